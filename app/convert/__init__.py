"""Read path: convert a stored version to a map in the requested format.

``recipe`` plans a conversion (cheaply, from the version's manifest), ``worker`` executes it, ``cache`` stores the
result and coalesces concurrent requests, ``app.pool`` runs the workers.
"""

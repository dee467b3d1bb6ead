"""READ: a stored version -> a map in the wanted format.

``recipe`` says how a map would be made (cheaply, from the version's manifest), ``worker`` makes it, ``cache`` keeps it
and lets one of many askers do the work, ``app.pool`` is where the work is done.
"""

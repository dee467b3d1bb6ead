"""A mirror: a server that follows another one, its centre, and serves while it is cut off (``fleetmap mirror``).

``centre`` is the client, which believes only what the centre has signed or what matches its hash; ``content`` fetches
chunks and files; ``follow`` brings the database up to date, pass by pass; ``process`` runs the passes.
"""

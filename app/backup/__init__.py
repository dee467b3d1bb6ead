"""Backups: consistent, incremental, verified, encrypted if wanted (``fleetmap backup``, ``fleetmap restore``).

A place of backups holds immutable packs of objects, each named by its hash, and one manifest per backup that lists the
packs which it consists of. ``repository`` is the place, ``packs`` the packs, ``encryption`` age; ``create`` writes a
backup, ``restore`` reads one, ``check`` hashes a place, ``retention`` says which backups stay.
"""

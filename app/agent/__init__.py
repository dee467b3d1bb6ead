"""The robot's side: a directory that always holds one complete, verified map of an environment.

``core`` the loop · ``trust`` verifies manifests · ``download`` fetches files over ``web`` (HTTP) · ``folder`` what is
on the disk · ``activation`` switches, with ``hooks`` · ``status`` reports · ``state`` survives a restart · ``ear``
Zenoh · ``options``. It imports nothing of the server but ``app.events.messages`` and ``app.errors``, so that it
installs without the server's packages.
"""

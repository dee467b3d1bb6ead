"""The robot's side: a directory that always holds one complete, verified map of an environment.

``core`` the loop · ``manifests`` fetches manifests, which ``trust`` verifies with ``freshness`` for time · ``download``
fetches files over ``web`` (HTTP) · ``folder`` what is on the disk · ``activation`` switches, with ``hooks`` and
``levels`` · ``status`` reports · ``state`` survives a restart · ``ear`` Zenoh · ``options``, ``requests``. It imports
nothing of the server but ``app.events.messages`` and ``app.errors``, so that it installs without the server's packages.
"""

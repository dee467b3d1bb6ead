"""The robot's side: a directory that always holds one complete, verified map of an environment.

``agent`` the loop · ``manifests`` fetches manifests, which ``signed_manifest`` verifies with ``freshness`` for time ·
``download``
fetches files over ``http_client`` (HTTP) · ``map_directory`` what is on the disk · ``activation`` switches, with
``hooks`` and
``levels`` · ``status`` reports · ``state`` survives a restart · ``zenoh_client`` Zenoh · ``options``, ``requests``. It
imports
nothing of the server but ``app.events.messages`` and ``app.errors``, so that it installs without the server's packages.
"""

"""The robot's side: a directory that always holds one complete, verified map of an environment.

Modules: ``agent`` sync loop · ``manifests`` fetches manifests, ``signed_manifest`` verifies them, ``freshness`` judges
their time · ``download`` fetches files with ``http_client`` · ``map_directory`` the files on disk · ``activation``
switches versions and runs ``hooks``, with ``levels`` · ``status`` reports · ``state`` persistent state ·
``zenoh_client`` Zenoh session · ``options`` and ``requests`` parameters.

Of the server it imports only ``app.errors``, ``app.events.messages`` and ``app.events.credentials``, so that it
installs without the server's packages.
"""

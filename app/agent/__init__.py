"""The robot's side: a folder that always holds one whole, verified map of an environment.

``trust`` what a robot believes · ``folder`` what stands on its disk · ``state`` what survives a restart · ``web``
HTTP · ``ear`` Zenoh · ``hooks`` what is run after a change · ``core`` the loop. It imports nothing of the server but
``app.events.messages`` and ``app.errors``, so that it installs without the server's packages.
"""

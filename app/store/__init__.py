"""The versioned store: environments, versions, content, channels, tokens, events and jobs, on SQLite or PostgreSQL.

``store`` the services together · ``values``, ``fleet_values`` what is handed out · ``changes`` what a version shall
change · ``encode`` canonical bytes · ``tree`` the chunk tree · ``parts`` layers as trees, by kind · ``diff`` what
differs · ``prepare`` working out a version · ``versions`` committing it · ``blobs`` files · ``garbage_collection``
upkeep · ``verify``, ``scrub`` damage · ``schema`` migrations.
"""

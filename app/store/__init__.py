"""Versioned store on SQLite or PostgreSQL: environments, versions, content, channels, tokens, events and jobs.

``store`` all services together · ``values``, ``fleet_values`` returned values · ``changes`` change sets · ``encode``
canonical bytes · ``tree`` the chunk tree · ``parts`` layers as trees, by kind · ``diff`` differences of parts ·
``prepare`` working out a version · ``versions`` committing it · ``blobs`` files · ``garbage_collection`` upkeep ·
``verify``, ``scrub`` detection of damage · ``schema`` migrations.
"""

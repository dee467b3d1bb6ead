"""Migration of a database in a process that is killed: ``python -m tests.chaos.migrator URL BLOBS``.

It prints a line right before it begins, so that a kill does not only meet imports.
"""

from __future__ import annotations

import sys
from pathlib import Path

from app.store import schema
from app.store.store import Store

if __name__ == "__main__":
    store = Store(sys.argv[1], Path(sys.argv[2]))
    schema.newest()  # reads the migrations
    print("migrating", flush=True)
    store.migrate()
    print("migrated", flush=True)

"""The store in a worker process: opened once, so that all that the process does shares one cache of chunks."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from app.store.store import Store


@lru_cache(maxsize=4)
def open_store(database_url: str, blob_dir: str) -> Store:
    """Open the store for reading; kept open between jobs."""
    from app.store.store import Store  # not needed to convert files

    return Store(database_url, Path(blob_dir), readonly=True)

"""Conformance suites of ports: each test runs on the local and on the shared adapter."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from app.backends.lead import Leads, open_leads
from app.store.store import Store
from tests.store.conftest import database_url, migrated_database, migrated_file

__all__ = ["database_url", "migrated_database", "migrated_file"]


@pytest.fixture
def open_process(database_url: str, tmp_path: Path) -> Iterator[Callable[[], Leads]]:
    """Function that opens the leads of one more process: of the same server, or of another one on PostgreSQL."""
    opened: list[Leads] = []

    def open_one() -> Leads:
        folder = tmp_path if database_url.startswith("sqlite") else tmp_path / str(len(opened))
        folder.mkdir(exist_ok=True)
        leads = open_leads(database_url, folder)
        leads.start()
        opened.append(leads)
        return leads

    yield open_one
    for leads in opened:
        leads.close()


@pytest.fixture
def store(database_url: str, tmp_path: Path) -> Iterator[Store]:
    new_store = Store(database_url, tmp_path / "blobs")
    new_store.migrate()
    yield new_store
    new_store.close()

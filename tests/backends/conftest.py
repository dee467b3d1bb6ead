"""Conformance suites of ports: each test runs on the local and on the shared adapter."""

from __future__ import annotations

from tests.postgres import postgres_cluster, postgres_url
from tests.store.conftest import migrated_database

__all__ = ["migrated_database", "postgres_cluster", "postgres_url"]

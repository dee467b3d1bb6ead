"""Fixtures of the container tests: a real PostgreSQL and the command line."""

from tests.cli.conftest import offline
from tests.postgres import postgres_cluster, postgres_url

__all__ = ["offline", "postgres_cluster", "postgres_url"]

"""A real PostgreSQL, and the command line, for the container files' tests."""

from tests.cli.conftest import offline
from tests.postgres import postgres_cluster, postgres_url

__all__ = ["offline", "postgres_cluster", "postgres_url"]

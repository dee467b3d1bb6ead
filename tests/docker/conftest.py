"""Fixtures of the container tests: a real PostgreSQL and the command line."""

from tests.cli.conftest import offline

__all__ = ["offline"]

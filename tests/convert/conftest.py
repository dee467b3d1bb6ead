"""Fixtures of the API tests, shared with these tests."""

from tests.api.conftest import api, fresh

__all__ = ["api", "fresh"]

"""The server that tests of the API share serves here too."""

from tests.api.conftest import api, fresh

__all__ = ["api", "fresh"]

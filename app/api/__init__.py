"""The HTTP interface: one module for each noun, which is discovered: it exposes its routes as ``router``.

``http`` has all that is below the nouns: ``http.middleware`` stands in front (token, bodies, errors),
``http.application`` before it (repeated requests from memory); ``http.problems`` knows the status of every error,
``http.schemas`` the shapes that nouns share.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator

from fastapi import APIRouter


def routers() -> Iterator[APIRouter]:
    """The routes below ``/api/v1`` of all nouns, by the names of their modules."""
    for name in sorted(module.name for module in pkgutil.iter_modules(__path__)):
        router = getattr(importlib.import_module(f"{__name__}.{name}"), "router", None)
        if isinstance(router, APIRouter):
            yield router

"""HTTP interface: one module per resource, discovered by its ``router``.

``http`` holds everything below the resources: ``http.middleware`` runs before all routes (tokens, bodies, errors),
``http.application`` before the middleware (repeated requests from memory). ``http.problems`` maps each error class to
a status, and ``http.schemas`` defines the shapes that resources share.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator

from fastapi import APIRouter


def routers() -> Iterator[APIRouter]:
    """Yield the routers below ``/api/v1`` of all resources, by module name."""
    for name in sorted(module.name for module in pkgutil.iter_modules(__path__)):
        router = getattr(importlib.import_module(f"{__name__}.{name}"), "router", None)
        if isinstance(router, APIRouter):
            yield router

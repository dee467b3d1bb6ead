"""OGC API: the content of an environment for GIS programs, below ``/ogc/{env}`` and ``/ogc/{env}/versions/{v}``.

Modules are discovered: by their ``router`` (see ``app.ogc.routing``) and by their ``extension`` (see
``app.ogc.extensions``), with which a module adds conformance classes, collections and links.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Iterator

from fastapi import APIRouter


def routers() -> Iterator[APIRouter]:
    """Yield the routers of all modules, by module name."""
    for name in sorted(module.name for module in pkgutil.iter_modules(__path__)):
        router = getattr(importlib.import_module(f"{__name__}.{name}"), "router", None)
        if isinstance(router, APIRouter):
            yield router

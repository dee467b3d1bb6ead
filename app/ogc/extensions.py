"""Extensions: what a module of this package adds to the pages that all modules share."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

from app.ogc.service import Link, Service
from app.store.values import Box


@dataclass(frozen=True, slots=True)
class Collection:
    """Entry of ``/collections``.

    bbox: (west, south, east, north) in degrees, None without an extent. members: further JSON members. links: besides
    those of extensions and of the collection's own page.
    """

    id: str
    title: str
    description: str
    bbox: Box | None = None
    members: Mapping[str, object] = field(default_factory=dict)
    links: Sequence[Link] = ()


async def _no_collections(_: Service) -> Sequence[Collection]:
    return ()


def _no_links(_: Service) -> Sequence[Link]:
    return ()


def _no_collection_links(_service: Service, _collection: str) -> Sequence[Link]:
    return ()


def _no_conformance(_: Service) -> Sequence[str]:
    return ()


async def _no_paths(_: Service) -> Mapping[str, object]:
    return {}


@dataclass(frozen=True, slots=True)
class Extension:
    """What a module adds, as its ``extension``.

    Attributes:
        conformance: URIs of conformance classes of all services; conformance_of: of one, besides these.
        collections: entries of ``/collections``.
        landing_links: links of the landing page.
        collection_links: links of a collection of any module.
        paths: path items of the OpenAPI 3.0 document, by path below the landing page.
    """

    conformance: Sequence[str] = ()
    conformance_of: Callable[[Service], Sequence[str]] = _no_conformance
    collections: Callable[[Service], Awaitable[Sequence[Collection]]] = _no_collections
    landing_links: Callable[[Service], Sequence[Link]] = _no_links
    collection_links: Callable[[Service, str], Sequence[Link]] = _no_collection_links
    paths: Callable[[Service], Awaitable[Mapping[str, object]]] = _no_paths


@cache
def extensions() -> tuple[Extension, ...]:
    """Return the extensions of all modules of this package, by module name."""
    folder = Path(__file__).parent
    modules = sorted(module.name for module in pkgutil.iter_modules([str(folder)]))
    loaded = [getattr(importlib.import_module(f"{__package__}.{name}"), "extension", None) for name in modules]
    return tuple(one for one in loaded if isinstance(one, Extension))


async def all_collections(service: Service) -> list[Collection]:
    """List the collections of all modules."""
    return [collection for one in extensions() for collection in await one.collections(service)]

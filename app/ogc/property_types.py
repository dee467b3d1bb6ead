"""JSON types of the properties of collections, without their tables: a write needs nothing else of all features."""

from __future__ import annotations

from collections import OrderedDict, defaultdict
from collections.abc import Mapping
from typing import Any, Final

import ormsgpack
import shapely

from app.ogc.service import Service
from app.ogc.tables import CACHE, JsonType, TableKey, VectorLayer, collection_of, json_types, table_key
from app.ogc.vector import EMPTY, TITLES
from app.store.content import ContentReader
from app.store.encode import array_header, from_wkb
from app.store.parts.features import PackedLeaf
from app.store.values import Version

Types = Mapping[str, frozenset[JsonType]]

MAX_CACHED: Final = 32
"""Maximum number of layers whose types are cached."""

_cached: OrderedDict[TableKey, Mapping[str, Types]] = OrderedDict()
"""Types by collection of the layers used last. Used by the event loop only."""


async def property_types(service: Service, version: Version, collection: str) -> Types:
    """Return the types of the properties of a vector collection in a version of the service's environment.

    The level and part of features are text in any case.
    """
    layer = TITLES[collection][0]
    key = table_key(version, layer)
    tables = None if key is None else CACHE.get(key)
    if tables is not None and collection in tables:
        return tables[collection].types
    by_collection: Mapping[str, Types] = {}
    if key is not None and tables is None:
        if key not in _cached:
            content, cache = service.services.store.content, service.services.response_cache
            _cached[key] = await cache.join(("types", key), read_types, content, version, layer)
        _cached.move_to_end(key)
        by_collection = _cached[key]
        while len(_cached) > MAX_CACHED:
            _cached.popitem(last=False)
    declared = EMPTY.get(collection)
    return by_collection.get(collection, {} if declared is None else declared.types)


def read_types(content: ContentReader, version: Version, layer: VectorLayer) -> dict[str, Types]:
    """Read the types of a layer's properties, by id of the collection."""
    seen: dict[str, dict[tuple[str, type], None]] = defaultdict(dict)
    for entry in version.parts:
        if entry.key.layer == layer and entry.count:
            for leaf in content.packed_leaves(version, entry.key):
                _add_leaf(seen, layer, leaf)
    return {name: json_types(pairs) for name, pairs in seen.items()}


def _add_leaf(seen: dict[str, dict[tuple[str, type], None]], layer: VectorLayer, leaf: PackedLeaf) -> None:
    rows: list[dict[str, Any]] = ormsgpack.unpackb(array_header(len(leaf.ids)) + b"".join(leaf.properties))
    shapes = shapely.get_type_id(from_wkb(leaf.wkb)).tolist() if layer == "objects" else [0] * len(rows)
    for members, shape in zip(rows, shapes, strict=True):
        names = (f"stored_{name}" if name in ("level", "part") else name for name in members)
        pairs = zip(names, map(type, members.values()), strict=True)
        seen[collection_of(layer, members.get("kind"), shape)].update(dict.fromkeys(pairs))

"""Features of a collection as prepared rows, so that a page is joined text, and a box a comparison of arrays.

Tables depend on the content of a layer and on the datum only, so that versions share them. They are cached up to a
number of bytes.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
import orjson
import shapely
from numpy.typing import NDArray

from app.api.http.features import Position, geometries_as_geojson
from app.api.http.responses import json_bytes
from app.model.features import Features, Properties
from app.model.frame import Datum
from app.model.geodesy import LocalFrame, local_frame
from app.model.layers import PartKey
from app.ogc.crs import ReferenceSystem
from app.store.content import ContentReader
from app.store.extent import join
from app.store.values import Box, Version

VectorLayer = Literal["topology", "objects", "zones", "location"]
VECTOR_LAYERS: tuple[VectorLayer, ...] = get_args(VectorLayer)

MAX_CACHED_BYTES = 256 * 2**20
"""Maximum size of the cached tables of a process; the newest one is cached in any case."""

ROW_BYTES = 600
"""Estimated size of a row besides its text and coordinates: Python objects and a geometry."""

MAX_PROPERTIES = 1000
"""Maximum number of properties in a collection's schema; further ones are in its features only."""

BATCH = 4096
"""Number of features that are written at a time."""

WGS84_DIGITS = 12

JsonType = Literal["string", "integer", "number", "boolean", "object", "array"]
_JSON_TYPES: Mapping[type, JsonType] = {
    str: "string",
    int: "integer",
    float: "number",
    bool: "boolean",
    dict: "object",
    list: "array",
    tuple: "array",
}


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """Rows of a collection in the order of level, part and id.

    Attributes:
        ids: distinct ids. source_ids: those of the parts, where two parts may have the same.
        parts: first row and key of each part.
        geometry: shapely geometries as they are anchored; local: bool [n], True for metres.
        boxes: float64 [n, 4] in degrees, NaN without coordinates. heights: float64 [n, 2], NaN without heights.
        texts: each feature as GeoJSON in CRS84. spans: int32 [n, 2], start and end of the geometry in it.
        types: JSON types of each property. geometry_types: names of the geometries' types.
    """

    ids: Sequence[str]
    source_ids: Sequence[str]
    parts: Sequence[tuple[int, PartKey]]
    geometry: NDArray[np.object_]
    local: NDArray[np.bool_]
    boxes: NDArray[np.float64]
    heights: NDArray[np.float64]
    texts: Sequence[bytes]
    spans: NDArray[np.int32]
    types: Mapping[str, frozenset[JsonType]]
    geometry_types: frozenset[str]
    datum: Datum
    rows: Mapping[str, int] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.ids)

    def part_of(self, row: int) -> PartKey:
        """Return the key of a row's part."""
        return next(key for start, key in reversed(self.parts) if start <= row)

    def position(self, row: int) -> Position:
        """Return the position of a row in the order of the collection."""
        key = self.part_of(row)
        return Position(key.layer, key.level, key.name, self.source_ids[row])

    @property
    def bbox(self) -> Box | None:
        """Return the box in degrees around all rows, None without coordinates."""
        boxes = self.boxes[~np.isnan(self.boxes[:, 0])]
        if not len(boxes):
            return None
        low, high = boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)
        return join([(float(low[0]), float(low[1]), float(high[0]), float(high[1]))], self.datum.longitude)

    @property
    def size(self) -> int:
        """Return the estimated size in bytes."""
        coordinates = int(shapely.get_num_coordinates(self.geometry).sum())
        return ROW_BYTES * len(self) + sum(map(len, self.texts)) + 24 * coordinates

    def in_wgs84(self, rows: NDArray[np.intp]) -> NDArray[np.object_]:
        """Return the geometries of rows in degrees."""
        return _converted(self.geometry[rows], self.local[rows], local_frame(self.datum))

    def in_crs(self, rows: NDArray[np.intp], crs: ReferenceSystem) -> NDArray[np.object_]:
        """Return the geometries of rows in a CRS. Raises Invalid if one is too far away for the local frame."""
        if crs.kind != "local":
            return crs.from_wgs84(self.in_wgs84(rows), self.datum)
        out, local = self.geometry[rows], self.local[rows]
        if not local.all():
            out[~local] = crs.from_wgs84(out[~local], self.datum)
        return out


def _converted(geometry: NDArray[np.object_], local: NDArray[np.bool_], frame: LocalFrame) -> NDArray[np.object_]:
    out = geometry.copy()
    if local.any():
        out[local] = frame.geometries_to_wgs84(geometry[local])
    return out


# --- from parts to tables ---


def collection_of(layer: VectorLayer, kind: object, geometry_type: int) -> str:
    """Return the id of the collection for an item: one geometry type each."""
    if layer == "topology":
        return "edges" if kind == "edge" else "nodes"
    if layer == "objects":
        families = {0: "points", 4: "points", 1: "lines", 2: "lines", 5: "lines", 3: "polygons", 6: "polygons"}
        return f"objects-{families.get(geometry_type, 'other')}"
    return "zones" if layer == "zones" else "fence"


@dataclass(slots=True)
class _Columns:
    """Columns of a table under construction."""

    ids: list[str] = field(default_factory=list)
    source_ids: list[str] = field(default_factory=list)
    parts: list[tuple[int, PartKey]] = field(default_factory=list)
    arrays: dict[str, list[NDArray[Any]]] = field(default_factory=dict)
    texts: list[bytes] = field(default_factory=list)
    types: dict[str, set[JsonType]] = field(default_factory=dict)
    rows: dict[str, int] = field(default_factory=dict)

    def add_part(self, key: PartKey, part: Features, indices: NDArray[np.intp], frame: LocalFrame) -> None:
        """Add some features of a part."""
        self.parts.append((len(self.ids), key))
        for start in range(0, len(indices), BATCH):
            self._add_batch(key, part, indices[start : start + BATCH], frame)

    def _add_batch(self, key: PartKey, part: Features, indices: NDArray[np.intp], frame: LocalFrame) -> None:
        geometry, local = part.geometry[indices], part.local[indices]
        degrees = _converted(geometry, local, frame)
        spans = np.empty((len(indices), 2), np.int32)
        shapes = geometries_as_geojson(degrees, WGS84_DIGITS)
        for k, (index, shape) in enumerate(zip(indices.tolist(), shapes, strict=True)):
            source_id, properties = part.ids[index], part.properties[index]
            item = self._distinct_id(source_id, key)
            members = with_place(properties, key)
            self._note_types(members)
            head = b'{"type":"Feature","id":' + orjson.dumps(item) + b',"geometry":'
            shown = b"null" if shape is None else bytes(orjson.dumps(shape))
            self.texts.append(head + shown + b',"properties":' + json_bytes(members) + b"}")
            spans[k] = len(head), len(head) + len(shown)
            self.ids.append(item)
            self.source_ids.append(source_id)
        columns = {
            "geometry": geometry,
            "local": local,
            "boxes": shapely.bounds(degrees).reshape(-1, 4),
            "heights": _heights(degrees),
            "spans": spans,
        }
        for name, column in columns.items():
            self.arrays.setdefault(name, []).append(column)

    def _distinct_id(self, item: str, key: PartKey) -> str:
        """Return the id, qualified by level and part if an earlier part has the same one."""
        candidate, number = item, 1
        while candidate in self.rows:
            candidate = f"{item}@{key.level}/{key.name}" + (f"#{number}" if number > 1 else "")
            number += 1
        self.rows[candidate] = len(self.ids)
        return candidate

    def _note_types(self, properties: Properties) -> None:
        for name, value in properties.items():
            if value is None or (name not in self.types and len(self.types) >= MAX_PROPERTIES):
                continue
            self.types.setdefault(name, set()).add(_JSON_TYPES.get(type(value), "object"))

    def table(self, datum: Datum) -> Table:
        """Return the table."""
        arrays = {name: np.concatenate(columns) for name, columns in self.arrays.items()}
        kinds = frozenset(str(name) for name in {g.geom_type for g in arrays["geometry"]})
        return Table(
            ids=self.ids,
            source_ids=self.source_ids,
            parts=self.parts,
            texts=self.texts,
            types={name: frozenset(types) for name, types in self.types.items()},
            geometry_types=kinds,
            datum=datum,
            rows=self.rows,
            **arrays,
        )


def with_place(properties: Properties, key: PartKey) -> dict[str, Any]:
    """Add level and part; stored properties of these names move to ``stored_level`` and ``stored_part``."""
    place = {"level": key.level, "part": key.name}
    moved = {f"stored_{name}": properties[name] for name in place if name in properties}
    return {**properties, **place, **moved}


def _heights(geometry: NDArray[np.object_]) -> NDArray[np.float64]:
    """Return minimum and maximum z of each geometry, NaN for those without."""
    out = np.full((len(geometry), 2), np.nan)
    for row in np.flatnonzero(shapely.has_z(geometry)).tolist():
        z = shapely.get_coordinates(geometry[row], include_z=True)[:, 2]
        out[row] = z.min(), z.max()
    return out


def build_tables(content: ContentReader, version: Version, layer: VectorLayer) -> dict[str, Table]:
    """Build the tables of a layer, by id of the collection. Takes seconds for 100 000 features: call it in a thread."""
    assert version.datum is not None
    frame = local_frame(version.datum)
    columns: dict[str, _Columns] = {}
    for key, part in _parts(content, version, layer):
        kinds = [properties.get("kind") for properties in part.properties]
        shapes = shapely.get_type_id(part.geometry).tolist()
        names = np.array([collection_of(layer, k, s) for k, s in zip(kinds, shapes, strict=True)], object)
        for name in dict.fromkeys(names.tolist()):
            columns.setdefault(name, _Columns()).add_part(key, part, np.flatnonzero(names == name), frame)
    return {name: one.table(version.datum) for name, one in sorted(columns.items())}


def build_item_table(
    content: ContentReader, version: Version, layer: VectorLayer, collection: str, item: str
) -> Table | None:
    """Build the table of one feature, by an id that is not qualified; None if there is none. Reads little."""
    assert version.datum is not None
    for entry in version.parts:
        if entry.key.layer != layer or not entry.count:
            continue
        part = content.features(version, entry.key, ids=[item])
        kinds = zip(part.properties, shapely.get_type_id(part.geometry).tolist(), strict=True)
        if any(collection_of(layer, properties.get("kind"), shape) == collection for properties, shape in kinds):
            columns = _Columns()
            columns.add_part(entry.key, part, np.array([0]), local_frame(version.datum))
            return columns.table(version.datum)
    return None


def _parts(content: ContentReader, version: Version, layer: VectorLayer) -> Iterator[tuple[PartKey, Features]]:
    for entry in version.parts:
        if entry.key.layer == layer and entry.count:
            part = content.load(version, [entry.key]).parts[entry.key]
            assert isinstance(part, Features)
            yield entry.key, part


# --- cache ---

TableKey = tuple[Datum, tuple[tuple[PartKey, str], ...]]


def table_key(version: Version, layer: VectorLayer) -> TableKey | None:
    """Return what the tables of a layer depend on; None if it has none: no datum or no content."""
    parts = tuple((entry.key, entry.hash) for entry in version.parts if entry.key.layer == layer and entry.count)
    return (version.datum, parts) if version.datum is not None and parts else None


class TableCache:
    """Least recently used tables, up to a number of bytes. Thread-safe."""

    def __init__(self, max_bytes: int = MAX_CACHED_BYTES) -> None:
        self._max_bytes = max_bytes
        self._entries: OrderedDict[TableKey, tuple[dict[str, Table], int]] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: TableKey) -> dict[str, Table] | None:
        """Return the tables of a layer, None if they are not cached."""
        with self._lock:
            entry = self._entries.get(key)
            if entry is None:
                return None
            self._entries.move_to_end(key)
            return entry[0]

    def put(self, key: TableKey, tables: dict[str, Table]) -> None:
        """Cache the tables of a layer."""
        size = sum(table.size for table in tables.values())
        with self._lock:
            self._entries[key] = tables, size
            while len(self._entries) > 1 and sum(cached for _, cached in self._entries.values()) > self._max_bytes:
                self._entries.popitem(last=False)


CACHE = TableCache()
"""Tables of this process: they depend on content only, so that all stores can share them."""

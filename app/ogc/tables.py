"""Features of a collection as rows, so that a page is joined text, and a box a comparison of arrays.

Tables depend on the content of a layer and on the datum only, so that versions share them. They are cached up to a
number of bytes.
"""

from __future__ import annotations

import re
import threading
from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import itemgetter
from typing import Any, Final, Literal, NamedTuple, get_args

import numpy as np
import orjson
import ormsgpack
import shapely
from numpy.typing import NDArray

from app.api.http.features import Position, geometries_as_geojson
from app.api.http.responses import json_bytes
from app.model.antimeridian import cut_at_antimeridian
from app.model.features import Properties
from app.model.frame import Datum
from app.model.geodesy import LocalFrame, local_frame
from app.model.layers import Layer, PartKey
from app.ogc.crs import ReferenceSystem
from app.store.content import ContentReader
from app.store.extent import join
from app.store.parts.features import PackedFeatures
from app.store.values import Box, Version

VectorLayer = Literal["topology", "objects", "zones", "location"]
VECTOR_LAYERS: tuple[VectorLayer, ...] = get_args(VectorLayer)

MAX_CACHED_BYTES = 256 * 2**20
"""Maximum size of the cached tables of a process; the newest one is cached in any case."""

ROW_BYTES = 900
"""Estimated size of a row besides its text and coordinates: Python objects and a geometry."""

_PLACED: Final = frozenset({"level", "part", "stored_level", "stored_part"})
_EDGE: Final = ormsgpack.packb("kind") + ormsgpack.packb("edge")

_NUMBERED: Final = re.compile(r"#[0-9]+\Z")

MAX_PROPERTIES = 1000
"""Maximum number of properties in a collection's schema; further ones are in its features only."""

BATCH = 4096
"""Maximum number of features that are written at a time."""

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


class Text(NamedTuple):
    """A feature as GeoJSON in CRS84, with the start and the end of its geometry."""

    text: bytes
    start: int
    end: int


@dataclass(frozen=True, slots=True)
class Declared:
    """What a collection without features says of them."""

    types: Mapping[str, frozenset[JsonType]]
    geometry_types: frozenset[str]


@dataclass(frozen=True, eq=False)
class Table:
    """Rows of a collection in the order of level, part and id. What a request may not need is made on demand, once.

    Attributes:
        ids: distinct ids. source_ids: those of the parts, where two parts may have the same.
        parts: first row and key of each part.
        geometry: shapely geometries as they are anchored; local: bool [n], True for metres.
        packed: properties of each row as MessagePack.
        declared: types of properties and names of geometries' types of a collection without features.
    """

    ids: Sequence[str]
    source_ids: Sequence[str]
    parts: Sequence[tuple[int, PartKey]]
    geometry: NDArray[np.object_]
    local: NDArray[np.bool_]
    packed: Sequence[bytes]
    datum: Datum
    declared: Declared | None = None
    _texts: dict[int, Text] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.ids)

    def part_of(self, row: int) -> PartKey:
        """Return the key of a row's part."""
        return self.parts[bisect_right(self.parts, row, key=itemgetter(0)) - 1][1]

    def _spans(self) -> Iterator[tuple[PartKey, int, int]]:
        """Yield each part's key, first row and the row after its last; nothing for a table without rows."""
        ends = [*(start for start, _ in self.parts[1:]), len(self)]
        for (start, key), end in zip(self.parts, ends, strict=False):  # without rows there is no part
            yield key, start, end

    def position(self, row: int) -> Position:
        """Return the position of a row in the order of the collection."""
        key = self.part_of(row)
        return Position(key.layer, key.level, key.name, self.source_ids[row])

    def properties(self, row: int) -> dict[str, Any]:
        """Return the properties of a row, with its place."""
        return with_place(ormsgpack.unpackb(self.packed[row]), self.part_of(row))

    def all_properties(self) -> Iterator[dict[str, Any]]:
        """Yield the properties of each row, with its place."""
        for key, start, end in self._spans():
            for packed in self.packed[start:end]:
                yield with_place(ormsgpack.unpackb(packed), key)

    def with_property(self, rows: Sequence[int], name: str, values: Sequence[object]) -> Sequence[int]:
        """Return the rows whose property may have one of these values: without unpacking what cannot."""
        if name in _PLACED:
            return rows
        words = [ormsgpack.packb(value) for value in values if isinstance(value, str)]
        key = ormsgpack.packb(name)
        sought = [key + word for word in words] if len(words) == len(values) else [key]
        return [row for row in rows if any(one in self.packed[row] for one in sought)]

    @cached_property
    def rows(self) -> Mapping[str, int]:
        """Return the row of each id."""
        return {item: row for row, item in enumerate(self.ids)}

    def row_of(self, feature: str) -> int | None:
        """Return the row of an id, which may be qualified in any case; None if there is none."""
        row = self.rows.get(feature)
        for key, start, end in self._spans():
            item = unqualified(feature, key) if row is None else None
            if item is not None and item in self.source_ids[start:end]:
                row = self.source_ids.index(item, start, end)
        return row

    @cached_property
    def boxes(self) -> NDArray[np.float64]:
        """Return the boxes in degrees, float64 [n, 4], NaN without coordinates."""
        bounds: NDArray[np.float64] = shapely.bounds(self.in_wgs84(np.arange(len(self)))).reshape(-1, 4)
        return bounds

    @cached_property
    def heights(self) -> NDArray[np.float64]:
        """Return the minimum and maximum height of each row, float64 [n, 2], NaN without heights."""
        out = np.full((len(self), 2), np.nan)
        for row in np.flatnonzero(shapely.has_z(self.geometry)).tolist():
            z = shapely.get_coordinates(self.geometry[row], include_z=True)[:, 2]
            out[row] = z.min(), z.max()
        return out

    @cached_property
    def bbox(self) -> Box | None:
        """Return the box in degrees around all rows, None without coordinates."""
        boxes = self.boxes[~np.isnan(self.boxes[:, 0])]
        if not len(boxes):
            return None
        if boxes[:, 2].max() - boxes[:, 0].min() > 180.0:  # on both sides of the antimeridian
            boxes = shapely.bounds(shapely.get_parts(self.in_wgs84(np.arange(len(self)))))
            boxes = boxes[~np.isnan(boxes[:, 0])]
            return join(
                [(west, south, east, north) for west, south, east, north in boxes.tolist()], self.datum.longitude
            )
        low, high = boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)
        return (float(low[0]), float(low[1]), float(high[0]), float(high[1]))

    @cached_property
    def types(self) -> Mapping[str, frozenset[JsonType]]:
        """Return the JSON types of each property."""
        if self.declared is not None:
            return self.declared.types
        seen: dict[tuple[str, type], None] = {}  # in the order of their first feature
        for members in self.all_properties():
            seen.update(dict.fromkeys(zip(members, map(type, members.values()), strict=True)))
        return json_types(seen)

    @cached_property
    def geometry_types(self) -> frozenset[str]:
        """Return the names of the geometries' types."""
        if self.declared is not None:
            return self.declared.geometry_types
        _, first = np.unique(shapely.get_type_id(self.geometry), return_index=True)
        return frozenset(str(geometry.geom_type) for geometry in self.geometry[first])

    def is_written(self, rows: Sequence[int]) -> bool:
        """Return whether the texts of rows are ready."""
        return all(row in self._texts for row in rows)

    def texts(self, rows: Sequence[int]) -> list[Text]:
        """Return rows as GeoJSON in CRS84."""
        missing = [row for row in rows if row not in self._texts]
        for start in range(0, len(missing), BATCH):
            self._write(missing[start : start + BATCH])
        return [self._texts[row] for row in rows]

    def _write(self, rows: Sequence[int]) -> None:
        shapes = geometries_as_geojson(self.in_wgs84(np.array(rows, np.intp)), WGS84_DIGITS)
        for row, shape in zip(rows, shapes, strict=True):
            head = b'{"type":"Feature","id":' + orjson.dumps(self.ids[row]) + b',"geometry":'
            shown = b"null" if shape is None else bytes(orjson.dumps(shape))
            text = head + shown + b',"properties":' + json_bytes(self.properties(row)) + b"}"
            self._texts[row] = Text(text, len(head), len(head) + len(shown))

    @property
    def size(self) -> int:
        """Return the estimated size in bytes, once all texts are written."""
        coordinates = int(shapely.get_num_coordinates(self.geometry).sum())
        return ROW_BYTES * len(self) + 3 * sum(map(len, self.packed)) + 72 * coordinates

    def in_wgs84(self, rows: NDArray[np.intp]) -> NDArray[np.object_]:
        """Return the geometries of rows in degrees, cut at the antimeridian."""
        return cut_at_antimeridian(self._in_degrees(rows))

    def _in_degrees(self, rows: NDArray[np.intp]) -> NDArray[np.object_]:
        return _converted(self.geometry[rows], self.local[rows], local_frame(self.datum))

    def in_crs(self, rows: NDArray[np.intp], crs: ReferenceSystem) -> NDArray[np.object_]:
        """Return the geometries of rows in a CRS; in the local frame those too far away are empty."""
        if crs.kind != "local":
            geometry = self.in_wgs84(rows) if crs.ends_at_antimeridian else self._in_degrees(rows)
            return crs.from_wgs84(geometry, self.datum)
        out, local = self.geometry[rows], self.local[rows]
        if not local.all():
            out[~local] = crs.from_wgs84(out[~local], self.datum)
        return out


def _converted(geometry: NDArray[np.object_], local: NDArray[np.bool_], frame: LocalFrame) -> NDArray[np.object_]:
    out = geometry.copy()
    if local.any():
        out[local] = frame.geometries_to_wgs84(geometry[local])
    return out


def json_types(seen: Iterable[tuple[str, type]]) -> dict[str, frozenset[JsonType]]:
    """Return the JSON types of properties. seen: names with Python types."""
    out: dict[str, set[JsonType]] = {}
    for name, kind in seen:
        if kind is not type(None) and (name in out or len(out) < MAX_PROPERTIES):
            out.setdefault(name, set()).add(_JSON_TYPES.get(kind, "object"))
    return {name: frozenset(types) for name, types in out.items()}


# --- ids ---


def qualifier(key: PartKey) -> str:
    """Return what follows the id of a feature whose id an earlier part has, too."""
    return f"@{key.level}/{key.name}"


def unqualified(feature: str, key: PartKey) -> str | None:
    """Return the id in a part of a feature with a qualified id; None if it is not qualified by this part."""
    for text in (feature, _NUMBERED.sub("", feature)):
        item = text.removesuffix(qualifier(key))
        if item and item != text:
            return item
    return None


# --- from parts to tables ---


def collection_of(layer: Layer, kind: object, geometry_type: int) -> str:
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
    geometry: list[NDArray[np.object_]] = field(default_factory=list)
    local: list[NDArray[np.bool_]] = field(default_factory=list)
    packed: list[bytes] = field(default_factory=list)
    taken: set[str] = field(default_factory=set)

    def add_part(self, key: PartKey, part: PackedFeatures, rows: NDArray[np.intp]) -> None:
        """Add some features of a part."""
        self.parts.append((len(self.ids), key))
        numbers = rows.tolist()
        ids = [part.ids[row] for row in numbers]
        self.source_ids += ids
        if self.taken.isdisjoint(ids):
            self.taken.update(ids)
        else:
            ids = [self._distinct_id(item, key) for item in ids]
        self.ids += ids
        self.geometry.append(part.geometry[rows])
        self.local.append(part.local[rows])
        self.packed += [part.properties[row] for row in numbers]

    def _distinct_id(self, item: str, key: PartKey) -> str:
        """Return the id, qualified by level and part if an earlier part has the same one."""
        candidate, number = item, 1
        while candidate in self.taken:
            candidate = item + qualifier(key) + (f"#{number}" if number > 1 else "")
            number += 1
        self.taken.add(candidate)
        return candidate

    def table(self, datum: Datum) -> Table:
        """Return the table."""
        geometry, local = np.concatenate(self.geometry), np.concatenate(self.local)
        return Table(self.ids, self.source_ids, self.parts, geometry, local, self.packed, datum)


def with_place(properties: Properties, key: PartKey) -> dict[str, Any]:
    """Add level and part; stored properties of these names move to ``stored_level`` and ``stored_part``."""
    out = {**properties, "level": key.level, "part": key.name}
    if "level" in properties:
        out["stored_level"] = properties["level"]
    if "part" in properties:
        out["stored_part"] = properties["part"]
    return out


def build_tables(content: ContentReader, version: Version, layer: VectorLayer) -> dict[str, Table]:
    """Build the tables of a layer, by id of the collection. Not for the event loop: large ones take a second."""
    assert version.datum is not None
    columns: dict[str, _Columns] = {}
    for entry in version.parts:
        if entry.key.layer == layer and entry.count:
            part = content.packed_features(version, entry.key)
            names = _collections_of(layer, part)
            for name in dict.fromkeys(names.tolist()):
                columns.setdefault(name, _Columns()).add_part(entry.key, part, np.flatnonzero(names == name))
    return {name: one.table(version.datum) for name, one in sorted(columns.items())}


def _collections_of(layer: VectorLayer, part: PackedFeatures) -> NDArray[np.object_]:
    """Return the id of the collection of each feature."""
    if layer == "topology":
        names = [collection_of(layer, "edge" if _is_edge(packed) else "node", 0) for packed in part.properties]
    else:
        names = [collection_of(layer, None, shape) for shape in shapely.get_type_id(part.geometry).tolist()]
    return np.array(names, object)


def _is_edge(packed: bytes) -> bool:
    """Return whether packed properties have the kind ``edge``; most that have not lack these bytes."""
    return _EDGE in packed and ormsgpack.unpackb(packed).get("kind") == "edge"


def table_of(key: PartKey, item: str, geometry: Any, properties: Properties, *, local: bool, datum: Datum) -> Table:
    """Build the table of one feature."""
    packed = ormsgpack.packb(dict(properties))
    return Table([item], [item], [(0, key)], np.array([geometry], object), np.array([local]), [packed], datum)


def empty_table(declared: Declared, datum: Datum) -> Table:
    """Build a table without rows."""
    return Table([], [], [], np.empty(0, object), np.empty(0, bool), [], datum, declared)


def build_item_table(
    content: ContentReader, version: Version, layer: VectorLayer, collection: str, feature: str
) -> Table | None:
    """Build the table of one feature, by its id; None if there is none, or if only the whole table tells. Reads little.

    It has the id that it has in the whole table.
    """
    keys = [entry.key for entry in version.parts if entry.key.layer == layer and entry.count]
    qualified = [(key, item) for key in keys if (item := unqualified(feature, key)) is not None]
    if not qualified:
        tables = (_item_table(content, version, key, collection, feature) for key in keys)
        return next((table for table in tables if table is not None), None)
    holder, item = qualified[0]
    is_plain = feature == item + qualifier(holder) and "@" not in item
    if len(qualified) > 1 or not is_plain or any(content.has_ids(version, key, [feature]) for key in keys):
        return None
    earlier = keys[: keys.index(holder)]
    is_taken = any(_item_table(content, version, key, collection, item) is not None for key in earlier)
    table = _item_table(content, version, holder, collection, item)
    return replace(table, ids=[feature]) if table is not None and is_taken else table


def _item_table(content: ContentReader, version: Version, key: PartKey, collection: str, item: str) -> Table | None:
    """Build the table of one feature of a part, by its id there; None if there is none."""
    assert version.datum is not None
    part = content.features(version, key, ids=[item])
    if not len(part):
        return None
    geometry, properties, local = part.geometry[0], part.properties[0], bool(part.local[0])
    if collection_of(key.layer, properties.get("kind"), shapely.get_type_id(geometry)) != collection:
        return None
    return table_of(key, item, geometry, properties, local=local, datum=version.datum)


def build_box_table(content: ContentReader, version: Version, layer: VectorLayer, name: str, box: Box) -> Table | None:
    """Build the table of what a collection has in a box in degrees; None if it has nothing there.

    The layer must have one part with content: of several, ids may need to be qualified.
    """
    assert version.datum is not None
    (key,) = [entry.key for entry in version.parts if entry.key.layer == layer and entry.count]
    part = content.packed_in_box(version, key, box)
    rows = np.flatnonzero(_collections_of(layer, part) == name)
    if not len(rows):
        return None
    columns = _Columns()
    columns.add_part(key, part, rows)
    return columns.table(version.datum)


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

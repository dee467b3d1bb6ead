"""Read a route graph: its features as a network."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import shapely

from app.errors import Problem, TooLarge, UnreadableFile
from app.formats import Files, ReadContext, _fields
from app.formats._network import Array, duplicates, edge_lines, node_points, number, raise_unreadable, shorten_list
from app.formats.nav2_route.vocabulary import (
    CANONICAL_METADATA,
    FLOATS,
    FRAME,
    LINES,
    MAX_ID,
    NAME,
    NUMBERS,
    SHAPE,
    TEXTS,
    TRIGGERS,
)
from app.model.features import from_columns, unique_ids
from app.model.layers import NETWORK, Layers, PartKey
from app.syntax import json


def read(files: Files, context: ReadContext) -> Layers:
    """Read the graph as topology, local metres. Raises UnreadableFile naming the feature, or TooLarge."""
    if not context.wants("topology"):
        return Layers()
    top = json.load(files[context.main or next(iter(files))], context.limits)
    rows = top.get("features") if isinstance(top, dict) else None
    if not isinstance(top, dict) or not isinstance(rows, list):
        raise UnreadableFile(
            "a route graph must be an object with an array of features", [Problem("missing array", where="features")]
        )
    if len(rows) > context.limits.features:
        raise TooLarge(f"the file has {len(rows)} features; the limit is {context.limits.features}")
    layers = _Reader(top, rows, context).layers()
    _fields.check(top, SHAPE, context)
    return layers


class _Reader:
    def __init__(self, top: dict[str, Any], rows: list[Any], context: ReadContext) -> None:
        self.top, self.rows, self.context = top, rows, context
        self.nodes: list[int] = []
        self.edges: list[int] = []
        self.ignored: list[Any] = []
        self.dangling: list[dict[str, Any]] = []
        self.is_complete: Counter[str] = Counter()
        for k, row in enumerate(rows):
            location = f"features[{k}]"
            geometry = row.get("geometry") if isinstance(row, dict) else None
            if not isinstance(row, dict) or not isinstance(geometry, (dict, type(None))):
                raise_unreadable("must be a GeoJSON feature with a geometry", location)
            kind = geometry.get("type") if geometry else None
            if kind == "Point":
                self.nodes.append(k)
            elif kind in LINES:
                self.edges.append(k)
            else:
                context.warn(
                    "neither a point nor a line; it is stored, but the route server ignores it", where=location
                )
                self.ignored.append(row)
        if not self.nodes or not self.edges:
            noun = "point (node)" if not self.nodes else "line (edge)"
            reason = f"no {noun}: the route server needs at least one node and one edge"
            raise UnreadableFile(reason, [Problem(reason, where="features")])

    def layers(self) -> Layers:
        numbers = [self.read_id(k) for k in self.nodes]
        ids = unique_ids(map(str, numbers))
        if repeats := duplicates(list(map(str, numbers))):
            self.context.warn(
                f"{len(repeats)} nodes share an id: {shorten_list(repeats)}; edges connect to the last one, as in Nav2"
            )
        index_by_number = {n: k for k, n in enumerate(numbers)}
        xyz: Array = np.array([self.position(k) for k in self.nodes], np.float64).reshape(-1, 3)
        properties: list[dict[str, Any]] = [
            {"kind": "node", "name": str(n), **self.canonical(k, n)} for k, n in zip(self.nodes, numbers, strict=True)
        ]
        indices, numbers, sources, targets = self.ends(index_by_number, properties)
        edges = unique_ids(map(str, numbers), set(ids))
        if repeats := duplicates(list(map(str, numbers))):
            self.context.warn(
                f"{len(repeats)} edges share an id: {shorten_list(repeats)}; later ones are exported with a new one"
            )
        lines = edge_lines(xyz, sources, targets)
        for j, (k, n) in enumerate(zip(indices, numbers, strict=True)):
            p = {"kind": "edge", "source": ids[sources[j]], "target": ids[targets[j]], **self.canonical(k, n)}
            lines[j] = self.shape(k, lines[j], p[NAME])
            properties.append(p)
        if self.is_complete["integers"]:
            self.context.warn(
                f"{self.is_complete['integers']} metadata values ({', '.join(sorted(FLOATS))}) are integers, "
                "which Nav2 rejects; they are exported as floats"
            )
        document: dict[str, Any] = {"members": {w: v for w, v in self.top.items() if w not in ("type", "features")}}
        credit = [self.top[w] for w in ("attribution", "license", "copyright") if isinstance(self.top.get(w), str)]
        document |= {"ignored": self.ignored} if self.ignored else {}
        document |= {"dangling": self.dangling} if self.dangling else {}
        geometry = np.concatenate([node_points(xyz), lines])
        collection_document = {NAME: document, "attribution": credit} if credit else {NAME: document}
        part = from_columns([*ids, *edges], geometry, properties, "local", collection_document)
        return Layers({PartKey("topology", self.context.level, NETWORK): part})

    def properties_of(self, k: int) -> dict[str, Any]:
        """Return the properties of a feature."""
        properties = self.rows[k].get("properties")
        if not isinstance(properties, dict):
            raise_unreadable("needs properties with an id", f"features[{k}]")
        return properties

    def read_id(self, k: int, key: str = "id") -> int:
        """Return a node's or edge's number."""
        value = self.properties_of(k).get(key)
        if isinstance(value, float) and value.is_integer():
            value = int(value)
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= MAX_ID:
            shown = "is missing" if value is None else f"is {str(value)[:40]!r}"
            raise_unreadable(f"{shown}; must be an integer from 0 to {MAX_ID}", f"features[{k}].properties.{key}")
        return value

    def position(self, k: int) -> tuple[float, float, float]:
        """Return x, y, z in metres."""
        location = f"features[{k}].geometry.coordinates"
        at = self.rows[k]["geometry"].get("coordinates")
        if not isinstance(at, list) or len(at) < 2:
            raise_unreadable("a node needs two coordinates [x, y]", location)
        x, y, z = (number(v, location) for v in [*at[:3], 0.0][:3])
        frame = self.properties_of(k).get("frame", FRAME)
        if frame != FRAME:
            self.context.warn(
                f"the node's frame is {str(frame)[:60]!r}; its coordinates are read as local", where=location
            )
        return x, y, z

    def ends(
        self, index_by_number: Mapping[int, int], properties: list[dict[str, Any]]
    ) -> tuple[list[int], list[int], list[int], list[int]]:
        """Return (features of edges between nodes, their numbers, indexes of their ends); store others with a node."""
        indices, numbers, sources, targets = [], [], [], []
        for k in self.edges:
            n, start, end = self.read_id(k), self.read_id(k, "startid"), self.read_id(k, "endid")
            a, b = index_by_number.get(start), index_by_number.get(end)
            if a is None or b is None:
                missing = start if a is None else end
                self.context.warn(
                    f"the edge {n} begins or ends at the missing node {missing}, and Nav2 rejects such a graph; "
                    "it is stored, but not exported",
                    where=f"features[{k}]",
                )
                edge_properties = {
                    w: v for w, v in self.properties_of(k).items() if w not in ("id", "startid", "endid")
                }
                edge = {"id": n, "from": start, "to": end, "properties": edge_properties}
                home = next((j for j in (a, b) if j is not None), None)
                if home is None:
                    self.dangling.append(edge)
                else:
                    properties[home][NAME].setdefault("dangling", []).append(edge)
                continue
            if a == b:
                self.context.warn(f"the edge {n} leads from a node to itself", where=f"features[{k}]")
            indices.append(k)
            numbers.append(n)
            sources.append(a)
            targets.append(b)
        return indices, numbers, sources, targets

    def canonical(self, k: int, n: int) -> dict[str, Any]:
        """Return an item's properties from its feature."""
        row = self.rows[k]
        extra_members = {w: v for w, v in self.properties_of(k).items() if w not in ("id", "startid", "endid")}
        out: dict[str, Any] = {}
        metadata = extra_members.get("metadata")
        if isinstance(metadata, dict):
            self.is_complete["integers"] += _integers(metadata)
            out = {CANONICAL_METADATA[w]: v for w, v in metadata.items() if fits(w, v) and (w, v) != ("name", str(n))}
            left = {w: v for w, v in metadata.items() if CANONICAL_METADATA.get(w) not in out}
            extra_members["metadata"] = left
            if not left and metadata:
                del extra_members["metadata"]
        self.is_complete["integers"] += _integers(extra_members.get("operations"))
        for reason in loader_problems(extra_members):
            self.context.warn(reason, where=f"features[{k}].properties")
        source_properties: dict[str, Any] = {"id": n}
        if extra_members:
            source_properties["properties"] = extra_members
        members = {w: v for w, v in row.items() if w not in ("type", "properties", "geometry")}
        if members:
            source_properties["members"] = members
        return {**out, NAME: source_properties}

    def shape(self, k: int, straight: Any, source_properties: dict[str, Any]) -> Any:
        """Return an edge's line: as drawn if that is a valid line, else from node to node."""
        geometry = self.rows[k]["geometry"]
        parts = geometry.get("coordinates")
        if geometry["type"] == "LineString":
            source_properties["line"] = True
            parts = [parts]
        drawn = _line(parts[0]) if isinstance(parts, list) and len(parts) == 1 else None
        if len(geometry) > 2 or drawn is None:
            if len(geometry) > 2 or parts not in (None, []):
                source_properties["geometry"] = {w: v for w, v in geometry.items() if w != "type"}
            return straight
        return straight if drawn == _line(shapely.get_coordinates(straight).tolist()) else shapely.LineString(drawn)


def fits(key: str, value: Any) -> bool:
    """Whether a metadata key is canonical, with a value of its type."""
    if key in TEXTS:
        return isinstance(value, str) and value != ""
    return key in NUMBERS and isinstance(value, (int, float)) and not isinstance(value, bool)


def _line(coordinates: Any) -> list[tuple[float, ...]] | None:
    """Return at least two positions, 2-D if all heights are 0; None if it is not a line."""
    if not isinstance(coordinates, list) or len(coordinates) < 2:
        return None
    out: list[tuple[float, ...]] = []
    for at in coordinates:
        if not isinstance(at, list) or len(at) not in (2, 3):
            return None
        if not all(isinstance(v, (int, float)) and not isinstance(v, bool) for v in at):
            return None
        out.append(tuple(map(float, at)))
    deep = all(len(at) == 3 for at in out) and any(at[2] for at in out)
    return out if deep else [at[:2] for at in out]


def _is_integer(key: str, value: Any) -> bool:
    return key in FLOATS and isinstance(value, int) and not isinstance(value, bool)


def _integers(value: Any) -> int:
    """Count the integers among values that Nav2 reads as floats, at any depth."""
    if isinstance(value, list):
        return sum(map(_integers, value))
    if not isinstance(value, dict):
        return 0
    return sum(_is_integer(w, v) + _integers(v) for w, v in value.items())


def as_floats(value: Any) -> Any:
    """Convert these values to floats."""
    if isinstance(value, list):
        return [as_floats(v) for v in value]
    if not isinstance(value, dict):
        return value
    return {w: float(v) if _is_integer(w, v) else as_floats(v) for w, v in value.items()}


def loader_problems(properties: Mapping[str, Any]) -> Iterator[str]:
    """Check a feature's properties for values at which the route server's loader throws."""
    metadata, operations = properties.get("metadata"), properties.get("operations")
    if "metadata" in properties:
        yield from _metadata_problems(metadata, "metadata")
    if isinstance(operations, (dict, list)):
        for name, one in operations.items() if isinstance(operations, dict) else enumerate(operations):
            if not isinstance(one, dict) or not isinstance(one.get("type"), str) or one.get("trigger") not in TRIGGERS:
                yield f"the operation {str(name)[:60]!r} needs a type and a trigger, one of {', '.join(TRIGGERS)}"
            elif "metadata" in one:
                yield from _metadata_problems(one["metadata"], f"the metadata of the operation {str(name)[:60]!r}")
    elif "operations" in properties:
        yield "operations must be an object of operations"
    cost = properties.get("cost", 0.0)
    if isinstance(cost, bool) or not isinstance(cost, (int, float)):
        yield f"cost must be a number, got {str(cost)[:40]!r}"
    if not isinstance(properties.get("overridable", True), bool):
        yield f"overridable must be true or false, got {str(properties['overridable'])[:40]!r}"
    if not isinstance(properties.get("frame", ""), str):
        yield f"frame must be a string, got {str(properties['frame'])[:40]!r}"


def _metadata_problems(value: Any, location: str) -> Iterator[str]:
    if not isinstance(value, dict):
        yield f"{location} must be an object"
        return
    for key, inner in value.items():
        if isinstance(inner, dict):
            yield from _metadata_problems(inner, f"{location}.{key[:60]}")
        elif any(v is None or isinstance(v, (dict, list)) for v in (inner if isinstance(inner, list) else [inner])):
            yield f"{location}.{key[:60]}: Nav2 reads only numbers, strings, booleans and lists of these"

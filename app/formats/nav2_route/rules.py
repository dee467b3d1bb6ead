"""Consumer checks for Nav2's route server.

Sources: nav2_route, geojson_graph_file_loader.cpp (nlohmann::json: a missing or wrongly typed member throws),
types.hpp (Metadata::getValue<float> throws bad_any_cast at an integer), the scorers' parameters, nav2_msgs (uint16 ids
in DynamicEdges, ComputeRoute). The server notices an invalid graph after it cleared the old one: the robot has none.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any

import orjson

from app.errors import Problem
from app.formats import Files
from app.formats._rules import error_finding, is_number, names, shown, warning_finding

MAX_ID = 2**32 - 1
MAX_SHORT_ID = 2**16 - 1
FLOATS = frozenset({"speed_limit", "abs_speed_limit", "penalty", "abs_time_taken"})
TRIGGERS = ("NODE", "ON_ENTER", "ON_EXIT")
LINES = ("LineString", "MultiLineString")
ON_EARTH = ("CRS84", "4326")
MAX_EXACT_METRES = 16_384.0


def check(files: Files) -> Iterator[Problem]:
    """Check a graph by the route server's rules."""
    main = next(iter(files))
    top = orjson.loads(files[main])
    rows = top.get("features") if isinstance(top, dict) else None
    if not isinstance(rows, list):
        yield error_finding("there is no array of features", main, where="features")
        return
    if not isinstance(top.get("crs", {}), dict) or any(name in str(top.get("crs")) for name in ON_EARTH):
        reason = "names longitude and latitude, but the route server ignores that and reads the numbers as metres"
        yield warning_finding(reason, main, where="crs")
    nodes: list[int] = []
    edges: list[tuple[int, Any, Any]] = []
    far = 0
    for k, row in enumerate(rows):
        location = f"features[{k}]"
        geometry, properties = (row.get("geometry"), row.get("properties")) if isinstance(row, dict) else (None, None)
        if not isinstance(geometry, dict):
            yield error_finding("has no geometry", main, where=location)
            continue
        kind = geometry.get("type")
        if kind != "Point" and kind not in LINES:
            continue  # the route server skips it
        if not isinstance(properties, dict):
            yield error_finding("has no properties", main, where=location)
            continue
        if not _is_id(properties.get("id")):
            reason = f"must be an integer from 0 to {MAX_ID}, got {shown(properties.get('id'))}"
            yield error_finding(reason, main, where=f"{location}.properties.id")
            continue
        if kind == "Point":
            nodes.append(properties["id"])
            at = geometry.get("coordinates")
            if not isinstance(at, list) or len(at) < 2 or not all(map(is_number, at[:2])):
                yield error_finding("a node needs the coordinates [x, y]", main, where=location)
            else:
                far += max(abs(at[0]), abs(at[1])) > MAX_EXACT_METRES
        else:
            edges.append((properties["id"], properties.get("startid"), properties.get("endid")))
        yield from _types(properties, main, location, is_node=kind == "Point")
        if "metadata" in properties:
            yield from _metadata(properties["metadata"], main, f"{location}.properties.metadata")
        if "operations" in properties:
            yield from _operations(properties["operations"], main, f"{location}.properties.operations")
    yield from _graph(nodes, edges, main)
    if far:
        reason = (
            f"{far} nodes are more than {MAX_EXACT_METRES:g} m from the origin, where the server's 32-bit floats "
            "are 2 mm apart"
        )
        yield warning_finding(reason, main)


def _types(properties: Mapping[str, Any], main: str, location: str, *, is_node: bool) -> Iterator[Problem]:
    """Check the types of a node's or edge's members against the loader."""
    if is_node:
        if not isinstance(properties.get("frame", ""), str):
            reason = f"must be a string, got {shown(properties['frame'])}"
            yield error_finding(reason, main, where=f"{location}.properties.frame")
        return
    if not is_number(properties.get("cost", 0.0)):
        reason = f"must be a number, got {shown(properties['cost'])}"
        yield error_finding(reason, main, where=f"{location}.properties.cost")
    if not isinstance(properties.get("overridable", True), bool):
        reason = f"must be true or false, got {shown(properties['overridable'])}"
        yield error_finding(reason, main, where=f"{location}.properties.overridable")


def _is_id(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= MAX_ID


def _graph(nodes: list[int], edges: list[tuple[int, Any, Any]], main: str) -> Iterator[Problem]:
    if not nodes:
        yield error_finding("no node (a Point with an id)", main, where="features")
    if not edges:
        yield error_finding("no edge (a LineString with an id)", main, where="features")
    node_ids = set(nodes)
    dangling = [n for n, *ends in edges if not all(_is_id(end) and end in node_ids for end in ends)]
    if dangling:
        yield error_finding(f"{len(dangling)} edges begin or end at missing nodes: {names(dangling)}", main)
    for noun, ids in (("nodes", nodes), ("edges", [n for n, _, _ in edges])):
        if repeats := [n for n, count in Counter(ids).items() if count > 1]:
            yield warning_finding(
                f"{len(repeats)} ids belong to several {noun}; only one of these is used: {names(repeats)}", main
            )
        if large := [n for n in ids if n > MAX_SHORT_ID]:
            use = "ComputeRoute and ComputeAndTrackRoute" if noun == "nodes" else "DynamicEdges"
            reason = f"{len(large)} {noun} have an id above {MAX_SHORT_ID}, which {use} cannot transmit: {names(large)}"
            yield warning_finding(reason, main)


def _metadata(metadata: Any, main: str, location: str) -> Iterator[Problem]:
    if not isinstance(metadata, dict):
        yield error_finding(f"must be an object, got {shown(metadata)}", main, where=location)
        return
    for key, value in metadata.items():
        inside = f"{location}.{key[:60]}"
        if isinstance(value, dict):
            yield from _metadata(value, main, inside)
        elif any(v is None or isinstance(v, (dict, list)) for v in (value if isinstance(value, list) else [value])):
            yield error_finding(
                "must be a number, string, boolean or list of these: the loader reads nothing else", main, where=inside
            )
        elif key in FLOATS and isinstance(value, int):
            reason = f"Nav2 reads a float here and rejects the integer {shown(value)}: write it with a decimal point"
            yield error_finding(reason, main, where=inside)


def _operations(operations: Any, main: str, location: str) -> Iterator[Problem]:
    if not isinstance(operations, (dict, list)):
        yield error_finding("must be an object of operations", main, where=location)
        return
    for name, one in operations.items() if isinstance(operations, dict) else enumerate(operations):
        inside = f"{location}.{str(name)[:60]}"
        if not isinstance(one, dict) or not isinstance(one.get("type"), str):
            yield error_finding("an operation needs a type", main, where=inside)
        elif one.get("trigger") not in TRIGGERS:
            reason = f"trigger must be one of {', '.join(TRIGGERS)}, got {shown(one.get('trigger'))}"
            yield error_finding(reason, main, where=inside)
        elif "metadata" in one:
            yield from _metadata(one["metadata"], main, f"{inside}.metadata")

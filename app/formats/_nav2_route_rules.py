"""What Nav2's route server wants of a graph.

Sources: nav2_route, geojson_graph_file_loader.cpp (nlohmann::json: a missing or wrongly typed member throws),
types.hpp (Metadata::getValue<float> throws bad_any_cast at an integer), the scorers' parameters, nav2_msgs (uint16 ids
in DynamicEdges, ComputeRoute). A bad graph is noticed after the old one is cleared: the robot has none then.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

import orjson

from app.errors import Problem
from app.formats import Files
from app.formats._rules import doubted, is_number, names, refused, shown

MOST_ID = 2**32 - 1
MOST_SHORT_ID = 2**16 - 1
FLOATS = frozenset({"speed_limit", "abs_speed_limit", "penalty", "abs_time_taken"})
TRIGGERS = ("NODE", "ON_ENTER", "ON_EXIT")
LINES = ("LineString", "MultiLineString")
ON_EARTH = ("CRS84", "4326")
FAR = 16_384.0


def check(files: Files) -> Iterator[Problem]:
    """A graph as the route server loads it."""
    main = next(iter(files))
    top = orjson.loads(files[main])
    rows = top.get("features") if isinstance(top, dict) else None
    if not isinstance(rows, list):
        yield refused("there is no array of features", main, where="features")
        return
    if not isinstance(top.get("crs", {}), dict) or any(word in str(top.get("crs")) for word in ON_EARTH):
        reason = "says longitude and latitude; the route server ignores it and takes the numbers for metres"
        yield doubted(reason, main, where="crs")
    nodes: list[int] = []
    edges: list[tuple[int, Any, Any]] = []
    far = 0
    for k, row in enumerate(rows):
        where = f"features[{k}]"
        geometry, said = (row.get("geometry"), row.get("properties")) if isinstance(row, dict) else (None, None)
        if not isinstance(geometry, dict):
            yield refused("has no geometry", main, where=where)
            continue
        kind = geometry.get("type")
        if kind != "Point" and kind not in LINES:
            continue  # the route server passes over it
        if not isinstance(said, dict):
            yield refused("has no properties", main, where=where)
            continue
        if not _is_id(said.get("id")):
            reason = f"must be a whole number from 0 to {MOST_ID}, is {shown(said.get('id'))}"
            yield refused(reason, main, where=f"{where}.properties.id")
            continue
        if kind == "Point":
            nodes.append(said["id"])
            at = geometry.get("coordinates")
            if not isinstance(at, list) or len(at) < 2 or not all(map(is_number, at[:2])):
                yield refused("a node needs the coordinates [x, y]", main, where=where)
            else:
                far += max(abs(at[0]), abs(at[1])) > FAR
            if not isinstance(said.get("frame", ""), str):
                yield refused(f"must be a text, is {shown(said['frame'])}", main, where=f"{where}.properties.frame")
        else:
            edges.append((said["id"], said.get("startid"), said.get("endid")))
            if not is_number(said.get("cost", 0.0)):
                yield refused(f"must be a number, is {shown(said['cost'])}", main, where=f"{where}.properties.cost")
            if not isinstance(said.get("overridable", True), bool):
                reason = f"must be true or false, is {shown(said['overridable'])}"
                yield refused(reason, main, where=f"{where}.properties.overridable")
        if "metadata" in said:
            yield from _metadata(said["metadata"], main, f"{where}.properties.metadata")
        if "operations" in said:
            yield from _operations(said["operations"], main, f"{where}.properties.operations")
    yield from _graph(nodes, edges, main)
    if far:
        reason = f"{far} nodes lie more than {FAR:g} m from the origin; the server's 32 bit floats step by 2 mm there"
        yield doubted(reason, main)


def _is_id(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value <= MOST_ID


def _graph(nodes: list[int], edges: list[tuple[int, Any, Any]], main: str) -> Iterator[Problem]:
    if not nodes:
        yield refused("there is no node (a Point with an id)", main, where="features")
    if not edges:
        yield refused("there is no edge (a LineString with an id)", main, where="features")
    known = set(nodes)
    lost = [n for n, *ends in edges if not all(_is_id(end) and end in known for end in ends)]
    if lost:
        yield refused(f"{len(lost)} edges begin or end at a node that is not there: {names(lost)}", main)
    for what, ids in (("nodes", nodes), ("edges", [n for n, _, _ in edges])):
        if again := [n for n, count in Counter(ids).items() if count > 1]:
            yield doubted(f"{len(again)} ids are given to several {what}; one of them wins: {names(again)}", main)
        if large := [n for n in ids if n > MOST_SHORT_ID]:
            use = "ComputeRoute and ComputeAndTrackRoute" if what == "nodes" else "DynamicEdges"
            reason = f"{len(large)} {what} have an id above {MOST_SHORT_ID}, which {use} cannot name: {names(large)}"
            yield doubted(reason, main)


def _metadata(said: Any, main: str, where: str) -> Iterator[Problem]:
    if not isinstance(said, dict):
        yield refused(f"must be an object, is {shown(said)}", main, where=where)
        return
    for word, value in said.items():
        inside = f"{where}.{word[:60]}"
        if isinstance(value, dict):
            yield from _metadata(value, main, inside)
        elif any(v is None or isinstance(v, (dict, list)) for v in (value if isinstance(value, list) else [value])):
            yield refused("the loader takes numbers, texts, truth values and lists of these only", main, where=inside)
        elif word in FLOATS and isinstance(value, int):
            reason = f"is read as a float, at which the integer {shown(value)} throws: write it with a point"
            yield refused(reason, main, where=inside)


def _operations(said: Any, main: str, where: str) -> Iterator[Problem]:
    if not isinstance(said, (dict, list)):
        yield refused("must be an object of operations", main, where=where)
        return
    for name, one in said.items() if isinstance(said, dict) else enumerate(said):
        inside = f"{where}.{str(name)[:60]}"
        if not isinstance(one, dict) or not isinstance(one.get("type"), str):
            yield refused("an operation needs a type", main, where=inside)
        elif one.get("trigger") not in TRIGGERS:
            reason = f"its trigger must be one of {', '.join(TRIGGERS)}, is {shown(one.get('trigger'))}"
            yield refused(reason, main, where=inside)
        elif "metadata" in one:
            yield from _metadata(one["metadata"], main, f"{inside}.metadata")

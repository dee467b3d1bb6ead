"""What Open-RMF's fleet adapters want of a navigation graph.

Source: open-rmf/rmf_ros2, rmf_fleet_adapter, agv/parse_graph.cpp (yaml-cpp: what is missing or of another type throws;
a waypoint name that is taken throws).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from app.errors import Problem
from app.formats import Files, _yaml
from app.formats._rules import (
    LARGEST,
    LIMITS,
    brief,
    doubted,
    is_number,
    missing,
    names,
    numbers,
    refused,
    repeated,
    shown,
)

CONSTRAINTS = ("forward", "backward")


def check(files: Files) -> Iterator[Problem]:
    """Each graph as a fleet adapter loads it."""
    for name, data in files.items():
        if not name.lower().endswith((".yaml", ".yml")):
            continue
        if brief(data):
            continue
        if len(data) > LARGEST:
            yield doubted(f"not checked: it is larger than {LARGEST} bytes", name)
            continue
        yield from _graph(_yaml.load(data, LIMITS), name)


def _graph(top: Any, main: str) -> Iterator[Problem]:
    levels = top.get("levels") if isinstance(top, dict) else None
    if not isinstance(levels, dict):
        yield refused("a graph needs a mapping of levels", main, where="levels")
        return
    if top.get("building_name") is None:
        yield doubted("a graph says its building", main, where="building_name")
    called: list[str] = []
    lifts = top.get("lifts")
    for level, said in levels.items():
        vertices = said.get("vertices") if isinstance(said, dict) else None
        lanes = said.get("lanes") if isinstance(said, dict) else None
        if not isinstance(vertices, list) or not isinstance(lanes, list):
            yield refused("a level needs a list of vertices and one of lanes", main, where=f"levels.{level}")
            continue
        for k, row in enumerate(vertices):
            where = f"levels.{level}.vertices[{k}]"
            if not isinstance(row, list) or len(row) < 3 or not numbers(row[:2], 2) or not isinstance(row[2], dict):
                yield refused("must be [x, y, {…}]", main, where=where)
                continue
            if isinstance(row[2].get("name"), str) and row[2]["name"]:
                called.append(row[2]["name"])
            lift = row[2].get("lift")
            if lift and isinstance(lifts, dict) and lift not in lifts:
                yield doubted(f"the graph tells of no lift {shown(lift)}", main, where=where)
        for k, row in enumerate(lanes):
            yield from _lane(row, len(vertices), main, f"levels.{level}.lanes[{k}]")
    if again := repeated(called):
        yield refused(f"{len(again)} names are given to several waypoints: {names(again)}", main, where="levels")
    yield from _things(top, main)


def _lane(row: Any, count: int, main: str, where: str) -> Iterator[Problem]:
    ends = row[:2] if isinstance(row, list) else []
    if len(ends) < 2 or not all(isinstance(i, int) and not isinstance(i, bool) and 0 <= i < count for i in ends):
        yield refused(f"must be [i, j, {{…}}] with vertices below {count}", main, where=where)
        return
    said = row[2] if len(row) > 2 else None
    if not isinstance(said, dict):
        yield refused("a lane has a mapping of its options, {} where there are none", main, where=where)
        return
    if said.get("orientation_constraint", CONSTRAINTS[0]) not in CONSTRAINTS:
        reason = f"must be forward or backward, is {shown(said['orientation_constraint'])}"
        yield refused(reason, main, where=f"{where}.orientation_constraint")
    if not is_number(said.get("speed_limit", 0.0)):
        yield refused(f"must be a number, is {shown(said['speed_limit'])}", main, where=f"{where}.speed_limit")


def _things(top: dict[str, Any], main: str) -> Iterator[Problem]:
    for word, keys in (("doors", ("endpoints", "map")), ("lifts", ("position", "dims"))):
        said = top.get(word)
        if said is not None and not isinstance(said, dict):
            yield refused(f"must be a mapping, is {shown(said)}", main, where=word)
            continue
        for name, one in (said or {}).items():
            if lost := missing(one, keys):
                yield refused(f"needs {' and '.join(lost)}", main, where=f"{word}.{name}")
            elif word == "lifts" and not (numbers(one["position"], 3, 3) and numbers(one["dims"], 2, 2)):
                yield refused("needs position [x, y, yaw] and dims [width, depth]", main, where=f"{word}.{name}")

"""Rules of Open-RMF's fleet adapters for navigation graphs.

Source: open-rmf/rmf_ros2, rmf_fleet_adapter, agv/parse_graph.cpp (yaml-cpp throws if a member is missing or has another
type, if a waypoint name is a duplicate, and if a graph with the key ``lifts`` lacks the lift of a vertex).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from app.errors import Problem
from app.formats import Files
from app.formats._rules import (
    LIMITS,
    MAX_WHOLE_YAML_BYTES,
    duplicates,
    error_finding,
    is_brief,
    is_number,
    missing,
    names,
    numbers,
    shown,
    warning_finding,
)
from app.syntax import yaml

CONSTRAINTS = ("forward", "backward")


def check(files: Files) -> Iterator[Problem]:
    """Check each graph with the rules of a fleet adapter."""
    for name, data in files.items():
        if not name.lower().endswith((".yaml", ".yml")):
            continue
        if is_brief(data):
            continue
        if len(data) > MAX_WHOLE_YAML_BYTES:
            yield warning_finding(f"not checked: it is larger than {MAX_WHOLE_YAML_BYTES} bytes", name)
            continue
        yield from _graph(yaml.load(data, LIMITS), name)


def _graph(top: Any, main: str) -> Iterator[Problem]:
    levels = top.get("levels") if isinstance(top, dict) else None
    if not isinstance(levels, dict):
        yield error_finding("a graph needs a mapping of levels", main, where="levels")
        return
    if top.get("building_name") is None:
        yield warning_finding("a graph should name its building", main, where="building_name")
    called: list[str] = []
    has_lifts = "lifts" in top  # even if empty
    lifts = top["lifts"] if isinstance(top.get("lifts"), dict) else {}
    for level, members in levels.items():
        vertices = members.get("vertices") if isinstance(members, dict) else None
        lanes = members.get("lanes") if isinstance(members, dict) else None
        if not isinstance(vertices, list) or not isinstance(lanes, list):
            yield error_finding("a level needs a list of vertices and one of lanes", main, where=f"levels.{level}")
            continue
        for k, row in enumerate(vertices):
            location = f"levels.{level}.vertices[{k}]"
            if not isinstance(row, list) or len(row) < 3 or not numbers(row[:2], 2) or not isinstance(row[2], dict):
                yield error_finding("must be [x, y, {…}]", main, where=location)
                continue
            if isinstance(row[2].get("name"), str) and row[2]["name"]:
                called.append(row[2]["name"])
            lift = row[2].get("lift")
            if lift and has_lifts and lift not in lifts:
                yield error_finding(f"unknown lift {shown(lift)}", main, where=location)
        for k, row in enumerate(lanes):
            yield from _lane(row, len(vertices), main, f"levels.{level}.lanes[{k}]")
    if repeats := duplicates(called):
        yield error_finding(f"{len(repeats)} duplicate waypoint names: {names(repeats)}", main, where="levels")
    yield from _things(top, main)


def _lane(row: Any, count: int, main: str, location: str) -> Iterator[Problem]:
    ends = row[:2] if isinstance(row, list) else []
    if len(ends) < 2 or not all(isinstance(i, int) and not isinstance(i, bool) and 0 <= i < count for i in ends):
        yield error_finding(f"must be [i, j, {{…}}] with vertices below {count}", main, where=location)
        return
    options = row[2] if len(row) > 2 else None
    if not isinstance(options, dict):
        yield error_finding("a lane needs a mapping of options: write {} if there are none", main, where=location)
        return
    if options.get("orientation_constraint", CONSTRAINTS[0]) not in CONSTRAINTS:
        reason = f"must be forward or backward, got {shown(options['orientation_constraint'])}"
        yield error_finding(reason, main, where=f"{location}.orientation_constraint")
    if not is_number(options.get("speed_limit", 0.0)):
        yield error_finding(
            f"must be a number, got {shown(options['speed_limit'])}", main, where=f"{location}.speed_limit"
        )


def _things(top: dict[str, Any], main: str) -> Iterator[Problem]:
    for section, keys in (("doors", ("endpoints", "map")), ("lifts", ("position", "dims"))):
        items = top.get(section)
        if items is not None and not isinstance(items, dict):
            yield error_finding(f"must be a mapping, got {shown(items)}", main, where=section)
            continue
        for name, one in (items or {}).items():
            if absent := missing(one, keys):
                yield error_finding(f"needs {' and '.join(absent)}", main, where=f"{section}.{name}")
            elif section == "lifts" and not (numbers(one["position"], 3, 3) and numbers(one["dims"], 2, 2)):
                yield error_finding(
                    "needs position [x, y, yaw] and dims [width, depth]", main, where=f"{section}.{name}"
                )

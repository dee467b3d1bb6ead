"""Rules of Open-RMF's building_map_generator and traffic editor for building.yaml.

Source: open-rmf/rmf_traffic_editor, rmf_building_map_tools/building_map (building.py, level.py, edge.py, vertex.py,
param_value.py, lift.py, transform.py); the traffic editor (C++) converts parameters to their declared type.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Iterator, Mapping
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
    mappings,
    missing,
    names,
    numbers,
    shown,
    warning_finding,
)
from app.syntax import yaml

SYSTEMS = ("reference_image", "web_mercator", "cartesian_meters", "wgs84")
KINDS: Mapping[int, type | tuple[type, ...]] = {1: (str, int, float), 2: int, 3: (int, float), 4: bool}
EDGES = ("lanes", "walls", "doors", "measurements", "human_lanes")
DOORS = ("sliding", "hinged", "double_sliding", "double_hinged")
DOOR = ("door_type", "x", "y", "motion_axis_orientation", "width")
LIFT = ("depth", "width", "yaw", "x", "y")
GRAPHS = 9
EASTING_FIRST = re.compile(r"\s*EPSG:\s*(32[67]\d\d|258\d\d|27700|2154|3857)\s*", re.IGNORECASE)
"""CRSs with easting first in PROJ: UTM on WGS 84 and ETRS 89, and other common ones."""


def check(files: Files) -> Iterator[Problem]:
    """Check a building with the rules of its generator and its editor."""
    main = next(iter(files))
    if is_brief(files[main]):
        return
    if len(files[main]) > MAX_WHOLE_YAML_BYTES:
        yield warning_finding(f"not checked: it is larger than {MAX_WHOLE_YAML_BYTES} bytes", main)
        return
    top = yaml.load(files[main], LIMITS)
    if not isinstance(top, dict):
        yield error_finding("a building must be a mapping", main)
        return
    if top.get("name") is None and top.get("building_name") is None:
        yield error_finding("a building needs a name", main, where="name")
    system = top.get("coordinate_system", SYSTEMS[0])
    if system not in SYSTEMS:
        yield error_finding(
            f"must be one of {', '.join(SYSTEMS)}, got {shown(system)}", main, where="coordinate_system"
        )
    yield from _parameters(top.get("parameters"), main, "parameters")
    levels = top.get("levels")
    if not isinstance(levels, dict) or not levels:
        yield error_finding("a building needs at least one level", main, where="levels")
        return
    reference = top.get("reference_level_name", next(iter(levels)))
    if reference not in levels:
        yield error_finding(f"unknown level {shown(reference)}", main, where="reference_level_name")
    for name, level in levels.items():
        if isinstance(level, dict):
            yield from _level(level, main, f"levels.{name}", files, measured=system == SYSTEMS[0] and name == reference)
        else:
            yield error_finding("must be a mapping", main, where=f"levels.{name}")
    if system == SYSTEMS[0] and isinstance(levels.get(reference), dict):
        yield from _check_alignment(levels, reference, main)
    yield from _check_coordinates(top, str(system), levels, main)
    lifts = top.get("lifts")
    for name, lift in lifts.items() if isinstance(lifts, dict) else ():
        yield from _lift(lift, levels, main, f"lifts.{name}")


def _parameters(parameters: Any, main: str, location: str) -> Iterator[Problem]:
    """Check typed parameters: [type, value]."""
    if not parameters:
        return
    if not isinstance(parameters, dict):
        yield error_finding(f"must be a mapping, got {shown(parameters)}", main, where=location)
        return
    for key, value in parameters.items():
        item_location = f"{location}.{key}"
        if not isinstance(value, list) or len(value) != 2 or value[0] not in KINDS or isinstance(value[0], bool):
            reason = f"must be [type, value] (1 text, 2 integer, 3 decimal, 4 boolean), got {shown(value)}"
            yield error_finding(reason, main, where=item_location)
        elif not isinstance(value[1], KINDS[value[0]]) or (value[0] in (2, 3) and isinstance(value[1], bool)):
            yield error_finding(
                f"the value {shown(value[1])} does not match its type {value[0]}", main, where=item_location
            )


def _level(level: dict[str, Any], main: str, location: str, files: Files, *, measured: bool) -> Iterator[Problem]:
    drawing = level.get("drawing")
    if drawing is not None:
        image = drawing.get("filename") if isinstance(drawing, dict) else None
        if not isinstance(image, str):
            yield error_finding("a drawing needs a filename", main, where=f"{location}.drawing")
        elif image and posixpath.normpath(posixpath.join(posixpath.dirname(main), image)) not in files:
            yield warning_finding(f"drawing file {shown(image)} not found", main, where=f"{location}.drawing.filename")
    if "elevation" in level and not is_number(level["elevation"]):
        yield error_finding(f"must be a number, got {shown(level['elevation'])}", main, where=f"{location}.elevation")
    vertices = level.get("vertices") or []
    if not isinstance(vertices, list):
        yield error_finding("must be a list", main, where=f"{location}.vertices")
        return
    for k, row in enumerate(vertices):
        if not isinstance(row, list) or len(row) < 4 or not numbers(row[:3], 3):
            yield error_finding("a vertex must be [x, y, z, name, {…}]", main, where=f"{location}.vertices[{k}]")
        elif len(row) > 4:
            yield from _parameters(row[4], main, f"{location}.vertices[{k}]")
    called = [
        row[3] for row in vertices if isinstance(row, list) and len(row) > 3 and isinstance(row[3], str) and row[3]
    ]
    if repeats := duplicates(called):
        reason = f"{len(repeats)} duplicate vertex names: {names(repeats)}; fleet adapters reject them"
        yield warning_finding(reason, main, where=f"{location}.vertices")
    for section in EDGES:
        yield from _edges(level.get(section), section, vertices, main, f"{location}.{section}")
    if measured and not level.get("measurements"):
        reason = "the reference level has no measurement; one pixel is one metre"
        yield warning_finding(reason, main, where=f"{location}.measurements")
    for section in ("floors", "holes"):
        for k, area in mappings(level.get(section)):
            ring = area.get("vertices")
            if not isinstance(ring, list) or len(ring) < 3 or not all(_is_index(i, vertices) for i in ring):
                yield error_finding("needs at least three existing vertices", main, where=f"{location}.{section}[{k}]")
    for k, row in enumerate(level.get("fiducials") or ()):
        if not isinstance(row, list) or len(row) < 3 or not numbers(row[:2], 2):
            yield error_finding("a fiducial must be [x, y, name]", main, where=f"{location}.fiducials[{k}]")


def _is_index(value: Any, vertices: list[Any]) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < len(vertices)


def _edges(rows: Any, section: str, vertices: list[Any], main: str, location: str) -> Iterator[Problem]:
    if not rows:
        return
    if not isinstance(rows, list):
        yield error_finding("must be a list", main, where=location)
        return
    for k, row in enumerate(rows):
        item_location = f"{location}[{k}]"
        if not isinstance(row, list) or len(row) < 2 or not all(_is_index(i, vertices) for i in row[:2]):
            yield error_finding(f"must be [i, j, {{…}}] with vertices below {len(vertices)}", main, where=item_location)
            continue
        parameters = row[2] if len(row) > 2 and isinstance(row[2], dict) else {}
        yield from _parameters(row[2] if len(row) > 2 else None, main, item_location)
        value = {key: v[1] for key, v in parameters.items() if isinstance(v, list) and len(v) == 2}
        if section == "measurements":
            if not is_number(value.get("distance")):
                yield error_finding("a measurement needs a distance", main, where=item_location)
            a, b = vertices[row[0]], vertices[row[1]]
            if isinstance(a, list) and isinstance(b, list) and a[:2] == b[:2]:
                yield error_finding(
                    "a measurement has length 0: the scale is computed by dividing by it", main, where=item_location
                )
        elif section == "doors":
            if absent := [key for key in ("name", "type") if value.get(key) is None]:
                yield error_finding(f"a door needs {' and '.join(absent)}", main, where=item_location)
            elif value["type"] not in DOORS:
                yield warning_finding(f"unsupported door type {shown(value['type'])}", main, where=item_location)
        elif section == "lanes" and value.get("graph_idx", 0) not in range(GRAPHS):
            reason = f"only graphs 0 to {GRAPHS - 1} are generated, not graph {shown(value['graph_idx'])}"
            yield warning_finding(reason, main, where=item_location)


def _check_alignment(levels: Mapping[str, Any], reference: str, main: str) -> Iterator[Problem]:
    """Check that each level with a drawing shares two fiducials with the reference level."""

    def marks(level: Any) -> set[str]:
        rows = level.get("fiducials") if isinstance(level, dict) else None
        return {str(row[2]) for row in rows or () if isinstance(row, list) and len(row) > 2}

    for name, level in levels.items():
        common = marks(level) & marks(levels[reference])
        if name != reference and len(common) < 2:
            reason = f"it shares {len(common)} fiducials with {reference}; two are needed to align its drawing"
            yield warning_finding(reason, main, where=f"levels.{name}.fiducials")


def _check_coordinates(top: Mapping[str, Any], system: str, levels: Mapping[str, Any], main: str) -> Iterator[Problem]:
    parameters = top.get("parameters") if isinstance(top.get("parameters"), dict) else {}
    assert isinstance(parameters, dict)
    value = {key: v[1] for key, v in parameters.items() if isinstance(v, list) and len(v) == 2}
    crs = value.get("generate_crs")
    if system in ("web_mercator", "wgs84") and not crs:
        yield error_finding(f"{system} needs the parameter generate_crs", main, where="parameters.generate_crs")
    if system == "wgs84":
        for key in ("suggested_offset_x", "suggested_offset_y"):
            if value.get(key) is None:
                yield error_finding(f"wgs84 needs the parameter {key}", main, where=f"parameters.{key}")
        if isinstance(crs, str) and EASTING_FIRST.fullmatch(crs):
            reason = f"{crs} has easting first but the generator expects northing first; x and y are swapped"
            yield warning_finding(reason, main, where="parameters.generate_crs")
    if system == "web_mercator":
        origin = value.get("generate_origin_vertex", "origin")
        rows = [row for lv in levels.values() if isinstance(lv, dict) for row in lv.get("vertices") or ()]
        if not any(isinstance(row, list) and len(row) > 3 and row[3] == origin for row in rows):
            reason = f"no vertex is named {shown(origin)}; the map's origin stays at 0° N 0° E"
            yield warning_finding(reason, main, where="parameters.generate_origin_vertex")


def _lift(lift: Any, levels: Mapping[str, Any], main: str, location: str) -> Iterator[Problem]:
    if not isinstance(lift, dict):
        yield error_finding("must be a mapping", main, where=location)
        return
    if absent := [key for key in LIFT if not is_number(lift.get(key))]:
        yield error_finding(f"a lift needs the numbers {', '.join(absent)}", main, where=location)
    for key in ("reference_floor_name", "highest_floor", "lowest_floor"):
        floor = lift.get(key)
        if (floor or (key == "reference_floor_name" and floor is not None)) and floor not in levels:
            yield error_finding(f"unknown level {shown(floor)}", main, where=f"{location}.{key}")
    doors = lift.get("doors")
    for name, door in doors.items() if isinstance(doors, dict) else ():
        if absent := missing(door, DOOR):
            yield error_finding(f"a lift door needs {', '.join(absent)}", main, where=f"{location}.doors.{name}")
    stops = lift.get("level_doors")
    for floor, listed in stops.items() if isinstance(stops, dict) else ():
        if floor not in levels:
            yield error_finding(f"unknown level {shown(floor)}", main, where=f"{location}.level_doors")
        absent = [d for d in listed if d not in (doors or {})] if isinstance(listed, list) else []
        if absent:
            yield warning_finding(
                f"the lift has no door {names(absent)}", main, where=f"{location}.level_doors.{floor}"
            )

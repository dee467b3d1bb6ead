"""Closures as requests to running planners, derived from the map files that these planners have loaded."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import shapely
import shapely.geometry
import yaml

from app.errors import MissingDatum
from app.fleet import vda5050
from app.model.closures import Closure, Closures
from app.model.geodesy import local_frame
from app.store.values import Version


def with_closures(version: Version, closures: Closures | None) -> Version:
    """Return the version with these closures applied to its maps."""
    return replace(version, closures=closures)


def closed_edges(files: Mapping[str, bytes]) -> list[int]:
    """Return the ids of edges that a Nav2 route graph marks as blocked, ascending."""
    graph = json.loads(next(iter(files.values())))
    edges = (feature["properties"] for feature in graph["features"])
    return sorted(e["id"] for e in edges if "startid" in e and (e.get("metadata") or {}).get("blocked") is True)


def closed_lanes(files: Mapping[str, bytes]) -> dict[str, list[int]]:
    """Return the indices of lanes that navigation graphs mark as blocked, ascending, by file.

    Counted as in rmf_fleet_adapter's parse_graph.cpp: the lanes of all levels in file order; a lane with a dock_name
    behind a door or lift takes two indices, the first for the path to an additional waypoint.
    """
    out = {}
    for name, data in files.items():
        closed: list[int] = []
        index = 0
        for level in yaml.load(data, yaml.CSafeLoader)["levels"].values():
            in_lift = [bool((vertex[2:3] or [{}])[0].get("lift")) for vertex in level.get("vertices") or ()]
            for lane in level.get("lanes") or ():
                parameters = lane[2] if len(lane) > 2 else {}
                count = 2 if parameters.get("dock_name") and _has_entry_event(lane, parameters, in_lift) else 1
                if parameters.get("blocked") is True:
                    closed += range(index, index + count)
                index += count
        out[name] = closed
    return out


def _has_entry_event(lane: Sequence[Any], parameters: Mapping[str, Any], in_lift: Sequence[bool]) -> bool:
    """Whether a lane has an entry event: a lift session or a door."""
    begin, end = in_lift[lane[0]], in_lift[lane[1]]
    if begin or end:
        return begin is not end
    return bool("demo_mock_floor_name" in parameters or "door_name" in parameters)


def zone_sets(version: Version, closures: Closures, map_id: str) -> list[dict[str, Any]]:
    """Return VDA 5050 3.0 zone sets, one for each level with closed areas.

    Coordinates are local metres; vertices are counter-clockwise. The map id of the default level is ``map_id``, that of
    other levels ``map_id/LEVEL``. Raises MissingDatum if an area in degrees cannot be converted.
    """
    out = []
    for level in sorted({c.level for c in closures.items if c.polygon is not None}):
        zones: list[dict[str, Any]] = []
        for closure in closures.items:
            if closure.polygon is None or closure.level != level:
                continue
            rings = _outlines(closure, version)
            for n, ring in enumerate(rings):
                zone_id = closure.id if len(rings) == 1 else f"{closure.id}/{n}"
                zones.append({"zoneId": zone_id, "zoneType": "BLOCKED", "vertices": ring})
        digest = hashlib.sha256(json.dumps(zones, sort_keys=True).encode()).hexdigest()[:16]
        map_of = vda5050.level_map_id(map_id, None if level == vda5050.default_level(version) else level)
        out.append({"zoneSet": {"zoneSetId": f"{map_of}-{digest}", "mapId": map_of, "zones": zones}})
    return out


def _outlines(closure: Closure, version: Version) -> list[list[dict[str, float]]]:
    """Return the outer rings of a closed area, counter-clockwise, without the repeated last point. Fills holes."""
    shape = shapely.geometry.shape(closure.polygon)
    if closure.crs == "wgs84":
        if version.datum is None:
            raise MissingDatum(f"{version.environment} has no datum, which closed areas in degrees require")
        shape = local_frame(version.datum).geometries_to_local(shapely.get_parts([shape]))
    parts = shapely.get_parts(shape)
    rings = []
    for polygon in parts:
        ring = shapely.geometry.polygon.orient(polygon, 1.0).exterior.coords[:-1]
        rings.append([{"x": round(x, 3), "y": round(y, 3)} for x, y, *_ in ring])
    return rings

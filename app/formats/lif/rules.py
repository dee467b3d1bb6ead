"""Rules of the Layout Interchange Format's specification.

Source: VDMA LIF 1.0.0, section 8 (members and their types, ids unique within the file, angles in radians from -π to π);
the drafts of 2.0 call vehicle types mobile robot types and put layouts into origins. ``stations`` may be absent: so say
0.11 and 2.0, and so do the examples of 1.0.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import orjson

from app.errors import Problem
from app.formats import Files
from app.formats._rules import duplicates, error_finding, is_number, mappings, missing, names, shown, warning_finding

META = ("projectIdentification", "creator", "exportTimestamp", "lifVersion")
ORIENTATIONS = ("GLOBAL", "TANGENTIAL")


def check(files: Files) -> Iterator[Problem]:
    """Check a file with the rules of the specification."""
    main = next(iter(files))
    top = orjson.loads(files[main])
    if not isinstance(top, dict):
        yield error_finding("a LIF file must be one JSON object", main)
        return
    meta = top.get("metaInformation")
    draft = isinstance(meta, dict) and str(meta.get("lifVersion", "")).startswith("2")
    if absent := missing(meta, META[1:] if draft else META):
        yield error_finding(f"the specification requires {', '.join(absent)}", main, where="metaInformation")
    layouts = top.get("layouts")
    path = "layouts"
    if layouts is None and isinstance(top.get("origins"), list):
        layouts = [lay for _, o in mappings(top["origins"]) for _, lay in mappings(o.get("layouts"))]
        path = "origins[].layouts"
    if not isinstance(layouts, list):
        yield error_finding("the specification requires an array of layouts", main, where="layouts")
        return
    ids: dict[str, list[str]] = {"nodeId": [], "edgeId": [], "stationId": [], "layoutId": []}
    ends: list[tuple[str, list[Any]]] = []
    for k, layout in mappings(layouts):
        location = f"{path}[{k}]"
        for key in missing(layout, ("layoutId", "nodes")):
            yield error_finding("the specification requires it", main, where=f"{location}.{key}")
        for key in missing(layout, ("layoutVersion", "edges")):
            yield warning_finding("the specification requires it", main, where=f"{location}.{key}")
        ids["layoutId"].append(str(layout.get("layoutId")))
        yield from _items(layout, ids, ends, main, location)
    for key, values in ids.items():
        if repeats := duplicates(values):
            yield error_finding(f"{len(repeats)} ids are not unique within the file: {names(repeats)}", main, where=key)
    node_ids = set(ids["nodeId"])
    if absent := [item for item, refs in ends if not all(isinstance(r, str) and r in node_ids for r in refs)]:
        reason = f"{len(absent)} edges or stations refer to unknown nodes: {names(absent)}"
        yield error_finding(reason, main, where=path)


def _items(
    layout: dict[str, Any], ids: dict[str, list[str]], ends: list[tuple[str, list[Any]]], main: str, location: str
) -> Iterator[Problem]:
    for k, node in mappings(layout.get("nodes")):
        item_location = f"{location}.nodes[{k}]"
        at = node.get("nodePosition")
        if not isinstance(node.get("nodeId"), str):
            yield error_finding("a node needs a nodeId", main, where=item_location)
        if not isinstance(at, dict) or not (is_number(at.get("x")) and is_number(at.get("y"))):
            yield error_finding("a node needs a nodePosition with x and y", main, where=item_location)
        ids["nodeId"].append(str(node.get("nodeId")))
        yield from _vehicles(node, "NodeProperties", main, item_location)
    for k, edge in mappings(layout.get("edges")):
        item_location = f"{location}.edges[{k}]"
        if absent := missing(edge, ("edgeId", "startNodeId", "endNodeId")):
            yield error_finding(f"an edge needs {', '.join(absent)}", main, where=item_location)
        ids["edgeId"].append(str(edge.get("edgeId")))
        ends.append((str(edge.get("edgeId")), [edge.get("startNodeId"), edge.get("endNodeId")]))
        yield from _vehicles(edge, "EdgeProperties", main, item_location)
    for k, station in mappings(layout.get("stations")):
        item_location = f"{location}.stations[{k}]"
        refs = station.get("interactionNodeIds")
        if not isinstance(station.get("stationId"), str) or not isinstance(refs, list):
            yield error_finding("a station needs a stationId and interactionNodeIds", main, where=item_location)
            continue
        ids["stationId"].append(station["stationId"])
        ends.append((station["stationId"], refs))


def _vehicles(item: dict[str, Any], end: str, main: str, location: str) -> Iterator[Problem]:
    key, noun = next(
        ((f"{w}{end}", w) for w in ("vehicleType", "mobileRobotType") if f"{w}{end}" in item), (f"vehicleType{end}", "")
    )
    entries = item.get(key)
    if not isinstance(entries, list) or not entries:
        yield error_finding("needs at least one vehicle type", main, where=f"{location}.{key}")
        return
    for k, one in enumerate(entries):
        item_location = f"{location}.{key}[{k}]"
        if len(missing(one, (f"{noun}Id", f"{noun}s"))) > 1:
            yield error_finding(f"needs a {noun}Id", main, where=item_location)
            continue
        theta = one.get("theta")
        if theta is not None and not is_number(theta):
            yield error_finding(f"must be a number, got {shown(theta)}", main, where=f"{item_location}.theta")
        elif theta is not None and abs(theta) > math.pi + 1e-6:
            yield warning_finding(
                f"must be an angle in radians from -π to π, got {theta:g}", main, where=f"{item_location}.theta"
            )
        if one.get("orientationType") not in (None, *ORIENTATIONS):
            reason = f"must be one of {', '.join(ORIENTATIONS)}, got {shown(one['orientationType'])}"
            yield error_finding(reason, main, where=f"{item_location}.orientationType")

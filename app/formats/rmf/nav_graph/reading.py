"""Reading navigation graphs: the graphs of one directory as one network per level."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import orjson
import shapely

from app.formats import Files, ReadContext, _fields
from app.formats.rmf import common
from app.formats.rmf.common import CABIN_HEIGHT, index, listing, mapping, number, raise_unreadable
from app.formats.rmf.nav_graph.vocabulary import NAME, SHAPE
from app.model.features import (
    Features,
    Properties,
    SharedKeyDicts,
    features,
    from_columns,
    points,
    segments,
    unique_ids,
)
from app.model.frame import GROUND
from app.model.layers import NETWORK, Layers, Part, PartKey
from app.syntax import yaml

MAX_CACHED_PARAMETERS = 4096
"""Maximum number of distinct lane parameters that are shared in memory."""


@dataclass(slots=True)
class _Level:
    """Level merged from all graphs."""

    nodes: dict[str, int] = field(default_factory=dict)
    at: list[tuple[float, float]] = field(default_factory=list)
    nodes_say: list[dict[str, Any]] = field(default_factory=list)
    edges: list[tuple[int, int, dict[str, Any]]] = field(default_factory=list)
    objects: list[tuple[str, Any, Properties]] = field(default_factory=list)
    rest: dict[str, Any] = field(default_factory=dict)
    dangling: dict[str, list[Any]] = field(default_factory=dict)


def read(files: Files, context: ReadContext) -> Layers:
    """Read all graphs as topology and objects by level, in local metres.

    Raises UnreadableFile with the location.
    """
    main = context.main
    graphs, names = _graphs(files, context)
    levels: dict[str, _Level] = {}
    tops: dict[str, Any] = {}
    doors: dict[str, tuple[Any, list[int], int]] = {}
    lifts: dict[str, tuple[Any, list[int], int]] = {}
    for graph in graphs:
        context.main = names[graph]
        _fields.check(graphs[graph], SHAPE, context)
        top, graphs[graph] = graphs[graph], {}  # free the parsed graph before features are built
        tops[str(graph)] = {key: value for key, value in top.items() if key not in ("levels", "doors", "lifts")}
        for name, members in mapping(top.get("levels"), "levels").items():
            _level(
                levels.setdefault(name, _Level()), graph, mapping(members, f"levels.{name}"), f"levels.{name}", context
            )
        _collect(doors, mapping(top.get("doors"), "doors"), graph, context, "doors")
        _collect(lifts, mapping(top.get("lifts"), "lifts"), graph, context, "lifts")
    top = members = {}
    context.main = main
    if not levels:
        raise_unreadable("a navigation graph needs at least one level", "levels")
    if context.level != GROUND:
        context.warn(f"the file names its own levels; level={context.level} is ignored", where="levels")
    for name, (members, inside, k) in doors.items():
        context.main = names[inside[0]]
        _door(levels, name, members, {"index": k, **_partly(inside, graphs)})
    for name, (members, inside, k) in lifts.items():
        context.main = names[inside[0]]
        _lift(levels, name, members, {"index": k, **_partly(inside, graphs)})
    context.main = main
    parts: dict[PartKey, Part] = {}
    taken: set[str] = set()
    for name, level in levels.items():
        document: dict[str, Any] = {"graphs": tops}
        if level.rest:
            document["level"] = level.rest
        if level.dangling:
            document["dangling"] = level.dangling
        network = _network(name, level, taken).with_document({NAME: document})
        parts[PartKey("topology", name, NETWORK)] = network
        if not len(network):  # a level without nodes is of use to this format only
            parts[PartKey("topology", name, NAME)] = network
        if level.objects:
            parts[PartKey("objects", name, NAME)] = features(level.objects, "local", {NAME: document})
    return Layers({key: part for key, part in parts.items() if context.wants(key.layer)})


def _graphs(files: Files, context: ReadContext) -> tuple[dict[int, dict[str, Any]], dict[int, str]]:
    """Return the content and the name of the files by graph: the number in the file name, else the next free one."""
    out: dict[int, dict[str, Any]] = {}
    names: dict[int, str] = {}
    named = sorted(files, key=lambda name: (not _stem(name).isdigit(), len(_stem(name)), name))
    for name in named:
        context.main = name
        top = yaml.load(files[name], context.limits)
        if not isinstance(top, dict):
            raise_unreadable("must be a mapping with levels", "")
        stem = _stem(name)
        graph_number = int(stem) if stem.isdecimal() and stem.isascii() and len(stem) < 5 else None
        graph = (
            graph_number
            if graph_number is not None and graph_number not in out
            else next(k for k in range(10**6) if k not in out)
        )
        if graph_number is None:
            context.warn(f"the file name is not a number; it is read as graph {graph}")
        out[graph], names[graph] = top, name
    return out, names


def _stem(name: str) -> str:
    return name.rpartition("/")[2].partition(".")[0]


def _level(level: _Level, graph: int, members: Mapping[str, Any], location: str, context: ReadContext) -> None:
    rows = listing(members.get("vertices"), f"{location}.vertices")
    places: list[int] = []
    for k, (row, (x, y)) in enumerate(zip(rows, common.places(rows, f"{location}.vertices").tolist(), strict=True)):
        parameters = mapping(row[2] if len(row) > 2 else None, f"{location}.vertices[{k}][2]")
        # A graph may list equal vertices; vertices of other graphs are matched by content.
        key = orjson.dumps((x, y, parameters, row[3:]), option=orjson.OPT_SORT_KEYS).decode()
        node_index = level.nodes.get(key)
        if node_index is None or str(graph) in level.nodes_say[node_index]["graphs"]:
            node_index = len(level.at)
            level.nodes.setdefault(key, node_index)
            level.at.append((x, y))
            more = {"more": row[3:]} if len(row) > 3 else {}
            level.nodes_say.append({"graphs": {}, "parameters": parameters, **more})
        level.nodes_say[node_index]["graphs"][str(graph)] = k
        places.append(node_index)
    shared: dict[str, dict[str, Any]] = {}
    compact = SharedKeyDicts()
    for k, row in enumerate(listing(members.get("lanes"), f"{location}.lanes")):
        at = f"{location}.lanes[{k}]"
        if not isinstance(row, list) or len(row) < 2:
            raise_unreadable("must be a list [vertex, vertex, {…}]", at)
        i, j = index(row[0], f"{at}[0]"), index(row[1], f"{at}[1]")
        parameters = mapping(row[2] if len(row) > 2 else None, f"{at}[2]")
        if not (0 <= i < len(rows) and 0 <= j < len(rows)):
            level.dangling.setdefault(str(graph), []).append(row)
            problem = (
                f"joins the vertices {i} and {j}, but the level has {len(rows)}; it is stored in the document only"
            )
            context.warn(problem, where=at)
            continue
        more = {"more": row[3:]} if len(row) > 3 else {}
        if len(shared) < MAX_CACHED_PARAMETERS:
            parameters = shared.setdefault(orjson.dumps(parameters).decode(), parameters)
        extra_members = {"graph": graph, "index": k, "parameters": parameters, **more}
        level.edges.append((places[i], places[j], compact(extra_members)))
        if parameters.get("is_bidirectional") is True:
            level.edges.append((places[j], places[i], compact({**extra_members, "reverse": True})))
    extra_members = {key: value for key, value in members.items() if key not in ("vertices", "lanes")}
    if extra_members:
        level.rest[str(graph)] = extra_members


def _collect(
    entries: dict[str, tuple[Any, list[int], int]],
    members: Mapping[str, Any],
    graph: int,
    context: ReadContext,
    section: str,
) -> None:
    """Add the doors or lifts of one graph to those of earlier graphs."""
    for name, one in members.items():
        if name not in entries:
            entries[name] = (one, [graph], len(entries))
            continue
        entries[name][1].append(graph)
        if entries[name][0] != one:
            context.warn(
                "differs between graphs; the definition of the earlier graph is used", where=f"{section}.{name}"
            )


def _partly(inside: list[int], graphs: Mapping[int, Any]) -> dict[str, Any]:
    return {} if len(inside) == len(graphs) else {"graphs": inside}


def _door(levels: Mapping[str, _Level], name: str, members: Any, source_properties: dict[str, Any]) -> None:
    location = f"doors.{name}"
    one = dict(mapping(members, location))
    ends = listing(one.pop("endpoints", None), f"{location}.endpoints")
    if len(ends) != 2:
        raise_unreadable("must be two points", f"{location}.endpoints")
    at = common.places(ends, f"{location}.endpoints")
    level = one.pop("map", None)
    if level not in levels:
        one["map"] = level
        level = next(iter(levels))
    properties = {"kind": "door", "name": name, NAME: {**source_properties, "says": one}}
    levels[str(level)].objects.append((f"{level}/door/{common.short(name)}", shapely.LineString(at), properties))


def _lift(levels: Mapping[str, _Level], name: str, members: Any, source_properties: dict[str, Any]) -> None:
    location = f"lifts.{name}"
    one = dict(mapping(members, location))
    position = listing(one.pop("position", None), f"{location}.position")
    dims = listing(one.pop("dims", None), f"{location}.dims")
    if len(position) < 2 or len(dims) != 2:
        raise_unreadable("needs position [x, y, yaw] and dims [width, depth]", location)
    x, y, yaw = (number(v, f"{location}.position") for v in [*position, 0.0][:3])
    size = [*(number(v, f"{location}.dims") for v in dims), CABIN_HEIGHT]
    level = next(iter(levels))
    properties: dict[str, Any] = {"kind": "lift", "name": name, "pose": [x, y, 0.0, 0.0, 0.0, yaw], "size": size}
    row = (
        f"{level}/lift/{common.short(name)}",
        shapely.Point(x, y),
        {**properties, NAME: {**source_properties, "says": one}},
    )
    levels[level].objects.append(row)


def _network(name: str, level: _Level, taken: set[str]) -> Features:
    level.nodes.clear()
    properties: list[Properties] = []
    compact = SharedKeyDicts()
    names = []
    for k, source_properties in enumerate(level.nodes_say):
        called = source_properties["parameters"].get("name")
        item_properties: dict[str, Any] = {"kind": "node"}
        if isinstance(called, str) and called:
            item_properties["name"] = called
            source_properties["parameters"] = {
                key: value for key, value in source_properties["parameters"].items() if key != "name"
            }
        item_properties |= common.area_property(source_properties["parameters"], typed=False)
        properties.append(compact({**item_properties, NAME: compact(source_properties)}))
        names.append(common.short(called) if "name" in item_properties else f"{common.short(name, 200)}/{k}")
    ids = unique_ids(names, taken)
    taken.update(ids)
    at = np.array(level.at, np.float64).reshape(-1, 2)
    sources, targets = [i for i, _, _ in level.edges], [j for _, j, _ in level.edges]
    edges = [common.short(f"{ids[i]}_{ids[j]}", 490) for i, j in zip(sources, targets, strict=True)]
    edges = unique_ids(edges, taken)
    taken.update(edges)
    for i, j, source_properties in level.edges:
        item_properties = {"kind": "edge", "source": ids[i], "target": ids[j], NAME: source_properties}
        limit = lane_speed_limit(source_properties["parameters"])
        if limit:
            item_properties["speed_limit"] = limit
        properties.append(compact(item_properties))
    lines = segments(at[sources], at[targets]) if sources else np.empty(0, object)
    return from_columns([*ids, *edges], np.concatenate([points(at), lines]), properties, "local")


def lane_speed_limit(parameters: Mapping[str, Any]) -> float:
    """Return a lane's speed limit in m/s, 0 if there is none."""
    speed = parameters.get("speed_limit")
    valid = isinstance(speed, (int, float)) and not isinstance(speed, bool) and speed > 0
    return float(speed) if valid and speed is not None else 0.0

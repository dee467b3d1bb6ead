"""ffr_network: environment_common's FFR networks, as YAML: named points, and lines between their coordinates.

``internal_points``: ``{name, x, y}`` in metres in the local frame; ``network_lines``: ``{start: {x, y}, end: {x, y}}``,
bidirectional. A line connects the points with exactly its end coordinates. Source: environment_common,
convertors/ffrnetwork_to_tmap.py, which reads ``topological/network.ffr.yaml`` (it adds each line to both end nodes;
due to a bug the reverse edge leads from a node to itself).

Canonical: a node's id is its name, an edge's ``<from>-<to>``; see ``_undirected`` for edges of both directions. A
point's ``z`` is its altitude. ``properties.ffr_network`` contains ``more`` (further keys of a point, or of a line and
under ``start`` and ``end`` of its ends), ``name`` if it is not the id; the document's ``ffr_network`` contains ``top``
(further keys of the file) and ``dangling`` (lines that end at no point).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from app.errors import Problem, UnreadableFile
from app.formats import Claims, Files, Format, LayerRequirements, ReadContext, Traits, WriteContext, _fields, register
from app.formats._fields import COORDINATE, WIDTH, record
from app.formats._network import (
    Array,
    check_name,
    duplicates,
    get_source_properties,
    identifier,
    is_name,
    merge_networks,
    natural_sort_key,
    node_points,
    number,
    raise_unreadable,
    shorten_list,
    source_document,
)
from app.formats._undirected import NODE_CANONICAL, Line, edges, lines, warn_isolated
from app.model.features import Properties, from_columns, unique_ids
from app.model.frame import MAX_METRES
from app.model.layers import NETWORK, Layers, PartKey
from app.syntax import yaml
from app.syntax.decimals import METRES, numbers

NAME = "ffr_network"
FILE = "network.ffr.yaml"
POINTS, LINES = "internal_points", "network_lines"
DECIMALS = 6
"""Decimal places to which equal coordinates agree: a micrometre."""

AXES = ("x", "y", "z")
_END = record(x=COORDINATE, y=COORDINATE)
SHAPE = record(
    internal_points=[record("name", x=COORDINATE, y=COORDINATE, z=COORDINATE)],
    network_lines=[record("name", start=_END, end=_END, width=WIDTH)],
)
"""Shape of the file."""


# --- reading ---------------------------------------------------------------------------------------------------------
def read(files: Files, context: ReadContext) -> Layers:
    """Read the network as topology. Raises UnreadableFile naming the point or line."""
    if not context.wants("topology"):
        return Layers()
    main = context.main or next(iter(files))
    top = yaml.load(files[main], context.limits)
    if not isinstance(top, dict) or not isinstance(top.get(POINTS), list):
        reason = f"an FFR network must be a mapping with a list of {POINTS}"
        raise UnreadableFile(f"{main}: {reason}", [Problem(reason, main, where=POINTS)])
    names, xyz, high, rests = _points(top[POINTS])
    if repeats := duplicates(names):
        context.warn(f"{len(repeats)} duplicate point names: {shorten_list(repeats)}")
    index_by_spot: dict[tuple[float, float], int] = {}
    crowded = []
    for k, (x, y) in enumerate(xyz[:, :2].tolist()):
        if index_by_spot.setdefault(_spot(x, y), k) != k:
            crowded.append(names[k])
    if crowded:
        context.warn(
            f"{len(crowded)} points share the position of another one: {shorten_list(crowded)}; lines connect to "
            "the first"
        )
    file_lines, dangling = _lines(top.get(LINES), index_by_spot, context)
    _fields.check(top, SHAPE, context)
    warn_isolated(len(names), (k for line in file_lines for k in (line.a, line.b)), names, context)
    ids = unique_ids(map(identifier, names))
    properties: list[Properties] = []
    for i, name, extra_members, is_high in zip(ids, names, rests, high, strict=True):
        source_members: dict[str, Any] = {"more": extra_members} if extra_members else {}
        if i != name:
            source_members["name"] = name
        if is_high:
            source_members["z"] = True
        properties.append({"kind": "node", "name": name, NAME: source_members})
    edge_ids, shapes, edge_properties = edges(file_lines, ids, xyz, NAME)
    extra_members = {key: value for key, value in top.items() if key not in (POINTS, LINES)}
    document = ({"top": extra_members} if extra_members else {}) | ({"dangling": dangling} if dangling else {})
    geometry = np.empty(len(ids) + len(shapes), object)
    geometry[:] = [*node_points(xyz), *shapes]
    part = from_columns([*ids, *edge_ids], geometry, [*properties, *edge_properties], "local", {NAME: document})
    return Layers({PartKey("topology", context.level, NETWORK): part})


def _spot(x: float, y: float) -> tuple[float, float]:
    return round(x, DECIMALS) + 0.0, round(y, DECIMALS) + 0.0


def _points(points: Sequence[Any]) -> tuple[list[str], Array, list[bool], list[dict[str, Any]]]:
    """Return names, float64 [n, 3] metres, whether each point has a z, and further keys."""
    names, rows, high, rests = [], [], [], []
    for k, point in enumerate(points):
        location = f"{POINTS}[{k}]"
        if not isinstance(point, dict):
            raise_unreadable("a point must be a mapping with name, x and y", location)
        name = point.get("name")
        if isinstance(name, bool) or not isinstance(name, (int, float, str)):
            raise_unreadable("a point must have a name", f"{location}.name")
        names.append(check_name(name if isinstance(name, str) else yaml.text(name), f"{location}.name"))
        rows.append((*_xy(point, location), number(point.get("z", 0.0), f"{location}.z")))
        high.append("z" in point)
        rests.append({key: value for key, value in point.items() if key not in ("name", *AXES)})
    return names, np.array(rows, np.float64).reshape(-1, 3), high, rests


def _xy(point: Any, location: str) -> tuple[float, float]:
    if not isinstance(point, dict):
        raise_unreadable("must be a mapping with x and y", location)
    x, y = (number(point.get(axis), f"{location}.{axis}") for axis in "xy")
    if max(abs(x), abs(y)) > MAX_METRES:
        raise_unreadable(f"coordinates must be within ±{MAX_METRES:g} m", location)
    return x, y


def _lines(
    entries: Any, index_by_spot: Mapping[tuple[float, float], int], context: ReadContext
) -> tuple[list[Line], list[dict[str, Any]]]:
    """Return the lines between points, and the dangling ones unchanged."""
    if entries is not None and not isinstance(entries, list):
        raise_unreadable("must be a list", LINES)
    file_lines, dangling = [], []
    for k, line in enumerate(entries or ()):
        location = f"{LINES}[{k}]"
        if not isinstance(line, dict):
            raise_unreadable("a line must be a mapping with start and end", location)
        ends = [_xy(line.get(end), f"{location}.{end}") for end in ("start", "end")]
        spots = [index_by_spot.get(_spot(*end)) for end in ends]
        if spots[0] is None or spots[1] is None:
            x, y = ends[0] if spots[0] is None else ends[1]
            reason = f"no point at its end x {x:g}, y {y:g}; the line is stored but is not part of the network"
            context.warn(reason, where=location)
            dangling.append(line)
            continue
        if spots[0] == spots[1]:
            context.warn("the line ends at its start point", where=location)
        extra_members = {key: value for key, value in line.items() if key not in ("start", "end")}
        for end in ("start", "end"):
            more = {key: value for key, value in line[end].items() if key not in "xy"}
            if more:
                extra_members[end] = more
        file_lines.append(Line(spots[0], spots[1], extra_members))
    return file_lines, dangling


# --- writing ---------------------------------------------------------------------------------------------------------
def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """Write ``network.ffr.yaml``: all networks as one, points in natural order of names, lines by their points.

    Edges of both directions between two nodes are one line. Raises MissingDatum for wgs84 items without a datum.
    """
    net = merge_networks(layers, context)
    order = sorted(range(len(net.nodes)), key=lambda k: natural_sort_key(net.nodes[k].id))
    if len(set(net.levels)) > 1:
        context.drop("levels of nodes", len(net.nodes), "all networks are joined into one")
    document = source_document(layers, NAME)
    xy = np.array([(n.x, n.y) for n in net.nodes], np.float64).reshape(-1, 2)
    xy_texts = list(map(yaml.decimal, numbers(xy.ravel(), METRES)))
    at = list(zip(xy_texts[::2], xy_texts[1::2], strict=True))
    spots = [_spot(x, y) for x, y in xy.tolist()]
    if len(set(spots)) < len(spots):
        reason = "nodes share the position of another one; readers connect their lines to the other one"
        context.warn(f"{len(spots) - len(set(spots))} {reason}")
    top = document.get("top")
    top = {key: v for key, v in top.items() if key not in (POINTS, LINES)} if isinstance(top, dict) else {}
    out = [yaml.mapping(top, 0)] if top else []
    out.append(f"{POINTS}:\n" if order else f"{POINTS}: []\n")
    dropped_count = unnamed = 0
    for k in order:
        node = net.nodes[k]
        p, its = node.properties, get_source_properties(node.properties, NAME)
        name = its.get("name")
        name = name if isinstance(name, str) and is_name(name) else node.id
        more = its.get("more")
        members = {key: v for key, v in more.items() if key not in ("name", *AXES)} if isinstance(more, dict) else {}
        unnamed += isinstance(p.get("name"), str) and p["name"] not in ("", name)
        dropped_count += bool(p.keys() - NODE_CANONICAL - {NAME})
        text = f"- name: {yaml.text(name)}\n  x: {at[k][0]}\n  y: {at[k][1]}\n"
        if node.z or its.get("z") is True:
            text += f"  z: {yaml.decimal(numbers([node.z or 0.0], METRES)[0])}\n"
        out.append(f"{text}{yaml.mapping(members, 2) if members else ''}")
    context.drop("attributes of nodes", dropped_count, "the format cannot store them")
    context.drop("names of nodes that are not their ids", unnamed, "a point's name is its node's id")
    ranks = {k: rank for rank, k in enumerate(order)}
    line_texts = []
    for line in sorted(lines(net, context, NAME), key=lambda one: (ranks[one.a], ranks[one.b])):
        ends = (_parse_end("start", line.members, at[line.a]), _parse_end("end", line.members, at[line.b]))
        extra_members = {key: value for key, value in line.members.items() if key not in ("start", "end")}
        line_texts.append(f"- {ends[0]}  {ends[1]}{yaml.mapping(extra_members, 2) if extra_members else ''}")
    dangling = document.get("dangling")
    dangling = [one for one in dangling if isinstance(one, dict) and one] if isinstance(dangling, list) else []
    line_texts += [f"- {yaml.mapping(one, 2)[2:]}" for one in dangling]
    out += [f"{LINES}:\n", *line_texts] if line_texts else [f"{LINES}: []\n"]
    return {FILE: "".join(out).encode()}


def _parse_end(end: str, members: Mapping[str, Any], at: tuple[str, str]) -> str:
    more = members.get(end)
    extra_members = {key: value for key, value in more.items() if key not in "xy"} if isinstance(more, dict) else {}
    return f"{end}:\n    x: {at[0]}\n    y: {at[1]}\n{yaml.mapping(extra_members, 4) if extra_members else ''}"


# --- detection -------------------------------------------------------------------------------------------------------
_POINTS = re.compile(rb"(?m)^[\"']?internal_points[\"']?[ \t]*:")
_LINES = re.compile(rb"(?m)^[\"']?network_lines[\"']?[ \t]*:")


def detect(name: str, data: bytes) -> bool:
    """Detect YAML with both lists at the top."""
    del name
    return b"network_lines" in data and bool(_POINTS.search(data) and _LINES.search(data))


register(
    Format(
        name=NAME,
        title="FFR network (environment_common)",
        files={FILE: "application/yaml"},
        layers=frozenset({"topology"}),
        detect=detect,
        read=read,
        write=write,
        needs=LayerRequirements(one_of=(frozenset({"topology"}),), anchor="local"),
        extensions=(".ffr.yaml", ".yaml", ".yml"),
        version=2,
        claims=Claims(priority=34),
        traits=Traits(keeps_bends="nodes"),
    )
)

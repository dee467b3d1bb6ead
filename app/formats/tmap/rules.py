"""Rules of topological_navigation for tmap2.

Sources: its JSON schema (config/tmap-schema.yaml); manager2.py, which addresses edges by ``edge_id`` and assigns new
ones of the form ``<from>_<to>`` when a node is renamed; localisation.py, which reads each node's pose. The schema of
2026 has times with the day first; its map_manager2.py refuses duplicate names and several pointsets.

A network of a city has megabytes of YAML. If its lines are regular, as PyYAML writes them, it is enough to count them;
only files with missing members or another layout are parsed.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

from app.errors import Problem
from app.formats import Files
from app.formats._rules import (
    HEAD_BYTES,
    LIMITS,
    duplicates,
    error_finding,
    is_brief,
    missing,
    names,
    shown,
    warning_finding,
)
from app.syntax import yaml

TOP = ("meta", "metric_map", "name", "nodes", "pointset")
META = ("map", "node", "pointset")
NODE = ("edges", "name")
EDGE = ("edge_id", "node")
YEAR_FIRST = re.compile(r"[0-9]{4}-[0-9]{2}-[0-9]{2}_[0-9]{2}-[0-9]{2}-[0-9]{2}")
DAY_FIRST = re.compile(r"[0-9]{2}-[0-9]{2}-[0-9]{4}_[0-9]{2}-[0-9]{2}-[0-9]{2}")

_LINES = re.compile(rb"\n(    name|    node| {6}edge_id| {6}node): (.*)")
_POINTSET = re.compile(rb"\n    pointset: ([^\n]*)")
_NO_TEXT = re.compile(rb"\n(?:metric_map|name|pointset): [-+.\d~]")
_COUNTED = (
    b"\n    map: ",
    b"\n    node: ",
    b"\n    pointset: ",
    b"\n    parent_frame: ",
    b"\n    edges:",
    b"\n    pose:\n",
)
_TOPS = (b"\nmetric_map: ", b"\nname: ", b"\npointset: ")
_TIME = re.compile(rb"""(?:^|\n)meta:\n(?:  [^\n]*\n)*?  last_updated: (['"]?)([^'"\n]*)\1\n""")

Edges = list[tuple[str, str, str]]
"""(source, id, target) of edges."""


@dataclass(slots=True)
class _Network:
    """What a file contains. pointsets: those of its nodes; is_newest: whether its time has the day first."""

    nodes: list[str] = field(default_factory=list)
    edges: Edges = field(default_factory=list)
    pointsets: set[str] = field(default_factory=set)
    is_newest: bool = False


def check(files: Files) -> Iterator[Problem]:
    """Check a map with the rules of the schema and the map manager."""
    main = next(iter(files))
    data = files[main]
    if is_brief(data):
        if not _is_dated(data[:HEAD_BYTES]):
            yield error_finding("must be a string like 2024-05-01_10-00-00", main, where="meta.last_updated")
        return
    network = _regular(data)
    if network is None:
        network = _Network()
        yield from _check_document(yaml.load(data, LIMITS), main, network)
    yield from _check_network(network, main)


def _regular(data: bytes) -> _Network | None:
    """Return the network of a regular, complete file, else None."""
    count = data.count(b"\n- meta:\n")
    if not count or not _is_dated(data[:HEAD_BYTES]) or b"&" in data:
        return None
    if any(data.count(line) != count for line in _COUNTED) or any(data.count(line) != 1 for line in _TOPS):
        return None
    if _NO_TEXT.search(data):
        return None
    called = b""
    nodes: list[str] = []
    edges: Edges = []
    waiting: dict[bytes, list[str]] = {b"edge_id": [], b"node": []}
    for key, value in _LINES.findall(data):
        text = value.decode("utf-8", "replace").strip("'\"")
        if key == b"    node":
            called = value
        elif key == b"    name":
            if value != called or value[:1] in b"-+.0123456789~&*":
                return None
            nodes.append(text)
            ids, targets = waiting[b"edge_id"], waiting[b"node"]
            if len(ids) != len(targets):
                return None
            edges += [(text, i, target) for i, target in zip(ids, targets, strict=True)]
            ids.clear()
            targets.clear()
        else:
            waiting[key.strip()].append(text)
    if len(nodes) != count or waiting[b"edge_id"]:
        return None
    is_newest = DAY_FIRST.fullmatch(_time(data[:HEAD_BYTES])) is not None
    values = set(_POINTSET.findall(data)) if is_newest else set()
    return _Network(nodes, edges, {text.decode("utf-8", "replace").strip("'\"") for text in values}, is_newest)


def _time(head: bytes) -> str:
    """Return the time of the last change, or an empty text."""
    time = _TIME.search(head)
    return "" if time is None else time[2].decode("latin1")


def _is_dated(head: bytes) -> bool:
    return _is_time(_time(head))


def _is_time(time: Any) -> bool:
    return isinstance(time, str) and bool(YEAR_FIRST.fullmatch(time) or DAY_FIRST.fullmatch(time))


def _check_document(top: Any, main: str, network: _Network) -> Iterator[Problem]:
    """Check the schema's rules one by one; adds to ``network``."""
    if not isinstance(top, dict):
        yield error_finding("a topological map must be a mapping: upload a list as the older format tmap", main)
        return
    for key in missing(top, TOP):
        yield error_finding("the schema requires this key", main, where=key)
    for key in ("metric_map", "name", "pointset"):
        if top.get(key) is not None and not isinstance(top[key], str):
            yield error_finding(f"must be a string, got {shown(top[key])}", main, where=key)
    time = top["meta"].get("last_updated") if isinstance(top.get("meta"), dict) else None
    network.is_newest = isinstance(time, str) and DAY_FIRST.fullmatch(time) is not None
    if not _is_time(time):
        reason = f"must be a string like 2024-05-01_10-00-00, got {shown(time)}"
        yield error_finding(reason, main, where="meta.last_updated")
    transformation = top.get("transformation")
    has_default = isinstance(transformation, dict) and bool(transformation.get("topo_frame_id"))
    rows = top.get("nodes")
    if not isinstance(rows, list):
        if rows is not None:
            yield error_finding(f"must be a list, got {shown(rows)}", main, where="nodes")
        return
    for k, row in enumerate(rows):
        location = f"nodes[{k}]"
        meta, node = (row.get("meta"), row.get("node")) if isinstance(row, dict) else (None, None)
        if absent := missing(meta, META):
            yield error_finding(f"the schema requires {', '.join(absent)}", main, where=f"{location}.meta")
        # Only older schemas require a frame; the newest has topo_frame_id and nav_frame instead.
        framed = isinstance(node, dict) and (node.get("nav_frame") or (has_default and not node.get("parent_frame")))
        if absent := missing(node, NODE if framed else (*NODE, "parent_frame")):
            yield error_finding(f"the schema requires {', '.join(absent)}", main, where=f"{location}.node")
        if not isinstance(node, dict):
            continue
        if missing(node.get("pose"), ("orientation", "position")):
            yield error_finding("a node needs a pose, which localisation reads", main, where=f"{location}.node.pose")
        for key in ("name", "parent_frame", "nav_frame"):
            if node.get(key) is not None and not isinstance(node[key], str):
                yield error_finding(f"must be a string, got {shown(node[key])}", main, where=f"{location}.node.{key}")
        name = str(node.get("name"))
        if isinstance(meta, dict) and meta.get("node") not in (None, node.get("name")):
            yield warning_finding(
                f"is {shown(meta['node'])}, but the node is named {name!r}", main, where=f"{location}.meta.node"
            )
        network.nodes.append(name)
        if isinstance(meta, dict):
            network.pointsets.add(str(meta.get("pointset")))
        listed = node.get("edges")
        if listed is not None and not isinstance(listed, list):
            yield error_finding(f"must be a list, got {shown(listed)}", main, where=f"{location}.node.edges")
            continue
        for j, edge in enumerate(listed or ()):
            if absent := missing(edge, EDGE):
                yield error_finding(
                    f"the schema requires {', '.join(absent)}", main, where=f"{location}.node.edges[{j}]"
                )
                continue
            network.edges.append((name, str(edge["edge_id"]), str(edge["node"])))


def _check_network(network: _Network, main: str) -> Iterator[Problem]:
    edges, node_names = network.edges, set(network.nodes)
    if repeats := duplicates(network.nodes):
        finding = error_finding if network.is_newest else warning_finding
        yield finding(
            f"{len(repeats)} duplicate node names, to which edges refer: {names(repeats)}", main, where="nodes"
        )
    if network.is_newest and len(network.pointsets) > 1:
        listed = names(sorted(network.pointsets))
        yield error_finding(f"the nodes have several pointsets in their meta: {listed}", main, where="nodes")
    if dangling := [i for _, i, target in edges if target not in node_names]:
        reason = f"{len(dangling)} edges lead to unknown nodes: {names(dangling)}"
        yield error_finding(reason, main, where="nodes")
    if repeats := duplicates(i for _, i, _ in edges):
        reason = f"{len(repeats)} duplicate edge_ids, by which the map manager finds edges: {names(repeats)}"
        yield warning_finding(reason, main, where="nodes")
    if other := [i for source, i, target in edges if i != f"{source}_{target}"]:
        reason = f"{len(other)} edges are not named <from>_<to> as by the map manager: {names(other)}"
        yield warning_finding(reason, main, where="nodes")

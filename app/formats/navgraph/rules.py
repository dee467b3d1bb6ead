"""Consumer checks for navigation graphs: Fawkes.

Source: fawkesrobotics/fawkes, src/libs/navgraph/yaml_navgraph.cpp and navgraph.cpp (add_node and add_edge reject
duplicate nodes and missing ones; calc_reachability asserts that each node is connected unless it is
``!unconnected``).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from app.errors import Problem
from app.formats import Files
from app.formats._rules import (
    LIMITS,
    MAX_WHOLE_YAML_BYTES,
    cpp_number,
    duplicates,
    error_finding,
    is_brief,
    names,
    shown,
    warning_finding,
)
from app.syntax import yaml

PREFIX = "tag:fawkesrobotics.org,navgraph/"
OURS = (PREFIX, "!")
NODE_TAGS = frozenset({"unconnected"})
EDGE_TAGS = frozenset({"dir", "bidir", "allow-intersection", "no-intersection", "split-intersection"})


def check(files: Files) -> Iterator[Problem]:
    """Check a graph by Fawkes' rules."""
    main = next(iter(files))
    if is_brief(files[main]):
        return
    if len(files[main]) > MAX_WHOLE_YAML_BYTES:
        yield warning_finding(f"not checked: it is larger than {MAX_WHOLE_YAML_BYTES} bytes", main)
        return
    top = yaml.load(files[main], LIMITS, tags=OURS, typed=False)
    if not isinstance(top, dict):
        yield error_finding("a graph must be a mapping", main)
        return
    if not isinstance(top.get("graph-name"), str):
        yield error_finding("a graph needs a name", main, where="graph-name")
    if "default-properties" in top:
        yield from _properties(top["default-properties"], main, "default-properties")
    nodes, alone = top.get("nodes"), set()
    called: list[str] = []
    tags: list[str] = []
    for k, item in enumerate(nodes if isinstance(nodes, list) else ()):
        tag, node = _split_tag(item)
        tags += [tag] if tag else []
        location = f"nodes[{k}]"
        if not isinstance(node, dict) or not isinstance(node.get("name"), str):
            yield error_finding("a node must be a mapping with a name", main, where=location)
            continue
        called.append(node["name"])
        if tag == PREFIX + "unconnected":
            alone.add(node["name"])
        elif tag and tag.removeprefix(PREFIX) not in NODE_TAGS and tag.startswith(PREFIX):
            yield warning_finding(
                f"Fawkes does not support the tag {shown(tag.removeprefix(PREFIX))} of a node", main, where=location
            )
        at = node.get("pos")
        if not isinstance(at, list) or len(at) != 2 or any(cpp_number(v) is None for v in at):
            yield error_finding(f"must be [x, y], got {shown(at)}", main, where=f"{location}.pos")
        if "properties" in node:
            yield from _properties(node["properties"], main, f"{location}.properties")
    if repeats := duplicates(called):
        yield error_finding(f"{len(repeats)} duplicate node names: {names(repeats)}", main, where="nodes")
    yield from _connections(top.get("connections"), set(called), alone, tags, main)
    if foreign := [tag for tag in tags if not tag.startswith(PREFIX)]:
        reason = f"tags have no effect in Fawkes without the line %TAG ! {PREFIX}: {names(sorted(set(foreign)))}"
        yield error_finding(reason, main)


def _split_tag(item: Any) -> tuple[str, Any]:
    return (item.tag, item.value) if isinstance(item, yaml.Tagged) else ("", item)


def _properties(properties: Any, main: str, location: str) -> Iterator[Problem]:
    if not isinstance(properties, list):
        yield error_finding(f"must be a list of properties, got {shown(properties)}", main, where=location)
        return
    for k, one in enumerate(properties):
        values = one.values() if isinstance(one, dict) else [one]
        if not all(isinstance(v, str) for v in values):
            yield error_finding(
                "a property must be a word or a key with a single value", main, where=f"{location}[{k}]"
            )


def _connections(
    connections: Any, node_names: set[str], alone: set[str], tags: list[str], main: str
) -> Iterator[Problem]:
    reached: set[str] = set()
    dangling: list[str] = []
    pairs: list[tuple[str, str]] = []
    for k, item in enumerate(connections if isinstance(connections, list) else ()):
        tag, ends = _split_tag(item)
        tags += [tag] if tag else []
        if not isinstance(ends, list) or len(ends) != 2 or not all(isinstance(end, str) for end in ends):
            yield error_finding("a connection must be a list of two names", main, where=f"connections[{k}]")
            continue
        if tag.startswith(PREFIX) and tag.removeprefix(PREFIX) not in EDGE_TAGS:
            reason = f"Fawkes does not support the tag {shown(tag.removeprefix(PREFIX))} of a connection"
            yield warning_finding(reason, main, where=f"connections[{k}]")
        dangling += [str(end) for end in ends if end not in node_names]
        reached.update(map(str, ends))
        pairs.append((str(ends[0]), str(ends[1])))
    if dangling:
        yield error_finding(
            f"{len(dangling)} ends of connections are not nodes: {names(dangling)}", main, where="connections"
        )
    if repeats := duplicates(pairs):
        pair_names = names("-".join(pair) for pair in repeats)
        yield warning_finding(f"{len(repeats)} duplicate connections: {pair_names}", main, where="connections")
    if lonely := sorted(node_names - reached - alone):
        reason = f"{len(lonely)} isolated nodes are not tagged !unconnected: {names(lonely)}"
        yield error_finding(reason, main, where="nodes")

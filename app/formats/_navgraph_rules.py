"""What Fawkes wants of a navigation graph.

Source: fawkesrobotics/fawkes, src/libs/navgraph/yaml_navgraph.cpp and navgraph.cpp (add_node and add_edge refuse what
is there already or not there; calc_reachability asserts that each node is connected unless it is ``!unconnected``).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from app.errors import Problem
from app.formats import Files, _yaml
from app.formats._rules import LARGEST, LIMITS, brief, cpp_number, doubted, names, refused, repeated, shown

PREFIX = "tag:fawkesrobotics.org,navgraph/"
OURS = (PREFIX, "!")
NODE_TAGS = frozenset({"unconnected"})
EDGE_TAGS = frozenset({"dir", "bidir", "allow-intersection", "no-intersection", "split-intersection"})


def check(files: Files) -> Iterator[Problem]:
    """A graph as Fawkes loads it."""
    main = next(iter(files))
    if brief(files[main]):
        return
    if len(files[main]) > LARGEST:
        yield doubted(f"not checked: it is larger than {LARGEST} bytes", main)
        return
    top = _yaml.load(files[main], LIMITS, tags=OURS, typed=False)
    if not isinstance(top, dict):
        yield refused("a graph is a mapping", main)
        return
    if not isinstance(top.get("graph-name"), str):
        yield refused("a graph needs a name", main, where="graph-name")
    if "default-properties" in top:
        yield from _properties(top["default-properties"], main, "default-properties")
    nodes, alone = top.get("nodes"), set()
    called: list[str] = []
    tags: list[str] = []
    for k, item in enumerate(nodes if isinstance(nodes, list) else ()):
        tag, node = _untagged(item)
        tags += [tag] if tag else []
        where = f"nodes[{k}]"
        if not isinstance(node, dict) or not isinstance(node.get("name"), str):
            yield refused("a node is a mapping with a name", main, where=where)
            continue
        called.append(node["name"])
        if tag == PREFIX + "unconnected":
            alone.add(node["name"])
        elif tag and tag.removeprefix(PREFIX) not in NODE_TAGS and tag.startswith(PREFIX):
            yield doubted(f"Fawkes knows no tag {shown(tag.removeprefix(PREFIX))} of a node", main, where=where)
        at = node.get("pos")
        if not isinstance(at, list) or len(at) != 2 or any(cpp_number(v) is None for v in at):
            yield refused(f"must be [x, y], is {shown(at)}", main, where=f"{where}.pos")
        if "properties" in node:
            yield from _properties(node["properties"], main, f"{where}.properties")
    if again := repeated(called):
        yield refused(f"{len(again)} nodes have a name that is taken: {names(again)}", main, where="nodes")
    yield from _connections(top.get("connections"), set(called), alone, tags, main)
    if foreign := [tag for tag in tags if not tag.startswith(PREFIX)]:
        reason = (
            f"without the line %TAG ! {PREFIX} the tags are not Fawkes' and mean nothing: {names(sorted(set(foreign)))}"
        )
        yield refused(reason, main)


def _untagged(item: Any) -> tuple[str, Any]:
    return (item.tag, item.value) if isinstance(item, _yaml.Tagged) else ("", item)


def _properties(said: Any, main: str, where: str) -> Iterator[Problem]:
    if not isinstance(said, list):
        yield refused(f"must be a list of properties, is {shown(said)}", main, where=where)
        return
    for k, one in enumerate(said):
        values = one.values() if isinstance(one, dict) else [one]
        if not all(isinstance(v, str) for v in values):
            yield refused("a property is a word or a key with a single value", main, where=f"{where}[{k}]")


def _connections(said: Any, known: set[str], alone: set[str], tags: list[str], main: str) -> Iterator[Problem]:
    reached: set[str] = set()
    lost: list[str] = []
    pairs: list[tuple[str, str]] = []
    for k, item in enumerate(said if isinstance(said, list) else ()):
        tag, ends = _untagged(item)
        tags += [tag] if tag else []
        if not isinstance(ends, list) or len(ends) != 2 or not all(isinstance(end, str) for end in ends):
            yield refused("a connection is a list of two names", main, where=f"connections[{k}]")
            continue
        if tag.startswith(PREFIX) and tag.removeprefix(PREFIX) not in EDGE_TAGS:
            reason = f"Fawkes knows no tag {shown(tag.removeprefix(PREFIX))} of a connection"
            yield doubted(reason, main, where=f"connections[{k}]")
        lost += [str(end) for end in ends if end not in known]
        reached.update(map(str, ends))
        pairs.append((str(ends[0]), str(ends[1])))
    if lost:
        yield refused(f"{len(lost)} ends of connections are no nodes: {names(lost)}", main, where="connections")
    if again := repeated(pairs):
        told = names("-".join(pair) for pair in again)
        yield doubted(f"{len(again)} connections stand there twice: {told}", main, where="connections")
    if lonely := sorted(known - reached - alone):
        reason = f"{len(lonely)} nodes have no connection and are not !unconnected: {names(lonely)}"
        yield refused(reason, main, where="nodes")

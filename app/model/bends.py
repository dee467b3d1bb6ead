"""Straight edges for formats without shapes: nodes at the bends of an edge, and the way back to the bent edges.

A robot that drives straight between the nodes of a bent edge cuts the corner, through any obstacle there. Such a format
therefore gets a node ``<a>~<b>~1``, ``<a>~<b>~2`` … at each bend of an edge between the nodes a and b (a before b in
the alphabet, counted from a; both directions share them), and the edge ``e`` becomes ``e~1``, ``e~2`` … from its
source. The names follow from the network alone, so that they stay the same in later maps. ``join`` recognises them.
"""

from __future__ import annotations

import hashlib
import re
from collections import defaultdict
from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.model.features import MAX_ID, Features, Properties, unique_ids
from app.model.geodesy import LocalFrame
from app.model.layers import Layers, Part, PartKey
from app.model.network import middle_frame

TOLERANCE_METRES = 0.05
"""Maximum distance of a straight edge from the bent one, in metres: smaller deviations are no bends."""

IDENTITY = frozenset({"id", "edge_id", "index", "lane", "line", "backward", "geometry"})
"""Properties by which formats identify one edge of a file, or its index in it: pieces of an edge do not have them."""

NAMED = re.compile(r"(.+)~([1-9][0-9]{0,5})\Z", re.DOTALL)
BENDS = "bends"
"""Property of an edge: the properties of the nodes at its bends in its source file, from the lower end on."""

POINT, LINE = 0, 1


@dataclass(frozen=True, slots=True)
class Split:
    """Result of a split. edges: number of bent edges. nodes: number of nodes at bends."""

    edges: int = 0
    nodes: int = 0


# --- splitting ---


def split(layers: Layers, shape_of: str | None = None) -> tuple[Layers, Split]:
    """Split the bent edges of all networks. Layers without such edges are returned as they are.

    Args:
        shape_of: a format with shapes that its consumers ignore: edges that it identifies keep theirs.

    Networks of both anchors stay as they are while there is no datum: their writers report it.
    """
    parts: dict[PartKey, Part] = {}
    total = Split()
    networks = layers.vector("topology")
    if not any((shapely.get_num_coordinates(part.geometry) > 2).any() for part in networks.values()):
        return layers, total
    nodes: dict[str, set[str]] = defaultdict(set)
    for key, part in networks.items():
        nodes[key.level].update(i for i, p in zip(part.ids, part.properties, strict=True) if p.get("kind") == "node")
    for key, part in networks.items():
        places = _bent(part, nodes[key.level], shape_of)
        if len(places) and (part.local.all() or not part.local.any() or layers.frame is not None):
            # only distances count, so that items on earth need no datum
            frame = layers.frame if part.local.any() else middle_frame(shapely.get_coordinates(part.geometry))
            parts[key], count = _split_part(part, places, frame)
            total = Split(total.edges + count.edges, total.nodes + count.nodes)
    return (replace(layers, parts={**layers.parts, **parts}), total) if total.nodes else (layers, total)


def _bent(part: Features, nodes: Container[str], shape_of: str | None) -> NDArray[np.intp]:
    """Return indices of the edges between these nodes with more than two coordinates."""
    line = shapely.get_type_id(part.geometry) == LINE
    places = np.flatnonzero(line & (shapely.get_num_coordinates(part.geometry) > 2))
    rows = ((k, part.properties[k]) for k in places.tolist())
    edges = [(k, p) for k, p in rows if _is_edge(p) and p["source"] in nodes and p["target"] in nodes]
    return np.array([k for k, p in edges if not is_identified(p, shape_of)], np.intp)


def _is_edge(properties: Properties) -> bool:
    ends = (properties.get("source"), properties.get("target"))
    return properties.get("kind") == "edge" and all(isinstance(end, str) for end in ends)


def is_identified(properties: Properties, name: str | None) -> bool:
    """Return whether the edge has an id in this format's file."""
    identity = properties.get(name) if name is not None else None
    return isinstance(identity, Mapping) and identity.get("id") is not None


@dataclass(slots=True)
class _Course:
    """Vertices of an edge from the lower to the higher of its ends. at: [n, 2 or 3] as anchored. metres: [n, 2]."""

    place: int
    ends: tuple[str, str]
    backward: bool
    at: NDArray[np.float64]
    metres: NDArray[np.float64]

    @property
    def key(self) -> bytes:
        """Return a key that is equal for both directions of a line."""
        return (np.round(self.metres[1:-1], 3) + 0.0).tobytes()


def _split_part(part: Features, places: NDArray[np.intp], frame: LocalFrame | None) -> tuple[Features, Split]:
    courses = [course for course in _courses(part, places, frame) if len(course.at) > 2]
    if not courses:
        return part, Split()
    lines: dict[tuple[str, str], dict[bytes, _Course]] = defaultdict(dict)
    for course in courses:
        lines[course.ends].setdefault(course.key, course)
    name_candidates: list[str] = []
    columns = _Columns()
    first: dict[tuple[tuple[str, str], bytes], int] = {}
    for ends, course_by_key in lines.items():
        for key, course in course_by_key.items():
            base = f"{ends[0]}~{ends[1]}"
            if len(course_by_key) > 1:  # parallel edges: a name per line, independent of their order
                base += f"~{hashlib.sha256(key).hexdigest()[:6]}"
            first[ends, key] = len(name_candidates)
            inner = course.at[1:-1]
            name_candidates += [_bend_name(base, n + 1) for n in range(len(inner))]
            columns.geometry += list(shapely.points(inner))
            columns.local += [bool(part.local[course.place])] * len(inner)
    names = unique_ids(name_candidates, set(part.ids))
    node_properties = [
        p
        for course_by_key in lines.values()
        for course in course_by_key.values()
        for p in _stored_bend_nodes(part, course)
    ]
    columns.properties += [{"name": name, **p, "kind": "node"} for name, p in zip(names, node_properties, strict=True)]
    pieces: list[str] = []
    for course in courses:
        begin = first[course.ends, course.key]
        between = names[begin : begin + len(course.at) - 2]
        p = part.properties[course.place]
        pieces += [_bend_name(part.ids[course.place], n + 1) for n in range(len(between) + 1)]
        columns.add_pieces(course, between, drop_identity(p), local=bool(part.local[course.place]))
    mask = np.ones(len(part), bool)
    mask[[course.place for course in courses]] = False
    rest = part.select(mask)
    columns.ids = [*names, *unique_ids(pieces, {*rest.ids, *names})]
    return columns.after(rest), Split(len(courses), len(names))


def _stored_bend_nodes(part: Features, course: _Course) -> list[Properties]:
    """Return the stored properties of the nodes at an edge's bends, empty ones if there are none."""
    count = len(course.at) - 2
    node_properties = part.properties[course.place].get(BENDS)
    if (
        isinstance(node_properties, list)
        and len(node_properties) == count
        and all(isinstance(p, Mapping) for p in node_properties)
    ):
        return node_properties
    return [{}] * count


@dataclass(slots=True)
class _Columns:
    """Columns of new features."""

    ids: list[str] = field(default_factory=list)
    geometry: list[Any] = field(default_factory=list)
    properties: list[Properties] = field(default_factory=list)
    local: list[bool] = field(default_factory=list)

    def add_pieces(self, course: _Course, between: Sequence[str], properties: Properties, *, local: bool) -> None:
        """Add the straight edges of a course, in the edge's own direction."""
        chain, at = [course.ends[0], *between, course.ends[1]], course.at
        if course.backward:
            chain, at = chain[::-1], at[::-1]
        self.geometry += list(shapely.linestrings(np.stack([at[:-1], at[1:]], axis=1)))
        self.properties += [{**properties, "source": a, "target": b} for a, b in pairwise(chain)]
        self.local += [local] * (len(chain) - 1)

    def after(self, rest: Features) -> Features:
        """Append these features to others, with the others' document."""
        column: NDArray[np.object_] = np.empty(len(self.geometry), object)
        column[:] = self.geometry
        return Features(
            (*rest.ids, *self.ids),
            np.concatenate([rest.geometry, column]),
            (*rest.properties, *self.properties),
            np.concatenate([rest.local, np.array(self.local, bool)]),
            rest.document,
        )


def _courses(part: Features, places: NDArray[np.intp], frame: LocalFrame | None) -> Iterator[_Course]:
    """Return the bent edges from node to node, reduced to the vertices that are bends."""
    at_node = _node_positions(part, frame)
    for k, metric in zip(places.tolist(), part.select(places).in_local(frame), strict=True):
        p, shape = part.properties[k], part.geometry[k]
        at = shapely.get_coordinates(shape, include_z=bool(shapely.has_z(shape)))
        metres = shapely.get_coordinates(metric)
        for end, name in ((0, p["source"]), (-1, p["target"])):
            node = at_node.get(name)
            if node is None or node[2] != part.local[k]:
                continue
            if np.hypot(*(node[1] - metres[end])) > TOLERANCE_METRES:  # an end of the edge is at its node
                index = len(at) if end else 0
                at = np.insert(at, index, node[0][: at.shape[1]], axis=0)
                metres = np.insert(metres, index, node[1], axis=0)
        ends = (p["source"], p["target"])
        backward = ends[0] > ends[1] or (ends[0] == ends[1] and metres.tolist() > metres[::-1].tolist())
        if backward:
            ends, at, metres = ends[::-1], at[::-1], metres[::-1]
        bends = _bends(metres)
        yield _Course(k, ends, backward, at[bends], metres[bends])


def _node_positions(
    part: Features, frame: LocalFrame | None
) -> dict[str, tuple[NDArray[np.float64], NDArray[np.float64], bool]]:
    """Return nodes by id: [x, y, z] as anchored (z 0 if absent), [x, y] in metres, and whether the anchor is local."""
    point = shapely.get_type_id(part.geometry) == POINT
    rows = [k for k in np.flatnonzero(point).tolist() if part.properties[k].get("kind") == "node"]
    nodes = part.select([k for k in rows if not part.geometry[k].is_empty])
    at = np.nan_to_num(shapely.get_coordinates(nodes.geometry, include_z=True))
    metres = shapely.get_coordinates(nodes.in_local(frame))
    return {i: (at[n], metres[n], bool(nodes.local[n])) for n, i in enumerate(nodes.ids)}


def _bends(metres: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return indices of a line's ends and of the vertices that a line within the tolerance needs."""
    line = shapely.simplify(shapely.linestrings(metres), TOLERANCE_METRES, preserve_topology=False)
    vertices = shapely.get_coordinates(line)
    if len(vertices) < 2:
        return np.array([0, len(metres) - 1], np.intp)
    indices = [0]
    for vertex in vertices[1:-1]:
        indices.append(indices[-1] + 1 + int((metres[indices[-1] + 1 :] == vertex).all(axis=1).argmax()))
    return np.array([*indices, len(metres) - 1], np.intp)


def drop_identity(properties: Properties) -> dict[str, Any]:
    """Return an edge's properties without its identity in a file, and without its bends."""
    return {
        name: {word: v for word, v in value.items() if word not in IDENTITY} if isinstance(value, Mapping) else value
        for name, value in properties.items()
        if name != BENDS
    }


def _bend_name(name: str, number: int) -> str:
    """Return ``name~number``, with a hash for the end of a name that is too long for an id."""
    limit = MAX_ID - 40
    if len(name) > limit:
        name = f"{name[: limit - 17]}~{hashlib.sha256(name.encode()).hexdigest()[:16]}"
    return f"{name}~{number}"


# --- joining ---


def join(layers: Layers) -> Layers:
    """Restore the edges that ``split`` has split, if nothing else uses the nodes at their bends."""
    parts = {key: _join_part(part) for key, part in layers.vector("topology").items()}
    changed = {key: part for key, part in parts.items() if part is not layers.parts[key]}
    return replace(layers, parts={**layers.parts, **changed}) if changed else layers


def _join_part(part: Features) -> Features:
    chains: dict[str, dict[int, int]] = defaultdict(dict)
    for k, (i, p) in enumerate(zip(part.ids, part.properties, strict=True)):
        bend = _parse_bend_name(i, p) if p.get("kind") == "node" else None
        if bend is not None:
            chains[bend[0]][bend[1]] = k
    if not chains:
        return part
    network = _Network(part)
    for base, numbered in chains.items():
        if set(numbered) == set(range(1, len(numbered) + 1)):
            network.join(base, [numbered[n] for n in range(1, len(numbered) + 1)])
    return network.join_edges()


def _parse_bend_name(i: str, p: Properties) -> tuple[str, int] | None:
    """Split a bend's name into base and number; None for other nodes."""
    for name in (i, p.get("name")):
        match = NAMED.match(name) if isinstance(name, str) and "~" in name else None
        if match is not None and "~" in match[1]:
            return match[1], int(match[2])
    return None


class _Network:
    """A network while edges are joined. touching: indices of the edges at each node, by id."""

    def __init__(self, part: Features) -> None:
        self.part = part
        self.nodes = {
            i: k for k, (i, p) in enumerate(zip(part.ids, part.properties, strict=True)) if p.get("kind") == "node"
        }
        self.touching: dict[str, list[int]] = defaultdict(list)
        for k, p in enumerate(part.properties):
            if _is_edge(p):
                for end in {p["source"], p["target"]}:
                    self.touching[end].append(k)
        self.gone: set[int] = set()
        self.whole = _Columns()

    def join(self, base: str, bends: Sequence[int]) -> None:
        """Join the edges over a chain of bends, if they are exactly what ``split`` makes."""
        part = self.part
        ids = [part.ids[k] for k in bends]
        near = {k for i in ids for k in self.touching[i]}
        pairs = {(part.properties[k]["source"], part.properties[k]["target"]): k for k in near}
        chain = self._chain(base, ids, pairs)
        if chain is None or len(pairs) < len(near):
            return
        runs = []
        for path in [chain] if chain == chain[::-1] else [chain, chain[::-1]]:
            steps = [step for step in pairwise(path) if step in pairs]
            if steps and len(steps) < len(path) - 1:
                return
            if steps:
                runs.append((path, [pairs[step] for step in steps]))
        if sum(len(run) for _, run in runs) < len(near) or not all(self._is_uniform(run) for _, run in runs):
            return
        if any(part.local[k] != part.local[bends[0]] for _, run in runs for k in run):
            return
        self.gone |= {*bends, *near}
        bend_properties = [
            {w: v for w, v in part.properties[k].items() if v and (w, v) != ("name", part.ids[k])} for k in bends
        ]
        for p in bend_properties:
            del p["kind"]
        for path, run in runs:
            self._add(path, run, {BENDS: bend_properties} if any(bend_properties) else {})

    def _chain(self, base: str, ids: Sequence[str], pairs: Mapping[tuple[str, str], int]) -> list[str] | None:
        """Return the nodes from one end over the bends to the other end; None if these are not the ends."""
        inner = set(ids)
        firsts, lasts = (
            {other for a, b in pairs for node, other in ((a, b), (b, a)) if node == end} - inner
            for end in (ids[0], ids[-1])
        )
        for first in sorted(firsts):
            for last in sorted(lasts):
                for a in self._names(first):
                    for b in self._names(last):
                        if base == f"{a}~{b}" or re.fullmatch(re.escape(f"{a}~{b}~") + "[0-9a-f]{6}", base):
                            return [first, *ids, last]
        return None

    def _names(self, i: str) -> list[str]:
        k = self.nodes.get(i)
        name = None if k is None else self.part.properties[k].get("name")
        return [i, name] if isinstance(name, str) and name != i else [i]

    def _is_uniform(self, run: Sequence[int]) -> bool:
        """Return whether the pieces differ only in their ends; otherwise they were edited one by one."""
        ends = {"source", "target"}
        run_properties = [drop_identity(self.part.properties[k]) for k in run]
        first, *others = ({name: v for name, v in p.items() if name not in ends} for p in run_properties)
        return all(other == first for other in others)

    def _add(self, path: Sequence[str], run: Sequence[int], extra_properties: Properties) -> None:
        part = self.part
        numbers = [NAMED.match(part.ids[k]) for k in run]
        names = {m[1] for n, m in enumerate(numbers) if m is not None and int(m[2]) == n + 1}
        i = next(iter(names)) if len(names) == 1 and None not in numbers else f"{path[0]}_{path[-1]}"
        steps = [shapely.get_coordinates(part.geometry[k], include_z=True) for k in run]
        at = np.concatenate([steps[0][:1], *(step[-1:] for step in steps)])
        line = shapely.linestrings(at[:, :2] if np.isnan(at[:, 2]).any() else at)
        p = {**drop_identity(part.properties[run[0]]), "source": path[0], "target": path[-1], **extra_properties}
        self.whole.ids.append(i)
        self.whole.geometry.append(line)
        self.whole.properties.append(p)
        self.whole.local.append(bool(part.local[run[0]]))

    def join_edges(self) -> Features:
        """Return the network with these edges."""
        if not self.gone:
            return self.part
        rest = self.part.select([k for k in range(len(self.part)) if k not in self.gone])
        self.whole.ids = unique_ids(self.whole.ids, set(rest.ids))
        return self.whole.after(rest)

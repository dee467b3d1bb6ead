"""All networks of a site as one graph in arrays, in local metres.

SciPy is imported where it is used: the server's own process, which only names the rules, starts without it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.errors import Invalid, MissingDatum
from app.model.features import Features, Properties
from app.model.layers import Layers, PartKey
from app.review.lifts import lift_stops

if TYPE_CHECKING:
    from scipy.sparse import csr_array

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Item:
    """One node or edge: its part, its row there, and its properties."""

    id: str
    key: PartKey
    row: int
    properties: Properties


@dataclass(frozen=True)
class Network:
    """Nodes and directed edges of all parts and levels.

    Attributes:
        xy: float64 [nodes, 2], metres; NaN if the position cannot be converted to the local frame.
        source, target: int64 [edges], indices of nodes; -1 if there is none.
        lines: object [edges], shapely geometries in metres; empty if they cannot be converted.
        parts: the features as they are stored.
        lifts: nodes at each lift with stops on several levels, by its name: a lift connects them without edges.
    """

    nodes: tuple[Item, ...]
    edges: tuple[Item, ...]
    xy: Floats
    source: Indices
    target: Indices
    lines: NDArray[np.object_]
    parts: Mapping[PartKey, Features]
    lifts: Mapping[str, list[int]]

    @cached_property
    def is_whole(self) -> Mask:
        """Which edges have both nodes."""
        return (self.source >= 0) & (self.target >= 0)

    @cached_property
    def is_open(self) -> Mask:
        """Which edges robots may use: those with both nodes that are not marked as blocked."""
        marked = np.array([edge.properties.get("blocked") is True for edge in self.edges], bool)
        out: Mask = self.is_whole & ~marked
        return out

    @cached_property
    def node_levels(self) -> NDArray[np.object_]:
        """Level of each node."""
        return np.array([node.key.level for node in self.nodes], object)

    @cached_property
    def edge_levels(self) -> NDArray[np.object_]:
        """Level of each edge."""
        return np.array([edge.key.level for edge in self.edges], object)

    @cached_property
    def is_flat(self) -> Mask:
        """Which edges have both nodes on their own level and a line."""
        same = np.zeros(len(self.edges), bool)
        k = np.flatnonzero(self.is_whole)
        same[k] = (self.node_levels[self.source[k]] == self.edge_levels[k]) & (
            self.node_levels[self.target[k]] == self.edge_levels[k]
        )
        out: Mask = same & (shapely.get_type_id(self.lines) == 1) & ~shapely.is_empty(self.lines)
        return out

    @property
    def levels(self) -> list[str]:
        """All levels with a network."""
        return sorted({key.level for key in self.parts})

    def graph(self, usable: Mask) -> csr_array:
        """Return the adjacency matrix of these edges and of lifts."""
        from scipy.sparse import csr_array

        k = np.flatnonzero(usable)
        n = len(self.nodes)
        rides = [(stops[0], stop) for stops in self.lifts.values() for stop in stops[1:]]
        ride = np.array(rides, np.int64).reshape(-1, 2)
        start = np.concatenate([self.source[k], ride[:, 0], ride[:, 1]])
        end = np.concatenate([self.target[k], ride[:, 1], ride[:, 0]])
        return csr_array((np.ones(len(start), np.int8), (start, end)), shape=(n, n))


def build_network(layers: Layers) -> Network:
    """Build the graph of a site. Edges refer to nodes of their own part first, then of other parts."""
    nodes: list[Item] = []
    edges: list[Item] = []
    places: list[Floats] = []
    lines: list[NDArray[np.object_]] = []
    homes: dict[PartKey, dict[str, int]] = {}
    parts = layers.vector("topology")
    for key, part in parts.items():
        geometry = _in_metres(part, layers)
        rows = {kind: [k for k, p in enumerate(part.properties) if p.get("kind") == kind] for kind in ("node", "edge")}
        homes[key] = {part.ids[k]: len(nodes) + n for n, k in enumerate(rows["node"])}
        nodes += [Item(part.ids[k], key, k, part.properties[k]) for k in rows["node"]]
        edges += [Item(part.ids[k], key, k, part.properties[k]) for k in rows["edge"]]
        points = geometry[rows["node"]]
        is_point = (shapely.get_type_id(points) == 0) & ~shapely.is_empty(points)
        xy = np.full((len(points), 2), np.nan)
        xy[is_point] = shapely.get_coordinates(points[is_point])
        places.append(xy)
        lines.append(geometry[rows["edge"]])
    everywhere = {i: k for home in reversed(homes.values()) for i, k in home.items()}
    ends = {
        end: np.array([_node(edge.properties.get(end), homes[edge.key], everywhere) for edge in edges], np.int64)
        for end in ("source", "target")
    }
    xy = np.concatenate(places) if places else np.empty((0, 2))
    return Network(
        tuple(nodes),
        tuple(edges),
        xy,
        ends["source"],
        ends["target"],
        np.concatenate(lines) if lines else np.empty(0, object),
        parts,
        lift_stops(layers, [node.key.level for node in nodes], [node.properties for node in nodes], xy),
    )


def _node(node: Any, home: Mapping[str, int], everywhere: Mapping[str, int]) -> int:
    return home.get(node, everywhere.get(node, -1)) if isinstance(node, str) else -1


def _in_metres(part: Features, layers: Layers) -> NDArray[np.object_]:
    try:
        return part.in_local(layers.frame)
    except (MissingDatum, Invalid):
        out: NDArray[np.object_] = np.full(len(part), shapely.LineString(), object)
        return out


@dataclass(frozen=True, slots=True)
class Reach:
    """Connection of nodes to the largest strongly connected part of their network.

    Attributes:
        main: bool [nodes], the nodes in that part. from_main, to_main: reachable from it; it is reachable from there.
        group: int64 [nodes], the strongly connected part of each node.
        trivial: bool [nodes], those of networks without two nodes between which a robot can go and come back; they
            count as reachable.
    """

    main: Mask
    from_main: Mask
    to_main: Mask
    group: Indices
    trivial: Mask

    @property
    def both(self) -> Mask:
        """Which nodes can be reached and left again."""
        return self.from_main & self.to_main


MAX_NETWORKS = 50
"""Maximum number of names of networks whose largest parts are searched; the others count as reachable."""


def reach(network: Network, usable: Mask) -> Reach:
    """Search the largest strongly connected part of each network (the parts with one name), and what it reaches."""
    from scipy.sparse.csgraph import breadth_first_order, connected_components

    n = len(network.nodes)
    graph = network.graph(usable)
    _, group = connected_components(graph, directed=True, connection="strong") if n else (0, np.empty(0, np.int64))
    out = Reach(np.zeros(n, bool), np.zeros(n, bool), np.zeros(n, bool), group.astype(np.int64), np.zeros(n, bool))
    if not n:
        return out
    names = np.array([node.key.name for node in network.nodes], object)
    backward = graph.T.tocsr()
    for number, name in enumerate(sorted(set(names.tolist()))):
        members = np.flatnonzero(names == name)
        labels, counts = np.unique(group[members], return_counts=True)
        if counts.max() < 2 or number >= MAX_NETWORKS:
            for mask in (out.main, out.from_main, out.to_main, out.trivial):
                mask[members] = True
            continue
        start = members[group[members] == labels[counts.argmax()]]
        out.main[start] = True
        for matrix, mask in ((graph, out.from_main), (backward, out.to_main)):
            mask[breadth_first_order(matrix, int(start[0]), directed=True, return_predecessors=False)] = True
    return out


def weak_groups(network: Network, usable: Mask, chosen: Mask) -> list[Indices]:
    """Group chosen nodes by connection among themselves, the largest group first."""
    from scipy.sparse.csgraph import connected_components

    inner = usable.copy()
    k = np.flatnonzero(usable)
    inner[k] = chosen[network.source[k]] & chosen[network.target[k]]
    _, label = connected_components(network.graph(inner), directed=False)
    members = np.flatnonzero(chosen)
    order = members[np.argsort(label[members], kind="stable")]
    if not len(order):
        return []
    cuts = np.flatnonzero(np.diff(label[order])) + 1
    return sorted(np.split(order.astype(np.int64), cuts), key=lambda group: (-len(group), int(group[0])))

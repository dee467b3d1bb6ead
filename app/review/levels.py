"""The network of one level, with edges along one line taken together."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import shapely
from numpy.typing import NDArray

from app.model.features import Properties
from app.review.network import Mask, Network

NEAR_METRES = 0.5
NEAR_SHARE = 0.25
"""A node nearer than NEAR_METRES to an edge misses it, in a dense network nearer than this share of the median edge."""

ON_METRES = 1e-6
"""Difference in length of two edges along one line, in metres."""

BLOCK = 64
"""Number of geometries that are looked up in a tree at a time, so that a block of a hostile network fits in memory."""

LEVEL_GROUND = ("no", "no", "no")


def height_tags(properties: Properties) -> tuple[str, ...]:
    """Return what OpenStreetMap states on the height of a way: its bridge, tunnel and layer."""
    source_properties = properties.get("osm")
    tags = source_properties.get("tags") if isinstance(source_properties, Mapping) else None
    if not isinstance(tags, Mapping):
        return ()
    return tuple(str(tags.get(word) or "no") for word in ("bridge", "tunnel", "layer"))


class LevelNetwork:
    """Nodes and undirected edges of one level: of edges between two nodes along one line the first."""

    def __init__(self, network: Network, level: str) -> None:
        on_level = (network.node_levels == level) & np.isfinite(network.xy).all(axis=1)
        self.nodes = np.flatnonzero(on_level)
        self.edges: list[int] = []
        self.twins: dict[int, list[int]] = {}
        firsts: dict[tuple[int, int], list[int]] = {}
        source, target = network.source.tolist(), network.target.tolist()  # plain numbers are faster one by one
        lengths = shapely.length(network.lines).tolist()
        for k in np.flatnonzero(network.is_flat & (network.edge_levels == level)).tolist():
            a, b = source[k], target[k]
            parallel = firsts.setdefault((a, b) if a < b else (b, a), [])
            twin = next((j for j in parallel if abs(lengths[j] - lengths[k]) < ON_METRES), None)
            if twin is None and len(parallel) < BLOCK:
                parallel.append(k)
                self.edges.append(k)
            self.twins.setdefault(k if twin is None else twin, []).append(k)
        self.lines = network.lines[self.edges]
        self.tree = shapely.STRtree(self.lines)
        typical = float(np.median([lengths[k] for k in self.edges])) if self.edges else 0.0
        self.near = min(NEAR_METRES, NEAR_SHARE * typical)
        self._network = network
        self.neighbours: dict[int, set[int]] = defaultdict(set)
        for k in np.flatnonzero(network.is_whole).tolist():
            self.neighbours[source[k]].add(target[k])
            self.neighbours[target[k]].add(source[k])

    @cached_property
    def ways(self) -> Ways:
        """Edges that robots may use."""
        ids: list[tuple[str, ...]] = []
        firsts: list[int] = []
        edges = self._network.edges
        for first in self.edges:
            usable = [k for k in self.twins[first] if self._network.is_open[k]]
            if usable:
                ids.append(tuple(edges[k].id for k in usable))
                firsts.append(usable[0])
        on_ground = [height_tags(edges[k].properties) in ((), LEVEL_GROUND) for k in firsts]
        return Ways(tuple(ids), self._network.lines[firsts], np.array(on_ground, bool))


@dataclass(frozen=True, slots=True)
class Ways:
    """Lines of a level on which robots may drive.

    Attributes:
        ids: of the edges along each line. on_ground: bool [n], neither on a bridge nor in a tunnel.
    """

    ids: tuple[tuple[str, ...], ...]
    lines: NDArray[np.object_]
    on_ground: Mask

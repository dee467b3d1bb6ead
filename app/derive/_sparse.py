"""Thin out a network: one node where several are close together, and branches only into ground that needs them."""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from app.derive._skeleton import FreeSpace, Graph, add_edges, lengths, near_pairs, tidy

ROUNDS = 8
"""Maximum number of times that all close pairs are looked at: merged nodes may be close to others."""

NEAREST = 6
"""Maximum number of close nodes that one is paired with in a round."""

MAX_VISITED = 100
"""Maximum number of nodes that a search for another way visits: mazes of single cells have thousands nearby."""

SHORT_WAY = 5.0
"""A way that is at most so many times as long replaces a passage too tight for nodes at a distance."""


def merge_close(graph: Graph, free_space: FreeSpace, *, distance: float, island: float) -> tuple[Graph, int]:
    """Merge nodes less than ``distance`` cells apart, closest first, as far as edges stay collision-free.

    One node of a pair takes over the edges of the other: the one with more edges, else the one farther from obstacles.
    Where obstacles allow no such merging, ``_Merging.merge`` says what else is tried. island: a piece of the network
    behind a passage too tight for nodes at this distance is dropped if it is smaller. Returns the graph and the number
    of such pieces.
    """
    dropped, changed = 0, {*map(tuple, graph.nodes.tolist())}
    for _ in range(ROUNDS):
        pairs = [
            (a, b)
            for a, b in _shortest_first(graph, near_pairs(graph.nodes, distance * (1.0 - 1e-9), NEAREST))
            if tuple(graph.nodes[a]) in changed or tuple(graph.nodes[b]) in changed
        ]
        if not pairs:
            break
        merging = _Merging(graph, free_space)
        for a, b in pairs:
            merging.merge(a, b, distance, island)
        graph, changed = merging.graph(), merging.changed
        dropped += merging.pieces
    return graph, dropped


def thin_out(graph: Graph, free_space: FreeSpace, *, share: float, radius: float, tolerance: float) -> Graph:
    """Merge junctions that are one place, and drop bends that are none. Lengths are in cells.

    Joined junctions are one place if they are less than ``share`` of their distance to obstacles apart. A node that
    only joins two others goes if it is no farther from their straight, collision-free line than half the distance by
    which a robot of this radius can move there, and ``tolerance``.
    """
    merging = _Merging(graph, free_space)
    # rounded: values that are equal by their integers decide alike on every machine
    radii = np.round(share * merging.clearance[graph.edges].max(axis=1), 9)
    near = np.round(lengths(graph.nodes, graph.edges), 9) < radii
    for a, b in _shortest_first(graph, graph.edges[near]):
        if merging.is_junction(a) and merging.is_junction(b):
            merging.join(a, b)
    for node in np.argsort(merging.clearance, kind="stable").tolist():
        merging.straighten(node, min(tolerance, max(1.0, (merging.clearance[node] - radius) / 2.0)))
    return merging.graph()


def _shortest_first(graph: Graph, pairs: NDArray[np.int64]) -> list[tuple[int, int]]:
    apart = np.round(lengths(graph.nodes, pairs), 9)
    ordered = np.sort(pairs, axis=1)[np.lexsort((pairs.max(axis=1), pairs.min(axis=1), apart))]
    return [(a, b) for a, b in ordered.tolist()]


class _Merging:
    """A graph while its nodes are merged. Nodes keep their indices. pieces: number of pieces cut off.

    changed: cells of nodes that moved or have other edges than before.
    """

    def __init__(self, graph: Graph, free_space: FreeSpace) -> None:
        from app.derive import _kernels_roadmap, _kernels_space

        self._kernels = _kernels_roadmap
        self._clear = _kernels_space.clear
        self._mask = free_space.mask
        self._at: list[tuple[int, int]] = [(y, x) for y, x in graph.nodes.tolist()]
        self._near: list[set[int]] = [set() for _ in self._at]
        for a, b in graph.edges.tolist():
            self._near[a].add(b)
            self._near[b].add(a)
        self._alive = [True] * len(self._at)
        self.pieces = 0
        self.changed: set[tuple[int, int]] = set()
        self.clearance = np.zeros(len(self._at))
        _kernels_space.clearances(free_space.gap, graph.nodes, self.clearance)

    def merge(self, a: int, b: int, distance: float, island: float) -> bool:
        """Make one node of two that are less than this apart, or move or drop one, if possible; return whether it was.

        What is tried, in order: one of both, or a cell near them, takes all edges; a node that only joins two others is
        left out, if these see each other, or cut off (``_cut``); one is moved away.
        """
        if not (self._alive[a] and self._alive[b]) or math.dist(self._at[a], self._at[b]) >= distance * (1.0 - 1e-9):
            return False
        first, second = self._ranked(a, b)
        return (
            self.join(a, b, distance)
            or any(self._bypass(k) for k in (second, first))
            or any(self._cut(k, distance, island) for k in (second, first))
            or any(self._move(k, other, distance) for k, other in ((second, first), (first, second)))
        )

    def join(self, a: int, b: int, around: float = 0.0) -> bool:
        """Merge two nodes that see each other at one of them, between them, or this far around, if all edges allow."""
        if not (self._alive[a] and self._alive[b] and self._sees(self._at[a], self._at[b])):
            return False
        first, second = self._ranked(a, b)
        others = (self._near[a] | self._near[b]) - {a, b}
        for cell in (self._at[first], self._at[second]):
            if all(self._sees(cell, self._at[k]) for k in others):
                break
        else:
            (y0, x0), (y1, x1) = self._at[a], self._at[b]
            cell = self._meeting(((y0 + y1) // 2, (x0 + x1) // 2), 0.0, around, others)
            if cell[0] < 0:
                return False
        self._at[first] = cell
        self.changed.add(cell)
        self._drop(second)
        for k in others:
            self._near[k].add(first)
        self._near[first] |= others
        return True

    def is_junction(self, node: int) -> bool:
        """Return whether three or more edges meet at a node."""
        return len(self._near[node]) > 2

    def straighten(self, node: int, leeway: float) -> None:
        """Drop a node that joins two others if these see each other and it is close to their line."""
        if len(self._near[node]) != 2:
            return
        (y, x), (a, b) = self._at[node], (self._at[k] for k in sorted(self._near[node]))
        length = math.dist(a, b)
        if not length or abs((b[0] - a[0]) * (x - a[1]) - (b[1] - a[1]) * (y - a[0])) <= leeway * length + 1e-9:
            self._bypass(node)

    def _ranked(self, a: int, b: int) -> list[int]:
        return sorted((a, b), key=lambda k: (-len(self._near[k]), -self.clearance[k], self._at[k]))

    def _bypass(self, node: int) -> bool:
        """Drop a node that is an end, or joins two nodes that see each other."""
        ends = sorted(self._near[node])
        if len(ends) == 2 and self._sees(self._at[ends[0]], self._at[ends[1]]):
            self._near[ends[0]].add(ends[1])
            self._near[ends[1]].add(ends[0])
        elif len(ends) != 1 or len(self._near[ends[0]]) == 1:
            return False
        self._drop(node)
        return True

    def _drop(self, node: int) -> None:
        self.changed |= {self._at[k] for k in self._near[node]}
        for k in self._near[node]:
            self._near[k].discard(node)
        self._near[node] = set()
        self._alive[node] = False

    def _cut(self, node: int, distance: float, island: float) -> bool:
        """Drop a node that joins two others if another way between them is short, or only a small piece is behind it.

        Short is at most SHORT_WAY times as long. Small is a piece within ``island`` of the node.
        """
        if len(self._near[node]) != 2:
            return False
        start, end = sorted(self._near[node])
        way = sum(math.dist(self._at[node], self._at[k]) for k in (start, end))
        if end in self._reached(start, node, SHORT_WAY * max(way, 2.0 * distance)):
            self._drop(node)
            return True
        for first in (start, end):
            piece = self._piece(first, node, island)
            if piece:
                for k in (node, *piece):
                    self._drop(k)
                self.pieces += 1
                return True
        return False

    def _piece(self, first: int, node: int, island: float) -> set[int]:
        """Return all nodes that one is joined with when another is gone, if all are within ``island`` of that one."""
        piece: set[int] = set()
        for k in self._reached(first, node, 2.0 * island):
            if math.dist(self._at[node], self._at[k]) >= island:
                return set()
            piece.add(k)
        joined = {node, *piece}
        is_whole = len(piece) <= MAX_VISITED and all(self._near[member] <= joined for member in piece)
        return piece if is_whole else set()

    def _reached(self, start: int, without: int, limit: float) -> Iterator[int]:
        """Yield the nodes reached from one along edges within a length, without using a node."""
        lengths, queue = {start: 0.0}, [(0.0, start)]
        yield start
        while queue and len(lengths) <= MAX_VISITED:
            far, current = heapq.heappop(queue)
            for k in self._near[current]:
                if k == without:
                    continue
                length = far + math.dist(self._at[current], self._at[k])
                shortest = lengths.get(k)
                if length <= limit and (shortest is None or length < shortest):
                    lengths[k] = length
                    heapq.heappush(queue, (length, k))
                    if shortest is None:
                        yield k

    def _move(self, node: int, other: int, distance: float) -> bool:
        """Move a node away from another one."""
        if not self._near[node]:
            return False
        cell = self._meeting(self._at[other], distance, 2.0 * distance, self._near[node])
        if cell[0] < 0:
            return False
        self._at[node] = cell
        self.changed.add(cell)
        return True

    def _meeting(self, cell: tuple[int, int], near: float, far: float, others: set[int]) -> tuple[int, int]:
        """Return the cell nearest to this one that sees all of these nodes; (-1, -1) if there is none."""
        if far <= 0.0:
            return -1, -1
        cells = np.array([self._at[k] for k in sorted(others)], np.int64).reshape(-1, 2)
        y, x = self._kernels.meeting(self._mask, cell[0], cell[1], near, far, cells)
        return int(y), int(x)

    def _sees(self, a: tuple[int, int], b: tuple[int, int]) -> bool:
        return bool(self._clear(self._mask, a[0], a[1], b[0], b[1]))

    def graph(self) -> Graph:
        """Return the graph of the remaining nodes."""
        alive = np.array(self._alive)
        place = np.cumsum(alive) - 1
        nodes = np.array(self._at, np.int64).reshape(-1, 2)[alive]
        links = [(place[a], place[b]) for a, near in enumerate(self._near) for b in near if a < b]
        return tidy(nodes, np.array(links, np.int64).reshape(-1, 2))


def cover(graph: Graph, free_space: FreeSpace, *, reach: float, detour: float, phase: tuple[float, float]) -> Graph:
    """Add nodes where much ground is more than ``reach`` cells from the network, and edges that avoid a detour.

    The nodes are chosen on a lattice of half the reach that begins at ``phase`` (row, column), so that they stay in
    place when the map grows: each covers the most ground that none before covered, and at least a third of what it
    would cover in the open.
    """
    from app.derive import _kernels_roadmap as kernels

    step = max(reach / 2.0, 1.0)
    rows, columns = (
        np.unique(np.rint(np.arange(begin % step, size - 1, step)).astype(np.int64))
        for begin, size in zip(phase, free_space.mask.shape, strict=True)
    )
    state = free_space.mask[np.ix_(rows, columns)]
    at = np.argwhere(state)
    if len(at):
        cells = np.stack([rows[at[:, 0]], columns[at[:, 1]]], axis=1)
        state[at[:, 0], at[:, 1]] += _is_covered(cells, graph, free_space, reach).astype(np.uint8)
        kernels.cover(free_space.mask, rows, columns, state, reach, max(1, int(np.pi * (reach / step) ** 2 / 3.0)))
        at = np.argwhere(state == 3)
    return add_edges(graph, free_space, np.stack([rows[at[:, 0]], columns[at[:, 1]]], axis=1), detour, 4.0 * reach)


def _is_covered(cells: NDArray[np.int64], graph: Graph, free_space: FreeSpace, reach: float) -> NDArray[np.bool_]:
    """Return for each cell whether one of the nearest places on the network is near and sees it."""
    from scipy.spatial import cKDTree

    from app.derive import _kernels_space as kernels
    from app.derive._skeleton import divide_edges

    places = divide_edges(graph, free_space, max(reach / 4.0, 2.0)).nodes
    count = min(6, len(places))
    away, near = cKDTree(places).query(cells, k=count, distance_upper_bound=reach)
    cell, place = np.nonzero(np.isfinite(away.reshape(len(cells), count)))
    both = np.concatenate([cells, places])
    pairs = np.stack([cell, near.reshape(len(cells), count)[cell, place] + len(cells)], axis=1).astype(np.int64)
    good = np.zeros(len(pairs), np.uint8)
    kernels.clear_pairs(free_space.mask, both, pairs, good)
    covered = np.zeros(len(cells), bool)
    covered[cell[good == 1]] = True
    return covered

"""Free space and its skeleton as arrays of cells: what the kernels are called through."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.model.grid import FREE, UNKNOWN, OccupancyGrid


@dataclass(frozen=True, slots=True, eq=False)
class FreeSpace:
    """Where a round robot's centre may be.

    mask: uint8 [h, w], 1 where it may; a border of zeros all around. gap: uint16 [h, w], distance to the next obstacle
    in the cell's column. row, column: the grid's cell at which (0, 0) of these arrays lies. cells: how many may be.
    """

    mask: NDArray[np.uint8]
    gap: NDArray[np.uint16]
    row: int
    column: int
    cells: int


@dataclass(frozen=True, slots=True, eq=False)
class Graph:
    """nodes: int64 [n, 2] row and column in a Space; edges: int64 [m, 2] places of nodes, each pair once."""

    nodes: NDArray[np.int64]
    edges: NDArray[np.int64]


def free_cells(grid: OccupancyGrid, unknown: bool) -> tuple[NDArray[np.uint8], int, int] | None:
    """1 where a cell is free (or unknown, where that counts), cut to what is free with a border of zeros.

    With the row and column of the grid at which the cut begins; None where nothing is free.
    """
    free = grid.cells == FREE
    if unknown:
        free |= grid.cells == UNKNOWN
    rows, columns = np.flatnonzero(free.any(axis=1)), np.flatnonzero(free.any(axis=0))
    if not len(rows):
        return None
    top, bottom, left, right = int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1
    out = np.zeros((bottom - top + 2, right - left + 2), np.uint8)
    out[1:-1, 1:-1] = free[top:bottom, left:right]
    return out, top - 1, left - 1


def space(free: NDArray[np.uint8], row: int, column: int, radius: float) -> FreeSpace:
    """The places for a robot of this radius (cells): farther than it from every obstacle's centre."""
    from app.derive import _kernels_space as kernels

    gap = np.empty(free.shape, np.uint16)
    kernels.gaps(free, gap)
    # A hair more, so that 0.3 m in cells of 0.05 m are 6 and not 5.999…: what touches, collides.
    count = kernels.erode(gap, (radius * (1.0 + 1e-9)) ** 2, free)
    return FreeSpace(free, gap, row, column, int(count))


def widest(free_space: FreeSpace) -> float:
    """How far the freest cell is from obstacles, in cells."""
    from app.derive import _kernels_space as kernels

    low, high = 0.0, float(max(free_space.mask.shape))
    while high - low > 0.01:
        middle = (low + high) / 2.0
        if kernels.erode(free_space.gap, middle * middle, free_space.mask):
            low = middle
        else:
            high = middle
    return low


def skeleton(
    free_space: FreeSpace, *, merge: float, spur: float, tolerance: float, island: float, voronoi: bool = False
) -> tuple[Graph, int]:
    """The skeleton of a space as a graph of straight, collision-free edges. Lengths are in cells.

    merge: junctions nearer than this along the skeleton are one. spur: dead ends that reach less than this beyond the
    free circle of their junction are cut. tolerance: how far a straight edge may be from the skeleton. island: pieces
    smaller than this across are left out (the largest always stays); how many is told. voronoi: of the generalised
    Voronoi diagram, farthest from obstacles everywhere, instead of Zhang and Suen's skeleton.
    """
    from app.derive import _kernels_skeleton as kernels
    from app.derive._kernels_thinning import thin

    thinned = free_space.mask.copy()
    cells = np.empty((ridges(thinned, free_space.gap) if voronoi else thin(thinned), 2), np.int32)
    rows = np.empty(len(thinned) + 1, np.int64)
    kernels.list_cells(thinned, cells, rows)
    raw = kernels.trace(thinned, cells, rows)
    del thinned
    merged = kernels.contract(raw, free_space.gap, cells, merge)
    lone, begin, path = kernels.chains(merged, kernels.prune(merged, free_space.gap, cells, spur))
    keep = np.zeros(len(path), np.uint8)
    kernels.simplify(free_space.mask, cells, begin, path, tolerance, keep)
    corner = path[keep == 1]
    line = np.repeat(np.arange(len(begin) - 1), np.diff(begin))[keep == 1]
    along = line[1:] == line[:-1]
    pairs = np.stack([corner[:-1][along], corner[1:][along]], axis=1)
    used = np.unique(np.concatenate([corner, lone]))
    edges = np.sort(np.searchsorted(used, pairs), axis=1)
    edges = np.unique(edges[edges[:, 0] != edges[:, 1]], axis=0)
    graph = Graph(cells[used].astype(np.int64), edges.astype(np.int64))
    return drop_islands(graph, free_space, island)


BAND = 2**25
"""Cells that are sorted at a time."""


def ridges(mask: NDArray[np.uint8], gap: NDArray[np.uint16]) -> int:
    """Thin a mask in place to the generalised Voronoi diagram; how many cells are left.

    It takes 2 bytes a cell, and some for those that are left: cells are sorted by their distance a part at a time.
    """
    from app.derive import _kernels_voronoi as kernels

    rank = np.empty(mask.shape, np.uint16)
    # In 16 bits a distance is exact to 1/65535 of the largest; below 181 cells no two different ones are the same.
    largest = np.sqrt(np.float32(kernels.farthest(mask, gap)))
    kernels.anchors(mask, gap, 65535.0 / max(float(largest), 1.0), rank)
    for order in _cells_by_rank(mask, rank, BAND):
        kernels.thin(mask, order, rank)
    left = np.concatenate([*_cells_by_rank(mask, rank, BAND), np.empty(0, np.int32)])
    return int(kernels.finish(mask, left))


def _cells_by_rank(mask: NDArray[np.uint8], rank: NDArray[np.uint16], limit: int) -> Iterator[NDArray[np.int32]]:
    """The set cells as places in the flat mask, sorted by rank, then place; about ``limit`` at a time.

    Those of higher ranks may not change meanwhile.
    """
    from app.derive import _kernels_voronoi as kernels

    counts = np.zeros(2**16, np.int64)
    kernels.count_ranks(mask, rank, counts)
    low = 0
    while low < len(counts):
        fit = int(np.searchsorted(np.cumsum(counts[low:]), limit, side="right"))
        high = low + max(1, fit)
        band_counts = counts[low:high]
        if band_counts.any():
            order = np.empty(int(band_counts.sum()), np.int32)
            kernels.sort_band(mask, rank, low, high, np.cumsum(band_counts) - band_counts, order)
            yield order
        low = high


def drop_islands(graph: Graph, free_space: FreeSpace, island: float) -> tuple[Graph, int]:
    """The graph without pieces that are less than ``island`` cells across, but always with the largest one.

    And how many such pieces there were.
    """
    from app.derive import _kernels_space as kernels

    count, piece = pieces(graph)
    if count < 2:
        return graph, 0
    low, high = np.full((count, 2), 2**31), np.full((count, 2), -1)
    np.minimum.at(low, piece, graph.nodes)
    np.maximum.at(high, piece, graph.nodes)
    clearance = np.zeros(len(graph.nodes))
    kernels.clearances(free_space.gap, graph.nodes, clearance)
    widest = np.zeros(count)
    np.maximum.at(widest, piece, clearance)
    across = np.hypot(*(high - low).T) + 2.0 * widest
    stays = across >= island
    stays[int(np.argmax(across))] = True
    return subgraph(graph, stays[piece]), int(count - stays.sum())


def pieces(graph: Graph) -> tuple[int, NDArray[np.int64]]:
    """How many connected pieces a graph has, and which one each node is in."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    n = len(graph.nodes)
    if not n:
        return 0, np.empty(0, np.int64)
    ones = np.ones(len(graph.edges), np.uint8)
    links = coo_array((ones, (graph.edges[:, 0], graph.edges[:, 1])), (n, n))
    count, piece = connected_components(links, directed=False)
    return int(count), piece.astype(np.int64)


def subgraph(graph: Graph, mask: NDArray[np.bool_]) -> Graph:
    """Some nodes (whole pieces) with their edges."""
    place = np.cumsum(mask) - 1
    return Graph(graph.nodes[mask], place[graph.edges[mask[graph.edges[:, 0]]]])


def add_open_edges(
    graph: Graph, free_space: FreeSpace, *, spacing: float, detour: float, phase: tuple[float, float] = (0.0, 0.0)
) -> Graph:
    """The graph with nodes ``spacing`` cells apart also in the open, and the straight ways that save a detour.

    Nodes are put along edges and on a lattice that begins at ``phase`` (row, column), so that it stays where it is when
    the map grows. Of the lines of their Delaunay triangulation that are collision-free, those are taken without which
    the way between their ends would be more than ``detour`` times as long.
    """
    from app.derive import _kernels_roadmap as kernels

    graph = divide_edges(graph, free_space, spacing)
    node_count = len(graph.nodes)
    nodes = np.concatenate([graph.nodes, _lattice(graph, free_space, spacing, phase)])
    pairs = _triangulate(nodes)
    pairs = pairs[lengths(nodes, pairs) <= 4.0 * spacing]
    pairs = drop_blocked(pairs, nodes, free_space)
    straight = lengths(nodes, pairs)
    order = np.lexsort((pairs[:, 1], pairs[:, 0], straight))
    pairs, straight = pairs[order], straight[order]
    taken = np.zeros(len(pairs), np.uint8)
    kernels.spanner(len(nodes), graph.edges, lengths(nodes, graph.edges), pairs, straight, detour, taken)
    full = Graph(nodes, np.concatenate([graph.edges, pairs[taken == 1]]))
    # Lattice nodes in pieces that the graph left out go again.
    count, piece = pieces(full)
    connected = np.zeros(count, bool)
    connected[piece[:node_count]] = True
    full = subgraph(full, connected[piece])
    return tidy(full.nodes, full.edges)


def drop_blocked(pairs: NDArray[np.int64], nodes: NDArray[np.int64], free_space: FreeSpace) -> NDArray[np.int64]:
    """The pairs whose straight line is collision-free."""
    from app.derive import _kernels_space as kernels

    good = np.zeros(len(pairs), np.uint8)
    kernels.clear_pairs(free_space.mask, nodes, pairs, good)
    return np.asarray(pairs[good == 1])


def tidy(nodes: NDArray[np.int64], edges: NDArray[np.int64]) -> Graph:
    """A graph with its nodes sorted by row and column, equal ones joined, and each edge once."""
    distinct, place = np.unique(nodes, axis=0, return_inverse=True)
    linked = np.sort(place.reshape(-1)[edges], axis=1)
    linked = np.unique(linked[linked[:, 0] != linked[:, 1]], axis=0)
    return Graph(distinct, linked)


def lengths(nodes: NDArray[np.int64], pairs: NDArray[np.int64]) -> NDArray[np.float64]:
    """The straight distance of each pair, in cells."""
    return np.asarray(np.hypot(*(nodes[pairs[:, 0]] - nodes[pairs[:, 1]]).T))


def divide_edges(graph: Graph, free_space: FreeSpace, spacing: float) -> Graph:
    """Nodes also along the edges, at most ``spacing`` apart where the cells allow."""
    if not len(graph.edges):
        return graph
    a, b = graph.nodes[graph.edges[:, 0]], graph.nodes[graph.edges[:, 1]]
    parts = np.maximum(np.ceil(lengths(graph.nodes, graph.edges) / spacing), 1).astype(np.int64)
    edge = np.repeat(np.arange(len(parts)), parts)
    first = np.cumsum(parts) - parts
    step = np.arange(len(edge)) - first[edge]
    share = np.stack([step, step + 1], axis=1) / parts[edge][:, None]
    ends = np.rint(a[edge][:, None, :] + (b - a)[edge][:, None, :] * share[:, :, None]).astype(np.int64).reshape(-1, 2)
    pairs = np.arange(len(ends), dtype=np.int64).reshape(-1, 2)
    from app.derive import _kernels_space as kernels

    # Between the cells nearest to points of a clear line, a line may still cut a corner: such an edge stays whole.
    good = np.zeros(len(pairs), np.uint8)
    kernels.clear_pairs(free_space.mask, ends, pairs, good)
    undivided = np.minimum.reduceat(good, first) == 0
    cells = ends.reshape(-1, 2, 2)[~undivided[edge]].reshape(-1, 2)
    divided = np.arange(len(cells), dtype=np.int64).reshape(-1, 2) + len(graph.nodes)
    return tidy(np.concatenate([graph.nodes, cells]), np.concatenate([graph.edges[undivided], divided]))


def _lattice(graph: Graph, free_space: FreeSpace, spacing: float, phase: tuple[float, float]) -> NDArray[np.int64]:
    """Cells of the space on a square lattice that are not near to a node already."""
    from scipy.spatial import cKDTree

    rows, columns = (
        np.unique(np.rint(np.arange(begin % spacing, size - 1, spacing)).astype(np.int64))
        for begin, size in zip(phase, free_space.mask.shape, strict=True)
    )
    at = np.argwhere(free_space.mask[np.ix_(rows, columns)])
    cells = np.stack([rows[at[:, 0]], columns[at[:, 1]]], axis=1)
    if not len(cells):
        return cells
    away, _ = cKDTree(graph.nodes).query(cells, distance_upper_bound=0.75 * spacing)
    return np.asarray(cells[np.isinf(away)])


def _triangulate(nodes: NDArray[np.int64]) -> NDArray[np.int64]:
    """The edges of a Delaunay triangulation; none where all nodes are on one line."""
    from scipy.spatial import Delaunay, QhullError

    try:
        corners = Delaunay(nodes).simplices
    except (QhullError, ValueError):
        return np.empty((0, 2), np.int64)
    pairs = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [0, 2]]])
    return np.unique(np.sort(pairs, axis=1), axis=0).astype(np.int64)

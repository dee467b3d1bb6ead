"""Free space and its skeleton as arrays of cells: the interface to the kernels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.model.grid import FREE, UNKNOWN, OccupancyGrid


@dataclass(frozen=True, slots=True, eq=False)
class FreeSpace:
    """Cells where a round robot's centre may be.

    Attributes:
        mask: uint8 [h, w], 1 if it may be there; with a border of zeros.
        gap: uint16 [h, w], distance to the nearest obstacle in the cell's column.
        row, column: the grid's cell at (0, 0) of these arrays.
        cells: number of ones in the mask.
    """

    mask: NDArray[np.uint8]
    gap: NDArray[np.uint16]
    row: int
    column: int
    cells: int


@dataclass(frozen=True, slots=True, eq=False)
class Graph:
    """Graph. nodes: int64 [n, 2] row, column in a FreeSpace. edges: int64 [m, 2] indices of nodes, each pair once."""

    nodes: NDArray[np.int64]
    edges: NDArray[np.int64]


def free_cells(grid: OccupancyGrid, unknown: bool) -> tuple[NDArray[np.uint8], int, int] | None:
    """Return 1 for free cells (and unknown ones, if included), cropped to them with a border of zeros.

    Also returns the grid's row and column at which the crop begins; None if nothing is free.
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
    """Return the free space of a robot of this radius (cells): cells farther than it from every obstacle's centre."""
    from app.derive import _kernels_space as kernels

    gap = np.empty(free.shape, np.uint16)
    kernels.gaps(free, gap)
    # slightly larger, so that 0.3 m in cells of 0.05 m are 6 and not 5.999…: contact is a collision
    count = kernels.erode(gap, (radius * (1.0 + 1e-9)) ** 2, free)
    return FreeSpace(free, gap, row, column, int(count))


def widest(free_space: FreeSpace) -> float:
    """Return the largest distance of a free cell to obstacles, in cells."""
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
    free_space: FreeSpace,
    *,
    merge: float,
    spur: float,
    tolerance: float,
    island: float,
    radius: float = 0.0,
    share: float = 0.0,
    voronoi: bool = False,
) -> tuple[Graph, int]:
    """Return the skeleton of a space as a graph of straight, collision-free edges. Lengths are in cells.

    Args:
        merge: junctions closer than this along the skeleton are merged.
        share: so are those closer than this share of their distance to obstacles.
        spur: dead ends that reach less than this beyond the free circle of their junction are cut.
        tolerance: maximum distance of a straight edge from the skeleton; less where there is little space (``leeway``).
        radius: the robot's, for that.
        island: pieces smaller than this across are dropped (the largest always stays).
        voronoi: use the generalised Voronoi diagram, farthest from obstacles everywhere, instead of Zhang and Suen's
            skeleton.

    Returns the graph and the number of dropped pieces.
    """
    from app.derive import _kernels_skeleton as kernels
    from app.derive._kernels_thinning import thin

    thinned = free_space.mask.copy()
    cells = np.empty((ridges(thinned, free_space.gap) if voronoi else thin(thinned), 2), np.int32)
    rows = np.empty(len(thinned) + 1, np.int64)
    kernels.list_cells(thinned, cells, rows)
    raw = kernels.trace(thinned, cells, rows)
    del thinned
    merged = kernels.contract(raw, free_space.gap, cells, merge, share)
    lone, begin, path = kernels.chains(merged, kernels.prune(merged, free_space.gap, cells, spur))
    keep = np.zeros(len(path), np.uint8)
    leeways = np.empty(len(path))
    kernels.leeway(free_space.gap, cells, path, radius, tolerance, leeways)
    kernels.simplify(free_space.mask, cells, begin, path, leeways, keep)
    corner = path[keep == 1]
    line = np.repeat(np.arange(len(begin) - 1), np.diff(begin))[keep == 1]
    along = line[1:] == line[:-1]
    pairs = np.stack([corner[:-1][along], corner[1:][along]], axis=1)
    used = np.unique(np.concatenate([corner, lone]))
    edges = distinct_pairs(np.searchsorted(used, pairs).astype(np.int64))
    graph = Graph(cells[used].astype(np.int64), edges)
    return drop_islands(graph, free_space, island)


BAND = 2**25
"""Number of cells that are sorted at a time."""


def ridges(mask: NDArray[np.uint8], gap: NDArray[np.uint16]) -> int:
    """Thin a mask in place to the generalised Voronoi diagram; return the number of remaining cells.

    Takes 2 bytes per cell, and some for the remaining ones: cells are sorted by their distance one part at a time.
    """
    from app.derive import _kernels_voronoi as kernels

    rank = np.empty(mask.shape, np.uint16)
    # In 16 bits a distance is exact to 1/65535 of the largest; below 181 cells all distinct distances stay distinct.
    largest = np.sqrt(np.float32(kernels.farthest(mask, gap)))
    kernels.anchors(mask, gap, 65535.0 / max(float(largest), 1.0), rank)
    for order in _cells_by_rank(mask, rank, BAND):
        kernels.thin(mask, order, rank)
    left = np.concatenate([*_cells_by_rank(mask, rank, BAND), np.empty(0, np.int32)])
    return int(kernels.finish(mask, left))


def _cells_by_rank(mask: NDArray[np.uint8], rank: NDArray[np.uint16], limit: int) -> Iterator[NDArray[np.int32]]:
    """Yield the set cells as flat indices, sorted by rank, then index; about ``limit`` at a time.

    Cells of higher ranks must not change meanwhile.
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
    """Drop pieces that are less than ``island`` cells across, except the largest one; return the graph and their
    number."""
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
    """Return the number of connected pieces of a graph, and the piece of each node, numbered by their first nodes."""
    from app.derive import _kernels_roadmap as kernels

    piece = np.empty(len(graph.nodes), np.int64)
    return int(kernels.pieces(graph.edges, piece)), piece


def subgraph(graph: Graph, mask: NDArray[np.bool_]) -> Graph:
    """Return some nodes (whole pieces) with their edges."""
    place = np.cumsum(mask) - 1
    return Graph(graph.nodes[mask], place[graph.edges[mask[graph.edges[:, 0]]]])


NEIGHBOURS = 32
"""Maximum number of nearest nodes that a node is paired with for edges in open ground: bounds time and memory."""


def add_edges(graph: Graph, free_space: FreeSpace, cells: NDArray[np.int64], detour: float, longest: float) -> Graph:
    """Add nodes at these cells, and straight edges shorter than ``longest`` cells that avoid a detour.

    Of the collision-free lines between all nodes and their nearest ones, those are added without which the path between
    their ends would be more than ``detour`` times as long. Nodes that no line joins to the graph are left out.
    """
    from app.derive import _kernels_roadmap as kernels

    node_count = len(graph.nodes)
    nodes = np.concatenate([graph.nodes, cells])
    pairs = drop_blocked(near_pairs(nodes, longest, NEIGHBOURS), nodes, free_space)
    straight = lengths(nodes, pairs)
    order = np.lexsort((pairs[:, 1], pairs[:, 0], straight))
    pairs, straight = pairs[order], straight[order]
    taken = np.zeros(len(pairs), np.uint8)
    kernels.spanner(len(nodes), graph.edges, lengths(nodes, graph.edges), pairs, straight, detour, taken)
    full = Graph(nodes, np.concatenate([graph.edges, pairs[taken == 1]]))
    count, piece = pieces(full)
    connected = np.zeros(count, bool)
    connected[piece[:node_count]] = True
    full = subgraph(full, connected[piece])
    return tidy(full.nodes, full.edges)


def drop_blocked(pairs: NDArray[np.int64], nodes: NDArray[np.int64], free_space: FreeSpace) -> NDArray[np.int64]:
    """Drop pairs whose straight line is not collision-free."""
    from app.derive import _kernels_space as kernels

    good = np.zeros(len(pairs), np.uint8)
    kernels.clear_pairs(free_space.mask, nodes, pairs, good)
    return np.asarray(pairs[good == 1])


def tidy(nodes: NDArray[np.int64], edges: NDArray[np.int64]) -> Graph:
    """Sort nodes by row and column, merge equal ones, and keep each edge once."""
    distinct, place = _distinct(nodes)
    return Graph(distinct, distinct_pairs(place[edges]))


def distinct_pairs(pairs: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return pairs of two nodes sorted, each once."""
    return _distinct(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1))[0]


def _distinct(rows: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the distinct rows ([n, 2], from 0 to 2^31) sorted, and the index of each row among them.

    One number for each row: np.unique of rows takes several times as long on few of them.
    """
    base = int(rows[:, 1].max(initial=0)) + 1
    numbers, place = np.unique(rows[:, 0] * base + rows[:, 1], return_inverse=True)
    return np.stack(np.divmod(numbers, base), axis=1), place


def near_pairs(nodes: NDArray[np.int64], distance: float, count: int) -> NDArray[np.int64]:
    """Return the pairs of each node and its ``count`` nearest ones less than ``distance`` away, each pair once."""
    from scipy.spatial import cKDTree

    if len(nodes) < 2:
        return np.empty((0, 2), np.int64)
    away, near = cKDTree(nodes).query(nodes, k=min(count + 1, len(nodes)), distance_upper_bound=distance)
    node, place = np.nonzero(np.isfinite(away))
    return distinct_pairs(np.stack([node, near[node, place]], axis=1).astype(np.int64))


def lengths(nodes: NDArray[np.int64], pairs: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the straight distance of each pair, in cells."""
    return np.asarray(np.hypot(*(nodes[pairs[:, 0]] - nodes[pairs[:, 1]]).T))


def divide_edges(graph: Graph, free_space: FreeSpace, spacing: float) -> Graph:
    """Add nodes along the edges, at most ``spacing`` apart if the cells allow it."""
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

    # Between cells nearest to points of a clear line, a line may still cut a corner: such an edge is not divided.
    good = np.zeros(len(pairs), np.uint8)
    kernels.clear_pairs(free_space.mask, ends, pairs, good)
    undivided = np.minimum.reduceat(good, first) == 0
    cells = ends.reshape(-1, 2, 2)[~undivided[edge]].reshape(-1, 2)
    divided = np.arange(len(cells), dtype=np.int64).reshape(-1, 2) + len(graph.nodes)
    return tidy(np.concatenate([graph.nodes, cells]), np.concatenate([graph.edges[undivided], divided]))

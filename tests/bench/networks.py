"""Grid -> network, compared with plain library code: skeletonize and skan, a roadmap with networkx."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import networkx as nx
import numpy as np
from scipy.ndimage import distance_transform_edt
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from skan import Skeleton
from skimage.morphology import skeletonize

from app.derive import _kernels_space, _roadmap, _skeleton
from app.model.grid import FREE, OccupancyGrid

RADIUS = 0.3
SAMPLES = 2000
NEIGHBOURS = 10
MAX_EDGE = 5.0


def library_skeleton(mask: Any) -> int:
    """Run scikit-image's thinning and skan's graph; return the number of its components."""
    graph = Skeleton(skeletonize(mask), keep_images=False)
    return int(connected_components(graph.graph, directed=False)[0])


def our_skeleton(grid: OccupancyGrid) -> int:
    """Convert the grid's cells to the simplified graph, with erosion; return the number of its components."""
    free_cells = _skeleton.free_cells(grid, unknown=False)
    assert free_cells is not None
    free_space = _skeleton.space(*free_cells, RADIUS / grid.resolution)
    graph, _ = _skeleton.skeleton(free_space, merge=6.0, spur=10.0, tolerance=2.0, island=0.0)
    return _skeleton.pieces(graph)[0]


def plain_roadmap(grid: OccupancyGrid) -> nx.Graph:
    """Build a textbook roadmap: a distance transform, a k-d tree, and a check along each line."""
    clearance = distance_transform_edt(grid.cells == FREE) * grid.resolution
    free = np.argwhere(clearance > RADIUS)
    nodes = free[np.random.default_rng(0).choice(len(free), SAMPLES, replace=False)]
    graph = nx.Graph()
    graph.add_nodes_from(range(SAMPLES))
    away, near = cKDTree(nodes).query(nodes, k=NEIGHBOURS + 1, distance_upper_bound=MAX_EDGE / grid.resolution)
    for a in range(SAMPLES):
        for length, b in zip(away[a, 1:], near[a, 1:], strict=True):
            if b == SAMPLES or graph.has_edge(a, b):
                continue
            steps = int(np.ceil(2 * length)) + 1
            line = np.rint(np.linspace(nodes[a], nodes[b], steps)).astype(int)
            narrowest = clearance[line[:, 0], line[:, 1]].min()
            if narrowest > RADIUS:
                graph.add_edge(a, int(b), length=length * grid.resolution, width=2 * narrowest)
    return graph


def our_roadmap(grid: OccupancyGrid) -> tuple[Any, Any]:
    """Build our roadmap from the grid's cells: the connected graph and the clearance of its edges."""
    free_cells = _skeleton.free_cells(grid, unknown=False)
    assert free_cells is not None
    free_space = _skeleton.space(*free_cells, RADIUS / grid.resolution)
    middle, _ = _skeleton.skeleton(free_space, merge=6.0, spur=10.0, tolerance=2.0, island=0.0)
    far = MAX_EDGE / grid.resolution
    graph, _ = _roadmap.roadmap(free_space, middle, samples=SAMPLES, neighbours=NEIGHBOURS, max_edge=far, seed=0)
    width = np.empty(len(graph.edges))
    _kernels_space.widths(free_space.gap, graph.nodes, graph.edges, width)
    return graph, width


def rows(grid: OccupancyGrid, tries: int) -> list[dict[str, Any]]:
    """Measure both alternately on the same grid."""
    mask = distance_transform_edt(grid.cells == FREE) * grid.resolution > RADIUS * (1 + 1e-9)
    same = library_skeleton(mask) == our_skeleton(grid)
    out = []
    for label, theirs, ours, times in (
        ("skeleton and graph", lambda: library_skeleton(mask), lambda: our_skeleton(grid), 5.0),
        ("roadmap", lambda: plain_roadmap(grid), lambda: our_roadmap(grid), 20.0),
    ):
        peer, our_time = in_turns(theirs, ours, tries)
        holds = peer >= times * our_time and (same or label == "roadmap")
        out.append(
            {
                "what": label,
                "peer": peer,
                "ours": our_time,
                "unit": "ms",
                "ratio": peer / our_time,
                "bound": f"≥ {times:g}, same pieces" if label != "roadmap" else f"≥ {times:g}",
                "holds": holds,
            }
        )
    return out


def in_turns(theirs: Callable[[], Any], ours: Callable[[], Any], tries: int) -> tuple[float, float]:
    """Measure the fastest tries of both in milliseconds, each after a warm-up."""
    best = [np.inf, np.inf]
    for k in range(tries + 1):
        for index, work in enumerate((theirs, ours)):
            start = time.perf_counter()
            work()
            if k:
                best[index] = min(best[index], (time.perf_counter() - start) * 1e3)
    return best[0], best[1]

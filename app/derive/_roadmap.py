"""Probabilistic roadmap over free cells; pieces that samples do not connect are joined along the skeleton."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from app.derive._skeleton import FreeSpace, Graph, drop_blocked, lengths, pieces, subgraph, tidy

MAX_LINKS = 16
"""Maximum number of skeleton nodes that a sample may be joined to."""


def roadmap(
    free_space: FreeSpace, skeleton: Graph, *, samples: int, neighbours: int, max_edge: float, seed: int
) -> tuple[Graph, int]:
    """Join seeded samples to their nearest neighbours by collision-free straight lines. Lengths are in cells.

    Half of the samples are drawn evenly from the space, half from the skeleton's nodes and edges, where clearance is
    largest and narrow passages are covered (as in medial-axis roadmaps). Unconnected pieces are joined via skeleton
    nodes, so that the roadmap connects what the skeleton connects. Samples in places that the skeleton omits, and those
    that see neither it nor another sample, are dropped. Returns the roadmap and the number of dropped samples.
    """
    from scipy.spatial import cKDTree

    random = np.random.default_rng(seed)
    middle = _sample_along(skeleton, free_space, samples // 2, random)
    cells = np.unique(np.concatenate([middle, _sample_cells(free_space, samples - len(middle), random)]), axis=0)
    n = len(cells)
    _, near = cKDTree(cells).query(cells, k=min(neighbours + 1, n), distance_upper_bound=max_edge)
    near = near.reshape(n, -1)
    a, b = np.repeat(np.arange(n), near.shape[1]), near.ravel()
    pairs = np.stack([a, b], axis=1)[(b < n) & (a != b)]
    edges = drop_blocked(np.unique(np.sort(pairs, axis=1), axis=0).astype(np.int64), cells, free_space)
    return _join_pieces(Graph(cells, edges), skeleton, free_space)


def _sample_along(skeleton: Graph, free_space: FreeSpace, count: int, random: np.random.Generator) -> NDArray[np.int64]:
    """Draw cells from the skeleton's edges, evenly by length."""
    if not len(skeleton.edges):
        return np.empty((0, 2), np.int64)
    length = lengths(skeleton.nodes, skeleton.edges)
    edge = random.choice(len(length), size=count, p=length / length.sum())
    a, b = skeleton.nodes[skeleton.edges[edge, 0]], skeleton.nodes[skeleton.edges[edge, 1]]
    cells = np.rint(a + (b - a) * random.random((count, 1))).astype(np.int64)
    return np.asarray(cells[free_space.mask[cells[:, 0], cells[:, 1]] == 1])


def _sample_cells(free_space: FreeSpace, count: int, random: np.random.Generator) -> NDArray[np.int64]:
    """Draw distinct cells of the space, evenly."""
    before = np.concatenate([[0], np.cumsum(free_space.mask.sum(axis=1, dtype=np.int64))])
    chosen = np.sort(random.choice(int(before[-1]), size=min(count, int(before[-1])), replace=False))
    rows = np.searchsorted(before, chosen, side="right") - 1
    out = np.empty((len(chosen), 2), np.int64)
    out[:, 0] = rows
    for row in np.unique(rows):
        selection = rows == row if len(chosen) < 64 else slice(*np.searchsorted(rows, [row, row + 1]))
        out[selection, 1] = np.flatnonzero(free_space.mask[row])[chosen[selection] - before[row]]
    return out


def _join_pieces(graph: Graph, skeleton: Graph, free_space: FreeSpace) -> tuple[Graph, int]:
    """Join the roadmap's pieces with edges of the skeleton, and drop samples that nothing can join.

    Returns the graph and the number of dropped samples.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import minimum_spanning_tree
    from scipy.spatial import cKDTree

    n, more = len(graph.nodes), len(skeleton.nodes)
    nodes = np.concatenate([graph.nodes, skeleton.nodes])
    k = min(MAX_LINKS, more)
    _, near = cKDTree(skeleton.nodes).query(graph.nodes, k=k)
    pairs = np.stack([np.repeat(np.arange(n), k), near.reshape(-1) + n], axis=1).astype(np.int64)
    fallback_edges = np.concatenate([drop_blocked(pairs, nodes, free_space), skeleton.edges + n])
    links = np.concatenate([graph.edges, fallback_edges])
    # A tree that prefers the roadmap's own edges, then short ones; scipy takes a weight of 0 as no edge.
    weight = np.concatenate([np.full(len(graph.edges), 1e-6), np.maximum(lengths(nodes, fallback_edges), 0.0) + 1e-3])
    size = n + more
    tree = minimum_spanning_tree(coo_array((weight, (links[:, 0], links[:, 1])), (size, size)).tocsr()).tocoo()
    added = np.stack([tree.row, tree.col], axis=1).astype(np.int64)[(tree.row >= n) | (tree.col >= n)]
    # leaves of the tree that are skeleton nodes lead nowhere
    while True:
        degree = np.bincount(added.ravel(), minlength=size)
        degree[:n] = 2
        stays = (degree[added] > 1).all(axis=1)
        if stays.all():
            break
        added = added[stays]
    full = Graph(nodes, np.concatenate([graph.edges, added]))
    remaining = np.ones(size, bool)
    remaining[n:] = False
    remaining[added.ravel()] = True
    count, piece = pieces(Graph(nodes, links))  # with the complete skeleton: which pieces belong to it
    connected = np.zeros(count, bool)
    connected[piece[n:]] = True
    remaining &= connected[piece]
    full = subgraph(full, remaining)
    return tidy(full.nodes, full.edges), n - int(remaining[:n].sum())

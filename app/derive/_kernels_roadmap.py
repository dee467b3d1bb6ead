"""Greedy spanner: select the straight edges that shorten a network's detours, as native code."""

# numba has its own number types: 64-bit integers and floats, whatever mypy infers from NumPy's.
# mypy: disable-error-code="assignment,return-value,arg-type,no-any-return"

from __future__ import annotations

import numpy as np

from app.derive._kernels_space import F64, I64, U8
from app.native import native


@native
def _link(head: I64, following: I64, to: I64, weight: F64, place: int, a: int, b: int, length: float) -> None:
    to[place], weight[place], following[place], head[a] = b, length, head[a], place


@native
def spanner(count: int, edges: I64, length: F64, wanted: I64, straight: F64, detour: float, out: U8) -> None:
    """Mark the wanted edges without which the path between their ends is more than ``detour`` times as long.

    count: number of nodes. edges: existing edges [m, 2], with their lengths. wanted: candidates [n, 2], shortest first;
    each marked one counts as existing for the next (the greedy spanner of Althöfer and others, 1993).
    """
    m, n = len(edges), len(wanted)
    head = np.full(count, -1, np.int64)
    following, to = np.empty(2 * (m + n), np.int64), np.empty(2 * (m + n), np.int64)
    weight = np.empty(2 * (m + n))
    used = 0
    for e in range(m):
        _link(head, following, to, weight, used, edges[e, 0], edges[e, 1], length[e])
        _link(head, following, to, weight, used + 1, edges[e, 1], edges[e, 0], length[e])
        used += 2
    distance = np.full(count, np.inf)
    queued = np.zeros(count, np.uint8)
    queue = np.empty(count + 1, np.int64)
    touched = np.empty(count, np.int64)
    for k in range(n):
        a, b, bound = wanted[k, 0], wanted[k, 1], detour * straight[k]
        distance[a] = 0.0
        touched[0], seen = a, 1
        queue[0], first, last = a, 0, 1
        while first != last:
            current = queue[first]
            first = first + 1 if first < count else 0
            queued[current] = 0
            link = head[current]
            while link >= 0:
                neighbour, far = to[link], distance[current] + weight[link]
                if far <= bound and far < distance[neighbour]:
                    if distance[neighbour] == np.inf:
                        touched[seen] = neighbour
                        seen += 1
                    distance[neighbour] = far
                    if not queued[neighbour]:
                        queued[neighbour] = 1
                        queue[last] = neighbour
                        last = last + 1 if last < count else 0
                link = following[link]
            if distance[b] < np.inf:
                break
        while first != last:
            queued[queue[first]] = 0
            first = first + 1 if first < count else 0
        reached = distance[b] < np.inf
        for i in range(seen):
            distance[touched[i]] = np.inf
        if not reached:
            out[k] = 1
            _link(head, following, to, weight, used, a, b, straight[k])
            _link(head, following, to, weight, used + 1, b, a, straight[k])
            used += 2


def compile_all() -> None:
    """Compile all kernels: call each one once on a tiny graph."""
    pairs, lengths = np.array([[0, 1]], np.int64), np.ones(1)
    spanner(2, pairs, lengths, pairs, lengths, 1.5, np.zeros(1, np.uint8))

"""Choose nodes and edges for open ground, as native code: a greedy cover, and a greedy spanner of short detours."""

# numba has its own number types: 64-bit integers and floats, whatever mypy infers from NumPy's.
# mypy: disable-error-code="assignment,return-value,arg-type,no-any-return"

from __future__ import annotations

import numpy as np

from app.derive._kernels_space import F64, I64, U8, clear
from app.native import native


@native
def cover(mask: U8, rows: I64, columns: I64, state: U8, reach: float, gain: int) -> int:
    """Choose points of a lattice until no other one would cover ``gain`` or more points; return their number.

    A point covers those at most ``reach`` cells away on a straight line within the mask. Those that cover most are
    chosen first (the greedy set cover), by row and column if equal. rows, columns: cells of the lattice. state:
    [len(rows), len(columns)], 0 outside the mask, 1 not covered, 2 covered; chosen ones become 3.
    """
    height, width = state.shape
    up, right = 0, 0
    while up + 1 < height and rows[up + 1] - rows[0] <= reach:
        up += 1
    while right + 1 < width and columns[right + 1] - columns[0] <= reach:
        right += 1
    seen = np.empty(((2 * up + 3) * (2 * right + 3), 2), np.int64)
    best = np.full(state.shape, np.int64((2 * up + 3) * (2 * right + 3)))
    chosen = 0
    for wanted in range((2 * up + 3) * (2 * right + 3), gain - 1, -1):
        for i in range(height):
            for j in range(width):
                if state[i, j] == 0 or best[i, j] < wanted:
                    continue
                count = 0
                for v in range(max(0, i - up - 1), min(height, i + up + 2)):
                    for u in range(max(0, j - right - 1), min(width, j + right + 2)):
                        dy, dx = rows[v] - rows[i], columns[u] - columns[j]
                        if state[v, u] != 1 or dy * dy + dx * dx > reach * reach:
                            continue
                        if clear(mask, rows[i], columns[j], rows[v], columns[u]):
                            seen[count, 0], seen[count, 1] = v, u
                            count += 1
                best[i, j] = count  # it only falls
                if count >= wanted:
                    for k in range(count):
                        state[seen[k, 0], seen[k, 1]] = 2
                    state[i, j] = 3
                    best[i, j] = 0
                    chosen += 1
    return chosen


@native
def meeting(mask: U8, y: int, x: int, near: float, far: float, cells: I64) -> tuple[int, int]:
    """Return the cell nearest to (y, x), from ``near`` up to ``far`` cells away, that sees all of ``cells`` ([n, 2]).

    It sees a cell if the straight line there stays in the mask. Returns (-1, -1) if there is none.
    """
    height, width = mask.shape
    reach = np.int64(far)
    top, bottom = np.int64(max(0, y - reach)), np.int64(min(height, y + reach + 1))
    left, right = np.int64(max(0, x - reach)), np.int64(min(width, x + reach + 1))
    best, row, column = far * far + 1.0, np.int64(-1), np.int64(-1)
    for v in range(top, bottom):
        for u in range(left, right):
            away = np.float64((v - y) ** 2 + (u - x) ** 2)
            if mask[v, u] == 0 or away < near * near or away > far * far or away >= best:
                continue
            good = True
            for k in range(len(cells)):
                if not clear(mask, v, u, cells[k, 0], cells[k, 1]):
                    good = False
                    break
            if good:
                best, row, column = away, v, u
    return row, column


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


@native
def pieces(edges: I64, out: I64) -> int:
    """Compute the connected piece of each node, numbered by their first nodes; return the number of pieces.

    edges: [m, 2]. out: [number of nodes]. The root of a piece is its first node.
    """
    for k in range(len(out)):
        out[k] = k
    for e in range(len(edges)):
        a, b = edges[e, 0], edges[e, 1]
        while out[a] != a:
            out[a] = out[out[a]]
            a = out[a]
        while out[b] != b:
            out[b] = out[out[b]]
            b = out[b]
        out[max(a, b)] = min(a, b)
    count = 0
    for k in range(len(out)):
        if out[k] == k:
            out[k] = count
            count += 1
        else:  # the parent is an earlier node, so it has the number of its piece already
            out[k] = out[out[k]]
    return count


def compile_all() -> None:
    """Compile all kernels: call each one once on a tiny graph."""
    pairs, lengths = np.array([[0, 1]], np.int64), np.ones(1)
    pieces(pairs, np.zeros(2, np.int64))
    spanner(2, pairs, lengths, pairs, lengths, 1.5, np.zeros(1, np.uint8))
    mask, at = np.ones((3, 3), np.uint8), np.arange(3)
    meeting(mask, 1, 1, 0.0, 1.0, pairs)
    cover(mask, at, at, np.ones((3, 3), np.uint8), 1.0, 1)

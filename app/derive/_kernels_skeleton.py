"""Graph of the skeleton of a mask, as native code.

Masks are [height, width] with a border of zeros, thinned by ``_kernels_thinning``. Skeleton cells are listed by row and
column, and paths hold indices into that list.
"""

# numba has its own number types: 64-bit integers and floats, whatever mypy infers from NumPy's.
# mypy: disable-error-code="assignment,return-value,arg-type,no-any-return"

from __future__ import annotations

import numpy as np

from app.derive._kernels_space import F64, I32, I64, U8, U16, clear, distance2, gaps
from app.derive._kernels_thinning import DX, DY, thin
from app.native import native

Graph = tuple[I64, I64, I64, I64, I64]


@native
def list_cells(mask: U8, cells: I32, rows: I64) -> None:
    """List the set cells as [n, 2] row and column, and the index at which each row begins ([height + 1])."""
    height, width = mask.shape
    n = 0
    for y in range(height):
        rows[y] = n
        for x in range(width):
            if mask[y, x]:
                cells[n, 0], cells[n, 1] = y, x
                n += 1
    rows[height] = n


@native
def _find(cells: I32, rows: I64, y: int, x: int) -> int:
    low, high = rows[y], rows[y + 1]
    while low < high:
        middle = (low + high) // 2
        if cells[middle, 1] < x:
            low = middle + 1
        else:
            high = middle
    return low


@native
def _neighbours(mask: U8, cells: I32, rows: I64, k: int, out: I64) -> int:
    y, x = cells[k, 0], cells[k, 1]
    n = 0
    for d in range(8):
        v, u = y + DY[d], x + DX[d]
        if mask[v, u]:
            out[n] = _find(cells, rows, v, u)
            n += 1
    return n


@native
def _walk(mask: U8, cells: I32, rows: I64, node: I64, done: U8, path: I64, used: int, at: int, following: int) -> int:
    """Append the cells from node ``at`` via its neighbour ``following`` to the next node; return the path's length."""
    near = np.empty(8, np.int64)
    path[used] = at
    used += 1
    previous, current = at, following
    while node[current] < 0:
        done[current] = 1
        path[used] = current
        used += 1
        _neighbours(mask, cells, rows, current, near)
        following = near[0] if near[0] != previous else near[1]
        previous, current = current, following
    path[used] = current
    return used + 1


@native
def trace(mask: U8, cells: I32, rows: I64) -> Graph:
    """Build the graph of a skeleton: (nodes, start, end, begin, path).

    nodes: cells with a number of neighbours other than two, and one cell of each ring. start, end: node indices of each
    edge. Edge e runs along the cells ``path[begin[e] : begin[e + 1]]``, each adjacent to the one before, including the
    nodes' own cells.
    """
    n = len(cells)
    near = np.empty(8, np.int64)
    node = np.full(n, -1, np.int64)
    nodes = np.empty(n, np.int64)
    count = ends = 0
    for k in range(n):
        degree = _neighbours(mask, cells, rows, k, near)
        if degree != 2:
            node[k] = count
            nodes[count] = k
            count += 1
            ends += degree
    rings = n // 4 + 1
    start, end = np.empty(ends + rings, np.int64), np.empty(ends + rings, np.int64)
    begin = np.empty(ends + rings + 1, np.int64)
    path = np.empty(n + 2 * (ends + rings), np.int64)
    done = np.zeros(n, np.uint8)
    edges = used = 0
    for phase in range(2):
        for k in range(n):
            if phase == 0:
                if node[k] < 0:
                    continue
            else:  # rings, which no node leads to
                if node[k] >= 0 or done[k]:
                    continue
                node[k] = count
                nodes[count] = k
                count += 1
            m = _neighbours(mask, cells, rows, k, near)
            for d in range(m if phase == 0 else 1):
                q = near[d]
                if (node[q] >= 0 and q < k) or done[q]:
                    continue
                begin[edges] = used
                used = _walk(mask, cells, rows, node, done, path, used, k, q)
                last = path[used - 1]
                if last == k and used - begin[edges] < 5:
                    used = begin[edges]  # two cells beside a junction that enclose nothing
                    continue
                start[edges], end[edges] = node[k], node[last]
                edges += 1
    begin[edges] = used
    return nodes[:count].copy(), start[:edges].copy(), end[:edges].copy(), begin[: edges + 1].copy(), path[:used].copy()


@native
def _incidence(count: int, start: I64, end: I64, alive: U8) -> tuple[I64, I64]:
    """Return the edges at each node: those of node v are ``edges[first[v] : first[v + 1]]`` (loops twice)."""
    first = np.zeros(count + 1, np.int64)
    for e in range(len(start)):
        if alive[e]:
            first[start[e] + 1] += 1
            first[end[e] + 1] += 1
    for v in range(count):
        first[v + 1] += first[v]
    at = first[:-1].copy()
    edges = np.empty(first[count], np.int64)
    for e in range(len(start)):
        if alive[e]:
            edges[at[start[e]]] = e
            at[start[e]] += 1
            edges[at[end[e]]] = e
            at[end[e]] += 1
    return first, edges


@native
def _lengths(cells: I32, begin: I64, path: I64) -> F64:
    out = np.zeros(len(begin) - 1)
    for e in range(len(out)):
        for i in range(begin[e], begin[e + 1] - 1):
            a, b = path[i], path[i + 1]
            straight = cells[a, 0] == cells[b, 0] or cells[a, 1] == cells[b, 1]
            out[e] += 1.0 if straight else np.sqrt(2.0)
    return out


@native
def _cluster(graph: Graph, gap: U16, cells: I32, radius: float, share: float, length: F64) -> tuple[I64, I64, F64]:
    """Cluster junctions that are close together, as ``contract`` describes: (head, via, away).

    head: [nodes], the junction that each node is merged into, itself if it stays. via: the edge towards it, or -1.
    away: its distance along the skeleton, in cells.
    """
    nodes, start, end = graph[:3]
    count = len(nodes)
    first, at = _incidence(count, start, end, np.ones(len(start), np.uint8))
    clearance = np.empty(count, np.int64)
    for v in range(count):
        clearance[v] = distance2(gap, cells[nodes[v], 0], cells[nodes[v], 1])
    order = np.argsort(-clearance, kind="mergesort")
    head, via, away = np.full(count, -1, np.int64), np.full(count, -1, np.int64), np.zeros(count)
    queue = np.empty(count, np.int64)
    for rank in range(count):
        v = order[rank]
        if head[v] >= 0:
            continue
        head[v] = v
        queue[0] = v
        size, i = 1, 0
        bound = max(radius, share * np.sqrt(clearance[v]))
        while i < size and first[v + 1] - first[v] > 2:
            current = queue[i]
            i += 1
            for k in range(first[current], first[current + 1]):
                e = at[k]
                u = end[e] if start[e] == current else start[e]
                far = away[current] + length[e]
                if head[u] < 0 and far <= bound and first[u + 1] - first[u] > 2:
                    head[u], via[u], away[u] = v, e, far
                    queue[size] = u
                    size += 1
    return head, via, away


@native
def contract(graph: Graph, gap: U16, cells: I32, radius: float, share: float = 0.0) -> Graph:
    """Merge junctions within ``radius`` cells of each other along the skeleton.

    The junction farthest from obstacles stays, and edges of the others are extended to it along the cells between. If
    ``share`` of its distance to obstacles is more, that is its radius: in open ground, junctions that are near each
    other in proportion are one place. Resulting loops of at most four times the radius are removed, since they lead
    nowhere.
    """
    nodes, start, end, begin, path = graph
    count, edges = len(nodes), len(start)
    length = _lengths(cells, begin, path)
    head, via, away = _cluster(graph, gap, cells, radius, share, length)
    remaining = np.zeros(edges, np.uint8)
    room = m = 0
    for e in range(edges):
        a, b = start[e], end[e]
        tree = via[a] == e or via[b] == e
        if tree or (head[a] == head[b] and length[e] + away[a] + away[b] <= 4.0 * radius):
            continue
        remaining[e] = 1
        m += 1
        room += begin[e + 1] - begin[e]
        for v0 in (a, b):
            v = v0
            while via[v] >= 0:
                room += begin[via[v] + 1] - begin[via[v]]
                v = end[via[v]] if start[via[v]] == v else start[via[v]]
    heads = np.flatnonzero(head == np.arange(count))
    place = np.full(count, -1, np.int64)
    place[heads] = np.arange(len(heads))
    new_start, new_end, new_begin = np.empty(m, np.int64), np.empty(m, np.int64), np.empty(m + 1, np.int64)
    new_path = np.empty(room, np.int64)
    used = m = 0
    for e in range(edges):
        if not remaining[e]:
            continue
        a, b = start[e], end[e]
        new_start[m], new_end[m], new_begin[m] = place[head[a]], place[head[b]], used
        used = _onwards(a, start, end, begin, path, via, new_path, used)
        new_path[new_begin[m] : used] = new_path[new_begin[m] : used][::-1].copy()
        for i in range(begin[e], begin[e + 1]):
            new_path[used] = path[i]
            used += 1
        used = _onwards(b, start, end, begin, path, via, new_path, used)
        m += 1
    new_begin[m] = used
    return nodes[heads], new_start, new_end, new_begin, new_path[:used].copy()


@native
def _onwards(v: int, start: I64, end: I64, begin: I64, path: I64, via: I64, out: I64, used: int) -> int:
    """Append the cells from node v (without its own) to its head."""
    while via[v] >= 0:
        e = via[v]
        low, high = begin[e], begin[e + 1] - 1
        forward = start[e] == v
        for i in range(1, high - low + 1):
            out[used] = path[low + i] if forward else path[high - i]
            used += 1
        v = end[e] if forward else start[e]
    return used


@native
def prune(graph: Graph, gap: U16, cells: I32, spur: float) -> U8:
    """Mark the edges that remain after dead ends shorter than ``spur`` are removed.

    The length of a dead end is measured in cells beyond the free circle of its junction. Removed are the shortest
    first, one per junction and round; a junction that then has two branches counts as part of a line.
    """
    nodes, start, end, begin, path = graph
    count, edges = len(nodes), len(start)
    length = _lengths(cells, begin, path)
    alive = np.ones(edges, np.uint8)
    best = np.empty(count)
    leaf = np.empty(count, np.int64)
    clearance = np.empty(count)
    for v in range(count):
        clearance[v] = np.sqrt(distance2(gap, cells[nodes[v], 0], cells[nodes[v], 1]))
    while True:
        first, at = _incidence(count, start, end, alive)
        best[:] = np.inf
        leaf[:] = -1
        for tip in range(count):
            if first[tip + 1] - first[tip] != 1:
                continue
            current, e, far = tip, at[first[tip]], 0.0
            while True:
                far += length[e]
                current = end[e] if start[e] == current else start[e]
                if first[current + 1] - first[current] != 2:
                    break
                e = at[first[current]] if at[first[current]] != e else at[first[current] + 1]
            if first[current + 1] - first[current] < 3:
                continue
            beyond = far - max(0.0, clearance[current] - clearance[tip])
            if beyond < spur and (beyond < best[current] or (beyond == best[current] and tip < leaf[current])):
                best[current], leaf[current] = beyond, tip
        pruned = False
        for junction in range(count):
            tip = leaf[junction]
            if tip < 0:
                continue
            pruned = True
            current, e = tip, at[first[tip]]
            while True:
                alive[e] = 0
                current = end[e] if start[e] == current else start[e]
                if current == junction:
                    break
                e = at[first[current]] if at[first[current]] != e else at[first[current] + 1]
        if not pruned:
            return alive


@native
def chains(graph: Graph, alive: U8) -> tuple[I64, I64, I64]:
    """Return the lines between junctions and ends: (lone, begin, path).

    lone: cells of nodes that never had edges. Line c runs along the cells ``path[begin[c] : begin[c + 1]]``; a ring
    without junctions begins and ends at one of its cells.
    """
    nodes, start, end, begin, path = graph
    count, edges = len(nodes), len(start)
    first, at = _incidence(count, start, end, alive)
    had, _ = _incidence(count, start, end, np.ones(edges, np.uint8))
    lone = np.empty(count, np.int64)
    alone = 0
    for v in range(count):
        if had[v + 1] == had[v]:
            lone[alone] = nodes[v]
            alone += 1
    done = np.zeros(edges, np.uint8)
    out_begin, out = np.empty(edges + 1, np.int64), np.empty(len(path), np.int64)
    lines = used = 0
    for phase in range(2):
        for v in range(count):
            degree = first[v + 1] - first[v]
            if phase == 0 and degree == 2:
                continue
            for k in range(first[v], first[v + 1]):
                e = at[k]
                if done[e]:
                    continue
                out_begin[lines] = used
                lines += 1
                current = v
                out[used] = nodes[v]
                used += 1
                while True:
                    done[e] = 1
                    low, high = begin[e], begin[e + 1] - 1
                    forward = start[e] == current
                    for i in range(1, high - low + 1):
                        out[used] = path[low + i] if forward else path[high - i]
                        used += 1
                    current = end[e] if forward else start[e]
                    if first[current + 1] - first[current] != 2 or current == v:
                        break
                    e = at[first[current]] if at[first[current]] != e else at[first[current] + 1]
    out_begin[lines] = used
    return lone[:alone].copy(), out_begin[: lines + 1].copy(), out[:used].copy()


@native
def leeway(gap: U16, cells: I32, path: I64, radius: float, tolerance: float, out: F64) -> None:
    """Compute how far, in cells, a straight edge may be from each cell of the lines.

    It is half the distance by which a robot of this radius can move there, at least one cell and at most the tolerance:
    lines stay in the middle of aisles and are straight in wide space.
    """
    for i in range(len(path)):
        distance = np.sqrt(distance2(gap, cells[path[i], 0], cells[path[i], 1]))
        out[i] = min(tolerance, max(1.0, (distance - radius) / 2.0))


@native
def simplify(mask: U8, cells: I32, begin: I64, path: I64, leeways: F64, keep: U8) -> None:
    """Simplify lines: mark in ``keep`` (one value per element of ``path``) the corners of their straight segments.

    Like Douglas-Peucker, but each segment must also stay within the mask; it deviates from each cell by its ``leeways``
    at most. Steps between neighbouring cells are always allowed, so this terminates.
    """
    stack = np.empty((len(path) + 2, 2), np.int64)
    for c in range(len(begin) - 1):
        low, high = begin[c], begin[c + 1] - 1
        keep[low] = keep[high] = 1
        stack[0, 0], stack[0, 1] = low, high
        size = 1
        while size > 0:
            size -= 1
            i, j = stack[size, 0], stack[size, 1]
            if j - i < 2:
                continue
            y0, x0 = np.int64(cells[path[i], 0]), np.int64(cells[path[i], 1])
            y1, x1 = np.int64(cells[path[j], 0]), np.int64(cells[path[j], 1])
            dy, dx = y1 - y0, x1 - x0
            along = dy * dy + dx * dx
            worst, farthest = -1.0, (i + j) // 2
            for k in range(i + 1, j):
                v, u = cells[path[k], 0] - y0, cells[path[k], 1] - x0
                t = 0.0
                if along > 0:
                    t = min(1.0, max(0.0, (v * dy + u * dx) / along))
                away = ((v - t * dy) ** 2 + (u - t * dx) ** 2) / max(leeways[k] ** 2, 1e-12)
                if away > worst:
                    worst, farthest = away, k
            if along > 0 and worst <= 1.0 and clear(mask, y0, x0, y1, x1):
                continue
            keep[farthest] = 1
            stack[size, 0], stack[size, 1] = i, farthest
            stack[size + 1, 0], stack[size + 1, 1] = farthest, j
            size += 2


def compile_all() -> None:
    """Compile all kernels: call each one once on a tiny grid."""
    mask = np.zeros((7, 9), np.uint8)
    mask[1:-1, 1:-1] = 1
    gap = np.zeros(mask.shape, np.uint16)
    gaps(mask, gap)
    thinned = mask.copy()
    cells, rows = np.empty((thin(thinned), 2), np.int32), np.empty(len(mask) + 1, np.int64)
    list_cells(thinned, cells, rows)
    graph = contract(trace(thinned, cells, rows), gap, cells, 1.0, 0.0)
    _, begin, path = chains(graph, prune(graph, gap, cells, 1.0))
    leeways = np.empty(len(path))
    leeway(gap, cells, path, 0.0, 1.0, leeways)
    simplify(mask, cells, begin, path, leeways, np.zeros(len(path), np.uint8))

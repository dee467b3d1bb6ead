"""Wave-function collapse on any lattice, as native code: observe, propagate, and repair contradictions.

A place is one window of the lattice; its domain is the set of patterns that are still possible there, one bit each. The
place with the lowest entropy is observed, and the consequences are propagated until every pattern has a partner in each
neighbour (arc consistency). If no pattern is left for a place, the places around it get back their initial domains, in
a wider ring each time this happens there, and are solved again: local backtracking as in model synthesis (Merrell and
Manocha, Model synthesis, TVCG 17, 2011).

Numbers are 64-bit integers throughout, so that the same seed gives the same result on every machine. Random numbers are
those of SplitMix64.
"""

# numba has its own number types: 64-bit integers and floats, whatever mypy infers from NumPy's.
# mypy: disable-error-code="assignment,return-value,arg-type,no-any-return,call-overload,operator,misc"

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from app.native import native

U64 = NDArray[np.uint64]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]
I32 = NDArray[np.int32]
I16 = NDArray[np.int16]

ONE = np.uint64(1)
ZERO = np.uint64(0)

DONE, IMPOSSIBLE, TIRED = 0, 1, 2
"""Results of ``collapse``: every place has a pattern; the initial domains are contradictory; a limit was reached."""

_BITS = np.uint64(0x03F79D71B4CB0A89)
_BIT = np.zeros(64, np.int64)
for _k in range(64):
    _BIT[((0x03F79D71B4CB0A89 << _k) & 0xFFFFFFFFFFFFFFFF) >> 58] = _k
_S58, _S52, _S30, _S27, _S31, _S11 = (np.uint64(s) for s in (58, 52, 30, 27, 31, 11))
_GAMMA, _MIX1, _MIX2 = np.uint64(0x9E3779B97F4A7C15), np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)


@native
def _random(state: U64) -> int:
    """Return the next number of SplitMix64, 0 to 2^53 - 1."""
    state[0] = state[0] + _GAMMA
    z = state[0]
    z = (z ^ (z >> _S30)) * _MIX1
    z = (z ^ (z >> _S27)) * _MIX2
    z = z ^ (z >> _S31)
    return np.int64(z >> _S11)


@native
def _entropy(domain: U64, weights: I64, heavy: I64, logs: I64) -> int:
    """Return the entropy of a domain in units of 2^-20; -1 if at most one pattern is left."""
    total, mean, count = np.int64(0), np.int64(0), 0
    for k in range(len(domain)):
        word = domain[k]
        while word != ZERO:
            low = word & (~word + ONE)
            p = (k << 6) + _BIT[np.int64((low * _BITS) >> _S58)]
            total += weights[p]
            mean += heavy[p]
            count += 1
            word ^= low
    if count <= 1:
        return -1
    return logs[total] - mean // total


@native
def _push(keys: I64, positions: I64, size: int, key: int, place: int) -> int:
    """Push onto a binary heap; return its new size."""
    i = size
    while i > 0:
        up = (i - 1) >> 1
        if keys[up] <= key:
            break
        keys[i], positions[i] = keys[up], positions[up]
        i = up
    keys[i], positions[i] = key, place
    return size + 1


@native
def _pop(keys: I64, positions: I64, size: int) -> int:
    """Pop a heap: move its first element to the end; return the new size."""
    first_key, first = keys[0], positions[0]
    size -= 1
    key, place = keys[size], positions[size]
    i = 0
    while True:
        child = 2 * i + 1
        if child >= size:
            break
        if child + 1 < size and keys[child + 1] < keys[child]:
            child += 1
        if keys[child] >= key:
            break
        keys[i], positions[i] = keys[child], positions[child]
        i = child
    keys[i], positions[i] = key, place
    keys[size], positions[size] = first_key, first
    return size


@native
def _single_pattern(domain: U64) -> int:
    """Return the only pattern of a domain, or -1 if there are several, -2 if there is none."""
    tile = np.int64(-2)
    for k in range(len(domain)):
        word = domain[k]
        if word != ZERO:
            if tile != -2 or word & (word - ONE) != ZERO:
                return -1
            tile = (k << 6) + _BIT[np.int64((word * _BITS) >> _S58)]
    return tile


@native
def _observe(
    domain: U64, weights: I64, tile: I64, shares: I64, placed: I64, totals: I64, balance: int, state: U64, chance: I64
) -> int:
    """Draw one pattern of a domain by weight; patterns placed too often so far weigh less, too rare ones more."""
    total = np.int64(0)
    count = 0
    for k in range(len(domain)):
        word = domain[k]
        while word != ZERO:
            low = word & (~word + ONE)
            p = (k << 6) + _BIT[np.int64((low * _BITS) >> _S58)]
            share = weights[p] << 10
            if balance >= 0:
                # expected over actual count of patterns with this tile, both plus an offset of some places
                c = tile[p]
                should = shares[c] * totals[0] // totals[1] + balance
                ratio = min(max((should << 10) // (placed[c] + balance), 1 << 6), 1 << 14)
                share = max((((weights[p] << 10) * ratio) >> 10) * ratio >> 10, 1)
            chance[count] = share
            total += share
            count += 1
            word ^= low
    at = _random(state) % total
    count = 0
    for k in range(len(domain)):
        word = domain[k]
        while word != ZERO:
            low = word & (~word + ONE)
            at -= chance[count]
            if at < 0:
                return (k << 6) + _BIT[np.int64((low * _BITS) >> _S58)]
            count += 1
            word ^= low
    return -1


@native
def _find_partners(domain: U64, a: int, d: int, allowed: U64, domains: U64, partners: U64) -> int:
    """Return the row of ``partners[d]`` with all patterns allowed beside those of place a in direction d.

    domains, partners: [4, 4096, words], the domains asked for last and their answers: many places have equal domains.
    """
    words = domain.shape[1]
    digest = ZERO
    for k in range(words):
        digest = (digest ^ domain[a, k]) * _MIX1
        digest ^= digest >> _S31
    row = np.int64((digest * _GAMMA) >> _S52)
    same = True
    for k in range(words):
        same = same and domains[d, row, k] == domain[a, k]
    if same:
        return row
    for k in range(words):
        domains[d, row, k] = domain[a, k]
        partners[d, row, k] = ZERO
    for k in range(words):
        word = domain[a, k]
        while word != ZERO:
            low = word & (~word + ONE)
            p = (k << 6) + _BIT[np.int64((low * _BITS) >> _S58)]
            word ^= low
            for j in range(words):
                partners[d, row, j] |= allowed[d, p, j]
    return row


@native
def _keep(domain: U64, b: int, partners: U64, d: int, row: int) -> int:
    """Remove patterns that are no partners from the domain of b: 0 unchanged, 1 changed, -1 none would be left."""
    rest, less = ZERO, ZERO
    for j in range(domain.shape[1]):
        rest |= domain[b, j] & partners[d, row, j]
        less |= domain[b, j] & ~partners[d, row, j]
    if less == ZERO:
        return 0
    if rest == ZERO:
        return -1
    for j in range(domain.shape[1]):
        domain[b, j] &= partners[d, row, j]
    return 1


@native
def collapse(
    domain: U64,
    initial: U64,
    wider: U64,
    neighbours: I32,
    allowed: U64,
    weights: I64,
    tile: I64,
    heavy: I64,
    logs: I64,
    noise: I32,
    state: U64,
    hits: I16,
    start: I64,
    counted: U8,
    settings: I64,
    report: I64,
) -> int:
    """Give every place one pattern, in place; return DONE, IMPOSSIBLE or TIRED.

    Args:
        domain: uint64 [n, words], patterns still possible at each place.
        initial: the same at the start, restored when a place is reset.
        wider: further patterns that a place then gets if that does not help, [n, words] or of length 0.
        neighbours: [n, 4], -1 for none; direction d and d ^ 1 are opposite.
        allowed: [4, patterns, words].
        weights, heavy: [patterns]; heavy is weight times its logarithm, as logs.
        tile: [patterns], the tile that is balanced.
        logs: of 0 to the sum of the weights, times 2^20.
        noise: [n], to break ties.
        state: state of the random numbers.
        hits: [n], how often no pattern was left for a place.
        start: the places whose domains are propagated first.
        counted: [n], whether a place counts for the balance.
        settings: balance (0: none, else number of smoothing places), maximum repairs, first radius of a repair, maximum
            steps, whether nothing was observed before, whether row by row.
        report: output: repairs, the place of the first contradiction, places widened, steps.
    """
    n, words = domain.shape
    balance, max_repairs, radius0, work = settings[0], settings[1], settings[2], settings[3]
    scan = settings[5] != 0
    fresh = settings[4] != 0  # nothing was observed so far: the input is contradictory
    patterns = len(weights)
    placed, shares = np.zeros(patterns, np.int64), np.zeros(patterns, np.int64)
    totals = np.zeros(2, np.int64)
    for p in range(patterns):
        totals[1] += weights[p]
        shares[tile[p]] += weights[p]
    single = np.full(n, -1, np.int32)
    chance = np.empty(patterns, np.int64)
    domains, partners = np.zeros((4, 4096, words), np.uint64), np.empty((4, 4096, words), np.uint64)
    queue = np.empty(n + 1, np.int64)
    waiting = np.zeros(n, np.uint8)
    head, size = 0, 0
    for i in range(len(start)):
        queue[size] = start[i]
        waiting[start[i]] = 1
        size += 1
    current = np.full(n, -1, np.int64)
    keys, places = np.empty(n + 1024, np.int64), np.empty(n + 1024, np.int64)
    heap = 0
    for a in range(n):
        p = _single_pattern(domain[a])
        if p == -2:
            report[1] = a
            return IMPOSSIBLE
        if p >= 0:
            single[a] = p
            placed[tile[p]] += counted[a]
            totals[0] += counted[a]
        else:
            current[a] = a if scan else _entropy(domain[a], weights, heavy, logs) + noise[a]
            if heap + 1 >= len(keys):
                return TIRED
            heap = _push(keys, places, heap, current[a], a)
    seen = np.zeros(n, np.int32)
    turn = np.int32(0)
    block = np.empty(n, np.int64)
    observed = False
    while True:
        # propagate known patterns
        while size > 0:
            a = queue[head]
            head = head + 1 if head < n else 0
            size -= 1
            waiting[a] = 0
            broken = -1
            for d in range(4):
                b = neighbours[a, d]
                if b < 0:
                    continue
                row = _find_partners(domain, a, d, allowed, domains, partners)
                outcome = _keep(domain, b, partners, d, row)
                report[3] += words
                if outcome == 0:
                    continue
                if outcome < 0:
                    broken = b
                    break
                if waiting[b] == 0:
                    tail = head + size
                    queue[tail if tail <= n else tail - n - 1] = b
                    waiting[b] = 1
                    size += 1
                p = _single_pattern(domain[b])
                if p >= 0 and single[b] < 0:
                    single[b] = p
                    placed[tile[p]] += counted[b]
                    totals[0] += counted[b]
                    current[b] = -1
                elif p == -1:
                    key = b if scan else _entropy(domain[b], weights, heavy, logs) + noise[b]
                    if key != current[b]:
                        current[b] = key
                        if heap + 1 >= len(keys):
                            # drop stale entries before the heap grows
                            fresh_size = 0
                            for i in range(heap):
                                if current[places[i]] == keys[i]:
                                    fresh_size = _push(keys, places, fresh_size, keys[i], places[i])
                            heap = fresh_size
                            if 2 * heap > len(keys):
                                more_keys = np.empty(2 * len(keys), np.int64)
                                more_places = np.empty(2 * len(keys), np.int64)
                                more_keys[:heap], more_places[:heap] = keys[:heap], places[:heap]
                                keys, places = more_keys, more_places
                        heap = _push(keys, places, heap, key, b)
            if broken < 0:
                continue
            # contradiction: reset the places around it
            report[0] += 1
            if report[1] < 0:
                report[1] = broken
            if report[0] > max_repairs or report[3] > work:
                return TIRED
            if fresh and not observed and len(wider) == 0:
                report[1] = broken
                return IMPOSSIBLE
            hits[broken] += 1
            radius = radius0 + radius0 * (hits[broken] - 1)
            turn += 1
            count, done = 1, 0
            block[0] = broken
            seen[broken] = turn
            for _ in range(radius):
                until = count
                for i in range(done, until):
                    for d in range(4):
                        b = neighbours[block[i], d]
                        if b >= 0 and seen[b] != turn:
                            seen[b] = turn
                            block[count] = b
                            count += 1
                done = until
                if done == count:
                    break
            if count == n and hits[broken] > 6 and len(wider) == 0:
                return IMPOSSIBLE
            widen = len(wider) > 0 and (hits[broken] > 3 or (fresh and not observed))
            for i in range(count):
                b = block[i]
                if hits[b] < hits[broken]:
                    hits[b] = max(hits[b], hits[broken] - 1)
                if single[b] >= 0:
                    placed[tile[single[b]]] -= counted[b]
                    totals[0] -= counted[b]
                    single[b] = -1
                for j in range(words):
                    if widen:
                        initial[b, j] |= wider[b, j]
                    domain[b, j] = initial[b, j]
                if widen:
                    report[2] += 1
                p = _single_pattern(domain[b])
                if p >= 0:
                    single[b] = p
                    placed[tile[p]] += counted[b]
                    totals[0] += counted[b]
                    current[b] = -1
                else:
                    current[b] = b if scan else _entropy(domain[b], weights, heavy, logs) + noise[b]
                    if heap + 1 >= len(keys):
                        more_keys = np.empty(2 * len(keys), np.int64)
                        more_places = np.empty(2 * len(keys), np.int64)
                        more_keys[:heap], more_places[:heap] = keys[:heap], places[:heap]
                        keys, places = more_keys, more_places
                    heap = _push(keys, places, heap, current[b], b)
                if waiting[b] == 0:
                    tail = head + size
                    queue[tail if tail <= n else tail - n - 1] = b
                    waiting[b] = 1
                    size += 1
            for i in range(count):
                for d in range(4):
                    b = neighbours[block[i], d]
                    if b >= 0 and waiting[b] == 0:
                        tail = head + size
                        queue[tail if tail <= n else tail - n - 1] = b
                        waiting[b] = 1
                        size += 1
        if report[3] > work:
            return TIRED
        # observe the place with the lowest entropy
        cell = -1
        while heap > 0 and cell < 0:
            heap = _pop(keys, places, heap)
            if current[places[heap]] == keys[heap] and single[places[heap]] < 0:
                cell = places[heap]
        if cell < 0:
            return DONE
        observed = True
        p = _observe(domain[cell], weights, tile, shares, placed, totals, balance, state, chance)
        for j in range(words):
            domain[cell, j] = ZERO
        domain[cell, p >> 6] = ONE << np.uint64(p & 63)
        single[cell] = p
        current[cell] = -1
        placed[tile[p]] += counted[cell]
        totals[0] += counted[cell]
        queue[head] = cell
        waiting[cell] = 1
        size = 1


def compile_all() -> None:
    """Compile all kernels: call each one once on a tiny lattice."""
    one = np.ones((2, 1), np.uint64)
    for wider in (one, one[:0]):
        collapse(
            one.copy(),
            one.copy(),
            wider,
            np.full((2, 4), -1, np.int32),
            np.ones((4, 1, 1), np.uint64),
            np.ones(1, np.int64),
            np.zeros(1, np.int64),
            np.zeros(1, np.int64),
            np.zeros(2, np.int64),
            np.zeros(2, np.int32),
            np.ones(1, np.uint64),
            np.zeros(2, np.int16),
            np.arange(2),
            np.ones(2, np.uint8),
            np.array([0, 1, 1, 1, 1, 0]),
            np.zeros(4, np.int64),
        )

"""Wave-function collapse: grids in which every small window occurs in a sample.

In the overlapping model (M. Gumin, WaveFunctionCollapse, 2016) every window of N × N tiles of the sample is a pattern;
two patterns may be adjacent if they agree on their overlap. In the simple tiled model blocks of cells are tiles, which
may be adjacent if they are in the sample. A tile is one cell or a block of cells; the sample may be rotated and
mirrored. ``app.generate._kernels_wfc`` solves any lattice of windows.

Arrays are [row, column] as in ``OccupancyGrid``: row 0 is the lowest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from app.errors import CannotGenerate
from app.model.grid import FREE

U8 = NDArray[np.uint8]
I64 = NDArray[np.int64]
U64 = NDArray[np.uint64]
Bool = NDArray[np.bool_]

DONE, IMPOSSIBLE, TIRED = 0, 1, 2
"""Results as in ``_kernels_wfc``, which is imported on demand."""

Symmetry = Literal["none", "mirror", "rotate", "all"]

MAX_PATTERNS = 4096
MAX_TILES = 4096
MAX_WEIGHT = 2**16
"""Approximate sum of all patterns' weights: entropies are read from a table of this length."""

MAX_WORK = 3_000_000_000
"""Words of 64 patterns that are processed before an attempt is given up: some minutes."""

MAX_PLACES = 2**22
"""Maximum number of tiles of a result."""

BALANCE = 300
"""Number of places that smooth the counts of placed patterns, for balanced weights."""

ATTEMPTS = 4
MAX_ROUNDS = 12
"""Number of attempts to join free space."""

SEARCH_RADIUS_TILES = 32
"""Tiles around an isolated piece in which a path to the rest is searched first."""

DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0))
"""Steps (row, column): direction d and d ^ 1 are opposite."""


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """Model learned from a sample.

    Attributes:
        tiles: uint8 [T, t, t] cells.
        patterns: int64 [P, N, N] tiles.
        weights: int64 [P], scaled count of each in the sample.
        allowed: uint64 [4, P, words], patterns that may be adjacent to each.
    """

    tiles: U8
    patterns: I64
    weights: I64
    allowed: U64

    @property
    def tile(self) -> int:
        """Number of cells along a tile."""
        return int(self.tiles.shape[1])

    @property
    def size(self) -> int:
        """Number of tiles along a pattern."""
        return int(self.patterns.shape[1])

    @property
    def classes(self) -> I64:
        """Groups of patterns for the balance: those with the same tile at the upper right. int64 [P], below P."""
        return np.unique(self.patterns[:, -1, -1], return_inverse=True)[1].reshape(-1).astype(np.int64)

    @property
    def words(self) -> int:
        """Number of 64-bit words of a domain."""
        return (len(self.patterns) + 63) // 64


def symmetries(cells: NDArray[Any], symmetry: Symmetry) -> list[NDArray[Any]]:
    """Return a sample as it is, mirrored left to right, rotated by quarters, or all eight variants."""
    if symmetry == "none":
        return [cells]
    if symmetry == "mirror":
        return [cells, cells[:, ::-1]]
    quarters = [np.rot90(cells, k) for k in range(4)]
    return quarters if symmetry == "rotate" else [*quarters, *(q[:, ::-1] for q in quarters)]


def learn(
    cells: U8,
    *,
    tile: int,
    pattern: int,
    symmetry: Symmetry,
    wrap: bool = False,
    valid: Bool | None = None,
) -> Model:
    """Learn a model from a sample.

    Args:
        tile: cells along a tile, a divisor of the sample's sides.
        pattern: tiles along a pattern; 1 is the simple tiled model.
        wrap: whether the sample continues at its other side.
        valid: cells to learn from; windows with other cells are skipped.

    Raises CannotGenerate if there are too many patterns, or none.
    """
    height, width = cells.shape
    if height % tile or width % tile or min(height, width) < tile * max(pattern, 2):
        raise CannotGenerate(
            f"a sample of {width} × {height} cells does not contain {max(pattern, 2)} × {max(pattern, 2)} tiles of "
            f"{tile} cells, or a whole number of them: use a larger sample, or a smaller tile or pattern"
        )
    sure = np.ones(cells.shape, bool) if valid is None else valid
    blocks = [_blocks(one, tile) for one in symmetries(cells, symmetry)]
    teach = [_blocks(one, tile).min(axis=(2, 3)) for one in symmetries(sure, symmetry)]
    tiles, index = _distinct(np.concatenate([b.reshape(-1, tile * tile) for b in blocks]))
    if len(tiles) > MAX_TILES:
        raise CannotGenerate(f"the sample has {len(tiles)} different tiles; the limit is {MAX_TILES}: use smaller ones")
    maps, at = [], 0
    for b in blocks:
        rows, columns = b.shape[:2]
        maps.append(index[at : at + rows * columns].reshape(rows, columns).astype(np.uint16))
        at += rows * columns
    windows = []
    for one, good in zip(maps, teach, strict=True):
        taught = _windows(_wrap(good, pattern, wrap), pattern).all(axis=(2, 3))
        windows.append(_windows(_wrap(one, pattern, wrap), pattern)[taught].reshape(-1, pattern * pattern))
    if not sum(len(f) for f in windows):
        raise CannotGenerate(
            f"no window of {pattern} × {pattern} tiles of the sample is completely known: use a smaller pattern"
        )
    patterns, pattern_index = _distinct(np.concatenate(windows))
    if len(patterns) > MAX_PATTERNS:
        raise CannotGenerate(
            f"the sample has {len(patterns)} different patterns; the limit is {MAX_PATTERNS}: use a smaller pattern, "
            "fewer symmetries, or a simpler sample"
        )
    counts = np.bincount(pattern_index, minlength=len(patterns))
    stack = patterns.reshape(-1, pattern, pattern).astype(np.int64)
    if pattern == 1:
        pairs = [_pairs(m, t, wrap) for m, t in zip(maps, teach, strict=True)]
        place = np.full(len(tiles), -1, np.int64)
        place[patterns[:, 0]] = np.arange(len(patterns))
        allowed = _observed_pairs(len(patterns), [[place[side] for side in pair] for pair in pairs])
    else:
        allowed = agreeing(stack)
    return Model(tiles.reshape(-1, tile, tile).astype(np.uint8), stack, scale_weights(counts), allowed)


def scale_weights(counts: I64) -> I64:
    """Scale weights to at least 1, with a sum of about MAX_WEIGHT."""
    total = max(int(counts.sum()), 1)
    return np.maximum(counts * (MAX_WEIGHT - len(counts)) // total, 1).astype(np.int64)


def agreeing(patterns: I64) -> U64:
    """Return allowed[d, p]: the patterns that agree with p in their overlap, one tile further in direction d."""
    n = patterns.shape[1]
    out = []
    for dy, dx in DIRECTIONS:
        part = patterns[:, max(dy, 0) : n + min(dy, 0), max(dx, 0) : n + min(dx, 0)].reshape(len(patterns), -1)
        other = patterns[:, max(-dy, 0) : n + min(-dy, 0), max(-dx, 0) : n + min(-dx, 0)].reshape(len(patterns), -1)
        _, key = _distinct(np.concatenate([part, other]))
        a, b = key[: len(patterns)], key[len(patterns) :]
        out.append(pack_bits(a[:, None] == b[None, :]))
    return np.stack(out)


def pack_bits(mask: Bool) -> U64:
    """Pack bool [n, P] as uint64 [n, words], bit p of a row for pattern p."""
    words = (mask.shape[1] + 63) // 64
    bits = np.zeros((len(mask), words * 8), np.uint8)
    some = np.packbits(mask, axis=1, bitorder="little")
    bits[:, : some.shape[1]] = some
    return np.ascontiguousarray(bits.view("<u8").astype(np.uint64))


def _observed_pairs(count: int, pairs: list[list[I64]]) -> U64:
    """Return ``allowed`` of tiles: those right of and above each in the sample, and the reverse."""
    right, above = np.zeros((count, count), bool), np.zeros((count, count), bool)
    for left_, right_, low, high in pairs:
        right[left_, right_] = True
        above[low, high] = True
    return np.stack([pack_bits(right), pack_bits(right.T), pack_bits(above), pack_bits(above.T)])


def _pairs(tiles: NDArray[Any], teach: Bool, wrap: bool) -> list[I64]:
    """Yield (left, right, low, high) of all neighbours that are both known."""
    out = []
    for axis in (1, 0):
        if wrap:
            other, both = np.roll(tiles, -1, axis), teach & np.roll(teach, -1, axis)
            out += [tiles[both], other[both]]
        else:
            a, b = (slice(None, -1), slice(1, None))
            cut: list[tuple[Any, Any]] = (
                [(slice(None), a), (slice(None), b)] if axis else [(a, slice(None)), (b, slice(None))]
            )
            both = teach[cut[0]] & teach[cut[1]]
            out += [tiles[cut[0]][both], tiles[cut[1]][both]]
    return out


def _blocks(cells: NDArray[Any], tile: int) -> NDArray[Any]:
    """Return the tiles as [rows, columns, tile, tile]."""
    height, width = cells.shape
    return np.ascontiguousarray(cells.reshape(height // tile, tile, width // tile, tile).transpose(0, 2, 1, 3))


def _wrap(tiles: NDArray[Any], pattern: int, wrap: bool) -> NDArray[Any]:
    return np.pad(tiles, (0, pattern - 1), mode="wrap") if wrap and pattern > 1 else tiles


def _windows(tiles: NDArray[Any], pattern: int) -> Any:
    return np.lib.stride_tricks.sliding_window_view(tiles, (pattern, pattern))


def _distinct(rows: NDArray[Any]) -> tuple[NDArray[Any], I64]:
    """Return the distinct rows in ascending order, and the index of each row in them."""
    width = 1 if rows.dtype.itemsize == 1 else 2  # tiles and patterns are below 2^16
    bytes_ = np.ascontiguousarray(rows, f">u{width}").view(f"V{rows.shape[1] * width}").reshape(-1)
    _, first, index = np.unique(bytes_, return_index=True, return_inverse=True)
    return rows[first], np.asarray(index, np.int64).reshape(-1)


@dataclass(frozen=True, slots=True, eq=False)
class Lattice:
    """Windows of tiles.

    Attributes:
        rows, columns: int64 [n], the lower left tile of each.
        neighbours: int32 [n, 4].
        shape: (rows, columns) of the tiles.

    Windows of a periodic lattice continue at the other side.
    """

    rows: I64
    columns: I64
    neighbours: NDArray[np.int32]
    shape: tuple[int, int]
    periodic: bool

    @classmethod
    def from_shape(
        cls, shape: tuple[int, int], pattern: int, *, periodic: bool = False, target: Bool | None = None
    ) -> Lattice:
        """Return all windows of a lattice; target: bool [rows, columns] of tiles, only windows that cover one."""
        height, width = shape
        if not periodic:
            height, width = height - pattern + 1, width - pattern + 1
        present = np.ones((height, width), bool)
        if target is not None:
            tiles = np.pad(target, (0, pattern - 1), mode="wrap") if periodic else target
            total = np.pad(tiles.astype(np.int64), ((1, 0), (1, 0))).cumsum(0).cumsum(1)
            n = pattern
            present = (total[n:, n:] - total[:-n, n:] - total[n:, :-n] + total[:-n, :-n]) > 0
        rows, columns = np.nonzero(present)
        index = np.full((height, width), -1, np.int32)
        index[rows, columns] = np.arange(len(rows), dtype=np.int32)
        neighbours = np.empty((len(rows), 4), np.int32)
        for d, (dy, dx) in enumerate(DIRECTIONS):
            y, x = rows + dy, columns + dx
            if periodic:
                neighbours[:, d] = index[y % height, x % width]
            else:
                inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
                neighbours[:, d] = np.where(inside, index[y.clip(0, height - 1), x.clip(0, width - 1)], -1)
        return cls(rows.astype(np.int64), columns.astype(np.int64), neighbours, shape, periodic)

    def fitting(self, patterns: I64, fixed: NDArray[Any], wall: int = -1) -> U64:
        """Return uint64 [n, words]: the patterns with the fixed tiles of each window (int64 [rows, columns], -1: any).

        wall: a tile that occurs only at fixed positions.
        """
        n = patterns.shape[1]
        words = (len(patterns) + 63) // 64
        out = np.broadcast_to(pack_bits(np.ones((1, len(patterns)), bool)), (len(self.rows), words)).copy()
        by_tile: dict[tuple[int, int, int], U64] = {}
        for dy in range(n):
            for dx in range(n):
                y, x = self.rows + dy, self.columns + dx
                if self.periodic:
                    y, x = y % self.shape[0], x % self.shape[1]
                fixed_tile = fixed[y, x]
                if wall >= 0:
                    out[fixed_tile != wall] &= pack_bits((patterns[:, dy, dx] != wall)[None])
                for tile in np.unique(fixed_tile[fixed_tile != -1]).tolist():
                    if (dy, dx, tile) not in by_tile:
                        by_tile[dy, dx, tile] = pack_bits((patterns[:, dy, dx] == tile)[None])
                    out[fixed_tile == tile] &= by_tile[dy, dx, tile]
        return out


@dataclass(slots=True, eq=False)
class Wave:
    """Lattice that is being solved; parts of it can be solved again under further conditions."""

    model: Model
    lattice: Lattice
    initial: U64
    wider: U64
    state: U64
    balance: int
    repairs: int
    domain: U64
    heavy: I64
    logs: I64
    noise: NDArray[np.int32]
    hits: NDArray[np.int16]
    counted: U8
    report: I64
    scan: bool

    @classmethod
    def start(
        cls,
        model: Model,
        lattice: Lattice,
        initial: U64,
        draw: np.random.Generator,
        *,
        balance: int,
        repairs: int,
        scan: bool,
        counted: Bool | None = None,
        wider: U64 | None = None,
    ) -> Wave:
        """Set up a lattice with all patterns possible. draw: seeds later draws; others: see ``_kernels_wfc``."""
        n = len(lattice.rows)
        weights = model.weights
        total = int(weights.sum())
        logs = np.zeros(total + 1, np.int64)
        exact = np.log2(np.arange(1, total + 1, dtype=np.float64))
        logs[1:] = np.rint(exact * 2**20).astype(np.int64)
        heavy = weights * logs[weights]
        state = draw.integers(0, 2**63, 1, dtype=np.int64).astype(np.uint64)
        noise = draw.integers(0, 2**12, n, dtype=np.int64).astype(np.int32)
        none = np.empty((0, model.words), np.uint64)
        return cls(
            model,
            lattice,
            initial,
            none if wider is None else wider,
            state,
            balance,
            repairs,
            initial.copy(),
            heavy,
            logs,
            noise,
            np.zeros(n, np.int16),
            np.ones(n, np.uint8) if counted is None else counted.astype(np.uint8),
            np.array([0, -1, 0, 0]),
            scan,
        )

    def run(self, start: I64 | None = None) -> int:
        """Collapse; start: places that were reset, else all. Returns the result, see ``_kernels_wfc``."""
        from app.generate import _kernels_wfc as kernels

        fresh = start is None
        settings = np.array(
            [self.balance, self.repairs, self.model.size + 1, MAX_WORK, int(fresh), int(self.scan)], np.int64
        )
        return kernels.collapse(
            self.domain,
            self.initial,
            self.wider,
            self.lattice.neighbours,
            self.model.allowed,
            self.model.weights,
            self.model.classes,
            self.heavy,
            self.logs,
            self.noise,
            self.state,
            self.hits,
            np.arange(len(self.domain)) if start is None else start,
            self.counted,
            settings,
            self.report,
        )

    def tiles(self) -> I64:
        """Return int64 [rows, columns]: the placed tiles; -1 if no window covers one. Only after DONE."""
        word = np.argmax(self.domain != 0, axis=1)
        bits = self.domain[np.arange(len(self.domain)), word]
        chosen = word * 64 + np.rint(np.log2(bits.astype(np.float64))).astype(np.int64)
        out = np.full(self.lattice.shape, -1, np.int64)
        for dy in range(self.model.size):
            for dx in range(self.model.size):
                y, x = self.lattice.rows + dy, self.lattice.columns + dx
                out[y % self.lattice.shape[0], x % self.lattice.shape[1]] = self.model.patterns[chosen, dy, dx]
        return out


def collapse_model(
    model: Model,
    shape: tuple[int, int],
    fixed: I64,
    draw: Callable[[str], np.random.Generator],
    *,
    periodic: bool = False,
    scan: bool = True,
    joined: bool = False,
    repairs: int = 20_000,
    wall: int = -1,
) -> I64:
    """Return tiles int64 [rows, columns] of which every window is a pattern of the model.

    Args:
        fixed: int64 [rows, columns], the given tiles, -1 elsewhere.
        wall: tile that occurs only at fixed positions.
        draw: random stream by name.
        scan: decide places row by row, which preserves the sample's statistics, instead of by lowest entropy.
        joined: make all free cells one piece, by their sides.

    Raises CannotGenerate if there is no solution.
    """
    if shape[0] * shape[1] > MAX_PLACES:
        raise CannotGenerate(
            f"the site has {shape[1]} × {shape[0]} tiles; the limit is {MAX_PLACES}: make the site smaller, "
            "or use larger tiles"
        )
    lattice = Lattice.from_shape(shape, model.size, periodic=periodic)
    initial = lattice.fitting(model.patterns, fixed, wall)
    free = fixed[(lattice.rows + model.size - 1) % shape[0], (lattice.columns + model.size - 1) % shape[1]] == -1
    why = ""
    for attempt in range(ATTEMPTS):
        wave = Wave.start(
            model,
            lattice,
            initial.copy(),
            draw(f"wave/{attempt}"),
            balance=BALANCE,
            repairs=repairs,
            scan=scan,
            counted=free,
        )
        ended = wave.run()
        if ended == IMPOSSIBLE and attempt == 0 and wave.report[0] <= 1:
            at = int(wave.report[1])
            raise CannotGenerate(
                f"the fixed cells contradict the sample at row {lattice.rows[at]}, column {lattice.columns[at]}, where "
                "no pattern fits: use a sample that contains such a place, another border or symmetry, or a smaller "
                "pattern"
            )
        if ended != DONE:
            why = f"{int(wave.report[0])} contradictions could not be repaired"
            continue
        if not joined or _join(wave):
            return wave.tiles()
        why = "the free space could not be joined"
    raise CannotGenerate(
        f"{why} in {ATTEMPTS} attempts: use another seed, a smaller pattern, a simpler sample or another border"
        + (", or connected=false" if joined else "")
    )


def _join(wave: Wave) -> bool:
    """Join the free cells: close each isolated piece, or open a path to the rest, and solve its surroundings again.

    Returns whether that was possible.
    """
    import cv2

    tile = wave.model.tile
    for turn in range(MAX_ROUNDS):
        free = render(wave.model, wave.tiles()) == FREE
        count, label = cv2.connectedComponents(free.astype(np.uint8), connectivity=4)
        if wave.lattice.periodic:
            label = _join_borders(np.asarray(label))
        sizes = np.bincount(label.ravel(), minlength=count)
        sizes[0] = 0
        main = int(np.argmax(sizes))
        apart = [k for k in range(1, count) if sizes[k] and k != main]
        if not apart:
            return bool(sizes[main])
        main_tiles = _blocks(label == main, tile).max(axis=(2, 3))
        cells = _blocks(label, tile)
        for k in apart:
            small = sizes[k] <= 8 * (wave.model.size * tile) ** 2
            _mend(wave, (cells == k).max(axis=(2, 3)), main_tiles, close=bool((turn + k) % 2 == 0 and small))
    return False


def _join_borders(label: NDArray[np.int32]) -> NDArray[np.int32]:
    """Merge labels that touch across the borders of a periodic lattice."""
    out = label.copy()
    for a, b in ((0, -1), (-1, 0)):
        for one, other in ((out[a], out[b]), (out[:, a], out[:, b])):
            for p, q in sorted({(int(p), int(q)) for p, q in zip(one, other, strict=True) if p and q and p != q}):
                now, then = min(p, q), max(p, q)
                out[out == then] = now
    return out


def _mend(wave: Wave, piece: Bool, main: Bool, *, close: bool) -> None:
    """Close an isolated piece, or open the shortest path from it to the main one; no change on contradiction.

    Pieces are bool [rows, columns] of tiles that contain any cell of them.
    """
    from scipy import ndimage

    lattice, model = wave.lattice, wave.model
    rows, columns = np.nonzero(piece)
    if close:
        cells = rows, columns
        matching = (model.tiles != FREE).all(axis=(1, 2))
    else:
        low_y, high_y = max(int(rows.min()) - SEARCH_RADIUS_TILES, 0), int(rows.max()) + SEARCH_RADIUS_TILES + 1
        low_x, high_x = max(int(columns.min()) - SEARCH_RADIUS_TILES, 0), int(columns.max()) + SEARCH_RADIUS_TILES + 1
        part = main[low_y:high_y, low_x:high_x]
        if not part.any():
            low_y = low_x = 0
            part = main
        away, (to_y, to_x) = ndimage.distance_transform_edt(~part, return_indices=True)
        best = int(np.argmin(away[rows - low_y, columns - low_x]))
        y, x = int(rows[best]) - low_y, int(columns[best]) - low_x
        end_y, end_x = int(to_y[y, x]), int(to_x[y, x])
        ys = [*range(y, end_y, 1 if end_y > y else -1), *[end_y] * (abs(end_x - x) + 1)]
        xs = [*[x] * abs(end_y - y), *range(x, end_x, 1 if end_x > x else -1), end_x]
        cells = np.array(ys) + low_y, np.array(xs) + low_x
        matching = (model.tiles == FREE).all(axis=(1, 2))
    touched: dict[int, U64] = {}
    masks = {
        (dy, dx): pack_bits(matching[model.patterns[:, dy, dx]][None])[0]
        for dy in range(model.size)
        for dx in range(model.size)
    }
    place = np.full(lattice.shape, -1, np.int64)
    place[lattice.rows, lattice.columns] = np.arange(len(lattice.rows))
    for y, x in zip(cells[0].tolist(), cells[1].tolist(), strict=True):
        for (dy, dx), mask in masks.items():
            v, u = y - dy, x - dx
            if lattice.periodic:
                v, u = v % lattice.shape[0], u % lattice.shape[1]
            if v < 0 or u < 0 or place[v, u] < 0:
                continue
            i = int(place[v, u])
            touched[i] = touched.get(i, wave.initial[i]) & mask
    if any(not domain.any() for domain in touched.values()):
        return
    before = wave.domain.copy(), wave.initial.copy()
    piece_places = place[rows, columns]  # the piece itself
    near = np.union1d(np.fromiter(touched, np.int64), piece_places[piece_places >= 0])
    for _ in range(2 * model.size):
        around = wave.lattice.neighbours[near].ravel()
        near = np.union1d(near, around[around >= 0])
    for i, domain in touched.items():
        wave.initial[i] = domain
    wave.domain[near] = wave.initial[near]
    ring = wave.lattice.neighbours[near].ravel()
    repairs, wave.repairs = wave.repairs, int(wave.report[0]) + 50
    ended = wave.run(np.union1d(near, ring[ring >= 0]).astype(np.int64))
    wave.repairs = repairs
    if ended != DONE:
        wave.domain[:], wave.initial[:] = before


def render(model: Model, tiles: I64) -> U8:
    """Convert tiles (all of them known) to cells."""
    blocks = model.tiles[tiles]
    rows, columns = tiles.shape
    return np.ascontiguousarray(blocks.transpose(0, 2, 1, 3).reshape(rows * model.tile, columns * model.tile))

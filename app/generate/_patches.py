"""Wave-function collapse at the scale of things: patches of a sample as large as a rack with its aisle, or a room.

Windows of a few cells know walls and gaps, but neither racks nor aisles; in a scan each is different, and they
contradict each other. Here a real grid is first drawn in blocks of some decimetres. A patch is a window of blocks, as
wide as an obstacle and the free space beside it usually are; two patches may be neighbours if they share a row of
blocks, as Wang tiles share a side (compare image quilting: Efros and Freeman, SIGGRAPH 2001). Where no patch fits,
sides may differ by a block or two: a contradiction is healed, and reported, instead of refused.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.derive import DerivationNotes
from app.errors import CannotGenerate
from app.generate import _wfc
from app.generate._site import invalid_option_error
from app.model.grid import FREE, OCCUPIED

U8 = NDArray[np.uint8]
Bool = NDArray[np.bool_]
I64 = NDArray[np.int64]

BLOCKS = 8
"""Default number of blocks from one patch to the next."""

PERIOD_METRES = (1.2, 4.0)
"""Minimum and maximum side of a patch, if it is measured."""

RUN_METRES = (0.3, 5.0)
"""Lengths of obstacles, and of free space between them, that are things and aisles."""

BLOCK_SHARE = 0.2
WALL_SHARE = 0.6
"""Minimum share of occupied cells of an occupied block; or of its side, if they belong to a wall that crosses it."""

SPECK_METRES = 0.3
"""Minimum length of a piece of wall; shorter ones are specks of a scan."""

CLOSED_SHARE = 0.6
CLOSED_METRES = 0.5
"""Minimum share of the lines across a closed sample that meet a wall this near to where what is known begins."""

KNOWN_SHARE = 0.5
"""Minimum share of known blocks of a patch; the others are beyond walls, and count as solid."""

MAX_PATCHES = 3000
MAX_DIFFERENCE = 2
"""Maximum number of blocks by which two sides may differ where no patch fits."""

MAIN_SHARE = 0.6
"""Minimum share of the free blocks that one piece has; smaller ones are closed."""

BALANCE = 30
"""Number of places that smooth the counts of placed patches."""


@dataclass(frozen=True, slots=True)
class Coarse:
    """Sample in blocks of ``block`` cells. cells: uint8 [rows, columns] FREE or OCCUPIED. observed: which are known."""

    cells: U8
    observed: Bool
    block: int


def usual_period(cells: U8, resolution: float) -> float:
    """Return the usual width of an obstacle and the free space beside it, in metres; cells as ``filled`` gives them."""
    widths: list[float] = []
    for value in (OCCUPIED, FREE):
        runs = np.concatenate([_runs(lines, value) for lines in (cells, cells.T)]) * resolution
        things = runs[(runs >= RUN_METRES[0]) & (runs <= RUN_METRES[1])]
        widths.append(float(np.median(things)) if len(things) else 0.0)
    return float(np.clip(sum(widths), *PERIOD_METRES))


def _runs(cells: U8, value: int) -> NDArray[np.float64]:
    """Return the lengths of runs of a value along rows that do not touch the sample's border."""
    same = np.pad((cells == value).astype(np.int8), ((0, 0), (1, 1)))
    step = np.diff(same, axis=1)
    start, stop = np.argwhere(step == 1), np.argwhere(step == -1)
    inner = (start[:, 1] > 0) & (stop[:, 1] < cells.shape[1])
    return np.asarray(stop[inner, 1] - start[inner, 1], np.float64)


def filled(cells: U8, observed: Bool) -> tuple[U8, Bool]:
    """Return a sample without its unknown margin, in which unknown holes of obstacles belong to them.

    cells: FREE or OCCUPIED. observed: which of them are known. Unknown cells that reach the margin stay unknown.
    """
    import cv2

    rows, columns = np.flatnonzero(observed.any(axis=1)), np.flatnonzero(observed.any(axis=0))
    if not len(rows):
        raise invalid_option_error("sample", "has no known cell")
    part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    cells, observed = cells[part].copy(), observed[part]
    count, label = cv2.connectedComponents(np.pad((~observed).astype(np.uint8), 1, constant_values=1), connectivity=4)
    outside = np.asarray(label[1:-1, 1:-1] == label[0, 0])
    hole = ~observed & ~outside
    if count > 1:
        cells[hole] = OCCUPIED
    return cells, observed | hole


def coarse(cells: U8, observed: Bool, block: int, resolution: float) -> Coarse:
    """Draw a sample in blocks, occupied if enough of a block is or if a wall crosses it; what is unknown is solid."""
    import cv2

    rows, columns = (n // block for n in cells.shape)
    if not rows * columns:
        side = f"{cells.shape[1]} × {cells.shape[0]} cells"
        raise invalid_option_error("tile", f"the sample of {side} is smaller than a tile of {block}")
    top, left = ((n - m * block) // 2 for n, m in zip(cells.shape, (rows, columns), strict=True))
    part = np.s_[top : top + rows * block, left : left + columns * block]

    def count(mask: Bool) -> I64:
        return np.asarray(mask[part].reshape(rows, block, columns, block).sum(axis=(1, 3)), np.int64)

    full = (cells == OCCUPIED) & observed
    _, label, stats, _ = cv2.connectedComponentsWithStats(full.astype(np.uint8), connectivity=8)
    long = np.maximum(stats[:, cv2.CC_STAT_WIDTH], stats[:, cv2.CC_STAT_HEIGHT]) * resolution >= SPECK_METRES
    wall = full & long[label]
    occupied = (count(full) >= BLOCK_SHARE * block * block) | (count(wall) >= WALL_SHARE * block)
    sure = occupied | (2 * count(observed) >= block * block)
    return Coarse(np.where(occupied | ~sure, OCCUPIED, FREE).astype(np.uint8), sure, block)


def is_closed(cells: U8, observed: Bool, resolution: float) -> bool:
    """Return whether walls bound a sample: most lines across it meet one where what is known begins and ends."""
    near = max(1, round(CLOSED_METRES / resolution))
    seen = hits = 0
    for values, sure in ((cells, observed), (cells[:, ::-1], observed[:, ::-1])):
        for lines, sure_lines in ((values, sure), (values.T, sure.T)):
            first = np.argmax(sure_lines, axis=1)
            for number in np.flatnonzero(sure_lines.any(axis=1)).tolist():
                start = int(first[number])
                seen += 1
                hits += bool((lines[number, start : start + near] == OCCUPIED).any())
    return bool(seen) and hits >= CLOSED_SHARE * seen


def bordered(sample: Coarse, border: int) -> Coarse:
    """Return a closed sample with a border of one block around it, in place of its outer walls if they are straight."""
    cells, observed = sample.cells, sample.observed
    for _ in range(4):  # each side in turn
        while len(cells) > 1 and float((cells[-1] != FREE).mean()) >= CLOSED_SHARE:
            cells, observed = cells[:-1], observed[:-1]
            if not len(observed) or observed[-1].any():
                break
        cells, observed = np.rot90(cells), np.rot90(observed)
    if not (cells == FREE).any():
        raise invalid_option_error("sample", "has nothing but walls")
    return Coarse(np.pad(cells, 1, constant_values=border), np.pad(observed, 1, constant_values=True), sample.block)


def learn(sample: Coarse, steps: int, symmetry: _wfc.Symmetry, border: int, *, wrap: bool) -> tuple[U8, I64]:
    """Return the distinct patches uint8 [P, steps + 1, steps + 1] of a sample, and the count of each.

    border: blocks of the outer wall; patches at it are taken even where little is known.

    Raises CannotGenerate if there is none, or too many.
    """
    n = steps + 1
    taken: list[NDArray[np.uint8]] = []
    variants = zip(_wfc.symmetries(sample.cells, symmetry), _wfc.symmetries(sample.observed, symmetry), strict=True)
    more = (0, steps if wrap else 0)
    for cells, observed in variants:
        if min(cells.shape) + more[1] < n:
            continue
        seen, sure = (
            np.lib.stride_tricks.sliding_window_view(np.pad(one, more, mode="wrap"), (n, n))
            for one in (cells, observed)
        )
        usable = (sure.mean(axis=(2, 3)) >= KNOWN_SHARE) | (seen == border).any(axis=(2, 3))
        taken.append(seen[usable].reshape(-1, n * n))
    if not sum(len(rows) for rows in taken):
        raise CannotGenerate(
            f"no window of {n} × {n} blocks of {sample.block} cells of the sample is mostly known: use a smaller "
            "pattern or tile"
        )
    patches, counts = np.unique(np.concatenate(taken), axis=0, return_counts=True)
    if len(patches) > MAX_PATCHES:  # rare ones are noise more often than things; corners are rare too
        rank = np.where((patches == border).any(axis=1), counts.max() + 1, counts)
        kept = np.sort(np.argsort(-rank, kind="stable")[:MAX_PATCHES])
        patches, counts = patches[kept], counts[kept]
    return patches.reshape(-1, n, n), counts.astype(np.int64)


def neighbours(patches: U8, difference: int) -> NDArray[np.uint64]:
    """Return allowed[d, p]: patches whose side differs by at most some blocks from p's, in direction d."""
    sides = {
        (0, 1): (patches[:, :, -1], patches[:, :, 0]),
        (0, -1): (patches[:, :, 0], patches[:, :, -1]),
        (1, 0): (patches[:, -1, :], patches[:, 0, :]),
        (-1, 0): (patches[:, 0, :], patches[:, -1, :]),
    }
    out = []
    for step in _wfc.DIRECTIONS:
        side, opposite = sides[step]
        away = (side[:, None, :] != opposite[None, :, :]).sum(axis=2)
        out.append(_wfc.pack_bits(away <= difference))
    return np.stack(out)


def places(patches: U8, shape: tuple[int, int], border: int, *, closed: bool) -> Bool:
    """Return which patches fit to the border of a lattice: bool [rows, columns, P]; border blocks lie nowhere else."""
    rows, columns = shape
    on_side = [(patches[:, :, 0] == border).all(axis=1), (patches[:, :, -1] == border).all(axis=1)]
    on_side += [(patches[:, 0, :] == border).all(axis=1), (patches[:, -1, :] == border).all(axis=1)]
    out = np.ones((rows, columns, len(patches)), bool)
    if not closed:
        return out
    at_side = np.zeros((4, rows, columns), bool)
    at_side[0, :, 0], at_side[1, :, -1], at_side[2, 0], at_side[3, -1] = True, True, True, True
    for side, mask in zip(at_side, on_side, strict=True):
        out &= side[:, :, None] == mask[None, None, :]
    inner = patches[:, 1:-1, 1:-1] == border
    return np.asarray(out & ~inner.any(axis=(1, 2))[None, None], bool)


def collapse(
    patches: U8,
    counts: I64,
    allowed_at: Bool,
    draw: Callable[[str], np.random.Generator],
    notes: DerivationNotes,
    *,
    periodic: bool,
    scan: bool,
    repairs: int,
    joined: bool,
    border: int | None = None,
) -> U8:
    """Return blocks uint8 [rows, columns] of patches whose sides agree, as far as they can.

    allowed_at: bool [rows, columns, P], patches that are possible at each place. border: of a wall around them.

    Raises CannotGenerate if no patch fits somewhere, or if no attempt gives mostly connected free space.
    """
    shape = (allowed_at.shape[0], allowed_at.shape[1])
    if not allowed_at.any(axis=2).all():
        row, column = np.argwhere(~allowed_at.any(axis=2))[0].tolist()
        raise CannotGenerate(
            f"no patch of the sample fits at row {row}, column {column} of {shape[0]} × {shape[1]}: use another "
            "border, smaller patches (pattern), or fewer fixed positions"
        )
    lattice = _wfc.Lattice.from_shape(shape, 1, periodic=periodic)
    initial = _wfc.pack_bits(allowed_at.reshape(-1, len(patches)))
    index = np.arange(len(patches)).reshape(-1, 1, 1)
    why = "contradictions could not be repaired"
    for difference in range(MAX_DIFFERENCE + 1):
        model = _wfc.Model(
            np.zeros((len(patches), 1, 1), np.uint8), index, _wfc.scale_weights(counts), neighbours(patches, difference)
        )
        for attempt in range(_wfc.ATTEMPTS):
            stream = draw(f"patches/{difference}/{attempt}")
            wave = _wfc.Wave.start(model, lattice, initial.copy(), stream, balance=BALANCE, repairs=repairs, scan=scan)
            if wave.run() != _wfc.DONE:
                continue
            blocks = _blocks(patches, wave.tiles())
            if border is not None:
                blocks[[0, -1]], blocks[:, [0, -1]] = border, border
            whole = _joined(blocks) if joined else blocks
            if whole is None:
                why = "the free space could not be joined"
                continue
            if difference:
                notes.warn(f"contradictions were healed: sides of patches differ by up to {difference} blocks")
            closed = int(np.count_nonzero(whole != blocks))
            notes.drop("free blocks", closed, "closed, because they could not be reached")
            return whole
    raise CannotGenerate(f"{why}: use another seed, smaller patches (pattern), more symmetry or another border")


def _blocks(patches: U8, chosen: I64) -> U8:
    """Lay patches side by side, each without the row and column that the next one has too."""
    n = patches.shape[1] - 1
    tiles = patches[chosen][:, :, :n, :n]
    return np.ascontiguousarray(tiles.transpose(0, 2, 1, 3).reshape(chosen.shape[0] * n, chosen.shape[1] * n))


def _joined(blocks: U8) -> U8 | None:
    """Return the blocks with small isolated free pieces closed; None if there is no main piece."""
    import cv2

    _, label, stats, _ = cv2.connectedComponentsWithStats((blocks == FREE).astype(np.uint8), connectivity=4)
    sizes: Sequence[int] = stats[1:, cv2.CC_STAT_AREA].tolist()
    if not sizes or max(sizes) < MAIN_SHARE * sum(sizes):
        return None
    main = 1 + sizes.index(max(sizes))
    return np.where((blocks == FREE) & (label != main), OCCUPIED, blocks).astype(np.uint8)

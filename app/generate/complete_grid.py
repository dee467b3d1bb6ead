"""Fill in unknown cells of a grid from its known part, as far as they are certain.

Walls that continue on the other side of an unknown area, straight or in an arc, are completed. A cell becomes free if
wave-function collapse with the known cells fixed (``_wfc``) gives that, and cells with the same surroundings are free
often enough (``_evidence``). All others stay unknown. With ``confidence=0`` all cells are filled in.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from app.derive import DerivationNotes
from app.errors import CannotGenerate
from app.generate import MAX_CELLS, RandomSource, _evidence, _wfc, generates
from app.generate._site import invalid_option_error
from app.model.grid import FREE, OCCUPIED, SLICE, UNKNOWN, OccupancyGrid, unknown_grey
from app.model.layers import Layers, Part, PartKey
from app.model.selection import grey_warning, grid_label, select_grids
from app.parameters import parameter

U8 = NDArray[np.uint8]
Bool = NDArray[np.bool_]

MAX_FILLED_CELLS = 2**20
"""Maximum number of cells that are filled in at once."""

REPAIRS = 100_000

HOLE = 2.0
"""Side of the holes that measure the confidence if the reach is unlimited, in metres."""


@dataclass(frozen=True, slots=True)
class Options:
    """Parameters of complete_grid."""

    grid: str | None = parameter(
        None, "name of the grid; default: map, else the only one on a level that is not a filter mask"
    )
    reach: float = parameter(
        1.0, "maximum distance of filled-in cells from a known one; 0: unlimited", minimum=0.0, maximum=1e6
    )
    confidence: float = parameter(
        0.98,
        "minimum share of cells with the same surroundings that were free in holes cut into the known part; other "
        "cells stay unknown; 0: all cells within reach are filled in, as free or occupied",
        minimum=0.0,
        maximum=0.9999,
    )
    pattern: int = parameter(3, "number of cells along a window", minimum=2, maximum=3)
    symmetry: Literal["none", "mirror", "rotate", "all"] = parameter(
        "all", "whether the known part is also used mirrored, rotated by quarters, or both"
    )
    order: Literal["rows", "entropy"] = parameter(
        "entropy", "order of decisions: lowest entropy first, from the known part inwards, or row by row"
    )


@generates({"occupancy"}, parameters=Options, needs={"occupancy"}, version=5)
def complete_grid(given: Layers, options: Options, source: RandomSource, notes: DerivationNotes) -> Layers:
    """Fill in unknown cells of a grid that are certain: walls that continue, free cells between free ones.

    Known cells do not change. Every filled-in window occurs in the known part if possible; warnings state how many do
    not, and how many cells stay unknown. Raises CannotGenerate if no cell is unknown, no window is known, no cell is
    certain, or too many would be filled in.
    """
    parts: dict[PartKey, Part] = {}
    why = ""
    for key, grid in select_grids(given, options.grid, "obstacles").items():
        if not (grid.cells == UNKNOWN).any():
            why = f"{grid_label(key)} has no unknown cell"
            continue
        parts[key] = _complete_grid(grid, options, source, notes, key)
    if not parts:
        raise CannotGenerate(f"{why}: nothing to fill in")
    return Layers(parts, given.datum, given.levels)


def _complete_grid(
    grid: OccupancyGrid, options: Options, source: RandomSource, notes: DerivationNotes, key: PartKey
) -> OccupancyGrid:
    name = grid_label(key)
    if grid.cells.size > MAX_CELLS:
        raise CannotGenerate(f"{name} has {grid.cells.size} cells; the limit is {MAX_CELLS}")
    known_cells = grid.cells != UNKNOWN
    grey = unknown_grey(grid)
    if grey is not None:
        known_cells &= ~grey
        notes.warn(grey_warning(grid, grey, name, "they are not learned from and do not change"))
    target = _cells_to_fill(known_cells, options.reach / grid.resolution)
    if grey is not None:
        target &= ~grey
    count = int(np.count_nonzero(target))
    if count > MAX_FILLED_CELLS:
        raise invalid_option_error(
            "reach", f"{name}: {count} cells would be filled in; the limit is {MAX_FILLED_CELLS}: use a smaller reach"
        )
    if not count:
        raise invalid_option_error("reach", f"{name}: no unknown cell is that close to a known one: use a larger reach")
    occupied = known_cells & (grid.cells >= grid.occupied_thresh * OCCUPIED)
    n = options.pattern
    counts = _counts(occupied, known_cells, n, options.symmetry)
    if not counts.any():
        raise CannotGenerate(
            f"{name}: no window of {n} × {n} cells is completely known to learn from: set a smaller pattern"
        )
    cells = grid.cells.copy()
    before = _evidence.Grid(occupied, known_cells, grid.resolution)
    wall = _evidence.walls(before, target)
    cells[wall] = OCCUPIED
    occupied, known_cells, target = occupied | wall, known_cells | wall, target & ~wall
    if options.confidence:
        side = min(2 * options.reach or HOLE, _evidence.SPAN_METRES)
        share = _evidence.confidence(before, side, source.stream(f"{key.level}/{key.name}/holes"))
        at = np.argwhere(target)
        kind = _evidence.surroundings(_evidence.Grid(occupied, known_cells, grid.resolution), at)
        target = np.zeros_like(target)
        target[tuple(at[share[kind] >= options.confidence].T)] = True
        if not target.any() and not wall.any():
            reason = f"{name}: no unknown cell reaches this confidence: set a lower confidence, or a smaller reach"
            raise invalid_option_error("confidence", reason)
    if target.any():
        _fill(cells, occupied, known_cells, target, counts, options, source, notes, key)
    if options.confidence:
        left = count - int(np.count_nonzero((cells != UNKNOWN) & (grid.cells == UNKNOWN)))
        why = f"they stay unknown: free cells need a confidence of {options.confidence:g}"
        notes.drop("unknown cells", left, f"{name}: {why}")
    properties = {word: value for word, value in grid.properties.items() if word != SLICE}
    return replace(grid, cells=cells, properties=properties)


def _fill(
    cells: U8,
    occupied: Bool,
    known_cells: Bool,
    target: Bool,
    counts: NDArray[np.int64],
    options: Options,
    source: RandomSource,
    notes: DerivationNotes,
    key: PartKey,
) -> None:
    """Fill in the wanted cells, in place. Cells that are not free stay unknown unless all are to be filled in."""
    n = options.pattern
    # process only the surroundings of the wanted cells
    rows, columns = np.flatnonzero(target.any(axis=1)), np.flatnonzero(target.any(axis=0))
    y0, y1 = max(int(rows[0]) - n, 0), int(rows[-1]) + n + 1
    x0, x1 = max(int(columns[0]) - n, 0), int(columns[-1]) + n + 1
    part = np.s_[y0:y1, x0:x1]
    tiles = _fill_window(occupied[part], known_cells[part], target[part], counts, options, source, notes, key)
    inside = cells[part]
    inside[target[part]] = np.where(tiles == 1, UNKNOWN if options.confidence else OCCUPIED, FREE)[target[part]]


def _fill_window(
    occupied: Bool,
    known_cells: Bool,
    target: Bool,
    counts: NDArray[np.int64],
    options: Options,
    source: RandomSource,
    notes: DerivationNotes,
    key: PartKey,
) -> NDArray[np.int64]:
    """Solve a window of the grid: 0 or 1 for each cell, -1 without a result."""
    n = options.pattern
    codes = np.arange(2 ** (n * n))
    patterns = (codes[:, None] >> np.arange(n * n) & 1).reshape(-1, n, n).astype(np.int64)
    tiles = np.array([FREE, OCCUPIED], np.uint8).reshape(2, 1, 1)
    model = _wfc.Model(tiles, patterns, _wfc.scale_weights(counts), _wfc.agreeing(patterns))
    lattice = _wfc.Lattice.from_shape(target.shape, n, target=target)
    if not len(lattice.rows):
        raise CannotGenerate(f"{grid_label(key)} is smaller than a window of {n} × {n} cells")
    wider = lattice.fitting(patterns, np.where(known_cells, occupied.astype(np.int8), np.int8(-1)))
    seen = _wfc.pack_bits((counts > 0)[None])
    narrow = wider & seen
    empty = ~narrow.any(axis=1)
    narrow[empty] = wider[empty]
    repairs = 0
    for attempt in range(_wfc.ATTEMPTS):
        draw = source.stream(f"{key.level}/{key.name}/{attempt}")
        wave = _wfc.Wave.start(
            model,
            lattice,
            narrow.copy(),
            draw,
            balance=_wfc.BALANCE,
            repairs=REPAIRS,
            scan=options.order == "rows",
            wider=wider,
        )
        ended = wave.run()
        repairs = int(wave.report[0])
        if ended == _wfc.DONE:
            strange = int(np.count_nonzero(~(wave.domain & seen).any(axis=1)))
            if strange:
                notes.warn(
                    f"{strange} of {len(lattice.rows)} filled-in windows do not occur in the known part; no others fit "
                    "between the known cells",
                    where=grid_label(key),
                )
            return wave.tiles()
    raise CannotGenerate(
        f"{grid_label(key)}: {repairs} contradictions could not be repaired: use a smaller pattern or reach"
    )


def _cells_to_fill(known_cells: Bool, reach: float) -> Bool:
    """Return the unknown cells within this many cells of a known one (between centres); all if reach is 0."""
    import cv2

    if not reach or not known_cells.any():
        return ~known_cells
    away = cv2.distanceTransform((~known_cells).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return ~known_cells & (np.asarray(away) <= reach + 1e-4)


def _counts(occupied: Bool, known_cells: Bool, n: int, symmetry: _wfc.Symmetry) -> NDArray[np.int64]:
    """Count each completely known window, by its cells as bits, row by row from below: int64 [2^(n·n)]."""
    height, width = (v - n + 1 for v in known_cells.shape)
    counts = np.zeros(2 ** (n * n), np.int64)
    if height < 1 or width < 1:
        return counts
    code, good = np.zeros((height, width), np.int16), np.ones((height, width), bool)
    for k in range(n * n):
        window = np.s_[k // n : k // n + height, k % n : k % n + width]
        code |= occupied[window].astype(np.int16) << k
        good &= known_cells[window]
    plain = np.bincount(code[good], minlength=len(counts))
    for order in _wfc.symmetries(np.arange(n * n).reshape(n, n), symmetry):
        codes = np.arange(len(counts))
        moved = sum((codes >> int(k) & 1) << i for i, k in enumerate(order.ravel()))
        np.add.at(counts, np.asarray(moved, np.int64), plain)
    return counts

"""Wave-function collapse: a site in which every small window occurs in a sample (Gumin 2016; ``_wfc``).

The sample is a built-in one, 5 m × 5 m, or a grid of the environment; of a grid, patches as large as a rack with its
aisle or a part of a room are put together (``_patches``). With ``order=rows`` the shares of tiles and of
neighbours stay close to the sample's; with lowest entropy first, rare patterns become rarer.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from app.derive import DerivationNotes
from app.errors import CannotGenerate, Problem
from app.generate import RandomSource, _cells, _patches, _wfc, generates
from app.generate._cells import STYLES, CellStyle
from app.generate._site import Site, SiteOptions, invalid_option_error
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid, unknown_grey_as_unknown
from app.model.layers import Layers
from app.parameters import parameter

U8 = NDArray[np.uint8]
Bool = NDArray[np.bool_]

SAMPLE_METRES = 5.0
"""Side of the built-in samples in metres."""

RESOLUTION = 0.05

MAX_SAMPLE_CELLS = 2**18
"""Maximum number of tiles of a sample."""

WALL = 0.1
"""Thickness of a site's outer wall in metres, at least one tile."""

BORDER = 99
"""Object kind of the outer wall's cells, to distinguish them from those inside."""

Rectangles = tuple[tuple[float, float, float, float], ...]


@dataclass(frozen=True, slots=True)
class Sample:
    """Built-in sample: rectangles (x, y, width, depth in metres) of its obstacles."""

    look: CellStyle
    rectangles: Rectangles

    def cells(self, resolution: float) -> U8:
        """Draw the sample as a grid: 0 free, 100 occupied; row 0 is the lowest."""
        n = max(1, round(SAMPLE_METRES / resolution))
        out = np.full((n, n), FREE, np.uint8)
        for x, y, w, d in self.rectangles:
            x0, y0, x1, y1 = (round(v / resolution) for v in (x, y, x + w, y + d))
            out[y0 : max(y1, y0 + 1), x0 : max(x1, x0 + 1)] = OCCUPIED
        return out


PILLARS = (0.4, 1.65, 2.9, 4.15)

SAMPLES: Mapping[str, Sample] = {
    "warehouse": Sample(
        STYLES["rack"],
        (
            *((x, y, 1.4, 0.4) for y in (0.7, 1.8, 2.9) for x in (0.8, 2.9)),
            *((x, 4.0, 0.2, 0.2) for x in (1.0, 3.0)),
        ),
    ),
    "office": Sample(
        STYLES["furniture"],
        (
            *((x, y, 0.8, 0.4) for y in (0.6, 1.4, 3.2, 4.0) for x in (0.6, 1.9)),
            *((x, y, 0.4, 0.4) for y in (0.6, 1.6, 3.0, 4.2) for x in (3.3, 4.2)),
        ),
    ),
    "pillars": Sample(CellStyle("pillar", 2.5, "wall"), tuple((x, y, 0.4, 0.4) for x in PILLARS for y in PILLARS)),
}


@dataclass(frozen=True, slots=True)
class Options(SiteOptions):
    """Parameters of wave-function collapse."""

    sample: str = parameter(
        "warehouse",
        f"sample: {', '.join(SAMPLES)}, or the name of a grid of the environment, whose cell size is used",
    )
    width: float = parameter(10.0, "size along x, if there is no fence", minimum=0.5, maximum=10_000.0, unit="m")
    depth: float = parameter(10.0, "size along y, if there is no fence", minimum=0.5, maximum=10_000.0, unit="m")
    model: Literal["overlapping", "tiled", "patches"] | None = parameter(
        None,
        "overlapping: every window of tiles occurs in the sample; tiled: every pair of neighbours does; patches: "
        "pieces as large as a rack with its aisle lie side by side where their sides agree; default: patches for a "
        "grid, else overlapping",
    )
    pattern: int | None = parameter(
        None,
        "overlapping: tiles along a window; patches: tiles from one patch to the next; default: 5; larger is closer to "
        "the sample and harder to solve",
        minimum=2,
        maximum=8,
    )
    tile: int | None = parameter(
        None,
        "number of cells along a tile; default: overlapping 1, tiled 2, patches: so that a patch is as wide as an "
        "obstacle and the free space beside it usually are",
        minimum=1,
        maximum=64,
    )
    symmetry: Literal["none", "mirror", "rotate", "all"] = parameter(
        "none", "whether the sample is also used mirrored, rotated by quarters, or both"
    )
    wrap: bool = parameter(False, "whether the sample continues at its other side")
    border: Literal["walls", "open", "periodic"] | None = parameter(
        None,
        "border: closed by walls; open like a section of a larger site; or periodic, so that copies fit together; "
        "default: as the sample's; the built-in ones have walls",
    )
    order: Literal["rows", "entropy"] = parameter(
        "rows", "order of decisions: row by row, close to the sample's shares, or lowest entropy first"
    )
    connected: bool = parameter(True, "whether all free cells must be one piece")
    free: tuple[float, ...] = parameter((), "positions that stay free, as x,y,x,y,…", unit="m")
    blocked: tuple[float, ...] = parameter((), "positions that are occupied, as x,y,x,y,…", unit="m")
    repairs: int = parameter(20_000, "maximum number of contradictions in one attempt", minimum=0, maximum=1_000_000)


@generates(
    {"location", "objects", "occupancy", "topology", "imagery"},
    parameters=Options,
    also={"location", "occupancy"},
    version=4,
)
def wave_function_collapse(given: Layers, options: Options, source: RandomSource, notes: DerivationNotes) -> Layers:
    """Site by wave-function collapse, in which every window occurs in a sample.

    Raises CannotGenerate for a sample that does not exist or is too large or too varied, for fixed positions that
    contradict it, and if all attempts fail.
    """
    sample, known_cells, resolution, look = _sample(given, options, notes)
    is_grid = look is STYLES["obstacle"]
    if options.model is None:
        options = replace(options, model="patches" if is_grid else "overlapping")
    if options.model == "patches":
        return _patchwork(given, options, source, notes, (sample, known_cells, resolution, look))
    if options.border is None:
        is_open = is_grid and not _patches.is_closed(*_patches.filled(sample, known_cells), resolution)
        options = replace(options, border="open" if is_open else "walls")
    pattern = _pattern(options)
    tile = options.tile or (1 if options.model == "overlapping" else 2)
    sample, known_cells = _whole_tiles(sample, known_cells, tile, notes)
    if sample.size > MAX_SAMPLE_CELLS * tile * tile:
        raise invalid_option_error(
            "sample", f"has {sample.size // tile**2} tiles; the limit is {MAX_SAMPLE_CELLS}: use a larger tile"
        )
    site = Site(given, options, notes)
    place = _cells.site_grid_frame(site, options.width, options.depth, resolution, step=tile)
    if options.wrap and options.border == "walls":
        raise invalid_option_error(
            "wrap", "a sample that continues at its other side has no walls: use border=open or periodic"
        )
    thick = max(1, round(WALL / (resolution * tile))) if options.border == "walls" else 0
    rows, columns = place.rows // tile, place.columns // tile
    if min(rows, columns) < max(pattern, 2 * thick + 1):
        min_side = max(pattern, 2 * thick + 1) * tile * resolution
        raise invalid_option_error(
            "width", f"the site has only {columns} × {rows} tiles: each side must be at least {min_side:g} m"
        )
    if thick:
        ring = max(pattern - 1, thick) * tile
        sample = np.pad(sample, ring, constant_values=BORDER)
        known_cells = np.pad(known_cells, ring, constant_values=True)
    model = _wfc.learn(
        sample, tile=tile, pattern=pattern, symmetry=options.symmetry, wrap=options.wrap, valid=known_cells
    )
    open_ = (model.tiles == FREE).all(axis=(1, 2))
    full = (model.tiles == OCCUPIED).all(axis=(1, 2))
    fixed = np.full((rows, columns), -1, np.int64)
    wall = -1
    if thick:
        wall = _single_index((model.tiles == BORDER).all(axis=(1, 2)), "border", "a wall tile")
        fixed[:thick], fixed[-thick:], fixed[:, :thick], fixed[:, -thick:] = wall, wall, wall, wall
    for option, mask, label in (("free", open_, "a free tile"), ("blocked", full, "an occupied tile")):
        _fix_tiles(fixed, mask, option, label, options, place, resolution * tile)
    tiles = _wfc.collapse_model(
        model,
        (rows, columns),
        fixed,
        source.stream,
        periodic=options.border == "periodic",
        scan=options.order == "rows",
        joined=options.connected,
        repairs=options.repairs,
        wall=wall,
    )
    cells = _wfc.render(model, tiles)
    _cells.add_objects(site, place, cells == BORDER, STYLES["wall"])
    _cells.add_objects(site, place, cells == OCCUPIED, look)
    return _cells.finish_site(site, options, notes, ground="concrete")


def _patchwork(
    given: Layers,
    options: Options,
    source: RandomSource,
    notes: DerivationNotes,
    sample: tuple[U8, Bool, float, CellStyle],
) -> Layers:
    """Return a site of patches of a sample (``_patches``)."""
    cells, known_cells, resolution, look = sample
    cells, known_cells = _patches.filled(cells, known_cells)
    steps = options.pattern or _patches.BLOCKS
    block = options.tile or max(1, round(_patches.usual_period(cells, resolution) / steps / resolution))
    if options.tile is None:
        notes.fill(
            "tile",
            block,
            f"patches of {steps * block * resolution:.2g} m, as the sample's obstacles and aisles",
            "tile",
        )
    blocks = _patches.coarse(cells, known_cells, block, resolution)
    if blocks.cells.size > MAX_SAMPLE_CELLS:
        raise invalid_option_error(
            "sample", f"has {blocks.cells.size} tiles; the limit is {MAX_SAMPLE_CELLS}: use a larger tile"
        )
    border = options.border or ("walls" if _patches.is_closed(cells, known_cells, resolution) else "open")
    if options.wrap and border == "walls":
        raise invalid_option_error(
            "wrap", "a sample that continues at its other side has no walls: use border=open or periodic"
        )
    if border == "walls":
        blocks = _patches.bordered(blocks, BORDER)
    site = Site(given, options, notes)
    step = steps * block
    place = _cells.site_grid_frame(site, options.width, options.depth, resolution, step=step)
    shape = place.rows // step, place.columns // step
    if border == "walls" and min(shape) < 2:
        raise invalid_option_error("width", f"each side must be at least {2 * step * resolution:g} m, two patches")
    patches, counts = _patches.learn(blocks, steps, options.symmetry, BORDER, wrap=options.wrap)
    allowed = _patches.places(patches, shape, BORDER, closed=border == "walls")
    _fix(allowed, patches, options, place, block)
    out = _patches.collapse(
        patches,
        counts,
        allowed,
        source.stream,
        notes,
        periodic=border == "periodic",
        scan=options.order == "rows",
        repairs=options.repairs,
        joined=options.connected,
        border=BORDER if border == "walls" else None,
    )
    drawn = np.kron(out, np.ones((block, block), np.uint8))
    _cells.add_objects(site, place, drawn == BORDER, STYLES["wall"])
    _cells.add_objects(site, place, drawn == OCCUPIED, look)
    return _cells.finish_site(site, options, notes, ground="concrete")


def _fix_tiles(
    fixed: NDArray[np.int64],
    mask: Bool,
    option: str,
    label: str,
    options: Options,
    place: _cells.GridFrame,
    size: float,
) -> None:
    """Fix the tiles at the positions of an option: the first of those that the mask allows, in place."""
    rows, columns = fixed.shape
    for x, y in _points(getattr(options, option), option):
        r, c = int((y - place.y) // size), int((x - place.x) // size)
        if not (0 <= r < rows and 0 <= c < columns):
            raise invalid_option_error(option, f"({x:g}, {y:g}) is outside the site")
        number = _single_index(mask, option, label)
        if fixed[r, c] not in (-1, number):
            raise invalid_option_error(option, f"({x:g}, {y:g}) is on a wall, or both free and occupied")
        fixed[r, c] = number


def _fix(allowed: Bool, patches: U8, options: Options, place: _cells.GridFrame, block: int) -> None:
    """Keep only patches that are free, or occupied, at the positions that the options fix."""
    steps = patches.shape[1] - 1
    size = place.resolution * block
    rows, columns = allowed.shape[0] * steps, allowed.shape[1] * steps
    for option, value in (("free", FREE), ("blocked", OCCUPIED)):
        for x, y in _points(getattr(options, option), option):
            r, c = (math.floor(v / size + 1e-9) for v in (y - place.y, x - place.x))
            if not (0 <= r < rows and 0 <= c < columns):
                raise invalid_option_error(option, f"({x:g}, {y:g}) is outside the site")
            allowed[r // steps, c // steps] &= patches[:, r % steps, c % steps] == value
            if not allowed[r // steps, c // steps].any():
                raise invalid_option_error(option, f"({x:g}, {y:g}) is on a wall, or no patch of the sample fits there")


def _pattern(options: Options) -> int:
    if options.model == "overlapping":
        return options.pattern or 5
    if options.pattern is not None:
        raise invalid_option_error("pattern", "applies only to model=overlapping: a tiled model uses only neighbours")
    return 1


def _sample(given: Layers, options: Options, notes: DerivationNotes) -> tuple[U8, Bool, float, CellStyle]:
    """Return (cells of 0 and 100, which of them are known, metres per cell, kind of its obstacles)."""
    grids = {key.name: grid for key, grid in reversed(given.grids().items())}
    if options.sample in SAMPLES and options.sample not in grids:
        sample = SAMPLES[options.sample]
        resolution = options.resolution or RESOLUTION
        cells = sample.cells(resolution)
        return cells, np.ones(cells.shape, bool), resolution, sample.look
    grid = grids.get(options.sample)
    if grid is None:
        grid_names = ", ".join(sorted(grids)) or "none"
        raise invalid_option_error(
            "sample",
            f"unknown sample {options.sample[:80]!r}: use one of {', '.join(SAMPLES)}, or a grid ({grid_names})",
        )
    resolution = round(grid.resolution, 3)
    if options.resolution is not None and abs(options.resolution - grid.resolution) > 1e-6:
        raise invalid_option_error("resolution", f"is the sample's, {grid.resolution:g} m: omit it")
    if resolution != grid.resolution:
        notes.fill("resolution", resolution, f"the sample's {grid.resolution!r} m in whole millimetres")
    return *binary(grid), resolution or RESOLUTION, STYLES["obstacle"]


def binary(grid: OccupancyGrid) -> tuple[U8, Bool]:
    """Return a grid's cells as 0 and 100, by its threshold, and which of them are known."""
    grid = unknown_grey_as_unknown(grid)
    known_cells = grid.cells != UNKNOWN
    occupied = known_cells & (grid.cells >= grid.occupied_thresh * OCCUPIED)
    return np.where(occupied, OCCUPIED, FREE).astype(np.uint8), known_cells


def _whole_tiles(cells: U8, known_cells: Bool, tile: int, notes: DerivationNotes) -> tuple[U8, Bool]:
    """Crop a sample to whole tiles."""
    rows, columns = (n // tile * tile for n in cells.shape)
    lost = cells.size - rows * columns
    if not rows * columns:
        raise invalid_option_error(
            "tile", f"the sample of {cells.shape[1]} × {cells.shape[0]} cells is smaller than one tile"
        )
    notes.drop("cells of the sample", lost, f"beyond the last whole tile of {tile} cells")
    return cells[:rows, :columns], known_cells[:rows, :columns]


def _single_index(mask: Bool, option: str, label: str) -> int:
    indices = np.flatnonzero(mask)
    if not len(indices):
        raise invalid_option_error(
            option, f"the sample has no {label.split(' ', 1)[1]} of this size: use a smaller tile"
        )
    return int(indices[0])


def _points(numbers: tuple[float, ...], option: str) -> list[tuple[float, float]]:
    if len(numbers) % 2:
        raise CannotGenerate(
            f"{option}: must be an even number of coordinates", [Problem("must be x,y,x,y,…", where=option)]
        )
    return list(zip(numbers[::2], numbers[1::2], strict=True))

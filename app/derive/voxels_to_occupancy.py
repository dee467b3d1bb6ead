"""Voxels -> occupancy: a height band of an octree or a point cloud as a grid."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.derive import DerivationNotes, derives
from app.errors import CannotConvert, MissingLayer
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.layers import Layers, Part, PartKey
from app.model.voxels import DEPTH, HALF, VoxelMap, gather
from app.parameters import parameter

MAX_CELLS = 2**28
"""Maximum number of cells of a grid (``Limits.pixels``)."""

MAX_SIDE_CELLS = 32767
"""Maximum number of cells along a side: Nav2's map_server rejects larger maps."""

MAX_OCCUPIED_SHARE = 0.95
"""Share of occupied cells from which on the floor probably counts as an obstacle."""

BAND_METRES = 2.0
"""Height above a recorded floor up to which voxels are obstacles, by default."""

FLOOR_FACTOR, FLOOR_SHARE = 3.0, 0.3
"""Area of a floor, in those of the layers above it, and in that of the largest layer."""

RANK = np.array([1, 0, 2], np.uint8)
"""Rank of unknown, free, occupied: a coarser cell has the highest rank that it covers, as in ``occupancy_grid``."""

VALUE = np.array([FREE, UNKNOWN, OCCUPIED], np.uint8)
"""Cell value by rank."""

States = NDArray[np.uint8]
"""States: 0 unknown, 1 free, 2 occupied."""


@dataclass(frozen=True, slots=True)
class Parameters:
    """Parameters of voxels_to_occupancy."""

    band: tuple[float, float] | None = parameter(
        None,
        "height range low,high above the level's floor; default: from the floor, if one was recorded, to 2 m above it "
        "or to the ceiling, else the full height",
        minimum=-1e5,
        maximum=1e5,
        unit="m",
    )
    resolution: float | None = parameter(
        None,
        "size of a cell; default: the voxels'. A coarser cell is occupied if any part is, else unknown, else free",
        minimum=1e-3,
        maximum=1e3,
        unit="m",
    )


@derives(gives="occupancy", needs={"voxels"}, parameters=Parameters, cost=2.0, version=2)
def voxels_to_occupancy(layers: Layers, parameters: Parameters, notes: DerivationNotes) -> Layers:
    """Projection of a height band: occupied if any voxel of the column is, free if all known ones are.

    Without a band, a recorded floor and what is above 2 m, or a ceiling below, are left out. Each voxel map becomes one
    grid of the same name; it covers all voxels whatever the band, so that the frame does not change with the band; its
    yaw is 0, its origin a multiple of the resolution. Raises MissingLayer if no voxel is in the band, CannotConvert if
    the grid would be too large or the band is not ascending.
    """
    if parameters.band is not None and not parameters.band[0] < parameters.band[1]:
        low, high = parameters.band
        raise CannotConvert(f"band must be low,high with low < high, got {low:g},{high:g}")
    parts: dict[PartKey, Part] = {}
    seen: list[str] = []
    for key, part in layers.parts_of("voxels").items():
        if not isinstance(part, VoxelMap) or not len(part):
            continue
        floor = layers.elevation(key.level)
        band = parameters.band or _band_above_floor(part, floor)
        if band is not None and parameters.band is None:
            notes.fill(
                "band", f"{band[0]:g},{band[1]:g}", f"{key.name}: heights above the floor that was recorded", "band"
            )
        grid = _project(part, band, parameters.resolution, floor)
        if grid is None:
            z = part.bounds()
            seen.append(f"{key.name} from {z[2]:g} to {z[5]:g} m above the local origin" if z else key.name)
            continue
        parts[PartKey("occupancy", key.level, key.name)] = grid
        _report_doubts(key, part, grid, parameters, notes)
    if not parts:
        why = f"no voxel is in the band; stored: {'; '.join(seen)}" if seen else "the voxel maps are empty"
        raise MissingLayer(f"{why}: set another band=low,high, or upload an octree or a point cloud")
    return Layers(parts, layers.datum, layers.levels)


def _report_doubts(
    key: PartKey, voxels: VoxelMap, grid: OccupancyGrid, parameters: Parameters, notes: DerivationNotes
) -> None:
    counts = grid.counts()
    known_cells = counts["occupied"] + counts["free"]
    if parameters.band is None and counts["occupied"] >= MAX_OCCUPIED_SHARE * known_cells:
        notes.warn(
            f"{key.name}: nearly every column is occupied, probably by the floor; set band=low,high to the heights of "
            "obstacles for robots"
        )
    if not voxels.leaf_counts()["free"]:
        notes.warn(f"{key.name}: the voxels contain no free space; all cells that are not occupied are unknown")


def _band_above_floor(voxels: VoxelMap, floor: float) -> tuple[float, float] | None:
    """Return the heights between a recorded floor and 2 m above it or a ceiling; None if no floor was recorded.

    A floor is the lowest layer of voxels that covers much of the ground, and much more of it than the layers above do,
    with those that continue it; a ceiling likewise. floor: of the level, metres above the local origin; the result is
    above it.
    """
    edge = voxels.resolution
    occupied = voxels.log_odds >= 0
    low, high = (z[occupied].astype(np.int64) for z in voxels.axis(2))
    if not len(low) or int(high.max() - low.min()) > MAX_SIDE_CELLS:
        return None
    bottom = int(low.min())
    areas = (high - low).astype(np.float64) ** 2
    change = np.zeros(int(high.max()) - bottom + 1)
    np.add.at(change, low - bottom, areas)
    np.add.at(change, high - bottom, -areas)
    layers = np.cumsum(change)[:-1]
    reach = max(2, round(BAND_METRES / edge))
    usual = np.array(
        [np.median(layers[k + 1 : k + 1 + reach]) if k + 1 < len(layers) else np.inf for k in range(len(layers))]
    )
    # walls and racks repeat in each layer; what is under the floor is noise
    ground = layers.max()
    is_floor = (layers >= FLOOR_FACTOR * usual) & (layers >= FLOOR_SHARE * ground)
    if not is_floor.any():
        return None
    first = int(is_floor.argmax())
    last = first
    while last + 1 < len(layers) and is_floor[last + 1]:
        last += 1
    top = last + 1 + reach
    above = layers[last + 1 : top]
    ceiling = np.flatnonzero(above >= FLOOR_FACTOR * max(float(np.median(above)), 1.0))
    ceiling = ceiling[ceiling >= reach // 2]
    if len(ceiling):
        top = last + 1 + int(ceiling[0])
    return round((last + 1 + bottom) * edge - floor, 6), round((top + bottom) * edge - floor, 6)


def _project(
    voxels: VoxelMap, band: tuple[float, float] | None, resolution: float | None, floor: float
) -> OccupancyGrid | None:
    """Convert a voxel map to a grid; None if nothing is in the band. floor: metres above the local origin."""
    edge = voxels.resolution
    bounds = [(int(low.min()), int(high.max())) for low, high in (voxels.axis(0), voxels.axis(1))]
    _check_size([high - low for low, high in bounds], edge, "upload voxels of a coarser resolution or a smaller area")
    inside = np.ones(len(voxels), bool)
    if band is not None:
        low, high = voxels.axis(2)
        bottom, top = ((floor + v) / edge for v in band)
        inside = (high > _snap_to_integer(bottom)) & (low < _snap_to_integer(top))
        if not inside.any():
            return None
    state = _columns(voxels, inside, bounds)
    size = resolution or edge
    if abs(size - edge) <= 1e-9 * edge:
        cells = VALUE[RANK][state]
        first = [bounds[0][0], bounds[1][0]]
        size = edge
    else:
        ranks = RANK[state]
        spans = [
            (math.floor(_snap_to_integer(a * edge / size)), math.ceil(_snap_to_integer(b * edge / size)))
            for a, b in bounds
        ]
        _check_size([last - begin for begin, last in spans], size, "use a coarser resolution")
        for axis, source, span in ((1, bounds[0], spans[0]), (0, bounds[1], spans[1])):
            ranks = _resample(ranks, axis, source, span, size / edge)
        first = [begin for begin, _ in spans]
        cells = VALUE[ranks]
    x, y = (round(v * size, 9) for v in first)
    return OccupancyGrid(cells, size, (x, y, 0.0))


def _check_size(sides: list[int], edge: float, instead: str) -> None:
    if max(sides) > MAX_SIDE_CELLS or sides[0] * sides[1] > MAX_CELLS:
        raise CannotConvert(
            f"the grid would have {sides[0]} × {sides[1]} cells of {edge:g} m, above the maximum of {MAX_SIDE_CELLS} "
            f"per side and {MAX_CELLS} in total: {instead}"
        )


def _columns(voxels: VoxelMap, inside: NDArray[np.bool_], bounds: list[tuple[int, int]]) -> States:
    """Compute the state of each column of smallest voxels: uint8 [rows, columns], row 0 at the smallest y.

    From the coarsest leaves down: each step doubles the raster and draws the leaves of the next depth into it, so a
    large leaf costs no more than a small one.
    """
    window = [(low + HALF, high + HALF) for low, high in bounds]
    picture = np.zeros((1, 1), np.uint8)
    start = (0, 0)
    x, y = gather(voxels.code), gather(voxels.code >> np.uint64(1))
    for depth in range(1, DEPTH + 1):
        up = DEPTH - depth
        (x0, x1), (y0, y1) = [(low >> up, -(-high >> up)) for low, high in window]
        picture = picture.repeat(2, axis=0).repeat(2, axis=1)
        top, left = y0 - 2 * start[0], x0 - 2 * start[1]
        picture = np.ascontiguousarray(picture[top : top + y1 - y0, left : left + x1 - x0])
        start = (y0, x0)
        indices = np.flatnonzero((voxels.depth == depth) & inside)
        if not len(indices):
            continue
        row, column = y[indices].astype(np.int64) - y0, x[indices].astype(np.int64) - x0
        occupied = voxels.log_odds[indices] >= 0
        free = row[~occupied], column[~occupied]
        picture[free] = np.maximum(picture[free], 1)
        picture[row[occupied], column[occupied]] = 2
    return picture


def _resample(ranks: States, axis: int, source: tuple[int, int], span: tuple[int, int], ratio: float) -> States:
    """Resample ranks to another cell size along one axis.

    source: first and end of the existing cells, counted from the origin. span: of the required ones, each ``ratio`` as
    long. A coarser cell has the highest rank that it covers (missing cells are unknown), a finer one the rank at its
    centre.
    """
    start, end = source
    number = np.arange(*span, dtype=np.float64)
    if ratio < 1:
        middle = np.floor((number + 0.5) * ratio).astype(np.int64) - start
        return np.take(ranks, np.clip(middle, 0, end - start - 1), axis=axis)
    begin = np.floor(_nears(number * ratio)).astype(np.int64) - start
    stop = np.ceil(_nears((number + 1) * ratio)).astype(np.int64) - start
    beyond = (begin < 0) | (stop > end - start)
    begin, stop = np.clip(begin, 0, None), np.clip(stop, None, end - start)
    pairs = np.stack([begin, stop], axis=1).ravel()
    pad = [(0, 0), (0, 0)]
    pad[axis] = (0, 1)  # so that the last one's end is an index, too
    out = np.maximum.reduceat(np.pad(ranks, pad), pairs, axis=axis)
    out = np.ascontiguousarray(np.take(out, np.arange(0, len(pairs), 2), axis=axis))
    at = [slice(None), slice(None)]
    for k in np.flatnonzero(beyond).tolist():
        at[axis] = slice(k, k + 1)
        out[tuple(at)] = np.maximum(out[tuple(at)], RANK[0])
    return out


def _snap_to_integer(value: float) -> float:
    """Round a number that is an integer up to the rounding error of a division."""
    integer = round(value)
    return float(integer) if abs(value - integer) < 1e-6 else value


def _nears(values: NDArray[np.float64]) -> NDArray[np.float64]:
    integers = np.round(values)
    return np.where(np.abs(values - integers) < 1e-6, integers, values)

"""Occupancy -> voxels: a grid's cells as columns of an octree."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.derive import DerivationNotes, derives
from app.errors import CannotConvert, MissingLayer
from app.model import masks
from app.model.grid import UNKNOWN, OccupancyGrid, unknown_grey_as_unknown
from app.model.layers import MAP, Layers, Part, PartKey
from app.model.selection import as_planned, grid_label
from app.model.voxels import DEPTH, HALF, LOG_ODDS, VoxelMap, morton
from app.parameters import parameter

MAX_LEAVES = 2**25
"""Maximum number of leaves (``Limits.voxels``)."""

COLUMNS = 2**28
"""Maximum number of columns that are processed (``Limits.pixels``)."""

ROWS_PER_BLOCK = 2**9
"""Number of rows that are sampled at once."""

NO_KNOWN_CELLS = (
    "the stored grids have no occupied or free cells to derive voxels from: upload an occupancy grid, an octree or a "
    "point cloud"
)

States = NDArray[np.uint8]
"""States: 0 unknown, 1 free, 2 occupied."""


@dataclass(frozen=True, slots=True)
class Parameters:
    """Parameters of occupancy_to_voxels."""

    height: float = parameter(2.0, "height of occupied columns above the floor", minimum=1e-3, maximum=1e3, unit="m")
    resolution: float | None = parameter(
        None, "edge length of the smallest voxel; default: the grid's", minimum=1e-3, maximum=1e3, unit="m"
    )
    free: bool = parameter(True, "whether free cells become free voxels of the same height, instead of unknown")


def _try(layers: Layers, parameters: Parameters) -> None:
    blocks = [
        _grid_columns(unknown_grey_as_unknown(grid), parameters, layers.elevation(key.level), key.name)
        for key, grid in _default_grids(layers).items()
    ]
    filled_blocks = [block for block in blocks if block is not None]
    if not filled_blocks:
        raise MissingLayer(NO_KNOWN_CELLS)
    for block in filled_blocks:
        if (
            np.count_nonzero(block.state) * (block.top - block.bottom) > MAX_LEAVES
        ):  # the count if all leaves were the smallest
            _cut_into_leaves(block)


@derives(gives="voxels", needs={"occupancy"}, parameters=Parameters, cost=8.0, version=2, trial=_try)
def occupancy_to_voxels(layers: Layers, parameters: Parameters, notes: DerivationNotes) -> Layers:
    """Voxels extruded from a grid: occupied cells become columns from the level's floor up, free cells free space.

    Each grid gives one voxel map of its name; if a level has a grid ``map``, only that one is used, and never costmap
    filter masks. A cell that is rotated or shifted against the voxels occupies all voxels that it touches. Raises
    MissingLayer if no cell is known, CannotConvert if the octree would be too large.
    """
    parts: dict[PartKey, Part] = {}
    for key, grid in _default_grids(layers).items():
        block = _grid_columns(
            as_planned(grid, grid_label(key), notes.warn), parameters, layers.elevation(key.level), key.name
        )
        if block is not None:
            voxels = VoxelMap(block.edge, *_leaves(block))
            parts[PartKey("voxels", key.level, key.name)] = voxels
            if not voxels.leaf_counts()["occupied"]:
                notes.warn(f"{key.name}: the grid has no occupied cell; the voxels contain only free space")
    if not parts:
        raise MissingLayer(NO_KNOWN_CELLS)
    notes.fill("height", parameters.height, "a grid has no heights", "height")
    return Layers(parts, layers.datum, layers.levels)


@dataclass(frozen=True, slots=True)
class _Block:
    """Columns of one grid, all from one height to another.

    edge: edge length of the smallest voxel in metres. corner: x and y of the first column, bottom and top: heights, in
    voxels from the origin.
    """

    name: str
    edge: float
    state: States
    corner: tuple[int, int]
    bottom: int
    top: int


def _default_grids(layers: Layers) -> dict[PartKey, OccupancyGrid]:
    """Return the grids to extrude."""
    grids = layers.grids()
    candidates = {k: g for k, g in grids.items() if k.name not in masks.MASKS and masks.NAME not in g.properties}
    mains = {key.level for key in candidates if key.name == MAP}
    return {key: grid for key, grid in candidates.items() if key.name == MAP or key.level not in mains}


def _grid_columns(grid: OccupancyGrid, parameters: Parameters, floor: float, name: str) -> _Block | None:
    """Return a grid's columns; None if no cell is known. Raises CannotConvert if they reach beyond an octree."""
    edge = parameters.resolution or grid.resolution
    state, corner = _columns(grid, edge, parameters.free, name)
    if not state.any():
        return None
    bottom = round(floor / edge)
    top = bottom + max(1, round(parameters.height / edge))
    if min(*corner, bottom) < -HALF or max(corner[0] + state.shape[1], corner[1] + state.shape[0], top) > HALF:
        raise CannotConvert(
            f"the grid {name} extends beyond {HALF * edge:g} m from the origin, the range of an octree of {edge:g} m "
            "voxels: use a coarser resolution"
        )
    return _Block(name, edge, state, corner, bottom, top)


def _states(grid: OccupancyGrid) -> States:
    """Return the states of a grid's cells; values between the thresholds are unknown."""
    values = np.zeros(256, np.uint8)
    percent = np.arange(101) / 100
    values[:101][percent <= grid.free_thresh] = 1
    values[:101][percent >= grid.occupied_thresh] = 2
    values[0], values[100], values[UNKNOWN] = 1, 2, 0
    return values[grid.cells]


def _columns(grid: OccupancyGrid, edge: float, free: bool, name: str) -> tuple[States, tuple[int, int]]:
    """Return the state of each column of voxels: uint8 [rows, columns], row 0 at the smallest y.

    Also returns the position of the first column, x and y in voxels from the origin.
    """
    state = _states(grid)
    if not free:
        state[state == 1] = 0
    x, y, yaw = grid.origin
    column, row = x / edge, y / edge
    straight = yaw == 0.0 and abs(grid.resolution - edge) <= 1e-9 * edge
    if straight and max(abs(column - round(column)), abs(row - round(row))) < 1e-3:
        return state, (round(column), round(row))
    corners = grid.corners() / edge
    left, bottom = (math.floor(v + 1e-6) for v in corners.min(axis=0))
    right, top = (math.ceil(v - 1e-6) for v in corners.max(axis=0))
    width, height = max(1, right - left), max(1, top - bottom)
    if width * height > COLUMNS:
        raise CannotConvert(
            f"the grid {name} would be {width} × {height} columns of voxels of {edge:g} m; the limit is {COLUMNS}: "
            "use a coarser resolution"
        )
    out = np.zeros((height, width), np.uint8)
    c, s = math.cos(yaw), math.sin(yaw)
    across = (np.arange(width) + left + 0.5) * edge - x
    for start in range(0, height, ROWS_PER_BLOCK):
        along = ((np.arange(start, min(height, start + ROWS_PER_BLOCK)) + bottom + 0.5) * edge - y)[:, None]
        u = np.floor((across * c + along * s) / grid.resolution).astype(np.int64)
        v = np.floor((along * c - across * s) / grid.resolution).astype(np.int64)
        inside = (u >= 0) & (u < grid.width) & (v >= 0) & (v < grid.height)
        out[start : start + ROWS_PER_BLOCK][inside] = state[v[inside], u[inside]]
    _splat(out, state, grid, edge, (left, bottom))
    return out, (left, bottom)


def _splat(out: States, state: States, grid: OccupancyGrid, edge: float, corner: tuple[int, int]) -> None:
    """Draw occupied cells into all columns that they touch, but do not have the centre of.

    Sampled are their corners, and points of their border at most half a voxel apart.
    """
    v, u = np.nonzero(state == 2)
    x, y, yaw = grid.origin
    c, s = math.cos(yaw), math.sin(yaw)
    steps = max(2, math.ceil(2 * grid.resolution / edge) + 1)
    for a, b in _border(steps):
        p, q = (u + a) * grid.resolution, (v + b) * grid.resolution
        column = np.floor((x + p * c - q * s) / edge).astype(np.int64) - corner[0]
        row = np.floor((y + p * s + q * c) / edge).astype(np.int64) - corner[1]
        out[np.clip(row, 0, out.shape[0] - 1), np.clip(column, 0, out.shape[1] - 1)] = 2


def _border(steps: int) -> list[tuple[float, float]]:
    """Return points just inside the border of a square of side 1, with so many on each side."""
    inset = 1e-6
    places = np.linspace(inset, 1 - inset, steps).tolist()
    ends = (places[0], places[-1])
    return [*itertools.product(ends, places), *itertools.product(places[1:-1], ends)]


def _cut_into_leaves(block: _Block) -> list[tuple[int, NDArray[np.int64], Square]]:
    """Split columns into the fewest leaves: squares of equal columns, cut into cubes between the two heights.

    For each size 2^j of cubes: j, their start above each of the squares (in units of their size), the squares. Raises
    CannotConvert if there are too many.
    """
    pieces = _pieces(block.bottom + HALF, block.top + HALF)
    tallest = max(k for _, k in pieces)
    squares = _squares(block.state, (block.corner[0] + HALF, block.corner[1] + HALF), tallest)
    out = []
    total = 0
    for start, k in pieces:
        for j in range(k + 1):
            every, largest = squares[j]
            square = every if j == k else largest
            stack = 1 << (k - j)
            total += len(square[0]) * stack
            if total > MAX_LEAVES:
                raise CannotConvert(
                    f"the grid {block.name} would become more than {MAX_LEAVES} voxels: use a coarser resolution "
                    "or a smaller height"
                )
            out.append((j, (start >> j) + np.arange(stack, dtype=np.int64), square))
    return out


def _leaves(block: _Block) -> tuple[NDArray[np.uint8], NDArray[np.uint64], NDArray[np.float32]]:
    """Return depth, code and log-odds of a block's leaves, in order."""
    depths, codes, odds = [], [], []
    for j, z, (x, y, values) in _cut_into_leaves(block):
        n, stack = len(x), len(z)
        # centres of the squares in smallest voxels, so that their codes can be cut to the depth
        coordinates = [np.repeat(x << j, stack) - HALF, np.repeat(y << j, stack) - HALF, np.tile(z << j, n) - HALF]
        codes.append(morton(*coordinates) >> np.uint64(3 * j))
        depths.append(np.full(n * stack, DEPTH - j, np.uint8))
        odds.append(np.repeat(np.array(LOG_ODDS, np.float32)[values.astype(np.intp) - 1], stack))
    depth, code, odd = np.concatenate(depths), np.concatenate(codes), np.concatenate(odds)
    order = np.argsort(code << (np.uint64(3) * (np.uint64(DEPTH) - depth.astype(np.uint64))))
    return depth[order], code[order], odd[order]


def _pieces(start: int, end: int) -> list[tuple[int, int]]:
    """Split a range of integers into aligned pieces (start, k): 2^k of them from a multiple of 2^k on."""
    out = []
    while start < end:
        k = (start & -start).bit_length() - 1 if start else DEPTH - 1
        while k > DEPTH - 1 or start + (1 << k) > end:
            k -= 1
        out.append((start, k))
        start += 1 << k
    return out


Square = tuple[NDArray[np.int64], NDArray[np.int64], States]


def _squares(state: States, corner: tuple[int, int], max_level: int) -> list[tuple[Square, Square]]:
    """For each size 2^j up to 2^most: all aligned squares of known, equal columns, and those in no larger one.

    A square is its x and y in units of its size, and its state. corner: x and y of the first column, from the tree's
    edge.
    """
    levels = [(state, corner)]
    for _ in range(max_level):
        levels.append(_halve(*levels[-1]))
    out = []
    for j, (level_states, (x0, y0)) in enumerate(levels):
        row, column = np.nonzero(level_states)
        values = level_states[row, column]
        x, y = column + x0, row + y0
        alone = np.ones(len(row), bool)
        if j < max_level:
            above, (left, low) = levels[j + 1]
            alone = above[(y >> 1) - low, (x >> 1) - left] == 0
        out.append(((x, y, values), (x[alone], y[alone], values[alone])))
    return out


def _halve(state: States, corner: tuple[int, int]) -> tuple[States, tuple[int, int]]:
    """Merge squares to twice the size: their state if all four quarters share it, else 0."""
    x0, y0 = corner
    height, width = state.shape
    around = ((y0 & 1, (y0 + height) & 1), (x0 & 1, (x0 + width) & 1))
    padded = np.pad(state, around)
    quarters = padded[0::2, 0::2], padded[0::2, 1::2], padded[1::2, 0::2], padded[1::2, 1::2]
    equal = (quarters[0] == quarters[1]) & (quarters[0] == quarters[2]) & (quarters[0] == quarters[3])
    return np.where(equal, quarters[0], np.uint8(0)), (x0 >> 1, y0 >> 1)

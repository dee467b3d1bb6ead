"""Occupancy grids: named 2-D grids in the local frame, with Nav2's semantics."""

from __future__ import annotations

import base64
import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from app.errors import Invalid
from app.model.frame import MAX_METRES

Mode = Literal["trinary", "scale", "raw"]

FREE = 0
OCCUPIED = 100
UNKNOWN = 255
"""Cell values: 0…100 as in Nav2, and 255 for its -1 (unknown)."""


def outline(height: int, width: int) -> NDArray[np.uint8]:
    """Unknown cells without memory, for a grid of which only the outline matters."""
    return np.broadcast_to(np.uint8(UNKNOWN), (height, width))


@dataclass(frozen=True, slots=True, eq=False)
class OccupancyGrid:
    """Cells with their position.

    Attributes:
        cells: uint8 [height, width], 0…100 or 255; row 0 is the *bottom* row (smallest y), as in
            nav_msgs/OccupancyGrid; images have row 0 on top, so readers and writers flip.
        resolution: metres per cell.
        origin: (x, y, yaw) of the lower left corner of cell (0, 0), metres and radians.
        mode, free_thresh, occupied_thresh, negate: interpretation of the source's image.
        properties: further data of the source, by format.
    """

    cells: NDArray[np.uint8]
    resolution: float
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    mode: Mode = "trinary"
    occupied_thresh: float = 0.65
    free_thresh: float = 0.196
    negate: bool = False
    properties: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.cells.dtype != np.uint8 or self.cells.ndim != 2 or 0 in self.cells.shape:
            raise Invalid(f"a grid needs uint8 cells of at least 1 × 1, got {self.cells.dtype} {self.cells.shape}")
        if not (math.isfinite(self.resolution) and 1e-6 <= self.resolution <= 1e4):
            raise Invalid(f"a grid's resolution must be between 1e-6 and 1e4 metres per cell, got {self.resolution!r}")
        if len(self.origin) != 3 or not all(math.isfinite(v) and abs(v) <= MAX_METRES for v in self.origin):
            raise Invalid(f"a grid's origin must be three finite numbers [x, y, yaw], got {list(self.origin)!r}")
        for name in ("occupied_thresh", "free_thresh"):
            value = getattr(self, name)
            if not (math.isfinite(value) and 0.0 <= value <= 1.0):
                raise Invalid(f"{name} must be between 0 and 1, got {value!r}")
        # Equal grids are equal bytes in the store, which tells 0 from 0.0 and -0.0.
        for name in ("resolution", "occupied_thresh", "free_thresh"):
            object.__setattr__(self, name, float(getattr(self, name)) + 0.0)
        object.__setattr__(self, "origin", tuple(float(v) + 0.0 for v in self.origin))
        if self.mode not in ("trinary", "scale", "raw"):
            raise Invalid(f"mode must be trinary, scale or raw, got {self.mode!r}")
        if any(self.cells.strides) and _beyond(self.cells):  # no strides: one value all over, see outline()
            raise Invalid("cells must be 0 to 100, or 255 for unknown")
        self.cells.flags.writeable = False

    @property
    def width(self) -> int:
        """Return the number of cells along x."""
        return int(self.cells.shape[1])

    @property
    def height(self) -> int:
        """Return the number of cells along y."""
        return int(self.cells.shape[0])

    def corners(self) -> NDArray[np.float64]:
        """Return the four corners (x, y) in metres, counter-clockwise from the origin: float64 [4, 2]."""
        x, y, yaw = self.origin
        w, h = self.width * self.resolution, self.height * self.resolution
        c, s = math.cos(yaw), math.sin(yaw)
        return np.array([[x + c * u - s * v, y + s * u + c * v] for u, v in ((0, 0), (w, 0), (w, h), (0, h))])

    def counts(self) -> dict[str, int]:
        """Count the cells that are occupied (100), free (0), unknown, and anything else."""
        occupied, free, unknown = (int(np.count_nonzero(self.cells == v)) for v in (OCCUPIED, FREE, UNKNOWN))
        other = int(self.cells.size) - occupied - free - unknown
        return {"occupied": occupied, "free": free, "unknown": unknown, "other": other}


def is_occupied(grid: OccupancyGrid, cells: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return which cells are occupied by the grid's own threshold; free and unknown ones never are."""
    out: NDArray[np.bool_] = (cells >= grid.occupied_thresh * OCCUPIED) & (cells != UNKNOWN) & (cells != FREE)
    return out


def halve_cells(cells: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Join 2 × 2 cells: the maximum of the known ones, unknown if there are none."""
    shifted: NDArray[np.uint8] = cells + np.uint8(256 - UNKNOWN)  # in uint8 arithmetic 255 becomes 0, the least
    if len(shifted) % 2:
        shifted = np.concatenate([shifted, np.zeros_like(shifted[:1])])
    shifted = np.maximum(shifted[0::2], shifted[1::2])
    if shifted.shape[1] % 2:
        shifted = np.concatenate([shifted, np.zeros_like(shifted[:, :1])], axis=1)
    shifted = np.maximum(shifted[:, 0::2], shifted[:, 1::2])
    shifted -= np.uint8(256 - UNKNOWN)
    return shifted


UNKNOWN_GREY = "unknown_grey"
"""Property of a grid: the free cells with map_saver's grey for unknown (205). Nav2 treats them as free by the grid's
free_thresh; whether they were observed is unknown.
"""


SLICE = "slice"
"""Property of a grid that shows nothing but the objects beside it. Whoever changes its cells removes it."""


def pack_cells(chosen: NDArray[np.bool_]) -> dict[str, Any]:
    """Encode chosen cells of a grid, bool [height, width], as a JSON-like value."""
    packed = zlib.compress(np.packbits(chosen).tobytes(), 9)
    return {"height": chosen.shape[0], "width": chosen.shape[1], "bits": base64.b64encode(packed).decode()}


def unknown_grey(grid: OccupancyGrid) -> NDArray[np.bool_] | None:
    """Return the free cells of a grid that have the grey of unknown ones; None if there are none."""
    record = grid.properties.get(UNKNOWN_GREY)
    if not isinstance(record, Mapping) or [record.get("height"), record.get("width")] != [grid.height, grid.width]:
        return None
    size = (grid.cells.size + 7) // 8
    try:
        bits = zlib.decompressobj().decompress(base64.b64decode(str(record.get("bits"))), size)
    except (ValueError, zlib.error):
        return None
    if len(bits) != size:
        return None
    chosen = np.unpackbits(np.frombuffer(bits, np.uint8), count=grid.cells.size)
    out = chosen.astype(bool).reshape(grid.height, grid.width) & (grid.cells == FREE)
    return out if out.any() else None


def unknown_grey_as_unknown(grid: OccupancyGrid) -> OccupancyGrid:
    """Set free cells with the grey of unknown ones to unknown, for consumers that need observed free cells."""
    grey = unknown_grey(grid)
    if grey is None:
        return without_unknown_grey(grid)
    return without_unknown_grey(replace(grid, cells=np.where(grey, np.uint8(UNKNOWN), grid.cells)))


def without_unknown_grey(grid: OccupancyGrid, seen: NDArray[np.bool_] | None = None) -> OccupancyGrid:
    """Mark cells as confirmed by people (seen: bool [height, width]; None: all of them)."""
    if UNKNOWN_GREY not in grid.properties:
        return grid
    rest = {word: value for word, value in grid.properties.items() if word != UNKNOWN_GREY}
    grey = None if seen is None else unknown_grey(grid)
    left = None if grey is None or seen is None else grey & ~seen
    if left is not None and left.any():
        rest[UNKNOWN_GREY] = pack_cells(left)
    return replace(grid, properties=rest)


def _beyond(cells: NDArray[np.uint8]) -> bool:
    """Return whether any cell is neither 0…100 nor 255, checked in strips of rows, since every grid is checked."""
    rows = max(1, 2**18 // cells.shape[1])
    shift = np.uint8(256 - UNKNOWN)  # in uint8 arithmetic 255 becomes 0, and 0…100 become 1…101
    return any(int((cells[y : y + rows] + shift).max()) > OCCUPIED + int(shift) for y in range(0, len(cells), rows))

"""Shared by reader and writer: keys of a map's YAML file, and the meaning of its image's grey values."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from app.model.grid import FREE, OCCUPIED, UNKNOWN, Mode

NAME = "occupancy_grid"

KEYS = ("image", "mode", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")

MAP_SAVER_PIXELS = {FREE: 254, OCCUPIED: 0, UNKNOWN: 205}
"""Pixel values that map_saver writes."""

Table = NDArray[np.uint8]


def reads_unknown_as_free(rule: Table, mode: Mode, *, negate: bool) -> bool:
    """Check whether the grey value that map_saver writes for unknown is read as free."""
    return mode == "trinary" and not negate and bool(rule[MAP_SAVER_PIXELS[UNKNOWN]] == FREE)


def cell_table(mode: Mode, negate: bool, occupied: float, free: float) -> Table:
    """Return the cell value of each opaque pixel value 0…255."""
    shade = np.arange(256)
    if mode == "raw":
        return np.where(shade <= OCCUPIED, shade, UNKNOWN).astype(np.uint8)
    high, low = np.float32(occupied), np.float32(free)
    x = shade.astype(np.float32) / np.float32(255)
    x = x if negate else np.float32(1) - x
    cells = np.full(256, UNKNOWN, np.uint8)
    if mode == "scale":
        between = (x > low) & (x < high)
        cells[between] = np.round((x[between] - low) / (high - low) * 100).astype(np.uint8)
    cells[x >= high] = OCCUPIED
    cells[x <= low] = FREE
    return cells

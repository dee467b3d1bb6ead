"""Tiles of changed cells: drawn in a worker if they summarise many cells."""

from __future__ import annotations

import numpy as np

from app.store.cell_changes import SAME, CellChangeImage
from app.store.in_worker import open_store
from app.syntax import images

TILE = 256
"""Side of a tile in pixels."""


def level_count(image: CellChangeImage) -> int:
    """Return the number of levels of detail: the lowest is one tile, the highest has one pixel per cell."""
    return ((max(image.width, image.height) - 1) // TILE).bit_length() + 1


def draw_tile(image: CellChangeImage, k: int, row: int, column: int) -> bytes:
    """Write a tile of the image halved k times as grey PNG of 256 × 256 pixels."""
    pixels = np.full((TILE, TILE), SAME, np.uint8)
    changes = image.reduce(k, row * TILE, column * TILE, TILE, TILE)
    pixels[: changes.shape[0], : changes.shape[1]] = changes
    return images.encode_png(pixels)


def draw_stored_tile(
    database_url: str, blob_dir: str, old: str | None, new: str | None, k: int, row: int, column: int
) -> bytes:
    """Draw a tile of the changes between two stored grids (in a worker). old, new: hashes of the parts."""
    return draw_tile(open_store(database_url, blob_dir).content.cell_changes(old, new), k, row, column)

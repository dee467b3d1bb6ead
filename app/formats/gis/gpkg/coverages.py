"""Tiled gridded coverages (OGC 17-066r1): heights and other values, as 16-bit PNG or 32-bit TIFF."""

from __future__ import annotations

import math
import sqlite3
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.errors import UnreadableFile
from app.formats.gis.gpkg.tile_matrix import Matrix, paint
from app.formats.gis.shapes import raise_unreadable
from app.limits import Limits
from app.syntax import geotiff, images

_COVERAGE = """
SELECT datatype, scale, offset, data_null, uom FROM gpkg_2d_gridded_coverage_ancillary WHERE tile_matrix_set_name = ?
"""
_TILES = "SELECT tpudt_id, scale, offset FROM gpkg_2d_gridded_tile_ancillary WHERE tpudt_name = ?"
MAX_TILES = 2**22
"""Maximum number of tiles with a scale of their own."""

Values = NDArray[np.float32]


class Coverage:
    """Values of a coverage: float32, NaN where there is none."""

    def __init__(self, database: sqlite3.Connection, name: str) -> None:
        self.database = database
        self.name = name
        row = database.execute(_COVERAGE, (name,)).fetchone()
        if row is None or row[0] not in ("integer", "float"):
            raise_unreadable("its values are not described in gpkg_2d_gridded_coverage_ancillary", name)
        self.is_float = row[0] == "float"
        self.scale, self.offset = _number(row[1], 1.0), _number(row[2], 0.0)
        self.null = row[3] if isinstance(row[3], int | float) else None
        self.unit = row[4] if isinstance(row[4], str) and len(row[4]) <= 100 else None
        listed = database.execute(_TILES, (name,)).fetchmany(MAX_TILES)
        self.tiles = {i: (_number(scale, 1.0), _number(offset, 0.0)) for i, scale, offset in listed}

    @property
    def properties(self) -> dict[str, Any]:
        """Return the properties of the image."""
        band = {"colour": "gray", **({"unit": self.unit} if self.unit else {})}
        return {"bands": [band], "nodata": "nan"}

    def read(self, matrix: Matrix, limits: Limits) -> Values:
        """Read all tiles: [height, width, 1], the top row first. Raises UnreadableFile, naming the tile."""
        out = np.full((matrix.height, matrix.width, 1), np.nan, np.float32)

        def decode(data: bytes, tile_id: int) -> Values:
            if self.is_float:
                raw = geotiff.read_tiff(data, limits).pixels[..., :1]
            else:
                if images.read_size(data, limits) != (matrix.tile_width, matrix.tile_height):
                    raise UnreadableFile("its size is not that in gpkg_tile_matrix")
                image = images.read_image(data, limits)
                if not image.mode.startswith("I"):
                    raise UnreadableFile(f"values must be 16-bit PNG, got an image of mode {image.mode}")
                raw = np.asarray(image)[..., None]
            scale, offset = self.tiles.get(tile_id, (1.0, 0.0))
            values = (raw.astype(np.float64) * scale + offset) * self.scale + self.offset
            if self.null is not None:
                values[raw == self.null] = np.nan
            return values.astype(np.float32)

        paint(self.database, matrix, out, decode)
        return out


def _number(value: Any, default: float) -> float:
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else default

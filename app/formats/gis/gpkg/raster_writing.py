"""Write grids and images as tables of tiles."""

from __future__ import annotations

import re
import sqlite3
from collections.abc import Mapping
from typing import Any

from app.formats import WriteContext
from app.formats._grid_files import grid_keys, transform_of
from app.formats.gis.gpkg.placing import Place, place
from app.formats.gis.gpkg.schema import TILES
from app.formats.gis.gpkg.tiles import TILE, Pyramid, grid_pyramid, image_pyramid, is_kept, write_tiles
from app.formats.gis.gpkg.words import DATE, LOCAL_SRS, ORGANIZATION
from app.model.geodesy import LocalFrame
from app.model.imagery import LOCAL, GeoImage
from app.model.layers import Layers, PartKey


class RasterWriter:
    """Writes rasters, and collects what describes them for the metadata."""

    def __init__(self, database: sqlite3.Connection, layers: Layers, context: WriteContext) -> None:
        self.database = database
        self.layers = layers
        self.context = context
        self.frame: LocalFrame | None = layers.frame
        self.names: set[str] = set()
        self.systems: dict[str, int] = {}
        self.entries: list[dict[str, Any]] = []

    def write(self) -> None:
        """Write all grids and images."""
        for key, grid in self.layers.grids().items():
            position = place(transform_of(grid), LOCAL, self.frame)
            if position is None:
                self.context.drop("turned grids", 1, "no CRS has their axes: set a datum, or download occupancy_grid")
                continue
            entry = {**grid_keys(grid), "properties": grid.properties}
            self._write(key, grid_pyramid(grid), position, entry, ())
        for key, picture in self.layers.parts_of("imagery").items():
            if isinstance(picture, GeoImage):
                self._write_image(key, picture)

    def _write_image(self, key: PartKey, picture: GeoImage) -> None:
        position = place(picture.transform, picture.crs, self.frame)
        if position is None:
            self.context.drop("turned images", 1, "no CRS has their axes: set a datum, or download satellite")
            return
        height, width, bands = picture.pixels.shape
        entry: dict[str, Any] = {
            "size": [width, height],
            "transform": list(picture.transform),
            "crs": picture.crs,
            "properties": dict(picture.properties),
        }
        if is_kept(picture):
            entry["bands"] = bands
        else:
            why = f"PNG tiles contain what is shown of {bands} bands of {picture.pixels.dtype}; satellite keeps all"
            self.context.drop("pixel values", width * height, why)
            lost = ("bands", "palette", "nodata")
            entry["properties"] = {name: value for name, value in picture.properties.items() if name not in lost}
        self._write(key, image_pyramid(picture), position, entry, picture.attribution)

    def _write(
        self, key: PartKey, pyramid: Pyramid, position: Place, entry: Mapping[str, Any], credit: tuple[str, ...]
    ) -> None:
        if not self.entries:
            for statement in TILES:
                self.database.execute(statement)
        table = self._table_name(key)
        srs = self._system(position)
        right = position.left + pyramid.width * position.dx
        bottom = position.top - pyramid.height * position.dy
        title = f"{key.layer} {key.name}" if key.level == "ground" else f"{key.layer} {key.name}, level {key.level}"
        if any(title == other["title"] for other in self.entries):
            title = table
        description = "; ".join(dict.fromkeys((*credit, *self.context.attribution)))
        row = (table, "tiles", title, description, DATE, position.left, bottom, right, position.top, srs)
        self.database.execute("INSERT INTO gpkg_contents VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", row)
        side = TILE * 2**pyramid.zooms
        box = (position.left, position.top - side * position.dy, position.left + side * position.dx, position.top)
        self.database.execute("INSERT INTO gpkg_tile_matrix_set VALUES (?, ?, ?, ?, ?, ?)", (table, srs, *box))
        for zoom in range(pyramid.zooms + 1):
            pixel = 2 ** (pyramid.zooms - zoom)
            size = (2**zoom, 2**zoom, TILE, TILE, position.dx * pixel, position.dy * pixel)
            self.database.execute("INSERT INTO gpkg_tile_matrix VALUES (?, ?, ?, ?, ?, ?, ?, ?)", (table, zoom, *size))
        write_tiles(self.database, table, pyramid)
        place_of_part = {"table": table, "title": title, "layer": key.layer, "level": key.level, "part": key.name}
        self.entries.append({**place_of_part, **entry})

    def _table_name(self, key: PartKey) -> str:
        """Return a name that every program accepts, once: ``occupancy_map``, ``imagery_plan_floor_2``."""
        level = "" if key.level == "ground" else f"_{key.level}"
        base = re.sub(r"[^a-z0-9]+", "_", f"{key.layer}_{key.name}{level}".lower()).strip("_")[:50]
        name, number = base, 2
        while name in self.names:
            name, number = f"{base}_{number}", number + 1
        self.names.add(name)
        return name

    def _system(self, position: Place) -> int:
        """Return the srs_id of a place; a CRS that is new is added."""
        if position.definition is None:
            if position.srs_id is None:
                raise AssertionError("a CRS without a number needs a definition")
            return position.srs_id
        if position.definition in self.systems:
            return self.systems[position.definition]
        next_number = LOCAL_SRS + 1 + sum(number > LOCAL_SRS for number in self.systems.values())
        number = next_number if position.srs_id is None else position.srs_id
        organization = ORGANIZATION if position.srs_id is None else "EPSG"
        title = re.search(r'"([^"]*)"', position.definition)
        row = (title[1] if title else "CRS", number, organization, number, position.definition, None)
        self.database.execute("INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?)", row)
        self.systems[position.definition] = number
        return number

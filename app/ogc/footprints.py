"""Grids, images and voxel maps as collections of one feature each: their outline, and where to get their content."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import shapely
from starlette.concurrency import run_in_threadpool

from app.convert.extents import raster_outline
from app.convert.placement import place_raster
from app.convert.recently_used import RecentlyUsed
from app.model.features import NO_GEOMETRY
from app.model.frame import GROUND, Datum
from app.model.geodesy import local_frame
from app.model.imagery import LOCAL
from app.ogc.service import Service
from app.ogc.tables import Table, table_of
from app.store.parts.roots import read_root
from app.store.values import PartEntry

WORDS: Final[Mapping[str, tuple[str, str, str]]] = {
    "occupancy": ("grid", "Grid", "cells"),
    "imagery": ("image", "Image", "pixels"),
    "voxels": ("voxels", "Voxel map", "leaves"),
}
"""Layers of these collections: beginning of the id, of the title, what is counted."""

MAX_FOOTPRINTS: Final = 2000


@dataclass(frozen=True, slots=True)
class _Footprint:
    """Outline of a part, in local metres or degrees, and what its content says of itself."""

    geometry: Any
    local: bool
    properties: Mapping[str, Any]


_FOOTPRINTS: RecentlyUsed[_Footprint] = RecentlyUsed(MAX_FOOTPRINTS, lambda _: 1)
"""Footprints of this process: they depend on content and datum only, so that all stores can share them."""


def raster_parts(service: Service) -> dict[str, PartEntry]:
    """Return the grids, images and voxel maps of a version by id of their collection; none without a datum."""
    out: dict[str, PartEntry] = {}
    for entry in service.version.parts if service.version.datum is not None else ():
        if entry.key.layer in WORDS and entry.count:
            level = "" if entry.key.level == GROUND else f"@{entry.key.level}"
            name = f"{WORDS[entry.key.layer][0]}-{entry.key.name}{level}"
            out[name if name not in out else f"{name}#{len(out)}"] = entry
    return out


def raster_title(entry: PartEntry) -> str:
    """Return the title of the collection of a part."""
    level = "" if entry.key.level == GROUND else f", level {entry.key.level}"
    return f"{WORDS[entry.key.layer][1]} {entry.key.name}{level}"


def geotiff_map(entry: PartEntry) -> tuple[str, dict[str, str]] | None:
    """Return format and parameters of the map that has a grid or image as cloud optimized GeoTIFF, with its place."""
    formats = {"occupancy": ("occupancy_grid", "grid"), "imagery": ("satellite", "picture")}
    if entry.key.layer not in formats:
        return None
    name, option = formats[entry.key.layer]
    return name, {option: entry.key.name, "level": entry.key.level, "file_type": "tif"}


def geotiff_url(service: Service, name: str, entry: PartEntry) -> str | None:
    """Return the absolute URL of the GeoTIFF of a grid or image; None for a voxel map, and in an edited draft."""
    if geotiff_map(entry) is None or service.version.pending is not None:
        return None
    return service.url("collections", name, "geotiff")


async def footprint_table(service: Service, name: str) -> Table | None:
    """Return the table of a grid, image or voxel map; None if there is no such collection."""
    entry = raster_parts(service).get(name)
    datum = service.version.datum
    if entry is None or datum is None:
        return None
    footprint = _FOOTPRINTS.get((entry.key, entry.hash, datum))
    if footprint is None:
        footprint = await run_in_threadpool(_read, service, entry, datum)
    addresses = {"map": service.url("collections", name, "map"), "geotiff": geotiff_url(service, name, entry)}
    properties = {**footprint.properties, **{key: url for key, url in addresses.items() if url is not None}}
    return table_of(entry.key, entry.key.name, footprint.geometry, properties, local=footprint.local, datum=datum)


def _read(service: Service, entry: PartEntry, datum: Datum) -> _Footprint:
    """Read the outline of a part and its measures, without a cell."""
    if entry.key.layer == "voxels":
        header = read_root(service.services.store.chunks.stage(), bytes.fromhex(entry.hash)).header
        box = entry.bounds.get("local")
        properties = {"resolution": header["resolution"], "leaves": entry.count}
        geometry, local = NO_GEOMETRY if box is None else shapely.box(*box), True
    else:
        reader = service.services.tiles.header(entry)
        system = LOCAL if reader.kind == "grid" else str(reader.header["crs"])
        resolution = place_raster(reader, datum).resolution
        properties = {"resolution": resolution, "width": reader.width, "height": reader.height}
        properties |= {} if reader.kind == "grid" else {"crs": system}
        metres, degrees = raster_outline(reader.header, reader.kind, local_frame(datum))
        local = system == LOCAL
        points = metres if local else degrees
        geometry = shapely.Polygon(points) if np.isfinite(points).all() else NO_GEOMETRY
    shown = {"kind": WORDS[entry.key.layer][0], "name": entry.key.name, **properties, "hash": entry.hash}
    kept = {name: value for name, value in shown.items() if value is not None}
    footprint = _Footprint(shapely.orient_polygons(geometry), local, kept)
    return _FOOTPRINTS.put((entry.key, entry.hash, datum), footprint)

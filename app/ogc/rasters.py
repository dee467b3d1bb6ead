"""Collections of grids and images, which are served as maps and map tiles."""

from __future__ import annotations

from collections.abc import Sequence
from urllib.parse import urlencode

from app.api.http.responses import API
from app.convert.preview import PreviewRequest, select_entries
from app.convert.views import ViewContent
from app.model.frame import GROUND
from app.ogc.collections import unknown_collection_error
from app.ogc.crs import CRS84, reference_systems
from app.ogc.extensions import Collection, Extension, all_collections
from app.ogc.extent import part_box
from app.ogc.service import Link, Service, link, origin
from app.ogc.vector import TITLES
from app.store.values import PartEntry

WORDS = {"occupancy": ("grid", "Grid"), "imagery": ("image", "Image")}

SHAPE_TYPES = {
    "nodes": {0, 4},
    "edges": {1, 2, 5},
    "objects-points": {0, 4},
    "objects-lines": {1, 2, 5},
    "objects-polygons": {3, 6},
    "objects-other": {7},
}
"""Shapely's types of the geometries of collections that share a layer."""

TIFF = "image/tiff; application=geotiff; profile=cloud-optimized"


def raster_parts(service: Service) -> dict[str, PartEntry]:
    """Return the grids and images of a version by id of their collection."""
    out: dict[str, PartEntry] = {}
    for entry in service.version.parts:
        if entry.key.layer in WORDS and entry.count:
            level = "" if entry.key.level == GROUND else f"@{entry.key.level}"
            name = f"{WORDS[entry.key.layer][0]}-{entry.key.name}{level}"
            out[name if name not in out else f"{name}#{len(out)}"] = entry
    return out


def cog_url(service: Service, entry: PartEntry) -> str:
    """Return the absolute URL of a raster as cloud optimized GeoTIFF, with its place on earth."""
    kind, option = ("occupancy_grid", "grid") if entry.key.layer == "occupancy" else ("satellite", "picture")
    query = urlencode({option: entry.key.name, "level": entry.key.level, "file_type": "tif"})
    server = origin(service.request, service.services.options.public_url)
    return f"{server}{API}/environments/{service.environment.name}/versions/{service.version.ref}/maps/{kind}?{query}"


def _links(service: Service, entry: PartEntry) -> list[Link]:
    return [link(cog_url(service, entry), "enclosure", TIFF, "GeoTIFF with its place on earth")]


async def _collections(service: Service) -> Sequence[Collection]:
    datum = service.version.datum
    if datum is None:
        return ()
    crs = list(reference_systems(service, datum))
    out = []
    for name, entry in raster_parts(service).items():
        word = WORDS[entry.key.layer][1]
        unit = "cells" if word == "Grid" else "pixels"
        level = "" if entry.key.level == GROUND else f", level {entry.key.level}"
        out.append(
            Collection(
                id=name,
                title=f"{word} {entry.key.name}{level}",
                description=f"{word} of {entry.count} {unit}, as maps and map tiles.",
                bbox=part_box(service, entry),
                members={"crs": crs, "storageCrs": CRS84},
                links=_links(service, entry),
            )
        )
    return out


def content_of(service: Service, collection: str | None) -> ViewContent:
    """Return what a map of a collection shows; None: the site's default level. Raises NotFound."""
    if collection is None:
        return ViewContent(select_entries(service.version, PreviewRequest()))
    if collection in TITLES:
        layer = TITLES[collection][0]
        parts = [entry for entry in service.version.parts if entry.key.layer == layer and entry.count]
        types = SHAPE_TYPES.get(collection)
        return ViewContent(parts, None if types is None else frozenset(types))
    return ViewContent([raster_parts(service)[collection]])


async def check_collection(service: Service, collection: str | None) -> None:
    """Raise NotFound for an unknown collection, or a version that has no place on earth."""
    if collection is None and service.version.datum is not None:
        return
    names = [one.id for one in await all_collections(service)]
    if collection not in names:
        raise unknown_collection_error(service, collection or "map", names)


extension = Extension(collections=_collections)

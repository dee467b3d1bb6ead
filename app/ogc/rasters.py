"""Collections of grids, images and voxel maps, which are served as maps and map tiles besides their outlines."""

from __future__ import annotations

from collections.abc import Sequence

from app.convert.preview import PreviewRequest, select_entries
from app.convert.views import ViewContent
from app.ogc.collections import unknown_collection_error
from app.ogc.crs import CRS84, reference_systems
from app.ogc.extensions import Collection, Extension, all_collections
from app.ogc.footprints import WORDS, footprint_table, geotiff_url, raster_parts, raster_title
from app.ogc.geotiff import TIFF
from app.ogc.service import Link, Service, link
from app.ogc.vector import TITLES, item_links
from app.store.values import PartEntry

SHAPE_TYPES = {
    "nodes": {0, 4},
    "edges": {1, 2, 5},
    "objects-points": {0, 4},
    "objects-lines": {1, 2, 5},
    "objects-polygons": {3, 6},
    "objects-other": {7},
}
"""Shapely's types of the geometries of collections that share a layer."""


def _links(service: Service, name: str, entry: PartEntry) -> list[Link]:
    geotiff = geotiff_url(service, name, entry)
    shown = [link(geotiff, "enclosure", TIFF, "GeoTIFF with its place on earth")] if geotiff is not None else []
    return [*item_links(service, name), *shown]


async def _collections(service: Service) -> Sequence[Collection]:
    datum = service.version.datum
    if datum is None:
        return ()
    crs = list(reference_systems(service, datum))
    out = []
    for name, entry in raster_parts(service).items():
        _, word, unit = WORDS[entry.key.layer]
        table = await footprint_table(service, name)
        out.append(
            Collection(
                id=name,
                title=raster_title(entry),
                description=f"{word} of {entry.count} {unit}: its outline as a feature, its content as maps and tiles.",
                bbox=None if table is None else table.bbox,
                members={"itemType": "feature", "crs": crs, "storageCrs": CRS84},
                links=_links(service, name, entry),
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

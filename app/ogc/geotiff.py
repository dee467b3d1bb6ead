"""GeoTIFFs of grids and images: redirects to their map, for programs that sign in below ``/ogc`` only."""

from __future__ import annotations

from typing import Annotated

from fastapi import Path
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from app.api.http.addresses import origin
from app.api.http.auth import Viewer
from app.api.http.responses import API
from app.errors import NotFound
from app.ogc.footprints import geotiff_map, raster_parts
from app.ogc.routing import both, ogc_router
from app.ogc.service import Service

TIFF = "image/tiff; application=geotiff; profile=cloud-optimized"
SECONDS = 3600
"""Maximum life of the link."""

RasterPath = Annotated[
    str, Path(max_length=512, description="Id of a collection of a grid or image.", examples=["grid-map"])
]

router = ogc_router()


@both(
    router,
    "/collections/{collection}/geotiff",
    {TIFF: {}},
    redirects=True,
    summary="Redirect to the GeoTIFF of a grid or image",
)
async def get_geotiff(service: Service, collection: RasterPath, principal: Viewer) -> Response:
    """Redirect to a grid or image as cloud optimized GeoTIFF, with its place on earth.

    The address works where programs send user and password, which maps do not take: it leads to a signed link.
    """
    entry = raster_parts(service).get(collection)
    wanted = None if entry is None else geotiff_map(entry)
    if wanted is None:
        raise NotFound(f"{collection} has no GeoTIFF: only collections of grids and images have one")
    if service.version.pending is not None:
        raise NotFound("no map is made of a draft before it is committed: open the GeoTIFF of a version")
    name, parameters = wanted
    links = service.services.links
    path = f"{API}/environments/{service.environment.name}/versions/{service.version.ref}/maps/{name}"
    seconds = min(SECONDS, links.max_seconds)
    grant = await run_in_threadpool(links.create, service.environment, path, parameters, seconds, principal)
    address = origin(service.request, service.services.options.public_url) + grant.url
    return Response(status_code=307, headers={"location": address, "cache-control": "no-store"})

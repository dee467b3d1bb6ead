"""Tiles of grids, images and voxel maps, in the raster's own pixels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

from fastapi import Path, Query, Request
from pydantic import BaseModel, Field
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from app.api.http.auth import Viewer
from app.api.http.caching import cache_control, none_match
from app.api.http.dependencies import Services, ServicesDep
from app.api.http.parameters import parse_version_ref
from app.api.http.responses import api_router, json_response
from app.api.http.schemas import EnvironmentPath, VersionPath, problem_responses
from app.api.http.tile_address import (
    NOT_MODIFIED,
    TILE_RESPONSES,
    LevelOfDetail,
    TileColumn,
    TileHash,
    TileRow,
    check_hash,
)
from app.api.layers import select_part
from app.convert.placement import Placement, place_columns, place_raster
from app.convert.pyramid import TILE, Size
from app.convert.tiles import Kind, TileAddress, tile_etag
from app.convert.voxel_tiles import Columns, Span, slice_heights
from app.errors import Invalid, Problem
from app.model.frame import MAX_METRES
from app.model.layers import PartKey
from app.store.values import PartEntry, Version

router = api_router("tiles", "/environments/{env}/versions/{v}/tiles")


class RasterOut(BaseModel):
    """Raster whose tiles can be read: size, position, and levels of detail."""

    kind: Kind
    name: str
    level: str
    width: int = Field(description="Pixels of the highest `z`. Voxels: one for each smallest voxel.")
    height: int
    resolution: float | None = Field(description="Metres per pixel. Null if the pixels are not square.")
    origin: tuple[float, float, float] | None = Field(
        description="x, y and yaw of the lower left corner in the local frame (metres, radians), as of an occupancy "
        "grid. Null if the pixels are not square, or the image is mirrored."
    )
    transform: tuple[float, float, float, float, float, float] = Field(
        description="[a, b, c, d, e, f]: x = a·column + b·row + c and y = d·column + e·row + f in local metres, for "
        "the upper left corner of a pixel; row 0 is on top."
    )
    deviation: float = Field(
        description="Maximum distance in metres between `transform` and the exact position; above 0 only for images in "
        "a CRS of their own."
    )
    tile: Literal[256] = Field(description="Side of a tile in pixels.")
    levels: int = Field(
        description="Number of values of `z`: `levels` - 1 has one pixel per cell; each one below halves the size, "
        "rounded up; 0 is a single tile."
    )
    bounds: tuple[float, float, float, float] = Field(
        description="Minimum x, minimum y, maximum x, maximum y of the turned raster in local metres."
    )
    hash: str = Field(description="Hash of the content; equal for equal rasters of different versions.")
    z_min: float | None = Field(description="Voxels: lowest height in metres. Null for others.")
    z_max: float | None = Field(description="Voxels: largest height in metres. Null for others.")


KindPath = Annotated[Kind, Path(description="Kind of raster.", examples=["occupancy"])]
NamePath = Annotated[
    str, Path(max_length=256, description="Name of the part, for example of a grid.", examples=["map"])
]
LevelQuery = Annotated[
    str | None, Query(max_length=256, description="Level of the part; required if several levels have the name.")
]
HeightQuery = Annotated[float | None, Query(ge=-MAX_METRES, le=MAX_METRES, allow_inf_nan=False)]


@dataclass(frozen=True, slots=True)
class _Raster:
    """A requested part, and the headers of its responses."""

    version: Version
    key: PartKey
    entry: PartEntry
    headers: dict[str, str]


def _find(services: Services, env: str, v: str, kind: Kind, name: str, level: str | None) -> _Raster:
    ref = parse_version_ref(v)
    version = services.store.versions.get(env, ref)
    key = select_part(version, kind, level, name)
    entry = version.part(key)
    assert entry is not None
    headers = {
        "cache-control": cache_control(ref),
        "fleetmap-version": str(version.ref),
        "fleetmap-root": version.root,
    }
    return _Raster(version, key, entry, headers)


@router.get(
    "/{kind}/{name:path}/{z}/{row}/{col}.png",
    response_class=Response,
    responses={
        **problem_responses(None, 404, 409, 422),
        **TILE_RESPONSES,
    },
    summary="Get a tile",
)
async def get_tile(
    env: EnvironmentPath,
    v: VersionPath,
    kind: KindPath,
    name: NamePath,
    z: LevelOfDetail,
    row: TileRow,
    col: TileColumn,
    request: Request,
    services: ServicesDep,
    _: Viewer,
    level: LevelQuery = None,
    z_min: Annotated[HeightQuery, Query(description="Voxels: lower end of the slice in metres. Default: all.")] = None,
    z_max: Annotated[HeightQuery, Query(description="Voxels: upper end of the slice in metres. Default: all.")] = None,
    hash_: TileHash = None,
) -> Response:
    """Return a tile of a raster, in the raster's own pixels: row 0 and column 0 are the upper left corner.

    `occupancy` and `voxels` are grey: 0 (free) to 100 (occupied), 255 unknown and outside; a coarser level has the
    maximum of the known cells, so that no obstacle disappears. A pixel of `voxels` is occupied if any voxel of its
    column in the slice is. `imagery` is RGB, or RGBA with transparency, also outside; coarser levels are averaged.

    Tiles of numbered versions never change, and may be cached for good.
    """
    generation = services.response_cache.generation()
    raster = await run_in_threadpool(_find, services, env, v, kind, name, level)
    check_hash(hash_, raster.entry.hash)
    address = TileAddress(z, row, col)
    tiles, entry = services.tiles, raster.entry
    if kind == "voxels":
        heights: Span | None = await run_in_threadpool(_heights, services, raster, z_min, z_max)
    elif z_min is not None or z_max is not None:
        given = "z_min" if z_min is not None else "z_max"
        raise Invalid(f"{given} selects a slice of voxels: omit it for {kind}", [Problem("omit it", where=given)])
    else:
        heights = None
    raster.headers["etag"] = tile_etag(entry, address, heights)
    if none_match(request.headers.get("if-none-match"), raster.headers["etag"]):
        return Response(status_code=304, headers=raster.headers)
    png = tiles.cached(entry, address, heights)
    if png is None and heights is not None:
        key = ("tile", entry.hash, address, heights)
        call = partial(tiles.voxel_tile, raster.version, raster.key, address, heights)
        png = await services.response_cache.join(key, call)
    elif png is None:
        png = await _draw(services, entry, address)
    services.response_cache.store_response(request, env, raster.headers, png, generation, "image/png")
    return Response(png, headers=raster.headers, media_type="image/png")


async def _draw(services: Services, entry: PartEntry, address: TileAddress) -> bytes:
    """Make a tile. Requests that need work on the whole raster wait for it together, without a thread each."""
    tiles, join = services.tiles, services.response_cache.join
    if not await run_in_threadpool(tiles.is_ready, entry, address.z):
        await join(("tiles", entry.hash), tiles.prepare, entry)
    png: bytes = await join(("tile", entry.hash, address), tiles.raster_tile, entry, address)
    return png


def _heights(services: Services, raster: _Raster, z_min: float | None, z_max: float | None) -> Span:
    return slice_heights(services.tiles.columns(raster.version, raster.key), z_min, z_max)


@router.get(
    "/{kind}/{name:path}",
    responses={**problem_responses(RasterOut, 404, 409, 422), **NOT_MODIFIED},
    summary="Describe the tiles of a raster",
)
def get_raster(
    env: EnvironmentPath,
    v: VersionPath,
    kind: KindPath,
    name: NamePath,
    request: Request,
    services: ServicesDep,
    _: Viewer,
    level: LevelQuery = None,
) -> Response:
    """Return size, position and levels of detail of a grid, an image or a voxel map."""
    raster = _find(services, env, v, kind, name, level)
    datum = raster.version.datum
    position = None if datum is None else datum.as_dict()
    raster.headers["etag"] = tile_etag(raster.entry, None, None, raster.key.level, raster.key.name, position)
    if none_match(request.headers.get("if-none-match"), raster.headers["etag"]):
        return Response(status_code=304, headers=raster.headers)
    columns = None
    if kind == "voxels":
        columns = services.tiles.columns(raster.version, raster.key)
        size, placement = Size(columns.width, columns.height), place_columns(columns)
    else:
        reader = services.tiles.header(raster.entry)
        size, placement = Size(reader.width, reader.height), place_raster(reader, datum)
    return json_response(_describe(raster, size, placement, columns), headers=raster.headers)


def _describe(raster: _Raster, size: Size, placement: Placement, columns: Columns | None) -> dict[str, Any]:
    first, end = (None, None) if columns is None else (h * columns.resolution for h in columns.heights)
    return {
        "kind": raster.key.layer,
        "name": raster.key.name,
        "level": raster.key.level,
        "width": size.width,
        "height": size.height,
        "resolution": placement.resolution,
        "origin": placement.origin,
        "transform": placement.transform,
        "deviation": placement.deviation,
        "tile": TILE,
        "levels": size.levels,
        "bounds": placement.bounds(size.width, size.height),
        "hash": raster.entry.hash,
        "z_min": None if first is None else round(first, 9),
        "z_max": None if end is None else round(end, 9),
    }

"""Changed cells between two versions of an occupancy grid, as tiles."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from typing import Annotated, Literal

from fastapi import Path, Query, Request
from pydantic import BaseModel, Field
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from app.api.diff import FromRef, Ref, compared_versions
from app.api.http.auth import Viewer
from app.api.http.caching import none_match
from app.api.http.dependencies import Services, ServicesDep
from app.api.http.responses import api_router, json_bytes, json_response
from app.api.http.schemas import EnvironmentPath, problem_responses
from app.api.http.tile_address import (
    NOT_MODIFIED,
    TILE_RESPONSES,
    LevelOfDetail,
    TileColumn,
    TileHash,
    TileRow,
    check_hash,
)
from app.convert.cache import ConvertedMap
from app.convert.change_tiles import TILE, draw_stored_tile, draw_tile, level_count
from app.convert.report import Report
from app.errors import Ambiguous, NotFound, Problem, Unavailable
from app.model.names import did_you_mean
from app.pool import WorkerDied
from app.store.cell_changes import CellChangeImage
from app.store.diff import cell_box
from app.store.values import Version

router = api_router("versions", "/environments/{env}/diff/tiles")

IMMUTABLE = "private, max-age=31536000, immutable"
REVALIDATE = "private, no-cache"
DIRECT = 2
"""Maximum number of halvings of a tile that is drawn at once: 1024 × 1024 cells; others are drawn in a worker."""

DRAWING = 1
"""Version of the drawing, part of each ETag."""


class ChangeRasterOut(BaseModel):
    """Raster of changed cells whose tiles can be read: size, position, and levels of detail."""

    name: str
    level: str
    from_: int | str = Field(alias="from", description="Number of the older version, or `dry:…`.")
    to: int | str = Field(description="Number of the newer version, or `dry:…`.")
    width: int = Field(description="Pixels of the highest `z`: cells of the newer grid.")
    height: int
    resolution: float = Field(description="Metres per cell.")
    origin: tuple[float, float, float] = Field(
        description="x, y and yaw of the lower left corner in the local frame (metres, radians)."
    )
    transform: tuple[float, float, float, float, float, float] = Field(
        description="[a, b, c, d, e, f]: x = a·column + b·row + c and y = d·column + e·row + f in local metres, for "
        "the upper left corner of a pixel; row 0 is on top."
    )
    tile: Literal[256] = Field(description="Side of a tile in pixels.")
    levels: int = Field(
        description="Number of values of `z`: `levels` - 1 has one pixel per cell; each one below halves the size, "
        "rounded up; 0 is a single tile."
    )
    bounds: tuple[float, float, float, float] = Field(
        description="Minimum x, minimum y, maximum x, maximum y of the turned raster in local metres."
    )
    hash: str = Field(description="Hash of both contents; equal for equal changes between other versions.")


@dataclass(frozen=True, slots=True)
class _Comparison:
    """Two versions of a grid; a hash is None if that version does not have it."""

    old: Version
    new: Version
    level: str
    old_hash: str | None
    new_hash: str | None

    def etag(self, *address: object) -> str:
        """Build the ETag of a response about it."""
        seed = json_bytes(["diff tiles", DRAWING, self.old_hash, self.new_hash, *address])
        return f'"{hashlib.sha256(seed).hexdigest()[:32]}"'

    @property
    def hash(self) -> str:
        """Return the hash of both contents."""
        return self.etag().strip('"')


NamePath = Annotated[str, Path(max_length=256, description="Name of the grid.", examples=["map"])]
LevelQuery = Annotated[
    str | None, Query(max_length=256, description="Level of the grid; required if several levels have the name.")
]


@router.get(
    "/{name:path}/{z}/{row}/{col}.png",
    response_class=Response,
    responses={
        **problem_responses(None, 404, 409, 422, 503),
        **TILE_RESPONSES,
    },
    summary="Get a tile of changed cells",
)
async def get_change_tile(
    env: EnvironmentPath,
    name: NamePath,
    z: LevelOfDetail,
    row: TileRow,
    col: TileColumn,
    request: Request,
    services: ServicesDep,
    _: Viewer,
    from_: FromRef = None,
    to: Ref = "latest",
    level: LevelQuery = None,
    hash_: TileHash = None,
) -> Response:
    """Return a grey tile of changed cells, in the pixels of the newer grid: row 0 and column 0 are the upper left.

    0: the same, or outside. 1: blocked (free before, occupied now). 2: freed. 3: unknown now. 4: unknown before, free
    now. 5: unknown before, occupied now. 6: another change of value. A coarser level has the smallest number above 0,
    so that no blocked cell disappears.

    If the grids differ in frame, each cell is compared with the older cell at its centre; outside the older grid cells
    count as unknown. A deleted grid is drawn in its own frame, as unknown now.
    """
    compared = await run_in_threadpool(_find, services, env, from_, to, name, level)
    check_hash(hash_, compared.hash)
    headers = _headers(compared.etag(z, row, col), from_, to)
    if none_match(request.headers.get("if-none-match"), headers["etag"]):
        return Response(status_code=304, headers=headers)
    key = (compared.etag(z, row, col), "change tile")
    png = await services.response_cache.join(key, _draw, services, compared, z, row, col)
    return Response(png, headers=headers, media_type="image/png")


@router.get(
    "/{name:path}",
    responses={**problem_responses(ChangeRasterOut, 404, 409, 422), **NOT_MODIFIED},
    summary="Describe the tiles of changed cells",
)
def get_change_raster(
    env: EnvironmentPath,
    name: NamePath,
    request: Request,
    services: ServicesDep,
    _: Viewer,
    from_: FromRef = None,
    to: Ref = "latest",
    level: LevelQuery = None,
) -> Response:
    """Return size, position and levels of detail of the tiles that show the changed cells of a grid."""
    compared = _find(services, env, from_, to, name, level)
    headers = _headers(compared.etag(name, compared.level, compared.old.ref, compared.new.ref), from_, to)
    if none_match(request.headers.get("if-none-match"), headers["etag"]):
        return Response(status_code=304, headers=headers)
    image = services.store.content.cell_changes(compared.old_hash, compared.new_hash)
    body = {
        "name": name,
        "level": compared.level,
        "from": compared.old.ref,
        "to": compared.new.ref,
        "width": image.width,
        "height": image.height,
        "resolution": image.header["resolution"],
        "origin": list(image.header["origin"]),
        "transform": _transform(image),
        "tile": TILE,
        "levels": level_count(image),
        "bounds": list(cell_box(image.header, 0, 0, image.width, image.height)),
        "hash": compared.hash,
    }
    return json_response(body, headers=headers)


def _find(services: Services, env: str, from_: str | None, to: str | None, name: str, level: str | None) -> _Comparison:
    """Find a grid in either version. Raises NotFound with the existing names, Ambiguous with the levels."""
    old, new = compared_versions(services, env, from_, to)
    grids: list[dict[tuple[str, str], str]] = [
        {(e.key.level, e.key.name): e.hash for e in version.parts if e.key.layer == "occupancy"}
        for version in (old, new)
    ]
    present = grids[0].keys() | grids[1].keys()
    levels = sorted({at for at, grid in present if grid == name and level in (None, at)})
    if not levels:
        names = sorted({grid for _, grid in present})
        on_level = "" if level is None else f" on level {level!r}"
        raise NotFound(
            f"unknown grid {name!r}{on_level}{did_you_mean(name, names)}; versions {old.ref} and {new.ref} have "
            f"{', '.join(f'{grid} (level {at})' for at, grid in sorted(present)) or 'none'}"
        )
    if len(levels) > 1:
        problems = [Problem(f"level {at}", where=name) for at in levels]
        raise Ambiguous(f"several levels have a grid {name!r}: give level (one of {', '.join(levels)})", problems)
    place = (levels[0], name)
    return _Comparison(old, new, levels[0], grids[0].get(place), grids[1].get(place))


def _headers(etag: str, from_: str | None, to: str | None) -> dict[str, str]:
    fixed = all(ref is not None and ref.isdigit() for ref in (from_, to))
    return {"etag": etag, "cache-control": IMMUTABLE if fixed else REVALIDATE}


def _transform(image: CellChangeImage) -> list[float]:
    x, y, yaw = image.header["origin"]
    resolution = image.header["resolution"]
    c, s = resolution * math.cos(yaw), resolution * math.sin(yaw)
    return [c, s, x - s * image.height, s, -c, y + c * image.height]


def _draw(services: Services, compared: _Comparison, z: int, row: int, col: int) -> bytes:
    """Draw a tile. Raises NotFound outside the raster."""
    image = services.store.content.cell_changes(compared.old_hash, compared.new_hash)
    levels = level_count(image)
    if z >= levels:
        raise NotFound(f"no level of detail {z}: the tiles have z 0 to {levels - 1}")
    k = levels - 1 - z
    rows, columns = (-(-size // (TILE << k)) for size in (image.height, image.width))
    if row >= rows or col >= columns:
        raise NotFound(f"no tile {row}/{col}: z {z} has rows 0 to {rows - 1} and columns 0 to {columns - 1}")
    if k <= DIRECT:
        return draw_tile(image, k, row, col)

    def convert() -> ConvertedMap:
        store = services.store
        arguments = (store.database_url, str(store.blob_dir), compared.old_hash, compared.new_hash, k, row, col)
        try:
            png: bytes = services.pool.run(draw_stored_tile, *arguments)
        except WorkerDied as error:
            raise Unavailable(f"the tile could not be drawn: {error.detail}") from error
        return ConvertedMap({"tile.png": (png, "image/png")}, None, Report("diff"))

    key = hashlib.sha256(compared.etag(z, row, col).encode()).hexdigest()
    return services.maps.cache.get_or_make(key, convert).single_file().read()

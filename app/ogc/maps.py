"""Maps (OGC API - Maps): pictures of the site and of each collection in any of its CRSs."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from fastapi import Query
from PIL import ImageColor
from starlette.responses import Response

from app.api.http.caching import none_match
from app.api.http.parameters import parse_numbers
from app.convert.drawing import Colour
from app.convert.views import MAX_SIDE, View, view_key
from app.errors import Invalid, NotFound, Problem
from app.model import geodesy
from app.model.imagery import LOCAL
from app.ogc.collections import CollectionPath
from app.ogc.crs import EPSG, MERCATOR, ReferenceSystem, parse_crs, reference_systems
from app.ogc.description import operation
from app.ogc.extensions import Collection, Extension, all_collections
from app.ogc.extent import site_box
from app.ogc.negotiation import Representation
from app.ogc.rasters import check_collection, content_of
from app.ogc.routing import both, ogc_router
from app.ogc.service import Link, Service, link
from app.ogc.tile_matrix_sets import MERCATOR_EDGE
from app.store.parts.boxes import ring
from app.store.values import Box

PNG = "image/png"
REL = "http://www.opengis.net/def/rel/ogc/1.0/map"
CONFORMANCE = "http://www.opengis.net/spec/ogcapi-maps-1/1.0/conf/"
DEFAULT_SIDE = 1024
"""Longer side of a map without a size, in pixels."""

MAX_COORDINATE = 1e9
MIN_SIDE = 1e-9
"""Maximum of a box's coordinates, and minimum of its sides, in units of its CRS."""

_CURIE = re.compile(r"\[(EPSG|OGC):([A-Za-z0-9.]+)\]")
_HEX = re.compile(r"(0x|#)?([0-9a-fA-F]{6})")

router = ogc_router()

BboxQuery = Annotated[
    str | None,
    Query(
        max_length=200,
        description="Minimum x, minimum y, maximum x, maximum y in the axis order of `bbox-crs`. Default: the content.",
        examples=["-0.53,53.26,-0.52,53.27"],
    ),
]
BboxCrsQuery = Annotated[
    str | None,
    Query(
        alias="bbox-crs",
        max_length=300,
        description="URI or CURIE (`[EPSG:3857]`) of the CRS of `bbox`. Default: CRS84.",
    ),
]
CrsQuery = Annotated[
    str | None,
    Query(max_length=300, description="URI or CURIE of the CRS of the map: one of the collection. Default: CRS84."),
]
WidthQuery = Annotated[
    int | None,
    Query(ge=1, le=MAX_SIDE, description="Width in pixels. Default: of the height, or 1024 for the longer side."),
]
HeightQuery = Annotated[
    int | None, Query(ge=1, le=MAX_SIDE, description="Height in pixels. Default: so that the map is not distorted.")
]
BgcolorQuery = Annotated[
    str | None,
    Query(max_length=40, description="Background: `0xRRGGBB` or a name such as `white`.", examples=["0xFFFFFF"]),
]
TransparentQuery = Annotated[
    bool | None, Query(description="Whether the background is transparent. Default: only without `bgcolor`.")
]


@dataclass(frozen=True, slots=True)
class _Wanted:
    """Parameters of a map."""

    bbox: str | None
    bbox_crs: str | None
    crs: str | None
    width: int | None
    height: int | None
    bgcolor: str | None
    transparent: bool | None


def _system(text: str | None, systems: Mapping[str, ReferenceSystem], parameter: str) -> ReferenceSystem:
    """Return the CRS with a URI or a CURIE; None: CRS84."""
    if text is None:
        return next(iter(systems.values()))
    curie = _CURIE.fullmatch(text)
    if curie is not None:
        text = f"{EPSG}{curie[2]}" if curie[1] == "EPSG" else f"http://www.opengis.net/def/crs/OGC/1.3/{curie[2]}"
    if text.startswith("https://www.opengis.net/"):
        text = "http" + text[5:]
    return parse_crs(text, systems, parameter)


def _code(system: ReferenceSystem) -> str:
    """Return the CRS for drawing, x first."""
    return {"crs84": geodesy.WGS84, "local": LOCAL}.get(system.kind, system.code)


def _parse_box(text: str, system: ReferenceSystem) -> Box:
    """Parse a box, x first. Raises Invalid."""
    numbers = parse_numbers(text)
    if len(numbers) != 4 or max(map(abs, numbers)) > MAX_COORDINATE:
        problem = Problem(f"must be four numbers within ±{MAX_COORDINATE:g}", where="bbox")
        raise Invalid(f"bbox must be four numbers separated by commas, got {text[:80]!r}", [problem])
    a, b, c, d = numbers
    box = (b, a, d, c) if system.swap else (a, b, c, d)
    if system.is_geographic:
        box = _continued(box)
    if box[0] >= box[2] or box[1] >= box[3]:
        raise Invalid(
            "bbox must have a minimum below its maximum on both axes (in degrees, west > east is the antimeridian)",
            [Problem("has no area", where="bbox")],
        )
    return box


def _continued(box: Box) -> Box:
    """Return a box in degrees across the antimeridian with an east beyond 180."""
    west, south, east, north = box
    return (west, south, east + 360.0, north) if 180.0 >= west > east >= -180.0 else box


def _corners(box: Box, system: ReferenceSystem) -> Box:
    """Return a box as clients see it: in the CRS's order of axes, with west > east across the antimeridian."""
    west, south, east, north = box
    east = east - 360.0 if system.is_geographic and west <= 180.0 < east else east
    return (south, west, north, east) if system.swap else (west, south, east, north)


def _convert(service: Service, box: Box, source: ReferenceSystem, target: ReferenceSystem) -> Box:
    """Return the box in one CRS around a box in another. Raises Invalid if it is outside of it."""
    if _code(source) == _code(target):
        return box
    assert service.version.datum is not None
    frame = geodesy.local_frame(service.version.datum)
    points = ring(box)
    degrees = (
        frame.to_wgs84(points) if source.kind == "local" else geodesy.between(_code(source), geodesy.WGS84, points)
    )
    if target.code == MERCATOR:
        degrees[:, 1] = degrees[:, 1].clip(-85.05, 85.05)
    out = frame.to_local(degrees) if target.kind == "local" else geodesy.between(geodesy.WGS84, _code(target), degrees)
    if target.code == MERCATOR:  # PROJ's x ends at the antimeridian
        out[:, 0] += np.round(degrees[:, 0] / 180.0 - out[:, 0] / MERCATOR_EDGE) * MERCATOR_EDGE
    if not np.isfinite(out).all():
        raise Invalid(
            f"the bbox is outside the area of {target.uri}: choose another crs", [Problem("outside", where="bbox")]
        )
    (x0, y0), (x1, y1) = out.min(axis=0).tolist(), out.max(axis=0).tolist()
    return x0, y0, x1, y1


def _size(box: Box, system: ReferenceSystem, wanted: _Wanted) -> tuple[int, int]:
    """Return width and height in pixels."""
    stretch = 1.0
    if _code(system) == geodesy.WGS84:  # a degree of longitude is shorter
        stretch = max(0.01, math.cos(math.radians((box[1] + box[3]) / 2)))
    ratio = (box[3] - box[1]) / ((box[2] - box[0]) * stretch)
    if wanted.width is None:
        long = DEFAULT_SIDE if ratio <= 1 else DEFAULT_SIDE / ratio
        width = _side(long if wanted.height is None else wanted.height / ratio)
    else:
        width = wanted.width
    return width, _side(width * ratio) if wanted.height is None else wanted.height


def _side(pixels: float) -> int:
    return round(min(max(1.0, pixels), MAX_SIDE))


def _background(wanted: _Wanted) -> Colour | None:
    """Return the colour of the background; None for a transparent one. Raises Invalid for an unknown colour."""
    colour: Colour = (255, 255, 255)
    if wanted.bgcolor is not None:
        match = _HEX.fullmatch(wanted.bgcolor)
        name = wanted.bgcolor.lower() if match is None else f"#{match[2]}"
        if not name.startswith("#") and name not in ImageColor.colormap:
            problem = Problem("must be 0xRRGGBB or a name of a web colour", where="bgcolor")
            raise Invalid(f"unknown bgcolor {wanted.bgcolor!r}: use 0xRRGGBB or a name such as white", [problem])
        red, green, blue = ImageColor.getrgb(name)[:3]
        colour = red, green, blue
    transparent = wanted.bgcolor is None if wanted.transparent is None else wanted.transparent
    return None if transparent else colour


async def _extent(service: Service, collection: str | None) -> Box:
    """Return the box of the content in degrees, a little larger. Raises NotFound if nothing has a position."""
    box = await site_box(service)
    if collection is not None:
        (entry,) = [one for one in await all_collections(service) if one.id == collection]
        box = entry.bbox or box
    if box is None:
        raise NotFound(f"{collection or service.environment.name} has no box to draw by default: give a bbox")
    west, south, east, north = _continued(box)
    x, y = max((east - west) * 0.02, 1e-6), max((north - south) * 0.02, 1e-6)
    south, north = max(-90.0, south - y), min(90.0, north + y)
    return (
        (west - x, south, east + x, north)
        if east > 180.0
        else (max(-180.0, west - x), south, min(180.0, east + x), north)
    )


async def _map(service: Service, collection: str | None, wanted: _Wanted) -> Response:
    service.choose({"png": PNG})
    await check_collection(service, collection)
    assert service.version.datum is not None
    systems = reference_systems(service, service.version.datum)
    system = _system(wanted.crs, systems, "crs")
    given = _system(wanted.bbox_crs, systems, "bbox-crs")
    if wanted.bbox is None:
        if wanted.bbox_crs is not None:
            raise Invalid("bbox-crs has no effect without bbox: omit it", [Problem("omit it", where="bbox-crs")])
        box = await _extent(service, collection)
    else:
        box = _parse_box(wanted.bbox, given)
    box = _convert(service, box, given, system)
    if min(box[2] - box[0], box[3] - box[1]) < MIN_SIDE:
        raise Invalid(
            f"the bbox is too small, or outside the area of {system.uri}: choose a larger one, or another crs",
            [Problem("has no area", where="bbox")],
        )
    view = View(_code(system), box, *_size(box, system, wanted))
    background = _background(wanted)
    content = content_of(service, collection)
    key = view_key(service.version, content, view, background)
    etag = f'"{key[:32]}"'
    headers = {"content-bbox": ",".join(map(repr, _corners(box, system))), "content-crs": f"<{system.uri}>"}
    if none_match(service.request.headers.get("if-none-match"), etag):
        return service.respond(b"", PNG, headers, etag)
    views, join = service.services.views, service.services.response_cache.join
    png = await join(("view", key), views.png, service.version, content, view, background)
    return service.respond(png, PNG, headers, etag)


_CONTENT: Mapping[str, object] = {PNG: {}}


@both(router, "/map", _CONTENT, summary="Draw a map of the site")
async def get_map(
    service: Service,
    bbox: BboxQuery = None,
    bbox_crs: BboxCrsQuery = None,
    crs: CrsQuery = None,
    width: WidthQuery = None,
    height: HeightQuery = None,
    bgcolor: BgcolorQuery = None,
    transparent: TransparentQuery = None,
    f: Representation = None,  # noqa: ARG001  parsed by choose()
) -> Response:
    """Draw images, grid, zones, objects, fence and network of the default level, as PNG.

    `Content-Bbox` is what the map shows, in the CRS of `Content-Crs`.
    """
    return await _map(service, None, _Wanted(bbox, bbox_crs, crs, width, height, bgcolor, transparent))


@both(router, "/collections/{collection}/map", _CONTENT, summary="Draw a map of a collection")
async def get_collection_map(
    service: Service,
    collection: CollectionPath,
    bbox: BboxQuery = None,
    bbox_crs: BboxCrsQuery = None,
    crs: CrsQuery = None,
    width: WidthQuery = None,
    height: HeightQuery = None,
    bgcolor: BgcolorQuery = None,
    transparent: TransparentQuery = None,
    f: Representation = None,  # noqa: ARG001  parsed by choose()
) -> Response:
    """Draw one collection on all its levels, as PNG. `Content-Bbox` is what the map shows, in `Content-Crs`."""
    return await _map(service, collection, _Wanted(bbox, bbox_crs, crs, width, height, bgcolor, transparent))


def _landing_links(service: Service) -> list[Link]:
    return [link(service.url("map"), REL, PNG, "Map of the site")] if service.version.datum is not None else []


def _collection_links(service: Service, collection: str) -> Sequence[Link]:
    return [link(service.url("collections", collection, "map"), REL, PNG, "Map")]


def _parameter(name: str, kind: str, description: str) -> dict[str, object]:
    return {"name": name, "in": "query", "required": False, "description": description, "schema": {"type": kind}}


_PARAMETERS = [
    _parameter("width", "integer", f"Width in pixels, at most {MAX_SIDE}."),
    _parameter("height", "integer", f"Height in pixels, at most {MAX_SIDE}."),
    _parameter("bgcolor", "string", "Background: `0xRRGGBB` or the name of a web colour."),
    _parameter("transparent", "boolean", "Whether the background is transparent. Default: only without `bgcolor`."),
]


async def _paths(service: Service) -> Mapping[str, object]:
    if service.version.datum is None:
        return {}
    shared = ("bbox", "bbox-crs", "crs")
    out: dict[str, object] = {"/map": operation("dataset.getMap", "Map of the site", (PNG,), shared, _PARAMETERS)}
    entries: list[Collection] = await all_collections(service)
    for entry in entries:
        name, title = f"{entry.id}.collection.getMap", f"{entry.title}: map"
        out[f"/collections/{entry.id}/map"] = operation(name, title, (PNG,), shared, _PARAMETERS)
    return out


extension = Extension(
    conformance=tuple(
        CONFORMANCE + name for name in ("core", "dataset-map", "collection-map", "crs", "tilesets", "png")
    ),
    landing_links=_landing_links,
    collection_links=_collection_links,
    paths=_paths,
)

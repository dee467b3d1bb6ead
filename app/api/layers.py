"""Canonical content: vector layers as GeoJSON, grids and images as PNG, or JSON metadata."""

from __future__ import annotations

import hashlib
import io
import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np
from fastapi import Path, Query, Request
from numpy.typing import NDArray
from PIL import Image
from pydantic import BaseModel, Field
from starlette.responses import Response

from app.api.http.auth import Viewer
from app.api.http.caching import none_match
from app.api.http.dependencies import Services, ServicesDep
from app.api.http.features import GEOJSON, Crs, PageCursor, PageLimit, missing_datum_error
from app.api.http.parameters import numbers, parse_box, parse_version_ref
from app.api.http.problems import NotAcceptable
from app.api.http.responses import api_router, json_bytes, json_response, next_page
from app.api.http.schemas import EnvironmentPath, VersionPath, component_schemas, problem_responses
from app.api.http.vector_layers import MAX_IDS, FeatureQuery, LayerFeaturesOut, parse_ids, write_layer
from app.convert.extents import bounds_in_both_frames
from app.errors import Ambiguous, Invalid, NotFound, Problem
from app.model.frame import MAX_METRES, Anchor
from app.model.geodesy import local_frame
from app.model.grid import OccupancyGrid
from app.model.imagery import GeoImage, display_pixels
from app.model.layers import MAP, VECTOR_LAYERS, Layer, PartKey
from app.model.voxels import DEPTH, Box3, VoxelMap
from app.model.voxels import cut as cut_voxels
from app.store.values import Bounds, Box, PartEntry, Version


class BoundsOut(BaseModel):
    """Bounding boxes of a part. Null in a frame to which it cannot be converted, and without content."""

    local: tuple[float, float, float, float] | None = Field(
        description="Minimum x, minimum y, maximum x, maximum y in metres of the local frame."
    )
    wgs84: tuple[float, float, float, float] | None = Field(
        description="West, south, east, north in degrees; west > east crosses the antimeridian. Null without a datum, "
        "unless the part is stored in degrees."
    )


class LayerOut(BaseModel):
    """One part of a version's content."""

    layer: str
    level: str
    name: str
    count: int
    hash: str
    bounds: BoundsOut
    information: str
    format: str | None = None
    sources: list[str]
    attribution: list[str]


LayerPath = Annotated[
    Literal["location", "objects", "topology", "occupancy", "voxels", "imagery", "zones"],
    Path(description="Name of the layer.", examples=["topology"]),
]

router = api_router("layers", "/environments/{env}/versions/{v}/layers")


def entry_dict(entry: PartEntry, bounds: Bounds) -> dict[str, Any]:
    """Convert a part entry to an item of the list of layers."""
    p = entry.provenance
    return {
        "layer": entry.key.layer,
        "level": entry.key.level,
        "name": entry.key.name,
        "count": entry.count,
        "hash": entry.hash,
        "bounds": {"local": bounds.get("local"), "wgs84": bounds.get("wgs84")},
        "information": p.information,
        "format": p.format,
        "sources": list(p.sources),
        "attribution": list(p.attribution),
    }


@router.get("", responses=problem_responses(list[LayerOut], 404), summary="List the layers of a version")
def list_layers(env: EnvironmentPath, v: VersionPath, services: ServicesDep, _: Viewer) -> Response:
    """List the parts of a version: layer, level, name, item count, bounds and provenance.

    With a datum, bounds are given in both frames. Those of a grid or an image are of its turned outline. Those of other
    parts contain the part, and may be larger than necessary if the datum has a heading.
    """
    version = services.store.versions.get(env, parse_version_ref(v))
    entries = [entry for entry in version.parts if entry.key.layer != "resources"]
    boxes = [bounds_in_both_frames(entry, version.datum, services.tiles.header) for entry in entries]
    return json_response([entry_dict(entry, bounds) for entry, bounds in zip(entries, boxes, strict=True)])


@router.get(
    "/{layer}",
    response_class=Response,
    responses={
        **problem_responses(None, 404, 406, 409, 422),
        200: {
            "description": "The content",
            "content": {
                GEOJSON: {"schema": {"$ref": "#/components/schemas/LayerFeaturesOut"}},
                "image/png": {},
                "application/json": {"schema": {"type": "object"}},
                "application/octet-stream": {},
            },
        },
        304: {"description": "Not modified: the client has this content"},
    },
    summary="Get a layer",
    openapi_extra=component_schemas(LayerFeaturesOut),
)
def get_layer(
    env: EnvironmentPath,
    v: VersionPath,
    layer: LayerPath,
    request: Request,
    services: ServicesDep,
    _: Viewer,
    level: Annotated[str | None, Query(max_length=256, description="Only parts of this level.")] = None,
    name: Annotated[
        str | None, Query(max_length=256, description="Name of the part, for example of a grid or a network.")
    ] = None,
    bbox: Annotated[
        str | None,
        Query(
            description="Only content in this box, given in `crs`: features whose bounding box intersects it, cells of "
            "a grid, or columns of a voxel map."
        ),
    ] = None,
    crs: Crs = None,
    q: Annotated[
        str | None,
        Query(max_length=200, description="Only features whose id, name or kind contains this text, in any case."),
    ] = None,
    ids: Annotated[
        str | None,
        Query(
            description=f"Only features with these ids, separated by commas: 1 to {MAX_IDS}.", examples=["dock,gate"]
        ),
    ] = None,
    zoom: Annotated[
        int | None,
        Query(
            ge=0,
            le=24,
            description="For drawing at this zoom level (a pixel is 156543.034 m / 2^zoom): shapes are simplified to a "
            "pixel, what is smaller is left out, and of several nodes in one pixel one is kept. Points that are no "
            "nodes are all kept, and edges keep their geometry.",
        ),
    ] = None,
    limit: PageLimit = None,
    cursor: PageCursor = None,
) -> Response:
    """Return the content of a layer. Vector layers are GeoJSON; in the local frame JSON-FG, with metres in `place`.

    Features are in the order of level, part and id. With `limit` they come in pages: `next` is the `cursor` of the
    next one, also in the header `Link`.

    `occupancy` and `imagery` are PNG, or JSON with `Accept: application/json`. `voxels` are JSON (`counts` in voxels
    of the finest resolution, whether or not leaves are merged), or an OctoMap `.bt` with `Accept:
    application/octet-stream`. Grids and voxel maps are in local metres; `crs` is that of `bbox` only.
    """
    version = services.store.versions.get(env, parse_version_ref(v))
    accept = request.headers.get("accept", "*/*")
    given = {"q": q, "ids": ids, "zoom": zoom, "limit": limit, "cursor": cursor}
    seed: list[Any] = [version.root, layer, level, name, bbox, crs, accept]
    seed += [given] if any(value is not None for value in given.values()) else []
    etag = f'"{hashlib.sha256(json_bytes(seed)).hexdigest()[:32]}"'
    headers = {
        "etag": etag,
        "vary": "accept",
        "fleetmap-version": str(version.ref),
        "fleetmap-root": version.root,
    }
    if none_match(request.headers.get("if-none-match"), etag):
        return Response(status_code=304, headers=headers)
    if layer in VECTOR_LAYERS:
        anchor: Anchor = crs or ("wgs84" if version.datum else "local")
        query = FeatureQuery(_box(bbox, anchor), q, parse_ids(ids), zoom, limit, cursor)
        response = _vector(request, services, version, layer, level, name, anchor, query)
    else:
        _refuse_vector_parameters(layer, given)
        if crs == "wgs84" and version.datum is None:
            raise missing_datum_error(env)
        key = select_part(version, layer, level, name)
        if layer == "voxels":
            response = _voxels(services, version, key, _local_box(version, bbox, crs), accept)
        elif layer == "occupancy":
            box = _local_box(version, bbox, crs)
            part = services.store.content.load(version, [key]).parts[key]
            assert isinstance(part, OccupancyGrid)
            response = _grid(key, part, box, accept)
        elif bbox is not None:
            raise Invalid(
                f"bbox is not supported for {layer}: omit it", [Problem("not supported for this layer", where="bbox")]
            )
        else:
            part = services.store.content.load(version, [key]).parts[key]
            assert isinstance(part, GeoImage)
            response = _picture(key, part, accept)
    for header, value in headers.items():
        response.headers[header] = value
    return response


# --- vector layers ---


def _vector(
    request: Request,
    services: Services,
    version: Version,
    layer: Layer,
    level: str | None,
    name: str | None,
    crs: Anchor,
    query: FeatureQuery,
) -> Response:
    _choose(request.headers.get("accept", "*/*"), GEOJSON, "application/json")
    keys = _fit_to_size(version, layer, level, name)
    if not keys and (level is not None or name is not None):
        raise _no_such_part_error(version, layer, level, name)
    body, cursor = write_layer(services.store.content, version, keys, crs, query, layer)
    return Response(body, headers=next_page(request, cursor), media_type=GEOJSON)


def _refuse_vector_parameters(layer: Layer, given: Mapping[str, object]) -> None:
    """Raise Invalid for parameters of vector layers, requested for another one."""
    names = [name for name, value in given.items() if value is not None]
    if names:
        vector = ", ".join(sorted(VECTOR_LAYERS))
        raise Invalid(
            f"{', '.join(names)}: not supported for {layer}, which has no features; omit it, or read {vector}",
            [Problem("not supported for this layer", where=name) for name in names],
        )


# --- grids, voxels, images ---


def _grid(key: PartKey, grid: OccupancyGrid, box: Box | None, accept: str) -> Response:
    kind = _choose(accept, "image/png", "application/json")
    if box is not None:
        grid = crop_grid(grid, box)
    if kind == "image/png":
        return Response(png(np.flipud(grid.cells)), media_type=kind)
    return json_response(
        {
            "name": key.name,
            "level": key.level,
            "width": grid.width,
            "height": grid.height,
            "resolution": grid.resolution,
            "origin": list(grid.origin),
            "counts": grid.counts(),
        }
    )


def crop_grid(grid: OccupancyGrid, box: Box) -> OccupancyGrid:
    """Crop a grid to the cells that intersect a box in the local frame. Raises NotFound if there are none."""
    x, y, yaw = grid.origin
    c, s = math.cos(yaw), math.sin(yaw)
    west, south, east, north = box
    corners = [(px - x, py - y) for px in (west, east) for py in (south, north)]
    u = [(c * px + s * py) / grid.resolution for px, py in corners]
    v = [(c * py - s * px) / grid.resolution for px, py in corners]
    left, right = max(0, math.floor(min(u))), min(grid.width, math.ceil(max(u)))
    low, high = max(0, math.floor(min(v))), min(grid.height, math.ceil(max(v)))
    if left >= right or low >= high:
        raise NotFound("the bbox does not intersect the grid")
    du, dv = left * grid.resolution, low * grid.resolution
    origin = (x + c * du - s * dv, y + s * du + c * dv, yaw)
    return replace(grid, cells=grid.cells[low:high, left:right].copy(), origin=origin)


def png(pixels: NDArray[Any]) -> bytes:
    """Encode pixels [height, width] or [height, width, 1…4] as PNG, fast rather than small."""
    if pixels.ndim == 3 and pixels.shape[2] == 1:
        pixels = pixels[:, :, 0]
    modes = {2: "LA", 3: "RGB", 4: "RGBA"}
    mode = modes[pixels.shape[2]] if pixels.ndim == 3 else "L"
    height, width = pixels.shape[:2]
    image = Image.frombytes(mode, (width, height), np.ascontiguousarray(pixels).tobytes())
    out = io.BytesIO()
    image.save(out, "PNG", compress_level=1)
    return out.getvalue()


def _voxels(services: Services, version: Version, key: PartKey, box: Box | None, accept: str) -> Response:
    """Return metadata of a voxel map, or its ``.bt``; a box selects columns of full height."""
    kind = _choose(accept, "application/json", "application/octet-stream")
    column: Box3 | None = None
    if box is not None:
        x0, y0, x1, y1 = box
        column = (x0, y0, -MAX_METRES, x1, y1, MAX_METRES)
    if kind == "application/octet-stream":
        options = {"kind": "bt", "name": key.name, "level": key.level}
        if column is not None:
            options["bbox"] = ",".join(map(repr, column))
        cached_map = services.maps.get_blocking(version, "octomap", options)
        return Response(cached_map.single_file().read(), media_type=kind)
    part = services.store.content.load(version, [key]).parts[key]
    assert isinstance(part, VoxelMap)
    if column is not None:
        part = cut_voxels(part, column)
        if not len(part):
            raise NotFound("the bbox does not intersect the voxel map")
    bounds = part.bounds()
    return json_response(
        {
            "name": key.name,
            "level": key.level,
            "resolution": part.resolution,
            "depth": DEPTH,
            "counts": part.voxel_counts(),
            "leaves": part.leaf_counts(),
            "bounds": list(bounds) if bounds else None,
        }
    )


def _picture(key: PartKey, picture: GeoImage, accept: str) -> Response:
    kind = _choose(accept, "image/png", "application/json")
    height, width, bands = picture.pixels.shape
    if kind == "application/json":
        return json_response(
            {
                "name": key.name,
                "level": key.level,
                "width": width,
                "height": height,
                "bands": bands,
                "type": picture.pixels.dtype.name,
                "colours": list(picture.colours),
                "nodata": picture.properties.get("nodata"),
                "transform": list(picture.transform),
                "crs": picture.crs,
                "attribution": list(picture.attribution),
            }
        )
    return Response(png(display_pixels(picture)), media_type=kind)


# --- selection of parts ---


def _fit_to_size(version: Version, layer: Layer, level: str | None, name: str | None) -> list[PartKey]:
    keys = (entry.key for entry in version.parts)
    return sorted(k for k in keys if k.layer == layer and level in (None, k.level) and name in (None, k.name))


def select_part(version: Version, layer: Layer, level: str | None, name: str | None) -> PartKey:
    """Select a part: the named one, else ``map``, else the only one. Raises Ambiguous with the choices."""
    keys = _fit_to_size(version, layer, level, name)
    if not keys:
        raise _no_such_part_error(version, layer, level, name)
    usual = [k for k in keys if k.name == MAP] if name is None else keys
    if len(keys) == 1 or len(usual) == 1:
        return keys[0] if len(keys) == 1 else usual[0]
    choices = usual or keys
    names = ", ".join(sorted({k.name for k in keys}))
    levels = ", ".join(sorted({k.level for k in choices}))
    raise Ambiguous(
        f"several parts of {layer} match: give name (one of {names})"
        + (f" and level (one of {levels})" if len({k.level for k in choices}) > 1 else ""),
        [Problem(f"level {k.level}", where=k.name) for k in keys],
    )


def _no_such_part_error(version: Version, layer: Layer, level: str | None, name: str | None) -> NotFound:
    existing_names = [f"{e.key.name} (level {e.key.level})" for e in version.parts if e.key.layer == layer]
    selection = " ".join(f"{k}={t!r}" for k, t in (("level", level), ("name", name)) if t is not None)
    description = f"{layer} {selection}".strip()
    return NotFound(f"version {version.ref} has no {description}; available: {', '.join(existing_names) or 'none'}")


def _box(text: str | None, crs: Anchor) -> Box | None:
    if text is None:
        return None
    if crs == "wgs84":
        return parse_box(text)
    x0, y0, x1, y1 = numbers(text, "bbox", "X0,Y0,X1,Y1")
    if not (x0 <= x1 and y0 <= y1 and max(map(abs, (x0, y0, x1, y1))) <= MAX_METRES):
        raise Invalid(
            "bbox must be X0,Y0,X1,Y1 in metres, with X0 ≤ X1 and Y0 ≤ Y1",
            [Problem("must be X0,Y0,X1,Y1", where="bbox")],
        )
    return x0, y0, x1, y1


def _local_box(version: Version, text: str | None, crs: Anchor | None) -> Box | None:
    """Convert a box to the local frame; a WGS 84 box becomes the bounding box of its edges.

    Without a CRS, the box is in degrees if there is a datum.
    """
    if text is None or crs != "wgs84":
        anchor: Anchor = "wgs84" if crs is None and version.datum else "local"
        if text is None or anchor == "local":
            return _box(text, "local")
    west, south, east, north = parse_box(text)
    assert version.datum is not None
    east += 360.0 if east < west else 0.0
    edge = np.linspace(0.0, 1.0, 9)
    across, up = west + edge * (east - west), south + edge * (north - south)
    ring = [(a, b) for a in across for b in (south, north)] + [(a, b) for a in (west, east) for b in up]
    places = local_frame(version.datum).to_local(np.array(ring))
    (x0, y0), (x1, y1) = places.min(axis=0), places.max(axis=0)
    return float(x0), float(y0), float(x1), float(y1)


def _choose(accept: str, *offered: str) -> str:
    """Select the media type that the client prefers (RFC 9110, 12.5.1). Raises NotAcceptable if none is offered."""
    best, choice = 0.0, None
    for kind in offered:
        quality = _quality(accept, kind)
        if quality > best:
            best, choice = quality, kind
    if choice is None:
        raise NotAcceptable(f"cannot return {accept[:200]}: accept {' or '.join(offered)}")
    return choice


def _quality(accept: str, kind: str) -> float:
    family = kind.partition("/")[0] + "/*"
    qualities: Mapping[str, float] = dict(_ranges(accept))
    for pattern in (kind, family, "*/*"):
        if pattern in qualities:
            return qualities[pattern]
    return 0.0


def _ranges(accept: str) -> list[tuple[str, float]]:
    out = []
    for item in accept.split(",")[:50]:
        kind, *rest = (part.strip() for part in item.split(";"))
        quality = 1.0
        for parameter in rest:
            if parameter.lower().startswith("q="):
                try:
                    quality = min(1.0, max(0.0, float(parameter[2:])))
                except ValueError:
                    quality = 0.0
        out.append((kind.lower() or "*/*", quality))
    return out

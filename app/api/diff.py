"""Differences between two versions: as JSON, as features to draw, or as an image."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from typing import Annotated, Literal

import numpy as np
import shapely
from fastapi import Query, Request
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from starlette.responses import Response

from app.api.diff_features import DiffFeaturesOut, FeatureSelection, changed_features
from app.api.http.auth import Viewer
from app.api.http.dependencies import Services, ServicesDep
from app.api.http.features import GEOJSON, Crs, PageCursor, PageLimit
from app.api.http.parameters import parse_version_ref
from app.api.http.responses import api_router, json_response
from app.api.http.schemas import VERSION_OR_PENDING, DiffOut, EnvironmentPath, component_schemas, problem_responses
from app.errors import Invalid, Problem
from app.model.features import Features, features
from app.model.frame import Anchor
from app.model.geodesy import LocalFrame, local_frame
from app.model.grid import OccupancyGrid
from app.model.layers import PartKey
from app.store.values import Version

router = api_router("versions", "/environments/{env}")

Ref = Annotated[
    str | None,
    Query(
        pattern=VERSION_OR_PENDING,
        description="The newer version: number, channel, or `latest`; or `dry:…` of a dry run, or `draft:…`.",
    ),
]

SIDE = 1024
MARGIN = 24
ADDED, DELETED, CHANGED, SAME = (0, 140, 60), (200, 30, 30), (230, 140, 0), (205, 205, 205)
FREED, BLOCKED, OTHER = (120, 200, 140), (225, 120, 120), (240, 205, 120)


FromRef = Annotated[
    str | None,
    Query(
        alias="from",
        pattern=VERSION_OR_PENDING,
        description="The older version: number, channel, or `latest`; or `dry:…` of a dry run, or `draft:…`. Default: "
        "the parent of `to`.",
    ),
]


@router.get(
    "/diff",
    responses={
        **problem_responses(DiffOut, 404),
        200: {
            "model": DiffOut,
            "description": "The differences",
            "content": {GEOJSON: {"schema": {"$ref": "#/components/schemas/DiffFeaturesOut"}}, "image/png": {}},
        },
    },
    summary="Compare two versions",
    openapi_extra=component_schemas(DiffFeaturesOut),
)
def diff(
    env: EnvironmentPath,
    request: Request,
    services: ServicesDep,
    _: Viewer,
    from_: FromRef = None,
    to: Ref = "latest",
    render: Annotated[
        Literal["json", "png"],
        Query(description="`png`: an image with added features in green, deleted in red, changed in orange."),
    ] = "json",
    format: Annotated[
        Literal["json", "geojson"], Query(description="`geojson`: the changed features with both states, to draw them.")
    ] = "json",
    crs: Crs = None,
    layer: Annotated[
        Literal["location", "objects", "topology", "zones"] | None,
        Query(description="Only features of this layer. Needs `format=geojson`, as do `crs`, `limit` and `cursor`."),
    ] = None,
    limit: PageLimit = None,
    cursor: PageCursor = None,
) -> Response:
    """Return the differences by layer.

    Features are listed by id as added, changed (with the fields) or deleted. For grids the numbers of freed and
    blocked cells are given; `/diff/tiles/{name}` draws them.

    With `format=geojson` each changed feature has both states. Features that nobody edited are not listed, even if a
    new datum moves them. Pages are as those of layers.
    """
    old, new = compared_versions(services, env, from_, to)
    if format == "geojson":
        if render == "png":
            problem = Problem("excludes format=geojson", where="render")
            raise Invalid("render=png and format=geojson exclude each other: omit one", [problem])
        return changed_features(request, services, old, new, FeatureSelection(crs, layer, limit, cursor))
    _require_geojson({"crs": crs, "layer": layer, "limit": limit, "cursor": cursor})
    if render == "png":
        return Response(_picture(services, old, new), media_type="image/png")
    layers = services.store.content.diff(old, new)
    return json_response({"from": old.ref, "to": new.ref, "layers": layers})


def compared_versions(services: Services, env: str, from_: str | None, to: str | None) -> tuple[Version, Version]:
    """Return the older version, by default the parent, and the newer one. Raises NotFound, Invalid."""
    new = services.store.versions.get(env, parse_version_ref(to or "latest"))
    if from_ is not None:
        return services.store.versions.get(env, parse_version_ref(from_)), new
    if new.parent is None:
        raise Invalid("version 0 has no parent to compare with: set from to a version")
    return services.store.versions.get(env, new.parent), new


def _require_geojson(given: Mapping[str, object]) -> None:
    """Raise Invalid if a parameter of ``format=geojson`` is set without it."""
    names = [name for name, value in given.items() if value is not None]
    if names:
        raise Invalid(
            f"{', '.join(names)}: only for format=geojson; set it, or omit them",
            [Problem("needs format=geojson", where=name) for name in names],
        )


def _picture(services: Services, old: Version, new: Version) -> bytes:
    """Draw the differences in at most 1024 × 1024 pixels, unchanged features in grey, +y (or north) up."""
    delta = services.store.content.delta_parts(old, new)
    groups: list[tuple[tuple[int, int, int], Features]] = []
    for changed in delta.features:
        deleted, was = (
            _select_features(services, old, changed.key, changed.deleted),
            _select_features(services, old, changed.key, changed.put.ids),
        )
        old_ids = set(was.ids)
        moved = changed.put.select([k for k, i in enumerate(changed.put.ids) if i in old_ids])
        fresh = changed.put.select([k for k, i in enumerate(changed.put.ids) if i not in old_ids])
        groups += [(DELETED, deleted), (CHANGED, was), (CHANGED, moved), (ADDED, fresh)]
    grids = [(k, *_grids(services, old, new, k)) for k in sorted({g.key for g in delta.grids})]
    datum = new.datum or old.datum
    frame = local_frame(datum) if datum else None
    # Without a datum, metres and degrees cannot be drawn together: metres take precedence.
    degrees = frame is None and not grids and all(features.needs_datum for _, features in groups if len(features))
    drawn = [(colour, _shapes(features, frame, degrees)) for colour, features in groups]
    boxes = [shapely.total_bounds(shapes) for _, shapes in drawn if len(shapes)]
    boxes += [_box_of_changes(a, b) for _, a, b in grids]
    boxes = [b for b in boxes if np.isfinite(b).all()]
    if not boxes:
        image = Image.new("RGB", (256, 64), "white")
        ImageDraw.Draw(image).text((12, 24), "no differences to draw", fill=(60, 60, 60))
        return _png(image)
    view = _Viewport(np.array(boxes), degrees)
    image = Image.new("RGB", (view.width, view.height), "white")
    for _, a, b in grids:
        view.paint(image, a, b)
    pen = ImageDraw.Draw(image)
    crs: Anchor = "wgs84" if degrees else "local"
    for changed in delta.features:
        if new.part(changed.key) is not None:
            around = services.store.content.features(new, changed.key, bbox=view.box(), crs=crs)
            view.draw(pen, SAME, _shapes(around, frame, degrees))
    for colour, shapes in drawn:
        view.draw(pen, colour, shapes)
    return _png(image)


def _select_features(services: Services, version: Version, key: PartKey, ids: tuple[str, ...]) -> Features:
    """Load the given features, skipping those that the version lacks."""
    if version.part(key) is None:
        return features((), "local")
    return services.store.content.features(version, key, ids=ids)


def _png(image: Image.Image) -> bytes:
    out = io.BytesIO()
    image.save(out, "PNG", compress_level=6)
    return out.getvalue()


def _shapes(features: Features, frame: LocalFrame | None, degrees: bool) -> NDArray[np.object_]:
    """Transform geometries to the coordinates of the image; skip those that cannot be converted."""
    if frame is not None:
        return features.in_local(frame)
    shapes: NDArray[np.object_] = features.geometry[features.local != degrees]
    return shapes


def _grids(
    services: Services, old: Version, new: Version, key: PartKey
) -> tuple[OccupancyGrid | None, OccupancyGrid | None]:
    out: list[OccupancyGrid | None] = []
    for version in (old, new):
        part = services.store.content.load(version, [key]).parts[key] if version.part(key) else None
        out.append(part if isinstance(part, OccupancyGrid) else None)
    return out[0], out[1]


def _is_same_frame(a: OccupancyGrid | None, b: OccupancyGrid | None) -> bool:
    return (
        a is not None
        and b is not None
        and a.cells.shape == b.cells.shape
        and a.origin == b.origin
        and a.resolution == b.resolution
    )


def _box_of_changes(a: OccupancyGrid | None, b: OccupancyGrid | None) -> NDArray[np.float64]:
    """Bound the changed cells of a grid, or both grids if their frames differ: [x0, y0, x1, y1]."""
    if a is not None and b is not None and _is_same_frame(a, b):
        rows, columns = np.nonzero(a.cells != b.cells)
        if not len(rows):
            return np.full(4, np.nan)
        corners = [(c, r) for c in (columns.min(), columns.max() + 1) for r in (rows.min(), rows.max() + 1)]
        points = _cells_to_local(b, np.array(corners, float))
    else:
        points = np.concatenate([g.corners() for g in (a, b) if g is not None])
    return np.concatenate([points.min(axis=0), points.max(axis=0)])


def _cells_to_local(grid: OccupancyGrid, cells: NDArray[np.float64]) -> NDArray[np.float64]:
    x, y, yaw = grid.origin
    c, s = math.cos(yaw), math.sin(yaw)
    u, v = cells[:, 0] * grid.resolution, cells[:, 1] * grid.resolution
    return np.stack([x + c * u - s * v, y + s * u + c * v], axis=1)


class _Viewport:
    """Viewport: local metres (or degrees) to pixels."""

    def __init__(self, boxes: NDArray[np.float64], degrees: bool) -> None:
        x0, y0 = boxes[:, 0].min(), boxes[:, 1].min()
        x1, y1 = boxes[:, 2].max(), boxes[:, 3].max()
        span = max(x1 - x0, y1 - y0)
        if span <= 0:
            span = 1e-4 if degrees else 10.0  # a single point: show ten metres around it
        pad = span * 0.08
        self._x0, self._y1 = x0 - pad, y1 + pad
        self._scale = (SIDE - 2 * MARGIN) / (span + 2 * pad)
        self.width = max(64, math.ceil((x1 - x0 + 2 * pad) * self._scale) + 2 * MARGIN)
        self.height = max(64, math.ceil((y1 - y0 + 2 * pad) * self._scale) + 2 * MARGIN)

    def box(self) -> tuple[float, float, float, float]:
        """Return the visible area: x0, y0, x1, y1."""
        west, south = self._x0 - MARGIN / self._scale, self._y1 - (self.height - MARGIN) / self._scale
        return west, south, west + self.width / self._scale, south + self.height / self._scale

    def draw(self, pen: ImageDraw.ImageDraw, colour: tuple[int, int, int], shapes: NDArray[np.object_]) -> None:
        """Draw points as dots, lines and outlines as lines."""
        for shape in shapely.get_parts(shapes) if len(shapes) else ():
            lines = [shape.exterior, *shape.interiors] if shape.geom_type == "Polygon" else [shape]
            for line in lines:
                if line.is_empty or line.geom_type == "GeometryCollection":
                    continue
                points = [tuple(p) for p in self._pixels(shapely.get_coordinates(line)).tolist()]
                if len(points) == 1:
                    x, y = points[0]
                    pen.ellipse((x - 4, y - 4, x + 4, y + 4), fill=colour)
                else:
                    pen.line(points, fill=colour, width=2)

    def paint(self, image: Image.Image, a: OccupancyGrid | None, b: OccupancyGrid | None) -> None:
        """Paint a grid's new state in light grey, changed cells in colour."""
        shown = b if b is not None else a
        assert shown is not None
        rows, columns = np.mgrid[0 : self.height, 0 : self.width]
        x = self._x0 + (columns + 0.5 - MARGIN) / self._scale
        y = self._y1 - (rows + 0.5 - MARGIN) / self._scale
        ox, oy, yaw = shown.origin
        c, s = math.cos(yaw), math.sin(yaw)
        u = np.floor((c * (x - ox) + s * (y - oy)) / shown.resolution).astype(np.int64)
        v = np.floor((c * (y - oy) - s * (x - ox)) / shown.resolution).astype(np.int64)
        inside = (u >= 0) & (u < shown.width) & (v >= 0) & (v < shown.height)
        pixels = np.array(image)
        values = shown.cells[v[inside], u[inside]].astype(np.int64)
        grey = np.where(values > 100, 225, 250 - values)
        colours = np.repeat(grey[:, None], 3, axis=1).astype(np.uint8)
        if a is not None and b is not None and _is_same_frame(a, b):
            was = a.cells[v[inside], u[inside]].astype(np.int64)
            differ = was != values
            for mask, colour in (
                (differ, OTHER),
                (differ & (values == 0), FREED),
                (differ & (values == 100), BLOCKED),
            ):
                colours[mask] = colour
        else:
            colours = (colours * 0.5 + np.array(ADDED if a is None else DELETED if b is None else OTHER) * 0.5).astype(
                np.uint8
            )
        pixels[inside] = colours
        image.paste(Image.fromarray(pixels))

    def _pixels(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        x = MARGIN + (points[:, 0] - self._x0) * self._scale
        y = MARGIN + (self._y1 - points[:, 1]) * self._scale
        return np.stack([x, y], axis=1)

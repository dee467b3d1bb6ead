"""Imagery -> objects: polygons from an aerial image or a floor plan; paths with their centrelines."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.derive import DerivationNotes, derives
from app.derive._picture_methods import choose_method, plan_to_grid, segment_picture
from app.derive._pictures import GroundImage, ground, picture_label, select_pictures
from app.derive._segments import Segmentation, Segments
from app.errors import CannotConvert
from app.model.features import features
from app.model.grid import FREE, OCCUPIED, OccupancyGrid
from app.model.layers import Layers, Part, PartKey
from app.parameters import parameter

NAME = "imagery"
"""Family and part name of these objects."""

Row = tuple[str, Any, dict[str, Any]]


@dataclass(frozen=True, slots=True)
class Parameters(Segmentation):
    """Parameters of imagery_to_objects."""

    outline_tolerance: float | None = parameter(
        None,
        "maximum distance of outlines from the pixel edges; default: one pixel",
        minimum=0.0,
        maximum=100.0,
        unit="m",
    )


@derives(gives="objects", needs={"imagery"}, parameters=Parameters, cost=30.0, version=3)
def imagery_to_objects(layers: Layers, parameters: Parameters, notes: DerivationNotes) -> Layers:
    """Objects in an image: fields, trees, vegetation, paths, roads, buildings; for a floor plan walls and floors.

    Polygons with a ``confidence`` of 0 to 1, classified by shape and shade; a path or road also has its centreline, of
    kind ``path`` with a ``width``, from which objects_to_topology derives a network. They have the image's anchor.
    Raises CannotConvert if nothing is recognised.
    """
    parts: dict[PartKey, Part] = {}
    for key, picture in select_pictures(layers, parameters.picture).items():
        name = picture_label(key)
        method = choose_method(picture, parameters)
        if method == "plan":
            grid, confidence = plan_to_grid(picture, layers.frame, parameters, notes, name)
            on, rows = None, _plan(grid, confidence, parameters)
        else:
            on = ground(picture, layers.frame, parameters.resolution, notes, name)
            rows = _regions(segment_picture(on, picture, parameters, method, notes, name), on, parameters)
        if not rows:
            raise CannotConvert(f"{name} shows no recognisable object: set other clusters, or another segmentation")
        if on is not None and on.on_earth and on.frame is not None:
            geometry = np.array([g for _, g, _ in rows], object)
            back = shapely.set_precision(on.frame.geometries_to_wgs84(geometry), 1e-12, mode="pointwise")
            rows = [(i, g, properties) for (i, _, properties), g in zip(rows, back, strict=True)]
        notes.warn(
            "objects were detected automatically in an image: review them before robots use them", where=key.name
        )
        objects = features(rows, "wgs84" if on is not None and on.on_earth else "local")
        parts[PartKey("objects", key.level, NAME)] = objects
    return Layers(parts, layers.datum, layers.levels)


def _regions(segments: Segments, on: GroundImage, parameters: Parameters) -> list[Row]:
    """Convert each region to a polygon, then add the centrelines of paths and roads, in the local frame."""
    tolerance = on.resolution if parameters.outline_tolerance is None else parameters.outline_tolerance
    shapes = polygons(segments.label, on.transform, tolerance)
    rows: list[Row] = []
    for k, region in enumerate(segments.regions, 1):
        if k in shapes:
            properties = {"kind": region.kind, "confidence": region.confidence, **region.attributes}
            rows.append((f"{region.kind}/{k}", shapes[k], properties))
    rows += _middles(segments, on)
    return rows


def polygons(label: NDArray[np.int32], transform: Any, tolerance: float) -> dict[int, Any]:
    """Return the area of each label, simplified, in metres."""
    from rasterio.features import shapes
    from rasterio.transform import Affine

    pieces: dict[int, list[Any]] = {}
    for geometry, value in shapes(label, mask=label > 0, connectivity=4, transform=Affine(*transform)):
        rings = geometry["coordinates"]
        pieces.setdefault(int(value), []).append(shapely.Polygon(rings[0], rings[1:]))
    out = {}
    for value, areas in pieces.items():
        area = areas[0] if len(areas) == 1 else shapely.MultiPolygon(areas)
        if tolerance > 0:
            area = shapely.simplify(area, tolerance, preserve_topology=True)
        area = shapely.set_precision(shapely.make_valid(area), 1e-9, mode="pointwise")
        if area.area > 0:
            out[value] = area
    return out


def _middles(segments: Segments, on: GroundImage) -> list[Row]:
    """Return the centrelines of paths and roads, joined at their crossings."""
    from app.derive import _kernels_space, _skeleton

    path_labels = [k for k, region in enumerate(segments.regions, 1) if region.kind in ("path", "road")]
    if not path_labels:
        return []
    mask = np.pad(np.isin(segments.label, path_labels), 1).astype(np.uint8)
    free_space = _skeleton.space(mask, -1, -1, 0.0)
    widths = [float(segments.regions[k - 1].attributes["width"]) for k in path_labels]
    usual = float(np.median(widths)) / on.resolution
    graph, _ = _skeleton.skeleton(free_space, merge=max(2.0, usual / 2), spur=usual, tolerance=1.0, island=0.0)
    if not len(graph.edges):
        return []
    wide = np.empty(len(graph.edges))
    _kernels_space.widths(free_space.gap, graph.nodes, graph.edges, wide)
    at = np.empty((len(graph.nodes), 2))
    at[:, 0] = on.left + (graph.nodes[:, 1] - 0.5) * on.resolution
    at[:, 1] = on.top - (graph.nodes[:, 0] - 0.5) * on.resolution
    at = np.round(at, 9) + 0.0
    lines = shapely.get_parts(shapely.line_merge(shapely.multilinestrings(shapely.linestrings(at[graph.edges]))))
    lines = lines[np.lexsort(shapely.bounds(lines).T[::-1])]
    narrow = {(float(x), float(y)): np.inf for x, y in at}
    for (a, b), w in zip(graph.edges.tolist(), wide.tolist(), strict=True):
        for n in (a, b):
            place = (float(at[n, 0]), float(at[n, 1]))
            narrow[place] = min(narrow[place], w)
    rows: list[Row] = []
    for k, line in enumerate(lines):
        width = min(narrow[(float(x), float(y))] for x, y in shapely.get_coordinates(line))
        properties = {"kind": "path", "width": round(width * on.resolution, 3), "middle_line": True}
        rows.append((f"middle/{k}", line, properties))
    return rows


def _plan(grid: OccupancyGrid, confidence: NDArray[np.float32], parameters: Parameters) -> list[Row]:
    """Return the walls, with the mean confidence of their cells, and the floors of a floor plan's grid."""
    x, y, _ = grid.origin
    r = grid.resolution
    tolerance = r / 2 if parameters.outline_tolerance is None else parameters.outline_tolerance
    rows: list[Row] = []
    for kind, value in (("wall", OCCUPIED), ("floor", FREE)):
        import cv2

        connectivity = 4
        _, label = cv2.connectedComponents((grid.cells == value).astype(np.uint8), connectivity=connectivity)
        cells, sure = np.bincount(label.ravel()), np.bincount(label.ravel(), weights=confidence.ravel())
        for k, area in sorted(polygons(label.astype(np.int32), (r, 0.0, x, 0.0, r, y), tolerance).items()):
            properties = (
                {"kind": kind, "confidence": round(float(sure[k] / cells[k]), 2)} if kind == "wall" else {"kind": kind}
            )
            rows.append((f"{kind}/{k}", area, properties))
    return rows

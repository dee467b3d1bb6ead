"""Area of an environment on earth: a robot with a GNSS fix inside it counts as being in the environment.

The area is the first of these that exists:

1. ``fence``: the polygons of the location layer (those of kind ``fence`` if there are any), on all levels, with holes;
2. ``floor``: mapped floor within ``NEIGHBOURHOOD_METRES`` of the datum, buffered by ``MARGIN_METRES``: the rectangle
   around the free cells of each occupancy grid that is no filter mask, the convex hull of each network, and all
   objects of kind ``floor``;
3. ``datum``: the circle of ``DATUM_METRES`` around the datum.

A datum at exactly 0, 0 counts as not set: it gives no area. Items in the local frame of such a datum, or without a
datum, have no position on earth.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final, Literal

import numpy as np
import shapely
from numpy.typing import NDArray
from sqlalchemy import Connection, delete, insert

from app.model import masks
from app.model.features import Features
from app.model.frame import Datum
from app.model.geodesy import LocalFrame, local_frame, surface
from app.model.grid import FREE
from app.model.layers import Layer, PartKey
from app.store import parts, tables, tree
from app.store.changes import KEEP, Keep
from app.store.encode import to_wkb
from app.store.parts.rasters import tile_cells, tile_leaf, tile_shape
from app.store.parts.roots import TILE_BATCH, PartRoot, read_root
from app.store.tree import ChunkStage
from app.store.values import NO_AREA, Area, Box, PartEntry

NEIGHBOURHOOD_METRES: Final = 2000.0
"""Radius around the datum within which floor counts, in metres."""

DATUM_METRES: Final = 200.0
"""Radius of the area around a datum without fence and floor, in metres."""

MARGIN_METRES: Final = 10.0
"""Buffer around floor, in metres: covers the error of a GNSS fix, and lines without width."""

AREA_LAYERS: Final[frozenset[Layer]] = frozenset({"location", "occupancy", "topology", "objects"})
"""Layers that an area depends on."""

MAX_FEATURES: Final = 2000
MAX_CELLS: Final = 2**22
"""Maximum features and cells of one part for an area computed with the commit; else the next query computes it."""

Array = NDArray[np.float64]

FENCE: Final = "fence"
FLOOR: Final = "floor"
CIRCLE_SEGMENTS: Final = 16
"""Number of straight segments of a quarter circle."""


def area_after(
    draft: ChunkStage,
    before: Sequence[PartEntry],
    after: Sequence[PartEntry],
    old_datum: Datum | None,
    datum: Datum | None,
) -> Area | Literal[Keep.KEEP] | None:
    """Compute the area after a change.

    Returns KEEP if it equals the previous one, None if computing it takes too long for a commit.
    """
    changed = {key.layer for key, _ in _hashes(before) ^ _hashes(after)}
    if old_datum == datum and not changed & AREA_LAYERS:
        return KEEP
    fence = _fence(draft, after, datum)
    if fence is not None:
        return KEEP if old_datum == datum and "location" not in changed else area_in_degrees(FENCE, fence)
    if any(e.count > (MAX_CELLS if e.key.layer == "occupancy" else MAX_FEATURES) for e in _floors(after, datum)):
        return None
    return _estimate_extent(draft, after, datum)


def compute_area(draft: ChunkStage, entries: Sequence[PartEntry], datum: Datum | None) -> Area:
    """Compute the area of a version's content, without a limit of time."""
    fence = _fence(draft, entries, datum)
    return _estimate_extent(draft, entries, datum) if fence is None else area_in_degrees(FENCE, fence)


def _hashes(entries: Iterable[PartEntry]) -> set[tuple[PartKey, str]]:
    return {(e.key, e.hash) for e in entries}


def _frame(datum: Datum | None) -> LocalFrame | None:
    return None if datum is None or datum.latitude == 0.0 == datum.longitude else local_frame(datum)


def _load(draft: ChunkStage, entries: Iterable[PartEntry]) -> list[Features]:
    loaded = parts.load(draft, {e.key: bytes.fromhex(e.hash) for e in entries}, lambda _: {})
    return [part for part in loaded.values() if isinstance(part, Features)]


# --- fence ---


def _fence(draft: ChunkStage, entries: Sequence[PartEntry], datum: Datum | None) -> Any:
    """Return the fence as a valid (Multi)Polygon in degrees, None if it has no area.

    Longitudes continue beyond ±180 across the antimeridian.
    """
    sites = _load(draft, (e for e in entries if e.key.layer == "location" and e.count))
    return fence_polygon(sites, _frame(datum))


def fence_polygon(sites: Sequence[Features], frame: LocalFrame | None) -> Any:
    """Join the polygons of location parts, see ``_fence``; local ones only with a frame."""
    polygons: list[Any] = []
    fences: list[Any] = []
    for site in sites:
        flat = np.isin(shapely.get_type_id(site.geometry), (3, 6)) & ~shapely.is_empty(site.geometry)
        chosen = site.select(flat & ~site.local if frame is None else flat)
        for place, properties in zip(chosen.in_wgs84(frame), chosen.properties, strict=True):
            pieces = [_unwrap(p) for p in shapely.get_parts(shapely.force_2d(place))]
            (fences if properties.get("kind") == FENCE else polygons).extend(p for p in pieces if p is not None)
    for group in (fences, polygons):
        joined = _polygonal(shapely.union_all(group))
        if joined is not None:
            return joined
    return None


def _unwrap(polygon: Any) -> Any:
    """Make a polygon in degrees valid.

    A polygon wider than half the globe crosses the antimeridian; its longitudes then continue beyond ±180.
    """
    if not np.isfinite(shapely.get_coordinates(polygon)).all():
        return None
    west, _, east, _ = polygon.bounds
    if east - west > 180.0:
        polygon = shapely.transform(polygon, lambda xy: np.column_stack([xy[:, 0] % 360.0, xy[:, 1]]))
    return _polygonal(shapely.make_valid(polygon))


def _polygonal(shape: Any) -> Any:
    """Join the polygons of a shape; None if they have no area."""
    pieces = [p for p in shapely.get_parts(shapely.get_parts(shape)) if p.geom_type == "Polygon" and p.area > 0]
    return shapely.union_all(pieces) if pieces else None


# --- floor and datum ---


def _floors(entries: Iterable[PartEntry], datum: Datum | None) -> list[PartEntry]:
    """Return the parts that can contain floor."""
    if _frame(datum) is None:
        return []
    floor_entries = [e for e in entries if e.count and e.key.layer in AREA_LAYERS - {"location"}]
    return [e for e in floor_entries if e.key.layer != "occupancy" or e.key.name not in masks.MASKS]


def _estimate_extent(draft: ChunkStage, entries: Sequence[PartEntry], datum: Datum | None) -> Area:
    """Compute the area of an environment without a fence."""
    frame = _frame(datum)
    if frame is None:
        return NO_AREA
    near = shapely.Point(0.0, 0.0).buffer(NEIGHBOURHOOD_METRES, quad_segs=CIRCLE_SEGMENTS)
    shapes: list[Any] = []
    for entry in _floors(entries, datum):
        if entry.key.layer == "occupancy":
            root = read_root(draft, bytes.fromhex(entry.hash))
            shapes.append(None if masks.NAME in root.header["properties"] else free_rectangle(draft, root))
            continue
        for part in _load(draft, [entry]):
            if entry.key.layer == "topology":
                shapes.append(_hull(part, frame, near))
            else:
                shapes += _floor_objects(part, frame)
    wide = [shapely.buffer(s, MARGIN_METRES, quad_segs=4) for s in shapes if s is not None]
    floor = _polygonal(shapely.intersection(shapely.union_all(wide), near)) if wide else None
    if floor is not None:
        return area_in_degrees(FLOOR, _shape_in_degrees(floor, frame))
    circle = shapely.Point(0.0, 0.0).buffer(DATUM_METRES, quad_segs=CIRCLE_SEGMENTS)
    return area_in_degrees("datum", _shape_in_degrees(circle, frame), size=round(math.pi * DATUM_METRES**2, 1))


def _geometries_in_metres(part: Features, frame: LocalFrame) -> NDArray[np.object_]:
    """Return a part's geometries in metres, without those that are too far away for the local frame."""
    out = np.asarray(shapely.force_2d(part.geometry), object).copy()
    distant = ~part.local
    if distant.any():
        out[distant] = shapely.transform(out[distant], frame.to_local)
    finite = np.isfinite(shapely.bounds(out)).all(axis=1)
    return np.asarray(out[finite & ~shapely.is_empty(out)], object)


def _hull(network: Features, frame: LocalFrame, near: Any) -> Any:
    """Compute the convex hull, in metres, of a network's items in the neighbourhood; None if there are none."""
    shapes = _geometries_in_metres(network, frame)
    inside = np.abs(shapely.bounds(shapes)).max(axis=1, initial=0.0) <= NEIGHBOURHOOD_METRES
    shapes[~inside] = shapely.intersection(shapely.make_valid(shapes[~inside]), near)
    points = shapely.get_coordinates(shapes)
    return shapely.convex_hull(shapely.multipoints(points)) if len(points) else None


def _floor_objects(part: Features, frame: LocalFrame) -> list[Any]:
    floors = part.select([k for k, p in enumerate(part.properties) if p.get("kind") == FLOOR])
    flat = [s for s in _geometries_in_metres(floors, frame) if s.geom_type in ("Polygon", "MultiPolygon")]
    return [p for p in (_polygonal(shapely.make_valid(s)) for s in flat) if p is not None]


def free_rectangle(draft: ChunkStage, grid: PartRoot) -> Any:
    """Compute the rectangle in metres around a stored grid's free cells, in the grid's orientation; None without any.

    Reads the grid tile by tile, equal tiles once.
    """
    node, header = grid.trees["tiles"], grid.header
    if node is None:
        return None
    (leaves,) = tree.leaves(draft, [node])
    raws = draft.read_many(leaves)
    codes: dict[bytes, list[int]] = {}
    for leaf in leaves:
        for code, name in tile_leaf(raws[leaf]):
            codes.setdefault(name, []).append(code)
    boxes: list[tuple[int, int, int, int]] = []
    names = list(codes)
    for start in range(0, len(names), TILE_BATCH):
        for name, raw in draft.stream(names[start : start + TILE_BATCH]).items():
            boxes += _free_boxes(header, tile_cells(raw) == FREE, codes[name])
    if not boxes:
        return None
    bounds = np.array(boxes, np.float64)
    u0, v0 = bounds[:, :2].min(axis=0).tolist()
    u1, v1 = bounds[:, 2:].max(axis=0).tolist()
    x, y, yaw = header["origin"]
    along, across = np.array([math.cos(yaw), math.sin(yaw)]), np.array([-math.sin(yaw), math.cos(yaw)])
    corners = np.array([along * u + across * v for u, v in ((u0, v0), (u1, v0), (u1, v1), (u0, v1))])
    return shapely.Polygon(corners * header["resolution"] + np.array([x, y]))


def _free_boxes(header: Mapping[str, Any], free: NDArray[np.bool_], codes: Sequence[int]) -> list[Any]:
    """Return (first column, first row, end column, end row) of the free cells of each of these equal tiles."""
    out: list[Any] = []
    if not free.any():
        return out
    for code in codes:
        row, column, height, width = tile_shape(header, code)
        cells = free.reshape(height, width)
        rows, columns = np.flatnonzero(cells.any(axis=1)), np.flatnonzero(cells.any(axis=0))
        out.append((column + columns[0], row + rows[0], column + columns[-1] + 1, row + rows[-1] + 1))
    return out


def _shape_in_degrees(shape: Any, frame: LocalFrame) -> Any:
    """Convert a shape from metres to degrees; longitudes continue beyond ±180 across the antimeridian."""
    around = frame.datum.longitude

    def change(xy: Array) -> Array:
        out = frame.to_wgs84(xy)
        out[:, 0] = (out[:, 0] - around + 180.0) % 360.0 - 180.0 + around
        return out

    return _polygonal(shapely.make_valid(shapely.transform(shape, change)))


def area_in_degrees(by: Literal["fence", "floor", "datum"], shape: Any, size: float | None = None) -> Area:
    """Build an area from a (Multi)Polygon in degrees whose longitudes may continue beyond ±180.

    It is cut at ±180 and, if that leaves pieces on both sides of the globe, into its eastern and western half.
    """
    pieces = []
    for turn in (-360.0, 0.0, 360.0):
        cut = shapely.intersection(shape, shapely.box(-180.0 + turn, -90.0, 180.0 + turn, 90.0))
        pieces.append(shapely.transform(cut, lambda xy, turn=turn: xy - np.array([turn, 0.0])))
    union = _polygonal(shapely.union_all(pieces))
    if union is None:
        return NO_AREA
    west, _, east, _ = union.bounds
    if east - west > 180.0:
        halves = [
            _polygonal(shapely.intersection(union, shapely.box(w, -90.0, w + 180.0, 90.0))) for w in (-180.0, 0.0)
        ]
    else:
        halves = [union]
    areas = [half for half in halves if half is not None]
    return Area(
        by,
        round(sum(surface(half) for half in areas) if size is None else size, 1),
        tuple((_box(half), bytes(to_wkb(np.array([half], object))[0])) for half in areas),
    )


def _box(shape: Any) -> Box:
    west, south, east, north = shape.bounds
    return float(west), float(south), float(east), float(north)


# --- rows ---


def write_area(connection: Connection, environment_id: str, area: Area) -> None:
    """Replace an environment's stored area. The caller has locked the environment's row."""
    table = tables.area
    connection.execute(delete(table).where(table.c.environment_id == environment_id))
    rows = [
        {
            "environment_id": environment_id,
            "piece": number,
            "basis": area.by,
            "size": area.size,
            "west": west,
            "south": south,
            "east": east,
            "north": north,
            "geometry": wkb,
        }
        for number, ((west, south, east, north), wkb) in enumerate(area.pieces)
    ]
    if rows:
        connection.execute(insert(table), rows)

"""Convert KML geometries and overlays to shapes."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import shapely
from lxml import etree
from numpy.typing import NDArray

from app.errors import UnreadableFile
from app.formats.kml.coordinates import (
    Sequences,
    off_earth_problem,
    parse_floats,
    parse_lenient_tuples,
    parse_point,
    with_line,
)
from app.formats.kml.items import Item
from app.formats.kml.words import GEOMETRIES, SIMPLE, child, child_text, local_name
from app.model.features import NO_GEOMETRY


def _flat(points: Sequence[tuple[float, float, float]]) -> NDArray[np.float64]:
    """Return float64 [n, 2], or [n, 3] if any altitude is not 0."""
    array = np.array(points, np.float64).reshape(-1, 3)
    return array if array[:, 2].any() else array[:, :2]


def _line(points: Sequence[tuple[float, float, float]]) -> Any:
    """Build a line; one point becomes a point, no points None."""
    if len(points) > 1:
        return shapely.linestrings(_flat(points))
    return shapely.points(_flat(points)[0]) if points else NO_GEOMETRY


def _area(rings: Sequence[Sequence[tuple[float, float, float]]]) -> Any:
    """Build a polygon from its rings, closing open ones.

    A ring of too few points (an edge drawn there and back) is padded with one of its points: its area is 0, but the
    drawing is preserved.
    """
    if not rings or not rings[0]:
        return NO_GEOMETRY
    closed = [[*r, r[0]] if r[0] != r[-1] else list(r) for r in rings if r]
    closed = [r if len(r) >= 4 else [*r[:-1], *[r[-2 if len(r) > 1 else 0]] * (4 - len(r)), r[-1]] for r in closed]
    deep = any(p[2] for r in closed for p in r)
    make = [shapely.linearrings(np.array(r)[:, : 3 if deep else 2]) for r in closed]
    return shapely.polygons(make[0], holes=make[1:] or None)


def _join_geometries(parts: Sequence[Any]) -> Any:
    """Combine several geometries into one: Multi… if they are of one type."""
    flat = list(parts)
    while any(p.geom_type.startswith(("Multi", "Geometry")) for p in flat):
        flat = [q for p in flat for q in shapely.get_parts(p)]
    flat = [p for p in flat if not p.is_empty]
    if not flat:
        return NO_GEOMETRY
    types = {p.geom_type for p in flat}
    make = {"Point": shapely.multipoints, "LineString": shapely.multilinestrings, "Polygon": shapely.multipolygons}
    deep = any(p.has_z for p in flat)
    flat = [shapely.force_3d(p) if deep and not p.has_z else p for p in flat]
    if len(types) == 1 and (one := types.pop()) in make:
        return make[one](flat)
    return shapely.geometrycollections(flat)


def read_geometry(g: etree._Element) -> Any:
    """Parse one geometry element, also irregular ones; empty ones give NO_GEOMETRY. Raises UnreadableFile."""
    name = local_name(g)
    if name in ("Point", "LineString", "LinearRing"):
        points = _coordinate_tuples(g)
        return _line(points[:1] if name == "Point" else points)
    if name == "Polygon":
        rings = [
            _coordinate_tuples(r)
            for side in ("outer", "inner")
            for r in g.iterfind(f"{{*}}{side}BoundaryIs/{{*}}LinearRing")
        ]
        return _area(rings)
    if name == "Track":
        texts = [(c, (c.text or "").split()) for c in g.iterchildren("{*}coord")]
        return _line([parse_point(parse_floats(t, c.sourceline), c.sourceline) for c, t in texts if len(t) in (2, 3)])
    if name == "Model":
        spot = child(g, "Location")
        texts3 = [] if spot is None else [child_text(spot, w) for w in ("longitude", "latitude", "altitude")]
        if len(texts3) < 3 or not (texts3[0] and texts3[1]):
            return NO_GEOMETRY
        return _line([parse_point(parse_floats([t or "0" for t in texts3], g.sourceline), g.sourceline)])
    inner = [read_geometry(c) for c in g if isinstance(c.tag, str) and local_name(c) in GEOMETRIES]
    return _join_geometries(inner)


def _coordinate_tuples(g: etree._Element) -> list[tuple[float, float, float]]:
    return [t for c in g.iterchildren("{*}coordinates") for t in parse_lenient_tuples(c.text or "", c.sourceline)]


def item_geometry(element: etree._Element) -> Any:
    """Parse the geometry of a placemark or overlay, of any shape. Raises UnreadableFile."""
    if local_name(element) == "GroundOverlay":
        return overlay_footprint(element)
    geometries = [c for c in element if isinstance(c.tag, str) and local_name(c) in GEOMETRIES]
    if len(geometries) == 1:
        return read_geometry(geometries[0])
    shapes = [s for s in map(read_geometry, geometries) if not s.is_empty]
    return shapes[0] if len(shapes) == 1 else _join_geometries(shapes)


def overlay_footprint(element: etree._Element) -> Any:
    """Return the corners of a GroundOverlay: its gx:LatLonQuad, else its LatLonBox rotated counter-clockwise."""
    quad, box = child(element, "LatLonQuad"), child(element, "LatLonBox")
    if quad is not None:
        corners = _coordinate_tuples(quad)
        return shapely.polygons([p[:2] for p in corners]) if len(corners) == 4 else NO_GEOMETRY
    if box is None:
        return NO_GEOMETRY
    texts = [child_text(box, side) for side in ("west", "south", "east", "north", "rotation")]
    if not all(texts[:4]):
        return NO_GEOMETRY
    west, south, east, north, turn = parse_floats([*texts[:4], texts[4] or "0"], box.sourceline)
    for x, y in ((west, south), (east, north)):
        if not (abs(x) <= 360.0 and abs(y) <= 90.0):
            raise UnreadableFile(
                f"an overlay's corner {x:g},{y:g} is not on earth", [off_earth_problem(x, y, box.sourceline)]
            )
    if not math.isfinite(turn):
        raise UnreadableFile(
            "an overlay's rotation is not finite", [with_line("rotation is not finite", box.sourceline)]
        )
    if east < west:
        east += 360.0
    corners2 = np.array([[west, south], [east, south], [east, north], [west, north]])
    angle = math.radians(turn)
    if angle:
        middle = corners2.mean(axis=0)
        shrink = max(math.cos(math.radians(middle[1])), 1e-6)
        u, v = (corners2 - middle).T * np.array([[shrink], [1.0]])
        c, s = math.cos(angle), math.sin(angle)
        corners2 = middle + np.stack([(c * u - s * v) / shrink, s * u + c * v], axis=1)
    return _is_within_earth(shapely.polygons(corners2))


def _is_within_earth(shape: Any) -> Any:
    """Split a footprint that crosses the antimeridian into two, one on either side."""
    west, _, east, _ = shape.bounds
    if west >= -180.0 and east <= 180.0:
        return shapely.intersection(shape, shapely.box(-180.0, -90.0, 180.0, 90.0)) if shape.bounds[3] > 90 else shape
    pieces = []
    for shift in (-360.0, 0.0, 360.0):
        moved = shapely.transform(shape, lambda p, by=shift: p + np.array([by, 0.0]))
        piece = shapely.intersection(moved, shapely.box(-180.0, -90.0, 180.0, 90.0))
        if piece.area > 0.0:
            pieces.append(piece)
    return pieces[0] if len(pieces) == 1 else _join_geometries(pieces)


def parse_plain_sequences(g: etree._Element) -> tuple[str, list[tuple[str, etree._Element]]] | None:
    """Return the shape and the coordinate elements of a geometry of regular structure.

    The shape is a code: ``P`` point, ``L`` line, ``A2`` area of two rings, ``M…`` several of them; the elements are
    (role, element) in the order of the geometry's own coordinates.
    """
    name = local_name(g)
    if name == "Polygon":
        if len(g) == 1 and (c := _single_ring(g[0])) is not None:
            return "A1", [("R", c)]
        coordinates = list(g.iter("{*}coordinates"))
        for k, c in enumerate(coordinates):
            ring = c.getparent()
            side = ring.getparent()
            tag = "outerBoundaryIs" if k == 0 else "innerBoundaryIs"
            alone = len(list(ring.iterchildren(c.tag))) == 1 and not len(c)
            if not alone or local_name(side) != tag or side.getparent() is not g:
                return None
        return (f"A{len(coordinates)}", [("R", c) for c in coordinates]) if coordinates else None
    if name in SIMPLE:
        if len(g) == 1 and not len(g[0]) and g[0].tag.endswith("}coordinates"):
            role = "P" if name == "Point" else "L"
            return role, [(role, g[0])]
        coordinates = list(g.iterchildren("{*}coordinates"))
        if len(coordinates) != 1 or len(coordinates[0]) or len(list(g.iter("{*}coordinates"))) != 1:
            return None
        role = "P" if name == "Point" else "L"
        return role, [(role, coordinates[0])]
    if name != "MultiGeometry":
        return None
    shape, out = "M", []
    for c in g:
        inner = parse_plain_sequences(c) if local_name(c) in SIMPLE else None
        if inner is None:
            return None
        shape += inner[0]
        out += inner[1]
    return (shape, out) if out else None


def _single_ring(side: etree._Element) -> etree._Element | None:
    """Return the coordinates of ``<outerBoundaryIs><LinearRing><coordinates/>`` without other content."""
    if len(side) == 1 and local_name(side) == "outerBoundaryIs":
        ring = side[0]
        if len(ring) == 1 and not len(ring[0]) and local_name(ring) == "LinearRing":
            c = ring[0]
            return c if local_name(c) == "coordinates" else None
    return None


def item_geometries(items: Sequence[Item], parsed: Sequences) -> NDArray[np.object_]:
    """Build all geometries, the regular ones by array operations. 3-D only if an altitude is not 0."""
    out = np.full(len(items), NO_GEOMETRY, object)
    rows_by_shape: dict[str, list[tuple[int, int]]] = {"P": [], "L": [], "A1": []}
    for n, item in enumerate(items):
        if item.shape in rows_by_shape:
            rows_by_shape[item.shape].append((n, item.sequences[0][1]))
        elif item.shape:
            out[n] = _assemble_geometry(item, parsed)
        else:
            out[n] = item_geometry(item.element)
    make: dict[str, Callable[..., Any]] = {
        "P": lambda p, indices, out: out.__setitem__(slice(None), shapely.points(p)),
        "L": lambda p, indices, out: shapely.linestrings(p, indices=indices, out=out),
        "A1": lambda p, indices, out: out.__setitem__(
            slice(None), shapely.polygons(shapely.linearrings(p, indices=indices))
        ),
    }
    deep_points = np.concatenate([[0], np.cumsum(parsed.points[:, 2] != 0.0)])
    for shape, rows in rows_by_shape.items():
        if not rows:
            continue
        indices, sequence = np.array(rows).T
        begin, end = parsed.start[sequence], parsed.start[sequence + 1]
        deep = deep_points[end] > deep_points[begin]
        for mask, width in ((~deep, 2), (deep, 3)):
            if not mask.any():
                continue
            size = (end - begin)[mask]
            offset = np.repeat(begin[mask] - np.concatenate([[0], np.cumsum(size)[:-1]]), size)
            points = parsed.points[np.arange(size.sum()) + offset, :width]
            geometries = np.empty(len(size), object)
            make[shape](points, np.repeat(np.arange(len(size)), size), geometries)
            out[indices[mask]] = geometries
    return out


def _assemble_geometry(item: Item, parsed: Sequences) -> Any:
    """Build a regular geometry of several lists: an area with holes, or a collection."""
    lists = [parsed.points[parsed.start[k] : parsed.start[k + 1]] for _, k, _ in item.sequences]
    deep = any(p[:, 2].any() for p in lists)
    rows = iter([p if deep else p[:, :2] for p in lists])
    shapes = []
    for piece in re.findall(r"P|L|A\d+", item.shape):
        if piece == "P":
            shapes.append(shapely.points(next(rows)[0]))
        elif piece == "L":
            shapes.append(shapely.linestrings(next(rows)))
        else:
            rings = [shapely.linearrings(next(rows)) for _ in range(int(piece[1:]))]
            shapes.append(shapely.polygons(rings[0], holes=rings[1:] or None))
    return _join_geometries(shapes) if item.shape[0] == "M" else shapes[0]

"""Solids of objects: ``properties.shapes`` and mesh files -> triangles, footprints and boxes in the local frame.

An object's collision solids are a list of mappings under ``shapes``, each with a ``type`` and, unless it is the
identity, a ``pose`` [x, y, z, roll, pitch, yaw] (metres, radians) in the object's own frame; the object's ``pose`` is
in the local frame. Rotations are SDF's: about the fixed axes x, y, z in this order, R = Rz·Ry·Rx.

========== ============================================= ==============================================================
type       further keys                                  origin and extent
========== ============================================= ==============================================================
box        size [x, y, z]                                its middle
cylinder   radius, length                                its middle, length along z
capsule    radius, length                                its middle; length of the cylinder between two half spheres
sphere     radius                                        its middle
ellipsoid  radii [x, y, z]                               its middle
plane      normal [x, y, z], size [x, y]                 its middle; infinite in physics engines, see ``planes``
polyline   points [[[x, y], …], …], height               rings by the even-odd rule, z from 0 to height
mesh       file, scale [x, y, z], submesh, center        the file's
heightmap  file, size [x, y, z], position [x, y, z]      its middle; the image's brightest pixel is at size z
========== ============================================= ==============================================================

A shape with a ``uri`` and no ``file`` is a solid that is missing in the upload: a missing mesh, a geometry of an
unknown type; the type ``model`` represents all solids of a missing model. ``Solids.read`` reports them.

``visual: true`` marks a shape that is only visible, without collision; ``unseen: true`` one with collision only.
``colour`` [r, g, b] or [r, g, b, a], 0 to 1, is its display colour.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import PurePosixPath
from typing import Any, NoReturn

import numpy as np
import shapely
from numpy.typing import NDArray

from app.errors import Invalid, Problem, TooLarge
from app.model import meshes
from app.model.features import Properties
from app.model.frame import MAX_METRES

Array = NDArray[np.float64]

MAX_TRIANGLES = 5_000_000
"""Maximum number of triangles of one object."""

MAX_SHAPES = 10_000
"""Maximum number of shapes of one object."""

MAX_PIXELS = 4097 * 4097
"""Maximum number of pixels of a height map's image."""

MAX_HEIGHTMAP_SIDE = 1400
"""Maximum number of rows and columns of a height map; of a larger image the brightest pixel of each block is used."""

TOLERANCE = 0.002
"""Maximum distance in metres of a round solid's flat sides from the true surface."""

MAX_OUTLINES = 5_000
"""Maximum number of triangles whose outlines are joined for a footprint; larger meshes use the convex hull."""

_NOTHING: Array = np.empty((0, 3, 3))


@dataclass(frozen=True, slots=True)
class Unreadable:
    """A solid of unknown extent: the error of reading it, and its origin (x, y) in metres, local frame."""

    error: Invalid | TooLarge
    at: tuple[float, float]


@dataclass(slots=True)
class Solids:
    """Reader of objects' solids; each mesh file is read once, however many shapes use it.

    resources: by path, as returned by ``Layers.resources()``. planes: whether planes count, as rectangles of their
    size. visuals: whether shapes without collision count too.
    """

    resources: Mapping[str, bytes]
    planes: bool = False
    visuals: bool = False
    _read: dict[str, meshes.Mesh | Invalid] = field(default_factory=dict, init=False, repr=False)

    def triangles(self, properties: Properties) -> Array:
        """Return an object's solids as triangles, float64 [n, 3, 3], metres, local frame.

        They are counter-clockwise seen from outside if the source is. Raises Invalid with the file or the shape; the
        detail states what to upload for a missing file.
        """
        triangles, unreadable = self.read(properties)
        if unreadable:
            raise unreadable[0].error
        return triangles

    def read(self, properties: Properties) -> tuple[Array, list[Unreadable]]:
        """Return the readable solids of an object, as ``triangles`` does, and the unreadable ones.

        Raises Invalid or TooLarge if the object as a whole is invalid or too large.
        """
        placement = matrix(parse_pose(properties))
        arrays: list[Array] = []
        unreadable: list[Unreadable] = []
        total = 0
        for k, shape in enumerate(object_shapes(properties)):
            if not self._counts(shape):
                continue
            try:
                arrays.append(self.shape(shape, f"shapes[{k}]"))
            except (Invalid, TooLarge) as error:
                unreadable.append(Unreadable(error, _origin(placement, shape)))
                continue
            total += len(arrays[-1])
            if total > MAX_TRIANGLES:
                raise TooLarge(f"an object has more than {MAX_TRIANGLES} triangles")
        return (
            _check_corners(_apply_transform(np.concatenate(arrays), placement), "pose") if arrays else _NOTHING
        ), unreadable

    def footprint(self, properties: Properties) -> Any:
        """Return the ground below an object's solids: a valid shapely geometry in local metres, possibly empty.

        For a mesh with very many triangles it is the convex hull.
        """
        outlines = []
        placement = matrix(parse_pose(properties))
        for k, shape in enumerate(object_shapes(properties)):
            if self._counts(shape):
                corners = self.shape(shape, f"shapes[{k}]")
                outlines.append(_shadow(_check_corners(_apply_transform(corners, placement), "pose")[:, :, :2]))
        return shapely.union_all(outlines) if outlines else shapely.Polygon()

    def bounds(self, properties: Properties) -> tuple[float, float, float, float, float, float] | None:
        """Return min x, min y, min z, max x, max y, max z of an object's solids, local metres; None without any."""
        flat = self.triangles(properties).reshape(-1, 3)
        if not len(flat):
            return None
        low, high = flat.min(axis=0).tolist(), flat.max(axis=0).tolist()
        return low[0], low[1], low[2], high[0], high[1], high[2]

    def size(self, properties: Properties) -> tuple[float, float, float] | None:
        """Return [x, y, z] of the box around an object's solids in its own frame, metres; None without any."""
        b = self.bounds({key: value for key, value in properties.items() if key != "pose"})
        return None if b is None else (b[3] - b[0], b[4] - b[1], b[5] - b[2])

    def shape(self, shape: Mapping[str, Any], location: str = "shape") -> Array:
        """Convert one shape into triangles in its object's frame, float64 [n, 3, 3]."""
        kind = shape.get("type")
        make = _MAKERS.get(kind) if isinstance(kind, str) else None
        if "file" not in shape and isinstance(shape.get("uri"), str):
            _raise_missing_file(str(shape["uri"]))
        if make is None:
            _raise_invalid(f"has the unknown type {str(kind)[:80]!r}: use one of {', '.join(_MAKERS)}", location)
        return _check_corners(
            _apply_transform(make(self, shape, location), matrix(parse_pose(shape, location))), location
        )

    def mesh(self, file: str) -> meshes.Mesh:
        """Read a mesh file once. Raises Invalid with its name."""
        if file not in self._read:
            try:
                self._read[file] = meshes.read_mesh(self.file(file), file)
            except Invalid as error:
                self._read[file] = error
            except TooLarge as error:
                self._read[file] = Invalid(error.detail, error.problems)
        cached = self._read[file]
        if isinstance(cached, Invalid):
            raise cached
        return cached

    def file(self, path: str) -> bytes:
        """Return a resource's bytes. Raises Invalid with the advice to upload it."""
        data = self.resources.get(path)
        if data is None:
            _raise_missing_file(path)
        return data

    def _counts(self, shape: Mapping[str, Any]) -> bool:
        return (self.visuals or shape.get("visual") is not True) and (self.planes or shape.get("type") != "plane")


def triangles(
    properties: Properties, resources: Mapping[str, bytes], *, planes: bool = False, visuals: bool = False
) -> Array:
    """Call ``Solids.triangles``; for many objects create one ``Solids``."""
    return Solids(resources, planes, visuals).triangles(properties)


def footprint(
    properties: Properties, resources: Mapping[str, bytes], *, planes: bool = False, visuals: bool = False
) -> Any:
    """Call ``Solids.footprint``."""
    return Solids(resources, planes, visuals).footprint(properties)


def bounds(
    properties: Properties, resources: Mapping[str, bytes], *, planes: bool = False, visuals: bool = False
) -> tuple[float, float, float, float, float, float] | None:
    """Call ``Solids.bounds``."""
    return Solids(resources, planes, visuals).bounds(properties)


def size(
    properties: Properties, resources: Mapping[str, bytes], *, planes: bool = False, visuals: bool = False
) -> tuple[float, float, float] | None:
    """Call ``Solids.size``."""
    return Solids(resources, planes, visuals).size(properties)


def object_shapes(properties: Properties) -> Sequence[Mapping[str, Any]]:
    """Return an object's shapes; empty if it has none. Raises Invalid if they are no list of mappings."""
    shapes = properties.get("shapes")
    if shapes is None:
        return []
    if not isinstance(shapes, (list, tuple)) or not all(isinstance(shape, Mapping) for shape in shapes):
        _raise_invalid("must be a list of mappings with a type", "shapes")
    if len(shapes) > MAX_SHAPES:
        _raise_invalid(f"are {len(shapes)}; the limit is {MAX_SHAPES}", "shapes")
    return shapes


def parse_pose(members: Mapping[str, Any], location: str = "pose") -> tuple[float, ...]:
    """Return [x, y, z, roll, pitch, yaw]; missing numbers are 0. Raises Invalid if it is no list of finite numbers."""
    pose = members.get("pose")
    if pose is None:
        return (0.0,) * 6
    if not isinstance(pose, (list, tuple)) or len(pose) > 6:
        _raise_invalid("must be [x, y, z, roll, pitch, yaw]", f"{location}.pose")
    numbers = [_number(value, f"{location}.pose", MAX_METRES) for value in pose]
    return (*numbers, *([0.0] * (6 - len(numbers))))


def rotation(roll: float, pitch: float, yaw: float) -> Array:
    """Return R = Rz(yaw)·Ry(pitch)·Rx(roll), float64 [3, 3]."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a), math.sin(a)) for a in (roll, pitch, yaw))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def matrix(pose: Sequence[float]) -> Array:
    """Convert a pose [x, y, z, roll, pitch, yaw] to float64 [4, 4]."""
    out = np.eye(4)
    out[:3, :3] = rotation(*pose[3:6])
    out[:3, 3] = pose[:3]
    return out


def apply_pose(corners: Array, pose: Sequence[float]) -> Array:
    """Transform points float64 [..., 3] of a frame with this pose to the frame around it."""
    return _apply_transform(corners, matrix(pose))


def _apply_transform(corners: Array, transform: Array) -> Array:
    if np.array_equal(transform, np.eye(4)):
        return corners
    return np.asarray(corners @ transform[:3, :3].T + transform[:3, 3], np.float64)


def _check_corners(corners: Array, location: str) -> Array:
    if not bool((np.abs(corners) <= MAX_METRES).all()):
        _raise_invalid(f"gives coordinates that are not finite metres within ±{MAX_METRES:g}", location)
    return corners


def _shadow(corners: Array) -> Any:
    """Return the union of triangles [n, 3, 2] seen from above; of very many the convex hull."""
    if not len(corners):
        return shapely.Polygon()
    if len(corners) > MAX_OUTLINES:
        return shapely.convex_hull(shapely.multipoints(corners.reshape(-1, 2)))
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])
    seen = np.abs(area) > 1e-12
    if not seen.any():  # a wall without thickness
        return shapely.convex_hull(shapely.multipoints(corners.reshape(-1, 2)))
    # a grid of a micrometre makes the union of hundreds of touching slivers robust
    return shapely.union_all(shapely.polygons(corners[seen]), grid_size=1e-6)


# --- the shapes ------------------------------------------------------------------------------------------------------


def _box(solids: Solids, shape: Mapping[str, Any], location: str) -> Array:  # noqa: ARG001 - one signature for all shapes
    return _unit_box() * _vector(shape, "size", 3, location)


def _sphere(solids: Solids, shape: Mapping[str, Any], location: str) -> Array:  # noqa: ARG001
    radius = _length(shape, "radius", location)
    return _revolve(*_arc(radius, 0.0), _sides(radius))


def _ellipsoid(solids: Solids, shape: Mapping[str, Any], location: str) -> Array:  # noqa: ARG001
    radii = _vector(shape, "radii", 3, location)
    sides = _sides(float(radii.max()))
    return _revolve(*_arc(1.0, 0.0, sides), sides) * radii


def _capsule(solids: Solids, shape: Mapping[str, Any], location: str) -> Array:  # noqa: ARG001
    radius = _length(shape, "radius", location)
    return _revolve(*_arc(radius, _length(shape, "length", location)), _sides(radius))


def _cylinder(solids: Solids, shape: Mapping[str, Any], location: str) -> Array:  # noqa: ARG001
    radius, half = _length(shape, "radius", location), _length(shape, "length", location) / 2.0
    return _revolve(np.array([0.0, radius, radius, 0.0]), np.array([-half, -half, half, half]), _sides(radius))


def _plane(solids: Solids, shape: Mapping[str, Any], location: str) -> Array:  # noqa: ARG001
    """Return a rectangle of the plane's size, rotated from +z to its normal by the smallest angle."""
    x, y = _vector(shape, "size", 2, location, (1.0, 1.0)) / 2.0
    flat = np.array([[[-x, -y, 0], [x, -y, 0], [x, y, 0]], [[-x, -y, 0], [x, y, 0], [-x, y, 0]]], np.float64)
    normal = _vector(shape, "normal", 3, location, (0.0, 0.0, 1.0), minimum=-MAX_METRES)
    length = float(np.linalg.norm(normal))
    if not length:
        _raise_invalid("must not be zero", f"{location}.normal")
    a, b, c = normal / length
    if c < -1.0 + 1e-12:
        return np.asarray(flat * np.array([1.0, -1.0, -1.0]), np.float64)
    k = 1.0 / (1.0 + c)
    turn = np.array([[1 - a * a * k, -a * b * k, a], [-a * b * k, 1 - b * b * k, b], [-a, -b, c]])
    return np.asarray(flat @ turn.T, np.float64)


def _polyline(solids: Solids, shape: Mapping[str, Any], location: str) -> Array:  # noqa: ARG001
    rings = shape.get("points")
    if not isinstance(rings, (list, tuple)) or not rings:
        _raise_invalid("must be a list of rings of [x, y]", f"{location}.points")
    area = shapely.Polygon()
    for ring in rings:
        at = _points(ring, f"{location}.points")
        if len(at) >= 3:
            area = shapely.symmetric_difference(area, shapely.make_valid(shapely.Polygon(at)))
    return extrude(area, 0.0, _length(shape, "height", location))


def extrude(area: Any, low: float, high: float) -> Array:
    """Extrude polygons (shapely, metres) from one height to another: closed triangles, float64 [n, 3, 3]."""
    faces = []
    for polygon in shapely.get_parts(shapely.get_parts(area)):  # a collection may contain several polygons in one part
        if shapely.get_type_id(polygon) != 3 or shapely.is_empty(polygon):
            continue
        oriented = shapely.orient_polygons(polygon)
        cut = shapely.get_parts(shapely.constrained_delaunay_triangles(oriented))
        flat = shapely.get_coordinates(cut).reshape(-1, 4, 2)[:, :3]
        a, b, c = flat[:, 0], flat[:, 1], flat[:, 2]
        back = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) < (c[:, 0] - a[:, 0]) * (b[:, 1] - a[:, 1])
        flat[back] = flat[back][:, ::-1]
        faces += [_add_height(flat, high), _add_height(flat[:, ::-1], low)]
        for ring in (oriented.exterior, *oriented.interiors):
            at = shapely.get_coordinates(ring)
            a3, b3 = (np.column_stack([p, np.full(len(p), low)]) for p in (at[:-1], at[1:]))
            up = np.array([0.0, 0.0, high - low])
            faces += [np.stack([a3, b3, b3 + up], axis=1), np.stack([a3, b3 + up, a3 + up], axis=1)]
    return np.concatenate(faces) if faces else _NOTHING


def _mesh(solids: Solids, shape: Mapping[str, Any], location: str) -> Array:
    file, part = shape.get("file"), shape.get("submesh")
    if not isinstance(file, str) or not file:
        _raise_invalid("must be the path of a mesh among the files of the objects", f"{location}.file")
    if part is not None and not isinstance(part, str):
        _raise_invalid("must be a name", f"{location}.submesh")
    scale = _vector(shape, "scale", 3, location, (1.0, 1.0, 1.0), minimum=-MAX_METRES)
    try:
        corners = solids.mesh(file).triangles(part or None, centre=shape.get("center") is True) * scale
    except Invalid as error:
        raise Invalid(error.detail, error.problems or [Problem(error.detail, file)]) from error
    return corners[:, ::-1] if np.prod(scale) < 0 else corners  # a mirrored solid has inverted faces


def _heightmap(solids: Solids, shape: Mapping[str, Any], location: str) -> Array:
    """Convert an image to a closed solid: brightest pixel at full height, black at 0, top row at maximum y.

    Source: gz-common ImageHeightmap and HeightmapShape (a pixel over the image's maximum, times the size's z).
    """
    file = shape.get("file")
    if not isinstance(file, str) or not file:
        _raise_invalid("must be the path of an image among the files of the objects", f"{location}.file")
    extent = _vector(shape, "size", 3, location, (1.0, 1.0, 1.0))
    position = _vector(shape, "position", 3, location, (0.0, 0.0, 0.0), minimum=-MAX_METRES)
    grey = _highest(_picture(solids.file(file), file))
    maximum = float(grey.max())
    z = grey[::-1] / (maximum or 1.0) * extent[2]
    rows, columns = z.shape
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, columns) * extent[0], np.linspace(-0.5, 0.5, rows) * extent[1])
    top = np.stack([x, y, z], axis=-1)
    floor = top.copy()
    floor[..., 2] = z.min() - max(1e-3, 1e-3 * float(extent[2]))
    corners = floor[[[0, 0], [-1, -1]], [[0, -1], [0, -1]]]
    parts = [_sheet(top), _sheet(corners)[:, ::-1]]
    for edge, base in (
        (top[0], floor[0]),
        (top[::-1, 0], floor[::-1, 0]),
        (top[-1, ::-1], floor[-1, ::-1]),
        (top[:, -1], floor[:, -1]),
    ):
        parts.append(_sheet(np.stack([base, edge])))
    return np.asarray(np.concatenate(parts) + position, np.float64)


def _highest(grey: Array) -> Array:
    """Reduce an image to the maximum number of rows and columns, each pixel the brightest of a block."""
    step = [math.ceil(n / MAX_HEIGHTMAP_SIDE) for n in grey.shape]
    if max(step) == 1:
        return grey
    rows, columns = (np.arange(0, n, k) for n, k in zip(grey.shape, step, strict=True))
    return np.asarray(np.maximum.reduceat(np.maximum.reduceat(grey, rows, axis=0), columns, axis=1), np.float64)


def _sheet(at: Array) -> Array:
    """Convert a grid of points [rows, columns, 3] into triangles, two for each of its squares."""
    a, b, c, d = at[:-1, :-1], at[:-1, 1:], at[1:, 1:], at[1:, :-1]
    both = np.stack([np.stack([a, b, c], axis=-2), np.stack([a, c, d], axis=-2)], axis=-3)
    return both.reshape(-1, 3, 3)


def _picture(data: bytes, file: str) -> Array:
    """Read an image's grey values, float64 [rows, columns]."""
    from PIL import Image

    kinds = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG", ".tif": "TIFF", ".tiff": "TIFF", ".bmp": "BMP"}
    kind = kinds.get(PurePosixPath(file).suffix.lower())
    if kind is None:
        _raise_invalid(f"must be one of {', '.join(sorted(kinds))}", file)
    try:
        with Image.open(io.BytesIO(data), formats=[kind]) as picture:
            if picture.width * picture.height > MAX_PIXELS:
                raise TooLarge(f"{file} has {picture.width} × {picture.height} pixels; the limit is {MAX_PIXELS}")
            deep = picture.mode in ("I", "F") or picture.mode.startswith("I;16")
            grey = np.asarray(picture if deep else picture.convert("L"), np.float64)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise Invalid(f"{file} cannot be read as an image: {error}", [Problem(str(error), file)]) from error
    if grey.ndim != 2 or min(grey.shape) < 2 or not bool(np.isfinite(grey).all()):
        _raise_invalid("must be an image of at least 2 × 2 pixels", file)
    return grey


_Maker = Callable[[Solids, Mapping[str, Any], str], Array]

_MAKERS: Mapping[str, _Maker] = {
    "box": _box,
    "cylinder": _cylinder,
    "sphere": _sphere,
    "capsule": _capsule,
    "ellipsoid": _ellipsoid,
    "plane": _plane,
    "polyline": _polyline,
    "mesh": _mesh,
    "heightmap": _heightmap,
}

TYPES = frozenset(_MAKERS)
"""Readers by type of shape."""


@cache
def _unit_box() -> Array:
    low, high = -0.5, 0.5
    return extrude(shapely.box(low, low, high, high), low, high)


def _sides(radius: float) -> int:
    """Return the number of flat sides of a circle, a multiple of 4 so that the extremes on the axes are exact."""
    ratio = TOLERANCE / radius if radius > 0 else 1.0
    side_count = math.pi / math.acos(1.0 - ratio) if ratio < 1.0 else 0.0
    return int(min(max(4 * math.ceil(side_count / 4.0), 16), 128))


def _arc(radius: float, length: float, sides: int = 0) -> tuple[Array, Array]:
    """Return (radii, heights) of half a circle from its lowest to its highest point, its halves ``length`` apart."""
    quarter = (sides or _sides(radius)) // 4
    angle = np.linspace(0.0, math.pi / 2.0, quarter + 1)
    r, z = np.sin(angle) * radius, np.cos(angle) * radius + length / 2.0
    if not length:
        r, z = r[:-1], z[:-1]
        return np.concatenate([r, [radius], r[::-1]]), np.concatenate([-z, [0.0], z[::-1]])
    return np.concatenate([r, r[::-1]]), np.concatenate([-z, z[::-1]])


def _revolve(radii: Array, heights: Array, sides: int) -> Array:
    """Revolve a curve (radii, heights), upwards, about the z axis: triangles without empty ones at the poles."""
    angle = np.arange(sides + 1) * (2.0 * math.pi / sides)
    c, s = np.cos(angle), np.sin(angle)
    quarter = sides // 4
    c[[quarter, 3 * quarter]], s[[0, 2 * quarter, sides]] = 0.0, 0.0
    c[-1], s[-1] = c[0], s[0]
    at = np.stack([radii[:, None] * c, radii[:, None] * s, np.repeat(heights[:, None], sides + 1, axis=1)], axis=-1)
    out = _sheet(at)
    flat = np.linalg.norm(np.cross(out[:, 1] - out[:, 0], out[:, 2] - out[:, 0]), axis=1)
    return out[flat > 0] if bool((flat > 0).any()) else out


def _add_height(flat: Array, z: float) -> Array:
    return np.concatenate([flat, np.full((*flat.shape[:-1], 1), z)], axis=-1)


def _origin(placement: Array, shape: Mapping[str, Any]) -> tuple[float, float]:
    """Return a shape's origin seen from above, in the frame around its object; the object's if its pose is invalid."""
    try:
        at = (placement @ matrix(parse_pose(shape)))[:2, 3]
    except Invalid:
        at = placement[:2, 3]
    return float(at[0]), float(at[1])


def _raise_missing_file(path: str) -> NoReturn:
    reason = f"the file {path[:200]} is missing: upload it together with the objects"
    raise Invalid(reason, [Problem(reason, path[:200])])


def _raise_invalid(reason: str, location: str) -> NoReturn:
    raise Invalid(f"{location} {reason}", [Problem(reason, where=location)])


def _number(value: Any, location: str, maximum: float, minimum: float | None = None) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= maximum:
        _raise_invalid(f"must be a finite number of at most {maximum:g}, got {str(value)[:80]}", location)
    if minimum is not None and value < minimum:
        _raise_invalid(f"must be at least {minimum:g}, got {value:g}", location)
    return float(value)


def _length(shape: Mapping[str, Any], word: str, location: str) -> float:
    return _number(shape.get(word), f"{location}.{word}", MAX_METRES, 0.0)


def _vector(
    shape: Mapping[str, Any], word: str, n: int, location: str, otherwise: Any = None, minimum: float = 0.0
) -> Array:
    values = shape.get(word, otherwise)
    if not isinstance(values, (list, tuple)) or len(values) != n:
        _raise_invalid(f"must be {n} numbers", f"{location}.{word}")
    return np.array([_number(v, f"{location}.{word}", MAX_METRES, minimum) for v in values])


def _points(ring: Any, location: str) -> Array:
    if not isinstance(ring, (list, tuple)) or not all(isinstance(p, (list, tuple)) and len(p) == 2 for p in ring):
        _raise_invalid("must be a list of rings of [x, y]", location)
    return np.array([[_number(v, location, MAX_METRES) for v in p] for p in ring], np.float64).reshape(-1, 2)

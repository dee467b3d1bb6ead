"""Static Gazebo models of objects from other formats (shapes, footprints, lines) and of a grid's walls."""

from __future__ import annotations

import math
import re
import struct
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from lxml import etree
from numpy.typing import NDArray

from app.errors import Invalid
from app.formats import WriteContext
from app.formats.gazebo import sdf
from app.formats.gazebo.library import MODELS
from app.formats.gazebo.models import is_absent
from app.model import obstacles, solids
from app.model.features import Feature
from app.model.frame import is_writable
from app.model.grid import UNKNOWN, OccupancyGrid
from app.parameters import parameter

WALL = 0.1
"""Default thickness of walls and lines as thin as walls, in metres."""

PLATE = 0.02
"""Thickness of areas drawn on the ground, in metres."""

HEIGHTS: Mapping[str, str] = {
    "wall": "wall_height",
    "building": "building_height",
    **dict.fromkeys(("barrier", "fence", "hedge"), "barrier_height"),
    "obstacle": "obstacle_height",
    "tree": "tree_height",
    "pole": "pole_height",
}
"""Parameter with the default height, by kind of obstacle."""

DRAWN = frozenset({"region", "zone", "area", "door"})
"""Kinds with visuals but no collisions."""

COLOURS: Mapping[str, str] = {
    "building": "building_colour",
    "wall": "wall_colour",
    "floor": "floor_colour",
    "door": "door_colour",
    "region": "area_colour",
}
"""Parameter with the default colour, by kind."""

Colour = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class BodyDefaults:
    """Default measures and colours of bodies."""

    wall_height: float = parameter(2.5, "height of walls without one", minimum=0.01, maximum=1000.0, unit="m")
    building_height: float = parameter(6.0, "height of buildings without one", minimum=0.01, maximum=1000.0, unit="m")
    barrier_height: float = parameter(
        1.2, "height of barriers, fences and hedges without one", minimum=0.01, maximum=1000.0, unit="m"
    )
    obstacle_height: float = parameter(1.0, "height of obstacles without one", minimum=0.01, maximum=1000.0, unit="m")
    tree_height: float = parameter(3.0, "height of trees without one", minimum=0.01, maximum=1000.0, unit="m")
    pole_height: float = parameter(2.0, "height of poles without one", minimum=0.01, maximum=1000.0, unit="m")
    door_height: float = parameter(2.1, "height of doors without one", minimum=0.01, maximum=1000.0, unit="m")
    wall_thickness: float | None = parameter(
        None,
        "thickness of walls and other thin lines without a width; default: 0.1, as in derived grids",
        minimum=0.001,
        maximum=100.0,
        unit="m",
    )
    floor_thickness: float = parameter(
        0.1, "thickness of floors without a height", minimum=0.001, maximum=100.0, unit="m"
    )
    pole_radius: float | None = parameter(
        None,
        "radius of obstacles given as points; default: by kind, for example 0.15 for poles, as in derived grids",
        minimum=0.001,
        maximum=100.0,
        unit="m",
    )
    building_colour: tuple[float, float, float] = parameter(
        (0.75, 0.68, 0.6), "colour of buildings: red, green, blue", minimum=0.0, maximum=1.0
    )
    wall_colour: tuple[float, float, float] = parameter(
        (0.7, 0.7, 0.7), "colour of walls: red, green, blue", minimum=0.0, maximum=1.0
    )
    floor_colour: tuple[float, float, float] = parameter(
        (0.8, 0.8, 0.78), "colour of floors: red, green, blue", minimum=0.0, maximum=1.0
    )
    door_colour: tuple[float, float, float] = parameter(
        (0.5, 0.35, 0.2), "colour of doors: red, green, blue", minimum=0.0, maximum=1.0
    )
    area_colour: tuple[float, float, float] = parameter(
        (0.45, 0.65, 0.4), "colour of areas drawn on the ground: red, green, blue", minimum=0.0, maximum=1.0
    )
    ground_colour: tuple[float, float, float] = parameter(
        (0.8, 0.8, 0.8), "colour of the ground: red, green, blue", minimum=0.0, maximum=1.0
    )
    ground: bool = parameter(True, "add a ground plane to a generated world")
    sun: bool = parameter(True, "add a light to a generated world that has none")


MAX_GROUND_METRES = 1e5

Rings = list[list[list[float]]]


def slug(text: str) -> str:
    """Convert a name to a part of a path or URI."""
    return re.sub(r"[^A-Za-z0-9_.-]+", "_", text).strip("._") or "map"


def valid(text: str) -> str:
    """Convert a text to a valid SDFormat name: no ``::``, ``__name__``, ``world`` or control characters."""
    name = "".join(c for c in text.replace("::", "_") if is_writable(c)).strip()[:200]
    name = name.replace("::", "_")
    if not name or name == "world" or (name.startswith("__") and name.endswith("__")):
        name = f"object_{name.strip('_')}".rstrip("_")
    return name


def free_name(text: str, taken: set[str]) -> str:
    """Return a valid unused name and add it to ``taken``."""
    name = base = valid(text)
    k = 1
    while name in taken:
        k += 1
        name = f"{base}_{k}"
    taken.add(name)
    return name


def sun(name: str) -> etree._Element:
    """Create a directional light from above."""
    light = etree.Element("light", name=name, type="directional")
    light.append(sdf.pose_element((0.0, 0.0, 10.0, 0.0, 0.0, 0.0)))
    sdf.child(light, "cast_shadows", "true")
    sdf.child(light, "diffuse", "0.8 0.8 0.8 1")
    sdf.child(light, "specular", "0.2 0.2 0.2 1")
    sdf.child(light, "direction", "-0.5 0.1 -0.9")
    return light


class Bodies:
    """Builder of models; collects their files and reports filled-in values and dropped data."""

    def __init__(self, context: WriteContext, resources: Mapping[str, bytes], defaults: BodyDefaults) -> None:
        self.context, self.resources, self.usual = context, resources, defaults
        self.files: dict[str, bytes] = {}
        self.newest = (1, 4)
        self.hilly = False  # whether the ground is a height map
        self._filled: set[tuple[str, float | Colour, str, str]] = set()
        self._dropped: Counter[tuple[str, str]] = Counter()
        self._box: list[tuple[float, float, float, float]] = []

    def report(self) -> None:
        """Report the values filled in and data dropped so far."""
        for noun, value, why, option in sorted(self._filled, key=lambda item: (item[0], item[2])):
            self.context.fill(noun, list(value) if isinstance(value, tuple) else value, why, option or None)
        for (noun, why), count in sorted(self._dropped.items()):
            self.context.drop(noun, count, why)
        self._filled.clear()
        self._dropped.clear()

    def model(self, one: Feature, elevation: float, taken: set[str]) -> etree._Element | None:
        """Build a static model of an object in local metres, or return None if it has no body.

        elevation: elevation of its level, in metres.
        """
        properties = one.properties
        kind = str(properties.get("kind"))
        try:
            shapes = [dict(s) for s in solids.object_shapes(properties)]
            pose = list(solids.parse_pose(properties))
        except Invalid as error:
            self._dropped[f"objects of kind {kind}", error.detail[:200]] += 1
            return None
        try:
            if shapes:
                shapes = self._with_files(shapes, kind)
                if obstacles.object_role(properties) == "mark":
                    shapes = [{**shape, "visual": True} for shape in shapes]
            else:
                shapes, pose = self._from_geometry(one, kind, elevation)
        except Invalid as error:
            self._dropped[f"objects of kind {kind}", error.detail[:200]] += 1
            return None
        if not shapes:
            self._dropped[f"objects of kind {kind}", "its solid is unknown: supply a height, shapes or a model"] += 1
            return None
        name = properties.get("name")
        name = free_name(name if isinstance(name, str) and name else one.id, taken)
        self._measure(one.geometry)
        self.hilly = self.hilly or any(shape.get("type") == "heightmap" for shape in shapes)
        return self._static(name, pose, shapes, COLOURS.get(kind), properties.get("gazebo"))

    def _measure_or_default(
        self, noun: str, option: str, why: str = "the objects have none", *, otherwise: float = 0.0
    ) -> float:
        """Return a measure from the options, else the other value, and report it as filled in."""
        setting = getattr(self.usual, option)
        value = float(otherwise if setting is None else setting)
        self._filled.add((noun, value, why, option))
        return value

    def _measure(self, geometry: Any) -> None:
        box = shapely.bounds(geometry)
        if np.isfinite(box).all():
            west, south, east, north = (float(v) for v in box)
            self._box.append((west, south, east, north))

    def _with_files(self, shapes: list[dict[str, Any]], kind: str) -> list[dict[str, Any]]:
        """Return the supported shapes whose files are stored, and add these files."""
        out = []
        for shape in shapes:
            if is_absent(shape):
                reason = f"{str(shape['uri'])[:200]} is not stored: upload it"
                self._dropped[f"solids of objects of kind {kind}", reason] += 1
                continue
            if str(shape.get("type")) not in sdf.SHAPES:
                self._dropped[
                    f"shapes of objects of kind {kind}", f"Gazebo does not support {str(shape.get('type'))[:40]}"
                ] += 1
                continue
            if shape["type"] in ("mesh", "heightmap"):
                file = str(shape.get("file"))
                if file not in self.resources:
                    self._dropped[f"meshes of objects of kind {kind}", f"{file[:200]} is not stored: upload it"] += 1
                    continue
                path = file if file.startswith(f"{MODELS}/") else f"{MODELS}/{file}"
                self.files[path] = self.resources[file]
                shape["uri"] = "model://" + path[len(MODELS) + 1 :]
            if shape["type"] in ("capsule", "ellipsoid"):
                self.newest = max(self.newest, (1, 8))
            try:
                sdf.geometry_element(shape, shape.get("uri"))
            except (LookupError, TypeError, ValueError):
                self._dropped[f"shapes of objects of kind {kind}", f"a {shape['type']} has no valid dimensions"] += 1
                continue
            out.append(shape)
        return out

    def _from_geometry(self, one: Feature, kind: str, elevation: float) -> tuple[list[dict[str, Any]], list[float]]:
        """Return shapes and pose of an outline in local metres (see ``app.model.obstacles``).

        No shapes if the height is unknown. Kinds that are no obstacles get a visual without a collision.
        """
        properties, geometry = one.properties, one.geometry
        if shapely.is_empty(geometry):
            return [], []
        role = obstacles.object_role(properties)
        body = (
            obstacles.object_body(properties, geometry, self._width(one), elevation=elevation)
            if role == "outline" or kind == "lift"
            else None
        )
        heights = obstacles.object_heights(properties, geometry, elevation)
        base, top = heights if body is None else (body.base, body.top)
        base = base if math.isfinite(base) else 0.0
        middle = np.round(shapely.get_coordinates(shapely.centroid(geometry))[0], 3) + 0.0
        shapes: list[dict[str, Any]] = []
        if role == "ground" and (area := obstacles.object_ground(properties, geometry)) is not None:
            height = _positive(properties.get("height"), 0.0) if kind == "floor" else 0.0
            height = height or self._measure_or_default(f"thickness of {kind}", "floor_thickness")
            shapes += _lower(_areas(_relative_to(area, middle), height), height)
        if body is not None:
            height = top - base if math.isfinite(top) else self._height(kind)
            if shapely.get_type_id(geometry) in (1, 5):
                width, square = self._width(one) or obstacles.object_width(properties) or 0.0, kind in obstacles.SQUARE
                for line in shapely.get_parts(_relative_to(geometry, middle)):
                    shapes += _segments(line, height, width, square=square)
            elif shapely.get_type_id(geometry) in (0, 4) and obstacles.box_size(properties) is None:
                radius = (self._width(one) or obstacles.object_width(properties) or 0.0) / 2
                for x, y in shapely.get_coordinates(_relative_to(geometry, middle)).tolist():
                    pose = [x, y, height / 2, 0.0, 0.0, 0.0]
                    shapes.append({"type": "cylinder", "radius": radius, "length": height, "pose": pose})
            else:
                shapes += _areas(_relative_to(body.area, middle), height)
        elif role == "mark":
            shapes += self._flat_shapes(properties, kind, _relative_to(geometry, middle), top - base)
        return shapes, [float(middle[0]), float(middle[1]), round(elevation + base, 9) + 0.0, 0.0, 0.0, 0.0]

    def _flat_shapes(self, properties: Mapping[str, Any], kind: str, flat: Any, height: float) -> list[dict[str, Any]]:
        """Return the visual shapes of an outline that is no obstacle.

        Its own height if it has one, an open door, or a plate on the ground; none for kinds that are not drawn.
        """
        if not (math.isfinite(height) and height > 0.0):
            if kind == "door":
                why = "the objects have none; doors are open and have no collision"
                height = self._measure_or_default("height of door", "door_height", why)
            elif kind in DRAWN:
                height = PLATE
                self._filled.add((f"height of {kind}", PLATE, "drawn on the ground without a collision", ""))
            else:
                return []
        shapes: list[dict[str, Any]] = []
        for part in shapely.get_parts(flat):
            if shapely.get_dimensions(part) == 2:
                shapes += _areas(part, height)
            elif shapely.get_dimensions(part) == 1:
                width = _positive(properties.get("width"), 0.0)
                width = width or self._measure_or_default(f"width of {kind}", "wall_thickness", otherwise=WALL)
                shapes += _segments(part, height, width, square=False)
        return [{**shape, "visual": True} for shape in shapes]

    def _height(self, kind: str) -> float:
        """Return the default height of a body: the top of anything that is solid for a laser."""
        return self._measure_or_default(f"height of {kind}", HEIGHTS.get(kind, "obstacle_height"))

    def _width(self, one: Feature) -> float | None:
        """Return the default width of a line or point if the options set one; reported in any case."""
        kind = str(one.properties.get("kind"))
        dimension = shapely.get_dimensions(one.geometry)
        if dimension > 1 or obstacles.has_width(one.properties) or obstacles.object_width(one.properties) is None:
            return None
        default = obstacles.object_width(one.properties) or 0.0
        if dimension == 1 and default > WALL:  # kinds wider than walls: hedge, river
            self._filled.add((f"width of {kind}", default, "the objects have none", ""))
            return None
        if dimension == 1:
            return self._measure_or_default(f"width of {kind}", "wall_thickness", otherwise=default)
        if obstacles.box_size(one.properties) is not None:
            return None
        return 2.0 * self._measure_or_default(f"radius of {kind}", "pole_radius", otherwise=default / 2)

    def _static(
        self,
        name: str,
        pose: Sequence[float],
        shapes: Sequence[Mapping[str, Any]],
        colour: str | None,
        source_properties: Any,
    ) -> etree._Element:
        """Build a static model with a collision and a visual for each shape, or only one of the two.

        colour: parameter with the colour of shapes that have none, if there is one.
        """
        model = etree.Element("model", name=name)
        if any(pose):
            model.append(sdf.pose_element(pose))
        sdf.child(model, "static", "true")
        link = sdf.child(model, "link", name="link")
        material = source_properties.get("material") if isinstance(source_properties, Mapping) else None
        for k, shape in enumerate(shapes):
            for tag in ("collision", "visual"):
                if shape.get("visual" if tag == "collision" else "unseen") is True:
                    continue
                part = sdf.child(link, tag, name=f"{tag}_{k}")
                if any(shape.get("pose", ())):
                    part.append(sdf.pose_element(shape["pose"]))
                part.append(sdf.geometry_element(shape, shape.get("uri")))
                if tag == "visual":
                    own_colour = _colour(shape)
                    if own_colour is None and colour is not None and not _is_script(material):
                        own_colour = self._colour_or_default(colour)
                    _material(part, own_colour, material)
        return model

    def _colour_or_default(self, option: str) -> str:
        """Return a colour from the options and report it as filled in."""
        value: Colour = getattr(self.usual, option)
        noun = next((kind for kind, name in COLOURS.items() if name == option), option.removesuffix("_colour"))
        self._filled.add((f"colour of {noun}", value, "no source specifies one", option))
        return f"{value[0]:g} {value[1]:g} {value[2]:g} 1"

    # --- ground and walls ----------------------------------------------------------------------------------------
    @property
    def ground_size(self) -> list[float]:
        """Return width and depth in metres of a ground under all generated objects and walls, at least 100 × 100."""
        return self._ground()[1]

    def _ground(self) -> tuple[list[float], list[float]]:
        if not self._box:
            return [0.0, 0.0], [100.0, 100.0]
        boxes = np.array(self._box)
        low, high = boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)
        middle = np.round((low + high) / 2, 3) + 0.0
        size = np.clip(np.ceil((high - low + 20.0) / 10.0) * 10.0, 100.0, MAX_GROUND_METRES)
        return [float(v) for v in middle], [float(v) for v in size]

    def ground(self) -> etree._Element:
        """Create a plane at height 0."""
        middle, size = self._ground()
        shape = {"type": "plane", "normal": [0.0, 0.0, 1.0], "size": size}
        return self._static("ground_plane", [*middle, 0.0, 0.0, 0.0, 0.0], [shape], "ground_colour", None)

    def walls(self, grid: OccupancyGrid, name: str, threshold: int, elevation: float) -> etree._Element | None:
        """Build one static model of a grid's occupied cells, with its mesh in ``models/<name>/meshes``."""
        occupied = (grid.cells >= threshold) & (grid.cells != UNKNOWN)
        if not occupied.any():
            self.context.warn(f"no cell has a value of {threshold} or more; no walls are written", where=name)
            return None
        file = f"{name}/meshes/{name}.stl"
        self.files[f"{MODELS}/{file}"] = stl(extrude(occupied, grid.resolution, self.usual.wall_height))
        self.context.fill("height of walls", self.usual.wall_height, "a grid has none", "wall_height")
        x, y, yaw = grid.origin
        corners = grid.corners()
        low, high = corners.min(axis=0), corners.max(axis=0)
        self._box.append((float(low[0]), float(low[1]), float(high[0]), float(high[1])))
        shape = {"type": "mesh", "scale": [1.0, 1.0, 1.0], "uri": f"model://{file}"}
        return self._static(name, [x, y, elevation, 0.0, 0.0, yaw], [shape], COLOURS["wall"], None)


def _colour(shape: Mapping[str, Any]) -> str | None:
    """Return a shape's own colour: three or four numbers from 0 to 1, as Gazebo reads them."""
    colour = shape.get("colour")
    if not isinstance(colour, (list, tuple)) or len(colour) not in (3, 4):
        return None
    if not all(isinstance(v, (int, float)) and not isinstance(v, bool) and 0.0 <= v <= 1.0 for v in colour):
        return None
    return sdf.format_numbers([*colour, 1.0][:4])


def _is_script(material: Any) -> bool:
    return isinstance(material, Mapping) and isinstance(material.get("name"), str)


def _material(visual: etree._Element, colour: str | None, script: Any) -> None:
    """Add the colour of a kind, or the material script that a list names."""
    if _is_script(script):
        material = sdf.child(sdf.child(visual, "material"), "script")
        uri = script.get("uri")
        if isinstance(uri, str):
            sdf.child(material, "uri", uri)
            sdf.child(material, "name", script["name"])
        else:
            sdf.child(material, "uri", "file://media/materials/scripts/gazebo.material")
            sdf.child(material, "name", f"Gazebo/{script['name']}")
    elif colour is not None:
        material = sdf.child(visual, "material")
        sdf.child(material, "ambient", colour)
        sdf.child(material, "diffuse", colour)


def _positive(value: Any, otherwise: float) -> float:
    """Return a finite number of metres (negative for a base below ground), else ``otherwise``."""
    usable = isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
    return float(value) if usable else otherwise


def _relative_to(geometry: Any, middle: NDArray[np.float64]) -> Any:
    """Convert a geometry to 2-D metres relative to a point."""
    return shapely.transform(shapely.force_2d(geometry), lambda at: at - middle)


def _lower(shapes: list[dict[str, Any]], depth: float) -> list[dict[str, Any]]:
    """Move shapes down by ``depth`` metres."""
    poses = [shape.get("pose", [0.0] * 6) for shape in shapes]
    return [{**shape, "pose": [*p[:2], p[2] - depth, *p[3:]]} for shape, p in zip(shapes, poses, strict=True)]


def _areas(area: Any, height: float) -> list[dict[str, Any]]:
    """Convert polygons to boxes if rectangular, else to rings to extrude."""
    if shapely.area(area) <= 0.0:
        return []
    if shapely.get_type_id(area) != 3:
        return [shape for part in shapely.get_parts(area) for shape in _areas(part, height)]
    corners = shapely.get_coordinates(shapely.get_exterior_ring(area))[:-1]
    if len(corners) == 4 and shapely.get_num_interior_rings(area) == 0:
        a, b = corners[1] - corners[0], corners[2] - corners[1]
        long, wide = float(np.hypot(*a)), float(np.hypot(*b))
        square = abs(float(a @ b)) <= 1e-6 * long * wide
        if square and float(np.abs(corners[0] + corners[2] - corners[1] - corners[3]).max()) <= 1e-6 * max(long, wide):
            middle = corners.mean(axis=0)
            yaw = math.atan2(float(a[1]), float(a[0]))
            pose = [float(middle[0]), float(middle[1]), height / 2, 0.0, 0.0, yaw]
            return [{"type": "box", "size": [long, wide, height], "pose": pose}]
    if not shapely.is_valid(area):
        area = shapely.make_valid(area)
    out = []
    for part in shapely.get_parts(area):
        if shapely.get_type_id(part) == 3:
            rings = [shapely.get_exterior_ring(part), *shapely.get_rings(part)[1:]]
            points: Rings = [shapely.get_coordinates(ring)[:-1].tolist() for ring in rings]
            out.append({"type": "polyline", "points": points, "height": height})
        elif shapely.get_type_id(part) == 6:
            out += [s for p in shapely.get_parts(part) for s in _areas(p, height)]
    return out


def _segments(line: Any, height: float, width: float, *, square: bool) -> list[dict[str, Any]]:
    """Convert a line to one box per segment; boxes overlap at joints.

    square: whether the line's ends are extended by half the width, too.
    """
    at = shapely.get_coordinates(line)
    steps = np.diff(at, axis=0)
    lengths = np.hypot(steps[:, 0], steps[:, 1])
    keep = np.flatnonzero(lengths > 1e-6)
    closed = len(at) > 3 and bool((at[0] == at[-1]).all())
    out = []
    for k in keep:
        along = steps[k] / lengths[k]
        before = width / 2 if square or closed or k != keep[0] else 0.0
        after = width / 2 if square or closed or k != keep[-1] else 0.0
        middle = (at[k] + at[k + 1]) / 2 + along * (after - before) / 2
        pose = [*(float(v) for v in middle), height / 2, 0.0, 0.0, math.atan2(float(along[1]), float(along[0]))]
        out.append({"type": "box", "size": [float(lengths[k]) + before + after, width, height], "pose": pose})
    return out


# --- a grid's walls ----------------------------------------------------------------------------------------------
def rectangles(occupied: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Cover the occupied cells with rectangles: int64 [n, 4], (first column, end column, first row, end row).

    Runs of equal extent in consecutive rows are joined; each cell is in exactly one rectangle. Ends are exclusive.
    """
    rows, starts, ends = _runs(occupied)
    order = np.lexsort((rows, ends, starts))
    rows, starts, ends = rows[order], starts[order], ends[order]
    new = np.ones(len(rows), bool)
    new[1:] = (starts[1:] != starts[:-1]) | (ends[1:] != ends[:-1]) | (rows[1:] != rows[:-1] + 1)
    first = np.flatnonzero(new)
    last = np.append(first[1:], len(rows)) - 1
    return np.column_stack([starts[first], ends[first], rows[first], rows[last] + 1])


def _runs(mask: NDArray[np.bool_]) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return row, first column and exclusive end column of each run of True along the rows of [h, w]."""
    change = np.zeros((mask.shape[0], mask.shape[1] + 1), bool)
    change[:, 0], change[:, -1] = mask[:, 0], mask[:, -1]
    np.not_equal(mask[:, 1:], mask[:, :-1], out=change[:, 1:-1])
    rows, columns = np.nonzero(change)
    return rows[::2], columns[::2], columns[1::2]


def extrude(occupied: NDArray[np.bool_], resolution: float, height: float) -> NDArray[np.float32]:
    """Build the outward surface of all occupied cells from 0 to this height: float32 [n, 3, 3].

    In metres from the corner of cell (0, 0). Tops and bottoms are rectangles, sides are runs of cell edges between
    occupied and other cells.
    """
    x0, x1, y0, y1 = rectangles(occupied).T
    flat = np.stack([_corner(x0, y0), _corner(x1, y0), _corner(x1, y1), _corner(x0, y1)], axis=1)
    quads = [_level(flat, 1), _level(flat[:, ::-1], 0)]
    for turned in (False, True):
        cells = occupied.T if turned else occupied
        padded = np.zeros((cells.shape[0] + 2, cells.shape[1]), bool)
        padded[1:-1] = cells
        for mask, up in ((padded[1:] & ~padded[:-1], False), (padded[:-1] & ~padded[1:], True)):
            line, start, end = _runs(mask)
            a, b = (_corner(line, start), _corner(line, end)) if turned else (_corner(start, line), _corner(end, line))
            if up != turned:
                a, b = b, a
            quads.append(np.concatenate([_level(np.stack([a, b], 1), 0), _level(np.stack([b, a], 1), 1)], axis=1))
    corners = np.concatenate(quads).astype(np.float64) * np.array([resolution, resolution, height])
    return np.asarray(corners[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3, 3), np.float32)


def _corner(x: NDArray[np.int64], y: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.column_stack([x, y])


def _level(corners: NDArray[np.int64], z: int) -> NDArray[np.int64]:
    """Extend corners [n, k, 2] to [n, k, 3] at this height."""
    return np.concatenate([corners, np.full((*corners.shape[:2], 1), z, np.int64)], axis=2)


def stl(triangles: NDArray[np.float32]) -> bytes:
    """Encode triangles float32 [n, 3, 3] as binary STL."""
    record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    out = np.zeros(len(triangles), record)
    out["corners"] = triangles
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    out["normal"] = normal / np.where(length > 0.0, length, 1.0)
    return b"\0" * 80 + struct.pack("<I", len(triangles)) + out.tobytes()

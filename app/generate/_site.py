"""Site builder: from a fence, solids, marks and a network to layers that agree with each other.

A generator adds objects with their solids, nodes, edges, zones and coloured ground to a ``Site``; ``finish`` creates
the location, the objects, the grid (the slice of these very solids), the network, the zones and an image seen from
above, and rejects contradictions. All coordinates are metres of the local frame, heights too: objects on a level start
at that level's elevation.

Stored numbers are whole millimetres and microradians, because the last bit of a sine differs between machines.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.derive import DerivationNotes
from app.derive.objects_to_occupancy import Parameters, objects_to_occupancy
from app.errors import CannotConvert, CannotGenerate, Invalid, Problem
from app.generate import MAX_CELLS, MAX_OBJECTS
from app.generate._reach import clearance, keep_largest_space, passable, unreachable_nodes
from app.generate._shapes import angle, disc, mm, orientation, rectangle, round_geometry
from app.model import raster, solids
from app.model.features import Features, Properties, features
from app.model.fences import fences
from app.model.frame import GROUND, Datum, Level
from app.model.grid import OccupancyGrid
from app.model.imagery import GeoImage
from app.model.layers import MAP, NETWORK, SITE, ZONES, Layers, Part, PartKey, Resources
from app.model.raster import RasterFrame
from app.parameters import parameter

Array = NDArray[np.float64]

NAME = "generated"
"""Family of the objects and files of a site."""

PICTURE = "satellite"

DATUM = Datum(latitude=52.4205, longitude=5.6132)
"""Default datum of a site: farmland in Flevoland, the Netherlands."""

HEIGHT = 0.2
RESOLUTIONS = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
DEFAULT_MAX_CELLS = 2**22
"""Maximum number of cells of a grid, and pixels of an image, at the finest default resolution."""

SLACK = 1.5
"""Margin in cells by which discretisation brings a path and an obstacle closer together."""

MAX_NODES = 20_000

COLOURS: Mapping[str, tuple[int, int, int]] = {
    "grass": (120, 146, 84),
    "meadow": (134, 158, 96),
    "soil": (140, 112, 82),
    "tilled": (126, 98, 70),
    "path": (186, 170, 138),
    "gravel": (172, 166, 156),
    "asphalt": (92, 92, 94),
    "concrete": (188, 186, 180),
    "paving": (170, 158, 146),
    "floor": (206, 202, 194),
    "marking": (226, 190, 60),
    "white": (232, 232, 228),
    "wall": (112, 108, 104),
    "roof": (150, 84, 66),
    "roof_dark": (98, 90, 88),
    "roof_light": (196, 192, 186),
    "crown": (58, 94, 46),
    "crown_light": (74, 112, 54),
    "crown_dark": (46, 80, 40),
    "leaf": (86, 128, 58),
    "straw": (204, 184, 120),
    "wood": (138, 104, 66),
    "metal": (150, 154, 160),
    "plastic": (214, 222, 224),
    "shelf": (60, 92, 140),
    "goods": (178, 140, 92),
    "charger": (66, 150, 110),
    "water": (82, 122, 150),
    "furniture": (150, 120, 92),
}
"""Colours of the image: red, green, blue."""

_NUMBER = {name: k for k, name in enumerate(COLOURS)}


@dataclass(frozen=True, slots=True)
class SiteOptions:
    """Parameters that every site has."""

    datum: tuple[float, float] | None = parameter(
        None,
        f"latitude,longitude of the origin; default: the environment's, else {DATUM.latitude:g},{DATUM.longitude:g}",
        minimum=-180.0,
        maximum=180.0,
        unit="°",
    )
    robot_radius: float = parameter(
        0.3, "radius of the largest robot; edges keep this distance from obstacles", minimum=0.05, maximum=5.0, unit="m"
    )
    height: float = parameter(
        HEIGHT,
        "height above the floor of the slice that becomes the grid",
        minimum=0.01,
        maximum=3.0,
        unit="m",
    )
    resolution: float | None = parameter(
        None,
        f"size of a cell; default: {RESOLUTIONS[0]}, or coarser if a grid would have more than 2^22 cells and still "
        "shows the paths",
        minimum=0.01,
        maximum=2.0,
        unit="m",
    )


def rgb(colour: str) -> list[float]:
    """Return a colour of COLOURS as in shapes."""
    return [round(v / 255, 3) for v in COLOURS[colour]]


def invalid_option_error(where: str, problem: str) -> CannotGenerate:
    """Return the error for one parameter."""
    return CannotGenerate(f"{where}: {problem}", [Problem(problem, where=where)])


class Site:
    """Site under construction.

    datum: its position. fence: the polygon that contains it (metres), the environment's or the generator's own;
    is_given states which, after ``set_fence``. coloured: solids without colour have their object's.
    """

    def __init__(
        self,
        given: Layers,
        options: SiteOptions,
        notes: DerivationNotes,
        *,
        levels: Sequence[Level] = (Level(),),
        coloured: bool = False,
    ) -> None:
        self.given, self.options, self.notes, self.levels = given, options, notes, tuple(levels)
        self.datum = _datum(given, options, notes)
        self.fence: Any = None
        self.is_given = False
        self.files: dict[str, bytes] = {}
        self._objects: dict[tuple[str, str], list[tuple[str, Any, Properties]]] = {}
        self._zones: dict[str, list[tuple[str, Any, Properties]]] = {}
        self._nodes: dict[str, tuple[str, tuple[float, float], dict[str, Any]]] = {}
        self._edges: dict[str, tuple[str, str, Any, dict[str, Any]]] = {}
        self._ground: dict[str, list[tuple[int, list[Any]]]] = {}
        self._bodies: dict[str, list[tuple[int, list[Any]]]] = {}
        self._base: dict[str, str] = {}
        self.coloured = coloured
        self._count = 0
        self._room = math.inf

    # --- the ground --------------------------------------------------------------------------------------------------

    def set_fence(self, area: Any, *, room: float = math.inf) -> Any:
        """Set the fence: the environment's if there is one (the largest of several polygons), else ``area``.

        area: a polygon in metres. room: minimum distance in metres between a robot on its path and objects beside it:
        the cells are fine enough to show it. Raises CannotGenerate if a grid of it would be too large.
        """
        self._room = room
        stored_fence = fences(self.given, self.notes.warn).get(GROUND)
        if stored_fence is not None:
            pieces = [p for p in shapely.get_parts(stored_fence) if p.geom_type == "Polygon"]
            pieces.sort(key=lambda p: (-p.area, *p.bounds))
            if len(pieces) > 1:
                self.notes.drop("polygons of the fence", len(pieces) - 1, "the site is in the largest one")
            self.fence, self.is_given = pieces[0], True
        else:
            self.fence = shapely.orient_polygons(round_geometry(area))
        _ = self.resolution
        return self.fence

    @property
    def resolution(self) -> float:
        """Return the cell size in metres. Raises CannotGenerate if there would be too many cells."""
        box = self.fence.bounds
        easy = next((r for r in RESOLUTIONS if _cells(box, r) <= DEFAULT_MAX_CELLS), RESOLUTIONS[-1])
        fine = max((r for r in RESOLUTIONS if SLACK * r <= self._room + 1e-9), default=RESOLUTIONS[0])
        size = self.options.resolution or min(easy, fine)
        if _cells(box, size) * len(self.levels) > MAX_CELLS:
            side = f"{box[2] - box[0]:.0f} × {box[3] - box[1]:.0f} m"
            raise invalid_option_error(
                "resolution",
                f"{side} on {len(self.levels)} levels would be more than {MAX_CELLS} cells of {size:g} m: use a "
                "coarser resolution or a smaller site",
            )
        return size

    def draw(self, shape: Any, colour: str, *, level: str = GROUND) -> None:
        """Paint ground in the image, over previous paint. shape: polygons or lines."""
        self._ground.setdefault(level, []).append((_NUMBER[colour], _coordinates_list(shape)))

    # --- objects ----------------------------------------------------------------------------------------------------

    def add_object(
        self,
        i: str,
        kind: str,
        geometry: Any,
        *,
        shapes: Sequence[Mapping[str, Any]] = (),
        pose: Sequence[float] | None = None,
        level: str = GROUND,
        colour: str | None = None,
        seen: Any = None,
        family: str = NAME,
        **words: Any,
    ) -> None:
        """Add an object. shapes: its solids (``app.model.solids``), in the frame of its pose (x, y, z, yaw).

        colour: of its geometry in the image, or of ``seen`` if that differs (a crown over a trunk). family: the name of
        its part, for formats that read only their own (walls, doors and lifts: ``openrmf``).
        """
        self._count += 1
        if self._count > MAX_OBJECTS:
            raise CannotGenerate(f"the site has more than {MAX_OBJECTS} objects: make it smaller")
        properties: dict[str, Any] = {"kind": kind, **words}
        if pose is not None:
            x, y, z, yaw = pose
            properties["pose"] = [mm(x), mm(y), mm(z), 0.0, 0.0, angle(yaw)]
        if shapes:
            tint = {"colour": rgb(colour)} if self.coloured and colour is not None else {}
            properties["shapes"] = [{**_plain(shape), **({} if "colour" in shape else tint)} for shape in shapes]
        self._objects.setdefault((level, family), []).append((i, round_geometry(geometry), properties))
        if colour is not None:
            shape = geometry if seen is None else seen
            self._bodies.setdefault(level, []).append((_NUMBER[colour], _coordinates_list(shape)))

    def box(
        self,
        i: str,
        kind: str,
        at: Sequence[float],
        size: Sequence[float],
        *,
        yaw: float = 0.0,
        base: float = 0.0,
        level: str = GROUND,
        **words: Any,
    ) -> None:
        """Add a box on the ground: centre (x, y), size (x, y, z), base in metres above the level's floor."""
        x, y, z = (mm(v) for v in size)
        shape: dict[str, Any] = {"type": "box", "size": [x, y, z], "pose": [0.0, 0.0, mm(z / 2), 0.0, 0.0, 0.0]}
        self.add_object(
            i,
            kind,
            rectangle(at[0], at[1], yaw, x, y),
            shapes=[shape],
            pose=(at[0], at[1], self.elevation(level) + base, yaw),
            level=level,
            size=[x, y, z],
            **words,
        )

    def post(
        self,
        i: str,
        kind: str,
        at: Sequence[float],
        radius: float,
        height: float,
        *,
        level: str = GROUND,
        **words: Any,
    ) -> None:
        """Add an upright cylinder on the ground at (x, y)."""
        r, h = mm(radius), mm(height)
        shape = {"type": "cylinder", "radius": r, "length": h, "pose": [0.0, 0.0, mm(h / 2), 0.0, 0.0, 0.0]}
        point = shapely.Point(at[0], at[1])
        pose = (at[0], at[1], self.elevation(level), 0.0)
        words = {"seen": disc(at[0], at[1], radius), "width": mm(2 * r), "height": h, **words}
        self.add_object(i, kind, point, shapes=[shape], pose=pose, level=level, **words)

    def mark(self, i: str, kind: str, geometry: Any, *, level: str = GROUND, **words: Any) -> None:
        """Add an object without a body: a region, a point of interest."""
        self.add_object(i, kind, geometry, level=level, **words)

    def zone(self, i: str, kind: str, polygon: Any, *, level: str = GROUND, **words: Any) -> None:
        """Add a zone: keepout, speed …"""
        self._zones.setdefault(level, []).append((i, round_geometry(polygon), {"kind": kind, **words}))

    def elevation(self, level: str) -> float:
        """Return the elevation of a level's floor in metres."""
        return next(candidate.elevation for candidate in self.levels if candidate.name == level)

    # --- the network -------------------------------------------------------------------------------------------------

    def node(self, name: str, at: Sequence[float], *, yaw: float = 0.0, level: str = GROUND, **words: Any) -> str:
        """Add a node; its name is its id."""
        if name in self._nodes or name in self._edges:
            raise ValueError(f"duplicate node name {name!r}")
        if len(self._nodes) >= MAX_NODES:
            raise CannotGenerate(f"the network has more than {MAX_NODES} nodes: make the site smaller")
        properties = {"kind": "node", "name": name, "orientation": orientation(yaw), **words}
        self._nodes[name] = (level, (mm(at[0]), mm(at[1])), properties)
        return name

    def add_edges(
        self,
        a: str,
        b: str,
        *,
        action: str = "move_base",
        speed: float | None = None,
        both: bool = True,
        bends: Sequence[Sequence[float]] = (),
        **words: Any,
    ) -> None:
        """Add an edge from a to b, and one back. bends: points between.

        Between levels it is a lift or stairs, and is not checked against a grid.
        """
        at = [self._nodes[a][1], *((mm(x), mm(y)) for x, y in bends), self._nodes[b][1]]
        for source, target, line in ((a, b, at), (b, a, at[::-1])) if both else ((a, b, at),):
            i = f"{source}_{target}"
            if i in self._edges or i in self._nodes:
                raise ValueError(f"duplicate edge id {i!r}")
            properties: dict[str, Any] = {"kind": "edge", "source": source, "target": target, "action": action, **words}
            if speed is not None:
                properties["speed_limit"] = speed
            self._edges[i] = (source, target, shapely.LineString(line), properties)

    def position(self, name: str) -> tuple[float, float]:
        """Return the position of a node."""
        return self._nodes[name][1]

    # --- result -----------------------------------------------------------------------------------------------------

    def finish(self, *, ground: str = "grass") -> Layers:
        """Return the layers. ground: colour of unpainted ground.

        Raises CannotGenerate if there is no obstacle at the height of the slice. An edge that a robot cannot follow, or
        a node that cannot be reached, is an error of the generator: RuntimeError.
        """
        if self.fence is None:
            raise ValueError("call set_fence() first")
        parts: dict[PartKey, Part] = {k: p for k, p in self.given.parts.items() if k.layer == "location"}
        if not self.is_given:
            ring = [("fence", self.fence, {"kind": "fence"})]
            parts[PartKey("location", GROUND, SITE)] = features(ring, "local")
        for (level, family), rows in self._objects.items():
            parts[PartKey("objects", level, family)] = features(rows, "local")
        if self.files:
            parts[PartKey("resources", GROUND, NAME)] = Resources(dict(sorted(self.files.items())))
        grids = self._grids(parts)
        parts.update(grids)
        self._check_zones()
        for level, rows in self._zones.items():
            parts[PartKey("zones", level, ZONES)] = features(rows, "local")
        widths = self._check_edges(grids)
        for level in {level for level, _, _ in self._nodes.values()}:
            nodes = [
                (i, shapely.Point(at), properties)
                for i, (node_level, at, properties) in self._nodes.items()
                if node_level == level
            ]
            edges = [
                (i, line, {**properties, **({"width": widths[i]} if i in widths else {})})
                for i, (a, _, line, properties) in self._edges.items()
                if self._nodes[a][0] == level
            ]
            parts[PartKey("topology", level, NETWORK)] = features([*nodes, *edges], "local")
        for level in (level.name for level in self.levels):
            parts[PartKey("imagery", level, PICTURE)] = self._picture(level, ground)
        return Layers(dict(sorted(parts.items())), self.datum, self.levels)

    def _grids(self, parts: Mapping[PartKey, Part]) -> dict[PartKey, Part]:
        """Return the slice of the objects on each level, of which one connected piece stays free."""
        resolution = self.resolution
        if self.options.resolution is None and resolution != RESOLUTIONS[0]:
            why = f"{RESOLUTIONS[0]} m would be more than {DEFAULT_MAX_CELLS} cells; a finer one can be set"
            self.notes.fill("resolution", resolution, why)
        grid_parameters = Parameters(height=self.options.height, resolution=resolution)
        grid_notes = DerivationNotes()
        grid_parts = {k: p for k, p in parts.items() if k.layer != "location"}
        for key, part in parts.items():
            if isinstance(part, Features) and key.layer == "objects":
                grid_parts[key] = self._below_height(part, self.elevation(key.level) + self.options.height)
        grid_parts[PartKey("location", GROUND, SITE)] = features([("fence", self.fence, {"kind": "fence"})], "local")
        try:
            grid_layers = objects_to_occupancy(Layers(grid_parts, self.datum, self.levels), grid_parameters, grid_notes)
        except CannotConvert as error:
            raise CannotGenerate(error.detail, error.problems) from error
        self.notes.warnings += grid_notes.warnings
        out: dict[PartKey, Part] = {}
        for key, grid in grid_layers.grids().items():
            cells, closed = keep_largest_space(grid.cells)
            if closed:
                area = round(closed * grid.resolution**2, 2)
                self.notes.drop("free cells", closed, f"{area:g} m² on {key.level} cannot be reached; they are unknown")
            properties = {"slice": {"of": "objects", "height": self.options.height}}
            out[PartKey("occupancy", key.level, MAP)] = OccupancyGrid(
                cells, grid.resolution, grid.origin, properties=properties
            )
        return out

    def _below_height(self, part: Features, z: float) -> Features:
        """Return the objects without solids that do not reach a height: crowns above a slice are most of a forest."""
        solid_reader = solids.Solids(self.files)
        radii: dict[str, float] = {}
        rows: list[int] = []
        properties: list[Properties] = []
        for k, p in enumerate(part.properties):
            shapes = p.get("shapes")
            if shapes:
                base = p["pose"][2] if "pose" in p else 0.0
                near = [shape for shape in shapes if _reaches(shape, z - base, solid_reader, radii)]
                if not near:
                    continue
                properties.append({**p, "shapes": near} if len(near) < len(shapes) else p)
            else:
                properties.append(p)
            rows.append(k)
        index = np.array(rows, np.intp)
        return Features(tuple(part.ids[k] for k in rows), part.geometry[index], tuple(properties), part.local[index])

    def _check_zones(self) -> None:
        """Check that no edge leads through a keep-out zone."""
        for level, rows in self._zones.items():
            shut = [polygon for _, polygon, properties in rows if properties["kind"] == "keepout"]
            level_edges = [(i, e[2]) for i, e in self._edges.items() if self._nodes[e[0]][0] == level]
            if shut and level_edges:
                lines = np.array([line for _, line in level_edges], object)
                hits = shapely.STRtree(lines).query(np.array(shut, object), predicate="intersects")[1]
                if len(hits):
                    raise RuntimeError(f"the edge {level_edges[int(hits[0])][0]} leads through a keep-out zone")

    def _check_edges(self, grids: Mapping[PartKey, Part]) -> dict[str, float]:
        """Return the free width of each edge in metres.

        Raises RuntimeError if a robot cannot follow one, or cannot reach a node.
        """
        edges = [(a, b) for a, b, _, _ in self._edges.values()]
        for start, directed in ((0, edges), (1, [(b, a) for a, b in edges])):
            lost = unreachable_nodes(list(self._nodes), directed)
            if lost:
                direction = "to" if start == 0 else "from"
                raise RuntimeError(f"no path {direction} {len(lost)} of the nodes, such as {', '.join(lost[:5])}")
        out: dict[str, float] = {}
        for key, grid in grids.items():
            if not isinstance(grid, OccupancyGrid):
                continue
            level_edges = [i for i, e in self._edges.items() if {self._nodes[n][0] for n in e[:2]} == {key.level}]
            lines = [self._edges[i][2] for i in level_edges]
            stands = [shapely.Point(at) for level, at, _ in self._nodes.values() if level == key.level]
            good = passable(grid, [*lines, *stands], self.options.robot_radius)
            if not good.all():
                k = int(np.flatnonzero(~good)[0])
                label = f"the edge {level_edges[k]}" if k < len(level_edges) else "a node"
                raise RuntimeError(f"{label} is nearer to an obstacle than {self.options.robot_radius:g} m")
            out |= dict(zip(level_edges, clearance(grid, lines).tolist(), strict=True))
        return out

    def _picture(self, level: str, ground: str) -> GeoImage:
        """Paint the level from above."""
        box = self.fence.bounds
        resolution = next((r for r in RESOLUTIONS if _cells(box, r) <= DEFAULT_MAX_CELLS), RESOLUTIONS[-1])
        frame = RasterFrame.from_box(box, resolution)
        index = np.full((frame.height, frame.width), _NUMBER[ground], np.uint8)
        for rows in (self._ground.get(level, []), self._bodies.get(level, [])):
            for number, shapes in _runs(rows):
                raster.paint(index, raster.areas(shapes, frame, touched=False), number)
        table = np.array(list(COLOURS.values()), np.uint8)
        left, bottom = frame.origin
        top = round(bottom + frame.height * resolution, 9)
        return GeoImage(table[index[::-1]], (resolution, 0.0, left, 0.0, -resolution, top))


# --- the grid ---------------------------------------------------------------------------------------------------------


def _cells(box: Sequence[float], resolution: float) -> float:
    return (box[2] - box[0] + resolution) * (box[3] - box[1] + resolution) / resolution**2


# --- small things -----------------------------------------------------------------------------------------------------


def _datum(given: Layers, options: SiteOptions, notes: DerivationNotes) -> Datum:
    """Return the environment's datum, else the requested one, else DATUM."""
    option_datum = None if options.datum is None else Datum(options.datum[0], options.datum[1])
    if given.datum is not None:
        if option_datum is not None and (option_datum.latitude, option_datum.longitude) != (
            given.datum.latitude,
            given.datum.longitude,
        ):
            reason = "the environment already has a datum: omit this, or change the datum with PATCH"
            raise Invalid(f"datum: {reason}", [Problem(reason, where="datum")])
        return given.datum
    if option_datum is None:
        notes.fill(
            "datum", DATUM.as_dict(), "neither the environment nor the parameter datum states the site's position"
        )
    return option_datum or DATUM


def _reaches(shape: Mapping[str, Any], z: float, solid_reader: solids.Solids, radii: dict[str, float]) -> bool:
    """Return whether a shape may reach a height in its object's frame (z upright); never False if it does."""
    kind = shape["type"]
    if kind == "box":
        radius = math.hypot(*shape["size"]) / 2
    elif kind in ("cylinder", "capsule"):
        radius = math.hypot(shape["radius"], shape["length"] / 2) + (shape["radius"] if kind == "capsule" else 0.0)
    elif kind == "mesh" and "center" not in shape:
        if shape["file"] not in radii:
            vertices = solid_reader.mesh(shape["file"]).vertices
            radii[shape["file"]] = float(np.linalg.norm(vertices, axis=1).max())
        radius = radii[shape["file"]] * max(map(abs, shape.get("scale", (1.0, 1.0, 1.0))))
    else:
        return True
    middle = shape["pose"][2] if "pose" in shape else 0.0
    return bool(abs(z - middle) <= radius + 0.001)


def _coordinates_list(shape: Any) -> list[Any]:
    return list(shape) if isinstance(shape, (list, tuple, np.ndarray)) else [shape]


def _plain(shape: Mapping[str, Any]) -> dict[str, Any]:
    """Return whether a shape has no pose, or a neutral one."""
    return {key: value for key, value in shape.items() if key != "pose" or any(value)}


def _runs(rows: Iterable[tuple[int, list[Any]]]) -> Iterable[tuple[int, list[Any]]]:
    """Group consecutive shapes of one colour."""
    current: tuple[int, list[Any]] | None = None
    for number, shapes in rows:
        if current is not None and current[0] == number:
            current[1].extend(shapes)
            continue
        if current is not None:
            yield current
        current = (number, list(shapes))
    if current is not None:
        yield current

"""Made-up maps, on which docs/images/derived-maps.png shows what is derived.

Offices of the generator as their own grid, as a robot would scan them, as architects draw them, with walls as two
lines, and coloured for visitors; and a cluttered hall. Lengths are in metres.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray

from app import generate
from app.derive import DerivationNotes
from app.model.features import Features
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.imagery import GeoImage
from app.model.layers import MAP, Layers, PartKey

SEED, GROUND = 7, "ground"
PIXEL = 0.05
"""Size of a pixel of plans and of a cell of scans."""

MARGIN = 1.5
"""Paper around a plan."""

BEAMS, REACH, NOISE = 1440, 12.0, 0.02
"""Beams of a scan, their reach, and the standard deviation of their lengths."""

TINTS = ((225, 205, 245), (205, 225, 250), (255, 228, 208), (214, 236, 214), (240, 232, 214))
"""Red, green and blue of the rooms of a coloured plan."""


def cases() -> Iterator[tuple[str, str, Layers]]:
    """Yield titles, derivations, and the layers that these get."""
    office = _grid(make_site("office", levels=1))
    small = make_site("office", levels=1, length=14.0)
    yield "Network of an office's grid", "occupancy_to_topology", _layers(office)
    yield "Rooms (blue), corridors (green) and doors (red) of the same grid", "occupancy_to_zones", _layers(office)
    yield "Network of a cluttered hall", "occupancy_to_topology", _layers(_grid(make_site("cluttered_hall")))
    yield "Grid of a plan with walls of two lines", "imagery_to_occupancy", _picture(double_line_plan(small))
    yield "Grid of a coloured plan", "imagery_to_occupancy", _picture(visitor_plan(small))
    title = "Objects of a scan: walls (blue), furniture (orange), posts (green) and other obstacles (grey)"
    yield title, "occupancy_to_objects", _layers(scan(office))


def make_site(generator: str, **options: Any) -> Layers:
    """Return a made-up site."""
    return generate.run(generator, SEED, options, Layers({}), DerivationNotes())


def _grid(site: Layers) -> OccupancyGrid:
    grid = site.parts[PartKey("occupancy", GROUND, MAP)]
    assert isinstance(grid, OccupancyGrid)
    return grid


def _layers(grid: OccupancyGrid) -> Layers:
    return Layers({PartKey("occupancy", GROUND, MAP): grid})


def _picture(pixels: NDArray[np.uint8]) -> Layers:
    image = GeoImage(pixels, (PIXEL, 0.0, 0.0, 0.0, -PIXEL, len(pixels) * PIXEL))
    return Layers({PartKey("imagery", GROUND, "plan"): image})


class _Paper:
    """White paper for the objects of a site: pixels uint8 [h, w, 3]."""

    def __init__(self, site: Layers) -> None:
        self.objects = [
            feature
            for key, part in site.parts.items()
            if key.layer == "objects" and key.level == GROUND and isinstance(part, Features)
            for feature in part
        ]
        self.walls = [_ground(f) for f in self.objects if f.properties["kind"] == "wall"]
        self.doors = [f.geometry for f in self.objects if f.properties["kind"] == "door"]
        around = shapely.total_bounds(self.walls)
        self.corner = around[:2] - MARGIN
        width, height = np.ceil((around[2:] + MARGIN - self.corner) / PIXEL).astype(int)
        self.pixels = np.full((height, width, 3), 255, np.uint8)

    def at(self, shape: Any) -> NDArray[np.int32]:
        """Return the positions of a shape in pixels: x, y [n, 2]."""
        x, y = ((shapely.get_coordinates(shape) - self.corner) / PIXEL).T
        return np.column_stack([np.rint(x), np.rint(len(self.pixels) - 1 - y)]).astype(np.int32)

    def outlines(self, shape: Any, shade: int) -> None:
        """Draw the rings of an area as lines of a pixel."""
        for ring in shapely.get_rings(shapely.get_parts(shape)):
            cv2.polylines(self.pixels, [self.at(ring)], True, (shade,) * 3, 1, cv2.LINE_AA)

    def furniture(self) -> Iterator[Any]:
        """Yield the ground that furniture covers."""
        for feature in self.objects:
            if feature.properties["kind"] not in ("wall", "door", "floor", "lift", "region"):
                yield _ground(feature)

    def text(self, words: str, at: Any, size: float = 0.45) -> None:
        """Write words with their middle at a point."""
        ((x, y),) = self.at(at)
        (width, height), _ = cv2.getTextSize(words, cv2.FONT_HERSHEY_SIMPLEX, size, 1)
        place = (int(x - width / 2), int(y + height / 2))
        cv2.putText(self.pixels, words, place, cv2.FONT_HERSHEY_SIMPLEX, size, (60, 60, 60), 1, cv2.LINE_AA)


def _ground(feature: Any) -> Any:
    """Return the ground that an object covers."""
    shape = feature.geometry
    width = feature.properties.get("width", 0.1)
    if shape.geom_type == "LineString":
        return shapely.buffer(shape, width / 2, cap_style="square")
    return shapely.buffer(shape, width / 2) if shape.geom_type == "Point" else shape


def _rooms(paper: _Paper) -> list[Any]:
    """Return the rooms between the walls, with doors closed."""
    closed = shapely.union_all([*paper.walls, *(shapely.buffer(door, 0.1, cap_style="square") for door in paper.doors)])
    holes = [shapely.Polygon(ring) for part in shapely.get_parts(closed) for ring in part.interiors]
    return [hole for hole in holes if hole.area > 1.0]


def double_line_plan(site: Layers) -> NDArray[np.uint8]:
    """Draw walls as two lines, with the furniture, the swings of the doors and dimensions: uint8 [h, w, 3]."""
    paper = _Paper(site)
    for item in paper.furniture():
        paper.outlines(item, 90)
    for door in paper.doors:
        ends = shapely.get_coordinates(door)
        radius = math.dist(*ends)
        first = math.atan2(*(ends[1] - ends[0])[::-1])
        turn = first + np.linspace(0.0, math.pi / 2, 12)
        swing = ends[0] + radius * np.column_stack([np.cos(turn), np.sin(turn)])
        line = paper.at(shapely.LineString([*swing, ends[0]]))
        cv2.polylines(paper.pixels, [line], False, (90,) * 3, 1, cv2.LINE_AA)
    walls = shapely.union_all(paper.walls)
    inside = np.zeros(paper.pixels.shape[:2], np.uint8)
    for wall in shapely.get_parts(walls):
        cv2.fillPoly(inside, [paper.at(ring) for ring in shapely.get_rings(wall)], 1)
    paper.pixels[inside == 1] = 255  # lines of furniture end at walls
    paper.outlines(walls, 0)
    for k, room in enumerate(_rooms(paper), 1):
        paper.text(f"R{k}", shapely.point_on_surface(room))
    return paper.pixels


def visitor_plan(site: Layers) -> NDArray[np.uint8]:
    """Draw thick walls around tinted rooms with names and symbols, as for visitors: uint8 [h, w, 3]."""
    paper = _Paper(site)
    rooms = _rooms(paper)
    for k, room in enumerate(rooms):
        cv2.fillPoly(paper.pixels, [paper.at(shapely.buffer(room, 0.1).exterior)], TINTS[k % len(TINTS)])
    for wall in paper.walls:
        cv2.fillPoly(paper.pixels, [paper.at(shapely.buffer(wall, 0.05, join_style="mitre"))], (70, 62, 96))
    for k, room in enumerate(rooms, 1):
        middle = shapely.point_on_surface(room)
        paper.text(f"Room {k}", middle)
        symbol = paper.at(shapely.Point(middle.x, middle.y + 0.75))[0].tolist()
        cv2.circle(paper.pixels, symbol, 7, (60, 120, 170), -1, cv2.LINE_AA)
        cv2.putText(paper.pixels, "i", (symbol[0] - 2, symbol[1] + 4), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255,) * 3, 1)
    paper.text("VISITORS", shapely.Point(paper.corner[0] + 4.0, paper.corner[1] + 0.7), 0.8)
    return paper.pixels


def scan(grid: OccupancyGrid) -> OccupancyGrid:
    """Return what a laser scanner sees of a grid from places 2 m apart: ends of beams, free ground before them."""
    random = np.random.default_rng(SEED)
    occupied = grid.cells == OCCUPIED
    height, width = occupied.shape
    room = cv2.distanceTransform(1 - occupied.astype(np.uint8), cv2.DIST_L2, 3) > 0.5 / grid.resolution
    room &= grid.cells == FREE
    step = round(2.0 / grid.resolution)
    places = np.argwhere(room[::step, ::step]) * step
    along = (np.arange(BEAMS) + 0.5) * (math.tau / BEAMS)
    reach = np.arange(1, REACH / grid.resolution * 2) / 2  # half a cell a step
    seen, hit = np.zeros((2, height, width), bool)

    def cells_at(row: int, column: int, far: NDArray[Any], beams: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        y = row + 0.5 + np.sin(beams) * far
        x = column + 0.5 + np.cos(beams) * far
        return np.clip(y.astype(int), 0, height - 1), np.clip(x.astype(int), 0, width - 1)

    for row, column in places.tolist():
        y, x = cells_at(row, column, reach, along[:, None])
        stops = grid.cells[y, x] != FREE
        end = np.where(stops.any(axis=1), stops.argmax(axis=1), len(reach))
        before = np.arange(len(reach)) < end[:, None] - 1
        seen[y[before], x[before]] = True
        beams = np.flatnonzero(end < len(reach))
        beams = beams[occupied[y[beams, end[beams]], x[beams, end[beams]]]]
        far = reach[end[beams]] + random.normal(0.0, NOISE / grid.resolution, len(beams))
        hit[cells_at(row, column, far, along[beams])] = True
    cells = np.full(grid.cells.shape, UNKNOWN, np.uint8)
    cells[seen] = FREE
    cells[hit] = OCCUPIED
    return OccupancyGrid(cells, grid.resolution, grid.origin)

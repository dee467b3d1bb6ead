"""Storeys of a building: rooms on both sides of a corridor, with walls, doors, and a lift at the corridor's end.

Drawn in metres with the corridor along u, then moved to its ``SiteFrame``. Walls, doors, floors and the lift are
objects in the terms of Open-RMF's building maps (part ``openrmf``), with the solids that simulators and grids need;
doors are open. Furniture keeps clear of the path from the door to the room's node.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely

from app.generate._shapes import angle, mm
from app.generate._site import Site
from app.generate._site_frame import SiteFrame

FAMILY = "openrmf"
WALL, PARTITION, SHELL = 0.12, 0.1, 0.24
"""Thickness in metres of a corridor's walls, of those between rooms, and of the outer ones."""

DOOR_HEIGHT = 2.1

SHAFT, CABIN, LIFT_DOOR = 2.4, 1.9, 1.2
"""Side of a lift's shaft, side of its cabin, and width of its doors, in metres."""


@dataclass(frozen=True, slots=True)
class Storeys:
    """Measures of a building, in metres.

    Attributes:
        length: of the corridor.
        depth: of the rooms on each side of it.
        least, most: widths of rooms.
        door: width of the rooms' doors.
        height: from floor to floor.
    """

    levels: int
    length: float
    depth: float
    corridor: float
    least: float
    most: float
    door: float
    height: float
    lift: bool


@dataclass(frozen=True, slots=True)
class Room:
    """Room of a building.

    Attributes:
        box: (u0, v0, u1, v1) inside its walls.
        door: u of its door.
        side: 1 if it is above the corridor, else -1.
        open: whether it has no wall to the corridor.
    """

    name: str
    kind: str
    level: str
    box: tuple[float, float, float, float]
    door: float
    side: int
    open: bool = False

    @property
    def depth(self) -> float:
        """Return the distance in metres from the corridor's wall to the outer one."""
        return self.box[3] - self.box[1]

    def position(self, along: float, inward: float) -> tuple[float, float]:
        """Return a point by metres from the room's left wall, and from the corridor's side."""
        v = self.box[1] + inward if self.side > 0 else self.box[3] - inward
        return self.box[0] + along, v


@dataclass(slots=True)
class Building:
    """Building that is being drawn into a site."""

    site: Site
    place: SiteFrame
    measures: Storeys
    radius: float
    rooms: list[Room] = field(default_factory=list)
    _count: dict[str, int] = field(default_factory=dict)

    def number(self, kind: str) -> int:
        """Return the next number of a kind of object, from 1."""
        self._count[kind] = self._count.get(kind, 0) + 1
        return self._count[kind]

    # walls, doors, floors, the lift

    def wall(
        self,
        level: str,
        a: tuple[float, float],
        b: tuple[float, float],
        thickness: float,
        openings: Iterable[tuple[float, float]] = (),
    ) -> None:
        """Add a wall from a to b, except openings (centre, width), metres from a along it."""
        length = math.dist(a, b)
        cuts = sorted((middle - width / 2, middle + width / 2) for middle, width in openings)
        starts = [0.0, *(end for _, end in cuts)]
        ends = [*(start for start, _ in cuts), length]
        for start, end in zip(starts, ends, strict=True):
            if end - start < 0.02:
                continue
            # the ends of the complete wall extend by half a wall, so that corners close
            low = start - (thickness / 2 if start == 0.0 else 0.0)
            high = end + (thickness / 2 if end == length else 0.0)
            self._piece(level, _along(a, b, start), _along(a, b, end), start - low, high - end, thickness)

    def _piece(
        self,
        level: str,
        a: tuple[float, float],
        b: tuple[float, float],
        before: float,
        after: float,
        thickness: float,
    ) -> None:
        a, b = self.place.to_local(*a), self.place.to_local(*b)
        yaw = angle(math.atan2(b[1] - a[1], b[0] - a[0]))
        long, high = math.dist(a, b), self.measures.height
        size = [mm(long + before + after), mm(thickness), mm(min(high - 0.2, 3.0))]
        shape = {"type": "box", "size": size, "pose": [mm((after - before) / 2), 0.0, mm(size[2] / 2), 0.0, 0.0, 0.0]}
        line = shapely.LineString([a, b])
        self.site.add_object(
            f"{level}/wall/{self.number(level + 'wall')}",
            "wall",
            line,
            shapes=[shape],
            pose=((a[0] + b[0]) / 2, (a[1] + b[1]) / 2, self.site.elevation(level), yaw),
            level=level,
            width=size[1],
            height=size[2],
            colour="wall",
            seen=shapely.buffer(line, thickness / 2, cap_style="square"),
            family=FAMILY,
            openrmf={"parameters": {}},
        )

    def door(
        self, level: str, name: str, middle: tuple[float, float], width: float, along: float, kind: str = "hinged"
    ) -> None:
        """Add an open door. along: direction of its wall, radians in the drawing."""
        c, s = round(math.cos(along), 12), round(math.sin(along), 12)
        ends = [self.place.to_local(middle[0] + k * c * width / 2, middle[1] + k * s * width / 2) for k in (-1, 1)]
        x, y = self.place.to_local(*middle)
        leaf = {
            "type": "box",
            "size": [mm(width), 0.04, DOOR_HEIGHT],
            "pose": [0.0, 0.0, DOOR_HEIGHT / 2, 0.0, 0.0, 0.0],
            "visual": True,
        }
        parameters = {
            "motion_axis": [1, "start"],
            "motion_degrees": [3, 90.0],
            "motion_direction": [2, 1],
            "type": [1, kind],
            "name": [1, name],
        }
        self.site.add_object(
            f"{level}/door/{name}",
            "door",
            shapely.LineString(ends),
            shapes=[leaf],
            pose=(x, y, self.site.elevation(level), along + self.place.yaw),
            level=level,
            name=name,
            width=mm(width),
            family=FAMILY,
            openrmf={"parameters": parameters},
        )

    def floor(self, level: str, area: Any, colour: str = "floor") -> None:
        """Add a slab with its top at the level's elevation."""
        polygon = self.place.geometry_to_local(area)
        x, y = (mm(v) for v in shapely.get_coordinates(shapely.centroid(polygon))[0])
        corners = shapely.get_coordinates(shapely.get_exterior_ring(polygon))[:-1] - np.array([x, y])
        ring = (np.round(corners, 3) + 0.0).tolist()
        self.site.add_object(
            f"{level}/floor/{self.number(level + 'floor')}",
            "floor",
            polygon,
            shapes=[{"type": "polyline", "points": [ring], "height": 0.1}],
            pose=(x, y, self.site.elevation(level) - 0.1, 0.0),
            level=level,
            family=FAMILY,
            openrmf={"parameters": {}},
        )
        self.site.draw(polygon, colour, level=level)

    def lift(self, name: str, levels: Sequence[str], middle: tuple[float, float]) -> None:
        """Add a lift that serves these levels, its doors towards larger u."""
        x, y = self.place.to_local(*middle)
        door = f"{name}_door"
        says = {
            "depth": CABIN,
            "doors": {
                door: {
                    "door_type": 2,
                    "motion_axis_orientation": 0.0,
                    "width": LIFT_DOOR,
                    "x": 0.0,
                    "y": -CABIN / 2,
                }
            },
            "highest_floor": levels[-1],
            "initial_floor_name": levels[0],
            "level_doors": {level: [door] for level in levels},
            "lowest_floor": levels[0],
            "plugins": True,
            "reference_floor_name": levels[0],
        }
        plate = {"type": "box", "size": [CABIN, CABIN, 0.02], "pose": [0.0, 0.0, 0.01, 0.0, 0.0, 0.0], "visual": True}
        # its doors are on the side of negative y, as the editor draws a new lift
        self.site.add_object(
            f"{levels[0]}/lift/{name}",
            "lift",
            shapely.Point(x, y),
            shapes=[plate],
            pose=(x, y, self.site.elevation(levels[0]), self.place.yaw + math.pi / 2),
            level=levels[0],
            name=name,
            size=[CABIN, CABIN, 2.5],
            family=FAMILY,
            openrmf={"says": {key: value for key, value in says.items() if key != "depth"}},
        )

    # objects in rooms

    def furnish(self, room: Room, goal: tuple[float, float]) -> Furniture:
        """Return the furnisher of a room whose node is at ``goal`` (metres along and inward)."""
        along = room.door - room.box[0]
        path = shapely.LineString(
            [room.position(along, -PARTITION), room.position(along, self.radius + 0.5), room.position(*goal)]
        )
        keep = self.radius + 3 * self.site.resolution + 0.1
        return Furniture(self, room, shapely.buffer(path, keep, cap_style="square"))

    def charger(self, things: Furniture, goal: tuple[float, float]) -> None:
        """Add a charger at the room's outer wall behind its node, and the place before it, if there is room."""
        room, depth, keep = things.room, 0.3, self.radius + 3 * self.site.resolution + 0.1
        inward = room.depth - 0.05 - depth - keep
        if inward < goal[1] + 0.3:
            return
        k = self.number("dock")
        things.add_item("charger", goal[0], room.depth - 0.03 - depth / 2, (0.5, depth, 0.6), "charger", gap=0.0)
        path = shapely.LineString([room.position(*goal), room.position(goal[0], inward)])
        things.occupied = shapely.union(things.occupied, shapely.buffer(path, keep))
        at = self.place.to_local(*room.position(goal[0], inward))
        words = {"openrmf": {"parameters": {"is_charger": [4, True], "is_parking_spot": [4, True]}}}
        yaw = self.place.yaw + room.side * math.pi / 2
        self.site.add_edges(room.name, self.site.node(f"dock_{k}", at, yaw=yaw, level=room.level, **words), speed=0.3)


@dataclass(slots=True)
class Furniture:
    """Furnisher that places objects into one room where there is free space."""

    building: Building
    room: Room
    occupied: Any

    def fits(self, area: Any) -> bool:
        """Return whether this area (drawn metres) is free and in the room."""
        return bool(shapely.contains(shapely.box(*self.room.box), area)) and not shapely.intersects(self.occupied, area)

    def add_item(
        self,
        kind: str,
        along: float,
        inward: float,
        size: tuple[float, float, float],
        colour: str,
        *,
        style: str = "box",
        gap: float = 0.05,
    ) -> bool:
        """Place an object centred there, ``size`` along the corridor, inwards and up; False if there is no free space.

        style: ``box``; ``desk``: a top on two side panels; ``table``: a top on a foot; ``bed``: on a lower frame.
        """
        u, v = self.room.position(along, inward)
        x, y, z = size
        area = shapely.box(u - x / 2, v - y / 2, u + x / 2, v + y / 2)
        if not self.fits(area):
            return False
        self.occupied = shapely.union(self.occupied, shapely.buffer(area, gap, join_style="mitre"))
        site, place, level = self.building.site, self.building.place, self.room.level
        polygon = place.geometry_to_local(area)
        at = place.to_local(u, v)
        site.add_object(
            f"{level}/{kind}/{self.building.number(level + kind)}",
            kind,
            polygon,
            shapes=_style_shapes(style, x, y, z),
            pose=(*at, site.elevation(level), place.yaw),
            level=level,
            size=[mm(x), mm(y), mm(z)],
            height=mm(z),
            room=self.room.name,
            colour=colour,
        )
        return True


def _style_shapes(style: str, x: float, y: float, z: float) -> list[dict[str, Any]]:
    def box(size: Sequence[float], pose: Sequence[float]) -> dict[str, Any]:
        return {"type": "box", "size": [mm(v) for v in size], "pose": [*(mm(v) for v in pose), 0.0, 0.0, 0.0]}

    if style == "desk":
        sides = [box((0.04, y, z - 0.04), (k * (x / 2 - 0.02), 0.0, (z - 0.04) / 2)) for k in (-1, 1)]
        return [box((x, y, 0.04), (0.0, 0.0, z - 0.02)), *sides]
    if style == "table":
        foot = box((max(0.1, x * 0.3), max(0.1, y * 0.3), z - 0.04), (0.0, 0.0, (z - 0.04) / 2))
        return [box((x, y, 0.04), (0.0, 0.0, z - 0.02)), foot]
    return [box((x, y, z), (0.0, 0.0, z / 2))]


def _along(a: tuple[float, float], b: tuple[float, float], length: float) -> tuple[float, float]:
    share = length / math.dist(a, b)
    return a[0] + (b[0] - a[0]) * share, a[1] + (b[1] - a[1]) * share

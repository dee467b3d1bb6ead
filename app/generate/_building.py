"""Storeys of a building: rooms on both sides of a corridor, with walls, doors, a lift at the corridor's end.

Drawn in metres with the corridor along u, then put to its ``Place``. Walls, doors, floors and the lift are objects in
the words of Open-RMF's building maps (part ``openrmf``), with the solids that simulators and grids need; doors stand
open. What stands in rooms keeps clear of the way from the door to the room's node.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely

from app.derive import DerivationNotes
from app.errors import CannotGenerate
from app.generate import RandomSource
from app.generate._site import SLACK, Site, SiteOptions, angle, invalid_option_error, mm
from app.generate._site_frame import SiteFrame, place_site
from app.model.frame import GROUND, Level
from app.model.layers import Layers

FAMILY = "openrmf"
WALL, PARTITION, SHELL = 0.12, 0.1, 0.24
"""Metres: thickness of a corridor's walls, of those between rooms, and of the outer ones."""

DOOR_HEIGHT = 2.1
RASTER = 0.8
"""Metres: doors on both sides of the corridor stand on multiples of it, so that they face each other or stand apart."""

SHAFT, CABIN, LIFT_DOOR = 2.4, 1.9, 1.2
"""Metres: side of a lift's shaft, side of its cabin, width of its doors."""

ENTRANCE = 0.3
"""Metres by which the entrance is at least narrower than the corridor."""

APRON = 5.0
"""Metres of paved ground before the entrance."""

LOWEST = 2.4
MAX_ROOMS = 5000
MAX_LEVELS = 20
MARGIN = 2.0


@dataclass(frozen=True, slots=True)
class Storeys:
    """Measures of a building, in metres. length: of the corridor; depth: of the rooms on each side of it; least and
    most: widths of rooms; door: width of the rooms' doors; height: from floor to floor."""

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
    """A room. box: (u0, v0, u1, v1) inside its walls; door: u of its door; side: 1 where it lies above the corridor,
    else -1; open: it has no wall to the corridor."""

    name: str
    kind: str
    level: str
    box: tuple[float, float, float, float]
    door: float
    side: int
    open: bool = False

    @property
    def depth(self) -> float:
        """Metres from the corridor's wall to the outer one."""
        return self.box[3] - self.box[1]

    def position(self, along: float, inward: float) -> tuple[float, float]:
        """A place by metres from its left wall, and from the corridor's side."""
        v = self.box[1] + inward if self.side > 0 else self.box[3] - inward
        return self.box[0] + along, v


@dataclass(slots=True)
class Building:
    """A building being drawn into a site."""

    site: Site
    place: SiteFrame
    measures: Storeys
    radius: float
    rooms: list[Room] = field(default_factory=list)
    _count: dict[str, int] = field(default_factory=dict)

    def number(self, kind: str) -> int:
        """The next number of a kind of thing, from 1."""
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
        """A wall from a to b, without openings (middle, width), metres from a along it."""
        length = math.dist(a, b)
        cuts = sorted((middle - width / 2, middle + width / 2) for middle, width in openings)
        starts = [0.0, *(end for _, end in cuts)]
        ends = [*(start for start, _ in cuts), length]
        for start, end in zip(starts, ends, strict=True):
            if end - start < 0.02:
                continue
            # Corners close where walls meet, so the ends of the whole wall reach half a wall farther.
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
        """A door that stands open. along: the direction of its wall, radians in the drawing."""
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
        """A slab whose top is the level's elevation."""
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
        """A lift that serves these levels, its doors towards larger u."""
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
        # Its doors are on the side of its negative y, as the editor draws a new lift.
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

    # what stands in rooms

    def furnish(self, room: Room, goal: tuple[float, float]) -> Furniture:
        """What may be put into a room whose node is at ``goal`` (metres along and inward)."""
        along = room.door - room.box[0]
        path = shapely.LineString(
            [room.position(along, -PARTITION), room.position(along, self.radius + 0.5), room.position(*goal)]
        )
        keep = self.radius + 3 * self.site.resolution + 0.1
        return Furniture(self, room, shapely.buffer(path, keep, cap_style="square"))

    def charger(self, things: Furniture, goal: tuple[float, float]) -> None:
        """A charger at the room's outer wall behind its node, and the place before it, where there is room."""
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
    """Puts things into one room where there is place."""

    building: Building
    room: Room
    occupied: Any

    def fits(self, area: Any) -> bool:
        """Whether this area (drawn metres) is free and in the room."""
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
        """A thing with its middle there, ``size`` along the corridor, inwards and up; False where there is no place.

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


# --- a building of rooms along corridors ------------------------------------------------------------------------------

Kinds = Callable[[int, int, list[float], np.random.Generator], list[str]]
"""(level from 0, side, widths of the rooms, chance) -> what each room is."""

NodeOf = Callable[[Room], tuple[float, float]]
"""Where in a room its node stands: metres along and inward."""


def check(measures: Storeys, radius: float) -> None:
    """Measures that do not go together are told before any work."""
    if measures.least > measures.most:
        raise invalid_option_error("room_width", "the smaller width comes first")
    if measures.least < measures.door + RASTER + 0.6:
        raise invalid_option_error(
            "room_width", f"must be at least {measures.door + RASTER + 0.6:.2f} m, for a door to stand in it"
        )
    if measures.length < measures.least + 1.0:
        raise invalid_option_error("length", f"must be at least {measures.least + 1.0:.2f} m, for one room")
    if 2 * (measures.length / measures.least) * measures.levels > MAX_ROOMS:
        raise CannotGenerate(f"the building would have more than {MAX_ROOMS} rooms: make it shorter, or rooms wider")
    if measures.depth < 2 * radius + 2.0:
        raise invalid_option_error(
            "depth", f"rooms must be at least {2 * radius + 2.0:.2f} m deep, for a robot to turn"
        )
    if measures.height < LOWEST + 0.2:
        raise invalid_option_error("storey_height", f"must be at least {LOWEST + 0.2:g} m")


def fits_robot(site: Site, measures: Storeys, radius: float) -> None:
    """Whether a robot passes the doors, once the grid's resolution is known."""
    need = 2 * radius + 2 * SLACK * site.resolution
    widths = {"door_width": measures.door, "corridor": measures.corridor - ENTRANCE}
    if measures.lift:
        widths["robot_radius"] = LIFT_DOOR
    for parameter, width in widths.items():
        if width < need - 1e-9:
            label = {"robot_radius": "the lift's doors are", "corridor": "its entrance is"}.get(parameter, "it is")
            raise invalid_option_error(
                parameter, f"{label} {width:.3g} m wide; a robot of {radius:g} m needs {need:.2f} m here"
            )


def level_names(levels: int) -> list[str]:
    """The names of a building's levels: the ground, then L2, L3 …"""
    return [GROUND, *(f"L{k}" for k in range(2, levels + 1))]


def building_levels(measures: Storeys) -> tuple[Level, ...]:
    """The levels with their elevations."""
    return tuple(Level(name, mm(k * measures.height)) for k, name in enumerate(level_names(measures.levels)))


def build(
    site: Site,
    measures: Storeys,
    radius: float,
    source: RandomSource,
    kinds: Kinds,
    node_of: Callable[[Room], tuple[float, float]],
) -> Building:
    """Shell, rooms, doors, lift and network of all levels. The rooms are still empty.

    node_of: where in a room its node stands.
    """
    west = SHAFT if measures.lift else 0.0
    total, across = west + measures.length, 2 * measures.depth + measures.corridor
    narrow = min(measures.door, measures.corridor - ENTRANCE, *([LIFT_DOOR] if measures.lift else []))
    place = place_site(site, total + APRON, across, MARGIN, narrow / 2 - radius)
    fits_robot(site, measures, radius)
    building = Building(site, place, measures, radius)
    names = level_names(measures.levels)
    for k, level in enumerate(names):
        _storey(building, k, level, west, source.stream(f"storey/{k}"), kinds)
    if measures.lift:
        building.lift("lift_1", names, (west / 2, across / 2))
    for k, level in enumerate(names):
        _network(building, k, level, west, node_of)
    if measures.lift:
        for low, high in itertools.pairwise(names):
            site.add_edges(f"lift_1_{low}", f"lift_1_{high}", action="lift")
    return building


def _storey(building: Building, k: int, level: str, west: float, chance: np.random.Generator, kinds: Kinds) -> None:
    """Floor, walls, doors and rooms of one level."""
    m, site = building.measures, building.site
    east, across = west + m.length, 2 * m.depth + m.corridor
    low, high = m.depth, m.depth + m.corridor
    middle = across / 2
    outline = shapely.box(west, 0.0, east, across)
    if m.lift:
        outline = shapely.union(outline, shapely.box(0.0, middle - SHAFT / 2, west, middle + SHAFT / 2))
    building.floor(level, outline)
    if m.lift:
        cabin = shapely.box(west / 2 - 0.9, middle - 0.9, west / 2 + 0.9, middle + 0.9)
        site.draw(building.place.geometry_to_local(cabin), "metal", level=level)
    site.draw(building.place.geometry_to_local(shapely.box(west, low, east, high)), "concrete", level=level)
    if k == 0:
        apron = shapely.box(east, max(0.0, middle - 4.0), east + APRON, min(across, middle + 4.0))
        building.floor(level, apron, "paving")
    used: list[float] = []
    for side in (1, -1):
        widths = _widths(m, chance)
        room_kinds = kinds(k, side, widths, chance)
        base = high if side > 0 else 0.0
        at = west
        openings: list[tuple[float, float]] = []
        gaps: list[tuple[float, float]] = []
        for n, (width, kind) in enumerate(zip(widths, room_kinds, strict=True)):
            name = f"{kind}_{k + 1}{n * 2 + (1 if side > 0 else 2):02d}"
            open_ = kind == "nurse_station"
            stop = _door(at - west + 0.3 + m.door / 2, at - west + width - 0.3 - m.door / 2, used)
            used.append(stop)
            door = round(west + stop, 3)
            box = (at + PARTITION / 2, base, at + width - PARTITION / 2, base + m.depth)
            building.rooms.append(Room(name, kind, level, box, door, side, open_))
            if open_:
                gaps.append((at - west + width / 2, width - 0.4))
            else:
                openings.append((door - west, m.door))
                building.door(level, f"{name}_door", (door, high if side > 0 else low), m.door, 0.0)
            at += width
            if n < len(widths) - 1:
                building.wall(level, (at, base), (at, base + m.depth), PARTITION)
        wall = high if side > 0 else low
        building.wall(level, (west, wall), (east, wall), WALL, [*openings, *gaps])
        building.wall(level, (west, across if side > 0 else 0.0), (east, across if side > 0 else 0.0), SHELL)
    main = mm(min(m.corridor - ENTRANCE, max(2.0, m.door)))
    building.wall(level, (east, 0.0), (east, across), SHELL, [(middle, main)] if k == 0 else [])
    if k == 0:
        building.door(level, "entrance_door", (east, middle), main, math.pi / 2, "double_sliding")
    building.wall(level, (west, 0.0), (west, across), SHELL, [(middle, LIFT_DOOR)] if m.lift else [])
    if m.lift:
        s = SHAFT / 2
        building.wall(level, (west, middle - s), (0.0, middle - s), PARTITION)
        building.wall(level, (0.0, middle - s), (0.0, middle + s), PARTITION)
        building.wall(level, (0.0, middle + s), (west, middle + s), PARTITION)


def _widths(m: Storeys, chance: np.random.Generator) -> list[float]:
    """Widths of the rooms along one side, together the corridor's length, in steps of a decimetre."""
    min_count, max_count = math.ceil(m.length / m.most - 1e-9), math.floor(m.length / m.least + 1e-9)
    if max_count < 1 or min_count > max_count:
        raise invalid_option_error(
            "room_width", f"no number of rooms from {m.least:g} to {m.most:g} m fills {m.length:g} m"
        )
    count = int(chance.integers(min_count, max_count + 1))
    spare = m.length - count * m.least
    shares = chance.random(count) + 0.2
    # What goes beyond the widest is given to the others.
    extra = np.zeros(count)
    room = np.full(count, m.most - m.least)
    for _ in range(count):
        open_ = extra < room - 1e-9
        left = spare - float(extra.sum())
        if left <= 1e-9 or not open_.any():
            break
        share = np.where(open_, shares, 0.0)
        extra = np.minimum(room, extra + left * share / float(share.sum()))
    ends = np.round(np.cumsum(m.least + extra), 1)
    ends[-1] = round(m.length, 3)
    return [round(float(v), 3) for v in np.diff(np.concatenate([[0.0], ends]))]


def _door(low: float, high: float, used: Sequence[float]) -> float:
    """A place for a door between two bounds, on the raster: where one stands opposite, else in the middle."""
    first, last = math.ceil(low / RASTER - 1e-9), math.floor(high / RASTER + 1e-9)
    places = [round(k * RASTER, 3) for k in range(first, last + 1)] or [round((low + high) / 2, 3)]
    facing = [at for at in places if at in used]
    return facing[0] if facing else places[len(places) // 2]


def _network(building: Building, k: int, level: str, west: float, node_of: NodeOf) -> None:
    """The corridor's middle, and from it into each room and the lift."""
    m, site, place = building.measures, building.site, building.place
    middle = m.depth + m.corridor / 2
    east = west + m.length
    rooms = [room for room in building.rooms if room.level == level]
    stops = {room.door for room in rooms}
    first = round(west + RASTER, 3)
    last = round(west + math.floor((m.length - 0.9) / RASTER) * RASTER, 3)
    if m.lift:
        stops.add(first)
    if k == 0:
        stops.add(last)
    name = {u: f"{level}_corridor_{n + 1}" for n, u in enumerate(sorted(stops))}
    for u in sorted(stops):
        site.node(name[u], place.to_local(u, middle), yaw=place.yaw, level=level)
    for a, b in itertools.pairwise(sorted(stops)):
        site.add_edges(name[a], name[b], speed=1.0)
    for room in rooms:
        u, v = room.position(room.door - room.box[0], building.radius + 0.5)
        facing = place.yaw + room.side * math.pi / 2
        inner = site.node(f"{room.name}_door", place.to_local(u, v), yaw=facing, level=level)
        site.add_edges(name[room.door], inner, speed=0.5)
        goal = room.position(*node_of(room))
        site.node(room.name, place.to_local(*goal), yaw=facing, level=level)
        site.add_edges(inner, room.name, speed=0.5)
        site.mark(
            f"{level}/room/{room.name}",
            "region",
            place.geometry_to_local(shapely.box(*room.box)),
            level=level,
            name=room.name,
        )
    if m.lift:
        at = place.to_local(west / 2, middle)
        site.node(f"lift_1_{level}", at, yaw=place.yaw, level=level)
        site.add_edges(f"lift_1_{level}", name[first], speed=0.3)
    if k == 0:
        site.node("entrance", place.to_local(east + APRON / 2, middle), yaw=place.yaw, level=level)
        site.add_edges(name[last], "entrance", speed=0.5)


def _along(a: tuple[float, float], b: tuple[float, float], length: float) -> tuple[float, float]:
    share = length / math.dist(a, b)
    return a[0] + (b[0] - a[0]) * share, a[1] + (b[1] - a[1]) * share


def slow_zones(building: Building, speed: float = 0.5) -> None:
    """Robots go slowly before the lift and at the entrance."""
    m, site, place = building.measures, building.site, building.place
    west = SHAFT if m.lift else 0.0
    low, high = m.depth, m.depth + m.corridor
    for level in level_names(m.levels):
        if m.lift:
            site.zone(
                f"{level}/speed/lift", "speed", place.geometry_to_local(shapely.box(west, low, west + 2.0, high)),
                level=level,
                value=speed, name=f"before the lift, {level}",
            )  # fmt: skip
    east = west + m.length
    site.zone(
        "ground/speed/entrance", "speed", place.geometry_to_local(shapely.box(east - 2.0, low, east + APRON, high)),
        value=speed, name="entrance",
    )  # fmt: skip


def goal(room: Room, radius: float) -> tuple[float, float]:
    """A room's node: straight in from the door, so that there is place for furniture on both sides."""
    inward = max(radius + 0.9, 0.42 * room.depth)
    return room.door - room.box[0], min(inward, room.depth - radius - 0.5)


def build_site(
    given: Layers,
    options: SiteOptions,
    measures: Storeys,
    source: RandomSource,
    notes: DerivationNotes,
    kinds: Kinds,
    furnish: Callable[[Furniture, Room, np.random.Generator], None] | None,
    charged: Callable[[int, Room], bool],
) -> Layers:
    """A whole building with its network. kinds: see ``build``. furnish: puts a room's things, None: it stays empty.
    charged: whether a room (of the level of that number) has a charger for robots."""
    check(measures, options.robot_radius)
    site = Site(given, options, notes, levels=building_levels(measures))

    def node_of(room: Room) -> tuple[float, float]:
        return goal(room, options.robot_radius)

    building = build(site, measures, options.robot_radius, source, kinds, node_of)
    for k, level in enumerate(level_names(measures.levels)):
        chance = source.stream(f"furniture/{k}")
        for room in (room for room in building.rooms if room.level == level):
            things = building.furnish(room, node_of(room))
            if charged(k, room):
                building.charger(things, node_of(room))
            if furnish is not None:
                furnish(things, room, chance)
    slow_zones(building)
    return site.finish(ground="grass")

"""Storeys of rooms along corridors: widths of rooms, doors, the network, the zones."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
import shapely

from app.derive import DerivationNotes
from app.errors import CannotGenerate
from app.generate import RandomSource
from app.generate._building import LIFT_DOOR, PARTITION, SHAFT, SHELL, WALL, Building, Furniture, Room, Storeys
from app.generate._shapes import mm
from app.generate._site import SLACK, Site, SiteOptions, invalid_option_error
from app.generate._site_frame import place_site
from app.model.frame import GROUND, Level
from app.model.layers import Layers
from app.parameters import parameter

RASTER = 0.8
"""Raster of door positions in metres: doors on both sides of the corridor either face each other or are apart."""

ENTRANCE = 0.3
"""Minimum difference in metres by which the entrance is narrower than the corridor."""

APRON = 5.0
"""Depth of the paved ground before the entrance, in metres."""

LOWEST = 2.4
MAX_ROOMS = 5000
MAX_LEVELS = 20
MARGIN = 2.0

Furnish = Callable[[Furniture, Room, np.random.Generator], None]
"""Puts the things of a room into it."""

Kinds = Callable[[int, int, list[float], np.random.Generator], list[str]]
"""Signature (level from 0, side, widths of the rooms, random generator) -> kind of each room."""

NodeOf = Callable[[Room], tuple[float, float]]
"""Signature for the position of a room's node: metres along and inward."""


@dataclass(frozen=True, slots=True)
class BuildingOptions(SiteOptions):
    """How large the building is, and how fine its rooms. The defaults are those of an office."""

    levels: int = parameter(2, "levels; from two on a lift joins them", minimum=1, maximum=MAX_LEVELS)
    length: float = parameter(32.0, "of the corridor", minimum=4.0, maximum=500.0, unit="m")
    depth: float = parameter(5.5, "of the rooms on each side of it", minimum=2.5, maximum=50.0, unit="m")
    corridor: float = parameter(2.4, "width of the corridor", minimum=1.2, maximum=20.0, unit="m")
    room_width: tuple[float, float] = parameter(
        (3.2, 6.4), "least,most width of a room", minimum=2.0, maximum=100.0, unit="m"
    )
    door_width: float = parameter(1.1, "of the rooms' doors", minimum=0.6, maximum=3.0, unit="m")
    storey_height: float = parameter(3.4, "from floor to floor", minimum=2.0, maximum=20.0, unit="m")
    furniture: bool = parameter(True, "whether there are desks, tables and cupboards")


def redefine(name: str, default: Any, doc: str = "") -> Any:
    """Declare a parameter of BuildingOptions again with another default, within the same bounds."""
    metadata = next(f.metadata for f in fields(BuildingOptions) if f.name == name)
    return field(default=default, metadata={**metadata, "doc": doc or metadata["doc"]})


def _measures(options: BuildingOptions) -> Storeys:
    least, most = options.room_width
    return Storeys(
        options.levels, options.length, options.depth, options.corridor, least, most, options.door_width,
        options.storey_height, options.levels > 1,
    )  # fmt: skip


def check(measures: Storeys, radius: float) -> None:
    """Check measures that exclude each other, before any work."""
    if measures.least > measures.most:
        raise invalid_option_error("room_width", "the smaller width must come first")
    if measures.least < measures.door + RASTER + 0.6:
        raise invalid_option_error(
            "room_width", f"must be at least {measures.door + RASTER + 0.6:.2f} m, to contain a door"
        )
    if measures.length < measures.least + 1.0:
        raise invalid_option_error("length", f"must be at least {measures.least + 1.0:.2f} m, for one room")
    if 2 * (measures.length / measures.least) * measures.levels > MAX_ROOMS:
        raise CannotGenerate(
            f"the building would have more than {MAX_ROOMS} rooms: make it shorter, or its rooms wider"
        )
    if measures.depth < 2 * radius + 2.0:
        raise invalid_option_error(
            "depth", f"rooms must be at least {2 * radius + 2.0:.2f} m deep, for a robot to turn"
        )
    if measures.height < LOWEST + 0.2:
        raise invalid_option_error("storey_height", f"must be at least {LOWEST + 0.2:g} m")


def fits_robot(site: Site, measures: Storeys, radius: float) -> None:
    """Check that a robot passes the doors, with the known resolution of the grid."""
    need = 2 * radius + 2 * SLACK * site.resolution
    widths = {"door_width": measures.door, "corridor": measures.corridor - ENTRANCE}
    if measures.lift:
        widths["robot_radius"] = LIFT_DOOR
    for option, width in widths.items():
        if width < need - 1e-9:
            label = {"robot_radius": "the lift's doors are", "corridor": "its entrance is"}.get(option, "it is")
            raise invalid_option_error(
                option, f"{label} {width:.3g} m wide; a robot of {radius:g} m needs at least {need:.2f} m"
            )


def level_names(levels: int) -> list[str]:
    """Return the names of a building's levels: the ground, then L2, L3 …"""
    return [GROUND, *(f"L{k}" for k in range(2, levels + 1))]


def building_levels(measures: Storeys) -> tuple[Level, ...]:
    """Return the levels with their elevations."""
    return tuple(Level(name, mm(k * measures.height)) for k, name in enumerate(level_names(measures.levels)))


def build(
    site: Site,
    measures: Storeys,
    radius: float,
    source: RandomSource,
    kinds: Kinds,
    node_of: Callable[[Room], tuple[float, float]],
) -> Building:
    """Build shell, rooms, doors, lift and network of all levels; the rooms are still empty.

    node_of: position of a room's node.
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
    """Build floor, walls, doors and rooms of one level."""
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
    """Draw widths of the rooms along one side; their sum is the corridor's length, in steps of a decimetre."""
    min_count, max_count = math.ceil(m.length / m.most - 1e-9), math.floor(m.length / m.least + 1e-9)
    if max_count < 1 or min_count > max_count:
        raise invalid_option_error(
            "room_width", f"no number of rooms from {m.least:g} to {m.most:g} m fills {m.length:g} m"
        )
    count = int(chance.integers(min_count, max_count + 1))
    spare = m.length - count * m.least
    shares = chance.random(count) + 0.2
    # distribute what exceeds the maximum to the others
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
    """Choose a door position between two bounds, on the raster: opposite another door, else in the middle."""
    first, last = math.ceil(low / RASTER - 1e-9), math.floor(high / RASTER + 1e-9)
    places = [round(k * RASTER, 3) for k in range(first, last + 1)] or [round((low + high) / 2, 3)]
    facing = [at for at in places if at in used]
    return facing[0] if facing else places[len(places) // 2]


def _network(building: Building, k: int, level: str, west: float, node_of: NodeOf) -> None:
    """Add the network: along the corridor, and from it into each room and the lift."""
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


def slow_zones(building: Building, speed: float = 0.5) -> None:
    """Add speed zones before the lift and at the entrance."""
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
    """Return a room's node: straight in from the door, so that furniture fits on both sides."""
    inward = max(radius + 0.9, 0.42 * room.depth)
    return room.door - room.box[0], min(inward, room.depth - radius - 0.5)


def build_site(
    given: Layers,
    options: BuildingOptions,
    source: RandomSource,
    notes: DerivationNotes,
    kinds: Kinds,
    furnish: Mapping[str, Furnish],
    charged: Callable[[int, Room], bool],
) -> Layers:
    """Build a complete building with its network.

    kinds: see ``build``. furnish: adds a room's furniture; None: it stays empty. charged: whether a room (of the level
    of that number) has a charger for robots.
    """
    measures = _measures(options)
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
            if options.furniture:
                furnish[room.kind](things, room, chance)
    slow_zones(building)
    return site.finish(ground="grass")


def put_shelves(things: Furniture, room: Room, chance: np.random.Generator) -> None:
    """Shelves along both side walls."""
    width = room.box[2] - room.box[0]
    for k in range(int((room.depth - 0.4) / 1.1)):
        for along in (0.3, width - 0.3):
            if chance.random() < 0.85:
                things.add_item("shelf", along, 0.75 + 1.1 * k, (0.5, 1.0, 2.0), "shelf")

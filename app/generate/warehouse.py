"""Generator ``warehouse``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from app.derive import DerivationNotes
from app.generate import RandomSource, _field, _field_network, _trees, generates
from app.generate._field import Field, FieldOptions, Layout, Line, Row
from app.generate._shapes import mm, rectangle
from app.generate._site import SLACK, Site, invalid_option_error
from app.generate._variety import drawn
from app.model.layers import Layers
from app.parameters import parameter

WALL = 0.2
"""Thickness of a wall in metres."""

BAY = 2.8
"""Distance between the uprights of a rack in metres."""

PALLET = (1.2, 0.8)

DOCK_METRES = 2.5
"""Depth of a dock's mark on the floor in metres."""


@dataclass(frozen=True, slots=True)
class Warehouse(FieldOptions):
    """Parameters of a warehouse.

    Ranges: a hall with shelves 3.9 m long and 0.9 m apart to pallet racks with aisles for reach trucks (2.5 to 3.4 m)
    and counterbalanced ones (3.5 to 4.5 m); halls are straight.
    """

    row_length: float | None = drawn(
        8.0,
        36.0,
        "maximum length of a rack",
        step=0.1,
        minimum=3.0,
        maximum=1000.0,
        unit="m",
        fence="as long as the fence allows",
        yields="high",
        helps=("docks", "cross_aisles"),
    )
    angle: float | None = parameter(
        None,
        "direction of the racks, counter-clockwise from the x axis; default: along the fence's longest side, else 0",
        minimum=-360.0,
        maximum=360.0,
        unit="°",
    )
    skew: float | None = parameter(
        None,
        "angle by which the racks' starts lean against the direction across the racks; default: as the fence, else 0",
        minimum=-45.0,
        maximum=45.0,
        unit="°",
    )
    taper: float | None = parameter(
        None,
        "share by which the last rack is longer than the first; default: as the fence, else 0",
        minimum=-0.6,
        maximum=0.6,
    )
    headland: float = drawn(
        2.8,
        6.0,
        "width of the cross aisle between the racks' ends and the wall",
        step=0.1,
        minimum=1.5,
        maximum=50.0,
        unit="m",
        yields="low",
        helps=("yard", "docks"),
    )
    yard: float = drawn(
        7.0,
        14.0,
        "depth of the dispatch area along the longest side",
        step=0.5,
        minimum=6.0,
        maximum=50.0,
        unit="m",
        yields="low",
        helps=("headland",),
    )
    docks: int = drawn(1, 5, "number of loading docks in the longest side", step=1, minimum=1, maximum=50, yields="low")
    racks: int | None = drawn(
        3,
        9,
        "number of double racks",
        step=1,
        minimum=2,
        maximum=_field.MAX_ROWS,
        fence="as many as fit into the fence",
        measured="rows",
    )
    aisle: float = drawn(
        1.2,
        4.0,
        "width of the aisle between two racks",
        step=0.05,
        minimum=0.8,
        maximum=20.0,
        unit="m",
        yields="high",
        helps=("headland",),
    )
    cross_aisles: int = drawn(0, 2, "number of aisles across all racks", step=1, minimum=0, maximum=20, yields="low")
    cross_width: float = drawn(
        2.5, 4.5, "width of an aisle across the racks", step=0.1, minimum=1.0, maximum=30.0, unit="m", yields="high"
    )
    staging: int = drawn(
        0,
        3,
        "number of docks with a staging area behind them, marked on the floor, with a lower speed limit",
        step=1,
        minimum=0,
        maximum=50,
        yields="low",
    )
    rack_depth: float = drawn(
        0.5,
        1.2,
        "depth of one of the two racks that stand back to back",
        step=0.05,
        minimum=0.3,
        maximum=5.0,
        unit="m",
    )
    rack_height: float = drawn(2.6, 6.5, "height of the racks", step=0.1, minimum=1.0, maximum=15.0, unit="m")
    filled: float = drawn(
        0.55, 0.95, "share of pallet places on the floor that are occupied", step=0.01, minimum=0.0, maximum=1.0
    )
    chargers: int = drawn(
        1, 3, "number of charging places", step=1, minimum=1, maximum=50, yields="low", helps=("docks",)
    )
    parking: int = drawn(
        0, 3, "number of parking places", step=1, minimum=0, maximum=50, yields="low", helps=("docks",)
    )
    one_way: bool = parameter(False, "whether aisles are one-way, in alternating directions")
    wall_height: float = parameter(7.0, "height of the hall's walls", minimum=2.0, maximum=20.0, unit="m")


@generates(
    {"location", "objects", "occupancy", "topology", "zones", "imagery"},
    parameters=Warehouse,
    also={"location"},
    version=2,
)
def warehouse(given: Layers, options: Warehouse, source: RandomSource, notes: DerivationNotes) -> Layers:
    """Warehouse: a hall with racks and pallets, aisles (optionally one-way), loading docks, chargers and parking."""
    site = Site(given, options, notes, coloured=True)
    lines = [Line("row", k, f"A{k}") for k in range(1, (options.racks or _field.MAX_ROWS) + 1)]
    layout = Layout(
        2 * options.rack_depth + options.aisle,
        options.rack_depth,
        "aisle",
        crossings=options.cross_aisles,
        crossing_width=options.cross_width,
    )
    out = _field.open_field(site, options, lines, layout, count=options.racks)
    site.draw(site.fence, "floor")
    pallets = sum(4 * row.length / BAY for row in out.rows)
    if pallets > _trees.MAX_PLANTS:
        raise invalid_option_error("racks", f"there would be {int(pallets)} pallets; the limit is {_trees.MAX_PLANTS}")
    for row in out.rows:
        _rack(site, out, row, options, source.stream(f"pallets {row.name}"))
    _field_network.network(
        out,
        _dispatch(site, out, options),
        aisle_speed=1.2,
        lane_speed=1.5,
        along="move_base",
        change="move_base",
        one_way=options.one_way,
    )
    return site.finish(ground="asphalt")


def _rack(site: Site, out: Field, row: Row, options: Warehouse, stream: np.random.Generator) -> None:
    """Add two racks back to back, the pallets on their floor, and their keep-out zone."""
    depth, height = options.rack_depth, options.rack_height
    bays = max(1, int(row.length / BAY))
    bay = row.length / bays
    shapes: list[dict[str, Any]] = []
    for post in range(bays + 1):
        u = min(max(post * bay, 0.05), row.length - 0.05)
        for v in (-depth + 0.05, -0.1, 0.1, depth - 0.05):
            place = [mm(u), mm(v), mm(height / 2), 0.0, 0.0, 0.0]
            shapes.append({"type": "box", "size": [0.1, 0.1, mm(height)], "pose": place})
    for level in range(1, max(1, int(height / 1.6)) + 1):
        z = level * height / (int(height / 1.6) + 1)
        for v in (-depth / 2, depth / 2):
            place = [mm(row.length / 2), mm(v), mm(z), 0.0, 0.0, 0.0]
            shapes.append({"type": "box", "size": [mm(row.length), mm(depth), 0.1], "pose": place})
    x, y = out.to_local(row.low, row.v)
    site.add_object(
        f"rack{row.name}",
        "shelf",
        out.strip(row, 2 * depth),
        shapes=shapes,
        pose=(x, y, 0.0, out.yaw),
        colour="shelf",
        name=f"Rack {row.name}",
        size=[mm(row.length), mm(2 * depth), mm(height)],
        height=mm(height),
    )
    site.zone(f"rack{row.name}", "keepout", out.strip(row, 2 * depth), name=f"Rack {row.name}")
    along, across = min(PALLET[0], (bay - 0.3) / 2), min(PALLET[1], depth - 0.15)
    number = 0
    for k in range(bays):
        for side in (-1, 1):
            for end in (-1, 1):
                a, b, c = stream.random(3).tolist()
                if a >= options.filled:
                    continue
                number += 1
                u = row.low + (k + 0.5) * bay + end * (along / 2 + 0.05 + 0.05 * b)
                size = (along, across, 0.8 + 0.6 * c)
                spot = out.to_local(u, row.v + side * (depth / 2))
                name = f"pallet{row.name}-{number}"
                site.box(name, "crate", spot, size, yaw=out.yaw, colour="goods" if b < 0.6 else "straw")


def _dispatch(site: Site, out: Field, options: Warehouse) -> dict[str, float]:
    """Build the dispatch area: doors with docks, chargers, parking places, and walls around the hall.

    Returns its nodes on the lane, and their u.
    """
    lane, radius = out.aisles[0], options.robot_radius
    names = [f"Dock{k + 1}" for k in range(options.docks)]
    names += [f"Charger{k + 1}" for k in range(options.chargers)]
    names += [f"Parking{k + 1}" for k in range(options.parking)]
    pitch = mm(max(3.0, 2 * radius + 1.2))
    if (len(names) + 1) * pitch > lane.high - lane.low:
        raise invalid_option_error(
            "docks",
            f"{len(names)} docks, chargers and parking places need {(len(names) + 1) * pitch:g} m of the "
            f"longest side, which has {lane.high - lane.low:.1f} m",
        )
    positions: dict[str, float] = {}
    doors = []
    clear = radius + WALL + SLACK * site.resolution + 0.1
    first = mm((lane.low + lane.high - (len(names) - 1) * pitch) / 2)
    facing = out.yaw - math.pi / 2
    for k, name in enumerate(names):
        u = mm(first + k * pitch)
        stop = f"At{name}"
        positions[stop] = u
        site.node(stop, out.to_local(u, lane.v), yaw=out.yaw)
        wall, near = _field_network.lowest(out, u, 0.0), _field_network.lowest(out, u, clear)
        if wall is None or near is None:
            raise invalid_option_error(
                "docks", f"the lane has no room for {len(names)} docks, chargers and parking places"
            )
        words: dict[str, Any] = {}
        v = near
        if name.startswith("Dock"):
            doors.append(out.area(u - 1.25, wall - 0.6, u + 1.25, wall + WALL + 0.6))
            site.mark(f"door{k + 1}", "door", _door(site.fence, doors[-1]), name=f"Gate {k + 1}")
            site.draw(out.area(u - 1.25, wall, u + 1.25, wall + DOCK_METRES), "marking")
            site.draw(out.area(u - 1.1, wall, u + 1.1, wall + DOCK_METRES - 0.15), "concrete")
        elif name.startswith("Charger"):
            words = {"openrmf": {"parameters": {"is_charger": [4, True], "is_parking_spot": [4, True]}}}
            v = near + 0.5
            site.box(
                name.lower(),
                "machine",
                out.to_local(u, mm(near + 0.5 - clear + WALL - 0.15)),
                (0.6, 0.3, 1.2),
                yaw=out.yaw,
                colour="charger",
                name=name,
            )
        else:
            words = {"openrmf": {"parameters": {"is_parking_spot": [4, True]}}}
            site.draw(rectangle(*out.to_local(u, v), out.yaw, 2 * radius + 0.4, 2 * radius + 0.4), "concrete")
        if v > lane.v - radius:
            raise invalid_option_error("yard", f"{options.yard:g} m is too shallow for a robot of radius {radius:g} m")
        site.node(name, out.to_local(u, mm(v)), yaw=facing, **words)
        site.add_edges(stop, name, speed=0.5)
    _staging(site, out, options, positions)
    _walls(site, doors, options.wall_height)
    slow = out.area(lane.low, 0.0, lane.high, lane.v + 1.0)
    if slow.geom_type == "Polygon":
        site.zone("speed-dispatch", "speed", slow, name="Dispatch", value=0.8)
    return positions


def _staging(site: Site, out: Field, options: Warehouse, positions: Mapping[str, float]) -> None:
    """Mark staging areas between docks and lane: goods wait there, so robots drive slowly."""
    if options.staging > options.docks:
        raise invalid_option_error("staging", f"must be at most the number of docks, {options.docks}")
    low, high = DOCK_METRES + 0.2, out.aisles[0].v - options.robot_radius - 0.4
    if options.staging and high - low < 1.0:
        raise invalid_option_error("staging", f"a yard of {options.yard:g} m has no room for them: make it deeper")
    for k in range(options.staging):
        u = positions[f"AtDock{k + 1}"]
        ground = out.area(u - 1.3, low, u + 1.3, high)
        if ground.geom_type != "Polygon":
            site.notes.drop("staging areas", 1, "the dispatch area has no room for it")
            continue
        site.draw(ground, "marking")
        site.draw(shapely.buffer(ground, -0.15, join_style="mitre"), "paving")
        site.mark(f"staging{k + 1}", "region", ground, name=f"Staging {k + 1}")
        site.zone(f"speed-staging{k + 1}", "speed", ground, name=f"Staging {k + 1}", value=0.4)


def _walls(site: Site, doors: list[Any], height: float) -> None:
    """Add walls around the hall, open at the doors."""
    inside = shapely.buffer(site.fence, -WALL, join_style="mitre")
    walls = shapely.difference(shapely.difference(site.fence, inside), shapely.union_all(doors))
    for k, piece in enumerate(sorted(shapely.get_parts(walls), key=lambda p: p.bounds), 1):
        if piece.geom_type != "Polygon" or piece.area < 1e-4:
            continue
        rings = [np.round(shapely.get_coordinates(r), 3).tolist()[:-1] for r in (piece.exterior, *piece.interiors)]
        shape = {"type": "polyline", "points": rings, "height": mm(height)}
        members: dict[str, Any] = {"height": mm(height), "name": f"Wall {k}"}
        site.add_object(f"wall{k}", "wall", piece, shapes=[shape], pose=(0.0, 0.0, 0.0, 0.0), colour="wall", **members)


def _door(fence: Any, gap: Any) -> Any:
    """Add a door from side to side of a gap in the wall, along it."""
    middle = shapely.intersection(shapely.boundary(shapely.buffer(fence, -WALL / 2, join_style="mitre")), gap)
    parts = shapely.get_parts(shapely.line_merge(middle))
    return max(parts, key=shapely.length)

"""Generator ``warehouse``."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from app.derive import DerivationNotes
from app.generate import RandomSource, _field, _trees, generates
from app.generate._field import Field, FieldOptions, Line, Row
from app.generate._shapes import mm, rectangle
from app.generate._site import SLACK, Site, invalid_option_error
from app.model.layers import Layers
from app.parameters import parameter

WALL = 0.2
"""Thickness of a wall in metres."""

BAY = 2.8
"""Distance between the uprights of a rack in metres."""

PALLET = (1.2, 0.8)


@dataclass(frozen=True, slots=True)
class Warehouse(FieldOptions):
    """Parameters of a warehouse."""

    row_length: float | None = parameter(
        None,
        "maximum length of a rack; default: as long as the fence allows, 24 without a fence",
        minimum=3.0,
        maximum=1000.0,
        unit="m",
    )
    headland: float = parameter(
        4.0, "width of the cross aisle between the racks' ends and the wall", minimum=1.5, maximum=50.0, unit="m"
    )
    yard: float = parameter(
        8.0, "depth of the dispatch area along the longest side", minimum=6.0, maximum=50.0, unit="m"
    )
    docks: int = parameter(3, "number of loading docks in the longest side", minimum=1, maximum=50)
    racks: int | None = parameter(
        None,
        "number of double racks; default: as many as fit into the fence, 5 without one",
        minimum=2,
        maximum=_field.MAX_ROWS,
    )
    aisle: float = parameter(2.8, "width of the aisle between two racks", minimum=0.8, maximum=20.0, unit="m")
    rack_depth: float = parameter(
        1.0, "depth of one of the two racks that stand back to back", minimum=0.3, maximum=5.0, unit="m"
    )
    rack_height: float = parameter(5.0, "height of the racks", minimum=1.0, maximum=15.0, unit="m")
    filled: float = parameter(0.85, "share of pallet places on the floor that are occupied", minimum=0.0, maximum=1.0)
    chargers: int = parameter(2, "number of charging places", minimum=1, maximum=50)
    parking: int = parameter(2, "number of parking places", minimum=0, maximum=50)
    one_way: bool = parameter(False, "whether aisles are one-way, in alternating directions")
    wall_height: float = parameter(7.0, "height of the hall's walls", minimum=2.0, maximum=20.0, unit="m")


@generates(
    {"location", "objects", "occupancy", "topology", "zones", "imagery"}, parameters=Warehouse, also={"location"}
)
def warehouse(given: Layers, options: Warehouse, source: RandomSource, notes: DerivationNotes) -> Layers:
    """Warehouse: a hall with racks and pallets, aisles (optionally one-way), loading docks, chargers and parking."""
    site = Site(given, options, notes, coloured=True)
    lines = [Line("row", k, f"A{k}") for k in range(1, (options.racks or _field.MAX_ROWS) + 1)]
    out = _field.open_field(
        site,
        options,
        lines,
        row_count=None if options.racks else 5,
        spacing=2 * options.rack_depth + options.aisle,
        half=options.rack_depth,
        word="aisle",
        length=24.0,
    )
    site.draw(site.fence, "floor")
    pallets = sum(4 * row.length / BAY for row in out.rows)
    if pallets > _trees.MAX_PLANTS:
        raise invalid_option_error("racks", f"there would be {int(pallets)} pallets; the limit is {_trees.MAX_PLANTS}")
    for row in out.rows:
        _rack(site, out, row, options, source.stream(f"pallets {row.number}"))
    _field.network(
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
        f"rack{row.number}",
        "shelf",
        out.strip(row, 2 * depth),
        shapes=shapes,
        pose=(x, y, 0.0, out.yaw),
        colour="shelf",
        name=f"Rack {row.number}",
        size=[mm(row.length), mm(2 * depth), mm(height)],
        height=mm(height),
    )
    site.zone(f"rack{row.number}", "keepout", out.strip(row, 2 * depth), name=f"Rack {row.number}")
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
                name = f"pallet{row.number}-{number}"
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
        wall, near = _field.lowest(out, u, 0.0), _field.lowest(out, u, clear)
        if wall is None or near is None:
            raise invalid_option_error(
                "docks", f"the lane has no room for {len(names)} docks, chargers and parking places"
            )
        words: dict[str, Any] = {}
        v = near
        if name.startswith("Dock"):
            doors.append(out.area(u - 1.25, wall - 0.6, u + 1.25, wall + WALL + 0.6))
            site.mark(f"door{k + 1}", "door", _door(site.fence, doors[-1]), name=f"Gate {k + 1}")
            site.draw(out.area(u - 1.25, wall, u + 1.25, wall + 2.5), "marking")
            site.draw(out.area(u - 1.1, wall, u + 1.1, wall + 2.35), "concrete")
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
    _walls(site, doors, options.wall_height)
    slow = out.area(lane.low, 0.0, lane.high, lane.v + 1.0)
    if slow.geom_type == "Polygon":
        site.zone("speed-dispatch", "speed", slow, name="Dispatch", value=0.8)
    return positions


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

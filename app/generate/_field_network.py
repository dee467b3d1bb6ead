"""Network and yard of a field: the nodes and edges that robots in polytunnels use, docks, a shed and a tank."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from typing import Any

import shapely

from app.generate._field import CURVE_STEP_METRES, Field, FieldOptions, stops
from app.generate._shapes import mm, rectangle
from app.generate._site import SLACK, invalid_option_error


def network(
    out: Field,
    on_lane: Mapping[str, float],
    *,
    aisle_speed: float,
    lane_speed: float,
    along: str = "row_traversal",
    change: str = "row_change",
    one_way: bool = False,
) -> None:
    """Add edges of lane and aisles, and the nodes of both. on_lane: nodes already on the lane, and their u.

    one_way: aisles are driven alternately from low to high u and back, as far as both ends are connected.
    """
    site, lane = out.site, out.aisles[0]
    at_ends = (("LaneWest", lane.low), ("LaneEast", lane.high))
    at_crossings = [(f"LaneX{k}", u) for k, u in lane.crossings.items()]
    for name, u in (*at_ends, *at_crossings):
        site.node(name, out.to_local(u, lane.v), yaw=out.heading(u))
    listed = sorted(
        [*((u, name) for name, u in on_lane.items()), *((u, name) for name, u in (*at_ends, *at_crossings))]
    )
    for (u, a), (w, b) in itertools.pairwise(listed):
        site.add_edges(a, b, speed=lane_speed, bends=_bends(out, lane.v, u, w))
    ends, round_both = {"Lane": ("LaneWest", "LaneEast")}, True
    crossing_names = {"Lane": {k: f"LaneX{k}" for k in lane.crossings}}
    for number, aisle in enumerate(out.aisles[1:]):
        round_both = round_both and aisle.west and aisle.east
        passed = [
            (u, site.node(f"{aisle.name}-{name}", out.to_local(u, aisle.v), yaw=out.heading(u)))
            for name, u in stops(out, aisle)
        ]
        single = one_way and round_both
        for (u, a), (w, b) in itertools.pairwise(passed if number % 2 == 0 else passed[::-1]):
            bends = _bends(out, aisle.v, u, w)
            site.add_edges(a, b, action=along, speed=aisle_speed, both=not single, bends=bends)
        ends[aisle.name] = (passed[0][1], passed[-1][1])
        crossing_names[aisle.name] = {k: f"{aisle.name}-x{k}" for k in aisle.crossings}
    for before, after in itertools.pairwise(out.aisles):
        for side, good in ((0, after.west), (1, after.east)):
            if good:
                action = "move_base" if before is lane else change
                site.add_edges(ends[before.name][side], ends[after.name][side], action=action, speed=lane_speed)
        for k in sorted(after.crossed):
            a, b = crossing_names[before.name][k], crossing_names[after.name][k]
            site.add_edges(a, b, action=change, speed=lane_speed)


def _bends(out: Field, v: float, u: float, w: float) -> list[tuple[float, float]]:
    """Return the points between two places at v with which an edge follows curved rows."""
    if not out.curve:
        return []
    count = math.ceil(abs(w - u) / CURVE_STEP_METRES)
    return [out.to_local(u + (w - u) * k / count, v) for k in range(1, count)]


def _pitch(options: FieldOptions) -> float:
    """Return the distance in metres from one dock to the next."""
    return mm(max(1.5, 2 * options.robot_radius + 0.6))


def _lane_nodes(out: Field) -> dict[str, float]:
    """Return u of the yard's nodes on the lane."""
    lane, options = out.aisles[0], out.options
    pitch = _pitch(options)
    middle = mm((lane.low + lane.high + options.docks * pitch) / 2)
    positions = {f"Yard{k + 1}": mm(middle - k * pitch) for k in range(options.docks)}
    positions["YardGate"] = mm(middle - options.docks * pitch - 1.0)
    return positions


def yard(out: Field, shed: float) -> dict[str, float]:
    """Add the yard along the longest side: docks, a gate, a barn and a water tank, as far as there is room.

    shed: length of the barn in metres; 0: none.

    Returns its nodes on the lane, and their u.
    """
    site, options, lane = out.site, out.options, out.aisles[0]
    positions = _lane_nodes(out)
    radius = options.robot_radius
    reach = lane.v - max(2.0, 2 * radius + 0.5)
    first, gate = positions["Yard1"], positions["YardGate"]
    if gate - 0.5 < lane.low or first + 0.5 > lane.high:
        raise invalid_option_error(
            "docks", f"the lane of {lane.high - lane.low:.1f} m has no room for {options.docks} docks"
        )
    low_u, high_u = max(lane.low, gate - 2.0), min(lane.high, first + radius + shed + 7.0)
    site.draw(out.area(low_u, 0.0, high_u, lane.v + 1.0), "gravel")
    free = shapely.buffer(site.fence, -0.3)
    for name, u in positions.items():
        site.node(name, out.to_local(u, lane.v), yaw=out.yaw)
    for k in range(options.docks):
        u = positions[f"Yard{k + 1}"]
        dock = f"Dock{k + 1}"
        facing = out.yaw - math.pi / 2
        charging: dict[str, Any] = {"openrmf": {"parameters": {"is_charger": [4, True], "is_parking_spot": [4, True]}}}
        site.node(dock, out.to_local(u, reach), yaw=facing, **charging)
        site.add_edges(f"Yard{k + 1}", dock, speed=0.5)
        behind = mm(reach - radius - 2 * SLACK * site.resolution - 0.25)
        place = out.to_local(u, behind)
        open_to = lowest(out, u, min(radius + 0.3, options.headland / 2))
        if open_to is None or open_to > reach or not free.contains(rectangle(*place, out.yaw, 0.6, 0.4)):
            raise invalid_option_error(
                "yard", f"{options.yard:g} m is too shallow for the docks of a robot of radius {radius:g} m"
            )
        site.box(
            f"charger{k + 1}", "machine", place, (0.6, 0.4, 0.9), yaw=out.yaw, colour="charger", name=f"Charger {k + 1}"
        )
    below = lowest(out, gate, min(radius + 0.5, options.headland / 2))
    if below is None or lane.v - below < 0.5:
        raise invalid_option_error("yard", f"{options.yard:g} m is too shallow for a gate")
    site.node("Gate", out.to_local(gate, below), yaw=out.yaw + math.pi / 2)
    site.add_edges("YardGate", "Gate", speed=0.5)
    start = first + radius + 1.0
    depth = mm(min(5.0, lane.v - 2.5 - radius))
    tank = out.to_local(start + shed + 2.0, 2.0)
    places = [out.to_local(u, 0.5 + depth / 2) for u in (start + shed / 2, gate - 2.0 - shed / 2)]
    barn = next((at for at in places if free.contains(rectangle(*at, out.yaw, shed, depth))), None) if shed else None
    if barn is not None:
        site.box("barn", "building", barn, (shed, depth, 4.0), yaw=out.yaw, colour="roof", name="Barn")
    elif shed:
        site.notes.drop("barns", 1, "the yard has no room for it")
    wet = shapely.Point(tank).buffer(1.5, quad_segs=4)
    if free.contains(wet):
        site.post("tank", "obstacle", tank, 1.0, 2.2, colour="water", name="Water tank")
        site.zone("keepout-tank", "keepout", wet, name="Water tank")
    else:
        site.notes.drop("water tanks", 1, "the yard has no room for it")
    slow = out.area(low_u, 0.0, high_u, lane.v + 1.0)
    if slow.geom_type == "Polygon":
        site.zone("speed-yard", "speed", slow, name="Yard", value=0.5)
    return positions


def lowest(out: Field, u: float, margin: float) -> float | None:
    """Return the lowest v below the lane that is straight ahead and at least a margin from the fence; else None."""
    inner, top = out.inner(margin), out.aisles[0].v
    if inner.is_empty:
        return None
    cut = shapely.intersection(inner, shapely.LineString([(u, inner.bounds[1] - 1), (u, top)]))
    pieces = [p.bounds for p in shapely.get_parts(cut) if p.geom_type == "LineString"]
    return next((mm(low) for _, low, _, high in pieces if abs(high - top) < 1e-6), None)

"""Fields: rows within any fence, along its longest side, and the network that robots in polytunnels use.

In a field's own frame u runs along the rows and v across them, from the longest side of the fence inwards. There is a
yard along that side, then a lane, then rows with an aisle between each two. Nodes of an aisle are named as in the
strawberry polytunnels of Riseholme: ``r1.5-ca`` (headland), ``-cb`` (row's end), ``-c0``, ``-c1`` …, ``-cy``, ``-cz``;
edges along the row are ``row_traversal``, those from one aisle to the next ``row_change``, others ``move_base``.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely

from app.generate._shapes import mm, rectangle, round_geometry
from app.generate._site import MAX_NODES, SLACK, Site, SiteOptions, invalid_option_error
from app.model.aisles import stop_positions
from app.parameters import parameter

MIN_AISLE_METRES = 2.0
"""Minimum length of an aisle between its headlands, in metres."""

MAX_ROWS = 500


@dataclass(frozen=True, slots=True)
class FieldOptions(SiteOptions):
    """Parameters that every field has."""

    row_length: float | None = parameter(
        None,
        "maximum length of a row; default: as long as the fence allows, 40 without a fence",
        minimum=3.0,
        maximum=1000.0,
        unit="m",
    )
    headland: float = parameter(
        5.0,
        "depth of the headland between a row's end and the fence, where robots turn",
        minimum=1.5,
        maximum=50.0,
        unit="m",
    )
    yard: float = parameter(8.0, "depth of the yard along the longest side", minimum=6.0, maximum=50.0, unit="m")
    docks: int = parameter(2, "number of charging docks in the yard", minimum=1, maximum=20)
    node_spacing: float = parameter(3.0, "distance between two nodes of an aisle", minimum=1.0, maximum=100.0, unit="m")


@dataclass(slots=True)
class Aisle:
    """Aisle between two rows. low, high: its ends along u.

    west, east: whether a robot can change there to the aisle before it.
    """

    name: str
    v: float
    low: float
    high: float
    west: bool = False
    east: bool = False


@dataclass(slots=True)
class Row:
    """Row or other line between two aisles. number: from 1 in its kind. low, high: its ends along u."""

    number: int
    v: float
    low: float
    high: float
    kind: str

    @property
    def length(self) -> float:
        """Length in metres."""
        return self.high - self.low


@dataclass(frozen=True, slots=True)
class Line:
    """Planned row, and the aisle behind it. kind: ``row``, or another one without plants (``legs``)."""

    kind: str
    number: int
    aisle: str


@dataclass(slots=True)
class Field:
    """Field on a site. yaw: of the rows. origin: local metres of u = v = 0."""

    site: Site
    options: FieldOptions
    yaw: float
    origin: tuple[float, float]
    rows: list[Row] = field(default_factory=list)
    aisles: list[Aisle] = field(default_factory=list)

    def to_local(self, u: float, v: float) -> tuple[float, float]:
        """Return a position in local metres."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return mm(self.origin[0] + c * u - s * v), mm(self.origin[1] + s * u + c * v)

    def area(self, low_u: float, low_v: float, high_u: float, high_v: float) -> Any:
        """Return a rectangle of the field, within the fence, in local metres."""
        corners = [self.to_local(u, v) for u, v in ((low_u, low_v), (high_u, low_v), (high_u, high_v), (low_u, high_v))]
        return round_geometry(shapely.intersection(shapely.Polygon(corners), self.site.fence))

    def strip(self, row: Row, width: float) -> Any:
        """Return the ground of a row, in local metres."""
        x, y = self.to_local((row.low + row.high) / 2, row.v)
        return rectangle(x, y, self.yaw, row.length, width)

    def line(self, row: Row) -> Any:
        """Return a row's centreline, in local metres."""
        return shapely.LineString([self.to_local(row.low, row.v), self.to_local(row.high, row.v)])

    def trim_after(self, kind: str) -> None:
        """Drop everything after the last line of a kind."""
        last = max((k for k, row in enumerate(self.rows) if row.kind == kind), default=-1)
        self.rows = self.rows[: last + 1]
        top = self.rows[-1].v if self.rows else 0.0
        self.aisles = [aisle for aisle in self.aisles if aisle.v < top or aisle is self.aisles[0]]

    def inner(self, margin: float) -> Any:
        """Return the fence without a margin, in the field's frame."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)

        def turned(xy: Any) -> Any:
            d = xy - np.array(self.origin)
            return np.column_stack([c * d[:, 0] + s * d[:, 1], c * d[:, 1] - s * d[:, 0]])

        return shapely.buffer(shapely.transform(self.site.fence, turned), -margin, join_style="mitre")


def number_rows(rows: int) -> list[Line]:
    """Yield rows 1, 2, 3 … and the aisles behind them."""
    return [Line("row", k, f"r{k}.5") for k in range(1, rows + 1)]


def open_field(
    site: Site,
    options: FieldOptions,
    lines: Sequence[Line],
    *,
    row_count: int | None,
    spacing: float,
    half: float,
    word: str = "row_spacing",
    length: float = 40.0,
) -> Field:
    """Lay out a field on the site, with the rows and aisles that its fence can contain.

    Args:
        lines: the sequence of lines, at most.
        row_count: number of lines of a site without a fence; None: all, if they were requested.
        spacing: metres from one to the next.
        half: metres from a row's centre to its side, including all jitter.
        word: the parameter that decides ``half``.

    Raises CannotGenerate if a robot has no room.
    """
    margin = 2.0
    count = len(lines) if row_count is None else row_count
    across = (options.row_length or length) + 2 * options.headland
    depth = options.yard + options.headland * 1.5 + (count - 1) * spacing
    room = min(spacing, options.headland) / 2 - options.robot_radius - half
    fence = site.set_fence(shapely.box(-margin, -margin, across - margin, depth - margin), room=room)
    out = Field(site, options, 0.0, (-margin, -margin))
    if site.is_given:
        out.yaw, out.origin = _longest(fence)
    else:
        lines = lines[:count]
    _check_room(site, options, spacing, half, word)
    _lay(out, lines, spacing, count_lost=row_count is None)
    nodes = 2 + 2 * options.docks + sum(len(stops(out, aisle)) for aisle in out.aisles[1:])
    if nodes > MAX_NODES - 200:
        raise invalid_option_error("node_spacing", f"there would be {nodes} nodes; the limit is {MAX_NODES - 200}")
    return out


def _longest(fence: Any) -> tuple[float, tuple[float, float]]:
    """Return (direction, start) of the fence's longest side, with the inside on its left."""
    plain = shapely.orient_polygons(shapely.simplify(fence, 0.5))
    ring = shapely.get_coordinates(plain.exterior)
    step = np.diff(ring, axis=0)
    longest = int(np.argmax(np.round(np.hypot(step[:, 0], step[:, 1]), 3)))
    (x, y), (dx, dy) = ring[longest].tolist(), step[longest].tolist()
    return round(math.atan2(dy, dx), 6), (mm(x), mm(y))


def _check_room(site: Site, options: FieldOptions, spacing: float, half: float, word: str) -> None:
    """Check that a robot fits between two rows, and around their ends."""
    needed = options.robot_radius + half + SLACK * site.resolution
    if spacing / 2 < needed:
        raise invalid_option_error(
            word,
            f"rows {spacing:.2f} m apart that reach {half:.2f} m to each side are too close for a robot of radius "
            f"{options.robot_radius:g} m: at least {2 * needed:.2f} m are needed with cells of {site.resolution:g} m",
        )
    if options.headland / 2 < needed:
        raise invalid_option_error(
            "headland", f"must be at least {2 * needed:.2f} m for robots to turn, got {options.headland:g} m"
        )


def _lay(out: Field, lines: Sequence[Line], spacing: float, *, count_lost: bool) -> None:
    """Return rows and aisles, from the lane up to the end of the fence."""
    options, site = out.options, out.site
    turn = options.headland / 2
    inner = out.inner(turn)
    drive = out.inner(options.robot_radius + SLACK * site.resolution)
    if inner.is_empty:
        raise invalid_option_error(
            "headland", f"the fence is too small for a field with a headland of {options.headland:g} m"
        )
    v = max(options.yard, turn)
    lane = _widest_row(inner, v, None)
    if lane is None or lane[1] - lane[0] < options.headland + MIN_AISLE_METRES:
        raise invalid_option_error(
            "yard",
            f"the fence has no room for a lane of {options.headland + MIN_AISLE_METRES:g} m behind a yard of "
            f"{options.yard:g} m",
        )
    lane = _longest_aisle(lane, options)
    out.aisles.append(Aisle("Lane", v, *lane))
    v += turn
    left = 0
    for k, line in enumerate(lines):
        before = out.aisles[-1]
        last = k == len(lines) - 1
        span = None if last else _widest_row(inner, v + spacing / 2, (before.low, before.high))
        if span is not None:
            span = _longest_aisle(span, options, (before.low, before.high))
        if span is None or span[1] - span[0] < options.headland + MIN_AISLE_METRES:
            span = None
        after = None if span is None else Aisle(line.aisle, v + spacing / 2, *span)
        if after is not None:
            ends = [((before.low, before.v), (after.low, after.v)), ((before.high, before.v), (after.high, after.v))]
            after.west, after.east = (drive.contains(shapely.LineString(end)) for end in ends)
            if not (after.west or after.east):
                after = None
        row = _row(line, v, before, after, inner, turn)
        if row is not None:
            out.rows.append(row)
        if after is None:
            left = sum(one.kind == "row" for one in lines[k + 1 :]) if count_lost else 0
            break
        out.aisles.append(after)
        v += spacing
    if not any(row.kind == "row" for row in out.rows):
        raise invalid_option_error(
            "headland", "the fence has no room for a row: use a smaller headland, yard or row_spacing"
        )
    site.notes.drop("rows", left, "the fence has no room for them, or no path to them")


def _row(line: Line, v: float, before: Aisle, after: Aisle | None, inner: Any, turn: float) -> Row | None:
    """Return the row between two aisles, a headland shorter than both."""
    low = before.low if after is None else max(before.low, after.low)
    high = before.high if after is None else min(before.high, after.high)
    span = _widest_row(inner, v, (low, high))
    if span is None:
        return None
    low, high = max(low, span[0]) + turn, min(high, span[1]) - turn
    return Row(line.number, v, low, high, line.kind) if high - low >= 1.0 else None


def _widest_row(area: Any, v: float, before: tuple[float, float] | None) -> tuple[float, float] | None:
    """Return the longest piece of an area at a height v, or the one that overlaps most with ``before``."""
    low, _, high, _ = area.bounds
    cut = shapely.intersection(area, shapely.LineString([(low - 1, v), (high + 1, v)]))
    pieces = [p.bounds for p in shapely.get_parts(cut) if p.geom_type == "LineString" and p.length > 0]
    best: tuple[float, tuple[float, float]] | None = None
    for a, _, b, _ in pieces:
        common = b - a if before is None else min(b, before[1]) - max(a, before[0])
        if common > 0 and (best is None or common > best[0] + 1e-6):
            best = (common, (mm(a), mm(b)))
    return None if best is None else best[1]


def _longest_aisle(
    reach: tuple[float, float], options: FieldOptions, before: tuple[float, float] | None = None
) -> tuple[float, float]:
    """Return an aisle for rows of maximum length: from its start, or from the start of the one before."""
    if options.row_length is None:
        return reach
    low = reach[0] if before is None else max(reach[0], before[0])
    return low, min(reach[1], mm(low + options.row_length + 2 * options.headland / 2))


# --- network and yard -------------------------------------------------------------------------------------------------


def stops(out: Field, aisle: Aisle) -> list[tuple[str, float]]:
    """Return an aisle's nodes and their u: headland, row's end, along the row, row's end, headland."""
    return stop_positions(aisle.low, aisle.high, out.options.headland / 2, out.options.node_spacing)


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
    for name, u in at_ends:
        site.node(name, out.to_local(u, lane.v), yaw=out.yaw)
    listed = sorted([*((u, name) for name, u in on_lane.items()), *((u, name) for name, u in at_ends)])
    for (_, a), (_, b) in itertools.pairwise(listed):
        site.add_edges(a, b, speed=lane_speed)
    ends, round_both = {"Lane": ("LaneWest", "LaneEast")}, True
    for number, aisle in enumerate(out.aisles[1:]):
        round_both = round_both and aisle.west and aisle.east
        names = [
            site.node(f"{aisle.name}-{name}", out.to_local(u, aisle.v), yaw=out.yaw) for name, u in stops(out, aisle)
        ]
        single = one_way and round_both
        for a, b in itertools.pairwise(names if number % 2 == 0 else names[::-1]):
            site.add_edges(a, b, action=along, speed=aisle_speed, both=not single)
        ends[aisle.name] = (names[0], names[-1])
    for before, after in itertools.pairwise(out.aisles):
        for side, good in ((0, after.west), (1, after.east)):
            if good:
                action = "move_base" if before is lane else change
                site.add_edges(ends[before.name][side], ends[after.name][side], action=action, speed=lane_speed)


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


def yard(out: Field) -> dict[str, float]:
    """Add the yard along the longest side: docks, a gate, a barn and a water tank, as far as there is room.

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
    low_u, high_u = max(lane.low, gate - 2.0), min(lane.high, first + radius + 14.0)
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
    barn = out.to_local(start + 3.5, 0.5 + depth / 2)
    tank = out.to_local(start + 9.0, 2.0)
    if free.contains(rectangle(*barn, out.yaw, 7.0, depth)):
        site.box("barn", "building", barn, (7.0, depth, 4.0), yaw=out.yaw, colour="roof", name="Barn")
    else:
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


def ground(out: Field, *, field_colour: str, lane_colour: str = "path") -> None:
    """Paint field, headlands and lane."""
    site, turn = out.site, out.options.headland / 2
    for row in out.rows:
        site.draw(out.strip(Row(row.number, row.v, row.low - turn, row.high + turn, row.kind), 2 * turn), lane_colour)
    lane = out.aisles[0]
    site.draw(
        shapely.LineString([out.to_local(lane.low, lane.v), out.to_local(lane.high, lane.v)]).buffer(1.2), lane_colour
    )
    if out.rows:
        spacing = out.rows[1].v - out.rows[0].v if len(out.rows) > 1 else 2.0
        for row in out.rows:
            site.draw(out.strip(row, spacing + 0.1), field_colour)


def between(row: Row, step: float) -> list[float]:
    """Return positions along a row, a step apart, with equal distances at both ends."""
    count = int(row.length / step + 1e-9)
    first = row.low + (row.length - count * step) / 2
    return [first + step * k for k in range(count + 1)]

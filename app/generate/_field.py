"""Fields: rows within any fence, along its longest side, and the network that robots in polytunnels use.

In a field's own frame u runs along the rows and v across them, from the longest side of the fence inwards. There is a
yard along that side, then a lane, then rows with an aisle between each two. Nodes of an aisle are named as in the
strawberry polytunnels of Riseholme: ``r1.5-ca`` (headland), ``-cb`` (row's end), ``-c0``, ``-c1`` …, ``-cy``, ``-cz``;
edges along the row are ``row_traversal``, those from one aisle to the next ``row_change``, others ``move_base``.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely

from app.generate._shapes import angle, mm, rectangle, round_geometry
from app.generate._site import MAX_NODES, SLACK, Site, SiteOptions, invalid_option_error
from app.generate._variety import drawn
from app.model.aisles import stop_positions
from app.parameters import parameter

MIN_AISLE_METRES = 2.0
"""Minimum length of an aisle between its headlands, in metres."""

MAX_ROWS = 500

MARGIN_METRES = 2.0
"""Distance of a field without a fence from the origin, in metres."""

DEFAULT_ROW_METRES = 40.0
"""Length of rows by which an environment's fence is not yet known, in metres."""

CURVE_STEP_METRES = 2.0
"""Length of the straight pieces of a curved row, in metres."""

MAX_SLOPE = 0.4
"""Maximum slope of a curved row against a straight one."""

MAX_SLANT = 1.0
"""Maximum metres by which a field without a fence widens or leans for each metre across the rows."""

MIN_PIECE_METRES = 3.0
"""Minimum length of a row's piece between two aisles across, in metres."""


@dataclass(frozen=True, slots=True)
class FieldOptions(SiteOptions):
    """Parameters that every field has."""

    like: str | None = parameter(
        None,
        "environment of the server whose rows are measured (network, objects, grid): parameters that are not set are "
        "drawn from its ranges",
    )
    row_length: float | None = drawn(
        28.0,
        60.0,
        "maximum length of a row",
        step=0.5,
        minimum=3.0,
        maximum=1000.0,
        unit="m",
        fence="as long as the fence allows",
        yields="high",
        helps=("docks", "yard"),
    )
    angle: float | None = drawn(
        0.0,
        179.5,
        "direction of the rows, counter-clockwise from the x axis",
        step=0.5,
        minimum=-360.0,
        maximum=360.0,
        unit="°",
        fence="along the fence's longest side",
    )
    skew: float | None = drawn(
        -14.0,
        14.0,
        "angle by which the rows' starts lean against the direction across the rows",
        step=0.5,
        minimum=-45.0,
        maximum=45.0,
        unit="°",
        fence="as the fence has it",
    )
    taper: float | None = drawn(
        -0.25,
        0.15,
        "share by which the last row is longer than the first",
        step=0.01,
        minimum=-0.6,
        maximum=0.6,
        fence="as the fence has it",
        yields="zero",
    )
    headland: float = drawn(
        3.5,
        7.0,
        "depth of the headland between a row's end and the fence, where robots turn",
        step=0.1,
        minimum=1.5,
        maximum=50.0,
        unit="m",
        yields="low",
        helps=("yard", "docks", "rows_per_tunnel"),
    )
    yard: float = drawn(
        7.0,
        12.0,
        "depth of the yard along the longest side",
        step=0.5,
        minimum=6.0,
        maximum=50.0,
        unit="m",
        yields="low",
        helps=("headland",),
    )
    docks: int = drawn(1, 4, "number of charging docks in the yard", step=1, minimum=1, maximum=20, yields="low")
    node_spacing: float = parameter(3.0, "distance between two nodes of an aisle", minimum=1.0, maximum=100.0, unit="m")


@dataclass(frozen=True, slots=True)
class FarmOptions(FieldOptions):
    """Parameters of fields with a farm's yard."""

    shed: float = drawn(
        0.0, 12.0, "length of the shed in the yard; 0: none", step=4.0, minimum=0.0, maximum=50.0, unit="m"
    )


@dataclass(frozen=True, slots=True)
class RowOptions(FarmOptions):
    """Parameters of fields whose rows are of single plants: they may be curved, crossed and have gaps."""

    curve: float | None = drawn(
        -1.5,
        1.5,
        "how far the middle of the field's rows lies beside the line between their ends",
        step=0.1,
        minimum=-50.0,
        maximum=50.0,
        unit="m",
        fence="0 in a fence",
        yields="zero",
    )
    missing: float = drawn(
        0.0, 0.08, "share of plants that are missing, some beside each other", step=0.005, minimum=0.0, maximum=0.9
    )
    cross_aisles: int = drawn(
        0, 1, "number of aisles across all rows", step=1, minimum=0, maximum=20, yields="low", helps=("row_length",)
    )
    cross_width: float = drawn(
        3.0, 5.0, "width of an aisle across the rows", step=0.1, minimum=1.0, maximum=30.0, unit="m"
    )


@dataclass(frozen=True, slots=True)
class Layout:
    """How the rows of a field lie; metres.

    Attributes:
        spacing: from one row to the next.
        half: from a row's centre to its side, including all jitter.
        word: the parameter that decides ``half``.
        curve: how far the middle of a row lies beside the line between its ends.
        crossings, crossing_width: aisles across the rows.
    """

    spacing: float
    half: float
    word: str = "row_spacing"
    curve: float = 0.0
    crossings: int = 0
    crossing_width: float = 0.0


@dataclass(slots=True)
class Aisle:
    """Aisle between two rows. low, high: its ends along u.

    west, east: whether a robot can change there to the aisle before it. crossings: u of the aisles across the rows, by
    their number; crossed: of those on which a robot can change to the aisle before it.
    """

    name: str
    v: float
    low: float
    high: float
    west: bool = False
    east: bool = False
    crossings: dict[int, float] = field(default_factory=dict)
    crossed: set[int] = field(default_factory=set)


@dataclass(slots=True)
class Row:
    """Row or other line between two aisles. number: from 1 in its kind. low, high: its ends along u.

    part: of a row that aisles cross, from 1; 0 if none does.
    """

    number: int
    v: float
    low: float
    high: float
    kind: str
    part: int = 0

    @property
    def name(self) -> str:
        """Its number, and a letter for each part of a crossed row: 3, 4a, 4b."""
        return f"{self.number}{chr(96 + self.part) if self.part else ''}"

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
    """Field on a site. yaw: of the rows. origin: local metres of u = v = 0. middle, reach: of the rows along u."""

    site: Site
    options: FieldOptions
    yaw: float
    origin: tuple[float, float]
    curve: float = 0.0
    middle: float = 0.0
    reach: float = 1.0
    rows: list[Row] = field(default_factory=list)
    aisles: list[Aisle] = field(default_factory=list)

    def bend(self, u: Any) -> Any:
        """Return by how many metres a curved row lies beside a straight one at u (a number or an array)."""
        return self.curve * (1.0 - ((u - self.middle) / self.reach) ** 2) if self.curve else 0.0 * u

    def heading(self, u: float) -> float:
        """Return the direction of the rows at u."""
        return angle(self.yaw + math.atan(-2 * self.curve * (u - self.middle) / self.reach**2))

    @property
    def steepest(self) -> float:
        """Return the largest slope of a curved line against a straight one, at the fence."""
        return 2 * abs(self.curve) * (self.reach + self.options.headland) / self.reach**2

    def to_local(self, u: float, v: float) -> tuple[float, float]:
        """Return a position in local metres."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        v = v + self.bend(u)
        return mm(self.origin[0] + c * u - s * v), mm(self.origin[1] + s * u + c * v)

    def shape_to_local(self, shape: Any) -> Any:
        """Convert a shape of the field's frame to local metres."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)

        def moved(uv: Any) -> Any:
            u, v = uv[:, 0], uv[:, 1] + self.bend(uv[:, 0])
            return np.column_stack([self.origin[0] + c * u - s * v, self.origin[1] + s * u + c * v])

        return round_geometry(shapely.transform(self.dense(shape), moved))

    def dense(self, shape: Any) -> Any:
        """Return a shape with corners close enough that its sides follow curved rows."""
        return shapely.segmentize(shape, CURVE_STEP_METRES) if self.curve else shape

    def area(self, low_u: float, low_v: float, high_u: float, high_v: float) -> Any:
        """Return a rectangle of the field, within the fence, in local metres."""
        whole = self.shape_to_local(shapely.box(low_u, low_v, high_u, high_v))
        return round_geometry(shapely.intersection(whole, self.site.fence))

    def strip(self, row: Row, width: float) -> Any:
        """Return the ground of a row, in local metres."""
        if self.curve:
            return self.shape_to_local(shapely.box(row.low, row.v - width / 2, row.high, row.v + width / 2))
        x, y = self.to_local((row.low + row.high) / 2, row.v)
        return rectangle(x, y, self.yaw, row.length, width)

    def line(self, row: Row) -> Any:
        """Return a row's centreline, in local metres."""
        return self.shape_to_local(shapely.LineString([(row.low, row.v), (row.high, row.v)]))

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
            u = c * d[:, 0] + s * d[:, 1]
            return np.column_stack([u, c * d[:, 1] - s * d[:, 0] - self.bend(u)])

        return shapely.transform(self.dense(shapely.buffer(self.site.fence, -margin, join_style="mitre")), turned)


def number_rows(rows: int) -> list[Line]:
    """Yield rows 1, 2, 3 … and the aisles behind them."""
    return [Line("row", k, f"r{k}.5") for k in range(1, rows + 1)]


def row_layout(options: RowOptions, spacing: float, half: float, word: str = "row_spacing") -> Layout:
    """Return the layout of a field of single plants; see ``Layout``."""
    crossings = (options.cross_aisles, options.cross_width)
    return Layout(spacing, half, word, options.curve or 0.0, *crossings)


def open_field(site: Site, options: FieldOptions, lines: Sequence[Line], layout: Layout, *, count: int | None) -> Field:
    """Lay out a field on the site, with the rows and aisles that its fence can contain.

    Args:
        lines: the sequence of lines, at most.
        count: number of lines that were requested, and of a site without a fence; None: as many as the fence contains.

    Raises CannotGenerate if a robot has no room.
    """
    out = Field(site, options, math.radians(options.angle or 0.0), (-MARGIN_METRES, -MARGIN_METRES))
    if count is not None:
        lines = lines[:count]
    length = options.row_length or DEFAULT_ROW_METRES
    _bend(out, layout, length)
    room = min(layout.spacing, options.headland) / 2 - options.robot_radius - layout.half
    fence = site.set_fence(_outline(out, layout, length, len(lines)), room=room)
    if site.is_given:
        for word in ("skew", "taper"):
            if getattr(options, word) is not None:
                raise invalid_option_error(word, "the environment's fence decides where rows end: omit it")
        out.yaw, out.origin = _longest(fence) if options.angle is None else _along(fence, options.angle)
        _bend(out, layout, None)
    _check_room(out, options, layout)
    _lay(out, lines, layout, count_lost=count is not None)
    _cross(out, layout)
    nodes = 2 + 2 * options.docks + sum(len(stops(out, aisle)) for aisle in out.aisles[1:])
    if nodes > MAX_NODES - 200:
        raise invalid_option_error("node_spacing", f"there would be {nodes} nodes; the limit is {MAX_NODES - 200}")
    return out


def _bend(out: Field, layout: Layout, length: float | None) -> None:
    """Set the curve of the rows. length: of a row that begins a headland from u = 0; None: as the fence has it."""
    out.curve, headland = 0.0, out.options.headland
    low, high = headland, headland + (length or 0.0)
    if length is None:
        west, _, east, _ = out.inner(0.0).bounds
        low, high = west + headland, east - headland
    out.middle, out.reach, out.curve = (low + high) / 2, max((high - low) / 2, 1.0), layout.curve
    if out.steepest > MAX_SLOPE:
        raise invalid_option_error(
            "curve",
            f"{layout.curve:g} m is too much for rows of {max(high - low, 0.0):.0f} m: they would turn by more than "
            f"{math.degrees(math.atan(MAX_SLOPE)):.0f}°; use less",
        )


def _outline(out: Field, layout: Layout, length: float, count: int) -> Any:
    """Return the fence of a field without one, in local metres: it leans and widens as the rows do."""
    options, turn = out.options, out.options.headland / 2
    lean = math.tan(math.radians(options.skew or 0.0))
    depth = options.yard + 1.5 * options.headland + (count - 1) * layout.spacing
    field_depth = (count - 1) * layout.spacing
    widening = (options.taper or 0.0) * length
    slant = lean + (widening / field_depth if field_depth > 0 else 0.0)
    if abs(slant) > MAX_SLANT:
        raise invalid_option_error(
            "taper",
            f"rows of {length:g} m would change by more than {MAX_SLANT:g} of the distance between them: use less",
        )
    west, east = (turn * (math.hypot(1.0, v) + 1.0) + layout.spacing * abs(v) / 2 for v in (lean, slant))
    first = options.yard + turn  # the fence is straight along the yard
    back = depth - first
    corners = [
        (0.0, 0.0),
        (length + west + east, 0.0),
        (length + west + east, first),
        (length + west + east + slant * back, depth),
        (lean * back, depth),
        (0.0, first),
    ]
    return out.shape_to_local(shapely.Polygon(corners))


def _along(fence: Any, direction: float) -> tuple[float, tuple[float, float]]:
    """Return (yaw, start) of rows in a direction, degrees: from the fence's first corner across them."""
    yaw = angle(math.radians(direction))
    ring = shapely.get_coordinates(fence.exterior)
    across = np.round(-math.sin(yaw) * ring[:, 0] + math.cos(yaw) * ring[:, 1], 3)
    x, y = ring[int(np.argmin(across))].tolist()
    return yaw, (mm(x), mm(y))


def _longest(fence: Any) -> tuple[float, tuple[float, float]]:
    """Return (direction, start) of the fence's longest side, with the inside on its left."""
    plain = shapely.orient_polygons(shapely.simplify(fence, 0.5))
    ring = shapely.get_coordinates(plain.exterior)
    step = np.diff(ring, axis=0)
    longest = int(np.argmax(np.round(np.hypot(step[:, 0], step[:, 1]), 3)))
    (x, y), (dx, dy) = ring[longest].tolist(), step[longest].tolist()
    return round(math.atan2(dy, dx), 6), (mm(x), mm(y))


def _check_room(out: Field, options: FieldOptions, layout: Layout) -> None:
    """Check that a robot fits between two rows, and around their ends."""
    size = out.site.resolution
    needed = (options.robot_radius + layout.half + SLACK * size) * math.hypot(1.0, out.steepest)
    for word, width in ((layout.word, layout.spacing), ("cross_width", layout.crossing_width + 2 * layout.half)):
        if width / 2 < needed and (word == layout.word or layout.crossings):
            raise invalid_option_error(
                word,
                f"rows {width:.2f} m apart that reach {layout.half:.2f} m to each side are too close for a robot of "
                f"radius {options.robot_radius:g} m: at least {2 * needed:.2f} m are needed with cells of {size:g} m",
            )
    if options.headland / 2 < needed:
        raise invalid_option_error(
            "headland", f"must be at least {2 * needed:.2f} m for robots to turn, got {options.headland:g} m"
        )


def _lay(out: Field, lines: Sequence[Line], layout: Layout, *, count_lost: bool) -> None:
    """Return rows and aisles, from the lane up to the end of the fence."""
    options, site, spacing = out.options, out.site, layout.spacing
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
            f"{options.yard:g} m: use a smaller yard or headland",
        )
    limit = options.row_length if site.is_given else None
    lane = _longest_aisle(lane, limit, options)
    out.aisles.append(Aisle("Lane", v, *lane))
    v += turn
    left = 0
    for k, line in enumerate(lines):
        before = out.aisles[-1]
        last = k == len(lines) - 1
        span = None if last else _widest_row(inner, v + spacing / 2, (before.low, before.high))
        if span is not None:
            span = _longest_aisle(span, limit, options, (before.low, before.high))
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
    reach: tuple[float, float], limit: float | None, options: FieldOptions, before: tuple[float, float] | None = None
) -> tuple[float, float]:
    """Return an aisle for rows of a maximum length: from its start, or from the start of the one before."""
    if limit is None:
        return reach
    low = reach[0] if before is None else max(reach[0], before[0])
    return low, min(reach[1], mm(low + limit + 2 * options.headland / 2))


def _cross(out: Field, layout: Layout) -> None:
    """Lead aisles across the rows, at equal distances, where they leave pieces of rows on both sides."""
    drive = out.inner(out.options.robot_radius + SLACK * out.site.resolution)
    low = float(np.median([row.low for row in out.rows]))
    high = float(np.median([row.high for row in out.rows]))
    half = layout.crossing_width / 2
    places = {k: mm(low + (high - low) * k / (layout.crossings + 1)) for k in range(1, layout.crossings + 1)}
    if layout.crossings and (high - low) / (layout.crossings + 1) < 2 * half + MIN_PIECE_METRES:
        raise invalid_option_error(
            "cross_aisles",
            f"rows of {high - low:.1f} m have no room for {layout.crossings} of {2 * half:g} m: use fewer, or longer "
            "rows",
        )
    rows: list[Row] = []
    split: dict[float, set[int]] = {}
    for row in out.rows:
        near = {k: u for k, u in places.items() if row.low + 1.0 < u - half and u + half < row.high - 1.0}
        split[row.v] = set(near)
        cuts = [row.low, *itertools.chain.from_iterable((u - half, u + half) for u in near.values()), row.high]
        for part, (a, b) in enumerate(zip(cuts[::2], cuts[1::2], strict=True), 1):
            rows.append(Row(row.number, row.v, mm(a), mm(b), row.kind, part if near else 0))
    out.rows = rows
    for before, after in itertools.pairwise(out.aisles):
        open_at = split.get(next((v for v in split if before.v < v < after.v), math.nan), set())
        for k in open_at:
            u = places[k]
            if drive.contains(out.dense(shapely.LineString([(u, before.v), (u, after.v)]))):
                before.crossings[k] = after.crossings[k] = u
                after.crossed.add(k)


def stops(out: Field, aisle: Aisle) -> list[tuple[str, float]]:
    """Return an aisle's nodes and their u: headland, row's end, along the row, row's end, headland; cross-aisles."""
    regular = stop_positions(aisle.low, aisle.high, out.options.headland / 2, out.options.node_spacing)
    return sorted([*regular, *((f"x{k}", u) for k, u in aisle.crossings.items())], key=lambda stop: stop[1])


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

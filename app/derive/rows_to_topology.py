"""Rows -> topology: network of the aisles between parallel rows, as people draw it in polytunnels and vineyards."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.derive import DerivationNotes, derives
from app.derive._rows import Course, Row, RowField, half_turn
from app.errors import CannotConvert, Invalid, MissingLayer
from app.model.aisles import stop_positions
from app.model.features import Features, concatenate, features
from app.model.grid import OccupancyGrid, is_occupied
from app.model.layers import MAP, NETWORK, Layers, Part, PartKey
from app.parameters import parameter

KINDS = ("row", "tree_row")

MAX_NODES = 200_000
"""Maximum number of nodes of a network."""

PARALLEL = 10.0
"""Maximum difference of rows of one field in direction, in degrees."""

ONE_LINE = 0.5
"""Distance across, in metres, below which pieces end to end may be one row."""

Item = tuple[str, Any, dict[str, Any]]
Drawn = tuple[NDArray[np.float64], Mapping[str, Any]]
"""Positions [n, 2] of a line of a drawn row, and its properties."""

DrawnRow = list[Drawn]
"""Pieces of a row."""

_ALONE = "no row of their direction lies beside them"


@dataclass(frozen=True, slots=True)
class Parameters:
    """Parameters of rows_to_topology."""

    robot_radius: float = parameter(
        0.3, "radius of the robot; edges keep this distance from obstacles", minimum=0.0, maximum=100.0, unit="m"
    )
    turn: float = parameter(
        2.25,
        "distance from the rows' ends at which robots change from one aisle to the next",
        minimum=0.1,
        maximum=25.0,
        unit="m",
    )
    node_spacing: float = parameter(3.0, "distance between two nodes of an aisle", minimum=1.0, maximum=100.0, unit="m")


@derives(gives="topology", needs={"objects"}, parameters=Parameters, cost=4.0, also=frozenset({"occupancy"}), version=4)
def rows_to_topology(layers: Layers, parameters: Parameters, notes: DerivationNotes) -> Layers:
    """Network of the aisles between rows: nodes along each aisle, at its ends and in the headlands.

    Rows are lines of kind ``row`` or ``tree_row``: from ``imagery_to_rows`` and ``occupancy_to_rows``, or drawn. Nodes
    are named as in Riseholme's polytunnels: ``r1.5-ca`` in the headland, ``-cb`` at the row's end, ``-c0`` … between,
    ``-cy`` and ``-cz`` at the other end. Edges along a row have the action ``row_traversal``, others ``row_change``.
    Rows that lie end to end are fields of their own, or pieces of one row if the same row lies beside them. Names of
    several fields begin with ``f1-``, ``f2-`` … Edges that meet occupied cells of a stored grid ``map`` are left out.
    Raises MissingLayer if there are no rows, CannotConvert if the robot fits between none.
    """
    parts: dict[PartKey, Part] = {}
    by_level: dict[str, list[Features]] = {}
    for key, part in layers.vector("objects").items():
        chosen = part.select_kinds(*KINDS)
        if len(chosen):
            by_level.setdefault(key.level, []).append(chosen)
    if not by_level:
        raise MissingLayer(
            f"the stored objects have no rows: derive them (imagery_to_rows, occupancy_to_rows), or draw lines of kind "
            f"{' or '.join(KINDS)}"
        )
    for level, drawn in by_level.items():
        grid = layers.grids().get(PartKey("occupancy", level, MAP))
        fields = _fields(concatenate(drawn), layers, parameters.turn, notes)
        if not fields:
            raise CannotConvert(
                "no two rows are parallel and side by side: draw or derive at least two rows of a field"
            )
        network = _Network(parameters, grid)
        for number, one in enumerate(fields, 1):
            network.add(one, "" if len(fields) == 1 else f"f{number}-")
        if not network.nodes:
            raise CannotConvert(
                f"a robot of radius {parameters.robot_radius:g} m fits between no two rows: use a smaller robot_radius"
            )
        notes.drop("aisles", network.narrow, f"a robot of radius {parameters.robot_radius:g} m does not fit")
        notes.drop("aisles", network.apart, "their rows do not lie side by side")
        notes.drop("edges", network.blocked, "they would meet occupied cells of the stored grid")
        parts[PartKey("topology", level, NETWORK)] = features([*network.nodes, *network.edges], "local")
    return Layers(parts, layers.datum, layers.levels)


def _fields(drawn: Features, layers: Layers, turn: float, notes: DerivationNotes) -> list[RowField]:
    """Group rows by their field, or by direction if they state none, and where they lie side by side."""
    try:
        metres = drawn.in_local(layers.frame)
    except Invalid as error:  # too far from the datum
        raise CannotConvert(error.detail, error.problems) from error
    groups: dict[Any, list[Drawn]] = {}
    pieces, owner = shapely.get_parts(shapely.force_2d(metres), return_index=True)
    for geometry, properties in zip(pieces, [drawn.properties[k] for k in owner], strict=True):
        if geometry.geom_type != "LineString" or geometry.length == 0:
            continue
        line = shapely.get_coordinates(geometry)
        ends = line[[0, -1]]
        angle = math.degrees(math.atan2(*(ends[1] - ends[0])[::-1])) % 180.0
        name = properties.get("field")
        near = (k for k in groups if isinstance(k, float) and abs((k - angle + 90) % 180 - 90) <= PARALLEL)
        group = name if isinstance(name, int | str) and not isinstance(name, bool) else next(near, float(angle))
        groups.setdefault(group, []).append((line, properties))
    blocks: list[list[DrawnRow]] = []
    for rows in groups.values():
        split, divided = _blocks(rows, turn)
        blocks.extend(split)
        if divided:
            notes.warn("fields with a row beside rows of another field are not connected: add edges between them")
    notes.drop("rows", sum(len(row) for block in blocks if len(block) == 1 for row in block), _ALONE)
    return [_row_field(block) for block in blocks if len(block) > 1]


def _blocks(drawn: list[Drawn], turn: float) -> tuple[list[list[DrawnRow]], bool]:
    """Split parallel rows that do not lie side by side, such as fields end to end.

    Two rows are neighbours if each is the next one that lies beside the other. What is drawn between them in order
    across, but not beside them, is another block. Also returns whether rows of two blocks lie beside each other.
    """
    course = _common_course(drawn)
    rows = _whole_rows(course, drawn, turn)
    before, after = _neighbours([_row(course, row) for row in rows])
    chains: dict[int, list[int]] = {}  # by its last row
    for k in range(len(rows)):
        is_next = before[k] in chains and after[before[k]] == k
        chains[k] = [*chains.pop(before[k]), k] if is_next else [k]
    blocks: dict[int, list[int]] = {}
    for chain in sorted(chains.values()):
        block = blocks.get(chain[0] - 1, [])
        if before[chain[0]] in block or (block and after[block[-1]] in chain):
            del blocks[block[-1]]
            blocks[chain[-1]] = [*block, *chain]
        else:
            blocks[chain[-1]] = chain
    numbers = {k: number for number, block in enumerate(blocks.values()) if len(block) > 1 for k in block}
    beside = [(k, n) for side in (before, after) for k, n in enumerate(side) if k in numbers and n in numbers]
    divided = any(numbers[k] != numbers[n] for k, n in beside)
    return [[rows[k] for k in sorted(block)] for block in blocks.values()], divided


def _whole_rows(course: Course, drawn: list[Drawn], turn: float) -> list[DrawnRow]:
    """Return rows in order across, with the pieces of each: they lie end to end, and beside the same row.

    A gap is no longer than the pieces on its sides: what lies farther apart are fields of their own. Where a robot has
    no room to turn, pieces are one row, whatever lies beside them.
    """
    order = sorted(((_row(course, [one]), one) for one in drawn), key=lambda item: item[0].v)
    pieces = [row for row, _ in order]
    before, after = _neighbours(pieces)
    continues = [False] * len(order)
    """Whether a piece belongs to the same row as the one before it."""
    for side, step in ((before, 1), (after, -1)):  # what is joined tells of the next ones that they lie beside one row
        for k in range(1, len(order))[::step]:
            a, b = sorted(side[k - 1 : k + 1])
            a_row_beside = a >= 0 and b < len(order) and all(continues[a + 1 : b + 1])
            left, right = pieces[k - 1 : k + 1]
            gap = max(left.low, right.low) - min(left.high, right.high)
            is_short = gap <= min(left.high - left.low, right.high - right.low)
            if gap >= 0.0 and (gap < turn or (a_row_beside and is_short)) and right.v - left.v < ONE_LINE:
                continues[k] = True
    rows: list[DrawnRow] = []
    for joined, (_, one) in zip(continues, order, strict=True):
        if joined:
            rows[-1].append(one)
        else:
            rows.append([one])
    return rows


def _neighbours(rows: list[Row]) -> tuple[list[int], list[int]]:
    """Return of each row the last one before and the first one after it beside it; -1 and the number of rows if none.

    The rows are in order across.
    """
    low, high = np.array([row.low for row in rows]), np.array([row.high for row in rows])
    before: list[int] = []
    after: list[int] = []
    for k in range(len(rows)):
        beside = np.flatnonzero((low < high[k]) & (high > low[k]))
        before.append(int(beside[beside < k].max(initial=-1)))
        after.append(int(beside[beside > k].min(initial=len(rows))))
    return before, after


def _common_course(rows: list[Drawn]) -> Course:
    """Return the direction and the bend that drawn rows have in common."""
    steps = np.array([line[-1] - line[0] for line, _ in rows])
    double = 2 * np.arctan2(steps[:, 1], steps[:, 0])
    yaw = half_turn(math.atan2(float(np.sin(double).mean()), float(np.cos(double).mean())) / 2)
    return _course(yaw, [line for line, _ in rows])


def _row_field(rows: list[DrawnRow]) -> RowField:
    """Return drawn rows as a field, with the bend that they have in common."""
    course = _common_course([piece for row in rows for piece in row])
    rows_in_order = tuple(sorted((_row(course, row) for row in rows), key=lambda row: row.v))
    return RowField(course.yaw, rows_in_order, bend=course.bend, middle=course.middle)


def _row(course: Course, pieces: DrawnRow) -> Row:
    """Return a drawn row along a course, as wide and as long as all its pieces."""
    along, across, thick = [], [], 0.0
    for line, properties in pieces:
        u, v = course.turned(line)
        along += [float(u.min()), float(u.max())]
        across.append(float(v.mean()))
        width = properties.get("row_width", properties.get("width"))
        thick = max(thick, float(width) if isinstance(width, int | float) and not isinstance(width, bool) else 0.0)
    low, high = min(across), max(across)
    return Row((low + high) / 2, min(along), max(along), width=thick + high - low, pieces=len(pieces))


def _course(yaw: float, lines: list[NDArray[np.float64]]) -> Course:
    """Return the course of lines near a direction: straight, or the parabola of least squares if any is bent."""
    if all(len(line) == 2 for line in lines):
        return Course(yaw)
    parts = [Course(yaw).turned(line) for line in lines]
    middle = float(np.concatenate([u for u, _ in parts]).mean())
    # each row has its own distance across: only the deviations from a row's mean tell slope and bend
    terms = [np.column_stack([u - middle, (u - middle) ** 2]) for u, _ in parts]
    left = np.concatenate([one - one.mean(axis=0) for one in terms])
    right = np.concatenate([v - v.mean() for _, v in parts])
    slope, bend = np.linalg.lstsq(left, right, rcond=None)[0].tolist()
    turned = yaw + math.atan(slope)
    c, s = math.cos(yaw - turned), math.sin(yaw - turned)
    # the parabola seen along its tangent: to first order of the slope, its bend is the same
    reference = np.concatenate([np.column_stack(part) for part in parts]).mean(axis=0)
    return Course(turned, bend * c**3, c * middle - s * float(reference[1]))


def _low_end(a: Row, b: Row) -> float:
    """Return where the longer of two rows begins."""
    return min(a.low, b.low)


def _high_end(a: Row, b: Row) -> float:
    """Return where the longer of two rows ends."""
    return max(a.high, b.high)


@dataclass(slots=True)
class _Network:
    """Network that grows field by field.

    blocked: number of edges that meet occupied cells. narrow, apart: number of aisles in which the robot does not fit,
    and of those whose rows do not lie side by side.
    """

    parameters: Parameters
    grid: OccupancyGrid | None
    nodes: list[Item] = field(default_factory=list)
    edges: list[Item] = field(default_factory=list)
    blocked: int = 0
    narrow: int = 0
    apart: int = 0

    def add(self, one: RowField, prefix: str) -> None:
        """Add the aisles of a field, and the changes between them."""
        parameters = self.parameters
        before: tuple[Item, Item] | None = None
        number = 0  # counts the lines as drawn
        for a, b in itertools.pairwise(one.rows):
            number += a.pieces
            free = b.v - a.v - (a.width + b.width) / 2
            fits = free >= 2 * parameters.robot_radius
            beside = min(a.high, b.high) > max(a.low, b.low)
            if not (fits and beside):  # neither: pieces of one row, without an aisle between
                self.narrow += beside
                self.apart += fits
                continue
            middle = (a.v + a.width / 2 + b.v - b.width / 2) / 2
            if len(self.nodes) + (_high_end(a, b) - _low_end(a, b)) / parameters.node_spacing > MAX_NODES:
                raise CannotConvert(
                    f"the network would have more than {MAX_NODES} nodes: set a larger node_spacing, or fewer rows"
                )
            # beside the end of the longer row there is no passage to the next aisle
            low, high = _low_end(a, b) - parameters.turn, _high_end(a, b) + parameters.turn
            stops = [
                self._node(f"{prefix}r{number}.5-{suffix}", one.to_local(u, middle))
                for suffix, u in stop_positions(low, high, parameters.turn, parameters.node_spacing)
            ]
            for start, end in itertools.pairwise(stops):
                self._edge(start, end, "row_traversal", free)
            if before is not None:
                for start, end in zip(before, (stops[0], stops[-1]), strict=True):
                    self._edge(start, end, "row_change", None)
            before = stops[0], stops[-1]

    def _node(self, name: str, at: tuple[float, float]) -> Item:
        node: Item = (name, shapely.Point(at), {"kind": "node", "name": name})
        self.nodes.append(node)
        return node

    def _edge(self, a: Item, b: Item, action: str, width: float | None) -> None:
        """Add an edge in both directions, unless it meets occupied cells."""
        line = shapely.LineString([a[1], b[1]])
        if self.grid is not None and _meets(self.grid, line, self.parameters.robot_radius):
            self.blocked += 2
            return
        for start, end, way in ((a[0], b[0], line), (b[0], a[0], shapely.reverse(line))):
            properties: dict[str, Any] = {"kind": "edge", "source": start, "target": end, "action": action}
            if width is not None:
                properties["width"] = round(width, 3)
            self.edges.append((f"{start}_{end}", way, properties))


def _meets(grid: OccupancyGrid, line: Any, radius: float) -> bool:
    """Return whether a robot that follows a line touches the centre of an occupied cell."""
    x, y, yaw = grid.origin
    low_x, low_y, high_x, high_y = line.buffer(radius).bounds
    corners = np.array([(low_x, low_y), (high_x, low_y), (high_x, high_y), (low_x, high_y)]) - (x, y)
    c, s = math.cos(yaw), math.sin(yaw)
    turned = np.column_stack([c * corners[:, 0] + s * corners[:, 1], c * corners[:, 1] - s * corners[:, 0]])
    first = np.maximum(np.floor(turned.min(axis=0) / grid.resolution).astype(int), 0)
    last = np.ceil(turned.max(axis=0) / grid.resolution).astype(int)
    part = grid.cells[first[1] : max(last[1], 0), first[0] : max(last[0], 0)]
    rows, columns = np.nonzero(is_occupied(grid, part))
    if not len(rows):
        return False
    u, v = (columns + first[0] + 0.5) * grid.resolution, (rows + first[1] + 0.5) * grid.resolution
    places = shapely.points(x + c * u - s * v, y + s * u + c * v)
    return bool((shapely.distance(places, line) <= radius).any())

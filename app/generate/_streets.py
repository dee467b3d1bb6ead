"""Streets as a network: lanes with turns at junctions, sidewalks around blocks, crossings between them.

Traffic keeps to the right. A street between two junctions has a lane in each direction, in the middle of its half of
the carriageway; from the end of each lane edges lead into every other lane that begins at the junction; U-turns exist
only at the end of a street. Sidewalks are paths around each block and along the town's edge, in both directions; near
junctions crossings join them over the street. At one point a sidewalk and a lane are joined, so that the network is
connected.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely
from shapely.ops import substring

from app.derive import DerivationNotes
from app.errors import CannotGenerate
from app.generate._blocks import Street
from app.generate._site import MAX_NODES, Site

Point = tuple[float, float]

DANGLE = 0.4
"""Length in metres below which pieces of a street beyond its last junction are rounding errors."""

EXTEND = 0.05
NODES = 8
"""Approximate number of nodes per street between two junctions: ends of lanes and crossings, corners of blocks."""

CORNER = math.radians(15.0)
TOLERANCE = 1.0


@dataclass(frozen=True, slots=True)
class Link:
    """Street between two junctions. ends: numbers of its junctions. width: between house fronts."""

    line: Any
    width: float
    ends: tuple[int, int]


@dataclass(slots=True)
class Loop:
    """Sidewalk around a block. stops: (metres along it, name, position)."""

    ring: Any
    stops: list[tuple[float, str, Point]] = field(default_factory=list)


@dataclass(slots=True)
class Streets:
    """Streets of a town. junctions: their positions. walk: width of a sidewalk."""

    links: list[Link]
    junctions: list[Point]
    walk: float
    loops: list[Loop] = field(default_factory=list)
    kept: list[Point] = field(default_factory=list)
    """Return areas that must stay free of objects: crossings and stops."""

    def carriage(self, link: Link) -> float:
        """Return the width of a street between its sidewalks in metres."""
        return link.width - 2 * self.walk

    def links_at(self, junction: int) -> list[int]:
        """Return the links at a junction; a link that begins and ends there is listed twice."""
        return [k for k, link in enumerate(self.links) for end in link.ends if end == junction]


def build_streets(streets: Sequence[Street], walk: float) -> Streets:
    """Cut streets at their intersections. walk: metres, at most a quarter of the narrowest street."""
    lines = [_longer(s.line) for s in streets]
    joined = shapely.line_merge(shapely.union_all(lines, grid_size=0.001))
    parts = [p for p in shapely.get_parts(joined) if p.geom_type == "LineString" and p.length > 0]
    parts = _trim(parts)
    count = _ends(parts)
    parts = [_shorter(part, count) for part in parts]
    parts.sort(key=lambda p: (p.bounds, p.length))
    tree = shapely.STRtree([s.line for s in streets])
    junctions: dict[Point, int] = {}
    links = []
    for part in parts:
        nearest = int(tree.nearest(shapely.line_interpolate_point(part, 0.5, normalized=True)))
        ends = [junctions.setdefault(_as_point(c), len(junctions)) for c in (part.coords[0], part.coords[-1])]
        links.append(Link(part, streets[nearest].width, (ends[0], ends[1])))
    if NODES * len(links) > MAX_NODES:
        raise CannotGenerate(
            f"the town has {len(links)} streets between junctions, and its network would have more than {MAX_NODES} "
            "nodes: make it smaller, or its blocks larger"
        )
    narrow = min((link.width for link in links), default=4 * walk)
    return Streets(links, list(junctions), min(walk, narrow / 4))


def _longer(line: Any) -> Any:
    """Extend a line a little beyond its ends, so that rounded ends still meet the street at which they end."""
    at = shapely.get_coordinates(line)
    if (at[0] == at[-1]).all():
        return line
    out = at.copy()
    for end, inner in ((0, 1), (-1, -2)):
        step = at[end] - at[inner]
        out[end] = at[end] + step / math.sqrt(float(step @ step)) * EXTEND
    return shapely.LineString(out)


def _trim(parts: list[Any]) -> list[Any]:
    """Remove short pieces that lead nowhere, and join the lines again at these points."""
    count = _ends(parts)
    remaining = [
        p for p in parts if p.length >= DANGLE or min(count[_as_point(c)] for c in (p.coords[0], p.coords[-1])) > 1
    ]
    if len(remaining) == len(parts):
        return parts
    return [p for p in shapely.get_parts(shapely.line_merge(shapely.multilinestrings(remaining))) if p.length > 0]


def _ends(parts: Sequence[Any]) -> dict[Point, int]:
    """Count the lines that end at each point."""
    count: dict[Point, int] = {}
    for part in parts:
        for c in (part.coords[0], part.coords[-1]):
            count[_as_point(c)] = count.get(_as_point(c), 0) + 1
    return count


def _shorter(part: Any, count: dict[Point, int]) -> Any:
    """Remove the extensions of ``_longer`` at ends that met nothing."""
    free = [EXTEND if count[_as_point(c)] == 1 else 0.0 for c in (part.coords[0], part.coords[-1])]
    return substring(part, free[0], part.length - free[1]) if any(free) else part


def _as_point(c: Iterable[float]) -> Point:
    x, y = c
    return round(float(x), 3) + 0.0, round(float(y), 3) + 0.0


# --- lanes ------------------------------------------------------------------------------------------------------------


def lanes(site: Site, streets: Streets, speed: float, keep: float) -> list[list[tuple[str, Any]]]:
    """Add lanes and the paths through junctions; return for each link its lanes: (name of its first node, line).

    keep: distance in metres of paths through junctions from kerbs.
    """
    inner = [
        shapely.buffer(link.line, max(0.05, streets.carriage(link) / 2 - keep), cap_style="square", join_style="mitre")
        for link in streets.links
    ]
    roadway = shapely.union_all(inner)
    shapely.prepare(roadway)
    ends: dict[str, tuple[Point, Point]] = {}
    arriving: dict[int, list[tuple[str, int]]] = {}
    leaving: dict[int, list[tuple[str, int]]] = {}
    out: list[list[tuple[str, Any]]] = []
    for k, link in enumerate(streets.links):
        out.append([])
        for name, line, (start, end) in (
            ("a", link.line, link.ends),
            ("b", shapely.reverse(link.line), link.ends[::-1]),
        ):
            lane = _lane(streets, line, start, end, streets.carriage(link) / 4)
            at = shapely.get_coordinates(lane)
            yaws = [math.atan2(*(b - a)[::-1]) for a, b in ((at[0], at[1]), (at[-2], at[-1]))]
            first = site.node(f"street_{k + 1}{name}_in", at[0], yaw=yaws[0])
            last = site.node(f"street_{k + 1}{name}_out", at[-1], yaw=yaws[1])
            site.add_edges(first, last, both=False, speed=speed, bends=at[1:-1].tolist(), surface="asphalt")
            ends |= {
                first: (_as_point(at[0]), _as_point(at[1] - at[0])),
                last: (_as_point(at[-1]), _as_point(at[-1] - at[-2])),
            }
            leaving.setdefault(start, []).append((first, k))
            arriving.setdefault(end, []).append((last, k))
            out[-1].append((first, lane))
    for junction, coming in sorted(arriving.items()):
        alone = len(streets.links_at(junction)) < 3
        for last, k in coming:
            for first, j in leaving.get(junction, []):
                if alone or j != k:
                    bends = _turn(ends[last], ends[first], streets.junctions[junction], roadway)
                    site.add_edges(last, first, both=False, speed=speed / 2, bends=bends, surface="asphalt")
    return out


def _turn(last: tuple[Point, Point], first: tuple[Point, Point], middle: Point, roadway: Any) -> list[Point]:
    """Return the bend of a path through a junction: none if both lanes' directions meet, else the junction's centre.

    last, first: the end of a lane and the start of the next one, with their directions.
    """
    (ax, ay), (ux, uy) = last
    (bx, by), (vx, vy) = first
    tried: list[list[Point]] = [[]]
    turn = ux * vy - uy * vx
    if abs(turn) > 0.1 * math.sqrt((ux * ux + uy * uy) * (vx * vx + vy * vy)):
        t = ((bx - ax) * vy - (by - ay) * vx) / turn
        tried.append([_as_point((ax + t * ux, ay + t * uy))])
    for bends in tried:
        if shapely.contains(roadway, shapely.LineString([last[0], *bends, first[0]])):
            return bends
    return [middle]


def _lane(streets: Streets, line: Any, start: int, end: int, off: float) -> Any:
    """Return the line to the right of a link's centreline, from one junction's edge to the next one's."""
    long = line.length
    cuts = [min(_before(streets, junction) + 2.0, 0.35 * long) for junction in (start, end)]
    middle = substring(line, cuts[0], long - cuts[1])
    lane = shapely.offset_curve(middle, -off, join_style="mitre", mitre_limit=2.0)
    if lane.geom_type != "LineString" or lane.is_empty or lane.length < 0.2 * middle.length:
        ends = shapely.get_coordinates(middle)[[0, -1]]
        step = ends[1] - ends[0]
        lane = shapely.LineString(ends + np.array([step[1], -step[0]]) / math.sqrt(float(step @ step)) * off)
    at = shapely.get_coordinates(lane)
    middle_start = shapely.get_coordinates(middle)[0]
    if float(((at[0] - middle_start) ** 2).sum()) > float(((at[-1] - middle_start) ** 2).sum()):
        lane = shapely.reverse(lane)
    return shapely.transform(lane, lambda xy: np.round(xy, 3) + 0.0)


def _before(streets: Streets, junction: int) -> float:
    """Return the distance in metres before a junction's centre of its streets' crossings."""
    widths = [streets.carriage(streets.links[k]) for k in streets.links_at(junction)]
    return max(widths) / 2 + streets.walk + 0.5 if len(widths) > 1 else 1.0


# --- sidewalks --------------------------------------------------------------------------------------------------------


def sidewalks(
    site: Site, streets: Streets, blocks: Sequence[Any], edge: Any, speed: float, notes: DerivationNotes
) -> None:
    """Add paths around blocks and inside the town's edge (a polygon, or None), and crossings between them."""
    areas = [shapely.buffer(block, streets.walk / 2, join_style="mitre", mitre_limit=2.0) for block in blocks]
    rings = [a.exterior for a in areas if a.geom_type == "Polygon"]
    if edge is not None:
        inner = shapely.buffer(edge, -streets.walk / 2, join_style="mitre")
        rings += [p.exterior for p in shapely.get_parts(inner) if p.geom_type == "Polygon"]
    rings = [shapely.transform(r, lambda xy: np.round(xy, 3) + 0.0) for r in rings]
    streets.loops = [Loop(ring) for ring in rings]
    crossings = _crossings(streets)
    joined = _select_crossings(len(streets.loops), [(a, b) for a, _, b, _ in crossings])
    left = [k for k in range(len(streets.loops)) if k not in joined]
    notes.drop("sidewalks", len(left), "no crossing leads to them")
    crossings = [c for c in crossings if c[0] in joined and c[2] in joined]
    for k in sorted(joined):
        _corners(streets.loops[k], k)
    footways = []
    for n, (a, p, b, q) in enumerate(crossings):
        ends = [_stop(streets.loops[k], at, f"crossing_{n + 1}{side}") for k, at, side in ((a, p, "a"), (b, q, "b"))]
        streets.kept += [p, q]
        if ends[0] != ends[1]:
            footways.append(ends)
    for k in sorted(joined):
        _add_sidewalk(site, streets.loops[k], speed)
    done: set[frozenset[str]] = set()
    for one, other in footways:
        if frozenset((one, other)) not in done:
            done.add(frozenset((one, other)))
            site.add_edges(one, other, action="cross", speed=speed / 2, surface="asphalt")


def _crossings(streets: Streets) -> list[tuple[int, Point, int, Point]]:
    """Return (sidewalk, position, sidewalk, position) of each crossing."""
    if not streets.loops:
        return []
    tree = shapely.STRtree([loop.ring for loop in streets.loops])
    out = []
    for link in streets.links:
        long = link.line.length
        cuts = [_before(streets, end) if len(streets.links_at(end)) > 1 else math.inf for end in link.ends]
        places = sorted({cuts[0], long - cuts[1]}) if max(cuts) < math.inf and long > sum(cuts) + 8.0 else [long / 2]
        for place in places:
            crossing = _add_crossing(streets, link, place, tree)
            if crossing is not None:
                out.append(crossing)
    return out


def _add_crossing(streets: Streets, link: Link, place: float, tree: Any) -> tuple[int, Point, int, Point] | None:
    """Return a crossing at this distance in metres along a link; None if one side has no sidewalk there."""
    ahead: Any = shapely.line_interpolate_point(link.line, place + 0.25)
    behind: Any = shapely.line_interpolate_point(link.line, place - 0.25)
    middle = shapely.line_interpolate_point(link.line, place)
    dx, dy = ahead.x - behind.x, ahead.y - behind.y
    norm = math.sqrt(dx * dx + dy * dy)
    if norm == 0:
        return None
    sides: list[tuple[int, Point]] = []
    want = (link.width - streets.walk) / 2
    for side in (-1.0, 1.0):
        nx, ny = -dy / norm * side, dx / norm * side
        ray = shapely.LineString([(middle.x, middle.y), (middle.x + nx * (want + 2), middle.y + ny * (want + 2))])
        best = None
        for k in sorted(int(n) for n in tree.query(ray, predicate="intersects")):
            for x, y in shapely.get_coordinates(shapely.intersection(ray, streets.loops[k].ring)):
                off = abs(math.sqrt((x - middle.x) ** 2 + (y - middle.y) ** 2) - want)
                if off <= TOLERANCE and (best is None or off < best[0]):
                    best = (off, k, _as_point((x, y)))
        if best is None:
            return None
        sides.append(best[1:])
    (a, p), (b, q) = sides
    return (a, p, b, q)


def _select_crossings(count: int, pairs: Sequence[tuple[int, int]]) -> set[int]:
    """Return the largest set of sidewalks that crossings connect."""
    root = list(range(count))

    def top(k: int) -> int:
        while root[k] != k:
            root[k] = root[root[k]]
            k = root[k]
        return k

    for a, b in pairs:
        root[max(top(a), top(b))] = min(top(a), top(b))
    groups: dict[int, list[int]] = {}
    for k in range(count):
        groups.setdefault(top(k), []).append(k)
    largest = max(groups, key=lambda first: (len(groups[first]), -first), default=None)
    return set() if largest is None else set(groups[largest])


def _corners(loop: Loop, number: int) -> None:
    """Add nodes at the corners of a sidewalk."""
    at = shapely.get_coordinates(loop.ring)[:-1]
    for k, corner in enumerate(at):
        a, b = corner - at[k - 1], at[(k + 1) % len(at)] - corner
        turn = abs(math.atan2(float(a[0] * b[1] - a[1] * b[0]), float(a @ b)))
        if turn > CORNER:
            _stop(loop, _as_point(corner), f"corner_{number + 1}_{k + 1}")


def _stop(loop: Loop, at: Point, name: str) -> str:
    """Add a node on a sidewalk, or return an existing one within half a metre."""
    for _, stop_name, place in loop.stops:
        if (place[0] - at[0]) ** 2 + (place[1] - at[1]) ** 2 < 0.25:
            return stop_name
    loop.stops.append((float(shapely.line_locate_point(loop.ring, shapely.Point(at))), name, at))
    return name


def _add_sidewalk(site: Site, loop: Loop, speed: float) -> None:
    """Add a sidewalk's nodes and the edges between them."""
    stops = sorted(loop.stops)
    for _, name, at in stops:
        site.node(name, at)
    at = shapely.get_coordinates(loop.ring)[:-1]
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(shapely.get_coordinates(loop.ring), axis=0).T))])
    total = float(along[-1])
    pairs = list(itertools.pairwise([*stops, stops[0]]))
    for (start, a, _), (end, b, _) in pairs[: 1 if len(stops) == 2 else None]:
        if a == b:
            continue
        length = (end - start) % total
        bends = sorted(((float(s) - start) % total, k) for k, s in enumerate(along[:-1]))
        between = [at[k].tolist() for s, k in bends if 0.3 < s < length - 0.3]
        site.add_edges(a, b, speed=speed, bends=between, surface="paving_stones")


# --- a stop -----------------------------------------------------------------------------------------------------------


def stop(site: Site, streets: Streets, roads: Sequence[Sequence[tuple[str, Any]]], notes: DerivationNotes) -> None:
    """Join a sidewalk and the lane that begins next to it: a drop-off stop for robots."""
    walks = [(name, at) for loop in streets.loops for _, name, at in loop.stops]
    lanes_ = [(name, lane) for pair in roads for name, lane in pair]
    if not walks or not lanes_:
        if walks or lanes_:
            notes.drop("sidewalks", len(streets.loops), "there is no path from a lane to them")
        return
    places = shapely.STRtree([shapely.Point(at) for _, at in walks])
    best: tuple[float, str, str] | None = None
    for name, lane in lanes_:
        start = shapely.Point(shapely.get_coordinates(lane)[0])
        k = int(np.asarray(places.nearest(start)))
        candidate = (round(float(shapely.distance(start, shapely.Point(walks[k][1]))), 3), walks[k][0], name)
        best = candidate if best is None or candidate < best else best
    assert best is not None
    site.add_edges(best[1], best[2], action="cross", speed=0.5, surface="asphalt")

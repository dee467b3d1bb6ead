"""Town quarter: streets, blocks, lots and buildings from a boundary, by a grammar."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely

from app.derive import DerivationNotes
from app.errors import CannotGenerate, Invalid, Problem
from app.generate import RandomSource, _blocks, _plants, _streets, generates
from app.generate._blocks import Lot
from app.generate._shapes import angle, disc, mm
from app.generate._site import SLACK, Site, SiteOptions, invalid_option_error
from app.model.layers import Layers
from app.parameters import parameter

RULES = """
town -> ring(main) quarter
quarter : area > 4 * block -> cut(rand(0.42, 0.58), main) quarter quarter
quarter : area > block & area <= 4 * block -> cut(rand(0.4, 0.6), street) quarter quarter
quarter : area <= block -> use
use @ 8 -> lots
use @ 1 -> park
use @ 0.5 -> square
lots : area > 1.9 * lot -> cut(rand(0.42, 0.58), 0) lots lots
lots : area <= 1.9 * lot & frontage < 6 -> garden
lots : area <= 1.9 * lot & frontage >= 6 -> inset(setback) house
house : width < 6 -> garden
house : width >= 6 & area > 400 -> flat(rand(2, storeys))
house : width >= 6 & area <= 400 @ 4 -> gable(rand(1, 3))
house : width >= 6 & area <= 400 @ 1 -> hip(rand(1, 2))
house : width >= 6 & area <= 400 @ 1 -> flat(rand(1, storeys))
"""

STOREY = 2.9
MAX_AREA_M2 = 25e6
"""Maximum area of a boundary in square metres."""

MAX_BOUNDARY_POINTS = 1000
MARGIN = 2.0
BETWEEN_LAMPS = 24.0
LAMP = (0.08, 5.0)
OSM_ROOF = {"flat": "flat", "gable": "gabled", "hip": "hipped"}
MAX_TREES = 5000


@dataclass(frozen=True, slots=True)
class Options(SiteOptions):
    """Parameters of a town."""

    boundary: tuple[float, ...] | None = parameter(
        None, "x1,y1,x2,y2,… corners of the town, in local metres; default: the fence, else width × depth"
    )
    width: float = parameter(
        200.0, "width of the town, if there is no boundary", minimum=30.0, maximum=5000.0, unit="m"
    )
    depth: float = parameter(
        150.0, "depth of the town, if there is no boundary", minimum=30.0, maximum=5000.0, unit="m"
    )
    rules: str | None = parameter(
        None,
        "grammar instead of the built-in one, rules on separate lines or separated by semicolons; it may "
        "use the constants main, street, block, lot, setback and storeys",
    )
    main: float = parameter(14.0, "width of main streets, between house fronts", minimum=4.0, maximum=100.0, unit="m")
    street: float = parameter(11.0, "width of the other streets", minimum=4.0, maximum=100.0, unit="m")
    sidewalk: float = parameter(
        2.5, "width of sidewalks, at most a quarter of a street", minimum=1.0, maximum=20.0, unit="m"
    )
    block: float = parameter(4500.0, "maximum area of a block", minimum=200.0, maximum=1e6, unit="m²")
    lot: float = parameter(320.0, "typical area of a lot", minimum=50.0, maximum=1e5, unit="m²")
    setback: float = parameter(
        3.0, "distance between a lot's edge and its building", minimum=0.0, maximum=100.0, unit="m"
    )
    storeys: int = parameter(5, "number of storeys of the highest building", minimum=1, maximum=50)
    trees: bool = parameter(True, "whether parks and gardens have trees and bushes")
    lamps: bool = parameter(True, "whether there are lamps along the sidewalks")


@generates(
    {"location", "objects", "resources", "occupancy", "topology", "zones", "imagery"},
    also=frozenset({"location"}),
    parameters=Options,
)
def town(given: Layers, options: Options, source: RandomSource, notes: DerivationNotes) -> Layers:
    """Town quarter: streets with lanes, sidewalks and crossings, blocks, lots and buildings by a rule grammar."""
    constants = {
        name: float(getattr(options, name)) for name in ("main", "street", "block", "lot", "setback", "storeys")
    }
    grammar = _blocks.parse(RULES if options.rules is None else options.rules, constants)
    site = Site(given, options, notes)
    boundary = _town_boundary(site, options)
    layout = _blocks.grow(grammar, boundary, source.stream("rules"))
    if not layout.streets:
        raise CannotGenerate("the rules create no street: use ring or cut", [Problem("no street", where="rules")])
    streets = _streets.build_streets(layout.streets, options.sidewalk)
    need = options.robot_radius + SLACK * site.resolution
    if streets.walk / 2 < need:
        raise invalid_option_error(
            "sidewalk", f"{streets.walk:.2f} m is too narrow for the robot, which needs at least {2 * need:.2f} m"
        )
    _paint(site, streets, layout, boundary)
    _buildings(site, [lot for lot in layout.lots if lot.use in _blocks.ROOFS])
    ring = any(rule.action == "ring" for rule in grammar.rules[grammar.start])
    _streets.sidewalks(site, streets, layout.blocks, boundary if ring else None, 1.2, notes)
    roads = _streets.lanes(site, streets, 5.0, need)
    _streets.stop(site, streets, roads, notes)
    if options.lamps:
        _lamps(site, streets, need, notes)
    if options.trees:
        _green(site, [lot for lot in layout.lots if lot.use in _blocks.OPEN], source)
    for k, lot in enumerate(lot for lot in layout.lots if lot.use in ("park", "square")):
        site.zone(f"{lot.use}_{k + 1}", "speed", lot.area, value=1.0, name=f"{lot.use} {k + 1}")
    return site.finish(ground="meadow")


def _town_boundary(site: Site, options: Options) -> Any:
    """Return the town's boundary: the requested one, else the fence, else a rectangle."""
    boundary = None if options.boundary is None else _polygon(options.boundary)
    outline = shapely.box(0.0, 0.0, options.width, options.depth) if boundary is None else boundary
    if outline.area > MAX_AREA_M2:
        raise invalid_option_error(
            "boundary", f"the town has {outline.area / 1e6:.1f} km²; the limit is {MAX_AREA_M2 / 1e6:g} km²"
        )
    around = shapely.buffer(outline, MARGIN, join_style="mitre", mitre_limit=3.0)
    fence = site.set_fence(around, room=options.sidewalk / 2 - options.robot_radius)
    if not site.is_given:
        return outline
    if boundary is not None:
        if not shapely.contains(fence, boundary):
            raise invalid_option_error("boundary", "extends beyond the fence of the environment")
        return boundary
    inner = [p for p in shapely.get_parts(shapely.buffer(fence, -0.5, join_style="mitre")) if p.area > 0]
    if not inner:
        raise CannotGenerate("the fence has no room for a town", [Problem("no room for a town", where="fence")])
    return shapely.normalize(shapely.transform(max(inner, key=lambda p: p.area), lambda xy: np.round(xy, 3) + 0.0))


def _polygon(numbers: Sequence[float]) -> Any:
    """Parse a polygon of x1,y1,x2,y2,…. Raises Invalid if it is none."""

    def wrong(problem: str) -> Invalid:
        return Invalid(f"boundary: {problem}", [Problem(problem, where="boundary")])

    if len(numbers) % 2 or not 6 <= len(numbers) <= 2 * MAX_BOUNDARY_POINTS:
        raise wrong(f"must be x,y of 3 to {MAX_BOUNDARY_POINTS} corners, got {len(numbers)} numbers")
    if max(map(abs, numbers)) > 1e6:
        raise wrong("must be within ±1e6 m")
    ring = [(mm(x), mm(y)) for x, y in zip(numbers[::2], numbers[1::2], strict=True)]
    polygon = shapely.Polygon(ring)
    if not polygon.is_valid:
        raise wrong(f"is not a valid polygon: {shapely.is_valid_reason(polygon)}")
    if polygon.area < 100.0:
        raise wrong(f"must have an area of at least 100 m², got {polygon.area:g} m²")
    return shapely.normalize(polygon)


# --- appearance -------------------------------------------------------------------------------------------------


def _paint(site: Site, streets: _streets.Streets, layout: _blocks.Town, boundary: Any) -> None:
    """Paint ground and roads."""
    site.draw(boundary, "paving")
    for k, link in enumerate(streets.links):
        half = streets.carriage(link) / 2
        site.draw(shapely.buffer(link.line, half, cap_style="square", join_style="mitre"), "asphalt")
        name = f"Street {k + 1}"
        tags = {"highway": "residential", "sidewalk": "both", "lanes": "2"}
        width = mm(streets.carriage(link))
        site.mark(f"road_{k + 1}", "road", link.line, name=name, width=width, osm={"tags": tags})
    for link in streets.links:
        site.draw(shapely.buffer(link.line, 0.1), "white")
    ground = {"garden": "grass", "park": "grass", "square": "concrete"}
    site.draw(list(layout.blocks), "soil" if not layout.lots else "grass")
    for lot in layout.lots:
        site.draw(lot.area, ground.get(lot.use, "concrete"))
    for k, block in enumerate(layout.blocks):
        site.mark(f"block_{k + 1}", "region", block, name=f"Block {k + 1}")


def _buildings(site: Site, lots: Sequence[Lot]) -> None:
    """Add buildings on their lots."""
    if any(lot.use == "gable" for lot in lots):
        site.files["models/roofs/meshes/gable.obj"] = _plants.obj(_roof(0.5), "roof")
    if any(lot.use == "hip" for lot in lots):
        site.files["models/roofs/meshes/hip.obj"] = _plants.obj(_roof(0.2), "roof")
    for k, lot in enumerate(lots):
        high = mm(lot.storeys * STOREY + 0.3)
        use, body = lot.use, None
        if use != "flat":
            body = _rectangle(lot.area)
            use = "flat" if body is None else use
        roof = 0.0
        if body is None:
            x, y = (mm(v) for v in shapely.get_coordinates(shapely.centroid(lot.area))[0])
            ring = np.round(shapely.get_coordinates(lot.area)[:-1] - np.array([x, y]), 3) + 0.0
            area, yaw = lot.area, 0.0
            shapes: list[dict[str, Any]] = [{"type": "polyline", "points": [ring.tolist()], "height": high}]
        else:
            area, (x, y), yaw, long, short = body
            roof = mm(min(4.0, 0.35 * short))
            shapes = [
                {"type": "box", "size": [long, short, high], "pose": [0.0, 0.0, mm(high / 2), 0.0, 0.0, 0.0]},
                {
                    "type": "mesh",
                    "file": f"models/roofs/meshes/{use}.obj",
                    "scale": [long, short, roof],
                    "pose": [0.0, 0.0, high, 0.0, 0.0, 0.0],
                    "colour": [0.59, 0.33, 0.26],
                },
            ]
        tags = {"building": "yes", "building:levels": str(lot.storeys), "roof:shape": OSM_ROOF[use]}
        site.add_object(
            f"building_{k + 1}",
            "building",
            area,
            shapes=shapes,
            pose=(x, y, 0.0, yaw),
            name=f"Building {k + 1}",
            height=mm(high + roof),
            levels=lot.storeys,
            roof=use,
            colour={"flat": "roof_light", "gable": "roof", "hip": "roof_dark"}[use],
            osm={"tags": tags},
        )


def _rectangle(area: Any) -> tuple[Any, tuple[float, float], float, float, float] | None:
    """Return the largest rectangle in an area, aligned with its enclosing rectangle.

    Returns (polygon, middle, yaw, length, width); None if it is hardly larger than a shed.
    """
    corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(area))
    a, b = corners[1] - corners[0], corners[2] - corners[1]
    long, short = math.sqrt(float(a @ a)), math.sqrt(float(b @ b))
    if long < short:
        a, long, short = b, short, long
    yaw = angle(math.atan2(float(a[1]), float(a[0])))
    x, y = (mm(v) for v in shapely.get_coordinates(shapely.centroid(area))[0])
    c, s = round(math.cos(yaw), 9), round(math.sin(yaw), 9)
    grown = shapely.buffer(area, 0.02, join_style="mitre")
    for step in range(20, 7, -1):
        size = (mm(long * step / 20), mm(short * step / 20))
        half = [(i * size[0] / 2, j * size[1] / 2) for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
        polygon = shapely.Polygon([(mm(x + c * u - s * v), mm(y + s * u + c * v)) for u, v in half])
        if shapely.contains(grown, polygon):
            return (polygon, (x, y), yaw, *size) if size[1] >= 4.0 else None
    return None


def _roof(ridge: float) -> Any:
    """Return a roof over a square of one metre, one metre high, its ridge from -ridge to ridge along x: triangles."""
    a, b, c, d = ((-0.5, -0.5, 0.0), (0.5, -0.5, 0.0), (0.5, 0.5, 0.0), (-0.5, 0.5, 0.0))
    e, f = (-ridge, 0.0, 1.0), (ridge, 0.0, 1.0)
    faces = [(a, b, f), (a, f, e), (c, d, e), (c, e, f), (b, c, f), (d, a, e), (a, d, c), (a, c, b)]
    return np.array(faces, np.float64)


def _lamps(site: Site, streets: _streets.Streets, need: float, notes: DerivationNotes) -> None:
    """Add lamps at the kerb if a robot can still pass them."""
    off = streets.walk / 2 - 0.25
    if off - LAMP[0] < need:
        notes.warn("there are no lamps; a robot could not pass them on the sidewalks at this resolution")
        return
    roads = shapely.STRtree([shapely.buffer(link.line, streets.carriage(link) / 2) for link in streets.links])
    reserved = shapely.STRtree([shapely.Point(at) for at in streets.kept])
    count = 0
    for loop in streets.loops:
        outside = loop.ring.is_ccw
        kerb = shapely.offset_curve(loop.ring, -off if outside else off, join_style="mitre")
        if kerb.geom_type not in ("LineString", "LinearRing") or not len(streets.kept):
            continue
        for k in range(int(kerb.length / BETWEEN_LAMPS)):
            at = shapely.line_interpolate_point(kerb, (k + 0.5) * BETWEEN_LAMPS)
            near = reserved.query(at, predicate="dwithin", distance=3.0)
            if len(near) or len(roads.query(at, predicate="dwithin", distance=0.1)):
                continue
            count += 1
            site.post(f"lamp_{count}", "pole", (mm(at.x), mm(at.y)), *LAMP, colour="metal", name=f"Lamp {count}")


def _green(site: Site, lots: Sequence[Lot], source: RandomSource) -> None:
    """Add trees in parks, bushes and a tree in gardens, benches on squares."""
    chance = source.stream("green")
    kinds = {name: _plants.grow_plants(name, count, source) for name, count in (("apple", 3), ("pine", 2), ("bush", 2))}
    trees = benches = 0
    for lot in lots:
        inner = shapely.buffer(lot.area, -2.0)
        if inner.is_empty:
            continue
        low_x, low_y, high_x, high_y = inner.bounds
        step = {"park": 9.0, "garden": 8.0, "square": 14.0}[lot.use]
        for row in range(int((high_y - low_y) / step) + 1):
            for column in range(int((high_x - low_x) / step) + 1):
                du, dv, choice, large, turn = chance.random(5).tolist()
                x, y = mm(low_x + (column + du) * step), mm(low_y + (row + dv) * step)
                if not shapely.contains_xy(inner, x, y):
                    continue
                if lot.use == "square":
                    benches += 1
                    site.box(
                        f"bench_{benches}", "bench", (x, y), (1.6, 0.5, 0.45), yaw=angle(6.28 * turn), colour="wood"
                    )
                    continue
                name = "bush" if choice < 0.25 else "pine" if choice < 0.5 else "apple"
                plant = kinds[name][int(large * 997) % len(kinds[name])]
                scale = round({"bush": 1.0, "pine": 1.1, "apple": 2.0}[name] * (0.8 + 0.4 * large), 3)
                trees += 1
                if trees > MAX_TREES:
                    return
                site.add_object(
                    f"tree_{trees}", plant.kind, shapely.Point(x, y), shapes=plant.shapes(scale),
                    pose=(x, y, 0.0, 6.28 * turn), width=mm(2 * plant.body[0] * scale),
                    height=mm(plant.height * scale), species=name,
                    colour="crown_dark" if name == "pine" else "crown_light" if name == "bush" else "crown",
                    seen=disc(x, y, plant.spread * scale),
                )  # fmt: skip
                site.files.update(plant.files)

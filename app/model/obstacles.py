"""Obstacles: objects of a site that block robots, by kind, as solids and as extruded footprints.

Worlds (``app.formats.gazebo``), grids, voxels and images of grids all use this module.

=========== ===========================================================================================================
an object   counts
=========== ===========================================================================================================
of kind     ``floor``, ``lift``: as ground that is free (a lift's cabin by its ``pose`` and ``size``)
of kind     ``lift``: also by the walls around its cabin, open at its doors, if Open-RMF states their positions
of kind     ``hole``: as an obstacle, since a robot would fall in
of kind     in ``OBSTACLES``: by its geometry; an OpenStreetMap kind only if the tag's value is one of ``OF_OSM``
with        ``shapes``: by its solids (``app.model.solids``), whatever its kind, except for those of ``IGNORED``
with        ``height`` or ``size``: by its geometry, or by a box of its size if it is a point, whatever its kind
of kind     ``door``: as an obstacle only if doors count as closed, whatever its shapes
of kind     in ``BROAD_KINDS``: as a point without width and size also as unknown ground
of kind     in ``SOLID``: without shapes and size as unknown ground (``object_surroundings``), except for objects of
            a world, which contains all solids of its models: there it has none
else        not: regions, points of interest, paths, roads, lights, measurements …
=========== ===========================================================================================================

An area counts as it is, a line as wide as it is (``width``, else its kind's), a point as a disc or as a box of its
size. It extends from ``base`` (else OpenStreetMap's ``min_height`` and ``building:min_level``, else the floor) to
``height`` (else ``height`` and ``building:levels`` among the tags, else without limit; ``app.model.osm_tags``).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import shapely

from app.model import osm_tags, solids
from app.model.features import Properties
from app.model.frame import MAX_METRES

Role = Literal["mark", "ground", "solids", "outline", "bodiless"]
"""Role of an object: a mark is no obstacle, ground is free, an outline is extruded, others have no known body."""

FREE = frozenset({"floor", "lift"})
DOORS = frozenset({"door"})
HOLES = frozenset({"hole"})
IGNORED = frozenset(
    {
        *("region", "poi", "path", "light", "actor", "fiducial", "measurement", "human_lane", "fence_line", "label"),
        *("ground_overlay", "overlay", "photo", "screen", "tour", "camera", "population", "road", "zone"),
    }
)
"""Marks, moving objects and objects without a body."""

CABIN_WALL = 0.05
"""Thickness of a lift cabin's walls in metres, as in rmf_building_map_tools."""

SOLID = frozenset({"model", "include"})
"""Kinds that have a body, which may be in files that were not uploaded."""

UNKNOWN_RADIUS_METRES = 0.7
"""Radius of unknown ground around an object of unknown extent, in metres: Open-RMF's chairs, desks and cabinets extend
about as far from their origin, and its buildings have their lanes no nearer.
"""

OBSTACLES: Mapping[str, float] = {
    **dict.fromkeys(("wall", "fence", "hedge", "barrier", "railing"), 0.1),
    **dict.fromkeys(("building", "obstacle", "furniture", "shelf", "rack", "table", "machine", "container"), 0.1),
    **dict.fromkeys(("pillar", "column", "bollard", "post", "pole", "rock", "stone", "crate", "box"), 0.3),
    **dict.fromkeys(("tree", "trunk", "bush", "shrub", "plant", "vegetation"), 0.3),
    **dict.fromkeys(("water", "pond", "ditch", "stream"), 1.0),
}
"""Kinds of obstacles, with the default width in metres of a line of that kind, or diameter of a point's disc. The 0.1 m
of a wall is what rmf_building_map_tools builds.
"""

BROAD_KINDS = frozenset(
    {
        *("building", "obstacle", "furniture", "shelf", "rack", "table", "machine", "container"),
        *("water", "pond", "ditch", "stream"),
    }
)
"""Kinds that cover more ground than the default disc of a point without a stated width."""

MAX_WIDTH_METRES = 1000.0
"""Maximum width of a line or a point in metres: a larger value is an error of the source."""

OF_OSM: Mapping[str, Mapping[str, float]] = {
    "building": {"*": 0.1, "no": 0.0, "roof": 0.0},
    "building:part": {"*": 0.1, "no": 0.0, "roof": 0.0},
    "barrier": {
        "*": 0.1,
        "hedge": 1.0,
        "ditch": 1.0,
        "city_wall": 1.0,
        "retaining_wall": 0.3,
        **dict.fromkeys(("bollard", "block", "planter", "jersey_barrier", "log", "debris"), 0.4),
        **dict.fromkeys(("gate", "lift_gate", "swing_gate", "sliding_gate", "entrance", "kerb", "cattle_grid"), 0.0),
        **dict.fromkeys(("toll_booth", "border_control", "sally_port", "height_restrictor", "bump_gate", "no"), 0.0),
    },
    "natural": {
        **dict.fromkeys(("tree", "shrub", "rock", "stone", "stump"), 0.4),
        **dict.fromkeys(("tree_row", "scrub"), 1.0),
        **dict.fromkeys(("water", "bay", "cliff", "sinkhole", "hot_spring"), 0.5),
    },
    "waterway": {
        **dict.fromkeys(("river", "canal"), 5.0),
        **dict.fromkeys(("stream", "ditch", "drain", "tidal_channel"), 1.0),
        **dict.fromkeys(("riverbank", "dock", "weir", "dam", "waterfall"), 1.0),
    },
    "landuse": dict.fromkeys(("basin", "reservoir"), 1.0),
    "leisure": dict.fromkeys(("swimming_pool",), 1.0),
    "man_made": {
        **dict.fromkeys(("tower", "silo", "storage_tank", "chimney", "mast", "water_tower", "gasometer"), 2.0),
        **dict.fromkeys(("street_cabinet", "flagpole", "utility_pole", "monitoring_station", "water_well"), 0.4),
    },
    "power": {**dict.fromkeys(("tower", "transformer"), 2.0), **dict.fromkeys(("pole", "catenary_mast"), 0.3)},
    "highway": dict.fromkeys(("street_lamp", "traffic_signals_pole"), 0.3),
    "amenity": dict.fromkeys(("fountain", "bench", "post_box", "waste_basket", "telephone", "vending_machine"), 0.6),
    "historic": dict.fromkeys(("monument", "memorial", "wayside_cross", "wayside_shrine"), 0.6),
}
"""OpenStreetMap: default width of a line or a point by a tag's key and value (``*``: any other); 0 is no obstacle."""

KEYS: Mapping[str, tuple[str, ...]] = {
    "building": ("building", "building:part"),
    "tree": ("natural",),
    "water": ("natural", "waterway", "landuse", "leisure"),
}
"""Tags that an OpenStreetMap object's kind may come from, if it differs from its main tag."""

SQUARE = frozenset({"wall"})
"""Kinds whose lines extend half their width beyond their ends, so that walls that meet at a corner close it."""


@dataclass(frozen=True, slots=True)
class Body:
    """The ground that an object covers (polygons, metres), and its lower and upper height above its floor.

    The upper height is infinite if unknown.
    """

    area: Any
    base: float
    top: float


def object_role(properties: Properties, *, doors_closed: bool = False) -> Role:
    """Return the role of an object. doors_closed: whether doors are obstacles."""
    kind = str(properties.get("kind") or "")
    if kind in FREE:
        return "ground"
    if kind in IGNORED or (kind in DOORS and not doors_closed):
        return "mark"
    if properties.get("shapes"):
        return "solids"
    if object_width(properties) is not None:
        return "outline"
    return "bodiless" if kind in SOLID and not _tags(properties) and "gazebo" not in properties else "mark"


def object_body(
    properties: Properties, geometry: Any, width: float | None = None, *, elevation: float = 0.0
) -> Body | None:
    """Return the body of an object with the role ``outline``, or of a lift's walls; None if it has none.

    geometry: in local metres. width: of a line, or of a point's disc, instead of the object's own. elevation: of its
    level, in metres. Raises Invalid if its pose is invalid.
    """
    if properties.get("kind") == "lift":
        return None if properties.get("shapes") else _cabin(properties, geometry)
    area = _area(shapely.force_2d(geometry), properties, width or object_width(properties) or 0.0)
    return None if area is None or area.is_empty else Body(area, *object_heights(properties, geometry, elevation))


def object_ground(properties: Properties, geometry: Any) -> Any | None:
    """Return the ground of a floor or a lift's cabin, on which robots stand: polygons; None if it has none."""
    area = _area(shapely.force_2d(geometry), properties, 0.0)
    return area if area is not None and area.area > 0 else None


def is_unsized(properties: Properties, geometry: Any) -> bool:
    """Return whether an object is a mere point and covers more ground than its disc."""
    is_point = shapely.get_type_id(geometry) in (0, 4)
    is_broad = is_point and str(properties.get("kind")) in BROAD_KINDS
    return is_broad and box_size(properties) is None and not has_width(properties)


def object_surroundings(properties: Properties, geometry: Any, radius: float) -> Any | None:
    """Return the ground that an object of unknown extent may cover; None if it has neither a geometry nor a pose.

    Args:
        geometry: in local metres.
        radius: metres around its geometry and its pose; half the diagonal of its size if that is more.
    """
    pose, size = properties.get("pose"), box_size(properties)
    xy = pose[:2] if isinstance(pose, (list, tuple)) else ()
    is_place = len(xy) == 2 and all(isinstance(v, (int, float)) and abs(v) <= MAX_METRES for v in xy)
    candidates = (shapely.force_2d(geometry), shapely.Point(xy) if is_place else shapely.Point())
    places = [place for place in candidates if not place.is_empty]
    reach = max(radius, math.hypot(*size[:2]) / 2 if size else 0.0)
    return shapely.union_all(shapely.buffer(places, reach)) if places else None


def object_footprint(properties: Properties, geometry: Any, solid_reader: solids.Solids) -> Any | None:
    """Return the ground that an object covers, at any height: polygons in metres; None if it is no obstacle.

    geometry: in local metres. Raises Invalid or BadUpload if its solids cannot be read.
    """
    role = object_role(properties)
    if role == "solids":
        shadow = solid_reader.footprint(properties)
        return None if shadow.is_empty else shadow
    body = object_body(properties, geometry) if role == "outline" else None
    return None if body is None else body.area


def _cabin(p: Properties, geometry: Any) -> Body | None:
    """Return the walls around a lift's cabin, with gaps at its doors; None if the doors are unknown.

    Walls without a way in would lock the cabin.

    Source: rmf_building_map_tools, lift.py (doors: x, y in the cabin's frame, width along motion_axis_orientation).
    """
    size, source_properties = box_size(p), p.get("openrmf")
    says = source_properties.get("says") if isinstance(source_properties, Mapping) else None
    doors = says.get("doors") if isinstance(says, Mapping) else None
    if size is None or not isinstance(doors, Mapping):
        return None
    x, y = size[0] / 2, size[1] / 2
    cabin = shapely.box(-x, -y, x, y)
    walls = shapely.difference(cabin.buffer(CABIN_WALL, join_style="mitre"), cabin)
    gaps = []
    pose = _pose(p, geometry)
    if pose is None:
        return None
    for door in doors.values():
        words = ("x", "y", "motion_axis_orientation", "width") if isinstance(door, Mapping) else ()
        numbers = [door.get(word) for word in words]
        if not numbers or not all(isinstance(v, (int, float)) and abs(v) <= MAX_METRES for v in numbers):
            return None
        along = float(numbers[3]) / 2
        across = max(x, y, CABIN_WALL) / 2  # cut through the door's own wall, not through the opposite one
        gap = shapely.box(-along, -across, along, across)
        turned = solids.apply_pose(_flat(gap), (float(numbers[0]), float(numbers[1]), 0.0, 0.0, 0.0, float(numbers[2])))
        gaps.append(shapely.Polygon(turned[:, :2]))
    if not gaps:
        return None
    walls = shapely.difference(walls, shapely.union_all(gaps))
    placed = shapely.transform(walls, lambda at: solids.apply_pose(np.c_[at, np.zeros(len(at))], pose)[:, :2])
    return Body(placed, 0.0, size[2] if len(size) > 2 and size[2] > 0 else math.inf)


def _flat(polygon: Any) -> Any:
    """Return the corners of a polygon at height 0: float64 [n, 3]."""
    return np.column_stack([shapely.get_coordinates(polygon), np.zeros(shapely.get_num_coordinates(polygon))])


def _pose(p: Properties, geometry: Any) -> tuple[float, ...] | None:
    """Return an object's pose; without one, its point; None if it has neither."""
    if p.get("pose") is not None:
        return solids.parse_pose(p)
    at = shapely.get_coordinates(geometry)
    return (*at[0], 0, 0, 0, 0) if len(at) else None


def _tags(p: Properties) -> Mapping[str, Any]:
    source_properties = p.get("osm")
    tags = source_properties.get("tags") if isinstance(source_properties, Mapping) else None
    return tags if isinstance(tags, Mapping) else {}


def has_width(properties: Properties) -> bool:
    """Return whether an object itself states its width."""
    return bool(_positive(properties.get("width")) or osm_tags.width(_tags(properties)))


def object_width(properties: Properties) -> float | None:
    """Return the width of an object's line or point in metres; None if the object is no obstacle."""
    p, kind = properties, str(properties.get("kind") or "")
    tags = _tags(p)
    if kind in DOORS or kind in HOLES:
        return 0.1
    key = next((key for key in KEYS.get(kind, (kind,)) if key in tags), None)
    if key is not None and key in OF_OSM:
        if tags.get("tunnel") in ("yes", "culvert", "flooded") or tags.get("location") in ("underground", "overhead"):
            return None
        values = OF_OSM[key]
        width = values.get(str(tags[key]), values.get("*", 0.0))
        value = _positive(p.get("width")) or osm_tags.width(tags) or width
        return min(value, MAX_WIDTH_METRES) if width else None
    width = min(_positive(p.get("width")) or 0.0, MAX_WIDTH_METRES)
    if kind in OBSTACLES and not tags:
        return width or OBSTACLES[kind]
    if not tags and (_positive(p.get("height")) or box_size(p)):
        return width or 0.1
    return None


def _area(geometry: Any, p: Properties, width: float) -> Any:
    """Return the ground that an object covers: a polygon in metres; None if it has none."""
    kind = int(shapely.get_type_id(geometry))
    size = box_size(p)
    if size is not None and (kind in (0, 4) or geometry.is_empty):
        x, y = size[0] / 2, size[1] / 2
        pose = _pose(p, geometry)
        return (
            None if pose is None else shapely.Polygon(solids.apply_pose(_flat(shapely.box(-x, -y, x, y)), pose)[:, :2])
        )
    if geometry.is_empty:
        return None
    if kind in (3, 6):
        return shapely.make_valid(geometry)
    if kind == 7:
        bodies = [b for b in (_area(g, {}, width) for g in shapely.get_parts(geometry)) if b is not None]
        return shapely.union_all(bodies) if bodies else None
    if width <= 0:
        return None
    caps = "round" if kind in (0, 4) else "square" if str(p.get("kind")) in SQUARE else "flat"
    return shapely.buffer(geometry, width / 2, cap_style=caps, join_style="mitre", mitre_limit=2.0)


def object_heights(properties: Properties, geometry: Any, elevation: float = 0.0) -> tuple[float, float]:
    """Return (base, top) of an extruded footprint in metres above the floor; the top is infinite if unknown.

    elevation: of the floor, in metres: a pose is in the local frame.
    """
    p = properties
    if str(p.get("kind")) in HOLES:
        return -math.inf, math.inf
    tags = _tags(p)
    base, top = _positive(p.get("base")), _positive(p.get("height"))
    if base is None:
        base = osm_tags.base(tags)
    if top is None:
        top = osm_tags.height(tags)
    size = box_size(p)
    if not top and size is not None and len(size) > 2 and size[2] > 0:
        pose = p.get("pose")
        if shapely.get_type_id(geometry) == 0 and isinstance(pose, (list, tuple)) and len(pose) > 2:
            base = (base or 0.0) + (_positive(_number(pose[2]) - elevation) or 0.0)
        top = (base or 0.0) + size[2]
    return base or 0.0, top or math.inf


def _number(value: Any) -> float:
    """Return a number; NaN for anything else."""
    return value if isinstance(value, (int, float)) and not isinstance(value, bool) else math.nan


def _positive(value: Any) -> float | None:
    number = _number(value)
    return float(number) if 0 <= number <= MAX_METRES else None


def box_size(p: Properties) -> tuple[float, ...] | None:
    """Return [x, y(, z)] of a box; None if the object has no valid size."""
    size = p.get("size")
    if not isinstance(size, (list, tuple)) or len(size) < 2:
        return None
    numbers = [_positive(v) for v in size[:3]]
    sides = tuple(v for v in numbers if v is not None)
    return sides if len(sides) == len(numbers) and sides[0] > 0 and sides[1] > 0 else None

"""What stands in a robot's way: the objects of a site, told by kind, as solids and as extruded footprints.

=========== ===========================================================================================================
an object   counts
=========== ===========================================================================================================
of kind     ``floor``, ``lift``: as ground that is free (a lift by its ``pose`` and ``size``)
of kind     ``hole``: as an obstacle, since a robot would fall in
of kind     in ``OBSTACLES``: by its geometry; an OpenStreetMap kind only where the tag's value is one of ``OF_OSM``
with        ``shapes``: by its solids (``app.model.solids``), whatever its kind but those of ``IGNORED``
with        ``height`` or ``size``: by its geometry, or a box of its size where it is a point, whatever its kind
of kind     ``door``: as an obstacle only where doors are taken as closed
else        not: regions, points of interest, paths, roads, lights, measurements …
=========== ===========================================================================================================

An area counts as it is, a line as wide as it is (``width``, else its kind's), a point as a disc or as a box of its
size. It reaches from ``base`` (else OpenStreetMap's ``min_height`` and ``building:min_level``, else the floor) to
``height`` (else ``height`` and ``building:levels`` among the tags, else without end; ``app.model.osm_tags``).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.derive import Notes
from app.errors import CannotConvert, Invalid, MissingDatum, MissingLayer, NotFound, Problem, TooLarge
from app.model import osm_tags, solids, worlds
from app.model.features import Features, Properties
from app.model.frame import MAX_METRES
from app.model.layers import Layers

Array = NDArray[np.float64]

FREE = frozenset({"floor", "lift"})
DOORS = frozenset({"door"})
HOLES = frozenset({"hole"})
IGNORED = frozenset(
    {
        *("region", "poi", "path", "light", "actor", "fiducial", "measurement", "human_lane", "fence_line", "label"),
        *("ground_overlay", "overlay", "photo", "screen", "tour", "camera", "population", "road", "zone"),
    }
)
"""Marks, moving things and things without a body."""

SOLID = frozenset({"model", "include"})
"""Kinds that have a body, which may be in files that nobody has supplied."""

OBSTACLES: Mapping[str, float] = {
    **dict.fromkeys(("wall", "fence", "hedge", "barrier", "railing"), 0.1),
    **dict.fromkeys(("building", "obstacle", "furniture", "shelf", "rack", "table", "machine", "container"), 0.1),
    **dict.fromkeys(("pillar", "column", "bollard", "post", "pole", "rock", "stone", "crate", "box"), 0.3),
    **dict.fromkeys(("tree", "trunk", "bush", "shrub", "plant", "vegetation"), 0.3),
    **dict.fromkeys(("water", "pond", "ditch", "stream"), 1.0),
}
"""Kinds that stand in the way, and how wide a line of that kind, or a point's disc, is where nothing says: metres.
The 0.1 m of a wall is what rmf_building_map_tools builds."""

SURROUNDINGS = 5.0
"""Metres around the origin of a solid that cannot be read: ground of which nothing is known."""

MOST_TRIANGLES = 10_000_000
"""Of all solids of a site together: a mesh of some megabytes can stand in a world many thousand times."""

WIDEST = 1000.0
"""Metres of a line's or a point's width: beyond it is a mistake."""

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
"""OpenStreetMap: by a tag's key and value (``*``: any other), how wide a line or a point is; 0 stands in no way."""

IN_NO_WAY = "nothing in a robot's way"

KEYS: Mapping[str, tuple[str, ...]] = {
    "building": ("building", "building:part"),
    "tree": ("natural",),
    "water": ("natural", "waterway", "landuse", "leisure"),
}
"""The tags that an OpenStreetMap object's kind may come from, where it is not called as its main tag is."""


@dataclass(slots=True)
class Site:
    """What stands on a level, in metres of the local frame.

    footprints: areas, lines or points (shapely); base and top: of each, metres above the level's floor (infinite where
    nothing says). triangles: float64 [n, 3, 3] of all solids, their heights above the level's floor too; owner: whose
    they are. free: ground that is known to be free. unknown: ground around solids that cannot be read, which is never
    free. unreadable: why they cannot, each reason once.
    """

    footprints: list[Any] = field(default_factory=list)
    base: list[float] = field(default_factory=list)
    top: list[float] = field(default_factory=list)
    triangles: Array = field(default_factory=lambda: np.empty((0, 3, 3)))
    owner: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    free: list[Any] = field(default_factory=list)
    unknown: list[Any] = field(default_factory=list)
    unreadable: list[str] = field(default_factory=list)

    @property
    def count(self) -> int:
        """How many obstacles there are."""
        return len(self.footprints) + len(np.unique(self.owner))

    def bounds(self) -> tuple[float, float, float, float] | None:
        """The box around everything, seen from above; None where there is nothing."""
        boxes = shapely.bounds(np.array([*self.footprints, *self.free], object)).reshape(-1, 4)
        if len(self.triangles):
            flat = self.triangles[:, :, :2].reshape(-1, 2)
            boxes = np.concatenate([boxes, [[*flat.min(axis=0), *flat.max(axis=0)]]])
        boxes = boxes[np.isfinite(boxes).all(axis=1)]
        if not len(boxes):
            return None
        low, high = boxes[:, :2].min(axis=0).tolist(), boxes[:, 2:].max(axis=0).tolist()
        return low[0], low[1], high[0], high[1]


def sites(
    layers: Layers,
    notes: Notes,
    *,
    doors_closed: bool = False,
    visuals: bool = False,
    world: str | None = None,
    surroundings: float = SURROUNDINGS,
) -> dict[str, Site]:
    """The sites of all levels that have objects; of several worlds one (``app.model.worlds``).

    surroundings: metres around a solid that cannot be read.
    Raises MissingDatum where objects are places on earth without one, Invalid where there is no such world.
    """
    known = solids.Solids(layers.resources(), visuals=visuals)
    out: dict[str, Site] = {}
    reader = _Reader(layers, notes, known, doors_closed, surroundings)
    parts = {key: part for key, part in layers.vector("objects").items() if len(part)}
    if world is not None and not any(worlds.names(part) for part in parts.values()):
        raise Invalid("no world is stored", [Problem("no world is stored", where="world")])
    for key, part in parts.items():
        try:
            one, others = worlds.chosen(part, world)
        except NotFound as error:
            raise Invalid(error.detail, [Problem(error.detail, where="world")]) from error
        if others:
            notes.warn(f"one world is looked at; ask for another one with world=: {', '.join(others)}")
        if len(one):
            reader.read(one, out.setdefault(key.level, Site()), key.level)
    reader.report()
    return {level: reader.finished(site, level) for level, site in out.items()}


def fences(layers: Layers, notes: Notes) -> dict[str, Any]:
    """The polygons of the location layer by level, joined, in metres (shapely)."""
    out: dict[str, Any] = {}
    for key, part in layers.vector("location").items():
        flat = np.isin(shapely.get_type_id(part.geometry), (3, 6)) & ~shapely.is_empty(part.geometry)
        chosen = part.take(flat)
        if not len(chosen):
            continue
        try:
            metres = chosen.in_local(layers.frame)
        except (MissingDatum, Invalid) as error:
            notes.warn(f"the fence is not used: {error.detail}", where=key.name)
            continue
        joined = shapely.union_all(shapely.make_valid(shapely.force_2d(metres)))
        if not joined.is_empty and joined.area > 0:
            out[key.level] = joined if key.level not in out else shapely.union(out[key.level], joined)
    return out


def unreadable_error(reasons: Iterable[str], what: str) -> MissingLayer:
    """The error for a map that would be a guess, since solids cannot be read. what: what is therefore not known."""
    named = list(dict.fromkeys(reasons))
    more = f"; and {len(named) - 3} more" if len(named) > 3 else ""
    detail = f"{what}, since solids of the objects cannot be read: {'; '.join(named[:3])}{more}"
    return MissingLayer(detail, [Problem(reason) for reason in named[:100]])


def fence_of(fences: Mapping[str, Any], level: str, ground: str) -> Any:
    """A level's fence, else that of the ground; None where there is none."""
    return fences.get(level, fences.get(ground))


class _Reader:
    """Objects on their way to obstacles: what all parts share."""

    def __init__(
        self, layers: Layers, notes: Notes, known: solids.Solids, doors_closed: bool, surroundings: float
    ) -> None:
        self.layers, self.notes, self.known, self.doors_closed = layers, notes, known, doors_closed
        self.surroundings = surroundings
        self.seen = replace(known, planes=True, visuals=True)
        self.found: dict[int, list[Array]] = {}
        self.left: Counter[str] = Counter()
        self.shapeless: Counter[str] = Counter()
        self.broken: list[tuple[str, str]] = []
        self.unreadable: dict[str, list[str]] = {}
        self.bodiless = 0
        self.triangles = 0

    def read(self, part: Features, site: Site, level: str) -> None:
        """Sort a part's objects into a site."""
        rows: list[int] = []
        widths: list[float] = []
        free: list[int] = []
        for k, p in enumerate(part.properties):
            kind = str(p.get("kind") or "")
            if kind in FREE:
                free.append(k)
            elif kind in IGNORED or (kind in DOORS and not self.doors_closed):
                self.left[kind] += 1
            elif p.get("shapes"):
                self._solids(part, k, site, level)
            else:
                width = 0.1 if kind in DOORS or kind in HOLES else _width(kind, p)
                if width is None:
                    solid = kind in SOLID and not _tags(p)
                    (self.shapeless if solid else self.left)[kind or "without a kind"] += 1
                else:
                    rows.append(k)
                    widths.append(width)
        if not rows and not free:
            return
        try:
            metres = shapely.force_2d(part.take([*rows, *free]).in_local(self.layers.frame))
        except Invalid as error:  # too far from the datum
            raise CannotConvert(error.detail, error.problems) from error
        assembled = _relations(part, rows)
        for n, (k, width) in enumerate(zip(rows, widths, strict=True)):
            p, geometry = part.properties[k], metres[n]
            if k in assembled:
                geometry = self._local(part, assembled[k])
            try:
                body = _body(geometry, p, width)
            except Invalid as error:
                self.broken.append((part.ids[k], error.detail))
                continue
            if body is None:
                self.bodiless += 1
                continue
            base, top = _heights(p)
            site.footprints.append(body)
            site.base.append(base)
            site.top.append(top)
        for n, k in enumerate(free):
            try:
                ground = _body(metres[len(rows) + n], part.properties[k], 0.0)
            except Invalid as error:
                self.broken.append((part.ids[k], error.detail))
                continue
            if ground is not None and ground.area > 0:
                site.free.append(ground)

    def _local(self, part: Features, geometry: Any) -> Any:
        frame = self.layers.frame
        if bool(part.local.all()) or frame is None:
            return geometry
        return frame.geometries_to_local(np.array([geometry], object))[0]

    def _solids(self, part: Features, k: int, site: Site, level: str) -> None:
        p = part.properties[k]
        try:
            made, unreadable = self.known.read(p)
        except (Invalid, TooLarge) as error:
            middle = shapely.get_coordinates(shapely.centroid(part.geometry[k]))
            at = (float(middle[0, 0]), float(middle[0, 1])) if len(middle) and part.local[k] else (0.0, 0.0)
            made, unreadable = np.empty((0, 3, 3)), [solids.Unreadable(error, at)]
        if unreadable:
            self._surround(part.ids[k], p, unreadable, site)
        self.triangles += len(made)
        if self.triangles > MOST_TRIANGLES:
            raise CannotConvert(f"the solids of the objects have more than {MOST_TRIANGLES} triangles")
        if unreadable and not len(made):
            return
        if len(made):
            self.found.setdefault(id(site), []).append(made - np.array([0.0, 0.0, self.layers.elevation(level)]))
        else:
            self.left["with planes or pictures only"] += 1

    def _surround(self, i: str, p: Properties, unreadable: Sequence[solids.Unreadable], site: Site) -> None:
        """The ground around solids of unknown extent: a disc, and what of the object is seen or said to be there."""
        size = _size(p)
        reach = max(self.surroundings, math.hypot(*size[:2]) / 2 if size else 0.0)
        around = [shapely.Point(one.at).buffer(reach) for one in unreadable]
        shapes = p.get("shapes")
        for shape in shapes if isinstance(shapes, (list, tuple)) else ():
            try:
                around.append(self.seen.footprint({**p, "shapes": [shape]}))
            except (Invalid, TooLarge):
                continue  # the disc stands for it
        site.unknown.append(shapely.union_all(around))
        name = p.get("name")
        for reason in dict.fromkeys(one.error.detail for one in unreadable):
            self.unreadable.setdefault(reason, []).append(name if isinstance(name, str) and name else i)
            if reason not in site.unreadable:
                site.unreadable.append(reason)

    def finished(self, site: Site, level: str) -> Site:  # noqa: ARG002
        """The site with its solids' triangles."""
        found = self.found.get(id(site), [])
        if found:
            site.triangles = np.concatenate(found)
            site.owner = np.repeat(np.arange(len(found)), [len(one) for one in found])
        return site

    def report(self) -> None:
        """What was left out, and why."""
        for kind, count in sorted(self.left.items()):
            self.notes.drop(f"objects {kind}", count, IN_NO_WAY)
        for kind, count in sorted(self.shapeless.items()):
            self.notes.drop(
                f"objects {kind}",
                count,
                "they say neither shapes nor a size: upload the files of their models with them",
            )
        self.notes.drop("objects", self.bodiless, "they have neither an area nor a size")
        for i, why in self.broken[:100]:
            self.notes.warn(f"left out: {why}", where=i)
        self.notes.drop("objects", len(self.broken), "their ground cannot be read")
        for reason, names in list(self.unreadable.items())[:100]:
            called = ", ".join(name[:80] for name in names[:5]) + (" …" if len(names) > 5 else "")
            objects = f"{len(names)} objects have" if len(names) > 1 else "1 object has"
            text = f"{objects} a solid that cannot be read ({called}): {reason}; the ground around it is unknown"
            self.notes.warn(text, where=names[0][:80])
        if self.unreadable:
            why = "solids that cannot be read have an unknown extent"
            self.notes.fill("surroundings", self.surroundings, why, "surroundings")


def body_of(properties: Properties, geometry: Any, known: solids.Solids) -> Any | None:
    """The ground that one object covers, whatever its height: a polygon in metres; None where it stands in no way.

    geometry: in local metres. Raises Invalid or BadUpload where its solids cannot be read.
    """
    kind = str(properties.get("kind") or "")
    if kind in FREE or kind in IGNORED or kind in DOORS:
        return None
    if properties.get("shapes"):
        shadow = known.footprint(properties)
        return None if shadow.is_empty else shadow
    width = 0.1 if kind in HOLES else _width(kind, properties)
    return None if width is None else _body(shapely.force_2d(geometry), properties, width)


def _tags(p: Properties) -> Mapping[str, Any]:
    own = p.get("osm")
    tags = own.get("tags") if isinstance(own, Mapping) else None
    return tags if isinstance(tags, Mapping) else {}


def _width(kind: str, p: Properties) -> float | None:
    """How wide a line or a point of an object is in metres; None where the object stands in no way."""
    tags = _tags(p)
    key = next((key for key in KEYS.get(kind, (kind,)) if key in tags), None)
    if key is not None and key in OF_OSM:
        if tags.get("tunnel") in ("yes", "culvert", "flooded") or tags.get("location") in ("underground", "overhead"):
            return None
        values = OF_OSM[key]
        width = values.get(str(tags[key]), values.get("*", 0.0))
        said = _positive(p.get("width")) or osm_tags.width(tags) or width
        return min(said, WIDEST) if width else None
    width = min(_positive(p.get("width")) or 0.0, WIDEST)
    if kind in OBSTACLES and not tags:
        return width or OBSTACLES[kind]
    if not tags and (_positive(p.get("height")) or _size(p)):
        return width or 0.1
    return None


def _body(geometry: Any, p: Properties, width: float) -> Any:
    """The ground that an object covers: a polygon in metres; None where it has none."""
    if geometry.is_empty:
        return None
    kind = int(shapely.get_type_id(geometry))
    size = _size(p)
    if kind in (0, 4) and size is not None:
        pose = solids.pose_of(p) if p.get("pose") is not None else (*shapely.get_coordinates(geometry)[0], 0, 0, 0, 0)
        x, y = size[0] / 2, size[1] / 2
        corners = np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]])
        return shapely.Polygon(solids.placed(corners, pose)[:, :2])
    if kind in (3, 6):
        return shapely.make_valid(geometry)
    if kind == 7:
        bodies = [b for b in (_body(g, {}, width) for g in shapely.get_parts(geometry)) if b is not None]
        return shapely.union_all(bodies) if bodies else None
    if width <= 0:
        return None
    caps = "round" if kind in (0, 4) else "square" if p.get("kind") == "wall" else "flat"
    return shapely.buffer(geometry, width / 2, cap_style=caps, join_style="mitre", mitre_limit=2.0)


def _heights(p: Properties) -> tuple[float, float]:
    """(base, top) of an extruded footprint in metres above the floor; the top is infinite where nothing says."""
    if p.get("kind") in HOLES:
        return -math.inf, math.inf
    tags = _tags(p)
    base, top = _positive(p.get("base")), _positive(p.get("height"))
    if base is None:
        base = osm_tags.base(tags)
    if top is None:
        top = osm_tags.height(tags)
    size = _size(p)
    if not top and size is not None and len(size) > 2 and size[2] > 0:
        pose = p.get("pose")
        bottom = _positive(pose[2]) if isinstance(pose, (list, tuple)) and len(pose) > 2 else None
        top = (base or 0.0) + (bottom or 0.0) + size[2]
    return base or 0.0, top or math.inf


def _positive(value: Any) -> float | None:
    good = isinstance(value, (int, float)) and not isinstance(value, bool) and 0 <= value <= MAX_METRES
    return float(value) if good else None


def _size(p: Properties) -> tuple[float, ...] | None:
    """[x, y(, z)] of a box; None where nothing says so."""
    said = p.get("size")
    if not isinstance(said, (list, tuple)) or len(said) < 2:
        return None
    numbers = [_positive(v) for v in said[:3]]
    found = tuple(v for v in numbers if v is not None)
    return found if len(found) == len(numbers) and found[0] > 0 and found[1] > 0 else None


def _relations(part: Features, rows: list[int]) -> dict[int, Any]:
    """The areas of OpenStreetMap's multipolygons among these rows, from their ways: outer ones less inner ones."""
    wanted = [
        k for k in rows if part.ids[k].startswith("r") and _tags(part.properties[k]).get("type") == "multipolygon"
    ]
    if not wanted:
        return {}
    index = part.index()
    out: dict[int, Any] = {}
    for k in wanted:
        rings: dict[str, list[Any]] = {"outer": [], "inner": []}
        members = part.properties[k]["osm"].get("members")
        for member in members if isinstance(members, (list, tuple)) else ():
            if not isinstance(member, (list, tuple)) or len(member) < 3:
                continue
            row = index.get(f"w{member[1]}") if member[0] == "way" else None
            role = "inner" if member[2] == "inner" else "outer"
            if row is not None:
                geometry = part.geometry[row]
                rings[role].append(shapely.boundary(geometry) if shapely.get_type_id(geometry) == 3 else geometry)
        outer, inner = (shapely.union_all(shapely.get_parts(shapely.polygonize(lines))) for lines in rings.values())
        area = shapely.difference(outer, inner)
        if area.area > 0:
            out[k] = area
    return out

"""Collect the obstacles of each level from stored objects, for grids and voxels."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.derive import DerivationNotes
from app.errors import CannotConvert, Invalid, MissingDatum, MissingLayer, NotFound, Problem, TooLarge
from app.model import obstacles, raster, solids, worlds
from app.model.distinct import distinct
from app.model.features import NO_GEOMETRY, Features, Properties
from app.model.grid import OCCUPIED, UNKNOWN
from app.model.layers import Layers
from app.model.obstacles import UNKNOWN_RADIUS_METRES
from app.model.osm_areas import ground_around, incomplete_areas, multipolygon_areas

Array = NDArray[np.float64]

DEFAULT_SURROUNDINGS_METRES = 5.0
"""Default radius of unknown ground around the origin of an unreadable solid, in metres."""

NO_AREA = "they have neither an area nor a size"
WITHOUT_FILES = "they have neither shapes nor a size: upload the files of their models too"
POINTS = "they are points: state their size, or draw their outlines"
INCOMPLETE = "their ways or nodes are missing, or their rings do not close: upload the whole area"

MAX_TRIANGLES = 10_000_000
"""Maximum number of triangles of all solids together: a world can place a mesh of some megabytes thousands of times."""

NOT_AN_OBSTACLE = "not an obstacle for robots"


@dataclass(slots=True)
class LevelObstacles:
    """Obstacles and ground of a level, in metres of the local frame.

    Attributes:
        footprints: areas, lines or points (shapely).
        base, top: of each footprint, metres above the level's floor; infinite if not stated.
        triangles: float64 [n, 3, 3] of all solids, heights above the level's floor.
        owner: index of the solid of each triangle.
        free: ground known to be free.
        unknown: ground around unreadable solids and objects of unknown extent, which is never free.
        unreadable: reasons why solids are unreadable, each once.
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
        """Number of obstacles."""
        return len(self.footprints) + len(distinct(self.owner))

    def cut(self, low: float, high: float) -> LevelObstacles:
        """Return the obstacles between two heights above the floor, or at that height if both are equal."""
        meets = (self.triangles[:, :, 2].min(axis=1) <= high) & (self.triangles[:, :, 2].max(axis=1) >= low)
        # a solid that spans the band without a surface in it still fills it
        meets = np.isin(self.owner, distinct(self.owner[self._spans(low)])) | meets
        standing = [
            k for k, (base, top) in enumerate(zip(self.base, self.top, strict=True)) if base <= high and top > low
        ]
        return replace(
            self,
            footprints=[self.footprints[k] for k in standing],
            base=[self.base[k] for k in standing],
            top=[self.top[k] for k in standing],
            triangles=self.triangles[meets],
            owner=self.owner[meets],
        )

    def _spans(self, height: float) -> NDArray[np.bool_]:
        """Mark the triangles of solids that reach from below a height to above it."""
        if not len(self.triangles):
            return np.zeros(0, bool)
        owners, index = np.unique(self.owner, return_inverse=True)
        lowest, highest = np.full(len(owners), np.inf), np.full(len(owners), -np.inf)
        np.minimum.at(lowest, index, self.triangles[:, :, 2].min(axis=1))
        np.maximum.at(highest, index, self.triangles[:, :, 2].max(axis=1))
        return np.asarray(((lowest <= height) & (highest > height))[index])

    def draw(self, cells: NDArray[np.uint8], frame: raster.RasterFrame, low: float, high: float) -> None:
        """Mark every cell as occupied that an obstacle of ``cut`` touches between two heights."""
        slab = np.array([[low, high]])
        raster.paint(cells, raster.surfaces(self.triangles, frame, slab), OCCUPIED)
        raster.paint(cells, raster.insides(self.triangles, self.owner, frame, slab[:, 0]), OCCUPIED)
        raster.paint(cells, raster.areas(self.footprints, frame, touched=True), OCCUPIED)

    def draw_unknown(self, cells: NDArray[np.uint8], frame: raster.RasterFrame) -> None:
        """Mark the ground of ``unknown`` as unknown unless it is occupied."""
        if self.unknown:
            solid = cells == OCCUPIED
            raster.paint(cells, raster.areas(self.unknown, frame, touched=True), UNKNOWN)
            cells[solid] = OCCUPIED

    def bounds(self) -> tuple[float, float, float, float] | None:
        """Return the bounding box of everything, seen from above; None if there is nothing."""
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
    notes: DerivationNotes,
    *,
    doors_closed: bool = False,
    visuals: bool = False,
    world: str | None = None,
    surroundings: float = DEFAULT_SURROUNDINGS_METRES,
    unknown_radius: float = UNKNOWN_RADIUS_METRES,
) -> dict[str, LevelObstacles]:
    """Collect the obstacles of all levels that have objects; if there are several worlds, of one
    (``app.model.worlds``).

    surroundings: radius in metres around an unreadable solid. unknown_radius: metres around an object of unknown
    extent. Raises MissingDatum if objects have WGS 84 coordinates and there is no datum, Invalid if there is no such
    world.
    """
    solid_reader = solids.Solids(layers.resources(), visuals=visuals)
    out: dict[str, LevelObstacles] = {}
    reader = _Reader(layers, notes, solid_reader, doors_closed, surroundings, unknown_radius)
    parts = {key: part for key, part in layers.vector("objects").items() if len(part)}
    if world is not None and not any(worlds.names(part) for part in parts.values()):
        raise Invalid("no world is stored: omit world", [Problem("no world is stored: omit world", where="world")])
    for key, part in parts.items():
        try:
            one, others = worlds.select_world(part, world)
        except NotFound as error:
            raise Invalid(error.detail, [Problem(error.detail, where="world")]) from error
        if others:
            notes.warn(f"only one world is used; select another one with world=: {', '.join(others)}")
        if len(one):
            reader.read(one, out.setdefault(key.level, LevelObstacles()), key.level)
    reader.report()
    return {level: reader.finish(site) for level, site in out.items()}


def unreadable_error(reasons: Iterable[str], summary: str) -> MissingLayer:
    """Return the error for a map that unreadable solids would make a guess. summary: what is therefore unknown."""
    named = list(dict.fromkeys(reasons))
    more = f"; and {len(named) - 3} more" if len(named) > 3 else ""
    detail = f"{summary}, because solids of the objects cannot be read: {'; '.join(named[:3])}{more}"
    return MissingLayer(detail, [Problem(reason) for reason in named[:100]])


class _Reader:
    """Converter of objects to obstacles, with the state that all parts share."""

    def __init__(
        self,
        layers: Layers,
        notes: DerivationNotes,
        solid_reader: solids.Solids,
        doors_closed: bool,
        surroundings: float,
        unknown_radius: float,
    ) -> None:
        self.layers, self.notes, self.solids, self.doors_closed = layers, notes, solid_reader, doors_closed
        self.surroundings, self.unknown_radius = surroundings, unknown_radius
        self.seen = replace(solid_reader, planes=True, visuals=True)
        self.shapes: dict[int, list[Array]] = {}
        self.left: Counter[str] = Counter()
        self.shapeless: Counter[str] = Counter()
        self.broken = 0
        self.unsized: dict[str, list[str]] = {}
        self.nowhere: list[str] = []
        self.unreadable: dict[str, list[str]] = {}
        self.bodiless = 0
        self.triangles = 0

    def read(self, part: Features, site: LevelObstacles, level: str) -> None:
        """Add a part's objects to a level's obstacles."""
        rows: list[int] = []
        for k, p in enumerate(part.properties):
            kind = str(p.get("kind") or "") or "without a kind"
            role = obstacles.object_role(p, doors_closed=self.doors_closed)
            if role == "mark":
                self.left[kind] += 1
            elif role == "solids":
                self._solids(part, k, site, level)
            else:
                self.shapeless[kind] += role == "bodiless"
                rows.append(k)
        if not rows:
            return
        try:
            metres = part.select(rows).in_local(self.layers.frame)
        except Invalid as error:  # too far from the datum
            raise CannotConvert(error.detail, error.problems) from error
        old = multipolygon_areas(part, [k for k, geometry in zip(rows, metres, strict=True) if geometry.is_empty])
        incomplete = incomplete_areas(part, rows)
        for k, stored in zip(rows, metres, strict=True):
            geometry = self._local(part, old[k]) if old.get(k) is not None else stored
            if k in incomplete:
                ground = ground_around(self._local(part, incomplete[k]), self.unknown_radius)
                self._unknown(part, k, ground, INCOMPLETE, site)
                if geometry.is_empty:
                    self.bodiless += 1
                    continue
            try:
                self._outline(part, k, geometry, site, level)
            except Invalid as error:
                self.broken += 1
                self._around(part, k, geometry, error.detail, site)

    def _outline(self, part: Features, k: int, geometry: Any, site: LevelObstacles, level: str) -> None:
        """Add an object by its geometry in metres: as an obstacle, or as free ground."""
        p = part.properties[k]
        role = obstacles.object_role(p, doors_closed=self.doors_closed)
        if role == "bodiless":
            self._around(part, k, geometry, WITHOUT_FILES, site)
            return
        is_ground = role == "ground"
        if is_ground:
            ground = obstacles.object_ground(p, geometry)
            if ground is not None:
                site.free.append(ground)
            if p.get("kind") != "lift":
                return
            if p.get("shapes"):
                self._solids(part, k, site, level)
                return
        body = obstacles.object_body(p, geometry, elevation=self.layers.elevation(level))
        if body is not None:
            site.footprints.append(body.area)
            site.base.append(body.base)
            site.top.append(body.top)
            if obstacles.is_unsized(p, geometry):
                self._around(part, k, geometry, POINTS, site)
        elif not is_ground:
            self.bodiless += 1
            self._around(part, k, geometry, NO_AREA, site)

    def _around(self, part: Features, k: int, geometry: Any, reason: str, site: LevelObstacles) -> None:
        """Add the ground of an object of unknown extent. geometry: its known geometry, in metres."""
        p = part.properties[k]
        if p.get("kind") != "floor":  # a floor of unknown extent is not free
            self._unknown(part, k, obstacles.object_surroundings(p, geometry, self.unknown_radius), reason, site)

    def _unknown(self, part: Features, k: int, ground: Any, reason: str, site: LevelObstacles) -> None:
        if ground is None or ground.is_empty:
            self.nowhere.append(_name(part, k))
            return
        site.unknown.append(ground)
        self.unsized.setdefault(reason, []).append(_name(part, k))

    def _local(self, part: Features, geometry: Any) -> Any:
        frame = self.layers.frame
        if bool(part.local.all()) or frame is None:
            return geometry
        return frame.geometries_to_local(np.array([geometry], object))[0]

    def _solids(self, part: Features, k: int, site: LevelObstacles, level: str) -> None:
        p = part.properties[k]
        try:
            triangles, unreadable = self.solids.read(p)
        except (Invalid, TooLarge) as error:
            self._mark_unknown_ground(_name(part, k), p, self._ground_around(part, k), [error.detail], site)
            return
        if unreadable:
            origins = shapely.MultiPoint([one.at for one in unreadable])
            ground = obstacles.object_surroundings({**p, "pose": None}, origins, self.surroundings)
            self._mark_unknown_ground(_name(part, k), p, ground, [one.error.detail for one in unreadable], site)
        self.triangles += len(triangles)
        if self.triangles > MAX_TRIANGLES:
            raise CannotConvert(f"the solids of the objects have more than {MAX_TRIANGLES} triangles: simplify them")
        if unreadable and not len(triangles):
            return
        if len(triangles):
            self.shapes.setdefault(id(site), []).append(triangles - np.array([0.0, 0.0, self.layers.elevation(level)]))
        else:
            self.left["with planes or images only"] += 1

    def _ground_around(self, part: Features, k: int) -> Any:
        """Return the ground around an object whose solids cannot be placed."""
        try:
            geometry = part.select([k]).in_local(self.layers.frame)[0]
        except (Invalid, MissingDatum):
            geometry = NO_GEOMETRY
        ground = obstacles.object_surroundings(part.properties[k], geometry, self.surroundings)
        return shapely.Point(0, 0).buffer(self.surroundings) if ground is None else ground

    def _mark_unknown_ground(
        self, name: str, p: Properties, ground: Any, reasons: Iterable[str], site: LevelObstacles
    ) -> None:
        """Add the ground around solids of unknown extent, including shapes of the object that can be read."""
        around = [ground]
        shapes = p.get("shapes")
        for shape in shapes if isinstance(shapes, (list, tuple)) else ():
            try:
                around.append(self.seen.footprint({**p, "shapes": [shape]}))
            except (Invalid, TooLarge):
                continue  # the disc covers it
        site.unknown.append(shapely.union_all(around))
        for reason in dict.fromkeys(reasons):
            self.unreadable.setdefault(reason, []).append(name)
            if reason not in site.unreadable:
                site.unreadable.append(reason)

    def finish(self, site: LevelObstacles) -> LevelObstacles:
        """Return the level's obstacles with the triangles of their solids."""
        pieces = self.shapes.get(id(site), [])
        if pieces:
            site.triangles = np.concatenate(pieces)
            site.owner = np.repeat(np.arange(len(pieces)), [len(one) for one in pieces])
        return site

    def report(self) -> None:
        """Write dropped objects and warnings to the notes."""
        for kind, count in sorted(self.left.items()):
            self.notes.drop(f"objects {kind}", count, NOT_AN_OBSTACLE)
        for kind, count in sorted(self.shapeless.items()):
            self.notes.drop(f"objects {kind}", count, WITHOUT_FILES)
        self.notes.drop("objects", self.bodiless, NO_AREA)
        self.notes.drop("objects", self.broken, "their geometry is invalid")
        for reason, names in list(self.unreadable.items())[:100]:
            self._warn(names, "a solid that cannot be read", f"{reason}; the ground around it is unknown")
        for reason, names in list(self.unsized.items())[:100]:
            self._warn(names, "an unknown extent", f"{reason}; the ground around is unknown")
        if self.nowhere:
            self._warn(self.nowhere, "no known position", "a grid may show their ground as free; add a geometry")
        if self.unreadable:
            why = "solids that cannot be read have an unknown extent"
            self.notes.fill("surroundings", self.surroundings, why, "surroundings")
        if self.unsized:
            why = "metres around objects of unknown extent"
            self.notes.fill("unknown_radius", self.unknown_radius, why, "unknown_radius")

    def _warn(self, names: Sequence[str], fault: str, consequence: str) -> None:
        distinct_names = list(dict.fromkeys(names))
        called = ", ".join(name[:80] for name in distinct_names[:5]) + (" …" if len(distinct_names) > 5 else "")
        objects = f"{len(names)} objects have" if len(names) > 1 else "1 object has"
        self.notes.warn(f"{objects} {fault} ({called}): {consequence}", where=names[0][:80])


def _name(part: Features, k: int) -> str:
    name = part.properties[k].get("name")
    return name if isinstance(name, str) and name else part.ids[k]

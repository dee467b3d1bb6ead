"""Apply closures to exported maps: areas become keepout zones and cells, edges are omitted from networks or marked.

Areas are added to the stored zones before anything is derived, so that masks and grids derived from zones contain them.
Edges are removed from the network that a format is about to write, stored or derived.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import shapely
import shapely.affinity
import shapely.geometry
from numpy.typing import NDArray

from app.errors import FleetMapError
from app.formats import Format
from app.model import masks
from app.model.closures import Closure, ClosureMode, Closures, closures_digest, zone_id
from app.model.features import Features, concatenate, features
from app.model.frame import Anchor, Datum
from app.model.geodesy import LocalFrame, local_frame
from app.model.grid import FREE, OCCUPIED, OccupancyGrid
from app.model.layers import MAP, Layers, PartKey
from app.store.values import Bounds, Box, PartEntry, Provenance, Version

if TYPE_CHECKING:
    from app.store.store import Store

PART_NAME = "closures in force"
KEEPOUT = "keepout"
BLOCKED, UNTIL = "blocked", "blocked_until"
NO_EFFECT = "none"

MAX_CELLS = 2**28
MAX_METRES_FROM_DATUM = 100_000.0
"""Maximum distance of a closed area in degrees from the datum, in metres."""

MAX_AREA_METRES = 10_000.0
"""Maximum extent of a closed area, in metres."""

MAX_LISTED = 100
"""Maximum number of edges that a report lists for one closure."""


# --- versions with closures ---


def add_areas(version: Version) -> Version:
    """Add the closed areas to a version's parts, as one part of the layer zones for each level."""
    if version.closures is None or not version.closures.items or any(map(_is_area_part, version.parts)):
        return version
    entries = [_entry(key, areas) for key, areas in _areas(version).items()]
    return replace(version, parts=tuple(sorted((*version.parts, *entries), key=lambda e: e.key)))


def drop_areas(version: Version) -> Version:
    """Remove the closed areas: the version as it is stored."""
    return replace(version, parts=tuple(entry for entry in version.parts if not _is_area_part(entry)))


def load(store: Store, version: Version, keys: Collection[PartKey]) -> Layers:
    """Load parts of a version, with its closed areas and without marks that an earlier release put into versions."""
    areas = {} if version.closures is None else {k: closed for k, closed in _areas(version).items() if k in keys}
    loaded = drop_timed_marks(store.content.load(version, [key for key in keys if key not in areas]))
    zones = {key: _zones([c for c in closed if not _is_kept(c, loaded)]) for key, closed in areas.items()}
    return replace(loaded, parts={**loaded.parts, **zones})


def _is_kept(area: Closure, layers: Layers) -> bool:
    """Return whether a zone of the version is this closed area for good: with its id, its kind and its shape."""
    item, shape, _ = _zone(area)
    for zones in layers.vector("zones", area.level).values():
        k = zones.index().get(item)
        if k is None or zones.properties[k].get("kind") != KEEPOUT or zones.local[k] != (area.crs != "wgs84"):
            continue
        if zones.geometry[k].equals(shape):
            return True
    return False


def drop_timed_marks(layers: Layers) -> Layers:
    """Drop marks in the layers that block something until a time: only closures block temporarily.

    Releases without closures stored such marks in versions, and exported maps with closures may be uploaded again.
    """
    return replace(
        layers,
        parts={
            key: _drop_timed_marks(part) if isinstance(part, Features) else part for key, part in layers.parts.items()
        },
    )


def _drop_timed_marks(part: Features) -> Features:
    timed = [UNTIL in p or ("overlay" in p and "expires" in p) for p in part.properties]
    if not any(timed):
        return part
    remaining = part.select([k for k, p in enumerate(part.properties) if not ("overlay" in p and "expires" in p)])
    properties = tuple(
        {name: value for name, value in p.items() if name not in (BLOCKED, UNTIL)} if UNTIL in p else p
        for p in remaining.properties
    )
    return replace(remaining, properties=properties)


def ingredients(version: Version, fmt: Format, keys: Collection[PartKey]) -> dict[str, Any]:
    """Collect the closures that a map's bytes depend on, for the recipe key; empty if none can change them."""
    closures = version.closures
    if closures is None:
        return {}
    network = fmt.traits.is_container or "topology" in fmt.layers
    masked = fmt.traits.is_container or any(_may_be_keepout(key) for key in keys)
    out: dict[str, Any] = {}
    if closures.items and (network or masked):
        out["closures"] = closures.digest
        if fmt.traits.is_container:
            out["masks"] = "closed"  # caches may have packages whose masks lack the closed areas
    if network and closures.mode != "apply":
        out["closure_mode"] = closures.mode
    return out


def place_problem(closure: Closure, version: Version) -> str | None:
    """Return why a closed area cannot be located in a version, or None."""
    levels = [level.name for level in version.levels]
    if closure.level not in levels:
        return f"version {version.ref} has no level {closure.level[:80]!r}; its levels: {', '.join(levels)[:500]}"
    if closure.crs == "wgs84" and version.datum is None:
        return f"version {version.ref} has no datum, which coordinates in degrees require"
    try:
        box = shapely.total_bounds(_zones([closure]).in_local(_frame(version.datum)))
    except FleetMapError as error:
        return error.detail
    if max(box[2] - box[0], box[3] - box[1]) > MAX_AREA_METRES:
        return f"it is wider than {MAX_AREA_METRES / 1000:g} km"
    if closure.crs == "wgs84" and not (np.abs(box) <= MAX_METRES_FROM_DATUM).all():
        return f"it extends more than {MAX_METRES_FROM_DATUM / 1000:g} km from the datum"
    return None


# --- areas ---

_placed_cache: OrderedDict[tuple[str, Any, Any], list[Closure]] = OrderedDict()
_placed_lock = threading.Lock()
MAX_CACHED_PLACES = 64


def _areas(version: Version) -> dict[PartKey, list[Closure]]:
    """Group the closed areas that can be located in a version by the part that they become."""
    closures = version.closures
    if closures is None or not closures.items:
        return {}
    cache_key = (closures.digest, version.levels, version.datum)
    with _placed_lock:
        chosen = _placed_cache.get(cache_key)
    if chosen is None:
        chosen = [c for c in closures.items if c.polygon is not None and place_problem(c, version) is None]
        with _placed_lock:
            _placed_cache[cache_key] = chosen
            while len(_placed_cache) > MAX_CACHED_PLACES:
                _placed_cache.popitem(last=False)
    taken = {entry.key for entry in version.parts if not _is_area_part(entry)}
    out: dict[PartKey, list[Closure]] = {}
    for closure in chosen:
        key = PartKey("zones", closure.level, PART_NAME)
        while key in taken:
            key = replace(key, name=key.name + "'")
        out.setdefault(key, []).append(closure)
    return out


def _is_area_part(entry: PartEntry) -> bool:
    return entry.key.layer == "zones" and entry.provenance.format == "closures"


def _entry(key: PartKey, areas: Sequence[Closure]) -> PartEntry:
    zones = _zones(areas)
    bounds: Bounds = {"local": _box(zones, zones.local), "wgs84": _box(zones, ~zones.local)}
    steps = ({"step": "closures", "overlays": [closure.id for closure in areas]},)
    digest = closures_digest([closure.as_dict() for closure in areas])
    return PartEntry(key, digest, len(areas), bounds, Provenance("raw", "closures", steps=steps))


def _box(zones: Features, chosen: NDArray[np.bool_]) -> Box | None:
    if not chosen.any():
        return None
    west, south, east, north = shapely.total_bounds(zones.geometry[chosen]).tolist()
    return west, south, east, north


def _zones(areas: Sequence[Closure]) -> Features:
    """Convert closed areas to keepout zones."""
    anchors: tuple[Anchor, ...] = ("local", "wgs84")
    both = []
    for anchor in anchors:
        chosen = [closure for closure in areas if (closure.crs == "wgs84") == (anchor == "wgs84")]
        both.append(features([_zone(closure) for closure in chosen], anchor))
    return concatenate(both)


def _zone(closure: Closure) -> tuple[str, Any, dict[str, Any]]:
    about = {"id": closure.id} | ({"detail": closure.detail} if closure.detail else {})
    properties = {"kind": KEEPOUT, "expires": closure.expires, "overlay": about}
    return zone_id(closure.id), shapely.force_2d(shapely.geometry.shape(closure.polygon)), properties


def _frame(datum: Datum | None) -> LocalFrame | None:
    return None if datum is None else local_frame(datum)


# --- maps ---


@dataclass(frozen=True, slots=True)
class ClosureLine:
    """Effect of one closure on a map, as a line of its report.

    edge: the closed edge, None for an area. edges: ids, at most ``MAX_LISTED``. why: the reason for no effect.
    """

    id: str
    level: str
    expires: str
    effect: str
    edges: tuple[str, ...] = ()
    edge: str | None = None
    why: str | None = None

    def as_dict(self) -> dict[str, Any]:
        """Convert the line to JSON, without empty members."""
        out: dict[str, Any] = {"id": self.id, "level": self.level, "expires": self.expires}
        out |= {} if self.edge is None else {"edge": self.edge}
        out |= {"effect": self.effect, "edges": list(self.edges)}
        return out if self.why is None else {**out, "why": self.why}

    @classmethod
    def from_dict(cls, line: Mapping[str, Any]) -> ClosureLine:
        """Read the line from JSON."""
        return cls(**{**line, "edges": tuple(line["edges"])})


@dataclass(slots=True)
class ClosureReport:
    """Effects of closures on one map.

    lines: one for each closure with an effect. omitted: number of removed edges. kept: number of blocked edges that
    stay in a format that cannot mark them. emptied: whether no edge would have been left. unmasked: levels of a
    container that have grids and closed areas, but no keepout mask.
    """

    lines: list[ClosureLine] = field(default_factory=list)
    omitted: int = 0
    kept: int = 0
    emptied: bool = False
    unmasked: list[str] = field(default_factory=list)


def close(
    fmt: Format, layers: Layers, closures: Closures | None, drawn: Collection[PartKey] = (), *, mark: bool = False
) -> tuple[Layers, ClosureReport]:
    """Apply closures, and the network's own blocked edges, to the layers that a format is about to write.

    drawn: parts derived from zones: they contain the areas already. mark: keep closed edges, with a mark.
    """
    report = ClosureReport()
    mode: ClosureMode = "apply" if closures is None else closures.mode
    mark = mark or mode == "mark" or fmt.traits.marks_blocked
    items = () if closures is None else closures.items
    effects: dict[str, _Effect] = {closure.id: _Effect() for closure in items}
    zones = {zone_id(closure.id): closure.id for closure in items}
    parts = dict(layers.parts)
    for key, part in layers.parts.items():
        if isinstance(part, Features) and key.layer == "topology":
            parts[key] = _close_edges(key, part, items, layers.frame, mark=mark, effects=effects, report=report)
        elif isinstance(part, OccupancyGrid):
            parts[key] = _close_mask(key, part, items, layers.frame, drawn=key in drawn, effects=effects)
        elif isinstance(part, Features) and key.layer == "zones":
            for overlay_id in (zones[i] for i in part.ids if i in zones):
                effects[overlay_id].zone = True
    if mark and not fmt.traits.marks_blocked:
        report.kept = sum(
            _is_blocked(p) for part in parts.values() if isinstance(part, Features) for p in part.properties
        )
    report.lines = [line(c, effects[c.id], mark=mark) for c in items if effects[c.id].text(mark=mark) != NO_EFFECT]
    return replace(layers, parts=parts), report


def close_masks(layers: Layers, closures: Closures | None) -> tuple[Layers, ClosureReport]:
    """Apply closed areas to the keepout masks of a container, which writes grids under other names."""
    items = () if closures is None else closures.items
    effects = {closure.id: _Effect() for closure in items}
    grids = {key: part for key, part in layers.parts.items() if isinstance(part, OccupancyGrid)}
    closed = {
        key: _close_mask(key, grid, items, layers.frame, drawn=False, effects=effects) for key, grid in grids.items()
    }
    unmasked = {c.level for c in items if c.polygon is not None and not effects[c.id].cells}
    report = ClosureReport([line(c, effects[c.id]) for c in items if effects[c.id].cells])
    report.unmasked = sorted(unmasked & {key.level for key in grids})
    return replace(layers, parts={**layers.parts, **closed}), report


@dataclass(slots=True)
class _Effect:
    """Effect of one closure on one map."""

    edges: list[str] = field(default_factory=list)
    zone: bool = False
    cells: str = ""

    def note_cells(self, *, complete: bool) -> None:
        """Note that a mask contains the area, complete or cropped; a cropped one counts."""
        if not complete:
            self.cells = "keepout cells (cropped at the mask's edge)"
        self.cells = self.cells or "keepout cells"

    def text(self, *, mark: bool) -> str:
        edges = "1 edge" if len(self.edges) == 1 else f"{len(self.edges)} edges"
        did = [("marked " if mark else "left out ") + edges] if self.edges else []
        return ", ".join([*did, *(["zone"] if self.zone else []), *([self.cells] if self.cells else [])]) or NO_EFFECT


def line(closure: Closure, effect: _Effect | None = None, *, mark: bool = False, why: str | None = None) -> ClosureLine:
    """Build a report's line about one closure. why: the reason for no effect."""
    effect = effect or _Effect()
    edges = tuple(effect.edges[:MAX_LISTED])
    return ClosureLine(closure.id, closure.level, closure.expires, effect.text(mark=mark), edges, closure.edge, why)


def report_lines(version: Version, stored: Iterable[ClosureLine]) -> tuple[ClosureLine, ...]:
    """Build a line for each closure in force: its effect from a map's stored report, or why it has none."""
    effects = {one.id: one for one in stored}
    out = []
    for closure in () if version.closures is None else version.closures.items:
        why: str | None = "this map has no such edge"
        if closure.edge is None:
            why = place_problem(closure, version) or "this map contains nothing inside the area"
        out.append(effects.get(closure.id) or line(closure, why=why))
    return tuple(out)


def merge_report_lines(reports: Iterable[Iterable[ClosureLine]]) -> tuple[ClosureLine, ...]:
    """Join the lines of several maps' reports: one line for each closure, with all its effects and edges.

    A line without an effect, and its reason, count only if no map shows the closure.
    """
    out: dict[str, ClosureLine] = {}
    for one in (one for report in reports for one in report):
        first = out.setdefault(one.id, one)
        if NO_EFFECT in (first.effect, one.effect):
            out[one.id] = one if first.effect == NO_EFFECT != one.effect else first
            continue
        effect = ", ".join(dict.fromkeys([*first.effect.split(", "), *one.effect.split(", ")]))
        out[one.id] = replace(first, effect=effect, edges=tuple(dict.fromkeys(first.edges + one.edges))[:MAX_LISTED])
    return tuple(out.values())


# --- networks ---


def _is_blocked(properties: Mapping[str, Any]) -> bool:
    return properties.get("kind") == "edge" and properties.get(BLOCKED) is True


def _close_edges(
    key: PartKey,
    part: Features,
    items: Sequence[Closure],
    frame: LocalFrame | None,
    *,
    mark: bool,
    effects: Mapping[str, _Effect],
    report: ClosureReport,
) -> Features:
    """Remove the closed edges of a network, or mark them."""
    until: dict[int, str] = {}
    for closure, places in _find_closed_edges(key, part, items, frame):
        for k in places:
            until[k] = max(until.get(k, ""), closure.expires)
        effects[closure.id].edges += [part.ids[k] for k in places]
    if not mark:
        blocked = np.array([_is_blocked(p) for p in part.properties], bool)
        blocked[list(until)] = True
        report.omitted += int(blocked.sum())
        left = part.select(~blocked) if blocked.any() else part
        report.emptied |= bool(blocked.any()) and not any(p.get("kind") == "edge" for p in left.properties)
        return left
    if not until:
        return part
    # Drawing formats write a drawn line and omit the edges read from it: unlink marked edges to write them too.
    loose = {part.properties[k].get("drawn_from") for k in until} - {None}
    properties = []
    for k, p in enumerate(part.properties):
        cut = ("drawn_from",) if p.get("drawn_from") in loose else ()
        added: dict[str, Any] = {BLOCKED: True, UNTIL: until[k]} if k in until else {}
        properties.append({name: value for name, value in p.items() if name not in cut} | added)
    return replace(part, properties=tuple(properties))


def _find_closed_edges(
    key: PartKey, part: Features, items: Sequence[Closure], frame: LocalFrame | None
) -> Iterator[tuple[Closure, list[int]]]:
    """Yield each closure of a network with the indices of the edges that it closes, by id or by crossing its area."""
    areas = [c for c in items if c.polygon is not None and c.level == key.level]
    named = [c for c in items if c.edge is not None]
    if not areas and not named:
        return
    edges = np.array([p.get("kind") == "edge" for p in part.properties], bool)
    positions = part.index() if named else {}
    for closure in named:
        k = positions.get(closure.edge or "")
        if k is not None and edges[k]:
            yield closure, [k]
    if areas and edges.any():
        places = np.flatnonzero(edges & part.local) if frame is None else np.flatnonzero(edges)
        tree = shapely.STRtree(part.select(places).in_local(frame))
        for closure in areas:
            try:
                area = _area_in_metres(closure, frame)
            except FleetMapError:
                continue  # cannot be located here, as the report explains
            hit = np.sort(tree.query(area, predicate="intersects"))
            if len(hit):
                yield closure, places[hit].tolist()


def _area_in_metres(closure: Closure, frame: LocalFrame | None) -> Any:
    """Convert a closed area to local metres. Raises MissingDatum."""
    return _zones([closure]).in_local(frame)[0]


# --- grids ---


def _may_be_keepout(key: PartKey) -> bool:
    """Return whether a part can be a keepout mask by its name: recipes are planned without the grids' properties."""
    return key.layer == "occupancy" and key.name != MAP and key.name not in masks.MASKS - masks.KEEPOUT_MASKS


def _close_mask(
    key: PartKey,
    grid: OccupancyGrid,
    items: Sequence[Closure],
    frame: LocalFrame | None,
    *,
    drawn: bool,
    effects: Mapping[str, _Effect],
) -> OccupancyGrid:
    """Draw the closed areas of its level in a grid, if it is a keepout mask. drawn: it contains them already."""
    areas = [c for c in items if c.polygon is not None and c.level == key.level]
    if not areas or not _may_be_keepout(key) or not masks.is_keepout(key.name, grid.properties):
        return grid
    grid, complete = (grid, True) if drawn else _burn(grid, areas, frame)
    for area in areas:
        effects[area.id].note_cells(complete=complete)
    return grid


def _burn(grid: OccupancyGrid, areas: Sequence[Closure], frame: LocalFrame | None) -> tuple[OccupancyGrid, bool]:
    """Mark closed areas as occupied in a stored keepout mask. Returns it and whether it covers all areas.

    The mask grows by free cells if an area extends beyond it, up to MAX_CELLS.
    """
    from rasterio.features import rasterize
    from rasterio.transform import Affine

    x, y, yaw = grid.origin
    cosine, sine, size = float(np.cos(yaw)), float(np.sin(yaw)), grid.resolution
    to_cells = [cosine / size, sine / size, -sine / size, cosine / size]
    shift = [-(x * cosine + y * sine) / size, (x * sine - y * cosine) / size]
    shapes = []
    for area in areas:
        try:
            shapes.append(shapely.affinity.affine_transform(_area_in_metres(area, frame), [*to_cells, *shift]))
        except FleetMapError:
            continue  # cannot be located here, as the report explains
    if not shapes:
        return grid, False
    left, bottom, right, top = shapely.total_bounds(np.array(shapes, object))
    before = (max(0, -int(np.floor(bottom))), max(0, -int(np.floor(left))))
    after = (max(0, int(np.ceil(top)) - grid.height), max(0, int(np.ceil(right)) - grid.width))
    fits = (grid.height + before[0] + after[0]) * (grid.width + before[1] + after[1]) <= MAX_CELLS
    if not fits:
        before = after = (0, 0)
    cells = np.pad(grid.cells, ((before[0], after[0]), (before[1], after[1])), constant_values=FREE)
    transform = Affine.translation(-before[1], -before[0])
    rasterize([(shape, OCCUPIED) for shape in shapes], out=cells, transform=transform, all_touched=True)
    dx, dy = -before[1] * size, -before[0] * size
    origin = (round(x + dx * cosine - dy * sine, 9), round(y + dx * sine + dy * cosine, 9), yaw)
    return replace(grid, cells=cells, origin=origin), fits

"""Apply closures on the way out: areas become keepout zones and cells, edges are left out of networks or marked.

Areas are put beside the stored zones before anything is derived, so that masks and grids made of zones hold them. Edges
are taken out of the network that a format is about to write, stored or derived.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import orjson
import shapely
import shapely.affinity
import shapely.geometry
from numpy.typing import NDArray

from app.errors import MissingDatum
from app.formats import Format
from app.model.closures import Closure, ClosureMode, Closures
from app.model.features import Features, concatenate, features
from app.model.frame import Anchor
from app.model.geodesy import LocalFrame
from app.model.grid import FREE, OCCUPIED, OccupancyGrid
from app.model.layers import Layers, Part, PartKey
from app.store import Store
from app.store.overlays import zone_id
from app.store.values import Bounds, Box, PartEntry, Provenance, Version

PART_NAME = "closures in force"
KEEPOUT = "keepout"
BLOCKED, UNTIL = "blocked", "blocked_until"
MAX_CELLS = 2**28
NO_EFFECT = "none"
MAX_LISTED = 100
"""Maximum number of edges that a report lists for one closure."""


def with_areas(version: Version) -> Version:
    """A version with its closures' areas as further parts of the layer zones, one for each level."""
    if version.closures is None or any(map(_is_ours, version.parts)):
        return version
    entries = []
    for key, areas in _areas(version).items():
        rows = [closure.as_dict() for closure in areas]
        digest = hashlib.sha256(orjson.dumps(rows, option=orjson.OPT_SORT_KEYS)).hexdigest()
        zones = _zones(areas)
        bounds: Bounds = {"local": _box(zones, zones.local), "wgs84": _box(zones, ~zones.local)}
        steps = ({"step": "closures", "overlays": [closure.id for closure in areas]},)
        entries.append(PartEntry(key, digest, len(areas), bounds, Provenance("raw", "closures", steps=steps)))
    parts = tuple(sorted((*version.parts, *entries), key=lambda entry: entry.key))
    return replace(version, parts=parts) if entries else version


def _box(zones: Features, chosen: NDArray[np.bool_]) -> Box | None:
    if not chosen.any():
        return None
    west, south, east, north = shapely.total_bounds(zones.geometry[chosen]).tolist()
    return west, south, east, north


def load(store: Store, version: Version, keys: Collection[PartKey]) -> Layers:
    """Load parts of a version, with its closures' areas and without marks that no longer count."""
    closures = version.closures
    if closures is None:
        return store.load(version, keys)
    areas = {key: closed for key, closed in _areas(version).items() if key in keys}
    loaded = store.load(version, [key for key in keys if key not in areas])
    parts: dict[PartKey, Part] = {key: _lifted(key, part, closures) for key, part in loaded.parts.items()}
    parts |= {key: _zones(closed) for key, closed in areas.items()}
    return replace(loaded, parts=parts)


def ingredients(version: Version, known: Format, keys: Collection[PartKey]) -> dict[str, Any]:
    """What a map's bytes depend on besides its parts; empty if no closure can change them."""
    closures = version.closures
    if closures is None:
        return {}
    network = known.holds or "topology" in known.carries
    masked = known.holds or any(key.layer == "occupancy" and key.name == KEEPOUT for key in keys)
    out: dict[str, Any] = {}
    if closures.items and (network or masked):
        out["closures"] = closures.digest
    if network and closures.mode != "apply":
        out["closure_mode"] = closures.mode
    if closures.lifted_edges or closures.lifted_zones:
        out["lifted"] = [sorted(map(list, closures.lifted_edges)), sorted(closures.lifted_zones)]
    return out


@dataclass(slots=True)
class ClosureReport:
    """What became of closures in one map. lines: one for each, for the report. left_out: edges that were taken out.
    kept: blocked edges that stay in a map whose planners know no word for them.
    """

    lines: list[dict[str, Any]] = field(default_factory=list)
    left_out: int = 0
    kept: int = 0


def close(
    known: Format, layers: Layers, closures: Closures | None, drawn: Collection[PartKey]
) -> tuple[Layers, ClosureReport]:
    """Apply closures, and the network's own blocked edges, to the layers that a format is about to write.

    drawn: parts that a derivation made of zones on the way: they hold the areas already.
    """
    report = ClosureReport()
    mode: ClosureMode = "apply" if closures is None else closures.mode
    mark = mode == "mark" or known.marks_blocked
    items = () if closures is None else closures.items
    effects: dict[str, dict[str, Any]] = {closure.id: {} for closure in items}
    parts = dict(layers.parts)
    for key, part in layers.parts.items():
        if isinstance(part, Features) and key.layer == "topology":
            parts[key] = _close_edges(key, part, items, layers.frame, mark=mark, effects=effects, report=report)
        elif isinstance(part, OccupancyGrid) and key.name == KEEPOUT:
            areas = [c for c in items if c.polygon is not None and c.level == key.level]
            if key not in drawn and areas:
                parts[key] = _burn(part, areas, layers.frame)
            for area in areas:
                effects[area.id]["cells"] = True
        elif isinstance(part, Features) and key.layer == "zones" and key.name.startswith(PART_NAME):
            for zone in part.properties:
                effects[str(zone["overlay"]["id"])]["zone"] = True
    if mark and not known.marks_blocked:
        report.kept = sum(_is_blocked(p) for part in parts.values() if isinstance(part, Features)
                          for p in part.properties)  # fmt: skip
    report.lines = [_line(closure, effects[closure.id], mark=mark) for closure in items]
    return replace(layers, parts=parts), report


def merged_lines(reports: Iterable[Iterable[Mapping[str, Any]]]) -> list[dict[str, Any]]:
    """Join the lines of several maps' reports: one line for each closure, with all its effects and edges."""
    out: dict[str, dict[str, Any]] = {}
    for line in (line for report in reports for line in report):
        known = out.setdefault(line["id"], {**line})
        effects = dict.fromkeys([known["effect"], line["effect"]])
        known["effect"] = ", ".join(e for e in effects if e != NO_EFFECT) or NO_EFFECT
        known["edges"] = list(dict.fromkeys([*known["edges"], *line["edges"]]))[:MAX_LISTED]
        if known["effect"] != NO_EFFECT:
            known.pop("why", None)
    return list(out.values())


def _line(closure: Closure, effect: Mapping[str, Any], *, mark: bool) -> dict[str, Any]:
    """A report's line about one closure."""
    edges: Sequence[str] = effect.get("edges", ())
    did = [("marked" if mark else "left out") + f" {len(edges)} edges"] if edges else []
    did += ["zone"] if effect.get("zone") else []
    did += ["keepout cells"] if effect.get("cells") else []
    line: dict[str, Any] = {"id": closure.id, "level": closure.level, "expires": closure.expires}
    if closure.edge is not None:
        line["edge"] = closure.edge
    line |= {"effect": ", ".join(did) or NO_EFFECT, "edges": list(edges[:MAX_LISTED])}
    if not did:
        line["why"] = "this map has no such edge" if closure.edge is not None else "this map has nothing in that area"
    return line


# --- areas ---


def _areas(version: Version) -> dict[PartKey, list[Closure]]:
    """The closures that are areas and have a place in a version, by the part that they become."""
    assert version.closures is not None
    levels = {level.name for level in version.levels}
    taken = {entry.key for entry in version.parts if not _is_ours(entry)}
    out: dict[PartKey, list[Closure]] = {}
    for closure in version.closures.items:
        if closure.polygon is None or closure.level not in levels:
            continue
        if closure.crs == "wgs84" and version.datum is None:
            continue
        key = PartKey("zones", closure.level, PART_NAME)
        while key in taken:
            key = replace(key, name=key.name + "'")
        out.setdefault(key, []).append(closure)
    return out


def _is_ours(entry: PartEntry) -> bool:
    return entry.key.layer == "zones" and entry.provenance.format == "closures"


def _zones(areas: Sequence[Closure]) -> Features:
    """Closed areas as keepout zones."""
    anchors: tuple[Anchor, ...] = ("local", "wgs84")
    both = []
    for anchor in anchors:
        chosen = [closure for closure in areas if (closure.crs == "wgs84") == (anchor == "wgs84")]
        both.append(features([_zone(closure) for closure in chosen], anchor))
    return concatenate(both)


def _zone(closure: Closure) -> tuple[str, Any, dict[str, Any]]:
    about = {"id": closure.id} | ({"detail": closure.detail} if closure.detail else {})
    properties = {"kind": KEEPOUT, "expires": closure.expires, "overlay": about}
    return zone_id(closure.id), shapely.geometry.shape(closure.polygon), properties


def _in_metres(closure: Closure, frame: LocalFrame | None) -> Any:
    """A closed area in local metres. Raises MissingDatum."""
    shape = shapely.geometry.shape(closure.polygon)
    if closure.crs != "wgs84":
        return shape
    if frame is None:
        raise MissingDatum("a closed area in degrees has no place without a datum")
    one = np.empty(1, object)
    one[0] = shape
    return frame.geometries_to_local(one)[0]


# --- networks ---


def _lifted(key: PartKey, part: Part, closures: Closures) -> Part:
    """A part without the marks of overlays that releases before closures put into versions."""
    if not isinstance(part, Features):
        return part
    if key.layer == "zones" and closures.lifted_zones:
        return part.take(np.array([i not in closures.lifted_zones for i in part.ids], bool))
    if key.layer == "topology" and closures.lifted_edges:
        properties = tuple(
            {k: v for k, v in p.items() if k not in (BLOCKED, UNTIL)}
            if (i, str(p.get(UNTIL))) in closures.lifted_edges
            else p
            for i, p in zip(part.ids, part.properties, strict=True)
        )
        return replace(part, properties=properties)
    return part


def _is_blocked(properties: Mapping[str, Any]) -> bool:
    return properties.get("kind") == "edge" and properties.get(BLOCKED) is True


def _close_edges(
    key: PartKey,
    part: Features,
    items: Sequence[Closure],
    frame: LocalFrame | None,
    *,
    mark: bool,
    effects: Mapping[str, dict[str, Any]],
    report: ClosureReport,
) -> Features:
    """A network without its closed edges, or with a mark on them."""
    until: dict[int, str] = {}
    for closure, places in _closed(key, part, items, frame):
        for k in places:
            until[k] = max(until.get(k, ""), closure.expires)
        effects[closure.id].setdefault("edges", []).extend(part.ids[k] for k in places)
    if not mark:
        gone = np.array([_is_blocked(p) for p in part.properties], bool)
        gone[list(until)] = True
        report.left_out += int(gone.sum())
        return part.take(~gone) if gone.any() else part
    if not until:
        return part
    # Drawing formats write a drawn line and leave out what was made of it: a marked edge speaks for itself.
    loose = {part.properties[k].get("drawn_from") for k in until} - {None}
    properties = []
    for k, p in enumerate(part.properties):
        if p.get("drawn_from") in loose:
            p = {name: value for name, value in p.items() if name != "drawn_from"}  # noqa: PLW2901
        properties.append({**p, BLOCKED: True, UNTIL: until[k]} if k in until else p)
    return replace(part, properties=tuple(properties))


def _closed(
    key: PartKey, part: Features, items: Sequence[Closure], frame: LocalFrame | None
) -> Iterator[tuple[Closure, list[int]]]:
    """Closures of a network with the positions of the edges that each closes: by id, or by crossing its area."""
    areas = [c for c in items if c.polygon is not None and c.level == key.level]
    named = [c for c in items if c.edge is not None]
    if not areas and not named:
        return
    edges = np.array([p.get("kind") == "edge" for p in part.properties], bool)
    where = part.index() if named else {}
    for closure in named:
        k = where.get(closure.edge or "")
        if k is not None and edges[k]:
            yield closure, [k]
    if areas and edges.any():
        places, lines = _lines(part, np.flatnonzero(edges), frame)
        for closure in areas:
            try:
                area = _in_metres(closure, frame)
            except MissingDatum:
                continue
            hit = shapely.intersects(lines, area)
            if hit.any():
                yield closure, places[hit].tolist()


def _lines(
    part: Features, places: NDArray[np.intp], frame: LocalFrame | None
) -> tuple[NDArray[np.intp], NDArray[np.object_]]:
    """Edges in local metres, with their positions; without a frame those that are anchored so."""
    if frame is None:
        places = places[part.local[places]]
    return places, part.take(places).in_local(frame)


# --- grids ---


def _burn(grid: OccupancyGrid, areas: Sequence[Closure], frame: LocalFrame | None) -> OccupancyGrid:
    """A stored keepout mask with closed areas occupied; it grows by free cells where an area reaches beyond it."""
    from rasterio.features import rasterize
    from rasterio.transform import Affine

    x, y, yaw = grid.origin
    cosine, sine, size = float(np.cos(yaw)), float(np.sin(yaw)), grid.resolution
    to_cells = [cosine / size, sine / size, -sine / size, cosine / size]
    shift = [-(x * cosine + y * sine) / size, (x * sine - y * cosine) / size]
    shapes = [shapely.affinity.affine_transform(_in_metres(area, frame), [*to_cells, *shift]) for area in areas]
    left, bottom, right, top = shapely.total_bounds(np.array(shapes, object))
    before = (max(0, -int(np.floor(bottom))), max(0, -int(np.floor(left))))
    after = (max(0, int(np.ceil(top)) - grid.height), max(0, int(np.ceil(right)) - grid.width))
    if (grid.height + before[0] + after[0]) * (grid.width + before[1] + after[1]) > MAX_CELLS:
        before = after = (0, 0)
    cells = np.pad(grid.cells, ((before[0], after[0]), (before[1], after[1])), constant_values=FREE)
    here = Affine.translation(-before[1], -before[0])
    rasterize([(shape, OCCUPIED) for shape in shapes], out=cells, transform=here, all_touched=True)
    dx, dy = -before[1] * size, -before[0] * size
    origin = (round(x + dx * cosine - dy * sine, 9), round(y + dx * sine + dy * cosine, 9), yaw)
    return replace(grid, cells=cells, origin=origin)

"""Turn edits (put, delete, cells) into a change set, checked against the version they build on.

A feature may be put back as ``GET …/layers/{layer}`` returns it: its unedited members stay exactly as stored, even if
the response rounded or converted them. An edited feature keeps its anchor, whatever the ``crs`` of its new geometry.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import chain
from typing import Any

import numpy as np
import shapely
import shapely.geometry

from app import formats
from app.errors import Invalid, MissingDatum, NotFound, Problem
from app.ingest.edited_part import EditedPart
from app.ingest.prepare import datum_moved_warnings
from app.model.features import NO_GEOMETRY, Features, Properties
from app.model.frame import GROUND, MAX_METRES, Datum, Level
from app.model.geodesy import LocalFrame, local_frame
from app.model.grid import OCCUPIED, SLICE, UNKNOWN, OccupancyGrid, without_unknown_grey
from app.model.layers import NETWORK, SITE, VECTOR_LAYERS, ZONES, Layer, PartKey, join_levels
from app.model.names import did_you_mean
from app.store.changes import KEEP, Changes, Delete, Provenance, Put, Replace
from app.store.store import Store
from app.store.values import Version

EDITED = Provenance("raw", "edit")

SAME_METRES, SAME_DEGREES = 2e-9, 2e-12
"""Twice the rounding of coordinates in responses: a smaller difference is no edit."""

MAX_DEPTH = 128
"""Maximum nesting depth of an edit's lists and objects: that of GeoJSON files, so that it can be written again."""

_SHAPES: Mapping[str, frozenset[str]] = {
    "node": frozenset({"Point"}),
    "edge": frozenset({"LineString"}),
    "location": frozenset({"Polygon", "MultiPolygon"}),
    "zones": frozenset({"Polygon", "MultiPolygon"}),
}
"""Allowed geometry types by kind of feature; objects may have any."""

_DEFAULT_NAME: Mapping[str, str] = {"topology": NETWORK, "location": SITE, "zones": ZONES, "objects": "edit"}


def edit_changes(
    store: Store, base: Version, changes: Sequence[Mapping[str, Any]]
) -> tuple[Changes, tuple[Problem, ...]]:
    """Combine all edits into one change set. Raises Invalid with the location of every invalid edit."""
    if not changes:
        raise Invalid("the request contains no edit: give at least one put, delete or cells in 'changes'")
    session = _Session(store, base, _named_ids(changes))
    problems: list[Problem] = []
    for k, change in enumerate(changes):
        try:
            session.apply(change)
        except (Invalid, NotFound, MissingDatum) as error:
            problems.append(Problem(error.detail, where=f"changes[{k}]"))
    problems += session.dangling()
    if problems:
        raise Invalid("; ".join(p.problem for p in problems), problems)
    session.loosen()
    change_set = session.changes()
    return change_set, tuple(datum_moved_warnings(base, change_set.datum)) if isinstance(
        change_set.datum, Datum
    ) else ()


def _named_ids(changes: Sequence[Mapping[str, Any]]) -> set[str]:
    """Return the ids of features that edits put and delete, and of the ends of edges."""
    out: set[Any] = set()
    for change in changes:
        feature = change.get("feature")
        feature = feature if isinstance(feature, Mapping) else {}
        properties = feature.get("properties")
        properties = properties if isinstance(properties, Mapping) else {}
        for value in (change.get("id"), feature.get("id"), properties.get("source"), properties.get("target")):
            if isinstance(value, str):
                out.add(value)
    return out


class _Session:
    def __init__(self, store: Store, base: Version, named: Collection[str]) -> None:
        self._store, self._base, self._named = store, base, named
        self._frame: LocalFrame | None = None if base.datum is None else local_frame(base.datum)
        self._drafts: dict[PartKey, EditedPart] = {}
        self._known_networks: list[EditedPart] | None = None
        self._grids: dict[PartKey, OccupancyGrid] = {}
        self._keys = {e.key for e in base.parts}
        self._datum = base.datum
        self._known_ids = {level.name for level in base.levels}

    def apply(self, change: Mapping[str, Any]) -> None:
        """Apply one edit: op put, delete or cells."""
        operation = change.get("op")
        members_by_operation = {
            "put": {"op", "layer", "level", "name", "feature", "crs"},
            "delete": {"op", "layer", "level", "name", "id"},
            "cells": {"op", "grid", "level", "polygon", "crs", "value"},
        }
        if operation not in members_by_operation:
            raise Invalid(f"op must be put, delete or cells, got {operation!r:.80}")
        extra = set(change) - members_by_operation[operation]
        if extra:
            raise Invalid(f"unknown member {sorted(extra)[0]!r:.80} of {operation}")
        {"put": self._apply_put, "delete": self._apply_delete, "cells": self._apply_cells}[operation](change)

    def dangling(self) -> list[Problem]:
        """List the edges that these edits leave without a node at one end.

        A lift's edge may end in another level's network. Edges that dangled before are not listed: the upload that
        brought them warned about them.
        """
        out: list[Problem] = []
        if not any(key.layer == "topology" for key in self._drafts):
            return out
        networks = self._networks()
        gone = {
            i
            for draft in networks
            for i in draft.deletes | _put_edges(draft)
            if self._network_of(draft, i, stored=True) is not None
        }
        for draft in networks:
            cut = {i for node in gone for i in draft.connected_edges(node) if draft.has_item(i)}
            edges = _put_edges(draft) | cut
            ends = (draft.row(i)[1].get(end) for i in edges for end in ("source", "target"))
            draft.read(end for end in ends if isinstance(end, str))
            for item in sorted(edges):
                properties = draft.row(item)[1]
                if properties.get("kind") != "edge":
                    continue
                for end in ("source", "target"):
                    node = properties.get(end)
                    if self._network_of(draft, node) is None and not self._was_dangling(draft, item, end, node):
                        problem = f"{end} {node!r} of edge {item} is not a node: put the node or delete the edge"
                        out.append(Problem(problem, where=item))
        return out

    def _networks(self) -> list[EditedPart]:
        """Return the networks of all levels, in the order of their keys."""
        if self._known_networks is None:
            keys = sorted(key for key in {*self._keys, *self._drafts} if key.layer == "topology")
            self._known_networks = [self._draft(key) for key in keys]
        return self._known_networks

    def _network_of(self, draft: EditedPart, item: Any, *, stored: bool = False) -> EditedPart | None:
        """Return the network with the node that an edge of ``draft`` names; None if it is not a node.

        It is the edge's own if that has the id, else that of another level. stored: as it was before these edits.
        """
        if not isinstance(item, str):
            return None
        for network in chain((draft,), self._networks()):
            if network.is_stored(item) if stored else network.has_item(item):
                row = network.before(item) if stored else network.row(item)
                if row[1].get("kind") == "node":
                    return network
                if network is draft:
                    return None
        return None

    def _was_dangling(self, draft: EditedPart, item: str, end: str, node: Any) -> bool:
        """Return whether the stored edge had this dangling end before these edits."""
        return (
            draft.is_stored(item)
            and draft.before(item)[1].get(end) == node
            and self._network_of(draft, node, stored=True) is None
        )

    def loosen(self) -> None:
        """Unlink network features from the drawn line they were read from if either was edited.

        Drawing formats write the line and omit features read from it, which is right only while both agree.
        """
        families = {f.family for f in formats.all_formats().values() if f.traits.is_drawing}
        touched: dict[str, set[str]] = defaultdict(set)
        for key, draft in list(self._drafts.items()):
            if key.layer == "objects" and key.name in families:
                touched[key.level] |= draft.edited_ids()
            elif key.layer == "topology":
                sources = {draft.before(i)[1].get("drawn_from") for i in draft.edited_ids()}
                touched[key.level] |= {s for s in sources if isinstance(s, str)}
        for key in sorted(self._keys):
            if key.layer != "topology" or not touched[key.level]:
                continue
            draft = self._draft(key)
            for item in draft.drawn_from(touched[key.level]):
                geometry, properties, local = draft.row(item)
                remaining = {name: value for name, value in properties.items() if name != "drawn_from"}
                draft.puts[item] = (geometry, remaining, local)

    def changes(self) -> Changes:
        """Build the change set for the store."""
        operations: list[Put | Delete | Replace] = []
        for key, draft in sorted(self._drafts.items()):
            if draft.deletes:
                operations.append(Delete(key, tuple(sorted(draft.deletes))))
            if draft.puts:
                ids = tuple(draft.puts)
                geometry = np.empty(len(ids), object)
                geometry[:] = [draft.puts[i][0] for i in ids]
                properties = tuple(draft.puts[i][1] for i in ids)
                local = np.array([draft.puts[i][2] for i in ids], bool)
                operations.append(Put(key, Features(ids, geometry, properties, local), self._provenance(key)))
        for key, grid in sorted(self._grids.items()):
            operations.append(Replace(key, grid, self._provenance(key)))
        levels = join_levels(
            self._base.levels, [Level(o.key.level) for o in operations if o.key.level not in self._known_ids]
        )
        return Changes(
            tuple(operations),
            KEEP if self._datum == self._base.datum else self._datum,
            KEEP if levels == self._base.levels else levels,
        )

    def _provenance(self, key: PartKey) -> Provenance:
        """Return the provenance of an edited part: it keeps its kind (raw, derived …) and is not derived again."""
        return next((e.provenance for e in self._base.parts if e.key == key), EDITED).with_edit_step()

    def _draft(self, key: PartKey) -> EditedPart:
        if key not in self._drafts:
            self._drafts[key] = EditedPart(self._store.content, self._base, key, self._named)
            if key.layer == "topology":
                self._known_networks = None
        return self._drafts[key]

    def _layer(self, change: Mapping[str, Any]) -> Layer:
        layer_name = change.get("layer")
        for layer in VECTOR_LAYERS:
            if layer == layer_name:
                return layer
        raise Invalid(f"layer must be one of {', '.join(sorted(VECTOR_LAYERS))}, got {layer_name!r:.80}")

    def _apply_put(self, change: Mapping[str, Any]) -> None:
        layer, feature = self._layer(change), change.get("feature")
        if not isinstance(feature, Mapping) or feature.get("type") != "Feature":
            raise Invalid("put needs 'feature', a GeoJSON Feature")
        item = feature.get("id")
        if not isinstance(item, str) or not item:
            raise Invalid("the feature's 'id' must be a string")
        properties = feature.get("properties") or {}
        if not isinstance(properties, Mapping):
            raise Invalid("the feature's 'properties' must be an object")
        # Accept what GET returns, so that a client can put a feature back.
        shown = {"level": feature.get("level"), "name": feature.get("part")}
        change = {**{k: v for k, v in shown.items() if isinstance(v, str) and v}, **change}
        if layer == "location":
            properties = self._take_datum(properties)
            if properties.get("kind") == "datum":
                return
        key = self._find_part(layer, item, change)
        draft = self._draft(key)
        geometry, local = self._geometry(feature, change)
        kind: str = layer
        if layer == "topology":
            properties = _network_item(item, properties)
            kind = str(properties["kind"])
            if geometry is None and kind == "edge":
                geometry, local = self._straight(draft, properties)
        before = draft.row(item) if draft.has_item(item) else None
        if geometry is None:
            geometry = NO_GEOMETRY
        elif before is not None:
            geometry, local = self._as_before(before, geometry, local)
        if before is None or geometry is not before[0]:
            _check_shape(kind, item, geometry)
        draft.deletes.discard(item)
        draft.dragged.discard(item)
        draft.puts[item] = (geometry, dict(properties), local)
        if layer == "topology" and properties["kind"] == "node" and before is not None:
            self._drag_edges(draft, item, before, (geometry, local))

    def _take_datum(self, properties: Mapping[str, Any]) -> Mapping[str, Any]:
        """Remove ``datum`` from a location's properties: the environment stores it."""
        datum_values = properties.get("datum")
        if datum_values is not None:
            names = ("latitude", "longitude", "altitude", "heading")
            if not isinstance(datum_values, Mapping) or not {"latitude", "longitude"} <= set(datum_values) <= set(
                names
            ):
                raise Invalid('properties.datum must be {"latitude": …, "longitude": …, "altitude"?, "heading"?}')
            self._datum = Datum(**datum_values)
        return {name: value for name, value in properties.items() if name != "datum"}

    def _as_before(self, before: tuple[Any, Properties, bool], geometry: Any, local: bool) -> tuple[Any, bool]:
        """Convert a feature's new geometry to its anchor; an unmoved feature keeps the stored geometry."""
        stored, _, anchored = before
        if stored.is_empty:
            return geometry, local
        if anchored == local:
            shown = stored
        elif self._frame is None:
            return geometry, local
        else:  # a stored place that is too far away for local metres becomes empty: the feature is moved back
            convert = self._frame.geometries_to_wgs84 if anchored else self._frame.near_geometries_to_local
            shown = convert(np.array([stored], object))[0]
        if not shown.is_empty and _is_nearly_equal(shown, geometry, SAME_METRES if local else SAME_DEGREES):
            return stored, anchored
        return (geometry if anchored == local else self._other(geometry, local)), anchored

    def _straight(self, draft: EditedPart, properties: Mapping[str, Any]) -> tuple[Any, bool]:
        """Build the straight geometry of an edge that has none, from node to node."""
        ends = []
        for end in ("source", "target"):
            if not draft.has_item(properties[end]):
                return NO_GEOMETRY, True  # reported as dangling after all edits
            ends.append(draft.row(properties[end]))
            if ends[-1][0].geom_type != "Point" or ends[-1][0].is_empty:
                raise Invalid(f"node {properties[end]!r} has no position: give the edge a LineString geometry")
        local = ends[0][2]
        places = [g if anchor == local else self._other(g, anchor) for g, _, anchor in ends]
        return shapely.LineString([shapely.get_coordinates(p, include_z=p.has_z)[0][:2] for p in places]), local

    def _other(self, geometry: Any, local: bool) -> Any:
        if self._frame is None:
            raise MissingDatum("the environment has no datum: set one to combine local and WGS 84 coordinates")
        one = np.array([geometry], object)
        return (self._frame.geometries_to_wgs84(one) if local else self._frame.geometries_to_local(one))[0]

    def _drag_edges(
        self, draft: EditedPart, node: str, before: tuple[Any, Properties, bool], now: tuple[Any, bool]
    ) -> None:
        """Move the ends of connected edges with a moved node, unless these edits put the edge itself."""
        if before[0].equals_exact(now[0], 0.0):
            return
        edges = [(network, item) for network in self._networks() for item in network.connected_edges(node)]
        for network, item in edges:
            if item in network.deletes or (item in network.puts and item not in network.dragged):
                continue
            line, properties, local = network.row(item)  # its other end may have been dragged before
            if line.geom_type != "LineString" or self._network_of(network, node) is not draft:
                continue
            place = now[0] if now[1] == local else self._other(now[0], now[1])
            network.dragged.add(item)
            vertices = shapely.get_coordinates(line, include_z=line.has_z)
            target = shapely.get_coordinates(place, include_z=bool(line.has_z))[0]
            target = np.nan_to_num(target, nan=0.0)
            if properties.get("source") == node:
                vertices[0] = target
            if properties.get("target") == node:
                vertices[-1] = target
            network.puts[item] = (shapely.LineString(vertices), properties, local)

    def _apply_delete(self, change: Mapping[str, Any]) -> None:
        layer, item = self._layer(change), change.get("id")
        if not isinstance(item, str) or not item:
            raise Invalid("delete needs 'id', a feature id")
        key = self._find_part(layer, item, change)
        draft = self._draft(key)
        if not draft.has_item(item):
            raise NotFound(f"feature {item!r:.80} not found in {layer}")
        draft.puts.pop(item, None)
        if draft.is_stored(item):
            draft.deletes.add(item)

    def _find_part(self, layer: Layer, item: str, change: Mapping[str, Any]) -> PartKey:
        """Return the part to edit: the named one, else the one with this id, else the default part."""
        level, name = change.get("level"), change.get("name")
        fitting = sorted(
            k
            for k in {*self._keys, *self._drafts}
            if k.layer == layer and level in (None, k.level) and name in (None, k.name)
        )
        holding = [k for k in fitting if self._draft(k).has_item(item)]
        if len(holding) > 1:
            choices = ", ".join(f"level {k.level} name {k.name}" for k in holding)
            raise Invalid(f"several parts of {layer} contain {item!r:.80}: give 'level' and 'name', one of: {choices}")
        if holding:
            return holding[0]
        usual = PartKey(layer, level or GROUND, name or _DEFAULT_NAME[layer])
        same = [k for k in fitting if k.level == usual.level]
        return same[0] if layer == "topology" and len(same) == 1 else usual

    def _geometry(self, feature: Mapping[str, Any], change: Mapping[str, Any]) -> tuple[Any, bool]:
        """Return a feature's geometry and whether it is local: ``place`` is local (JSON-FG), else ``crs`` decides."""
        place = feature.get("place")
        local = place is not None or self._is_local(change)
        shape = place if place is not None else feature.get("geometry")
        if shape is None:
            return None, local
        return parse_geometry(shape), local

    def _is_local(self, change: Mapping[str, Any]) -> bool:
        crs = change.get("crs") or ("wgs84" if self._base.datum is not None else "local")
        if crs not in ("local", "wgs84"):
            raise Invalid(f"crs must be local or wgs84, got {crs!r:.80}")
        return bool(crs == "local")

    def _apply_cells(self, change: Mapping[str, Any]) -> None:
        key = self._grid_key(change)
        if key not in self._grids:
            stored = self._store.content.load(self._base, [key]).parts[key]
            assert isinstance(stored, OccupancyGrid)
            self._grids[key] = stored
        grid, value = self._grids[key], change.get("value")
        if isinstance(value, bool) or not isinstance(value, int) or not (0 <= value <= OCCUPIED or value == UNKNOWN):
            raise Invalid(f"value must be 0 to 100, or 255 for unknown, got {value!r:.80}")
        polygon = parse_geometry(change.get("polygon"))
        if polygon.geom_type not in ("Polygon", "MultiPolygon") or not polygon.is_valid:
            reason = shapely.is_valid_reason(polygon)
            raise Invalid(f"polygon must be a valid GeoJSON Polygon or MultiPolygon, got {polygon.geom_type}: {reason}")
        local = self._is_local(change)
        bound = np.array([MAX_METRES, MAX_METRES] if local else [180.0, 90.0])
        if polygon.is_empty or (np.abs(shapely.get_coordinates(polygon)) > bound).any():
            unit = f"±{MAX_METRES:g} metres" if local else "longitude ±180, latitude ±90 degrees"
            raise Invalid(f"the polygon must not be empty, and all its corners must be within {unit}")
        if not local:
            polygon = self._other(polygon, False)
        mask = cells_within(grid, polygon)
        if not mask.any():
            raise Invalid(f"the polygon covers no cell centre of grid {key.name}")
        cells = grid.cells.copy()
        cells[mask] = value
        # An edited grid has more information than the objects that it was derived from.
        grid = without_unknown_grey(grid, mask)
        properties = {word: value for word, value in grid.properties.items() if word != SLICE}
        self._grids[key] = replace(grid, cells=cells, properties=properties)

    def _grid_key(self, change: Mapping[str, Any]) -> PartKey:
        name, level = change.get("grid"), change.get("level")
        fitting = sorted(
            k for k in self._keys if k.layer == "occupancy" and level in (None, k.level) and name in (None, k.name)
        )
        by_name = defaultdict(list)
        for key in fitting:
            by_name[key.name].append(key)
        if not fitting:
            grid_names = sorted(k.name for k in self._keys if k.layer == "occupancy")
            near = did_you_mean(name or "", grid_names)
            raise NotFound(f"unknown grid {name!r:.80}{near}; available: {', '.join(grid_names) or 'none'}")
        if len(fitting) == 1:
            return fitting[0]
        if name is None and len(by_name["map"]) == 1:
            return by_name["map"][0]
        raise Invalid(f"several grids match ({', '.join(k.name for k in fitting)}): name one with 'grid' (and 'level')")


def _put_edges(draft: EditedPart) -> set[str]:
    return {i for i, (_, properties, _) in draft.puts.items() if properties.get("kind") == "edge"}


def cells_within(grid: OccupancyGrid, polygon: Any) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Mark the cells whose centre is inside a polygon of the local frame: bool [height, width], row 0 at the bottom."""
    x, y, yaw = grid.origin
    c, s = np.cos(yaw), np.sin(yaw)

    def to_cells(points: np.ndarray[Any, np.dtype[np.float64]]) -> np.ndarray[Any, np.dtype[np.float64]]:
        dx, dy = points[:, 0] - x, points[:, 1] - y
        return np.column_stack([(dx * c + dy * s), (dy * c - dx * s)]) / grid.resolution

    shape = shapely.transform(polygon, to_cells)
    left, bottom, right, top = shape.bounds
    columns = np.arange(max(0, int(np.floor(left))), min(grid.width, int(np.ceil(right)) + 1))
    rows = np.arange(max(0, int(np.floor(bottom))), min(grid.height, int(np.ceil(top)) + 1))
    mask = np.zeros(grid.cells.shape, bool)
    if not len(columns) or not len(rows):
        return mask
    shapely.prepare(shape)
    for start in range(0, len(rows), 512):  # in blocks, to bound the memory of a large polygon
        block = rows[start : start + 512]
        u, v = np.meshgrid(columns + 0.5, block + 0.5)
        inside = shapely.contains_xy(shape, u, v)
        mask[block[0] : block[-1] + 1, columns[0] : columns[-1] + 1] = inside
    return mask


def parse_geometry(geometry: Any) -> Any:
    """Parse a GeoJSON geometry. Raises Invalid if it is none."""
    if not isinstance(geometry, Mapping):
        raise Invalid(f"a geometry must be a GeoJSON object, got {type(geometry).__name__}")
    try:
        return shapely.geometry.shape(geometry)
    except Exception as error:
        raise Invalid(f"invalid GeoJSON geometry: {error}") from error


def _is_nearly_equal(a: Any, b: Any, tolerance: float) -> bool:
    """Compare two geometries: same structure, coordinates within the tolerance, heights within 2 nm."""
    if a.geom_type != b.geom_type or a.has_z != b.has_z or not a.equals_exact(b, 0.0 if a.is_empty else tolerance):
        return False
    if not a.has_z:
        return True
    ours, theirs = (shapely.get_coordinates(g, include_z=True)[:, 2] for g in (a, b))
    return bool(np.allclose(ours, theirs, rtol=0.0, atol=SAME_METRES, equal_nan=True))


def _check_shape(kind: str, item: str, geometry: Any) -> None:
    """Check that a node is a point, an edge a line, a fence or zone a polygon. Raises Invalid."""
    allowed = _SHAPES.get(kind)
    if allowed is None or (geometry.geom_type in allowed and not geometry.is_empty):
        return
    name = {"location": "fence", "zones": "zone"}.get(kind, kind)
    got = "none" if geometry is NO_GEOMETRY else geometry.geom_type
    raise Invalid(f"{name} {item!r} must have a geometry of type {' or '.join(sorted(allowed))}, got {got}")


def _network_item(item: str, properties: Mapping[str, Any]) -> Mapping[str, Any]:
    kind = properties.get("kind") or ("edge" if "source" in properties else "node")
    if kind not in ("node", "edge"):
        raise Invalid(f"kind of a topology feature must be node or edge, got {kind!r:.80}")
    if kind == "edge" and not all(isinstance(properties.get(e), str) for e in ("source", "target")):
        raise Invalid(f"edge {item} needs 'source' and 'target', the ids of its nodes")
    return {**properties, "kind": kind}


def check_depth(changes: Sequence[Mapping[str, Any]]) -> None:
    """Raise Invalid for edits that are nested too deeply to be stored."""
    if _exceeds_depth(MAX_DEPTH, changes):
        reason = f"nested deeper than {MAX_DEPTH} lists and objects"
        raise Invalid(f"the changes are {reason}", [Problem(reason, where="changes")])


def _exceeds_depth(limit: int, value: Any) -> bool:
    """Return whether lists and mappings are nested deeper than ``limit``."""
    front = [value]
    for _ in range(limit):
        front = [
            inner
            for one in front
            if isinstance(one, list | tuple | Mapping)
            for inner in (one.values() if isinstance(one, Mapping) else one)
        ]
        if not front:
            return False
    return True

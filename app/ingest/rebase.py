"""Three-way merge of a draft with a newer head, feature by feature and cell by cell.

A property, a shape, a cell that only one of them changed is taken from there; what both changed differently is a
conflict. Ends of edges are compared on their own, since they follow nodes.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import shapely

from app.model.features import Features, Properties
from app.model.frame import Datum
from app.model.geodesy import local_frame
from app.model.grid import FREE, SLICE, UNKNOWN_GREY, OccupancyGrid, pack_cells, unknown_grey
from app.model.layers import PartKey, join_levels
from app.store.changes import KEEP, Changes, Delete, Operation, Prepared, Put, Replace
from app.store.encode import pack
from app.store.in_worker import open_store
from app.store.store import Store
from app.store.values import FeatureDelta, GridDelta, Version

Side = Literal["draft", "head"]

DELETED: Final = "deleted"
"""Name of the field in a conflict of a feature that one side deleted and the other changed."""

_ABSENT: Final = object()

_GREY: Final = np.uint8(254)
"""Value of a free cell with the grey of unknown ones, while cells are merged; no cell of a grid has it."""

_STRIP_ROWS: Final = 512


@dataclass(frozen=True, slots=True)
class MergeConflict:
    """What a draft and the head changed differently. id: of a feature; None for a grid or the datum."""

    layer: str
    level: str
    part: str
    id: str | None
    fields: tuple[str, ...]
    reason: str

    def as_dict(self) -> dict[str, Any]:
        """Return the conflict as JSON."""
        return {
            "layer": self.layer,
            "level": self.level,
            "part": self.part,
            "id": self.id,
            "fields": list(self.fields),
            "reason": self.reason,
        }


class _Row(NamedTuple):
    geometry: Any
    properties: Properties
    local: bool

    @property
    def is_edge(self) -> bool:
        return self.properties.get("kind") == "edge"


@dataclass(slots=True)
class _Side:
    """What one side did to a part since the base."""

    put: Mapping[str, _Row] = field(default_factory=dict)
    deleted: frozenset[str] = frozenset()

    def has_touched(self, item: str) -> bool:
        return item in self.put or item in self.deleted


def prepare_rebase(
    database_url: str, blob_dir: str, base: Version, draft: Version, head: Version, prefer: Side | None
) -> tuple[Prepared | None, tuple[MergeConflict, ...]]:
    """Prepare a draft's changes on top of the head (in a worker); None if there are conflicts."""
    store = open_store(database_url, blob_dir)
    changes, conflicts = merge(store, base, draft, head, prefer)
    return (None if conflicts else store.versions.prepare(head, changes)), conflicts


def merge(
    store: Store, base: Version, draft: Version, head: Version, prefer: Side | None = None
) -> tuple[Changes, tuple[MergeConflict, ...]]:
    """Combine a draft's changes since ``base`` with those of the head.

    prefer: the side that wins where both changed the same; without it each such place is a conflict.
    """
    work = _Merge(store, base, draft, head, prefer)
    datum = work.datum()
    ours, theirs = store.content.delta_parts(base, draft), store.content.delta_parts(base, head)
    merged: dict[PartKey, _PartMerge] = {}
    their_features = {delta.key: delta for delta in theirs.features}
    our_features = {delta.key: delta for delta in ours.features}
    keys = set(our_features)
    if any(key.layer == "topology" for key in keys):  # edges of a lift end at nodes of another level
        keys |= {key for key in their_features if key.layer == "topology"}
    for key in sorted(keys):
        part = _PartMerge(work, key, _side(our_features.get(key)), _side(their_features.get(key)))
        part.merge_items()
        merged[key] = part
    networks = [part for part in merged.values() if part.key.layer == "topology"]
    for part in networks:
        part.tie_ends(networks, datum)
    for part in networks:
        part.check_ends(networks)
    their_grids = {delta.key: delta for delta in theirs.grids}
    replaced = [work.merge_grid(delta, their_grids.get(delta.key)) for delta in ours.grids]
    operations: list[Operation] = [operation for part in merged.values() for operation in part.operations()]
    operations += [operation for operation in replaced if operation is not None]
    levels = join_levels(head.levels, [level for level in draft.levels if level not in base.levels])
    changes = Changes(
        tuple(operations),
        KEEP if datum == head.datum else datum,
        KEEP if levels == head.levels else levels,
    )
    return changes, tuple(work.conflicts)


@dataclass(slots=True)
class _Merge:
    """What the merges of all parts share."""

    store: Store
    base: Version
    draft: Version
    head: Version
    prefer: Side | None
    conflicts: list[MergeConflict] = field(default_factory=list)

    def takes_draft(self, key: PartKey, item: str | None, fields: Sequence[str], reason: str) -> bool:
        """Decide a conflict by the preferred side; without one, note the conflict."""
        if self.prefer is None:
            self.refuse(key, item, fields, reason)
        return self.prefer == "draft"

    def refuse(self, key: PartKey, item: str | None, fields: Sequence[str], reason: str) -> None:
        """Note a conflict that somebody must solve by an edit."""
        self.conflicts.append(MergeConflict(key.layer, key.level, key.name, item, tuple(sorted(fields)), reason))

    def datum(self) -> Datum | None:
        """Return the merged datum."""
        ours, theirs = self.draft.datum, self.head.datum
        if ours in (self.base.datum, theirs):
            return theirs
        if theirs == self.base.datum:
            return ours
        place = PartKey("location", "ground", "site")
        reason = f"the draft and version {self.head.number} set different datums"
        return ours if self.takes_draft(place, None, ["datum"], reason) else theirs

    def has_unchanged_node(self, item: str, changed: Collection[PartKey]) -> bool:
        """Return whether a network of the head, beside the changed ones, has a node with this id."""
        keys = [e.key for e in self.head.parts if e.key.layer == "topology" and e.key not in changed]
        rows = [_rows(self.store.content.features(self.head, key, ids=[item])).get(item) for key in keys]
        return any(row is not None and not row.is_edge for row in rows)

    def merge_grid(self, ours: GridDelta, theirs: GridDelta | None) -> Replace | None:
        """Merge the cells of a grid; None to keep those of the head."""
        key = ours.key
        if theirs is None:
            return self._with(key, self._grid(self.draft, key))
        is_stored = all(version.part(key) is not None for version in (self.base, self.draft, self.head))
        grids = [self._grid(version, key) for version in (self.base, self.draft, self.head)] if is_stored else []
        if not grids or any(_frame_of(grid) != _frame_of(grids[0]) for grid in grids):
            reason = f"the draft and version {self.head.number} changed the grid, one of them as a whole"
            return (
                self._with(key, self._grid(self.draft, key)) if self.takes_draft(key, None, ["grid"], reason) else None
            )
        merged, contested = _merged_cells(*grids, takes_ours=self.prefer != "head")
        if contested and self.prefer is None:
            reason = f"the draft and version {self.head.number} changed {contested} cells differently"
            self.refuse(key, None, ["cells"], reason)
        return self._with(key, merged)

    def _grid(self, version: Version, key: PartKey) -> OccupancyGrid:
        part = self.store.content.load(version, [key]).parts[key]
        assert isinstance(part, OccupancyGrid)
        return part

    def _with(self, key: PartKey, grid: OccupancyGrid) -> Replace:
        entry = self.head.part(key) or self.draft.part(key)
        assert entry is not None
        return Replace(key, grid, entry.provenance.with_edit_step())


class _PartMerge:
    """Merge of one vector part: features to put and to delete on top of the head."""

    def __init__(self, work: _Merge, key: PartKey, ours: _Side, theirs: _Side) -> None:
        self._work, self.key, self._ours, self._theirs = work, key, ours, theirs
        changed_by_both = [i for i in (*ours.put, *ours.deleted) if theirs.has_touched(i)]
        self._base = self._read(work.base, changed_by_both if key.layer != "topology" else None)
        self._head = self._read(work.head, None) if key.layer == "topology" else dict(theirs.put)
        self.put: dict[str, _Row] = {}
        self.deleted: set[str] = set()

    def merge_items(self) -> None:
        """Decide each feature that the draft changed."""
        for item, ours in self._ours.put.items():
            if not self._theirs.has_touched(item):
                self.put[item] = ours
            elif item in self._theirs.deleted:
                reason = f"the draft changed it, version {self._work.head.number} deleted it"
                if self._work.takes_draft(self.key, item, [DELETED], reason):
                    self.put[item] = ours
            else:
                self._merge_item(item, self._base.get(item), ours, self._theirs.put[item])
        for item in self._ours.deleted:
            if item in self._theirs.put:
                reason = f"the draft deleted it, version {self._work.head.number} changed it"
                if self._work.takes_draft(self.key, item, [DELETED], reason):
                    self.deleted.add(item)
            elif item not in self._theirs.deleted:
                self.deleted.add(item)

    def _merge_item(self, item: str, was: _Row | None, ours: _Row, theirs: _Row) -> None:
        takes_ours = self._work.prefer == "draft"
        fields: list[str] = []
        properties: dict[str, Any] = {}
        old = {} if was is None else was.properties
        for name in (*theirs.properties, *(n for n in ours.properties if n not in theirs.properties)):
            values = tuple(row.get(name, _ABSENT) for row in (old, ours.properties, theirs.properties))
            value, is_contested = _merged_value(*values, takes_ours=takes_ours)
            if value is not _ABSENT:
                properties[name] = value
            if is_contested:
                fields.append(name)
        shape, is_contested = _merged_shape(was, ours, theirs, takes_ours=takes_ours)
        if is_contested:
            fields.append("geometry")
        if fields and self._work.prefer is None:
            reason = f"the draft and version {self._work.head.number} changed {', '.join(sorted(fields))} differently"
            self._work.refuse(self.key, item, fields, reason)
        self.put[item] = _Row(shape[0], properties, shape[1])

    def tie_ends(self, networks: Sequence[_PartMerge], datum: Datum | None) -> None:
        """Move ends of one side's edges to the nodes that the other side moved."""
        ours = {network.key: network.moved_nodes(network._ours) for network in networks}
        theirs = {network.key: network.moved_nodes(network._theirs) for network in networks}
        candidates = [(i, row, theirs) for i, row in self._ours.put.items() if row.is_edge and i in self.put]
        candidates += [(i, row, ours) for i, row in self._theirs.put.items() if row.is_edge and i not in self.deleted]
        for item, _, moved in candidates:
            row = self.row(item)
            if row is None or row.geometry.geom_type != "LineString" or row.geometry.is_empty:
                continue
            vertices = shapely.get_coordinates(row.geometry, include_z=row.geometry.has_z)
            tied = vertices.copy()
            for end, k in (("source", 0), ("target", -1)):
                name = str(row.properties.get(end))
                network = self._network_of(name, networks)
                node = None if network is None or name not in moved[network.key] else network.row(name)
                if node is not None:
                    place = shapely.get_coordinates(_in_anchor(node, row.local, datum))[0]
                    tied[k, :2] = place
            if not np.array_equal(vertices, tied, equal_nan=True):
                self.put[item] = row._replace(geometry=shapely.LineString(tied))

    def check_ends(self, networks: Sequence[_PartMerge]) -> None:
        """Note edges that would lose a node which the other side deleted, or made an edge, on any level."""
        ours = {node for network in networks for node in network.lost_nodes(network._ours)}
        theirs = {node for network in networks for node in network.lost_nodes(network._theirs)}
        for item, row in self.put.items():
            for end in ("source", "target") if row.is_edge else ():
                node = row.properties.get(end)
                if node in theirs and not self._has_node(node, networks):
                    reason = (
                        f"version {self._work.head.number} deleted its {end} {node!r}: delete the edge from the draft, "
                        "or put the node into it"
                    )
                    self._work.refuse(self.key, item, [end], reason)
        for item, row in self._theirs.put.items():
            if not row.is_edge or item in self.deleted or item in self.put:
                continue
            for end in ("source", "target"):
                node = row.properties.get(end)
                if node in ours and not self._has_node(node, networks):
                    reason = (
                        f"the draft deleted its {end} {node!r}, which version {self._work.head.number} connects: put "
                        "the node back into the draft"
                    )
                    self._work.refuse(self.key, item, [end], reason)

    def row(self, item: str) -> _Row | None:
        """Return a feature as merged."""
        if item in self.put:
            return self.put[item]
        return None if item in self.deleted else self._head.get(item)

    def operations(self) -> Iterator[Put | Delete]:
        """Return what is to be done on top of the head."""
        if self.deleted:
            yield Delete(self.key, tuple(sorted(self.deleted)))
        if self.put:
            geometry = np.empty(len(self.put), object)
            geometry[:] = [row.geometry for row in self.put.values()]
            properties = tuple(row.properties for row in self.put.values())
            local = np.array([row.local for row in self.put.values()], bool)
            entry = self._work.head.part(self.key) or self._work.draft.part(self.key)
            assert entry is not None
            features = Features(tuple(self.put), geometry, properties, local)
            yield Put(self.key, features, entry.provenance.with_edit_step())

    def _has_node(self, item: str, networks: Sequence[_PartMerge]) -> bool:
        """Return whether an edge of this network may name a node."""
        if self._network_of(item, networks) is not None:
            return True
        return self.row(item) is None and self._work.has_unchanged_node(item, {n.key for n in networks})

    def _network_of(self, item: str, networks: Sequence[_PartMerge]) -> _PartMerge | None:
        """Return the merged network with the node that an edge of this one names: its own, else another level's."""
        for network in (self, *networks):
            row = network.row(item)
            if row is not None and not row.is_edge:
                return network
            if row is not None and network is self:
                return None
        return None

    def moved_nodes(self, side: _Side) -> set[str]:
        """Return the nodes that a side moved."""
        return {
            i
            for i, row in side.put.items()
            if not row.is_edge and i in self._base and not _is_same_shape(row, self._base[i])
        }

    def lost_nodes(self, side: _Side) -> set[str]:
        """Return the nodes that a side deleted, or replaced with edges of the same ids."""
        lost = {*side.deleted, *(i for i, row in side.put.items() if row.is_edge)}
        return {i for i in lost if i in self._base and not self._base[i].is_edge}

    def _read(self, version: Version, ids: Sequence[str] | None) -> dict[str, _Row]:
        if version.part(self.key) is None:
            return {}
        return _rows(self._work.store.content.features(version, self.key, ids=ids))


def _side(delta: FeatureDelta | None) -> _Side:
    return _Side() if delta is None else _Side(_rows(delta.put), frozenset(delta.deleted))


def _rows(features: Features) -> dict[str, _Row]:
    columns = zip(features.ids, features.geometry, features.properties, features.local.tolist(), strict=True)
    return {i: _Row(geometry, properties, local) for i, geometry, properties, local in columns}


def _merged_value(was: Any, ours: Any, theirs: Any, *, takes_ours: bool) -> tuple[Any, bool]:
    """Return the merged value of a property, and whether both sides changed it differently."""
    if _is_same(ours, theirs) or _is_same(was, ours):
        return theirs, False
    if _is_same(was, theirs):
        return ours, False
    return (ours if takes_ours else theirs), True


def _frame_of(grid: OccupancyGrid) -> tuple[Any, ...]:
    """Return what must be equal for grids to be merged cell by cell."""
    properties = {word: value for word, value in grid.properties.items() if word not in (SLICE, UNKNOWN_GREY)}
    rule = (grid.mode, grid.negate, grid.occupied_thresh, grid.free_thresh)
    return grid.cells.shape, grid.resolution, grid.origin, rule, properties


def _merged_cells(
    was: OccupancyGrid, ours: OccupancyGrid, theirs: OccupancyGrid, *, takes_ours: bool
) -> tuple[OccupancyGrid, int]:
    """Merge cells of grids with one frame. Returns the grid and the number of cells that both changed differently.

    A free cell with the grey of unknown ones has a value of its own: to confirm it as free is a change.
    """
    cells, grey = theirs.cells.copy(), np.zeros(theirs.cells.shape, bool)
    masks = [unknown_grey(grid) for grid in (was, ours, theirs)]
    contested = 0
    for row in range(0, theirs.height, _STRIP_ROWS):  # in strips, to bound the memory of a large grid
        strip = slice(row, row + _STRIP_ROWS)
        old, new, other = (
            grid.cells[strip] if mask is None else np.where(mask[strip], _GREY, grid.cells[strip])
            for grid, mask in zip((was, ours, theirs), masks, strict=True)
        )
        edited = new != old
        both = edited & (other != old) & (other != new)
        contested += int(both.sum())
        merged = np.where(edited if takes_ours else edited & ~both, new, other)
        grey[strip] = merged == _GREY
        cells[strip] = np.where(grey[strip], np.uint8(FREE), merged)
    properties = {word: value for word, value in theirs.properties.items() if word != UNKNOWN_GREY}
    if SLICE not in ours.properties:
        properties.pop(SLICE, None)
    if grey.any():
        properties[UNKNOWN_GREY] = pack_cells(grey)
    return replace(theirs, cells=cells, properties=properties), contested


def _merged_shape(was: _Row | None, ours: _Row, theirs: _Row, *, takes_ours: bool) -> tuple[tuple[Any, bool], bool]:
    """Return the merged geometry with its anchor; the ends and the course of an edge are merged separately."""
    chosen = ours if takes_ours else theirs
    if _is_same_shape(ours, theirs) or (was is not None and _is_same_shape(was, ours)):
        return (theirs.geometry, theirs.local), False
    if was is not None and _is_same_shape(was, theirs):
        return (ours.geometry, ours.local), False
    rows = (was, ours, theirs)
    if was is None or not all(r is not None and r.is_edge and r.geometry.geom_type == "LineString" for r in rows):
        return (chosen.geometry, chosen.local), True
    if len({r.local for r in (was, ours, theirs)}) > 1:
        return (chosen.geometry, chosen.local), True
    parts = [_line_parts(r.geometry) for r in (was, ours, theirs)]
    merged = [_merged_value(*values, takes_ours=takes_ours) for values in zip(*parts, strict=True)]
    vertices = [vertex for part, _ in merged for vertex in part]
    return (shapely.LineString(vertices), ours.local), any(is_contested for _, is_contested in merged)


def _line_parts(line: Any) -> tuple[list[list[float]], list[list[float]], list[list[float]]]:
    """Split a line into its start, its course and its end."""
    vertices: list[list[float]] = shapely.get_coordinates(line, include_z=line.has_z).tolist()
    return vertices[:1], vertices[1:-1], vertices[-1:]


def _is_same(a: Any, b: Any) -> bool:
    if a is _ABSENT or b is _ABSENT:
        return a is b
    return bool(pack(a) == pack(b))  # since 1 == 1.0 == True in Python


def _is_same_shape(a: _Row, b: _Row) -> bool:
    return a.local == b.local and bool(shapely.equals_identical(a.geometry, b.geometry))


def _in_anchor(row: _Row, local: bool, datum: Datum | None) -> Any:
    """Return a geometry in metres (``local``) or degrees."""
    if row.local == local or datum is None:
        return row.geometry
    one = np.array([row.geometry], object)
    frame = local_frame(datum)
    return (frame.geometries_to_local(one) if local else frame.geometries_to_wgs84(one))[0]

"""Working out a version: operations on trees, the resulting changes, and the new chunks. Only reads and computes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from app.errors import Invalid, NotFound
from app.model.frame import Datum, Level
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.layers import LAYERS, PART_TYPES, VECTOR_LAYERS, PartKey
from app.model.templates import NO_TEMPLATES, Templates, template_changes
from app.store import diff, parts, tree
from app.store.area import area_after
from app.store.changes import KEEP, Changes, Delete, Drop, Operation, Prepared, Replace
from app.store.diff import CellChanges
from app.store.encode import compress, pack, root_hash
from app.store.gc_pause import gc_paused
from app.store.parts.features import edit_features, empty_features
from app.store.parts.roots import EncodedPart, PartRoot, read_root
from app.store.tree import ChunkStage
from app.store.values import PartEntry, Provenance, Version

MAX_COMPARED: Final = 2000
"""Number of features of a new or emptied part above which they are counted without a comparison."""

IsIntact = Callable[[str], bool]
"""Predicate: whether all stored chunks of a part (its hash) still match their hashes."""


def prepare(draft: ChunkStage, base: Version, changes: Changes, is_intact: IsIntact) -> Prepared:
    """Prepare a version on top of a base. Damaged chunks of a part that is replaced are stored again."""
    with gc_paused():
        return _prepare(draft, base, changes, is_intact)


def prepare_further(
    draft: ChunkStage, base: Version, current: Version, changes: Changes, is_intact: IsIntact
) -> Prepared:
    """Prepare changes on top of an uncommitted version, as a change of the version that it is based on."""
    with gc_paused():
        prepared = _prepare(draft, current, changes, is_intact)
        before, after = ({entry.key: entry for entry in parts} for parts in (base.parts, prepared.parts))
        summary = summarise(draft, before, after)
    summary |= frame_changes(base.datum, prepared.datum, base.levels, prepared.levels)
    summary |= template_changes(base.templates, prepared.templates)
    return replace(prepared, base=base.number, changes=summary, changed=prepared.root != base.root, area=None)


def _prepare(draft: ChunkStage, base: Version, changes: Changes, is_intact: IsIntact) -> Prepared:
    entries = {entry.key: entry for entry in base.parts}
    before = dict(entries)
    blobs: dict[str, bytes] = {}
    replaced: dict[PartKey, Replace] = {}
    for operation in changes.operations:
        key = operation.key
        if isinstance(operation, Replace) and key in before and not is_intact(before[key].hash):
            del before[key], entries[key]  # damaged: no comparison is possible, and none of its chunks counts as stored
        encoded_part = compose_operation(draft, entries, operation)
        if encoded_part is not None:
            blobs.update(encoded_part.blobs)
        if isinstance(operation, Replace):
            replaced[operation.key] = operation
        else:
            replaced.pop(operation.key, None)
    datum = base.datum if changes.datum is KEEP else changes.datum
    levels = base.levels if changes.levels is KEEP else _check_levels(changes.levels)
    templates = base.templates if changes.templates is KEEP else changes.templates
    listed = tuple(entries[key] for key in sorted(entries))
    root = version_root(listed, datum, levels, templates)
    damaged = {entry.key for entry in base.parts} - before.keys()
    fresh = _new_chunks(draft, before, entries)
    renewed = _rederived_parts(before, entries, replaced)
    if root == base.root and not renewed:
        same = Prepared(base.number, root, fresh, base.parts, datum, levels, templates, {}, changed=False, area=KEEP)
        return replace(same, blobs=blobs)
    summary = summarise(draft, before, entries, replaced)
    summary |= frame_changes(base.datum, datum, base.levels, levels)
    summary |= template_changes(base.templates, templates)
    summary |= {"renewed": renewed} if renewed else {}
    return Prepared(
        base.number,
        root,
        fresh,
        listed,
        datum,
        levels,
        templates,
        summary,
        changed=True,
        blobs=blobs,
        area=None if damaged else area_after(draft, base.parts, listed, base.datum, datum),
    )


def version_root(
    entries: Sequence[PartEntry], datum: Datum | None, levels: Sequence[Level], templates: Templates = NO_TEMPLATES
) -> str:
    """Return the version's root hash."""
    named = ((e.key.layer, e.key.level, e.key.name, e.hash) for e in entries)
    return root_hash(named, datum, levels, templates.as_dict())


def _rederived_parts(
    before: Mapping[PartKey, PartEntry], after: Mapping[PartKey, PartEntry], replaced: Mapping[PartKey, Replace]
) -> list[dict[str, str]]:
    """Return derived parts that were given again with equal content but by other steps or from other inputs.

    Their provenance needs a new version, since it decides whether they are stale.
    """
    out = []
    for key in sorted(replaced):
        a, b = before.get(key), after.get(key)
        if (
            a is None
            or b is None
            or a.hash != b.hash
            or a.provenance.information != "derived"
            or b.provenance.is_edited
        ):
            continue
        # compared as packed bytes: stored lists correspond to tuples of new steps
        old, new = (pack([p.information, list(p.steps), list(p.inputs)]) for p in (a.provenance, b.provenance))
        if old != new:
            out.append({"layer": key.layer, "level": key.level, "name": key.name})
    return out


def _check_levels(levels: Sequence[Level]) -> tuple[Level, ...]:
    names = [level.name for level in levels]
    if len(set(names)) != len(names):
        raise Invalid(f"two levels have the same name: {', '.join(sorted(names))}")
    return tuple(sorted(levels, key=lambda level: (level.elevation, level.name)))


def compose_operation(draft: ChunkStage, entries: dict[PartKey, PartEntry], operation: Operation) -> EncodedPart | None:
    """Apply an operation to a version's entries; returns its chunks in the stage, None if there are none."""
    key = operation.key
    entry = entries.get(key)
    label = f"{key.layer} {key.name!r} on level {key.level!r}"
    if isinstance(operation, Drop):
        if entry is None:
            raise NotFound(f"there is no {label}")
        del entries[key]
        return None
    root = read_root(draft, bytes.fromhex(entry.hash)) if entry else None
    if isinstance(operation, Replace):
        if not isinstance(operation.part, PART_TYPES[key.layer]):
            raise Invalid(f"{label} must be {PART_TYPES[key.layer].__name__}, got {type(operation.part).__name__}")
        encoded_part = parts.compose(draft, operation.part, root, entry.digest if entry else "")
        if encoded_part is None and entry is not None:
            entries[key] = replace(entry, provenance=operation.provenance)
            return None
        assert encoded_part is not None
        entries[key] = PartEntry(
            key,
            encoded_part.hash.hex(),
            encoded_part.count,
            encoded_part.bounds,
            operation.provenance,
            digest=encoded_part.digest,
        )
        return encoded_part
    if key.layer not in VECTOR_LAYERS:
        raise Invalid(f"{label} has no features to put or delete: replace it as a whole")
    if isinstance(operation, Delete):
        if entry is None or root is None:
            raise NotFound(f"there is no {label}")
        encoded_part = edit_features(draft, root, None, set(operation.ids), label)
        provenance = entry.provenance.with_edit_step()
    else:
        root = root or read_root(draft, empty_features(draft))
        encoded_part = edit_features(draft, root, operation.features, (), label)
        provenance = merge_provenance(entry.provenance, operation.provenance) if entry else operation.provenance
    digest = entry.digest if entry and encoded_part.hash.hex() == entry.hash else ""
    entries[key] = PartEntry(
        key, encoded_part.hash.hex(), encoded_part.count, encoded_part.bounds, provenance, digest=digest
    )
    return encoded_part


def merge_provenance(old: Provenance, new: Provenance) -> Provenance:
    """Return the provenance after features were added: raw if any of it is, with all sources, steps and credits."""
    return Provenance(
        information="raw" if "raw" in (old.information, new.information) else new.information,
        format=old.format or new.format,
        sources=tuple(dict.fromkeys((*old.sources, *new.sources))),
        upload=None,
        steps=(*old.steps, *(step for step in new.steps if step not in old.steps)),
        attribution=tuple(dict.fromkeys((*old.attribution, *new.attribution))),
        inputs=old.inputs or new.inputs,
    )


# --- changes ---


def read_roots(draft: ChunkStage, key: PartKey, entries: Mapping[PartKey, PartEntry]) -> PartRoot | None:
    """Read the decoded root of a part, or None."""
    entry = entries.get(key)
    return read_root(draft, bytes.fromhex(entry.hash)) if entry else None


def differing_keys(before: Mapping[PartKey, PartEntry], after: Mapping[PartKey, PartEntry]) -> list[PartKey]:
    """Return the keys of parts that differ, by layer in the order of ``LAYERS``."""

    def differs(key: PartKey) -> bool:
        a, b = before.get(key), after.get(key)
        return a is None or b is None or a.hash != b.hash

    keys = [key for key in before.keys() | after.keys() if differs(key)]
    return sorted(keys, key=lambda key: (LAYERS.index(key.layer), key))


def part_names(keys: Sequence[PartKey]) -> dict[PartKey, str]:
    """Return a part's name among those of its layer, with the level if the name is ambiguous."""
    seen: dict[tuple[str, str], int] = {}
    for key in keys:
        seen[key.layer, key.name] = seen.get((key.layer, key.name), 0) + 1
    return {key: key.name if seen[key.layer, key.name] == 1 else f"{key.level}/{key.name}" for key in keys}


def summarise(
    draft: ChunkStage,
    before: Mapping[PartKey, PartEntry],
    after: Mapping[PartKey, PartEntry],
    replaced: Mapping[PartKey, Replace] | None = None,
) -> dict[str, Any]:
    """Count changes by layer."""
    out: dict[str, Any] = {}
    keys = differing_keys(before, after)
    names = part_names(sorted(before.keys() | after.keys()))
    for key in keys:
        a, b = before.get(key), after.get(key)
        if key.layer in VECTOR_LAYERS:
            total = out.setdefault(key.layer, {"added": 0, "changed": 0, "deleted": 0})
            if (a is None or not a.count) and b is not None and b.count > MAX_COMPARED:
                total["added"] += b.count
                continue
            if (b is None or not b.count) and a is not None and a.count > MAX_COMPARED:
                total["deleted"] += a.count
                continue
            changed = diff.features(draft, read_roots(draft, key, before), read_roots(draft, key, after))
            for name, count in changed.counts().items():
                total[name] += count
            if changed.document:
                total["document"] = True
        elif key.layer == "occupancy":
            operation = (replaced or {}).get(key)
            new = operation.part if operation else None
            if a is None and isinstance(new, OccupancyGrid):
                cells = cells_of_new_grid(new)
            else:
                cells = diff.cells(draft, read_roots(draft, key, before), read_roots(draft, key, after))
            out.setdefault(key.layer, {})[names[key]] = cells.as_dict()
        else:
            other = diff.diff_other_parts(draft, read_roots(draft, key, before), read_roots(draft, key, after))
            out.setdefault(key.layer, {})[names[key]] = other
    return out


def cells_of_new_grid(grid: OccupancyGrid) -> CellChanges:
    """Return the changes of a new grid: every cell with a value was unknown before."""
    out = CellChanges()
    known_cells = grid.cells != UNKNOWN
    total = int(known_cells.sum())
    out.freed = int((grid.cells == FREE).sum())
    out.blocked = int((grid.cells == OCCUPIED).sum())
    out.other = total - out.freed - out.blocked
    if total:
        rows = np.flatnonzero(known_cells.any(axis=1))
        columns = np.flatnonzero(known_cells.any(axis=0))
        header = {"origin": list(grid.origin), "resolution": grid.resolution}
        out.box = diff.cell_box(header, float(columns[0]), float(rows[0]), float(columns[-1] + 1), float(rows[-1] + 1))
    return out


def frame_changes(
    old: Datum | None, new: Datum | None, old_levels: Sequence[Level], new_levels: Sequence[Level]
) -> dict[str, Any]:
    """Return ``datum`` and ``levels`` with from and to, if they differ."""
    out: dict[str, Any] = {}
    if old != new:
        out["datum"] = {"from": old.as_dict() if old else None, "to": new.as_dict() if new else None}
    if sorted((v.name, v.elevation) for v in old_levels) != sorted((v.name, v.elevation) for v in new_levels):
        out["levels"] = {
            "from": [{"name": v.name, "elevation": v.elevation} for v in old_levels],
            "to": [{"name": v.name, "elevation": v.elevation} for v in new_levels],
        }
    return out


# --- new chunks ---


def _new_chunks(
    draft: ChunkStage, before: Mapping[PartKey, PartEntry], after: Mapping[PartKey, PartEntry]
) -> dict[str, bytes]:
    """Return hash (hex) -> stored bytes of the chunks of changed parts that were not read from the store."""
    out: dict[bytes, bytes] = {}
    for key in differing_keys(before, after):
        entry = after.get(key)
        if entry is None:
            continue
        old = read_roots(draft, key, before)
        existing_names: set[bytes] = set()
        if old is not None:
            for node in old.trees.values():
                existing_names |= tree.names(draft, node)
        new, tiles = parts.new_chunks(draft, bytes.fromhex(entry.hash), existing_names)
        for name in new:
            if name not in out:
                out[name] = compress(draft.new[name])
        out.update((name, draft.stored[name]) for name in tiles)
    return {name.hex(): data for name, data in out.items()}

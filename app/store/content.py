"""Content of versions: complete, by box, by id, and the differences of two versions."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Any

from app.errors import Invalid, NotFound
from app.model.features import Features
from app.model.frame import Anchor
from app.model.geodesy import local_frame
from app.model.layers import VECTOR_LAYERS, Layers, PartKey
from app.model.templates import template_changes
from app.store import diff, parts
from app.store.blobs import Blobs
from app.store.cell_changes import CellChangeImage
from app.store.chunks import Chunks
from app.store.diff import FeatureChanges
from app.store.gc_pause import gc_paused
from app.store.parts.features import (
    PackedFeatures,
    PackedLeaf,
    features_from_items,
    features_in_box,
    find_places,
    items_by_id,
    load_packed,
    packed_from_items,
    packed_leaves,
)
from app.store.parts.roots import PartRoot, read_document, read_root
from app.store.prepare import differing_keys, frame_changes, part_names, read_roots
from app.store.references import References
from app.store.tree import ChunkStage
from app.store.values import Box, Delta, FeatureDelta, GridDelta, Version


class ContentReader:
    """Read access to layers. The cost does not depend on the age of the version."""

    def __init__(self, chunks: Chunks, blobs: Blobs) -> None:
        self._chunks, self._blobs = chunks, blobs
        self._references = References()

    def load(self, version: Version, keys: Collection[PartKey] | None = None) -> Layers:
        """Read a version's content, or some parts of it. Raises NotFound if the version has no part with a given key.

        Features come in the order of their ids, not in the order of the upload: a part is a set.
        """
        entries = {e.key: e for e in version.parts}
        chosen = list(entries) if keys is None else sorted(set(keys))
        for key in chosen:
            if key not in entries:
                raise NotFound(_missing(version, key))
        hashes = {key: bytes.fromhex(entries[key].hash) for key in chosen}
        loaded = parts.load(self._chunks.stage(), hashes, self._blobs.get_many) if hashes else {}
        return Layers(loaded, version.datum, version.levels)

    def features(
        self,
        version: Version,
        key: PartKey,
        *,
        bbox: Box | None = None,
        crs: Anchor = "local",
        ids: Collection[str] | None = None,
    ) -> Features:
        """Read features of a vector part by id, as they are anchored: all, or filtered by ``bbox``, by ids, or by both.

        Args:
            bbox: (minimum x, minimum y, maximum x, maximum y) in metres (crs ``local``) or degrees (``wgs84``; west >
                east crosses the antimeridian); features without coordinates are in no box.
            ids: only the leaves that contain them are read.

        Raises MissingDatum if the part has items with another anchor than ``crs`` and the version has no datum.
        """
        draft = self._chunks.stage()
        root = self._root(draft, version, key)
        if bbox is None and ids is None:
            loaded = self.load(version, [key]).parts[key]
            assert isinstance(loaded, Features)
            return loaded
        if bbox is None:
            items = items_by_id(draft, root, ids or ())
        else:
            frame = None if version.datum is None else local_frame(version.datum)
            items = features_in_box(draft, root, bbox, crs, frame)
            if ids is not None:
                selected_ids = set(ids)
                items = {i: item for i, item in items.items() if i in selected_ids}
        return features_from_items(items, read_document(draft, root))

    def packed_in_box(self, version: Version, key: PartKey, bbox: Box) -> PackedFeatures:
        """Read the features of a vector part in a box in degrees by id, with packed properties."""
        draft = self._chunks.stage()
        frame = None if version.datum is None else local_frame(version.datum)
        return packed_from_items(features_in_box(draft, self._root(draft, version, key), bbox, "wgs84", frame))

    def referring(self, version: Version, key: PartKey, names: Collection[str]) -> Features:
        """Read the features that name one of these as ``source``, ``target`` or ``drawn_from``, and some others."""
        draft = self._chunks.stage()
        root = self._root(draft, version, key)
        return features_from_items(self._references.items(draft, root, names), {})

    def packed_features(self, version: Version, key: PartKey) -> PackedFeatures:
        """Read all features of a vector part by id, with packed properties: a fraction of the time of ``features``."""
        draft = self._chunks.stage()
        with gc_paused():
            return load_packed(draft, self._root(draft, version, key))

    def packed_leaves(self, version: Version, key: PartKey) -> Iterator[PackedLeaf]:
        """Read a vector part leaf by leaf, in bounded memory."""
        draft = self._chunks.stage()
        return packed_leaves(draft, self._root(draft, version, key))

    def has_ids(self, version: Version, key: PartKey, ids: Collection[str]) -> set[str]:
        """Return the given ids that the part has; none if there is no such part."""
        if version.part(key) is None:
            return set()
        draft = self._chunks.stage()
        return set(find_places(draft, self._root(draft, version, key), sorted(set(ids))))

    def _root(self, draft: ChunkStage, version: Version, key: PartKey) -> PartRoot:
        if key.layer not in VECTOR_LAYERS:
            raise Invalid(f"layer {key.layer} has no features: use one of {', '.join(sorted(VECTOR_LAYERS))}")
        root = read_roots(draft, key, {e.key: e for e in version.parts})
        if root is None:
            raise NotFound(_missing(version, key))
        return root

    def diff(self, a: Version, b: Version) -> dict[str, Any]:
        """Compare version a with version b, by layer; reads only what the two do not share.

        Vector layers: ``{added: [ids], changed: [{id, fields}], deleted: [ids]}``, ids of all parts of the layer
        together. occupancy: ``{grid: {freed, blocked, unknown, other, bbox, fields?}}``, metres. voxels, imagery and
        resources: ``{name: {added, changed, deleted, fields?}}``, counts of voxels, tiles or files. ``datum`` and
        ``levels``: ``{from, to}``; ``templates`` as returned by ``template_changes``.
        """
        draft = self._chunks.stage()
        before, after = {e.key: e for e in a.parts}, {e.key: e for e in b.parts}
        names = part_names(sorted(before.keys() | after.keys()))
        out: dict[str, Any] = {}
        for key in differing_keys(before, after):
            old, new = read_roots(draft, key, before), read_roots(draft, key, after)
            if key.layer in VECTOR_LAYERS:
                changed = diff.features(draft, old, new)
                layer = out.setdefault(key.layer, {"added": [], "changed": [], "deleted": []})
                for name, listed in changed.as_dict().items():
                    layer[name] += listed
                if changed.document:
                    layer["document"] = True
            elif key.layer == "occupancy":
                out.setdefault(key.layer, {})[names[key]] = diff.cells(draft, old, new).as_dict()
            else:
                out.setdefault(key.layer, {})[names[key]] = diff.diff_other_parts(draft, old, new)
        out |= frame_changes(a.datum, b.datum, a.levels, b.levels)
        return out | template_changes(a.templates, b.templates)

    def feature_changes(
        self, a: Version, b: Version, layers: Collection[str] = VECTOR_LAYERS
    ) -> list[tuple[PartKey, FeatureChanges]]:
        """Compare the vector parts of two versions that differ, sorted by key."""
        draft = self._chunks.stage()
        before, after = {e.key: e for e in a.parts}, {e.key: e for e in b.parts}
        keys = [key for key in differing_keys(before, after) if key.layer in VECTOR_LAYERS and key.layer in layers]
        roots = [(key, read_roots(draft, key, before), read_roots(draft, key, after)) for key in sorted(keys)]
        return [(key, diff.features(draft, old, new)) for key, old, new in roots]

    def cell_changes(self, old: str | None, new: str | None) -> CellChangeImage:
        """Compare two stored grids, given by the hashes of their parts; None for a grid that does not exist."""
        draft = self._chunks.stage()
        roots = [None if name is None else read_root(draft, bytes.fromhex(name)) for name in (old, new)]
        return CellChangeImage(draft, *roots)

    def delta_parts(self, a: Version, b: Version) -> Delta:
        """Compute the changes that turn version a into version b: features put and deleted, rectangles of grids."""
        draft = self._chunks.stage()
        before, after = {e.key: e for e in a.parts}, {e.key: e for e in b.parts}
        features, grids, other = [], [], []
        for key in differing_keys(before, after):
            old, new = read_roots(draft, key, before), read_roots(draft, key, after)
            if key.layer in VECTOR_LAYERS:
                changed = diff.features(draft, old, new)
                items = {i: changed.after[i] for i in (*changed.added, *changed.changed)}
                document = read_document(draft, new) if new is not None and changed.document else {}
                features.append(FeatureDelta(key, features_from_items(items, document), tuple(changed.deleted)))
            elif key.layer == "occupancy":
                grids.append(_grid_delta(draft, key, old, new))
            else:
                other.append(key)
        moved = frame_changes(a.datum, b.datum, a.levels, b.levels)
        return Delta(tuple(features), tuple(grids), tuple(other), "datum" in moved, "levels" in moved)


def _grid_delta(draft: ChunkStage, key: PartKey, old: PartRoot | None, new: PartRoot | None) -> GridDelta:
    if new is None:
        return GridDelta(key, (), deleted=True)
    if old is None or old.header != new.header:
        return GridDelta(key, (), whole=True)
    return GridDelta(key, diff.rectangles(draft, old, new))


def _missing(version: Version, key: PartKey) -> str:
    contents = ", ".join(f"{e.key.layer}/{e.key.level}/{e.key.name}" for e in version.parts) or "nothing"
    return (
        f"version {version.ref} of {version.environment} has no {key.layer} {key.name!r} on level {key.level!r}; it "
        f"has {contents}"
    )

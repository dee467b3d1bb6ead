"""Prepare an upload in a worker: files -> change set. Reads the store, writes nothing."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any, Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from app import formats, upload_reader
from app.errors import Damaged, Invalid, Problem
from app.ingest.match import match_ids
from app.ingest.moved import follow_outlines
from app.limits import Limits
from app.model.features import Features, merge_documents
from app.model.frame import Datum, Level
from app.model.grid import (
    SLICE,
    UNKNOWN,
    UNKNOWN_GREY,
    OccupancyGrid,
    pack_cells,
    unknown_grey,
    unknown_grey_as_unknown,
)
from app.model.imagery import GeoImage
from app.model.layers import Part, PartKey, Resources, cloud_name, join_levels
from app.store.changes import KEEP, Changes, Drop, Operation, Prepared, Provenance, Put, Replace
from app.store.in_worker import open_store
from app.store.prepare import merge_provenance
from app.store.store import Store
from app.store.values import Version
from app.upload_reader import Bundle, EnvironmentContext, UploadHints

Mode = Literal["replace", "merge"]

READ = 0.1
"""Fraction of a derivation or generation that reading counts as, and likewise storing."""


@dataclass(frozen=True, slots=True)
class FileNote:
    """Uploaded file, or member of an uploaded archive: its format and whether it is used."""

    name: str
    format: str | None
    used: bool


@dataclass(frozen=True, slots=True)
class PreparedUpload:
    """Changes that an upload would make, with warnings. members: content of unpacked archives."""

    prepared: Prepared
    notes: tuple[FileNote, ...]
    warnings: tuple[Problem, ...]
    members: Mapping[str, bytes]


def prepare_upload(
    database_url: str,
    blob_dir: str,
    base: Version,
    paths: Mapping[str, Path],
    hints: UploadHints,
    mode: Mode,
    limits: Limits,
) -> PreparedUpload:
    """Read spooled files and prepare the version that they would create on top of ``base``.

    Raises the errors of ``app.upload_reader.read``.
    """
    store = open_store(database_url, blob_dir)
    uploaded = {name: path.read_bytes() for name, path in paths.items()}
    files = upload_reader.unpack(uploaded, limits)
    upload_bundle = upload_reader.read(files, hints, EnvironmentContext(base.datum, read_fence(store, base)), limits)
    upload_bundle, moved = follow_outlines(store, base, upload_bundle)
    renamed: dict[str, dict[str, str]] = {}
    # Sorted: objects come before the topology that was read from the same drawing.
    operations: list[Operation] = [
        operation_for(store, base, upload_bundle, key, mode, files, renamed, limits)
        for key in sorted(upload_bundle.parts)
    ]
    operations += _stale_clouds(base, upload_bundle)
    warnings = [*upload_bundle.warnings, *moved, *_unused_hints(hints, upload_bundle)]
    warnings += distance_warnings(upload_bundle, upload_bundle.datum or base.datum)
    datum: Any = KEEP
    if upload_bundle.datum is not None and upload_bundle.datum != base.datum:
        datum = upload_bundle.datum
        warnings += datum_moved_warnings(base, upload_bundle.datum)
    levels: Any = KEEP
    joined_levels = join_levels(base.levels, upload_bundle.levels)
    listed = {level.name for level in joined_levels}
    # A level that only the upload's ``level`` names has elevation 0 m until a source states it.
    joined_levels = join_levels(
        joined_levels, [Level(name) for name in sorted({key.level for key in upload_bundle.parts} - listed)]
    )
    if joined_levels != base.levels:
        levels = joined_levels
    prepared = store.versions.prepare(base, Changes(tuple(operations), datum, levels))
    notes = [FileNote(name, use.format, use.used) for name, use in upload_bundle.files.items()]
    notes += [FileNote(name, "zip", True) for name in uploaded.keys() - files.keys()]
    members = {name: files[name] for name in files.keys() - uploaded.keys()}
    return PreparedUpload(prepared, tuple(sorted(notes, key=lambda n: n.name)), tuple(warnings), members)


def _stale_clouds(base: Version, upload_bundle: Bundle) -> list[Drop]:
    """List the point clouds to drop because an upload replaces the voxel map that was built from them."""
    existing_keys = {entry.key for entry in base.parts}
    clouds = [
        PartKey("resources", k.level, cloud_name(k.name)) for k in sorted(upload_bundle.parts) if k.layer == "voxels"
    ]
    return [Drop(key) for key in clouds if key in existing_keys and key not in upload_bundle.parts]


def _unused_hints(hints: UploadHints, upload_bundle: Bundle) -> list[Problem]:
    """Warn about upload hints without effect."""
    out = []
    drawings = {f.name for f in formats.all_formats().values() if f.traits.is_drawing}
    if hints.layer is not None and not any(use.format in drawings for use in upload_bundle.files.values()):
        drawing_formats = ", ".join(sorted(drawings))
        out.append(Problem(f"the upload contains no drawing ({drawing_formats}); layer is ignored", where="layer"))
    if hints.grid is not None and not any(key.layer == "occupancy" for key in upload_bundle.parts):
        out.append(Problem("the upload contains no grid; the grid name is ignored", where="grid"))
    return out


def prepare_changes(database_url: str, blob_dir: str, base: Version, changes: Changes) -> Prepared:
    """Prepare the version that these changes create on top of ``base`` (in a worker)."""
    return open_store(database_url, blob_dir).versions.prepare(base, changes)


MAX_USUAL_METRES = 100_000.0
"""Distance from the datum above which a part is suspicious. The local frame is exact to 1 mm within 10 km."""
_EARTH_RADIUS = 6_371_000.0


def distance_warnings(upload_bundle: Bundle, datum: Datum | None) -> list[Problem]:
    """Warn about parts whose nearest corner is far from the datum: swapped coordinates or the wrong environment."""
    out = []
    for key, part in sorted(upload_bundle.parts.items()):
        if not isinstance(part, Features) or not len(part):
            continue
        metres = []
        if part.local.any():
            west, south, east, north = shapely.total_bounds(part.geometry[part.local])
            metres.append(float(np.hypot(max(west, 0.0, -east), max(south, 0.0, -north))))
        if datum is not None and not part.local.all():
            metres.append(_metres_to(shapely.total_bounds(part.geometry[~part.local]), datum))
        distances = [m for m in metres if np.isfinite(m)]
        if distances and min(distances) > MAX_USUAL_METRES:
            location = f"{key.layer} {key.level}/{key.name}"
            reason = (
                f"about {min(distances) / 1000:.0f} km from the datum; check the environment and the order of the "
                "coordinates"
            )
            files, _ = upload_bundle.origin.get(key, ((), ""))
            out.append(Problem(reason, files[0] if files else None, where=location))
    return out


def _metres_to(box: NDArray[np.float64], datum: Datum) -> float:
    """Approximate the distance in metres from a datum to a box [west, south, east, north] in degrees, on a sphere."""
    west, south, east, north = box
    datum_latitude, lat = np.radians(datum.latitude), np.radians(np.clip(datum.latitude, south, north))
    turn = min(abs((datum.longitude - edge + 180.0) % 360.0 - 180.0) for edge in (west, east))
    turn = 0.0 if west <= datum.longitude <= east else turn
    half = (
        np.sin((lat - datum_latitude) / 2) ** 2
        + np.cos(datum_latitude) * np.cos(lat) * np.sin(np.radians(turn) / 2) ** 2
    )
    return float(2 * _EARTH_RADIUS * np.arcsin(np.sqrt(np.clip(half, 0.0, 1.0))))


def datum_moved_warnings(base: Version, datum: Datum) -> list[Problem]:
    """Build the warning about a moved datum."""
    if base.datum is None:
        return []
    return [
        Problem(
            f"the datum moves from {base.datum.latitude!r}, {base.datum.longitude!r} (heading {base.datum.heading:g}°) "
            f"to {datum.latitude!r}, {datum.longitude!r} (heading {datum.heading:g}°); features with local anchor keep "
            "their metres, features with wgs84 anchor their degrees, so the two shift against each other"
        )
    ]


def read_fence(store: Store, base: Version) -> shapely.Polygon | None:
    """Read the fence of a version's location layer."""
    keys = [e.key for e in base.parts if e.key.layer == "location" and e.count]
    with contextlib.suppress(Damaged):  # this upload may repair it
        for part in store.content.load(base, keys).parts.values() if keys else ():
            if isinstance(part, Features) and len(part):
                polygon: shapely.Polygon = part.geometry[0]
                return polygon
    return None


def operation_for(
    store: Store,
    base: Version,
    upload_bundle: Bundle,
    key: PartKey,
    mode: Mode,
    files: Mapping[str, bytes],
    renamed: dict[str, dict[str, str]],
    limits: Limits,
) -> Replace | Put:
    """Build the operation that stores one part.

    renamed: by level, objects that took a stored object's id; features read from their drawing follow.
    """
    part = upload_bundle.parts[key]
    names, origin = upload_bundle.origin[key]
    digest = hashlib.sha256()
    for name in names:
        digest.update(hashlib.sha256(files[name]).digest())
    provenance = Provenance("raw", origin, names, digest.hexdigest(), attribution=upload_bundle.credit(key))
    entry = base.part(key)
    fmt = formats.all_formats().get(origin)
    own_ids = fmt is not None and fmt.traits.own_ids
    if isinstance(part, Features):
        if key.layer == "topology" and key.level in renamed:
            part = _rename_drawn_from(part, renamed[key.level])
        if entry is not None and key.layer in ("topology", "objects", "zones") and not own_ids:
            ids = part.ids
            with contextlib.suppress(Damaged):  # nothing to compare with: keep the upload's ids
                part = match_ids(store, base, key, part)
            if key.layer == "objects":
                renamed.setdefault(key.level, {}).update((a, b) for a, b in zip(ids, part.ids, strict=True) if a != b)
        if mode == "merge":
            return Put(key, _merge_with_stored(store, base, key, part) if entry else part, provenance)
    elif mode == "merge" and entry is not None:
        old = store.content.load(base, [key]).parts[key]
        if isinstance(part, OccupancyGrid) and isinstance(old, OccupancyGrid):
            part = merge_grids(old, part, key.name, limits.pixels)
            # What was measured does not get stale with the inputs of what it was laid onto.
            provenance = replace(merge_provenance(entry.provenance, provenance), inputs=())
        elif isinstance(part, Resources) and isinstance(old, Resources):
            part, provenance = Resources({**old.files, **part.files}), merge_provenance(entry.provenance, provenance)
    return Replace(key, part, provenance)


def _rename_drawn_from(part: Features, renamed: Mapping[str, str]) -> Features:
    """Update a network's references to drawn objects that got other ids."""
    properties = tuple(
        {**p, "drawn_from": renamed[p["drawn_from"]]} if p.get("drawn_from") in renamed else p for p in part.properties
    )
    return replace(part, properties=properties)


def _merge_with_stored(store: Store, base: Version, key: PartKey, part: Features) -> Features:
    """Merge the collection documents of the stored part and the upload into the upload's part.

    The result has the credits of both, bounds around both, and the drawings of both with their styles, even if two
    drawings have the same name.
    """
    old = store.content.load(base, [key]).parts[key]
    assert isinstance(old, Features)
    for family, new_document in part.document.items():
        stored, new = (
            d.get("documents") if isinstance(d, Mapping) else None for d in (old.document.get(family), new_document)
        )
        if isinstance(stored, Mapping) and isinstance(new, Mapping):
            part = _rename_documents(part, family, _free_names(stored, new))
    out = merge_documents(old.document, part.document)
    credit = [*_attribution(old), *_attribution(part)]
    if credit:
        out["attribution"] = list(dict.fromkeys(credit))
    boxes = [box for f in (old, part) if (box := f.document.get("bounds"))]
    if len(boxes) == 2:
        (west, south, east, north), (w, s, e, n) = boxes
        out["bounds"] = [min(west, w), min(south, s), max(east, e), max(north, n)]
    return part.with_document(out)


def _free_names(stored: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, str]:
    """Choose new names for drawings whose name belongs to a different stored drawing."""
    names: dict[str, str] = {}
    for name in sorted(new):
        if name in stored and stored[name] != new[name]:
            stem, dot, end = name.rpartition(".")
            stem, end = (stem, dot + end) if stem else (name, "")
            taken = {*stored, *new, *names.values()}
            names[name] = next(free for n in count(2) if (free := f"{stem}-{n}{end}") not in taken)
    return names


def _rename_documents(part: Features, family: str, names: Mapping[str, str]) -> Features:
    if not names:
        return part
    source_document = part.document[family]
    documents = {names.get(name, name): value for name, value in source_document["documents"].items()}

    def renamed(properties: Mapping[str, Any]) -> Mapping[str, Any]:
        source_properties = properties.get(family)
        if not isinstance(source_properties, Mapping) or source_properties.get("document") not in names:
            return properties
        return {**properties, family: {**source_properties, "document": names[source_properties["document"]]}}

    document = {**part.document, family: {**source_document, "documents": documents}}
    return replace(part, properties=tuple(renamed(p) for p in part.properties), document=document)


def _attribution(part: Part) -> list[str]:
    if isinstance(part, GeoImage):
        return list(part.attribution)
    stated = part.document.get("attribution", ()) if isinstance(part, Features) else ()
    return [str(line) for line in stated]


def merge_grids(old: OccupancyGrid, new: OccupancyGrid, name: str, max_cells: int) -> OccupancyGrid:
    """Merge two grids: known cells of the new grid overwrite the old ones, unknown cells overwrite nothing.

    The result covers both. Both must have the same resolution and yaw, and origins a whole number of cells apart (to a
    hundredth of a cell). Free cells with the grey of unknown ones count as unknown; they stay free where neither grid
    knows better.
    """
    if abs(old.resolution - new.resolution) > 1e-9 or abs(old.origin[2] - new.origin[2]) > 1e-9:
        raise Invalid(
            f"grid {name}: merging needs the stored grid's resolution {old.resolution!r} and yaw {old.origin[2]!r}, "
            f"the upload has {new.resolution!r} and {new.origin[2]!r}: use mode=replace, or resample the upload"
        )
    yaw, res = old.origin[2], old.resolution
    c, s = np.cos(yaw), np.sin(yaw)
    dx, dy = new.origin[0] - old.origin[0], new.origin[1] - old.origin[1]
    across, up = (dx * c + dy * s) / res, (dy * c - dx * s) / res
    column, row = round(across), round(up)
    if abs(across - column) > 0.01 or abs(up - row) > 0.01:
        raise Invalid(
            f"grid {name}: merging needs origins a whole number of cells apart; they are {across:.3f} × {up:.3f} cells "
            "apart: use mode=replace, or resample the upload onto the stored grid"
        )
    if _thresholds(new) != _thresholds(old):  # its grey is free by its own thresholds only
        new = unknown_grey_as_unknown(new)
    left, bottom = min(0, column), min(0, row)
    width = max(old.width, column + new.width) - left
    height = max(old.height, row + new.height) - bottom
    if width * height > max_cells:
        raise Invalid(
            f"grid {name}: the merged grid would have {width} × {height} cells, the limit is {max_cells}: the "
            f"origins are {np.hypot(dx, dy):.0f} m apart; check the origin, or use mode=replace"
        )
    stored = np.s_[-bottom : -bottom + old.height, -left : -left + old.width]
    window = np.s_[row - bottom : row - bottom + new.height, column - left : column - left + new.width]
    cells, grey = np.full((height, width), UNKNOWN, np.uint8), np.zeros((height, width), bool)
    cells[stored], grey[stored] = old.cells, _grey_mask(old)
    new_grey = _grey_mask(new)
    is_seen = (new.cells != UNKNOWN) & ~new_grey
    new_grey &= cells[window] == UNKNOWN
    np.copyto(cells[window], new.cells, where=is_seen | new_grey)
    grey[window] = (grey[window] & ~is_seen) | new_grey
    properties = dict(old.properties)
    if not np.array_equal(cells, old.cells):
        properties.pop(SLICE, None)
    if grey.any():
        properties[UNKNOWN_GREY] = pack_cells(grey)
    else:
        properties.pop(UNKNOWN_GREY, None)
    x = old.origin[0] + (left * c - bottom * s) * res
    y = old.origin[1] + (left * s + bottom * c) * res
    return replace(old, cells=cells, origin=(float(x), float(y), yaw), properties=properties)


def _thresholds(grid: OccupancyGrid) -> tuple[str, bool, float, float]:
    return grid.mode, grid.negate, grid.occupied_thresh, grid.free_thresh


def _grey_mask(grid: OccupancyGrid) -> NDArray[np.bool_]:
    """Mark the free cells with the grey of unknown ones: bool [height, width]."""
    grey = unknown_grey(grid)
    return np.zeros(grid.cells.shape, bool) if grey is None else grey

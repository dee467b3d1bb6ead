"""Let poses follow outlines: an object that was moved in a file, e.g. in QGIS, is moved in every map."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

import shapely

from app import formats
from app.errors import Damaged, Invalid, Problem
from app.model import geodesy
from app.model.features import Features
from app.model.layers import PartKey
from app.model.poses import moved_pose
from app.store.store import Store
from app.store.values import Version
from app.upload_reader import Bundle

NAMED: Final = 5
"""Number of objects that a warning names."""


def follow_outlines(store: Store, base: Version, upload_bundle: Bundle) -> tuple[Bundle, list[Problem]]:
    """Move the ``pose`` of objects whose outline was moved since ``base``, as edits of features do.

    Only in drawings: they carry ``pose`` and ``shapes`` as properties, which programs keep as they were. Other formats
    state the place of an object by its pose. Returns the bundle, the same if nothing was moved, and warnings about the
    objects that were moved, and about those whose solids stay where they were.
    """
    parts, warnings = dict(upload_bundle.parts), list[Problem]()
    for key, part in sorted(upload_bundle.parts.items()):
        names, origin = upload_bundle.origin[key]
        fmt = formats.all_formats().get(origin)
        if key.layer != "objects" or fmt is None or not fmt.traits.is_drawing or base.part(key) is None:
            continue
        if not isinstance(part, Features) or not any(_is_placed(p) for p in part.properties):
            continue
        with contextlib.suppress(Damaged):  # nothing to compare with
            stored = store.content.load(base, [key]).parts[key]
            datum = upload_bundle.datum or base.datum
            if isinstance(stored, Features) and (datum is not None or bool(stored.local.all() and part.local.all())):
                frame = None if datum is None else geodesy.local_frame(datum)
                parts[key], moved, left = _follow(stored, part, frame)
                file = names[0] if len(names) == 1 else None
                warnings += _warnings(key, file, moved, left)
    is_same = all(part is upload_bundle.parts[key] for key, part in parts.items())
    return upload_bundle if is_same else replace(upload_bundle, parts=parts), warnings


def _follow(
    stored: Features, part: Features, frame: geodesy.LocalFrame | None
) -> tuple[Features, list[str], list[str]]:
    """Return the features with their new poses, the ids of those moved, and of those whose solids stay."""
    places = stored.index()
    pairs = [
        (k, place)
        for k, (item, p) in enumerate(zip(part.ids, part.properties, strict=True))
        if _is_placed(p)
        and (place := places.get(item)) is not None
        and p.get("shapes") == stored.properties[place].get("shapes")
        and not (part.local[k] == stored.local[place] and part.geometry[k] == stored.geometry[place])
    ]
    if not pairs:
        return part, [], []
    properties, moved, left = list(part.properties), list[str](), list[str]()
    before = _in_metres(stored.select([place for _, place in pairs]), frame)
    after = _in_metres(part.select([k for k, _ in pairs]), frame)
    for (k, place), old, new in zip(pairs, before, after, strict=True):
        try:
            change = moved_pose(old, new, stored.properties[place], properties[k])
        except Invalid:
            left.append(part.ids[k])
            continue
        if change:
            properties[k] = {**properties[k], **change}
            moved.append(part.ids[k])
    return replace(part, properties=tuple(properties)) if moved else part, moved, left


def _is_placed(properties: Mapping[str, Any]) -> bool:
    return properties.get("pose") is not None or bool(properties.get("shapes"))


def _in_metres(part: Features, frame: geodesy.LocalFrame | None) -> Sequence[shapely.Geometry]:
    """Return geometries in local metres, empty where they are too far away."""
    out = part.geometry.copy()
    if frame is not None and not part.local.all():
        out[~part.local] = frame.near_geometries_to_local(out[~part.local])
    return list(out)


def _warnings(key: PartKey, file: str | None, moved: Sequence[str], left: Sequence[str]) -> list[Problem]:
    where = f"{key.layer} {key.level}/{key.name}"
    out = []
    if moved:
        reason = f"the outline was moved, but not 'pose': the pose was moved with it, of {_named(moved)}"
        out.append(Problem(reason, file, where=where))
    if left:
        reason = (
            "the outline was reshaped or turned, but the solids stay where 'pose' places them: change 'pose' and "
            f"'shapes' of {_named(left)}"
        )
        out.append(Problem(reason, file, where=where))
    return out


def _named(items: Sequence[str]) -> str:
    named = ", ".join(item[:80] for item in items[:NAMED])
    return named if len(items) <= NAMED else f"{named} and {len(items) - NAMED} more"

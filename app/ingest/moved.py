"""Let poses follow outlines: an object that was moved in a file, e.g. in QGIS, is moved in every map."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence, Set
from dataclasses import replace
from typing import Any, Final

import numpy as np
import shapely
from numpy.typing import NDArray

from app import formats
from app.errors import Damaged, Invalid, NotFound, Problem
from app.model import geodesy
from app.model.features import Features
from app.model.layers import PartKey
from app.model.poses import moved_pose
from app.store.store import Store
from app.store.values import Version
from app.upload_reader import Bundle

ROUNDED: Final = 0.02
"""Distance in metres below which an outline was not moved: files with seven decimals of a degree round by a quarter."""

EARLIER: Final = 10
"""Number of earlier states of a part in which a pose is looked for: a file may be edited and uploaded many times."""

LOOKED_AT: Final = 100
"""Number of earlier versions that are read for them."""

NAMED: Final = 5
"""Number of objects that a warning names."""


def follow_outlines(store: Store, base: Version, upload_bundle: Bundle) -> tuple[Bundle, list[Problem]]:
    """Move the ``pose`` of objects whose outline was moved since the version with that pose, as edits of features do.

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
        if not isinstance(part, Features):
            continue
        datum = upload_bundle.datum or base.datum
        outlines = _Outlines(part, None if datum is None else geodesy.local_frame(datum))
        for n, earlier in enumerate(_states(store, base, key) if outlines.waiting else ()):
            if n == 0:
                outlines.wait_only_for({*earlier.ids})
            outlines.follow(earlier)
            if not outlines.waiting:
                break
        parts[key] = outlines.part()
        warnings += _warnings(key, names[0] if len(names) == 1 else None, outlines)
    is_same = all(part is upload_bundle.parts[key] for key, part in parts.items())
    return upload_bundle if is_same else replace(upload_bundle, parts=parts), warnings


def _states(store: Store, base: Version, key: PartKey) -> Iterator[Features]:
    """Yield the part as it is stored, then as it was before, newest first; versions without it are passed over."""
    seen: set[str] = set()
    for number in range(base.number, max(base.number - LOOKED_AT, 0), -1):
        with contextlib.suppress(Damaged, NotFound):
            version = base if number == base.number else store.versions.get(base.environment, number)
            entry = version.part(key)
            if entry is None or entry.hash in seen:
                continue
            seen.add(entry.hash)
            part = store.content.load(version, [key]).parts[key]
            if isinstance(part, Features):
                yield part
        if len(seen) > EARLIER:
            return


class _Outlines:
    """Objects of an upload whose poses may have to follow their outlines.

    waiting: indices of objects that no earlier state with the same pose and solids was found for. moved, left: ids of
    objects that were moved, and of those whose solids stay.
    """

    def __init__(self, part: Features, frame: geodesy.LocalFrame | None) -> None:
        self._part, self._frame = part, frame
        self._properties = list(part.properties)
        self.waiting = [k for k, p in enumerate(part.properties) if p.get("pose") is not None or p.get("shapes")]
        self.moved: list[str] = []
        self.left: list[str] = []

    def wait_only_for(self, ids: Set[str]) -> None:
        """Leave other objects as they are: they are new."""
        self.waiting = [k for k in self.waiting if self._part.ids[k] in ids]

    def follow(self, earlier: Features) -> None:
        """Move the objects that had their pose in this state."""
        places = earlier.index()
        pairs = [
            (k, place)
            for k in self.waiting
            if (place := places.get(self._part.ids[k])) is not None
            and _solids(self._part.properties[k]) == _solids(earlier.properties[place])
        ]
        if not pairs:
            return
        now, before = ([pair[n] for pair in pairs] for n in (0, 1))
        self.waiting = sorted({*self.waiting} - {*now})
        old, new = self._in_metres(earlier.select(before)), self._in_metres(self._part.select(now))
        for n in np.flatnonzero(~_is_unmoved(old, new)).tolist():
            k, place = pairs[n]
            try:
                change = moved_pose(old[n], new[n], earlier.properties[place], self._properties[k], ROUNDED)
            except Invalid:
                self.left.append(self._part.ids[k])
                continue
            if change:
                self._properties[k] = {**self._properties[k], **change}
                self.moved.append(self._part.ids[k])

    def part(self) -> Features:
        """Return the part with the poses that follow."""
        return replace(self._part, properties=tuple(self._properties)) if self.moved else self._part

    def _in_metres(self, part: Features) -> NDArray[np.object_]:
        """Return geometries in local metres, empty where that is not known or too far away."""
        out = part.geometry.copy()
        on_earth = ~part.local
        if on_earth.any():
            nowhere = np.full(int(on_earth.sum()), shapely.Point(), object)
            out[on_earth] = nowhere if self._frame is None else self._frame.near_geometries_to_local(out[on_earth])
        return out


def _solids(properties: Mapping[str, Any]) -> tuple[Any, Any]:
    return properties.get("pose"), properties.get("shapes") or None


def _is_unmoved(old: NDArray[np.object_], new: NDArray[np.object_]) -> NDArray[np.bool_]:
    """Return which geometries have the same coordinates but for rounding: bool [n]."""
    counts = shapely.get_num_coordinates(old)
    out: NDArray[np.bool_] = counts == shapely.get_num_coordinates(new)
    index = np.repeat(np.arange(len(old)), np.where(out, counts, 0))
    steps = shapely.get_coordinates(new[out]) - shapely.get_coordinates(old[out])
    out[index[np.hypot(*steps.T) > ROUNDED]] = False
    return out


def _warnings(key: PartKey, file: str | None, outlines: _Outlines) -> list[Problem]:
    reasons = []
    if outlines.moved:
        moved = _named(outlines.moved)
        reasons.append(f"the outline was moved, but not 'pose': the pose was moved with it, of {moved}")
    if outlines.left:
        reasons.append(
            "the outline was reshaped or turned, but the solids stay where 'pose' places them: change 'pose' and "
            f"'shapes' of {_named(outlines.left)}"
        )
    return [Problem(reason, file, where=f"{key.layer} {key.level}/{key.name}") for reason in reasons]


def _named(items: Sequence[str]) -> str:
    named = ", ".join(item[:80] for item in items[:NAMED])
    return named if len(items) <= NAMED else f"{named} and {len(items) - NAMED} more"

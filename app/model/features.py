"""Vector layers: location, objects, topology and zones are collections of features.

A feature has a stable id, a geometry, JSON-like properties and an anchor: ``local`` coordinates are (x, y[, z]) in
metres in the environment's local frame, ``wgs84`` ones (longitude, latitude[, altitude]) in degrees and metres. Items
are stored as they are anchored, so a round trip loses nothing and a new datum moves no wgs84 item.

Words that every format shares, in ``properties``:

========== ================= =========================================================================================
layer      property          meaning
========== ================= =========================================================================================
all        ``kind``          what it is: ``node``, ``edge``, ``region``, ``poi``, ``building``, ``keepout`` …
all        ``name``          the name people and robots use; need not be unique
topology   ``source``        id of the node an edge starts at (edges only)
topology   ``target``        id of the node an edge ends at (edges only; an edge is directed)
topology   ``orientation``   [x, y, z, w], the quaternion of a node's pose in the local frame, as its source gives it
topology   ``action``        what a robot does along an edge
topology   ``speed_limit``   metres per second along an edge
topology   ``width``         metres of free width along an edge
topology   ``surface``       what an edge's ground is made of (``asphalt``, ``gravel``: OpenStreetMap's words)
topology   ``access``        who may use an edge (``yes``, ``private``, ``no`` …: OpenStreetMap's words)
topology   ``stairs``        true where an edge goes over steps
topology   ``bends``         what a file of straight edges says of the nodes at an edge's bends (``app.model.bends``)
topology   ``blocked``       true: nobody is to take the edge, until ``blocked_until`` (an RFC 3339 time)
zones      ``value``         what the kind needs: a speed in m/s, a priority …
zones      ``expires``       RFC 3339 time at which the zone ends
objects    ``pose``          [x, y, z, roll, pitch, yaw], metres and radians, local frame
objects    ``size``          [x, y, z], metres
objects    ``shapes``        its solids, see ``app.model.solids``
objects    ``height``        metres of an extruded footprint's top above the level's floor
objects    ``base``          metres of its underside above the level's floor, else 0
objects    ``width``         metres across a line or a point
all        ``<format>``      what only that format knows of the item, kept for the way back
========== ================= =========================================================================================
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.errors import Invalid, MissingDatum, Problem
from app.model.frame import MAX_METRES, Anchor, is_writable
from app.model.geodesy import LocalFrame

Properties = Mapping[str, Any]
"""JSON-like: keys are texts, values None, bool, int (64 bit), finite float, text, list or mapping of these."""

NO_GEOMETRY = shapely.GeometryCollection()
"""The geometry of an item that has none (a KML placemark without one): never None, so that arrays stay plain."""

MAX_ID = 512


@dataclass(frozen=True, slots=True)
class Feature:
    """One item of a collection, for code that looks at few of them."""

    id: str
    geometry: Any
    properties: Properties
    anchor: Anchor


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """n features as parallel columns, checked when made and never changed.

    ids: n distinct texts. geometry: object array [n] of shapely geometries. properties: n mappings.
    local: bool array [n], True where the coordinates are metres in the local frame.
    document: what the source says of the collection as a whole (a network's name, a drawing's styles), by format.
    """

    ids: tuple[str, ...]
    geometry: NDArray[np.object_]
    properties: tuple[Properties, ...]
    local: NDArray[np.bool_]
    document: Properties = field(default_factory=dict)

    def __post_init__(self) -> None:
        n = len(self.ids)
        if not n == len(self.geometry) == len(self.properties) == len(self.local):
            raise ValueError(
                f"columns differ: {n} ids, {len(self.geometry)} geometries, {len(self.properties)} properties"
            )
        if self.local.dtype != bool or self.local.ndim != 1:
            raise ValueError(f"local must be bool [{n}], got {self.local.dtype} {self.local.shape}")
        if not bool(shapely.is_geometry(self.geometry).all()):
            raise ValueError("geometry must hold shapely geometries; NO_GEOMETRY stands for none")
        if len(set(self.ids)) != n:
            twice = next(i for i, seen in _repeats(self.ids) if seen)
            raise Invalid(f"two features of one collection have the id {twice!r}")
        for i in self.ids:
            if not i or len(i) > MAX_ID or not is_writable(i):
                bad = [Problem(f"an id must have 1 to {MAX_ID} characters, no control characters", where=repr(i[:80]))]
                raise Invalid(f"the id {i[:80]!r} cannot be used", bad)
        _check_coordinates(self)
        self.geometry.flags.writeable = False
        self.local.flags.writeable = False

    def __len__(self) -> int:
        return len(self.ids)

    def __iter__(self) -> Iterator[Feature]:
        for i, g, p, local in zip(self.ids, self.geometry, self.properties, self.local, strict=True):
            yield Feature(i, g, p, "local" if local else "wgs84")

    def select(self, index: NDArray[np.bool_] | NDArray[np.intp] | Sequence[int]) -> Features:
        """The features at these places (a boolean mask or indexes), with the same document."""
        indices = np.asarray(index)
        indices = np.flatnonzero(indices) if indices.dtype == bool else indices.astype(np.intp)
        return Features(
            tuple(self.ids[k] for k in indices),
            self.geometry[indices],
            tuple(self.properties[k] for k in indices),
            self.local[indices],
            self.document,
        )

    def select_kinds(self, *kinds: str) -> Features:
        """The features whose ``kind`` is one of these."""
        return self.select([k for k, p in enumerate(self.properties) if p.get("kind") in kinds])

    def index(self) -> dict[str, int]:
        """id -> place."""
        return {i: k for k, i in enumerate(self.ids)}

    def with_document(self, document: Properties) -> Features:
        """The same features under another document."""
        return replace(self, document=document)

    @property
    def needs_datum(self) -> bool:
        """Whether any item stands on earth, so that metres need a datum."""
        return bool(len(self.ids)) and not bool(self.local.all())

    def in_local(self, frame: LocalFrame | None) -> NDArray[np.object_]:
        """All geometries in metres; MissingDatum if any is on earth and there is no frame."""
        return self._geometries_in(True, frame)

    def in_wgs84(self, frame: LocalFrame | None) -> NDArray[np.object_]:
        """All geometries in (longitude, latitude); MissingDatum if any is local and there is no frame."""
        return self._geometries_in(False, frame)

    def _geometries_in(self, local: bool, frame: LocalFrame | None) -> NDArray[np.object_]:
        other = self.local != local
        if not other.any():
            return self.geometry
        if frame is None:
            raise MissingDatum(
                "the environment has no datum, so places on earth and local metres cannot be brought together: "
                'set one with PATCH /api/v1/environments/{env} {"datum": {"latitude": …, "longitude": …}} '
                "or upload a datum.yaml"
            )
        out = self.geometry.copy()
        change = frame.geometries_to_local if local else frame.geometries_to_wgs84
        out[other] = change(self.geometry[other])
        return out


def features(
    rows: Iterable[tuple[str, Any, Properties]], anchor: Anchor, document: Properties | None = None
) -> Features:
    """A collection from (id, shapely geometry or None, properties), all with one anchor."""
    listed = list(rows)
    geometry = np.empty(len(listed), object)
    for k, (_, g, _) in enumerate(listed):
        geometry[k] = NO_GEOMETRY if g is None else g
    return Features(
        tuple(i for i, _, _ in listed),
        geometry,
        tuple(p for _, _, p in listed),
        np.full(len(listed), anchor == "local"),
        document or {},
    )


def from_columns(
    ids: Sequence[str],
    geometry: NDArray[np.object_],
    properties: Sequence[Properties],
    anchor: Anchor,
    document: Properties | None = None,
) -> Features:
    """A collection from columns, all with one anchor: the quick way for readers that work with arrays."""
    return Features(tuple(ids), geometry, tuple(properties), np.full(len(ids), anchor == "local"), document or {})


def concatenate(collections: Sequence[Features]) -> Features:
    """All features of several collections; documents are merged, later ones win. Ids must be distinct."""
    document: Properties = {}
    for c in collections:
        document = merge_documents(document, c.document)
    geometry = np.concatenate([c.geometry for c in collections]) if collections else np.empty(0, object)
    local = np.concatenate([c.local for c in collections]) if collections else np.empty(0, bool)
    return Features(
        tuple(i for c in collections for i in c.ids),
        geometry,
        tuple(p for c in collections for p in c.properties),
        local,
        document,
    )


def merge_documents(a: Properties, b: Properties) -> dict[str, Any]:
    """Both mappings as one, nested ones too: so the drawings of several files keep their styles side by side.

    Where both say something else of the same key and not both with a mapping, ``b`` wins.
    """
    out = dict(a)
    for key, value in b.items():
        old_value = out.get(key)
        nested = isinstance(old_value, Mapping) and isinstance(value, Mapping)
        out[key] = merge_documents(old_value, value) if nested and old_value is not None else value
    return out


def shared_key_dict(*keys: str) -> dict[str, Any]:
    """A mapping with these keys, all None, whose copies (``.copy()``, then set) share its table of keys.

    Such a copy is a usual dict that takes little more than half the memory: for readers that make very many mappings
    of the same keys (PEP 412; a copy that gets another key becomes one with a table of its own).
    """

    if any(key.startswith("__") for key in keys):  # names that Python gives a meaning
        return dict.fromkeys(keys)

    class Pattern:
        pass

    holder = Pattern()
    for _ in range(64):  # the first instances keep room for keys to come
        holder = Pattern()
        for key in keys:
            setattr(holder, key, None)
    return vars(holder)


class SharedKeyDicts:
    """Mappings -> the same ones in less memory: those with the same keys share their table of keys
    (``shared_key_dict``)."""

    MAX_LAYOUTS = 256
    """Tables that are kept."""

    def __init__(self) -> None:
        self._patterns: dict[tuple[str, ...], dict[str, Any]] = {}

    def __call__(self, mapping: dict[str, Any]) -> dict[str, Any]:
        """The mapping, with its keys in their order."""
        keys = tuple(mapping)
        pattern = self._patterns.get(keys)
        if pattern is None:
            if len(self._patterns) >= self.MAX_LAYOUTS:
                return mapping
            pattern = self._patterns[keys] = shared_key_dict(*keys)
        out = pattern.copy()
        for key, value in mapping.items():
            out[key] = value
        return out


def points(coordinates: NDArray[np.float64]) -> NDArray[np.object_]:
    """Point geometries from float64 [n, 2] or [n, 3]."""
    return np.asarray(shapely.points(coordinates), object).reshape(len(coordinates))


def segments(starts: NDArray[np.float64], ends: NDArray[np.float64]) -> NDArray[np.object_]:
    """Two-point LineStrings from float64 [n, 2 or 3] starts and ends."""
    return np.asarray(shapely.linestrings(np.stack([starts, ends], axis=1)), object).reshape(len(starts))


def unique_ids(names: Iterable[str], taken: set[str] | None = None) -> list[str]:
    """The names as distinct ids: a repeated one gets ``#2``, ``#3`` … (names may repeat in files, ids may not)."""
    used = set(taken or ())
    counts: dict[str, int] = {}
    out = []
    for name in names:
        candidate = name
        while candidate in used:
            counts[name] = counts.get(name, 1) + 1
            candidate = f"{name}#{counts[name]}"
        used.add(candidate)
        out.append(candidate)
    return out


def _repeats(ids: Iterable[str]) -> Iterator[tuple[str, bool]]:
    seen: set[str] = set()
    for i in ids:
        yield i, i in seen
        seen.add(i)


def _check_coordinates(f: Features) -> None:
    """Finite everywhere; metres within MAX_METRES; latitude within ±90 and longitude within ±180 degrees."""
    for first in range(0, len(f.ids), CHECKED):
        some = slice(first, first + CHECKED)
        _check_batch(f.ids[some], f.geometry[some], f.local[some])


CHECKED = 2**15
"""Features that are checked at a time: the coordinates of all would take as much memory as the features do."""


def _check_batch(ids: Sequence[str], geometry: NDArray[np.object_], is_local: NDArray[np.bool_]) -> None:
    coordinates, owner = shapely.get_coordinates(geometry, include_z=True, return_index=True)
    flat, z = coordinates[:, :2], coordinates[:, 2]
    # shapely gives NaN as the z of a 2-D geometry: only a 3-D one's z is looked at.
    deep = shapely.has_z(geometry)[owner]
    local = is_local[owner]
    bound = np.where(local[:, None], MAX_METRES, np.array([180.0, 90.0]))
    good = (np.abs(flat) <= bound).all(axis=1) & (~deep | (np.abs(z) <= MAX_METRES))
    if not good.all():
        k = int(owner[np.flatnonzero(~good)[0]])
        at = coordinates[np.flatnonzero(~good)[0]]
        kind = "metres within ±1e7" if is_local[k] else "longitude within ±180 and latitude within ±90 degrees"
        place = ", ".join(f"{v:g}" for v in (at if deep[np.flatnonzero(~good)[0]] else at[:2]))
        raise Invalid(
            f"feature {ids[k]!r} has the coordinates ({place}); they must be finite {kind}",
            [Problem(f"coordinates ({place}) are not finite {kind}", where=ids[k])],
        )

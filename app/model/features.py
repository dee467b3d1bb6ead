"""Vector layers: location, objects, topology and zones are collections of features.

A feature has a stable id, a geometry, JSON-like properties and an anchor: ``local`` coordinates are (x, y[, z]) in
metres in the environment's local frame, ``wgs84`` ones (longitude, latitude[, altitude]) in degrees and metres. Items
are stored as they are anchored, so a round trip loses nothing and a new datum moves no wgs84 item.

Property names that all formats share, in ``properties``:

========== ================= =========================================================================================
layer      property          meaning
========== ================= =========================================================================================
all        ``kind``          kind of item: ``node``, ``edge``, ``region``, ``poi``, ``building``, ``keepout`` …
all        ``name``          the name people and robots use; need not be unique
topology   ``source``        id of the node an edge starts at (edges only)
topology   ``target``        id of the node an edge ends at (edges only; an edge is directed)
topology   ``area``          name of the area that a node is in: a zone of kind ``room``, ``aisle`` …
topology   ``orientation``   [x, y, z, w], the quaternion of a node's pose in the local frame, as in its source
topology   ``action``        action of a robot along an edge
topology   ``speed_limit``   metres per second along an edge
topology   ``width``         metres of free width along an edge
topology   ``surface``       surface of an edge's ground (``asphalt``, ``gravel``: OpenStreetMap's values)
topology   ``access``        right to use an edge (``yes``, ``private``, ``no`` …: OpenStreetMap's values)
topology   ``stairs``        true if an edge leads over steps
topology   ``bends``         properties of the nodes at an edge's bends, from a straight-edge file (``app.model.bends``)
topology   ``blocked``       true: no robot may use the edge, until ``blocked_until`` (an RFC 3339 time)
zones      ``value``         value for the kind: a speed in m/s, a priority …
zones      ``expires``       RFC 3339 time at which the zone ends
objects    ``pose``          [x, y, z, roll, pitch, yaw], metres and radians, local frame
objects    ``size``          [x, y, z], metres
objects    ``shapes``        its solids, see ``app.model.solids``
objects    ``height``        metres of an extruded footprint's top above the level's floor
objects    ``base``          metres of its underside above the level's floor, else 0
objects    ``width``         metres across a line or a point
all        ``<format>``      format-specific data of the item, stored for export to that format
========== ================= =========================================================================================
"""

from __future__ import annotations

import hashlib
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
"""JSON-like value: None, bool, int (64 bit), finite float, text, or a list or mapping (with text keys) of these."""

NO_GEOMETRY = shapely.GeometryCollection()
"""Geometry of an item without one (a KML placemark, for example): never None, so that arrays stay plain."""

MAX_ID = 512


@dataclass(frozen=True, slots=True)
class Feature:
    """One item of a collection, for code that reads few of them."""

    id: str
    geometry: Any
    properties: Properties
    anchor: Anchor


@dataclass(frozen=True, slots=True, eq=False)
class Features:
    """n features as parallel columns, checked at construction and immutable.

    ids: n distinct texts. geometry: object array [n] of shapely geometries. properties: n mappings.
    local: bool array [n], True if the coordinates are metres in the local frame.
    document: the source's data about the whole collection (a network's name, a drawing's styles), by format.
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
            raise ValueError("geometry must contain shapely geometries, NO_GEOMETRY for an absent one")
        if len(set(self.ids)) != n:
            twice = next(i for i, seen in _repeats(self.ids) if seen)
            raise Invalid(f"duplicate feature id {twice!r} in one collection")
        for i in self.ids:
            if not i or len(i) > MAX_ID or not is_writable(i):
                bad = [
                    Problem(f"an id must have 1 to {MAX_ID} characters and no control characters", where=repr(i[:80]))
                ]
                raise Invalid(f"invalid id {i[:80]!r}", bad)
        _check_coordinates(self)
        self.geometry.flags.writeable = False
        self.local.flags.writeable = False

    def __len__(self) -> int:
        return len(self.ids)

    def __iter__(self) -> Iterator[Feature]:
        for i, g, p, local in zip(self.ids, self.geometry, self.properties, self.local, strict=True):
            yield Feature(i, g, p, "local" if local else "wgs84")

    def select(self, index: NDArray[np.bool_] | NDArray[np.intp] | Sequence[int]) -> Features:
        """Return the features at these indices (or of a boolean mask), with the same document."""
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
        """Return the features whose ``kind`` is one of these."""
        return self.select([k for k, p in enumerate(self.properties) if p.get("kind") in kinds])

    def index(self) -> dict[str, int]:
        """id -> place."""
        return {i: k for k, i in enumerate(self.ids)}

    def with_document(self, document: Properties) -> Features:
        """Return the same features with another document."""
        return replace(self, document=document)

    @property
    def needs_datum(self) -> bool:
        """Return whether any item is on earth, so that metres need a datum."""
        return bool(len(self.ids)) and not bool(self.local.all())

    def in_local(self, frame: LocalFrame | None) -> NDArray[np.object_]:
        """Return all geometries in metres. Raises MissingDatum if any is on earth and there is no frame."""
        return self._geometries_in(True, frame)

    def in_wgs84(self, frame: LocalFrame | None) -> NDArray[np.object_]:
        """Return all geometries in (longitude, latitude). Raises MissingDatum if any is local and there is no frame."""
        return self._geometries_in(False, frame)

    def _geometries_in(self, local: bool, frame: LocalFrame | None) -> NDArray[np.object_]:
        other = self.local != local
        if not other.any():
            return self.geometry
        if frame is None:
            raise MissingDatum(
                "the environment has no datum, which is needed to convert between WGS 84 and local metres: "
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
    """Build a collection from (id, shapely geometry or None, properties), all with one anchor."""
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
    """Build a collection from columns, all with one anchor: faster, for readers that work with arrays."""
    return Features(tuple(ids), geometry, tuple(properties), np.full(len(ids), anchor == "local"), document or {})


def concatenate(collections: Sequence[Features]) -> Features:
    """Join the features of several collections; documents are merged, later ones win. Ids must be distinct."""
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
    """Merge two mappings, including nested ones, so that drawings of several files keep their styles side by side.

    If both have different values for a key and these are not both mappings, ``b`` wins.
    """
    out = dict(a)
    for key, value in b.items():
        old_value = out.get(key)
        nested = isinstance(old_value, Mapping) and isinstance(value, Mapping)
        out[key] = merge_documents(old_value, value) if nested and old_value is not None else value
    return out


def shared_key_dict(*keys: str) -> dict[str, Any]:
    """Create a mapping with these keys, all None, whose copies (``.copy()``, then set) share its table of keys.

    A copy is an ordinary dict that takes little more than half the memory: for readers that create very many mappings
    of the same keys (PEP 412; a copy that gets another key becomes one with a table of its own).
    """

    if any(key.startswith("__") for key in keys):  # Python reserves such names
        return dict.fromkeys(keys)

    class Pattern:
        pass

    holder = Pattern()
    for _ in range(64):  # the first instances reserve room for further keys
        holder = Pattern()
        for key in keys:
            setattr(holder, key, None)
    return vars(holder)


class SharedKeyDicts:
    """Converter of mappings that saves memory: equal sets of keys share one table (``shared_key_dict``)."""

    MAX_LAYOUTS = 256
    """Maximum number of cached tables."""

    def __init__(self) -> None:
        self._patterns: dict[tuple[str, ...], dict[str, Any]] = {}

    def __call__(self, mapping: dict[str, Any]) -> dict[str, Any]:
        """Return the mapping, with its keys in the same order."""
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
    """Create point geometries from float64 [n, 2] or [n, 3]."""
    return np.asarray(shapely.points(coordinates), object).reshape(len(coordinates))


def segments(starts: NDArray[np.float64], ends: NDArray[np.float64]) -> NDArray[np.object_]:
    """Create two-point LineStrings from float64 [n, 2 or 3] starts and ends."""
    return np.asarray(shapely.linestrings(np.stack([starts, ends], axis=1)), object).reshape(len(starts))


def unique_ids(names: Iterable[str], taken: set[str] | None = None) -> list[str]:
    """Make names distinct ids: a repeated one gets ``#2``, ``#3`` … (names may repeat in files, ids may not)."""
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


def short_id(text: str, limit: int = MAX_ID - 12) -> str:
    """Return the text, or, if it is too long for an id, its beginning and a hash of all of it.

    The default limit leaves room for what makes it unique.
    """
    if len(text) <= limit:
        return text
    return f"{text[: limit - 18]}~{hashlib.blake2b(text.encode(), digest_size=8).hexdigest()}"


def _repeats(ids: Iterable[str]) -> Iterator[tuple[str, bool]]:
    seen: set[str] = set()
    for i in ids:
        yield i, i in seen
        seen.add(i)


def _check_coordinates(f: Features) -> None:
    """Check coordinates: finite, metres within MAX_METRES, latitude within ±90, longitude within ±180 degrees."""
    for first in range(0, len(f.ids), CHECKED):
        some = slice(first, first + CHECKED)
        _check_batch(f.ids[some], f.geometry[some], f.local[some])


CHECKED = 2**15
"""Number of features that are checked at a time: all coordinates would take as much memory as the features."""


def _check_batch(ids: Sequence[str], geometry: NDArray[np.object_], is_local: NDArray[np.bool_]) -> None:
    coordinates, owner = shapely.get_coordinates(geometry, include_z=True, return_index=True)
    flat, z = coordinates[:, :2], coordinates[:, 2]
    # shapely gives NaN as the z of a 2-D geometry: only the z of 3-D ones is checked
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

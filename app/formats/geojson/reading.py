"""Read GeoJSON and JSON-FG: features as parts of layers, in degrees or in metres."""

from __future__ import annotations

import re
from typing import Any, NoReturn, cast

import numpy as np
import orjson
import shapely
from numpy.typing import NDArray

from app.errors import Invalid, Problem, TooLarge, UnreadableFile
from app.formats import Files, ReadContext
from app.formats.geojson.geometry import parse_geometries
from app.formats.geojson.words import FAMILY, GEOMETRIES, LOCAL_2D, OWN_FRAME, OWN_MEMBER
from app.model.antimeridian import cut_at_antimeridian
from app.model.features import MAX_ID, Features, Properties, unique_ids
from app.model.frame import MAX_METRES, Datum, Level
from app.model.geodesy import local_frame
from app.model.layers import NETWORK, VECTOR_LAYERS, Layer, Layers, Part, PartKey
from app.syntax import json

_EARTH = re.compile(r"(?i)(?:.*\b(?:CRS84h?|WGS ?84)|.*EPSG(?::|/)[^/]*(?::|/)?(?:4326|4979)\b)")
ROUNDED = 2e-7
"""Distance in degrees (2 cm) beyond which ``geometry`` differs from ``place`` by more than rounding to 7 decimals."""

_METRES = {"Engineering2D", "Engineering3D"}


def read(files: Files, context: ReadContext) -> Layers:
    """Read objects, and the layers that our own data describes.

    Raises UnreadableFile (with a line if known) for files that are not GeoJSON, for numbers that are not finite, for
    positions that are not on earth and for coordinate systems other than WGS 84; TooLarge beyond the limits.
    """
    data = files[context.main].removeprefix(b"\xef\xbb\xbf")
    top = json.load(data, context.limits)
    return _Reader(data, top, context).layers()


def _has_own_members(p: Any) -> bool:
    """Whether these properties contain our own data."""
    return (
        isinstance(p, dict)
        and "part" in p
        and isinstance(p.get("layer"), str)
        and p["layer"] in VECTOR_LAYERS
        and isinstance(p.get("level"), str)
        and isinstance(p["part"], str)
    )


def _raise_unreadable(reason: str, line: int | None = None, location: str | None = None) -> NoReturn:
    raise UnreadableFile(f"{location}: {reason}" if location else reason, [Problem(reason, line=line, where=location)])


def _is_box(box: Any) -> bool:
    """Whether these are four or six numbers, corner after corner, within the range of longitudes and latitudes."""
    if not isinstance(box, list) or len(box) not in (4, 6):
        return False
    numbers = [float(v) for v in box if isinstance(v, (int, float)) and not isinstance(v, bool)]
    if len(numbers) < len(box):
        return False
    half = len(numbers) // 2
    west, south, east, north = numbers[0], numbers[1], numbers[half], numbers[half + 1]
    return max(abs(west), abs(east)) <= 180.0 and -90.0 <= south <= north <= 90.0


class _Reader:
    def __init__(self, data: bytes, top: Any, context: ReadContext) -> None:
        self.data = data
        self.context = context
        if not isinstance(top, dict):
            _raise_unreadable("GeoJSON must be one object with a type", 1)
        self.top = top
        self.root = str(top.get("type"))
        self.rows = self._rows()
        self.marks = [_has_own_members(row.get("properties")) for row in self.rows]
        if len(self.rows) > context.limits.features:
            raise TooLarge(f"{context.main} has {len(self.rows)} features; the limit is {context.limits.features}")
        reference = top.get("coordRefSys")
        self.local = self._is_local(reference)
        self.in_own_frame = self.local and isinstance(reference, str) and OWN_FRAME.fullmatch(reference) is not None
        self._check_crs(top.get("crs"), None)

    def _rows(self) -> list[dict[str, Any]]:
        if self.root == "FeatureCollection":
            rows = self.top.get("features")
            if not isinstance(rows, list):
                _raise_unreadable("a FeatureCollection needs an array called features", 1)
            for k, row in enumerate(rows):
                if not isinstance(row, dict) or row.get("type") != "Feature":
                    _raise_unreadable(
                        "every member of features must be an object of type Feature", self.line(k), f"features[{k}]"
                    )
            return rows
        if self.root == "Feature":
            return [self.top]
        if self.root in GEOMETRIES:
            return [{"type": "Feature", "geometry": self.top, "properties": None}]
        _raise_unreadable(f"unsupported type {self.root[:40]!r}: must be FeatureCollection, Feature or a geometry", 1)

    def line(self, k: int) -> int | None:
        """Return the line where feature k begins, assuming that features contain no features."""
        line_number = None
        for n, match in enumerate(re.finditer(rb'"type"\s*:\s*"Feature"', self.data)):
            if n == k:
                line_number = self.data.count(b"\n", 0, match.start()) + 1
        return line_number

    def _is_local(self, reference: Any) -> bool:
        """Whether ``coordRefSys`` names a local engineering frame."""
        if isinstance(reference, dict):
            reference = reference.get("href")
        if not isinstance(reference, str):
            return False
        return reference.rstrip("/").rpartition("/")[2] in _METRES or self._is_frame_here(reference)

    def _is_frame_here(self, reference: str) -> bool:
        """Whether this names the frame of an environment whose datum is ours; a new environment takes it over."""
        if OWN_FRAME.fullmatch(reference) is None:
            return False
        datum = self._datum_member()
        frame = self.context.frame
        if frame is None:
            return "datum" in self.top
        return frame.datum == datum

    def _datum_member(self) -> Datum | None:
        """Return the datum beside ``coordRefSys``, as our APIs write it. Raises UnreadableFile for a malformed one."""
        datum = self.top.get("datum")
        if datum is None:
            return None
        try:
            return Datum(**datum)
        except (TypeError, ValueError, Invalid) as error:
            _raise_unreadable(f"datum: {error}: give latitude, longitude, altitude and heading", 1, "datum")

    def _check_crs(self, crs: Any, location: str | None) -> None:
        """Check ``crs`` of the 2008 specification: WGS 84 in longitude, latitude, or absent."""
        if crs is None:
            return
        properties = crs.get("properties") if isinstance(crs, dict) else None
        name = properties.get("name") if isinstance(properties, dict) else None
        name = name if isinstance(name, str) else orjson.dumps(crs).decode()
        if not _EARTH.match(name) or "UTM" in name.upper():
            _raise_unreadable(
                f"the coordinates are in {name[:80]}, but GeoJSON uses degrees (WGS 84 longitude, latitude): "
                "export the file again in EPSG:4326 (a Nav2 route graph has the format nav2_route)",
                1,
                location or "crs",
            )

    # --- features ---

    def report_missing_members(self) -> None:
        """Warn about features without mandatory members, and about an unknown CRS of places."""
        for member in ("geometry", "properties"):
            lacking = [
                k
                for k, row in enumerate(self.rows)
                if member not in row and not (member == "geometry" and "place" in row)
            ]
            if lacking:
                reason = f"{len(lacking)} features lack the mandatory member {member!r}; use null for an empty one"
                self.context.warn(reason, line=self.line(lacking[0]), where=self.name(lacking[0]))
        crs = self.top.get("coordRefSys")
        if crs is not None and not self.local:
            text = crs if isinstance(crs, str) else orjson.dumps(crs).decode()
            if not _EARTH.match(text):
                reason = f"{text[:80]} is unsupported; only `geometry` (WGS 84) is read, `place` is ignored"
                self.context.warn(reason, where="coordRefSys")
        box = self.top.get("bbox")
        if box is not None and not _is_box(box):
            self.context.warn("not a box [west, south, east, north] in degrees; it is stored unchanged", where="bbox")

    def layers(self) -> Layers:
        self.report_missing_members()
        extension = self.top.get(OWN_MEMBER)
        extension = extension if isinstance(extension, dict) else {}
        network = self._network()
        keys = [self._key(k, network) for k in range(len(self.rows))]
        raw = [self._read_geometry(k, row) for k, row in enumerate(self.rows)]
        local = np.array([is_local for is_local, _ in raw], bool)
        shapes, odd = parse_geometries(
            [g for _, g in raw], lambda k, reason: _raise_unreadable(reason, self.line(k), self.name(k))
        )
        datum = extension.get("datum")
        datum = Datum(**datum) if isinstance(datum, dict) else self._datum_member() if self.in_own_frame else None
        self._check_places(shapes, local)
        self._compare_geometry(shapes, local, datum)
        groups: dict[PartKey, list[int]] = {}
        for k, key in enumerate(keys):
            groups.setdefault(key, []).append(k)
        documents = self._documents(extension)
        parts: dict[PartKey, Part] = {}
        home = PartKey("objects", self.context.level, FAMILY)
        for key in dict.fromkeys([*groups, *documents]):
            places = groups.get(key, [])
            document = documents.get(key, {})
            if key == home:
                document = {**document, **self._document()}
            file_ids = [self._requested_id(k, self.rows[k]) for k in places]
            ids = unique_ids(file_ids)
            repeats = [a for a, b in zip(ids, file_ids, strict=True) if a != b]
            if repeats:
                self.context.warn(f"{len(repeats)} duplicate ids; later ones got #2, #3 …", where=repeats[0])
            rows = [
                self._properties(
                    k,
                    i,
                    foreign=not self.marks[k] and key == home,
                    odd=odd.get(k),
                    at=(shapes[k], bool(local[k])),
                )
                for k, i in zip(places, ids, strict=True)
            ]
            parts[key] = Features(tuple(ids), shapes[places], tuple(rows), local[places], document)
        if home not in parts and not parts:
            parts[home] = Features((), np.empty(0, object), (), np.empty(0, bool), self._document())
        levels = extension.get("levels")
        return Layers(
            parts,
            datum,
            tuple(Level(**v) for v in levels) if isinstance(levels, list) else (Level(),),
        )

    def name(self, k: int) -> str:
        row = self.rows[k]
        return f"feature {row['id']!r}" if row.get("id") is not None else f"features[{k}]"

    def _key(self, k: int, network: bool) -> PartKey:
        row = self.rows[k]
        if self.marks[k]:
            p = row["properties"]
            return PartKey(cast(Layer, p["layer"]), p["level"], p["part"])
        if network and row["properties"].get("kind") in ("node", "edge"):
            return PartKey("topology", self.context.level, NETWORK)
        return PartKey("objects", self.context.level, FAMILY)

    def _network(self) -> bool:
        """Whether the unmarked features are a topology: edges whose end nodes all exist."""
        nodes, ends = set(), []
        for row, mark in zip(self.rows, self.marks, strict=True):
            p = row.get("properties")
            if mark:
                continue
            if not isinstance(p, dict) or not isinstance(row.get("id"), str) or p.get("kind") not in ("node", "edge"):
                return False
            if p["kind"] == "node":
                nodes.add(row["id"])
            else:
                ends += [p.get("source"), p.get("target")]
        if not ends:
            return False
        stubs = [e for e in ends if not isinstance(e, str) or e not in nodes]
        if stubs:
            self.context.warn(
                f"{len(stubs)} edges begin or end at missing nodes ({str(stubs[0])[:80]}); the features are "
                "stored as objects, not as a network"
            )
        return not stubs

    def _read_geometry(self, k: int, row: dict[str, Any]) -> tuple[bool, Any]:
        """Return whether the feature is in metres, and its GeoJSON geometry or None."""
        place = row.get("place")
        if "crs" in row:
            self._check_crs(row["crs"], self.name(k))
        if isinstance(place, dict):
            crs = place.get("coordRefSys", row.get("coordRefSys"))
            if self.local if crs is None else self._is_local(crs):
                return True, place
            if row.get("geometry") is None and OWN_FRAME.fullmatch(str(crs or self.top.get("coordRefSys"))):
                reason = "place is in the local frame of an environment with another datum, and geometry is null: "
                _raise_unreadable(reason + "export the features in CRS84", self.line(k), self.name(k))
            if row.get("geometry") is None:
                self.context.warn(
                    "place is in an unsupported coordinate system; the feature is stored without a geometry",
                    line=self.line(k),
                    where=self.name(k),
                )
        geometry = row.get("geometry")
        if geometry is None and self.local and place is None and "place" in row:
            return True, None
        if geometry is not None and not isinstance(geometry, dict):
            _raise_unreadable("a geometry must be an object or null", self.line(k), self.name(k))
        return False, geometry

    def _compare_geometry(self, shapes: NDArray[np.object_], local: NDArray[np.bool_], datum: Datum | None) -> None:
        """Warn about features whose ``geometry`` is not where ``place`` is: programs edit one of the two.

        Only in files that state the datum of their metres, as ours do.
        """
        both = [k for k in np.flatnonzero(local).tolist() if isinstance(self.rows[k].get("geometry"), dict)]
        if datum is None or not both:
            return

        def refuse(k: int, reason: str) -> NoReturn:
            _raise_unreadable(f"geometry: {reason}", self.line(both[k]), self.name(both[k]))

        drawn, _ = parse_geometries([self.rows[k]["geometry"] for k in both], refuse)
        placed = local_frame(datum).geometries_to_wgs84(shapes[both])
        same = shapely.is_empty(drawn) | shapely.equals_exact(placed, drawn, tolerance=ROUNDED)
        for change in (shapely.orient_polygons, shapely.normalize, cut_at_antimeridian):
            left = np.flatnonzero(~same)
            same[left] = shapely.equals_exact(change(placed[left]), change(drawn[left]), tolerance=ROUNDED)
        moved = np.flatnonzero(~same).tolist()
        if moved:
            k = both[moved[0]]
            reason = (
                "`geometry` is elsewhere than `place`, which is used; delete `place` of what was moved in `geometry`"
            )
            self.context.warn(f"{reason} ({len(moved)} features)", line=self.line(k), where=self.name(k))

    def _check_places(self, shapes: NDArray[np.object_], local: NDArray[np.bool_]) -> None:
        coordinates, owner = shapely.get_coordinates(shapes, return_index=True)
        bound = np.where(local[owner][:, None], MAX_METRES, np.array([180.0, 90.0]))
        bad = np.flatnonzero((np.abs(coordinates) > bound).any(axis=1))
        if len(bad):
            k = int(owner[bad[0]])
            x, y = coordinates[bad[0]].tolist()
            reason = (
                f"({x:g}, {y:g}) is outside ±1e7 metres"
                if local[k]
                else (
                    f"({x:g}, {y:g}) is not longitude, latitude in degrees: use JSON-FG's place with coordRefSys "
                    f"{LOCAL_2D} for metres, or export the file in EPSG:4326"
                )
            )
            _raise_unreadable(reason, self.line(k), self.name(k))

    def _requested_id(self, k: int, row: dict[str, Any]) -> str:
        raw_id = row.get("id")
        if raw_id is None and isinstance(row.get("properties"), dict):
            raw_id = row["properties"].get("name")
            raw_id = raw_id if isinstance(raw_id, str) else None
        text = str(raw_id) if isinstance(raw_id, str | int | float) and not isinstance(raw_id, bool) else ""
        return text if text and len(text) <= MAX_ID and text.isprintable() else f"feature/{k}"

    def _properties(self, k: int, i: str, *, foreign: bool, odd: Any, at: tuple[Any, bool]) -> Properties:
        shape, metres = at
        row = self.rows[k]
        file_properties = row.get("properties")
        if file_properties is not None and not isinstance(file_properties, dict):
            _raise_unreadable("properties must be an object or null", self.line(k), self.name(k))
        out: dict[str, Any] = dict(file_properties or {})
        if not foreign:
            if not self.marks[k]:
                return out
            more = out.pop("more", None)
            for key in ("layer", "level", "part"):
                del out[key]
            return {**out, **more} if isinstance(more, dict) else out
        source_properties: dict[str, Any] = {}
        misfits = {}
        for key, fits in (("kind", str), ("name", str), (FAMILY, ())):
            if key in out and not isinstance(out[key], fits):
                misfits[key] = out.pop(key)
        if "kind" not in out:
            out["kind"] = ("note", "poi", "path", "region")[int(shapely.get_dimensions(shape)) + 1]
            source_properties["added"] = ["kind"]
        if misfits:
            source_properties["kept"] = misfits
        if row.get("id") != i or isinstance(row.get("id"), bool):
            source_properties["id"] = row.get("id")
        if file_properties is None:
            source_properties["properties"] = None
        members = {k: v for k, v in row.items() if k not in ("type", "id", "geometry", "properties")}
        if metres:
            # Written from the canonical coordinates instead.
            del members["place"]
            members.pop("coordRefSys", None)
            if self.in_own_frame:
                members.pop("datum", None)
        if self.root != "FeatureCollection":
            members = {k: v for k, v in members.items() if k != OWN_MEMBER}
        if members:
            source_properties["members"] = members
        if odd is not None:
            source_properties["geometry"] = odd
        if source_properties:
            out[FAMILY] = source_properties
        return out

    def _document(self) -> dict[str, Any]:
        handled = {"type", "features", OWN_MEMBER} if self.root == "FeatureCollection" else set(self.top)
        document: dict[str, Any] = {"type": self.root if self.root in ("FeatureCollection", "Feature") else "Geometry"}
        members = {k: v for k, v in self.top.items() if k not in handled}
        if self.top.get("coordRefSys") is not None and self.local:
            members.pop("coordRefSys", None)
            members.pop("conformsTo", None)
            if self.in_own_frame:
                members.pop("datum", None)
        if members:
            document["members"] = members
        texts = [self.top[k] for k in ("attribution", "license", "copyright") if isinstance(self.top.get(k), str)]
        return {FAMILY: document, "attribution": texts} if texts else {FAMILY: document}

    def _documents(self, extension: dict[str, Any]) -> dict[PartKey, dict[str, Any]]:
        out: dict[PartKey, dict[str, Any]] = {}
        rows = extension.get("documents")
        for row in rows if isinstance(rows, list) else []:
            if (
                isinstance(row, dict)
                and str(row.get("layer")) in VECTOR_LAYERS
                and isinstance(row.get("document"), dict)
            ):
                key = PartKey(cast(Layer, row["layer"]), str(row.get("level")), str(row.get("part")))
                out[key] = row["document"]
        return out

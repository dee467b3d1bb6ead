"""GeoJSON (RFC 7946), with JSON-FG's ``place`` (OGC 21-045r1) for what stands in metres.

**Reading.** Each feature is an object of the family ``geojson``; its properties are the object's, and whatever has no
word here comes back: ``properties.geojson`` holds the ``id`` as it stood where it is no text or repeats another's,
``members`` (foreign ones and ``bbox``), ``geometry`` as it stood where it says more than its points (a fourth
coordinate, an open ring), ``kept`` (properties that would stand for one of our words with a value of another type) and
``added`` (words that we put in). ``document.geojson`` holds the root's type and further members.

**Our own words.** Features of other layers and families carry ``layer``, ``level`` and ``part`` among their properties
(where an editor like QGIS keeps them) and go back to where they came from; ``more`` holds properties of those names. A
collection without them, whose features are nodes and edges (``kind``, ``source``, ``target``) as the API answers them,
is a topology.

**Metres never pass as degrees.** An item anchored in metres has them in ``place``, and the collection says with
``coordRefSys`` that they are in a local engineering frame (x east, y north, z up); ``geometry`` is its place on earth
where the environment has a datum, else null. ``fleet_map`` holds the datum, the levels and the parts' documents. A
collection in another coordinate system is refused: RFC 7946 knows degrees only.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from io import BytesIO
from itertools import chain
from typing import Any, NoReturn, cast

import numpy as np
import orjson
import shapely
from numpy.typing import NDArray

from app.errors import Problem, TooLarge, UnreadableFile
from app.formats import Claims, Files, Format, LayerRequirements, ReadContext, Traits, WriteContext, register
from app.model.features import MAX_ID, NO_GEOMETRY, Features, Properties, unique_ids
from app.model.frame import GROUND, MAX_METRES, Datum, Level
from app.model.layers import NETWORK, VECTOR_LAYERS, Layer, Layers, Part, PartKey
from app.syntax import json
from app.syntax.decimals import DEGREES, METRES

FAMILY = "geojson"
LOCAL_2D = "http://www.opengis.net/def/crs/OGC/0/Engineering2D"
LOCAL_3D = "http://www.opengis.net/def/crs/OGC/0/Engineering3D"
"""OGC's names for a local engineering frame: what ``coordRefSys`` says of metres in the environment's frame."""

CONFORMS = "http://www.opengis.net/spec/json-fg-1/1.0/conf/core"
OWN_MEMBER = "fleet_map"

GEOMETRIES = ("Point", "MultiPoint", "LineString", "MultiLineString", "Polygon", "MultiPolygon", "GeometryCollection")
WORDS = frozenset({"layer", "level", "part", "more"})

_EARTH = re.compile(r"(?i)(?:.*\b(?:CRS84h?|WGS ?84)|.*EPSG(?::|/)[^/]*(?::|/)?(?:4326|4979)\b)")
_METRES = {"Engineering2D", "Engineering3D"}


# --- reading -----------------------------------------------------------------------------------------------------


def detect(name: str, data: bytes) -> bool:  # noqa: ARG001
    """A JSON object of a GeoJSON type, and not the Nav2 route server's graph: that is metres in GeoJSON's clothes."""
    head = data[:65536].lstrip(b"\xef\xbb\xbf \t\r\n")
    if head[:1] != b"{":
        return False
    if b'"startid"' in data and b'"endid"' in data:
        return False
    if len(data) <= 2**20:
        try:
            top = orjson.loads(data.removeprefix(b"\xef\xbb\xbf"))
        except orjson.JSONDecodeError:
            return bool(_SAYS.search(head))
        kind = top.get("type")
        if kind in GEOMETRIES:
            return isinstance(top.get("coordinates", top.get("geometries")), list)
        return kind == "FeatureCollection" or (kind == "Feature" and "geometry" in top)
    return bool(_SAYS.search(head) or _SAYS.search(data[-4096:]))


_SAYS = re.compile(rb'"type"\s*:\s*"Feature(?:Collection)?"')


def read(files: Files, context: ReadContext) -> Layers:
    """Objects, and the layers that our own words tell of.

    Raises UnreadableFile (with a line where there is one) for what is not GeoJSON, for numbers that are not finite, for
    places that are not on earth and for coordinate systems other than WGS 84; TooLarge beyond the limits.
    """
    data = files[context.main].removeprefix(b"\xef\xbb\xbf")
    top = json.load(data, context.limits)
    return _Reader(data, top, context).layers()


def _has_own_members(p: Any) -> bool:
    """Whether these properties carry our own words."""
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
    """Whether these are four or six numbers, corner after corner, within the earth's longitudes and latitudes."""
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
            _raise_unreadable("GeoJSON is one object with a type", 1)
        self.top = top
        self.root = str(top.get("type"))
        self.rows = self._rows()
        self.marks = [_has_own_members(row.get("properties")) for row in self.rows]
        if len(self.rows) > context.limits.features:
            raise TooLarge(f"{context.main} has {len(self.rows)} features; the limit is {context.limits.features}")
        self.local = self._is_local(top.get("coordRefSys"))
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
        _raise_unreadable(
            f"{self.root[:40]!r} is no GeoJSON type: FeatureCollection, Feature or a geometry is needed", 1
        )

    def line(self, k: int) -> int | None:
        """The line where feature k begins, as far as the text tells: features seldom hold features."""
        line_number = None
        for n, match in enumerate(re.finditer(rb'"type"\s*:\s*"Feature"', self.data)):
            if n == k:
                line_number = self.data.count(b"\n", 0, match.start()) + 1
        return line_number

    def _is_local(self, reference: Any) -> bool:
        """Whether ``coordRefSys`` names a local engineering frame."""
        if isinstance(reference, dict):
            reference = reference.get("href")
        return isinstance(reference, str) and reference.rstrip("/").rpartition("/")[2] in _METRES

    def _check_crs(self, crs: Any, location: str | None) -> None:
        """The ``crs`` of the 2008 specification: WGS 84 in longitude, latitude or nothing."""
        if crs is None:
            return
        properties = crs.get("properties") if isinstance(crs, dict) else None
        name = properties.get("name") if isinstance(properties, dict) else None
        name = name if isinstance(name, str) else orjson.dumps(crs).decode()
        if not _EARTH.match(name) or "UTM" in name.upper():
            _raise_unreadable(
                f"its coordinates are in {name[:80]}, but GeoJSON means degrees (WGS 84 longitude, latitude): export "
                "it again in EPSG:4326 (a Nav2 route graph is the format nav2_route)",
                1,
                location or "crs",
            )

    # --- features ---

    def report_missing_members(self) -> None:
        """Report features without the members that every feature has, and a CRS of places that is not known."""
        for member in ("geometry", "properties"):
            lacking = [
                k
                for k, row in enumerate(self.rows)
                if member not in row and not (member == "geometry" and "place" in row)
            ]
            if lacking:
                reason = (
                    f"{len(lacking)} features have no member {member!r}: each must have one, null where there is none"
                )
                self.context.warn(reason, line=self.line(lacking[0]), where=self.name(lacking[0]))
        crs = self.top.get("coordRefSys")
        if crs is not None and not self.local:
            text = crs if isinstance(crs, str) else orjson.dumps(crs).decode()
            if not _EARTH.match(text):
                reason = f"{text[:80]} is unsupported: only `geometry` (WGS 84) is read, `place` is ignored"
                self.context.warn(reason, where="coordRefSys")
        box = self.top.get("bbox")
        if box is not None and not _is_box(box):
            self.context.warn("is no box [west, south, east, north] in degrees; it is kept", where="bbox")

    def layers(self) -> Layers:
        self.report_missing_members()
        extension = self.top.get(OWN_MEMBER)
        extension = extension if isinstance(extension, dict) else {}
        network = self._network()
        keys = [self._key(k, network) for k in range(len(self.rows))]
        raw = [self._read_geometry(k, row) for k, row in enumerate(self.rows)]
        local = np.array([is_local for is_local, _ in raw], bool)
        shapes, odd = _geometries(
            [g for _, g in raw], lambda k, reason: _raise_unreadable(reason, self.line(k), self.name(k))
        )
        self._check_places(shapes, local)
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
                self.context.warn(f"{len(repeats)} ids stand more than once; later ones got #2, #3 …", where=repeats[0])
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
        datum = extension.get("datum")
        levels = extension.get("levels")
        return Layers(
            parts,
            Datum(**datum) if isinstance(datum, dict) else None,
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
        """Whether the unmarked features are a topology: edges whose ends are all there."""
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
                f"{len(stubs)} edges begin or end at nodes that are not there ({str(stubs[0])[:80]}): the features are "
                "kept as objects, not as a network"
            )
        return not stubs

    def _read_geometry(self, k: int, row: dict[str, Any]) -> tuple[bool, Any]:
        """(whether it is in metres, the GeoJSON geometry or None)."""
        place = row.get("place")
        if "crs" in row:
            self._check_crs(row["crs"], self.name(k))
        if isinstance(place, dict):
            crs = place.get("coordRefSys", row.get("coordRefSys"))
            if self.local if crs is None else self._is_local(crs):
                return True, place
            if row.get("geometry") is None:
                self.context.warn(
                    "its place is in a coordinate system that is not known here; it is kept without a geometry",
                    line=self.line(k),
                    where=self.name(k),
                )
        geometry = row.get("geometry")
        if geometry is None and self.local and place is None and "place" in row:
            return True, None
        if geometry is not None and not isinstance(geometry, dict):
            _raise_unreadable("a geometry must be an object or null", self.line(k), self.name(k))
        return False, geometry

    def _check_places(self, shapes: NDArray[np.object_], local: NDArray[np.bool_]) -> None:
        coordinates, owner = shapely.get_coordinates(shapes, return_index=True)
        bound = np.where(local[owner][:, None], MAX_METRES, np.array([180.0, 90.0]))
        bad = np.flatnonzero((np.abs(coordinates) > bound).any(axis=1))
        if len(bad):
            k = int(owner[bad[0]])
            x, y = coordinates[bad[0]].tolist()
            reason = (
                f"({x:g}, {y:g}) is beyond ±1e7 metres"
                if local[k]
                else f"({x:g}, {y:g}) is no longitude, latitude in degrees: metres belong into JSON-FG's place, with "
                f"coordRefSys {LOCAL_2D}, or the file must be exported in EPSG:4326"
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
            # Written again from the canonical coordinates.
            del members["place"]
            members.pop("coordRefSys", None)
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


# --- geometries --------------------------------------------------------------------------------------------------

RaiseUnreadable = Callable[[int, str], NoReturn]


def _geometries(raw: Sequence[Any], refuse: RaiseUnreadable) -> tuple[NDArray[np.object_], dict[int, Any]]:
    """Shapely geometries of GeoJSON ones, and by place those whose text says more than the shape."""
    out = np.empty(len(raw), object)
    odd: dict[int, Any] = {}
    plain: dict[str, list[int]] = {"Point": [], "LineString": []}
    single: list[int] = []
    for k, geometry in enumerate(raw):
        if geometry is None:
            out[k] = NO_GEOMETRY
        elif len(geometry) == 2 and isinstance(geometry.get("coordinates"), list) and geometry["coordinates"]:
            kind = geometry.get("type")
            (plain[kind] if kind in ("Point", "LineString") else single).append(k)
        else:
            single.append(k)
    # Nearly all features of a network are points and lines in two dimensions: those are made at once.
    at = [raw[k]["coordinates"] for k in plain["Point"]]
    if at and _flat(at):
        out[plain["Point"]] = shapely.points(np.array(at, np.float64))
    else:
        single += plain["Point"]
    lines = [raw[k]["coordinates"] for k in plain["LineString"]]
    rows = list(chain.from_iterable(lines))
    sizes = list(map(len, lines))
    if lines and min(sizes) > 1 and _flat(rows):
        owner = np.repeat(np.arange(len(lines)), sizes)
        out[plain["LineString"]] = shapely.linestrings(np.array(rows, np.float64), indices=owner)
    else:
        single += plain["LineString"]
    for k in sorted(single):
        one = _GeometryParser()
        try:
            out[k] = one.shape(raw[k])
        except (ValueError, shapely.errors.GEOSException) as error:
            refuse(k, str(error))
        if one.odd or out[k].is_empty:
            odd[k] = raw[k]
    return out, odd


def _flat(rows: list[Any]) -> bool:
    """Whether these are positions of two numbers each."""
    return (
        set(map(type, rows)) == {list}
        and set(map(len, rows)) == {2}
        and set(map(type, chain.from_iterable(rows))) <= {int, float}
    )


class _GeometryParser:
    """One GeoJSON geometry -> shapely. odd: the text says something that the shape does not."""

    def __init__(self) -> None:
        self.odd = False

    def shape(self, geometry: Any) -> Any:
        if not isinstance(geometry, dict) or geometry.get("type") not in GEOMETRIES:
            kind = geometry.get("type") if isinstance(geometry, dict) else geometry
            raise ValueError(f"{str(kind)[:40]!r} is no geometry type of GeoJSON")
        kind = geometry["type"]
        inner = geometry.get("geometries" if kind == "GeometryCollection" else "coordinates")
        if not isinstance(inner, list):
            raise ValueError(f"a {kind} needs its coordinates as an array")
        if len(geometry) > 2:
            self.odd = True
        if kind == "GeometryCollection":
            return shapely.GeometryCollection([self.shape(g) for g in inner])
        if not inner:
            self.odd = True
            return NO_GEOMETRY
        if kind == "Point":
            return shapely.points(self.positions([inner])[0])
        if kind == "MultiPoint":
            return shapely.multipoints(shapely.points(self.positions(inner)))
        if kind == "LineString":
            return self.line(inner)
        if kind == "MultiLineString":
            return shapely.multilinestrings([self.line(part) for part in inner])
        if kind == "Polygon":
            return self.polygon(inner)
        return shapely.multipolygons([self.polygon(part) for part in inner])

    def positions(self, rows: Any) -> NDArray[np.float64]:
        """[n, 2 or 3]: three where all have an altitude and any is not 0."""
        if not isinstance(rows, list) or not all(isinstance(row, list) for row in rows):
            raise ValueError("coordinates must be arrays of positions")
        if not set(map(type, chain.from_iterable(rows))) <= {int, float} or any(len(row) < 2 for row in rows):
            raise ValueError("a position must be two or three numbers")
        sizes = set(map(len, rows))
        if sizes == {2}:
            return np.array(rows, np.float64)
        if sizes == {3}:
            at = np.array(rows, np.float64)
            if at[:, 2].any():
                return at
        self.odd = True
        return np.array([row[:2] for row in rows], np.float64)

    def line(self, rows: Any) -> Any:
        at = self.positions(rows)
        if len(at) < 2:
            raise ValueError("a line needs two positions or more")
        return shapely.linestrings(at)

    def polygon(self, rings: Any) -> Any:
        if not isinstance(rings, list) or not rings:
            raise ValueError("a polygon needs an array of rings")
        shapes = [self.ring(ring) for ring in rings]
        if len({bool(r.has_z) for r in shapes}) > 1:
            self.odd = True
            shapes = [shapely.force_2d(r) for r in shapes]
        return shapely.polygons(shapes[0], shapes[1:] or None)

    def ring(self, rows: Any) -> Any:
        at = self.positions(rows)
        if len(at) and (at[0] != at[-1]).any():
            # RFC 7946 asks for a closed ring; it is clear what an open one means.
            self.odd = True
            at = np.concatenate([at, at[:1]])
        if len(at) < 4:
            raise ValueError("a polygon's ring needs four positions or more, the last one equal to the first")
        return shapely.linearrings(at)


# --- writing -----------------------------------------------------------------------------------------------------


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """``map.geojson``: an uploaded collection as it was, everything else beside it in our own words."""
    out = _Writer(layers)
    pictures: tuple[Layer, ...] = ("occupancy", "voxels", "imagery")
    for layer in pictures:
        context.drop(layer, len(layers.parts_of(layer)), "GeoJSON holds features, no cells or pixels")
    context.drop("resources", len(layers.resources()), "GeoJSON is one text without further files")
    return {"map.geojson": out.data(context)}


class _Writer:
    def __init__(self, layers: Layers) -> None:
        self.layers = layers
        self.metres = False
        self.deep = False

    def data(self, context: WriteContext) -> bytes:
        home = PartKey("objects", GROUND, FAMILY)
        parts = {k: p for k, p in self.layers.parts.items() if isinstance(p, Features)}
        order = sorted(parts, key=lambda key: (key != home, key))
        rows: list[dict[str, Any]] = []
        documents = []
        drawn = {(key.level, i) for key, part in parts.items() if key.layer == "objects" for i in part.ids}
        for key in order:
            part = parts[key]
            collection_document = {
                k: v for k, v in part.document.items() if key != home or k not in (FAMILY, "attribution")
            }
            if collection_document or (not len(part) and key != home):
                documents.append(
                    {"layer": key.layer, "level": key.level, "part": key.name, "document": collection_document}
                )
            rows += self.features(key, part, drawn, plain=key == home)
        extension: dict[str, Any] = {}
        if self.layers.datum is not None:
            extension["datum"] = self.layers.datum.as_dict()
        if self.layers.levels != (Level(),):
            extension["levels"] = [{"name": v.name, "elevation": v.elevation} for v in self.layers.levels]
        if documents:
            extension["documents"] = documents
        document = parts[home].document if home in parts else {}
        original = document.get(FAMILY)
        original = original if isinstance(original, Mapping) else {}
        members = original.get("members")
        top: dict[str, Any] = dict(members) if isinstance(members, Mapping) else {}
        root = original.get("type")
        if root in ("Feature", "Geometry") and len(rows) == 1 and not self.metres and extension.keys() <= {"datum"}:
            if root == "Feature":
                return _dump({**rows[0], OWN_MEMBER: extension} if extension else rows[0])
            if rows[0]["geometry"] is not None:
                context.drop("datum", len(extension), "a geometry alone has no place for it")
                return _dump(rows[0]["geometry"])
        if self.metres:
            top = {"conformsTo": [CONFORMS], **top, "coordRefSys": LOCAL_3D if self.deep else LOCAL_2D}
        if context.attribution and not top.keys() & {"attribution", "license", "copyright"}:
            top["attribution"] = "; ".join(context.attribution)
        if extension:
            top[OWN_MEMBER] = extension
        top.pop("type", None)
        top.pop("features", None)
        return _dump({"type": "FeatureCollection", **top, "features": rows})

    def features(
        self, key: PartKey, part: Features, drawn: set[tuple[str, str]], *, plain: bool
    ) -> list[dict[str, Any]]:
        frame = self.layers.frame
        on_earth = part.in_wgs84(frame) if frame is not None or not part.local.any() else part.geometry
        degrees = _mappings(on_earth, DEGREES)
        metres: dict[int, Any] = {}
        local = np.flatnonzero(part.local)
        if len(local):
            self.metres = True
            self.deep |= bool(shapely.has_z(part.geometry[local]).any())
            metres = dict(zip(local.tolist(), _mappings(part.geometry[local], METRES), strict=True))
        part_members = {"layer": key.layer, "level": key.level, "part": key.name}
        rows = []
        for k, (i, p) in enumerate(zip(part.ids, part.properties, strict=True)):
            origin = p.get("drawn_from")
            if key.layer == "topology" and isinstance(origin, str) and (key.level, origin) in drawn:
                # The drawing it was made from is written; with the network it would stand there twice.
                continue
            place = metres.get(k)
            geometry = None if k in metres and frame is None else degrees[k]
            row: dict[str, Any] = {"type": "Feature", "id": i}
            if plain:
                self.foreign(row, p, part.geometry[k], geometry, metres.get(k, ...))
            else:
                row["geometry"] = geometry
                if k in metres:
                    row["place"] = place
                more = {w: p[w] for w in WORDS if w in p}
                remaining = {w: v for w, v in p.items() if w not in WORDS} if more else p
                row["properties"] = (
                    {**part_members, **remaining, "more": more} if more else {**part_members, **remaining}
                )
            rows.append(row)
        return rows

    def foreign(self, row: dict[str, Any], p: Properties, shape: Any, geometry: Any, place: Any) -> None:
        """A feature of an uploaded collection, as it was but for what has changed since. place: ... for none."""
        source_value = p.get(FAMILY)
        source_properties: Mapping[str, Any] = source_value if isinstance(source_value, Mapping) else {}
        if "id" in source_properties:
            if source_properties["id"] is None:
                del row["id"]
            else:
                row["id"] = source_properties["id"]
        properties: dict[str, Any] | None = {k: v for k, v in p.items() if k != FAMILY}
        added = source_properties.get("added")
        default = ("note", "poi", "path", "region")[int(shapely.get_dimensions(shape)) + 1]
        if isinstance(added, list) and "kind" in added and p.get("kind") == default and properties is not None:
            del properties["kind"]
        if isinstance(source_properties.get("kept"), Mapping) and properties is not None:
            properties |= {k: v for k, v in source_properties["kept"].items() if k not in properties or k == FAMILY}
        if not properties and "properties" in source_properties and source_properties["properties"] is None:
            properties = None
        odd = source_properties.get("geometry")
        if isinstance(odd, dict) and _is_same_shape(odd, shape):
            if place is ...:
                geometry = odd
            else:
                place = odd
        row["geometry"] = geometry
        if place is not ...:
            row["place"] = place
        row["properties"] = properties
        members = source_properties.get("members")
        if isinstance(members, Mapping):
            row.update({k: v for k, v in members.items() if k not in row})


def _is_same_shape(odd: dict[str, Any], shape: Any) -> bool:
    """Whether an uploaded geometry still is what the item looks like."""
    try:
        return bool(shapely.equals_identical(_GeometryParser().shape(odd), shape))
    except (ValueError, shapely.errors.GEOSException, RecursionError):
        return False


def _mappings(geometry: NDArray[np.object_], decimals: int) -> list[Any]:
    """GeoJSON geometries, rounded; None for an item without one."""
    n = len(geometry)
    if not n:
        return []
    types, has_z, empty = shapely.get_type_id(geometry), shapely.has_z(geometry), shapely.is_empty(geometry)
    out: list[Any] = [None] * n
    for deep in (False, True):
        indices = np.flatnonzero((has_z == deep) & ~empty)
        if not len(indices):
            continue
        at = shapely.get_coordinates(geometry[indices], include_z=deep)
        rows = (np.round(at, decimals) + 0.0).tolist()
        ends = np.cumsum(shapely.get_num_coordinates(geometry[indices])).tolist()
        begin = 0
        for k, kind, end in zip(indices.tolist(), types[indices].tolist(), ends, strict=True):
            if kind == 0:
                out[k] = {"type": "Point", "coordinates": rows[begin]}
            elif kind == 1:
                out[k] = {"type": "LineString", "coordinates": rows[begin:end]}
            else:
                out[k] = _mapping(geometry[k], rows, [begin])
            begin = end
    return out


def _mapping(geometry: Any, rows: list[Any], at: list[int]) -> dict[str, Any]:
    """One geometry from its coordinates in order; at: where the next one stands."""

    def take(part: Any) -> list[Any]:
        begin = at[0]
        at[0] += shapely.get_num_coordinates(part)
        return rows[begin : at[0]]

    def rings(polygon: Any) -> list[Any]:
        return [take(polygon.exterior), *(take(r) for r in polygon.interiors)] if not polygon.is_empty else []

    kind = geometry.geom_type
    if kind == "GeometryCollection":
        return {"type": kind, "geometries": [_mapping(g, rows, at) for g in geometry.geoms]}
    if kind == "Polygon":
        inner: list[Any] = rings(geometry)
    elif kind == "MultiPolygon":
        inner = [rings(g) for g in geometry.geoms]
    elif kind == "MultiLineString":
        inner = [take(g) for g in geometry.geoms]
    elif kind == "Point":
        inner = (take(geometry) or [[]])[0]
    else:
        kind = "LineString" if kind == "LinearRing" else kind
        inner = take(geometry)
    return {"type": kind, "coordinates": inner}


def _dump(value: Any) -> bytes:
    """One line for each feature, so that texts compare well."""
    if isinstance(value, dict) and value.get("type") == "FeatureCollection":
        head = {k: v for k, v in value.items() if k != "features"}
        out = BytesIO()  # not joined from rows: orjson's answers take 4 kB and more each, however short they are
        out.write(orjson.dumps(head)[:-1])
        out.write(b',"features":[')
        for k, row in enumerate(value["features"]):
            out.write(b",\n" if k else b"\n")
            out.write(orjson.dumps(row))
        out.write(b"\n]}\n" if value["features"] else b"]}\n")
        return out.getvalue()
    return orjson.dumps(value) + b"\n"


register(
    Format(
        name="geojson",
        title="GeoJSON",
        files={"map.geojson": "application/geo+json"},
        layers=frozenset(VECTOR_LAYERS),
        detect=detect,
        read=read,
        write=write,
        needs=LayerRequirements(tuple(frozenset({layer}) for layer in ("objects", "topology", "location", "zones"))),
        extensions=(".geojson", ".json"),
        claims=Claims(priority=5),
        traits=Traits(is_drawing=True, marks_blocked=True),
    )
)

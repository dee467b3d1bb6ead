"""Features that GIS programs send, as edits: ids, types of properties, coordinates, ends of edges at nodes."""

from __future__ import annotations

import math
import secrets
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import orjson
import shapely
import shapely.geometry

from app.errors import Conflict, Invalid, NotFound, Problem
from app.model.antimeridian import join_at_antimeridian
from app.model.geodesy import local_frame
from app.model.layers import PartKey
from app.model.poses import SAME, moved_pose
from app.ogc.crs import ReferenceSystem
from app.ogc.tables import collection_of, unqualified
from app.ogc.vector import TITLES
from app.store.content import ContentReader
from app.store.values import Version

SNAP: Final = 0.5
"""Distance in metres within which the end of an edge is put onto a node."""

MAX_JSON_ID: Final = 512

PLACE: Final = frozenset({"level", "part"})
"""Properties that say where a feature is stored."""


@dataclass(frozen=True, slots=True)
class Stored:
    """A feature of a version. item: its id in its part."""

    key: PartKey
    item: str
    geometry: Any
    properties: Mapping[str, Any]
    local: bool


class FeatureEditor:
    """Turns features of one collection of a version into edits (see ``app.ingest.edits``)."""

    def __init__(
        self,
        content: ContentReader,
        version: Version,
        collection: str,
        types: Mapping[str, frozenset[str]],
        crs: ReferenceSystem,
    ) -> None:
        """types: JSON types of the collection's properties, as its schema has them. crs: of sent coordinates."""
        assert version.datum is not None
        self._content, self._version, self._collection, self._types = content, version, collection, types
        self._crs, self._datum, self._frame = crs, version.datum, local_frame(version.datum)
        self._layer = TITLES[collection][0]

    def find(self, feature: str) -> Stored:
        """Return a feature by its id in the collection. Raises NotFound."""
        keys = [entry.key for entry in self._version.parts if entry.key.layer == self._layer]
        qualified = [(key, item) for key in keys if (item := unqualified(feature, key)) is not None]
        for key, item in (*((key, feature) for key in keys), *qualified):
            part = self._content.features(self._version, key, ids=[item])
            for i, geometry, properties, local in zip(
                part.ids, part.geometry, part.properties, part.local.tolist(), strict=True
            ):
                kind = shapely.get_type_id(geometry)
                if collection_of(self._layer, properties.get("kind"), kind) == self._collection:
                    return Stored(key, i, geometry, properties, local)
        raise NotFound(f"{self._collection} has no feature {feature[:80]!r}")

    def create(self, feature: Mapping[str, Any]) -> tuple[str, Mapping[str, Any]]:
        """Return the id of a new feature and the edit that adds it. Raises Invalid, Conflict."""
        sent = self._properties(feature)
        place = {name: sent.pop(name) for name in PLACE if sent.get(name) is not None}
        properties = {name: value for name, value in sent.items() if value is not None and name not in PLACE}
        geometry = self._geometry(feature.get("geometry"))
        given = feature.get("id", properties.pop("id", None))
        properties |= self._kind(properties)
        if self._collection == "edges":
            key, geometry = self._tie(geometry, properties, None, place)
            place = {"level": key.level, "part": key.name}
        item = self._id(given, properties)
        return item, self._put(item, geometry, properties, place)

    def change(self, feature: str, sent: Mapping[str, Any], *, replaces: bool) -> Mapping[str, Any]:
        """Return the edit that replaces a feature, or merges ``sent`` with it (RFC 7396). Raises NotFound, Invalid."""
        stored = self.find(feature)
        properties = self._properties(sent)
        for name, value in (("level", stored.key.level), ("part", stored.key.name)):
            if properties.pop(name, value) not in (value, None):
                problem = Problem(f"must stay {value!r}", where=f"properties.{name}")
                raise Invalid(f"a feature keeps its {name}: delete it, and add it with the other {name}", [problem])
        for name in PLACE & stored.properties.keys():  # as features are shown
            if f"stored_{name}" in properties:
                properties[name] = properties.pop(f"stored_{name}")
        if properties.get("id") == feature and "id" not in stored.properties:
            del properties["id"]
        merged = {} if replaces else dict(stored.properties)
        if replaces:
            merged = {name: value for name, value in properties.items() if value is not None}
        else:
            merged = _merge_patch(stored.properties, properties)
        if self._layer == "topology":
            merged["kind"] = stored.properties.get("kind", "node")
        is_moved = replaces or "geometry" in sent
        is_tied = self._collection == "edges" and any(
            merged.get(end) != stored.properties.get(end) for end in ("source", "target")
        )
        if not is_moved and not is_tied:
            return self._put(stored.item, stored.geometry, merged, _place_of(stored.key), local=stored.local)
        geometry = self._geometry(sent.get("geometry")) if is_moved else self._local(stored.geometry, stored.local)
        if self._collection == "edges":
            _, geometry = self._tie(geometry, merged, stored, {})
        elif geometry is not None:
            merged |= moved_pose(self._former(stored), geometry, stored.properties, merged)
        return self._put(stored.item, geometry, merged, _place_of(stored.key))

    def delete(self, feature: str) -> Mapping[str, Any]:
        """Return the edit that deletes a feature. Raises NotFound."""
        stored = self.find(feature)
        return {"op": "delete", "layer": self._layer, "id": stored.item, **_named(_place_of(stored.key))}

    def _put(
        self, item: str, geometry: Any, properties: Mapping[str, Any], place: Mapping[str, Any], *, local: bool = True
    ) -> Mapping[str, Any]:
        shape = None if geometry is None or geometry.is_empty else shapely.geometry.mapping(geometry)
        members = {"place": shape, "geometry": None} if local else {"geometry": shape}
        feature = {"type": "Feature", "id": item, "properties": dict(properties), **members}
        anchor = {"crs": "local" if local else "wgs84"}
        return {"op": "put", "layer": self._layer, "feature": feature, **anchor, **_named(place)}

    # --- properties ---

    def _properties(self, feature: Mapping[str, Any]) -> dict[str, Any]:
        sent = feature.get("properties")
        if sent is not None and not isinstance(sent, Mapping):
            raise Invalid(
                "the feature's 'properties' must be an object", [Problem("must be an object", where="properties")]
            )
        return {name: self._typed(name, value) for name, value in (sent or {}).items()}

    def _typed(self, name: str, value: Any) -> Any:
        """Return a property's value in a type of the schema. Raises Invalid."""
        types = self._types.get(name)
        if value is None or types is None or name in PLACE:
            return value
        if isinstance(value, str) and "string" not in types and types & {"array", "object"}:
            try:
                value = orjson.loads(value)  # programs without such types show and send them as text
            except orjson.JSONDecodeError:
                raise self._type_error(name, types) from None
        if isinstance(value, float) and value.is_integer() and "number" not in types:
            value = int(value)
        fits: Mapping[str, Any] = {"string": str, "boolean": bool, "array": list, "object": dict}
        is_number = isinstance(value, int) and not isinstance(value, bool)
        is_number |= isinstance(value, float) and math.isfinite(value)
        fits_number = is_number and bool(types & {"number", "integer"})  # its values may all be whole by chance
        if not fits_number and not any(isinstance(value, fits[one]) for one in types if one in fits):
            raise self._type_error(name, types)
        return value

    def _type_error(self, name: str, types: frozenset[str]) -> Invalid:
        words = " or ".join(sorted(types))
        problem = Problem(f"must be {words}", where=f"properties.{name}")
        return Invalid(f"{name} must be {words}, as the schema of {self._collection} says", [problem])

    def _kind(self, properties: Mapping[str, Any]) -> Mapping[str, Any]:
        if self._layer == "topology":
            return {"kind": "edge" if self._collection == "edges" else "node"}
        if self._layer in ("zones", "objects") and not properties.get("kind"):
            example = "keepout, speed, priority" if self._layer == "zones" else "tree, shelf, wall"
            problem = Problem("is missing", where="properties.kind")
            raise Invalid(f"a new feature of {self._collection} needs 'kind': {example} …", [problem])
        return {}

    def _id(self, given: Any, properties: Mapping[str, Any]) -> str:
        """Return the id of a new feature: the given one, its name or the nodes of an edge if free, else a new one."""
        if given is not None and not isinstance(given, str):
            given = str(given) if isinstance(given, int) and not isinstance(given, bool) else None
        if given:
            if len(given) > MAX_JSON_ID:
                raise Invalid(f"an id must have at most {MAX_JSON_ID} characters", [Problem("too long", where="id")])
            if self._is_taken(given):
                raise Conflict(f"{self._collection} has a feature {given[:80]!r} already: use another id, or PUT it")
            return str(given)
        wanted = str(properties.get("name") or "")
        if self._collection == "edges":
            wanted = f"{properties['source']}_{properties['target']}"
        if wanted and len(wanted) <= MAX_JSON_ID and wanted.isprintable() and not self._is_taken(wanted):
            return wanted
        return f"{self._collection.rstrip('s')}-{secrets.token_hex(4)}"

    def _is_taken(self, item: str) -> bool:
        keys = [entry.key for entry in self._version.parts if entry.key.layer == self._layer]
        return any(self._content.has_ids(self._version, key, [item]) for key in keys)

    # --- coordinates ---

    def _geometry(self, sent: Any) -> Any:
        """Return a sent geometry in local metres; None for none. Raises Invalid."""
        if sent is None:
            return None
        problems = [Problem("invalid", where="geometry")]
        if not _has_only_numbers(sent):
            raise Invalid("invalid GeoJSON geometry: coordinates must be numbers", problems)
        try:
            shape = shapely.geometry.shape(sent)
        except Exception as error:
            raise Invalid(f"invalid GeoJSON geometry: {error}", problems) from error
        if not np.isfinite(shapely.get_coordinates(shape)).all():
            raise Invalid("the geometry has a coordinate that is not finite: give numbers", problems)
        if self._crs.kind != "local":
            degrees = self._crs.to_wgs84(np.array([shape], object), self._datum)
            beyond = np.abs(shapely.get_coordinates(degrees)) > (180.0, 90.0)
            if self._crs.is_geographic and beyond.any():
                detail = f"the geometry is beyond ±180° of longitude or ±90° of latitude: {self._crs.uri} has "
                raise Invalid(detail + ("latitude" if self._crs.swap else "longitude") + " first", problems)
            shape = join_at_antimeridian(degrees[0])  # it was sent in two pieces
        parts = shapely.get_parts(shape)
        if self._layer == "topology" and shape.geom_type.startswith("Multi") and len(parts) == 1:
            shape = parts[0]  # programs with layers of one type send all as multiple ones
        if self._layer == "objects" and collection_of("objects", None, shapely.get_type_id(shape)) != self._collection:
            raise Invalid(
                f"{self._collection} has no {shape.geom_type}: add it to the collection of its type", problems
            )
        if self._crs.kind == "local":
            return shape
        local = self._frame.geometries_to_local(np.array([shape], object))[0]
        if not np.isfinite(shapely.get_coordinates(local)).all():
            raise Invalid(f"the geometry is outside the area of {self._crs.uri}: check Content-Crs", problems)
        return local

    def _former(self, stored: Stored) -> Any:
        """Return the former place in local metres, empty if it was too far away: then it can be moved back."""
        one = np.array([stored.geometry], object)
        return stored.geometry if stored.local else self._frame.near_geometries_to_local(one)[0]

    def _local(self, geometry: Any, local: bool) -> Any:
        return geometry if local else self._frame.geometries_to_local(np.array([geometry], object))[0]

    # --- ends of edges ---

    def _tie(
        self, line: Any, properties: dict[str, Any], stored: Stored | None, place: Mapping[str, Any]
    ) -> tuple[PartKey, Any]:
        """Put the ends of an edge onto nodes, and set ``source`` and ``target``; returns its part and its geometry.

        An end that was moved goes to the node within SNAP metres of it, an unmoved one stays as it is. Raises
        Invalid if there is none.
        """
        if line is None or line.geom_type != "LineString" or line.is_empty:
            problem = Problem("must be a LineString", where="geometry")
            raise Invalid("an edge needs a LineString from node to node", [problem])
        former = None if stored is None else self._former(stored)
        old = None if former is None or former.is_empty else shapely.get_coordinates(former)
        vertices = shapely.get_coordinates(line, include_z=line.has_z)
        keys = [stored.key] if stored is not None else self._networks(place)
        for end, k in (("source", 0), ("target", -1)):
            is_moved = old is None or _apart(old[k], vertices[k]) > SAME
            wanted = properties.get(end)
            is_renamed = wanted is not None and (stored is None or wanted != stored.properties.get(end))
            if stored is not None and old is not None and not is_moved and not is_renamed:
                properties[end] = stored.properties.get(end)
                vertices[k, :2] = old[k]
                continue
            if is_renamed:
                key, node = self._node(keys, str(wanted), end)
                if is_moved and _apart(node, vertices[k]) > SNAP:
                    raise self._end_error(end, f"is {_apart(node, vertices[k]):.2f} m from its node {wanted!r}")
            else:
                key, name, node = self._nearest(keys, vertices[k], end)
                properties[end] = name
            vertices[k, :2] = node
            keys = [key, *(other for other in keys if other != key)] if end == "source" else keys
        return keys[0], shapely.LineString(vertices)

    def _networks(self, place: Mapping[str, Any]) -> list[PartKey]:
        keys = [
            entry.key
            for entry in self._version.parts
            if entry.key.layer == "topology"
            and place.get("level") in (None, entry.key.level)
            and place.get("part") in (None, entry.key.name)
        ]
        if not keys:
            raise Invalid("there is no network with this level and part: add a node there first")
        return keys

    def _node(self, keys: Sequence[PartKey], name: str, end: str) -> tuple[PartKey, Any]:
        others = [e.key for e in self._version.parts if e.key.layer == "topology" and e.key not in keys]  # of a lift
        for key in (*keys, *others):
            part = self._content.features(self._version, key, ids=[name])
            if len(part) and part.properties[0].get("kind") != "edge" and not part.geometry[0].is_empty:
                return key, shapely.get_coordinates(self._local(part.geometry[0], bool(part.local[0])))[0]
        problem = Problem("is not a node", where=f"properties.{end}")
        raise Invalid(f"{end} {name[:80]!r} is not a node: use the id of one", [problem])

    def _nearest(self, keys: Sequence[PartKey], point: Any, end: str) -> tuple[PartKey, str, Any]:
        x, y = float(point[0]), float(point[1])
        nodes: list[tuple[float, PartKey, str, Any]] = []
        for key in keys:
            part = self._content.features(self._version, key, bbox=(x - SNAP, y - SNAP, x + SNAP, y + SNAP))
            for name, geometry, properties, local in zip(
                part.ids, part.geometry, part.properties, part.local.tolist(), strict=True
            ):
                if properties.get("kind") != "edge" and geometry.geom_type == "Point":
                    node = shapely.get_coordinates(self._local(geometry, local))[0]
                    nodes.append((_apart(node, point), key, name, node))
        near = sorted((one for one in nodes if one[0] <= SNAP), key=lambda one: one[:3])
        if not near:
            raise self._end_error(end, f"is at no node, the nearest is more than {SNAP} m away")
        if near[0][1].level != near[-1][1].level:
            levels = ", ".join(sorted({one[1].level for one in near}))
            raise Invalid(f"nodes of several levels are at the {end} of the edge ({levels}): set 'level'")
        return near[0][1], near[0][2], near[0][3]

    def _end_error(self, end: str, reason: str) -> Invalid:
        word = "start" if end == "source" else "end"
        detail = f"the {word} of the edge {reason}: end it at a node, or move the node, which its edges follow"
        return Invalid(detail, [Problem(reason, where=f"geometry ({end})")])


def _merge_patch(old: Mapping[str, Any], patch: Mapping[str, Any]) -> dict[str, Any]:
    """Merge as RFC 7396 says: null removes a member, objects are merged, all else replaces."""
    out = dict(old)
    for name, value in patch.items():
        if value is None:
            out.pop(name, None)
        elif isinstance(value, Mapping):
            before = out.get(name)
            out[name] = _merge_patch(before if isinstance(before, Mapping) else {}, value)
        else:
            out[name] = value
    return out


def _has_only_numbers(geometry: Any) -> bool:
    """Return whether all coordinates of a GeoJSON geometry are numbers: shapely reads text, too."""
    front = [geometry]
    while front:
        one = front.pop()
        if isinstance(one, Mapping):
            front += [one[name] for name in ("coordinates", "geometries") if name in one]
        elif isinstance(one, list):
            front += one
        elif isinstance(one, bool) or not isinstance(one, int | float):
            return False
    return True


def _apart(a: Any, b: Any) -> float:
    return math.hypot(float(a[0]) - float(b[0]), float(a[1]) - float(b[1]))


def _place_of(key: PartKey) -> Mapping[str, Any]:
    return {"level": key.level, "part": key.name}


def _named(place: Mapping[str, Any]) -> dict[str, Any]:
    """Return level and part by the names that edits have for them."""
    names = {"level": "level", "part": "name"}
    return {names[name]: str(value) for name, value in place.items()}

"""Write GeoJSON: one feature for each item, with its layer, level and part."""

from __future__ import annotations

from collections.abc import Mapping
from io import BytesIO
from typing import Any

import numpy as np
import orjson
import shapely
from numpy.typing import NDArray

from app.formats import WriteContext
from app.formats.geojson.geometry import GeometryParser
from app.formats.geojson.words import CONFORMS, FAMILY, LOCAL_2D, LOCAL_3D, OWN_MEMBER, WORDS
from app.model.features import Features, Properties
from app.model.frame import GROUND, Level
from app.model.layers import Layer, Layers, PartKey
from app.syntax.decimals import DEGREES, METRES


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """Write ``map.geojson``: an uploaded collection unchanged, and everything else with our own data."""
    out = _Writer(layers)
    pictures: tuple[Layer, ...] = ("occupancy", "voxels", "imagery")
    for layer in pictures:
        context.drop(layer, len(layers.parts_of(layer)), "GeoJSON contains features, not cells or pixels")
    context.drop("resources", len(layers.resources()), "GeoJSON is one text file without further files")
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
                context.drop("datum", len(extension), "a single geometry cannot express it")
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
                # The drawing that the network was derived from is written; the network would duplicate it.
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
        """Write a feature of an uploaded collection, updated to its item. place: ... for none."""
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
    """Whether an uploaded geometry still equals the item's geometry."""
    try:
        return bool(shapely.equals_identical(GeometryParser().shape(odd), shape))
    except (ValueError, shapely.errors.GEOSException, RecursionError):
        return False


def _mappings(geometry: NDArray[np.object_], decimals: int) -> list[Any]:
    """Write GeoJSON geometries, rounded; None for an item without one."""
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
    """Write one geometry from its coordinates in order; at: index of the next one."""

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
    """Write one line per feature, so that texts compare well."""
    if isinstance(value, dict) and value.get("type") == "FeatureCollection":
        head = {k: v for k, v in value.items() if k != "features"}
        out = BytesIO()  # not joined from rows: each result of orjson takes at least 4 kB, however short it is
        out.write(orjson.dumps(head)[:-1])
        out.write(b',"features":[')
        for k, row in enumerate(value["features"]):
            out.write(b",\n" if k else b"\n")
            out.write(orjson.dumps(row))
        out.write(b"\n]}\n" if value["features"] else b"]}\n")
        return out.getvalue()
    return orjson.dumps(value) + b"\n"

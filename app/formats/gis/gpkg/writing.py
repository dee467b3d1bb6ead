"""Write a GeoPackage by SQLite in memory: one table for each layer and type of geometry, one for each raster."""

from __future__ import annotations

import contextlib
import sqlite3
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import orjson
import shapely
from numpy.typing import NDArray

from app.formats import WriteContext
from app.formats.gis.gpkg.raster_writing import RasterWriter
from app.formats.gis.gpkg.schema import SCHEMA, index_triggers
from app.formats.gis.gpkg.styles import STYLES, style
from app.formats.gis.gpkg.words import (
    APPLICATION_ID,
    CARTESIAN,
    DATE,
    DEGREES,
    DOCUMENT,
    GEOMETRY_TYPES,
    LOCAL_SRS,
    ORGANIZATION,
    USER_VERSION,
    quoted,
)
from app.formats.gis.shapes import transformed
from app.formats.gis.tables import columns
from app.model.features import Features, Properties
from app.model.frame import Level
from app.model.geodesy import LocalFrame, wgs84_wkt
from app.model.layers import Layer, Layers, PartKey
from app.parameters import parameter

SQLITE_VERSION = 3_040_000
"""Written as the version of SQLite, for the same reason."""

_SUFFIXES = ("points", "lines", "lines", "polygons", "multipoints", "multilines", "multipolygons", "collections")
_EXPECTED = {"nodes": 0, "edges": 1, "fence": 3, "zones": 3}
_SQL_TYPES = {"text": "TEXT", "integer": "INTEGER", "real": "DOUBLE", "boolean": "BOOLEAN"}
_NO_TYPE = -1


@dataclass(frozen=True, slots=True)
class WriteOptions:
    """Choice of what is written."""

    rasters: bool = parameter(True, "include occupancy grids and images as tiles; false: features only")


@dataclass(frozen=True, slots=True)
class Item:
    """Feature with its part."""

    key: PartKey
    id: str
    geometry: Any
    properties: Properties


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """Write ``map.gpkg`` with all vector layers, grids and images."""
    options = context.options if isinstance(context.options, WriteOptions) else WriteOptions()
    context.drop("voxels", len(layers.parts_of("voxels")), "a GeoPackage contains features and tiles, not voxels")
    rasters: tuple[Layer, ...] = ("occupancy", "imagery")
    for layer in rasters:
        count = 0 if options.rasters else len(layers.parts_of(layer))
        context.drop(layer, count, "rasters=false leaves them out")
    context.drop("resources", len(layers.resources()), "a GeoPackage has no further files")
    with contextlib.closing(sqlite3.connect(":memory:", isolation_level=None)) as database:
        database.execute("PRAGMA page_size = 4096")
        database.execute(f"PRAGMA application_id = {APPLICATION_ID}")
        database.execute(f"PRAGMA user_version = {USER_VERSION}")
        database.execute("BEGIN")
        for statement in SCHEMA:
            database.execute(statement)
        _write_systems(database, layers.frame)
        description = "; ".join(context.attribution)
        for name, items in sorted(_group(layers).items()):
            _TableWriter(database, name, items, layers.frame).write(description)
        database.execute("COMMIT")
        database.execute("VACUUM")  # before there are tiles: it copies everything
        database.execute("BEGIN")
        tiles = RasterWriter(database, layers, context)
        if options.rasters:
            tiles.write()
        _write_metadata(database, layers, tiles.entries)
        database.execute("COMMIT")
        data = memoryview(database.serialize())
    changes = struct.pack(">I", 1)
    version = struct.pack(">I", SQLITE_VERSION)
    return {"map.gpkg": b"".join([data[:24], changes, data[28:92], changes, version, data[100:]])}


# --- tables -----------------------------------------------------------------------------------------------------------
def _group(layers: Layers) -> dict[str, list[Item]]:
    """Group the features of all parts by table."""
    out: dict[str, list[Item]] = {}
    drawn = {(key.level, i) for key, part in layers.vector("objects").items() for i in part.ids}
    for key, part in sorted(layers.parts.items()):
        if not isinstance(part, Features):
            continue
        types = np.where(shapely.is_empty(part.geometry), _NO_TYPE, shapely.get_type_id(part.geometry)).tolist()
        for k, (i, properties) in enumerate(zip(part.ids, part.properties, strict=True)):
            origin = properties.get("drawn_from")
            if key.layer == "topology" and isinstance(origin, str) and (key.level, origin) in drawn:
                continue  # the drawing that the network was derived from is written
            name = _table_name(key.layer, properties.get("kind"), types[k], bool(part.local[k]))
            out.setdefault(name, []).append(Item(key, i, part.geometry[k], properties))
    return out


def _table_name(layer: Layer, kind: Any, type_id: int, local: bool) -> str:
    base: str = layer
    if layer == "topology" and kind in ("node", "edge"):
        base = f"{kind}s"
    elif layer == "location" and kind == "fence":
        base = "fence"
    if type_id != _EXPECTED.get(base):
        base = f"{base}_{'plain' if type_id == _NO_TYPE else _SUFFIXES[type_id]}"
    return base if local else f"{base}_wgs84"


class _TableWriter:
    """Writes one table: all features have one type of geometry and one CRS."""

    def __init__(
        self, database: sqlite3.Connection, name: str, items: Sequence[Item], frame: LocalFrame | None
    ) -> None:
        self.database = database
        self.name = name
        self.geometry = np.empty(len(items), object)
        for k, item in enumerate(items):
            self.geometry[k] = item.geometry
        self.columns = columns([i.key for i in items], [i.id for i in items], [i.properties for i in items])
        self.is_spatial = not bool(shapely.is_empty(self.geometry[:1]).all())
        if name.endswith("_wgs84"):
            self.srs = DEGREES
        else:
            self.srs = CARTESIAN if frame is None else LOCAL_SRS
            self.geometry = self.geometry if frame is None else _to_east_north(self.geometry, frame)

    def write(self, description: str) -> None:
        """Write the table, its entries in the GeoPackage's own tables, and its style."""
        self._create()
        names = [*(["geom"] if self.is_spatial else []), *(c.name for c in self.columns)]
        marks = ", ".join("?" * len(names))
        listed = ", ".join(map(quoted, names))
        self.database.executemany(f"INSERT INTO {quoted(self.name)} ({listed}) VALUES ({marks})", self._rows())  # noqa: S608
        if not self.is_spatial:
            self._register("attributes", description, (None, None, None, None), self.srs)
            return
        box = tuple(float(v) for v in shapely.total_bounds(self.geometry))
        self._register("features", description, box, self.srs)
        deep = bool(shapely.has_z(self.geometry).any())
        kind = GEOMETRY_TYPES[int(shapely.get_type_id(self.geometry[0]))]
        row = (self.name, "geom", kind, self.srs, 2 if deep else 0, 0)
        self.database.execute("INSERT INTO gpkg_geometry_columns VALUES (?, ?, ?, ?, ?, ?)", row)
        self._write_index()
        self._write_style()

    def _create(self) -> None:
        lines = ["fid INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL"]
        if self.is_spatial:
            lines.append(f"geom {GEOMETRY_TYPES[int(shapely.get_type_id(self.geometry[0]))]}")
        lines += [f"{quoted(c.name)} {_SQL_TYPES[c.type]}" for c in self.columns]
        self.database.execute(f"CREATE TABLE {quoted(self.name)} ({', '.join(lines)})")

    def _rows(self) -> Iterator[tuple[Any, ...]]:
        values = [column.values for column in self.columns]
        if self.is_spatial:
            values.insert(0, encode_shapes(self.geometry, self.srs))
        return zip(*values, strict=True)

    def _register(self, kind: str, description: str, box: tuple[Any, ...], srs: int) -> None:
        row = (self.name, kind, self.name, description, DATE, *box, srs)
        self.database.execute("INSERT INTO gpkg_contents VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", row)

    def _write_index(self) -> None:
        """Write the spatial index, with the triggers by which editors keep it up to date."""
        index = f"rtree_{self.name}_geom"
        boxes = shapely.bounds(self.geometry)
        self.database.execute(f"CREATE VIRTUAL TABLE {index} USING rtree(id, minx, maxx, miny, maxy)")
        rows = ((k + 1, x0, x1, y0, y1) for k, (x0, y0, x1, y1) in enumerate(boxes.tolist()))
        self.database.executemany(f"INSERT INTO {index} VALUES (?, ?, ?, ?, ?)", rows)  # noqa: S608
        for trigger in index_triggers(self.name, "geom", "fid"):
            self.database.execute(trigger)
        extension = (self.name, "geom", "gpkg_rtree_index", "http://www.geopackage.org/spec120/#extension_rtree")
        self.database.execute("INSERT INTO gpkg_extensions VALUES (?, ?, ?, ?, 'write-only')", extension)

    def _write_style(self) -> None:
        key = self.name.removesuffix("_wgs84")
        if key in STYLES:
            row = (self.name, "geom", "default", style(key), 1, DATE)
            self.database.execute(
                "INSERT INTO layer_styles (f_table_catalog, f_table_schema, f_table_name, f_geometry_column, styleName,"
                " styleQML, styleSLD, useAsDefault, description, owner, ui, update_time)"
                " VALUES ('', '', ?, ?, ?, ?, '', ?, '', '', NULL, ?)",
                row,
            )


def encode_shapes(geometry: NDArray[np.object_], srs: int) -> list[bytes]:
    """Encode geometries as GeoPackage binary: a header with the bounding box (not of points), then WKB."""
    codes = shapely.to_wkb(geometry, output_dimension=3, byte_order=1, flavor="iso")
    boxes = shapely.bounds(geometry)
    point = struct.pack("<2sBBi", b"GP", 0, 0b001, srs)
    other = struct.pack("<2sBBi", b"GP", 0, 0b011, srs)
    pack = struct.Struct("<4d").pack
    return [
        point + code if kind == 0 else other + pack(x0, x1, y0, y1) + code
        for code, kind, (x0, y0, x1, y1) in zip(codes, shapely.get_type_id(geometry), boxes.tolist(), strict=True)
    ]


def _to_east_north(geometry: NDArray[np.object_], frame: LocalFrame) -> NDArray[np.object_]:
    """Turn the local frame into metres east and north."""
    if frame.datum.heading == 0.0:
        return geometry
    p, q, r, s = frame.from_local

    def turn(points: NDArray[np.float64]) -> NDArray[np.float64]:
        out = points.copy()
        x, y = points[:, 0], points[:, 1]
        out[:, 0], out[:, 1] = p * x + q * y, r * x + s * y
        return out

    return transformed(geometry, turn)


# --- tables of the GeoPackage itself ----------------------------------------------------------------------------------
def _write_systems(database: sqlite3.Connection, frame: LocalFrame | None) -> None:
    rows: list[tuple[Any, ...]] = [
        ("Undefined Cartesian SRS", CARTESIAN, "NONE", -1, "undefined", "metres of an unknown place"),
        ("Undefined geographic SRS", 0, "NONE", 0, "undefined", "degrees of an unknown reference"),
        ("WGS 84", DEGREES, "EPSG", 4326, wgs84_wkt(), "longitude and latitude in degrees"),
    ]
    if frame is not None:
        description = "transverse Mercator centred on the environment's datum"
        rows.append(("Local frame", LOCAL_SRS, ORGANIZATION, LOCAL_SRS, frame.wkt, description))
    database.executemany("INSERT INTO gpkg_spatial_ref_sys VALUES (?, ?, ?, ?, ?, ?)", rows)


def _write_metadata(database: sqlite3.Connection, layers: Layers, rasters: Sequence[Mapping[str, Any]]) -> None:
    """Write the datum, the levels and the parts' documents, which have no table."""
    content: dict[str, Any] = {}
    if layers.datum is not None:
        content["datum"] = layers.datum.as_dict()
    if layers.levels != (Level(),):
        content["levels"] = [{"name": v.name, "elevation": v.elevation} for v in layers.levels]
    documents: list[Mapping[str, Any]] = [
        {"layer": key.layer, "level": key.level, "part": key.name, "document": part.document}
        for key, part in sorted(layers.parts.items())
        if isinstance(part, Features) and (part.document or not len(part))
    ]
    if documents:
        content["documents"] = documents
    if rasters:
        content["rasters"] = [{name: value for name, value in row.items() if name != "title"} for row in rasters]
    if not content:
        return
    text = orjson.dumps(content, option=orjson.OPT_SORT_KEYS).decode()
    row = (1, "dataset", DOCUMENT, "application/json", text)
    database.execute("INSERT INTO gpkg_metadata VALUES (?, ?, ?, ?, ?)", row)
    reference = ("geopackage", None, None, None, DATE, 1, None)
    database.execute("INSERT INTO gpkg_metadata_reference VALUES (?, ?, ?, ?, ?, ?, ?)", reference)

"""Read a GeoPackage: its tables by SQLite from a copy in memory, its geometries by GEOS.

Nothing in the file runs: only plain tables are read, functions and everything but SELECT are denied.
"""

from __future__ import annotations

import contextlib
import re
import sqlite3
from collections.abc import Iterator, Mapping
from typing import Any, cast

import numpy as np
import orjson
from numpy.typing import NDArray

from app.errors import TooLarge
from app.formats import Files, ReadContext
from app.formats.gis.gpkg.raster_reading import RasterReader
from app.formats.gis.gpkg.words import (
    CARTESIAN,
    COVERAGE,
    DEGREES,
    DOCUMENT,
    ENVELOPES,
    LOCAL_SRS,
    ORGANIZATION,
    quoted,
)
from app.formats.gis.shapes import parse_shapes, raise_unreadable, transformed
from app.formats.gis.tables import LOCAL, Table, to_parts
from app.model.features import Features
from app.model.frame import Datum, Level
from app.model.geodesy import local_frame
from app.model.layers import VECTOR_LAYERS, Layer, Layers, Part, PartKey
from app.syntax.decimals import METRES

MAX_TABLES = 1000
STEP = 10_000
"""Number of rows that are fetched at a time."""

_LOCAL = (CARTESIAN, LOCAL_SRS)
_LAYERS = """
SELECT c.table_name, c.data_type, c.srs_id, g.column_name, g.srs_id
FROM gpkg_contents AS c LEFT JOIN gpkg_geometry_columns AS g ON g.table_name = c.table_name
ORDER BY c.table_name, g.column_name
"""
_METADATA = "SELECT metadata FROM gpkg_metadata WHERE md_standard_uri = ? ORDER BY id"


def read(files: Files, context: ReadContext) -> Layers:
    """Read all tables. Raises UnreadableFile for a damaged file, with the table; TooLarge beyond the limits."""
    try:
        with contextlib.closing(_open(files[context.main])) as database:
            return _Reader(database, context).layers()
    except sqlite3.Error as error:
        raise_unreadable(f"not a readable SQLite database: {error}")


def _open(data: bytes) -> sqlite3.Connection:
    """Open a copy of a database in memory, from which only plain tables can be read."""
    if data[18:20] == b"\x02\x02":  # a database in memory has no write-ahead log
        data = data[:18] + b"\x01\x01" + data[20:]
    database = sqlite3.connect(":memory:")
    try:
        database.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)
        database.setlimit(sqlite3.SQLITE_LIMIT_TRIGGER_DEPTH, 0)
        database.setlimit(sqlite3.SQLITE_LIMIT_SQL_LENGTH, 2**20)
        database.setlimit(sqlite3.SQLITE_LIMIT_EXPR_DEPTH, 100)
        database.text_factory = lambda raw: raw.decode("utf-8", "replace")
        for pragma in ("trusted_schema = OFF", "cell_size_check = ON", "temp_store = MEMORY"):
            database.execute(f"PRAGMA {pragma}")
        database.deserialize(data)
        database.set_authorizer(_authorize)
    except BaseException:
        database.close()
        raise
    return database


def _authorize(action: int, table: str | None, column: str | None, schema: str | None, source: str | None) -> int:
    """Allow SELECT on tables, min, max, and PRAGMA table_xinfo; source: a view or trigger that causes the action."""
    del schema
    if source is not None:
        return sqlite3.SQLITE_DENY
    if action == sqlite3.SQLITE_FUNCTION and column in ("min", "max"):
        return sqlite3.SQLITE_OK
    pragma = action == sqlite3.SQLITE_PRAGMA and table == "table_xinfo"
    reading = action in (sqlite3.SQLITE_SELECT, sqlite3.SQLITE_READ)
    return sqlite3.SQLITE_OK if reading or pragma else sqlite3.SQLITE_DENY


class _Reader:
    def __init__(self, database: sqlite3.Connection, context: ReadContext) -> None:
        self.database = database
        self.context = context
        self.left = context.limits.features
        self.tables = self._plain_tables()
        self.rasters: dict[str, tuple[str, str | None, Any]] = {}
        for name in ("gpkg_contents", "gpkg_spatial_ref_sys"):
            if name not in self.tables:
                raise_unreadable(f"not a GeoPackage: it has no table {name}")
        self.extension = self._extension()
        datum = self.extension.get("datum")
        self.datum = Datum(**datum) if isinstance(datum, dict) else None

    def layers(self) -> Layers:
        parts = to_parts(list(self._tables()), self.context, "gpkg")
        for key, document in self._documents().items():
            part = parts.get(key, Features((), np.empty(0, object), (), np.empty(0, bool)))
            if isinstance(part, Features):
                parts[key] = part.with_document(document)
        raster_parts = self._raster_parts()
        levels = self.extension.get("levels")
        known_levels = tuple(Level(**v) for v in levels) if isinstance(levels, list) else (Level(),)
        return Layers({**parts, **raster_parts}, self.datum, known_levels)

    def _plain_tables(self) -> dict[str, str]:
        """Return the tables by lower-case name. Views and virtual tables would run code of the file."""
        rows = self.database.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table' AND rootpage > 0")
        return {
            str(name).lower(): str(name)
            for name, sql in rows.fetchmany(10 * MAX_TABLES)
            if re.match(r"\s*create\s+table\b", str(sql), re.IGNORECASE)
        }

    def _extension(self) -> dict[str, Any]:
        """Return our own metadata: the datum, the levels and the parts' documents."""
        if "gpkg_metadata" not in self.tables:
            return {}
        row = self.database.execute(_METADATA, (DOCUMENT,)).fetchone()
        if row is None:
            return {}
        value = orjson.loads(str(row[0]))
        return value if isinstance(value, dict) else {}

    def _documents(self) -> dict[PartKey, dict[str, Any]]:
        """Return the documents of the parts by their keys."""
        out: dict[PartKey, dict[str, Any]] = {}
        rows = self.extension.get("documents")
        for row in rows if isinstance(rows, list) else []:
            if isinstance(row, dict) and row.get("layer") in VECTOR_LAYERS and isinstance(row.get("document"), dict):
                key = PartKey(cast(Layer, row["layer"]), str(row.get("level")), str(row.get("part")))
                out[key] = row["document"]
        return out

    def _raster_parts(self) -> dict[PartKey, Part]:
        """Return the grids and images; the tables of tiles are known once all tables are read."""
        if not self.rasters:
            return {}
        for name in ("gpkg_tile_matrix_set", "gpkg_tile_matrix"):
            if name not in self.tables:
                raise_unreadable(f"its tiles are not described: it has no table {name}")
        rows = self.extension.get("rasters")
        entries = [row for row in rows if isinstance(row, dict)] if isinstance(rows, list) else []
        frame = self.context.frame if self.datum is None else local_frame(self.datum)
        reader = RasterReader(self.database, self.context, entries, frame)
        systems = self._systems()
        out: dict[PartKey, Part] = {}
        for name, (data_type, table, srs_id) in self.rasters.items():
            if table is None:
                self.context.warn("only tables are read, not views: store it as a layer of its own", where=name)
                continue
            if srs_id != CARTESIAN and srs_id not in systems:
                raise_unreadable(f"unknown srs_id {srs_id!r:.40}: it is not in gpkg_spatial_ref_sys", name)
            crs = LOCAL if srs_id == CARTESIAN else systems[srs_id][1]
            out |= reader.read(name, table, crs, is_coverage=data_type == COVERAGE)
        return out

    # --- tables ---

    def _tables(self) -> Iterator[Table]:
        systems = self._systems()
        has_geometry = "gpkg_geometry_columns" in self.tables
        query = _LAYERS if has_geometry else "SELECT table_name, data_type, srs_id, NULL, NULL FROM gpkg_contents"
        listed = self.database.execute(query).fetchmany(MAX_TABLES + 1)
        if len(listed) > MAX_TABLES:
            raise TooLarge(f"{self.context.main} has more than {MAX_TABLES} tables: split it")
        for name, data_type, contents_srs, geometry, srs in listed:
            if str(name).lower() in ("layer_styles", "qgis_projects") or str(name).lower().startswith("gpkg_"):
                continue
            table = self.tables.get(str(name).lower())
            if data_type in ("tiles", COVERAGE):
                self.rasters[str(name)] = (data_type, table, contents_srs)
            elif table is None:
                self.context.warn("only tables are read, not views: store it as a layer of its own", where=str(name))
            elif data_type == "features" and geometry is not None:
                yield self._table(table, str(geometry), systems, contents_srs if srs is None else srs)
            elif data_type == "attributes":
                # The CRS of a table without geometries is the anchor of its items.
                yield self._table(table, None, systems, contents_srs if contents_srs in _LOCAL else DEGREES)

    def _systems(self) -> dict[Any, tuple[str, str | None]]:
        """Return (organization, CRS) by srs_id."""
        columns = {name for name, _ in self._columns("gpkg_spatial_ref_sys")}
        wkt2 = "definition_12_063" if "definition_12_063" in columns else "NULL"
        query = f"SELECT srs_id, organization, organization_coordsys_id, definition, {wkt2} FROM gpkg_spatial_ref_sys"  # noqa: S608
        out: dict[Any, tuple[str, str | None]] = {}
        for srs_id, organization, code, definition, new_definition in self.database.execute(query).fetchmany(10_000):
            texts = [
                t
                for t in (new_definition, definition)
                if isinstance(t, str) and t.strip().lower() not in ("", "undefined")
            ]
            crs = f"EPSG:{code}" if str(organization).upper() == "EPSG" else next(iter(texts), None)
            out[srs_id] = (str(organization), crs)
        return out

    def _crs(self, srs_id: Any, systems: Mapping[Any, tuple[str, str | None]], name: str) -> tuple[str | None, bool]:
        """Return the CRS of a table, and whether it is our local frame without its heading."""
        if srs_id == CARTESIAN:
            return LOCAL, False
        if srs_id not in systems:
            raise_unreadable(f"unknown srs_id {srs_id!r:.40}: it is not in gpkg_spatial_ref_sys", name)
        organization, crs = systems[srs_id]
        if organization == ORGANIZATION and srs_id == LOCAL_SRS and self.datum is not None:
            return LOCAL, True
        return crs, False

    def _columns(self, table: str) -> list[tuple[str, str]]:
        """Return (name, declared type) of the stored columns: generated ones would run code of the file."""
        rows = self.database.execute(f"PRAGMA table_xinfo({quoted(table)})").fetchall()
        return [(str(row[1]), str(row[2]).upper()) for row in rows if row[6] == 0]

    def _table(
        self, name: str, geometry: str | None, systems: Mapping[Any, tuple[str, str | None]], srs_id: Any
    ) -> Table:
        names = self._columns(name)
        shapes = next((n for n, _ in names if geometry is not None and n.lower() == geometry.lower()), None)
        if geometry is not None and shapes is None:
            raise_unreadable(f"it has no column {geometry[:80]!r}", name)
        primary = self._primary_key(name)
        plain = [(n, kind) for n, kind in names if n not in (shapes, primary)]
        selected = ", ".join(quoted(n) for n in ([shapes] if shapes else []) + [n for n, _ in plain]) or "NULL"
        cursor = self.database.execute(f"SELECT {selected} FROM {quoted(name)}")  # noqa: S608
        rows: list[tuple[Any, ...]] = []
        while batch := cursor.fetchmany(STEP):
            rows += batch
            self.left -= len(batch)
            if self.left < 0:
                limit = self.context.limits.features
                raise TooLarge(f"{self.context.main} has more than {limit} features: split it")
        geometries = self._geometries([row[0] for row in rows] if shapes else [None] * len(rows), name)
        crs, turned = self._crs(srs_id, systems, name)
        if turned and self.datum is not None and self.datum.heading != 0.0:
            geometries = _turn(geometries, self.datum)
        offset = 1 if shapes else 0
        columns = {
            n: self._values([row[k + offset] for row in rows], n, kind, name) for k, (n, kind) in enumerate(plain)
        }
        return Table(name, columns, geometries, crs)

    def _primary_key(self, name: str) -> str | None:
        rows = self.database.execute(f"PRAGMA table_xinfo({quoted(name)})").fetchall()
        return next((str(row[1]) for row in rows if row[5] and "INT" in str(row[2]).upper()), None)

    def _values(self, values: list[Any], column: str, kind: str, table: str) -> list[Any]:
        if kind == "BOOLEAN":
            return [bool(v) if isinstance(v, int) else v for v in values]
        blobs = sum(isinstance(v, bytes) for v in values)
        if blobs:
            self.context.warn(f"{blobs} binary values are skipped", where=f"{table}.{column}")
            return [None if isinstance(v, bytes) else v for v in values]
        return values

    def _geometries(self, blobs: list[Any], table: str) -> NDArray[np.object_]:
        codes: list[bytes | None] = []
        for k, blob in enumerate(blobs):
            if blob is not None and (not isinstance(blob, bytes) or len(blob) < 8 or blob[:2] != b"GP"):
                raise_unreadable("not a GeoPackage geometry", f"{table}, row {k + 1}")
            if blob is None:
                codes.append(None)
                continue
            envelope = blob[3] >> 1 & 7
            if envelope not in ENVELOPES or blob[3] & 0x20:
                raise_unreadable("unsupported kind of geometry: store it as a simple feature", f"{table}, row {k + 1}")
            codes.append(blob[8 + ENVELOPES[envelope] :])
        return parse_shapes(codes, table)


def _turn(geometry: NDArray[np.object_], datum: Datum) -> NDArray[np.object_]:
    """Turn metres east and north into the local frame, rounded to a nanometre."""
    p, q, r, s = local_frame(datum).from_local

    def turn(points: NDArray[np.float64]) -> NDArray[np.float64]:
        out = points.copy()
        east, north = points[:, 0], points[:, 1]
        # The inverse of a rotation is its transpose.
        out[:, 0], out[:, 1] = p * east + r * north, q * east + s * north
        return np.asarray(np.round(out, METRES) + 0.0)

    return transformed(geometry, turn)

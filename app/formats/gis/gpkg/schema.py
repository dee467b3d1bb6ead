"""The tables that a GeoPackage must have, and those of its extensions that are used (OGC 12-128r17)."""

from __future__ import annotations

SCHEMA = (
    """CREATE TABLE gpkg_spatial_ref_sys (
srs_name TEXT NOT NULL,
srs_id INTEGER PRIMARY KEY NOT NULL,
organization TEXT NOT NULL,
organization_coordsys_id INTEGER NOT NULL,
definition TEXT NOT NULL,
description TEXT)""",
    """CREATE TABLE gpkg_contents (
table_name TEXT PRIMARY KEY NOT NULL,
data_type TEXT NOT NULL,
identifier TEXT UNIQUE,
description TEXT DEFAULT '',
last_change DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
min_x DOUBLE,
min_y DOUBLE,
max_x DOUBLE,
max_y DOUBLE,
srs_id INTEGER,
CONSTRAINT fk_gc_r_srs_id FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys(srs_id))""",
    """CREATE TABLE gpkg_geometry_columns (
table_name TEXT NOT NULL,
column_name TEXT NOT NULL,
geometry_type_name TEXT NOT NULL,
srs_id INTEGER NOT NULL,
z TINYINT NOT NULL,
m TINYINT NOT NULL,
CONSTRAINT pk_geom_cols PRIMARY KEY (table_name, column_name),
CONSTRAINT uk_gc_table_name UNIQUE (table_name),
CONSTRAINT fk_gc_tn FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
CONSTRAINT fk_gc_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys (srs_id))""",
    """CREATE TABLE gpkg_extensions (
table_name TEXT,
column_name TEXT,
extension_name TEXT NOT NULL,
definition TEXT NOT NULL,
scope TEXT NOT NULL,
CONSTRAINT ge_tce UNIQUE (table_name, column_name, extension_name))""",
    """CREATE TABLE gpkg_metadata (
id INTEGER CONSTRAINT m_pk PRIMARY KEY ASC NOT NULL,
md_scope TEXT NOT NULL DEFAULT 'dataset',
md_standard_uri TEXT NOT NULL,
mime_type TEXT NOT NULL DEFAULT 'text/xml',
metadata TEXT NOT NULL DEFAULT '')""",
    """CREATE TABLE gpkg_metadata_reference (
reference_scope TEXT NOT NULL,
table_name TEXT,
column_name TEXT,
row_id_value INTEGER,
timestamp DATETIME NOT NULL DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')),
md_file_id INTEGER NOT NULL,
md_parent_id INTEGER,
CONSTRAINT crmr_mfi_fk FOREIGN KEY (md_file_id) REFERENCES gpkg_metadata(id),
CONSTRAINT crmr_mpi_fk FOREIGN KEY (md_parent_id) REFERENCES gpkg_metadata(id))""",
    """CREATE TABLE layer_styles (
id INTEGER PRIMARY KEY AUTOINCREMENT NOT NULL,
f_table_catalog TEXT(256),
f_table_schema TEXT(256),
f_table_name TEXT(256),
f_geometry_column TEXT(256),
styleName TEXT(30),
styleQML TEXT,
styleSLD TEXT,
useAsDefault BOOLEAN,
description TEXT,
owner TEXT(30),
ui TEXT(30),
update_time DATETIME DEFAULT (strftime('%Y-%m-%dT%H:%M:%fZ','now')))""",
    """INSERT INTO gpkg_contents (table_name, data_type, identifier, description, last_change)
VALUES ('layer_styles', 'attributes', 'layer_styles', '', '2000-01-01T00:00:00.000Z')""",
    """INSERT INTO gpkg_extensions VALUES ('gpkg_metadata', NULL, 'gpkg_metadata',
'http://www.geopackage.org/spec120/#extension_metadata', 'read-write')""",
    """INSERT INTO gpkg_extensions VALUES ('gpkg_metadata_reference', NULL, 'gpkg_metadata',
'http://www.geopackage.org/spec120/#extension_metadata', 'read-write')""",
)

TILES = (
    """CREATE TABLE gpkg_tile_matrix_set (
table_name TEXT NOT NULL PRIMARY KEY,
srs_id INTEGER NOT NULL,
min_x DOUBLE NOT NULL,
min_y DOUBLE NOT NULL,
max_x DOUBLE NOT NULL,
max_y DOUBLE NOT NULL,
CONSTRAINT fk_gtms_table_name FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name),
CONSTRAINT fk_gtms_srs FOREIGN KEY (srs_id) REFERENCES gpkg_spatial_ref_sys (srs_id))""",
    """CREATE TABLE gpkg_tile_matrix (
table_name TEXT NOT NULL,
zoom_level INTEGER NOT NULL,
matrix_width INTEGER NOT NULL,
matrix_height INTEGER NOT NULL,
tile_width INTEGER NOT NULL,
tile_height INTEGER NOT NULL,
pixel_x_size DOUBLE NOT NULL,
pixel_y_size DOUBLE NOT NULL,
CONSTRAINT pk_ttm PRIMARY KEY (table_name, zoom_level),
CONSTRAINT fk_tmm_table_name FOREIGN KEY (table_name) REFERENCES gpkg_contents(table_name))""",
)
"""The tables that describe tiles, for a GeoPackage that has some."""

TILE_TABLE = """CREATE TABLE {} (
id INTEGER PRIMARY KEY AUTOINCREMENT,
zoom_level INTEGER NOT NULL,
tile_column INTEGER NOT NULL,
tile_row INTEGER NOT NULL,
tile_data BLOB NOT NULL,
UNIQUE (zoom_level, tile_column, tile_row))"""

_BOX = "ST_MinX(NEW.{c}), ST_MaxX(NEW.{c}), ST_MinY(NEW.{c}), ST_MaxY(NEW.{c})"
_FILLED = "NEW.{c} NOTNULL AND NOT ST_IsEmpty(NEW.{c})"

_TRIGGERS = (
    "CREATE TRIGGER rtree_{t}_{c}_insert AFTER INSERT ON {t} WHEN (FILLED) "
    "BEGIN INSERT OR REPLACE INTO rtree_{t}_{c} VALUES (NEW.{i}, BOX); END",
    "CREATE TRIGGER rtree_{t}_{c}_update2 AFTER UPDATE OF {c} ON {t} "
    "WHEN OLD.{i} = NEW.{i} AND (NEW.{c} ISNULL OR ST_IsEmpty(NEW.{c})) "
    "BEGIN DELETE FROM rtree_{t}_{c} WHERE id = OLD.{i}; END",
    "CREATE TRIGGER rtree_{t}_{c}_update4 AFTER UPDATE ON {t} "
    "WHEN OLD.{i} != NEW.{i} AND (NEW.{c} ISNULL OR ST_IsEmpty(NEW.{c})) "
    "BEGIN DELETE FROM rtree_{t}_{c} WHERE id IN (OLD.{i}, NEW.{i}); END",
    "CREATE TRIGGER rtree_{t}_{c}_update5 AFTER UPDATE ON {t} WHEN OLD.{i} != NEW.{i} AND (FILLED) "
    "BEGIN DELETE FROM rtree_{t}_{c} WHERE id = OLD.{i}; "
    "INSERT OR REPLACE INTO rtree_{t}_{c} VALUES (NEW.{i}, BOX); END",
    "CREATE TRIGGER rtree_{t}_{c}_update6 AFTER UPDATE OF {c} ON {t} "
    "WHEN OLD.{i} = NEW.{i} AND (FILLED) AND (OLD.{c} NOTNULL AND NOT ST_IsEmpty(OLD.{c})) "
    "BEGIN UPDATE rtree_{t}_{c} SET minx = ST_MinX(NEW.{c}), maxx = ST_MaxX(NEW.{c}), "
    "miny = ST_MinY(NEW.{c}), maxy = ST_MaxY(NEW.{c}) WHERE id = NEW.{i}; END",
    "CREATE TRIGGER rtree_{t}_{c}_update7 AFTER UPDATE OF {c} ON {t} "
    "WHEN OLD.{i} = NEW.{i} AND (FILLED) AND (OLD.{c} ISNULL OR ST_IsEmpty(OLD.{c})) "
    "BEGIN INSERT INTO rtree_{t}_{c} VALUES (NEW.{i}, BOX); END",
    "CREATE TRIGGER rtree_{t}_{c}_delete AFTER DELETE ON {t} WHEN OLD.{c} NOT NULL "
    "BEGIN DELETE FROM rtree_{t}_{c} WHERE id = OLD.{i}; END",
)


def index_triggers(table: str, geometry: str, key: str) -> list[str]:
    """Return the statements that create the triggers of a table's spatial index. key: column of the primary key."""
    texts = [text.replace("FILLED", _FILLED).replace("BOX", _BOX) for text in _TRIGGERS]
    return [text.format(t=table, c=geometry, i=key) for text in texts]

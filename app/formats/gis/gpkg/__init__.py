"""GeoPackage 1.3 (OGC 12-128r17): a SQLite database with tables of features, which QGIS and GDAL edit.

**Our own data.** One table for each layer and type of geometry: ``nodes``, ``edges``, ``zones``, ``fence``,
``objects_points``, ``objects_lines``, ``objects_polygons`` … Features in degrees are in tables whose names end in
``_wgs84``; the others are in metres. Columns are ``id``, ``layer``, ``level``, ``part``, then the properties; ``more``
is JSON with those that no column can express (nested ones, mixed types, names that SQLite takes for equal). Datum,
levels and documents are in ``gpkg_metadata``. Everything is read back; rows that were added in QGIS belong to the part
of the table's first row. QGIS shows edges as arrows (``layer_styles``).

**Coordinates.** Metres are in transverse Mercator centred on the datum (srs_id 300000): the local frame without its
heading, so geometries are turned by the heading, and back (to a nanometre) on reading. Without a datum they are in the
undefined Cartesian system (srs_id -1). Degrees are in EPSG:4326, longitude first.

**Reading other files.** Each row of a feature or attribute table is an object of the family ``gpkg``, or what the
upload's ``layer`` says. Its columns are its properties; ``id`` or ``name`` is its id, else table and number. A column
called name in any case is its ``name``; a ``kind`` that is no text becomes ``class``. Any CRS that PROJ knows is
converted to degrees (WGS 84), rounded to 1e-12; srs_id -1 and engineering systems are metres of the local frame.
Measures (M) and binary values are not read. Views, virtual tables, generated columns and triggers of the file are
never run.
"""

from __future__ import annotations

from app.formats import Format, LayerRequirements, Traits, register
from app.formats.gis.gpkg.reading import read
from app.formats.gis.gpkg.words import APPLICATION_ID, FAMILY
from app.formats.gis.gpkg.writing import write
from app.formats.gis.tables import ReadOptions
from app.model.layers import VECTOR_LAYERS


def detect(name: str, data: bytes) -> bool:
    """Detect a SQLite database with the GeoPackage's application id, or of its file extension (versions before 1.2)."""
    if data[:16] != b"SQLite format 3\0":
        return False
    return data[68:72] == APPLICATION_ID.to_bytes(4, "big") or name.lower().endswith(".gpkg")


register(
    Format(
        name=FAMILY,
        title="GeoPackage",
        files={"map.gpkg": "application/geopackage+sqlite3"},
        layers=frozenset(VECTOR_LAYERS),
        detect=detect,
        read=read,
        write=write,
        needs=LayerRequirements(tuple(frozenset({layer}) for layer in ("objects", "topology", "location", "zones"))),
        read_options=ReadOptions,
        extensions=(".gpkg",),
        traits=Traits(is_drawing=True, marks_blocked=True),
    )
)

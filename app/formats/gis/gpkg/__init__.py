"""GeoPackage 1.3 (OGC 12-128r17): a SQLite database with tables of features, which QGIS and GDAL edit.

**Our own data.** One table for each layer and type of geometry: ``nodes``, ``edges``, ``zones``, ``fence``,
``objects_points``, ``objects_lines``, ``objects_polygons`` … Features in degrees are in tables whose names end in
``_wgs84``; the others are in metres. Columns are ``id``, ``layer``, ``level``, ``part``, then the properties; ``more``
is JSON with those that no column can express (nested ones, mixed types, names that SQLite takes for equal). Datum,
levels and documents are in ``gpkg_metadata``. Everything is read back; rows that were added in QGIS belong to the part
of the table's first row. QGIS shows edges as arrows (``layer_styles``).

**Grids and images.** Each is a table of PNG tiles of 512 pixels with overviews, ``occupancy_map``, ``imagery_plan`` …;
``rasters=false`` leaves them out. A grid's tiles have a palette whose indices are the cell values, and no tile where
all is unknown. Grids and 8-bit images (grey, colours, palette) come back whole; of other images what is shown is
written. Tiles are upright in their CRS, so a turned raster has a CRS with its own axes (oblique Mercator centred on the
datum, srs_id 300001 …): nothing is resampled, and positions differ from transverse Mercator by 0.01 mm at 1 km and 8 mm
at 10 km. Without a datum, or if the axes of an image are turned in its own CRS, a turned raster is not written.

**Coordinates.** Metres are in transverse Mercator centred on the datum (srs_id 300000): the local frame without its
heading, so geometries are turned by the heading, and back (to a nanometre) on reading. Without a datum they are in the
undefined Cartesian system (srs_id -1). Degrees are in EPSG:4326, longitude first.

**Reading other files.** Each row of a feature or attribute table is an object of the family ``gpkg``, or what the
upload's ``layer`` says. Its columns are its properties; ``id`` or ``name`` is its id, else table and number. A column
called name in any case is its ``name``; a ``kind`` that is no text becomes ``class``. Any CRS that PROJ knows is
converted to degrees (WGS 84), rounded to 1e-12; srs_id -1 and engineering systems are metres of the local frame.

Tables of tiles (PNG, JPEG) are images in their CRS at the finest zoom level; gridded coverages (16-bit PNG, float TIFF)
are images of one band of values. With ``layer=occupancy`` they are grids: the values of a coverage are those of the
cells, and shades are read by Nav2's default thresholds.

Measures (M) and binary values are not read. Views, virtual tables, generated columns and triggers of the file are
never run.
"""

from __future__ import annotations

from app.formats import ANY_FEATURES, Format, LayerRequirements, Traits, register
from app.formats.gis.gpkg.reading import read
from app.formats.gis.gpkg.words import APPLICATION_ID, FAMILY
from app.formats.gis.gpkg.writing import WriteOptions, write
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
        layers=VECTOR_LAYERS | {"occupancy", "imagery"},
        detect=detect,
        read=read,
        write=write,
        needs=LayerRequirements((*ANY_FEATURES, frozenset({"occupancy"}), frozenset({"imagery"}))),
        version=3,
        read_options=ReadOptions,
        write_options=WriteOptions,
        extensions=(".gpkg",),
        traits=Traits(is_drawing=True, marks_blocked=True),
    )
)

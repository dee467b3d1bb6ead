"""Names in a GeoPackage (OGC 12-128r17, version 1.3) that reader and writer share, and our own."""

from __future__ import annotations

FAMILY = "gpkg"

APPLICATION_ID = 0x47504B47
"""``GPKG``, at byte 68 of the file."""
USER_VERSION = 10300

CARTESIAN = -1
"""srs_id of an undefined Cartesian system."""

DEGREES = 4326
"""srs_id of WGS 84."""

ORGANIZATION = "fleet_map"
"""Organization of our local frame in ``gpkg_spatial_ref_sys``."""
LOCAL_SRS = 300000
"""srs_id of the local frame without its heading: transverse Mercator centred on the datum."""

DOCUMENT = "https://fleet-map-server.github.io/content/1"
"""``md_standard_uri`` of the metadata with the datum, the levels and the parts' documents."""

DATE = "2000-01-01T00:00:00.000Z"
"""Written as the time of every change: the same layers give the same bytes."""

COVERAGE = "2d-gridded-coverage"
"""``data_type`` of a table of tiles with values instead of colours."""

ENVELOPES = {0: 0, 1: 32, 2: 48, 3: 48, 4: 64}
"""Bytes of a geometry's envelope, by its code in the flags."""

GEOMETRY_TYPES = (
    "POINT",
    "LINESTRING",
    "LINESTRING",
    "POLYGON",
    "MULTIPOINT",
    "MULTILINESTRING",
    "MULTIPOLYGON",
    "GEOMETRYCOLLECTION",
)
"""Names of the geometry types, by shapely's type ids (2: a ring)."""


def quoted(name: str) -> str:
    """Return a name of a table or column for SQL."""
    return '"' + name.replace('"', '""') + '"'

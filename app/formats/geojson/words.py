"""Names in GeoJSON and JSON-FG that reader and writer share, and our own."""

from __future__ import annotations

import re

FAMILY = "geojson"
LOCAL_2D = "http://www.opengis.net/def/crs/OGC/0/Engineering2D"
LOCAL_3D = "http://www.opengis.net/def/crs/OGC/0/Engineering3D"
"""OGC's names for a local engineering frame, as ``coordRefSys`` of metres in the environment's frame."""

OWN_FRAME = re.compile(r"urn:fleetmap:crs:local|https?://[^?#]+/ogc/[^?#]+/crs/local")
"""Our names for an environment's local frame; the member ``datum`` beside them says which one it is."""

CONFORMS = "http://www.opengis.net/spec/json-fg-1/1.0/conf/core"
OWN_MEMBER = "fleet_map"

GEOMETRIES = ("Point", "MultiPoint", "LineString", "MultiLineString", "Polygon", "MultiPolygon", "GeometryCollection")
WORDS = frozenset({"layer", "level", "part", "more"})

"""GeoJSON (RFC 7946), with JSON-FG's ``place`` (OGC 21-045r1) for items in metres.

**Reading.** Each feature is an object of the family ``geojson``; its properties are the object's, and everything
without a canonical name is stored and written again: ``properties.geojson`` contains the original ``id`` if it is not a
text or repeats another one, ``members`` (foreign ones and ``bbox``), the original ``geometry`` if it has more than its
points (a fourth coordinate, an open ring), ``kept`` (properties with a canonical name but a value of another type) and
``added`` (names of properties that we added). ``document.geojson`` contains the root's type and further members.

**Our own data.** Features of other layers and families have ``layer``, ``level`` and ``part`` in their properties
(where an editor like QGIS preserves them) and are read back into their part; ``more`` contains properties of those
names. A collection without them, whose features are nodes and edges (``kind``, ``source``, ``target``) as the API
returns them, is a topology.

**Metres and degrees are kept apart.** An item anchored in metres has them in ``place``, and the collection's
``coordRefSys`` names a local engineering frame (x east, y north, z up); ``geometry`` is its position on earth if the
environment has a datum, else null. ``fleet_map`` contains the datum, the levels and the parts' documents. A collection
in the local frame of our OGC API or API, with its ``datum``, is read in metres if the environment has an equal datum or
none; else ``geometry`` is read. A collection in another coordinate system is rejected: RFC 7946 allows degrees only.
"""

from __future__ import annotations

import re

import orjson

from app.formats import ANY_FEATURES, Claims, Format, LayerRequirements, Traits, register
from app.formats.geojson.reading import read
from app.formats.geojson.words import GEOMETRIES
from app.formats.geojson.writing import write
from app.model.layers import VECTOR_LAYERS


def detect(name: str, data: bytes) -> bool:  # noqa: ARG001
    """Detect a JSON object of a GeoJSON type, except a graph of the Nav2 route server, which is in metres."""
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


register(
    Format(
        name="geojson",
        title="GeoJSON",
        files={"map.geojson": "application/geo+json"},
        layers=frozenset(VECTOR_LAYERS),
        detect=detect,
        read=read,
        write=write,
        needs=LayerRequirements(ANY_FEATURES),
        extensions=(".geojson", ".json"),
        claims=Claims(priority=5),
        traits=Traits(is_drawing=True, marks_blocked=True),
    )
)

"""GeoJSON (RFC 7946), with JSON-FG's ``place`` (OGC 21-045r1) for what stands in metres.

**Reading.** Each feature is an object of the family ``geojson``; its properties are the object's, and whatever has no
word here comes back: ``properties.geojson`` holds the ``id`` as it stood where it is no text or repeats another's,
``members`` (foreign ones and ``bbox``), ``geometry`` as it stood where it says more than its points (a fourth
coordinate, an open ring), ``kept`` (properties that would stand for one of our words with a value of another type) and
``added`` (words that we put in). ``document.geojson`` holds the root's type and further members.

**Our own words.** Features of other layers and families carry ``layer``, ``level`` and ``part`` among their properties
(where an editor like QGIS keeps them) and go back to where they came from; ``more`` holds properties of those names. A
collection without them, whose features are nodes and edges (``kind``, ``source``, ``target``) as the API answers them,
is a topology.

**Metres never pass as degrees.** An item anchored in metres has them in ``place``, and the collection says with
``coordRefSys`` that they are in a local engineering frame (x east, y north, z up); ``geometry`` is its place on earth
where the environment has a datum, else null. ``fleet_map`` holds the datum, the levels and the parts' documents. A
collection in another coordinate system is refused: RFC 7946 knows degrees only.
"""

from __future__ import annotations

import re

import orjson

from app.formats import Claims, Format, LayerRequirements, Traits, register
from app.formats.geojson.reading import read
from app.formats.geojson.words import GEOMETRIES
from app.formats.geojson.writing import write
from app.model.layers import VECTOR_LAYERS


def detect(name: str, data: bytes) -> bool:  # noqa: ARG001
    """A JSON object of a GeoJSON type, and not the Nav2 route server's graph: that is metres in GeoJSON's clothes."""
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
        needs=LayerRequirements(tuple(frozenset({layer}) for layer in ("objects", "topology", "location", "zones"))),
        extensions=(".geojson", ".json"),
        claims=Claims(priority=5),
        traits=Traits(is_drawing=True, marks_blocked=True),
    )
)

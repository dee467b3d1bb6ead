"""OpenStreetMap: reads XML (``.osm``, also ``.gz`` and ``.bz2``) and PBF, writes XML.

Reading. Each node that a ``highway=*`` way uses is a topology node ``n<id>``, each segment of such a way a directed
edge ``w<way>:<from>-<to>`` (a segment that the way repeats gets ``#2`` …), two if it is bidirectional; a way with one
node twice and the tag ``self_loop=yes`` is an edge from that node to itself. Tags and further attributes (version,
user, timestamp …) are stored in ``properties.osm`` of nodes and edges. Everything else is an object of the family
``osm``: tagged or isolated nodes ``n<id>``, all ways ``w<id>`` (including highways, so that they can be written again
complete and in order) and relations ``r<id>``, a multipolygon with its area. Nodes that are only bends of a line are
not objects: their ids and attributes are stored with their way, in ``refs`` and ``vertices``, and their positions in
its geometry. ``properties.osm`` of an object:

========== ============================================================================================================
tags       key -> value
attributes XML attributes except id, lat and lon
refs       (ways) node ids in order
missing    (ways) indexes into refs of nodes without a position; the geometry has a vertex for each of the others
vertices   (ways) attributes of the nodes that are not features: one mapping for all, or a list parallel to refs
members    (relations) [type, id, role] in order
children   elements that OSM does not define: [name, attributes], then text and a list of such elements, if any
========== ============================================================================================================

An object's kind is its main tag's key (``building``, ``barrier``, ``highway`` …), or ``tree`` and ``water``, else the
tag ``kind``, else ``point``, ``line`` or ``relation``; its ``height``, ``base`` and ``width`` also come from tags (the
rules are in ``app.model.osm_tags``). An edge has its way's ``speed_limit`` (of its direction), ``width`` (else the
lanes'), ``surface`` and ``access``, and ``stairs``. Ways are connected only by a common node: a bridge and what is
below it are not. Elements marked as deleted (``action="delete"``, ``visible="false"``) are stored but not part of the
network.

Writing. Canonical content takes precedence: a feature's geometry over stored node positions, and its name, height,
speed limit … over tags with another value; a highway way is written unchanged while all its edges are in the network,
and is split if edges were removed, became one-way or have other tags (the first piece keeps the id, the others get
negative ones, and relations are updated). Edges without a stored way become new ways with negative ids. Objects of
other formats, and zones, are written as ways and nodes with their plain properties as tags, such as ``name`` and
``kind``; zones also have the tag ``zone`` and are read back as objects. Sorted as OSM tools require: nodes, ways,
relations, each by id.
"""

from __future__ import annotations

import re

from app.formats import Claims, Format, LayerRequirements, Traits, register
from app.formats.osm import rules
from app.formats.osm.parsing import is_pbf, unpack
from app.formats.osm.reading import read
from app.formats.osm.tags import CARRIES
from app.formats.osm.writing import write
from app.limits import Limits


def detect(name: str, data: bytes) -> bool:  # noqa: ARG001
    """Detect by content: an ``<osm>`` root (also compressed), or a PBF header."""
    head = unpack(data[: 2**16], Limits(), limit=4096)[:4096] if data[:3] in (b"BZh", *_GZIP) else data[:4096]
    if is_pbf(head):
        return True
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        head = head.decode("utf-16", "replace").encode()
    return bool(_FIRST.match(head.lstrip(b"\xef\xbb\xbf")))


_FIRST = re.compile(rb"(?s)\s*+(?>(?:(?><\?.*?\?>|<!--.*?-->)\s*+)*)(?:<osm[\s/>]|<!DOCTYPE\s+osm\b)")
_GZIP = tuple(b"\x1f\x8b" + bytes([k]) for k in (8,))

register(
    Format(
        name="osm",
        title="OpenStreetMap",
        files={"map.osm": "application/vnd.openstreetmap.data+xml"},
        layers=CARRIES,
        detect=detect,
        read=read,
        check=rules.check,
        write=write,
        needs=LayerRequirements(one_of=(frozenset({"objects"}), frozenset({"topology"})), anchor="wgs84"),
        version=4,
        extensions=(".osm", "osm.xml", ".osm.gz", ".osm.bz2", ".pbf"),
        claims=Claims(priority=20),
        traits=Traits(own_ids=True, own_network=True),
    )
)

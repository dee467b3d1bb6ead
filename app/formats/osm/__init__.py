"""OpenStreetMap: XML (``.osm``, also ``.gz`` and ``.bz2``) and PBF in, XML out.

Reading. Each node that a ``highway=*`` way uses is a topology node ``n<id>``, each segment of such a way a directed
edge ``w<way>:<from>-<to>`` (a segment that the way repeats gets ``#2`` …), two where it may be used both ways; a way of
one node twice that is tagged ``self_loop=yes`` is an edge from that node to itself. Tags and
the further attributes (version, user, timestamp …) stay with nodes and edges in ``properties.osm``. Everything else is
an object of the family ``osm``: tagged or lone nodes ``n<id>``, all ways ``w<id>`` (the highways too, so that they come
back whole and in order) and relations ``r<id>``, a multipolygon with its area. Nodes that only bend a line are no
objects: their ids and attributes stand with their way, in ``refs`` and ``vertices``, and their places in its geometry.
``properties.osm`` of an object:

========== ============================================================================================================
tags       key -> value
attributes XML attributes but for id, lat and lon
refs       (ways) node ids in order
missing    (ways) indexes into refs of nodes without a place; the geometry has a vertex for each of the others
vertices   (ways) attributes of the nodes that are no features: one mapping for all, or a list parallel to refs
members    (relations) [type, id, role] in order
children   elements that OSM does not know: [name, attributes], then the text and a list of such where there are any
========== ============================================================================================================

An object's kind is its main tag's key (``building``, ``barrier``, ``highway`` …), ``tree`` and ``water`` for what is
one, else ``point``, ``line`` or ``relation``; tags also say its ``height``, ``base`` and ``width`` (the rules are in
``app.model.osm_tags``). An edge has its way's ``speed_limit`` (of its direction), ``width`` (else the lanes'),
``surface`` and ``access``, and ``stairs``. Ways join where they share a node: a bridge and what is below it do not.
Elements marked as deleted (``action="delete"``, ``visible="false"``) are kept, but no robot drives on them.

Writing. The canonical content decides: a feature's place wins over what else is known of a node, and its name, height,
speed limit … over the tags where they say something else; a highway way comes
back whole while all its edges are in the network, and is split where edges are gone, have become one-way or carry other
tags (the first piece keeps the id, the others get negative ones, and relations follow). Edges that no way explains
become new ways with negative ids. Objects of other formats, and zones, are written as ways and nodes with the tags
``name`` and ``kind``. Sorted as the OSM tools ask: nodes, ways, relations, each by id.
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
    """By content: an ``<osm>`` root (also compressed), or a PBF header."""
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
        version=3,
        extensions=(".osm", "osm.xml", ".osm.gz", ".osm.bz2", ".pbf"),
        claims=Claims(priority=20),
        traits=Traits(own_ids=True, own_network=True),
    )
)

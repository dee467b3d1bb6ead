"""lanelet2: roads and footways as lanes between a left and a right bound, in an OSM file (Lanelet2, Autoware).

Points, linestrings (ways) and relations: lanelets (``type=lanelet``, members ``left``, ``right``, sometimes
``centerline`` and ``regulatory_element``), areas (``type=multipolygon``) and regulatory elements. Source: Lanelet2's
documentation (LaneletAndAreaTagging, LinestringTagging) and its reader (OsmHandlerLoad); Autoware's further tags
``local_x``, ``local_y`` (metres in the frame that ``map_projector_info.yaml`` beside the map names) and ``ele``.

Reading. Each lanelet is a directed edge ``l<id>`` along its own centreline or the line half-way between its bounds,
and a second one ``l<id>:back`` if it is bidirectional: with ``one_way=no``, or by default for pedestrians only. Nodes
are the connections of lanelets as Lanelet2 defines them: both bounds of one end where both bounds of the next one
begin; ``n<left>:<right>`` by the ids of the two points. (Where a bidirectional lanelet ends, turning is possible: its
two ends in Lanelet2's sense are one node.) ``width`` is the smallest distance of the bounds (or the lanelet's own
tag), ``speed_limit`` is in m/s. A lanelet's id and tags are in the edge's ``properties.lanelet2``, a node's two
``points`` in the node's.

Everything else, and the lanelets again so that they can be written complete, is an object of the family ``lanelet2``:
points that are not only bends ``n<id>``, ways ``w<id>``, relations ``r<id>``, with their type as ``kind``. Their
``properties.lanelet2`` contains ``tags``, further ``attributes``, ``refs`` and ``members``, the indexes of ``missing``
points, ``children`` that OSM does not define, and for a way's bends the ``vertices``, parallel to ``refs`` (one for all
if they are equal): ``tags``, ``attributes``, and ``at``, the position on earth of points in metres.

Positions are in wgs84, except with the projector ``Local``: then ``local_x`` and ``local_y`` are read, as in Autoware.

Writing. A lanelet is written unchanged while its edges are in the network as it draws them; if one direction was
removed, the other one remains. Any other edge becomes a new lanelet with bounds at half its width, an edge and its
reverse one lanelet with ``one_way=no``; connected lanelets share points of their bounds as far as the geometry allows.
To read such a network back without loss, a new lanelet has a centreline and the tags ``fleetmap:edge``,
``fleetmap:back``, ``fleetmap:source`` and ``fleetmap:target``, and each node is a point with the tag ``fleetmap:node``.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Any

from app.formats import Claims, Format, LayerRequirements, Selection, register
from app.formats.lanelet2.new_lanelets import WriteOptions
from app.formats.lanelet2.reading import read
from app.formats.lanelet2.tags import MAIN, NAME, PROJECTOR
from app.formats.lanelet2.writing import write
from app.model.layers import PartKey

_LANELET = re.compile(
    rb"""<tag\s+(?:k\s*=\s*["']type["']\s+v\s*=\s*["']lanelet["']|v\s*=\s*["']lanelet["']\s+k\s*=\s*["']type["'])\s*/?>"""
)
_ROOT = re.compile(rb"<osm[\s>]")


def detect(name: str, data: bytes) -> bool:  # noqa: ARG001
    """Detect an ``<osm>`` file with a lanelet in it."""
    return b"lanelet" in data and _ROOT.search(data[:4096]) is not None and _LANELET.search(data) is not None


def companions(main: str, data: bytes, names: Sequence[str]) -> Iterable[str]:  # noqa: ARG001
    """Return Autoware's projection file beside the map."""
    folder = main.rpartition("/")[0]
    return [n for n in names if n == f"{folder}/{PROJECTOR}".lstrip("/")]


def choose(keys: Sequence[PartKey], options: Any) -> Sequence[PartKey]:  # noqa: ARG001 - one signature for all formats
    """Select the networks, and the objects from such maps."""
    return [key for key in keys if key.layer == "topology" or (key.layer == "objects" and key.name == NAME)]


register(
    Format(
        name=NAME,
        title="Lanelet2 (including Autoware maps)",
        files={MAIN: "application/vnd.openstreetmap.data+xml"},
        layers=frozenset({"topology", "objects"}),
        detect=detect,
        read=read,
        write=write,
        needs=LayerRequirements(
            one_of=(frozenset({"topology"}),), anchor="wgs84", also=frozenset({"objects"}), accepts_family=True
        ),
        write_options=WriteOptions,
        version=2,
        extensions=(".osm",),
        selection=Selection(choose),
        claims=Claims(priority=36, companions=companions),
    )
)

"""lanelet2: roads and footways as lanes between a left and a right bound, in an OSM file (Lanelet2, Autoware).

Points, linestrings (ways) and relations: lanelets (``type=lanelet``, members ``left``, ``right``, now and then
``centerline`` and ``regulatory_element``), areas (``type=multipolygon``) and regulatory elements. Source: Lanelet2's
documentation (LaneletAndAreaTagging, LinestringTagging) and its reader (OsmHandlerLoad); Autoware's further tags
``local_x``, ``local_y`` (metres in the frame that ``map_projector_info.yaml`` beside the map names) and ``ele``.

Reading. Each lanelet is a directed edge ``l<id>`` along its own centreline or the line half-way between its bounds,
two (``l<id>:back``) where it may be used both ways: where ``one_way`` says no, and, where nothing is said, where it is
for pedestrians only. Nodes are where lanelets meet as Lanelet2 means it: both bounds of one end where both bounds of
the next one begin; ``n<left>:<right>`` by the ids of the two points. (Where a lanelet for both ways ends, one may turn:
its two ends in Lanelet2's sense are one node.) ``width`` is the least distance of the bounds
(or what the lanelet says), ``speed_limit`` is in m/s. A lanelet's id and tags stand in the edge's
``properties.lanelet2``, a node's two ``points`` in the node's.

Everything else, and the lanelets once more so that they come back whole, is an object of the family ``lanelet2``:
points that are no mere bends ``n<id>``, ways ``w<id>``, relations ``r<id>``, ``kind`` being their type. Their
``properties.lanelet2`` holds ``tags``, further ``attributes``, ``refs`` and ``members``, the indexes of ``missing``
points, ``children`` that OSM does not know, and of a way's mere bends the ``vertices``, parallel to ``refs`` (one for
all where they are alike): ``tags``, ``attributes``, and the ``at`` of points that say their metres too.

Places are on earth, but metres where the projector is ``Local``: there ``local_x`` and ``local_y`` count, as in
Autoware.

Writing. A lanelet comes back while its edges are in the network as it draws them; where one direction is gone, the
other one is left. Any other edge becomes a new lanelet with bounds at half its width, an edge and its way back one
lanelet with ``one_way=no``; lanelets that meet share points of their bounds as far as the geometry lets them. So that
a network comes back as it was, such a lanelet has a centreline and the tags ``fleetmap:edge``, ``fleetmap:back``,
``fleetmap:source`` and ``fleetmap:target``, and each node is a point with the tag ``fleetmap:node``.
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
    """An ``<osm>`` file with a lanelet in it."""
    return b"lanelet" in data and _ROOT.search(data[:4096]) is not None and _LANELET.search(data) is not None


def companions(main: str, data: bytes, names: Sequence[str]) -> Iterable[str]:  # noqa: ARG001
    """Autoware's file about the projection, which stands beside the map."""
    folder = main.rpartition("/")[0]
    return [n for n in names if n == f"{folder}/{PROJECTOR}".lstrip("/")]


def choose(keys: Sequence[PartKey], options: Any) -> Sequence[PartKey]:  # noqa: ARG001 - one signature for all formats
    """The networks, and what came from such a map."""
    return [key for key in keys if key.layer == "topology" or (key.layer == "objects" and key.name == NAME)]


register(
    Format(
        name=NAME,
        title="Lanelet2 (also Autoware's)",
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

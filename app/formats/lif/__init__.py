"""lif: VDMA Layout Interchange Format 1.0, the tracks of automated guided vehicles as JSON.

A file has layouts, each with nodes, directed edges and stations; all share one origin, in metres, x and y. The rules of
a vehicle type at a node or along an edge are in a list with one entry per type. Two drafts of 2.0 are also read and
written back in their form: one calls vehicles mobile robots, the other one also groups layouts in ``origins``.
Source: VDMA LIF 1.0.0 (LIF.md, section 8).

Canonical: a layout's ``layoutLevelId`` is its level (without one, the requested level), its nodes and edges are that
level's network, its stations objects of kind ``station``. An item's id is that of the file; ``nodeName``, ``edgeName``
and ``stationName`` are its name. A speed or an orientation that all vehicle types share is the item's: an edge's
``maxSpeed`` is its ``speed_limit``, a node's ``theta`` its ``orientation``, and a trajectory of degree 1 gives an
edge's bends. ``properties.lif`` contains the rest of the item as ``item``, its ``id``, its ``layout`` and its index in
it as ``at``, and a node's ``dangling`` edges. The document's ``lif`` contains the file's other members as ``top``, and
those of its ``layouts`` and ``origins``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import orjson

from app.formats import Claims, Format, LayerRequirements, Selection, Traits, register
from app.formats.lif import rules
from app.formats.lif.reading import read
from app.formats.lif.vocabulary import NAME
from app.formats.lif.writing import WriteOptions, write
from app.model.layers import Layers, PartKey


def lacks(layers: Layers) -> str | None:
    """Return the reason why there is no node to write, or None."""
    some_node = any(p.get("kind") == "node" for part in layers.vector("topology").values() for p in part.properties)
    return None if some_node else "the network has no node: supply one with nodes"


def detect(name: str, data: bytes) -> bool:  # noqa: ARG001 - one signature for all formats
    """Detect a JSON object with LIF's two top-level members."""
    if data[:64].lstrip(b"\xef\xbb\xbf \t\r\n")[:1] != b"{" or b'"metaInformation"' not in data:
        return False
    if b'"layouts"' not in data or b'"FeatureCollection"' in data:
        return False
    if len(data) > 2**20:
        return b'"nodePosition"' in data
    try:
        top = orjson.loads(data.removeprefix(b"\xef\xbb\xbf"))
    except orjson.JSONDecodeError:
        return b'"lifVersion"' in data
    return "metaInformation" in top and ("layouts" in top or "origins" in top)


def choose(keys: Sequence[PartKey], options: Any) -> Sequence[PartKey]:  # noqa: ARG001 - one signature for all formats
    """Choose the networks, and the stations that came from a LIF file."""
    return [key for key in keys if key.layer == "topology" or (key.layer == "objects" and key.name == NAME)]


register(
    Format(
        name=NAME,
        title="Layout Interchange Format (VDMA LIF)",
        files={"layout.lif.json": "application/json"},
        layers=frozenset({"topology", "objects"}),
        detect=detect,
        read=read,
        check=rules.check,
        write=write,
        needs=LayerRequirements(one_of=(frozenset({"topology"}),), anchor="local", missing_content=lacks),
        write_options=WriteOptions,
        extensions=(".lif.json", ".lif", ".json"),
        selection=Selection(choose),
        claims=Claims(priority=37),
        traits=Traits(has_title=True),
    )
)

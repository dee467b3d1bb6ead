"""lif: VDMA's Layout Interchange Format 1.0, the tracks of automated guided vehicles as JSON.

A file has layouts, each with nodes, directed edges and stations; all of them share one origin, metres, x and y. What a
type of vehicle may do at a node or along an edge stands in a list with one entry for each type. Two drafts of 2.0 are
read too and served as they came: one calls vehicles mobile robots, the other one also puts layouts into ``origins``.
Source: VDMA LIF 1.0.0 (LIF.md, section 8).

Canonical: a layout's ``layoutLevelId`` is its level (without one, the level asked for), its nodes and edges are that
level's network, its stations objects of the kind ``station``. An item's id is the file's; ``nodeName``, ``edgeName``
and ``stationName`` are its name. A speed or an orientation that all types of vehicle share is the item's: an edge's
``maxSpeed`` is its ``speed_limit``, a node's ``theta`` its ``orientation``, and a trajectory of degree 1 is an edge's
bends. ``properties.lif`` holds the rest of the item under ``item``, its ``id``, the ``layout`` it stands in and ``at``
which place there, and a node's ``dangling`` edges. The document's ``lif`` holds the file's other members under ``top``
and what it says of its ``layouts`` and ``origins``.
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
    """A layout needs a node."""
    some_node = any(p.get("kind") == "node" for part in layers.vector("topology").values() for p in part.properties)
    return None if some_node else "the network has no node: supply one with nodes"


def detect(name: str, data: bytes) -> bool:  # noqa: ARG001 - one signature for all formats
    """A JSON object with LIF's two members on top."""
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
    """The networks, and the stations that came from a LIF file."""
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

"""nav2_route: the graphs of Nav2's route server, GeoJSON by its shape, metres in a robot's frame by its meaning.

A Point is a node {id, frame, metadata, operations}, a LineString or MultiLineString a directed edge {id, startid,
endid, cost, overridable, metadata, operations} whose shape the server does not look at. Ids are numbers: 32 bit in a
graph, 16 bit in the server's actions and services. The server tells integers from floats: what it asks for as a float
must be written as one (``85.0``), else it throws; so a metadata word that it reads so is always served as a float, and
all others keep the type they came with. Setting a new graph clears the old one before it is loaded: a bad file leaves
none.
Source: navigation2, nav2_route/src/plugins/graph_file_loaders/geojson_graph_file_loader.cpp and the edge scorers.

Canonical: an item's id is its number as a text; ``properties.nav2_route`` holds its ``id``, ``properties`` (the
feature's, less what is canonical), ``members`` (further ones of the feature), ``line`` where an edge is no
MultiLineString, and ``geometry`` where its shape is none of ours. The metadata words ``abs_speed_limit`` (metres per
second), ``name``, ``action`` and ``width`` are the canonical ``speed_limit``, ``name`` … The document's ``nav2_route``
holds the file's ``members``, the ``ignored`` features that are neither node nor edge, and the ``dangling`` edges
between unknown nodes (an edge with one known end is kept with that node).
"""

from __future__ import annotations

from app.formats import Claims, Format, LayerRequirements, Traits, register
from app.formats.nav2_route import rules
from app.formats.nav2_route.reading import read
from app.formats.nav2_route.vocabulary import NAME
from app.formats.nav2_route.writing import WriteOptions, write
from app.model.layers import Layers


def lacks(layers: Layers) -> str | None:
    """Nodes and edges must both be there."""
    kinds = {p.get("kind") for part in layers.vector("topology").values() for p in part.properties}
    return None if {"node", "edge"} <= kinds else "the network has no edge between its nodes: supply one with edges"


def detect(name: str, data: bytes) -> bool:  # noqa: ARG001 - one signature for all formats
    """A JSON object of features with the route server's own words."""
    if data[:64].lstrip(b"\xef\xbb\xbf \t\r\n")[:1] != b"{":
        return False
    return b'"startid"' in data and b'"endid"' in data and b'"features"' in data


register(
    Format(
        name=NAME,
        title="Route graph (Nav2 route server)",
        files={"graph.geojson": "application/geo+json"},
        layers=frozenset({"topology"}),
        detect=detect,
        read=read,
        write=write,
        needs=LayerRequirements(one_of=(frozenset({"topology"}),), anchor="local", missing_content=lacks),
        write_options=WriteOptions,
        check=rules.check,
        extensions=(".geojson", ".json"),
        version=2,
        claims=Claims(priority=36),
        traits=Traits(keeps_bends="foreign", has_title=True),
    )
)

"""nav2_route: graphs of Nav2's route server: GeoJSON in form, but with coordinates in metres in a robot's frame.

A Point is a node {id, frame, metadata, operations}, a LineString or MultiLineString a directed edge {id, startid,
endid, cost, overridable, metadata, operations} whose shape the server ignores. Ids are numbers: 32 bit in a graph, 16
bit in the server's actions and services. The server distinguishes integers from floats: a value that it reads as float
must be written as one (``85.0``), else it throws; so such a metadata value is always written as a float, and all others
keep their type. Setting a new graph clears the old one before it is loaded: an invalid file leaves the robot without
graph.
Source: navigation2, nav2_route/src/plugins/graph_file_loaders/geojson_graph_file_loader.cpp and the edge scorers.

Canonical: an item's id is its number as a text; ``properties.nav2_route`` contains its ``id``, ``properties`` (the
feature's, without the canonical ones), ``members`` (further ones of the feature), ``line`` if an edge is not a
MultiLineString, and ``geometry`` if its shape differs from the canonical one. The metadata keys ``abs_speed_limit``
(metres per second), ``name``, ``action`` and ``width`` are the canonical ``speed_limit``, ``name`` … The document's
``nav2_route`` contains the file's ``members``, the ``ignored`` features that are neither node nor edge, and the
``dangling`` edges between unknown nodes (an edge with one existing end is stored with that node).
"""

from __future__ import annotations

from app.formats import Claims, Format, LayerRequirements, Traits, register
from app.formats.nav2_route import rules
from app.formats.nav2_route.reading import read
from app.formats.nav2_route.vocabulary import NAME
from app.formats.nav2_route.writing import WriteOptions, write
from app.model.layers import Layers


def lacks(layers: Layers) -> str | None:
    """Return what to supply if the network has no node or no edge, else None."""
    kinds = {p.get("kind") for part in layers.vector("topology").values() for p in part.properties}
    return (
        None if {"node", "edge"} <= kinds else "the network has no edge between its nodes: supply a network with edges"
    )


def detect(name: str, data: bytes) -> bool:  # noqa: ARG001 - one signature for all formats
    """Detect a JSON object of features with the route server's own properties."""
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
        version=4,
        claims=Claims(priority=36),
        traits=Traits(keeps_bends="foreign", has_title=True),
    )
)

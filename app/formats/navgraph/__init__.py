"""navgraph: navigation graphs of the Fawkes robot framework, as YAML 1.2 with tags.

Nodes have a name, a position [x, y] in metres and properties; connections join two nodes in both directions, with
``!dir`` in one. Fawkes reads every scalar as a text, and a property without a value (a bare word) as ``true``. A
connection that crosses others is rejected (the default, ``!no-intersection``), added nevertheless
(``!allow-intersection``) or split at a new node (``!split-intersection``). A node without connections must be
``!unconnected``.
Source: fawkes, src/libs/navgraph/yaml_navgraph.cpp and navgraph.cpp.

Canonical: a node's id is its name, an edge's ``<from>_<to>``; a connection of both directions is two edges, the second
with ``backward``. The property ``orientation`` (radians) is also the node's orientation. ``properties.navgraph``
contains a node's ``properties`` (a mapping), ``words`` (those of them that are bare), ``tag`` and ``more`` (further
keys); a connection's ``tag``, ``backward`` and, if the file has intersection tags, ``order``: with these Fawkes adds
connections in sequence, and the result depends on it. The document's ``navgraph`` contains ``top`` (the keys of the
file except nodes and connections), ``defaults`` and ``words`` of the default properties.
"""

from __future__ import annotations

import re

from app.formats import Claims, Format, LayerRequirements, Traits, register
from app.formats.navgraph import rules
from app.formats.navgraph.reading import read
from app.formats.navgraph.vocabulary import NAME
from app.formats.navgraph.writing import WriteOptions, write

_GRAPH_NAME = re.compile(rb"(?m)^graph-name[ \t]*:")
_TAG = re.compile(rb"(?m)^%TAG\s+\S+\s+tag:fawkesrobotics\.org,navgraph/")


def detect(name: str, data: bytes) -> bool:
    """Detect YAML with Fawkes' %TAG line, or with the name of a graph."""
    if not name.lower().endswith((".yaml", ".yml")) or b"nodes" not in data:
        return False
    return bool(_TAG.search(data[:4096]) or _GRAPH_NAME.search(data))


register(
    Format(
        name=NAME,
        title="Navigation graph (Fawkes)",
        files={"navgraph.yaml": "application/yaml"},
        layers=frozenset({"topology"}),
        detect=detect,
        read=read,
        check=rules.check,
        write=write,
        needs=LayerRequirements(one_of=(frozenset({"topology"}),), anchor="local"),
        write_options=WriteOptions,
        extensions=(".yaml", ".yml"),
        version=2,
        claims=Claims(priority=35),
        traits=Traits(keeps_bends="nodes", has_title=True),
    )
)

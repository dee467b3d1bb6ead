"""0.yaml, 1.yaml …: navigation graphs of Open-RMF's fleet adapters, one per kind of robot.

``{building_name, levels: {level: {vertices: [[x, y, {name, …}]], lanes: [[i, j, {…}]]}}, doors: {name: {endpoints,
map}}, lifts: {name: {position: [x, y, yaw], dims: [width, depth]}}}`` in metres; lanes are directed. They are generated
from a building as by ``building_map_generator nav``: the vertices that lanes of the graph use, in order of first use; a
two-way lane as two; ``door_name`` if a lane crosses a door, ``lift`` if a vertex is inside a lift's shaft,
``orientation_constraint``, ``speed_limit``, ``mutex``, ``dock_name`` and ``undock_name``.

Source: open-rmf/rmf_traffic_editor, rmf_building_map_tools/building_map (building.py, level.py, lift.py).

Canonical: the graphs of a directory are one network per level. A vertex that several graphs list identically is one
node; ``properties.rmf_nav_graph`` holds its index in each graph (``graphs``) and its ``parameters``, an edge's
``graph``, ``index`` and ``parameters``. Doors and lifts are objects. The document's ``rmf_nav_graph`` holds the top
level of each graph. A node of another format is named by its name if no other vertex of the graph has it, else by its
id, with ``#2``, ``#3`` … if that is taken: fleet adapters refuse a repeated name. A graph whose vertices name lifts
that no source describes has no ``lifts``.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from app.formats import Claims, Format, LayerRequirements, Selection, Traits, one_map_per_folder, register
from app.formats.rmf import common
from app.formats.rmf.common import BUILDING
from app.formats.rmf.nav_graph import rules
from app.formats.rmf.nav_graph.reading import read
from app.formats.rmf.nav_graph.vocabulary import NAME
from app.formats.rmf.nav_graph.writing import write
from app.model.layers import Layers, PartKey

_TOP = re.compile(rb"(?m)^building_name[ \t]*:")
_LEVELS = re.compile(rb"(?m)^levels[ \t]*:")
_OF_BUILDING = re.compile(
    rb"(?m)^(?:coordinate_system|crowd_sim|reference_level_name)[ \t]*:"
    rb"|^[ \t]+(?:walls|measurements|drawing|elevation|floors|fiducials|models|human_lanes|flattened_x_offset)[ \t]*:"
)


def lacks(layers: Layers) -> str | None:
    """Return the reason why there is no lane to write, or None."""
    some_edge = any(p.get("kind") == "edge" for part in layers.vector("topology").values() for p in part.properties)
    return None if some_edge else "the network has no edge: supply one with edges (building.yaml, tmap2, OSM …)"


def detect(name: str, data: bytes) -> bool:
    """Detect YAML with a building's name and levels, without keys that only a building.yaml has."""
    if not name.lower().endswith((".yaml", ".yml")) or not _TOP.search(data):
        return False
    return bool(_LEVELS.search(data) and not _OF_BUILDING.search(data))


def choose(keys: Sequence[PartKey], options: Any) -> Sequence[PartKey]:  # noqa: ARG001 - one signature for all formats
    """Choose the networks, and the doors and lifts that came from a building or from graphs."""
    return [k for k in keys if k.layer == "topology" or (k.layer == "objects" and k.name in (NAME, BUILDING))]


register(
    Format(
        name=NAME,
        title="Navigation graphs (Open-RMF)",
        files={"0.yaml": "application/yaml"},
        layers=frozenset({"topology", "objects"}),
        detect=detect,
        read=read,
        check=rules.check,
        write=write,
        needs=LayerRequirements(
            one_of=(frozenset({"topology"}),), anchor="local", also=frozenset({"objects"}), missing_content=lacks
        ),
        write_options=common.WriteOptions,
        extensions=(".yaml", ".yml"),
        version=5,
        selection=Selection(choose),
        claims=Claims(priority=30, sort=one_map_per_folder),
        traits=Traits(keeps_bends="nodes", has_title=True),
    )
)

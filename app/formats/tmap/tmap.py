"""tmap: the older networks of topological_navigation (strands_navigation), a YAML list of nodes: ``*.tmap``.

See ``tmap.network``. What its reader (topological_navigation, manager.py) takes of a node: ``name``, ``map``,
``pointset``, ``pose``, ``verts``, ``edges``, ``localise_by_topic``, ``xy_goal_tolerance`` and ``yaw_goal_tolerance``;
of an edge: ``edge_id``, ``node``, ``action``, ``top_vel``, ``map_2d``, ``inflation_radius`` and
``recovery_behaviours_config``. All of these are written; further keys, at which it does not look, are kept.
"""

from __future__ import annotations

from app.formats import Claims, Format, LayerRequirements, Selection, Traits, WriteContext, register
from app.formats.tmap import network, writing
from app.formats.tmap.reading import read
from app.model.layers import Layers

FILE = "map.tmap"
ENDS = (".tmap", ".yaml", ".yml", ".tmap2")


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """``map.tmap``; see ``tmap.writing``. The map's name and transformation have no place in it."""
    return {FILE: writing.write(layers, context, listed=True)}


def detect(name: str, data: bytes) -> bool:
    """A YAML list whose first entry is that of a node."""
    return name.lower().endswith(ENDS) and network.is_list(data)


register(
    Format(
        name="tmap",
        title="Topological map, the older list (strands_navigation)",
        files={FILE: "application/yaml"},
        layers=frozenset({"topology", "objects"}),
        detect=detect,
        read=read,
        write=write,
        needs=LayerRequirements(one_of=(frozenset({"topology"}),), anchor="local"),
        write_options=network.ListOptions,
        extensions=(".tmap",),
        version=2,
        selection=Selection(network.choose),
        claims=Claims(priority=49, leads_folder="topological"),
        traits=Traits(family=network.NAME, keeps_bends="nodes", has_title=True),
    )
)

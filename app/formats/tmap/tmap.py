"""tmap: older networks of topological_navigation (strands_navigation), a YAML list of nodes: ``*.tmap``.

See ``tmap.network``. Its reader (topological_navigation, manager.py) uses these keys of a node: ``name``, ``map``,
``pointset``, ``pose``, ``verts``, ``edges``, ``localise_by_topic``, ``xy_goal_tolerance`` and ``yaw_goal_tolerance``;
of an edge: ``edge_id``, ``node``, ``action``, ``top_vel``, ``map_2d``, ``inflation_radius`` and
``recovery_behaviours_config``. All of these are written; further keys, which it ignores, are preserved.
"""

from __future__ import annotations

from app.formats import Claims, Format, LayerRequirements, Selection, Traits, WriteContext, register
from app.formats.tmap import network, writing
from app.formats.tmap.reading import read
from app.model.layers import Layers

FILE = "map.tmap"
ENDS = (".tmap", ".yaml", ".yml", ".tmap2")


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """Write ``map.tmap``, which cannot store the map's name and transformation; see ``tmap.writing``."""
    return {FILE: writing.write(layers, context, listed=True)}


def detect(name: str, data: bytes) -> bool:
    """Detect a YAML list whose first entry is a node."""
    return name.lower().endswith(ENDS) and network.is_list(data)


register(
    Format(
        name="tmap",
        title="Topological map, older list (strands_navigation)",
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

"""building.yaml: buildings of the Open-RMF traffic editor, with their floor plan images.

A level has vertices ``[x, y, z, name, {parameters}]``; lanes, walls, doors, measurements and human lanes are
``[i, j, {parameters}]`` between vertices, floors and holes rings of them; a parameter is ``[type, value]`` with 1 text,
2 integer, 3 decimal, 4 boolean. ``coordinate_system`` sets the meaning of the coordinates:

* ``reference_image`` (the default): pixels, y down. y is negated; the scale is the mean of metres per
  pixel over the measurements of the reference level (``reference_level_name``, else the first); every other level takes
  scale, rotation and translation from the fiducials that it shares by name with the reference level, never from its
  own measurements. With fewer than two common fiducials (or no measurement) one pixel is one metre.
* ``cartesian_meters``: metres, y up; ``offset_x`` and ``offset_y`` are stored but not applied.
* ``wgs84``: x is the longitude, y the latitude, degrees.
* ``web_mercator``: the world is 256 wide; x from 0 eastward, y from 0 downward to -256.

Source: open-rmf/rmf_traffic_editor, rmf_building_map_tools/building_map (building.py, level.py, transform.py, lift.py).

Canonical: one topology part and one objects part per level. A vertex is a node, its id is its name, else
``<level>/<index>``, its text parameter ``area`` the node's property; a lane is an edge, a two-way lane two edges that
are written as one lane. Walls, doors, floors, holes, models, lifts, fiducials, measurements and human lanes are objects
of these kinds. ``properties.openrmf`` holds an item's position in its list (``index``), its ``parameters`` and its
``vertices``. The document's ``openrmf`` is ``{building, level, order, transform}``: the file's top level without levels
and lifts, the level without its lists, its position in the file, and [scale, rotation, x, y] from pixels (y up) to
metres. Geometry takes precedence: an item moved by an edit gets vertices at its new position. A node of another format
is named by its name if no other vertex has it, else by its id, with ``#2``, ``#3`` … if that is taken.
"""

from __future__ import annotations

import re

from app.formats import Claims, Format, LayerRequirements, Selection, Traits, register
from app.formats.rmf import common
from app.formats.rmf.building import rules
from app.formats.rmf.building.reading import read
from app.formats.rmf.building.vocabulary import FILE, NAME
from app.formats.rmf.building.writing import write
from app.formats.rmf.images import companion_hook

_FILENAME = re.compile(
    rb"\bfilename[\"']?[ \t]*:[ \t]*(?:\"([^\"\n]{1,500})\"|'([^'\n]{1,500})'|([^\s,}#\"'][^,}#\n]{0,500}))"
)

_LEVELS = re.compile(rb"(?m)^levels[ \t]*:")
_OF_GRAPH = re.compile(rb"(?m)^building_name[ \t]*:")
_OF_BUILDING = re.compile(
    rb"(?m)^(?:coordinate_system|crowd_sim|reference_level_name)[ \t]*:"
    rb"|^[ \t]+(?:walls|measurements|drawing|elevation|floors|fiducials|models|human_lanes|flattened_x_offset)[ \t]*:"
)
_VERTICES = re.compile(rb"(?m)^[ \t]+vertices[ \t]*:")
_NAMED = re.compile(rb"(?m)^name[ \t]*:")


def detect(name: str, data: bytes) -> bool:
    """Detect YAML whose levels have keys that only a building has, or a name and vertices."""
    if not name.lower().endswith((".yaml", ".yml")) or not _LEVELS.search(data):
        return False
    if _OF_BUILDING.search(data):
        return True
    return bool(not _OF_GRAPH.search(data) and _NAMED.search(data) and _VERTICES.search(data))


register(
    Format(
        name=NAME,
        title="Building (Open-RMF traffic editor)",
        files={FILE: "application/yaml"},
        layers=frozenset({"topology", "objects", "resources"}),
        detect=detect,
        read=read,
        check=rules.check,
        write=write,
        needs=LayerRequirements(one_of=(frozenset({"topology"}),), also=frozenset({"objects", "resources"})),
        write_options=common.WriteOptions,
        extensions=(".building.yaml", ".yaml", ".yml"),
        version=5,
        selection=Selection(common.choose_building),
        claims=Claims(priority=40, companions=companion_hook(_FILENAME)),
        traits=Traits(keeps_bends="nodes", has_title=True),
    )
)

"""tmap2: networks of topological_navigation, as YAML: ``*.tmap2.yaml`` or ``*.tmap2``.

See ``tmap.network``. The older list (``tmap``) is also read if a client names it tmap2; missing members are filled in.
"""

from __future__ import annotations

from app.formats import Claims, Format, LayerRequirements, Selection, Traits, WriteContext, register
from app.formats.tmap import network, rules, writing
from app.formats.tmap.reading import read
from app.model.layers import Layers

FILE = "network.tmap2.yaml"
NAMES = (".tmap2.yaml", ".tmap2.yml", ".tmap2")


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """Write ``network.tmap2.yaml``; see ``tmap.writing``."""
    return {FILE: writing.write(layers, context)}


def detect(name: str, data: bytes) -> bool:
    """Detect a topological map by its name, or YAML with its top-level keys; never the older list."""
    lower = name.lower()
    if b"node" not in data or network.is_list(data):
        return False
    if lower.endswith(NAMES):
        return True
    return lower.endswith((".yaml", ".yml", ".tmap")) and network.is_mapping(data)


register(
    Format(
        name=network.NAME,
        title="Topological map (topological_navigation)",
        files={FILE: "application/yaml"},
        layers=frozenset({"topology", "objects"}),
        detect=detect,
        read=read,
        check=rules.check,
        write=write,
        needs=LayerRequirements(one_of=(frozenset({"topology"}),), anchor="local"),
        write_options=network.WriteOptions,
        extensions=(*NAMES, ".tmap"),
        version=3,
        selection=Selection(network.choose),
        claims=Claims(priority=50, leads_folder="topological"),
        traits=Traits(keeps_bends="nodes", has_title=True),
    )
)

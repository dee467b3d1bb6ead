"""Write Lanelet2: stored elements unchanged, and new lanelets for edges of other formats."""

from __future__ import annotations

from app.formats import WriteContext
from app.formats.lanelet2.document import Document
from app.formats.lanelet2.new_lanelets import NewLanelets
from app.formats.lanelet2.stored import StoredElements
from app.formats.lanelet2.tags import MAIN, PROJECTOR
from app.model.layers import Layers


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """Write ``lanelet2.osm``, and ``map_projector_info.yaml`` if the source had one or the options request it.

    Raises MissingDatum if a network is in metres and there is no datum.
    """
    out = Document(layers, context)
    stored = StoredElements(out)
    for level in dict.fromkeys(key.level for key in sorted(layers.parts)):
        stored.level(level)
    NewLanelets(out).add_network()
    files = {MAIN: out.text()}
    for item, times in sorted(out.lost.items()):
        context.drop(item, times, "Lanelet2 maps cannot express them")
    if layers.datum is not None:
        context.drop("datum", 1, "Lanelet2 positions are in wgs84, without a local frame")
    if out.projector is not None:
        files[PROJECTOR] = out.projector.encode()
    elif context.options.projector_info:
        files[PROJECTOR] = b"projector_type: Local\nvertical_datum: WGS84\n"
    return files

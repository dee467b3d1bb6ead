"""Writing Lanelet2: stored elements as they were, and new lanelets for edges from elsewhere."""

from __future__ import annotations

from app.formats import WriteContext
from app.formats.lanelet2.document import Document
from app.formats.lanelet2.new_lanelets import NewLanelets
from app.formats.lanelet2.stored import StoredElements
from app.formats.lanelet2.tags import MAIN, PROJECTOR
from app.model.layers import Layers


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """``lanelet2.osm``, and ``map_projector_info.yaml`` where the source had one or it is asked for.

    Raises MissingDatum where a network is in metres and there is no datum.
    """
    out = Document(layers, context)
    stored = StoredElements(out)
    for level in dict.fromkeys(key.level for key in sorted(layers.parts)):
        stored.level(level)
    NewLanelets(out).add_network()
    files = {MAIN: out.text()}
    for item, times in sorted(out.lost.items()):
        context.drop(item, times, "a Lanelet2 map has no place for them")
    if layers.datum is not None:
        context.drop("datum", 1, "a Lanelet2 map stands on earth and has no local frame of its own")
    if out.projector is not None:
        files[PROJECTOR] = out.projector.encode()
    elif context.options.projector_info:
        files[PROJECTOR] = b"projector_type: Local\nvertical_datum: WGS84\n"
    return files

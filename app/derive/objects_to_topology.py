"""Drawn lines -> topology: a network drawn in Google Earth or QGIS for a robot's format."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from app import formats
from app.derive import DerivationNotes, derives
from app.errors import MissingLayer
from app.model import network
from app.model.features import Features, concatenate, unique_ids
from app.model.layers import NETWORK, Layers, Part, PartKey
from app.parameters import parameter


@dataclass(frozen=True, slots=True)
class Parameters:
    """Parameters of objects_to_topology."""

    join: float = parameter(
        network.JOIN, "distance below which vertices become one node", minimum=0.0, maximum=100.0, unit="m"
    )
    outlines: bool = parameter(False, "whether outlines of polygons are paths, too")


@derives(gives="topology", needs={"objects"}, parameters=Parameters, cost=1.0)
def objects_to_topology(layers: Layers, parameters: Parameters, notes: DerivationNotes) -> Layers:  # noqa: ARG001
    """Network of nodes and directed edges from drawn lines and points of interest.

    One network per level, from all its drawings. Raises MissingLayer if there are no lines or points of interest.
    """
    every = formats.all_formats().values()
    complete = {fmt.family for fmt in every if fmt.traits.own_network}
    # Elsewhere only lines of kind path are paths: walls and doors of buildings are lines, too.
    drawings = {name for fmt in every if fmt.traits.is_drawing for name in (fmt.name, fmt.family)}
    by_level: dict[str, list[tuple[str, Features]]] = {}
    for key, part in layers.vector("objects").items():
        if key.name in complete:
            continue
        chosen = part if key.name in drawings else part.select_kinds("path", "poi")
        if len(chosen):
            by_level.setdefault(key.level, []).append((key.name, chosen))
    parts: dict[PartKey, Part] = {}
    for level, named in by_level.items():
        network_part = _network([part for _, part in named], layers, parameters)
        if len(network_part):
            parts[PartKey("topology", level, NETWORK)] = network_part
    if not parts:
        raise MissingLayer(
            "the stored objects have no drawn lines or points of interest to derive a network from: upload a network "
            "(tmap2, osm …) or a KML or GeoJSON drawing with paths as lines; if the paths are drawn as polygons, set "
            "outlines=true"
        )
    return Layers(parts, layers.datum, layers.levels)


def _network(drawings: list[Features], layers: Layers, parameters: Parameters) -> Features:
    """Build one network from several drawings, whose objects may share ids."""
    origins = tuple(i for part in drawings for i in part.ids)
    ids = iter(unique_ids(origins))
    renamed = [Features(tuple(next(ids) for _ in p.ids), p.geometry, p.properties, np.array(p.local)) for p in drawings]
    return network.from_drawing(
        concatenate(renamed),
        join=parameters.join,
        frame=layers.frame,
        outlines=parameters.outlines,
        origins=origins,
    )

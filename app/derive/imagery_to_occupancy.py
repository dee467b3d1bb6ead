"""Imagery -> occupancy: a grid from an aerial image or a floor plan, for planning without a better map."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from app.derive import DerivationNotes, derives
from app.derive._picture_methods import choose_method, plan_to_grid, segment_picture
from app.derive._pictures import ground, picture_label, select_pictures
from app.derive._segments import OBSTACLES, Segmentation, probability_cells
from app.errors import CannotConvert, MissingDatum
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.imagery import LOCAL
from app.model.layers import MAP, Layers, Part, PartKey
from app.parameters import parameter

PROBABILITY = "probability"
"""Name of the grid of probabilities."""


@dataclass(frozen=True, slots=True)
class Parameters(Segmentation):
    """Parameters of imagery_to_occupancy."""

    probabilities: bool = parameter(
        False,
        "whether there is also a grid `probability`, whose cells are the probability in percent that they are occupied",
    )


@derives(gives="occupancy", needs={"imagery"}, parameters=Parameters, cost=30.0, version=3)
def imagery_to_occupancy(layers: Layers, parameters: Parameters, notes: DerivationNotes) -> Layers:
    """Occupancy grid from an image: trees, vegetation, buildings, water and walls are occupied.

    Fields, paths, roads and a plan's rooms are free, everything else is unknown: also regions below ``confidence``. The
    origin is a multiple of the resolution, yaw 0. Raises CannotConvert if nothing is recognised in the image,
    MissingDatum if it is anchored in WGS 84 and there is no datum.
    """
    parts: dict[PartKey, Part] = {}
    for key, picture in select_pictures(layers, parameters.picture).items():
        name = picture_label(key)
        if picture.crs != LOCAL and layers.frame is None:
            raise MissingDatum('a grid needs a datum: PATCH the environment with {"datum": {…}}')
        method = choose_method(picture, parameters)
        if method == "plan":
            grid, sure = plan_to_grid(picture, layers.frame, parameters, notes, name)
            chance = np.where(sure > 0, np.rint(100 * sure).astype(np.uint8), grid.cells)
            chances = replace(grid, cells=chance)
        else:
            on = ground(picture, layers.frame, parameters.resolution, notes, name)
            segments = segment_picture(on, picture, parameters, method, notes, name)
            cells = np.full(segments.label.shape, UNKNOWN, np.uint8)
            cells[segments.open_] = FREE
            values = np.array([UNKNOWN, *(_value(r.kind) for r in segments.regions)], np.uint8)
            mask = segments.label > 0
            cells[mask] = values[segments.label[mask]]
            bottom = on.top - on.resolution * len(cells)
            origin = (round(on.left, 9), round(bottom, 9), 0.0)
            grid = OccupancyGrid(np.ascontiguousarray(cells[::-1]), on.resolution, origin)
            chances = replace(grid, cells=np.ascontiguousarray(probability_cells(segments)[::-1]))
        if parameters.probabilities:
            parts[PartKey("occupancy", key.level, PROBABILITY)] = chances
        if not (grid.cells == FREE).any():
            raise CannotConvert(f"{name} shows no free ground: no field, path, road or room was detected")
        notes.warn("the grid was detected automatically in an image: review it before robots use it", where=key.name)
        parts[PartKey("occupancy", key.level, MAP)] = grid
    return Layers(parts, layers.datum, layers.levels)


def _value(kind: str) -> int:
    """Return the cell value of a region."""
    return OCCUPIED if kind in OBSTACLES else UNKNOWN if kind == "area" else FREE

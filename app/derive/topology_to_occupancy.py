"""Topology -> occupancy: edges of a network are free, objects are occupied."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.derive import DerivationNotes, derives
from app.derive._obstacles import LevelObstacles, sites
from app.derive.objects_to_occupancy import HEIGHT, cell_size, empty_cells, grid_frame
from app.errors import CannotConvert, Invalid, MissingDatum, MissingLayer
from app.model import raster
from app.model.features import Features, Properties
from app.model.fences import fences, level_fence
from app.model.frame import GROUND
from app.model.grid import FREE, OccupancyGrid
from app.model.layers import MAP, Layers, Part, PartKey
from app.parameters import parameter

WIDTH = 1.0
"""Default width of an edge in metres: a robot and some clearance."""

OF_HIGHWAY: Mapping[str, float] = {
    **dict.fromkeys(("motorway", "trunk"), 7.0),
    **dict.fromkeys(("primary", "secondary", "tertiary", "unclassified", "residential"), 5.5),
    **dict.fromkeys(("motorway_link", "trunk_link", "primary_link", "secondary_link", "tertiary_link"), 3.5),
    **dict.fromkeys(("living_street", "pedestrian", "road"), 4.0),
    **dict.fromkeys(("service", "track"), 3.0),
    **dict.fromkeys(("footway", "cycleway", "bridleway"), 2.0),
}
"""OpenStreetMap: default width in metres by class of the way, without width or lanes.

The values are on the narrow side, so that free cells are road.
"""

MAX_WIDTH_METRES = 1000.0
"""Maximum plausible width of an edge in metres."""

MARGIN = 1.0
"""Margin of unknown ground around everything, in metres."""


@dataclass(frozen=True, slots=True)
class Parameters:
    """Parameters of topology_to_occupancy."""

    edge_width: float | None = parameter(
        None,
        f"width of edges without one; default: {WIDTH}, for OpenStreetMap ways the width of their class",
        minimum=0.01,
        maximum=MAX_WIDTH_METRES,
        unit="m",
    )
    resolution: float | None = cell_size()
    stairs: bool = parameter(False, "whether edges over stairs are free ground")
    obstacles: bool = parameter(True, "whether stored obstacles are drawn as occupied")


@derives(
    gives="occupancy",
    needs={"topology"},
    also=frozenset({"objects", "resources", "location"}),
    parameters=Parameters,
    cost=40.0,
    version=3,
)
def topology_to_occupancy(layers: Layers, parameters: Parameters, notes: DerivationNotes) -> Layers:
    """Occupancy grid of a network: free along its edges, occupied by objects, elsewhere unknown.

    Edges have their own width. Objects override edges, except in OpenStreetMap's passages through buildings. A fence
    limits the free space. The origin is a multiple of the resolution, yaw 0. Raises MissingLayer if no edge is
    drivable, MissingDatum for WGS 84 coordinates without a datum, CannotConvert if the grid would be too large.
    """
    around = fences(layers, notes.warn)
    obstacles = _obstacles(layers, notes) if parameters.obstacles else {}
    parts: dict[PartKey, Part] = {}
    for level in dict.fromkeys(key.level for key in layers.vector("topology")):
        open_, through = _free(layers, level, parameters, notes)
        if not len(open_) and not len(through):
            continue
        fence = level_fence(around, level, GROUND)
        box = shapely.total_bounds(np.concatenate([open_, through])).tolist()
        frame = grid_frame(
            (box[0] - MARGIN, box[1] - MARGIN, box[2] + MARGIN, box[3] + MARGIN), parameters.resolution, notes
        )
        cells = empty_cells(
            frame, None, [shapely.Point(box[0], box[1])]
        )  # a floor without an area: everything is unknown
        ground = open_ if fence is None else shapely.intersection(open_, fence)
        raster.paint(cells, raster.areas(ground, frame, touched=False), FREE)
        if level in obstacles:
            section = obstacles[level].cut(HEIGHT, HEIGHT)
            section.draw(cells, frame, HEIGHT, HEIGHT)
            section.draw_unknown(cells, frame)
        if len(through):
            inside = through if fence is None else shapely.intersection(through, fence)
            raster.paint(cells, raster.areas(inside, frame, touched=False), FREE)
        parts[PartKey("occupancy", level, MAP)] = OccupancyGrid(cells, frame.resolution, (*frame.origin, 0.0))
    if not parts:
        raise MissingLayer(
            "the network has no drivable edges to draw free space along: upload a network with edges (if all of them "
            "are stairs, set stairs=true)"
        )
    notes.warn("only the edges of the network are free; all other ground is unknown")
    return Layers(parts, layers.datum, layers.levels)


def _free(
    layers: Layers, level: str, parameters: Parameters, notes: DerivationNotes
) -> tuple[NDArray[np.object_], NDArray[np.object_]]:
    """Return the ground of a level's edges in metres, polygons and lines: of edges outdoors, and through buildings."""
    shapes: list[Any] = []
    through: list[bool] = []
    steps = flat = assumed = 0
    for part in layers.vector("topology", level).values():
        rows, widths, inner = [], [], []
        for k, p in enumerate(part.properties):
            if p.get("kind") != "edge":
                continue
            if p.get("stairs") is True and not parameters.stairs:
                steps += 1
                continue
            width = _width(p)
            assumed += width is None
            rows.append(k)
            widths.append(width or parameters.edge_width or OF_HIGHWAY.get(_tag(p, "highway"), WIDTH))
            inner.append(_tag(p, "tunnel") == "building_passage" or _tag(p, "covered") == "yes")
        lines = _metres(part.select(rows), layers)
        buffers = shapely.buffer(lines, np.array(widths) / 2, quad_segs=4)
        good = ~shapely.is_empty(buffers)
        flat += int(np.count_nonzero(~good))
        # add the lines too: an edge narrower than a cell would have gaps
        shapes += [*buffers[good], *lines[good]]
        through += np.array(inner, bool)[good].tolist() * 2
    notes.drop("edges over stairs", steps, "wheels cannot climb them; see stairs")
    notes.drop("edges without a geometry", flat, "their geometry is missing or empty")
    if assumed:
        width_text = parameters.edge_width or f"{WIDTH} m, for an OpenStreetMap way that of its class"
        notes.fill("width of edges", width_text, f"{assumed} edges state no width", "edge_width")
    areas = np.empty(len(shapes), object)
    areas[:] = shapes
    chosen = np.array(through, bool)
    return areas[~chosen], areas[chosen]


def _metres(part: Features, layers: Layers) -> NDArray[np.object_]:
    try:
        return np.asarray(shapely.force_2d(part.in_local(layers.frame)), object)
    except Invalid as error:  # too far from the datum
        raise CannotConvert(error.detail, error.problems) from error


def _width(p: Properties) -> float | None:
    value = p.get("width")
    good = isinstance(value, (int, float)) and not isinstance(value, bool) and 0 < value <= MAX_WIDTH_METRES
    return float(value) if good and value is not None else None


def _tag(p: Properties, key: str) -> str:
    source_properties = p.get("osm")
    tags = source_properties.get("tags") if isinstance(source_properties, Mapping) else None
    value = tags.get(key) if isinstance(tags, Mapping) else None
    return value if isinstance(value, str) else ""


def _obstacles(layers: Layers, notes: DerivationNotes) -> dict[str, LevelObstacles]:
    """Return the obstacles of each level; none if the objects have WGS 84 coordinates and there is no datum."""
    try:
        return sites(layers, notes)
    except (MissingDatum, CannotConvert) as error:
        notes.warn(f"objects are not drawn; {error.detail}")
        return {}

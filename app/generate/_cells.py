"""Convert a grid to a site: occupied cells become objects whose slice is that grid again; the network follows.

The outline of each piece of occupied cells is exact: a box if the piece is a rectangle, else its extruded outline. Rows
of the arrays are counted from below, as in ``OccupancyGrid``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.derive import DerivationNotes
from app.derive.occupancy_to_topology import Parameters, network
from app.errors import CannotConvert, CannotGenerate
from app.generate import MAX_CELLS, MAX_OBJECTS
from app.generate._site import Site, SiteOptions, invalid_option_error
from app.model.features import Features
from app.model.frame import GROUND
from app.model.grid import OccupancyGrid
from app.model.layers import MAP, NETWORK, Layers, Part, PartKey

Bool = NDArray[np.bool_]

BLOCK = 64
"""Cells along a side of the pieces into which one with a long outline is cut: solids with many corners are slow."""

LONG = 400
"""Maximum number of corners of an outline that is not cut."""


@dataclass(frozen=True, slots=True)
class CellStyle:
    """Object of occupied cells: a kind, its height in metres and its colour in the image."""

    kind: str
    height: float
    colour: str


@dataclass(frozen=True, slots=True)
class GridFrame:
    """Frame of a grid: its lower left corner in metres, metres per cell, cells along x and y."""

    x: float
    y: float
    resolution: float
    columns: int
    rows: int

    @property
    def box(self) -> Any:
        """Return its outline, a polygon in metres."""
        right, top = self.x + self.columns * self.resolution, self.y + self.rows * self.resolution
        return shapely.box(self.x, self.y, round(right, 3), round(top, 3))


def site_grid_frame(site: Site, width: float, depth: float, resolution: float, *, step: int = 1) -> GridFrame:
    """Return the frame of a site's grid: around the environment's fence, else width × depth metres from the origin.

    step: the sides are multiples of this many cells. Raises CannotGenerate before any work for too many cells, or cells
    that are not whole millimetres, the precision of stored coordinates.
    """
    if abs(resolution * 1000 - round(resolution * 1000)) > 1e-6:
        raise invalid_option_error("resolution", f"must be in whole millimetres, got {resolution:g} m")
    size = resolution * step
    if width / size * (depth / size) * step * step > MAX_CELLS:
        raise invalid_option_error(
            "width",
            f"{width:g} × {depth:g} m would be more than {MAX_CELLS} cells of {resolution:g} m: make it smaller",
        )
    low_x, low_y, high_x, high_y = site.set_fence(shapely.box(0.0, 0.0, width, depth)).bounds
    if not site.is_given:
        columns, rows = (max(1, round(v / size)) for v in (width, depth))
        frame = GridFrame(0.0, 0.0, resolution, columns * step, rows * step)
        site.fence = frame.box
        return frame
    x, y = (math.floor(v / resolution + 1e-6) for v in (low_x, low_y))
    columns, rows = (math.ceil((v - o * resolution) / size - 1e-6) for v, o in ((high_x, x), (high_y, y)))
    if columns * rows * step * step > MAX_CELLS:
        raise invalid_option_error("resolution", f"the fence contains more than {MAX_CELLS} cells of {resolution:g} m")
    return GridFrame(round(x * resolution, 3), round(y * resolution, 3), resolution, columns * step, rows * step)


def add_objects(site: Site, place: GridFrame, occupied: Bool, seen: CellStyle) -> None:
    """Add an object for each piece of occupied cells (joined by their sides), all of the same look."""
    pieces = _pieces(occupied)
    if len(pieces) > MAX_OBJECTS:
        raise CannotGenerate(f"the site would have {len(pieces)} objects; the limit is {MAX_OBJECTS}: make it smaller")
    numbers: dict[str, int] = {}
    floor = site.elevation(GROUND)
    shapely.prepare(site.fence)
    for outline in pieces:
        area = shapely.transform(outline, lambda at: np.round(at * place.resolution + [place.x, place.y], 3) + 0.0)
        if site.is_given and not site.fence.intersects(area):
            continue
        numbers[seen.kind] = numbers.get(seen.kind, 0) + 1
        i = f"{seen.kind}/{numbers[seen.kind]}"
        low_x, low_y, high_x, high_y = area.bounds
        if len(outline.exterior.coords) == 5 and not outline.interiors:
            at = ((low_x + high_x) / 2, (low_y + high_y) / 2)
            size = [round(high_x - low_x, 3), round(high_y - low_y, 3), seen.height]
            solid: dict[str, Any] = {"type": "box", "size": size, "pose": [0.0, 0.0, seen.height / 2, 0.0, 0.0, 0.0]}
            if any(round(v * 1000) % 2 for v in size[:2]):  # its centre is no whole millimetre: use its corner
                at = (low_x, low_y)
                solid["pose"][:2] = [round(v / 2, 4) for v in size[:2]]
            words: dict[str, Any] = {"size": size}
        else:
            at = (low_x, low_y)
            rings = [area.exterior, *area.interiors]
            points = [(np.round(shapely.get_coordinates(r)[:-1] - at, 3) + 0.0).tolist() for r in rings]
            solid = {"type": "polyline", "points": points, "height": seen.height}
            words = {"height": seen.height}
        pose = (*at, floor, 0.0)
        site.add_object(i, seen.kind, area, shapes=[solid], pose=pose, colour=seen.colour, **words)


def finish_site(site: Site, options: SiteOptions, notes: DerivationNotes, *, ground: str) -> Layers:
    """Return the site's layers with the network of its grid: the largest piece that its robot can reach."""
    layers = site.finish(ground=ground)
    grid = layers.parts[PartKey("occupancy", GROUND, MAP)]
    if not isinstance(grid, OccupancyGrid):
        raise TypeError("a site has a grid")
    topology = free_space_network(grid, options.robot_radius, notes)
    parts: dict[PartKey, Part] = dict(layers.parts)
    if topology is not None:
        parts[PartKey("topology", GROUND, NETWORK)] = topology
    return Layers(dict(sorted(parts.items())), layers.datum, layers.levels)


def free_space_network(grid: OccupancyGrid, radius: float, notes: DerivationNotes) -> Features | None:
    """Return the network of a grid's free space, in one piece; None, with a warning, if a robot finds no path."""
    network_notes = DerivationNotes()
    # woods, caves and yards are wide: half as dense as in buildings, and no denser than their coarse cells
    reach = max(4.0, 20 * grid.resolution)
    parameters = Parameters(robot_radius=radius, reach=reach, spacing=2 * reach, detour=1.5)
    try:
        topology = network(grid, parameters, network_notes, "the grid")
    except CannotConvert as error:
        notes.warn(f"the site has no network; {error.detail}")
        return None
    notes.dropped += network_notes.dropped
    return _largest(topology, notes)


def _largest(network: Features, notes: DerivationNotes) -> Features:
    """Return the largest piece of a network, by its nodes."""
    place = network.index()
    parent = list(range(len(network)))

    def root(i: int) -> int:
        while parent[i] != i:
            parent[i] = parent[parent[i]]
            i = parent[i]
        return i

    for k, properties in enumerate(network.properties):
        if properties.get("kind") == "edge":
            for end in (properties["source"], properties["target"]):
                parent[root(k)] = root(place[end])
    roots = np.array([root(k) for k in range(len(network))])
    nodes = np.array([properties.get("kind") == "node" for properties in network.properties])
    components, counts = np.unique(roots[nodes], return_counts=True)
    mask = roots == components[int(np.argmax(counts))]
    notes.drop("nodes", int(np.count_nonzero(nodes & ~mask)), "not connected to the rest for this robot")
    return network.select(mask)


def _pieces(occupied: Bool) -> list[Any]:
    """Return the outline in cells of each piece, from below and from the left; long outlines in several pieces."""
    if not occupied.any():
        return []
    rows, columns = occupied.shape
    outlines = _outlines(occupied.astype(np.int32))
    long = [p for p in outlines if shapely.count_coordinates(p) > LONG]
    if long:
        inside = _mask(long, occupied.shape) & occupied
        block = np.arange(rows)[:, None] // BLOCK * (columns // BLOCK + 1) + np.arange(columns)[None, :] // BLOCK + 1
        outlines = [p for p in outlines if shapely.count_coordinates(p) <= LONG]
        outlines += _outlines(np.where(inside, block, 0).astype(np.int32))
    return sorted(outlines, key=lambda p: (p.bounds[1], p.bounds[0], p.wkb))


def _outlines(label: NDArray[np.int32]) -> list[Any]:
    from rasterio import features

    polygons = features.shapes(label, mask=label > 0, connectivity=4)
    return [shapely.normalize(shapely.geometry.shape(s)) for s, _ in polygons]


def _mask(areas: list[Any], shape: tuple[int, int]) -> Bool:
    from rasterio import features

    return np.asarray(features.rasterize([(area, 1) for area in areas], shape, dtype=np.uint8) > 0)


STYLES: Mapping[str, CellStyle] = {
    "wall": CellStyle("wall", 2.5, "wall"),
    "rack": CellStyle("rack", 2.0, "shelf"),
    "furniture": CellStyle("furniture", 0.8, "furniture"),
    "obstacle": CellStyle("obstacle", 1.5, "goods"),
    "rock": CellStyle("rock", 2.5, "wall"),
}

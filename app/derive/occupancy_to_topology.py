"""Occupancy -> topology: the network of paths of a round robot through a grid's free space.

Free space is the set of cells for the robot's centre: those farther than ``robot_radius`` from every obstacle, between
cell centres, as Nav2's inflation layer detects collisions (InflationLayer::computeCost). Unknown cells and everything
beyond the grid are obstacles. Every edge is a straight line that crosses only such cells, so it is collision-free in
any format; its ``width`` is the free width at its narrowest cell. Connected free space gives a connected network. Ids
are derived from positions on a coarse raster, so that most ids stay if that part of the map does not change.

By default a network is as sparse as those that people draw: junctions that are one place, bends within the robot's play
and dead ends that lead nowhere are left out, and open ground gets nodes only where the lines are far (``_sparse``).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from app.derive import DerivationNotes, derives
from app.derive._places import named
from app.errors import CannotConvert, Invalid, Problem, TooLarge
from app.model.features import Features, Properties, SharedKeyDicts, from_columns, points
from app.model.grid import OccupancyGrid, unknown_grey, unknown_grey_as_unknown
from app.model.layers import NETWORK, Layers, Part, PartKey
from app.model.selection import grey_warning, grid_label, select_grids
from app.parameters import parameter

if TYPE_CHECKING:
    from app.derive._skeleton import FreeSpace, Graph

RASTERS = (0.5, 0.1, 0.01)
"""Raster sizes in metres: a node is named after its position on the first one that makes the name unique."""

ONE_PLACE = 0.5
"""Junctions closer than this share of their distance to obstacles are one place."""

METHOD_PARAMETERS: Mapping[str, tuple[str, ...]] = {
    "spacing": ("skeleton", "voronoi"),
    "merge": ("skeleton", "voronoi"),
    "reach": ("skeleton",),
    "detour": ("skeleton",),
    "samples": ("roadmap",),
    "neighbours": ("roadmap",),
    "max_edge": ("roadmap",),
    "seed": ("roadmap",),
}
"""Parameters that apply to some methods only."""


@dataclass(frozen=True, slots=True)
class Parameters:
    """Parameters of occupancy_to_topology."""

    method: Literal["skeleton", "roadmap", "voronoi"] = parameter(
        "skeleton",
        "method; skeleton: centrelines of free space, with a few nodes and straight edges in open ground, as people "
        "draw networks; voronoi: only the lines farthest from all obstacles (generalised Voronoi diagram); roadmap: a "
        "graph for planners, random samples joined by collision-free lines, too dense for people to name or edit",
    )
    grid: str | None = parameter(
        None, "name of the grid; default: map, else the only one on a level that is not a filter mask"
    )
    robot_radius: float = parameter(
        0.3, "radius of the robot; edges keep this distance from obstacles", minimum=0.0, maximum=100.0, unit="m"
    )
    unknown: bool = parameter(False, "whether robots may drive through unknown cells")
    unknown_grey: Literal["unknown", "free"] = parameter(
        "unknown",
        "meaning of cells with grey 205: map_saver writes it for unknown, but a free_thresh of 0.25 reads it as free",
    )
    tolerance: float = parameter(
        0.5,
        "maximum distance of straight edges from the skeleton or diagram, at most half the distance by which the robot "
        "can move aside there",
        minimum=0.0,
        maximum=100.0,
        unit="m",
    )
    spur: float = parameter(
        1.5,
        "length below which dead ends are cut, measured beyond the free circle around their junction",
        minimum=0.0,
        maximum=1000.0,
        unit="m",
    )
    island: float = parameter(
        4.0,
        "diameter below which isolated pieces of free space are dropped, except the largest one",
        minimum=0.0,
        maximum=1e6,
        unit="m",
    )
    merge: float = parameter(
        0.5,
        "skeleton, voronoi: distance below which nodes become one (junctions in wide space: below half their distance "
        "to obstacles), at most half of spacing; 0: no nodes are merged",
        minimum=0.0,
        maximum=100.0,
        unit="m",
    )
    spacing: float = parameter(
        4.0,
        "skeleton, voronoi: maximum distance of nodes along the lines; 0: nodes at corners and crossings only",
        minimum=0.0,
        maximum=1000.0,
        unit="m",
    )
    reach: float = parameter(
        2.0,
        "skeleton: distance from the network beyond which ground gets nodes of its own; 0: nothing is added to the "
        "centrelines",
        minimum=0.0,
        maximum=1000.0,
        unit="m",
    )
    detour: float = parameter(
        1.25,
        "skeleton: ratio of path length to straight line above which a straight edge is added in open ground",
        minimum=1.0,
        maximum=100.0,
    )
    samples: int = parameter(1000, "roadmap: number of samples", minimum=2, maximum=200_000)
    neighbours: int = parameter(10, "roadmap: number of nearest samples to join with", minimum=1, maximum=64)
    max_edge: float = parameter(5.0, "roadmap: maximum length of an edge", minimum=0.01, maximum=1000.0, unit="m")
    seed: int = parameter(0, "roadmap: seed of the samples", minimum=0, maximum=2**31 - 1)


@derives(gives="topology", needs={"occupancy"}, parameters=Parameters, cost=3.0, version=3, also=frozenset({"zones"}))
def occupancy_to_topology(layers: Layers, parameters: Parameters, notes: DerivationNotes) -> Layers:
    """Network of nodes and directed edges along the paths through a grid's free space.

    One network per level. Stored zones of kind room, corridor, door, aisle and row (drawn, or by occupancy_to_zones)
    give their names to nodes. Raises CannotConvert if a grid has no paths (nothing free, no obstacle, too narrow for
    the robot), NotFound or Ambiguous if no grid can be selected, Invalid for parameters of another method.
    """
    _check(parameters)
    parts: dict[PartKey, Part] = {}
    for key, grid in select_grids(layers, parameters.grid, "paths").items():
        derived, missing = named(network(grid, parameters, notes, grid_label(key)), layers, key.level)
        notes.drop("names of areas", missing, f"the network of {key.level} does not lead through them")
        parts[PartKey("topology", key.level, NETWORK)] = derived
    return Layers(parts, layers.datum, layers.levels)


def network(grid: OccupancyGrid, parameters: Parameters, notes: DerivationNotes, called: str) -> Features:
    """Derive the network of one grid. called: name of the grid for messages."""
    grid = _drop_unseen(grid, parameters, notes, called)
    space = _space(grid, parameters, called)
    graph = _lines(space, grid.resolution, parameters, notes, called)
    if parameters.method == "roadmap":
        graph = _roadmap_graph(graph, space, grid.resolution, parameters, notes, called)
    else:
        graph = _sparse_graph(graph, space, grid, parameters, notes, called)
    if not len(graph.edges):
        supply = "a smaller robot_radius, more samples" if parameters.method == "roadmap" else "a smaller robot_radius"
        if parameters.method != "roadmap" and not parameters.spacing:
            supply = "a spacing above 0 (spacing=0 places nodes at corners and crossings only), " + supply
        raise CannotConvert(
            f"{called} has {space.cells} cells for a robot of radius {parameters.robot_radius:g} m, too few for a "
            f"path: use {supply}, or a larger grid"
        )
    row, column, width = space.row, space.column, _widths(space, graph)
    del space  # frees three bytes per cell, which the features may need
    return _features(grid, row, column, graph, width)


def _lines(space: FreeSpace, cell: float, parameters: Parameters, notes: DerivationNotes, called: str) -> Graph:
    """Return the centrelines of a free space, or its diagram, without islands. cell: metres per cell."""
    from app.derive import _skeleton

    is_sparse = parameters.method != "roadmap" and parameters.merge > 0.0
    graph, islands = _skeleton.skeleton(
        space,
        merge=max((parameters.merge if is_sparse else parameters.robot_radius) / cell, 2.0),
        spur=parameters.spur / cell,
        tolerance=parameters.tolerance / cell,
        island=parameters.island / cell,
        radius=parameters.robot_radius / cell,
        share=ONE_PLACE if is_sparse else 0.0,
        voronoi=parameters.method == "voronoi",
    )
    notes.drop(
        "areas of free space", islands, f"{called}: isolated and less than island={parameters.island:g} m across"
    )
    count, _ = _skeleton.pieces(graph)
    if count > 1:
        notes.warn(f"the network has {count} disconnected pieces; the robot does not fit between them", where=called)
    return graph


def _roadmap_graph(
    graph: Graph, space: FreeSpace, cell: float, parameters: Parameters, notes: DerivationNotes, called: str
) -> Graph:
    """Return a roadmap that joins what these lines join."""
    from app.derive import _roadmap

    graph, alone = _roadmap.roadmap(
        space,
        graph,
        samples=parameters.samples,
        neighbours=parameters.neighbours,
        max_edge=parameters.max_edge / cell,
        seed=parameters.seed,
    )
    notes.drop("samples", alone, f"{called}: nothing to join them to, or in dropped areas")
    return graph


def _sparse_graph(
    graph: Graph, space: FreeSpace, grid: OccupancyGrid, parameters: Parameters, notes: DerivationNotes, called: str
) -> Graph:
    """Return the lines with as many nodes as people draw, and with edges across open ground."""
    from app.derive import _skeleton, _sparse

    cell, dropped = grid.resolution, 0
    spacing, island = parameters.spacing / cell, parameters.island / cell
    merge = min(parameters.merge, parameters.spacing / 2.0 or math.inf) / cell
    if merge:
        graph = _sparse.thin_out(
            graph,
            space,
            share=ONE_PLACE,
            radius=parameters.robot_radius / cell,
            tolerance=parameters.tolerance / cell,
        )
        graph, dropped = _sparse.merge_close(graph, space, distance=merge, island=island)
    if spacing:
        graph = _skeleton.divide_edges(graph, space, max(spacing, 2.0))
    if parameters.reach and parameters.method == "skeleton":
        graph = _cover(graph, space, grid, parameters)
    if merge:
        graph, more = _sparse.merge_close(graph, space, distance=merge, island=island)
        dropped += more
    notes.drop(
        "areas of free space",
        dropped,
        f"{called}: less than island={parameters.island:g} m across, behind passages in which the robot has no room",
    )
    return graph


def _cover(graph: Graph, space: FreeSpace, grid: OccupancyGrid, parameters: Parameters) -> Graph:
    """Return the lines with nodes and edges in open ground; a room smaller than ``reach`` gets an edge, too."""
    from app.derive import _sparse

    reach = max(parameters.reach / grid.resolution, 2.0)
    while True:
        phase = _phase(grid, space, max(reach / 2.0, 1.0))
        full = _sparse.cover(graph, space, reach=reach, detour=parameters.detour, phase=phase)
        if len(full.edges) or reach <= 2.0:
            return full
        reach = max(reach / 2.0, 2.0)


def _drop_unseen(grid: OccupancyGrid, parameters: Parameters, notes: DerivationNotes, called: str) -> OccupancyGrid:
    """Return the grid with free cells of grey 205 as unknown, unless unknown_grey is free."""
    grey = unknown_grey(grid)
    if grey is None:
        return grid
    if parameters.unknown_grey == "free":
        notes.warn(grey_warning(grid, grey, called, "edges may lead through unexplored ground"))
        return grid
    notes.warn(grey_warning(grid, grey, called, "no edges lead there; unknown_grey=free keeps them free"))
    return unknown_grey_as_unknown(grid)


def _check(parameters: Parameters) -> None:
    """Raise Invalid for parameters that the chosen method ignores."""
    changed = [f.name for f in fields(parameters) if getattr(parameters, f.name) != f.default]
    wrong = [n for n in changed if parameters.method not in METHOD_PARAMETERS.get(n, (parameters.method,))]
    if wrong:
        methods = {n: " or ".join(METHOD_PARAMETERS[n]) for n in wrong}
        problems = [Problem(f"applies only to method={methods[n]}, not to {parameters.method}", where=n) for n in wrong]
        raise Invalid("; ".join(f"{p.where}: {p.problem}" for p in problems), problems)


def _space(grid: OccupancyGrid, parameters: Parameters, called: str) -> FreeSpace:
    """Return the free space of the robot.

    Raises CannotConvert if there is none, or if the grid has no obstacle.
    """
    from app.derive import _skeleton

    if grid.cells.size >= 2**31 - 2 * (grid.width + grid.height):
        raise TooLarge(f"{called} has {grid.cells.size} cells, the maximum for deriving a network is 2^31")
    free_cells = _skeleton.free_cells(grid, parameters.unknown)
    if free_cells is None:
        counts = grid.counts()
        summary = ", ".join(f"{counts[n]} {n}" for n in ("occupied", "unknown", "other") if counts[n])
        hint = (
            "; unknown=true allows paths through unknown cells" if counts["unknown"] and not parameters.unknown else ""
        )
        raise CannotConvert(
            f"{called} has no free cell ({summary}), so there are no paths: upload a map with free space{hint}"
        )
    free, row, column = free_cells
    if free.shape == (grid.height + 2, grid.width + 2) and free[1:-1, 1:-1].all():
        raise CannotConvert(
            f"{called} is completely free, and paths follow obstacles: upload a map with obstacles, or the network "
            "itself"
        )
    space = _skeleton.space(free, row, column, parameters.robot_radius / grid.resolution)
    if not space.cells:
        widest = _skeleton.widest(space) * grid.resolution
        raise CannotConvert(
            f"{called} is too narrow for a robot of radius {parameters.robot_radius:g} m: free cells are at most "
            f"{widest:.3g} m from obstacles; use a robot_radius below that"
        )
    return space


def _phase(grid: OccupancyGrid, space: FreeSpace, spacing: float) -> tuple[float, float]:
    """Return the row and column in a space at which a lattice fixed to the local frame begins."""
    x, y, yaw = grid.origin
    c, s = math.cos(yaw), math.sin(yaw)
    along, across = (c * x + s * y) / grid.resolution, (c * y - s * x) / grid.resolution
    return (-(across + space.row) % spacing, -(along + space.column) % spacing)


def _widths(space: FreeSpace, graph: Graph) -> NDArray[np.float64]:
    """Compute the free width along each edge, in cells."""
    from app.derive import _kernels_space

    width = np.empty(len(graph.edges))
    _kernels_space.widths(space.gap, graph.nodes, graph.edges, width)
    return width


def _features(grid: OccupancyGrid, row: int, column: int, graph: Graph, width: NDArray[np.float64]) -> Features:
    """Return nodes, then edges in both directions. row, column: the grid's cell at the graph's (0, 0)."""
    x, y, yaw = grid.origin
    c, s = math.cos(yaw), math.sin(yaw)
    u = (graph.nodes[:, 1] + column + 0.5) * grid.resolution
    v = (graph.nodes[:, 0] + row + 0.5) * grid.resolution
    xy = np.round(np.stack([x + c * u - s * v, y + s * u + c * v], axis=1), 9) + 0.0
    names = _names(xy)
    metres = np.round(np.concatenate([width, width]) * grid.resolution, 6).tolist()
    ends = np.concatenate([graph.edges, graph.edges[:, ::-1]])
    order = np.lexsort((ends[:, 1], ends[:, 0]))
    ends, metres = ends[order], [metres[k] for k in order]
    pairs = [(names[a], names[b]) for a, b in ends.tolist()]
    compact = SharedKeyDicts()
    properties: list[Properties] = [compact({"kind": "node", "name": n}) for n in names]
    properties += [
        compact({"kind": "edge", "source": a, "target": b, "width": w}) for (a, b), w in zip(pairs, metres, strict=True)
    ]
    lines = np.asarray(shapely.linestrings(xy[ends]), object)
    geometry = np.concatenate([points(xy), lines])
    return from_columns([*names, *(f"{a}_{b}" for a, b in pairs)], geometry, properties, "local")


def _names(xy: NDArray[np.float64]) -> list[str]:
    """Name each position: ``p`` and its coordinates on the coarsest raster that makes the name unique."""
    names = [""] * len(xy)
    left = np.arange(len(xy))
    for step in RASTERS:
        digits = 2 if step < 0.1 else 1
        cell = np.round(xy[left] / step).astype(np.int64)
        _, place, counts = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
        alone = counts[place.reshape(-1)] == 1
        for k, (i, j) in zip(left[alone].tolist(), (cell[alone] * step + 0.0).tolist(), strict=True):
            names[k] = f"p{i:.{digits}f}_{j:.{digits}f}"
        left = left[~alone]
    for k, (i, j) in zip(left.tolist(), xy[left].tolist(), strict=True):
        names[k] = f"p{i!r}_{j!r}"
    return names

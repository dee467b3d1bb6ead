"""Networks that `occupancy_to_topology` derives, beside networks that people drew over the same grid.

Keys of a label file, besides those that all kinds have:

    map: map.yaml                 # a grid, or a building (*.building.yaml): its walls become the grid (doors open;
                                  # furniture is left out, since only the names of its models are known)
    image, picture: map.pgm       # files that belong to the grid (its image, and another image that it names)
    network: network.tmap2.yaml   # what people drew, in any format
    image_sha256, …               # of each of these files
    level: L1                     # of a building: which level
    shift: [dx, dy]               # metres to add to the network's positions, if its frame is another
    robot_radius: 0.3             # metres
    area: [[x, y], …]             # polygon in metres of the grid, where the network is compared; without it: everywhere

The network is derived from the whole grid with the parameters' defaults and `robot_radius`. Free space is computed
here by SciPy: cells farther than `robot_radius` from every obstacle and unknown cell (grey 205 is unknown); of it, the
pieces count in which people drew. Figures, of both networks where that makes sense:

- nodes: number of nodes with an edge in the area, divided by that of the drawn network.
- coverage: share of the free cells in the area from which a straight collision-free line of at most REACH metres leads
  to the network.
- detour p95: between POINTS random free cells of the area, pairs at least APART metres apart: length of the way over
  the network divided by the shortest way in free space. A way enters and leaves the network within ACCESS metres of
  its ends, or at the nearest place. Shortest ways are those of a graph of 16 neighbours: at most 2.8 % too long.
- close pairs: pairs of nodes nearer than 0.5 m. blocked: edges that touch an obstacle or unknown cell. split: how many
  more pieces the network has than the free space that it lies in.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy import ndimage, sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from app.derive import DerivationNotes
from app.derive.objects_to_occupancy import Parameters as GridParameters
from app.derive.objects_to_occupancy import objects_to_occupancy
from app.derive.occupancy_to_topology import Parameters, network
from app.limits import Limits
from app.model.features import Features
from app.model.grid import FREE, UNKNOWN, OccupancyGrid, unknown_grey
from app.model.layers import Layers
from app.upload_reader import EnvironmentContext, UploadHints, read
from tests.derive.judge import BadLabels, Case, Figure, Result

REACH, ACCESS, APART, CLOSE = 2.0, 2.0, 3.0, 0.5
"""Metres: see above."""

POINTS, CELLS, STEP, NEAREST = 36, 4000, 0.25, 4
"""Random points for detours; random cells for coverage; metres between places along the network's edges; how many of
them are looked at before all within reach are."""

Bool = NDArray[np.bool_]
Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Network:
    """Nodes that have edges. at: float [n, 2] metres. pairs: int [m, 2], indices of nodes, each pair once."""

    at: Floats
    pairs: Ints


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """Free space of a robot. free, area: bool [height, width], row 0 at the bottom; area: free cells that count.

    piece: int, number of the piece of free space of each cell, 0 where it is not free.
    """

    grid: OccupancyGrid
    free: Bool
    piece: NDArray[np.int32]
    area: Bool
    outline: Any

    def cells(self, at: Floats) -> Ints:
        """Row and column of positions in metres."""
        x, y, yaw = self.grid.origin
        assert yaw == 0.0
        cell = np.floor((at[:, ::-1] - [y, x]) / self.grid.resolution).astype(np.int64)
        return np.clip(cell, 0, np.array(self.free.shape) - 1)

    def inside(self, at: Floats) -> Bool:
        """Whether positions lie in the compared area."""
        return np.asarray(shapely.contains_xy(self.outline, at[:, 0], at[:, 1]))


def judge(case: Case) -> Result:
    """Derive the network of the case's grid and compare it with the drawn one."""
    grid = _grid(case)
    drawn = _network_of(_drawn(case), tuple(case.labels.get("shift", (0.0, 0.0))))
    radius = float(case.labels["robot_radius"])
    start = time.process_time()
    made = _network_of(network(grid, Parameters(robot_radius=radius), DerivationNotes(), case.name))
    seconds = Figure("derived in", time.process_time() - start, "CPU s")
    ground = _ground(grid, drawn, radius, case.labels.get("area"))
    figures = [*_compare(made, drawn, ground), seconds]
    return Result(figures, _picture(made, drawn, ground))


def _layers(case: Case, *keys: str) -> Layers:
    files = {case.file(key).name: case.file(key).read_bytes() for key in keys if key in case.labels}
    return read(files, UploadHints(), EnvironmentContext(None, None, None, True, False), Limits()).layers(None)


def _grid(case: Case) -> OccupancyGrid:
    layers = _layers(case, "map", "image", "picture")
    if str(case.labels["map"]).endswith(".building.yaml"):
        level = case.labels["level"]
        walls = {k: p for k, p in layers.parts.items() if k.layer == "objects" and k.level == level}
        building = Layers(walls, layers.datum, layers.levels)
        layers = objects_to_occupancy(building, GridParameters(unknown_radius=0.0), DerivationNotes())
    (grid,) = layers.grids().values()
    return grid


def _drawn(case: Case) -> Features:
    by_level = {key.level: part for key, part in _layers(case, "network").vector("topology").items()}
    level = case.labels.get("level", next(iter(by_level)))
    if level not in by_level:
        raise BadLabels(f"{case.path}: the network has no level {level}; it has {', '.join(by_level)}")
    return by_level[level]


def _network_of(features: Features, shift: tuple[float, float] = (0.0, 0.0)) -> Network:
    index = features.index()
    pairs = {
        tuple(sorted((index[p["source"]], index[p["target"]])))
        for p in features.properties
        if p["kind"] == "edge" and p["source"] != p["target"]
    }
    used, ends = np.unique(np.array(sorted(pairs), np.int64), return_inverse=True)
    at = shapely.get_coordinates(features.geometry[used])[:, :2] + np.array(shift)
    return Network(at, ends.reshape(-1, 2))


def _ground(grid: OccupancyGrid, drawn: Network, radius: float, area: list[list[float]] | None) -> Ground:
    free = grid.cells == FREE
    grey = unknown_grey(grid)
    if grey is not None:
        free &= ~grey
        grid = replace(grid, cells=np.where(grey, np.uint8(UNKNOWN), grid.cells), properties={})
    distance = ndimage.distance_transform_edt(np.pad(free, 1))[1:-1, 1:-1]
    free = distance > radius / grid.resolution * (1 + 1e-9)
    piece, _ = ndimage.label(free, np.ones((3, 3)))
    x, y, _ = grid.origin
    high = (x + grid.width * grid.resolution, y + grid.height * grid.resolution)
    outline = shapely.Polygon(area) if area else shapely.box(x, y, *high)
    shapely.prepare(outline)
    everything = Ground(grid, free, piece, free, outline)
    places, _ = _places(drawn, everything)
    cells = everything.cells(places)
    counts = np.bincount(piece[cells[:, 0], cells[:, 1]], minlength=2)
    counts[0] = 0
    rows, columns = np.nonzero(np.isin(piece, np.flatnonzero(counts >= 0.02 * counts.sum())))
    at = (np.stack([columns, rows], axis=1) + 0.5) * grid.resolution + [x, y]
    chosen = everything.inside(at)
    mask = np.zeros_like(free)
    mask[rows[chosen], columns[chosen]] = True
    return replace(everything, area=mask)


def _places(net: Network, ground: Ground) -> tuple[Floats, sparse.coo_array]:
    """Positions at most STEP apart along the network, and the lengths of the pieces between them.

    Positions that are not free (drawn near walls) move to the nearest free cell up to 0.6 m away.
    """
    at, links = [net.at], []
    count = len(net.at)
    for a, b in net.pairs.tolist():
        length = float(np.hypot(*(net.at[a] - net.at[b])))
        n = max(1, int(np.ceil(length / STEP)))
        inner = np.arange(count, count + n - 1)
        at.append(net.at[a] + (net.at[b] - net.at[a]) * (np.arange(1, n) / n)[:, None])
        chain = np.concatenate([[a], inner, [b]])
        links.append(np.stack([chain[:-1], chain[1:], np.full(n, max(length, 1e-6) / n)], axis=1))
        count += n - 1
    ends = np.concatenate(links)
    pairs = ends[:, :2].astype(np.int64)
    places = np.concatenate(at)
    cell = ground.cells(places)
    blocked = ~ground.free[cell[:, 0], cell[:, 1]]
    if blocked.any():
        r = ground.grid.resolution
        free = np.argwhere(ground.free)
        centres = (free[:, ::-1] + 0.5) * r + np.array(ground.grid.origin[:2])
        far, near = cKDTree(centres).query(places[blocked], distance_upper_bound=0.6)
        moved = places[blocked]
        moved[np.isfinite(far)] = centres[near[np.isfinite(far)]]
        places[blocked] = moved
    return places, sparse.coo_array((ends[:, 2], (pairs[:, 0], pairs[:, 1])), (count, count))


def _compare(made: Network, drawn: Network, ground: Ground) -> list[Figure]:
    random = np.random.default_rng(0)
    cells = np.argwhere(ground.area)
    sample = random.permutation(cells)
    ours, theirs = _places(made, ground), _places(drawn, ground)
    ours_covered, theirs_covered = (_coverage(sample[:CELLS], p, ground) for p, _ in (ours, theirs))
    ours_detour, theirs_detour = _detours(sample[:POINTS], (ours, theirs), ground)
    count, people = int(ground.inside(made.at).sum()), int(ground.inside(drawn.at).sum())
    return [
        Figure("nodes / drawn nodes", count / people, "", 0.5, 2.0),
        Figure("nodes", count),
        Figure("drawn nodes", people),
        Figure("coverage", ours_covered, "", at_least=0.9),
        Figure("coverage of drawn", theirs_covered),
        Figure("detour p95", ours_detour, "", at_most=1.25),
        Figure("detour p95 of drawn", theirs_detour),
        Figure("close pairs", len(cKDTree(made.at).query_pairs(CLOSE - 1e-6)), "", at_most=0),
        Figure("blocked", _blocked(made, ground), "edges", at_most=0),
        Figure("blocked of drawn", _blocked(drawn, ground), "edges"),
        Figure("split", _split(made, ground), "pieces", at_most=0),
    ]


def _clear(start: Ints, end: Ints, mask: Bool) -> Bool:
    """Whether the straight lines between cells ([n, 2] each) stay in a mask, sampled every third of a cell."""
    longest = int(np.abs(end - start).max(initial=1))
    clear = np.ones(len(start), bool)
    for share in np.linspace(0.0, 1.0, 3 * longest + 1):
        at = np.rint(start + (end - start) * share).astype(np.int64)
        clear &= mask[at[:, 0], at[:, 1]]
    return clear


def _coverage(sample: Ints, places: Floats, ground: Ground) -> float:
    """Share of cells that see a place: first the nearest places of each cell are looked at, then all others."""
    target = ground.cells(places)
    reach = math.nextafter(REACH / ground.grid.resolution, math.inf)  # SciPy's bound is exclusive
    tree = cKDTree(target)
    _, near = tree.query(sample, min(NEAREST, len(target)), distance_upper_bound=reach)
    near = near.reshape(len(sample), -1)
    covered = np.zeros(len(sample), bool)
    for other in near.T:
        left = np.flatnonzero(~covered & (other < len(target)))
        covered[left] = _clear(sample[left], target[other[left]], ground.free)
    rest = np.flatnonzero(~covered & (near[:, -1] < len(target)))
    if len(rest):
        pairs = cKDTree(sample[rest]).sparse_distance_matrix(tree, reach, output_type="ndarray")
        cell, other = rest[pairs["i"]], pairs["j"]
        covered[cell[_clear(sample[cell], target[other], ground.free)]] = True
    return float(covered.mean())


def _free_graph(ground: Ground) -> tuple[sparse.csr_array, Ints]:
    """Graph of the free cells with 16 neighbours, in metres, and the number of each cell (-1: not free)."""
    free = np.pad(ground.free, 2)
    number = np.full(free.shape, -1)
    number[free] = np.arange(free.sum())
    rows, columns, lengths = [], [], []
    for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1), (1, 2), (1, -2), (2, 1), (2, -1)):
        sy, sx = int(np.sign(dy)), int(np.sign(dx))
        between = [] if 0 in (dy, dx) else [(sy, sx), (dy - sy, dx - sx)] if sy * dy != sx * dx else [(dy, 0), (0, dx)]
        good = free & np.roll(free, (-dy, -dx), (0, 1))
        for v, u in between:
            good &= np.roll(free, (-v, -u), (0, 1))
        rows.append(number[good])
        columns.append(np.roll(number, (-dy, -dx), (0, 1))[good])
        lengths.append(np.full(len(rows[-1]), np.hypot(dy, dx) * ground.grid.resolution))
    n = int(free.sum())
    graph = sparse.coo_array((np.concatenate(lengths), (np.concatenate(rows), np.concatenate(columns))), (n, n))
    return graph.tocsr(), number[2:-2, 2:-2]


def _detours(points: Ints, networks: tuple[tuple[Floats, sparse.coo_array], ...], ground: Ground) -> tuple[float, ...]:
    graph, number = _free_graph(ground)
    ids = number[points[:, 0], points[:, 1]]
    far = csgraph.dijkstra(graph, directed=False, indices=ids)
    straight = far[:, ids]
    apart = np.triu(np.isfinite(straight) & (straight >= APART), 1)
    out = []
    for places, links in networks:
        cell = ground.cells(places)
        place = number[cell[:, 0], cell[:, 1]]
        access = np.where(place >= 0, far[:, place], np.inf)
        access[access > np.maximum(ACCESS, access.min(axis=1, keepdims=True))] = np.inf
        over = np.array([_over(links, start, access) for start in access])
        out.append(float(np.percentile((over / np.where(apart, straight, 1.0))[apart], 95)))
    return tuple(out)


def _over(links: sparse.coo_array, start: Floats, access: Floats) -> Floats:
    """Lengths of the ways over the network from one point to all. start: [places], its distance to each place."""
    n = len(start)
    entry = np.flatnonzero(np.isfinite(start))
    row = np.concatenate([links.row, np.full(len(entry), n)])
    column = np.concatenate([links.col, entry])
    length = np.concatenate([links.data, np.maximum(start[entry], 1e-9)])
    graph = sparse.coo_array((length, (row, column)), (n + 1, n + 1)).tocsr()
    along = csgraph.dijkstra(graph, directed=False, indices=n)[:n]
    return np.asarray((along + access).min(axis=1))


def _blocked(net: Network, ground: Ground) -> int:
    free = ground.grid.cells == FREE
    ends = ground.cells(net.at)[net.pairs.ravel()].reshape(-1, 2, 2)
    return int((~_clear(ends[:, 0], ends[:, 1], free)).sum())


def _split(net: Network, ground: Ground) -> int:
    links = sparse.coo_array((np.ones(len(net.pairs)), (net.pairs[:, 0], net.pairs[:, 1])), (len(net.at),) * 2)
    _, part = csgraph.connected_components(links, directed=False)
    cell = ground.cells(net.at)
    pieces = ground.piece[cell[:, 0], cell[:, 1]]
    return len({*zip(pieces.tolist(), part.tolist(), strict=True)}) - len({*pieces.tolist()})


def _picture(made: Network, drawn: Network, ground: Ground) -> Image.Image:
    """Return the area: what counts white, other free cells grey, the drawn network blue, the derived one red."""
    grid = ground.grid
    rows, columns = np.nonzero(ground.area)
    margin = int(1.0 / grid.resolution)
    top, left = max(0, rows.min() - margin), max(0, columns.min() - margin)
    bottom, right = rows.max() + margin, columns.max() + margin
    shade = np.full(grid.cells.shape, 150, np.uint8)
    shade[grid.cells == FREE] = 225
    shade[ground.area] = 255
    shade[(grid.cells != FREE) & (grid.cells != UNKNOWN)] = 0
    cut = shade[top:bottom, left:right]
    scale = max(1.0, min(6.0, 1500 / max(cut.shape)))
    size = (round(cut.shape[1] * scale), round(cut.shape[0] * scale))
    image = Image.fromarray(cut[::-1]).resize(size, Image.Resampling.NEAREST).convert("RGB")
    pen = ImageDraw.Draw(image)

    def pixels(at: Floats) -> list[tuple[float, float]]:
        x, y, _ = grid.origin
        u = ((at[:, 0] - x) / grid.resolution - left) * scale
        v = size[1] - ((at[:, 1] - y) / grid.resolution - top) * scale
        return list(zip(u.tolist(), v.tolist(), strict=True))

    for net, colour, width in ((drawn, (60, 120, 255), 2), (made, (220, 30, 0), 3)):
        at = pixels(net.at)
        for a, b in net.pairs.tolist():
            pen.line([at[a], at[b]], colour, width)
        for u, v in at:
            pen.ellipse([u - width - 1, v - width - 1, u + width + 1, v + width + 1], colour)
    return image

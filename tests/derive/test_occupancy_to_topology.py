"""Grids become networks: collision-free, connected as free space is, in the right place, and never silently empty."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np
import pytest
import shapely
from numpy.typing import NDArray
from scipy import ndimage
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from app import derive, formats, parameters
from app.derive import DerivationNotes, occupancy_to_imagery, occupancy_to_voxels, voxels_to_occupancy
from app.derive.occupancy_to_topology import Parameters, network, occupancy_to_topology
from app.errors import Ambiguous, CannotConvert, Invalid, MissingLayer, NotFound
from app.formats import ReadContext, WriteContext
from app.generate import RandomSource, complete_grid
from app.limits import Limits
from app.model.features import Features
from app.model.frame import GROUND, Level
from app.model.grid import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    UNKNOWN_GREY,
    OccupancyGrid,
    pack_cells,
    unknown_grey,
    without_unknown_grey,
)
from app.model.imagery import GeoImage
from app.model.layers import MAP, NETWORK, Layers, PartKey
from app.upload_reader import EnvironmentContext, UploadHints, read

METHODS = ("skeleton", "roadmap", "voronoi")
FARM = "environment_template/riseholme_park_farm_strawberry_polytunnels/config"
DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


def grid(cells: Any, resolution: float = 0.1, origin: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> OccupancyGrid:
    return OccupancyGrid(np.ascontiguousarray(cells, np.uint8), resolution, origin)


def rooms(seed: int = 0, size: int = 120) -> NDArray[np.uint8]:
    """Rooms of different sizes with doors, posts in them, and a sealed one."""
    random = np.random.default_rng(seed)
    cells = np.full((size, size), OCCUPIED, np.uint8)
    third = size // 3
    for row, column in itertools.product(range(3), range(3)):
        cells[row * third + 2 : (row + 1) * third - 2, column * third + 2 : (column + 1) * third - 2] = FREE
        if (row, column) == (2, 2):
            continue
        door = int(random.integers(8, third - 16))
        if column < 2 and (row, column + 1) != (2, 2):
            cells[row * third + door : row * third + door + 9, column * third : (column + 1) * third + 4] = FREE
        if row < 2 and (row + 1, column) != (2, 2):
            cells[row * third : (row + 1) * third + 4, column * third + door : column * third + door + 9] = FREE
    cells[:1], cells[-1:], cells[:, :1], cells[:, -1:] = OCCUPIED, OCCUPIED, OCCUPIED, OCCUPIED
    for y, x in random.integers(5, size - 5, (12, 2)):
        cells[y : y + 2, x : x + 2] = OCCUPIED
    return cells


def derived(g: OccupancyGrid, **values: Any) -> Features:
    derived_layers = occupancy_to_topology(Layers({PartKey("occupancy"): g}), Parameters(**values), DerivationNotes())
    assert set(derived_layers.parts) == {PartKey("topology", "ground", NETWORK)}
    part = derived_layers.parts[PartKey("topology", "ground", NETWORK)]
    assert isinstance(part, Features)
    return part


def graph_of(f: Features) -> nx.DiGraph:
    g = nx.DiGraph()
    for item in f:
        if item.properties["kind"] == "node":
            g.add_node(item.id, at=(item.geometry.x, item.geometry.y))
    for item in f:
        if item.properties["kind"] == "edge":
            a, b = item.properties["source"], item.properties["target"]
            (x0, y0), (x1, y1) = item.geometry.coords
            assert g.nodes[a]["at"] == (x0, y0)
            assert g.nodes[b]["at"] == (x1, y1)
            g.add_edge(a, b, length=item.geometry.length, width=item.properties["width"])
    return g


def cells_at(g: OccupancyGrid, xy: NDArray[np.float64]) -> NDArray[np.intp]:
    """Row and column of places, by the definition of a grid's origin."""
    x, y, yaw = g.origin
    dx, dy = xy[:, 0] - x, xy[:, 1] - y
    u, v = math.cos(yaw) * dx + math.sin(yaw) * dy, math.cos(yaw) * dy - math.sin(yaw) * dx
    return np.stack([np.floor(v / g.resolution), np.floor(u / g.resolution)], axis=1).astype(np.intp)


def distances(g: OccupancyGrid) -> NDArray[np.float64]:
    """Metres from cell centre to the nearest obstacle's centre, with obstacles beyond the grid; by scipy."""
    free = np.pad(g.cells == FREE, 1)
    return np.asarray(ndimage.distance_transform_edt(free))[1:-1, 1:-1] * g.resolution


def along(lines: Sequence[Any], step: float) -> tuple[NDArray[np.float64], NDArray[np.intp]]:
    """Places on lines with about this distance, all in one array, and where in it each line begins."""
    ends = shapely.get_coordinates(lines).reshape(-1, 2, 2)  # straight lines
    length = shapely.length(lines)
    # even: a step to a diagonal neighbour is not met at the corner
    count = np.maximum(2, 2 * np.round(length / step / 2).astype(np.intp))
    begin = np.cumsum(count) - count
    number = np.arange(count.sum()) - np.repeat(begin, count)
    share = (number / np.repeat(count - 1, count))[:, None]
    return np.repeat(ends[:, 0], count, 0) + share * np.repeat(ends[:, 1] - ends[:, 0], count, 0), begin


def check(g: OccupancyGrid, f: Features, radius: float) -> nx.DiGraph:
    """Collision-free everywhere, both ways, and connected where free space is."""
    clearance = distances(g)
    network = graph_of(f)
    both_ways = [item for item in f if item.properties["kind"] == "edge"]
    for item in both_ways:
        back = network.edges[item.properties["target"], item.properties["source"]]
        assert back["width"] == item.properties["width"]
    edges = [item for item in both_ways if item.properties["source"] < item.properties["target"]]
    places, begin = along([item.geometry for item in edges], g.resolution / 5)
    at = cells_at(g, places)
    nearest = np.minimum.reduceat(clearance[at[:, 0], at[:, 1]], begin) if edges else ()
    for item, near in zip(edges, nearest, strict=True):
        assert near > radius, f"{item.id} comes within {near} m"
        # The narrowest of all cells that are touched is at most the narrowest of those that were sampled.
        assert item.properties["width"] <= 2 * near - g.resolution + 1e-6
        assert item.properties["width"] >= max(0.0, 2 * (near - 1.5 * g.resolution) - g.resolution)
    place, _ = ndimage.label(clearance > radius * (1 + 1e-9), np.ones((3, 3)))
    pieces = list(nx.weakly_connected_components(network))
    labels = []
    for piece in pieces:
        at = cells_at(g, np.array([network.nodes[n]["at"] for n in piece]))
        inside = set(place[at[:, 0], at[:, 1]].tolist())
        assert len(inside) == 1, "edges join unconnected free space"
        labels += inside
    assert len(set(labels)) == len(labels), "connected free space has separate networks"
    sizes = np.bincount(place.ravel())[1:]
    assert int(np.argmax(sizes)) + 1 in labels
    return network


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("radius", [0.0, 0.15, 0.3])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_edges_are_free_and_connected_space_stays_connected(method: str, radius: float, seed: int) -> None:
    g = grid(rooms(seed))
    network = check(g, derived(g, method=method, robot_radius=radius, island=0.0), radius)
    assert nx.number_weakly_connected_components(network) >= 2 or method == "roadmap", "the sealed room has ways too"
    graph = nx.Graph(network)
    assert graph.number_of_edges() >= graph.number_of_nodes() - 2


@pytest.mark.parametrize("method", METHODS)
def test_grid_origin_and_yaw_move_the_network(method: str) -> None:
    cells = rooms(3)
    for origin in ((-6.0, 3.5, 0.0), (100.0, -20.0, 0.7), (0.05, 0.05, -2.5)):
        g = grid(cells, origin=origin)
        check(g, derived(g, method=method), 0.3)
    plain, turned = derived(grid(cells), spacing=0.0), derived(grid(cells, origin=(5.0, -3.0, 0.5)), spacing=0.0)
    a = shapely.get_coordinates(plain.select_kinds("node").geometry)
    c, s = math.cos(0.5), math.sin(0.5)
    moved = np.stack([5.0 + c * a[:, 0] - s * a[:, 1], -3.0 + s * a[:, 0] + c * a[:, 1]], axis=1)
    assert np.allclose(moved, shapely.get_coordinates(turned.select_kinds("node").geometry), atol=1e-8)


def test_corridor_gives_expected_network() -> None:
    """Seven free cells of 0.1 m between walls, 40 long: one line along the middle row, 0.7 m wide."""
    cells = np.full((9, 42), OCCUPIED)
    cells[1:8, 1:41] = FREE
    f = derived(grid(cells), robot_radius=0.2, spacing=0.0)
    edges = f.select_kinds("edge")
    rows = shapely.get_coordinates(edges.geometry)[:, 1]
    long = [e for e in edges if e.geometry.length > 2.0]
    assert len(long) == 2
    assert {e.properties["width"] for e in long} == {0.7}
    assert rows.min() >= 0.4
    assert rows.max() <= 0.5
    with pytest.raises(CannotConvert, match=r"free cells are at most 0\.4 m from obstacles"):
        derived(grid(cells), robot_radius=0.4)
    assert len(derived(grid(cells), robot_radius=0.399, spacing=0.0)) == 2 + 2


def test_ring_around_post_stays_ring() -> None:
    cells = np.full((61, 61), FREE)
    cells[[0, -1]], cells[:, [0, -1]] = OCCUPIED, OCCUPIED
    cells[25:36, 25:36] = OCCUPIED
    network = nx.Graph(check(grid(cells), derived(grid(cells), spacing=0.0), 0.3))
    cycles = nx.cycle_basis(network)
    assert len(cycles) == 1
    ring = shapely.Polygon([network.nodes[n]["at"] for n in cycles[0]])
    assert ring.contains(shapely.box(2.5, 2.5, 3.6, 3.6))


def test_unknown_cells_are_obstacles_by_default() -> None:
    cells = rooms(1)
    cells[cells == OCCUPIED] = UNKNOWN
    g = grid(cells)
    check(g, derived(g), 0.3)
    cells = np.full((40, 40), UNKNOWN)
    cells[5:35, 5:12], cells[5:35, 28:35], cells[0, 0] = FREE, FREE, OCCUPIED
    apart = graph_of(derived(grid(cells), island=0.0))
    assert nx.number_weakly_connected_components(apart) == 2
    graph = graph_of(derived(grid(cells), island=0.0, unknown=True))
    assert nx.number_weakly_connected_components(graph) == 1


def test_islands_are_dropped_except_the_largest() -> None:
    cells = rooms(2)
    assert nx.number_weakly_connected_components(graph_of(derived(grid(cells), island=0.0))) > 1
    assert nx.number_weakly_connected_components(graph_of(derived(grid(cells), island=6.0))) == 1
    assert len(derived(grid(cells), island=1e6)) > 10


def test_dropped_places_are_noted() -> None:
    notes = DerivationNotes()
    layers = Layers({PartKey("occupancy"): grid(rooms(2))})
    occupancy_to_topology(layers, Parameters(island=6.0), notes)
    assert [(d.subject, d.count) for d in notes.dropped] == [("areas of free space", 1)]
    assert not notes.warnings
    notes = DerivationNotes()
    occupancy_to_topology(layers, Parameters(island=0.0), notes)
    assert [w.problem.split(";")[0] for w in notes.warnings] == ["the network has 2 disconnected pieces"]
    assert not notes.dropped
    occupancy_to_topology(layers, Parameters(island=6.0, method="roadmap"), notes)
    assert {d.subject for d in notes.dropped} == {"areas of free space", "samples"}


def test_open_space_is_covered_without_detours() -> None:
    cells = np.full((200, 200), FREE)
    cells[[0, -1]], cells[:, [0, -1]] = OCCUPIED, OCCUPIED
    cells[90:110, 60:140] = OCCUPIED
    g = grid(cells)
    f = derived(g, reach=1.5, spacing=3.0, detour=1.2)
    network = check(g, f, 0.3)
    at = np.array([a for _, a in network.nodes(data="at")])
    names = list(network)
    free = np.argwhere(distances(g) > 0.3)
    places, _ = along(f.select_kinds("edge").geometry.tolist(), 0.1)
    away, _ = cKDTree(places).query((free[:, ::-1] + 0.5) * 0.1)
    assert (away <= 1.5).mean() > 0.95
    assert away.max() < 3.0
    lengths = dict(nx.all_pairs_dijkstra_path_length(network, weight="length"))
    random = np.random.default_rng(0)
    worst = 1.0
    for a, b in random.integers(0, len(at), (400, 2)):
        line = shapely.LineString([at[a], at[b]])
        if line.length > 2.0 and not line.intersects(shapely.box(5.6, 8.6, 14.4, 11.4)):
            worst = max(worst, lengths[names[a]][names[b]] / line.length)
    assert worst < 1.35
    sparse = derived(g, spacing=0.0, reach=0.0)
    assert len(sparse.select_kinds("node")) < len(network) / 3


def test_spur_is_cut_and_dead_end_is_not() -> None:
    cells = np.full((60, 120), OCCUPIED)
    cells[20:41, 2:118] = FREE
    cells[15:20, 60] = FREE  # a notch in the wall
    cells[2:20, 90:101] = FREE  # a bay, two metres deep
    with_all = nx.Graph(graph_of(derived(grid(cells), robot_radius=0.0, spacing=0.0, spur=0.0)))
    cut = nx.Graph(graph_of(derived(grid(cells), robot_radius=0.0, spacing=0.0, spur=0.7)))

    def ends(g: nx.Graph, x: float) -> list[float]:
        return [a[1] for n, a in g.nodes(data="at") if g.degree(n) == 1 and abs(a[0] - x) < 0.8]

    assert min(ends(with_all, 6.05)) < 2.0
    assert not ends(cut, 6.05)
    assert min(ends(cut, 9.55)) < 1.2


def test_lines_are_simplified_within_tolerance_and_free_space() -> None:
    steps = np.full((80, 200), OCCUPIED)
    for x in range(2, 198):
        y = 30 + round(8 * math.sin(x / 15))
        steps[y - 6 : y + 7, x] = FREE
    coarse = derived(grid(steps), robot_radius=0.1, spacing=0.0, tolerance=0.3)
    fine = derived(grid(steps), robot_radius=0.1, spacing=0.0, tolerance=0.05)
    free = derived(grid(steps), robot_radius=0.1, spacing=0.0, tolerance=100.0)
    assert len(free) <= len(coarse) < len(fine)
    for f in (coarse, fine, free):
        check(grid(steps), f, 0.1)
    # The middle lines of both agree within the two tolerances.
    lines = shapely.union_all(coarse.select_kinds("edge").geometry)
    assert (
        shapely.hausdorff_distance(lines, shapely.union_all(fine.select_kinds("edge").geometry), 0.2)
        < 0.3 + 0.05 + 0.15
    )


def test_most_ids_stay_when_map_is_unchanged() -> None:
    cells = rooms(4, 240)
    before = derived(grid(cells))
    cells = cells.copy()
    cells[50:53, 50:53] = OCCUPIED
    after = derived(grid(cells))
    nodes = set(before.select_kinds("node").ids)
    assert len(nodes & set(after.select_kinds("node").ids)) > 0.85 * len(nodes)
    # The same place in a map that has grown by a strip on its lower left: nothing moves at all.
    grown = np.full((260, 260), OCCUPIED, np.uint8)
    grown[20:, 20:] = cells
    same = derived(grid(grown, origin=(-2.0, -2.0, 0.0)))
    shared = set(after.select_kinds("node").ids) & set(same.select_kinds("node").ids)
    assert len(shared) > 0.9 * len(after.select_kinds("node"))


def test_roadmaps_are_seeded() -> None:
    g = grid(rooms(5))
    a, b, c = (derived(g, method="roadmap", seed=s, samples=300) for s in (1, 1, 2))
    assert a.ids == b.ids
    assert list(a.properties) == list(b.properties)
    assert a.ids != c.ids
    few, many = (derived(g, method="roadmap", samples=n) for n in (50, 800))
    assert len(few.select_kinds("node")) < 120 < 500 < len(many.select_kinds("node"))
    longest = max(
        e.geometry.length for e in derived(g, method="roadmap", samples=800, max_edge=0.7).select_kinds("edge")
    )
    assert longest < 4.0


def test_roadmap_with_few_samples_finds_narrow_passage() -> None:
    cells = np.full((100, 200), FREE)
    cells[[0, -1]], cells[:, [0, -1]] = OCCUPIED, OCCUPIED
    cells[:, 95:105] = OCCUPIED
    cells[47:56, 95:105] = FREE
    g = grid(cells)
    for seed in range(5):
        network = check(g, derived(g, method="roadmap", samples=20, seed=seed), 0.3)
        assert nx.number_weakly_connected_components(network) == 1


def mean_clearance(g: OccupancyGrid, f: Features) -> float:
    """Metres to the nearest obstacle, on average along all edges."""
    clearance = distances(g)
    lines = [e.geometry for e in f.select_kinds("edge")]
    places, begin = along(lines, g.resolution / 5)
    at = cells_at(g, places)
    mean = np.add.reduceat(clearance[at[:, 0], at[:, 1]], begin) / np.diff(begin, append=len(at))
    return float(np.average(mean, weights=shapely.length(lines)))


@pytest.mark.parametrize("seed", range(4))
def test_voronoi_edges_maximise_distance_to_obstacles(seed: int) -> None:
    g = grid(rooms(seed))
    exact = {"spacing": 0.0, "merge": 0.0, "tolerance": 0.1, "spur": 0.5, "robot_radius": 0.2}
    networks = {
        "skeleton": derived(g, reach=0.0, **exact),
        "voronoi": derived(g, method="voronoi", **exact),
    }
    assert mean_clearance(g, networks["voronoi"]) >= mean_clearance(g, networks["skeleton"])
    assert mean_clearance(g, networks["voronoi"]) > mean_clearance(g, derived(g, robot_radius=0.2))


def test_voronoi_diagram_of_room_is_as_expected() -> None:
    """Two rooms of 4 × 4 m and a door of 0.9 m: through their middles and the door's, and nowhere into the corners."""
    cells = np.full((42, 85), OCCUPIED)
    cells[1:41, 1:41], cells[1:41, 44:84], cells[17:26, 41:44] = FREE, FREE, FREE
    network = nx.Graph(check(grid(cells), derived(grid(cells), method="voronoi", spacing=0.0), 0.3))
    at = np.array([a for _, a in network.nodes(data="at")])
    assert at[:, 0].min() == pytest.approx(2.1, abs=0.15)
    assert at[:, 0].max() == pytest.approx(6.4, abs=0.15)
    assert abs(at[:, 1] - 2.1).max() < 0.2
    # Around a post in the open the diagram is a ring in the middle between it and the walls.
    cells = np.full((81, 81), OCCUPIED)
    cells[1:-1, 1:-1] = FREE
    cells[36:45, 36:45] = OCCUPIED
    ring = nx.Graph(check(grid(cells), derived(grid(cells), method="voronoi", spacing=0.0), 0.3))
    assert len(nx.cycle_basis(ring)) == 1
    away = np.abs(np.array([a for _, a in ring.nodes(data="at")]) - 4.05).max(axis=1)
    assert away.min() > 1.9
    near = derived(grid(cells), method="voronoi", spacing=0.5)
    assert max(e.geometry.length for e in near.select_kinds("edge")) < 0.65


def bad(cells: Any, **values: Any) -> str:
    with pytest.raises(CannotConvert) as caught:
        derived(grid(cells), **values)
    return caught.value.detail


@pytest.mark.parametrize("method", METHODS)
def test_grids_without_paths_raise_cannot_convert(method: str) -> None:
    assert "completely free" in bad(np.full((50, 60), FREE), method=method)
    assert "no free cell (3000 occupied)" in bad(np.full((50, 60), OCCUPIED), method=method)
    unknown = bad(np.full((50, 60), UNKNOWN), method=method)
    assert "no free cell (3000 unknown)" in unknown
    assert "unknown=true" in unknown
    assert "completely free" in bad(np.full((50, 60), UNKNOWN), method=method, unknown=True)
    assert "completely free" in bad([[FREE]], method=method)
    assert "no free cell" in bad([[OCCUPIED]], method=method)
    assert "no free cell (1 other)" in bad([[50]], method=method)
    large = bad(rooms(), method=method, robot_radius=50.0)
    assert "radius 50 m" in large
    assert "use a robot_radius below" in large
    spot = np.full((9, 9), OCCUPIED)
    spot[4, 4] = FREE
    assert "too few for a path" in bad(spot, method=method, robot_radius=0.0)
    assert "'map' of level 'ground'" in bad(spot, method=method, robot_radius=0.0)
    if method != "roadmap":
        assert "use a spacing above 0" in bad(spot, method=method, robot_radius=0.0, spacing=0.0)


def test_thresholds_in_between_are_not_free() -> None:
    cells = rooms(1)
    cells[cells == OCCUPIED] = 40
    check(grid(cells), derived(grid(cells)), 0.3)


def test_grid_selection() -> None:
    g = grid(rooms())
    parts = {PartKey("occupancy", "ground", n): g for n in ("keepout", "map")}
    parts[PartKey("occupancy", "L2", "only")] = g
    layers = Layers(dict(parts), levels=(Level(), Level("L2", 4.0)))
    assert {k.level for k in occupancy_to_topology(layers, Parameters(), DerivationNotes()).parts} == {"ground", "L2"}
    assert {k.level for k in occupancy_to_topology(layers, Parameters(grid="only"), DerivationNotes()).parts} == {"L2"}
    with pytest.raises(NotFound, match="keepout, map, only"):
        occupancy_to_topology(layers, Parameters(grid="nogo"), DerivationNotes())
    parts[PartKey("occupancy", "L2", "second")] = g
    with pytest.raises(Ambiguous, match="only, second"):
        occupancy_to_topology(Layers(dict(parts), levels=layers.levels), Parameters(), DerivationNotes())


def test_masks_are_used_only_when_named() -> None:
    g = grid(rooms())
    mask = Layers({PartKey("occupancy", "ground", "keepout"): g})
    with pytest.raises(MissingLayer, match="masks contain no paths"):
        occupancy_to_topology(mask, Parameters(), DerivationNotes())
    assert occupancy_to_topology(mask, Parameters(grid="keepout"), DerivationNotes()).parts
    both = Layers({**mask.parts, PartKey("occupancy", "ground", "floor"): grid(rooms(1))})
    (network,) = occupancy_to_topology(both, Parameters(), DerivationNotes()).parts.values()
    assert isinstance(network, Features)
    assert network.ids == derived(grid(rooms(1))).ids


def test_network_parameters_are_validated() -> None:
    with pytest.raises(Invalid, match="samples: applies only to method=roadmap, not to skeleton"):
        derived(grid(rooms()), samples=5)
    for method in ("roadmap", "voronoi"):
        with pytest.raises(Invalid, match=f"detour: applies only to method=skeleton, not to {method}"):
            derived(grid(rooms()), method=method, detour=2.0)
    with pytest.raises(Invalid, match="spacing: applies only to method=skeleton or voronoi, not to roadmap"):
        derived(grid(rooms()), method="roadmap", spacing=2.0)
    with pytest.raises(Invalid, match="at least 0"):
        parameters.parse(Parameters, {"robot_radius": "-1"})
    with pytest.raises(Invalid, match="must be one of"):
        parameters.parse(Parameters, {"method": "magic"})
    plan = derive.plan(frozenset({"occupancy"}), frozenset({"topology"}))
    assert plan is not None
    assert [s.name for s in plan.steps] == ["occupancy_to_topology"]


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("method", METHODS)
def test_random_grids_give_valid_network_or_error(method: str, seed: int) -> None:
    random = np.random.default_rng(seed)
    shape = random.integers(3, 90, 2)
    cells = np.where(random.random(shape) < random.choice([0.02, 0.2, 0.4]), OCCUPIED, FREE)
    cells = np.kron(cells, np.ones((2, 2)))
    g = grid(cells)
    for radius in (0.0, 0.1, 0.25):
        try:
            f = derived(g, method=method, robot_radius=radius, island=0.0)
        except CannotConvert:
            assert (distances(g) > radius * (1 + 1e-9)).sum() < 4000
            continue
        check(g, f, radius)


@pytest.fixture(scope="module")
def strawberry() -> tuple[OccupancyGrid, Features]:
    if not (DATA / FARM).is_dir():
        pytest.skip("the real maps are not beside the checkout")
    files = {n: (DATA / FARM / "metric/map" / n).read_bytes() for n in ("map.yaml", "map.png")}
    files["network.tmap2.yaml"] = (DATA / FARM / "topological/network.tmap2.yaml").read_bytes()
    layers = read(files, UploadHints(), EnvironmentContext(None, None, None, True, False), Limits()).layers(None)
    (network,) = layers.vector("topology").values()
    (g,) = layers.grids().values()
    return g, network


def in_pieces(network: nx.DiGraph) -> tuple[csr_array, NDArray[np.float64]]:
    """Return the network in pieces of 10 cm, so that ways may begin in the middle of an edge.

    Also the places that the pieces join; the lengths have one row and column more.
    """
    number = {n: k for k, n in enumerate(network)}
    places = np.array([at for _, at in network.nodes(data="at")])
    lines = [(number[a], number[b], length) for a, b, length in nx.Graph(network).edges(data="length")]
    a, b = np.array([line[:2] for line in lines]).T
    length = np.array([line[2] for line in lines])
    steps = np.maximum(1, np.ceil(length / 0.1)).astype(np.intp)
    line = np.repeat(np.arange(len(lines)), steps)
    piece = np.arange(len(line)) - np.repeat(np.cumsum(steps) - steps, steps)
    is_last = piece == steps[line] - 1
    end = np.where(is_last, b[line], len(places) + np.cumsum(~is_last) - 1)
    begin = np.where(piece == 0, a[line], np.roll(end, 1))
    p, q, share = places[a[line]], places[b[line]], ((piece + 1) / steps[line])[:, None]
    places = np.concatenate([places, (p + (q - p) * share)[~is_last]])
    size = len(places) + 1
    graph = coo_array(
        (np.tile((length / steps)[line], 2), (np.append(begin, end), np.append(end, begin))), (size, size)
    )
    return graph.tocsr(), places


@pytest.mark.parametrize(("method", "ways"), [("skeleton", 0.85), ("roadmap", 0.7)])
def test_strawberry_map_network_matches_hand_drawn_one(
    strawberry: tuple[OccupancyGrid, Features], method: str, ways: float
) -> None:
    """90 % of the nodes within 0.8 m, 85 % of the edges with a path at most 1.3 times as long (random ways: 70 %)."""
    g, by_hand = strawberry
    f = derived(g, method=method, **({"samples": 2500} if method == "roadmap" else {}))
    network = check(g, f, 0.3)
    nodes = by_hand.select_kinds("node")
    at = shapely.get_coordinates(nodes.geometry)[:, :2]
    cell = cells_at(g, at)
    free = g.cells[cell[:, 0], cell[:, 1]] == FREE
    assert free.sum() == 182
    graph, places = in_pieces(network)
    tree = cKDTree(places)
    near = tree.query(at[free])[0] <= 0.8
    assert near.mean() >= 0.9
    index = nodes.index()
    ends = [
        (index[edge.properties["source"]], index[edge.properties["target"]]) for edge in by_hand.select_kinds("edge")
    ]
    wanted = [(a, b) for a, b in ends if a != b and free[a] and free[b]]
    # From the one to the network, along it, and to the other: all of it counts.
    reach = [np.array(tree.query_ball_point(p, 0.8), np.intp) for p in at]
    away = [np.hypot(*(places[v] - p).T) for v, p in zip(reach, at, strict=True)]
    limit = 1.3 * max(math.dist(at[a], at[b]) for a, b in wanted)
    first = np.array([len(places)])
    good = 0
    for a in {a for a, _ in wanted}:
        start = coo_array((away[a], (np.repeat(first, len(reach[a])), reach[a])), shape=graph.shape)
        length = dijkstra((graph + start).tocsr(), indices=len(places), limit=limit)
        for b in (b for start, b in wanted if start == a):
            ways_to_b = length[reach[b]] + away[b]
            good += ways_to_b.min(initial=math.inf) <= 1.3 * math.dist(at[a], at[b])
    total = len(wanted)
    assert total == 413
    assert good / total >= ways


# --- cells of unknown's grey ---


def seen_in_part(free_thresh: float) -> dict[str, bytes]:
    """A map as written by map_saver: a seen room (254), its walls (0), and unseen cells (205) on the right."""
    pixels = np.full((60, 120), 205, np.uint8)
    pixels[5:55, 5:55] = 254
    pixels[[4, 55], 4:56] = 0
    pixels[4:56, 4] = 0
    head = "image: map.pgm\nresolution: 0.1\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\n"
    text = f"{head}free_thresh: {free_thresh}\n"
    return {"map.yaml": text.encode(), "map.pgm": b"P5\n120 60\n255\n" + pixels.tobytes()}


def test_grey_205_cells_have_no_edges_by_default() -> None:
    files = seen_in_part(0.25)
    ((key, grid),) = formats.read(formats.group(files)[0][0], ReadContext()).grids().items()
    assert int((grid.cells == FREE).sum()) == 7200 - 154, "the file is unchanged for Nav2"
    notes = DerivationNotes()
    derived_network = network(grid, Parameters(), notes, "the map")
    assert shapely.total_bounds(derived_network.geometry)[2] < 5.6
    (warning,) = [w.problem for w in notes.warnings if "grey 205" in w.problem]
    assert "4546 cells" in warning
    assert "unknown_grey=free keeps them free" in warning
    notes = DerivationNotes()
    derived_network = network(grid, Parameters(unknown_grey="free"), notes, "the map")
    assert shapely.total_bounds(derived_network.geometry)[2] > 8
    assert "edges may lead through unexplored ground" in notes.warnings[0].problem

    written = formats.write(formats.get_format("occupancy_grid"), Layers({key: grid}), WriteContext())
    assert written["map.pgm"] == files["map.pgm"], "the picture keeps its greys"
    ((_, again),) = formats.read(formats.group(written)[0][0], ReadContext()).grids().items()
    assert again.properties == grid.properties
    usual = formats.read(formats.group(seen_in_part(0.196))[0][0], ReadContext()).grids()
    assert [g.properties for g in usual.values()] == [{}]


def test_hand_drawn_free_cells_are_trusted() -> None:
    ((_, grid),) = formats.read(formats.group(seen_in_part(0.25))[0][0], ReadContext()).grids().items()
    drawn = np.zeros(grid.cells.shape, bool)
    drawn[:, 60:] = True
    before, after = unknown_grey(grid), unknown_grey(without_unknown_grey(grid, drawn))
    assert before is not None
    assert after is not None
    assert (after == before & ~drawn).all()
    assert without_unknown_grey(grid).properties == {}


def test_all_derivations_treat_grey_205_as_unknown() -> None:
    cells, grey = np.full((120, 120), FREE, np.uint8), np.ones((120, 120), bool)
    grey[30:90, 30:90] = False
    cells[30:90, [30, 89]] = cells[[30, 89], 30:90] = OCCUPIED
    cells[5:15, 5:15] = cells[55:58, 55:58] = UNKNOWN
    key = PartKey("occupancy", GROUND, MAP)
    properties = {UNKNOWN_GREY: pack_cells(grey & (cells == FREE))}
    grid = OccupancyGrid(cells, 0.05, free_thresh=0.25, properties=properties)
    layers = Layers({key: grid})
    free = int((cells[30:90, 30:90] == FREE).sum())

    notes = DerivationNotes()
    tall = occupancy_to_voxels.Parameters(height=0.05, free=True)
    voxels = occupancy_to_voxels.occupancy_to_voxels(layers, tall, notes)
    ((_, back),) = (
        voxels_to_occupancy.voxels_to_occupancy(voxels, voxels_to_occupancy.Parameters(), DerivationNotes())
        .grids()
        .items()
    )
    assert back.counts()["free"] == free
    assert "count as unknown" in notes.warnings[0].problem

    (picture,) = occupancy_to_imagery.occupancy_to_imagery(
        layers, occupancy_to_imagery.Parameters(), notes
    ).parts.values()
    assert isinstance(picture, GeoImage)
    assert ((picture.pixels[::-1, :, 3] == 0) == (grey & (cells != OCCUPIED) | (cells == UNKNOWN))).all()

    ((_, full_grid),) = (
        complete_grid.complete_grid(
            layers, complete_grid.Options(confidence=0.0), RandomSource(1, "complete_grid"), notes
        )
        .grids()
        .items()
    )
    assert (full_grid.cells[55:58, 55:58] != UNKNOWN).all()
    assert (full_grid.cells[5:15, 5:15] == UNKNOWN).all(), "nothing near it was seen"
    assert (full_grid.cells[grey & (cells == FREE)] == FREE).all()
    assert "they are not learned from" in notes.warnings[-1].problem

    fmt = formats.get_format("occupancy_grid")
    for values in ({"resolution": 0.1}, {"resolution": 0.025}, {"normalize": True}):
        turned = replace(grid, origin=(0.0, 0.0, 0.3)) if "normalize" in values else grid
        context = WriteContext(options=formats.write_options(fmt, values))
        written = formats.write(fmt, Layers({key: turned}), context)
        ((_, again),) = formats.read(formats.group(written)[0][0], ReadContext()).grids().items()
        left = unknown_grey(again)
        assert left is not None
        area = int(((again.cells == FREE) & ~left).sum()) * again.resolution**2
        assert area == pytest.approx(free * 0.05**2, rel=0.1), values

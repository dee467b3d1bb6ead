"""Derived networks are as sparse as drawn ones: no close nodes, one crossing where corridors cross, few in the open."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import networkx as nx
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from app.derive import DerivationNotes, _skeleton
from app.generate import run
from app.model.frame import GROUND
from app.model.grid import FREE, OCCUPIED
from app.model.layers import MAP, NETWORK, Layers, PartKey
from tests.derive import judge
from tests.derive.test_occupancy_to_topology import along, check, derived, distances, graph_of, grid, rooms

LABELS = Path(__file__).parent / "labels" / "networks"


def positions(network: nx.Graph) -> NDArray[np.float64]:
    return np.array([at for _, at in network.nodes(data="at")])


@pytest.mark.parametrize("method", ["skeleton", "voronoi"])
@pytest.mark.parametrize("seed", range(4))
def test_no_two_nodes_are_close_and_all_stays_connected(method: str, seed: int) -> None:
    random = np.random.default_rng(seed)
    cells = rooms(seed, 150)
    cells[random.random(cells.shape) < 0.004] = OCCUPIED  # specks, as scans have
    g = grid(cells)
    network = check(g, derived(g, method=method, robot_radius=0.2), 0.2)
    assert not cKDTree(positions(network)).query_pairs(0.5 - 1e-6)
    dense = graph_of(derived(g, method=method, robot_radius=0.2, merge=0.0))
    assert len(network) < 0.8 * len(dense)
    assert cKDTree(positions(dense)).query_pairs(0.5)


def test_doors_that_almost_face_each_other_share_a_crossing() -> None:
    """A corridor of 2 m, with a door of 1 m on each side, 0.4 m off: one crossing, not two junctions."""
    cells = np.full((100, 161), OCCUPIED)
    cells[40:60, 1:160] = FREE
    cells[1:40, 70:80] = FREE
    cells[60:99, 74:84] = FREE
    network = nx.Graph(check(grid(cells), derived(grid(cells), reach=0.0), 0.3))
    assert sorted(d for _, d in network.degree() if d != 2) == [1, 1, 1, 1, 4]


def test_tight_gap_is_left_out_if_there_is_another_way() -> None:
    """Two rooms joined by a door of 1.5 m and a gap whose only free cells for the robot touch at a corner."""
    cells = np.full((62, 82), OCCUPIED)
    cells[1:61, 1:40], cells[1:61, 42:81] = FREE, FREE
    cells[20:35, 40:42] = FREE
    with_door = cells.copy()
    cells[12:17, 40], cells[13:18, 41] = FREE, FREE  # two cells of room for a radius of 0.25 m, diagonal
    both = nx.Graph(check(grid(cells), derived(grid(cells), robot_radius=0.25), 0.25))
    door = nx.Graph(check(grid(with_door), derived(grid(with_door), robot_radius=0.25), 0.25))
    assert not cKDTree(positions(both)).query_pairs(0.5 - 1e-6)
    assert len(nx.cycle_basis(both)) <= len(nx.cycle_basis(door)) + 1
    cells[20:35, 40:42] = OCCUPIED  # the gap alone: it must stay
    check(grid(cells), derived(grid(cells), robot_radius=0.25), 0.25)


def test_open_ground_gets_few_nodes() -> None:
    """A hall of 20 × 20 m: no cell is much farther than reach from an edge, and no mesh covers it."""
    cells = np.full((200, 200), FREE)
    cells[[0, -1]], cells[:, [0, -1]] = OCCUPIED, OCCUPIED
    g = grid(cells)
    free = (np.argwhere(distances(g) > 0.3)[:, ::-1] + 0.5) * 0.1
    counts = []
    for reach in (1.5, 2.0, 4.0):
        f = derived(g, reach=reach)
        counts.append(len(check(g, f, 0.3)))
        places, _ = along(f.select_kinds("edge").geometry.tolist(), 0.1)
        assert (cKDTree(places).query(free)[0] <= reach).mean() > 0.9
    assert counts[0] > counts[1] > counts[2]
    assert counts[1] <= 400 / 10
    small = np.full((30, 30), FREE)
    small[[0, -1]], small[:, [0, -1]] = OCCUPIED, OCCUPIED
    assert len(derived(grid(small)).select_kinds("edge")) >= 2, "a room smaller than reach has an edge, too"


@pytest.mark.parametrize("seed", range(3))
def test_nodes_that_see_each_other_have_a_short_path(seed: int) -> None:
    """Every pair within reach in a hall with pillars, by brute force; a triangulation has longer paths between some."""
    random = np.random.default_rng(seed)
    mask = np.zeros((202, 202), np.uint8)
    mask[1:-1, 1:-1] = 1
    for y, x in random.integers(10, 190, (12, 2)):
        mask[y : y + 6, x : x + 6] = 0
    at = random.permutation(np.argwhere(mask))[:40]
    space = _skeleton.space(mask.copy(), 0, 0, 0.0)
    graph = _skeleton.add_edges(_skeleton.Graph(at[:1], np.empty((0, 2), np.int64)), space, at[1:], 1.25, 80.0)
    assert len(graph.nodes) == 40
    assert len(graph.edges) < 40 * 3
    network = nx.Graph()
    for a, b in graph.edges.tolist():
        network.add_edge(a, b, weight=float(np.hypot(*(graph.nodes[a] - graph.nodes[b]))))
    paths = dict(nx.all_pairs_dijkstra_path_length(network))
    compared = 0
    for a, b in combinations(range(40), 2):
        straight = float(np.hypot(*(graph.nodes[a] - graph.nodes[b])))
        share = np.linspace(0.0, 1.0, 2000)[:, None]
        line = np.rint(graph.nodes[a] + (graph.nodes[b] - graph.nodes[a]) * share).astype(np.int64)
        near = ndimage.minimum_filter(mask, 3)[line[:, 0], line[:, 1]].all()  # a line that only touches is left out
        if straight < 80.0 and near:
            compared += 1
            assert paths[a][b] <= 1.25 * straight + 1e-9, (a, b)
    assert compared > 100


def test_nearest_pairs_and_pieces_are_those_of_brute_force() -> None:
    random = np.random.default_rng(5)
    for count in (0, 1, 2, 3, 50):
        at = np.unique(random.integers(0, 2**31 if count == 3 else 60, (count, 2)), axis=0)
        away = np.hypot(*(at[:, None] - at[None]).transpose(2, 0, 1)) if count else np.empty((0, 0))
        expected = {
            (min(a, b), max(a, b))
            for a in range(len(at))
            for b in range(len(at))
            if a != b and away[a, b] < 20.0 and (away[a] < away[a, b]).sum() <= 4
        }
        pairs = _skeleton.near_pairs(at, 20.0, 4)
        assert {*map(tuple, pairs.tolist())} <= expected
        distinct = {(a, b) for a, b in expected if (away[a] == away[a, b]).sum() == (away[b] == away[a, b]).sum() == 1}
        assert {*map(tuple, pairs.tolist())} >= distinct
        graph = nx.Graph(pairs.tolist())
        graph.add_nodes_from(range(len(at)))
        number, piece = _skeleton.pieces(_skeleton.Graph(at, pairs))
        parts = sorted(nx.connected_components(graph), key=min)
        assert number == len(parts)
        assert piece.tolist() == [next(k for k, part in enumerate(parts) if node in part) for node in range(len(at))]


def test_equal_nodes_become_one_and_edges_are_kept_once() -> None:
    last = 2**31 - 2
    nodes = np.array([[5, last], [0, 3], [5, last], [last, 0]])
    graph = _skeleton.tidy(nodes, np.array([[0, 1], [1, 2], [0, 2], [3, 1]]))
    assert graph.nodes.tolist() == [[0, 3], [5, last], [last, 0]]
    assert graph.edges.tolist() == [[0, 1], [0, 2]]


def test_lines_stay_in_the_middle_of_aisles() -> None:
    """A bent aisle of 1.5 m: the tolerance of 0.5 m must not lead edges along its walls."""
    cells = np.full((90, 200), OCCUPIED)
    for x in range(2, 198):
        y = 45 + round(25 * np.sin(x / 40))
        cells[y - 8 : y + 8, x] = FREE
    g = grid(cells)
    network = derived(g, robot_radius=0.2, reach=0.0)
    check(g, network, 0.2)
    assert min(e.properties["width"] for e in network.select_kinds("edge")) > 0.7


@pytest.mark.parametrize(
    ("name", "kept"),
    [
        ("turtlebot3_world", True),
        ("turtlebot3_free_fleet", True),
        ("robast_plan", True),
        ("hotel_l2", True),
        ("triple_h", False),  # detours of 1.3 around its right angles, like those of the drawn network
    ],
)
def test_labelled_grids_give_networks_as_people_draw_them(name: str, kept: bool) -> None:
    if not judge.DATA.is_dir():
        pytest.skip("the real maps are not beside the checkout")
    (case,) = [c for c in judge.cases(LABELS) if c.name == name]
    result = judge.judged(case)
    figures = {figure.name: figure for figure in result.figures}
    assert result.is_kept == kept, {n: f.value for n, f in figures.items() if not f.is_kept}
    for word in ("nodes / drawn nodes", "coverage", "close pairs", "blocked", "split"):
        assert figures[word].is_kept, (word, figures[word].value)
    assert figures["detour p95"].value < figures["detour p95 of drawn"].value


@pytest.mark.parametrize(("name", "values"), [("forest", {"width": 30, "depth": 24}), ("terrain", {"detail": "65"})])
def test_generated_open_sites_have_few_nodes(name: str, values: dict[str, object]) -> None:
    made = run(name, 2, values, Layers({}), DerivationNotes())
    g = made.grids()[PartKey("occupancy", GROUND, MAP)]
    network = made.vector("topology")[PartKey("topology", GROUND, NETWORK)]
    at = positions(graph_of(network))
    area = float((distances(g) > 0.3).sum()) * g.resolution**2
    assert len(at) < area / 6
    assert not cKDTree(at).query_pairs(0.5 - 1e-6)

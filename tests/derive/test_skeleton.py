"""The thinning against scikit-image's, its graph against skan's idea of one, and the folder of compiled code."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from functools import cache
from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage
from skimage.measure import euler_number, label
from skimage.morphology import skeletonize

from app import native
from app.derive import DerivationNotes, _skeleton
from app.derive import _kernels_skeleton as kernels
from app.derive import _kernels_space as space_kernels
from app.derive import _kernels_voronoi as voronoi_kernels
from app.derive._kernels_thinning import thin
from app.derive.occupancy_to_topology import Parameters, network
from app.errors import CannotConvert
from app.model.grid import FREE, OccupancyGrid
from tests.derive.test_occupancy_to_topology import rooms, strawberry  # noqa: F401

Mask = NDArray[np.bool_]


def thinned(mask: Mask) -> Mask:
    padded = np.pad(mask.astype(np.uint8), 1)
    count = thin(padded)
    assert count == padded.sum()
    assert set(np.unique(padded)) <= {0, 1}
    return np.asarray(padded[1:-1, 1:-1] == 1)


def same_topology(skeleton: Mask, mask: Mask) -> None:
    assert not (skeleton & ~mask).any()
    assert label(skeleton, connectivity=2).max() == label(mask, connectivity=2).max(), "pieces"
    assert euler_number(skeleton, 2) == euler_number(mask, 2), "holes"
    library = skeletonize(mask)
    assert label(skeleton, connectivity=2).max() == label(library, connectivity=2).max()
    assert euler_number(skeleton, 2) == euler_number(library, 2)


def one_cell_wide(skeleton: Mask) -> None:
    """No cell except ends can be deleted without changing pieces or holes: checked cell by cell with the library."""
    padded = np.pad(skeleton, 1)
    for y, x in np.argwhere(padded):
        assert needed(padded[y - 1 : y + 2, x - 1 : x + 2].tobytes()), (y, x)


@cache
def needed(window: bytes) -> bool:
    """Whether the middle of 3 × 3 cells is an end, or changes pieces or holes when it goes."""
    around = np.frombuffer(window, np.bool_).reshape(3, 3).copy()
    if around.sum() <= 2:
        return True
    around[1, 1] = False
    cut = label(around, connectivity=2).max() > 1
    # a cell whose four sides are all set encloses nothing when it stays, and a hole when it is deleted
    opened = label(~np.pad(around, 1), connectivity=1).max() > 1
    return bool(cut or opened)


def masks(count: int) -> list[Mask]:
    random = np.random.default_rng(7)
    out = []
    for k in range(count):
        shape = random.integers(1, 60, 2)
        mask = random.random(shape) < random.choice([0.05, 0.2, 0.5, 0.7, 0.9, 0.97])
        if k % 3 == 1:
            mask = np.kron(mask, np.ones((4, 4))) > 0
        elif k % 3 == 2:
            mask = ndimage.gaussian_filter(random.random((80, 90)), random.uniform(1, 4)) > 0.5
        out.append(mask)
    return out


def ridges(mask: Mask) -> Mask:
    """The generalised Voronoi diagram of a mask."""
    free_space = _skeleton.space(np.pad(mask.astype(np.uint8), 1), 0, 0, 0.0)
    padded = free_space.mask.copy()
    assert _skeleton.ridges(padded, free_space.gap) == padded.sum()
    assert set(np.unique(padded)) <= {0, 1}
    return np.asarray(padded[1:-1, 1:-1] == 1)


def test_voronoi_diagrams_keep_pieces_and_holes() -> None:
    for mask in masks(240):
        diagram = ridges(mask)
        same_topology(diagram, mask)
        one_cell_wide(diagram)


def test_distances_to_the_nearest_obstacle_are_exact() -> None:
    for mask in masks(30):
        free = np.pad(mask.astype(np.uint8), 1)
        gap = np.zeros(free.shape, np.uint16)
        space_kernels.gaps(free, gap)
        far, column = np.zeros(free.shape, np.int64), np.zeros(free.shape, np.int64)
        at, until = np.zeros(free.shape[1], np.int64), np.zeros(free.shape[1] + 1)
        for y in range(len(free)):
            voronoi_kernels.envelope(gap, y, at, until, far[y], column[y])
        assert voronoi_kernels.farthest(free, gap) == far.max()
        assert np.allclose(np.sqrt(far), ndimage.distance_transform_edt(free))
        rows = np.arange(len(free))[:, None]
        across = np.arange(free.shape[1])[None, :] - column
        assert (across**2 + gap[rows, column].astype(np.int64) ** 2 == far).all()


@pytest.mark.parametrize("band", [1, 50, 700])
def test_voronoi_thinning_in_parts_equals_whole(band: int, monkeypatch: pytest.MonkeyPatch) -> None:
    mask_list = masks(60)
    diagrams = [ridges(mask) for mask in mask_list]
    monkeypatch.setattr(_skeleton, "BAND", band)
    for mask, diagram in zip(mask_list, diagrams, strict=True):
        assert (ridges(mask) == diagram).all()


def test_sorted_cells_come_in_bands_of_requested_size() -> None:
    random = np.random.default_rng(3)
    mask, rank = (random.random((40, 50)) < 0.6).astype(np.uint8), random.integers(0, 65536, (40, 50)).astype(np.uint16)
    rank[:20] = 7  # more than a part holds
    parts = list(_skeleton._cells_by_rank(mask, rank, 100))
    places = np.flatnonzero(mask)
    assert np.concatenate(parts).tolist() == places[np.argsort(rank.ravel()[places], kind="stable")].tolist()
    assert sorted(map(len, parts))[-2:] <= [100, int(mask[:20].sum()) + 100]
    assert len(parts) > 5


def test_thinning_keeps_topology_like_reference_library() -> None:
    for mask in masks(240):
        same_topology(thinned(mask), mask)


def test_lines_are_one_cell_wide() -> None:
    for mask in masks(36):
        one_cell_wide(thinned(mask))


@pytest.mark.parametrize(
    "mask",
    [
        *(np.ones(shape) for shape in ((1, 1), (2, 2), (50, 50), (2, 30))),
        *(np.eye(9), np.indices((9, 9)).sum(0) % 2, np.kron(np.eye(9), np.ones((2, 2))), np.zeros((4, 4))),
    ],
)
def test_thinning_of_special_masks(mask: Any) -> None:
    same_topology(thinned(mask > 0), mask > 0)


def test_thinning_equals_zhang_suen_before_last_step() -> None:
    """Against the rules of the paper, written down plainly."""

    around = ((1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1), (0, 1), (1, 1))

    def plain(mask: Mask) -> Mask:
        p = np.pad(mask, 1).astype(np.uint8)
        while True:
            deleted = 0
            for odd in (True, False):
                n = [np.roll(p, s, (0, 1)) for s in around]
                total = sum(v.astype(int) for v in n)
                rises = sum(((n[k] == 0) & (n[(k + 1) % 8] == 1)).astype(int) for k in range(8))
                north, east, south, west = n[0], n[2], n[4], n[6]
                first, second = (east * south * (north | west)), (north * west * (east | south))
                go = (p == 1) & (total >= 2) & (total <= 6) & (rises == 1) & ((first if odd else second) == 0)
                deleted += int(go.sum())
                p[go] = 0
            if not deleted:
                return np.asarray(p[1:-1, 1:-1] == 1)

    for mask in masks(90):
        expected = plain(mask)
        skeleton = thinned(mask)
        # Ours goes one step further (redundant cells) and keeps lone 2 × 2 blocks, which the paper's rules delete.
        extra = skeleton & ~expected
        blocks = label(mask, connectivity=2)
        missing_blocks = set(np.unique(blocks[mask])) - set(np.unique(blocks[expected]))
        assert set(np.unique(blocks[extra])) <= missing_blocks
        assert len(np.argwhere(extra)) == len(missing_blocks)


def test_thinning_of_real_map(strawberry: Any) -> None:  # noqa: F811
    free = strawberry[0].cells == FREE
    (rows, columns), margin = np.nonzero(free), 20
    seen = free[rows.min() - margin : rows.max() + margin, columns.min() - margin : columns.max() + margin]
    assert seen.sum() == free.sum() > 1_000_000, "the scan begins in the middle of its grid"
    same_topology(thinned(seen), seen)


def test_distances_are_exact() -> None:
    random = np.random.default_rng(3)
    for _ in range(20):
        free = np.pad((random.random(random.integers(2, 60, 2)) < 0.93).astype(np.uint8), 1)
        gap = np.empty(free.shape, np.uint16)
        space_kernels.gaps(free, gap)
        expected = ndimage.distance_transform_edt(free)
        cells = np.argwhere(free)
        got = np.zeros(len(cells))
        space_kernels.clearances(gap, cells, got)
        assert np.allclose(got, expected[free == 1])
        for radius in (0.0, 0.5, 1.0, 1.5, 2.3, 5.0):
            out = np.empty_like(free)
            count = space_kernels.erode(gap, radius**2, out)
            assert (out == (expected > radius)).all()
            assert count == out.sum()


def test_clear_lines_visit_every_touched_cell() -> None:
    """Against shapely: a line is clear where it touches no blocked cell, be it at a corner."""
    import shapely

    random = np.random.default_rng(5)
    mask = np.pad((random.random((30, 30)) < 0.9).astype(np.uint8), 1)
    blocked = shapely.union_all([shapely.box(x - 0.5, y - 0.5, x + 0.5, y + 0.5) for y, x in np.argwhere(mask == 0)])
    seen = set()
    for y0, x0, y1, x1 in random.integers(1, 31, (600, 4)):
        line = shapely.LineString([(x0, y0), (x1, y1)]) if (y0, x0) != (y1, x1) else shapely.Point(x0, y0)
        expected = not shapely.intersects(blocked, line)
        if bool(space_kernels.clear(mask, y0, x0, y1, x1)) != expected:
            pytest.fail(f"{(y0, x0, y1, x1)}: {expected}")
        seen.add(expected)
    assert seen == {True, False}


def test_narrowest_cell_of_line_is_exact() -> None:
    """Compared with all cells that the line touches, by shapely, and scipy's distances."""
    import shapely

    random = np.random.default_rng(6)
    for share in (0.01, 0.1):
        free = np.pad((random.random((40, 40)) >= share).astype(np.uint8), 1)
        gap = np.empty(free.shape, np.uint16)
        space_kernels.gaps(free, gap)
        expected = ndimage.distance_transform_edt(free)
        boxes = [shapely.box(x - 0.5, y - 0.5, x + 0.5, y + 0.5) for y, x in np.ndindex(free.shape)]
        for y0, x0, y1, x1 in random.integers(1, 41, (200, 4)):
            touched = shapely.intersects(boxes, shapely.LineString([(x0, y0), (x1, y1)])).reshape(free.shape)
            assert space_kernels.narrowest(gap, y0, x0, y1, x1) == round(expected[touched].min() ** 2)


def network_of(graph: Any) -> nx.MultiGraph:
    nodes, start, end, begin, _ = graph
    g = nx.MultiGraph()
    g.add_nodes_from(range(len(nodes)))
    for e, (a, b) in enumerate(zip(start.tolist(), end.tolist(), strict=True)):
        g.add_edge(a, b, cells=int(begin[e + 1] - begin[e]))
    return g


def test_graph_covers_skeleton() -> None:
    """As many pieces and loops as the skeleton has pieces and holes, and its paths are all of its cells."""
    for mask in masks(90):
        skeleton = thinned(mask)
        padded = np.pad(skeleton.astype(np.uint8), 1)
        cells = np.empty((int(padded.sum()), 2), np.int32)
        rows = np.empty(len(padded) + 1, np.int64)
        kernels.list_cells(padded, cells, rows)
        assert (cells == np.argwhere(padded)).all()
        graph = kernels.trace(padded, cells, rows)
        nodes, start, end, begin, path = graph
        g = network_of(graph)
        assert nx.number_connected_components(g) == label(skeleton, connectivity=2).max()
        assert set(nodes.tolist()) | set(path.tolist()) == set(range(len(cells)))
        for e in range(len(start)):
            path_cells = cells[path[begin[e] : begin[e + 1]]]
            assert (np.abs(np.diff(path_cells, axis=0)).max(axis=1) == 1).all(), "each cell is next to the one before"
            assert path[begin[e]] == nodes[start[e]]
            assert path[begin[e + 1] - 1] == nodes[end[e]]
        merged = kernels.contract(graph, np.full(padded.shape, 3, np.uint16) * padded, cells, 1.5)
        assert nx.number_connected_components(network_of(merged)) == nx.number_connected_components(g)
        for e in range(len(merged[1])):
            path_cells = cells[merged[4][merged[3][e] : merged[3][e + 1]]]
            assert (np.abs(np.diff(path_cells, axis=0)).max(axis=1) == 1).all()


def test_hostile_shapes_are_thinned_quickly() -> None:
    board = np.indices((150, 150)).sum(0) % 2 * 100  # each free cell a node with four edges
    comb = np.full((300, 301), FREE)
    comb[:-1, ::2] = 100
    maze = np.full((301, 301), 100)
    maze[1::2, 1:-1] = FREE
    maze[2::4, -2], maze[4::4, 1] = FREE, FREE
    network(OccupancyGrid(rooms(), 0.1), Parameters(), DerivationNotes(), "it")  # compiled, or loaded
    started = time.process_time()
    for cells in (board, comb, maze):
        for radius in (0.0, 0.01, 3.0):
            grid = OccupancyGrid(cells.astype(np.uint8), 0.05)
            try:
                network(grid, Parameters(robot_radius=radius), DerivationNotes(), "it")
            except CannotConvert:
                assert radius > 0.04
    assert time.process_time() - started < 30


STAGES = """
import os, sys
from pathlib import Path
import numba
import numpy as np
from app import native
from app.sandbox import SandboxPolicy, confine, landlock_version

assert "app.derive._kernels_space" in native._modules()
native._modules = lambda: ["app.derive._kernels_space"]

def own_process(stage):  # forked: with numba, whose import takes longest, but without our kernels
    if not os.fork():
        stage()
        os._exit(0)
    assert os.wait()[1] == 0

def use(confined):
    assert not confined or confine(SandboxPolicy()) or not landlock_version()
    from app.derive import _kernels_space as k
    gap, mask = np.full((5, 5), 3, np.uint16), np.zeros((5, 5), np.uint8)
    assert k.erode(gap, 4.0, mask) == mask.sum() == 25
    os.write(1, b"%d\\n" % sum(k.erode.stats.cache_hits.values()))

numba.njit(lambda x: x + 1)(1)
folder = Path(os.environ["NUMBA_CACHE_DIR"])
own_process(lambda: use(True))
own_process(lambda: native.fill(folder))
before = sorted(p.name for p in folder.rglob("*"))
assert any("erode" in n for n in before)
own_process(lambda: use(True))
assert sorted(p.name for p in folder.rglob("*")) == before
for file in folder.rglob("*.nb?"):
    file.write_bytes(b"nonsense")
own_process(lambda: use(False))
"""


def test_compiled_code_is_read_from_read_only_directory_unless_damaged(tmp_path: Path) -> None:
    """In a confined process, as on the server: filled before, read there; absent, compiled in memory.

    Damaged, for a process that may write: compiled anew.
    """
    env = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "native"), "PYTHONDONTWRITEBYTECODE": "1"}
    process = subprocess.run([sys.executable, "-c", STAGES], env=env, capture_output=True, text=True, check=False)
    assert process.returncode == 0, process.stderr
    assert process.stdout.split() == ["0", "1", "0"]


def test_cache_directory_that_cannot_be_created_is_ignored(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(native.FOLDER, "/proc/nowhere")
    double = native.native(lambda x: 2 * x)
    assert double(21) == 42

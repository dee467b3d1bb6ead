"""Perturbation: objects moved, removed and added; objects, grids and networks still agree."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
import yaml
from PIL import Image

from app import generate
from app.derive import DerivationNotes
from app.errors import CannotGenerate, Invalid, MissingLayer
from app.generate import _reach
from app.generate._site import Site, SiteOptions
from app.model.features import Features, features
from app.model.grid import FREE, OCCUPIED, UNKNOWN, UNKNOWN_GREY, OccupancyGrid, pack_cells, unknown_grey
from app.model.layers import Layers, PartKey
from tests.api.conftest import Api
from tests.generate.site_checks import digest, make, world

STILL = {"speckle": 0.0, "erode": 0.0, "dilate": 0.0, "dropped": 0}
"""No noise."""

ALONE = {**STILL, "shift": 0.0, "turn": 0.0, "row_shift": 0.0, "missing": 0.0, "obstacles": 0}
"""Nothing at all."""


def disturbed(given: Layers, seed: int = 7, **values: Any) -> tuple[Layers, Layers, DerivationNotes]:
    """(the environment after it, the changed parts, the notes)"""
    notes = DerivationNotes()
    new_layers = generate.run("perturbation", seed, values, given, notes)
    return Layers({**given.parts, **new_layers.parts}, new_layers.datum, new_layers.levels), new_layers, notes


def orchard() -> Layers:
    """Four rows of nine posts, 3 m apart, 2 m in the row, with a way between two of them."""
    site = Site(Layers(), SiteOptions(resolution=0.05), DerivationNotes())
    site.set_fence(shapely.box(-3, -3, 20, 13))
    for row in range(4):
        for k in range(9):
            site.post(f"tree/{row}/{k}", "tree", (2.0 * k, 3.0 * row), 0.15, 2.5)
    site.box("shed", "building", (10, 11.5), (8, 1, 3))
    for k in range(9):
        site.node(f"n{k}", (2.0 * k, 4.5))
    for k in range(8):
        site.add_edges(f"n{k}", f"n{k + 1}")
    return site.finish()


def objects(layers: Layers, name: str = "generated") -> Features:
    part = layers.parts[PartKey("objects", "ground", name)]
    assert isinstance(part, Features)
    return part


def grid(layers: Layers) -> OccupancyGrid:
    part = layers.parts[PartKey("occupancy")]
    assert isinstance(part, OccupancyGrid)
    return part


def network(layers: Layers) -> Features:
    (part,) = layers.vector("topology").values()
    return part


def places(part: Features) -> dict[str, Any]:
    return {i: np.array(p["pose"]) for i, p in zip(part.ids, part.properties, strict=True)}


def edges_are_free(layers: Layers, radius: float = 0.3) -> None:
    for key, part in layers.vector("topology").items():
        grid = layers.grids().get(PartKey("occupancy", key.level))
        assert grid is not None
        lines = [
            g
            for g, p in zip(part.geometry, part.properties, strict=True)
            if p["kind"] == "edge" and not p.get("blocked")
        ]
        assert lines
        assert _reach.passable(grid, lines, radius).all()


def test_grid_and_network_follow_moved_objects() -> None:
    before = orchard()
    after, new_layers, notes = disturbed(before, **STILL, missing=0.2, obstacles=6)
    then, now = places(objects(before)), places(objects(after))
    assert 0 < len(then) - len(now) < 20
    assert set(now) < set(then)
    assert (now["shed"] == then["shed"]).all(), "built objects stay"
    away = [float(np.hypot(*(now[i] - then[i])[:2])) for i in now if i != "shed"]
    assert 0 < max(away) <= 0.1 + 0.15 + 1e-3
    new = objects(after, "perturbation")
    assert len(new) == 6
    assert {p["shapes"][0]["type"] for p in new.properties} == {"box", "cylinder"}
    world(after, 0.2)  # its slice is its grid
    assert (grid(after).cells != grid(before).cells).mean() > 0.001
    edges_are_free(after)
    assert set(network(after).ids) <= set(network(before).ids)
    assert any("6 new obstacles" in w.problem for w in notes.warnings)
    assert {k.layer for k in new_layers.parts} <= {"objects", "occupancy", "topology"}


@pytest.mark.parametrize("site", ["hospital", "warehouse", "cluttered_hall"])
def test_perturbed_sites_stay_consistent(site: str) -> None:
    before, _ = make(site)
    after, _, _ = disturbed(before, **STILL, obstacles=12)
    world(after, 0.2)
    edges_are_free(after)
    noisy, _, _ = disturbed(before, severity=3.0, obstacles=12)
    edges_are_free(noisy)  # there is no noise where robots drive


def test_perturbation_is_repeatable_and_seeded() -> None:
    before = orchard()
    a, b, c = (digest(disturbed(before, seed)[1]) for seed in (7, 7, 8))
    assert a == b != c
    assert a == "58a976ef664b428f950c07b955da2b4b221b8b067aede79d9bec9e4767b554ba"


def test_rows_move_as_a_whole() -> None:
    before = orchard()
    after, _, notes = disturbed(before, **{**ALONE, "row_shift": 0.3})
    then, now = places(objects(before)), places(objects(after))
    by = {i: tuple(np.round(now[i][:2] - then[i][:2], 3).tolist()) for i in then}
    rows = [{by[f"tree/{row}/{k}"] for k in range(9)} for row in range(4)]
    assert all(len(row) == 1 for row in rows)
    assert len(set().union(*rows)) == 4, "each in its own way"
    assert any("36 objects moved (4 rows)" in w.problem for w in notes.warnings)


def test_turned_objects_keep_shape_and_do_not_collide() -> None:
    pieces = []
    for k in range(6):
        size = {"type": "box", "size": [1.0, 0.4, 1.0], "pose": [0, 0, 0.5, 0, 0, 0]}
        properties = {"kind": "table", "pose": [0.5 * k, 0.0, 0.0, 0.0, 0.0, math.pi / 2], "shapes": [size]}
        pieces.append((f"t{k}", shapely.box(0.5 * k - 0.2, -0.5, 0.5 * k + 0.2, 0.5), properties))
    before = Layers({PartKey("objects", "ground", "gazebo"): features(pieces, "local")})
    after, _, notes = disturbed(before, **{**ALONE, "shift": 0.3, "turn": 40.0})
    part = objects(after, "gazebo")
    for i, g, p in zip(part.ids, part.geometry, part.properties, strict=True):
        assert g.area == pytest.approx(0.4, abs=0.01), i
        ring = shapely.box(-0.5, -0.2, 0.5, 0.2)
        c, s = math.cos(p["pose"][5]), math.sin(p["pose"][5])
        turn = np.array([[c, -s], [s, c]])
        seen = shapely.transform(ring, lambda at, t=turn, p=p: at @ t.T + p["pose"][:2])
        assert shapely.hausdorff_distance(seen, g) < 0.01, "pose and outline agree"
    for k, a in enumerate(part.geometry):
        assert not any(a.intersects(b) for b in part.geometry[k + 1 :])
    assert any(d.subject == "moves of objects" for d in notes.dropped)


def room(cells: Any = None, origin: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> OccupancyGrid:
    """Twelve by eight metres with walls, three boxes and an unseen corner."""
    if cells is None:
        cells = np.zeros((160, 240), np.uint8)
        cells[[0, 1, -2, -1]] = cells[:, [0, 1, -2, -1]] = OCCUPIED
        for x, y in ((60, 40), (120, 80), (180, 120)):
            cells[y : y + 10, x : x + 16] = OCCUPIED
        cells[130:150, 10:40] = UNKNOWN
    return OccupancyGrid(cells, 0.05, origin)


def lane(*ys: float) -> Features:
    """Lanes across the room."""
    rows: list[tuple[str, Any, dict[str, Any]]] = []
    for k, y in enumerate(ys):
        rows += [(f"a{k}", shapely.Point(1, y), {"kind": "node"}), (f"b{k}", shapely.Point(11, y), {"kind": "node"})]
        line = shapely.LineString([(1, y), (11, y)])
        rows.append((f"e{k}", line, {"kind": "edge", "source": f"a{k}", "target": f"b{k}"}))
    return features(rows, "local")


def test_grid_without_objects_has_its_pieces_moved() -> None:
    before = Layers({PartKey("occupancy"): room()})
    after, new_layers, notes = disturbed(before, **{**ALONE, "shift": 0.6})
    assert {k.layer for k in new_layers.parts} == {"occupancy"}
    cells, old = grid(after).cells, grid(before).cells
    assert (cells == OCCUPIED).sum() == (old == OCCUPIED).sum()
    assert (cells[:2] == OCCUPIED).all(), "walls are too long to be things"
    assert ((cells == UNKNOWN) == (old == UNKNOWN)).all()
    assert any("3 objects moved" in w.problem for w in notes.warnings)
    empty_site, _, _ = disturbed(before, **{**ALONE, "missing": 1.0})
    assert (grid(empty_site).cells == OCCUPIED).sum() == (old == OCCUPIED).sum() - 3 * 160
    more, _, _ = disturbed(before, **{**ALONE, "obstacles": 5})
    assert (grid(more).cells == OCCUPIED).sum() > (old == OCCUPIED).sum() + 5 * 20


@pytest.mark.parametrize("edges", ["remove", "block"])
def test_edges_crossed_by_obstacle_are_removed_or_blocked(edges: str) -> None:
    lanes = lane(*(0.5 + 0.5 * k for k in range(1, 14)))
    before = Layers({PartKey("occupancy"): room(), PartKey("topology", "ground", "network"): lanes})
    after, _, notes = disturbed(before, **{**ALONE, "obstacles": 4}, edges=edges)
    part = network(after)
    lost = {i for i in lanes.ids if i.startswith("e")} - {
        i for i, p in zip(part.ids, part.properties, strict=True) if p["kind"] == "edge" and not p.get("blocked")
    }
    assert 0 < len(lost) < 13
    new = (grid(after).cells == OCCUPIED) & (grid(before).cells != OCCUPIED)
    at = shapely.points((np.argwhere(new)[:, ::-1] + 0.5) * 0.05)
    old = shapely.points((np.argwhere(grid(before).cells == OCCUPIED)[:, ::-1] + 0.5) * 0.05)
    for i, g, p in zip(lanes.ids, lanes.geometry, lanes.properties, strict=True):
        if p["kind"] == "edge" and shapely.distance(g, old).min() > 0.35:
            away = float(shapely.distance(g, at).min())  # to the middles of its cells
            assert (away < 0.27) <= (i in lost) <= (away < 0.34), i
    node_ids = [i for i, p in zip(part.ids, part.properties, strict=True) if p["kind"] == "node"]
    if edges == "block":
        assert part.ids == lanes.ids
    else:
        assert all(p["source"] in node_ids and p["target"] in node_ids for p in part.properties if p["kind"] == "edge")
    warnings = [w for w in notes.warnings if "because of new obstacles" in w.problem]
    assert warnings
    assert warnings[0].where == "ground/network"


def test_noise_grows_with_distance_and_spares_paths() -> None:
    cells = np.zeros((400, 400), np.uint8)
    cells[[0, 1, -2, -1]] = cells[:, [0, 1, -2, -1]] = OCCUPIED
    line = shapely.LineString([(1, 10), (19, 10)])
    ends = [(n, shapely.Point(x, 10), {"kind": "node"}) for n, x in (("a", 1), ("b", 19))]
    network = features([*ends, ("e", line, {"kind": "edge", "source": "a", "target": "b"})], "local")
    before = Layers({PartKey("occupancy"): room(cells), PartKey("topology", "ground", "network"): network})
    after, _, _ = disturbed(before, **{**ALONE, "speckle": 0.2})
    wrong = (grid(after).cells == OCCUPIED) & (cells != OCCUPIED)
    away = np.abs((np.arange(400) + 0.5) * 0.05 - 10)
    share = wrong[:, 20:-20].mean(axis=1)
    assert share[away < 0.38].sum() == 0
    assert share[(away > 1) & (away < 3)].mean() == pytest.approx(0.2 * 2 / 10, rel=0.2)
    assert share[(away > 7) & (away < 9.5)].mean() == pytest.approx(0.2 * 8.25 / 10, rel=0.1)
    worn, _, _ = disturbed(before, **{**ALONE, "erode": 1.0})
    lost = (grid(worn).cells == FREE) & (cells == OCCUPIED)
    assert 0.7 < lost.sum() / (4 * 396) < 1.0
    assert not lost[0].any(), "only edges are worn"
    grown, _, _ = disturbed(before, **{**ALONE, "dilate": 0.5})
    added = (grid(grown).cells == OCCUPIED) & (cells != OCCUPIED)
    assert added[2].any()
    assert not added[4:-4, 4:-4].any()
    patchy, _, _ = disturbed(before, **{**ALONE, "dropped": 5, "patch": 2.0})
    hidden = grid(patchy).cells == UNKNOWN
    assert 5 * math.pi * 0.3**2 / 4 < hidden.sum() * 0.05**2 <= 5 * math.pi
    assert not hidden[away < 0.38, 20:-20].any()
    strong, _, _ = disturbed(before, **{**ALONE, "speckle": 0.02}, severity=5.0)
    assert ((grid(strong).cells == OCCUPIED) & (cells != OCCUPIED)).sum() == pytest.approx(wrong.sum() / 2, rel=0.1)


def test_rotated_grid_follows_objects() -> None:
    """Turned by 30 degrees and coarser: the cells of the objects' places change, no others."""
    post = {"type": "cylinder", "radius": 0.4, "length": 1.0, "pose": [0, 0, 0.5, 0, 0, 0]}
    properties = {"kind": "post", "pose": [5.0, 3.0, 0.0, 0, 0, 0], "shapes": [post]}
    circle = shapely.Point(5, 3).buffer(0.4)
    yaw = math.pi / 6
    y, x = np.mgrid[:100, :120]
    u, v = (x + 0.5) * 0.08, (y + 0.5) * 0.08
    east, north = 1 + math.cos(yaw) * u - math.sin(yaw) * v, -2 + math.sin(yaw) * u + math.cos(yaw) * v
    cells = np.where(np.hypot(east - 5, north - 3) <= 0.4, OCCUPIED, FREE).astype(np.uint8)
    tilted_grid = OccupancyGrid(cells, 0.08, (1.0, -2.0, yaw))
    before = Layers(
        {
            PartKey("occupancy"): tilted_grid,
            PartKey("objects", "ground", "gazebo"): features([("p", circle, properties)], "local"),
        }
    )
    after, _, _ = disturbed(before, **{**ALONE, "shift": 4.0})
    at = places(objects(after, "gazebo"))["p"]
    assert np.hypot(*(at[:2] - [5, 3])) > 1
    occupied = grid(after).cells == OCCUPIED
    middle = east[occupied].mean(), north[occupied].mean()
    assert np.hypot(middle[0] - at[0], middle[1] - at[1]) < 0.1
    assert occupied.sum() == pytest.approx((cells == OCCUPIED).sum(), rel=0.4)


def test_invalid_perturbations_raise(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(MissingLayer, match="objects or occupancy or topology"):
        disturbed(Layers())
    before = Layers({PartKey("occupancy"): room()})
    with pytest.raises(CannotGenerate, match="available: ground"):
        disturbed(before, level="attic")
    with pytest.raises(CannotGenerate, match="available: map"):
        disturbed(before, grid="attic")
    with pytest.raises(CannotGenerate, match="ground: it has neither obstacles nor a grid"):
        disturbed(Layers({PartKey("topology", "ground", "network"): lane(1.0)}))
    with pytest.raises(CannotGenerate, match="severity"):
        disturbed(before, severity=0.0)
    with pytest.raises(CannotGenerate, match="these parameters disturb nothing"):
        disturbed(before, **ALONE)
    with pytest.raises(Invalid, match="the smaller value must come first"):
        disturbed(before, obstacle_size=(2.0, 1.0))
    for wrong in ({"missing": 2.0}, {"shift": -1.0}, {"obstacles": 10**9}, {"edges": "bend"}, {"largest": "nan"}):
        with pytest.raises(Invalid):
            disturbed(before, **wrong)
    full = Layers({PartKey("occupancy"): room(np.full((9, 9), OCCUPIED, np.uint8))})
    with pytest.raises(CannotGenerate, match="these parameters disturb nothing"):
        disturbed(full, **{**ALONE, "obstacles": 3})
    monkeypatch.setattr("app.generate.perturbation.MAX_CELLS", 1000)
    with pytest.raises(CannotGenerate, match="the limits are 1000"):
        disturbed(before)


@pytest.mark.parametrize("shape", [(1, 1), (1, 50), (50, 1), (7, 3)])
@pytest.mark.parametrize("value", [FREE, OCCUPIED, UNKNOWN])
def test_small_and_empty_grids_are_accepted(shape: tuple[int, int], value: int) -> None:
    before = Layers({PartKey("occupancy"): room(np.full(shape, value, np.uint8))})
    try:
        after, _, _ = disturbed(before, severity=10.0)
    except CannotGenerate as error:
        assert "these parameters disturb nothing" in error.detail
    else:
        assert grid(after).cells.shape == shape


def test_masks_are_unchanged_unless_named() -> None:
    mask = OccupancyGrid(room().cells.copy(), 0.05)
    before = Layers({PartKey("occupancy"): room(), PartKey("occupancy", "ground", "keepout"): mask})
    _, new_layers, _ = disturbed(before)
    assert [k.name for k in new_layers.parts] == ["map"]
    _, new_layers, _ = disturbed(before, grid="keepout")
    assert [k.name for k in new_layers.parts] == ["keepout"]


def test_grey_205_cells_are_unchanged() -> None:
    """No new obstacle is on unseen ground, and no noise frees its edge."""
    cells = room().cells.copy()
    grey = np.zeros(cells.shape, bool)
    grey[:, 121:] = cells[:, 121:] == FREE
    properties = {UNKNOWN_GREY: pack_cells(grey)}
    before = Layers({PartKey("occupancy"): OccupancyGrid(cells, 0.05, free_thresh=0.25, properties=properties)})
    after, _, _ = disturbed(before, obstacles=40, speckle=0.2, erode=0.9, severity=1.0)
    assert (grid(after).cells != cells)[:, :100].any()
    assert (grid(after).cells[grey] == FREE).all()
    left = unknown_grey(grid(after))
    assert left is not None
    assert (left == grey).all()
    assert (grid(after).cells[[0, -1], 130:-2] == OCCUPIED).all()


def test_repeated_perturbation_stays_consistent() -> None:
    """A second perturbation works on the result of the first, and keeps its obstacles."""
    one, _, _ = disturbed(orchard(), **STILL)
    two, _, _ = disturbed(one, 8, **STILL, missing=0.0)
    assert set(objects(one, "perturbation").ids) < set(objects(two, "perturbation").ids)
    assert len(objects(two, "perturbation")) == 6
    world(two, 0.2)


# --- real maps, over HTTP ---------------------------------------------------------------------------------------------
STRAWBERRY = "environment_template/riseholme_park_farm_strawberry_polytunnels/config"


def counts(api: Api, env: str, version: int | str) -> dict[str, int]:
    """The cells of the stored map."""
    address = f"environments/{env}/versions/{version}/layers/occupancy?name=map"
    cell_counts: dict[str, int] = api.get(address, headers={"Accept": "application/json"}).json()["counts"]
    return cell_counts


def test_strawberry_farm_is_perturbed(api: Api, fresh: Callable[[], str], shared: Path) -> None:
    root = shared / "data" / STRAWBERRY
    env = fresh()
    api.post("environments", {"name": env})
    chosen = [
        f
        for part in ("metric/map", "topological", "world")
        for f in sorted((root / part).rglob("*"))
        if f.is_file() and f.stat().st_size < 2e7
    ]
    api.upload(env, {f"config/{f.relative_to(root).as_posix()}": f.read_bytes() for f in chosen})
    then = counts(api, env, 1)
    request = {"generator": "perturbation", "seed": 3, "parameters": {"obstacles": 5}}
    version = api.post(f"environments/{env}/generations", request).json()
    assert version["information"]["occupancy"] == "generated"
    assert any("5 new obstacles" in w["problem"] for w in version["warnings"])
    now = counts(api, env, "latest")
    assert sum(now.values()) == sum(then.values()) == 4000 * 4000
    assert 0.9 < now["occupied"] / then["occupied"] < 1.2, "mild"
    assert 0 < now["unknown"] - then["unknown"] < 3 * math.pi * (0.75 / 0.05 + 1) ** 2, "two patches"
    texts = [api.get(f"environments/{env}/versions/{v}/maps/tmap2").content for v in (1, "latest")]
    nodes = [yaml.load(text, yaml.CSafeLoader)["nodes"] for text in texts]
    edges = [sum(len(n["node"]["edges"]) for n in network_nodes) for network_nodes in nodes]
    assert 0.7 * edges[0] < edges[1] <= edges[0]
    ids = {n["node"]["name"] for n in nodes[1]}
    assert all(e["node"] in ids for n in nodes[1] for e in n["node"]["edges"])
    report = api.get(f"environments/{env}/versions/latest/reports/occupancy_grid").json()
    (step,) = (line for line in report["layers"] if line["name"] == "map")
    assert step["information"] == "generated"
    assert step["steps"][-1]["parameters"]["obstacles"] == 5


def test_building_is_perturbed(api: Api, fresh: Callable[[], str], shared: Path) -> None:
    """It has no grid: the derived one shows the new obstacles, and no lane leads through them."""
    env = fresh()
    api.post("environments", {"name": env})
    file = shared / "data/openrmf_building/office/office.building.yaml"
    api.upload(env, {file.name: file.read_bytes()})
    request = {"generator": "perturbation", "seed": 7, "parameters": {"obstacles": 8}}
    body = api.post(f"environments/{env}/generations", request).json()
    assert any("8 new obstacles" in w["problem"] for w in body["warnings"])
    grids = []
    for version in (1, body["version"]):
        answer = api.get(f"environments/{env}/versions/{version}/maps/occupancy_grid?resolution=0.1")
        with zipfile.ZipFile(io.BytesIO(answer.content)) as z:
            content = yaml.safe_load(z.read("map.yaml"))
            grids.append((np.asarray(Image.open(io.BytesIO(z.read(content["image"]))))[::-1], content))
    (then, content), (now, also) = grids
    assert content["origin"] == also["origin"]
    new = (now == 0) & (then != 0)
    assert 8 * 0.07 <= new.sum() * 0.01 <= 8 * 2.0
    topology = api.get(f"environments/{env}/versions/latest/layers/topology?crs=local").json()["features"]
    at = shapely.points(np.argwhere(new)[:, ::-1] * 0.1 + 0.05 + np.array(also["origin"][:2]))
    tree = shapely.STRtree(at)
    content = [f.get("place") or f["geometry"] for f in topology if f["properties"]["kind"] == "edge"]
    lanes = [shapely.geometry.shape(one) for one in content]
    assert 40 < len(lanes) < 58
    assert not len(tree.query(np.array(lanes, object), predicate="dwithin", distance=0.15)[0])
    assert b"new/" in api.get(f"environments/{env}/versions/latest/maps/gazebo/world.sdf").content
    assert api.get(f"environments/{env}/versions/latest/maps/openrmf").status_code == 200
    api.post(f"environments/{env}/versions", {"revert_to": 1, "message": "as it was"})
    again = api.post(f"environments/{env}/generations", request).json()
    assert again["root"] == body["root"], "the same seed, the same environment"

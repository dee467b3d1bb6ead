"""Fields and the warehouse: rows within any fence, and everything that a site must hold to."""

from __future__ import annotations

import itertools
import math
import os
import random
import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from app import generate
from app.errors import CannotGenerate, Invalid
from app.generate import _trees
from app.model.features import Features, features
from app.model.frame import GROUND, Datum
from app.model.geodesy import local_frame
from app.model.grid import FREE, OCCUPIED
from app.model.layers import Layers, PartKey
from app.model.meshes import read_mesh
from tests.api.conftest import Api
from tests.generate import site_checks

NETWORK = PartKey("topology", GROUND, "network")
OBJECTS = PartKey("objects", GROUND, "generated")
SMALL: dict[str, dict[str, Any]] = {
    "orchard": {"rows": 3, "row_length": 20, "shed": 4, "docks": 1},
    "crop_rows": {"beds": 3, "row_length": 20},
    "polytunnels": {"tunnels": 1, "rows_per_tunnel": 3, "row_length": 20},
    "vineyard": {"rows": 3, "row_length": 20, "shed": 4, "docks": 1},
    "warehouse": {"racks": 2, "row_length": 22, "docks": 2, "parking": 1},
}
PLAIN = {"angle": 0, "skew": 0, "taper": 0, "curve": 0, "missing": 0, "cross_aisles": 0}
"""Parameters of a field with straight rows of equal length."""

DIGESTS = {
    "orchard": "c4406877942ac51d6bef01ba0576a44cd3b992eb3fc32b900c948bf92dd29623",
    "crop_rows": "304562043f852a428b9452e91484d4011da56802e0583cd996c4e27cc5f73929",
    "polytunnels": "6f72dae31d843aa8c702399fd7e70539b2c40bcf259c2eb281aa391313f4c67c",
    "vineyard": "ba3c58f7f83cdf184d667f49505579bd51eb87117ff4e859f9c045fb0bbbbc9c",
    "warehouse": "a355e178bd1a86eebc18a1f0654290ca0d35fa528abe8abd7ca87268d2b98870",
}
HERE = Datum(53.2686, -0.5245, heading=12.0)
FENCES = {
    "slanting": [(0, 0), (44, 14), (30, 52), (-12, 36)],
    "triangle": [(0, 0), (70, 10), (20, 55)],
    "L": [(0, 0), (50, 0), (50, 22), (26, 22), (26, 60), (0, 60)],
    "U": [(0, 0), (60, 0), (60, 50), (40, 50), (40, 26), (22, 26), (22, 50), (0, 50)],
}


FENCE_COUNT = int(os.environ.get("FLEETMAP_FENCES", "4"))
"""Random fences of each generator: every second one a union of boxes, the fourth one with a hole. make fuzz: 40."""


def fenced(name: str) -> Layers:
    """An environment with a datum and a fence of GNSS places."""
    ring = local_frame(HERE).geometries_to_wgs84(np.array([shapely.Polygon(FENCES[name])], object))
    return Layers({PartKey("location", GROUND, "site"): features([("f", ring[0], {"kind": "fence"})], "wgs84")}, HERE)


def network(layers: Layers) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """Places of the nodes, and the edges."""
    part = layers.parts[NETWORK]
    assert isinstance(part, Features)
    nodes = {f.id: f.geometry for f in part if f.properties["kind"] == "node"}
    return nodes, {f.id: dict(f.properties) for f in part if f.properties["kind"] == "edge"}


@pytest.mark.parametrize("name", sorted(SMALL))
def test_field_is_consistent_in_every_format(name: str, tmp_path: Path) -> None:
    layers, notes = site_checks.make(name, **SMALL[name])
    assert not notes.dropped
    assert [t.subject for t in notes.template] == ["parameters", "datum"]
    site_checks.agrees_with_itself(layers, 0.3)
    site_checks.sound_sdf(layers, tmp_path)
    site_checks.serves(layers)
    assert site_checks.digest(layers) == DIGESTS[name]
    other, _ = site_checks.make(name, 8, **SMALL[name])
    assert site_checks.digest(other) != DIGESTS[name]
    fixed, _ = site_checks.make(name, **{**SMALL[name], **notes.template[0].value})
    assert site_checks.digest(fixed) == DIGESTS[name], "the reported values, set, give the same site"


@pytest.mark.parametrize(("name", "fence"), list(zip(sorted(SMALL), itertools.cycle(FENCES), strict=False)))
def test_rows_keep_within_any_fence_along_its_longest_side(name: str, fence: str) -> None:
    given = fenced(fence)
    layers, _ = site_checks.make(name, given=given)
    assert layers.datum == HERE
    site_checks.agrees_with_itself(Layers({**given.parts, **layers.parts}, layers.datum, layers.levels), 0.3)
    polygon = shapely.Polygon(FENCES[fence]).buffer(0.002)
    for part in (
        *layers.vector("objects").values(),
        *layers.vector("topology").values(),
        *layers.vector("zones").values(),
    ):
        assert shapely.contains(polygon, part.geometry).all()
    nodes, edges = network(layers)
    sides = [(math.dist(a, b), a, b) for a, b in itertools.pairwise([*FENCES[fence], FENCES[fence][0]])]
    _, a, b = max(sides)
    along = math.atan2(b[1] - a[1], b[0] - a[0])
    rows = [e for e in edges.values() if e["action"] == "row_traversal" or e["source"].startswith("A1-")]
    assert len(rows) > 10
    for edge in rows[:20]:
        if edge["source"][:3] == edge["target"][:3]:
            p, q = nodes[edge["source"]], nodes[edge["target"]]
            assert math.sin(math.atan2(q.y - p.y, q.x - p.x) - along) == pytest.approx(0, abs=0.01)


def test_network_names_match_real_polytunnels() -> None:
    layers, _ = site_checks.make(
        "polytunnels", tunnels=2, rows_per_tunnel=5, row_length=16, row_spacing=1.35, angle=0, skew=0, taper=0
    )
    nodes, edges = network(layers)
    aisles = {n.rpartition("-")[0] for n in nodes if n.startswith("r")}
    between = ["r0.7", "r1.5", "r2.5", "r3.5", "r4.5", "r5.3", "r5.7", "r6.5", "r7.5", "r8.5", "r9.5", "r10.3"]
    assert aisles == set(between), "as in Riseholme's two tunnels"
    assert {n.partition("-")[2] for n in nodes if n.startswith("r")} == {
        "ca",
        "cb",
        *(f"c{k}" for k in range(4)),
        "cy",
        "cz",
    }
    assert nodes["r1.5-ca"].distance(nodes["r2.5-ca"]) == pytest.approx(1.35)
    count = Counter(e["action"] for e in edges.values())
    assert count["row_traversal"] == 12 * 7 * 2
    assert count["row_change"] == 11 * 2 * 2
    assert edges["r5.3-ca_r5.7-ca"]["action"] == "row_change"
    assert edges["LaneWest_r0.7-ca"]["action"] == "move_base"
    objects = layers.parts[OBJECTS]
    assert isinstance(objects, Features)
    kinds = Counter(p["kind"] for p in objects.properties)
    assert (kinds["table"], kinds["tunnel"], kinds["post"]) == (10, 2, 3), "two tunnels share the legs between them"
    (grid,) = layers.grids().values()
    table = objects.geometry[objects.index()["table1"]]
    x, y = shapely.centroid(table).x + 1.2, shapely.centroid(table).y
    assert grid.cells[int((y - grid.origin[1]) / 0.05), int((x - grid.origin[0]) / 0.05)] == FREE, "between its legs"
    (zones,) = layers.vector("zones").values()
    assert {i for i in zones.ids if i.startswith("row")} == {f"row{k}" for k in range(1, 11)}


def test_orchard_trees_follow_parameters() -> None:
    parameters = {"rows": 3, "row_length": 18, "row_spacing": 5.0, "tree_spacing": 3.0, "jitter": 0.2, **PLAIN}
    layers, _ = site_checks.make("orchard", **parameters)
    part = layers.parts[OBJECTS]
    assert isinstance(part, Features)
    trees = [f for f in part if f.properties["kind"] == "tree"]
    trunk, crown = trees[0].properties["shapes"]
    assert trunk["colour"] == [0.541, 0.408, 0.259], "138, 104, 66"
    assert crown["colour"][1] > crown["colour"][0], "green"
    assert len(trees) == 3 * 7
    lines = {f.properties["name"]: f.geometry for f in part if f.properties["kind"] == "tree_row"}
    assert lines["Row 1"].distance(lines["Row 2"]) == pytest.approx(5.0)
    off = [lines[f"Row {f.id[4]}"].distance(f.geometry) for f in trees]
    assert 0.05 < max(off) <= 0.2
    (grid,) = layers.grids().values()
    for tree in trees:
        x, y = tree.properties["pose"][:2]
        assert grid.cells[int((y - grid.origin[1]) / 0.05), int((x - grid.origin[0]) / 0.05)] == OCCUPIED
    still, _ = site_checks.make("orchard", **{**parameters, "jitter": 0})
    rows = still.parts[OBJECTS]
    assert isinstance(rows, Features)
    x = [f.geometry.x for f in rows if f.id.startswith("tree1-")]
    assert np.diff(x) == pytest.approx(3.0)


def test_crown_mesh_is_closed_ball() -> None:
    mesh = read_mesh(_trees.crown_mesh(), "crown.stl")
    corners = mesh.vertices[mesh.faces]
    assert len(mesh.faces) == 80
    assert np.linalg.norm(mesh.vertices, axis=1) == pytest.approx(1.0, abs=1e-5)
    volume = np.einsum("ij,ij->i", np.cross(corners[:, 0], corners[:, 1]), corners[:, 2]).sum() / 6
    assert 3.6 < volume < 4 / 3 * math.pi, "its sides look outwards"


def test_one_way_aisles_alternate_directions() -> None:
    values = {**SMALL["warehouse"], "racks": 4}
    plain, _ = site_checks.make("warehouse", **values)
    layers, _ = site_checks.make("warehouse", one_way=True, **values)
    site_checks.agrees_with_itself(layers, 0.3)
    edges = network(layers)[1]
    assert {f"A{k}-ca_A{k}-cb" in edges for k in (1, 3)} == {True}
    assert "A1-cb_A1-ca" not in edges
    assert "A2-cb_A2-ca" in edges
    assert "A2-ca_A2-cb" not in edges
    aisles = [e for e in edges.values() if re.match(r"A\d-", e["source"]) and e["source"][:3] == e["target"][:3]]
    before = network(plain)[1]
    assert len(before) - len(edges) == len(aisles)
    nodes, _ = network(layers)
    assert {"Dock1", "Dock2", "Charger1", "Charger2", "Parking1"} <= set(nodes)
    part = layers.parts[NETWORK]
    assert isinstance(part, Features)
    charger = part.properties[part.index()["Charger1"]]
    assert charger["openrmf"]["parameters"]["is_charger"] == [4, True]


@pytest.mark.parametrize(
    ("name", "values", "why"),
    [
        ("orchard", {"rows": 0}, "at least 2"),
        ("orchard", {"rows": 10**9}, "at most 500"),
        ("orchard", {"row_spacing": "wide"}, "must be a number"),
        ("orchard", {"colour": "red"}, "unknown parameter of orchard"),
        (
            "orchard",
            {"robot_radius": 1.7, "row_spacing": 3.6},
            r"row_spacing: rows 3.60 m apart .* at least 3.9\d m are needed",
        ),
        (
            "orchard",
            {"headland": 1.5, "robot_radius": 0.8},
            "headland: must be at least .* for robots to turn, got 1.5",
        ),
        ("orchard", {"crown_diameter": 0.3, "trunk_diameter": 0.5}, "must be at least trunk_diameter"),
        (
            "orchard",
            {"rows": 500, "row_length": 1000, "tree_spacing": 0.5, "resolution": 1},
            "node_spacing: there would be",
        ),
        ("orchard", {"row_length": 500, "rows": 200, "resolution": 0.01}, "resolution: .* use a coarser"),
        ("orchard", {"docks": 20, "row_length": 10}, r"docks: the lane of \d+"),
        ("orchard", {"datum": "95,0"}, "datum latitude must be between"),
        ("crop_rows", {"aisle": 0.5, "rows_per_bed": 3, "row_spacing": 0.4}, "aisle: rows 1.30 m apart"),
        ("crop_rows", {"plant_spacing": 0.05, "row_length": 300, "beds": 20}, "plant_spacing: there would be"),
        ("polytunnels", {"tunnel_height": 2, "side_height": 3}, "must be above side_height"),
        (
            "polytunnels",
            {"tunnels": 40, "row_length": 800, "hoop_spacing": 0.5, "node_spacing": 90},
            "hoop_spacing: there",
        ),
        ("vineyard", {"canopy_base": 2, "canopy_top": 1}, "must be above canopy_base"),
        ("vineyard", {"rows": 100, "row_length": 700}, "node_spacing: there would be"),
        (
            "warehouse",
            {"docks": 30, "chargers": 2, "parking": 2},
            "docks: 34 docks, chargers and parking places need 105 m",
        ),
        ("warehouse", {"robot_radius": 1.5, "rack_depth": 1, "aisle": 2.8}, "aisle: rows 4.80 m apart"),
    ],
)
def test_invalid_field_parameters_raise_before_work(name: str, values: dict[str, Any], why: str) -> None:
    with pytest.raises((CannotGenerate, Invalid), match=why):
        site_checks.make(name, **values)


@pytest.mark.parametrize("name", sorted(SMALL))
def test_random_fences_give_site_or_error(name: str) -> None:
    chance = random.Random(f"fences for {name}")
    key = PartKey("location", GROUND, "site")
    site_count = 0
    for number in range(FENCE_COUNT):
        size = chance.uniform(35, 80)
        ring = [
            (math.cos(0.9 * k) * chance.uniform(0.4, 1), math.sin(0.9 * k) * chance.uniform(0.4, 1)) for k in range(7)
        ]
        fence = shapely.Polygon([(size * x / 1.4, size * y / 1.4) for x, y in ring])
        if number % 2:
            boxes = [(chance.uniform(0, size / 2), chance.uniform(0, size / 2)) for _ in range(3)]
            fence = shapely.union_all([shapely.box(x, y, x + size / 2, y + size / 3) for x, y in boxes])
        fence = max(shapely.get_parts(fence.buffer(0)), key=shapely.area)
        fence = shapely.difference(fence, shapely.point_on_surface(fence).buffer(1.0)) if number == 3 else fence
        part = features([("f", fence, {"kind": "fence"})], "local")
        values = {"robot_radius": chance.choice((0.2, 0.25)), "headland": chance.choice((3, 5))}
        try:
            layers, _ = site_checks.make(name, number, Layers({key: part}, HERE), resolution=0.1, **values)
        except CannotGenerate as error:
            assert error.problems[0].where in {"yard", "docks", "headland", "rows_per_tunnel"}, error.detail
            continue
        site_count += 1
        for layer_part in (*layers.vector("objects").values(), *layers.vector("topology").values()):
            assert shapely.contains(fence.buffer(0.05), layer_part.geometry).all()
    assert site_count >= FENCE_COUNT / 2


def test_too_small_fence_raises_cannot_generate() -> None:
    key = PartKey("location", GROUND, "site")
    for size, why in (
        ((9, 9), "yard: the fence has no room for a lane"),
        ((4, 60), "too small for a field|no room for a lane"),
    ):
        small = features([("f", shapely.box(0, 0, *size), {"kind": "fence"})], "local")
        for name in SMALL:
            with pytest.raises(CannotGenerate, match=f"{why}|the fence has no room for a row"):
                generate.run(name, 1, {}, Layers({key: small}, HERE), site_checks.DerivationNotes())


def test_large_fields_use_cells_that_show_the_paths() -> None:
    big = features([("f", shapely.box(0, 0, 120, 100), {"kind": "fence"})], "local")
    layers, notes = site_checks.make(
        "vineyard", given=Layers({PartKey("location", GROUND, "site"): big}, HERE), vine_spacing=6
    )
    (grid,) = layers.grids().values()
    assert grid.resolution == 0.1
    assert [t.subject for t in notes.template] == ["parameters", "resolution"]


def test_field_is_generated_over_http_and_edited(api: Api) -> None:
    format_names = ("gazebo", "occupancy_grid", "tmap2", "kml", "osm", "satellite", "openrmf")
    version = site_checks.over_http(api, "polytunnels", format_names, **SMALL["polytunnels"])
    assert set(version["information"].values()) >= {"generated"}
    env = "environments/made-polytunnels"
    before = api.get(f"{env}/versions/latest/layers/location").json()
    body = {"generator": "warehouse", "seed": 1, "parameters": SMALL["warehouse"]}
    api.post(f"{env}/generations", body)
    after = api.get(f"{env}/versions/latest/layers/location").json()
    assert after["features"], "the new site has its fence"
    assert after["features"] != before["features"], "the old site's fence does not bind the new one"
    world = api.get("/maps/made-polytunnels/gazebo").content
    assert b"walls_map" not in world, "the grid is a slice of the objects"
    ring = [[5, 5], [6, 5], [6, 6], [5, 6], [5, 5]]
    change = {"op": "cells", "grid": "map", "polygon": {"type": "Polygon", "coordinates": [ring]}, "crs": "local"}
    api.post(f"{env}/edits", {"changes": [{**change, "value": 100}]})
    world = api.get("/maps/made-polytunnels/gazebo").content
    assert b"walls_map" in world, "people have drawn in it"
    problem = api.problem("POST", f"{env}/generations", 422, json={**body, "parameters": {"racks": 1}})
    assert "racks" in problem["detail"]

"""Warnings about edges that cross obstacles, and closures of edges that get nodes at bends."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import shapely
import yaml

from app import formats
from app.convert import worker
from app.convert.files import offline
from app.model.closures import Closure, Closures
from app.model.features import features
from app.model.frame import GROUND, Datum
from app.model.grid import FREE, OCCUPIED, UNKNOWN, UNKNOWN_GREY, OccupancyGrid, pack_cells
from app.model.layers import MAP, NETWORK, Layers, Part, PartKey
from tests.api.conftest import Api

TOPOLOGY = PartKey("topology", GROUND, NETWORK)
AROUND = [(0.5, 2.5), (0.5, 8.5), (9.5, 8.5), (9.5, 2.5)]
"""Path from a to b around a wall on x = 5 that leaves y > 7 free."""


def site(bend: bool, yaw: float = 0.0, **parts: Part) -> Layers:
    """Build two nodes on both sides of a wall, joined in both directions, and one edge along the wall."""
    turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
    at = [tuple(row) for row in (np.array(AROUND) @ turn).tolist()]
    line = at if bend else [at[0], at[-1]]
    up = [at[0], at[1]]
    rows: list[tuple[str, Any, dict[str, Any]]] = [
        ("a", shapely.Point(at[0]), {"kind": "node"}),
        ("b", shapely.Point(at[-1]), {"kind": "node"}),
        ("c", shapely.Point(at[1]), {"kind": "node"}),
        ("a_b", shapely.LineString(line), {"kind": "edge", "source": "a", "target": "b"}),
        ("b_a", shapely.LineString(line[::-1]), {"kind": "edge", "source": "b", "target": "a"}),
        ("a_c", shapely.LineString(up), {"kind": "edge", "source": "a", "target": "c"}),
    ]
    network: dict[PartKey, Part] = {TOPOLOGY: features(rows, "local")}
    return Layers({**network, **{PartKey(k, GROUND, MAP): p for k, p in parts.items()}})  # type: ignore[arg-type]


def hall(yaw: float = 0.0) -> OccupancyGrid:
    cells = np.full((20, 20), FREE, np.uint8)
    cells[:14, 10] = OCCUPIED
    return OccupancyGrid(cells, 0.5, (0.0, 0.0, yaw))


def crossing(report: Mapping[str, Any]) -> list[str]:
    return [w["problem"] for w in report["warnings"] if "cross" in w["problem"]]


@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_straight_edges_through_a_wall_are_reported_and_bent_ones_go_around(yaw: float) -> None:
    for name in ("tmap2", "geojson"):
        fmt = formats.get_format(name)
        through = worker.from_layers(fmt, site(False, yaw, occupancy=hall(yaw)), {}, derived=False)
        assert crossing(through.report.as_dict()) == [
            "2 edges cross occupied cells of the occupancy grid 'map': a_b, b_a; a robot that follows the network "
            "meets an obstacle there"
        ]
        assert (
            crossing(worker.from_layers(fmt, site(True, yaw, occupancy=hall(yaw)), {}, derived=False).report.as_dict())
            == []
        )


def test_buildings_are_obstacles_without_a_grid() -> None:
    rows: list[tuple[str, Any, dict[str, Any]]] = [
        ("house", shapely.box(4, 0, 6, 7), {"kind": "building"}),
        ("roof", shapely.box(0, 4, 4, 6), {"kind": "building", "base": 3.0}),
        ("home", shapely.box(0, 2, 1, 5), {"kind": "building"}),
        ("park", shapely.box(0, 0, 9, 9), {"kind": "region"}),
    ]
    objects = features(rows, "local")
    fmt = formats.get_format("tmap2")
    (warning,) = crossing(worker.from_layers(fmt, site(False, objects=objects), {}, derived=False).report.as_dict())
    assert warning.startswith("2 edges cross buildings or walls: a_b, b_a;") or warning.startswith("2 edges cross")
    assert crossing(worker.from_layers(fmt, site(True, objects=objects), {}, derived=False).report.as_dict()) == []


def test_nav2_drives_straight_along_its_own_bent_edges() -> None:
    layers = site(True, occupancy=hall())
    part = layers.vector("topology")[TOPOLOGY]
    owned = tuple({**p, "nav2_route": {"id": k}} for k, p in enumerate(part.properties))
    nav2_layers = Layers(
        {**layers.parts, TOPOLOGY: features(zip(part.ids, part.geometry, owned, strict=True), "local")}
    )
    fmt = formats.get_format("nav2_route")
    (warning,) = crossing(worker.from_layers(fmt, nav2_layers, {}, derived=False).report.as_dict())
    assert warning.startswith("2 edges cross occupied cells")
    assert crossing(worker.from_layers(fmt, layers, {}, derived=False).report.as_dict()) == []


def test_closures_by_id_and_area_close_all_pieces_of_a_bent_edge() -> None:
    fmt = formats.get_format("tmap2")
    until = "2030-01-01T00:00:00Z"
    area = {"type": "Polygon", "coordinates": [[[4, 8], [6, 8], [6, 9], [4, 9], [4, 8]]]}
    by_id = Closures((Closure("c", "blocked", GROUND, until, edge="a_b"),))
    by_area = Closures((Closure("c", "blocked", GROUND, until, polygon=area, crs="local"),))
    for closures, closed_ids in ((by_id, {"a_b"}), (by_area, {"a_b", "b_a"})):
        written_map = worker.from_layers(fmt, site(True), {}, derived=False, closures=closures)
        nodes = yaml.safe_load(written_map.files["network.tmap2.yaml"])["nodes"]
        left = {e["edge_id"].partition("~")[0] for n in nodes for e in n["node"]["edges"]}
        assert left == {"a_b", "b_a", "a_c"} - closed_ids
        (line,) = written_map.report.as_dict()["closures"]
        assert set(line["edges"]) == closed_ids, "the report names the edges of the version"


def test_reports_of_stored_maps_name_edges_through_obstacles(api: Api, fresh: Any) -> None:
    env = fresh()
    api.post("environments", {"name": env})
    layers = site(False, occupancy=hall())
    for name in ("tmap2", "occupancy_grid"):
        api.upload(env, worker.from_layers(formats.get_format(name), layers, {}, derived=False).files)
    report = api.get(f"environments/{env}/versions/latest/reports/tmap2").json()
    assert len(crossing(report)) == 1
    assert "a_b, b_a" in crossing(report)[0]
    assert crossing(api.get(f"environments/{env}/versions/1/reports/tmap2").json()) == []


HOUSE = ("house", shapely.box(4, -2, 6, 4), {"kind": "building"})


def detour(*between: tuple[float, float], inside: bool = False, **parts: Part) -> Layers:
    """Build one edge from (0, 0) via these points to (10, 0), or to a node inside ``HOUSE``."""
    end = (5.0, 0.0) if inside else (10.0, 0.0)
    rows: list[tuple[str, Any, dict[str, Any]]] = [
        ("a", shapely.Point(0, 0), {"kind": "node"}),
        ("b", shapely.Point(end), {"kind": "node"}),
        ("e", shapely.LineString([(0, 0), *between, end]), {"kind": "edge", "source": "a", "target": "b"}),
    ]
    network: dict[PartKey, Part] = {TOPOLOGY: features(rows, "local")}
    objects = {PartKey("objects", GROUND, MAP): features([HOUSE], "local")}
    grids = {PartKey(k, GROUND, MAP): p for k, p in parts.items()}  # type: ignore[arg-type]
    return Layers({**network, **objects, **grids}, Datum(48.0, 9.0))


@pytest.mark.parametrize("name", ["tmap2", "geojson", "nav2_route"])
def test_bends_inside_a_building_do_not_hide_that_an_edge_leads_through_it(name: str) -> None:
    fmt = formats.get_format(name)
    crossed = {
        "straight": detour(),
        "bend inside": detour((5, 1)),
        "in, out and in": detour((5, 1), (5, 6), (4.5, 6), (4.5, 2), (2, 2), inside=True),
    }
    for called, layers in crossed.items():
        (warning,) = crossing(worker.from_layers(fmt, layers, {}, derived=False).report.as_dict())
        assert warning.startswith("1 edge crosses buildings or walls: e;"), called
    clear = [detour(inside=True), detour((4.5, 1), inside=True), detour((3, 6), (8, 6))]
    assert all(crossing(worker.from_layers(fmt, layers, {}, derived=False).report.as_dict()) == [] for layers in clear)


def test_buildings_are_obstacles_in_unknown_cells() -> None:
    fmt = formats.get_format("tmap2")
    free = OccupancyGrid(np.full((20, 40), FREE, np.uint8), 0.5, (-5.0, -5.0, 0.0))
    unknown = OccupancyGrid(np.full((20, 40), UNKNOWN, np.uint8), 0.5, (-5.0, -5.0, 0.0))
    beyond = OccupancyGrid(np.full((20, 20), FREE, np.uint8), 0.5, (-5.0, -5.0, 0.0))
    grey = replace(free, free_thresh=0.25, properties={UNKNOWN_GREY: pack_cells(np.ones((20, 40), bool))})
    for grid, count in ((free, 0), (unknown, 1), (beyond, 1), (grey, 1)):
        warnings = crossing(worker.from_layers(fmt, detour((5, 1), occupancy=grid), {}, derived=False).report.as_dict())
        assert len(warnings) == count


def test_environment_package_warns_of_edges_through_obstacles() -> None:
    fmt = formats.get_format("environment")
    warnings = crossing(worker.from_layers(fmt, detour((5, 1)), {}, derived=False).report.as_dict())
    assert len(warnings) == 1
    assert "1 edge crosses buildings or walls: e;" in warnings[0]


@pytest.mark.parametrize("name", ["nav2_route", "navgraph"])
def test_files_of_a_network_and_a_grid_are_checked_without_a_server(name: str) -> None:
    layers = site(False, occupancy=hall())
    files: dict[str, bytes] = {}
    for source in ("nav2_route", "occupancy_grid"):
        files |= worker.from_layers(formats.get_format(source), layers, {}, derived=False).files
    warnings = crossing(offline(files, name, datum=Datum(48.0, 9.0)).report.as_dict())
    assert len(warnings) == 1
    assert "occupied cells of the occupancy grid" in warnings[0]

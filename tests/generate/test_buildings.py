"""Offices and wards: walls, doors, lifts and levels that are equal in all formats, and impossible sizes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import shapely
import yaml

from app.convert.files import write_layers
from app.errors import CannotGenerate, Invalid
from app.formats import FileGroup, ReadContext, get_format, read
from app.model.features import features
from app.model.frame import GROUND, Datum, Level
from app.model.layers import Layers, PartKey
from tests.api.conftest import Api
from tests.generate import site_checks

DIGESTS = {
    "office": "bce4bce179379260d5ef5b840b58c3b3e423a7f5ed4e35cfe44a8f2ca432e381",
    "hospital": "16d2cd2a54651aac9895089e099f1ef2b637e479592120c6c5e67cf3d33aacd4",
}


@pytest.fixture(scope="module")
def office() -> Layers:
    return site_checks.make("office", length=14)[0]


def test_office_is_consistent_in_every_format(office: Layers, tmp_path: Path) -> None:
    assert office.levels == (Level(), Level("L2", 3.4))
    site_checks.agrees_with_itself(office, 0.3)
    site_checks.sound_sdf(office, tmp_path)
    site_checks.serves(office)
    assert site_checks.digest(office) == DIGESTS["office"]


def test_ward_is_consistent() -> None:
    layers, _ = site_checks.make("hospital", length=16)
    site_checks.agrees_with_itself(layers, 0.3)
    assert site_checks.digest(layers) == DIGESTS["hospital"]
    kinds = {p["kind"] for part in layers.vector("objects").values() for p in part.properties}
    assert {"wall", "door", "floor", "bed", "counter", "region", "charger"} <= kinds
    assert "lift" not in kinds
    nodes = {i for part in layers.vector("topology").values() for i in part.ids}
    assert {"nurse_station_104", "dock_1", "entrance"} <= nodes


@pytest.mark.parametrize("seed", range(2))
def test_stacked_wards_are_consistent(seed: int) -> None:
    layers, _ = site_checks.make("hospital", seed, levels=2, length=24, robot_radius=0.45)
    site_checks.agrees_with_itself(layers, 0.45)


def test_open_rmf_reads_walls_doors_and_the_lift(office: Layers) -> None:
    files = write_layers(office, "openrmf", {}, site_checks.CAME).files
    building = yaml.safe_load(files["building.yaml"])
    assert list(building["levels"]) == ["ground", "L2"]
    assert building["levels"]["L2"]["elevation"] == 3.4
    lift = building["lifts"]["lift_1"]
    assert lift["level_doors"] == {"ground": ["lift_1_door"], "L2": ["lift_1_door"]}
    assert (lift["lowest_floor"], lift["highest_floor"], lift["reference_floor_name"]) == ("ground", "L2", "ground")
    assert lift["doors"]["lift_1_door"]["y"] == -0.95
    doors = [row[2] for row in building["levels"]["ground"]["doors"]]
    rooms = [p["name"] for p in office.vector("objects", GROUND)[PartKey("objects", GROUND, "generated")].properties
             if p["kind"] == "region"]  # fmt: skip
    assert {d["name"][1] for d in doors} == {"entrance_door", *(f"{name}_door" for name in rooms)}
    chargers = [row for row in building["levels"]["ground"]["vertices"] if len(row) > 4 and "is_charger" in row[4]]
    assert [row[3] for row in chargers] == ["dock_1", "dock_2"]
    back = read(FileGroup(get_format("openrmf"), "building.yaml", files), ReadContext())
    for level in ("ground", "L2"):
        walls = office.vector("objects", level)[PartKey("objects", level, "openrmf")].select_kinds(
            "wall", "door", "floor"
        )
        again = back.vector("objects", level)[PartKey("objects", level, "openrmf")].select_kinds(
            "wall", "door", "floor"
        )
        assert len(walls) == len(again)
        assert shapely.hausdorff_distance(*(shapely.union_all(f.geometry) for f in (walls, again))) < 1e-6


def test_open_rmf_lanes_name_doors_and_lift(office: Layers) -> None:
    graph = yaml.safe_load(write_layers(office, "rmf_nav_graph", {}, site_checks.CAME).files["0.yaml"])
    assert set(graph["levels"]) == {"ground", "L2"}
    for name, level in graph["levels"].items():
        inside = {row[2]["name"] for row in level["vertices"] if row[2].get("lift") == "lift_1"}
        assert inside == {f"lift_1_{name}"}
        through = {row[2]["door_name"] for row in level["lanes"] if "door_name" in row[2]}
        assert through == {door for door, entry in graph["doors"].items() if entry["map"] == name}
    assert set(graph["lifts"]) == {"lift_1"}


def test_building_stays_inside_fence() -> None:
    ring = shapely.Polygon([(100, 50), (140, 90), (115, 115), (75, 75)])
    fence = features([("f", ring, {"kind": "fence"})], "local")
    given = Layers({PartKey("location", GROUND, "site"): fence}, Datum(53.0, -0.5))
    layers, _ = site_checks.make("office", given=given, length=20, levels=2)
    site_checks.agrees_with_itself(layers, 0.3)
    for part in (*layers.vector("objects").values(), *layers.vector("topology").values()):
        assert shapely.contains(ring, part.geometry).all()
    with pytest.raises(CannotGenerate, match=r"the fence has no room for the site, which needs 111\.4 × 17\.4 m"):
        site_checks.make("office", given=given, length=100)


@pytest.mark.parametrize(
    ("values", "why"),
    [
        ({"levels": 0}, "at least 1"),
        ({"levels": 10**9}, "at most 20"),
        ({"length": 0}, "at least 4"),
        ({"length": 1e9}, "at most 500"),
        ({"length": 500, "levels": 20, "room_width": (2.5, 3)}, "more than 5000 rooms"),
        ({"room_width": (6, 3)}, "the smaller width must come first"),
        ({"room_width": (6, 6.1), "length": 32}, "no number of rooms"),
        ({"room_width": (2, 3)}, "to contain a door"),
        ({"door_width": 0.7}, r"door_width: it is 0\.7 m wide; a robot of 0\.3 m needs at least 0\.75 m"),
        ({"robot_radius": 0.5}, "door_width"),
        ({"robot_radius": 0.55, "door_width": 1.5, "room_width": (4, 6)}, "the lift's doors are 1.2 m wide"),
        ({"robot_radius": 2, "door_width": 3, "room_width": (5, 8)}, "must be at least 6.00 m deep"),
        ({"corridor": 1.2, "robot_radius": 0.4}, "corridor"),
        ({"storey_height": 2.2}, "storey_height"),
        ({"length": 500, "depth": 50, "resolution": 0.01}, "coarser resolution"),
    ],
)
def test_invalid_building_parameters_raise(values: dict[str, Any], why: str) -> None:
    with pytest.raises((CannotGenerate, Invalid), match=why):
        site_checks.make("office", **values)


def test_building_is_generated_over_http(api: Api) -> None:
    format_names = ("openrmf", "rmf_nav_graph", "tmap2", "gazebo", "kml")
    version = site_checks.over_http(api, "office", format_names, length=16)
    assert version["information"]["topology"] == "generated"
    site_checks.over_http(api, "hospital", ("openrmf",), length=16)
    grid = api.get("environments/made-office/versions/latest/maps/occupancy_grid?level=L2")
    assert grid.content[:2] == b"PK"

"""rmf_site: sites round-trip, positions match the editor, conversion to buildings and graphs."""

from __future__ import annotations

import json
import math
import random
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
import yaml

from app import formats
from app.convert.files import offline
from app.errors import MissingLayer, UnreadableFile
from app.formats import FileGroup, ReadContext, WriteContext, get_format
from app.limits import Limits
from app.model.features import Features, features
from app.model.frame import Datum, Level
from app.model.geodesy import local_frame
from app.model.layers import Layers, Part, PartKey
from app.syntax import ron
from app.upload_reader import UploadHints

FORMAT = get_format("rmf_site")
SAMPLES = Path(__file__).resolve().parents[1] / "samples" / "rmf_site"
WARD = {
    "ward.site.json": (SAMPLES / "ward" / "ward.site.json").read_bytes(),
    "plans/ground.png": (SAMPLES / "ward" / "plans" / "ground.png").read_bytes(),
}
HUT = {"hut.site.ron": (SAMPLES / "hut.site.ron").read_bytes()}


def ward(**changes: Any) -> dict[str, bytes]:
    """The sample with other values: a member's path, its parts joined by ``__``, to its new value; None deletes it."""
    top = json.loads(WARD["ward.site.json"])
    for path, value in changes.items():
        *above, last = path.split("__")
        inner = top
        for key in above:
            inner = inner[key]
        if value is None:
            del inner[last]
        else:
            inner[last] = value
    return {**WARD, "ward.site.json": json.dumps(top).encode()}


def read(files: dict[str, bytes], **context: Any) -> tuple[Layers, ReadContext]:
    read_context = ReadContext(**context)
    return formats.read(FileGroup(FORMAT, next(iter(files)), files), read_context), read_context


def write(layers: Layers, **options: Any) -> tuple[dict[str, Any], dict[str, bytes], WriteContext]:
    context = WriteContext(options=formats.write_options(FORMAT, options))
    files = formats.write(FORMAT, layers, context)
    main = next(iter(files))
    site = json.loads(files[main]) if main.endswith(".json") else ron.load(files[main], Limits())
    return site, files, context


def network(layers: Layers, level: str = "Ground floor") -> Features:
    content = layers.parts[PartKey("topology", level, "network")]
    assert isinstance(content, Features)
    return content


def objects(layers: Layers, level: str = "Ground floor") -> Features:
    content = layers.parts[PartKey("objects", level, "openrmf")]
    assert isinstance(content, Features)
    return content


def item(part: Features, i: str) -> tuple[dict[str, Any], list[list[float]]]:
    k = part.index()[i]
    return dict(part.properties[k]), shapely.get_coordinates(part.geometry[k]).tolist()


def with_part(layers: Layers, key: PartKey, new: Part) -> Layers:
    return Layers({**layers.parts, key: new}, layers.datum, layers.levels)


def changed(part: Features, i: str, geometry: Any = None, **properties: Any) -> Features:
    k = part.index()[i]
    places, new_properties = part.geometry.copy(), list(part.properties)
    places[k] = places[k] if geometry is None else geometry
    new_properties[k] = {**new_properties[k], **properties}
    return Features(part.ids, places, tuple(new_properties), part.local, part.document)


def problems(context: ReadContext | WriteContext) -> str:
    return "\n".join(f"{p.where}: {p.problem}" for p in context.warnings)


def test_site_round_trips_in_json_and_ron() -> None:
    layers, _ = read(WARD)
    original = json.loads(WARD["ward.site.json"])
    site, files, context = write(layers)
    assert site == original
    assert list(files) == ["map.site.json", "plans/ground.png"]
    assert files["plans/ground.png"] == WARD["plans/ground.png"]
    assert not context.dropped
    assert not context.warnings
    again, files, _ = write(layers, encoding="ron")
    assert again == original
    assert list(files) == ["map.site.ron", "plans/ground.png"]
    text = files["map.site.ron"].decode()
    for piece in (
        "10: Translate2D((0.0, 0.0)),",
        "graphs: Only([120]),",
        "graphs: All,",
        "tags: [Charger, ParkingSpot, HoldingPoint],",
        "reverse: Disable,",
        "CategorizedTranslate2D({\n",
        '"Power Source": {',
    ):
        assert piece in text
    assert FORMAT.selection.from_filename("map.site.ron") == {"encoding": "ron"}
    assert FORMAT.selection.from_filename("map.site.json") == {"encoding": "json"}
    assert FORMAT.selection.from_filename("map.zip") == {}


def test_item_positions_match_values_computed_by_hand() -> None:
    layers, context = read(WARD)
    assert layers.levels == (Level("Ground floor", 0.0), Level("Upstairs", 3.5))
    assert layers.datum == Datum(53.2686, -0.5245)
    ground, up = network(layers), network(layers, "Upstairs")
    kinds = [
        Counter(p["kind"] for p in part.properties)
        for part in (ground, up, objects(layers), objects(layers, "Upstairs"))
    ]
    assert kinds == [
        {"node": 6, "edge": 7},
        {"node": 3, "edge": 4},
        {"wall": 3, "door": 4, "floor": 1, "measurement": 1, "fiducial": 1, "model": 1, "lift": 1},
        {"wall": 1, "robot": 1},
    ]
    charger, at = item(ground, "charger_1")
    assert at == [[2.0, 2.0]]
    parameters = charger["openrmf"]["parameters"]
    assert {word: value for word, (_, value) in parameters.items()} == {
        **dict.fromkeys(("is_charger", "is_parking_spot", "is_holding_point"), True),
        "spawn_robot_name": "tug_1",
        "spawn_robot_type": "Tug",
    }
    bay, _ = item(ground, "bay")
    assert {w: v for w, (_, v) in bay["openrmf"]["parameters"].items()} == {
        "is_parking_spot": True,
        "mutex": "narrow",
        "dock_name": "bay",
    }
    assert ground.geometry[ground.index()["Ground floor/17"]].z == 0.25
    cabin, at = item(ground, "Ground floor/117")
    assert at == [pytest.approx([8.0, 5.0])], "the cabin's middle: 1.135 m behind its reference anchors"
    assert cabin["openrmf"]["parameters"]["lift_cabin"] == [1, "Lift A"]
    assert item(up, "Upstairs/117")[1] == at
    one, _ = item(ground, "Ground floor/15_bay")
    assert (one["source"], one["target"], one["speed_limit"]) == ("Ground floor/15", "bay", 0.5)
    assert {w: v for w, (_, v) in one["openrmf"]["parameters"].items()} == {
        **{"bidirectional": False, "graph_idx": 0, "orientation": "forward", "mutex": "narrow", "speed_limit": 0.5}
    }
    assert "bay_Ground floor/15" not in ground.ids
    back, _ = item(ground, "Ground floor/17_Ground floor/15")
    assert back["speed_limit"] == 0.25
    assert back["openrmf"]["parameters"]["orientation"] == [1, "backward"]
    lift, at = item(objects(layers), "Ground floor/lift/110")
    assert lift["size"] == [2.0, 1.8, 2.5]
    assert lift["pose"] == pytest.approx([8.0, 5.0, 0.0, 0.0, 0.0, 0.0])
    says = lift["openrmf"]["says"]
    assert says["doors"]["front_door"] == {
        **{"door_type": 2, "motion_axis_orientation": 1.570796327, "width": 1.0, "x": 1.135, "y": 0.2}
    }
    assert says["doors"]["back_door"]["x"] == -1.175
    assert says["level_doors"] == {"Ground floor": ["front_door"], "Upstairs": ["back_door"]}
    assert (says["lowest_floor"], says["highest_floor"]) == ("Ground floor", "Upstairs")
    door, _ = item(objects(layers), "Ground floor/door/30")
    assert (door["name"], door["height"]) == ("main door", 2.1)
    assert {w: v for w, (_, v) in door["openrmf"]["parameters"].items()} == {
        **{"type": "double_hinged", "right_left_ratio": 2.0, "motion_axis": "start", "motion_degrees": 80.0},
        **{"motion_direction": 1, "name": "main door"},
    }
    low, _ = item(objects(layers), "Ground floor/wall/61")
    assert (low["height"], low["base"]) == (1.2, 0.1)
    assert item(objects(layers), "Ground floor/wall/62")[1] == [[12.0, 8.0], [-0.05, 8.05]], (
        "the anchor's place for walls"
    )
    measured, at = item(objects(layers), "Ground floor/measurement/45")
    assert at == [[2.0, -1.0], [12.0, -1.0]]
    assert measured["openrmf"]["parameters"]["distance"] == [3, 10.0]
    assert item(objects(layers), "Ground floor/fiducial/44")[0]["name"] == "north east"
    robot, _ = item(objects(layers, "Upstairs"), "Upstairs/model/174")
    assert robot["pose"] == pytest.approx([5.0, 5.0, 3.5, 0.0, 0.0, 2 * math.atan2(0.6, 0.8)])
    assert "2 lanes belong to several graphs" in problems(context)


def test_older_ron_site_reads_as_same_elements() -> None:
    layers, _ = read(HUT)
    desk, _ = item(objects(layers, "L1"), "L1/model/50")
    assert desk["pose"] == pytest.approx([1.5, 2.0, 0.0, 0.0, 0.0, math.pi / 4])
    assert desk["openrmf"]["says"] == {"model_name": "OpenRobotics/Desk", "static": True}
    assert [e["openrmf"]["parameters"]["graph_idx"] for e in network(layers, "L1").select_kinds("edge").properties] == [
        [2, 3]
    ]
    site, _, context = write(layers)
    assert site["properties"]["name"] == 'hut "two" é'
    assert site["navigation"]["guided"]["locations"]["82"]["name"] == 'stop "1"'
    (model,) = site["model_instances"].values()
    (scenario,) = site["scenarios"].values()
    assert site["model_descriptions"][str(model["description"])]["source"] == {"Search": "OpenRobotics/Desk"}
    assert scenario["instances"]["50"] == {"pose": model["pose"], "inclusion": "Included", "on_level": 0}
    assert "the image 'scan.png' was not uploaded" in problems(context)


def test_unknown_members_give_a_warning_and_round_trip() -> None:
    files = ward(
        new_in_0_2={"a": 1},
        levels__1__mood="blue",
        levels__2__mood="red",
        navigation__guided__lanes__130__colour=[1, 2],
    )
    layers, context = read(files)
    assert "unknown member 'levels: mood' (2 times)" in problems(context)
    assert "unknown member 'new_in_0_2'" in problems(context)
    assert "unknown member 'lanes: colour'" in problems(context)
    assert write(layers)[0] == json.loads(files["ward.site.json"])


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"format_version": "1.0"}, "format_version: version 1.0 is not supported"),
        ({"format_version": 1}, "format_version: must be a string"),
        ({"levels": {}}, "levels: a site needs at least one level"),
        ({"levels__1__anchors__10": {"Translate2D": [1.0]}}, "levels.1.anchors.10: must be a list of 2 numbers"),
        ({"levels__1__anchors__10": {"Spline": []}}, "levels.1.anchors.10: must be Translate2D"),
        ({"levels__1__anchors__10": {"Translate2D": [1e9, 0]}}, "levels.1.anchors.10: must be within"),
        ({"levels__1__anchors__ten": {"Translate2D": [1.0, 1.0]}}, "invalid id 'ten'"),
        ({"levels__1__walls__60__anchors": [10, 999]}, "levels.1.walls.60: uses anchors"),
        ({"levels__1__walls__60__anchors": [10]}, "levels.1.walls.60.anchors: must be a list of 2 ids"),
        ({"levels__1__walls__60__anchors": [10, True]}, "must be an element id"),
        ({"levels__1__doors__31__kind": {"SingleSwing": {"swing": {"Forward": {"grad": 1}}}}}, "must be deg or rad"),
        ({"levels__1__drawings__40__properties__pixels_per_meter": 0}, "must be between"),
        ({"navigation__guided__lanes__130__reverse": "Maybe"}, "must be Same, Disable or Different"),
        ({"navigation__guided__lanes__130__graphs": "None"}, "must be All, Only or AllExcept"),
        ({"lifts__110__properties__reference_anchors": [10, 11]}, "unknown anchor 10 of the site"),
        ({"lifts__110__properties__cabin__Rect__depth": -1}, "must have a depth and a width above 0"),
        ({"model_instances__172__pose__rot": {"quat": [0, 0, 0, 0]}}, "invalid rotation"),
        ({"properties__geographic_offset__anchor": [95.0, 0.0]}, "latitude must be between"),
    ],
)
def test_invalid_site_raises_unreadable_file_with_location(changes: dict[str, Any], reason: str) -> None:
    with pytest.raises(UnreadableFile) as caught:
        read(ward(**changes))
    assert reason in caught.value.detail
    assert caught.value.problems[0].file == "ward.site.json"


@pytest.mark.parametrize(("latitude", "good"), [(-80.1, False), (-80.0, True), (84.0, True), (84.1, False)])
def test_check_rejects_latitudes_outside_utm_zones(latitude: float, good: bool) -> None:
    files = ward(properties__geographic_offset__anchor=[latitude, 0.0])
    findings = [p for p in formats.check(FORMAT, files) if p.where == "properties.geographic_offset.anchor"]
    assert [p.level for p in findings] == ([] if good else ["error"])


def test_lanes_without_anchor_round_trip() -> None:
    lane = {"anchors": [14, 999], "graphs": "All"}
    layers, context = read(ward(navigation__guided__lanes__136=lane))
    assert "1 items use no anchor" in problems(context)
    site, _, write_context = write(layers)
    assert site["navigation"]["guided"]["lanes"]["136"] == lane
    assert "136 use anchors that do not exist" in problems(write_context)


def test_edited_geometry_takes_precedence() -> None:
    layers, _ = read(WARD)
    key = PartKey("topology", "Ground floor", "network")
    moved = changed(network(layers), "Ground floor/15", shapely.Point(7.0, 2.5), name="middle")
    moved = moved.select([k for k, i in enumerate(moved.ids) if i != "Ground floor/15_charger_1"])
    edited = with_part(layers, key, moved)
    solid = PartKey("objects", "Ground floor", "openrmf")
    thing = changed(objects(layers), "Ground floor/wall/60", shapely.LineString([[0.0, 0.0], [11.0, 0.5]]))
    thing = changed(thing, "Ground floor/lift/110", shapely.Point(8.5, 5.0), pose=[8.5, 5.0, 0, 0, 0, math.pi / 2])
    thing = thing.select([k for k, i in enumerate(thing.ids) if i != "Ground floor/model/172"])
    site, _, _ = write(with_part(edited, solid, thing))
    level, guided = site["levels"]["1"], site["navigation"]["guided"]
    assert level["anchors"]["15"] == {"Translate2D": [7.0, 2.5]}
    assert guided["lanes"]["130"]["reverse"] == "Disable"
    new = next(one for one in guided["locations"].values() if one["name"] == "middle")
    assert new == {"anchor": 15, "tags": [], "name": "middle", "graphs": "All"}
    first, second = level["walls"]["60"]["anchors"]
    assert first == 10
    assert level["anchors"][str(second)] == {"Translate2D": [11.0, 0.5]}
    left, right = (
        site["anchors"][str(i)]["Translate2D"] for i in site["lifts"]["110"]["properties"]["reference_anchors"]
    )
    assert [*left, *right] == pytest.approx([7.6, 6.135, 9.4, 6.135]), "the front points along y now"
    assert site["model_instances"].keys() == {"173", "174"}
    assert site["scenarios"]["160"]["instances"].keys() == {"173", "199"}


def test_environment_datum_is_kept_when_site_has_another() -> None:
    frame = local_frame(Datum(1.0, 2.0, heading=10.0))
    layers, context = read(WARD, frame=frame)
    assert layers.datum is None
    assert "differs from the environment's datum" in problems(context)
    site, _, write_context = write(Layers(layers.parts, Datum(1.0, 2.0, 5.0, 10.0), layers.levels))
    assert site["properties"]["geographic_offset"] == {"anchor": [1.0, 2.0], "zoom": 17, "visible": True}
    assert {d.subject for d in write_context.dropped} == {"the datum's heading", "the datum's altitude"}


def summary(building: dict[str, Any]) -> dict[str, Any]:
    """Extract the data of each level that both formats support."""
    out: dict[str, Any] = {}
    for name, level in building["levels"].items():
        rows = {
            k: level.get(k) or [] for k in ("vertices", "lanes", "walls", "doors", "measurements", "floors", "models")
        }
        tags = {*("is_charger", "is_parking_spot", "is_holding_point", "mutex", "dock_name", "lift_cabin")}
        plain = [{w: v[1] for w, v in row[2].items()} for row in rows["lanes"]]
        doors = [{w: v[1] for w, v in row[2].items()} for row in rows["doors"]]
        out[name] = {
            **{k: len(rows[k]) for k in ("lanes", "walls", "doors", "floors")},
            "elevation": level.get("elevation", 0),
            "named": sorted(row[3] for row in rows["vertices"] if len(row) > 3 and row[3]),
            "tags": Counter(
                (word, value[1])
                for row in rows["vertices"]
                if len(row) > 4
                for word, value in row[4].items()
                if word in tags and value[1]
            ),
            "lane": Counter((p.get("graph_idx", 0), p["bidirectional"], p.get("orientation", "")) for p in plain),
            "door": Counter((p["name"], p["type"], p.get("motion_axis"), p.get("right_left_ratio", 1)) for p in doors),
            "models": Counter(m["model_name"] for m in rows["models"]),
            "drawing": (level.get("drawing") or {}).get("filename"),
        }
        if level.get("drawing"):
            out[name]["measured"] = sorted(row[2]["distance"][1] for row in rows["measurements"])
    return out


def test_real_buildings_round_trip_via_site(shared: Path) -> None:
    for path in sorted((shared / "data" / "openrmf_building").glob("*/*.building.yaml")):
        files = {path.name: path.read_bytes(), **{p.name: p.read_bytes() for p in path.parent.glob("*.png")}}
        site = offline(files, "rmf_site").files
        back = offline(site, "openrmf", hints=UploadHints("rmf_site")).files
        original, building = yaml.safe_load(files[path.name]), yaml.safe_load(back["building.yaml"])
        assert summary(building) == summary(original), path
        assert all(back[name] == files[name] for name in back if name != "building.yaml")
        lifts, again = original.get("lifts") or {}, building.get("lifts") or {}
        assert lifts.keys() == again.keys()
        for name, lift in lifts.items():
            for word in ("x", "y", "yaw", "width", "depth"):
                assert again[name][word] == pytest.approx(lift[word], abs=1e-6)
            (old,), (new,) = lift["doors"].values(), again[name]["doors"].values()
            assert new == pytest.approx(old)
            assert again[name]["level_doors"].keys() == lift["level_doors"].keys()


def test_site_exports_to_building_and_navigation_graphs() -> None:
    built = offline(WARD, "openrmf")
    building = yaml.safe_load(built.files["building.yaml"])
    ground = building["levels"]["Ground floor"]
    assert (building["name"], building["coordinate_system"]) == ("ward", "cartesian_meters")
    assert [row[3] for row in ground["vertices"] if row[3]] == ["charger_1", "bay"]
    assert Counter(row[2]["bidirectional"][1] for row in ground["lanes"]) == {True: 2, False: 3}
    assert building["lifts"]["Lift A"]["x"] == pytest.approx(8.0)
    graphs = offline(WARD, "rmf_nav_graph").files
    cleaners, tugs = (yaml.safe_load(graphs[name])["levels"] for name in ("0.yaml", "1.yaml"))
    assert (len(cleaners["Upstairs"]["lanes"]), len(tugs["Ground floor"]["lanes"])) == (4, 2)
    assert any(v[2].get("lift") == "Lift A" for v in cleaners["Ground floor"]["vertices"])


def test_options_add_chargers_and_robots_to_any_network() -> None:
    rows: list[tuple[str, Any, dict[str, Any]]] = [
        ("a", shapely.Point(0, 0), {"kind": "node"}),
        ("b", shapely.Point(3, 0), {"kind": "node"}),
        ("c", shapely.Point(3, 4, 1), {"kind": "node"}),
        ("ab", shapely.LineString([[0, 0], [3, 0]]), {"kind": "edge", "source": "a", "target": "b"}),
        ("ba", shapely.LineString([[3, 0], [0, 0]]), {"kind": "edge", "source": "b", "target": "a"}),
        (
            "bc",
            shapely.LineString([[3, 0], [3, 4]]),
            {"kind": "edge", "source": "b", "target": "c", "speed_limit": 0.5},
        ),
    ]
    layers = Layers({PartKey("topology", "ground", "network"): features(rows, "local")}, Datum(53.0, -1.0))
    site, _, context = write(layers, chargers="a", robot_name="tug", graph=2, building="barn", speed_limit=1.5)
    assert site["properties"] == {
        "name": "barn",
        "geographic_offset": {"anchor": [53.0, -1.0], "visible": False, "zoom": 15},
    }
    guided = site["navigation"]["guided"]
    both, one = guided["lanes"].values()
    assert both.keys() == {"anchors", "forward", "graphs"}
    assert (one["reverse"], one["forward"], both["forward"]) == ("Disable", {"speed_limit": 0.5}, {"speed_limit": 1.5})
    (graph,) = guided["graphs"].values()
    assert graph["name"] == "2"
    tags = {location["name"]: location["tags"] for location in guided["locations"].values()}
    assert tags == {"a": ["Charger", "ParkingSpot", "HoldingPoint"], "b": [], "c": []}
    (robot,) = site["model_instances"].values()
    assert (robot["name"], str(robot["description"]) in site["robots"]) == ("tug_1", True)
    assert {t.subject for t in context.template} >= {"lanes: graphs", "lanes: speed_limit"}
    assert ("heights of nodes above their level", 1) in {(d.subject, d.count) for d in context.dropped}
    again, _ = read({"map.site.json": json.dumps(site).encode()})
    assert np.allclose(
        shapely.get_coordinates(network(again, "ground").select_kinds("node").geometry), [[0, 0], [3, 0], [3, 4]]
    )
    with pytest.raises(MissingLayer, match="rmf_site needs a network"):
        write(Layers({}))


def test_check_finds_errors_of_the_editor() -> None:
    check = FORMAT.check
    assert check is not None
    assert list(check(WARD)) == []
    broken = ward(
        format_version="2.0",
        properties__geographic_offset__anchor=[85.0, 0.0],
        levels__1__doors__30__name=None,
        levels__1__walls__60__anchors=[10, 999],
        levels__1__floors__60={"anchors": [10, 11, 12]},
        levels__2__anchors__10={"Translate2D": [0.0, 0.0]},
        navigation__guided__lanes__130__graphs=None,
        navigation__guided__locations__151__name="charger_1",
        model_instances__172__description=999,
    )
    findings = {(p.where or "", p.level) for p in check(broken)}
    assert findings == {
        ("format_version", "error"),
        ("properties.geographic_offset.anchor", "error"),
        ("levels.1.doors.30", "error"),
        ("levels.1.walls", "error"),
        ("navigation.guided.lanes.130", "error"),
        ("navigation.guided.locations", "warning"),
        ("model_instances", "error"),
        ("", "error"),
    }


def test_members_of_wrong_type_are_rejected_or_round_trip() -> None:
    """Every site that the reader accepts can also be written."""
    top = json.loads(WARD["ward.site.json"])
    places: list[tuple[Any, Any]] = []
    stack: list[Any] = [top]
    while stack:
        inner = stack.pop()
        places += [(inner, key) for key in (inner if isinstance(inner, dict) else range(len(inner)))]
        stack += [v for v in (inner.values() if isinstance(inner, dict) else inner) if isinstance(v, dict | list)]
    dice = random.Random(5)
    others = (None, 5, -1, "x", [], {}, [1], {"a": 1}, 1e300, True, {"Only": [7]}, {"1": {}})
    refused = 0
    for inner, key in dice.sample(places, 60):
        was, inner[key] = inner[key], dice.choice(others)
        try:
            layers, _ = read({"a.site.json": json.dumps(top).encode()})
        except UnreadableFile as error:
            refused += 1
            assert error.problems
        else:
            again, _, _ = write(layers)
            assert again["format_version"] == "0.1"
        inner[key] = was
    assert 10 < refused < 60

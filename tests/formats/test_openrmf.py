"""openrmf: real buildings round-trip, positions match the official tools; edits and other networks."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
import yaml

from app import formats
from app.convert.files import offline
from app.errors import BadUpload, MissingLayer, UnreadableFile
from app.formats import FileGroup, ReadContext, WriteContext, get_format
from app.limits import Limits
from app.model.features import Features, features
from app.model.frame import Datum, Level
from app.model.geodesy import local_frame
from app.model.layers import Layers, Part, PartKey, Resources
from app.upload_reader import UploadHints

FORMAT = get_format("openrmf")
SAMPLES = Path(__file__).resolve().parents[1] / "samples" / "openrmf"
Same = Callable[[str, dict[str, bytes], dict[str, bytes]], list[str]]


def sample(name: str) -> dict[str, bytes]:
    folder = SAMPLES / name
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def read(files: dict[str, bytes] | str, **context: Any) -> tuple[Layers, ReadContext]:
    given = {"a.building.yaml": files.encode()} if isinstance(files, str) else files
    read_context = ReadContext(**context)
    main = next(n for n in given if n.endswith(".building.yaml"))
    return formats.read(FileGroup(FORMAT, main, given), read_context), read_context


def write(layers: Layers, **options: Any) -> tuple[dict[str, Any], dict[str, bytes], WriteContext]:
    context = WriteContext(options=formats.write_options(FORMAT, options))
    files = formats.write(FORMAT, layers, context)
    return yaml.safe_load(files["building.yaml"]), files, context


def part(layers: Layers, layer: str, level: str) -> Features:
    content = layers.parts[PartKey(layer, level, "network" if layer == "topology" else "openrmf")]  # type: ignore[arg-type]
    assert isinstance(content, Features)
    return content


def place(features_: Features, i: str) -> list[float]:
    return shapely.get_coordinates(features_.geometry[features_.index()[i]])[0].tolist()


def problems(context: ReadContext | WriteContext) -> str:
    return "\n".join(f"{p.where}: {p.problem}" for p in context.warnings)


def with_part(layers: Layers, key: PartKey, new: Part) -> Layers:
    return Layers({**layers.parts, key: new}, layers.datum, layers.levels)


def real(shared: Path) -> list[Path]:
    paths = sorted((shared / "data" / "openrmf_building").glob("*/*.building.yaml"))
    assert len(paths) >= 7
    return paths


def test_real_buildings_round_trip_with_images(shared: Path, same: Same) -> None:
    for path in real(shared):
        files = {path.name: path.read_bytes(), **{p.name: p.read_bytes() for p in path.parent.glob("*.png")}}
        back = offline(files, "openrmf").files
        assert same("openrmf", files, back) == [], path
        for name, data in back.items():
            assert name == "building.yaml" or data == files[name], "an image is kept byte for byte"
        assert offline(back, "openrmf", hints=UploadHints("openrmf")).files == back


def test_layers_match_facts_of_real_buildings(shared: Path, facts_json: dict[str, Any]) -> None:
    counted = ("walls", "doors", "floors", "models", "measurements", "fiducials", "holes")
    for path in real(shared):
        facts = facts_json[path.relative_to(shared / "data").as_posix()]["facts"]
        layers, _ = read({path.name: path.read_bytes()})
        lifts = 0
        for level, level_facts in facts["levels"].items():
            network, objects = part(layers, "topology", level), part(layers, "objects", level)
            kinds = Counter(p["kind"] for p in [*network.properties, *objects.properties])
            assert kinds["node"] == level_facts["vertices"]
            assert kinds["edge"] == level_facts["directed_lanes"]
            assert {k: kinds[k[:-1]] for k in counted} == {k: level_facts[k] for k in counted}
            assert sum("name" in p for p in network.properties if p["kind"] == "node") == level_facts["named_vertices"]
            graphs = Counter(
                str(p["openrmf"]["parameters"]["graph_idx"][1]) for p in network.select_kinds("edge").properties
            )
            both = {k: v * 2 for k, v in level_facts["lanes_by_graph_idx"].items()}
            assert graphs == both or level_facts["lanes_unidirectional"]
            lifts += kinds["lift"]
            official = facts["official_generator"]["levels"][level]
            scale, rotation, x, y = network.document["openrmf"]["transform"]
            assert scale == pytest.approx(official["scale_m_per_px"], abs=1e-11)
            assert rotation == pytest.approx(official["rotation_rad"], abs=1e-11)
            assert [x, y] == pytest.approx(official["translation"], abs=1e-8)
            nodes = network.select_kinds("node")
            at = shapely.get_coordinates(nodes.geometry)
            assert np.abs([at.min(0), at.max(0)] - np.array(official["vertex_bounds_m"])).max() < 6e-5
            first = next(k for k, p in enumerate(nodes.properties) if p["openrmf"]["index"] == 0)
            assert at[first].tolist() == pytest.approx(official["first_vertex_m"], abs=6e-7)
            assert layers.elevation(level) == level_facts["elevation"]
        assert lifts == len(facts["lifts"])


def test_measurements_and_fiducials_place_levels() -> None:
    """By hand: 0.098 m per pixel downstairs; upstairs half of it, turned by a quarter."""
    layers, context = read(sample("clinic"))
    ground, up = part(layers, "topology", "Ground floor"), part(layers, "topology", "Upstairs")
    assert place(ground, "charger_1") == pytest.approx([2.94, -2.94])
    assert place(ground, "lift_ground") == pytest.approx([9.8, -4.41])
    assert place(up, "lift_up") == pytest.approx([9.8, -4.41])
    assert up.document["openrmf"]["transform"][:2] == pytest.approx([0.049, math.pi / 2])
    assert layers.levels == (Level("Ground floor", 0.0), Level("Upstairs", 3.5))
    assert set(ground.ids) > {"Ground floor/0", "charger_1", "ward: 3", "charger_1_ward: 3", "ward: 3_charger_1"}
    edge = ground.properties[ground.index()["charger_1_ward: 3"]]
    assert (edge["source"], edge["target"], edge["speed_limit"]) == ("charger_1", "ward: 3", 0.5)
    objects = part(layers, "objects", "Ground floor")
    kinds = {p["kind"] for p in objects.properties}
    assert kinds == {"wall", "door", "measurement", "human_lane", "floor", "hole", "model", "fiducial", "lift"}
    lamp = objects.properties[objects.index()["Ground floor/model/1"]]
    assert lamp["pose"] == pytest.approx([7.84, -1.176, 1.25, 0, 0, -0.5])
    lift = objects.properties[objects.index()["Ground floor/lift/Lift A"]]
    assert lift["size"][:2] == [2, 2.5]
    assert lift["pose"] == pytest.approx([9.8, -4.41, 0, 0, 0, 0.25])
    door = objects.index()["Ground floor/door/0"]
    assert objects.properties[door]["name"] == "ward_door"
    assert shapely.get_coordinates(objects.geometry[door]).ravel() == pytest.approx([5.88, -0.98, 5.88, -3.92])
    assert "points outside the upload" in problems(context)
    assert sorted(layers.resources()) == ["plans/ground.png", "scan.png", "up.png"]


def test_image_outside_upload_is_written_under_base_name() -> None:
    building, files, _ = write(read(sample("clinic"))[0])
    assert building["levels"]["Upstairs"]["drawing"]["filename"] == "up.png"
    assert files["up.png"] == sample("clinic")["plans/up.png"]
    assert building["levels"]["Ground floor"]["layers"]["laser"]["filename"] == "scan.png"


def test_samples_round_trip_with_same_rows() -> None:
    for name in ("clinic", "yard", "quay"):
        files = sample(name)
        original = yaml.safe_load(files[f"{name}.building.yaml"])
        building, _, context = write(read(files)[0])
        for level, one in original["levels"].items():
            for section, rows in one.items():
                if section in ("drawing", "layers"):
                    continue
                if section == "floors":
                    rows = [{"parameters": {}, **row} for row in rows]
                if section in ("vertices", "fiducials"):
                    for row, new in zip(rows, building["levels"][level][section], strict=True):
                        assert new[:2] == pytest.approx(row[:2], abs=1e-9)
                        assert new[2:] == row[2:]
                elif section == "models":
                    for row, new in zip(rows, building["levels"][level][section], strict=True):
                        assert new == pytest.approx({"z": 0, **row}, abs=1e-9)
                else:
                    assert building["levels"][level].get(section) == rows or rows == {}, (name, level, section)
        for key, value in original.items():
            if key == "lifts" and value:
                old, new = value["Lift A"], building["lifts"]["Lift A"]
                assert [new.pop(axis) for axis in "xy"] == pytest.approx([old.pop(axis) for axis in "xy"], abs=1e-9)
                assert new == old
            elif key != "levels":
                assert building[key] == value
        assert not context.dropped


def test_wgs84_and_metric_buildings_keep_their_coordinates() -> None:
    quay, _ = read(sample("quay"))
    network = part(quay, "topology", "L1")
    assert not network.local.any()
    assert place(network, "berth_1") == [103.78, 1.3]
    yard, context = read(sample("yard"))
    ground = part(yard, "topology", "ground")
    assert place(ground, "gate#2") == [12.5, -3.25]
    assert ground.geometry[ground.index()["ground/2"]].z == 0.5
    assert "duplicate vertex names" in problems(context)
    assert "from a vertex to itself" in problems(context)


def test_web_mercator_round_trips_via_degrees() -> None:
    text = """
coordinate_system: web_mercator
name: m
levels:
  L: {elevation: 0, vertices: [[128, -128, 0, origin], [201.8, -127.1, 0, x]], lanes: [[0, 1, {graph_idx: [2, 0]}]]}
"""
    layers, _ = read(text)
    network = part(layers, "topology", "L")
    assert place(network, "origin") == pytest.approx([0.0, 0.0], abs=1e-12)
    x, y = place(network, "x")
    assert x == pytest.approx((201.8 - 128) / 128 * 180)
    assert math.asinh(math.tan(math.radians(y))) == pytest.approx(0.9 / 128 * math.pi)
    building, _, _ = write(layers)
    assert building["levels"]["L"]["vertices"][1][:2] == pytest.approx([201.8, -127.1], abs=1e-9)


def test_two_way_lane_becomes_one_way_when_edge_is_deleted() -> None:
    layers, _ = read(sample("clinic"))
    key = PartKey("topology", "Ground floor", "network")
    network = part(layers, "topology", "Ground floor")
    forward = network.index()["charger_1_ward: 3"]
    building, _, _ = write(with_part(layers, key, network.select(np.arange(len(network)) != forward)))
    lane = building["levels"]["Ground floor"]["lanes"][0]
    assert lane[:2] == [6, 5]
    assert lane[2]["bidirectional"] == [4, False]
    assert lane[2]["orientation"] == [1, "backward"]


def test_edges_with_different_speed_become_two_lanes() -> None:
    layers, _ = read(sample("clinic"))
    key = PartKey("topology", "Ground floor", "network")
    network = part(layers, "topology", "Ground floor")
    properties = list(network.properties)
    k = network.index()["charger_1_ward: 3"]
    properties[k] = {**properties[k], "speed_limit": 0.25}
    changed = Features(network.ids, network.geometry, tuple(properties), network.local, network.document)
    building, _, _ = write(with_part(layers, key, changed))
    first, second = building["levels"]["Ground floor"]["lanes"][:2]
    assert (first[:2], first[2]["speed_limit"], first[2]["bidirectional"]) == ([5, 6], [3, 0.25], [4, False])
    assert (second[:2], second[2]["speed_limit"], second[2]["bidirectional"]) == ([6, 5], [3, 0.5], [4, False])


def test_walls_stay_when_node_is_moved() -> None:
    layers, _ = read(sample("clinic"))
    key = PartKey("topology", "Ground floor", "network")
    network = part(layers, "topology", "Ground floor")
    geometry = network.geometry.copy()
    geometry[network.index()["Ground floor/0"]] = shapely.Point(9.8, -9.8)
    changed = Features(network.ids, geometry, network.properties, network.local, network.document)
    building, _, context = write(with_part(layers, key, changed))
    level = building["levels"]["Ground floor"]
    assert level["vertices"][0][:2] == pytest.approx([100, 100])
    assert level["walls"][0][:2] == [10, 1]
    assert level["vertices"][10][:2] == pytest.approx([10, 10])
    assert building["coordinate_system"] == "reference_image"
    assert not context.warnings


def test_building_is_written_in_metres_when_measurement_changes() -> None:
    layers, _ = read(sample("clinic"))
    key = PartKey("objects", "Ground floor", "openrmf")
    objects = part(layers, "objects", "Ground floor")
    properties = list(objects.properties)
    k = objects.index()["Ground floor/measurement/0"]
    source_properties = properties[k]["openrmf"]
    properties[k] = {**properties[k], "openrmf": {**source_properties, "parameters": {"distance": [3, 20]}}}
    changed = Features(objects.ids, objects.geometry, tuple(properties), objects.local, objects.document)
    building, _, context = write(with_part(layers, key, changed))
    assert building["coordinate_system"] == "cartesian_meters"
    assert building["levels"]["Upstairs"]["vertices"][0][:2] == pytest.approx([9.8, -4.41])
    assert "drawing" not in building["levels"]["Ground floor"]
    assert "no longer match the position of level" in problems(context)
    assert any("pixels" in line.subject for line in context.dropped)


def test_network_of_other_format_is_written_in_metres() -> None:
    datum = Datum(53.0, -0.5)
    at = local_frame(datum).to_wgs84(np.array([[0.0, 0.0], [10.0, 5.0], [20.0, 5.0]]))
    rows: list[tuple[str, Any, dict[str, Any]]] = [
        (f"n{k}", shapely.Point(xy), {"kind": "node", "osm": {"tags": {}}}) for k, xy in enumerate(at)
    ]
    for a, b in ((0, 1), (1, 0), (1, 2)):
        line = shapely.LineString(at[[a, b]])
        limit = {"speed_limit": 1.5} if a + b == 1 else {}
        rows.append((f"w{a}{b}", line, {"kind": "edge", "source": f"n{a}", "target": f"n{b}", "width": 2.0, **limit}))
    key = PartKey("topology", "ground", "network")
    building, _, context = write(Layers({key: features(rows, "wgs84")}, datum))
    assert building["coordinate_system"] == "cartesian_meters"
    level = building["levels"]["ground"]
    assert [v[3] for v in level["vertices"]] == ["n0", "n1", "n2"]
    assert level["vertices"][1][:2] == pytest.approx([10, 5], abs=1e-6)
    assert [lane[:2] for lane in level["lanes"]] == [[0, 1], [1, 2]]
    assert level["lanes"][0][2]["bidirectional"] == [4, True]
    assert level["lanes"][0][2]["speed_limit"] == [3, 1.5]
    assert level["lanes"][1][2] == {
        "bidirectional": [4, False],
        "graph_idx": [2, 0],
        "orientation": [1, ""],
        "speed_limit": [3, 0],
    }
    assert {line.subject for line in context.dropped} >= {"edges' widths", "nodes' attributes of other formats"}
    filled = {line.subject: line.value for line in context.template}
    assert filled == {"name": "map", "lanes: graph_idx": 0, "lanes: speed_limit": 0.0, "lanes: orientation": ""}
    options = {"chargers": "n1", "robot_name": "tractor", "graph": 2, "speed_limit": 0.8, "building": "Barn"}
    building, _, context = write(Layers({key: features(rows, "wgs84")}, datum), **options)
    level = building["levels"]["ground"]
    assert building["name"] == "Barn"
    assert level["vertices"][1][4] == {
        "is_charger": [4, True],
        "is_holding_point": [4, True],
        "is_parking_spot": [4, True],
        "spawn_robot_name": [1, "tractor_1"],
        "spawn_robot_type": [1, "TinyRobot"],
    }
    assert [lane[2]["speed_limit"] for lane in level["lanes"]] == [[3, 1.5], [3, 0.8]]
    assert {lane[2]["graph_idx"][1] for lane in level["lanes"]} == {2}
    assert {line.option for line in context.template if line.option} == {*options, "robot_type"}


def test_network_on_new_level_joins_building_in_pixels() -> None:
    layers, _ = read(sample("clinic"))
    node = features([("a", shapely.Point(3.0, 4.0), {"kind": "node"})], "local")
    building, files, _ = write(with_part(layers, PartKey("topology", "roof", "network"), node))
    assert building["coordinate_system"] == "reference_image"
    assert list(building["levels"])[-1] == "roof"
    again, _ = read({"x.building.yaml": files["building.yaml"]})
    assert place(part(again, "topology", "roof"), "a") == pytest.approx([3.0, 4.0])


def test_two_buildings_are_written_in_metres() -> None:
    clinic, _ = read(sample("clinic"))
    yard, _ = read(sample("yard"))
    both = Layers({**clinic.parts, **yard.parts}, None, (*clinic.levels, *yard.levels))
    building, _, context = write(both)
    assert building["coordinate_system"] == "cartesian_meters"
    assert building["levels"]["ground"]["vertices"][1][:2] == [12.5, -3.25]
    assert building["levels"]["Ground floor"]["vertices"][5][:2] == pytest.approx([2.94, -2.94])
    assert "different buildings" in problems(context)


def test_building_without_vertices_exports_to_own_format_only() -> None:
    text = "name: m\ncoordinate_system: cartesian_meters\nlevels:\n  L:\n    elevation: 2\n    models:\n"
    text += "      - {model_name: Bin, name: b, x: 1, y: 2, z: 0.5, yaw: 0}\n"
    back = offline({"m.building.yaml": text.encode()}, "openrmf").files
    model = yaml.safe_load(back["building.yaml"])["levels"]["L"]["models"][0]
    assert model == {"model_name": "Bin", "name": "b", "x": 1.0, "y": 2.0, "z": 0.5, "yaw": 0.0}
    with pytest.raises(MissingLayer):
        offline({"m.building.yaml": text.encode()}, "tmap2")


def test_rows_to_missing_vertices_round_trip() -> None:
    text = "name: m\nlevels:\n  L:\n    elevation: 0\n    vertices: [[0, 0, 0, a], [1, 1, 0, b]]\n"
    text += (
        "    lanes: [[0, 7, {graph_idx: [2, 0]}], [0, 1, {graph_idx: [2, 0]}]]\n    floors: [{vertices: [0, 1, 9]}]\n"
    )
    layers, context = read(text)
    assert "joins the vertices 0 and 7, but the level has 2" in problems(context)
    building, _, warned = write(layers)
    lanes = building["levels"]["L"]["lanes"]
    assert lanes == [[0, 1, {"graph_idx": [2, 0]}], [0, 7, {"graph_idx": [2, 0]}]]
    assert building["levels"]["L"]["floors"] == [{"vertices": [0, 1, 9]}]
    assert "will reject the file" in problems(warned)


def test_pixel_is_a_metre_when_measurements_and_fiducials_are_missing() -> None:
    text = "name: m\nlevels:\n  A: {elevation: 0, vertices: [[3, 4, 0, a]]}\n"
    text += "  B: {elevation: 1, vertices: [[5, 6, 0, b]]}\n"
    layers, context = read(text)
    assert place(part(layers, "topology", "A"), "a") == [3, -4]
    assert place(part(layers, "topology", "B"), "b") == [5, -6]
    assert "no measurement sets the scale" in problems(context)
    assert "fewer than two fiducials" in problems(context)


LEVEL = "name: m\nlevels:\n  L:\n    elevation: 0\n"
BROKEN = {
    "levels: 3\nwalls: 1\n": "levels",
    "name: m\nlevels: {}\n": "levels",
    "- 1\n": "",
    f"coordinate_system: polar\n{LEVEL}": "coordinate_system",
    f"reference_level_name: X\n{LEVEL}": "reference_level_name",
    f"{LEVEL}    vertices: [[1, 2], [3]]\n": "levels.L.vertices[1]",
    f"{LEVEL}    vertices: [[1, x, 0, a]]\n": "levels.L.vertices[0][1]",
    f"{LEVEL}    vertices: [[1, true, 0, a]]\n": "levels.L.vertices[0][1]",
    f"{LEVEL}    vertices: [[1, 2, 0, [a]]]\n": "levels.L.vertices[0][3]",
    f"{LEVEL}    vertices: [[1, 2, 0, a, 7]]\n": "levels.L.vertices[0][4]",
    f"{LEVEL}    vertices: {{a: 1}}\n": "levels.L.vertices",
    f"{LEVEL}    vertices: [[1, 2]]\n    walls: [[0, x]]\n": "levels.L.walls[0][1]",
    f"{LEVEL}    lanes: [3]\n": "levels.L.lanes[0]",
    f"{LEVEL}    lanes: [[0, 1, 5]]\n": "levels.L.lanes[0][2]",
    f"{LEVEL}    models: [{{name: a, x: 1}}]\n": "levels.L.models[0].y",
    f"{LEVEL}    models: [{{name: a, x: 1, y: 2, z: 1.0e+300}}]\n": "levels.L.models[0].z",
    f"{LEVEL}    floors: [{{vertices: [a]}}]\n": "levels.L.floors[0].vertices[0]",
    f"{LEVEL}    fiducials: [[1]]\n": "levels.L.fiducials[0]",
    f"{LEVEL}lifts: {{a: {{x: 1}}}}\n": "lifts.a.y",
    f"{LEVEL}    vertices: [[0, 0], [1.0e-300, 0]]\n    measurements: [[0, 1, {{distance: [3, 9]}}]]\n": (
        "levels.L.measurements"
    ),
}


@pytest.mark.parametrize("text", BROKEN)
def test_invalid_building_raises_unreadable_file(text: str) -> None:
    with pytest.raises(UnreadableFile) as caught:
        read(text)
    assert caught.value.problems[0].where == (BROKEN[text] or None)
    assert caught.value.problems[0].file == "a.building.yaml"


def test_far_coordinates_and_too_many_fiducials_raise_unreadable_file() -> None:
    with pytest.raises(BadUpload):
        read(f"{LEVEL}    vertices: [[1.0e+300, 2, 0, a]]\n")
    marks = ", ".join("[1, 2, a]" for _ in range(500))
    with pytest.raises(UnreadableFile, match="fiducials in common"):
        read(f"name: m\nlevels:\n  A: {{fiducials: [{marks}]}}\n  B: {{fiducials: [{marks}]}}\n")


def test_read_returns_requested_layers_only() -> None:
    layers, _ = read(sample("clinic"), requested_layers=frozenset({"topology"}))
    assert {key.layer for key in layers.parts} == {"topology"}
    assert not any(isinstance(p, Resources) for p in layers.parts.values())


def test_detect_rejects_other_yaml() -> None:
    samples = SAMPLES.parent
    for folder in ("tmap2", "datum", "occupancy_grid", "rmf_nav_graph"):
        for path in (samples / folder).rglob("*"):
            if path.is_file():
                assert not FORMAT.detect(path.name, path.read_bytes()), path
    assert not FORMAT.detect("x.project.yaml", b"building:\n  filename: a.building.yaml\nname: a\nversion: 1\n")


def test_large_building_is_read_and_written_in_bounded_time() -> None:
    n = 5000
    vertices = "".join(f'      - [{k}, {k % 7}, 0, ""]\n' for k in range(n))
    lanes = "".join(
        f'      - [{k}, {k + 1}, {{bidirectional: [4, true], graph_idx: [2, 0], orientation: [1, ""]}}]\n'
        for k in range(n - 1)
    )
    layers, _ = read(f"{LEVEL}    lanes:\n{lanes}    vertices:\n{vertices}", limits=Limits())
    building, _, _ = write(layers)
    assert len(building["levels"]["L"]["lanes"]) == n - 1

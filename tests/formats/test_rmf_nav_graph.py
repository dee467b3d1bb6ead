"""rmf_nav_graph: graphs round-trip, and graphs of a building equal those of the official generator."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable
from itertools import pairwise
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
from app.model.features import Features, features
from app.model.layers import Layers, PartKey
from app.upload_reader import UploadHints

FORMAT = get_format("rmf_nav_graph")
SAMPLES = Path(__file__).resolve().parents[1] / "samples"
Same = Callable[[str, dict[str, bytes], dict[str, bytes]], list[str]]


def sample(kind: str, name: str) -> dict[str, bytes]:
    folder = SAMPLES / kind / name
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def read(files: dict[str, bytes] | str) -> tuple[Layers, ReadContext]:
    given = {"0.yaml": files.encode()} if isinstance(files, str) else files
    context = ReadContext()
    return formats.read(FileGroup(FORMAT, next(iter(given)), given), context), context


def write(layers: Layers, **options: Any) -> tuple[dict[str, Any], WriteContext]:
    context = WriteContext(options=formats.write_options(FORMAT, options))
    files = formats.write(FORMAT, layers, context)
    return {name: yaml.safe_load(data) for name, data in files.items()}, context


def part(layers: Layers, layer: str, level: str) -> Features:
    name = "network" if layer == "topology" else "rmf_nav_graph"
    content = layers.parts[PartKey(layer, level, name)]  # type: ignore[arg-type]
    assert isinstance(content, Features)
    return content


def generated(shared: Path) -> list[Path]:
    folders = sorted((shared / "data" / "rmf_nav_graph").glob("generated_*"))
    assert len(folders) >= 6
    return folders


def test_real_graphs_round_trip(shared: Path, same: Same) -> None:
    for folder in [*generated(shared), shared / "data" / "openrmf_building" / "robast_sim"]:
        files = {p.name: p.read_bytes() for p in folder.rglob("[0-9].yaml")}
        back = offline(files, "rmf_nav_graph").files
        assert sorted(back) == sorted(files)
        assert same("rmf_nav_graph", files, back) == same("rmf_nav_graph", back, files) == [], folder
        assert offline(back, "rmf_nav_graph").files == back


def test_graphs_of_building_equal_official_generator(shared: Path, same: Same) -> None:
    for folder in generated(shared):
        building = shared / "data" / "openrmf_building" / folder.name.removeprefix("generated_")
        source = next(building.glob("*.building.yaml"))
        official = {p.name: p.read_bytes() for p in folder.rglob("*.yaml")}
        files = offline({source.name: source.read_bytes()}, "rmf_nav_graph").files
        assert sorted(files) == sorted(official)
        assert same("rmf_nav_graph", official, files) == same("rmf_nav_graph", files, official) == [], folder


def test_vertex_order_equals_official_generator(shared: Path) -> None:
    for folder in generated(shared):
        building = shared / "data" / "openrmf_building" / folder.name.removeprefix("generated_")
        source = next(building.glob("*.building.yaml"))
        files = offline({source.name: source.read_bytes()}, "rmf_nav_graph").files
        for path in folder.rglob("*.yaml"):
            ours, theirs = yaml.safe_load(files[path.name]), yaml.safe_load(path.read_bytes())
            for level, level_graph in theirs["levels"].items():
                assert ours["levels"][level]["lanes"] == level_graph["lanes"]
                names = [v[2] for v in level_graph["vertices"]]
                assert [v[2] for v in ours["levels"][level]["vertices"]] == names


def test_layers_match_facts_of_real_graphs(shared: Path, facts_json: dict[str, Any]) -> None:
    for folder in generated(shared):
        for path in sorted(folder.rglob("*.yaml")):
            facts = facts_json[path.relative_to(shared / "data").as_posix()]["facts"]
            layers, _ = read({path.name: path.read_bytes()})
            doors = 0
            for level, level_facts in facts["levels"].items():
                network = part(layers, "topology", level)
                kinds = Counter(p["kind"] for p in network.properties)
                assert (kinds["node"], kinds["edge"]) == (level_facts["vertices"], level_facts["lanes_directed"])
                if level_facts["vertices"]:
                    at = shapely.get_coordinates(network.select_kinds("node").geometry)
                    assert np.abs([at.min(0), at.max(0)] - np.array(level_facts["bounds"])).max() < 6e-5
            for objects in layers.vector("objects").values():
                doors += len(objects.select_kinds("door"))
            assert doors == facts["doors"]


def test_graphs_of_directory_form_one_network() -> None:
    groups, rest = formats.group(sample("rmf_nav_graph", "clinic"))
    assert [(g.format.name, sorted(g.files)) for g in groups] == [("rmf_nav_graph", ["0.yaml", "1.yaml"])]
    assert rest == []
    layers, _ = read(sample("rmf_nav_graph", "clinic"))
    ground = part(layers, "topology", "Ground floor")
    shared_node = ground.properties[ground.index()["ward: 3"]]
    assert shared_node["rmf_nav_graph"]["graphs"] == {"0": 1, "1": 0}
    assert len(ground.select_kinds("node")) == 5
    both = [p for p in ground.select_kinds("edge").properties if p["rmf_nav_graph"]["index"] == 3]
    assert {(p["source"], p["target"]) for p in both} == {
        ("Ground floor/2", "lift_ground"),
        ("lift_ground", "Ground floor/2"),
    }
    lift = part(layers, "objects", "Ground floor").select_kinds("lift").properties[0]
    assert (lift["size"][:2], lift["pose"][5]) == ([2.0, 2.5], 0.25)


def test_sample_round_trips_row_by_row() -> None:
    files = sample("rmf_nav_graph", "clinic")
    graphs, context = write(read(files)[0])
    for name, data in files.items():
        assert graphs[name] == yaml.safe_load(data)
    assert not context.dropped
    assert not context.template


def test_building_exports_doors_lifts_mutexes_limits_and_orientations() -> None:
    converted = offline(sample("openrmf", "clinic"), "rmf_nav_graph")
    zero, one = (yaml.safe_load(converted.files[name]) for name in ("0.yaml", "1.yaml"))
    assert list(converted.files) == ["0.yaml", "1.yaml"]
    lane = {"door_name": "ward_door", "mutex": "hall", "speed_limit": 0.5}
    assert zero["levels"]["Ground floor"]["lanes"] == [
        [0, 1, {**lane, "orientation_constraint": "forward"}],
        [1, 0, {**lane, "orientation_constraint": "backward"}],
        [1, 2, {"is_bidirectional": False}],
    ]
    charger = zero["levels"]["Ground floor"]["vertices"][0]
    assert charger[:2] == pytest.approx([2.94, -2.94])
    assert charger[2] == {
        "name": "charger_1",
        "is_charger": True,
        "is_parking_spot": True,
        "spawn_robot_name": "nurse_1",
    }
    assert zero["levels"]["Upstairs"] == {"lanes": [], "vertices": []}
    assert one["levels"]["Ground floor"]["vertices"][1][2] == {
        "name": "lift_ground",
        "lift": "Lift A",
        "lift_cabin": "Lift A",
    }
    assert one["levels"]["Upstairs"]["vertices"][0][2]["lift"] == "Lift A"
    assert one["levels"]["Upstairs"]["lanes"][0][2] == {"speed_limit": 1.25}
    for graph in (zero, one):
        assert graph["building_name"] == "clinic"
        assert graph["doors"]["ward_door"]["map"] == "Ground floor"
        assert graph["lifts"]["Lift A"]["position"] == pytest.approx([9.8, -4.41, 0.25])
        assert graph["lifts"]["Lift A"]["dims"] == [2.0, 2.5]


def test_metric_building_exports_offset_crs_and_dock_lanes() -> None:
    files = offline(sample("openrmf", "yard"), "rmf_nav_graph").files
    graph = yaml.safe_load(files["3.yaml"])
    assert (graph["offset"], graph["crs_name"]) == ([22700.5, 15900], "EPSG:3414")
    text = (
        "name: d\ncoordinate_system: cartesian_meters\nlevels:\n  L:\n    elevation: 0\n"
        "    vertices: [[0, 0, 0, a], [5, 0, 0, b, {dock_name: [1, pump]}]]\n"
        "    lanes: [[0, 1, {bidirectional: [4, true], graph_idx: [2, 0]}]]\n"
    )
    docked = yaml.safe_load(offline({"d.building.yaml": text.encode()}, "rmf_nav_graph").files["0.yaml"])
    assert docked["levels"]["L"]["lanes"] == [[0, 1, {"dock_name": "pump"}], [1, 0, {"undock_name": "pump"}]]


def test_graphs_round_trip_via_building(same: Same, shared: Path) -> None:
    for folder in generated(shared):
        files = {p.name: p.read_bytes() for p in folder.rglob("*.yaml")}
        building = offline(files, "openrmf").files
        assert same("rmf_nav_graph", files, offline(building, "rmf_nav_graph").files) == []


def test_network_of_other_format_becomes_graph_0_with_ids_as_names() -> None:
    rows: list[tuple[str, Any, dict[str, Any]]] = [
        ("a", shapely.Point(0, 0), {"kind": "node", "tmap2": {}}),
        ("b", shapely.Point(2, 0), {"kind": "node", "name": "Bee"}),
        ("c", shapely.Point(4, 0), {"kind": "node"}),
        ("d", shapely.Point(4, 9), {"kind": "node"}),
    ]
    for a, b in ("ab", "ba", "bc"):
        graphs = {"kind": "edge", "source": a, "target": b, "speed_limit": 0.5, "action": "move_base"}
        rows.append((f"{a}_{b}", shapely.LineString([(0, 0), (1, 0)]), graphs))
    graphs, context = write(Layers({PartKey("topology", "ground", "network"): features(rows, "local")}))
    level = graphs["0.yaml"]["levels"]["ground"]
    assert [v[2]["name"] for v in level["vertices"]] == ["a", "Bee", "c"]
    assert level["lanes"] == [
        [0, 1, {"speed_limit": 0.5}],
        [1, 0, {"speed_limit": 0.5}],
        [1, 2, {"speed_limit": 0.5, "is_bidirectional": False}],
    ]
    dropped = {line.subject: line.count for line in context.dropped}
    assert dropped == {"edges' actions": 3, "nodes without lanes": 1, "nodes' attributes of other formats": 1}
    assert [(line.subject, line.option) for line in context.template] == [
        ("building_name", "building"),
        ("lanes: graph", "graph"),
    ]


def test_repeated_names_of_other_formats_give_way_to_ids() -> None:
    """Fleet adapters refuse a graph with a duplicate name; elsewhere names need not be unique, also over levels."""
    line = shapely.LineString([(0, 0), (1, 0)])
    parts = {}
    for level, i, j, other in (("L1", "a", "b", "Hall"), ("L2", "c", "Dock", "Dock")):
        rows = [(i, shapely.Point(0, 0), {"kind": "node", "name": "Dock"})]
        rows += [(j, shapely.Point(1, 0), {"kind": "node", "name": other})]
        rows += [(f"{i}_{j}", line, {"kind": "edge", "source": i, "target": j})]
        rows += [(f"{level}/lone", shapely.Point(2, 0), {"kind": "node", "name": "Hall"})]
        parts[PartKey("topology", level, "network")] = features(rows, "local")
    graphs, context = write(Layers(parts))
    names = [v[2]["name"] for level in ("L1", "L2") for v in graphs["0.yaml"]["levels"][level]["vertices"]]
    assert names == ["a", "Hall", "c", "Dock"], "nodes without lanes are not in the graph"
    (warning,) = context.warnings
    assert "1 names occur more than once: Dock;" in warning.problem
    context = WriteContext()
    building = yaml.safe_load(formats.write(get_format("openrmf"), Layers(parts), context)["building.yaml"])
    names = [v[3] for level in ("L1", "L2") for v in building["levels"][level]["vertices"]]
    assert sorted(names) == ["Dock", "L1/lone", "L2/lone", "a", "b", "c"]
    assert "2 names occur more than once: Dock, Hall;" in context.warnings[0].problem


@pytest.mark.parametrize(
    ("levels", "names"),
    [
        ({"L": [("Hall", "Dock"), ("q", "Dock"), ("z", "Hall")]}, ["Hall#2", "q", "Hall"]),
        ({"L": [("z", "Hall"), ("q", "Dock"), ("Hall", "Dock")]}, ["Hall", "q", "Hall#2"]),
        ({"L1": [("n1", "Dock"), ("n2", "")], "L2": [("n1", "Dock"), ("n2", "")]}, ["n1", "n2", "n1#2", "n2#2"]),
    ],
)
def test_ids_that_replace_names_are_unique(levels: dict[str, list[tuple[str, str]]], names: list[str]) -> None:
    """An id may be the name of another node, and occur on other levels."""
    parts = {}
    for level, nodes in levels.items():
        rows: list[Any] = [(i, shapely.Point(k, 0), {"kind": "node", "name": n}) for k, (i, n) in enumerate(nodes)]
        for k, ((a, _), (b, _)) in enumerate(pairwise(nodes)):
            line = shapely.LineString([(k, 0), (k + 1, 0)])
            rows.append((f"e{k}", line, {"kind": "edge", "source": a, "target": b}))
        parts[PartKey("topology", level, "network")] = features(rows, "local")
    graphs, context = write(Layers(parts))
    assert [v[2]["name"] for level in graphs["0.yaml"]["levels"].values() for v in level["vertices"]] == names
    assert ["names occur more than once" in w.problem for w in context.warnings] == [True]
    building = yaml.safe_load(formats.write(get_format("openrmf"), Layers(parts), WriteContext())["building.yaml"])
    assert sorted(v[3] for level in building["levels"].values() for v in level["vertices"]) == sorted(names)


def test_same_id_in_two_networks_of_a_level_becomes_two_names() -> None:
    rows: list[Any] = [("n", shapely.Point(0, 0), {"kind": "node"})]
    parts = {PartKey("topology", "L", name): features(rows, "local") for name in ("a", "b")}
    building = yaml.safe_load(formats.write(get_format("openrmf"), Layers(parts), WriteContext())["building.yaml"])
    assert [v[3] for v in building["levels"]["L"]["vertices"]] == ["n", "n#2"]


@pytest.mark.parametrize(("numbers", "names"), [((12, 13.5), ["12", "13.5"]), ((12, 12), ["a", "b"])])
def test_numbers_are_names(numbers: tuple[float, float], names: list[str]) -> None:
    named = zip("ab", numbers, strict=True)
    rows: list[Any] = [(i, shapely.Point(n, 0), {"kind": "node", "name": n}) for i, n in named]
    rows += [("a_b", shapely.LineString([(12, 0), (13, 0)]), {"kind": "edge", "source": "a", "target": "b"})]
    layers = Layers({PartKey("topology", "L", "network"): features(rows, "local")})
    graphs, _ = write(layers)
    assert [v[2]["name"] for v in graphs["0.yaml"]["levels"]["L"]["vertices"]] == names
    building = yaml.safe_load(formats.write(get_format("openrmf"), layers, WriteContext())["building.yaml"])
    assert [v[3] for v in building["levels"]["L"]["vertices"]] == names


def test_name_of_open_rmf_stays_where_another_format_repeats_it() -> None:
    layers, _ = read(
        "building_name: x\nlevels: {L: {vertices: [[0, 0, {name: a}], [1, 0, {}]], lanes: [[0, 1, {}]]}}\n"
    )
    rows: list[Any] = [("p", shapely.Point(3, 0), {"kind": "node", "name": "a"})]
    rows += [("q", shapely.Point(4, 0), {"kind": "node"})]
    rows += [("p_q", shapely.LineString([(3, 0), (4, 0)]), {"kind": "edge", "source": "p", "target": "q"})]
    more = {PartKey("topology", "M", "network"): features(rows, "local")}
    graphs, _ = write(Layers({**layers.parts, **more}))
    levels = graphs["0.yaml"]["levels"]
    assert [v[2]["name"] for level in "LM" for v in levels[level]["vertices"]] == ["a", "", "p", "q"]


def test_options_fill_in_robots_and_lanes() -> None:
    rows: list[Any] = [(i, shapely.Point(k, 0), {"kind": "node"}) for k, i in enumerate(("a", "b10", "b9"))]
    line = shapely.LineString([(0, 0), (1, 0)])
    rows += [(f"{a}_{b}", line, {"kind": "edge", "source": a, "target": b}) for a, b in (("a", "b9"), ("a", "b10"))]
    layers = Layers({PartKey("topology", "ground", "network"): features(rows, "local")})
    options = {"chargers": "b10, b9,nowhere", "robot_name": "mower", "robot_type": "Mower", "graph": "3"}
    graphs, context = write(layers, **options, speed_limit="0.7", building="Farm")
    assert list(graphs) == ["3.yaml"]
    assert graphs["3.yaml"]["building_name"] == "Farm"
    level = graphs["3.yaml"]["levels"]["ground"]
    vertices = {v[2]["name"]: v[2] for v in level["vertices"]}
    charger = {"is_charger": True, "is_parking_spot": True, "is_holding_point": True, "spawn_robot_type": "Mower"}
    assert vertices["b9"] == {"name": "b9", **charger, "spawn_robot_name": "mower_1"}
    assert vertices["b10"] == {"name": "b10", **charger, "spawn_robot_name": "mower_2"}
    assert vertices["a"] == {"name": "a"}
    assert {lane[2]["speed_limit"] for lane in level["lanes"]} == {0.7}
    filled = {line.option: line.value for line in context.template}
    assert filled["robot_name"] == ["mower_1", "mower_2"]
    assert (filled["robot_type"], filled["graph"], filled["speed_limit"]) == ("Mower", 3, 0.7)
    assert [w.problem for w in context.warnings if "nowhere" in w.problem]
    # A source's own chargers get only the robots that they do not name.
    stored, _ = read(CHARGERS)
    stored_graphs, _ = write(stored, robot_name="nurse", chargers="c")
    at = stored_graphs["0.yaml"]["levels"]["L"]["vertices"]
    assert [v[2].get("spawn_robot_name") for v in at] == ["nurse_1", "nurse_2", "nurse_3"]
    assert "spawn_robot_type" not in at[0][2], "a robot that a source names is its own matter"
    plain, context = write(stored)
    assert plain["0.yaml"]["levels"]["L"]["vertices"][1][2] == {"name": "b", "is_charger": True}
    assert not [line for line in context.template if "robot" in line.subject]


CHARGERS = """building_name: x
levels:
  L:
    vertices:
    - [0, 0, {name: a, is_charger: true, spawn_robot_name: nurse_1}]
    - [1, 0, {name: b, is_charger: true}]
    - [2, 0, {name: c}]
    lanes: [[0, 1, {}], [1, 2, {}]]
"""


def test_level_without_vertices_is_written() -> None:
    text = "building_name: x\nlevels: {L: {vertices: [[0, 0, {name: a}]], lanes: []}, M: {vertices: [], lanes: []}}\n"
    graph = yaml.safe_load(offline({"0.yaml": text.encode()}, "rmf_nav_graph").files["0.yaml"])
    assert graph["levels"]["M"] == {"lanes": [], "vertices": []}
    assert offline({"0.yaml": text.encode()}, "tmap2").files, "an empty level is no part of other maps"


def test_graph_without_lifts_section_gets_none() -> None:
    """Older graphs name lifts at vertices only; with an empty section, fleet adapters would refuse them."""
    text = (
        "building_name: x\nlevels: {L: {vertices: [[0, 0, {name: a}], [1, 0, {lift: Lift1}]], lanes: [[0, 1, {}]]}}\n"
    )
    graphs, context = write(read(text)[0])
    assert graphs["0.yaml"]["levels"]["L"]["vertices"][1][2]["lift"] == "Lift1"
    assert "lifts" not in graphs["0.yaml"]
    assert not context.warnings
    plain, _ = write(read(text.replace("{lift: Lift1}", "{}"))[0])
    assert plain["0.yaml"]["lifts"] == {}


def test_duplicate_names_give_a_warning() -> None:
    graphs, context = write(
        read("building_name: x\nlevels: {L: {vertices: [[0, 0, {name: a}], [1, 0, {name: a}]]}}\n")[0]
    )
    assert len(graphs["0.yaml"]["levels"]["L"]["vertices"]) == 2
    assert "duplicate vertex names: a; fleet adapters reject them" in context.warnings[0].problem


def test_network_without_lanes_raises_missing_layer() -> None:
    node = features([("a", shapely.Point(0, 0), {"kind": "node"})], "local")
    with pytest.raises(MissingLayer, match="supply"):
        write(Layers({PartKey("topology", "ground", "network"): node}))


def test_lanes_to_missing_vertices_round_trip() -> None:
    layers, context = read("building_name: x\nlevels: {L: {vertices: [[0, 0, {name: a}]], lanes: [[0, 4, {}]]}}\n")
    assert "joins the vertices 0 and 4" in context.warnings[0].problem
    graphs, warned = write(layers)
    assert graphs["0.yaml"]["levels"]["L"]["lanes"] == [[0, 4, {}]]
    assert "will reject" in warned.warnings[0].problem


HEAD = "building_name: x\nlevels:\n  L:\n"
BROKEN = {
    "building_name: x\nlevels: 3\n": "levels",
    "building_name: x\nlevels: {}\n": "levels",
    f"{HEAD}    vertices: [[1]]\n": "levels.L.vertices[0]",
    f"{HEAD}    vertices: [[1, 2, 3]]\n": "levels.L.vertices[0][2]",
    f"{HEAD}    vertices: [[1, null, {{}}]]\n": "levels.L.vertices[0][1]",
    f"{HEAD}    lanes: [5]\n": "levels.L.lanes[0]",
    f"{HEAD}    lanes: [[a, 1, {{}}]]\n": "levels.L.lanes[0][0]",
    f"{HEAD}    vertices: []\ndoors: {{d: {{endpoints: [[0, 0]]}}}}\n": "doors.d.endpoints",
    f"{HEAD}    vertices: []\nlifts: {{d: {{position: [0, 0, 0]}}}}\n": "lifts.d",
}


@pytest.mark.parametrize("text", BROKEN)
def test_invalid_graph_raises_unreadable_file(text: str) -> None:
    with pytest.raises(UnreadableFile) as caught:
        read(text)
    assert caught.value.problems[0].where == BROKEN[text]
    assert caught.value.problems[0].file == "0.yaml"


WRONG_FILE: list[tuple[str, str]] = [
    ("[x, 0, {name: a}]", "levels.L.vertices[0][0]"),
    ("[0, 0, {name: a}]]}}\nlevels: [\n#", ""),
    ("[0, 0, {name: a}]]}}\ndoors: {d: {endpoints: [[0, 0]]}}\n#", "doors.d.endpoints"),
]


@pytest.mark.parametrize(("vertex", "where"), WRONG_FILE)
def test_error_names_the_graph_that_has_it(vertex: str, where: str) -> None:
    good = "building_name: x\nlevels: {L: {vertices: [[0, 0, {name: a}]]}}\n"
    files = {"nav/0.yaml": good, "nav/1.yaml": good.replace("[0, 0, {name: a}]", vertex), "nav/2.yaml": good}
    with pytest.raises(UnreadableFile) as caught:
        read({name: text.encode() for name, text in files.items()})
    assert [(p.file, p.where or "") for p in caught.value.problems] == [("nav/1.yaml", where)]


def test_warning_names_the_graph_that_has_it() -> None:
    good = "building_name: x\nlevels: {L: {vertices: [[0, 0, {name: a}]], lanes: []}}\n"
    files = {"nav/0.yaml": good.replace("lanes: []", "lanes: [[0, 7, {}]]"), "nav/1.yaml": good}
    _, context = read({name: text.encode() for name, text in files.items()})
    assert [p.file for p in context.warnings if "joins the vertices" in p.problem] == ["nav/0.yaml"]


def test_building_takes_precedence_over_its_graphs() -> None:
    files = {**sample("openrmf", "clinic"), **sample("rmf_nav_graph", "clinic")}
    building = yaml.safe_load(offline(files, "openrmf", hints=UploadHints()).files["building.yaml"])
    alone = yaml.safe_load(offline(sample("openrmf", "clinic"), "openrmf").files["building.yaml"])
    assert building == alone
    assert offline(files, "rmf_nav_graph").files == offline(sample("openrmf", "clinic"), "rmf_nav_graph").files


def test_equal_lane_parameters_are_shared_in_memory() -> None:
    """Memory of a large graph is that of its features: equal parameters are one object, keys are shared."""
    rows = "".join(f"      - [{k}, {k + 1}, {{speed_limit: 0.5}}]\n" for k in range(50))
    places = "".join(f"      - [{k}.5, 0.0, {{name: ''}}]\n" for k in range(51))
    text = f"building_name: hall\ndoors: {{}}\nlevels:\n  L1:\n    lanes:\n{rows}    vertices:\n{places}lifts: {{}}\n"
    layers, _ = read({"0.yaml": text.encode()})
    (network,) = layers.vector("topology").values()
    edges = [p for p in network.properties if p["kind"] == "edge"]
    assert len(edges) == 50
    assert len({id(p["rmf_nav_graph"]["parameters"]) for p in edges}) == 1
    assert [p["rmf_nav_graph"]["index"] for p in edges] == list(range(50))
    assert max(sys.getsizeof(p) for p in edges) < sys.getsizeof(dict(edges[0]))

"""tmap2: real files round-trip, layers match facts, nothing is dropped, invalid files raise errors with a location."""

from __future__ import annotations

import json
import math
import random
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import ryml
import shapely
import yaml
from hypothesis import given
from hypothesis import strategies as st

from app import formats
from app.errors import BadUpload, Invalid, MissingDatum, UnreadableFile
from app.formats import FileGroup, ReadContext, WriteContext, get_format
from app.formats.tmap.network import EPOCH, LAST_UPDATED, TRANSFORMATION
from app.limits import Limits
from app.model.features import Features, features
from app.model.frame import Datum, Level
from app.model.layers import Layers, PartKey

FORMAT = get_format("tmap2")
SAMPLES = Path(__file__).resolve().parents[1] / "samples" / "tmap2"
OLD = SAMPLES.parent / "tmap" / "old.tmap"
FACTS: dict[str, Any] = json.loads((SAMPLES / "facts.json").read_text())
NETWORK = PartKey("topology", "ground", "network")
POINTS = PartKey("objects", "ground", "tmap2")
Same = Callable[[str, dict[str, bytes], dict[str, bytes]], list[str]]


def read(data: bytes | str, name: str = "network.tmap2.yaml", **context: Any) -> tuple[Layers, ReadContext]:
    content = data.encode() if isinstance(data, str) else data
    read_context = ReadContext(main=name, **context)
    return formats.read(FileGroup(FORMAT, name, {name: content}), read_context), read_context


def write(layers: Layers, **context: Any) -> tuple[bytes, WriteContext]:
    write_context = WriteContext(**context)
    files = formats.write(FORMAT, layers, write_context)
    assert list(files) == ["network.tmap2.yaml"]
    return files["network.tmap2.yaml"], write_context


def network(layers: Layers) -> Features:
    """Return the network; points of interest as nodes derived by objects_to_topology."""
    part = layers.parts[NETWORK if NETWORK in layers.parts else POINTS]
    assert isinstance(part, Features)
    return Features(
        part.ids,
        part.geometry,
        tuple({**p, "kind": "node"} if p["kind"] == "poi" else p for p in part.properties),
        part.local,
        part.document,
    )


def again(layers: Layers) -> tuple[bytes, WriteContext]:
    return write(Layers({NETWORK: network(layers)}, layers.datum, layers.levels))


def warnings(context: ReadContext | WriteContext) -> str:
    return "\n".join(p.problem for p in context.warnings)


def bounds(part: Features) -> list[list[float]]:
    nodes = [g for g, p in zip(part.geometry, part.properties, strict=True) if p["kind"] != "edge"]
    xyz = np.nan_to_num(shapely.get_coordinates(nodes, include_z=True), nan=0.0)
    return [xyz.min(0).tolist(), xyz.max(0).tolist()]


LARGE_BYTES = 1_000_000
"""The comparator takes seconds for larger files; ``tests/test_real_maps.py`` compares them as they are served."""


def real(shared: Path) -> list[Path]:
    data = shared / "data"
    paths = [p for end in ("*.tmap2.yaml", "*.tmap2", "*.tmap", ".*.tmap2") for p in data.rglob(end)]
    return sorted(set(paths))


@cache
def read_file(path: Path) -> tuple[Layers, ReadContext]:
    """Read a real file, once for all tests."""
    return read(path.read_bytes(), path.name)


@cache
def write_again(path: Path) -> tuple[bytes, WriteContext]:
    """Write what was read from a real file, once for all tests."""
    return again(read_file(path)[0])


# --- real files ------------------------------------------------------------------------------------------------------


def test_real_files_round_trip(shared: Path, same: Same, facts_json: dict[str, Any]) -> None:
    paths = real(shared)
    assert len(paths) == sum(f.get("kind") == "tmap2" for f in facts_json.values()) == 9
    for path in paths:
        data = path.read_bytes()
        assert formats.detect(path.name, data) is (get_format("tmap") if path.suffix == ".tmap" else FORMAT), path
        assert [g.main for g in formats.group({path.name: data}, "tmap2")[0]] == [path.name]
        served, context = write_again(path)
        if len(data) < LARGE_BYTES:
            assert same("tmap2", {path.name: data}, {"network.tmap2.yaml": served}) == [], path
        assert context.dropped == []
        once_more, _ = again(read(served)[0])
        assert once_more == served, path


def test_layers_match_facts_of_real_files(shared: Path, facts_json: dict[str, Any]) -> None:
    for path in real(shared):
        fact = facts_json[str(path.relative_to(shared / "data"))]["facts"]
        layers, context = read_file(path)
        part = network(layers)
        edges = [p for p in part.properties if p["kind"] == "edge"]
        assert sum(p["kind"] == "node" for p in part.properties) == fact["nodes"]
        assert len(edges) + fact["dangling_edges"] == fact["edges_directed"]
        assert sum(p["source"] == p["target"] for p in edges) == fact["self_loops"]
        assert len({(p["source"], p["target"]) for p in edges}) == fact["distinct_directed_pairs"]
        assert np.allclose(bounds(part), fact["bounds_xyz"], rtol=0, atol=1e-8)
        assert bool(part.local.all())
        if "name" in fact:
            assert part.document["tmap2"]["name"] == fact["name"]
        assert ("self" in warnings(context)) == bool(fact["self_loops"])
        assert (list(layers.parts) == [POINTS]) == (fact["edges_directed"] == 0)
        actions: dict[str, int] = {}
        for p in edges:
            actions[p["action"]] = actions.get(p["action"], 0) + 1
        assert actions == fact["actions"]


def test_written_files_are_valid_for_schema_and_other_readers(shared: Path) -> None:
    for path in real(shared):
        if path.stat().st_size > 400_000:
            continue
        served, _ = write_again(path)
        check_schema(yaml.load(served, yaml.CSafeLoader))
        ryml.parse_in_arena(served)
        assert b"*" not in served.replace(b"'*", b"")


def check_schema(top: dict[str, Any]) -> None:
    """topological_navigation's tmap-schema.yaml, written out."""
    assert {"meta", "metric_map", "name", "nodes", "pointset"} <= top.keys()
    assert LAST_UPDATED.match(top["meta"]["last_updated"])
    assert all(isinstance(top[key], str) for key in ("metric_map", "name", "pointset"))
    for entry in top["nodes"]:
        assert {key: type(value) for key, value in entry["meta"].items() if key in ("map", "node", "pointset")} == {
            "map": str,
            "node": str,
            "pointset": str,
        }
        node = entry["node"]
        assert isinstance(node["name"], str)
        assert isinstance(node["parent_frame"], str)
        assert isinstance(node.get("properties", {}), dict)
        for edge in node["edges"]:
            assert isinstance(edge["edge_id"], str)
            assert isinstance(edge["node"], str)
            assert isinstance(edge.get("properties", {}), dict)


# --- our samples -----------------------------------------------------------------------------------------------------


def test_samples_match_facts() -> None:
    fact = FACTS["orchard.tmap2.yaml"]
    layers, context = read((SAMPLES / "orchard.tmap2.yaml").read_bytes())
    part = network(layers)
    edges = [p for p in part.properties if p["kind"] == "edge"]
    assert sum(p["kind"] == "node" for p in part.properties) == fact["nodes"]
    assert len(edges) == fact["edges"]
    assert sum(p["source"] == p["target"] for p in edges) == fact["self_loops"]
    assert bounds(part) == fact["bounds"]
    assert part.document["tmap2"]["name"] == fact["name"]
    text = warnings(context)
    assert ("leads to the unknown node" in text) == bool(fact["dangling"])
    assert ("have no edges" in text) == bool(fact["lonely"])
    assert ("duplicate node names" in text) == bool(fact["repeated_names"])
    assert ("duplicate edge ids" in text) == bool(fact["repeated_edge_ids"])


def test_nodes_without_edges_become_points_of_interest() -> None:
    layers, context = read((SAMPLES / "stops.tmap2.yaml").read_bytes())
    part = layers.parts[POINTS]
    assert isinstance(part, Features)
    assert part.ids == ("no", "42")
    assert [p["kind"] for p in part.properties] == ["poi", "poi"]
    assert bounds(part) == FACTS["stops.tmap2.yaml"]["bounds"]
    assert "points of interest" in warnings(context)
    served = yaml.safe_load(again(layers)[0])
    assert [n["node"]["name"] for n in served["nodes"]] == ["42", "no"]
    assert served["nodes"][0]["node"]["properties"] == {"semantics": "charger"}


def test_points_of_interest_document_names_derived_network() -> None:
    layers, _ = read((SAMPLES / "stops.tmap2.yaml").read_bytes())
    derived_network = network(layers).with_document({})
    served, _ = write(Layers({NETWORK: derived_network, **layers.parts}), title="farm")
    assert yaml.safe_load(served)["name"] == "stops"


def test_orchard_matches_expected_file(same: Same) -> None:
    data = (SAMPLES / "orchard.tmap2.yaml").read_bytes()
    layers, _ = read(data)
    part = network(layers)
    assert part.ids == ("Gate", "Row 1", "Größe", "Gate#2", "Gate_Row 1", "Gate_Gate", "Row 1_Größe", "Row 1_Größe#2")
    gate, row, size, second = part.properties[:4]
    assert gate["orientation"] == [0.0, 0.0, 0.7071067811865476, 0.7071067811865476]
    assert size["orientation"][3] == 2.0  # as its source gives it
    assert row["tmap2"]["node"]["edges"] == [{"action": "row_traversal", "edge_id": "Row 1_Barn", "node": "Barn"}]
    assert size["tmap2"]["meta"] == {"map": "orchard_north"}
    assert "meta" not in gate["tmap2"]
    assert second["name"] == "Gate"
    assert not part.geometry[0].has_z
    assert part.geometry[1].z == 1.5
    loop = part.properties[5]
    assert (loop["source"], loop["target"], loop["action"], loop["speed_limit"]) == ("Gate", "Gate", "wait_gate", 0.4)
    assert loop["tmap2"]["properties"] == {"surface": "gravel"}
    assert loop["tmap2"]["restrictions_planning"] is True
    assert part.properties[7]["tmap2"] == {"edge_id": "Row 1_Größe"}
    assert part.geometry[6].has_z
    served, context = again(layers)
    assert same("tmap2", {"a.tmap2.yaml": data}, {"b.tmap2.yaml": served}) == []
    assert context.dropped == []
    top = yaml.safe_load(served)
    check_schema(top)
    assert [n["node"]["name"] for n in top["nodes"]] == ["Gate", "Gate", "Größe", "Row 1"]
    assert top["verts"] == yaml.safe_load(data)["verts"]
    assert [e["node"] for n in top["nodes"] if n["node"]["name"] == "Row 1" for e in n["node"]["edges"]] == [
        "Barn",
        "Größe",
    ]


def test_older_list_is_written_with_missing_members() -> None:
    layers, _ = read(OLD.read_bytes(), "old.tmap")
    assert network(layers).document["tmap"] == {"layout": "list"}
    served, context = again(layers)
    top = yaml.safe_load(served)
    check_schema(top)
    assert (top["name"], top["metric_map"], top["pointset"]) == ("yard_points", "yard", "yard_points")
    node = top["nodes"][0]["node"]
    assert node["xy_goal_tolerance"] == 0.25
    assert node["properties"] == {"xy_goal_tolerance": 0.25, "yaw_goal_tolerance": 0.2}
    edge = node["edges"][0]
    assert edge["top_vel"] == 0.55
    assert edge["goal"] == {"target_pose": {"header": {"frame_id": "$node.parent_frame"}, "pose": "$node.pose"}}
    assert any("edges" in t.subject for t in context.template)


# --- names -----------------------------------------------------------------------------------------------------------


def two(first: Any, second: Any = "B") -> str:
    """Create a network of two nodes and one edge between them."""

    def node(name: Any, to: Any, x: float) -> dict[str, Any]:
        edges = [{"edge_id": f"e{x:g}", "node": to, "action": "move_base"}] if to is not None else []
        pose = {"position": {"x": x, "y": 2.0, "z": 0.0}, "orientation": {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}}
        return {
            "meta": {"map": "m", "node": name, "pointset": "p"},
            "node": {"name": name, "edges": edges, "pose": pose},
        }

    top = {"meta": {"last_updated": EPOCH}, "metric_map": "m", "name": "p", "pointset": "p"}
    nodes = [node(first, second, 1.0), node(second, None, 5.0)]
    return yaml.safe_dump(top | {"nodes": nodes}, allow_unicode=True)


@pytest.mark.parametrize(
    "name",
    [
        "no", "y", "1", "010", "1e5", "1.5", "2022-01-01", "~", "a: b", "- a", "!x", "&x", "*x", "#x", "a #b", " x ",
        "'", '"', "Größe 7", "übergänge/№ 1", "穀物", "🚜", "a\u200bb", "\u202eabc", "x" * 256, "null", "=", "[a]",
        "{", "%", "@a", "`", "A" * 250 + "é", "e\u0301", "\u00a0", "0x1F", "12:30", "...", "w1:2-3", "-1", ".5", "a.1",
        "_1",
    ],
)  # fmt: skip
def test_any_name_round_trips(name: str) -> None:
    layers, context = read(two(name))
    part = network(layers)
    assert part.properties[0]["name"] == name
    served, _ = again(layers)
    nodes = {n["node"]["name"]: n["node"] for n in yaml.safe_load(served)["nodes"]}
    assert set(nodes) == {name, "B"}
    assert nodes[name]["edges"][0]["node"] == "B"
    assert again(read(served)[0])[0] == served
    assert ("invisible" in warnings(context)) == (name in ("a\u200bb", "\u202eabc", "\u00a0"))


@pytest.mark.parametrize("name", ["", "x" * 257, "a\nb", "a\x07", "a\u2028b", None, ["a"], {"a": 1}])
def test_invalid_name_raises_unreadable_file(name: Any) -> None:
    with pytest.raises(UnreadableFile, match="name") as caught:
        read(two(name))
    assert caught.value.problems[0].where == "nodes[0].node.name"
    assert caught.value.problems[0].file == "network.tmap2.yaml"


def test_scalar_names_become_text_with_their_edges() -> None:
    layers, context = read(two(5, 7))
    assert network(layers).ids == ("5", "7", "e1")
    assert network(layers).properties[2]["target"] == "7"
    assert "is not text" in warnings(context)


def test_long_and_missing_edge_ids_round_trip() -> None:
    document = yaml.safe_load(two("A" * 256, "B" * 256))
    document["nodes"][0]["node"]["edges"] = [
        {"edge_id": "A" * 600, "node": "B" * 256},
        {"node": "B" * 256},
        {"edge_id": 7, "node": "B" * 256},
    ]
    layers, _ = read(yaml.safe_dump(document))
    part = network(layers)
    assert all(len(i) <= 512 for i in part.ids)
    edges = yaml.safe_load(again(layers)[0])["nodes"][0]["node"]["edges"]
    assert {e["edge_id"] for e in edges} == {"7", "A" * 600, f"{'A' * 256}_{'B' * 256}"}


# --- what other formats know -----------------------------------------------------------------------------------------


def from_elsewhere() -> Features:
    """Create a network of another format: geographic, without source properties of tmap2."""
    point, line = shapely.Point, shapely.LineString
    rows: list[tuple[str, Any, dict[str, Any]]] = [
        ("n1", point(-0.5245, 53.2686), {"kind": "node", "name": "Barn", "kml": {"style": {"icon": "x"}}, "floor": 2}),
        ("n10", point(-0.5235, 53.2686), {"kind": "node", "osm": {"tags": {"a": "b"}}, "drawn_from": "o"}),
        ("n2", point(-0.5245, 53.2696, 4.0), {"kind": "node", "orientation": [0.0, 0.0, 1.0, 0.0]}),
        ("w1:1-10", line([(-0.5245, 53.2686), (-0.5235, 53.2686)]),
         {"kind": "edge", "source": "n1", "target": "n10", "speed_limit": 1.5, "width": 3, "name": "Lane",
          "osm": {"way": 1}}),
        ("w1:10-1", line([(-0.5235, 53.2686), (-0.52, 53.27), (-0.5245, 53.2686)]),
         {"kind": "edge", "source": "n10", "target": "n1", "action": "row_traversal", "kml": {"surface": "grass"}}),
    ]  # fmt: skip
    return features(rows, "wgs84")


DATUM = Datum(53.2686, -0.5245)


@pytest.mark.parametrize("name", ["tmap2", "tmap"])
def test_options_set_members_of_new_nodes(name: str) -> None:
    fmt = formats.get_format(name)
    options = {"verts_radius": "1.5", "xy_goal_tolerance": "0.2", "yaw_goal_tolerance": "0.5"}
    context = WriteContext(options=formats.write_options(fmt, options), title="farm")
    (served,) = formats.write(fmt, Layers({NETWORK: from_elsewhere()}, DATUM), context).values()
    listed = yaml.safe_load(served)
    for entry in listed if name == "tmap" else listed["nodes"]:
        node = entry["node"]
        assert [math.hypot(v["x"], v["y"]) for v in node["verts"]] == pytest.approx([1.5] * 8)
        properties = node if name == "tmap" else node["properties"]
        turned = node["name"] == "n2"
        assert (properties["xy_goal_tolerance"], properties["yaw_goal_tolerance"]) == (0.2, 0.5 if turned else 6.29)
    filled = {line.subject: line.value for line in context.template}
    assert filled["nodes: verts"] == "an octagon of 1.5 m"
    assert (filled["nodes: xy_goal_tolerance"], filled["nodes: yaw_goal_tolerance"]) == (0.2, 0.5)
    assert filled["nodes without an orientation: yaw_goal_tolerance"] == 6.29
    for wrong in ({"verts_radius": "0"}, {"yaw_goal_tolerance": "7"}, {"xy_goal_tolerance": "nan"}):
        with pytest.raises(Invalid):
            formats.write_options(fmt, wrong)
    # A network of its own keeps what it says.
    again = formats.read(formats.group({f"a.{name}": served}, name)[0][0], ReadContext())
    (same,) = formats.write(fmt, again, WriteContext(title="farm")).values()
    assert same == served


def test_network_of_other_format_gets_defaults_and_keeps_attributes() -> None:
    served, context = write(Layers({NETWORK: from_elsewhere()}, DATUM), title="farm")
    top = yaml.safe_load(served)
    check_schema(top)
    assert (top["name"], top["metric_map"], top["pointset"]) == ("farm", "farm", "farm")
    assert top["meta"]["last_updated"] == EPOCH
    n1, n2, n10, bend = (n["node"] for n in top["nodes"])
    assert [n["name"] for n in (n1, n2, n10, bend)] == ["n1", "n2", "n10", "n1~n10~1"]
    assert n1["pose"]["position"] == {"x": 0.0, "y": 0.0, "z": 0.0}
    assert n10["pose"]["position"]["x"] == pytest.approx(66.72, abs=0.01)
    assert n2["pose"]["position"]["y"] == pytest.approx(111.30, abs=0.01)
    assert n2["pose"]["position"]["z"] == 4.0
    assert n10["pose"]["orientation"] == {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}
    assert (n10["properties"]["yaw_goal_tolerance"], n2["properties"]["yaw_goal_tolerance"]) == (6.29, 0.1)
    assert len(n1["verts"]) == 8
    assert all(math.hypot(v["x"], v["y"]) == pytest.approx(0.75) for v in n1["verts"])
    assert n1["properties"] | {"name": "Barn", "floor": 2, "kml": {"style": {"icon": "x"}}} == n1["properties"]
    assert "osm" not in n10["properties"]
    edge = n1["edges"][0]
    assert (edge["action"], edge["edge_id"], edge["node"]) == ("move_base", "w1:1-10", "n10")
    assert edge["properties"] == {"speed_limit": 1.5, "width": 3, "name": "Lane"}
    assert edge["restrictions_planning"] == "True"
    assert n10["edges"][0]["action"] == "row_traversal"
    assert {d.subject: d.count for d in context.dropped} == {"osm tags and attributes": 2}
    assert {"nodes at bends", "metric_map", "name", "pointset", "transformation"} <= {
        t.subject for t in context.template
    }

    back = network(read(served)[0])
    by_id = dict(zip(back.ids, back.properties, strict=True))
    assert set(back.ids) == {"n1", "n2", "n10", "w1:1-10", "w1:10-1"}
    assert by_id["n1"]["name"] == "Barn"
    assert by_id["n1"]["kml"] == {"style": {"icon": "x"}}
    assert (by_id["w1:1-10"]["speed_limit"], by_id["w1:1-10"]["width"], by_id["w1:1-10"]["name"]) == (1.5, 3, "Lane")
    assert by_id["w1:10-1"]["kml"] == {"surface": "grass"}
    assert again(read(served)[0])[0] == served


def test_options_set_edge_action_and_osm_tags() -> None:
    options = formats.write_options(
        FORMAT, {"action": "NavigateToPose", "action_type": "nav2_msgs/NavigateToPose", "osm": "true", "pointset": "no"}
    )
    served, context = write(Layers({NETWORK: from_elsewhere()}, DATUM), options=options)
    top = yaml.safe_load(served)
    assert (top["name"], top["pointset"]) == ("no", "no")
    edge = top["nodes"][0]["node"]["edges"][0]
    assert (edge["action"], edge["action_type"]) == ("NavigateToPose", "nav2_msgs/NavigateToPose")
    assert edge["properties"]["osm"] == {"way": 1}
    assert context.dropped == []
    back = network(read(served)[0])
    assert back.properties[back.index()["n10"]]["osm"] == {"tags": {"a": "b"}}


def test_geographic_network_requires_datum() -> None:
    with pytest.raises(MissingDatum):
        write(Layers({NETWORK: from_elsewhere()}))


def test_levels_are_merged_at_their_elevation_and_reported() -> None:
    def level(x: float, z: float | None = None) -> Features:
        place = shapely.Point(x, 0) if z is None else shapely.Point(x, 0, z)
        edge = {"kind": "edge", "source": "A", "target": "B"}
        rows = [("A", place, {"kind": "node"}), ("B", shapely.Point(x, 5), {"kind": "node"})]
        return features([*rows, ("A_B", shapely.LineString([(x, 0), (x, 5)]), edge)], "local")

    upper = PartKey("topology", "first", "network")
    levels = (Level(), Level("first", 3.5))
    served, context = write(Layers({NETWORK: level(0.0), upper: level(10.0, 4.0)}, None, levels))
    nodes = {n["node"]["name"]: n["node"] for n in yaml.safe_load(served)["nodes"]}
    at = {name: tuple(node["pose"]["position"].values()) for name, node in nodes.items()}
    assert sorted(at.values()) == [(0.0, 0.0, 0.0), (0.0, 5.0, 0.0), (10.0, 0.0, 4.0), (10.0, 5.0, 3.5)]
    by_place = {place: name for name, place in at.items()}
    edges = {(name, e["node"]) for name, node in nodes.items() for e in node["edges"]}
    assert edges == {
        (by_place[(0.0, 0.0, 0.0)], by_place[(0.0, 5.0, 0.0)]),
        (by_place[(10.0, 0.0, 4.0)], by_place[(10.0, 5.0, 3.5)]),
    }
    assert [(d.subject, d.count) for d in context.dropped] == [("levels of nodes and edges", 3)]
    assert "several networks" in warnings(context)
    only, context = write(Layers({upper: level(10.0)}, None, levels))
    assert yaml.safe_load(only)["nodes"][0]["node"]["pose"]["position"]["z"] == 3.5
    assert context.dropped == []


def test_invalid_last_updated_is_replaced_with_warning() -> None:
    document = yaml.safe_load(two("A"))
    for value in (0, "yesterday", None, 20220623):
        document["meta"]["last_updated"] = value
        served, context = again(read(yaml.safe_dump(document))[0])
        assert yaml.safe_load(served)["meta"]["last_updated"] == EPOCH
        assert ("not a time" in warnings(context)) == (value is not None)


@pytest.mark.parametrize("time", ["2022-06-23_13-10-11", "23-06-2026_13-10-11"])
def test_last_updated_is_kept(time: str) -> None:
    """Day first since topological_navigation of 2026."""
    document = yaml.safe_load(two("A"))
    document["meta"]["last_updated"] = time
    served, context = again(read(yaml.safe_dump(document))[0])
    assert yaml.safe_load(served)["meta"]["last_updated"] == time
    assert "not a time" not in warnings(context)


def test_unknown_members_round_trip_in_place() -> None:
    document = yaml.safe_load(two("A"))
    document["definitions"] = {"default_bt": "<root>\n  <a b='c'/>\n</root>\n", "zz": [[1, [2]], {}, []]}
    document["actions"] = {"navigate_to_pose": {"composable": False}}
    document["meta"]["origin"] = {"latitude": 1.5, "longitude": 2, "altitude": 0.0}
    entry = document["nodes"][0]
    entry |= {"extra": 1, "more": [None], "zone": {"a": True}}
    entry["meta"] |= {"sub": "x", "node": "other"}
    entry["node"] |= {"nav_frame": "topo", "edges_seen": 5, "zeta": "~"}
    entry["node"]["pose"] |= {"header": {"seq": 1}}
    entry["node"]["pose"]["position"]["accuracy"] = 0.1
    entry["node"]["edges"][0] |= {"action": None, "weight": 1e-09, "b": False}
    served = yaml.safe_load(again(read(yaml.safe_dump(document))[0])[0])
    document["transformation"] = TRANSFORMATION
    document["nodes"][1]["node"]["parent_frame"] = "map"
    assert served == document


def test_transformation_moves_nodes_in_child_frame() -> None:
    document = yaml.safe_load(two("A"))
    half = math.sqrt(0.5)
    document["transformation"] = {
        "child": "topo_map",
        "parent": "map",
        "rotation": {"w": half, "x": 0.0, "y": 0.0, "z": half},  # a quarter turn to the left
        "translation": {"x": 100.0, "y": 0.0, "z": 1.0},
    }
    document["nodes"][0]["node"]["parent_frame"] = "topo_map"
    document["nodes"][1]["node"]["parent_frame"] = "map"
    layers, context = read(yaml.safe_dump(document))
    part = network(layers)
    assert part.geometry[0].x == pytest.approx(98.0)
    assert part.geometry[0].y == pytest.approx(1.0)
    assert part.geometry[0].z == pytest.approx(1.0)
    assert part.properties[0]["orientation"] == pytest.approx([0.0, 0.0, half, half])
    assert part.geometry[1].coords[:] == [(5.0, 2.0)]
    assert "topo_map" in warnings(context)
    served = yaml.safe_load(again(layers)[0])
    for before, after in zip(document["nodes"], served["nodes"], strict=True):
        for key in ("position", "orientation"):
            assert after["node"]["pose"][key] == pytest.approx(before["node"]["pose"][key], abs=1e-9)


@pytest.mark.parametrize("frame_key", ["child", "topo_frame_id"])
def test_levels_with_different_child_frames_keep_their_places(frame_key: str) -> None:
    """A file has one transformation: nodes in the child frame of another one are moved to a frame of it."""
    parts = {}
    for level, child, shift, names in (("L1", "one", 100.0, "AB"), ("L2", "two", 500.0, "CD")):
        document = yaml.safe_load(two(*names))
        document["transformation"] = {frame_key: child, "parent": "map", "rotation": {"w": 1.0}}
        document["transformation"]["translation"] = {"x": shift, "y": 0.0, "z": 0.0}
        for entry in document["nodes"]:
            entry["node"]["parent_frame"] = child
        parts.update(read(yaml.safe_dump(document), level=level)[0].parts)
    served, context = write(Layers(parts))
    nodes = {entry["node"]["name"]: entry["node"] for entry in yaml.safe_load(served)["nodes"]}
    other = ("map", 0.0) if frame_key == "child" else ("one", -100.0)  # the newest localisation has one frame for all
    assert {name: node["parent_frame"] for name, node in nodes.items()} == {
        "A": "one", "B": "one", "C": other[0], "D": other[0],
    }  # fmt: skip
    assert nodes["A"]["pose"]["position"]["x"] == 1.0
    assert nodes["C"]["pose"]["position"]["x"] == 501.0 + other[1]
    assert "2 nodes are in the frame of another transformation" in warnings(context)
    part = network(read(served)[0])
    at = {i: g.x for i, g in zip(part.ids, part.geometry, strict=True) if g.geom_type == "Point"}
    assert at == {"A": 101.0, "B": 105.0, "C": 501.0, "D": 505.0}


NEWEST_FRAMES = [
    {"nav_frame": "${transformation.topo_frame_id}"},
    {"nav_frame": "farm"},
    {"parent_frame": "farm"},
    {},
]


@pytest.mark.parametrize("frames", NEWEST_FRAMES, ids=str)
def test_newest_transformation_moves_nodes(frames: dict[str, str]) -> None:
    """topological_navigation 47595a188d: topo_frame_id replaces child, and nav_frame parent_frame."""
    document = yaml.safe_load(two("A"))
    rotation = {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}
    translation = {"x": 100.0, "y": 0.0, "z": 0.0}
    document["transformation"] = {"topo_frame_id": "farm", "parent": "map"}
    document["transformation"] |= {"rotation": rotation, "translation": translation}
    first, second = (entry["node"] for entry in document["nodes"])
    first.pop("parent_frame", None)
    first |= frames
    second["parent_frame"] = "map"
    layers, context = read(yaml.safe_dump(document))
    x = first["pose"]["position"]["x"]
    part = network(layers)
    assert part.geometry[0].x == pytest.approx(x + 100.0)
    assert part.geometry[1].x == pytest.approx(second["pose"]["position"]["x"])
    assert "1 nodes are in the frame 'farm'" in warnings(context)
    assert "unknown" not in warnings(context)
    served, _ = again(layers)
    assert yaml.safe_load(served)["nodes"] == document["nodes"]
    found = [p for p in formats.check(FORMAT, {"a.tmap2.yaml": served}) if p.where == "nodes[0].node"]
    assert found == []


def test_new_nodes_are_in_frame_of_newest_network() -> None:
    """The newest localisation takes all nodes to be in topo_frame_id."""
    document = yaml.safe_load(two("A"))
    half = math.sqrt(0.5)
    rotation = {"w": half, "x": 0.0, "y": 0.0, "z": half}  # a quarter turn to the left
    document["transformation"] = {"topo_frame_id": "farm", "parent": "map", "rotation": rotation}
    document["transformation"]["translation"] = {"x": 100.0, "y": 0.0, "z": 0.0}
    rows: list[Any] = [("plain", shapely.Point(100.0, 7.0), {"kind": "node"})]
    rows += [("turned", shapely.Point(100.0, 8.0), {"kind": "node", "orientation": [0.0, 0.0, half, half]})]
    layers, _ = read(yaml.safe_dump(document))
    new = {PartKey("topology", "ground", "other"): features(rows, "local")}
    served, _ = write(Layers({NETWORK: network(layers), **new}))
    nodes = {entry["node"]["name"]: entry["node"] for entry in yaml.safe_load(served)["nodes"]}
    for name, x, z, w in (("plain", 7.0, -half, half), ("turned", 8.0, 0.0, 1.0)):
        assert nodes[name]["parent_frame"] == "farm"
        assert nodes[name]["pose"]["position"] == pytest.approx({"x": x, "y": 0.0, "z": 0.0}, abs=1e-9)
        assert nodes[name]["pose"]["orientation"] == pytest.approx({"w": w, "x": 0.0, "y": 0.0, "z": z}, abs=1e-9)
    back = network(read(served)[0])
    assert back.geometry[back.index()["plain"]].coords[0][:2] == pytest.approx((100.0, 7.0))


# --- determinism and round trips -------------------------------------------------------------------------------------


def test_written_bytes_are_independent_of_item_order() -> None:
    for path in (SAMPLES / "orchard.tmap2.yaml", OLD):
        part = network(read(path.read_bytes(), path.name)[0])
        served, _ = write(Layers({NETWORK: part}))
        order = list(range(len(part)))
        random.Random(4).shuffle(order)
        assert write(Layers({NETWORK: part.select(order)}))[0] == served


def test_duplicate_edge_ids_keep_their_order() -> None:
    document = yaml.safe_load(two("B", "A"))
    document["nodes"][0]["node"]["edges"] = [
        {"edge_id": "gg", "node": "A", "action": "x"},
        {"edge_id": "f", "node": "A", "action": "x"},
    ]
    document["nodes"][1]["node"]["edges"] = [{"edge_id": "f", "node": "B", "action": "x"}]
    served, _ = again(read(yaml.safe_dump(document))[0])
    assert [e["edge_id"] for e in yaml.safe_load(served)["nodes"][1]["node"]["edges"]] == ["f", "gg"]
    assert again(read(served)[0])[0] == served


def test_pyyaml_reads_small_and_large_numbers() -> None:
    rows = [("A", shapely.Point(1e-9, 9999999.123456789), {"kind": "node", "orientation": [1e-20, 0.0, 1.5e-7, 1.0]})]
    served, _ = write(Layers({NETWORK: features(rows, "local")}))
    pose = yaml.safe_load(served)["nodes"][0]["node"]["pose"]
    assert pose["position"] == {"x": 1e-09, "y": 9999999.123456789, "z": 0.0}
    assert pose["orientation"] == {"w": 1.0, "x": 1e-20, "y": 0.0, "z": 1.5e-7}


names = st.text(st.characters(exclude_categories=["Cs", "Cc", "Zl", "Zp"]), min_size=1, max_size=8)
scalars = st.none() | st.booleans() | st.integers(-(2**63), 2**63 - 1) | names | st.floats(-1e6, 1e6)
nested = st.recursive(scalars, lambda v: st.lists(v, max_size=3) | st.dictionaries(names, v, max_size=3), max_leaves=6)
metres = st.floats(-1e5, 1e5).map(lambda v: round(v, 9) + 0.0)
extra_members = st.dictionaries(
    names.filter(lambda k: k not in ("name", "edges", "pose", "properties")), nested, max_size=3
)


@st.composite
def networks(draw: st.DrawFn) -> dict[str, Any]:
    called = draw(st.lists(names, min_size=1, max_size=5, unique=True))
    nodes = []
    for name in called:
        edges = [
            {
                **draw(extra_members),
                "edge_id": draw(names),
                "node": draw(st.sampled_from(called) | names),
                "action": draw(names),
            }
            for _ in range(draw(st.integers(0, 3)))
        ]
        position = {axis: draw(metres) for axis in "xyz"}
        orientation = {axis: draw(st.floats(-1, 1)) for axis in "wxyz"}
        properties = draw(st.dictionaries(names, nested, max_size=2))
        node = {
            **draw(extra_members),
            "name": name,
            "edges": edges,
            "pose": {"position": position, "orientation": orientation},
        }
        node |= {"parent_frame": "map", "properties": properties}
        nodes.append({"meta": {"map": draw(names), "node": name, "pointset": "p"}, "node": node})
    top = draw(st.dictionaries(names.filter(lambda k: k not in ("nodes", "transformation")), nested, max_size=2))
    fixed = {"meta": {"last_updated": "2024-05-01_08-30-00"}, "metric_map": "m", "name": "p", "pointset": "p"}
    return {**top, **fixed, "transformation": TRANSFORMATION, "nodes": nodes}


def plain(top: dict[str, Any]) -> dict[str, Any]:
    """Sort nodes and edges."""
    for entry in top["nodes"]:
        entry["node"]["edges"].sort(key=lambda edge: json.dumps(edge, sort_keys=True))
    top["nodes"].sort(key=lambda entry: entry["node"]["name"])
    return top


@given(networks())
def test_any_network_round_trips(top: dict[str, Any]) -> None:
    text = yaml.safe_dump(top, allow_unicode=True)
    layers, _ = read(text)
    served, context = again(layers)
    assert context.dropped == []
    assert plain(yaml.safe_load(served)) == plain(json.loads(json.dumps(top)))
    assert again(read(served)[0])[0] == served


# --- bad input -------------------------------------------------------------------------------------------------------


def broken(change: Callable[[dict[str, Any]], Any]) -> str:
    document: dict[str, Any] = yaml.safe_load(two("A"))
    change(document)
    return yaml.safe_dump(document)


@pytest.mark.parametrize(
    ("change", "where"),
    [
        (lambda t: t.pop("nodes"), "nodes"),
        (lambda t: t.update(nodes={"a": 1}), "nodes"),
        (lambda t: t["nodes"].append("x"), "nodes[2]"),
        (lambda t: t["nodes"][1].pop("node"), "nodes[1]"),
        (lambda t: t["nodes"][1].update(meta=[1]), "nodes[1].meta"),
        (lambda t: t["nodes"][0]["node"].update(edges="x"), "nodes[0].node.edges"),
        (lambda t: t["nodes"][0]["node"].update(edges=[1]), "nodes[0].node.edges"),
        (lambda t: t["nodes"][0]["node"].pop("pose"), "A.pose"),
        (lambda t: t["nodes"][0]["node"].update(pose=[1, 2]), "A.pose"),
        (lambda t: t["nodes"][0]["node"]["pose"].pop("position"), "A.pose"),
        (lambda t: t["nodes"][0]["node"]["pose"]["position"].pop("y"), "A.pose"),
        (lambda t: t["nodes"][0]["node"]["pose"]["position"].update(y="x"), "A.pose.position"),
        (lambda t: t["nodes"][0]["node"]["pose"]["position"].update(y=True), "A.pose.position"),
        (lambda t: t["nodes"][0]["node"]["pose"]["position"].update(y=None), "A.pose.position"),
        (lambda t: t["nodes"][0]["node"]["pose"]["position"].update(y=[1]), "A.pose.position"),
        (lambda t: t["nodes"][0]["node"]["pose"]["position"].update(y=1e300), "nodes[0].node.pose.position.y"),
        (lambda t: t["nodes"][0]["node"]["pose"]["orientation"].pop("w"), "A.pose"),
        (lambda t: t["nodes"][0]["node"]["pose"]["orientation"].update(w="up"), "A.pose.orientation"),
        (lambda t: t.update(transformation={"child": "c", "rotation": {"w": 0}}), "transformation.rotation"),
        (lambda t: t.update(transformation={"child": "c", "translation": {"x": "a"}}), "transformation.translation.x"),
    ],
)  # fmt: skip
def test_invalid_file_raises_unreadable_file_with_location(change: Callable[[dict[str, Any]], Any], where: str) -> None:
    with pytest.raises(UnreadableFile) as caught:
        read(broken(change))
    assert caught.value.problems[0].where == where
    assert caught.value.problems[0].file == "network.tmap2.yaml"


@pytest.mark.parametrize("value", [".nan", ".inf", "1.0e+999"])
def test_non_finite_positions_raise_unreadable_file_with_line(value: str) -> None:
    text = two("A").replace("x: 5.0", f"x: {value}")
    with pytest.raises(UnreadableFile) as caught:
        read(text)
    assert caught.value.problems[0].line == text[: text.index(f"x: {value}")].count("\n") + 1


@pytest.mark.parametrize(
    "data", [b"", b"nodes", b"[]", b"- 1", b"nodes: [", b"\x00\x01", b"a: *b", b"nodes: [{node: *x}]"]
)
def test_other_bytes_are_rejected_or_empty(data: bytes) -> None:
    if data == b"[]":
        assert len(network(read(data)[0])) == 0
        return
    with pytest.raises(BadUpload):
        read(data)


def test_truncated_and_mutated_files_are_read_or_rejected() -> None:
    data = (SAMPLES / "orchard.tmap2.yaml").read_bytes()
    dice = random.Random(11)
    for k in range(300):
        variant = bytearray(data[: dice.randrange(len(data))] if k % 3 == 0 else data)
        for _ in range(dice.randrange(4)):
            if variant:
                variant[dice.randrange(len(variant))] = dice.randrange(256)
        try:
            layers, _ = read(bytes(variant))
        except BadUpload:
            continue
        if layers.parts:
            yaml.safe_load(again(layers)[0])


def test_limits_are_enforced() -> None:
    data = (SAMPLES / "orchard.tmap2.yaml").read_bytes()
    with pytest.raises(BadUpload):
        read(data, limits=Limits(features=3))
    with pytest.raises(BadUpload):
        read(data, limits=Limits(yaml_nodes=20))


def test_unwanted_layers_are_not_read() -> None:
    assert read(b"not yaml: [", requested_layers=frozenset({"location"}))[0].parts == {}


@pytest.mark.parametrize(
    ("name", "data", "is_one"),
    [
        ("x.yaml", b"metric_map: a\nname: b\nnodes: []\n", True),
        ("x.yml", b"verts: {}\nname: b\nnodes: []\npointset: p\n", True),
        ("x.yaml", b"# c\n- meta:\n    map: m\n  node:\n    name: a\n", False),
        ("x.tmap2", b"nodes: []", True),
        ("map.yaml", b"image: map.pgm\nresolution: 0.05\norigin: [0, 0, 0]\n", False),
        ("datum.yaml", b"datum_latitude: 1\ndatum_longitude: 2\n", False),
        ("x.yaml", b"graph-name: a\nnodes: []\n", False),
        ("x.kml", b"metric_map: a\nnodes: []\n", False),
    ],
)
def test_detect_recognises_networks(name: str, data: bytes, is_one: bool) -> None:
    assert FORMAT.detect(name, data) is is_one

"""lif: real layouts round-trip, levels match facts, members that all vehicles share are canonical."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

from app import formats
from app.convert.files import offline
from app.errors import CannotConvert, MissingDatum, TooLarge, UnreadableFile
from app.formats import FileGroup, ReadContext, WriteContext, get_format
from app.formats.lif.writing import WriteOptions
from app.limits import Limits
from app.model.features import Features, features
from app.model.frame import Datum, Level
from app.model.layers import Layers, PartKey
from app.upload_reader import UploadHints

FORMAT = get_format("lif")
SAMPLES = Path(__file__).resolve().parents[1] / "samples" / "lif"
FACTS: dict[str, Any] = json.loads((SAMPLES / "facts.json").read_text())
NETWORK = PartKey("topology", "ground", "network")
Same = Callable[[str, dict[str, bytes], dict[str, bytes]], list[str]]


def read(data: Any, **context: Any) -> tuple[Layers, ReadContext]:
    content = data if isinstance(data, bytes) else json.dumps(data).encode()
    read_context = ReadContext(main="layout.lif.json", **context)
    return formats.read(FileGroup(FORMAT, "layout.lif.json", {"layout.lif.json": content}), read_context), read_context


def write(part: Features | Layers, **context: Any) -> tuple[bytes, WriteContext]:
    write_context = WriteContext(**context)
    layers = part if isinstance(part, Layers) else Layers({NETWORK: part})
    files = formats.write(FORMAT, layers, write_context)
    assert list(files) == ["layout.lif.json"]
    return files["layout.lif.json"], write_context


def warnings(context: ReadContext | WriteContext) -> str:
    return "\n".join(p.problem for p in context.warnings)


def item(layers: Layers, i: str, layer: Any = "topology") -> dict[str, Any]:
    matches = [
        p for part in layers.vector(layer).values() for k, p in zip(part.ids, part.properties, strict=True) if k == i
    ]
    assert len(matches) == 1, i
    return dict(matches[0])


def check(data: bytes) -> dict[str, Any]:
    """Check the required members of LIF 1.0, and that references are valid."""
    top: dict[str, Any] = json.loads(data)
    meta = top["metaInformation"]
    assert all(isinstance(meta[w], str) for w in ("projectIdentification", "creator", "exportTimestamp", "lifVersion"))
    nodes: list[str] = []
    for layout in top["layouts"]:
        assert isinstance(layout["layoutId"], str)
        for node in layout["nodes"]:
            nodes.append(node["nodeId"])
            assert all(isinstance(node["nodePosition"][w], float) for w in "xy")
            assert node["vehicleTypeNodeProperties"]
            for entry in node["vehicleTypeNodeProperties"]:
                assert isinstance(entry["vehicleTypeId"], str)
    assert len(set(nodes)) == len(nodes)
    for edge in (e for layout in top["layouts"] for e in layout["edges"]):
        assert {edge["startNodeId"], edge["endNodeId"]} <= set(nodes)
        assert edge["vehicleTypeEdgeProperties"]
        for entry in edge["vehicleTypeEdgeProperties"]:
            assert isinstance(entry["vehicleTypeId"], str)
            assert isinstance(entry["rotationAllowed"], bool)
            line = entry.get("trajectory")
            if line:
                assert len(line["knotVector"]) == len(line["controlPoints"]) + line["degree"] + 1
    return top


# --- real files ------------------------------------------------------------------------------------------------------


def real(shared: Path) -> list[Path]:
    return sorted((shared / "data" / "lif").rglob("*.json"))


def test_real_files_round_trip(shared: Path, same: Same, facts_json: dict[str, Any]) -> None:
    assert len(real(shared)) == sum(f.get("kind") == "lif" for f in facts_json.values()) == 9
    for path in real(shared):
        data = path.read_bytes()
        assert formats.detect(path.name, data) is FORMAT, path
        layers, context = read(data)
        served, write_context = write(layers)
        assert same("lif", {path.name: data}, {"layout.lif.json": served}) == [], path
        assert (write_context.dropped, write_context.template, [w for w in write_context.warnings if not w.level]) == (
            [],
            [],
            [],
        )
        assert json.loads(served)["metaInformation"] == json.loads(data)["metaInformation"]
        assert write(read(served)[0])[0] == served
        assert ("is a draft" in warnings(context)) == ("2_0" in str(path))
        converted = offline({path.name: data}, "lif").files["layout.lif.json"]
        assert same("lif", {path.name: data}, {"layout.lif.json": converted}) == [], path


def test_layers_match_facts_of_real_files(shared: Path, facts_json: dict[str, Any]) -> None:
    for path in real(shared):
        fact = facts_json[str(path.relative_to(shared / "data"))]["facts"]
        layers, _ = read(path.read_bytes())
        for layout in fact["layouts"]:
            level = layout["layoutLevelId"] or "ground"
            kinds = [p["kind"] for part in layers.vector("topology", level).values() for p in part.properties]
            assert kinds.count("node") == layout["nodes"]
            assert kinds.count("edge") == layout["edges"]
            assert sum(len(part) for part in layers.vector("objects", level).values()) == layout["stations"]


# --- our sample ------------------------------------------------------------------------------------------------------


def test_sample_matches_facts() -> None:
    fact = FACTS["plant.lif.json"]
    layers, context = read((SAMPLES / "plant.lif.json").read_bytes())
    for kind, word, layer in (
        ("node", "nodes", "topology"),
        ("edge", "edges", "topology"),
        ("station", "stations", "objects"),
    ):
        for level, n in fact[word].items():
            parts = layers.vector(layer, level).values()  # type: ignore[arg-type]
            assert sum(p["kind"] == kind for part in parts for p in part.properties) == n
    rows = [(i, p, g) for part in layers.vector("topology").values()
            for i, p, g in zip(part.ids, part.properties, part.geometry, strict=True)]  # fmt: skip
    assert {i: p["speed_limit"] for i, p, _ in rows if "speed_limit" in p} == fact["speed_limits"]
    assert [i for i, _, g in rows if shapely.get_num_coordinates(g) > 2] == fact["bent"]
    assert [i for i, p, _ in rows if "orientation" in p] == fact["turned"]
    points = [g for _, p, g in rows if p["kind"] == "node"]
    assert shapely.total_bounds(points).tolist() == [*fact["bounds"][0], *fact["bounds"][1]]
    assert sum(len(p["lif"].get("dangling", ())) for _, p, _ in rows) == fact["dangling"]
    assert "leads to the unknown node 'gone'" in warnings(context)
    assert "radians" in warnings(context)
    assert {key.level for key in layers.parts} == {"0", "1"}


def test_sample_matches_expected_content(same: Same) -> None:
    data = (SAMPLES / "plant.lif.json").read_bytes()
    layers, _ = read(data)
    dock = item(layers, "N2")
    assert dock["name"] == "Dock"
    assert dock["orientation"] == pytest.approx([0, 0, math.sin(1.57 / 2), math.cos(1.57 / 2)])
    assert "orientation" not in item(layers, "N1")
    main = item(layers, "E1#2")
    assert (main["source"], main["target"], main["name"]) == ("N1", "N2", "Main")
    assert main["lif"]["id"] == "E1"
    assert item(layers, "lift")["target"] == "U1"
    press = item(layers, "S2", "objects")
    assert (press["kind"], press["name"]) == ("station", "Press")
    stations = layers.parts[PartKey("objects", "0", "lif")]
    assert isinstance(stations, Features)
    assert stations.geometry[0].equals(shapely.Point(11, -1))
    assert stations.geometry[1].is_empty
    served, context = write(layers)
    assert same("lif", {"a.json": data}, {"b.json": served}) == []
    assert (context.dropped, context.template, [w for w in context.warnings if not w.level]) == ([], [], [])
    top = json.loads(served)
    assert [layout["layoutId"] for layout in top["layouts"]] == ["Hall", "Upstairs", "Empty"]
    assert [n["nodeId"] for n in top["layouts"][0]["nodes"]] == ["N2", "N1", "E1"]
    assert [e["edgeId"] for e in top["layouts"][0]["edges"]] == ["E1", "E0", "curve", "lift", "nowhere"]


def test_written_order_is_independent_of_stored_order() -> None:
    layers, _ = read((SAMPLES / "plant.lif.json").read_bytes())
    turned = {
        key: part.select(list(reversed(range(len(part)))))
        for key, part in layers.parts.items()
        if isinstance(part, Features)
    }
    turned = {
        k: Features(
            v.ids, v.geometry, tuple(dict(sorted(p.items(), reverse=True)) for p in v.properties), v.local, v.document
        )
        for k, v in turned.items()
    }
    assert write(Layers(dict(reversed(turned.items())), None, layers.levels))[0] == write(layers)[0]


def test_edits_are_written() -> None:
    layers, _ = read((SAMPLES / "plant.lif.json").read_bytes())
    key = PartKey("topology", "0", "network")
    part = layers.parts[key]
    assert isinstance(part, Features)
    properties = [dict(p) for p in part.properties]
    place = part.index()
    properties[place["N2"]] |= {"name": "Ramp", "orientation": [0.0, 0.0, 1.0, 0.0]}
    properties[place["E1#2"]]["speed_limit"] = 0.75
    geometry = part.geometry.copy()
    geometry[place["N2"]] = shapely.Point(12, 1)
    added = features([("new", shapely.Point(3, 3), {"kind": "node"})], "local")
    changed = Features(
        (*part.ids, "new"), np.concatenate([geometry, added.geometry]), (*properties, *added.properties),
        np.concatenate([part.local, added.local]), part.document,
    )  # fmt: skip
    served, context = write(Layers({**layers.parts, key: changed}, None, layers.levels))
    hall = json.loads(served)["layouts"][0]
    ramp = hall["nodes"][0]
    assert (ramp["nodeId"], ramp["nodeName"], ramp["nodePosition"]) == ("N2", "Ramp", {"x": 12.0, "y": 1.0})
    assert [e["theta"] for e in ramp["vehicleTypeNodeProperties"]] == pytest.approx([math.pi, math.pi])
    assert ramp["vehicleTypeNodeProperties"][0]["actions"]
    assert [e["maxSpeed"] for e in hall["edges"][0]["vehicleTypeEdgeProperties"]] == [0.75, 0.75]
    assert hall["nodes"][-1]["nodeId"] == "new"
    assert hall["nodes"][-1]["vehicleTypeNodeProperties"] == [{"vehicleTypeId": "any"}]
    assert [(t.subject, t.option) for t in context.template] == [("nodes: vehicle type", "vehicle_type")]


def test_options_set_missing_values() -> None:
    edge = {"kind": "edge", "source": "a", "target": "b"}
    rows: list[tuple[str, Any, dict[str, Any]]] = [
        ("a", shapely.Point(0, 0), {"kind": "node"}),
        ("b", shapely.Point(3, 0), {"kind": "node"}),
        ("e", shapely.LineString([(0, 0), (3, 0)]), edge),
    ]
    options = {
        "vehicle_type": "fork", "creator": "me", "project": "hall", "orientation_type": "GLOBAL",
        "vehicle_orientation": 1.5, "rotation_allowed": True, "layout_version": "7",
    }  # fmt: skip
    context = WriteContext(options=formats.write_options(FORMAT, options))
    layers = Layers({PartKey("topology", "ground", "network"): features(rows, "local")})
    top = json.loads(formats.write(FORMAT, layers, context)["layout.lif.json"])
    assert (top["metaInformation"]["creator"], top["metaInformation"]["projectIdentification"]) == ("me", "hall")
    (layout,) = top["layouts"]
    assert layout["layoutVersion"] == "7"
    assert layout["edges"][0]["vehicleTypeEdgeProperties"] == [
        {"vehicleTypeId": "fork", "vehicleOrientation": 1.5, "orientationType": "GLOBAL", "rotationAllowed": True}
    ]
    assert {t.option: t.value for t in context.template if t.option} == options


def test_drafts_keep_their_member_names(shared: Path) -> None:
    drafts = sorted((shared / "data" / "lif" / "vdma_lif_2_0_draft").glob("*.json"))
    types = []
    for path in drafts:
        layers, _ = read(path.read_bytes())
        key = PartKey("topology", "0", "network")
        part = layers.parts[key]
        assert isinstance(part, Features)
        edge = {"kind": "edge", "source": "new", "target": "N1"}
        rows: list[tuple[str, Any, dict[str, Any]]] = [
            ("new", shapely.Point(3, 3), {"kind": "node"}),
            ("e", shapely.LineString([(3, 3), (0, 0)]), edge),
        ]
        added = features(rows, "local")
        both = Features(
            (*part.ids, *added.ids), np.concatenate([part.geometry, added.geometry]),
            (*part.properties, *added.properties), np.concatenate([part.local, added.local]), part.document,
        )  # fmt: skip
        top = json.loads(write(Layers({**layers.parts, key: both}))[0])
        layout = (top["layouts"] if "layouts" in top else top["origins"][0]["layouts"])[0]
        types.append(layout["nodes"][-1]["mobileRobotTypeNodeProperties"])
        assert "mobileRobotTypeEdgeProperties" in layout["edges"][-1]
    assert types == [
        [{"mobileRobotTypeId": "any"}],
        [{"mobileRobotTypes": [{"manufacturer": "any", "seriesName": "any"}]}],
    ]


# --- from other formats ----------------------------------------------------------------------------------------------


def street(*names: str, **more: Any) -> Features:
    rows: list[tuple[str, Any, dict[str, Any]]] = [
        (i, shapely.Point(k, 0), {"kind": "node", "name": i}) for k, i in enumerate(names)
    ]
    for k in range(len(names) - 1):
        line = shapely.LineString([(k, 0), (k + 0.5, 1), (k + 1, 0)])
        rows.append((f"e{k}", line, {"kind": "edge", "source": names[k], "target": names[k + 1], **more}))
    return features(rows, "local")


def test_network_of_other_format_is_written() -> None:
    part = street("A", "B", speed_limit=2.5, action="row_traversal")
    up = PartKey("topology", "up", "network")
    layers = Layers({NETWORK: part, up: street("A", "C")}, None, (Level(), Level("up", 3.0)))
    served, context = write(layers, title="farm", options=WriteOptions(vehicle_type="robot"))
    top = check(served)
    assert [(v["layoutId"], v.get("layoutLevelId")) for v in top["layouts"]] == [("ground", None), ("up", "up")]
    assert [[n["nodeId"] for n in v["nodes"]] for v in top["layouts"]] == [["A", "B"], ["C", "A#2"]]
    entry = top["layouts"][0]["edges"][0]["vehicleTypeEdgeProperties"][0]
    assert entry["vehicleTypeId"] == "robot"
    assert entry["maxSpeed"] == 2.5
    assert entry["trajectory"]["controlPoints"][1] == {"x": 0.5, "y": 1.0}
    assert [(d.subject, d.count) for d in context.dropped] == [("attributes of edges", 1)]
    assert "a numeric suffix makes them unique" in warnings(context)
    back, _ = read(served)
    assert item(back, "e0")["speed_limit"] == 2.5
    line = back.parts[NETWORK]
    assert isinstance(line, Features)
    assert shapely.get_num_coordinates(line.geometry[2]) == 3
    assert write(back)[0] == served


def test_tmap2_round_trips_via_lif(shared: Path) -> None:
    farm = shared / "data" / "environment_template" / "riseholme_park_farm_vineyard" / "config" / "topological"
    data = (farm / "network.tmap2.yaml").read_bytes()
    lif_data = offline({"network.tmap2.yaml": data}, "lif").files["layout.lif.json"]
    top = check(lif_data)
    tmap2 = get_format("tmap2")
    group = FileGroup(tmap2, "n.tmap2.yaml", {"n.tmap2.yaml": data})
    part = formats.read(group, ReadContext(main="n.tmap2.yaml")).parts[NETWORK]
    assert isinstance(part, Features)
    nodes = {i: (g.x, g.y) for i, g in zip(part.ids, part.geometry, strict=True) if g.geom_type == "Point"}
    positions = {n["nodeId"]: (n["nodePosition"]["x"], n["nodePosition"]["y"]) for n in top["layouts"][0]["nodes"]}
    assert positions.keys() == nodes.keys()
    assert all(positions[i] == pytest.approx(at) for i, at in nodes.items())
    assert {(e["edgeId"], e["startNodeId"], e["endNodeId"]) for e in top["layouts"][0]["edges"]} == {
        (i, p["source"], p["target"]) for i, p in zip(part.ids, part.properties, strict=True) if p["kind"] == "edge"
    }
    assert offline({"layout.lif.json": lif_data}, "tmap2").files


def test_file_round_trips_via_geojson(same: Same) -> None:
    data = (SAMPLES / "plant.lif.json").read_bytes()
    layers, _ = read(data)
    geojson_data = formats.write(get_format("geojson"), layers, WriteContext())["map.geojson"]
    assert formats.detect("map.geojson", geojson_data) is get_format("geojson")
    context = ReadContext(main="map.geojson")
    again = formats.read(FileGroup(get_format("geojson"), "map.geojson", {"map.geojson": geojson_data}), context)
    assert same("lif", {"a.json": data}, {"b.json": write(again)[0]}) == []


def test_write_requires_nodes_and_a_datum_for_geographic_ones() -> None:
    part = features([("a", shapely.Point(-0.5, 53.0), {"kind": "node"})], "wgs84")
    with pytest.raises(MissingDatum):
        write(part)
    node = check(write(Layers({NETWORK: part}, Datum(53.0, -0.5)))[0])["layouts"][0]["nodes"][0]
    assert node["nodePosition"] == {"x": 0.0, "y": 0.0}
    with pytest.raises(CannotConvert, match="supply"):
        write(features([("e", shapely.Point(1, 1), {"kind": "edge"})], "local"))


# --- bad and doubtful files ------------------------------------------------------------------------------------------


def layout(nodes: Any = None, edges: Any = None, **more: Any) -> dict[str, Any]:
    base = [{"nodeId": i, "nodePosition": {"x": k, "y": 0}, "vehicleTypeNodeProperties": [{"vehicleTypeId": "t"}]}
            for k, i in enumerate("AB")]  # fmt: skip
    meta = {"projectIdentification": "p", "creator": "c", "exportTimestamp": "t", "lifVersion": "1.0.0"}
    one = {"layoutId": "L", "nodes": base + (nodes or []), "edges": edges or [], **more}
    return {"metaInformation": meta, "layouts": [one]}


AT = {"x": 1, "y": 2}


@pytest.mark.parametrize(
    ("data", "where", "reason"),
    [
        ([], "layouts", "array"),
        ({"layouts": 5}, "layouts", "array"),
        ({"layouts": [5]}, "layouts[0]", "object"),
        ({"layouts": [{}]}, "layouts[0].layoutId", "id"),
        ({"layouts": [{"layoutId": "a"}, {"layoutId": "a"}]}, "layouts[1].layoutId", "duplicate layout"),
        ({"layouts": [], "origins": [5]}, "origins[0]", "object"),
        (layout(layoutLevelId=5), "layouts[0].layoutLevelId", "string"),
        (layout(layoutLevelId="a\nb"), "layouts[0].layoutLevelId", "control"),
        (layout(stations={}), "layouts[0].stations", "array"),
        (layout([5]), "layouts[0].nodes[2]", "object"),
        (layout([{"nodePosition": AT}]), "layouts[0].nodes[2].nodeId", "id"),
        (layout([{"nodeId": "", "nodePosition": AT}]), "layouts[0].nodes[2].nodeId", "characters"),
        (layout([{"nodeId": "C"}]), "layouts[0].nodes[2].nodePosition", "x and y"),
        (layout([{"nodeId": "C", "nodePosition": {"x": "1", "y": 0}}]), "layouts[0].nodes[2].nodePosition.x", "number"),
        (layout(edges=[{"edgeId": None}]), "layouts[0].edges[0].edgeId", "id"),
        (
            layout(stations=[{"stationId": "S", "stationPosition": 5}]),
            "layouts[0].stations[0].stationPosition",
            "x and",
        ),
    ],
)
def test_invalid_file_raises_unreadable_file_with_location(data: Any, where: str, reason: str) -> None:
    with pytest.raises(UnreadableFile) as caught:
        read(data)
    problem = caught.value.problems[0]
    assert problem.where == where
    assert reason in problem.problem
    assert problem.file == "layout.lif.json"


def test_limits_are_enforced() -> None:
    with pytest.raises(UnreadableFile, match="JSON") as caught:
        read(b'{"layouts": [\n}')
    assert caught.value.problems[0].line == 2
    with pytest.raises(UnreadableFile, match="deeper"):
        read(b'{"layouts":' + b"[" * 200 + b"]" * 200 + b"}")
    with pytest.raises(TooLarge):
        read(layout(), limits=Limits(features=1))
    with pytest.raises(UnreadableFile, match="finite"):
        read(layout([{"nodeId": "C", "nodePosition": {"x": 1e9, "y": 0}}]))


@pytest.mark.parametrize(
    ("data", "warning"),
    [
        (layout([{"nodeId": 7, "nodePosition": AT}]), "is not text"),
        (layout([{"nodeId": "A", "nodePosition": AT}]), "duplicate ids of"),
        (layout([{"nodeId": "C", "nodePosition": AT}]), "have no vehicle type"),
        (layout([{"nodeId": "C", "nodePosition": AT, "vehicleTypeNodeProperties": [5]}]), "have no vehicle type"),
        (layout(edges=[{"edgeId": "e", "startNodeId": "A", "endNodeId": "A"}]), "to itself"),
        (layout(edges=[{"edgeId": "e", "startNodeId": "A", "endNodeId": "X"}]), "unknown node"),
        (layout(edges=[{"edgeId": "e", "startNodeId": None, "endNodeId": ["X"]}]), "unknown node"),
        (
            layout(stations=[{"stationId": "S", "interactionNodeIds": ["X"]}]),
            "unknown interaction nodes of the station: X",
        ),
        (layout(stations=[{"stationId": "S"}]), "needs an array"),
        ({"layouts": layout()["layouts"]}, "read as version 1.0"),
        ({**layout(), "metaInformation": {"lifVersion": "3.1"}}, "is a draft"),
    ],
)
def test_doubtful_values_are_read_with_a_warning(data: dict[str, Any], warning: str, same: Same) -> None:
    layers, context = read(data)
    assert warning in warnings(context)
    served, _ = write(layers)
    assert write(read(served)[0])[0] == served
    if "unknown node" in warning or "itself" in warning:
        assert same("lif", {"a.json": json.dumps(data).encode()}, {"b.json": served}) == []


def test_layout_without_level_gets_requested_level() -> None:
    layers, _ = read(layout(), level="cellar")
    assert {k.level for k in layers.parts} == {"cellar"}
    assert "layoutLevelId" not in json.loads(write(layers)[0])["layouts"][0]
    lif_data = offline({"a.json": json.dumps(layout()).encode()}, "lif", hints=UploadHints("lif")).files[
        "layout.lif.json"
    ]
    assert check(lif_data)


def test_invalid_stored_source_properties_do_not_prevent_writing() -> None:
    for value in (5, "x", [1], {"a": 1}, None, [[1]], True, {"layoutId": 3}, [{"layoutId": "x", "head": 4}]):
        source_properties = dict.fromkeys(("id", "layout", "at", "item", "dangling"), value)
        words = ("vehicleTypeNodeProperties", "vehicleTypeEdgeProperties", "nodePosition", "trajectory", "nodeName")
        inner = {"item": dict.fromkeys(words, value), "dangling": [{"item": {"edgeId": "z"}, "layout": value}]}
        rows: list[tuple[str, Any, dict[str, Any]]] = [
            ("a", shapely.Point(0, 0), {"kind": "node", "name": value, "orientation": value, "lif": source_properties}),
            ("b", shapely.Point(1, 0), {"kind": "node", "orientation": [0, 0, 0, 1], "lif": inner}),
            (
                "e",
                shapely.Point(1, 0),
                {"kind": "edge", "source": "a", "target": "b", "speed_limit": value, "lif": source_properties},
            ),
            ("f", shapely.Point(1, 0), {"kind": "edge", "source": "b", "target": "a", "speed_limit": 1, "lif": inner}),
        ]
        stations = features(
            [("s", shapely.Point(1, 0), {"kind": "station", "name": value, "lif": source_properties})], "local"
        )
        document = {"lif": dict.fromkeys(("top", "layouts", "origins", "dangling"), value)}
        layers = Layers({NETWORK: features(rows, "local", document), PartKey("objects", "ground", "lif"): stations})
        top = json.loads(write(layers)[0])
        layouts = top.get("layouts", []) + [v for o in top.get("origins", []) for v in o["layouts"]]
        assert sum(len(v["nodes"]) for v in layouts) == 2


@pytest.mark.parametrize(
    ("data", "is_one"),
    [
        (json.dumps(layout()).encode(), True),
        (b"\xef\xbb\xbf " + json.dumps(layout()).encode(), True),
        (json.dumps({"a": layout()}).encode(), False),
        (b'{"metaInformation": {"lifVersion": 1}, "layouts": [', True),
        (b'{"metaInformation": 1, "layouts": [', False),
        (b'["metaInformation", "layouts"]', False),
    ],
)
def test_detect_recognises_lif(data: bytes, is_one: bool) -> None:
    assert FORMAT.detect("a.json", data) is is_one

"""nav2_route: real graphs round-trip, the loader's rules hold, numbers are stable, errors name their location."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
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
from app.limits import Limits
from app.model.features import Features, features
from app.model.frame import Datum, Level
from app.model.geodesy import local_frame
from app.model.layers import Layers, PartKey

FORMAT = get_format("nav2_route")
SAMPLES = Path(__file__).resolve().parents[1] / "samples" / "nav2_route"
FACTS: dict[str, Any] = json.loads((SAMPLES / "facts.json").read_text())
NETWORK = PartKey("topology", "ground", "network")
Same = Callable[[str, dict[str, bytes], dict[str, bytes]], list[str]]


def read(data: Any, **context: Any) -> tuple[Features, ReadContext]:
    content = data if isinstance(data, bytes) else json.dumps(data).encode()
    read_context = ReadContext(main="graph.geojson", **context)
    part = formats.read(FileGroup(FORMAT, "graph.geojson", {"graph.geojson": content}), read_context).parts[NETWORK]
    assert isinstance(part, Features)
    return part, read_context


def write(part: Features | Layers, **context: Any) -> tuple[bytes, WriteContext]:
    write_context = WriteContext(**context)
    layers = part if isinstance(part, Layers) else Layers({NETWORK: part})
    files = formats.write(FORMAT, layers, write_context)
    assert list(files) == ["graph.geojson"]
    return files["graph.geojson"], write_context


def warnings(context: ReadContext | WriteContext) -> str:
    return "\n".join(p.problem for p in context.warnings)


class Unsigned(int):
    """An integer as nlohmann's JSON stores one without a sign: getValue<float> throws."""


class RouteServer:
    """Loader with the rules of geojson_graph_file_loader.cpp, including its exceptions."""

    def __init__(self, data: bytes) -> None:
        top = json.loads(data)
        kinds = {"Point": 0, "LineString": 1, "MultiLineString": 1}
        by_kind: tuple[list[Any], list[Any]] = ([], [])
        for feature in top["features"]:
            kind = kinds.get(feature["geometry"]["type"])
            if kind is not None:
                by_kind[kind].append(feature)
        assert by_kind[0], "no nodes"
        assert by_kind[1], "no edges"
        self.nodes: dict[int, tuple[float, float]] = {}
        self.metadata: dict[tuple[str, int], dict[str, Any]] = {}
        for node in by_kind[0]:
            p = node["properties"]
            n = self.number(p["id"])
            assert n not in self.nodes, "two nodes with one id"
            x, y = node["geometry"]["coordinates"][:2]
            assert isinstance(p.get("frame", ""), str)
            self.nodes[n] = (float(x), float(y))
            self.both("node", n, p)
        self.edges: dict[int, tuple[int, int]] = {}
        for edge in by_kind[1]:
            p = edge["properties"]
            n, start, end = (self.number(p[w]) for w in ("id", "startid", "endid"))
            assert start in self.nodes, "Start id does not exist"
            assert end in self.nodes, "End id does not exist"
            assert n not in self.edges, "two edges with one id"
            assert isinstance(p.get("cost", 0.0), (int, float))
            assert isinstance(p.get("overridable", True), bool)
            self.edges[n] = (start, end)
            self.both("edge", n, p)

    @staticmethod
    def number(value: Any) -> int:
        assert isinstance(value, int), "id"
        assert 0 <= value < 2**32
        return value

    def both(self, kind: str, n: int, p: dict[str, Any]) -> None:
        self.metadata[kind, n] = self.read(p.get("metadata", {}))
        for operation in p.get("operations", {}).values():
            assert isinstance(operation["type"], str)
            assert operation["trigger"] in ("NODE", "ON_ENTER", "ON_EXIT")
            self.read(operation.get("metadata", {}))

    def read(self, metadata: dict[str, Any]) -> dict[str, Any]:
        for word, value in metadata.items():
            if isinstance(value, dict):
                self.read(value)
                continue
            for v in value if isinstance(value, list) else [value]:
                assert isinstance(v, (bool, int, float, str)), f"Failed to convert {word}"
            if word in ("speed_limit", "abs_speed_limit", "penalty", "abs_time_taken"):
                assert isinstance(value, float), f"bad_any_cast: {word}"
        return metadata


# --- real files ------------------------------------------------------------------------------------------------------


def real(shared: Path) -> list[Path]:
    return sorted((shared / "data" / "nav2_route_graph").rglob("*.geojson"))


def test_real_files_round_trip(shared: Path, same: Same, facts_json: dict[str, Any]) -> None:
    assert len(real(shared)) == sum(f.get("kind") == "nav2_route_graph" for f in facts_json.values()) == 4
    for path in real(shared):
        data = path.read_bytes()
        assert formats.detect(path.name, data) is FORMAT, path
        served, context = write(read(data)[0])
        assert same("nav2_route", {path.name: data}, {"graph.geojson": served}) == [], path
        assert (context.dropped, context.template, context.warnings) == ([], [], [])
        assert write(read(served)[0])[0] == served
        before, after = RouteServer(data), RouteServer(served)
        assert (before.edges, before.metadata) == (after.edges, after.metadata)
        assert before.nodes.keys() == after.nodes.keys()
        assert all(after.nodes[n] == pytest.approx(at, abs=1e-9) for n, at in before.nodes.items())
        for word in ("name", "crs", "date_generated"):
            assert json.loads(served).get(word) == json.loads(data).get(word)


def test_real_files_match_counted_facts(shared: Path, facts_json: dict[str, Any]) -> None:
    for path in real(shared):
        fact = facts_json[str(path.relative_to(shared / "data"))]["facts"]
        part, _ = read(path.read_bytes())
        nodes = [k for k, p in enumerate(part.properties) if p["kind"] == "node"]
        pairs = {(p["source"], p["target"]) for p in part.properties if p["kind"] == "edge"}
        assert len(nodes) == fact["nodes"]
        assert len(part) - len(nodes) == fact["edges"]
        assert sum((b, a) not in pairs for a, b in pairs) == fact["edges_without_reverse"]
        bounds = shapely.total_bounds(part.geometry[nodes])
        assert bounds == pytest.approx([*fact["bounds"][0], *fact["bounds"][1]], abs=1e-6)
        assert bool(part.local.all())


# --- our sample ------------------------------------------------------------------------------------------------------


def test_sample_matches_expected_facts() -> None:
    fact = FACTS["hall.geojson"]
    part, context = read((SAMPLES / "hall.geojson").read_bytes())
    kinds = [p["kind"] for p in part.properties]
    pairs = [(p["source"], p["target"]) for p in part.properties if p["kind"] == "edge"]
    assert (kinds.count("node"), kinds.count("edge")) == (fact["nodes"], fact["edges"])
    assert sum(p[::-1] not in pairs for p in pairs) == fact["one_way"]
    assert shapely.total_bounds(part.geometry).tolist() == [*fact["bounds"][0], *fact["bounds"][1]]
    assert sum(shapely.get_num_coordinates(part.geometry) > 2) == fact["bent"]
    assert f"{fact['integers']} metadata values" in warnings(context)
    assert "neither a point nor a line" in warnings(context)


def test_sample_is_written_as_expected(same: Same) -> None:
    data = (SAMPLES / "hall.geojson").read_bytes()
    part, _ = read(data)
    assert part.ids == ("0", "1", "70000", "7", "1#2", "8", "9")
    gate, _, bay, lane, back, gap, blank = part.properties
    assert gate["name"] == "Gate"
    assert gate["nav2_route"] == {"id": 0, "properties": {"frame": "map", "metadata": {"class": "door"}}}
    assert bay["name"] == "70000"
    assert part.geometry[2].z == 1.5
    assert (lane["source"], lane["target"], lane["speed_limit"]) == ("0", "1", 1)
    assert lane["nav2_route"]["members"] == {"id": "lane-a"}
    assert back["nav2_route"] == {"id": 1, "line": True}
    assert gap["nav2_route"]["geometry"]["coordinates"][1][0] == [4.5, 4.0]
    assert blank["nav2_route"] == {"id": 9}
    served, context = write(part)
    assert same("nav2_route", {"a.geojson": data}, {"b.geojson": served}) == []
    assert context.dropped == context.template == []
    assert "1 nodes have an id above 65535" in warnings(context)
    server = RouteServer(served)
    assert server.edges[1] == (1, 0)
    assert b'"speed_limit":85.0' in served
    assert b'"speed_limit":50.0' in served
    assert b'"abs_speed_limit":1.0' in served
    assert b'"aisle":14}' in served or b'"aisle":14,' in served  # what its reader takes for an integer stays one
    assert b'"door_id":54}' in served
    assert json.loads(served)["features"][-1]["geometry"]["type"] == "Polygon"
    shapes = {
        f["properties"].get("id"): f["geometry"] for f in json.loads(served)["features"] if "startid" in f["properties"]
    }
    assert shapes[1] == {"type": "LineString", "coordinates": [[4.5, 0.0], [2.0, 1.0], [0.0, 0.0]]}
    assert len(shapes[8]["coordinates"]) == 2


def test_geojson_export_is_not_detected_as_route_graph() -> None:
    data = (SAMPLES / "hall.geojson").read_bytes()
    geojson_data = offline({"hall.geojson": data}, "geojson").files["map.geojson"]
    assert formats.detect("map.geojson", geojson_data) is get_format("geojson")
    again = offline({"map.geojson": geojson_data}, "nav2_route").files["graph.geojson"]
    assert again == offline({"hall.geojson": data}, "nav2_route").files["graph.geojson"]


# --- numbers ---------------------------------------------------------------------------------------------------------


def street(names: list[str], *, oneway: bool = False, **more: Any) -> Features:
    """Build a chain of nodes, connected in both directions, or only forwards."""
    rows: list[tuple[str, Any, dict[str, Any]]] = [
        (i, shapely.Point(k, 0), {"kind": "node", "name": i}) for k, i in enumerate(names)
    ]
    for k in range(len(names) - 1):
        for a, b in ((k, k + 1),) if oneway else ((k, k + 1), (k + 1, k)):
            p = {"kind": "edge", "source": names[a], "target": names[b], **more}
            rows.append((f"{names[a]}_{names[b]}", shapely.LineString([(a, 0), (b, 0)]), p))
    return features(rows, "local")


def numbers(data: bytes) -> dict[str, int]:
    properties = [f["properties"] for f in json.loads(data)["features"]]
    return {p["metadata"]["name"]: p["id"] for p in properties if "startid" not in p and "metadata" in p}


def test_numbers_depend_on_own_id_only() -> None:
    names = [f"WayPoint{k}" for k in range(60)]
    first = numbers(write(street(names))[0])
    assert first == numbers(write(street(list(reversed(names))))[0])
    assert set(first) == set(names)
    assert max(first.values()) < 2**16
    more = numbers(write(street(["new", *names[:30], *names[31:]]))[0])
    changed = [n for n in names if n in more and more[n] != first[n]]
    assert len(changed) <= 1  # only one that had to make way for another
    server = RouteServer(write(street(names))[0])
    assert len(server.nodes.keys() | server.edges.keys()) == 60 + 118


def test_source_numbers_round_trip_and_are_not_reused() -> None:
    part, _ = read((SAMPLES / "hall.geojson").read_bytes())
    added = features(
        [
            ("Bay 3", shapely.Point(9, 9), {"kind": "node", "name": "Bay 3"}),
            ("12", shapely.Point(8, 9), {"kind": "node"}),
        ],
        "local",
    )
    both = Features(
        (*part.ids, *added.ids),
        np.concatenate([part.geometry, added.geometry]),
        (*part.properties, *added.properties),
        np.concatenate([part.local, added.local]),
        part.document,
    )
    server = RouteServer(write(both)[0])
    assert {0, 1, 70000, 12} < set(server.nodes)
    assert len(server.nodes) == 5
    assert set(server.edges) == {7, 1, 8, 9}


def test_duplicate_numbers_become_distinct() -> None:
    data = json.loads((SAMPLES / "hall.geojson").read_bytes())
    data["features"].append(
        {"type": "Feature", "properties": {"id": 1}, "geometry": {"type": "Point", "coordinates": [7, 7]}}
    )
    part, context = read(data)
    assert "share an id" in warnings(context)
    assert part.properties[part.ids.index("7")]["target"] == "1#2"  # the last one, as Nav2 does
    served, write_context = write(part)
    assert "confuse" in warnings(write_context)
    server = RouteServer(served)
    assert len(server.nodes) == 4
    _, end = server.edges[7]
    assert server.nodes[end] == (7.0, 7.0)


def test_ids_have_16_bit_while_enough_are_free() -> None:
    """Nav2's actions and services have ids of 16 bit; numbers of the source may be larger."""
    names = [f"n{k}" for k in range(33_000)]
    street_of_many = street(names, oneway=True)
    place = shapely.Point(-1, 0)
    large = features([("large", place, {"kind": "node", "nav2_route": {"id": 70_000}})], "local")
    both = Features(
        (*street_of_many.ids, *large.ids),
        np.concatenate([street_of_many.geometry, large.geometry]),
        (*street_of_many.properties, *large.properties),
        np.concatenate([street_of_many.local, large.local]),
        street_of_many.document,
    )
    served, _ = write(both)
    server = RouteServer(served)
    assert len(server.nodes) == 33_001
    assert len(server.edges) == 32_999
    assert [n for n in server.nodes if n >= 2**16] == [70_000]
    assert max(server.edges) < 2**16


def test_more_edges_than_16_bit_get_larger_ids_with_warning() -> None:
    rows: list[Any] = [(i, shapely.Point(k, 0), {"kind": "node"}) for k, i in enumerate("ab")]
    line = shapely.LineString([(0, 0), (1, 0)])
    rows += [(f"e{k}", line, {"kind": "edge", "source": "a", "target": "b"}) for k in range(2**16 + 1)]
    served, context = write(features(rows, "local"))
    RouteServer(served)
    assert "ComputeRoute" not in warnings(context)
    assert "DynamicEdges" in warnings(context)


# --- from other formats ----------------------------------------------------------------------------------------------


def test_network_of_another_format_is_written() -> None:
    part = street(["A", "B", "C"], speed_limit=2, action="row_traversal", tmap2={"fail_policy": "fail"})
    served, write_context = write(part, title="farm", attribution=("© somebody",))
    top = json.loads(served)
    assert (top["name"], top["attribution"]) == ("farm", "© somebody")
    server = RouteServer(served)
    assert sorted(server.nodes.values()) == [(0.0, 0.0), (1.0, 0.0), (2.0, 0.0)]
    assert all(
        m == {"action": "row_traversal", "abs_speed_limit": 2.0} for (k, _), m in server.metadata.items() if k == "edge"
    )
    assert {t.subject for t in write_context.template} == {"id", "name", "crs", "frame"}
    options = formats.write_options(FORMAT, {"graph_name": "rows", "frame_id": "farm_map"})
    context = WriteContext(options=options)
    document = json.loads(formats.write(FORMAT, Layers({NETWORK: part}), context)["graph.geojson"])
    assert document["name"] == "rows"
    assert {f["properties"].get("frame") for f in document["features"] if f["geometry"]["type"] == "Point"} == {
        "farm_map"
    }
    assert {t.option for t in context.template if t.option} == {"graph_name", "frame_id"}
    assert [(d.subject, d.count) for d in write_context.dropped] == [
        ("items with attributes that Nav2 cannot express", 4)
    ]
    back, _ = read(served)
    assert {p["name"] for p in back.properties if p["kind"] == "node"} == {"A", "B", "C"}
    assert {p.get("action") for p in back.properties if p["kind"] == "edge"} == {"row_traversal"}
    assert {p.get("speed_limit") for p in back.properties if p["kind"] == "edge"} == {2.0}
    assert write(back)[0] == served


def test_tmap2_round_trips_through_route_graph(shared: Path) -> None:
    farm = shared / "data" / "environment_template" / "riseholme_park_farm_vineyard" / "config" / "topological"
    data = (farm / "network.tmap2.yaml").read_bytes()
    server = RouteServer(offline({"network.tmap2.yaml": data}, "nav2_route").files["graph.geojson"])
    names = {m["name"]: server.nodes[n] for (k, n), m in server.metadata.items() if k == "node"}
    part = formats.read(
        FileGroup(get_format("tmap2"), "n.tmap2.yaml", {"n.tmap2.yaml": data}), ReadContext(main="n.tmap2.yaml")
    ).parts[NETWORK]
    assert isinstance(part, Features)
    places = {i: (g.x, g.y) for i, g in zip(part.ids, part.geometry, strict=True) if g.geom_type == "Point"}
    assert names.keys() == places.keys()
    assert all(names[i] == pytest.approx(at) for i, at in places.items())
    of = {n: m["name"] for (k, n), m in server.metadata.items() if k == "node"}
    assert {(of[a], of[b]) for a, b in server.edges.values()} == {
        (p["source"], p["target"]) for p in part.properties if p["kind"] == "edge"
    }


def test_network_without_edges_is_refused_with_advice() -> None:
    with pytest.raises(CannotConvert, match="supply"):
        write(street(["A"]))


def test_wgs84_positions_need_datum_and_levels_are_joined() -> None:
    line = [(-0.5, 53.0), (-0.5, 53.001)]
    rows: list[tuple[str, Any, dict[str, Any]]] = [
        ("a", shapely.Point(line[0]), {"kind": "node"}),
        ("b", shapely.Point(line[1]), {"kind": "node"}),
        ("a_b", shapely.LineString(line), {"kind": "edge", "source": "a", "target": "b"}),
    ]
    part = features(rows, "wgs84")
    with pytest.raises(MissingDatum):
        write(part)
    up = PartKey("topology", "up", "network")
    served, context = write(Layers({NETWORK: part, up: part}, Datum(53.0, -0.5), (Level(), Level("up", 3.0))))
    assert len(RouteServer(served).nodes) == 4
    assert "levels of nodes" in {d.subject for d in context.dropped}


def test_far_coordinates_are_warned_about() -> None:
    rows = [
        ("a", shapely.Point(1e5, 0), {"kind": "node"}),
        ("b", shapely.Point(0, 0), {"kind": "node"}),
        ("a_b", shapely.LineString([(1e5, 0), (0, 0)]), {"kind": "edge", "source": "a", "target": "b"}),
    ]
    assert "32-bit floats" in warnings(write(features(rows, "local"))[1])


# --- bad and doubtful files ------------------------------------------------------------------------------------------


def graph(*more: dict[str, Any], **edge: Any) -> dict[str, Any]:
    node = {"type": "Feature", "geometry": {"type": "Point", "coordinates": [1, 2]}}
    line = {"type": "Feature", "geometry": {"type": "LineString", "coordinates": [[1, 2], [3, 4]]}}
    other = {"type": "Feature", "geometry": {"type": "Point", "coordinates": [3, 4]}}
    rows = [
        {**node, "properties": {"id": 1}},
        {**other, "properties": {"id": 2}},
        {**line, "properties": {"id": 3, "startid": 1, "endid": 2, **edge}},
    ]
    return {"type": "FeatureCollection", "features": [*rows, *more]}


def node(**properties: Any) -> dict[str, Any]:
    return {"type": "Feature", "properties": properties, "geometry": {"type": "Point", "coordinates": [5, 6]}}


@pytest.mark.parametrize(
    ("data", "where", "reason"),
    [
        ([], "features", "array"),
        ({"features": {}}, "features", "array"),
        (graph(5), "features[3]", "feature"),  # type: ignore[arg-type]
        (graph({"type": "Feature", "properties": {}, "geometry": []}), "features[3]", "geometry"),
        (graph(node()), "features[3].properties.id", "missing"),
        (graph(node(id="7")), "features[3].properties.id", "an integer"),
        (graph(node(id=-1)), "features[3].properties.id", "an integer"),
        (graph(node(id=1.5)), "features[3].properties.id", "an integer"),
        (graph(node(id=2**32)), "features[3].properties.id", "an integer"),
        (graph(node(id=True)), "features[3].properties.id", "an integer"),
        (graph({**node(), "properties": None}), "features[3]", "properties"),
        (graph({**node(id=5), "geometry": {"type": "Point"}}), "features[3].geometry.coordinates", "two"),
        (graph({**node(id=5), "geometry": {"type": "Point", "coordinates": [1, "x"]}}),
         "features[3].geometry.coordinates", "not a number"),
        (graph(startid="1"), "features[2].properties.startid", "an integer"),
        (graph(endid=None), "features[2].properties.endid", "missing"),
        ({"features": graph()["features"][:2]}, "features", "no line"),
        ({"features": graph()["features"][2:]}, "features", "no point"),
    ],
)  # fmt: skip
def test_bad_files_are_refused_with_location(data: Any, where: str, reason: str) -> None:
    with pytest.raises(UnreadableFile) as caught:
        read(data)
    problem = caught.value.problems[0]
    assert problem.where == where
    assert reason in problem.problem
    assert problem.file == "graph.geojson"


@pytest.mark.parametrize(
    ("data", "line"),
    [(b'{"features": [\n1,\n}', 3), (b'{"features": [NaN]}', 1), (b'{"features": [1e999]}', 1)],
)
def test_invalid_json_is_refused_with_line(data: bytes, line: int) -> None:
    with pytest.raises(UnreadableFile, match="JSON") as caught:
        read(data)
    assert caught.value.problems[0].line == line


def test_read_enforces_limits() -> None:
    with pytest.raises(UnreadableFile, match="deeper"):
        read(b'{"features":' + b"[" * 200 + b"]" * 200 + b"}")
    with pytest.raises(TooLarge):
        read(graph(), limits=Limits(text_bytes=20))
    with pytest.raises(TooLarge):
        read(graph(), limits=Limits(features=2))
    with pytest.raises(UnreadableFile, match="finite"):
        read(graph({**node(id=5), "geometry": {"type": "Point", "coordinates": [1e9, 0]}}))


@pytest.mark.parametrize(
    ("data", "warning"),
    [
        (graph(startid=9), "missing node"),
        (graph(startid=9, endid=8), "missing node"),
        (graph(endid=1), "to itself"),
        (graph(node(id=4, frame="odom")), "frame is 'odom'"),
        (graph(metadata={"a": None}), "numbers, strings, booleans"),
        (graph(metadata={"a": {"b": [[1]]}}), "numbers, strings, booleans"),
        (graph(metadata=5), "must be an object"),
        (graph(operations={"x": {"type": "stop", "trigger": "NEVER"}}), "trigger"),
        (graph(operations={"x": {"type": "a", "trigger": "NODE", "metadata": {"y": None}}}), "operation 'x'"),
        (graph(operations=5), "operations must be"),
        (graph(cost="high"), "cost must be"),
        (graph(overridable=1), "overridable must be"),
        (graph(node(id=4, frame=7)), "frame must be"),
        (graph(metadata={"speed_limit": 85}), "exported as floats"),
    ],
)  # fmt: skip
def test_doubtful_content_is_read_with_warning(data: dict[str, Any], warning: str) -> None:
    # A file with an edge to nowhere needs another edge to be one.
    extra = {"type": "Feature", "geometry": {"type": "MultiLineString", "coordinates": "?"}}
    data["features"].append({**extra, "properties": {"id": 90, "startid": 2, "endid": 1}})
    part, context = read(data)
    assert warning in warnings(context)
    served, write_context = write(part)
    assert write(read(served)[0])[0] == served
    if "speed_limit" not in str(data) and not re.search("node$|itself$|frame is", warning):
        assert warning in warnings(write_context)


def test_dangling_edges_are_stored_but_not_exported() -> None:
    line = {"type": "Feature", "geometry": {"type": "LineString", "coordinates": [[0, 0], [1, 1]]}}
    part, _ = read(
        graph(
            {**line, "properties": {"id": 11, "startid": 1, "endid": 99, "cost": 2}},
            {**line, "properties": {"id": 12, "startid": 98, "endid": 99}},
        )
    )
    assert part.properties[0]["nav2_route"]["dangling"] == [{"id": 11, "from": 1, "to": 99, "properties": {"cost": 2}}]
    assert part.document["nav2_route"]["dangling"] == [{"id": 12, "from": 98, "to": 99, "properties": {}}]
    served, context = write(part)
    assert set(RouteServer(served).edges) == {3}
    assert [(d.subject, d.count) for d in context.dropped] == [("edges without both end nodes", 2)]


def test_metadata_of_other_types_stays_in_metadata() -> None:
    metadata = {"name": "", "action": 5, "width": "wide", "abs_speed_limit": True}
    part, _ = read(graph(node(id=4, metadata={"name": "4"}), metadata=metadata))
    assert part.properties[-1]["nav2_route"]["properties"]["metadata"] == metadata
    assert "speed_limit" not in part.properties[-1]
    top = json.loads(write(part)[0])
    assert [f["properties"]["metadata"] for f in top["features"] if "metadata" in f["properties"]] == [
        {"name": "4"},
        metadata,
    ]


def test_read_skips_unrequested_layers() -> None:
    context = ReadContext(main="g.json", requested_layers=frozenset({"voxels"}))
    assert formats.read(FileGroup(FORMAT, "g.json", {"g.json": b"{}"}), context).parts == {}


def test_detect_accepts_route_graphs_only() -> None:
    data = json.dumps(graph()).encode()
    assert FORMAT.detect("a.json", data)
    assert FORMAT.detect("b.geojson", b"\xef\xbb\xbf\n" + data)
    assert not FORMAT.detect("b.geojson", b"x" + data)
    assert not FORMAT.detect("b.geojson", b'{"type":"FeatureCollection","features":[]}')


def test_invalid_property_values_are_written_safely() -> None:
    odd: list[Any] = [5, "x", [1], {"a": 1}, None, [[1]], True, {"id": -1}]
    for value in odd:
        source_properties = dict.fromkeys(("id", "properties", "members", "geometry", "dangling", "line"), value)
        inner = {"properties": dict.fromkeys(("id", "startid", "metadata", "operations", "cost", "frame"), value)}
        rows: list[tuple[str, Any, dict[str, Any]]] = [
            ("a", shapely.Point(0, 0), {"kind": "node", "name": value, "nav2_route": source_properties}),
            ("b", shapely.Point(1, 0), {"kind": "node", "width": value, "nav2_route": inner}),
            ("e", shapely.Point(1, 0), {"kind": "edge", "source": "a", "target": "b", "nav2_route": source_properties}),
            ("f", shapely.Point(1, 0), {"kind": "edge", "source": "b", "target": "a", "nav2_route": inner}),
            ("g", shapely.Point(1, 0), {"kind": "edge", "source": value, "target": value, "nav2_route": value}),
        ]
        for document in ({"members": value, "ignored": value, "dangling": value}, value):
            served, _ = write(features(rows, "local", {"nav2_route": document}))
            assert len(json.loads(served)["features"]) >= 4


@pytest.mark.parametrize("heading", [0.0, 30.0])
def test_gdal_shows_the_metres_where_they_are_on_earth(heading: float, tmp_path: Path) -> None:
    program = shutil.which("ogr2ogr")
    if program is None:
        pytest.skip("ogr2ogr is not installed")
    datum = Datum(53.2686, -0.5245, heading=heading)
    nodes = [(name, shapely.Point(x, y), {"kind": "node"}) for name, x, y in (("1", 100.0, 50.0), ("2", -20.0, 7.0))]
    edge = ("3", shapely.LineString([(100.0, 50.0), (-20.0, 7.0)]), {"kind": "edge", "source": "1", "target": "2"})
    layers = Layers({PartKey("topology", name="network"): features([*nodes, edge], "local")}, datum)
    files = formats.write(get_format("nav2_route"), layers, WriteContext())
    (tmp_path / "graph.geojson").write_bytes(files["graph.geojson"])
    arguments = ["-f", "GeoJSON", "-lco", "COORDINATE_PRECISION=12", "-t_srs", "EPSG:4326", "/vsistdout/"]
    done = subprocess.run([program, *arguments, tmp_path / "graph.geojson"], capture_output=True, check=True)
    rows = [row["geometry"] for row in json.loads(done.stdout)["features"] if row["geometry"]["type"] == "Point"]
    metres = local_frame(datum).to_local(np.array([row["coordinates"][:2] for row in rows]))
    assert np.abs(metres - [[100.0, 50.0], [-20.0, 7.0]]).max() < 1e-3

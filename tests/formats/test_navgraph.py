"""navgraph: real graphs round-trip, independently counted facts, Fawkes' rules, errors name their location."""

from __future__ import annotations

import json
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
from app.errors import BadUpload, MissingDatum, UnreadableFile
from app.formats import FileGroup, ReadContext, WriteContext, get_format
from app.limits import Limits
from app.model.features import Features, features
from app.model.frame import Datum, Level
from app.model.layers import Layers, PartKey
from app.syntax.yaml import Tagged, load
from app.upload_reader import UploadHints

FORMAT = get_format("navgraph")
SAMPLES = Path(__file__).resolve().parents[1] / "samples" / "navgraph"
FACTS: dict[str, Any] = json.loads((SAMPLES / "facts.json").read_text())
NETWORK = PartKey("topology", "ground", "network")
HEAD = "%YAML 1.2\n%TAG ! tag:fawkesrobotics.org,navgraph/\n---\n"
Same = Callable[[str, dict[str, bytes], dict[str, bytes]], list[str]]


def read(data: bytes | str, **context: Any) -> tuple[Features, ReadContext]:
    content = data.encode() if isinstance(data, str) else data
    read_context = ReadContext(main="navgraph.yaml", **context)
    part = formats.read(FileGroup(FORMAT, "navgraph.yaml", {"navgraph.yaml": content}), read_context).parts[NETWORK]
    assert isinstance(part, Features)
    return part, read_context


def write(part: Features | Layers, **context: Any) -> tuple[str, WriteContext]:
    write_context = WriteContext(**context)
    layers = part if isinstance(part, Layers) else Layers({NETWORK: part})
    files = formats.write(FORMAT, layers, write_context)
    assert list(files) == ["navgraph.yaml"]
    return files["navgraph.yaml"].decode(), write_context


def warnings(context: ReadContext | WriteContext) -> str:
    return "\n".join(p.problem for p in context.warnings)


class Fawkes:
    """Loader with the rules of yaml_navgraph.cpp: every scalar is a text; connections are added in sequence."""

    def __init__(self, text: str) -> None:
        assert text.startswith(HEAD)
        loader = type("Loader", (yaml.BaseLoader,), {})  # all scalars are texts, as yaml-cpp's as<std::string>
        loader.add_multi_constructor("tag:fawkesrobotics.org,navgraph/", self.tagged)  # type: ignore[attr-defined]
        top = yaml.load(text, Loader=loader)
        self.name = top["graph-name"]
        self.nodes: dict[str, tuple[float, float]] = {}
        self.properties: dict[str, dict[str, str]] = {}
        self.unconnected = set()
        for item in top["nodes"]:
            tag, node = item if isinstance(item, tuple) else (None, item)
            assert node["name"] not in self.nodes, "Fawkes: node already exists"
            assert len(node["pos"]) == 2
            self.nodes[node["name"]] = (float(node["pos"][0]), float(node["pos"][1]))
            self.properties[node["name"]] = self.flat(node.get("properties", []))
            if tag == "unconnected":
                self.unconnected.add(node["name"])
        self.defaults = self.flat(top.get("default-properties", []))
        self.edges: list[tuple[str, str, bool]] = []
        self.splits = 0
        for item in top["connections"]:
            self.add(*(item if isinstance(item, tuple) else (None, item)))
        self.check()

    @staticmethod
    def tagged(loader: Any, suffix: str, node: Any) -> tuple[str, Any]:
        build = loader.construct_mapping if isinstance(node, yaml.MappingNode) else loader.construct_sequence
        return suffix, build(node, deep=True)

    @staticmethod
    def flat(items: Any) -> dict[str, str]:
        assert isinstance(items, list), "Fawkes: properties must be a list"
        out: dict[str, str] = {}
        for item in items:
            pairs = item if isinstance(item, dict) else {item: "true"}
            assert all(isinstance(v, str) for v in pairs.values())
            out |= pairs
        return out

    def add(self, tag: str | None, pair: list[str]) -> None:
        a, b = pair
        assert a in self.nodes, f"Fawkes: there is no node {a}"
        assert b in self.nodes, f"Fawkes: there is no node {b}"
        directed = tag == "dir"
        for x, y, one_way in self.edges:
            assert (x, y) != (a, b), f"Fawkes: edge {a} {b} already exists"
            assert directed or one_way or (x, y) != (b, a), f"Fawkes: edge {a} {b} already exists"
        line = shapely.LineString([self.nodes[a], self.nodes[b]])
        others = [(x, y) for x, y, _ in self.edges if not {x, y} & {a, b}]
        crossing = [o for o in others if line.intersects(shapely.LineString([self.nodes[n] for n in o]))]
        if tag in (None, "bidir", "dir", "no-intersection"):
            assert not crossing, f"Fawkes: edge {a} {b} intersects {crossing}"
        self.splits += len(crossing) * (tag == "split-intersection")
        self.edges.append((a, b, directed))

    def check(self) -> None:
        onward: dict[str, set[str]] = {n: set() for n in self.nodes}
        for a, b, directed in self.edges:
            onward[a].add(b)
            if not directed:
                onward[b].add(a)
        connected = [n for n in self.nodes if n not in self.unconnected]
        seen, front = set(connected[:1]), connected[:1]
        while front:
            new = onward[front.pop()] - seen
            seen |= new
            front += new
        assert not seen & self.unconnected, "Fawkes: marked unconnected but reachable"
        assert not any(onward[n] for n in self.unconnected)
        assert seen == set(connected), f"Fawkes: cannot reach {set(connected) - seen}"


# --- real files ------------------------------------------------------------------------------------------------------


def test_real_files_round_trip(shared: Path, same: Same, facts_json: dict[str, Any]) -> None:
    paths = sorted((shared / "data" / "navgraph").rglob("*.yaml"))
    assert len(paths) == sum(f.get("kind") == "fawkes_navgraph" for f in facts_json.values()) == 3
    for path in paths:
        data = path.read_bytes()
        assert formats.detect(path.name, data) is FORMAT, path
        served, context = write(read(data)[0])
        assert same("navgraph", {path.name: data}, {"navgraph.yaml": served.encode()}) == [], path
        assert (context.dropped, context.template) == ([], [])
        assert write(read(served)[0])[0] == served


def test_real_files_match_counted_facts(shared: Path, facts_json: dict[str, Any]) -> None:
    for path in sorted((shared / "data" / "navgraph").rglob("*.yaml")):
        fact = facts_json[str(path.relative_to(shared / "data"))]["facts"]
        part, context = read(path.read_bytes())
        nodes = [p for p in part.properties if p["kind"] == "node"]
        edges = [p for p in part.properties if p["kind"] == "edge"]
        tags = fact["connections_by_tag"]
        assert len(nodes) == fact["nodes"]
        assert len(edges) == 2 * fact["connections"] - tags.get("!dir", 0)
        assert sum(p["navgraph"].get("tag") == "unconnected" for p in nodes) == fact["nodes_by_tag"].get(
            "!unconnected", 0
        )
        split = sum(p["navgraph"].get("tag") == "split-intersection" for p in edges)
        assert split == 2 * tags.get("!split-intersection", 0)
        assert Counter(w for p in nodes for w in p["navgraph"].get("words", [])) == fact["bare_scalar_properties"]
        assert sum("orientation" in p for p in nodes) == fact["node_property_keys"].get("orientation", 0)
        assert part.document["navgraph"]["top"]["graph-name"] == fact["graph_name"]
        assert part.document["navgraph"]["defaults"] == fact["default_properties"]
        assert ("is not a node" in warnings(context)) == (fact["root_is_a_node"] is False)
        points = part.geometry[: len(nodes)]
        assert shapely.total_bounds(points) == pytest.approx([*fact["bounds"][0], *fact["bounds"][1]], abs=1e-6)
        assert bool(part.local.all())


def test_exported_real_graphs_load_in_fawkes(shared: Path) -> None:
    for path in sorted((shared / "data" / "navgraph").rglob("*.yaml")):
        before, after = Fawkes(path.read_text()), Fawkes(write(read(path.read_bytes())[0])[0])
        assert before.nodes.keys() == after.nodes.keys()
        assert all(after.nodes[n] == pytest.approx(at, abs=1e-9) for n, at in before.nodes.items())
        assert before.splits == after.splits


# --- our sample ------------------------------------------------------------------------------------------------------


def test_sample_matches_expected_facts() -> None:
    fact = FACTS["depot.yaml"]
    part, context = read((SAMPLES / "depot.yaml").read_bytes())
    nodes = {i: p for i, p in zip(part.ids, part.properties, strict=True) if p["kind"] == "node"}
    pairs = [(p["source"], p["target"]) for p in part.properties if p["kind"] == "edge"]
    both = sorted({tuple(sorted(p)) for p in pairs if p[::-1] in pairs})
    assert len(nodes) == fact["nodes"]
    assert both == sorted(tuple(sorted(p)) for p in fact["both_ways"])
    assert sorted(p for p in pairs if p[::-1] not in pairs) == sorted(map(tuple, fact["one_way"]))
    assert [i for i, p in nodes.items() if p["navgraph"].get("tag") == "unconnected"] == fact["unconnected"]
    assert [*zip(*[iter(shapely.total_bounds(part.geometry).tolist())] * 2, strict=True)] == [
        tuple(b) for b in fact["bounds"]
    ]
    assert "is not a node" in warnings(context)
    dock = nodes["Dock"]
    assert dock["name"] == "Charging dock"
    assert dock["orientation"] == pytest.approx([0, 0, math.sin(4.71 / 2), math.cos(4.71 / 2)])
    assert dock["navgraph"] == {
        "name": "Dock",
        "properties": {"orientation": 4.71, "highway_exit": True},
        "words": ["highway_exit"],
    }
    assert nodes["no"]["navgraph"] == {"properties": {"fragile": True}}
    assert nodes["A"]["navgraph"]["more"] == {"floor": {"colour": "grey", "tiles": [1, 2]}}


def test_sample_is_written_as_expected(same: Same) -> None:
    data = (SAMPLES / "depot.yaml").read_bytes()
    part, _ = read(data)
    served, context = write(part)
    assert same("navgraph", {"a.yaml": data}, {"b.yaml": served.encode()}) == []
    assert (context.dropped, context.template) == ([], [])
    assert "graph-name: Depot\nroot: Nowhere\nrevision: 7\n" in served
    assert "  - !unconnected\n    name: 'shelf 4'\n" in served or "  - !unconnected\n    name: shelf 4\n" in served
    assert "      - highway_exit\n" in served
    assert "      - orientation: 4.71\n" in served
    order = [line for line in served.splitlines() if line.startswith(("  - [", "  - !")) and "[" in line]
    assert [line.split("[")[0].strip(" -") for line in order] == [
        "", "!bidir", "!dir", "!no-intersection", "!split-intersection", "!allow-intersection", "!dir", "!dir",
    ]  # fmt: skip


def test_edited_properties_are_exported() -> None:
    part, _ = read((SAMPLES / "depot.yaml").read_bytes())
    place = part.index()
    properties = [dict(p) for p in part.properties]
    properties[place["Dock"]]["orientation"] = [0.0, 0.0, math.sin(0.25), math.cos(0.25)]
    properties[place["A"]]["name"] = "Bay"
    keep = [k for k, i in enumerate(part.ids) if i not in ("Dock_A", "C 1_010")]
    changed = Features(part.ids, part.geometry, tuple(properties), part.local, part.document).select(keep)
    served, context = write(changed)
    assert "      - orientation: 0.5\n" in served
    assert "      - name: Bay\n" in served
    assert "  - !dir [A, Dock]\n" in served
    assert "  - !dir ['010', 'C 1']\n" in served or "  - !dir ['010', C 1]\n" in served
    assert [d.subject for d in context.dropped] == ["intersection tags"]


# --- from other formats ----------------------------------------------------------------------------------------------


def cross(**more: Any) -> Features:
    """Two streets that cross on a bridge, a one-way street, a parallel edge, an isolated node."""
    at = {"W": (-5.0, 0.0), "E": (5.0, 0.0), "S": (0.0, -5.0), "N": (0.0, 5.0), "alone": (9.0, 9.0)}
    rows: list[tuple[str, Any, dict[str, Any]]] = [
        (i, shapely.Point(p), {"kind": "node", "name": i}) for i, p in at.items()
    ]
    rows[0] = ("W", shapely.Point(-5, 0, 2), {"kind": "node", "name": "West gate", "floor": 2, "kml": {"a": 1}})
    pairs = ["WE", "EW", "SN", "NS", "ES", "NW", "WN"]
    for k, (a, b) in enumerate(pairs):
        p = {"kind": "edge", "source": a, "target": b, "speed_limit": 1.0}
        rows.append((f"e{k}", shapely.LineString([at[a], at[b]]), p))
    bent = shapely.LineString([at["W"], (0, 9), at["E"]])
    rows.append(("bent", bent, {"kind": "edge", "source": "W", "target": "E", **more}))
    return features(rows, "local")


def test_network_of_another_format_loads_in_fawkes() -> None:
    served, context = write(cross(), title="quarter")
    graph = Fawkes(served)
    assert graph.name == "quarter"
    assert graph.unconnected == {"alone"}
    assert {frozenset((a, b)): d for a, b, d in graph.edges} == {
        frozenset("WE"): False,
        frozenset("SN"): False,
        frozenset("ES"): True,
        frozenset("NW"): False,
        frozenset(("W", "E~W~1")): True,
        frozenset(("E~W~1", "E")): True,
    }
    assert graph.properties["W"] == {"name": "West gate", "floor": "2"}
    assert served.count("!allow-intersection") == 2
    assert {d.subject: d.count for d in context.dropped} == {
        "altitudes of nodes": 1,
        "ids of edges": 9,
        "edges with attributes (action, speed limit …)": 7,
        "attributes of nodes that are not scalars": 1,
    }
    assert {t.subject for t in context.template} == {"graph-name", "nodes: !unconnected", "nodes at bends"}
    assert next(t.option for t in context.template if t.subject == "graph-name") == "graph_name"
    assert context.warnings == []
    assert write(read(served)[0])[0] == served


def one_way(*pairs: str) -> Features:
    at = {"A": (0.0, 0.0), "B": (4.0, 0.0), "C": (4.0, 4.0), "D": (0.0, 4.0)}
    rows: list[tuple[str, Any, dict[str, Any]]] = [
        (i, shapely.Point(p), {"kind": "node", "name": i}) for i, p in at.items() if i in "".join(pairs)
    ]
    for a, b in pairs:
        line = shapely.LineString([at[a], at[b]])
        rows.append((f"{a}_{b}", line, {"kind": "edge", "source": a, "target": b}))
    return features(rows, "local")


def test_first_node_reaches_all_others() -> None:
    served, context = write(one_way("DC", "CB", "BA"))
    assert next(iter(Fawkes(served).nodes)) == "D"
    assert context.warnings == []
    served, context = write(one_way("AC", "BC"))
    assert "no node reaches all others" in warnings(context)
    with pytest.raises(AssertionError, match="cannot reach"):
        Fawkes(served)


def test_one_way_crossings_are_warned_about() -> None:
    served, context = write(one_way("AC", "BD", "CB"))
    assert "2 one-way connections cross" in warnings(context)
    with pytest.raises(AssertionError, match="intersects"):
        Fawkes(served)


def test_wgs84_positions_need_datum() -> None:
    rows: list[tuple[str, Any, dict[str, Any]]] = [
        ("a", shapely.Point(-0.5, 53.0), {"kind": "node"}),
        ("b", shapely.Point(-0.5, 53.001), {"kind": "node"}),
        ("a_b", shapely.LineString([(-0.5, 53.0), (-0.5, 53.001)]), {"kind": "edge", "source": "a", "target": "b"}),
    ]
    part = features(rows, "wgs84")
    with pytest.raises(MissingDatum):
        write(part)
    graph = Fawkes(write(Layers({NETWORK: part}, Datum(53.0, -0.5)))[0])
    assert graph.nodes["a"] == (0.0, 0.0)
    assert graph.nodes["b"] == pytest.approx((0.0, 111.28), abs=0.1)


def test_levels_are_joined_with_distinct_names() -> None:
    up = PartKey("topology", "up", "network")
    layers = Layers({NETWORK: one_way("AB", "BA"), up: one_way("AB", "BA")}, None, (Level(), Level("up", 3.0)))
    served, context = write(layers)
    assert "name: A#2" in served or "name: 'A#2'" in served
    assert {d.subject for d in context.dropped} >= {"levels of nodes"}
    assert "a numeric suffix" in warnings(context)


def test_tmap2_and_drawing_are_exported(shared: Path) -> None:
    farm = shared / "data" / "environment_template" / "riseholme_park_farm_vineyard" / "config" / "topological"
    data = (farm / "network.tmap2.yaml").read_bytes()
    navgraph_data = offline({"network.tmap2.yaml": data}, "navgraph").files["navgraph.yaml"]
    graph = Fawkes(navgraph_data.decode())
    again = offline({"navgraph.yaml": navgraph_data}, "tmap2").files["network.tmap2.yaml"]
    names = {n["node"]["name"]: n["node"]["pose"]["position"] for n in yaml.safe_load(data)["nodes"]}
    back = {n["node"]["name"]: n["node"] for n in yaml.safe_load(again)["nodes"]}
    assert set(back) == set(names) == set(graph.nodes)
    for name, at in names.items():
        assert graph.nodes[name] == pytest.approx((at["x"], at["y"]), abs=1e-8)
    edges = {(n["node"]["name"], e["node"]) for n in yaml.safe_load(data)["nodes"] for e in n["node"]["edges"]}
    assert {(n, e["node"]) for n, node in back.items() for e in node["edges"]} == edges


# --- names, tags, bad files ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "scalar",
    ["no", "'yes'", "010", "1.50", "~", "0x1F", "12:30", "'a: b'", "'a, b'", "'[x]'", "'!dir'", "Größe", '"tab \\x41"',
     "null", "'#1'", "a.b", "'-'", "2022-01-01", "'{'"],
)  # fmt: skip
def test_any_name_round_trips_as_fawkes_reads_it(scalar: str) -> None:
    text = f"{HEAD}graph-name: G\nnodes:\n- {{name: {scalar}, pos: [1, 2]}}\n- {{name: B, pos: [3, 4]}}\n"
    text += f"connections:\n- [{scalar}, B]\n"
    before = Fawkes(text)
    after = Fawkes(write(read(text)[0])[0])
    assert before.nodes == after.nodes
    assert {frozenset(e[:2]) for e in before.edges} == {frozenset(e[:2]) for e in after.edges}


def graph(nodes: str = "", connections: str = "", head: str = HEAD) -> str:
    base = "- name: A\n  pos: [0, 0]\n- name: B\n  pos: [1, 0]\n"
    return f"{head}graph-name: G\nnodes:\n{base}{nodes}connections:\n- [A, B]\n{connections}"


@pytest.mark.parametrize(
    ("text", "where", "reason"),
    [
        (graph("- pos: [1, 2]\n"), "nodes[2]", "name"),
        (graph("- name: C\n"), "C.pos", "pos"),
        (graph("- name: C\n  pos: [1, 2, 3]\n"), "C.pos", "[x, y]"),
        (graph("- name: C\n  pos: [1, .nan]\n"), "C.pos", "finite"),
        (graph("- name: C\n  pos: [1, x]\n"), "C.pos", "not a number"),
        (graph("- name: [C]\n  pos: [1, 2]\n"), "nodes[2].name", "string"),
        (graph("- name: ''\n  pos: [1, 2]\n"), "nodes[2].name", "characters"),
        (graph('- name: "a\\nb"\n  pos: [1, 2]\n'), "nodes[2].name", "control"),
        (graph("- [C, 1, 2]\n"), "nodes[2]", "mapping"),
        (graph("- name: C\n  pos: [1, 2]\n  properties: 5\n"), "C.properties", "list"),
        (graph("- name: C\n  pos: [1, 2]\n  properties: [[a]]\n"), "C.properties", "list"),
        (graph("- name: C\n  pos: [1, 2]\n  properties: [{a: 99999999999999999999}]\n"), "C.properties.a", "64 bit"),
        (graph("- name: C\n  pos: !dir [1, 2]\n"), "C.pos", "[x, y]"),
        (graph("- name: C\n  pos: [1, 2]\n  properties: [{a: !dir [1]}]\n"), "C.properties.a", "tag"),
        (graph(connections="- [A]\n"), "connections[1]", "pair"),
        (graph(connections="- {A: B}\n"), "connections[1]", "pair"),
        (graph(connections="- [A, [B]]\n"), "connections[1]", "string"),
        (graph(connections="- !a%20b [A, B]\n"), "connections[1]", "tag"),
        (f"{HEAD}graph-name: G\nnodes: 5\n", "nodes", "list"),
        (f"{HEAD}[]\n", "nodes", "list"),
    ],
)
def test_bad_files_are_refused_with_location(text: str, where: str, reason: str) -> None:
    with pytest.raises(UnreadableFile) as caught:
        read(text)
    problem = caught.value.problems[0]
    assert problem.where == where
    assert reason in problem.problem
    assert problem.file == "navgraph.yaml"


@pytest.mark.parametrize(
    "text",
    [
        graph(head="%TAG !x! tag:evil,2024:\n---\n"),
        graph(connections="- !!python/tuple [A, B]\n"),
        graph("- !!set {name: C, pos: [1, 2]}\n"),
        graph("- name: !dir C\n  pos: [1, 2]\n"),
        graph("&n - name: C\n"),
    ],
)
def test_unknown_yaml_tags_are_refused_with_line(text: str) -> None:
    with pytest.raises(BadUpload) as caught:
        read(text)
    assert caught.value.problems[0].line


@pytest.mark.parametrize(
    ("text", "warning"),
    [
        (graph(connections="- [A, X]\n"), "unknown node 'X'"),
        (graph(connections="- [X, Y]\n"), "unknown node 'X'"),
        (graph(connections="- [B, A]\n"), "duplicate connection"),
        (graph(connections="- !dir [B, B]\n"), "to itself"),
        (graph(connections="- !fast [A, B]\n"), "does not support the tag !fast"),
        (graph("- name: A\n  pos: [5, 5]\n"), "duplicate node names"),
        (graph("- !parked\n  name: C\n  pos: [5, 5]\n"), "does not support the tag !parked"),
        (graph("- name: C\n  pos: [5, 5]\n  properties: {a: 1}\n"), "must be a list"),
        (graph("- name: C\n  pos: [5, 5]\n  properties: [a: 1, a: 2]\n"), "the last value is used"),
        (graph("- name: C\n  pos: [5, 5]\n  properties: [a: [1]]\n"), "not a scalar"),
        (graph(connections="- !dir [A, B]\n", head=""), "without the line"),
        (f"{HEAD}nodes: []\n", "missing"),
    ],
)
def test_doubtful_content_is_read_with_warning(text: str, warning: str) -> None:
    part, context = read(text)
    assert warning in warnings(context)
    served, _ = write(part)
    assert write(read(served)[0])[0] == served


def test_dangling_connections_are_stored_but_not_exported() -> None:
    part, _ = read(graph(connections="- !dir [A, X]\n- [Y, B]\n- [X, Y]\n"))
    assert part.properties[0]["navgraph"]["dangling"] == [{"tag": "dir", "ends": ["A", "X"]}]
    assert part.properties[1]["navgraph"]["dangling"] == [{"ends": ["Y", "B"]}]
    assert part.document["navgraph"]["dangling"] == [{"ends": ["X", "Y"]}]
    served, context = write(part)
    assert len(Fawkes(served).edges) == 1
    assert [(d.subject, d.count) for d in context.dropped] == [("connections without both end nodes", 3)]


def test_duplicate_name_is_exported_unchanged() -> None:
    part, _ = read(graph("- name: A\n  pos: [5, 5]\n"))
    assert part.ids[:3] == ("A", "B", "A#2")
    assert part.properties[2]["name"] == "A"
    served, context = write(part)
    assert served.count("name: A\n") == 2
    assert "Fawkes rejects" in warnings(context)


def test_read_skips_unrequested_layers() -> None:
    context = ReadContext(main="n.yaml", requested_layers=frozenset({"occupancy"}))
    assert formats.read(FileGroup(FORMAT, "n.yaml", {"n.yaml": graph().encode()}), context).parts == {}


@pytest.mark.parametrize(
    ("name", "text", "is_one"),
    [
        ("a.yaml", graph(), True),
        ("a.yml", graph(head=""), True),
        ("a.txt", graph(), False),
        ("a.yaml", "nodes: []\nname: x\n", False),
        ("a.yaml", "nodes:\n- graph-name: x\n", False),
    ],
)
def test_detect_accepts_navgraphs_only(name: str, text: str, is_one: bool) -> None:
    assert FORMAT.detect(name, text.encode()) is is_one


def test_large_and_dense_graphs_are_written_in_time() -> None:
    n = 80
    at = np.stack([np.cos(np.arange(n)), np.sin(np.arange(n))], axis=1) * 100
    rows: list[tuple[str, Any, dict[str, Any]]] = [
        (f"n{k}", shapely.Point(p), {"kind": "node"}) for k, p in enumerate(at)
    ]
    for k in range(n):
        for j in range(k + 1, min(k + 60, n)):
            line = shapely.LineString([at[k], at[j]])
            for a, b in ((k, j), (j, k)):
                rows.append((f"{a}_{b}", line, {"kind": "edge", "source": f"n{a}", "target": f"n{b}"}))
    served, _ = write(features(rows, "local"))
    assert served.count("!allow-intersection") > 2_000


def test_yaml_tags_are_read_only_for_formats_that_declare_them() -> None:
    limits = Limits()
    data = b"%TAG ! tag:x,2024:\n---\na: !t [1, no]\n"
    with pytest.raises(UnreadableFile):
        load(data, limits)
    assert load(data, limits, tags=("tag:x,2024:",)) == {"a": Tagged("tag:x,2024:t", [1, False])}
    assert load(data, limits, tags=("tag:x,2024:",), typed=False) == {"a": Tagged("tag:x,2024:t", ["1", "no"])}
    with pytest.raises(UnreadableFile, match="unknown %TAG"):
        load(data, limits, tags=("!",))
    with pytest.raises(UnreadableFile, match="deeper"):
        load(b"!t [" * 60, limits, tags=("!",))


def test_hints_name_the_format() -> None:
    files = {"plain.yaml": b"nodes:\n- name: A\n  pos: [1, 2]\n"}
    assert b"pos: [1.0, 2.0]" in offline(files, "navgraph", hints=UploadHints("navgraph")).files["navgraph.yaml"]


def test_invalid_property_values_are_written_safely() -> None:
    odd: list[Any] = [5, "x", [1], {"a": 1}, None, [[1]], True]
    for value in odd:
        source_properties = dict.fromkeys(
            ("name", "tag", "properties", "words", "more", "dangling", "order", "backward"), value
        )
        rows: list[tuple[str, Any, dict[str, Any]]] = [
            (
                "a",
                shapely.Point(0, 0),
                {"kind": "node", "orientation": value, "name": value, "navgraph": source_properties},
            ),
            ("b", shapely.Point(1, 0), {"kind": "node", "navgraph": {"more": {"name": "c", "pos": 1}}}),
            ("e", shapely.Point(1, 0), {"kind": "edge", "source": "a", "target": "b", "navgraph": source_properties}),
            ("f", shapely.Point(1, 0), {"kind": "edge", "source": value, "target": value, "navgraph": value}),
        ]
        top = dict.fromkeys(("top", "defaults", "words", "dangling"), value)
        for document in ({"navgraph": top}, {"navgraph": value}, {"navgraph": {"top": {"nodes": 1, "root": value}}}):
            served, _ = write(features(rows, "local", document))
            assert len(read(served)[0]) == 3

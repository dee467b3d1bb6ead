"""ffr_network: points and lines between their coordinates round-trip, in both directions, without loss."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import shapely
import yaml

from app import formats
from app.convert.files import offline
from app.errors import BadUpload
from app.formats import FileGroup, ReadContext, WriteContext, get_format
from app.model.features import Features, features
from app.model.layers import Layers, PartKey

FORMAT = get_format("ffr_network")
SAMPLES = Path(__file__).resolve().parents[1] / "samples" / "ffr_network"
YARD = (SAMPLES / "yard.ffr.yaml").read_bytes()
NETWORK = PartKey("topology", "ground", "network")


def read(data: bytes, name: str = "network.ffr.yaml") -> tuple[Features, ReadContext]:
    context = ReadContext(main=name)
    part = formats.read(FileGroup(FORMAT, name, {name: data}), context).parts[NETWORK]
    assert isinstance(part, Features)
    return part, context


def write(part: Features) -> tuple[dict[str, Any], WriteContext]:
    context = WriteContext()
    files = formats.write(FORMAT, Layers({NETWORK: part}), context)
    return yaml.safe_load(files["network.ffr.yaml"]), context


def seeds_tmap(data: dict[str, Any]) -> set[tuple[str, str]]:
    """Find lines as ffrnetwork_to_tmap.py does, points by their coordinates' text; KeyError if it would fail."""
    nodes = {f"x{n['x']}y{n['y']}": n["name"] for n in data["internal_points"]}
    return {
        (nodes[f"x{e['start']['x']}y{e['start']['y']}"], nodes[f"x{e['end']['x']}y{e['end']['y']}"])
        for e in data["network_lines"]
    }


def plain(value: Any) -> Any:
    """Normalise the order of lists and keys, and 0 and 0.0."""
    if isinstance(value, dict):
        return {key: plain(value[key]) for key in sorted(value)}
    if isinstance(value, list):
        return sorted((plain(v) for v in value), key=json.dumps)
    return float(value) if isinstance(value, int) else value


def test_sample_matches_known_facts() -> None:
    fact = json.loads((SAMPLES / "facts.json").read_text())["yard.ffr.yaml"]
    assert formats.detect("network.ffr.yaml", YARD) is FORMAT
    part, context = read(YARD)
    items = zip(part.ids, part.geometry, part.properties, strict=True)
    at = {i: [g.x, g.y] for i, g, p in items if p["kind"] == "node"}
    assert at == fact["nodes"]
    ends = [[p["source"], p["target"]] for p in part.properties if p["kind"] == "edge"]
    assert ends == fact["edges"]
    assert part.geometry[1].z == 0.5
    assert [p.get("width") for p in part.properties if p["kind"] == "edge"] == [2.5, 2.5, None, None]
    warnings = "\n".join(w.problem for w in context.warnings)
    assert "no point stands" in warnings
    assert "have no lines: well" in warnings


def test_all_members_round_trip() -> None:
    part, _ = read(YARD)
    back, context = write(part)
    assert context.dropped == context.warnings == []
    assert plain(back) == plain(yaml.safe_load(YARD))
    assert seeds_tmap({**back, "network_lines": back["network_lines"][:2]}) == {("gate", "barn"), ("12", "gate")}


def test_parallel_and_opposite_edges_stay_separate() -> None:
    ends = "{start: {x: %s, y: 0}, end: {x: %s, y: 0}, n: %d}"
    lines = [ends % (0, 1, 1), ends % (1, 0, 2), ends % (0, 1, 3), ends % (1, 1, 4)]
    text = "internal_points: [{name: a, x: 0, y: 0}, {name: b, x: 1, y: 0}]\nnetwork_lines: [" + ", ".join(lines) + "]"
    part, _ = read(text.encode())
    assert sum(p["kind"] == "edge" for p in part.properties) == 7
    back, context = write(part)
    assert plain(back) == plain(yaml.safe_load(text))
    assert context.warnings == []


def test_network_of_other_format_is_written() -> None:
    rows: list[tuple[str, Any, dict[str, Any]]] = [
        ("a", shapely.Point(0.1, 0.2), {"kind": "node", "name": "Gate"}),
        ("b", shapely.Point(1 / 3, 2.0), {"kind": "node"}),
        ("c", shapely.Point(5.0, 5.0), {"kind": "node"}),
        ("1", shapely.LineString([(0.1, 0.2), (1 / 3, 2)]), {"kind": "edge", "source": "a", "target": "b"}),
        ("2", shapely.LineString([(1 / 3, 2), (0.1, 0.2)]), {"kind": "edge", "source": "b", "target": "a"}),
        ("3", shapely.LineString([(1 / 3, 2), (5, 5)]), {"kind": "edge", "source": "b", "target": "c"}),
    ]
    rows[3][2]["speed_limit"] = 2.0
    back, context = write(features(rows, "local"))
    assert seeds_tmap(back) == {("a", "b"), ("b", "c")}
    assert [e.get("oneway") for e in back["network_lines"]] == [None, True]
    assert back["network_lines"][0]["speed_limit"] == 2.0
    assert any("one way" in w.problem for w in context.warnings)
    assert {d.subject for d in context.dropped} == {
        "attributes of the way back",
        "names of nodes that are not their ids",
    }


def test_network_exports_to_tmap2_with_both_directions() -> None:
    top = yaml.safe_load(offline({"network.ffr.yaml": YARD}, "tmap2").files["network.tmap2.yaml"])
    edges = {(n["node"]["name"], e["node"]) for n in top["nodes"] for e in n["node"]["edges"]}
    assert edges == {("gate", "barn"), ("barn", "gate"), ("12", "gate"), ("gate", "12")}


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("internal_points: {}\nnetwork_lines: []", "internal_points"),
        ("internal_points: [3]\nnetwork_lines: []", "internal_points[0]"),
        ("internal_points: [{x: 1, y: 1}]\nnetwork_lines: []", "internal_points[0].name"),
        ("internal_points: [{name: a, x: 1, y: true}]\nnetwork_lines: []", "internal_points[0].y"),
        ("internal_points: [{name: a, x: 1, y: 1.0e+12}]\nnetwork_lines: []", "internal_points[0]"),
        ("internal_points: [{name: a, x: 1, y: 1, z: up}]\nnetwork_lines: []", "internal_points[0].z"),
        ("internal_points: []\nnetwork_lines: 3", "network_lines"),
        ("internal_points: []\nnetwork_lines: [{start: {x: 1, y: 1}}]", "network_lines[0].end"),
        ("internal_points: []\nnetwork_lines: [[1, 2]]", "network_lines[0]"),
    ],
)
def test_invalid_network_raises_unreadable_file_with_location(text: str, where: str) -> None:
    with pytest.raises(BadUpload) as caught:
        read(text.encode())
    assert [p.where for p in caught.value.problems] == [where]

"""tmap: the older list round-trips, has all keys that its reader uses, and converts to tmap2 and back without loss."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
import yaml

from app import formats
from app.convert.files import offline
from app.errors import UnreadableFile
from app.formats import FileGroup, ReadContext, WriteContext, get_format
from app.limits import Limits
from app.model.features import Features, features
from app.model.layers import Layers, PartKey
from app.upload_reader import EnvironmentContext, UploadHints
from app.upload_reader import read as read_bundle

FORMAT = get_format("tmap")
SAMPLES = Path(__file__).resolve().parents[1] / "samples"
OLD = (SAMPLES / "tmap" / "old.tmap").read_bytes()
NETWORK = PartKey("topology", "ground", "network")
Same = Callable[[str, dict[str, bytes], dict[str, bytes]], list[str]]

NODE_KEYS = {"name", "map", "pointset", "pose", "verts", "edges", "localise_by_topic"}
NODE_KEYS |= {"xy_goal_tolerance", "yaw_goal_tolerance"}
EDGE_KEYS = {"edge_id", "node", "action", "top_vel", "map_2d", "inflation_radius", "recovery_behaviours_config"}
"""topological_navigation's msg/TopologicalNode.msg and msg/Edge.msg."""


def read(data: bytes, name: str = "map.tmap") -> tuple[Layers, ReadContext]:
    context = ReadContext(main=name)
    return formats.read(FileGroup(FORMAT, name, {name: data}), context), context


def write(layers: Layers, **options: Any) -> tuple[bytes, WriteContext]:
    context = WriteContext(options=FORMAT.write_options(**options))
    files = formats.write(FORMAT, layers, context)
    assert list(files) == ["map.tmap"]
    return files["map.tmap"], context


def plain(data: bytes) -> dict[str, Any]:
    """Convert a list to nodes by name and edges by id, with all members, independent of order."""
    out: dict[str, Any] = {}
    for entry in yaml.safe_load(data):
        node = dict(entry["node"])
        edges = {e["edge_id"]: e for e in node.pop("edges")}
        assert len(edges) == len(entry["node"]["edges"])
        assert node["name"] not in out
        out[node["name"]] = {**entry, "node": node, "edges": edges}
    return out


def alike(a: Any, b: Any) -> bool:
    """Compare with positions to a nanometre."""
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(alike(a[k], b[k]) for k in a)
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(alike, a, b))
    if isinstance(a, float) and isinstance(b, float):
        return abs(a - b) <= 1e-9
    return type(a) is type(b) and bool(a == b)


def load_v1(data: bytes) -> list[tuple[Any, ...]]:
    """Read a list as manager.py's load_map_from_file does; KeyError if it would fail."""
    out = []
    for entry in yaml.safe_load(data):
        node = entry["node"]
        at, turned = node["pose"]["position"], node["pose"]["orientation"]
        pose = [float(at[k]) for k in "xyz"] + [float(turned[k]) for k in "xyzw"]
        verts = [(float(v["x"]), float(v["y"])) for v in node["verts"]]
        edges = [(e["edge_id"], e["node"], e["action"], float(e.get("top_vel", 0.55))) for e in node["edges"]]
        tolerances = float(node["yaw_goal_tolerance"]), float(node["xy_goal_tolerance"])
        out.append((node["name"], node["pointset"], pose, verts, edges, *tolerances))
    return out


def drawn() -> Layers:
    """Create a network of another format."""
    rows: list[tuple[str, Any, dict[str, Any]]] = [
        ("a", shapely.Point(1.0, 2.0), {"kind": "node", "name": "Gate"}),
        ("b", shapely.Point(4.0, 6.0), {"kind": "node"}),
        ("a>b", shapely.LineString([(1, 2), (4, 6)]), {"kind": "edge", "source": "a", "target": "b"}),
        ("b>a", shapely.LineString([(4, 6), (1, 2)]), {"kind": "edge", "source": "b", "target": "a"}),
    ]
    rows[2][2]["speed_limit"] = 1.25
    return Layers({NETWORK: features(rows, "local")})


def test_real_list_round_trips(shared: Path, same: Same, facts_json: dict[str, Any]) -> None:
    name = "tmap2/legacy_tmap_bacchus_vines/tmap.tmap"
    data = (shared / "data" / name).read_bytes()
    assert formats.detect("tmap.tmap", data) is FORMAT
    layers, _ = read(data)
    served, context = write(layers)
    assert alike(plain(served), plain(data))
    assert same("tmap2", {"a.tmap": data}, {"b.tmap": served}) == []
    assert context.dropped == []
    assert write(read(served)[0])[0] == served
    facts = facts_json[name]["facts"]
    part = layers.parts[NETWORK]
    assert isinstance(part, Features)
    kinds = [p["kind"] for p in part.properties]
    assert (kinds.count("node"), kinds.count("edge")) == (facts["nodes"], facts["edges_directed"])
    xy = shapely.get_coordinates(part.geometry)
    low, high = np.array(facts["bounds_xyz"])[:, :2]
    assert np.allclose([xy.min(0), xy.max(0)], [low, high], rtol=0, atol=1e-9)
    assert sum(len(node[4]) for node in load_v1(served)) == facts["edges_directed"]


def test_sample_matches_facts() -> None:
    fact = json.loads((SAMPLES / "tmap" / "facts.json").read_text())["old.tmap"]
    layers, context = read(OLD)
    part = layers.parts[NETWORK]
    assert isinstance(part, Features)
    kinds = [p["kind"] for p in part.properties]
    assert (kinds.count("node"), kinds.count("edge")) == (fact["nodes"], fact["edges"])
    assert context.warnings == []
    assert plain(write(layers)[0]) == plain(OLD)


def test_detect_uses_content_and_accepts_tmap2_name() -> None:
    mapping = (SAMPLES / "tmap2" / "orchard.tmap2.yaml").read_bytes()
    for name in ("map.tmap", "map.yaml", "x.tmap2"):
        assert formats.detect(name, OLD) is FORMAT
        assert formats.detect(name, mapping) is get_format("tmap2")
    assert formats.detect("list.txt", OLD) is None
    assert formats.detect("waypoints.yaml", b"- node: WayPoint3\n- node: WayPoint4\n") is None
    for format_name in ("tmap", "tmap2", None):
        bundle = read_bundle({"old.tmap": OLD}, UploadHints(format_name), EnvironmentContext(), Limits())
        assert list(bundle.parts) == [NETWORK]
        assert bundle.files["old.tmap"].format == (format_name or "tmap")


def test_tmap2_takes_precedence_over_tmap() -> None:
    files = {"old.tmap": OLD, "a_rather_long_name.tmap2.yaml": (SAMPLES / "tmap2" / "orchard.tmap2.yaml").read_bytes()}
    bundle = read_bundle(files, UploadHints(), EnvironmentContext(), Limits())
    assert bundle.parts[NETWORK].document["tmap2"]["name"] == "orchard_full"  # type: ignore[union-attr]
    assert not bundle.files["old.tmap"].used


def test_list_round_trips_via_tmap2() -> None:
    tmap2_files = offline({"old.tmap": OLD}, "tmap2").files
    back = offline(dict(tmap2_files), "tmap").files["map.tmap"]
    first, last = plain(OLD), plain(back)
    for name, entry in first.items():
        assert last[name]["meta"] == entry["meta"]
        assert entry["node"].items() <= last[name]["node"].items()
        for i, edge in entry["edges"].items():
            assert edge.items() <= last[name]["edges"][i].items()
    assert load_v1(OLD) == load_v1(back)


def test_tmap2_as_list_keeps_items_and_reports_dropped_top_level() -> None:
    data = (SAMPLES / "tmap2" / "orchard.tmap2.yaml").read_bytes()
    layers = formats.read(FileGroup(get_format("tmap2"), "n.tmap2.yaml", {"n.tmap2.yaml": data}), ReadContext())
    served, context = write(layers)
    assert len(load_v1(served)) == len(yaml.safe_load(data)["nodes"])
    assert any("transformation" in d.why for d in context.dropped)
    assert all(e["node"].keys() >= NODE_KEYS for e in yaml.safe_load(served))
    twice = offline({"map.tmap": served}, "tmap2").files["network.tmap2.yaml"]
    once, now = ({e["node"]["name"]: e["node"] for e in yaml.safe_load(d)["nodes"]} for d in (data, twice))
    assert once.keys() == now.keys()
    for name, node in once.items():
        for key in ("properties", "restrictions_planning", "verts", "name"):
            if key in node:
                want, have = node[key], now[name][key]
                assert want.items() <= have.items() if isinstance(want, dict) else want == have


def test_network_of_other_format_is_filled_in_and_reported() -> None:
    served, context = write(drawn(), pointset="yard", top_vel=0.4, action="go")
    entries = yaml.safe_load(served)
    assert [e["node"]["name"] for e in entries] == ["a", "b"]
    assert entries[0]["meta"] == {"map": "map", "node": "a", "pointset": "yard"}
    assert all(e["node"].keys() >= NODE_KEYS for e in entries)
    assert entries[0]["node"]["properties"] == {"name": "Gate"}
    forward, back = (e["node"]["edges"][0] for e in entries)
    assert forward.keys() >= EDGE_KEYS
    assert (forward["top_vel"], back["top_vel"]) == (1.25, 0.4)
    assert (forward["action"], forward["map_2d"]) == ("go", "map")
    assert load_v1(served)[0][:3] == ("a", "yard", [1.0, 2.0, 0.0, 0.0, 0.0, 0.0, 1.0])
    filled = {t.subject for t in context.template}
    assert {"edges: action", "edges: top_vel", "nodes: verts", "nodes: pose.orientation"} <= filled
    assert "transformation" not in filled
    again, _ = read(served)
    part = again.parts[NETWORK]
    assert isinstance(part, Features)
    assert part.properties[0]["name"] == "Gate"
    assert part.properties[2]["speed_limit"] == 1.25


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"- meta: {}\n  node: 3\n", "node"),
        (b"- node:\n    name: a\n", "pose"),
        (b"- node:\n    name: a\n    edges: 4\n    pose: {position: {x: 1, y: 2}}\n", "edges"),
        (b"- node:\n    name: [a]\n    pose: {position: {x: 1, y: 2}}\n", "name"),
        (b"- node:\n    name: a\n    pose: {position: {x: .nan, y: 2}}\n", ""),
    ],
)
def test_invalid_list_raises_unreadable_file_with_location(data: bytes, reason: str) -> None:
    with pytest.raises(UnreadableFile) as caught:
        read(data)
    assert reason in caught.value.detail
    assert caught.value.problems[0].file == "map.tmap"

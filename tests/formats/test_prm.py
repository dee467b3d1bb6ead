"""prm: pixels of a map's image become metres and back, edges of both directions, lossless round trips."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
import yaml

from app import formats
from app.convert.files import offline
from app.errors import BadUpload, Invalid, UnreadableFile
from app.formats import FileGroup, ReadContext, WriteContext, get_format
from app.limits import Limits
from app.model.features import Features, features
from app.model.grid import OccupancyGrid
from app.model.layers import Layers, PartKey
from app.upload_reader import EnvironmentContext, UploadHints
from app.upload_reader import read as read_bundle

FORMAT = get_format("prm")
SAMPLE = Path(__file__).resolve().parents[1] / "samples" / "prm"
MEADOW = {p.name: p.read_bytes() for p in (SAMPLE / "meadow").iterdir()}
NETWORK = PartKey("topology", "ground", "network")
Edges = set[tuple[str, str]]


def read(files: dict[str, bytes], **options: str) -> tuple[Features, Any]:
    bundle = read_bundle(files, UploadHints(options=options), EnvironmentContext(), Limits())
    part = bundle.parts[NETWORK]
    assert isinstance(part, Features)
    return part, bundle


def write(layers: Layers) -> tuple[dict[str, Any], WriteContext]:
    context = WriteContext()
    files = formats.write(FORMAT, layers, context)
    assert list(files) == ["prm.yaml"]
    return yaml.safe_load(files["prm.yaml"]), context


def nodes(part: Features) -> dict[str, list[float]]:
    pairs = zip(part.ids, part.geometry, part.properties, strict=True)
    return {i: [g.x, g.y] for i, g, p in pairs if p["kind"] == "node"}


def edges(part: Features) -> Edges:
    return {(p["source"], p["target"]) for p in part.properties if p["kind"] == "edge"}


def reference_output(picture: tuple[int, int], count: int) -> tuple[bytes, list[dict[str, Any]], list[dict[str, Any]]]:
    """Output of metric_to_prm.generate_prm: integer pixels, an undirected graph, PyYAML's block style."""
    dice = np.random.default_rng(3)
    at = [(int(dice.integers(picture[0])), int(dice.integers(picture[1]))) for _ in range(count)]
    node_rows = [{"id": k, "x": x, "y": y} for k, (x, y) in enumerate(at)]
    graph = [
        {"from": a, "to": b, "weight": float(math.dist(at[a], at[b]))}
        for a in range(count)
        for b in range(a + 1, count)
        if math.dist(at[a], at[b]) < 60
    ]
    return yaml.dump({"nodes": node_rows, "edges": graph}, sort_keys=False).encode(), node_rows, graph


def test_sample_matches_expected_facts() -> None:
    fact = json.loads((SAMPLE / "facts.json").read_text())["meadow"]
    part, bundle = read(MEADOW)
    assert nodes(part) == fact["nodes"]
    assert len(edges(part)) == fact["edges"]
    assert edges(part) == {("0", "1"), ("1", "0"), ("0", "2"), ("2", "0"), ("1", "2"), ("2", "1")}
    warnings = "\n".join(w.problem for w in bundle.warnings)
    assert "'77'" in warnings
    assert "without lines: 10" in warnings
    assert {k.layer for k in bundle.parts} == {"topology", "occupancy"}
    assert bundle.files["map.pgm"].format == "occupancy_grid"
    assert bundle.origin[NETWORK] == (("prm.yaml",), "prm")


def test_file_of_reference_writer_round_trips() -> None:
    data, node_rows, graph = reference_output((200, 120), 120)
    assert formats.detect("prm_autogen.yaml", data) is FORMAT
    files = {
        "config/topological/prm_autogen.yaml": data,
        "config/metric/map/map.yaml": MEADOW["map.yaml"].replace(b"0.0]", b"0.3]"),
        "config/metric/map/map.pgm": b"P5\n200 120\n255\n" + b"\xfe" * 24000,
        "config/metric/nogo/map.yaml": MEADOW["map.yaml"].replace(b"0.5", b"7.0"),
        "config/metric/nogo/map.pgm": MEADOW["map.pgm"],
    }
    part, _ = read(files)
    # The first node by hand: the centre of its pixel, turned by the yaw about the lower left corner.
    u, v = (node_rows[0]["x"] + 0.5) * 0.5, (120 - node_rows[0]["y"] - 0.5) * 0.5
    x, y = -2.0 + u * math.cos(0.3) - v * math.sin(0.3), 10.0 + u * math.sin(0.3) + v * math.cos(0.3)
    assert np.allclose(nodes(part)["0"], [x, y], rtol=0, atol=1e-9)
    served = offline(files, "prm").files["prm.yaml"]
    back = yaml.safe_load(served)
    assert back["nodes"] == node_rows
    assert all(type(n["x"]) is int for n in back["nodes"])
    assert sorted(back["edges"], key=lambda e: (e["from"], e["to"])) == graph
    assert back["picture"] == {"height": 120, "origin": [-2.0, 10.0, 0.3], "resolution": 0.5}
    assert offline({"prm.yaml": served}, "prm").files["prm.yaml"] == served, "it stands for itself now"


def test_every_key_round_trips() -> None:
    data = b"""seed: 7
nodes:
- {id: b-1, x: 1, y: 2, name: Dock}
- {id: 4, x: 2.5, y: 2}
- {id: 1.5, x: 0, y: 0, tags: [a, {b: null}]}
edges:
- {from: b-1, to: 4, weight: 9, speed_limit: 1.5}
- {from: 4, to: b-1, weight: 2}
- {from: 4, to: 4}
- {from: 1.5, to: b-1, oneway: true, weight: 2}
- {from: 1.5, to: nowhere, weight: 1}
picture: {resolution: 0.1, origin: [0, 0, 0], height: 50}
"""
    part, _ = read({"p.yaml": data})
    assert nodes(part) == {
        "b-1": pytest.approx([0.15, 4.75]),
        "4": pytest.approx([0.3, 4.75]),
        "1.5": pytest.approx([0.05, 4.95]),
    }
    assert [p.get("name") for p in part.properties[:3]] == ["Dock", None, None]
    assert part.properties[3]["speed_limit"] == 1.5
    assert ("1.5", "b-1") in edges(part)
    assert ("b-1", "1.5") not in edges(part)
    once, now = yaml.safe_load(data), yaml.safe_load(offline({"p.yaml": data}, "prm").files["prm.yaml"])
    assert {k: v for k, v in now.items() if k not in ("nodes", "edges")} == {
        k: v for k, v in once.items() if k not in ("nodes", "edges")
    }
    key = str
    assert sorted(now["nodes"], key=key) == sorted(once["nodes"], key=key)
    once["edges"][2]["weight"] = 0.0  # the distance, if the file has none
    assert sorted((sorted(e.items()) for e in now["edges"]), key=key) == sorted(
        (sorted(e.items()) for e in once["edges"]), key=key
    )


WEIGHED = b"""nodes:
- {id: 0, x: 10, y: 10}
- {id: 1, x: 50, y: 10}
- {id: 2, x: 50, y: 40}
edges:
- {from: 0, to: 1, weight: 40.0}
- {from: 1, to: 2, weight: %d}
picture: {resolution: 0.05, origin: [0.0, 0.0, 0.0], height: 100}
"""


@pytest.mark.parametrize("weight", [30, 90])
def test_weights_follow_the_pixels_of_another_map(weight: int) -> None:
    part, _ = read({"prm.yaml": WEIGHED % weight})
    fine = OccupancyGrid(np.zeros((500, 500), np.uint8), 0.01, (0.0, 0.0, 0.0))
    roadmap, context = write(Layers({NETWORK: part, PartKey("occupancy", "ground", "map"): fine}))
    assert [e["weight"] for e in roadmap["edges"]] == [200.0, 5.0 * weight]
    assert [w.problem for w in context.warnings] == (
        [] if weight == 30 else ["1 edges have a weight that is not their length in pixels; it is kept"]
    )


@pytest.mark.parametrize("has_grid", [False, True])
def test_weights_of_each_network_follow_its_own_pixels(has_grid: bool) -> None:
    """Without a grid, the pixels are those of the first network's image, 0.05 m."""
    fine, _ = read({"prm.yaml": WEIGHED % 30})
    coarse = (WEIGHED % 30).replace(b"0.05", b"0.1")
    for node in b"012":
        coarse = re.sub(rb"(id|from|to): %c," % node, rb"\g<1>: 1%c," % node, coarse)
    parts: dict[PartKey, Any] = {PartKey("topology", "L1", "network"): fine}
    parts[PartKey("topology", "L2", "network")] = read({"prm.yaml": coarse})[0]
    if has_grid:
        parts[PartKey("occupancy", "L1", "map")] = OccupancyGrid(np.zeros((500, 500), np.uint8), 0.1, (0.0, 0.0, 0.0))
    roadmap, context = write(Layers(parts))
    assert [e["weight"] for e in roadmap["edges"]] == ([20.0, 15.0, 40.0, 30] if has_grid else [40.0, 30, 80.0, 60.0])
    assert not [w for w in context.warnings if "weight" in w.problem]


def test_weights_of_edges_to_unknown_nodes_are_scaled() -> None:
    part, _ = read({"prm.yaml": (WEIGHED % 30).replace(b"from: 1, to: 2", b"from: 1, to: 9")})
    grid = OccupancyGrid(np.zeros((500, 500), np.uint8), 0.01, (0.0, 0.0, 0.0))
    roadmap, _ = write(Layers({NETWORK: part, PartKey("occupancy", "ground", "map"): grid}))
    assert roadmap["edges"][1] == {"from": 1, "to": 9, "weight": 150.0}


def test_weight_of_moved_node_is_reported() -> None:
    part, _ = read({"prm.yaml": WEIGHED % 30})
    roadmap, context = write(Layers({NETWORK: part}))
    assert context.warnings == []
    geometry = part.geometry.copy()
    geometry[0] = shapely.Point(geometry[0].x - 0.5, geometry[0].y)
    roadmap, context = write(Layers({NETWORK: replace(part, geometry=geometry)}))
    assert [e["weight"] for e in roadmap["edges"]] == [40.0, 30]
    assert "1 edges have a weight that is not their length" in context.warnings[0].problem


def test_network_of_another_format_gets_pixels_of_stored_map() -> None:
    rows: list[tuple[str, Any, dict[str, Any]]] = [
        ("gate", shapely.Point(1.01, 2.0), {"kind": "node", "orientation": [0, 0, 0, 1]}),
        ("0", shapely.Point(3.0, 4.0), {"kind": "node", "name": "Barn"}),
        ("e1", shapely.LineString([(1, 2), (3, 4)]), {"kind": "edge", "source": "gate", "target": "0"}),
    ]
    network = features(rows, "local")
    grid = OccupancyGrid(np.zeros((100, 80), np.uint8), 0.1, (-1.0, -2.0, 0.0))
    layers = Layers({NETWORK: network, PartKey("occupancy", "ground", "map"): grid})
    roadmap, context = write(layers)
    assert roadmap["nodes"] == [
        {"id": 0, "x": 40, "y": 39, "name": "Barn"},
        {"id": 1, "x": 20, "y": 59, "name": "gate"},
    ]
    assert roadmap["edges"] == [{"from": 1, "to": 0, "weight": round(math.hypot(20, 20), 9), "oneway": True}]
    assert any("one-way" in w.problem for w in context.warnings)
    assert {d.subject: d.count for d in context.dropped} == {
        "positions of nodes within their pixels": 2,
        "attributes of nodes": 1,
    }
    assert [t.subject for t in context.template] == ["edges: weight"]
    alone, context = write(Layers({NETWORK: network}))
    assert alone["picture"] == {"resolution": 0.05, "origin": [0.0, 1.0, 0.0], "height": 80}
    assert "picture: resolution, origin, height" in [t.subject for t in context.template]
    coarse = WriteContext(options=formats.write_options(FORMAT, {"pixel_size": 0.5}))
    coarse_roadmap = yaml.safe_load(formats.write(FORMAT, Layers({NETWORK: network}), coarse)["prm.yaml"])
    assert coarse_roadmap["picture"] == {"resolution": 0.5, "origin": [0.0, 1.0, 0.0], "height": 8}
    assert [t.option for t in coarse.template if t.option] == ["pixel_size"]
    again, _ = read({"prm.yaml": yaml.safe_dump(alone).encode()})
    assert np.allclose(nodes(again)["0"], [3.0, 4.0], atol=0.05)


def test_roadmap_without_map_reports_what_to_supply() -> None:
    alone = {"prm.yaml": MEADOW["prm.yaml"]}
    with pytest.raises(UnreadableFile, match=r"add that map.*resolution, origin and height"):
        read(alone)
    roadmap, _ = read(alone, resolution="0.5", origin="-2,10,0", height="6")
    assert nodes(roadmap) == nodes(read(MEADOW)[0])
    with pytest.raises(Invalid):
        read(alone, resolution="0.5", height="0")


def test_tmap2_takes_precedence_over_roadmap_in_template() -> None:
    tmap2 = (SAMPLE.parent / "tmap2" / "orchard.tmap2.yaml").read_bytes()
    files = {"config/topological/network.tmap2.yaml": tmap2, "config/topological/prm_autogen.yaml": MEADOW["prm.yaml"]}
    bundle = read_bundle(files, UploadHints(), EnvironmentContext(), Limits())
    assert not bundle.files["config/topological/prm_autogen.yaml"].used
    assert any("richer tmap2" in w.problem for w in bundle.warnings)


@pytest.mark.parametrize(
    ("text", "where"),
    [
        ("nodes: 3\nedges: []", "nodes"),
        ("nodes:\n- 4\nedges: []", "nodes[0]"),
        ("nodes:\n- {id: 1, x: 1}\nedges: []", "nodes[0].y"),
        ("nodes:\n- {id: 1, x: a, y: 1}\nedges: []", "nodes[0].x"),
        ("nodes:\n- {id: [1], x: 1, y: 1}\nedges: []", "nodes[0].id"),
        ("nodes:\n- {id: 1, x: 1.0e+300, y: 1}\nedges: []", "nodes[0]"),
        ("nodes:\n- {id: 1, x: 1, y: 1}\nedges: 3", "edges"),
        ("nodes:\n- {id: 1, x: 1, y: 1}\nedges:\n- {from: 1}", "edges[0].to"),
        ("nodes:\n- {id: 1, x: 1, y: 1}\nedges:\n- {from: 1, to: 1, weight: heavy}", "edges[0].weight"),
        ("nodes:\n- {id: 1, x: 1, y: 1}\nedges: []\npicture: {height: 0}", "picture.origin"),
        ("nodes:\n- {id: 1, x: 1, y: 1}\nedges: []\npicture: {height: true, origin: [0, 0, 0]}", "picture.height"),
    ],
)
def test_invalid_values_are_refused_with_location(text: str, where: str) -> None:
    with pytest.raises(BadUpload) as caught:
        formats.read(FileGroup(FORMAT, "prm.yaml", {**MEADOW, "prm.yaml": text.encode()}), ReadContext())
    assert [p.where for p in caught.value.problems] == [where]


@pytest.mark.parametrize(("image", "path"), [("img/map.pgm", "img/map.pgm"), ("/home/me/map.pgm", "map.pgm")])
def test_map_is_found_with_its_image_in_a_folder(image: str, path: str) -> None:
    roadmap = b"nodes:\n- {id: 0, x: 1, y: 1}\n- {id: 1, x: 2, y: 1}\nedges:\n- {from: 0, to: 1, weight: 1.0}\n"
    grid = "resolution: 0.5\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    files = {"site/prm.yaml": roadmap, "site/map.yaml": f"image: {image}\n{grid}".encode()}
    picture = b"P5\n4 3\n255\n" + bytes(12)
    taller = b"P5\n4 9\n255\n" + bytes(36)
    files |= {f"site/{path}": picture, "site/other/map.pgm": taller}
    bundle = read_bundle(files, UploadHints(), EnvironmentContext(), Limits())
    part = bundle.parts[NETWORK]
    assert isinstance(part, Features)
    assert nodes(part)["0"] == pytest.approx([0.75, 0.75])

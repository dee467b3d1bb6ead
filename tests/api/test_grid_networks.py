"""A grid alone gives networks, over HTTP and the command line, with correct reports."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import networkx as nx
import pytest
import yaml

from app.derive import _kernels_roadmap, _kernels_skeleton, _kernels_space
from tests.api.conftest import Api
from tests.preloaded import run_preloaded

HERE = "environment_template/riseholme_park_farm_strawberry_polytunnels/config/metric/map"
DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / HERE


@pytest.fixture(scope="module", autouse=True)
def compiled() -> None:
    """Use the user's directory of native code, which the confined workers can read."""
    for kernels in (_kernels_space, _kernels_skeleton, _kernels_roadmap):
        kernels.compile_all()


@pytest.fixture(scope="module")
def files() -> dict[str, bytes]:
    if not DATA.is_dir():
        pytest.skip("the real maps are not beside the checkout")
    return {name: (DATA / name).read_bytes() for name in ("map.yaml", "map.png")}


def network_in(text: bytes) -> nx.DiGraph:
    g = nx.DiGraph()
    for entry in yaml.load(text, yaml.CSafeLoader)["nodes"]:
        node = entry["node"]
        g.add_node(node["name"], at=(node["pose"]["position"]["x"], node["pose"]["position"]["y"]))
        g.add_edges_from((node["name"], e["node"]) for e in node["edges"])
    return g


def test_real_grid_alone_gives_networks(api: Api, files: dict[str, bytes]) -> None:
    api.post("environments", {"name": "polytunnels"})
    api.upload("polytunnels", files)
    table: dict[str, Any] = {r["format"]: r for r in api.get("environments/polytunnels/versions/1/maps").json()}
    for name in ("tmap2", "nav2_route", "navgraph", "lif", "tmap"):
        assert table[name]["state"] == "derivable", table[name]
        assert [s["step"] for s in table[name]["chain"]] == ["occupancy_to_topology"]
    assert table["tmap2"]["chain"][0]["parameters"]["robot_radius"] == 0.3
    plain = network_in(api.get("/maps/polytunnels/tmap2").content)
    assert 400 < len(plain) < 1000
    assert max(map(len, nx.weakly_connected_components(plain))) > 0.95 * len(plain)
    wide = network_in(api.get("/maps/polytunnels/tmap2?robot_radius=0.7").content)
    assert 100 < len(wide) < len(plain)
    sparse = network_in(api.get("/maps/polytunnels/tmap2?spacing=0&reach=0").content)
    assert 400 < len(sparse) < 0.95 * len(plain)
    random = network_in(api.get("/maps/polytunnels/tmap2?method=roadmap&samples=500&seed=3").content)
    assert 300 < len(random) < 1000
    report = api.get("environments/polytunnels/versions/1/reports/tmap2?robot_radius=0.7").json()
    (line,) = [entry for entry in report["layers"] if entry["layer"] == "topology"]
    assert line["information"] == "derived"
    assert set(line["sources"]) == set(files)
    assert line["steps"][0]["step"] == "occupancy_to_topology"
    assert line["steps"][0]["parameters"]["robot_radius"] == 0.7
    assert line["steps"][0]["parameters"]["method"] == "skeleton"
    route = json.loads(api.get("/maps/polytunnels/nav2_route?spacing=3").content)
    assert {f["geometry"]["type"] for f in route["features"]} >= {"Point"}
    assert api.get("/maps/polytunnels/navgraph?spacing=3").content.count(b"pos:") > 100
    assert api.get("/maps/polytunnels/tmap2?samples=7", expect=None).status_code == 422
    answer = api.get("/maps/polytunnels/tmap2?robot_radius=60", expect=None)
    assert answer.status_code == 422
    assert "use a robot_radius below" in answer.json()["detail"]
    assert api.get("/maps/polytunnels/tmap2?derive=false", expect=None).status_code == 422


def test_command_line_derives_the_same_networks(files: dict[str, bytes], tmp_path: Path) -> None:
    for name, data in files.items():
        (tmp_path / name).write_bytes(data)
    out = tmp_path / "network.tmap2.yaml"
    arguments = ["convert", "map.yaml", "map.png", "--to", "tmap2", "-o", str(out), "-O", "robot_radius=0.7"]
    process = run_preloaded(arguments, env=os.environ, cwd=tmp_path)
    assert process.returncode == 0, process.stdout
    assert 100 < len(network_in(out.read_bytes())) < 2000


def test_blank_grid_is_refused_with_advice(api: Api) -> None:
    api.post("environments", {"name": "meadow"})
    described = (
        b"image: map.pgm\nresolution: 0.5\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    )
    api.upload("meadow", {"map.yaml": described, "map.pgm": b"P5 40 30 255\n" + b"\xfe" * 1200})
    answer = api.get("/maps/meadow/tmap2", expect=None)
    assert answer.status_code == 422
    assert "completely free" in answer.json()["detail"]
    table: dict[str, Any] = {r["format"]: r for r in api.get("environments/meadow/versions/1/maps").json()}
    assert table["tmap2"]["state"] == "missing"
    assert any("completely free" in text for text in table["tmap2"]["missing"])

"""Every command against a running server: what it does, what it prints, how it fails."""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import urllib.request
import zipfile
from pathlib import Path

import pytest

from app.cli import demo
from tests.cli.conftest import TOKEN, Fleetmap

NETWORK = """
meta: {{last_updated: 2024-05-01_10-00-00}}
metric_map: farm
name: farm
pointset: farm
transformation:
  child: topo_map
  parent: map
  rotation: {{w: 1.0, x: 0.0, y: 0.0, z: 0.0}}
  translation: {{x: 0.0, y: 0.0, z: 0.0}}
nodes:
- meta: {{map: farm, node: A, pointset: farm}}
  node:
    name: A
    parent_frame: map
    pose: {{orientation: {{w: 1.0, x: 0.0, y: 0.0, z: 0.0}}, position: {{x: {x}, y: 0.0, z: 0.0}}}}
    properties: {{xy_goal_tolerance: 0.3, yaw_goal_tolerance: 0.1}}
    edges:
    - {{action: move_base, edge_id: A_B, node: B, restrictions_planning: obstacleFree_1}}
    verts: []
- meta: {{map: farm, node: B, pointset: farm}}
  node:
    name: B
    parent_frame: map
    pose: {{orientation: {{w: 1.0, x: 0.0, y: 0.0, z: 0.0}}, position: {{x: 5.0, y: 2.0, z: 0.0}}}}
    edges: []
    verts: []
"""


@pytest.fixture
def network(tmp_path: Path) -> Path:
    path = tmp_path / "network.tmap2.yaml"
    path.write_text(NETWORK.format(x="1.0"))
    return path


def history(fleetmap: Fleetmap, network: Path, name: str) -> None:
    """An environment with versions 1 and 2; node A moves in the second."""
    assert fleetmap("import", network, "-e", name, "-m", "first").status == 0
    network.write_text(NETWORK.format(x="1.5"))
    assert fleetmap("import", network, "-e", name, "-m", "moved A").status == 0


def test_versions_diff_promote_and_revert(fleetmap: Fleetmap, network: Path, tmp_path: Path) -> None:
    history(fleetmap, network, "story")
    rows = fleetmap("versions", "story", "--json").json
    assert [(row["version"], row["message"]) for row in rows][:2] == [(2, "moved A"), (1, "first")]

    output = fleetmap("diff", "story", "1", "2").out
    assert "~ topology A: " in output
    assert "B" not in {line.split()[2] for line in output.splitlines() if line.startswith("~ topology")}

    assert fleetmap("promote", "story", "1").status == 0
    assert "production" in fleetmap("versions", "story").out
    out = tmp_path / "robot.yaml"
    assert fleetmap("export", "story", "tmap2", "-o", out).status == 0
    assert "x: 1.0" in out.read_text(), "robots get what production stands on"
    assert fleetmap("export", "story", "tmap2", "-o", out, "--version", "latest").status == 0
    assert "x: 1.5" in out.read_text()

    assert fleetmap("revert", "story", "production").status == 0
    roots = {row["version"]: row["root"] for row in fleetmap("versions", "story", "--json").json}
    assert roots[3] == roots[1] != roots[2]
    assert "have the same content" in fleetmap("diff", "story", "1", "3").out
    assert len(fleetmap("versions", "story", "-n", "2", "--json").json) == 2


def test_show_writes_a_picture(fleetmap: Fleetmap, network: Path, tmp_path: Path) -> None:
    from PIL import Image

    history(fleetmap, network, "drawn")
    out = tmp_path / "drawn.png"
    assert fleetmap("show", "drawn", "-o", out, "--theme", "dark", "--width", "300").out.strip() == str(out)
    picture = Image.open(out)
    assert picture.width == 300
    assert picture.getpixel((0, 0)) == (20, 23, 27)  # the background of the dark theme
    assert fleetmap("show", "drawn", "-o", out, "--layers", "imagery").status == 1


def test_all_environments_are_listed(fleetmap: Fleetmap, network: Path) -> None:
    assert fleetmap("import", network, "-e", "listed-farm").status == 0
    rows = {row["name"]: row for row in fleetmap("versions", "--json").json}
    assert rows["listed-farm"]["version"] == 1
    assert "listed-farm" in fleetmap("versions", "--limit", "100").out
    assert len(fleetmap("versions", "--limit", "1", "--json").json) == 1


def test_where_lists_environments_at_position(fleetmap: Fleetmap, network: Path) -> None:
    assert fleetmap("import", network, "-e", "south-field", "--datum", "-33.9,18.4").status == 0
    result = fleetmap("where", "-33.9,18.40002")
    assert result.status == 0, result.err
    assert "south-field" in result.out
    assert "mapped floor" in result.out
    result = fleetmap("where", "-33.9,18.40002", "--json")
    (environment,) = result.json
    assert (environment["name"], environment["match"]["by"], result.status) == ("south-field", "floor", 0)
    assert environment["match"]["distance_m"] == pytest.approx(1.8, abs=0.1)
    nowhere = fleetmap("where", "33.9,18.4")
    assert (nowhere.status, nowhere.out) == (1, "")
    assert "no environment contains 33.9,18.4" in nowhere.err
    nowhere = fleetmap("where", "33.9,18.4", "--json")
    assert (nowhere.status, nowhere.json) == (1, [])
    for bad in ("91,0", "nan,0", "north", "1"):
        wrong = fleetmap("where", bad)
        assert wrong.status == 1
        assert "LAT,LON" in wrong.err
    assert fleetmap("where").status == 2


def test_planned_promotion_waits(fleetmap: Fleetmap, network: Path) -> None:
    history(fleetmap, network, "planned")
    result = fleetmap("promote", "planned", "2", "--channel", "staging", "--at", "2099-01-31T06:00:00Z", "--json")
    assert result.status == 0, result.err
    assert result.json["planned"]["version"] == 2
    assert "staging" not in fleetmap("versions", "planned").out
    past = fleetmap("promote", "planned", "2", "--at", "2001-01-31T06:00:00Z")
    assert past.status == 1
    assert "past" in past.err


def test_promotion_in_two_stages_is_planned_and_cancelled(fleetmap: Fleetmap, network: Path) -> None:
    history(fleetmap, network, "staged")
    result = fleetmap(
        "promote", "staged", "1", "--ready", "0.9", "--failed", "0.2", "--deadline", "2099-01-31T06:00:00Z"
    )
    assert (
        result.out.strip() == "staged: production will point to version 1 when 0.9 of its online robots have fetched it"
    )
    body = fleetmap("promote", "staged", "1", "--ready", "0.9", "--window", "60", "--json").json
    assert body["version"] is None
    assert (body["rollout"]["state"], body["rollout"]["ready"], body["rollout"]["window"]) == ("waiting", 0.9, 60.0)
    assert "cancelled the planned move" in fleetmap("promote", "staged", "--cancel").out
    assert fleetmap("promote", "staged", "--cancel").status == 1, "there is nothing to cancel any more"
    assert fleetmap("promote", "staged", "--cancel", "--ready", "0.5").status == 2
    assert fleetmap("promote", "staged", "1").out.strip() == "staged: production points to version 1"
    assert "is rolled back" in fleetmap("promote", "staged", "2", "--failed", "0.2").out
    alone = fleetmap("promote", "staged", "2", "--window", "60")
    assert alone.status == 1
    assert "ready, failed" in alone.err


def test_import_sets_grid_name_and_merge_deletes_nothing(fleetmap: Fleetmap, network: Path, tmp_path: Path) -> None:
    assert fleetmap("import", network, "-e", "merged").status == 0
    (tmp_path / "mask.yaml").write_text(
        "image: mask.pgm\nresolution: 0.5\norigin: [0, 0, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.2\n"
    )
    (tmp_path / "mask.pgm").write_bytes(b"P5 2 2 255\n" + bytes([0, 254, 205, 254]))
    files = (tmp_path / "mask.yaml", tmp_path / "mask.pgm")
    result = fleetmap("import", *files, "-e", "merged", "--grid", "keepout", "--mode", "merge")
    assert result.status == 0, result.err
    assert fleetmap("export", "merged", "occupancy_grid", "-o", f"{tmp_path}/out/").status == 0
    written = {p.name for p in (tmp_path / "out").iterdir()}
    assert written == {"keepout.yaml", "keepout.pgm", "keepout_filter_info.yaml"}
    only = fleetmap("export", "merged", "occupancy_grid", "--file", "keepout.yaml", "-o", tmp_path / "one.yaml")
    assert only.status == 0, only.err
    assert (tmp_path / "one.yaml").read_bytes() == (tmp_path / "out" / "keepout.yaml").read_bytes()
    network.write_text(network.read_text().replace("name: B", "name: C").replace("node: B", "node: C"))
    assert fleetmap("import", network, "-e", "merged", "--mode", "merge").status == 0
    assert fleetmap("export", "merged", "tmap2", "-o", tmp_path / "all.yaml").status == 0
    text = (tmp_path / "all.yaml").read_text()
    assert all(f"name: {node}" in text for node in "ABC")


def test_export_writes_complete_site(fleetmap: Fleetmap, tmp_path: Path) -> None:
    assert fleetmap("generate", "office", "--seed", "7", "-e", "tower").status == 0
    folder = tmp_path / "site"
    options = ("-O", "level=*", "-O", "grid=*")
    written = fleetmap("export", "tower", "occupancy_grid", *options, "-o", f"{folder}/", "--json").json
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    assert {"map.yaml", "map.pgm", "L2/map.yaml", "L2/map.pgm", "speed.yaml", "L2/speed_filter_info.yaml"} <= names
    assert {Path(path).relative_to(folder).as_posix() for path in written["files"]} == names
    lines = {(line["level"], line["name"]) for line in written["report"]["layers"] if line["layer"] == "occupancy"}
    assert lines == {("ground", "map"), ("L2", "map"), ("ground", "speed"), ("L2", "speed")}
    assert fleetmap("export", "tower", "occupancy_grid", *options, "-o", tmp_path / "site.zip").status == 0
    with zipfile.ZipFile(tmp_path / "site.zip") as archive:
        assert set(archive.namelist()) == names
    one = tmp_path / "one.yaml"
    assert fleetmap("export", "tower", "occupancy_grid", "--file", "L2/map.yaml", "-o", one).status == 0
    assert one.read_bytes() == (folder / "L2" / "map.yaml").read_bytes()


def test_dry_run_stores_nothing(fleetmap: Fleetmap, network: Path) -> None:
    refused = fleetmap("import", network, "-e", "rehearsal", "--dry-run")
    assert refused.status == 1
    assert "does not create it" in refused.err
    assert fleetmap("import", network, "-e", "rehearsal").status == 0
    network.write_text(NETWORK.format(x="9.0"))
    result = fleetmap("import", network, "-e", "rehearsal", "--dry-run")
    assert result.status == 0, result.err
    assert "topology: 2 changed" in result.out, "the node and the edge that starts at it"
    assert fleetmap("versions", "rehearsal", "--json").json[0]["version"] == 1
    assert fleetmap("import", network, "-e", "rehearsal").status == 0
    derived = fleetmap("derive", "rehearsal", "topology_to_occupancy", "--dry-run")
    assert derived.status == 0, derived.err
    assert derived.out.startswith("rehearsal: this would create a version\n  occupancy: map (")
    generated = fleetmap("generate", "orchard", "-e", "rehearsal", "--replace", "--dry-run")
    assert "\n  occupancy: map (" in generated.out, generated.err
    assert fleetmap("generate", "orchard", "--to", "kml", "-o", "-", "--dry-run").status == 2
    assert fleetmap("generate", "orchard", "-e", "nowhere", "--dry-run").status == 1
    reverted = fleetmap("revert", "rehearsal", "1", "--dry-run")
    assert reverted.out == "rehearsal: this would create a version\n  topology: 2 changed\n"
    assert fleetmap("revert", "rehearsal", "2", "--dry-run").out == "rehearsal: this would change nothing\n"
    assert fleetmap("revert", "rehearsal", "1", "--dry-run", "--json").json["id"].startswith("dry:")
    assert fleetmap("versions", "rehearsal", "--json").json[0]["version"] == 2


def test_damaged_file_is_refused_with_its_position(fleetmap: Fleetmap, tmp_path: Path) -> None:
    bad = tmp_path / "bad.tmap2.yaml"
    bad.write_text("meta: {}\nnodes:\n- node: {name: A\n")
    result = fleetmap("import", bad, "-e", "damaged", "-f", "tmap2")
    assert result.status == 1
    assert "bad.tmap2.yaml:" in result.err
    assert "Traceback" not in result.err
    problem = json.loads(fleetmap("import", bad, "-e", "damaged", "-f", "tmap2", "--json").err)
    assert problem["status"] == 422
    assert problem["errors"][0]["file"] == "bad.tmap2.yaml"
    assert "unknown environment" in fleetmap("environment", "show", "damaged").err, "nothing is left behind"
    assert fleetmap("import", bad.with_name("network.tmap2.yaml"), "-e", "damaged").status == 1


def test_offline_problem_equals_server_problem(offline: Fleetmap, tmp_path: Path) -> None:
    bad = tmp_path / "bad.tmap2.yaml"
    bad.write_text("meta: {}\nnodes:\n- node: {name: A\n")
    result = offline("convert", bad, "--format", "tmap2", "--to", "geojson", "-o", tmp_path / "out.geojson")
    assert result.status == 1
    assert "bad.tmap2.yaml:" in result.err
    assert not (tmp_path / "out.geojson").exists()


def test_import_sets_datum_of_new_environment(fleetmap: Fleetmap, network: Path, tmp_path: Path) -> None:
    assert fleetmap("import", network, "-e", "placed", "--datum", "52.5,5.5,30").status == 0
    out = tmp_path / "datum.yaml"
    assert fleetmap("export", "placed", "datum", "-o", out).status == 0
    assert "52.5" in out.read_text()
    result = fleetmap("import", network, "-e", "placed", "--datum", "91,0")
    assert result.status == 1
    assert "latitude" in result.err


def test_coverage_and_formats(fleetmap: Fleetmap, network: Path) -> None:
    assert fleetmap("import", network, "-e", "covered").status == 0
    rows = {row["format"]: row["state"] for row in fleetmap("coverage", "covered", "--json").json}
    assert rows["tmap2"] == "direct"
    assert rows["occupancy_grid"] == "derivable"
    assert rows["datum"] == "missing"
    output = fleetmap("coverage", "covered").out
    assert "tmap2" in output
    formats = {f["id"]: f for f in fleetmap("formats", "--json").json}
    assert {"datum", "geojson", "kml", "kmz", "occupancy_grid", "osm", "tmap2"} <= set(formats)
    assert "resolution" in {o["name"] for o in formats["occupancy_grid"]["options"]}


def test_parameters_of_generators_have_types_units_defaults_and_bounds(offline: Fleetmap) -> None:
    result = offline("generate", "orchard", "--parameters")
    assert result.status == 0
    lines = {line.split()[0]: " ".join(line.split()) for line in result.out.splitlines() if line}
    assert lines["row_spacing"] == "row_spacing number, 1 to 30 m distance between rows; default: from the seed, 3 to 5"
    docks = "docks whole number, 1 to 20 number of charging docks in the yard; default: from the seed, 1 to 4"
    assert lines["docks"] == docks
    described = {p["name"]: p for p in offline("generate", "orchard", "--parameters", "--json").json["parameters"]}
    assert described.keys() <= lines.keys()
    assert described["docks"]["schema"] == {"type": "integer", "minimum": 1, "maximum": 20}
    assert "did you mean orchard?" in offline("generate", "orchrd", "--parameters").err


def test_token_create_list_link_and_delete(fleetmap: Fleetmap, server: str, network: Path) -> None:
    assert fleetmap("import", network, "-e", "guarded").status == 0
    token = fleetmap("token", "create", "field robot", "--role", "viewer", "--environments", "guard*", "--json").json
    assert fleetmap("versions", "guarded", "--token", token["token"]).status == 0
    denied = fleetmap("revert", "guarded", "1", "--token", token["token"])
    assert denied.status == 1
    assert "error:" in denied.err
    listed = fleetmap("token", "list", "--json")
    assert token["id"] in {row["id"] for row in listed.json}
    assert token["token"] not in listed.out
    assert "ended" in fleetmap("token", "list").out.splitlines()[0].split()
    link = fleetmap("token", "link", token["id"])
    assert re.fullmatch(rf"{server}/#sign-in=[\w-]{{22}}\n", link.out), link.out
    assert set(fleetmap("token", "link", token["id"], "--json").json) == {"code", "path", "expires", "url"}
    assert fleetmap("token", "link", "nosuch").status == 1
    assert fleetmap("token", "delete", token["id"]).status == 0
    result = fleetmap("versions", "guarded", "--token", token["token"])
    assert result.status == 1
    assert "--token" in result.err


def test_link_gives_a_map_without_a_token(fleetmap: Fleetmap, network: Path) -> None:
    history(fleetmap, network, "linked")
    assert fleetmap("promote", "linked", "1").status == 0
    result = fleetmap("link", "linked", "tmap2", "network.tmap2.yaml", "--seconds", "600")
    assert result.status == 0
    assert "network.tmap2.yaml of version 1, without a token until" in result.err
    with urllib.request.urlopen(result.out.strip()) as answer:
        assert b"edge_id" in answer.read()
    newest = fleetmap("link", "linked", "tmap2", "-V", "latest", "--json").json
    assert (newest["version"], newest["name"]) == (2, "network.tmap2.yaml")
    with urllib.request.urlopen(newest["url"]) as answer:
        assert len(answer.read()) == newest["size"]
    for wrong in (("nonsense",), ("tmap2", "other.yaml"), ("tmap2", "--seconds", "99999999")):
        refused = fleetmap("link", "linked", *wrong)
        assert (refused.status, refused.out) == (1, "")
        assert "error:" in refused.err


def test_robot_token_names_its_robot(fleetmap: Fleetmap) -> None:
    assert fleetmap("token", "create", "mower-9", "--role", "robot", "--json").json["robot"] == "mower-9"
    result = fleetmap("token", "create", "the red one", "--role", "robot", "--robot", "mower-9")
    assert (result.status, "reports the status of robot mower-9" in result.err) == (0, True)
    for wrong in (("the red one", "--role", "robot"), ("x", "--role", "robot", "--robot", "a b")):
        refused = fleetmap("token", "create", *wrong)
        assert (refused.status, refused.out) == (1, "")
        assert "--robot" in refused.err


def test_usage_errors_have_their_own_status(fleetmap: Fleetmap, network: Path, tmp_path: Path) -> None:
    assert fleetmap("import", network).status == 2
    assert fleetmap("export", "story", "kml", "-o", "-", "--json").status == 2
    assert fleetmap("nonsense").status == 2
    absent = fleetmap("import", tmp_path / "absent", "-e", "x")
    assert absent.status == 1
    assert f"no file or folder '{tmp_path}/absent'" in absent.err
    assert "--environment" not in absent.err
    missing = fleetmap("versions", "no-such-place")
    assert missing.status == 1
    assert "List all with" in missing.err
    named = fleetmap("import", network, "-e", "My Farm")
    assert named.status == 1
    assert "try my-farm" in named.err


def test_import_with_environment_as_argument_proposes_its_option(fleetmap: Fleetmap, network: Path) -> None:
    assert fleetmap("environment", "create", "strawberry").status == 0
    mistaken = fleetmap("import", "strawberry", network)
    assert mistaken.status == 1
    assert "no file or folder 'strawberry': set an environment with --environment strawberry" in mistaken.err


def test_unknown_parameter_is_refused(fleetmap: Fleetmap, network: Path, tmp_path: Path) -> None:
    assert fleetmap("import", network, "-e", "opted").status == 0
    for result in (
        fleetmap("export", "opted", "tmap2", "-o", tmp_path / "x", "-O", "colour=red"),
        fleetmap("convert", network, "--to", "tmap2", "-o", tmp_path / "x", "-O", "colour=red"),
        fleetmap("import", network, "-e", "opted", "-O", "colour=red"),
    ):
        assert result.status == 1
        assert "colour" in result.err
    assert not (tmp_path / "x").exists()


def test_demo_is_installed_once_and_its_commands_work(fleetmap: Fleetmap, server: str, tmp_path: Path) -> None:
    if shutil.which("curl") is None:
        (pytest.fail if os.environ.get("CI") else pytest.skip)("curl is not installed")
    first = fleetmap("demo", "--json").json
    assert first == {"environment": demo.NAME, "version": 1, "created": True}
    assert fleetmap("demo", "--json").json == {**first, "created": False}
    version = fleetmap("versions", demo.NAME, "--json").json[0]
    assert version["warnings"] == []
    layers = {layer for layer, kind in version["information"].items() if kind != "missing"}
    assert layers == {"location", "objects", "topology", "occupancy", "zones", "imagery"}
    assert len(demo.curl_lines(server, TOKEN)) == 3
    for line in demo.curl_lines(server, TOKEN):
        done = subprocess.run(
            [*shlex.split(line), "--fail", "--silent", "--show-error"],
            cwd=tmp_path,
            capture_output=True,
            timeout=60,
            check=False,
        )
        assert done.returncode == 0, done.stderr.decode()
    assert demo.NAME in {e["name"] for e in json.loads(run_curl(demo.curl_lines(server, TOKEN)[0]))}
    assert (tmp_path / f"{demo.NAME}.kml").read_bytes().startswith(b"<?xml")


def run_curl(line: str) -> bytes:
    return subprocess.run([*shlex.split(line), "--silent"], capture_output=True, timeout=60, check=True).stdout


def test_light_install_converts_without_the_packages_of_the_server(tmp_path: Path) -> None:
    """``[convert]`` has no numba, OpenCV, SciPy, SQLAlchemy, FastAPI or pydantic."""
    script = (
        "import sys\n"
        "for name in ('numba', 'cv2', 'scipy', 'sqlalchemy', 'geoalchemy2', 'fastapi', 'uvicorn', 'pydantic'):\n"
        "    sys.modules[name] = None\n"
        "from app.cli import run\n"
        "sys.exit(run(sys.argv[1:]))\n"
    )
    root = Path(__file__).resolve().parents[2]
    network = root / "tests/samples/tmap2/orchard.tmap2.yaml"
    command = [sys.executable, "-c", script, "convert", str(network), "--to", "geojson", "-o", str(tmp_path / "a.json")]
    done = subprocess.run(command, capture_output=True, text=True, cwd=root)
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "a.json").read_text())["features"]

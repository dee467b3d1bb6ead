"""``fleetmap check``: the consumers' rules on files on disk, without a server."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from app.cli.companions import with_companions
from app.cli.folder import single
from tests.cli.conftest import Fleetmap

YAML = "image: {image}\nresolution: 0.05\norigin: [0, 0, {yaw}]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"


def a_map(folder: Path, image: str = "map.pgm", yaw: float = 0.0) -> Path:
    path = folder / "map.yaml"
    path.write_text(YAML.format(image=image, yaw=yaw))
    (folder / "map.pgm").write_bytes(b"P5 2 2 255\n" + bytes([0, 254, 205, 254]))
    return path


def test_check_accepts_valid_map(offline: Fleetmap, tmp_path: Path) -> None:
    a_map(tmp_path)
    result = offline("check", tmp_path)
    assert result.status == 0, result.err
    assert "map.yaml (occupancy_grid): no problems" in result.out


def test_check_reports_warnings_and_succeeds(offline: Fleetmap, tmp_path: Path) -> None:
    a_map(tmp_path, yaw=0.5)
    result = offline("check", tmp_path)
    assert result.status == 0
    assert "warning: map.yaml: origin: " in result.out


def test_check_fails_for_map_that_nav2_rejects(offline: Fleetmap, tmp_path: Path) -> None:
    path = a_map(tmp_path, image="other.pgm")
    result = offline("check", path, tmp_path / "map.pgm")
    assert result.status == 1
    assert "map.yaml (occupancy_grid): would be rejected" in result.out
    assert "error: map.yaml: image: " in result.out
    answer = offline("check", path, tmp_path / "map.pgm", "--json")
    assert answer.status == 1
    (line,) = answer.json["maps"]
    assert (line["format"], line["file"], line["result"]) == ("occupancy_grid", "map.yaml", "error")
    assert [(f["level"], f["where"]) for f in line["findings"]] == [("error", "image")]
    assert answer.json["unknown"] == ["map.pgm"]


def test_each_map_of_a_folder_is_checked(offline: Fleetmap, tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        a_map(tmp_path / name, image="map.pgm" if name == "a" else "gone.pgm")
    result = offline("check", tmp_path, "--json")
    assert result.status == 1
    assert {line["file"]: line["result"] for line in result.json["maps"]} == {
        "a/map.yaml": "fine",
        "b/map.yaml": "error",
    }


def test_check_reports_files_that_are_not_maps(offline: Fleetmap, tmp_path: Path) -> None:
    (tmp_path / "note.txt").write_text("nothing here")
    result = offline("check", tmp_path / "note.txt")
    assert result.status == 1
    assert "no file has a recognised map format" in result.err
    named = offline("check", tmp_path / "note.txt", "--format", "nav2_route")
    assert named.status == 1
    assert "would be rejected" in named.out


def test_check_reads_image_beside_named_file(offline: Fleetmap, tmp_path: Path) -> None:
    folder = tmp_path / "maps"
    folder.mkdir()
    path = a_map(folder, image="/home/somebody/map.pgm")
    (tmp_path / "map.pgm").write_bytes(b"P5 1 1 255\n\0")
    result = offline("check", path, "--json")
    assert [(line["file"], line["result"]) for line in result.json["maps"]] == [("map.yaml", "warning")]
    a_map(folder)
    result = offline("check", path, "--json")
    assert (result.status, result.json["maps"][0]["result"], result.json["unknown"]) == (0, "fine", [])
    out = tmp_path / "out"
    result = offline("convert", path, "--to", "occupancy_grid", "-o", f"{out}/")
    assert result.status == 0, result.err
    assert (out / "map.pgm").read_bytes().endswith(bytes([0, 254, 205, 254]))


def test_files_outside_of_a_maps_folder_are_not_read(offline: Fleetmap, tmp_path: Path) -> None:
    folder = tmp_path / "maps"
    folder.mkdir()
    (tmp_path / "other.pgm").write_bytes(b"P5 2 2 255\n" + bytes(4))
    (folder / "linked.pgm").symlink_to(tmp_path / "other.pgm")
    for image in ("../other.pgm", str(tmp_path / "other.pgm"), "linked.pgm"):
        result = offline("convert", a_map(folder, image=image), "--to", "occupancy_grid", "-o", "-")
        assert result.status == 1, image
        assert "is not in the upload" in result.err


WORLD = """<sdf version="1.9"><world name="w"><include><uri>model://crate</uri></include></world></sdf>"""
MODEL = """<sdf version="1.9"><model name="crate"><static>true</static><link name="l"><collision name="c">
<geometry><box><size>1 1 1</size></box></geometry></collision></link></model></sdf>"""
CONFIG = """<model><name>crate</name><sdf version="1.9">model.sdf</sdf></model>"""


def test_companions_are_those_of_the_format(shared: Path, tmp_path: Path) -> None:
    """A building's floor plans, a world's models below it, a picture's world file; nothing else of the folder."""
    crate = tmp_path / "models" / "crate"
    crate.mkdir(parents=True)
    (tmp_path / "w.world").write_text(WORLD)
    (crate / "model.sdf").write_text(MODEL)
    (crate / "model.config").write_text(CONFIG)
    Image.fromarray(np.zeros((2, 2, 3), np.uint8)).save(tmp_path / "field.png")
    (tmp_path / "field.pgw").write_text("1\n0\n0\n-1\n0\n0\n")
    (tmp_path / "other.pgw").write_text("1\n0\n0\n-1\n0\n0\n")
    hotel = shared / "data" / "openrmf_building" / "hotel" / "hotel.building.yaml"
    expected = {
        tmp_path / "w.world": {"models/crate/model.sdf", "models/crate/model.config"},
        tmp_path / "field.png": {"field.pgw"},
        tmp_path / "field.pgw": {"field.png"},
        hotel: {f"hotel_L{n}.png" for n in (1, 2, 3)},
    }
    for path, names in expected.items():
        files = with_companions([single(path)])
        assert {f.name for f in files} == {path.name} | names
    named = with_companions([single(tmp_path / "field.png"), single(tmp_path / "other.pgw", "field.pgw")])
    assert [f.path.name for f in named] == ["field.png", "other.pgw"], "what the user names stays"


def test_unknown_generator_option_lists_accepted_ones(offline: Fleetmap, tmp_path: Path) -> None:
    result = offline("generate", "orchard", "--to", "tmap2", "-o", tmp_path / "n.yaml", "-O", "typo=1")
    assert result.status == 1
    assert "typo: unknown parameter of orchard: use one of angle, cross_aisles," in result.err
    assert "tmap2 accepts action," in result.err

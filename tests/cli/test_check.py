"""``fleetmap check``: the consumers' rules on files on disk, without a server."""

from __future__ import annotations

from pathlib import Path

from tests.cli.conftest import Fleetmap

YAML = "image: {image}\nresolution: 0.05\norigin: [0, 0, {yaw}]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"


def a_map(folder: Path, image: str = "map.pgm", yaw: float = 0.0) -> Path:
    path = folder / "map.yaml"
    path.write_text(YAML.format(image=image, yaw=yaw))
    (folder / "map.pgm").write_bytes(b"P5 2 2 255\n" + bytes([0, 254, 205, 254]))
    return path


def test_a_good_map_passes(offline: Fleetmap, tmp_path: Path) -> None:
    a_map(tmp_path)
    told = offline("check", tmp_path)
    assert told.status == 0, told.err
    assert "map.yaml (occupancy_grid): nothing to complain of" in told.out


def test_doubts_are_told_and_pass(offline: Fleetmap, tmp_path: Path) -> None:
    a_map(tmp_path, yaw=0.5)
    told = offline("check", tmp_path)
    assert told.status == 0
    assert "warning: map.yaml: origin: " in told.out


def test_a_map_that_nav2_would_refuse_fails(offline: Fleetmap, tmp_path: Path) -> None:
    path = a_map(tmp_path, image="other.pgm")
    told = offline("check", path, tmp_path / "map.pgm")
    assert told.status == 1
    assert "map.yaml (occupancy_grid): would be refused" in told.out
    assert "error: map.yaml: image: " in told.out
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
    told = offline("check", tmp_path, "--json")
    assert told.status == 1
    assert {line["file"]: line["result"] for line in told.json["maps"]} == {"a/map.yaml": "fine", "b/map.yaml": "error"}


def test_what_is_no_map_is_said(offline: Fleetmap, tmp_path: Path) -> None:
    (tmp_path / "note.txt").write_text("nothing here")
    told = offline("check", tmp_path / "note.txt")
    assert told.status == 1
    assert "none of the files is a map" in told.err
    named = offline("check", tmp_path / "note.txt", "--format", "nav2_route")
    assert named.status == 1
    assert "would be refused" in named.out


def test_the_picture_beside_a_named_file_is_read(offline: Fleetmap, tmp_path: Path) -> None:
    folder = tmp_path / "maps"
    folder.mkdir()
    path = a_map(folder, image="/home/somebody/map.pgm")
    (tmp_path / "map.pgm").write_bytes(b"P5 1 1 255\n\0")
    told = offline("check", path, "--json")
    assert [(line["file"], line["result"]) for line in told.json["maps"]] == [("map.yaml", "warning")]
    a_map(folder)
    told = offline("check", path, "--json")
    assert (told.status, told.json["maps"][0]["result"], told.json["unknown"]) == (0, "fine", [])
    out = tmp_path / "out"
    told = offline("convert", path, "--to", "occupancy_grid", "-o", f"{out}/")
    assert told.status == 0, told.err
    assert (out / "map.pgm").read_bytes().endswith(bytes([0, 254, 205, 254]))


def test_files_outside_of_a_maps_folder_are_not_read(offline: Fleetmap, tmp_path: Path) -> None:
    folder = tmp_path / "maps"
    folder.mkdir()
    (tmp_path / "other.pgm").write_bytes(b"P5 2 2 255\n" + bytes(4))
    (folder / "linked.pgm").symlink_to(tmp_path / "other.pgm")
    for image in ("../other.pgm", str(tmp_path / "other.pgm"), "linked.pgm"):
        told = offline("convert", a_map(folder, image=image), "--to", "occupancy_grid", "-o", "-")
        assert told.status == 1, image
        assert "is not in the upload" in told.err


def test_companions_of_all_formats(offline: Fleetmap, shared: Path, tmp_path: Path) -> None:
    """What is named alone gives the map that its folder gives."""
    data = shared / "data"
    named = {
        "openrmf_building/robast_sim/robast_sim.building.yaml": "openrmf",
        "gazebo_sdf/environment_common_test_files/test.world": "gazebo",
        "lanelet2/autoware_mgrs_mini/lanelet2_map.osm": "lanelet2",
    }
    for name, form in named.items():
        told = offline("check", data / name, "--json")
        assert [line["format"] for line in told.json["maps"]] == [form], told.out

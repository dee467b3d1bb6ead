"""``fleetmap align`` against a running server, and which derivations are listed."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from tests.api.test_alignments import files, piece_files
from tests.cli.conftest import Fleetmap


@pytest.fixture(scope="module")
def maps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("maps")
    for name, origin in (("map", [-3.0, 2.0, 0.0]), ("other", [4.0, -1.0, 0.3])):
        for file, data in files(name, origin).items():
            (folder / file).write_bytes(data)
    return folder


def hall(fleetmap: Fleetmap, maps: Path, name: str) -> None:
    for grid in ("map", "other"):
        result = fleetmap("import", maps / f"{grid}.yaml", maps / f"{grid}.png", "-e", name, "--grid", grid)
        assert result.status == 0, result.err


def test_align_moves_grid_onto_another(fleetmap: Fleetmap, maps: Path) -> None:
    hall(fleetmap, maps, "halls")
    result = fleetmap("align", "halls", "map", "--grid", "other", "--dry-run")
    assert result.status == 0, result.err
    assert "halls: ground/other turned by -17." in result.out
    assert "residual 0.0" in result.out
    assert "agreement 100.0%" in result.out
    assert "origin (4.000, -1.000, 17.189°) → (-3.0" in result.out
    assert "nothing is stored" in result.out
    body = fleetmap("align", "halls", "map", "--grid", "other", "-m", "by its walls", "--json").json
    assert body["version"]["message"] == "by its walls"
    assert body["alignment"]["yaw"] == pytest.approx(-0.3, abs=math.radians(0.2))
    assert body["alignment"]["residual"] < 0.1
    assert body["alignment"]["origin"][:2] == pytest.approx([-3.0, 2.0], abs=0.05)
    again = fleetmap("align", "halls", "map", "--grid", "other")
    assert again.status == 0
    assert "turned by 0.0" in again.out.replace("-0.0", "0.0"), "it lies there already"
    assert "only the grid moves" in again.err


def test_align_by_points(fleetmap: Fleetmap, maps: Path) -> None:
    hall(fleetmap, maps, "points")
    pairs = ("--pair", "4,-1=0,0", "--pair", "5,-1=1,0", "--pair", "4,3=0,4", "--pair", "0,0=9,9")
    result = fleetmap("align", "points", "--grid", "other", *pairs)
    assert result.status == 0, result.err
    assert "moved by -4.000, 1.000 m" in result.out
    assert "1 pairs disagree" in result.err
    refused = fleetmap("align", "points", "--grid", "other", *pairs, "--least", "0.9")
    assert refused.status == 1
    assert "do not fit" in refused.err


def test_align_onto_objects_and_invalid_options(fleetmap: Fleetmap, maps: Path, tmp_path: Path) -> None:
    hall(fleetmap, maps, "sliced")
    lines = ["[-3,2.05],[9,2.05]", "[-3,9.95],[9,9.95]", "[-2.95,2],[-2.95,10]", "[8.95,2],[8.95,10]",
             "[1.05,2],[1.05,7]", "[1,7.05],[4,7.05]"]  # fmt: skip
    walls = [
        {
            "type": "Feature",
            "properties": {"kind": "wall"},
            "geometry": None,
            "place": {"type": "LineString", "coordinates": json.loads(f"[{line}]")},
        }
        for line in lines
    ]
    crs = "http://www.opengis.net/def/crs/OGC/0/Engineering2D"
    (tmp_path / "walls.geojson").write_text(
        json.dumps({"type": "FeatureCollection", "coordRefSys": crs, "features": walls})
    )
    assert fleetmap("import", tmp_path / "walls.geojson", "-e", "sliced").status == 0
    slice_ = ("objects", "--grid", "other", "-O", "resolution=0.1", "--near", "0.15", "--dry-run")
    result = fleetmap("align", "sliced", *slice_, "--json")
    assert result.json["alignment"]["origin"] == pytest.approx([-3.0, 2.0, 0.0], abs=0.1)
    assert fleetmap("align", "sliced", *slice_, "-O", "colour=1").status == 1
    for wrong, says in (
        ((), "missing reference"),
        (("map", "--pair", "0,0=1,1"), "or --pair"),
        (("map", "-O", "height=1"), "grids have no parameters"),
        (("--pair", "0,0=1,1", "-O", "height=1"), "cannot be combined with --pair"),
        (("map", "--angle", "400"), "0<=x<=180"),
    ):
        refused = fleetmap("align", "sliced", *wrong)
        assert refused.status == 2, wrong
        assert says in " ".join(refused.err.replace("│", " ").split()), wrong
    for text in ("0,0", "0,0=1", "a,b=c,d", "0,0=nan,1", "0,0=1,1=2,2"):
        refused = fleetmap("align", "sliced", "--pair", text)
        assert refused.status == 1
        assert "--pair must" in refused.err
    assert "available: " in fleetmap("align", "sliced", "map", "--grid", "moon").err


def test_derive_lists_derivations_of_server(
    fleetmap: Fleetmap, offline: Fleetmap, monkeypatch: pytest.MonkeyPatch
) -> None:
    listed = fleetmap("derive", "--json")
    assert listed.status == 0
    assert "location_to_imagery" not in {row["id"] for row in listed.json}, "this server has no provider"
    assert "location_to_imagery" not in listed.err
    monkeypatch.setattr("app.cli.client.MAX_ATTEMPTS", 1)
    absent = fleetmap("derive", "--json", "--server", "http://127.0.0.1:9")
    assert absent.json == listed.json
    assert "no response from http://127.0.0.1:9" in absent.err
    assert "location_to_imagery" in absent.err
    monkeypatch.delenv("FLEETMAP_SERVER")
    alone = offline("derive")
    assert "occupancy_to_topology" in alone.out
    assert "no server set" in alone.err
    monkeypatch.setenv("FLEETMAP_TOKEN", "wrong")
    assert fleetmap("derive", "--server", "http://127.0.0.1:9").status == 0


def test_align_merges_grids(fleetmap: Fleetmap, tmp_path: Path) -> None:
    for name, view in (("one", (-3.0, 3.5, 10.0)), ("two", (0.5, 9.0, 80.0))):
        for file, data in piece_files(name, view).items():
            (tmp_path / file).write_bytes(data)
        paths = (tmp_path / f"{name}.yaml", tmp_path / f"{name}.png")
        assert fleetmap("import", *paths, "-e", "crew", "--grid", name).status == 0
    preview = fleetmap("align", "crew", "--merge", "one", "two", "--name", "site", "--dry-run")
    assert preview.status == 0, preview.err
    assert "crew: ground/two turned by 70." in preview.out.replace("turned by 69.", "turned by 70.")
    assert "m of walls in common" in preview.out
    assert "nothing is stored" in preview.out
    pose = ("--pose", "two=4.4,-0.8,75", "--angle", "10", "--reach", "1")
    body = fleetmap("align", "crew", "--merge", "one", "two", *pose, "--seam", "newest", "--drop", "--json").json
    assert math.degrees(body["merge"]["grids"][1]["yaw"]) == pytest.approx(70, abs=0.5)
    assert body["merge"]["name"] == "one"
    for wrong, says in (
        (("--merge", "one"), "at least two grids"),
        (("--merge", "one", "two", "--grid", "one"), "cannot be combined with --merge"),
        (("one", "two"), "--merge to merge grids"),
        (("one", "--drop"), "require --merge"),
    ):
        refused = fleetmap("align", "crew", *wrong)
        assert refused.status == 2, wrong
        assert says in " ".join(refused.err.replace("│", " ").split()), wrong
    for option in (("--pose", "two=1,2"), ("--pair", "0,0=1,1")):
        refused = fleetmap("align", "crew", "--merge", "one", "two", *option)
        assert refused.status == 1
        assert f"{option[0]} must be" in refused.err

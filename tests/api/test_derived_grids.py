"""A town, a building or a fence alone gives a grid and an octree, over HTTP, with a correct report."""

from __future__ import annotations

import io
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from PIL import Image

from app.convert import files as direct
from app.errors import MissingLayer
from tests.api.conftest import Api, parts
from tests.worlds import CRATE, WALLS, house

TOWN = b"""<osm version="0.6">
<node id="1" lat="52.0" lon="10.0"/><node id="2" lat="52.0" lon="10.0001"/><node id="3" lat="52.0001" lon="10.0001"/>
<node id="4" lat="52.0001" lon="10.0"/><node id="5" lat="52.0002" lon="10.0003"><tag k="natural" v="tree"/></node>
<way id="9"><nd ref="1"/><nd ref="2"/><nd ref="3"/><nd ref="4"/><nd ref="1"/><tag k="building" v="yes"/></way>
<way id="8"><nd ref="1"/><nd ref="2"/><tag k="highway" v="footway"/></way>
</osm>"""

FENCE = b"""datum_latitude: 52.0
datum_longitude: 10.0
gnss_fence:
  gnss_fence_coords: [[52.0, 10.0], [52.0, 10.0002], [52.0002, 10.0002], [52.0002, 10.0]]
"""


def fetch_grid(api: Api, env: str, query: str = "") -> tuple[Any, dict[str, Any]]:
    """Return (cells as grey values, top row first; content of the YAML)."""
    answer = api.get(f"environments/{env}/versions/latest/maps/occupancy_grid{query}")
    with zipfile.ZipFile(io.BytesIO(answer.content)) as z:
        map_yaml = yaml.safe_load(z.read("map.yaml"))
        return np.asarray(Image.open(io.BytesIO(z.read(map_yaml["image"])))), map_yaml


def fetch_report(api: Api, env: str, query: str = "") -> dict[str, Any]:
    report: dict[str, Any] = api.get(f"environments/{env}/versions/latest/reports/occupancy_grid{query}").json()
    return report


def test_town_alone_gives_a_grid(api: Api) -> None:
    api.post("environments", {"name": "hamlet"})
    api.upload("hamlet", {"map.osm": TOWN})
    rows = {row["format"]: row for row in api.get("environments/hamlet/versions/latest/maps").json()}
    assert rows["occupancy_grid"]["state"] == "derivable"
    assert [s["step"] for s in rows["occupancy_grid"]["chain"]] == ["objects_to_occupancy"]
    assert rows["octomap"]["state"] == "derivable"
    grey, map_yaml = fetch_grid(api, "hamlet")
    assert map_yaml["resolution"] == 0.05
    assert (grey == 0).sum() * 0.05**2 == pytest.approx(6.864 * 11.127, rel=0.03), "a house of 6.86 m × 11.13 m"
    report = fetch_report(api, "hamlet")
    line = next(line for line in report["layers"] if line["layer"] == "occupancy")
    assert line["information"] == "derived"
    assert line["sources"] == ["map.osm"]
    assert line["steps"][0]["step"] == "objects_to_occupancy"
    _, coarse = fetch_grid(api, "hamlet", "?resolution=0.5&inflate=1")
    assert coarse["resolution"] == 0.5
    assert api.get("/maps/hamlet/octomap").content.startswith(b"# Octomap OcTree binary file")
    for wrong in ("?resolution=0.0001", "?band=3,1", "?height=1&band=0,1", "?height=-5", "?doors=ajar"):
        problem: Any = api.get(f"/maps/hamlet/occupancy_grid{wrong}", expect=None)
        assert problem.status_code == 422, (wrong, problem.text)
        assert problem.json()["detail"]


def test_fence_gives_a_blank_grid_and_bounds_derived_grids(api: Api) -> None:
    api.post("environments", {"name": "paddock"})
    api.upload("paddock", {"datum.yaml": FENCE})
    grey, _ = fetch_grid(api, "paddock")
    assert set(np.unique(grey)) <= {205, 254}
    assert any("grid is empty" in w["problem"] for w in fetch_report(api, "paddock")["warnings"])
    api.upload("paddock", {"map.osm": TOWN})
    grey, map_yaml = fetch_grid(api, "paddock")
    assert map_yaml["origin"] == [0, 0, 0]
    assert (grey.shape[1] * 0.05, grey.shape[0] * 0.05) == (
        pytest.approx(13.73, abs=0.1),
        pytest.approx(22.25, abs=0.1),
    )
    assert (grey == 0).sum() > 10_000
    line = next(line for line in fetch_report(api, "paddock")["layers"] if line["layer"] == "occupancy")
    assert sorted(line["sources"]) == ["datum.yaml", "map.osm"]


def test_derived_grid_is_stale_after_upload_of_a_fence(api: Api) -> None:
    api.post("environments", {"name": "yard"})
    api.upload("yard", {"map.osm": TOWN})
    body = {"method": "objects_to_occupancy", "parameters": {"resolution": 0.1}}
    made_ = api.post("environments/yard/derivations", body, expect=201).json()
    assert made_["information"]["occupancy"] == "derived"
    assert made_["stale"] == []
    fence = b"""<kml xmlns="http://www.opengis.net/kml/2.2"><Document><Placemark><Polygon><outerBoundaryIs><LinearRing>
<coordinates>10,52 10.0001,52 10.0001,52.0001 10,52.0001 10,52</coordinates></LinearRing></outerBoundaryIs></Polygon>
</Placemark></Document></kml>"""
    head = api.upload("yard", {"fence.kml": fence}, layer="location").json()
    assert [(s["layer"], s["changed"]) for s in head["stale"]] == [("occupancy", ["location ground/site"])]
    _, map_yaml = fetch_grid(api, "yard")
    assert map_yaml["resolution"] == 0.1, (
        "maps are derived from the current inputs, with the parameters of the stored grid"
    )
    report = next(line for line in fetch_report(api, "yard")["layers"] if line["layer"] == "occupancy")
    assert sorted(report["sources"]) == ["fence.kml", "map.osm"]
    assert report["steps"][0]["also"] == ["location", "resources"]


def test_server_and_offline_conversion_give_equal_cells(api: Api) -> None:
    """This covers a world whose walls are a mesh, beside a box, with the mesh and without it."""
    api.post("environments", {"name": "house"})
    files = {**house(WALLS, CRATE), "datum.yaml": FENCE}
    api.upload("house", files)
    grey, _ = fetch_grid(api, "house")
    assert (grey == 0).sum() > 400, "a quarter of the house is in the fence"
    alone = direct.offline(files, "occupancy_grid")
    assert np.array_equal(np.asarray(Image.open(io.BytesIO(alone.files["map.pgm"]))), grey)
    posted = api("POST", "convert", 200, files=parts(files), data={"to": "occupancy_grid"})
    with zipfile.ZipFile(io.BytesIO(posted.content)) as z:
        assert z.read("map.pgm") == alone.files["map.pgm"]
    # Without the mesh only the crate is known, and its surroundings are unknown: the fence gives no blank grid either.
    api.post("environments", {"name": "ruin"})
    for extra in ((), (CRATE,)):
        lost = {**house(None, *extra), "datum.yaml": FENCE}
        api.upload("ruin", lost)
        if not extra:
            problem: Any = api.problem("GET", "environments/ruin/versions/latest/maps/occupancy_grid", 422)
            assert "walls.stl is missing: upload it" in problem["detail"]
            with pytest.raises(MissingLayer, match=r"walls\.stl is missing: upload it"):
                direct.offline(lost, "occupancy_grid")
            rows = {r["format"]: r for r in api.get("environments/ruin/versions/latest/maps").json()}
            assert rows["occupancy_grid"]["state"] == "missing"
            assert "walls.stl" in str(rows["occupancy_grid"]["missing"])
    grey, _ = fetch_grid(api, "ruin")
    assert np.array_equal(
        grey, np.asarray(Image.open(io.BytesIO(direct.offline(lost, "occupancy_grid").files["map.pgm"])))
    )
    assert (grey == 205).sum() * 0.05**2 > 0.2 * math.pi * 5.0**2, (
        "a quarter of the disc around the house is in the fence"
    )
    assert any("house" in w["problem"] and "walls.stl" in w["problem"] for w in fetch_report(api, "ruin")["warnings"])


def test_fallback_derivation_adds_a_warning(api: Api) -> None:
    """Applies if the objects' solids are unreadable and a network is stored, on the server and offline."""
    path = TOWN[: TOWN.index(b'<way id="9"')] + TOWN[TOWN.index(b'<way id="8"') :]
    files = {**house(None), "map.osm": path.replace(b"natural", b"note"), "datum.yaml": FENCE}
    api.post("environments", {"name": "lane"})
    api.upload("lane", files)
    fetch_grid(api, "lane")
    for report in (fetch_report(api, "lane"), direct.offline(files, "occupancy_grid").report.as_dict()):
        line = next(line for line in report["layers"] if line["layer"] == "occupancy")
        assert [s["step"] for s in line["steps"]] == ["topology_to_occupancy"]
        (warning,) = [w["problem"] for w in report["warnings"] if w["problem"].endswith("another derivation was used")]
        assert "objects_to_occupancy failed" in warning
        assert "walls.stl is missing" in warning


def test_regions_without_obstacles_give_no_grid(api: Api) -> None:
    api.post("environments", {"name": "sketch"})
    square = [[0.001, 0], [0.002, 0], [0.002, 0.001], [0.001, 0]]
    drawing = {
        "type": "FeatureCollection",
        "features": [{"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [square]}}],
    }
    import json

    api.upload("sketch", {"a.geojson": json.dumps(drawing).encode()})
    refused: Any = api.get("/maps/sketch/occupancy_grid", expect=None)
    assert refused.status_code == 422
    assert "is an obstacle" in refused.json()["detail"]


def test_real_buildings_and_towns_give_grids(api: Api, shared: Path) -> None:
    data = shared / "data"
    buildings = ("hotel/hotel.building.yaml", "office/office.building.yaml", "robast_sim/tiplu.building.yaml")
    for name, path in {
        **{b.split("/")[0].replace("_", "-"): data / "openrmf_building" / b for b in buildings},
        "netherlands": data / "osm/urban-netherlands-subburbs/osm.xml",
    }.items():
        api.post("environments", {"name": name})
        api.upload(name, {path.name: path.read_bytes()})
        level = "?level=L2" if name == "hotel" else ""
        if name == "netherlands":  # nothing encloses a town
            level = "?outside_free=true&resolution=0.2"
            grey, _ = fetch_grid(api, name, "?resolution=0.2")
            assert (grey == 254).sum() < 0.01 * (grey == 205).sum()
        grey, _ = fetch_grid(api, name, level)
        assert (grey == 0).sum() > 1000
        assert (grey == 254).sum() > 10_000


def test_world_alone_gives_a_slice(api: Api, shared: Path) -> None:
    root = shared / "data/gazebo_sdf/turtlebot3_world"
    files = [p for p in root.rglob("*") if p.is_file() and "maps" not in p.parts]
    api.post("environments", {"name": "arena"})
    api.upload("arena", {p.relative_to(root).as_posix(): p.read_bytes() for p in files})
    grey, map_yaml = fetch_grid(api, "arena", "?height=0.18")
    low, _ = (np.argwhere(grey[::-1] == 0).min(axis=0) * 0.05 + map_yaml["origin"][1::-1]).tolist()
    assert low == pytest.approx(-3.3985, abs=0.05), "the slice that facts.json counts"
    line = next(line for line in fetch_report(api, "arena", "?height=0.18")["layers"] if line["layer"] == "occupancy")
    assert line["steps"][0]["parameters"]["height"] == 0.18
    assert any(name.endswith("wall.dae") for name in line["sources"])
    dropped = {d["what"]: d["why"] for d in fetch_report(api, "arena")["dropped"]}
    assert dropped["objects include"] == "not an obstacle for robots", "the ground plane, which is on another server"
    assert api.get("/maps/arena/octomap?resolution=0.2").content.startswith(b"# Octomap")
    problem: Any = api.get("/maps/arena/occupancy_grid?height=20", expect=None)
    assert problem.status_code == 422
    assert "the solids reach from" in problem.json()["detail"]

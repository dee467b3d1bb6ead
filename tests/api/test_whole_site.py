"""All levels, named parts and drawn masks of a format: over HTTP, and in manifests."""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest
import yaml
from PIL import Image

from app.convert import site
from tests.api import samples
from tests.api.conftest import Api, running, settings_for

ODD_LEVELS = ("map.yaml", "a/b", "..", "Étage 2", "L2 ", "50%", "a%2Fb", "x?y#z", "con:1", "*", "k" * 256, "k" * 255)


def zone(name: str, kind: str, value: Any = None, *, x: float = 0.0) -> dict[str, Any]:
    ring = [[x, -1.0], [x + 1.0, -1.0], [x + 1.0, 0.0], [x, 0.0], [x, -1.0]]
    properties = {"kind": kind} | ({} if value is None else {"value": value})
    geometry = {"type": "Polygon", "coordinates": [ring]}
    return {"type": "Feature", "id": name, "properties": properties, "geometry": geometry}


def draw(api: Api, env: str, *features: dict[str, Any], level: str = "ground") -> None:
    """Zones on a level, in local metres."""
    placed = [{**f, "properties": {**f["properties"], "level": level}} for f in features]
    collection = {
        "type": "FeatureCollection",
        "coordRefSys": "https://www.opengis.net/def/crs/OGC/0/Engineering",
        "features": placed,
    }
    api.upload(env, {"zones.geojson": json.dumps(collection).encode()}, layer="zones", level=level, format="geojson")


def listed(api: Api, env: str, formats: str, *, version: str = "latest", optional: str = "") -> dict[str, Any]:
    more = {"optional": optional} if optional else {}
    answer = api.get(f"environments/{env}/versions/{version}/manifest", params={"formats": formats, **more})
    body: dict[str, Any] = answer.json()
    return body


def names_of(body: dict[str, Any], fmt: str = "occupancy_grid") -> list[str]:
    return [f["name"] for f in body["files"] if f["format"] == fmt]


def check_files(api: Api, env: str, body: dict[str, Any], query: str = "") -> None:
    """Check that each file of a manifest can be downloaded by its name, with the signed hash."""
    for file in body["files"]:
        path = f"environments/{env}/versions/{body['version']}/maps/{file['format']}/{quote(file['name'])}{query}"
        got = api.get(path).content
        assert hashlib.sha256(got).hexdigest() == file["sha256"], file
        assert len(got) == file["size"]


def unzipped(content: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


@pytest.fixture(scope="module")
def office(api: Api) -> str:
    """Generate an office with two levels and zones on both."""
    api.post("environments", {"name": "office-7"})
    api.post("environments/office-7/generations", {"generator": "office", "seed": 7})
    return "office-7"


@pytest.fixture(scope="module")
def polytunnels(api: Api) -> str:
    """Generate a farm with keepouts and speed limits drawn as zones."""
    api.post("environments", {"name": "polytunnels-7"})
    api.post("environments/polytunnels-7/generations", {"generator": "polytunnels", "seed": 7})
    return "polytunnels-7"


@pytest.fixture
def house(api: Api, fresh: Callable[[], str]) -> str:
    """Create grids on two levels: map and nav on the ground, map on L2."""
    name = fresh()
    api.post("environments", {"name": name})
    api.upload(name, samples.grid())
    api.upload(name, samples.grid(width=10), grid="nav")
    api.upload(name, samples.grid(width=12), level="L2")
    return name


def test_manifest_lists_both_levels_and_masks_of_office(api: Api, office: str) -> None:
    body = listed(api, office, "occupancy_grid,satellite,tmap2")
    assert [level["name"] for level in body["levels"]] == ["ground", "L2"]
    assert body["levels"][1]["elevation"] > 2.0
    files = {f"{f['format']}/{f['name']}": f.get("level") for f in body["files"]}
    for stem in ("map.yaml", "map.pgm", "speed.yaml", "speed.pgm", "speed_filter_info.yaml"):
        assert files[f"occupancy_grid/{stem}"] == "ground"
        assert files[f"occupancy_grid/L2/{stem}"] == "L2"
    assert (files["satellite/satellite.tif"], files["satellite/L2/satellite.tif"]) == ("ground", "L2")
    assert files["tmap2/network.tmap2.yaml"] is None
    assert "missing" not in body
    check_files(api, office, body)


def test_reupload_of_a_package_keeps_the_root(
    api: Api, office: str, polytunnels: str, fresh: Callable[[], str], shared: Path
) -> None:
    template = shared / "data" / "environment_template" / "riseholme_park_farm_vineyard"
    real = fresh()
    api.post("environments", {"name": real})
    api.upload(real, {p.relative_to(template).as_posix(): p.read_bytes() for p in template.rglob("*") if p.is_file()})
    for name in (office, polytunnels, real):
        package = api.get(f"environments/{name}/versions/latest/maps/environment").content
        copy = fresh()
        api.post("environments", {"name": copy})
        version = api.upload(copy, {"environment.zip": package}).json()
        before = api.get(f"environments/{name}/versions/latest").json()
        assert version["root"] == before["root"]
        assert version["warnings"] == []
        for env in (name, copy):
            network = yaml.safe_load(api.get(f"/maps/{env}/tmap2/network.tmap2.yaml").content)
            names = {network[key] for key in ("name", "metric_map", "pointset")}
            assert names == {env} if name != real else "riseholme" in network["name"], "an uploaded mask keeps its own"


def test_manifest_lists_drawn_masks_of_polytunnels(api: Api, polytunnels: str) -> None:
    body = listed(api, polytunnels, "occupancy_grid")
    assert {"map.pgm", "keepout.pgm", "keepout_filter_info.yaml", "speed.pgm"} <= set(names_of(body))
    check_files(api, polytunnels, body)
    alone = unzipped(api.get(f"/maps/{polytunnels}/occupancy_grid?grid=keepout").content)
    site_files = unzipped(api.get(f"/maps/{polytunnels}/occupancy_grid?level=*&grid=*").content)
    assert alone == {name: site_files[name] for name in alone}
    grey = np.asarray(Image.open(io.BytesIO(site_files["keepout.pgm"])))
    assert (grey == 0).any(), "keepouts are drawn"


def test_zip_has_the_files_of_the_manifest(api: Api, office: str) -> None:
    files = unzipped(api.get(f"/maps/{office}/occupancy_grid?level=*&grid=*").content)
    body = listed(api, office, "occupancy_grid")
    hashes = {f["name"]: f["sha256"] for f in body["files"]}
    assert hashes == {name: hashlib.sha256(data).hexdigest() for name, data in files.items()}
    for name, data in files.items():
        if name.endswith("map.yaml"):
            assert yaml.safe_load(data)["image"] == "map.pgm", "beside its YAML"
    response = api.get(f"/maps/{office}/occupancy_grid?level=*&grid=*")
    again = api.get(
        f"/maps/{office}/occupancy_grid?level=*&grid=*", expect=304, headers={"if-none-match": response.headers["etag"]}
    )
    assert again.headers["fleetmap-root"] == response.headers["fleetmap-root"]


@pytest.mark.parametrize(
    ("query", "expected"),
    [
        ("level=*", {"map.yaml", "L2/map.yaml"}),
        ("grid=*", {"map.yaml", "nav.yaml"}),
        ("level=*&grid=*", {"map.yaml", "nav.yaml", "L2/map.yaml"}),
        ("level=L2&grid=*", {"L2/map.yaml"}),
        ("level=*&grid=nav", {"nav.yaml"}),
        ("level=*&grid=*&file_type=png", {"map.yaml", "nav.yaml", "L2/map.yaml"}),
    ],
)
def test_stars_select_levels_and_grids(api: Api, house: str, query: str, expected: set[str]) -> None:
    files = unzipped(api.get(f"/maps/{house}/occupancy_grid?{query}").content)
    assert {name for name in files if name.endswith(".yaml")} == expected
    assert {name.rpartition(".")[2] for name in files} == {"yaml", "png" if "png" in query else "pgm"}


def test_url_without_parameters_gives_the_default_map(api: Api, house: str) -> None:
    files = unzipped(api.get(f"/maps/{house}/occupancy_grid").content)
    assert set(files) == {"map.yaml", "map.pgm"}
    assert unzipped(api.get(f"/maps/{house}/occupancy_grid?level=L2").content)["map.pgm"][:7] == b"P5\n12 6"


def test_files_are_fetched_below_the_folder_of_their_level(api: Api, house: str) -> None:
    for query in ("", "?level=*&grid=*", "?level=L2"):
        got = api.get(f"/maps/{house}/occupancy_grid/L2/map.pgm{query}").content
        assert got[:7] == b"P5\n12 6"
    assert "no level" in api.problem("GET", f"/maps/{house}/occupancy_grid/L3/map.pgm", 404)["detail"]
    api.problem("GET", f"/maps/{house}/occupancy_grid/L2/map.pgm?level=ground", 404)
    api.problem("GET", f"/maps/{house}/occupancy_grid/L2/nav.pgm", 404)


def test_masks_are_drawn_on_the_level_of_their_zones(api: Api, house: str) -> None:
    draw(api, house, zone("low", "keepout"))
    draw(api, house, zone("high", "keepout", x=1.0), zone("slow", "speed", 0.5), level="L2")
    body = listed(api, house, "occupancy_grid")
    names = set(names_of(body))
    assert {"keepout.yaml", "L2/keepout.yaml", "L2/speed.yaml"} <= names
    assert "speed.yaml" not in names
    check_files(api, house, body)
    ground, above = (api.get(f"/maps/{house}/occupancy_grid/{name}keepout.pgm").content for name in ("", "L2/"))
    assert (ground[:6], above[:7]) == (b"P5\n8 6", b"P5\n12 6"), "each in the frame of its level's map"
    assert api.get(f"/maps/{house}/occupancy_grid/speed.pgm").content[:7] == b"P5\n12 6", (
        "on the only level that has it"
    )


def test_stored_mask_of_one_level_does_not_hide_a_drawn_one(api: Api, house: str) -> None:
    api.upload(house, samples.grid("keepout", width=12), grid="keepout", level="L2")
    draw(api, house, zone("low", "keepout"))
    body = listed(api, house, "occupancy_grid")
    assert {"keepout.pgm", "L2/keepout.pgm"} <= set(names_of(body))
    check_files(api, house, body)
    assert api.get(f"/maps/{house}/occupancy_grid?grid=keepout&level=ground").status_code == 200


def test_zones_of_other_kinds_draw_no_mask(api: Api, house: str) -> None:
    draw(api, house, zone("a", "priority"))
    assert {name for name in names_of(listed(api, house, "occupancy_grid")) if "yaml" in name} == {
        "map.yaml",
        "nav.yaml",
        "L2/map.yaml",
    }
    api.problem("GET", f"/maps/{house}/occupancy_grid?level=*&grid=keepout", 404)


def test_mask_that_cannot_be_drawn_fails_the_whole_format(api: Api, house: str) -> None:
    draw(api, house, zone("a", "speed", 0.5), zone("b", "speed", "50%", x=1.0), zone("c", "keepout", x=2.0))
    path = f"environments/{house}/versions/latest/manifest?formats=occupancy_grid"
    detail = api.problem("GET", path, 422)["detail"]
    assert "max_speed" in detail
    assert detail.startswith("occupancy_grid: ")
    assert "keepout.pgm" in names_of(listed(api, house, "occupancy_grid?max_speed=2"))
    check_files(api, house, listed(api, house, "occupancy_grid?max_speed=2"), "?max_speed=2")
    api.get(f"/maps/{house}/occupancy_grid/map.yaml")


def test_lowest_level_is_the_default_without_ground(api: Api, bare: str) -> None:
    api.upload(bare, samples.grid(width=9), level="L1")
    assert names_of(listed(api, bare, "occupancy_grid")) == ["map.pgm", "map.yaml"]
    api.upload(bare, samples.grid(width=12), level="B1")
    body = listed(api, bare, "occupancy_grid")
    top = next(f["level"] for f in body["files"] if f["name"] == "map.yaml")
    assert top == min(
        level["name"] for level in body["levels"] if level["elevation"] == 0 and level["name"] != "ground"
    )
    check_files(api, bare, body)
    api.problem("GET", f"/maps/{bare}/occupancy_grid", 409)


@pytest.mark.parametrize("level", ODD_LEVELS)
def test_level_folders_are_safe_and_reversible(level: str) -> None:
    folder = site.level_folder_name(level)
    assert site.level_of_folder(folder, ODD_LEVELS) == level
    assert folder.isprintable()
    assert folder.isascii()
    assert len(folder) <= 160
    assert not set(folder) & set('./\\:*?"<>|#$')
    assert folder == folder.strip()


def test_level_folders_never_collide() -> None:
    folders = [site.level_folder_name(level) for level in (*ODD_LEVELS, "L2", "%61", "a")]
    assert len(set(folders)) == len(folders)


def test_levels_with_special_names_are_served(api: Api, bare: str) -> None:
    api.upload(bare, samples.grid())
    levels = ("map.yaml", "a/b", "..", "Étage 2", "x?y#z*")
    for place, level in enumerate(levels):
        api.upload(bare, samples.grid(width=9 + place), level=level)
    body = listed(api, bare, "occupancy_grid")
    assert {f["level"] for f in body["files"]} == {"ground", *levels}
    check_files(api, bare, body)
    assert set(unzipped(api.get(f"/maps/{bare}/occupancy_grid?level=*").content)) == set(names_of(body))


def test_report_covers_all_parts(api: Api, office: str) -> None:
    report = api.get(f"environments/{office}/versions/latest/reports/occupancy_grid?level=*&grid=*").json()
    lines = {(line["level"], line["name"]): line for line in report["layers"] if line["layer"] == "occupancy"}
    assert set(lines) == {("ground", "map"), ("L2", "map"), ("ground", "speed"), ("L2", "speed")}
    assert lines["L2", "map"]["information"] == "generated"
    assert lines["L2", "speed"]["steps"][0]["step"] == "zones_to_occupancy"
    assert (report["format"], report["version"]) == ("occupancy_grid", 1)
    assert len({str(line) for line in report["dropped"]}) == len(report["dropped"])


def test_derived_grids_of_all_levels_are_listed(api: Api, bare: str, shared: Path) -> None:
    folder = shared / "data" / "openrmf_building" / "hotel"
    files = {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    api.upload(bare, files)
    body = listed(api, bare, "occupancy_grid?resolution=0.5")
    levels = {f["level"] for f in body["files"]}
    assert len(levels) > 1
    assert {"map.yaml", "map.pgm"} <= set(names_of(body))
    check_files(api, bare, body, "?resolution=0.5")


def test_template_that_names_a_grid_hides_no_other(api: Api, house: str) -> None:
    api("PUT", f"environments/{house}/templates/occupancy_grid", 201, json={"values": {"grid": "nav"}})
    assert {"map.yaml", "nav.yaml", "L2/map.yaml"} <= set(names_of(listed(api, house, "occupancy_grid")))


def test_entries_carry_parameters(api: Api, house: str) -> None:
    body = listed(
        api,
        house,
        "occupancy_grid?level=L2&grid=map",
    )
    assert names_of(body) == ["L2/map.pgm", "L2/map.yaml"]
    check_files(api, house, body, "?level=L2&grid=map")
    assert "L2/map.png" in names_of(listed(api, house, "occupancy_grid?file_type=png"))
    api.upload(house, samples.grid(width=11), level="a,b&c")
    body = listed(api, house, f"occupancy_grid?level={quote('a,b&c', safe='')}")
    assert {f["level"] for f in body["files"]} == {"a,b&c"}


@pytest.mark.parametrize(
    ("query", "message"),
    [
        ("formats=occupancy_grid,occupancy_grid", "duplicate format"),
        ("formats=occupancy_grid&optional=occupancy_grid%3Flevel=L2", "duplicate format"),
        ("formats=occupancy_grid%3Fcolour=red", "colour"),
        ("formats=occupancy_grid%3Flevel=a%26level=b", "duplicate parameter"),
        ("formats=occupancy_grid&optional=nothing", "unknown format"),
        ("formats=&optional=occupancy_grid", "list 1 to"),
        ("formats=occupancy_grid%3Flevel=L9", "occupancy_grid: "),
    ],
)
def test_bad_entries_are_refused(api: Api, house: str, query: str, message: str) -> None:
    answer = api.get(f"environments/{house}/versions/latest/manifest?{query}", expect=None)
    assert answer.status_code in (404, 422)
    assert message in answer.json()["detail"]


def test_unavailable_optional_formats_are_listed(api: Api, house: str) -> None:
    body = listed(api, house, "occupancy_grid", optional="kml,datum")
    assert {line["format"] for line in body["missing"]} == {"kml", "datum"}
    assert all("upload" in line["detail"] for line in body["missing"])
    assert {"map.yaml", "L2/map.yaml"} <= set(names_of(body))
    problem = api.problem("GET", f"environments/{house}/versions/latest/manifest?formats=occupancy_grid,kml", 422)
    assert "kml" in problem["detail"]


def test_failed_optional_format_is_not_retried_at_once(api: Api, house: str, monkeypatch: pytest.MonkeyPatch) -> None:
    draw(api, house, zone("a", "speed", 0.5), zone("b", "speed", "50%", x=1.0))
    api.upload(house, {"network.tmap2.yaml": samples.tmap2()})
    maps = api.app.state.services.maps
    tried = []
    make = maps._run_conversion

    def counted(recipe: Any, stop: Any) -> Any:
        tried.append(recipe.format.name)
        return make(recipe, stop)

    monkeypatch.setattr(maps, "_run_conversion", counted)
    for _ in range(3):
        body = listed(api, house, "tmap2", optional="occupancy_grid")
        (line,) = body["missing"]
        assert (line["format"], "max_speed" in line["detail"]) == ("occupancy_grid", True)
        api.app.state.services.store.generation.change()  # not from memory
    assert names_of(body, "tmap2") == ["network.tmap2.yaml"]
    assert tried.count("occupancy_grid") <= 4, "each stored grid once, and the masks once"


def test_whole_site_is_converted_with_a_cache_for_one_map(tmp_path: Path) -> None:
    with running(settings_for(tmp_path, cache_bytes=1)) as api:
        api.post("environments", {"name": "small"})
        for level in ("ground", "L2", "L3"):
            api.upload("small", samples.grid(), level=level)
        body = listed(api, "small", "occupancy_grid")
        assert len(names_of(body)) == 6
        assert len(unzipped(api.get("/maps/small/occupancy_grid?level=*&grid=*").content)) == 6


def test_masks_are_converted_once_for_manifest_and_files(api: Api, house: str, monkeypatch: pytest.MonkeyPatch) -> None:
    draw(api, house, zone("low", "keepout"), zone("slow", "speed", 0.5, x=1.0))
    maps = api.app.state.services.maps
    steps = []
    make = maps._run_conversion

    def counted(recipe: Any, stop: Any) -> Any:
        steps.extend(step.name for step in recipe.steps)
        return make(recipe, stop)

    monkeypatch.setattr(maps, "_run_conversion", counted)
    body = listed(api, house, "occupancy_grid")
    check_files(api, house, body)
    assert steps == ["zones_to_occupancy"]


def test_formats_without_parts_are_unchanged(api: Api, farm: str) -> None:
    assert names_of(listed(api, farm, "tmap2"), "tmap2") == ["network.tmap2.yaml"]
    api.problem("GET", f"/maps/{farm}/tmap2?level=*", 422)

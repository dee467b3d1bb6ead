"""Environments over HTTP: create, find, rename, delete, restore, purge, clone."""

from __future__ import annotations

import io
import json
import math
import re
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from pyproj import Geod

from tests.api import samples
from tests.api.conftest import Api

Fresh = Callable[[], str]


def test_environment_is_created_empty_or_with_a_datum(api: Api, fresh: Fresh) -> None:
    name = fresh()
    answer = api.post("environments", {"name": name, "title": "T", "description": "D", "tags": ["a", "b"]})
    assert answer.headers["location"] == f"/api/v1/environments/{name}"
    body = answer.json()
    assert body["version"] == 0
    assert body["datum"] is None
    assert body["bounds"] is None
    assert (body["title"], body["description"], body["tags"]) == ("T", "D", ["a", "b"])
    other = fresh()
    environment = api.post(
        "environments", {"name": other, "datum": {"latitude": 53.0, "longitude": -0.5, "heading": 10}}
    ).json()
    assert environment["version"] == 1
    assert environment["datum"] == {"latitude": 53.0, "longitude": -0.5, "altitude": 0.0, "heading": 10.0}


@pytest.mark.parametrize(
    "body",
    [
        {},
        {"name": "Upper"},
        {"name": "robots"},
        {"name": "server"},
        {"name": "a" * 64},
        {"name": "-a"},
        {"name": "a/b"},
        {"name": "**"},
        {"name": "ok-name", "datum": {"latitude": 86, "longitude": 0}},
        {"name": "ok-name", "datum": {"latitude": 0}},
        {"name": "ok-name", "tags": "x"},
        {"name": "ok-name", "colour": "red"},
        [],
        "text",
    ],
)
def test_invalid_environments_are_refused(api: Api, body: object) -> None:
    problem = api.problem("POST", "environments", 422, json=body)
    if body:
        assert problem.get("errors") or "reserved" in problem["detail"]


def test_used_name_returns_409(api: Api, bare: str) -> None:
    api.problem("POST", "environments", 409, json={"name": bare})


def test_etag_is_the_head(api: Api, farm: str) -> None:
    answer = api.get(f"environments/{farm}")
    assert answer.headers["etag"] == '"3"'
    body = answer.json()
    assert body["version"] == 3
    assert len(body["root"]) == 64
    west, south, east, north = body["bounds"]
    assert west < samples.LONGITUDE < east
    assert south <= samples.LATITUDE < north
    assert body["datum"]["latitude"] == samples.LATITUDE


def test_unknown_environment_returns_404(api: Api) -> None:
    for path in ("", "/versions", "/versions/latest", "/channels", "/versions/latest/maps/kml", "/versions/1/layers"):
        api.problem("GET", f"environments/nowhere{path}", 404)
    api.problem("DELETE", "environments/nowhere", 404)
    api.problem("GET", "environments/Bad*Name", 422)


def test_environment_is_described_and_renamed(api: Api, farm: str, fresh: Fresh) -> None:
    patched = api("PATCH", f"environments/{farm}", 200, json={"title": "New", "tags": []}).json()
    assert (patched["title"], patched["tags"], patched["version"]) == ("New", [], 3)
    new = fresh()
    answer = api("PATCH", f"environments/{farm}", 200, json={"name": new})
    assert answer.json()["name"] == new
    assert answer.headers["content-location"] == f"/api/v1/environments/{new}"
    api.problem("GET", f"environments/{farm}", 404)
    assert api.get(f"environments/{new}/versions/latest").json()["environment"] == new
    assert api.get(f"environments/{new}/versions/2/maps/tmap2").headers["fleetmap-version"] == "2"
    api.post("environments", {"name": farm})


def test_invalid_new_names_are_refused(api: Api, farm: str, bare: str) -> None:
    api.problem("PATCH", f"environments/{farm}", 409, json={"name": bare})
    api.problem("PATCH", f"environments/{farm}", 422, json={"name": "robots"})
    api.problem("PATCH", f"environments/{farm}", 422, json={})
    problem = api.problem(
        "PATCH", f"environments/{farm}", 409, json={"name": bare, "datum": {"latitude": 1, "longitude": 1}}
    )
    assert bare in problem["detail"]
    assert api.get(f"environments/{farm}").json()["version"] == 3, "the datum was not set either"


def test_new_datum_creates_a_version_with_warnings(api: Api, farm: str) -> None:
    answer = api("PATCH", f"environments/{farm}", 200, json={"datum": {"latitude": 53.3, "longitude": -0.5}})
    body = answer.json()
    assert body["version"] == 4
    assert answer.headers["etag"] == '"4"'
    assert body["datum"]["latitude"] == 53.3
    assert body["warnings"]
    same = api("PATCH", f"environments/{farm}", 200, json={"datum": {"latitude": 53.3, "longitude": -0.5}}).json()
    assert same["version"] == 4
    api.problem(
        "PATCH",
        f"environments/{farm}",
        412,
        json={"datum": {"latitude": 1, "longitude": 1}},
        headers={"If-Match": '"3"'},
    )
    api.problem("PATCH", f"environments/{farm}", 412, json={"title": "x"}, headers={"If-Match": '"3"'})
    api("PATCH", f"environments/{farm}", 200, json={"title": "x"}, headers={"If-Match": '"4"'})


def test_environment_is_deleted_restored_and_purged(api: Api, farm: str) -> None:
    api("DELETE", f"environments/{farm}", 204)
    problem = api.problem("GET", f"environments/{farm}", 404)
    assert "deleted" in problem["detail"]
    api.problem("GET", f"/maps/{farm}/tmap2", 404)
    api.problem("POST", "environments", 409, json={"name": farm})
    listed = api.get("environments", params={"deleted": "true", "limit": 1000}).json()
    assert [e["name"] for e in listed if e["name"] == farm and e["deleted"]] == [farm]
    assert api.post(f"environments/{farm}/restore", expect=200).json()["version"] == 3
    api.get(f"/maps/{farm}/tmap2")
    api.problem("POST", f"environments/{farm}/purge", 409)
    api("DELETE", f"environments/{farm}", 204)
    api.post(f"environments/{farm}/purge", expect=204)
    api.problem("POST", f"environments/{farm}/restore", 404)
    assert api.post("environments", {"name": farm}).json()["version"] == 0


def test_clone_has_the_content_of_its_source(api: Api, farm: str, fresh: Fresh) -> None:
    name = fresh()
    environment = api.post("environments", {"name": name, "clone": {"environment": farm, "version": 2}}).json()
    assert environment["version"] == 1
    assert environment["root"] == api.get(f"environments/{farm}/versions/2").json()["root"]
    copy = api.get(f"environments/{name}/versions/1/maps/tmap2").content
    assert copy == api.get(f"environments/{farm}/versions/2/maps/tmap2").content
    api.problem("POST", "environments", 404, json={"name": fresh(), "clone": {"environment": "nowhere"}})
    api.problem("POST", "environments", 404, json={"name": fresh(), "clone": {"environment": farm, "version": 99}})
    both = {"name": fresh(), "clone": {"environment": farm}, "datum": {"latitude": 0, "longitude": 0}}
    api.problem("POST", "environments", 422, json=both)


def test_contains_finds_environments_of_a_position(api: Api, farm: str) -> None:
    query = {"contains": "53.2687,-0.5246", "limit": "1000"}
    assert farm in [e["name"] for e in api.get("environments", params=query).json()]
    environment = next(e for e in api.get("environments", params=query).json() if e["name"] == farm)
    assert environment["match"]["by"] == "fence"
    assert environment["match"]["area_m2"] == pytest.approx(66.7 * 66.8, rel=0.01)
    assert environment["match"]["distance_m"] == pytest.approx(math.hypot(6.7, 11.1), rel=0.02)
    assert "match" not in api.get(f"environments/{farm}").json()
    assert all("match" not in e for e in api.get("environments", params={"bbox": "-0.6,53.2,-0.4,53.3"}).json())
    far_query = {"contains": "-53.2687,-0.5246"}
    assert farm not in [e["name"] for e in api.get("environments", params=far_query).json()]
    box = {"bbox": "-0.6,53.2,-0.4,53.3", "limit": "1000"}
    assert farm in [e["name"] for e in api.get("environments", params=box).json()]
    assert farm not in [e["name"] for e in api.get("environments", params={"bbox": "10,53.2,11,53.3"}).json()]
    for bad in ("1", "", "a,b", "91,0", "0,181", "1,2,3", "nan,1", "1,NaN", "inf,1"):
        problem = api.problem("GET", "environments", 422, params={"contains": bad})
        assert "LAT,LON" in problem["detail"]
    problem = api.problem("GET", "environments", 422, params={**query, "cursor": farm})
    assert "Link header" in problem["detail"]
    for bad in ("1,2,3", "0,2,1,1", "0,0,200,1"):
        api.problem("GET", "environments", 422, params={"bbox": bad})


FIELDS = {
    "riseholme_park_farm_general_east_pathway": "53.26868,-0.52525",
    "riseholme_park_farm_strawberry_polytunnels": "53.26850,-0.52460",
    "riseholme_park_farm_vineyard": "53.26810,-0.52440",
}
"""Return real fields of one farm, each with a position inside only its own fence."""


def test_contains_distinguishes_adjacent_fields(api: Api, fresh: Fresh, shared: Path) -> None:
    names: dict[str, str] = {}
    rings: dict[str, shapely.Polygon] = {}
    for field in FIELDS:
        names[field] = fresh()
        root = shared / "data" / "environment_template" / field
        api.post("environments", {"name": names[field]})
        files = {p.relative_to(root).as_posix(): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w") as archive:
            for name, data in files.items():
                archive.writestr(name, data)
        api.upload(names[field], {"field.zip": packed.getvalue()})
        text = files.get("config/location/datum.yaml", files["config/location/datum_autogen.yaml"]).decode()
        coordinates = re.search(r"gnss_fence_coords: (\[\[.*?\]\])", text, re.DOTALL)
        assert coordinates is not None
        rings[field] = shapely.Polygon([(x, y) for y, x in json.loads(coordinates[1])])
    boxes = [api.get(f"environments/{name}").json()["bounds"] for name in names.values()]

    def answers(latitude: float, longitude: float) -> list[dict[str, Any]]:
        environments = api.get("environments", params={"contains": f"{latitude},{longitude}", "limit": 1000}).json()
        return [e for e in environments if e["name"] in names.values()]

    for field, position in FIELDS.items():
        latitude, longitude = map(float, position.split(","))
        assert sum(w <= longitude <= e and s <= latitude <= n for w, s, e, n in boxes) > 1, (
            "bounding boxes would not distinguish them"
        )
        (hit,) = answers(latitude, longitude)
        assert hit["name"] == names[field]
        area, _ = Geod(ellps="WGS84").geometry_area_perimeter(rings[field])
        assert hit["match"]["by"] == "fence"
        assert hit["match"]["area_m2"] == pytest.approx(abs(area), rel=0.01)
    # Expected matches of a hundred positions in and around the farm, from the fences in the files.
    for longitude, latitude in np.random.default_rng(1).uniform((-0.5260, 53.2678), (-0.5230, 53.2692), (100, 2)):
        inside = {
            names[field]
            for field, ring in rings.items()
            if shapely.make_valid(ring).covers(shapely.Point(longitude, latitude))
        }
        assert {e["name"] for e in answers(latitude, longitude)} == inside


def test_contains_is_paginated(api: Api, fresh: Fresh) -> None:
    names = sorted(fresh() for _ in range(5))
    for k, name in enumerate(names):
        api.post("environments", {"name": name, "datum": {"latitude": 10.0 + k * 1e-4, "longitude": 20.0}})
    seen: list[str] = []
    path: str | None = "/api/v1/environments?contains=10,20&limit=2"
    while path is not None:
        answer = api.get(path)
        seen += [e["name"] for e in answer.json()]
        path = answer.links["next"]["url"] if "next" in answer.links else None
    assert seen == names, "the nearest datum first"
    limited = api.token_for("viewer", environments=names[3])
    assert [e["name"] for e in limited.get("environments", params={"contains": "10,20"}).json()] == [names[3]]


def test_list_is_paginated(api: Api, fresh: Fresh) -> None:
    tag = f"paged-{fresh()}"
    names = sorted(fresh() for _ in range(5))
    for name in names:
        api.post("environments", {"name": name, "tags": [tag]})
    seen: list[str] = []
    path: str | None = f"/api/v1/environments?q={tag}&limit=2"
    pages = 0
    while path:
        answer = api.get(path)
        seen += [e["name"] for e in answer.json()]
        pages += 1
        link = answer.links.get("next")
        path = link["url"] if link else None
    assert seen == names
    assert pages == 3
    for bad in ({"limit": "0"}, {"limit": "1001"}, {"limit": "x"}):
        api.problem("GET", "environments", 422, params=bad)


def test_misspelt_parameter_is_reported(api: Api) -> None:
    problem = api.problem("GET", "environments", 422, params={"lmit": "3"})
    assert problem["errors"][0]["where"] == "lmit"

"""Environments over HTTP: made, found, renamed, deleted, restored, purged, cloned."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from tests.api import samples
from tests.api.conftest import Api

Fresh = Callable[[], str]


def test_made_empty_or_with_a_datum(api: Api, fresh: Fresh) -> None:
    name = fresh()
    answer = api.post("environments", {"name": name, "title": "T", "description": "D", "tags": ["a", "b"]})
    assert answer.headers["location"] == f"/api/v1/environments/{name}"
    body = answer.json()
    assert body["version"] == 0
    assert body["datum"] is None
    assert body["bounds"] is None
    assert (body["title"], body["description"], body["tags"]) == ("T", "D", ["a", "b"])
    other = fresh()
    made = api.post(
        "environments", {"name": other, "datum": {"latitude": 53.0, "longitude": -0.5, "heading": 10}}
    ).json()
    assert made["version"] == 1
    assert made["datum"] == {"latitude": 53.0, "longitude": -0.5, "altitude": 0.0, "heading": 10.0}


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
def test_what_cannot_be_made(api: Api, body: object) -> None:
    problem = api.problem("POST", "environments", 422, json=body)
    if body:
        assert problem.get("errors") or "reserved" in problem["detail"]


def test_a_taken_name(api: Api, bare: str) -> None:
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


def test_there_is_no_such_environment(api: Api) -> None:
    for path in ("", "/versions", "/versions/latest", "/channels", "/versions/latest/maps/kml", "/versions/1/layers"):
        api.problem("GET", f"environments/nowhere{path}", 404)
    api.problem("DELETE", "environments/nowhere", 404)
    api.problem("GET", "environments/Bad*Name", 422)


def test_described_and_renamed(api: Api, farm: str, fresh: Fresh) -> None:
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


def test_renaming_refused(api: Api, farm: str, bare: str) -> None:
    api.problem("PATCH", f"environments/{farm}", 409, json={"name": bare})
    api.problem("PATCH", f"environments/{farm}", 422, json={"name": "robots"})
    api.problem("PATCH", f"environments/{farm}", 422, json={})
    problem = api.problem(
        "PATCH", f"environments/{farm}", 409, json={"name": bare, "datum": {"latitude": 1, "longitude": 1}}
    )
    assert bare in problem["detail"]
    assert api.get(f"environments/{farm}").json()["version"] == 3, "the datum was not set either"


def test_a_new_datum_is_a_version_and_warns(api: Api, farm: str) -> None:
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


def test_deleted_restored_purged(api: Api, farm: str) -> None:
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


def test_cloned(api: Api, farm: str, fresh: Fresh) -> None:
    name = fresh()
    made = api.post("environments", {"name": name, "clone": {"environment": farm, "version": 2}}).json()
    assert made["version"] == 1
    assert made["root"] == api.get(f"environments/{farm}/versions/2").json()["root"]
    mine = api.get(f"environments/{name}/versions/1/maps/tmap2").content
    assert mine == api.get(f"environments/{farm}/versions/2/maps/tmap2").content
    api.problem("POST", "environments", 404, json={"name": fresh(), "clone": {"environment": "nowhere"}})
    api.problem("POST", "environments", 404, json={"name": fresh(), "clone": {"environment": farm, "version": 99}})
    both = {"name": fresh(), "clone": {"environment": farm}, "datum": {"latitude": 0, "longitude": 0}}
    api.problem("POST", "environments", 422, json=both)


def test_which_map_am_i_on(api: Api, farm: str) -> None:
    here = {"contains": "53.2687,-0.5246", "limit": "1000"}
    assert farm in [e["name"] for e in api.get("environments", params=here).json()]
    there = {"contains": "-53.2687,-0.5246"}
    assert farm not in [e["name"] for e in api.get("environments", params=there).json()]
    box = {"bbox": "-0.6,53.2,-0.4,53.3", "limit": "1000"}
    assert farm in [e["name"] for e in api.get("environments", params=box).json()]
    assert farm not in [e["name"] for e in api.get("environments", params={"bbox": "10,53.2,11,53.3"}).json()]
    for bad in ("1", "a,b", "91,0", "0,181", "1,2,3", "nan,1", "inf,1"):
        api.problem("GET", "environments", 422, params={"contains": bad})
    for bad in ("1,2,3", "0,2,1,1", "0,0,200,1"):
        api.problem("GET", "environments", 422, params={"bbox": bad})


def test_pages(api: Api, fresh: Fresh) -> None:
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


def test_a_misspelt_parameter_is_told(api: Api) -> None:
    problem = api.problem("GET", "environments", 422, params={"lmit": "3"})
    assert problem["errors"][0]["where"] == "lmit"

"""Signed links: scope, lifetime and refusals."""

from __future__ import annotations

import hashlib
import json
import logging
import sqlite3
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlencode, urlsplit

import httpx
import pytest

from app import links
from app.api.http.auth import Credentials
from app.backends.documents import FileDocument
from app.errors import ExpiredLink, InvalidLink
from app.links import LinkSecrets
from tests.api import samples
from tests.api.conftest import Api, problem, running, settings_for

NOW = 1_800_000_000.0


# --- the signature ---


def signed(secret: bytes, path: str, expires: int, **parameters: str) -> links.SignedAddress:
    query = links.sign(secret, "e1", path, parameters, expires)
    parsed_link = links.parse(path, query.encode())
    assert parsed_link is not None
    return parsed_link


def test_signature_holds_for_parameters_in_any_order() -> None:
    query = links.sign(b"k", "e1", "/maps/farm/kml", {"b": "2 &é", "a": "1"}, int(NOW) + 9)
    pairs = parse_qsl(query)
    for items in (pairs, pairs[::-1]):
        parsed_link = links.parse("/maps/farm/kml", urlencode(items).encode())
        assert parsed_link is not None
        assert (parsed_link.query, parsed_link.expires, parsed_link.environment_id) == (
            b"a=1&b=2+%26%C3%A9",
            int(NOW) + 9,
            "e1",
        )
        assert links.check([b"other", b"k"], parsed_link) == 1


def test_signature_covers_path_parameters_expiry_and_environment() -> None:
    good = signed(b"k", "/maps/farm/kml", int(NOW) + 9, a="1")
    assert links.check([b"k"], good) == 0
    e1, _, code = good.signature.partition(".")
    altered: list[dict[str, Any]] = [
        {"path": "/maps/farm/kmz"}, {"path": "/maps/farm/kml/map.kml"}, {"query": b""}, {"query": b"a=2"},
        {"query": b"a=1&b=1"}, {"expires": int(NOW) + 10}, {"signature": f"e2.{code}"}, {"signature": f"{e1}.{code}="},
        {"signature": f"{e1}.{code[:-1]}"}, {"signature": code}, {"signature": ""}, {"signature": f"{e1}.\udcff"},
    ]  # fmt: skip
    for change in altered:
        values = {name: getattr(good, name) for name in ("path", "query", "expires", "signature")} | change
        with pytest.raises(InvalidLink):
            links.check([b"k"], links.SignedAddress(**values))
    with pytest.raises(InvalidLink):
        links.check([b"j"], good)
    with pytest.raises(InvalidLink):
        links.check([], good)


def test_genuine_link_ends_at_its_expiry_and_stays_expired(tmp_path: Path) -> None:
    """This includes other processes, and a clock that is set back."""
    secrets = LinkSecrets(FileDocument(tmp_path / "links.json"))
    link, later = (signed(secrets.newest(), "/maps/farm/kml", int(NOW) + life) for life in (9, 90))
    secrets.check(link, NOW + 8.9)
    for clock in (9.0, 10.0, 8.0, -1e6):
        with pytest.raises(ExpiredLink, match="request a new one"):
            LinkSecrets(FileDocument(tmp_path / "links.json")).check(link, NOW + clock)
    secrets.check(later, NOW)


def test_links_made_after_the_clock_was_set_back_are_valid(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """This includes new links that expire before links that were seen to have expired, which end permanently, with
    their secret.
    """
    secrets = LinkSecrets(FileDocument(tmp_path / "links.json"))
    old, other = (signed(secrets.newest(), "/maps/farm/kml", int(NOW) + life) for life in (900, 1000))
    with pytest.raises(ExpiredLink):
        secrets.check(old, NOW + 1e7)
    assert secrets.signing(NOW, NOW + 901) == secrets.newest()
    secrets.check(other, NOW)
    new = signed(secrets.signing(NOW, NOW + 60), "/maps/farm/kml", int(NOW) + 60)
    assert "set back" in caplog.text
    secrets.check(new, NOW)
    for link in (old, other):
        with pytest.raises(InvalidLink):
            LinkSecrets(FileDocument(tmp_path / "links.json")).check(link, NOW)


@pytest.mark.parametrize("expires", ["", "x", "-1", "1e9", "١٢٣", "1" * 13, None])
def test_link_without_a_number_of_seconds_is_invalid(expires: str | None) -> None:
    query = urlencode({"signature": "e.x", **({} if expires is None else {"expires": expires})})
    with pytest.raises(InvalidLink, match="expires"):
        links.parse("/maps/farm/kml", query.encode())


def test_query_without_signature_is_not_a_link() -> None:
    assert links.parse("/maps/farm/kml", b"expires=1") is None
    assert links.parse("/maps/farm/kml", b"my_signature=1&expires=1") is None
    for bad in (b"signature=%ff", b"signature=a&expires=1&x=1&x=2", b"signature=a&signature=b&expires=1"):
        with pytest.raises(InvalidLink):
            links.parse("/maps/farm/kml", bad)


# --- the secrets ---


def test_secrets_are_shared_and_read_by_their_owner_only(tmp_path: Path) -> None:
    file = FileDocument(tmp_path / "keys" / "links.json")
    one, two = LinkSecrets(file), LinkSecrets(file)
    with ThreadPoolExecutor(8) as pool:
        assert len(set(pool.map(lambda k: (one, two)[k % 2].newest(), range(32)))) == 1
    assert len(one.newest()) == 32
    assert (tmp_path / "keys" / "links.json").stat().st_mode & 0o077 == 0


def test_rotated_secret_stays_valid_until_its_links_have_ended(tmp_path: Path) -> None:
    one, two = LinkSecrets(FileDocument(tmp_path / "links.json")), LinkSecrets(FileDocument(tmp_path / "links.json"))
    old = one.newest()
    one.rotate(NOW, 60)
    new = two.newest()
    assert new != old
    assert two.valid(NOW + 59) == one.valid(NOW + 59) == [new, old]
    assert two.valid(NOW + 60) == [new]
    assert one.valid(NOW) == [new], "its lifetime has ended, even if the clock is set back"
    one.rotate(NOW + 61, 60)
    assert [s["until"] for s in json.loads((tmp_path / "links.json").read_text())] == [None, NOW + 121], (
        "the old secret is removed"
    )
    for k in range(40):
        one.rotate(NOW + 62 + k / 10, 60)
    assert len(two.valid(NOW + 66)) == links.MAX_SECRETS


# --- over HTTP ---


def link(api: Api, env: str, version: int | str = "latest", **body: Any) -> dict[str, Any]:
    """Create a link; return it as the API does, but ``url`` without the server's address."""
    signed_link: dict[str, Any] = api.post(f"environments/{env}/versions/{version}/links", body).json()
    assert signed_link["url"].startswith(f"{api.url}/api/v1/environments/{env}/versions/{signed_link['version']}/maps/")
    return signed_link | {"url": signed_link["url"].removeprefix(api.url)}


def altered(url: str, **change: str | None) -> str:
    """Change query parameters of a link."""
    parts = urlsplit(url)
    values = {k: v for k, v in (dict(parse_qsl(parts.query)) | change).items() if v is not None}
    return f"{parts.path}?{urlencode(values)}"


def test_link_needs_no_token(api: Api, farm: str) -> None:
    anonymous = api.as_(None)
    with_token = api.get(f"environments/{farm}/versions/3/maps/occupancy_grid/map.png?file_type=png&grid=map")
    signed_link = link(
        api, farm, format="occupancy_grid", file="map.png", parameters={"grid": "map", "file_type": "png"}
    )
    assert signed_link["url"].startswith(f"/api/v1/environments/{farm}/versions/3/maps/occupancy_grid/map.png?")
    assert (signed_link["version"], signed_link["name"]) == (3, "map.png")
    for _ in range(3):
        answer = anonymous.get(signed_link["url"])
        assert answer.content == with_token.content
        assert (answer.headers["etag"], answer.headers["fleetmap-version"]) == (with_token.headers["etag"], "3")
        assert answer.headers["referrer-policy"] == "no-referrer"
        assert "private" in answer.headers["cache-control"]
    assert (hashlib.sha256(answer.content).hexdigest(), len(answer.content)) == (
        signed_link["sha256"],
        signed_link["size"],
    )
    assert "referrer-policy" not in with_token.headers
    unchanged = anonymous.get(signed_link["url"], 304, headers={"If-None-Match": answer.headers["etag"]})
    assert unchanged.headers["referrer-policy"] == "no-referrer"
    head = anonymous("HEAD", signed_link["url"], 200)
    assert (head.content, head.headers["content-length"]) == (b"", str(signed_link["size"]))
    part = anonymous.get(signed_link["url"], 206, headers={"Range": "bytes=2-5"})
    assert part.content == answer.content[2:6]
    api.upload(farm, {"more.kml": samples.KML})
    assert anonymous.get(signed_link["url"]).content == answer.content, "the link names the version by number"
    zip_link = link(api, farm, "latest", format="occupancy_grid")
    assert anonymous.get(zip_link["url"]).headers["content-type"] == "application/zip"


def test_short_address_can_be_signed(api: Api, farm: str) -> None:
    services = api.app.state.services
    environment = services.store.environments.get(farm)
    creator = services.access.authenticate(Credentials(f"Bearer {api.token}".encode()))
    for path in (f"/maps/{farm}/tmap2", f"/maps/{farm}/tmap2/network.tmap2.yaml"):
        grant = services.links.create(environment, path, {}, 60, creator)
        for _ in range(2):
            assert api.as_(None).get(grant.url).content == api.get(path).content


@pytest.mark.parametrize("warm", [False, True])
def test_altered_link_is_refused(api: Api, farm: str, warm: bool) -> None:
    anonymous = api.as_(None)
    url = link(api, farm, format="geojson", parameters={"derive": False})["url"]
    assert "derive=false" in url
    if warm:
        anonymous.get(url)
        api.get(urlsplit(url).path)
    other = link(api, farm, format="tmap2")["url"]
    good = dict(parse_qsl(urlsplit(url).query))
    try:
        for change in (
            {"derive": None}, {"derive": "true"}, {"expires": str(int(good["expires"]) + 1)}, {"signature": "x"},
            {"signature": dict(parse_qsl(urlsplit(other).query))["signature"]}, {"crs": "local"},
        ):  # fmt: skip
            body = anonymous.problem("GET", altered(url, **change), 403)
            assert (body["type"], body["title"]) == ("urn:fleetmap:problem:invalid-link", "Invalid link")
            assert "request a new one" in body["detail"]
        query = urlsplit(url).query
        for path in (f"environments/{farm}/versions/2/maps/geojson", f"/maps/{farm}/geojson",
                     f"environments/{farm}/versions/3/maps/tmap2"):  # fmt: skip
            anonymous.problem("GET", f"{path}?{query}", 403)
        assert "valid 'expires'" in anonymous.problem("GET", altered(url, expires=None), 403)["detail"]
        anonymous.problem("GET", altered(url, signature=None), 401)
        api.problem("GET", altered(url, derive="true"), 403)  # a token beside a link is ignored
        anonymous.get(url)
    finally:
        services = api.app.state.services
        services.access._sources.clear()


def test_link_opens_nothing_else(api: Api, farm: str) -> None:
    anonymous = api.as_(None)
    url = link(api, farm, format="geojson")["url"]
    query = urlsplit(url).query
    for path in (f"environments/{farm}", f"environments/{farm}/versions/3", f"environments/{farm}/versions/3/maps",
                 f"environments/{farm}/versions/3/reports/geojson", "formats", "/metrics",
                 f"environments/{farm}/versions/3/manifest"):  # fmt: skip
        anonymous.problem("GET", f"{path}?{query}", 401)
    for method in ("POST", "PUT", "DELETE", "PATCH", "OPTIONS"):
        anonymous.problem(method, url, 401)
    api.problem("GET", f"environments/{farm}/versions/3/maps/geojson?%73ignature=x&expires=1", 422)


def test_link_ends(api: Api, farm: str) -> None:
    anonymous = api.as_(None)
    signed_link = link(api, farm, format="geojson", seconds=2)
    assert anonymous.get(signed_link["url"]).content
    deadline = time.monotonic() + 30
    while (answer := anonymous.get(signed_link["url"], None)).status_code == 200:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    assert datetime.now(UTC) >= datetime.fromisoformat(signed_link["expires"])
    body = problem(answer)
    assert (answer.status_code, body["type"]) == (403, "urn:fleetmap:problem:expired-link")
    assert body["detail"] == "the link has expired: request a new one"
    for _ in range(40):
        anonymous.problem("GET", signed_link["url"], 403)  # an expired link is not a failure


def test_link_ends_with_its_environment(api: Api, farm: str) -> None:
    anonymous = api.as_(None)
    url = link(api, farm, format="datum")["url"]
    anonymous.get(url)
    api("DELETE", f"environments/{farm}", 204)
    assert "deleted or renamed" in anonymous.problem("GET", url, 403)["detail"]
    api("POST", f"environments/{farm}/restore", 200)
    anonymous.get(url)
    api("DELETE", f"environments/{farm}", 204)
    api("POST", f"environments/{farm}/purge")
    api.post("environments", {"name": farm})
    for k in range(3):
        api.upload(farm, {"datum.yaml": samples.DATUM.replace(b"53.", b"5%d." % k)})
    for _ in range(3):
        anonymous.problem("GET", url, 403)


def test_link_is_created_by_readers_of_its_environment(api: Api, farm: str, bare: str) -> None:
    path, body = f"environments/{farm}/versions/3/links", {"format": "geojson"}
    for role in ("viewer", "robot", "editor"):
        api.token_for(role, environments=farm).post(path, body)
    api.token_for("viewer", environments=bare).problem("POST", path, 403, json=body)
    api.as_(None).problem("POST", path, 401, json=body)
    for bad, status in (
        ({"format": "nothing"}, 404), ({"format": "geojson", "file": "x"}, 404),
        ({"format": "geojson", "seconds": 0}, 422),
        ({"format": "geojson", "seconds": 86_401}, 422), ({"format": "geojson", "parameters": {"nonsense": 1}}, 422),
        ({"format": "geojson", "parameters": {"signature": "x"}}, 422), ({"format": "geojson", "more": 1}, 422),
        ({"format": "geojson", "parameters": {"derive": "perhaps"}}, 422), ({}, 422),
    ):  # fmt: skip
        api.problem("POST", path, status, json=bad)
    assert "86400" in api.problem("POST", path, 422, json={"format": "geojson", "seconds": 90_000})["detail"]
    api.problem("POST", f"environments/{bare}/versions/0/links", 422, json={"format": "tmap2"})
    api.problem("POST", f"environments/{farm}/versions/77/links", 404, json=body)


def test_link_does_not_outlive_the_token_of_its_creator(api: Api, farm: str) -> None:
    ends = datetime.now(UTC) + timedelta(hours=1)
    short = api.token_for("viewer", expires=ends.isoformat())
    signed_link = link(short, farm, format="geojson")
    assert datetime.fromisoformat(signed_link["expires"]) <= ends
    left = datetime.fromisoformat(link(api, farm, format="geojson")["expires"]) - datetime.now(UTC)
    assert timedelta(hours=23.9) < left <= timedelta(hours=24), "the default is the maximum"


@pytest.fixture
def strict(tmp_path: Path) -> Iterator[Api]:
    with running(settings_for(tmp_path, token_failures=5)) as api:
        api.post("environments", {"name": "farm"})
        api.upload("farm", {"datum.yaml": samples.DATUM, "n.tmap2.yaml": samples.tmap2()})
        yield api


def test_repeated_wrong_signatures_return_429(strict: Api) -> None:
    anonymous = strict.as_(None)
    url = link(strict, "farm", format="geojson")["url"]
    wrong = strict.as_("wrong-token")
    for k in range(3):
        anonymous.problem("GET", altered(url, signature=f"x{k}"), 403)
    for _ in range(2):
        wrong.problem("GET", "formats", 401)
    assert int(anonymous("GET", altered(url, signature="y"), 429).headers["retry-after"]) > 0
    wrong.problem("GET", "formats", 429)
    assert anonymous.get(url).content, "valid links cannot be guessed"


def test_links_stay_valid_after_a_rotation(strict: Api, tmp_path: Path) -> None:
    anonymous = strict.as_(None)
    old = link(strict, "farm", format="geojson")["url"]
    anonymous.get(old)
    strict.post("keys")
    new = link(strict, "farm", format="geojson")["url"]
    assert anonymous.get(old).content == anonymous.get(new).content
    (tmp_path / "keys" / "links.json").unlink()
    deadline = time.monotonic() + 30
    while 200 in [
        anonymous.get(url, None).status_code for url in (old, new)
    ]:  # cached responses are valid for a second
        assert time.monotonic() < deadline
        time.sleep(0.05)
    anonymous.problem("GET", new, 403)


def test_link_shows_a_signature_in_no_log_job_or_metric(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    with running(settings_for(tmp_path, log_level="debug")) as api:
        api.post("environments", {"name": "farm"})
        api.upload("farm", {"datum.yaml": samples.DATUM, "n.tmap2.yaml": samples.tmap2()})
        url = link(api, "farm", format="geojson")["url"]
        signature = dict(parse_qsl(urlsplit(url).query))["signature"].partition(".")[2]
        with httpx.Client() as client:
            logging.getLogger("httpx").setLevel(logging.WARNING)
            for query in ("", "x"):
                client.get(api.url + url + query)
        assert signature not in api.get("/metrics").text
    assert signature not in "\n".join(r.getMessage() for r in caplog.records if not r.name.startswith("http"))


def test_slow_map_by_link_returns_503_and_keeps_no_signature(tmp_path: Path) -> None:
    with running(settings_for(tmp_path, job_seconds=0.001)) as api:
        api.post("environments", {"name": "farm"})
        api.upload("farm", {"datum.yaml": samples.DATUM, "n.tmap2.yaml": samples.tmap2()})
        services = api.app.state.services
        creator = services.access.authenticate(Credentials(f"Bearer {api.token}".encode()))
        path = "/api/v1/environments/farm/versions/1/maps/geojson"
        grant = services.links.create(services.store.environments.get("farm"), path, {"derive": "false"}, 600, creator)
        anonymous = api.as_(None)
        answer = anonymous("GET", grant.url, 503)
        assert int(answer.headers["retry-after"]) > 0
        assert "try again" in problem(answer)["detail"]
        deadline = time.monotonic() + 60
        while anonymous.get(grant.url, None).status_code == 503:
            assert time.monotonic() < deadline
            time.sleep(0.1)
        assert anonymous.get(grant.url).content
        with closing(sqlite3.connect(tmp_path / "fleetmap.sqlite3")) as database:
            while None in (results := [row[0] for row in database.execute("select result from job")]):
                assert time.monotonic() < deadline, "the job's end is stored a moment after the map"
                time.sleep(0.05)
        assert [json.loads(r) for r in results] == [{"location": f"{path}?derive=false"}]


def test_link_works_without_access_control(tmp_path: Path) -> None:
    with running(settings_for(tmp_path, insecure_no_auth=True, admin_token=None)) as api:
        open_ = api.as_(None)
        open_.post("environments", {"name": "farm"})
        open_.upload("farm", {"datum.yaml": samples.DATUM})
        url = link(open_, "farm", format="datum")["url"]
        for _ in range(2):
            open_.get(url)
            open_.problem("GET", url, 403, headers={"Host": "evil.example"})
        open_.problem("GET", altered(url, signature="x"), 403)

"""Channels, formats, conversion, tokens and roles, health and metrics, and the shape of errors."""

from __future__ import annotations

import contextlib
import io
import re
import zipfile
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import yaml
from sqlalchemy import update

from app import sandbox
from app.main import sandbox_policy
from app.pool import Pool
from app.store import tables
from app.store.in_worker import open_store
from app.store.store import Store
from tests.api import samples
from tests.api.conftest import ADMIN, API, Api, create_farm, empty_database, parts, problem, running, settings_for
from tests.events.conftest import eventually
from tests.test_pool import work_double, work_write

# --- channels ---


def test_channel_moves_forward_and_back(api: Api, farm: str) -> None:
    url = f"environments/{farm}/channels"
    (latest,) = api.get(url).json()
    assert (latest["channel"], latest["version"]) == ("latest", 3)
    moved = api("PUT", f"{url}/production", 200, json={"version": 2}).json()
    assert (moved["channel"], moved["version"], moved["author"]) == ("production", 2, "administrator")
    assert moved["root"] == api.get(f"environments/{farm}/versions/2").json()["root"]
    assert [c["channel"] for c in api.get(url).json()] == ["latest", "production"]
    assert api.get(f"environments/{farm}/versions/production").json()["version"] == 2
    back = api("PUT", f"{url}/production", 200, json={"version": 1}).json()
    assert back["sequence"] > moved["sequence"]
    assert api("PUT", f"{url}/staging", 200, json={"version": "production"}).json()["version"] == 1
    for body in ({}, {"version": -1}, {"version": 1, "x": 1}, {"version": None}):
        answer = api("PUT", f"{url}/production", None, json=body)
        assert answer.status_code in (404, 422)
        problem(answer)
    api.problem("PUT", f"{url}/production", 404, json={"version": 99})
    api.problem("PUT", f"{url}/latest", 422, json={"version": 1})
    api.problem("PUT", f"{url}/Bad", 422, json={"version": 1})


def test_planned_move_happens_or_is_cancelled(api: Api, farm: str) -> None:
    url = f"environments/{farm}/channels"
    api("PUT", f"{url}/production", 200, json={"version": 2})
    later = (datetime.now(UTC) + timedelta(hours=1)).isoformat()
    planned = api("PUT", f"{url}/production", 200, json={"version": 3, "activate_at": later}).json()
    assert planned["version"] == 2
    assert planned["planned"]["version"] == 3
    api("DELETE", f"{url}/production/planned", 204)
    assert api.get(url).json()[1]["planned"] is None
    api.problem("DELETE", f"{url}/production/planned", 404)
    for bad in ("2020-01-01T00:00:00Z", "2099-01-01T00:00:00", "tomorrow"):
        api.problem("PUT", f"{url}/production", 422, json={"version": 2, "activate_at": bad})
    soon = (datetime.now(UTC) + timedelta(seconds=3)).isoformat()
    api("PUT", f"{url}/production", 200, json={"version": 3, "activate_at": soon})
    eventually(lambda: api.get(f"/maps/{farm}/tmap2").headers["fleetmap-version"] == "3")


# --- formats and conversion ---


def test_formats_lists_options(api: Api) -> None:
    formats = {f["id"]: f for f in api.get("formats").json()}
    assert {"datum", "osm", "kml", "kmz", "occupancy_grid", "tmap2", "geojson"} <= set(formats)
    grid = formats["occupancy_grid"]
    assert set(grid) == {"id", "title", "files", "media_types", "read", "write", "options", "information"}
    assert set(grid["information"]) == {
        "location", "objects", "topology", "occupancy", "voxels", "imagery", "zones",
    }  # fmt: skip
    assert grid["information"]["occupancy"] == "raw"
    assert grid["information"]["voxels"] == "derived"
    assert grid["information"]["location"] == "-"
    assert formats["kml"]["information"]["occupancy"] == "derived", "a KML places a grid, but does not contain it"
    assert formats["kml"]["information"]["topology"] in ("raw", "derived")
    option = next(o for o in grid["options"] if o["name"] == "file_type")
    assert option["schema"]["enum"] == ["pgm", "png", "tif"]
    assert "default" in option
    assert option["for"] == "write"
    assert option["description"]


def test_convert_returns_the_format(api: Api) -> None:
    answer = api("POST", "convert", 200, files=parts({"n.kml": samples.KML}), data={"to": "tmap2"})
    assert len(yaml.safe_load(answer.content)["nodes"]) == 3
    assert answer.headers["content-disposition"] == 'attachment; filename="network.tmap2.yaml"'
    assert int(answer.headers["fleetmap-warnings"]) >= 1, "no datum was given: there is a warning"
    given = {"to": "datum", "datum": '{"latitude": 53.25, "longitude": -0.5}'}
    datum = yaml.safe_load(api("POST", "convert", 200, files=parts({"n.kml": samples.KML}), data=given).content)
    assert datum["datum_latitude"] == 53.25
    several = api(
        "POST", "convert", 200, files=parts(samples.grid()), data={"to": "occupancy_grid", "file_type": "png"}
    )
    with zipfile.ZipFile(io.BytesIO(several.content)) as archive:
        assert sorted(archive.namelist()) == ["map.png", "map.yaml"]
    report = api(
        "POST", "convert", 200, files=parts({"n.kml": samples.KML}), data={"to": "tmap2", "report": "true"}
    ).json()
    assert report["format"] == "tmap2"
    assert report["files"][0]["name"] == "network.tmap2.yaml"
    assert report["warnings"]


@pytest.mark.parametrize(
    ("fields", "status"),
    [
        ({}, 422),
        ({"to": "nosuch"}, 422),
        ({"to": "satellite", "pixel": "-1"}, 422),
        ({"to": "tmap2", "format": "nosuch"}, 422),
        ({"to": "tmap2", "colour": "red"}, 422),
        ({"to": "tmap2", "datum": "x"}, 422),
        ({"to": "tmap2", "datum": "99,0"}, 422),
        ({"to": "tmap2", "datum": '{"latitude": NaN}'}, 422),
        ({"to": "tmap2", "layer": "sky"}, 422),
    ],
)
def test_invalid_conversions_are_refused(api: Api, fields: dict[str, str], status: int) -> None:
    api.problem("POST", "convert", status, files=parts({"n.kml": samples.KML}), data=fields)


def test_conversion_without_files_is_refused(api: Api) -> None:
    api.problem("POST", "convert", 415, json={"to": "kml"})
    api.problem("POST", "convert", 422, files={"to": (None, "kml")})
    api.problem("POST", "convert", 422, files=parts({"../x": samples.KML}), data={"to": "tmap2"})
    api.problem("POST", "convert", 422, files=parts({"x.bin": b"\x00\x01nothing"}), data={"to": "tmap2"})


# --- access ---


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, Api]]:
    """Run a server with an environment and a client of every role."""
    with running(settings_for(tmp_path_factory.mktemp("guarded"))) as api:
        api.post("environments", {"name": "farm-1"})
        api.post("environments", {"name": "street"})
        api.upload("farm-1", {"datum.yaml": samples.DATUM, "n.tmap2.yaml": samples.tmap2()})
        roles = {role: api.token_for(role) for role in ("viewer", "robot", "editor", "admin")}
        roles["scoped"] = api.token_for("editor", environments="farm-*")
        roles["scoped admin"] = api.token_for("admin", environments="farm-*")
        yield {**roles, "first": api, "nobody": api.as_(None)}


E = "environments/farm-1"
READS = [
    "environments", E, f"{E}/versions", f"{E}/versions/1", f"{E}/versions/1/sources", f"{E}/versions/1/layers",
    f"{E}/versions/1/sources/n.tmap2.yaml", f"{E}/versions/1/layers/topology", f"{E}/versions/1/maps",
    f"{E}/versions/1/maps/tmap2", f"{E}/versions/1/maps/tmap2/network.tmap2.yaml", f"{E}/versions/1/reports/tmap2",
    f"{E}/diff?from=0&to=1", f"{E}/channels", f"{E}/transform?xy=1,2", "formats", "/maps/farm-1/tmap2",
    "/maps/farm-1/tmap2/network.tmap2.yaml", "/metrics",
]  # fmt: skip
EDITS = [
    ("POST", f"{E}/versions", {"json": {"revert_to": 99}}),
    ("POST", f"{E}/edits", {"json": {"changes": [{"op": "delete", "layer": "zones", "id": "x"}]}}),
    ("PUT", f"{E}/channels/production", {"json": {"version": 99}}),
    ("DELETE", f"{E}/channels/production/planned", {}),
    ("POST", "convert", {"files": parts({"n.kml": samples.KML}), "data": {"to": "nosuch"}}),
    ("PATCH", E, {"json": {"datum": {"latitude": samples.LATITUDE, "longitude": samples.LONGITUDE}}}),
]
RULES = [
    ("POST", "environments", {"json": {"name": "farm-1"}}),
    ("PATCH", E, {"json": {"title": "x"}}),
    ("POST", f"{E}/restore", {}),
    ("POST", f"{E}/purge", {}),
    ("GET", "tokens", {}),
    ("POST", "tokens", {"json": {"name": "", "role": "king"}}),
    ("DELETE", "tokens/nosuch", {}),
]


@pytest.mark.parametrize("path", READS)
def test_every_role_reads(guarded: dict[str, Api], path: str) -> None:
    for role in ("viewer", "robot", "editor", "admin"):
        guarded[role].get(path)
    answer = guarded["nobody"]("GET", path, 401)
    assert answer.headers["www-authenticate"].startswith("Bearer")
    problem(answer)


@pytest.mark.parametrize(("method", "path", "more"), EDITS)
def test_editors_change_content(guarded: dict[str, Api], method: str, path: str, more: dict[str, object]) -> None:
    for role in ("viewer", "robot"):
        guarded[role].problem(method, path, 403, **more)
    for role in ("editor", "admin"):
        assert guarded[role](method, path, None, **more).status_code not in (401, 403)
    guarded["nobody"].problem(method, path, 401, **more)


@pytest.mark.parametrize(("method", "path", "more"), RULES)
def test_administrators_manage_environments(
    guarded: dict[str, Api], method: str, path: str, more: dict[str, object]
) -> None:
    for role in ("viewer", "robot", "editor"):
        guarded[role].problem(method, path, 403, **more)
    assert guarded["admin"](method, path, None, **more).status_code not in (401, 403)
    guarded["nobody"].problem(method, path, 401, **more)


def test_limited_token_accesses_its_environments_only(guarded: dict[str, Api]) -> None:
    scoped, ruler = guarded["scoped"], guarded["scoped admin"]
    assert [e["name"] for e in scoped.get("environments").json()] == ["farm-1"]
    scoped.get(E)
    scoped.get("/maps/farm-1/tmap2")
    scoped.get("/maps/farm-1/tmap2")
    for path in ("environments/street", "environments/street/versions", "/maps/street/tmap2", "environments/nowhere"):
        scoped.problem("GET", path, 403)
    scoped.problem("POST", "environments/street/edits", 403, json={"changes": []})
    scoped.problem("GET", "/metrics", 403)
    ruler.problem("GET", "tokens", 403)
    ruler.problem("POST", "tokens", 403, json={"name": "x", "role": "admin"})
    ruler.problem("POST", "environments", 403, json={"name": "road"})
    ruler.problem("POST", "environments", 403, json={"name": "farm-2", "clone": {"environment": "street"}})
    ruler.problem("PATCH", E, 403, json={"name": "street-2"})


def test_cached_response_needs_access(guarded: dict[str, Api]) -> None:
    """Cached responses are only for clients with access."""
    path = "/maps/farm-1/tmap2"
    for _ in range(3):
        guarded["admin"].get(path)
    guarded["nobody"].problem("GET", path, 401)
    guarded["first"].as_("wrong-token").problem("GET", path, 401)
    outside = guarded["first"].token_for("viewer", environments="street")
    outside.problem("GET", path, 403)
    outside.problem("GET", path, 403)
    guarded["admin"].get(path)


def test_open_addresses_need_no_token(guarded: dict[str, Api]) -> None:
    for path in ("/healthz", "/readyz", "/docs", "/openapi.json", "/docs/swagger-ui-bundle.js"):
        guarded["nobody"].get(path)
    for path in ("/nothing", "/api/v1", "/api/v1/nothing", "/metrics"):
        guarded["nobody"].problem("GET", path, 401)


def test_tokens_are_created_listed_and_revoked(guarded: dict[str, Api]) -> None:
    api = guarded["first"]
    expires = (datetime.now(UTC) + timedelta(days=1)).isoformat()
    body = {"name": "mower", "role": "robot", "environments": "farm*", "robot": "mower-3", "expires": expires}
    answer = api.post("tokens", body)
    token = answer.json()
    assert answer.headers["cache-control"] == "no-store"
    assert len(token["token"]) >= 22
    assert (token["role"], token["robot"], token["environments"]) == ("robot", "mower-3", "farm*")
    listed = {t["id"]: t for t in api.get("tokens").json()}
    assert "token" not in listed[token["id"]]
    assert token["token"] not in api.get("tokens").text
    client = api.as_(token["token"])
    client.get(E)
    api("DELETE", f"tokens/{token['id']}", 204)
    client.problem("GET", E, 401)
    api.problem("DELETE", f"tokens/{token['id']}", 404)
    for bad in (
        {"name": "x"},
        {"name": "", "role": "viewer"},
        {"name": "x", "role": "viewer", "robot": "r"},
        {"name": "x", "role": "viewer", "expires": "2020-01-01T00:00:00Z"},
        {"name": "x", "role": "viewer", "expires": "2099-01-01T00:00:00"},
    ):
        api.problem("POST", "tokens", 422, json=bad)


def test_robot_token_names_its_robot(guarded: dict[str, Api]) -> None:
    api = guarded["first"]
    assert api.post("tokens", {"name": "mower-3", "role": "robot"}).json()["robot"] == "mower-3"
    token = api.post("tokens", {"name": "the red one", "role": "robot", "robot": "Mower.4"}).json()
    assert (token["name"], token["robot"]) == ("the red one", "Mower.4")
    assert api.post("tokens", {"name": "the red one", "role": "viewer"}).json()["robot"] is None
    for bad, location in (
        ({"name": "the red one"}, "name"), ({"name": "r/1"}, "name"), ({"name": "r" * 129}, "name"),
        ({"name": "r", "robot": "a b"}, "robot"), ({"name": "r", "robot": "-r"}, "robot"),
    ):  # fmt: skip
        body = api.problem("POST", "tokens", 422, json={"role": "robot", **bad})
        assert [e["where"] for e in body["errors"]] == [location]
        assert "A-Z, a-z, 0-9" in body["detail"]


def test_robot_token_without_a_robot_still_reads(guarded: dict[str, Api]) -> None:
    """Former releases created such tokens without a robot's name."""
    api = guarded["first"]
    old = api.token_for("robot", name="old-robot")
    store = api.app.state.services.store
    with store._database.write() as connection:
        changed = connection.execute(update(tables.token).where(tables.token.c.name == "old-robot").values(robot=None))
    assert changed.rowcount == 1
    old.get(E)
    old.get("/maps/farm-1/tmap2")
    status = {"environment": "farm-1", "channel": "latest", "version": 1, "root": "0" * 64, "state": "active"}
    assert "names no robot" in old.problem("PUT", "robots/old-robot/status", 403, json=status)["detail"]


def test_expired_token_is_refused(guarded: dict[str, Api]) -> None:
    api = guarded["first"]
    api.get("/maps/farm-1/tmap2")  # converted before
    expires = datetime.now(UTC) + timedelta(seconds=5)
    short = api.token_for("viewer", expires=expires.isoformat())
    short.get("/maps/farm-1/tmap2")
    eventually(lambda: short.get("/maps/farm-1/tmap2", None).status_code == 401)
    assert datetime.now(UTC) >= expires
    short.problem("GET", "/maps/farm-1/tmap2", 401)


def test_last_administrator_token_cannot_be_revoked(tmp_path: Path) -> None:
    with running(settings_for(tmp_path)) as api:
        (only,) = api.get("tokens").json()
        api.problem("DELETE", f"tokens/{only['id']}", 409)
        limited = api.token_for("admin", environments="farm")
        api.problem("DELETE", f"tokens/{only['id']}", 409)
        limited.close()
        second = api.token_for("admin")
        second("DELETE", f"tokens/{only['id']}", 204)
        api.problem("GET", "formats", 401)


def test_repeated_wrong_tokens_return_429(tmp_path: Path) -> None:
    with running(settings_for(tmp_path, token_failures=3)) as api:
        api.get("formats")
        wrong = api.as_("wrong")
        for _ in range(3):
            wrong.problem("GET", "formats", 401)
        answer = wrong("GET", "formats", 429)
        assert int(answer.headers["retry-after"]) > 0
        problem(answer)
        wrong.get("/healthz")
        for path in ("formats", "environments"):
            api.as_(None).get(path, headers={"Authorization": f"Bearer {ADMIN}"})
        late = api.token_for("robot", name="r1")
        late.get("formats")
        late("PUT", "robots/r1/status", 422, json={})


def test_insecure_mode_accepts_local_requests_only(tmp_path: Path) -> None:
    with running(settings_for(tmp_path, insecure_no_auth=True, admin_token=None)) as api:
        open_ = api.as_(None)
        open_.post("environments", {"name": "farm"})
        open_.upload("farm", {"n.tmap2.yaml": samples.tmap2()})
        for _ in range(2):
            open_.get("/maps/farm/tmap2")
            open_.problem("GET", "/maps/farm/tmap2", 403, headers={"Host": "evil.example"})
        open_.problem("GET", "formats", 403, headers={"Host": "evil.example"})
        open_.problem("POST", "environments", 403, json={"name": "x"}, headers={"Origin": "https://evil.example"})
        open_.get("formats", headers={"Origin": api.url})


# --- health ---


def test_health_and_metrics(api: Api, farm: str) -> None:
    assert api.get("/healthz").json() == {"status": "ok"}
    assert api.get("/readyz").json()["status"] == "ready"
    for _ in range(3):
        api.get(f"/maps/{farm}/tmap2")
    text = api.get("/metrics").text
    for name in (
        "fleetmap_requests_total", "fleetmap_request_seconds_bucket", "fleetmap_conversions_total",
        "fleetmap_cache_hits_total", "fleetmap_head", "fleetmap_environments", "fleetmap_uploads_total",
    ):  # fmt: skip
        assert re.search(rf"^{name}[{{ ]", text, re.MULTILINE), name
    assert f'fleetmap_head{{environment="{farm}"}} 3.0' in text
    assert 'route="/maps/{env}/{format}"' in text
    assert 'route="/api/v1/environments/{env}/versions"' in text
    assert farm not in "".join(line for line in text.splitlines() if line.startswith("fleetmap_requests"))


def test_readiness_without_database_returns_503(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from app.errors import Unavailable
    from app.store.store import Store

    with running(settings_for(tmp_path)) as api:

        def away(_: Store) -> None:
            raise Unavailable("the database does not answer")

        monkeypatch.setattr(Store, "check", away)
        answer = api("GET", "/readyz", 503)
        assert int(answer.headers["retry-after"]) > 0
        problem(answer)
        api.get("/healthz")


# --- errors ---


@pytest.mark.parametrize(
    ("method", "path", "status", "more"),
    [
        ("GET", "/nothing", 404, {}),
        ("GET", "/api/v1/nothing", 404, {}),
        ("GET", "/api/v1/environments/", 404, {}),
        ("PUT", "/api/v1/environments", 405, {"json": {}}),
        ("DELETE", "/healthz", 405, {}),
        ("POST", "/api/v1/environments", 400, {"content": b"{", "headers": {"Content-Type": "application/json"}}),
        ("POST", "/api/v1/environments", 422, {"json": {"name": 1}}),
        ("POST", "/api/v1/environments", 422, {}),
        ("POST", "/api/v1/environments", 415, {"content": b"{}", "headers": {"Content-Type": "text/json"}}),
        ("GET", "/docs/nothing.js", 404, {}),
        ("GET", "/api/v1/jobs/nosuch", 404, {}),
    ],
)
def test_errors_have_one_shape(api: Api, method: str, path: str, status: int, more: dict[str, object]) -> None:
    answer = api(method, path, status, **more)
    problem(answer)
    if status == 405:
        assert answer.headers["allow"]


def test_internal_error_reveals_no_data(
    api: Api, bare: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    from app.store.channels import Channels

    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("secret /etc/path and token")

    monkeypatch.setattr(Channels, "all", broken)
    body = api.problem("GET", f"environments/{bare}/channels", 500)
    assert "secret" not in str(body)
    assert "RuntimeError at " in caplog.text
    assert "secret" not in caplog.text
    assert "/" not in next(r.getMessage() for r in caplog.records if "internal error" in r.getMessage())


def test_damaged_data_logs_an_alarm(
    api: Api, farm: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    from app.errors import Damaged
    from app.store.blobs import Blobs

    def damaged(*_: object) -> bytes:
        raise Damaged("blob 12ab does not match its hash")

    monkeypatch.setattr(Blobs, "get", damaged)
    api.problem("GET", f"environments/{farm}/versions/2/sources/network.tmap2.yaml", 500)
    assert [r for r in caplog.records if r.levelname == "CRITICAL"]


def test_full_disk_returns_507(api: Api, bare: str, monkeypatch: pytest.MonkeyPatch) -> None:
    import errno

    from app.ingest import Ingest

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", "/var/lib/somewhere")

    monkeypatch.setattr(Ingest, "upload", full)
    answer = api.upload(bare, {"n.tmap2.yaml": samples.tmap2()}, expect=507)
    assert answer.headers["retry-after"]
    assert "somewhere" not in answer.text
    problem(answer)


def test_tokens_do_not_reach_the_log(api: Api, bare: str, caplog: pytest.LogCaptureFixture) -> None:
    api.get(f"environments/{bare}")
    api.as_("a-wrong-token-of-mine").problem("GET", "formats", 401)
    assert ADMIN not in caplog.text
    assert "a-wrong-token-of-mine" not in caplog.text


# --- the first start ---


def test_first_start_prints_a_token_once(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    settings = settings_for(tmp_path, admin_token=None)
    with running(settings) as api:
        (token,) = re.findall(r"shown only once: (\S+)", capfd.readouterr().out)
        assert len(token) >= 22
        api.as_(token).get("tokens")
    with running(settings) as api:
        assert "token" not in capfd.readouterr().out
        api.as_(token).post("environments", {"name": "kept"})
    with running(settings_for(tmp_path)) as api:
        assert [e["name"] for e in api.get("environments").json()] == ["kept"]
        api.as_(token).get("tokens")


def test_server_stops_cleanly(tmp_path: Path) -> None:
    with running(settings_for(tmp_path)) as api:
        api.post("environments", {"name": "farm"})
        api.upload("farm", {"n.tmap2.yaml": samples.tmap2()})
        services = api.app.state.services
        workers = [w.process for w in services.pool._workers.values()]
        assert workers
        listening = api.as_(api.token).http.stream("GET", f"{API}/events?since=0", timeout=60)
        lines = listening.__enter__().iter_lines()
        while "version.created" not in next(lines):
            pass
        api.others.clear()  # it still listens while the server stops
    assert [line for line in lines if line.startswith("event")] == [], "its stream ends without a broken connection"
    listening.__exit__(None, None, None)
    assert not any(w.is_alive() for w in workers)
    assert [p.name for p in (tmp_path / "spool").iterdir()] == [".lock"]
    with running(settings_for(tmp_path)) as api:
        assert api.get("environments/farm").json()["version"] == 1


Fresh = Callable[[], str]


def test_settings_reach_the_pool(tmp_path: Path) -> None:
    with running(settings_for(tmp_path, max_features=5)) as api:
        api.post("environments", {"name": "farm"})
        answer = api.upload("farm", {"n.tmap2.yaml": samples.tmap2()}, expect=413)
        assert "5" in problem(answer)["detail"]
    assert API == "/api/v1"


@pytest.mark.skipif(sandbox.landlock_version() < 1, reason="the kernel has no Landlock")
def test_workers_read_the_live_database_and_write_no_file_of_the_server(tmp_path: Path) -> None:
    with running(settings_for(tmp_path)) as api:
        create_farm(api, "farm")
        services = api.app.state.services
        names = {p.relative_to(tmp_path).parts[0]: p for p in tmp_path.rglob("*") if p.is_file() and p.stat().st_size}
        assert {"keys", "blobs", "fleetmap.sqlite3", "fleetmap.sqlite3-wal"} <= names.keys()
        for path in names.values():
            if path.name.endswith("-shm"):
                continue
            before = path.read_bytes()
            with pytest.raises(RuntimeError, match="PermissionError"):
                services.pool.run(work_write, str(path), "x")
            assert path.read_bytes() == before


def head_of(url: str, blob_dir: str, environment: str) -> int:
    """Run in a worker."""
    return open_store(url, blob_dir).environments.get(environment).head


@pytest.mark.skipif(sandbox.landlock_version() < 1, reason="the kernel has no Landlock")
def test_worker_reads_a_database_whose_shared_memory_is_newer_than_the_worker(tmp_path: Path) -> None:
    """SQLite removes the file when the last connection closes. A worker may write to the file it started with only."""
    settings = settings_for(tmp_path)
    file, blob_dir = tmp_path / "fleetmap.sqlite3", str(settings.blob_dir)
    file.write_bytes(empty_database())
    pool = Pool(1, allowed=sandbox_policy(settings))
    try:
        assert pool.run(work_double, 1) == 2, "it runs, confined"
        assert not Path(f"{file}-shm").exists()
        with contextlib.closing(Store(settings.database, settings.blob_dir)) as store:
            for name in ("a", "b", "c"):
                store.environments.create(name)
                assert pool.run(head_of, settings.database, blob_dir, name) == 0
            with pytest.raises(RuntimeError, match="PermissionError"):
                pool.run(work_write, f"{file}-shm", "x")
    finally:
        pool.close()

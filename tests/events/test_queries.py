"""Maps and versions asked for over Zenoh, and what else comes in from the bus: the same answers as over HTTP."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest
import zenoh

from app.errors import Damaged
from tests.api import samples
from tests.api.conftest import Api, running, settings_for
from tests.api.conftest import problem as problem_of
from tests.events.conftest import client_config, eventually, status_payload
from tests.ports import free_port


@pytest.fixture(scope="module")
def port() -> int:
    return free_port()


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory, port: int) -> Iterator[Api]:
    endpoint = f"tcp/127.0.0.1:{port}"
    with running(settings_for(tmp_path_factory.mktemp("asked"), zenoh_mode="router", zenoh_listen=endpoint)) as api:
        eventually(lambda: api.get("/readyz").json()["events"]["state"] == "connected")
        yield api


def test_maps_over_zenoh_equal_http(api: Api, session: zenoh.Session) -> None:
    api.post("environments", {"name": "asked"})
    api.upload("asked", {"network.tmap2.yaml": samples.tmap2()})
    api.upload("asked", samples.grid())

    def get(key: str) -> Any:
        reply = next(iter(session.get(key, timeout=60.0)))
        return reply.ok if reply.ok is not None else reply.err

    for version in ("1", "latest"):
        reply = get(f"fleetmap/asked/{version}/maps/tmap2/network.tmap2.yaml")
        response = api.get(f"environments/asked/versions/{version}/maps/tmap2/network.tmap2.yaml")
        assert bytes(reply.payload) == response.content
        assert str(reply.encoding) in response.headers["content-type"]
    grid = get("fleetmap/asked/latest/maps/occupancy_grid/map.yaml?resolution=0.5")
    assert bytes(grid.payload) == api.get("/maps/asked/occupancy_grid/map.yaml?resolution=0.5").content
    version = json.loads(bytes(get("fleetmap/asked/2/version").payload))
    assert version == api.get("environments/asked/versions/2").json()
    for path, options in (
        ("asked/latest/maps/nothing/x", ""),
        ("asked/99/version", ""),
        ("nowhere/latest/version", ""),
        ("asked/latest/maps/tmap2/other.yaml", ""),
        ("asked/latest/maps/occupancy_grid", "resolution=nan"),
        ("asked/latest/maps/occupancy_grid", "resolution=0.5;resolution=0.1"),
        ("asked/latest/maps/occupancy_grid", "colour=red"),
        ("asked/latest/maps/osm", ""),
    ):
        environment, _, rest = path.partition("/")
        response = api.get(f"environments/{environment}/versions/{rest.removesuffix('/version')}", expect=None, params=[
            tuple(pair.split("=")) for pair in options.split(";") if pair
        ])  # fmt: skip
        refused = get(f"fleetmap/{path}?{options}")
        assert json.loads(bytes(refused.payload)) == problem_of(response)
        assert str(refused.encoding) == "application/problem+json"
    for key in ("fleetmap/*/*/version", "fleetmap/asked/latest/maps/**", "**"):
        problem = json.loads(bytes(get(key).payload))
        assert (problem["status"], "wildcards are unsupported" in problem["detail"]) == (422, True)


def test_environments_by_position_equal_http(api: Api, session: zenoh.Session) -> None:
    for name, files in (("fenced", {"datum.yaml": samples.DATUM}), ("bare", None)):
        api.post(
            "environments", {"name": name, "datum": {"latitude": samples.LATITUDE, "longitude": samples.LONGITUDE}}
        )
        if files:
            api.upload(name, files)

    def get(parameters: str) -> Any:
        reply = next(iter(session.get(f"fleetmap/server/where{parameters}", timeout=60.0)))
        return reply.ok if reply.ok is not None else reply.err

    answer = get("?lat=53.2687;lon=-0.5246")
    environments = json.loads(bytes(answer.payload))
    assert environments == api.get("environments", params={"contains": "53.2687,-0.5246"}).json()
    assert [(e["name"], e["match"]["by"]) for e in environments if e["name"] in ("fenced", "bare")] == [
        ("fenced", "fence"),
        ("bare", "datum"),
    ]
    assert str(answer.encoding) == "application/json"
    assert json.loads(bytes(get("?lat=-53.2687;lon=-0.5246").payload)) == []
    for bad in (
        "",
        "?lat=1",
        "?lat=91;lon=0",
        "?lat=nan;lon=0",
        "?lat=a;lon=b",
        "?lat=1;lon=2;crs=local",
        "?lat=1,2;lon=3",
    ):
        refused = get(bad)
        problem = json.loads(bytes(refused.payload))
        assert (problem["status"], str(refused.encoding)) == (422, "application/problem+json"), bad
        assert "lat" in problem["detail"]


def test_conversion_does_not_block_other_queries(
    api: Api, session: zenoh.Session, port: int, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    api.post("environments", {"name": "busy"})
    api.upload("busy", {"network.tmap2.yaml": samples.tmap2()})
    go, maps, late = threading.Event(), api.app.state.services.maps, []
    make = maps.fetch

    def slow(*args: Any, **more: Any) -> Any:
        assert go.wait(60)
        return make(*args, **more)

    monkeypatch.setattr(maps, "fetch", slow)
    try:
        for _ in range(10):
            session.get("fleetmap/busy/latest/maps/geojson/map.geojson", late.append, timeout=60.0)
        with zenoh.open(client_config(port)) as leaves:
            leaves.get("fleetmap/busy/latest/maps/geojson", lambda _: None, timeout=60.0)
            quick = next(iter(session.get("fleetmap/busy/1/version", timeout=60.0)))
        assert quick.ok is not None
        assert not late
    finally:
        go.set()
    eventually(lambda: len(late) == 10)
    assert len({bytes(reply.ok.payload) for reply in late}) == 1
    assert not [r for r in caplog.records if r.levelname == "ERROR"], "who left before the answer is no error"


def test_complete_site_over_zenoh_equals_http(api: Api, session: zenoh.Session) -> None:
    api.post("environments", {"name": "tower"})
    api.upload("tower", samples.grid())
    api.upload("tower", samples.grid(width=12), grid="nav", level="a/b 2")
    base, folder = "tower/latest/maps/occupancy_grid", "a%2Fb%202"
    for rest, query in (
        ("", "level=*;grid=*"),
        (f"/{folder}/nav.pgm", ""),
        (f"/{folder}/nav.yaml", "level=*;grid=*"),
        ("/map.yaml", "level=*"),
    ):
        reply = next(iter(session.get(f"fleetmap/{base}{rest}?{query}", timeout=60.0)))
        assert reply.ok is not None, bytes(reply.err.payload)
        path = f"environments/tower/versions/latest/maps/occupancy_grid{quote(rest)}?{query.replace(';', '&')}"
        assert bytes(reply.ok.payload) == api.get(path).content
    reply = next(iter(session.get(f"fleetmap/{base}/L9/map.yaml", timeout=60.0)))
    assert json.loads(bytes(reply.err.payload))["status"] == 404


def test_file_too_large_for_zenoh_is_not_read(
    api: Api, session: zenoh.Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    api.post("environments", {"name": "large"})
    api.upload("large", samples.grid())
    ready = api.app.state.services.maps.get_cached
    api.get("/maps/large/occupancy_grid/map.pgm")

    def huge(recipe: Any) -> Any:
        cached_map = ready(recipe)
        return replace(cached_map, files=tuple(replace(f, size=2**40, path=Path("/nowhere")) for f in cached_map.files))

    monkeypatch.setattr(api.app.state.services.maps, "get_cached", huge)
    reply = next(iter(session.get("fleetmap/large/latest/maps/occupancy_grid/map.pgm", timeout=60.0)))
    problem = json.loads(bytes(reply.err.payload))
    assert (problem["status"], problem["title"]) == (413, "Too large")
    assert "1099511627776 bytes; the limit over Zenoh is 67108864: fetch it over HTTP" in problem["detail"]


def test_damaged_data_is_logged_as_critical_for_zenoh_queries(
    api: Api, session: zenoh.Session, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    api.post("environments", {"name": "rotten"})
    for error, level in ((Damaged("chunk 4711 has other bytes"), "CRITICAL"), (KeyError("a secret"), "ERROR")):

        def fail(*_: Any, error: Exception = error) -> Any:
            raise error

        with monkeypatch.context() as patch:
            patch.setattr(api.app.state.services.store.versions, "get", fail)
            reply = next(iter(session.get("fleetmap/rotten/0/version", timeout=60.0)))
        assert json.loads(bytes(reply.err.payload))["status"] == 500
        assert [r.levelname for r in caplog.records if r.levelname == level]
    assert "a secret" not in caplog.text


def test_status_keys_with_wildcards_are_ignored(
    api: Api, session: zenoh.Session, caplog: pytest.LogCaptureFixture
) -> None:
    api.post("environments", {"name": "wild"})
    for key in (
        "**",
        "fleetmap/**",
        "fleetmap/**/status",
        "fleetmap/*/robots/*/status",
        "fleetmap/wild/robots/r$*/status",
    ):
        session.put(key, status_payload(5))
    session.delete("fleetmap/wild/robots/r1/status")
    session.put("fleetmap/wild/robots/r2/status", status_payload(1))
    eventually(lambda: api.get("robots/r2", expect=None).status_code == 200)
    assert [r["robot"] for r in api.get("robots?environment=wild").json()] == ["r2"]
    assert not [r for r in caplog.records if r.levelname == "ERROR"]


def test_server_has_liveliness_token(api: Api, session: zenoh.Session) -> None:
    tokens = [str(r.ok.key_expr) for r in session.liveliness().get("fleetmap/server", timeout=60.0) if r.ok]
    assert tokens == ["fleetmap/server"]

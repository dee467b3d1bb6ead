"""Damaged storage and full disks, as seen by clients: no wrong byte is served, and everything else keeps working."""

from __future__ import annotations

import contextlib
import logging
import os
import sqlite3
import subprocess
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import httpx
import pytest

from app.api.http.dependencies import Writability
from app.errors import NoRoom
from tests.api import samples
from tests.api.conftest import Api, problem, running, settings_for

NETWORK = "n.tmap2.yaml"


def flip(path: Path, at: int | None = None, count: int = 1) -> None:
    """Change bytes of a file but keep its timestamps, like bit rot."""
    before = path.stat()
    with path.open("r+b") as file:
        file.seek(before.st_size // 2 if at is None else at)
        old = file.read(count)
        file.seek(-len(old), os.SEEK_CUR)
        file.write(bytes(byte ^ 0xFF for byte in old))
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


def environment(api: Api, name: str) -> str:
    api.post("environments", {"name": name, "datum": {"latitude": samples.LATITUDE, "longitude": samples.LONGITUDE}})
    return name


def cached(folder: Path) -> list[Path]:
    return [p for p in (folder / "cache").glob("??/*/*") if p.parent.parent.name != "locks" and p.name != "map.json"]


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Api, Path]]:
    """Start a server whose files these tests damage."""
    folder = tmp_path_factory.mktemp("damage")
    with running(settings_for(folder, memory_cache_bytes=0)) as api:
        yield api, folder


def forget(api: Api) -> None:
    """Clear the server's memory, like a restart."""
    services = api.app.state.services
    services.response_cache._entries.clear()
    services.store.chunks.forget()


def test_damaged_cached_maps_are_converted_again(server: tuple[Api, Path]) -> None:
    api, folder = server
    farm = environment(api, "cached")
    api.upload(farm, {NETWORK: samples.tmap2()})
    for path in (f"/maps/{farm}/tmap2", f"/maps/{farm}/environment"):
        good = api.get(path)
        files = cached(folder)
        assert files
        for harm in (flip, lambda p: p.write_bytes(bytes(p.stat().st_size))):
            for file in files:
                if file.exists():
                    harm(file)
            forget(api)
            again = api.get(path)
            assert again.content == good.content
            assert again.headers["etag"] == good.headers["etag"]
    assert "fleetmap_cache_damaged_total" in api.get("/metrics").text


def test_damaged_large_map_breaks_the_download(server: tuple[Api, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.api.maps.IN_MEMORY", 100)
    monkeypatch.setattr("app.api.http.streams.CHUNK", 64)
    api, folder = server
    farm = environment(api, "large")
    before = set(cached(folder))
    api.upload(farm, {NETWORK: samples.tmap2({"gate": (0.0, 0.0), "barn": (11.0, 0.0), "field": (10.0, 8.0)})})
    good = api.get(f"/maps/{farm}/tmap2").content
    (file,) = set(cached(folder)) - before
    flip(file)
    forget(api)
    with pytest.raises(httpx.RemoteProtocolError):
        api.get(f"/maps/{farm}/tmap2", None)
    assert api.get(f"/maps/{farm}/tmap2").content == good
    (file,) = set(cached(folder)) - before
    flip(file)
    os.utime(file)  # something wrote to it
    forget(api)
    assert api.get(f"/maps/{farm}/tmap2", 206, headers={"Range": "bytes=10-2000"}).content == good[10:2001]


def test_upload_repairs_damaged_files_and_chunks(server: tuple[Api, Path]) -> None:
    api, folder = server
    farm = environment(api, "healed")
    other = samples.tmap2().replace(b"0.1", b"0.2")
    first = {NETWORK: samples.tmap2(), "notes.txt": b"x" * 100_000, "small.txt": b"small"}
    place = f"environments/{farm}/versions/{api.upload(farm, first).json()['version']}"
    good = api.get(f"{place}/maps/tmap2").content
    blobs = [p for p in (folder / "blobs").rglob("*") if p.is_file() and len(p.name.split(".")[0]) == 64]
    for path in blobs:
        path.write_bytes(bytes(path.stat().st_size))
    with contextlib.closing(sqlite3.connect(folder / "fleetmap.sqlite3")) as database, database:
        database.execute("UPDATE chunk SET data = zeroblob(length(data))")
    for path in cached(folder):
        path.unlink()
    forget(api)
    api.problem("GET", f"{place}/sources/notes.txt", 500)
    store = api.app.state.services.store
    assert {f.kind for f in store.verifier().run().findings} == {"chunk", "blob"}
    answer = api.upload(farm, first, None)
    assert answer.status_code == 200, answer.text
    forget(api)
    assert api.get(f"{place}/maps/tmap2").content == good
    assert [f for f in store.verifier().run().findings if (farm, 2) in f.versions] == []
    for name, data in first.items():
        assert api.get(f"{place}/sources/{name}").content == data
    with contextlib.closing(sqlite3.connect(folder / "fleetmap.sqlite3")) as database, database:
        database.execute("UPDATE chunk SET data = zeroblob(length(data))")
    forget(api)
    version = api.upload(farm, {NETWORK: other}).json()["version"]
    api.get(f"environments/{farm}/versions/{version}/maps/tmap2")  # another upload is stored despite the damage


# --- the database's own file ---


def damage_pages(path: Path) -> None:
    """Overwrite every page except the first, which has the page size and the roots of the tables."""
    with contextlib.closing(sqlite3.connect(path)) as database:
        database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    with path.open("r+b") as file:
        file.seek(4096)
        file.write(b"\xa5" * (path.stat().st_size - 4096))


def reopen(api: Api) -> None:
    """Open new connections, with empty page caches."""
    api.app.state.services.store._database.engine.dispose()


def test_malformed_database_is_reported_as_not_ready(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    file = tmp_path / "fleetmap.sqlite3"
    with running(settings_for(tmp_path)) as api:
        farm = environment(api, "farm")
        assert api.get("/readyz").json()["status"] == "ready"
        damage_pages(file)
        reopen(api)
        forget(api)
        for _ in range(3):
            body = api.problem("GET", f"environments/{farm}/versions", 503)
            assert "fleetmap.sqlite3" in body["detail"]
            assert "fleetmap verify" in body["detail"]
            assert str(tmp_path) not in str(body)
        body = problem(api("GET", "/readyz", 503))
        assert "fleetmap.sqlite3" in body["detail"]
        api.get("/healthz")
        alarms = [r for r in caplog.records if r.levelno >= logging.CRITICAL and r.name == "app.store.database"]
        assert len(alarms) == 1, "logged once"
        assert str(file) in alarms[0].getMessage()


def test_missing_or_replaced_database_file_refuses_writes(tmp_path: Path) -> None:
    file = tmp_path / "fleetmap.sqlite3"
    with running(settings_for(tmp_path)) as api:
        environment(api, "farm")
        file.rename(tmp_path / "away")
        for method, path in (("GET", "environments/farm"), ("POST", "environments")):
            body = api.problem(method, path, 503, **({"json": {"name": "lost"}} if method == "POST" else {}))
            assert "fleetmap.sqlite3 is missing" in body["detail"]
        problem(api("GET", "/readyz", 503))
        assert not file.exists(), "no empty database replaces it"
        file.write_bytes((tmp_path / "away").read_bytes())
        assert "replaced" in api.problem("POST", "environments", 503, json={"name": "lost"})["detail"]
        file.unlink()
        (tmp_path / "away").rename(file)
        reopen(api)
        api.get("environments/farm")
        assert api.get("/readyz").status_code == 200


# --- full and read-only disks ---


def test_write_check_runs_once_for_many_requests() -> None:
    probes: list[int] = []
    full = False

    def probe() -> None:
        probes.append(1)
        if full:
            raise NoRoom("the disk is full")

    writability = Writability(probe)
    with ThreadPoolExecutor(8) as many:
        assert set(many.map(lambda _: writability.refusal(), range(50))) == {None}
    assert len(probes) < 25, "few checks, even if requests are slow"
    full = True
    writability.forget()
    assert writability.refusal() == "the disk is full"


def test_readiness_repeats_the_write_check(server: tuple[Api, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    api, probes = server[0], list[int]()
    monkeypatch.setattr("app.api.http.dependencies.WRITABLE_SECONDS", 3600.0)
    monkeypatch.setattr("app.api.http.uploads.check_room", lambda _: probes.append(1))
    api.app.state.services.writability.forget()
    for _ in range(5):
        assert api.get("/readyz?for=writes").json()["writes"] == "ok"
    assert len(probes) == 1
    api.app.state.services.writability.forget()


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    with mounted_disk(tmp_path / "disk") as folder:
        yield folder


@contextlib.contextmanager
def mounted_disk(folder: Path) -> Iterator[Path]:
    """Mount a disk of 12 MB."""
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=12m,mode=700", "tmpfs", str(folder)]
    if os.geteuid() != 0 or subprocess.run(command, check=False, capture_output=True).returncode != 0:
        pytest.skip("needs root to mount a small disk")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def fill(folder: Path) -> Path:
    """Fill a disk to its last byte."""
    ballast = folder / "ballast"
    for block in (bytes(4096), b"x"):
        with contextlib.suppress(OSError), ballast.open("ab", buffering=0) as file:
            while True:
                file.write(block)
    return ballast


def test_full_disk_stops_only_writes(small_disk: Path) -> None:
    settings = settings_for(small_disk / "data")
    for started_full in (False, True):
        with running(settings, migrates=True) as api:
            if not started_full:
                farm = environment(api, "farm")
                api.upload(farm, {NETWORK: samples.tmap2()})
                api.get(f"/maps/{farm}/tmap2")
                ballast = fill(small_disk)
            assert api.get(f"/maps/{farm}/tmap2").status_code == 200
            for name in ("kml", "geojson", "nav2_route", "environment"):
                assert api.get(f"/maps/{farm}/{name}").content, "converted without the cache"
            api.get(f"environments/{farm}/versions/latest/manifest", params={"formats": "tmap2,kml"})
            api.get("keys")
            api.get(f"environments/{farm}/versions/latest/sources/{NETWORK}")
            api.get("/metrics")
            answer = api.upload(farm, {NETWORK: samples.tmap2().replace(b"0.1", b"0.3")}, 507)
            assert int(answer.headers["retry-after"]) > 0
            problem(answer)
            for k in range(100):  # as long as the write-ahead log has free space in its file
                body = {"name": f"other-{started_full}-{k}".lower(), "description": "d" * 15_000}
                answer = api("POST", "environments", None, json=body)
                if answer.status_code != 201:
                    break
            assert answer.status_code == 507, answer.text
            assert int(answer.headers["retry-after"]) > 0
            assert api.get(f"/maps/{farm}/tmap2").status_code == 200
            api.app.state.services.writability.forget()
            ready = api.get("/readyz").json()
            assert ready["status"] == "read-only"
            assert ready["reads"] == "ok"
            assert "No space" in ready["writes"]
            assert "No space" in ready["cache"]
            problem(api("GET", "/readyz?for=writes", 503))
            if started_full:
                ballast.unlink()
                api.upload(farm, {NETWORK: samples.tmap2().replace(b"0.1", b"0.3")}, 201)
                api.get(f"/maps/{farm}/kml")
                api.app.state.services.writability.forget()
                ready = api.get("/readyz?for=writes").json()
                assert (ready["status"], ready["writes"], ready["cache"]) == ("ready", "ok", "ok")

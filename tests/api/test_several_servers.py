"""Several servers on one PostgreSQL and one blob store, with data folders of their own: what one made, all have."""

from __future__ import annotations

import base64
import hashlib
import os
import random
import shutil
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
import uvicorn

from app.config import Settings
from app.convert.maps import Maps
from app.errors import Unavailable
from app.main import open_store
from app.store.values import Source
from app.worker import create_worker
from tests.api import samples
from tests.api.conftest import Api, parts, running, settings_for
from tests.api.test_derivation_choice import SQUARE
from tests.events.conftest import eventually
from tests.preloaded import run_preloaded
from tests.seaweed import Fault, FaultyStore, Seaweed
from tests.store.samples import add_sources

pytestmark = pytest.mark.postgres

YARD = Path(__file__).resolve().parents[1] / "samples" / "gazebo" / "yard"


@pytest.fixture(params=["folder", "s3"])
def settings(request: pytest.FixtureRequest, postgres_url: str, tmp_path: Path) -> list[Settings]:
    """Settings of two servers that share the database and the blob store, and nothing else."""
    url = str(tmp_path / "blobs") if request.param == "folder" else request.getfixturevalue("s3_url")
    several = [settings_for(tmp_path / name, database_url=postgres_url, blob_url=url) for name in "ab"]
    for one in several:
        one.blob_dir.mkdir(parents=True, exist_ok=True)
    store = open_store(several[0])
    store.migrate()
    store.close()
    return several


@pytest.fixture
def servers(settings: list[Settings]) -> Iterator[list[Api]]:
    """Two running servers."""
    with ExitStack() as stack:
        yield [stack.enter_context(running(one)) for one in settings]


def sha256_of(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def conversions(servers: list[Api]) -> int:
    """Return how many maps all servers have converted."""
    return sum(server.app.state.services.maps.cache.misses for server in servers)


@contextmanager
def working(settings: Settings) -> Iterator[Any]:
    """Run a worker with these settings; yields the counter of its conversions."""
    app = create_worker(settings)
    server = uvicorn.Server(uvicorn.Config(app, host="127.0.0.1", port=0, log_config=None, lifespan="on"))
    thread = threading.Thread(target=server.run)
    thread.start()
    try:
        eventually(lambda: server.started and app.state.worker.is_connected, 60.0)
        yield app.state.services.metrics.conversions
    finally:
        server.should_exit = True
        thread.join(60)
        assert not thread.is_alive(), "the worker did not stop"


def test_job_of_one_server_is_followed_and_fetched_on_another(
    settings: list[Settings], monkeypatch: pytest.MonkeyPatch
) -> None:
    quick, gate = Maps.get_or_convert, threading.Event()

    def slow(self: Maps, recipe: Any, stop: Any) -> Any:
        assert gate.wait(60)
        return quick(self, recipe, stop)

    quick_to_answer = settings[0].model_copy(update={"job_seconds": 0.2})
    with running(quick_to_answer) as a, running(settings[1]) as b:
        a.post("environments", {"name": "farm"})
        a.upload("farm", {"n.tmap2.yaml": samples.tmap2()})
        monkeypatch.setattr(Maps, "get_or_convert", slow)
        started = a.get("/maps/farm/tmap2", 202).headers["location"]
        assert b.get(started).json()["state"] == "running"
        gate.set()
        done = eventually(lambda: (job := b.get(started).json())["state"] == "done" and job, 60.0)
        fetched = b.get(done["result"]["location"])
        assert fetched.content == a.get("/maps/farm/tmap2").content
        assert conversions([b]) == 0


def test_worker_shares_nothing_with_its_servers_but_database_and_blob_store(
    settings: list[Settings], tmp_path: Path
) -> None:
    """It reads uploaded meshes by their hashes, and leaves the map where the servers find it."""
    files = {p.relative_to(YARD).as_posix(): p.read_bytes() for p in YARD.rglob("*") if p.is_file()}
    url, place = settings[0].database_url, settings[0].blob_url
    with ExitStack() as stack:
        a, b = (stack.enter_context(running(one)) for one in settings)
        counter = stack.enter_context(working(settings_for(tmp_path / "w", database_url=url, blob_url=place)))
        a.post("environments", {"name": "yard"})
        a.upload("yard", files)
        maps = [server.get("/maps/yard/octomap").content for server in (b, a)]
        assert maps[0] == maps[1]
        assert counter.labels("octomap", "made")._value.get() == 1
        copies = list((tmp_path / "w" / "blobs").glob("[0-9a-f][0-9a-f]/*"))
        assert bool(copies) == str(place).startswith("s3:"), "files of the bucket, read by hash"
        assert conversions([a, b]) == 0


def test_what_a_worker_finds_out_about_a_map_is_known_to_its_server(settings: list[Settings], tmp_path: Path) -> None:
    """Else the server would ask for the same map again and again."""
    url, place = settings[0].database_url, settings[0].blob_url
    with (
        running(settings[0]) as api,
        working(settings_for(tmp_path / "w", database_url=url, blob_url=place)) as counter,
    ):
        api.post("environments", {"name": "beds"})
        api.upload("beds", {"a.geojson": SQUARE})
        manifest = "environments/beds/versions/latest/manifest?formats=geojson&optional=tmap2"
        body = api.get(manifest).json()
        assert [one["format"] for one in body["missing"]] == ["tmap2"]
        assert "outlines=true" in body["missing"][0]["detail"]
        api.upload("beds", samples.grid())
        network = api.get("/maps/beds/tmap2")
        assert network.content
        report = api.get("environments/beds/versions/latest/reports/tmap2").json()
        assert any("outlines=true" in one["problem"] for one in report["warnings"]), "it took another way"
        assert counter.labels("tmap2", "made")._value.get() == 1
        assert "missing" not in api.get(manifest).json() or not api.get(manifest).json()["missing"]


def test_map_made_on_one_server_is_served_by_all(servers: list[Api]) -> None:
    a, b = servers
    a.post("environments", {"name": "farm"})
    a.upload("farm", {"datum.yaml": samples.DATUM, "n.tmap2.yaml": samples.tmap2(), **samples.grid()})
    for address in ("/maps/farm/tmap2", "/maps/farm/geojson", "/maps/farm/occupancy_grid"):
        made = a.get(address)
        before = conversions(servers)
        served = b.get(address)
        assert (served.content, served.headers["etag"]) == (made.content, made.headers["etag"]), address
        assert conversions(servers) == before, f"{address} was converted again"
    assert conversions(servers) == conversions([a])


def test_delta_of_another_server_is_as_small(servers: list[Api]) -> None:
    a, b = servers
    a.post("environments", {"name": "farm"})
    a.upload("farm", {"datum.yaml": samples.DATUM, "n.tmap2.yaml": samples.tmap2()})
    old = a.get("/maps/farm/tmap2").content
    name, (x, y) = next(iter(samples.NODES.items()))
    a.upload("farm", {"n.tmap2.yaml": samples.tmap2({**samples.NODES, name: (x + 0.25, y)})})
    new = a.get("/maps/farm/tmap2").content
    assert new != old
    digest = base64.b64encode(hashlib.sha256(old).digest()).decode()
    headers = {"Accept-Encoding": "dcz", "Available-Dictionary": f":{digest}:"}
    sizes = []
    for server in servers:
        with server.http.stream("GET", "/maps/farm/tmap2", headers=headers) as answer:
            assert answer.headers["content-encoding"] == "dcz"
            sizes.append(len(b"".join(answer.iter_raw())))
    assert sizes[0] == sizes[1] < len(new) / 2
    assert conversions([b]) == 0


def test_sources_are_read_where_they_were_not_uploaded(servers: list[Api]) -> None:
    a, b = servers
    a.post("environments", {"name": "farm"})
    pixels = bytes(random.Random(3).choices((0, 205, 254), k=3000 * 3100))
    grid = {"map.pgm": b"P5\n3000 3100\n255\n" + pixels, "map.yaml": samples.grid()["map.yaml"]}
    a.upload("farm", grid)
    for name, data in grid.items():
        assert b.get(f"environments/farm/versions/1/sources/{name}").content == data
        part = b.get(f"environments/farm/versions/1/sources/{name}", 206, headers={"Range": "bytes=30-70"})
        assert part.content == data[30:71]


def test_workers_read_files_that_their_server_gets_for_them(servers: list[Api]) -> None:
    a, b = servers
    a.post("environments", {"name": "yard"})
    a.upload("yard", {p.relative_to(YARD).as_posix(): p.read_bytes() for p in YARD.rglob("*") if p.is_file()})
    made = b.get("/maps/yard/gazebo")
    assert conversions([a]) == 0
    assert made.content == a.get("/maps/yard/gazebo").content


def test_lost_shared_map_is_made_again(servers: list[Api]) -> None:
    a, b = servers
    a.post("environments", {"name": "farm"})
    a.upload("farm", {"datum.yaml": samples.DATUM, "n.tmap2.yaml": samples.tmap2()})
    made = a.get("/maps/farm/tmap2")
    files = a.app.state.services.store.blobs.files
    (shared,) = files.list("made/")
    files.write({shared.key: b"x" * shared.size})
    assert b.get("/maps/farm/tmap2").content == made.content
    assert conversions([b]) == 1
    (again,) = files.list("made/")
    assert b"".join(files.stream(again.key)) != b"x" * shared.size, "it is shared again"


def test_unused_shared_maps_are_collected(servers: list[Api]) -> None:
    a, b = servers
    a.post("environments", {"name": "farm"})
    a.upload("farm", {"datum.yaml": samples.DATUM, "n.tmap2.yaml": samples.tmap2()})
    made = a.get("/maps/farm/tmap2")
    store = a.app.state.services.store
    assert store.made_maps.collect() == 0
    assert store.made_maps.collect(days=-1) == 1
    assert list(store.blobs.files.list("made/")) == []
    assert a.get("/maps/farm/tmap2").content == made.content, "from the cache of this server"
    assert b.get("/maps/farm/tmap2").content == made.content, "converted again"
    store.garbage.collect(timedelta(0))
    assert len(list(store.blobs.files.list("made/"))) == 1


def test_verify_repairs_files_wherever_they_are(settings: list[Settings], tmp_path: Path) -> None:
    environment = {
        **os.environ,
        "FLEETMAP_DATABASE_URL": settings[1].database,
        "FLEETMAP_DATA_DIR": str(settings[1].data_dir),
        "FLEETMAP_BLOB_URL": settings[1].blob_url or "",
    }
    store = open_store(settings[0])
    store.environments.create("farm")
    data = random.Random(6).randbytes(90_000)
    (tmp_path / "originals").mkdir()
    (tmp_path / "originals" / "cloud.bin").write_bytes(data)
    name = store.blobs.put(data)
    add_sources(store, "farm", 0, Source("cloud.bin", len(data), name))
    store.blobs.files.write({f"{name[:2]}/{name}": data[1:] + b"x"})
    for key in ("intact", "damaged", "lost"):
        store.made_maps.publish(key, b"{}", [key.encode()])
    shared = {key: f"made/{sha256_of(key)[:2]}/{sha256_of(key)}" for key in ("damaged", "lost")}
    store.blobs.files.write({shared["damaged"]: b"x" * len("damaged")})
    store.blobs.files.delete([shared["lost"]])
    found = run_preloaded(["verify"], env=environment, cwd=tmp_path)
    assert found.returncode == 1, found.stdout
    assert name[:16] in found.stdout
    assert "3 shared maps" in found.stdout
    for key, path in shared.items():
        assert [key in line for line in found.stdout.splitlines() if path[8:24] in line] == [True]
    repaired = run_preloaded(
        ["verify", "--repair", "--from", str(tmp_path / "originals")], env=environment, cwd=tmp_path
    )
    assert repaired.returncode == 0, repaired.stdout
    assert store.blobs.get(name) == data
    assert len(list(store.made_maps.iterate_checks())) == len(list(store.blobs.files.list("made/"))) == 1
    assert store.made_maps.load("intact") is not None
    store.close()


def test_collection_beside_uploads_of_another_server_loses_nothing(settings: list[Settings]) -> None:
    uploading, collecting = (open_store(one) for one in settings)
    uploading.environments.create("farm")
    contents = [random.Random(k).randbytes(70_000) for k in range(3)]
    ended = threading.Event()

    def collect() -> int:
        count = 0
        while not ended.is_set():
            collecting.garbage.look_at_everything()
            count += collecting.garbage.collect(timedelta(seconds=1))["blobs"]
        return count

    committed: list[str] = []
    with ThreadPoolExecutor(1) as thread:
        collection = thread.submit(collect)
        try:
            for k in range(30):
                name = uploading.blobs.put(contents[k % 3])
                try:
                    add_sources(uploading, "farm", 0, Source(f"f{k}", 70_000, name))
                except Unavailable as error:
                    assert "send it again" in error.detail
                else:
                    committed.append(name)
                    if k % 3 == 2:
                        with uploading._database.write() as connection:  # forgotten again, so that they are collected
                            connection.exec_driver_sql("DELETE FROM source")
                            connection.exec_driver_sql("UPDATE blob SET kept = false, used = used - 100")
                        committed.clear()
                assert all(hashlib.sha256(uploading.blobs.get(one)).hexdigest() == one for one in committed)
        finally:
            ended.set()
        collection.result(60)
    assert collecting.blob_upkeep.verify() == []
    for store in (uploading, collecting):
        store.close()


def test_server_serves_what_it_has_without_the_store_and_recovers(
    postgres_url: str, tmp_path: Path, seaweed: Seaweed, s3_url: str
) -> None:
    settings = settings_for(tmp_path, database_url=postgres_url, blob_url=s3_url)
    settings.blob_dir.mkdir(parents=True)
    store = open_store(settings)
    store.migrate()
    store.close()
    with running(settings) as api:
        api.post("environments", {"name": "farm"})
        api.upload("farm", {"datum.yaml": samples.DATUM, "n.tmap2.yaml": samples.tmap2()})
        made = api.get("/maps/farm/tmap2")
        api.app.state.services.writability.forget()
        assert api.get("/readyz?for=writes").json()["status"] == "ready"
        seaweed.stop()
        try:
            api.app.state.services.writability.forget()
            assert api.get("/readyz").json()["status"] == "read-only"
            assert "does not answer" in api.problem("GET", "/readyz?for=writes", 503)["detail"]
            assert api.get("/maps/farm/tmap2").content == made.content
            other = api.get("/maps/farm/geojson")
            assert other.json()["features"], "converted, and not shared"
            refused = api("POST", "environments/farm/versions", 503, files=parts(samples.grid()))
            assert "nothing was stored" in refused.json()["detail"]
            assert api.get("environments/farm").json()["version"] == 1
            later = settings_for(tmp_path / "later", database_url=postgres_url, blob_url=s3_url)
            with running(later) as started:
                assert started.get("/readyz").json()["status"] == "read-only"
                assert started.get("/maps/farm/tmap2").content == made.content
        finally:
            seaweed.start()
        api.app.state.services.writability.forget()
        assert api.get("/readyz").json()["status"] == "ready"
        assert api.upload("farm", samples.grid()).json()["version"] == 2
        sources = api.get("environments/farm/versions/2").json()["sources"]
        assert {s["name"] for s in sources} == {"map.pgm", "map.yaml"}
        assert api.app.state.services.store.blob_upkeep.verify() == []


def test_faults_of_the_store_are_named_and_end_by_themselves(
    tmp_path: Path, seaweed: Seaweed, s3_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.backends.blob_s3.STALL_SECONDS", 1)
    monkeypatch.setattr("app.backends.blob_s3.CONNECT_SECONDS", 1)
    store = FaultyStore(seaweed.ports["s3"])
    monkeypatch.setenv("AWS_ENDPOINT_URL", store.endpoint)
    try:
        with running(settings_for(tmp_path, blob_url=s3_url)) as api:
            writability = api.app.state.services.writability
            api.post("environments", {"name": "farm"})
            api.upload("farm", {"n.tmap2.yaml": samples.tmap2()})
            made = api.get("/maps/farm/tmap2").content
            faults = [(Fault(status=507), 507, "full"), (Fault(status=403), 503, "access was refused")]
            for fault, status, reason in [*faults, (Fault(seconds=5.0), 503, "slowly")]:
                store.fault = fault
                writability.forget()
                assert api.get("/readyz").json()["status"] == "read-only", reason
                assert reason in api.problem("GET", "/readyz?for=writes", 503)["detail"]
                refused = api("POST", "environments/farm/versions", status, files=parts(samples.grid()))
                assert "nothing was stored" in refused.json()["detail"]
                assert api.get("/maps/farm/tmap2").content == made
                store.fault = Fault()
                writability.forget()
                assert api.get("/readyz").json()["status"] == "ready", reason
            assert api.upload("farm", samples.grid()).json()["version"] == 2
            source = api.get("environments/farm/versions/2/sources/map.pgm").content
            services = api.app.state.services
            shutil.rmtree(services.store.blob_dir)
            store.fault = Fault(changes_bytes=True)
            api.problem("GET", "environments/farm/versions/2/sources/map.pgm", 500)
            store.fault = Fault()
            assert api.get("environments/farm/versions/2/sources/map.pgm").content == source
    finally:
        store.close()

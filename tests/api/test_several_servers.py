"""Several servers on one PostgreSQL and one blob store, with data folders of their own: what one made, all have."""

from __future__ import annotations

import base64
import hashlib
import random
from collections.abc import Iterator
from contextlib import ExitStack
from datetime import timedelta
from pathlib import Path

import pytest

from app.config import Settings
from app.main import open_store
from tests.api import samples
from tests.api.conftest import Api, parts, running, settings_for
from tests.postgres import postgres_cluster, postgres_url
from tests.seaweed import Seaweed, s3_url, seaweed

__all__ = ["postgres_cluster", "postgres_url", "s3_url", "seaweed"]

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


def conversions(servers: list[Api]) -> int:
    """Return how many maps all servers have converted."""
    return sum(server.app.state.services.maps.cache.misses for server in servers)


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
        finally:
            seaweed.start()
        api.app.state.services.writability.forget()
        assert api.get("/readyz").json()["status"] == "ready"
        assert api.upload("farm", samples.grid()).json()["version"] == 2
        sources = api.get("environments/farm/versions/2").json()["sources"]
        assert {s["name"] for s in sources} == {"map.pgm", "map.yaml"}
        assert api.app.state.services.store.blob_upkeep.verify() == []

"""The same interface on PostgreSQL with PostGIS: one pass through all uses of the database."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import psycopg
import pytest

from app.errors import Unavailable
from app.main import close_services, open_services
from app.store.store import Store
from tests.api import samples
from tests.api.conftest import Api, running, settings_for
from tests.api.test_writers import races

pytestmark = pytest.mark.postgres


@pytest.fixture
def api(postgres_url: str, tmp_path: Path) -> Iterator[Api]:
    """Run a server on a database that ``fleetmap migrate`` has prepared."""
    settings = settings_for(tmp_path, database_url=postgres_url)
    settings.blob_dir.mkdir(parents=True)
    store = Store(settings.database, settings.blob_dir)
    store.migrate()
    store.close()
    with running(settings) as api:
        yield api


def test_server_creates_schema_but_does_not_change_an_older_one(postgres_url: str, tmp_path: Path) -> None:
    settings = settings_for(tmp_path, database_url=postgres_url)
    close_services(open_services(settings))
    with psycopg.connect(postgres_url.replace("+psycopg", ""), autocommit=True) as connection:
        connection.execute("UPDATE alembic_version SET version_num = '0015'")
    with pytest.raises(Unavailable, match=r"schema is 0015, this release needs .*: run fleetmap migrate"):
        open_services(settings)


def test_postgres_serves_the_whole_interface(api: Api) -> None:
    assert api.get("/readyz").json()["status"] == "ready"
    api.post("environments", {"name": "farm", "tags": ["wheat"]})
    api.upload("farm", {"datum.yaml": samples.DATUM, "n.tmap2.yaml": samples.tmap2()}, headers={"Idempotency-Key": "k"})
    again = api.upload(
        "farm", {"datum.yaml": samples.DATUM, "n.tmap2.yaml": samples.tmap2()}, headers={"Idempotency-Key": "k"}
    )
    assert again.json()["version"] == 1
    first = api.get("/maps/farm/tmap2")
    assert first.headers["fleetmap-version"] == "1"
    node = {"type": "Feature", "id": "new", "geometry": None, "place": {"type": "Point", "coordinates": [2.0, 1.0]}}
    put = {"op": "put", "layer": "topology", "feature": {**node, "properties": {"kind": "node"}}}
    api.post("environments/farm/edits", {"changes": [put]}, headers={"If-Match": '"1"'})
    api.problem("POST", "environments/farm/edits", 412, json={"changes": [put]}, headers={"If-Match": '"1"'})
    second = api.get("/maps/farm/tmap2")
    assert second.headers["fleetmap-version"] == "2"
    assert b"new" in second.content
    assert api.get("environments/farm/diff").json()["layers"]["topology"]["added"] == ["new"]
    near = api.get("environments/farm/versions/2/layers/topology?crs=local&bbox=1.5,0.5,2.5,1.5").json()["features"]
    assert {f["id"] for f in near} >= {"new"}
    assert [e["name"] for e in api.get("environments?contains=53.2687,-0.5246").json()] == ["farm"]
    assert api.get("environments?bbox=10,10,11,11").json() == []
    api("PUT", "environments/farm/channels/production", 200, json={"version": 1})
    assert api.get("/maps/farm/tmap2").headers["etag"] == first.headers["etag"]
    templates = {"set": "outdoor", "formats": {"tmap2": {"values": {"pointset": "rows"}}}}
    assert api("PUT", "environments/farm/templates", 201, json=templates).json()["version"] == 3
    assert b"pointset: rows" in api.get("environments/farm/versions/latest/maps/tmap2").content
    assert api.get("environments/farm/versions/2/maps/tmap2").headers["etag"] == second.headers["etag"]
    api.post("environments/farm/versions", {"revert_to": 1})
    assert (
        api.get("environments/farm/versions/4").json()["root"] == api.get("environments/farm/versions/1").json()["root"]
    )
    assert api.get("environments/farm/versions/1/sources/n.tmap2.yaml").content == samples.tmap2()
    viewer = api.token_for("viewer", environments="farm")
    viewer.get("/maps/farm/kml")
    viewer.problem("DELETE", "environments/farm", 403)
    api.post("environments", {"name": "copy", "clone": {"environment": "farm"}})
    assert 'fleetmap_head{environment="farm"} 4.0' in api.get("/metrics").text
    api("DELETE", "environments/farm", 204)
    api.problem("GET", "/maps/farm/tmap2", 404)
    api.post("environments/farm/purge", expect=204)
    assert [e["name"] for e in api.get("environments").json()] == ["copy"]
    assert api.get("/maps/copy/tmap2").content == first.content


def test_concurrent_writers_succeed_on_postgres(api: Api) -> None:
    api.post("environments", {"name": "farm"})
    api.upload("farm", {"n.tmap2.yaml": samples.tmap2()})
    races(api, "farm")


def test_nul_returns_422(api: Api) -> None:
    """PostgreSQL refuses texts with NUL, even in queries."""
    api.post("environments", {"name": "farm"})
    state = {"maps": [{"mapId": "\0", "mapVersion": "1", "mapStatus": "ENABLED"}]}
    for method, path, body in (
        ("GET", "robots?cursor=%00/x", None), ("GET", "environments?cursor=%00", None), ("GET", "jobs/%00", None),
        ("GET", "events?environment=%00&follow=false", None), ("POST", "robots/x/vda5050/state", state),
        ("PUT", "environments/farm/channels/production", {"version": "\0"}),
        ("POST", "environments/farm/overlays/a%00/accept", None),
    ):  # fmt: skip
        assert "NUL" in api.problem(method, path, 422, json=body)["detail"]

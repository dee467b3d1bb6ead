"""A mirror has what its centre has, with the same numbers, and takes over only what is missing."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from datetime import UTC, datetime

import pytest
from sqlalchemy import select

from app.errors import Mirrored
from app.mirror.follow import FULL_PASS
from app.store import tables
from app.store.store import Store
from tests.api import samples
from tests.api.conftest import Api, create_farm
from tests.mirror.conftest import Edge, long_network, stored_bytes

Make = Callable[..., Edge]
_count = itertools.count(1)


@pytest.fixture
def farm(centre: Api) -> str:
    return create_farm(centre, f"farm-{next(_count)}")


def rows(store: Store, name: str) -> dict[str, object]:
    """Everything that both servers must have alike."""
    with store._database.read() as connection:
        row = connection.execute(select(tables.environment).where(tables.environment.c.name == name)).one()
        of = {
            table.name: [
                tuple(r)
                for r in connection.execute(
                    select(*(c for c in table.c if c.name != "position" or table is not tables.event))
                    .where(table.c.environment_id == row.id)
                    .order_by(*table.primary_key.columns)
                )
            ]
            for table in (tables.version, tables.source, tables.channel, tables.event, tables.overlay)
        }
    keep = ("id", "title", "tags", "head", "root", "sequence", "closures_sequence", "updated", "created", "deleted")
    return {**of, "environment": tuple(getattr(row, name) for name in keep)}


def test_mirror_equals_its_centre(centre: Api, site: Api, farm: str, follower: Make) -> None:
    centre("PUT", f"environments/{farm}/channels/production", 200, json={"version": 2})
    report = {"kind": "blocked", "edge": "gate_barn", "state": "accepted"}
    centre.post(f"environments/{farm}/overlays", report)
    edge = follower(farm)
    edge.follow()
    here, there = site.app.state.services.store, centre.app.state.services.store
    assert rows(here, farm) == rows(there, farm)
    for path in (f"/maps/{farm}/tmap2", f"/maps/{farm}/occupancy_grid", f"/maps/{farm}/geojson"):
        ours, theirs = site.get(path), centre.get(path)
        assert (ours.content, ours.headers["etag"]) == (theirs.content, theirs.headers["etag"])
    path = f"environments/{farm}/versions/production/manifest?formats=tmap2,occupancy_grid"
    ours, theirs = site.get(path).json(), centre.get(path).json()
    assert {**ours, "time": 0, "expires": 0} == {**theirs, "time": 0, "expires": 0}
    assert here.verifier().run().findings == []


def test_mirror_follows_every_change(centre: Api, site: Api, farm: str, follower: Make) -> None:
    here, there = site.app.state.services.store, centre.app.state.services.store
    edge = follower("farm-*", "moved-*")
    edge.follow()
    path = f"environments/{farm}"
    centre.upload(farm, {"n.tmap2.yaml": samples.tmap2({"gate": (0.0, 1.0), "barn": (10.0, 0.0), "field": (9.0, 8.0)})})
    centre("PUT", f"{path}/channels/production", 200, json={"version": 4})
    centre("PUT", f"{path}/channels/staging", 200, json={"version": 3, "activate_at": "2099-01-01T00:00:00Z"})
    centre("PATCH", path, 200, json={"title": "Another title"})
    edge.follow()
    assert rows(here, farm) == rows(there, farm)
    assert site.get(f"{path}/channels").json()[1]["version"] == 4
    centre("PATCH", path, 200, json={"name": f"moved-{farm}"})
    edge.follow()
    assert rows(here, f"moved-{farm}") == rows(there, f"moved-{farm}")
    site.get(path, 404)
    centre("DELETE", f"environments/moved-{farm}", 204)
    edge.follow()
    assert "deleted" in site.problem("GET", f"environments/moved-{farm}", 404)["detail"]
    centre.post(f"environments/moved-{farm}/restore", expect=200)
    edge.follow()
    assert rows(here, f"moved-{farm}") == rows(there, f"moved-{farm}")
    centre("DELETE", f"environments/moved-{farm}", 204)
    centre.post(f"environments/moved-{farm}/purge", expect=204)
    edge.follow()
    assert not {e.name for e in here.mirror_target.environments().values()} & {farm, f"moved-{farm}"}
    centre.post("environments", {"name": farm})
    edge.follow()
    assert rows(here, farm) == rows(there, farm), "a new environment of that name continues its sequences"


def test_catch_up_transfers_only_what_is_missing(centre: Api, farm: str, alone: Make) -> None:
    centre.upload(farm, {"network.tmap2.yaml": long_network()})
    edge = alone(farm)
    edge.follow()
    before = stored_bytes(edge.store)
    for step in range(1, 4):
        centre.upload(farm, {"network.tmap2.yaml": long_network(step)})
    edge.wire.sent = edge.wire.received = 0
    edge.follow()
    missing = stored_bytes(edge.store) - before
    transferred = edge.wire.sent + edge.wire.received
    assert transferred <= 1.1 * missing, (transferred, missing)
    assert edge.store.verifier().run().findings == []
    clone = f"clone-of-{farm}"
    centre.post("environments", {"name": clone, "clone": {"environment": farm}})
    other = alone(clone)
    other.follow()
    assert other.wire.received < 0.1 * before, "the content is there already"
    edge.wire.sent = edge.wire.received = 0
    edge.follow()
    assert edge.wire.received < 5000, "nothing has changed"


def test_mirrored_environment_is_changed_at_its_centre(centre: Api, site: Api, farm: str, follower: Make) -> None:
    follower(farm).follow()
    path = f"environments/{farm}"
    calls = [
        ("POST", f"{path}/edits", {"changes": [{"op": "delete", "layer": "topology", "id": "gate"}]}),
        ("PUT", f"{path}/channels/production", {"version": 1}),
        ("PATCH", path, {"title": "mine"}),
        ("DELETE", path, None),
        ("POST", f"{path}/drafts", {"name": "mine"}),
    ]
    for method, address, body in calls:
        problem = site.problem(method, address, 409, **({} if body is None else {"json": body}))
        assert problem["type"] == "urn:fleetmap:problem:mirrored", (address, problem)
        assert centre.url in problem["detail"]
    refused = site.upload(farm, {"n.tmap2.yaml": samples.tmap2({"a": (0.0, 0.0)}, ())}, 409).json()
    assert centre.url in refused["detail"]
    site.post("environments", {"name": f"mine-{farm}", "clone": {"environment": farm}})
    with pytest.raises(Mirrored):
        site.app.state.services.store.environments.update(farm, title="mine")


def test_own_environment_of_the_same_name_stays(centre: Api, farm: str, alone: Make) -> None:
    edge = alone(farm)
    edge.store.environments.create(farm, title="its own")
    failures = edge.mirror.run_once().failures
    assert failures is not None
    assert "of its own" in failures[farm]
    assert edge.store.environments.get(farm).title == "its own"


def test_released_environment_is_changed_here(centre: Api, farm: str, alone: Make) -> None:
    edge = alone(farm)
    edge.follow()
    assert edge.store.mirror_target.release(farm)
    edge.store.environments.update(farm, title="mine")
    centre("PATCH", f"environments/{farm}", 200, json={"title": "theirs"})
    centre("PUT", f"environments/{farm}/channels/production", 200, json={"version": 2})
    edge.follow()
    assert edge.store.environments.get(farm).title == "mine"
    assert [channel.name for channel in edge.store.channels.all(farm)] == ["latest"]
    assert not edge.store.mirror_target.release(farm)


def test_title_is_followed_although_it_is_no_event(centre: Api, farm: str, alone: Make) -> None:
    edge = alone(farm)
    edge.follow()
    centre("PATCH", f"environments/{farm}", 200, json={"title": "Another title"})
    edge.wire.sent = edge.wire.received = 0
    edge.follow()
    assert edge.wire.received < 1000, "a pass without news costs next to nothing"
    assert edge.store.environments.get(farm).title == "Farm"
    edge.now = lambda: datetime.now(UTC) + FULL_PASS
    edge.follow()
    assert edge.store.environments.get(farm).title == "Another title"

"""A mirror has what its centre has, with the same numbers, and takes over only what is missing."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import pytest
from sqlalchemy import select

from app.store import tables
from app.store.store import Store
from tests.api.conftest import Api, create_farm
from tests.mirror.conftest import Edge

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

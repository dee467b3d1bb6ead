"""Environments, channels, events, tokens and jobs, on both databases."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
import shapely

from app.errors import Conflict, Gone, Invalid, NotFound
from app.events.messages import Event
from app.model.features import features
from app.model.frame import Datum
from app.model.geodesy import between
from app.model.layers import PartKey
from app.store import outbox
from app.store.changes import Delete, Put, Replace
from app.store.extent import extent, geometry, join
from app.store.parts.rasters import picture_bounds
from app.store.store import Store
from app.store.values import PartEntry, Provenance
from tests.store.samples import (
    DATUM,
    GRID,
    OBJECTS,
    TOPOLOGY,
    add_sources,
    everything,
    grid,
    network,
    replaces,
    rows,
    save,
)


def test_environment_create_describe_and_find(store: Store):
    environment = store.environments.create(
        "farm-1", title="The Farm", description="of apples", tags=("uk", "uk", "trial")
    )
    assert (environment.head, environment.tags, environment.datum, environment.bounds, environment.deleted) == (
        0,
        ("uk", "trial"),
        None,
        None,
        None,
    )
    assert environment.created.tzinfo is not None
    assert store.environments.get("farm-1") == environment
    assert store.versions.get("farm-1").number == 0
    assert store.versions.get("farm-1").parts == ()
    for name in ("a" * 64, "", "Farm", "-a", "ä", "a/b", "robots", "server", "a b", "**"):
        with pytest.raises(Invalid):
            store.environments.create(name)
    with pytest.raises(Conflict, match="already exists"):
        store.environments.create("farm-1")
    with pytest.raises(NotFound):
        store.environments.get("farm-2")
    changed = store.environments.update("farm-1", title="New", tags=["x"])
    assert (changed.title, changed.description, changed.tags) == ("New", "of apples", ("x",))
    with pytest.raises(Invalid, match="no control characters"):
        store.environments.update("farm-1", description="a\x00")


def test_environment_list_is_paged_filtered_and_scoped(store: Store):
    for k in range(7):
        store.environments.create(f"farm-{k}", title=f"Field {k}", description="100%" if k == 3 else "", tags=[f"T{k}"])
    store.environments.create("city")
    first, cursor = store.environments.page(limit=3)
    assert [e.name for e in first] == ["city", "farm-0", "farm-1"]
    rest, end = store.environments.page(limit=10, cursor=cursor)
    assert [e.name for e in rest] == [f"farm-{k}" for k in range(2, 7)]
    assert end is None
    assert [e.name for e in store.environments.page(q="FIELD 4")[0]] == ["farm-4"]
    assert [e.name for e in store.environments.page(q="t5")[0]] == ["farm-5"]
    assert [e.name for e in store.environments.page(q="0%")[0]] == ["farm-3"]
    assert store.environments.page(q="_%")[0] == []
    names, cursor = store.environments.page(allowed="farm-[2-5]", limit=3)
    assert [e.name for e in names] == ["farm-2", "farm-3", "farm-4"]
    assert cursor == "farm-4"
    assert [e.name for e in store.environments.page(allowed="farm-[2-5]", limit=3, cursor=cursor)[0]] == ["farm-5"]
    with pytest.raises(Invalid):
        store.environments.page(limit=0)


def test_extent_contains_all_parts(store: Store):
    store.environments.create("farm", datum=Datum(53.2, -0.5))
    store.environments.create("nowhere")
    assert store.environments.get("farm").bounds == (-0.5, 53.2, -0.5, 53.2)
    save(store, "farm", Replace(TOPOLOGY, network(50, side=1000)))
    west, south, east, north = store.environments.get("farm").bounds or (0, 0, 0, 0)
    assert west == pytest.approx(-0.5, abs=1e-3)
    assert south == pytest.approx(53.2, abs=1e-3)
    assert east - west == pytest.approx(1000 / 66_800, rel=0.05)
    assert north - south == pytest.approx(1000 / 111_300, rel=0.05)
    assert [e.name for e in store.environments.page(bbox=(-0.6, 53.0, -0.495, 53.201))[0]] == ["farm"]
    assert store.environments.page(bbox=(-0.6, 53.0, -0.51, 53.201))[0] == []
    for bad in ((0.0, 53.0, 1.0, 91.0), (0.0, 53.0, 181.0, 54.0), (float("nan"), 0.0, 1.0, 1.0)):
        with pytest.raises(Invalid):
            store.environments.page(bbox=bad)


@pytest.mark.parametrize("anchor", ["wgs84", "local"])
def test_extent_crosses_antimeridian(store: Store, anchor: str):
    store.environments.create("fiji", datum=Datum(-17.0, 179.999))
    if anchor == "wgs84":
        rows_ = [("a", shapely.Point(179.99, -17.01), {}), ("b", shapely.Point(-179.98, -16.9), {})]
        version = save(store, "fiji", Replace(OBJECTS, features(rows_, "wgs84")))
        assert version.part(OBJECTS).bounds["wgs84"] == (179.99, -17.01, -179.98, -16.9)  # type: ignore[union-attr]
        again = save(store, "fiji", Put(OBJECTS, features([("c", shapely.Point(-179.99, -17), {})], "wgs84")))
        assert again.part(OBJECTS).bounds == version.part(OBJECTS).bounds  # type: ignore[union-attr]
    else:
        rows_ = [("a", shapely.Point(-900, -900), {}), ("b", shapely.Point(2000, 2000), {})]
        save(store, "fiji", Replace(OBJECTS, features(rows_, "local")))
    west, _, east, _ = store.environments.get("fiji").bounds or (0, 0, 0, 0)
    assert west > 179.9
    assert east < -179.9
    for longitude in (179.9995, -179.9995, 180.0, -180.0):
        bbox = (longitude, -17.0, longitude, -17.0)
        assert [e.name for e in store.environments.page(bbox=bbox)[0]] == ["fiji"], longitude
    for longitude in (0.0, 179.5, -179.5):
        assert store.environments.page(bbox=(longitude, -17.0, longitude, -17.0))[0] == []
    assert store.environments.page(bbox=(179.0, -18, -179.0, -16))[0]
    assert store.environments.page(bbox=(-179.99, -18, -179.0, -16))[0]
    assert not store.environments.page(bbox=(-179.0, -18, 179.0, -16))[0]
    inside = store.content.features(store.versions.get("fiji"), OBJECTS, bbox=(179.0, -18, -179.0, -16), crs="wgs84")
    assert {"a", "b"} <= set(inside.ids)


def test_box_of_an_image_crosses_antimeridian():
    """An image of 60 × 40 m with its middle there; one that is as wide as the globe does not cross it."""
    easting, northing = between("EPSG:4326", "EPSG:32760", np.array([[180.0, -16.8]]))[0].tolist()
    size = {"width": 600, "height": 400}
    west, south, east, north = picture_bounds(
        {**size, "crs": "EPSG:32760", "transform": (0.1, 0.0, easting - 30.0, 0.0, -0.1, northing + 20.0)}
    )["wgs84"] or (0, 0, 0, 0)
    assert 179.9997 < west < 179.9998
    assert -179.9998 < east < -179.9997
    assert -16.801 < south < -16.8 < north < -16.799
    for crs, transform in (
        ("EPSG:4326", (0.6, 0.0, -180.0, 0.0, -0.4, 80.0)),
        ("EPSG:4326", (0.4, 0.0, -120.0, 0.0, -0.4, 80.0)),
        ("EPSG:3857", (66_000.0, 0.0, -19_800_000.0, 0.0, -66_000.0, 13_200_000.0)),
    ):
        west, _, east, _ = picture_bounds({**size, "crs": crs, "transform": transform})["wgs84"] or (0, 0, 0, 0)
        assert west <= -119.99
        assert east >= 119.99


def test_boxes_are_joined_across_antimeridian():
    assert join([]) is None
    assert join([(10, 0, 20, 5), (15, -1, 30, 3)]) == (10, -1, 30, 5)
    assert join([(170, 0, -170, 1), (-175, 2, -165, 3)]) == (170, 0, -165, 3)
    assert join([(-175, 2, -165, 3), (170, 0, -170, 1)], around=179.0) == (170, 0, -165, 3)
    assert join([(-180, 0, 0, 1), (0, 0, 180, 1)]) == (-180, 0, 180, 1)
    entry = PartEntry(GRID, "00", 1, {"local": (0, 0, 100, 100), "wgs84": None}, Provenance())
    assert extent([entry], None) is None
    assert extent([], DATUM) == (-0.5, 53.2, -0.5, 53.2)
    shapes = [shapely.from_wkb(geometry(b)) for b in ((1, 2, 1, 2), (1, 2, 3, 2), (1, 2, 3, 4), (170, 0, -170, 1))]
    assert [s.geom_type for s in shapes] == ["Point", "LineString", "Polygon", "MultiPolygon"]
    assert geometry(None) is None


def test_environment_delete_restore_and_purge(store: Store):
    store.environments.create("farm", datum=DATUM)
    save(store, "farm", Replace(GRID, grid()))
    environment = store.environments.delete("farm", "ann")
    assert environment.deleted is not None
    for call in (store.environments.get, store.versions.get, store.environments.delete, store.channels.all):
        with pytest.raises(Gone):
            call("farm")
    with pytest.raises(Gone):
        store.channels.move("farm", "production", 1, author="a")
    assert store.environments.page()[0] == []
    assert [e.name for e in store.environments.page(deleted=True)[0]] == ["farm"]
    assert store.environments.get("farm", deleted=True).head == 2
    with pytest.raises(Conflict, match="purge"):
        store.environments.create("farm")
    back = store.environments.restore("farm", "ann")
    assert back.deleted is None
    assert store.versions.get("farm").part(GRID) is not None
    with pytest.raises(Conflict):
        store.environments.restore("farm", "ann")
    with pytest.raises(Conflict, match="delete it first"):
        store.environments.purge("farm")
    store.environments.delete("farm", "ann")
    store.environments.purge("farm")
    with pytest.raises(NotFound):
        store.environments.get("farm", deleted=True)
    new = store.environments.create("farm")
    assert new.head == 0
    assert new.id != back.id
    events = store.events.page("farm")
    assert events[0].sequence == 7  # five events of the first farm were published under this name, and its second end
    assert [e.body["type"] for e in store.events.page(None)].count("environment.deleted") == 2


def test_clone_shares_content_and_has_separate_history(store: Store):
    store.environments.create("farm", datum=DATUM)
    digest = store.blobs.put(b"orig")
    from app.store.values import Source

    save(store, "farm", *replaces(everything()))
    add_sources(store, "farm", 2, Source("o", 4, digest))
    clone = store.environments.create("copy", clone=store.versions.get("farm"), author="ann")
    assert (clone.head, clone.root, clone.datum) == (1, store.versions.get("farm").root, DATUM)
    version = store.versions.get("copy")
    assert version.changes["topology"]["added"] == 300
    assert [s.name for s in version.sources] == ["o"]
    assert version.author == "ann"
    other = store.environments.create("moved", clone=store.versions.get("farm"), datum=Datum(1, 2))
    assert other.datum == Datum(1, 2)
    assert other.root != clone.root
    save(store, "copy", Delete(TOPOLOGY, ("n0",)))
    assert store.versions.get("farm").number == 2
    assert [(e.body["type"], e.sequence) for e in store.events.page("copy")][:2] == [
        ("environment.created", 1),
        ("version.created", 2),
    ]


def test_renamed_environment_keeps_its_history(store: Store):
    store.environments.create("farm", datum=DATUM)
    save(store, "farm", Replace(GRID, grid()))
    store.channels.move("farm", "production", 1, author="a")
    renamed = store.environments.update("farm", new_name="field", author="ann")
    assert (renamed.name, renamed.head) == ("field", 2)
    assert store.versions.get("field", "production").number == 1
    with pytest.raises(NotFound):
        store.environments.get("farm")
    tail = [(e.sequence, e.environment, e.body["type"]) for e in store.events.page("field")][-2:]
    assert tail == [(5, "farm", "environment.deleted"), (6, "field", "environment.created")]
    store.environments.create("farm")
    assert [e.sequence for e in store.events.page("farm")] == [6]
    with pytest.raises(Conflict, match="already exists"):
        store.environments.update("farm", new_name="field")
    with pytest.raises(Invalid):
        store.environments.update("farm", new_name="NO")


def test_outbox_lists_last_events_of_all_environments(store: Store, monkeypatch: pytest.MonkeyPatch):
    for name, moves in (("busy", 5), ("calm", 1), ("gone", 1), ("moved", 2)):
        store.environments.create(name)
        for k in range(moves):
            store.channels.move(name, f"c{k}", 0, author="ann")
    store.environments.delete("gone")
    store.environments.purge("gone")
    store.environments.update("moved", new_name="here")
    end = store.events.last_position()

    def last(each: int, limit: int, position: int = end) -> list[tuple[str, int]]:
        ranges = store.events.history(position, each, limit)
        pages = [page for chosen in ranges if (page := store.events.last(chosen, each, position))]
        assert [page[-1].position for page in pages] == sorted((p[-1].position for p in pages), reverse=True)
        assert all([e.sequence for e in page] == sorted(e.sequence for e in page) for page in pages)
        events = sorted((e for page in pages for e in page), key=lambda e: e.position)
        return [(e.environment, e.sequence) for e in events]

    begun = [("busy", n) for n in range(1, 7)] + [("calm", 1), ("calm", 2), ("gone", 1), ("gone", 2)]
    ended = [("gone", 3), ("moved", 4), ("here", 5)]
    assert last(9, 99) == [*begun, ("moved", 1), ("moved", 2), ("moved", 3), *ended]
    assert last(1, 99) == [("busy", 6), ("calm", 2), ("gone", 3), ("here", 5)]
    assert last(9, 7) == [("busy", 6), ("calm", 1), ("calm", 2), ("gone", 2), *ended], "each has its last events"
    assert last(9, 2) == [("gone", 3), ("here", 5)], "those with the oldest events have none"
    assert last(9, 99, position=2) == [("busy", 1), ("busy", 2)]
    monkeypatch.setattr(outbox, "LOG_SEARCH_WINDOW", 3)
    newest = [("gone", 3), ("moved", 4), ("here", 5)]
    assert last(9, 99) == [*begun[:8], *newest]
    assert last(9, 7) == [("busy", 5), ("busy", 6), ("calm", 1), ("calm", 2), *newest], "the others share what is left"
    assert last(9, 4) == [("calm", 2), *newest]


def test_events_have_the_documented_members(store: Store):
    store.environments.create("farm", author="ann", datum=DATUM)
    version = save(store, "farm", Replace(GRID, grid()), Replace(TOPOLOGY, network(5)))
    then = datetime(2031, 5, 1, 4, tzinfo=UTC)
    store.channels.move("farm", "production", 2, author="ann", activate_at=then)
    store.channels.move("farm", "production", 1, author="bob")
    store.channels.move("farm", "production", 2, author="bob")
    store.channels.move("farm", "production", 1, author="bob")
    events = store.events.page("farm")
    assert [e.sequence for e in events] == list(range(1, 8))
    assert [e.body["type"] for e in events] == [
        "environment.created",
        "version.created",
        "version.created",
        "channel.planned",
        "channel.moved",
        "channel.moved",
        "channel.moved",
    ]
    third = events[2].body
    assert third == {
        "sequence": 3,
        "type": "version.created",
        "environment": "farm",
        "version": 2,
        "root": version.root,
        "previous": {"version": 1, "root": store.versions.get("farm", 1).root},
        "layers": [
            {"layer": e.key.layer, "level": "ground", "name": e.key.name, "change": "added", "hash": e.hash}
            for e in version.parts
        ],
        "message": "edit",
        "author": "ann",
        "time": third["time"],
    }
    assert third["time"].endswith("Z")
    planned, first, forward, backward = (e.body for e in events[3:])
    assert planned["activate_at"] == "2031-05-01T04:00:00.000000Z"
    assert (planned["channel"], planned["version"], planned["previous"]) == ("production", 2, None)
    assert (first["previous"], first["rollback"]) == (None, False)
    assert (forward["previous"]["version"], forward["rollback"]) == (1, False)
    assert (backward["previous"]["version"], backward["version"], backward["rollback"]) == (2, 1, True)
    assert {x["change"] for x in backward["layers"]} == {"deleted"}
    assert [e.sequence for e in store.events.page("farm", since=5)] == [6, 7]
    assert [e.sequence for e in store.events.page("farm", since=2, limit=2)] == [3, 4]
    store.environments.create("other")
    log = store.events.page(None)
    assert [e.position for e in log] == list(range(1, 9))
    assert store.events.last_position() == 8
    assert [e.environment for e in store.events.page(None, since=7)] == ["other"]


def test_log_has_one_order_with_many_writers(store: Store):
    def work(k: int) -> None:
        name = f"e{k}"
        store.environments.create(name)
        for n in range(5):
            save(store, name, Put(TOPOLOGY, features([(f"n{n}", None, {"n": n})], "local")))

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(work, range(4)))
    log = store.events.page(None)
    assert [e.position for e in log] == list(range(1, 25))
    for k in range(4):
        assert [e.sequence for e in log if e.environment == f"e{k}"] == list(range(1, 7))


def test_channels_are_moved_planned_and_cancelled(store: Store):
    store.environments.create("farm", datum=DATUM)
    save(store, "farm", Replace(GRID, grid()))
    assert [(c.name, c.version) for c in store.channels.all("farm")] == [("latest", 2)]
    moved = store.channels.move("farm", "production", 1, author="ann")
    assert (moved.version, moved.root, moved.planned, moved.author) == (
        1,
        store.versions.get("farm", 1).root,
        None,
        "ann",
    )
    again = store.channels.move("farm", "production", 1, author="bob")
    assert again == moved
    soon = datetime.now(UTC) + timedelta(hours=1)
    planned = store.channels.move("farm", "staging", 2, author="ann", activate_at=soon)
    assert (planned.version, planned.planned.version) == (None, 2)  # type: ignore[union-attr]
    with pytest.raises(NotFound):
        store.versions.get("farm", "staging")
    assert store.channels.apply_due_moves(datetime.now(UTC)) == []
    assert store.channels.cancel_planned("farm", "staging", "ann").planned is None
    with pytest.raises(NotFound, match="planned"):
        store.channels.cancel_planned("farm", "staging", "ann")
    store.channels.move("farm", "production", 2, author="zoe", activate_at=soon)
    count = len(store.events.page("farm"))
    ((name, done),) = store.channels.apply_due_moves(soon + timedelta(seconds=1))
    assert (name, done.name, done.version, done.planned, done.author) == ("farm", "production", 2, None, "zoe")
    assert store.channels.apply_due_moves(soon + timedelta(seconds=1)) == []
    assert len(store.events.page("farm")) == count + 1
    assert [c.name for c in store.channels.all("farm")] == ["latest", "production", "staging"]
    for bad in ("latest", "Production", "1x", "", "a" * 64):
        with pytest.raises(Invalid):
            store.channels.move("farm", bad, 1, author="ann")
    with pytest.raises(NotFound, match="no version 9"):
        store.channels.move("farm", "production", 9, author="ann")
    with pytest.raises(Invalid, match="time zone"):
        store.channels.move("farm", "production", 1, author="ann", activate_at=datetime(2031, 1, 1))


def test_dropped_plan_appends_cancelled_event(store: Store):
    """Events carry ``activate_at``: clients that rely on them would switch anyway."""
    store.environments.create("farm", datum=DATUM)
    save(store, "farm", Replace(GRID, grid()))
    soon = datetime.now(UTC) + timedelta(hours=1)
    store.channels.move("farm", "staging", 2, author="ann", activate_at=soon)
    store.channels.cancel_planned("farm", "staging", "bob")
    store.channels.move("farm", "staging", 1, author="ann")
    store.channels.move("farm", "staging", 2, author="ann", activate_at=soon)
    stays = store.channels.move("farm", "staging", 1, author="zoe")
    store.channels.move("farm", "staging", 1, author="zoe")
    store.channels.move("farm", "staging", 2, author="ann", activate_at=soon)
    store.channels.move("farm", "staging", 2, author="zoe")
    events = [e.body for e in store.events.page("farm", since=3)]
    assert [(e["type"], e["version"]) for e in events] == [
        ("channel.planned", 2), ("channel.cancelled", 2), ("channel.moved", 1), ("channel.planned", 2),
        ("channel.cancelled", 2), ("channel.planned", 2), ("channel.moved", 2),
    ]  # fmt: skip
    assert [e["sequence"] for e in events] == list(range(4, 11))
    first, second = events[1], events[4]
    assert (first["previous"], first["author"], first["reason"]) == (None, "bob", "the plan was cancelled")
    assert (second["previous"]["version"], second["author"], second["layers"]) == (1, "zoe", [])
    assert stays.sequence == events[2]["sequence"], "it has not moved"
    assert Event.from_json(json.dumps(second)).type == "channel.cancelled"


def test_expired_token_stays_expired_when_the_clock_is_set_back(store: Store):
    now = present = datetime.now(UTC)
    store = Store(store.database_url, store.blob_dir, clock=lambda: present)
    _, lasting = store.tokens.create("admin", "admin")
    _, seen = store.tokens.create("seen", "viewer", expires=now + timedelta(hours=1))
    _, unseen = store.tokens.create("unseen", "viewer", expires=now + timedelta(hours=2))
    _, long = store.tokens.create("long", "viewer", expires=now + timedelta(days=2))
    assert store.tokens.find(seen) is not None
    present = now + timedelta(hours=1)
    assert store.tokens.find(seen) is None
    present = now + timedelta(days=1)
    assert store.tokens.end_expired() == 1, "nobody has sent it"
    assert store.tokens.end_expired() == 0
    present = now
    other = Store(store.database_url, store.blob_dir, clock=lambda: present)  # after a restart
    for each in (store, other):
        assert each.tokens.find(seen) is None
        assert each.tokens.find(unseen) is None
        assert each.tokens.find(lasting) is not None
        assert each.tokens.find(long) is not None
    assert {t.name for t in other.tokens.all() if t.ended} == {"seen", "unseen"}
    _, new = other.tokens.create("new", "viewer", expires=now + timedelta(minutes=1))
    assert store.tokens.find(new) is not None, "a clock that was ahead ends no token that is made afterwards"
    store.close()
    other.close()


def test_tokens_are_stored_hashed(store: Store):
    token, secret = store.tokens.create("ci", "editor", environments="farm-*")
    assert token.ended is None
    assert len(secret) >= 32
    assert store.tokens.find(secret) == token
    assert store.tokens.find(secret + "x") is None
    assert store.tokens.find("\ud800") is None
    assert store.tokens.find("x" * 10_000) is None
    chosen, text = store.tokens.create("admin", "admin", token="a-chosen-secret-of-length")
    assert text == "a-chosen-secret-of-length"
    with pytest.raises(Conflict):
        store.tokens.create("again", "admin", token=text)
    with pytest.raises(Invalid, match="empty"):
        store.tokens.create("empty", "admin", token="")
    with pytest.raises(Invalid, match="role"):
        store.tokens.create("x", "king")  # type: ignore[arg-type]
    with pytest.raises(Invalid, match="must name its robot"):
        store.tokens.create("mower", "robot")
    past, old = store.tokens.create("old", "viewer", expires=datetime.now(UTC) - timedelta(seconds=1))
    assert store.tokens.find(old) is None
    assert [t.id for t in store.tokens.all()] == [token.id, chosen.id, past.id]
    assert [t.ended is None for t in store.tokens.all()] == [True, True, False]
    store.tokens.delete(token.id)
    assert store.tokens.find(secret) is None
    with pytest.raises(NotFound):
        store.tokens.delete(token.id)
    with store._database.read() as connection:
        stored = connection.exec_driver_sql("SELECT hash FROM token").scalars().all()
    assert all(len(h) == 64 and text not in h for h in stored)


def test_jobs_are_stored_updated_and_deleted(store: Store):
    job = store.jobs.create(owner="ann", detail="waiting")
    assert (job.state, job.progress, job.owner, job.detail) == ("queued", 0.0, "ann", "waiting")
    job = store.jobs.update(job.id, state="running", progress=0.5, detail="half")
    assert (job.state, job.progress, job.detail) == ("running", 0.5, "half")
    job = store.jobs.update(job.id, state="done", progress=7.0, result={"url": "/x", "n": 1.0})
    assert (job.progress, job.result) == (1.0, {"url": "/x", "n": 1.0})
    assert store.jobs.update(job.id, state="cancelled").state == "done"
    assert store.jobs.get(job.id) == next(store.jobs.newest())
    store.jobs.delete(job.id)
    for call in (store.jobs.get, store.jobs.delete, store.jobs.update):
        with pytest.raises(NotFound):
            call(job.id)


def test_jobs_are_read_newest_first_some_at_a_time(store: Store, monkeypatch: pytest.MonkeyPatch):
    created = [store.jobs.create(owner=f"ann-{k % 2}", detail="").id for k in range(7)]
    expected = [job.id for job in sorted(map(store.jobs.get, created), key=lambda j: (j.created, j.id), reverse=True)]
    own = [job_id for job_id in expected if created.index(job_id) % 2]
    for page in (200, 3, 1):
        monkeypatch.setattr("app.store.jobs.PAGE", page)
        assert [job.id for job in store.jobs.newest()] == expected
        assert [job.id for job in store.jobs.newest("ann-1")] == own


def test_version_changes_name_level_of_parts_with_equal_names(store: Store):
    store.environments.create("farm")
    first, second = PartKey("occupancy", "ground", "map"), PartKey("occupancy", "first", "map")
    version = save(store, "farm", Replace(first, grid()), Replace(second, grid(seed=1)))
    assert set(version.changes["occupancy"]) == {"first/map", "ground/map"}
    assert rows(features([], "local")) == {}


def test_one_of_the_needed_tokens_remains(store: Store):
    """Also if the last two are revoked at once."""
    names = [store.tokens.create(name, "admin")[0].id for name in ("ann", "bob")]
    store.tokens.create("carl", "viewer")

    def revoke(token_id: str) -> str:
        try:
            store.tokens.delete(token_id, is_needed=lambda token: token.role == "admin")
        except Conflict as error:
            return error.detail
        return ""

    with ThreadPoolExecutor(2) as threads:
        outcomes = sorted(threads.map(revoke, names))
    assert outcomes == ["", "this is the last administrator's token: create another one first"]
    assert [token.role for token in store.tokens.all()] == ["admin", "viewer"]

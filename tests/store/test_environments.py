"""Environments, channels, events, tokens and jobs, on both databases."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import shapely

from app.errors import Conflict, Gone, Invalid, NotFound
from app.events.messages import Event
from app.model.features import features
from app.model.frame import Datum
from app.model.layers import PartKey
from app.store.changes import Delete, Put, Replace
from app.store.extent import extent, geometry, join
from app.store.store import Store
from app.store.values import PartEntry, Provenance
from tests.store.samples import DATUM, GRID, OBJECTS, TOPOLOGY, everything, grid, network, replaces, rows, save


def test_create_describe_find(store: Store):
    environment = store.create_environment(
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
    assert store.environment("farm-1") == environment
    assert store.version("farm-1").number == 0
    assert store.version("farm-1").parts == ()
    for name in ("a" * 64, "", "Farm", "-a", "ä", "a/b", "robots", "server", "a b", "**"):
        with pytest.raises(Invalid):
            store.create_environment(name)
    with pytest.raises(Conflict, match="taken"):
        store.create_environment("farm-1")
    with pytest.raises(NotFound):
        store.environment("farm-2")
    changed = store.update_environment("farm-1", title="New", tags=["x"])
    assert (changed.title, changed.description, changed.tags) == ("New", "of apples", ("x",))
    with pytest.raises(Invalid, match="NUL"):
        store.update_environment("farm-1", description="a\x00")


def test_lists_are_paged_filtered_and_scoped(store: Store):
    for k in range(7):
        store.create_environment(f"farm-{k}", title=f"Field {k}", description="100%" if k == 3 else "", tags=[f"T{k}"])
    store.create_environment("city")
    first, cursor = store.environments(limit=3)
    assert [e.name for e in first] == ["city", "farm-0", "farm-1"]
    rest, end = store.environments(limit=10, cursor=cursor)
    assert [e.name for e in rest] == [f"farm-{k}" for k in range(2, 7)]
    assert end is None
    assert [e.name for e in store.environments(q="FIELD 4")[0]] == ["farm-4"]
    assert [e.name for e in store.environments(q="t5")[0]] == ["farm-5"]
    assert [e.name for e in store.environments(q="0%")[0]] == ["farm-3"]
    assert store.environments(q="_%")[0] == []
    names, cursor = store.environments(allowed="farm-[2-5]", limit=3)
    assert [e.name for e in names] == ["farm-2", "farm-3", "farm-4"]
    assert cursor == "farm-4"
    assert [e.name for e in store.environments(allowed="farm-[2-5]", limit=3, cursor=cursor)[0]] == ["farm-5"]
    with pytest.raises(Invalid):
        store.environments(limit=0)


def test_extents_hold_all_parts(store: Store):
    store.create_environment("farm", datum=Datum(53.2, -0.5))
    store.create_environment("nowhere")
    assert store.environment("farm").bounds == (-0.5, 53.2, -0.5, 53.2)
    save(store, "farm", Replace(TOPOLOGY, network(50, side=1000)))
    west, south, east, north = store.environment("farm").bounds or (0, 0, 0, 0)
    assert west == pytest.approx(-0.5, abs=1e-3)
    assert south == pytest.approx(53.2, abs=1e-3)
    assert east - west == pytest.approx(1000 / 66_800, rel=0.05)
    assert north - south == pytest.approx(1000 / 111_300, rel=0.05)
    assert [e.name for e in store.environments(bbox=(-0.6, 53.0, -0.495, 53.201))[0]] == ["farm"]
    assert store.environments(bbox=(-0.6, 53.0, -0.51, 53.201))[0] == []
    for bad in ((0.0, 53.0, 1.0, 91.0), (0.0, 53.0, 181.0, 54.0), (float("nan"), 0.0, 1.0, 1.0)):
        with pytest.raises(Invalid):
            store.environments(bbox=bad)


@pytest.mark.parametrize("anchor", ["wgs84", "local"])
def test_extents_cross_the_antimeridian(store: Store, anchor: str):
    store.create_environment("fiji", datum=Datum(-17.0, 179.999))
    if anchor == "wgs84":
        rows_ = [("a", shapely.Point(179.99, -17.01), {}), ("b", shapely.Point(-179.98, -16.9), {})]
        version = save(store, "fiji", Replace(OBJECTS, features(rows_, "wgs84")))
        assert version.part(OBJECTS).bounds["wgs84"] == (179.99, -17.01, -179.98, -16.9)  # type: ignore[union-attr]
        again = save(store, "fiji", Put(OBJECTS, features([("c", shapely.Point(-179.99, -17), {})], "wgs84")))
        assert again.part(OBJECTS).bounds == version.part(OBJECTS).bounds  # type: ignore[union-attr]
    else:
        rows_ = [("a", shapely.Point(-900, -900), {}), ("b", shapely.Point(2000, 2000), {})]
        save(store, "fiji", Replace(OBJECTS, features(rows_, "local")))
    west, _, east, _ = store.environment("fiji").bounds or (0, 0, 0, 0)
    assert west > 179.9
    assert east < -179.9
    for longitude in (179.9995, -179.9995, 180.0, -180.0):
        bbox = (longitude, -17.0, longitude, -17.0)
        assert [e.name for e in store.environments(bbox=bbox)[0]] == ["fiji"], longitude
    for longitude in (0.0, 179.5, -179.5):
        assert store.environments(bbox=(longitude, -17.0, longitude, -17.0))[0] == []
    assert store.environments(bbox=(179.0, -18, -179.0, -16))[0]
    assert store.environments(bbox=(-179.99, -18, -179.0, -16))[0]
    assert not store.environments(bbox=(-179.0, -18, 179.0, -16))[0]
    ids = {f.id for f in store.find((179.0, -18, -179.0, -16))}
    assert {"a", "b"} <= ids
    assert {f.id for f in store.find((-180.0, -18, -179.0, -16))} == ids - {"a"}
    inside = store.features(store.version("fiji"), OBJECTS, bbox=(179.0, -18, -179.0, -16), crs="wgs84")
    assert {"a", "b"} <= set(inside.ids)


def test_boxes_are_joined_around_the_globe():
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


def test_the_index_follows_every_head(store: Store):
    store.create_environment("farm", datum=Datum(53.2, -0.5))
    save(store, "farm", *replaces(everything()))
    everywhere = (-180.0, -90.0, 180.0, 90.0)

    def expected() -> set[tuple[str, str]]:
        out = set()
        for key, part in store.load(store.version("farm")).vector("objects").items():
            out |= {(key.layer, i) for i, g in zip(part.ids, part.geometry, strict=True) if not g.is_empty}
        for layer in ("topology", "location", "zones"):
            for part in store.load(store.version("farm")).vector(layer).values():  # type: ignore[arg-type]
                out |= {(layer, i) for i in part.ids}
        return out

    def indexed_items() -> set[tuple[str, str]]:
        return {(f.key.layer, f.id) for f in store.find(everywhere, limit=10_000)}

    assert indexed_items() == expected()
    far = features([("n3", shapely.Point(5000, 0), {})], "local")
    head = save(store, "farm", Delete(TOPOLOGY, ("n1", "n2")), Put(TOPOLOGY, far))
    assert indexed_items() == expected()
    assert ("topology", "n1") not in indexed_items()
    (moved,) = [f for f in store.find(everywhere, layer="topology", limit=10_000) if f.id == "n3"]
    assert moved.box[0] > -0.43
    save(store, "farm", datum=Datum(10.0, 20.0))
    assert indexed_items() == expected()
    (moved,) = [f for f in store.find((19, 9, 21, 11), layer="topology", limit=10_000) if f.id == "n3"]
    assert moved.box[1] == pytest.approx(10.0, abs=0.01)
    store.revert("farm", head.number, author="a", message="")
    many = network(5000)
    save(store, "farm", Replace(TOPOLOGY, many))
    assert indexed_items() == expected()
    assert len(store.find(everywhere, limit=7)) == 7
    save(store, "farm", datum=None)
    assert indexed_items() == {("objects", "e"), ("objects", "m"), ("location", "fence")}
    store.rebuild_index()
    assert indexed_items() == {("objects", "e"), ("objects", "m"), ("location", "fence")}
    store.delete_environment("farm")
    assert indexed_items() == set()


def test_delete_restore_purge(store: Store):
    store.create_environment("farm", datum=DATUM)
    save(store, "farm", Replace(GRID, grid()))
    environment = store.delete_environment("farm", "ann")
    assert environment.deleted is not None
    for call in (store.environment, store.version, store.delete_environment, store.channels):
        with pytest.raises(Gone):
            call("farm")
    with pytest.raises(Gone):
        store.set_channel("farm", "production", 1, author="a")
    assert store.environments()[0] == []
    assert [e.name for e in store.environments(deleted=True)[0]] == ["farm"]
    assert store.environment("farm", deleted=True).head == 2
    with pytest.raises(Conflict, match="purge"):
        store.create_environment("farm")
    back = store.restore_environment("farm", "ann")
    assert back.deleted is None
    assert store.version("farm").part(GRID) is not None
    with pytest.raises(Conflict):
        store.restore_environment("farm", "ann")
    with pytest.raises(Conflict, match="delete it first"):
        store.purge_environment("farm")
    store.delete_environment("farm", "ann")
    store.purge_environment("farm")
    with pytest.raises(NotFound):
        store.environment("farm", deleted=True)
    new = store.create_environment("farm")
    assert new.head == 0
    assert new.id != back.id
    events = store.events("farm")
    assert events[0].sequence == 7  # five events of the first farm were told under this name, and its second end
    assert [e.body["type"] for e in store.events(None)].count("environment.deleted") == 2


def test_a_clone_shares_content_and_keeps_its_own_history(store: Store):
    store.create_environment("farm", datum=DATUM)
    digest = store.blobs.put(b"orig")
    from app.store.values import Source

    save(store, "farm", *replaces(everything()))
    store.add_sources("farm", 2, [Source("o", 4, digest)])
    clone = store.create_environment("copy", clone=store.version("farm"), author="ann")
    assert (clone.head, clone.root, clone.datum) == (1, store.version("farm").root, DATUM)
    version = store.version("copy")
    assert version.changes["topology"]["added"] == 300
    assert [s.name for s in version.sources] == ["o"]
    assert version.author == "ann"
    other = store.create_environment("moved", clone=store.version("farm"), datum=Datum(1, 2))
    assert other.datum == Datum(1, 2)
    assert other.root != clone.root
    save(store, "copy", Delete(TOPOLOGY, ("n0",)))
    assert store.version("farm").number == 2
    assert [(e.body["type"], e.sequence) for e in store.events("copy")][:2] == [
        ("environment.created", 1),
        ("version.created", 2),
    ]


def test_a_renamed_environment_keeps_its_history(store: Store):
    store.create_environment("farm", datum=DATUM)
    save(store, "farm", Replace(GRID, grid()))
    store.set_channel("farm", "production", 1, author="a")
    renamed = store.update_environment("farm", new_name="field", author="ann")
    assert (renamed.name, renamed.head) == ("field", 2)
    assert store.version("field", "production").number == 1
    with pytest.raises(NotFound):
        store.environment("farm")
    tail = [(e.sequence, e.environment, e.body["type"]) for e in store.events("field")][-2:]
    assert tail == [(5, "farm", "environment.deleted"), (6, "field", "environment.created")]
    store.create_environment("farm")
    assert [e.sequence for e in store.events("farm")] == [6]
    with pytest.raises(Conflict, match="taken"):
        store.update_environment("farm", new_name="field")
    with pytest.raises(Invalid):
        store.update_environment("farm", new_name="NO")


def test_the_last_events_of_all_environments(store: Store):
    for name, moves in (("busy", 5), ("calm", 1), ("gone", 1), ("moved", 2)):
        store.create_environment(name)
        for k in range(moves):
            store.set_channel(name, f"c{k}", 0, author="ann")
    store.delete_environment("gone")
    store.purge_environment("gone")
    store.update_environment("moved", new_name="here")
    end = store.last_position()

    def last(each: int, limit: int, position: int = end) -> list[tuple[str, int]]:
        events = store.last_events(position, each, limit)
        assert [e.position for e in events] == sorted(e.position for e in events)
        return [(e.environment, e.sequence) for e in events]

    begun = [("busy", n) for n in range(1, 7)] + [("calm", 1), ("calm", 2), ("gone", 1), ("gone", 2)]
    ended = [("gone", 3), ("moved", 4), ("here", 5)]
    assert last(9, 99) == [*begun, ("moved", 1), ("moved", 2), ("moved", 3), *ended]
    assert last(1, 99) == [("busy", 6), ("calm", 2), ("gone", 3), ("here", 5)]
    assert last(9, 7) == [("busy", 6), ("calm", 1), ("calm", 2), ("gone", 2), *ended], "each has its last ones"
    assert last(9, 2) == [("gone", 3), ("here", 5)], "the ones that were silent longest have none"
    assert last(9, 99, position=2) == [("busy", 1), ("busy", 2)]


def test_events_have_the_documented_members(store: Store):
    store.create_environment("farm", author="ann", datum=DATUM)
    made = save(store, "farm", Replace(GRID, grid()), Replace(TOPOLOGY, network(5)))
    then = datetime(2031, 5, 1, 4, tzinfo=UTC)
    store.set_channel("farm", "production", 2, author="ann", activate_at=then)
    store.set_channel("farm", "production", 1, author="bob")
    store.set_channel("farm", "production", 2, author="bob")
    store.set_channel("farm", "production", 1, author="bob")
    events = store.events("farm")
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
        "root": made.root,
        "previous": {"version": 1, "root": store.version("farm", 1).root},
        "layers": [
            {"layer": e.key.layer, "level": "ground", "name": e.key.name, "change": "added", "hash": e.hash}
            for e in made.parts
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
    assert [e.sequence for e in store.events("farm", since=5)] == [6, 7]
    assert [e.sequence for e in store.events("farm", since=2, limit=2)] == [3, 4]
    store.create_environment("other")
    log = store.events(None)
    assert [e.position for e in log] == list(range(1, 9))
    assert store.last_position() == 8
    assert [e.environment for e in store.events(None, since=7)] == ["other"]


def test_the_log_has_one_order_with_many_writers(store: Store):
    def work(k: int) -> None:
        name = f"e{k}"
        store.create_environment(name)
        for n in range(5):
            save(store, name, Put(TOPOLOGY, features([(f"n{n}", None, {"n": n})], "local")))

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(work, range(4)))
    log = store.events(None)
    assert [e.position for e in log] == list(range(1, 25))
    for k in range(4):
        assert [e.sequence for e in log if e.environment == f"e{k}"] == list(range(1, 7))


def test_channels_are_moved_planned_cancelled(store: Store):
    store.create_environment("farm", datum=DATUM)
    save(store, "farm", Replace(GRID, grid()))
    assert [(c.name, c.version) for c in store.channels("farm")] == [("latest", 2)]
    moved = store.set_channel("farm", "production", 1, author="ann")
    assert (moved.version, moved.root, moved.planned, moved.author) == (1, store.version("farm", 1).root, None, "ann")
    again = store.set_channel("farm", "production", 1, author="bob")
    assert again == moved
    soon = datetime.now(UTC) + timedelta(hours=1)
    planned = store.set_channel("farm", "staging", 2, author="ann", activate_at=soon)
    assert (planned.version, planned.planned.version) == (None, 2)  # type: ignore[union-attr]
    with pytest.raises(NotFound):
        store.version("farm", "staging")
    assert store.apply_due_moves(datetime.now(UTC)) == []
    assert store.cancel_planned("farm", "staging", "ann").planned is None
    with pytest.raises(NotFound, match="planned"):
        store.cancel_planned("farm", "staging", "ann")
    store.set_channel("farm", "production", 2, author="zoe", activate_at=soon)
    count = len(store.events("farm"))
    ((name, done),) = store.apply_due_moves(soon + timedelta(seconds=1))
    assert (name, done.name, done.version, done.planned, done.author) == ("farm", "production", 2, None, "zoe")
    assert store.apply_due_moves(soon + timedelta(seconds=1)) == []
    assert len(store.events("farm")) == count + 1
    assert [c.name for c in store.channels("farm")] == ["latest", "production", "staging"]
    for bad in ("latest", "Production", "1x", "", "a" * 64):
        with pytest.raises(Invalid):
            store.set_channel("farm", bad, 1, author="ann")
    with pytest.raises(NotFound, match="no version 9"):
        store.set_channel("farm", "production", 9, author="ann")
    with pytest.raises(Invalid, match="time zone"):
        store.set_channel("farm", "production", 1, author="ann", activate_at=datetime(2031, 1, 1))


def test_a_plan_that_is_dropped_is_told(store: Store):
    """Events carry ``activate_at``: who goes by them would switch all the same."""
    store.create_environment("farm", datum=DATUM)
    save(store, "farm", Replace(GRID, grid()))
    soon = datetime.now(UTC) + timedelta(hours=1)
    store.set_channel("farm", "staging", 2, author="ann", activate_at=soon)
    store.cancel_planned("farm", "staging", "bob")
    store.set_channel("farm", "staging", 1, author="ann")
    store.set_channel("farm", "staging", 2, author="ann", activate_at=soon)
    stays = store.set_channel("farm", "staging", 1, author="zoe")
    store.set_channel("farm", "staging", 1, author="zoe")
    store.set_channel("farm", "staging", 2, author="ann", activate_at=soon)
    store.set_channel("farm", "staging", 2, author="zoe")
    events = [e.body for e in store.events("farm", since=3)]
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


def test_expired_token_stays_expired_when_the_clock_is_set_back(
    store: Store, database_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    now = datetime.now(UTC)
    _, lasting = store.create_token("admin", "admin")
    _, seen = store.create_token("seen", "viewer", expires=now + timedelta(hours=1))
    _, unseen = store.create_token("unseen", "viewer", expires=now + timedelta(hours=2))
    _, long = store.create_token("long", "viewer", expires=now + timedelta(days=2))
    assert store.find_token(seen) is not None
    monkeypatch.setattr("app.store.tokens.utcnow", lambda: now + timedelta(hours=1))
    assert store.find_token(seen) is None
    monkeypatch.setattr("app.store.tokens.utcnow", lambda: now + timedelta(days=1))
    assert store.end_expired_tokens() == 1, "nobody has sent it"
    assert store.end_expired_tokens() == 0
    monkeypatch.setattr("app.store.tokens.utcnow", lambda: now)
    other = Store(database_url, tmp_path / "blobs")  # after a restart
    for each in (store, other):
        assert each.find_token(seen) is None
        assert each.find_token(unseen) is None
        assert each.find_token(lasting) is not None
        assert each.find_token(long) is not None
    assert {t.name for t in other.tokens() if t.ended} == {"seen", "unseen"}
    _, new = other.create_token("new", "viewer", expires=now + timedelta(minutes=1))
    assert store.find_token(new) is not None, "a clock that was ahead ends no token that is made afterwards"
    other.close()


def test_tokens_are_kept_hashed(store: Store):
    token, secret = store.create_token("ci", "editor", environments="farm-*")
    assert token.ended is None
    assert len(secret) >= 32
    assert store.find_token(secret) == token
    assert store.find_token(secret + "x") is None
    assert store.find_token("\ud800") is None
    assert store.find_token("x" * 10_000) is None
    chosen, text = store.create_token("admin", "admin", token="a-chosen-secret-of-length")
    assert text == "a-chosen-secret-of-length"
    with pytest.raises(Conflict):
        store.create_token("again", "admin", token=text)
    with pytest.raises(Invalid, match="empty"):
        store.create_token("empty", "admin", token="")
    with pytest.raises(Invalid, match="role"):
        store.create_token("x", "king")  # type: ignore[arg-type]
    with pytest.raises(Invalid, match="must name its robot"):
        store.create_token("mower", "robot")
    past, old = store.create_token("old", "viewer", expires=datetime.now(UTC) - timedelta(seconds=1))
    assert store.find_token(old) is None
    assert [t.id for t in store.tokens()] == [token.id, chosen.id, past.id]
    assert [t.ended is None for t in store.tokens()] == [True, True, False]
    store.delete_token(token.id)
    assert store.find_token(secret) is None
    with pytest.raises(NotFound):
        store.delete_token(token.id)
    with store._database.read() as connection:
        stored = connection.exec_driver_sql("SELECT hash FROM token").scalars().all()
    assert all(len(h) == 64 and text not in h for h in stored)


def test_jobs(store: Store):
    job = store.create_job(owner="ann", detail="waiting")
    assert (job.state, job.progress, job.owner, job.detail) == ("queued", 0.0, "ann", "waiting")
    job = store.update_job(job.id, state="running", progress=0.5, detail="half")
    assert (job.state, job.progress, job.detail) == ("running", 0.5, "half")
    assert [j.id for j in store.jobs(state="running")] == [job.id]
    job = store.update_job(job.id, state="done", progress=7.0, result={"url": "/x", "n": 1.0})
    assert (job.progress, job.result) == (1.0, {"url": "/x", "n": 1.0})
    assert store.update_job(job.id, state="cancelled").state == "done"
    assert store.job(job.id) == store.jobs()[0]
    store.delete_job(job.id)
    for call in (store.job, store.delete_job, store.update_job):
        with pytest.raises(NotFound):
            call(job.id)


def test_parts_of_several_levels_are_told_apart(store: Store):
    store.create_environment("farm")
    first, second = PartKey("occupancy", "ground", "map"), PartKey("occupancy", "first", "map")
    version = save(store, "farm", Replace(first, grid()), Replace(second, grid(seed=1)))
    assert set(version.changes["occupancy"]) == {"first/map", "ground/map"}
    assert rows(features([], "local")) == {}

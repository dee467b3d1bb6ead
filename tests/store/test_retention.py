"""Retention on both databases: what stays, what goes, and what happens at the same moment."""

from __future__ import annotations

import random
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from sqlalchemy import text

from app.errors import Conflict, FleetMapError, Invalid, NotFound, Thinned
from app.store.changes import Changes, Replace
from app.store.fleet_values import ReceivedReport, RobotReport, Rollout
from app.store.retention_rule import Rule
from app.store.robots import _note
from app.store.store import Store
from app.store.values import Idempotency, Source, Version
from app.store.versions import insert_sources
from tests.store.conftest import NOW, Clock
from tests.store.samples import GRID, TOPOLOGY, add_sources, grid, network, save

RULE = Rule(all_days=30, daily_days=60, last=2)
STRICT = Rule(all_days=1, daily_days=0, last=1)


@pytest.fixture
def history(farm: Store, clock: Clock) -> Store:
    """Environment ``farm`` with 20 versions, two a day, the newest ten days old, then a year passes."""
    for k in range(2, 21):
        clock.now = NOW + timedelta(hours=12 * k)
        save(farm, "farm", Replace(GRID, grid(50, 45, seed=k)), Replace(TOPOLOGY, network(5, seed=k)))
    clock.now = NOW + timedelta(days=375)
    return farm


def thin(store: Store, rule: Rule = STRICT, writable: tuple[str, ...] = ()) -> tuple[int, ...]:
    """Apply a rule; returns the numbers of the thinned versions, ascending."""
    out: list[int] = []
    for plan in store.retention.plan(rule, writable):
        for removed in store.retention.apply(plan, rule):
            out += removed.versions
    return tuple(sorted(out))


def kept(store: Store) -> set[int]:
    return {v.number for v in store.versions.page("farm", limit=1000) if v.thinned is None}


def report(store: Store, robot: str, version: Version, state: Any = "active") -> None:
    body = RobotReport("production", version.number, version.root, state)
    assert store.robots.note_reports([ReceivedReport("farm", robot, body, datetime.now(UTC))]) == [None]


def test_rule_keeps_all_of_some_days_then_one_a_day_then_the_last():
    hours = [(k, datetime(2026, 1, 1, tzinfo=UTC) + timedelta(hours=8 * k)) for k in range(300)]
    now = datetime(2026, 1, 1, tzinfo=UTC) + timedelta(hours=8 * 300)
    reasons = Rule(all_days=10, daily_days=50, last=3).reasons(hours[::-1], now)
    assert [n for n, why in reasons.items() if why == "last"] == [299, 298, 297]
    assert sorted(n for n, why in reasons.items() if why == "recent") == list(range(270, 297))
    daily = [n for n, why in reasons.items() if why == "daily"]
    assert sorted(daily) == list(range(152, 270, 3)), "the last of each day, none older than 50 days"
    assert min(reasons) == 152


@pytest.mark.parametrize(
    "rule", [Rule(0, 0, 0), Rule(0, 365, 10), Rule(30, 365, 0), Rule(30, 10), Rule(-5), Rule(30, source_days=0)]
)
def test_rule_that_could_remove_everything_is_refused(sqlite_store: Store, rule: Rule):
    with pytest.raises(Invalid, match=r"could remove everything|less than all|at least 1 day"):
        list(sqlite_store.retention.plan(rule))


def test_thinned_version_keeps_its_entry_and_answers_when_and_why(history: Store, clock: Clock):
    before = {v.number: v for v in history.versions.page("farm", limit=100)}
    contents = {n: history.content.load(before[n]) for n in (12, 20)}
    plan = next(history.retention.plan(RULE))
    assert plan.kept == {"head": 1, "last": 1, "first": 1}
    assert thin(history, RULE) == tuple(range(1, 19)) == tuple(sorted(plan.thinned))
    for version in history.versions.page("farm", limit=100):
        was = before[version.number]
        metadata = (version.root, version.parent, version.author, version.message, version.time, version.changes)
        assert metadata == (was.root, was.parent, was.author, was.message, was.time, was.changes)
        gone = 1 <= version.number <= 18
        assert (version.thinned is not None) == gone
        assert ("thinned" in version.as_dict()) == gone
        if version.thinned is not None:
            assert version.thinned.time == clock.now
            assert version.thinned.rule == RULE.text
            assert version.parts == ()
    for read in (history.versions.get, lambda e, n: history.channels.target(e, n)):
        with pytest.raises(Thinned, match=r"version 12 of farm was thinned on 2031-01-11.*all of 30 days.*0 and 19"):
            read("farm", 12)
    with pytest.raises(Thinned):
        history.versions.revert("farm", 12, author="ann", message="")
    with pytest.raises(Thinned):
        history.channels.move("farm", "production", 12, author="ann")
    with pytest.raises(Thinned):
        history.environments.create("copy", clone=before[12])
    assert history.content.load(history.versions.get("farm", 20)).parts.keys() == contents[20].parts.keys()
    assert save(history, "farm", Replace(GRID, grid(seed=99))).number == 21, "numbers are not used again"
    assert thin(history, RULE) == (19,), "only the last two stay, and what was thinned is not counted again"


def test_content_goes_with_collection_and_verify_finds_nothing_wrong(history: Store):
    removable, stored = history.garbage.removable_bytes(list(history.retention.plan(STRICT)))
    assert 0 < removable < stored
    thin(history)
    history.garbage.collect(timedelta(hours=1))
    assert history.garbage.removable_bytes() == (removable, stored), "somebody may still read it"
    collected = history.garbage.collect(timedelta(0))
    assert collected["chunks"] > 20
    assert history.garbage.removable_bytes() == (0, stored - removable)
    result = history.verifier().run()
    assert result.findings == []
    assert result.checked["version"] == 2
    head = history.versions.get("farm")
    history.chunks.forget()
    assert len(history.content.load(head).parts) == 2


def test_index_behind_a_thinned_version_is_built_afresh(history: Store):
    with history._database.write() as connection:
        connection.execute(text("UPDATE environment SET search_version = 7, search_sequence = 0"))
    assert 7 in thin(history)
    history.garbage.collect(timedelta(0))
    assert [hit.id for hit in history.search.find("W3", limit=1)[0]] == ["n3"]


def _channel(store: Store) -> None:
    store.channels.move("farm", "production", 5, author="ann")


def _moved_on(store: Store) -> None:
    store.channels.move("farm", "production", 5, author="ann")
    store.channels.move("farm", "production", 20, author="ann")


def _planned(store: Store) -> None:
    store.channels.move("farm", "production", 20, author="ann")
    store.channels.move("farm", "production", 5, author="ann", activate_at=store.now() + timedelta(days=9))


def _cancelled(store: Store) -> None:
    _planned(store)
    store.channels.cancel_planned("farm", "production", "ann")


def _rollout(store: Store) -> None:
    store.channels.move("farm", "production", 20, author="ann")
    rollout = Rollout(0, "", store.now(), ready=0.5)
    store.channels.move("farm", "production", 5, author="ann", rollout=rollout)
    store.channels.cancel_planned("farm", "production", "ann")


def _rolled_back(store: Store) -> None:
    _channel(store)
    rollout = Rollout(0, "", store.now(), failed=0.5)
    store.channels.move("farm", "production", 20, author="ann", rollout=rollout)


def _robot(store: Store) -> None:
    report(store, "r1", store.versions.get("farm", 5))


def _robot_that_fetches_another(store: Store) -> None:
    report(store, "r1", store.versions.get("farm", 5))
    report(store, "r1", store.versions.get("farm", 20), "downloading")


def _robot_of_another_number(store: Store) -> None:
    root = store.versions.get("farm", 5).root
    body = RobotReport("production", 400, root, "active")
    store.robots.note_reports([ReceivedReport("farm", "r1", body, datetime.now(UTC))])


def _tag(store: Store) -> None:
    assert store.tags.add("farm", 5, "season", author="ann").tags == ("season",)


def _link(store: Store) -> None:
    store.retention.note_link("farm", 5, store.now() + timedelta(days=2))


def _draft(store: Store) -> None:
    with store._database.write() as connection:
        owner = connection.execute(text("SELECT id FROM environment")).scalar_one()
        values = (
            "INSERT INTO draft (id, environment_id, base, root, created, expires, changed, changes, warnings, "
            "manifest, name, owner, owner_id, revision, edited) SELECT 'd', :owner, 5, root, time, time, true, "
            "changes, warnings, manifest, 'lanes', 'ann', 'a', 1, time FROM version WHERE number = 5"
        )
        connection.execute(text(values), {"owner": owner})


USES: list[tuple[Callable[[Store], None], str]] = [
    (_channel, "channel"),
    (_moved_on, "rollback"),
    (_planned, "planned move"),
    (_cancelled, "planned move"),
    (_rollout, "rollout"),
    (_rolled_back, "rollout"),
    (_robot, "robot"),
    (_robot_that_fetches_another, "robot"),
    (_robot_of_another_number, "robot"),
    (_tag, "tag"),
    (_link, "link"),
    (_draft, "draft"),
]


def test_what_is_in_use_stays(history: Store):
    """All uses one after the other; the last one begins between the plan and the removal."""
    others = set(range(1, 20)) - {5}
    for use, reason in USES:
        with history._database.write() as connection:
            for table in ("channel", "robot", "version_tag", "draft"):
                connection.execute(text(f"DELETE FROM {table}"))
            connection.execute(text("UPDATE version SET linked = NULL"))
            connection.execute(text("DELETE FROM event WHERE sequence > 22"))
            connection.execute(text("UPDATE environment SET sequence = 22"))
        before = next(history.retention.plan(STRICT))
        assert before.thinned == tuple(sorted(others | {5}, reverse=True)), use.__name__
        use(history)
        plan = next(history.retention.plan(STRICT))
        assert plan.thinned == tuple(sorted(others, reverse=True)), use.__name__
        assert plan.kept.get(reason) == 1, (use.__name__, plan.kept)
        removed = {n for one in history.retention.apply(before, STRICT) for n in one.versions}
        assert removed == others, use.__name__
        others = set()


def test_end_of_use_lets_version_go(history: Store, clock: Clock):
    _tag(history)
    _link(history)
    report(history, "r1", history.versions.get("farm", 7))
    with pytest.raises(Conflict, match="version 5 of farm has the tag"):
        history.tags.add("farm", 6, "season", author="ann")
    with pytest.raises(Invalid, match="invalid tag"):
        history.tags.add("farm", 6, "a,b", author="ann")
    assert history.tags.add("farm", 5, "season", author="ann").tags == ("season",)
    assert set(thin(history)) == set(range(1, 20)) - {5, 7}
    history.tags.remove("farm", 5, "season")
    with pytest.raises(NotFound, match="has no tag"):
        history.tags.remove("farm", 5, "season")
    assert thin(history) == (), "the link lasts"
    clock.now += timedelta(days=3)
    report(history, "r1", history.versions.get("farm", 20))
    assert thin(history) == (5, 7)
    with pytest.raises(Thinned):
        history.tags.add("farm", 5, "season", author="ann")


def test_repeated_request_is_answered_while_its_key_is_stored(history: Store, clock: Clock):
    key = Idempotency("k", "same")
    made = history.versions.prepare(history.versions.get("farm"), _grid(77))
    version = history.versions.commit("farm", made, author="ann", message="", idempotency=key)
    save(history, "farm", Replace(GRID, grid(seed=78)))
    clock.now += timedelta(days=5)
    assert version.number not in thin(history)
    assert history.versions.commit("farm", made, author="ann", message="", idempotency=key) == version


def _grid(seed: int) -> Changes:
    return Changes((Replace(GRID, grid(seed=seed)),))


def test_files_of_thinned_versions_go_and_shared_ones_stay(history: Store):
    names = {n: history.blobs.put(bytes([n]) * 3000) for n in (5, 6, 20)}
    for n in (5, 6, 20):
        add_sources(history, "farm", n, Source(f"{n}.yaml", 3000, names[n], "tmap2", used=True))
    add_sources(history, "farm", 20, Source("again.yaml", 3000, names[6], "tmap2"))
    thin(history)
    history.garbage.collect(timedelta(0))
    with pytest.raises(NotFound):
        history.blobs.get(names[5])
    assert history.blobs.get(names[6]) == bytes([6]) * 3000
    listed = {v.number: v.sources for v in history.versions.page("farm", limit=100)}
    assert [s.name for s in listed[5]] == ["5.yaml"]
    assert listed[5][0].removed is not None
    assert all(s.removed is None for s in listed[20])
    assert history.verifier().run().findings == []


def test_old_files_of_kept_versions_go_only_if_layers_have_their_content(history: Store, clock: Clock):
    clock.now = NOW + timedelta(days=30)
    rule = Rule(all_days=365, daily_days=0, source_days=25)
    blobs = {name: history.blobs.put(name.encode() * 500) for name in ("a", "b", "c", "d", "e")}

    def sources(*listed: tuple[str, str | None, bool]) -> list[Source]:
        return [Source(n, 500, blobs[n], fmt, used) for n, fmt, used in listed]

    with history._database.write() as connection:
        owner = connection.execute(text("SELECT id FROM environment")).scalar_one()
        old = sources(("a", "tmap2", True), ("b", "tmap2", False), ("c", "zip", True), ("d", None, True))
        insert_sources(connection, owner, 3, old, first=0)
        insert_sources(connection, owner, 19, sources(("e", "tmap2", True)), first=0)
    plan = next(history.retention.plan(rule, ("tmap2",)))
    assert plan.thinned == ()
    assert plan.files == ((3, 0),)
    assert thin(history, rule, ("tmap2",)) == ()
    history.garbage.collect(timedelta(0))
    with pytest.raises(NotFound):
        history.blobs.get(blobs["a"])
    assert all(history.blobs.get(blobs[n]) for n in "bcde")
    assert history.content.load(history.versions.get("farm", 3)).parts, "the version itself is kept"
    # the same file again: it is stored again
    assert history.blobs.put(b"a" * 500) == blobs["a"]
    again = add_sources(history, "farm", 3, *sources(("a", "tmap2", True)))
    assert [(s.name, s.removed) for s in again.sources][:1] == [("a", None)]
    history.garbage.collect(timedelta(0))
    assert history.blobs.get(blobs["a"]) == b"a" * 500


def test_deleted_and_unchanged_environments_are_left_alone(history: Store):
    history.environments.create("other")
    history.environments.delete("farm")
    assert [plan.environment for plan in history.retention.plan(STRICT)] == ["other"]
    assert thin(history) == ()
    history.environments.restore("farm")
    plan = next(p for p in history.retention.plan(STRICT) if p.environment == "farm")
    history.environments.delete("farm")
    assert list(history.retention.apply(plan, STRICT)) == []


def test_report_that_is_being_stored_keeps_its_version(history: Store):
    """A report whose transaction has begun and not ended when the removal starts.

    It changes only what the robot holds, so that nothing but the lock of all reports makes the removal wait for it.
    """
    version, head = history.versions.get("farm", 5), history.versions.get("farm")
    report(history, "r1", head, "downloading")
    plan = next(history.retention.plan(STRICT))
    removed: list[int] = []

    def remove() -> None:
        removed.extend(n for one in history.retention.apply(plan, STRICT) for n in one.versions)

    thread = threading.Thread(target=remove)
    with history._database.write(notify=False, upkeep=True) as connection:
        owner = connection.execute(text("SELECT id FROM environment")).scalar_one()
        body = RobotReport("production", 20, head.root, "downloading", holds=(5, version.root))
        assert _note(connection, owner, ReceivedReport("farm", "r1", body, datetime.now(UTC)), 10) is None
        thread.start()
        _wait_until_blocked(history)
    thread.join(60)
    assert sorted(removed) == [n for n in range(1, 20) if n != 5]


def _wait_until_blocked(store: Store) -> None:
    """Wait until a transaction waits for another's lock. On SQLite writers wait for their turn anyway."""
    deadline = time.monotonic() + 60
    while not store._database.sqlite:
        with store._database.read() as connection:
            if connection.execute(text("SELECT count(*) FROM pg_locks WHERE NOT granted")).scalar_one():
                return
        assert time.monotonic() < deadline, "the removal did not wait for the report"
        time.sleep(0.01)


def test_promotions_reports_and_tags_during_removal(history: Store):
    """Whatever took effect before the removal of its version keeps it; what comes later is refused."""
    stop, used, failures = threading.Event(), list[int](), list[Exception]()

    def use(seed: int) -> None:
        chance = random.Random(seed)
        while not stop.is_set():
            number = chance.randrange(1, 20)
            kind = chance.choice(("promote", "tag", "report"))
            try:
                version = history.versions.get("farm", number)
                if kind == "promote":
                    history.channels.move("farm", f"c{seed}-{number}", number, author="ann")
                elif kind == "tag":
                    history.tags.add("farm", number, f"t{seed}-{number}", author="ann")
                else:
                    report(history, f"r{seed}-{number}", version)
                    history.versions.get("farm", number)  # else it was thinned before the report
                used.append(number)
                if len(used) > 5:
                    stop.set()
            except Thinned:
                continue
            except FleetMapError as error:
                failures.append(error)
                return

    threads = [threading.Thread(target=use, args=(seed,)) for seed in (1, 2)]
    plan = next(history.retention.plan(STRICT))
    for thread in threads:
        thread.start()
    removed: set[int] = set()
    for start in range(0, len(plan.thinned), 2):  # small transactions, so that the others get in between
        some = replace(plan, thinned=plan.thinned[start : start + 2])
        removed |= {n for one in history.retention.apply(some, STRICT) for n in one.versions}
    stop.set()
    for thread in threads:
        thread.join(60)
    assert failures == []
    assert not removed & set(used)
    assert removed | set(used) == set(range(1, 20)) | set(used)
    assert kept(history) == set(range(21)) - removed
    assert history.garbage.collect(timedelta(0))["chunks"] >= 0
    assert history.verifier().run().findings == []

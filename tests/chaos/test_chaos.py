"""kill -9 of server, router, database and collector at random moments.

Meanwhile uploads, promotes and closures are written, garbage is collected, events are relayed and sent to a webhook,
and robots download.

Each is killed FLEETMAP_CHAOS times (4, ``make chaos``: 50), split between two setups: PostgreSQL with the server's own
router, and SQLite with a separate router. FLEETMAP_CHAOS_SEED selects another order of moments.
"""

from __future__ import annotations

import json
import os
import random
import time
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from tests.agent.conftest import ROOT
from tests.chaos.world import ANY, COMMIT, DOWNLOAD, ENVIRONMENT, RELAY, Fleet, World, fleet_of
from tests.events.conftest import eventually
from tests.postgres import Cluster, postgres_cluster
from tests.preloaded import run_preloaded

__all__ = ["postgres_cluster"]

KILLS = int(os.environ.get("FLEETMAP_CHAOS", "4"))
SEED = int(os.environ.get("FLEETMAP_CHAOS_SEED", "5"))
SECONDS_A_KILL = 30

pytestmark = pytest.mark.timeout(240 + 3 * KILLS * SECONDS_A_KILL)


@pytest.mark.postgres
def test_postgresql_with_own_router_survives_kills(tmp_path: Path, postgres_cluster: Cluster) -> None:
    each = {"server": KILLS - KILLS // 2, "router": KILLS - KILLS // 2, "database": KILLS, "collector": KILLS // 2}
    with fleet_of(tmp_path, postgres_cluster, own_router=True, seed=SEED) as fleet:
        kill_repeatedly(fleet, each)
        check(fleet)


def test_sqlite_with_separate_router_survives_kills(tmp_path: Path) -> None:
    each = {"server": KILLS // 2, "router": KILLS // 2, "collector": KILLS // 4}
    with fleet_of(tmp_path, None, own_router=False, seed=SEED + 100) as fleet:
        kill_repeatedly(fleet, each)
        check(fleet)


def kill_repeatedly(fleet: Fleet, each: dict[str, int]) -> list[float]:
    """Kill each process ``each`` times in random order, in each phase in turn. Returns seconds until /healthz."""
    world, dice = fleet.world, random.Random(SEED)
    order = [target for target, count in each.items() for _ in range(count)]
    dice.shuffle(order)
    aims = {target: [COMMIT, RELAY, DOWNLOAD, ANY] for target in each}
    met: Counter[tuple[str, str]] = Counter()
    healthy: list[float] = []
    for target in order:
        aim = aims[target].pop(0)
        aims[target].append(aim)
        fleet.wait_for(aim)
        met.update((target, phase) for phase in fleet.under_way())
        getattr(world, f"kill_{target}")()
        time.sleep(dice.choice((0.0, 0.0, 0.1, 0.5)))
        healthy.append(world.revive(target))
        before = fleet.count_commits()
        if dice.random() < 0.7:  # otherwise the next kill hits it during its start
            eventually(lambda n=before: fleet.count_commits() > n, 60)
        if dice.random() < 0.3:  # a pause, so that robots make progress
            lines = [len(robot.lines) for robot in fleet.robots]
            eventually(lambda at=lines: any(r.saw("switched", n) for r, n in zip(fleet.robots, at, strict=True)), 60)
    print(f"killed {dict(Counter(order))}; under way then: { {f'{t} {p}': n for (t, p), n in sorted(met.items())} }")
    for phase in (COMMIT, RELAY, DOWNLOAD) if len(order) >= 10 else ():
        assert any(count for (_, p), count in met.items() if p == phase), f"no kill came in the middle of a {phase}"
    return healthy


def check(fleet: Fleet) -> None:
    """Check the invariants after all kills."""
    world = fleet.world
    head = fleet.settle()
    fleet.watcher.stop()
    check_versions(fleet, head["version"])
    events = _events(world)
    last = events[-1]["sequence"]
    assert [event["sequence"] for event in events] == list(range(1, last + 1)), "the log has a gap"
    created = [event["version"] for event in events if event["type"] == "version.created"]
    assert created == list(range(1, head["version"] + 1)), "an event is missing or duplicate"
    expected = list(range(1, last + 1))
    eventually(lambda: fleet.reader.sequences[-1:] == [last])
    assert fleet.reader.sequences == expected, "server-sent events: a gap or a repeat"
    # A new leader publishes new events first, then those that it may have missed.
    fleet.listener.wait(lambda listener: sorted(listener.sequences()) == expected, 250)
    received = eventually(lambda: (s := _in_order(fleet.receiver.sequences(ENVIRONMENT)))[-1:] == [last] and s)
    assert received == expected, "webhook: a gap, or an event before an earlier one"
    assert fleet.receiver.problems == []
    check_promotes(fleet, events)
    check_closures(fleet)
    check_stored_data(fleet)
    check_robots(fleet, head)


def check_versions(fleet: Fleet, head: int) -> None:
    """Check that versions have no gap, and contain each acknowledged one once, under its number."""
    versions = []
    cursor = head + 1
    while cursor > 0:
        page = fleet.world.get(f"environments/{ENVIRONMENT}/versions?limit=100" + _after(versions))
        versions += page
        cursor = page[-1]["version"]
    assert [v["version"] for v in versions] == list(range(head, -1, -1)), "a gap, a fork or a number used twice"
    assert [v["parent"] for v in versions] == [*range(head - 1, -1, -1), None]
    messages = {v["version"]: v["message"] for v in versions}
    assert all(writer.commits for writer in (*fleet.first, *fleet.writers))
    assert lost_versions(fleet, messages) == []
    counts = Counter(messages.values())
    assert all(counts[message] == 1 for writer in fleet.writers for message in writer.commits), "a commit was repeated"


def lost_versions(fleet: Fleet, messages: dict[int, str]) -> list[int]:
    """List acknowledged versions that are missing or another commit, by the messages that the server lists."""
    commits = [item for writer in (*fleet.first, *fleet.writers) for item in writer.commits.items()]
    return [number for message, number in commits if messages.get(number) != message]


def check_promotes(fleet: Fleet, events: list[dict[str, Any]]) -> None:
    """Check that the log has each acknowledged move of the channel, in order."""
    moves = iter(event["version"] for event in events if event["type"] == "channel.moved")
    assert fleet.promoter.moves
    assert all(version in moves for version in fleet.promoter.moves), "an acknowledged promote is lost"


def check_closures(fleet: Fleet) -> None:
    """Check that each closure is at least as far as it was acknowledged."""
    ranks = fleet.closer.RANKS
    assert "ended" in fleet.closer.states.values()
    stored: dict[str, str] = {}
    for state in ranks:
        rows = fleet.world.get(f"environments/{ENVIRONMENT}/overlays?state={state}")
        stored |= {row["id"]: row["state"] for row in rows}
    lost = [key for key, state in fleet.closer.states.items() if ranks.get(stored.get(key, ""), -1) < ranks[state]]
    assert lost == [], "an acknowledged closure is lost"


def check_stored_data(fleet: Fleet) -> None:
    """Check that all versions are whole, by ``fleetmap verify``, and that garbage was collected meanwhile."""
    world = fleet.world
    variables = {**os.environ, **world.variables, "FLEETMAP_DATA_DIR": str(world.folder / "data")}
    done = run_preloaded(["verify", "--json"], env=variables, cwd=ROOT)
    assert done.returncode == 0, done.stdout
    log = (world.folder / "collector.log").read_text()
    assert "'chunks':" in log, f"nothing was collected:\n{log[-2000:]}"
    assert "Traceback" not in log, log[-2000:]


def _in_order(sequences: list[int]) -> list[int]:
    """Return each sequence once, in the order they first came."""
    return list(dict.fromkeys(sequences))


def _after(versions: list[dict[str, object]]) -> str:
    return f"&cursor={versions[-1]['version']}" if versions else ""


def _events(world: World) -> list[dict[str, Any]]:
    """Read the complete event log of the environment, like a new client."""
    out: list[dict[str, Any]] = []
    answer = world.http.get("events", params={"environment": ENVIRONMENT, "since": 0, "follow": False})
    assert answer.status_code == 200
    for line in answer.text.splitlines():
        if line.startswith("data:"):
            out.append(json.loads(line[5:]))
    return out


def check_robots(fleet: Fleet, head: dict[str, object]) -> None:
    """Check that all robots run the head's root, intact, and processed sequences without repetition or step back."""
    for robot in fleet.robots:
        name = robot.into.name
        assert robot.standing["root"] == head["root"]
        robot.wait("hook", version=head["version"])
        lines = robot.into.with_name(f"{name}.hooks").read_text().split("\n")[:-1]
        done = [(int(a), int(b), c) for a, b, c in (line.split() for line in lines)]
        sequences = [sequence for sequence, _, _ in done]
        assert sequences == sorted(set(sequences)), f"{name} processed a sequence twice, or an older one"
        assert len(done) > 1, f"{name} followed nothing"
        assert done[-1][2] == head["root"]
        for kind in ("refused", "damaged"):
            assert robot.saw(kind) is None, robot.saw(kind)
        assert robot.process.poll() is None, f"{name} has ended: {robot.lines[-3:]}"
    assert fleet.watcher.looks > 100
    proof = eventually(lambda: _agreed(fleet), 60)
    assert proof == {"latest": 2, "production": 1}


def _agreed(fleet: Fleet) -> dict[str, int] | None:
    """Return the number of robots that run their channel's root once all do, according to the server; else None."""
    channels = fleet.world.get(f"environments/{ENVIRONMENT}/channels")
    if any(c["robots"]["holding"] != c["robots"]["total"] for c in channels):
        return None
    return {c["channel"]: c["robots"]["holding"] for c in channels}

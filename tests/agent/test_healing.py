"""Faults of server, clock or disk neither stop the agent nor block it permanently."""

from __future__ import annotations

import errno
import json
import shutil
import time
from collections.abc import Callable, Iterator
from datetime import datetime, timedelta, timezone
from http.server import BaseHTTPRequestHandler
from pathlib import Path

import pytest

from app.agent import activation, agent
from app.cli.agent import _logger
from tests.agent.conftest import whole
from tests.agent.fake import Fake, One, StoppedClock, run, send
from tests.events.conftest import eventually

A, B, C = ({"kml/map.kml": letter * 5000} for letter in (b"a", b"b", b"c"))

Robot = Callable[..., One]


@pytest.fixture
def fake(tmp_path: Path) -> Iterator[Fake]:
    server = Fake(tmp_path / "keys")
    server.put(A)
    server.close_edges()
    yield server
    server.close()


@pytest.fixture
def robot(fake: Fake, tmp_path: Path) -> Robot:
    return lambda *on_change, **more: One(fake, tmp_path / "robot", *on_change, **more)


@pytest.fixture(autouse=True)
def _short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(agent, "FIRST_PAUSE_SECONDS", 0.05)


def later(**delta: float) -> str:
    return (datetime.now(timezone.utc) + timedelta(**delta)).isoformat()


def test_invalid_unicode_of_server_is_reported(fake: Fake, robot: Robot) -> None:
    fake.instead = lambda h: "/manifest" in h.path and (send(h, 409, b'{"detail": "bad \\ud800 text"}') or True)
    one = robot()
    assert not one.once()
    assert one.detail == "bad ? text"
    assert fake.statuses[-1]["detail"] == "bad ? text"


@pytest.mark.parametrize("as_json", [True, False])
def test_log_prints_invalid_unicode(as_json: bool, capfd: pytest.CaptureFixture[str]) -> None:
    _logger(as_json=as_json)("failed", detail="bad \ud800 text")
    captured = capfd.readouterr()
    assert "bad ? text" in captured.out + captured.err


@pytest.fixture
def opened(fake: Fake, tmp_path: Path) -> Iterator[One]:
    """An agent that stays the same for several polls."""
    one = One(fake, tmp_path / "robot")
    one.agent.open()
    yield one
    one.agent.close()


def test_time_far_ahead_does_not_freeze_server(fake: Fake, stopped: StoppedClock, opened: One) -> None:
    assert opened.agent.run_once()
    fake.more = {"time": later(hours=2)}
    fake.put(B)
    assert opened.agent.run_once()
    fake.more = {}
    for _ in range(5):  # in all much longer than half an hour
        stopped.seconds += 1200
        fake.put(C)
        assert opened.agent.run_once()
    assert not opened.saw("refused")
    stopped.seconds += 1801
    assert not opened.agent.run_once(), "and then it is frozen"
    assert "no new signed response" in opened.detail


def test_slow_download_and_hooks_do_not_freeze_server(fake: Fake, stopped: StoppedClock, tmp_path: Path) -> None:
    def slow(handler: BaseHTTPRequestHandler) -> bool:
        stopped.seconds += 3600.0 * ("/maps/" in handler.path)
        return False

    one = One(fake, tmp_path / "robot", "true")
    fake.instead = slow
    one.agent.open()
    assert one.agent.run_once()
    assert (fake.statuses[-1]["state"], fake.statuses[-1]["version"]) == ("active", 1)
    assert not one.agent.run_once(), "an hour later the same response is returned"
    assert "no new signed response" in one.detail
    fake.put(B)
    assert one.agent.run_once()
    one.agent.close()


def test_planned_versions_do_not_hide_a_frozen_channel(fake: Fake, stopped: StoppedClock, opened: One) -> None:
    fake.put(B)
    fake.move("production", 1)
    assert opened.agent.run_once()
    for count in range(4):
        stopped.seconds += 600
        fake.plan("production", 1 + count % 2)  # another one with each poll
        opened.agent.run_once()
        assert bool(opened.saw("refused")) == (count == 3)
    assert "no new signed response" in opened.detail


def test_agent_recovers_from_absurd_time_at_first_contact(fake: Fake, robot: Robot) -> None:
    fake.more = {"time": later(days=4500), "expires": later(days=4501)}
    assert robot(clock=lambda: 1000.0).once()
    fake.more = {}
    fake.put(B)
    assert robot().once()


def test_time_out_of_range_is_refused(fake: Fake, robot: Robot) -> None:
    assert robot().once()
    fake.put(B)
    for members in (
        {"time": "9999-12-31T23:59:59-23:59", "expires": "9999-12-31T23:59:59-23:59"},
        {"levels": [{"name": "g", "elevation": 10**400}]},
    ):
        fake.more = members
        one = robot()
        assert not one.once()
        assert "invalid manifest" in one.detail
    fake.more = {}
    assert robot().once()


def test_endorsed_key_resets_newest_time(fake: Fake, robot: Robot) -> None:
    one = robot()
    assert one.once()
    path = one.into / "state.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "newest_time": time.time() + 4000 * 86400}))
    fake.put(B)
    one = robot()
    assert not one.once()
    assert "expired" in one.detail
    fake.keys.rotate()
    assert robot().once()
    assert whole(one.into)["version"] == 2


def test_folders_are_bounded_while_a_map_waits(fake: Fake, robot: Robot) -> None:
    assert robot().once()
    fake.put(B)
    one = robot(before_switch=("exit 75",))
    one.agent.open()
    for count in range(8):
        fake.close_edges(f"e{count}")
        one.agent.run_once()
    one.agent.close()
    assert len(list((one.into / "versions").iterdir())) <= 5
    assert len(list((one.into / "partial").iterdir())) <= 1


def test_closures_keep_previous_version(fake: Fake, robot: Robot) -> None:
    one = robot()
    assert one.once()
    fake.put(B)
    assert robot().once()
    for edge in "wxyz":
        fake.close_edges(edge)
        assert robot().once()
    fake.close_edges()
    assert robot().once()
    assert any(path.name.startswith("1-") for path in (one.into / "versions").iterdir())
    fake.move("latest", 1)
    fake.asked.clear()
    assert robot().once()
    assert not [path for path in fake.asked if "/maps/" in path]


def test_full_disk_before_the_hooks_puts_the_version_back(
    fake: Fake, robot: Robot, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    hook = f"head -c1 $FLEETMAP_CURRENT/kml/map.kml >> {tmp_path}/log"
    assert robot(hook).once()
    fake.put(B)

    def write(path: Path, _: bytes) -> None:
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    with monkeypatch.context() as patch:
        patch.setattr(activation, "write_durably", write)
        one = robot(hook)
        assert not one.once()
    assert "changed: No space left on device" in one.detail
    assert whole(one.into)["version"] == 1
    assert (tmp_path / "log").read_text() == "a", "the robot still has version 1"
    assert (fake.statuses[-1]["state"], fake.statuses[-1]["holds"]["version"]) == ("failed", 1)
    assert robot(hook).once()


def test_empty_folder_is_reported_as_such(fake: Fake, robot: Robot) -> None:
    one = robot()
    assert one.once()
    shutil.rmtree(one.into)
    fake.instead = lambda h: "/maps/" in h.path and (send(h, 500, b"{}") or True)
    assert not robot().once()
    assert fake.statuses[-1]["holds"] == {"version": 0, "root": "0" * 64}


def test_map_without_the_robots_level_is_refused_before_the_switch(fake: Fake, robot: Robot, tmp_path: Path) -> None:
    fake.levels = {"kml/map.kml": "L1"}
    hook = f"echo $FLEETMAP_VERSION >> {tmp_path}/log"
    fake.put(C)
    one = robot(hook, poll_seconds=0.1)
    assert one.once()
    (one.into / "level").write_text("L1\n")
    fake.put(B)
    fake.levels = {"kml/map.kml": "L2"}
    one = robot(hook, poll_seconds=0.1)
    with run(one):
        eventually(lambda: one.saw("failed"))
        time.sleep(1)
    assert "version 3 has no level" in one.detail
    assert whole(one.into)["version"] == 2
    assert (tmp_path / "log").read_text().split() == ["2"]
    assert (fake.statuses[-1]["state"], fake.statuses[-1]["version"]) == ("failed", 3)

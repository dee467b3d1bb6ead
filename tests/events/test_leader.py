"""The thread that one process of a data folder has: who has it, and how it says it stands."""

from __future__ import annotations

import logging
import signal
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from app.backends.lead import LocalLeads
from app.backends.notify import CommitCounter
from app.errors import Unavailable
from app.events.leader import LeaderThread, read_state
from tests.events.conftest import eventually


class Rounds(LeaderThread):
    """Each round calls ``work``, then says that all is well."""

    def __init__(self, folder: Path, work: Callable[[], object]) -> None:
        leads = LocalLeads(folder)
        super().__init__(CommitCounter(folder), folder, "some", leads, well="it goes on", trouble="IT STOPPED")
        self.work, self.rounds, self.stumbles, self.shut = work, 0, 0, 0

    def _run_once(self) -> None:
        self.work()
        self.rounds += 1
        self._publish_state({"state": "connected"})
        self._stopping.wait(0.01)

    def _on_unexpected_error(self) -> None:
        super()._on_unexpected_error()
        self.stumbles += 1

    def _release(self) -> None:
        self.shut += 1


def test_state_of_killed_process_is_replaced(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "app.events.leader")
    (tmp_path / "some.json").write_text('{"state": "connected"}')
    slow = threading.Event()
    one = Rounds(tmp_path, slow.wait)
    one.start()
    try:
        assert read_state(tmp_path, "some") == {"state": "starting"}, "at once, before anybody can ask"
        assert not caplog.text, "no alarm: nothing has failed yet"
        slow.set()
        eventually(lambda: read_state(tmp_path, "some") == {"state": "connected"})
        assert "it goes on" in caplog.text
        (tmp_path / "some.json").unlink()
        eventually(lambda: read_state(tmp_path, "some") == {"state": "connected"})
    finally:
        slow.set()
        one.close()
    assert one.shut == 1


def test_next_process_takes_over_after_kill(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.events.leader.POLL_SECONDS", 0.05)
    hold = "import fcntl, sys; f = open(sys.argv[1], 'a'); fcntl.flock(f, fcntl.LOCK_EX); print('held', flush=True)"
    other = subprocess.Popen(
        [sys.executable, "-c", hold + "; input()", str(tmp_path / "some.lock")],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert other.stdout is not None
    assert other.stdout.readline() == b"held\n"
    (tmp_path / "some.json").write_text('{"state": "connected"}')
    first, second = Rounds(tmp_path, lambda: None), Rounds(tmp_path, lambda: None)
    first.start()
    try:
        threading.Event().wait(0.2)
        assert first.rounds == 0
        assert read_state(tmp_path, "some") == {"state": "connected"}, "it is the other one's to say"
        other.send_signal(signal.SIGKILL)
        other.communicate()
        eventually(lambda: first.rounds)
        second.start()
        first.close()
        rounds = first.rounds
        eventually(lambda: second.rounds)
        assert first.rounds == rounds
    finally:
        first.close()
        second.close()


def test_leader_logs_outage_and_recovery_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    monkeypatch.setattr("app.events.leader.POLL_SECONDS", 0.01)
    errors: list[Exception] = [Unavailable("the database is away")] * 3 + [ValueError("a mistake")]

    def work() -> None:
        if errors:
            if len(errors) == 1:
                eventually(lambda: read_state(tmp_path, "some")["state"] == "down")
            raise errors.pop(0)

    one = Rounds(tmp_path, work)
    one.start()
    try:
        eventually(lambda: one.rounds)
        assert caplog.text.count("IT STOPPED: the database is away") == 1
        assert caplog.text.count("fleetmap-some: unexpected error") == 1
        assert one.stumbles == 1
        eventually(lambda: read_state(tmp_path, "some") == {"state": "connected"})
    finally:
        one.close()


def test_leader_keeps_running_when_state_file_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def full(*_: object, **__: object) -> int:
        raise OSError(28, "No space left on device")

    one = Rounds(tmp_path, lambda: None)
    monkeypatch.setattr("app.events.leader.write_private", full)
    one.start()
    try:
        eventually(lambda: one.rounds > 3)
        assert "could not write some.json: No space left on device" in caplog.text
    finally:
        one.close()

"""Local faults: disk errors, damaged files, internal errors; one agent in this process against a test server."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import json
import os
import pathlib
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from app.agent import agent, map_directory
from app.errors import Conflict, Invalid
from tests.agent.conftest import ROOT, whole
from tests.agent.fake import PLACE, Fake, One, run
from tests.events.conftest import eventually

A, B = {"kml/map.kml": b"a" * 5000}, {"kml/map.kml": b"b" * 6000}


@pytest.fixture
def robot(fake: Fake, tmp_path: Path) -> Callable[..., One]:
    """A new agent of one folder, as after a restart."""
    return lambda *on_change, **more: One(fake, tmp_path / "robot", *on_change, **more)


Robot = Callable[..., One]


def test_internal_error_is_reported_and_agent_continues(
    fake: Fake, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    def wrong(*_: Any) -> None:
        raise KeyError("x")

    monkeypatch.setattr(agent, "FIRST_PAUSE_SECONDS", 0.02)
    fake.close_edges()  # a server that knows of closures takes `holds`, too
    assert robot().once()
    fake.put(B)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(map_directory.MapDirectory, "build", wrong)
        one = robot(poll_seconds=3600.0)
        with run(one):
            eventually(lambda: one.saw("failed"))
            assert "internal error in the agent (KeyError at test_local_faults.py:" in one.detail
            eventually(lambda: fake.statuses[-1]["state"] == "failed")
            assert (fake.statuses[-1]["version"], fake.statuses[-1]["holds"]["version"]) == (2, 1)
            patch.undo()
            eventually(lambda: one.saw("active", version=2))


# --- the disk ---


class Killed(BaseException):
    """As the power goes."""


def nth(monkeypatch: pytest.MonkeyPatch, number: int, error: BaseException) -> list[str]:
    """The n-th change of the disk fails, and all later ones: what was done until then."""
    done: list[str] = []

    def failing(name: str) -> None:
        real = getattr(os, name)

        def call(*arguments: Any, **more: Any) -> Any:
            done.append(name)
            if len(done) >= number:
                raise error
            return real(*arguments, **more)

        monkeypatch.setattr(os, name, call)
        accessor = getattr(pathlib, "_normal_accessor", None)  # Python 3.10's pathlib has its own names for them
        if hasattr(accessor, name):
            monkeypatch.setattr(accessor, name, call)

    for name in ("fsync", "replace", "rename", "link", "symlink", "mkdir", "utime"):
        failing(name)
    return done


@pytest.mark.parametrize("error", [OSError(errno.ENOSPC, "No space left on device"), Killed()], ids=["full", "killed"])
def test_agent_recovers_from_disk_error_at_each_step(fake: Fake, tmp_path: Path, error: BaseException) -> None:
    fake.put({**B, "kml/same.kml": b"s" * 10})
    fake.versions[0] = {**A, "kml/same.kml": b"s" * 10}
    fake.move("latest", 1)
    assert One(fake, tmp_path / "first", "true").once()
    fake.move("latest", 2)
    step = 1 if isinstance(error, Killed) else 2
    number, good = 1 - step, False
    while not good:
        number += step
        into, taken = tmp_path / f"robot{number}", tmp_path / f"taken{number}"
        shutil.copytree(tmp_path / "first", into, symlinks=True)
        hook = f"cp $FLEETMAP_CURRENT/kml/map.kml {taken}"
        one = One(fake, into, hook)
        one.agent.open()
        with pytest.MonkeyPatch.context() as patch:
            nth(patch, number, error)
            with contextlib.suppress(Killed):
                good = one.agent.run_once()
        assert whole(into)["version"] in (1, 2)
        if not good and isinstance(error, Killed):
            one.agent.close()
            one = One(fake, into, hook)
            one.agent.open()
        elif not good:
            assert "No space left" in one.detail
            assert fake.statuses[-1]["state"] == "failed"
            assert not list((into / "versions").glob(".new")), "a full disk is not left fuller"
        assert one.agent.run_once(), "also without a restart, once there is room"
        one.agent.close()
        assert whole(into)["version"] == 2
        assert taken.read_bytes() == B["kml/map.kml"]
        assert json.loads((into / "state.json").read_text())["marks"]["latest"]["sequence"] == fake.sequence
        assert len(list((into / "versions").iterdir())) == 2
    assert number > 15, "there are as many steps at least"


def test_old_downloads_and_versions_are_removed_for_space(
    fake: Fake, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    room = 20_000

    def used(path: Path) -> int:
        inodes = {p.stat().st_ino: p.stat().st_size for p in path.rglob("*.kml")}
        inodes |= {p.stat().st_ino: p.stat().st_size for p in (path / "partial").iterdir()}
        return sum(inodes.values())

    monkeypatch.setattr(map_directory.MapDirectory, "_free", lambda self: room - used(self.path))
    monkeypatch.setattr(map_directory, "CHUNK", 0)
    assert robot().once()  # 5000 bytes
    fake.put(B)
    assert robot().once()  # 6000 bytes, and the 5000 of before
    partial = robot().into / "partial"
    (partial / ("0" * 64 + ".part")).write_bytes(bytes(4000))
    fake.put({"kml/map.kml": b"c" * 9000})  # fits without the part
    assert robot().once()
    assert {p.name[:2] for p in (robot().into / "versions").iterdir()} == {"1-", "2-", "3-"}
    fake.put({"kml/map.kml": b"d" * 9000})
    (partial / (hashlib.sha256(b"d" * 9000).hexdigest() + ".part")).write_bytes(b"d" * 5000)
    one = robot()
    assert one.once(), one.lines
    assert fake.asked[-1].endswith("map.kml")
    assert whole(one.into)["version"] == 4
    assert {p.name[:2] for p in (robot().into / "versions").iterdir()} == {"3-", "4-"}, "the others were in the way"
    fake.put({"kml/map.kml": b"e" * 12_000})
    one = robot()
    assert not one.once()
    assert "11000 are free" in one.detail
    assert whole(one.into)["version"] == 4


def test_full_disk_removes_old_versions_before_state(fake: Fake, robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    assert robot().once()
    fake.put(B)
    assert robot().once()
    fake.put(A)
    real, into = os.fsync, robot().into

    def full(descriptor: int) -> None:
        if len(list((into / "versions").iterdir())) > 1:
            raise OSError(errno.ENOSPC, "No space left on device")
        real(descriptor)

    one = robot()
    one.agent.open()
    monkeypatch.setattr(os, "fsync", full)
    assert not one.agent.run_once(), "there is room for the memory, and not for the map"
    assert f"{into}: No space left" in one.detail
    assert json.loads((into / "state.json").read_text())["marks"]["latest"]["sequence"] == 3
    assert whole(into)["version"] == 2
    monkeypatch.undo()
    assert one.agent.run_once()
    one.agent.close()
    assert whole(into)["version"] == 3


def test_reinstalled_server_is_refused_until_state_is_deleted(fake: Fake, robot: Robot, tmp_path: Path) -> None:
    fake.put(B)
    assert robot().once()
    anew = Fake(tmp_path / "other")
    try:
        anew.put(A)
        one = One(anew, robot().into)
        assert not one.once()
        assert "possibly another server. If this is intended" in one.detail
        assert whole(one.into)["version"] == 2
        anew.keys = fake.keys
        one = One(anew, robot().into)
        assert not one.once()
        assert "If the server was reinstalled, delete state.json" in one.detail
        (one.into / "state.json").unlink()
        one = One(anew, robot().into)
        assert one.once()
        assert whole(one.into)["version"] == 1
        assert one.saw("trusting", detail="first contact")
    finally:
        anew.close()


def test_file_names_equal_on_file_system_are_refused(fake: Fake, robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    fake.put({"kml/Map.kml": b"a", "kml/map.kml": b"b"})

    def exists_in_any_case(path: Path) -> bool:
        return path.name.lower() in {p.name.lower() for p in path.parent.iterdir()}

    monkeypatch.setattr(os.path, "lexists", exists_in_any_case)
    one = robot()
    assert not one.once()
    assert "have the same name on the file system" in one.detail
    assert not (one.into / "current").exists()
    monkeypatch.undo()
    assert robot().once()


def test_agent_copies_files_without_hard_links(fake: Fake, robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    for number in range(4):
        fake.put({**B, "kml/other.kml": bytes([number]) * 3000})
        one = robot()
        assert one.once(), one.lines
        assert whole(one.into)["version"] == number + 2


def test_file_system_without_locks_is_reported(fake: Fake, robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(Invalid, match=r"could not lock .* \(No locks available\)"):
        robot().once()


def test_damage_while_running_is_reported_and_repaired(fake: Fake, robot: Robot, tmp_path: Path) -> None:
    one = robot(f"cat $FLEETMAP_CURRENT/kml/map.kml > {tmp_path}/taken")
    one.agent.open()
    assert one.agent.run_once()
    path = one.into / "current" / "kml" / "map.kml"
    path.chmod(0o644)
    path.write_bytes(b"x" * 5000)
    (tmp_path / "taken").unlink()
    fake.more = {"expires": "2999-01-01T00:00:00Z"}  # the next signature over the same map
    fake.instead = lambda h: bool(h.headers.__delitem__("if-none-match"))
    assert one.agent.run_once()
    one.agent.close()
    assert one.saw("damaged", version=1, files=["kml/map.kml"])
    assert whole(one.into)["version"] == 1
    assert (tmp_path / "taken").read_bytes() == A["kml/map.kml"]


def test_preloaded_files_are_verified_again(fake: Fake, robot: Robot) -> None:
    assert robot().once()
    fake.put(B)
    ready = robot().into / "partial" / hashlib.sha256(B["kml/map.kml"]).hexdigest()
    ready.write_bytes(b"x" * 6000)
    one = robot()
    assert one.once(), one.lines
    assert whole(one.into)["version"] == 2


def test_links_of_others_are_not_followed(fake: Fake, robot: Robot, tmp_path: Path) -> None:
    assert robot().once()
    into, target = robot().into, tmp_path / "mine"
    target.write_text("mine")
    fake.put(B)
    (into / ".state.json.new").symlink_to(target)
    (into / ".current.new").symlink_to(target)
    (into / ".changed.new").symlink_to(target)
    (into / "partial" / (hashlib.sha256(B["kml/map.kml"]).hexdigest() + ".part")).symlink_to(tmp_path / "absent")
    assert robot("true").once()
    assert whole(into)["version"] == 2
    assert target.read_text() == "mine"
    assert not (tmp_path / "absent").exists()


def test_agent_keeps_running_when_log_cannot_be_written(fake: Fake, tmp_path: Path) -> None:
    arguments = ["agent", "-s", fake.url, "-e", PLACE, "-f", "kml", "--into", str(tmp_path / "robot"), "--once"]
    reader, nobody = os.pipe()
    os.close(reader)
    with Path("/dev/full").open("w") as full, os.fdopen(nobody, "w") as closed:
        for log, more in ((full, []), (full, ["--json"]), (closed, []), (closed, ["--json"])):
            process = subprocess.run(
                [sys.executable, "-m", "app.cli", *arguments, *more],
                env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(ROOT)},
                stdout=log,
                stderr=log,
                timeout=60,
                check=False,
            )
            assert whole(tmp_path / "robot")["version"] == len(fake.versions), process
            assert fake.statuses[-1]["state"] == "active", "and it said so"
            fake.put({"kml/map.kml": bytes(len(fake.versions))})


# --- hooks ---


def test_hook_variables_of_many_changed_files_are_truncated(fake: Fake, robot: Robot, tmp_path: Path) -> None:
    names = [f"kml/models/{'x' * 40}/{k}.kml" for k in range(4000)]
    fake.put({"kml/map.kml": b"new", **dict.fromkeys(names, b"m")})
    hook = f'printf "%s\\n" "$FLEETMAP_CHANGED" > {tmp_path}/some; cp "$FLEETMAP_CHANGED_FILE" {tmp_path}/all'
    one = robot(hook)
    assert one.once(), one.lines
    assert (tmp_path / "all").read_text().splitlines() == sorted([*names, "kml/map.kml"])
    some = (tmp_path / "some").read_text().splitlines()
    assert "kml/map.kml" in some, "what lies deepest is left out first"
    assert 1000 < len(some) < 4000


def test_directory_with_foreign_current_is_refused(fake: Fake, robot: Robot) -> None:
    robot().into.mkdir()
    (robot().into / "current").mkdir()
    with pytest.raises(Conflict, match="is not a link"):
        robot().once()

"""Bad luck and bad servers, one agent in this process against a server that signs and does whatever a test wants."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import gzip
import hashlib
import json
import os
import pathlib
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

import pytest

from app.agent import agent, http_client, map_directory
from app.agent.zenoh_client import ZenohClient
from app.errors import Conflict, Invalid
from app.events import messages
from tests.agent.conftest import ROOT, whole
from tests.agent.fake import PLACE, Fake, One, run, send
from tests.events.conftest import eventually, free_port

A, B = {"kml/map.kml": b"a" * 5000}, {"kml/map.kml": b"b" * 6000}


@pytest.fixture
def fake(tmp_path: Path) -> Iterator[Fake]:
    server = Fake(tmp_path / "keys")
    server.put(A)
    yield server
    server.close()


@pytest.fixture
def robot(fake: Fake, tmp_path: Path) -> Callable[..., One]:
    """A new agent of one folder, as after a restart."""
    return lambda *on_change, **more: One(fake, tmp_path / "robot", *on_change, **more)


Robot = Callable[..., One]


def event(sequence: int, **more: Any) -> messages.Event:
    body = {"sequence": sequence, "type": "version.created", "environment": PLACE, "version": 2, "root": "0" * 64}
    return messages.Event.from_json(json.dumps(body | more))


# --- the server knows less than its events ---


def test_it_looks_again_where_the_server_knew_less_than_its_event(
    fake: Fake, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(agent, "FIRST_PAUSE_SECONDS", 0.02)
    one = robot(poll_seconds=3600.0)
    with run(one):
        eventually(lambda: one.saw("active", version=1))
        fake.asked.clear()
        one.agent._on_event(event(2))
        eventually(lambda: sum("/manifest" in path for path in fake.asked) >= 3)
        assert whole(one.into)["version"] == 1
        assert not one.saw("failed"), "a server behind its own events is no failure"
        fake.put(B)
        eventually(lambda: one.saw("active", version=2))
        fake.asked.clear()
        time.sleep(0.3)
        assert not fake.asked, "and then it is content"


def test_a_version_that_the_channel_does_not_follow_is_not_waited_for(
    fake: Fake, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(agent, "FIRST_PAUSE_SECONDS", 0.001)
    fake.move("production", 1)
    one = robot(poll_seconds=3600.0)
    one.agent._on_event(event(9))  # before it knows which channel it follows
    with run(one):
        eventually(lambda: one.saw("active", version=1))
        one.agent._on_event(event(10))
        time.sleep(0.3)
    assert sum("/manifest" in path for path in fake.asked) == 1


def test_an_event_that_never_comes_true_costs_ever_less(
    fake: Fake, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(agent, "FIRST_PAUSE_SECONDS", 0.001)
    one = robot(poll_seconds=3600.0)
    with run(one):
        eventually(lambda: one.saw("active", version=1))
        fake.asked.clear()
        one.agent._on_event(event(10**8))
        time.sleep(1.5)
    assert 3 <= sum("/manifest" in path for path in fake.asked) <= 14, "1, 2, 4 … ms"


# --- what stands, and what the robot has taken of it ---


def test_hooks_run_for_a_map_that_was_taken_back_while_they_ran(fake: Fake, robot: Robot, tmp_path: Path) -> None:
    taken = tmp_path / "taken"
    loads = f"cat $FLEETMAP_CURRENT/kml/map.kml > {taken}"
    assert robot(loads).once()
    fake.put(B)
    one = robot(f"{loads}; sleep 60")
    with run(one):
        eventually(lambda: taken.read_bytes() == B["kml/map.kml"])
    assert json.loads((one.into / "state.json").read_text())["activated"] is None
    fake.move("latest", 1)
    again = robot(loads)
    assert again.once()
    assert whole(one.into)["version"] == 1
    assert taken.read_bytes() == A["kml/map.kml"], "what the robot drives by is what stands"


def test_not_modified_is_not_asked_of_a_map_that_does_not_stand(fake: Fake, robot: Robot) -> None:
    assert robot().once()
    fake.put(B)
    one = robot()
    assert one.once()
    old = next(p.name for p in (one.into / "versions").iterdir() if p.name.startswith("1-"))
    (one.into / "current").unlink()
    (one.into / "current").symlink_to(f"versions/{old}")  # somebody went back by hand
    assert robot().once()
    assert whole(one.into)["version"] == 2
    (one.into / "current" / "manifest.json").unlink()
    assert robot().once()
    assert whole(one.into)["version"] == 2
    (one.into / "current").unlink()
    (one.into / "current").symlink_to(f"/tmp/{old}")
    assert robot().once()
    assert whole(one.into)["version"] == 2


def test_where_the_channels_are_not_told_latest_is_not_guessed(fake: Fake, robot: Robot) -> None:
    fake.move("production", 1)
    fake.put(B)
    for status in (400, 404, 200, 301):
        fake.instead = lambda h, s=status: "/channels" in h.path and (send(h, s, b"{}") or True)
        one = robot()
        assert not one.once()
        assert not (one.into / "current").exists(), "latest may be what nobody has tried yet"
    fake.instead = lambda _: False
    assert robot().once()
    assert whole(one.into)["version"] == 1
    fake.instead = lambda h: "/channels" in h.path and (send(h, 400, b"{}") or True)
    assert robot().once(), "production stays so"


def test_a_map_that_is_taken_back_during_its_download_is_not_put_in_place(
    fake: Fake, robot: Robot, tmp_path: Path
) -> None:
    log = f"echo $FLEETMAP_VERSION >> {tmp_path}/log"
    assert robot(log).once()
    fake.put(B)
    one = robot(log, poll_seconds=3600.0)

    def slow(handler: BaseHTTPRequestHandler) -> bool:
        if "/maps/" in handler.path:
            fake.move("latest", 1)
            one.agent._on_event(event(3, type="version.created"))
        return False

    fake.instead = slow
    with run(one):
        eventually(lambda: one.saw("active", version=1))
    assert not one.saw("switched", version=2)
    assert whole(one.into)["sequence"] == 3
    assert (tmp_path / "log").read_text().split() == ["1"], "nor is the robot bothered"


def test_where_the_next_map_comes_during_a_download_both_are_taken(fake: Fake, robot: Robot) -> None:
    assert robot().once()
    fake.put(B)
    one = robot(poll_seconds=3600.0)

    def slow(handler: BaseHTTPRequestHandler) -> bool:
        if "/versions/2/maps/" in handler.path:
            fake.put({"kml/map.kml": b"c" * 7000})
            one.agent._on_event(event(3))
        return False

    fake.instead = slow
    with run(one):
        eventually(lambda: one.saw("active", version=3))
    assert one.saw("switched", version=2), "else a fleet that changes faster than its line would never move"


def test_what_is_planned_is_what_is_preloaded(fake: Fake, robot: Robot) -> None:
    fake.move("production", 1)
    fake.put(B)
    fake.planned["production"] = {"version": 2}

    def other(handler: BaseHTTPRequestHandler) -> bool:
        handler.path = handler.path.replace("/versions/2/manifest", "/versions/1/manifest")
        return False

    fake.instead = other
    one = robot()
    assert not one.once()
    assert "of version 1 instead of 2" in one.detail
    fake.instead = lambda _: False
    again = robot()
    assert again.once()
    assert again.saw("ready", version=2)


def test_models_are_found_by_gazebo(fake: Fake, robot: Robot) -> None:
    fake.put({"gazebo/world.sdf": b"w", "gazebo/models/shelf/model.sdf": b"m"})
    one = robot(formats=("gazebo",))
    assert one.once()
    script = 'set -eu; . "$1"; printf "%s\n" "$GAZEBO_MODEL_PATH"; . "$1"; printf "%s\n" "$GAZEBO_MODEL_PATH"'
    command = ["env", "-u", "GAZEBO_MODEL_PATH", "sh", "-c", script, "sh", one.into / "current" / "environment.sh"]
    search_paths = subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()
    models = str(one.into / "current" / "gazebo" / "models")
    assert search_paths == [models, f"{models}:{models}"], "no empty place in it, which would be wherever one is"


def test_a_moved_folder_has_its_paths_put_right(fake: Fake, robot: Robot, tmp_path: Path) -> None:
    assert robot().once()
    (tmp_path / "robot").rename(tmp_path / "elsewhere")
    (tmp_path / "robot").mkdir()
    fake.instead = lambda h: h.path == "/x"
    one = One(fake, tmp_path / "elsewhere")
    one.agent.open()
    one.agent.close()
    script = (tmp_path / "elsewhere" / "current" / "environment.sh").read_text()
    assert f"FLEETMAP_CURRENT={tmp_path}/elsewhere/current" in script, "also without a server"
    assert whole(tmp_path / "elsewhere")["version"] == 1


# --- servers that answer what no server should ---


def test_an_answer_to_the_status_is_not_swallowed(fake: Fake, robot: Robot) -> None:
    bomb = gzip.compress(bytes(2**20)) * 40

    def answer(status: int, body: bytes) -> Callable[[BaseHTTPRequestHandler], bool]:
        return lambda h: h.command == "PUT" and (send(h, status, body, **{"content-encoding": "gzip"}) or True)

    for number, (status, body) in enumerate([(200, b"no gzip"), (200, bomb), (400, b"no gzip"), (400, bomb)]):
        fake.put({"kml/map.kml": bytes([number]) * 100})
        fake.instead = answer(status, body)
        one = robot()
        assert one.once(), one.lines


@pytest.mark.parametrize("where", ["http://[", "//127.0.0.1:1/x", "http://127.0.0.1:1/x", "", "\x00"])
def test_jobs_are_the_servers_own(fake: Fake, robot: Robot, where: str) -> None:
    fake.instead = lambda h: "/manifest" in h.path and (send(h, 202, b"{}", location=where) or True)
    one = robot()
    assert not one.once()
    assert one.saw("failed")


def test_a_job_that_is_done_and_never_handed_out(fake: Fake, robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(http_client, "MAX_JOBS", 5)

    def job(handler: BaseHTTPRequestHandler) -> bool:
        if "/manifest" in handler.path:
            send(handler, 202, b"{}", location="/job")
        elif handler.path == "/job":
            send(handler, 200, b'{"state": "done"}')
        else:
            return False
        return True

    fake.instead = job
    one = robot()
    assert not one.once()
    assert "conversion jobs" in one.detail
    assert fake.asked.count("/job") == 5


def test_it_says_where_a_server_has_moved(fake: Fake, robot: Robot) -> None:
    fake.instead = lambda h: send(h, 308, b"", location="https://map-server/x") or True  # type: ignore[func-returns-value]
    one = robot()
    assert not one.once()
    assert "redirects to https://map-server/x: if the server has moved, change --server" in one.detail


def test_a_file_too_small_for_a_dictionary(fake: Fake, robot: Robot) -> None:
    fake.put({"kml/map.kml": b"1234567"})
    assert robot().once()
    seen: list[str | None] = []

    def answer(handler: BaseHTTPRequestHandler) -> bool:
        if "/maps/" not in handler.path:
            return False
        seen.append(handler.headers.get("available-dictionary"))
        send(handler, 200, b"x" * 60, **{"content-encoding": "dcz"})
        return True

    fake.put({"kml/map.kml": b"7654321"})
    fake.instead = answer
    one = robot()
    assert not one.once()
    assert "which was not requested" in one.detail
    assert seen == [None]
    fake.instead = lambda _: False
    assert robot().once()


def test_a_line_that_breaks_all_the_time_gets_there(fake: Fake, robot: Robot) -> None:
    fake.put({"kml/map.kml": os.urandom(50_000)})
    piece = 6000  # less than any buffer

    def cut(handler: BaseHTTPRequestHandler) -> bool:
        if "/maps/" not in handler.path:
            return False
        data = fake.versions[1]["kml/map.kml"]
        start = int((handler.headers.get("range") or "bytes=0-")[6:-1])
        handler.send_response(206 if start else 200)
        handler.send_header("content-length", str(len(data) - start))
        handler.end_headers()
        handler.wfile.write(data[start : start + piece])
        handler.close_connection = True
        return True

    fake.instead = cut
    tries = 0
    while not robot().once():
        tries += 1
        assert tries < 12
    assert tries == 50_000 // piece


@pytest.mark.parametrize("part", ["/channels", "/manifest", "/maps/"])
@pytest.mark.parametrize("kind", ["head", "body"])
def test_a_server_that_answers_slowly_for_ever_is_given_up(
    fake: Fake, robot: Robot, monkeypatch: pytest.MonkeyPatch, part: str, kind: str
) -> None:
    monkeypatch.setattr(http_client, "HEAD_SECONDS", 0.2)
    monkeypatch.setattr(http_client, "PACE_SECONDS", 0.2)
    stop = threading.Event()

    def slow(handler: BaseHTTPRequestHandler) -> bool:
        if part not in handler.path:
            return False
        if kind == "body":
            handler.send_response(200)
            handler.send_header("content-length", "5000")
            handler.end_headers()
        with contextlib.suppress(OSError):
            while not stop.wait(0.02):
                handler.wfile.write(b"H")
                handler.wfile.flush()
        handler.close_connection = True
        return True

    fake.instead = slow
    one = robot()
    assert not one.once()
    assert one.saw("failed")
    stop.set()
    fake.instead = lambda _: False
    assert robot().once()


@pytest.mark.parametrize("part", ["/channels", "/manifest", "/maps/", "/status"])
def test_it_ends_at_once_while_a_server_hangs(fake: Fake, robot: Robot, part: str) -> None:
    hangs, stop = threading.Event(), threading.Event()

    def hang(handler: BaseHTTPRequestHandler) -> bool:
        if part in handler.path:
            hangs.set()
            stop.wait(50)
        return part in handler.path

    fake.instead = hang
    one = robot()
    with run(one):
        assert hangs.wait(20)
    stop.set()
    assert not one.saw("failed"), "to end is no failure"


def test_a_mistake_of_ours_is_told_and_gone_on_from(fake: Fake, robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
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
            assert "internal error in the agent (KeyError at test_luck.py:" in one.detail
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
def test_a_disk_that_fails_at_each_step(fake: Fake, tmp_path: Path, error: BaseException) -> None:
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


def test_old_parts_and_versions_make_room(fake: Fake, robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_on_a_full_disk_old_versions_go_before_the_memory(
    fake: Fake, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
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


def test_a_server_that_was_set_up_anew(fake: Fake, robot: Robot, tmp_path: Path) -> None:
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


def test_names_that_are_one_on_this_file_system(fake: Fake, robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_a_file_system_without_hard_links(fake: Fake, robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    for number in range(4):
        fake.put({**B, "kml/other.kml": bytes([number]) * 3000})
        one = robot()
        assert one.once(), one.lines
        assert whole(one.into)["version"] == number + 2


def test_a_file_system_without_locks_is_no_other_agent(
    fake: Fake, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with pytest.raises(Invalid, match=r"could not lock .* \(No locks available\)"):
        robot().once()


def test_what_is_damaged_while_it_runs_is_told_and_healed(fake: Fake, robot: Robot, tmp_path: Path) -> None:
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


def test_what_lies_ready_is_looked_at_again(fake: Fake, robot: Robot) -> None:
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


def test_a_log_that_takes_nothing_stops_nobody(fake: Fake, tmp_path: Path) -> None:
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


def test_a_change_of_very_many_files(fake: Fake, robot: Robot, tmp_path: Path) -> None:
    names = [f"kml/models/{'x' * 40}/{k}.kml" for k in range(4000)]
    fake.put({"kml/map.kml": b"new", **dict.fromkeys(names, b"m")})
    hook = f'printf "%s\\n" "$FLEETMAP_CHANGED" > {tmp_path}/some; cp "$FLEETMAP_CHANGED_FILE" {tmp_path}/all'
    one = robot(hook)
    assert one.once(), one.lines
    assert (tmp_path / "all").read_text().splitlines() == sorted([*names, "kml/map.kml"])
    some = (tmp_path / "some").read_text().splitlines()
    assert "kml/map.kml" in some, "what lies deepest is left out first"
    assert 1000 < len(some) < 4000


def test_layers_come_signed(fake: Fake, robot: Robot, tmp_path: Path) -> None:
    log = f'echo "$FLEETMAP_LAYERS" >> {tmp_path}/log'
    fake.more = {"layers": {"objects": "1", "topology": "1"}}
    assert robot(log).once()
    fake.put(B)
    fake.more = {"layers": {"topology": "2", "zones": "1"}}
    one = robot(log, poll_seconds=3600.0)
    forged = {
        "layers": [],
        "previous": {"root": whole(one.into)["root"]},
        "root": json.loads(fake.manifest("latest"))["root"],
    }
    one.agent._on_event(event(2, **forged))
    assert one.once()
    fake.put(A)
    fake.more = {"layers": {}}
    assert robot(log).once()
    every = "imagery location objects occupancy topology voxels zones"
    assert (tmp_path / "log").read_text().splitlines() == ["objects topology", "objects topology zones", every]
    fake.put(B)
    for wrong in ({"A B": "1"}, {"topology": 1}, [1], "x"):
        fake.more = {"layers": wrong}
        one = robot(log)
        assert not one.once()
        assert "invalid manifest" in one.detail


# --- the router ---


@pytest.mark.parametrize(
    "told", ["serial//dev/ttyUSB0", "unixsock-stream//run/x", "tls/h:1#verify_name_on_connect=false"]
)
def test_a_server_tells_routers_by_plain_addresses(fake: Fake, robot: Robot, told: str) -> None:
    fake.ready = {"connect": f"tcp/127.0.0.1:{free_port()},{told}"}
    one = robot()
    with run(one):
        eventually(lambda: one.saw("polling"))
        assert one.agent._zenoh is not None
        assert not one.agent._zenoh.has_endpoint
    assert "unsupported router address" in one.saw("polling")["detail"]  # type: ignore[index]


def test_it_says_why_it_hears_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    from app.agent import zenoh_client

    monkeypatch.setattr(zenoh_client, "CONNECT_MS", 100)
    problems: list[str] = []
    port = free_port()
    one = ZenohClient(PLACE, "robot", on_event=lambda _: None, on_connected=lambda: None, on_lost=problems.append)
    try:
        one.set_endpoint(f"tcp/127.0.0.1:{port}", "fleetmap")
        eventually(lambda: problems)
    finally:
        one.close()
    assert f"no router at tcp/127.0.0.1:{port}" in problems[0]


def test_a_folder_of_someone_else(fake: Fake, robot: Robot) -> None:
    robot().into.mkdir()
    (robot().into / "current").mkdir()
    with pytest.raises(Conflict, match="is not a link"):
        robot().once()

"""Faulty servers and routers: one agent in this process against a server that signs and returns anything."""

from __future__ import annotations

import contextlib
import gzip
import json
import os
import subprocess
import threading
import time
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

import pytest

from app.agent import agent, http_client
from app.agent.zenoh_client import ZenohClient
from app.events import messages
from tests.agent.conftest import whole
from tests.agent.fake import PLACE, Fake, One, run, send
from tests.events.conftest import eventually
from tests.ports import free_port

A, B = {"kml/map.kml": b"a" * 5000}, {"kml/map.kml": b"b" * 6000}


@pytest.fixture
def robot(fake: Fake, tmp_path: Path) -> Callable[..., One]:
    """A new agent of one folder, as after a restart."""
    return lambda *on_change, **more: One(fake, tmp_path / "robot", *on_change, **more)


Robot = Callable[..., One]


def event(sequence: int, **more: Any) -> messages.Event:
    body = {"sequence": sequence, "type": "version.created", "environment": PLACE, "version": 2, "root": "0" * 64}
    return messages.Event.from_json(json.dumps(body | more))


# --- server behind its events ---


def test_agent_polls_again_when_server_is_behind_its_event(
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


def test_agent_ignores_versions_of_other_channels(fake: Fake, robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(agent, "FIRST_PAUSE_SECONDS", 0.001)
    fake.move("production", 1)
    one = robot(poll_seconds=3600.0)
    one.agent._on_event(event(9))  # before it knows which channel it follows
    with run(one):
        eventually(lambda: one.saw("active", version=1))
        one.agent._on_event(event(10))
        time.sleep(0.3)
    assert sum("/manifest" in path for path in fake.asked) == 1


def test_unconfirmed_event_backs_off(fake: Fake, robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(agent, "FIRST_PAUSE_SECONDS", 0.001)
    one = robot(poll_seconds=3600.0)
    with run(one):
        eventually(lambda: one.saw("active", version=1))
        fake.asked.clear()
        one.agent._on_event(event(10**8))
        eventually(lambda: sum("/manifest" in path for path in fake.asked) >= 3)
        time.sleep(0.5)
    assert sum("/manifest" in path for path in fake.asked) <= 14, "1, 2, 4 … ms"


# --- installed map and loaded map ---


def test_hooks_run_again_for_map_rolled_back_meanwhile(fake: Fake, robot: Robot, tmp_path: Path) -> None:
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


def test_etag_is_not_sent_when_map_is_not_installed(fake: Fake, robot: Robot) -> None:
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


def test_agent_does_not_guess_latest_without_channel_list(fake: Fake, robot: Robot) -> None:
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


def test_map_rolled_back_during_download_is_not_installed(fake: Fake, robot: Robot, tmp_path: Path) -> None:
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


def test_next_map_during_download_is_installed_afterwards(fake: Fake, robot: Robot) -> None:
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


def test_preload_refuses_other_version_than_planned(fake: Fake, robot: Robot) -> None:
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


def test_moved_directory_gets_corrected_paths(fake: Fake, robot: Robot, tmp_path: Path) -> None:
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


# --- invalid responses ---


def test_undecodable_status_response_is_handled(fake: Fake, robot: Robot) -> None:
    bomb = gzip.compress(bytes(2**20)) * 40

    def answer(status: int, body: bytes) -> Callable[[BaseHTTPRequestHandler], bool]:
        return lambda h: h.command == "PUT" and (send(h, status, body, **{"content-encoding": "gzip"}) or True)

    for number, (status, body) in enumerate([(200, b"no gzip"), (200, bomb), (400, b"no gzip"), (400, bomb)]):
        fake.put({"kml/map.kml": bytes([number]) * 100})
        fake.instead = answer(status, body)
        one = robot()
        assert one.once(), one.lines


@pytest.mark.parametrize("where", ["http://[", "//127.0.0.1:1/x", "http://127.0.0.1:1/x", "", "\x00"])
def test_job_on_another_host_is_refused(fake: Fake, robot: Robot, where: str) -> None:
    fake.instead = lambda h: "/manifest" in h.path and (send(h, 202, b"{}", location=where) or True)
    one = robot()
    assert not one.once()
    assert one.saw("failed")


def test_agent_gives_up_after_too_many_jobs(fake: Fake, robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_redirect_of_moved_server_is_reported(fake: Fake, robot: Robot) -> None:
    fake.instead = lambda h: send(h, 308, b"", location="https://map-server/x") or True  # type: ignore[func-returns-value]
    one = robot()
    assert not one.once()
    assert "redirects to https://map-server/x: if the server has moved, change --server" in one.detail


def test_small_file_is_fetched_without_delta(fake: Fake, robot: Robot) -> None:
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


def test_download_completes_despite_frequent_interruptions(fake: Fake, robot: Robot) -> None:
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
def test_endlessly_slow_response_is_aborted(
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
def test_agent_stops_at_once_while_server_hangs(fake: Fake, robot: Robot, part: str) -> None:
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
    "address", ["serial//dev/ttyUSB0", "unixsock-stream//run/x", "tls/h:1#verify_name_on_connect=false"]
)
def test_unsupported_router_address_of_server_is_refused(fake: Fake, robot: Robot, address: str) -> None:
    fake.ready = {"connect": f"tcp/127.0.0.1:{free_port()},{address}"}
    one = robot()
    with run(one):
        eventually(lambda: one.saw("polling"))
        assert one.agent._zenoh is not None
        assert not one.agent._zenoh.has_endpoint
    assert "unsupported router address" in one.saw("polling")["detail"]  # type: ignore[index]


def test_zenoh_client_reports_connection_failure(monkeypatch: pytest.MonkeyPatch) -> None:
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

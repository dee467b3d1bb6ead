"""Attacks by a malicious server: refused and reported, ``current`` unchanged, and the robot recovers by itself."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import json
import threading
import time
from collections.abc import Callable, Iterator
from datetime import datetime, timedelta, timezone
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

import pytest

from app.agent import agent, http_client
from app.agent.signed_manifest import MAX_SEQUENCE_AHEAD
from app.agent.state import AgentState, Mark, load, save
from app.errors import Conflict
from app.signing import Keys
from tests.agent.conftest import whole
from tests.agent.fake import Fake, One, StoppedClock, run, send
from tests.agent.test_bad_server import event
from tests.events.conftest import eventually

A, B = {"kml/map.kml": b"a" * 50_000}, {"kml/map.kml": b"b" * 60_000}

Robot = Callable[..., One]
Attack = Callable[[Fake, Path], None]


@pytest.fixture
def robot(fake: Fake, tmp_path: Path) -> Robot:
    return lambda *on_change, **more: One(fake, tmp_path / "robot", *on_change, **more)


@pytest.fixture(autouse=True)
def _short_times(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(agent, "FIRST_PAUSE_SECONDS", 0.02)
    monkeypatch.setattr(http_client, "PACE_SECONDS", 0.5)


def signs(fake: Fake, keys: Keys, change: Callable[[dict[str, Any]], dict[str, Any]], name: str | None = None) -> None:
    """Manifests with other members, signed with these keys; name: that the signature gives to its key."""

    def lie(handler: BaseHTTPRequestHandler) -> bool:
        if "/latest/manifest" not in handler.path:
            return False
        data = json.dumps(change(json.loads(fake.manifest("latest")))).encode()
        key, signature = keys.sign(data)
        text = f"{name or key}:{base64.b64encode(signature).decode()}"
        send(handler, 200, data, **{"fleetmap-signature": text} if name != "" else {})
        return True

    fake.instead = lie


def serves(fake: Fake, change: Callable[[bytes], bytes]) -> None:
    """Files with other bytes."""

    def lie(handler: BaseHTTPRequestHandler) -> bool:
        if "/maps/" in handler.path:
            send(handler, 200, change(fake.versions[1]["kml/map.kml"]))
        return "/maps/" in handler.path

    fake.instead = lie


def trickles(fake: Fake, rate: float, length: int | None = None) -> None:
    """Files that come at so many bytes a second; length: that they announce."""

    def lie(handler: BaseHTTPRequestHandler) -> bool:
        if "/maps/" not in handler.path:
            return False
        data = fake.versions[1]["kml/map.kml"]
        start = int((handler.headers.get("range") or "bytes=0-")[6:-1])
        handler.send_response(206 if start else 200)
        handler.send_header("content-length", str((length or len(data)) - start))
        handler.end_headers()
        handler.close_connection = True
        with contextlib.suppress(OSError):
            for at in range(start, len(data)):
                handler.wfile.write(data[at : at + 1])
                handler.wfile.flush()
                time.sleep(1 / rate)
        return True

    fake.instead = lie


def replay_old_manifest(fake: Fake, _: Path) -> None:
    signs(fake, fake.keys, lambda body: {**body, "sequence": 1})


def replay_old_file(fake: Fake, _: Path) -> None:
    serves(fake, lambda _: A["kml/map.kml"])


def foreign_sequence(fake: Fake, folder: Path) -> None:
    signs(fake, Keys(folder / "foreign"), lambda body: {**body, "sequence": 2**63 - 1})


def trusted_sequence(fake: Fake, _: Path) -> None:
    signs(fake, fake.keys, lambda body: {**body, "sequence": 2**63 - 1})


def trusted_epoch(fake: Fake, _: Path) -> None:
    signs(fake, fake.keys, lambda body: {**body, "epoch": 2**63 - 1})


def unsigned(fake: Fake, _: Path) -> None:
    signs(fake, fake.keys, lambda body: body, "")


def unknown_key(fake: Fake, folder: Path) -> None:
    signs(fake, Keys(folder / "unknown"), lambda body: body, "f" * 16)


def expired(fake: Fake, _: Path) -> None:
    hour_ago = datetime.now(timezone.utc) - timedelta(hours=1)
    signs(fake, fake.keys, lambda body: {**body, "expires": hour_ago.isoformat()})


def endless_file(fake: Fake, _: Path) -> None:
    serves(fake, lambda data: data * 200)


def endless_manifest(fake: Fake, _: Path) -> None:
    def lie(handler: BaseHTTPRequestHandler) -> bool:
        if "/manifest" in handler.path:
            handler.send_response(200)
            handler.end_headers()
            handler.close_connection = True
            with contextlib.suppress(OSError):
                while True:
                    handler.wfile.write(bytes(1 << 16))
        return "/manifest" in handler.path

    fake.instead = lie


def one_byte_a_second(fake: Fake, _: Path) -> None:
    trickles(fake, 1.5)


def hundred_bytes_a_second(fake: Fake, _: Path) -> None:
    trickles(fake, 100)


def cut_off(fake: Fake, _: Path) -> None:
    def lie(handler: BaseHTTPRequestHandler) -> bool:
        if "/maps/" in handler.path:
            handler.send_response(200)
            handler.send_header("content-length", "60000")
            handler.end_headers()
            handler.close_connection = True
        return "/maps/" in handler.path

    fake.instead = lie


def one_bit(fake: Fake, _: Path) -> None:
    serves(fake, lambda data: data[:777] + bytes([data[777] ^ 1]) + data[778:])


def hostile_name(fake: Fake, _: Path) -> None:
    file = {"format": "kml", "name": "../../../etc/x", "size": 1, "sha256": "0" * 64}
    signs(fake, fake.keys, lambda body: {**body, "files": [file]})


def other_environment(fake: Fake, _: Path) -> None:
    signs(fake, fake.keys, lambda body: {**body, "environment": "elsewhere"})


@pytest.mark.parametrize(
    ("attack", "word"),
    [
        (replay_old_manifest, "possible rollback"),
        (replay_old_file, "differs from the manifest"),
        (foreign_sequence, "which the server does not list"),
        (trusted_sequence, "more than 1000000000 ahead"),
        (trusted_epoch, "ahead of 0"),
        (unsigned, "no valid signature"),
        (unknown_key, "which the server does not list"),
        (expired, "manifest expired"),
        (endless_file, "differs from the manifest"),
        (endless_manifest, "exceeds"),
        (one_byte_a_second, "bytes in"),
        (hundred_bytes_a_second, "less than 4096 bytes per second"),
        (cut_off, "no response"),
        (one_bit, "differs from the manifest"),
        (hostile_name, "invalid or duplicate file path"),
        (other_environment, "belongs to environment 'elsewhere'"),
    ],
)
def test_attack_is_refused_reported_and_healed(
    fake: Fake, robot: Robot, tmp_path: Path, attack: Attack, word: str
) -> None:
    fake.move("latest", 1)
    one = robot("true", poll_seconds=0.2)
    with run(one):
        eventually(lambda: one.saw("active", version=1))
        honest = fake.instead
        attack(fake, tmp_path)
        fake.finish_requests()
        fake.put(B)
        eventually(lambda: fake.statuses[-1]["state"] == "failed" and word in fake.statuses[-1]["detail"])
        assert whole(one.into)["version"] == 1
        assert (one.into / "current" / "kml" / "map.kml").read_bytes() == A["kml/map.kml"]
        fake.instead = honest
        eventually(lambda: fake.statuses[-1]["state"] == "active" and fake.statuses[-1]["version"] == 2)
    assert whole(one.into)["version"] == 2


def test_slow_download_is_resumed(fake: Fake, robot: Robot) -> None:
    assert robot().once()
    fake.put(B)
    trickles(fake, 1000)
    one = robot()
    assert not one.once()
    (part,) = (one.into / "partial").iterdir()
    size = part.stat().st_size
    assert size > 0
    starts: list[str] = []

    def honest(handler: BaseHTTPRequestHandler) -> bool:
        if "/maps/" in handler.path:
            starts.append(handler.headers["range"])
        return False

    fake.instead = honest
    assert robot().once()
    assert starts == [f"bytes={size}-"]


# --- frozen ---


@pytest.fixture
def opened(robot: Robot) -> Iterator[One]:
    """An agent that stays the same for several polls."""
    one = robot()
    one.agent.open()
    yield one
    one.agent.close()


def test_frozen_server_is_reported(fake: Fake, opened: One, stopped: StoppedClock) -> None:
    assert opened.agent.run_once()
    data = fake.manifest("latest")
    key, signature = fake.keys.sign(data)
    header = f"{key}:{base64.b64encode(signature).decode()}"

    def frozen(handler: BaseHTTPRequestHandler) -> bool:
        if "/manifest" in handler.path:
            send(handler, 200, data, **{"fleetmap-signature": header})
        return "/manifest" in handler.path

    fake.instead = frozen
    fake.put(B)
    assert opened.agent.run_once()
    stopped.seconds += 1800
    assert opened.agent.run_once(), "as long as one may have been signed before"
    stopped.seconds += 1
    assert not opened.agent.run_once()
    assert fake.statuses[-1]["state"] == "failed"
    assert "no new signed response since" in fake.statuses[-1]["detail"]
    assert whole(opened.into)["version"] == 1
    fake.instead = lambda _: False
    assert opened.agent.run_once()
    assert (fake.statuses[-1]["state"], fake.statuses[-1]["version"]) == ("active", 2)


def test_server_behind_its_events_is_reported(fake: Fake, opened: One, stopped: StoppedClock) -> None:
    def remark() -> str:
        assert opened.agent.run_once()
        assert fake.statuses[-1]["state"] == "active", "events are not signed: they make no robot fail"
        return str(fake.statuses[-1].get("detail", ""))

    assert not remark()
    opened.agent._on_event(event(2))
    assert not remark()
    stopped.seconds += 61
    assert "sequence 2 was announced" in remark()
    fake.put(B)
    assert not remark()
    assert fake.statuses[-1]["version"] == 2
    opened.agent._on_event(event(10**17))
    opened.agent._on_event(event(9))
    stopped.seconds += 61
    assert "sequence 9" in remark(), "the other one is absurd"
    stopped.seconds += 901
    assert not remark(), "forgotten"


# --- time ---


def test_expired_map_is_refused_with_the_clock_set_back(fake: Fake, robot: Robot) -> None:
    assert robot().once()
    fake.put(B)
    old = (datetime.now(timezone.utc) - timedelta(days=1)).isoformat()
    fake.more = {"expires": old, "time": (datetime.now(timezone.utc) - timedelta(days=1, hours=1)).isoformat()}
    one = robot(clock=lambda: time.time() - 2 * 86400)
    assert not one.once()
    assert "manifest expired" in one.detail
    assert whole(one.into)["version"] == 1
    fake.more = {}
    assert robot(clock=lambda: time.time() - 2 * 86400).once()


def test_clock_set_forward_recovers_when_corrected(fake: Fake, robot: Robot) -> None:
    year = 365 * 86400
    one = robot(clock=lambda: time.time() + year)
    assert not one.once()
    assert "manifest expired" in one.detail
    assert robot().once()


def test_server_clock_that_was_ahead_blocks_no_robot(fake: Fake, robot: Robot) -> None:
    for ahead in (timedelta(hours=11), timedelta(days=400)):
        now = datetime.now(timezone.utc) + ahead
        fake.more = {"time": now.isoformat(), "expires": (now + timedelta(days=1)).isoformat()}
        fake.put(B if ahead.days else A)
        assert robot().once()
    fake.more = {}
    fake.put(A)
    one = robot()
    assert one.once(), one.lines
    assert whole(one.into)["version"] == 4


def test_unset_clock_is_replaced_by_signed_time(fake: Fake, robot: Robot) -> None:
    assert robot(clock=lambda: 1000.0).once()
    fake.put(B)
    fake.more = {"expires": (datetime.now(timezone.utc) - timedelta(hours=1)).isoformat()}
    one = robot(clock=lambda: 1000.0)
    assert not one.once()
    assert "manifest expired" in one.detail


# --- order ---


def test_epoch_comes_before_sequence(fake: Fake, robot: Robot) -> None:
    for _ in range(3):
        fake.put(A)
    assert robot().once()
    fake.more = {"epoch": 1}
    fake.put(B)
    fake.channels["latest"] = (5, 1)
    one = robot()
    assert one.once(), "a restored server starts with a lower sequence and a higher epoch"
    assert whole(one.into)["version"] == 5
    fake.more = {"epoch": 0}
    fake.put(A)
    one = robot()
    assert not one.once()
    assert "of epoch 0 is lower" in one.detail


def test_endorsed_key_resets_the_marks(fake: Fake, robot: Robot) -> None:
    assert robot().once()
    signs(fake, fake.keys, lambda body: {**body, "sequence": MAX_SEQUENCE_AHEAD})
    assert robot().once(), "one manifest of a stolen key"
    fake.instead = lambda _: False
    fake.put(B)
    assert not robot().once()
    fake.keys.rotate()
    one = robot()
    assert one.once(), one.lines
    assert whole(one.into)["version"] == 2
    assert json.loads((one.into / "state.json").read_text())["marks"]["latest"]["sequence"] == 2


def test_state_survives_restart(tmp_path: Path) -> None:
    state = AgentState("field", marks={"latest": Mark(2, 7, "0" * 64)}, working="1-abc", newest_time=12.5)
    save(tmp_path / "state.json", state)
    assert load(tmp_path / "state.json", "field") == state


# --- deltas, hooks, and other agents ---


def test_delta_that_cannot_be_decoded_falls_back_to_the_file(fake: Fake, robot: Robot) -> None:
    assert robot().once()
    fake.put(B)
    digest = hashlib.sha256(A["kml/map.kml"]).digest()

    def delta(handler: BaseHTTPRequestHandler) -> bool:
        if "dcz" not in handler.headers.get("accept-encoding", ""):
            return False
        send(handler, 200, http_client.DCZ_MAGIC + digest + b"nonsense", **{"content-encoding": "dcz"})
        return True

    fake.instead = delta
    one = robot()
    assert one.once(), one.lines
    assert whole(one.into)["version"] == 2
    switched = one.saw("switched")
    assert switched is not None
    assert "complete files" in switched["detail"]


def test_hook_printing_a_gigabyte_is_rolled_back(fake: Fake, robot: Robot) -> None:
    assert robot("true").once()
    fake.put(B)
    one = robot("test $FLEETMAP_VERSION = 1 || { head -c 1000000000 /dev/zero | tr '\\0' x; echo the end; exit 3; }")
    assert not one.once()
    assert one.detail.endswith("the end")
    assert len(fake.statuses[-1]["detail"]) <= 2000
    assert whole(one.into)["version"] == 1


def test_killed_hook_is_rolled_back(fake: Fake, robot: Robot) -> None:
    assert robot("true").once()
    fake.put(B)
    one = robot("test $FLEETMAP_VERSION = 1 || kill -9 $$")
    assert not one.once()
    assert "exited with status -9" in one.detail
    assert whole(one.into)["version"] == 1


def test_hook_steps_that_were_skipped_are_reported(fake: Fake, robot: Robot) -> None:
    skipped = '{"step": "keepout", "result": "skipped", "detail": "there is no mask server"}'
    one = robot(f"""echo '{skipped}' >> $FLEETMAP_HOOK_STATUS; echo 'not JSON' >> $FLEETMAP_HOOK_STATUS""")
    assert one.once()
    assert fake.statuses[-1]["state"] == "active"
    assert fake.statuses[-1]["detail"] == "keepout: skipped: there is no mask server"
    fake.put(B)
    assert robot("""echo '{"step": "x", "result": "done", "detail": ""}' >> $FLEETMAP_HOOK_STATUS""").once()
    assert "detail" not in fake.statuses[-1]


def test_second_agent_of_a_directory_is_refused(fake: Fake, robot: Robot) -> None:
    one = robot(poll_seconds=3600.0)
    with run(one):
        eventually(lambda: one.saw("active", version=1))
        with pytest.raises(Conflict, match="another agent uses"):
            robot().once()
        fake.put(B)
        one.agent._on_event(event(2))
        eventually(lambda: one.saw("active", version=2))
    assert robot().once(), "and afterwards it is free"


def test_many_forged_events_keep_agent_idle(fake: Fake, robot: Robot) -> None:
    one = robot(poll_seconds=3600.0)
    with run(one):
        eventually(lambda: one.saw("active", version=1))
        fake.asked.clear()
        stop = threading.Event()
        threading.Timer(1.0, stop.set).start()
        sequence = 10
        while not stop.is_set():
            sequence += 1
            one.agent._on_event(event(sequence, type="overlay.accepted"))
            time.sleep(0.001)
        assert len([path for path in fake.asked if "/manifest" in path]) < 20

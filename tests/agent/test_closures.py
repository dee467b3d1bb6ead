"""Closures reach a robot with the manifest, at once and on every channel, and leave it the same way."""

from __future__ import annotations

import base64
import json
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

import pytest

from app.agent import agent
from app.events.messages import RobotStatus
from tests.agent.conftest import whole
from tests.agent.fake import Fake, One, run, send
from tests.agent.test_bad_server import event
from tests.events.conftest import eventually

A, B = {"kml/map.kml": b"a" * 5000}, {"kml/map.kml": b"b" * 6000}

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


def map_and_closures(one: One) -> tuple[bytes, dict[str, Any]]:
    """The map's bytes and closures.json of what stands."""
    current = one.into / "current"
    whole(one.into)
    return (current / "kml" / "map.kml").read_bytes(), json.loads((current / "closures.json").read_text())


def test_closure_event_updates_installed_map(fake: Fake, robot: Robot, tmp_path: Path) -> None:
    hook = f'echo "$FLEETMAP_OVERLAYS" >> {tmp_path}/log; cp "$FLEETMAP_CLOSURES_FILE" {tmp_path}/closures'
    one = robot(hook, poll_seconds=3600.0)
    fake.move("production", 1)
    with run(one):
        eventually(lambda: one.saw("active", version=1))
        assert map_and_closures(one)[1] == {"digest": fake.digest, "closures": []}
        root, name = whole(one.into)["root"], (one.into / "current").readlink().name
        assert name == f"1-{root[:8]}"
        fake.close_edges("e7")
        one.agent._on_event(event(fake.sequence, type="overlay.accepted", overlay="x"))
        eventually(lambda: fake.statuses[-1].get("overlays") == fake.digest and fake.statuses[-1]["state"] == "active")
        data, closures = map_and_closures(one)
        assert data.endswith(b"ae7")
        assert [c["edge"] for c in closures["closures"]] == ["e7"]
        assert json.loads((tmp_path / "closures").read_text()) == closures
        assert whole(one.into)["root"] == root
        assert (one.into / "current").readlink().name == f"{name}-{fake.digest[:8]}"
        closed = fake.digest
        fake.close_edges()
        one.agent._on_event(event(fake.sequence, type="overlay.ended"))
        eventually(lambda: fake.statuses[-1]["overlays"] == fake.digest and fake.statuses[-1]["state"] == "active")
        assert map_and_closures(one)[0] == A["kml/map.kml"]
        assert (one.into / "current").readlink().name == name
        fake.asked.clear()
        for kind in ("overlay.created", "overlay.rejected", "overlay.expired"):
            one.agent._on_event(event(fake.sequence + 1, type=kind))
        time.sleep(0.3)
        assert not fake.asked, "these change nothing that is in force"
    assert (tmp_path / "log").read_text().split() == [fake.digest, closed, fake.digest]


def test_closures_without_any_changed_file_are_a_switch(fake: Fake, robot: Robot, tmp_path: Path) -> None:
    assert robot(f"echo x >> {tmp_path}/log").once()
    digest = "1" * 64
    fake.sequence += 1
    fake.channels = {"latest": (1, fake.sequence)}
    fake.more = {"overlays": [{"id": "p", "kind": "keepout", "level": "ground"}], "overlays_digest": digest}
    one = robot(f"echo $FLEETMAP_CHANGED. >> {tmp_path}/log")
    assert one.once()
    assert map_and_closures(one)[1]["digest"] == digest
    assert (tmp_path / "log").read_text().split() == ["x", "."]
    assert fake.asked[-1].endswith("formats=kml"), "no file is fetched"


def test_closures_changed_during_download_are_no_error(fake: Fake, robot: Robot) -> None:
    assert robot().once()
    fake.put(B)
    changes = 2

    def change(handler: BaseHTTPRequestHandler) -> bool:
        nonlocal changes
        if "/maps/" in handler.path and changes:
            changes -= 1
            fake.close_edges(f"e{changes}")
        return False

    fake.instead = change
    one = robot()
    assert one.once(), one.lines
    assert map_and_closures(one)[0].endswith(b"be0")
    assert not one.saw("refused")
    assert not one.saw("failed")
    assert all("closures=apply" in path for path in fake.asked if "/maps/" in path)


def test_file_removed_with_its_closure_is_no_error(fake: Fake, robot: Robot) -> None:
    fake.versions[0] = {**A, "kml/mask.kml": b"m" * 100}

    def change(handler: BaseHTTPRequestHandler) -> bool:
        if "mask.kml" in handler.path and "kml/mask.kml" in fake.versions[0]:
            fake.versions[0] = A
            fake.close_edges()
            handler.send_error(404)
            return True
        return False

    fake.instead = change
    one = robot()
    assert one.once(), one.lines
    assert [f["name"] for f in whole(one.into)["files"]] == ["map.kml"]


def test_closures_that_never_agree_are_an_error(fake: Fake, robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(agent, "CLOSURES_SECONDS", 0.001)
    assert robot().once()
    fake.put(B)
    request_count = 0

    def change(handler: BaseHTTPRequestHandler) -> bool:
        nonlocal request_count
        if "/maps/" in handler.path:
            request_count += 1
            fake.close_edges(f"e{request_count}")
        return False

    fake.instead = change
    one = robot()
    assert not one.once()
    assert "have changed since its manifest" in one.detail
    assert request_count <= 2 * (agent.MAX_CLOSURE_CHANGES + 1)
    assert whole(one.into)["version"] == 1
    fake.instead = lambda _: False
    assert robot().once()


def test_planned_version_is_fetched_with_closures(fake: Fake, robot: Robot) -> None:
    fake.close_edges("e7")
    fake.move("production", 1)
    fake.put(B)
    fake.planned["production"] = {"version": 2}
    one = robot()
    assert one.once()
    assert any("/versions/2/manifest" in path and "closures=apply" in path for path in fake.asked)
    one = robot(poll_seconds=0.1)
    with run(one):
        eventually(lambda: one.saw("ready", version=2))
        fake.close_edges("e8")
        eventually(lambda: whole(one.into)["overlays_digest"] == fake.digest)
        fake.asked.clear()
        eventually(lambda: len(fake.asked) > 4)
    fake.planned.clear()
    fake.move("production", 2)
    fake.asked.clear()
    one = robot()
    assert one.once()
    assert map_and_closures(one)[0].endswith(b"be8")
    assert not [path for path in fake.asked if "/maps/" in path], "it was fetched before, with the new closure"


def test_server_without_closures_gets_no_new_parameters(fake: Fake, robot: Robot) -> None:
    fake.closures = None
    fake.move("production", 1)
    fake.put(B)
    fake.planned["production"] = {"version": 2}
    one = robot()
    assert one.once()
    assert map_and_closures(one)[1] == {"digest": "", "closures": []}
    assert not [path for path in fake.asked if "closures" in path]
    assert not [status for status in fake.statuses if "overlays" in status]
    fake.close_edges()
    assert robot("exit 1").once() is True, "a server that begins to apply closures changes no map"


def test_before_switch_runs_for_closures(fake: Fake, robot: Robot) -> None:
    assert robot().once()
    fake.close_edges("e7")
    one = robot(before_switch=("grep -q e7 $FLEETMAP_CLOSURES_FILE && exit 75",))
    assert not one.once()
    assert fake.statuses[-1]["state"] == "ready"
    assert map_and_closures(one)[0] == A["kml/map.kml"]


@pytest.mark.parametrize(
    "members",
    [
        {"overlays": [7], "overlays_digest": "0" * 64},
        {"overlays": [{}], "overlays_digest": "0" * 64},
        {"overlays": [{"id": "x"}], "overlays_digest": None},
        {"overlays_digest": "x"},
        {"overlays": 7},
    ],
)
def test_invalid_closures_are_refused(fake: Fake, robot: Robot, members: dict[str, Any]) -> None:
    assert robot().once()
    fake.put(B)
    fake.more = members
    one = robot()
    assert not one.once()
    assert "invalid manifest" in one.detail
    assert whole(one.into)["version"] == 1


def test_status_carries_the_digest() -> None:
    body = {"channel": "latest", "version": 1, "root": "0" * 64, "state": "active", "overlays": "1" * 64}
    status = RobotStatus.from_dict(body)
    assert status.overlays == "1" * 64
    assert status.as_dict() == body


@pytest.mark.parametrize("ref", ["latest", "2"])
@pytest.mark.parametrize(
    ("members", "text"),
    [
        ({"closures": "ignore"}, "closures=ignore instead of closures=apply"),
        ({"closures": "mark"}, "closures=mark instead of closures=apply"),
        ({"parameters": {"kml": {"level": "L2"}}}, "'level': 'L2'"),
        ({"parameters": {}}, "'crs': 'local'"),
        ({"missing": []}, "optional formats osm are missing without a reason"),
        ({"closures": 7}, "invalid manifest"),
    ],
)
def test_manifest_of_another_request_is_refused(
    fake: Fake, robot: Robot, members: dict[str, Any], text: str, ref: str
) -> None:
    fake.more = {"parameters": {"kml": {"crs": "local"}}, "missing": [{"format": "osm", "detail": "no network"}]}
    more = {"formats": ("kml?crs=local",), "optional": ("osm",)}
    assert robot(**more).once()
    fake.put(B)
    honest, fake.more = fake.more, fake.more | members
    if ref == "2":
        fake.move("production", 1)
        fake.move("production", 1)
        fake.plan("production", 2)
        more["channel"] = "production"
        fake.more, lie = honest, fake.more

        def change(handler: BaseHTTPRequestHandler) -> bool:
            fake.more = lie if "/versions/2/manifest" in handler.path else honest
            return False

        fake.instead = change
    one = robot(**more)
    assert not one.once()
    assert text in one.detail
    assert whole(one.into)["version"] == 1
    assert (fake.statuses[-1]["state"], fake.statuses[-1]["version"]) == ("failed", 1 if ref == "latest" else 2)
    fake.more, fake.instead = honest, lambda _: False
    assert robot(**more).once()


def test_request_is_not_checked_if_the_server_applies_no_closures(fake: Fake, robot: Robot) -> None:
    fake.closures = None
    assert robot(formats=("kml?crs=local",), optional=("osm",)).once()


def test_other_closures_under_one_sequence_are_refused(fake: Fake, robot: Robot) -> None:
    fake.close_edges("e7")
    assert robot().once()
    fake.closures = []
    one = robot()
    assert not one.once()
    assert "under the same sequence" in one.detail
    assert map_and_closures(one)[0].endswith(b"ae7")
    fake.close_edges()
    assert robot().once()


def test_first_digest_under_one_sequence_is_accepted(fake: Fake, robot: Robot) -> None:
    assert robot().once()
    path = robot().into / "state.json"
    state = json.loads(path.read_text())
    assert state["marks"]["latest"].pop("overlays_digest") == fake.digest
    path.write_text(json.dumps(state))
    fake.more = {"extra": 1}
    assert robot().once()
    assert json.loads(path.read_text())["marks"]["latest"]["overlays_digest"] == fake.digest


def closed(one: One) -> list[str]:
    """Edges that are closed in what the robot drives by."""
    return [closure["edge"] for closure in map_and_closures(one)[1]["closures"]]


def test_closure_reaches_a_robot_whose_hook_fails_for_the_newer_version(
    fake: Fake, robot: Robot, tmp_path: Path
) -> None:
    hook = f"test $FLEETMAP_VERSION = 1 && cp $FLEETMAP_CURRENT/kml/map.kml {tmp_path}/taken"
    assert robot(hook).once()
    fake.put(B)
    assert not robot(hook).once()
    fake.close_edges("e7")
    one = robot(hook)
    assert not one.once()
    assert (closed(one), whole(one.into)["version"]) == (["e7"], 1)
    assert (tmp_path / "taken").read_bytes().endswith(b"ae7")
    state = json.loads((one.into / "state.json").read_text())
    assert state["working"] == state["activated"] == (one.into / "current").readlink().name
    last = fake.statuses[-1]
    assert (last["state"], last["version"], last["overlays"]) == ("failed", 2, fake.digest)
    assert "sequence" not in last, "that of the closure would say that the robot has acted on the move to 2"
    assert last["holds"]["version"] == 1
    fake.asked.clear()
    assert not robot(hook).once()
    assert not [path for path in fake.asked if "/versions/1/" in path], "once for each change"
    fake.close_edges()
    one = robot(hook)
    assert not one.once()
    assert closed(one) == []
    assert robot().once()
    assert whole(one.into)["version"] == 2


@pytest.mark.parametrize("status", ["75", "1"])
def test_closure_reaches_a_robot_that_waits_or_refused(fake: Fake, robot: Robot, status: str) -> None:
    assert robot().once()
    fake.put(B)
    one = robot("true", before_switch=(f"test $FLEETMAP_VERSION = 1 || exit {status}",), poll_seconds=0.2)
    with run(one):
        eventually(lambda: fake.statuses[-1]["version"] == 2)
        fake.close_edges("e7")
        eventually(lambda: fake.statuses[-1].get("overlays") == fake.digest)
        assert (closed(one), whole(one.into)["version"]) == (["e7"], 1)
        assert one.agent._activation.is_waiting() == (status == "75")
        fake.close_edges()
        eventually(lambda: fake.statuses[-1].get("overlays") == fake.digest)
        assert closed(one) == []


@pytest.mark.parametrize("status", ["75", "1"])
def test_replayed_manifest_opens_no_closed_edge(fake: Fake, robot: Robot, status: str) -> None:
    """A robot that cannot have the channel's version yet takes closures only from a manifest that has the newest."""
    assert robot().once()
    old = fake.manifest("1", "formats=kml&closures=apply")
    old_file, old_digest = fake.file("kml/map.kml", 1), fake.digest
    key, signature = fake.keys.sign(old)
    signed = f"{key}:{base64.b64encode(signature).decode()}"
    fake.put(B)
    fake.close_edges("e7")
    hook = {"before_switch": (f"test $FLEETMAP_VERSION = 1 || exit {status}",)}
    one = robot(**hook)
    assert not one.once()
    assert closed(one) == ["e7"]

    def replay(handler: BaseHTTPRequestHandler) -> bool:
        if handler.path.partition("?")[0].endswith("/versions/1/manifest"):
            send(handler, 200, old, **{"fleetmap-signature": signed})
        elif "/versions/1/maps/" in handler.path:
            send(handler, 200, old_file, **{"fleetmap-overlays": old_digest})
        else:
            return False
        return True

    fake.instead = replay
    fake.close_edges("e7", "e8")
    one = robot(**hook)
    assert not one.once()
    assert closed(one) == ["e7"]
    assert "an old manifest was replayed" in fake.statuses[-1]["detail"]
    assert one.saw("failed", detail=one.agent._closures_problem), one.lines
    fake.instead = lambda _: False
    one = robot(**hook)
    assert not one.once()
    assert closed(one) == ["e7", "e8"]
    assert "replayed" not in fake.statuses[-1]["detail"]


def test_closure_that_cannot_be_loaded_is_retried_with_backoff(fake: Fake, robot: Robot, tmp_path: Path) -> None:
    assert robot().once()
    fake.put(B)
    loads = "test $FLEETMAP_VERSION = 1 && ! grep -q e7 $FLEETMAP_CLOSURES_FILE"
    hook = f"cat $FLEETMAP_CLOSURES_FILE >> {tmp_path}/log; {loads}"
    one = robot(hook, poll_seconds=0.2)
    one.agent._retries._first = lambda: 1000.0
    one.agent._retries._longest = 1000.0
    with run(one):
        eventually(lambda: one.saw("failed"))
        fake.close_edges("e7")
        eventually(lambda: (tmp_path / "log").read_text().count("e7") >= 2)
        time.sleep(1.5)
    assert closed(one) == []
    assert (tmp_path / "log").read_text().count('"id": "e7"') == 2, "version 2 and version 1, once each"


def test_closures_changed_during_preload_are_no_failure(
    fake: Fake, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(agent, "CLOSURES_SECONDS", 0.01)
    fake.move("production", 1)
    assert robot().once()
    fake.put(B)
    fake.planned["production"] = {"version": 2}
    changes = 3

    def change(handler: BaseHTTPRequestHandler) -> bool:
        nonlocal changes
        if "/versions/2/maps/" in handler.path and changes:
            changes -= 1
            fake.close_edges(f"e{changes}")
        return False

    fake.instead = change
    fake.statuses.clear()
    assert robot().once()
    assert changes == 0
    assert [(s["state"], s["version"]) for s in fake.statuses] == [("active", 1), ("ready", 2)]

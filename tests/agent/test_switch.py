"""Switching: ``--before-switch``, hooks, and rollback if a map cannot be loaded."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

import pytest

from app.agent import activation, agent
from tests.agent.conftest import ROOT, whole
from tests.agent.fake import PLACE, Fake, One, run, send
from tests.events.conftest import eventually

A, B, C = ({"kml/map.kml": letter * 5000} for letter in (b"a", b"b", b"c"))

Robot = Callable[..., One]


@pytest.fixture
def robot(fake: Fake, tmp_path: Path) -> Robot:
    """A new agent of one directory, as after a restart."""
    return lambda *on_change, **more: One(fake, tmp_path / "robot", *on_change, **more)


@pytest.fixture(autouse=True)
def _short_pauses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(agent, "FIRST_PAUSE_SECONDS", 0.05)
    monkeypatch.setattr(agent, "BEFORE_SWITCH_SECONDS", 0.05)


def exits(path: Path) -> str:
    """A command that logs the version and ends with the status in a file."""
    return f'echo "$FLEETMAP_VERSION" >> {path}.log; exit $(cat {path})'


def calls(path: Path) -> list[str]:
    log = path.with_name(path.name + ".log")
    return log.read_text().split() if log.exists() else []


def loads(taken: Path) -> str:
    """A hook that loads each map but those with b."""
    return f"cd $FLEETMAP_CURRENT/kml; grep -q b map.kml && {{ echo 'no b'; exit 3; }}; cp map.kml {taken}"


def unavailable(request: BaseHTTPRequestHandler) -> bool:
    """Answer each request of an agent with 503."""
    send(request, 503, b"")
    return True


def state(one: One) -> dict[str, Any]:
    body: dict[str, Any] = json.loads((one.into / "state.json").read_text())
    return body


# --- before ---


def test_before_switch_delays_until_it_agrees(fake: Fake, robot: Robot, tmp_path: Path) -> None:
    status = tmp_path / "status"
    status.write_text("0")
    assert robot(before_switch=(exits(status),)).once(), "the first map is a switch, too"
    assert calls(status) == ["1"]
    status.write_text("75")
    fake.put(B)
    one = robot(f"touch {tmp_path}/hook", before_switch=(exits(status),), poll_seconds=3600.0)
    with run(one):
        eventually(lambda: calls(status).count("2") >= 3)
        assert whole(one.into)["version"] == 1
        manifest_paths = [path for path in fake.asked if "/manifest" in path]
        eventually(lambda: fake.statuses[-1]["state"] == "ready")
        assert fake.statuses[-1]["version"] == 2
        assert fake.statuses[-1]["sequence"] == 1, "of what it drives by"
        since = next(x for x in one.lines if x["event"] == "ready")["detail"]
        assert "has been ready since 20" in since
        count = len(fake.statuses)
        eventually(lambda: calls(status).count("2") >= 6)
        assert len(fake.statuses) == count, "each refusal is not another status"
        assert [path for path in fake.asked if "/manifest" in path] == manifest_paths, (
            "the server is not asked each time"
        )
        status.write_text("0")
        eventually(lambda: one.saw("active", version=2))
        eventually(lambda: fake.statuses[-1]["state"] == "active")
    assert whole(one.into)["version"] == 2
    assert (tmp_path / "hook").exists()


def test_before_switch_sees_both_maps(fake: Fake, robot: Robot, tmp_path: Path) -> None:
    compares = f"cat $FLEETMAP_CURRENT/kml/map.kml $FLEETMAP_NEXT/kml/map.kml > {tmp_path}/both; "
    compares += f'echo "$FLEETMAP_CHANGED $FLEETMAP_LAYERS" > {tmp_path}/changed'
    assert robot().once()
    fake.put(B)
    assert robot(before_switch=(compares,)).once()
    assert (tmp_path / "both").read_bytes() == A["kml/map.kml"] + B["kml/map.kml"]
    assert (tmp_path / "changed").read_text() == "kml/map.kml topology\n"


def test_newer_map_replaces_pending_one(fake: Fake, robot: Robot, tmp_path: Path) -> None:
    assert robot().once()
    fake.put(B)
    (tmp_path / "status").write_text("75")
    one = robot(before_switch=(exits(tmp_path / "status"),), poll_seconds=0.3)
    with run(one):
        eventually(lambda: one.saw("ready", version=2))
        fake.put(C)
        eventually(lambda: one.saw("ready", version=3))
        fake.move("latest", 1)
        eventually(lambda: one.saw("active", version=1))
        count = len(calls(tmp_path / "status"))
        time.sleep(0.3)
        assert len(calls(tmp_path / "status")) == count, "nothing waits any more"
        fake.move("latest", 3)
        (tmp_path / "status").write_text("0")
        eventually(lambda: one.saw("active", version=3))


@pytest.mark.parametrize(
    ("command", "word"), [("echo no; exit 7", "exited with status 7: no"), ("sleep 60", "exceeded 0.2")]
)
def test_before_switch_refuses_a_version(
    fake: Fake, robot: Robot, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, command: str, word: str
) -> None:
    monkeypatch.setattr(activation, "BEFORE_SWITCH_LIMIT_SECONDS", 0.2)
    assert robot().once()
    fake.put(B)
    refuses = f"echo x >> {tmp_path}/log; [ $FLEETMAP_VERSION != 2 ] || {{ {command}; }}"
    one = robot(before_switch=(refuses,), poll_seconds=3600.0)
    monkeypatch.setattr(agent, "FIRST_PAUSE_SECONDS", 600.0)
    with run(one):
        eventually(lambda: fake.statuses[-1]["state"] == "failed")
        assert word in fake.statuses[-1]["detail"]
        assert fake.statuses[-1]["version"] == 2
        assert whole(one.into)["version"] == 1
        one.agent._wake.set()
        time.sleep(0.3)
        assert (tmp_path / "log").read_text().split() == ["x"], "the same version is not asked for again at once"
        monkeypatch.setattr(activation, "BEFORE_SWITCH_LIMIT_SECONDS", 60.0)  # a busy machine takes its time
        fake.put(C)
        one.agent._wake.set()
        eventually(lambda: one.saw("active", version=3))


def test_once_ends_while_before_switch_delays(fake: Fake, robot: Robot) -> None:
    one = robot(before_switch=("exit 75",))
    assert not one.once()
    assert fake.statuses[-1]["state"] == "ready"
    assert not (one.into / "current").exists()


# --- after ---


def test_failed_hook_restores_last_working_version(fake: Fake, robot: Robot, tmp_path: Path) -> None:
    taken = tmp_path / "taken"
    assert robot(loads(taken)).once()
    fake.put(B)
    one = robot(loads(taken))
    assert not one.once()
    assert whole(one.into)["version"] == 1
    assert taken.read_bytes() == A["kml/map.kml"]
    last = fake.statuses[-1]
    assert (last["state"], last["version"], last["sequence"]) == ("failed", 2, 1)
    assert "no b" in last["detail"]
    assert not any(s["state"] == "active" and s["version"] == 2 for s in fake.statuses)
    assert state(one)["activated"] == state(one)["working"] == (one.into / "current").readlink().name
    fake.put(C)
    again = robot(loads(taken))
    assert again.once(), again.lines
    assert whole(one.into)["version"] == 3
    assert taken.read_bytes() == C["kml/map.kml"]


def test_failed_hook_is_retried_with_backoff(fake: Fake, robot: Robot, tmp_path: Path) -> None:
    assert robot("true").once()
    fake.put(B)
    log = f"echo $FLEETMAP_VERSION >> {tmp_path}/log"
    one = robot(f"{log}; test $FLEETMAP_VERSION = 1 || test -e {tmp_path}/mended", poll_seconds=3600.0)
    with run(one):
        eventually(lambda: (tmp_path / "log").exists() and len((tmp_path / "log").read_text().split()) >= 6)
        for _ in range(20):
            one.agent._wake.set()  # forged events are no reason to try at once
            time.sleep(0.02)
        assert len((tmp_path / "log").read_text().split()) < 16
        assert whole(one.into)["version"] in (1, 2)
        (tmp_path / "mended").touch()
        eventually(lambda: one.saw("active", version=2), 60)
    assert whole(one.into)["version"] == 2


def test_first_version_stays_if_its_hook_fails(fake: Fake, robot: Robot) -> None:
    one = robot("exit 1")
    assert not one.once()
    assert whole(one.into)["version"] == 1
    assert (fake.statuses[-1]["state"], fake.statuses[-1]["version"]) == ("failed", 1)
    assert state(one)["working"] is None
    assert robot("true").once()


def test_previous_version_is_kept_for_rollback(fake: Fake, robot: Robot) -> None:
    assert robot("true").once()
    for number in range(5):
        fake.put({"kml/map.kml": bytes([number]) * 4000})
        assert not robot("test $FLEETMAP_VERSION = 1").once()
        assert whole(robot().into)["version"] == 1


def test_hook_failing_for_both_versions_is_reported(fake: Fake, robot: Robot, tmp_path: Path) -> None:
    assert robot("true").once()
    fake.put(B)
    one = robot(f"test -e {tmp_path}/mended")
    assert not one.once()
    assert "version 1 could not be loaded again either" in one.detail
    assert whole(one.into)["version"] == 1
    assert state(one)["activated"] is None
    fake.move("latest", 1)
    (tmp_path / "mended").touch()
    again = robot(f"test -e {tmp_path}/mended")
    assert again.once()
    assert again.saw("hook", version=1), "what the robot has loaded is unknown: it loads again"


def test_planned_version_is_fetched_when_current_one_fails(fake: Fake, robot: Robot) -> None:
    fake.move("production", 1)
    assert robot("true").once()
    fake.put(B)
    fake.put(C)
    fake.move("production", 2)
    fake.planned["production"] = {"version": 3}
    one = robot("test $FLEETMAP_VERSION != 2", poll_seconds=0.1)
    with run(one):
        eventually(lambda: fake.statuses[-1]["state"] == "ready")
        ready = fake.statuses[-1]
        assert ready["version"] == 3
        assert "version 2" in ready["detail"]
        assert any(s["state"] == "failed" and s["version"] == 2 for s in fake.statuses)
        time.sleep(0.5)
        assert fake.statuses[-1] == ready
        fake.planned.clear()
        fake.move("production", 3)
        eventually(lambda: fake.statuses[-1]["state"] == "active")
    assert whole(one.into)["version"] == 3


def test_planned_version_is_fetched_when_manifest_is_unavailable(fake: Fake, robot: Robot) -> None:
    fake.move("production", 1)
    assert robot().once()
    fake.put(B)
    fake.planned["production"] = {"version": 2}
    fake.instead = lambda h: "/production/manifest" in h.path and (h.send_error(409) or True)
    one = robot()
    assert not one.once()
    assert [s["state"] for s in fake.statuses][-2:] == ["failed", "ready"]
    assert fake.statuses[-1]["version"] == 2


def test_interrupted_hooks_run_without_server(fake: Fake, robot: Robot, tmp_path: Path) -> None:
    assert robot("true").once()
    path = robot().into / "state.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "activated": None}))
    fake.instead = unavailable
    one = robot(f"touch {tmp_path}/loaded")
    assert not one.once()
    assert (tmp_path / "loaded").exists()
    assert one.saw("active", version=1)


def test_hooks_run_again_after_a_boot(
    fake: Fake, robot: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The programs that they told have started anew, also without a server."""
    hook = f'echo "$FLEETMAP_CHANGED" >> {tmp_path}/loaded'
    boot = tmp_path / "boot_id"
    monkeypatch.setattr("app.agent.state.BOOT_ID", boot)
    assert robot(hook).once()  # this system has no such file
    for content in "aa":
        boot.write_text(content)
        assert robot(hook).once()
    assert (tmp_path / "loaded").read_text().splitlines() == ["kml/map.kml"]
    fake.instead = unavailable
    for content in "bb":
        boot.write_text(content)
        assert not robot(hook).once()
    assert (tmp_path / "loaded").read_text().splitlines() == ["kml/map.kml"] * 2


def test_state_of_an_older_agent_is_read(fake: Fake, robot: Robot, tmp_path: Path) -> None:
    one = robot("true")
    assert one.once()
    new = state(one)
    old = {
        **new,
        "form": 1,
        "marks": {c: {"sequence": m["sequence"], "root": m["root"]} for c, m in new["marks"].items()},
    }
    for name in ("working", "newest_time"):
        del old[name]
    (one.into / "state.json").write_text(json.dumps(old))
    fake.put(B)
    assert not robot("test $FLEETMAP_VERSION = 1").once()
    assert whole(one.into)["version"] == 1, "the version that ran is the one to go back to"
    assert state(one)["form"] == 2


def put_dangerous_variable(one: One) -> Path:
    """Make the installed map one of an older agent, whose list had not this variable. Return its folder."""
    version = (one.into / "current").resolve()
    body = json.loads((version / "manifest.json").read_text())
    (version / "manifest.json").write_text(json.dumps({**body, "variables": {"ROS_DOMAIN_ID": "7", "FIELD_ID": "p1"}}))
    (version / "environment.sh").write_text("export ROS_DOMAIN_ID=7\nexport FIELD_ID=p1\n")
    return version


def test_installed_map_with_dangerous_variable_is_held(fake: Fake, robot: Robot, tmp_path: Path) -> None:
    taken = tmp_path / "taken"
    assert robot(loads(taken)).once()
    version = put_dangerous_variable(robot())
    fake.put(B)
    fake.instead = unavailable
    assert not robot(loads(taken)).once()
    text = (version / "environment.sh").read_text()
    assert "ROS_DOMAIN_ID" not in text, "cleaned at the start, also without a server"
    assert "export FIELD_ID=p1\n" in text
    fake.instead = lambda _: False
    one = robot(loads(taken))
    assert not one.once()
    assert "version 1 is restored" in one.detail
    assert (one.into / "current").resolve() == version
    assert taken.read_bytes() == A["kml/map.kml"]


def test_dangerous_variable_of_an_earlier_map_is_left_out_after_rollback(
    fake: Fake, robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert robot("true").once()
    version = put_dangerous_variable(robot())
    fake.put(B)
    with monkeypatch.context() as patch:
        patch.setattr(activation.Activation, "load", lambda _: activation.ACTIVE)  # power goes before the hooks run
        robot("true").once()
    (version / "environment.sh").write_text("export ROS_DOMAIN_ID=7\n")
    one = robot("test $FLEETMAP_VERSION = 1")
    assert not one.once()
    assert (one.into / "current").resolve() == version
    assert "ROS_DOMAIN_ID" not in (version / "environment.sh").read_text()


def test_rewritten_descriptions_leave_the_order_of_versions(fake: Fake, robot: Robot) -> None:
    """Which versions are kept depends on when each was last used. An old one that cannot be read does not matter."""
    for content in (A, B, C):
        fake.put(content)
        assert robot("true").once()
    folder = robot().agent._folder
    names = [name.split("-")[0] for name in folder._names()]
    for path in folder.versions.glob("*/environment.sh"):
        path.write_text("old\n")
    for k, name in enumerate(folder._names()):
        os.utime(folder.versions / name, (1000 - k, 1000 - k))
    folder.refresh()
    assert [name.split("-")[0] for name in folder._names()] == names
    assert len(names) > 1
    assert {path.read_text() for path in folder.versions.glob("*/environment.sh")}.isdisjoint({"old\n"})
    unreadable = folder.versions / folder._names()[-1] / "environment.sh"
    unreadable.unlink()
    unreadable.mkdir()
    assert robot("true").once()


def test_kill_at_random_moments_of_hooks_ends_consistently(fake: Fake, tmp_path: Path) -> None:
    into, taken, dice = tmp_path / "robot", tmp_path / "taken", random.Random(3)
    hook = f"sleep 0.1; {loads(taken)}; sleep 0.1"
    arguments = ["agent", "-s", fake.url, "-e", PLACE, "-f", "kml", "--into", str(into), "--poll", "3600", "--json"]
    arguments += ["--before-switch", "sleep 0.1", "--on-change", hook]
    command = [sys.executable, "-m", "app.cli", *arguments]
    variables = {"PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT)}
    assert One(fake, into, hook).once()
    fake.put(B)
    for _ in range(6):
        process = subprocess.Popen(command, env=variables, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        assert process.stdout is not None
        assert process.stdout.readline(), "it has begun"
        time.sleep(dice.uniform(0.2, 1.5))
        process.send_signal(signal.SIGKILL)
        process.wait(10)
        process.stdout.close()
        assert whole(into)["version"] in (1, 2)
        one = One(fake, into, hook)
        assert not one.once()
        assert whole(into)["version"] == 1
        assert taken.read_bytes() == A["kml/map.kml"], "the robot drives by what current says"
    fake.put(C)
    assert One(fake, into, hook).once()
    assert taken.read_bytes() == C["kml/map.kml"]


@pytest.mark.parametrize(("status", "reported"), [(409, "failed"), (404, "failed"), (503, "downloading")])
def test_unavailable_planned_version_is_reported_once(fake: Fake, robot: Robot, status: int, reported: str) -> None:
    fake.move("production", 1)
    assert robot().once()
    fake.put(B)
    fake.plan("production", 2)
    detail = b'{"detail": "no kml of this version"}'
    fake.instead = lambda h: "/versions/2/manifest" in h.path and (send(h, status, detail) or True)
    fake.statuses.clear()
    one = robot(poll_seconds=0.05)
    with run(one):
        eventually(lambda: sum("/versions/2/manifest" in path for path in fake.asked) >= 4)
        states = [(s["state"], s["version"], s["root"]) for s in fake.statuses]
        assert states == [("active", 1, fake.root(1)), (reported, 2, fake.root(2))]
        assert "no kml of this version" in fake.statuses[-1]["detail"]
        fake.instead = lambda _: False
        eventually(lambda: fake.statuses[-1]["state"] == "ready")


def test_server_that_is_busy_during_a_preload_is_no_failure_of_the_version(fake: Fake, robot: Robot) -> None:
    fake.move("production", 1)
    assert robot().once()
    fake.put(B)
    fake.plan("production", 2)
    fake.instead = lambda h: "/versions/2/maps/" in h.path and (send(h, 500, b"{}") or True)
    assert not robot().once()
    last = fake.statuses[-1]
    assert (last["state"], last["version"]) == ("downloading", 2)
    assert "returned status 500" in last["detail"]

"""Bad luck: a cut line, kill -9 at random moments, a server and a router that go and come back."""

from __future__ import annotations

import json
import random
import signal
import socket
import time
from pathlib import Path

import pytest
import zenoh

from app.events.bus import BusOptions, router_configuration
from app.events.router import Router
from tests.agent.conftest import ROOT, Gate, Robot, Start, network, whole
from tests.api.conftest import ADMIN, Api, running, settings_for
from tests.cli.conftest import ServerProcess
from tests.events.conftest import client_config, eventually
from tests.ports import free_port


def test_interrupted_download_is_resumed(api: Api, place: str, robot: Start, gate: Gate) -> None:
    whole_size = len(api.get(f"/maps/{place}/tmap2/network.tmap2.yaml").content)
    gate.cut = whole_size // 2
    one = robot("--once", server=gate.url)
    assert one.end() == 1
    (part,) = (one.into / "partial").iterdir()
    got = part.stat().st_size
    assert 0 < got <= gate.cut
    gate.cut = None
    gate.requests.clear()
    again = robot("--once", server=gate.url)
    assert again.end() == 0, again.lines
    ((sent, size),) = [(sent, size) for _, path, sent, size in gate.requests if "/maps/" in path]
    assert sent["range"] == f"bytes={got}-"
    assert size == whole_size - got
    assert again.file() == api.get(f"/maps/{place}/tmap2/network.tmap2.yaml").content


def test_partial_download_of_other_content_is_discarded(api: Api, place: str, robot: Start, gate: Gate) -> None:
    gate.cut = 5000
    one = robot("--once", server=gate.url)
    assert one.end() == 1
    (part,) = (one.into / "partial").iterdir()
    part.write_bytes(b"y" * 4000)
    gate.cut = None
    again = robot("--once", server=gate.url)
    assert again.end() == 0, again.lines
    assert whole(one.into)["version"] == 1


def test_kill_at_random_moments_never_leaves_half_a_map(
    api: Api, place: str, robot: Start, gate: Gate, tmp_path: Path
) -> None:
    dice = random.Random(7)
    gate.deltas = False
    gate.slow = 0.015  # a second for the network
    hook = f"sleep 0.2; cp $FLEETMAP_CURRENT/manifest.json {tmp_path}/hooked"
    one = robot("--once", "--on-change", hook, server=gate.url)
    assert one.end() == 0
    seen = [1]
    middle = 0
    for turn in range(10):
        api.upload(place, {"n.tmap2.yaml": network(turn + 1)})
        one = robot("--poll", "3600", "--on-change", hook, server=gate.url)
        one.wait("downloading")
        time.sleep(dice.uniform(0, 1.5))
        one.kill()
        seen.append(whole(one.into)["version"])
        middle += any(path.suffix == ".part" for path in (one.into / "partial").iterdir())
        json.loads((one.into / "state.json").read_text())
    assert seen == sorted(seen), "never back"
    assert middle, "no kill came in the middle of a download"
    last = robot("--once", "--on-change", hook, server=gate.url)
    assert last.end() == 0
    assert last.standing["version"] == 11
    assert last.standing["root"] == api.get(f"environments/{place}").json()["root"]
    assert json.loads((tmp_path / "hooked").read_text())["version"] == 11, "the hook ran for what stands"
    assert list((last.into / "partial").iterdir()) == []


def test_interrupted_hook_runs_after_restart(api: Api, place: str, robot: Start, tmp_path: Path) -> None:
    one = robot("--poll", "3600", "--on-change", f"touch {tmp_path}/begun; sleep 30")
    eventually((tmp_path / "begun").exists)
    one.kill()
    assert whole(one.into)["version"] == 1
    assert robot("--once", "--on-change", f"touch {tmp_path}/again").end() == 0
    assert (tmp_path / "again").exists()
    assert robot("--once", "--on-change", f"touch {tmp_path}/third").end() == 0
    assert not (tmp_path / "third").exists()


def test_forged_events_cost_little_and_change_nothing(
    api: Api, place: str, robot: Start, gate: Gate, port: int, tmp_path: Path
) -> None:
    one = robot("--poll", "3600", "--on-change", f"echo $FLEETMAP_LAYERS >> {tmp_path}/layers", server=gate.url)
    one.wait("connected")
    one.wait("active", version=1)
    gate.requests.clear()
    root = one.standing["root"]
    session = zenoh.open(client_config(port))
    try:
        forged = {"type": "version.created", "environment": place, "version": 99, "root": "f" * 64, "layers": 7}
        for number in range(400):
            session.put(f"fleetmap/{place}/events", json.dumps({**forged, "sequence": 1000 + number}).encode())
            session.put(f"fleetmap/{place}/events", b"[" * 1000)
            more = {"channel": {"x": 1}, "previous": {"root": root}, "sequence": 2000 + number}
            session.put(f"fleetmap/{place}/events", json.dumps({**forged, **more}).encode())
            more = {"channel": None, "previous": {"root": root}, "sequence": 3}
            session.put(f"fleetmap/{place}/events", json.dumps({**forged, **more}).encode())
            time.sleep(0.01)
    finally:
        session.close()  # type: ignore[no-untyped-call]
    manifest_paths = [path for _, path, _, _ in gate.requests if "/manifest" in path]
    assert len(manifest_paths) < 30, len(manifest_paths)
    assert one.standing["version"] == 1
    api.upload(place, {"n.tmap2.yaml": network(1)})
    one.wait("active", version=2)
    one.wait("hook", version=2)
    assert (tmp_path / "layers").read_text().split() == ["topology", "topology"]
    assert one.stop() == 0


def test_sigterm_stops_agent_during_download(place: str, robot: Start, gate: Gate) -> None:
    gate.slow = 0.2
    one = robot("--poll", "3600", server=gate.url)
    one.wait("downloading")
    time.sleep(0.3)
    begun = time.monotonic()
    assert one.stop() == 0
    assert time.monotonic() - begun < 60


@pytest.fixture
def line() -> tuple[int, int]:
    """Ports for a server and a router."""
    return free_port(), free_port()


def test_agent_survives_killed_server(line: tuple[int, int], tmp_path: Path) -> None:
    port, zenoh = line
    variables = {
        "FLEETMAP_ADMIN_TOKEN": ADMIN,
        "FLEETMAP_ZENOH_MODE": "router",
        "FLEETMAP_ZENOH_LISTEN": f"tcp/127.0.0.1:{zenoh}",
    }

    def serve() -> tuple[ServerProcess, Api]:
        with socket.socket() as probe:  # the port is free again
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            eventually(lambda: _binds(probe, port))
        started = ServerProcess(
            "--port", str(port), "--data-dir", str(tmp_path / "data"), environment=variables, folder=ROOT
        )
        return started, Api(started.ready(), None)  # type: ignore[arg-type]

    process, api = serve()
    one = None
    try:
        api.post("environments", {"name": "farm"})
        api.upload("farm", {"n.tmap2.yaml": network()})
        one = Robot(api.url, "farm", tmp_path / "robot", "--poll", "2")
        one.wait("active", version=1)
        one.wait("connected")
        api.upload("farm", {"n.tmap2.yaml": network(1)})
        process.stop(signal.SIGKILL)
        api.close()
        assert whole(one.into)["version"] >= 1
        process, api = serve()
        one.wait("active", version=2)
        count = len(one.lines)
        eventually(lambda: api.get("/readyz").json()["events"]["state"] == "connected")
        api.upload("farm", {"n.tmap2.yaml": network(9)})
        one.wait("active", after=count, version=3)
        assert one.stop() == 0
    finally:
        if one is not None:
            one.kill()
        api.close()
        process.stop()


def _binds(probe: socket.socket, port: int) -> bool:
    try:
        probe.bind(("127.0.0.1", port))
    except OSError:
        return False
    return True


def test_agent_survives_killed_router(line: tuple[int, int], tmp_path: Path) -> None:
    zenoh = line[1]
    options = BusOptions(listen=f"tcp/127.0.0.1:{zenoh}")
    router = Router(router_configuration(options))
    assert router.problem is None
    settings = settings_for(
        tmp_path / "data",
        zenoh_mode="client",
        zenoh_connect=f"tcp/127.0.0.1:{zenoh}",
        zenoh_advertise=f"tcp/0.0.0.0:{zenoh}",
    )
    (tmp_path / "data").mkdir()
    one = None
    try:
        with running(settings) as api:
            eventually(lambda: api.get("/readyz").json()["events"]["state"] == "connected")
            assert api.get("/readyz").json()["events"]["connect"] == f"tcp/127.0.0.1:{zenoh}"
            api.post("environments", {"name": "farm"})
            api.upload("farm", {"n.tmap2.yaml": network()})
            one = Robot(api.url, "farm", tmp_path / "robot", "--poll", "3600")
            one.wait("active", version=1)
            one.wait("connected")
            router._process.kill()
            router.close()
            api.upload("farm", {"n.tmap2.yaml": network(1)})
            time.sleep(2)
            router = Router(router_configuration(options))
            assert router.problem is None
            one.wait("active", version=2)
            eventually(lambda: api.get("/readyz").json()["events"]["state"] == "connected")
            api.upload("farm", {"n.tmap2.yaml": network(2)})
            one.wait("active", version=3)
            assert one.stop() == 0
    finally:
        if one is not None:
            one.kill()
        router.close()

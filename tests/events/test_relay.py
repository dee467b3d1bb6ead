"""What is committed is told over Zenoh: all of it, in order, also to who comes late or was cut off."""

from __future__ import annotations

import json
import logging
import os
import signal
from pathlib import Path

import pytest
import zenoh

from app.errors import Invalid
from app.events.bus import Bus, BusOptions, router_configuration
from app.events.messages import Event, RobotStatus
from app.events.router import Router
from tests.api import samples
from tests.api.conftest import Api, running, settings_for
from tests.events.conftest import Listener, client_config, eventually, free_port, nothing


def network(k: int) -> bytes:
    """One of many networks."""
    return samples.tmap2({"a": (0.0, float(k)), "b": (5.0, 1.0)}, (("a", "b"),))


def test_a_commit_is_told(api: Api, session: zenoh.Session) -> None:
    ear = Listener(session, "fleetmap/*/events")
    api.post("environments", {"name": "farm"})
    made = api.upload("farm", {"datum.yaml": samples.DATUM}, message="measured").json()
    ear.wait(lambda e: len(e.sequences()) >= 2)
    told = next(e for e in ear.events if e["type"] == "version.created")
    assert (told["environment"], told["version"], told["root"]) == ("farm", 1, made["root"])
    assert told["message"] == "measured"
    assert told["layers"][0]["layer"] == "location"
    event = Event.from_json(json.dumps(told))
    assert event.sequence == told["sequence"]
    api("PUT", "environments/farm/channels/production", 200, json={"version": 1})
    ear.wait(lambda e: any(x["type"] == "channel.moved" for x in e.events))
    assert ear.sequences() == [1, 2, 3]


def test_late_joiners_get_history(api: Api, session: zenoh.Session) -> None:
    api.post("environments", {"name": "late"})
    for k in range(5):
        api.upload("late", {"n.tmap2.yaml": network(k)})
    first = Listener(session, "fleetmap/late/events")
    first.wait(lambda e: len(e.sequences()) == 6)
    assert first.sequences() == [1, 2, 3, 4, 5, 6]


def test_a_killed_router_comes_back_and_nothing_is_lost(api: Api, session: zenoh.Session, tmp_path: Path) -> None:
    ear = Listener(session, "fleetmap/rough/events")
    api.post("environments", {"name": "rough"})
    ear.wait(lambda e: e.sequences() == [1])
    os.kill(router_of(api), signal.SIGKILL)
    for k in range(4):
        api.upload("rough", {"n.tmap2.yaml": network(k)})
    ear.wait(lambda e: e.sequences() == [1, 2, 3, 4, 5], 30)
    assert eventually(lambda: api.get("/readyz").json()["events"]["state"] == "connected")


def router_of(api: Api) -> int:
    """The router's process."""
    import subprocess

    found = subprocess.run(["pgrep", "-P", str(os.getpid()), "-f", "app.events.router"], capture_output=True, text=True)
    return int(found.stdout.split()[-1])


def test_a_restarted_server_tells_what_it_had_not_told(tmp_path: Path, port: int) -> None:
    with running(settings_for(tmp_path, zenoh_mode="off")) as api:
        api.post("environments", {"name": "quiet"})
        assert api.get("/readyz").json()["events"] == {"state": "off"}
    settings = settings_for(tmp_path, zenoh_mode="router", zenoh_listen=f"tcp/127.0.0.1:{port}")
    for expected in (1, 2):
        with running(settings) as api:
            eventually(lambda api=api: api.get("/readyz").json()["events"]["state"] == "connected")
            session = zenoh.open(client_config(port))
            try:
                ear = Listener(session, "fleetmap/quiet/events")
                ear.wait(lambda e, n=expected: e.sequences() == list(range(1, n + 1)))
                api.upload("quiet", {"n.tmap2.yaml": network(expected)})
                ear.wait(lambda e, n=expected: e.sequences() == list(range(1, n + 2)))
            finally:
                session.close()  # type: ignore[no-untyped-call]


def test_a_taken_port_is_told_and_maps_are_served(tmp_path: Path) -> None:
    import socket

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        where = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        with running(settings_for(tmp_path, zenoh_mode="router", zenoh_listen=where)) as api:
            events = eventually(lambda: (e := api.get("/readyz").json()["events"])["state"] == "down" and e)
            assert where in events["detail"]
            assert "/root" not in events["detail"], "nor other places of whoever built Zenoh"
            assert ".rs" not in events["detail"]
            api.post("environments", {"name": "deaf"})
            assert api.upload("deaf", {"n.tmap2.yaml": samples.tmap2()}).status_code == 201


def test_a_taken_port_is_not_tried_all_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each try is a process."""
    import socket

    started: list[Router] = []

    def counted(configuration: str) -> Router:
        started.append(Router(configuration))
        return started[-1]

    monkeypatch.setattr("app.events.bus.Router", counted)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        options = BusOptions(listen=f"tcp/127.0.0.1:{taken.getsockname()[1]}")
        bus = Bus(options, ask=nothing, explain=nothing, on_status=nothing, on_alive=nothing)
        for _ in range(5):
            assert not bus.tend()
        assert len(started) == 1
    try:
        eventually(bus.tend)
    finally:
        bus.close()


def test_a_router_of_the_operators(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Mode client: the router is somebody else's, and comes later than the server."""
    caplog.set_level(logging.INFO, "app.events.single")
    port = free_port()
    where = f"tcp/127.0.0.1:{port}"
    with running(settings_for(tmp_path, zenoh_mode="client", zenoh_connect=where)) as api:
        api.post("environments", {"name": "patient"})
        eventually(lambda: api.get("/readyz").json()["events"]["state"] == "down", 30)
        router = Router(router_configuration(BusOptions(listen=where)))
        assert router.problem is None
        try:
            eventually(lambda: api.get("/readyz").json()["events"]["state"] == "connected", 30)
            session = zenoh.open(client_config(port))
            try:
                Listener(session, "fleetmap/patient/events").wait(lambda e: e.sequences() == [1])
            finally:
                session.close()  # type: ignore[no-untyped-call]
            assert f"events go out over Zenoh at {where}" in caplog.text
        finally:
            router.close()
        gone = eventually(lambda: (e := api.get("/readyz").json()["events"])["state"] == "down" and e, 30)
        assert gone["detail"] == f"the router at {where} is gone: it is looked for"


@pytest.mark.parametrize(
    ("payload", "word"),
    [
        (b"", "JSON"), (b"[]", "JSON"), (b"{}", "channel"), (b"[" * 100_000, "bytes"), (b"[" * 9_000, "JSON"),
        (b'{"channel": "production", "version": true, "root": "", "state": "happy"}', "state"),
    ],
)  # fmt: skip
def test_statuses_are_checked(payload: bytes, word: str) -> None:
    with pytest.raises(Invalid, match=word):
        RobotStatus.from_json(payload)


def test_a_status_comes_through() -> None:
    said = {"channel": "production", "version": 3, "root": "0" * 64, "state": "active", "sequence": 7}
    assert RobotStatus.from_json(json.dumps(said)).as_dict() == said

"""Relay: every commit is published over Zenoh in order, also to late and reconnected subscribers."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import threading
from pathlib import Path
from typing import Any, ClassVar

import pytest
import zenoh

from app.backends.lead import LocalLeads
from app.errors import Invalid, Unavailable
from app.events.bus import Bus, BusOptions, router_configuration
from app.events.messages import Event, RobotStatus
from app.events.relay import Relay, relay_state
from app.events.router import Router
from app.store.store import Store
from tests.api import samples
from tests.api.conftest import Api, running, settings_for
from tests.events.conftest import Listener, client_config, eventually, nothing
from tests.ports import free_port


def network(k: int) -> bytes:
    """One of many networks."""
    return samples.tmap2({"a": (0.0, float(k)), "b": (5.0, 1.0)}, (("a", "b"),))


def test_commit_publishes_event(api: Api, session: zenoh.Session) -> None:
    listener = Listener(session, "fleetmap/*/events")
    api.post("environments", {"name": "farm"})
    version = api.upload("farm", {"datum.yaml": samples.DATUM}, message="measured").json()
    listener.wait(lambda e: len(e.sequences()) >= 2)
    created_event = next(e for e in listener.events if e["type"] == "version.created")
    assert (created_event["environment"], created_event["version"], created_event["root"]) == (
        "farm",
        1,
        version["root"],
    )
    assert created_event["message"] == "measured"
    assert created_event["layers"][0]["layer"] == "location"
    event = Event.from_json(json.dumps(created_event))
    assert event.sequence == created_event["sequence"]
    api("PUT", "environments/farm/channels/production", 200, json={"version": 1})
    listener.wait(lambda e: any(x["type"] == "channel.moved" for x in e.events))
    assert listener.sequences() == [1, 2, 3]


def test_late_joiners_get_history(api: Api, session: zenoh.Session) -> None:
    api.post("environments", {"name": "late"})
    for k in range(5):
        api.upload("late", {"n.tmap2.yaml": network(k)})
    # Who joins in the very milliseconds in which Zenoh first learns of a publisher may miss its first samples.
    services = api.app.state.services
    eventually(lambda: services.store.events.relay_position() == services.store.events.last_position())
    first = Listener(session, "fleetmap/late/events")
    first.wait(lambda e: len(e.sequences()) == 6)
    assert first.sequences() == [1, 2, 3, 4, 5, 6]


def test_killed_router_is_restarted_without_loss(api: Api, session: zenoh.Session, tmp_path: Path) -> None:
    listener = Listener(session, "fleetmap/rough/events")
    api.post("environments", {"name": "rough"})
    listener.wait(lambda e: e.sequences() == [1])
    os.kill(router_of(api), signal.SIGKILL)
    for k in range(4):
        api.upload("rough", {"n.tmap2.yaml": network(k)})
    listener.wait(lambda e: e.sequences() == [1, 2, 3, 4, 5], 30)
    assert eventually(lambda: api.get("/readyz").json()["events"]["state"] == "connected")


def router_of(api: Api) -> int:
    """The router's process."""
    import subprocess

    process = subprocess.run(
        ["pgrep", "-P", str(os.getpid()), "-f", "app.events.router"], capture_output=True, text=True
    )
    return int(process.stdout.split()[-1])


def test_restarted_server_publishes_pending_events(tmp_path: Path, port: int) -> None:
    with running(settings_for(tmp_path, zenoh_mode="off")) as api:
        api.post("environments", {"name": "quiet"})
        assert api.get("/readyz").json()["events"] == {"state": "off"}
    settings = settings_for(tmp_path, zenoh_mode="router", zenoh_listen=f"tcp/127.0.0.1:{port}")
    for expected in (1, 2):
        with running(settings) as api:
            eventually(lambda api=api: api.get("/readyz").json()["events"]["state"] == "connected")
            session = zenoh.open(client_config(port))
            try:
                listener = Listener(session, "fleetmap/quiet/events")
                listener.wait(lambda e, n=expected: e.sequences() == list(range(1, n + 1)))
                api.upload("quiet", {"n.tmap2.yaml": network(expected)})
                listener.wait(lambda e, n=expected: e.sequences() == list(range(1, n + 2)))
            finally:
                session.close()  # type: ignore[no-untyped-call]


def test_server_reports_taken_router_port_and_serves_maps(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        with running(settings_for(tmp_path, zenoh_mode="router", zenoh_listen=endpoint)) as api:
            events = eventually(lambda: (e := api.get("/readyz").json()["events"])["state"] == "down" and e)
            assert endpoint in events["detail"]
            assert "/root" not in events["detail"], "nor other places of whoever built Zenoh"
            assert ".rs" not in events["detail"]
            api.post("environments", {"name": "deaf"})
            assert api.upload("deaf", {"n.tmap2.yaml": samples.tmap2()}).status_code == 201


def test_router_start_backs_off_when_port_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each try is a process."""
    started: list[Router] = []

    def counted(configuration: str) -> Router:
        started.append(Router(configuration))
        return started[-1]

    monkeypatch.setattr("app.events.bus.Router", counted)
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        options = BusOptions(listen=f"tcp/127.0.0.1:{taken.getsockname()[1]}")
        bus = Bus(options, query_handler=nothing, explain=nothing, on_status=nothing, on_alive=nothing)
        for _ in range(5):
            assert not bus.ensure_connected()
        assert len(started) == 1
    try:
        eventually(bus.ensure_connected)
    finally:
        bus.close()


def test_relay_uses_external_router(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Mode client: the router is somebody else's, and comes later than the server."""
    port = free_port()
    endpoint = f"tcp/127.0.0.1:{port}"
    with running(settings_for(tmp_path, zenoh_mode="client", zenoh_connect=endpoint, log_level="info")) as api:
        api.post("environments", {"name": "patient"})
        eventually(lambda: api.get("/readyz").json()["events"]["state"] == "down")
        router = Router(router_configuration(BusOptions(listen=endpoint)))
        assert router.problem is None
        try:
            eventually(lambda: api.get("/readyz").json()["events"]["state"] == "connected")
            session = zenoh.open(client_config(port))
            try:
                Listener(session, "fleetmap/patient/events").wait(lambda e: e.sequences() == [1])
            finally:
                session.close()  # type: ignore[no-untyped-call]
            assert f"event relay: connected to Zenoh at {endpoint}" in caplog.text
        finally:
            router.close()
        bus_state = eventually(lambda: (e := api.get("/readyz").json()["events"])["state"] == "down" and e)
        assert bus_state["detail"] == f"lost the connection to the router at {endpoint}: reconnecting"


@pytest.mark.parametrize(
    ("payload", "word"),
    [
        (b"", "JSON"), (b"[]", "JSON"), (b"{}", "channel"), (b"[" * 100_000, "bytes"), (b"[" * 9_000, "JSON"),
        (b'{"channel": "production", "version": true, "root": "", "state": "happy"}', "state"),
        (b'{"holds": 1}', "holds"), (b'{"holds": {"version": 1, "root": "x"}}', "holds"),
        (b'{"holds": {"version": true, "root": "' + b"0" * 64 + b'"}}', "holds"),
    ],
)  # fmt: skip
def test_statuses_are_checked(payload: bytes, word: str) -> None:
    with pytest.raises(Invalid, match=word):
        RobotStatus.from_json(payload)


def test_status_over_zenoh_is_stored() -> None:
    status = {"channel": "production", "version": 3, "root": "0" * 64, "state": "active", "sequence": 7}
    assert RobotStatus.from_json(json.dumps(status)).as_dict() == status
    more = status | {"state": "failed", "detail": "no room", "holds": {"version": 2, "root": "a" * 64}}
    assert RobotStatus.from_json(json.dumps(more)).as_dict() == more


class Deaf:
    """A bus that is always there."""

    relay, history, title, opened, connected = "zenoh", 256, "nowhere", 1, True
    state: ClassVar = {"state": "connected"}

    def __init__(self) -> None:
        self.put: list[int] = []
        self.environments: list[str] = []
        self.closed = 0

    def ensure_connected(self) -> bool:
        return True

    def publish(self, environment: str, body: Any) -> None:
        self.put.append(body["sequence"])
        self.environments.append(environment)

    def close_publishers(self) -> None:
        self.closed += 1

    def flush(self) -> None:
        """Everything is accepted."""

    def close(self) -> None:
        """Nothing is open."""


def test_relay_notices_that_another_server_has_led_for_a_moment(tmp_path: Path) -> None:
    """It publishes nothing that it read before, and the history again: late joiners ask its publishers alone."""
    store = Store(f"sqlite:///{tmp_path / 'store.sqlite'}", tmp_path / "blobs")
    store.migrate()
    for name in "abcd":
        store.environments.create(name)
    leads = LocalLeads(tmp_path)
    bus, lead = Deaf(), leads.lead("events")
    publish = bus.publish

    def publish_and_lose_the_lead(environment: str, body: Any) -> None:
        publish(environment, body)
        if bus.environments == ["a", "b"]:
            lead.release()
            other = threading.Thread(target=store.events.set_relayed, args=(store.events.last_position(),))
            other.start()
            other.join()
            assert lead.try_acquire()

    bus.publish = publish_and_lose_the_lead  # type: ignore[method-assign]
    relay = Relay(store, bus, tmp_path, leads)  # type: ignore[arg-type]
    relay.start()
    try:
        eventually(lambda: len(bus.environments) == 6)
        assert bus.environments[:2] == ["a", "b"]
        assert sorted(bus.environments[2:]) == ["a", "b", "c", "d"], "the history, which the other one published"
        assert bus.closed == 1, "late joiners get nothing from publishers of an earlier term"
        bus.environments.clear()
        lead.release()
        assert lead.try_acquire()
        eventually(lambda: len(bus.environments) == 4)
        assert bus.closed == 2
    finally:
        relay.close()
        store.close()


def test_database_outage_is_logged_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("app.events.leader.POLL_SECONDS", 0.01)
    store = Store(f"sqlite:///{tmp_path / 'store.sqlite'}", tmp_path / "blobs")
    store.migrate()
    store.environments.create("farm")
    relayed, reads = store.events.relay_position, []

    def away(*args: Any, **more: Any) -> int:
        reads.append(1)
        if len(reads) < 20:
            raise Unavailable("the database is away")
        return relayed(*args, **more)

    monkeypatch.setattr(store.events, "relay_position", away)
    bus = Deaf()
    relay = Relay(store, bus, tmp_path, LocalLeads(tmp_path))  # type: ignore[arg-type]
    relay.start()
    try:
        eventually(lambda: relay_state(tmp_path, "router") == {"state": "connected", "leader": True})
        assert set(bus.put) == {1}, "perhaps twice: as new, and as history"
        assert caplog.text.count("event relay: down: the database is away") == 1
    finally:
        relay.close()
        store.close()


def test_router_logs_do_not_block_it(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    """Zenoh logs to standard output, which is a pipe that is read once."""
    monkeypatch.setenv("RUST_LOG", "zenoh=trace")
    port = free_port()
    router = Router(router_configuration(BusOptions(listen=f"tcp/127.0.0.1:{port}")))
    try:
        assert router.problem is None
        monkeypatch.delenv("RUST_LOG")
        received: list[bytes] = []
        with zenoh.open(client_config(port)) as receiver, zenoh.open(client_config(port)) as sender:
            subscriber = receiver.declare_subscriber("some/**", lambda sample: received.append(bytes(sample.payload)))
            eventually(lambda: sender.put("some/key", b"first") or received)
            for _ in range(200):
                sender.put("some/key", b"more", congestion_control=zenoh.CongestionControl.BLOCK)
            eventually(lambda: received.count(b"more") == 200)
            subscriber.undeclare()  # type: ignore[no-untyped-call]
    finally:
        router.close()
    assert len(capfd.readouterr().err) > 2**16, "more than a pipe holds"


def test_idle_connections_do_not_block_others() -> None:
    port = free_port()
    router = Router(router_configuration(BusOptions(listen=f"tcp/127.0.0.1:{port}")))
    assert router.problem is None
    with contextlib.ExitStack() as silent:
        silent.callback(router.close)
        for _ in range(150):
            silent.enter_context(socket.create_connection(("127.0.0.1", port)))
        more = {"connect/timeout_ms": 5000, "connect/exit_on_failure": True}
        with zenoh.open(client_config(port, **more)) as session:
            assert list(session.info.routers_zid())


def test_router_drops_only_huge_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.events.bus.MESSAGE_BYTES", 2**20)
    port = free_port()
    router = Router(router_configuration(BusOptions(listen=f"tcp/127.0.0.1:{port}", max_reply_bytes=2**19)))
    assert router.problem is None
    received: list[int] = []
    with contextlib.ExitStack() as stack:
        stack.callback(router.close)
        receiver, sender = (stack.enter_context(zenoh.open(client_config(port))) for _ in range(2))
        subscriber = receiver.declare_subscriber("some/**", lambda sample: received.append(len(sample.payload)))
        eventually(lambda: sender.put("some/key", b"1") or received)
        for size in (2**19, 2**22, 2):
            sender.put("some/key", bytes(size), congestion_control=zenoh.CongestionControl.BLOCK)
        eventually(lambda: received[-1] == 2)
        assert [size for size in received if size != 1] == [2**19, 2]
        subscriber.undeclare()  # type: ignore[no-untyped-call]


def test_router_dying_at_start_is_restarted(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[Router] = []

    def failing_once(configuration: str) -> Router:
        started.append(Router("no configuration" if len(started) == 1 else configuration))
        return started[-1]

    monkeypatch.setattr("app.events.bus.Router", failing_once)
    options = BusOptions(mode="router", listen=f"tcp/127.0.0.1:{free_port()}")
    bus = Bus(options, query_handler=nothing, explain=nothing, on_status=nothing, on_alive=nothing)
    try:
        eventually(bus.ensure_connected)
        started[0]._process.kill()
        started[0]._process.wait()
        assert not bus.ensure_connected()
        assert started[1].problem is not None
        eventually(bus.ensure_connected)
        assert len(started) == 3
    finally:
        bus.close()

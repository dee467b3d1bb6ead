"""A router with TLS, users and access control: who comes in, who hears, who may say what."""

from __future__ import annotations

import contextlib
import json
import socket
import stat
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh
from zenoh import ext

from app.agent.zenoh_client import ZenohClient
from app.cli.server import check
from app.errors import Invalid, Unavailable
from app.events.bus import Bus, BusOptions, router_configuration, session_configuration
from app.events.bus import check as check_bus
from app.events.credentials import ZenohCredentials, describe_connection_failure
from app.events.router import Router
from app.events.security import RouterSecurity, access_control, read_users
from app.main import check_bus as check_settings
from tests.api import samples
from tests.api.conftest import Api, running, settings_for
from tests.certificates import Authority
from tests.events.conftest import Listener, client_config, eventually, nothing, status_payload
from tests.events.test_fleet import robot_of
from tests.events.test_ros2 import GRID, STRING, Heard, grid_of, tokens
from tests.ports import free_port

REFUSED_SECONDS = 1.0
"""A client that is refused tries so long: Zenoh does not tell it why, it goes on trying."""


# --- who comes in ---------------------------------------------------------------------------------------------------
def session_to(port: int, login: ZenohCredentials, *, scheme: str = "tls", patience: float = 10.0) -> zenoh.Session:
    """A robot's session; ZError where it is not let in."""
    more = {
        "connect/endpoints": [f"{scheme}/127.0.0.1:{port}"],
        "connect/timeout_ms": int(patience * 1000),
        "connect/exit_on_failure": True,
        "listen/endpoints": [],
        **login.values(),
    }
    return zenoh.open(client_config(port, **more))


def refused(port: int, login: ZenohCredentials, scheme: str = "tls") -> None:
    with pytest.raises(zenoh.ZError), session_to(port, login, scheme=scheme, patience=REFUSED_SECONDS):
        pass


@pytest.fixture(scope="module")
def authority(tmp_path_factory: pytest.TempPathFactory) -> Authority:
    return Authority(tmp_path_factory.mktemp("certificates"))


@pytest.fixture(scope="module")
def port() -> int:
    return free_port()


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory, authority: Authority, port: int) -> Iterator[Api]:
    """A server whose router shows a certificate and knows two robots."""
    folder = tmp_path_factory.mktemp("secure")
    users = folder / "users"
    users.write_text("# the fleet\nr1:word one\n\nr2:word:two\n")
    certificate, key = authority.sign("server")
    settings = settings_for(
        folder / "data",
        zenoh_mode="router",
        zenoh_listen=f"tls/127.0.0.1:{port}",
        zenoh_certificate=certificate,
        zenoh_key=key,
        zenoh_ca=authority.pem,
        zenoh_users=users,
        ros2_environments="farm=/",
    )
    check(settings)
    check_settings(settings)
    with running(settings) as api:
        eventually(lambda: api.get("/readyz").json()["events"]["state"] == "connected")
        eventually(lambda: api.get("/readyz").json()["ros2"]["state"] == "connected")
        api.post("environments", {"name": "farm"})
        api.upload("farm", samples.grid())
        yield api


@pytest.fixture
def r1(api: Api, port: int, authority: Authority) -> Iterator[zenoh.Session]:
    with session_to(port, ZenohCredentials(authority.pem, user="r1", password="word one")) as session:
        yield session


@pytest.fixture
def r2(api: Api, port: int, authority: Authority) -> Iterator[zenoh.Session]:
    with session_to(port, ZenohCredentials(authority.pem, user="r2", password="word:two")) as session:
        yield session


def test_robot_may_subscribe_query_and_publish_its_status(api: Api, r1: zenoh.Session) -> None:
    listener = Listener(r1, "fleetmap/farm/events")
    listener.wait(lambda e: e.sequences() == [1, 2])  # history comes over keys of its own
    api.upload("farm", {"network.tmap2.yaml": samples.tmap2()})
    listener.wait(lambda e: e.sequences() == [1, 2, 3])
    reply = next(iter(r1.get("fleetmap/farm/1/version", timeout=60.0)))
    assert reply.ok is not None
    assert json.loads(bytes(reply.ok.payload))["version"] == 1
    reply = next(iter(r1.get("fleetmap/server/where?lat=53.2686;lon=-0.5245", timeout=60.0)))
    assert reply.ok is not None
    assert json.loads(bytes(reply.ok.payload)) == api.get("environments?contains=53.2686,-0.5245").json() == []
    alive = r1.liveliness().get("fleetmap/server", timeout=60.0)
    assert [str(one.ok.key_expr) for one in alive if one.ok] == ["fleetmap/server"]
    token = r1.liveliness().declare_token("fleetmap/robots/r1")
    r1.put("fleetmap/farm/robots/r1/status", status_payload(1))
    assert eventually(lambda: (r := robot_of(api, "r1")) and r["online"] and r["version"] == 1)
    assert robot_of(api, "r1")["vouched"], "the router lets in nobody but its users"
    token.undeclare()  # type: ignore[no-untyped-call]
    grid = grid_of(Heard(r1, f"0/map/{GRID}").wait())
    assert grid["cells"].shape == (6, 8)
    assert grid_of(Heard(r1, "map", recovery=False).wait())["cells"].shape == (6, 8)
    for key in ("@ros2_lv/0/*/*/*/NN/**", "@ros2_lv/0/*/*/*/MP/**", "@/*/@ros2_lv/MP/**"):
        assert tokens(r1, key), key


def test_robot_may_publish_nothing_but_its_status(api: Api, r1: zenoh.Session, r2: zenoh.Session) -> None:
    events, topics = Listener(r2, "fleetmap/*/events"), Heard(r2, f"0/map/{GRID}")
    everything: list[tuple[str, zenoh.SampleKind, bytes]] = []
    r2.declare_subscriber("**", lambda s: everything.append((str(s.key_expr), s.kind, bytes(s.payload))))
    topics.wait()
    events.wait(lambda e: 2 in e.sequences())
    for key in ("fleetmap/farm/events", f"0/map/{GRID}", "map", "anything", "fleetmap/farm/1/version"):
        r1.put(key, b'{"sequence": 9999}')
        r1.delete(key)
    r1.put("fleetmap/farm/robots/r2/status", status_payload(66))
    r1.put("fleetmap/nowhere/robots/r1/status/more", status_payload(66))
    for key in ("**", "fleetmap/**", "fleetmap/*/events", "fleetmap/farm/e$*", "fleetmap/**/robots/r1/status", "@/**"):
        r1.put(key, b'{"sequence": 9999}')
    advanced = ext.declare_advanced_publisher(
        r1,
        "fleetmap/farm/events",
        cache=ext.CacheConfig(10),
        publisher_detection=True,
        sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.1),
    )
    advanced.put(b'{"sequence": 9999}')
    names = ("fleetmap/robots/r2", "fleetmap/robots/*", "fleetmap/server", "fleetmap/**", "@ros2_lv/0/x")
    shown = [r1.liveliness().declare_token(key) for key in (*names, "fleetmap/farm/events/@adv/pub/1/1/_")]
    answered = ("fleetmap/farm/1/version", "fleetmap/**", "**", "fleetmap/farm/events/@adv/**")
    forged = [r1.declare_queryable(key, lambda query: query.reply(query.key_expr, b"forged")) for key in answered]
    r1.put("fleetmap/farm/robots/r1/status", status_payload(2))  # what was said before was taken or dropped before
    eventually(lambda: (r := robot_of(api, "r1")) and r["version"] == 2)
    version = api.upload("farm", {"network.tmap2.yaml": samples.tmap2(edges=(("gate", "barn"),))}).json()
    events.wait(lambda e: e.events[-1]["version"] == version["version"])
    eventually(lambda: any("topological_map_2" in key for key, _, _ in everything))
    assert [event["sequence"] for event in events.events] == list(range(1, len(events.events) + 1))
    assert len(topics.samples) == 1
    received = [(key, kind, payload) for key, kind, payload in everything if key != "fleetmap/farm/robots/r1/status"]
    network = {f"0/topological_map_2/{STRING}", "topological_map_2"}
    assert {"fleetmap/farm/events"} < {key for key, _, _ in received} <= {"fleetmap/farm/events", *network}
    assert all(kind == zenoh.SampleKind.PUT for _, kind, _ in received)
    assert not [payload for _, _, payload in received if payload in (b'{"sequence": 9999}', status_payload(66))]
    assert robot_of(api, "r2") is None
    for key, expected in (("fleetmap/robots/*", []), ("fleetmap/server", ["fleetmap/server"])):
        replies = r2.liveliness().get(key, timeout=60.0)
        assert [str(reply.ok.key_expr) for reply in replies if reply.ok] == expected
    answers = [bytes(reply.ok.payload) for reply in r2.get("fleetmap/farm/1/version", timeout=60.0) if reply.ok]
    assert len(answers) == 1
    assert json.loads(answers[0])["version"] == 1
    late = Listener(r2, "fleetmap/farm/events")
    late.wait(lambda e: len(e.events) == len(events.events))
    assert 9999 not in late.sequences()
    for declaration in (*shown, *forged, advanced):
        declaration.undeclare()  # type: ignore[no-untyped-call]


def test_unknown_users_are_rejected(api: Api, port: int, authority: Authority, tmp_path: Path) -> None:
    ca = authority.pem
    refused(port, ZenohCredentials(ca, user="r1", password="word two"))
    refused(port, ZenohCredentials(ca, user="stranger", password="word one"))
    refused(port, ZenohCredentials(ca, user="server", password="server"))
    refused(port, ZenohCredentials(ca))
    refused(
        port, ZenohCredentials(Authority(tmp_path).pem, user="r1", password="word one")
    )  # the robot does not believe it
    refused(port, ZenohCredentials(user="r1", password="word one"), "tcp")


def test_generated_security_files_are_private(api: Api) -> None:
    folder = api.app.state.services.options.data_dir
    for name in ("zenoh-password", "zenoh-users"):
        assert stat.S_IMODE((folder / name).stat().st_mode) == 0o600
    password = (folder / "zenoh-password").read_text()
    assert len(password) > 40
    assert f"server:{password}\n" in (folder / "zenoh-users").read_text()
    assert not [p for p in folder.iterdir() if p.name.startswith("zenoh-users.")]
    assert password not in api.get("/readyz").text


class Wire:
    """A link between a robot and the router, with somebody who listens to it."""

    def __init__(self, port: int) -> None:
        self.received = bytearray()
        self._to = port
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._server.getsockname()[1]
        self._threads = [threading.Thread(target=self._accept, daemon=True)]
        self._threads[0].start()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                near, _ = self._server.accept()
                far = socket.create_connection(("127.0.0.1", self._to))
                for a, b in ((near, far), (far, near)):
                    self._threads.append(threading.Thread(target=self._pass, args=(a, b), daemon=True))
                    self._threads[-1].start()

    def _pass(self, a: socket.socket, b: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := a.recv(2**16):
                self.received += data
                b.sendall(data)
        for end in (a, b):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)
            end.close()

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        for thread in self._threads:
            thread.join(60)


def test_tls_hides_passwords_and_messages(api: Api, port: int, authority: Authority) -> None:
    wire = Wire(port)
    try:
        with session_to(wire.port, ZenohCredentials(authority.pem, user="r1", password="word one")) as session:
            listener = Listener(session, "fleetmap/farm/events")
            listener.wait(lambda e: 2 in e.sequences())
            session.put("fleetmap/farm/robots/r1/status", status_payload(3))
            eventually(lambda: (r := robot_of(api, "r1")) and r["version"] == 3)
    finally:
        wire.close()
    assert len(wire.received) > 2000
    for word in (b"fleetmap", b"version.created", b"word one", b"robots/r1"):  # long enough not to come by chance
        assert word not in wire.received


def test_mtls_requires_robot_certificate(authority: Authority, tmp_path: Path) -> None:
    """Without users: what a certificate opens is everything."""
    port = free_port()
    certificate, key = authority.sign("mutual")
    settings = settings_for(
        tmp_path / "data",
        zenoh_mode="router",
        zenoh_listen=f"tls/127.0.0.1:{port}",
        zenoh_certificate=certificate,
        zenoh_key=key,
        zenoh_ca=authority.pem,
        zenoh_mtls=True,
    )
    with running(settings) as api:
        eventually(lambda: api.get("/readyz").json()["events"]["state"] == "connected")
        api.post("environments", {"name": "farm"})
        refused(port, ZenohCredentials(authority.pem))
        refused(port, ZenohCredentials(authority.pem, *Authority(tmp_path / "others", "ca").sign("robot")))
        with session_to(port, ZenohCredentials(authority.pem, *authority.sign("robot"))) as session:
            Listener(session, "fleetmap/farm/events").wait(lambda e: e.sequences() == [1])


def test_server_logs_in_at_external_router(authority: Authority, tmp_path: Path) -> None:
    port = free_port()
    endpoint = f"tls/127.0.0.1:{port}"
    certificate, key = authority.sign("router")
    (tmp_path / "users").write_text("maps:of all\nr1:one\n")
    theirs = RouterSecurity(
        ZenohCredentials(authority.pem, certificate, key), users=tmp_path / "users", folder=tmp_path
    )
    config = json.loads(router_configuration(BusOptions(listen=endpoint, security=theirs)))
    config["access_control"]["enabled"] = False  # their rules know their users
    router = Router(json.dumps(config))
    assert router.problem is None
    try:
        settings: dict[str, Any] = {"zenoh_mode": "client", "zenoh_connect": endpoint, "zenoh_ca": authority.pem}
        with running(settings_for(tmp_path / "a", **settings, zenoh_user="maps", zenoh_password="of all")) as api:
            eventually(lambda: api.get("/readyz").json()["events"]["state"] == "connected")
            api.post("environments", {"name": "farm"})
            with session_to(port, ZenohCredentials(authority.pem, user="r1", password="one")) as session:
                Listener(session, "fleetmap/farm/events").wait(lambda e: e.sequences() == [1])
        wrong = BusOptions(
            mode="client",
            connect=endpoint,
            security=RouterSecurity(ZenohCredentials(authority.pem, user="maps", password="of none")),
        )
        quick = json.loads(session_configuration(wrong))
        quick["connect"]["timeout_ms"] = int(REFUSED_SECONDS * 1000)
        with pytest.raises(zenoh.ZError), zenoh.open(zenoh.Config.from_json5(json.dumps(quick))):
            pass
    finally:
        router.close()


@pytest.mark.parametrize(
    ("days", "foreign", "reason"),
    [(-1, False, "certificate has expired"), (2, True, "unable to get local issuer certificate")],
)
def test_untrusted_certificate_is_explained(
    authority: Authority, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, days: int, foreign: bool, reason: str
) -> None:
    monkeypatch.setattr("app.events.bus.CONNECT_SECONDS", REFUSED_SECONDS)
    port = free_port()
    endpoint = f"tls/127.0.0.1:{port}"
    certificate, key = (Authority(tmp_path, "others") if foreign else authority).sign("own", days)
    options = BusOptions(listen=endpoint, security=RouterSecurity(ZenohCredentials(authority.pem, certificate, key)))
    bus = Bus(options, query_handler=nothing, explain=nothing, on_status=nothing, on_alive=nothing)
    try:
        assert not bus.ensure_connected()
        assert bus.state["detail"] == f"no router at {endpoint}: certificate not trusted: {reason}"
        refused(port, ZenohCredentials(authority.pem))
        listener = ZenohClient(
            "farm", "r1", on_event=nothing, on_connected=nothing, login=ZenohCredentials(authority.pem)
        )
        monkeypatch.setattr("app.agent.zenoh_client.CONNECT_MS", int(REFUSED_SECONDS * 1000))
        listener.set_endpoint(endpoint, "fleetmap")
        try:
            eventually(lambda: listener.problem and reason in listener.problem)
        finally:
            listener.close()
    finally:
        bus.close()


def test_rejected_robot_is_explained(authority: Authority, tmp_path: Path) -> None:
    endpoint = f"tls/127.0.0.1:{free_port()}"
    mutual = RouterSecurity(ZenohCredentials(authority.pem, *authority.sign("strict")), mutual=True)
    router = Router(router_configuration(BusOptions(listen=endpoint, security=mutual)))
    assert router.problem is None
    error = zenoh.ZError("Unable to connect! at /somewhere/else.rs:1")
    try:
        for login, reason in (
            (ZenohCredentials(authority.pem), "TLS error: tlsv13 alert certificate required"),
            (
                ZenohCredentials(authority.pem, *authority.sign("late", -1)),
                "TLS error: sslv3 alert certificate expired",
            ),
            (ZenohCredentials(authority.pem, *Authority(tmp_path, "x").sign("r")), "TLS error: "),
            (ZenohCredentials(authority.pem, *authority.sign("r1")), "Unable to connect!"),
        ):
            assert describe_connection_failure(f"{endpoint}, tcp/x:1", error, login).startswith(
                f"no router at {endpoint}, tcp/x:1: {reason}"
            )
    finally:
        router.close()
    for other_endpoint in (endpoint, "tcp/127.0.0.1:1", "tls/[::1]:1", "what is this"):
        assert (
            describe_connection_failure(other_endpoint, error, ZenohCredentials(authority.pem))
            == f"no router at {other_endpoint}: Unable to connect!"
        )


# --- what an operator writes ----------------------------------------------------------------------------------------
def test_users_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "users"
    path.write_bytes(b"# robots\r\nr1: one two \r\n\r\nr-2.x:a:b#c\n")
    assert read_users(path) == {"r1": "one two", "r-2.x": "a:b#c"}


@pytest.mark.parametrize(
    ("text", "reason"),
    [(b"", "no user"), (b"# x\n", "no user"), (b"r1\n", "line 1: must be NAME"), (b"r1:\n", "line 1: must be NAME"),
     (b"a:b\nr/1:x\n", "line 2: invalid name"), (b"*:x", "invalid name"), (b"server:x", "is reserved"),
     (b"a:b\na:c", "line 2: duplicate name"), (b"a:\xff", "UTF-8"), (b"a:b\x00c", "must be NAME"),
     (b"a:b\n" * 300_000, "bytes")],
)  # fmt: skip
def test_invalid_users_file_is_refused(text: bytes, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "users"
    path.write_bytes(text)
    with pytest.raises(Invalid, match=reason):
        read_users(path)


def test_missing_credential_file_is_reported_before_start(tmp_path: Path) -> None:
    missing_file = tmp_path / "gone.pem"
    existing_file = tmp_path / "here.pem"
    existing_file.touch()
    for security in (
        RouterSecurity(ZenohCredentials(ca=missing_file)),
        RouterSecurity(ZenohCredentials(certificate=missing_file, key=existing_file)),
        RouterSecurity(ZenohCredentials(certificate=existing_file, key=missing_file)),
        RouterSecurity(users=missing_file, folder=tmp_path),
    ):
        with pytest.raises(Invalid, match=r"could not read .*gone\.pem"):
            check_bus(BusOptions(security=security))
    for login in (
        ZenohCredentials(certificate=existing_file),
        ZenohCredentials(key=existing_file),
        ZenohCredentials(user="a"),
        ZenohCredentials(password="a"),
    ):
        with pytest.raises(Invalid, match="must be set together"):
            check_bus(BusOptions(mode="client", connect="tcp/x:1", security=RouterSecurity(login)))
    with pytest.raises(Unavailable, match="FLEETMAP_ZENOH_CONFIG"):
        check_bus(BusOptions(config=missing_file))
    existing_file.write_text("no PEM")
    with pytest.raises(Invalid, match="is not a certificate of a certification authority"):
        check_bus(BusOptions(security=RouterSecurity(ZenohCredentials(ca=existing_file))))
    one, other = Authority(tmp_path / "ca").sign("one"), Authority(tmp_path / "ca").sign("other")
    for certificate, key in ((one[0], other[1]), (existing_file, one[1]), (one[0], existing_file)):
        with pytest.raises(Invalid, match="are not a certificate and its unencrypted key"):
            check_bus(BusOptions(security=RouterSecurity(ZenohCredentials(certificate=certificate, key=key))))
    assert "secret" not in repr(ZenohCredentials(user="a", password="secret"))


@pytest.mark.parametrize(
    ("more", "reason"),
    [
        ({"zenoh_certificate": "a"}, "must be set together"), ({"tls_key": "a"}, "must be set together"),
        ({"zenoh_listen": "tls/0.0.0.0:7447"}, "requires zenoh_certificate"),
        ({"zenoh_certificate": "a", "zenoh_key": "b"}, "encrypted endpoint"),
        ({"zenoh_user": "a"}, "must be set together"), ({"zenoh_mtls": True}, "zenoh_mtls requires"),
        ({"zenoh_mode": "client", "zenoh_connect": "tcp/x:1", "zenoh_users": "u"}, "users of other routers"),
        ({"zenoh_connect": "tcp/x:1", "zenoh_users": "u"}, "rights of other routers"),
    ],
)  # fmt: skip
def test_inconsistent_settings_are_refused(more: dict[str, Any], reason: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=reason):
        settings_for(tmp_path, **{"zenoh_mode": "router", **more})


def test_operators_access_control_takes_precedence(tmp_path: Path) -> None:
    users = tmp_path / "users"
    users.write_text("r1:one\n")
    security = RouterSecurity(users=users, folder=tmp_path)
    ours = json.loads(router_configuration(BusOptions(prefix="a/b", security=security)))["access_control"]
    assert ours["default_permission"] == "deny"
    assert [key for rule in ours["rules"][3:] for key in rule["key_exprs"]] == [
        "a/b/*/robots/r1/status",
        "a/b/robots/r1",
    ]
    config = tmp_path / "zenoh.json5"
    theirs = {**access_control("x", ["r1"]), "default_permission": "allow"}
    config.write_text(json.dumps({"access_control": theirs}))
    configuration = json.loads(router_configuration(BusOptions(security=security, config=config)))
    assert configuration["access_control"]["default_permission"] == "allow"
    assert configuration["transport"]["auth"]["usrpwd"]["dictionary_file"] == str(tmp_path / "zenoh-users")


def test_concurrent_processes_share_one_password(tmp_path: Path) -> None:
    users = tmp_path / "users"
    users.write_text("r1:one\n")
    options = BusOptions(security=RouterSecurity(users=users, folder=tmp_path))
    passwords: list[str] = []
    barrier = threading.Barrier(8)

    def start() -> None:
        barrier.wait()
        passwords.append(json.loads(session_configuration(options))["transport"]["auth"]["usrpwd"]["password"])

    threads = [threading.Thread(target=start) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    assert len(passwords) == 8
    assert len(set(passwords)) == 1
    assert sorted(p.name for p in tmp_path.iterdir()) == ["users", "zenoh-password"]

"""Clients that occupy connections: silent, slow, or rejected. The server still serves all others."""

from __future__ import annotations

import contextlib
import resource
import select
import socket
import ssl
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import httpx
import pytest

from app.api.http.connections import TRUST_SECONDS, ConnectionLimits, Connections, fit_open_files
from tests.api.conftest import ADMIN, Api, running, settings_for
from tests.certificates import Authority
from tests.cli.conftest import ServerProcess

HEADERS = {"Authorization": f"Bearer {ADMIN}"}
CLOSED_SECONDS = 6.0
"""Longest time from a response that announces the end of its connection to this end."""

PATIENCE_SECONDS = 60.0
"""Time in seconds that a test waits for what must happen, on any machine."""

JSON_HEAD = "Content-Type: application/json\r\nContent-Length: 100000\r\n"


class FakeConnection:
    """Connection that records whether it was closed."""

    def __init__(self) -> None:
        self.closed = False
        self.is_idle = False

    def close_idle(self) -> None:
        self.closed = True


class Clock:
    def __init__(self) -> None:
        self.time = 0.0

    def __call__(self) -> float:
        return self.time


def crowd(connections: Connections, number: int, address: str) -> list[FakeConnection]:
    """Open connections of one address, all accepted."""
    fakes = [FakeConnection() for _ in range(number)]
    assert all(connections.open(one, address) for one in fakes)
    return fakes


def still_open(crowd: list[FakeConnection]) -> int:
    return sum(not one.closed for one in crowd)


# --- which connections are closed ---


def test_oldest_connection_of_an_address_is_closed_beyond_its_limit() -> None:
    connections = Connections(ConnectionLimits(total=100, per_address=5))
    first = crowd(connections, 5, "10.0.0.1")
    other = crowd(connections, 5, "10.0.0.2")
    crowd(connections, 2, "10.0.0.1")
    assert [one.closed for one in first] == [True, True, False, False, False]
    assert still_open(other) == 5
    assert len(connections) == 10
    local = crowd(connections, 20, "127.0.0.1")
    assert still_open(local) == 20, "loopback addresses have no limit of their own"


def test_authenticated_connections_do_not_count_for_their_address() -> None:
    connections = Connections(ConnectionLimits(total=100, per_address=5))
    robots = []
    for _ in range(20):  # behind one NAT
        robots += crowd(connections, 1, "10.0.0.1")
        connections.prove(robots[-1])
    crowd(connections, 50, "10.0.0.1")
    assert still_open(robots) == 20
    assert len(connections) == 25


def test_anonymous_connections_leave_a_quarter_and_close_none_with_a_token() -> None:
    clock = Clock()
    connections = Connections(ConnectionLimits(total=100, per_address=1000), clock)
    (robot,) = crowd(connections, 1, "10.0.0.1")
    connections.prove(robot)
    strangers = [one for k in range(30) for one in crowd(connections, 10, f"192.0.2.{k}")]
    assert still_open(strangers) == 75
    expected = crowd(connections, 24, "10.0.0.1")
    assert still_open(expected) == 24
    assert still_open(strangers) == 75
    crowd(connections, 1, "10.0.0.1")
    assert still_open(expected) == 24
    assert still_open(strangers) == 74, "a trusted address replaces an anonymous one"
    assert not robot.closed
    clock.time += TRUST_SECONDS + 1
    late = crowd(connections, 30, "10.0.0.1")
    assert still_open(late) == 30
    assert len(connections) == 100, "its address is no longer trusted"


def test_connections_with_a_token_are_closed_only_while_idle() -> None:
    connections = Connections(ConnectionLimits(total=16, per_address=100))
    proven = []
    for _ in range(16):
        proven += crowd(connections, 1, "10.0.0.1")
        connections.prove(proven[-1])
    late = FakeConnection()
    assert not connections.open(late, "10.0.0.1")
    connections.close(late)
    proven[3].is_idle = True
    assert connections.open(late, "10.0.0.1")
    assert [k for k, one in enumerate(proven) if one.closed] == [3]
    connections.prove(late)
    connections.prove(proven[3])  # its response came too late
    assert len(connections) == 16
    for one in [*proven, late]:
        connections.close(one)
    assert len(connections) == 0


def test_limit_of_open_files_is_raised_to_its_maximum() -> None:
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    hard = before[1] if before[1] != resource.RLIM_INFINITY else 2**20
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (min(1024, hard), before[1]))
        assert fit_open_files(1000) == 1000
        assert resource.getrlimit(resource.RLIMIT_NOFILE)[0] >= 2000, "a socket and a streamed file each"
        assert fit_open_files(hard + 1) <= hard // 2
        assert resource.getrlimit(resource.RLIMIT_NOFILE)[0] == hard
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


# --- against a server ---


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Api]:
    settings = settings_for(
        tmp_path_factory.mktemp("server"), max_uploads=1, header_seconds=1.0, body_seconds=1.0, body_pace=1000
    )
    with running(settings) as api:
        api.post("environments", {"name": "farm"})
        yield api


def connect(url: str) -> socket.socket:
    place = urlsplit(url)
    return socket.create_connection((place.hostname, place.port), timeout=PATIENCE_SECONDS)


def read_to_end(line: socket.socket, trickle: bytes = b"") -> tuple[bytes, float]:
    """Read until the server closes; return the bytes and the seconds after the response. Sends ``trickle``."""
    out, answered, started = b"", 0.0, time.monotonic()
    while time.monotonic() - started < PATIENCE_SECONDS:
        if not select.select([line], [], [], 0.05)[0]:
            if trickle:
                with contextlib.suppress(OSError):
                    line.sendall(trickle)
            continue
        try:
            data = line.recv(65536)
        except ConnectionResetError:
            data = b""
        if not data and trickle:  # half closed: until it is closed altogether
            with contextlib.suppress(OSError):
                while time.monotonic() - started < PATIENCE_SECONDS:
                    line.sendall(trickle)
                    time.sleep(0.05)
        if not data:
            return out, time.monotonic() - (answered or started)
        answered = answered or time.monotonic()
        out += data
    raise AssertionError(f"the connection stays open; it got {out[:200]!r}")


REFUSED = [
    ("POST /api/v1/environments", "", JSON_HEAD, 401),
    ("POST /api/v1/environments", "nonsense", JSON_HEAD, 401),
    ("POST /healthz", "", JSON_HEAD, 405),
    ("PUT /docs/nothing", "", JSON_HEAD, 405),
    ("GET /api/v1/formats", "", JSON_HEAD, 401),
    ("GET /healthz", "", JSON_HEAD, 200),
    ("DELETE /api/v1/tokens/nosuch", ADMIN, JSON_HEAD, 404),
    ("POST /api/v1/environments", ADMIN, JSON_HEAD.replace("100000", "99999999999"), 413),
    ("POST /api/v1/environments", ADMIN, JSON_HEAD.replace("json", "pdf"), 415),
    ("POST /api/v1/environments", ADMIN, JSON_HEAD + "Content-Encoding: gzip\r\n", 415),
    ("POST /api/v1/environments", ADMIN, JSON_HEAD + "Expect: 100-continue\r\nContent-Encoding: gzip\r\n", 415),
    ("POST /api/v1/environments", "", "Content-Type: application/json\r\nTransfer-Encoding: chunked\r\n", 401),
]


def send_head(url: str, target: str, token: str, head: str) -> socket.socket:
    """Open a connection and send the header of a request, without its body."""
    line = connect(url)
    method, path = target.split()
    bearer = f"Authorization: Bearer {token}\r\n" if token else ""
    line.sendall(f"{method} {path} HTTP/1.1\r\nHost: x\r\n{bearer}{head}\r\n".encode())
    return line


def test_rejected_body_is_not_awaited(api: Api) -> None:
    """The response announces that the connection closes, and it does, even while the client still sends the body."""
    lines = [send_head(api.url, target, token, head) for target, token, head, _ in REFUSED]
    for line, (target, _, head, status) in zip(lines, REFUSED, strict=True):
        chunk = b"1\r\n \r\n" if "chunked" in head else b" "
        with line:
            answer, seconds = read_to_end(line, chunk)
        assert answer.startswith(f"HTTP/1.1 {status} ".encode()), f"{target}: {answer[:200]!r}"
        assert b"connection: close\r\n" in answer, target
        assert seconds < CLOSED_SECONDS, target


def test_rejected_large_body_gets_a_response(api: Api) -> None:
    """A client that sends everything before it reads is not reset."""
    with connect(api.url) as line:
        body = bytes(20_000_000)
        line.sendall(
            b"POST /api/v1/environments/farm/versions HTTP/1.1\r\nHost: x\r\n"
            b"Content-Type: application/octet-stream\r\nContent-Length: %d\r\n\r\n" % len(body)
        )
        line.sendall(body)
        assert read_to_end(line)[0].startswith(b"HTTP/1.1 401 ")


def test_connection_is_kept_after_a_complete_body(api: Api) -> None:
    with connect(api.url) as line:
        for piece in (b"", b"{}"):
            line.sendall(b"POST /api/v1/environments HTTP/1.1\r\nHost: x\r\nContent-Length: %d\r\n\r\n" % len(piece))
            line.sendall(piece)
            answer = b""
            while b"\r\n\r\n" not in answer:
                answer += line.recv(65536)
            if not piece:
                assert answer.startswith(b"HTTP/1.1 401 ")
                assert b"connection: close" not in answer


ASK = b"GET /openapi.json HTTP/1.1\r\nHost: x\r\n"


@pytest.mark.parametrize("number", [1, 3])
def test_malformed_request_keeps_earlier_responses(api: Api, number: int) -> None:
    with connect(api.url) as line:
        line.sendall((ASK + b"\r\n") * number + b"nonsense\r\n\r\n" + bytes(100_000))
        answers, _ = read_to_end(line)
    expected = api.http.get("/openapi.json").content
    for _ in range(number):
        head, _, answers = answers.partition(b"\r\n\r\n")
        assert head.startswith(b"HTTP/1.1 200 ")
        assert answers.startswith(expected)
        answers = answers[len(expected) :]
    assert answers == b""


def test_incomplete_request_after_a_response_ends_the_connection(api: Api) -> None:
    with connect(api.url) as line:
        line.sendall(ASK + b"\r\n" + ASK + b"Transfer-Encoding: chunked\r\n\r\nnonsense\r\n")
        assert b"HTTP/1.1 400 " not in read_to_end(line)[0]
    with connect(api.url) as line:
        line.sendall(ASK + b"Transfer-Encoding: chunked\r\n\r\nnonsense\r\n")
        assert read_to_end(line)[0].startswith(b"HTTP/1.1 400 ")


def test_slow_bodies_and_headers_time_out(api: Api) -> None:
    bearer = f"Authorization: Bearer {ADMIN}\r\n"
    with connect(api.url) as body, connect(api.url) as head, connect(api.url) as blank:
        body.sendall(f"POST /api/v1/environments HTTP/1.1\r\nHost: x\r\n{bearer}{JSON_HEAD}\r\n".encode())
        blank.sendall(b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n")
        answer, _ = read_to_end(body, b" ")
        assert answer.startswith(b"HTTP/1.1 408 ")
        assert b"1000 bytes per second" in answer
        head.sendall(b"GET /healthz HTTP/1.1\r\nHost: x\r\nX-Slow: ")
        assert read_to_end(head, b"x")[0] == b""
        assert read_to_end(blank, b"\r\n")[0].startswith(b"HTTP/1.1 200 "), "empty lines before a request are ignored"


def test_connection_of_client_that_does_not_read_is_closed(api: Api) -> None:
    with connect(api.url) as line:
        line.sendall(b"GET /openapi.json HTTP/1.1\r\nHost: x\r\n\r\n" * 200)
        with pytest.raises((ConnectionResetError, BrokenPipeError)):
            _send_for(line, PATIENCE_SECONDS)


def _send_for(line: socket.socket, seconds: float) -> None:
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        line.send(b"G")
        time.sleep(0.05)


def test_unfinished_handshakes_are_bounded(tmp_path: Path) -> None:
    authority = Authority(tmp_path)
    certificate, key = authority.sign("server")
    settings = settings_for(
        tmp_path / "data", tls_certificate=certificate, tls_key=key, max_connections=16, header_seconds=4.0
    )
    trust = ssl.create_default_context(cafile=str(authority.pem))
    with running(settings, trust) as api, contextlib.ExitStack() as silent:
        lines = [silent.enter_context(connect(api.url)) for _ in range(40)]
        for line in lines[:24]:
            read_to_end(line)
        api.get("formats")
        for line in lines[24:]:
            read_to_end(line)
        with trust.wrap_socket(connect(api.url), server_hostname="127.0.0.1") as line:
            line.sendall(f"POST /api/v1/environments HTTP/1.1\r\nHost: x\r\n{JSON_HEAD}\r\n".encode())
            assert read_to_end(line)[0].startswith(b"HTTP/1.1 401 ")


def trickle(address: str, number: int, flood: list[socket.socket]) -> Iterator[None]:
    """Open connections that slowly send bytes of a header, or of a body without a token; yields at each 100th."""
    for k in range(number):
        line = connect(address)
        head = f"POST /api/v1/environments HTTP/1.1\r\nHost: x\r\n{JSON_HEAD}"
        line.sendall((head + ("\r\n" if k % 2 else "X-Slow: ")).encode())
        flood.append(line)
        if k % 100 == 0:
            for other in flood:
                with contextlib.suppress(OSError):
                    other.send(b" ")
            yield


def test_server_answers_during_a_flood_of_slow_connections(tmp_path: Path) -> None:
    """600 sockets send a byte per second each, of a header or of a body without a token. Others get their response."""
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(900, limits[1]), limits[1]))
    number = 600
    process = ServerProcess(
        "--data-dir", str(tmp_path / "data"), "--max-connections", "200",
        environment={"FLEETMAP_ADMIN_TOKEN": ADMIN, "FLEETMAP_CONVERSION_WORKERS": "1"}, folder=tmp_path,
    )  # fmt: skip
    flood: list[socket.socket] = []
    try:
        process.ready()
        with httpx.Client(base_url=process.address, headers=HEADERS, timeout=PATIENCE_SECONDS) as client:
            assert client.get("/api/v1/formats").status_code == 200
            stream = client.stream("GET", "/api/v1/events")
            assert stream.__enter__().status_code == 200
            for _ in trickle(process.address, number, flood):
                for path in ("/healthz", "/api/v1/environments"):
                    answer = httpx.get(f"{process.address}{path}", headers=HEADERS, timeout=PATIENCE_SECONDS)
                    assert answer.status_code == 200
                assert client.get("/api/v1/formats").status_code == 200
            opened = len(list(Path(f"/proc/{process.process.pid}/fd").iterdir()))
            assert opened < 200 + 100
            stream.__exit__(None, None, None)
    finally:
        for line in flood:
            line.close()
        process.stop()
        resource.setrlimit(resource.RLIMIT_NOFILE, limits)

"""Fake server of one environment, which signs and returns anything, and an agent in this process."""

from __future__ import annotations

import base64
import contextlib
import hashlib
import itertools
import json
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from datetime import datetime, timedelta, timezone
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, unquote

from app.agent.agent import Agent, AgentOptions
from app.signing import Keys

PLACE = "field"
Files = Mapping[str, bytes]
"""``<format>/<name>`` -> bytes."""


class Fake:
    """A server. ``put`` adds a version and moves ``latest`` there, ``move`` moves a channel; ``asked`` is what was.

    instead: called with each request first; it answers by itself and returns True where it likes to.
    """

    def __init__(self, folder: Path) -> None:
        self.keys = Keys(folder)
        self.versions: list[Files] = []
        self.channels: dict[str, tuple[int, int]] = {}
        self.sequence = 0
        self.more: dict[str, Any] = {}
        self.closures: list[dict[str, Any]] | None = None
        """None: a server that applies none. Each is written at the end of every file."""
        self.signs_time = True
        self.levels: dict[str, str] = {}
        """Path of a file -> level."""
        self.ready: dict[str, Any] = {}
        self.planned: dict[str, Any] = {}
        self.statuses: list[dict[str, Any]] = []
        self.asked: list[str] = []
        self.instead: Callable[[BaseHTTPRequestHandler], bool] = lambda _: False
        self._numbers, self._current, self._answered = itertools.count(), set[int](), threading.Condition()
        fake = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"
            wbufsize = -1

            def do_GET(self) -> None:
                with fake._answering():
                    fake.asked.append(self.path)
                    if not fake.instead(self):
                        fake.answer(self)

            def do_PUT(self) -> None:
                fake.statuses.append(json.loads(self.rfile.read(int(self.headers["content-length"]))))
                with fake._answering():
                    if not fake.instead(self):
                        send(self, 204, b"")

            def log_message(self, *_: Any) -> None:
                pass

        class Server(ThreadingHTTPServer):
            daemon_threads = True

            def handle_error(self, *_: Any) -> None:
                pass  # an agent that gives up a slow answer

        self._server = Server(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self._server.server_port}"
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join(60)

    def finish_requests(self) -> None:
        """Wait until all requests that are being answered now have been answered."""
        with self._answered:
            current = set(self._current)
            assert self._answered.wait_for(lambda: not current & self._current, 60)

    @contextlib.contextmanager
    def _answering(self) -> Iterator[None]:
        number = next(self._numbers)
        with self._answered:
            self._current.add(number)
        try:
            with contextlib.suppress(OSError):
                yield
        finally:
            with self._answered:
                self._current.remove(number)
                self._answered.notify_all()

    def put(self, files: Files) -> int:
        """A version with these files; its number."""
        self.versions.append(dict(files))
        self.move("latest", len(self.versions))
        return len(self.versions)

    def move(self, channel: str, version: int) -> None:
        self.sequence += 1
        self.channels[channel] = (version, self.sequence)

    def close_edges(self, *edges: str) -> None:
        """Accept closures of these edges, and end all others."""
        self.closures = [{"id": edge, "kind": "edge", "level": "ground", "edge": edge} for edge in edges]
        self.sequence += 1
        self.channels = {name: (version, self.sequence) for name, (version, _) in self.channels.items()}

    @property
    def digest(self) -> str:
        return hashlib.sha256(json.dumps(self.closures or []).encode()).hexdigest()

    def root(self, version: int) -> str:
        return hashlib.sha256(repr(sorted(self.versions[version - 1].items())).encode()).hexdigest()

    def plan(self, channel: str, version: int) -> None:
        self.planned[channel] = {"version": version, "root": self.root(version)}

    def file(self, path: str, version: int) -> bytes:
        return self.versions[version - 1][path] + "".join(c["id"] for c in self.closures or []).encode()

    def manifest(self, ref: str, query: str = "") -> bytes:
        number, sequence = (int(ref), 1) if ref.isdigit() else self.channels[ref]
        originals = self.versions[number - 1]
        files = {path: self.file(path, number) for path in originals}
        body = {
            "environment": PLACE,
            **({} if ref.isdigit() else {"channel": ref}),
            "sequence": sequence,
            "version": number,
            "root": self.root(number),
            "expires": (datetime.now(timezone.utc) + timedelta(days=1)).isoformat(),
            "files": [
                {
                    "format": path.partition("/")[0],
                    "name": path.partition("/")[2],
                    "size": len(data),
                    "sha256": hashlib.sha256(data).hexdigest(),
                    **({"level": self.levels[path]} if path in self.levels else {}),
                }
                for path, data in sorted(files.items())
            ],
            "layers": {"topology": hashlib.sha256(repr(sorted(originals.items())).encode()).hexdigest()[:16]},
        }
        if self.closures is not None:
            body |= {"overlays": self.closures, "overlays_digest": self.digest, **self.request(ref, query)}
        if self.levels:
            names = sorted(set(self.levels.values()))
            body["levels"] = [{"name": name, "elevation": 3.5 * k} for k, name in enumerate(names)]
        if self.signs_time:
            body["time"] = datetime.now(timezone.utc).isoformat()
        return json.dumps(body | self.more).encode()

    def request(self, ref: str, query: str) -> dict[str, Any]:
        """Return the manifest members that repeat the request."""
        values = dict(parse_qsl(query))
        entries = [unquote(e).partition("?") for e in values.get("formats", "").split(",")]
        entries += [unquote(e).partition("?") for e in values.get("optional", "").split(",") if e]
        parameters = {name: dict(parse_qsl(text)) for name, _, text in entries if text}
        mode = values.get("closures", "ignore" if ref.isdigit() else "apply")
        return ({"parameters": parameters} if parameters else {}) | ({} if mode == "apply" else {"closures": mode})

    def answer(self, handler: BaseHTTPRequestHandler) -> None:
        """As a server does."""
        address, _, query = handler.path.partition("?")
        path = address.split("/")
        if path[-1] == "readyz":
            return send(handler, 200, json.dumps({"events": self.ready}).encode())
        if path[-1] == "keys":
            return send(handler, 200, json.dumps([key.as_dict() for key in self.keys.public()]).encode())
        if path[-1] == "channels":
            lines = [
                {"channel": c, "version": v, "planned": self.planned.get(c)} for c, (v, _) in self.channels.items()
            ]
            return send(handler, 200, json.dumps(lines).encode())
        if path[-1] == "manifest":
            if not path[-2].isdigit() and path[-2] not in self.channels:
                return send(handler, 404, b'{"detail": "no such channel"}')
            data = self.manifest(path[-2], query)
            etag = f'"{hashlib.sha256(data.partition(b"expires")[0] + self.digest.encode()).hexdigest()}"'
            if handler.headers.get("if-none-match") == etag:
                return send(handler, 304, b"", etag=etag)
            key, signature = self.keys.sign(data)
            signed = f"{key}:{base64.b64encode(signature).decode()}"
            return send(handler, 200, data, etag=etag, **{"fleetmap-signature": signed})
        data = self.file("/".join(path[8:]), int(path[6]))
        more = {} if self.closures is None else {"fleetmap-overlays": self.digest}
        start = int((handler.headers.get("range") or "bytes=0-")[6:-1])
        return send(handler, 206 if start else 200, data[start:], **more)


def send(handler: BaseHTTPRequestHandler, status: int, body: bytes, **headers: str) -> None:
    handler.send_response(status)
    if status not in (204, 304):
        handler.send_header("content-length", str(len(body)))
    for name, value in headers.items():
        handler.send_header(name, value)
    handler.end_headers()
    handler.wfile.write(body)


class StoppedClock:
    """Monotonic clock that a test moves, in place of a module's ``time``: no load of the machine makes it later."""

    def __init__(self) -> None:
        self.seconds = 1000.0

    def monotonic(self) -> float:
        return self.seconds


@contextlib.contextmanager
def run(one: One) -> Iterator[None]:
    """It runs until the end of the block."""
    one.agent.open()
    thread = threading.Thread(target=one.agent.run, daemon=True)
    thread.start()
    try:
        yield
    finally:
        one.agent.stop()
        thread.join(60)
        assert not thread.is_alive(), "it does not end"
        one.agent.close()


class One:
    """Agent in this process; ``lines`` are its logged events."""

    def __init__(
        self,
        fake: Fake,
        into: Path,
        *on_change: str,
        formats: tuple[str, ...] = ("kml",),
        clock: Callable[[], float] = time.time,
        **more: Any,
    ) -> None:
        self.into = into
        self.lines: list[dict[str, Any]] = []
        options = AgentOptions(fake.url, PLACE, formats, into, robot="robot", on_change=on_change, **more)
        self.agent = Agent(options, lambda event, **members: self.lines.append({"event": event, **members}), clock)

    def once(self) -> bool:
        """Take the folder, sync once, let go."""
        try:
            self.agent.open()
            return self.agent.run_once()
        finally:
            self.agent.close()

    def saw(self, event: str, **members: Any) -> dict[str, Any] | None:
        fits = (x for x in self.lines if x["event"] == event and all(x.get(k) == v for k, v in members.items()))
        return next(fits, None)

    @property
    def detail(self) -> str:
        """Detail of the last failure."""
        return str([x for x in self.lines if x["event"] in ("failed", "refused")][-1]["detail"])

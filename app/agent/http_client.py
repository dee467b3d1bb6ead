"""HTTP client of the agent: manifest, keys, files with ranges (RFC 9110) and deltas (RFC 9842), status."""

from __future__ import annotations

import base64
import contextlib
import json
import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote, urljoin

import httpx

from app.agent.signed_manifest import ManifestFile
from app.agent.state import digest
from app.bearer import authorization
from app.errors import Denied, FleetMapError, Invalid, NotFound, Unavailable, Untrusted
from app.events.credentials import server_ssl_context

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

API = "/api/v1"
SIGNATURE = "fleetmap-signature"
CHECK_ADDRESS = "check the address of the Fleet Map Server"
OVERLAYS = "fleetmap-overlays"
"""Response header of a map: digest of the closures that were applied to it."""

TIMEOUT = httpx.Timeout(10.0, read=60.0)
"""Timeouts in seconds. For longer conversions the server returns a job."""

HEAD_SECONDS = 90.0
"""Time limit for the header of a response; also ends connections that send it byte by byte."""

WATCH_SECONDS = 0.5
RESPONSE_SECONDS = 300.0
"""Time limit for a manifest or another small response."""

PACE_SECONDS = 60.0
MIN_BYTES_PER_SECOND = 4096
"""Minimum rate of a response, averaged over each PACE_SECONDS and over the whole response. A slower one counts as
failed; the next attempt resumes the download.
"""

MAX_MANIFEST_BYTES = 32 * 2**20
MAX_JSON_BYTES = 4 * 2**20
MAX_DICTIONARY_BYTES = 64 * 2**20
"""Maximum file size for deltas: decoding holds the file in memory twice."""

MIN_DICTIONARY_BYTES = 8
"""Minimum dictionary size of Zstandard."""

WINDOW_LOG = 27
"""Maximum window of a delta, as a power of two: 128 MiB."""

DCZ_MAGIC = bytes.fromhex("5e2a4d1820000000")
JOB_SECONDS = 600.0
MAX_JOBS = 1000
"""Maximum number of conversion jobs for one manifest. More means that the server discards finished maps."""


class AgentStopped(Exception):
    """Control flow: ``stop`` was called."""


class ClosuresChanged(Unavailable):
    """A file has other closures than its manifest: fetch the manifest again."""


class UnreadableDelta(Untrusted):
    """A delta that cannot be decoded: fetch the complete file."""


class RetryLater(Unavailable):
    """The server is busy: retry after ``seconds``."""

    def __init__(self, detail: str, seconds: float = 0.0) -> None:
        super().__init__(detail)
        self.seconds = seconds


class _RequestWatchdog:
    """Time limits of all requests, enforced by one thread: a timer per request would cost more than the request."""

    def __init__(self) -> None:
        self._due: dict[object, tuple[float, Callable[[], None]]] = {}
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    @contextlib.contextmanager
    def within(self, seconds: float, late: Callable[[], None]) -> Iterator[None]:
        """Call ``late`` in another thread if the ``with`` body takes longer than this, at most one second late."""
        with self._lock:
            if self._thread is None:
                self._thread = threading.Thread(target=self._interrupt_overdue, name="fleetmap-watch", daemon=True)
                self._thread.start()
        entry = object()
        self._due[entry] = (time.monotonic() + seconds, late)
        try:
            yield
        finally:
            self._due.pop(entry, None)

    def _interrupt_overdue(self) -> None:
        while True:
            time.sleep(WATCH_SECONDS)
            now = time.monotonic()
            for entry, (until, late) in list(self._due.items()):
                if until < now and self._due.pop(entry, None) is not None:
                    late()


_watch = _RequestWatchdog()


class ServerClient:
    """HTTP client of one server. Methods raise FleetMapError for error responses and failed connections.

    Args:
        ca: certification authority of the server (PEM); default: public ones.
    """

    def __init__(self, server: str, token: str | None, stopping: threading.Event, ca: Path | None = None) -> None:
        self.server = (server if "://" in server else f"http://{server}").rstrip("/")
        headers = {"User-Agent": "fleetmap-agent", "Accept-Encoding": "identity"}
        if token:
            headers["Authorization"] = authorization(token)
        self._http = httpx.Client(
            base_url=self.server,
            headers=headers,
            timeout=TIMEOUT,
            follow_redirects=False,
            verify=server_ssl_context(self.server, ca),
        )
        self._stopping = stopping
        self._sockets: list[socket.socket] = []
        self._overlays: str | None = None
        self.received = 0
        self.deltas = 0
        self.failed_deltas = 0

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def interrupt(self) -> None:
        """Abort requests that wait for a response. Safe to call from any thread."""
        for connection in self._sockets:
            with contextlib.suppress(OSError):
                socket.socket.shutdown(connection, socket.SHUT_RDWR)

    # --- requests ---

    def readyz(self) -> Any:
        """Get the server's readiness document; its member ``events`` has the address of the router."""
        return self._json("/readyz")

    def keys(self, environment: str | None = None) -> list[Mapping[str, Any]]:
        """List the signing keys, newest first. environment: of a mirror also its centre's, and why it may sign."""
        query = "" if environment is None else f"?environment={quote(environment, safe='')}"
        body = self._json(f"{API}/keys{query}")
        return [line for line in body if isinstance(line, dict)] if isinstance(body, list) else []

    def channels(self, environment: str) -> list[Mapping[str, Any]]:
        """List the channels with their planned moves, without the fleet's status."""
        body = self._json(f"{API}/environments/{quote(environment, safe='')}/channels?robots=false")
        if not isinstance(body, list):
            raise Unavailable(f"unexpected response from {self.server} (channels are not a list): {CHECK_ADDRESS}")
        return [line for line in body if isinstance(line, dict)]

    def manifest(
        self, environment: str, ref: str, query: str, etag: str | None = None
    ) -> tuple[bytes, str, str | None] | None:
        """Get a manifest: the signed bytes, the signature and the ETag; None if its ETag is still ``etag``.

        Args:
            query: encoded query string.
        """
        path = f"{API}/environments/{quote(environment, safe='')}/versions/{quote(ref, safe='')}/manifest?{query}"
        headers = {"If-None-Match": etag} if etag else {}
        for _ in range(MAX_JOBS):
            with self._stream(path, headers) as answer:
                if answer.status_code == 304 and etag:
                    return None
                if answer.status_code == 200:
                    data = self._read_all(answer, MAX_MANIFEST_BYTES)
                    return data, answer.headers.get(SIGNATURE, ""), answer.headers.get("etag")
                if answer.status_code != 202:
                    raise self._response_error(answer)
                location = answer.headers.get("location", "")
            self._wait(path, location)
        raise Unavailable(
            f"{self.server} did not return the manifest after {MAX_JOBS} conversion jobs: check the server's log"
        )

    def put_status(self, robot: str, body: Mapping[str, Any]) -> None:
        """Report the robot's status. The body of a successful response is not read."""
        path = f"{API}/robots/{quote(robot, safe='')}/status"
        with self._stream(path, {"Prefer": "return=minimal"}, dict(body)) as answer:
            if answer.status_code >= 300:
                raise self._response_error(answer)

    def fetch(
        self,
        environment: str,
        version: int,
        file: ManifestFile,
        target: Path,
        old: tuple[Path, str] | None,
        *,
        query: str = "",
        overlays: str | None = None,
    ) -> None:
        """Download a file to ``target`` and verify it. Resumes an interrupted download in ``<target>.part``.

        Args:
            old: installed file with its SHA-256, offered as the dictionary for a delta.
            query: encoded query string.
            overlays: digest of the closures in the manifest.

        Raises:
            ClosuresChanged: the bytes differ because the closures have changed since.
            Untrusted: the bytes differ from the manifest.
        """
        path = f"{API}/environments/{quote(environment, safe='')}/versions/{version}/maps/"
        path += f"{quote(file.format, safe='')}/{quote(file.name, safe='/')}{'?' if query else ''}{query}"
        part = target.with_name(target.name + ".part")
        self._overlays = None
        for _ in range(2):
            fresh = not part.exists()
            if part.exists() and part.stat().st_size > file.size:
                part.unlink()
            try:
                complete = self._receive(path, part, file, old if fresh else None)
            except UnreadableDelta:
                self.failed_deltas += 1
                part.unlink(missing_ok=True)
                old = None
                continue
            if _complete(part, file):
                part.chmod(0o444)
                part.replace(target)
                return
            part.unlink(missing_ok=True)
            if overlays is not None and self._overlays not in (None, overlays):
                raise ClosuresChanged(f"closures in {file.path} have changed since its manifest was signed")
            if fresh and complete:
                break
            old = None  # an unusable delta or partial file: once more from the start
        raise Untrusted(f"hash of {file.path} differs from the manifest: the file was changed in transit")

    # --- internals ---

    def _receive(self, path: str, part: Path, file: ManifestFile, old: tuple[Path, str] | None) -> bool:
        """Write or resume ``part``. Return whether the server sent the complete file."""
        start = part.stat().st_size if part.exists() else 0
        if start == file.size and start:
            return False
        headers = {"Range": f"bytes={start}-"} if start else {}
        if old is not None and not start and _fits(old[0].stat().st_size, file.size):
            dictionary = base64.b64encode(bytes.fromhex(old[1])).decode()
            headers |= {"Available-Dictionary": f":{dictionary}:", "Accept-Encoding": "dcz"}
        with self._stream(path, headers) as answer:
            self._overlays = answer.headers.get(OVERLAYS)
            if answer.status_code == 416:
                return False
            if answer.status_code == 202:
                raise RetryLater(f"the server is still converting {file.path}", 2.0)
            if answer.status_code not in (200, 206):
                raise self._response_error(answer)
            coding = answer.headers.get("content-encoding", "identity").lower()
            chunks = self._chunks(answer)
            if coding == "dcz" and "Available-Dictionary" in headers and old is not None:
                self._write(part, "wb", 0, _decode(chunks, old, file), file, keep=False)
                self.deltas += 1
                return False
            if coding != "identity":
                raise Unavailable(f"{file.path} has the Content-Encoding {coding!r}, which was not requested")
            going_on = answer.status_code == 206
            self._write(part, "ab" if going_on else "wb", start if going_on else 0, chunks, file, keep=True)
            return not going_on

    @staticmethod
    def _write(part: Path, mode: str, start: int, chunks: Iterable[bytes], file: ManifestFile, *, keep: bool) -> None:
        written = start
        if not start:
            part.unlink(missing_ok=True)  # never follow a link planted here
        try:
            with part.open(mode) as stream:
                for chunk in chunks:
                    written += len(chunk)
                    if written > file.size:
                        break  # larger than in the manifest; the caller checks the size
                    stream.write(chunk)
                stream.flush()
                os.fsync(stream.fileno())
        except BaseException as error:
            if not keep or isinstance(error, OSError):  # frees space on a full disk
                part.unlink(missing_ok=True)
            raise
        if written > file.size:
            part.unlink(missing_ok=True)

    def _chunks(self, answer: httpx.Response) -> Iterator[bytes]:
        """Iterate over the body as received: a larger buffer would be lost if the connection breaks.

        Raises Unavailable if the response is slower than MIN_BYTES_PER_SECOND.
        """
        begun = window = time.monotonic()
        total = since = 0
        for chunk in answer.iter_raw():
            if self._stopping.is_set():
                raise AgentStopped
            self.received += len(chunk)
            total, since, now = total + len(chunk), since + len(chunk), time.monotonic()
            if now - window > PACE_SECONDS:
                for count, seconds in ((since, now - window), (total, now - begun)):
                    if count < MIN_BYTES_PER_SECOND * seconds:
                        raise Unavailable(
                            f"{self.server} sent {count} bytes in {seconds:.0f} seconds, less than "
                            f"{MIN_BYTES_PER_SECOND} bytes per second: the agent resumes the download later"
                        )
                window, since = now, 0
            yield chunk

    def _read_all(self, answer: httpx.Response, limit: int) -> bytes:
        data, end = bytearray(), time.monotonic() + RESPONSE_SECONDS
        for chunk in self._chunks(answer):
            data += chunk
            if time.monotonic() > end:
                raise Unavailable(f"{self.server} did not complete its response within {RESPONSE_SECONDS:g} seconds")
            if len(data) > limit:
                raise Untrusted(f"response from {self.server} exceeds {limit} bytes")
        return bytes(data)

    def _json(self, path: str) -> Any:
        with self._stream(path, {}) as answer:
            if answer.status_code != 200:
                raise self._response_error(answer)
            data = self._read_all(answer, MAX_JSON_BYTES)
        try:
            return json.loads(data)
        except (ValueError, RecursionError):
            raise Unavailable(f"unexpected response from {self.server} (not JSON): {CHECK_ADDRESS}") from None

    def _wait(self, path: str, location: str) -> None:
        """Wait for the job at ``location``, a reference relative to ``path``. Raises Invalid if the job failed."""
        try:
            address = urljoin(path, location)
        except ValueError:
            address = ""
        if not address.startswith("/") or address.startswith("//"):
            raise Unavailable(f"unexpected response from {self.server} (job on another host): {CHECK_ADDRESS}")
        pause, waited = 0.3, 0.0
        while True:
            job = self._json(address)
            state = job.get("state") if isinstance(job, dict) else None
            if state == "done":
                return
            if state not in ("queued", "running"):
                problem = job.get("problem") if isinstance(job, dict) else None
                detail = problem.get("detail") if isinstance(problem, dict) else state
                raise Invalid(f"the server cannot convert the maps: {plain(str(detail)[:1000])}")
            if waited > JOB_SECONDS:
                raise Unavailable(f"the server did not convert the maps within {JOB_SECONDS:g} seconds")
            if self._stopping.wait(pause):
                raise AgentStopped
            waited += pause
            pause = min(5.0, pause * 1.5)

    @contextlib.contextmanager
    def _stream(self, path: str, headers: Mapping[str, str], body: Any = None) -> Iterator[httpx.Response]:
        """Send a GET request, or PUT if there is a JSON body."""
        method = "GET" if body is None else "PUT"
        request = self._http.build_request(
            method, path, headers=dict(headers), json=body, extensions={"trace": self._note}
        )
        with self._reach():
            with _watch.within(HEAD_SECONDS, self.interrupt):
                answer = self._http.send(request, stream=True)
            with contextlib.closing(answer):
                yield answer

    def _note(self, event: str, details: Mapping[str, Any]) -> None:
        """Store the sockets of open connections for ``interrupt``."""
        if event in ("connection.connect_tcp.complete", "connection.start_tls.complete"):
            connection = details["return_value"].get_extra_info("socket")
            if isinstance(connection, socket.socket):
                self._sockets = [*(s for s in self._sockets if s.fileno() != -1), connection]

    @contextlib.contextmanager
    def _reach(self) -> Iterator[None]:
        if self._stopping.is_set():
            raise AgentStopped
        try:
            yield
        except (httpx.HTTPError, httpx.InvalidURL) as error:
            if self._stopping.is_set():
                raise AgentStopped from None
            raise Unavailable(f"no response from {self.server}: {error or type(error).__name__}") from None

    def _response_error(self, answer: httpx.Response) -> FleetMapError:
        """Return the error for an error response."""
        status, detail = answer.status_code, ""
        try:
            problem = json.loads(self._read_all(answer, MAX_JSON_BYTES))
            detail = str(problem.get("detail") or problem.get("title") or "") if isinstance(problem, dict) else ""
        except (ValueError, RecursionError, httpx.HTTPError, FleetMapError):
            detail = ""
        detail = plain(detail[:1000]) or f"{self.server} returned status {status}"
        if 300 <= status < 400 and (elsewhere := answer.headers.get("location")):
            detail = f"{self.server} redirects to {elsewhere[:300]}: if the server has moved, change --server"
        if status in (429, 503):
            try:
                seconds = float(answer.headers.get("retry-after", "0"))
            except ValueError:
                seconds = 0.0
            return RetryLater(detail, min(300.0, max(0.0, seconds)))
        if status in (401, 403):
            return Denied(f"{detail} (token: FLEETMAP_TOKEN)")
        if status == 404:
            return NotFound(detail)
        return Unavailable(detail) if status >= 500 else Invalid(detail)


def plain(text: str) -> str:
    """Replace lone surrogates, which JSON may contain and UTF-8 cannot encode."""
    return text.encode("utf-8", "replace").decode()


def _complete(part: Path, file: ManifestFile) -> bool:
    try:
        if part.stat().st_size != file.size:
            return False
        return digest(part) == file.sha256
    except FileNotFoundError:
        return False


def _fits(old: int, new: int) -> bool:
    """Whether to request a delta, by the sizes of the old and the new file in bytes."""
    return old >= MIN_DICTIONARY_BYTES and max(old, new) <= MAX_DICTIONARY_BYTES


def _decode(chunks: Iterator[bytes], old: tuple[Path, str], file: ManifestFile) -> Iterator[bytes]:
    """Decode a ``dcz`` body chunk by chunk. Raises UnreadableDelta, also if it exceeds the size in the manifest."""
    old_path, sha256 = old
    want = DCZ_MAGIC + bytes.fromhex(sha256)
    head = b""
    for chunk in chunks:
        head += chunk
        if len(head) >= len(want):
            break
    if head[: len(want)] != want:
        raise UnreadableDelta(f"{file.path}: the delta does not apply to the installed file")
    decoder = zstd.ZstdDecompressor(
        zstd.ZstdDict(old_path.read_bytes(), is_raw=True).as_prefix,
        options={zstd.DecompressionParameter.window_log_max: WINDOW_LOG},
    )
    size = 0
    data: bytes | None = head[len(want) :]
    try:
        while data is not None and not decoder.eof:
            out = decoder.decompress(data, max_length=1 << 20)
            size += len(out)
            if size > file.size:
                raise UnreadableDelta(f"{file.path}: the decoded delta exceeds the size in the manifest")
            if out:
                yield out
            data = b"" if not decoder.needs_input else next(chunks, None)
    except zstd.ZstdError as error:
        raise UnreadableDelta(f"{file.path}: invalid delta: {error}") from None

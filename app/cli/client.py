"""The command line's side of HTTP: one client that knows the server, the token, problems, jobs and lost answers."""

from __future__ import annotations

import json
import os
import secrets
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from email.message import Message
from pathlib import Path, PurePosixPath
from types import TracebackType
from typing import IO, Any
from urllib.parse import quote, unquote, urljoin

import httpx

from app.cli import variables
from app.cli.output import ProgressBar, print_status, progress_bar
from app.cli.problems import RequestFailed
from app.events.credentials import server_ssl_context
from app.model.names import did_you_mean

DEFAULT_SERVER = "http://127.0.0.1:8000"
API = "/api/v1"

MAX_ATTEMPTS = 4
"""How often a request that may be repeated is sent before its failure is told."""

RETRY_SECONDS = 0.5
"""Before the second try; doubled each time. A server's Retry-After is waited for instead, up to MAX_RETRY_SECONDS."""

MAX_RETRY_SECONDS = 30.0

POLL_SECONDS = 0.3
"""Between two looks at a job; grows to MAX_POLL_SECONDS."""

MAX_POLL_SECONDS = 2.0

STREAM_SECONDS = 60.0
"""Longest silence of a stream of events, in seconds: the server sends a comment every 15."""

MAX_NAMES = 1000
"""Names of environments that a mistyped one is compared with."""

TIMEOUT = httpx.Timeout(10.0, read=330.0, write=60.0)
"""Seconds. A conversion may take its server up to 300 seconds before it answers."""


@dataclass(slots=True)
class LocalFile:
    """A file to upload: its name there and its place here. It is open only while it is being read."""

    name: str
    path: Path
    size: int
    on_read: Callable[[int], None] = lambda _: None
    _stream: IO[bytes] | None = field(default=None, repr=False)
    _offset: int = 0

    def read(self, count: int = -1) -> bytes:
        """The next bytes; the file is closed at its end."""
        if self._stream is None:
            self._stream = self.path.open("rb")
            self._stream.seek(self._offset)
        data = self._stream.read(count)
        self._offset += len(data)
        self.on_read(len(data))
        if not data or count < 0:
            self.close()
        return data

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """As for any file; counted from the size that was seen when it was found."""
        self._offset = {os.SEEK_SET: 0, os.SEEK_CUR: self._offset, os.SEEK_END: self.size}[whence] + offset
        if self._stream is not None:
            self._stream.seek(self._offset)
        return self._offset

    def tell(self) -> int:
        """Where the next read starts."""
        return self._offset

    def close(self) -> None:
        """Give the file back."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None


@dataclass(frozen=True, slots=True)
class Download:
    """Bytes that came in: in a temporary file, with what the server said of them."""

    path: Path
    name: str
    media_type: str
    headers: Mapping[str, str]

    @property
    def is_zip(self) -> bool:
        """Whether it is several files in an archive."""
        return self.media_type == "application/zip"


class Client:
    """The server's HTTP interface. Every method raises Refused where it says no or nothing."""

    def __init__(self, server: str | None = None, token: str | None = None) -> None:
        self.server = (server or os.environ.get("FLEETMAP_SERVER") or DEFAULT_SERVER).rstrip("/")
        if "://" not in self.server:
            self.server = f"http://{self.server}"
        self.token = token or os.environ.get("FLEETMAP_TOKEN") or None
        for warning in variables.mistyped(os.environ):
            print_status(f"warning: {warning}", style="yellow")
        headers = {"User-Agent": "fleetmap"}
        if self.token:
            headers["Authorization"] = f"Bearer {self.token}"
        ca = os.environ.get("FLEETMAP_CA")
        self._http = httpx.Client(
            base_url=self.server,
            headers=headers,
            timeout=TIMEOUT,
            follow_redirects=False,
            verify=server_ssl_context(self.server, Path(ca) if ca else None),
        )

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the connections."""
        self._http.close()

    # --- JSON ---

    def get(self, path: str, params: Mapping[str, Any] | None = None) -> Any:
        """The JSON at a path below the API."""
        return self._json(self._send("GET", path, params=_present(params), repeat=True))

    def post(self, path: str, body: Mapping[str, Any], *, repeat: bool = False) -> Any:
        """Send JSON; ``repeat`` where the server recognises the same request by its Idempotency-Key."""
        headers = {"Idempotency-Key": secrets.token_hex(16)} if repeat else {}
        return self._json(self._send("POST", path, content=_present(body), headers=headers, repeat=repeat))

    def post_until_done(self, path: str, body: Mapping[str, Any]) -> Any:
        """Send JSON that may be sent again; where it becomes a job, wait for its end with a bar and send it again."""
        while True:
            answer = self._send("POST", path, content=_present(body), repeat=True)
            if answer.status_code != httpx.codes.ACCEPTED:
                return self._json(answer)
            self._wait(answer)

    def put(self, path: str, body: Mapping[str, Any], headers: Mapping[str, str] | None = None) -> Any:
        """Put JSON."""
        return self._json(self._send("PUT", path, content=_present(body), headers=headers, repeat=True))

    def patch(self, path: str, body: Mapping[str, Any]) -> Any:
        """Change some members."""
        return self._json(self._send("PATCH", path, content=_present(body)))

    def delete(
        self, path: str, params: Mapping[str, Any] | None = None, headers: Mapping[str, str] | None = None
    ) -> Any:
        """Delete what stands at a path."""
        return self._json(self._send("DELETE", path, params=_present(params), headers=headers, repeat=True))

    def pages(self, path: str, params: Mapping[str, Any], *, limit: int | None = None) -> Iterator[Any]:
        """All items of a list, or the first ``limit``; a page names the next one in ``Link: <…>; rel="next"``."""
        count, address, query = 0, path, _present(params)
        while True:
            answer = self._send("GET", address, params=query, repeat=True)
            for item in self._json(answer):
                if limit is not None and count >= limit:
                    return
                yield item
                count += 1
            if "next" not in answer.links:
                return
            address, query = urljoin(str(answer.url), answer.links["next"]["url"]), {}

    def stream(self, path: str, params: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
        """Yield server-sent events as ``{id, type, data}`` until the server ends the stream."""
        timeout = httpx.Timeout(10.0, read=STREAM_SECONDS)
        with (
            self._connect(),
            self._http.stream("GET", self._address(path), params=_present(params), timeout=timeout) as answer,
        ):
            if answer.status_code != httpx.codes.OK:
                answer.read()
                self._check(answer)
            event: dict[str, Any] = {}
            for line in answer.iter_lines():
                name, _, value = line.partition(":")
                value = value.removeprefix(" ")
                if name == "id":
                    event["id"] = int(value)
                elif name == "event":
                    event["type"] = value
                elif name == "data":
                    event["data"] = json.loads(value)
                elif not line and "data" in event:
                    yield event
                    event = {}

    # --- files ---

    def upload(self, path: str, files: Sequence[LocalFile], fields: Mapping[str, str]) -> tuple[int, Any]:
        """Post files as one multipart request with a bar, and wait for its job if it becomes one: (status, JSON).

        A lost answer is asked for again with the same Idempotency-Key, so it never becomes a second version.
        """
        headers = {"Idempotency-Key": secrets.token_hex(16)}
        with progress_bar("uploading", total=sum(f.size for f in files), count_bytes=True) as bar:
            answer = self._send("POST", path, headers=headers, repeat=True, body=lambda: _multipart(files, fields, bar))
        if answer.status_code == httpx.codes.ACCEPTED:
            job = self._wait(answer)
            return httpx.codes.CREATED, job.get("result")
        return answer.status_code, self._json(answer)

    @contextmanager
    def download(self, path: str, params: Mapping[str, Any] | None = None) -> Iterator[Download]:
        """Get a file with a bar into a temporary place that lasts as long as the block."""
        with tempfile.TemporaryDirectory(prefix="fleetmap-") as folder:
            yield self._download(path, _present(params), Path(folder) / "download")

    def _download(self, path: str, params: Mapping[str, Any], target: Path) -> Download:
        while True:
            with self._connect(), self._http.stream("GET", self._address(path), params=params or None) as answer:
                if answer.status_code == httpx.codes.OK:
                    return _receive(answer, target)
                answer.read()
                self._check(answer)
            self._wait(answer)  # made by now: asking again gets it from the cache

    # --- inside ---

    def _address(self, path: str) -> str:
        """A path below the API; whole addresses and those that start with the API's stay as they are."""
        return path if path.startswith(("http:", "https:", API, "/healthz", "/readyz")) else API + path

    def _send(
        self,
        method: str,
        path: str,
        *,
        params: Mapping[str, Any] | None = None,
        content: Any = None,
        headers: Mapping[str, str] | None = None,
        repeat: bool = False,
        body: Callable[[], dict[str, Any]] | None = None,
    ) -> httpx.Response:
        for left in range(MAX_ATTEMPTS - 1, -1, -1):
            pause = RETRY_SECONDS * 2 ** (MAX_ATTEMPTS - 1 - left)
            try:
                answer = self._http.request(
                    method,
                    self._address(path),
                    params=params or None,
                    json=content,
                    headers=headers,
                    **(body() if body else {}),
                )
            except httpx.ConnectError as error:
                raise _unreachable(self.server, error) from error
            except httpx.TransportError as error:
                if not (repeat and left):
                    raise _unreachable(self.server, error) from error
            else:
                busy = answer.status_code in (httpx.codes.SERVICE_UNAVAILABLE, httpx.codes.TOO_MANY_REQUESTS)
                if not (busy and repeat and left and "Retry-After" in answer.headers):
                    self._check(answer)
                    return answer
                pause = _seconds(answer.headers["Retry-After"], pause)
            time.sleep(pause)
        raise AssertionError("the last try returns or raises")

    def _check(self, answer: httpx.Response) -> None:
        """Raise Refused with the problem of an error, and a hint."""
        if answer.status_code < 400:
            return
        problem: Any = None
        if "json" in answer.headers.get("Content-Type", ""):
            try:
                problem = answer.json()
            except ValueError:
                problem = None
        if not isinstance(problem, dict):
            problem = {"title": answer.reason_phrase, "detail": f"{answer.url} answered {answer.status_code}"}
        hint = _hint(answer, self.token)
        if answer.status_code == httpx.codes.NOT_FOUND and "no environment" in str(problem.get("detail")):
            hint = self._other_environments(answer.url)
        raise RequestFailed(problem, status=answer.status_code, hint=hint)

    def _other_environments(self, url: httpx.URL) -> str:
        """Return the environment that a mistyped one probably means; only those that the token may see."""
        environment = unquote(
            url.params.get("environment") or url.path.removeprefix(f"{API}/environments/").split("/")[0]
        )
        near = ""
        if url.path != f"{API}/environments":
            with suppress(RequestFailed):
                near = did_you_mean(
                    environment, (row["name"] for row in self.pages("/environments", {}, limit=MAX_NAMES))
                )
        question = near.strip(" ()").capitalize()
        return f"{question} `fleetmap environment list` lists all.".strip()

    @contextmanager
    def _connect(self) -> Iterator[None]:
        try:
            yield
        except httpx.TransportError as error:
            raise _unreachable(self.server, error) from error

    def _json(self, answer: httpx.Response) -> Any:
        if not answer.content:
            return None
        try:
            return answer.json()
        except ValueError as error:
            detail = f"{answer.url} does not answer as a Fleet Map Server: its answer is no JSON"
            raise RequestFailed(
                {"title": "Not a Fleet Map Server", "detail": detail}, status=answer.status_code
            ) from error

    def _wait(self, answer: httpx.Response) -> dict[str, Any]:
        """Follow a job to its end with a bar; Refused with the job's problem where it fails."""
        location = answer.headers.get("Location")
        if answer.status_code != httpx.codes.ACCEPTED or not location:
            detail = f"unexpected answer {answer.status_code} of {answer.url}"
            raise RequestFailed({"title": "Unexpected answer", "detail": detail}, status=answer.status_code)
        location, pause = urljoin(str(answer.url), location), POLL_SECONDS
        with progress_bar("waiting", total=1.0) as bar:
            while True:
                job: dict[str, Any] = self.get(location)
                bar.update(
                    completed=float(job.get("progress") or 0), description=str(job.get("detail") or job["state"])
                )
                if job["state"] == "done":
                    return job
                if job["state"] in ("failed", "cancelled"):
                    problem = job.get("problem") or {
                        "title": f"The job was {job['state']}",
                        "detail": job.get("detail"),
                    }
                    raise RequestFailed(problem, status=problem.get("status"))
                time.sleep(pause)
                pause = min(MAX_POLL_SECONDS, pause * 1.5)


def quote_path(*parts: Any) -> str:
    """A path below the API from its parts, each quoted whole."""
    return "/" + "/".join(quote(str(part), safe="") for part in parts)


def _multipart(files: Sequence[LocalFile], fields: Mapping[str, str], bar: ProgressBar) -> dict[str, Any]:
    bar.update(completed=0)
    for file in files:
        file.on_read = bar.advance
        file.seek(0)
    return {"data": dict(fields), "files": [("files", (f.name, f, "application/octet-stream")) for f in files]}


def _receive(answer: httpx.Response, target: Path) -> Download:
    length = answer.headers.get("Content-Length", "")
    total = int(length) if length.isdigit() and not answer.headers.get("Content-Encoding") else None
    with progress_bar("downloading", total=total, count_bytes=True) as bar, target.open("wb") as stream:
        for chunk in answer.iter_bytes(1 << 16):
            stream.write(chunk)
            bar.advance(len(chunk))
    media_type = answer.headers.get("Content-Type", "application/octet-stream").split(";")[0].strip().lower()
    return Download(target, _file_name(answer), media_type, dict(answer.headers))


def _file_name(answer: httpx.Response) -> str:
    """The name the server gave, without any folder: it decides no place on this machine."""
    message = Message()
    message["Content-Disposition"] = answer.headers.get("Content-Disposition", "")
    named = message.get_filename() or PurePosixPath(answer.url.path).name
    name = PurePosixPath(named.replace("\\", "/")).name
    return name if name not in ("", ".", "..") and name.isprintable() else "map"


def _present(members: Mapping[str, Any] | None) -> dict[str, Any]:
    return {name: value for name, value in (members or {}).items() if value is not None}


def _seconds(retry_after: str, otherwise: float) -> float:
    try:
        return min(MAX_RETRY_SECONDS, max(0.0, float(retry_after)))
    except ValueError:
        return otherwise


def _unreachable(server: str, error: httpx.TransportError) -> RequestFailed:
    detail = f"no answer from {server}: {error or type(error).__name__}"
    hint = "Is it running? Start it with `fleetmap serve`, or name another with --server or FLEETMAP_SERVER."
    return RequestFailed({"title": "Server unreachable", "detail": detail}, hint=hint)


def _hint(answer: httpx.Response, token: str | None) -> str:
    """Return what to do about an error on the command line."""
    if answer.status_code == httpx.codes.UNAUTHORIZED and token:
        return "Give another with --token or FLEETMAP_TOKEN."
    if answer.status_code == httpx.codes.UNAUTHORIZED:
        return "Give a token with --token or FLEETMAP_TOKEN; the server's first start printed the administrator's."
    return ""

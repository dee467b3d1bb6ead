"""HTTP client of the command line: server address, token, problems, jobs and retries."""

from __future__ import annotations

import json
import os
import re
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

from app.bearer import authorization
from app.cli import variables
from app.cli.output import ProgressBar, print_status, progress_bar
from app.cli.problems import RequestFailed
from app.events.credentials import server_ssl_context
from app.model.names import did_you_mean

DEFAULT_SERVER = "http://127.0.0.1:8000"
API = "/api/v1"

MAX_ATTEMPTS = 4
"""Maximum number of attempts of a repeatable request."""

RETRY_SECONDS = 0.5
"""Pause before the second attempt; doubles each time. A Retry-After replaces it, up to MAX_RETRY_SECONDS."""

MAX_RETRY_SECONDS = 30.0

POLL_SECONDS = 0.3
"""First interval between two polls of a job; grows to MAX_POLL_SECONDS."""

MAX_POLL_SECONDS = 2.0

STREAM_SECONDS = 60.0
"""Maximum time without data on an event stream; the server sends a comment every 15 seconds."""

UNKNOWN_ENVIRONMENT = re.compile(r"(no|unknown) environment\b")
"""Pattern in the detail of a 404 response for an unknown environment."""

MAX_NAMES = 1000
"""Maximum number of environments to compare a mistyped name with."""

TIMEOUT = httpx.Timeout(10.0, read=330.0, write=60.0)
"""Timeouts in seconds. A conversion may take up to 300 seconds until the server responds."""


@dataclass(slots=True)
class LocalFile:
    """File to upload, with its name on the server and its local path. Open only while it is read."""

    name: str
    path: Path
    size: int
    on_read: Callable[[int], None] = lambda _: None
    _stream: IO[bytes] | None = field(default=None, repr=False)
    _offset: int = 0

    def read(self, count: int = -1) -> bytes:
        """Read the next bytes. The file is closed at its end."""
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
        """Set the position of the next read. The end is at ``size``, which may differ from the size on disk."""
        self._offset = {os.SEEK_SET: 0, os.SEEK_CUR: self._offset, os.SEEK_END: self.size}[whence] + offset
        if self._stream is not None:
            self._stream.seek(self._offset)
        return self._offset

    def tell(self) -> int:
        """Return the position of the next read."""
        return self._offset

    def close(self) -> None:
        """Close the file."""
        if self._stream is not None:
            self._stream.close()
            self._stream = None


@dataclass(frozen=True, slots=True)
class Download:
    """Downloaded file in a temporary folder, with the response headers."""

    path: Path
    name: str
    media_type: str
    headers: Mapping[str, str]

    @property
    def is_zip(self) -> bool:
        """Whether it is a ZIP archive of several files."""
        return self.media_type == "application/zip"


class Client:
    """HTTP client of a server. All methods raise RequestFailed for error responses and failed connections."""

    def __init__(self, server: str | None = None, token: str | None = None) -> None:
        self.server = (server or os.environ.get("FLEETMAP_SERVER") or DEFAULT_SERVER).rstrip("/")
        if "://" not in self.server:
            self.server = f"http://{self.server}"
        self.token = token or os.environ.get("FLEETMAP_TOKEN") or None
        for warning in variables.mistyped(os.environ):
            print_status(f"warning: {warning}", style="yellow")
        headers = {"User-Agent": "fleetmap"}
        if self.token:
            headers["Authorization"] = authorization(self.token)
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
        """Close the connections."""
        self._http.close()

    # --- JSON ---

    def get(self, path: str, params: Mapping[str, Any] | None = None) -> Any:
        """Get JSON from a path below the API."""
        return self._json(self._send("GET", path, params=_present(params), repeat=True))

    def post(self, path: str, body: Mapping[str, Any], *, repeat: bool = False) -> Any:
        """Post JSON. repeat: retry with an Idempotency-Key, which the server must support at this path."""
        headers = {"Idempotency-Key": secrets.token_hex(16)} if repeat else {}
        return self._json(self._send("POST", path, content=_present(body), headers=headers, repeat=repeat))

    def post_until_done(self, path: str, body: Mapping[str, Any]) -> Any:
        """Post JSON. If the server starts a job, wait for its end with a progress bar and post again."""
        while True:
            answer = self._send("POST", path, content=_present(body), repeat=True)
            if answer.status_code != httpx.codes.ACCEPTED:
                return self._json(answer)
            self._wait(answer)

    def post_work(self, path: str, body: Mapping[str, Any], description: str) -> Any:
        """Post a derivation or generation, with a progress bar while the server works, or its workers do."""
        key = {"Idempotency-Key": secrets.token_hex(16)}
        prefer = {} if body.get("dry_run") else {"Prefer": "respond-async"}
        with progress_bar(description):
            answer = self._send("POST", path, content=_present(body), headers={**key, **prefer}, repeat=True)
        if answer.status_code != httpx.codes.ACCEPTED:
            return self._json(answer)
        self._wait(answer)
        return self._json(self._send("POST", path, content=_present(body), headers=key, repeat=True))  # its result

    def put(self, path: str, body: Mapping[str, Any], headers: Mapping[str, str] | None = None) -> Any:
        """Put JSON at a path below the API."""
        return self._json(self._send("PUT", path, content=_present(body), headers=headers, repeat=True))

    def patch(self, path: str, body: Mapping[str, Any]) -> Any:
        """Patch a resource with a JSON body."""
        return self._json(self._send("PATCH", path, content=_present(body)))

    def delete(
        self, path: str, params: Mapping[str, Any] | None = None, headers: Mapping[str, str] | None = None
    ) -> Any:
        """Delete the resource at a path."""
        return self._json(self._send("DELETE", path, params=_present(params), headers=headers, repeat=True))

    def pages(self, path: str, params: Mapping[str, Any], *, limit: int | None = None) -> Iterator[Any]:
        """Yield the items of a paginated list, at most ``limit``; follows ``Link: <…>; rel="next"``."""
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
            if not answer.headers.get("content-type", "").startswith("text/event-stream"):
                raise _not_ours(answer, "no stream of events")
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
        """Post files as one multipart request with a progress bar; wait for its job if it starts one.

        Returns status and JSON. If the response is lost, the request is repeated with the same Idempotency-Key, so that
        it creates one version only.
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
        """Download a file with a progress bar to a temporary folder, which is removed after the ``with`` block."""
        with tempfile.TemporaryDirectory(prefix="fleetmap-") as folder:
            yield self._download(path, _present(params), Path(folder) / "download")

    def _download(self, path: str, params: Mapping[str, Any], target: Path) -> Download:
        while True:
            with self._connect(), self._http.stream("GET", self._address(path), params=params or None) as answer:
                if answer.status_code == httpx.codes.OK:
                    return _receive(answer, target)
                answer.read()
                self._check(answer)
            self._wait(answer)  # the map is cached then: request it again

    # --- internals ---

    def _address(self, path: str) -> str:
        """Prefix a path with the API's; complete addresses and prefixed paths stay unchanged."""
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
        raise AssertionError("the last attempt returns or raises")

    def _check(self, answer: httpx.Response) -> None:
        """Raise RequestFailed with problem and hint for an error response."""
        if answer.status_code < 400:
            return
        problem: Any = None
        if "json" in answer.headers.get("Content-Type", ""):
            try:
                problem = answer.json()
            except ValueError:
                problem = None
        if not isinstance(problem, dict):
            problem = {"title": answer.reason_phrase, "detail": f"{answer.url} returned status {answer.status_code}"}
        hint = _hint(answer, self.token)
        if answer.status_code == httpx.codes.NOT_FOUND and UNKNOWN_ENVIRONMENT.search(str(problem.get("detail"))):
            hint = self._other_environments(answer.url)
        raise RequestFailed(problem, status=answer.status_code, hint=hint)

    def _other_environments(self, url: httpx.URL) -> str:
        """Return a hint with the most similar environment that the token can access."""
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
        return f"{question} List all with `fleetmap environment list`.".strip()

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
            raise _not_ours(answer, "not JSON") from error

    def _wait(self, answer: httpx.Response) -> dict[str, Any]:
        """Wait for a job with a progress bar and return it. Raises RequestFailed with its problem if it fails."""
        location = answer.headers.get("Location")
        if answer.status_code != httpx.codes.ACCEPTED or not location:
            detail = f"unexpected status {answer.status_code} from {answer.url}"
            raise RequestFailed({"title": "Unexpected response", "detail": detail}, status=answer.status_code)
        location, pause = urljoin(str(answer.url), location), POLL_SECONDS
        with progress_bar("waiting", total=1.0) as bar:
            while True:
                job: dict[str, Any] = self.get(location)
                description = ": ".join(str(text) for text in (job.get("detail"), job.get("step")) if text)
                bar.update(completed=float(job.get("progress") or 0), description=description or job["state"])
                if job["state"] == "done":
                    return job
                if job["state"] in ("failed", "cancelled"):
                    problem = job.get("problem") or {
                        "title": f"Job {job['state']}",
                        "detail": job.get("detail"),
                    }
                    raise RequestFailed(problem, status=problem.get("status"))
                time.sleep(pause)
                pause = min(MAX_POLL_SECONDS, pause * 1.5)


def quote_path(*parts: Any) -> str:
    """Join percent-encoded parts to a path below the API."""
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
    """Return the file name from the server, without folders, so that the server cannot choose a local path."""
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


def _not_ours(answer: httpx.Response, reason: str) -> RequestFailed:
    detail = f"unexpected response from {answer.url} ({reason}): check the address of the Fleet Map Server"
    return RequestFailed({"title": "Not a Fleet Map Server", "detail": detail}, status=answer.status_code)


def _unreachable(server: str, error: httpx.TransportError) -> RequestFailed:
    detail = f"no response from {server}: {error or type(error).__name__}"
    hint = "Start the server with `fleetmap serve`, or set the address of another one with --server or FLEETMAP_SERVER."
    return RequestFailed({"title": "Server unreachable", "detail": detail}, hint=hint)


def _hint(answer: httpx.Response, token: str | None) -> str:
    """Return a hint for the command line, empty if there is none."""
    if answer.status_code == httpx.codes.UNAUTHORIZED and token:
        return "Set another token with --token or FLEETMAP_TOKEN."
    if answer.status_code == httpx.codes.UNAUTHORIZED:
        return "Set a token with --token or FLEETMAP_TOKEN; the first start of the server printed the administrator's."
    return ""

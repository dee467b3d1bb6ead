"""HTTP client of a centre. States are accepted only if its key has signed them for this request, content by hash."""

from __future__ import annotations

import base64
import contextlib
import json
import secrets
import zlib
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from typing import Any, Final
from urllib.parse import quote

import httpx

from app.agent import signatures
from app.bearer import authorization
from app.errors import Conflict, Denied, FleetMapError, NotFound, Unauthenticated, Unavailable, Untrusted
from app.store.mirror_source import SIGNATURE
from app.store.values import rfc3339

API: Final = "/api/v1"
MAX_PAGE_BYTES: Final = 512 * 2**20
PIECE_BYTES: Final = 2**20
"""Maximum size of a decoded piece of a body, however small it was packed."""

TIMEOUT: Final = httpx.Timeout(10.0, read=60.0)
STREAM_SECONDS: Final = 60.0
"""Maximum time without data on the stream of events; a server sends a comment every 15 seconds."""


class CentreUnreachable(Unavailable):
    """No connection to the centre: nothing else can succeed now."""


class Centre:
    """A centre, with the token of this mirror. Not thread-safe, but for ``wait_for_event``.

    received, sent: bytes of bodies as transferred, without the stream of events.
    key: its trusted raw public key; None before the first contact, at which ``given`` (an id, or the key in base64) or
    else the first key is trusted.
    """

    def __init__(
        self,
        url: str,
        token: str,
        *,
        key: bytes | None = None,
        given: str | None = None,
        client: httpx.Client | None = None,
    ) -> None:
        self.url, self.key, self._given = url.rstrip("/"), key, given
        self._http = client or httpx.Client(timeout=TIMEOUT)
        self._headers = {"authorization": authorization(token), "accept-encoding": "gzip"}
        self.received = self.sent = 0

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    # --- what is signed ---

    def listing(self, position: int = 0) -> dict[str, Any]:
        """Read the environments that may be mirrored; null if the log still ends at a position.

        Raises Untrusted, Denied or Unavailable.
        """
        return self._signed("/mirror", {"position": position})

    def page(self, environment: str, after: int, sequence: int, thinned: datetime | None = None) -> dict[str, Any]:
        """Read what follows a version and an event, and what was thinned since.

        Raises NotFound, Untrusted, Denied or Unavailable.
        """
        path = f"/environments/{quote(environment, safe='')}/mirror"
        since = {} if thinned is None else {"thinned": rfc3339(thinned)}
        return self._signed(path, {"after": after, "sequence": sequence, **since})

    def _signed(self, path: str, query: Mapping[str, Any]) -> dict[str, Any]:
        nonce = secrets.token_urlsafe(24)
        data, headers = self._read("GET", path, params={**query, "nonce": nonce})
        key = self.verify(data, headers.get(SIGNATURE, ""))
        try:
            body = json.loads(data)
        except ValueError as error:
            raise Untrusted(f"{self.url} has signed no JSON: {error}") from error
        if not isinstance(body, dict) or body.get("nonce") != nonce:
            raise Untrusted(f"{self.url} returned the answer to another request: check the proxies in between")
        self.key = key
        return body

    def verify(self, data: bytes, signature: str) -> bytes:
        """Verify a signature by the trusted key or one that it endorses; returns that key. Raises Untrusted."""
        try:
            return signatures.verify_signature(data, signature, self.key, self._given, self.keys)
        except Untrusted as error:
            raise Untrusted(
                f"{self.url} is not the centre that this server follows, or its answer was changed: {error.detail}"
            ) from error

    def keys(self) -> list[dict[str, Any]]:
        """List the public keys, newest first. Each endorses its successor; nothing else vouches for them."""
        data, _ = self._read("GET", "/keys")
        lines = self._parsed(data)
        return [line for line in lines if isinstance(line, dict)] if isinstance(lines, list) else []

    # --- content ---

    @contextlib.contextmanager
    def content(self, environment: str, body: Mapping[str, Any]) -> Iterator[Iterator[bytes]]:
        """Request chunks and files of versions, as a stream of bytes. Raises NotFound, Denied or Unavailable."""
        path = f"{API}/environments/{quote(environment, safe='')}/mirror/content"
        with (
            self._errors(),
            self._http.stream("POST", self.url + path, json=body, headers=self._headers) as answer,
        ):
            if answer.status_code != 200:
                raise self._problem(answer, self._body(answer))
            try:
                yield self._pieces(answer)
            finally:
                self._count(answer)

    # --- what the mirror hands on ---

    def report(
        self, environment: str, *, statuses: Sequence[Mapping[str, Any]] = (), changes: Sequence[Mapping[str, Any]] = ()
    ) -> dict[str, Any]:
        """Hand on statuses of robots and changes of overlays; returns the outcome of each."""
        path = f"/environments/{quote(environment, safe='')}/mirror/reports"
        data, _ = self._read("POST", path, json={"statuses": list(statuses), "changes": list(changes)})
        outcome = self._parsed(data)
        if len(outcome["statuses"]) != len(statuses) or len(outcome["changes"]) != len(changes):
            raise Unavailable(f"{self.url} answered for another number of reports: they will be sent again")
        return dict(outcome)

    def delegate(self, public: bytes, environments: Sequence[str]) -> list[dict[str, Any]]:
        """Request statements that a key may sign the manifests of environments."""
        body = {"public_key": base64.b64encode(public).decode(), "environments": list(environments)}
        data, _ = self._read("POST", "/mirror/delegations", json=body)
        return list(self._parsed(data))

    def wait_for_event(self, position: int) -> bool:
        """Wait until the centre has an event after a position of its log; False if the connection ends before."""
        timeout = httpx.Timeout(10.0, read=STREAM_SECONDS)
        with (
            contextlib.suppress(httpx.HTTPError, FleetMapError),
            self._http.stream(
                "GET", f"{self.url}{API}/events", params={"since": position}, headers=self._headers, timeout=timeout
            ) as answer,
        ):
            if answer.status_code == 200:
                last = b""
                for piece in self._pieces(answer):
                    *lines, last = (last + piece).split(b"\n")
                    if any(line.startswith(b"data:") for line in lines):
                        return True
                    last = last[: len(b"data:")]  # all that matters of a line, which may be endless
        return False

    def _parsed(self, data: bytes) -> Any:
        try:
            return json.loads(data)
        except ValueError as error:
            raise Unavailable(f"{self.url} returned no JSON: check the proxies in between") from error

    def _read(self, method: str, path: str, **more: Any) -> tuple[bytes, httpx.Headers]:
        with (
            self._errors(),
            self._http.stream(method, self.url + API + path, headers=self._headers, **more) as answer,
        ):
            data = self._body(answer)
            self._count(answer)
            if answer.status_code != 200:
                raise self._problem(answer, data)
            return data, answer.headers

    def _body(self, answer: httpx.Response) -> bytes:
        data = bytearray()
        for piece in self._pieces(answer):
            data += piece
            if len(data) > MAX_PAGE_BYTES:
                raise Untrusted(f"{self.url} sent more than {MAX_PAGE_BYTES} bytes: this is no Fleet Map Server")
        return bytes(data)

    def _pieces(self, answer: httpx.Response) -> Iterator[bytes]:
        """Iterate over a body. httpx would decode each piece as a whole: 1 KiB may unpack to gigabytes.

        Raises Untrusted for a coding that was not requested, Unavailable if the body is damaged or ends early.
        """
        coding = answer.headers.get("content-encoding", "identity").lower()
        if coding == "identity":
            yield from answer.iter_raw()
            return
        if coding != "gzip":
            raise Untrusted(f"{self.url} used the Content-Encoding {coding[:80]!r}, which was not requested")
        decoder = zlib.decompressobj(wbits=16 + zlib.MAX_WBITS)
        try:
            for raw in answer.iter_raw():
                packed = raw
                while packed and not decoder.eof:
                    if piece := decoder.decompress(packed, PIECE_BYTES):
                        yield piece
                    packed = decoder.unconsumed_tail
            if piece := decoder.flush():
                yield piece
        except zlib.error as error:
            raise Unavailable(f"{self.url} sent a damaged body: {error}") from error
        if not decoder.eof:
            raise Unavailable(f"{self.url} sent a body that ended early")

    def _count(self, answer: httpx.Response) -> None:
        self.received += answer.num_bytes_downloaded
        self.sent += len(answer.request.content)

    @contextlib.contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except (httpx.ConnectError, httpx.ConnectTimeout, httpx.InvalidURL, httpx.UnsupportedProtocol) as error:
            raise CentreUnreachable(f"no connection to {self.url}: {type(error).__name__}: {error}") from error
        except httpx.HTTPError as error:
            raise Unavailable(f"no connection to {self.url}: {type(error).__name__}: {error}") from error

    def _problem(self, answer: httpx.Response, data: bytes) -> FleetMapError:
        """Return the error of a response."""
        try:
            detail = str(json.loads(data)["detail"])
        except (ValueError, KeyError, TypeError):
            detail = f"status {answer.status_code}"
        text = f"{self.url}: {detail[:500]}"
        if answer.status_code == 401:
            return Unauthenticated(f"{text} (create a token there with `fleetmap token create NAME --role mirror`)")
        kinds: dict[int, type[FleetMapError]] = {403: Denied, 404: NotFound, 409: Conflict}
        return kinds.get(answer.status_code, Unavailable)(text)

"""Middleware in front of all routes: token check, limits on size and pace of bodies, uniform errors.

Plain ASGI: it costs a few microseconds and lets bodies stream.
"""

from __future__ import annotations

import asyncio
import logging
import re
import secrets
import time

from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.responses import Response
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app import traces
from app.api.http import problems
from app.api.http.auth import (
    ANONYMOUS_VIEWER,
    BASIC_CHALLENGE,
    MAX_SOURCES,
    OGC,
    OPEN_CALLS,
    SAFE_METHODS,
    Credentials,
    Principal,
    authorise,
    check_same_origin,
    client_source,
    environment_in_path,
    is_basic,
    is_open,
)
from app.api.http.dependencies import Services
from app.api.http.problems import SlowBody, UnsupportedMedia
from app.api.http.signed import LINK, request_link
from app.api.http.single_flight import SingleFlight
from app.errors import FleetMapError, TooLarge, Unauthenticated
from app.logs import REQUEST_ID, log_request
from app.store.audit import CALLER, Caller

log = logging.getLogger("app.requests")

MAX_OPEN_BODY_BYTES = 4096
"""Maximum size of a body that anyone may send: a sign-in, in bytes."""

MULTIPART_OVERHEAD = 2**20
"""Maximum size of a multipart body beside its files: field values and the headers of parts, in bytes."""

PART_OVERHEAD = 1024
_BODY = frozenset({"POST", "PUT", "PATCH"})
_METHODS = frozenset({"GET", "DELETE", "OPTIONS", *_BODY})

_REQUEST_ID = re.compile(rb"[A-Za-z0-9._-]{1,64}")
_REPORT = re.compile(r"/api/v1/robots/[^/]+/(?:status|vda5050/state)")
"""Reports of robots: they change neither maps nor access, and are too frequent for the audit log."""

MAX_LOGGED_PATH = 300
"""Maximum number of characters of a path in the log."""

MAX_LOGGED_REJECTIONS = 20
"""Maximum number of logged refusals per source and minute; further ones have level DEBUG."""

SLOW_SECONDS = 1.0
"""Minimum duration of requests that are logged like changes, in seconds."""


class _Disconnected(Exception):
    """The client disconnected before the end of its body."""


class Guard:
    """ASGI middleware; looks up ``app.state.services`` for each request."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app
        self._checks: SingleFlight[tuple[Credentials, int], Principal] = SingleFlight()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle a request, or pass it on."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        services: Services = scope["app"].state.services
        started = time.perf_counter()
        head_only = scope["method"] == "HEAD"
        scope.setdefault("state", {})
        if head_only:
            # Handle HEAD as GET without a body; routes that treat HEAD specially read it from the state.
            scope = {**scope, "method": "GET", "state": {**scope["state"], "head": True}}
        headers = _headers(scope)
        given = headers.get(b"x-request-id", b"")
        request_id = given.decode() if _REQUEST_ID.fullmatch(given) else secrets.token_hex(8)
        REQUEST_ID.set(request_id)
        answer = _ResponseSender(send, head_only, request_id)
        with traces.request_span(scope["method"], scope["path"], headers) as span:
            try:
                await self._handle(scope, _RequestBody(receive, services), answer, started)
            finally:
                traces.end_request(span, scope["method"], _route(scope), answer.status)

    async def _handle(self, scope: Scope, body: _RequestBody, answer: _ResponseSender, started: float) -> None:
        services: Services = scope["app"].state.services
        reason = ""
        try:
            await self._pass(scope, body, answer, services)
        except _Disconnected:
            return
        except FleetMapError as error:
            reason = error.detail
            response = problems.error_response(error)
            if response.status_code == 401 and scope["path"].startswith(OGC):
                response.headers["www-authenticate"] = BASIC_CHALLENGE
            await self._reject(response, scope, body, answer)
        except HTTPException as error:
            reason = str(error.detail)
            await self._reject(problems.http_error_response(error), scope, body, answer)
        except asyncio.CancelledError:
            raise
        except Exception as error:  # noqa: BLE001  the last place where a bug can become a 500 with a shape
            await self._reject(problems.internal_error_response(error), scope, body, answer)
        finally:
            route = _route(scope)
            method = scope["method"] if scope["method"] in _METHODS else "other"
            services.metrics.requests.labels(method, route, str(answer.status)).inc()
            seconds = time.perf_counter() - started
            services.metrics.seconds.labels(route).observe(seconds)
            _log(scope, answer.status, seconds, reason)

    async def _pass(self, scope: Scope, body: _RequestBody, answer: _ResponseSender, services: Services) -> None:
        headers = _headers(scope)
        services.access.check_origin(scope["headers"])
        if is_open(scope["path"], scope["method"]):
            # Do not read the body: anyone can send one, and only the sign-in takes one.
            if (scope["method"], scope["path"]) in OPEN_CALLS and body.check_headers(
                scope, headers, MAX_OPEN_BODY_BYTES
            ):
                await body.preload()
            await self._app(scope, body, answer)
            return
        principal = await self._principal(scope, services)
        if scope["method"] not in SAFE_METHODS:
            if principal is ANONYMOUS_VIEWER:
                raise Unauthenticated("a change requires a token: sign in, or send 'Authorization: Bearer <token>'")
            if principal.session_ends is not None:
                check_same_origin(scope, required=True)
            elif is_basic(headers.get(b"authorization", b"")):  # browsers add it by themselves, like a session
                check_same_origin(scope, required=False)
        environment = environment_in_path(scope["path"])
        authorise(scope, principal, environment)
        scope["state"]["principal"] = principal
        CALLER.set(_caller(scope, principal, environment))
        if scope["method"] in _BODY and body.check_headers(scope, headers):
            await body.preload()
        await self._app(scope, body, answer)

    async def _principal(self, scope: Scope, services: Services) -> Principal:
        """Authenticate by signed link, else by token or session. A token beside a link is ignored."""
        credentials = Credentials.from_scope(scope)
        link = request_link(scope)
        if link is not None:
            scope["state"][LINK] = link
            return await run_in_threadpool(services.links.check, link, credentials.client)
        principal = services.access.cached_principal(credentials)
        if principal is None:
            key = (credentials, services.response_cache.generation())
            principal = await self._checks.run(key, services.access.authenticate, credentials)
        return principal

    async def _reject(self, response: Response, scope: Scope, body: _RequestBody, answer: _ResponseSender) -> None:
        if answer.started:
            # The response has started: the only correct end is a broken connection.
            raise ConnectionAbortedError("internal error after the start of the response")
        await response(scope, body, answer)


def _route(scope: Scope) -> str:
    """Return the path template of the route that responded, ``other`` if none did."""
    return str(scope["state"].get("route") or getattr(scope.get("route"), "path", "")) or "other"


def _caller(scope: Scope, principal: Principal, environment: str | None) -> Caller | None:
    """Build the author of a change for the audit log; None for requests that are not logged there."""
    path = scope["path"]
    if scope["method"] in ("GET", "OPTIONS") or _REPORT.fullmatch(path):
        return None
    return Caller(
        principal.id,
        principal.name,
        principal.role,
        _address(scope),
        REQUEST_ID.get(),
        scope["method"],
        path,
        environment,
    )


def _address(scope: Scope) -> str:
    client = scope.get("client")
    return str(client[0]) if client else "-"


class _Quota:
    """Limit on warnings per source and minute, so that unauthenticated clients cannot fill the log."""

    def __init__(self) -> None:
        self._counts: dict[str, int] = {}
        self._minute = 0

    def allow(self, source: str) -> bool:
        """Count one refusal; return whether it is within the limit of this minute."""
        minute = int(time.monotonic() // 60)
        if minute != self._minute or len(self._counts) > MAX_SOURCES:
            self._counts, self._minute = {}, minute
        self._counts[source] = self._counts.get(source, 0) + 1
        return self._counts[source] <= MAX_LOGGED_REJECTIONS


_rejections = _Quota()


def _log(scope: Scope, status: int, seconds: float, reason: str) -> None:
    """Log a request: refusals and failures as WARNING, changes and slow requests as INFO, others as DEBUG."""
    changes = scope["method"] not in ("GET", "OPTIONS") and not _REPORT.fullmatch(scope["path"])
    starting = status == 503 and scope["path"] == "/readyz"  # later failures are logged by their cause
    if (status >= 500 and not starting) or (
        status in (401, 403, 429) and _rejections.allow(client_source(_address(scope)))
    ):
        level = logging.WARNING
    elif changes or seconds > SLOW_SECONDS:
        level = logging.INFO
    else:
        level = logging.DEBUG
    if not log.isEnabledFor(level):
        return
    principal = scope["state"].get("principal")
    fields = {
        "method": scope["method"],
        "path": scope["path"][:MAX_LOGGED_PATH],
        "status": status,
        "ms": round(seconds * 1000, 1),
        "token": principal.name if principal else "",
        "token_id": principal.id if principal else "",
        "role": principal.role if principal else "",
        "address": _address(scope),
        "reason": reason,
    }
    log_request(log, level, fields)


def _headers(scope: Scope) -> dict[bytes, bytes]:
    return dict(scope["headers"])


class _ResponseSender:
    """Wrapper of ``send``: records the status, adds headers, and drops the body of a HEAD."""

    __slots__ = ("_head_only", "_request_id", "_send", "started", "status")

    def __init__(self, send: Send, head_only: bool, request_id: str) -> None:
        self._send, self._head_only, self._request_id = send, head_only, request_id.encode()
        self.started, self.status = False, 0

    async def __call__(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            self.started, self.status = True, message["status"]
            headers = list(message.get("headers", ()))
            names = {name for name, _ in headers}
            if b"x-content-type-options" not in names:
                headers.append((b"x-content-type-options", b"nosniff"))
            if b"cache-control" not in names:
                headers.append((b"cache-control", b"no-cache"))
            headers.append((b"x-request-id", self._request_id))
            message = {**message, "headers": headers}
        elif self._head_only and message["type"] == "http.response.body":
            if message.get("more_body", False):
                return
            message = {"type": "http.response.body", "body": b"", "more_body": False}
        await self._send(message)


class _RequestBody:
    """Wrapper of ``receive``: counts bytes and enforces the pace."""

    __slots__ = (
        "_complete",
        "_declared",
        "_limit",
        "_loaded",
        "_receive",
        "_received",
        "_services",
        "_started",
        "content",
    )

    def __init__(self, receive: Receive, services: Services) -> None:
        self._receive, self._services = receive, services
        self._limit = services.options.max_json_bytes
        self._received, self._started, self._complete = 0, time.monotonic(), False
        self._declared: int | None = 0
        self._loaded: Message | None = None
        self.content = "request body"

    def check_headers(self, scope: Scope, headers: dict[bytes, bytes], limit: int | None = None) -> bool:
        """Check the declared coding, media type and length; return whether to read the body at once.

        limit: a lower maximum size than that of other calls, in bytes.
        """
        self._limit = self._limit if limit is None else min(self._limit, limit)
        coding = headers.get(b"content-encoding", b"identity").strip().lower()
        length = headers.get(b"content-length")
        self._declared = int(length) if length is not None and length.isdigit() else None
        if length is None and b"transfer-encoding" not in headers:
            self._declared = 0
        if coding not in (b"", b"identity"):
            raise UnsupportedMedia(
                f"unsupported Content-Encoding {coding.decode('latin-1')[:40]}: send the plain bytes (an "
                "archive may be sent as a .zip file)"
            )
        if self._declared == 0:
            return False
        media = headers.get(b"content-type", b"").partition(b";")[0].strip().lower().decode("latin-1")
        upload = accepts_files(scope["path"])
        if media == "multipart/form-data" and upload:
            limits = self._services.options.limits
            self.content = "upload"
            # The size of part headers is limited by the parser; this is only an upper bound.
            parts = min(limits.files, 100_000)
            self._limit = limits.upload_bytes + MULTIPART_OVERHEAD + parts * PART_OVERHEAD
        elif not (media == "application/json" or (media.startswith("application/") and media.endswith("+json"))):
            takes = "multipart/form-data or application/json" if upload else "application/json"
            raise UnsupportedMedia(
                f"unsupported media type {media[:80] or 'none (Content-Type is missing)'}: send {takes}"
            )
        if self._declared is not None and self._declared > self._limit:
            raise self._too_large()
        return self.content != "upload"

    async def preload(self) -> None:
        """Read the complete body, so that errors occur before a route parses half of it."""
        chunks = []
        while not self._complete:
            chunks.append((await self()).get("body", b""))
        self._loaded = {"type": "http.request", "body": b"".join(chunks), "more_body": False}

    async def __call__(self) -> Message:
        if self._loaded is not None:
            message, self._loaded = self._loaded, None
            return message
        if self._declared == 0 or self._complete:
            return await self._receive()
        pause, pace = self._services.options.body_seconds, self._services.options.body_pace
        late = self._started + pause + self._received / pace - time.monotonic()
        try:
            async with asyncio.timeout(min(pause, max(0.001, late))):
                message = await self._receive()
        except TimeoutError:
            raise SlowBody(
                f"the {self.content} stopped arriving, or is slower than {pace} bytes per second: send it again"
            ) from None
        if message["type"] == "http.disconnect":
            raise _Disconnected
        self._received += len(message.get("body", b""))
        self._complete = not message.get("more_body", False)
        if self._received > self._limit:
            raise self._too_large()
        return message

    def _too_large(self) -> TooLarge:
        return TooLarge(
            f"the {self.content} is larger than {self._limit} bytes: send less, or ask the operator to raise the limit"
        )


def accepts_files(path: str) -> bool:
    """Test if this path accepts file uploads."""
    parts = path.split("/")
    if path == "/api/v1/convert":
        return True
    return len(parts) == 6 and parts[:4] == ["", "api", "v1", "environments"] and parts[5] == "versions"

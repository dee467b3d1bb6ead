"""RFC 9457: every error of the server in one wire shape, ``application/problem+json``.

``{type, title, status, detail, errors?: [{file?, line?, where?, problem}]}``. The table below is the only place that
knows which class of error has which status.
"""

from __future__ import annotations

import errno
import logging
import threading
import time
import traceback
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from pathlib import PurePath
from typing import Any

import orjson
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.responses import Response

from app import errors
from app.pool import WorkerDied

log = logging.getLogger(__name__)

MEDIA_TYPE = "application/problem+json"


class MalformedBody(errors.Invalid):
    """A request body that is not what its media type says (JSON that does not parse, a broken multipart)."""


class UnsupportedMedia(errors.Invalid):
    """A media type or content coding that the call does not take."""


class NotAcceptable(errors.Invalid):
    """None of the media types that the client accepts can be served."""


class SlowBody(errors.FleetMapError):
    """The client stopped sending its body."""


class Throttled(errors.Denied):
    """Too many wrong tokens from this address; ``retry_after`` in seconds."""

    retry_after = 60


STATUS: Mapping[type[errors.FleetMapError], tuple[int, str]] = {
    errors.NotFound: (404, "Not found"),
    errors.Gone: (404, "Deleted"),
    MalformedBody: (400, "Malformed body"),
    UnsupportedMedia: (415, "Unsupported media type"),
    NotAcceptable: (406, "Not acceptable"),
    SlowBody: (408, "Request timeout"),
    errors.Invalid: (422, "Invalid request"),
    errors.BadUpload: (422, "Bad upload"),
    errors.UnreadableFile: (422, "Unreadable file"),
    errors.TooLarge: (413, "Too large"),
    errors.UnsafeArchive: (422, "Unsafe archive"),
    WorkerDied: (422, "Processing failed"),
    errors.CannotConvert: (422, "Cannot convert"),
    errors.CannotGenerate: (422, "Cannot generate"),
    errors.MissingLayer: (422, "Missing layer"),
    errors.MissingDatum: (422, "Missing datum"),
    errors.Ambiguous: (409, "Ambiguous"),
    errors.Conflict: (409, "Conflict"),
    errors.StaleParent: (412, "The head has moved"),
    Throttled: (429, "Too many failures"),
    errors.Denied: (403, "Denied"),
    errors.Unauthenticated: (401, "Token needed"),
    errors.InvalidLink: (403, "Invalid link"),
    errors.ExpiredLink: (403, "Expired link"),
    errors.NoRoom: (507, "No room left"),
    errors.DatabaseDamaged: (503, "Database damaged"),
    errors.Unavailable: (503, "Unavailable"),
    errors.Damaged: (500, "Damaged data"),
    errors.Untrusted: (500, "Not to be trusted"),
}
"""Class -> status and title; a class that is not listed takes its nearest base's."""

RETRY_SECONDS = 5
DISK_FULL_RETRY_SECONDS = 60
ALARM_SECONDS = 3600.0
"""How often the same alarm is logged, however many requests meet it."""

MAX_ERRORS = 100
MAX_ALARMS = 1000


def problem_status(error: errors.FleetMapError) -> tuple[int, str, str]:
    """Status, title and the problem's type of an error."""
    for cls in type(error).__mro__:
        if cls in STATUS:
            status, title = STATUS[cls]
            name = "".join("-" + c.lower() if c.isupper() else c for c in cls.__name__).strip("-")
            return status, title, f"urn:fleetmap:problem:{name}"
    return 500, "Internal error", "about:blank"


def document(
    status: int,
    detail: str,
    *,
    title: str | None = None,
    type_: str = "about:blank",
    problems: Sequence[errors.Problem] = (),
) -> dict[str, Any]:
    """The JSON of a problem."""
    out: dict[str, Any] = {
        "type": type_,
        "title": title or HTTPStatus(status).phrase,
        "status": status,
        "detail": clean(detail),
    }
    if problems:
        out["errors"] = [{**p.as_dict(), "problem": clean(p.problem)} for p in problems[:MAX_ERRORS]]
    return out


def clean(text: str) -> str:
    """A text that JSON can carry: lone surrogates shown as escapes, and not longer than a page."""
    if len(text) > 4000:
        text = text[:4000] + " …"
    return text.encode("utf-8", "backslashreplace").decode()


def problem(
    status: int,
    detail: str,
    *,
    title: str | None = None,
    type_: str = "about:blank",
    problems: Sequence[errors.Problem] = (),
    headers: Mapping[str, str] | None = None,
) -> Response:
    """The answer for a problem."""
    body = document(status, detail, title=title, type_=type_, problems=problems)
    extra = {"cache-control": "no-store", **(headers or {})}
    return Response(orjson.dumps(body), status, extra, MEDIA_TYPE)


def as_document(error: errors.FleetMapError) -> dict[str, Any]:
    """The JSON of an error, for a job that failed."""
    status, title, type_ = problem_status(error)
    return document(status, error.detail, title=title, type_=type_, problems=error.problems)


def error_response(error: errors.FleetMapError) -> Response:
    """The answer for one of our own errors."""
    status, title, type_ = problem_status(error)
    headers = {}
    if isinstance(error, errors.Unauthenticated):
        headers["www-authenticate"] = 'Bearer realm="fleetmap"'
    elif isinstance(error, Throttled):
        headers["retry-after"] = str(error.retry_after)
    elif status == 503:
        headers["retry-after"] = str(RETRY_SECONDS)
    elif status == 507:
        headers["retry-after"] = str(DISK_FULL_RETRY_SECONDS)
    if isinstance(error, errors.Damaged | errors.NoRoom) and _is_news(error.detail):
        # The operator's alarm; the client learns only that it was not its fault.
        alarm = "stored data is damaged" if isinstance(error, errors.Damaged) else "no room left on the server's disk"
        log.critical("%s: %s", alarm, error.detail)
    return problem(status, error.detail, title=title, type_=type_, problems=error.problems, headers=headers)


_alarms: dict[str, float] = {}
_alarms_lock = threading.Lock()


def _is_news(detail: str) -> bool:
    """Whether an alarm was not logged within the last hour."""
    now = time.monotonic()
    with _alarms_lock:
        for text in [text for text, since in _alarms.items() if now - since > ALARM_SECONDS]:
            del _alarms[text]
        if detail in _alarms or len(_alarms) >= MAX_ALARMS:
            return False
        _alarms[detail] = now
        return True


def problem_body(error: Exception) -> bytes:
    """The JSON of any error, for who asks otherwise than over HTTP."""
    return bytes(
        (error_response(error) if isinstance(error, errors.FleetMapError) else internal_error_response(error)).body
    )


def http_error_response(error: HTTPException) -> Response:
    """The answer for Starlette's and FastAPI's own errors (no route, wrong method …)."""
    if error.status_code in (204, 304):
        return Response(status_code=error.status_code, headers=error.headers)
    details = {
        404: "there is nothing at this address; /docs lists what there is",
        405: "this address does not take this method",
    }
    phrase = HTTPStatus(error.status_code).phrase
    detail = str(error.detail)
    if detail == phrase:
        detail = details.get(error.status_code, detail)
    return problem(error.status_code, detail, headers=error.headers)


def validation_error_response(error: RequestValidationError) -> Response:
    """The answer for a request that does not fit its schema; 400 where the body is not even JSON."""
    problems = []
    for item in error.errors():
        location = ".".join(str(part) for part in item.get("loc", ()))
        if item.get("type") == "json_invalid":
            reason = str(item.get("ctx", {}).get("error", item["msg"]))
            parse_problem = errors.Problem(f"not JSON: {reason}", where=f"character {item['loc'][-1]}")
            return problem(
                400,
                "the request body is not JSON",
                title="Malformed body",
                type_="urn:fleetmap:problem:malformed-body",
                problems=[parse_problem],
            )
        problems.append(errors.Problem(str(item["msg"]).removeprefix("Value error, "), where=location))
    detail = "; ".join(f"{p.where}: {p.problem}" for p in problems[:5])
    return problem(422, detail, title="Invalid request", type_="urn:fleetmap:problem:invalid", problems=problems)


def internal_error_response(error: BaseException) -> Response:
    """The answer for anything else. The log gets the class and our own lines, no data, paths or tokens."""
    if isinstance(error, OSError) and error.errno in errors.DISK_FULL_ERRNOS:
        detail = "the server has no room left; nothing was stored. Try again after its operator has freed space"
        return error_response(errors.NoRoom(detail))
    if isinstance(error, OSError) and error.errno == errno.EROFS:
        return error_response(errors.Unavailable("the server's disk is read-only; nothing was stored. Try again later"))
    log.error("internal error: %s", describe(error))
    return problem(500, "internal error; the server's log has the details. Nothing was stored", title="Internal error")


def describe(error: BaseException) -> str:
    """Class and places of an exception in one line: ``ValueError at store.versions:120 < api.maps:33``.

    Neither its text (it may hold data or names of files) nor whole paths.
    """
    frames = traceback.extract_tb(error.__traceback__)
    ours = [f"{PurePath(f.filename).parent.name}.{PurePath(f.filename).stem}:{f.lineno}" for f in frames]
    return f"{type(error).__name__} at {' < '.join(reversed(ours[-6:]))}"


async def handle_error(_: Request, error: Exception) -> Response:
    """FastAPI's handler for our own errors."""
    assert isinstance(error, errors.FleetMapError)
    return error_response(error)


async def handle_http(_: Request, error: Exception) -> Response:
    """FastAPI's handler for HTTP errors."""
    assert isinstance(error, HTTPException)
    return http_error_response(error)


async def handle_validation(_: Request, error: Exception) -> Response:
    """FastAPI's handler for requests that do not fit their schema."""
    assert isinstance(error, RequestValidationError)
    return validation_error_response(error)

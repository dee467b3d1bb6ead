"""Error responses: every error as ``application/problem+json`` (RFC 9457).

``{type, title, status, detail, errors?: [{file?, line?, where?, problem}]}``. The table below is the only mapping
from error classes to status codes.
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
from typing import Any, Final

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
    """The request body is malformed (invalid JSON, a broken multipart)."""


class UnsupportedMedia(errors.Invalid):
    """The call does not support the media type or content coding."""


class NotAcceptable(errors.Invalid):
    """None of the media types that the client accepts is available."""


class SlowBody(errors.FleetMapError):
    """The client stopped sending its body, or sends it too slowly."""


class Throttled(errors.Denied):
    """Too many wrong tokens from this address. ``retry_after``: seconds."""

    retry_after = 60


STATUS: Mapping[type[errors.FleetMapError], tuple[int, str]] = {
    errors.NotFound: (404, "Not found"),
    errors.Gone: (404, "Deleted"),
    errors.Thinned: (410, "Thinned"),
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
    errors.Mirrored: (409, "Changed elsewhere"),
    errors.StaleParent: (412, "The head has moved"),
    Throttled: (429, "Too many failures"),
    errors.Denied: (403, "Denied"),
    errors.Unauthenticated: (401, "Token required"),
    errors.InvalidLink: (403, "Invalid link"),
    errors.ExpiredLink: (403, "Expired link"),
    errors.NoRoom: (507, "Disk full"),
    errors.DatabaseDamaged: (503, "Database damaged"),
    errors.Unavailable: (503, "Unavailable"),
    errors.Damaged: (500, "Damaged data"),
    errors.Untrusted: (500, "Untrusted data"),
}
"""Mapping of error classes to status and title; other classes use their nearest base class."""

RETRY_SECONDS = 5
DISK_FULL_RETRY_SECONDS = 60
ALARM_SECONDS = 3600.0
"""Minimum seconds between two logs of the same alarm."""

MAX_ERRORS = 100
MAX_ALARMS = 1000


def problem_status(error: errors.FleetMapError) -> tuple[int, str, str]:
    """Return status, title and problem type of an error."""
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
    """Build the JSON of a problem."""
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
    """Make a text safe for JSON: escape lone surrogates, and shorten it to 4000 characters."""
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
    """Build the response for a problem."""
    body = document(status, detail, title=title, type_=type_, problems=problems)
    extra = {"cache-control": "no-store", **(headers or {})}
    return Response(orjson.dumps(body), status, extra, MEDIA_TYPE)


def as_document(error: errors.FleetMapError) -> dict[str, Any]:
    """Build the JSON of an error, for a failed job."""
    status, title, type_ = problem_status(error)
    return document(status, error.detail, title=title, type_=type_, problems=error.problems)


def error_response(error: errors.FleetMapError) -> Response:
    """Build the response for an error of this server."""
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
        # An alarm for the operator; the client only learns that the request was not at fault.
        alarm = "stored data is damaged" if isinstance(error, errors.Damaged) else "the server's disk is full"
        log.critical("%s: %s", alarm, error.detail)
    return problem(status, error.detail, title=title, type_=type_, problems=error.problems, headers=headers)


_alarms: dict[str, float] = {}
_alarms_lock = threading.Lock()


def _is_news(detail: str) -> bool:
    """Return whether an alarm was not logged within the last hour, and remember it."""
    now = time.monotonic()
    with _alarms_lock:
        for text in [text for text, since in _alarms.items() if now - since > ALARM_SECONDS]:
            del _alarms[text]
        if detail in _alarms or len(_alarms) >= MAX_ALARMS:
            return False
        _alarms[detail] = now
        return True


def problem_body(error: Exception) -> bytes:
    """Build the JSON of any error, for queries that do not use HTTP."""
    return bytes(
        (error_response(error) if isinstance(error, errors.FleetMapError) else internal_error_response(error)).body
    )


def http_error_response(error: HTTPException) -> Response:
    """Build the response for an error of Starlette or FastAPI (no route, wrong method …)."""
    if error.status_code in (204, 304):
        return Response(status_code=error.status_code, headers=error.headers)
    details = {
        404: "no such address: see /docs for the list",
        405: "this address does not support the method: see /docs",
    }
    phrase = HTTPStatus(error.status_code).phrase
    detail = str(error.detail)
    if detail == phrase:
        detail = details.get(error.status_code, detail)
    return problem(error.status_code, detail, headers=error.headers)


JSON_TYPES: Final = {
    **dict.fromkeys(("dict_type", "model_type", "model_attributes_type"), "must be a JSON object"),
    **dict.fromkeys(("list_type", "tuple_type"), "must be a JSON array"),
}
"""Reasons in JSON's terms, for the errors for which pydantic uses Python's."""


def validation_error_response(error: RequestValidationError) -> Response:
    """Build the response for a request that does not match its schema; 400 if the body is not JSON."""
    problems = []
    for item in error.errors():
        location = ".".join(str(part) for part in item.get("loc", ()))
        if item.get("type") == "json_invalid":
            reason = str(item.get("ctx", {}).get("error", item["msg"]))
            parse_problem = errors.Problem(f"invalid JSON: {reason}", where=f"character {item['loc'][-1]}")
            return problem(
                400,
                "the request body is not valid JSON",
                title="Malformed body",
                type_="urn:fleetmap:problem:malformed-body",
                problems=[parse_problem],
            )
        reason = JSON_TYPES.get(item["type"]) or str(item["msg"]).removeprefix("Value error, ")
        problems.append(errors.Problem(reason, where=location))
    detail = "; ".join(f"{p.where}: {p.problem}" for p in problems[:5])
    return problem(422, detail, title="Invalid request", type_="urn:fleetmap:problem:invalid", problems=problems)


def internal_error_response(error: BaseException) -> Response:
    """Build the response for any other error. Logs the class and our own lines, no data, paths or tokens."""
    if isinstance(error, OSError) and error.errno in errors.DISK_FULL_ERRNOS:
        detail = "the server's disk is full, and nothing was stored: try again when its operator has freed space"
        return error_response(errors.NoRoom(detail))
    if isinstance(error, OSError) and error.errno == errno.EROFS:
        return error_response(
            errors.Unavailable("the server's disk is read-only, and nothing was stored: try again later")
        )
    log.error("internal error: %s", describe(error))
    return problem(
        500, "internal server error, and nothing was stored; details are in the server log", title="Internal error"
    )


def describe(error: BaseException) -> str:
    """Describe an exception in one line, as in ``ValueError at store.versions:120 < api.maps:33``.

    Omits the text (it may contain data or file names) and full paths.
    """
    frames = traceback.extract_tb(error.__traceback__)
    ours = [f"{PurePath(f.filename).parent.name}.{PurePath(f.filename).stem}:{f.lineno}" for f in frames]
    return f"{type(error).__name__} at {' < '.join(reversed(ours[-6:]))}"


async def handle_error(_: Request, error: Exception) -> Response:
    """Handle errors of this server for FastAPI."""
    assert isinstance(error, errors.FleetMapError)
    return error_response(error)


async def handle_http(_: Request, error: Exception) -> Response:
    """Handle HTTP errors for FastAPI."""
    assert isinstance(error, HTTPException)
    return http_error_response(error)


async def handle_validation(_: Request, error: Exception) -> Response:
    """Handle requests that do not match their schema for FastAPI."""
    assert isinstance(error, RequestValidationError)
    return validation_error_response(error)

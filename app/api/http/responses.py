"""Conventions of this API for requests and responses: strict JSON, and pages with a link to the next one."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Coroutine, Mapping
from typing import Any
from urllib.parse import quote, urlencode

import orjson
from fastapi import APIRouter, Request
from fastapi.routing import APIRoute
from starlette.responses import Response

from app.errors import Invalid, Problem
from app.ingest import CommitResult
from app.model.names import did_you_mean
from app.store.values import Version

API = "/api/v1"


def api_path(*parts: object) -> str:
    """Build a path below the API from its parts, each quoted completely."""
    return API + "".join("/" + quote(str(part), safe="") for part in parts)


def json_bytes(value: Any) -> bytes:
    """Write compact UTF-8 JSON."""
    return orjson.dumps(value, option=orjson.OPT_NON_STR_KEYS)


def json_response(value: Any, status: int = 200, headers: Mapping[str, str] | None = None) -> Response:
    """Build a JSON response."""
    return Response(json_bytes(value), status, headers, "application/json")


def page_response(request: Request, items: list[Any], cursor: str | None) -> Response:
    """Build a page of a list, with ``Link: <…>; rel="next"`` if there are more items."""
    return json_response(items, headers=next_page(request, cursor))


def next_page(request: Request, cursor: str | None) -> dict[str, str]:
    """Build the header ``Link`` to the next page; empty for the last one."""
    if cursor is None:
        return {}
    query = [(k, v) for k, v in request.query_params.multi_items() if k != "cursor"]
    path = quote(request.url.path, safe="/")
    return {"link": f'<{path}?{urlencode([*query, ("cursor", cursor)])}>; rel="next"'}


def version_headers(version: Version) -> dict[str, str]:
    """Build the headers of a version: ``ETag`` for ``If-Match``, number and root. What is not committed has its id."""
    tag = str(version.ref if version.pending is None else version.pending.tag)
    return {"etag": f'"{tag}"', "fleetmap-version": str(version.ref), "fleetmap-root": version.root}


def commit_response(outcome: CommitResult) -> Response:
    """Build the response of a commit: 201 for a new version, also if the request is repeated; else 200."""
    version = outcome.version
    if version is None:
        return json_response(outcome.body)
    headers = version_headers(version)
    location = api_path("environments", version.environment, "versions", version.number)
    if outcome.status == "unchanged":
        return json_response(outcome.body, headers={**headers, "content-location": location})
    return json_response(outcome.body, 201, {**headers, "location": location})


class _StrictRequest(Request):
    async def json(self) -> Any:
        """Parse the body as JSON: no NaN, infinity or lone surrogates, integers up to 64 bits, limited nesting."""
        data = await self.body()
        value = orjson.loads(data)
        if _LONG.search(data):  # orjson would parse a larger integer as a float
            json.loads(data, parse_int=_int64)
        return value


_LONG = re.compile(rb"\d{19}")


def _int64(text: str) -> int:
    if len(text) > 20 or not -(2**63) <= int(text) < 2**63:
        raise json.JSONDecodeError(f"the integer {text[:40]} exceeds 64 bits", text, 0)
    return int(text)


class StrictRoute(APIRoute):
    """Route with strict JSON that refuses unknown query parameters, so that misspelt ones are reported."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """Wrap FastAPI's handler with the checks."""
        handler = super().get_route_handler()
        allowed_names = {field.alias for field in _query_fields(self.dependant)}
        free = bool((self.openapi_extra or {}).get("x-free-query"))

        async def exact(request: Request) -> Response:
            if not free:
                unknown = sorted(set(request.query_params) - allowed_names)
                if unknown:
                    accepted = ", ".join(sorted(allowed_names)) or "none"
                    near = did_you_mean(unknown[0], allowed_names)
                    raise Invalid(
                        f"unknown query parameter {unknown[0][:80]!r}{near}; accepted: {accepted}",
                        [Problem(f"unknown; accepted: {accepted}", where=name[:80]) for name in unknown[:20]],
                    )
            return await handler(_StrictRequest(request.scope, request.receive))

        return exact


def api_router(tag: str, prefix: str = "") -> APIRouter:
    """Create the router of a resource below ``/api/v1`` and ``prefix``. tag: its heading in the documentation."""
    return APIRouter(prefix=API + prefix, tags=[tag], route_class=StrictRoute)


def _query_fields(dependant: Any) -> list[Any]:
    out = list(dependant.query_params)
    for inner in dependant.dependencies:
        out += _query_fields(inner)
    return out

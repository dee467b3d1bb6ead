"""Map downloads: plain routes on top of the response cache, the disk cache and conversion."""

from __future__ import annotations

import hashlib
import itertools
from dataclasses import replace
from functools import partial
from typing import Annotated, Any, Literal
from urllib.parse import quote, urlencode

from fastapi import FastAPI, Path, Query, Request
from pydantic import BaseModel, Field
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from app.api.http import deltas
from app.api.http.addresses import (
    MapRequest,
    parse_map_request,
    parse_query,
    request_address,
    resolve_recipe,
    signed_link,
)
from app.api.http.auth import Principal, Viewer
from app.api.http.caching import content_disposition, none_match
from app.api.http.conversions import JobStarted, job_started_response
from app.api.http.dependencies import Services, ServicesDep
from app.api.http.parameters import parse_version_ref
from app.api.http.response_cache import FRESH_SECONDS, CachedResponse, Key, request_key
from app.api.http.responses import API, api_path, api_router, json_response
from app.api.http.schemas import EnvironmentPath, ProblemItem, VersionPath, problem_responses
from app.api.http.streams import IN_MEMORY, Headers, range_headers, raw_response, requested_range, stream_file
from app.clock import seconds_since_boot
from app.convert.cache import CachedFile, CachedMap, LostMap
from app.convert.maps import select_file
from app.convert.recipe import Recipe
from app.errors import Unavailable

MAX_LOST_ATTEMPTS = 5
"""Maximum number of conversions if a map leaves the cache before it is read."""

MAX_PLANS = 20
"""Maximum number of ways to make a map that are planned, each since a derivation of the one before found nothing."""

OVERLAYS = b"fleetmap-overlays"
"""Name of the header with the digest of the closures in force that a map shows."""


async def download(template: str, request: Request) -> Response:
    """Serve a map, or one of its files, on the slow path."""
    request.scope["state"]["route"] = template  # for the metrics: plain routes leave no route in the scope
    services: Services = request.app.state.services
    for _ in range(MAX_LOST_ATTEMPTS):
        try:
            return await _answer(request, services, await _get_or_convert(request, services))
        except LostMap:  # evicted after the lookup
            services.response_cache.evict(request)
    raise Unavailable("the map is evicted from the cache before it can be sent: try again in a few seconds")


async def _get_or_convert(request: Request, services: Services) -> CachedResponse | JobStarted:
    """Return the response for the request's address, converting if needed, or the job that converts."""
    memory, key = services.response_cache, request_key(request)
    fresh = memory.get_fresh(key)
    if fresh is not None and (fresh.body is not None or fresh.file is not None):
        return fresh
    wanted = parse_map_request(request)
    # Taken before any read: a concurrent commit makes this response stale, never wrongly fresh.
    generation, until = memory.generation(), seconds_since_boot() + FRESH_SECONDS
    for attempt in itertools.count():
        recipe = await memory.run_shared(request, resolve_recipe, services, wanted)
        old = memory.get(key)
        if (
            old is not None
            and old.recipe is not None
            and old.body is not None
            and _identity(old.recipe) == _identity(recipe)
        ):
            fresh = replace(old, generation=generation, fresh_until=until)
            memory.insert(key, fresh)
            return fresh
        empty = _without_body(request, services, wanted, recipe, generation, until)
        if _matches(request, empty.etag):
            memory.insert(key, empty)
            return empty
        # Key by recipe: a client that saw a later commit has another recipe and does not join this call.
        try:
            answer = await _fetch(request, services, key, wanted, recipe, empty)
            if answer is not None:
                return answer
            if attempt >= MAX_PLANS:
                raise Unavailable(f"the map is planned anew after {MAX_PLANS} attempts: try again in a few seconds")
        except LostMap:  # damaged or evicted while being read: convert again
            if attempt >= MAX_LOST_ATTEMPTS:
                raise
    raise AssertionError("unreachable")


async def _fetch(
    request: Request, services: Services, key: Key, wanted: MapRequest, recipe: Recipe, empty: CachedResponse
) -> CachedResponse | JobStarted | None:
    """Build the response of a recipe from disk, or by conversion; concurrent requests share one call.

    Returns None if the conversion used another recipe: the response then has another ETag, which the client may have.
    """
    memory = services.response_cache

    def fill(cached_map: CachedMap) -> CachedResponse:
        full = _with_body(empty, wanted, recipe, cached_map)
        memory.insert(key, full)
        return full

    def fill_from_disk() -> CachedResponse | None:
        cached_map = services.maps.get_cached(recipe)
        if cached_map is None:
            return None
        services.metrics.disk_hits.inc()
        return fill(cached_map)

    entry = await memory.join((key, _identity(recipe), "ready"), fill_from_disk)
    if entry is not None:
        return entry
    principal: Principal = request.scope["state"]["principal"]
    outcome = await services.jobs.get_or_start(recipe, principal, request_address(request))
    if isinstance(outcome, JobStarted):
        return outcome
    working, cached_map = outcome
    if working.key != recipe.key:
        return None
    return await memory.join((key, _identity(recipe), "fill"), fill, cached_map)


def _without_body(
    request: Request, services: Services, wanted: MapRequest, recipe: Recipe, generation: int, until: float
) -> CachedResponse:
    """Build the part of a response that is known before the conversion."""
    version = recipe.version
    etag = recipe.etag if wanted.file is None else _file_etag(recipe, wanted.file)
    closures = version.closures
    more = ({} if wanted.derive else {"derive": "false"}) | ({} if closures is None else {"closures": closures.mode})
    query = urlencode({**wanted.values, **more})
    report = api_path("environments", version.environment, "versions", version.number, "reports", wanted.format)
    bare = [
        (b"etag", etag.encode()),
        (b"cache-control", b"no-cache"),
        (b"fleetmap-version", str(version.number).encode()),
        (b"fleetmap-root", version.root.encode()),
        *([] if closures is None else [(OVERLAYS, closures.digest.encode())]),
        (b"vary", b"accept-encoding, available-dictionary"),  # required with 304 as well (RFC 9110, 15.4.5)
    ]
    report_link = f'<{report}{"?" + query if query else ""}>; rel="describedby"'.encode()
    headers = [*bare, (b"link", report_link), (b"x-content-type-options", b"nosniff")]
    if signed_link(request) is not None:
        bare, headers = _private(bare), _private(headers)
    state = request.scope["state"]
    return CachedResponse(
        environment=wanted.environment,
        recipe=recipe,
        etag=etag,
        raw_etag=etag.encode(),
        headers=headers,
        bare=bare,
        size=0,
        body=None,
        file=None,
        sha256="",
        generation=generation,
        fresh_until=until,
        tally=services.response_cache.tally(str(state["route"])),
        link=None if signed_link(request) is None else state["principal"],
    )


def _private(headers: Headers) -> Headers:
    """Adapt headers to a signed link: no shared caching, and no referrer that contains the link."""
    others = [(name, value) for name, value in headers if name != b"cache-control"]
    return [*others, (b"cache-control", b"private, no-cache"), (b"referrer-policy", b"no-referrer")]


def _file_etag(recipe: Recipe, name: str) -> str:
    return f'{recipe.etag[:-1]}-{hashlib.sha256(name.encode("utf-8", "surrogatepass")).hexdigest()[:8]}"'


def _identity(recipe: Recipe) -> tuple[str, int, str, str, str]:
    """Return a key that distinguishes recipes at one address, also of a purged environment with the same name."""
    version, closures = recipe.version, recipe.version.closures
    return recipe.key, version.number, version.environment, version.root, closures.digest if closures else ""


def _matches(request: Request, etag: str) -> bool:
    """Test if the client has the response already; ``*`` does not match, since the file may not exist."""
    header = request.headers.get("if-none-match")
    return header is not None and header.strip() != "*" and none_match(header, etag)


def _with_body(empty: CachedResponse, wanted: MapRequest, recipe: Recipe, cached_map: CachedMap) -> CachedResponse:
    """Complete a response with the headers and content of its map. Raises NotFound if there is no such file."""
    file = select_file(recipe, cached_map, wanted.file)
    headers = [
        (b"content-type", _media_type(file).encode()),
        (b"accept-ranges", b"bytes"),
        (b"content-disposition", content_disposition(file.name).encode()),
        *empty.headers,
        (b"use-as-dictionary", _dictionary(wanted).encode()),
    ]
    if file.size > IN_MEMORY and file.path is not None:
        return replace(empty, headers=headers, size=file.size, file=file, sha256=file.sha256)
    body = file.read()
    headers.insert(0, (b"content-length", str(len(body)).encode()))
    return replace(empty, headers=headers, size=len(body), body=body, sha256=file.sha256)


def _dictionary(map_request: MapRequest) -> str:
    """Return the URL pattern for which this file is a dictionary: the same file of any version (RFC 9842)."""
    env, name = quote(map_request.environment, safe=""), quote(map_request.format, safe="")
    file = "/" + quote(map_request.file, safe="/") if map_request.file else ""
    if map_request.version is None:
        return f'match="/maps/{env}/{name}{file}"'
    return f'match="{API}/environments/{env}/versions/*/maps/{name}{file}"'


def _media_type(file: CachedFile) -> str:
    media_type = file.media_type
    return (
        f"{media_type}; charset=utf-8" if media_type.startswith("text/") and "charset" not in media_type else media_type
    )


async def _answer(request: Request, services: Services, outcome: CachedResponse | JobStarted) -> Response:
    if isinstance(outcome, JobStarted):
        if signed_link(request) is not None:  # a link's holder has no token to follow a job
            raise Unavailable("the map is still being converted: try again in a few seconds")
        return job_started_response(outcome.job)
    if none_match(request.headers.get("if-none-match"), outcome.etag):
        return raw_response(304, outcome.bare)
    delta = await _delta(request, services, outcome)
    if delta is not None:
        return delta
    part = requested_range(request, outcome.etag, outcome.size)
    if outcome.file is not None:
        return await _from_disk(request, outcome, outcome.file, part)
    body = outcome.body or b""
    if part is None:
        return raw_response(200, outcome.headers, body)
    return raw_response(206, _partial_headers(outcome, part), body[part[0] : part[1]])


async def _delta(request: Request, services: Services, entry: CachedResponse) -> Response | None:
    """Return the file as a delta to the client's file, if the server has that file."""
    old = deltas.offered_dictionary(request.headers)
    if old is None or "range" in request.headers or entry.size > deltas.MAX_BYTES:
        return None
    content = entry.body if entry.body is not None else entry.file
    if content is None:
        return None
    delta = await services.deltas.between(old, entry.sha256, content)
    if delta is None:
        return None
    etag = f'{entry.etag[:-1]}-dcz{old[:16]}"'.encode()
    left = (b"content-length", b"etag", b"accept-ranges")
    headers = [(n, v) for n, v in entry.headers if n not in left]
    headers = [(b"content-length", str(len(delta)).encode()), (b"content-encoding", b"dcz"), (b"etag", etag), *headers]
    head_only = bool(request.scope.get("state", {}).get("head"))
    return raw_response(200, headers, b"" if head_only else delta)


def _partial_headers(entry: CachedResponse, part: tuple[int, int] | None) -> Headers:
    return [*range_headers(part, entry.size), *((n, v) for n, v in entry.headers if n != b"content-length")]


async def _from_disk(
    request: Request, entry: CachedResponse, cached_file: CachedFile, part: tuple[int, int] | None
) -> Response:
    """Stream a large file. It is opened before the response starts, so the cache may evict it meanwhile."""
    assert cached_file.path is not None
    headers, status = _partial_headers(entry, part), 206 if part else 200
    if request.scope["state"].get("head"):
        return raw_response(status, headers)
    try:
        file = await run_in_threadpool(cached_file.path.open, "rb")
    except OSError as error:
        raise cached_file.lost_error(error) from error
    start, end = part or (0, entry.size)
    return stream_file(file, start, end, status, headers, None if part else cached_file.check)


def add_routes(app: FastAPI) -> None:
    """Add the plain routes of maps; documented in ``app.api.http.openapi``."""
    base = f"{API}/environments/{{env}}/versions/{{v}}/maps/{{format}}"
    for path in (base, base + "/{file:path}", "/maps/{env}/{format}", "/maps/{env}/{format}/{file:path}"):
        app.router.add_route(path, partial(download, path), methods=["GET"], include_in_schema=False)


class CoverageOut(BaseModel):
    """Availability of a format: direct, derivable with a chain of steps, or missing."""

    format: str
    state: Literal["direct", "derivable", "missing"]
    chain: list[dict[str, Any]]
    missing: list[str]
    choose: str | None = Field(None, description="Parts to select in the query, if there are several of a kind.")


class ReportOut(BaseModel):
    """Report on a map: inputs, derivations, filled-in values, and dropped data."""

    format: str
    version: int
    layers: list[dict[str, Any]]
    attribution: list[str] = Field(description="Licences and credits of the sources, to be shown with the map.")
    template: list[dict[str, Any]] = Field(
        description="Filled-in values: `what`, `value`, `why`, `option` (the parameter that sets it, if any), and "
        "`from`: `request`, `environment`, `set NAME` or `default`."
    )
    dropped: list[dict[str, Any]]
    warnings: list[ProblemItem]
    closures: list[dict[str, Any]] = Field(
        description="Closures in force, each with its `effect` on this map and the `edges` that it closes."
    )


FormatPath = Annotated[
    str, Path(max_length=64, description="Id of a format; see `GET /api/v1/formats`.", examples=["geojson"])
]

router = api_router("maps", "/environments/{env}/versions/{v}")


@router.get("/maps", responses=problem_responses(list[CoverageOut], 404), summary="List the available formats")
def coverage(env: EnvironmentPath, v: VersionPath, services: ServicesDep, _: Viewer) -> Response:
    """List for each format whether the version provides it directly, by derivation, or what is missing."""
    return json_response(services.maps.coverage(services.store.versions.get(env, parse_version_ref(v))))


@router.get(
    "/reports/{format}",
    responses=problem_responses(ReportOut, 404, 409, 422),
    summary="Get the report of a map",
    openapi_extra={"x-free-query": True},
)
async def report(
    env: EnvironmentPath,
    v: VersionPath,
    format: FormatPath,
    request: Request,
    services: ServicesDep,
    principal: Viewer,
    derive: bool = Query(True, description="Allow derived information."),
) -> Response:
    """Return which information of a map is raw, derived or filled in, and what was dropped and why.

    Accepts the parameters of the map.
    """
    values, allowed, closures = parse_query(request.scope["query_string"])
    plan = partial(resolve_recipe, services, MapRequest(env, v, format, None, values, allowed and derive, closures))
    outcome = await services.jobs.convert(plan, principal, request_address(request))
    if isinstance(outcome, JobStarted):
        return job_started_response(outcome.job)
    map_report = await run_in_threadpool(services.maps.report, outcome[0])
    return json_response(map_report.as_dict())

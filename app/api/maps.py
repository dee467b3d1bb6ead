"""Maps as robots fetch them: plain routes over an LRU of answers, so that a fleet that asks again costs microseconds.

``FleetMapApp`` first answers what it has in memory: an answer is believed while
``Store.generation()`` stays the same and for a second at most, the caller's token likewise. All else goes the long
way: guard, route, recipe (the ETag), cache on disk, conversion.
"""

from __future__ import annotations

import hashlib
import itertools
import re
import threading
import time
from collections import OrderedDict
from collections.abc import AsyncIterator, Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, BinaryIO, ParamSpec, TypeVar
from urllib.parse import parse_qsl, quote, urlencode

from fastapi import APIRouter, FastAPI, Query, Request
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.responses import Response, StreamingResponse
from starlette.types import Receive, Scope, Send

from app.api import deltas
from app.api.auth import Authenticator, Principal, Viewer
from app.api.caching import Unsatisfiable, byte_range, content_disposition, none_match
from app.api.dependencies import Services, ServicesDep
from app.api.jobs import JobStarted, job_started_response
from app.api.metrics import Metrics
from app.api.middleware import is_local_origin
from app.api.protocol import PROVE
from app.api.responses import API, StrictRoute, api_path, json_response
from app.api.schemas import CoverageOut, EnvironmentPath, FormatPath, ReportOut, VersionPath, problem_responses
from app.api.signed import LINK
from app.api.single_flight import SingleFlight
from app.convert.cache import CachedFile, CachedMap, LostMap
from app.convert.maps import select_file
from app.convert.recipe import Recipe
from app.errors import Invalid, NotFound, Problem, Unavailable
from app.links import SignedAddress
from app.model.closures import CLOSURE_MODES, ClosureMode
from app.store.values import LATEST, Version

FRESH_SECONDS = 1.0
MAX_LOST_ATTEMPTS = 5
"""How often a map is made again that was lost from the cache before it was read."""

IN_MEMORY = 8 * 2**20
"""Files up to this many bytes are answered from memory; larger ones are streamed from disk."""

CHUNK = 256 * 2**10
PRODUCTION = "production"
OVERLAYS = b"fleetmap-overlays"
"""Header: digest of the closures in force that a map shows."""

T = TypeVar("T")
P = ParamSpec("P")
Headers = list[tuple[bytes, bytes]]
Key = tuple[bytes, bytes]
"""Raw path and raw query."""


@dataclass(frozen=True, slots=True)
class MapRequest:
    """What an address asks for. version: None on a short address. file: None for the whole map. closures: None for the
    default of the address.
    """

    environment: str
    version: str | None
    format: str
    file: str | None
    closures: ClosureMode | None = None


@dataclass(frozen=True, slots=True, eq=False)
class CachedResponse:
    """What stands at an address. recipe: None where it is no map. body: None while it is not made, or too large for
    memory; file: then the one on disk. link_expires: seconds since 1970, of a signed link; None where a token is
    needed.
    """

    wanted: MapRequest
    recipe: Recipe | None
    etag: str
    raw_etag: bytes
    headers: Headers
    bare: Headers
    size: int
    body: bytes | None
    file: CachedFile | None
    sha256: str
    generation: int
    fresh_until: float
    tally: list[int]
    link_expires: int | None = None


class ResponseCache:
    """Answers in memory, and the long way to an answer."""

    def __init__(self, here_bytes: int, access: Authenticator, metrics: Metrics, generation: Any) -> None:
        self._limit, self._size = here_bytes, 0
        self.access, self._metrics, self.generation = access, metrics, generation
        self._entries: OrderedDict[Key, CachedResponse] = OrderedDict()
        self._poll_task: SingleFlight[tuple[Any, ...], Any] = SingleFlight()
        self._lock = threading.Lock()
        self._tallies: dict[str, list[int]] = {}

    def get_fresh(self, key: Key) -> CachedResponse | None:
        """What is known to stand there at this moment."""
        entry = self._entries.get(key)
        if entry is None or entry.fresh_until < time.monotonic() or entry.generation != self.generation():
            return None
        return entry

    async def get_or_convert(
        self, request: Request, services: Services, principal: Principal
    ) -> CachedResponse | JobStarted:
        """What stands at the request's address; made where need be, or the job that makes it."""
        key = _key(request)
        fresh = self.get_fresh(key)
        if fresh is not None and (fresh.body is not None or fresh.file is not None):
            return fresh
        link = signed_link(request)
        values, derive, closures = _options(key[1] if link is None else link.query)
        map_request = replace(parse_map_path(request), closures=closures)
        # Taken before anything is read: a commit in between makes this answer stale, never fresh.
        generation, until = self.generation(), time.monotonic() + FRESH_SECONDS
        for attempt in itertools.count():
            recipe = await self.run_shared(request, _resolve, services, map_request, values, derive)
            old = self._entries.get(key)
            if (
                old is not None
                and old.recipe is not None
                and _is_same_request(old.recipe, recipe)
                and old.body is not None
            ):
                fresh = replace(old, generation=generation, fresh_until=until)
                self._insert(key, fresh)
                return fresh
            empty = self._resource(map_request, recipe, values, derive, generation, until, _route(request))
            if link is not None:
                empty = _without_link_headers(empty, link)
            if _matches(request, empty.etag):
                self._insert(key, empty)
                return empty
            # From here on the recipe says what is meant: who was told of a later commit has another one.
            try:
                entry: CachedResponse | None = await self._poll_task.run(
                    (key, _recipe_identity(recipe), "ready"), self._ready, services, key, empty
                )
                if entry is not None:
                    return entry
                outcome = await services.jobs.get_or_start(recipe, principal, request_address(request))
                if isinstance(outcome, JobStarted):
                    return outcome
                working, cached_map = outcome
                if working.key != recipe.key:
                    continue  # made another way, so with another tag, which the client may have
                entry = await self._poll_task.run(
                    (key, _recipe_identity(recipe), "fill"), self._fill, key, empty, cached_map
                )
            except LostMap:  # damaged or evicted while it was read: it is made again
                if attempt >= MAX_LOST_ATTEMPTS:
                    raise
                continue
            return entry
        raise AssertionError("unreachable")

    def _ready(self, services: Services, key: Key, empty: CachedResponse) -> CachedResponse | None:
        assert empty.recipe is not None
        cached_map = services.maps.get_cached(empty.recipe)
        if cached_map is None:
            return None
        self._metrics.disk_hits.inc()
        return self._fill(key, empty, cached_map)

    def _fill(self, key: Key, empty: CachedResponse, cached_map: CachedMap) -> CachedResponse:
        full = _with_body(empty, cached_map)
        self._insert(key, full)
        return full

    async def run_shared(self, request: Request, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """What ``function`` finds, called in a thread: one look for all who ask for this address at the same moment.

        Nobody joins a look that began before the last commit. So what it finds must depend on what commits tell of
        alone (robots' reports are not), and on nothing that was found before it, nor on who asks.
        """
        result: T = await self._poll_task.run((_key(request), self.generation(), function), function, *args, **kwargs)
        return result

    def _resource(
        self,
        map_request: MapRequest,
        recipe: Recipe,
        values: Mapping[str, str],
        derive: bool,
        generation: int,
        until: float,
        route: str,
    ) -> CachedResponse:
        version = recipe.version
        etag = recipe.etag if map_request.file is None else _file_etag(recipe, map_request.file)
        closures = version.closures
        more = ({} if derive else {"derive": "false"}) | ({} if closures is None else {"closures": closures.mode})
        query = urlencode({**values, **more})
        report = api_path(
            "environments", version.environment, "versions", version.number, "reports", map_request.format
        )
        bare = [
            (b"etag", etag.encode()),
            (b"cache-control", b"no-cache"),
            (b"fleetmap-version", str(version.number).encode()),
            (b"fleetmap-root", version.root.encode()),
            *([] if closures is None else [(OVERLAYS, closures.digest.encode())]),
            (b"vary", b"accept-encoding, available-dictionary"),  # with 304 as well (RFC 9110, 15.4.5)
        ]
        link = f'<{report}{"?" + query if query else ""}>; rel="describedby"'.encode()
        headers = [*bare, (b"link", link), (b"x-content-type-options", b"nosniff")]
        tally = self._tallies.setdefault(route, [0, 0])
        return CachedResponse(
            map_request, recipe, etag, etag.encode(), headers, bare, 0, None, None, "", generation, until, tally
        )

    def store_response(
        self, request: Request, environment: str, headers: Mapping[str, str], body: bytes, generation: int
    ) -> None:
        """Another answer (200, with an ``etag``) that a whole fleet asks for at once; good until the next commit.

        generation: as it was before the store was asked. Whoever may enter the environment gets it.
        """
        key = _key(request)
        bare = [(name.encode(), value.encode()) for name, value in headers.items()]
        full = [*bare, (b"content-length", str(len(body)).encode()), (b"content-type", b"application/json")]
        full.append((b"x-content-type-options", b"nosniff"))
        tally = self._tallies.setdefault(request.scope["route"].path, [0, 0])
        map_request, until, etag = (
            MapRequest(environment, None, "", None),
            time.monotonic() + FRESH_SECONDS,
            headers["etag"],
        )
        self._insert(
            key,
            CachedResponse(
                map_request, None, etag, etag.encode(), full, bare, len(body), body, None, "", generation, until, tally
            ),
        )

    def evict(self, request: Request) -> None:
        """Drop what is remembered of an address."""
        with self._lock:
            old = self._entries.pop(_key(request), None)
            self._size -= _entry_bytes(old) if old else 0

    def flush_counters(self) -> None:
        """Add what was answered from memory since the last call to the metrics."""
        for route, tally in list(self._tallies.items()):
            for place, status in enumerate(("200", "304")):
                new, tally[place] = tally[place], 0
                if new:
                    self._metrics.requests.labels("GET", route, status).inc(new)
                    self._metrics.memory_hits.inc(new)

    def _insert(self, key: Key, resource: CachedResponse) -> None:
        with self._lock:
            old = self._entries.pop(key, None)
            self._size += _entry_bytes(resource) - (_entry_bytes(old) if old else 0)
            self._entries[key] = resource
            while self._size > self._limit and len(self._entries) > 1:
                self._size -= _entry_bytes(self._entries.popitem(last=False)[1])


def signed_link(request: Request) -> SignedAddress | None:
    """The signed link, already checked, that a request was made by."""
    link: SignedAddress | None = request.scope["state"].get(LINK)
    return link


def _without_link_headers(resource: CachedResponse, link: SignedAddress) -> CachedResponse:
    """The same for a link: only its holder may cache it, and no page learns the link as a referrer."""

    def private(headers: Headers) -> Headers:
        others = [(name, value) for name, value in headers if name != b"cache-control"]
        return [*others, (b"cache-control", b"private, no-cache"), (b"referrer-policy", b"no-referrer")]

    return replace(resource, headers=private(resource.headers), bare=private(resource.bare), link_expires=link.expires)


def _key(request: Request) -> Key:
    scope = request.scope
    return (scope.get("raw_path") or scope["path"].encode(), scope["query_string"])


def _entry_bytes(resource: CachedResponse) -> int:
    return 2048 + len(resource.body or b"")


def _file_etag(recipe: Recipe, name: str) -> str:
    return f'{recipe.etag[:-1]}-{hashlib.sha256(name.encode("utf-8", "surrogatepass")).hexdigest()[:8]}"'


def _recipe_identity(recipe: Recipe) -> tuple[str, int, str, str]:
    """What tells recipes at one address apart."""
    closures = recipe.version.closures
    return recipe.key, recipe.version.number, recipe.version.environment, closures.digest if closures else ""


def _is_same_request(a: Recipe, b: Recipe) -> bool:
    return _recipe_identity(a) == _recipe_identity(b)


def _matches(request: Request, etag: str) -> bool:
    """Whether the client has it already; ``*`` says nothing about a file that may not exist."""
    header = request.headers.get("if-none-match")
    return header is not None and header.strip() != "*" and none_match(header, etag)


def _resolve(services: Services, map_request: MapRequest, values: Mapping[str, str], derive: bool) -> Recipe:
    return services.maps.recipe(
        resolve_version(services, map_request), map_request.format, values, derive=derive, file=map_request.file
    )


def resolve_version(services: Services, map_request: MapRequest) -> Version:
    """The version that an address means, with the closures that its maps show: on a short one production where there is
    one, else the head.
    """
    if map_request.version is not None:
        return services.store.channel_target(
            map_request.environment, parse_version_ref(map_request.version), map_request.closures
        )[0]
    try:
        return services.store.channel_target(map_request.environment, PRODUCTION, map_request.closures)[0]
    except NotFound:
        return services.store.channel_target(map_request.environment, LATEST, map_request.closures)[0]


def parse_version_ref(ref: str) -> str | int:
    """A version as an address names it: a number, or a channel."""
    return int(ref) if ref.isascii() and ref.isdigit() and len(ref) <= 18 else ref


def _with_body(empty: CachedResponse, cached_map: CachedMap) -> CachedResponse:
    """With headers and content of the made map. NotFound where it has no such file."""
    assert empty.recipe is not None
    file = select_file(empty.recipe, cached_map, empty.wanted.file)
    headers = [
        (b"content-type", _media_type(file).encode()),
        (b"accept-ranges", b"bytes"),
        (b"content-disposition", content_disposition(file.name).encode()),
        *empty.headers,
        (b"use-as-dictionary", _dictionary(empty.wanted).encode()),
    ]
    if file.size > IN_MEMORY and file.path is not None:
        return replace(empty, headers=headers, size=file.size, file=file, sha256=file.sha256)
    body = file.read()
    headers.insert(0, (b"content-length", str(len(body)).encode()))
    return replace(empty, headers=headers, size=len(body), body=body, sha256=file.sha256)


def _dictionary(map_request: MapRequest) -> str:
    """For which addresses this file is a dictionary: the same file of any version (RFC 9842, URL pattern)."""
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


_SHORT = re.compile(r"/maps/([^/]+)/([^/]+)(?:/(.+))?", re.DOTALL)
_LONG = re.compile(rf"{API}/environments/([^/]+)/versions/([^/]+)/maps/([^/]+)(?:/(.+))?", re.DOTALL)


def parse_map_path(request: Request) -> MapRequest:
    """What the address of a map asks for."""
    path = request.scope["path"]
    short, long = _SHORT.fullmatch(path), _LONG.fullmatch(path)
    if short:
        return MapRequest(short[1], None, short[2], short[3])
    if long:
        return MapRequest(long[1], long[2], long[3], long[4])
    raise NotFound("there is no map at this address")


def _route(request: Request) -> str:
    return str(request.scope["state"]["route"])


def request_address(request: Request) -> str:
    """The request's own address, to be asked for again; without the signature of a link."""
    link = signed_link(request)
    query = request.url.query if link is None else link.query.decode()
    return quote(request.scope["path"], safe="/") + (f"?{quote(query, safe='&=%,.:+-_~/')}" if query else "")


def _options(query: bytes) -> tuple[dict[str, str], bool, ClosureMode | None]:
    """The format's options, whether derived information is allowed, and how closures are shown. Invalid for what is
    given twice.
    """
    try:
        text = query.decode("ascii")
    except UnicodeDecodeError:
        raise Invalid("the query cannot be read: it must be percent-encoded UTF-8") from None
    return parse_options(text)


def parse_options(query: str) -> tuple[dict[str, str], bool, ClosureMode | None]:
    """The same of a query that is text, as a manifest's entries hold one."""
    try:
        pairs = parse_qsl(query, keep_blank_values=True, max_num_fields=100, errors="strict")
    except ValueError:
        raise Invalid("the query cannot be read: it must be percent-encoded UTF-8 with at most 100 members") from None
    values: dict[str, str] = {}
    for name, value in pairs:
        if name in values:
            raise Invalid(f"the parameter {name[:80]!r} is given twice", [Problem("given twice", where=name[:80])])
        values[name] = value
    derive = values.pop("derive", "true")
    if derive not in ("true", "false"):
        raise Invalid(f"derive must be true or false, got {derive[:80]!r}", [Problem("true or false", where="derive")])
    return values, derive == "true", closure_mode(values.pop("closures", None))


def closure_mode(text: str | None) -> ClosureMode | None:
    """The parameter ``closures`` of a map; None for the default of the address. Raises Invalid."""
    if text is None:
        return None
    for mode in CLOSURE_MODES:
        if mode == text:
            return mode
    accepted = ", ".join(CLOSURE_MODES)
    raise Invalid(f"closures must be one of {accepted}, got {text[:80]!r}", [Problem(accepted, where="closures")])


class FleetMapApp(FastAPI):
    """The application, with the answers it has in memory in front of everything else.

    ``response_cache`` is None until the services are open.
    """

    response_cache: ResponseCache | None = None

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a repeated request for a map from memory, or go the long way."""
        hot = self.response_cache
        if hot is not None and scope["type"] == "http" and scope["method"] in ("GET", "HEAD"):
            entry = hot.get_fresh((scope.get("raw_path") or b"", scope["query_string"]))
            if entry is not None:
                reply = _reply(hot, entry, scope["headers"], scope["method"] == "HEAD")
                if reply is not None:
                    if PROVE in scope.get("state", ()):
                        scope["state"][PROVE]()
                    await send(reply[0])
                    await send(reply[1])
                    return
        await super().__call__(scope, receive, send)


_EMPTY = {"type": "http.response.body", "body": b""}


def _reply(
    hot: ResponseCache, entry: CachedResponse, headers: list[tuple[bytes, bytes]], head_only: bool
) -> tuple[dict[str, Any], dict[str, Any]] | None:
    """The two messages of an answer, or None where it takes the long way."""
    authorization = condition = None
    for name, value in headers:
        if name == b"authorization":
            authorization = value
        elif name == b"if-none-match":
            if condition is not None:
                return None
            condition = value
        elif name in (b"range", b"if-match", b"available-dictionary"):
            return None
    if entry.link_expires is None:
        principal = hot.access.cached_principal(authorization)
        if principal is None or not principal.can_access(entry.wanted.environment):
            return None
    elif entry.link_expires <= time.time():  # the signature is part of the key: it was checked with the first request
        return None
    if hot.access.insecure and not is_local_origin(dict(headers)):
        return None
    if condition is not None and (condition == entry.raw_etag or none_match(condition.decode("latin-1"), entry.etag)):
        if entry.body is None and condition.strip() == b"*":
            return None
        entry.tally[1] += 1
        return {"type": "http.response.start", "status": 304, "headers": entry.bare}, _EMPTY
    if entry.body is None:
        return None
    entry.tally[0] += 1
    body = _EMPTY if head_only else {"type": "http.response.body", "body": entry.body}
    return {"type": "http.response.start", "status": 200, "headers": entry.headers}, body


async def download(template: str, request: Request) -> Response:
    """A map, or one of its files: the long way."""
    request.scope["state"]["route"] = template  # for the metrics; plain routes leave none in the scope
    services: Services = request.app.state.services
    principal: Principal = request.scope["state"]["principal"]
    for _ in range(MAX_LOST_ATTEMPTS):
        try:
            return await _answer(
                request, services, await services.response_cache.get_or_convert(request, services, principal)
            )
        except LostMap:  # it left the cache since it was found
            services.response_cache.evict(request)
    raise Unavailable("the map is removed from the cache faster than it is sent: try again in a few seconds")


async def _answer(request: Request, services: Services, outcome: CachedResponse | JobStarted) -> Response:
    if isinstance(outcome, JobStarted):
        if signed_link(request) is not None:  # its holder has no token to follow a job with
            raise Unavailable("the map is still being converted: try again in a few seconds")
        return job_started_response(outcome.job)
    if none_match(request.headers.get("if-none-match"), outcome.etag):
        return _response(304, outcome.bare)
    delta = await _delta(request, services, outcome)
    if delta is not None:
        return delta
    if outcome.file is not None:
        return await _from_disk(request, outcome)
    body = outcome.body or b""
    part = byte_range(request.headers.get("range"), request.headers.get("if-range"), outcome.etag, outcome.size)
    if isinstance(part, Unsatisfiable):
        raise _unsatisfiable(outcome.size)
    if part is None:
        return _response(200, outcome.headers, body)
    return _response(206, _partial_headers(outcome, part), body[part[0] : part[1]])


async def _delta(request: Request, services: Services, entry: CachedResponse) -> Response | None:
    """The file as a delta to the one that the client has, if it has one that is known here."""
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
    return _response(200, headers, b"" if head_only else delta)


def _response(status: int, headers: Headers, body: bytes = b"") -> Response:
    response = Response(body, status)
    response.raw_headers = list(headers)
    return response


def _unsatisfiable(size: int) -> HTTPException:
    return HTTPException(416, f"the file has {size} bytes", {"content-range": f"bytes */{size}"})


def _partial_headers(entry: CachedResponse, part: tuple[int, int]) -> Headers:
    other_headers = [(n, v) for n, v in entry.headers if n != b"content-length"]
    start, end = part
    return [
        (b"content-length", str(end - start).encode()),
        (b"content-range", f"bytes {start}-{end - 1}/{entry.size}".encode()),
        *other_headers,
    ]


async def _from_disk(request: Request, entry: CachedResponse) -> Response:
    """A large file, in chunks. It is opened before the answer starts, so the cache may drop it meanwhile."""
    assert entry.file is not None
    assert entry.file.path is not None
    part = byte_range(request.headers.get("range"), request.headers.get("if-range"), entry.etag, entry.size)
    if isinstance(part, Unsatisfiable):
        raise _unsatisfiable(entry.size)
    head_only = bool(request.scope.get("state", {}).get("head"))
    start, end = part or (0, entry.size)
    headers = _partial_headers(entry, part) if part else [(b"content-length", str(entry.size).encode()), *entry.headers]
    status = 206 if part else 200
    if head_only:
        return _response(status, headers)
    try:
        file = await run_in_threadpool(entry.file.path.open, "rb")
    except OSError as error:
        raise entry.file.lost_error(error) from error
    return stream_file(file, start, end, status, headers, None if part else entry.file.check)


def stream_file(
    file: BinaryIO, start: int, end: int, status: int, headers: Headers, check: Callable[[str], None] | None = None
) -> Response:
    """The bytes [start, end) of an open file, which is closed at the end.

    check: called with the hash of all of it before the last bytes are sent; what it raises breaks the connection, so
    that nobody takes damaged content for whole.
    """
    digest = hashlib.sha256()

    def read(size: int) -> bytes:
        chunk = file.read(size)
        if check is not None:
            digest.update(chunk)
        return chunk

    async def chunks() -> AsyncIterator[bytes]:
        try:
            await run_in_threadpool(file.seek, start)
            left = end - start
            while left > 0:
                chunk = await run_in_threadpool(read, min(CHUNK, left))
                if not chunk:
                    raise OSError("a file that is being sent became shorter")
                left -= len(chunk)
                if check is not None and not left:
                    check(digest.hexdigest())
                yield chunk
        finally:
            file.close()

    response = StreamingResponse(chunks(), status)
    response.raw_headers = list(headers)
    return response


def add_routes(app: FastAPI) -> None:
    """The plain routes of maps; documented in ``app.api.openapi``."""
    base = f"{API}/environments/{{env}}/versions/{{v}}/maps/{{format}}"
    for path in (base, base + "/{file:path}", "/maps/{env}/{format}", "/maps/{env}/{format}/{file:path}"):
        app.router.add_route(path, partial(download, path), methods=["GET"], include_in_schema=False)


async def convert_at_address(
    services: Services, map_request: MapRequest, query: bytes, principal: Principal
) -> tuple[Recipe, CachedMap] | JobStarted:
    """The map that an address of a version's number gives, made where need be; the job that makes it if it takes long.

    query: the map's parameters, percent-encoded.
    """
    values, derive, closures = _options(query)
    path = api_path(
        "environments", map_request.environment, "versions", map_request.version, "maps", map_request.format
    )
    address = f"{path}?{query.decode()}" if query else path
    plan = partial(_resolve, services, replace(map_request, closures=closures), values, derive)
    return await convert_plan(services, plan, address, principal)


async def convert_plan(
    services: Services, plan: Callable[[], Recipe], address: str, principal: Principal
) -> tuple[Recipe, CachedMap] | JobStarted:
    """The map of a plan, made where need be; the job that makes it for ``address`` if it takes long."""
    recipe = await run_in_threadpool(plan)
    cached_map = await run_in_threadpool(services.maps.get_cached, recipe)
    if cached_map is not None:
        return recipe, cached_map
    return await services.jobs.get_or_start(recipe, principal, address)


router = APIRouter(prefix="/environments/{env}/versions/{v}", tags=["maps"], route_class=StrictRoute)


@router.get("/maps", responses=problem_responses(list[CoverageOut], 404), summary="Which formats can be had")
def coverage(env: EnvironmentPath, v: VersionPath, services: ServicesDep, _: Viewer) -> Response:
    """For every format: whether it can be written as it is, by deriving what lacks, or what to supply."""
    return json_response(services.maps.coverage(services.store.version(env, parse_version_ref(v))))


@router.get(
    "/reports/{format}",
    responses=problem_responses(ReportOut, 404, 409, 422),
    summary="What a map is made of",
    openapi_extra={"x-free-query": True},
)
async def report(
    env: EnvironmentPath,
    v: VersionPath,
    format: FormatPath,
    request: Request,
    services: ServicesDep,
    principal: Viewer,
    derive: bool = Query(True, description="Whether derived information is allowed."),
) -> Response:
    """Raw, derived and filled-in information of a map, what was dropped and why. Takes the map's own parameters."""
    values, allowed, mode = _options(request.scope["query_string"])
    plan = partial(_resolve, services, MapRequest(env, v, format, None, mode), values, allowed and derive)
    outcome = await convert_plan(services, plan, request_address(request), principal)
    if isinstance(outcome, JobStarted):
        return job_started_response(outcome.job)
    map_report = await run_in_threadpool(services.maps.report, outcome[0])
    return json_response(map_report.as_dict())

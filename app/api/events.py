"""Events as server-sent events, resumable, and the same maps over Zenoh.

A stream of one environment has its ``sequence`` as ids, a stream of several the place in the log of all. Streams that
stand at the same place share each look at the log. A stream ends soon after its token does.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import orjson
from fastapi import Header, Query, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response, StreamingResponse

from app.api.environments import as_dict
from app.api.http.auth import Authenticator, Principal, Viewer
from app.api.http.dependencies import Services, ServicesDep
from app.api.http.parameters import closure_mode, parse_position, parse_version_ref
from app.api.http.problems import Throttled
from app.api.http.protocol import ON_STOP
from app.api.http.responses import api_router
from app.api.http.schemas import problem_responses
from app.api.http.single_flight import SingleFlight
from app.convert.cache import CachedFile
from app.convert.maps import select_file
from app.errors import Invalid, NotFound, Problem, TooLarge, Unauthenticated, Unavailable
from app.events import messages
from app.events.bus import DeferredReply, Reply
from app.store.values import Event

COMMIT_POLL_SECONDS = 0.02
"""How often a stream looks at the host's generation number."""

POLL_SECONDS = 1.0
KEEP_ALIVE_SECONDS = 15.0
RECHECK_SECONDS = 5.0
"""How long a stream goes on before its token is looked up again; one revoked in this process ends it at once."""

PAGE = 200
MAX_ENVIRONMENTS = 100
"""Environments in an answer over Zenoh."""

STREAMS = 1000
"""So many streams at once for each worker."""

router = api_router("events")


@dataclass(frozen=True, slots=True)
class StreamEvent:
    """An event as it goes out. number: its id in the stream."""

    number: int
    environment: str
    line: bytes


class EventFeed:
    """Who listens at this moment: all wait for one look at the store."""

    def __init__(self, services: Services) -> None:
        self._services = services
        self._poll_task: SingleFlight[tuple[str | None, int, int], list[StreamEvent]] = SingleFlight()
        self._checks: SingleFlight[tuple[bytes | None, str | None, int], Principal] = SingleFlight()
        self._changed = asyncio.Event()
        self._task: asyncio.Task[None] | None = None
        self.streams = 0
        self.ending = False

    async def wait(self, seconds: float) -> None:
        """Until something was committed, at most this long."""
        if self._task is None or self._task.done():
            self._task = asyncio.create_task(self._read_counter())
        changed = self._changed
        try:
            async with asyncio.timeout(seconds):
                await changed.wait()
        except TimeoutError:
            return

    async def events(self, environment: str | None, start: int) -> list[StreamEvent]:
        """The next events after a place; all who stand there share a look. NotFound, Unavailable."""
        key = (environment, start, self._services.store.generation())
        return await self._poll_task.run(key, self._read, environment, start)

    def _read(self, environment: str | None, start: int) -> list[StreamEvent]:
        out = []
        for event in self._services.store.events.page(environment, start, PAGE):
            number = event.sequence if environment is not None else event.position
            out.append(StreamEvent(number, event.environment, _line(event, number)))
        return out

    async def check(self, header: bytes | None, client: str | None) -> None:
        """Look a token up: Unauthenticated, Throttled, Unavailable."""
        key = (header, client, self._services.store.generation())
        await self._checks.run(key, self._services.access.authenticate, header, client)

    def close(self) -> None:
        """The server stops: streams end, and begin again where it is back."""
        self.ending = True
        self._changed.set()

    async def _read_counter(self) -> None:
        seen = self._services.store.generation()
        last = 0.0
        while self.streams:
            await asyncio.sleep(COMMIT_POLL_SECONDS)
            last += COMMIT_POLL_SECONDS
            now = self._services.store.generation()
            if now != seen or last > POLL_SECONDS:
                seen, last = now, 0.0
                self._changed.set()
                self._changed = asyncio.Event()


@router.get(
    "/events",
    response_class=Response,
    responses={
        **problem_responses(None, 404, 503),
        200: {"description": "A stream that does not end", "content": {"text/event-stream": {}}},
    },
    summary="Events as they happen",
)
async def stream_events(
    request: Request,
    services: ServicesDep,
    principal: Viewer,
    environment: Annotated[
        str | None, Query(description="Only of this environment; else of all that the token reaches.")
    ] = None,
    since: Annotated[
        int | None,
        Query(ge=0, description="Events after this sequence (without `environment`: place in the log); left out: new."),
    ] = None,
    last_event_id: Annotated[str | None, Header(alias="Last-Event-ID", description="Resumes a stream.")] = None,
    follow: Annotated[bool, Query(description="`false`: end after what has happened so far.")] = True,
) -> Response:
    """Server-sent events: `event` is the type, `data` the JSON, `id` what to resume from."""
    if environment is not None:
        principal.require_environment(environment)
    start = since
    if last_event_id is not None and last_event_id.strip():
        text = last_event_id.strip()
        if not (text.isascii() and text.isdigit() and len(text) <= 18):
            raise Invalid("Last-Event-ID is a number from an event's id", [Problem("not a number", where="id")])
        start = int(text)
    start = await run_in_threadpool(_start_position, services, environment, start)  # NotFound comes before the stream
    feed: EventFeed = request.app.state.feed
    if feed.streams >= STREAMS:
        raise Unavailable("too many streams of events are open: close some, or poll with follow=false")
    headers = {"cache-control": "no-store", "x-accel-buffering": "no", "x-content-type-options": "nosniff"}
    state = request.scope["state"]
    if state.get("head"):
        return StreamingResponse(_empty_stream(), media_type="text/event-stream", headers=headers)
    state[ON_STOP] = feed.close
    client = request.client.host if request.client else None
    bearer = _StreamAuth(services.access, feed, principal, request.headers.get("authorization"), client)
    stream = _stream(feed, bearer, environment, start, follow=follow)
    return StreamingResponse(stream, media_type="text/event-stream", headers=headers)


def _start_position(services: Services, environment: str | None, start: int | None) -> int:
    """Where a stream begins; without a start with what happens from now on.

    NotFound for an environment that is not there, unless its end is still to be told. Invalid for a place that the log
    has not come to: whoever was further has seen another log (one from before a backup was put back, say), and would
    miss all that happens until then.
    """
    try:
        newest = (
            services.store.events.last_position()
            if environment is None
            else services.store.events.last_sequence(environment)
        )
    except NotFound:
        if start is None or environment is None or not services.store.events.page(environment, start, 1):
            raise
        return start
    if start is not None and start > newest:
        reason = f"nothing with the number {start} has happened here, the last is {newest}: begin with a lower one"
        raise Invalid(reason, [Problem("later than the log", where="since")])
    return newest if start is None else start


async def _empty_stream() -> AsyncIterator[bytes]:
    """What is left of a stream whose head alone is asked for."""
    lines: tuple[bytes, ...] = ()
    for line in lines:
        yield line


class _StreamAuth:
    """Whether a stream's token is still one."""

    def __init__(
        self, access: Authenticator, feed: EventFeed, principal: Principal, header: str | None, client: str | None
    ) -> None:
        self.principal = principal
        self._access, self._feed, self._client = access, feed, client
        self._header = None if header is None else header.encode("latin-1")
        self._invalidated_at, self._checked = access.is_invalidated, time.monotonic()

    async def is_valid(self) -> bool:
        """Raises Unavailable where that cannot be known at this moment."""
        if self._access.insecure:
            return True
        if self.principal.has_expired():
            return False
        forgotten, now = self._access.is_invalidated, time.monotonic()
        if forgotten == self._invalidated_at and now - self._checked < RECHECK_SECONDS:
            return True
        try:
            await self._feed.check(self._header, self._client)
        except (Unauthenticated, Throttled):
            return False
        self._invalidated_at, self._checked = forgotten, now
        return True


async def _stream(
    feed: EventFeed, bearer: _StreamAuth, environment: str | None, start: int, *, follow: bool
) -> AsyncIterator[bytes]:
    feed.streams += 1
    try:
        yield b": Fleet Map Server\nretry: 2000\n\n"
        quiet = 0.0
        loop = asyncio.get_running_loop()
        while True:
            try:
                page = await feed.events(environment, start)
                if not await bearer.is_valid():
                    return
            except Unavailable:  # the log is still there when the database is back
                yield b": the database is away\n\n"
                await asyncio.sleep(POLL_SECONDS)
                if feed.ending:
                    return
                continue
            except NotFound:
                return  # purged: whoever asks again is told so
            for event in page:
                start = event.number
                if bearer.principal.can_access(event.environment):  # it may have had another name then
                    yield event.line
            if page:
                quiet = 0.0
                continue
            if not follow or feed.ending:
                return
            before = loop.time()
            await feed.wait(KEEP_ALIVE_SECONDS)
            quiet += loop.time() - before
            if quiet >= KEEP_ALIVE_SECONDS:
                quiet = 0.0
                yield b": still here\n\n"
    finally:
        feed.streams -= 1


def _line(event: Event, number: int) -> bytes:
    return b"id: %d\nevent: %s\ndata: %s\n\n" % (number, str(event.body["type"]).encode(), orjson.dumps(event.body))


def answer_zenoh_query(
    services: Services, max_bytes: int, environment: str, rest: str, parameters: Mapping[str, str]
) -> Reply | DeferredReply:
    """What HTTP answers at ``/environments/{environment}/versions/{rest}``: ``{v}/version``, ``{v}/maps/{format}/…``;
    for a map that is not there, what makes it. ``server/where``: what ``/environments?contains=`` answers.

    max_bytes: so many bytes are answered. Blocks. Raises what the calls over HTTP answer as problems.
    """
    if (environment, rest) == messages.POSITION_QUERY:
        return _locate(services, parameters)
    pieces = rest.split("/")
    if pieces[1:] == ["version"]:
        version = services.store.versions.get(environment, parse_version_ref(pieces[0]))
        _no_parameters(parameters)
        return Reply(orjson.dumps(version.as_dict()), "application/json")
    if len(pieces) < 3 or pieces[1] != "maps":
        raise NotFound("there is a version and its maps: {v}/version, {v}/maps/{format}, {v}/maps/{format}/{file}")
    values = dict(parameters)
    derive = values.pop("derive", "true")
    if derive not in ("true", "false"):
        raise Invalid("derive must be true or false", [Problem("true or false", where="derive")])
    mode = closure_mode(values.pop("closures", None))
    version, _ = services.store.channels.target(environment, parse_version_ref(pieces[0]), mode)
    name, file = pieces[2], "/".join(pieces[3:]) or None
    recipe = services.maps.recipe(version, name, values, derive=derive == "true", file=file)
    cached_map = services.maps.get_cached(recipe)
    if cached_map is not None:
        return _reply_from(select_file(recipe, cached_map, file), max_bytes)
    return lambda: _reply_from(
        services.maps.fetch(version, name, values, derive=derive == "true", file=file), max_bytes
    )


def _locate(services: Services, parameters: Mapping[str, str]) -> Reply:
    """The environments that a position is in, best match first, as over HTTP."""
    given = dict(parameters)
    latitude, longitude = given.pop("lat", None), given.pop("lon", None)
    if given or latitude is None or longitude is None:
        raise Invalid(
            "a position needs lat and lon in degrees and nothing else: server/where?lat=53.2687;lon=-0.5244",
            [Problem("lat and lon", where="parameters")],
        )
    hits, _ = services.store.areas.locate(*parse_position(f"{latitude},{longitude}", "lat,lon"), limit=MAX_ENVIRONMENTS)
    return Reply(orjson.dumps([as_dict(environment, match) for environment, match in hits]), "application/json")


def _reply_from(file: CachedFile, max_bytes: int) -> Reply:
    if file.size > max_bytes:
        raise TooLarge(f"the map has {file.size} bytes, more than is sent over Zenoh ({max_bytes}): fetch it over HTTP")
    return Reply(file.read(), file.media_type)


def _no_parameters(parameters: Mapping[str, Any]) -> None:
    for name in parameters:
        raise Invalid(f"a version takes no parameter {name[:80]!r}", [Problem("unknown", where=name[:80])])

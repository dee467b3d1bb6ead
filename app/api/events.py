"""Events as resumable server-sent events, and replies to Zenoh queries.

The ids of a stream are the ``sequence`` of one environment, or log positions if the stream has several. Streams at
the same position share each read of the log. With ``robots=true`` a stream also has changes of robots, which are not in
the log and have no id. A stream ends soon after its token or session.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import orjson
from fastapi import Header, Query, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response, StreamingResponse

from app.api.environments import as_dict
from app.api.http.auth import Authenticator, Credentials, Principal, Viewer
from app.api.http.dependencies import Services, ServicesDep
from app.api.http.parameters import closure_mode, parse_position, parse_version_ref
from app.api.http.problems import Throttled
from app.api.http.protocol import ON_STOP
from app.api.http.responses import api_router
from app.api.http.schemas import problem_responses
from app.api.http.single_flight import SingleFlight
from app.api.robot_feed import RobotFeed, RobotSubscription
from app.convert.cache import CachedFile
from app.convert.maps import select_file
from app.errors import Invalid, NotFound, Problem, TooLarge, Unauthenticated, Unavailable
from app.events import messages
from app.events.bus import DeferredReply, Reply
from app.store.values import Event

INTERVAL_SECONDS = 0.02
"""Shortest time between two looks at the log."""

WAIT_SECONDS = 0.2
"""Longest wait of a thread for a commit, as the server may stop."""

POLL_SECONDS = 1.0
KEEP_ALIVE_SECONDS = 15.0
RECHECK_SECONDS = 5.0
"""Seconds until a stream's token or session is checked again; what ends in this process ends its streams at once."""

PAGE = 200
MAX_ENVIRONMENTS = 100
"""Maximum number of environments in a Zenoh reply."""

STREAMS = 1000
"""Maximum number of concurrent streams per worker process."""

router = api_router("events")


@dataclass(frozen=True, slots=True)
class StreamEvent:
    """Event in the form of a stream. number: its id in the stream."""

    number: int
    environment: str
    line: bytes


class EventFeed:
    """Feed for all streams of a process: they share each read of the log."""

    def __init__(self, services: Services) -> None:
        self._services = services
        self._poll_task: SingleFlight[tuple[str | None, int, int], list[StreamEvent]] = SingleFlight()
        self._checks: SingleFlight[tuple[Credentials, int], Principal] = SingleFlight()
        self._changed = asyncio.Event()
        self._task: asyncio.Task[None] | None = None
        self.robots = RobotFeed(services)
        self.streams = 0
        self.ending = False

    def next_change(self) -> asyncio.Event:
        """Return what is set after the next commit. To miss none, call it before reading the log."""
        if self._task is None or self._task.done():
            self._task = asyncio.create_task(self._follow_counter(self._services.store.generation()))
        return self._changed

    async def wait(self, changed: asyncio.Event, seconds: float, robots: RobotSubscription | None = None) -> None:
        """Wait for ``changed`` or a change of ``robots``, but no longer than ``seconds``."""
        if robots is None:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(seconds):
                    await changed.wait()
            return
        waits: list[asyncio.Task[Any]] = [asyncio.create_task(changed.wait()), asyncio.create_task(robots.wait())]
        try:
            await asyncio.wait(waits, timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for waiting in waits:
                waiting.cancel()

    async def events(self, environment: str | None, start: int) -> list[StreamEvent]:
        """Return the next events after a position; streams at the same position share the read.

        Raises NotFound or Unavailable.
        """
        key = (environment, start, self._services.store.generation())
        return await self._poll_task.run(key, self._read, environment, start)

    def _read(self, environment: str | None, start: int) -> list[StreamEvent]:
        out = []
        for event in self._services.store.events.page(environment, start, PAGE):
            number = event.sequence if environment is not None else event.position
            out.append(StreamEvent(number, event.environment, _line(event, number)))
        return out

    async def check(self, credentials: Credentials) -> Principal:
        """Check a token or session. Raises Unauthenticated, Throttled or Unavailable."""
        key = (credentials, self._services.store.generation())
        return await self._checks.run(key, self._services.access.authenticate, credentials)

    def close(self) -> None:
        """End all streams, since the server stops; clients reconnect later."""
        self.ending = True
        self._changed.set()
        self._services.store.generation.wake()

    async def _follow_counter(self, seen: int) -> None:
        generation, last_look = self._services.store.generation, time.monotonic()
        while self.streams and not self.ending:
            is_new = await asyncio.to_thread(generation.wait, seen, WAIT_SECONDS)
            if is_new or time.monotonic() - last_look > POLL_SECONDS:
                seen, last_look = generation(), time.monotonic()
                self._changed.set()
                self._changed = asyncio.Event()
                await asyncio.sleep(INTERVAL_SECONDS)


@router.get(
    "/events",
    response_class=Response,
    responses={
        **problem_responses(None, 404, 503),
        200: {"description": "An endless stream", "content": {"text/event-stream": {}}},
    },
    summary="Stream events",
)
async def stream_events(
    request: Request,
    services: ServicesDep,
    principal: Viewer,
    environment: Annotated[
        str | None,
        Query(description="Only events of this environment. Default: all environments that the token can access."),
    ] = None,
    since: Annotated[
        int | None,
        Query(
            ge=0,
            description="Events after this sequence, or, without `environment`, after this log position. Default: only "
            "new events.",
        ),
    ] = None,
    last_event_id: Annotated[
        str | None, Header(alias="Last-Event-ID", description="Id of the last received event: resume after it.")
    ] = None,
    follow: Annotated[bool, Query(description="`false`: end after the stored events.")] = True,
    robots: Annotated[
        bool, Query(description="Also stream `robot.status`: the new status of robots. Excludes `follow=false`.")
    ] = False,
) -> Response:
    """Stream server-sent events: `event` is the type, `data` the JSON, `id` the number from which to resume.

    The stream begins with an `id` without data: the number that it begins after.

    With `robots=true`, `robot.status` has the status of a robot as in `GET /robots`, after each change and at most once
    per second. It has no `id`, because it is not stored: read `GET /robots` after the stream has opened again.
    """
    if environment is not None:
        principal.require_environment(environment)
    if robots and not follow:
        raise Invalid(
            "robots=true excludes follow=false: changes of robots are not stored, so follow the stream",
            [Problem("excludes follow=false", where="robots")],
        )
    start = since
    if last_event_id is not None and last_event_id.strip():
        text = last_event_id.strip()
        if not (text.isascii() and text.isdigit() and len(text) <= 18):
            raise Invalid(
                "invalid Last-Event-ID: it must be the number in an event's id",
                [Problem("must be a number", where="id")],
            )
        start = int(text)
    start = await run_in_threadpool(
        _start_position, services, environment, start
    )  # raise NotFound before the stream starts
    feed: EventFeed = request.app.state.feed
    if feed.streams >= STREAMS:
        raise Unavailable("too many event streams are open: close some, or poll with follow=false")
    headers = {"cache-control": "no-store", "x-accel-buffering": "no", "x-content-type-options": "nosniff"}
    state = request.scope["state"]
    if state.get("head"):
        return StreamingResponse(_empty_stream(), media_type="text/event-stream", headers=headers)
    state[ON_STOP] = feed.close
    bearer = _StreamAuth(services.access, feed, principal, Credentials.from_scope(request.scope))
    subscription = await feed.robots.subscribe(environment) if robots else None
    stream = _stream(feed, bearer, environment, start, subscription, follow=follow)
    return StreamingResponse(stream, media_type="text/event-stream", headers=headers)


def _start_position(services: Services, environment: str | None, start: int | None) -> int:
    """Resolve the start of a stream. Default: after the newest event.

    Raises NotFound for an unknown environment, unless its last events are still to be sent. Raises Invalid for a
    position beyond the log: the client has seen another log (for example one from before a restored backup) and would
    miss events.
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
        reason = f"since={start} is beyond the event log, which ends at {newest}: use a lower number"
        raise Invalid(reason, [Problem("beyond the event log", where="since")])
    return newest if start is None else start


async def _empty_stream() -> AsyncIterator[bytes]:
    """Stream nothing, for HEAD requests."""
    lines: tuple[bytes, ...] = ()
    for line in lines:
        yield line


class _StreamAuth:
    """Check of a stream's token or session while the stream runs."""

    def __init__(self, access: Authenticator, feed: EventFeed, principal: Principal, credentials: Credentials) -> None:
        self.principal = principal
        self._access, self._feed, self._credentials = access, feed, credentials
        self._invalidated_at, self._checked = access.is_invalidated, time.monotonic()

    async def is_valid(self) -> bool:
        """Check the token. Raises Unavailable if that is impossible at the moment."""
        if self._access.insecure:
            return True
        if self.principal.has_expired():
            return False
        forgotten, now = self._access.is_invalidated, time.monotonic()
        if forgotten == self._invalidated_at and now - self._checked < RECHECK_SECONDS:
            return True
        try:
            principal = await self._feed.check(self._credentials)
        except (Unauthenticated, Throttled):
            return False
        if principal.id != self.principal.id:  # the session has ended, and its client may only read anonymously
            return False
        self._invalidated_at, self._checked = forgotten, now
        return True


async def _stream(
    feed: EventFeed,
    bearer: _StreamAuth,
    environment: str | None,
    start: int,
    robots: RobotSubscription | None,
    *,
    follow: bool,
) -> AsyncIterator[bytes]:
    feed.streams += 1
    try:
        # The id tells clients that lose the stream before its first event where to resume.
        yield b": Fleet Map Server\nretry: 2000\nid: %d\n\n" % start
        quiet = 0.0
        loop = asyncio.get_running_loop()
        while True:
            changed = feed.next_change()
            try:
                page = await feed.events(environment, start)
                if not await bearer.is_valid():
                    return
            except Unavailable:  # the log is available again when the database is
                yield b": the database is unavailable\n\n"
                await asyncio.sleep(POLL_SECONDS)
                if feed.ending:
                    return
                continue
            except NotFound:
                return  # purged: the next request returns 404
            for event in page:
                start = event.number
                if bearer.principal.can_access(
                    event.environment
                ):  # an event may carry a former name of its environment
                    yield event.line
            changes = b"" if robots is None else robots.take(bearer.principal)
            if changes:
                yield changes
            if page or changes:
                quiet = 0.0
                continue
            if not follow or feed.ending:
                return
            before = loop.time()
            await feed.wait(changed, KEEP_ALIVE_SECONDS, robots)
            quiet += loop.time() - before
            if quiet >= KEEP_ALIVE_SECONDS:
                quiet = 0.0
                yield b": keep-alive\n\n"
    finally:
        feed.streams -= 1
        if robots is not None:
            robots.close()


def _line(event: Event, number: int) -> bytes:
    return b"id: %d\nevent: %s\ndata: %s\n\n" % (number, str(event.body["type"]).encode(), orjson.dumps(event.body))


def answer_zenoh_query(
    services: Services, max_bytes: int, environment: str, rest: str, parameters: Mapping[str, str]
) -> Reply | DeferredReply:
    """Answer a Zenoh query like HTTP at ``/environments/{environment}/versions/{rest}``.

    ``rest`` is ``{v}/version`` or ``{v}/maps/{format}/…``; a map that is not cached gives a deferred reply, which
    converts it. ``server/where`` answers like ``/environments?contains=``.

    max_bytes: maximum size of a reply. Blocks. Raises the same errors as the HTTP calls.
    """
    if (environment, rest) == messages.POSITION_QUERY:
        return _locate(services, parameters)
    pieces = rest.split("/")
    if pieces[1:] == ["version"]:
        version = services.store.versions.get_committed(environment, parse_version_ref(pieces[0]))
        _no_parameters(parameters)
        return Reply(orjson.dumps(version.as_dict()), "application/json")
    if len(pieces) < 3 or pieces[1] != "maps":
        raise NotFound("unknown key: use {v}/version, {v}/maps/{format} or {v}/maps/{format}/{file}")
    values = dict(parameters)
    derive = values.pop("derive", "true")
    if derive not in ("true", "false"):
        raise Invalid("derive must be true or false", [Problem("must be true or false", where="derive")])
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
    """Find the environments at a position, best match first, as over HTTP."""
    given = dict(parameters)
    latitude, longitude = given.pop("lat", None), given.pop("lon", None)
    if given or latitude is None or longitude is None:
        raise Invalid(
            "invalid position: give lat and lon in degrees, and no other parameter, as in "
            "server/where?lat=53.2687;lon=-0.5244",
            [Problem("give lat and lon", where="parameters")],
        )
    hits, _ = services.store.areas.locate(*parse_position(f"{latitude},{longitude}", "lat,lon"), limit=MAX_ENVIRONMENTS)
    return Reply(orjson.dumps([as_dict(environment, match) for environment, match in hits]), "application/json")


def _reply_from(file: CachedFile, max_bytes: int) -> Reply:
    if file.size > max_bytes:
        raise TooLarge(f"the map has {file.size} bytes; the limit over Zenoh is {max_bytes}: fetch it over HTTP")
    return Reply(file.read(), file.media_type)


def _no_parameters(parameters: Mapping[str, Any]) -> None:
    for name in parameters:
        raise Invalid(f"unknown parameter {name[:80]!r}: a version takes none", [Problem("unknown", where=name[:80])])

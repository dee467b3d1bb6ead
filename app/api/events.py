"""Events as server-sent events, resumable, and the same maps over Zenoh.

A stream of one environment has its ``sequence`` as ids, a stream of several the place in the log of all.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Mapping
from typing import Annotated, Any

import orjson
from fastapi import APIRouter, Header, Query, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response, StreamingResponse

from app.api.access import Principal, Viewer
from app.api.answers import Route
from app.api.maps import number_of
from app.api.schemas import told
from app.api.services import Here, Services
from app.convert.cache import Made
from app.errors import Invalid, NotFound, Problem, TooLarge, Unavailable
from app.events.bus import Answer, Make
from app.store.values import Event

LOOK_SECONDS = 0.02
"""How often a stream looks at the host's generation number."""

POLL_SECONDS = 1.0
KEEP_ALIVE_SECONDS = 15.0
PAGE = 200
STREAMS = 1000
"""So many streams at once for each worker."""

router = APIRouter(tags=["events"], route_class=Route)


class Feed:
    """Who listens at this moment: all wait for one look at the store."""

    def __init__(self, here: Services) -> None:
        self._here = here
        self._changed = asyncio.Event()
        self._task: asyncio.Task[None] | None = None
        self.streams = 0

    async def wait(self, seconds: float) -> None:
        """Until something was committed, at most this long."""
        if self._task is None or self._task.done():
            self._task = asyncio.create_task(self._look())
        changed = self._changed
        try:
            async with asyncio.timeout(seconds):
                await changed.wait()
        except TimeoutError:
            return

    async def _look(self) -> None:
        seen = self._here.store.generation()
        last = 0.0
        while self.streams:
            await asyncio.sleep(LOOK_SECONDS)
            last += LOOK_SECONDS
            now = self._here.store.generation()
            if now != seen or last > POLL_SECONDS:
                seen, last = now, 0.0
                self._changed.set()
                self._changed = asyncio.Event()


@router.get(
    "/events",
    response_class=Response,
    responses={
        **told(None, 404, 503),
        200: {"description": "A stream that does not end", "content": {"text/event-stream": {}}},
    },
    summary="Events as they happen",
)
async def stream_events(
    request: Request,
    here: Here,
    who: Viewer,
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
        who.enter(environment)
    start = since
    if last_event_id is not None and last_event_id.strip():
        text = last_event_id.strip()
        if not (text.isascii() and text.isdigit() and len(text) <= 18):
            raise Invalid("Last-Event-ID is a number from an event's id", [Problem("not a number", where="id")])
        start = int(text)
    if start is None:
        start = await run_in_threadpool(_now, here, environment)
    elif environment is not None:
        await run_in_threadpool(here.store.events, environment, start, 1)  # NotFound comes before the stream
    feed: Feed = request.app.state.feed
    if feed.streams >= STREAMS:
        raise Unavailable("too many streams of events are open: close some, or poll with follow=false")
    headers = {"cache-control": "no-store", "x-accel-buffering": "no", "x-content-type-options": "nosniff"}
    stream = _stream(here, feed, who, environment, start, follow=follow)
    return StreamingResponse(stream, media_type="text/event-stream", headers=headers)


def _now(here: Services, environment: str | None) -> int:
    if environment is None:
        return here.store.last_position()
    return here.store.last_sequence(environment)


async def _stream(
    here: Services, feed: Feed, who: Principal, environment: str | None, start: int, *, follow: bool
) -> AsyncIterator[bytes]:
    feed.streams += 1
    try:
        yield b": Fleet Map Server\nretry: 2000\n\n"
        quiet = 0.0
        loop = asyncio.get_running_loop()
        while True:
            try:
                page = await run_in_threadpool(here.store.events, environment, start, PAGE)
            except Unavailable:  # the log is still there when the database is back
                yield b": the database is away\n\n"
                await asyncio.sleep(POLL_SECONDS)
                continue
            except NotFound:
                return  # purged: whoever asks again is told so
            for event in page:
                start = event.sequence if environment is not None else event.position
                if environment is not None or who.may_enter(event.environment):
                    yield _line(event, start)
            if page:
                quiet = 0.0
                continue
            if not follow:
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


def ask(here: Services, most: int, environment: str, rest: str, parameters: Mapping[str, str]) -> Answer | Make:
    """What HTTP answers at ``/environments/{environment}/versions/{rest}``: ``{v}/version``, ``{v}/maps/{format}/…``;
    for a map that is not there, what makes it.

    most: so many bytes are answered. Blocks. Raises what the calls over HTTP answer as problems.
    """
    pieces = rest.split("/")
    version = here.store.version(environment, number_of(pieces[0]))
    if pieces[1:] == ["version"]:
        _no_parameters(parameters)
        return Answer(orjson.dumps(version.as_dict()), "application/json")
    if len(pieces) < 3 or pieces[1] != "maps":
        raise NotFound("there is a version and its maps: {v}/version, {v}/maps/{format}, {v}/maps/{format}/{file}")
    values = dict(parameters)
    derive = values.pop("derive", "true")
    if derive not in ("true", "false"):
        raise Invalid("derive must be true or false", [Problem("true or false", where="derive")])
    name, file = pieces[2], "/".join(pieces[3:]) or None
    made = here.maps.ready(here.maps.recipe(version, name, values, derive=derive == "true", file=file))
    if made is not None:
        return _file_of(made, file, most)
    return lambda: _file_of(here.maps.at_once(version, name, values, derive=derive == "true", file=file), file, most)


def _file_of(made: Made, name: str | None, most: int) -> Answer:
    found = made.whole() if name is None else made.file(name)
    if found is None:
        names = ", ".join(f.name for f in made.files[:20])
        raise NotFound(f"this map has no file {name!r}; its files are: {names}")
    if found.size > most:
        raise TooLarge(f"the map has {found.size} bytes, more than is sent over Zenoh ({most}): fetch it over HTTP")
    return Answer(found.path.read_bytes(), found.media_type)


def _no_parameters(parameters: Mapping[str, Any]) -> None:
    for name in parameters:
        raise Invalid(f"a version takes no parameter {name[:80]!r}", [Problem("unknown", where=name[:80])])

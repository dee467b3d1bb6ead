"""Response cache in memory: repeated requests of a fleet take microseconds.

A response is valid while ``Store.generation()`` is unchanged, for at most a second, and so are tokens and sessions.
Other requests take the slow path: middleware, route, recipe (the ETag), disk cache, conversion.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ParamSpec, TypeVar

from fastapi import Request
from starlette.types import Scope

from app.api.http.auth import Authenticator, Credentials, Principal, authorise
from app.api.http.caching import none_match
from app.api.http.metrics import Metrics
from app.api.http.single_flight import SingleFlight
from app.api.http.streams import Headers
from app.clock import seconds_since_boot
from app.convert.cache import CachedFile
from app.convert.recipe import Recipe
from app.errors import Denied

FRESH_SECONDS = 1.0

T = TypeVar("T")
P = ParamSpec("P")
Key = tuple[bytes, bytes]
"""Key of the cache: raw path and raw query."""


@dataclass(frozen=True, slots=True, eq=False)
class CachedResponse:
    """Cached response of an address.

    Attributes:
        recipe: None if the address is not a map.
        body: None before the conversion, or if too large for memory; ``file`` is then the one on disk.
        link: principal of the signed link, if the address is one; None if a token is required.
    """

    environment: str
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
    link: Principal | None = None


class ResponseCache:
    """LRU cache of responses by address, and single flight for their creation. Thread-safe."""

    def __init__(self, max_bytes: int, access: Authenticator, metrics: Metrics, generation: Callable[[], int]) -> None:
        self._limit, self._size = max_bytes, 0
        self.access, self._metrics, self.generation = access, metrics, generation
        self._entries: OrderedDict[Key, CachedResponse] = OrderedDict()
        self._flights: SingleFlight[tuple[Any, ...], Any] = SingleFlight()
        self._lock = threading.Lock()
        self._tallies: dict[str, list[int]] = {}

    def get_fresh(self, key: Key) -> CachedResponse | None:
        """Return the response of an address if it is still valid."""
        entry = self._entries.get(key)
        if entry is None or entry.fresh_until < seconds_since_boot() or entry.generation != self.generation():
            return None
        return entry

    def get(self, key: Key) -> CachedResponse | None:
        """Return the last response of an address, valid or not."""
        return self._entries.get(key)

    async def join(self, key: tuple[Any, ...], function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Run ``function`` in a thread and return its result; concurrent calls with the same key share one run."""
        result: T = await self._flights.run(key, function, *args, **kwargs)
        return result

    async def run_shared(self, request: Request, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Run ``function`` in a thread and return its result; concurrent requests for the same address share one run.

        Requests after a commit do not join a run that began before it. So the result may depend only on data that
        changes by commits (not on robot reports), and neither on earlier reads nor on the caller.
        """
        return await self.join((request_key(request), self.generation(), function), function, *args, **kwargs)

    def tally(self, route: str) -> list[int]:
        """Return the counters of a route's responses from memory: status 200, and 304."""
        return self._tallies.setdefault(route, [0, 0])

    def store_response(
        self,
        request: Request,
        environment: str,
        headers: Mapping[str, str],
        body: bytes,
        generation: int,
        media_type: str = "application/json",
    ) -> None:
        """Cache another response (200, with an ``etag``) that a whole fleet requests; valid until the next commit.

        generation: value from before the store was read. All callers with access to the environment get the response.
        """
        bare = [(name.encode(), value.encode()) for name, value in headers.items()]
        full = [*bare, (b"content-length", str(len(body)).encode()), (b"content-type", media_type.encode())]
        full.append((b"x-content-type-options", b"nosniff"))
        response = CachedResponse(
            environment=environment,
            recipe=None,
            etag=headers["etag"],
            raw_etag=headers["etag"].encode(),
            headers=full,
            bare=bare,
            size=len(body),
            body=body,
            file=None,
            sha256="",
            generation=generation,
            fresh_until=seconds_since_boot() + FRESH_SECONDS,
            tally=self.tally(request.scope["route"].path),
        )
        self.insert(request_key(request), response)

    def evict(self, request: Request) -> None:
        """Remove the response of an address."""
        with self._lock:
            old = self._entries.pop(request_key(request), None)
            self._size -= _entry_bytes(old) if old else 0

    def flush_counters(self) -> None:
        """Add the responses served from memory since the last call to the metrics."""
        for route, tally in list(self._tallies.items()):
            for place, status in enumerate(("200", "304")):
                new, tally[place] = tally[place], 0
                if new:
                    self._metrics.requests.labels("GET", route, status).inc(new)
                    self._metrics.memory_hits.inc(new)

    def insert(self, key: Key, response: CachedResponse) -> None:
        """Cache a response, evicting the oldest ones if necessary."""
        with self._lock:
            old = self._entries.pop(key, None)
            self._size += _entry_bytes(response) - (_entry_bytes(old) if old else 0)
            self._entries[key] = response
            while self._size > self._limit and len(self._entries) > 1:
                self._size -= _entry_bytes(self._entries.popitem(last=False)[1])

    def reply(self, scope: Scope) -> tuple[dict[str, Any], dict[str, Any]] | None:
        """Return the two ASGI messages of a cached response, or None for the slow path."""
        entry = self.get_fresh((scope.get("raw_path") or b"", scope["query_string"]))
        if entry is None:
            return None
        authorization = cookie = condition = None
        for name, value in scope["headers"]:
            if name == b"authorization":
                authorization = value
            elif name == b"cookie":
                cookie = value
            elif name == b"if-none-match":
                if condition is not None:
                    return None
                condition = value
            elif name in (b"range", b"if-match", b"available-dictionary"):
                return None
        # The signature of a link is part of the key: the first request checked it.
        credentials = Credentials.from_headers(authorization, cookie, scope)
        principal = entry.link or self.access.cached_principal(credentials)
        if principal is None or (entry.link is not None and principal.has_expired()):
            return None
        try:
            self.access.check_origin(scope["headers"])
            authorise(scope, principal, entry.environment)
        except Denied:
            return None
        if condition is not None and (
            condition == entry.raw_etag or none_match(condition.decode("latin-1"), entry.etag)
        ):
            if entry.body is None and condition.strip() == b"*":
                return None
            entry.tally[1] += 1
            return {"type": "http.response.start", "status": 304, "headers": entry.bare}, _EMPTY
        if entry.body is None:
            return None
        entry.tally[0] += 1
        body = _EMPTY if scope["method"] == "HEAD" else {"type": "http.response.body", "body": entry.body}
        return {"type": "http.response.start", "status": 200, "headers": entry.headers}, body


_EMPTY = {"type": "http.response.body", "body": b""}


def request_key(request: Request) -> Key:
    """Return the cache key of a request."""
    scope = request.scope
    return (scope.get("raw_path") or scope["path"].encode(), scope["query_string"])


def _entry_bytes(response: CachedResponse) -> int:
    return 2048 + len(response.body or b"")

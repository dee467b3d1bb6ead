"""Answers in memory, so that a fleet that asks again costs microseconds.

An answer is believed while ``Store.generation()`` stays the same and for a second at most, the caller's token likewise.
All else goes the long way: guard, route, recipe (the ETag), cache on disk, conversion.
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ParamSpec, TypeVar

from fastapi import Request
from starlette.types import Scope

from app.api.http.auth import Authenticator, Principal, authorise
from app.api.http.caching import none_match
from app.api.http.metrics import Metrics
from app.api.http.single_flight import SingleFlight
from app.api.http.streams import Headers
from app.convert.cache import CachedFile
from app.convert.recipe import Recipe
from app.errors import Denied

FRESH_SECONDS = 1.0

T = TypeVar("T")
P = ParamSpec("P")
Key = tuple[bytes, bytes]
"""Raw path and raw query."""


@dataclass(frozen=True, slots=True, eq=False)
class CachedResponse:
    """What stands at an address. recipe: None where it is no map. body: None while it is not made, or too large for
    memory; file: then the one on disk. link: the caller with the signed link that the address is; None where a token is
    needed.
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
    """Answers in memory, by address; the least recently stored go first."""

    def __init__(self, max_bytes: int, access: Authenticator, metrics: Metrics, generation: Callable[[], int]) -> None:
        self._limit, self._size = max_bytes, 0
        self.access, self._metrics, self.generation = access, metrics, generation
        self._entries: OrderedDict[Key, CachedResponse] = OrderedDict()
        self._flights: SingleFlight[tuple[Any, ...], Any] = SingleFlight()
        self._lock = threading.Lock()
        self._tallies: dict[str, list[int]] = {}

    def get_fresh(self, key: Key) -> CachedResponse | None:
        """What is known to stand there at this moment."""
        entry = self._entries.get(key)
        if entry is None or entry.fresh_until < time.monotonic() or entry.generation != self.generation():
            return None
        return entry

    def get(self, key: Key) -> CachedResponse | None:
        """What stood there when it was last looked up."""
        return self._entries.get(key)

    async def join(self, key: tuple[Any, ...], function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """What ``function`` finds, called in a thread: one call for all who come with this key meanwhile."""
        result: T = await self._flights.run(key, function, *args, **kwargs)
        return result

    async def run_shared(self, request: Request, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """What ``function`` finds, called in a thread: one look for all who ask for this address at the same moment.

        Nobody joins a look that began before the last commit. So what it finds must depend on what commits tell of
        alone (robots' reports are not), and on nothing that was found before it, nor on who asks.
        """
        return await self.join((request_key(request), self.generation(), function), function, *args, **kwargs)

    def tally(self, route: str) -> list[int]:
        """The counters of a route's answers from memory: status 200, and 304."""
        return self._tallies.setdefault(route, [0, 0])

    def store_response(
        self, request: Request, environment: str, headers: Mapping[str, str], body: bytes, generation: int
    ) -> None:
        """Another answer (200, with an ``etag``) that a whole fleet asks for at once; good until the next commit.

        generation: as it was before the store was asked. Whoever may enter the environment gets it.
        """
        bare = [(name.encode(), value.encode()) for name, value in headers.items()]
        full = [*bare, (b"content-length", str(len(body)).encode()), (b"content-type", b"application/json")]
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
            fresh_until=time.monotonic() + FRESH_SECONDS,
            tally=self.tally(request.scope["route"].path),
        )
        self.insert(request_key(request), response)

    def evict(self, request: Request) -> None:
        """Drop what is remembered of an address."""
        with self._lock:
            old = self._entries.pop(request_key(request), None)
            self._size -= _entry_bytes(old) if old else 0

    def flush_counters(self) -> None:
        """Add what was answered from memory since the last call to the metrics."""
        for route, tally in list(self._tallies.items()):
            for place, status in enumerate(("200", "304")):
                new, tally[place] = tally[place], 0
                if new:
                    self._metrics.requests.labels("GET", route, status).inc(new)
                    self._metrics.memory_hits.inc(new)

    def insert(self, key: Key, response: CachedResponse) -> None:
        """Remember an answer; others go where there is no room for it."""
        with self._lock:
            old = self._entries.pop(key, None)
            self._size += _entry_bytes(response) - (_entry_bytes(old) if old else 0)
            self._entries[key] = response
            while self._size > self._limit and len(self._entries) > 1:
                self._size -= _entry_bytes(self._entries.popitem(last=False)[1])

    def reply(self, scope: Scope) -> tuple[dict[str, Any], dict[str, Any]] | None:
        """The two messages of an answer to a request, or None where it takes the long way."""
        entry = self.get_fresh((scope.get("raw_path") or b"", scope["query_string"]))
        if entry is None:
            return None
        authorization = condition = None
        for name, value in scope["headers"]:
            if name == b"authorization":
                authorization = value
            elif name == b"if-none-match":
                if condition is not None:
                    return None
                condition = value
            elif name in (b"range", b"if-match", b"available-dictionary"):
                return None
        # The signature of a link is part of the key: it was checked with the first request.
        principal = entry.link or self.access.cached_principal(authorization)
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
    """Where the answer to a request is remembered."""
    scope = request.scope
    return (scope.get("raw_path") or scope["path"].encode(), scope["query_string"])


def _entry_bytes(response: CachedResponse) -> int:
    return 2048 + len(response.body or b"")

"""Single flight: coalesce concurrent calls with the same key into one."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Hashable
from typing import Any, Generic, ParamSpec, TypeVar

from starlette.concurrency import run_in_threadpool

K = TypeVar("K", bound=Hashable)
T = TypeVar("T")
P = ParamSpec("P")


class SingleFlight(Generic[K, T]):
    """Running calls by key, on one event loop.

    The meaning of a key must not change during a call. If a commit changes the result, the key must contain the
    store's generation, because a client that knows of the commit must not get an older result.
    """

    def __init__(self) -> None:
        self._running: dict[K, asyncio.Future[T]] = {}

    async def run(self, key: K, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Run ``function`` in a thread, or join the call with the same key; errors go to all callers.

        The call continues if the caller that started it is cancelled.
        """
        running = self._running.get(key)
        if running is None:
            running = asyncio.ensure_future(run_in_threadpool(function, *args, **kwargs))
            self._running[key] = running
            running.add_done_callback(lambda done: self._done(key, done))
        return await asyncio.shield(running)

    def _done(self, key: K, done: asyncio.Future[Any]) -> None:
        self._running.pop(key, None)
        if not done.cancelled():
            done.exception()  # mark the exception as retrieved: there may be no caller left

"""Work that is done once for all who want it at the same moment: a fleet that asks at once costs one look."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Hashable
from typing import Any, Generic, ParamSpec, TypeVar

from starlette.concurrency import run_in_threadpool

K = TypeVar("K", bound=Hashable)
T = TypeVar("T")
P = ParamSpec("P")


class SingleFlight(Generic[K, T]):
    """Calls under way, by key, on one event loop.

    What a key stands for must not change while its call runs: where a commit changes the answer, the store's generation
    belongs into the key, for who comes after the commit may have been told of it.
    """

    def __init__(self) -> None:
        self._running: dict[K, asyncio.Future[T]] = {}

    async def run(self, key: K, function: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """The result of ``function``, called in a thread by the first who asks; what it raises goes to all.

        It goes on where the one who began it goes away.
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
            done.exception()  # looked at by whoever waits; nobody may be left

"""Changes of robots for streams of events: each environment that has such streams is read for all of them at once.

Reports are no commits and have no log, so the stored robots are compared with the last ones sent. That works for any
number of worker processes, and costs nothing if no stream wants it.
"""

from __future__ import annotations

import asyncio
import logging
import time
from datetime import UTC, datetime, timedelta
from weakref import WeakSet

import orjson
from starlette.concurrency import run_in_threadpool

from app.api.http.auth import Principal
from app.api.http.dependencies import Services
from app.api.http.problems import describe
from app.api.robots import robots_as_json
from app.errors import NotFound, Unavailable

log = logging.getLogger(__name__)

POLL_SECONDS = 0.2
ROBOT_SECONDS = 1.0
"""Minimum number of seconds between two messages about one robot."""

COMPLETE_SECONDS = 5.0
"""Seconds between comparisons of all robots: their presence and lag change without a report."""

COMMIT_SECONDS = 1.0
"""The same after a commit, which may have moved a channel."""

MAX_LOAD = 0.1
"""Maximum share of time for comparisons of all robots."""

REPORT_OVERLAP = timedelta(seconds=10)
"""Reports are read again for this long, since another process may store one later than it received it."""

RETRY_SECONDS = 1.0

RobotKey = tuple[str, str]
"""Environment and robot."""


class RobotSubscription:
    """Changes that one stream has not sent yet: only the newest of each robot, so that memory is bounded."""

    def __init__(self) -> None:
        self.is_closed = False
        self._lines: dict[RobotKey, bytes] = {}
        self._changed = asyncio.Event()

    async def wait(self) -> None:
        """Wait for a change."""
        await self._changed.wait()

    def add(self, lines: dict[RobotKey, bytes]) -> None:
        """Add changes."""
        self._lines |= lines
        self._changed.set()

    def close(self) -> None:
        """End the subscription."""
        self.is_closed = True

    def take(self, principal: Principal) -> bytes:
        """Return and remove the changes; those that the principal cannot access are dropped."""
        lines, self._lines = self._lines, {}
        self._changed.clear()
        return b"".join(line for (environment, _), line in lines.items() if principal.can_access(environment))


class RobotFeed:
    """Feed for all streams of a process."""

    def __init__(self, services: Services) -> None:
        self._services = services
        self._watches: dict[str | None, _Watch] = {}

    async def subscribe(self, environment: str | None) -> RobotSubscription:
        """Subscribe to all changes from now on. None: of all environments. Raises NotFound or Unavailable.

        The subscription ends with ``close``, or when nothing refers to it.
        """
        subscription = RobotSubscription()
        watch = self._watches.get(environment)
        if watch is None or not watch.is_running:
            watch = self._watches[environment] = _Watch(self._services, environment)
        watch.subscriptions.add(subscription)
        await watch.start()
        for name in [name for name, other in self._watches.items() if not other.is_running]:
            del self._watches[name]
        return subscription


class _Watch:
    """Comparison of the robots of one environment, or of all (None), while there are subscriptions."""

    def __init__(self, services: Services, environment: str | None) -> None:
        self.subscriptions: WeakSet[RobotSubscription] = WeakSet()
        self._services, self._environment = services, environment
        self._sent: dict[RobotKey, tuple[int, float]] = {}
        self._pending: dict[RobotKey, bytes] = {}
        self._newest = datetime.fromtimestamp(0, UTC)
        self._generation = 0
        self._completed, self._duration = 0.0, 0.0
        self._task: asyncio.Task[None] | None = None
        self._baseline: asyncio.Future[None] | None = None

    @property
    def is_running(self) -> bool:
        """Whether it is starting or comparing."""
        starting = self._baseline is not None and not self._baseline.done()
        return starting or (self._task is not None and not self._task.done())

    async def start(self) -> None:
        """Read the robots to compare with, unless another stream has. Raises NotFound or Unavailable."""
        if self._baseline is None:
            self._baseline = asyncio.ensure_future(self._read_baseline())
        await asyncio.shield(self._baseline)

    async def _read_baseline(self) -> None:
        lines = await run_in_threadpool(self._read, True)
        self._sent = {key: (hash(line), 0.0) for key, line in lines.items()}
        self._task = asyncio.create_task(self._run())

    async def _run(self) -> None:
        while not all(subscription.is_closed for subscription in self.subscriptions):
            await asyncio.sleep(POLL_SECONDS)
            complete = self._is_complete_due()
            try:
                lines = await run_in_threadpool(self._read, complete)
            except Unavailable:
                await asyncio.sleep(RETRY_SECONDS)
            except NotFound:
                return  # deleted or renamed: its streams end
            except Exception as error:  # noqa: BLE001  all streams share this task: it must not end
                log.error("robots: reading their changes failed, will retry: %s", describe(error))  # noqa: TRY400
                await asyncio.sleep(RETRY_SECONDS)
            else:
                if complete:
                    self._sent = {key: sent for key, sent in self._sent.items() if key in lines}
                self._publish(lines, time.monotonic())

    def _is_complete_due(self) -> bool:
        age = time.monotonic() - self._completed
        has_commit = self._services.store.generation() != self._generation
        return age >= max(COMMIT_SECONDS if has_commit else COMPLETE_SECONDS, self._duration / MAX_LOAD)

    def _read(self, complete: bool) -> dict[RobotKey, bytes]:
        """Read all robots, or those with new reports, as messages. Blocks."""
        store, started = self._services.store, time.monotonic()
        generation = store.generation()
        if complete:
            robots = store.robots.all(self._environment)
        else:
            robots = store.robots.received_since(self._environment, self._newest - REPORT_OVERLAP)
        bodies = robots_as_json(self._services, robots)
        lines = {(body["environment"], body["robot"]): _line(body) for body in bodies}
        self._newest = max((robot.time for robot in robots), default=self._newest)
        if complete:
            self._completed, self._generation = time.monotonic(), generation
            self._duration = self._completed - started
        return lines

    def _publish(self, lines: dict[RobotKey, bytes], now: float) -> None:
        changes = {}
        candidates, self._pending = {**self._pending, **lines}, {}
        for key, line in candidates.items():
            digest, sent = self._sent.get(key, (0, 0.0))
            if hash(line) == digest:
                continue
            if now - sent < ROBOT_SECONDS:
                self._pending[key] = line
                continue
            self._sent[key] = hash(line), now
            changes[key] = line
        if changes:
            for subscription in list(self.subscriptions):
                subscription.add(changes)


def _line(body: dict[str, object]) -> bytes:
    return b"event: robot.status\ndata: %s\n\n" % orjson.dumps(body)

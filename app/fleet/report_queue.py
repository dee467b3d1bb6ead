"""Queue of robot reports: stores them in order, many in one transaction.

Reports from Zenoh wait while the database is unavailable. Simultaneous reports of a fleet need few transactions.

Of several servers, which all receive what robots publish over Zenoh, the one that relays events stores it. The others
keep the reports of the last seconds: if one of them takes over, it stores what the former leader may not have.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
import time
from collections import Counter, deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from datetime import UTC, datetime

from app.backends.lead import Lead, LeadLostError, Term
from app.errors import FleetMapError, Invalid, Unavailable
from app.events.messages import ROBOT_NAME, RobotStatus
from app.store.base import ENVIRONMENT_NAME
from app.store.fleet_values import ReceivedReport, RobotReport
from app.store.robots import MAX_PRESENT
from app.store.store import Store

log = logging.getLogger(__name__)

QUEUE_SIZE = 20_000
"""Maximum number of waiting reports; further ones are dropped and logged."""

MAX_QUEUED_PER_ROBOT = 200
"""Maximum number of waiting reports from Zenoh per robot, so that one robot cannot displace others."""

BATCH = 100
"""Maximum number of reports in one transaction: about 0.25 s on SQLite, which blocks other writers."""

PRESENCE_REFRESH_SECONDS = 15.0
"""Interval at which the time of the last check is stored, once for all robots that are present."""

SETTLE_SECONDS = 5.0
"""Time after taking over until this process has seen which robots are present, and stores the differences."""

STAND_BY_SECONDS = 10.0
"""Time for which a server that does not lead keeps reports from Zenoh."""

MAX_STAND_BY = 5_000
RETRY_SECONDS = 1.0
WARN_SECONDS = 20.0


def report_from_status(status: RobotStatus) -> RobotReport:
    """Convert a status for the store. An invalid time is dropped, since nothing depends on robots' clocks."""
    reported_at = None
    if status.time is not None:
        with contextlib.suppress(ValueError, OverflowError):
            reported_at = datetime.fromisoformat(status.time)
            reported_at = reported_at.astimezone(UTC) if reported_at.tzinfo is not None else None
    more = (status.sequence, reported_at, status.overlays, status.holds, status.place)
    return RobotReport(status.channel, status.version, status.root, status.state, status.detail, *more)


@dataclass(frozen=True, slots=True)
class _QueuedReport:
    """A waiting report. result: future of the caller; None for reports from Zenoh."""

    report: ReceivedReport
    result: Future[FleetMapError | None] | None = None


class ReportQueue:
    """Queue with a writer thread for reports and presence of robots. Thread-safe.

    ``enqueue_status`` and ``set_presence`` return at once, ``store_report`` after the report is stored.

    Args:
        lead: lead of the server that stores what comes over Zenoh.
        bus_vouches: whether reports from Zenoh count as authenticated, because the router requires users.
    """

    def __init__(
        self,
        store: Store,
        lead: Lead,
        clock: Callable[[], datetime] = lambda: datetime.now(UTC),
        *,
        bus_vouches: bool = False,
    ) -> None:
        self._store, self._lead, self._clock, self._bus_vouches = store, lead, clock, bus_vouches
        self._standby: deque[tuple[float, _QueuedReport]] = deque(maxlen=MAX_STAND_BY)
        self._term: Term | None = None
        self._leads_since = 0.0
        self._is_settled = False
        self._queue: queue.Queue[tuple[str, str, bytes, datetime] | _QueuedReport | None] = queue.Queue(QUEUE_SIZE)
        self._shares: Counter[str] = Counter()
        self._present: set[str] = set()
        self._departed: set[str] = set()
        self._has_news: set[str] = set()
        self._lock = threading.Lock()
        self._dropped_count = 0
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Start the writer thread. Further calls have no effect."""
        if self._thread is not None:
            return
        self._thread = threading.Thread(target=self._run, name="fleetmap-fleet", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Write waiting reports, then stop."""
        self._stopping.set()
        with contextlib.suppress(queue.Full):
            self._queue.put_nowait(None)
        if self._thread is not None:
            self._thread.join(10)

    def enqueue_status(self, environment: str, robot: str, payload: bytes) -> None:
        """Queue a robot's status from Zenoh, not yet parsed. Drops it if the queue is full."""
        with self._lock:
            if self._shares[robot] >= MAX_QUEUED_PER_ROBOT:
                self._dropped_count += 1
                return
            try:
                self._queue.put_nowait((environment, robot, payload, self._clock()))
            except queue.Full:
                self._dropped_count += 1
                return
            self._shares[robot] += 1

    def store_report(self, received: ReceivedReport) -> None:
        """Store a report from HTTP. Blocks until it is stored. Raises the store's error if it is rejected."""
        wait_until_stored(self.submit_report(received), WARN_SECONDS)

    def submit_report(self, received: ReceivedReport) -> Future[FleetMapError | None]:
        """Queue a report from HTTP. The future's result is None or the store's error. Raises Unavailable."""
        result: Future[FleetMapError | None] = Future()
        if self._thread is None or self._stopping.is_set():
            raise Unavailable("the server is starting or stopping: try again in a few seconds")
        try:
            self._queue.put_nowait(_QueuedReport(received, result))
        except queue.Full:
            raise Unavailable("too many waiting robot reports: try again in a few seconds") from None
        return result

    def set_presence(self, robot: str, on_bus: bool) -> None:
        """Record that a robot's Zenoh session appeared or disappeared."""
        if not ROBOT_NAME.fullmatch(robot):
            return
        with self._lock:
            if on_bus and len(self._present) < MAX_PRESENT:
                self._present.add(robot)
                self._has_news.add(robot)
                self._departed.discard(robot)
            elif not on_bus:
                self._present.discard(robot)
                self._has_news.discard(robot)
                self._departed.add(robot)
        with contextlib.suppress(queue.Full):
            self._queue.put_nowait(None)

    def _run(self) -> None:
        renewed = 0.0
        batch: list[_QueuedReport] = []
        while True:
            wait = PRESENCE_REFRESH_SECONDS / 3 if not batch else 0.0
            batch += self._take_batch(wait, BATCH - len(batch))
            renew = time.monotonic() - renewed > PRESENCE_REFRESH_SECONDS
            try:
                batch = self._share(batch)
                self._write_presence(renew=renew)
                renewed = time.monotonic() if renew else renewed
                self._write(batch)
                batch = []
            except Unavailable as error:
                log.warning("robot reports: storing delayed, will retry: %s", error.detail)
                for queued in batch:
                    _resolve_futures(queued, error)
                batch = [queued for queued in batch if queued.result is None]
                if self._stopping.wait(RETRY_SECONDS):
                    return
            except Exception:
                log.exception("robot reports: storing a batch failed; retrying one at a time")
                batch = self._write_each(batch)
            if self._stopping.is_set() and self._queue.empty():
                return

    def _share(self, batch: list[_QueuedReport]) -> list[_QueuedReport]:
        """Return what this process has to store: all reports if it leads, else only those from HTTP."""
        now, term = time.monotonic(), self._lead.term
        if term != self._term:  # also if another server has led only between two looks
            self._term, self._leads_since, self._is_settled = term, now, False
        if term is not None:
            earlier = [queued for came, queued in self._standby if now - came < STAND_BY_SECONDS]
            self._standby.clear()
            return [*earlier, *batch]
        self._standby.extend((now, queued) for queued in batch if queued.result is None)
        while self._standby and now - self._standby[0][0] > STAND_BY_SECONDS:
            self._standby.popleft()
        return [queued for queued in batch if queued.result is not None]

    def _take_batch(self, seconds: float, limit: int) -> list[_QueuedReport]:
        out: list[_QueuedReport] = []
        refused: list[str] = []
        deadline = time.monotonic() + seconds
        for _ in range(limit):
            try:
                wait = 0.0 if out or refused else max(0.0, deadline - time.monotonic())
                item = self._queue.get(timeout=wait) if wait else self._queue.get_nowait()
            except queue.Empty:
                break
            if item is None:
                break
            if isinstance(item, _QueuedReport):
                out.append(item)
                continue
            environment, robot, payload, came = item
            with self._lock:
                self._shares[robot] -= 1
                if not self._shares[robot]:
                    del self._shares[robot]
            try:
                out.append(_QueuedReport(_read(environment, robot, payload, came, vouched=self._bus_vouches)))
            except FleetMapError as error:
                refused.append(f"robot reports: dropped one of {robot!r:.128} in {environment!r:.64}: {error.detail}")
        _warn(refused)
        if self._dropped_count:
            log.error("robot reports: dropped %d, the queue is full", self._dropped_count)
            self._dropped_count = 0
        return out

    def _write(self, batch: list[_QueuedReport]) -> None:
        """Store reports, and take them out of the list: those of a robot in order.

        Others from HTTP come first, for which somebody waits. Raises LeadLostError for those from Zenoh if another
        server has taken over.
        """
        on_bus = {_robot(queued) for queued in batch if queued.result is None} if self._term is not None else set()
        self._write_batch([q for q in batch if q.result is not None and _robot(q) not in on_bus])
        batch[:] = [q for q in batch if q.result is None or _robot(q) in on_bus]
        try:
            while batch and self._term is not None:  # after a takeover there are up to MAX_STAND_BY
                with self._term.fenced():
                    self._write_batch(batch[:BATCH])
                del batch[:BATCH]
        except LeadLostError:
            self._write_batch([queued for queued in batch if queued.result is not None])
            batch[:] = [queued for queued in batch if queued.result is None]
            raise

    def _write_batch(self, batch: list[_QueuedReport]) -> None:
        if not batch:
            return
        unheard: list[str] = []
        for queued, refused in zip(
            batch, self._store.robots.note_reports([queued.report for queued in batch]), strict=True
        ):
            if refused is not None and queued.result is None:
                unheard.append(f"robot reports: dropped one of {queued.report.robot}: {refused.detail}")
            _resolve_futures(queued, refused)
        _warn(unheard)

    def _write_each(self, batch: list[_QueuedReport]) -> list[_QueuedReport]:
        """Store reports one at a time, so that a bad one affects no other. Return those to retry."""
        left = []
        for queued in batch:
            try:
                self._write([queued])
            except Unavailable as error:
                _resolve_futures(queued, error)
                left += [queued] if queued.result is None else []
            except Exception:
                log.exception("robot reports: dropped one of %s", queued.report.robot)
                _resolve_futures(queued, Unavailable("internal server error; details are in the server log"))
        return left

    def _write_presence(self, *, renew: bool) -> None:
        """Store the robots that came or went. renew: also that the others are still present."""
        with self._lock:
            arrived, departed = set(self._has_news), set(self._departed)
            has_robots = bool(self._present)
        if self._term is not None:
            with self._term.fenced():
                new, gone = self._settle(arrived, departed)
                if new and not self._is_settled:  # a restarted server sees all robots again
                    new -= self._store.robots.present_robots()
                if new or gone:
                    self._store.robots.note_presence(new, gone, self._clock())
                if renew and self._is_settled and has_robots:
                    self._store.robots.renew_presence(self._clock())
        with self._lock:
            self._has_news -= arrived
            self._departed -= departed

    def _settle(self, arrived: set[str], departed: set[str]) -> tuple[set[str], set[str]]:
        """Add, once after taking over, what the stored presence lacks: changes that no server has stored."""
        if self._is_settled or time.monotonic() - self._leads_since < SETTLE_SECONDS:
            return arrived, departed
        stored = self._store.robots.present_robots()
        with self._lock:
            present = set(self._present)
        self._is_settled = True
        return arrived | (present - stored), departed | (stored - present)


def wait_until_stored(result: Future[FleetMapError | None], seconds: float = 0.0) -> None:
    """Wait until a report is stored. Raises the store's error if it is rejected, Unavailable after ``seconds``."""
    try:
        refused = result.result(seconds)
    except TimeoutError:
        raise Unavailable("the report could not be stored in time: try again in a few seconds") from None
    if refused is not None:
        raise refused


def _robot(queued: _QueuedReport) -> tuple[str, str]:
    return queued.report.environment, queued.report.robot


def _resolve_futures(queued: _QueuedReport, refused: FleetMapError | None) -> None:
    if queued.result is not None and not queued.result.done():
        queued.result.set_result(refused)


def _warn(reasons: list[str]) -> None:
    """Log the first reason and the number of others, so that invalid reports do not fill the log."""
    if reasons:
        log.warning("%s%s", reasons[0], f" (and {len(reasons) - 1} others)" if len(reasons) > 1 else "")


def _read(environment: str, robot: str, payload: bytes, time: datetime, *, vouched: bool) -> ReceivedReport:
    if not ROBOT_NAME.fullmatch(robot) or not ENVIRONMENT_NAME.fullmatch(environment):
        raise Invalid("invalid name of robot or environment")
    return ReceivedReport(environment, robot, report_from_status(RobotStatus.from_json(payload)), time, vouched)

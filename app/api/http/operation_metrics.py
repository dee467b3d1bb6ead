"""Metrics for what an operator has to act on: robots, rollouts, closures, events, disks, cache, certificates, clock.

A scrape costs SQL counts over indexes and a few system calls, whatever the number of robots and stored data. Each
server reports its own disks, certificates and clock, and all servers on one database the same figures of the fleet.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Final

from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from app import __version__
from app.backends.room import disk_room
from app.convert.cache import Cache
from app.errors import FleetMapError
from app.events.leader import read_state
from app.fleet.status import PRESENCE_FRESH, REPORT_FRESH
from app.store.store import Store

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Gauge:
    """A metric: name, meaning, names of its labels."""

    name: str
    meaning: str
    labels: tuple[str, ...] = ()


Sample = tuple[Gauge, tuple[str, ...], float]
"""A gauge, its labels' values, its value."""

Source = Callable[[], Iterable[Sample]]
"""Function that reads the values of some gauges. It may raise FleetMapError and OSError."""

CHANNEL = ("environment", "channel")

INFO = Gauge("fleetmap_info", "Version of the program; the value is 1.", ("version",))
ROBOTS = Gauge(
    "fleetmap_robots",
    "Number of robots, by whether they run the map and the closures of their channel: `holding`, `lagging`, or "
    "`failed` if they do not and reported a failure. Offline robots count.",
    (*CHANNEL, "status"),
)
LATE_ROBOTS = Gauge(
    "fleetmap_robots_late",
    "Number of robots that are online, do not run the map of their channel, and took theirs over 15 minutes ago. If "
    "over 1000 robots are behind, counted once a minute.",
    CHANNEL,
)
ROLLOUT = Gauge(
    "fleetmap_rollout_overdue_seconds",
    "Seconds since an open rollout could have gone on: `waiting` for robots since its time or its start, `watching` "
    "since the end of its watch; 0 before.",
    (*CHANNEL, "state"),
)
MOVES = Gauge(
    "fleetmap_moves_overdue_seconds", "Seconds that the most overdue planned move of a channel is late; 0 without one."
)
CLOSURES = Gauge("fleetmap_closures", "Number of closures in force.", ("environment",))
ENDING_CLOSURES = Gauge(
    "fleetmap_closures_ending",
    "Number of closures that end within an hour, of those in force for at least 6 hours.",
    ("environment",),
)
PENDING = Gauge(
    "fleetmap_overlays_pending", "Number of reported obstructions that wait for an editor.", ("environment",)
)
UNSENT = Gauge("fleetmap_events_unsent", "Number of events that were not handed to Zenoh yet.")
OLDEST_UNSENT = Gauge("fleetmap_events_oldest_unsent_seconds", "Age of the oldest of these events in seconds, else 0.")
CONNECTED = Gauge("fleetmap_events_connected", "Whether this server is connected to its Zenoh router.")
DISK_FREE = Gauge("fleetmap_disk_free_bytes", "Free space for the server on the disk of a folder.", ("folder",))
DISK_SIZE = Gauge("fleetmap_disk_size_bytes", "Size of the disk of a folder.", ("folder",))
DISK_INODES = Gauge("fleetmap_disk_inodes", "Number of files that the disk of a folder can have.", ("folder",))
DISK_FREE_INODES = Gauge(
    "fleetmap_disk_free_inodes", "Number of further files that the disk of a folder can have.", ("folder",)
)
WRITABLE = Gauge("fleetmap_writable", "Whether data can be stored: 0 while the server is read-only.")
CACHE = Gauge("fleetmap_cache_bytes", "Size of the map cache on disk, as this process has counted it.")
CACHE_LIMIT = Gauge("fleetmap_cache_limit_bytes", "Size limit of the map cache on disk.")
CACHE_PROBLEM = Gauge("fleetmap_cache_problem", "Whether maps cannot be written to the cache on disk.")
CERTIFICATE = Gauge(
    "fleetmap_certificate_left_seconds",
    "Seconds until the end of a certificate that the server has loaded: `https`, `zenoh`, or `zenoh_ca`, the authority "
    "for Zenoh. Negative after its end.",
    ("certificate",),
)
CLOCK = Gauge("fleetmap_clock_offset_seconds", "Seconds by which PostgreSQL's clock is ahead of this server's.")

GAUGES: Final = tuple(value for value in list(globals().values()) if isinstance(value, Gauge))
"""All gauges of a server."""

WORKER_GAUGES: Final = (INFO, DISK_FREE, DISK_SIZE, DISK_INODES, DISK_FREE_INODES)


class OperationCollector(Collector):
    """Collector of sources. A source that fails is left out and logged once, so that the others stay visible.

    gauges: those that are named even without a value.
    """

    def __init__(self, sources: Iterable[Source], gauges: Iterable[Gauge] = GAUGES) -> None:
        self._sources, self._gauges = tuple(sources), tuple(gauges)
        self._failed: set[int] = set()

    def collect(self) -> Iterable[Metric]:
        """Yield the gauges with their values."""
        families = {g.name: GaugeMetricFamily(g.name, g.meaning, labels=g.labels) for g in self._gauges}
        for number, source in enumerate(self._sources):
            try:
                samples = list(source())
            except (FleetMapError, OSError) as error:
                if number not in self._failed:
                    reason = error.detail if isinstance(error, FleetMapError) else error.strerror
                    log.warning("metrics: some figures are missing (reason=%s)", reason)
                self._failed.add(number)
                continue
            self._failed.discard(number)
            for gauge, values, value in samples:
                families[gauge.name].add_metric(values, value)
        yield from families.values()


def info() -> Iterator[Sample]:
    """Read the version of the program."""
    yield INFO, (__version__,), 1.0


@dataclass(frozen=True, slots=True)
class FleetSource:
    """Figures of the fleet, which all servers on a database share."""

    store: Store

    def __call__(self) -> Iterator[Sample]:
        """Read them."""
        now, fleet = self.store.now(), self.store.fleet_figures
        for robots in fleet.robots(on_bus_after=now - PRESENCE_FRESH, heard_after=now - REPORT_FRESH):
            labels = robots.environment, robots.channel
            for status in ("holding", "lagging", "failed"):
                yield ROBOTS, (*labels, status), getattr(robots, status)
            yield LATE_ROBOTS, labels, robots.late
        for rollout in fleet.rollouts():
            yield ROLLOUT, (rollout.environment, rollout.channel, rollout.state), rollout.overdue
        yield MOVES, (), fleet.overdue_moves()
        for overlays in fleet.overlays():
            labels_of = (overlays.environment,)
            yield CLOSURES, labels_of, overlays.in_force
            yield ENDING_CLOSURES, labels_of, overlays.ending
            yield PENDING, labels_of, overlays.pending
        offset = self.store.clock_offset()
        if offset is not None:
            yield CLOCK, (), offset


@dataclass(frozen=True, slots=True)
class EventSource:
    """Figures of the events to Zenoh; not of a server that publishes none."""

    store: Store
    data_dir: Path

    def __call__(self) -> Iterator[Sample]:
        """Read them."""
        number, oldest = self.store.events.unsent(self.store.now())
        yield UNSENT, (), number
        yield OLDEST_UNSENT, (), oldest
        yield CONNECTED, (), read_state(self.data_dir, "events")["state"] == "connected"


@dataclass(frozen=True, slots=True)
class DiskSource:
    """Free space of folders, by name; of several on one disk only the first."""

    folders: Mapping[str, Path]

    def __call__(self) -> Iterator[Sample]:
        """Read it."""
        devices = set()
        for name, folder in self.folders.items():
            room = disk_room(folder)
            if room.device not in devices:
                yield DISK_SIZE, (name,), room.size
                yield DISK_FREE, (name,), room.free
                if room.inodes:
                    yield DISK_INODES, (name,), room.inodes
                    yield DISK_FREE_INODES, (name,), room.free_inodes
            devices.add(room.device)


@dataclass(frozen=True, slots=True)
class ServerSource:
    """State of this server. refusal: returns why nothing can be stored, or None."""

    cache: Cache
    refusal: Callable[[], str | None]

    def __call__(self) -> Iterator[Sample]:
        """Read it."""
        yield WRITABLE, (), self.refusal() is None
        yield CACHE, (), self.cache.size
        yield CACHE_LIMIT, (), self.cache.limit
        yield CACHE_PROBLEM, (), self.cache.problem is not None


@dataclass(frozen=True, slots=True)
class CertificateSource:
    """Ends of certificates, by their use, as they were when the server loaded them."""

    now: Callable[[], datetime]
    ends: Mapping[str, datetime] = field(default_factory=dict)

    def __call__(self) -> Iterator[Sample]:
        """Compute the seconds that are left."""
        for name, end in self.ends.items():
            yield CERTIFICATE, (name,), (end - self.now()).total_seconds()

"""Prometheus metrics: requests, conversions, cache hits, heads.

With several worker processes prometheus_client keeps the counters in files (``PROMETHEUS_MULTIPROC_DIR``, set by
``app.main.serve``), and any worker returns those of all.
"""

from __future__ import annotations

import contextlib
import math
import os
import time
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from pathlib import Path

from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest, multiprocess
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from app.api.http.mirror_metrics import MirrorCollector
from app.api.http.operation_metrics import OperationCollector
from app.backends.lead import Leads
from app.backends.queue import QueueFigures
from app.store.scrub import current_state, figures
from app.store.store import Store

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
MAX_HEADS = 10_000


class Metrics:
    """Counters of one application."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self.requests = Counter(
            "fleetmap_requests", "Number of requests.", ["method", "route", "status"], registry=self.registry
        )
        self.seconds = Histogram(
            "fleetmap_request_seconds",
            "Seconds until the end of a response, without responses from memory.",
            ["route"],
            registry=self.registry,
            buckets=(0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1, 3, 10, 30, 100),
        )
        self.conversions = Counter(
            "fleetmap_conversions", "Number of conversions.", ["format", "result"], registry=self.registry
        )
        hits = Counter("fleetmap_cache_hits", "Number of maps served from a cache.", ["cache"], registry=self.registry)
        self.memory_hits = hits.labels("memory")
        self.disk_hits = hits.labels("disk")
        self.cache_damaged = Counter(
            "fleetmap_cache_damaged",
            "Number of damaged maps in the cache, which were converted again.",
            registry=self.registry,
        )
        self.uploads = Counter("fleetmap_uploads", "Number of uploads and edits.", ["result"], registry=self.registry)

        self.queue: Callable[[], QueueFigures] | None = None
        self.operation: OperationCollector | None = None
        self._reserve()

    def _reserve(self) -> None:
        """Allocate disk space for this process's shared counters.

        A write to a sparse file on a full disk would kill the process.
        """
        folder = os.environ.get("PROMETHEUS_MULTIPROC_DIR")
        if folder:
            self.seconds.labels("other")  # creates the file of the histograms
            for path in Path(folder).glob(f"*_{os.getpid()}.db"):
                with contextlib.suppress(OSError), path.open("r+b") as file:
                    os.posix_fallocate(file.fileno(), 0, os.fstat(file.fileno()).st_size)

    def render(self, store: Store, leads: Leads) -> bytes:
        """Write all metrics in the text format of Prometheus."""
        registry = self.registry
        if os.environ.get("PROMETHEUS_MULTIPROC_DIR"):
            registry = CollectorRegistry()
            multiprocess.MultiProcessCollector(registry)  # type: ignore[no-untyped-call]
        heads = CollectorRegistry()
        heads.register(_HeadVersionCollector(store))
        heads.register(_Scrubs(store))
        heads.register(_Backups(store))
        heads.register(_Webhooks(store))
        if self.queue is not None:
            heads.register(QueueCollector(self.queue))
        heads.register(_Leaders(leads))
        if self.operation is not None:
            heads.register(self.operation)
        heads.register(MirrorCollector(store))
        return generate_latest(registry) + generate_latest(heads)


class _HeadVersionCollector(Collector):
    """Head version of every environment, and the number of environments."""

    def __init__(self, store: Store) -> None:
        self._store = store

    def collect(self) -> Iterable[Metric]:
        heads = GaugeMetricFamily("fleetmap_head", "Number of an environment's newest version.", labels=["environment"])
        count, cursor = 0, None
        while count < MAX_HEADS:
            page, cursor = self._store.environments.page(limit=1000, cursor=cursor)
            for environment in page:
                heads.add_metric([environment.name], environment.head)
            count += len(page)
            if cursor is None:
                break
        yield heads
        yield GaugeMetricFamily("fleetmap_environments", "Environments that are not deleted.", value=count)


class _Leaders(Collector):
    """Tasks that one server at a time does."""

    def __init__(self, leads: Leads) -> None:
        self._leads = leads

    def collect(self) -> Iterable[Metric]:
        gauge = GaugeMetricFamily(
            "fleetmap_leader",
            "Whether this server does a task that one server at a time does, by task.",
            labels=["task"],
        )
        for name, leads in sorted(self._leads.roles().items()):
            gauge.add_metric([name], leads)
        yield gauge


class _Scrubs(Collector):
    """Age and findings of the last complete check of stored data."""

    def __init__(self, store: Store) -> None:
        self._store = store

    def collect(self) -> Iterable[Metric]:
        state = figures(current_state(self._store))
        age = "Seconds since the last complete check of all stored data; +Inf before the first one."
        yield GaugeMetricFamily("fleetmap_scrub_age_seconds", age, value=state["age"])
        yield GaugeMetricFamily(
            "fleetmap_scrub_running", "Whether a check of all stored data is running.", value=state["running"]
        )
        findings = GaugeMetricFamily(
            "fleetmap_scrub_findings", "Number of damaged items found by the check, by kind.", labels=["kind"]
        )
        for kind, count in state["findings"].items():
            findings.add_metric([kind], count)
        yield findings


class _Backups(Collector):
    """Age of the last successful backup, and failures since."""

    def __init__(self, store: Store) -> None:
        self._store = store

    def collect(self) -> Iterable[Metric]:
        last = self._store.backups.last()
        age = math.inf if last is None else max(0.0, time.time() - last.finished.timestamp())
        meaning = "Seconds since the end of the last successful backup; +Inf before the first one."
        yield GaugeMetricFamily("fleetmap_backup_age_seconds", meaning, value=age)
        failures = "Number of failed backups since the last successful one."
        yield GaugeMetricFamily("fleetmap_backup_failures", failures, value=self._store.backups.failures().count)


class _Webhooks(Collector):
    """Events that webhooks have still to get, and for how long they have failed."""

    def __init__(self, store: Store) -> None:
        self._store = store

    def collect(self) -> Iterable[Metric]:
        waiting = GaugeMetricFamily(
            "fleetmap_webhook_waiting",
            "Number of events that a webhook has still to get, at most 1000.",
            labels=["webhook"],
        )
        failing = GaugeMetricFamily(
            "fleetmap_webhook_failing_seconds",
            "Seconds since the first failed attempt after the last success, of the receiver or of an environment; 0: "
            "none failed.",
            labels=["webhook"],
        )
        for webhook in self._store.webhooks.all():
            waiting.add_metric([webhook.id], self._store.webhooks.count_waiting(webhook))
            failures = (webhook.attempts, *(lag.attempts for lag in self._store.webhooks.lags(webhook.id)))
            since = [attempts.since for attempts in failures if attempts.since is not None]
            failing.add_metric([webhook.id], (datetime.now(UTC) - min(since)).total_seconds() if since else 0)
        yield waiting
        yield failing


class QueueCollector(Collector):
    """State of the queue of conversions and other work: of all servers if they share one, else of this process."""

    def __init__(self, figures: Callable[[], QueueFigures]) -> None:
        self._figures = figures

    def collect(self) -> Iterable[Metric]:
        """Yield the figures."""
        figures = self._figures()
        waiting = GaugeMetricFamily(
            "fleetmap_queue_waiting", "Number of tasks that wait, by who waits for them.", labels=["urgency"]
        )
        for urgency, count in sorted(figures.waiting.items()):
            waiting.add_metric([urgency], count)
        yield waiting
        yield GaugeMetricFamily("fleetmap_queue_running", "Number of tasks that are carried out.", figures.running)
        oldest = "Seconds that the longest waiting task has waited."
        yield GaugeMetricFamily("fleetmap_queue_oldest_seconds", oldest, figures.oldest)
        yield GaugeMetricFamily(
            "fleetmap_queue_workers",
            "Number of live workers; of tasks that a server without a shared queue does at a time.",
            figures.workers,
        )

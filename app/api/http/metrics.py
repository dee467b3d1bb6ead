"""Prometheus: requests, conversions, cache hits, heads.

With several worker processes prometheus_client keeps the counters in files (``PROMETHEUS_MULTIPROC_DIR``, set by
``app.main.serve``), and any worker answers for all of them.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable
from pathlib import Path

from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest, multiprocess
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from app.store.scrub import figures, read_state
from app.store.store import Store

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"
MAX_HEADS = 10_000


class Metrics:
    """The counters of one application."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        self.requests = Counter(
            "fleetmap_requests", "Requests answered.", ["method", "route", "status"], registry=self.registry
        )
        self.seconds = Histogram(
            "fleetmap_request_seconds",
            "Time to the end of an answer, without those from memory.",
            ["route"],
            registry=self.registry,
            buckets=(0.001, 0.003, 0.01, 0.03, 0.1, 0.3, 1, 3, 10, 30, 100),
        )
        self.conversions = Counter("fleetmap_conversions", "Maps made.", ["format", "result"], registry=self.registry)
        hits = Counter("fleetmap_cache_hits", "Maps answered without making them.", ["cache"], registry=self.registry)
        self.memory_hits = hits.labels("memory")
        self.disk_hits = hits.labels("disk")
        self.cache_damaged = Counter(
            "fleetmap_cache_damaged", "Cached maps found damaged, and made again.", registry=self.registry
        )
        self.uploads = Counter("fleetmap_uploads", "Uploads and edits.", ["result"], registry=self.registry)

        self._reserve()

    def _reserve(self) -> None:
        """Take the room of this process's shared counters now: touching a hole on a full disk would kill it."""
        folder = os.environ.get("PROMETHEUS_MULTIPROC_DIR")
        if folder:
            self.seconds.labels("other")  # makes the histograms' file
            for path in Path(folder).glob(f"*_{os.getpid()}.db"):
                with contextlib.suppress(OSError), path.open("r+b") as file:
                    os.posix_fallocate(file.fileno(), 0, os.fstat(file.fileno()).st_size)

    def render(self, store: Store) -> bytes:
        """The text that Prometheus reads."""
        registry = self.registry
        if os.environ.get("PROMETHEUS_MULTIPROC_DIR"):
            registry = CollectorRegistry()
            multiprocess.MultiProcessCollector(registry)  # type: ignore[no-untyped-call]
        heads = CollectorRegistry()
        heads.register(_HeadVersionCollector(store))
        heads.register(_Scrubs(store))
        return generate_latest(registry) + generate_latest(heads)


class _HeadVersionCollector(Collector):
    """Every environment's newest version, and how many environments there are."""

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


class _Scrubs(Collector):
    """When stored data was last hashed as a whole, and what of it was damaged."""

    def __init__(self, store: Store) -> None:
        self._store = store

    def collect(self) -> Iterable[Metric]:
        state = figures(read_state(self._store.blob_dir))
        age = "Seconds since the last complete check of all stored data; +Inf where there was none yet."
        yield GaugeMetricFamily("fleetmap_scrub_age_seconds", age, value=state["age"])
        yield GaugeMetricFamily("fleetmap_scrub_running", "Whether such a check is under way.", value=state["running"])
        findings = GaugeMetricFamily(
            "fleetmap_scrub_findings", "Damaged items found by the check, by kind.", labels=["kind"]
        )
        for kind, count in state["findings"].items():
            findings.add_metric([kind], count)
        yield findings

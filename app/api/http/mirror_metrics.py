"""Metrics of a server that follows another one."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from app.store.store import Store

Figures = dict[str, Any]


class MirrorCollector(Collector):
    """State of the mirror, as its process has stored it; without samples on a server that mirrors no other."""

    def __init__(self, store: Store) -> None:
        self._store = store

    def collect(self) -> Iterable[Metric]:
        """Yield the figures."""
        figures = self._store.mirrors.figures()
        for name, text, value in _GAUGES:
            gauge = GaugeMetricFamily(f"fleetmap_mirror_{name}", text)
            number = None if figures is None else value(figures)
            if number is not None:
                gauge.add_metric([], number)
            yield gauge
        traffic = CounterMetricFamily(
            "fleetmap_mirror_bytes",
            "Bytes of bodies that the mirror has exchanged with its centre, as transferred.",
            labels=["direction"],
        )
        skipped = GaugeMetricFamily(
            "fleetmap_mirror_skipped_statuses",
            "Number of robots' statuses that the centre refused since it last accepted some, by environment.",
            labels=["environment"],
        )
        if figures is not None:
            traffic.add_metric(["received"], figures["received"])
            traffic.add_metric(["sent"], figures["sent"])
            for environment, count in sorted(figures["skipped"].items()):
                skipped.add_metric([environment], count)
        yield traffic
        yield skipped


_GAUGES: tuple[tuple[str, str, Callable[[Figures], float | None]], ...] = (
    (
        "contact_age_seconds",
        "Seconds since a mirror last had contact with its centre; +Inf before the first one.",
        lambda figures: figures["contact_age"],
    ),
    (
        "events_behind",
        "Number of events in the centre's log, as of the last contact, that a mirror has not taken over.",
        lambda figures: figures["behind"],
    ),
    (
        "waiting_changes",
        "Number of changes of closures that a mirror's centre does not have yet.",
        lambda figures: figures["waiting"],
    ),
    (
        "permission_seconds",
        "Seconds until robots refuse the first environment of a mirror that has no contact; 0 if they do.",
        lambda figures: figures["permission"],
    ),
)

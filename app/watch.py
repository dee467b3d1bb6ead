"""Metrics for operators, by the settings of a server or worker."""

from __future__ import annotations

import logging
from datetime import UTC, datetime

from app.api.http.dependencies import Writability
from app.api.http.operation_metrics import (
    WORKER_GAUGES,
    CertificateSource,
    DiskSource,
    EventSource,
    FleetSource,
    OperationCollector,
    ServerSource,
    Source,
    info,
)
from app.certificates import read_certificate
from app.config import Settings
from app.convert.cache import Cache
from app.errors import Invalid
from app.store.store import Store

log = logging.getLogger(__name__)


def operation_metrics(settings: Settings, store: Store, cache: Cache, writability: Writability) -> OperationCollector:
    """Return the metrics of a server for its operator. Reads its certificates now, as the server loads them now."""
    sources: list[Source] = [
        info,
        FleetSource(store),
        _disks(settings),
        ServerSource(cache, writability.refusal),
        CertificateSource(lambda: datetime.now(UTC), _certificate_ends(settings)),
    ]
    if settings.zenoh_mode != "off":
        sources.append(EventSource(store, settings.data_dir))
    return OperationCollector(sources)


def disk_metrics(settings: Settings) -> OperationCollector:
    """Return the metrics of a worker for its operator."""
    return OperationCollector([info, _disks(settings)], WORKER_GAUGES)


def _disks(settings: Settings) -> DiskSource:
    return DiskSource({"data": settings.data_dir, "blobs": settings.blob_dir})


def _certificate_ends(settings: Settings) -> dict[str, datetime]:
    files = {"https": settings.tls_certificate, "zenoh": settings.zenoh_certificate, "zenoh_ca": settings.zenoh_ca}
    out = {}
    for name, path in files.items():
        if path is None or (settings.zenoh_mode == "off" and name != "https"):
            continue
        try:
            out[name] = read_certificate(path).ends
        except Invalid as error:  # the server's start reports it as well
            log.warning("metrics: the end of a certificate is unknown (%s)", error.detail)
    return out

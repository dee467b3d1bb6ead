"""Services that routes use: one object at ``app.state.services``, created when the server starts."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from fastapi import Depends, Request

from app.api.http.auth import Authenticator, Editor
from app.api.http.conversions import ConversionJobs
from app.api.http.deltas import Deltas
from app.api.http.metrics import Metrics
from app.api.http.response_cache import ResponseCache
from app.api.http.schemas import IdempotencyKey, IfMatch
from app.api.http.shared_work import SharedWork
from app.api.http.signed import SignedLinks
from app.api.http.uploads import UploadSpool
from app.backends.lead import Leads
from app.convert.maps import Maps
from app.convert.preview import Previews
from app.convert.tiles import Tiles
from app.convert.views import Views
from app.errors import Unavailable
from app.events.outgoing import OutgoingRules
from app.fleet import ReportQueue as FleetIntake
from app.ingest import CommitRequest, Ingest
from app.limits import Limits
from app.pool import Pool
from app.signing import SigningKeys
from app.store.retention_rule import Rule
from app.store.store import Store

WRITABLE_SECONDS = 2.0
"""Seconds for which the result of a write check is cached."""

PROBE_SECONDS = 5.0


@dataclass(frozen=True, slots=True)
class ApiOptions:
    """Settings of the API. Times in seconds, sizes in bytes; see ``app.config``."""

    limits: Limits
    spool_dir: Path
    max_json_bytes: int = 64 * 2**20
    body_seconds: float = 30.0
    body_pace: int = 1024
    data_dir: Path = Path("data")
    zenoh_mode: str = "off"
    zenoh_prefix: str = "fleetmap"
    zenoh_listen: str = ""
    zenoh_advertise: str = ""
    ros2: bool = False
    manifest_seconds: int = 86_400
    delegation_seconds: int = 604_800
    public_url: str | None = None
    basemap_url: str | None = None
    basemap_attribution: str = ""
    retention: Rule | None = None
    mqtt: bool = False
    webhooks: OutgoingRules = field(default_factory=OutgoingRules)


class Writability:
    """Cached check for whether data can be stored.

    Thread-safe; ``checks`` run at most every WRITABLE_SECONDS, never concurrently.
    """

    def __init__(self, *checks: Callable[[], None]) -> None:
        self._checks = checks
        self._lock = threading.Lock()
        self._until = 0.0
        self._refusal: str | None = None

    def refusal(self) -> str | None:
        """Return why nothing can be stored at the moment, or None."""
        if time.monotonic() < self._until:
            return self._refusal
        if not self._lock.acquire(timeout=PROBE_SECONDS):
            return f"the disk did not respond within {PROBE_SECONDS:g} seconds"
        try:
            if time.monotonic() >= self._until:
                self._refusal = self._check()
                self._until = time.monotonic() + WRITABLE_SECONDS
            return self._refusal
        finally:
            self._lock.release()

    def _check(self) -> str | None:
        try:
            for check in self._checks:
                check()
        except Unavailable as error:
            return error.detail
        return None

    def forget(self) -> None:
        """Discard the cached result."""
        self._until = 0.0


@dataclass(frozen=True, slots=True)
class Services:
    """Services that routes use.

    spare: worker for tasks that should not wait for ``pool``. work: workers of all servers, None if there are none.
    """

    options: ApiOptions
    store: Store
    pool: Pool
    spare: Pool
    ingest: Ingest
    maps: Maps
    access: Authenticator
    jobs: ConversionJobs
    work: SharedWork | None
    response_cache: ResponseCache
    intake: UploadSpool
    metrics: Metrics
    keys: SigningKeys
    links: SignedLinks
    deltas: Deltas
    tiles: Tiles
    previews: Previews
    views: Views
    leads: Leads
    fleet: FleetIntake
    writability: Writability
    prepared: threading.Event = field(default_factory=threading.Event)
    """Event that is set once the first map and coverage table need not wait for modules to load."""


async def services(request: Request) -> Services:
    """Return the services of the application."""
    instance: Services = request.app.state.services
    return instance


ServicesDep = Annotated[Services, Depends(services)]


async def commit_request(
    principal: Editor, if_match: IfMatch = None, idempotency_key: IdempotencyKey = None
) -> CommitRequest:
    """The author and the headers of a request that makes a version; its message is in the body or the query."""
    return CommitRequest(principal.name, if_match=if_match, idempotency_key=idempotency_key)


CommitDep = Annotated[CommitRequest, Depends(commit_request)]

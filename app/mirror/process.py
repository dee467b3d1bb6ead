"""The process of a mirror: one pass after the other, at once when something happens on either side.

Beside the server, as a worker is: it can be stopped, replaced and killed at any time without the server, and of several
servers with one database one process works. It needs no port; ``/readyz`` of the server has its state.
"""

from __future__ import annotations

import logging
import random
import threading
import time
from typing import Final

from app.backends.lead import Lead
from app.errors import FleetMapError
from app.mirror.centre import Centre
from app.mirror.follow import Mirror
from app.store.store import Store

log = logging.getLogger(__name__)

LEAD: Final = "mirror"
PASS_SECONDS: Final = 15.0
"""Maximum time between two passes; also the maximum delay of robots' statuses."""

POLL_SECONDS: Final = 0.1
STAND_BY_SECONDS: Final = 1.0
MAX_PAUSE_SECONDS: Final = 60.0


def run(store: Store, centre: Centre, mirror: Mirror, lead: Lead, stop: threading.Event) -> None:
    """Follow a centre until ``stop`` is set. Failures are logged and retried with growing pauses."""
    news = threading.Event()
    watcher = threading.Thread(target=_watch, args=(centre, mirror, news, stop), name="fleetmap-watch", daemon=True)
    watcher.start()
    failures = 0
    while not stop.is_set():
        if not lead.try_acquire():
            stop.wait(STAND_BY_SECONDS)
            continue
        generation = store.generation()
        if _attempt(mirror, lead, first=failures == 0):
            failures = 0
            news.clear()  # what happened during the pass is after its position: the watcher finds it
            _wait(store, generation, mirror.left, news, stop)
        else:
            failures += 1
            pause = min(MAX_PAUSE_SECONDS, 0.5 * 2 ** min(failures, 10))
            stop.wait(pause * random.uniform(0.5, 1.0))  # noqa: S311  jitter is no secret
    lead.release()


def _attempt(mirror: Mirror, lead: Lead, *, first: bool) -> bool:
    """Run one pass; returns whether the centre was reached."""
    try:
        with lead.fenced():
            mirror.run_once()
    except FleetMapError as error:
        log.log(logging.WARNING if first else logging.INFO, "mirror: will retry: %s", error.detail)
        return False
    except Exception as error:  # noqa: BLE001  an answer of a faulty centre must not end the process
        log.error("mirror: failed, will retry: %s: %s", type(error).__name__, error)  # noqa: TRY400  a trace shows paths
        return False
    if not first:
        log.info("mirror: connected again")
    return True


def _wait(store: Store, generation: int, left: int, news: threading.Event, stop: threading.Event) -> None:
    """Wait until the centre has news, this server has more to hand on than was left, or PASS_SECONDS have passed."""
    end = time.monotonic() + PASS_SECONDS
    while time.monotonic() < end and not news.is_set() and not stop.wait(POLL_SECONDS):
        if store.generation() != generation:
            generation = store.generation()
            try:
                if store.edge_changes.count_waiting() > left:
                    return
            except FleetMapError:
                return


def _watch(centre: Centre, mirror: Mirror, news: threading.Event, stop: threading.Event) -> None:
    """Set ``news`` at each event of the centre. A hint only: passes do not depend on it."""
    while not stop.is_set():
        if not mirror.position or news.is_set():
            stop.wait(POLL_SECONDS)
        elif centre.wait_for_event(mirror.position):
            news.set()
        else:
            stop.wait(STAND_BY_SECONDS)

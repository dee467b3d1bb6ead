"""Background scrub: one process hashes stored bytes again, slowly, in repeated passes.

A pass reads SQLite's tables one by one, chunks, versions' roots, files and a sample of the cache. Its position is
stored in the blob folder, since SQLite's own file may be damaged, or in the database that several servers share; after
a restart the pass continues there.
"""

from __future__ import annotations

import contextlib
import json
import logging
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Final

from app.backends.documents import Document, FileDocument
from app.backends.lead import Lead, Term
from app.errors import FleetMapError, Unavailable, system_reason
from app.store.store import Store
from app.store.verify import KINDS, Kind, check_root

log = logging.getLogger(__name__)

STATE: Final = ".scrub.json"
DOCUMENT: Final = "scrub"
POLL_SECONDS: Final = 60.0
SAVE_SECONDS: Final = 10.0
THING_BYTES: Final = 4096
"""Size that checking a small object counts as, in bytes, since finding it costs more than hashing it."""

CheckCache = Callable[[], Iterator[tuple[str, int, bool]]]
"""Iterator over (key, bytes, whether it is intact) of the cache's entries."""


@dataclass(slots=True)
class ScrubState:
    """Position of a pass. Times: seconds since 1970, 0.0 for never. after: last object checked by the step.

    found: damaged objects by kind, of the current pass; findings: of the last complete pass, and at least ``found``.
    """

    step: int = 0
    after: str = ""
    started: float = 0.0
    completed: float = 0.0
    size: int = 0
    found: dict[str, int] = field(default_factory=dict)
    findings: dict[str, int] = field(default_factory=dict)


def _document(store: Store) -> Document:
    return store.document(DOCUMENT) if store.is_shared else FileDocument(store.blob_dir / STATE)


def current_state(store: Store) -> ScrubState:
    """Read the state of a store's scrub, a new one if its file cannot be read. Raises Unavailable."""
    try:
        return _parse_state(_document(store).read() or b"{}")
    except OSError:
        return ScrubState()


def _parse_state(content: bytes) -> ScrubState:
    try:
        members = json.loads(content)
        field_names = {f.name for f in fields(ScrubState)}
        return ScrubState(**{name: value for name, value in members.items() if name in field_names})
    except (ValueError, TypeError, AttributeError):
        return ScrubState()


class Scrub:
    """Passes over a store in a thread of its own. every: seconds from one pass to the next. rate: bytes per second.

    lead: right to scrub, of one process of all servers. delay: seconds before the first pass, so that it does not slow
    down the start of the server.
    """

    def __init__(
        self,
        store: Store,
        check_cache: CheckCache,
        lead: Lead,
        *,
        every: float,
        rate: int,
        delay: float = POLL_SECONDS,
    ) -> None:
        self._lead = lead
        self._store, self._check_cache = store, check_cache
        self._every, self._rate, self._delay = every, rate, delay
        self._stopped = threading.Event()
        self._state = ScrubState()
        self._saved = 0.0
        self._debt = 0.0
        self._term: Term | None = None
        self._reason = ""
        self._thread = threading.Thread(target=self._run, daemon=True, name="fleetmap-scrub")

    def start(self) -> None:
        """Start the thread; it scrubs once this process gets the lead."""
        self._thread.start()

    def close(self) -> None:
        """Stop the thread promptly."""
        self._stopped.set()
        if self._thread.is_alive():
            self._thread.join(5.0)
        self._lead.release()

    def _run(self) -> None:
        self._stopped.wait(self._delay)
        while not self._stopped.is_set():
            try:
                if self._lead.try_acquire():  # else another process scrubs
                    self.pass_if_due()
                self._reason = ""
            except OSError as error:
                self._wait_for(system_reason(error))
            except FleetMapError as error:
                self._wait_for(error.detail)
            except Exception:  # the thread must outlive a defect: else checks would end unnoticed
                log.exception("scrub: internal error; it continues")
            self._stopped.wait(POLL_SECONDS)

    def _wait_for(self, reason: str) -> None:
        if reason != self._reason:  # once, not every minute
            log.warning("scrub: waiting (reason=%s)", reason)
        self._reason = reason

    def pass_if_due(self) -> None:
        """Continue a pass, or begin one if the last is long enough ago."""
        self._term = self._lead.term
        self._state = current_state(self._store)
        if not self._state.started and time.time() - self._state.completed < self._every:
            return
        if not self._state.started:
            last_pass = (self._state.completed, self._state.findings)
            self._state = ScrubState(started=time.time(), completed=last_pass[0], findings=last_pass[1])
        steps = (self._pages, self._chunks, self._versions, self._blobs, self._cache)
        restarting: dict[Callable[[], None], Kind] = {self._versions: "version", self._cache: "cache"}
        while self._state.step < len(steps):
            step = steps[self._state.step]
            if step in restarting:
                self._state.found.pop(restarting[step], None)  # the step restarts and finds it again
            step()
            if self._is_ending():
                self._save()
                return
            self._state.step, self._state.after = self._state.step + 1, ""
        state = self._state
        self._state = ScrubState(completed=time.time(), size=state.size, findings=state.found)
        self._save()
        log.info("scrub: complete (bytes=%d, findings=%s)", state.size, state.found or "none")

    def _pages(self) -> None:
        for name, size, problem in self._store.check_pages(self._state.after):
            if not self._note_checked("database", name, size, problem):
                return

    def _chunks(self) -> None:
        for name, size, problem in self._store.verifier().chunks(self._state.after):
            if not self._note_checked("chunk", name, size, problem):
                return

    def _versions(self) -> None:
        for environment, row in self._store.verifier().versions():
            problem, _ = check_root(row)
            if not self._note_checked("version", f"{environment} {row.number}", len(row.manifest), problem):
                return

    def _blobs(self) -> None:
        for name, size, problem in self._store.blob_upkeep.iterate_checks(self._state.after, self._skip):
            if not self._note_checked("blob", name, size, problem):
                return

    def _skip(self, name: str, error: Unavailable) -> None:
        """Skip a file that is temporarily unreadable: the next pass checks it."""
        log.warning("scrub: a stored file could not be checked (blob=%s, reason=%s)", name, error.detail)

    def _cache(self) -> None:
        for key, size, intact in self._check_cache():
            if not self._note_checked("cache", key, size, None if intact else "damaged; it is rebuilt"):
                return

    def _note_checked(self, kind: Kind, name: str, size: int, problem: str | None) -> bool:
        """Count a checked object and wait as long as the rate requires; False if the scrub was stopped."""
        if problem is not None:
            self._note(kind, name, problem)
        self._state.after = name
        self._state.size += size
        self._debt += max(size, THING_BYTES) / self._rate
        if time.monotonic() - self._saved > SAVE_SECONDS:
            self._save()
        if self._debt > 0.05:  # one long sleep instead of many of a microsecond
            self._stopped.wait(self._debt)
            self._debt = 0.0
        return not self._is_ending()

    def _is_ending(self) -> bool:
        """Whether to end the pass: the process stops, or another one scrubs or has scrubbed meanwhile."""
        return self._stopped.is_set() or self._term is None or not self._term.goes_on

    def _note(self, kind: Kind, name: str, problem: str) -> None:
        state = self._state
        state.found[kind] = state.found.get(kind, 0) + 1
        state.findings[kind] = max(state.findings.get(kind, 0), state.found[kind])
        if kind != "cache":  # cached maps are rebuilt without an administrator
            log.critical(
                "scrub: stored data is damaged: run `fleetmap verify --repair` (%s=%s, %s)", kind, name, problem
            )

    def _save(self) -> None:
        self._saved = time.monotonic()
        content = json.dumps(asdict(self._state)).encode()
        if self._term is None:
            return
        with contextlib.suppress(Unavailable, OSError), self._term.fenced():  # a full disk must not stop the scrub
            _document(self._store).update(lambda _: content, notify=False)


def figures(state: ScrubState) -> dict[str, Any]:
    """Return the figures for monitoring. age: seconds since the last complete pass, infinite if there was none."""
    age = time.time() - state.completed if state.completed else float("inf")
    findings = {kind: state.findings.get(kind, 0) for kind in KINDS}
    return {"age": age, "completed": state.completed, "running": bool(state.started), "findings": findings}

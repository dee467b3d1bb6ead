"""Sync loop of the agent: wait for an event or poll, verify the manifest, fetch what differs, switch, report."""

from __future__ import annotations

import dataclasses
import random
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from app.agent import signatures, signed_manifest
from app.agent.activation import ACTIVE, BEFORE_SWITCH_SECONDS, Activation, LogEvent, Outcome, Retries, changed_files
from app.agent.download import Downloads
from app.agent.freshness import Freshness, SignedClock
from app.agent.http_client import AgentStopped, ClosuresChanged, RetryLater, ServerClient, plain
from app.agent.levels import write_hooks
from app.agent.manifests import Manifests
from app.agent.map_directory import MapDirectory
from app.agent.options import AgentOptions, robot_name
from app.agent.requests import parse_requests
from app.agent.router import find_router
from app.agent.signed_manifest import Manifest, ManifestFile
from app.agent.state import AgentState, StateStore, read_boot_id
from app.agent.status import StatusReporter, Subject, describe_status, loaded_version
from app.agent.waking import CLOSURE_EVENTS, LATEST, Alarm, is_newer, is_relevant
from app.agent.zenoh_client import ZenohClient
from app.errors import FleetMapError, Invalid, NotFound, Unavailable, Untrusted
from app.event_types import RobotState
from app.events import messages

__all__ = ["Agent", "AgentOptions", "robot_name"]

PRODUCTION = "production"
FIRST_PAUSE_SECONDS = 1.0
"""Pause after the first failure; doubles with each further one up to the poll interval."""

RECHECK_AFTER_SECONDS = 5.0
"""Duration of a download after which the agent checks the channel again before it switches."""

MAX_CLOSURE_CHANGES = 5
"""Maximum number of times that one sync fetches a manifest again because closures have changed."""

CLOSURES_SECONDS = 0.1
"""First pause if the server's files have other closures than its newest manifest; doubles each time."""


class Agent:
    """Keeps the map of one environment up to date. clock: seconds since 1970; may be wrong by one minute."""

    def __init__(self, options: AgentOptions, log: LogEvent, clock: Callable[[], float] = time.time) -> None:
        if options.key is not None:
            options = dataclasses.replace(options, key=signatures.check_key(options.key))
        self.options, self._log_event, self._clock = options, log, clock
        self._robot = robot_name(options.robot)
        self._login = options.zenoh_login
        if self._login.password is not None and self._login.user is None:
            self._login = dataclasses.replace(self._login, user=self._robot)
        self._login.values()  # raises Invalid here rather than in the session's thread
        self._stopping = threading.Event()
        self._wake = Alarm(self._stopping)
        self._folder = MapDirectory(options.into)
        self._web = ServerClient(options.server, options.token, self._stopping, options.ca)
        self._zenoh: ZenohClient | None = None
        self._store = StateStore(self._folder.state, options.environment, self._folder.free_space)
        self._retries = Retries(options.poll_seconds, lambda: FIRST_PAUSE_SECONDS)
        self._activation = Activation(
            self._folder, self._store, options, self._robot, log=log, stopping=self._stopping, retries=self._retries
        )
        self._signed_clock = SignedClock(clock)
        self._freshness = Freshness(options.poll_seconds, self._time_text)
        requests = parse_requests(options.formats, options.optional)
        self._downloads = Downloads(self._folder, self._web, requests)
        self._manifests = Manifests(
            options,
            requests,
            self._web,
            self._folder,
            self._store,
            clock=self._signed_clock,
            freshness=self._freshness,
            log=log,
        )
        self._status = StatusReporter(
            options.environment,
            self._robot,
            self._web,
            self._stopping,
            lambda reason: self._log_once("status", detail=reason),
        )
        self._reported: tuple[Any, ...] | None = None
        self._reported_once: set[str] = set()
        self._preloaded: Manifest | None = None
        self._preloaded_closures = ""
        self._fetched: Manifest | None = None
        self._refreshed: tuple[str, str] | None = None
        self._closures_problem = ""  # why the current map lacks the newest closures, while the channel's is not active
        self._announced_sequence = 0
        self._stale_replies = 0

    @property
    def _state(self) -> AgentState:
        return self._store.value

    def open(self) -> None:
        """Lock the map directory, load the state and check the installed files.

        Raises Conflict if another agent uses the directory, Invalid if its state cannot be used.
        """
        self._folder.open()
        self._store.load()
        state = signatures.pin_key(self._state, self.options.key)
        if state.key is None and self._state.key is not None:
            self._log_event("trusting", key=state.given, detail="the key pinned before is no longer trusted")
        installed = self._folder.manifest(self._folder.current_version)
        name = self._folder.current_version
        if installed is not None and name is not None and (bad := self._folder.damaged_files(name, installed)):
            self._log_event("damaged", version=installed.version, files=bad[:20])
            state = dataclasses.replace(state, etag=None)
        self._store.stage(state.in_boot(read_boot_id()))
        self._signed_clock.floor = state.newest_time
        self._activation.protect()
        self._folder.refresh()

    def close(self) -> None:
        """Close the connections and unlock the map directory."""
        if self._zenoh is not None:
            self._zenoh.close()
        self._web.close()
        self._folder.close()

    def stop(self) -> None:
        """Request the end of ``run``. Safe to call from any thread, but not in a signal handler: it takes locks."""
        self._stopping.set()
        self._wake.set()
        self._web.interrupt()

    def run_once(self) -> bool:
        """Sync once; return whether the channel's map is installed and all hooks succeeded."""
        self._retries.forget_others()
        try:
            return self._attempt(self._sync)
        except AgentStopped:
            return False

    def run(self) -> None:
        """Keep the map directory up to date until ``stop`` is called."""
        self._zenoh = ZenohClient(
            self.options.environment,
            self._robot,
            on_event=self._on_event,
            on_connected=self._on_router_connected,
            on_lost=self._on_router_lost,
            config=self.options.zenoh_config,
            login=self._login,
        )
        self._status.bus = self._zenoh
        if self._login.user not in (None, self._robot):
            reason = f"the router accepts a status from user {self._login.user} only for the robot of that name"
            self._log_event("user", detail=f"{reason}: use --robot {self._login.user}, or the robot's own user")
        if (installed := self._folder.manifest(self._folder.current_version)) is not None:
            self._log_event("holding", version=installed.version, root=installed.root)
        failures = 0
        woken = False
        while not self._stopping.is_set():
            self._wake.clear()
            before = (self._state.marks, self._status.status)
            pause = self.options.poll_seconds
            try:
                if not woken or not self._zenoh.connected:
                    self._find_router()
                good = self._attempt(self._sync) or self._activation.is_waiting()
                failures = 0 if good else failures + 1
                # With several server hosts, a response may lag behind an event: poll again, with growing pauses.
                self._stale_replies = (
                    self._stale_replies + 1 if good and self._accepted_sequence < self._announced_sequence else 0
                )
                vain = woken and before == (self._state.marks, self._status.status)
                self._wake.idle_wakeups = self._wake.idle_wakeups + 1 if vain else 0
                if failures or self._stale_replies:
                    pause = min(pause, FIRST_PAUSE_SECONDS * 2 ** min(20, max(failures, self._stale_replies) - 1))
                pause *= random.uniform(0.5, 1.5)  # noqa: S311  jitter is no secret
                if (due := self._retries.next_due) is not None:
                    pause = min(pause, max(0.0, due - time.monotonic()))
                woken = self._sleep_or_switch(max(self._after, pause))
            except AgentStopped:
                break

    def _sleep_or_switch(self, seconds: float) -> bool:
        """Sleep, and repeat ``--before-switch`` if it delays a switch. Return whether to sync at once."""
        end = time.monotonic() + seconds
        while self._activation.is_waiting():
            remaining = end - time.monotonic()
            woken = self._wake.sleep(max(0.0, min(BEFORE_SWITCH_SECONDS, remaining)), self._status)
            if woken or self._stopping.is_set() or time.monotonic() >= end:
                return woken
            self._attempt(self._switch_pending)
            if not self._activation.is_waiting():
                return True  # switched or refused
        return self._wake.sleep(max(0.0, end - time.monotonic()), self._status)

    def _on_event(self, event: messages.Event) -> None:
        """Wake the sync loop if the event may change this robot's map. Called in a Zenoh thread."""
        if event.environment != self.options.environment or not isinstance(event.channel, str | None):
            return
        channel = self._state.channel
        if not is_newer(event, self._state.marks.get(channel or "")):
            return
        if is_relevant(event, channel, {self.options.channel} if self.options.channel else {PRODUCTION, channel}):
            is_move = event.type == "channel.moved" or (event.type == "version.created" and channel == LATEST)
            if is_move or (event.type in CLOSURE_EVENTS and self._manifests.has_closures):
                self._announced_sequence = event.sequence  # the channel's manifest has at least this sequence
                self._freshness.announce(event.sequence)
            self._wake.set()

    @property
    def _accepted_sequence(self) -> int:
        """Highest accepted sequence of the followed channel; -1 before the first manifest."""
        mark = self._state.marks.get(self._state.channel or "")
        return -1 if mark is None else mark.sequence

    def _on_router_connected(self) -> None:
        self._log_event("connected", detail="listening for events over Zenoh")
        self._wake.rejoined = True
        self._status.forget_sent()
        self._wake.set()

    def _on_router_lost(self, problem: str) -> None:
        self._log_event(
            "polling", detail=f"{problem}; the agent polls about every {self.options.poll_seconds:g} seconds"
        )

    def _find_router(self) -> None:
        if self._zenoh is None:
            return
        try:
            router = find_router(self.options, self._web, has_endpoint=self._zenoh.has_endpoint)
        except Invalid as error:
            self._log_once("polling", detail=error.detail)
            return
        if router is not None:
            self._zenoh.set_endpoint(*router)

    def _attempt(self, action: Callable[[], bool]) -> bool:
        """Run a step and report its errors. Return whether it succeeded."""
        self._after = 0.0
        self._about = None
        try:
            good = action()
        except FleetMapError as error:
            self._report_error(error)
            good = False
        except OSError as error:
            self._fail("failed", f"{error.filename or self._folder.path}: {error.strerror or error}")
            good = False
        except AgentStopped:
            raise
        except Exception as error:  # noqa: BLE001  an internal error must not end the agent
            frame = traceback.extract_tb(error.__traceback__)[-1]
            place = f"{Path(frame.filename).name}:{frame.lineno}"
            self._fail("failed", f"internal error in the agent ({type(error).__name__} at {place}): {error}")
            good = False
        self._status.send()
        return good

    _after = 0.0
    _about: Manifest | None = None
    """Manifest of the map that an error is about; None for the current map."""

    def _sync(self) -> bool:
        self._store.save(self._state)
        self._write_hooks()
        try:
            plans = self._fetch_channels()
        except FleetMapError:
            if self._activation.is_load_due:  # interrupted hooks do not need the server
                self._report(self._activation.load())
            raise
        channel = self._channel(plans)
        planned = next((p for p in plans or () if p.get("channel") == channel), {}).get("planned")
        outcome: Outcome | None = None
        try:
            outcome = self._follow(channel)
            if outcome.state != "active":
                self._refresh_closures()
            if outcome.state == "active" and (problem := self._freshness.stale_problem()) is not None:
                raise Untrusted(problem)
            self._report(outcome, is_planned=planned is not None)
        except FleetMapError as error:
            if planned is None:
                raise
            self._report_error(error, is_planned=True)
            outcome = Outcome("failed", error.detail)
        self._about = None
        loaded = plans is None or self._preload(planned, outcome)
        return outcome.state == "active" and loaded

    def _write_hooks(self) -> None:
        try:
            write_hooks(self._folder, self.options.on_change, self._robot)
        except OSError as error:  # only `fleetmap agent-level` needs this file
            self._log_once("hooks", detail=f"{self._folder.path}/hooks.json cannot be written: {error.strerror}")

    def _follow(self, channel: str) -> Outcome:
        """Switch ``current`` to the channel's map and run the hooks."""
        manifest = self._manifests.fetch_latest(channel)
        outcome = self._install_latest(channel, manifest) if manifest is not None else None
        self._about = None
        loaded = self._activation.load()
        return loaded if outcome is None or outcome.state == "active" else outcome

    def _refresh_closures(self) -> None:
        """Apply the newest closures to the current version if the channel's version is not active."""
        name, self._closures_problem = self._folder.current_version, ""
        current, digest = self._folder.manifest(name), self._manifests.overlays_digest
        if name is None or current is None or digest is None or self._state.working != name:
            return
        if self._manifests.closures_key == current.closures_key or self._refreshed == (name, digest):
            return
        keep = self._preloaded.files if self._preloaded else ()
        try:
            begun = time.monotonic()
            manifest, sources = self._fetch_version(current.version, keep)
            self._manifests.check_refreshed(manifest, current)
            if manifest.map_key == current.map_key:
                self._refreshed = (name, digest)  # these closures do not concern this version
                return
            members = {
                "version": manifest.version,
                "root": manifest.root,
                "channel": self._state.channel,
                "sequence": manifest.sequence,
                "files": len(changed_files(current, manifest)),
                "seconds": round(time.monotonic() - begun, 3),
                "detail": "closures of the current version",
            }
            built = self._folder.build(manifest, sources)
            outcome = self._activation.replace(built, manifest, members, self._time_text()[:19] + "Z")
        except FleetMapError as error:
            self._closures_problem = f"closures of version {current.version}: {error.detail}"
            self._log_event("failed", detail=self._closures_problem)
            return
        if outcome.state == "failed":
            self._log_event("failed", detail=outcome.detail)

    def _fetch_version(self, version: int, keep: Sequence[ManifestFile]) -> tuple[Manifest, dict[str, Path]]:
        """Fetch a version by number, again if closures change meanwhile. Return manifest, and path -> verified file."""
        for attempt in range(MAX_CLOSURE_CHANGES):
            manifest = self._manifests.fetch_planned(version)
            self._fetched = manifest
            try:
                installed = self._folder.manifest(self._folder.current_version)
                return manifest, self._downloads.fetch(manifest, installed, keep)
            except (ClosuresChanged, NotFound) as error:
                if manifest.overlays_digest is None:
                    raise
                problem = error.detail
            if self._stopping.wait(CLOSURES_SECONDS * 2**attempt):
                raise AgentStopped
        raise ClosuresChanged(problem)

    def _switch_pending(self) -> bool:
        """Run ``--before-switch`` again for the pending map. Return whether the map is active."""
        pending, self._activation.pending = self._activation.pending, None
        if pending is None or pending.manifest.expires.timestamp() < self._signed_clock.now():
            return False
        outcome = self._switch(pending.name, pending.manifest, pending.members, pending.since)
        if outcome.state == "active":
            outcome = self._activation.load()
        self._report(outcome, is_planned=self._preloaded is not None)
        return outcome.state == "active"

    def _fetch_channels(self) -> list[Mapping[str, Any]] | None:
        try:
            return self._web.channels(self.options.environment)
        except (NotFound, Invalid) as error:
            if self.options.channel is None and PRODUCTION not in self._state.marks:
                raise  # without the list, the channel to follow is unknown
            self._log_once("channels", detail=error.detail)
            return None

    def _channel(self, plans: Sequence[Mapping[str, Any]] | None) -> str:
        """Return the channel to follow. ``production``, once followed, stays the default even if no longer listed."""
        if self.options.channel is not None:
            return self.options.channel
        stands = any(p.get("channel") == PRODUCTION and p.get("version") is not None for p in plans or ())
        if stands or PRODUCTION in self._state.marks:
            return PRODUCTION
        self._log_once("following", channel=LATEST, detail="the channel production points to no version yet")
        return LATEST

    def _install_latest(self, channel: str, manifest: Manifest) -> Outcome:
        """Install a manifest, or the one that replaces it if closures change during the download."""
        for attempt in range(MAX_CLOSURE_CHANGES):
            try:
                return self._install(manifest)
            except (ClosuresChanged, NotFound, Invalid, Untrusted) as error:
                newer = self._manifests.fetch_latest(channel) if manifest.overlays_digest is not None else None
                if newer is None or (newer.map_key == manifest.map_key and not isinstance(error, ClosuresChanged)):
                    raise
                if newer.map_key == manifest.map_key and self._stopping.wait(CLOSURES_SECONDS * 2**attempt):
                    raise AgentStopped from None
                manifest = newer
        return self._install(manifest)

    def _install(self, manifest: Manifest) -> Outcome:
        """Fetch missing files, build the version folder and switch to it."""
        name = self._folder.current_version
        installed = self._folder.manifest(name)
        bad = self._folder.damaged_files(name, installed) if name is not None and installed is not None else []
        if bad and installed is not None:
            self._log_event("damaged", version=installed.version, files=bad[:20])
        if name is not None and installed is not None and not bad and installed.map_key == manifest.map_key:
            self._activation.pending = None
            if installed.data != manifest.data:
                self._folder.describe(name, manifest)  # the same files: a newer sequence or a later expiry
            self._note_installed(manifest)
            return ACTIVE
        if (refused := self._activation.refusal(manifest)) is not None:
            return refused
        self._about = manifest
        pending = self._activation.pending
        if pending is not None and pending.manifest.map_key == manifest.map_key:
            self._folder.describe(pending.name, manifest)
            return self._switch(pending.name, manifest, pending.members, pending.since)
        self._activation.pending = None
        web, begun = self._web, time.monotonic()
        received, deltas, failed_deltas = web.received, web.deltas, web.failed_deltas
        ready = self._preloaded.files if self._preloaded else ()
        sources = self._downloads.fetch(
            manifest, installed, ready, lambda: self._set_status("downloading", about=manifest)
        )
        if (newer := self._superseding_manifest(manifest, time.monotonic() - begun)) is not None:
            return self._install(newer)
        members = {
            "version": manifest.version,
            "root": manifest.root,
            "channel": manifest.channel,
            "sequence": manifest.sequence,
            "files": len(changed_files(installed, manifest)),
            "bytes": web.received - received,
            "deltas": web.deltas - deltas,
            "seconds": round(time.monotonic() - begun, 3),
        }
        if (count := web.failed_deltas - failed_deltas) > 0:
            members["detail"] = f"{count} deltas could not be decoded; the complete files were fetched"
        return self._switch(self._folder.build(manifest, sources), manifest, members, self._time_text()[:19] + "Z")

    def _switch(self, name: str, manifest: Manifest, members: Mapping[str, Any], since: str) -> Outcome:
        outcome = self._activation.switch(name, manifest, members, since)
        if outcome.state == "active":
            self._note_installed(manifest)
        else:
            self._folder.prune(self._preloaded.files if self._preloaded else ())
        return outcome

    def _note_installed(self, manifest: Manifest) -> None:
        """Store the ETag of the installed manifest and remove files that are no longer needed."""
        self._manifests.note_installed(manifest)
        self._folder.prune(self._preloaded.files if self._preloaded else ())

    def _superseding_manifest(self, manifest: Manifest, seconds: float) -> Manifest | None:
        """Return the channel's newer manifest if the channel has moved during the download and its files are present.

        So a map that was rolled back meanwhile is not installed. None if the newer map must still be fetched.
        """
        if manifest.channel is None or (
            self._announced_sequence <= manifest.sequence and seconds < RECHECK_AFTER_SECONDS
        ):
            return None

        def is_present(newer: Manifest) -> bool:
            if newer.mark == manifest.mark:
                return False
            self._wake.set()
            return self._downloads.has_all(newer)

        try:
            return self._manifests.fetch_latest(manifest.channel, is_present)
        except FleetMapError:
            return None  # the next sync reports it

    def _preload(self, planned: Any, outcome: Outcome) -> bool:
        """Fetch the version that the channel is planned to move to. Return whether it is complete.

        Args:
            outcome: of the map that the channel points to now; its failure is reported in the status ``ready``.
        """
        version = planned.get("version") if isinstance(planned, dict) else None
        if type(version) is not int:
            if self._preloaded is not None:
                self._preloaded = None
                self._folder.prune()
            return True
        closures = self._manifests.closures_key
        if self._preloaded is None or (self._preloaded.version, self._preloaded_closures) != (version, closures):
            self._fetched = None
            try:
                self._preloaded, _ = self._fetch_version(version, ())
            except FleetMapError as error:
                self._report_preload_error(error, version, planned.get("root"))
                return False
            self._preloaded_closures = closures
        self._set_status("ready", None if outcome.state == "active" else outcome.detail, self._preloaded)
        return True

    def _report_preload_error(self, error: FleetMapError, version: int, root: Any) -> None:
        """Report why a planned version was not fetched: ``downloading`` for temporary errors, else ``failed``."""
        detail = f"planned version {version}: {error.detail}"
        subject: Subject | None = self._fetched
        if subject is None and isinstance(root, str) and signed_manifest.is_hash(root):
            subject = (version, root)
        if isinstance(error, RetryLater):
            self._after = error.seconds
        if isinstance(error, Unavailable):
            if subject is not None:
                self._set_status("downloading", detail, subject)
        elif subject is None:
            self._log_once("failed", detail=detail)  # an older server does not list the planned root
        elif self._set_status("failed", detail, subject):
            self._log_event("refused" if isinstance(error, Untrusted) else "failed", detail=detail)

    def _report(self, outcome: Outcome, *, is_planned: bool = False) -> None:
        """Report the outcome of the channel's map. is_planned: with a planned version, skip an unchanged status."""
        detail = "; ".join(text for text in (outcome.detail, self._closures_problem) if text)
        report_key = (outcome.state, detail, self._folder.current_version, self._accepted_sequence)
        if is_planned and report_key == self._reported:
            return
        self._reported = report_key
        if outcome.state == "active":
            self._set_status("active", self._remark())
        elif outcome.state == "failed":
            if self._set_status("failed", detail, outcome.manifest):
                self._log_event("failed", detail=detail)
        else:
            self._set_status("ready", detail, outcome.manifest)

    def _remark(self) -> str | None:
        """Return remarks about an active map: missing optional formats, server behind its events, failed hook steps."""
        current = self._folder.manifest(self._folder.current_version)
        if current is None:
            return None
        remarks = (
            self._manifests.missing_remark(current),
            self._freshness.behind_remark(self._accepted_sequence),
            self._activation.hook_remark(),
            self._manifests.variables_remark(current),
        )
        return "; ".join(remark for remark in remarks if remark) or None

    def _report_error(self, error: FleetMapError, *, is_planned: bool = False) -> None:
        if isinstance(error, RetryLater):
            self._after = error.seconds
        report_key = ("failed", error.detail, self._folder.current_version, self._accepted_sequence)
        if is_planned and report_key == self._reported:
            return
        self._reported = report_key
        self._fail("refused" if isinstance(error, Untrusted) else "failed", error.detail)

    def _set_status(self, state: RobotState, detail: str | None = None, about: Subject | None = None) -> bool:
        """Set the status and send it. Return whether it is new. about: its map; default: the current one."""
        current = self._folder.manifest(self._folder.current_version)
        is_loaded = self._state.activated == self._folder.current_version
        status = describe_status(
            state,
            plain(detail[: messages.MAX_DETAIL]) if detail else None,
            about,
            current,
            channel=self._state.channel or self.options.channel or LATEST,
            time=self._time_text(),
            holds=loaded_version(current, is_loaded=is_loaded, has_closures=self._manifests.has_closures),
        )
        if not self._status.set(status):
            return False
        if state != "failed":
            self._log_event(
                state,
                version=status.version,
                root=status.root,
                channel=status.channel,
                **({"detail": status.detail} if status.detail else {}),
            )
        self._status.send()
        return True

    def _time_text(self) -> str:
        moment = datetime.fromtimestamp(self._clock(), timezone.utc)
        return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")

    def _fail(self, event: str, detail: str) -> None:
        self._log_event(event, detail=detail)
        self._set_status("failed", detail, self._about)

    def _log_once(self, event: str, **members: Any) -> None:
        if event not in self._reported_once:
            self._reported_once.add(event)
            self._log_event(event, **members)

"""Hand on statuses of robots: first the changed ones, in order, then the present ones with the robots' places."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from datetime import datetime, timedelta
from itertools import groupby
from typing import Any, Final

from app.mirror.centre import Centre
from app.mirror.failures import NotedFailure
from app.store.fleet_values import ReceivedReport
from app.store.mirror_state import MirrorState
from app.store.store import Store
from app.store.values import rfc3339

log = logging.getLogger(__name__)

PAGE: Final = 500
"""Maximum number of statuses in one request."""

OVERLAP: Final = timedelta(seconds=30)
"""Statuses are read again for this long before the last pass: another process may store one after those that it
received later, and a new leader stores what came before it led."""

OVERLAP_ROWS: Final = 1000
"""Maximum number of rows of the history that are read again."""

PASS_SECONDS: Final = 10.0
"""Time of a pass for either kind, and for one request more. The others wait for the next pass: robots that report
faster than a slow line takes do not keep the mirror from following its centre."""

Skipped = dict[str, dict[str, Any]]
"""By environment, how many statuses the centre refused, and why."""


class Statuses:
    """Hands on what this server has stored since the last pass. Not thread-safe."""

    def __init__(self, store: Store, centre: Centre) -> None:
        self._store, self._centre = store, centre
        self._last_pass: datetime | None = None
        self._handed_rows: dict[int, tuple[str, str, datetime]] = {}
        self._handed_times: dict[tuple[str, str], datetime] = {}

    def hand_on(self, state: MirrorState) -> None:
        """Hand on the statuses. Raises Unavailable if the centre cannot take them now."""
        skipped = {name: dict(one) for name, one in (state.skipped or {}).items()}
        if skipped:
            mirrored = {one.name for one in self._store.mirror_target.environments().values() if one.centre}
            skipped = {name: one for name, one in skipped.items() if name in mirrored}
        began = self._store.now()
        if self._hand_on_changed(state, skipped, min(began, self._last_pass or began) - OVERLAP):
            self._hand_on_present(state, skipped)
            self._last_pass = began

    def _hand_on_changed(self, state: MirrorState, skipped: Skipped, since: datetime) -> bool:
        """Hand on rows of the history; return whether these were all that there were at the last request."""
        store, end = self._store.edge_changes, time.monotonic() + PASS_SECONDS
        handed = min(state.reported, store.newest_report())  # SQLite uses the numbers of removed rows again
        row = handed - OVERLAP_ROWS
        self._handed_rows = {number: of for number, of in self._handed_rows.items() if number > row}
        while rows := store.reports_after(row, PAGE, handed=handed, since=since):
            row = rows[-1][0]
            about = {number: (one.environment, one.robot, one.time) for number, one in rows}
            if new := [one for number, one in rows if self._handed_rows.get(number) != about[number]]:
                self._send(new, skipped, counted=True)
                self._store.mirrors.save(reported=max(row, handed), skipped=skipped)
                self._handed_rows |= about
            if time.monotonic() > end:
                return len(rows) < PAGE
        return True

    def _hand_on_present(self, state: MirrorState, skipped: Skipped) -> None:
        end = time.monotonic() + PASS_SECONDS
        since = None if state.seen is None else state.seen - OVERLAP
        if since is not None:
            self._handed_times = {robot: at for robot, at in self._handed_times.items() if at > since}
        while current := self._store.edge_changes.current_reports(since, PAGE):
            since = current[-1].time
            times = {(one.environment, one.robot): one.time for one in current}
            if new := [one for one in current if self._handed_times.get((one.environment, one.robot)) != one.time]:
                self._send(new, skipped, counted=False)
                self._store.mirrors.save(seen=max(since, state.seen or since), skipped=skipped)
                self._handed_times |= times
            if time.monotonic() > end:
                return

    def _send(self, reports: Sequence[ReceivedReport], skipped: Skipped, *, counted: bool) -> None:
        """Hand on statuses of robots. Those that the centre refuses are skipped, which ``skipped`` says.

        counted: whether these are changed statuses; the present ones, which follow them, count once.
        """
        ordered = sorted(reports, key=lambda report: report.environment)  # stable: each robot's order stays
        for environment, group in groupby(ordered, key=lambda report: report.environment):
            statuses = [_report_as_json(report) for report in group]
            refusals: dict[str, str] = {}
            with NotedFailure(refusals, environment):
                self._centre.report(environment, statuses=statuses)
            if not refusals:
                if skipped.pop(environment, None) is not None:
                    log.info("mirror: the centre accepts statuses again (environment=%s)", environment)
                continue
            problem = refusals[environment]
            if environment not in skipped:
                log.warning("mirror: statuses of robots are skipped (environment=%s): %s", environment, problem)
            before = skipped.get(environment, {"statuses": 0})["statuses"]
            skipped[environment] = {"statuses": before + (len(statuses) if counted else 0), "problem": problem}


def _report_as_json(received: ReceivedReport) -> dict[str, Any]:
    report = received.report
    members: dict[str, Any] = {
        "channel": report.channel,
        "version": report.version,
        "root": report.root,
        "state": report.state,
        "detail": report.detail,
        "time": None if report.reported_at is None else rfc3339(report.reported_at),
        "sequence": report.sequence,
        "overlays": report.overlays,
        "holds": None if report.holds is None else {"version": report.holds[0], "root": report.holds[1]},
        **({} if report.place is None else report.place.as_dict()),
    }
    status = {name: value for name, value in members.items() if value is not None}
    return {
        "robot": received.robot,
        "status": status,
        "received": rfc3339(received.time),
        "vouched": received.vouched,
    }

"""Bring a mirror up to date: hand on what it received, then take over what the centre has, then renew permissions.

Each environment's row is its checkpoint: version and sequence up to which it is mirrored. A pass that ends at any point
leaves each environment in a state that it had at the centre; the next pass goes on from there.
"""

from __future__ import annotations

import base64
import json
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from datetime import datetime, timedelta
from fnmatch import fnmatchcase
from itertools import groupby
from typing import Any, Final

from app.errors import Denied, FleetMapError, NotFound, Unavailable, Untrusted
from app.mirror.centre import Centre
from app.mirror.content import Fetcher
from app.mirror.failures import NotedFailure
from app.mirror.statuses import Statuses
from app.signing import SigningKeys
from app.store.base import utcnow
from app.store.edge_changes import QueuedChange
from app.store.mirror_source import FORM
from app.store.mirror_state import MirrorState, StoredDelegation
from app.store.mirror_target import MirroredEnvironment, MirrorPage, parse_page, read_time
from app.store.store import Store

log = logging.getLogger(__name__)

REPORTS: Final = 500
"""Maximum number of reports or changes in one request."""

DELEGATIONS: Final = 500
"""Maximum number of environments in one request for permissions."""

RENEWALS: Final = 24
"""A permission is renewed after this part of its time, and not more often than every MIN_RENEWAL."""

MIN_RENEWAL: Final = timedelta(minutes=10)


FULL_PASS: Final = timedelta(minutes=10)
"""Time after which all environments are compared again, also without a new event."""


class Mirror:
    """Follows a centre. Not thread-safe.

    position: of the centre's log, as of the last pass. left: number of changes that the last pass could not hand on.

    Args:
        keys: keys of this server, which the centre permits to sign.
        names: environments to mirror, as names or patterns (fnmatch); empty: all that the token may mirror.
    """

    def __init__(
        self,
        store: Store,
        keys: SigningKeys,
        centre: Centre,
        names: Sequence[str] = (),
        clock: Callable[[], datetime] = utcnow,
    ) -> None:
        self._store, self._keys, self._centre, self._names, self._clock = store, keys, centre, tuple(names), clock
        self._fetcher = Fetcher(store, centre)
        self.position = self.left = 0
        self._complete: tuple[datetime, int] | None = None
        self._statuses = Statuses(store, centre)
        self._counted = (0, 0)

    def run_once(self) -> MirrorState:
        """Run one pass; returns the state after it.

        Raises Untrusted if this is another server or it lies, Unauthenticated or Denied for the token, Unavailable if
        the centre cannot be reached. Reasons why some environments are not mirrored are in the state.
        """
        try:
            state = self._run_once()
        except FleetMapError as error:
            self._note_problem(error)
            raise
        return state

    def _run_once(self) -> MirrorState:
        failures: dict[str, str] = {}
        listing = self._centre.listing(self._seen_position())
        state = self._check(listing)
        if int(listing["epoch"]) != state.epoch:
            self._complete = None
            listing = self._centre.listing()
        if self._hand_on(state, failures):  # it is in the centre's log by now
            listing = self._centre.listing(self._seen_position())
        self.position = int(listing["position"])
        changes: dict[str, Any] = {"epoch": int(listing["epoch"]), "url": self._centre.url, "key": self._centre.key}
        if listing["environments"] is not None:
            self._take_over(listing, failures)
            keys = self._centre.keys()
            changes |= {"centre_keys": keys} if keys != list(state.centre_keys) else {}
            changes |= {} if failures else {"position": self.position}
            self._complete = None if failures else (self._clock(), self.position)
        self._renew_permissions(failures)
        for name, problem in sorted(failures.items()):
            if (state.failures or {}).get(name) != problem:  # once, not for each pass
                log.warning("mirror: skipped, will retry (environment=%s): %s", name, problem)
        changes |= {"contact": self._clock(), "problem": None, "failures": failures}
        self._store.mirrors.save(**changes, **self._traffic(), centre_position=self.position)
        return self._store.mirrors.state() or state

    def _seen_position(self) -> int:
        """Return the position of the last pass that was complete; 0 if it is too old: titles change without events."""
        if self._complete is None or not timedelta(0) <= self._clock() - self._complete[0] < FULL_PASS:
            return 0
        return self._complete[1]

    def _take_over(self, listing: Mapping[str, Any], failures: dict[str, str]) -> None:
        self._remove_purged(listing)
        local = self._store.mirror_target.environments()
        for item in listing["environments"]:
            if self._is_chosen(str(item["name"])):
                with NotedFailure(failures, str(item["name"]), goes_on=True):
                    self._sync(item, local.get(str(item["id"])), int(listing["epoch"]))

    def _note_problem(self, error: FleetMapError) -> None:
        if self._store.mirrors.state() is not None:
            self._store.mirrors.save(problem=error.detail, **self._traffic())

    def _traffic(self) -> dict[str, int]:
        """Return the bytes received and sent since the last call."""
        before, self._counted = self._counted, (self._centre.received, self._centre.sent)
        return {"received": self._counted[0] - before[0], "sent": self._counted[1] - before[1]}

    def _check(self, listing: Mapping[str, Any]) -> MirrorState:
        """Check that the centre is the one that this server follows. Raises Untrusted."""
        if listing.get("form") != FORM:
            raise Untrusted(
                f"{self._centre.url} writes form {listing.get('form')!r:.20}, this server reads form {FORM}: update "
                "the older one"
            )
        state = self._store.mirrors.state()
        if state is None:
            assert self._centre.key is not None
            self._store.mirrors.start(self._centre.url, self._centre.key)
            log.info("mirror: follows %s from now on", self._centre.url)
            state = MirrorState(self._centre.url, self._centre.key)
        if int(listing["epoch"]) < state.epoch:
            raise Untrusted(
                f"{self._centre.url} has epoch {listing['epoch']}, lower than {state.epoch} before: it was restored "
                "from a backup without `fleetmap restore`, or this is another server. Raise its epoch"
            )
        return state

    def _is_chosen(self, name: str) -> bool:
        return not self._names or any(fnmatchcase(name, pattern) for pattern in self._names)

    # --- taking over ---

    def _remove_purged(self, listing: Mapping[str, Any]) -> None:
        """Remove environments that the centre has no more, but not those that the token cannot see any more."""
        present = {str(item["id"]) for item in listing["environments"]}
        allowed = listing["allowed"]
        for one in self._store.mirror_target.environments().values():
            visible = allowed is None or fnmatchcase(one.name, allowed)
            if one.centre is not None and one.id not in present and visible:
                log.warning("mirror: removed, since the centre has purged it (environment=%s)", one.name)
                self._store.mirror_target.remove(one.id)

    def _sync(self, item: Mapping[str, Any], local: MirroredEnvironment | None, epoch: int) -> None:
        """Take over an environment up to the centre's present state."""
        if local is not None and local.centre is None:
            return  # released: it is changed here
        if local is not None and self._is_current(item, local, epoch):
            return
        after, sequence = (-1, 0) if local is None else (local.head, local.sequence)
        while True:
            page = self._page(item, after, sequence, epoch)
            if local is not None and page.epoch > local.epoch:
                self._replace(item, epoch)
                return
            if local is not None and _has_diverged(page, local):
                raise Untrusted(
                    f"{item['name']}: the history at {self._centre.url} is not the one mirrored before, under the same "
                    f"epoch {page.epoch}: it was restored without raising the epoch, or this is another server"
                )
            base = self._base_parts(local, after)
            fetched = self._fetcher.fetch(page, after, base)
            self._store.mirror_target.apply(page, self._centre.url, fetched.chunks, fetched.blobs)
            if page.complete:
                return
            local = self._store.mirror_target.environments()[page.id]
            after, sequence = local.head, local.sequence

    def _is_current(self, item: Mapping[str, Any], local: MirroredEnvironment, epoch: int) -> bool:
        same = (item["name"], int(item["sequence"]), epoch) == (local.name, local.sequence, local.epoch)
        return same and read_time(str(item["updated"])) == local.updated and local.centre == self._centre.url

    def _page(self, item: Mapping[str, Any], after: int, sequence: int, epoch: int) -> MirrorPage:
        thinned = self._store.mirror_target.newest_thinned(str(item["id"])) if after >= 0 else None
        page = parse_page(self._centre.page(str(item["name"]), after, sequence, thinned))
        if page.id != item["id"] or page.epoch != epoch:
            raise Unavailable(f"{item['name']}: it changed at {self._centre.url} meanwhile: the next attempt follows")
        return page

    def _base_parts(self, local: MirroredEnvironment | None, after: int) -> list[str]:
        if local is None or after < 0:
            return []
        base, _ = self._store.versions.get_with_base(local.name, after)
        return [entry.hash for entry in base.parts]

    def _replace(self, item: Mapping[str, Any], epoch: int) -> None:
        """Take over a history that is another one since the centre was restored: all of it in one transaction."""
        log.warning(
            "mirror: the centre was restored, its history replaces the mirrored one (environment=%s)", item["name"]
        )
        after, sequence = -1, 0
        pages: list[MirrorPage] = []
        chunks: set[bytes] = set()
        blobs: set[str] = set()
        while not pages or not pages[-1].complete:
            page = self._page(item, after, sequence, epoch)
            roots = [entry.hash for entry in pages[-1].versions[-1][0].parts] if pages and pages[-1].versions else []
            fetched = self._fetcher.fetch(page, after, roots)
            chunks.update(fetched.chunks)
            blobs.update(fetched.blobs)
            pages.append(page)
            after, sequence = page.last, page.upto
        versions = tuple(version for page in pages for version in page.versions)
        events = tuple(event for page in pages for event in page.events)
        merged = replace(pages[-1], versions=versions, events=events, base=None)
        self._store.mirror_target.apply(merged, self._centre.url, sorted(chunks), blobs, anew=True)

    # --- handing on ---

    def _hand_on(self, state: MirrorState, failures: dict[str, str]) -> bool:
        """Hand on changes of overlays, then reports of robots, in their order; returns whether there were changes."""
        waiting = self._store.edge_changes.waiting(REPORTS)
        for environment, group in groupby(waiting, key=lambda change: change.environment):
            with NotedFailure(failures, environment, goes_on=True):
                self._hand_on_changes(environment, list(group))
        self.left = sum(change.environment in failures for change in waiting)
        self._statuses.hand_on(state)
        return bool(waiting)

    def _hand_on_changes(self, environment: str, changes: Sequence[QueuedChange]) -> None:
        outcome = self._centre.report(environment, changes=[_change_as_json(change.body) for change in changes])
        for change, result in zip(changes, outcome["changes"], strict=True):
            if result["problem"] is not None:
                log.warning("mirror: refused by the centre (environment=%s): %s", environment, result["problem"])
            self._store.edge_changes.settle(change, result["problem"], result["overlay"])

    # --- permissions ---

    def _renew_permissions(self, failures: dict[str, str]) -> None:
        """Request statements that this server's key may sign, where there is none, or where it is old."""
        public, now = self._keys.public()[0].public, self._clock()
        valid = {
            one.environment_id
            for one in self._store.mirrors.delegations()
            if one.key == public and not _is_old(one, now)
        }
        mirrored = [one for one in self._store.mirror_target.environments().values() if one.centre and not one.deleted]
        due = [one for one in mirrored if one.id not in valid and self._is_chosen(one.name)]
        for start in range(0, len(due), DELEGATIONS):
            some = due[start : start + DELEGATIONS]
            try:
                self._request_permissions(some, public)
            except (NotFound, Denied):  # one of them: find out which
                for one in some:
                    with NotedFailure(failures, one.name):
                        self._request_permissions([one], public)

    def _request_permissions(self, environments: Sequence[MirroredEnvironment], public: bytes) -> None:
        answers = {
            str(a["environment_id"]): a for a in self._centre.delegate(public, [one.name for one in environments])
        }
        stored = []
        for one in environments:
            if one.id not in answers:
                continue
            answer = answers[one.id]
            statement = base64.b64decode(answer["statement"])
            self._centre.verify(statement, f"{answer['signed_by']}:{answer['signature']}")
            body = json.loads(statement)
            about = (body.get("kind"), body.get("public_key"), body.get("environment"))
            if about != ("delegation", base64.b64encode(public).decode(), one.name):
                raise Untrusted(f"{one.name}: {self._centre.url} signed a permission for something else")
            signature = base64.b64decode(answer["signature"])
            expires = read_time(body["until"])
            stored.append(StoredDelegation(one.id, statement, answer["signed_by"], signature, public, expires))
        self._store.mirrors.store_delegations(stored)


def _has_diverged(page: MirrorPage, local: MirroredEnvironment) -> bool:
    """Return whether the centre's history is another one than that of the mirror."""
    if page.upto < local.sequence:
        return True
    return page.base is None or page.base["root"] != local.root


def _is_old(one: StoredDelegation, now: datetime) -> bool:
    start = read_time(json.loads(one.statement)["from"])
    return now - start > max(MIN_RENEWAL, (one.expires - start) / RENEWALS) or now < start - MIN_RENEWAL


def _change_as_json(body: Mapping[str, Any]) -> dict[str, Any]:
    """Convert a queued change for the centre, which has its own environment, state and version."""
    overlay = {
        name: value for name, value in body["overlay"].items() if name not in ("environment", "state", "version")
    }
    return {**body, "overlay": overlay}

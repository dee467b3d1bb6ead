"""Edits that gather in a draft, and its rebase on a newer head."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Final, TypeVar

from app.errors import Denied, StaleParent
from app.ingest.edits import check_depth, edit_changes
from app.ingest.rebase import MergeConflict, Side, prepare_rebase
from app.store.changes import Changes, Prepared
from app.store.in_worker import open_store
from app.store.store import Store
from app.store.values import DRAFT_PREFIX, Draft, Version, Writer

MAX_ATTEMPTS: Final = 20
"""Maximum number of attempts to store an edit without ``If-Match`` while others edit the draft."""

TURNS: Final = 64
"""Number of locks that the drafts share."""

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class RebaseResult:
    """A draft on top of the head, or the conflicts that prevent it."""

    draft: Draft
    conflicts: tuple[MergeConflict, ...] = ()


class DraftEditor:
    """Operations on drafts. Only the owner of a draft and administrators may write it."""

    def __init__(self, store: Store, run_in_worker: Callable[..., Any]) -> None:
        self._store, self._run_in_worker = store, run_in_worker
        self._turns = tuple(threading.RLock() for _ in range(TURNS))

    def turn(self, id: str) -> AbstractContextManager[object]:
        """Let only this thread edit a draft, else the slowest of several writers finds its edit stale every time.

        Writers of other processes do not wait: what they store meanwhile is still found by compare-and-swap.
        """
        return self._turns[hash(id) % TURNS]

    def edit(
        self,
        environment: str,
        id: str,
        changes: Sequence[Mapping[str, Any]],
        writer: Writer,
        if_match: str | None = None,
    ) -> Draft:
        """Apply edits to a draft, all or none; concurrent edits are kept.

        if_match: an ``If-Match`` header, which must name the draft's content. Raises Invalid, NotFound, Denied,
        StaleParent.
        """
        check_depth(changes)

        def once(current: Version) -> Draft:
            assert current.pending is not None
            assert current.parent is not None
            base = self._store.versions.get(environment, current.parent)
            change_set, warnings = edit_changes(self._store, current, changes)
            failure = "the draft could not be edited"
            prepared = self._run_in_worker(prepare_draft, base, current, change_set, failure=failure)
            return self._store.drafts.store(environment, current.pending, prepared, warnings, rebased=False)

        return self._on_current(environment, id, writer, if_match, once)

    def check(self, version: Version, changes: Sequence[Mapping[str, Any]]) -> None:
        """Check edits that are the first ones on top of a version. Raises Invalid, NotFound."""
        check_depth(changes)
        edit_changes(self._store, version, changes)

    def rebase(
        self, environment: str, id: str, writer: Writer, if_match: str | None = None, prefer: Side | None = None
    ) -> RebaseResult:
        """Put a draft's changes on top of the head. prefer: the side that wins where both changed the same.

        Raises NotFound, Denied, StaleParent.
        """

        def once(current: Version) -> RebaseResult:
            assert current.pending is not None
            assert current.parent is not None
            head = self._store.versions.get(environment)
            base = self._store.versions.get(environment, current.parent)
            if head.number == base.number:
                return RebaseResult(self._store.drafts.get(environment, id))
            prepared, conflicts = self._run_in_worker(
                prepare_rebase, base, current, head, prefer, failure="the draft could not be rebased"
            )
            if prepared is None:
                return RebaseResult(self._store.drafts.get(environment, id), conflicts)
            return RebaseResult(self._store.drafts.store(environment, current.pending, prepared, rebased=True))

        return self._on_current(environment, id, writer, if_match, once)

    def delete(self, environment: str, id: str, writer: Writer) -> None:
        """Delete a draft with its changes. Raises NotFound, Denied."""
        check_writer(self._store.drafts.get(environment, id), writer)
        self._store.drafts.delete(environment, id)

    def _on_current(
        self, environment: str, id: str, writer: Writer, if_match: str | None, once: Callable[[Version], T]
    ) -> T:
        check_writer(self._store.drafts.get(environment, id), writer)
        attempts = MAX_ATTEMPTS if if_match in (None, "*") else 1
        for attempt in range(attempts):
            with self.turn(id):
                current = self._store.versions.get(environment, DRAFT_PREFIX + id)
                check_draft_match(if_match, current)
                try:
                    return once(current)
                except StaleParent:
                    if attempt == attempts - 1:
                        raise
        raise AssertionError("unreachable")


def prepare_draft(database_url: str, blob_dir: str, base: Version, current: Version, changes: Changes) -> Prepared:
    """Prepare changes on top of a draft's content (in a worker)."""
    return open_store(database_url, blob_dir).versions.prepare_further(base, current, changes)


def check_writer(draft: Draft, writer: Writer) -> None:
    """Raise Denied unless somebody may write a draft."""
    if not draft.may_write(writer):
        raise Denied(
            f"the draft {draft.name!r} belongs to {draft.owner}: only its owner or an administrator may change it; "
            "make one of your own"
        )


def check_draft_match(header: str | None, current: Version) -> None:
    """Check the If-Match header against a draft's content. Raises StaleParent if it names another one."""
    assert current.pending is not None
    if header is None:
        return
    tags = [tag.strip().removeprefix("W/").strip('"') for tag in header.split(",")]
    if "*" not in tags and current.pending.tag not in tags:
        raise StaleParent(
            f"the draft is at {current.pending.tag}, which If-Match {header[:80]} does not include: read it again, and "
            "repeat the change"
        )

"""Worker's side of the queue: which errors are a task's outcome, and which ones let another attempt follow."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import pytest

from app.api.http.task_performer import TaskPerformer
from app.backends.queue import FAILURES, MAX_FAILURES, Task
from app.errors import Invalid, NoRoom, Unavailable
from app.ingest import CommitRequest, DerivationRequest
from app.store.store import Store
from app.store.values import Job


class Failing:
    """Ingest whose changes fail."""

    def __init__(self, error: Exception) -> None:
        self.error = error

    def stopped_by(self, stop: object) -> Failing:
        return self

    def derive(self, environment: str, request: DerivationRequest, commit: CommitRequest) -> Any:
        raise self.error


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    """An empty store."""
    store = Store(f"sqlite:///{tmp_path / 'fleetmap.sqlite'}", tmp_path / "blobs")
    store.migrate()
    yield store
    store.close()


def perform(store: Store, error: Exception, failures: int) -> Job:
    """Carry out a derivation that fails after some other attempts; return its job, also if the error was raised."""
    job = store.jobs.create("ana", task="key")
    performer = TaskPerformer(store, cast(Any, None), cast(Any, Failing(error)), lambda *_: None)
    arguments = {
        "request": {"method": "topology", "values": {}},
        "commit": {"author": "ana"},
        "caller": None,
        FAILURES: failures,
    }
    try:
        performer.perform(Task("derive", "key", "farm", "person", arguments))
    except Unavailable as raised:
        assert raised is error
    return store.jobs.get(job.id)


@pytest.mark.parametrize("error", [Unavailable("the database is unavailable"), NoRoom("the disk is full")])
def test_change_is_tried_again_when_the_database_is_back(store: Store, error: Exception) -> None:
    assert perform(store, error, MAX_FAILURES - 1).state == "running"


def test_change_that_goes_on_failing_ends_with_the_reason(store: Store) -> None:
    job = perform(store, Unavailable("the database is unavailable"), MAX_FAILURES)
    assert job.state == "failed"
    assert job.problem is not None
    assert "the database is unavailable" in job.problem["detail"]


def test_error_of_the_request_is_its_outcome_at_once(store: Store) -> None:
    assert perform(store, Invalid("unknown method"), 0).state == "failed"

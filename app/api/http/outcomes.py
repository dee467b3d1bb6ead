"""Outcomes of tasks as JSON, for the servers that wait for them: what was made, or why not."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from app import errors
from app.errors import CannotDerive, FleetMapError, Problem, Unavailable
from app.ingest import CommitResult
from app.store.store import Store

LOST = "the work was lost with its worker: repeat the request"


def error_as_json(error: BaseException) -> dict[str, Any]:
    """Convert an error; of an internal one only that there was one."""
    if not isinstance(error, FleetMapError):
        return {"error": ""}
    out: dict[str, Any] = {
        "error": type(error).__name__,
        "detail": error.detail,
        "problems": [problem.as_dict() for problem in error.problems],
    }
    return {**out, "step": error.step, "choose": error.choose} if isinstance(error, CannotDerive) else out


def error_from_json(outcome: Mapping[str, Any] | None) -> Exception:
    """Return the error of a task that failed; Unavailable if its outcome is unknown."""
    if outcome is None:
        return Unavailable(LOST)
    kind = getattr(errors, str(outcome.get("error")), None)
    if not (isinstance(kind, type) and issubclass(kind, FleetMapError)):
        return RuntimeError("internal error in a worker of another server; details are in its log")
    problems = [Problem(**problem) for problem in outcome["problems"]]
    if issubclass(kind, CannotDerive):
        return kind(outcome["detail"], problems, outcome["step"], choose=outcome["choose"])
    return kind(outcome["detail"], problems)


def commit_as_json(result: CommitResult) -> dict[str, Any]:
    """Convert the result of a change; content is in the store."""
    return {
        "status": result.status,
        "version": None if result.version is None else result.version.number,
        "body": result.body,
    }


def commit_from_json(store: Store, environment: str, outcome: Mapping[str, Any]) -> CommitResult:
    """Return the result of a change that a worker made."""
    number = outcome["version"]
    version = None if number is None else store.versions.get(environment, number)
    return CommitResult(outcome["status"], version, dict(outcome["body"]))

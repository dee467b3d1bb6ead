"""Errors of a command as RFC 9457 problems, with a hint for the command line."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from app.errors import FleetMapError


class RequestFailed(Exception):
    """The server's answer is a problem, or there is no answer. ``problem`` has RFC 9457's members."""

    def __init__(self, problem: Mapping[str, Any], *, status: int | None = None, hint: str = "") -> None:
        super().__init__(str(problem.get("detail") or problem.get("title") or "refused"))
        self.problem, self.status, self.hint = dict(problem), status, hint


HINTS: Mapping[str, str] = {
    "MissingDatum": "On the command line: --datum LAT,LON, or a datum.yaml among the files.",
    "missing-datum": "On the command line: `fleetmap import PATH --environment NAME --datum LAT,LON`.",
    "gone": "`fleetmap environment restore NAME` brings it back; `fleetmap environment purge NAME` frees the name.",
    "Ambiguous": "On the command line: --option grid=NAME.",
    "ambiguous": "On the command line: --option grid=NAME.",
}
"""What to do here, by our own errors' class or the last word of a server's problem type."""


def as_problem(error: FleetMapError) -> dict[str, Any]:
    """An error of our own as the server would tell it."""
    problem: dict[str, Any] = {"title": type(error).__name__, "detail": error.detail}
    if error.problems:
        problem["errors"] = [p.as_dict() for p in error.problems]
    return problem


def describe_error(error: Exception) -> tuple[dict[str, Any] | None, str]:
    """Return the problem of an error and a hint; None for an error that is not the user's to mend."""
    if isinstance(error, RequestFailed):
        kind = str(error.problem.get("type", "")).rpartition(":")[2]
        return error.problem, error.hint or HINTS.get(kind, "")
    if isinstance(error, FleetMapError):
        return as_problem(error), HINTS.get(type(error).__name__, "")
    if isinstance(error, ModuleNotFoundError):
        if error.name is None or error.name.partition(".")[0] == "app":
            return None, ""
        detail = f"this command needs the server's packages ({error.name} is not installed)"
        return {"title": "Not installed", "detail": detail}, 'pip install "fleet-map-server[server]"'
    if isinstance(error, OSError):
        prefix = f"{error.filename}: " if error.filename else ""
        return {"title": "Input or output failed", "detail": f"{prefix}{error.strerror or error}"}, ""
    return None, ""

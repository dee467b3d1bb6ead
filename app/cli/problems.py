"""Errors of a command as RFC 9457 problems, with a hint for the command line."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from app.errors import FleetMapError


class RequestFailed(Exception):
    """Error response of the server, or no response. ``problem`` has the members of RFC 9457."""

    def __init__(self, problem: Mapping[str, Any], *, status: int | None = None, hint: str = "") -> None:
        super().__init__(str(problem.get("detail") or problem.get("title") or "refused"))
        self.problem, self.status, self.hint = dict(problem), status, hint


HINTS: Mapping[str, str] = {
    "MissingDatum": "Set it with --datum LAT,LON, or add a datum.yaml to the files.",
    "missing-datum": "Set it with `fleetmap import PATH --environment NAME --datum LAT,LON`.",
    "gone": "Restore it with `fleetmap environment restore NAME`, or free its name with `… purge NAME`.",
    "Ambiguous": "Choose one with --option grid=NAME.",
    "ambiguous": "Choose one with --option grid=NAME.",
}
"""Hints by error class, or by the last part of the problem type of the server."""


def as_problem(error: FleetMapError) -> dict[str, Any]:
    """Return the RFC 9457 problem of a local error."""
    problem: dict[str, Any] = {"title": type(error).__name__, "detail": error.detail}
    if error.problems:
        problem["errors"] = [p.as_dict() for p in error.problems]
    return problem


def describe_error(error: Exception) -> tuple[dict[str, Any] | None, str]:
    """Return the problem of an error and a hint; None for an internal error."""
    if isinstance(error, RequestFailed):
        kind = str(error.problem.get("type", "")).rpartition(":")[2]
        return error.problem, error.hint or HINTS.get(kind, "")
    if isinstance(error, FleetMapError):
        return as_problem(error), HINTS.get(type(error).__name__, "")
    if isinstance(error, ModuleNotFoundError):
        if error.name is None or error.name.partition(".")[0] == "app":
            return None, ""
        detail = f"this command requires the server's packages: {error.name} is not installed"
        return {"title": "Not installed", "detail": detail}, 'pip install "fleet-map-server[server]"'
    if isinstance(error, OSError):
        prefix = f"{error.filename}: " if error.filename else ""
        return {"title": "Input or output failed", "detail": f"{prefix}{error.strerror or error}"}, ""
    return None, ""

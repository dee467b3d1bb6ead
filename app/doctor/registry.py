"""Checks by name, and what they return."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final, Literal

from app.doctor.site import Site

Level = Literal["ok", "warning", "error"]


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of a look at one thing. detail: its state. place: file, address or setting. advice: what to do.

    ``error``: the server cannot work, or loses its security, now or within days. ``warning``: it works with a fault.
    """

    level: Level
    detail: str
    place: str = ""
    advice: str = ""


@dataclass(frozen=True, slots=True)
class Result:
    """A finding and the name of its check."""

    check: str
    finding: Finding

    def as_dict(self) -> dict[str, str]:
        """Return the members for JSON."""
        finding = self.finding
        return {
            "check": self.check,
            "level": finding.level,
            "detail": finding.detail,
            "place": finding.place,
            "advice": finding.advice,
        }


Check = Callable[[Site], Iterable[Finding]]

CHECKS: Final[dict[str, Check]] = {}


def check(function: Check) -> Check:
    """Register a check under the name of its function, with hyphens."""
    CHECKS[function.__name__.replace("_", "-")] = function
    return function


def ok(detail: str, place: str = "") -> Finding:
    """Return a finding that needs nothing."""
    return Finding("ok", detail, place)


def warning(detail: str, place: str = "", advice: str = "") -> Finding:
    """Return a finding that needs a look."""
    return Finding("warning", detail, place, advice)


def error(detail: str, place: str = "", advice: str = "") -> Finding:
    """Return a finding that needs action."""
    return Finding("error", detail, place, advice)


def human_size(count: int) -> str:
    """Format a number of bytes with three digits."""
    value = float(count)
    for unit in ("B", "KiB", "MiB", "GiB"):
        if value < 1024:
            return f"{value:.3g} {unit}"
        value /= 1024
    return f"{value:.3g} TiB"

"""Notes that readers, derivations, generators and writers report with their result: warnings, losses and defaults."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from app.errors import Problem

MAX_WARNINGS = 100_000
"""Maximum number of warnings that are stored per task."""


@dataclass(frozen=True, slots=True)
class Dropped:
    """A number of items that are missing in the result, and the reason."""

    subject: str
    count: int
    why: str

    def as_dict(self) -> dict[str, Any]:
        """Return the loss as JSON."""
        return {"what": self.subject, "count": self.count, "why": self.why}

    @classmethod
    def from_dict(cls, line: Mapping[str, Any]) -> Dropped:
        """Read the loss from its JSON."""
        return cls(line["what"], line["count"], line["why"])


@dataclass(frozen=True, slots=True)
class Filled:
    """A value that was filled in from a default because no source has it. value: JSON-like.

    option: the parameter that sets it. format: of a map inside another one. origin: source of the value, the default or
    another setting of the option; empty if not looked up.
    """

    subject: str
    value: Any
    why: str
    option: str | None = None
    format: str | None = None
    origin: str = ""

    def as_dict(self) -> dict[str, Any]:
        """Return the value as JSON, without its empty members."""
        more = {"option": self.option, "format": self.format, "from": self.origin or None}
        members = {"what": self.subject, "value": self.value, "why": self.why}
        return members | {name: text for name, text in more.items() if text is not None}

    @classmethod
    def from_dict(cls, line: Mapping[str, Any]) -> Filled:
        """Read the value from its JSON."""
        return cls(
            line["what"], line["value"], line["why"], line.get("option"), line.get("format"), line.get("from", "")
        )


@dataclass(slots=True)
class Warnings:
    """Collector of warnings. main: their file if they name no other."""

    warnings: list[Problem] = field(default_factory=list, kw_only=True)
    main: str = field(default="", kw_only=True)

    def warn(self, problem: str, *, file: str | None = None, line: int | None = None, where: str | None = None) -> None:
        """Add a warning: the result is usable, but its users should know this."""
        if len(self.warnings) < MAX_WARNINGS:
            self.warnings.append(Problem(problem, file or self.main or None, line, where))


@dataclass(slots=True)
class Notes(Warnings):
    """Collector of warnings, losses, and values that were filled in."""

    dropped: list[Dropped] = field(default_factory=list, kw_only=True)
    template: list[Filled] = field(default_factory=list, kw_only=True)

    def drop(self, subject: str, count: int, why: str) -> None:
        """Report a number of items of the source that are missing in the result; a count of 0 is no loss."""
        if count:
            self.dropped.append(Dropped(subject, int(count), why))  # converts NumPy's integers

    def fill(self, subject: str, value: Any, why: str, option: str | None = None) -> None:
        """Report that a default was filled in. value: JSON-like. option: the parameter that sets it."""
        self.template.append(Filled(subject, value, why, option))

    def as_warnings(self) -> tuple[Problem, ...]:
        """Return all notes as warnings of a version."""
        return (
            *self.warnings,
            *(Problem(f"dropped: {one.count} {one.subject}: {one.why}") for one in self.dropped),
            *(Problem(f"filled in: {one.subject} = {one.value}: {one.why}") for one in self.template),
        )

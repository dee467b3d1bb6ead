"""What those who read, derive, generate and write maps report beside their result: doubts, losses and defaults."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from app.errors import Problem

MAX_WARNINGS = 100_000
"""Warnings of one task that are kept."""


@dataclass(frozen=True, slots=True)
class Dropped:
    """So many things that have no place in the result, and why."""

    subject: str
    count: int
    why: str

    def as_dict(self) -> dict[str, Any]:
        """The loss as JSON."""
        return {"what": self.subject, "count": self.count, "why": self.why}

    @classmethod
    def from_dict(cls, line: Mapping[str, Any]) -> Dropped:
        """The loss from its JSON."""
        return cls(line["what"], line["count"], line["why"])


@dataclass(frozen=True, slots=True)
class Filled:
    """A value that no source has: a default was filled in. value: JSON-like.

    option: the parameter that sets it. format: of a map inside another one. origin: where the value comes from, the
    default or what else sets the option; empty where that is not looked up.
    """

    subject: str
    value: Any
    why: str
    option: str | None = None
    format: str | None = None
    origin: str = ""

    def as_dict(self) -> dict[str, Any]:
        """The value as JSON, without its empty members."""
        more = {"option": self.option, "format": self.format, "from": self.origin or None}
        members = {"what": self.subject, "value": self.value, "why": self.why}
        return members | {name: text for name, text in more.items() if text is not None}

    @classmethod
    def from_dict(cls, line: Mapping[str, Any]) -> Filled:
        """The value from its JSON."""
        return cls(
            line["what"], line["value"], line["why"], line.get("option"), line.get("format"), line.get("from", "")
        )


@dataclass(slots=True)
class Warnings:
    """Collects warnings. main: the file that they are about if they name no other."""

    warnings: list[Problem] = field(default_factory=list, kw_only=True)
    main: str = field(default="", kw_only=True)

    def warn(self, problem: str, *, file: str | None = None, line: int | None = None, where: str | None = None) -> None:
        """Something doubtful: the result stands all the same, and whoever uses it should know this."""
        if len(self.warnings) < MAX_WARNINGS:
            self.warnings.append(Problem(problem, file or self.main or None, line, where))


@dataclass(slots=True)
class Notes(Warnings):
    """Collects warnings, losses, and values that were filled in."""

    dropped: list[Dropped] = field(default_factory=list, kw_only=True)
    template: list[Filled] = field(default_factory=list, kw_only=True)

    def drop(self, subject: str, count: int, why: str) -> None:
        """So much of the source has no place in the result; a count of 0 is no loss."""
        if count:
            self.dropped.append(Dropped(subject, int(count), why))  # also of NumPy's integers

    def fill(self, subject: str, value: Any, why: str, option: str | None = None) -> None:
        """No source has this: a default was filled in. value: JSON-like. option: the parameter that sets it."""
        self.template.append(Filled(subject, value, why, option))

    def as_warnings(self) -> tuple[Problem, ...]:
        """All notes as warnings of a version."""
        return (
            *self.warnings,
            *(Problem(f"left out: {one.count} {one.subject}: {one.why}") for one in self.dropped),
            *(Problem(f"filled in: {one.subject} = {one.value}: {one.why}") for one in self.template),
        )

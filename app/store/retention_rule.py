"""Rules of retention: which versions stay by their age. A calculation on numbers and times alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta

from app.errors import Invalid


@dataclass(frozen=True, slots=True)
class Rule:
    """Which versions stay by their age.

    Attributes:
        all_days: days of which all versions stay.
        daily_days: days of which the last version of each day (UTC) stays; 0: none.
        last: number of the newest versions that stay, however old.
        source_days: days after which files of kept versions go, if the layers have all that the format can say; None:
            they stay.
    """

    all_days: int
    daily_days: int = 365
    last: int = 10
    source_days: int | None = None

    def check(self) -> None:
        """Raise Invalid for a rule that could remove everything, or that contradicts itself."""
        if self.all_days < 1 or self.last < 1:
            raise Invalid(
                f"the rule {self.text!r} could remove everything: keep all versions of at least 1 day, and at least "
                "the last one"
            )
        if self.daily_days and self.daily_days < self.all_days:
            raise Invalid(
                f"one version a day for {self.daily_days} days is less than all of {self.all_days} days: use 0, or "
                "more days"
            )
        if self.source_days is not None and self.source_days < 1:
            raise Invalid("files of kept versions stay for at least 1 day: use another number of days, or none")

    @property
    def text(self) -> str:
        """Return the rule in words, as the history tells it."""
        daily = f", one a day for {self.daily_days} days" if self.daily_days else ""
        return f"all of {self.all_days} days{daily}, the last {self.last}"

    def reasons(self, versions: Sequence[tuple[int, datetime]], now: datetime) -> dict[int, str]:
        """Return which versions (number, time; newest first) stay by their age, and why."""
        out: dict[int, str] = {}
        days: set[object] = set()
        for k, (number, time) in enumerate(versions):
            day, age = time.date(), now - time
            if k < self.last:
                out[number] = "last"
            elif age <= timedelta(days=self.all_days):
                out[number] = "recent"
            elif age <= timedelta(days=self.daily_days) and day not in days:
                out[number] = "daily"
            days.add(day)
        return out

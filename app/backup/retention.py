"""Which backups of a place stay: ``ALL[/DAILY[/MONTHLY]]``, such as ``7d/90d/2y``."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Final

from app.backup.repository import Snapshot
from app.errors import Invalid

_TERM: Final = re.compile(r"(\d{1,5})([dwmy])")
_DAYS: Final = {"d": 1, "w": 7, "m": 30, "y": 365}


@dataclass(frozen=True, slots=True)
class KeepRule:
    """Spans back from now: within the first all backups stay, then one a day, then one a month; zero for none."""

    everything: timedelta
    daily: timedelta = timedelta(0)
    monthly: timedelta = timedelta(0)

    def outdated(self, snapshots: Sequence[Snapshot], now: datetime) -> list[Snapshot]:
        """Return the backups that go, of backups in any order. The newest one always stays."""
        newest_first = sorted(snapshots, key=lambda snapshot: snapshot.started, reverse=True)
        days: set[str] = set()
        months: set[str] = set()
        gone: list[Snapshot] = []
        for number, snapshot in enumerate(newest_first):
            age = now - snapshot.started
            day, month = snapshot.started.strftime("%Y-%m-%d"), snapshot.started.strftime("%Y-%m")
            of_day = age <= self.daily and day not in days
            of_month = age <= self.monthly and month not in months
            if number == 0 or age <= self.everything or of_day or of_month:
                days.add(day)
                months.add(month)
            else:
                gone.append(snapshot)
        return gone


def parse_rule(text: str) -> KeepRule:
    """Read a rule. Raises Invalid."""
    terms = text.split("/")
    matches = [_TERM.fullmatch(term) for term in terms]
    if len(terms) > 3 or not all(matches):
        raise Invalid(
            f"--keep {text[:80]}: use ALL, ALL/DAILY or ALL/DAILY/MONTHLY with numbers of days, weeks, months or "
            "years, such as 30d or 7d/90d/2y"
        )
    spans = [timedelta(days=int(match[1]) * _DAYS[match[2]]) for match in matches if match is not None]
    if any(later <= earlier for earlier, later in itertools.pairwise(spans)):
        raise Invalid(f"--keep {text[:80]}: each span must be longer than the one before it")
    return KeepRule(*spans)

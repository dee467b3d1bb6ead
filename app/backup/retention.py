"""Which backups of a place stay: ``ALL[/DAILY[/MONTHLY]]``, such as ``7d/90d/2y``.

Days and months are counted in the backups, not on the clock: one without a backup does not count. So neither a pause
nor a clock that leaps makes older backups go.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from app.backup.repository import Snapshot
from app.errors import Invalid

_TERM: Final = re.compile(r"(\d{1,5})([dwmy])")
_DAYS: Final = {"d": 1, "w": 7, "m": 30, "y": 365}


@dataclass(frozen=True, slots=True)
class KeepRule:
    """Days, days and months (UTC) before the newest backup's, of which all, one a day, one a month stay; 0: none."""

    everything: int
    daily: int = 0
    monthly: int = 0

    def outdated(self, snapshots: Sequence[Snapshot]) -> list[Snapshot]:
        """Return the backups that go, of backups in any order. The newest one always stays."""
        days: dict[str, int] = {}
        months: dict[str, int] = {}
        gone: list[Snapshot] = []
        newest_first = sorted(snapshots, key=lambda snapshot: snapshot.order, reverse=True)
        for number, snapshot in enumerate(newest_first):
            day, month = snapshot.started.strftime("%Y-%m-%d"), snapshot.started.strftime("%Y-%m")
            is_last_of_day, is_last_of_month = day not in days, month not in months
            age = days.setdefault(day, len(days))
            age_in_months = months.setdefault(month, len(months))
            if not (
                number == 0
                or age <= self.everything > 0
                or (is_last_of_day and age <= self.daily)
                or (is_last_of_month and age_in_months <= self.monthly > 0)
            ):
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
    spans = [int(match[1]) * _DAYS[match[2]] for match in matches if match is not None]
    if any(later <= earlier for earlier, later in itertools.pairwise(spans)):
        raise Invalid(f"--keep {text[:80]}: each span must be longer than the one before it")
    everything, daily, monthly = (*spans, 0, 0)[:3]
    return KeepRule(everything, daily, -(-monthly // _DAYS["m"]))

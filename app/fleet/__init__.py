"""The fleet: who holds what, who is there, who lags.

``picture`` what follows from what is stored · ``rollout`` when channels move, and move back · ``intake`` what comes
over the bus, in order, into the store.
"""

from app.fleet.intake import NOTE_SECONDS, Intake, report_of, settle
from app.fleet.picture import Holding, Lag, holding, is_online, lag_of
from app.fleet.rollout import decide

__all__ = [
    "NOTE_SECONDS",
    "Holding",
    "Intake",
    "Lag",
    "decide",
    "holding",
    "is_online",
    "lag_of",
    "report_of",
    "settle",
]

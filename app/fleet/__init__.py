"""The fleet: who holds what, who is there, who lags.

``status`` what follows from what is stored · ``rollout`` when channels move, and move back · ``report_queue`` what
comes over the bus, in order, into the store.
"""

from app.fleet.report_queue import NOTE_SECONDS, ReportQueue, report_of, settle
from app.fleet.rollout import decide
from app.fleet.status import ChannelConvergence, Lag, holding, is_online, lag_of

__all__ = [
    "NOTE_SECONDS",
    "ChannelConvergence",
    "Lag",
    "ReportQueue",
    "decide",
    "holding",
    "is_online",
    "lag_of",
    "report_of",
    "settle",
]

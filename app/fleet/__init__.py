"""The fleet: who holds what, who is there, who lags.

``status`` what follows from what is stored · ``rollout`` when channels move, and move back · ``report_queue`` what
comes over the bus, in order, into the store.
"""

from app.fleet.report_queue import WARN_SECONDS, ReportQueue, report_from_status, wait_until_stored
from app.fleet.rollout import next_step
from app.fleet.status import ChannelConvergence, Lag, channel_convergence, is_online, robot_lag

__all__ = [
    "WARN_SECONDS",
    "ChannelConvergence",
    "Lag",
    "ReportQueue",
    "channel_convergence",
    "is_online",
    "next_step",
    "report_from_status",
    "robot_lag",
    "wait_until_stored",
]

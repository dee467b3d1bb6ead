"""Fleet status, rollouts and robot reports.

Modules: ``status`` online, lag and convergence of robots · ``rollout`` steps of rollouts · ``report_queue`` stores
reports in order · ``overlays`` permanent closures · ``live`` closures for running planners · ``vda5050`` VDA 5050
messages.
"""

from app.fleet.report_queue import WARN_SECONDS, ReportQueue, report_from_status, wait_until_stored
from app.fleet.rollout import next_step
from app.fleet.status import ChannelConvergence, Lag, channel_convergence, count_robots, is_online, robot_lag

__all__ = [
    "WARN_SECONDS",
    "ChannelConvergence",
    "Lag",
    "ReportQueue",
    "channel_convergence",
    "count_robots",
    "is_online",
    "next_step",
    "report_from_status",
    "robot_lag",
    "wait_until_stored",
]

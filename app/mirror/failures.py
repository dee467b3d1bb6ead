"""Which failures concern one environment, and which the whole centre."""

from __future__ import annotations

from app.backends.lead import LeadLostError
from app.errors import (
    Conflict,
    DatabaseDamaged,
    Denied,
    FleetMapError,
    NoRoom,
    NotFound,
    Unauthenticated,
    Unavailable,
    Untrusted,
)
from app.mirror.centre import CentreUnreachable


class NotedFailure:
    """Context that notes an environment's failure and goes on; failures of the whole centre pass.

    goes_on: note also that something is unavailable, such as damaged content at the centre, as long as the centre can
    be reached: so no environment keeps the others from being mirrored.
    """

    def __init__(self, failures: dict[str, str], environment: str, *, goes_on: bool = False) -> None:
        self._failures, self._environment, self._goes_on = failures, environment, goes_on

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> bool:
        is_own = isinstance(error, NotFound | Conflict | Untrusted | Denied) and not isinstance(error, Unauthenticated)
        is_own = is_own or (self._goes_on and isinstance(error, Unavailable) and not _is_general(error))
        if not is_own or not isinstance(error, FleetMapError):
            return False
        self._failures[self._environment] = error.detail
        return True


def _is_general(error: Unavailable) -> bool:
    """Return whether no environment can be mirrored now: no connection, no lead, no disk space."""
    return isinstance(error, CentreUnreachable | LeadLostError | NoRoom | DatabaseDamaged)

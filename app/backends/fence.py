"""Fence: the right to store what some work has made, such as a leader's in its term or a worker's that has a task.

A process may lose its right without noticing, for example because it stood still for seconds. So each transaction of
the work checks the right right before its commit, in the database itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Final, Protocol

from sqlalchemy import Connection

from app.errors import Unavailable

LIMIT_IDLE_TIME: Final = "set_config('idle_in_transaction_session_timeout', '2000', true)"
"""SQL for the check of a shared right: PostgreSQL ends the transaction if its process stands still before the commit.

So it blocks those who wait for the right for no more than 2 s.
"""


class FenceError(Unavailable):
    """The right to store was lost: somebody else may have it."""


class Fence(Protocol):
    """Right to store."""

    def check(self, connection: Connection) -> None:
        """Check within a transaction, right before its commit, that the right goes on. Raises FenceError."""


_fences: ContextVar[tuple[Fence, ...]] = ContextVar("fences", default=())


@contextmanager
def fenced_by(fence: Fence) -> Iterator[None]:
    """Let transactions of this context be committed only if this right, and those around it, go on."""
    token = _fences.set((*_fences.get(), fence))
    try:
        yield
    finally:
        _fences.reset(token)


def check_fences(connection: Connection) -> None:
    """Check a transaction right before its commit; one of a context without fences passes. Raises FenceError."""
    for fence in _fences.get():
        fence.check(connection)

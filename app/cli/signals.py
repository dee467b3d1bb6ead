"""Signals that stop a command."""

from __future__ import annotations

import signal
from _thread import start_new_thread
from collections.abc import Callable


def call_at_stop(stop: Callable[[], None]) -> None:
    """Call ``stop`` in a thread of its own when SIGTERM or SIGINT (Ctrl-C) arrives.

    Not in the signal handler: it interrupts the main thread anywhere, also where that holds a lock that ``stop`` needs,
    such as the lock of a ``threading.Event``, and would wait forever. To start a ``threading.Thread`` takes one, too.
    """
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: start_new_thread(stop, ()))

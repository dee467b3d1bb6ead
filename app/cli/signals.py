"""Signals that stop a command."""

from __future__ import annotations

import signal
from _thread import start_new_thread
from collections.abc import Callable


def call_at_stop(stop: Callable[[], None]) -> None:
    """Call ``stop`` in a thread of its own when SIGTERM or SIGINT (Ctrl-C) arrives.

    A signal's handler interrupts the main thread anywhere, also where it holds a lock that ``stop`` needs, such as that
    of a ``threading.Event``: the process would wait for itself. Starting a ``threading.Thread`` takes a lock, too.
    """
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, lambda *_: start_new_thread(stop, ()))

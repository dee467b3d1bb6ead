"""Progress of the work of a worker process.

The code that does the work reports its steps here; the pool hands them to the process that waits for it. Without one,
as in the command line, reports cost next to nothing.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

INTERVAL_SECONDS: Final = 0.2
"""Minimum time between two reports of the same step."""


@dataclass(frozen=True, slots=True)
class Progress:
    """How far work is. fraction: from 0 to 1. step: what is done now, for people; empty if unknown."""

    fraction: float = 0.0
    step: str = ""


Sink = Callable[[Progress], None]


class _Reporter:
    """Where reports go. start, end: the part of the whole that they are about."""

    def __init__(self) -> None:
        self.sink: Sink | None = None
        self.start, self.end = 0.0, 1.0
        self.last, self.step = 0.0, ""

    def report(self, fraction: float, step: str) -> None:
        now = time.monotonic()
        if self.sink is None or (step == self.step and now - self.last < INTERVAL_SECONDS):
            return
        self.last, self.step = now, step
        self.sink(Progress(self.start + (self.end - self.start) * min(1.0, max(0.0, fraction)), step))


_reporter = _Reporter()


def report(fraction: float, step: str) -> None:
    """Report what is done next, and the fraction of the work (see ``within``) that is done."""
    _reporter.report(fraction, step)


@contextlib.contextmanager
def within(start: float, end: float) -> Iterator[None]:
    """Have reports inside be about a part of the work, from one fraction of it to another."""
    outer = _reporter.start, _reporter.end
    width = outer[1] - outer[0]
    _reporter.start, _reporter.end = outer[0] + width * start, outer[0] + width * end
    try:
        yield
    finally:
        _reporter.start, _reporter.end = outer


@contextlib.contextmanager
def sent_to(sink: Sink) -> Iterator[None]:
    """Send the reports of this process to a function. For one piece of work at a time."""
    _reporter.sink, _reporter.start, _reporter.end = sink, 0.0, 1.0
    _reporter.last, _reporter.step = 0.0, ""
    try:
        yield
    finally:
        _reporter.sink = None

"""Memory that a long-lived process does not need any more: garbage in cycles, and free memory of the C library.

Python looks for cycles among its oldest objects only after as many young ones have survived as are a quarter of them,
and loading layers moves objects there uncounted (``app.store.gc_pause``): so what the database's statements leave
behind could grow for hours. And glibc keeps what a program frees in an arena for each few threads: after some minutes
of uploads and downloads a server with 70 MB in use held another 70 MB to 100 MB that way.
"""

from __future__ import annotations

import ctypes
import gc
from collections.abc import Callable
from functools import cache


@cache
def _trim() -> Callable[[int], int] | None:
    """Return glibc's ``malloc_trim``; None with another C library."""
    function: Callable[[int], int] | None = getattr(ctypes.CDLL(None), "malloc_trim", None)
    return function


def release_free_memory() -> None:
    """Return the free pages of all arenas to the system; takes some milliseconds."""
    trim = _trim()
    if trim is not None:
        trim(0)


class OldGarbage:
    """Collector of the garbage among old objects, for a caller that comes by from time to time."""

    def __init__(self) -> None:
        self._runs = self._count()

    def collect(self) -> bool:
        """Collect, if Python has not since the last call; return whether. All threads wait meanwhile."""
        is_due = self._runs == self._count() and gc.isenabled()
        if is_due:
            gc.collect()
        self._runs = self._count()
        return is_due

    @staticmethod
    def _count() -> int:
        """Return the number of full collections so far."""
        return int(gc.get_stats()[-1]["collections"])

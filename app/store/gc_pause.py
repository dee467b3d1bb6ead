"""Pause of Python's cyclic garbage collector for work that creates very many objects."""

from __future__ import annotations

import gc
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_gc_lock = threading.Lock()
_gc_users = 0
_gc_was_on = False
_is_frozen = False


@contextmanager
def gc_paused() -> Iterator[None]:
    """Pause Python's cyclic garbage collector, for work that creates very many objects and no cycles.

    It would traverse all of them again and again (a whole layer loads two to three times slower with it). At the end
    the objects move to the oldest generation by freezing and unfreezing, which traverses none of them; else the next
    collection of the young generation would take as long as the pause saved. Not so in a process that keeps
    frozen objects, which unfreezing would release.
    """
    global _gc_users, _gc_was_on, _is_frozen  # noqa: PLW0603 - one switch for the interpreter
    with _gc_lock:
        if _gc_users == 0:
            _gc_was_on = gc.isenabled()
            gc.disable()
        _gc_users += 1
    try:
        yield
    finally:
        with _gc_lock:
            _gc_users -= 1
            if _gc_users == 0 and _gc_was_on:
                # Once only: it counts the frozen objects one by one, some milliseconds of each call.
                _is_frozen = _is_frozen or gc.get_freeze_count() > 0
                if not _is_frozen:
                    gc.freeze()
                    gc.unfreeze()
                gc.enable()

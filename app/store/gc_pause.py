"""Python's cycle collector, paused for work that makes very many objects."""

from __future__ import annotations

import gc
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_gc_lock = threading.Lock()
_gc_users = 0
_gc_was_on = False


@contextmanager
def gc_paused() -> Iterator[None]:
    """Without Python's cycle collector, for work that makes very many objects and no cycles.

    It would look at all of them again and again (a whole layer loads two to three times slower with it). At the end
    they are counted among the old objects, or the next collection of the young ones would take as long as it saved;
    freezing and unfreezing does that without a look at any of them.
    """
    global _gc_users, _gc_was_on  # noqa: PLW0603 - one switch for the interpreter
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
                if gc.get_freeze_count() == 0:
                    gc.freeze()
                    gc.unfreeze()
                gc.enable()

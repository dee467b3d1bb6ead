"""What a long-lived process releases: garbage in cycles among old objects, and free pages of the C library."""

from __future__ import annotations

import gc
import subprocess
import sys
import weakref

from app.heap import OldGarbage

FRAGMENTED = """
import re
from pathlib import Path
from app.heap import release_free_memory

def megabytes():
    return int(re.search(r"Anonymous: +([0-9]+)", Path("/proc/self/smaps_rollup").read_text())[1]) / 1024

blocks = [bytes(10_000) for _ in range(5_000)]
kept = blocks[::100]  # free blocks between used ones stay with the C library
del blocks
before = megabytes()
release_free_memory()
print(before - megabytes())
"""


class Knot:
    """An object in a cycle with itself."""

    def __init__(self) -> None:
        self.itself = self


def test_garbage_among_old_objects_is_collected() -> None:
    garbage = OldGarbage()
    gone = weakref.ref(Knot())
    gc.freeze()
    gc.unfreeze()  # as a pause of the collector does at its end
    gc.collect(1)
    assert gone() is not None
    assert garbage.collect()
    assert gone() is None


def test_python_s_own_collection_is_not_repeated() -> None:
    garbage = OldGarbage()
    gc.collect()
    assert not garbage.collect()
    assert garbage.collect()


def test_free_memory_goes_back_to_the_system() -> None:
    done = subprocess.run([sys.executable, "-c", FRAGMENTED], capture_output=True, text=True, check=True)
    assert float(done.stdout) > 30

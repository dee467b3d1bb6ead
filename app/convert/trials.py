"""What trials of derivations have found, by content: in memory, and in a file for the next start.

A line of the file is the SHA-256 of its rest and ``[key, hindrance]`` as JSON; of two lines of a key the later counts.
A damaged line is passed over, so that its trial is made again, and where the disk refuses there is only the memory.
"""

from __future__ import annotations

import contextlib
import hashlib
import threading
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from uuid import uuid4

import orjson

from app.derive import ChainFailure

MAX_TRIALS = 10_000
"""Trials that are remembered; the file is written anew at twice as many lines."""


class Trials:
    """The outcome of trials by key: a Hindrance, or None where all steps work. Thread-safe."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._guard = threading.Lock()
        self._results: dict[str, ChainFailure | None] = {}
        self._lines = 0
        for key, failure in self._read():
            self._set(key, failure)

    def __getitem__(self, key: str) -> ChainFailure | None:
        """KeyError where it was not tried."""
        with self._guard:
            return self._results[key]

    def add(self, key: str, failure: ChainFailure | None, *, lasting: bool) -> None:
        """Remember an outcome. lasting: also for the next start."""
        with self._guard:
            self._set(key, failure)
            if not lasting:
                return
            self._lines += 1
            with contextlib.suppress(OSError):
                if self._lines > 2 * MAX_TRIALS:
                    self._rewrite()
                else:
                    with self._path.open("ab", buffering=0) as file:  # one write: whole lines, whoever else writes
                        file.write(_line(key, failure))

    def _set(self, key: str, failure: ChainFailure | None) -> None:
        self._results.pop(key, None)  # the latest last: the oldest goes first
        self._results[key] = failure
        while len(self._results) > MAX_TRIALS:
            self._results.pop(next(iter(self._results)))

    def _read(self) -> Iterator[tuple[str, ChainFailure | None]]:
        try:
            lines = self._path.read_bytes().splitlines()
        except OSError:
            return
        self._lines = len(lines)
        for line in lines:
            digest, _, text = line.partition(b" ")
            if digest != _digest(text):
                continue
            with contextlib.suppress(TypeError, ValueError):  # of a release that knows other fields
                key, failure = orjson.loads(text)
                yield key, None if failure is None else ChainFailure(**failure)

    def _rewrite(self) -> None:
        temporary = self._path.with_suffix(f".{uuid4().hex}")
        try:
            temporary.write_bytes(b"".join(_line(key, failure) for key, failure in self._results.items()))
            temporary.replace(self._path)
        finally:
            temporary.unlink(missing_ok=True)
        self._lines = len(self._results)


def _line(key: str, failure: ChainFailure | None) -> bytes:
    text = orjson.dumps([key, None if failure is None else asdict(failure)])
    return _digest(text) + b" " + text + b"\n"


def _digest(text: bytes) -> bytes:
    return hashlib.sha256(text).hexdigest().encode()

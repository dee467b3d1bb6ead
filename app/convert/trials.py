"""Cached results of derivation trials, by content: in memory and in a file that survives restarts.

A line of the file is the SHA-256 of its rest and ``[key, failure]`` as JSON; the last line of a key wins. Damaged lines
are skipped, so that their trials run again. If the disk cannot be written, only the memory is used.
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

from app import __version__
from app.convert.recipe import DerivationChain, reduce_chain
from app.derive import ChainFailure
from app.formats import Format
from app.store.values import Version

MAX_TRIALS = 10_000
"""Maximum number of cached trials; the file is compacted at twice as many lines."""


class Trials:
    """Results of trials by key: a ChainFailure, or None if all steps work. Thread-safe."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._guard = threading.Lock()
        self._results: dict[str, ChainFailure | None] = {}
        self._lines = 0
        for key, failure in self._read():
            self._set(key, failure)

    def __getitem__(self, key: str) -> ChainFailure | None:
        """Return the result of a trial. Raises KeyError if it has not run."""
        with self._guard:
            return self._results[key]

    def add(self, key: str, failure: ChainFailure | None, *, lasting: bool) -> None:
        """Cache a result. lasting: also in the file, for the next start."""
        with self._guard:
            self._set(key, failure)
            if not lasting:
                return
            self._lines += 1
            with contextlib.suppress(OSError):
                if self._lines > 2 * MAX_TRIALS:
                    self._rewrite()
                else:
                    with self._path.open("ab", buffering=0) as file:  # one write: lines stay whole
                        file.write(_line(key, failure))

    def _set(self, key: str, failure: ChainFailure | None) -> None:
        self._results.pop(key, None)  # newest last: the oldest is evicted first
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
            with contextlib.suppress(TypeError, ValueError):  # written by a release with other fields
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


def trial_key(version: Version, chain: DerivationChain, fmt: Format | None = None) -> str:
    """Hash the inputs of a trial: a chain's steps and, with ``fmt``, the format whose needs are checked."""
    keys = reduce_chain(chain).keys if fmt is None else chain.keys
    entries = {e.key: e.hash for e in version.parts}
    ingredients = {
        "server": __version__,
        "format": None if fmt is None else [fmt.name, fmt.version],
        "steps": [[s.name, s.version, s.given] for s in chain.steps],
        "parts": [[k.layer, k.level, k.name, entries[k]] for k in keys],
        "datum": version.datum.as_dict() if version.datum else None,
        "levels": [[level.name, level.elevation] for level in version.levels],
    }
    return hashlib.sha256(orjson.dumps(ingredients)).hexdigest()


def is_lasting(chain: DerivationChain) -> bool:
    """Return whether the result of a trial is permanent: not if a step uses a model, which may be added or removed."""
    return not any(dict(step.given).get("model") for step in chain.steps)


def _line(key: str, failure: ChainFailure | None) -> bytes:
    text = orjson.dumps([key, None if failure is None else asdict(failure)])
    return _digest(text) + b" " + text + b"\n"


def _digest(text: bytes) -> bytes:
    return hashlib.sha256(text).hexdigest().encode()

"""Measure derivations on maps that people labelled: one module for each kind of label, one table for all of them.

A label file `NAME.labels.yaml` says what a map shows, and nothing of how it is derived:

    kind: network                      # name of a module of this package
    map: openrmf_building/office/office.building.yaml    # beside the file, or below the folder of maps
    sha256: 83c8…                      # of the map: labels of another file would mean nothing
    labelled: 2026-11-24, by eye       # when and how; labels are not changed afterwards
    …                                  # the kind's own keys: see its module

`judge(case)` of a kind's module derives from the map and returns a `Result`: figures with their bounds, and a picture
with the result drawn over the map.
"""

from __future__ import annotations

import hashlib
import importlib
import pkgutil
import resource
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import yaml
from PIL import Image

SUFFIX = ".labels.yaml"
DATA = Path(__file__).resolve().parents[4] / "shared" / "data"


class BadLabels(Exception):
    """A label file that cannot be used: the message names the file and what to change."""


@dataclass(frozen=True, slots=True)
class Figure:
    """One measured value. at_least, at_most: bounds that a useful result keeps; without either it only informs."""

    name: str
    value: float
    unit: str = ""
    at_least: float | None = None
    at_most: float | None = None

    @property
    def is_kept(self) -> bool:
        """Whether the value is within its bounds; NaN is not."""
        above = self.at_least is None or self.value >= self.at_least
        below = self.at_most is None or self.value <= self.at_most
        return above and below

    @property
    def bound(self) -> str:
        """The bounds as text; empty without any."""
        low = "" if self.at_least is None else f"≥ {self.at_least:g}"
        high = "" if self.at_most is None else f"≤ {self.at_most:g}"
        return " and ".join(part for part in (low, high) if part)


@dataclass(frozen=True, slots=True)
class Case:
    """A label file. roots: folders below which its maps may lie, in order."""

    path: Path
    kind: str
    labels: Mapping[str, Any]
    roots: Sequence[Path]

    @property
    def name(self) -> str:
        """Name of the label file without its suffix."""
        return self.path.name.removesuffix(SUFFIX)

    def file(self, key: str = "map") -> Path:
        """Return the path of a file that the labels name.

        Raises:
            BadLabels: it lies nowhere, or it is another file than the labelled one.
        """
        name = str(self.labels[key])
        path = next((root / name for root in self.roots if (root / name).is_file()), None)
        if path is None:
            raise BadLabels(f"{self.path}: {key} {name} is in none of {', '.join(map(str, self.roots))}")
        sha256 = self.labels.get("sha256" if key == "map" else f"{key}_sha256")
        if sha256 is not None and hashlib.sha256(path.read_bytes()).hexdigest() != sha256:
            raise BadLabels(f"{self.path}: {path} is not the file that was labelled (its SHA-256 differs)")
        return path


@dataclass(frozen=True, slots=True)
class Result:
    """What a kind's `judge` returns. picture: the result over the map, RGB. `judged` fills in the rest."""

    figures: Sequence[Figure]
    picture: Image.Image | None = None
    seconds: float = 0.0
    megabytes: float = 0.0
    case: Case | None = field(default=None, repr=False)

    @property
    def is_kept(self) -> bool:
        """Whether all figures are within their bounds."""
        return all(figure.is_kept for figure in self.figures)


def kinds() -> dict[str, ModuleType]:
    """Modules of this package by the kind of labels that they judge."""
    names = [module.name for module in pkgutil.iter_modules(__path__) if not module.name.startswith("_")]
    return {name: importlib.import_module(f"{__name__}.{name}") for name in sorted(names)}


def cases(folder: Path, data: Path = DATA) -> Iterator[Case]:
    """Yield the label files below a folder, sorted by kind and name.

    Raises:
        BadLabels: a file without a known kind.
    """
    known, out = kinds(), []
    for path in folder.rglob(f"*{SUFFIX}"):
        labels = yaml.safe_load(path.read_text())
        kind = labels.get("kind") if isinstance(labels, dict) else None
        if kind not in known:
            raise BadLabels(f"{path}: kind is {kind!r}; known: {', '.join(known)}")
        out.append(Case(path, kind, labels, (path.parent, folder, data)))
    yield from sorted(out, key=lambda case: (case.kind, case.name))


def judged(case: Case) -> Result:
    """Run a case; measure its seconds of CPU, and by how many megabytes the process's peak grew."""
    before, start = _peak_megabytes(), time.process_time()
    result: Result = kinds()[case.kind].judge(case)
    seconds, megabytes = time.process_time() - start, _peak_megabytes() - before
    return replace(result, seconds=seconds, megabytes=megabytes, case=case)


def _peak_megabytes() -> float:
    scale = 1e6 if sys.platform == "darwin" else 1e3
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / scale

"""Variety: parameters that are not set are drawn from the seed, evenly from ranges of real sites.

Ranges come from maps of real farms and halls and from planting guides; with ``like``, from an environment that is
measured (``_likeness``). A drawn value that does not fit to the rest (a fence, a wide robot, a parameter that is set)
gives way to the end of its range that fits best; a value that is set never does.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from app.errors import CannotGenerate

FINE_STEP = 0.001
"""Step of a measured range that is narrower than the usual step."""

Stream = Callable[[str], np.random.Generator]


@dataclass(frozen=True, slots=True)
class Span:
    """Range of a parameter.

    Attributes:
        low, high: both inclusive.
        step: drawn values are multiples of it.
        yields: the end to which a drawn value gives way first; None: it never does.
        helps: other parameters whose problems it may solve, at that end.
        is_free: whether it is drawn only for a site without a fence, which decides it otherwise.
        measured: name of the quantity that ``like`` measures for it.
    """

    low: float
    high: float
    step: float
    yields: Literal["low", "high", "zero"] | None = None
    helps: tuple[str, ...] = ()
    is_free: bool = False
    measured: str = ""

    @property
    def ends(self) -> tuple[float, ...]:
        """The values to which it gives way, in this order."""
        return {
            "low": (self.low, self.high),
            "high": (self.high, self.low),
            "zero": (0.0,),
            None: (),
        }[self.yields]

    def draw(self, chance: float) -> float:
        """Return a value for a number from 0 to 1: a whole number if the step is one."""
        steps = round((self.high - self.low) / self.step)
        value = self.low + self.step * min(int(chance * (steps + 1)), steps)
        return round(value) if self.step >= 1 and float(self.step).is_integer() else round(value, 6) + 0.0


def drawn(
    low: float,
    high: float,
    doc: str,
    *,
    step: float,
    minimum: float,
    maximum: float,
    unit: str = "",
    fence: str = "",
    yields: Literal["low", "high", "zero"] | None = None,
    helps: tuple[str, ...] = (),
    measured: str = "",
) -> Any:
    """Declare a parameter that is drawn from the seed unless it is set: None until ``draw`` has filled it in.

    fence: what decides it if the environment has a fence. Others: see ``Span``; minimum, maximum: bounds if it is set.
    """
    default = f"{fence}, else " if fence else ""
    text = f"{doc}; default: {default}from the seed, {low:g} to {high:g}"
    span = Span(low, high, step, yields, helps, bool(fence), measured)
    members = {"doc": text, "minimum": minimum, "maximum": maximum, "unit": unit, "span": span}
    return dataclasses.field(default=None, metadata=members)


def spans(parameters: type[Any]) -> dict[str, Span]:
    """Return the ranges of a generator's parameters, by name."""
    return {f.name: f.metadata["span"] for f in dataclasses.fields(parameters) if "span" in f.metadata}


@dataclass(frozen=True, slots=True)
class Draw:
    """Parameters of a generator, with drawn values where none were set.

    ranges: of the drawn parameters. values: what was drawn. why: where the ranges come from. tried: values that gave
    way to an end.
    """

    options: Any
    ranges: Mapping[str, Span]
    values: Mapping[str, float]
    why: str
    tried: frozenset[tuple[str, float]] = frozenset()

    def given_way(self, error: CannotGenerate) -> Draw | None:
        """Return a draw in which one value gives way, so that a site may fit; None if none is left that can."""
        subjects = {problem.where for problem in error.problems}
        for name, span in self.ranges.items():
            ends = span.ends if name in subjects else span.ends[:1] if subjects & set(span.helps) else ()
            for end in ends:
                if self.values[name] == end or (name, end) in self.tried:
                    continue
                value = int(end) if isinstance(self.values[name], int) else end
                options = dataclasses.replace(self.options, **{name: value})
                values = {**self.values, name: value}
                return Draw(options, self.ranges, values, self.why, self.tried | {(name, end)})
        return None


def draw(options: Any, stream: Stream, measured: Mapping[str, tuple[float, float]], *, fenced: bool, why: str) -> Draw:
    """Draw the parameters that are not set.

    Args:
        stream: random stream by name: a parameter has its own, so that setting one does not change the others.
        measured: ranges by the name of the quantity, instead of those of ``drawn``.
        fenced: whether the environment has a fence.
        why: where the ranges come from, for the report.
    """
    ranges = {
        name: span
        for name, span in _ranges(options, measured)
        if getattr(options, name) is None and not (fenced and span.is_free)
    }
    values = {name: span.draw(float(stream(f"parameter {name}").random())) for name, span in ranges.items()}
    return Draw(dataclasses.replace(options, **values) if values else options, ranges, values, why)


def _ranges(options: Any, measured: Mapping[str, tuple[float, float]]) -> Iterator[tuple[str, Span]]:
    """Yield the ranges of the parameters, measured ones within the bounds of each."""
    bounds = {f.name: f.metadata for f in dataclasses.fields(options)}
    for name, span in spans(type(options)).items():
        like = measured.get(span.measured or name)
        if like is None:
            yield name, span
            continue
        low, high = (min(max(v, bounds[name]["minimum"]), bounds[name]["maximum"]) for v in like)
        step = span.step if high - low >= span.step or float(span.step).is_integer() else FINE_STEP
        low, high = (round(v / step) * step for v in (low, high))
        yield name, dataclasses.replace(span, low=round(low, 6), high=round(max(low, high), 6), step=step)

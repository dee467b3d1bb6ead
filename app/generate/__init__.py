"""Generators: layers created from parameters and a seed, for sites that are not mapped yet or do not exist.

A generator is one module with one function under ``@generates``; its parameters are a frozen dataclass. The same seed
and parameters give the same layers on every machine: all randomness comes from ``RandomSource``, and results of
transcendental functions are rounded before they are stored.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from app import parameters, plugins
from app.derive import DerivationNotes
from app.errors import CannotGenerate, Invalid, MissingLayer, NotFound, Problem
from app.generate import _likeness, _variety
from app.model.fences import fences
from app.model.frame import GROUND, Datum
from app.model.layers import Layer, Layers, PartKey, is_empty
from app.model.names import did_you_mean

MAX_SEED = 2**63 - 1
MAX_CELLS = 2**26
"""Default name of a generated grid."""

MAX_OBJECTS = 200_000

DRAWN = "parameters"
"""Subject of the note with the drawn values of parameters."""

LIKE = "like"
"""Name of the parameter that names another environment, of which a generator takes its ranges."""


@dataclass(frozen=True, slots=True)
class RandomSource:
    """Source of all randomness of one generation: streams by name, so that draws of one part do not shift another's."""

    seed: int
    generator: str

    def stream(self, name: str) -> np.random.Generator:
        """Return the stream of this name, from its beginning."""
        digest = hashlib.sha256(f"{self.seed}/{self.generator}/{name}".encode()).digest()
        return np.random.Generator(np.random.PCG64(int.from_bytes(digest[:16], "little")))


Function = Callable[[Layers, Any, RandomSource, DerivationNotes], Layers]
"""Signature (existing parts, parameters, random source, notes) -> new parts. Pure except for the notes.

Existing parts: those of the layers that the generator needs or reads, with datum and levels. Parts of the result
replace those with the same key; a part that is returned unchanged is not stored again.
"""


@dataclass(frozen=True, slots=True)
class Generator:
    """Generator of layers.

    Attributes:
        needs: layers that it works on and may replace.
        changes: optional layers that it works on, of which at least one must exist.
        also: optional layers that it reads (a fence).

    With neither needs nor changes it generates a whole site, which replaces an earlier generated one.
    """

    name: str
    title: str
    gives: frozenset[Layer]
    needs: frozenset[Layer]
    also: frozenset[Layer]
    version: int
    parameters: type[Any]
    function: Function
    changes: frozenset[Layer] = frozenset()

    @property
    def reads(self) -> frozenset[Layer]:
        """All layers that it reads."""
        return self.editable_layers | self.also

    @property
    def editable_layers(self) -> frozenset[Layer]:
        """Layers that it may replace; empty if it generates a whole site."""
        return self.needs | self.changes

    def as_dict(self) -> dict[str, Any]:
        """Return the generator as clients see it."""
        return {
            "id": self.name,
            "title": self.title,
            "gives": sorted(self.gives),
            "needs": sorted(self.needs),
            "changes": sorted(self.changes),
            "version": self.version,
            "parameters": parameters.describe(self.parameters),
        }


_registry = plugins.Registry[Generator](__name__, "generator")


def generates(
    gives: set[Layer],
    *,
    parameters: type[Any],
    needs: frozenset[Layer] | set[Layer] = frozenset(),
    also: frozenset[Layer] | set[Layer] = frozenset(),
    changes: frozenset[Layer] | set[Layer] = frozenset(),
    version: int = 1,
) -> Callable[[Function], Function]:
    """Register a function as a generator: its name is the id, the first line of its docstring the title."""

    def declare(function: Function) -> Function:
        name = function.__name__
        layers = (frozenset(gives), frozenset(needs), frozenset(also))
        values = (plugins.title(function), *layers, version, parameters, function, frozenset(changes))
        _registry.add(name, Generator(name, *values))
        return function

    return declare


def all_generators() -> Mapping[str, Generator]:
    """Return all generators by name, in alphabetical order."""
    return _registry.all()


def get_generator(name: str) -> Generator:
    """Return a generator. Raises NotFound, with the existing names, for an unknown name."""
    generators = all_generators()
    if name not in generators:
        raise NotFound(
            f"unknown generator {name!r:.80}{did_you_mean(name, generators)}; available: {', '.join(generators)}"
        )
    return generators[name]


def check(name: str, seed: int, values: Mapping[str, Any]) -> tuple[Generator, Any]:
    """Return the generator and its parameters, before any work. Raises NotFound, or Invalid with each wrong value."""
    generator = get_generator(name)
    if not 0 <= seed <= MAX_SEED:
        problem = f"must be from 0 to {MAX_SEED}, got {seed}"
        raise Invalid(f"seed: {problem}", [Problem(problem, where="seed")])
    return generator, parameters.parse(generator.parameters, values, f"parameter of {name}")


def run(
    name: str,
    seed: int,
    values: Mapping[str, Any],
    given: Layers,
    notes: DerivationNotes,
    like: Layers | None = None,
) -> Layers:
    """Run a generator: return only new parts, with the datum and the levels of the whole.

    like: the environment that the parameter ``like`` names, of which the ranges are measured.

    Raises NotFound, Invalid, MissingLayer (with the layers that it works on), CannotGenerate.
    """
    maker, options = check(name, seed, values)
    lacking = maker.needs - given.layers
    if lacking:
        raise MissingLayer(
            f"{name} needs {', '.join(sorted(lacking))}, which is missing: upload a map or generate a site"
        )
    if maker.changes and not maker.changes & given.layers:
        raise MissingLayer(
            f"{name} needs {' or '.join(sorted(maker.changes))}, which is missing: upload a map or generate a site"
        )
    generated_layers = _drawn_site(maker, options, RandomSource(seed, name), given, notes, like)
    fresh = {k: p for k, p in generated_layers.parts.items() if given.parts.get(k) is not p and not is_empty(p)}
    if not fresh:
        raise CannotGenerate(f"{name} generated nothing with these parameters: change them")
    unknown = {k.layer for k in fresh} - maker.gives
    if unknown:
        raise ValueError(f"{name} generated {', '.join(sorted(unknown))}, which it does not declare")
    return Layers(fresh, given.datum or generated_layers.datum, generated_layers.levels)


def _drawn_site(
    maker: Generator, options: Any, source: RandomSource, given: Layers, notes: DerivationNotes, like: Layers | None
) -> Layers:
    """Run a generator with drawn values for parameters that are not set, and report them."""
    measured, why = _measured(maker, options, like)
    fenced = bool(_variety.spans(maker.parameters)) and GROUND in fences(given, lambda *_, **__: None)
    draw = _variety.draw(options, source.stream, measured, fenced=fenced, why=why)
    while True:
        trial = DerivationNotes()
        try:
            out = maker.function(given, draw.options, source, trial)
            break
        except CannotGenerate as error:
            other = draw.given_way(error)
            if other is None:
                raise  # what is wrong when every drawn value has given way is about values that were set
            draw = other
    if draw.values:
        notes.fill(DRAWN, dict(draw.values), f"{draw.why}; set them to keep them")
    notes.warnings += trial.warnings
    notes.dropped += trial.dropped
    notes.template += trial.template
    return out


def drawn_values(notes: DerivationNotes) -> dict[str, float]:
    """Return the values of parameters that ``run`` drew, by its notes."""
    return next((line.value for line in notes.template if line.subject == DRAWN), {})


def _measured(maker: Generator, options: Any, like: Layers | None) -> tuple[Mapping[str, tuple[float, float]], str]:
    """Return the ranges of the environment that ``like`` names, and where the ranges of all parameters come from."""
    wanted = getattr(options, LIKE, None)
    if wanted is None:
        return {}, "drawn from the seed"
    if like is None:
        problem = "can be read only by a server: store the site in an environment of it"
        raise CannotGenerate(f"{LIKE}: {wanted} {problem}", [Problem(problem, where=LIKE)])
    names = {span.measured or name for name, span in _variety.spans(maker.parameters).items()}
    ranges = _likeness.measure(like, names, wanted)
    listed = ", ".join(f"{name} {low:g} to {high:g}" for name, (low, high) in sorted(ranges.items()))
    return ranges, f"drawn from the seed, within what was measured in {wanted} ({listed})"


def step(
    name: str,
    seed: int,
    values: Mapping[str, Any],
    used: Mapping[PartKey, str],
    datum: Datum | None = None,
    drawn: Mapping[str, float] | None = None,
) -> dict[str, Any]:
    """Return the provenance of a generation: enough to repeat it.

    used: hashes of the parts that it read. datum: the one that it created. drawn: values of parameters that were not
    set (``drawn_values``).
    """
    generator, options = check(name, seed, values)
    defaults = {p["name"]: p["default"] for p in parameters.describe(generator.parameters)}
    members: dict[str, Any] = {"step": name, "seed": seed, "version": generator.version}
    members["parameters"] = {**defaults, **parameters.canonical(options)}
    if drawn:
        members["drawn"] = dict(drawn)
    if datum is not None:
        members["datum"] = datum.as_dict()
    if used:
        members["given"] = [
            {"layer": k.layer, "level": k.level, "name": k.name, "hash": digest} for k, digest in sorted(used.items())
        ]
    return members

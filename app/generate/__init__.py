"""Generators: layers made up from parameters and a seed, for sites that are not mapped yet or do not exist.

A generator is one module with one function under ``@generates``; its parameters are a frozen dataclass. The same seed
and parameters give the same layers on every machine: all chance comes from ``RandomSource``, and what went through a
transcendental function is rounded before it is kept.
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
from app.model.frame import Datum
from app.model.layers import Layer, Layers, PartKey, is_empty
from app.model.names import did_you_mean

MAX_SEED = 2**63 - 1
MAX_CELLS = 2**26
"""Of a grid that is made up."""

MAX_OBJECTS = 200_000


@dataclass(frozen=True, slots=True)
class RandomSource:
    """Where all chance of one generation comes from: streams by name, so that one part's draws shift no other's."""

    seed: int
    generator: str

    def stream(self, name: str) -> np.random.Generator:
        """The stream of this name, from its beginning."""
        digest = hashlib.sha256(f"{self.seed}/{self.generator}/{name}".encode()).digest()
        return np.random.Generator(np.random.PCG64(int.from_bytes(digest[:16], "little")))


Function = Callable[[Layers, Any, RandomSource, DerivationNotes], Layers]
"""(what is there, parameters, chance, notes) -> the new parts. Pure but for the notes.

What is there: the parts of the layers that it needs or looks at, with datum and levels. Parts of the result take the
place of those with the same key; one that is passed on as it was given is left alone.
"""


@dataclass(frozen=True, slots=True)
class Generator:
    """One way to make layers up. needs: layers that it works on and may replace. changes: layers that it works on where
    they are there, one of them at least. also: those that it looks at where they are there (a fence). With neither
    needs nor changes it makes a whole site, and takes the place of an earlier made-up one."""

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
        """All layers that it looks at."""
        return self.editable_layers | self.also

    @property
    def editable_layers(self) -> frozenset[Layer]:
        """Layers that it may replace; empty where it makes a whole site."""
        return self.needs | self.changes

    def as_dict(self) -> dict[str, Any]:
        """The generator as clients see it."""
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
    """Declare a function as a generator; its name is its id, its docstring's first line its title."""

    def declare(function: Function) -> Function:
        name = function.__name__
        layers = (frozenset(gives), frozenset(needs), frozenset(also))
        values = (plugins.title(function), *layers, version, parameters, function, frozenset(changes))
        _registry.add(name, Generator(name, *values))
        return function

    return declare


def all_generators() -> Mapping[str, Generator]:
    """Every generator by name, in alphabetical order."""
    return _registry.all()


def get_generator(name: str) -> Generator:
    """NotFound, with the known ones, for a name that is none."""
    generators = all_generators()
    if name not in generators:
        raise NotFound(
            f"there is no generator {name!r}{did_you_mean(name, generators)}; known ones: {', '.join(generators)}"
        )
    return generators[name]


def check(name: str, seed: int, values: Mapping[str, Any]) -> tuple[Generator, Any]:
    """The generator and its parameters, before any work. NotFound, or Invalid with each wrong value."""
    generator = get_generator(name)
    if not 0 <= seed <= MAX_SEED:
        problem = f"must be from 0 to {MAX_SEED}, got {seed}"
        raise Invalid(f"seed: {problem}", [Problem(problem, where="seed")])
    return generator, parameters.parse(generator.parameters, values, f"parameter of {name}")


def run(name: str, seed: int, values: Mapping[str, Any], given: Layers, notes: DerivationNotes) -> Layers:
    """What the generator makes: only new parts, with the datum and the levels of the whole.

    Raises NotFound, Invalid, MissingLayer (with what it works on), CannotGenerate.
    """
    maker, options = check(name, seed, values)
    lacking = maker.needs - given.layers
    if lacking:
        raise MissingLayer(
            f"{name} works on {', '.join(sorted(lacking))}, and there is none: upload a map or generate one first"
        )
    if maker.changes and not maker.changes & given.layers:
        raise MissingLayer(
            f"{name} works on {' or '.join(sorted(maker.changes))}, and there is none: upload a map or generate one "
            "first"
        )
    generated_layers = maker.function(given, options, RandomSource(seed, name), notes)
    fresh = {k: p for k, p in generated_layers.parts.items() if given.parts.get(k) is not p and not is_empty(p)}
    if not fresh:
        raise CannotGenerate(f"{name} made nothing with these parameters")
    unknown = {k.layer for k in fresh} - maker.gives
    if unknown:
        raise ValueError(f"{name} made {', '.join(sorted(unknown))} and does not declare it")
    return Layers(fresh, given.datum or generated_layers.datum, generated_layers.levels)


def step(
    name: str, seed: int, values: Mapping[str, Any], used: Mapping[PartKey, str], datum: Datum | None = None
) -> dict[str, Any]:
    """How it was made, for provenance: enough to make it again.

    used: hashes of the parts that it was given. datum: the one that it made up.
    """
    generator, options = check(name, seed, values)
    defaults = {p["name"]: p["default"] for p in parameters.describe(generator.parameters)}
    members: dict[str, Any] = {"step": name, "seed": seed, "version": generator.version}
    members["parameters"] = {**defaults, **parameters.canonical(options)}
    if datum is not None:
        members["datum"] = datum.as_dict()
    if used:
        members["given"] = [
            {"layer": k.layer, "level": k.level, "name": k.name, "hash": digest} for k, digest in sorted(used.items())
        ]
    return members

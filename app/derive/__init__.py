"""Derivations: pure functions from layers to a layer, and the planner that chains them.

A derivation is one module with one function under ``@derives``; its parameters are a frozen dataclass. ``plan`` finds
the cheapest chain from the layers that are stored to one that a format needs, prefers stored layers, ends on cycles,
and when stuck says what to supply.
"""

from __future__ import annotations

import heapq
import importlib
import pkgutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from app.model.layers import Layer, Layers

Function = Callable[[Layers, Any], Layers]


@dataclass(frozen=True, slots=True)
class Derivation:
    """One step. gives: the layer it makes. needs: the layers it reads. cost: relative effort and loss, above 0."""

    name: str
    title: str
    gives: Layer
    needs: frozenset[Layer]
    cost: float
    version: int
    parameters: type[Any]
    function: Function


@dataclass(frozen=True, slots=True)
class Step:
    """A derivation as it stands in a plan."""

    name: str
    gives: Layer
    needs: tuple[Layer, ...]
    version: int


@dataclass(frozen=True, slots=True)
class Plan:
    """How to come from stored layers to the wanted ones: steps in order; empty where everything is stored."""

    steps: tuple[Step, ...]
    cost: float


_registry: dict[str, Derivation] = {}


def derives(
    gives: Layer, needs: set[Layer], *, parameters: type[Any], cost: float, version: int = 1
) -> Callable[[Function], Function]:
    """Declare a function as a derivation; its name is its id, its docstring's first line its title."""

    def declare(function: Function) -> Function:
        name = function.__name__
        if name in _registry:
            raise ValueError(f"derivation {name} is declared twice")
        title = (function.__doc__ or name).strip().splitlines()[0]
        _registry[name] = Derivation(name, title, gives, frozenset(needs), cost, version, parameters, function)
        return function

    return declare


@cache
def _discover() -> None:
    for module in sorted(m.name for m in pkgutil.iter_modules(__path__)):
        if not module.startswith("_"):
            importlib.import_module(f"{__name__}.{module}")


def all_derivations() -> Mapping[str, Derivation]:
    """Every derivation by name, in alphabetical order."""
    _discover()
    return dict(sorted(_registry.items()))


def plan(available: frozenset[Layer], wanted: frozenset[Layer]) -> Plan | None:
    """The cheapest chain that adds what is wanted to what is available (Dijkstra over sets of layers), or None."""
    queue: list[tuple[float, int, frozenset[Layer], tuple[Step, ...]]] = [(0.0, 0, available, ())]
    done: set[frozenset[Layer]] = set()
    pushed = 0
    while queue:
        cost, _, have, steps = heapq.heappop(queue)
        if wanted <= have:
            return Plan(steps, cost)
        if have in done:
            continue
        done.add(have)
        for d in all_derivations().values():
            if d.needs <= have and d.gives not in have:
                pushed += 1
                step = Step(d.name, d.gives, tuple(sorted(d.needs)), d.version)
                heapq.heappush(queue, (cost + d.cost, pushed, have | {d.gives}, (*steps, step)))
    return None


def run(steps: tuple[Step, ...], layers: Layers, values: Mapping[str, Any] | None = None) -> Layers:
    """Carry out a plan: the layers with what each step adds. values: parameters by derivation name."""
    for step in steps:
        known = all_derivations()[step.name]
        made = known.function(layers, (values or {}).get(step.name) or known.parameters())
        layers = Layers({**layers.parts, **made.parts}, layers.datum or made.datum, layers.levels)
    return layers

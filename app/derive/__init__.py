"""Derivations: pure functions from layers to a layer, and the planner that chains them.

A derivation is one module with one function under ``@derives``; its parameters are a frozen dataclass. ``plan`` finds
the cheapest chain from the layers that are stored to one that a format needs, prefers stored layers, ends on cycles,
and when stuck says what to supply.
"""

from __future__ import annotations

import contextlib
import dataclasses
import heapq
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from app import parameters, plugins
from app.errors import Ambiguous, CannotConvert, CannotDerive, MissingLayer, Problem
from app.model.features import Features
from app.model.grid import FREE, UNKNOWN, OccupancyGrid
from app.model.layers import Layer, Layers, Part
from app.model.notes import Notes
from app.model.voxels import VoxelMap


@dataclass(slots=True)
class DerivationNotes(Notes):
    """Where a step says what was doubtful, what it left out, and what it made up (it goes into the map's report)."""


P = TypeVar("P")
T = TypeVar("T")

Function = Callable[[Layers, Any, DerivationNotes], Layers]
"""(stored and derived layers, parameters, notes) -> the new parts. Pure but for the notes."""

Trial = Callable[[Layers, Any], None]
"""(layers, parameters): raises what the function would raise on them, in a fraction of its time."""


@dataclass(frozen=True, slots=True)
class Derivation:
    """One step. gives: the layer it makes. needs: the layers it reads. also: stored layers that it uses a part of where
    they are there, and does without where they are not. cost: relative effort and loss, above 0.

    part_names: names of the parts that it makes, where these are others than the usual one. Such a step is no way to
    the layer; it is taken where a part of such a name is asked for and not stored, and is given the layer's usual part,
    whose frame it may take. is_terminal: what it makes is good for a map and not for deriving more (a grid that knows
    of no obstacle). trial: says whether it works, where that is cheaper to tell than to do.
    """

    name: str
    title: str
    gives: Layer
    needs: frozenset[Layer]
    cost: float
    version: int
    parameters: type[Any]
    function: Function
    also: frozenset[Layer] = frozenset()
    part_names: frozenset[str] = frozenset()
    is_terminal: bool = False
    trial: Trial | None = None

    def step(self) -> Step:
        """The derivation as it stands in a plan, with its default parameters."""
        return Step(self.name, self.gives, tuple(sorted(self.needs)), self.version, (), tuple(sorted(self.also)))


@dataclass(frozen=True, slots=True)
class Step:
    """A derivation as it stands in a plan. given: its parameters that differ from the defaults, sorted by name."""

    name: str
    gives: Layer
    needs: tuple[Layer, ...]
    version: int
    given: tuple[tuple[str, Any], ...] = ()
    also: tuple[Layer, ...] = ()

    @property
    def reads(self) -> frozenset[Layer]:
        """All layers that it looks at."""
        return frozenset((*self.needs, *self.also))

    def as_dict(self) -> dict[str, Any]:
        """The step as JSON, with all its parameters."""
        defaults = {p["name"]: p["default"] for p in parameters.describe(all_derivations()[self.name].parameters)}
        values = {**defaults, **dict(self.given)}
        looked = {"also": list(self.also)} if self.also else {}
        return {"step": self.name, "from": list(self.needs), **looked, "to": self.gives, "parameters": values}


@dataclass(frozen=True, slots=True)
class Plan:
    """How to come from stored layers to the wanted ones: steps in order; empty where everything is stored."""

    steps: tuple[Step, ...]
    cost: float


_registry = plugins.Registry[Derivation](__name__, "derivation", "fleetmap.derivations")


def derives(
    gives: Layer,
    needs: set[Layer],
    *,
    parameters: type[Any],
    cost: float,
    version: int = 1,
    also: frozenset[Layer] = frozenset(),
    makes: frozenset[str] = frozenset(),
    last: bool = False,
    trial: Trial | None = None,
) -> Callable[[Function], Function]:
    """Declare a function as a derivation; its name is its id, its docstring's first line its title."""

    def declare(function: Function) -> Function:
        name = function.__name__
        fields = (
            plugins.title(function),
            gives,
            frozenset(needs),
            cost,
            version,
            parameters,
            function,
            also,
            makes,
            last,
            trial,
        )
        _registry.add(name, Derivation(name, *fields))
        return function

    return declare


def all_derivations() -> Mapping[str, Derivation]:
    """Every derivation by name, in alphabetical order."""
    return _registry.all()


def ends_in_display_step(steps: Iterable[Mapping[str, Any]]) -> bool:
    """Whether one of these steps, as provenance tells them, is the last one that a map may take (see ``last``)."""
    derivations = all_derivations()
    return any(
        name in derivations and derivations[name].is_terminal for name in (str(step.get("step")) for step in steps)
    )


def plan(
    available: frozenset[Layer],
    required: frozenset[Layer],
    without: frozenset[str] = frozenset(),
    dead: frozenset[Layer] = frozenset(),
) -> Plan | None:
    """The cheapest chain that adds what is wanted to what is available (Dijkstra over sets of layers), or None.

    without: names of derivations that must not be part of it. dead: available layers that nothing is derived from.
    """
    queue: list[tuple[float, int, frozenset[Layer], tuple[Step, ...]]] = [(0.0, 0, available, ())]
    done: set[frozenset[Layer]] = set()
    pushed = 0
    while queue:
        cost, _, have, steps = heapq.heappop(queue)
        if required <= have:
            return Plan(steps, cost)
        if have in done:
            continue
        done.add(have)
        blocked = dead | {step.gives for step in steps if all_derivations()[step.name].is_terminal}
        for d in all_derivations().values():
            if d.needs & blocked:
                continue
            if d.needs <= have and d.gives not in have and d.name not in without and not d.part_names:
                pushed += 1
                heapq.heappush(queue, (cost + d.cost, pushed, have | {d.gives}, (*steps, d.step())))
    return None


@dataclass(frozen=True, slots=True)
class ChainFailure:
    """Why a chain does not work on what is stored. step: the one to blame, empty where none is. choose: it would, with
    one of several things named."""

    step: str
    reason: str
    choose: bool = False

    @classmethod
    def from_error(cls, error: CannotDerive) -> ChainFailure:
        """The failure that an error reports."""
        return cls(error.step, error.detail, error.choose)

    def as_error(self) -> CannotDerive:
        """The error that reports this failure."""
        return CannotDerive(self.reason, step=self.step, choose=self.choose)


def no_chain_error(error: MissingLayer, failed: Sequence[ChainFailure]) -> CannotConvert:
    """Nothing is left to try: what to name or to supply, and why the derivations that were tried found nothing."""
    unnamed = next((one for one in failed if one.choose), None)
    if unnamed is not None:
        return Ambiguous(unnamed.reason)
    if not failed:
        return error
    reasons = "; ".join(one.reason for one in failed)
    return MissingLayer(f"{error.detail}; what is stored does not do: {reasons}", error.problems)


def first_working(
    make_plan: Callable[[frozenset[str]], P],
    attempt: Callable[[P, Sequence[ChainFailure]], T],
    exhausted: Callable[[MissingLayer, Sequence[ChainFailure]], CannotConvert] = no_chain_error,
) -> T:
    """What the cheapest plan gives whose derivations find something to use in the content.

    make_plan: the cheapest plan without these derivations; MissingLayer if none is left, which ``exhausted`` turns into
    the error to raise. attempt: carry out a plan, given the failures so far; CannotDerive names the step that failed.
    All else that these raise is passed on.
    """
    failed: list[ChainFailure] = []
    while True:
        try:
            planned = make_plan(frozenset(one.step for one in failed))
        except MissingLayer as error:
            raise exhausted(error, failed) from error
        try:
            return attempt(planned, failed)
        except CannotDerive as error:
            if not error.step:
                raise
            failed.append(ChainFailure.from_error(error))


def parameter_names(name: str) -> frozenset[str]:
    """The names of a derivation's parameters."""
    return frozenset(f.name for f in dataclasses.fields(all_derivations()[name].parameters))


def with_parameters(steps: Iterable[Step], values: Mapping[str, Any]) -> tuple[Step, ...]:
    """The steps, each with those of the values that it knows. Invalid names what is wrong with one."""
    out = []
    for step in steps:
        step_values = {name: value for name, value in values.items() if name in parameter_names(step.name)}
        chosen = parameters.parse(all_derivations()[step.name].parameters, step_values, f"parameter of {step.name}")
        out.append(replace(step, given=tuple(parameters.canonical(chosen).items())))
    return tuple(out)


def _is_empty_result(part: Part) -> bool:
    """Whether a derived part is no information: no items, no voxels, or all cells unknown or free alike."""
    if isinstance(part, OccupancyGrid):
        first = part.cells[0, 0]
        return bool(first in (FREE, UNKNOWN) and (part.cells == first).all())
    return isinstance(part, Features | VoxelMap) and not len(part)


def run(steps: Iterable[Step], layers: Layers, notes: DerivationNotes | None = None) -> Layers:
    """Carry out a plan: the layers with what each step adds. CannotDerive names the step that found nothing to use."""
    notes = notes or DerivationNotes()
    for step in steps:
        derivation = all_derivations()[step.name]
        with _as_derivation_error(step):
            derived_layers = derivation.function(layers, derivation.parameters(**dict(step.given)), notes)
        if (
            not derivation.part_names
            and not derivation.is_terminal
            and all(map(_is_empty_result, derived_layers.parts_of(step.gives).values()))
        ):
            needs = " and ".join(step.needs)
            reason = f"{step.name} finds nothing in the stored {needs} to make {step.gives} of: supply {step.gives}"
            raise CannotDerive(f"{reason}, or {needs} with more in it", [Problem(reason)], step=step.name)
        layers = Layers({**layers.parts, **derived_layers.parts}, layers.datum or derived_layers.datum, layers.levels)
    return layers


def try_steps(steps: Sequence[Step], layers: Layers) -> None:
    """Raise what ``run`` would raise; cheaper where the last step has a trial."""
    last = all_derivations()[steps[-1].name]
    if last.trial is None:
        run(steps, layers)
        return
    layers = run(steps[:-1], layers)
    with _as_derivation_error(steps[-1]):
        last.trial(layers, last.parameters(**dict(steps[-1].given)))


@contextlib.contextmanager
def _as_derivation_error(step: Step) -> Iterator[None]:
    """CannotDerive instead of CannotConvert: the step is to blame."""
    try:
        yield
    except CannotConvert as error:
        choose = isinstance(error, Ambiguous)
        raise CannotDerive(error.detail, error.problems, step=step.name, choose=choose) from error

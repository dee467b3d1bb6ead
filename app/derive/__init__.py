"""Derivations: pure functions from layers to a layer, and the planner that chains them.

A derivation is one module with one function under ``@derives``; its parameters are a frozen dataclass. ``plan`` finds
the cheapest chain from the stored layers to a layer that a format needs. It prefers stored layers, stops at cycles, and
if there is no chain, the error names the layer to supply.
"""

from __future__ import annotations

import contextlib
import dataclasses
import heapq
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from app import parameters, plugins, progress
from app.errors import Ambiguous, CannotConvert, CannotDerive, MissingLayer, Problem
from app.model.features import Features
from app.model.grid import FREE, UNKNOWN, OccupancyGrid
from app.model.layers import Layer, Layers, Part
from app.model.notes import Notes
from app.model.voxels import VoxelMap


@dataclass(slots=True)
class DerivationNotes(Notes):
    """Notes of a step for the map's report: warnings, dropped data and filled-in values."""


P = TypeVar("P")
T = TypeVar("T")

Function = Callable[[Layers, Any, DerivationNotes], Layers]
"""Signature (layers, parameters, notes) -> new parts; the layers are stored or derived. Pure except for the notes."""

Trial = Callable[[Layers, Any], None]
"""Signature (layers, parameters): raises the errors that the function would raise, in a fraction of its time."""


@dataclass(frozen=True, slots=True)
class Derivation:
    """Derivation of one layer from others.

    Attributes:
        gives: layer that it creates.
        needs: layers that it reads.
        also: stored layers of which it uses a part if present; they are optional.
        cost: relative effort and loss, above 0.
        part_names: names of the parts that it creates, if they differ from the layer's default name. Such a derivation
            does not provide the layer: it runs only if a part of such a name is requested and not stored, and it
            receives the layer's default part, whose frame it may use.
        is_terminal: whether the result is good for a map but not as input of other derivations (a grid without
            obstacles).
        trial: cheap check whether the derivation works on given layers.
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
        """Return this derivation as a step of a plan, with its default parameters."""
        return Step(self.name, self.gives, tuple(sorted(self.needs)), self.version, (), tuple(sorted(self.also)))


@dataclass(frozen=True, slots=True)
class Step:
    """Step of a plan: a derivation with its parameters. given: parameters that differ from the defaults, sorted by
    name."""

    name: str
    gives: Layer
    needs: tuple[Layer, ...]
    version: int
    given: tuple[tuple[str, Any], ...] = ()
    also: tuple[Layer, ...] = ()

    @property
    def reads(self) -> frozenset[Layer]:
        """All layers that the step reads."""
        return frozenset((*self.needs, *self.also))

    def as_dict(self) -> dict[str, Any]:
        """Return the step as JSON, with all its parameters."""
        defaults = {p["name"]: p["default"] for p in parameters.describe(all_derivations()[self.name].parameters)}
        values = {**defaults, **dict(self.given)}
        looked = {"also": list(self.also)} if self.also else {}
        return {"step": self.name, "from": list(self.needs), **looked, "to": self.gives, "parameters": values}


@dataclass(frozen=True, slots=True)
class Plan:
    """Chain from stored layers to the required ones: steps in order; empty if everything is stored."""

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
    """Register a function as a derivation: its name is the id, the first line of its docstring the title."""

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
    """Return all derivations by name, in alphabetical order."""
    return _registry.all()


def is_display_only(information: str, steps: Iterable[Mapping[str, Any]]) -> bool:
    """Return whether a part with this provenance was derived for display only (``is_terminal``), so is no evidence.

    A measured grid that was merged into such a one keeps its steps.
    """
    derivations = all_derivations()
    return information == "derived" and any(
        name in derivations and derivations[name].is_terminal for name in (str(step.get("step")) for step in steps)
    )


def plan(
    available: frozenset[Layer],
    required: frozenset[Layer],
    without: frozenset[str] = frozenset(),
    dead: frozenset[Layer] = frozenset(),
) -> Plan | None:
    """Find the cheapest chain from available to required layers (Dijkstra over sets of layers), or None.

    without: names of derivations to exclude. dead: available layers that no derivation may use.
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
    """Reason why a chain does not work on the stored layers.

    Attributes:
        step: derivation that failed; empty if none did.
        choose: whether the chain would work if the request named one of several parts.
    """

    step: str
    reason: str
    choose: bool = False

    @classmethod
    def from_error(cls, error: CannotDerive) -> ChainFailure:
        """Create the failure that an error reports."""
        return cls(error.step, error.detail, error.choose)

    def as_error(self) -> CannotDerive:
        """Return the error that reports this failure."""
        return CannotDerive(self.reason, step=self.step, choose=self.choose)


def no_chain_error(error: MissingLayer, failed: Sequence[ChainFailure]) -> CannotConvert:
    """Return the error for exhausted plans: what to name or to supply, and why each tried derivation failed."""
    unnamed = next((one for one in failed if one.choose), None)
    if unnamed is not None:
        return Ambiguous(unnamed.reason)
    if not failed:
        return error
    reasons = "; ".join(one.reason for one in failed)
    return MissingLayer(f"{error.detail}; the stored layers do not suffice: {reasons}", error.problems)


def first_working(
    make_plan: Callable[[frozenset[str]], P],
    attempt: Callable[[P, Sequence[ChainFailure]], T],
    exhausted: Callable[[MissingLayer, Sequence[ChainFailure]], CannotConvert] = no_chain_error,
) -> T:
    """Carry out the cheapest plan whose derivations all find usable content.

    make_plan: returns the cheapest plan without the given derivations; raises MissingLayer if none is left, which
    ``exhausted`` turns into the error to raise. attempt: carries out a plan, given the failures so far; raises
    CannotDerive with the step that failed. Other errors are passed on.
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
    """Return the parameter names of a derivation."""
    return frozenset(f.name for f in dataclasses.fields(all_derivations()[name].parameters))


def with_parameters(steps: Iterable[Step], values: Mapping[str, Any]) -> tuple[Step, ...]:
    """Return the steps, each with the values that are its parameters. Raises Invalid for an invalid value."""
    out = []
    for step in steps:
        step_values = {name: value for name, value in values.items() if name in parameter_names(step.name)}
        chosen = parameters.parse(all_derivations()[step.name].parameters, step_values, f"parameter of {step.name}")
        out.append(replace(step, given=tuple(parameters.canonical(chosen).items())))
    return tuple(out)


def _is_empty_result(part: Part) -> bool:
    """Return whether a derived part is empty: no items, no voxels, or all cells unknown or all free."""
    if isinstance(part, OccupancyGrid):
        first = part.cells[0, 0]
        return bool(first in (FREE, UNKNOWN) and (part.cells == first).all())
    return isinstance(part, Features | VoxelMap) and not len(part)


def run(steps: Iterable[Step], layers: Layers, notes: DerivationNotes | None = None) -> Layers:
    """Carry out a plan: return the layers with each step's result added.

    Raises CannotDerive with the step that failed if it raises CannotConvert or its result is empty.
    """
    notes = notes or DerivationNotes()
    steps = tuple(steps)
    for step, done in zip(steps, _shares(steps), strict=True):
        derivation = all_derivations()[step.name]
        progress.report(done, step.name)
        with _as_derivation_error(step):
            derived_layers = derivation.function(layers, derivation.parameters(**dict(step.given)), notes)
        if (
            not derivation.part_names
            and not derivation.is_terminal
            and all(map(_is_empty_result, derived_layers.parts_of(step.gives).values()))
        ):
            needs = " and ".join(step.needs)
            reason = f"{step.name} finds nothing in the stored {needs} to derive {step.gives} from: supply {step.gives}"
            raise CannotDerive(f"{reason}, or {needs} with more content", [Problem(reason)], step=step.name)
        layers = Layers({**layers.parts, **derived_layers.parts}, layers.datum or derived_layers.datum, layers.levels)
    return layers


def _shares(steps: Sequence[Step]) -> list[float]:
    """Return the fraction of the whole cost that is spent before each step."""
    costs = [all_derivations()[step.name].cost for step in steps]
    total = sum(costs) or 1.0
    return [sum(costs[:k]) / total for k in range(len(costs))]


def try_steps(steps: Sequence[Step], layers: Layers) -> None:
    """Raise the errors that ``run`` would raise; cheaper if the last step has a trial."""
    last = all_derivations()[steps[-1].name]
    if last.trial is None:
        run(steps, layers)
        return
    layers = run(steps[:-1], layers)
    with _as_derivation_error(steps[-1]):
        last.trial(layers, last.parameters(**dict(steps[-1].given)))


@contextlib.contextmanager
def _as_derivation_error(step: Step) -> Iterator[None]:
    """Turn CannotConvert into CannotDerive, which names the step."""
    try:
        yield
    except CannotConvert as error:
        choose = isinstance(error, Ambiguous)
        raise CannotDerive(error.detail, error.problems, step=step.name, choose=choose) from error

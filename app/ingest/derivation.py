"""A missing layer computed from others and committed: a version whose provenance says how, and from what."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from app import derive, parameters
from app.derive import ChainFailure, DerivationNotes, Step
from app.errors import CannotDerive, Conflict, Invalid, MissingLayer, NotFound, Problem
from app.ingest.prepare import open_store
from app.model.layers import MAP, Layer, Layers, PartKey, is_empty
from app.model.names import did_you_mean
from app.store.changes import Changes, Prepared, Provenance, Replace
from app.store.values import PartEntry, Version, frame_input


@dataclass(frozen=True, slots=True)
class DerivationRequest:
    """What is to be derived. values: parameters by name, of the method and of the steps before it. replace: also what
    a source has told."""

    method: str
    values: Mapping[str, Any]
    replace: bool = False


def check(request: DerivationRequest) -> None:
    """NotFound for an unknown method (with the known ones), Invalid for a parameter that no derivation has."""
    derivations = derive.all_derivations()
    if request.method not in derivations:
        near = did_you_mean(request.method, derivations)
        raise NotFound(f"there is no derivation {request.method!r}{near}; known ones: {', '.join(derivations)}")
    method_values = {n: v for n, v in request.values.items() if n in derive.parameter_names(request.method)}
    parameters.parse(derivations[request.method].parameters, method_values, f"parameter of {request.method}")
    everything = frozenset().union(*(derive.parameter_names(name) for name in derivations))
    for name in request.values:
        if name not in everything:
            accepted = ", ".join(sorted(derive.parameter_names(request.method))) or "none"
            near = did_you_mean(name, derive.parameter_names(request.method))
            problem = f"no such parameter of {request.method}{near}; accepted: {accepted}"
            raise Invalid(f"{name}: {problem}", [Problem(problem, where=f"parameters.{name}")])


def prepare_derivation(
    database_url: str, blob_dir: str, base: Version, request: DerivationRequest
) -> tuple[Prepared, tuple[Problem, ...]]:
    """In a worker: carry out a derivation on a version, with what has to be derived before it.

    Raises MissingLayer (with what is needed), CannotDerive, Conflict (a source has told that layer).
    """
    store = open_store(database_url, blob_dir)
    derivation = derive.all_derivations()[request.method]
    stored = {
        e.key: e for e in base.parts if e.count > 0 and e.key.layer != derivation.gives and not _is_display_only(e)
    }
    existing_parts = {e.key: e for e in base.parts if e.count > 0 and e.key.layer == derivation.gives}
    available: frozenset[Layer] = frozenset({k.layer for k in stored} | ({"location"} if base.datum else set()))

    def plan(without: frozenset[str]) -> tuple[Step, ...]:
        return _steps(derivation, available, without)

    def attempt(
        steps: tuple[Step, ...], _: Sequence[ChainFailure]
    ) -> tuple[tuple[Step, ...], dict[PartKey, PartEntry], Layers, DerivationNotes]:
        """Carry out all steps but the last: the chain, the stored parts that it reads, the layers, the notes."""
        needed = {layer for step in steps for layer in step.reads}
        used = {k: e for k, e in stored.items() if k.layer in needed}
        used |= {
            k: e
            for k, e in existing_parts.items()
            if derivation.gives in needed or (derivation.part_names and k.name == MAP)
        }
        # Not only the layers that are needed: a derivation may look at others where they are there (a fence).
        loaded = store.content.load(base, sorted(used))
        notes = DerivationNotes()
        chain = derive.with_parameters(steps, request.values)
        before = derive.run(chain[:-1], Layers(loaded.parts, base.datum, base.levels), notes)
        return chain, used, before, notes

    # Outside of ``attempt``: where the method itself finds nothing, no other way to it is looked for.
    chain, used, before, notes = derive.first_working(plan, attempt, _no_chain_error)
    derived_layers = derive.run(chain[-1:], before, notes)
    _check_values(request, chain)
    fresh = {
        k: p for k, p in derived_layers.parts.items() if k.layer == derivation.gives and before.parts.get(k) is not p
    }
    fresh = {k: p for k, p in fresh.items() if not is_empty(p)}
    if not fresh:
        raise CannotDerive(f"{request.method} made nothing of what is stored", step=request.method)
    _check_free(request, fresh.keys(), existing_parts)
    provenance = Provenance(
        "derived",
        None,
        tuple(sorted({s for e in used.values() for s in e.provenance.sources})),
        None,
        tuple(step.as_dict() for step in chain),
        tuple(dict.fromkeys(text for k in sorted(used) for text in used[k].provenance.attribution)),
        (*(input_line(e) for k, e in sorted(used.items())), frame_input(base.datum, base.levels)),
    )
    operations = tuple(Replace(key, part, provenance) for key, part in sorted(fresh.items()))
    return store.versions.prepare(base, Changes(operations)), notes.as_warnings()


def _is_display_only(entry: PartEntry) -> bool:
    """Whether a part was made for people to look at, so that it is no evidence."""
    return not entry.provenance.is_edited and derive.ends_in_display_step(entry.provenance.steps)


def _steps(derivation: derive.Derivation, available: frozenset[Layer], without: frozenset[str]) -> tuple[Step, ...]:
    """The cheapest chain that ends in a derivation; MissingLayer if there is none."""
    before = derive.plan(available, derivation.needs, without | {derivation.name})
    if before is None:
        lacking = ", ".join(sorted(derivation.needs - available))
        raise MissingLayer(f"{derivation.name} needs {lacking}, and the environment has none: upload a map that has")
    return (*before.steps, derivation.step())


def _no_chain_error(error: MissingLayer, failed: Sequence[ChainFailure]) -> MissingLayer:
    tried = f"; what is stored does not do: {'; '.join(one.reason for one in failed)}" if failed else ""
    return MissingLayer(f"{error.detail}{tried}")


def _check_values(request: DerivationRequest, chain: Sequence[Step]) -> None:
    """Nothing is silently ignored: a parameter of a step that is not on the way is refused."""
    taken = frozenset().union(*(derive.parameter_names(step.name) for step in chain))
    for name in request.values:
        if name not in taken:
            problem = f"no step on the way takes it ({', then '.join(step.name for step in chain)})"
            raise Invalid(f"{name}: {problem}", [Problem(problem, where=f"parameters.{name}")])


def _check_free(request: DerivationRequest, keys: Any, existing_parts: Mapping[PartKey, PartEntry]) -> None:
    for key in sorted(keys):
        entry = existing_parts.get(key)
        if entry is None or request.replace:
            continue
        if entry.provenance.information == "derived" and not entry.provenance.is_edited:
            continue
        edited = entry.provenance.is_edited
        why = "was derived and then edited" if edited else f"is {entry.provenance.information}"
        raise Conflict(
            f"the {key.layer} {key.level}/{key.name} {why}: to put a derived one in its place, ask with replace=true"
        )


def input_line(entry: PartEntry) -> dict[str, Any]:
    """A part as one of the inputs in a derived part's provenance."""
    key = entry.key
    return {"layer": key.layer, "level": key.level, "name": key.name, "hash": entry.hash}

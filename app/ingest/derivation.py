"""Derive a missing layer and commit it; the version's provenance records steps and inputs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from app import derive, parameters, progress
from app.derive import ChainFailure, DerivationNotes, Step
from app.errors import CannotDerive, Conflict, Invalid, MissingLayer, NotFound, Problem
from app.ingest.prepare import READ
from app.model.layers import MAP, Layer, Layers, PartKey, is_empty
from app.model.names import did_you_mean
from app.store.changes import Changes, Prepared, Provenance, Replace
from app.store.in_worker import open_store
from app.store.values import PartEntry, Version, frame_input


@dataclass(frozen=True, slots=True)
class DerivationRequest:
    """Request to derive a layer.

    values: parameters by name, of the method and of the steps before it. replace: also replace uploaded content.
    """

    method: str
    values: Mapping[str, Any]
    replace: bool = False


def check(request: DerivationRequest) -> None:
    """Check method and parameter names.

    Raises NotFound for an unknown method (and lists the valid ones), Invalid for a parameter that no derivation has.
    """
    derivations = derive.all_derivations()
    if request.method not in derivations:
        near = did_you_mean(request.method, derivations)
        raise NotFound(f"unknown derivation {request.method!r:.80}{near}; available: {', '.join(derivations)}")
    method_values = {n: v for n, v in request.values.items() if n in derive.parameter_names(request.method)}
    parameters.parse(derivations[request.method].parameters, method_values, f"parameter of {request.method}")
    everything = frozenset().union(*(derive.parameter_names(name) for name in derivations))
    for name in request.values:
        if name not in everything:
            accepted = ", ".join(sorted(derive.parameter_names(request.method))) or "none"
            near = did_you_mean(name, derive.parameter_names(request.method))
            problem = f"unknown parameter of {request.method}{near}; accepted: {accepted}"
            raise Invalid(f"{name}: {problem}", [Problem(problem, where=f"parameters.{name}")])


def prepare_derivation(
    database_url: str, blob_dir: str, base: Version, request: DerivationRequest
) -> tuple[Prepared, tuple[Problem, ...]]:
    """Run a derivation on a version, with the steps that it depends on (in a worker).

    Raises MissingLayer (and names the missing layers), CannotDerive, Conflict (the layer was uploaded or edited).
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
        """Run all steps but the last. Returns the chain, the stored parts it reads, the layers and the notes."""
        needed = {layer for step in steps for layer in step.reads}
        used = {k: e for k, e in stored.items() if k.layer in needed}
        used |= {k: e for k, e in existing_parts.items() if _is_read(k, derivation, needed)}
        # Load more than the required layers: a derivation may use optional ones (a fence).
        progress.report(0.0, "reading")
        loaded = store.content.load(base, sorted(used))
        notes = DerivationNotes()
        chain = derive.with_parameters(steps, request.values)
        with progress.within(READ, 1.0 - READ - _last_share(chain)):
            before = derive.run(chain[:-1], Layers(loaded.parts, base.datum, base.levels), notes)
        return chain, used, before, notes

    # Outside of ``attempt``: if the method itself finds nothing, do not try another chain.
    chain, used, before, notes = derive.first_working(plan, attempt, _no_chain_error)
    with progress.within(1.0 - READ - _last_share(chain), 1.0 - READ):
        derived_layers = derive.run(chain[-1:], before, notes)
    progress.report(1.0 - READ, "storing")
    _check_values(request, chain)
    fresh = {
        k: p for k, p in derived_layers.parts.items() if k.layer == derivation.gives and before.parts.get(k) is not p
    }
    fresh = {k: p for k, p in fresh.items() if not is_empty(p)}
    if not fresh:
        raise CannotDerive(f"{request.method} found nothing to create in the stored layers", step=request.method)
    _check_free(request, fresh.keys(), existing_parts)
    provenance = Provenance(
        "derived",
        None,
        tuple(sorted({s for e in used.values() for s in e.provenance.sources})),
        None,
        tuple(step.as_dict() for step in chain),
        tuple(dict.fromkeys(text for k in sorted(used) for text in used[k].provenance.attribution)),
        _inputs(base, {k: e for k, e in used.items() if k not in fresh}),
    )
    operations = tuple(Replace(key, part, provenance) for key, part in sorted(fresh.items()))
    return store.versions.prepare(base, Changes(operations)), notes.as_warnings()


def _is_read(key: PartKey, derivation: derive.Derivation, needed: set[Layer]) -> bool:
    """Return whether a derivation reads a stored part of the layer that it gives.

    One that has its own layer among the optional ones matches its result with the stored parts of the same names.
    """
    if derivation.gives in derivation.also:
        return key.name in derivation.part_names
    return derivation.gives in needed or bool(derivation.part_names and key.name == MAP)


def _last_share(chain: Sequence[Step]) -> float:
    """Return the fraction of the work that the last step is, beside reading and storing."""
    costs = [derive.all_derivations()[step.name].cost for step in chain]
    return (1.0 - 2 * READ) * costs[-1] / sum(costs)


def _is_display_only(entry: PartEntry) -> bool:
    """Return whether a part was created for display only, so that it is no evidence."""
    provenance = entry.provenance
    return not provenance.is_edited and derive.is_display_only(provenance.information, provenance.steps)


def _steps(derivation: derive.Derivation, available: frozenset[Layer], without: frozenset[str]) -> tuple[Step, ...]:
    """Return the cheapest chain that ends in a derivation. Raises MissingLayer if there is none."""
    before = derive.plan(available, derivation.needs, without | {derivation.name})
    if before is None:
        lacking = ", ".join(sorted(derivation.needs - available))
        raise MissingLayer(f"{derivation.name} needs {lacking}, which the environment lacks: upload a map with it")
    return (*before.steps, derivation.step())


def _no_chain_error(error: MissingLayer, failed: Sequence[ChainFailure]) -> MissingLayer:
    tried = f"; the stored layers do not suffice: {'; '.join(one.reason for one in failed)}" if failed else ""
    return MissingLayer(f"{error.detail}{tried}")


def _check_values(request: DerivationRequest, chain: Sequence[Step]) -> None:
    """Reject parameters of steps that are not in the chain. Raises Invalid."""
    taken = frozenset().union(*(derive.parameter_names(step.name) for step in chain))
    for name in request.values:
        if name not in taken:
            problem = f"no step of the chain has this parameter ({', then '.join(step.name for step in chain)})"
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
            f"the {key.layer} {key.level}/{key.name} {why}: to replace it with a derived one, set replace=true"
        )


def _inputs(base: Version, used: Mapping[PartKey, PartEntry]) -> tuple[dict[str, Any], ...]:
    """Describe the inputs of a derivation. used: without the parts that it replaces, which would make it stale."""
    return (*(input_line(e) for _, e in sorted(used.items())), frame_input(base.datum, base.levels))


def input_line(entry: PartEntry) -> dict[str, Any]:
    """Describe a part as an input in a derived part's provenance."""
    key = entry.key
    return {"layer": key.layer, "level": key.level, "name": key.name, "hash": entry.hash}

"""A missing layer computed from others and committed: a version whose provenance says how, and from what."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from app import derive, parameters
from app.derive import Notes, Step
from app.errors import CannotDerive, Conflict, Invalid, MissingLayer, NotFound, Problem
from app.ingest.prepare import open_store
from app.model.layers import MAP, Layer, Layers, PartKey, is_empty
from app.model.names import did_you_mean
from app.store.changes import Changes, Prepared, Provenance, Replace
from app.store.values import PartEntry, Version, frame_line


@dataclass(frozen=True, slots=True)
class Wish:
    """What is to be derived. values: parameters by name, of the method and of the steps before it. replace: also what
    a source has told."""

    method: str
    values: Mapping[str, Any]
    replace: bool = False


def check(wish: Wish) -> None:
    """NotFound for an unknown method (with the known ones), Invalid for a parameter that no derivation has."""
    known = derive.all_derivations()
    if wish.method not in known:
        near = did_you_mean(wish.method, known)
        raise NotFound(f"there is no derivation {wish.method!r}{near}; known ones: {', '.join(known)}")
    own = {n: v for n, v in wish.values.items() if n in derive.takes(wish.method)}
    parameters.parse(known[wish.method].parameters, own, f"parameter of {wish.method}")
    everything = frozenset().union(*(derive.takes(name) for name in known))
    for name in wish.values:
        if name not in everything:
            accepted = ", ".join(sorted(derive.takes(wish.method))) or "none"
            near = did_you_mean(name, derive.takes(wish.method))
            problem = f"no such parameter of {wish.method}{near}; accepted: {accepted}"
            raise Invalid(f"{name}: {problem}", [Problem(problem, where=f"parameters.{name}")])


def prepare_derivation(
    database_url: str, blob_dir: str, base: Version, wish: Wish
) -> tuple[Prepared, tuple[Problem, ...]]:
    """In a worker: carry out a derivation on a version, with what has to be derived before it.

    Raises MissingLayer (with what is needed), CannotDerive, Conflict (a source has told that layer).
    """
    store = open_store(database_url, blob_dir)
    known = derive.all_derivations()[wish.method]
    stored = {e.key: e for e in base.parts if e.count > 0 and e.key.layer != known.gives and not _is_drawn(e)}
    own = {e.key: e for e in base.parts if e.count > 0 and e.key.layer == known.gives}
    without: frozenset[str] = frozenset({wish.method})
    failed: list[str] = []
    while True:
        steps = _steps(known, frozenset(k.layer for k in stored), base, without, failed)
        needed = {layer for step in steps for layer in step.reads}
        used = {k: e for k, e in stored.items() if k.layer in needed}
        used |= {k: e for k, e in own.items() if known.gives in needed or (known.makes and k.name == MAP)}
        # Not only the layers that are needed: a derivation may look at others where they are there (a fence).
        loaded = store.load(base, sorted(used))
        notes = Notes()
        try:
            layers = Layers(loaded.parts, base.datum, base.levels)
            way = derive.with_values(steps, wish.values)
            before = derive.run(way[:-1], layers, notes)
            made = derive.run(way[-1:], before, notes)
            break
        except CannotDerive as error:
            if error.step == wish.method or not error.step:
                raise
            without |= {error.step}
            failed.append(error.detail)
    _check_values(wish, way)
    fresh = {k: p for k, p in made.parts.items() if k.layer == known.gives and before.parts.get(k) is not p}
    fresh = {k: p for k, p in fresh.items() if not is_empty(p)}
    if not fresh:
        raise CannotDerive(f"{wish.method} made nothing of what is stored", step=wish.method)
    _check_free(wish, fresh.keys(), own)
    provenance = Provenance(
        "derived",
        None,
        tuple(sorted({s for e in used.values() for s in e.provenance.sources})),
        None,
        tuple(step.as_dict() for step in way),
        tuple(dict.fromkeys(text for k in sorted(used) for text in used[k].provenance.attribution)),
        (*(input_line(e) for k, e in sorted(used.items())), frame_line(base.datum, base.levels)),
    )
    operations = tuple(Replace(key, part, provenance) for key, part in sorted(fresh.items()))
    told = [Problem(f"left out: {d['count']} {d['what']}: {d['why']}") for d in notes.dropped]
    told += [Problem(f"filled in: {t['what']} = {t['value']}: {t['why']}") for t in notes.template]
    return store.prepare(base, Changes(operations)), (*notes.warnings, *told)


def _is_drawn(entry: PartEntry) -> bool:
    """Whether a part was made for people to look at, so that it is no evidence."""
    return not entry.provenance.edited and derive.is_drawn(entry.provenance.steps)


def _steps(
    known: derive.Derivation, available: frozenset[Layer], base: Version, without: frozenset[str], failed: Sequence[str]
) -> tuple[Step, ...]:
    have: frozenset[Layer] = available if base.datum is None else available | {"location"}
    before = derive.plan(have, known.needs, without)
    if before is None:
        lacking = ", ".join(sorted(known.needs - have))
        tried = f"; what is stored does not do: {'; '.join(failed)}" if failed else ""
        raise MissingLayer(f"{known.name} needs {lacking}, and the environment has none: upload a map that has{tried}")
    return (*before.steps, known.step())


def _check_values(wish: Wish, way: Sequence[Step]) -> None:
    """Nothing is silently ignored: a parameter of a step that is not on the way is refused."""
    taken = frozenset().union(*(derive.takes(step.name) for step in way))
    for name in wish.values:
        if name not in taken:
            problem = f"no step on the way takes it ({', then '.join(step.name for step in way)})"
            raise Invalid(f"{name}: {problem}", [Problem(problem, where=f"parameters.{name}")])


def _check_free(wish: Wish, keys: Any, own: Mapping[PartKey, PartEntry]) -> None:
    for key in sorted(keys):
        entry = own.get(key)
        if entry is None or wish.replace:
            continue
        if entry.provenance.information == "derived" and not entry.provenance.edited:
            continue
        edited = entry.provenance.edited
        why = "was derived and then edited" if edited else f"is {entry.provenance.information}"
        raise Conflict(
            f"the {key.layer} {key.level}/{key.name} {why}: to put a derived one in its place, ask with replace=true"
        )


def input_line(entry: PartEntry) -> dict[str, Any]:
    """A part as one of the inputs in a derived part's provenance."""
    key = entry.key
    return {"layer": key.layer, "level": key.level, "name": key.name, "hash": entry.hash}

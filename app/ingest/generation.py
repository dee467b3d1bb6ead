"""Generate a site and commit it; the version's provenance records generator, seed and parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from app import generate, progress
from app.derive import DerivationNotes
from app.errors import Conflict, Problem
from app.ingest.prepare import READ
from app.model.layers import Layers, PartKey
from app.store.changes import KEEP, Changes, Drop, Operation, Prepared, Provenance, Replace
from app.store.in_worker import open_store
from app.store.store import Store
from app.store.values import PartEntry, Version


@dataclass(frozen=True, slots=True)
class GenerationRequest:
    """Request to generate a site. replace: also replace uploaded or edited content."""

    generator: str
    seed: int
    values: Mapping[str, Any]
    replace: bool = False

    @property
    def like(self) -> str | None:
        """The environment that the site shall resemble, if the generator has such a parameter."""
        return getattr(generate.check(self.generator, self.seed, self.values)[1], generate.LIKE, None)


def prepare_generation(
    database_url: str, blob_dir: str, base: Version, order: GenerationRequest, like: Version | None = None
) -> tuple[Prepared, tuple[Problem, ...]]:
    """Run a generator on a version (in a worker).

    A generator of whole sites ignores the parts that such a generator created before, and deletes those that the new
    site lacks: the last site's fence does not bind the next one.

    like: version that the site shall resemble.

    Raises MissingLayer, CannotGenerate, Conflict (the part was uploaded or edited).
    """
    store = open_store(database_url, blob_dir)
    generator, _ = generate.check(order.generator, order.seed, order.values)
    used = {e.key: e for e in base.parts if e.count > 0 and e.key.layer in generator.reads}
    if not generator.editable_layers:
        used = {k: e for k, e in used.items() if not _is_generated(e)}
    progress.report(0.0, "reading")
    loaded = store.content.load(base, sorted(used))
    given = Layers(loaded.parts, base.datum, base.levels)
    notes = DerivationNotes()
    progress.report(READ, order.generator)
    with progress.within(READ, 1.0 - READ):
        model = None if like is None else _like_layers(store, like)
        generated_layers = generate.run(order.generator, order.seed, order.values, given, notes, model)
    progress.report(1.0 - READ, "storing")
    existing_parts = {e.key: e for e in base.parts if e.count > 0}
    _check_free(order, generator, generated_layers, existing_parts)
    credit = tuple(dict.fromkeys(text for k in sorted(used) for text in used[k].provenance.attribution))
    made_up = generated_layers.datum if base.datum is None else None
    hashes, drawn = {k: e.hash for k, e in used.items()}, generate.drawn_values(notes)
    how = generate.step(order.generator, order.seed, order.values, hashes, made_up, drawn)
    if like is not None:
        how[generate.LIKE] = {"environment": like.environment, "version": like.number}
    sources = tuple(sorted({s for e in used.values() for s in e.provenance.sources}))
    provenance = Provenance("generated", None, sources, None, (how,), credit)
    operations: list[Operation] = [
        Replace(key, part, provenance) for key, part in sorted(generated_layers.parts.items())
    ]
    if not generator.editable_layers:
        operations += [
            Drop(key)
            for key in sorted(existing_parts)
            if key not in generated_layers.parts and _is_generated(existing_parts[key])
        ]
    datum = generated_layers.datum if generated_layers.datum != base.datum else KEEP
    levels = generated_layers.levels if generated_layers.levels != base.levels else KEEP
    return store.versions.prepare(base, Changes(tuple(operations), datum, levels)), notes.as_warnings()


def _like_layers(store: Store, version: Version) -> Layers:
    """Return what is measured of an environment: its objects, its network and its grid."""
    wanted = [e.key for e in version.parts if e.count > 0 and e.key.layer in ("objects", "topology", "occupancy")]
    loaded = store.content.load(version, sorted(wanted))
    return Layers(loaded.parts, version.datum, version.levels)


def _is_generated(entry: PartEntry) -> bool:
    """Return whether a part was generated and not edited since."""
    return entry.provenance.information == "generated" and not entry.provenance.is_edited


def _check_free(
    order: GenerationRequest,
    generator: generate.Generator,
    generated_layers: Layers,
    existing_parts: Mapping[PartKey, PartEntry],
) -> None:
    """Check that a generator may replace these parts: its inputs and generated parts, others only on request.

    Raises Conflict.
    """
    for key in sorted(generated_layers.parts):
        entry = existing_parts.get(key)
        if entry is None or order.replace or key.layer in generator.editable_layers or _is_generated(entry):
            continue
        edited, kind = entry.provenance.is_edited, entry.provenance.information
        why = f"was {kind} and then edited" if edited else f"is {kind}"
        raise Conflict(
            f"the {key.layer} {key.level}/{key.name} {why}: to replace it with a generated one, set replace=true"
        )

"""Execute a recipe: load the parts, derive missing layers, write the format, and report losses and filled-in values."""

from __future__ import annotations

import mimetypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from typing import Any

from app import derive, formats, parameters, progress
from app.convert import closures as applied_closures
from app.convert import recipe as recipes
from app.convert import site
from app.convert.closures import ClosureLine
from app.convert.recipe import DerivationChain, Recipe, Spread
from app.convert.report import LayerLine, Report, all_credits, merge_reports, unsupported_layers
from app.derive import ChainFailure, Step
from app.errors import CannotConvert, CannotDerive, FleetMapError, MissingLayer, Problem
from app.formats import UNTITLED, Format, NestedMap, WriteContext
from app.model.closures import Closures
from app.model.crossings import crossings
from app.model.features import Features
from app.model.frame import GROUND
from app.model.layers import Layer, Layers, PartKey
from app.model.templates import NO_TEMPLATES, Templates
from app.store.in_worker import open_store
from app.store.values import PartEntry, Provenance, Version, datum_information
from app.syntax import archives
from app.templates import resolve

READ_PART = 0.1
DERIVED_PART = 0.1, 0.7
"""Fraction of the work after which a map is read, and the part of it in which it is derived."""


@dataclass(frozen=True, slots=True)
class WrittenMap:
    """Written map: files (main file first) and report. places: level and name of each file's part, if several."""

    files: dict[str, bytes]
    report: Report
    places: dict[str, tuple[str, str]] = field(default_factory=dict)


def convert_version(
    database_url: str,
    blob_dir: str,
    version: Version,
    name: str,
    values: Mapping[str, Any],
    chain: DerivationChain,
    spread: Spread | None = None,
) -> WrittenMap:
    """Convert a stored version (in a worker). Parts are addressed by content, so concurrent changes have no effect."""
    store = open_store(database_url, blob_dir)
    fmt = formats.get_format(name)
    progress.report(0.0, "reading")
    layers = applied_closures.load(store, version, chain.keys)
    entries = {e.key: e for e in version.parts}
    templates, closures = version.templates, version.closures
    title = version.environment
    return write(
        fmt, layers, values, chain, entries, templates=templates, closures=closures, spread=spread, title=title
    )


def find_chain_failure(
    database_url: str, blob_dir: str, version: Version, chain: DerivationChain
) -> ChainFailure | None:
    """Find the step of a chain that fails on a version's content, or None if all work (in a worker)."""
    layers = applied_closures.load(open_store(database_url, blob_dir), version, chain.keys)
    try:
        derive.try_steps(chain.steps, layers)
    except CannotDerive as error:
        return ChainFailure.from_error(error)
    except FleetMapError as error:
        return ChainFailure("", error.detail)
    return None


def stored_crossings(
    database_url: str, blob_dir: str, version: Version, name: str, keys: Sequence[PartKey]
) -> list[Problem]:
    """Warn about stored edges that cross the version's obstacles (in a worker). keys: the parts of the map."""
    fmt = formats.get_format(name)
    seen = [e.key for e in version.parts if e.key.layer in ("occupancy", "objects") and e.key not in keys]
    layers = applied_closures.load(open_store(database_url, blob_dir), version, [*keys, *seen])
    chosen = fmt.selection.choose(sorted(k for k in keys if k.layer in fmt.layers), formats.write_options(fmt, {}))
    used = replace(layers, parts={k: layers.parts[k] for k in chosen})
    return crossing_edges(fmt, applied_closures.close(fmt, used, version.closures)[0], layers)


def find_missing_content(
    database_url: str, blob_dir: str, version: Version, name: str, chain: DerivationChain
) -> ChainFailure | None:
    """Find content that a format needs and its existing layers lack, or None (in a worker)."""
    fmt = formats.get_format(name)
    layers = applied_closures.load(open_store(database_url, blob_dir), version, chain.keys)
    try:
        derived_layers = derive.run(chain.steps, layers)
    except FleetMapError as error:
        return ChainFailure("", error.detail)
    reason = fmt.needs.missing_content(derived_layers) if fmt.needs.missing_content is not None else None
    return None if reason is None else ChainFailure("", f"{name}: {reason}")


def write(
    fmt: Format,
    layers: Layers,
    values: Mapping[str, Any],
    chain: DerivationChain,
    entries: Mapping[PartKey, PartEntry] | None = None,
    origin: Mapping[PartKey, tuple[tuple[str, ...], str]] | None = None,
    credit: Mapping[PartKey, Sequence[str]] | None = None,
    templates: Templates = NO_TEMPLATES,
    closures: Closures | None = None,
    spread: Spread | None = None,
    around: Layers | None = None,
    title: str = UNTITLED,
) -> WrittenMap:
    """Derive and write a map.

    entries (of a stored version), or origin and credit (of files): provenance, licences and credits of each part.
    templates: for nested maps. closures: to apply. spread: write every derived part. around: further layers whose
    obstacles edges may cross. title: the environment's name, for formats that have a title.
    """
    notes = derive.DerivationNotes()
    options = recipes.writer_options(fmt, values)
    if entries is None:  # from files; stored versions are loaded without marks
        layers = applied_closures.drop_timed_marks(layers)
    source = _Source(layers, chain, entries, origin, credit, templates, closures, around or Layers(), title)
    before, after = DERIVED_PART if chain.steps else (READ_PART, READ_PART)
    if spread is None:
        with progress.within(before, after):
            derived_layers = derive.run(chain.steps, layers, notes)
        progress.report(after, f"writing {fmt.name}")
        return _write_one(fmt, derived_layers, options, source, notes)
    try:
        with progress.within(before, after):
            derived_layers = derive.run(chain.steps, layers, notes)
    except CannotDerive as error:
        if not spread.optional:
            raise
        if isinstance(error.__cause__, MissingLayer):
            return WrittenMap({}, Report(fmt.name))
        raise CannotConvert(error.detail, error.problems) from error
    with progress.within(after, 1.0):
        return _write_each(fmt, derived_layers, options, source, notes, spread)


@dataclass(frozen=True, slots=True)
class _Source:
    """Inputs of ``write``."""

    layers: Layers
    way: DerivationChain
    entries: Mapping[PartKey, PartEntry] | None
    origin: Mapping[PartKey, tuple[tuple[str, ...], str]] | None
    credit: Mapping[PartKey, Sequence[str]] | None
    templates: Templates
    closures: Closures | None
    around: Layers
    title: str


def _write_each(
    fmt: Format, derived_layers: Layers, options: Any, source: _Source, notes: derive.DerivationNotes, spread: Spread
) -> WrittenMap:
    """Write every derived part as it would be written by itself, and join the maps."""
    parts = fmt.selection.parts
    if parts is None:
        raise AssertionError(f"{fmt.name} declares no parts")
    keys = [
        k
        for k in derived_layers.parts_of(parts.layer)
        if k not in source.layers.parts and (k.level, k.name) not in spread.stored
    ]
    keys = [k for k in keys if not spread.names or k.name in spread.names]
    files: dict[str, bytes] = {}
    places: dict[str, tuple[str, str]] = {}
    reports: list[tuple[str, Report]] = []
    for index, key in enumerate(sorted(keys, key=lambda k: (k.level != spread.default, k))):
        progress.report(index / len(keys), f"writing {fmt.name}")
        names = [k.name for k in keys if k.level == key.level]
        usual = not spread.names and key.name == site.default_name(parts, names)
        chosen = replace(options, **{parts.level: key.level, parts.name: None if usual else key.name})
        one = _write_one(fmt, derived_layers, chosen, source, notes)
        folder = "" if key.level == spread.default else site.level_folder_name(key.level) + "/"
        reports.append((folder, one.report))
        for name, data in one.files.items():
            files.setdefault(folder + name, data)
            places.setdefault(folder + name, (key.level, key.name))
    return WrittenMap(files, merge_reports(reports) if reports else Report(fmt.name), places)


def _write_one(
    fmt: Format, derived_layers: Layers, options: Any, source: _Source, notes: derive.DerivationNotes
) -> WrittenMap:
    """Write one map of derived and existing layers."""
    layers, chain, entries, origin = source.layers, source.way, source.entries, source.origin
    credit, closures = source.credit, source.closures
    noted = {k: e.provenance.attribution for k, e in entries.items()} if entries is not None else credit or {}
    context = WriteContext(source.title, options, stored=None if closures is not None and closures.items else noted)
    inner: list[LayerLine] = []
    inner_closures: list[tuple[ClosureLine, ...]] = []
    if fmt.traits.is_container:
        context.make = partial(_inner, source, inner, inner_closures)
    chosen = fmt.selection.choose(sorted(k for k in derived_layers.parts if k.layer in fmt.layers), context.options)
    used = Layers({k: derived_layers.parts[k] for k in chosen}, derived_layers.datum, derived_layers.levels)
    if fmt.traits.is_container:  # nested maps apply the other closures themselves
        used, closed = applied_closures.close_masks(used, closures)
    else:
        drawn = derived_layers.parts.keys() - layers.parts.keys()
        applied, closed = applied_closures.close(fmt, used, closures, drawn)
        if closed.emptied and _has_no_edges(fmt, applied):
            applied, closed = applied_closures.close(fmt, used, closures, drawn, mark=True)
        used = applied
    lines = _report_layers(used, layers, chain, entries or {}, origin or {}, noted)
    context.attribution = tuple(sorted(all_credits(lines)))  # sorted: equal content gives equal bytes
    files = formats.write(fmt, used, context)
    _report_closures(fmt, closed, context)
    if not fmt.traits.is_container:  # nested maps check their edges themselves
        context.warnings += crossing_edges(
            fmt, used, replace(derived_layers, parts={**source.around.parts, **derived_layers.parts})
        )
    keys = {line.key for line in lines}
    lines += [line for line in inner if line.key not in keys]
    # Other layers of a stored version are not part of the recipe's key: ``Maps.report`` adds them.
    unsupported = unsupported_layers(fmt, None, layers) if entries is None else ()
    report = Report(
        fmt.name,
        tuple(lines),
        all_credits(lines),
        (*notes.template, *context.template),
        (*notes.dropped, *context.dropped, *unsupported),
        (*notes.warnings, *context.warnings),
        applied_closures.merge_report_lines([closed.lines, *inner_closures]),
    )
    return WrittenMap(files, report)


def crossing_edges(fmt: Format, written: Layers, around: Layers) -> list[Problem]:
    """Warn about edges that cross obstacles in a map of these layers. around: layers with grids and objects."""
    return crossings(written, around, shape_of=fmt.name if fmt.traits.keeps_bends == "foreign" else None)


def _has_no_edges(fmt: Format, layers: Layers) -> bool:
    """Return whether the format cannot be written because no edge is left."""
    return fmt.needs.missing_content is not None and fmt.needs.missing_content(layers) is not None


def _report_closures(fmt: Format, closed: applied_closures.ClosureReport, context: WriteContext) -> None:
    """Report blocked edges, omitted ones and those that planners can still use, and areas that no mask contains."""
    context.drop("blocked edges", closed.omitted, f"{fmt.name} cannot mark an edge as blocked for its planners")
    if closed.kept:
        edges = "1 blocked edge stays" if closed.kept == 1 else f"{closed.kept} blocked edges stay"
        why = "requested with closures=mark, or no edge would be left"
        context.warn(f"{edges} in this map ({why}); planners of {fmt.name} use them unless closed otherwise")
    for level in closed.unmasked:
        context.warn(
            f"no grid of this package contains the closed areas of the level {level!r}, which has no stored keepout "
            "mask: get keepout.yaml of occupancy_grid"
        )


def from_layers(
    fmt: Format,
    layers: Layers,
    option_values: Mapping[str, Any],
    *,
    derived: bool,
    entries: Mapping[PartKey, PartEntry] | None = None,
    origin: Mapping[PartKey, tuple[tuple[str, ...], str]] | None = None,
    credit: Mapping[PartKey, Sequence[str]] | None = None,
    closures: Closures | None = None,
    around: Layers | None = None,
    title: str = UNTITLED,
) -> WrittenMap:
    """Convert layers with the cheapest chain that works. Raises the errors of planning, deriving and writing.

    around: the layers whose obstacles edges may cross, if there are more than these.
    """
    if site.selects_all(fmt, option_values):
        return _write_every_part(
            fmt, layers, option_values, derived=derived, entries=entries, origin=origin, credit=credit
        )
    writer_options = recipes.writer_options(fmt, option_values)
    stock = recipes.available_in(layers)

    def plan(without: frozenset[str]) -> DerivationChain:
        return recipes.plan_chain(fmt, stock, writer_options, derived=derived, values=option_values, without=without)

    def attempt(chain: DerivationChain, failed: Sequence[ChainFailure]) -> WrittenMap:
        written = write(
            fmt,
            Layers({k: layers.parts[k] for k in chain.keys}, layers.datum, layers.levels),
            option_values,
            chain,
            entries,
            origin,
            credit,
            closures=closures,
            around=around or layers,
            title=title,
        )
        warnings = (*recipes.detours(failed), *written.report.warnings)
        return replace(written, report=replace(written.report, warnings=warnings))

    return derive.first_working(plan, attempt)


def _write_every_part(
    fmt: Format,
    layers: Layers,
    option_values: Mapping[str, Any],
    *,
    derived: bool,
    entries: Mapping[PartKey, PartEntry] | None,
    origin: Mapping[PartKey, tuple[tuple[str, ...], str]] | None,
    credit: Mapping[PartKey, Sequence[str]] | None,
) -> WrittenMap:
    """Write a map of several parts (``app.convert.site``) from layers in memory."""
    version = _as_version(layers)

    def plan(without: frozenset[str]) -> Recipe:
        return site.recipe(version, fmt, option_values, derived=derived, without=without, archive=False)

    def attempt(recipe: Recipe, _: Sequence[ChainFailure]) -> WrittenMap:
        files: dict[str, bytes] = {}
        places: dict[str, tuple[str, str]] = {}
        reports: list[tuple[str, Report]] = []
        for member in recipe.members:
            chain, spread = member.recipe.chain, member.recipe.spread
            chain_layers = Layers({k: layers.parts[k] for k in chain.keys}, layers.datum, layers.levels)
            values = parameters.canonical(member.recipe.options)
            one = write(fmt, chain_layers, values, chain, entries, origin, credit, spread=spread)
            reports.append((member.folder, one.report))
            for file in site.select([_PlacedFile(name, one.places.get(name)) for name in one.files], member):
                files.setdefault(member.folder + file.name, one.files[file.name])
                places.setdefault(member.folder + file.name, file.place or member.place or ("", ""))
        if not files:
            raise site.no_parts_error(recipe)
        return WrittenMap(files, merge_reports(reports), places)

    return derive.first_working(plan, attempt)


@dataclass(frozen=True, slots=True)
class _PlacedFile:
    """File name, with the level and name of its part if known."""

    name: str
    place: tuple[str, str] | None


def _as_version(layers: Layers) -> Version:
    """Describe layers in memory as a version, for planning."""
    stock = recipes.available_in(layers)
    parts = []
    for key in sorted(layers.parts):
        bounds: Any = dict.fromkeys(stock.anchors.get(key, ()), (0.0, 0.0, 0.0, 0.0))
        parts.append(PartEntry(key, "", int(key not in stock.empty_parts), bounds, Provenance("raw")))
    now = datetime.fromtimestamp(0, UTC)
    return Version("", 0, "", None, "", "", now, {}, (), (), layers.datum, layers.levels, tuple(parts))


def _inner(
    source: _Source,
    derivations: list[LayerLine],
    closed: list[tuple[ClosureLine, ...]],
    name: str,
    layers: Layers,
    values: Mapping[str, Any],
    derived: bool,
) -> NestedMap:
    """Write a nested map for ``WriteContext``; add the layers that it derives to ``derivations``."""
    fmt = formats.get_format(name)
    option_values = {**resolve(source.templates, fmt).values, **values}
    written_map = from_layers(
        fmt,
        layers,
        option_values,
        derived=derived,
        entries=source.entries,
        origin=source.origin,
        credit=source.credit,
        closures=source.closures,
        around=source.layers,
        title=source.title,
    )
    report = written_map.report
    derivations += [line for line in report.layers if line.information == "derived"]
    closed.append(report.closures)
    template = tuple(replace(line, format=fmt.name) for line in report.template)
    return NestedMap(written_map.files, report.dropped, template, report.warnings)


def media_type(fmt: Format, name: str) -> str:
    """Return the media type of one of a format's files, by its extension."""
    end = name.rpartition(".")[2]
    for pattern, declared in fmt.files.items():
        if pattern.rpartition(".")[2] == end:
            return declared
    return mimetypes.guess_type(name)[0] or "application/octet-stream"


def zip_files(files: Mapping[str, bytes]) -> bytes:
    """Create a zip of several files with reproducible bytes."""
    return archives.pack(files)


def _report_layers(
    used: Layers,
    before: Layers,
    chain: DerivationChain,
    entries: Mapping[PartKey, PartEntry],
    origin: Mapping[PartKey, tuple[tuple[str, ...], str]],
    noted: Mapping[PartKey, Sequence[str]],
) -> list[LayerLine]:
    """Build the report line of each part in the map: raw, derived or template, with steps and sources."""
    out = []
    steps = {step.gives: step for step in chain.steps}
    for key in sorted(used.parts):
        part = used.parts[key]
        if isinstance(part, Features) and not len(part):
            continue
        line = LayerLine(key.layer, key.level, key.name, "raw", attribution=tuple(noted.get(key, ())))
        if key not in before.parts and key.layer in steps:
            part_steps, roots = _ancestry(key.layer, steps)
            sources = sorted({s for k, e in entries.items() if k.layer in roots for s in e.provenance.sources})
            sources = sources or sorted({s for k, (n, _) in origin.items() if k.layer in roots for s in n})
            needed = [k for k in before.parts if k.layer in roots]
            credit = tuple(dict.fromkeys(text for k in needed for text in noted.get(k, ())))
            done = tuple(step.as_dict() for step in chain.steps if step in part_steps)
            line = replace(line, information="derived", steps=done, sources=tuple(sources), attribution=credit)
        elif key in entries:
            p = entries[key].provenance
            line = replace(line, information=p.information, steps=p.steps, sources=p.sources)
        else:
            line = replace(line, sources=origin.get(key, ((), ""))[0])
        out.append(line)
    if used.datum is not None and not any(line.layer == "location" for line in out):
        out.insert(0, LayerLine("location", GROUND, "datum", datum_information(used.datum, entries.values())))
    return out


def _ancestry(layer: Layer, steps: Mapping[Layer, Step]) -> tuple[set[Step], set[Layer]]:
    """Return the steps that lead to a derived layer, and the stored layers that they start from."""
    done: set[Step] = set()
    roots: set[Layer] = set()
    todo = [layer]
    while todo:
        step = steps.get(todo.pop())
        if step is None or step in done:
            continue
        done.add(step)
        todo += [need for need in step.reads if need in steps]
        roots |= {need for need in step.reads if need not in steps}
    return done, roots

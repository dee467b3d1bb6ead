"""Map service: plan, convert, cache and report."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from app import formats, parameters, templates
from app.convert import closures as applied_closures
from app.convert import files as direct
from app.convert import losses, site
from app.convert import recipe as recipes
from app.convert import worker as making
from app.convert.cache import Cache, CachedFile, CachedMap, ConvertedMap, LostMap, SharedMaps
from app.convert.recipe import Recipe
from app.convert.report import LayerLine, Report, all_credits, merge_reports, unsupported_layers
from app.convert.trials import Trials, is_lasting, trial_key
from app.derive import ChainFailure, first_working
from app.errors import (
    Ambiguous,
    CannotConvert,
    CannotDerive,
    FleetMapError,
    Invalid,
    MissingLayer,
    NotFound,
    Problem,
    Unavailable,
    UnreadableFile,
)
from app.formats import environment
from app.limits import Limits
from app.model.frame import Datum
from app.model.layers import Layers, PartKey
from app.model.names import did_you_mean
from app.model.notes import Dropped
from app.pool import CancelHandle, WorkerDied
from app.store.store import Store
from app.store.values import Provenance, Version
from app.syntax import shell
from app.upload_reader import UploadHints

Run = Callable[..., Any]
"""Runner of a module-level function: ``run(function, *args, stop=…)`` returns its result (``Pool.run``)."""


MAX_HOLD_ATTEMPTS = 5
"""Maximum number of conversions of a map that the cache evicts at once."""

FAILURE_SECONDS = 60.0
"""Minimum number of seconds before a failed optional map is tried again; see ``Maps.failure``."""

MAX_CACHED_RESULTS = 1000
"""Maximum number of maps with a cached failure, or with cached warnings about edges that cross obstacles."""


class Maps:
    """Maps of stored versions, converted on demand in worker processes and cached by content."""

    def __init__(
        self,
        store: Store,
        run: Run,
        cache_dir: Path,
        limits: Limits,
        *,
        cache_bytes: int = 4 * 2**30,
        run_trial: Run | None = None,
        shared: SharedMaps | None = None,
    ) -> None:
        """Create the service.

        shared: maps of all servers. run_trial: as ``run``, for jobs that must not wait for conversions.
        """
        self._store, self._run, self._limits = store, run, limits
        self._run_trial = run_trial or run
        self.cache = Cache(cache_dir, cache_bytes, shared)
        self._trials = Trials(cache_dir / "trials")
        self._crossings_cache: dict[Any, list[Problem]] = {}
        self._failures: OrderedDict[str, tuple[float, float, FleetMapError]] = OrderedDict()
        self._detours: OrderedDict[str, tuple[ChainFailure, ...]] = OrderedDict()
        self._guard = threading.Lock()

    def recipe(
        self,
        version: Version,
        name: str,
        values: Mapping[str, str] | None = None,
        *,
        derive: bool = True,
        file: str | None = None,
        listed: bool = False,
    ) -> Recipe:
        """Plan a conversion; cheap. Raises NotFound, Invalid, MissingLayer, MissingDatum, Ambiguous.

        values: of the request; the environment's templates supply the rest. file: the requested file of the map; its
        name may select a part (``keepout.yaml`` is the grid keepout, ``L2/map.yaml`` the one of the level L2). listed:
        as in a manifest: files are named as those of the whole site, and no zip is created.
        """
        plan = self._planner(version, name, values or {}, derive=derive, file=file, listed=listed)
        mode = None if version.closures is None else version.closures.mode
        order = recipes.MapOrder(version.ref, name, dict(values or {}), derive, file, listed, mode)

        def check(recipe: Recipe, failed: Sequence[ChainFailure]) -> Recipe:
            self._check_known_failure(recipe)
            return replace(recipe, failed=tuple(failed), replan=plan, order=order)

        planned = first_working(plan, check)
        return planned.without(self._detours.get(planned.key, planned.failed))

    def _planner(
        self, version: Version, name: str, values: Mapping[str, str], *, derive: bool, file: str | None, listed: bool
    ) -> Callable[[frozenset[str]], Recipe]:
        """Return a function that plans a request's map without some derivations. Raises the errors of ``recipe``."""
        version = applied_closures.add_areas(version)
        fmt = formats.get_format(name)
        filled = templates.resolve(version.templates, fmt)
        hints = fmt.selection.from_filename(file.rpartition("/")[2]) if file is not None else {}

        def plan(without: frozenset[str]) -> Recipe:
            if (parts := fmt.selection.parts) is not None:
                if file is not None:
                    by_name = {parts.level, parts.name, *hints}  # the file's name overrides templates
                    option_values = {**{n: v for n, v in filled.values.items() if n not in by_name}, **values}
                    recipe = site.file_recipe(version, fmt, option_values, file, derived=derive, without=without)
                    if recipe is not None:
                        return recipe
                elif listed or site.selects_all(fmt, values):
                    option_values = {**filled.values, **values}
                    return site.recipe(version, fmt, option_values, derived=derive, without=without, archive=not listed)
            option_values = {**filled.values, **hints, **site.single_part_options(fmt, values)}
            return recipes.recipe(version, name, option_values, derived=derive, without=without)

        origin = {**filled.origin, **dict.fromkeys({**hints, **values}, templates.REQUEST)}
        return lambda without: _with_origin(plan(without), origin)

    def _check_known_failure(self, recipe: Recipe) -> None:
        """Raise CannotDerive if a step has failed on this content before, unless the map may be empty."""
        for one in [recipe, *(member.recipe for member in recipe.members)]:
            if one.members or not one.steps or (one.spread is not None and one.spread.optional):
                continue
            with contextlib.suppress(KeyError):
                tried = self._trials[trial_key(one.version, one.chain)]
                if tried is not None and tried.step:
                    raise tried.as_error()

    def get_cached(self, recipe: Recipe) -> CachedMap | None:
        """Return the map if it is cached."""
        return self.cache.get(recipe.key)

    def get_made(self, recipe: Recipe, failed: Sequence[ChainFailure]) -> tuple[Recipe, CachedMap] | None:
        """Return a map that another process has made, after these derivations of its recipe found nothing to use.

        They are remembered: this process has not tried them, and would plan the same recipe again.
        """
        planned = recipe.without(failed)
        if planned.key != recipe.key:
            self._detours[recipe.key] = tuple(failed)
            while len(self._detours) > MAX_CACHED_RESULTS:
                self._detours.popitem(last=False)
        cached_map = self.cache.get_or_fetch(planned.key)
        return None if cached_map is None else (planned, cached_map)

    def get_or_convert(self, recipe: Recipe, stop: CancelHandle | None = None) -> tuple[Recipe, CachedMap]:
        """Return the map and its recipe, which differs from the given one if a step of that finds nothing to use.

        Blocks until the map is converted. stop: cancels the conversion from another thread; it then raises Cancelled.
        Raises CannotConvert if no chain works.
        """
        if recipe.compared is not None:
            find_losses = partial(self._find_losses, recipe.compared, stop)
            return recipe, self.cache.get_or_make(recipe.key, find_losses, uses_cache=True)
        try:
            return recipe, self._convert(recipe, stop)
        except CannotDerive:
            if recipe.replan is None:
                raise

        def convert(planned: Recipe, failed: Sequence[ChainFailure]) -> tuple[Recipe, CachedMap]:
            self._check_known_failure(planned)
            working = replace(planned, failed=tuple(failed), replan=recipe.replan)
            return working, self._convert(working, stop)

        return first_working(recipe.replan, convert)

    def _convert(self, recipe: Recipe, stop: CancelHandle | None) -> CachedMap:
        """Convert exactly this recipe and cache failures: that of a step which finds nothing to use, for all maps."""
        started = time.monotonic()
        try:
            if recipe.members:
                return self.cache.get_or_fetch(recipe.key) or self._assemble(recipe, stop)
            return self.cache.get_or_make(recipe.key, lambda: self._run_conversion(recipe, stop))
        except CannotDerive as error:
            if not recipe.members:  # otherwise the member stores it
                key = trial_key(recipe.version, recipe.chain)
                self._trials.add(key, ChainFailure.from_error(error), lasting=is_lasting(recipe.chain))
            raise
        except (CannotConvert, NotFound, Invalid) as error:
            self.note_failure(recipe, error, time.monotonic() - started)
            raise

    def _find_losses(self, recipe: Recipe, stop: CancelHandle | None) -> ConvertedMap:
        """Convert a map, read it back and compare it with its version."""
        stop = stop or CancelHandle()
        with stop.part(0.0, 0.5):
            cached_map = self.get_or_convert(recipe, stop)[1]
        files = {file.name: file.read() for file in cached_map.files}
        store_location = (self._store.database_url, str(self._store.blob_dir))
        arguments = (recipe.version, recipe.format.name, files, self._limits)
        try:
            with stop.part(0.5, 1.0):
                content: bytes = self._run(losses.find_losses, *store_location, *arguments, stop=stop)
        except WorkerDied as error:
            raise CannotConvert(f"the map in {recipe.format.name} could not be read back: {error.detail}") from error
        return ConvertedMap({"losses.json": (content, "application/json")}, None, cached_map.report)

    def failure(self, recipe: Recipe, formats: int = 1) -> FleetMapError | None:
        """Return the error of a recent conversion that content or parameters made impossible, or None.

        formats: number of maps that are wanted together. A failure counts until each of them may have failed as slowly,
        twice: otherwise the first one would be tried again before the last has failed, for ever.
        """
        with self._guard:
            since, seconds, error = self._failures.get(recipe.key, (0.0, 0.0, None))
        return error if time.monotonic() - since < max(FAILURE_SECONDS, 2 * formats * seconds) else None

    def note_failure(self, recipe: Recipe, error: FleetMapError, seconds: float) -> None:
        """Remember that this map could not be made, here or by another process, and how long that took."""
        with self._guard:
            self._failures[recipe.key] = (time.monotonic(), seconds, error)
            self._failures.move_to_end(recipe.key)
            while len(self._failures) > MAX_CACHED_RESULTS:
                self._failures.popitem(last=False)

    def _assemble(self, recipe: Recipe, stop: CancelHandle | None) -> CachedMap:
        """Assemble a map of several members, each converted by itself; cached members are protected meanwhile."""
        for _ in range(MAX_HOLD_ATTEMPTS):
            # A member with a damaged file is removed from the cache and converted again.
            with contextlib.suppress(LostMap), self.cache.hold_files() as hold:
                cached_maps = [
                    self._convert_member(recipe, k, hold, stop or CancelHandle()) for k in range(len(recipe.members))
                ]
                return self.cache.get_or_make(recipe.key, partial(join_members, recipe, cached_maps))
        raise Unavailable("cached maps are damaged repeatedly: check the disk of the cache")

    def _convert_member(
        self, recipe: Recipe, k: int, hold: Callable[[CachedMap], CachedMap], stop: CancelHandle
    ) -> CachedMap:
        count = len(recipe.members)
        with stop.part(k / count, (k + 1) / count):
            return self._convert_and_hold(recipe.members[k].recipe, hold, stop)

    def _convert_and_hold(
        self, recipe: Recipe, hold: Callable[[CachedMap], CachedMap], stop: CancelHandle | None
    ) -> CachedMap:
        for _ in range(MAX_HOLD_ATTEMPTS):
            with contextlib.suppress(LostMap):  # evicted at this moment
                return hold(self._convert(recipe, stop))
        raise Unavailable("the map cache is too small for the current conversions: try again or enlarge the cache")

    def fetch(
        self,
        version: Version,
        name: str,
        values: Mapping[str, str] | None = None,
        *,
        derive: bool = True,
        file: str | None = None,
    ) -> CachedFile:
        """Return the requested file of a map, or the zip of all files; blocks until the map is converted.

        Raises the errors of ``recipe`` and ``get_or_convert``, and NotFound if the map has no such file.
        """
        return select_file(*self.get_or_convert(self.recipe(version, name, values, derive=derive, file=file)), file)

    def get_blocking(
        self, version: Version, name: str, values: Mapping[str, str] | None = None, *, derive: bool = True
    ) -> CachedMap:
        """Return the map; blocks until it is converted. Raises the errors of ``recipe`` and ``get_or_convert``."""
        return self.get_or_convert(self.recipe(version, name, values, derive=derive))[1]

    def report(self, recipe: Recipe) -> Report:
        """Build the map report for this version: raw, derived, filled-in and dropped content."""
        recipe, cached_map = self.get_or_convert(recipe)
        written = cached_map.report
        if recipe.members:
            members = [(member.folder, self.report(member.recipe)) for member in recipe.members]
            return merge_reports([*members, ("", Report(written.format, dropped=written.dropped))])
        version = recipe.version
        stored = {e.key: e for e in version.parts}
        anew = {step.gives for step in recipe.steps}
        # Equal content may come from other files in another version: use this version's sources. A part that a step
        # derived again, although one of that name is stored, has the step's sources.
        lines = tuple(
            _with_provenance(line, stored[line.key].provenance)
            if line.key in stored and line.layer not in anew
            else line
            for line in written.layers
        )
        warnings = [*recipes.detours(recipe.failed), *written.warnings, *_stale_warnings(recipe)]
        warnings += [Problem(reason) for reason in self._unused_templates(recipe)]
        texts = {one.problem for one in warnings}
        warnings += [one for one in self._crossings(recipe) if one.problem not in texts]
        report = replace(
            written,
            layers=lines,
            attribution=all_credits(lines),
            dropped=written.dropped + unsupported_layers(recipe.format, stored, Layers()),
            warnings=tuple(warnings),
            closures=applied_closures.report_lines(version, written.closures),
            version=version.number,
        )
        return report.with_value_origin(recipe.origin, version.templates)

    def _crossings(self, recipe: Recipe) -> list[Problem]:
        """Warn about edges that cross obstacles which the map itself does not contain."""
        version, fmt, keys = recipe.version, recipe.format, recipe.chain.keys
        network = [k for k in keys if k.layer == "topology"]
        if recipe.steps or fmt.traits.is_container or not network or "topology" not in fmt.layers:
            return []
        beside = [(e.key, e.hash) for e in version.parts if e.key.layer in ("occupancy", "objects")]
        key = ("crossings", recipe.key, version.datum, tuple(beside))
        with self._guard:
            problems = self._crossings_cache.get(key)
        if problems is None:
            store_location = (self._store.database_url, str(self._store.blob_dir))
            try:
                problems = self._run(making.stored_crossings, *store_location, version, fmt.name, network)
            except (FleetMapError, WorkerDied) as error:
                problems = [Problem(f"edges were not checked against obstacles: {error.detail}")]
            with self._guard:
                self._crossings_cache[key] = problems
                while len(self._crossings_cache) > MAX_CACHED_RESULTS:
                    self._crossings_cache.pop(next(iter(self._crossings_cache)))
        return problems

    def _unused_templates(self, recipe: Recipe) -> list[str]:
        """List the environment's template values that this release cannot use."""
        used = formats.all_formats().values() if recipe.format.traits.is_container else [recipe.format]
        reasons = [reason for fmt in used for reason in templates.resolve(recipe.version.templates, fmt).ignored]
        return list(dict.fromkeys(reasons))

    def variables(self, version: Version) -> dict[str, str]:
        """Return an environment_template's literal variables by name (``FARM_NAME`` …)."""
        keys = [e.key for e in version.parts if e.key.layer == "objects" and e.key.name == environment.NAME]
        out: dict[str, str] = {}
        for part in self._store.content.load(version, keys).vector("objects").values() if keys else ():
            stored = part.document.get(environment.NAME)
            out |= shell.exported_variables(stored.get("variables") if isinstance(stored, Mapping) else None)[0]
        return dict(sorted(out.items()))

    def coverage(self, version: Version) -> list[dict[str, Any]]:
        """List for every format: direct, derivable or missing, the derivation chain, and what to supply."""
        available = recipes.available_layers(version)
        out = []
        for fmt in formats.all_formats().values():
            if fmt.write is None:
                continue
            line: dict[str, Any] = {"format": fmt.name, "state": "missing", "chain": [], "missing": []}
            try:
                chain, choose = self._find_chain(version, fmt, available)
            except Ambiguous as error:  # derivable once the caller selects one
                line |= {"state": "direct", "choose": error.detail}
            except FleetMapError as error:
                line["missing"] = [*recipes.missing_layers(fmt, available), *(p.problem for p in error.problems)]
                line["missing"] = line["missing"] or [error.detail]
            else:
                line["state"] = "derivable" if chain.steps else "direct"
                line["chain"] = [step.as_dict() for step in chain.steps]
                line |= {"choose": choose} if choose else {}
            out.append(line)
        return out

    def source_parts(self, version: Version, name: str) -> tuple[PartKey, ...]:
        """List the stored parts that a format's map would be converted from; empty if it cannot be."""
        try:
            return self._find_chain(version, formats.get_format(name), recipes.available_layers(version))[0].keys
        except FleetMapError:
            return ()

    def _find_chain(
        self, version: Version, fmt: formats.Format, available: recipes.AvailableLayers
    ) -> tuple[recipes.DerivationChain, str | None]:
        """Find the cheapest chain whose derivations work on the stored layers, by running them once per content.

        Returns it, and what the caller must specify if it works only then.
        """
        template_values = templates.resolve(version.templates, fmt).values
        options = formats.write_options(fmt, template_values)
        unnamed: tuple[recipes.DerivationChain, str | None] | None = None

        def plan(without: frozenset[str]) -> recipes.DerivationChain:
            return recipes.plan_chain(fmt, available, options, values=template_values, without=without)

        def attempt(
            chain: recipes.DerivationChain, failed: Sequence[ChainFailure]
        ) -> tuple[recipes.DerivationChain, str | None]:
            nonlocal unnamed
            failure = self._find_chain_failure(version, chain) if chain.steps else None
            if failure is None:
                self._check_content(version, fmt, chain)
                return chain, None
            if failure.step:
                if failure.choose and unnamed is None:
                    unnamed = chain, failure.reason
                raise failure.as_error()
            if unnamed is not None:
                return unnamed
            raise CannotConvert(failure.reason, [Problem(one.reason) for one in (*failed, failure)])

        def exhausted(error: MissingLayer, failed: Sequence[ChainFailure]) -> MissingLayer:
            return MissingLayer(error.detail, [Problem(one.reason) for one in failed])

        try:
            return first_working(plan, attempt, exhausted)
        except MissingLayer:
            if unnamed is None:
                raise
            return unnamed

    def _check_content(self, version: Version, fmt: formats.Format, chain: recipes.DerivationChain) -> None:
        """Raise CannotConvert if the layers have too little content for the format (a network without edges)."""
        if fmt.needs.missing_content is None:
            return
        failure = self._find_failure(
            trial_key(version, chain, fmt), chain, making.find_missing_content, version, fmt.name, chain
        )
        if failure is not None:
            raise CannotConvert(failure.reason, [Problem(failure.reason)])

    def _find_chain_failure(self, version: Version, chain: recipes.DerivationChain) -> ChainFailure | None:
        """Find the step of a chain that fails on the stored layers, and why (an empty step: no single one)."""
        chain = recipes.reduce_chain(chain)
        return self._find_failure(trial_key(version, chain), chain, making.find_chain_failure, version, chain)

    def _find_failure(
        self, key: str, chain: recipes.DerivationChain, function: Callable[..., Any], *args: Any
    ) -> ChainFailure | None:
        """Return a trial's failure, from the cache or from a worker."""
        with contextlib.suppress(KeyError):
            return self._trials[key]
        store_location = (self._store.database_url, str(self._store.blob_dir))
        try:
            failure: ChainFailure | None = self._run_trial(function, *store_location, *args)
            lasting = is_lasting(chain)
        except WorkerDied as error:
            failure, lasting = ChainFailure("", error.detail), False
        self._trials.add(key, failure, lasting=lasting)
        return failure

    def convert(
        self,
        files: Mapping[str, Path],
        to: str,
        *,
        hints: UploadHints | None = None,
        datum: Datum | None = None,
        options: Mapping[str, str] | None = None,
    ) -> direct.Converted:
        """Convert spooled files without storing anything."""
        recipes.writer_options(formats.get_format(to), options or {})
        arguments = (dict(files), to, hints or UploadHints(), datum, dict(options or {}), self._limits)
        try:
            converted: direct.Converted = self._run(direct.offline_paths, *arguments)
        except WorkerDied as error:
            raise UnreadableFile(f"the files could not be converted: {error.detail}") from error
        return converted

    def _run_conversion(self, recipe: Recipe, stop: CancelHandle | None) -> ConvertedMap:
        values = parameters.canonical(recipe.options)
        store_location = (self._store.database_url, str(self._store.blob_dir))
        cancel_arguments = {} if stop is None else {"stop": stop}
        try:
            written: making.WrittenMap = self._run(
                making.convert_version,
                *store_location,
                recipe.version,
                recipe.format.name,
                values,
                recipe.chain,
                recipe.spread,
                **cancel_arguments,
            )
        except WorkerDied as error:
            raise CannotConvert(f"conversion to {recipe.format.name} failed: {error.detail}") from error
        typed: dict[str, tuple[bytes | CachedFile, str]] = {
            name: (data, making.media_type(recipe.format, name)) for name, data in written.files.items()
        }
        archive = None
        if len(typed) > 1 and recipe.spread is None:
            archive = (f"{recipe.format.name}.zip", making.zip_files(written.files))
        return ConvertedMap(typed, archive, written.report, written.places)


def select_file(recipe: Recipe, cached_map: CachedMap, file: str | None) -> CachedFile:
    """Select the requested file of a map, or the zip of all files. file: as in the request. Raises NotFound."""
    if file is None:
        return cached_map.single_file()
    file_name = recipe.file or file
    cached_file = cached_map.file(file_name)
    if cached_file is None and recipe.spread is not None and "/" not in file_name:
        others = [f for f in cached_map.files if f.name.rpartition("/")[2] == file_name]
        cached_file = others[0] if len(others) == 1 else None  # on the only level that has it
    if cached_file is None:
        names = [f.name for f in cached_map.files]
        near = did_you_mean(file, names)
        raise NotFound(f"this map has no file {file!r}{near}; its files: {', '.join(names[:20]) or 'none'}")
    return cached_file


def join_members(recipe: Recipe, cached_maps: Sequence[CachedMap]) -> ConvertedMap:
    """Join the files of all members; of two with equal names keep the first and report the other as dropped."""
    files: dict[str, tuple[bytes | CachedFile, str]] = {}
    places: dict[str, tuple[str, str]] = {}
    clashes: list[Dropped] = []
    for member, cached_map in zip(recipe.members, cached_maps, strict=True):
        for file in site.select(cached_map.files, member):
            name = member.folder + file.name
            place = file.place or member.place
            if name in files:
                why = f"a file of {places[name][1]!r} has the same name; rename one of the two"
                clashes.append(Dropped(f"file {name} of {place[1] if place else name!r}", 1, why))
                continue
            files[name] = (file, file.media_type)
            if place is not None:
                places[name] = place
    if not files:
        raise site.no_parts_error(recipe)
    archive = None
    if recipe.archive and len(files) > 1:
        archive = (f"{recipe.format.name}.zip", making.zip_files(_LazyFiles({n: p for n, (p, _) in files.items()})))
    report = merge_reports(
        [(m.folder, cached_map.report) for m, cached_map in zip(recipe.members, cached_maps, strict=True)]
    )
    return ConvertedMap(files, archive, replace(report, dropped=(*report.dropped, *clashes)), places)


class _LazyFiles(Mapping[str, bytes]):
    """Files by name, read on demand."""

    def __init__(self, files: Mapping[str, bytes | CachedFile]) -> None:
        self._files = files

    def __getitem__(self, name: str) -> bytes:
        content = self._files[name]
        return content if isinstance(content, bytes) else content.read()

    def __iter__(self) -> Iterator[str]:
        return iter(self._files)

    def __len__(self) -> int:
        return len(self._files)


def _with_provenance(line: LayerLine, provenance: Provenance) -> LayerLine:
    return replace(
        line, information=provenance.information, sources=provenance.sources, attribution=provenance.attribution
    )


def _stale_warnings(recipe: Recipe) -> list[Problem]:
    """Warn about parts that were derived from content that has changed since."""
    stale = applied_closures.drop_areas(recipe.version).stale
    return [
        Problem(
            f"stale: derived from inputs that have changed since ({', '.join(why)}). Derive it again",
            where=f"{key.layer} {key.level}/{key.name}",
        )
        for key, why in stale.items()
        if key in recipe.chain.keys
    ]


def _with_origin(recipe: Recipe, origin: Mapping[str, str]) -> Recipe:
    members = tuple(replace(member, recipe=replace(member.recipe, origin=origin)) for member in recipe.members)
    return replace(recipe, origin=origin, members=members)

"""Ingest service: uploads, edits, reverts, datum changes. Each change creates one version or fails as a whole."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal

import orjson

from app import generate as generators
from app import parameters
from app.errors import CannotDerive, Conflict, Invalid, Problem, StaleParent, UnreadableFile
from app.ingest import online
from app.ingest.alignment import AlignmentRequest, AlignmentResult, prepare_alignment, previous_alignment
from app.ingest.commit_request import CommitRequest
from app.ingest.derivation import DerivationRequest, input_line, prepare_derivation
from app.ingest.derivation import check as check_wish
from app.ingest.drafts import DraftEditor, check_writer
from app.ingest.edits import check_depth, edit_changes
from app.ingest.generation import GenerationRequest, prepare_generation
from app.ingest.merging import MergeRequest, prepare_merge, previous_merge
from app.ingest.merging import check as check_merge
from app.ingest.prepare import Mode, PreparedUpload, datum_moved_warnings, prepare_changes, prepare_upload
from app.ingest.templates import TemplateUpdate
from app.limits import Limits
from app.model.frame import Datum
from app.pool import CancelHandle, WorkerDied
from app.store.changes import KEEP, Changes, Prepared
from app.store.pending import as_prepared
from app.store.store import Store
from app.store.values import DRAFT_PREFIX, Idempotency, Source, Version, Writer
from app.upload_reader import UploadHints

Run = Callable[..., Any]
"""Runner of a module-level function: ``run(function, *args)`` returns its result (``Pool.run``)."""

UNCHANGED = "="
"""Prefix of the fingerprint of a request that changed nothing."""

MAX_COMMIT_ATTEMPTS = 50
"""Maximum number of attempts to commit a change without ``If-Match`` while the head moves."""


@dataclass(frozen=True, slots=True)
class SpooledFile:
    """Uploaded file on disk; ``name`` is the client's relative path."""

    name: str
    path: Path
    size: int
    sha256: str


@dataclass(frozen=True, slots=True)
class Upload:
    """Uploaded files with the client's hints."""

    files: tuple[SpooledFile, ...]
    hints: UploadHints = field(default_factory=UploadHints)
    mode: Mode = "replace"


@dataclass(frozen=True, slots=True)
class CommitResult:
    """Result of a change. version: None for a dry run. body: the version or dry run as JSON."""

    status: Literal["created", "unchanged", "dry_run", "replayed"]
    version: Version | None
    body: dict[str, Any]


class Ingest:
    """Operations that create versions, or dry runs if the request says so."""

    def __init__(self, store: Store, run: Run, limits: Limits, provider: online.Provider | None = None) -> None:
        self._store, self._run, self._limits = store, run, limits
        self.provider = provider
        self.drafts = DraftEditor(store, self._run_in_worker)

    def stopped_by(self, stop: CancelHandle) -> Ingest:
        """Return the same service, whose work can be stopped from another thread; it then raises Cancelled."""
        return Ingest(self._store, partial(self._run, stop=stop), self._limits, self.provider)

    def upload(self, environment: str, upload: Upload, commit: CommitRequest) -> CommitResult:
        """Commit uploaded files as one version, or none of them.

        Raises BadUpload (nothing is stored), Invalid, StaleParent (``if_match`` names another version), Conflict (the
        idempotency key was used for another request), Unavailable.
        """
        _check_upload(upload)
        key = commit.idempotency(_fingerprint(upload, commit))
        paths = {f.name: f.path for f in upload.files}

        def once(base: Version) -> CommitResult:
            proposal: PreparedUpload = self._run_in_worker(
                prepare_upload, base, paths, upload.hints, upload.mode, self._limits
            )
            sources = self._store_sources(environment, upload, proposal)
            return self._commit(environment, base, proposal.prepared, commit, key, proposal.warnings, sources)

        return self._commit_on_head(environment, key, commit.if_match, once, "commit the upload")

    def edit(self, environment: str, changes: Sequence[Mapping[str, Any]], commit: CommitRequest) -> CommitResult:
        """Commit edits as one version. Raises Invalid (dangling edges, unknown ids), StaleParent, Conflict."""
        check_depth(changes)
        key = commit.idempotency(_digest(["edit", list(changes), commit.message]))
        return self._edit(environment, lambda _: changes, commit, key)

    def amend(
        self, environment: str, edits: Callable[[Version], Sequence[Mapping[str, Any]]], commit: CommitRequest
    ) -> CommitResult:
        """Commit edits that are computed from the head.

        If the head moves meanwhile, ``edits`` is called again, so that concurrent changes are kept. If it returns no
        edits, nothing changes.
        """
        return self._edit(environment, edits, commit, None)

    def _edit(
        self,
        environment: str,
        edits: Callable[[Version], Sequence[Mapping[str, Any]]],
        commit: CommitRequest,
        key: Idempotency | None,
    ) -> CommitResult:
        def once(base: Version) -> CommitResult:
            changes = edits(base)
            if changes or key is not None:
                change_set, warnings = edit_changes(self._store, base, changes)
            elif commit.dry_run:
                change_set, warnings = Changes(), ()
            else:
                return CommitResult("unchanged", base, base.as_dict())
            prepared: Prepared = self._run_in_worker(prepare_changes, base, change_set)
            return self._commit(environment, base, prepared, commit, key, warnings)

        return self._commit_on_head(environment, key, commit.if_match, once, "commit the edit")

    def derive(self, environment: str, request: DerivationRequest, commit: CommitRequest) -> CommitResult:
        """Derive a layer from others and commit it as one version.

        Raises NotFound, Invalid, CannotConvert, Conflict (the layer was uploaded or edited), StaleParent.
        """
        check_wish(request)
        fingerprint = ["derive", request.method, dict(request.values), request.replace, commit.message]
        key = commit.idempotency(_digest(fingerprint))
        described = commit.with_default_message(f"Derived by {request.method}")

        def once(base: Version) -> CommitResult:
            prepared, warnings = self._run_in_worker(
                prepare_derivation, base, request, failure="the layer could not be derived"
            )
            return self._commit(environment, base, prepared, described, key, warnings)

        return self._commit_on_head(environment, key, commit.if_match, once, "derive the layer")

    def generate(self, environment: str, order: GenerationRequest, commit: CommitRequest) -> CommitResult:
        """Generate a site from parameters and a seed, and commit it as one version.

        Whether the caller may read the environment that the site shall resemble must have been checked.

        Raises NotFound, Invalid, CannotGenerate, MissingLayer, Conflict (the part was uploaded or edited), StaleParent.
        """
        generators.check(order.generator, order.seed, order.values)
        like = None if order.like is None else self._store.versions.get(order.like)
        fingerprint = ["generate", order.generator, order.seed, dict(order.values), order.replace, commit.message]
        key = commit.idempotency(_digest(fingerprint))
        described = commit.with_default_message(f"Generated by {order.generator}, seed {order.seed}")

        def once(base: Version) -> CommitResult:
            prepared, warnings = self._run_in_worker(
                prepare_generation, base, order, like, failure="the site could not be generated"
            )
            return self._commit(environment, base, prepared, described, key, warnings)

        return self._commit_on_head(environment, key, commit.if_match, once, "generate the site")

    def fetch_imagery(self, environment: str, request: DerivationRequest, commit: CommitRequest) -> CommitResult:
        """Fetch an image of the site from the configured provider and commit it as one version.

        Raises CannotDerive (no provider, or its response is unusable), MissingLayer or MissingDatum, Invalid,
        Unavailable (the provider is down), Conflict, StaleParent.
        """
        provider = self.provider
        if provider is None:
            raise CannotDerive(
                "no imagery provider is configured: the operator must set FLEETMAP_IMAGERY_URL, FLEETMAP_IMAGERY_KIND "
                "and, if the provider requires one, FLEETMAP_IMAGERY_TOKEN",
                step=online.METHOD,
            )
        chosen = parameters.parse(online.Parameters, request.values, f"parameter of {online.METHOD}")
        key = commit.idempotency(_digest(["fetch", dict(request.values), request.replace, commit.message]))
        described = commit.with_default_message(f"Fetched from {provider.host}")
        fetches: list[tuple[online.Mosaic, tuple[bytes | None, ...]]] = []

        def once(base: Version) -> CommitResult:
            online.check_free(base, chosen, replace=request.replace)
            fences = sorted((e for e in base.parts if e.key.layer == "location" and e.count), key=lambda e: e.key)
            site = self._store.content.load(base, [e.key for e in fences])
            sheet = online.plan_mosaic(provider, online.site_box(site, chosen), chosen.resolution)
            if not fetches or fetches[-1][0] != sheet:  # same site: reuse the images
                fetches.append((sheet, tuple(online.Fetcher(provider).fetch(sheet.blocks))))
            step, lines = provider.provenance_step(chosen), tuple(map(input_line, fences))
            fetched = online.FetchedImagery(sheet, fetches[-1][1], chosen, step, provider.attribution, lines)
            failure = "the fetched image could not be read"
            try:
                prepared, warnings = self._run_in_worker(
                    online.prepare_picture, base, fetched, self._limits, failure=failure
                )
            except (CannotDerive, UnreadableFile):
                online.Fetcher(provider).forget(sheet.blocks)
                raise
            return self._commit(environment, base, prepared, described, key, warnings)

        return self._commit_on_head(environment, key, commit.if_match, once, "commit the fetched image")

    def align(self, environment: str, request: AlignmentRequest, commit: CommitRequest) -> CommitResult:
        """Align a grid with another map and commit it as one version.

        body of the result: {alignment, merge, version, warnings, dry_run}. Raises NotFound, Invalid, CannotConvert
        (nothing fits), StaleParent.
        """
        described = commit.with_default_message(f"Aligned the grid {request.level}/{request.grid}")
        key = commit.idempotency(_digest(["align", _fields(request, commit), commit.message]))
        return self._place_grids(environment, request, described, key)

    def merge(self, environment: str, request: MergeRequest, commit: CommitRequest) -> CommitResult:
        """Merge grids of several robots into one and commit it as one version.

        Returns and raises as `align`; Conflict if another grid has the result's name.
        """
        check_grid_name(request.name or None)
        check_merge(request)
        request = dataclasses.replace(request, max_cells=min(request.max_cells, self._limits.pixels))
        described = commit.with_default_message(f"Merged the grids {', '.join(request.grids)} of {request.level}")
        key = commit.idempotency(_digest(["merge", _fields(request, commit), commit.message]))
        return self._place_grids(environment, request, described, key)

    def _place_grids(
        self,
        environment: str,
        request: AlignmentRequest | MergeRequest,
        commit: CommitRequest,
        key: Idempotency | None,
    ) -> CommitResult:
        """Run an alignment or merge in a worker and commit it."""
        request = dataclasses.replace(request, dry_run=commit.dry_run)
        replayed = self._previous_result(environment, key)
        if replayed is not None and replayed.version is not None:
            stored = replayed.version
            if isinstance(request, MergeRequest):
                report = previous_merge(stored, request)
            else:
                report = previous_alignment(stored, request)
            return dataclasses.replace(replayed, body=_alignment_as_json(request, report, replayed, stored.warnings))
        work = prepare_merge if isinstance(request, MergeRequest) else prepare_alignment

        def once(base: Version) -> CommitResult:
            result: AlignmentResult = self._run_in_worker(work, base, request, failure="the grids could not be placed")
            if result.prepared is None:
                outcome = CommitResult("dry_run", None, {})
            else:
                outcome = self._commit(environment, base, result.prepared, commit, key, result.warnings)
            return dataclasses.replace(
                outcome, body=_alignment_as_json(request, result.summary, outcome, result.warnings)
            )

        return self._commit_on_head(environment, None, commit.if_match, once, "place the grids")

    def revert(self, environment: str, to: int, commit: CommitRequest) -> CommitResult:
        """Commit a new version with the content of an old one."""
        key = commit.idempotency(_digest(["revert", to, commit.message]))
        text = commit.message or f"Revert to version {to}"

        def once(base: Version) -> CommitResult:
            if commit.dry_run:
                target = self._store.versions.get(environment, to)
                prepared = self._store.versions.prepare_revert(base, target)
                return self._commit(environment, base, prepared, commit.with_message(text), None)
            same = self._store.versions.get(environment, to).root == base.root
            noted = Idempotency(key.key, UNCHANGED + key.fingerprint) if same and key is not None else key
            version = self._store.versions.revert(
                environment, to, author=commit.author, message=text, expected=base.number, idempotency=noted
            )
            return CommitResult("unchanged" if same else "created", version, version.as_dict())

        return self._commit_on_head(environment, key, commit.if_match, once, "revert the environment")

    def commit_dry_run(self, environment: str, ref: str, commit: CommitRequest) -> CommitResult:
        """Commit exactly what a dry run (``dry:<id>``) tried, with its sources, provenance and warnings.

        Raises NotFound if it has expired, StaleParent if it was not made for the head, Conflict.
        """
        again = "the dry run was made for version {}: run it again and review the changes"
        return self._commit_pending(environment, ref, commit, again, lambda: None)

    def commit_draft(self, environment: str, id: str, writer: Writer, commit: CommitRequest) -> CommitResult:
        """Commit a draft as one version, by default with its name as message, and remove it.

        Raises NotFound, Denied (it is another one's), StaleParent if it is not based on the head or was edited
        meanwhile, Conflict if it has no changes.
        """

        def check() -> None:
            check_writer(self._store.drafts.get(environment, id), writer)

        again = "the draft is based on version {}: rebase the draft and review the changes"
        return self._commit_pending(environment, DRAFT_PREFIX + id, commit, again, check)

    def _commit_pending(
        self, environment: str, ref: str, commit: CommitRequest, again: str, check: Callable[[], None]
    ) -> CommitResult:
        """Commit a dry run or draft. again: what to do if it is not based on the head. check: of the permission."""
        key = commit.idempotency(_digest(["commit", ref, commit.message]))
        replayed = self._previous_result(environment, key)
        if replayed is not None:
            return replayed
        check()
        tried = self._store.versions.get(environment, ref)
        head = self._store.versions.get(environment)
        check_if_match(commit.if_match, head)
        if tried.parent != head.number:
            raise StaleParent(f"the head of {environment} is version {head.number}, {again.format(tried.parent)}")
        if ref.startswith(DRAFT_PREFIX) and tried.pending is not None and not tried.pending.changed:
            raise Conflict("the draft has no changes: edit it first, or delete it")
        described = commit.with_default_message(tried.message)
        return self._commit(environment, head, as_prepared(tried), described, key, tried.warnings, tried.sources)

    def set_datum(self, environment: str, datum: Datum, commit: CommitRequest) -> CommitResult:
        """Commit a version with another datum: local features keep their metres, wgs84 features their degrees."""

        def once(base: Version) -> CommitResult:
            if base.datum == datum:
                return CommitResult("unchanged", base, base.as_dict())
            prepared = self._store.versions.prepare(base, Changes((), datum, KEEP))
            described = commit.with_default_message("Set the datum")
            return self._commit(environment, base, prepared, described, None, datum_moved_warnings(base, datum))

        return self._commit_on_head(environment, None, commit.if_match, once, "set the datum")

    def template(self, environment: str, update: TemplateUpdate, commit: CommitRequest) -> CommitResult:
        """Commit new template values as one version, since they change the robots' maps.

        update: validated. Raises StaleParent, Conflict.
        """
        fingerprint = _digest(["template", update.as_dict(), commit.message])
        key = commit.idempotency(fingerprint)
        described = commit.with_default_message(update.summary())

        def once(base: Version) -> CommitResult:
            prepared = self._store.versions.prepare(base, Changes(templates=update.apply_to(base.templates)))
            return self._commit(environment, base, prepared, described, key)

        return self._commit_on_head(environment, key, commit.if_match, once, "set the templates")

    def _commit_on_head(
        self,
        environment: str,
        key: Idempotency | None,
        if_match: str | None,
        once: Callable[[Version], CommitResult],
        task: str,
    ) -> CommitResult:
        """Commit a change on the head, and retry if the head moves and no condition forbids it.

        task: what to do, for the error if all attempts fail. A repeated ``key`` returns the stored result.
        """
        self._store.environments.check_own(environment)  # before the work
        replayed = self._previous_result(environment, key)
        if replayed is not None:
            return replayed
        for last in _tries(if_match):
            base = self._store.versions.get(environment)
            check_if_match(if_match, base)
            try:
                return once(base)
            except StaleParent:
                if last:
                    raise
        raise StaleParent(
            f"could not {task}: {environment} changed during each of {MAX_COMMIT_ATTEMPTS} attempts; try again"
        )

    def _commit(
        self,
        environment: str,
        base: Version,
        prepared: Prepared,
        commit: CommitRequest,
        key: Idempotency | None,
        warnings: Sequence[Problem] = (),
        sources: Sequence[Source] = (),
    ) -> CommitResult:
        if commit.dry_run:
            tried = self._store.versions.store_dry_run(
                environment,
                prepared,
                author=commit.author,
                message=commit.message,
                sources=tuple(sources),
                warnings=tuple(warnings),
            )
            return CommitResult("dry_run", None, dry_run_as_json(self._store, tried))
        if not prepared.changed:
            # Store the key too: if the request is repeated after other changes, it must not undo them.
            noted = None if key is None else Idempotency(key.key, UNCHANGED + key.fingerprint)
            same = base
            if noted is not None or sources or prepared.chunks:
                same = self._store.versions.commit(
                    environment,
                    prepared,
                    author=commit.author,
                    message=commit.message,
                    sources=tuple(sources),
                    idempotency=noted,
                )
            return CommitResult("unchanged", same, {**same.as_dict(), "warnings": [w.as_dict() for w in warnings]})
        version = self._store.versions.commit(
            environment,
            prepared,
            author=commit.author,
            message=commit.message,
            sources=tuple(sources),
            warnings=tuple(warnings),
            idempotency=key,
        )
        return CommitResult("created", version, version.as_dict())

    def _previous_result(self, environment: str, key: Idempotency | None) -> CommitResult | None:
        """Return the stored result for this key. Raises Conflict if the key belongs to another request."""
        if key is None:
            return None
        record = self._store.versions.idempotent(environment, key.key)
        if record is None:
            return None
        fingerprint, number = record
        if fingerprint.removeprefix(UNCHANGED) != key.fingerprint:
            raise Conflict(f"the Idempotency-Key {key.key!r} was already used for another request: use a new one")
        version = self._store.versions.get(environment, number)
        same = fingerprint.startswith(UNCHANGED)
        return CommitResult("unchanged" if same else "replayed", version, version.as_dict())

    def _store_sources(self, environment: str, upload: Upload, proposal: PreparedUpload) -> list[Source]:
        """Store the uploaded files byte for byte, before the version that refers to them."""
        notes = {n.name: n for n in proposal.notes}
        names = [f.name for f in upload.files] + list(proposal.members)
        contents: list[bytes | Path] = [f.path for f in upload.files]
        contents += list(proposal.members.values())
        similar = self._store.versions.sources_by_name(environment, names)
        digests = self._store.blobs.put_many(contents, [similar.get(name) for name in names])
        sizes = [f.size for f in upload.files] + [len(data) for data in proposal.members.values()]
        return [
            Source(name, size, digest, notes[name].format, notes[name].used)
            for name, size, digest in zip(names, sizes, digests, strict=True)
        ]

    def _run_in_worker(
        self, function: Callable[..., Any], *args: Any, failure: str = "the upload could not be read"
    ) -> Any:
        try:
            return self._run(function, self._store.database_url, str(self._store.blob_dir), *args)
        except WorkerDied as error:
            raise UnreadableFile(f"{failure}: {error.detail}") from error


def dry_run_as_json(store: Store, tried: Version) -> dict[str, Any]:
    """Describe a dry run: the version as it would be, with its differences from the head that it was made for."""
    assert tried.parent is not None
    layers = store.content.diff(store.versions.get(tried.environment, tried.parent), tried)
    return {**tried.as_dict(), "diff": {"from": tried.parent, "to": tried.ref, "layers": layers}}


def _fields(request: AlignmentRequest | MergeRequest, commit: CommitRequest) -> dict[str, Any]:
    return {**dataclasses.asdict(request), "dry_run": commit.dry_run}


def _alignment_as_json(
    request: AlignmentRequest | MergeRequest,
    report: Mapping[str, Any] | None,
    outcome: CommitResult,
    warnings: Sequence[Problem],
) -> dict[str, Any]:
    version_body = None if outcome.version is None else outcome.version.as_dict()
    dry_run = outcome.body if outcome.status == "dry_run" and outcome.body else None
    problems = [w.as_dict() for w in warnings]
    word = "merge" if isinstance(request, MergeRequest) else "alignment"
    reports = {"alignment": None, "merge": None, word: report}
    return {**reports, "version": version_body, "warnings": problems, "dry_run": dry_run}


def check_if_match(header: str | None, head: Version) -> None:
    """Check the If-Match header: ``"3"``, ``"<root>"``, a list, or ``*``. Raises StaleParent if it misses the head."""
    if header is None:
        return
    tags = [t.strip().removeprefix("W/").strip('"') for t in header.split(",")]
    if "*" not in tags and str(head.number) not in tags and head.root not in tags:
        raise StaleParent(
            f"the head of {head.environment} is version {head.number} (root {head.root}), which If-Match "
            f"{header[:80]} does not include: review the changes in between and send it again"
        )


def _check_upload(upload: Upload) -> None:
    if not upload.files:
        raise Invalid("the upload has no file: send at least one as form field 'files'")
    check_grid_name(upload.hints.grid)
    check_file_names(upload.files)


def check_file_names(files: Sequence[SpooledFile]) -> None:
    """Check names of uploaded files. Raises Invalid for unusable and duplicate names."""
    seen: set[str] = set()
    for file in files:
        problem = name_problem(file.name)
        if problem is None and file.name in seen:
            problem = "duplicate name"
        if problem:
            raise Invalid(f"invalid file name {file.name[:200]!r}: {problem}", [Problem(problem, file.name[:200])])
        seen.add(file.name)


def check_grid_name(grid: str | None) -> None:
    """Check that a grid name is usable in file names: ``keepout`` becomes ``keepout.yaml``. Raises Invalid."""
    if grid is None:
        return
    problem = name_problem(grid)
    if problem is None and "/" in grid:
        problem = "it must not contain a slash"
    if problem is None and grid.startswith("."):
        problem = "it must not start with a dot"
    if problem is None and len(grid) > 100:
        problem = "it must have at most 100 characters"
    if problem:
        raise Invalid(
            f"invalid grid name {grid[:100]!r}: {problem}, since file names contain it",
            [Problem(problem, where="grid")],
        )


def name_problem(name: str) -> str | None:
    """Return why a name of an uploaded file is invalid, or None. Names are relative paths with forward slashes."""
    if not name or len(name) > 1024:
        return "it must have 1 to 1024 characters"
    if not name.isprintable():
        return "it must not contain control characters"
    if "\\" in name or name.startswith("/") or (len(name) > 1 and name[1] == ":"):
        return "it must be a relative path with forward slashes"
    if any(part in ("", ".", "..") for part in name.split("/")):
        return "it must not contain empty, '.' or '..' parts"
    return None


def _tries(if_match: str | None) -> list[bool]:
    """Return for each attempt whether it is the last: with a condition there is only one."""
    count = 1 if if_match not in (None, "*") else MAX_COMMIT_ATTEMPTS
    return [k == count - 1 for k in range(count)]


def _fingerprint(upload: Upload, commit: CommitRequest) -> str:
    hints = upload.hints
    values = [hints.format, hints.layer, hints.level, hints.grid, upload.mode, commit.message, commit.dry_run]
    files = sorted([f.name, f.sha256] for f in upload.files)
    return _digest(["upload", values, dict(sorted(hints.options.items())), files])


def _digest(value: Any) -> str:
    return hashlib.sha256(orjson.dumps(value, option=orjson.OPT_SORT_KEYS)).hexdigest()

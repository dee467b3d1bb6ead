"""Repair damaged blobs and chunks with the same bytes from another source, verified by hash.

Bytes from any source (a folder, another server, an upload read again) are stored only under their own hash. So a repair
cannot change history, and a wrong source does no harm.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import zipfile
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any, Protocol

from app import upload_reader
from app.errors import Damaged, FleetMapError, NotFound
from app.ingest.moved import follow_outlines
from app.ingest.prepare import Mode, operation_for, read_fence
from app.limits import Limits
from app.model.layers import PartKey
from app.store.changes import Put
from app.store.in_worker import open_store
from app.store.prepare import compose_operation
from app.store.store import Store
from app.store.tree import ChunkStage
from app.store.values import PartEntry, Version
from app.store.verify import Finding
from app.upload_reader import EnvironmentContext, UploadHints

Run = Callable[..., Any]
"""Runner of a module-level function: ``run(function, *args)`` returns its result (``Pool.run``)."""

REMAKING = "removed, to be made again when requested"


class Donor(Protocol):
    """Source of bytes for a repair. name: shown to people."""

    name: str

    def blob(self, sha256: str) -> bytes | None:
        """Return a blob's content by its hash, or None."""
        ...

    def chunk(self, sha256: str) -> bytes | None:
        """Return a chunk's canonical bytes by its hash, or None."""
        ...


@dataclass(frozen=True, slots=True)
class RecoveredData:
    """Chunks and blobs recovered from a version's uploads: hash (hex) -> bytes."""

    chunks: Mapping[str, bytes]
    blobs: Mapping[str, bytes]


def repair(
    store: Store, findings: Collection[Finding], donors: Sequence[Donor], run: Run, limits: Limits
) -> dict[tuple[str, str], str]:
    """Repair as many findings as possible. Returns the origin of the bytes by (kind, name) of the finding.

    Damaged maps that servers share are removed: REMAKING instead of an origin.

    Data that is reachable only through a lost chunk is checked by the next verification.
    """
    blobs = {f.name: f for f in findings if f.kind == "blob"}
    chunks = {f.name: f for f in findings if f.kind == "chunk"}
    healed: dict[tuple[str, str], str] = {}
    for donor in donors:
        for name in [n for n in blobs if ("blob", n) not in healed]:
            data = donor.blob(name)
            if data is not None and store.blobs.put(data) == name:
                healed["blob", name] = donor.name
        for name in [n for n in chunks if ("chunk", n) not in healed]:
            raw = donor.chunk(name)
            with contextlib.suppress(Damaged):
                if raw is not None:
                    store.chunks.heal({name: raw})
                    healed["chunk", name] = donor.name
    users = {v for f in (*blobs.values(), *chunks.values()) for v in f.versions}
    # drafts and dry runs keep no uploads
    for environment, number in sorted((name, number) for name, number in users if isinstance(number, int)):
        place = (environment, number)
        lost_blobs = {n for n in blobs if ("blob", n) not in healed}
        lost_chunks = {n for n in chunks if ("chunk", n) not in healed}
        hit = [blobs[n] for n in lost_blobs] + [chunks[n] for n in lost_chunks]
        if not any(place in finding.versions for finding in hit):
            continue
        origin = f"the uploads of {environment} {number}"
        arguments = (store.database_url, str(store.blob_dir), environment, number, lost_chunks, lost_blobs, limits)
        for source in store.versions.get(environment, number).sources:
            with contextlib.suppress(FleetMapError):  # the worker has no network; it does without what is lost
                store.blobs.fetch([source.sha256])
        try:
            rebuilt: RecoveredData = run(recover_from_uploads, *arguments)
        except FleetMapError:
            continue  # the uploads are unreadable: keep the finding
        for data in rebuilt.blobs.values():
            healed["blob", store.blobs.put(data)] = origin
        store.chunks.heal(rebuilt.chunks)
        healed |= {("chunk", name): origin for name in rebuilt.chunks}
    if healed:
        store.garbage.look_at_everything()  # what was lost is not known to be part of versions
    for name in (f.name for f in findings if f.kind == "shared map"):
        store.made_maps.drop(name)
        healed["shared map", name] = REMAKING
    return healed


def recover_from_uploads(
    database_url: str,
    blob_dir: str,
    environment: str,
    number: int,
    lost_chunks: Collection[str],
    lost_blobs: Collection[str],
    limits: Limits,
) -> RecoveredData:
    """Recover lost chunks and blobs by reading a version's uploaded files again (in a worker).

    The upload hints (layer, name) are not stored: those that the version's parts suggest are tried until all data is
    recovered.
    """
    store = open_store(database_url, blob_dir)
    version, base = store.versions.get_with_base(environment, number)
    files, contents = _uploads(store, version, lost_blobs)
    chunks: dict[str, bytes] = {}
    for hints in _possible_hints(version.parts):
        if len(chunks) == len(lost_chunks) and len(contents) == len(lost_blobs):
            break
        with contextlib.suppress(FleetMapError):
            for draft, blobs in _compose_parts(store, version, base, files, hints, limits):
                chunks |= {
                    n: draft.stream([bytes.fromhex(n)])[bytes.fromhex(n)] for n in _staged_hashes(draft, lost_chunks)
                }
                contents |= {n: data for n, data in blobs.items() if n in lost_blobs}
    return RecoveredData(chunks, contents)


def _uploads(store: Store, version: Version, lost: Collection[str]) -> tuple[dict[str, bytes], dict[str, bytes]]:
    """Load the version's uploaded files, unpacked, and the lost blobs found in its archives."""
    files: dict[str, bytes] = {}
    contents: dict[str, bytes] = {}
    for source in version.sources:
        with contextlib.suppress(Damaged, NotFound):
            data = store.blobs.get(source.sha256)
            if source.format == "zip":
                contents |= _members(data, {s.sha256: s.size for s in version.sources if s.sha256 in lost})
            else:
                files[source.name] = data
    for source in version.sources:
        if source.sha256 in contents:
            files[source.name] = contents[source.sha256]
    return files, contents


def _members(data: bytes, sizes: Mapping[str, int]) -> dict[str, bytes]:
    """Find the members of an archive that have one of these hashes (hash -> size)."""
    out = {}
    unreadable = (zipfile.BadZipFile, zipfile.LargeZipFile, NotImplementedError, RuntimeError, OSError)
    with contextlib.suppress(*unreadable), zipfile.ZipFile(io.BytesIO(data)) as archive:
        for info in archive.infolist():
            if info.file_size in sizes.values():
                with archive.open(info) as member:
                    content = member.read(info.file_size)
                digest = hashlib.sha256(content).hexdigest()
                if digest in sizes:
                    out[digest] = content
    return out


def _possible_hints(entries: Sequence[PartEntry]) -> Iterator[UploadHints]:
    """Yield the upload hints that may have been sent with the files."""
    seen = [UploadHints()]
    for entry in entries:
        grid = entry.key.name if entry.key.layer == "occupancy" else None
        form = entry.provenance.format or None
        seen += [
            UploadHints(form, layer, entry.key.level, name)
            for layer in (None, entry.key.layer)
            for name in dict.fromkeys((None, grid))
        ]
        seen += [UploadHints(None, layer, entry.key.level, grid) for layer in (None, entry.key.layer)]
    for k, hints in enumerate(seen):
        if hints not in seen[:k]:
            yield hints


def _compose_parts(
    store: Store, version: Version, base: Version | None, files: Mapping[str, bytes], hints: UploadHints, limits: Limits
) -> Iterator[tuple[ChunkStage, Mapping[str, bytes]]]:
    """Yield the chunks and blobs of the parts read from the files, as replaced or merged parts."""
    start = version if base is None else base
    upload_bundle = upload_reader.read(
        files, hints, EnvironmentContext(start.datum or version.datum, read_fence(store, start)), limits
    )
    entries: Mapping[PartKey, PartEntry] = {} if base is None else {e.key: e for e in base.parts}
    moved, _ = follow_outlines(store, start, upload_bundle)  # once, poses were stored as they were uploaded
    bundles = [upload_bundle] if moved is upload_bundle else [moved, upload_bundle]
    modes: tuple[Mode, ...] = ("replace", "merge")
    for bundle, mode in product(bundles, modes):
        renamed: dict[str, dict[str, str]] = {}
        for key in sorted(bundle.parts):
            with contextlib.suppress(FleetMapError):
                operation = operation_for(store, start, bundle, key, mode, files, renamed, limits)
                draft = store.chunks.stage()
                stored_entries = {key: entries[key]} if isinstance(operation, Put) and key in entries else {}
                encoded_part = compose_operation(draft, dict(stored_entries), operation)
                yield draft, encoded_part.blobs if encoded_part is not None else {}


def _staged_hashes(draft: ChunkStage, hashes: Collection[str]) -> list[str]:
    return [n for n in hashes if bytes.fromhex(n) in draft.new or bytes.fromhex(n) in draft.stored]

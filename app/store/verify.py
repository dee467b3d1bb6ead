"""Verification of stored bytes against their hashes, and of versions' roots against their chunks. Read-only.

Drafts and dry runs are checked like versions.

A version's root is the hash of its parts' hashes, a part's hash that of its first chunk, and each chunk contains the
hashes of the next: if all chunks match their hashes and none is missing, every version is unchanged since its commit.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal

from sqlalchemy import Table, select

from app.errors import Damaged, Unavailable
from app.store import tables
from app.store.blob_upkeep import BlobUpkeep
from app.store.blobs import Blobs
from app.store.chunks import Chunks
from app.store.database import Database
from app.store.made_maps import MadeMaps
from app.store.manifest import unpack_manifest
from app.store.parts.rasters import tile_leaf
from app.store.parts.resources import file_leaf
from app.store.parts.roots import document_chunks, read_root
from app.store.prepare import version_root
from app.store.tree import ChunkStage, Node
from app.store.values import DRAFT_PREFIX, DRY_PREFIX, PartEntry

Kind = Literal["database", "blob", "chunk", "version", "cache", "shared map"]
KINDS: Final[tuple[Kind, ...]] = ("database", "chunk", "version", "blob", "cache")
"""What the background check reads; each reader of a shared map checks it."""

VersionName = tuple[str, int | str]
"""An environment's name, and a version's number or the name of a draft or dry run: ``draft:…``, ``dry:…``."""

Progress = Callable[[Kind, int], None]
"""Callback after each checked object, with its kind and its bytes."""

PAGE: Final = 200
MAX_LINES: Final = 20
_PENDING: Final[Mapping[str, Table]] = {DRAFT_PREFIX: tables.draft, DRY_PREFIX: tables.dry_run}
_NOTHING: Final[frozenset[str]] = frozenset()


@dataclass(frozen=True, slots=True)
class Finding:
    """One damaged object. name: a hash (hex), a version, or the database. versions: those that contain it."""

    kind: Kind
    name: str
    problem: str
    versions: tuple[VersionName, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        versions = [{"environment": name, "version": number} for name, number in self.versions]
        return {"kind": self.kind, "name": self.name, "problem": self.problem, "versions": versions}


@dataclass(slots=True)
class VerifyResult:
    """Number of checked objects by kind, and the findings. started: seconds since 1970."""

    checked: dict[Kind, int] = field(default_factory=dict)
    size: int = 0
    findings: list[Finding] = field(default_factory=list)
    started: float = field(default_factory=time.time)

    @property
    def unused_chunks(self) -> list[str]:
        """Return the damaged chunks that nothing uses, to be removed when all others are repaired."""
        return [f.name for f in self.findings if f.kind == "chunk" and not f.versions]


@dataclass(frozen=True, slots=True)
class _PartReferences:
    """References of a part: chunks that are lost or damaged (hex), and blobs (hex)."""

    bad: frozenset[str]
    blobs: frozenset[str]


class Verifier:
    """Checks of one store. It may run beside servers that write to it."""

    def __init__(
        self,
        database: Database,
        chunks: Chunks,
        blobs: Blobs,
        upkeep: BlobUpkeep,
        made_maps: MadeMaps,
        progress: Progress = lambda kind, size: None,
    ) -> None:
        self._database, self._chunks, self._blobs, self._upkeep = database, chunks, blobs, upkeep
        self._made_maps, self._progress = made_maps, progress

    def run(self) -> VerifyResult:
        """Check everything. Raises Unavailable if the database cannot be read at all."""
        out = VerifyResult()
        problem = self._database.integrity(MAX_LINES, quick=False)
        self._count(out, "database", 0)
        if problem is not None:
            out.findings.append(Finding("database", "database", problem))
        try:
            self._content(out)
        except Unavailable as error:
            if not out.findings:
                raise
            out.findings.append(Finding("database", "database", f"the check ended early: {error.detail}"))
        return out

    def _content(self, out: VerifyResult) -> None:
        bad: dict[str, str] = {}
        present: set[bytes] = set()
        for name, size, problem in self._chunks.iterate_checks():
            self._count(out, "chunk", size)
            present.add(name)
            if problem is not None:
                bad[name.hex()] = problem
        walk = _Walk(self._chunks, bad, present)
        chunk_users: dict[str, list[VersionName]] = {name: [] for name in bad}
        blob_users: dict[str, list[VersionName]] = {}
        for environment, row in self.versions():
            version = (environment, int(row.number))
            self._count(out, "version", len(row.manifest))
            problem, entries = check_root(row)
            if problem is not None:
                out.findings.append(Finding("version", f"{environment} {row.number}", problem, (version,)))
            _add_users(walk, entries, version, chunk_users, blob_users)
        self._check_pending(out, walk, chunk_users, blob_users)
        for chunk, users in chunk_users.items():
            out.findings.append(Finding("chunk", chunk, bad.get(chunk, "lost"), tuple(dict.fromkeys(users))))
        for environment, number, blob in self._sources():
            blob_users.setdefault(blob, []).append((environment, number))
        self._check_blobs(out, blob_users)
        for shared, size, problem in self._made_maps.iterate_checks():
            self._count(out, "shared map", size)
            if problem is not None:
                out.findings.append(Finding("shared map", shared, problem))

    def _check_pending(
        self, out: VerifyResult, walk: _Walk, chunks: dict[str, list[VersionName]], blobs: dict[str, list[VersionName]]
    ) -> None:
        for name, row in self._pending():
            self._count(out, "version", len(row.manifest))
            problem, entries = _check_manifest(row)
            bad: dict[str, list[VersionName]] = {}
            _add_users(walk, entries, name, bad, blobs)
            if (problem is None and not bad) or not self._is_pending(name, row.root):
                continue  # what an edit or a commit left meanwhile may have been collected
            if problem is not None:
                out.findings.append(Finding("version", " ".join(map(str, name)), problem, (name,)))
            for chunk, users in bad.items():
                chunks.setdefault(chunk, []).extend(users)

    def _pending(self) -> Iterator[tuple[VersionName, Any]]:
        """Iterate over (name, row) of every draft and dry run."""
        e = tables.environment
        for prefix, t in _PENDING.items():
            query = select(e.c.name, t.c.id, t.c.root, t.c.manifest).join(t, t.c.environment_id == e.c.id)
            last = ""
            while True:
                with self._database.read() as connection:
                    rows = connection.execute(query.where(t.c.id > last).order_by(t.c.id).limit(PAGE)).all()
                yield from (((str(row.name), prefix + row.id), row) for row in rows)
                if len(rows) < PAGE:
                    break
                last = rows[-1].id

    def _is_pending(self, name: VersionName, root: str) -> bool:
        prefix, _, key = str(name[1]).partition(":")
        t = _PENDING[prefix + ":"]
        with self._database.read() as connection:
            return connection.execute(select(t.c.id).where(t.c.id == key, t.c.root == root)).first() is not None

    def _check_blobs(self, out: VerifyResult, users: Mapping[str, list[VersionName]]) -> None:
        missing = dict.fromkeys(users)
        for name, size, problem in self._upkeep.iterate_checks():
            self._count(out, "blob", size)
            missing.pop(name, None)
            if problem is not None:
                out.findings.append(Finding("blob", name, problem, tuple(dict.fromkeys(users.get(name, ())))))
        for name in missing:
            if not self._blobs.has(name):  # else it was stored meanwhile
                out.findings.append(Finding("blob", name, "lost", tuple(dict.fromkeys(users[name]))))

    def _count(self, out: VerifyResult, kind: Kind, size: int) -> None:
        out.checked[kind] = out.checked.get(kind, 0) + 1
        out.size += size
        self._progress(kind, size)

    def chunks(self, after: str = "") -> Iterator[tuple[str, int, str | None]]:
        """Hash one chunk after the other: (hash in hex, bytes, problem or None)."""
        for name, size, problem in self._chunks.iterate_checks(bytes.fromhex(after)):
            yield name.hex(), size, problem

    def versions(self) -> Iterator[tuple[str, Any]]:
        """Iterate over (environment, row) of every version with content, also of deleted environments."""
        e, v = tables.environment, tables.version
        columns = (e.c.name, e.c.id, v.c.number, v.c.root, v.c.manifest, e.c.head, e.c.root.label("head_root"))
        query = select(*columns).join(v, v.c.environment_id == e.c.id).where(v.c.thinned.is_(None))
        query = query.order_by(e.c.id, v.c.number).limit(PAGE)
        environment, number = "", -1
        while True:
            later = (v.c.environment_id > environment) | ((v.c.environment_id == environment) & (v.c.number > number))
            with self._database.read() as connection:
                rows = connection.execute(query.where(later)).all()
            for row in rows:
                yield str(row.name), row
            if len(rows) < PAGE:
                return
            environment, number = rows[-1].id, rows[-1].number

    def _sources(self) -> list[tuple[str, int | str, str]]:
        e, s, d = tables.environment, tables.source, tables.dry_run
        query = select(e.c.name, s.c.number, s.c.sha256).join(s, s.c.environment_id == e.c.id)
        query = query.where(s.c.removed.is_(None))
        tried = select(e.c.name, d.c.id, d.c.sources).join(d, d.c.environment_id == e.c.id)
        with self._database.read() as connection:
            out: list[tuple[str, int | str, str]] = [(r.name, r.number, r.sha256) for r in connection.execute(query)]
            for row in connection.execute(tried):
                out += [(row.name, DRY_PREFIX + row.id, source["sha256"]) for source in row.sources]
        return out


def check_root(row: Any) -> tuple[str | None, tuple[PartEntry, ...]]:
    """Check a version's own row; returns its problem (None if intact), and its parts."""
    problem, entries = _check_manifest(row)
    if problem is None and row.number == row.head and row.root != row.head_root:
        problem = f"the root in its environment is {row.head_root}, but {row.root} was committed"
    return problem, entries


def _check_manifest(row: Any) -> tuple[str | None, tuple[PartEntry, ...]]:
    try:
        datum, levels, entries, templates = unpack_manifest(bytes(row.manifest))
        root = version_root(entries, datum, levels, templates)
    except Damaged as error:
        return error.detail, ()
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        return f"invalid manifest ({type(error).__name__})", ()
    if root != row.root:
        return f"the root of its manifest is {root}, but {row.root} was committed", entries
    return None, entries


def _add_users(
    walk: _Walk,
    entries: Sequence[PartEntry],
    name: VersionName,
    chunks: dict[str, list[VersionName]],
    blobs: dict[str, list[VersionName]],
) -> None:
    """Note which damaged chunks and which blobs these parts contain."""
    for entry in entries:
        below = walk.below(bytes.fromhex(entry.hash))
        for chunk in below.bad:
            chunks.setdefault(chunk, []).append(name)
        for blob in below.blobs:
            blobs.setdefault(blob, []).append(name)


class _Walk:
    """Walk through parts' trees that skips damaged nodes and visits each node once."""

    def __init__(self, chunks: Chunks, bad: Mapping[str, str], present: set[bytes]) -> None:
        self._chunks, self._bad, self._present = chunks, bad, present
        self._parts: dict[bytes, _PartReferences] = {}
        self._nodes: dict[bytes, _PartReferences] = {}

    def below(self, part: bytes) -> _PartReferences:
        """Return the references of a part."""
        if part not in self._parts:
            self._parts[part] = self._part(part)
        return self._parts[part]

    def _is_bad(self, name: bytes) -> bool:
        if name not in self._present and not self._chunks.find_damaged([name]):
            self._present.add(name)  # stored after the iteration over chunks had passed it
        return name not in self._present or name.hex() in self._bad

    def _part(self, name: bytes) -> _PartReferences:
        if self._is_bad(name):
            return _PartReferences(frozenset({name.hex()}), _NOTHING)
        draft = ChunkStage(self._chunks)
        root = read_root(draft, name)
        subtrees = [self._node(draft, node, root.type) for node in root.trees.values() if node is not None]
        documents = {h.hex() for h in document_chunks(root) if self._is_bad(h)}
        return _merge_references(subtrees, documents)

    def _node(self, draft: ChunkStage, node: Node, kind: str) -> _PartReferences:
        cached = self._nodes.get(node.hash)
        if cached is not None:
            return cached
        if self._is_bad(node.hash):
            below = _PartReferences(frozenset({node.hash.hex()}), _NOTHING)
        elif node.level:
            children = draft.inner(node.hash).children()
            below = _merge_references([self._node(draft, child, kind) for child in children], set())
        elif kind in ("grid", "picture"):
            (raw,) = draft.stream([node.hash]).values()
            below = _merge_references([], {tile.hex() for _, tile in tile_leaf(raw) if self._is_bad(tile)})
        elif kind == "resources":
            (raw,) = draft.stream([node.hash]).values()
            below = _PartReferences(_NOTHING, frozenset(h for _, _, h in file_leaf(raw)))
        else:
            below = _PartReferences(_NOTHING, _NOTHING)
        self._nodes[node.hash] = below
        return below


def _merge_references(subtrees: list[_PartReferences], bad: set[str]) -> _PartReferences:
    return _PartReferences(
        frozenset(bad).union(*(b.bad for b in subtrees)), _NOTHING.union(*(b.blobs for b in subtrees))
    )

"""Versions: reading them, committing a prepared one, adding further sources, reverting."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from typing import Any, Final, Literal

from sqlalchemy import Connection, Row, bindparam, func, insert, select, update

from app import traces
from app.errors import Conflict, Damaged, NotFound, Problem, StaleParent
from app.model.templates import template_changes
from app.store import blob_rows, chunks, drafts, dry_runs, outbox, parts, tables
from app.store.area import area_after, write_area
from app.store.audit import skip_audit
from app.store.base import (
    checked_text,
    clean_problem,
    environment_row,
    nearest_channel,
    storable_text,
)
from app.store.blobs import Blobs
from app.store.changes import KEEP, Changes, Keep, Prepared
from app.store.chunks import Chunks
from app.store.database import Database
from app.store.extent import extent, geometry
from app.store.manifest import (
    as_version,
    pack_manifest,
    read_if_kept,
    read_sources,
    read_version,
    version_columns,
)
from app.store.pending import check_committed
from app.store.prepare import frame_changes, prepare, prepare_further, summarise
from app.store.values import DRAFT_PREFIX, DRY_PREFIX, LATEST, Area, Idempotency, Pending, Source, Version

NAMES_AT_ONCE = 500
MAX_REVERT_ATTEMPTS: Final = 8


_CHANNEL: Final = select(tables.channel.c.version).where(
    tables.channel.c.environment_id == bindparam("environment"), tables.channel.c.name == bindparam("channel")
)


def resolve(connection: Connection, environment: Row[Any], ref: str | int) -> int:
    """Resolve a number, ``latest``, or a channel's name to a version's number. Raises NotFound."""
    if isinstance(ref, int):
        return ref
    if ref == LATEST:
        return int(environment.head)
    if ref.isascii() and ref.isdigit() and len(ref) < 10:
        return int(ref)
    number = connection.execute(_CHANNEL, {"environment": environment.id, "channel": ref}).scalar_one_or_none()
    if number is None:
        near = nearest_channel(connection, environment, ref)
        raise NotFound(
            f"{environment.name} has no version or channel {ref[:80]!r}{near}: use a number, latest, or an existing "
            "channel"
        )
    return int(number)


def insert_version(
    connection: Connection,
    environment: Row[Any],
    version: Version,
    *,
    sequence: int,
    area: Area | Literal[Keep.KEEP] | None,
) -> None:
    """Write a version's rows and make it the head. The caller has locked the environment's row.

    area: of this version; KEEP if it is that of the version before, None if the next query computes it.
    """
    row = {
        "environment_id": environment.id,
        "number": version.number,
        "root": version.root,
        "parent": version.parent,
        "author": version.author,
        "message": version.message,
        "time": version.time,
        "sequence": sequence,
        "changes": dict(version.changes),
        "warnings": [clean_problem(w).as_dict() for w in version.warnings],
        **_content_values(version),
    }
    connection.execute(insert(tables.version), row)
    insert_sources(connection, environment.id, version.number, version.sources, first=0)
    box = extent(version.parts, version.datum)
    west, south, east, north = box or (None, None, None, None)
    connection.execute(
        update(tables.environment)
        .where(tables.environment.c.id == environment.id)
        .values(
            head=version.number,
            root=version.root,
            sequence=sequence,
            datum=version.datum.as_dict() if version.datum else None,
            updated=version.time,
            west=west,
            south=south,
            east=east,
            north=north,
            extent=geometry(box),
            **({} if area is KEEP else {"area_stale": area is None}),
        )
    )
    if isinstance(area, Area):
        write_area(connection, environment.id, area)


def _content_values(version: Version) -> dict[str, Any]:
    """Return the columns of a version's content, or of its thinning at another server."""
    if version.thinned is not None:
        return {"manifest": b"", "thinned": version.thinned.time, "thinned_rule": version.thinned.rule}
    return {"manifest": pack_manifest(version.datum, version.levels, version.parts, version.templates)}


def append_version_event(
    connection: Connection, environment: Row[Any], before: Version, version: Version, sequence: int
) -> None:
    """Append the event of a new version. Call it last, see ``outbox.append_event``."""
    outbox.append_event(
        connection,
        environment_id=environment.id,
        environment=environment.name,
        sequence=sequence,
        kind="version.created",
        version=version.number,
        root=version.root,
        previous=(before.number, before.root),
        layers=outbox.layer_changes(before.parts, version.parts),
        message=version.message,
        author=version.author,
        time=version.time,
    )


def insert_sources(
    connection: Connection, environment_id: str, number: int, sources: Sequence[Source], first: int
) -> None:
    """Write source rows; the blobs of those that were not removed must exist and are marked as used."""
    if not sources:
        return
    blob_rows.lock(connection, {s.sha256 for s in sources if s.removed is None}, kept=True)
    connection.execute(
        insert(tables.source),
        [
            {
                "environment_id": environment_id,
                "number": number,
                "position": first + k,
                "name": storable_text(s.name),
                "size": s.size,
                "sha256": s.sha256,
                "format": s.format,
                "used": s.used,
                "removed": s.removed,
            }
            for k, s in enumerate(sources)
        ],
    )


class Versions:
    """Service for the versions of environments."""

    def __init__(self, database: Database, chunks: Chunks, blobs: Blobs) -> None:
        self._database, self._chunks, self._blobs = database, chunks, blobs

    def get(self, environment: str, ref: str | int = LATEST) -> Version:
        """Read a version by number, channel or ``latest``, a dry run by ``dry:<id>``, a draft by ``draft:<id>``.

        Raises NotFound, Thinned if a rule removed its content, or Gone if the environment is deleted.
        """
        with self._database.read() as connection:
            row = environment_row(connection, environment)
            if isinstance(ref, str) and ref.startswith(DRY_PREFIX):
                return dry_runs.read(connection, row, ref, self._database.now())
            if isinstance(ref, str) and ref.startswith(DRAFT_PREFIX):
                return drafts.read(connection, row, ref.removeprefix(DRAFT_PREFIX), self._database.now())
            return read_version(connection, row, resolve(connection, row, ref))

    def get_committed(self, environment: str, ref: str | int) -> Version:
        """Read a version that robots may be given. Raises Invalid for a dry run or draft, and as ``get``."""
        check_committed(ref)
        return self.get(environment, ref)

    def page(self, environment: str, *, limit: int = 100, before: int | None = None) -> list[Version]:
        """List versions, newest first, also thinned ones; ``before``: only those with a smaller number."""
        table = tables.version
        with self._database.read() as connection:
            row = environment_row(connection, environment)
            query = version_columns().where(table.c.environment_id == row.id)
            if before is not None:
                query = query.where(table.c.number < before)
            rows = connection.execute(query.order_by(table.c.number.desc()).limit(limit)).all()
            sources = read_sources(connection, row.id, [r.number for r in rows])
        return [as_version(row.name, r, sources[r.number]) for r in rows]

    def get_with_base(self, environment: str, number: int) -> tuple[Version, Version | None]:
        """Read a version, also of a deleted environment, and its predecessor, None if that was thinned."""
        with self._database.read() as connection:
            row = environment_row(connection, environment, deleted=True)
            base = read_if_kept(connection, row, number - 1) if number else None
            return read_version(connection, row, number), base

    def prepare(self, base: Version, changes: Changes) -> Prepared:
        """Prepare a version on top of a base. Only reads and computes, so that it may run in another process.

        Raises Invalid if content cannot be stored, NotFound if content to delete does not exist.
        """
        return prepare(self._chunks.stage(), base, changes, self._is_intact)

    def prepare_further(self, base: Version, current: Version, changes: Changes) -> Prepared:
        """Prepare changes on top of a draft's content, as a change of its base. Like ``prepare``."""
        return prepare_further(self._chunks.stage(), base, current, changes, self._is_intact)

    def _is_intact(self, part: str) -> bool:
        """Return whether the database has all chunks of a part intact, bypassing the cache."""
        try:
            names, _ = parts.all_chunks(self._chunks.stage(), bytes.fromhex(part), ())
        except Damaged:
            return False
        return not self._chunks.find_damaged(sorted(names))

    def commit(
        self,
        environment: str,
        prepared: Prepared,
        *,
        author: str,
        message: str,
        sources: Sequence[Source] = (),
        warnings: Sequence[Problem] = (),
        idempotency: Idempotency | None = None,
    ) -> Version:
        """Make the prepared version the head, in one transaction with its event.

        A key that was used before returns the version of that request. A prepared version without changes adds the
        sources to the head and returns it. Raises StaleParent if the head has moved since ``prepared.base``, Conflict
        if the key was used with another fingerprint, NotFound if ``prepared.pending`` has expired; a draft is removed,
        or StaleParent is raised if it was edited meanwhile.
        """
        with traces.span("commit", environment=environment, chunks=len(prepared.chunks), files=len(prepared.blobs)):
            return self._commit(environment, prepared, author, message, sources, warnings, idempotency)

    def _commit(
        self,
        environment: str,
        prepared: Prepared,
        author: str,
        message: str,
        sources: Sequence[Source],
        warnings: Sequence[Problem],
        idempotency: Idempotency | None,
    ) -> Version:
        checked_text(author, "an author")
        checked_text(message, "a message")
        if prepared.blobs:
            self._blobs.put_many(list(prepared.blobs.values()))
        with self._database.write() as connection:
            row = environment_row(connection, environment, lock=True)
            if (previous := _previous_version(connection, row, idempotency)) is not None:
                skip_audit()
                return read_version(connection, row, previous)
            _check_head(row, prepared.base)
            now = self._database.now()
            if prepared.pending is not None:
                _claim(connection, row, prepared.pending, now)
            chunks.insert(connection, prepared.chunks, kept=True)  # without changes: the repaired chunks
            if not prepared.changed:
                _append_sources(connection, row.id, row.head, sources)
                _remember(connection, row.id, idempotency, row.head, now)
                return read_version(connection, row, row.head)
            before = read_version(connection, row, row.head)
            blob_rows.lock(connection, set(prepared.blobs), kept=True)
            sequence = row.sequence + 1
            version = Version(
                environment=row.name,
                number=row.head + 1,
                root=prepared.root,
                parent=row.head,
                author=author,
                message=message,
                time=now,
                changes=prepared.changes,
                sources=tuple(sources),
                warnings=tuple(warnings),
                datum=prepared.datum,
                levels=prepared.levels,
                parts=prepared.parts,
                templates=prepared.templates,
            )
            insert_version(connection, row, version, sequence=sequence, area=prepared.area)
            _remember(connection, row.id, idempotency, version.number, now)
            stored = read_version(connection, row, version.number)
            append_version_event(connection, row, before, version, sequence)
        return stored

    def store_dry_run(
        self,
        environment: str,
        prepared: Prepared,
        *,
        author: str,
        message: str,
        sources: Sequence[Source] = (),
        warnings: Sequence[Problem] = (),
    ) -> Version:
        """Store the prepared version as a dry run, which can be read and committed by its id until it expires.

        The blobs of the sources must exist. Raises StaleParent if the head has moved since ``prepared.base``.
        """
        checked_text(author, "an author")
        checked_text(message, "a message")
        if prepared.blobs:
            self._blobs.put_many(list(prepared.blobs.values()))
        with self._database.write(notify=False, upkeep=True) as connection:
            row = environment_row(connection, environment, lock=True)
            _check_head(row, prepared.base)
            chunks.insert(connection, prepared.chunks)
            blob_rows.lock(connection, {*prepared.blobs, *(source.sha256 for source in sources)}, kept=False)
            return dry_runs.insert(
                connection,
                row,
                prepared,
                author=author,
                message=message,
                sources=sources,
                warnings=warnings,
                now=self._database.now(),
            )

    def remove_expired_dry_runs(self) -> None:
        """Remove expired dry runs; the next garbage collection removes their content."""
        dry_runs.remove_expired(self._database)

    def sources_by_name(self, environment: str, names: Sequence[str]) -> dict[str, str]:
        """Return the hashes of the newest uploaded files with these names, of those that have one."""
        table, newest = tables.source, func.max(tables.source.c.number)
        out: dict[str, str] = {}
        with self._database.read() as connection:
            row = environment_row(connection, environment)
            for start in range(0, len(names), NAMES_AT_ONCE):
                some = list(names[start : start + NAMES_AT_ONCE])
                named = (table.c.environment_id == row.id) & table.c.name.in_(some) & table.c.removed.is_(None)
                last = select(table.c.name, newest.label("number")).where(named).group_by(table.c.name).subquery()
                same = (table.c.name == last.c.name) & (table.c.number == last.c.number)
                query = select(table.c.name, table.c.sha256).join(last, same).where(named).order_by(table.c.position)
                out.update({r.name: r.sha256 for r in connection.execute(query)})
        return out

    def revert(
        self,
        environment: str,
        to: int,
        *,
        author: str,
        message: str,
        expected: int | None = None,
        idempotency: Idempotency | None = None,
    ) -> Version:
        """Create a version with the content of an old one; returns the head itself if its content is equal.

        expected: raise StaleParent if the head is another one; without it the head may move meanwhile.
        """
        for attempt in range(MAX_REVERT_ATTEMPTS):
            target = self.get(environment, to)
            head = self.get(environment)
            if expected is not None and head.number != expected:
                record = self.idempotent(environment, idempotency.key) if idempotency else None
                if record is None:
                    raise StaleParent(
                        f"the head of {environment} is version {head.number}, the change was made for version "
                        f"{expected}: review the changes in between and send it again"
                    )
            try:
                return self.commit(
                    environment,
                    self.prepare_revert(head, target),
                    author=author,
                    message=message,
                    idempotency=idempotency,
                )
            except StaleParent:
                if attempt == MAX_REVERT_ATTEMPTS - 1 or expected is not None:
                    raise
        raise AssertionError("unreachable")

    def prepare_revert(self, head: Version, target: Version) -> Prepared:
        """Prepare a version on top of the head with the content of another one."""
        changed = head.root != target.root
        changes: dict[str, Any] = {}
        area: Area | Literal[Keep.KEEP] | None = KEEP
        if changed:
            area = area_after(self._chunks.stage(), head.parts, target.parts, head.datum, target.datum)
            before, after = {e.key: e for e in head.parts}, {e.key: e for e in target.parts}
            changes = summarise(self._chunks.stage(), before, after)
            changes |= frame_changes(head.datum, target.datum, head.levels, target.levels)
            changes |= template_changes(head.templates, target.templates)
        contents = (target.parts, target.datum, target.levels, target.templates)
        return Prepared(head.number, target.root, {}, *contents, changes, changed=changed, area=area)

    def idempotent(self, environment: str, key: str) -> tuple[str, int] | None:
        """Return (fingerprint, version number) of the request that used this key, or None."""
        table = tables.idempotency
        with self._database.read() as connection:
            row = environment_row(connection, environment)
            query = select(table.c.fingerprint, table.c.version).where(
                table.c.environment_id == row.id, table.c.key == key
            )
            record = connection.execute(query).one_or_none()
        return None if record is None else (record.fingerprint, record.version)


def _claim(connection: Connection, environment: Row[Any], pending: Pending, now: datetime) -> None:
    """Keep a dry run until the transaction ends, or remove a draft that becomes a version."""
    if pending.kind == "draft":
        drafts.remove(connection, environment, pending, now)
    else:
        dry_runs.lock(connection, environment, pending.id, now)


def _check_head(row: Row[Any], base: int) -> None:
    if row.head != base:
        raise StaleParent(
            f"the head of {row.name} is version {row.head}, the change was made for version {base}: review "
            "the changes in between and send it again"
        )


def _previous_version(connection: Connection, row: Row[Any], idempotency: Idempotency | None) -> int | None:
    if idempotency is None:
        return None
    table = tables.idempotency
    query = select(table).where(table.c.environment_id == row.id, table.c.key == idempotency.key)
    record = connection.execute(query).one_or_none()
    if record is None:
        return None
    if record.fingerprint != idempotency.fingerprint:
        raise Conflict(f"the Idempotency-Key {idempotency.key!r} was already used for another request: use a new one")
    return int(record.version)


def _remember(
    connection: Connection, environment_id: str, idempotency: Idempotency | None, version: int, now: datetime
) -> None:
    if idempotency is not None:
        connection.execute(
            insert(tables.idempotency).values(
                environment_id=environment_id,
                key=idempotency.key,
                fingerprint=idempotency.fingerprint,
                version=version,
                time=now,
            )
        )


def _append_sources(connection: Connection, environment_id: str, number: int, sources: Sequence[Source]) -> None:
    table = tables.source
    existing_sources = read_sources(connection, environment_id, [number])[number]
    present = {(s.name, s.sha256): s.removed is not None for s in existing_sources}
    again = [s for s in dict.fromkeys(sources) if present.get((s.name, s.sha256))]
    if again:  # uploaded again after a rule had removed them
        blob_rows.lock(connection, {s.sha256 for s in again}, kept=True)
        of_version = (table.c.environment_id == environment_id) & (table.c.number == number)
        for s in again:
            same = (table.c.name == storable_text(s.name)) & (table.c.sha256 == s.sha256)
            connection.execute(update(table).where(of_version, same).values(removed=None))
    new = [s for s in dict.fromkeys(sources) if (s.name, s.sha256) not in present]
    last = connection.execute(
        select(func.max(table.c.position)).where(table.c.environment_id == environment_id, table.c.number == number)
    ).scalar_one()
    insert_sources(
        connection,
        environment_id,
        number,
        [replace(s, used=False) for s in new],
        first=0 if last is None else last + 1,
    )

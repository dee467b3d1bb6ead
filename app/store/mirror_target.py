"""Environments of a centre in the database of a server that mirrors it.

A page of ``mirror_source`` is applied in one transaction: versions with their own numbers, times and sequences,
channels, overlays and the events, which the relay then publishes like any other. The environment's row is the
checkpoint. The content of the versions must be stored before. What the mirror has changed by itself stays until the
centre has it.
"""

from __future__ import annotations

import base64
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Final

from sqlalchemy import Connection, Row, delete, func, insert, select, update

from app.errors import Conflict, Damaged, Unavailable, Untrusted
from app.model.frame import Datum, Level
from app.model.templates import NO_TEMPLATES, Templates
from app.store import blob_rows, outbox, tables
from app.store import chunks as chunk_rows
from app.store.base import check_environment_name, upsert
from app.store.database import Database
from app.store.manifest import unpack_manifest, warnings_from_row
from app.store.mirror_source import FORM
from app.store.overlays import read_closures_anew
from app.store.prepare import version_root
from app.store.protection import lock_reports
from app.store.retention import thin
from app.store.values import Event, PartEntry, Source, Thinning, Version
from app.store.versions import insert_sources, insert_version

BATCH: Final = 500

NO_CONTENT: Final[tuple[Datum | None, tuple[Level, ...], tuple[PartEntry, ...], Templates]] = (
    None,
    (),
    (),
    NO_TEMPLATES,
)

PAGE_PROBLEM: Final = "invalid page from the centre"


@dataclass(frozen=True, slots=True)
class MirroredEnvironment:
    """An environment of this database, as far as a mirror compares it. centre: None if it follows no other server.

    root: of version ``head``.
    """

    id: str
    name: str
    head: int
    root: str
    sequence: int
    updated: datetime
    epoch: int
    centre: str | None
    deleted: bool


@dataclass(frozen=True, slots=True)
class MirrorPage:
    """A checked page of an environment, see ``mirror_source``.

    thinned: numbers of versions that the mirror may have and whose content the centre has removed, with when and why.
    """

    environment: Mapping[str, Any]
    epoch: int
    upto: int
    last: int
    complete: bool
    versions: tuple[tuple[Version, int], ...]
    events: tuple[Event, ...]
    channels: tuple[Mapping[str, Any], ...]
    overlays: tuple[Mapping[str, Any], ...]
    prefixes: tuple[bytes, ...]
    base: Mapping[str, Any] | None
    tags: tuple[Mapping[str, Any], ...]
    thinned: tuple[tuple[range, Thinning], ...]

    @property
    def id(self) -> str:
        """Id of the environment, the same on both servers."""
        return str(self.environment["id"])

    @property
    def name(self) -> str:
        """Name of the environment."""
        return str(self.environment["name"])


def parse_page(body: Mapping[str, Any]) -> MirrorPage:
    """Check a page. Raises Untrusted if it cannot be what a centre writes, or is of a newer release."""
    if body.get("form") != FORM:
        raise Untrusted(
            f"the centre writes pages of form {body.get('form')!r:.20}, this server reads form {FORM}: update the "
            "older one"
        )
    try:
        name = check_environment_name(str(body["environment"]["name"]))
        prefixes = base64.b64decode(body["chunks"], validate=True)
        return MirrorPage(
            environment=body["environment"],
            epoch=int(body["epoch"]),
            upto=int(body["upto"]),
            last=int(body["last"]),
            complete=bool(body["complete"]),
            versions=tuple((_read_version(name, row), int(row["sequence"])) for row in body["versions"]),
            events=tuple(
                Event(int(e["sequence"]), str(e["environment"]), dict(e["body"]), read_time(e["time"]), 0)
                for e in body["events"]
            ),
            channels=tuple(body["channels"]),
            overlays=tuple(body["overlays"]),
            prefixes=tuple(prefixes[k : k + 8] for k in range(0, len(prefixes), 8)),
            base=body["base"],
            tags=tuple(body["tags"]),
            thinned=tuple((range(int(r["first"]), int(r["last"]) + 1), _read_thinning(r)) for r in body["thinned"]),
        )
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise Untrusted(f"{PAGE_PROBLEM}: {type(error).__name__}: {error}") from error
    except Damaged as error:
        raise Untrusted(f"{PAGE_PROBLEM}: {error.detail}") from error


def read_time(text: str) -> datetime:
    """Read an RFC 3339 time. Raises ValueError."""
    moment = datetime.fromisoformat(text)
    if moment.tzinfo is None:
        raise ValueError(f"no time zone in {text[:40]!r}")
    return moment


def read_sources_of(rows: Sequence[Mapping[str, Any]]) -> tuple[Source, ...]:
    """Read the files of a version from a page."""
    return tuple(
        Source(
            r["name"],
            int(r["size"]),
            r["sha256"],
            r["format"],
            bool(r["used"]),
            read_time(r["removed"]) if "removed" in r else None,
        )
        for r in rows
    )


def _read_thinning(row: Mapping[str, Any]) -> Thinning:
    return Thinning(read_time(row["time"]), str(row["rule"]))


def _read_version(environment: str, row: Mapping[str, Any]) -> Version:
    thinned = _read_thinning(row["thinned"]) if "thinned" in row else None
    datum, levels, parts, templates = NO_CONTENT
    if thinned is None:
        datum, levels, parts, templates = unpack_manifest(base64.b64decode(row["manifest"], validate=True))
    root = version_root(parts, datum, levels, templates) if thinned is None else str(row["root"])
    if root != row["root"]:
        raise Damaged(f"version {row['number']} has the root {root}, but {row['root']} is stated")
    return Version(
        environment=environment,
        number=int(row["number"]),
        root=root,
        parent=row["parent"],
        author=row["author"],
        message=row["message"],
        time=read_time(row["time"]),
        changes=row["changes"],
        sources=read_sources_of(row["sources"]),
        warnings=warnings_from_row(row["warnings"]),
        datum=datum,
        levels=levels,
        parts=parts,
        templates=templates,
        thinned=thinned,
    )


class MirrorTarget:
    """Write access for a mirror."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def environments(self) -> dict[str, MirroredEnvironment]:
        """Read all environments by id, also deleted ones."""
        table = tables.environment
        with self._database.read() as connection:
            return {row.id: _as_mirrored(row) for row in connection.execute(select(table))}

    def absent_chunks(self, prefixes: Sequence[bytes]) -> tuple[list[bytes], list[bytes]]:
        """Look for stored chunks by the beginnings of their hashes: (hashes that are there, beginnings of others)."""
        table = tables.chunk
        present: list[bytes] = []
        with self._database.read() as connection:
            for start in range(0, len(prefixes), BATCH // 4):
                some = prefixes[start : start + BATCH // 4]
                for prefix in some:
                    query = select(table.c.hash).where(table.c.hash >= prefix, table.c.hash <= prefix + b"\xff" * 24)
                    present += [bytes(h) for h in connection.execute(query.limit(2)).scalars()]
        stored = {h[:8] for h in present}
        return present, [p for p in prefixes if p not in stored]

    def newest_thinned(self, environment_id: str) -> datetime | None:
        """Return when the versions that are thinned here were thinned last; None without one."""
        table = tables.version
        query = select(func.max(table.c.thinned)).where(
            table.c.environment_id == environment_id, table.c.thinned.is_not(None)
        )
        with self._database.read() as connection:
            newest: datetime | None = connection.execute(query).scalar_one()
        return newest

    def add_chunks(self, chunks: Mapping[str, bytes]) -> None:
        """Store chunks (hash in hex -> compressed bytes) that no version refers to yet."""
        with self._database.write(notify=False, upkeep=True) as connection:
            chunk_rows.insert(connection, chunks)

    def apply(
        self, page: MirrorPage, centre: str, names: Sequence[bytes], blobs: Collection[str], *, anew: bool = False
    ) -> None:
        """Apply a page in one transaction.

        Args:
            names: hashes of all chunks that its versions need and that the mirror's versions do not refer to.
            blobs: files of their parts, likewise.
            anew: remove what the mirror has of the environment before, since the centre's history is another one.

        Raises Conflict if this server has an environment of its own under that name, Unavailable if content is missing.
        """
        with self._database.write(upkeep=True) as connection:
            if page.thinned:
                lock_reports(connection)
            row = _claim_row(connection, page, centre)
            if page.upto < row.sequence and not anew:
                return  # another process has applied a newer one
            if anew:
                _clear(connection, row)
                row = _row_by_id(connection, page.id)
            digest = read_closures_anew(connection, row).digest
            _keep_chunks(connection, names)
            blob_rows.lock(connection, blobs, kept=True)
            for version, sequence in page.versions:
                if version.number <= row.head:
                    continue
                insert_version(connection, row, version, sequence=sequence, area=None)
            if row.head < 0 and not page.versions:
                raise Untrusted(f"{PAGE_PROBLEM}: {page.name} has no version")
            if page.base is not None:
                _add_base_sources(connection, row, page)
            _write_channels(connection, row, page)
            _write_tags(connection, row, page)
            if not anew:
                _thin(connection, page, self._database.now())
            _write_overlays(connection, row, page.overlays, self._database.now())
            _write_environment(connection, row, page, centre, digest)
            _retire_names(connection, page)
            outbox.append_copies(connection, page.id, [e for e in page.events if e.sequence > row.sequence])

    def remove(self, environment_id: str) -> None:
        """Remove a mirrored environment that its centre has purged; its name continues from its last sequence."""
        table = tables.environment
        with self._database.write(upkeep=True) as connection:
            row = connection.execute(select(table).where(table.c.id == environment_id).with_for_update()).one_or_none()
            if row is None or row.centre is None:
                return
            upsert(connection, tables.retired, {"name": row.name}, {"sequence": row.sequence})
            connection.execute(delete(table).where(table.c.id == environment_id))
            connection.execute(update(tables.collection).values(purges=tables.collection.c.purges + 1))

    def release(self, name: str) -> bool:
        """Make a mirrored environment one of this server, which is changed here; False if it is none.

        The centre's permission to sign stays valid until it ends.
        """
        table = tables.environment
        with self._database.write() as connection:
            query = select(table).where(table.c.name == name, table.c.centre.is_not(None))
            row = connection.execute(query.with_for_update()).one_or_none()
            if row is None:
                return False
            connection.execute(delete(tables.edge_change).where(tables.edge_change.c.environment_id == row.id))
            connection.execute(update(table).where(table.c.id == row.id).values(centre=None))
            return True


def _as_mirrored(row: Row[Any]) -> MirroredEnvironment:
    epoch = int(row.centre_epoch or 0)
    is_deleted = row.deleted is not None
    return MirroredEnvironment(
        row.id, row.name, row.head, row.root, row.sequence, row.updated, epoch, row.centre, is_deleted
    )


def _row_by_id(connection: Connection, environment_id: str) -> Row[Any]:
    table = tables.environment
    return connection.execute(select(table).where(table.c.id == environment_id).with_for_update()).one()


def _claim_row(connection: Connection, page: MirrorPage, centre: str) -> Row[Any]:
    """Lock the environment's row, or create it; free its name if another mirrored environment had it."""
    table = tables.environment
    holder = connection.execute(select(table).where(table.c.name == page.name)).one_or_none()
    if holder is not None and holder.id != page.id:
        if holder.centre is None:
            raise Conflict(
                f"this server has an environment {page.name!r} of its own: rename or purge it, or mirror others with "
                "--environment"
            )
        # renamed or purged at the centre; no client can use this name, and its own page or removal follows
        connection.execute(update(table).where(table.c.id == holder.id).values(name=f"~{holder.id}"))
    query = select(table).where(table.c.id == page.id)
    row = connection.execute(query.with_for_update()).one_or_none()
    if row is not None:
        if row.centre is None:
            raise Conflict(
                f"the environment {row.name!r} was released from its centre and is changed here: purge it to mirror it "
                "again"
            )
        return row
    members = page.environment
    values = {
        "id": page.id,
        "name": page.name,
        "title": members["title"],
        "description": members["description"],
        "tags": list(members["tags"]),
        "head": -1,
        "root": "",
        "sequence": 0,
        "datum": None,
        "area_stale": True,
        "created": read_time(members["created"]),
        "updated": read_time(members["updated"]),
        "centre": centre,
        "centre_epoch": page.epoch,
    }
    connection.execute(insert(table).values(values))
    return _row_by_id(connection, page.id)


def _clear(connection: Connection, row: Row[Any]) -> None:
    """Remove versions, channels, events and overlays of an environment, except what the centre has to get."""
    queued = select(tables.edge_change.c.overlay_id)
    for table in (tables.source, tables.version, tables.version_tag, tables.channel, tables.event):
        connection.execute(delete(table).where(table.c.environment_id == row.id))
    overlay = tables.overlay
    connection.execute(delete(overlay).where(overlay.c.environment_id == row.id, overlay.c.id.not_in(queued)))
    owner = tables.environment
    values = {"head": -1, "root": "", "sequence": 0, "closures_sequence": 0, "area_stale": True}
    connection.execute(update(owner).where(owner.c.id == row.id).values(values))
    connection.execute(update(tables.collection).values(purges=tables.collection.c.purges + 1))


def _keep_chunks(connection: Connection, names: Sequence[bytes]) -> None:
    """Mark chunks as parts of a version. Raises Unavailable if garbage collection has removed one meanwhile."""
    table = tables.chunk
    ordered = sorted(set(names))
    for start in range(0, len(ordered), BATCH):
        some = ordered[start : start + BATCH]
        changed = update(table).where(table.c.hash.in_(some)).values(kept=True, used=int(time.time()))
        if connection.execute(changed).rowcount != len(some):
            raise Unavailable("content was removed while it was mirrored: the next attempt fetches it again")


def _add_base_sources(connection: Connection, row: Row[Any], page: MirrorPage) -> None:
    """Add files that were uploaded again without a change, and so became sources of the newest version."""
    table = tables.source
    number = int(row.head)
    if number < 0 or page.base is None or row.root != page.base["root"]:
        return
    count = connection.execute(
        select(func.count()).where(table.c.environment_id == row.id, table.c.number == number)
    ).scalar_one()
    insert_sources(connection, row.id, number, read_sources_of(page.base["sources"])[count:], first=count)


def _write_channels(connection: Connection, row: Row[Any], page: MirrorPage) -> None:
    if not page.complete:
        return
    table = tables.channel
    connection.execute(delete(table).where(table.c.environment_id == row.id))
    for channel in page.channels:
        values = dict(channel)
        for name in ("time", "planned_at"):
            values[name] = None if values[name] is None else read_time(values[name])
        connection.execute(insert(table).values(environment_id=row.id, **values))


def _write_tags(connection: Connection, row: Row[Any], page: MirrorPage) -> None:
    if not page.complete:
        return
    table = tables.version_tag
    connection.execute(delete(table).where(table.c.environment_id == row.id))
    for tag in page.tags:
        values = {**tag, "time": read_time(tag["time"])}
        connection.execute(insert(table).values(environment_id=row.id, **values))


def _thin(connection: Connection, page: MirrorPage, now: datetime) -> None:
    """Thin what the centre has thinned, except of what is in use here: a robot may have reported only to the mirror."""
    for numbers, thinning in page.thinned:
        row = _row_by_id(connection, page.id)
        for start in range(numbers.start, numbers.stop, BATCH):
            some = list(range(start, min(start + BATCH, numbers.stop)))
            thin(connection, row, some, thinning.rule, now, recorded=thinning.time)


def _write_overlays(
    connection: Connection, row: Row[Any], overlays: Sequence[Mapping[str, Any]], now: datetime
) -> None:
    """Write the centre's overlays, except those with changes that the centre does not have yet."""
    queue, table = tables.edge_change, tables.overlay
    queued = set(connection.execute(select(queue.c.overlay_id).where(queue.c.environment_id == row.id)).scalars())
    for overlay in overlays:
        values = overlay_values(overlay)
        if overlay["id"] in queued:
            continue
        state = connection.execute(select(table.c.state).where(table.c.id == overlay["id"])).scalar_one_or_none()
        if state in ("ended", "expired") and values["expires"] <= now:
            continue  # ended here at its time, and soon at the centre
        upsert(connection, table, {"id": overlay["id"]}, {"environment_id": row.id, **values})


def overlay_values(overlay: Mapping[str, Any]) -> dict[str, Any]:
    """Return the columns of an overlay's row except id and environment. Raises ValueError."""
    values = {c.name: overlay.get(c.name) for c in tables.overlay.c if c.name not in ("id", "environment_id")}
    for name in ("created", "expires", "decided"):
        values[name] = None if values[name] is None else read_time(str(values[name]))
    return values


def _write_environment(connection: Connection, row: Row[Any], page: MirrorPage, centre: str, digest: str) -> None:
    """Write the environment's row. digest: of the closures that were in force before."""
    table = tables.environment
    members = page.environment
    values: dict[str, Any] = {
        "name": page.name,
        "title": members["title"],
        "description": members["description"],
        "tags": list(members["tags"]),
        "sequence": page.upto,
        "centre": centre,
        "centre_epoch": page.epoch,
    }
    if page.complete:
        values |= {"updated": read_time(members["updated"]), "closures_sequence": int(members["closures_sequence"])}
        values["deleted"] = None if members["deleted"] is None else read_time(members["deleted"])
    closures_sequence = values.get("closures_sequence", row.closures_sequence)
    if closures_sequence == row.closures_sequence and read_closures_anew(connection, row).digest != digest:
        values["edge_sequence"] = row.edge_sequence + 1  # robots have seen other closures under these sequences
    connection.execute(update(table).where(table.c.id == row.id).values(values))


def _retire_names(connection: Connection, page: MirrorPage) -> None:
    """Note the last sequences under former names, from which a new environment of such a name continues."""
    last: dict[str, int] = {}
    for event in page.events:
        if event.environment != page.name:
            last[event.environment] = event.sequence
    for name, sequence in last.items():
        upsert(connection, tables.retired, {"name": name}, {"sequence": sequence})

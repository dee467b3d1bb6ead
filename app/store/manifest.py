"""Version rows as values: the part list of a version (its manifest); the content itself is in chunks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import ormsgpack
from sqlalchemy import Connection, Row, select

from app.errors import Damaged, NotFound, Problem
from app.model.frame import Datum, Level
from app.model.layers import PartKey
from app.model.templates import NO_TEMPLATES, Templates
from app.store import tables
from app.store.encode import compress, decompress, pack
from app.store.values import Box, PartEntry, Provenance, Source, Version

MANIFEST: Final = 1
"""Encoding of a version's manifest: [1, datum, levels, parts]. Older encodings stay readable by this number."""

WITH_TEMPLATES: Final = 2
"""Encoding of manifests with templates: [2, datum, levels, parts, templates]."""


def pack_manifest(
    datum: Datum | None, levels: Sequence[Level], parts: Sequence[PartEntry], templates: Templates = NO_TEMPLATES
) -> bytes:
    """Decoded manifest of a version, without the content itself."""
    rows = [
        [
            e.key.layer,
            e.key.level,
            e.key.name,
            bytes.fromhex(e.hash),
            e.count,
            _box_as_list(e.bounds.get("local")),
            _box_as_list(e.bounds.get("wgs84")),
            bytes.fromhex(e.digest),
            e.provenance.as_dict(),
        ]
        for e in parts
    ]
    place = datum.as_dict() if datum else None
    storeys = [[v.name, v.elevation] for v in levels]
    template_values = templates.as_dict()
    return compress(
        pack(
            [WITH_TEMPLATES, place, storeys, rows, template_values]
            if template_values
            else [MANIFEST, place, storeys, rows]
        )
    )


def _box_as_list(box: Box | None) -> list[float] | None:
    return None if box is None else list(box)


def unpack_manifest(data: bytes) -> tuple[Datum | None, tuple[Level, ...], tuple[PartEntry, ...], Templates]:
    """The reverse."""
    form, *members = ormsgpack.unpackb(decompress(data))
    if (form, len(members)) not in ((MANIFEST, 3), (WITH_TEMPLATES, 4)):
        raise Damaged("a version has an unsupported manifest: it may have been written by a newer release")
    place, levels, rows, *more = members
    parts = tuple(
        PartEntry(
            PartKey(layer, level, name),
            h.hex(),
            count,
            {"local": tuple(local) if local else None, "wgs84": tuple(wgs84) if wgs84 else None},
            Provenance.from_dict(provenance),
            digest=digest.hex(),
        )
        for layer, level, name, h, count, local, wgs84, digest, provenance in rows
    )
    templates = Templates.from_dict(more[0]) if more else NO_TEMPLATES
    return (Datum(**place) if place else None), tuple(Level(n, e) for n, e in levels), parts, templates


def as_version(environment: str, row: Row[Any], sources: Sequence[Source]) -> Version:
    """Convert a row and its sources into a value."""
    datum, levels, parts, templates = unpack_manifest(bytes(row.manifest))
    return Version(
        environment=environment,
        number=row.number,
        root=row.root,
        parent=row.parent,
        author=row.author,
        message=row.message,
        time=row.time,
        changes=row.changes,
        sources=tuple(sources),
        warnings=warnings_from_row(row.warnings),
        datum=datum,
        levels=levels,
        parts=parts,
        templates=templates,
    )


def warnings_from_row(rows: Sequence[Mapping[str, Any]]) -> tuple[Problem, ...]:
    """Convert stored warnings."""
    return tuple(Problem(w["problem"], w.get("file"), w.get("line"), w.get("where")) for w in rows)


def read_sources(connection: Connection, environment_id: str, numbers: Sequence[int]) -> dict[int, list[Source]]:
    """Read the sources of some versions, in the order of their upload."""
    table = tables.source
    query = (
        select(table)
        .where(table.c.environment_id == environment_id, table.c.number.in_(list(numbers)))
        .order_by(table.c.number, table.c.position)
    )
    out: dict[int, list[Source]] = {n: [] for n in numbers}
    for r in connection.execute(query):
        out[r.number].append(Source(r.name, r.size, r.sha256, r.format, r.used))
    return out


def read_version(connection: Connection, environment: Row[Any], number: int) -> Version:
    """Read one version. Raises NotFound."""
    table = tables.version
    query = select(table).where(table.c.environment_id == environment.id, table.c.number == number)
    row = connection.execute(query).one_or_none()
    if row is None:
        raise NotFound(f"{environment.name} has no version {number}; it has versions 0 to {environment.head}")
    return as_version(environment.name, row, read_sources(connection, environment.id, [number])[number])

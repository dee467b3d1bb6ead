"""Version rows as values: the part list of a version (its manifest); the content itself is in chunks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import ormsgpack
from sqlalchemy import Connection, Row, Select, bindparam, func, select

from app.errors import Damaged, NotFound, Problem, Thinned
from app.model.frame import Datum, Level
from app.model.layers import PartKey
from app.model.templates import NO_TEMPLATES, Templates
from app.store import tables
from app.store.encode import compress, decompress, pack
from app.store.values import Box, PartEntry, Provenance, Source, Thinning, Version, rfc3339

TAG_SEPARATOR: Final = ","
"""Between tags in one text; no tag has it."""

MANIFEST: Final = 1
"""Encoding of a version's manifest: [1, datum, levels, parts]. Older encodings stay readable by this number."""

WITH_TEMPLATES: Final = 2
"""Encoding of manifests with templates: [2, datum, levels, parts, templates]."""


def version_columns() -> Select[Any]:
    """Return a query of versions' rows, each with ``tags``: their names in one text, None without any."""
    table, tag = tables.version, tables.version_tag
    of_version = (tag.c.environment_id == table.c.environment_id) & (tag.c.number == table.c.number)
    tags = select(func.aggregate_strings(tag.c.name, TAG_SEPARATOR)).where(of_version)
    return select(table, tags.scalar_subquery().label("tags"))


_VERSION: Final = version_columns().where(
    tables.version.c.environment_id == bindparam("environment"), tables.version.c.number == bindparam("number")
)
_SOURCES: Final = (
    select(tables.source)
    .where(
        tables.source.c.environment_id == bindparam("environment"),
        tables.source.c.number.in_(bindparam("numbers", expanding=True)),
    )
    .order_by(tables.source.c.number, tables.source.c.position)
)


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
    """Convert a row of ``version_columns`` and its sources into a value; a thinned one has no parts."""
    datum, levels, parts, templates = (
        unpack_manifest(bytes(row.manifest)) if row.thinned is None else (None, (), (), NO_TEMPLATES)
    )
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
        tags=tuple(sorted(row.tags.split(TAG_SEPARATOR))) if row.tags else (),
        thinned=None if row.thinned is None else Thinning(row.thinned, row.thinned_rule or ""),
    )


def warnings_from_row(rows: Sequence[Mapping[str, Any]]) -> tuple[Problem, ...]:
    """Convert stored warnings."""
    return tuple(Problem(w["problem"], w.get("file"), w.get("line"), w.get("where")) for w in rows)


def read_sources(connection: Connection, environment_id: str, numbers: Sequence[int]) -> dict[int, list[Source]]:
    """Read the sources of some versions, in the order of their upload."""
    out: dict[int, list[Source]] = {n: [] for n in numbers}
    for r in connection.execute(_SOURCES, {"environment": environment_id, "numbers": list(numbers)}):
        out[r.number].append(Source(r.name, r.size, r.sha256, r.format, r.used, r.removed))
    return out


def read_version(connection: Connection, environment: Row[Any], number: int) -> Version:
    """Read one version. Raises NotFound, or Thinned if its content was removed."""
    version = read_history(connection, environment, number)
    if version.thinned is not None:
        raise Thinned(_thinned_detail(connection, environment, version))
    return version


def read_if_kept(connection: Connection, environment: Row[Any], number: int) -> Version | None:
    """Read one version; None if its content was removed. Raises NotFound."""
    version = read_history(connection, environment, number)
    return version if version.thinned is None else None


def read_history(connection: Connection, environment: Row[Any], number: int) -> Version:
    """Read one version as the history lists it: without parts if it was thinned. Raises NotFound."""
    row = connection.execute(_VERSION, {"environment": environment.id, "number": number}).one_or_none()
    if row is None:
        raise NotFound(f"{environment.name} has no version {number}; it has versions 0 to {environment.head}")
    return as_version(environment.name, row, read_sources(connection, environment.id, [number])[number])


def _thinned_detail(connection: Connection, environment: Row[Any], version: Version) -> str:
    table, thinned = tables.version, version.thinned
    assert thinned is not None
    kept = (table.c.environment_id == environment.id) & table.c.thinned.is_(None)
    older = select(func.max(table.c.number)).where(kept, table.c.number < version.number)
    newer = select(func.min(table.c.number)).where(kept, table.c.number > version.number)
    near = [n for query in (older, newer) if (n := connection.execute(query).scalar_one()) is not None]
    return (
        f"version {version.number} of {environment.name} was thinned on {rfc3339(thinned.time)} by the rule "
        f"{thinned.rule!r}: only its entry in the history is left. The nearest versions with content are "
        f"{' and '.join(map(str, near))}"
    )

"""What dry runs and drafts have in common: a version's content in a row of its own, which keeps that content stored."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy import Row

from app.errors import Invalid, Problem
from app.store.base import clean_problem
from app.store.changes import Prepared
from app.store.manifest import pack_manifest, unpack_manifest, warnings_from_row
from app.store.values import DRAFT_PREFIX, DRY_PREFIX, PENDING_NUMBER, Pending, Source, Version


def check_committed(ref: str | int) -> None:
    """Raise Invalid if a name of a version is that of a dry run or draft."""
    if isinstance(ref, str) and ref.startswith((DRY_PREFIX, DRAFT_PREFIX)):
        kind = "dry run" if ref.startswith(DRY_PREFIX) else "draft"
        reason = f"a {kind} is not a version that robots can get: commit it first, and use the number of the version"
        raise Invalid(reason, [Problem(reason, where="version")])


def content_values(prepared: Prepared, warnings: Sequence[Problem]) -> dict[str, Any]:
    """Return the columns that hold a prepared version."""
    return {
        "base": prepared.base,
        "root": prepared.root,
        "changed": prepared.changed,
        "changes": dict(prepared.changes),
        "warnings": [clean_problem(warning).as_dict() for warning in warnings],
        "manifest": pack_manifest(prepared.datum, prepared.levels, prepared.parts, prepared.templates),
    }


def as_version(
    environment: Row[Any], row: Row[Any], pending: Pending, *, author: str, message: str, sources: Sequence[Source] = ()
) -> Version:
    """Convert a row into the version that it holds. Its time is that of the dry run, or of the draft's last edit."""
    datum, levels, parts, templates = unpack_manifest(bytes(row.manifest))
    return Version(
        environment=environment.name,
        number=PENDING_NUMBER,
        root=row.root,
        parent=row.base,
        author=author,
        message=message,
        time=row.edited if pending.kind == "draft" else row.created,
        changes=row.changes,
        sources=tuple(sources),
        warnings=warnings_from_row(row.warnings),
        datum=datum,
        levels=levels,
        parts=parts,
        templates=templates,
        pending=pending,
    )


def as_prepared(version: Version) -> Prepared:
    """Return the change of a dry run or draft, to be committed. Its chunks and blobs are stored."""
    assert version.pending is not None
    assert version.parent is not None
    return Prepared(
        version.parent,
        version.root,
        {},
        version.parts,
        version.datum,
        version.levels,
        version.templates,
        dict(version.changes),
        changed=version.pending.changed,
        pending=version.pending,
    )

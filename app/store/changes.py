"""Change sets: the operations that make a version, and the prepared version that results."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Literal, NoReturn

from app.model.features import Features
from app.model.frame import Datum, Level
from app.model.layers import Part, PartKey
from app.model.templates import Templates
from app.store.values import Area, PartEntry, Pending, Provenance

__all__ = [
    "KEEP",
    "RAW",
    "Changes",
    "Delete",
    "Drop",
    "Keep",
    "Operation",
    "Prepared",
    "Provenance",
    "Put",
    "Replace",
]


class Keep(enum.Enum):
    """Sentinel for "leave unchanged"."""

    KEEP = "keep"

    def __setstate__(self, _: object) -> NoReturn:
        raise TypeError("a sentinel never changes")  # what app.answers requires of an enumeration


KEEP: Final = Keep.KEEP

RAW: Final = Provenance()
"""Provenance of content from a source."""


@dataclass(frozen=True, slots=True)
class Replace:
    """Replace the part under the key."""

    key: PartKey
    part: Part
    provenance: Provenance = RAW


@dataclass(frozen=True, slots=True)
class Put:
    """Add features, or replace those with the same id; members of the document are joined by key."""

    key: PartKey
    features: Features
    provenance: Provenance = RAW


@dataclass(frozen=True, slots=True)
class Delete:
    """Delete features. Raises NotFound if the part or an id is unknown."""

    key: PartKey
    ids: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Drop:
    """Delete the whole part. Raises NotFound if there is none."""

    key: PartKey


Operation = Replace | Put | Delete | Drop


@dataclass(frozen=True, slots=True)
class Changes:
    """Operations in order, with the new datum, levels and templates if they change."""

    operations: tuple[Operation, ...] = ()
    datum: Datum | Literal[Keep.KEEP] | None = KEEP
    levels: tuple[Level, ...] | Literal[Keep.KEEP] = KEEP
    templates: Templates | Literal[Keep.KEEP] = KEEP


@dataclass(frozen=True, slots=True)
class Prepared:
    """A version ready to be committed on top of version ``base``; plain data, so that it can cross processes.

    chunks: hash (hex) -> stored bytes of all chunks that are missing or damaged in the base. blobs: SHA-256 -> content
    of files that belong to the content (resources). changes: counts by layer. changed: whether the root differs from
    the base's, or the provenance of derived parts is renewed. area: KEEP if it is the base's, None if the next query
    computes it. pending: the dry run or draft that stored the content, which must still exist.
    """

    base: int
    root: str
    chunks: Mapping[str, bytes]
    parts: tuple[PartEntry, ...]
    datum: Datum | None
    levels: tuple[Level, ...]
    templates: Templates
    changes: dict[str, Any]
    changed: bool
    blobs: Mapping[str, bytes] = field(default_factory=dict)
    area: Area | Literal[Keep.KEEP] | None = None
    pending: Pending | None = None

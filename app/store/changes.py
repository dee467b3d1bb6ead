"""What a new version shall change, and what came out of preparing it."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Literal

from app.model.features import Features
from app.model.frame import Datum, Level
from app.model.layers import Part, PartKey
from app.model.templates import Templates
from app.store.values import Area, PartEntry, Provenance

__all__ = [
    "KEEP",
    "RAW",
    "Changes",
    "Delete",
    "Drop",
    "IndexRows",
    "Keep",
    "Operation",
    "Prepared",
    "Provenance",
    "Put",
    "Replace",
]


class Keep(enum.Enum):
    """The sentinel for "leave it as it is"."""

    KEEP = "keep"


KEEP: Final = Keep.KEEP

RAW: Final = Provenance()
"""It stands in a source."""


@dataclass(frozen=True, slots=True)
class Replace:
    """The part becomes this; what was under the key is gone."""

    key: PartKey
    part: Part
    provenance: Provenance = RAW


@dataclass(frozen=True, slots=True)
class Put:
    """Features are added or, where their id is known, replaced; members of the document are joined by key."""

    key: PartKey
    features: Features
    provenance: Provenance = RAW


@dataclass(frozen=True, slots=True)
class Delete:
    """Features go; NotFound where the part or an id is unknown."""

    key: PartKey
    ids: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Drop:
    """The whole part goes; NotFound where there is none."""

    key: PartKey


Operation = Replace | Put | Delete | Drop


@dataclass(frozen=True, slots=True)
class Changes:
    """Operations in order, and the datum, levels and templates where they are to change."""

    operations: tuple[Operation, ...] = ()
    datum: Datum | Literal[Keep.KEEP] | None = KEEP
    levels: tuple[Level, ...] | Literal[Keep.KEEP] = KEEP
    templates: Templates | Literal[Keep.KEEP] = KEEP


@dataclass(frozen=True, slots=True)
class IndexRows:
    """Changes to the head's spatial index: ids to remove, and (id, box in degrees, WKB in degrees) to put."""

    key: PartKey
    removed: tuple[str, ...]
    put: tuple[tuple[str, tuple[float, float, float, float], bytes], ...]


@dataclass(frozen=True, slots=True)
class Prepared:
    """A version ready to be committed on top of version ``base``; plain data, so it can cross processes.

    chunks: hash (hex) -> stored bytes of all chunks that the base does not have, or has damaged. blobs: SHA-256 ->
    content of files that belong to the content (resources). changes: counts by layer. changed: whether the root differs
    from the base's, or what says where the content comes from is renewed. index: the index' changes where they are few,
    else None (it is brought up to date when it is asked). area: KEEP if it is the base's, None if the next query
    computes it.
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
    index: tuple[IndexRows, ...] | None = None
    area: Area | Literal[Keep.KEEP] | None = None

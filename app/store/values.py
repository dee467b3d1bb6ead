"""Values of the store: frozen, free of SQLAlchemy, picklable, with aware times in UTC."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.errors import Invalid, Problem
from app.model.closures import Closures
from app.model.features import Features
from app.model.frame import Datum, Level
from app.model.layers import CONTENT_LAYERS, PartKey
from app.model.templates import NO_TEMPLATES, Templates

EDIT = "edit"
"""Name of the provenance step that an edit of derived content adds."""

Information = Literal["raw", "derived", "template", "generated"]
State = Literal["queued", "running", "done", "failed", "cancelled"]
Role = Literal["viewer", "robot", "mirror", "editor", "admin"]

Box = tuple[float, float, float, float]
"""A box (minimum x, minimum y, maximum x, maximum y), or in degrees (west, south, east, north).

In degrees, west > east means that the box crosses the antimeridian.
"""

Bounds = Mapping[Literal["local", "wgs84"], Box | None]
"""Boxes of a part's local items in metres and of its wgs84 items in degrees; None without such items."""

LATEST = "latest"
"""Name of the channel that always points to the head."""


@dataclass(frozen=True, slots=True)
class Environment:
    """An environment, in its current state.

    id: stays when the name changes. head: the newest version's number, root: its root hash (hex). bounds: (west,
    south, east, north) in degrees around all content, or None if nothing is on earth. sequence: of its last event.
    deleted: time of deletion, until it is restored or purged.
    """

    id: str
    name: str
    title: str
    description: str
    tags: tuple[str, ...]
    head: int
    root: str
    datum: Datum | None
    bounds: Box | None
    created: datetime
    updated: datetime
    deleted: datetime | None
    sequence: int = 0


MatchBasis = Literal["fence", "floor", "datum"]


@dataclass(frozen=True, slots=True)
class Area:
    """The area of an environment on earth, see ``app.store.area``.

    size: square metres. pieces: (box in degrees, WKB of a valid polygon in degrees), none across the antimeridian.
    """

    by: MatchBasis
    size: float
    pieces: tuple[tuple[Box, bytes], ...]


NO_AREA = Area("datum", 0.0, ())
"""Area of an environment without a position on earth."""


@dataclass(frozen=True, slots=True)
class Match:
    """Reason why a position is in an environment.

    by: what its area is taken from. area: square metres. distance: metres to the datum, None if there is none.
    """

    by: MatchBasis
    area: float
    distance: float | None

    def as_dict(self) -> dict[str, Any]:
        """Return the match as clients see it."""
        return {"by": self.by, "area_m2": self.area, "distance_m": self.distance}


@dataclass(frozen=True, slots=True)
class Source:
    """An uploaded file: its bytes are the blob ``sha256``. used: whether the version was made from it.

    removed: when a rule of retention removed the file.
    """

    name: str
    size: int
    sha256: str
    format: str | None = None
    used: bool = True
    removed: datetime | None = None

    def as_dict(self) -> dict[str, Any]:
        """Return the source as JSON; ``removed`` only if it was."""
        return {
            "name": self.name,
            "size": self.size,
            "sha256": self.sha256,
            "format": self.format,
            "used": self.used,
            **({} if self.removed is None else {"removed": rfc3339(self.removed)}),
        }


@dataclass(frozen=True, slots=True)
class Provenance:
    """Origin of a part's content. It is not part of any hash.

    information: whether it comes from a source, other layers, defaults or a generator. format: of the source. sources:
    names of the version's sources it was read from. upload: SHA-256 over the uploaded files of this part. steps: how it
    was computed, with parameters. attribution: licences and credits. inputs: of a derived part: ``{layer, level, name,
    hash}`` each, and ``{datum, levels}`` in a line of their own.
    """

    information: Information = "raw"
    format: str | None = None
    sources: tuple[str, ...] = ()
    upload: str | None = None
    steps: tuple[Mapping[str, Any], ...] = ()
    attribution: tuple[str, ...] = ()
    inputs: tuple[Mapping[str, Any], ...] = ()

    @property
    def is_edited(self) -> bool:
        """Return whether derived content was edited."""
        return any(step.get("step") == EDIT for step in self.steps)

    def with_edit_step(self) -> Provenance:
        """Add the step for an edit: edited content is not derived or generated again without confirmation."""
        if not (self.inputs or self.information == "generated") or self.is_edited:
            return self
        return replace(self, steps=(*self.steps, {"step": EDIT}))

    def as_dict(self) -> dict[str, Any]:
        """Return the JSON members, without the empty ones."""
        members: dict[str, Any] = {
            "information": self.information,
            "format": self.format,
            "sources": list(self.sources),
            "upload": self.upload,
            "steps": [dict(step) for step in self.steps],
            "attribution": list(self.attribution),
            "inputs": [dict(line) for line in self.inputs],
        }
        return {name: value for name, value in members.items() if value}

    @classmethod
    def from_dict(cls, members: Mapping[str, Any]) -> Provenance:
        """Read the result of ``as_dict``."""
        return cls(
            information=members.get("information", "raw"),
            format=members.get("format"),
            sources=tuple(members.get("sources", ())),
            upload=members.get("upload"),
            steps=tuple(members.get("steps", ())),
            attribution=tuple(members.get("attribution", ())),
            inputs=tuple(members.get("inputs", ())),
        )


@dataclass(frozen=True, slots=True)
class PartEntry:
    """A version's record of one part.

    hash: of the part's content (hex), the root of its tree. count: features, cells, voxels, pixels or files. bounds:
    boxes of its items. digest: hash of the canonical content in the order of the upload, empty after an edit; only a
    shortcut to detect an equal upload.
    """

    key: PartKey
    hash: str
    count: int
    bounds: Bounds
    provenance: Provenance
    digest: str = ""


def datum_information(datum: Datum, parts: Iterable[PartEntry]) -> Information:
    """Return whether the datum was set by people, or by the generator of one of the parts."""
    datum_values = datum.as_dict()
    made_up = any(step.get("datum") == datum_values for e in parts for step in e.provenance.steps)
    return "generated" if made_up else "raw"


PendingKind = Literal["dry", "draft"]

DRY_PREFIX, DRAFT_PREFIX = "dry:", "draft:"
"""Start of the name of a dry run and of a draft among the names of versions: ``dry:<id>``, ``draft:<id>``."""

PENDING_NUMBER = -1
"""``Version.number`` of a dry run or draft: no version has it."""


@dataclass(frozen=True, slots=True)
class Pending:
    """A version that is not committed: a dry run, or the content of a draft at one of its revisions.

    id: hexadecimal digits. expires: until when it can be read. changed: whether committing it makes a version.
    revision: rises with every edit of a draft; 0 for a dry run, which never changes.
    """

    kind: PendingKind
    id: str
    expires: datetime
    changed: bool
    revision: int = 0

    @property
    def ref(self) -> str:
        """Return the name by which it can be read like a version of its environment."""
        return f"{self.kind}:{self.id}"

    @property
    def tag(self) -> str:
        """Return a name of this content, which no later edit has."""
        return f"{self.ref}.{self.revision}" if self.kind == "draft" else self.ref


@dataclass(frozen=True, slots=True)
class Thinning:
    """When a rule of retention removed the content of a version, and which."""

    time: datetime
    rule: str


@dataclass(frozen=True, slots=True)
class Version:
    """An immutable state of an environment.

    environment: its name. changes: counts of changes against its parent, by layer. warnings: of its sources. parts:
    sorted by key. templates: values for formats that need more than the layers have. closures: those that its maps
    show; None: none (as it is stored). pending: set if it is not committed; number is then ``PENDING_NUMBER`` and time
    that of the dry run, or of the draft's last edit. tags: its names, sorted. thinned: set if its content was removed:
    it has no parts then.
    """

    environment: str
    number: int
    root: str
    parent: int | None
    author: str
    message: str
    time: datetime
    changes: Mapping[str, Any]
    sources: tuple[Source, ...]
    warnings: tuple[Problem, ...]
    datum: Datum | None
    levels: tuple[Level, ...]
    parts: tuple[PartEntry, ...]
    templates: Templates = NO_TEMPLATES
    closures: Closures | None = None
    pending: Pending | None = None
    tags: tuple[str, ...] = ()
    thinned: Thinning | None = None

    @property
    def ref(self) -> int | str:
        """Return the name by which it can be read: its number, ``dry:<id>`` or ``draft:<id>``."""
        return self.number if self.pending is None else self.pending.ref

    def part(self, key: PartKey) -> PartEntry | None:
        """Return the entry of a part, or None."""
        return next((entry for entry in self.parts if entry.key == key), None)

    @property
    def stale(self) -> dict[PartKey, tuple[str, ...]]:
        """Return derived parts with changed inputs, each with the inputs that have changed."""
        now = {(e.key.layer, e.key.level, e.key.name): e.hash for e in self.parts if e.count}
        out: dict[PartKey, tuple[str, ...]] = {}
        for entry in self.parts:
            changed = []
            for line in entry.provenance.inputs:
                if "layer" not in line:
                    frame = frame_input(self.datum, self.levels)
                    if line != {name: frame.get(name) for name in line}:
                        changed.append("datum or levels" if "levels" in line else "datum")
                elif now.get((line["layer"], line["level"], line["name"])) != line["hash"]:
                    changed.append(f"{line['layer']} {line['level']}/{line['name']}")
            used = {(n["layer"], n["level"], n["name"]) for n in entry.provenance.inputs if "layer" in n}
            layers = {layer for layer, _, _ in used}
            steps = entry.provenance.steps
            layers |= {layer for step in steps for layer in step.get("also", ()) if layer != entry.key.layer}
            if any("location" in step.get("from", ()) for step in steps):
                layers.add("location")  # the one layer that a step can do without: a datum is sufficient
            identity = (entry.key.layer, entry.key.level, entry.key.name)
            new = (
                [k for k in now if k[0] in layers and k not in used and k != identity]
                if entry.provenance.inputs
                else []
            )
            changed += [f"{layer} {level}/{name}" for layer, level, name in new]
            if changed:
                out[entry.key] = tuple(changed)
        return out

    @property
    def information(self) -> dict[str, str]:
        """Return for each of the seven layers raw, derived, template, generated, or missing; raw takes precedence."""
        order = ("raw", "derived", "generated", "template")
        out: dict[str, str] = {}
        for layer in CONTENT_LAYERS:
            kinds = {e.provenance.information for e in self.parts if e.key.layer == layer and e.count}
            if layer == "location" and self.datum is not None and not kinds:
                kinds = {datum_information(self.datum, self.parts)}
            out[layer] = next((kind for kind in order if kind in kinds), "missing")
        return out

    def _describe_stale(self, key: PartKey, changed: tuple[str, ...]) -> dict[str, Any]:
        entry = self.part(key)
        last = entry.provenance.steps[-1] if entry is not None and entry.provenance.steps else {}
        return {
            "layer": key.layer,
            "level": key.level,
            "name": key.name,
            "changed": list(changed),
            "method": last.get("step"),
            "parameters": last.get("parameters", {}),
        }

    def as_dict(self) -> dict[str, Any]:
        """Return the version as JSON; of a dry run or draft without number and time, but with ``id`` and expiry."""
        pending, thinned = self.pending, self.thinned
        revision = pending.revision if pending is not None and pending.kind == "draft" else None
        return {
            "environment": self.environment,
            "version": self.number if pending is None else None,
            "root": self.root,
            "parent": self.parent,
            "author": self.author,
            "message": self.message,
            "time": rfc3339(self.time) if pending is None else None,
            "changes": dict(self.changes),
            "sources": [source.as_dict() for source in self.sources],
            "warnings": [warning.as_dict() for warning in self.warnings],
            "information": self.information,
            "stale": [self._describe_stale(key, changed) for key, changed in self.stale.items()],
            "tags": list(self.tags),
            **({} if thinned is None else {"thinned": {"time": rfc3339(thinned.time), "rule": thinned.rule}}),
            **({} if pending is None else {"id": self.ref, "expires": rfc3339(pending.expires), "revision": revision}),
        }


@dataclass(frozen=True, slots=True)
class Writer:
    """Who edits drafts: the id and name of a token, and whether it may write those of others."""

    id: str
    name: str
    is_admin: bool = False


@dataclass(frozen=True, slots=True)
class Draft:
    """A named working version of an environment, which edits gather in until it is committed or deleted.

    base: number of the version that it was made from or rebased on. head: that of the environment. revision: rises with
    every edit. changed: time of the last one. changes: counts against the base, by layer.
    """

    id: str
    environment: str
    name: str
    owner: str
    owner_id: str
    base: int
    head: int
    revision: int
    created: datetime
    changed: datetime
    expires: datetime
    changes: Mapping[str, Any]

    @property
    def ref(self) -> str:
        """Return the name by which it can be read like a version of its environment."""
        return DRAFT_PREFIX + self.id

    @property
    def tag(self) -> str:
        """Return the name of its present content, as ``Pending.tag``."""
        return f"{self.ref}.{self.revision}"

    def may_write(self, writer: Writer) -> bool:
        """Test if somebody may edit, commit and delete it: its owner, or an administrator."""
        return writer.is_admin or writer.id == self.owner_id

    def as_dict(self) -> dict[str, Any]:
        """Return the draft as JSON."""
        return {
            "id": self.id,
            "version": self.ref,
            "environment": self.environment,
            "name": self.name,
            "owner": self.owner,
            "base": self.base,
            "head": self.head,
            "behind": self.head != self.base,
            "revision": self.revision,
            "created": rfc3339(self.created),
            "changed": rfc3339(self.changed),
            "expires": rfc3339(self.expires),
            "changes": dict(self.changes),
        }


def frame_input(datum: Datum | None, levels: Sequence[Level]) -> dict[str, Any]:
    """Return datum and levels as a line among a derivation's inputs."""
    return {
        "datum": datum.as_dict() if datum else None,
        "levels": [[level.name, level.elevation] for level in levels],
    }


@dataclass(frozen=True, slots=True)
class Event:
    """One row of the log. sequence: of the environment, without gaps. body: the event as JSON.

    position: in the whole log, increasing by one, so that one reader can follow all environments. environment_id: stays
    when the name changes.
    """

    sequence: int
    environment: str
    body: Mapping[str, Any]
    time: datetime
    position: int = 0
    environment_id: str = ""


@dataclass(frozen=True, slots=True)
class Token:
    """An access token without its secret.

    environments: a name pattern (fnmatch), None for all. ended: when it was found to have expired; it stays expired.
    used: when it was last used, to the hour.
    """

    id: str
    name: str
    role: Role
    environments: str | None
    robot: str | None
    expires: datetime | None
    created: datetime
    ended: datetime | None = None
    used: datetime | None = None


@dataclass(frozen=True, slots=True)
class Idempotency:
    """A client's key for one request, with a fingerprint of its content. Raises Invalid for an invalid key."""

    key: str
    fingerprint: str

    def __post_init__(self) -> None:
        if not 1 <= len(self.key) <= 255 or not self.key.isprintable():
            raise Invalid("an Idempotency-Key must have 1 to 255 printable characters")


@dataclass(frozen=True, slots=True)
class Job:
    """Long-running work. progress: 0 to 1. problem: the reason of a failure, as an RFC 9457 object.

    step: what a running one does now, None if unknown.
    task: key of the task that it waits for, if that is in the queue of all servers. outcome: of that task.
    """

    id: str
    state: State
    progress: float
    detail: str
    result: Mapping[str, Any] | None
    problem: Mapping[str, Any] | None
    created: datetime
    updated: datetime
    owner: str
    task: str | None = None
    outcome: Mapping[str, Any] | None = None
    step: str | None = None


@dataclass(frozen=True, slots=True)
class FeatureDelta:
    """Changes of a vector part from one version to another; a moved feature is one put."""

    key: PartKey
    put: Features
    deleted: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class ChangedCells:
    """Changed cells: uint8 [height, width] with cells[0, 0] at (row, column), row 0 at the bottom."""

    row: int
    column: int
    cells: NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class GridDelta:
    """Changes of a grid from one version to another.

    whole: the grid's frame (size, resolution, origin, mode) changed or the grid is new, so that the client must load
    it; rectangles is then empty. deleted: the grid was deleted.
    """

    key: PartKey
    rectangles: tuple[ChangedCells, ...]
    whole: bool = False
    deleted: bool = False


@dataclass(frozen=True, slots=True)
class Delta:
    """Changes between two versions. other: changed parts that are neither vectors nor grids."""

    features: tuple[FeatureDelta, ...] = ()
    grids: tuple[GridDelta, ...] = ()
    other: tuple[PartKey, ...] = ()
    datum: bool = False
    levels: bool = False


class Position(NamedTuple):
    """Position of a manifest in its channel's history.

    sequence: of the event that led to it. edge: number of changes that a mirror made by itself until then. epoch: of
    the server that a mirror follows; None: of this server.
    """

    sequence: int
    edge: int = 0
    epoch: int | None = None


def rfc3339(time: datetime) -> str:
    """Format a time in UTC with microseconds and a Z."""
    return time.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")

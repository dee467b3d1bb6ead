"""What the store hands out: frozen values, free of SQLAlchemy, picklable, all times aware and in UTC."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from datetime import UTC, datetime
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from app.errors import Problem
from app.model.closures import NO_CLOSURES, Closure, Closures
from app.model.features import Features
from app.model.frame import Datum, Level
from app.model.layers import CONTENT_LAYERS, PartKey
from app.model.templates import NO_TEMPLATES, Templates

EDIT = "edit"
"""The step that people's changes leave in the provenance of what was derived."""

Information = Literal["raw", "derived", "template", "generated"]
State = Literal["queued", "running", "done", "failed", "cancelled"]
RobotState = Literal["downloading", "ready", "active", "failed"]
Role = Literal["viewer", "robot", "editor", "admin"]

Box = tuple[float, float, float, float]
"""(minimum x, minimum y, maximum x, maximum y); in degrees (west, south, east, north), where west > east means that
the box crosses the antimeridian."""

Bounds = Mapping[Literal["local", "wgs84"], Box | None]
"""The box of a part's local items in metres and of its wgs84 items in degrees; None where it has none of them."""

LATEST = "latest"
"""The channel that moves by itself: the head."""


@dataclass(frozen=True, slots=True)
class Environment:
    """A mapped place, as it is now.

    id: stays when the name changes. head: the newest version's number, root: its root hash (hex). bounds: (west,
    south, east, north) in degrees around all that it holds, or None where nothing is on earth. sequence: of its last
    event. deleted: since when it waits for being restored or purged.
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
"""Of an environment without a place on earth."""


@dataclass(frozen=True, slots=True)
class Match:
    """The reason why a position is in an environment.

    by: what its area is taken from. area: square metres. distance: metres to the datum, None if there is none.
    """

    by: MatchBasis
    area: float
    distance: float | None

    def as_dict(self) -> dict[str, Any]:
        """The match as clients see it."""
        return {"by": self.by, "area_m2": self.area, "distance_m": self.distance}


@dataclass(frozen=True, slots=True)
class Source:
    """An uploaded file: its bytes are the blob ``sha256``. used: whether the version was made from it."""

    name: str
    size: int
    sha256: str
    format: str | None = None
    used: bool = True

    def as_dict(self) -> dict[str, Any]:
        """The source as JSON."""
        return {
            "name": self.name,
            "size": self.size,
            "sha256": self.sha256,
            "format": self.format,
            "used": self.used,
        }


@dataclass(frozen=True, slots=True)
class Provenance:
    """Where a part's content comes from. It does not count for any hash.

    information: it stands in a source, was computed from other layers, filled in, or made up. format: of the source.
    sources: names of the version's sources that gave it. upload: SHA-256 over the uploaded files of this part. steps:
    how it was computed, with parameters. attribution: licences and credits. inputs: of a derived part, what it was
    computed from: ``{layer, level, name, hash}``, and ``{datum, levels}`` in a line of their own.
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
        """Whether people have changed what was derived."""
        return any(step.get("step") == EDIT for step in self.steps)

    def with_edit_step(self) -> Provenance:
        """After people's changes: what was derived or generated is no longer made anew without a word."""
        if not (self.inputs or self.information == "generated") or self.is_edited:
            return self
        return replace(self, steps=(*self.steps, {"step": EDIT}))

    def as_dict(self) -> dict[str, Any]:
        """JSON-like members, without the empty ones."""
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
        """The reverse of ``as_dict``."""
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
    """A version's line about one part.

    hash: of the part's content (hex), the root of its tree. count: features, cells, voxels, pixels or files. bounds:
    where its items lie. digest: hash of the canonical content in the order it was uploaded, empty after an edit; only
    a short cut for "the same again".
    """

    key: PartKey
    hash: str
    count: int
    bounds: Bounds
    provenance: Provenance
    digest: str = ""


def datum_information(datum: Datum, parts: Iterable[PartEntry]) -> Information:
    """Whether people told the datum, or a generator made it up with one of the parts."""
    datum_values = datum.as_dict()
    made_up = any(step.get("datum") == datum_values for e in parts for step in e.provenance.steps)
    return "generated" if made_up else "raw"


@dataclass(frozen=True, slots=True)
class Version:
    """An immutable state of an environment.

    environment: its name. changes: counts of what this version changed against its parent, by layer. warnings: what
    was doubtful in its sources. parts: sorted by key. templates: what is filled in where a format asks for more than
    the layers have. closures: those that its maps show; None: none (as it is stored).
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

    def part(self, key: PartKey) -> PartEntry | None:
        """The entry of a part, or None."""
        return next((entry for entry in self.parts if entry.key == key), None)

    @property
    def stale(self) -> dict[PartKey, tuple[str, ...]]:
        """Derived parts whose inputs are no longer what they were computed from, each with what has changed."""
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
            layers |= {layer for step in steps for layer in step.get("also", ())}
            if any("location" in step.get("from", ()) for step in steps):
                layers.add("location")  # the one layer that a step may have done without: a datum is location enough
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
        """For each of the seven layers raw, derived, template, generated, or missing; raw beats the others."""
        order = ("raw", "derived", "generated", "template")
        out: dict[str, str] = {}
        for layer in CONTENT_LAYERS:
            kinds = {e.provenance.information for e in self.parts if e.key.layer == layer and e.count}
            if layer == "location" and self.datum is not None and not kinds:
                kinds = {datum_information(self.datum, self.parts)}
            out[layer] = next((kind for kind in order if kind in kinds), "missing")
        return out

    def as_dict(self) -> dict[str, Any]:
        """The version as JSON."""
        return {
            "environment": self.environment,
            "version": self.number,
            "root": self.root,
            "parent": self.parent,
            "author": self.author,
            "message": self.message,
            "time": rfc3339(self.time),
            "changes": dict(self.changes),
            "sources": [source.as_dict() for source in self.sources],
            "warnings": [warning.as_dict() for warning in self.warnings],
            "information": self.information,
            "stale": [
                {"layer": k.layer, "level": k.level, "name": k.name, "changed": list(changed)}
                for k, changed in self.stale.items()
            ],
        }


def frame_input(datum: Datum | None, levels: Sequence[Level]) -> dict[str, Any]:
    """Datum and levels as a line among a derivation's inputs."""
    return {
        "datum": datum.as_dict() if datum else None,
        "levels": [[level.name, level.elevation] for level in levels],
    }


RolloutState = Literal["waiting", "watching", "done", "expired", "failed", "rolled_back", "cancelled"]
OPEN_ROLLOUTS: tuple[RolloutState, ...] = ("waiting", "watching")


@dataclass(frozen=True, slots=True)
class Rollout:
    """A move in two stages: robots fetch the version first, and are watched after it.

    ready: the channel moves when this share of its online robots has the version (None: at its time alone). failed: it
    moves back, or does not move at all, when this share says that it failed. deadline: the move is given up then.
    window: seconds of watching. before: the version that it moves back to. state: ``waiting`` until it moves,
    ``watching`` after it, then how it ended. said_before: robots that said already that they failed with this version
    when its present stage began, and when that was heard: what came after it is told by this, not by comparing clocks.
    """

    version: int
    root: str
    started: datetime
    ready: float | None = None
    failed: float | None = None
    activate_at: datetime | None = None
    deadline: datetime | None = None
    window: float = 600.0
    state: RolloutState = "waiting"
    before: int | None = None
    moved: datetime | None = None
    detail: str = ""
    said_before: Mapping[str, str] = field(default_factory=dict)

    def as_row(self) -> dict[str, Any]:
        """JSON-like, with all members, as it is stored."""
        out: dict[str, Any] = {}
        for item in fields(self):
            value = getattr(self, item.name)
            out[item.name] = rfc3339(value) if isinstance(value, datetime) else value
        return out

    def as_dict(self) -> dict[str, Any]:
        """JSON-like, what clients see of it."""
        return {name: value for name, value in self.as_row().items() if name != "said_before"}

    @classmethod
    def from_row(cls, members: Mapping[str, Any]) -> Rollout:
        """The reverse of ``as_row``; rows of earlier releases have no ``said_before``."""
        values = dict(members)
        for name in ("started", "activate_at", "deadline", "moved"):
            values[name] = None if values[name] is None else datetime.fromisoformat(values[name])
        return cls(**values)


@dataclass(frozen=True, slots=True)
class RolloutStep:
    """What a roll-out does next: move, move back, or end as ``state`` says; and why."""

    do: Literal["move", "move_back", "end"]
    state: RolloutState
    detail: str


@dataclass(frozen=True, slots=True)
class PlannedMove:
    """A channel's next move. activate_at: None where it waits for robots alone."""

    version: int
    activate_at: datetime | None
    author: str = ""
    root: str = ""


@dataclass(frozen=True, slots=True)
class Channel:
    """A movable name for a version. version and root are None where the first move is still planned.

    sequence: of the event that moved it last (``latest``: of the event that made the head). rollout: the last one.
    closures: those in force, and closures_sequence: of the last event that changed them.
    """

    name: str
    version: int | None
    root: str | None
    sequence: int
    planned: PlannedMove | None
    author: str
    time: datetime
    rollout: Rollout | None = None
    closures: Closures = NO_CLOSURES
    closures_sequence: int = 0


@dataclass(frozen=True, slots=True)
class Event:
    """One row of the log. sequence: of the environment, without gaps. body: the event as JSON.

    position: of the whole log, growing by one, so that one reader can follow all environments.
    """

    sequence: int
    environment: str
    body: Mapping[str, Any]
    time: datetime
    position: int = 0


@dataclass(frozen=True, slots=True)
class Token:
    """An access token without its secret.

    environments: a name pattern (fnmatch), None for all. ended: when it was seen to have expired; it stays expired.
    """

    id: str
    name: str
    role: Role
    environments: str | None
    robot: str | None
    expires: datetime | None
    created: datetime
    ended: datetime | None = None


@dataclass(frozen=True, slots=True)
class Idempotency:
    """A client's key for one request, and a fingerprint of the request's content."""

    key: str
    fingerprint: str


@dataclass(frozen=True, slots=True)
class Job:
    """Work that takes long. progress: 0 to 1. problem: why it failed, as an RFC 9457 object."""

    id: str
    state: State
    progress: float
    detail: str
    result: Mapping[str, Any] | None
    problem: Mapping[str, Any] | None
    created: datetime
    updated: datetime
    owner: str


@dataclass(frozen=True, slots=True)
class RobotReport:
    """What a robot says of itself. reported_at: when, by its own clock. sequence: of the last event that it has
    processed.

    holds: version and root that it has loaded, ``NO_ROOT`` for none; None where it does not say. It is not part of the
    history. overlays: digest of the closures in the map that it has loaded; None from robots that know of none.
    """

    channel: str
    version: int
    root: str
    state: RobotState
    detail: str | None = None
    sequence: int | None = None
    reported_at: datetime | None = None
    overlays: str | None = None
    holds: tuple[int, str] | None = None


@dataclass(frozen=True, slots=True)
class ReceivedReport:
    """A report, of whom, and when it was heard by the server's clock.

    vouched: whether it came with authority: with a token that may report for the robot, or over a router with users.
    """

    environment: str
    robot: str
    report: RobotReport
    time: datetime
    vouched: bool = True


@dataclass(frozen=True, slots=True)
class ActiveMap:
    """What a robot drives on. sequence: of the event that it acted on, where it says so. since: server's clock.
    overlays: digest of the closures in it.
    """

    version: int
    root: str
    sequence: int | None
    since: datetime
    overlays: str | None = None

    def shows(self, root: str | None, overlays: str) -> bool:
        """Whether this is the map of a root and of closures, given by their digest."""
        return self.root == root and (self.overlays or NO_CLOSURES.digest) == overlays


@dataclass(frozen=True, slots=True)
class Robot:
    """A robot in one environment, as it is now.

    time: of its last report. since: when it first said the same. on_bus: its liveliness on the bus, as of
        ``presence_at``;
    None where it never was on the bus. vouched: whether any of its reports came with authority, so that it counts in
    roll-outs.
    """

    robot: str
    environment: str
    report: RobotReport
    time: datetime
    since: datetime
    held: ActiveMap | None
    on_bus: bool | None = None
    presence_at: datetime | None = None
    vouched: bool = True

    def has_failed_with(self, root: str) -> bool:
        """Whether it says that it failed with a version."""
        return self.report.state == "failed" and self.report.root == root


@dataclass(frozen=True, slots=True)
class ChannelMove:
    """An event that brought a channel to a version."""

    sequence: int
    version: int
    root: str
    time: datetime


NO_ROOT: Final = "0" * 64
"""Root that a robot without a map reports."""

OverlayState = Literal["pending", "accepted", "rejected", "expired", "ended"]


@dataclass(frozen=True, slots=True)
class Overlay:
    """Something that is blocked until ``expires``: a GeoJSON polygon in ``crs``, or an edge by its id.

    state: ``pending`` until an editor accepts or rejects it or its time is over (``expired``). An accepted one is in
    force on every channel until it has ``ended``. version: the one that made it permanent, or into which a release
    before closures put it.
    """

    environment: str
    kind: str
    level: str
    polygon: Mapping[str, Any] | None
    edge: str | None
    crs: str | None
    detail: str | None
    reporter: str
    created: datetime
    expires: datetime
    id: str = ""
    state: OverlayState = "pending"
    decided_by: str | None = None
    decided: datetime | None = None
    version: int | None = None

    def as_dict(self) -> dict[str, Any]:
        """The overlay as clients see it, without its empty members."""
        out: dict[str, Any] = {"id": self.id, "environment": self.environment, "kind": self.kind}
        out |= {"state": self.state, "level": self.level, "reporter": self.reporter}
        out |= {"created": rfc3339(self.created), "expires": rfc3339(self.expires)}
        more: dict[str, Any] = {
            "polygon": self.polygon,
            "edge": self.edge,
            "crs": self.crs,
            "detail": self.detail,
            "decided_by": self.decided_by,
            "decided": rfc3339(self.decided) if self.decided else None,
            "version": self.version,
        }
        return out | {name: value for name, value in more.items() if value is not None}

    @property
    def closure(self) -> Closure:
        """What it closes while it is in force."""
        end = rfc3339(self.expires)
        return Closure(self.id, self.kind, self.level, end, self.edge, self.polygon, self.crs, self.detail)


@dataclass(frozen=True, slots=True)
class FeatureDelta:
    """What turns a vector part of one version into that of another: a moved feature is one put."""

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
    """What turns a grid of one version into that of another.

    whole: the grid's frame (size, resolution, origin, mode) changed or the grid is new, so that only loading it helps;
    rectangles is empty then. deleted: it is gone.
    """

    key: PartKey
    rectangles: tuple[ChangedCells, ...]
    whole: bool = False
    deleted: bool = False


@dataclass(frozen=True, slots=True)
class Delta:
    """What changed in meaning between two versions. other: changed parts that are neither vectors nor grids."""

    features: tuple[FeatureDelta, ...] = ()
    grids: tuple[GridDelta, ...] = ()
    other: tuple[PartKey, ...] = ()
    datum: bool = False
    levels: bool = False


@dataclass(frozen=True, slots=True)
class FeatureHit:
    """A feature of some environment's head that stands in a box on earth: box in degrees."""

    environment: str
    key: PartKey
    id: str
    box: Box = field(default=(0.0, 0.0, 0.0, 0.0))


def rfc3339(time: datetime) -> str:
    """UTC with microseconds and a Z."""
    return time.astimezone(UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")

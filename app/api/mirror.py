"""What a server that mirrors this one reads, and what it hands on: the side of the centre (``fleetmap mirror``).

Answers that state what is current are signed by the key that signs manifests, and contain the request's ``nonce``, so
that no one in between can change or repeat them. Content is checked by its hashes.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Annotated, Any, Literal

import ormsgpack
from fastapi import Query
from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import Response, StreamingResponse

from app.api.http.auth import MirrorRole
from app.api.http.dependencies import Services, ServicesDep
from app.api.http.responses import api_router, json_bytes, json_response
from app.api.http.schemas import NAME, ApiTime, EnvironmentPath, RequestModel, problem_responses
from app.api.overlays import check_place, parse_polygon, shown_versions
from app.errors import Conflict, FleetMapError, Invalid, NotFound, Problem, Unavailable
from app.events.messages import ROBOT_NAME, RobotStatus
from app.fleet import report_from_status
from app.signing import delegation_statement
from app.store import blob_coding
from app.store.blob_rows import BlobRow
from app.store.edge_changes import OverlayChange
from app.store.fleet_values import Overlay, ReceivedReport
from app.store.mirror_source import PREFIX_BYTES, SIGNATURE
from app.store.values import rfc3339

TYPE = "application/octet-stream"
MAX_REPORTS = 1000
MAX_ENVIRONMENTS = 1000
MAX_BLOBS = 1000
STREAM_BATCH = 200
MAX_AHEAD = timedelta(seconds=60)
"""Maximum lead of a mirror's clock; later times are set to the present."""

Nonce = Annotated[
    str,
    Query(
        pattern=r"^[A-Za-z0-9_-]{16,64}$",
        description="Random text that the signed answer repeats.",
        examples=["c2lsZW50LW5vbmNl"],
    ),
]


class MirroredItem(BaseModel):
    """Environment that can be mirrored. sequence: of its last event."""

    id: str
    name: str
    sequence: int
    updated: datetime


class MirrorListOut(BaseModel):
    """Environments that the token may mirror, also deleted ones; null if nothing has happened since `position`."""

    form: int = Field(description="Number of the form of these documents.")
    epoch: int
    position: int = Field(description="Position of the event log.")
    allowed: str | None = Field(description="Pattern of the token's environments; null: all.")
    environments: list[MirroredItem] | None
    nonce: str


class MirrorPageOut(BaseModel):
    """What happened in an environment after a sequence."""

    form: int
    epoch: int
    environment: dict[str, Any]
    base: dict[str, Any] | None = Field(description="The version `after`; null if there is none.")
    upto: int = Field(description="Sequence up to which the page reaches.")
    last: int = Field(description="Number of the newest version of the page.")
    complete: bool = Field(description="Whether nothing follows the page.")
    versions: list[dict[str, Any]]
    events: list[dict[str, Any]]
    channels: list[dict[str, Any]]
    overlays: list[dict[str, Any]]
    tags: list[dict[str, Any]]
    thinned: list[dict[str, Any]] = Field(
        description="Versions up to `after` whose content was removed since `thinned`: `{first, last, time, rule}`."
    )
    chunks: str = Field(description="Beginnings (8 bytes each) of the hashes of the chunks of these versions, base64.")
    nonce: str


class ContentBody(RequestModel):
    """Content that a mirror lacks."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"after": -1, "last": 1, "chunks": True}]})

    after: int = Field(ge=-1, lt=2**31, description="Newest version that the mirror has; -1: none.")
    last: int = Field(ge=0, lt=2**31, description="Newest version of the page.")
    chunks: bool = Field(False, description="Send the chunks of these versions.")
    present: str = Field("", description="Beginnings of the hashes of chunks to leave out, base64.")
    blobs: list[Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]] = Field(
        [], max_length=MAX_BLOBS, description="Files to send, by SHA-256."
    )
    whole: bool = Field(False, description="Send files without reference to others that the mirror may lack.")


class EdgeStatusBody(RequestModel):
    """A robot's status that a mirror received."""

    robot: str = Field(pattern=f"^{ROBOT_NAME.pattern}$")
    status: dict[str, Any] = Field(description="As in `PUT /robots/{robot}/status`, without the environment.")
    received: ApiTime
    vouched: bool


class EdgeOverlayBody(RequestModel):
    """An overlay after a change that a mirror made."""

    id: str = Field(pattern=r"^[0-9a-f]{1,32}$")
    kind: Literal["blocked"]
    level: str = Field(min_length=1, max_length=256)
    reporter: str = Field(max_length=1000)
    created: ApiTime
    expires: ApiTime
    polygon: dict[str, Any] | None = None
    edge: str | None = Field(None, max_length=512)
    crs: Literal["local", "wgs84"] | None = None
    detail: str | None = Field(None, max_length=20_000)
    decided_by: str | None = Field(None, max_length=1000)
    decided: ApiTime | None = None


class EdgeChangeBody(RequestModel):
    """A change of an overlay that a mirror made."""

    event: str = Field(max_length=40, description="`overlay.created`, `.accepted`, `.rejected` or `.ended`.")
    overlay: EdgeOverlayBody
    author: str = Field(max_length=1000)
    time: ApiTime


class ReportsBody(RequestModel):
    """What a mirror received, in order."""

    model_config = ConfigDict(json_schema_extra={"examples": [{"statuses": [], "changes": []}]})

    statuses: list[EdgeStatusBody] = Field([], max_length=MAX_REPORTS)
    changes: list[EdgeChangeBody] = Field([], max_length=MAX_REPORTS)


class ChangeResultOut(BaseModel):
    """Outcome of a change. problem: why it is not in force here. overlay: as it is here; null if there is none."""

    problem: str | None
    overlay: dict[str, Any] | None


class ReportsOut(BaseModel):
    """Outcome of each item. statuses: null, or why one was not stored."""

    statuses: list[str | None]
    changes: list[ChangeResultOut]


class DelegationsBody(RequestModel):
    """Key of a mirror."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"public_key": base64.b64encode(bytes(32)).decode(), "environments": []}]}
    )

    public_key: str = Field(max_length=64, description="Raw Ed25519 public key, base64.")
    environments: list[Annotated[str, Field(pattern=NAME)]] = Field(max_length=MAX_ENVIRONMENTS)


class DelegationOut(BaseModel):
    """Statement that a key may sign the manifests of one environment until a time; bytes in base64."""

    environment: str
    environment_id: str
    statement: str
    signed_by: str
    signature: str
    until: datetime


router = api_router("mirrors")


@router.get("/mirror", responses=problem_responses(MirrorListOut), summary="List what a mirror may follow")
def list_mirrored(
    services: ServicesDep,
    principal: MirrorRole,
    nonce: Nonce,
    position: Annotated[
        int, Query(ge=0, lt=2**63, description="Position of the event log up to which the mirror has everything.")
    ] = 0,
) -> Response:
    """List environments with their last sequence, also deleted ones, signed as a manifest is."""
    listing = services.store.mirror_source.listing(principal.environments, position)
    return _signed(services, {**listing, "nonce": nonce})


@router.get(
    "/environments/{env}/mirror",
    responses=problem_responses(MirrorPageOut, 404, 409),
    summary="Get what a mirror lacks of an environment",
)
def get_mirror_page(
    env: EnvironmentPath,
    services: ServicesDep,
    _: MirrorRole,
    nonce: Nonce,
    after: Annotated[int, Query(ge=-1, lt=2**31, description="Newest version that the mirror has.")] = -1,
    sequence: Annotated[int, Query(ge=0, lt=2**63, description="Newest event that the mirror has.")] = 0,
    thinned: Annotated[
        ApiTime | None, Query(description="Time up to which the mirror has removed thinned versions.")
    ] = None,
) -> Response:
    """Return events, versions, channels and overlays after a sequence, also of a deleted environment.

    Signed as a manifest is. The content is named by hashes; a mirror requests what it lacks.
    """
    return _signed(services, {**services.store.mirror_source.page(env, after, sequence, thinned), "nonce": nonce})


@router.post(
    "/environments/{env}/mirror/content",
    response_class=Response,
    responses={200: {"description": "Chunks and files", "content": {TYPE: {}}}, **problem_responses(None, 404)},
    summary="Get chunks and files of versions",
)
def get_mirror_content(env: EnvironmentPath, body: ContentBody, services: ServicesDep, _: MirrorRole) -> Response:
    """Return chunks, then files of the given versions, as they are stored.

    A chunk: its length (4 bytes, big-endian) and its compressed bytes. A file: the length of its head (4 bytes), a
    MessagePack array `[sha256, size, coding, base, length]`, and so many bytes. Other content of this server cannot
    be requested.
    """
    content = services.store.mirror_source.content(env, body.after, body.last)
    foreign = next((name for name in body.blobs if name not in content.blobs), None)
    if foreign is not None:
        raise NotFound(f"versions {body.after + 1} to {body.last} of {env} have no file {foreign}")
    present = _prefixes(body.present)
    chosen = [name for name in content.chunks if name[:PREFIX_BYTES] not in present] if body.chunks else []
    rows = services.store.blobs.rows(body.blobs)
    lost = next((name for name in body.blobs if name not in rows), None)
    if lost is not None:
        raise NotFound(f"the file {lost} is lost on the centre: run `fleetmap verify --repair` there")
    return StreamingResponse(
        _stream(services, chosen, [rows[name] for name in body.blobs], whole=body.whole), media_type=TYPE
    )


def _stream(services: Services, chunks: Sequence[bytes], rows: Iterable[BlobRow], *, whole: bool) -> Iterator[bytes]:
    for start in range(0, len(chunks), STREAM_BATCH):
        stored = services.store.chunks.stored(chunks[start : start + STREAM_BATCH])
        yield b"".join(len(data).to_bytes(4) + data for _, data in stored)
    for row in rows:
        if row.base is not None and whole:
            plain = services.store.blobs.get(row.name)
            packed = blob_coding.compress_bytes(plain)
            data = plain if packed is None else packed
            yield _file_head(BlobRow(row.name, row.size, stored=len(data), coding=None if packed is None else "zstd"))
            yield data
            continue
        yield _file_head(row)
        yield from services.store.blobs.encoded(row)


def _file_head(row: BlobRow) -> bytes:
    head = ormsgpack.packb([row.name, row.size, row.coding, row.base, row.stored])
    return len(head).to_bytes(4) + head


def _prefixes(text: str) -> set[bytes]:
    try:
        data = base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError):
        raise Invalid("present is no base64", [Problem("must be base64", where="body.present")]) from None
    return {data[k : k + PREFIX_BYTES] for k in range(0, len(data), PREFIX_BYTES)}


@router.post(
    "/environments/{env}/mirror/reports",
    responses=problem_responses(ReportsOut, 400, 404, 415),
    summary="Hand on what a mirror received",
)
def store_mirror_reports(env: EnvironmentPath, body: ReportsBody, services: ServicesDep, _: MirrorRole) -> Response:
    """Store statuses of robots and changes of overlays that a mirror received, with their own times.

    A repetition changes nothing. A status that is older than the robot's last one is stored in its history.
    """
    services.store.environments.get(env)
    now = datetime.now(UTC)
    received: list[ReceivedReport | str] = [_as_received(env, line, now) for line in body.statuses]
    problems = iter(services.store.robots.note_reports([r for r in received if isinstance(r, ReceivedReport)]))
    statuses: list[str | None] = []
    for one in received:
        problem = one if isinstance(one, str) else next(problems)
        statuses.append(problem.detail if isinstance(problem, FleetMapError) else problem)
    changes = [_apply_change(services, env, change, now) for change in body.changes]
    return json_response({"statuses": statuses, "changes": changes})


def _as_received(env: str, line: EdgeStatusBody, now: datetime) -> ReceivedReport | str:
    """Return a mirror's report, or why it is invalid."""
    try:
        report = report_from_status(RobotStatus.from_dict(line.status))
    except Invalid as error:
        return error.detail
    return ReceivedReport(env, line.robot, report, _not_ahead(line.received, now), line.vouched, late=True)


def _apply_change(services: Services, env: str, change: EdgeChangeBody, now: datetime) -> dict[str, Any]:
    members = change.overlay.model_dump()
    members["created"] = _not_ahead(change.overlay.created, now)
    overlay = Overlay(environment=env, **members)
    try:
        if (overlay.polygon is None) == (overlay.edge is None):
            raise Invalid("an overlay is either a polygon or an edge")
        if overlay.polygon is not None:
            overlay = replace(overlay, polygon=parse_polygon(overlay.polygon))
            check_place(overlay, shown_versions(services, env))
        stored = services.store.edge_changes.apply(
            env, OverlayChange(change.event, overlay, change.author, _not_ahead(change.time, now))
        )
    except Unavailable:
        raise
    except (Conflict, Invalid) as error:
        return {"problem": error.detail, "overlay": services.store.edge_changes.read_overlay(env, overlay.id)}
    return {"problem": None, "overlay": stored}


def _not_ahead(time: datetime, now: datetime) -> datetime:
    if time.tzinfo is None:
        raise Invalid("times need a time zone, for example 2030-01-31T06:00:00Z")
    return min(time, now + MAX_AHEAD)


@router.post(
    "/mirror/delegations",
    responses=problem_responses(list[DelegationOut], 400, 404, 415),
    summary="Let a mirror sign manifests",
)
def delegate(body: DelegationsBody, services: ServicesDep, principal: MirrorRole) -> Response:
    """State that a key may sign the manifests of environments, until `FLEETMAP_DELEGATION_SECONDS` from now.

    Robots that trust this server's key then accept what the mirror signs.
    """
    try:
        public = base64.b64decode(body.public_key, validate=True)
    except (binascii.Error, ValueError):
        public = b""
    if len(public) != 32:
        raise Invalid("invalid public_key", [Problem("must be 32 bytes in base64", where="body.public_key")])
    for name in body.environments:
        principal.require_environment(name)
    statements = _statements(services, public, body.environments)
    services.store.audit.record_change()  # like a new key
    return json_response(statements)


def _statements(services: Services, public: bytes, environments: Sequence[str]) -> list[dict[str, Any]]:
    start = datetime.now(UTC)
    until = start + timedelta(seconds=services.options.delegation_seconds)
    out = []
    for name in dict.fromkeys(environments):
        environment = services.store.environments.get(name, deleted=True)
        statement = delegation_statement(public, name, start, until)
        key, signature = services.keys.sign(statement)
        out.append(
            {
                "environment": name,
                "environment_id": environment.id,
                "statement": base64.b64encode(statement).decode(),
                "signed_by": key,
                "signature": base64.b64encode(signature).decode(),
                "until": rfc3339(until),
            }
        )
    return out


def _signed(services: Services, body: dict[str, Any]) -> Response:
    data = json_bytes(body)
    key, signature = services.keys.sign(data)
    header = f"{key}:{base64.b64encode(signature).decode()}"
    return Response(data, 200, {SIGNATURE: header, "cache-control": "no-store"}, "application/json")

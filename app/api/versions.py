"""Versions: uploads, edits, reverts, history and source files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Any, Literal

from fastapi import Path, Query, Request
from fastapi.exceptions import RequestValidationError
from pydantic import ConfigDict, Field, ValidationError
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from app.api.http.auth import Viewer
from app.api.http.caching import content_disposition, none_match
from app.api.http.dependencies import CommitDep, Services, ServicesDep
from app.api.http.forms import FormFields
from app.api.http.parameters import parse_version_ref
from app.api.http.problems import MalformedBody, UnsupportedMedia
from app.api.http.responses import api_router, commit_response, json_response, page_response, version_headers
from app.api.http.schemas import (
    DRY_RUN,
    MAX_TEXT,
    UNCHANGED_OR_DRY_RUN,
    Cursor,
    DryRun,
    DryRunOut,
    EnvironmentPath,
    Limit,
    RequestModel,
    SourceOut,
    VersionOut,
    VersionPath,
    problem_responses,
)
from app.api.http.streams import IN_MEMORY, range_headers, raw_response, requested_range, stream_file
from app.api.http.uploads import UploadForm
from app.errors import FleetMapError, Invalid, NotFound, Problem, Thinned
from app.ingest import CommitRequest, CommitResult, Upload, dry_run_as_json
from app.store.values import Source, rfc3339
from app.upload_reader import DRAWN_LAYERS


class RevertBody(RequestModel):
    """New version with the content of an old one."""

    revert_to: int = Field(ge=0, description="Number of the old version.")
    message: str = Field("", max_length=MAX_TEXT)
    dry_run: DryRun = False


class CommitBody(RequestModel):
    """Commit of a dry run: a version with exactly its content, sources, provenance and warnings."""

    commit: str = Field(
        pattern=DRY_RUN,
        description="`id` of the dry run. Returns 412 if the head is not the `parent` of the dry run any more.",
    )
    message: str = Field("", max_length=MAX_TEXT, description="Default: the message of the dry run.")


class PutChange(RequestModel):
    """Add or replace one feature, by id.

    A feature can be put back as returned by `GET …/layers/{layer}`: unedited values keep their exact stored form. An
    existing feature keeps its anchor (local metres, or a geographic position), whatever the `crs` of its new
    geometry; to change the anchor, delete the feature and put it again. `properties.datum` of a fence sets the
    environment's datum. Edges move with their nodes.
    """

    op: Literal["put"]
    layer: Literal["location", "objects", "topology", "zones"]
    feature: dict[str, Any] = Field(
        description="GeoJSON Feature with an `id` (a text); `place` instead of `geometry` is in local metres. An edge "
        "without geometry is straight."
    )
    level: str | None = Field(None, max_length=256)
    name: str | None = Field(None, max_length=256, description="Name of the part, if the layer has several.")
    crs: Literal["local", "wgs84"] | None = Field(
        None, description="CRS of `geometry`. Default: `wgs84` if there is a datum, else `local`."
    )


class DeleteChange(RequestModel):
    """Remove one feature, by id."""

    op: Literal["delete"]
    layer: Literal["location", "objects", "topology", "zones"]
    id: str = Field(min_length=1, max_length=512)
    level: str | None = Field(None, max_length=256)
    name: str | None = Field(None, max_length=256)


class CellsChange(RequestModel):
    """Set the cells of a grid whose centres are in a polygon."""

    op: Literal["cells"]
    grid: str | None = Field(None, max_length=256, description="Name of the grid. Default: `map`, else the only grid.")
    level: str | None = Field(None, max_length=256)
    polygon: dict[str, Any] = Field(description="GeoJSON Polygon or MultiPolygon.")
    crs: Literal["local", "wgs84"] | None = Field(
        None, description="CRS of the polygon. Default: `wgs84` if there is a datum, else `local`."
    )
    value: int = Field(ge=0, le=255, description="New value: 0 free … 100 occupied, 255 unknown.")


Change = Annotated[PutChange | DeleteChange | CellsChange, Field(discriminator="op")]


class EditsBody(RequestModel):
    """Changes that are committed together as one version, or not at all."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "message": "a charging dock by the gate",
                    "changes": [
                        {
                            "op": "put",
                            "layer": "topology",
                            "feature": {
                                "type": "Feature",
                                "id": "dock",
                                "geometry": {"type": "Point", "coordinates": [5.6133, 52.4206]},
                                "properties": {"kind": "node", "name": "dock"},
                            },
                        },
                        {
                            "op": "put",
                            "layer": "topology",
                            "feature": {
                                "type": "Feature",
                                "id": "Gate_dock",
                                "geometry": None,
                                "properties": {"kind": "edge", "source": "Gate", "target": "dock"},
                            },
                        },
                    ],
                }
            ]
        },
    )

    message: str = Field("", max_length=MAX_TEXT)
    changes: list[Change] = Field(min_length=1, max_length=100_000)
    dry_run: DryRun = False


router = api_router("versions", "/environments/{env}")

UPLOAD_BODY: dict[str, Any] = {
    "x-free-query": True,
    "x-schemas": {"RevertBody": RevertBody.model_json_schema(), "CommitBody": CommitBody.model_json_schema()},
    "requestBody": {
        "required": True,
        "content": {
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": ["files"],
                    "properties": {
                        "files": {
                            "type": "array",
                            "items": {"type": "string", "format": "binary"},
                            "description": (
                                "One or more files; a name may be a relative path. A `.zip` of a folder is "
                                "equivalent to its files."
                            ),
                        },
                        "format": {
                            "type": "string",
                            "description": "Id of the files' format. Default: detected from the content.",
                        },
                        "layer": {
                            "type": "string",
                            "enum": list(DRAWN_LAYERS),
                            "description": "Layer for the lines and polygons of a drawing.",
                        },
                        "level": {"type": "string", "default": "ground", "description": "Level of the content."},
                        "grid": {"type": "string", "description": "Name for an uploaded grid."},
                        "mode": {"type": "string", "enum": ["replace", "merge"], "default": "replace"},
                        "message": {"type": "string", "description": "Reason of the change, for the history."},
                        "dry_run": {
                            "type": "boolean",
                            "default": False,
                            "description": "Return the version that would be created, and store it only as a dry run: "
                            "see `DryRunOut`.",
                        },
                    },
                    "additionalProperties": {"type": "string", "description": "Options of the format."},
                },
                "examples": {
                    "datum": {
                        "summary": "Position of the environment",
                        "value": {
                            "files": ["datum.yaml"],
                            "message": "measured with GNSS",
                        },
                    }
                },
            },
            "application/json": {
                "schema": {
                    "oneOf": [
                        {"$ref": "#/components/schemas/RevertBody"},
                        {"$ref": "#/components/schemas/CommitBody"},
                    ]
                },
                "examples": {"revert": {"value": {"revert_to": 1, "message": "the gate was open"}}},
            },
        },
    },
}


@router.get("/versions", responses=problem_responses(list[VersionOut], 404), summary="List versions")
def list_versions(
    env: EnvironmentPath, request: Request, services: ServicesDep, _: Viewer, limit: Limit = 100, cursor: Cursor = None
) -> Response:
    """List the versions of an environment, newest first."""
    if cursor is not None and not (cursor.isascii() and cursor.isdigit() and len(cursor) <= 18):
        raise Invalid(
            "invalid cursor: take it from the Link header of the previous page",
            [Problem("invalid cursor", where="cursor")],
        )
    before = int(cursor) if cursor is not None else None
    versions = services.store.versions.page(env, limit=limit + 1, before=before)
    following = str(versions[limit - 1].number) if len(versions) > limit else None
    return page_response(request, [version.as_dict() for version in versions[:limit]], following)


@router.post(
    "/versions",
    status_code=201,
    responses={
        **problem_responses(VersionOut, 400, 404, 409, 412, 413, 415, 503, ok=201, description="A new version"),
        **UNCHANGED_OR_DRY_RUN,
    },
    summary="Upload files, revert to a version, or commit a dry run",
    openapi_extra=UPLOAD_BODY,
)
async def create_version(
    env: EnvironmentPath,
    request: Request,
    services: ServicesDep,
    commit: CommitDep,
) -> Response:
    """Create one version from one upload, or none if it fails.

    The files are stored unchanged; doubtful content causes warnings.

    With `dry_run` nothing becomes a version. The response has an `id` by which the result can be read for ten minutes
    instead of a version, and committed with `{"commit": id}`.
    """
    media = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media == "multipart/form-data":
        async with services.intake.receive(request) as form:
            upload, described = _upload(form, request, commit)
            outcome = await run_in_threadpool(_counted, services, services.ingest.upload, env, upload, described)
    elif media == "application/json" or media.endswith("+json"):
        _no_query(request)
        body = await _revert_or_commit_body(request)
        described = commit.with_message(body.message)
        if isinstance(body, CommitBody):
            outcome = await run_in_threadpool(
                _counted, services, services.ingest.commit_dry_run, env, body.commit, described
            )
        else:
            outcome = await run_in_threadpool(
                services.ingest.revert, env, body.revert_to, described.as_dry_run(body.dry_run)
            )
    else:
        raise UnsupportedMedia(
            "unsupported media type: send multipart/form-data with files, or application/json with revert_to or commit"
        )
    return commit_response(outcome)


@router.post(
    "/edits",
    status_code=201,
    responses={
        **problem_responses(VersionOut, 400, 404, 409, 412, 415, ok=201, description="A new version"),
        **UNCHANGED_OR_DRY_RUN,
    },
    summary="Edit features and cells",
)
def create_edit(env: EnvironmentPath, body: EditsBody, services: ServicesDep, commit: CommitDep) -> Response:
    """Put or delete features and set cells, all in one version or none.

    Edits that leave edges without their nodes are refused.
    """
    changes = [change.model_dump(exclude_none=True) for change in body.changes]
    described = commit.with_message(body.message).as_dry_run(body.dry_run)
    outcome = _counted(services, services.ingest.edit, env, changes, described)
    return commit_response(outcome)


@router.get("/versions/{v}", responses=problem_responses(VersionOut | DryRunOut, 404), summary="Get a version")
def get_version(env: EnvironmentPath, v: VersionPath, services: ServicesDep, _: Viewer) -> Response:
    """Return a version by number, by channel, or the newest; or a dry run or draft, with its differences."""
    version = services.store.versions.get(env, parse_version_ref(v))
    body = version.as_dict() if version.pending is None else dry_run_as_json(services.store, version)
    return json_response(body, headers=version_headers(version))


@router.get(
    "/versions/{v}/sources",
    tags=["sources"],
    responses=problem_responses(list[SourceOut], 404),
    summary="List uploaded files",
)
def list_sources(env: EnvironmentPath, v: VersionPath, services: ServicesDep, _: Viewer) -> Response:
    """List the files of a version, including unused ones."""
    return json_response(
        [source.as_dict() for source in services.store.versions.get(env, parse_version_ref(v)).sources]
    )


@router.get(
    "/versions/{v}/sources/{name:path}",
    tags=["sources"],
    response_class=Response,
    responses={
        **problem_responses(None, 404, 416),
        200: {"description": "The file", "content": {"application/octet-stream": {}}},
        206: {"description": "Part of the file"},
        304: {"description": "Not modified: the client has this file"},
    },
    summary="Download an uploaded file",
)
def get_source(
    env: EnvironmentPath,
    v: VersionPath,
    name: Annotated[
        str, Path(max_length=1024, description="Name of the file, with its folders.", examples=["datum.yaml"])
    ],
    request: Request,
    services: ServicesDep,
    _: Viewer,
    sha256: Annotated[
        str | None, Query(pattern=r"^[0-9a-f]{64}$", description="SHA-256 of the file, if several have this name.")
    ] = None,
) -> Response:
    """Return a file byte for byte as it was uploaded, always as an attachment that a browser does not display."""
    source = _source(services.store.versions.get(env, parse_version_ref(v)).sources, name, sha256)
    if source.removed is not None:
        raise Thinned(
            f"the file {source.name[:200]!r} was removed on {rfc3339(source.removed)} by a rule of retention: request "
            f"the map in its format{'' if source.format is None else f', {source.format},'} instead"
        )
    etag = f'"{source.sha256}"'
    headers = [
        (b"content-type", b"application/octet-stream"),
        (b"content-disposition", content_disposition(source.name).encode()),
        (b"x-content-type-options", b"nosniff"),
        (b"content-security-policy", b"sandbox; default-src 'none'"),
        (b"accept-ranges", b"bytes"),
        (b"cache-control", b"no-cache"),
        (b"etag", etag.encode()),
    ]
    if none_match(request.headers.get("if-none-match"), etag):
        return raw_response(304, [(n, v) for n, v in headers if n in (b"etag", b"cache-control")])
    part = requested_range(request, etag, source.size)
    start, end = part or (0, source.size)
    headers = [*range_headers(part, source.size), *headers]
    status = 206 if part else 200
    if request.scope["state"].get("head"):
        return raw_response(status, headers)
    if source.size > IN_MEMORY:
        return stream_file(services.store.blobs.open(source.sha256), start, end, status, headers)
    return raw_response(status, headers, services.store.blobs.get(source.sha256)[start:end])


def _source(sources: tuple[Source, ...], name: str, sha256: str | None) -> Source:
    fitting = [s for s in sources if s.name == name and sha256 in (None, s.sha256)]
    if not fitting:
        names = ", ".join(s.name for s in sources[:20]) or "none"
        raise NotFound(f"this version has no source {name[:200]!r}; available: {names}")
    fitting.sort(key=lambda s: (s.removed is not None, not s.used))
    return fitting[0]


def _upload(form: UploadForm, request: Request, commit: CommitRequest) -> tuple[Upload, CommitRequest]:
    """Parse the form and the query of an upload; returns it with the completed request. Raises Invalid."""
    fields = FormFields(form, request.query_params.multi_items())
    mode = fields.take("mode") or "replace"
    if mode not in ("replace", "merge"):
        raise Invalid("mode must be replace or merge", [Problem("must be replace or merge", where="mode")])
    hints, message, dry_run = fields.take_hints(), fields.take("message"), fields.take_flag("dry_run")
    upload = Upload(
        files=tuple(form.files),
        hints=replace(hints, options=fields.take_rest()),
        mode=mode,  # type: ignore[arg-type]  # checked above
    )
    return upload, commit.with_message(message).as_dry_run(dry_run)


def _counted(services: Services, change: Callable[..., CommitResult], *args: Any) -> CommitResult:
    """Apply an upload or edit, and count its outcome."""
    try:
        outcome = change(*args)
    except FleetMapError:
        services.metrics.uploads.labels("refused").inc()
        raise
    services.metrics.uploads.labels(outcome.status).inc()
    return outcome


async def _revert_or_commit_body(request: Request) -> RevertBody | CommitBody:
    try:
        value = await request.json()
    except ValueError as error:
        raise MalformedBody(f"the request body is not JSON: {error}") from None
    model: type[RevertBody | CommitBody] = RevertBody
    if isinstance(value, dict) and "commit" in value:
        if "revert_to" in value:
            reason = "revert_to and commit exclude each other: give one"
            raise Invalid(reason, [Problem(reason, where="body.commit")])
        model = CommitBody
    try:
        return model.model_validate(value)
    except ValidationError as error:
        items = [{**item, "loc": ("body", *item["loc"])} for item in error.errors()]
        raise RequestValidationError(items) from None


def _no_query(request: Request) -> None:
    for name in request.query_params:
        raise Invalid(
            f"unknown query parameter {name[:80]!r}: put it into the JSON body, as in "
            '{"revert_to": 1, "dry_run": true}',
            [Problem("unknown", where=name[:80])],
        )

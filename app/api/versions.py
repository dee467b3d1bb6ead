"""Versions: uploads, edits, reverts, history, and the files that made them."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Request
from pydantic import ValidationError
from starlette.concurrency import run_in_threadpool
from starlette.exceptions import HTTPException
from starlette.responses import Response

from app import formats
from app.api.auth import Editor, Principal, Viewer
from app.api.caching import Unsatisfiable, byte_range, content_disposition, none_match
from app.api.dependencies import Services, ServicesDep
from app.api.maps import IN_MEMORY, parse_version_ref, stream_file
from app.api.problems import UnsupportedMedia
from app.api.responses import StrictRoute, api_path, json_response, page_response
from app.api.schemas import (
    VERSION,
    Cursor,
    EditsBody,
    EnvironmentPath,
    IdempotencyKey,
    IfMatch,
    Limit,
    RevertBody,
    SourceOut,
    VersionOut,
    VersionPath,
    problem_responses,
)
from app.api.uploads import UploadForm
from app.errors import FleetMapError, Invalid, NotFound, Problem
from app.ingest import CommitResult, SpooledFile, Upload
from app.ingest.service import name_problem
from app.model.frame import GROUND, Level
from app.store.values import Source
from app.upload_reader import DRAWN_LAYERS, parse_drawn_layer

router = APIRouter(prefix="/environments/{env}", tags=["versions"], route_class=StrictRoute)

UPLOAD_BODY: dict[str, Any] = {
    "x-free-query": True,
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
                            "description": "One file or more; a name may be a relative path. A `.zip` of a folder is "
                            "the same as its files.",
                        },
                        "format": {"type": "string", "description": "A format's id; left out: found by content."},
                        "layer": {
                            "type": "string",
                            "enum": list(DRAWN_LAYERS),
                            "description": "What the lines and polygons of a drawing are meant for.",
                        },
                        "level": {"type": "string", "default": "ground", "description": "The storey."},
                        "grid": {"type": "string", "description": "The name of an uploaded grid."},
                        "mode": {"type": "string", "enum": ["replace", "merge"], "default": "replace"},
                        "message": {"type": "string", "description": "Why, for the history."},
                        "dry_run": {"type": "boolean", "default": False, "description": "Only say what would be."},
                    },
                    "additionalProperties": {"type": "string", "description": "Options of the format."},
                },
                "examples": {
                    "datum": {
                        "summary": "Where the environment is",
                        "value": {
                            "files": ["datum.yaml"],
                            "message": "measured with GNSS",
                        },
                    }
                },
            },
            "application/json": {
                "schema": {"$ref": "#/components/schemas/RevertBody"},
                "examples": {"revert": {"value": {"revert_to": 1, "message": "the gate was open"}}},
            },
        },
    },
}


@router.get("/versions", responses=problem_responses(list[VersionOut], 404), summary="History, newest first")
def list_versions(
    env: EnvironmentPath, request: Request, services: ServicesDep, _: Viewer, limit: Limit = 100, cursor: Cursor = None
) -> Response:
    """All versions of an environment."""
    if cursor is not None and not (cursor.isascii() and cursor.isdigit() and len(cursor) <= 18):
        raise Invalid("the cursor is not one that a page's Link header gave", [Problem("unknown", where="cursor")])
    before = int(cursor) if cursor is not None else None
    versions = services.store.versions.page(env, limit=limit + 1, before=before)
    following = str(versions[limit - 1].number) if len(versions) > limit else None
    return page_response(request, [version.as_dict() for version in versions[:limit]], following)


@router.post(
    "/versions",
    status_code=201,
    responses={
        **problem_responses(VersionOut, 400, 404, 409, 412, 413, 415, 503, ok=201, description="A new version"),
        200: {"model": VersionOut, "description": "Nothing changed: the head. Or a dry run: `version` is null."},
    },
    summary="Upload files, or revert",
    openapi_extra=UPLOAD_BODY,
)
async def create_version(
    env: EnvironmentPath,
    request: Request,
    services: ServicesDep,
    principal: Editor,
    if_match: IfMatch = None,
    idempotency_key: IdempotencyKey = None,
) -> Response:
    """One upload is one version, all or nothing. Files are taken as they are; what is doubtful comes as warnings."""
    media = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if media == "multipart/form-data":
        async with services.intake.receive(request) as form:
            upload = _upload(form, request)
            outcome = await run_in_threadpool(
                _count_upload, services, services.ingest.upload, env, upload, principal, if_match, idempotency_key
            )
    elif media == "application/json" or media.endswith("+json"):
        _no_query(request)
        outcome = await run_in_threadpool(
            _revert, services, env, await _revert_body(request), principal, if_match, idempotency_key
        )
    else:
        raise UnsupportedMedia("send multipart/form-data with files, or application/json with revert_to")
    return commit_response(outcome)


@router.post(
    "/edits",
    status_code=201,
    responses={
        **problem_responses(VersionOut, 400, 404, 409, 412, 415, ok=201, description="A new version"),
        200: {"model": VersionOut, "description": "Nothing changed: the head."},
    },
    summary="Edit features and cells",
)
def create_edit(
    env: EnvironmentPath,
    body: EditsBody,
    services: ServicesDep,
    principal: Editor,
    if_match: IfMatch = None,
    idempotency_key: IdempotencyKey = None,
) -> Response:
    """Some features put or deleted, some cells set: one version, or none. Edges that would dangle are refused."""
    changes = [change.model_dump(exclude_none=True) for change in body.changes]
    _count = services.metrics.uploads.labels
    try:
        outcome = services.ingest.edit(
            env, changes, message=body.message, author=principal.name, if_match=if_match, idempotency=idempotency_key
        )
    except FleetMapError:
        _count("refused").inc()
        raise
    _count(outcome.status).inc()
    return commit_response(outcome)


@router.get("/versions/{v}", responses=problem_responses(VersionOut, 404), summary="One version")
def get_version(env: EnvironmentPath, v: VersionPath, services: ServicesDep, _: Viewer) -> Response:
    """A version by number, by channel, or the newest."""
    version = services.store.versions.get(env, parse_version_ref(v))
    headers = {"etag": f'"{version.number}"', "fleetmap-version": str(version.number), "fleetmap-root": version.root}
    return json_response(version.as_dict(), headers=headers)


@router.get(
    "/versions/{v}/sources",
    tags=["sources"],
    responses=problem_responses(list[SourceOut], 404),
    summary="Uploaded files",
)
def list_sources(env: EnvironmentPath, v: VersionPath, services: ServicesDep, _: Viewer) -> Response:
    """The files that made a version, also those that were not used."""
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
        206: {"description": "A part of it"},
        304: {"description": "The client has it"},
    },
    summary="An uploaded file, byte for byte",
)
def get_source(
    env: EnvironmentPath,
    v: Annotated[str, Path(pattern=VERSION, description="Number, channel, or `latest`.", examples=["latest"])],
    name: Annotated[
        str, Path(max_length=1024, description="The file's name, with its folders.", examples=["datum.yaml"])
    ],
    request: Request,
    services: ServicesDep,
    _: Viewer,
    sha256: Annotated[
        str | None, Query(pattern=r"^[0-9a-f]{64}$", description="Which one, where several have this name.")
    ] = None,
) -> Response:
    """Always as an attachment, never to be shown by a browser as what it says it is."""
    source = _source(services.store.versions.get(env, parse_version_ref(v)).sources, name, sha256)
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
        response = Response(status_code=304)
        response.raw_headers = [(n, v) for n, v in headers if n in (b"etag", b"cache-control")]
        return response
    part = byte_range(request.headers.get("range"), request.headers.get("if-range"), etag, source.size)
    if isinstance(part, Unsatisfiable):
        detail = f"the file has {source.size} bytes"
        raise HTTPException(416, detail, {"content-range": f"bytes */{source.size}"})
    start, end = part or (0, source.size)
    headers.insert(0, (b"content-length", str(end - start).encode()))
    if part:
        headers.insert(1, (b"content-range", f"bytes {start}-{end - 1}/{source.size}".encode()))
    status = 206 if part else 200
    if source.size > IN_MEMORY:
        return stream_file(services.store.blobs.open(source.sha256), start, end, status, headers)
    response = Response(services.store.blobs.get(source.sha256)[start:end], status)
    response.raw_headers = headers
    return response


def _source(sources: tuple[Source, ...], name: str, sha256: str | None) -> Source:
    fitting = [s for s in sources if s.name == name and sha256 in (None, s.sha256)]
    if not fitting:
        names = ", ".join(s.name for s in sources[:20]) or "none"
        raise NotFound(f"this version has no source {name[:200]!r}; its sources: {names}")
    return next((s for s in fitting if s.used), fitting[0])


def commit_response(outcome: CommitResult) -> Response:
    """The answer for what became of a change: 201 where there is a new version, also when it is told again."""
    version = outcome.version
    if version is None:
        return json_response(outcome.body)
    headers = {"etag": f'"{version.number}"', "fleetmap-version": str(version.number), "fleetmap-root": version.root}
    location = api_path("environments", version.environment, "versions", version.number)
    if outcome.status == "unchanged":
        return json_response(outcome.body, headers={**headers, "content-location": location})
    return json_response(outcome.body, 201, {**headers, "location": location})


def _upload(form: UploadForm, request: Request) -> Upload:
    """What the form and the query say, checked."""
    fields = dict(form.fields)
    for name, value in request.query_params.multi_items():
        if name in fields:
            raise Invalid(f"{name[:80]!r} is given twice", [Problem("given twice", where=name[:80])])
        fields[name] = value
    layer = parse_drawn_layer(fields.pop("layer", "") or None)
    mode = fields.pop("mode", "") or "replace"
    if mode not in ("replace", "merge"):
        raise Invalid("mode must be replace or merge", [Problem("unknown", where="mode")])
    level = fields.pop("level", "") or GROUND
    Level(level)
    message = fields.pop("message", "")
    return Upload(
        files=tuple(form.files),
        format=parse_format_name(fields.pop("format", ""), "format"),
        layer=layer,
        level=level,
        grid=fields.pop("grid", "") or None,
        mode=mode,  # type: ignore[arg-type]  # checked above
        message=message,
        dry_run=truth(fields.pop("dry_run", ""), "dry_run"),
        options=fields,
    )


def parse_format_name(text: str, location: str) -> str | None:
    """A format's id as a form says it; empty is none. Invalid, with those there are, where it is not known."""
    if not text:
        return None
    try:
        return formats.get_format(text).name
    except NotFound as error:
        raise Invalid(error.detail, [Problem("no such format", where=location)]) from None


def check_names(files: list[SpooledFile]) -> None:
    """Invalid for names that cannot be kept, and where there is no file at all."""
    if not files:
        raise Invalid("there is no file: send at least one in the field 'files'", [Problem("missing", where="files")])
    seen: set[str] = set()
    for file in files:
        problem = name_problem(file.name) or ("this name is used twice" if file.name in seen else None)
        if problem:
            shown = file.name[:200]
            raise Invalid(f"the file name {shown!r} cannot be used: {problem}", [Problem(problem, shown)])
        seen.add(file.name)


def truth(text: str, parameter: str) -> bool:
    """A form's yes or no; empty is no."""
    values = {"": False, "false": False, "0": False, "no": False, "true": True, "1": True, "yes": True}
    if text.lower() not in values:
        raise Invalid(
            f"{parameter} must be true or false, got {text[:80]!r}", [Problem("true or false", where=parameter)]
        )
    return values[text.lower()]


def _count_upload(
    services: Services, take: Any, env: str, upload: Upload, principal: Principal, if_match: str | None, key: str | None
) -> CommitResult:
    try:
        outcome: CommitResult = take(env, upload, author=principal.name, if_match=if_match, idempotency=key)
    except FleetMapError:
        services.metrics.uploads.labels("refused").inc()
        raise
    services.metrics.uploads.labels(outcome.status).inc()
    return outcome


def _revert(
    services: Services, env: str, body: RevertBody, principal: Principal, if_match: str | None, key: str | None
) -> CommitResult:
    return services.ingest.revert(
        env, body.revert_to, message=body.message, author=principal.name, if_match=if_match, idempotency=key
    )


async def _revert_body(request: Request) -> RevertBody:
    from fastapi.exceptions import RequestValidationError

    from app.api.problems import MalformedBody

    try:
        value = await request.json()
    except ValueError as error:
        raise MalformedBody(f"the request body is not JSON: {error}") from None
    try:
        return RevertBody.model_validate(value)
    except ValidationError as error:
        items = [{**item, "loc": ("body", *item["loc"])} for item in error.errors()]
        raise RequestValidationError(items) from None


def _no_query(request: Request) -> None:
    for name in request.query_params:
        raise Invalid(f"a revert takes no query parameter {name[:80]!r}", [Problem("unknown", where=name[:80])])

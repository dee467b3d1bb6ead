"""Signed manifest of a version's files, and the keys that sign it."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Annotated, Any, Literal
from urllib.parse import parse_qsl

from fastapi import Query, Request
from pydantic import BaseModel, Field
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from app import formats
from app.api.http.addresses import request_address
from app.api.http.auth import ServerAdmin, Viewer
from app.api.http.caching import none_match
from app.api.http.conversions import JobStarted, job_started_response
from app.api.http.dependencies import Services, ServicesDep
from app.api.http.parameters import parse_options, parse_version_ref, require_format
from app.api.http.responses import api_router, json_bytes, json_response
from app.api.http.schemas import NAME, EnvironmentPath, VersionPath, problem_responses
from app.convert import site
from app.convert.cache import CachedMap
from app.convert.recipe import Recipe, writer_options
from app.errors import CannotConvert, FleetMapError, Invalid, NotFound, Problem
from app.events.messages import SIGNATURE
from app.model.closures import NO_CLOSURES, ClosureMode
from app.store.values import Version, frame_input

STEP_SECONDS = 600
"""Step of the signing time: within a step a polling robot gets the same bytes, and 304."""

MAX_FORMATS = 32
MAX_LIST = 4000
"""Maximum length of a list of formats with their parameters."""

UNAVAILABLE = (CannotConvert, NotFound, Invalid)
"""Errors that make one format unavailable; all others fail the whole request."""

LAYER_DIGITS = 16


class KeyDelegationOut(BaseModel):
    """Statement of a centre that a mirror's key may sign manifests of one environment for a time; bytes in base64."""

    statement: str
    signed_by: str
    signature: str


class KeyOut(BaseModel):
    """Public key; bytes in base64."""

    id: str
    algorithm: Literal["Ed25519"]
    public_key: str
    created: datetime
    endorsed_by: str | None = None
    endorsement: str | None = None
    delegations: list[KeyDelegationOut] = Field(
        [], description="On a mirror, for `environment`: why robots that trust its centre may trust this key."
    )


class ManifestFile(BaseModel):
    """One file of a map."""

    format: str
    name: str = Field(
        description="Name of the file. Files of other levels than the default one are below a folder of the level: "
        "`L2/map.yaml`."
    )
    size: int
    sha256: str
    level: str | None = Field(None, description="Level of the file, if it belongs to one.")


class ManifestLevel(BaseModel):
    """Level of the environment."""

    name: str
    elevation: float = Field(description="Metres above the local origin.")


class ManifestMissing(BaseModel):
    """Optional format that is not available."""

    format: str
    detail: str = Field(description="Reason, and what to supply.")


class ManifestOut(BaseModel):
    """Signed manifest that a robot verifies; the signature is in a header."""

    environment: str
    channel: str | None = None
    epoch: int = Field(
        0,
        description="Epoch of the server: orders manifests before the sequence. The operator raises it after a "
        "restore. Omitted if 0.",
    )
    sequence: int
    edge_sequence: int = Field(
        0,
        description="Number of changes that a mirror made by itself while its centre was cut off: orders manifests of "
        "equal `sequence`. Omitted if 0.",
    )
    version: int
    root: str
    time: datetime = Field(description="Time of signing, in steps of ten minutes.")
    expires: datetime
    levels: list[ManifestLevel] = Field(description="Levels, lowest first.")
    files: list[ManifestFile]
    missing: list[ManifestMissing] = Field([], description="Optional formats that are not available. Omitted if empty.")
    overlays: list[dict[str, Any]] = Field(
        [], description="Closures in force that the files show, by id. Omitted if empty."
    )
    closures: Literal["mark", "ignore"] | None = Field(
        None, description="How the files show the closures in force. Omitted if `apply`."
    )
    parameters: dict[str, dict[str, str]] = Field(
        {}, description="Parameters with which each format was requested. Omitted if empty."
    )
    overlays_digest: str = Field(description="SHA-256 of `overlays`; equals `Fleetmap-Overlays` of each file.")
    layers: dict[str, str] = Field(
        description="Hash of each layer. Equal layers of any two versions have equal hashes."
    )
    variables: dict[str, str] | None = Field(
        None, description="Variables of an uploaded `environment_template`, such as `FARM_NAME`, for its scripts."
    )


ClosuresQuery = Annotated[
    ClosureMode | None,
    Query(
        description="How maps show the closures in force. `apply`: closed edges are omitted, or marked in formats that "
        "can block an edge; `mark`: they stay in all formats, with a mark; `ignore`: closures are not shown. Default: "
        "`apply`, but `ignore` for a version number."
    ),
]

router = api_router("manifest")


@router.get("/keys", responses=problem_responses(list[KeyOut]), summary="List signing keys")
def list_keys(
    services: ServicesDep,
    principal: Viewer,
    environment: Annotated[
        str | None,
        Query(
            pattern=NAME,
            description="On a mirror: also list the delegation for this environment, and the keys of its centre.",
        ),
    ] = None,
) -> Response:
    """List the keys, newest first; the newest one signs.

    `endorsement` is the signature of the previous key over the raw public key.
    """
    lines = [key.as_dict() for key in services.keys.public()]
    if environment is not None:
        principal.require_environment(environment)
        lines = _with_delegation(services, lines, environment)
    return json_response(lines)


def _with_delegation(services: Services, lines: list[dict[str, Any]], environment: str) -> list[dict[str, Any]]:
    """Add the delegation for an environment to the key that it is about, and the keys of the centre."""
    mirror, delegation = services.store.mirrors.state(), services.store.mirrors.delegation(environment)
    if mirror is None or delegation is None:
        return lines
    public = base64.b64encode(delegation.key).decode()
    texts = {
        "statement": base64.b64encode(delegation.statement).decode(),
        "signed_by": delegation.signed_by,
        "signature": base64.b64encode(delegation.signature).decode(),
    }
    out = [{**line, "delegations": [texts]} if line["public_key"] == public else line for line in lines]
    listed = {line["id"] for line in lines}
    return out + [dict(line) for line in mirror.centre_keys if line["id"] not in listed]


@router.post(
    "/keys",
    status_code=201,
    responses=problem_responses(KeyOut, ok=201, description="The new key"),
    summary="Rotate the signing key",
)
def rotate_key(services: ServicesDep, _: ServerAdmin) -> Response:
    """Create a new signing key.

    Robots that trust the old key accept the new one, because the old key endorses it. Requires an administrator's
    token for all environments.

    Signed links get a new secret as well; existing links stay valid until they expire.
    """
    try:
        with services.store.audit.changing():
            key = services.keys.rotate()
            services.links.rotate()
    finally:
        services.store.generation.change()  # invalidate cached responses that the old key signed
    return json_response(key.as_dict(), 201)


@router.get(
    "/environments/{env}/versions/{v}/manifest",
    responses={
        **problem_responses(ManifestOut, 404, 409),
        304: {"description": "Not modified: the client has this manifest"},
    },
    summary="Get the signed manifest of a version",
)
async def get_manifest(
    env: EnvironmentPath,
    v: VersionPath,
    request: Request,
    services: ServicesDep,
    principal: Viewer,
    formats: Annotated[
        str,
        Query(
            description="Formats, comma-separated. Each may have parameters as in a URL: "
            "`occupancy_grid?level=L2&grid=map,tmap2`; percent-encode a comma or `&` in a value once more. "
            "Default for formats with levels and named parts: all of them.",
            max_length=MAX_LIST,
            examples=["geojson,kml"],
        ),
    ],
    optional: Annotated[
        str,
        Query(
            description="Further formats, in the same syntax. Unavailable ones are listed in `missing`.",
            max_length=MAX_LIST,
            examples=["lanelet2"],
        ),
    ] = "",
    closures: ClosuresQuery = None,
) -> Response:
    """Return names, sizes and hashes of map files, signed with the server's key over exactly these bytes.

    The header `Fleetmap-Signature` is `<key id>:<base64 of the Ed25519 signature>`; see `/keys` for the keys.
    `sequence` belongs to the event that moved the channel (or created the version), or that last changed the closures
    in force. A robot refuses a lower sequence. Files of other levels than the default one are below a folder named
    like the level; `level` gives the level of a file.
    """
    entries = _entries(formats, optional)
    cached_maps: dict[str, CachedMap] = {}
    while True:
        outcome = await services.response_cache.run_shared(
            request, _sign_manifest, services, env, v, entries, closures, request, {}
        )
        if (
            isinstance(outcome, _PendingConversion) and outcome.recipe.key in cached_maps
        ):  # the cache is too small for all maps of the manifest
            outcome = await run_in_threadpool(_sign_manifest, services, env, v, entries, closures, request, cached_maps)
        if not isinstance(outcome, _PendingConversion):
            break
        try:
            conversion = await services.jobs.get_or_start(outcome.recipe, principal, request_address(request))
        except UNAVAILABLE as error:
            if outcome.entry.required:
                raise _with_format_name(error, outcome.entry) from error
            continue  # the failure is cached: the next attempt lists the format as missing
        if isinstance(conversion, JobStarted):
            return job_started_response(conversion.job)
        recipe, cached_map = conversion
        cached_maps[recipe.key] = cached_map
    headers, data = outcome
    if none_match(request.headers.get("if-none-match"), headers["etag"]):
        return Response(status_code=304, headers=headers)
    return Response(data, 200, headers, "application/json")


@dataclass(frozen=True, slots=True)
class _Entry:
    """Requested format with the parameters of its maps. requested: all of them, as texts."""

    format: str
    values: Mapping[str, str]
    derive: bool
    closures: ClosureMode | None
    required: bool
    requested: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class _PendingConversion:
    """Map to convert before the manifest can be written."""

    entry: _Entry
    recipe: Recipe


def _sign_manifest(
    services: Services,
    env: str,
    v: str,
    entries: list[_Entry],
    mode: ClosureMode | None,
    request: Request,
    cached_maps: Mapping[str, CachedMap],
) -> tuple[dict[str, str], bytes] | _PendingConversion:
    """Write and sign the manifest; return headers and bytes, or the first map to convert before that.

    cached_maps: maps converted for this response, by recipe key; the cache may have evicted them since.
    """
    channel = None if isinstance(parse_version_ref(v), int) else v
    generation = services.response_cache.generation()
    version, position = services.store.channels.target(env, parse_version_ref(v), mode)
    closures = version.closures or NO_CLOSURES
    listed = _list_files(services, version, entries, cached_maps)
    if isinstance(listed, _PendingConversion):
        return listed
    files, missing = listed
    now = services.store.now().timestamp()
    signed = (int(now) // STEP_SECONDS) * STEP_SECONDS
    body: dict[str, Any] = {"environment": env}
    if channel is not None:
        body["channel"] = channel
    body |= {
        "sequence": position.sequence,
        "version": version.number,
        "root": version.root,
        "time": _seconds(signed),
        "expires": _seconds(signed + services.options.manifest_seconds),
        "levels": _levels(version),
        "files": files,
        "overlays_digest": closures.digest,
        "layers": _layers(version),
    }
    # Sign every value that is not the default, so that a proxy cannot change the request. Omit empty members:
    # robots download every byte with each change.
    shown = version.closures.mode if version.closures is not None else "ignore"
    parameters = {entry.format: entry.requested for entry in entries if entry.requested}
    body |= {"closures": shown} if shown != "apply" else {}
    body |= {"parameters": parameters} if parameters else {}
    epoch = services.store.epoch() if position.epoch is None else position.epoch
    body |= {"epoch": epoch} if epoch else {}
    body |= {"edge_sequence": position.edge} if position.edge else {}
    body |= {"missing": missing} if missing else {}
    body |= {"overlays": [closure.as_dict() for closure in closures.items]} if closures.items else {}
    variables = services.maps.variables(version)
    if variables:
        body["variables"] = variables
    data = json_bytes(body)
    key, signature = services.keys.sign(data)
    header = f"{key}:{base64.b64encode(signature).decode()}"
    headers = {"etag": f'"{header[-40:-2]}"', "cache-control": "no-cache", SIGNATURE: header}
    services.response_cache.store_response(request, env, headers, data, generation)
    return headers, data


def _seconds(moment: float) -> str:
    """Format a time as RFC 3339 in UTC, to the second."""
    return datetime.fromtimestamp(int(moment), UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def _list_files(
    services: Services, version: Version, entries: list[_Entry], cached_maps: Mapping[str, CachedMap]
) -> tuple[list[dict[str, Any]], list[dict[str, str]]] | _PendingConversion:
    """List the files of all formats and the unavailable optional formats; or return a map to convert first."""
    files: list[dict[str, Any]] = []
    missing: list[dict[str, str]] = []
    for entry in entries:
        try:
            recipe = _recipe(services, version, entry)
            cached_map = services.maps.get_cached(recipe) or cached_maps.get(recipe.key)
            if cached_map is None and not entry.required:
                failure = services.maps.failure(recipe, len(entries))
                if failure is not None:
                    raise failure
        except UNAVAILABLE as error:
            if entry.required:
                raise _with_format_name(error, entry) from error
            missing.append({"format": entry.format, "detail": error.detail})
            continue
        if cached_map is None:
            return _PendingConversion(entry, recipe)
        for file in cached_map.files:
            line = {"format": entry.format, "name": file.name, "size": file.size, "sha256": file.sha256}
            files.append(line | ({"level": file.place[0]} if file.place is not None else {}))
    return sorted(files, key=lambda f: (f["format"], f["name"])), sorted(missing, key=lambda m: m["format"])


def _recipe(services: Services, version: Version, entry: _Entry) -> Recipe:
    """Plan the whole site in a format, or the selection that the entry's parameters make."""
    values = {**site.whole_site_options(formats.get_format(entry.format)), **entry.values}
    if entry.closures is not None:
        in_force = version.closures or services.store.overlays.closures(version.environment)
        version = replace(version, closures=in_force.for_mode(entry.closures))
    return services.maps.recipe(version, entry.format, values, derive=entry.derive, listed=True)


def _with_format_name(error: FleetMapError, entry: _Entry) -> FleetMapError:
    """Return the same error with the name of the format."""
    if entry.format in error.detail:
        return error
    return type(error)(f"{entry.format}: {error.detail}", error.problems)


def _levels(version: Version) -> list[dict[str, Any]]:
    """List the levels, lowest first; a level that only occurs as the name of a part is at 0 m."""
    heights = {entry.key.level: 0.0 for entry in version.parts} | {one.name: one.elevation for one in version.levels}
    return [{"name": name, "elevation": heights[name]} for name in sorted(heights, key=lambda n: (heights[n], n))]


def _layers(version: Version) -> dict[str, str]:
    """Hash each layer's content: a robot with two manifests can tell which layers differ without a request."""
    parts: dict[str, list[Any]] = {}
    for entry in version.parts:
        parts.setdefault(entry.key.layer, []).append([entry.key.level, entry.key.name, entry.hash])
    frame = frame_input(version.datum, version.levels)
    if version.datum is not None or "location" in parts:
        parts.setdefault("location", []).append(frame)
    return {name: hashlib.sha256(json_bytes(lines)).hexdigest()[:LAYER_DIGITS] for name, lines in sorted(parts.items())}


def _entries(required: str, optional: str) -> list[_Entry]:
    """Parse the formats of a request. Raises Invalid for unknown or duplicate formats and unreadable parameters."""
    entries = [_entry(text, "formats", required=True) for text in required.split(",") if text.strip()]
    if not entries:
        raise Invalid(
            f"no format given: list 1 to {MAX_FORMATS} formats, comma-separated",
            [Problem("must not be empty", where="formats")],
        )
    entries += [_entry(text, "optional", required=False) for text in optional.split(",") if text.strip()]
    names = [entry.format for entry in entries]
    if len(names) > MAX_FORMATS:
        raise Invalid(
            f"too many formats: list 1 to {MAX_FORMATS}, comma-separated", [Problem("too many", where="formats")]
        )
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        reason = f"duplicate format {twice}: give each format once"
        raise Invalid(reason, [Problem(reason, where="formats")])
    return entries


def _entry(text: str, location: str, *, required: bool) -> _Entry:
    name, _, query = text.strip().partition("?")
    fmt = require_format(name, location)
    if fmt.write is None:
        raise Invalid(
            f"{name} cannot be written: see GET /api/v1/formats for formats with write",
            [Problem("read-only format", where=location)],
        )
    try:
        values, derive, closures = parse_options(query)
        writer_options(fmt, values)
    except Invalid as error:
        raise Invalid(f"{name}: {error.detail}", error.problems) from None
    return _Entry(name, values, derive, closures, required, dict(parse_qsl(query, keep_blank_values=True)))

"""What a robot verifies: a signed list of a version's files, and the keys that sign."""

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
from app.api.http.schemas import EnvironmentPath, VersionPath, problem_responses
from app.convert import site
from app.convert.cache import CachedMap
from app.convert.recipe import Recipe, writer_options
from app.errors import CannotConvert, FleetMapError, Invalid, NotFound, Problem
from app.events.messages import SIGNATURE
from app.model.closures import NO_CLOSURES, ClosureMode
from app.store.values import Version, frame_input

STEP_SECONDS = 600
"""The time of expiry moves in steps, so that a robot that polls gets the same bytes, and 304."""

MAX_FORMATS = 32
MAX_LIST = 4000
"""Characters of a list of formats with their parameters."""

UNAVAILABLE = (CannotConvert, NotFound, Invalid)
"""Why a format cannot be given. Anything else concerns the whole request."""

LAYER_DIGITS = 16


class KeyOut(BaseModel):
    """A public key; bytes in base64."""

    id: str
    algorithm: Literal["Ed25519"]
    public_key: str
    created: datetime
    endorsed_by: str | None = None
    endorsement: str | None = None


class ManifestFile(BaseModel):
    """One file of a map."""

    format: str
    name: str = Field(description="With the folder of its level, if that is not the default one: `L2/map.yaml`.")
    size: int
    sha256: str
    level: str | None = Field(None, description="Of a file that belongs to one level.")


class ManifestLevel(BaseModel):
    """A storey."""

    name: str
    elevation: float = Field(description="Metres above the local origin.")


class ManifestMissing(BaseModel):
    """An optional format that cannot be given."""

    format: str
    detail: str = Field(description="Why, and what to supply.")


class ManifestOut(BaseModel):
    """What a robot verifies; its signature is in a header."""

    environment: str
    channel: str | None = None
    epoch: int = Field(
        0,
        description="Order is by epoch, then sequence. The operator raises it after a restore; left out at 0.",
    )
    sequence: int
    version: int
    root: str
    time: datetime = Field(description="When it was signed, in steps of ten minutes.")
    expires: datetime
    levels: list[ManifestLevel] = Field(description="From the lowest up.")
    files: list[ManifestFile]
    missing: list[ManifestMissing] = Field([], description="Optional formats that cannot be given; left out if none.")
    overlays: list[dict[str, Any]] = Field(
        [], description="The closures in force that its files show, by id; left out if there are none."
    )
    closures: Literal["mark", "ignore"] | None = Field(
        None, description="How its files show the closures in force; left out for `apply`."
    )
    parameters: dict[str, dict[str, str]] = Field(
        {}, description="The parameters that each format was requested with; left out if there are none."
    )
    overlays_digest: str = Field(description="SHA-256 of that list; `Fleetmap-Overlays` of each file.")
    layers: dict[str, str] = Field(description="A hash of each layer: equal where the layer is, in any two versions.")
    variables: dict[str, str] | None = Field(
        None, description="What the place is called: literal variables of an environment_template's scripts."
    )


ClosuresQuery = Annotated[
    ClosureMode | None,
    Query(
        description="How maps show the closures in force: `apply` (closed edges are left out of formats that "
        "cannot express a blocked edge), `mark` or `ignore`. Default: `apply`, but `ignore` for a version's number."
    ),
]

router = api_router("manifest")


@router.get("/keys", responses=problem_responses(list[KeyOut]), summary="Keys that sign manifests")
def list_keys(services: ServicesDep, _: Viewer) -> Response:
    """The newest first: it signs. `endorsement` is the signature of the key before it over the raw public key."""
    return json_response([key.as_dict() for key in services.keys.public()])


@router.post(
    "/keys",
    status_code=201,
    responses=problem_responses(KeyOut, ok=201, description="The new key"),
    summary="Rotate the key",
)
def rotate_key(services: ServicesDep, _: ServerAdmin) -> Response:
    """From now on a new key signs. Robots that trust the old one follow, since it vouches for the new one. Takes a
    token for all environments.

    Signed links get a new secret as well; links that were made before stay valid until they expire.
    """
    try:
        with services.store.audit.changing():
            key = services.keys.rotate()
            services.links.rotate()
    finally:
        services.store.generation.change()  # what was signed with the old key is in memory no longer
    return json_response(key.as_dict(), 201)


@router.get(
    "/environments/{env}/versions/{v}/manifest",
    responses={**problem_responses(ManifestOut, 404, 409), 304: {"description": "The client has it"}},
    summary="A signed list of a version's files",
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
            description="Formats, comma-separated. Each may carry parameters as in an address: "
            "`occupancy_grid?level=L2&grid=map,tmap2`; a comma or `&` in a value is percent-encoded once more. "
            "Default of a format that has levels and named parts: all of them.",
            max_length=MAX_LIST,
            examples=["geojson,kml"],
        ),
    ],
    optional: Annotated[
        str,
        Query(
            description="Further formats, written in the same way. Those that cannot be given are listed in `missing`.",
            max_length=MAX_LIST,
            examples=["lanelet2"],
        ),
    ] = "",
    closures: ClosuresQuery = None,
) -> Response:
    """Names, sizes and hashes of the files of maps, signed with the server's key over exactly these bytes.

    The header `Fleetmap-Signature` is `<key id>:<base64 of the Ed25519 signature>`; `/keys` has the keys. `sequence`
    is that of the event that brought the channel (or the version) there, or that last changed which closures are in
    force: a robot refuses a lower one. Files of a level other than the default one are below a folder of its name;
    `level` names a file's level.
    """
    entries = _entries(formats, optional)
    cached_maps: dict[str, CachedMap] = {}
    while True:
        outcome = await services.response_cache.run_shared(
            request, _sign_manifest, services, env, v, entries, closures, request, {}
        )
        if (
            isinstance(outcome, _PendingConversion) and outcome.recipe.key in cached_maps
        ):  # the cache has no room for all of them at once
            outcome = await run_in_threadpool(_sign_manifest, services, env, v, entries, closures, request, cached_maps)
        if not isinstance(outcome, _PendingConversion):
            break
        try:
            conversion = await services.jobs.get_or_start(outcome.recipe, principal, request_address(request))
        except UNAVAILABLE as error:
            if outcome.entry.required:
                raise _with_format_name(error, outcome.entry) from error
            continue  # it is remembered: the next look lists it as missing
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
    """A format of the request, with the parameters of its maps. requested: all of them, as texts."""

    format: str
    values: Mapping[str, str]
    derive: bool
    closures: ClosureMode | None
    required: bool
    requested: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class _PendingConversion:
    """A map that is to be made before the manifest can be written."""

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
    """The headers and the signed bytes; the first map that is to be made before that can be said.

    cached_maps: maps that were made for this answer, by their recipes' keys: they may have left the cache again.
    """
    channel = None if isinstance(parse_version_ref(v), int) else v
    generation = services.response_cache.generation()
    version, sequence = services.store.channels.target(env, parse_version_ref(v), mode)
    closures = version.closures or NO_CLOSURES
    listed = _list_files(services, version, entries, cached_maps)
    if isinstance(listed, _PendingConversion):
        return listed
    files, missing = listed
    now = datetime.now(UTC).timestamp()
    signed = (int(now) // STEP_SECONDS) * STEP_SECONDS
    body: dict[str, Any] = {"environment": env}
    if channel is not None:
        body["channel"] = channel
    body |= {
        "sequence": sequence,
        "version": version.number,
        "root": version.root,
        "time": _seconds(signed),
        "expires": _seconds(signed + services.options.manifest_seconds),
        "levels": _levels(version),
        "files": files,
        "overlays_digest": closures.digest,
        "layers": _layers(version),
    }
    # What is not the default is signed: nobody on the way can change what was requested. A robot pays for each byte
    # with every change: what is empty is left out.
    shown = version.closures.mode if version.closures is not None else "ignore"
    parameters = {entry.format: entry.requested for entry in entries if entry.requested}
    body |= {"closures": shown} if shown != "apply" else {}
    body |= {"parameters": parameters} if parameters else {}
    body |= {"epoch": epoch} if (epoch := services.store.epoch()) else {}
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
    """RFC 3339 in UTC, to the second."""
    return datetime.fromtimestamp(int(moment), UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def _list_files(
    services: Services, version: Version, entries: list[_Entry], cached_maps: Mapping[str, CachedMap]
) -> tuple[list[dict[str, Any]], list[dict[str, str]]] | _PendingConversion:
    """The files of all formats, and the optional formats that cannot be given; or a map that is to be made first."""
    files: list[dict[str, Any]] = []
    missing: list[dict[str, str]] = []
    for entry in entries:
        try:
            recipe = _recipe(services, version, entry)
            cached_map = services.maps.get_cached(recipe) or cached_maps.get(recipe.key)
            failure = None if cached_map is not None or entry.required else services.maps.failure(recipe)
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
    """Plan the whole site in a format, or what the entry's parameters select of it."""
    values = {**site.whole_site_options(formats.get_format(entry.format)), **entry.values}
    if entry.closures is not None:
        in_force = version.closures or services.store.overlays.closures(version.environment)
        version = replace(version, closures=in_force.for_mode(entry.closures))
    return services.maps.recipe(version, entry.format, values, derive=entry.derive, listed=True)


def _with_format_name(error: FleetMapError, entry: _Entry) -> FleetMapError:
    """The same error, saying which format cannot be given."""
    if entry.format in error.detail:
        return error
    return type(error)(f"{entry.format}: {error.detail}", error.problems)


def _levels(version: Version) -> list[dict[str, Any]]:
    """The levels from the lowest up; one that only parts name is at 0 m."""
    heights = {entry.key.level: 0.0 for entry in version.parts} | {one.name: one.elevation for one in version.levels}
    return [{"name": name, "elevation": heights[name]} for name in sorted(heights, key=lambda n: (heights[n], n))]


def _layers(version: Version) -> dict[str, str]:
    """A hash of each layer's content: who has two manifests knows which layers differ, without asking anybody."""
    parts: dict[str, list[Any]] = {}
    for entry in version.parts:
        parts.setdefault(entry.key.layer, []).append([entry.key.level, entry.key.name, entry.hash])
    frame = frame_input(version.datum, version.levels)
    if version.datum is not None or "location" in parts:
        parts.setdefault("location", []).append(frame)
    return {name: hashlib.sha256(json_bytes(lines)).hexdigest()[:LAYER_DIGITS] for name, lines in sorted(parts.items())}


def _entries(required: str, optional: str) -> list[_Entry]:
    """The formats of a request. Invalid for unknown ones, for what is named twice, and for unreadable parameters."""
    entries = [_entry(text, "formats", required=True) for text in required.split(",") if text.strip()]
    if not entries:
        raise Invalid(f"name 1 to {MAX_FORMATS} formats, comma-separated", [Problem("empty", where="formats")])
    entries += [_entry(text, "optional", required=False) for text in optional.split(",") if text.strip()]
    names = [entry.format for entry in entries]
    if len(names) > MAX_FORMATS:
        raise Invalid(f"name 1 to {MAX_FORMATS} formats, comma-separated", [Problem("too many", where="formats")])
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        reason = f"the format {twice} is named twice: give each format once"
        raise Invalid(reason, [Problem(reason, where="formats")])
    return entries


def _entry(text: str, location: str, *, required: bool) -> _Entry:
    name, _, query = text.strip().partition("?")
    fmt = require_format(name, location)
    if fmt.write is None:
        raise Invalid(f"{name} is not served", [Problem("not served", where=location)])
    try:
        values, derive, closures = parse_options(query)
        writer_options(fmt, values)
    except Invalid as error:
        raise Invalid(f"{name}: {error.detail}", error.problems) from None
    return _Entry(name, values, derive, closures, required, dict(parse_qsl(query, keep_blank_values=True)))

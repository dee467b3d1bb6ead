"""What a robot verifies: a signed list of a version's files, and the keys that sign."""

from __future__ import annotations

import asyncio
import base64
import dataclasses
import hashlib
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Annotated, Any

from fastapi import APIRouter, Query, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from app import formats
from app.api.access import Admin, Viewer
from app.api.answers import Route, answer, json_bytes
from app.api.caching import none_match
from app.api.jobs import Started, started
from app.api.maps import address_of, number_of
from app.api.schemas import EnvironmentPath, KeyOut, ManifestOut, VersionPath, told
from app.api.services import Here, Services
from app.convert import Recipe
from app.convert.cache import Made
from app.errors import CannotDerive, Invalid, NotFound, Problem
from app.events.messages import SIGNATURE
from app.store.values import Version, frame_line, rfc3339

STEP_SECONDS = 600
"""The time of expiry moves in steps, so that a robot that polls gets the same bytes, and 304."""

MAX_FORMATS = 32
LAYER_DIGITS = 16

router = APIRouter(tags=["manifest"], route_class=Route)


@router.get("/keys", responses=told(list[KeyOut]), summary="Keys that sign manifests")
def list_keys(here: Here, _: Viewer) -> Response:
    """The newest first: it signs. `endorsement` is the signature of the key before it over the raw public key."""
    return answer([key.as_dict() for key in here.keys.public()])


@router.post(
    "/keys", status_code=201, responses=told(KeyOut, ok=201, description="The new key"), summary="Rotate the key"
)
def rotate_key(here: Here, _: Admin) -> Response:
    """From now on a new key signs. Robots that trust the old one follow, since it vouches for the new one.

    Signed links get a new secret as well; links that were made before stay valid until they expire.
    """
    made = here.keys.rotate()
    here.links.rotate()
    here.store.generation.change()  # what was signed with the old key is in memory no longer
    return answer(made.as_dict(), 201)


@router.get(
    "/environments/{env}/versions/{v}/manifest",
    responses={**told(ManifestOut, 404, 409), 304: {"description": "The client has it"}},
    summary="A signed list of a version's files",
)
async def get_manifest(
    env: EnvironmentPath,
    v: VersionPath,
    request: Request,
    here: Here,
    who: Viewer,
    formats: Annotated[
        str,
        Query(
            description="Formats, separated by commas; of grids all are listed.",
            max_length=1000,
            examples=["geojson,kml"],
        ),
    ],
) -> Response:
    """Names, sizes and hashes of the files of maps, signed with the server's key over exactly these bytes.

    The header `Fleetmap-Signature` is `<key id>:<base64 of the Ed25519 signature>`; `/keys` has the keys. `sequence`
    is that of the event that brought the channel (or the version) there: a robot refuses a lower one.
    """
    names = _names(formats)
    made: dict[str, Made] = {}
    while True:
        found = await here.hot.shared(request, _signed, here, env, v, names, request, {})
        if isinstance(found, Recipe) and found.key in made:  # the cache has no room for all of them at once
            found = await run_in_threadpool(_signed, here, env, v, names, request, made)
        if not isinstance(found, Recipe):
            break
        outcome = await _made(here, found, request, who)
        if isinstance(outcome, Started):
            return started(outcome.job)
        if outcome is not None:
            made[found.key] = outcome
    headers, data = found
    if none_match(request.headers.get("if-none-match"), headers["etag"]):
        return Response(status_code=304, headers=headers)
    return Response(data, 200, headers, "application/json")


def _signed(
    here: Services, env: str, v: str, names: list[str], request: Request, known: Mapping[str, Made]
) -> tuple[dict[str, str], bytes] | Recipe:
    """The headers and the signed bytes; the first map that is to be made before that can be said.

    known: maps that were made for this answer, by their recipes' keys: they may have left the cache again.
    """
    channel = None if isinstance(number_of(v), int) else v
    generation = here.hot.generation()
    version, sequence = here.store.standing(env, number_of(v))
    files: list[dict[str, Any]] = []
    for name in names:
        seen: set[str] = set()
        for values in _variants(name, version):
            recipe = here.maps.recipe(version, name, values)
            made = here.maps.ready(recipe) or known.get(recipe.key)
            if made is None:
                return recipe
            for file in made.files:
                if file.name not in seen:
                    seen.add(file.name)
                    files.append({"format": name, "name": file.name, "size": file.size, "sha256": file.sha256})
    now = datetime.now(UTC).timestamp()
    expires = (int(now) // STEP_SECONDS) * STEP_SECONDS + here.options.manifest_seconds
    body: dict[str, Any] = {"environment": env}
    if channel is not None:
        body["channel"] = channel
    body |= {
        "sequence": sequence,
        "version": version.number,
        "root": version.root,
        "expires": rfc3339(datetime.fromtimestamp(expires, UTC)),
        "files": sorted(files, key=lambda f: (f["format"], f["name"])),
        "layers": _layers(version),
    }
    variables = here.maps.variables(version)
    if variables:
        body["variables"] = variables
    data = json_bytes(body)
    key, signature = here.keys.sign(data)
    signed = f"{key}:{base64.b64encode(signature).decode()}"
    headers = {"etag": f'"{signed[-40:-2]}"', "cache-control": "no-cache", SIGNATURE: signed}
    here.hot.keep(request, env, headers, data, generation)
    return headers, data


def _layers(version: Version) -> dict[str, str]:
    """A hash of each layer's content: who has two manifests knows which layers differ, without asking anybody."""
    parts: dict[str, list[Any]] = {}
    for entry in version.parts:
        parts.setdefault(entry.key.layer, []).append([entry.key.level, entry.key.name, entry.hash])
    frame = frame_line(version.datum, version.levels)
    if version.datum is not None or "location" in parts:
        parts.setdefault("location", []).append(frame)
    return {name: hashlib.sha256(json_bytes(lines)).hexdigest()[:LAYER_DIGITS] for name, lines in sorted(parts.items())}


def _names(text: str) -> list[str]:
    names = list(dict.fromkeys(part.strip() for part in text.split(",") if part.strip()))
    if not names or len(names) > MAX_FORMATS:
        raise Invalid(f"name 1 to {MAX_FORMATS} formats, separated by commas", [Problem("empty", where="formats")])
    for name in names:
        try:
            known = formats.get_format(name)
        except NotFound as error:
            raise Invalid(error.detail, [Problem("no such format", where="formats")]) from None
        if known.write is None:
            raise Invalid(f"{name} is not served", [Problem("not served", where="formats")])
    return names


def _variants(name: str, version: Version) -> list[dict[str, str]]:
    """The options under which a robot may fetch files of a format by their names alone: each grid on its own."""
    known = formats.get_format(name)
    own = {f.name for f in dataclasses.fields(known.write_options)}
    grids = sorted({e.key.name for e in version.parts if e.key.layer == "occupancy" and e.count})
    if "occupancy" in known.carries and "grid" in own and known.by_file("keepout.yaml") and len(grids) > 1:
        return [{"grid": grid} for grid in grids]
    return [{}]


async def made_for(
    here: Services, version: Version, name: str, values: dict[str, str], request: Request, who: Any
) -> Made | Started:
    """A version's map in a format, with these options; the job where it takes long."""
    while True:
        recipe: Recipe = await run_in_threadpool(here.maps.recipe, version, name, values)
        made = await run_in_threadpool(here.maps.ready, recipe) or await _made(here, recipe, request, who)
        if made is not None:
            return made


async def _made(here: Services, recipe: Recipe, request: Request, who: Any) -> Made | Started | None:
    """A map that is not ready, or the job that makes it. None where it cannot be derived so: the next recipe goes
    another way, or says that there is none.
    """
    try:
        return await here.work.make(recipe, who, address_of(request))
    except CannotDerive:
        await asyncio.sleep(0)
        return None

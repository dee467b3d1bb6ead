"""Signed links to maps, for clients that cannot send a token."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from urllib.parse import quote, urlencode

from fastapi import Request
from pydantic import BaseModel, ConfigDict, Field
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from app.api.http.addresses import MapRequest, origin, resolve_recipe
from app.api.http.auth import Principal, Viewer
from app.api.http.conversions import JobStarted, job_started_response
from app.api.http.dependencies import Services, ServicesDep
from app.api.http.parameters import parse_options, parse_version_ref
from app.api.http.responses import API, api_path, api_router, json_response
from app.api.http.schemas import EnvironmentPath, RequestModel, VersionPath, problem_responses
from app.api.http.signed import Grant
from app.convert.cache import CachedFile
from app.convert.maps import select_file
from app.errors import Unavailable
from app.store.audit import set_audit_target
from app.store.values import Version, rfc3339


class LinkBody(RequestModel):
    """Map, or file of a map, to which a signed link gives access."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"format": "geojson", "file": "map.geojson", "seconds": 3600}]},
    )

    format: str = Field(max_length=64, description="Id of the format.")
    file: str | None = Field(
        None,
        min_length=1,
        max_length=1000,
        description="One file of the map. Default: the complete map, as its file or a zip.",
    )
    parameters: dict[str, str | int | float | bool] = Field(
        default_factory=dict, max_length=50, description="Parameters of the map, as in its URL."
    )
    seconds: int | None = Field(
        None,
        ge=1,
        description="Lifetime of the link in seconds. Default and maximum: the setting `FLEETMAP_LINK_SECONDS`.",
    )


class LinkOut(BaseModel):
    """Signed link, with the file to which it gives access."""

    url: str = Field(description="Link that needs no token until it expires. Anyone who has it can read this map.")
    expires: datetime
    version: int
    root: str
    name: str = Field(description="Name of the file.")
    size: int = Field(description="Size of the file in bytes.")
    sha256: str


router = api_router("maps", "/environments/{env}/versions/{v}")


@router.post(
    "/links",
    status_code=201,
    responses={
        **problem_responses(LinkOut, 400, 404, 409, 415, ok=201, description="The link"),
        202: {"description": "The conversion takes long: follow the job at `Location`, then repeat the request."},
    },
    summary="Create a signed link to a map",
)
async def create_link(
    env: EnvironmentPath, v: VersionPath, body: LinkBody, request: Request, services: ServicesDep, principal: Viewer
) -> Response:
    """Create a link to a map that needs no token until it expires, for `GET` and `HEAD`.

    The link names the version by number, so its bytes never change. It stops working when the environment is deleted
    or the token that created it expires, but not when that token is revoked. The map is converted first: if that
    fails, there is no link.
    """
    services.links.check_life(body.seconds)
    version = await run_in_threadpool(services.store.versions.get_committed, env, parse_version_ref(v))
    values = {name: _text(value) for name, value in body.parameters.items()}
    linked = await link_to(services, request, principal, version, body.format, body.file, values, body.seconds)
    if isinstance(linked, JobStarted):
        return job_started_response(linked.job)
    set_audit_target(target=f"link to {body.format} of version {version.number}, until {linked.expires}")
    await run_in_threadpool(services.store.audit.record_change)
    out = {
        "url": linked.url,
        "expires": linked.expires,
        "version": version.number,
        "root": version.root,
        "name": linked.file.name,
        "size": linked.file.size,
        "sha256": linked.file.sha256,
    }
    return json_response(out, 201, {"cache-control": "no-store"})


@dataclass(frozen=True, slots=True)
class LinkedFile:
    """File behind a link. url: full address. expires: RFC 3339; None for a link that needs a token."""

    url: str
    expires: str | None
    file: CachedFile


async def link_to(
    services: Services,
    request: Request,
    principal: Principal,
    version: Version,
    format: str,
    file: str | None,
    values: dict[str, str],
    seconds: int | None = None,
    *,
    signed: bool = True,
) -> LinkedFile | JobStarted:
    """Convert a version's map, and link to it or to one of its files; return a job if the conversion takes long.

    Args:
        values: parameters of the map, as in its URL.
        seconds: lifetime of the link. Default: the maximum.
        signed: create a link that needs no token.

    Raises the errors of the conversion; NotFound if the map has no such file.
    """
    query = urlencode(sorted(values.items()))
    wanted = MapRequest(version.environment, str(version.number), format, file, *parse_options(query))
    address = api_path("environments", version.environment, "versions", version.number, "maps", format)
    plan = partial(resolve_recipe, services, wanted)
    outcome = await services.jobs.convert(plan, principal, f"{address}?{query}" if query else address)
    if isinstance(outcome, JobStarted):
        return outcome
    map_file = select_file(*outcome, file)
    path = f"{API}/environments/{version.environment}/versions/{version.number}/maps/{format}"
    path += "" if file is None else f"/{file}"

    base = origin(request, services.options.public_url)
    if not signed:
        return LinkedFile(base + quote(path, safe="/") + (f"?{query}" if query else ""), None, map_file)

    def sign() -> Grant:
        environment = services.store.environments.get(version.environment)
        grant = services.links.create(environment, path, values, seconds or services.links.max_seconds, principal)
        with contextlib.suppress(Unavailable):  # a full disk: nothing can be thinned either
            services.store.retention.note_link(version.environment, version.number, grant.expires)
        return grant

    grant = await run_in_threadpool(sign)
    return LinkedFile(base + grant.url, rfc3339(grant.expires), map_file)


def _text(value: str | float | bool) -> str:
    """Format a parameter as in a URL."""
    if isinstance(value, bool):
        return "true" if value else "false"
    return value if isinstance(value, str) else repr(value)

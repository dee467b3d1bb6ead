"""Signed links to maps, for clients that have no place for a token."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from functools import partial
from urllib.parse import quote, urlencode

from fastapi import Request
from pydantic import BaseModel, ConfigDict, Field
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from app.api.http.addresses import MapRequest, resolve_recipe
from app.api.http.auth import Principal, Viewer
from app.api.http.conversions import JobStarted, job_started_response
from app.api.http.dependencies import Services, ServicesDep
from app.api.http.parameters import parse_options, parse_version_ref
from app.api.http.responses import API, api_path, api_router, json_response
from app.api.http.schemas import EnvironmentPath, RequestModel, VersionPath, problem_responses
from app.api.http.signed import Grant
from app.convert.cache import CachedFile
from app.convert.maps import select_file
from app.store.audit import set_audit_target
from app.store.values import Version, rfc3339


class LinkBody(RequestModel):
    """The map, or one file of it, that a signed link gives."""

    model_config = ConfigDict(
        json_schema_extra={"examples": [{"format": "geojson", "file": "map.geojson", "seconds": 3600}]},
    )

    format: str = Field(max_length=64, description="A format's id.")
    file: str | None = Field(
        None, min_length=1, max_length=1000, description="One file of the map; left out: the file itself or a zip."
    )
    parameters: dict[str, str | int | float | bool] = Field(
        default_factory=dict, max_length=50, description="Parameters of the map, as in its address."
    )
    seconds: int | None = Field(
        None, ge=1, description="Life of the link. Default and maximum: the setting `FLEETMAP_LINK_SECONDS`."
    )


class LinkOut(BaseModel):
    """A signed link, and the file that it gives."""

    url: str = Field(description="Needs no token until it expires. Whoever has it can read this map.")
    expires: datetime
    version: int
    root: str
    name: str = Field(description="Of the file.")
    size: int = Field(description="Bytes.")
    sha256: str


router = api_router("maps", "/environments/{env}/versions/{v}")


@router.post(
    "/links",
    status_code=201,
    responses={
        **problem_responses(LinkOut, 400, 404, 409, 415, ok=201, description="The link"),
        202: {"description": "The map takes long: follow the job at `Location`, then ask again."},
    },
    summary="Create a signed link to a map",
)
async def create_link(
    env: EnvironmentPath, v: VersionPath, body: LinkBody, request: Request, services: ServicesDep, principal: Viewer
) -> Response:
    """The `url` needs no token until it `expires`, for `GET` and `HEAD` alone.

    It names the version by number, so that its bytes stay the same, and ends with the environment. It does not outlive
    the token that created it, but is not revoked with it. The map is converted first: a map that cannot be made has no
    link.
    """
    services.links.check_life(body.seconds)
    version = await run_in_threadpool(services.store.versions.get, env, parse_version_ref(v))
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
    """A file behind a link. url: full address. expires: RFC 3339; None for a link that needs a token."""

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
    """Convert a version's map, and link to it or to one of its files; the job where converting takes long.

    Args:
        values: the map's parameters, as in its address.
        seconds: life of the link; default: the maximum.
        signed: whether the link needs no token.

    Raises what converting raises; NotFound for a file that the map does not have.
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

    base = str(request.base_url).rstrip("/")
    if not signed:
        return LinkedFile(base + quote(path, safe="/") + (f"?{query}" if query else ""), None, map_file)

    def sign() -> Grant:
        environment = services.store.environments.get(version.environment)
        return services.links.create(environment, path, values, seconds or services.links.max_seconds, principal)

    grant = await run_in_threadpool(sign)
    return LinkedFile(base + grant.url, rfc3339(grant.expires), map_file)


def _text(value: str | float | bool) -> str:
    """A parameter as an address has it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    return value if isinstance(value, str) else repr(value)

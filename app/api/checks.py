"""Mistakes in a version, by rules, with edits that repair them; also of a version with edits that are not stored."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Literal, TypeVar

from fastapi import Query, Request
from pydantic import BaseModel, ConfigDict, Field
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from app.api.http.auth import Viewer
from app.api.http.caching import none_match
from app.api.http.dependencies import Services, ServicesDep
from app.api.http.parameters import parse_version_ref
from app.api.http.response_cache import request_key
from app.api.http.responses import api_router, json_bytes
from app.api.http.schemas import EnvironmentPath, RequestModel, VersionPath, problem_responses
from app.api.versions import Change
from app.errors import NotFound, Unavailable
from app.ingest import check_depth
from app.pool import WorkerDied
from app.review.rules import MAX_FINDINGS, RULES, RuleName
from app.review.worker import check_version
from app.store.values import Version

RELEASE = 2
"""Rises with each change of the rules, so that clients do not keep findings of earlier ones."""

MAX_DRAFT = 10_000
"""Maximum number of edits in a draft: it is checked while someone draws."""


T = TypeVar("T")


class FixOut(BaseModel):
    """Edits that make a finding vanish: `changes` as the body of `POST …/edits` takes them."""

    title: str
    changes: list[Change]


class FindingOut(BaseModel):
    """One mistake."""

    rule: RuleName
    severity: Literal["error", "warning", "info"]
    layer: Literal["location", "objects", "topology", "occupancy", "voxels", "imagery", "zones", "resources"]
    level: str
    ids: list[str] = Field(description="Features that it is about, at most 50; those to repair come first.")
    where: list[float] | None = Field(
        description="Position [x, y] in metres of the local frame; null if the environment has no datum to convert it."
    )
    detail: str
    fix: FixOut | None = Field(description="A repair, if there is an obvious one.")


class RuleOut(BaseModel):
    """A rule by which versions are checked."""

    rule: RuleName
    title: str
    severity: Literal["error", "warning", "info"]


class ChecksOut(BaseModel):
    """Findings in a version, errors first. `rules`: all that were checked."""

    version: int | str
    items: list[FindingOut] = Field(description=f"At most {MAX_FINDINGS}.")
    truncated: bool = Field(description="There are more findings than these.")
    rules: list[RuleOut]


class DraftBody(RequestModel):
    """Edits that are applied before the check, as in `POST …/edits`."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {
                    "changes": [
                        {
                            "op": "put",
                            "layer": "topology",
                            "feature": {
                                "type": "Feature",
                                "id": "shed",
                                "geometry": {"type": "Point", "coordinates": [5.6134, 52.4207]},
                                "properties": {"kind": "node", "name": "shed"},
                            },
                        }
                    ]
                }
            ]
        },
    )

    changes: list[Change] = Field(min_length=1, max_length=MAX_DRAFT)


router = api_router("versions", "/environments/{env}/versions/{v}")

Level = Annotated[
    str | None,
    Query(min_length=1, max_length=256, description="Only findings on this level. Default: all levels."),
]


@router.get(
    "/checks",
    responses={
        **problem_responses(ChecksOut, 404, 503),
        304: {"description": "Not modified: the client has these findings"},
    },
    summary="Check a version for mistakes",
)
async def get_checks(
    env: EnvironmentPath, v: VersionPath, request: Request, services: ServicesDep, _: Viewer, level: Level = None
) -> Response:
    """Return mistakes in the network and what stands in its way, with edits that repair them.

    Closures in force do not count: they are no part of a version.
    """
    generation = services.response_cache.generation()  # before the read: a commit meanwhile makes the response stale
    version = await run_in_threadpool(services.store.versions.get, env, parse_version_ref(v))
    _require_level(version, level)
    etag = f'"{hashlib.sha256(json_bytes(["checks", RELEASE, version.root, version.ref, level])).hexdigest()[:32]}"'
    headers = {
        "etag": etag,
        "cache-control": "no-cache",
        "fleetmap-version": str(version.ref),
        "fleetmap-root": version.root,
    }
    if none_match(request.headers.get("if-none-match"), etag):
        return Response(status_code=304, headers=headers)
    cached = services.response_cache.get(request_key(request))
    if cached is not None and cached.etag == etag and cached.body is not None:
        body = cached.body  # of the same root, so still valid after commits
    else:
        key = ("checks", version.root, version.ref, env, level)
        body = await services.response_cache.join(key, _checks, services, version, level)
    services.response_cache.store_response(request, env, headers, body, generation)
    return Response(body, headers=headers, media_type="application/json")


@router.post(
    "/checks",
    responses=problem_responses(ChecksOut, 400, 404, 409, 413, 415, 503),
    summary="Check a version with edits that are not stored",
)
async def check_draft(
    env: EnvironmentPath, v: VersionPath, body: DraftBody, services: ServicesDep, _: Viewer, level: Level = None
) -> Response:
    """Return the mistakes that the version would have with these edits. Stores nothing.

    Invalid edits are refused as by `POST …/edits`.
    """
    changes = [change.model_dump(exclude_none=True) for change in body.changes]
    check_depth(changes)
    version = await run_in_threadpool(services.store.versions.get, env, parse_version_ref(v))
    if level is not None and all(change.get("level") != level for change in changes):
        _require_level(version, level)
    return Response(await run_in_threadpool(_checks, services, version, level, changes), media_type="application/json")


def run_review(services: Services, function: Callable[..., T], *args: Any) -> T:
    """Run a review of stored versions in a worker. Blocks. Raises Unavailable if it takes too long."""
    store = services.store
    try:
        result: T = services.pool.run(function, store.database_url, str(store.blob_dir), *args)
    except WorkerDied as error:
        raise Unavailable(f"the version could not be reviewed: {error.detail}") from error
    return result


def _checks(
    services: Services, version: Version, level: str | None, changes: Sequence[Mapping[str, Any]] = ()
) -> bytes:
    result = run_review(services, check_version, version, level, changes)
    rules = [rule.as_dict() for rule in RULES]
    return json_bytes({"version": version.ref, **result, "rules": rules})


def _require_level(version: Version, level: str | None) -> None:
    """Raise NotFound if a version lacks a level."""
    names = [other.name for other in version.levels]
    if level is not None and level not in names:
        raise NotFound(f"version {version.ref} has no level {level[:80]!r}; its levels: {', '.join(names[:50])}")

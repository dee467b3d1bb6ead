"""Jobs: conversions that take longer than an answer may."""

from __future__ import annotations

import itertools
from datetime import datetime
from typing import Annotated, Any, Literal

from fastapi import Path, Query
from pydantic import BaseModel
from starlette.responses import Response

from app.api.http.auth import Principal, Viewer
from app.api.http.conversions import job_as_json
from app.api.http.dependencies import ServicesDep
from app.api.http.responses import api_router, json_response
from app.api.http.schemas import Limit, ProblemOut, problem_responses
from app.errors import NotFound
from app.store.values import Job, State


class JobOut(BaseModel):
    """Work that takes long."""

    id: str
    state: Literal["queued", "running", "done", "failed", "cancelled"]
    progress: float
    detail: str
    result: dict[str, Any] | None = None
    problem: ProblemOut | None = None
    created: datetime
    updated: datetime


JobPath = Annotated[str, Path(max_length=100, description="A job's id.")]

router = api_router("jobs", "/jobs")


def _require_job_owner(services: ServicesDep, principal: Principal, id: str) -> Job:
    """A job that the caller may see; NotFound for all others, as if there were none."""
    job = services.store.jobs.get(id)
    if job.owner != principal.id and not (principal.has_role("admin") and principal.environments is None):
        raise NotFound(f"there is no job {id[:80]!r}")
    return job


@router.get("", responses=problem_responses(list[JobOut]), summary="List jobs")
def list_jobs(
    services: ServicesDep,
    principal: Viewer,
    state: Annotated[State | None, Query(description="Only jobs in this state.")] = None,
    limit: Limit = 100,
) -> Response:
    """List the jobs of the own token, newest first; administrators whose token is for all environments see all."""
    every = principal.role == "admin" and principal.environments is None
    visible_jobs = (job for job in reversed(services.store.jobs.all()) if every or job.owner == principal.id)
    bodies = (body for body in map(job_as_json, visible_jobs) if state in (None, body["state"]))
    return json_response(list(itertools.islice(bodies, limit)))


@router.get("/{id}", responses=problem_responses(JobOut, 404), summary="How far a job is")
def get_job(id: JobPath, services: ServicesDep, principal: Viewer) -> Response:
    """A job of the own token; an administrator of all environments sees all. ``result.location`` is where a
    finished map is had.
    """
    return json_response(job_as_json(_require_job_owner(services, principal, id)))


@router.delete("/{id}", status_code=204, responses=problem_responses(None, 404), summary="Cancel or forget a job")
def delete_job(id: JobPath, services: ServicesDep, principal: Viewer) -> Response:
    """Cancels a job that runs: the work is stopped, unless somebody else waits for it too. Forgets one that has
    ended.
    """
    job = _require_job_owner(services, principal, id)
    if job_as_json(job)["state"] in ("queued", "running"):
        services.store.jobs.update(id, state="cancelled", detail="cancelled")
        services.jobs.cancel(id)  # where another process is at it, that one notices within seconds
    else:
        services.store.jobs.delete(id)
    return Response(status_code=204)

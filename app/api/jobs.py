"""Jobs: conversions that outlive their request."""

from __future__ import annotations

import itertools
from datetime import datetime
from typing import Annotated, Any, Literal

from fastapi import Path, Query
from pydantic import BaseModel, Field
from starlette.responses import Response

from app.api.http.auth import Principal, Viewer
from app.api.http.conversions import job_as_json
from app.api.http.dependencies import ServicesDep
from app.api.http.responses import api_router, json_response
from app.api.http.schemas import Limit, ProblemOut, problem_responses
from app.errors import NotFound
from app.store.values import Job, State


class JobOut(BaseModel):
    """Long-running conversion."""

    id: str
    state: Literal["queued", "running", "done", "failed", "cancelled"]
    progress: float = Field(
        description="Part of the work that is done, from 0 to 1, by its steps; updated about once a second. A long "
        "step may take most of the time."
    )
    detail: str
    step: str | None = Field(None, description="What a running job does now: a derivation, `reading`, `storing` …")
    result: dict[str, Any] | None = None
    problem: ProblemOut | None = None
    created: datetime
    updated: datetime


JobPath = Annotated[str, Path(max_length=100, description="Id of the job.")]

router = api_router("jobs", "/jobs")


def _require_job_owner(services: ServicesDep, principal: Principal, id: str) -> Job:
    """Return a job that the caller may see. Raises NotFound for any other job, as if it did not exist."""
    job = services.store.jobs.get(id)
    if job.owner != principal.id and not (principal.has_role("admin") and principal.environments is None):
        raise NotFound(f"unknown job {id[:80]!r}")
    return job


@router.get("", responses=problem_responses(list[JobOut]), summary="List jobs")
def list_jobs(
    services: ServicesDep,
    principal: Viewer,
    state: Annotated[State | None, Query(description="Only jobs in this state.")] = None,
    limit: Limit = 100,
) -> Response:
    """List the jobs of the caller's token, newest first.

    Administrators with a token for all environments see all jobs.
    """
    every = principal.role == "admin" and principal.environments is None
    jobs = services.store.jobs.newest(None if every else principal.id)
    bodies = (body for body in map(job_as_json, jobs) if state in (None, body["state"]))
    return json_response(list(itertools.islice(bodies, limit)))


@router.get("/{id}", responses=problem_responses(JobOut, 404), summary="Get a job")
def get_job(id: JobPath, services: ServicesDep, principal: Viewer) -> Response:
    """Return the state of a job of the caller's token.

    Administrators with a token for all environments see all jobs. `result.location` is the address of the finished
    map.
    """
    return json_response(job_as_json(_require_job_owner(services, principal, id)))


@router.delete("/{id}", status_code=204, responses=problem_responses(None, 404), summary="Cancel or delete a job")
def delete_job(id: JobPath, services: ServicesDep, principal: Viewer) -> Response:
    """Cancel a running job, or delete a finished one.

    Cancelling stops the conversion unless another request waits for it.
    """
    job = _require_job_owner(services, principal, id)
    if job_as_json(job)["state"] in ("queued", "running"):
        services.store.jobs.update(id, state="cancelled", detail="cancelled")
        services.jobs.cancel(id)  # another process that runs it notices within seconds
    else:
        services.store.jobs.delete(id)
    return Response(status_code=204)

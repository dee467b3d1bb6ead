"""Synthetic sites: list the generators, run one and commit its result."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import Response

from app import generate
from app.api.http.auth import Editor, Viewer
from app.api.http.conversions import STARTED, Prefer, responds_async, work_response
from app.api.http.dependencies import CommitDep, ServicesDep
from app.api.http.responses import api_router, commit_response, json_response
from app.api.http.schemas import (
    MAX_TEXT,
    UNCHANGED_OR_DRY_RUN,
    DryRun,
    EnvironmentPath,
    RequestModel,
    VersionOut,
    problem_responses,
)
from app.errors import Invalid, NotFound, Problem
from app.generate import LIKE
from app.ingest import GenerationRequest


class GenerationBody(RequestModel):
    """Synthetic site to generate."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [{"generator": "orchard", "seed": 7, "parameters": {"rows": 6}, "replace": True}]
        },
    )

    generator: str = Field(max_length=200, description="Name of a generator; see `GET /api/v1/generators`.")
    seed: int = Field(
        0, ge=0, le=2**63 - 1, description="Random seed: the same seed and parameters give the same site."
    )
    parameters: dict[str, Any] = Field(default_factory=dict, description="Parameters of the generator.")
    message: str = Field("", max_length=MAX_TEXT)
    replace: bool = Field(False, description="Replace uploaded or edited content as well.")
    dry_run: DryRun = False


class GeneratorOut(BaseModel):
    """Generator of synthetic sites."""

    id: str
    title: str
    gives: list[str]
    needs: list[str] = Field(description="Layers that it requires.")
    changes: list[str] = Field(
        description="Layers of which it requires at least one, and changes those that exist. If `needs` and `changes` "
        "are empty, it creates a complete site."
    )
    version: int
    parameters: list[dict[str, Any]]


router = api_router("generations")


@router.get("/generators", responses=problem_responses(list[GeneratorOut]), summary="List generators")
def list_generators(_: Viewer) -> Response:
    """List the generators of synthetic sites with their parameters."""
    return json_response([generator.as_dict() for generator in generate.all_generators().values()])


@router.post(
    "/environments/{env}/generations",
    status_code=201,
    responses={
        **problem_responses(VersionOut, 400, 404, 409, 412, 415, 503, ok=201, description="A new version"),
        **UNCHANGED_OR_DRY_RUN,
        **STARTED,
    },
    summary="Generate a synthetic site and commit it",
)
def create_generation(
    env: EnvironmentPath,
    body: GenerationBody,
    services: ServicesDep,
    principal: Editor,
    commit: CommitDep,
    prefer: Prefer = None,
) -> Response:
    """Create a version whose provenance records generator, seed and parameters. The same values give the same layers.

    Layers that were generated before are replaced. Returns 409 if a layer was uploaded or edited, unless `replace` is
    true. The parameter `like` names an environment that the caller may read.
    """
    like = body.parameters.get(LIKE)
    if like not in (None, ""):
        principal.require_environment(str(like))
    order = GenerationRequest(body.generator, body.seed, body.parameters, body.replace)
    try:
        described = commit.with_message(body.message).as_dry_run(body.dry_run)
        if services.work is not None and services.work.has_workers():
            wait = not responds_async(prefer)
            return work_response(services.work.commit("generate", env, order, described, principal.id, wait=wait))
        outcome = services.ingest.generate(env, order, described)
    except NotFound as error:
        if body.generator in generate.all_generators():
            raise
        raise Invalid(error.detail, [Problem("unknown generator", where="body.generator")]) from None
    return commit_response(outcome)

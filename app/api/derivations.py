"""Layers computed from others: list the derivations, run one and commit its result."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import Response

from app import derive, parameters
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
from app.catalogue import describe_derivations
from app.errors import Invalid, NotFound, Problem
from app.ingest import DerivationRequest, online


class DerivationBody(RequestModel):
    """Derivation to run and commit."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [{"method": "objects_to_topology", "parameters": {"join": 0.5}, "replace": True}]
        },
    )

    method: str = Field(max_length=200, description="Name of a derivation; see `GET /api/v1/derivations`.")
    parameters: dict[str, Any] = Field(
        default_factory=dict, description="Parameters of the derivation, and of derivations that must run before it."
    )
    message: str = Field("", max_length=MAX_TEXT)
    replace: bool = Field(False, description="Replace uploaded or edited content as well.")
    dry_run: DryRun = False


class DerivationOut(BaseModel):
    """Derivation: computes a layer from others."""

    id: str
    title: str
    gives: str
    needs: list[str]
    cost: float
    version: int
    parameters: list[dict[str, Any]]


router = api_router("derivations")


def as_online() -> dict[str, Any]:
    """Describe the derivation that queries the online imagery provider; maps never run it implicitly."""
    return {
        "id": online.METHOD,
        "title": "Download an image of the site from the configured provider.",
        "gives": "imagery",
        "needs": ["location"],
        "cost": 100.0,
        "version": 1,
        "parameters": parameters.describe(online.Parameters),
    }


@router.get("/derivations", responses=problem_responses(list[DerivationOut]), summary="List derivations")
def list_derivations(services: ServicesDep, _: Viewer) -> Response:
    """List the derivations with their inputs and parameters.

    Maps run them when needed; pass their parameters in the query of a map.
    """
    return json_response(describe_derivations() + ([as_online()] if services.ingest.provider is not None else []))


@router.post(
    "/environments/{env}/derivations",
    status_code=201,
    responses={
        **problem_responses(VersionOut, 400, 404, 409, 412, 415, 503, ok=201, description="A new version"),
        **UNCHANGED_OR_DRY_RUN,
        **STARTED,
    },
    summary="Derive a layer and commit it",
)
def create_derivation(
    env: EnvironmentPath,
    body: DerivationBody,
    services: ServicesDep,
    principal: Editor,
    commit: CommitDep,
    prefer: Prefer = None,
) -> Response:
    """Create a version whose provenance records the derivation, its parameters and its inputs.

    The layer becomes stale when the inputs change.

    Returns 409 if the layer was uploaded or edited, unless `replace` is true. `location_to_imagery` downloads an
    image of the site if the operator has configured a provider, and returns 503 while the provider is down. The image
    becomes stale when the fence or the datum changes, but maps keep using it.
    """
    request = DerivationRequest(body.method, body.parameters, body.replace)
    try:
        described = commit.with_message(body.message).as_dry_run(body.dry_run)
        if body.method == online.METHOD:
            return commit_response(services.ingest.fetch_imagery(env, request, described))
        if services.work is not None and services.work.has_workers():
            wait = not responds_async(prefer)
            return work_response(services.work.commit("derive", env, request, described, principal.id, wait=wait))
        outcome = services.ingest.derive(env, request, described)
    except NotFound as error:
        if body.method in derive.all_derivations():
            raise
        raise Invalid(error.detail, [Problem("unknown derivation", where="body.method")]) from None
    return commit_response(outcome)

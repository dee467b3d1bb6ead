"""Layers computed from others: which ways there are, and committing what one of them gives."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import Response

from app import derive, parameters
from app.api.http.auth import Viewer
from app.api.http.dependencies import CommitDep, ServicesDep
from app.api.http.responses import api_router, commit_response, json_response
from app.api.http.schemas import (
    MAX_TEXT,
    EnvironmentPath,
    RequestModel,
    VersionOut,
    problem_responses,
)
from app.catalogue import describe_derivations
from app.errors import Invalid, NotFound, Problem
from app.ingest import DerivationRequest, online


class DerivationBody(RequestModel):
    """A layer to be computed from others."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [{"method": "objects_to_topology", "parameters": {"join": 0.5}, "replace": True}]
        },
    )

    method: str = Field(max_length=200, description="A derivation's name; see `/api/v1/derivations`.")
    parameters: dict[str, Any] = Field(
        default_factory=dict, description="Of the method, and of the derivations that have to come before it."
    )
    message: str = Field("", max_length=MAX_TEXT)
    replace: bool = Field(False, description="Whether what a source has told, or people have edited, gives way.")


class DerivationOut(BaseModel):
    """A way to compute a layer from others."""

    id: str
    title: str
    gives: str
    needs: list[str]
    cost: float
    version: int
    parameters: list[dict[str, Any]]


router = api_router("derivations")


def as_online() -> dict[str, Any]:
    """The one that asks a provider on the net; no map takes it by itself."""
    return {
        "id": online.METHOD,
        "title": "A picture of the site from the configured provider.",
        "gives": "imagery",
        "needs": ["location"],
        "cost": 100.0,
        "version": 1,
        "parameters": parameters.describe(online.Parameters),
    }


@router.get("/derivations", responses=problem_responses(list[DerivationOut]), summary="All derivations")
def list_derivations(services: ServicesDep, _: Viewer) -> Response:
    """What can be computed from what. Maps use them by themselves; their parameters go into a map's query."""
    return json_response(describe_derivations() + ([as_online()] if services.ingest.provider is not None else []))


@router.post(
    "/environments/{env}/derivations",
    status_code=201,
    responses={
        **problem_responses(VersionOut, 400, 404, 409, 412, 415, 503, ok=201, description="A new version"),
        200: {"model": VersionOut, "description": "Nothing changed: the head."},
    },
    summary="Compute a layer and commit it",
)
def create_derivation(env: EnvironmentPath, body: DerivationBody, services: ServicesDep, commit: CommitDep) -> Response:
    """A version whose provenance says how the layer was made and from what. It goes stale when that changes.

    409 where a source has told that layer, unless `replace` is true. `location_to_imagery` fetches a picture of the
    site where the operator has set up a provider (503 while that is down); it goes stale when the fence or the datum
    changes, and is still used then.
    """
    request = DerivationRequest(body.method, body.parameters, body.replace)
    try:
        carry_out = services.ingest.fetch_imagery if body.method == online.METHOD else services.ingest.derive
        outcome = carry_out(env, request, commit.with_message(body.message))
    except NotFound as error:
        if body.method in derive.all_derivations():
            raise
        raise Invalid(error.detail, [Problem("no such derivation", where="body.method")]) from None
    return commit_response(outcome)

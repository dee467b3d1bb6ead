"""Sites made up from parameters and a seed: which generators there are, and committing what one of them makes."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import Response

from app import generate
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
from app.errors import Invalid, NotFound, Problem
from app.ingest import GenerationRequest


class GenerationBody(RequestModel):
    """A site to be made up."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [{"generator": "orchard", "seed": 7, "parameters": {"rows": 6}, "replace": True}]
        },
    )

    generator: str = Field(max_length=200, description="A generator's name; see `/api/v1/generators`.")
    seed: int = Field(0, ge=0, le=2**63 - 1, description="The same seed and parameters give the same site again.")
    parameters: dict[str, Any] = Field(default_factory=dict, description="Of the generator.")
    message: str = Field("", max_length=MAX_TEXT)
    replace: bool = Field(False, description="Whether what a source has told, or people have edited, gives way.")


class GeneratorOut(BaseModel):
    """A way to make up a site."""

    id: str
    title: str
    gives: list[str]
    needs: list[str] = Field(description="Layers that it works on.")
    changes: list[str] = Field(
        description="Layers that it works on where they are there, one at least. With neither it makes a whole site."
    )
    version: int
    parameters: list[dict[str, Any]]


router = api_router("generations")


@router.get("/generators", responses=problem_responses(list[GeneratorOut]), summary="All generators")
def list_generators(_: Viewer) -> Response:
    """What can be made up, and with which parameters."""
    return json_response([generator.as_dict() for generator in generate.all_generators().values()])


@router.post(
    "/environments/{env}/generations",
    status_code=201,
    responses={
        **problem_responses(VersionOut, 400, 404, 409, 412, 415, 503, ok=201, description="A new version"),
        200: {"model": VersionOut, "description": "Nothing changed: the head."},
    },
    summary="Make up a site and commit it",
)
def create_generation(env: EnvironmentPath, body: GenerationBody, services: ServicesDep, commit: CommitDep) -> Response:
    """A version whose provenance says generator, seed and parameters: the same ones give the same layers again.

    What was made up here before gives way; 409 where a source has told a part, unless `replace` is true.
    """
    order = GenerationRequest(body.generator, body.seed, body.parameters, body.replace)
    try:
        outcome = services.ingest.generate(env, order, commit.with_message(body.message))
    except NotFound as error:
        if body.generator in generate.all_generators():
            raise
        raise Invalid(error.detail, [Problem("no such generator", where="body.generator")]) from None
    return commit_response(outcome)

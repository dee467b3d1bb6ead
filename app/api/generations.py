"""Sites made up from parameters and a seed: which generators there are, and committing what one of them makes."""

from __future__ import annotations

from fastapi import APIRouter
from starlette.responses import Response

from app import generate
from app.api.http.auth import Editor, Viewer
from app.api.http.dependencies import ServicesDep
from app.api.http.responses import StrictRoute, json_response
from app.api.schemas import (
    EnvironmentPath,
    GenerationBody,
    GeneratorOut,
    IdempotencyKey,
    IfMatch,
    VersionOut,
    problem_responses,
)
from app.api.versions import commit_response
from app.errors import Invalid, NotFound, Problem
from app.ingest import GenerationRequest

router = APIRouter(tags=["generations"], route_class=StrictRoute)


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
def create_generation(
    env: EnvironmentPath,
    body: GenerationBody,
    services: ServicesDep,
    principal: Editor,
    if_match: IfMatch = None,
    idempotency_key: IdempotencyKey = None,
) -> Response:
    """A version whose provenance says generator, seed and parameters: the same ones give the same layers again.

    What was made up here before gives way; 409 where a source has told a part, unless `replace` is true.
    """
    order = GenerationRequest(body.generator, body.seed, body.parameters, body.replace)
    try:
        outcome = services.ingest.generate(
            env, order, message=body.message, author=principal.name, if_match=if_match, idempotency=idempotency_key
        )
    except NotFound as error:
        if body.generator in generate.all_generators():
            raise
        raise Invalid(error.detail, [Problem("no such generator", where="body.generator")]) from None
    return commit_response(outcome)

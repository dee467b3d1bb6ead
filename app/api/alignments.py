"""Grids laid onto other maps: where they should lie, told or committed."""

from __future__ import annotations

import math

from fastapi import APIRouter
from starlette.responses import Response

from app.api.http.auth import Editor
from app.api.http.dependencies import ServicesDep
from app.api.http.responses import StrictRoute, json_response
from app.api.schemas import (
    AlignmentBody,
    AlignmentOut,
    EnvironmentPath,
    IdempotencyKey,
    IfMatch,
    OntoBody,
    problem_responses,
)
from app.errors import Invalid, Problem
from app.ingest import AlignmentRequest

router = APIRouter(tags=["alignments"], route_class=StrictRoute)


@router.post(
    "/environments/{env}/alignments",
    status_code=201,
    responses={
        **problem_responses(AlignmentOut, 400, 404, 409, 412, 415, 422, 503, ok=201, description="A new version"),
        200: {"model": AlignmentOut, "description": "A dry run, or nothing changed."},
    },
    summary="Lay a grid onto another map",
)
def create_alignment(
    env: EnvironmentPath,
    body: AlignmentBody,
    services: ServicesDep,
    principal: Editor,
    if_match: IfMatch = None,
    idempotency_key: IdempotencyKey = None,
) -> Response:
    """Find the turn and the shift that lay a stored grid onto another grid, a slice of the objects, or given points.

    The grid's origin changes, its cells do not; `normalize=true` of `occupancy_grid` bakes a turn into the cells.
    """
    if (body.onto is None) == (body.pairs is None):
        reason = "give either onto or pairs"
        raise Invalid(reason, [Problem(reason, where="body.onto")])
    onto = body.onto or OntoBody.model_validate({})
    request = AlignmentRequest(
        grid=body.grid,
        level=body.level,
        layer=onto.layer,
        name=onto.name,
        onto_level=onto.level,
        values=onto.parameters,
        pairs=tuple(body.pairs or ()),
        angle=math.radians(body.angle),
        reach=body.reach,
        near=body.near or (0.5 if body.pairs else 0.1),
        least=body.least,
        dry_run=body.dry_run,
    )
    outcome = services.ingest.align(
        env, request, message=body.message, author=principal.name, if_match=if_match, idempotency=idempotency_key
    )
    version = outcome.version
    if version is None or outcome.status == "unchanged":
        return json_response(outcome.body)
    headers = {"etag": f'"{version.number}"', "fleetmap-version": str(version.number), "fleetmap-root": version.root}
    return json_response(outcome.body, 201, headers)

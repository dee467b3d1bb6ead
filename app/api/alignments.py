"""Grids laid onto other maps: where they should lie, told or committed."""

from __future__ import annotations

import math
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import Response

from app.api.http.dependencies import CommitDep, ServicesDep
from app.api.http.responses import api_router, json_response, version_headers
from app.api.http.schemas import (
    MAX_TEXT,
    EnvironmentPath,
    ProblemItem,
    RequestModel,
    VersionOut,
    problem_responses,
)
from app.errors import Invalid, Problem
from app.ingest import AlignmentRequest


class OntoBody(RequestModel):
    """The map that a grid is laid onto."""

    layer: Literal["occupancy", "objects", "voxels"] = Field(
        "occupancy", description="A stored grid, or a layer that a grid is derived from."
    )
    level: str = Field("ground", max_length=256)
    name: str = Field("map", max_length=256, description="Of a stored grid.")
    parameters: dict[str, Any] = Field(
        default_factory=dict, description="Of the derivation, where there is one: `height`, `world` …"
    )


Place = tuple[float, float]


class AlignmentBody(RequestModel):
    """A stored grid that does not lie where it should, and what says where that is: another map, or pairs of points."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [{"pairs": [[[0, 0], [1, 2]], [[10, 0], [11, 2]]], "dry_run": True}],
        },
    )

    grid: str = Field("map", max_length=256, description="The name of the grid that is moved.")
    level: str = Field("ground", max_length=256)
    onto: OntoBody | None = Field(None, description="The map that it shall lie on.")
    pairs: list[tuple[Place, Place]] | None = Field(
        None,
        min_length=2,
        max_length=1000,
        description="Points [[x, y], [x, y]]: where it is, and where it should be, m.",
    )
    angle: float = Field(180.0, ge=0, le=180, description="The largest turn that is tried, degrees.")
    reach: float | None = Field(None, ge=0, le=1e7, description="The farthest that the grid's middle may go, m.")
    near: float | None = Field(
        None, gt=0, le=1000, description="What agrees: cells this near to each other (0.1 m), or points (0.5 m)."
    )
    least: float = Field(0.5, ge=0, le=1, description="The share that has to agree.")
    dry_run: bool = Field(False, description="Only tell what was found.")
    message: str = Field("", max_length=MAX_TEXT)


class AlignmentOut(BaseModel):
    """A motion p -> R(yaw) p + (x, y) in metres and radians, how well it fits, and the version in which it was made."""

    alignment: dict[str, Any] | None = Field(
        description="`x`, `y`, `yaw`, `residual` (m), `agreement` and `overlap` (shares), `origin` and `before`."
    )
    version: VersionOut | None
    warnings: list[ProblemItem]


router = api_router("alignments")


@router.post(
    "/environments/{env}/alignments",
    status_code=201,
    responses={
        **problem_responses(AlignmentOut, 400, 404, 409, 412, 415, 422, 503, ok=201, description="A new version"),
        200: {"model": AlignmentOut, "description": "A dry run, or nothing changed."},
    },
    summary="Lay a grid onto another map",
)
def create_alignment(env: EnvironmentPath, body: AlignmentBody, services: ServicesDep, commit: CommitDep) -> Response:
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
    outcome = services.ingest.align(env, request, commit.with_message(body.message))
    version = outcome.version
    if version is None or outcome.status == "unchanged":
        return json_response(outcome.body)
    return json_response(outcome.body, 201, version_headers(version))

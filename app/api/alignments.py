"""Grid alignment: fit a grid onto another map, and report or commit the result."""

from __future__ import annotations

import math
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import Response

from app.api.http.dependencies import CommitDep, ServicesDep
from app.api.http.responses import api_router, json_response, version_headers
from app.api.http.schemas import (
    MAX_TEXT,
    DryRun,
    DryRunOut,
    EnvironmentPath,
    ProblemItem,
    RequestModel,
    VersionOut,
    problem_responses,
)
from app.errors import Invalid, Problem
from app.ingest import AlignmentRequest


class OntoBody(RequestModel):
    """Map to fit the grid onto."""

    layer: Literal["occupancy", "objects", "voxels"] = Field(
        "occupancy",
        description="Layer of the target map: `occupancy` for a stored grid, or a layer from which a grid is derived.",
    )
    level: str = Field("ground", max_length=256)
    name: str = Field("map", max_length=256, description="Name of the target grid, if it is stored.")
    parameters: dict[str, Any] = Field(
        default_factory=dict,
        description="Parameters of the derivation that makes the target grid, if it is derived: `height`, `world` …",
    )


Place = tuple[float, float]


class AlignmentBody(RequestModel):
    """Alignment of a stored grid with another map (`onto`) or with pairs of points (`pairs`)."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [{"pairs": [[[0, 0], [1, 2]], [[10, 0], [11, 2]]], "dry_run": True}],
        },
    )

    grid: str = Field("map", max_length=256, description="Name of the grid to move.")
    level: str = Field("ground", max_length=256)
    onto: OntoBody | None = Field(None, description="Map to fit the grid onto, instead of `pairs`.")
    pairs: list[tuple[Place, Place]] | None = Field(
        None,
        min_length=2,
        max_length=1000,
        description="Pairs of points [[x, y], [x, y]] in metres: present position, correct position.",
    )
    angle: float = Field(180.0, ge=0, le=180, description="Maximum rotation to try, in degrees.")
    reach: float | None = Field(
        None,
        ge=0,
        le=1e7,
        description="Maximum distance that the grid's centre may move, in metres. Default: no limit.",
    )
    near: float | None = Field(
        None,
        gt=0,
        le=1000,
        description="Maximum distance in metres at which cells or points match. Default: 0.1 for cells, 0.5 "
        "for points.",
    )
    least: float = Field(0.5, ge=0, le=1, description="Minimum share of matching cells or points, from 0 to 1.")
    dry_run: DryRun = False
    message: str = Field("", max_length=MAX_TEXT)


class AlignmentOut(BaseModel):
    """Alignment p -> R(yaw) p + (x, y) in metres and radians, how well it fits, and the version that it created."""

    alignment: dict[str, Any] | None = Field(
        description="`x`, `y`, `yaw`, `residual` (m), `agreement` and `overlap` (0 to 1), `origin` and the previous "
        "origin `before`."
    )
    version: VersionOut | None = Field(description="Null in a dry run.")
    warnings: list[ProblemItem]
    dry_run: DryRunOut | None = Field(description="In a dry run the version that would be created, if the maps fit.")


router = api_router("alignments")


@router.post(
    "/environments/{env}/alignments",
    status_code=201,
    responses={
        **problem_responses(AlignmentOut, 400, 404, 409, 412, 415, 422, 503, ok=201, description="A new version"),
        200: {"model": AlignmentOut, "description": "A dry run, or nothing changed."},
    },
    summary="Align a grid with another map",
)
def create_alignment(env: EnvironmentPath, body: AlignmentBody, services: ServicesDep, commit: CommitDep) -> Response:
    """Fit a stored grid onto another grid, a slice of the objects, or given points.

    The alignment is a rotation and a translation: the grid's origin changes, its cells do not. To rotate the cells,
    download the grid with `normalize=true` (`occupancy_grid`).
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
    )
    outcome = services.ingest.align(env, request, commit.with_message(body.message).as_dry_run(body.dry_run))
    version = outcome.version
    if version is None or outcome.status == "unchanged":
        return json_response(outcome.body)
    return json_response(outcome.body, 201, version_headers(version))

"""Grid alignment: fit a grid onto another map, and report or commit the result."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

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
from app.ingest import AlignmentRequest, MergeRequest
from app.model.stitching import MAX_GRIDS


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
Metres = Annotated[float, Field(ge=-1e7, le=1e7, allow_inf_nan=False)]
Degrees = Annotated[float, Field(ge=-360, le=360, allow_inf_nan=False)]


class MergeBody(RequestModel):
    """Grids of several robots to lay into one, in the frame of the first."""

    grids: list[Annotated[str, Field(max_length=256)]] = Field(
        min_length=2,
        max_length=MAX_GRIDS,
        description="Names of the grids, all of `level`, the oldest first. The first one stays where it is.",
    )
    name: str | None = Field(
        None, max_length=100, description="Name of the merged grid. Default: the first grid's, which it replaces."
    )
    seam: Literal["evidence", "newest"] = Field(
        "evidence",
        description="Where grids disagree: `evidence` counts occupied and free observations of all grids, in doubt "
        "occupied; with `newest` the last of `grids` that knows the cell decides.",
    )
    drop: bool = Field(
        False, description="Delete the grids that were merged; the result stays. Default: they stay as they are."
    )
    pairs: dict[str, Annotated[list[tuple[Place, Place]], Field(min_length=2, max_length=1000)]] = Field(
        default_factory=dict,
        max_length=MAX_GRIDS,
        description="By grid: pairs of points [[x, y], [x, y]] in metres: position in this grid, position in the "
        "first grid. They decide if the common area is too small to find the position.",
    )
    poses: dict[str, tuple[Metres, Metres, Degrees]] = Field(
        default_factory=dict,
        max_length=MAX_GRIDS,
        description="By grid: rough position of its frame in the first one's, [x, y] in metres and the rotation in "
        "degrees. The search is limited to `angle` (default: 20°) and `reach` (default: 2 m) around it.",
    )
    overlap: float = Field(
        0.1,
        ge=0,
        le=1,
        description="Minimum area that a grid has in common with the others: a share of the smaller one, 0 to 1.",
    )


class AlignmentBody(RequestModel):
    """Alignment of a stored grid with another map (`onto`) or with pairs of points (`pairs`), or a `merge`."""

    model_config = ConfigDict(
        json_schema_extra={
            "examples": [
                {"pairs": [[[0, 0], [1, 2]], [[10, 0], [11, 2]]], "dry_run": True},
                {"merge": {"grids": ["robot-1", "robot-2"], "name": "site"}, "dry_run": True},
            ],
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
    merge: MergeBody | None = Field(None, description="Merge grids into one, instead of moving one of them.")
    angle: float | None = Field(
        None, ge=0, le=180, description="Maximum rotation to try, in degrees. Default: 180; around `merge.poses` 20."
    )
    reach: float | None = Field(
        None,
        ge=0,
        le=1e7,
        description="Maximum distance that the grid's centre may move, in metres. Default: no limit; around "
        "`merge.poses` 2.",
    )
    near: float | None = Field(
        None,
        gt=0,
        le=1000,
        description="Maximum distance in metres at which cells or points match. Default: 0.1 for cells, 0.5 "
        "for points.",
    )
    least: float | None = Field(
        None,
        ge=0,
        le=1,
        description="Minimum share of matching cells or points, from 0 to 1. Default: 0.5; for `merge` 0.9, of the "
        "walls that both grids saw.",
    )
    dry_run: DryRun = False
    message: str = Field("", max_length=MAX_TEXT)


class AlignmentOut(BaseModel):
    """Alignment p -> R(yaw) p + (x, y) in metres and radians, how well it fits, and the version that it created."""

    alignment: dict[str, Any] | None = Field(
        description="`x`, `y`, `yaw`, `residual` (m), `agreement` and `overlap` (0 to 1), `origin` and the previous "
        "origin `before`. Null for a merge."
    )
    merge: dict[str, Any] | None = Field(
        description="For a merge: `name`, `resolution`, `origin`, `size`, `cells`, the number of `conflicts` and of "
        "those that became free (`freed`), and for each of `grids` its motion `x`, `y`, `yaw` into the first grid's "
        "frame, `agreement`, `overlap`, `residual`, `walls` (m) and `area` (m²) in common, other positions that fit "
        "nearly as well (`others`), and the `problem` if it cannot be placed."
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
    summary="Align a grid with another map, or merge grids",
)
def create_alignment(env: EnvironmentPath, body: AlignmentBody, services: ServicesDep, commit: CommitDep) -> Response:
    """Fit a stored grid onto another grid, a slice of the objects, or given points.

    The alignment is a rotation and a translation: the grid's origin changes, its cells do not. To rotate the cells,
    download the grid with `normalize=true` (`occupancy_grid`).

    With `merge`, grids of several robots become one: each is placed by the walls that it has in common with the
    others. A grid that fits nowhere, or in several ways, is refused: give its `pairs` or pose.
    """
    described = commit.with_message(body.message).as_dry_run(body.dry_run)
    if body.merge is not None:
        outcome = services.ingest.merge(env, _merge_request(body, body.merge), described)
    else:
        outcome = services.ingest.align(env, _alignment_request(body), described)
    version = outcome.version
    if version is None or outcome.status == "unchanged":
        return json_response(outcome.body)
    return json_response(outcome.body, 201, version_headers(version))


def _alignment_request(body: AlignmentBody) -> AlignmentRequest:
    if (body.onto is None) == (body.pairs is None):
        reason = "give one of onto, pairs and merge"
        raise Invalid(reason, [Problem(reason, where="body.onto")])
    onto = body.onto or OntoBody.model_validate({})
    return AlignmentRequest(
        grid=body.grid,
        level=body.level,
        layer=onto.layer,
        name=onto.name,
        onto_level=onto.level,
        values=onto.parameters,
        pairs=tuple(body.pairs or ()),
        angle=math.radians(180.0 if body.angle is None else body.angle),
        reach=body.reach,
        near=body.near or (0.5 if body.pairs else 0.1),
        least=0.5 if body.least is None else body.least,
    )


def _merge_request(body: AlignmentBody, merge: MergeBody) -> MergeRequest:
    others = [word for word in ("grid", "onto", "pairs") if word in body.model_fields_set]
    if others:
        reason = f"{others[0]} cannot be combined with merge"
        raise Invalid(reason, [Problem(reason, where=f"body.{others[0]}")])
    return MergeRequest(
        grids=tuple(merge.grids),
        level=body.level,
        name=merge.name or "",
        seam=merge.seam,
        drop=merge.drop,
        pairs={name: tuple(pairs) for name, pairs in merge.pairs.items()},
        poses={name: (x, y, math.radians(yaw)) for name, (x, y, yaw) in merge.poses.items()},
        angle=None if body.angle is None else math.radians(body.angle),
        reach=body.reach,
        near=body.near or 0.1,
        least=0.9 if body.least is None else body.least,
        overlap=merge.overlap,
    )

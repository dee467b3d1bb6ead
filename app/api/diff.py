"""Differences between two versions: as JSON, as features to draw, or as an image."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

from fastapi import Query, Request
from starlette.responses import Response

from app.api.diff_features import DiffFeaturesOut, FeatureSelection, changed_features
from app.api.http.auth import Viewer
from app.api.http.dependencies import Services, ServicesDep
from app.api.http.features import GEOJSON, Crs, PageCursor, PageLimit
from app.api.http.parameters import parse_version_ref
from app.api.http.responses import api_router, json_response
from app.api.http.schemas import VERSION_OR_PENDING, DiffOut, EnvironmentPath, component_schemas, problem_responses
from app.convert.change_picture import ChangePicture
from app.errors import Invalid, Problem
from app.store.values import Version

router = api_router("versions", "/environments/{env}")

Ref = Annotated[
    str | None,
    Query(
        pattern=VERSION_OR_PENDING,
        description="The newer version: number, channel, or `latest`; or `dry:…` of a dry run, or `draft:…`.",
    ),
]

FromRef = Annotated[
    str | None,
    Query(
        alias="from",
        pattern=VERSION_OR_PENDING,
        description="The older version: number, channel, or `latest`; or `dry:…` of a dry run, or `draft:…`. Default: "
        "the parent of `to`.",
    ),
]


@router.get(
    "/diff",
    responses={
        **problem_responses(DiffOut, 404),
        200: {
            "model": DiffOut,
            "description": "The differences",
            "content": {GEOJSON: {"schema": {"$ref": "#/components/schemas/DiffFeaturesOut"}}, "image/png": {}},
        },
    },
    summary="Compare two versions",
    openapi_extra=component_schemas(DiffFeaturesOut),
)
def diff(
    env: EnvironmentPath,
    request: Request,
    services: ServicesDep,
    _: Viewer,
    from_: FromRef = None,
    to: Ref = "latest",
    render: Annotated[
        Literal["json", "png"],
        Query(
            description="`png`: an image of 1024 pixels' width, +y up, with added features in green, deleted in red, "
            "changed in orange; cells that are blocked now in red, free now in blue."
        ),
    ] = "json",
    format: Annotated[
        Literal["json", "geojson"], Query(description="`geojson`: the changed features with both states, to draw them.")
    ] = "json",
    crs: Crs = None,
    layer: Annotated[
        Literal["location", "objects", "topology", "zones"] | None,
        Query(description="Only features of this layer. Needs `format=geojson`, as do `crs`, `limit` and `cursor`."),
    ] = None,
    limit: PageLimit = None,
    cursor: PageCursor = None,
) -> Response:
    """Return the differences by layer.

    Features are listed by id as added, changed (with the fields) or deleted. For grids the numbers of freed and
    blocked cells are given; `/diff/tiles/{name}` draws them.

    With `format=geojson` each changed feature has both states. Features that nobody edited are not listed, even if a
    new datum moves them. Pages are as those of layers.
    """
    old, new = compared_versions(services, env, from_, to)
    if format == "geojson":
        if render == "png":
            problem = Problem("excludes format=geojson", where="render")
            raise Invalid("render=png and format=geojson exclude each other: omit one", [problem])
        return changed_features(request, services, old, new, FeatureSelection(crs, layer, limit, cursor))
    _require_geojson({"crs": crs, "layer": layer, "limit": limit, "cursor": cursor})
    if render == "png":
        png = ChangePicture(services.store, services.tiles, old, new).png()
        return Response(png, media_type="image/png")
    layers = services.store.content.diff(old, new)
    return json_response({"from": old.ref, "to": new.ref, "layers": layers})


def compared_versions(services: Services, env: str, from_: str | None, to: str | None) -> tuple[Version, Version]:
    """Return the older version, by default the parent, and the newer one. Raises NotFound, Invalid."""
    new = services.store.versions.get(env, parse_version_ref(to or "latest"))
    if from_ is not None:
        return services.store.versions.get(env, parse_version_ref(from_)), new
    if new.parent is None:
        raise Invalid("version 0 has no parent to compare with: set from to a version")
    return services.store.versions.get(env, new.parent), new


def _require_geojson(given: Mapping[str, object]) -> None:
    """Raise Invalid if a parameter of ``format=geojson`` is set without it."""
    names = [name for name, value in given.items() if value is not None]
    if names:
        raise Invalid(
            f"{', '.join(names)}: only for format=geojson; set it, or omit them",
            [Problem("needs format=geojson", where=name) for name in names],
        )

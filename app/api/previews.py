"""Pictures of whole sites."""

from __future__ import annotations

from typing import Annotated

from fastapi import Query, Request
from starlette.concurrency import run_in_threadpool
from starlette.responses import Response

from app.api.http.auth import Viewer
from app.api.http.caching import cache_control, none_match
from app.api.http.dependencies import Services, ServicesDep
from app.api.http.parameters import parse_version_ref
from app.api.http.responses import api_router
from app.api.http.schemas import EnvironmentPath, VersionPath, problem_responses
from app.convert.painting import ThemeName
from app.convert.preview import (
    DEFAULT_WIDTH,
    LAYERS,
    MAX_WIDTH,
    MIN_WIDTH,
    PreviewRequest,
    parse_layers,
    preview_key,
)
from app.store.values import Version

router = api_router("tiles", "/environments/{env}/versions/{v}")


@router.get(
    "/preview.png",
    response_class=Response,
    responses={
        **problem_responses(None, 404, 422),
        200: {"description": "The picture", "content": {"image/png": {}}},
        304: {"description": "Not modified: the client has this picture"},
    },
    summary="Get a picture of the site",
)
async def get_preview(
    env: EnvironmentPath,
    v: VersionPath,
    request: Request,
    services: ServicesDep,
    _: Viewer,
    layers: Annotated[
        str | None,
        Query(
            max_length=200,
            description=f"Comma-separated layers, of {', '.join(LAYERS)}. Default: all that exist, voxels only if "
            "there is neither an image nor a grid.",
            examples=["occupancy,topology"],
        ),
    ] = None,
    level: Annotated[
        str | None, Query(max_length=256, description="Level to draw. Default: `ground`, else the lowest with content.")
    ] = None,
    width: Annotated[
        int,
        Query(
            ge=MIN_WIDTH,
            le=MAX_WIDTH,
            description="Width in pixels. The height follows from the site, from half the width to 5/4 of it.",
        ),
    ] = DEFAULT_WIDTH,
    theme: Annotated[ThemeName, Query(description="Dark on light, or light on dark.")] = "light",
) -> Response:
    """Draw one level of the whole site in the local frame, +y up, with a margin.

    Without a datum, content in degrees is drawn north up; if there is content in metres as well, only that is drawn.
    Images and the grid `map` (else the first one) are below; zones, objects, fence, edges and nodes above. Equal
    content gives equal bytes.
    """
    ref = parse_version_ref(v)
    wanted = PreviewRequest(parse_layers(layers), level, width, theme)
    version = await run_in_threadpool(services.store.versions.get, env, ref)
    key = preview_key(version, wanted)
    headers = {
        "etag": f'"{key[:32]}"',
        "cache-control": cache_control(ref),
        "fleetmap-version": str(version.ref),
        "fleetmap-root": version.root,
    }
    if none_match(request.headers.get("if-none-match"), headers["etag"]):
        return Response(status_code=304, headers=headers)
    png = await services.response_cache.join(("preview", key), _draw, services, version, wanted)
    return Response(png, headers=headers, media_type="image/png")


def _draw(services: Services, version: Version, wanted: PreviewRequest) -> bytes:
    return services.previews.png(version, wanted)

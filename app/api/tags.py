"""Tags: names of versions that never move, and keep them from being thinned."""

from __future__ import annotations

from typing import Annotated

from fastapi import Path
from starlette.responses import Response

from app.api.http.auth import Editor
from app.api.http.dependencies import ServicesDep
from app.api.http.parameters import parse_version_ref
from app.api.http.responses import api_router, json_response
from app.api.http.schemas import VERSION, EnvironmentPath, VersionOut, problem_responses
from app.store.tags import TAG_NAME

TagPath = Annotated[
    str, Path(pattern=f"^{TAG_NAME.pattern}$", max_length=63, description="Name of the tag.", examples=["season-2026"])
]

TaggedPath = Annotated[
    str,
    Path(pattern=VERSION, description="Version: number, channel, or `latest`.", examples=["1"]),
]

router = api_router("versions", "/environments/{env}/versions/{v}/tags")


@router.put("/{tag}", responses=problem_responses(VersionOut, 404, 409), summary="Tag a version")
def put_tag(env: EnvironmentPath, v: TaggedPath, tag: TagPath, services: ServicesDep, principal: Editor) -> Response:
    """Give a version a name. Retention keeps a tagged version. A tag never moves: 409 if another version has it."""
    return json_response(services.store.tags.add(env, parse_version_ref(v), tag, author=principal.name).as_dict())


@router.delete("/{tag}", status_code=204, responses=problem_responses(None, 404), summary="Remove a tag")
def delete_tag(env: EnvironmentPath, v: TaggedPath, tag: TagPath, services: ServicesDep, _: Editor) -> Response:
    """Remove a tag from a version, which retention may thin from then on."""
    services.store.tags.remove(env, parse_version_ref(v), tag)
    return Response(status_code=204)

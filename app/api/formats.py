"""File formats that the server reads and writes."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel
from starlette.responses import Response

from app.api.http.auth import Viewer
from app.api.http.responses import api_router, json_response
from app.api.http.schemas import problem_responses
from app.catalogue import describe_formats


class FormatOut(BaseModel):
    """File format. `options` are the parameters of its maps (and, with `for: read`, of reading it)."""

    id: str
    title: str
    files: list[str]
    media_types: list[str]
    read: bool
    write: bool
    options: list[dict[str, Any]]
    information: dict[str, str]


router = api_router("formats", "/formats")


@router.get("", responses=problem_responses(list[FormatOut]), summary="List formats")
def list_formats(_: Viewer) -> Response:
    """List the formats with their parameters and the information that each provides."""
    return json_response(describe_formats())

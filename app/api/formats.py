"""What can be read and served."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel
from starlette.responses import Response

from app.api.http.auth import Viewer
from app.api.http.responses import api_router, json_response
from app.api.http.schemas import problem_responses
from app.catalogue import describe_formats


class FormatOut(BaseModel):
    """A file format; ``options`` are the parameters of its maps (and of reading it, with ``for: read``)."""

    id: str
    title: str
    files: list[str]
    media_types: list[str]
    read: bool
    write: bool
    options: list[dict[str, Any]]
    information: dict[str, str]


router = api_router("formats", "/formats")


@router.get("", responses=problem_responses(list[FormatOut]), summary="All formats")
def list_formats(_: Viewer) -> Response:
    """What can be read and served, with parameters, and which information each format gives."""
    return json_response(describe_formats())

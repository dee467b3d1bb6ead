"""What can be read and served."""

from __future__ import annotations

from fastapi import APIRouter
from starlette.responses import Response

from app.api.http.auth import Viewer
from app.api.http.responses import StrictRoute, json_response
from app.api.schemas import FormatOut, problem_responses
from app.catalogue import describe_formats

router = APIRouter(prefix="/formats", tags=["formats"], route_class=StrictRoute)


@router.get("", responses=problem_responses(list[FormatOut]), summary="All formats")
def list_formats(_: Viewer) -> Response:
    """What can be read and served, with parameters, and which information each format gives."""
    return json_response(describe_formats())

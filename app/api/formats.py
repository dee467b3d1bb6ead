"""What can be read and served."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter
from starlette.responses import Response

from app import derive, formats, parameters
from app.api.access import Viewer
from app.api.answers import Route, answer
from app.api.schemas import FormatOut, told
from app.formats import Format
from app.store.values import INFORMATION_LAYERS

router = APIRouter(prefix="/formats", tags=["formats"], route_class=Route)


def as_dict(known: Format) -> dict[str, Any]:
    """The format in the contract's words. information: what a file of it gives, itself or by derivation."""
    return {
        "id": known.name,
        "title": known.title,
        "files": list(known.files),
        "media_types": list(known.media_types),
        "read": known.read is not None,
        "write": known.write is not None,
        "options": options(known),
        "information": {layer: _information(known, layer) for layer in INFORMATION_LAYERS},
    }


def options(known: Format) -> list[dict[str, Any]]:
    """Its parameters: ``for`` tells those of its maps (``write``) from those of an upload (``read``)."""
    written = [{**p, "for": "write"} for p in parameters.describe(known.write_options)] if known.write else []
    read = [{**p, "for": "read"} for p in parameters.describe(known.read_options)] if known.read else []
    return written + read


def _information(known: Format, layer: Any) -> str:
    told = known.carries - ({"occupancy"} if known.outlines else frozenset())  # where a grid lies is no grid
    if layer in told:
        return "raw"
    return "derived" if derive.plan(told, frozenset({layer})) is not None else "-"


@router.get("", responses=told(list[FormatOut]), summary="All formats")
def list_formats(_: Viewer) -> Response:
    """What can be read and served, with parameters, and which information each format gives."""
    return answer([as_dict(known) for known in formats.all_formats().values()])

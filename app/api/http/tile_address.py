"""Address of a tile in a URL, and the responses of routes that serve tiles."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import Path, Query

from app.errors import NotFound, Problem

MAX_INDEX = 2**20

LevelOfDetail = Annotated[int, Path(ge=0, le=32, description="Level of detail, 0 to `levels` - 1.", examples=[0])]
TileRow = Annotated[int, Path(ge=0, le=MAX_INDEX, description="Row of the tile, 0 on top.", examples=[0])]
TileColumn = Annotated[int, Path(ge=0, le=MAX_INDEX, description="Column of the tile, 0 on the left.", examples=[0])]
TileHash = Annotated[
    str | None,
    Query(
        alias="hash",
        max_length=64,
        description="`hash` of the raster's description; 404 if the raster has another one. Such an address stays true "
        "in caches, even if the environment is deleted and another one of its name is created.",
    ),
]

NOT_MODIFIED: dict[int | str, dict[str, Any]] = {304: {"description": "Not modified: the client has this content"}}
TILE_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {"description": "The tile: 256 × 256 pixels", "content": {"image/png": {}}},
    **NOT_MODIFIED,
}


def check_hash(given: str | None, actual: str) -> None:
    """Raise NotFound if a client asks for a tile of other content."""
    if given is not None and given != actual:
        problem = Problem("not the hash of this raster", where="hash")
        raise NotFound("the raster has other content: read its description again, and use its hash", [problem])

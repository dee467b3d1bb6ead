"""Address of a tile in a URL, and the responses of routes that serve tiles."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import Path

MAX_INDEX = 2**20

LevelOfDetail = Annotated[int, Path(ge=0, le=32, description="Level of detail, 0 to `levels` - 1.", examples=[0])]
TileRow = Annotated[int, Path(ge=0, le=MAX_INDEX, description="Row of the tile, 0 on top.", examples=[0])]
TileColumn = Annotated[int, Path(ge=0, le=MAX_INDEX, description="Column of the tile, 0 on the left.", examples=[0])]

NOT_MODIFIED: dict[int | str, dict[str, Any]] = {304: {"description": "Not modified: the client has this content"}}
TILE_RESPONSES: dict[int | str, dict[str, Any]] = {
    200: {"description": "The tile: 256 × 256 pixels", "content": {"image/png": {}}},
    **NOT_MODIFIED,
}

"""Grids and images as trees of tiles in Morton order, and back."""

from __future__ import annotations

from collections.abc import Container, Mapping
from typing import Any, Final

import numpy as np
import ormsgpack
from numpy.typing import NDArray

from app.errors import Invalid
from app.model.geodesy import WGS84, between, crs_bounds
from app.model.grid import OccupancyGrid
from app.model.imagery import GeoImage, pixel_positions
from app.store import tree
from app.store.encode import ENCODING, interleave, pack, pack_value
from app.store.parts.boxes import bounding_box, crossing_box, ring
from app.store.parts.roots import TILE_BATCH, EncodedPart, PartRoot, leaf_members, put_root
from app.store.tree import ChunkStage, Node
from app.store.values import Bounds

TILE: Final = 256


def compose_grid(draft: ChunkStage, part: OccupancyGrid, base: PartRoot | None) -> EncodedPart:
    """Write a grid as chunks; tiles of the base are not stored again."""
    header = {
        "height": part.height,
        "width": part.width,
        "resolution": float(part.resolution),
        "origin": [float(v) + 0.0 for v in part.origin],
        "mode": part.mode,
        "occupied_thresh": float(part.occupied_thresh) + 0.0,
        "free_thresh": float(part.free_thresh) + 0.0,
        "negate": bool(part.negate),
        "properties": ormsgpack.unpackb(pack_value(part.properties, "properties")),
    }
    tiles = _build_tiles(draft, part.cells, tile_names(draft, base))
    name = put_root(draft, "grid", header, {"tiles": tiles})
    return EncodedPart(name, int(part.cells.size), {"local": bounding_box(part.corners()), "wgs84": None})


def compose_picture(draft: ChunkStage, part: GeoImage, base: PartRoot | None) -> EncodedPart:
    """Write an image as chunks; tiles of the base are not stored again."""
    pixels = part.pixels
    header = {
        "height": pixels.shape[0],
        "width": pixels.shape[1],
        "bands": pixels.shape[2],
        "dtype": _dtype_name(pixels.dtype),
        "transform": [float(v) + 0.0 for v in part.transform],
        "crs": part.crs,
        "properties": ormsgpack.unpackb(pack_value(part.properties, "properties")),
    }
    tiles = _build_tiles(draft, pixels, tile_names(draft, base))
    name = put_root(draft, "picture", header, {"tiles": tiles})
    return EncodedPart(name, int(pixels.shape[0] * pixels.shape[1]), picture_bounds(header))


def _dtype_name(dtype: np.dtype[Any]) -> str:
    if dtype.kind not in "buif" or dtype.itemsize > 8:
        raise Invalid(f"pixels of type {dtype} cannot be stored; use integers or floats of up to 64 bit")
    return f"{dtype.kind}{dtype.itemsize}"


def _build_tiles(draft: ChunkStage, cells: NDArray[Any], existing_names: Container[bytes]) -> Node | None:
    little = cells.dtype.newbyteorder("<")
    rows, cols = tile_counts(cells.shape[0], cells.shape[1])
    code = interleave(
        np.tile(np.arange(cols, dtype=np.uint64), rows), np.repeat(np.arange(rows, dtype=np.uint64), cols)
    )
    order = np.argsort(code)
    names = []
    for k in order.tolist():
        r, c = divmod(k, cols)
        block = cells[r * TILE : (r + 1) * TILE, c * TILE : (c + 1) * TILE]
        raw = pack([ENCODING, "tile", np.ascontiguousarray(block, little).tobytes()])
        names.append(draft.put_compressed(raw, existing_names))
    codes = code[order].astype(">u8").tobytes()
    keys = [codes[8 * k : 8 * k + 8] for k in range(len(names))]
    return tree.build(
        draft, keys, 6, lambda s, e: pack([ENCODING, "tiles", codes[8 * s : 8 * e], b"".join(names[s:e])])
    )


def tile_counts(height: int, width: int) -> tuple[int, int]:
    """Return (rows, columns) of tiles."""
    return -(-height // TILE), -(-width // TILE)


def tile_leaf(raw: bytes) -> list[tuple[int, bytes]]:
    """Return (Morton code, tile's name) of a leaf of a raster."""
    codes, names = leaf_members(raw, "tiles")
    return [
        (int.from_bytes(codes[8 * k : 8 * k + 8], "big"), names[32 * k : 32 * k + 32]) for k in range(len(codes) // 8)
    ]


def tile_names(draft: ChunkStage, base: PartRoot | None) -> set[bytes]:
    """Return the names of a raster's tiles."""
    root = base.trees.get("tiles") if base else None
    if root is None:
        return set()
    (leaves,) = tree.leaves(draft, [root])
    return {name for raw in draft.read_many(leaves).values() for _, name in tile_leaf(raw)}


def picture_bounds(header: Mapping[str, Any]) -> Bounds:
    """Return the extent of an image; its box in degrees has west > east if it crosses the antimeridian."""
    crs, transform, w, h = header["crs"], header["transform"], header["width"], header["height"]
    corners = pixel_positions(transform, np.array([0, w, w, 0]), np.array([0, 0, h, h]))
    if crs == "local":
        return {"local": bounding_box(corners), "wgs84": None}
    box = crs_bounds(crs, corners)
    if box is not None and box[2] - box[0] > 180.0:
        border = between(crs, WGS84, pixel_positions(transform, *ring((0.0, 0.0, w, h)).T))
        with np.errstate(invalid="ignore"):  # infinite ones
            longitude = np.unwrap(border[:, 0], period=360.0)
        if np.ptp(longitude) <= 180.0:  # an image of half the globe is wide indeed
            box = crossing_box(between(crs, WGS84, corners))
    return {"local": None, "wgs84": box}


def _load_tiles(draft: ChunkStage, root: PartRoot, out: NDArray[Any]) -> None:
    node = root.trees["tiles"]
    if node is None:
        return
    (leaves,) = tree.leaves(draft, [node])
    raws = draft.read_many(leaves)
    rows: dict[bytes, list[int]] = {}
    for leaf in leaves:
        for code, name in tile_leaf(raws[leaf]):
            rows.setdefault(name, []).append(code)
    names = list(rows)
    for start in range(0, len(names), TILE_BATCH):
        for name, raw in draft.stream(names[start : start + TILE_BATCH]).items():
            for code in rows[name]:
                place_tile(out, code, raw)


def morton(code: int) -> tuple[int, int]:
    """Return (row, column) of a tile's code."""
    col = row = 0
    for bit in range(32):
        col |= (code >> (2 * bit) & 1) << bit
        row |= (code >> (2 * bit + 1) & 1) << bit
    return row, col


def place_tile(out: NDArray[Any], code: int, raw: bytes) -> None:
    """Copy a tile's values to its position in [height, width(, bands)]."""
    row, col = morton(code)
    target = out[row * TILE : (row + 1) * TILE, col * TILE : (col + 1) * TILE]
    (data,) = leaf_members(raw, "tile")
    target[...] = np.frombuffer(data, out.dtype.newbyteorder("<")).reshape(target.shape)


def tile_shape(header: Mapping[str, Any], code: int) -> tuple[int, int, int, int]:
    """Return (first row, first column, height, width) of a tile."""
    row, col = morton(code)
    return (
        row * TILE,
        col * TILE,
        min(TILE, header["height"] - row * TILE),
        min(TILE, header["width"] - col * TILE),
    )


def tile_cells(raw: bytes) -> NDArray[np.uint8]:
    """Return a grid tile's cells, flat."""
    (data,) = leaf_members(raw, "tile")
    return np.frombuffer(data, np.uint8)


def grid_cells(draft: ChunkStage, root: PartRoot) -> NDArray[np.uint8]:
    """Return a grid's cells."""
    cells = np.empty((root.header["height"], root.header["width"]), np.uint8)
    _load_tiles(draft, root, cells)
    return cells


def load_grid(draft: ChunkStage, root: PartRoot) -> OccupancyGrid:
    """Load a grid with all its tiles."""
    h = root.header
    cells = grid_cells(draft, root)
    x, y, yaw = h["origin"]
    return OccupancyGrid(
        cells,
        h["resolution"],
        (x, y, yaw),
        h["mode"],
        h["occupied_thresh"],
        h["free_thresh"],
        h["negate"],
        h["properties"],
    )


def load_picture(draft: ChunkStage, root: PartRoot) -> GeoImage:
    """Load an image with all its tiles."""
    h = root.header
    pixels = np.empty((h["height"], h["width"], h["bands"]), np.dtype(h["dtype"]) if h["dtype"] != "b1" else np.bool_)
    _load_tiles(draft, root, pixels)
    a, b, c, d, e, f = h["transform"]
    return GeoImage(pixels, (a, b, c, d, e, f), h["crs"], h["properties"])

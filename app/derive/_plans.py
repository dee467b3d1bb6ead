"""Convert a floor plan to walls, rooms and the ground outside.

Ink is darker than Otsu's threshold between ink and paper. A room cannot be reached from the edge of the image without
crossing ink or a gap narrower than ``gap`` (doors, dashed lines). An even shade between ink and paper on much of the
image is the grey of ROS maps, which means unknown: such a plan shows itself what is outside, so all of its paper is
free.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.derive import DerivationNotes
from app.errors import CannotConvert
from app.model.frame import MAX_METRES
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.imagery import GeoImage, display_pixels, pixel_positions
from app.model.raster import RasterFrame, check_frame

RESOLUTION = 0.05
"""Default cell size in metres, unless the image is coarser."""

MAX_CELLS = 2**28
MAX_SIDE_CELLS = 32767

MIN_CONTRAST = 24
"""Minimum difference in grey levels between ink and paper."""

SHADE = 0.02
"""Minimum share of the image of an even shade between ink and paper that counts as unknown."""

MAX_ROOM_DISTANCE_METRES = 1.0
"""Distance from a room in metres beyond which ink is no wall but a title, a scale or a dimension."""

ROOM = 1.0
"""Area of the smallest room in square metres; smaller enclosed areas are letters, pillars and hollow walls."""

COLOURFUL, CHROMA = 0.05, 40
PAPER = 0.4


@dataclass(frozen=True, slots=True)
class FloorPlanOptions:
    """Options of a floor plan conversion. gap: metres. speck: square metres. outside_free: whether outside is free."""

    gap: float
    speck: float
    resolution: float | None
    outside_free: bool


def looks_like_plan(rgb: NDArray[np.uint8], valid: NDArray[np.bool_]) -> bool:
    """Return whether an image is ink on paper: almost no colour, and one bright shade on much of it."""
    if not valid.any():
        return False
    pixels = rgb[valid]
    chroma = pixels.max(axis=1).astype(np.int16) - pixels.min(axis=1)
    if float((chroma > CHROMA).mean()) > COLOURFUL:
        return False
    grey = pixels.max(axis=1)
    counts = np.bincount(grey, minlength=256)
    around = np.convolve(counts, np.ones(17, np.int64), "same")
    # require ink, too: a bright field with nothing darker in it is no floor plan
    return bool(around[180:].max() >= PAPER * len(grey)) and bool((grey < 128).any())


def to_grey(picture: GeoImage) -> NDArray[np.uint8]:
    """Return the image in grey on white paper: uint8 [h, w]."""
    shown = display_pixels(picture)
    rgb = shown[..., :3] if shown.shape[2] >= 3 else shown[..., :1]
    grey = rgb[..., 0] if rgb.shape[2] == 1 else _luma(rgb)
    if shown.shape[2] in (2, 4):
        alpha = shown[..., -1].astype(np.uint16)
        grey = ((grey.astype(np.uint16) * alpha + 255 * (255 - alpha)) // 255).astype(np.uint8)
    return np.ascontiguousarray(grey)


def _luma(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    import cv2

    return np.asarray(cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY), np.uint8)


def plan_to_grid(picture: GeoImage, how: FloorPlanOptions, notes: DerivationNotes, name: str) -> OccupancyGrid:
    """Convert a floor plan in the local frame to a grid: ink occupied, rooms free, the rest unknown.

    The origin is a multiple of a cell. Raises CannotConvert for an image without ink or without a closed room.
    """
    import cv2

    grey = to_grey(picture)
    threshold, _ = cv2.threshold(grey, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    level = int(threshold)
    ink = grey <= level
    if ink.all() or not ink.any() or int(grey[~ink].mean()) - int(grey[ink].mean()) < MIN_CONTRAST:
        raise CannotConvert(f"{name} has a single shade, with no ink on paper: use another segmentation")
    if ink.mean() > 0.5:
        raise CannotConvert(f"{name} is dark overall, not a plan on bright paper: use another segmentation")
    unknown = _shades(grey, level, notes, name)
    a, b, _, d, e, _ = picture.transform
    size = math.sqrt(abs(a * e - b * d))
    resolution = how.resolution or max(RESOLUTION, float(f"{size:.6g}"))
    corners = picture.outline()
    if not np.abs(corners).max() <= MAX_METRES:
        raise CannotConvert(f"{name} extends beyond the local frame: correct its position or scale")
    low, high = corners.min(axis=0), corners.max(axis=0)
    frame = check_frame(
        RasterFrame.from_box((float(low[0]), float(low[1]), float(high[0]), float(high[1])), resolution),
        MAX_CELLS,
        MAX_SIDE_CELLS,
    )
    walls = _walls(ink, picture, frame, size)
    paper, shaded = _sample_picture(~unknown, picture, frame)
    walls, specks = _drop_specks(walls, how.speck / resolution**2)
    notes.drop("specks of ink", specks, f"{name}: less than {how.speck:g} m², so they count as dirt or lettering")
    has_unknown = bool(unknown.any())
    if has_unknown:
        inside = (walls == 0) & paper & ~shaded
    else:
        outside = _outside(walls, how.gap / 2 / resolution)
        inside = _rooms(~outside & (walls == 0) & paper, ROOM / resolution**2)
    if not inside.any() and not how.outside_free:
        raise CannotConvert(
            f"{name} encloses no room: its walls have openings wider than gap={how.gap:g} m. Set a wider gap, or "
            "outside_free=true if everything but walls is free"
        )
    cells = np.full(walls.shape, UNKNOWN, np.uint8)
    if how.outside_free:
        cells[paper & ~shaded] = FREE
    cells[inside] = FREE
    near = walls == 1
    if inside.any() and not has_unknown and not how.outside_free:
        away = cv2.distanceTransform((~inside).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
        far = near & (away > MAX_ROOM_DISTANCE_METRES / resolution)
        notes.drop("cells of ink", int(far.sum()), f"{name}: more than {MAX_ROOM_DISTANCE_METRES:g} m from any room")
        near &= ~far
    cells[near] = OCCUPIED
    return OccupancyGrid(cells, resolution, (*frame.origin, 0.0))


def _shades(grey: NDArray[np.uint8], level: int, notes: DerivationNotes, name: str) -> NDArray[np.bool_]:
    """Mark pixels of even shades between ink and paper."""
    counts = np.bincount(grey.ravel(), minlength=256)
    paper = int(np.argmax(counts[level + 1 :])) + level + 1
    brightest = int(np.flatnonzero(counts > 0.05 * grey.size)[-1]) if (counts > 0.05 * grey.size).any() else paper
    shades = [k for k in range(level + 1, max(paper, brightest) - MIN_CONTRAST) if counts[k] >= SHADE * grey.size]
    if not shades:
        return np.zeros(grey.shape, bool)
    listing = ", ".join(map(str, shades))
    notes.warn(
        f"{name}: the even grey {listing} counts as unknown, as in ROS maps; gap has no effect",
        where="imagery",
    )
    return np.asarray(np.isin(grey, shades))


def _walls(ink: NDArray[np.bool_], picture: GeoImage, frame: RasterFrame, size: float) -> NDArray[np.uint8]:
    """Mark cells with ink, uint8 [rows, columns], row 0 lowest.

    Marked are the cell of each ink pixel's centre and each cell whose centre is ink, so no line is lost at any ratio of
    resolutions.
    """
    walls = np.zeros((frame.height, frame.width), np.uint8)
    if size <= frame.resolution * 1.5:
        rows, columns = np.nonzero(ink)
        for k in range(0, len(rows), 2**20):
            u, v = (np.asarray(n[k : k + 2**20], np.float64) + 0.5 for n in (columns, rows))
            at = pixel_positions(picture.transform, u, v)
            x, y = np.floor(frame.to_cells(at)).astype(np.int64).T
            walls[np.clip(y, 0, frame.height - 1), np.clip(x, 0, frame.width - 1)] = 1
    _, mask = _sample_picture(~ink, picture, frame)
    walls[mask] = 1
    return walls


def _sample_picture(
    bright: NDArray[np.bool_], picture: GeoImage, frame: RasterFrame
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return (cells whose centre is in the image, those of them that are not bright)."""
    a, b, c, d, e, f = picture.transform
    det = a * e - b * d
    height, width = bright.shape
    inside = np.zeros((frame.height, frame.width), bool)
    dark = np.zeros((frame.height, frame.width), bool)
    x = frame.origin[0] + (np.arange(frame.width) + 0.5) * frame.resolution - c
    strip = max(1, 2**20 // frame.width)
    for start in range(0, frame.height, strip):
        rows = np.arange(start, min(start + strip, frame.height))
        y = (frame.origin[1] + (rows + 0.5) * frame.resolution - f)[:, None]
        column = np.floor((e * x[None, :] - b * y) / det).astype(np.int64)
        row = np.floor((a * y - d * x[None, :]) / det).astype(np.int64)
        ok = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        inside[rows] = ok
        dark[rows] = ok & ~bright[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
    return inside, dark


def _drop_specks(walls: NDArray[np.uint8], min_area: float) -> tuple[NDArray[np.uint8], int]:
    """Remove pieces of ink that cover fewer than ``min_area`` cells; return the rest and the number removed."""
    import cv2

    if min_area <= 1:
        return walls, 0
    _, labels, stats, _ = cv2.connectedComponentsWithStats(walls, connectivity=8)
    small = stats[:, cv2.CC_STAT_WIDTH].astype(np.int64) * stats[:, cv2.CC_STAT_HEIGHT] < min_area
    small[0] = False
    if not small.any():
        return walls, 0
    return np.where(small[labels], 0, walls).astype(np.uint8), int(small[1:].sum())


def _rooms(inside: NDArray[np.bool_], min_area: float) -> NDArray[np.bool_]:
    """Remove pieces of fewer than ``min_area`` cells."""
    import cv2

    _, labels, stats, _ = cv2.connectedComponentsWithStats(inside.astype(np.uint8), connectivity=4)
    large = stats[:, cv2.CC_STAT_AREA] >= min_area
    large[0] = False
    return np.asarray(large[labels])


def _outside(walls: NDArray[np.uint8], radius: float) -> NDArray[np.bool_]:
    """Mark the cells reachable from beyond the edge through openings wider than two radii (in cells)."""
    import cv2

    margin = math.ceil(radius) + 2
    padded = np.pad(walls, margin)
    away = cv2.distanceTransform((padded == 0).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    core = (away > radius).astype(np.uint8)
    _, labels = cv2.connectedComponents(core, connectivity=4)
    reached = ((labels == labels[0, 0]) & (core == 1)).astype(np.uint8)
    # grow back to the walls, but not through them
    open_ = (padded == 0).astype(np.uint8)
    kernel = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    for _ in range(math.ceil(radius * 1.5)):
        grown = cv2.dilate(reached, kernel) & open_
        if (grown == reached).all():
            break
        reached = grown
    return np.asarray(reached[margin:-margin, margin:-margin] == 1)

"""Convert a floor plan to walls, rooms and the ground outside.

Ink is darker than its ground; `_plan_ink` tells walls from text, icons and furniture, which become unknown. A room
cannot be reached from the edge of the image without crossing ink or a gap narrower than ``gap`` (doors, dashed lines).
On a tinted plan, floor that the edge of the image cuts off is floor, too. The grey of ROS maps means unknown: such a
plan shows itself what is outside, so all of its paper is free, and all of its ink is wall.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.derive import DerivationNotes
from app.derive._plan_ink import (
    MIN_CONTRAST,
    THICK_CONFIDENCE,
    Drawing,
    chroma,
    even_ground,
    extremes,
    plain_drawing,
    read_drawing,
)
from app.errors import CannotConvert
from app.model.frame import MAX_METRES
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.imagery import GeoImage, display_pixels, pixel_positions
from app.model.raster import RasterFrame, check_frame

RESOLUTION = 0.05
"""Default cell size in metres, unless the image is coarser."""

MAX_CELLS = 2**28
MAX_SIDE_CELLS = 32767

SHADE = 0.02
"""Minimum share of the image of the grey that counts as unknown."""

ROS_UNKNOWN = 205
"""The grey that map_saver of ROS writes for unknown."""

ROS_LEVELS = 0.8
"""Share of the image that the three most frequent greys of a ROS map cover."""

MAX_PIXEL_METRES = 0.5
"""Maximum size of a pixel; a plan without a scale has pixels of a metre."""

CUT = 0.15
"""Maximum share of the outline of floor, and of the edge of the image, along which the image cuts it off."""

MAX_ROOM_DISTANCE_METRES = 1.0
"""Distance from a room in metres beyond which ink is no wall but a title, a scale or a dimension."""

ROOM = 1.0
"""Area of the smallest room in square metres; smaller enclosed areas are letters, pillars and hollow walls."""

COLOURFUL, CHROMA = 0.05, 40
PAPER = 0.4

FLAT, BRIGHT = 0.75, 200
"""Share of even pixels of a drawing in colours, and its minimum median grey; photographs are rough or darker."""


@dataclass(frozen=True, slots=True)
class FloorPlanOptions:
    """Options of a floor plan conversion. gap: metres. speck: square metres. outside_free: whether outside is free."""

    gap: float
    speck: float
    resolution: float | None
    outside_free: bool


def looks_like_plan(rgb: NDArray[np.uint8], valid: NDArray[np.bool_]) -> bool:
    """Return whether an image is ink on paper, or a bright drawing in even colours.

    Ink on paper has almost no colour, and one bright shade on much of it.
    """
    if not valid.any():
        return False
    low, high = extremes(rgb)
    low, grey = low[valid], high[valid]
    # require ink, too: a bright field with nothing darker in it is no floor plan
    if not (low < 128).any():
        return False
    if float((grey - low > CHROMA).mean()) > COLOURFUL:
        return float(np.median(grey)) >= BRIGHT and float(even_ground(high)[valid].mean()) >= FLAT
    counts = np.bincount(grey, minlength=256)
    around = np.convolve(counts, np.ones(17, np.int64), "same")
    return bool(around[180:].max() >= PAPER * len(grey)) and bool((grey < 128).any())


def to_rgb(picture: GeoImage) -> NDArray[np.uint8]:
    """Return the image in colours on white paper: uint8 [h, w, 3]."""
    shown = display_pixels(picture)
    rgb = shown[..., :3] if shown.shape[2] >= 3 else np.repeat(shown[..., :1], 3, axis=2)
    if shown.shape[2] in (2, 4) and (shown[..., -1] < 255).any():
        alpha = shown[..., -1:].astype(np.uint16)
        rgb = ((rgb.astype(np.uint16) * alpha + 255 * (255 - alpha)) // 255).astype(np.uint8)
    return np.ascontiguousarray(rgb)


def _luma(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    import cv2

    return np.asarray(cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY), np.uint8)


def plan_to_grid(
    picture: GeoImage, how: FloorPlanOptions, notes: DerivationNotes, name: str
) -> tuple[OccupancyGrid, NDArray[np.float32]]:
    """Convert a floor plan in the local frame to a grid: walls occupied, rooms free, the rest unknown.

    Returns also the probability of each cell that it is a wall, float32 [rows, columns], 0 where it is none. The origin
    is a multiple of a cell. Raises CannotConvert for an image without ink or without a closed room.
    """
    rgb = to_rgb(picture)
    grey, tone = _luma(rgb), chroma(rgb)
    del rgb  # a third of the memory of a large plan
    ink, level = _ink(grey, name)
    unknown = _ros_unknown(tone, grey, level, notes, name)
    a, b, _, d, e, _ = picture.transform
    size = math.sqrt(abs(a * e - b * d))
    if size > MAX_PIXEL_METRES:
        raise CannotConvert(
            f"{name} has pixels of {size:g} m, in which no wall can be seen: upload it with its scale, "
            "metres_per_pixel or a measurement of the building"
        )
    frame = _frame(picture, how.resolution or max(RESOLUTION, float(f"{size:.6g}")), name)
    has_unknown = bool(unknown.any())
    drawing = plain_drawing(ink, size) if has_unknown else read_drawing(tone, grey, ink, size)
    notes.drop(
        "symbols", drawing.count, f"{name}: letters, icons and furniture apart from walls are unknown, not walls"
    )
    walls, others, doubt, sure = _layers(drawing, picture, frame, size)
    paper, shaded = _sample_picture(~unknown, picture, frame)
    barrier, specks = _drop_specks(walls | others, how.speck / frame.resolution**2)
    notes.drop("specks of ink", specks, f"{name}: less than {how.speck:g} m², so they count as dirt or lettering")
    walls &= barrier
    open_ = (barrier == 0) & paper & ~shaded
    if has_unknown:
        inside = open_
    else:
        outside, cut = _outside(barrier, how.gap / 2 / frame.resolution, cuts=drawing.tinted)
        inside = _rooms(~outside & open_, ROOM / frame.resolution**2) & ~doubt
        if cut:
            notes.warn(f"{name}: floor that the edge of the image cuts off counts as inside", where="imagery")
    if not inside.any() and not how.outside_free:
        raise CannotConvert(
            f"{name} encloses no room: its walls have openings wider than gap={how.gap:g} m. Set a wider gap, or "
            "outside_free=true if everything but walls is free"
        )
    cells = np.full(walls.shape, UNKNOWN, np.uint8)
    if how.outside_free:
        cells[paper & ~shaded & ~doubt] = FREE
    cells[inside] = FREE
    cells[others & barrier == 1] = UNKNOWN
    if inside.any() and not (has_unknown or how.outside_free):
        # dimensions touch walls where both are lines; thick walls may stand around rooms that are not recognised
        walls = _drop_far(walls, inside, frame.resolution, notes, name, pieces=drawing.is_thick)
    cells[walls == 1] = OCCUPIED
    return OccupancyGrid(cells, frame.resolution, (*frame.origin, 0.0)), np.where(walls == 1, sure, np.float32(0))


def _ink(grey: NDArray[np.uint8], name: str) -> tuple[NDArray[np.bool_], int]:
    """Return what is darker than paper, and Otsu's threshold. Raises CannotConvert for an image that is no plan."""
    import cv2

    threshold, _ = cv2.threshold(grey, 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
    level = int(threshold)
    ink = grey <= level
    if ink.all() or not ink.any() or int(grey[~ink].mean()) - int(grey[ink].mean()) < MIN_CONTRAST:
        raise CannotConvert(f"{name} has a single shade, with no ink on paper: use another segmentation")
    if ink.mean() > 0.5:
        raise CannotConvert(f"{name} is dark overall, not a plan on bright paper: use another segmentation")
    return ink, level


def _frame(picture: GeoImage, resolution: float, name: str) -> RasterFrame:
    """Return the grid's frame. Raises CannotConvert if the image extends beyond the local frame."""
    corners = picture.outline()
    if not np.abs(corners).max() <= MAX_METRES:
        raise CannotConvert(f"{name} extends beyond the local frame: correct its position or scale")
    low, high = corners.min(axis=0), corners.max(axis=0)
    box = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
    return check_frame(RasterFrame.from_box(box, resolution), MAX_CELLS, MAX_SIDE_CELLS)


def _layers(
    drawing: Drawing, picture: GeoImage, frame: RasterFrame, size: float
) -> tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.bool_], NDArray[np.float32]]:
    """Return (walls, other lines that close rooms, cells of symbols, probability of a wall), row 0 lowest."""
    walls = _walls(drawing.walls, picture, frame, size)
    others = _walls(drawing.lines, picture, frame, size) if drawing.lines.any() else np.zeros_like(walls)
    doubt = _walls(drawing.symbols, picture, frame, size) == 1 if drawing.symbols.any() else np.zeros(walls.shape, bool)
    sure = np.where(walls == 1, np.float32(drawing.line_confidence), np.float32(0))
    if drawing.thick.any():
        sure[_walls(drawing.thick, picture, frame, size) == 1] = THICK_CONFIDENCE
    return walls, others, doubt, sure


def _drop_far(
    walls: NDArray[np.uint8],
    inside: NDArray[np.bool_],
    resolution: float,
    notes: DerivationNotes,
    name: str,
    *,
    pieces: bool,
) -> NDArray[np.uint8]:
    """Drop ink that is far from all rooms; with ``pieces`` only connected ink all of which is."""
    import cv2

    away = cv2.distanceTransform((~inside).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    far = (walls == 1) & (away > MAX_ROOM_DISTANCE_METRES / resolution)
    if pieces:
        count, label = cv2.connectedComponents(walls, connectivity=8)
        near = np.zeros(count, bool)
        near[label[(walls == 1) & ~far]] = True
        far &= ~near[label]
    notes.drop("cells of ink", int(far.sum()), f"{name}: more than {MAX_ROOM_DISTANCE_METRES:g} m from any room")
    return np.where(far, 0, walls).astype(np.uint8)


def _ros_unknown(
    tone: NDArray[np.uint8], grey: NDArray[np.uint8], level: int, notes: DerivationNotes, name: str
) -> NDArray[np.bool_]:
    """Mark the grey of a ROS map that means unknown: an even grey that surrounds the map, or the one of map_saver.

    Other plans have no such grey, whatever the shade of their rooms. tone: chroma.
    """
    counts = np.bincount(grey.ravel(), minlength=256)
    shades = np.argsort(counts, kind="stable")[::-1][:3]
    bright = [int(k) for k in shades if k > level and counts[k] >= SHADE * grey.size]
    few = len(bright) > 1 and counts[shades].sum() >= ROS_LEVELS * grey.size
    if not few or (tone == 0).mean() < ROS_LEVELS:
        return np.zeros(grey.shape, bool)
    shade, paper = min(bright), max(bright)
    edge = np.concatenate([grey[0], grey[-1], grey[:, 0], grey[:, -1]])
    surrounds = (edge == shade).sum() > (edge == paper).sum()
    if paper - shade < MIN_CONTRAST or not (shade == ROS_UNKNOWN or surrounds):
        return np.zeros(grey.shape, bool)
    notes.warn(
        f"{name}: the even grey {shade} counts as unknown, as in ROS maps; gap has no effect",
        where="imagery",
    )
    return np.asarray(grey == shade)


def _walls(ink: NDArray[np.bool_], picture: GeoImage, frame: RasterFrame, size: float) -> NDArray[np.uint8]:
    """Mark cells with ink, uint8 [rows, columns], row 0 lowest.

    Marked are the cell of each ink pixel's centre and each cell whose centre is ink, so no line is lost at any ratio of
    resolutions.
    """
    walls = np.zeros((frame.height, frame.width), np.uint8)
    if size <= frame.resolution * 1.5:
        pixels = np.flatnonzero(ink)  # numpy is slow with two axes
        for k in range(0, len(pixels), 2**20):
            v, u = (n.astype(np.float64) + 0.5 for n in np.divmod(pixels[k : k + 2**20], ink.shape[1]))
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


def _outside(walls: NDArray[np.uint8], radius: float, *, cuts: bool) -> tuple[NDArray[np.bool_], bool]:
    """Mark the cells reachable from beyond the edge through openings wider than two radii (in cells).

    cuts: whether floor may be cut off by the edge: ground of which little borders on the edge is inside then. Returns
    also whether there is such floor.
    """
    import cv2

    margin = 0 if cuts else math.ceil(radius) + 2
    padded = np.pad(walls, margin)
    away = cv2.distanceTransform(np.pad((padded == 0).astype(np.uint8), 1, mode="edge"), cv2.DIST_L2, 5)[1:-1, 1:-1]
    core = (away > radius).astype(np.uint8)
    count, labels = cv2.connectedComponents(core, connectivity=4)
    edges = (labels[0], labels[-1], labels[1:-1, 0], labels[1:-1, -1])
    contact = np.bincount(np.concatenate(edges), minlength=count)
    is_outside = contact > 0
    if cuts:
        rim = (core == 1) & (cv2.erode(core, np.ones((3, 3), np.uint8), borderValue=0) == 0)
        outline = np.maximum(np.bincount(labels[rim], minlength=count), 1)
        is_outside &= (contact > CUT * outline) | (contact > CUT * sum(len(edge) for edge in edges))
    is_outside[0] = False
    reached = is_outside[labels].astype(np.uint8)
    # grow back to the walls, but not through them
    open_ = (padded == 0).astype(np.uint8)
    kernel = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    for _ in range(math.ceil(radius * 1.5)):
        grown = cv2.dilate(reached, kernel) & open_
        if (grown == reached).all():
            break
        reached = grown
    height, width = walls.shape
    cut = bool(cuts and (contact[1:] > 0).any() and (~is_outside[1:] & (contact[1:] > 0)).any())
    return np.asarray(reached[margin : margin + height, margin : margin + width] == 1), cut

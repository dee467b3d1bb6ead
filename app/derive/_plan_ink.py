"""Tell the walls of a drawn floor plan from its other ink: text, icons, furniture, doors, marked routes.

A plan with tinted rooms, or on coloured paper, has ink in many shades: ink is what is darker than the ground on both
sides of it and no wider than a wall (the black top-hat of Meyer 1979). On plain paper ink is below Otsu's threshold.
Walls are then the ink that remains without

- coloured ink on a plan that is drawn in black or grey: routes, dimensions and marks;
- separate pieces no larger than ``SYMBOL`` that are neither solid nor straight: letters, icons, furniture;
- lines that are thinner than the walls, if most of the ink is thick, but for those that continue a wall: windows;
- on plain paper, if walls are drawn as two lines or hatched: single lines no longer than a symbol, as of furniture and
  letters that touch walls, of curtains and of the swings of doors.

What is removed is neither wall nor floor: it may be furniture. To tell text by its strokes is from Epshtein et al. 2010
(stroke width transform), to take thick lines before thin ones from Ahmed et al. 2011 (floor plan analysis).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]

MIN_CONTRAST = 24
"""Minimum difference in grey levels between ink and its ground."""

EVEN = 6
"""Maximum difference in grey levels between neighbouring pixels of an even ground."""

TINTED = 0.04
"""Share of the plan from which even shades that are neither paper nor ink count as tinted rooms or coloured paper."""

MIN_TINT = 12
"""Minimum difference in grey levels between paper and a tint."""

LEVEL = 0.25
"""Share of the darker ground that one shade has on a plan that is tinted."""

MIN_WEAK_CONTRAST = 10
"""Minimum difference in grey levels between ink and ground next to stronger ink, without noise."""

DARK = 0.6
"""Share of the paper's brightness below which an area is no floor but a label or a solid, on a tinted plan."""

MAX_WALL_METRES = 1.0
"""Thickness from which a dark area is no wall, on a tinted plan."""

CHROMA, NEUTRAL = 60, 0.6
"""Chroma of coloured ink, and share of neutral ink from which coloured ink is no wall."""

SYMBOL_METRES = 3.0
"""Side of the rectangle around a separate piece of ink up to which it is a symbol."""

SOLID_METRES, SOLID = 0.25, 0.75
"""Minimum thickness of a solid separate piece, a pillar or pier, and share of its rectangle that it fills."""

STRAIGHT_METRES = 1.0
"""Minimum length of a straight separate piece, a wall between two openings."""

THICK_METRES, THICK = 0.1, 0.67
"""Minimum thickness of thick walls, and share of the ink from which thinner lines are no walls."""

WINDOW_METRES = 3.0
"""Maximum length of a window between two thick walls."""

STROKE_CELL_METRES = 0.05
"""Size of the cells in which double and long lines are looked for."""

STROKE_CELLS, STROKE_METRES, MAX_STROKE_METRES = 3, 1.0, 0.4
"""Minimum thickness of a wall of two lines or hatching, its minimum length, and the maximum thickness."""

STROKE_GAPS_METRES = (0.1, 0.2)
"""Gaps between the two lines of a wall up to which both are one, closest lines first."""

DOUBLE = 0.4
"""Share of double lines, among them and long ones, from which short single lines are no walls."""

AS_THICK = 0.6
"""Share of the width of walls from which a small separate piece is as thick as a wall."""

INSIDE = 0.9
"""Share of a thin piece of ink that lies between walls if it is a window."""

THICK_CONFIDENCE, LINE_CONFIDENCE, TINTED_CONFIDENCE = 0.9, 0.75, 0.7
"""Probability that ink is a wall: the share that was, on plans whose walls people traced."""


@dataclass(frozen=True, slots=True, eq=False)
class Drawing:
    """Ink of a plan, bool [h, w].

    Attributes:
        walls: ink of walls.
        lines: other lines that may close a room: doors, windows, furniture.
        symbols: ink and dark areas that close no room.
        thick: those walls that are drawn thick or filled.
        count: number of separate symbols.
        is_thick: whether walls are told from other lines by their thickness.
        tinted: whether rooms or paper have colours or shades.
    """

    walls: Mask
    lines: Mask
    symbols: Mask
    thick: Mask
    count: int
    is_thick: bool
    tinted: bool

    @property
    def line_confidence(self) -> float:
        """Probability that a line of ``walls`` that is not thick is a wall."""
        return TINTED_CONFIDENCE if self.tinted else LINE_CONFIDENCE


def plain_drawing(ink: Mask, size: float) -> Drawing:
    """Return a drawing all of whose ink is wall, as in a robot's map."""
    none = np.zeros_like(ink)
    return Drawing(ink, none, none, _thick(ink, size), 0, is_thick=False, tinted=False)


def read_drawing(tone: NDArray[np.uint8], grey: NDArray[np.uint8], ink: Mask, size: float) -> Drawing:
    """Divide the ink of a plan.

    tone: chroma, uint8 [h, w]. ink: what is darker than paper as a whole. size: metres per pixel.
    """
    tinted = is_tinted(grey, ink)
    # among tinted rooms a coloured outline may be a wall
    ink, others = _tinted_ink(grey, size) if tinted else _drop_marks(tone, ink)
    thick = _thick(ink, size)
    is_thick = bool(ink.any()) and float(thick.sum()) >= THICK * float(ink.sum())
    width = _wall_width(thick) if is_thick else 0.0
    windows = _between(thick, ink & ~thick, width, size) if is_thick else np.zeros_like(ink)
    kept, windows, symbols, count = _drop_symbols(ink & ~windows, windows, width, size)
    thick &= kept
    walls = thick | windows if is_thick else kept if tinted else _strokes(kept, size)
    thick &= walls
    return Drawing(walls, kept & ~walls, others | symbols, thick, count, is_thick=is_thick, tinted=tinted)


def extremes(rgb: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the weakest and the strongest channel: uint8 [...] each."""
    # channel by channel: numpy is slow along a short last axis
    r, g, b = (rgb[..., k] for k in range(3)) if rgb.shape[-1] == 3 else (rgb[..., 0],) * 3
    return np.minimum(np.minimum(r, g), b), np.maximum(np.maximum(r, g), b)


def chroma(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the difference between the strongest and the weakest channel: uint8 [...]."""
    low, high = extremes(rgb)
    return np.asarray(high - low)


def even_ground(grey: NDArray[np.uint8]) -> Mask:
    """Mark pixels that hardly differ from their neighbours."""
    import cv2

    kernel = np.ones((3, 3), np.uint8)
    return np.asarray(cv2.morphologyEx(grey, cv2.MORPH_GRADIENT, kernel) <= EVEN)


def is_tinted(grey: NDArray[np.uint8], ink: Mask) -> bool:
    """Return whether much of a plan has even shades that are neither its paper, the brightest one, nor its ink."""
    ground = grey[even_ground(grey) & ~ink]
    counts = np.bincount(ground, minlength=256)
    paper = int(np.flatnonzero(counts >= 0.01 * grey.size)[-1]) if (counts >= 0.01 * grey.size).any() else 255
    below = counts[: max(paper - MIN_TINT, 0)]
    if below.sum() < TINTED * grey.size:
        return False
    # the uneven light of a scan is spread over all shades, a tint is not
    return bool(np.convolve(below, np.ones(5, np.int64), "same").max() >= LEVEL * below.sum())


def _tinted_ink(grey: NDArray[np.uint8], size: float) -> tuple[Mask, Mask]:
    """Return (ink: darker than the ground on both sides and no wider than a wall, dark areas that are wider)."""
    import cv2

    side = max(5, round(MAX_WALL_METRES / size)) | 1
    ground = cv2.morphologyEx(grey, cv2.MORPH_CLOSE, np.ones((side, side), np.uint8))
    contrast = cv2.subtract(ground, grey)
    noise = float(np.quantile(contrast[even_ground(grey)], 0.95))
    weak = contrast >= min(MIN_CONTRAST, max(MIN_WEAK_CONTRAST, 3 * noise))
    # thin outlines fade where pixels blend: a piece is ink if some of it is strong
    count, label = cv2.connectedComponents(weak.astype(np.uint8), connectivity=8)
    strong = np.bincount(label[contrast >= MIN_CONTRAST], minlength=count) > 0
    strong[0] = False
    ink = strong[label]
    dark = DARK * float(np.quantile(grey, 0.9))
    return ink, (ground < dark) | ((grey < dark) & ~ink)


def _drop_marks(tone: NDArray[np.uint8], ink: Mask) -> tuple[Mask, Mask]:
    """Divide ink into (the main ink, coloured ink on a plan in black or grey)."""
    import cv2

    if not ink.any():
        return ink, np.zeros_like(ink)
    coloured = ink & (tone > CHROMA)
    if not coloured.any() or float(coloured.sum()) > (1 - NEUTRAL) * float(ink.sum()):
        return ink, np.zeros_like(ink)
    # blended pixels around a coloured line belong to it, unless they touch black ink
    core = cv2.dilate((ink & ~coloured).astype(np.uint8), np.ones((3, 3), np.uint8)) == 1
    edge = cv2.dilate(coloured.astype(np.uint8), np.ones((3, 3), np.uint8)) == 1
    lonely = cv2.morphologyEx((ink & ~coloured).astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8)) == 0
    marks = coloured | (ink & edge & lonely & ~coloured & ~core)
    return ink & ~marks, marks


def _drop_symbols(ink: Mask, windows: Mask, width: float, size: float) -> tuple[Mask, Mask, Mask, int]:
    """Divide ink beside windows into walls, with what touches them, and symbols.

    width: of thick walls in pixels. Returns (ink of walls, windows of walls, separate small pieces with what they
    enclose, their number).
    """
    import cv2

    _, label, stats, _ = cv2.connectedComponentsWithStats(ink.view(np.uint8), connectivity=8)
    sides = stats[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]] * size
    short = sides.max(axis=1) <= SYMBOL_METRES
    short[0] = False
    if windows.any():
        piers, panes = _chained(ink, np.asarray(label, np.int32), short, windows, width)
        short &= ~piers
        ink, windows = ink | (windows & ~panes), panes
        label = np.where(windows, 0, label)
    separate = short[label]
    if windows.any():
        separate |= ink & (label == 0)
    del label  # four bytes for each pixel
    contours, _ = cv2.findContours(separate.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    outlines = [contour for contour in contours if not _is_wall_piece(contour, separate, size)]
    filled = np.zeros(ink.shape, np.uint8)
    # one by one: together, overlapping areas would count as holes
    for outline in outlines:
        cv2.drawContours(filled, [outline], -1, 1, cv2.FILLED)
    symbols = (filled == 1) & ~(ink & ~separate) & ~windows
    return ink & ~symbols, windows, symbols, len(outlines)


def _chained(
    ink: Mask, label: NDArray[np.int32], short: NDArray[np.bool_], windows: Mask, width: float
) -> tuple[NDArray[np.bool_], Mask]:
    """Return (small pieces as thick as walls in a chain of windows that begins at a wall, those windows)."""
    import cv2

    depth = np.zeros(len(short), np.float32)
    np.maximum.at(depth, label[ink].astype(np.intp), _depth(ink)[ink])
    piers = short & (depth >= AS_THICK * width / 2)
    wall = ink & ~short[label]
    chain = cv2.dilate((wall | windows | (piers[label] & ink)).astype(np.uint8), np.ones((3, 3), np.uint8))
    count, link = cv2.connectedComponents(chain, connectivity=8)
    begins = np.zeros(count, bool)
    begins[link[wall]] = True
    holds = np.zeros(len(short), bool)
    holds[label[ink & begins[link]]] = True
    # a pier stands beside a window; what only touches a wall was not separate
    return piers & holds, windows & begins[link]


def _is_wall_piece(contour: Any, ink: Mask, size: float) -> bool:
    """Return whether a small separate piece is a pillar, a pier, or a straight wall between two openings."""
    import cv2

    _, sides, _ = cv2.minAreaRect(contour)
    short, long = ((side + 1) * size for side in sorted(sides))
    if short < SOLID_METRES and long < STRAIGHT_METRES:
        return False
    x, y, width, height = cv2.boundingRect(contour)
    piece = np.zeros((height, width), np.uint8)
    cv2.drawContours(piece, [contour], -1, 1, cv2.FILLED, offset=(-x, -y))
    area = float((ink[y : y + height, x : x + width] & (piece == 1)).sum()) * size**2
    return area >= SOLID * short * long


def _thick(ink: Mask, size: float) -> Mask:
    """Return the parts of the ink that are at least ``THICK_METRES`` and three pixels wide."""
    import cv2

    side = max(3, round(THICK_METRES / size))
    kernel = np.ones((side, side), np.uint8)
    core = cv2.morphologyEx(ink.astype(np.uint8), cv2.MORPH_OPEN, kernel)
    # a square does not reach into the corners of slanted lines
    return np.asarray((cv2.dilate(core, np.ones((3, 3), np.uint8)) == 1) & ink)


def _strokes(ink: Mask, size: float) -> Mask:
    """Return ink of double or hatched lines, of single ones longer than symbols, and of what is solid.

    Returns all ink if walls are not drawn as double lines.
    """
    import cv2

    step = max(1, round(STROKE_CELL_METRES / size))
    if STROKE_CELLS * step * size > MAX_STROKE_METRES:
        return ink  # too coarse to show a wall as two lines
    # the maximum of step x step pixels
    block = np.ones((step, step), np.uint8)
    cells = np.asarray(cv2.dilate(ink.view(np.uint8), block, anchor=(0, 0))[::step, ::step] == 1)
    cell = step * size
    long = _grown(_straight(cells, SYMBOL_METRES / cell)) & cells
    double = _grown(_straight(_double(cells, cell), STROKE_METRES / cell)) & cells
    kept = long | double
    if int(double.sum()) < DOUBLE * max(1, int(kept.sum())):
        return ink
    pixels = cv2.resize(kept.view(np.uint8), None, fx=step, fy=step, interpolation=cv2.INTER_NEAREST)
    pillar = np.ones((max(2, round(SOLID_METRES / size)),) * 2, np.uint8)
    solid = cv2.morphologyEx(ink.view(np.uint8), cv2.MORPH_OPEN, pillar)
    return np.asarray(((pixels[: ink.shape[0], : ink.shape[1]] == 1) & ink) | (solid == 1))


def _grown(mask: Mask) -> Mask:
    import cv2

    return np.asarray(cv2.dilate(mask.view(np.uint8), np.ones((3, 3), np.uint8)) == 1)


def _double(cells: Mask, cell: float) -> Mask:
    """Mark lines that lie side by side, with what is between them, unless they are thicker than a wall."""
    import cv2

    body = np.zeros(cells.shape, bool)
    thin = np.ones((STROKE_CELLS, STROKE_CELLS), np.uint8)
    side = max(STROKE_CELLS + 1, round(MAX_STROKE_METRES / cell))
    for gap in STROKE_GAPS_METRES:  # a wide gap also fills what is between a wall and furniture beside it
        shape = np.ones((round(gap / cell) + 1,) * 2, np.uint8)
        filled = cv2.morphologyEx(cells.view(np.uint8), cv2.MORPH_CLOSE, shape)
        filled = cv2.morphologyEx(filled, cv2.MORPH_OPEN, thin)
        body |= (filled == 1) & (cv2.morphologyEx(filled, cv2.MORPH_OPEN, np.ones((side, side), np.uint8)) == 0)
    return body


def _straight(cells: Mask, length: float) -> Mask:
    """Return the parts of lines in any direction that are straight for a length in cells.

    This is an opening with lines. Only marked cells are looked at, and for each direction fewer with each test.
    """
    half = max(1, round(length / 2))
    padded = np.pad(cells, half)
    flat, width = padded.ravel(), padded.shape[1]
    lines = np.zeros_like(flat)
    marked = np.flatnonzero(flat)
    count = math.ceil(half * math.pi)  # one cell apart at the ends
    for angle in np.arange(count) * (math.pi / count):
        along = np.arange(-half, half + 1) / max(abs(math.cos(angle)), abs(math.sin(angle)))
        along = along[np.abs(along) <= half + 0.5]
        steps = np.rint(along * math.sin(angle)).astype(np.intp) * width
        steps += np.rint(along * math.cos(angle)).astype(np.intp)
        middles = marked
        for step in (*steps[:: max(1, half // 4)], *steps):  # distant cells first: they rule out most
            middles = middles[flat.take(middles + step)]
        for step in steps:
            lines[middles + step] = True
    return lines.reshape(padded.shape)[half:-half, half:-half].copy()


def _depth(ink: Mask) -> NDArray[np.float32]:
    """Return the distance of each pixel from the edge of the ink."""
    import cv2

    return np.asarray(cv2.distanceTransform(ink.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_3), np.float32)


def _wall_width(thick: Mask) -> float:
    """Return the usual width of thick ink in pixels: depths are spread evenly from 0 to half of it."""
    return 4 * float(np.median(_depth(thick)[thick]))


def _between(thick: Mask, thin: Mask, width: float, size: float) -> Mask:
    """Return the thin pieces that lie between two thick walls in line with each other: windows and panes.

    width: of the walls in pixels.
    """
    import cv2

    length = max(3, round(WINDOW_METRES / size)) | 1
    walls = thick.astype(np.uint8)
    gaps = np.zeros(thick.shape, bool)
    for shape in ((1, length), (length, 1)):
        gaps |= (cv2.morphologyEx(walls, cv2.MORPH_CLOSE, np.ones(shape, np.uint8)) == 1) & ~thick
    # a closing along a row also fills rooms narrower than a window: keep what is little thicker than a wall
    wide = max(3, round(1.5 * width)) | 1
    gaps &= cv2.morphologyEx(gaps.astype(np.uint8), cv2.MORPH_OPEN, np.ones((wide, wide), np.uint8)) == 0
    count, label = cv2.connectedComponents(thin.astype(np.uint8), connectivity=8)
    pixels = np.bincount(label.ravel(), minlength=count)
    inside = np.bincount(label[gaps], minlength=count)
    windows = inside >= INSIDE * pixels
    windows[0] = False
    return np.asarray(windows[label])

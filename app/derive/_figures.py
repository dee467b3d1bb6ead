"""Detect shapes in a mask: discs, rectangles, thin straight walls, and irregular areas.

Masks are uint8 [height, width] of zeros and ones, row 0 the lowest. Positions are (x, y) in cells from the corner of
cell (0, 0), so that the centre of cell (row, column) is (column + 0.5, row + 0.5).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.errors import CannotConvert

ROUND = 0.8
"""Minimum share of its enclosing circle that a disc fills: above a square (0.64), below an octagon (0.9)."""

PARTLY, HOLLOW = 0.7, 0.88
"""Minimum share of the enclosing circle for a partly seen rim, which must fill less than HOLLOW of its rectangle.

A disc fills 0.79 of its rectangle.
"""

MIN_ASPECT = 0.7
"""Minimum ratio of width to length of a disc."""

MIN_FILL = 0.85
"""Minimum share of its enclosing rectangle that a rectangle fills: above a disc (0.79) and a triangle (0.5)."""

MAX_FIGURES = 200_000
"""Maximum number of shapes, and of centreline edges; more are noise."""

MAX_PIECES = 2_000_000
"""Maximum number of connected pieces and holes of a mask, including specks."""

ROWS_PER_BLOCK = 1024
"""Rows that are processed together."""

STEP = 0.25
"""Distance in cells between the positions at which a wall's width is sampled."""

MAX_SAMPLES = 64
"""Maximum number of positions along a wall at which its width is sampled."""


@dataclass(frozen=True, slots=True)
class Disc:
    """Disc, in cells."""

    x: float
    y: float
    radius: float


@dataclass(frozen=True, slots=True)
class Box:
    """Rectangle in cells: its centre, its longer and its shorter side, and the direction of the longer one."""

    x: float
    y: float
    length: float
    width: float
    yaw: float


@dataclass(frozen=True, slots=True)
class MaskShapes:
    """Shapes found in a mask. areas: polygons (shapely), in cells. specks: number of shapes that were too small."""

    discs: list[Disc]
    boxes: list[Box]
    walls: list[Box]
    areas: list[Any]
    specks: int


@dataclass(frozen=True, slots=True)
class ShapeLimits:
    """Size limits of shapes, in cells.

    Attributes:
        speck: smallest shape.
        disc: widest disc.
        box: longest rectangle.
        wall: widest wall.
        small: length up to which every shape counts as a disc.
        tolerance: maximum distance of straight edges from the cells.
    """

    speck: float
    disc: float
    box: float
    wall: float
    small: float
    tolerance: float


def figures(mask: NDArray[np.uint8], free: NDArray[np.bool_], sizes: ShapeLimits) -> MaskShapes:
    """Find all shapes of a mask, in order of their rows and columns.

    free: bool [height, width], cells known to be free; an outline that encloses such a cell is no solid shape but the
    walls of a room. Raises CannotConvert if there are more than ``MAX_FIGURES`` shapes.
    """
    import cv2

    if pieces(mask) > MAX_PIECES:
        raise CannotConvert(f"the grid is too noisy: it has more than {MAX_PIECES} pieces and holes")
    contours, tree = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    shapes = MaskShapes([], [], [], [], 0)
    specks = 0
    rest = np.zeros(mask.shape, np.uint8)
    links = np.empty((0, 4), np.int64) if tree is None else np.asarray(tree[0], np.int64)
    # (row, column) of each shape's first cell: the order must not depend on OpenCV
    outer = [k for k in range(len(contours)) if links[k, 3] < 0]
    outer.sort(key=lambda k: tuple(contours[k][:, 0, ::-1].min(axis=0).tolist()))
    for k in outer:
        points = contours[k][:, 0, :]
        box, share, sides = _rectangle(contours[k])
        if box.length < sizes.speck - 1e-6:
            specks += 1
            continue
        inner = []
        child = int(links[k, 2])
        while child >= 0:
            inner.append(child)
            child = int(links[child, 0])
        # a shape larger than a disc or a box, and wider than a wall, is none of these
        small = box.length <= max(sizes.disc, sizes.box) or box.width <= sizes.wall
        room = small and any(_has_free_cell(contours[c], free) for c in inner)
        disc = None if room else _disc(points, sides, sizes)
        if disc is not None:
            shapes.discs.append(disc)
        elif not room and share >= MIN_FILL and box.width <= sizes.wall and box.length >= 2 * box.width:
            shapes.walls.append(box)
        elif not room and share >= MIN_FILL and box.length <= sizes.box:
            shapes.boxes.append(box)
        else:
            cv2.drawContours(rest, [contours[k], *(contours[c] for c in inner)], -1, 1, cv2.FILLED)
    if rest.any():
        _split_others(rest & mask, sizes, shapes)
    return MaskShapes(shapes.discs, shapes.boxes, shapes.walls, shapes.areas, specks)


def _has_free_cell(contour: Any, free: NDArray[np.bool_]) -> bool:
    """Return whether a hole contains a free cell."""
    import cv2

    x, y, w, h = cv2.boundingRect(contour)
    inside = np.zeros((h, w), np.uint8)
    cv2.drawContours(inside, [contour], -1, 1, cv2.FILLED, offset=(-x, -y))
    cv2.drawContours(inside, [contour], -1, 0, 1, offset=(-x, -y))
    return bool((free[y : y + h, x : x + w] & (inside == 1)).any())


def pieces(mask: NDArray[np.uint8]) -> int:
    """Return an upper bound of the number of pieces and holes: cells that differ from the cells before and above."""
    height, width = mask.shape
    count = 0
    for start in range(0, height, ROWS_PER_BLOCK):
        band = np.zeros((min(ROWS_PER_BLOCK, height - start) + 1, width + 2), bool)
        low = max(0, start - 1)
        rows = mask[low : start + ROWS_PER_BLOCK]
        band[-len(rows) :, 1:-1] = rows == 1
        before = band[1:, :-2]
        count += int((band[1:, 1:-1] & ~(before | band[:-1, :-2] | band[:-1, 1:-1] | band[:-1, 2:])).sum())
        count += int((~band[1:, 1:-1] & before & band[:-1, 1:-1]).sum())
    return count


def _cells(contour: Any) -> float:
    """Count the cells of a shape with its holes filled: Pick's theorem for the polygon through the cell centres."""
    import cv2

    steps = np.abs(np.diff(contour[:, 0, :], axis=0, append=contour[:1, 0, :])).max(axis=1)
    return float(cv2.contourArea(contour) + steps.sum() / 2 + 1)


def _rectangle(contour: Any) -> tuple[Box, float, tuple[float, float]]:
    """Return the smallest rectangle around a shape, the share that the shape fills, and its sides between cell centres.

    The sides of the rectangle are longer than those between cell centres: by one cell if it is axis-aligned, by less if
    it is rotated, so that its area matches that of the cells.
    """
    import cv2

    (x, y), (w, h), angle = cv2.minAreaRect(contour.astype(np.float32))
    yaw = math.radians(angle)
    if h > w:
        w, h, yaw = h, w, yaw + math.pi / 2
    yaw = (yaw + math.pi / 2) % math.pi - math.pi / 2  # a rectangle has no front: -90 to 90 degrees
    cells = _cells(contour)
    more = min(1.0, max(0.0, (math.sqrt((w - h) ** 2 + 4 * cells) - w - h) / 2))
    box = Box(x + 0.5, y + 0.5, w + more, h + more, 0.0 if abs(yaw) < 1e-6 else yaw)
    return box, cells / (box.length * box.width), (w, h)


def _disc(points: NDArray[Any], sides: tuple[float, float], sizes: ShapeLimits) -> Disc | None:
    """Return the shape as a disc, or None. sides: of the rectangle around it, between cell centres."""
    import cv2

    (x, y), reach = cv2.minEnclosingCircle(points.astype(np.float32))
    radius = reach + 0.5
    if 2 * radius > sizes.disc:
        return None
    hull = cv2.convexHull(points)
    # half a cell more all around (Steiner's formula): contours run through cell centres
    area = cv2.contourArea(hull) + 0.5 * cv2.arcLength(hull, True) + math.pi / 4
    length, width = sides[0] + 1, sides[1] + 1
    share = area / (math.pi * radius**2)
    corners = (area + 1 - math.pi / 4) / (length * width)
    round_ = width >= MIN_ASPECT * length and (share >= ROUND or (share >= PARTLY and corners < HOLLOW))
    if not round_ and length > sizes.small:
        return None
    return Disc(x + 0.5, y + 0.5, math.sqrt(area / math.pi) if round_ else radius)


def _split_others(rest: NDArray[np.uint8], sizes: ShapeLimits, shapes: MaskShapes) -> None:
    """Split the remaining shapes: thin parts become walls, the others rectangles or areas."""
    from app.derive import _skeleton

    rows, columns = np.flatnonzero(rest.any(axis=1)), np.flatnonzero(rest.any(axis=0))
    top, left = int(rows[0]), int(columns[0])
    mask = np.pad(rest[top : int(rows[-1]) + 1, left : int(columns[-1]) + 1], 1)
    at = np.array([left - 1.0, top - 1.0])
    thick = _open_mask(mask, sizes.wall / 2)
    if thick.any():
        shapes.areas.extend(_areas(thick, sizes, shapes, at))
    thin = mask & (1 - thick)
    if not thin.any():
        return
    free_space = _skeleton.space(thin.copy(), 0, 0, 0.0)
    # branches that reach less than their width out of a wall are roughness
    graph, _ = _skeleton.skeleton(free_space, merge=2.0, spur=sizes.speck, tolerance=sizes.tolerance, island=0.0)
    if len(graph.edges) > MAX_FIGURES:
        raise CannotConvert(f"the grid shows no walls: its thin pieces have more than {MAX_FIGURES} edges")
    ends = straighten_lines(graph.nodes[:, ::-1].astype(np.float64), graph.edges, sizes.tolerance)
    for a, b in ends:
        wall = _wall(thin, a + 0.5, b + 0.5, sizes.wall)
        if wall.length >= sizes.speck:
            shapes.walls.append(Box(wall.x + at[0], wall.y + at[1], wall.length, wall.width, wall.yaw))


def _open_mask(mask: NDArray[np.uint8], radius: float) -> NDArray[np.uint8]:
    """Return the parts of a mask wider than two radii, including their corners. The mask has a border of zeros."""
    from app.derive import _skeleton

    core = _skeleton.space(mask.copy(), 0, 0, radius)
    if not core.cells:
        return np.zeros(mask.shape, np.uint8)
    # The corner of a square is 0.41 radii beyond its inscribed circle. These kernels count everything outside the
    # arrays as core, so it is moved out of reach.
    edge = int(1.5 * radius) + 2
    far = _skeleton.space(np.pad(1 - core.mask, edge, constant_values=1), 0, 0, 1.5 * radius).mask
    far = far[edge:-edge, edge:-edge]
    return np.asarray(mask & (1 - far), np.uint8)


def _areas(thick: NDArray[np.uint8], sizes: ShapeLimits, mask_shapes: MaskShapes, at: NDArray[np.float64]) -> list[Any]:
    """Add rectangular thick shapes to the boxes and return the outlines of the others, in order of their rows."""
    import cv2
    import shapely

    from app.derive.imagery_to_objects import polygons

    count, label = cv2.connectedComponents(thick, connectivity=4)
    out = []
    shapes = (
        polygons(label.astype(np.int32, copy=False), (1.0, 0.0, at[0], 0.0, 1.0, at[1]), sizes.tolerance / 2)
        if count > 1
        else {}
    )
    for _, area in sorted(shapes.items()):
        around = shapely.minimum_rotated_rectangle(area)
        corners = shapely.get_coordinates(around)
        if len(corners) == 5 and area.area >= MIN_FILL * around.area:
            sides = np.hypot(*np.diff(corners[:3], axis=0).T)
            long = int(np.argmax(sides))
            step = corners[long + 1] - corners[long]
            if sides[long] <= sizes.box:
                yaw = (math.atan2(step[1], step[0]) + math.pi / 2) % math.pi - math.pi / 2
                middle = corners[:4].mean(axis=0)
                x, y = (float(v) for v in middle)
                mask_shapes.boxes.append(Box(x, y, float(sides[long]), float(sides[1 - long]), yaw))
                continue
        out.append(area)
    return out


def straighten_lines(
    nodes: NDArray[np.float64], edges: NDArray[np.int64], tolerance: float
) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Join edges into straight lines within ``tolerance`` and return the end points of each line.

    At each node the straightest pair is joined first. Lines are in the order of their first edges.
    """
    lines: dict[int, list[int]] = {k: [int(a), int(b)] for k, (a, b) in enumerate(edges)}
    at: dict[int, set[int]] = {}
    for k, (a, b) in lines.items():
        at.setdefault(a, set()).add(k)
        at.setdefault(b, set()).add(k)
    for node in sorted(at):
        while len(at[node]) > 1:
            best: tuple[float, int, int, list[int]] | None = None
            neighbours = sorted(at[node])
            for i, one in enumerate(neighbours):
                for other in neighbours[i + 1 :]:
                    joined = _join_lines(lines[one], lines[other], node)
                    away = _distance_from_line(nodes[joined], tolerance)
                    if away is not None and (best is None or away < best[0]):
                        best = (away, one, other, joined)
            if best is None:
                break
            _, one, other, joined = best
            for k in (one, other):
                for end in (lines[k][0], lines[k][-1]):
                    at[end].discard(k)
            del lines[other]
            lines[one] = joined
            at[joined[0]].add(one)
            at[joined[-1]].add(one)
    return [(nodes[line[0]], nodes[line[-1]]) for _, line in sorted(lines.items())]


def _join_lines(one: list[int], other: list[int], node: int) -> list[int]:
    """Join two lines at a common end."""
    first = one if one[-1] == node else one[::-1]
    second = other if other[0] == node else other[::-1]
    return [*first, *second[1:]]


def _distance_from_line(line: NDArray[np.float64], tolerance: float) -> float | None:
    """Return the maximum distance of the corners from the chord; None if above tolerance, or if the line turns back."""
    chord = line[-1] - line[0]
    length = float(np.hypot(*chord))
    if length == 0.0:
        return None
    along = (line - line[0]) @ chord / length
    if (np.diff(along) <= 0).any():
        return None
    away = np.abs((line - line[0]) @ np.array([-chord[1], chord[0]])) / length
    worst = float(away.max())
    return worst if worst <= tolerance else None


def _wall(thin: NDArray[np.uint8], a: NDArray[np.float64], b: NDArray[np.float64], widest: float) -> Box:
    """Fit a straight wall to a centreline: as wide as its cells, centred in them, up to where they end."""
    length = float(np.hypot(*(b - a)))
    along = (b - a) / length
    across = np.array([-along[1], along[0]])
    n = min(MAX_SAMPLES, max(3, round(length)))
    share = (np.arange(n) + 0.5) / n
    middle = a + (b - a) * share[:, None]
    left, right = _reach(thin, middle, across, widest), _reach(thin, middle, -across, widest)
    usual = float(np.median(left + right))  # at junctions other walls count as width
    shift = float(np.median((left - right) / 2))
    before, after = (float(_reach(thin, p[None] + shift * across, d, widest)[0]) for p, d in ((a, -along), (b, along)))
    ends = a - along * before, b + along * after
    centre = (ends[0] + ends[1]) / 2 + shift * across
    yaw = (math.atan2(along[1], along[0]) + math.pi / 2) % math.pi - math.pi / 2
    return Box(float(centre[0]), float(centre[1]), length + before + after, max(usual, 1.0), yaw)


def _reach(
    mask: NDArray[np.uint8], places: NDArray[np.float64], direction: NDArray[np.float64], max_distance: float
) -> NDArray[np.float64]:
    """Measure how far the mask continues from positions in a direction, in cells; at most ``max_distance``."""
    steps = np.arange(0.0, max_distance + 1.0, STEP) + STEP / 2
    at = np.floor(places[:, None, :] + direction * steps[:, None]).astype(np.int64)
    x = np.clip(at[..., 0], 0, mask.shape[1] - 1)
    y = np.clip(at[..., 1], 0, mask.shape[0] - 1)
    out = mask[y, x] == 0
    ends = np.where(out.any(axis=1), out.argmax(axis=1), len(steps))
    return np.asarray(ends * STEP, np.float64)

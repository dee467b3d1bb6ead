"""Figures in a mask: what is round, what is a rectangle, what is a thin straight piece, and what is none of these.

Masks are uint8 [height, width] of zeros and ones, row 0 the lowest. Places are (x, y) in cells from the corner of cell
(0, 0), so that the middle of cell (row, column) is (column + 0.5, row + 0.5).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.errors import CannotConvert

ROUND = 0.8
"""Share of its enclosing circle that a round figure fills: more than a square (0.64), less than an octagon (0.9)."""

PARTLY, HOLLOW = 0.7, 0.88
"""The same for a rim of which a part was not seen, and of its rectangle it then fills less than this (a disc 0.79)."""

MIN_ASPECT = 0.7
"""How wide a round figure is against its length at least."""

MIN_FILL = 0.85
"""Share of its enclosing rectangle that a rectangle fills: more than a disc (0.79) or a triangle (0.5)."""

MAX_FIGURES = 200_000
"""Figures, and edges of middle lines: more are noise."""

MAX_PIECES = 2_000_000
"""Pieces and holes of a mask, specks too."""

ROWS_PER_BLOCK = 1024
"""Rows that are looked at together."""

STEP = 0.25
"""Cells between the places at which a wall's width is looked up."""

MAX_SAMPLES = 64
"""Places along a wall at which its width is looked up, at most."""


@dataclass(frozen=True, slots=True)
class Disc:
    """A round figure in cells."""

    x: float
    y: float
    radius: float


@dataclass(frozen=True, slots=True)
class Box:
    """A rectangle in cells: its middle, its longer and its shorter side, and the direction of the longer one."""

    x: float
    y: float
    length: float
    width: float
    yaw: float


@dataclass(frozen=True, slots=True)
class MaskShapes:
    """What a mask shows. areas: polygons (shapely), in cells. specks: how many figures were too small."""

    discs: list[Disc]
    boxes: list[Box]
    walls: list[Box]
    areas: list[Any]
    specks: int


@dataclass(frozen=True, slots=True)
class ShapeLimits:
    """How large figures are, in cells. speck: the least. disc: the widest round one. box: the longest rectangle.
    wall: the widest wall. small: up to this length all counts as round. tolerance: how far straight edges may be from
    the cells."""

    speck: float
    disc: float
    box: float
    wall: float
    small: float
    tolerance: float


def figures(mask: NDArray[np.uint8], free: NDArray[np.bool_], sizes: ShapeLimits) -> MaskShapes:
    """All figures of a mask, in order of their rows and columns.

    free: bool [height, width], which cells are known to be free; what closes around such a cell is no solid figure but
    walls around a room. CannotConvert where there are more figures than ``MAX_FIGURES``.
    """
    import cv2

    if pieces(mask) > MAX_PIECES:
        raise CannotConvert(f"this is noise: it has more than {MAX_PIECES} pieces and holes")
    contours, tree = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    shapes = MaskShapes([], [], [], [], 0)
    specks = 0
    rest = np.zeros(mask.shape, np.uint8)
    links = np.empty((0, 4), np.int64) if tree is None else np.asarray(tree[0], np.int64)
    # (row, column) of each figure's first cell: the order of the findings does not hang on OpenCV's.
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
        # What is larger than a disc or a box, and wider than a wall, is none of these anyway.
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
    """Whether a hole has a free cell."""
    import cv2

    x, y, w, h = cv2.boundingRect(contour)
    inside = np.zeros((h, w), np.uint8)
    cv2.drawContours(inside, [contour], -1, 1, cv2.FILLED, offset=(-x, -y))
    cv2.drawContours(inside, [contour], -1, 0, 1, offset=(-x, -y))
    return bool((free[y : y + h, x : x + w] & (inside == 1)).any())


def pieces(mask: NDArray[np.uint8]) -> int:
    """How many pieces and holes a mask has at most: cells that begin one, with none of the same before and above."""
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
    """How many cells a figure has, its holes filled: Pick's theorem for the polygon through the cells' middles."""
    import cv2

    steps = np.abs(np.diff(contour[:, 0, :], axis=0, append=contour[:1, 0, :])).max(axis=1)
    return float(cv2.contourArea(contour) + steps.sum() / 2 + 1)


def _rectangle(contour: Any) -> tuple[Box, float, tuple[float, float]]:
    """The smallest rectangle around a figure, the share of it that the figure fills, and its sides between middles.

    The sides are longer than those between the middles of cells, by a cell where a rectangle lies straight, by less
    where it is turned: by as much as makes its area that of the cells.
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
    """A round figure, or None. sides: of the rectangle around it, between the middles of cells."""
    import cv2

    (x, y), reach = cv2.minEnclosingCircle(points.astype(np.float32))
    radius = reach + 0.5
    if 2 * radius > sizes.disc:
        return None
    hull = cv2.convexHull(points)
    # Half a cell more all around (Steiner's formula): contours run through the middles of cells.
    area = cv2.contourArea(hull) + 0.5 * cv2.arcLength(hull, True) + math.pi / 4
    length, width = sides[0] + 1, sides[1] + 1
    share = area / (math.pi * radius**2)
    corners = (area + 1 - math.pi / 4) / (length * width)
    round_ = width >= MIN_ASPECT * length and (share >= ROUND or (share >= PARTLY and corners < HOLLOW))
    if not round_ and length > sizes.small:
        return None
    return Disc(x + 0.5, y + 0.5, math.sqrt(area / math.pi) if round_ else radius)


def _split_others(rest: NDArray[np.uint8], sizes: ShapeLimits, shapes: MaskShapes) -> None:
    """Figures that are neither: their thin parts are walls, the others rectangles or areas."""
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
    # Ends that reach less than their width out of a wall are its roughness.
    graph, _ = _skeleton.skeleton(free_space, merge=2.0, spur=sizes.speck, tolerance=sizes.tolerance, island=0.0)
    if len(graph.edges) > MAX_FIGURES:
        raise CannotConvert(f"this is no place with walls: thin pieces have more than {MAX_FIGURES} edges")
    ends = straighten_lines(graph.nodes[:, ::-1].astype(np.float64), graph.edges, sizes.tolerance)
    for a, b in ends:
        wall = _wall(thin, a + 0.5, b + 0.5, sizes.wall)
        if wall.length >= sizes.speck:
            shapes.walls.append(Box(wall.x + at[0], wall.y + at[1], wall.length, wall.width, wall.yaw))


def _open_mask(mask: NDArray[np.uint8], radius: float) -> NDArray[np.uint8]:
    """What is wider than two radii, with its corners. The mask has a border of zeros."""
    from app.derive import _skeleton

    core = _skeleton.space(mask.copy(), 0, 0, radius)
    if not core.cells:
        return np.zeros(mask.shape, np.uint8)
    # The corner of a square is 0.41 radii beyond the circle in it. What is beyond the arrays counts as core to these
    # kernels, so that it is moved out of reach.
    edge = int(1.5 * radius) + 2
    far = _skeleton.space(np.pad(1 - core.mask, edge, constant_values=1), 0, 0, 1.5 * radius).mask
    far = far[edge:-edge, edge:-edge]
    return np.asarray(mask & (1 - far), np.uint8)


def _areas(thick: NDArray[np.uint8], sizes: ShapeLimits, mask_shapes: MaskShapes, at: NDArray[np.float64]) -> list[Any]:
    """Rectangles among the thick figures go to the boxes; the others' outlines, in order of their rows."""
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
    """The ends of straight lines, each of edges that go on where another ends and that it passes within ``tolerance``.

    At each node the pair that is straightest is joined first. Lines are in the order of their first edges.
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
    """Two lines as one that runs through a common end."""
    first = one if one[-1] == node else one[::-1]
    second = other if other[0] == node else other[::-1]
    return [*first, *second[1:]]


def _distance_from_line(line: NDArray[np.float64], tolerance: float) -> float | None:
    """How far the straight line between the ends is from the corners; None if too far, or if the line turns back."""
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
    """A straight wall from the middle line of one: as wide as its cells, in their middle, to where they end."""
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
    """How far cells of the mask go on from places in a direction, ``max_distance`` cells at most."""
    steps = np.arange(0.0, max_distance + 1.0, STEP) + STEP / 2
    at = np.floor(places[:, None, :] + direction * steps[:, None]).astype(np.int64)
    x = np.clip(at[..., 0], 0, mask.shape[1] - 1)
    y = np.clip(at[..., 1], 0, mask.shape[0] - 1)
    out = mask[y, x] == 0
    ends = np.where(out.any(axis=1), out.argmax(axis=1), len(steps))
    return np.asarray(ends * STEP, np.float64)

"""Detect shapes in a mask: discs, rectangles, thin straight walls, and irregular areas.

Masks are uint8 [height, width] of zeros and ones, row 0 the lowest. Positions are (x, y) in cells from the corner of
cell (0, 0), so that the centre of cell (row, column) is (column + 0.5, row + 0.5).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.derive._centrelines import straighten_lines, wall_boxes
from app.derive._shapes import Box, Disc, MaskShapes, ShapeLimits
from app.derive._walls import find_tables, fit_arc, join_faces, join_walls
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

FREE_INSIDE = 0.5
"""Share of free cells in a hole above which it is a room; a solid's inside is free where a beam slipped through."""

MIN_ARC_CELLS = 5
"""Minimum size of the seen rim of a round object; smaller ones are clutter."""

FREE_IN_ARC = 0.3
"""Maximum share of free cells within the seen rim of a round object."""

MIN_RIM = 0.65
"""Minimum share of the sides of a rectangular solid that was seen: three of four."""

OBLIQUE, MAX_OBLIQUE = 2.0, 0.2
"""Minimum length of an oblique wall in lengths of the shortest wall, and angle in radians from which it is oblique."""

MIN_DIRECTION = 0.3
"""Minimum share of the walls' length in a direction along which tables stand."""

MAX_FIGURES = 200_000
"""Maximum number of shapes, and of centreline edges; more are noise."""

MAX_PIECES = 2_000_000
"""Maximum number of connected pieces and holes of a mask, including specks."""

ROWS_PER_BLOCK = 1024
"""Rows that are processed together."""


def figures(mask: NDArray[np.uint8], free: NDArray[np.bool_], sizes: ShapeLimits) -> MaskShapes:
    """Find all shapes of a mask, in order of their rows and columns.

    free: bool [height, width], cells known to be free; an outline that encloses such a cell is no solid shape but the
    walls of a room. Raises CannotConvert if there are more than ``MAX_FIGURES`` shapes.
    """
    import cv2

    if pieces(mask) > MAX_PIECES:
        raise CannotConvert(f"the grid is too noisy: it has more than {MAX_PIECES} pieces and holes")
    rims, seen = _broken_rims(mask, free, sizes)
    np.subtract(mask, seen, out=seen)  # arrays as large as the grid are used again: they are most of the memory
    contours, tree = cv2.findContours(seen, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    del seen
    shapes = MaskShapes([], [], [], [], 0)
    specks = 0
    rest = np.zeros(mask.shape, np.uint8)
    links = np.empty((0, 4), np.int64) if tree is None else np.asarray(tree[0], np.int64)
    # (row, column) of each shape's first cell: the order must not depend on OpenCV
    outer = [k for k in range(len(contours)) if links[k, 3] < 0]
    outer.sort(key=lambda k: tuple(contours[k][:, 0, ::-1].min(axis=0).tolist()))
    thin = np.zeros(mask.shape, np.uint8)
    legs: list[tuple[float, float]] = []
    for k in outer:
        points = contours[k][:, 0, :]
        box, share, sides = _rectangle(contours[k])
        if box.length <= sizes.leg:
            legs.append((box.x, box.y))
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
        room = small and _is_free([contours[c] for c in inner], free)
        disc = None if room else _disc(points, sides, sizes) or _arc(contours[k], mask, free, sizes)
        if disc is not None:
            shapes.discs.append(disc)
        elif not room and share >= MIN_FILL and box.width <= sizes.wall and box.length >= 2 * box.width:
            shapes.walls.append(box)
            cv2.drawContours(thin, [contours[k], *(contours[c] for c in inner)], -1, 1, cv2.FILLED)
        elif not room and share >= MIN_FILL and box.length <= sizes.box:
            shapes.boxes.append(box)
        elif not room and box.length <= sizes.box and _is_rim(contours[k], box, mask, free, sizes):
            rims.append(box)
        else:
            cv2.drawContours(rest, [contours[k], *(contours[c] for c in inner)], -1, 1, cv2.FILLED)
    if rest.any():
        rest &= mask
        _split_others(rest, thin, sizes, shapes)
    del rest
    thin &= mask
    shapes = _join(_without_insides(shapes, rims, mask.shape), thin, free, sizes)
    return _with_tables(replace(shapes, specks=specks), np.array(legs), free, sizes)


def _is_rim(contour: Any, box: Box, mask: NDArray[np.uint8], free: NDArray[np.bool_], sizes: ShapeLimits) -> bool:
    """Return whether a thin piece is the seen rim of a solid rectangle: most of its sides, its inside not free."""
    import cv2

    if min(box.length, box.width) < 2 * sizes.speck:
        return False
    corners = np.floor(_corners(box) + 0.5).astype(np.int32)
    # the corners of a turned box may lie outside the window of the outline
    x, y, width, height = window = cv2.boundingRect(np.vstack([contour[:, 0, :], corners]))
    corners -= (x, y)
    piece, outline, inside = np.zeros((3, height, width), np.uint8)
    cv2.drawContours(piece, [contour], -1, 1, cv2.FILLED, offset=(-x, -y))
    piece &= _cut(mask, window)
    cv2.polylines(outline, [corners], True, 1)
    near = cv2.dilate(piece, np.ones((5, 5), np.uint8)) == 1
    if near[outline == 1].mean() < MIN_RIM:
        return False
    cv2.fillPoly(inside, [corners], 1)
    inner = (inside == 1) & (piece == 0)
    return bool((_cut(free, window) & inner).sum() <= FREE_INSIDE * inner.sum())


def _cut(cells: NDArray[Any], window: Sequence[int]) -> NDArray[Any]:
    """Return the cells of a window (x, y, width, height); those outside the grid are zero."""
    x, y, width, height = window
    out = np.zeros((height, width), cells.dtype)
    part = cells[max(y, 0) : y + height, max(x, 0) : x + width]
    out[max(-y, 0) :, max(-x, 0) :][: part.shape[0], : part.shape[1]] = part
    return out


def _broken_rims(
    mask: NDArray[np.uint8], free: NDArray[np.bool_], sizes: ShapeLimits
) -> tuple[list[Box], NDArray[np.uint8]]:
    """Return (solid rectangles whose rims were seen in several pieces, the cells of those pieces)."""
    import cv2

    contours, tree = cv2.findContours(
        cv2.dilate(mask, np.ones((3, 3), np.uint8)), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE
    )
    out: list[tuple[int, int, Box]] = []
    seen = np.zeros_like(mask)
    # no holes, but what stands in them: in a closed room
    for contour in itertools.compress(contours, [] if tree is None else tree[0][:, 3] < 0):
        x, y, width, height = cv2.boundingRect(contour)
        if max(width, height) > sizes.box + 2 or min(width, height) <= sizes.wall + 2:
            continue
        piece = np.zeros((height, width), np.uint8)
        cv2.drawContours(piece, [contour], -1, 1, cv2.FILLED, offset=(-x, -y))
        piece &= mask[y : y + height, x : x + width]
        parts, _ = cv2.findContours(piece, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        if len(parts) < 2:
            continue
        around = np.concatenate(parts) + np.array([x, y], np.int32)
        box, _, _ = _rectangle(cv2.convexHull(around))
        if (
            box.width > sizes.wall
            and _is_rim(contour, box, mask, free, sizes)
            and _arc(contour, mask, free, sizes) is None
        ):
            out.append((y, x, box))
            cv2.drawContours(seen, [contour], -1, 1, cv2.FILLED)
    return [box for _, _, box in sorted(out, key=lambda rim: rim[:2])], seen & mask


def _corners(box: Box) -> NDArray[np.float64]:
    """Return the corners of a box between the middles of its outermost cells, from the middle of cell (0, 0)."""
    along = np.array([math.cos(box.yaw), math.sin(box.yaw)])
    across = np.array([-along[1], along[0]]) * (box.width - 1) / 2
    along = along * (box.length - 1) / 2
    middle = np.array([box.x - 0.5, box.y - 0.5])
    return middle + np.stack([-along - across, along - across, along + across, across - along])


def _without_insides(shapes: MaskShapes, rims: list[Box], shape: tuple[int, ...]) -> MaskShapes:
    """Add solids of which the rim was seen, and drop what was seen within them."""
    if not rims:
        return shapes
    inside = _painted(rims, shape, 0.0)

    def is_outside(figure: Disc | Box) -> bool:
        row, column = min(int(figure.y), shape[0] - 1), min(int(figure.x), shape[1] - 1)
        return not inside[max(row, 0), max(column, 0)]

    boxes = [box for box in shapes.boxes if is_outside(box)]
    walls = [wall for wall in shapes.walls if is_outside(wall)]
    return replace(shapes, discs=list(filter(is_outside, shapes.discs)), boxes=[*boxes, *rims], walls=walls)


def _join(shapes: MaskShapes, thin: NDArray[np.uint8], free: NDArray[np.bool_], sizes: ShapeLimits) -> MaskShapes:
    """Join pieces of walls; what is too short for a wall, or lies beside one, becomes an area."""
    joined = join_walls(shapes.walls, sizes.tolerance + 0.5, sizes.gap, _directions(shapes.walls))
    # what is longer now has a better direction
    joined = join_walls(joined, sizes.tolerance + 0.5, sizes.gap, _directions(joined))
    joined = join_faces(joined, free, sizes.wall)
    walls = [wall for wall in joined if wall.length >= sizes.length]
    main = _directions(walls)
    # across the main directions, what is little longer than clutter is clutter
    walls = [wall for wall in walls if not main or wall.length >= OBLIQUE * sizes.length or _is_along(wall, main)]
    left = _painted(walls, thin.shape, 1.0)
    np.greater(thin, left, out=left.view(bool))
    return replace(shapes, walls=walls, areas=[*shapes.areas, *_remains(left)])


def _painted(boxes: list[Box], shape: tuple[int, ...], margin: float) -> NDArray[np.uint8]:
    """Return the cells of boxes with a margin around them."""
    import cv2

    out = np.zeros(shape, np.uint8)
    for box in boxes:
        along = np.array([math.cos(box.yaw), math.sin(box.yaw)])
        across = np.array([-along[1], along[0]]) * (box.width / 2 + margin)
        along = along * (box.length / 2 + margin)
        middle = np.array([box.x - 0.5, box.y - 0.5])
        corners = np.stack([middle - along - across, middle + along - across, middle + along + across])
        corners = np.vstack([corners, middle - along + across])
        cv2.fillPoly(out, [np.round(corners * 16).astype(np.int32)], 1, shift=4)
    return out


def _remains(left: NDArray[np.uint8]) -> list[Any]:
    """Return what walls do not cover as areas, joined over gaps of two cells; single cells are none."""
    import cv2

    from app.derive.imagery_to_objects import polygons

    count, label = cv2.connectedComponents(cv2.dilate(left, np.ones((3, 3), np.uint8)), connectivity=8)
    label[left == 0] = 0
    single = np.bincount(label[left == 1], minlength=count) < 2
    label[single[label]] = 0
    areas = polygons(label.astype(np.int32, copy=False), (1.0, 0.0, 0.0, 0.0, 1.0, 0.0), 0.0) if label.any() else {}
    return [area for _, area in sorted(areas.items())]


def _with_tables(
    shapes: MaskShapes, legs: NDArray[np.float64], free: NDArray[np.bool_], sizes: ShapeLimits
) -> MaskShapes:
    """Replace four legs that stand in a rectangle by the table that stands on them."""
    if not sizes.table[1] or not len(legs):
        return shapes
    tables = list(find_tables(legs, free, sizes.table, _directions(shapes.walls)))
    discs, boxes, areas = shapes.discs, shapes.boxes, shapes.areas
    for table in tables:
        discs = [disc for disc in discs if not _is_in(table, disc.x, disc.y)]
        boxes = [box for box in boxes if not _is_in(table, box.x, box.y)]
        areas = [area for area in areas if not _is_in(table, area.centroid.x, area.centroid.y)]
    return replace(shapes, discs=discs, boxes=[*boxes, *tables], areas=areas)


def _is_in(box: Box, x: float, y: float, margin: float = 2.0) -> bool:
    c, s = math.cos(box.yaw), math.sin(box.yaw)
    u, v = (x - box.x) * c + (y - box.y) * s, (y - box.y) * c - (x - box.x) * s
    return abs(u) <= box.length / 2 + margin and abs(v) <= box.width / 2 + margin


def _is_along(wall: Box, directions: list[float]) -> bool:
    """Return whether a wall is along a direction, or at a right angle to it."""
    turns = [abs(math.remainder(wall.yaw - direction, math.pi / 2)) for direction in directions]
    return min(turns) <= MAX_OBLIQUE


def _directions(walls: list[Box]) -> list[float]:
    """Return the main directions of walls, from 0 to 90 degrees, in radians: one, or two at odds with each other."""
    if not walls:
        return []
    turns = np.array([wall.yaw % (math.pi / 2) for wall in walls])
    lengths = np.array([wall.length for wall in walls])
    # length by degrees, and within three degrees of each
    degrees = np.floor(np.degrees(turns)).astype(np.int64) % 90
    weight = np.bincount(degrees, weights=lengths, minlength=90)
    out: list[float] = []
    while len(out) < 2:
        sums = sum((np.roll(weight, k) for k in range(-3, 4)), np.zeros(90))
        best = int(sums.argmax())
        if sums[best] < MIN_DIRECTION * lengths.sum():
            break
        away = np.remainder(turns - math.radians(best + 0.5) + math.pi / 4, math.pi / 2) - math.pi / 4
        near = np.abs(away) <= math.radians(3.5)
        out.append(float(math.radians(best + 0.5) + np.average(away[near], weights=lengths[near])))
        weight[(best + np.arange(-3, 4)) % 90] = 0.0
    return out


def _is_free(holes: list[Any], free: NDArray[np.bool_]) -> bool:
    """Return whether most of the ground in the holes of a piece is free."""
    import cv2

    cells = seen = 0
    for hole in holes:
        x, y, w, h = cv2.boundingRect(hole)
        inside = np.zeros((h, w), np.uint8)
        cv2.drawContours(inside, [hole], -1, 1, cv2.FILLED, offset=(-x, -y))
        cv2.drawContours(inside, [hole], -1, 0, 1, offset=(-x, -y))
        cells += int(inside.sum())
        seen += int((free[y : y + h, x : x + w] & (inside == 1)).sum())
    return seen > FREE_INSIDE * cells


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


def _arc(contour: Any, mask: NDArray[np.uint8], free: NDArray[np.bool_], sizes: ShapeLimits) -> Disc | None:
    """Return the round object of whose rim a piece is the part that was seen, or None."""
    import cv2

    x, y, width, height = cv2.boundingRect(contour)
    if max(width, height) > sizes.disc or max(width, height) < MIN_ARC_CELLS:
        return None
    piece = np.zeros((height, width), np.uint8)
    cv2.drawContours(piece, [contour], -1, 1, cv2.FILLED, offset=(-x, -y))
    rows, columns = np.nonzero(piece & mask[y : y + height, x : x + width])
    at = np.column_stack([columns + (x + 0.5), rows + (y + 0.5)]).astype(np.float64)
    disc = fit_arc(at, sizes.disc / 2)
    if disc is None:
        return None
    v, u = np.ogrid[y : y + height, x : x + width]
    inner = np.hypot(u + 0.5 - disc.x, v + 0.5 - disc.y) < disc.radius - 1.5
    return disc if (free[y : y + height, x : x + width] & inner).sum() <= FREE_IN_ARC * inner.sum() else None


def _split_others(rest: NDArray[np.uint8], out: NDArray[np.uint8], sizes: ShapeLimits, shapes: MaskShapes) -> None:
    """Split the remaining shapes: thin parts become walls and are marked in ``out``, others rectangles or areas."""
    from app.derive import _skeleton

    rows, columns = np.flatnonzero(rest.any(axis=1)), np.flatnonzero(rest.any(axis=0))
    top, left = int(rows[0]), int(columns[0])
    mask = np.pad(rest[top : int(rows[-1]) + 1, left : int(columns[-1]) + 1], 1)
    at = np.array([left - 1.0, top - 1.0])
    thick = _open_mask(mask, sizes.wall / 2)
    if thick.any():
        shapes.areas.extend(_areas(thick, sizes, shapes, at))
    mask -= thick
    del thick
    out[top : int(rows[-1]) + 1, left : int(columns[-1]) + 1] |= mask[1:-1, 1:-1]
    if not mask.any():
        return
    free_space = _skeleton.space(mask, 0, 0, 0.0)  # without a radius the mask does not change
    # branches that reach less than their width out of a wall are roughness
    graph, _ = _skeleton.skeleton(free_space, merge=2.0, spur=sizes.speck, tolerance=sizes.tolerance, island=0.0)
    if len(graph.edges) > MAX_FIGURES:
        raise CannotConvert(f"the grid shows no walls: its thin pieces have more than {MAX_FIGURES} edges")
    for wall in wall_boxes(mask, straighten_lines(graph.nodes[:, ::-1], graph.edges, sizes.tolerance), sizes.wall):
        if wall.length >= sizes.speck:
            shapes.walls.append(replace(wall, x=wall.x + float(at[0]), y=wall.y + float(at[1])))


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

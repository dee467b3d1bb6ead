"""Rooms, corridors and doors of a grid: basins of the distance to walls, divided at narrow necks.

Steps, after the methods compared by Bormann et al. (Room segmentation: survey, implementation, and analysis, ICRA
2016), MAORIS (Mielle et al., ICRA 2018) and ROSE² (Luperto et al., IROS 2022):

1. *Declutter.* Isolated pieces of occupied cells up to ``CLUTTER`` across (legs, chairs, posts) are not walls, nor are
   pockets of unknown cells up to ``POCKET`` across (what furniture hides).
2. *Basins.* Ground is flooded from the places farthest from walls. Basins that meet are one room unless they meet in a
   neck, narrower than both.
3. *Doors.* A neck is a door if its jambs are walls, it is as wide as a door and as short as a wall is thick.
   Basins that meet elsewhere are joined.
4. *Corridors* are parts of a basin that are much narrower than it, and long; and long basins.
5. Basins that walls do not enclose (fields, yards, fringes of a scan) are no rooms.
6. *Niches*, which open to one other area along a whole side, are parts of it, as Bormann et al. join small parts that
   share much of their outline with one other.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from app.derive import _partitions

Mask = NDArray[np.bool_]
Labels = NDArray[np.int32]
Distance = NDArray[np.float32]

CLUTTER = 1.0
"""Maximum size of isolated obstacles that are furniture, in metres."""

ISLAND = 8.0
ISLAND_AREA = 15.0
BULK = 0.5
"""Isolated obstacles that are furniture if they are no thin walls and no rooms: maximum size in metres and square
metres, and the minimum share of their smallest rectangle that they fill."""

DASH = 0.1
"""Gaps in metres within the outline of a piece of furniture."""

POCKET = 1.6
"""Maximum width of unknown ground that counts as part of the room around it, in metres."""

NECK = 0.85
WIDE_NECK = 0.65
"""Ratios of a neck's width to that of the smaller basin, above which both are one room: for necks as wide as a door,
and for wider ones."""

MAX_DOOR = 2.3
MIN_DOOR = 0.5
"""Width of doors in metres: from a narrow leaf to a double door."""

WIDE_DOOR = 2.0
"""Minimum width in metres of openings that part rooms although the distance to walls does not dip in them."""

JAMB = 0.5
"""Minimum length of the walls that a door's gap continues, as a share of its width."""

MIN_ROOM_WIDTH = 1.0
MIN_ROOM_AREA = 1.5
"""Smallest room, in metres and square metres."""

THIN = 0.6
"""Ratio of a corridor's width to that of the room that it leaves."""

LONG = 3.0
"""Minimum ratio of a corridor's length to its width."""

MOUTHS = 3.6
"""Maximum length of the ends at which a corridor meets its room, as a multiple of its width: two, which may widen."""

MAX_CORRIDOR = 4.0
"""Maximum width of a corridor in metres."""

ENCLOSED = 0.6
"""Minimum share of a room's outline that is wall or leads to another room."""

SIDE = 0.25
"""Minimum share of a room's outline, of a square one side, along which it opens to one area and is its niche."""

BESIDE = 0.7
"""Depth in metres behind a door in which the areas on its sides are sought."""

SEEN = 0.25
"""Minimum share of a room's cells that are free: less was not seen, or is the inside of an obstacle."""

RAYS = 72


@dataclass(frozen=True, slots=True)
class Door:
    """Passage between two areas. ends: float64 [2, 2] x, y of its jambs in cells; sides: labels of the areas; is_wide:
    whether it is too wide for a door; confidence: share of its width that walls continue."""

    ends: NDArray[np.float64]
    sides: tuple[int, int]
    is_wide: bool
    confidence: float

    @property
    def width(self) -> float:
        """Return its width in cells."""
        return float(np.hypot(*(self.ends[1] - self.ends[0])))


@dataclass(frozen=True, slots=True, eq=False)
class Rooms:
    """Areas of a grid.

    Attributes:
        labels: int32 [h, w], 0 for none.
        kinds: ``room`` or ``corridor``, by label.
        widths: diameter in cells of the largest circle of ground in each.
        enclosed: share of each outline that is wall or leads to another area.
        doors: gaps between them.
    """

    labels: Labels
    kinds: dict[int, str]
    widths: dict[int, float]
    enclosed: dict[int, float]
    doors: list[Door]


def rooms(free: Mask, occupied: Mask, cell: float) -> Rooms:
    """Divide the free ground of a grid into rooms and corridors. cell: metres; grids have row 0 at the bottom."""
    ground, wall = declutter(free, occupied, cell)
    distance = distances(ground)
    borders = _partitions.borders(wall, ground, WIDE_DOOR, JAMB, cell)
    labels = basins(np.where(borders, np.float32(0), distance), cell)
    labels = _grown(labels, borders)
    labels, doors = _join(labels, distance, wall, borders, cell)
    labels = _enclosed(labels, free, wall, distance, cell)
    thick = thickness(ground, distance)
    labels, corridors = _cut_corridors(labels, free, thick, cell)
    labels = _without_niches(labels, corridors, free, cell)
    doors = [replace(door, sides=_sides(door, labels, cell)) for door in doors]
    return _classified(labels, doors, wall, distance, thick, cell, corridors)


def distances(mask: Mask) -> Distance:
    """Return the distance of each cell of a mask to the nearest other cell, in cells."""
    return np.asarray(cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE), np.float32)


def declutter(free: Mask, occupied: Mask, cell: float) -> tuple[Mask, Mask]:
    """Return the ground and the walls, without furniture and small unknown pockets.

    The masks must have a margin of unknown cells that is wider than a pocket.
    """
    furniture = _furniture(occupied, free, cell)
    wall = occupied & ~furniture
    unknown = ~free & ~occupied & ~furniture
    depth = distances(unknown)
    piece, count = ndimage.label(unknown)
    deepest = np.zeros(count + 1)
    np.maximum.at(deepest, np.asarray(piece, np.int64).ravel(), depth.ravel())
    unknown &= (deepest > POCKET / 2 / cell)[piece]
    return ~wall & ~unknown, wall


def _furniture(occupied: Mask, free: Mask, cell: float) -> Mask:
    """Return the cells of isolated obstacles that are no walls, with what they enclose."""
    out = np.zeros(occupied.shape, np.uint8)
    size = 2 * max(1, round(DASH / 2 / cell)) + 1
    joined = np.asarray(
        cv2.morphologyEx(occupied.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((size, size), np.uint8)), np.uint8
    )
    for contour in outer_contours(joined):
        _, sides, _ = cv2.minAreaRect(contour)
        length, width = (max(sides) + 1.0) * cell, (min(sides) + 1.0) * cell
        area = cv2.contourArea(contour) * cell * cell + 1e-9
        is_bulky = length <= ISLAND and area <= ISLAND_AREA and width > CLUTTER / 2 and area >= BULK * length * width
        if np.hypot(length, width) <= CLUTTER or (is_bulky and not _has_room(contour, free)):
            cv2.drawContours(out, [contour], -1, 1, cv2.FILLED)
    return np.asarray(out == 1)


def outer_contours(mask: NDArray[np.uint8]) -> list[NDArray[np.int32]]:
    """Return the outer outline of each piece of a mask, also of those inside others."""
    contours, tree = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    return (
        [np.asarray(c, np.int32) for c, links in zip(contours, tree[0], strict=True) if links[3] < 0]
        if len(contours)
        else []
    )


def _has_room(contour: NDArray[np.int32], free: Mask) -> bool:
    """Return whether most of what an obstacle encloses is free."""
    x, y, width, height = cv2.boundingRect(contour)
    inside = np.zeros((height, width), np.uint8)
    cv2.drawContours(inside, [contour], -1, 1, cv2.FILLED, offset=(-x, -y))
    count = np.count_nonzero((inside == 1) & free[y : y + height, x : x + width])
    return bool(2 * count > np.count_nonzero(inside))


def basins(distance: Distance, cell: float) -> Labels:
    """Label the basins of the distance to walls (cells), divided at necks."""
    from app.derive import _kernels_rooms as kernels

    inside = np.flatnonzero(distance > 0)
    order = inside[np.argsort(-distance.ravel()[inside], kind="stable")]
    labels = np.zeros(distance.shape, np.int32)
    peak = np.zeros(len(order) + 2)
    ratios = np.array([NECK, WIDE_NECK])
    kernels.flood(distance, order, MAX_DOOR / 2 / cell, ratios, MIN_ROOM_WIDTH / 2 / cell, labels, peak)
    return labels


def _grown(labels: Labels, ground: Mask) -> Labels:
    """Return labels that reach into the thin ground between them."""
    labels = labels.copy()
    left = ground & (labels == 0)
    while left.any():
        near = cv2.dilate(labels.astype(np.float32), np.ones((3, 3), np.uint8)).astype(np.int32)
        reached = left & (near > 0)
        if not reached.any():
            break
        labels[reached] = near[reached]
        left &= ~reached
    return labels


def _join(labels: Labels, distance: Distance, wall: Mask, borders: Mask, cell: float) -> tuple[Labels, list[Door]]:
    """Join basins that meet elsewhere than at a door; return the labels and the doors."""
    parent = np.arange(int(labels.max()) + 1)

    def top(k: int) -> int:
        while parent[k] != k:
            k = int(parent[k])
        return k

    candidates: list[Door] = []
    for a, b, seam in _seams(labels):
        door = _door(seam, distance, wall, cell, (a, b))
        if door is None and borders[tuple(seam.T)].mean() <= 0.5:
            low, high = sorted((top(a), top(b)))
            parent[high] = low
        elif door is not None:
            candidates.append(door)
    final = np.array([top(k) for k in range(len(parent))], np.int32)
    doors = [
        Door(d.ends, (int(final[d.sides[0]]), int(final[d.sides[1]])), d.is_wide, d.confidence) for d in candidates
    ]
    return final[labels], [d for d in doors if d.sides[0] != d.sides[1] and not d.is_wide]


def _seams(labels: Labels) -> list[tuple[int, int, NDArray[np.int64]]]:
    """Return the connected pieces of the lines where two basins meet: both labels, and cells [n, 2] (row, column)."""
    met, sides = [], []
    for dy, dx in ((0, 1), (1, 0)):
        first, second = labels[: len(labels) - dy, : labels.shape[1] - dx], labels[dy:, dx:]
        at = np.argwhere((first != second) & (first > 0) & (second > 0))
        met.append(at)
        sides.append(np.sort(np.stack([first[tuple(at.T)], second[tuple(at.T)]], axis=1), axis=1))
    every, pairs = np.concatenate(met), np.concatenate(sides)
    order = np.lexsort((every[:, 1], every[:, 0], pairs[:, 1], pairs[:, 0]))
    every, pairs = every[order], pairs[order]
    begins = np.flatnonzero((np.diff(pairs, axis=0, prepend=-1) != 0).any(axis=1)).tolist()
    out: list[tuple[int, int, NDArray[np.int64]]] = []
    for begin, end in itertools.pairwise([*begins, len(pairs)]):
        a, b = pairs[begin].tolist()
        points = np.unique(every[begin:end], axis=0)
        low = points.min(axis=0)
        canvas = np.zeros(points.max(axis=0) - low + 1, np.uint8)
        canvas[tuple((points - low).T)] = 1
        _, piece = cv2.connectedComponents(cv2.dilate(canvas, np.ones((3, 3), np.uint8)), connectivity=8)
        index = piece[tuple((points - low).T)]
        out += [(a, b, points[index == k]) for k in np.unique(index)]
    return out


def _door(seam: NDArray[np.int64], distance: Distance, wall: Mask, cell: float, sides: tuple[int, int]) -> Door | None:
    """Return the door at a seam, None if it is no door."""
    row, column = seam[int(np.argmax(distance[tuple(seam.T)]))]
    half = float(distance[row, column])
    hits, ends = _rays(wall, int(row), int(column), int(max(MAX_DOOR / cell, 2.5 * half)))
    pairs = hits[:, None] + hits[None, :]
    turn = np.abs(np.arange(RAYS)[:, None] - np.arange(RAYS)[None, :])
    opposite = np.abs(turn - RAYS // 2) <= RAYS // 8
    pairs = np.where(opposite, pairs, np.inf)
    i, k = np.unravel_index(int(np.argmin(pairs)), pairs.shape)
    jambs = ends[[i, k]]
    width = float(np.hypot(*(jambs[1] - jambs[0])))
    if not np.isfinite(pairs[i, k]) or width * cell < MIN_DOOR:
        return None
    walls = _jambs(wall, jambs, width, cell) / width
    if walls < JAMB:
        return None
    reach = half + 0.7 / cell
    y0, y1 = max(0, int(row - reach)), int(row + reach) + 1
    x0, x1 = max(0, int(column - reach)), int(column + reach) + 1
    near = distance[y0:y1, x0:x1]
    rows, columns = np.mgrid[y0 : y0 + near.shape[0], x0 : x0 + near.shape[1]]
    along = (jambs[1] - jambs[0]) / max(width, 1e-9)
    across = (rows - row) * along[0] - (columns - column) * along[1]
    wider = (near > 1.15 * half) & (np.hypot(rows - row, columns - column) <= reach)
    if not ((wider & (across > 0)).any() and (wider & (across < 0)).any()):
        return None
    return Door(jambs, sides, width * cell > MAX_DOOR, min(1.0, walls))


def _jambs(wall: Mask, ends: NDArray[np.float64], width: float, cell: float) -> float:
    """Return the length of the walls that continue the line of a gap, on both sides, in cells."""
    along = (ends[1] - ends[0]) / width
    reach = max(1, round(0.15 / cell))
    aside = np.arange(-reach, reach + 1)[:, None] * np.array([-along[1], along[0]])
    total = 0.0
    for end, direction in ((ends[0], -along), (ends[1], along)):
        steps = np.arange(int(2 * width) + 1)[:, None, None] * direction
        at = np.rint(end + steps + aside).astype(int)
        x, y = np.clip(at[..., 0], 0, wall.shape[1] - 1), np.clip(at[..., 1], 0, wall.shape[0] - 1)
        gone = ~wall[y, x].any(axis=1)
        total += float(np.argmax(gone)) if gone.any() else float(len(gone))
    return total


def _rays(wall: Mask, row: int, column: int, length: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return for rays from a cell the distance to the first wall (inf if none), and its position x, y [RAYS, 2]."""
    angle = np.arange(RAYS) * (2 * np.pi / RAYS)
    step = np.arange(1, length + 1)
    y = np.rint(row + np.sin(angle)[:, None] * step).astype(int)
    x = np.rint(column + np.cos(angle)[:, None] * step).astype(int)
    inside = (y >= 0) & (y < wall.shape[0]) & (x >= 0) & (x < wall.shape[1])
    hit = np.zeros(inside.shape, bool)
    hit[inside] = wall[y[inside], x[inside]]
    first = hit.argmax(axis=1)
    some = hit.any(axis=1)
    rays = np.arange(RAYS)
    ends = np.stack([x[rays, first], y[rays, first]], axis=1).astype(np.float64)
    return np.where(some, step[first].astype(np.float64), np.inf), ends


def thickness(ground: Mask, distance: Distance) -> Distance:
    """Return for each cell the radius of the largest disc of ground that covers it, in steps of a tenth."""
    out = np.minimum(distance, 1.0).astype(np.float32)
    radius, largest = 2.0, float(distance.max())
    while radius < largest:
        outside = distance < radius
        if not outside.all():
            covered = distances(outside) < radius
            out[covered & ground] = radius
        radius *= 1.1
    return out


def _cut_corridors(labels: Labels, free: Mask, thick: Distance, cell: float) -> tuple[Labels, set[int]]:
    """Give long parts of a basin that are much narrower than it, and what they part, labels of their own.

    Return the labels, and those of such corridors.
    """
    labels = labels.copy()
    count = int(labels.max())
    corridors: set[int] = set()
    peak = np.zeros(count + 1)
    np.maximum.at(peak, labels.ravel(), thick.ravel())
    thin = (labels > 0) & (thick < THIN * peak[labels]) & (thick * cell >= 0.3) & (thick * cell <= MAX_CORRIDOR / 2)
    for basin, window in _windows(labels):
        inside = labels[window] == basin
        part = (thin[window] & inside).astype(np.uint8)
        _, piece, stats, _ = cv2.connectedComponentsWithStats(part, connectivity=4)
        before = count
        for k in np.flatnonzero(stats[:, cv2.CC_STAT_AREA] * cell * cell >= MIN_ROOM_AREA).tolist():
            x, y, width, height, _ = stats[k].tolist()
            frame = (slice(max(y - 1, 0), y + height + 1), slice(max(x - 1, 0), x + width + 1))
            chosen = piece[frame] == k
            if k and _is_corridor(chosen, inside[frame], free[window][frame], thick[window][frame]):
                count += 1
                labels[window][frame][chosen] = count
                corridors.add(count)
        if count > before:
            pieces, piece = cv2.connectedComponents((labels[window] == basin).astype(np.uint8), connectivity=4)
            for k in range(2, pieces):
                count += 1
                labels[window][piece == k] = count
    return labels, corridors


def _without_niches(labels: Labels, corridors: set[int], free: Mask, cell: float) -> Labels:
    """Join rooms that open to one other area along a whole side, and scraps, to their neighbours, the smallest first.

    Scraps, which corridors leave, are too small for rooms, or were not seen.
    """
    labels = labels.copy()
    for k, window in sorted(_windows(labels), key=lambda one: np.count_nonzero(labels[one[1]] == one[0])):
        chosen = labels[window] == k
        if k in corridors or not chosen.any():
            continue
        beside = labels[window][(cv2.dilate(chosen.astype(np.uint8), np.ones((3, 3), np.uint8)) == 1) & ~chosen]
        shared = np.bincount(beside, minlength=1)
        shared[0] = 0
        area = np.count_nonzero(chosen)
        is_scrap = area * cell * cell < MIN_ROOM_AREA or np.count_nonzero(chosen & free[window]) < SEEN * area
        if is_scrap or shared.max() >= SIDE * len(beside):
            labels[window][chosen] = int(shared.argmax())
    return labels


def _sides(door: Door, labels: Labels, cell: float) -> tuple[int, int]:
    """Return the areas on both sides of a door, 0 for none."""
    middle, along = door.ends.mean(axis=0), (door.ends[1] - door.ends[0]) / door.width
    places = middle + np.linspace(-0.3, 0.3, 7)[:, None] * along * door.width
    depths = np.arange(round(BESIDE / 2 / cell), round(BESIDE / cell) + 2)[:, None, None] * np.array(
        [-along[1], along[0]]
    )
    out = []
    for sign in (-1, 1):
        x, y = np.moveaxis(np.rint(places + sign * depths).astype(int), -1, 0)
        near = labels[np.clip(y, 0, labels.shape[0] - 1), np.clip(x, 0, labels.shape[1] - 1)]
        out.append(int(np.bincount(near.ravel()).argmax()))
    return out[0], out[1]


def _is_corridor(chosen: Mask, basin: Mask, free: Mask, thick: Distance) -> bool:
    """Return whether a thin part of a basin leads out of it: long, seen, and open at its ends only."""
    area = float(np.count_nonzero(chosen))
    wide = 2.0 * float(np.median(thick[chosen]))
    if area < LONG / 1.5 * wide * wide or np.count_nonzero(chosen & free) < SEEN * area:
        return False
    beside = cv2.dilate(chosen.astype(np.uint8), np.ones((3, 3), np.uint8)) == 1
    return bool(np.count_nonzero(beside & ~chosen & basin) <= MOUTHS * wide)


def _enclosed(labels: Labels, free: Mask, wall: Mask, distance: Distance, cell: float) -> Labels:
    """Drop basins that are too small, hidden, or enclosed neither by walls nor by other basins that stay."""
    labels = labels.copy()
    solid = cv2.dilate(wall.astype(np.uint8), np.ones((3, 3), np.uint8)) == 1
    dropped = True
    while dropped:
        dropped = False
        for k, window in _windows(labels):
            chosen = labels[window] == k
            area = np.count_nonzero(chosen)
            wide = 2.0 * float(distance[window][chosen].max())
            if (
                area * cell * cell < MIN_ROOM_AREA
                or wide * cell < 0.8 * MIN_ROOM_WIDTH
                or np.count_nonzero(chosen & free[window]) < SEEN * area
                or _enclosure(chosen, solid[window] | (labels[window] > 0)) < ENCLOSED
            ):
                labels[window][chosen] = 0
                dropped = True
    return labels


def _windows(labels: Labels) -> list[tuple[int, tuple[slice, slice]]]:
    """Return each label with a window around its cells; labels must keep off the border."""
    return [
        (k, (slice(e[0].start - 1, e[0].stop + 1), slice(e[1].start - 1, e[1].stop + 1)))
        for k, e in enumerate(ndimage.find_objects(labels), 1)
        if e is not None
    ]


def _enclosure(chosen: Mask, border: Mask) -> float:
    """Return the share of an area's outer outline that is border."""
    filled = ndimage.binary_fill_holes(chosen)  # what stands inside encloses nothing
    ring = (cv2.dilate(filled.astype(np.uint8), np.ones((3, 3), np.uint8)) == 1) & ~filled
    return float(np.count_nonzero(ring & border)) / max(1.0, float(np.count_nonzero(ring)))


def _classified(
    labels: Labels, doors: list[Door], wall: Mask, distance: Distance, thick: Distance, cell: float, corridors: set[int]
) -> Rooms:
    """Return the areas with their kinds: a corridor is long, and leads on at two places or more."""
    solid = cv2.dilate(wall.astype(np.uint8), np.ones((3, 3), np.uint8)) == 1
    kinds: dict[int, str] = {}
    widths: dict[int, float] = {}
    enclosed: dict[int, float] = {}
    for k, window in _windows(labels):
        chosen = labels[window] == k
        widths[k] = 2.0 * float(distance[window][chosen].max())
        enclosed[k] = _enclosure(chosen, solid[window] | (labels[window] > 0))
        middle = 2.0 * float(np.median(thick[window][chosen]))
        is_long = np.count_nonzero(chosen) >= LONG * middle**2 and max(middle, widths[k]) * cell <= MAX_CORRIDOR
        beside = (cv2.dilate(chosen.astype(np.uint8), np.ones((3, 3), np.uint8)) == 1) & (labels[window] > 0) & ~chosen
        exits, _ = cv2.connectedComponents(beside.astype(np.uint8), connectivity=8)
        ways = max(exits - 1, sum(k in door.sides for door in doors))
        kinds[k] = "corridor" if k in corridors or (is_long and ways > 1) else "room"
    return Rooms(labels, kinds, widths, enclosed, [d for d in doors if d.sides[0] != d.sides[1]])

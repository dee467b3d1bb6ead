"""Find parallel rows (trees, vines, crops, posts) in a mask of plants or obstacles.

Directions come from projections of the mask: along rows, its cells fall onto few lines (the Radon transform, as in
Rovira-Más et al. 2005). In each of the best directions, lines with cells at short distances become segments, each the
strongest of its neighbourhood. Segments side by side at regular distances are a field. A single line, such as a wall,
and lines without regularity are none: this is what a Hough transform alone does not tell. A row is only where its
plants stand out on both sides: the edge of a meadow is none, and rows end where they run into it. Where all rows have
a gap at once, an aisle crosses them, and the field falls into blocks. Rows may be bent: all of a field by one parabola.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from app.model.distinct import distinct

Array = NDArray[np.float64]

MAX_CELLS = 2**21
"""Maximum number of cells of a mask; larger ones are coarsened."""

MAX_CELL = 2.0
"""Largest cell in metres in which rows can be told apart."""

MAX_STEPS = 2**25
"""Maximum number of steps on all lines of a direction: those across a mask of many kilometres have more."""

SAMPLE = 40_000
"""Maximum number of cells from which directions are computed."""

ALONG = 1.0
"""Length of a step along a row in metres: a step with any cell counts once, so that walls weigh no more than trees."""

FINE = 0.05
"""Minimum distance of the fine lines on which rows are looked for, in metres; of the coarse ones it is twice that."""

GAP = 4.0
"""Maximum gap in a row, in metres: posts of tunnels stand 3 m apart."""

FILL = 0.25
"""Minimum share of a row's steps that have a cell."""

MIN_LENGTH, MIN_ROWS = 5.0, 3
"""Minimum length of a row in metres, and minimum number of rows of a field."""

MIN_SCORE, MIN_SHARE = 100.0, 0.15
"""Minimum score of a field (three rows of 20 m have 134), and its minimum share of the best field's."""

CLEAR = 2.0
"""Minimum ratio of the cells of a row to those of the middle of the aisles at its sides, for each step."""

COMMON = 0.2
"""Maximum share of rows that have plants where an aisle crosses them."""

BENDS, BENT = 12, 1.1
"""Number of bends on each side, and minimum ratio of a bent direction's energy to the straight one's."""

TURNED = 1.03
"""Minimum ratio of a turned direction's energy: along slightly bent rows it hardly differs, and aisles across blur."""

BEND, FINE_BEND = 5e-4, 1e-4
"""Steps of the bend in 1/m, coarse and fine: 5e-4 is 0.2 m in the middle of 40 m."""

DIRECTIONS, FINE_DIRECTIONS = 6, 3
"""Number of directions in which rows are looked for, on coarse and on fine lines."""

REGULAR, MISSING = 0.25, 2
"""Tolerated deviation from the distance of rows, as a share of it, and maximum multiple of it at missing rows."""

STRICT = 0.5
"""Minimum share of regular distances of a field whose rows stand in beds; beds of two rows have half."""

BED = 6.0
"""Maximum distance between beds, as a multiple of that of their rows."""

FINER = 0.4
"""Minimum score of rows, as a share of that of thicker ones that they divide: the thick ones are beds."""

MIN_CONTRAST = 0.35
"""Minimum contrast between rows and aisles; scattered cells have 0."""

SIMILAR, BESIDE = 0.4, 0.5
"""Minimum ratio of a row's length to the median, and minimum share of a row that lies beside its neighbour."""

FLANK = 1.0
"""Maximum distance of lines of one row in metres: the flank of a crown is not a row of its own."""

VALLEY = 0.5
"""Maximum ratio of the cells between two rows to those of the rows: more, and they are one thick row."""

MAX_SPACING = 15.0
"""Maximum distance of rows in metres."""


@dataclass(frozen=True, slots=True)
class Row:
    """Row at a distance v across the rows' direction, from low to high along it, in metres.

    fill: share of its length that has plants, up to 1. width: of its plants, in metres. pieces: number of lines in
    which it is drawn.
    """

    v: float
    low: float
    high: float
    fill: float = 1.0
    width: float = 0.0
    pieces: int = 1

    @property
    def length(self) -> float:
        """Length in metres."""
        return self.high - self.low


@dataclass(frozen=True, slots=True)
class Course:
    """Direction of rows: yaw at u = middle; from there they bend aside by bend (1/m) times the distance's square."""

    yaw: float
    bend: float = 0.0
    middle: float = 0.0

    def turned(self, xy: Array) -> tuple[Array, Array]:
        """Return positions [n, 2] in local metres as distances along (u) and across (v) the rows."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        u = c * xy[:, 0] + s * xy[:, 1]
        v = c * xy[:, 1] - s * xy[:, 0]
        return u, v - self.bend * (u - self.middle) ** 2 if self.bend else v


@dataclass(frozen=True, slots=True)
class RowField:
    """Field of parallel rows.

    Attributes:
        yaw: direction of the rows in radians from the local x axis, see ``half_turn``.
        rows: in the order of v.
        regular: share of the distances of rows that are regular.
        score: support of the field, for comparing fields.
        bend, middle: of bent rows, see ``Course``.
    """

    yaw: float
    rows: tuple[Row, ...]
    regular: float = 1.0
    score: float = 0.0
    bend: float = 0.0
    middle: float = 0.0

    @property
    def course(self) -> Course:
        """Direction of the rows."""
        return Course(self.yaw, self.bend, self.middle)

    @property
    def spacing(self) -> float:
        """Median distance of rows in metres."""
        return float(np.median(np.diff([row.v for row in self.rows])))

    def to_local(self, u: float, v: float) -> tuple[float, float]:
        """Return a position along and across the rows in local metres."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        v += self.bend * (u - self.middle) ** 2
        return round(c * u - s * v, 6), round(s * u + c * v, 6)

    def line(self, row: Row, step: float = 2.0) -> list[tuple[float, float]]:
        """Return a row's line in local metres: its ends, and positions a step apart if it is bent."""
        count = max(1, math.ceil(row.length / step)) if self.bend else 1
        return [self.to_local(row.low + row.length * k / count, row.v) for k in range(count + 1)]


def half_turn(yaw: float) -> float:
    """Return a line's direction from -pi/4 to 3 pi/4: rows are then numbered from south to north, or east to west."""
    return (yaw + math.pi / 4) % math.pi - math.pi / 4


def find_fields(
    mask: NDArray[np.bool_], size: float, left: float, bottom: float, yaw: float = 0.0, limit: int = 8
) -> list[RowField]:
    """Return the fields of rows in a mask [h, w], row 0 at the bottom, the best first.

    size: metres of a cell. left, bottom: local metres of its lower left corner. yaw: rotation of the mask around that
    corner in radians. limit: maximum number of fields.
    """
    corner = np.array([left, bottom])
    filled, crossed = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(filled):
        return []
    mask = mask[filled[0] : filled[-1] + 1, crossed[0] : crossed[-1] + 1]
    left, bottom = left + int(crossed[0]) * size, bottom + int(filled[0]) * size
    mask, size = _coarse(mask, size)
    if size > MAX_CELL:
        return []
    rows, columns = np.nonzero(mask)
    xy = np.column_stack([left + (columns + 0.5) * size, bottom + (rows + 0.5) * size])
    if yaw:
        c, s = math.cos(yaw), math.sin(yaw)
        xy = (xy - corner) @ np.array([[c, s], [-s, c]]) + corner
    out: list[RowField] = []
    while len(xy) >= 2 * MIN_ROWS and len(out) < limit:
        best = _finest_field(list(_candidates(xy, size)))
        if _score(best) < max(MIN_SCORE, MIN_SHARE * out[0].score if out else 0.0):
            break
        out += best
        for block in best:
            xy = xy[~_covered(block, xy)]
    return out[:limit]


def _finest_field(candidates: list[list[RowField]]) -> list[RowField]:
    """Return the best candidate, or the rows into which its rows divide if they are beds."""
    best = max(candidates, key=_score, default=[])
    if not best:
        return []
    length = sum(row.length for block in best for row in block.rows)
    finer = [
        blocks
        for blocks in candidates
        if _score(blocks) >= FINER * _score(best)
        and blocks[0].spacing <= 0.7 * best[0].spacing
        and sum(row.length for block in blocks for row in block.rows) >= 1.4 * length
    ]
    return max(finer, key=_score, default=best)


def _score(blocks: list[RowField]) -> float:
    return sum(block.score for block in blocks)


def _coarse(mask: NDArray[np.bool_], size: float) -> tuple[NDArray[np.bool_], float]:
    """Return the mask with at most MAX_CELLS cells; a coarse cell is set if any of its own is."""
    step = max(1, math.ceil(math.sqrt(mask.size / MAX_CELLS)))
    if step == 1:
        return mask, size
    high, wide = (math.ceil(n / step) * step for n in mask.shape)
    padded = np.zeros((high, wide), bool)
    padded[: mask.shape[0], : mask.shape[1]] = mask
    return np.asarray(padded.reshape(high // step, step, wide // step, step).any(axis=(1, 3))), size * step


def _energy(xy: Array, course: Course, across: float) -> float:
    """Return how unevenly the lines of a direction hold the cells: squared deviation of their numbers of steps."""
    u, v = course.turned(xy)
    i = np.floor((u - u.min()) / ALONG).astype(np.int64)
    j = np.floor((v - v.min()) / across).astype(np.int64)
    steps, lines = int(i.max()) + 1, int(j.max()) + 1
    cells = j * steps + i
    if steps * lines <= MAX_CELLS:
        full = np.zeros(steps * lines, bool)
        full[cells] = True
        counts = full.reshape(lines, steps).sum(axis=1).astype(np.float64)
    else:
        counts = np.bincount(distinct(cells) // steps).astype(np.float64)
    return float(((counts - counts.mean()) ** 2).sum())


def _directions(xy: Array, size: float) -> list[Course]:
    """Return the directions with the highest energy, refined to a tenth of a degree, and bent where that is higher."""
    few = xy[:: max(1, len(xy) // SAMPLE)]
    across = max(2 * size, 0.2)
    energy = np.array([_energy(few, Course(math.radians(k / 2)), across) for k in range(360)])
    peaks = [k for k in range(360) if energy[k] >= max(energy[k - 1], energy[(k + 1) % 360])]
    out: list[Course] = []
    for k in sorted(peaks, key=lambda k: -energy[k])[:DIRECTIONS]:
        near = [Course(half_turn(math.radians(k / 2 + tenth / 10))) for tenth in range(-5, 6)]
        straight = max(near, key=lambda course: _energy(few, course, across))
        if not out:
            bent = _bent_course(few, straight.yaw, across)
            if _energy(few, bent, across) >= BENT * _energy(few, straight, across):
                straight = bent
        out.append(straight)
    return out


def _bent_course(few: Array, yaw: float, across: float) -> Course:
    """Return the bent direction near a straight one that has the highest energy.

    Slopes shear the rows, so that they stay copies of each other; the direction is varied after that.
    """
    centre = (few.min(axis=0) + few.max(axis=0)) / 2

    def course(turn: float, slope: float, bend: float) -> Course:
        u = math.cos(turn) * float(centre[0]) + math.sin(turn) * float(centre[1])
        return Course(turn, bend, u - slope / (2 * bend))

    part = few[:: max(1, len(few) // (SAMPLE // 4))]
    bends = [k * BEND for k in range(-BENDS, BENDS + 1) if k]
    wide = [(yaw, k / 100, bend) for k in range(-20, 21, 2) for bend in bends]
    best = max(wide, key=lambda one: _energy(part, course(*one), 2 * across))
    for slope, bend, turn in ((0.004, FINE_BEND, 0.02), (0.001, FINE_BEND / 4, 0.005)):
        a, b, c = best
        near = [(a, b + k * slope, c + n * bend) for k in range(-4, 5) for n in range(-4, 5) if c + n * bend]
        a, b, c = max(near, key=lambda one: _energy(few, course(*one), across))
        turned = [(a + k * turn, b - k * turn, c) for k in range(-4, 5)]
        other = max(turned, key=lambda one: _energy(few, course(*one), across))
        gain = _energy(few, course(*other), across) / max(_energy(few, course(a, b, c), across), 1e-9)
        best = other if gain >= TURNED else (a, b, c)
    return course(*best)


def _candidates(xy: Array, size: float) -> Iterator[list[RowField]]:
    """Yield the best field of each likely direction, on coarse lines, and of the likeliest ones on fine lines."""
    directions = _directions(xy, size)
    for across, count in ((max(2 * size, 2 * FINE), DIRECTIONS), (max(size, FINE), FINE_DIRECTIONS)):
        for course in directions[:count]:
            yield _best_in(xy, course, across)


def _best_in(xy: Array, course: Course, across: float) -> list[RowField]:
    """Return the blocks of a direction's best field. across: distance of the lines on which rows are looked for, in
    metres.
    """
    lines = _segments(xy, course, across)
    fields = [one for one in (_field(course, chain) for chain in _chains(lines)) if one is not None]
    if not fields:
        return []
    u, v = course.turned(xy)
    order = np.argsort(v, kind="stable")
    u, v = u[order], v[order]
    divided = [_blocks(one, u, v) for one in fields]
    scored = [
        [replace(one, score=one.score * _emptiness(one, xy) * _contrast(one, xy, across)) for one in blocks]
        for blocks in divided
    ]
    best = max(scored, key=_score)
    return [one for one in best if one.score > 0]


def _blocks(field: RowField, u: Array, v: Array) -> list[RowField]:
    """Return a field as far as its rows stand out, divided where aisles cross them. u, v: cells, in the order of v."""
    low = min(row.low for row in field.rows)
    steps = int((max(row.high for row in field.rows) - low) / ALONG) + 1
    distances = np.diff([row.v for row in field.rows])
    near = np.minimum(np.append(distances, np.inf), np.insert(distances, 0, np.inf))
    clear = np.zeros((len(near), steps), bool)
    for k, (row, beside) in enumerate(zip(field.rows, near.tolist(), strict=True)):
        half = min(max(row.width / 2, beside / 8), beside / 4)
        inside, left, right = (
            _density(u, v, centre, half if centre == row.v else beside / 8, low, steps)
            for centre in (row.v, row.v - beside / 2, row.v + beside / 2)
        )
        clear[k] = (inside > 0) & (inside >= CLEAR * np.maximum(left, right))
    out = []
    support = sum(row.fill * row.length for row in field.rows) * min(1.0, (len(field.rows) - 1) / 4)
    for first, last in _ranges_between_crossings(clear):
        rows = []
        for row, beside, inside in zip(field.rows, near.tolist(), clear, strict=True):
            shorter = _shortened_row(row, beside, np.flatnonzero(inside[first:last]) + first, low, u, v)
            rows += [shorter] if shorter is not None else []
        typical = float(np.median([row.length for row in rows])) if rows else 0.0
        rows = [row for row in rows if row.length >= SIMILAR * typical]
        if len(rows) >= MIN_ROWS and _same_distances(rows, distances):
            kept = sum(row.fill * row.length for row in rows) * min(1.0, (len(rows) - 1) / 4)
            out.append(replace(field, rows=tuple(rows), score=field.score * kept / support))
    return out


def _same_distances(rows: list[Row], distances: Array) -> bool:
    """Return whether a part of a field has the field's distances: walls that go on beyond an aisle across it do not."""
    ratio = np.diff([row.v for row in rows])[:, None] / distances[None]
    return bool((np.abs(ratio - 1.0) <= REGULAR).any(axis=1).mean() >= STRICT)


def _density(u: Array, v: Array, centre: float, half: float, low: float, steps: int) -> Array:
    """Return the number of cells per metre across in a strip along the rows, for each step."""
    start, stop = np.searchsorted(v, [centre - half, centre + half])
    i = np.floor((u[start:stop] - low) / ALONG).astype(np.int64)
    return np.bincount(i[(i >= 0) & (i < steps)], minlength=steps) / (2 * half)


def _ranges_between_crossings(clear: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the ranges of steps between aisles across the rows. clear: bool [rows, steps], where plants stand out."""
    number = np.arange(clear.shape[1])
    filled = [np.flatnonzero(one) for one in clear if one.any()]
    if not filled:
        return []
    inside = sum(((number >= one[0]) & (number <= one[-1])).astype(np.int64) for one in filled)
    gaps = np.concatenate([np.diff(one) for one in filled] + [np.ones(1, np.int64)])
    usual = float(np.percentile(gaps, 90))
    empty = clear.sum(axis=0) <= COMMON * inside
    cuts = [0]
    for first, last in _runs(empty):
        if last - first >= max(2.0, 1.5 * usual - 1.0):
            cuts += [first, last]
    return list(itertools.pairwise([*cuts, clear.shape[1]]))[::2]


def _shortened_row(row: Row, beside: float, steps: NDArray[np.int64], low: float, u: Array, v: Array) -> Row | None:
    """Return a row along the longest run of steps where it stands out, None if that is short."""
    if not len(steps):
        return None
    run = max(np.split(steps, np.flatnonzero(np.diff(steps) * ALONG > GAP) + 1), key=lambda part: (len(part), -part[0]))
    start, stop = np.searchsorted(v, [row.v - 0.4 * beside, row.v + 0.4 * beside])
    i = np.floor((u[start:stop] - low) / ALONG).astype(np.int64)
    members = np.isin(i, run)
    along, across = u[start:stop][members], v[start:stop][members]
    if not len(along) or float(np.ptp(along)) < MIN_LENGTH:
        return None
    fill = len(run) * ALONG / max(float(np.ptp(along)), ALONG)
    if fill < FILL:
        return None
    return Row(float(across.mean()), float(along.min()), float(along.max()), min(1.0, fill), row.width)


def _contrast(field: RowField, xy: Array, across: float) -> float:
    """Return how much more of a field's cells its rows hold than of its area, from 0 to 1; 0 below MIN_CONTRAST."""
    u, v = field.course.turned(xy)
    low, high = min(row.low for row in field.rows), max(row.high for row in field.rows)
    inside = (u >= low) & (u <= high) & (v >= field.rows[0].v) & (v <= field.rows[-1].v)
    lines = np.array([row.v for row in field.rows])
    half = np.array([max(row.width / 2 + across, field.spacing / 4) for row in field.rows])
    nearest = np.abs(v[inside][:, None] - lines[None]) <= half[None]
    share = float(nearest.any(axis=1).mean()) if inside.any() else 0.0
    area = min(1.0, float(2 * half[:-1].sum()) / max(float(lines[-1] - lines[0]), 1e-9))
    contrast = (share - area) / max(1.0 - area, 1e-9)
    return contrast if contrast >= MIN_CONTRAST else 0.0


def _emptiness(field: RowField, xy: Array) -> float:
    """Return the share of the aisles' steps in whose middle quarter nothing is, to the second power."""
    u, v = field.course.turned(xy)
    full = total = 0
    for a, b in itertools.pairwise(field.rows):
        low, high = max(a.low, b.low), min(a.high, b.high)
        edge = (b.v - a.v) * 3 / 8
        inside = (v > a.v + edge) & (v < b.v - edge) & (u > low) & (u < high)
        full += len(distinct(np.floor((u[inside] - low) / ALONG)))
        total += max(1, int((high - low) / ALONG))
    return (1.0 - min(full / total, 1.0)) ** 2


def _segments(xy: Array, course: Course, across: float) -> list[Row]:
    """Return the segments along a direction, each the strongest of its neighbourhood, in the order of v."""
    u, v = course.turned(xy)
    low_u, low_v = float(u.min()), float(v.min())
    i = np.floor((u - low_u) / ALONG).astype(np.int64)
    j = np.floor((v - low_v) / across).astype(np.int64)
    if (int(j.max()) + 3) * (int(i.max()) + 1) > MAX_STEPS:
        return []
    weight = np.zeros((int(j.max()) + 3, int(i.max()) + 1))
    np.add.at(weight, (j + 1, i), 1.0)
    steps = weight > 0
    # three bins together: a row is not exactly on one line
    steps[1:-1] |= steps[:-2] | steps[2:]
    candidates: list[tuple[float, float, int, int, int]] = []
    for line in np.flatnonzero(steps.sum(axis=1) * ALONG >= FILL * MIN_LENGTH):
        filled = np.flatnonzero(steps[line])
        for run in np.split(filled, np.flatnonzero(np.diff(filled) * ALONG > GAP) + 1):
            length = (run[-1] - run[0] + 1) * ALONG
            if length >= MIN_LENGTH and len(run) * ALONG >= FILL * length:
                around = weight[line - 1 : line + 2, run[0] : run[-1] + 1].sum(axis=1)
                mass = float(around.sum())
                # the lines beside a thin row hold as much in their three bins as its own
                support = len(run) + mass / (1 + mass)
                candidates.append((support, float(around[1]), int(line), int(run[0]), int(run[-1])))
    lines = _joined(_strongest(candidates), weight > 0, max(6, round(FLANK / across)))
    order = np.argsort(v, kind="stable")
    out = []
    for top, below, first, last in lines:
        start, stop = np.searchsorted(v[order], [low_v + (top - 1.5) * across, low_v + (below + 0.5) * across])
        members = order[start:stop]
        members = members[(u[members] >= low_u + first * ALONG) & (u[members] < low_u + (last + 1) * ALONG)]
        if len(members) and float(np.ptp(u[members])) >= MIN_LENGTH:
            low, high = float(u[members].min()), float(u[members].max())
            fill = len(distinct(i[members])) * ALONG / (high - low)
            out.append(Row(float(v[members].mean()), low, high, min(1.0, fill), (below - top + 1) * across))
    return sorted(out, key=lambda row: row.v)


def _strongest(candidates: list[tuple[float, float, int, int, int]]) -> list[tuple[int, int, int]]:
    """Return (line, first, last) of the segments beside which there is no stronger one, in the order of lines."""
    taken: list[tuple[int, int, int]] = []
    for _, _, line, first, last in sorted(candidates, reverse=True):
        if not any(abs(line - k) <= 2 and min(last, b) >= max(first, a) for k, a, b in taken):
            taken.append((line, first, last))
    return sorted(taken)


def _joined(lines: list[tuple[int, int, int]], full: NDArray[np.bool_], reach: int) -> list[tuple[int, int, int, int]]:
    """Join segments of one thick row: crowns are several lines wide, and no line between is empty.

    Returns (first line, last line, first step, last step). full: bool [lines, steps]. reach: maximum number of
    lines from one to the next.
    """
    groups: list[tuple[int, int, int, int]] = []
    for line, first, last in lines:
        one, apart = (line, line, first, last), []
        # a line may join several: the flanks of a row's halves, on both sides of an aisle that crosses it
        for top, below, a, b in groups:
            shared = min(last, b) - max(first, a) + 1
            joins = line - below <= reach and shared >= BESIDE * min(last - first + 1, b - a + 1)
            if joins:
                part = full[below - 1 : line + 2, max(first, a) : min(last, b) + 1].mean(axis=1)
                joins = bool(part[2:-2].min(initial=1.0) >= VALLEY * min(part[:3].max(), part[-3:].max()))
            if joins:
                one = (min(top, one[0]), line, min(a, one[2]), max(b, one[3]))
            else:
                apart.append((top, below, a, b))
        groups = [*apart, one]
    return groups


def _beside(a: Row, b: Row) -> float:
    """Return the share of the shorter row that lies beside the other one."""
    return max(0.0, min(a.high, b.high) - max(a.low, b.low)) / max(min(a.length, b.length), 1e-9)


def _chains(rows: list[Row]) -> list[list[Row]]:
    """Return sequences of rows side by side."""
    chains: list[list[Row]] = []
    for row in rows:
        near = [c for c in chains if row.v - c[-1].v <= MAX_SPACING and _beside(row, c[-1]) >= BESIDE]
        if near:
            max(near, key=lambda c: min(row.high, c[-1].high) - max(row.low, c[-1].low)).append(row)
        else:
            chains.append([row])
    return [chain for chain in chains if len(chain) >= MIN_ROWS]


def _field(course: Course, chain: list[Row]) -> RowField | None:
    """Return the most regular part of a sequence of rows as a field, or None."""
    length = float(np.median([row.length for row in chain]))
    chain = [row for row in chain if row.length >= SIMILAR * length]
    if len(chain) < MIN_ROWS:
        return None
    best: RowField | None = None
    distances = np.diff([row.v for row in chain])
    for spacing in np.unique(np.round(distances, 2)):
        if spacing <= 0:
            continue
        ratio = distances / spacing
        near = np.abs(ratio - np.clip(np.round(ratio), 1, MISSING)) <= REGULAR * np.clip(np.round(ratio), 1, MISSING)
        once = np.abs(ratio - 1.0) <= REGULAR
        wider = ratio[(ratio > 1 + REGULAR) & (ratio <= BED)]
        between = float(np.median(wider)) if len(wider) else 1.0
        in_beds = near | (np.abs(ratio - between) <= REGULAR * between)
        for fits, factor in ((near, 1.0), (in_beds, 0.7)):
            for part in _runs(fits):
                rows = chain[part[0] : part[1] + 1]
                regular = float(once[part[0] : part[1]].mean())
                if len(rows) < MIN_ROWS or (factor < 1.0 and regular < STRICT):
                    continue
                support = sum(row.fill * row.length for row in rows) * math.sqrt(length)
                score = support * factor * regular * min(1.0, (len(rows) - 1) / 4)
                if best is None or score > best.score:
                    best = RowField(course.yaw, tuple(rows), regular, score, course.bend, course.middle)
    return best


def _runs(fits: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the runs of true values, as (first, one past the last)."""
    padded = np.concatenate([[False], fits, [False]])
    change = np.flatnonzero(padded[1:] != padded[:-1])
    return [(int(a), int(b)) for a, b in zip(change[::2], change[1::2], strict=True)]


def _covered(field: RowField, xy: Array) -> NDArray[np.bool_]:
    """Return which positions lie within a field."""
    u, v = field.course.turned(xy)
    margin = field.spacing / 2
    inside = (v >= field.rows[0].v - margin) & (v <= field.rows[-1].v + margin)
    low, high = min(row.low for row in field.rows), max(row.high for row in field.rows)
    return np.asarray(inside & (u >= low - ALONG) & (u <= high + ALONG))

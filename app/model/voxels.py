"""Voxels: named 3-D occupancy as the leaves of an octree of depth 16, as in OctoMap.

A leaf's **code** at its depth d has d groups of three bits, the octant on the way from the root down, x in the lowest
bit of each. Its **place** is the code of its first smallest voxel: code << 3·(16 - d). Leaves are in ascending order of
place, which is also the order of a depth-first traversal. Frame: local; the tree is centred on the origin, so voxel v
of an axis spans (v - 32768 … v - 32767) · resolution metres.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.errors import Invalid

DEPTH = 16
"""Number of levels of the tree: 65536 smallest voxels along each axis, centred on the local origin."""

HALF = 2 ** (DEPTH - 1)
"""Number of smallest voxels between the tree's edge and its middle."""

UNSET = 255
"""Colour that means "no colour": OctoMap's convention."""

LOG_ODDS = (np.float32(math.log(0.1192 / (1 - 0.1192))), np.float32(math.log(0.971 / (1 - 0.971))))
"""Log-odds of free and occupied voxels without measured values: OctoMap's clamping thresholds."""

Box3 = tuple[float, float, float, float, float, float]
"""A box: min x, min y, min z, max x, max y, max z in metres."""

Codes = NDArray[np.uint64]


@dataclass(frozen=True, slots=True, eq=False)
class VoxelMap:
    """n leaves in ascending order of their place; none is inside another.

    Attributes:
        resolution: side of the smallest voxel in metres.
        depth: uint8 [n], 1…16 (16 = smallest).
        code: uint64 [n], the Morton code at that depth.
        log_odds: float32 [n], finite, ≥ 0 occupied.
        colour: uint8 [n, 3] red, green, blue, or None.
        binary: whether the source distinguishes only free and occupied (a ``.bt``).
        properties: further data of the source, by format.
    """

    resolution: float
    depth: NDArray[np.uint8]
    code: Codes
    log_odds: NDArray[np.float32]
    colour: NDArray[np.uint8] | None = None
    binary: bool = True
    properties: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not (math.isfinite(self.resolution) and 1e-6 <= self.resolution <= 1e4):
            raise Invalid(f"a voxel map's resolution must be between 1e-6 and 1e4 metres, got {self.resolution!r}")
        n = len(self.depth)
        columns: tuple[tuple[str, NDArray[Any], Any], ...] = (
            ("depth", self.depth, np.uint8),
            ("code", self.code, np.uint64),
            ("log_odds", self.log_odds, np.float32),
        )
        for name, column, dtype in columns:
            if column.dtype != dtype or column.shape != (n,):
                raise ValueError(f"{name} must be {np.dtype(dtype)} [{n}], got {column.dtype} {column.shape}")
            column.flags.writeable = False
        if self.colour is not None:
            if self.colour.dtype != np.uint8 or self.colour.shape != (n, 3):
                raise ValueError(f"colour must be uint8 [{n}, 3], got {self.colour.dtype} {self.colour.shape}")
            self.colour.flags.writeable = False
        if not n:
            return
        if int(self.depth.min()) < 1 or int(self.depth.max()) > DEPTH:
            raise Invalid(f"voxel depths must be 1 to {DEPTH}")
        if not bool(np.isfinite(self.log_odds).all()):
            raise Invalid("voxel log-odds must be finite")
        up = _bits_below(self.depth)
        start = self.code << up
        if bool((start >> up != self.code).any()) or int(start.max()) >= 1 << 3 * DEPTH:
            raise Invalid("a voxel's code is outside the tree")
        end = start + (np.uint64(1) << up)
        if bool((start[1:] < end[:-1]).any()):
            raise Invalid("voxels must be in ascending order of their place, and none inside another")

    def __len__(self) -> int:
        return len(self.depth)

    @property
    def place(self) -> Codes:
        """Return uint64 [n]: the code of each leaf's first smallest voxel, ascending."""
        return self.code << _bits_below(self.depth)

    @property
    def occupied(self) -> NDArray[np.bool_]:
        """Return bool [n]: log-odds of 0 and more are occupied, others free; space without a leaf is unknown."""
        return self.log_odds >= 0

    def axis(self, k: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the first and end (exclusive) smallest voxel of each leaf along axis k (0 x, 1 y, 2 z).

        Counted from the origin, int64 [n] each; times the resolution in metres.
        """
        up = DEPTH - self.depth.astype(np.int64)
        low = (gather(self.code >> np.uint64(k)).astype(np.int64) << up) - HALF
        return low, low + (np.int64(1) << up)

    def bounds(self) -> Box3 | None:
        """Return the box around all leaves, metres; None if there are none."""
        if not len(self):
            return None
        sides = [(low.min(), high.max()) for low, high in map(self.axis, range(3))]
        x, y, z = [(round(int(low) * self.resolution, 9), round(int(high) * self.resolution, 9)) for low, high in sides]
        return x[0], y[0], z[0], x[1], y[1], z[1]

    def voxel_counts(self) -> dict[str, int]:
        """Return ``{occupied, free}`` in smallest voxels, independent of how leaves were merged."""
        volume = np.int64(1) << _bits_below(self.depth).astype(np.int64)
        occupied = int(volume[self.occupied].sum())
        return {"occupied": occupied, "free": int(volume.sum()) - occupied}

    def leaf_counts(self) -> dict[str, int]:
        """Return ``{occupied, free}`` in leaves."""
        occupied = int(np.count_nonzero(self.occupied))
        return {"occupied": occupied, "free": len(self) - occupied}


def gather(code: Codes) -> Codes:
    """Compact every third bit, from the lowest: one axis of Morton codes, uint64 [n]."""
    out = code & np.uint64(0x1249249249249249)
    for shift, mask in (
        (2, 0x10C30C30C30C30C3),
        (4, 0x100F00F00F00F00F),
        (8, 0x1F0000FF0000FF),
        (16, 0x1F00000000FFFF),
        (32, 0x1FFFFF),
    ):
        out = (out | (out >> np.uint64(shift))) & np.uint64(mask)
    return out


def spread(axis: Codes) -> Codes:
    """Spread the bits of numbers below 2^21: two zero bits between one and the next (reverse of ``compact``)."""
    out = axis & np.uint64(0x1FFFFF)
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        out = (out | (out << np.uint64(shift))) & np.uint64(mask)
    return out


def morton(x: NDArray[np.int64], y: NDArray[np.int64], z: NDArray[np.int64]) -> Codes:
    """Return codes at depth 16 of smallest voxels counted from the origin, -32768…32767: uint64 [n]."""
    code = np.zeros(np.shape(x), np.uint64)
    for k, axis in enumerate((x, y, z)):
        code |= spread((axis + HALF).astype(np.uint64)) << np.uint64(k)
    return code


def expand_leaves(voxels: VoxelMap, mask: NDArray[np.bool_]) -> tuple[Codes, NDArray[np.intp]]:
    """Return all smallest voxels of some leaves: their codes at depth 16, ascending, uint64 [m], and their leaf.

    mask: bool [n]. The caller bounds m (``voxel_counts``): a leaf at depth 1 has 2^45 of them.
    """
    rows = np.flatnonzero(mask)
    size = np.int64(1) << _bits_below(voxels.depth[rows]).astype(np.int64)
    total = int(size.sum())
    within = np.arange(total, dtype=np.int64) - np.repeat(np.cumsum(size) - size, size)
    leaf = np.repeat(rows, size)
    return voxels.place[leaf] + within.astype(np.uint64), leaf


def prune(voxels: VoxelMap, deepest: int = DEPTH) -> VoxelMap:
    """Merge eight sibling leaves of equal log-odds into one, from ``deepest`` upwards, as OctoMap prunes.

    It stops at the first level without a merge, never makes the root a leaf, and ignores colours: a merged leaf gets
    the mean of the set ones, unless the first is not set. Source: OcTreeBaseImpl::prune, ColorOcTree::pruneNode.
    """
    depth, code, odds = voxels.depth.copy(), voxels.code.copy(), voxels.log_odds
    colour = None if voxels.colour is None else voxels.colour.copy()
    changed = False
    for d in range(deepest, 1, -1):
        first = np.flatnonzero(depth == d)
        first = first[(code[first] & np.uint64(7)) == 0]
        first = first[first + 7 < len(depth)]
        for k in range(1, 8):
            same = (depth[first + k] == d) & (odds[first + k] == odds[first])
            first = first[same]
        # disjoint leaves of one depth, eight in a row and the first an octant 0, are siblings if the last is
        first = first[code[first + 7] == code[first] + np.uint64(7)]
        if not len(first):
            break
        changed = True
        code[first] >>= np.uint64(3)
        depth[first] = d - 1
        if colour is not None:
            rows = colour[first[:, None] + np.arange(8)]
            mean = _mean_colour(rows.reshape(-1, 3), np.arange(0, 8 * len(first), 8))
            colour[first] = np.where(_is_set(rows[:, 0])[:, None], mean, UNSET)
        keep = np.ones(len(depth), bool)
        keep[(first[:, None] + np.arange(1, 8)).ravel()] = False
        depth, code, odds = depth[keep], code[keep], odds[keep]
        colour = None if colour is None else colour[keep]
    return replace(voxels, depth=depth, code=code, log_odds=odds, colour=colour) if changed else voxels


def coarser(voxels: VoxelMap, depth: int) -> VoxelMap:
    """Merge leaves below ``depth`` (1…16) into their ancestors of that depth, with OctoMap's values of inner nodes.

    These are the highest log-odds below (no obstacle is lost; unknown counts least), and the mean of the set colours,
    level by level.
    """
    depths, code, odds, colour = voxels.depth, voxels.code, voxels.log_odds, voxels.colour
    if not len(voxels) or int(depths.max()) <= depth:
        return voxels
    depths, code, odds = depths.copy(), code.copy(), odds.copy()
    colour = None if colour is None else colour.copy()
    for d in range(DEPTH, depth, -1):
        lower = np.flatnonzero(depths == d)
        if not len(lower):
            continue
        parents = code[lower] >> np.uint64(3)
        start = _starts(parents)
        first = lower[start]
        odds[first] = np.maximum.reduceat(odds[lower], start)
        if colour is not None:
            colour[first] = _mean_colour(colour[lower], start)
        code[first] = parents[start]
        keep = np.ones(len(depths), bool)
        keep[lower] = False
        keep[first] = True
        depths[first] = d - 1
        depths, code, odds = depths[keep], code[keep], odds[keep]
        colour = None if colour is None else colour[keep]
    return replace(voxels, depth=depths, code=code, log_odds=odds, colour=colour)


def cut(voxels: VoxelMap, box: Box3, limit: int = 2**24) -> VoxelMap:
    """Return the smallest voxels that intersect a box (metres, local; a touching face does not count).

    Large leaves are cut at the box's faces. Raises Invalid if that would give more than ``limit`` leaves.
    """
    low, high = _voxel_range(box, voxels.resolution)
    depth, code = voxels.depth, voxels.code
    source = np.arange(len(voxels), dtype=np.intp)
    pieces: list[tuple[NDArray[np.uint8], Codes, NDArray[np.intp]]] = []
    total = 0
    while len(code):
        meets, inside = np.ones(len(code), bool), np.ones(len(code), bool)
        up = DEPTH - depth.astype(np.int64)
        for k in range(3):
            start = (gather(code >> np.uint64(k)).astype(np.int64) << up) - HALF
            end = start + (np.int64(1) << up)
            meets &= (start < high[k]) & (end > low[k])
            inside &= (start >= low[k]) & (end <= high[k])
        contained = meets & inside
        pieces.append((depth[contained], code[contained], source[contained]))
        crossed = meets & ~inside
        total += int(np.count_nonzero(contained))
        if total + 8 * int(np.count_nonzero(crossed)) > limit:
            raise Invalid(f"cutting to this box would give more than {limit} voxels: use a smaller box")
        depth = np.repeat(depth[crossed] + np.uint8(1), 8)
        octants = np.tile(np.arange(8, dtype=np.uint64), int(np.count_nonzero(crossed)))
        code = np.repeat(code[crossed] << np.uint64(3), 8) | octants
        source = np.repeat(source[crossed], 8)
    if not pieces:
        return voxels
    depth, code, source = (np.concatenate(columns) for columns in zip(*pieces, strict=True))
    if len(pieces) > 1:
        order = np.argsort(code << _bits_below(depth))
        depth, code, source = depth[order], code[order], source[order]
    colour = None if voxels.colour is None else voxels.colour[source]
    return replace(voxels, depth=depth, code=code, log_odds=voxels.log_odds[source], colour=colour)


def merge_to_parents(
    code: Codes, odds: NDArray[np.float32], colour: NDArray[np.uint8] | None
) -> tuple[NDArray[np.intp], Codes, NDArray[np.float32], NDArray[np.uint8] | None]:
    """Return the parents of nodes of one depth in ascending order: start of their children, code, log-odds and colour.

    Source: OcTreeNode::updateOccupancyChildren, ColorOcTreeNode::updateColorChildren.
    """
    above = code >> np.uint64(3)
    start = _starts(above)
    colours = None if colour is None else _mean_colour(colour, start)
    return start, above[start], np.maximum.reduceat(odds, start), colours


def _bits_below(depth: NDArray[np.uint8]) -> Codes:
    """Return 3·(16 - depth): the shift from a code at that depth to one of the smallest voxels."""
    return (np.uint8(3) * (np.uint8(DEPTH) - depth)).astype(np.uint64)


def _starts(codes: Codes) -> NDArray[np.intp]:
    """Return the start of each run of equal codes."""
    new = np.empty(len(codes), bool)
    new[:1] = True
    np.not_equal(codes[1:], codes[:-1], out=new[1:])
    return np.flatnonzero(new)


def _is_set(colour: NDArray[np.uint8]) -> NDArray[np.bool_]:
    return np.asarray((colour != UNSET).any(axis=1))


def _mean_colour(colour: NDArray[np.uint8], start: NDArray[np.intp]) -> NDArray[np.uint8]:
    """Return the mean of the set colours of each run, rounded down; unset if none is set."""
    given = _is_set(colour)
    total = np.add.reduceat(np.where(given[:, None], colour, 0).astype(np.int64), start, axis=0)
    count = np.add.reduceat(given.astype(np.int64), start)[:, None]
    return np.where(count > 0, total // np.maximum(count, 1), UNSET).astype(np.uint8)


def _voxel_range(box: Box3, resolution: float) -> tuple[list[int], list[int]]:
    """Return the smallest voxels that intersect a box: first and end (exclusive) along each axis, at least one."""
    if not all(map(math.isfinite, box)) or any(box[k] > box[k + 3] for k in range(3)):
        raise Invalid("a box must be min x, min y, min z, max x, max y, max z in metres, minima first")
    low, high = [], []
    for k in range(3):
        a, b = (_snap_to_integer(min(max(v / resolution, -HALF - 1.0), HALF + 1.0)) for v in (box[k], box[k + 3]))
        low.append(math.floor(a))
        high.append(max(math.ceil(b), low[-1] + 1))
    return low, high


def _snap_to_integer(value: float) -> float:
    """Round to a whole number if it is one except for the rounding of a division (0.3 / 0.1)."""
    integer = round(value)
    return float(integer) if abs(value - integer) < 1e-6 else value

"""Movable objects: shift and turn them, detect rows, and put back those that collide."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.model import solids
from app.model.features import Features, features
from app.model.layers import Layers, PartKey

Array = NDArray[np.float64]

ROW = 3
"""Minimum number of objects in a row."""


@dataclass(slots=True)
class Movable:
    """One object, or piece of a grid. at: its centre. body: the ground it covers (metres). row: its row, or -1.

    moved: (dx, dy, turn); None: it never moves. gone: whether it is removed.
    """

    place: tuple[PartKey, int] | int
    at: tuple[float, float]
    body: Any
    row: int = -1
    moved: tuple[float, float, float] | None = (0.0, 0.0, 0.0)
    gone: bool = False

    @property
    def has_changed(self) -> bool:
        return self.gone or (self.moved is not None and any(self.moved))

    def now(self) -> Any:
        """Return the ground that it covers now."""
        return self.body if self.moved is None or not any(self.moved) else move_shape(self.body, self.at, self.moved)


# --- objects ----------------------------------------------------------------------------------------------------------
def move_shape(shape: Any, around: tuple[float, float], by: tuple[float, float, float]) -> Any:
    """Turn a shape around a point and shift it, in whole millimetres; heights stay."""
    dx, dy, turn = by
    c, s = math.cos(turn), math.sin(turn)
    x, y = around

    def placed(at: Array) -> Array:
        u, v = at[:, 0] - x, at[:, 1] - y
        flat = np.stack([x + c * u - s * v + dx, y + s * u + c * v + dy], axis=1)
        return np.asarray(np.concatenate([np.round(flat, 3) + 0.0, at[:, 2:]], axis=1), np.float64)

    return shapely.transform(shape, placed, include_z=bool(shapely.has_z(shape)))


def changed_features(part: Features, things: dict[int, Movable], given: Layers) -> Features:
    """Return a part with its objects at their current positions, without removed ones."""
    metres = part.in_local(given.frame).copy()
    geometry = part.geometry.copy()
    properties = list(part.properties)
    for k, t in things.items():
        if t.gone or t.moved is None:
            continue
        metres[k] = move_shape(metres[k], t.at, t.moved)
        if part.local[k]:
            geometry[k] = metres[k]
        else:
            assert given.frame is not None
            back = given.frame.geometries_to_wgs84(np.array([metres[k]], object))
            geometry[k] = shapely.set_precision(back[0], 1e-12, mode="pointwise")
        object_properties = properties[k]
        if object_properties.get("pose") is not None or object_properties.get("shapes"):
            pose = list(solids.parse_pose(object_properties))
            place = shapely.get_coordinates(move_shape(shapely.Point(pose[:2]), t.at, t.moved))[0].tolist()
            yaw = round(math.remainder(pose[5] + t.moved[2], math.tau), 6) + 0.0
            properties[k] = {**object_properties, "pose": [*place, pose[2], pose[3], pose[4], yaw]}
    stays = np.array([k not in things or not things[k].gone for k in range(len(part))], bool)
    return Features(part.ids, geometry, tuple(properties), part.local.copy(), part.document).select(stays)


def append_rows(before: Features | None, rows: list[tuple[str, Any, dict[str, Any]]]) -> Features:
    """Return new rows with numbers after the existing ones."""
    fresh = features(rows, "local")
    if before is None:
        return fresh
    geometry = np.concatenate([before.geometry, fresh.geometry])
    local = np.concatenate([before.local, fresh.local])
    properties = (*before.properties, *fresh.properties)
    return Features((*before.ids, *fresh.ids), geometry, properties, local, before.document)


def find_rows(at: Array) -> NDArray[np.int64]:
    """Return the row of each of the positions [n, 2], from 0; -1 if it is in none.

    Rows run in the direction in which most objects have their nearest neighbour; a row ends sideways at a gap of more
    than half the median distance to it.
    """
    from scipy.spatial import cKDTree

    out = np.full(len(at), -1, np.int64)
    if len(at) < ROW:
        return out
    away, neighbour = cKDTree(at).query(at, 2)
    apart = away[:, 1]
    mask = apart > 1e-6
    if mask.sum() < ROW:
        return out
    to = at[neighbour[:, 1]] - at
    angle = np.round(np.arctan2(to[:, 1], to[:, 0]) % math.pi, 6)
    bins = np.bincount((angle[mask] / math.pi * 36).astype(np.int64) % 36, minlength=36)
    smooth = bins + np.roll(bins, 1) + np.roll(bins, -1)
    best = int(np.argmax(smooth))
    if smooth[best] < max(ROW, 0.4 * mask.sum()):
        return out
    # the mean of directions that are 180 degrees apart is half the mean of their doubles
    close = mask & (np.abs((angle / math.pi * 36 - best - 0.5 + 18) % 36 - 18) <= 1.5)
    double = 2 * angle[close]
    direction = math.atan2(float(np.sin(double).sum()), float(np.cos(double).sum())) / 2
    across = np.round(-math.sin(direction) * at[:, 0] + math.cos(direction) * at[:, 1], 3)
    gap = max(float(np.median(apart[mask])) / 2, 0.05)
    order = np.argsort(across, kind="stable")
    row = np.empty(len(at), np.int64)
    row[order] = np.concatenate([[0], np.cumsum(np.diff(across[order]) > gap)])
    count = np.bincount(row)
    numbers = np.cumsum(count >= ROW) - 1
    return np.where(count[row] >= ROW, numbers[row], -1)


def separate(things: Sequence[Movable]) -> int:
    """Put back objects that now overlap others and did not before; return their number."""
    present_things = [t for t in things if not t.gone]
    before = np.array([t.body for t in present_things], object)
    put = 0
    while True:
        now = np.array([t.now() for t in present_things], object)
        a, b = shapely.STRtree(now).query(now, predicate="intersects")
        pair = a < b
        a, b = a[pair], b[pair]
        moved = np.array([t.moved is not None and any(t.moved) for t in present_things], bool)
        wrong = (moved[a] | moved[b]) & ~shapely.intersects(before[a], before[b])
        if not wrong.any():
            return put
        for k in np.unique(np.concatenate([a[wrong], b[wrong]])).tolist():
            if moved[k]:
                present_things[k].moved = (0.0, 0.0, 0.0)
                put += 1

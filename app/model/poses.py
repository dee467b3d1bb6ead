"""Poses of objects whose outline a GIS program has moved: solids are placed by the pose alone."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
import shapely

from app.errors import Invalid, Problem

SAME: Final = 1e-3
"""Distance in metres below which a point is where it was: more than the rounding of GIS programs."""

DIGITS: Final = 6
"""Decimals of a pose that was moved, in metres: the last bits of a projection depend on the library."""

DISTORTION: Final = 1e-6
"""Change in size of a shape that is moved in degrees, per metre of its way: that of a move north at 80 degrees."""


def moved_pose(
    before: Any, after: Any, stored: Mapping[str, Any], properties: Mapping[str, Any], tolerance: float = SAME
) -> Mapping[str, Any]:
    """Return the ``pose`` that follows a moved outline; nothing where none has to.

    Args:
        before, after: outlines in local metres.
        stored, properties: the object's former and new properties.
        tolerance: distance in metres below which a point is where it was.

    Raises Invalid if solids would stay at the old place of an outline that was reshaped or turned.
    """
    has_solids = bool(properties.get("shapes"))
    pose: Any = stored.get("pose")
    if properties.get("pose") != pose:
        return {}  # the request itself says where the object is
    if pose is None and has_solids:
        pose = [0.0] * 6
    if not _is_position(pose) or before.is_empty or after.is_empty:
        return {}
    shift = _translation(before, after, tolerance)
    if shift is not None:
        x, y = shift
        if math.hypot(x, y) <= tolerance:
            return {}
        return {"pose": [round(pose[0] + x, DIGITS), round(pose[1] + y, DIGITS), *pose[2:]]}
    if has_solids:
        detail = "the outline of an object with solids can be moved, but not reshaped or turned: change its 'pose'"
        raise Invalid(detail, [Problem("is not the former outline, moved", where="geometry")])
    return {}


def _is_position(pose: Any) -> bool:
    if not isinstance(pose, list | tuple) or len(pose) < 2:
        return False
    return all(isinstance(value, int | float) and not isinstance(value, bool) for value in pose[:2])


def _translation(before: Any, after: Any, tolerance: float) -> tuple[float, float] | None:
    """Return by how many metres east and north a shape was moved; None if it was also changed."""
    both = np.array([before, after], object)
    for one, other in (both, shapely.orient_polygons(both), shapely.normalize(both)):
        old, new = shapely.get_coordinates(one), shapely.get_coordinates(other)
        if old.shape != new.shape:
            return None
        shifts = new - old
        shift = shifts.mean(axis=0)
        size = float(np.hypot(*np.ptp(old, axis=0)))
        distortion = DISTORTION * size * float(np.hypot(*shift))
        if np.hypot(*(shifts - shift).T).max() <= tolerance + distortion:
            return float(shift[0]), float(shift[1])
    return None

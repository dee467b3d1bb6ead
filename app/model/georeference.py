"""Position of local rasters on earth and back: only the affine transform changes, never a pixel."""

from __future__ import annotations

import math

import numpy as np

from app.model.geodesy import LocalFrame
from app.model.imagery import Affine, pixel_positions

Turn = tuple[float, float, float, float]
"""Rotation (p, q, r, s) of coordinates: p·x + q·y and r·x + s·y."""

NANOMETRE = 9
"""Decimals of a position in metres."""

DIGITS = 15
"""Significant digits of a pixel's sides: those that a rotation and back leave unchanged."""


def turn(transform: Affine, matrix: Turn) -> Affine:
    """Return a transform with rotated coordinates."""
    a, b, c, d, e, f = transform
    p, q, r, s = matrix
    return (p * a + q * d, p * b + q * e, p * c + q * f, r * a + s * d, r * b + s * e, r * c + s * f)


def to_earth(transform: Affine, frame: LocalFrame) -> Affine:
    """Convert a transform to local metres into one to ``frame.crs``: turned by the heading."""
    return turn(transform, frame.from_local)


def to_local(transform: Affine, crs: str, size: tuple[int, int], frame: LocalFrame) -> Affine | None:
    """Undo ``to_earth`` if a CRS is that of the frame; None for another one. size: columns and rows."""
    width, height = size
    ends = pixel_positions(transform, np.array([0.0, width, width, 0.0]), np.array([0.0, 0.0, height, height]))
    if not frame.is_same_crs(crs, ends):
        return None
    p, q, r, s = frame.from_local
    if (p, q, r, s) == (1.0, 0.0, 0.0, 1.0):
        return transform
    a, b, c, d, e, f = turn(transform, (p, r, q, s))
    digits = DIGITS - 1 - math.floor(math.log10(max(abs(v) for v in (a, b, d, e))))
    a, b, d, e = (round(v, digits) + 0.0 for v in (a, b, d, e))
    return (a, b, round(c, NANOMETRE) + 0.0, d, e, round(f, NANOMETRE) + 0.0)

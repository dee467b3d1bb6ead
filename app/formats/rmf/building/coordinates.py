"""Building coordinates: conversion from file values to metres or degrees, and back."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from app.formats.rmf.common import Array, raise_unreadable

IMAGE, METRIC, ON_EARTH, MERCATOR = "reference_image", "cartesian_meters", "wgs84", "web_mercator"
SYSTEMS = (IMAGE, METRIC, ON_EARTH, MERCATOR)
DEGREE_SYSTEMS = frozenset({ON_EARTH, MERCATOR})

MIN_SCALE = 1e-9
"""Minimum scale in metres per pixel; its reciprocal is the maximum."""

MAX_FIDUCIALS = 200
"""Maximum number of fiducials that two levels share; all pairs are compared."""

_EARTH_TURN = 180.0 / 128.0


@dataclass(frozen=True, slots=True)
class Transform:
    """Transform from drawing pixels (y up) to local metres: rotate, scale, then translate."""

    scale: float = 1.0
    rotation: float = 0.0
    shift: tuple[float, float] = (0.0, 0.0)

    def apply(self, xy: Array) -> Array:
        """Convert pixels [n, 2] to metres [n, 2]."""
        with np.errstate(all="ignore"):  # non-finite results are rejected later, with the item's name
            return np.asarray((xy @ self._matrix().T) * self.scale + np.array(self.shift), np.float64)

    def invert(self, xy: Array) -> Array:
        """Convert metres [n, 2] to pixels [n, 2]."""
        return np.asarray(((xy - np.array(self.shift)) / self.scale) @ self._matrix(), np.float64)

    def _matrix(self) -> Array:
        c, s = math.cos(self.rotation), math.sin(self.rotation)
        return np.array([[c, -s], [s, c]])

    def as_list(self) -> list[float]:
        """Return the transform as stored in a document: [scale, rotation, x, y]."""
        return [self.scale, self.rotation, *self.shift]

    def is_close(self, other: Transform) -> bool:
        """Check that both transforms map pixels to the same positions, within about a micrometre."""
        moved = max(abs(a - b) for a, b in zip(self.shift, other.shift, strict=True))
        turn = abs(math.remainder(self.rotation - other.rotation, 2 * math.pi))
        return abs(self.scale - other.scale) <= 1e-8 * abs(self.scale) and turn <= 1e-8 and moved <= 1e-6


@dataclass(frozen=True, slots=True)
class Scaling:
    """Inputs of a level's transform: measurements (pixels, metres) and fiducials (name, x, y; y up)."""

    measurements: list[tuple[float, float]]
    fiducials: list[tuple[str, float, float]]


def transforms(levels: Mapping[str, Scaling], reference: str, warn: Callable[[str, str], None]) -> dict[str, Transform]:
    """Compute each level's transform for a building in pixels, as rmf_building_map_tools does.

    warn: called with (problem, location) if the scale cannot be determined.
    """
    scales = [metres / pixels for pixels, metres in levels[reference].measurements if pixels > 0 and metres > 0]
    if len(scales) < len(levels[reference].measurements):
        warn("a measurement has no length; it is ignored", f"levels.{reference}.measurements")
    if not scales:
        warn("no measurement sets the scale; one pixel is read as one metre", f"levels.{reference}.measurements")
    scale = sum(scales) / len(scales) if scales else 1.0
    if not MIN_SCALE <= scale <= 1 / MIN_SCALE:
        raise_unreadable(
            f"invalid scale of {scale:g} metres per pixel: check the distances of the measurements",
            f"levels.{reference}.measurements",
        )
    out = {reference: Transform(scale)}
    for name, level in levels.items():
        if name != reference:
            transform = _fit_fiducials(levels[reference].fiducials, level.fiducials, scale)
            if transform is None:
                problem = "shares fewer than two fiducials with the reference level; one pixel is read as one metre"
                warn(problem, f"levels.{name}.fiducials")
            out[name] = transform or Transform()
    return out


def _fit_fiducials(
    reference: Sequence[tuple[str, float, float]], other: Sequence[tuple[str, float, float]], scale: float
) -> Transform | None:
    """Fit a transform to the pairs of common fiducials.

    The rotation is a circular mean; the relative scale and the translation are means.
    """
    by_name: dict[str, list[tuple[float, float]]] = {}
    for name, x, y in other:
        by_name.setdefault(name, []).append((x, y))
    pairs = ((x, y, *b) for name, x, y in reference for b in by_name.get(name, ()))
    common = np.array(list(islice(pairs, MAX_FIDUCIALS + 1)), np.float64).reshape(-1, 4)
    if len(common) > MAX_FIDUCIALS:
        raise_unreadable(f"two levels have more than {MAX_FIDUCIALS} fiducials in common", "fiducials")
    first, second = np.triu_indices(len(common), 1)
    with np.errstate(all="ignore"):
        step = common[second] - common[first]
        reference_lengths, lengths = np.hypot(step[:, 0], step[:, 1]), np.hypot(step[:, 2], step[:, 3])
        valid = (reference_lengths > 0) & (lengths > 0)
        if not valid.any():
            return None
        step, relative = step[valid], float(np.mean(lengths[valid] / reference_lengths[valid]))
        turn = np.arctan2(step[:, 3], step[:, 2]) - np.arctan2(step[:, 1], step[:, 0])
        rotation = -math.atan2(float(np.sin(turn).sum()), float(np.cos(turn).sum()))
    if not MIN_SCALE <= scale / relative <= 1 / MIN_SCALE:
        raise_unreadable("the fiducials of two levels have no common scale: check their positions", "fiducials")
    turned = Transform(1.0 / relative, rotation).apply(common[:, 2:])
    shift = (common[:, :2] - turned).mean(axis=0) * scale
    return Transform(scale / relative, rotation, (float(shift[0]), float(shift[1])))


def to_canonical(system: str, raw: Array, transform: Transform) -> Array:
    """Convert the file's x and y to local metres, or to longitude and latitude in degrees."""
    if system == IMAGE:
        return transform.apply(raw * np.array([1.0, -1.0]))
    if system == MERCATOR:
        north = np.clip(raw[:, 1] / 128.0 + 1.0, -16.0, 16.0)
        latitude: Array = np.degrees(2.0 * np.arctan(np.exp(np.pi * north)) - np.pi / 2.0)
        return np.asarray(np.column_stack([raw[:, 0] * _EARTH_TURN - 180.0, latitude]), np.float64)
    return raw


def to_file(system: str, at: Array, transform: Transform) -> Array:
    """Reverse ``to_canonical``."""
    if system == IMAGE:
        return np.asarray(transform.invert(at) * np.array([1.0, -1.0]), np.float64)
    if system == MERCATOR:
        north = np.arctanh(np.sin(np.radians(np.clip(at[:, 1], -89.9999, 89.9999))))
        return np.asarray(np.column_stack([at[:, 0] / _EARTH_TURN + 128.0, (north / np.pi - 1.0) * 128.0]), np.float64)
    return at

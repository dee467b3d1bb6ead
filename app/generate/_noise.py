"""Gradient noise in octaves: Perlin's and simplex, in two and three dimensions, on grids of points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

Kind = Literal["perlin", "simplex"]


@dataclass(frozen=True, slots=True)
class Fractal:
    """Noise in octaves: each is ``lacunarity`` times as fine as the one before, and ``persistence`` times as strong.

    feature: approximate distance between hills of the coarsest octave, in the unit of the points (metres).
    """

    kind: Kind = "simplex"
    feature: float = 10.0
    octaves: int = 5
    persistence: float = 0.5
    lacunarity: float = 2.0

    @property
    def total(self) -> float:
        """Sum of the octaves' amplitudes."""
        return float(sum(self.persistence**k for k in range(self.octaves)))


def noise2(x: Array, y: Array, fractal: Fractal, draw: np.random.Generator) -> Array:
    """Return values from -1 to 1 at all points of two axes: float64 [len(y), len(x)]. draw: selects the noise."""
    from app.generate import _kernels_noise as kernels

    kernel = kernels.perlin2 if fractal.kind == "perlin" else kernels.simplex2
    out = np.zeros((len(y), len(x)))
    for scale, strength, (dx, dy, _), table in _octaves(fractal, draw):
        kernel(x * scale + dx, y * scale + dy, table, strength, out)
    return np.clip(out, -1.0, 1.0, out=out)


def noise3(x: Array, y: Array, z: Array, fractal: Fractal, draw: np.random.Generator) -> Array:
    """Return values from -1 to 1 at all points of three axes: float64 [len(z), len(y), len(x)]."""
    from app.generate import _kernels_noise as kernels

    kernel = kernels.perlin3 if fractal.kind == "perlin" else kernels.simplex3
    out = np.zeros((len(z), len(y), len(x)))
    for scale, strength, (dx, dy, dz), table in _octaves(fractal, draw):
        kernel(x * scale + dx, y * scale + dy, z * scale + dz, table, strength, out)
    return np.clip(out, -1.0, 1.0, out=out)


def _octaves(fractal: Fractal, draw: np.random.Generator) -> list[tuple[float, float, list[float], NDArray[np.uint8]]]:
    """Yield (scale, amplitude, offset, permutation) of each octave: none shares its lattice with another."""
    out = []
    for k in range(fractal.octaves):
        order = np.argsort(draw.random(256), kind="stable").astype(np.uint8)
        begin = (draw.random(3) * 256).tolist()
        scale = fractal.lacunarity**k / fractal.feature
        out.append((scale, fractal.persistence**k / fractal.total, begin, np.concatenate([order, order])))
    return out

"""Gradient noise on a grid of points, as native code: Perlin's improved noise and simplex noise in 2-D and 3-D.

Sources: K. Perlin, Improving noise (SIGGRAPH 2002); S. Gustavson, Simplex noise demystified (2005). Only sums, products
and comparisons: the same seed gives the same values on every machine. Each kernel adds ``amplitude`` times the noise,
about -1 to 1, to ``out``. table: uint8 [512], a permutation of 0 to 255, twice.
"""

# numba has its own number types: 64-bit integers and floats, whatever mypy infers from NumPy's.
# mypy: disable-error-code="assignment,return-value,arg-type,no-any-return"

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from app.native import native

U8 = NDArray[np.uint8]
F64 = NDArray[np.float64]

_R = 0.7071067811865476
_X2 = np.array([1.0, _R, 0.0, -_R, -1.0, -_R, 0.0, _R])
_Y2 = np.array([0.0, _R, 1.0, _R, 0.0, -_R, -1.0, -_R])
_X3 = np.array([1.0, -1, 1, -1, 1, -1, 1, -1, 0, 0, 0, 0, 1, -1, 0, 0])
_Y3 = np.array([1.0, 1, -1, -1, 0, 0, 0, 0, 1, -1, 1, -1, 1, 1, -1, -1])
_Z3 = np.array([0.0, 0, 0, 0, 1, 1, -1, -1, 1, 1, -1, -1, 0, 0, 1, -1])
"""Gradients: eight directions in the plane, the edge centres of a cube in space (four of them twice)."""

_SCALE2 = 1.4142135623730951
"""Scale to -1 … 1: noise of unit gradients in the plane reaches half the diagonal of a square."""

_F2, _G2 = 0.3660254037844386, 0.21132486540518713
_F3, _G3 = 1.0 / 3.0, 1.0 / 6.0
_SIMPLEX2, _SIMPLEX3 = 99.2, 32.0
"""Scale of simplex noise to -1 … 1: for unit gradients in the plane, for edge centres in space."""


@native
def _fade(t: float) -> float:
    return t * t * t * (t * (t * 6.0 - 15.0) + 10.0)


@native
def perlin2(x: F64, y: F64, table: U8, amplitude: float, out: F64) -> None:
    """out: float64 [len(y), len(x)]."""
    scale = amplitude * _SCALE2
    for r in range(len(y)):
        fy = math.floor(y[r])
        v = y[r] - fy
        j = np.int64(fy) & 255
        fade_y = _fade(v)
        last = np.int64(-1) << 40
        a = b = c = d = 0
        for k in range(len(x)):
            fx = math.floor(x[k])
            u = x[k] - fx
            cell = np.int64(fx)
            if cell != last:  # points of one square share its corners
                last = cell
                i = cell & 255
                p, q = table[i] + j, table[i + 1] + j
                a, b, c, d = table[p] & 7, table[q] & 7, table[p + 1] & 7, table[q + 1] & 7
            fade_x = _fade(u)
            low = _X2[a] * u + _Y2[a] * v
            low += fade_x * (_X2[b] * (u - 1.0) + _Y2[b] * v - low)
            high = _X2[c] * u + _Y2[c] * (v - 1.0)
            high += fade_x * (_X2[d] * (u - 1.0) + _Y2[d] * (v - 1.0) - high)
            out[r, k] += scale * (low + fade_y * (high - low))


@native
def perlin3(x: F64, y: F64, z: F64, table: U8, amplitude: float, out: F64) -> None:
    """out: float64 [len(z), len(y), len(x)]."""
    hashes = np.zeros(8, np.int64)
    for s in range(len(z)):
        fz = math.floor(z[s])
        w = z[s] - fz
        layer = np.int64(fz) & 255
        fade_z = _fade(w)
        for r in range(len(y)):
            fy = math.floor(y[r])
            v = y[r] - fy
            j = np.int64(fy) & 255
            fade_y = _fade(v)
            last = np.int64(-1) << 40
            for k in range(len(x)):
                fx = math.floor(x[k])
                u = x[k] - fx
                cell = np.int64(fx)
                if cell != last:
                    last = cell
                    i = cell & 255
                    for corner in range(8):
                        one = table[i + (corner & 1)] + j + (corner >> 1 & 1)
                        hashes[corner] = table[table[one & 511] + layer + (corner >> 2)] & 15
                fade_x = _fade(u)
                total = 0.0
                for half in range(2):
                    t = w - half
                    low = _dot3(hashes[4 * half], u, v, t)
                    low += fade_x * (_dot3(hashes[4 * half + 1], u - 1.0, v, t) - low)
                    high = _dot3(hashes[4 * half + 2], u, v - 1.0, t)
                    high += fade_x * (_dot3(hashes[4 * half + 3], u - 1.0, v - 1.0, t) - high)
                    plane = low + fade_y * (high - low)
                    total = plane if half == 0 else total + fade_z * (plane - total)
                out[s, r, k] += amplitude * total


@native
def _dot3(h: int, x: float, y: float, z: float) -> float:
    return _X3[h] * x + _Y3[h] * y + _Z3[h] * z


@native
def simplex2(x: F64, y: F64, table: U8, amplitude: float, out: F64) -> None:
    """out: float64 [len(y), len(x)]."""
    scale = amplitude * _SIMPLEX2
    for r in range(len(y)):
        for k in range(len(x)):
            skew = (x[k] + y[r]) * _F2
            fi, fj = math.floor(x[k] + skew), math.floor(y[r] + skew)
            back = (fi + fj) * _G2
            x0, y0 = x[k] - (fi - back), y[r] - (fj - back)
            di = 1 if x0 > y0 else 0
            i, j = np.int64(fi) & 255, np.int64(fj) & 255
            x1, y1 = x0 - di + _G2, y0 - (1 - di) + _G2
            x2, y2 = x0 - 1.0 + 2.0 * _G2, y0 - 1.0 + 2.0 * _G2
            total = 0.0
            t = 0.5 - x0 * x0 - y0 * y0
            if t > 0.0:
                g = table[table[i] + j] & 7
                total += t * t * t * t * (_X2[g] * x0 + _Y2[g] * y0)
            t = 0.5 - x1 * x1 - y1 * y1
            if t > 0.0:
                g = table[table[i + di] + j + 1 - di] & 7
                total += t * t * t * t * (_X2[g] * x1 + _Y2[g] * y1)
            t = 0.5 - x2 * x2 - y2 * y2
            if t > 0.0:
                g = table[table[i + 1] + j + 1] & 7
                total += t * t * t * t * (_X2[g] * x2 + _Y2[g] * y2)
            out[r, k] += scale * total


@native
def simplex3(x: F64, y: F64, z: F64, table: U8, amplitude: float, out: F64) -> None:
    """out: float64 [len(z), len(y), len(x)]."""
    scale = amplitude * _SIMPLEX3
    for s in range(len(z)):
        for r in range(len(y)):
            for k in range(len(x)):
                skew = (x[k] + y[r] + z[s]) * _F3
                fi, fj, fk = math.floor(x[k] + skew), math.floor(y[r] + skew), math.floor(z[s] + skew)
                back = (fi + fj + fk) * _G3
                x0, y0, z0 = x[k] - (fi - back), y[r] - (fj - back), z[s] - (fk - back)
                # second and third corner: along the largest, then also along the second largest coordinate
                if x0 >= y0:
                    if y0 >= z0:
                        a, b, c, d, e, f = 1, 0, 0, 1, 1, 0
                    elif x0 >= z0:
                        a, b, c, d, e, f = 1, 0, 0, 1, 0, 1
                    else:
                        a, b, c, d, e, f = 0, 0, 1, 1, 0, 1
                elif y0 < z0:
                    a, b, c, d, e, f = 0, 0, 1, 0, 1, 1
                elif x0 < z0:
                    a, b, c, d, e, f = 0, 1, 0, 0, 1, 1
                else:
                    a, b, c, d, e, f = 0, 1, 0, 1, 1, 0
                i, j, m = np.int64(fi) & 255, np.int64(fj) & 255, np.int64(fk) & 255
                total = 0.0
                for corner in range(4):
                    if corner == 0:
                        u, v, w, o, p, q = x0, y0, z0, 0, 0, 0
                    elif corner == 1:
                        u, v, w, o, p, q = x0 - a + _G3, y0 - b + _G3, z0 - c + _G3, a, b, c
                    elif corner == 2:
                        u, v, w, o, p, q = x0 - d + 2 * _G3, y0 - e + 2 * _G3, z0 - f + 2 * _G3, d, e, f
                    else:
                        u, v, w, o, p, q = x0 - 0.5, y0 - 0.5, z0 - 0.5, 1, 1, 1
                    t = 0.6 - u * u - v * v - w * w
                    if t > 0.0:
                        h = table[table[table[i + o] + j + p & 511] + m + q] & 15
                        total += t * t * t * t * _dot3(h, u, v, w)
                out[s, r, k] += scale * total


def compile_all() -> None:
    """Compile all kernels: call each one once on a point."""
    at, table = np.zeros(1), np.zeros(512, np.uint8)
    for flat in (perlin2, simplex2):
        flat(at, at, table, 1.0, np.zeros((1, 1)))
    for deep in (perlin3, simplex3):
        deep(at, at, at, table, 1.0, np.zeros((1, 1, 1)))

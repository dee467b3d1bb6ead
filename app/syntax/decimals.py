"""Numbers as text, the same on every machine: rounded to 1e-9 m or 1e-12 degrees before printing."""

from __future__ import annotations

from collections.abc import Iterable
from io import BytesIO

import numpy as np
from numpy.typing import NDArray

METRES = 9
DEGREES = 12
"""Decimals to round to: a nanometre, and a tenth of a micrometre on the ground."""

_WHOLE = 2.0**53
"""From here on a float has no decimals, and rounding would overflow on the way."""


def number(value: float, decimals: int = METRES) -> str:
    """The shortest text that reads back as the rounded value; always with a point or an exponent, never ``-0.0``."""
    return repr(round(float(value), decimals) + 0.0)


def numbers(values: NDArray[np.float64] | Iterable[float], decimals: int = METRES) -> list[str]:
    """The same for many values at once."""
    exact = np.asarray(values, np.float64)
    rounded = np.round(np.clip(exact, -_WHOLE, _WHOLE), decimals) + 0.0
    large = np.abs(exact) >= _WHOLE
    if large.any():
        rounded[large] = exact[large]
    return list(map(repr, rounded.tolist()))


def encode_pieces(pieces: list[str]) -> bytes:
    """The pieces as UTF-8, one after the other. The list is emptied meanwhile, so that no text is held twice."""
    pieces.reverse()
    out = BytesIO()  # whose content is taken out without a copy
    while pieces:
        out.write(pieces.pop().encode())
    return out.getvalue()

"""Format numbers reproducibly on every machine: rounded to 1e-9 m or 1e-12 degrees before printing."""

from __future__ import annotations

from collections.abc import Iterable
from io import BytesIO

import numpy as np
from numpy.typing import NDArray

METRES = 9
DEGREES = 12
"""Decimals to round metres and degrees to: 1 nm, and 0.1 µm on the ground."""

_WHOLE = 2.0**53
"""Smallest float without decimals: rounding larger ones would overflow."""


def number(value: float, decimals: int = METRES) -> str:
    """Format the shortest text of the rounded value; always with a point or an exponent, never ``-0.0``."""
    return repr(round(float(value), decimals) + 0.0)


def numbers(values: NDArray[np.float64] | Iterable[float], decimals: int = METRES) -> list[str]:
    """Format many values like ``number``."""
    exact = np.asarray(values, np.float64)
    rounded = np.round(np.clip(exact, -_WHOLE, _WHOLE), decimals) + 0.0
    large = np.abs(exact) >= _WHOLE
    if large.any():
        rounded[large] = exact[large]
    return list(map(repr, rounded.tolist()))


def encode_pieces(pieces: list[str]) -> bytes:
    """Encode the pieces as UTF-8 and join them. Empties the list, so that no text is in memory twice."""
    pieces.reverse()
    out = BytesIO()  # getvalue returns its buffer without a copy
    while pieces:
        out.write(pieces.pop().encode())
    return out.getvalue()

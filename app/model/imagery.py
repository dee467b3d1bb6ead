"""Imagery: georeferenced pictures (satellite images, floor plans)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from numpy.typing import NDArray

from app.errors import Invalid


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """Pixels and where they lie.

    pixels: [height, width, bands], row 0 on top. transform: (a, b, c, d, e, f) with x = a·column + b·row + c and
    y = d·column + e·row + f for the outer corner of a pixel. crs: ``local`` (metres in the local frame) or a CRS
    name that PROJ knows (``EPSG:32630``).
    """

    pixels: NDArray[Any]
    transform: tuple[float, float, float, float, float, float]
    crs: str = "local"
    properties: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.pixels.ndim != 3 or 0 in self.pixels.shape:
            raise Invalid(f"a picture needs pixels [height, width, bands], got {self.pixels.shape}")
        if len(self.transform) != 6 or not all(math.isfinite(v) for v in self.transform):
            raise Invalid(f"a picture's transform must be six finite numbers, got {self.transform!r}")
        a, b, _, d, e, _ = self.transform
        if a * e - b * d == 0.0:
            raise Invalid("a picture's transform must not be singular: its pixels would have no area")
        if not self.crs:
            raise Invalid("a picture needs a CRS: local, or a name such as EPSG:32630")
        self.pixels.flags.writeable = False

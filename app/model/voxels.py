"""Voxels: named 3-D occupancy as the leaves of an octree of depth 16, as OctoMap keeps it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.errors import Invalid

DEPTH = 16
"""Levels of the tree: 65536 smallest voxels along each axis, centred on the local origin."""


@dataclass(frozen=True, slots=True, eq=False)
class VoxelMap:
    """n leaves in ascending order of their place.

    resolution: metres an edge of the smallest voxel. depth: uint8 [n], 1…16 (16 = smallest). code: uint64 [n], the
    Morton code at that depth (x lowest bit of each three). log_odds: float32 [n], ≥ 0 occupied. colour: uint8 [n, 3]
    red, green, blue, or None. binary: whether only free and occupied were told apart (a ``.bt``).
    """

    resolution: float
    depth: NDArray[np.uint8]
    code: NDArray[np.uint64]
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
        if n and (int(self.depth.min()) < 1 or int(self.depth.max()) > DEPTH):
            raise Invalid(f"voxel depths must be 1 to {DEPTH}")
        if n and bool((self.code >> (self.depth.astype(np.uint64) * np.uint64(3))).any()):
            raise Invalid("a voxel's code lies outside the tree")
        if not bool(np.isfinite(self.log_odds).all()):
            raise Invalid("voxel log-odds must be finite")

"""Small Gazebo worlds of mesh walls and boxes, for tests."""

from __future__ import annotations

import numpy as np
import shapely

from app.model import solids
from tests.model.test_meshes import stl

CRATE = (
    b"<model name='crate'><static>true</static><pose>1 1 0.5 0 0 0</pose><link name='l'>"
    b"<collision name='c'><geometry><box><size>0.4 0.4 1</size></box></geometry></collision></link></model>"
)
"""Model of one box of 0.4 × 0.4 × 1 m at (1, 1)."""

WALLS = "walls.stl"
"""Mesh file of a house of 6 × 4 m around the origin, its walls 0.2 m thick and 2 m high."""


def walls() -> bytes:
    """Build the closed walls of the house as binary STL."""
    ring = shapely.difference(shapely.box(-3, -2, 3, 2), shapely.box(-2.8, -1.8, 2.8, 1.8))
    return stl(*(tuple(map(tuple, corners)) for corners in np.asarray(solids.extrude(ring, 0.0, 2.0)).tolist()))


def house(mesh: str | None, *models: bytes) -> dict[str, bytes]:
    """Build a world with the house and further models. mesh: name of its mesh file in the upload; None: without."""
    world = (
        b"<sdf version='1.7'><world name='w'><model name='house'><static>true</static><link name='l'>"
        b"<collision name='c'><geometry><mesh><uri>model://house/meshes/walls.stl</uri></mesh></geometry></collision>"
        b"</link></model>" + b"".join(models) + b"</world></sdf>"
    )
    return {"a.world": world, **({f"models/house/meshes/{mesh}": walls()} if mesh else {})}

"""Shapes in a mask, in cells: positions are (x, y) from the corner of cell (0, 0)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Disc:
    """Disc, in cells."""

    x: float
    y: float
    radius: float


@dataclass(frozen=True, slots=True)
class Box:
    """Rectangle in cells: its centre, its longer and its shorter side, and the direction of the longer one."""

    x: float
    y: float
    length: float
    width: float
    yaw: float


@dataclass(frozen=True, slots=True)
class MaskShapes:
    """Shapes found in a mask. areas: polygons (shapely), in cells. specks: number of shapes that were too small."""

    discs: list[Disc]
    boxes: list[Box]
    walls: list[Box]
    areas: list[Any]
    specks: int


@dataclass(frozen=True, slots=True)
class ShapeLimits:
    """Size limits of shapes, in cells.

    Attributes:
        speck: smallest shape.
        disc: widest disc.
        box: longest rectangle.
        wall: widest wall.
        small: length up to which every shape counts as a disc.
        tolerance: maximum distance of straight edges from the cells.
        length: shortest wall.
        gap: widest gap in a wall that is bridged.
        leg: longest leg of a table.
        table: shortest and longest side of a table on four legs; zeros if there are none.
    """

    speck: float
    disc: float
    box: float
    wall: float
    small: float
    tolerance: float
    length: float
    gap: float
    leg: float
    table: tuple[float, float]

"""Convert ``map.yaml`` and its PGM to cells of a nav_msgs/msg/OccupancyGrid, like Nav2's map server.

Source: navigation2, ``nav2_map_server/src/map_io.cpp``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

MAX_CELLS = 2**31
MAX_SIDE = 32767
MODES = ("trinary", "scale", "raw")
UNKNOWN = 255
"""Byte of an unknown cell, -1 as int8."""


class GridError(Exception):
    """Invalid grid, which Nav2's map server would not load either."""


@dataclass(frozen=True)
class Grid:
    """Cells of an occupancy grid.

    Attributes:
        resolution: metres per cell.
        origin: x, y (metres) and yaw (radians) of the lower left corner.
        cells: one byte per cell (255 is -1), row by row from the bottom, x fastest.
    """

    width: int
    height: int
    resolution: float
    origin: tuple[float, float, float]
    cells: bytes


def read_map(path: Path) -> Grid:
    """Read a grid. Raises GridError with the path."""
    try:
        return _read_map(path)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise GridError(f"could not publish {path}: {error}") from None


def _read_map(path: Path) -> Grid:
    import yaml  # python3-yaml is a dependency of ROS 2

    try:
        body: Any = yaml.safe_load(path.read_bytes())
    except yaml.YAMLError as error:
        raise ValueError(f"invalid YAML: {error}") from None
    if not isinstance(body, dict):
        raise TypeError("not a map.yaml")
    mode = str(body.get("mode", "trinary"))
    if mode not in MODES:
        raise ValueError(f"unknown mode {mode[:80]!r}: must be {', '.join(MODES)}")
    resolution = float(body["resolution"])
    x, y, yaw = (float(value) for value in body["origin"])
    if not (resolution > 0 and all(map(math.isfinite, (resolution, x, y, yaw)))):
        raise ValueError("resolution and origin must be finite, and the resolution positive")
    width, height, largest, pixels = read_pgm((path.parent / str(body["image"])).read_bytes())
    table = cell_values(
        mode, float(body["occupied_thresh"]), float(body["free_thresh"]), largest, negate=bool(int(body["negate"]))
    )
    cells = pixels.translate(table)
    rows = (cells[start : start + width] for start in range((height - 1) * width, -1, -width))
    return Grid(width, height, resolution, (x, y, yaw), b"".join(rows))


def cell_values(mode: str, occupied: float, free: float, largest: int, *, negate: bool) -> bytes:
    """Return the cell value of each of 256 grey values. largest: grey value of white."""
    out = bytearray()
    for value in range(256):
        shade = min(value, largest) / largest
        if mode == "raw":  # the pixel is the cell value
            grey = round(shade * 255)
            out.append(grey if grey <= 100 else UNKNOWN)
            continue
        probability = shade if negate else 1.0 - shade
        if probability >= occupied:
            out.append(100)
        elif probability <= free:
            out.append(0)
        elif mode == "trinary":
            out.append(UNKNOWN)
        else:
            out.append(round((probability - free) / (occupied - free) * 100))
    return bytes(out)


def read_pgm(data: bytes) -> tuple[int, int, int, bytes]:
    """Read a PGM, binary (P5) or text (P2), of at most 8 bits.

    Returns width, height, value of white, and pixels row by row from the top. Raises ValueError.
    """
    kind = data[:2]
    if kind not in (b"P5", b"P2"):
        raise ValueError("the image is not a PGM: request occupancy_grid?file_type=pgm")
    numbers, start = _header(data)
    width, height, largest = numbers
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE and width * height <= MAX_CELLS):
        raise ValueError(f"image size {width} × {height} must be from 1 to {MAX_SIDE} on each side")
    if not 0 < largest <= 255:
        raise ValueError(f"the image has {largest + 1} grey values; the limit is 256")
    if kind == b"P5":
        pixels = data[start : start + width * height]
    else:
        words = data[start:].split()
        if any(not word.isdigit() or int(word) > largest for word in words[: width * height]):
            raise ValueError(f"pixels must be numbers from 0 to {largest}")
        pixels = bytes(int(word) for word in words[: width * height])
    if len(pixels) != width * height:
        raise ValueError(f"the image has only {len(pixels)} of {width * height} pixels")
    return width, height, largest, pixels


def _header(data: bytes) -> tuple[tuple[int, int, int], int]:
    """Return the three numbers of the header, which may contain comments, and the offset of the pixels."""
    numbers: list[int] = []
    at = 2
    while len(numbers) < 3:
        while at < len(data) and (data[at : at + 1].isspace() or data[at : at + 1] == b"#"):
            if data[at : at + 1] == b"#":
                end = data.find(b"\n", at)
                at = len(data) if end < 0 else end
            at += 1
        start = at
        while at < len(data) and data[at : at + 1].isdigit():
            at += 1
        if at == start or at - start > 9:
            raise ValueError("the PGM header is truncated or invalid")
        numbers.append(int(data[start:at]))
    return (numbers[0], numbers[1], numbers[2]), at + 1

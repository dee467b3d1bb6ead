"""Encode three ROS 2 messages as CDR like ``rmw_serialize``: version 1, little endian, no padding at the end.

Four bytes contain the encoding (``00 01 00 00``); after them each number is aligned to its size, counted from the end
of these four bytes. A string is its length in bytes including the final NUL, the bytes and the NUL. Source: OMG
DDSI-RTPS §10 and the ``.msg`` files of nav_msgs, map_msgs and std_msgs.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass
from datetime import datetime

HEADER = b"\x00\x01\x00\x00"


@dataclass(frozen=True, slots=True)
class Grid:
    """Content of an OccupancyGrid.

    Attributes:
        resolution: metres per cell.
        origin: (x, y, yaw) of the lower left corner of cell (0, 0), in metres and radians.
        cells: int8, row by row from the bottom: -1 unknown (byte 255), else 0…100.
    """

    width: int
    height: int
    resolution: float
    origin: tuple[float, float, float]
    cells: bytes

    @property
    def frame(self) -> tuple[int, int, float, tuple[float, float, float]]:
        """Size, resolution and origin. An update requires grids with the same frame."""
        return self.width, self.height, self.resolution, self.origin


def occupancy_grid(grid: Grid, stamp: datetime, frame_id: str) -> bytes:
    """Encode ``nav_msgs/msg/OccupancyGrid``. stamp: for the header and ``map_load_time``."""
    x, y, yaw = grid.origin
    writer = _Writer(_header(stamp, frame_id))
    writer.pack("iIfII", *_time(stamp), grid.resolution, grid.width, grid.height)
    writer.pack("7d", x, y, 0.0, 0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2))
    return writer.sequence(grid.cells)


def occupancy_grid_update(
    x: int, y: int, width: int, height: int, cells: bytes, stamp: datetime, frame_id: str
) -> bytes:
    """Encode ``map_msgs/msg/OccupancyGridUpdate``, a rectangle of cells; (x, y): its lower left cell (column, row)."""
    writer = _Writer(_header(stamp, frame_id))
    writer.pack("iiII", x, y, width, height)
    return writer.sequence(cells)


def string(text: str) -> bytes:
    """Encode ``std_msgs/msg/String``."""
    return HEADER + _text(text)


class _Writer:
    def __init__(self, start: bytes) -> None:
        self._data = bytearray(start)

    def pack(self, numbers: str, *values: float) -> None:
        """Append numbers of one size, aligned to it."""
        size = struct.calcsize("<" + numbers[-1])
        self._data += bytes(-(len(self._data) - len(HEADER)) % size) + struct.pack("<" + numbers, *values)

    def sequence(self, items: bytes) -> bytes:
        """Append a byte sequence as the last member and return the message."""
        self.pack("I", len(items))
        return bytes(self._data) + items


def _header(stamp: datetime, frame_id: str) -> bytes:
    return HEADER + struct.pack("<iI", *_time(stamp)) + _text(frame_id)


def _time(stamp: datetime) -> tuple[int, int]:
    seconds = math.floor(stamp.timestamp())
    return seconds, stamp.microsecond * 1000


def _text(text: str) -> bytes:
    data = text.encode() + b"\0"
    return struct.pack("<I", len(data)) + data

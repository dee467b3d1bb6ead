"""Configuration of GDAL for images: single-threaded, in memory, without copies of pixels.

No other module sets it up; ``app.syntax.ogr`` has another GDAL for vectors.
"""

from __future__ import annotations

import contextlib
import ctypes
import io
import logging
import mmap
import sys
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

CACHE = 32 * 2**20
"""Size of GDAL's cache of decoded blocks, in bytes."""

DATA_TYPES = {
    "uint8": "Byte",
    "int8": "Int8",
    "uint16": "UInt16",
    "int16": "Int16",
    "uint32": "UInt32",
    "int32": "Int32",
    "uint64": "UInt64",
    "int64": "Int64",
    "float32": "Float32",
    "float64": "Float64",
}
"""GDAL's pixel types by NumPy's names."""


@contextlib.contextmanager
def gdal(cache: int = CACHE) -> Iterator[Any]:
    """Return rasterio (slow to import) with a small GDAL cache and without access to sidecar files."""
    import rasterio

    logging.getLogger("rasterio").setLevel(logging.CRITICAL)  # errors are raised as exceptions, too
    settings = {
        "GDAL_CACHEMAX": cache,
        "COG_TMP_COMPRESSION": "DEFLATE",  # of overviews until they are in place; LZW makes noise larger than it is
        "GDAL_DISABLE_READDIR_ON_OPEN": "EMPTY_DIR",
        "GDAL_MEM_ENABLE_OPEN": "YES",
        "GDAL_NUM_THREADS": "1",
        "GDAL_PAM_ENABLED": "NO",
        "GDAL_TIFF_INTERNAL_MASK": "YES",
    }
    with rasterio.Env(**settings), warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        yield rasterio


PIECE = 2**24
"""Number of bytes of a finished file that are copied at a time."""


def buffer_bytes(buffer: memoryview) -> bytes:
    """Copy a file that GDAL has created in memory, and free its pages on the way.

    A large file is therefore never in memory twice. The buffer is empty afterwards.
    """
    content = np.frombuffer(buffer, np.uint8)
    free = _free()
    page, start = mmap.PAGESIZE, content.__array_interface__["data"][0]
    out = io.BytesIO()
    for k in range(0, len(content), PIECE):
        out.write(content[k : k + PIECE].data)
        low, high = -(-(start + k) // page) * page, (start + min(k + PIECE, len(content))) // page * page
        if free is not None and k + PIECE <= len(content):
            free(low, high - low)
    return out.getvalue()


def _free() -> Callable[[int, int], Any] | None:
    """Return a function (address, size) that frees the pages of a buffer; None if the system does not support it."""
    call = getattr(ctypes.CDLL(None), "madvise", None) if sys.platform == "linux" else None
    if call is None:
        return None
    call.argtypes = (ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int)
    return lambda at, size: call(at, size, mmap.MADV_DONTNEED)


def native(pixels: NDArray[Any]) -> NDArray[Any]:
    """Return pixels in a form that GDAL can read: without a copy if possible (booleans become 0 and 1)."""
    if pixels.dtype == np.bool_:
        pixels = pixels.view(np.uint8)
    elif pixels.dtype == np.float16:
        pixels = pixels.astype(np.float32)
    if not pixels.dtype.isnative or min(pixels.strides) < 0:
        pixels = np.ascontiguousarray(pixels, pixels.dtype.newbyteorder("="))
    return pixels


def open_memory_dataset(rasterio: Any, pixels: NDArray[Any], bands: int, *, described: bool = False) -> Any:
    """Create a dataset of the first bands of ``native`` pixels [height, width, bands] without a copy.

    The pixels must outlive it. described: it accepts a transform, colours, tags and a mask; the pixels stay read-only.
    """
    height, width, _ = pixels.shape
    row, column, band = pixels.strides
    name = (
        f"MEM:::DATAPOINTER={pixels.__array_interface__['data'][0]},PIXELS={width},LINES={height},BANDS={bands},"
        f"DATATYPE={DATA_TYPES[pixels.dtype.name]},PIXELOFFSET={column},LINEOFFSET={row},BANDOFFSET={band}"
    )
    return rasterio.open(name, "r+" if described else "r", driver="MEM")

"""LAS and LAZ files as point clouds, read and written with laspy and lazrs.

The header is checked against the file's size before anything is allocated. Coordinates are integers times a scale plus
an offset and become float64; dimensions with only zeros are skipped. Source: ASPRS LAS 1.4 R15.
"""

from __future__ import annotations

import io
import math
import re
import struct
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.errors import Invalid, UnreadableFile
from app.formats import ReadContext, WriteContext
from app.formats.clouds.points import AXES, RGB, Cloud, check_count, unreadable_error
from app.model.geodesy import length_units, with_height_unit, with_vertical

MAGIC = b"LASF"
SCALE = 0.001
"""Default step of coordinates, in metres."""

HEADER = struct.Struct("<4s20xBB64x4xHIIBHI")
"""Signature, version, header size, offset to the points, VLRs, point format, bytes a point, points (until 1.3)."""

VLR_BYTES, EVLR_BYTES = 54, 60
LASZIP = b"laszip encoded"
LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
"""Number of layers by item type of points since 1.4: base item, colours, near infrared, waveforms."""

EXTRA_BYTES = 14
"""Item type with one layer per byte."""

FILES = re.compile(r"EXTENSION|PARAMETERFILE|GRIDS", re.IGNORECASE)
"""WKT keywords that make PROJ open files."""

SOFTWARE = "Fleet Map Server"
NO_DATE = slice(90, 94)
"""Creation day and year in the header, set to 0 (unknown): the current date would change the bytes each day."""

GEOGRAPHIC, PROJECTED, PROJECTED_UNITS, VERTICAL, VERTICAL_UNITS = 2048, 3072, 3076, 4096, 4099
"""GeoTIFF keys of a CRS and its units (OGC 19-008r4)."""

USER_DEFINED = 32767
"""Code of a CRS that is defined by further keys."""

UNITS = {9001: 1.0, 9002: 0.3048, 9003: 1200 / 3937}
"""Metres of a unit, by its EPSG code."""

INTEGER_DIMENSIONS = {"intensity": 65535, "classification": 255, "user_data": 255, "point_source_id": 65535}
"""Standard dimensions that take other formats' columns of the same name, with their maximum value."""


def detect(name: str, data: bytes) -> bool:
    """Detect the signature and an existing version."""
    del name
    return data.startswith(MAGIC) and len(data) > 26 and data[24] == 1 and data[25] <= 4


def parse(data: bytes, context: ReadContext) -> Cloud:
    """Parse all points. Raises UnreadableFile or TooLarge."""
    import laspy

    count = _check(data, context)
    with _convert_errors():
        las = laspy.read(io.BytesIO(data), laz_backend=laspy.LazBackend.Lazrs)
    if len(las.points) != count:
        raise unreadable_error(
            f"the header declares {count} points, but the file has {len(las.points)}", where="header"
        )
    return _cloud(las, count, context)


def _check(data: bytes, context: ReadContext) -> int:
    """Check the header against the limits and the file's size; return the number of points."""
    if len(data) < 227:
        raise unreadable_error("the file ends within the header", where="header")
    magic, major, minor, size, start, vlrs, form, record, count = HEADER.unpack_from(data)
    if magic != MAGIC or major != 1 or minor > 4:
        raise unreadable_error(f"unsupported version {magic!r} {major}.{minor}: must be LAS 1.0 to 1.4", where="header")
    need = {3: 235, 4: 375}.get(minor, 227)
    if size < need or start < size or start > len(data):
        raise unreadable_error("the sizes in the header contradict each other", where="header")
    if vlrs * VLR_BYTES > start - size:
        raise unreadable_error(f"{vlrs} variable length records do not fit before the points", where="header")
    evlrs = 0
    if minor == 4:
        first, evlrs, count = struct.unpack_from("<QIQ", data, 235)
        if evlrs and (first > len(data) or evlrs * EVLR_BYTES > len(data) - first):
            raise unreadable_error(f"{evlrs} extended records do not fit after the points", where="header")
    if any(not math.isfinite(v) for v in struct.unpack_from("<6d", data, 131)):
        raise unreadable_error("scales and offsets must be finite numbers", where="header")
    if form & 0x3F > 10:
        raise unreadable_error(f"unknown point format {form & 0x3F}", where="header")
    check_count(count, context)
    if form & 0xC0 == 0:
        if start + count * record > len(data):
            have = len(data) - start
            raise unreadable_error(
                f"{count} points of {record} bytes need {count * record} bytes, but the file has {have}"
            )
    elif count:
        context.limits.check_unpacked(count * record, len(data) - start)
        _check_chunks(data, start, size, vlrs, count, record)
    return int(count)


def _check_chunks(data: bytes, start: int, size: int, vlrs: int, count: int, record: int) -> None:
    """Check the LASzip record and the chunk table of compressed points, whose sizes are allocated as declared."""
    position = size
    for _ in range(vlrs):
        user, number, length = struct.unpack_from("<2x16sHH", data, position)
        position += VLR_BYTES
        if user.rstrip(b"\0") == LASZIP and number == 22204:
            break
        position += length
    else:
        raise unreadable_error("the file is compressed but has no LASzip record", where="header")
    if length < 34 or position + length > start:
        raise unreadable_error("the LASzip record ends too early", where="laszip")
    items = struct.unpack_from("<H", data, position + 32)[0]
    if length < 34 + 6 * items:
        raise unreadable_error("the LASzip record ends too early", where="laszip")
    kinds = [struct.unpack_from("<HH", data, position + 34 + 6 * k) for k in range(items)]
    total = sum(bytes_ for _, bytes_ in kinds)
    if total != record:
        raise unreadable_error(
            f"the LASzip record declares points of {total} bytes, the header of {record}", where="laszip"
        )
    if len(data) - start < 8:
        raise unreadable_error("the compressed points are missing", where="laszip")
    (table,) = struct.unpack_from("<q", data, start)
    if table == -1:  # a streaming writer has put the offset at the end
        (table,) = struct.unpack_from("<q", data, len(data) - 8)
    if not start + 8 <= table <= len(data) - 8:
        raise unreadable_error("the chunk table is outside the file", where="laszip")
    if struct.unpack_from("<I", data, table + 4)[0] > count:
        raise unreadable_error("there are more chunks than points", where="laszip")
    if any(kind in LAYERS or kind == EXTRA_BYTES for kind, _ in kinds):
        _check_layers(data, start, table, data[position : position + length], kinds)


def _check_layers(data: bytes, start: int, table: int, laszip: bytes, kinds: list[tuple[int, int]]) -> None:
    """Check the layer sizes in each chunk of 1.4 point formats, which are allocated as declared."""
    import lazrs

    stream = io.BytesIO(data)
    stream.seek(start)
    with _convert_errors():
        chunks = lazrs.read_chunk_table(stream, lazrs.LazVlr(laszip))
    layers = sum(bytes_ if kind == EXTRA_BYTES else LAYERS.get(kind, 0) for kind, bytes_ in kinds)
    first = sum(bytes_ for _, bytes_ in kinds) + 4
    position = start + 8
    for _, size in chunks:
        if size < first + 4 * layers or position + size > table:
            raise unreadable_error("a chunk ends beyond the points or before its start", where="laszip")
        if first + 4 * layers + sum(struct.unpack_from(f"<{layers}I", data, position + first)) > size:
            raise unreadable_error("the layers of a chunk are larger than the chunk", where="laszip")
        position += size


@contextmanager
def _convert_errors() -> Iterator[None]:
    """Convert errors of laspy and lazrs to UnreadableFile, including Rust panics of lazrs on damaged files."""
    import laspy
    import lazrs

    try:
        yield
    except (laspy.errors.LaspyException, lazrs.LazrsError, AssertionError) as error:
        raise unreadable_error(f"{str(error)[:200] or type(error).__name__}") from error
    except BaseException as error:
        if type(error).__name__ != "PanicException":
            raise
        raise UnreadableFile(
            "the compressed points are damaged", unreadable_error("damaged points").problems
        ) from error


def _cloud(las: Any, count: int, context: ReadContext) -> Cloud:
    columns: dict[str, NDArray[Any]] = {}
    for axis, scale, offset in zip(AXES, las.header.scales, las.header.offsets, strict=True):
        columns[axis] = las.points.array[axis.upper()] * float(scale) + float(offset)
    for name in las.point_format.dimension_names:
        if name in ("X", "Y", "Z"):
            continue
        column = np.asarray(las[name])
        if len(column) and column.any():
            columns[name if name not in columns else f"{name}_"] = column
    keys = _geo_keys(las.header)
    crs = _wkt(las.header) or (_crs(keys, context) if keys else None)
    if crs is not None and (len(crs) > 2**16 or FILES.search(crs)):
        context.warn("the coordinate reference system is too long or refers to files; it is ignored, set crs=EPSG:…")
        crs = None
    return Cloud(columns, count, crs=crs, units=_units(keys) if crs is None else None)


def _records(header: Any, number: int) -> list[Any]:
    """Return the records of a projection with a number."""
    records = [*header.vlrs, *(header.evlrs or ())]
    return [r for r in records if r.user_id == "LASF_Projection" and r.record_id == number]


def _wkt(header: Any) -> str | None:
    """Return the coordinate reference system as WKT, if the file has it."""
    for record in _records(header, 2112):
        text = str(getattr(record, "string", "")).strip("\0 ")
        if re.match(r"[A-Z_0-9]{4,40}\[", text):  # WKT only, none of PROJ's other CRS notations
            return text
    return None


def _geo_keys(header: Any) -> dict[int, int]:
    """Return the GeoTIFF keys that are codes."""
    for record in _records(header, 34735):
        return {k.id: k.value_offset for k in getattr(record, "geo_keys", ()) if k.tiff_tag_location == 0}
    return {}


def _crs(keys: Mapping[int, int], context: ReadContext) -> str | None:
    """Return the CRS that GeoTIFF keys name by codes, with the unit of its heights if that is not the metre."""
    code = keys.get(PROJECTED) or keys.get(GEOGRAPHIC)
    if not code or not 1024 <= code < USER_DEFINED:
        return None
    crs, vertical = f"EPSG:{code}", keys.get(VERTICAL, 0)
    compound = with_vertical(crs, str(vertical)) if 1024 <= vertical < USER_DEFINED else None
    if compound is not None:
        return compound
    unit = UNITS.get(keys.get(VERTICAL_UNITS, 0))
    try:
        plane, height = length_units(crs) or (1.0, 1.0)
        if unit is None and plane != height:
            unit = plane
            context.warn(
                f"the file names no unit of heights: they are read in that of {crs}, {unit:.10g} m; set crs={crs} if "
                "they are metres",
                where="crs",
            )
        return crs if unit is None or unit == height else with_height_unit(crs, unit)
    except Invalid:
        return crs  # an unknown CRS is reported where it is applied


def _units(keys: Mapping[int, int]) -> tuple[float, float] | None:
    """Return the metres of a unit of x and y, and of z, of a CRS without a code; None if both are metres."""
    unit = UNITS.get(keys.get(PROJECTED_UNITS, 0), 1.0) if keys.get(PROJECTED) == USER_DEFINED else 1.0
    height = UNITS.get(keys.get(VERTICAL_UNITS, 0), unit)
    return None if unit == height == 1.0 else (unit, height)


# --- writing ------------------------------------------------------------------------------------------------------
def recompress(data: bytes, compress: bool) -> bytes:
    """Compress or decompress an uploaded file without loss."""
    import laspy

    with _convert_errors():
        las = laspy.read(io.BytesIO(data), laz_backend=laspy.LazBackend.Lazrs)
        out = io.BytesIO()
        las.write(out, do_compress=compress, laz_backend=laspy.LazBackend.Lazrs)
    written = bytearray(out.getvalue())
    written[NO_DATE] = data[NO_DATE]
    return bytes(written)


def pack(columns: Mapping[str, NDArray[Any]], context: WriteContext, compress: bool) -> bytes:
    """Encode LAS 1.4, point format 7 with colours and 6 without, in steps of a millimetre.

    columns: as returned by ``plain``; columns without a LAS dimension become extra bytes. Points without finite
    coordinates are dropped.
    """
    import laspy

    places = np.stack([columns[axis].astype(np.float64) for axis in AXES], axis=1)
    valid = np.isfinite(places).all(axis=1)
    context.drop("points", int(np.count_nonzero(~valid)), "LAS cannot store points without finite coordinates")
    places = places[valid]
    coloured = all(name in columns for name in RGB)
    header = laspy.LasHeader(version="1.4", point_format=7 if coloured else 6)
    header.generating_software = SOFTWARE
    header.global_encoding.wkt = True
    low = places.min(axis=0) if len(places) else np.zeros(3)
    high = places.max(axis=0) if len(places) else np.zeros(3)
    header.offsets = np.floor((low + high) / 2)
    reach = float(np.maximum(high - header.offsets, header.offsets - low).max())
    scale = SCALE
    while reach / scale >= 2**31 - 1:
        scale *= 10
    header.scales = np.full(3, scale)
    if scale > SCALE:
        context.warn(f"the cloud exceeds the range of millimetre steps; its points are written in steps of {scale:g} m")
    extra: dict[str, NDArray[Any]] = {}
    standard: dict[str, NDArray[Any]] = {}
    for name, column in columns.items():
        if name in AXES or (coloured and name in RGB):
            continue
        values = column[valid]
        if name == "gps_time" or (name in INTEGER_DIMENSIONS and _is_within(values, INTEGER_DIMENSIONS[name])):
            standard[name] = values
        else:
            taken = {d.lower() for d in header.point_format.dimension_names} | {n.lower() for n in extra}
            extra[_free_name(name, taken)] = values
    if extra:
        header.add_extra_dims(
            [laspy.ExtraBytesParams(name=n, type=c.dtype.newbyteorder("<")) for n, c in extra.items()]
        )
    las = laspy.LasData(header)
    las.points = laspy.ScaleAwarePointRecord.zeros(len(places), header=header)
    for k, axis in enumerate(AXES):
        las[axis.upper()] = np.round((places[:, k] - header.offsets[k]) / scale).astype(np.int32)
    for name, column in {**standard, **extra}.items():
        las[name] = column
    las.return_number = np.ones(len(places), np.uint8)
    las.number_of_returns = np.ones(len(places), np.uint8)
    for name in RGB if coloured else ():
        las[name] = columns[name][valid].astype(np.uint16) * np.uint16(257)
    las.update_header()
    out = io.BytesIO()
    las.write(out, do_compress=compress, laz_backend=laspy.LazBackend.Lazrs)
    written = bytearray(out.getvalue())
    written[NO_DATE] = bytes(4)
    return bytes(written)


def _is_within(column: NDArray[Any], maximum: int) -> bool:
    """Check that all values are integers from 0 to ``maximum``."""
    if not len(column):
        return True
    if column.dtype.kind == "f" and not bool((np.isfinite(column) & (column == np.floor(column))).all()):
        return False
    return int(column.min()) >= 0 and int(column.max()) <= maximum


def _free_name(name: str, taken: set[str]) -> str:
    """Return a name for extra bytes: at most 32 bytes of ASCII, and not an existing dimension."""
    stem = re.sub(r"[^ -~]", "_", name)[:28] or "value"
    out, k = stem, 2
    while out.lower() in taken:
        out, k = f"{stem}_{k}", k + 1
    return out

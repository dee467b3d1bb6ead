"""Read and write GeoTIFF with GDAL, in memory only.

GDAL opens uploads only with the GTiff driver, from bytes in memory: never a sidecar file, VRT or URL. Size and memory
are checked from the header before pixels are decoded.
"""

from __future__ import annotations

import itertools
import math
import re
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.errors import BadUpload, Problem, TooLarge, UnreadableFile
from app.limits import Limits
from app.model.frame import MAX_METRES
from app.model.gdal import CACHE, DATA_TYPES, buffer_bytes, gdal, native, open_memory_dataset
from app.model.geodesy import crs_bounds
from app.model.imagery import LOCAL, Affine, GeoImage

NO_TRANSFORM: Affine = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)

BLOCK = 512
"""Side of a written tile, in pixels."""

OWN_TAG = "FLEETMAP_CRS"
"""Private metadata item: ``local`` if the raster is anchored in the local frame, whatever CRS the file names."""

LOCAL_WKT = 'LOCAL_CS["local frame",UNIT["metre",1],AXIS["x",EAST],AXIS["y",NORTH]]'
"""The local frame as an engineering CRS, without a position on earth: GDAL keeps its name and unit in GeoTIFF keys."""

MAX_WKT = 2**16
"""Maximum length of a CRS definition, in characters: ten times PROJ's longest."""

MEMORY_DIVISOR = 3
"""Divisor: decoded pixels may use 1/3 of a worker's memory, since storing and writing them needs the rest."""

GEO_TAGS = frozenset({33550, 33922, 34264, 34735})
"""TIFF tags ModelPixelScale, ModelTiepoint, ModelTransformation, GeoKeyDirectory (OGC 19-008r4)."""
GDAL_METADATA = 42112
MAX_TAGS = 4096
MAX_PAGES = 1000
"""Maximum number of pages. Overviews and masks are pages, too: real files have up to about thirty."""

Halve = Callable[[NDArray[Any]], NDArray[Any]]

CRS_NAME = re.compile(r"(EPSG|ESRI|IAU_\d{4}):\d{1,7}|OGC:CRS84", re.IGNORECASE)

_MEMORY_NAME = re.compile(r"/vsimem/[0-9a-f-]+/[0-9a-f-]+\.tif(?:, band \d+)?:?\s*")


@dataclass(frozen=True, slots=True)
class Raster:
    """Decoded TIFF. transform, crs: None if it has none. properties: as in ``GeoImage``, with the file's tags.

    is_local: our own mark, see ``OWN_TAG``.
    """

    pixels: NDArray[Any]
    transform: Affine | None
    crs: str | None
    properties: dict[str, Any] = field(default_factory=dict)
    doubts: tuple[str, ...] = ()
    is_local: bool = False


# --- detection ----------------------------------------------------------------------------------------------------
def is_tiff(data: bytes) -> bool:
    """Detect TIFF or BigTIFF, in either byte order, by the first bytes."""
    return data[:4] in (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


def is_georeferenced(data: bytes) -> bool:
    """Return whether the first page of a TIFF has georeferencing tags."""
    return bool(GEO_TAGS & _tags(data).keys()) or has_item(data, OWN_TAG)


def has_item(data: bytes, name: str) -> bool:
    """Return whether the first page of a TIFF has a metadata item of GDAL."""
    start, size = _tags(data).get(GDAL_METADATA, (0, 0))
    return name.encode() in data[start : start + size]


MAX_BANDS = 1024
"""Maximum number of bands: hyperspectral images have a few hundred, and GDAL needs milliseconds for each."""

GEO_KEYS = 34735
GEOGRAPHIC, PROJECTED, USER_DEFINED = 2048, 3072, 32767


def read_epsg_code(data: bytes) -> int | None:
    """Read the EPSG code of the first page of a TIFF; None if it has none or defines its own CRS.

    Source: OGC GeoTIFF 1.1, section 7.
    """
    start, size = _tags(data).get(GEO_KEYS, (0, 0))
    order = "<" if data[:2] == b"II" else ">"
    try:
        shorts = struct.unpack_from(f"{order}{min(size, 4096)}H", data, start)
    except struct.error:
        return None
    keys = {shorts[k]: shorts[k + 3] for k in range(4, len(shorts) - 3, 4) if shorts[k + 1] == 0 and shorts[k + 2] == 1}
    code = keys.get(PROJECTED) or keys.get(GEOGRAPHIC)
    return None if code in (None, 0, USER_DEFINED) else code


def _tags(data: bytes) -> dict[int, tuple[int, int]]:
    """Read the first page's tags: number -> (offset, count); empty if the file is damaged."""
    page = next(_pages(data), None)
    if page is None:
        return {}
    order, big, at, count = page
    entry = order + ("HHQQ" if big else "HHII")
    step = struct.calcsize(entry)
    try:
        rows = [struct.unpack_from(entry, data, at + k * step) for k in range(min(count, MAX_TAGS))]
    except struct.error:
        return {}
    return {tag: (offset, size) for tag, _, size, offset in rows}


def _pages(data: bytes) -> Iterator[tuple[str, bool, int, int]]:
    """Yield each page of a TIFF as (byte order, whether it is a BigTIFF, offset of its tags, number of tags).

    Stops at the first damage; endless if the pages form a loop.
    """
    if not is_tiff(data):
        return
    order = "<" if data[:2] == b"II" else ">"
    big = data[2:4] in (b"+\0", b"\0+")
    offset_format, number, step = (order + "Q", order + "Q", 20) if big else (order + "I", order + "H", 12)
    try:
        (at,) = struct.unpack_from(offset_format, data, 8 if big else 4)
        while at:
            (count,) = struct.unpack_from(number, data, at)
            at += struct.calcsize(number)
            yield order, big, at, count
            (at,) = struct.unpack_from(offset_format, data, at + count * step)
    except (struct.error, OverflowError):
        return


# --- GDAL ---------------------------------------------------------------------------------------------------------
def crs_name(crs: Any) -> str:
    """Name a CRS of rasterio: ``EPSG:32630`` if that is equal, else WKT; ``local`` for an engineering CRS.

    Raises UnreadableFile for one that would make PROJ open files.
    """
    authority = crs.to_authority(confidence_threshold=100)
    if authority:
        name = ":".join(authority)
        if type(crs).from_user_input(name) == crs:
            return name
    text = str(crs.to_wkt(version="WKT2_2019"))
    check_wkt(text)
    return LOCAL if re.match(r"\s*(ENGCRS|ENGINEERINGCRS|LOCAL_CS|LOCAL_DATUM)", text, re.IGNORECASE) else text


def check_wkt(text: str) -> None:
    """Check a CRS definition. Raises UnreadableFile if it is too long or refers to local files (grid shifts)."""
    if len(text) > MAX_WKT:
        raise UnreadableFile(f"its CRS definition is too long: {len(text)} characters, the limit is {MAX_WKT}")
    for grids in re.findall(r"grids\s*=\s*([^\s\"]*)", text, re.IGNORECASE):
        if grids != "@null":
            raise UnreadableFile("its CRS definition refers to a grid file: specify it as EPSG:<number>")


def crs_from_wkt(text: str) -> str:
    """Name a CRS that is given as WKT (a .prj file). Raises UnreadableFile."""
    check_wkt(text)
    with gdal() as rasterio:
        try:
            return crs_name(rasterio.crs.CRS.from_wkt(text.strip()))
        except rasterio.errors.CRSError as error:
            raise UnreadableFile(f"invalid CRS: {_reason(error)}") from error


def position_problem(picture: GeoImage) -> str | None:
    """Return why an image's position is invalid: outside the local frame, or outside its CRS; else None."""
    ends = picture.outline()
    if picture.crs == LOCAL:
        beyond = not (np.abs(ends) <= MAX_METRES).all()
        return f"it extends beyond ±{MAX_METRES:g} m of the local frame" if beyond else None
    if not np.isfinite(ends).all() or crs_bounds(picture.crs, ends) is None:
        return f"its coordinates are outside the area of {picture.crs if len(picture.crs) <= 40 else 'its CRS'}"
    return None


def _reason(error: BaseException) -> str:
    """Return GDAL's first error message, without its names of in-memory files."""
    message = str(error)
    while (deeper := error.__cause__ or error.__context__) is not None and str(deeper):
        error, message = deeper, str(deeper)
    text = _MEMORY_NAME.sub("", message).replace("'/vsimem", "'").strip()
    return re.sub(r"/vsimem/\S*", "the file", text)[:300] or type(error).__name__


# --- reading ------------------------------------------------------------------------------------------------------
def read_tiff(data: bytes, limits: Limits) -> Raster:
    """Decode a TIFF's first page. Raises UnreadableFile or TooLarge before anything large is allocated."""
    from rasterio._err import CPLE_BaseError
    from rasterio.io import MemoryFile

    if next(itertools.islice(_pages(data), MAX_PAGES, None), None) is not None:
        raise TooLarge(f"the TIFF has more than {MAX_PAGES} pages, or its pages form a loop")
    with gdal() as rasterio:
        errors = (rasterio.errors.RasterioError, CPLE_BaseError, OSError, ValueError, TypeError, ArithmeticError)
        try:
            with MemoryFile(data) as file, file.open(driver="GTiff", GEOREF_SOURCES="INTERNAL") as dataset:
                _check_size(dataset, limits)
                raster = _decode(dataset, rasterio)
        except BadUpload:
            raise
        except errors as error:
            raise UnreadableFile(f"the TIFF is damaged or of an unsupported kind: {_reason(error)}") from error
    code = read_epsg_code(data)
    if code is not None and raster.crs in (None, LOCAL):  # GDAL's result for an unknown code
        reason = f"unknown CRS EPSG:{code} in its GeoTIFF keys: correct them"
        raise UnreadableFile(reason, [Problem(reason, where="crs")])
    return raster


def _check_size(dataset: Any, limits: Limits) -> None:
    width, height, count = dataset.width, dataset.height, dataset.count
    kinds = sorted(set(dataset.dtypes))
    if width < 1 or height < 1 or count < 1:
        raise UnreadableFile(f"invalid size of the TIFF: {width} × {height} pixels in {count} bands")
    if width * height > limits.pixels:
        raise TooLarge(
            f"the TIFF declares {width} × {height} = {width * height} pixels; the limit is {limits.pixels} "
            "(FLEETMAP_MAX_PIXELS)"
        )
    if count > MAX_BANDS:
        raise TooLarge(f"the TIFF declares {count} bands; the limit is {MAX_BANDS}")
    if len(kinds) != 1 or kinds[0] not in DATA_TYPES:
        raise UnreadableFile(f"unsupported pixel type of the TIFF: {', '.join(kinds)}; use integers or floats")
    size = width * height * count * np.dtype(kinds[0]).itemsize
    limit = limits.memory_bytes // MEMORY_DIVISOR
    if size > limit:
        raise TooLarge(f"the TIFF's pixels take {size} bytes ({count} bands of {kinds[0]}); the limit is {limit}")


def _decode(dataset: Any, rasterio: Any) -> Raster:
    doubts = []
    pages = len(dataset.subdatasets)
    if pages > 1:
        doubts.append(f"it has {pages} pages; only the first one is read")
    flags = dataset.mask_flag_enums[0]
    masked = rasterio.enums.MaskFlags.per_dataset in flags and not {
        rasterio.enums.MaskFlags.alpha,
        rasterio.enums.MaskFlags.nodata,
    } & set(flags)
    pixels = _pixels(dataset, rasterio, masked)
    tags = _texts(dataset.tags())
    is_local = tags.pop(OWN_TAG, None) == LOCAL
    transform, crs = _placement(dataset, is_local, doubts)
    properties = _properties(dataset, tags, masked)
    return Raster(np.moveaxis(pixels, 0, 2), transform, crs, properties, tuple(doubts), is_local)


def _pixels(dataset: Any, rasterio: Any, masked: bool) -> NDArray[Any]:
    """Read the pixels as [bands, height, width]; a mask becomes one more band."""
    count, height, width = dataset.count, dataset.height, dataset.width
    kind = np.dtype(dataset.dtypes[0])
    pixels = np.empty((count + masked, height, width), kind)
    for window in _windows(dataset, rasterio):
        rows, columns = window.toslices()
        dataset.read(out=pixels[:count, rows, columns], window=window)
    if masked:
        full = 127 if kind == np.int8 else 255
        np.multiply(dataset.read_masks(1) != 0, full, out=pixels[count], casting="unsafe")
    return pixels


def _placement(dataset: Any, is_local: bool, doubts: list[str]) -> tuple[Affine | None, str | None]:
    """Return transform and CRS, from ground control points if the file has no transform. Raises UnreadableFile."""
    transform: Affine | None = tuple(float(v) for v in dataset.transform[:6])  # type: ignore[assignment]
    crs = crs_name(dataset.crs) if dataset.crs else LOCAL if is_local else None
    if transform != NO_TRANSFORM or is_local:
        return transform, crs
    points, points_crs = dataset.gcps
    if not points:
        if dataset.rpcs:
            raise UnreadableFile("georeferenced only by a sensor model (RPC): orthorectify it first (gdalwarp -rpc)")
        return None, crs
    plane = fit_affine([(p.col, p.row, p.x, p.y) for p in points])
    if plane is None:
        raise UnreadableFile("its ground control points are collinear: at least three must not be on one line")
    transform, off = plane
    if off > 0.5:
        doubts.append(
            f"its {len(points)} ground control points deviate by up to {off:.1f} pixels from an affine fit; warp it "
            "(gdalwarp) for a closer fit"
        )
    return transform, crs_name(points_crs) if points_crs else crs


def _properties(dataset: Any, tags: dict[str, str], masked: bool) -> dict[str, Any]:
    """Collect the file's metadata. tags: of the whole file; removes those that only describe its production."""
    colours = [c.name for c in dataset.colorinterp]
    bands = [_band(dataset, k, colour) for k, colour in enumerate(colours)]
    if masked:
        bands.append({"colour": "mask"})
    properties: dict[str, Any] = {"bands": bands}
    nodata = dataset.nodata
    if nodata is not None:
        kind = np.dtype(dataset.dtypes[0])
        is_integer = math.isfinite(nodata) and kind.kind in "iu" and float(nodata).is_integer()
        properties["nodata"] = int(nodata) if is_integer else nodata if math.isfinite(nodata) else str(float(nodata))
    if "palette" in colours:
        table = dataset.colormap(colours.index("palette") + 1)
        properties["palette"] = [list(table[k]) for k in sorted(table)]
    if tags.get("AREA_OR_POINT") == "Area":
        del tags["AREA_OR_POINT"]
    tags.pop("OVR_RESAMPLING_ALG", None)
    if tags.get("TIFFTAG_COPYRIGHT"):
        properties["attribution"] = [tags["TIFFTAG_COPYRIGHT"]]
    if tags:
        properties["satellite"] = {"tags": tags}
    return properties


def _band(dataset: Any, k: int, colour: str) -> dict[str, Any]:
    values = {
        "description": dataset.descriptions[k] or None,
        "unit": dataset.units[k] or None,
        "scale": _unless(dataset.scales[k], 1.0),
        "offset": _unless(dataset.offsets[k], 0.0),
    }
    band: dict[str, Any] = {"colour": colour, **{name: value for name, value in values.items() if value is not None}}
    if tags := _texts(dataset.tags(k + 1)):
        band["satellite"] = {"tags": tags}
    return band


def _windows(dataset: Any, rasterio: Any) -> Iterator[Any]:
    """Yield windows of whole blocks that fit into the cache.

    GDAL reads line by line, and would decode each tile of a wide image again for each line.
    """
    high, wide = dataset.block_shapes[0]
    room = CACHE // 2 // (dataset.count * np.dtype(dataset.dtypes[0]).itemsize)
    columns = max(1, room // (high * wide)) * wide
    rows = max(1, room // (high * min(columns, dataset.width))) * high
    for y in range(0, dataset.height, rows):
        for x in range(0, dataset.width, columns):
            yield rasterio.windows.Window(x, y, min(columns, dataset.width - x), min(rows, dataset.height - y))


def _unless(value: float, default: float) -> float | None:
    """Return a finite number that differs from the default, else None."""
    return float(value) if math.isfinite(value) and value != default else None


def _texts(tags: Mapping[str, str]) -> dict[str, str]:
    """Select the tags whose names and values are safe in any response."""
    return {
        name: value
        for name, value in tags.items()
        if name and not re.search("[\ud800-\udfff\0]", name + value) and name not in ("ns", "bidx")
    }


def fit_affine(points: Sequence[tuple[float, float, float, float]]) -> tuple[Affine, float] | None:
    """Fit an affine transform to (column, row, x, y) points. Returns it and the maximum error in pixels."""
    table = np.array(points, np.float64)
    if not np.isfinite(table).all():
        return None
    design = np.column_stack([table[:, 0], table[:, 1], np.ones(len(table))])
    solution, _, rank, _ = np.linalg.lstsq(design, table[:, 2:], rcond=None)
    if rank < 3:
        return None
    (a, d), (b, e), (c, f) = solution.tolist()
    off = design @ solution - table[:, 2:]
    area = abs(a * e - b * d)
    worst = float(np.hypot(off[:, 0], off[:, 1]).max())
    return (a, b, c, d, e, f), worst / math.sqrt(area) if area > 0.0 else math.inf


# --- writing ------------------------------------------------------------------------------------------------------
def write_cog(picture: GeoImage, crs: str | None, tags: Mapping[str, str], halve: Halve | None = None) -> bytes:
    """Write a cloud optimized GeoTIFF: tiles of 512 pixels, overviews above that size, deflate with a predictor.

    crs: its name or WKT; None: metres of the local frame. tags: of the whole file. halve: makes an overview of the
    level below it, both [height, width], of an image with one band; None: GDAL averages shades and takes the nearest of
    others. The pixels are not copied: GDAL reads the array in place.
    The file has no time stamp and no version, so equal images give equal bytes.
    """
    from rasterio import shutil
    from rasterio.io import MemoryFile

    pixels = native(picture.pixels)
    colours = picture.colours
    count = pixels.shape[2]
    masked = count > 1 and colours[-1] == "mask"
    count -= masked
    options = {
        "COMPRESS": "DEFLATE",
        "PREDICTOR": "YES",
        "LEVEL": "6",
        "BLOCKSIZE": str(BLOCK),
        "BIGTIFF": "IF_SAFER",
        "NUM_THREADS": "1",
        "OVERVIEW_RESAMPLING": "NEAREST" if "palette" in colours or not _is_shade(picture) else "AVERAGE",
    }
    # Cache two rows of the largest overview's tiles: an incomplete tile would be written twice.
    cache = max(CACHE // 4, BLOCK * pixels.shape[1] * pixels.shape[2] * pixels.itemsize)
    with gdal(cache) as rasterio, MemoryFile(ext=".tif") as draft, MemoryFile() as out:
        with open_memory_dataset(rasterio, pixels, count, described=True) as dataset:
            _describe(dataset, picture, colours[:count], crs, tags, rasterio)
            if masked:
                dataset.write_mask(pixels[..., count] != 0)
            if halve is None or max(pixels.shape[:2]) <= BLOCK:
                shutil.copy(dataset, out.name, driver="COG", **options)
            else:
                _write_overviews(dataset, draft.name, halve, pixels[..., 0], rasterio)
                with rasterio.open(draft.name) as complete:
                    shutil.copy(complete, out.name, driver="COG", **options, OVERVIEWS="FORCE_USE_EXISTING")
        return buffer_bytes(out.getbuffer())


def _write_overviews(dataset: Any, name: str, halve: Halve, pixels: NDArray[Any], rasterio: Any) -> None:
    """Copy a dataset to a plain GeoTIFF, and write its overviews: GDAL cannot be given their pixels otherwise."""
    from rasterio import shutil

    options = {"TILED": "YES", "BLOCKXSIZE": str(BLOCK), "BLOCKYSIZE": str(BLOCK), "COMPRESS": "DEFLATE", "ZLEVEL": "1"}
    shutil.copy(dataset, name, driver="GTiff", **options)
    count = ((max(pixels.shape) - 1) // BLOCK).bit_length()
    with rasterio.open(name, "r+") as draft:
        draft.build_overviews([2**k for k in range(1, count + 1)], rasterio.enums.Resampling.nearest)
    for k in range(count):
        pixels = halve(pixels)
        with rasterio.open(f"GTIFF_DIR:{k + 2}:{name}", "r+") as overview:
            overview.write(pixels, 1)


def _is_shade(picture: GeoImage) -> bool:
    """Return whether pixel values can be interpolated: shades and heights, not class numbers (integers, no colour)."""
    return picture.pixels.dtype.kind == "f" or picture.pixels.dtype == np.uint8


def _describe(
    dataset: Any, picture: GeoImage, colours: Sequence[str], crs: str | None, tags: Mapping[str, str], rasterio: Any
) -> None:
    interpretations = rasterio.enums.ColorInterp
    dataset.transform = rasterio.Affine(*picture.transform)
    dataset.crs = rasterio.crs.CRS.from_user_input(LOCAL_WKT if crs is None else crs)
    nodata = picture.nodata
    if nodata is not None and _can_represent(picture.pixels.dtype, nodata):
        dataset.nodata = nodata
    dataset.colorinterp = [
        interpretations[c] if c in interpretations.__members__ else interpretations.undefined for c in colours
    ]
    source_bands = picture.properties.get("bands")
    bands = list(source_bands)[: len(colours)] if isinstance(source_bands, list | tuple) else []
    for k, band in enumerate(bands):
        if not isinstance(band, Mapping):
            continue
        if isinstance(band.get("description"), str):
            dataset.set_band_description(k + 1, band["description"])
        if isinstance(band.get("unit"), str):
            dataset.set_band_unit(k + 1, band["unit"])
        source_properties = band.get("satellite")
        if isinstance(source_properties, Mapping) and isinstance(source_properties.get("tags"), Mapping):
            dataset.update_tags(k + 1, **{str(n): str(v) for n, v in sorted(source_properties["tags"].items())})
    for name, default in (("scale", 1.0), ("offset", 0.0)):
        values = [b.get(name, default) if isinstance(b, Mapping) else default for b in bands]
        if any(v != default for v in values):
            setattr(dataset, name + "s", [float(v) for v in values] + [default] * (len(colours) - len(values)))
    palette = picture.properties.get("palette")
    if "palette" in colours and isinstance(palette, list | tuple):
        table = {k: tuple(int(v) for v in entry) for k, entry in enumerate(palette)}
        dataset.write_colormap(colours.index("palette") + 1, table)
    dataset.update_tags(**{name: tags[name] for name in sorted(tags)})


def _can_represent(kind: np.dtype[Any], value: float) -> bool:
    """Return whether pixels of this type can have the value."""
    if kind.kind == "f":
        return True
    if not (math.isfinite(value) and float(value).is_integer()):
        return False
    info = np.iinfo(kind) if kind.kind in "iu" else None
    return info is not None and info.min <= value <= info.max


def crs_to_wkt(crs: str) -> str:
    """Format a CRS as WKT 1 if possible, since older tools read no other, else WKT 2."""
    with gdal() as rasterio:
        return str(rasterio.crs.CRS.from_user_input(crs).to_wkt())


# --- files beside an image ----------------------------------------------------------------------------------------
def world_file(transform: Affine, digits: int) -> bytes:
    """Format a world file: for the centre of a pixel, in the order of ESRI. digits: decimals of the position."""
    a, b, c, d, e, f = transform
    numbers = [*map(_exact, (a, d, b, e)), _round(c + a / 2 + b / 2, digits), _round(f + d / 2 + e / 2, digits)]
    return ("\n".join(numbers) + "\n").encode()


def _exact(value: float) -> str:
    return repr(float(value) + 0.0)


def _round(value: float, digits: int) -> str:
    """Round to a nanometre, or to 15 digits if these are fewer, so that a shift by half a pixel and back is exact."""
    return repr(float(f"{round(value, digits):.15g}") + 0.0)


def aux_xml(crs: str, *, is_local: bool) -> bytes:
    """Format GDAL's sidecar file with the CRS, which QGIS and GDAL read, and our own mark."""
    from xml.sax.saxutils import escape

    mark = f'  <Metadata>\n    <MDI key="{OWN_TAG}">{LOCAL}</MDI>\n  </Metadata>\n' if is_local else ""
    return f"<PAMDataset>\n  <SRS>{escape(crs_to_wkt(crs))}</SRS>\n{mark}</PAMDataset>\n".encode()

"""Point clouds and voxels: shared by ``pcd``, ``ply`` and ``las``.

A cloud becomes the occupied voxels that contain its points; a voxel's colour is the mean of its points. The file is
stored beside the voxels, byte for byte, as a resource; the voxel map refers to it and holds a fingerprint of the leaves
made from it (``properties.points``). So all cloud formats return the same points, and the file is never exported for
other voxels: neither after another upload with that name nor after a change of the leaves.

Frame of the voxels: local. Points with a CRS (a LAS file names its own) are converted with the environment's datum;
others are read as local metres. A cloud far beyond the octree (UTM coordinates without a CRS) is moved to the origin by
whole metres, with a warning.
"""

from __future__ import annotations

import hashlib
import io
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from app.errors import Invalid, Problem, TooLarge, UnreadableFile
from app.formats import Files, Parts, ReadContext, WriteContext
from app.formats._select import file_stem, select_part
from app.limits import Limits
from app.model.distinct import distinct
from app.model.frame import MAX_DATUM_LATITUDE, Datum
from app.model.geodesy import LocalFrame, crs_to_wgs84, local_frame
from app.model.layers import MAP, Layers, Part, PartKey, Resources, cloud_name
from app.model.voxels import DEPTH, HALF, LOG_ODDS, VoxelMap, expand_leaves, morton
from app.parameters import parameter

PROPERTY = "points"
"""Property of a voxel map that refers to the source file of its leaves."""

RESOLUTIONS = tuple(digit * 10.0**power for power in range(-2, 4) for digit in (1, 2, 5))[2:]
"""Voxel sizes in metres: 0.05 is the default, the others are for clouds that do not fit into the octree with it."""

FAR_RATIO = 10.0
"""Distance from the origin, in lengths of the cloud, above which a cloud is far away."""

MAX_METRES = 1e9
"""Maximum coordinate in metres; larger values mark "no return"."""

CHUNK = 2**20
"""Number of points processed at once, to bound the memory in addition to the file."""

IDENTITY_VIEWPOINT = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
"""Default viewpoint of a cloud: at the origin, not rotated."""

AXES = ("x", "y", "z")
Array = NDArray[np.float64]
Offset = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """Conversion of points to voxels."""

    resolution: float | None = parameter(
        None,
        "edge length of a voxel; default: 0.05, or the first of 0.1, 0.2, 0.5 … that fits the cloud into the octree",
        minimum=1e-3,
        maximum=1e4,
        unit="m",
    )
    origin: tuple[float, float, float] | None = parameter(
        None, "x,y,z in the file's coordinates that become the local origin; subtracted from every point", unit="m"
    )
    crs: str | None = parameter(
        None,
        "coordinate reference system of the points, for example EPSG:32632; 'local': local metres, ignoring the file; "
        "default: that of the file, else local metres",
    )


@dataclass(frozen=True, slots=True)
class Cloud:
    """Point cloud: named columns in file order, float or integer [n] or [n, count], including x, y and z.

    width, height: of an organised cloud, width · height = n; else n and 1. viewpoint: x, y, z and the quaternion w, x,
    y, z of the sensor. comments: lines of text. further: counts of the file's other elements by name. crs: as in the
    file (a code or WKT). units: metres of a unit of x and y, and of z, if there is no CRS; default: metres.
    """

    columns: Mapping[str, NDArray[Any]]
    width: int
    height: int = 1
    viewpoint: tuple[float, ...] = IDENTITY_VIEWPOINT
    comments: tuple[str, ...] = ()
    further: Mapping[str, int] = field(default_factory=dict)
    crs: str | None = None
    units: tuple[float, float] | None = None

    def __len__(self) -> int:
        return len(self.columns["x"])

    def places(self, start: int, stop: int) -> Array:
        """Return coordinates of a range of points, in metres or in units of the CRS: float64 [m, 3]."""
        return np.stack([self.columns[axis][start:stop].astype(np.float64) for axis in AXES], axis=1)


Parse = Callable[[bytes, ReadContext], Cloud]


def unreadable_error(reason: str, line: int | None = None, where: str | None = None) -> UnreadableFile:
    """Create the error for an unreadable file, with its location."""
    return UnreadableFile(reason, [Problem(reason, line=line, where=where)])


def check_count(count: int, context: ReadContext) -> None:
    """Raise TooLarge if there are more points than voxels allowed in an upload: each point gives at most one voxel."""
    if count > context.limits.voxels:
        raise TooLarge(f"the cloud has {count} points; the limit is {context.limits.voxels}")


def check_columns(columns: Mapping[str, NDArray[Any]]) -> None:
    """Raise UnreadableFile if a coordinate is missing."""
    missing = [axis for axis in AXES if axis not in columns or columns[axis].ndim != 1]
    if missing:
        raise unreadable_error(
            f"points need x, y and z with one value each; missing: {', '.join(missing)}", where=missing[0]
        )


def table(
    text: bytes, dtype: np.dtype[Any], rows: int, first_line: int, skip: int = 0, *, alone: bool = True
) -> NDArray[Any]:
    """Parse rows of space-separated numbers to a structured array [rows].

    dtype: packed fields without shapes, one per column. first_line: the text's line in its file, from 1. skip: lines
    before the rows. alone: nothing else follows; one additional row is returned if there is one. Raises UnreadableFile
    with the line.
    """

    if not rows:
        return np.empty(0, dtype)
    if text.count(b"\n", 0, len(text)) + 1 < rows:  # cheaper than parsing row by row
        raise unreadable_error(f"the header declares {rows} points, but the file has fewer lines", first_line)
    try:
        out = np.loadtxt(io.BytesIO(text), dtype, comments=None, skiprows=skip, max_rows=rows + alone, ndmin=1)
    except (ValueError, OverflowError) as error:
        match = re.search(r"at row (\d+)", str(error))
        # NumPy counts rows from 0 for an invalid value, from 1 for too many or too few values.
        line = first_line + skip + int(match[1]) - (" columns " in str(error)) if match else None
        reason = str(error).partition(";")[0][:200]
        raise unreadable_error(f"invalid row of numbers: {reason}", line) from error
    if len(out) < rows:
        raise unreadable_error(f"the header declares {rows} points, but the file has {len(out)} rows", first_line)
    return np.asarray(out)


# --- points -> voxels ---------------------------------------------------------------------------------------------
def read(files: Files, context: ReadContext, form: str, parse: Parse) -> Layers:
    """Read a voxel map, and the file as its resource.

    Raises UnreadableFile, TooLarge, or Invalid for an unknown CRS.
    """
    main = context.main or next(iter(files))
    data = files[main]
    if not context.wants("voxels") and not context.wants("resources"):
        return Layers()
    options = context.options if isinstance(context.options, ReadOptions) else ReadOptions()
    cloud = parse(data, context)
    name = context.grid or main.rpartition("/")[2].rpartition(".")[0] or MAP
    if cloud.viewpoint[3:] != (1.0, 0.0, 0.0, 0.0):
        context.warn("the VIEWPOINT is rotated; it is stored but not applied to the points")
    for noun, count in cloud.further.items():
        context.warn(f"{count} × {noun} are stored with the file only; only points become voxels", where=noun)
    voxels, placed, datum = _voxelise(cloud, options, context)
    path = f"{name}.{form}"
    source_properties = {
        "file": path,
        "sha256": hashlib.sha256(data).hexdigest(),
        "leaves": _fingerprint(voxels),
        "points": len(cloud),
        **placed,
    }
    voxel_map = VoxelMap(
        voxels.resolution,
        voxels.depth,
        voxels.code,
        voxels.log_odds,
        voxels.colour,
        voxels.binary,
        {PROPERTY: source_properties},
    )
    parts: dict[PartKey, Part] = {PartKey("voxels", context.level, name): voxel_map}
    if context.wants("resources"):
        parts[PartKey("resources", context.level, cloud_name(name))] = Resources({path: data})
    return Layers(parts, datum)


def _voxelise(
    cloud: Cloud, options: ReadOptions, context: ReadContext
) -> tuple[VoxelMap, dict[str, Any], Datum | None]:
    """Return the voxels, how the points were placed, and the datum if the cloud sets one."""
    local, placed, corner = _place(cloud, options, context)
    n = len(cloud)

    def chunks() -> Iterator[Array]:
        for start in range(0, n, CHUNK):
            stop = min(n, start + CHUNK)
            yield cloud.places(start, stop) if local is None else local[start:stop]

    low, high, finite = np.full(3, math.inf), np.full(3, -math.inf), 0
    for places in chunks():
        finite_places = places[_usable(places)]
        finite += len(finite_places)
        if len(finite_places):
            low, high = np.minimum(low, finite_places.min(axis=0)), np.maximum(high, finite_places.max(axis=0))
    if finite < n:
        context.warn(
            f"{n - finite} of {n} points have no valid coordinates; they are stored with the file and give no voxels"
        )
    if not finite:
        context.warn("the cloud has no points with valid coordinates; the voxel map is empty")
        resolution = options.resolution or RESOLUTIONS[0]
        none = np.empty(0, np.uint64)
        return VoxelMap(resolution, np.empty(0, np.uint8), none, np.empty(0, np.float32)), placed, corner
    resolution, shift = _fit_resolution(low, high, options, context)
    if any(shift):
        placed["origin"] = list(shift)
    codes, rows = [], []
    factor, start = 1.0 / resolution, 0
    for places in chunks():
        usable = _usable(places)
        index = np.floor((places[usable] - np.array(shift)) * factor).astype(np.int64)
        # Points on the octree's upper boundary due to rounding belong to its last voxel.
        np.clip(index, -HALF, HALF - 1, out=index)
        codes.append(morton(index[:, 0], index[:, 1], index[:, 2]))
        rows.append(start + np.flatnonzero(usable))
        start += len(places)
    code, colour = _merge_codes(np.concatenate(codes), rows, colours(cloud))
    depth = np.full(len(code), DEPTH, np.uint8)
    odds = np.full(len(code), LOG_ODDS[1], np.float32)
    return VoxelMap(resolution, depth, code, odds, colour, colour is None), placed, corner


def _place(
    cloud: Cloud, options: ReadOptions, context: ReadContext
) -> tuple[Array | None, dict[str, Any], Datum | None]:
    """Return the points in local metres, how they were placed, and the datum if the cloud sets one.

    The points are None if the file's coordinates are local metres.
    """
    frame, corner = context.frame, None
    local: Array | None = None
    placed: dict[str, Any] = {}
    crs, earth = _to_wgs84(cloud, options, context)
    if earth is not None:
        if frame is None:
            corner = _corner(earth)
            frame = local_frame(corner)
            context.warn(
                f"the environment has no datum; the cloud's south-west corner, latitude {corner.latitude!r}, longitude "
                f"{corner.longitude!r}, is used: upload a datum.yaml or PATCH the environment to set another"
            )
        local = frame.to_local(earth)
        placed |= {"crs": crs, "datum": frame.datum.as_dict()}
    elif cloud.units is not None and options.crs is None:
        context.warn(
            f"the file's CRS has no code, but units of {cloud.units[0]:.10g} m (x, y) and {cloud.units[1]:.10g} m (z): "
            "the points become local metres; set crs=EPSG:… to place them",
            where="crs",
        )
        local = _in_metres(cloud.places(0, len(cloud)), cloud.units)
        placed["units"] = list(cloud.units)
    return local, placed, corner


def _merge_codes(
    code: NDArray[np.uint64], rows: Sequence[NDArray[np.intp]], shade: NDArray[np.uint8] | None
) -> tuple[NDArray[np.uint64], NDArray[np.uint8] | None]:
    """Return unique codes, ascending, with the mean colour of their points."""
    if shade is None:
        return distinct(code), None
    order = np.argsort(code, kind="stable")
    code = code[order]
    first = np.flatnonzero(np.concatenate([[True], code[1:] != code[:-1]]))
    shade = shade[np.concatenate(rows)[order]]
    count = np.diff(first, append=len(code))
    mean = np.empty((len(first), 3), np.uint8)
    for k in range(3):
        mean[:, k] = np.add.reduceat(shade[:, k], first, dtype=np.int64) // count
    return code[first], mean


def _to_wgs84(cloud: Cloud, options: ReadOptions, context: ReadContext) -> tuple[str, Array | None]:
    """Return the CRS and the points' (longitude, latitude, height), or None without a supported CRS."""
    crs = options.crs or cloud.crs
    if crs is None or crs == "local" or not len(cloud):
        return "", None
    if options.crs is not None and not re.fullmatch(r"[A-Za-z]{2,10}:[0-9]{1,10}", options.crs):
        raise Invalid(f"crs must be a code like EPSG:32632, or 'local', got {options.crs[:80]!r}")
    try:
        earth = crs_to_wgs84(crs, cloud.places(0, len(cloud)))
    except Invalid as error:
        if options.crs is not None:
            raise
        context.warn(f"{error.detail}, with crs=…; until then the points are read as local metres", where="crs")
        return "", None
    if not np.isfinite(earth[:, :2]).all(axis=1).any():
        raise unreadable_error(
            f"all points are outside the area of the coordinate reference system {crs[:80]}", where="crs"
        )
    return crs, earth


def _in_metres(places: Array, units: Sequence[float]) -> Array:
    """Convert coordinates from the units of x and y, and of z."""
    return places * (units[0], units[0], units[1])


def _usable(places: Array) -> NDArray[np.bool_]:
    """Mark the points with valid coordinates."""
    return np.asarray((np.abs(places) <= MAX_METRES).all(axis=1))


def _corner(earth: Array) -> Datum:
    """Return the south-west corner of (longitude, latitude), rounded to 1e-7 degrees."""
    valid = np.isfinite(earth[:, :2]).all(axis=1)
    west, south = np.floor(earth[valid, :2].min(axis=0) * 1e7) / 1e7
    return Datum(float(np.clip(south, -MAX_DATUM_LATITUDE, MAX_DATUM_LATITUDE)), float(west))


def _fit_resolution(low: Array, high: Array, options: ReadOptions, context: ReadContext) -> tuple[float, Offset]:
    """Choose the resolution, and the offset subtracted from the points, so that they fit into the octree."""
    candidates = RESOLUTIONS if options.resolution is None else (options.resolution,)
    shift = np.zeros(3) if options.origin is None else np.array(options.origin)
    if options.origin is None and not _check_fit(low, high, candidates[0]):
        away = float(np.maximum(np.abs(low), np.abs(high))[:2].max())
        if away > FAR_RATIO * float((high - low).max()):
            shift[:2] = np.round((low + high)[:2] / 2)
            if not all(_check_fit(low[2:], high[2:], r) for r in candidates[:1]):
                shift[2] = np.round((low[2] + high[2]) / 2)
            context.warn(
                f"the points are up to {away:.0f} m from the origin, beyond the octree's ±{HALF * candidates[0]:g} m; "
                f"({', '.join(f'{v:.0f}' for v in shift)}) is used as the local origin of the voxels: set crs=EPSG:… "
                "or origin=x,y,z to place them"
            )
    for resolution in candidates:
        if _check_fit(low - shift, high - shift, resolution):
            if options.resolution is None and resolution != candidates[0]:
                context.warn(f"the cloud is too large for voxels of {candidates[0]:g} m; they have {resolution:g} m")
            return resolution, (float(shift[0]), float(shift[1]), float(shift[2]))
    need = float(np.maximum(np.abs(low - shift), np.abs(high - shift)).max()) / HALF
    raise unreadable_error(
        f"points exceed the range of voxels of {candidates[-1]:g} m, {HALF * candidates[-1]:g} m from the origin: set "
        f"resolution to at least {need:.3g}, or another origin",
        where="resolution",
    )


def _check_fit(low: Array, high: Array, resolution: float) -> bool:
    return bool((low >= -HALF * resolution).all() and (high < HALF * resolution).all())


def _fingerprint(voxels: VoxelMap) -> str:
    """Compute the fingerprint of the leaves made from a cloud."""
    digest = hashlib.sha256(repr(float(voxels.resolution)).encode())
    for column in (voxels.depth, voxels.code, voxels.log_odds, voxels.colour):
        digest.update(b"" if column is None else np.ascontiguousarray(column).data)
    return digest.hexdigest()[:32]


# --- meaning of columns -------------------------------------------------------------------------------------------
RGB = ("red", "green", "blue")
NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"))


def colours(cloud: Cloud) -> NDArray[np.uint8] | None:
    """Return red, green and blue of each point as uint8 [n, 3], or None if the cloud has none.

    PCL packs them into one number of four bytes of any type (``rgb``, ``rgba``: blue in the lowest byte); PLY has one
    byte each, or floats of 0…1; LAS has 16 bits each, in some files with values of 8 bits.
    """
    packed = next((c for name in ("rgb", "rgba") if (c := cloud.columns.get(name)) is not None), None)
    if packed is not None and packed.ndim == 1 and packed.dtype.itemsize == 4:
        number = np.ascontiguousarray(packed).view(np.uint32)
        return np.stack([(number >> np.uint32(s) & np.uint32(255)).astype(np.uint8) for s in (16, 8, 0)], axis=1)
    if any(name not in cloud.columns or cloud.columns[name].ndim != 1 for name in RGB):
        return None
    out = np.empty((len(cloud), 3), np.uint8)
    channels = [cloud.columns[name] for name in RGB]
    wide = any(c.dtype.itemsize > 1 and c.size and c.dtype.kind in "ui" and int(c.max()) > 255 for c in channels)
    for k, column in enumerate(channels):
        if column.dtype.kind == "f":
            out[:, k] = np.round(np.clip(np.nan_to_num(column, nan=0.0), 0.0, 1.0) * 255)
        else:
            out[:, k] = np.clip(column >> 8 if wide else column, 0, 255)
    return out


def plain(cloud: Cloud) -> dict[str, NDArray[Any]]:
    """Convert to columns with common names and one value per point.

    x, y, z, then nx, ny, nz and red, green, blue (uint8) if present, then the others with their names; ``name_0`` … for
    columns with several values per point.
    """
    out = {axis: cloud.columns[axis] for axis in AXES}
    used = set(AXES)
    for names in NORMALS:
        if all(name in cloud.columns and cloud.columns[name].ndim == 1 for name in names):
            out |= dict(zip(NORMALS[0], (cloud.columns[name] for name in names), strict=True))
            used.update(names)
            break
    shade = colours(cloud)
    if shade is not None:
        out |= {name: shade[:, k] for k, name in enumerate(RGB)}
        if "rgb" in cloud.columns or "rgba" in cloud.columns:
            name = "rgb" if "rgb" in cloud.columns else "rgba"
            used.add(name)
            if name == "rgba":
                alpha = np.ascontiguousarray(cloud.columns[name]).view(np.uint32) >> np.uint32(24)
                out["alpha"] = alpha.astype(np.uint8)
        used.update(RGB)
    for name, column in cloud.columns.items():
        if name in used:
            continue
        if column.ndim == 1:
            out[name] = column
        else:
            out |= {f"{name}_{k}": column[:, k] for k in range(column.shape[1])}
    return out


# --- voxels -> points ---------------------------------------------------------------------------------------------
Frame = Literal["source", "local"]

FRAME_DOC = (
    "source: coordinates as uploaded; local: metres in the local frame; default: source in the uploaded format, "
    "local in others"
)
NAME_DOC = "name of the voxel map; *: all; default: map, else the only one"
LEVEL_DOC = "level of the voxel map; *: all; default: ground, or the only one that has it"

MAX_POINTS = 2**25
"""Maximum number of points generated from voxels."""


@dataclass(frozen=True, slots=True)
class CloudToWrite:
    """Cloud to write. data: the uploaded file if it can be exported unchanged; ``cloud()`` returns the points."""

    cloud: Callable[[], Cloud]
    data: bytes | None
    form: str
    local: bool


def source(
    layers: Layers,
    context: WriteContext,
    name: str | None,
    level: str | None,
    frame: Frame | None,
    forms: Sequence[str],
    parsers: Mapping[str, Parse],
) -> CloudToWrite:
    """Return the points of a voxel map: those of its source file, else the centres of its occupied voxels.

    forms: extensions of the requested format. Raises MissingLayer, NotFound, Ambiguous, or Invalid for too many points.
    """
    keys = choose(sorted(layers.parts_of("voxels")), name, level)
    voxels = layers.parts[keys[0]]
    if not isinstance(voxels, VoxelMap):
        raise AssertionError(f"{keys[0]} is not a voxel map")
    source_properties = voxels.properties.get(PROPERTY)
    data = _stored_file(layers, keys[0], voxels, source_properties) if isinstance(source_properties, Mapping) else None
    if data is None or not isinstance(source_properties, Mapping):
        if frame == "source":
            raise Invalid(
                "frame=source requires an uploaded cloud, but this voxel map was not made from one: use frame=local"
            )
        return CloudToWrite(lambda: centres(voxels, context), None, "", local=True)
    form = str(source_properties["file"]).rpartition(".")[2]
    moved = any(name in source_properties for name in ("crs", "units", "origin"))
    local = moved and (frame == "local" or (frame is None and form not in forms))
    if moved and not local:
        context.warn("the points have the coordinates of the upload; frame=local converts them to the local frame")
    same_form = form in forms and not local
    parse = parsers[form]

    def load() -> Cloud:
        cloud = parse(data, ReadContext(limits=_NO_LIMITS))
        return _to_local(cloud, source_properties, context) if local else cloud

    return CloudToWrite(load, data if same_form else None, form, local)


_NO_LIMITS = Limits(voxels=2**62, text_bytes=2**62, unpacked_bytes=2**62)
"""Limits for stored files: the settings may have changed since their upload."""


def choose(keys: Sequence[PartKey], name: str | None, level: str | None) -> list[PartKey]:
    """Choose the requested voxel map and its file."""
    supply = "upload one (a point cloud or an OctoMap file)"
    matches = select_part(keys, "voxels", name, level, noun="voxel map", option="name", supply=supply)
    belongs = [PartKey("resources", key.level, cloud_name(key.name)) for key in matches]
    return [*matches, *(key for key in keys if key in belongs)]


def _stored_file(layers: Layers, key: PartKey, voxels: VoxelMap, source_properties: Mapping[str, Any]) -> bytes | None:
    """Return the source file of a voxel map, if it is stored and its fingerprint matches the leaves."""
    part = layers.parts.get(PartKey("resources", key.level, cloud_name(key.name)))
    data = part.files.get(str(source_properties.get("file"))) if isinstance(part, Resources) else None
    if data is None or source_properties.get("leaves") != _fingerprint(voxels):
        return None
    return data if hashlib.sha256(data).hexdigest() == source_properties.get("sha256") else None


def _to_local(cloud: Cloud, source_properties: Mapping[str, Any], context: WriteContext) -> Cloud:
    """Convert points to the local frame, as for the voxels; normals are rotated, too."""
    columns = dict(cloud.columns)
    places = cloud.places(0, len(cloud))
    normals = next((n for n in NORMALS if all(name in columns and columns[name].ndim == 1 for name in n)), None)
    if "crs" in source_properties:
        frame = local_frame(Datum(**source_properties["datum"]))
        if normals is not None:
            _turn(columns, normals, places, str(source_properties["crs"]), frame)
        places = frame.to_local(crs_to_wgs84(str(source_properties["crs"]), places))
    elif "units" in source_properties:
        places = _in_metres(places, source_properties["units"])
    places = places - np.array(source_properties.get("origin", (0.0, 0.0, 0.0)))
    columns |= {axis: places[:, k] for k, axis in enumerate(AXES)}
    if cloud.viewpoint != IDENTITY_VIEWPOINT:
        context.drop("viewpoint", 1, "it has the coordinates of the source: request it with frame=source")
    return Cloud(columns, cloud.width, cloud.height, comments=cloud.comments, further=cloud.further)


def _turn(columns: dict[str, NDArray[Any]], names: Sequence[str], places: Array, crs: str, frame: LocalFrame) -> None:
    """Rotate normals of a projected CRS about the vertical to the local frame, by the angle at the cloud's centre."""
    finite = places[np.isfinite(places).all(axis=1)]
    if not len(finite):
        return
    middle = (finite.min(axis=0) + finite.max(axis=0)) / 2
    step = np.array([middle, middle + np.array([1.0, 0.0, 0.0])])
    a, b = frame.to_local(crs_to_wgs84(crs, step))
    angle = math.atan2(b[1] - a[1], b[0] - a[0])
    x, y = (columns[name].astype(np.float64) for name in names[:2])
    columns[names[0]] = x * math.cos(angle) - y * math.sin(angle)
    columns[names[1]] = x * math.sin(angle) + y * math.cos(angle)


def centres(voxels: VoxelMap, context: WriteContext) -> Cloud:
    """Return the centres of all occupied smallest voxels, in ascending order of their codes, with their colours.

    float32: accurate to a hundredth of a voxel in the whole octree. Raises Invalid if there are more than MAX_POINTS.
    """
    counts = voxels.voxel_counts()
    if counts["occupied"] > MAX_POINTS:
        raise Invalid(
            f"the {counts['occupied']} occupied voxels give more than {MAX_POINTS} points: request octomap with a "
            "depth or a bbox instead"
        )
    context.drop("free voxels", voxels.leaf_counts()["free"], "a cloud has points for occupied voxels only")
    if not voxels.binary:
        other = int(np.count_nonzero(voxels.log_odds[voxels.occupied] != LOG_ODDS[1]))
        context.drop("log-odds", other, "a point has no probability")
    code, rows = expand_leaves(voxels, voxels.occupied)
    smallest = VoxelMap(
        voxels.resolution, np.full(len(code), DEPTH, np.uint8), code, np.zeros(len(code), np.float32), None
    )
    columns: dict[str, NDArray[Any]] = {
        axis: ((smallest.axis(k)[0] + 0.5) * voxels.resolution).astype(np.float32) for k, axis in enumerate(AXES)
    }
    if voxels.colour is not None:
        shade = voxels.colour[rows]
        columns |= {name: np.ascontiguousarray(shade[:, k]) for k, name in enumerate(RGB)}
    return Cloud(columns, len(code))


def file_name(name: str | None, ending: str) -> str:
    """Return ``map.pcd``, or a file name from the requested name."""
    return f"{file_stem(name or MAP)}.{ending}"


PARTS = Parts("voxels", "name", file_stem)


def options_from_filename(endings: Sequence[str]) -> Callable[[str], dict[str, str]]:
    """Create a parser of file names: ``lab.pcd`` selects the voxel map ``lab``."""

    def parse_name(name: str) -> dict[str, str]:
        stem, _, end = name.rpartition(".")
        if not stem or end not in endings:
            return {}
        return {} if stem == MAP else {"name": stem}

    return parse_name

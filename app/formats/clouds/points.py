"""Point clouds and voxels: what ``pcd``, ``ply`` and ``las`` share.

A cloud becomes the voxels that its points lie in, all of them occupied; a voxel's colour is the mean of its points'.
The file itself is kept beside the voxels, byte for byte, as a resource, and the voxel map says which one it is and of
which leaves it tells (``properties.points``). So the same format gives the same points back, the other cloud formats
give them too, and the file is never served for voxels that it did not make: neither after another upload of that name
nor after a change of the leaves.

Frame of the voxels: local. Points of a known CRS (a LAS file names its own) come there by the environment's datum;
others are taken as local metres. A cloud that lies far beyond the octree (UTM coordinates without a CRS) is moved to
the origin by whole metres, with a warning.
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
from app.model.frame import MAX_DATUM_LATITUDE, Datum
from app.model.geodesy import LocalFrame, crs_to_wgs84, local_frame
from app.model.layers import MAP, Layers, Part, PartKey, Resources, cloud_name
from app.model.voxels import DEPTH, HALF, LOG_ODDS, VoxelMap, expand_leaves, morton
from app.parameters import parameter

PROPERTY = "points"
"""Where a voxel map says which file its leaves were made of."""

RESOLUTIONS = tuple(digit * 10.0**power for power in range(-2, 4) for digit in (1, 2, 5))[2:]
"""Metres: 0.05 is the default, the next ones are for clouds that it does not reach around."""

FAR_RATIO = 10.0
"""A cloud lies far away where it is so many times farther from the origin than it is long."""

MAX_METRES = 1e9
"""Metres: numbers beyond are marks for "no return", not places."""

CHUNK = 2**20
"""Points that are looked at at once: bounded memory beside the file's own."""

IDENTITY_VIEWPOINT = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)
"""The viewpoint of a cloud that says nothing of it: at the origin, not turned."""

AXES = ("x", "y", "z")
Array = NDArray[np.float64]
Offset = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """How points become voxels."""

    resolution: float | None = parameter(
        None,
        "edge of a voxel; default: 0.05, or the next of 0.1, 0.2, 0.5 … with which the cloud fits into the tree",
        minimum=1e-3,
        maximum=1e4,
        unit="m",
    )
    origin: tuple[float, float, float] | None = parameter(
        None, "x,y,z of the file that are the local origin: they are subtracted from every point", unit="m"
    )
    crs: str | None = parameter(
        None,
        "coordinate reference system of the points, as EPSG:32632; 'local' for local metres whatever the file says; "
        "default: what the file says, else local metres",
    )


@dataclass(frozen=True, slots=True)
class Cloud:
    """n points: named columns in the file's order, float or integer [n] or [n, count]; x, y and z are among them.

    width, height: of an organised cloud, width · height = n; else n and 1. viewpoint: x, y, z and the quaternion w, x,
    y, z of the sensor. comments: lines of text. further: what else the file holds, by name and count. crs: as the file
    tells it (a code or WKT).
    """

    columns: Mapping[str, NDArray[Any]]
    width: int
    height: int = 1
    viewpoint: tuple[float, ...] = IDENTITY_VIEWPOINT
    comments: tuple[str, ...] = ()
    further: Mapping[str, int] = field(default_factory=dict)
    crs: str | None = None

    def __len__(self) -> int:
        return len(self.columns["x"])

    def places(self, start: int, stop: int) -> Array:
        """Coordinates of some points, metres or as the CRS has them: float64 [m, 3]."""
        return np.stack([self.columns[axis][start:stop].astype(np.float64) for axis in AXES], axis=1)


Parse = Callable[[bytes, ReadContext], Cloud]


def unreadable_error(reason: str, line: int | None = None, where: str | None = None) -> UnreadableFile:
    """A file that cannot be read, and where."""
    return UnreadableFile(reason, [Problem(reason, line=line, where=where)])


def check_count(count: int, context: ReadContext) -> None:
    """TooLarge for more points than an upload may have: as many as voxels, of which each point makes one at most."""
    if count > context.limits.voxels:
        raise TooLarge(f"the cloud has {count} points; the limit is {context.limits.voxels}")


def check_columns(columns: Mapping[str, NDArray[Any]]) -> None:
    """UnreadableFile where a coordinate is missing."""
    missing = [axis for axis in AXES if axis not in columns or columns[axis].ndim != 1]
    if missing:
        raise unreadable_error(
            f"points need x, y and z with one value each; missing: {', '.join(missing)}", where=missing[0]
        )


def table(
    text: bytes, dtype: np.dtype[Any], rows: int, first_line: int, skip: int = 0, *, alone: bool = True
) -> NDArray[Any]:
    """Rows of numbers separated by blanks: structured [rows].

    dtype: packed fields without shapes, a column each. first_line: the text's line in its file, from 1. skip: lines
    before the rows. alone: nothing else follows, so that one row more is given where there is one. Raises
    UnreadableFile with the line.
    """

    if not rows:
        return np.empty(0, dtype)
    if text.count(b"\n", 0, len(text)) + 1 < rows:  # cheaper than to find out row by row
        raise unreadable_error(f"the header says {rows} points, the file has fewer lines", first_line)
    try:
        out = np.loadtxt(io.BytesIO(text), dtype, comments=None, skiprows=skip, max_rows=rows + alone, ndmin=1)
    except (ValueError, OverflowError) as error:
        match = re.search(r"at row (\d+)", str(error))
        # NumPy counts rows from 0 where a value is wrong, from 1 where there are too many or too few.
        line = first_line + skip + int(match[1]) - (" columns " in str(error)) if match else None
        reason = str(error).partition(";")[0][:200]
        raise unreadable_error(f"a row of numbers cannot be read: {reason}", line) from error
    if len(out) < rows:
        raise unreadable_error(f"the header says {rows} points, the file has {len(out)} rows", first_line)
    return np.asarray(out)


# --- points -> voxels ---------------------------------------------------------------------------------------------
def read(files: Files, context: ReadContext, form: str, parse: Parse) -> Layers:
    """A voxel map, and the file as the resource that belongs to it.

    Raises UnreadableFile, TooLarge, or Invalid for a CRS that does not exist.
    """
    main = context.main or next(iter(files))
    data = files[main]
    if not context.wants("voxels") and not context.wants("resources"):
        return Layers()
    options = context.options if isinstance(context.options, ReadOptions) else ReadOptions()
    cloud = parse(data, context)
    name = context.grid or main.rpartition("/")[2].rpartition(".")[0] or MAP
    if cloud.viewpoint[3:] != (1.0, 0.0, 0.0, 0.0):
        context.warn("the VIEWPOINT turns the cloud: it is kept, and the points are taken as they stand")
    for noun, count in cloud.further.items():
        context.warn(f"{count} × {noun}: kept with the file, only the points become voxels", where=noun)
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
    """The voxels, how the points came to their places, and the datum where the cloud brought one."""
    frame, corner = context.frame, None
    local: Array | None = None
    placed: dict[str, Any] = {}
    crs, earth = _to_wgs84(cloud, options, context)
    if earth is not None:
        if frame is None:
            corner = _corner(earth)
            frame = local_frame(corner)
            context.warn(
                f"the environment has no datum: the cloud's south-west corner, latitude {corner.latitude!r}, longitude "
                f"{corner.longitude!r}, is taken; upload a datum.yaml or PATCH the environment to set another"
            )
        local = frame.to_local(earth)
        placed |= {"crs": crs, "datum": frame.datum.as_dict()}
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
        context.warn(f"{n - finite} of {n} points have no coordinates of a place: kept with the file, no voxels")
    if not finite:
        context.warn("the cloud has no points with coordinates")
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
        # What lies on the tree's far side by the rounding of a product belongs to its last voxel.
        np.clip(index, -HALF, HALF - 1, out=index)
        codes.append(morton(index[:, 0], index[:, 1], index[:, 2]))
        rows.append(start + np.flatnonzero(usable))
        start += len(places)
    code, colour = _merge_codes(np.concatenate(codes), rows, colours(cloud))
    depth = np.full(len(code), DEPTH, np.uint8)
    odds = np.full(len(code), LOG_ODDS[1], np.float32)
    return VoxelMap(resolution, depth, code, odds, colour, colour is None), placed, corner


def _merge_codes(
    code: NDArray[np.uint64], rows: Sequence[NDArray[np.intp]], shade: NDArray[np.uint8] | None
) -> tuple[NDArray[np.uint64], NDArray[np.uint8] | None]:
    """Each code once, ascending, with the mean colour of its points."""
    if shade is None:
        code = np.sort(code)
        return code[np.concatenate([[True], code[1:] != code[:-1]])], None  # np.unique takes a hundred times as long
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
    """The CRS and the points' (longitude, latitude, height), where there is a CRS that is known."""
    crs = options.crs or cloud.crs
    if crs is None or crs == "local" or not len(cloud):
        return "", None
    if options.crs is not None and not re.fullmatch(r"[A-Za-z]{2,10}:[0-9]{1,10}", options.crs):
        raise Invalid(f"crs must be a code like EPSG:32632, or 'local'; got {options.crs[:80]!r}")
    try:
        earth = crs_to_wgs84(crs, cloud.places(0, len(cloud)))
    except Invalid as error:
        if options.crs is not None:
            raise
        context.warn(f"{error.detail}, with crs=…; until then the points are taken as local metres", where="crs")
        return "", None
    if not np.isfinite(earth[:, :2]).all(axis=1).any():
        raise unreadable_error(
            f"none of the points lies where the coordinate reference system {crs[:80]} has places", where="crs"
        )
    return crs, earth


def _usable(places: Array) -> NDArray[np.bool_]:
    """Which points have a place."""
    return np.asarray((np.abs(places) <= MAX_METRES).all(axis=1))


def _corner(earth: Array) -> Datum:
    """The south-west corner of (longitude, latitude), to a ten-millionth of a degree."""
    valid = np.isfinite(earth[:, :2]).all(axis=1)
    west, south = np.floor(earth[valid, :2].min(axis=0) * 1e7) / 1e7
    return Datum(float(np.clip(south, -MAX_DATUM_LATITUDE, MAX_DATUM_LATITUDE)), float(west))


def _fit_resolution(low: Array, high: Array, options: ReadOptions, context: ReadContext) -> tuple[float, Offset]:
    """Resolution, and what is subtracted from the points, so that their box lies in the tree."""
    candidates = RESOLUTIONS if options.resolution is None else (options.resolution,)
    shift = np.zeros(3) if options.origin is None else np.array(options.origin)
    if options.origin is None and not _check_fit(low, high, candidates[0]):
        away = float(np.maximum(np.abs(low), np.abs(high))[:2].max())
        if away > FAR_RATIO * float((high - low).max()):
            shift[:2] = np.round((low + high)[:2] / 2)
            if not all(_check_fit(low[2:], high[2:], r) for r in candidates[:1]):
                shift[2] = np.round((low[2] + high[2]) / 2)
            context.warn(
                f"the points lie up to {away:.0f} m from the origin, beyond the octree's ±{HALF * candidates[0]:g} m: "
                f"for the voxels ({', '.join(f'{v:.0f}' for v in shift)}) is taken as the local origin; say crs=EPSG:… "
                "or origin=x,y,z to place them"
            )
    for resolution in candidates:
        if _check_fit(low - shift, high - shift, resolution):
            if options.resolution is None and resolution != candidates[0]:
                context.warn(f"the cloud is too large for voxels of {candidates[0]:g} m: they have {resolution:g} m")
            return resolution, (float(shift[0]), float(shift[1]), float(shift[2]))
    need = float(np.maximum(np.abs(low - shift), np.abs(high - shift)).max()) / HALF
    raise unreadable_error(
        f"voxels of {candidates[-1]:g} m reach {HALF * candidates[-1]:g} m from the origin, the points go beyond: set "
        f"resolution to {need:.3g} or more, or another origin",
        where="resolution",
    )


def _check_fit(low: Array, high: Array, resolution: float) -> bool:
    return bool((low >= -HALF * resolution).all() and (high < HALF * resolution).all())


def _fingerprint(voxels: VoxelMap) -> str:
    """Which leaves a cloud was made into."""
    digest = hashlib.sha256(repr(float(voxels.resolution)).encode())
    for column in (voxels.depth, voxels.code, voxels.log_odds, voxels.colour):
        digest.update(b"" if column is None else np.ascontiguousarray(column).data)
    return digest.hexdigest()[:32]


# --- meaning of columns -------------------------------------------------------------------------------------------
RGB = ("red", "green", "blue")
NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"))


def colours(cloud: Cloud) -> NDArray[np.uint8] | None:
    """Red, green and blue of each point: uint8 [n, 3]; None where the cloud has none.

    PCL packs them into one number of four bytes (``rgb``, ``rgba``: blue in the lowest), whatever its type says; PLY
    has one byte each, or floats of 0…1; LAS 16 bits each, or a byte's values by mistake.
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
    """The columns under the names that most tools know, one value a point each: x, y, z, then nx, ny, nz and red,
    green, blue (uint8) where there are any, then the others as they are called; ``name_0`` … of one with several."""
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
    "source: coordinates as uploaded; local: metres in the local frame; default: source in the format that was "
    "uploaded, local in others"
)
NAME_DOC = "name of the voxel map; *: all; default: map, else the only one"
LEVEL_DOC = "level of the voxel map; *: all; default: the one it is on"

MAX_POINTS = 2**25
"""Points that voxels are made into at most."""


@dataclass(frozen=True, slots=True)
class CloudToWrite:
    """What is to be written. data: the uploaded file where it can be served as it is; ``cloud()`` are the points."""

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
    """The points behind a voxel map: those of the file it was made of, else the centres of its occupied voxels.

    forms: endings of the wanted format. Raises MissingLayer, NotFound, Ambiguous, or Invalid for too many points.
    """
    keys = choose(sorted(layers.parts_of("voxels")), name, level)
    voxels = layers.parts[keys[0]]
    if not isinstance(voxels, VoxelMap):
        raise AssertionError(f"{keys[0]} is no voxel map")
    source_properties = voxels.properties.get(PROPERTY)
    data = _stored_file(layers, keys[0], voxels, source_properties) if isinstance(source_properties, Mapping) else None
    if data is None or not isinstance(source_properties, Mapping):
        if frame == "source":
            raise Invalid("frame=source asks for an uploaded cloud, and this voxel map was not made of one")
        return CloudToWrite(lambda: centres(voxels, context), None, "", local=True)
    form = str(source_properties["file"]).rpartition(".")[2]
    moved = "crs" in source_properties or "origin" in source_properties
    local = moved and (frame == "local" or (frame is None and form not in forms))
    if moved and not local:
        context.warn("the points stand in the coordinates they came in: ask with frame=local for the local frame")
    same_form = form in forms and not local
    parse = parsers[form]

    def load() -> Cloud:
        cloud = parse(data, ReadContext(limits=_NO_LIMITS))
        return _to_local(cloud, source_properties, context) if local else cloud

    return CloudToWrite(load, data if same_form else None, form, local)


_NO_LIMITS = Limits(voxels=2**62, text_bytes=2**62, unpacked_bytes=2**62)
"""For files that were taken in: limits may have changed since."""


def choose(keys: Sequence[PartKey], name: str | None, level: str | None) -> list[PartKey]:
    """The voxel map that is asked for, and the file that belongs to it."""
    supply = "upload one (a point cloud or an OctoMap file)"
    matches = select_part(keys, "voxels", name, level, noun="voxel map", option="name", supply=supply)
    belongs = [PartKey("resources", key.level, cloud_name(key.name)) for key in matches]
    return [*matches, *(key for key in keys if key in belongs)]


def _stored_file(layers: Layers, key: PartKey, voxels: VoxelMap, source_properties: Mapping[str, Any]) -> bytes | None:
    """The file that a voxel map was made of, if it is there and tells of these very leaves."""
    part = layers.parts.get(PartKey("resources", key.level, cloud_name(key.name)))
    data = part.files.get(str(source_properties.get("file"))) if isinstance(part, Resources) else None
    if data is None or source_properties.get("leaves") != _fingerprint(voxels):
        return None
    return data if hashlib.sha256(data).hexdigest() == source_properties.get("sha256") else None


def _to_local(cloud: Cloud, source_properties: Mapping[str, Any], context: WriteContext) -> Cloud:
    """The points in the local frame, as they were when they became voxels; normals turn along."""
    columns = dict(cloud.columns)
    places = cloud.places(0, len(cloud))
    normals = next((n for n in NORMALS if all(name in columns and columns[name].ndim == 1 for name in n)), None)
    if "crs" in source_properties:
        frame = local_frame(Datum(**source_properties["datum"]))
        if normals is not None:
            _turn(columns, normals, places, str(source_properties["crs"]), frame)
        places = frame.to_local(crs_to_wgs84(str(source_properties["crs"]), places))
    places = places - np.array(source_properties.get("origin", (0.0, 0.0, 0.0)))
    columns |= {axis: places[:, k] for k, axis in enumerate(AXES)}
    if cloud.viewpoint != IDENTITY_VIEWPOINT:
        context.drop("viewpoint", 1, "it stands in the coordinates of the source: ask with frame=source")
    return Cloud(columns, cloud.width, cloud.height, comments=cloud.comments, further=cloud.further)


def _turn(columns: dict[str, NDArray[Any]], names: Sequence[str], places: Array, crs: str, frame: LocalFrame) -> None:
    """Normals of a projected CRS about the vertical into the local frame, by the angle in the cloud's middle."""
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
    """The centres of all occupied smallest voxels, in ascending order of their place, with their colours.

    float32: to within a hundredth of a voxel everywhere in the tree. Raises Invalid where there are more than MOST.
    """
    counts = voxels.voxel_counts()
    if counts["occupied"] > MAX_POINTS:
        raise Invalid(
            f"the {counts['occupied']} occupied voxels would be more than {MAX_POINTS} points: ask for octomap with a "
            "depth or a bbox instead"
        )
    context.drop("free voxels", voxels.leaf_counts()["free"], "a cloud has points where something is only")
    if not voxels.binary:
        other = int(np.count_nonzero(voxels.log_odds[voxels.occupied] != LOG_ODDS[1]))
        context.drop("log-odds", other, "a point is there or not")
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
    """``map.pcd``, or the asked for name's."""
    return f"{file_stem(name or MAP)}.{ending}"


PARTS = Parts("voxels", "name", file_stem)


def options_from_filename(endings: Sequence[str]) -> Callable[[str], dict[str, str]]:
    """``lab.pcd`` asks for the voxel map ``lab``."""

    def parse_name(name: str) -> dict[str, str]:
        stem, _, end = name.rpartition(".")
        if not stem or end not in endings:
            return {}
        return {} if stem == MAP else {"name": stem}

    return parse_name

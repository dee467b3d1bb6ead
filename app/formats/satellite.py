"""Georeferenced images: GeoTIFF, PNG and JPEG with a world file, images with given corners, floor plans.

A GeoTIFF contains its position. A world file (.pgw, .jgw, .tfw, .wld) has six lines A, D, B, E, C, F: x = A·column +
B·row + C and y = D·column + E·row + F for the *centre* of a pixel (the rule of ESRI and GDAL); the CRS is in a .prj or
.aux.xml beside it. ``corners`` are [latitude, longitude]. Pixels are stored unchanged; they are resampled only if a
request selects another CRS (``app.model.resampling``). Written: a cloud optimized GeoTIFF, or PNG with a world file.

Coordinates without a CRS are read as degrees if plausible (pixels of at most 0.0002°, about 20 m, within the degrees
of the globe), else as metres of the local frame; both with a warning.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from app.errors import Invalid, Problem, TooLarge, UnreadableFile
from app.formats import Claims, Files, Format, LayerRequirements, Parts, ReadContext, Selection, WriteContext, register
from app.formats._select import file_stem, select_part
from app.limits import Limits
from app.model.frame import MAX_METRES, is_writable
from app.model.geodesy import WGS84, LocalFrame
from app.model.georeference import to_earth, to_local
from app.model.imagery import DEFAULT_COLOURS, LOCAL, Affine, GeoImage, display_pixels, pixel_positions
from app.model.layers import Layers, PartKey
from app.model.resampling import resample
from app.parameters import parameter
from app.syntax import geotiff, images, xml
from app.syntax.decimals import DEGREES, METRES

NAME = "satellite"
TIFF_ENDS = (".tif", ".tiff")
IMAGE_ENDS = (".png", ".jpg", ".jpeg", ".bmp", *TIFF_ENDS)
WORLD_ENDS = {
    ".pgw": (".png",),
    ".pngw": (".png",),
    ".jgw": (".jpg", ".jpeg"),
    ".jpgw": (".jpg", ".jpeg"),
    ".jpegw": (".jpeg", ".jpg"),
    ".bpw": (".bmp",),
    ".bmpw": (".bmp",),
    ".tfw": TIFF_ENDS,
    ".tifw": TIFF_ENDS,
    ".tiffw": TIFF_ENDS,
    ".wld": IMAGE_ENDS,
}
"""Extensions of the images that belong to a world file, by its own extension."""

MAX_WORLD = 4096
MAX_SIDECAR = 2**20
DEGREE_PIXEL = 2e-4
"""Largest pixel size read as degrees (20 m on earth). A plan in metres has pixels of 0.001 to 1."""

HOW_TO_SUPPLY = (
    "no position for the image: add a world file (.pgw, .jgw, .tfw), or set corners=lat,lon,… of two opposite "
    "or all four corners, or, for a floor plan, metres_per_pixel with origin and yaw"
)
NO_PLACE = (
    "its coordinates are metres of the local frame, an engineering CRS without a position on earth: set a datum for one"
)
_NUMBER = re.compile(rb"[-+]?(\d+\.?\d*|\.\d+)([eEdD][-+]?\d+)?|[-+]?(nan|inf(inity)?)", re.IGNORECASE)


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """Position of an image that does not contain one."""

    crs: str | None = parameter(
        None, "CRS of an image or world file that names none: EPSG:<number>, wgs84 (longitude, latitude) or local"
    )
    corners: tuple[float, ...] | None = parameter(
        None,
        "lat,lon of two opposite corners, or of all four in the order upper left, upper right, lower right, "
        "lower left; for an image without a position",
    )
    metres_per_pixel: float | None = parameter(
        None,
        "pixel size of a floor plan without a position",
        minimum=1e-5,
        maximum=1e4,
        unit="m",
    )
    origin: tuple[float, float] = parameter(
        (0.0, 0.0), "x,y of a floor plan's lower left corner in the local frame", unit="m"
    )
    yaw: float = parameter(0.0, "rotation of a floor plan about its origin, counter-clockwise", unit="rad")
    picture: str | None = parameter(None, "name to store the image under; default: the file's name")
    file: str | None = parameter(None, "file that the options apply to, if several images are uploaded")


@dataclass(frozen=True, slots=True)
class WriteOptions:
    """Image to write, and its encoding."""

    picture: str | None = parameter(None, "name of the image; *: all; default: satellite, else the only one")
    level: str | None = parameter(None, "level of the image; *: all; default: ground, or the only one that has it")
    file_type: Literal["tif", "png"] | None = parameter(
        None, "tif: a cloud optimized GeoTIFF with everything (default); png: 8 bit with a world file"
    )
    crs: Literal["source", "local", "wgs84"] = parameter(
        "source",
        "source: original pixels and CRS; local or wgs84: resampled to metres of the local frame or to degrees",
    )
    resolution: float | None = parameter(
        None, "pixel size to resample to, in metres or degrees of the CRS", minimum=1e-9, maximum=1e6
    )
    resampling: Literal["nearest", "bilinear", "cubic"] | None = parameter(
        None, "interpolation between pixels; default: bilinear, nearest for palettes"
    )


# --- detection ----------------------------------------------------------------------------------------------------
def detect(name: str, data: bytes) -> bool:
    """Detect a GeoTIFF or a world file. An image alone may show anything."""
    end = _world_file_ending(name)
    if end is None:
        return geotiff.is_georeferenced(data)
    if len(data) > MAX_WORLD or b"\0" in data:
        return False
    return end != ".wld" or (len(data.split()) >= 6 and all(map(_NUMBER.fullmatch, data.split()[:6])))


def yields(name: str) -> bool:
    """Whether the file is a world file, which only describes its image."""
    return _world_file_ending(name) is not None


def lacking(name: str, data: bytes) -> str:
    """Return what to add to an image without a position; else an empty text."""
    del name
    return HOW_TO_SUPPLY if _is_picture(data) and not geotiff.is_georeferenced(data) else ""


def _is_picture(data: bytes) -> bool:
    return images.detect_kind(data) in ("png", "jpeg", "bmp") or geotiff.is_tiff(data)


def _world_file_ending(name: str) -> str | None:
    end = name.rpartition("/")[2].lower().rpartition(".")
    return "." + end[2] if end[1] and "." + end[2] in WORLD_ENDS else None


def companions(main: str, data: bytes, names: Sequence[str]) -> Iterable[str]:
    """Return a world file's image or an image's world file, and the .prj and .aux.xml beside them."""
    del data
    by_lower = _by_lower_case(tuple(names))
    lower = main.lower()
    stem = lower.rpartition(".")[0]
    end = _world_file_ending(main)
    if end is not None:
        picture = next((stem + e for e in WORLD_ENDS[end] if stem + e in by_lower), None)
        candidates = [picture] if picture else []
    else:
        picture = lower
        endings = [w for w, ends in WORLD_ENDS.items() if lower.endswith(ends)]
        candidates = [world for w in endings for world in (stem + w, lower + "w") if world in by_lower][:1]
    candidates += [stem + ".prj", stem + ".aux.xml"] + ([picture + ".aux.xml"] if picture else [])
    return [by_lower[n] for n in dict.fromkeys(candidates) if n in by_lower and by_lower[n] != main]


@lru_cache(maxsize=4)
def _by_lower_case(names: tuple[str, ...]) -> dict[str, str]:
    """Map lower-case names to names, the first of those that differ only in case.

    Cached, since it is called for every image of an upload.
    """
    by_lower: dict[str, str] = {}
    for name in names:
        by_lower.setdefault(name.lower(), name)
    return by_lower


# --- reading ------------------------------------------------------------------------------------------------------
def read(files: Files, context: ReadContext) -> Layers:
    """Read one image. Raises UnreadableFile (with file and reason), TooLarge, or Invalid for invalid options."""
    main = context.main or next(iter(files))
    options = context.options if isinstance(context.options, ReadOptions) else ReadOptions()
    _check_options(options)
    world = next((n for n in files if _world_file_ending(n) is not None), None)
    image = main if _world_file_ending(main) is None else next((n for n in files if _is_picture(files[n])), None)
    if image is None:
        stem, end = main.rpartition(".")[0], WORLD_ENDS[_world_file_ending(main) or ".wld"]
        reason = f"the upload lacks the image of this world file: add {stem.rpartition('/')[2]}{end[0]} beside it"
        raise UnreadableFile(f"{main}: {reason}", [Problem(reason, main)])
    if not _is_picture(files[image]):
        reason = "not a TIFF, PNG, JPEG or BMP image: its first bytes do not match"
        raise UnreadableFile(f"{image}: {reason}", [Problem(reason, image)])
    if not context.wants("imagery"):
        return Layers()
    try:
        raster = _decode(files[image], context.limits)
    except (UnreadableFile, TooLarge) as error:
        raise type(error)(f"{image}: {error.detail}", [Problem(error.detail, image)]) from error
    for doubt in raster.doubts:
        context.warn(doubt, file=image)
    if raster.crs is None:
        raster = _with_sidecar(raster, files, context)
    transform, crs = _place(raster, image, world, files, options, context)
    if raster.is_local and context.frame is not None and crs != LOCAL:
        height, width = raster.pixels.shape[:2]
        metres = to_local(transform, crs, (width, height), context.frame)
        transform, crs = (transform, crs) if metres is None else (metres, LOCAL)
    try:
        picture = GeoImage(raster.pixels, transform, crs, raster.properties)
    except Invalid as error:
        file = world if world is not None and raster.transform is None else image
        raise UnreadableFile(f"{file}: {error.detail}", [Problem(error.detail, file)]) from error
    _check_place(picture, image)
    name = options.picture or image.rpartition("/")[2].rpartition(".")[0]
    if not name or len(name) > 256 or not is_writable(name):
        name = NAME
    return Layers({PartKey("imagery", context.level, name): picture})


def _decode(data: bytes, limits: Limits) -> geotiff.Raster:
    if geotiff.is_tiff(data):
        return geotiff.read_tiff(data, limits)
    pixels = images.png_pixels(data, limits)
    if pixels is None:
        image = images.read_image(data, limits)
        if image.mode.startswith("I"):
            pixels = _pixels(image, image.mode, np.uint16)
        else:
            clear = "transparency" in image.info or image.mode in ("LA", "PA", "RGBA", "La", "RGBa")
            grey = image.mode in ("1", "L", "LA", "La")
            pixels = _pixels(image, ("LA" if clear else "L") if grey else ("RGBA" if clear else "RGB"), np.uint8)
    bands = [{"colour": colour} for colour in DEFAULT_COLOURS[pixels.shape[2]]]
    return geotiff.Raster(pixels, None, None, {"bands": bands})


def _pixels(image: Image.Image, mode: str, kind: type[np.generic]) -> NDArray[Any]:
    """Return [height, width, bands] of an image in this mode, converted in strips of rows.

    Pillow's own conversion takes twice the memory.
    """
    bands = len(Image.new(mode, (1, 1)).getbands())
    out = np.empty((image.height, image.width, bands), kind)
    rows = max(1, images.STRIP // image.width)
    for y in range(0, image.height, rows):
        strip = image.crop((0, y, image.width, min(image.height, y + rows)))
        if strip.mode != mode:
            if "transparency" in strip.info and mode == "LA":
                strip = strip.convert("RGBA")
            strip = strip.convert(mode)
        part = np.asarray(strip)
        out[y : y + rows] = part if part.ndim == 3 else part[..., None]
    return out


def _check_options(options: ReadOptions) -> None:
    problems = []
    if (
        options.crs is not None
        and options.crs.lower() not in (LOCAL, "wgs84")
        and not geotiff.CRS_NAME.fullmatch(options.crs)
    ):
        problems.append(Problem(f"crs must be EPSG:<number>, wgs84 or local, got {options.crs[:80]!r}", where="crs"))
    corners = options.corners
    if corners is not None:
        if len(corners) not in (4, 8):
            reason = f"corners must be lat,lon of two or four corners (4 or 8 numbers), got {len(corners)} numbers"
            problems.append(Problem(reason, where="corners"))
        elif any(abs(v) > (180.0 if k % 2 else 90.0) for k, v in enumerate(corners)):
            reason = "corners must be latitude (-90 to 90) and longitude (-180 to 180) in turn, in degrees"
            problems.append(Problem(reason, where="corners"))
        if options.metres_per_pixel is not None:
            reason = "corners and metres_per_pixel exclude each other: use one of them"
            problems.append(Problem(reason, where="metres_per_pixel"))
    if any(abs(v) > MAX_METRES for v in options.origin):
        problems.append(Problem(f"origin must be within ±{MAX_METRES:g} m", where="origin"))
    if problems:
        raise Invalid("; ".join(f"{p.where}: {p.problem}" for p in problems), problems)


def _place(
    raster: geotiff.Raster, image: str, world: str | None, files: Files, options: ReadOptions, context: ReadContext
) -> tuple[Affine, str]:
    """Return the image's transform and CRS: from the image itself, else its world file, else the options."""
    height, width = raster.pixels.shape[:2]
    file_transform, teller = raster.transform, image
    if file_transform is not None and world is not None:
        context.warn("the world file is ignored: the image contains its position", file=world)
    elif file_transform is None and world is not None:
        file_transform, teller = _read_world(files[world], world), world
    option = "corners" if options.corners else "metres_per_pixel" if options.metres_per_pixel else None
    if file_transform is not None:
        if option:
            context.warn(
                f"option {option} is ignored: {teller} gives the position of the image", file=image, where=option
            )
        return file_transform, _find_crs(file_transform, raster, teller, options, context)
    if options.crs is not None and option:
        reason = (
            "corners are latitude and longitude"
            if option == "corners"
            else "metres_per_pixel refers to the local frame"
        )
        context.warn(f"option crs is ignored: {reason}", file=image, where="crs")
    if options.corners is not None:
        return _from_corners(options.corners, width, height, image, context), WGS84
    if options.metres_per_pixel is not None:
        m, (x, y) = options.metres_per_pixel, options.origin
        cos, sin = m * math.cos(options.yaw), m * math.sin(options.yaw)
        return (cos, sin, x - sin * height, sin, -cos, y + cos * height), LOCAL
    raise UnreadableFile(f"{image}: {HOW_TO_SUPPLY}", [Problem(HOW_TO_SUPPLY, image)])


def _find_crs(
    transform: Affine, raster: geotiff.Raster, teller: str, options: ReadOptions, context: ReadContext
) -> str:
    option = options.crs
    if raster.crs is not None:
        if option is not None:
            context.warn("option crs is ignored: the image names its own CRS", file=teller, where="crs")
        return raster.crs
    if option is not None:
        return {"wgs84": WGS84, LOCAL: LOCAL}.get(option.lower(), option.upper())
    if _looks_like_degrees(transform, raster.pixels.shape[1], raster.pixels.shape[0]):
        context.warn(
            "no CRS; coordinates are read as degrees (longitude, latitude on WGS 84). If they are not, set "
            "crs=EPSG:<number> or crs=local",
            file=teller,
        )
        return WGS84
    context.warn(
        "no CRS; coordinates are read as metres of the local frame. If they are not, set crs=EPSG:<number>",
        file=teller,
    )
    return LOCAL


def _looks_like_degrees(transform: Affine, width: int, height: int) -> bool:
    a, b, _, d, e, _ = transform
    ends = pixel_positions(transform, np.array([0.0, width, width, 0.0]), np.array([0.0, 0.0, height, height]))
    small = max(math.hypot(a, d), math.hypot(b, e)) <= DEGREE_PIXEL
    return small and bool(np.abs(ends[:, 0]).max() <= 180.0 and np.abs(ends[:, 1]).max() <= 90.0)


def _read_world(data: bytes, name: str) -> Affine:
    """Read a world file's six numbers; move the origin from the centre of the first pixel to its outer corner."""
    tokens = data.split()
    bad_index = next((k for k, token in enumerate(tokens[:6]) if not _NUMBER.fullmatch(token)), None)
    if len(tokens) != 6 or bad_index is not None:
        shown = f"{len(tokens)} words" if bad_index is None else repr(tokens[bad_index][:40].decode("latin1"))
        reason = f"a world file has six lines of one number each (with a point), found {shown}"
        raise UnreadableFile(f"{name}: {reason}", [Problem(reason, name, None if bad_index is None else bad_index + 1)])
    numbers = [float(re.sub(rb"[dD]", b"e", token) if b"inf" not in token.lower() else token) for token in tokens]
    bad_index = next((k for k, v in enumerate(numbers) if not math.isfinite(v)), None)
    if bad_index is not None:
        reason = f"a world file's numbers must be finite, got {numbers[bad_index]}"
        raise UnreadableFile(f"{name}: {reason}", [Problem(reason, name, bad_index + 1)])
    a, d, b, e, c, f = numbers
    return (a, b, c - a / 2 - b / 2, d, e, f - d / 2 - e / 2)


def _from_corners(corners: Sequence[float], width: int, height: int, image: str, context: ReadContext) -> Affine:
    """Fit a transform to longitude and latitude, from (latitude, longitude) of the corners."""
    latitude, longitude = corners[0::2], corners[1::2]
    if len(latitude) == 2:
        west, east = sorted(longitude)
        south, north = sorted(latitude)
        if east - west > 180.0:
            west, east = east, west + 360.0
        return ((east - west) / width, 0.0, west, 0.0, (south - north) / height, north)
    if max(longitude) - min(longitude) > 180.0:
        longitude = [v + 360.0 if v < 0.0 else v for v in longitude]
    ends = ((0.0, 0.0), (width, 0.0), (width, height), (0.0, height))
    fit = geotiff.fit_affine([(u, v, x, y) for (u, v), x, y in zip(ends, longitude, latitude, strict=True)])
    if fit is None or not math.isfinite(fit[1]):
        reason = "the corners lie on one line"
        raise UnreadableFile(f"{image}: {reason}", [Problem(reason, image, where="corners")])
    transform, off = fit
    if off > 0.02 * math.hypot(width, height):
        reason = (
            f"the corners are not a parallelogram ({off:.0f} pixels off): give them as upper left, upper right, "
            "lower right, lower left, each as latitude,longitude"
        )
        raise UnreadableFile(f"{image}: {reason}", [Problem(reason, image, where="corners")])
    if off > 0.5:
        context.warn(
            f"the corners are {off:.1f} pixels off the nearest parallelogram, which is used instead", file=image
        )
    return transform


def _with_sidecar(raster: geotiff.Raster, files: Files, context: ReadContext) -> geotiff.Raster:
    """Return an image with the CRS and our own mark of a .prj or .aux.xml beside it."""
    for name in sorted(files):
        lower, data = name.lower(), files[name]
        if not lower.endswith((".prj", ".aux.xml")):
            continue
        if len(data) > MAX_SIDECAR:
            raise TooLarge(f"{name} has {len(data)} bytes; the limit is {MAX_SIDECAR}", [Problem("too large", name)])
        try:
            is_local = raster.is_local
            if lower.endswith(".prj"):
                text: str | None = data.decode("utf-8-sig")
            else:
                root = xml.parse(data, context.limits)
                text = root.findtext(".//SRS")
                is_local = root.findtext(f".//MDI[@key='{geotiff.OWN_TAG}']") == LOCAL
            if text and text.strip():
                return replace(raster, crs=geotiff.crs_from_wkt(text), is_local=is_local)
        except (UnreadableFile, UnicodeError) as error:
            reason = error.detail if isinstance(error, UnreadableFile) else "not UTF-8 text"
            raise UnreadableFile(f"{name}: {reason}", [Problem(reason, name)]) from error
    return raster


def _check_place(picture: GeoImage, image: str) -> None:
    """Reject positions beyond the local frame, or without coordinates on earth in PROJ."""
    reason = geotiff.position_problem(picture)
    if reason is not None:
        local = picture.crs == LOCAL
        advice = "set crs=EPSG:<number>" if local else "set another one with crs=EPSG:<number>, or crs=local"
        reason = f"{reason}: {advice}"
        raise UnreadableFile(f"{image}: {reason}", [Problem(reason, image, where=None if local else "crs")])


# --- writing ------------------------------------------------------------------------------------------------------
def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """Write ``satellite.tif``, or ``satellite.png`` with its world file.

    Raises MissingLayer, NotFound, Ambiguous, MissingDatum, or Invalid for an impossible raster.
    """
    options = context.options if isinstance(context.options, WriteOptions) else WriteOptions()
    pictures = {k: p for k, p in layers.parts_of("imagery").items() if isinstance(p, GeoImage)}
    key = choose(sorted(pictures), options)[0]
    picture = pictures[key]
    crs = {"source": picture.crs, "local": LOCAL, "wgs84": WGS84}[options.crs]
    if options.crs != "source" or options.resolution is not None:
        new_picture = resample(picture, layers.frame, crs=crs, resolution=options.resolution, method=options.resampling)
        if new_picture is not picture:
            picture = replace(new_picture, properties=_without_statistics(new_picture.properties))
    elif options.resampling is not None:
        raise Invalid("resampling has no effect without crs=local, crs=wgs84 or a resolution: set one of them")
    stem = file_stem(options.picture or NAME, NAME)
    picture, named = _on_earth(picture, layers.frame)
    if options.file_type == "png":
        return _write_png(picture, named, stem, context)
    if named is None:
        context.warn(NO_PLACE, file=f"{stem}.tif")
    tags = _tags(picture)
    if picture.crs == LOCAL:
        tags[geotiff.OWN_TAG] = LOCAL
    credit = [*picture.attribution, *context.attribution]
    if credit:
        tags.setdefault("TIFFTAG_COPYRIGHT", "; ".join(dict.fromkeys(credit)))
    return {f"{stem}.tif": geotiff.write_cog(picture, named, tags)}


def _on_earth(picture: GeoImage, frame: LocalFrame | None) -> tuple[GeoImage, str | None]:
    """Return an image with the transform to write, and the CRS of that; None without a datum for local metres."""
    if picture.crs != LOCAL:
        return picture, picture.crs
    if frame is None:
        return picture, None
    return replace(picture, transform=to_earth(picture.transform, frame)), frame.wkt


def choose(keys: Sequence[PartKey], options: WriteOptions) -> Sequence[PartKey]:
    """Select the named image; else ``satellite``, else the only one.

    On the given level, else on the ground, else on the only one.
    """
    supply = "upload one (a GeoTIFF, or a PNG with its world file)"
    return select_part(
        keys, "imagery", options.picture, options.level, noun="image", option="picture", supply=supply, default=NAME
    )


def options_from_filename(name: str) -> dict[str, str]:
    """Return the options that a file name implies: ``.png`` and ``.pgw`` PNG, ``plan.tif`` the image ``plan``."""
    lower = name.lower()
    for end, kind in ((".png.aux.xml", "png"), (".png", "png"), (".pgw", "png"), (".tif", "tif")):
        if lower.endswith(end) and len(name) > len(end):
            stem = name[: -len(end)]
            return {"file_type": kind, **({} if stem == NAME else {"picture": stem})}
    return {}


def _tags(picture: GeoImage) -> dict[str, str]:
    source_properties = picture.properties.get(NAME)
    tags = source_properties.get("tags") if isinstance(source_properties, Mapping) else None
    return {str(k): str(v) for k, v in tags.items()} if isinstance(tags, Mapping) else {}


def _without_statistics(properties: Mapping[str, Any]) -> dict[str, Any]:
    """Remove the statistics of resampled bands, which are no longer valid."""
    bands = []
    for band in properties.get("bands", ()):
        source_properties = band.get(NAME) if isinstance(band, Mapping) else None
        if isinstance(source_properties, Mapping) and isinstance(source_properties.get("tags"), Mapping):
            tags = {k: v for k, v in source_properties["tags"].items() if not str(k).startswith("STATISTICS_")}
            bands.append({**band, NAME: {**source_properties, "tags": tags}})
        else:
            bands.append(band)
    return {**properties, "bands": bands} if bands else dict(properties)


def _write_png(picture: GeoImage, crs: str | None, stem: str, context: WriteContext) -> dict[str, bytes]:
    height, width, count = picture.pixels.shape
    pixels = display_pixels(picture)
    if picture.pixels.dtype != np.uint8:
        why = (
            f"PNG is written with 8 bit: {picture.pixels.dtype} was stretched to 0…255; file_type=tif keeps the values"
        )
        context.drop("pixel values", height * width, why)
    colours = picture.colours
    shown = 3 if {"red", "green", "blue"} <= set(colours) else 1
    extra = count - shown - any(c in ("alpha", "mask") for c in colours)
    context.drop("bands", extra, "PNG is written as grey or RGB with transparency; file_type=tif keeps all bands")
    context.drop("tags", len(_tags(picture)), "they are GeoTIFF metadata; file_type=tif keeps them")
    digits = METRES if crs is None or abs(picture.transform[0]) + abs(picture.transform[4]) > 0.1 else DEGREES
    out = {f"{stem}.png": images.encode_png(pixels), f"{stem}.pgw": geotiff.world_file(picture.transform, digits)}
    if crs is None:
        context.warn(f"{NO_PLACE}. To upload it again, set crs=local", file=f"{stem}.pgw")
    else:
        out[f"{stem}.png.aux.xml"] = geotiff.aux_xml(crs, is_local=picture.crs == LOCAL)
    return out


register(
    Format(
        name=NAME,
        title="Georeferenced image (GeoTIFF, or PNG and JPEG with a world file)",
        files={"satellite.tif": "image/tiff", "satellite.png": "image/png", "satellite.pgw": "text/plain"},
        layers=frozenset({"imagery"}),
        detect=detect,
        read=read,
        write=write,
        version=3,
        needs=LayerRequirements((frozenset({"imagery"}),)),
        read_options=ReadOptions,
        write_options=WriteOptions,
        extensions=IMAGE_ENDS,
        selection=Selection(
            choose, options_from_filename, Parts("imagery", "picture", partial(file_stem, default=NAME), default=NAME)
        ),
        claims=Claims(
            companions=companions,
            is_sidecar=yields,
            missing_metadata=lacking,
            completing_options=frozenset({"corners", "metres_per_pixel"}),
        ),
    )
)

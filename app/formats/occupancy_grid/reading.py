"""Reading map_server files: a YAML file with its image, or an image alone."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from app.errors import BadUpload, Problem, UnreadableFile
from app.formats import Files, ReadContext, _fields, _masks
from app.formats.occupancy_grid import geotiff_grid
from app.formats.occupancy_grid.words import KEYS, MAP_SAVER_PIXELS, NAME, Table, cell_table, reads_unknown_as_free
from app.model.frame import MAX_METRES
from app.model.grid import FREE, UNKNOWN, UNKNOWN_GREY, Mode, OccupancyGrid, outline, pack_cells
from app.model.layers import MAP, Layers, PartKey
from app.parameters import parameter
from app.syntax import geotiff, images, yaml

MODES: tuple[Mode, ...] = ("trinary", "scale", "raw")
SHAPE = _fields.record(
    "image mode negate occupied_thresh free_thresh map_type",
    resolution=_fields.Number(
        1e-6, 1e4, usual=(1e-3, 10.0), hint="a cell of this size contains a room; is it in metres?", unit="metres"
    ),
    origin=(_fields.COORDINATE, _fields.COORDINATE, replace(_fields.ANGLE, low=-MAX_METRES, high=MAX_METRES)),
)
"""Schema of a map's YAML file. Source: Nav2's map_io, slam_toolbox."""
REQUIRED = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")
YAML_ENDS = (".yaml", ".yml")
TIFF_ENDS = (".tif", ".tiff")
IMAGE_ENDS = (".pgm", ".png", ".bmp", ".jpg", ".jpeg")


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """Parameters of an image without a YAML file."""

    resolution: float | None = parameter(
        None, "size of a cell, for an image without a YAML file", minimum=1e-6, maximum=1e4, unit="m"
    )
    origin: tuple[float, float, float] = parameter(
        (0.0, 0.0, 0.0), "x,y,yaw of the lower left corner (metres, radians), for an image without a YAML file"
    )
    negate: bool = parameter(False, "white is occupied, for an image without a YAML file")
    occupied_thresh: float = parameter(
        0.65, "minimum share of black of occupied cells, for an image without a YAML file", minimum=0.0, maximum=1.0
    )
    free_thresh: float = parameter(
        0.196, "maximum share of black of free cells, for an image without a YAML file", minimum=0.0, maximum=1.0
    )
    mode: Literal["trinary", "scale", "raw"] = parameter(
        "trinary", "meaning of grey values (as in Nav2), for an image without a YAML file"
    )


def is_image(name: str, data: bytes) -> bool:
    """Detect an image by content or name."""
    return images.detect_kind(data) is not None or name.lower().endswith(IMAGE_ENDS)


def find_image(reference: str, main: str, names: Iterable[str]) -> tuple[str | None, str]:
    """Find the upload's image for a reference in a YAML file, and a warning if it is not at the referenced path.

    Only plain relative paths are followed; for others (absolute, with ``..``, a drive, a variable) the base name is
    looked up: beside the YAML file, else the only one in the upload.
    """
    folder = main.rpartition("/")[0]
    beside = f"{folder}/" if folder else ""
    name_set = set(names)
    plain = reference.removeprefix("./")
    parts = plain.split("/")
    foreign = any(c in reference for c in "\\~%$:") or ".." in parts or reference.startswith("/") or "" in parts
    if not foreign and beside + plain in name_set:
        return beside + plain, ""
    base = re.split(r"[/\\]", reference)[-1]
    if not base or base in (".", ".."):
        return None, ""
    if beside + base in name_set:
        match = beside + base
    else:
        same = [n for n in name_set if n.rpartition("/")[2] == base]
        if len(same) != 1:  # choosing one of several would be a guess that robots rely on
            return None, ""
        match = same[0]
    if match == beside + reference:
        return match, ""
    return match, f"the image {reference[:200]!r} is not part of the upload; {match!r} is used"


def read(files: Files, context: ReadContext) -> Layers:
    """Read one grid. Raises UnreadableFile (with key and line) or TooLarge."""
    main = context.main or next(iter(files))
    options = context.options if isinstance(context.options, ReadOptions) else ReadOptions()
    if geotiff.is_tiff(files[main]):
        return _read_tiff(files, main, options, context)
    if not is_image(main, files[main]):
        return _read_yaml(files, main, options, context)
    beside = next((n for n in files if n != main and n.lower().endswith(YAML_ENDS)), None)
    if beside is not None and options.resolution is None:
        return _read_yaml(files, beside, options, context)
    if options.resolution is None:
        reason = "an image alone has no cell size: add its YAML file, or set the option resolution"
        raise UnreadableFile(f"{main}: {reason}", [Problem(reason, main, where="resolution")])
    parameters = {
        "resolution": options.resolution,
        "origin": options.origin,
        "mode": options.mode,
        "occupied_thresh": options.occupied_thresh,
        "free_thresh": options.free_thresh,
        "negate": options.negate,
    }
    return _layers(parameters, {}, main, main, files, context)


def _read_tiff(files: Files, main: str, options: ReadOptions, context: ReadContext) -> Layers:
    if not context.wants("occupancy"):
        return Layers()
    if options != ReadOptions():
        context.warn("the options for images without a YAML file are ignored; it is a GeoTIFF", file=main)
    try:
        grid = geotiff_grid.read_grid(files[main], context)
    except BadUpload as error:
        raise type(error)(f"{main}: {error.detail}", [Problem(error.detail, main)]) from error
    grid = replace(grid, properties=_mask_meaning(files, main, context))
    return Layers({PartKey("occupancy", context.level, _name(main, context)): grid})


def _mask_meaning(files: Files, main: str, context: ReadContext) -> dict[str, Any]:
    """Read the parameters of a mask beside its main file; empty if there are none."""
    mask_file = next((n for n in _masks.companions(main, list(files)) if n in files), None)
    return _masks.read(mask_file, files[mask_file], context) if mask_file else {}


def _name(main: str, context: ReadContext) -> str:
    return context.grid or main.rpartition("/")[2].rpartition(".")[0] or MAP


def _read_yaml(files: Files, main: str, options: ReadOptions, context: ReadContext) -> Layers:
    data = files[main]
    document = yaml.load(data, context.limits)
    if not isinstance(document, dict):
        raise UnreadableFile(f"{main}: a map's YAML file must be a mapping with the keys {', '.join(REQUIRED)}")
    if options != ReadOptions():
        context.warn("the options for images without a YAML file are ignored; there is a YAML file", file=main)
    problems: list[Problem] = []

    def add_problem(key: str, reason: str) -> None:
        problems.append(Problem(reason, main, _line(data, key), key))

    missing = [key for key in REQUIRED if document.get(key) is None]
    for key in missing:
        add_problem(key, f"the key {key} is missing")
    parameters: dict[str, Any] = {"mode": document.get("mode", "trinary")}
    for key, low, high in (
        ("resolution", 1e-6, 1e4),
        ("occupied_thresh", 0.0, 1.0),
        ("free_thresh", 0.0, 1.0),
    ):
        if key not in missing:
            parameters[key] = number = _number(document[key])
            if number is None or not low <= number <= high:
                add_problem(key, f"{key} must be a number between {low:g} and {high:g}, got {_shown(document[key])}")
    if "origin" not in missing:
        origin = document["origin"]
        numbers = [_number(v) for v in origin] if isinstance(origin, list) else []
        if len(numbers) != 3 or any(v is None or abs(v) > MAX_METRES for v in numbers):
            add_problem(
                "origin", f"origin must be three numbers [x, y, yaw] within ±{MAX_METRES:g}, got {_shown(origin)}"
            )
        parameters["origin"] = tuple(numbers)
    if "negate" not in missing:
        negate = document["negate"]
        number = _number(negate)
        if isinstance(negate, bool) or number in (0.0, 1.0):
            parameters["negate"] = bool(negate if isinstance(negate, bool) else number)
        else:
            add_problem("negate", f"negate must be 0, 1, true or false, got {_shown(negate)}")
    if parameters["mode"] not in MODES:
        add_problem("mode", f"mode must be trinary, scale or raw, got {_shown(parameters['mode'])}")
    image = document.get("image")
    if "image" not in missing and not (isinstance(image, str) and image):
        add_problem("image", f"image must be the name of an image file, got {_shown(image)}")
    if problems:
        raise UnreadableFile("; ".join(f"{p.file}: {p.problem}" for p in problems), problems)
    picture = _picture_name(str(image), files, main, context)
    if parameters["free_thresh"] > parameters["occupied_thresh"]:
        reason = "free_thresh is above occupied_thresh; cells that match both are free"
        context.warn(reason, file=main, line=_line(data, "free_thresh"), where="free_thresh")
    _fields.check(document, SHAPE, context)
    extra = {key: value for key, value in document.items() if key not in KEYS}
    if "mode" in document:
        parameters["mode"] = document["mode"]
    return _layers(parameters, extra, main, picture, files, context)


def _picture_name(image: str, files: Files, main: str, context: ReadContext) -> str:
    """Return the name of the upload's image for the YAML file's ``image``. Raises UnreadableFile if missing."""
    picture, warning = find_image(image, main, files)
    if picture is None or picture == main:
        reason = f"the image {image[:200]!r} is not in the upload: add this file, next to the YAML file"
        raise UnreadableFile(f"{main}: {reason}", [Problem(reason, main, _line(files[main], "image"), "image")])
    if warning:
        context.warn(warning, file=main, line=_line(files[main], "image"), where="image")
    return picture


def _layers(
    parameters: Mapping[str, Any], extra: Mapping[str, Any], main: str, picture: str, files: Files, context: ReadContext
) -> Layers:
    if not context.wants("occupancy"):
        return Layers()
    yaw = parameters["origin"][2]
    if yaw != 0.0:
        line = _line(files[main], "origin") if main != picture else None
        reason = f"the origin has a yaw of {yaw:g} rad, which Nav2 ignores; request the map with normalize=true"
        context.warn(reason, file=main, line=line, where="origin")
    mask_file = (
        next((n for n in _masks.companions(main, list(files)) if n != picture), None) if main != picture else None
    )
    meaning = _masks.read(mask_file, files[mask_file], context) if mask_file else {}
    try:
        if context.decode_cells:
            shades = images.read_grey(files[picture], context.limits)
            rule = cell_table(
                parameters["mode"], parameters["negate"], parameters["occupied_thresh"], parameters["free_thresh"]
            )
            doubtful = reads_unknown_as_free(rule, parameters["mode"], negate=parameters["negate"]) and not meaning
            cells, grey = _cells(shades, rule, parameters["mode"], MAP_SAVER_PIXELS[UNKNOWN] if doubtful else None)
            if grey is not None:
                meaning = {**meaning, UNKNOWN_GREY: pack_cells(grey)}
        else:
            width, height = images.read_size(files[picture], context.limits)
            cells = outline(height, width)
    except BadUpload as error:
        raise type(error)(f"{picture}: {error.detail}", [Problem(error.detail, picture)]) from error
    grid = OccupancyGrid(
        cells,
        parameters["resolution"],
        parameters["origin"],
        parameters["mode"],
        parameters["occupied_thresh"],
        parameters["free_thresh"],
        parameters["negate"],
        {**({NAME: extra} if extra else {}), **meaning},
    )
    return Layers({PartKey("occupancy", context.level, _name(main, context)): grid})


def _cells(
    shades: images.Grey, rule: Table, mode: Mode, shade: int | None
) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
    """Convert an image to canonical cells (bottom row first), a strip of rows at a time.

    Also returns a mask of the opaque cells with the given grey value, or None if there are none.
    """
    cells = np.empty((shades.height, shades.width), np.uint8)
    grey = None if shade is None else np.zeros(cells.shape, bool)
    table = rule.tobytes()
    for y, block, opaque in shades.strips():
        values = images.apply_table(block, table)
        if opaque is not None and mode != "raw":
            values = np.where(opaque, values, np.uint8(UNKNOWN))
        top = shades.height - y
        cells[top - len(values) : top] = values[::-1]
        if grey is not None:
            grey[top - len(values) : top] = ((block == shade) & (values == FREE))[::-1]
    return cells, grey if grey is not None and grey.any() else None


def _number(value: Any) -> float | None:
    """Parse a finite number, also a quoted one (as yaml-cpp does)."""
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        return None
    if isinstance(value, str) and not re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", value, re.ASCII):
        return None
    number = float(value)
    return number if math.isfinite(number) else None


def _shown(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)[:80]


def _line(data: bytes, key: str) -> int | None:
    """Return the line (from 1) of a top-level key."""
    match = re.search(rb'^[ \t{]*["\']?' + key.encode() + rb'["\']?[ \t]*:', data, re.MULTILINE)
    return None if match is None else data.count(b"\n", 0, match.end()) + 1

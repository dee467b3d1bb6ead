"""Occupancy grids as Nav2's map_server keeps them: a YAML of resolution, origin and thresholds beside a grey picture.

A pixel g (0…255) is x = 1 - g/255 occupied (``negate``: g/255). ``trinary``: 100 where x ≥ occupied_thresh, then 0
where x ≤ free_thresh (free wins), else unknown; ``scale``: between the thresholds round(100 (x - free)/(occupied -
free)); ``raw``: g itself up to 100, else unknown. A pixel that is not opaque is unknown (trinary, scale). The picture's
top row is the map's last one. Comparisons are in float32. Source: nav2_map_server, map_io.cpp.

A costmap filter mask (keepout, speed) is such a grid with one more file, ``<grid>_filter_info.yaml``: see ``_masks``.

Frame: local; ``origin`` = [x, y, yaw] of the lower left corner, metres and radians. Nav2 ignores the yaw.
"""

from __future__ import annotations

import io
import json
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from app.errors import BadUpload, FleetMapError, Invalid, Problem, UnreadableFile
from app.formats import (
    BAD_INPUT,
    Claims,
    Files,
    Format,
    LayerRequirements,
    Parts,
    ReadContext,
    Selection,
    WriteContext,
    _fields,
    _masks,
    register,
)
from app.formats._select import file_stem, select_part
from app.formats.occupancy_grid import rules as _occupancy_grid_rules
from app.limits import Limits
from app.model.frame import MAX_METRES
from app.model.grid import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    UNKNOWN_GREY,
    Mode,
    OccupancyGrid,
    outline,
    pack_cells,
    unknown_grey,
    unknown_grey_as_unknown,
    without_unknown_grey,
)
from app.model.layers import MAP, Layers, PartKey
from app.parameters import parameter
from app.syntax import images, yaml

NAME = "occupancy_grid"
MODES: tuple[Mode, ...] = ("trinary", "scale", "raw")
SHAPE = _fields.record(
    "image mode negate occupied_thresh free_thresh map_type",
    resolution=_fields.Number(
        1e-6, 1e4, usual=(1e-3, 10.0), hint="a cell this large holds a room; is it in metres?", unit="metres"
    ),
    origin=(_fields.COORDINATE, _fields.COORDINATE, replace(_fields.ANGLE, low=-MAX_METRES, high=MAX_METRES)),
)
"""What a map's YAML holds. Source: Nav2's map_io, slam_toolbox."""

KEYS = ("image", "mode", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")
REQUIRED = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh")
YAML_ENDS = (".yaml", ".yml")
IMAGE_ENDS = (".pgm", ".png", ".bmp", ".jpg", ".jpeg")

MAP_SAVER_PIXELS = {FREE: 254, OCCUPIED: 0, UNKNOWN: 205}
"""The pixels that map_saver writes."""

Table = NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """How to take a picture that comes without a YAML."""

    resolution: float | None = parameter(
        None, "size of a cell, for a picture without a YAML", minimum=1e-6, maximum=1e4, unit="m"
    )
    origin: tuple[float, float, float] = parameter(
        (0.0, 0.0, 0.0), "x,y,yaw of the lower left corner (metres, radians), for a picture without a YAML"
    )
    negate: bool = parameter(False, "white is occupied, for a picture without a YAML")
    occupied_thresh: float = parameter(
        0.65, "from this share of black on a cell is occupied, for a picture without a YAML", minimum=0.0, maximum=1.0
    )
    free_thresh: float = parameter(
        0.196, "up to this share of black a cell is free, for a picture without a YAML", minimum=0.0, maximum=1.0
    )
    mode: Literal["trinary", "scale", "raw"] = parameter(
        "trinary", "what the greys mean (as in Nav2), for a picture without a YAML"
    )


@dataclass(frozen=True, slots=True)
class WriteOptions:
    """Which grid, and how it is written."""

    grid: str | None = parameter(None, "name of the grid; *: all, drawn masks too; default: map, else the only one")
    level: str | None = parameter(None, "level of the grid; *: all; default: the one it is on")
    file_type: Literal["pgm", "png"] | None = parameter(
        None, "picture format; default: pgm, or png where only transparency can say unknown"
    )
    mode: Literal["trinary", "scale", "raw"] | None = parameter(
        None, "how greys encode cells; default: as uploaded, or raw where that cannot say every value"
    )
    resolution: float | None = parameter(
        None,
        "resample to this size of a cell: a coarser cell has the highest value that it covers (unknown counts just "
        "above free), a finer one that of the cell at its centre",
        minimum=1e-3,
        maximum=1e3,
        unit="m",
    )
    normalize: bool = parameter(
        False,
        "bake the yaw (which Nav2 ignores) into the cells, unknown outside, and move the origin to a whole multiple "
        "of the resolution; obstacles never get lost",
    )


# --- telling ------------------------------------------------------------------------------------------------------
_BLOCK = re.compile(
    rb'^["\']?(image|resolution|origin|occupied_thresh|free_thresh|negate)(?=["\']?[ \t]*:)', re.MULTILINE
)
_FLOW = re.compile(rb'(?<=[{,\s"\'])(?:image|resolution|origin|occupied_thresh|free_thresh|negate)(?=["\']?[ \t]*:)')
_FLOW_START = re.compile(rb"(?:\xef\xbb\xbf)?(?:\s|#[^\n]*\n|---|%[^\n]*\n)*\{")
HEAD = 2**16


def detect(name: str, data: bytes) -> bool:
    """A YAML that names an image and at least two of a grid's other keys. A picture alone may be of anything."""
    del name
    head = data[:HEAD]
    if b"image" not in head or b"\0" in head:
        return False
    pattern = _FLOW if _FLOW_START.match(head) else _BLOCK
    keys = set(pattern.findall(head.removeprefix(b"\xef\xbb\xbf")))
    return b"image" in keys and len(keys) >= 3


def companions(main: str, data: bytes, names: Sequence[str]) -> Iterable[str]:
    """The picture that a YAML names, and a mask's parameters. For a picture: the YAML of the same stem."""
    if _is_image(main, data):
        stem = main.rpartition(".")[0]
        return [n for n in names if n in (stem + ".yaml", stem + ".yml")]
    try:
        image = yaml.load(data, Limits(yaml_nodes=10_000))["image"]
        return [n for n in [_find_image(str(image), main, names)[0]] if n] + _masks.companions(main, names)
    except (*BAD_INPUT, FleetMapError):  # the reader says what is wrong with it
        return []


def _is_image(name: str, data: bytes) -> bool:
    return images.detect_kind(data) is not None or name.lower().endswith(IMAGE_ENDS)


def _find_image(reference: str, main: str, names: Iterable[str]) -> tuple[str | None, str]:
    """The picture of the upload that a YAML means, and a warning if it is not simply where the YAML says.

    Only a plain relative path is followed; of any other one (absolute, with ``..``, a drive, a variable) the base name
    is looked up: beside the YAML, else the only one of the upload.
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
        if len(same) != 1:  # of several one would be a guess, and a robot would drive by it
            return None, ""
        match = same[0]
    if match == beside + reference:
        return match, ""
    return match, f"the image {reference[:200]!r} is not part of the upload; {match!r} was taken for it"


# --- reading ------------------------------------------------------------------------------------------------------
def read(files: Files, context: ReadContext) -> Layers:
    """One grid. Raises UnreadableFile (with key and line) or TooLarge."""
    main = context.main or next(iter(files))
    options = context.options if isinstance(context.options, ReadOptions) else ReadOptions()
    if not _is_image(main, files[main]):
        return _read_yaml(files, main, options, context)
    beside = next((n for n in files if n != main and n.lower().endswith(YAML_ENDS)), None)
    if beside is not None and options.resolution is None:
        return _read_yaml(files, beside, options, context)
    if options.resolution is None:
        reason = "a picture alone does not say how large its cells are: add its YAML, or the option resolution"
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


def _read_yaml(files: Files, main: str, options: ReadOptions, context: ReadContext) -> Layers:
    data = files[main]
    document = yaml.load(data, context.limits)
    if not isinstance(document, dict):
        raise UnreadableFile(f"{main}: a map's YAML is a mapping with the keys {', '.join(REQUIRED)}")
    if options != ReadOptions():
        context.warn("the options of a picture without a YAML are not used: there is a YAML", file=main)
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
        add_problem("image", f"image must be the name of a picture, got {_shown(image)}")
    if problems:
        raise UnreadableFile("; ".join(f"{p.file}: {p.problem}" for p in problems), problems)
    picture, warning = _find_image(str(image), main, files)
    if picture is None or picture == main:
        reason = f"the image {str(image)[:200]!r} is not in the upload: add this file, beside the YAML"
        raise UnreadableFile(f"{main}: {reason}", [Problem(reason, main, _line(data, "image"), "image")])
    if warning:
        context.warn(warning, file=main, line=_line(data, "image"), where="image")
    if parameters["free_thresh"] > parameters["occupied_thresh"]:
        reason = "free_thresh is above occupied_thresh: where both hold a cell is free"
        context.warn(reason, file=main, line=_line(data, "free_thresh"), where="free_thresh")
    _fields.check(document, SHAPE, context)
    extra = {key: value for key, value in document.items() if key not in KEYS}
    if "mode" in document:
        parameters["mode"] = document["mode"]
    return _layers(parameters, extra, main, picture, files, context)


def _layers(
    parameters: Mapping[str, Any], extra: Mapping[str, Any], main: str, picture: str, files: Files, context: ReadContext
) -> Layers:
    if not context.wants("occupancy"):
        return Layers()
    yaw = parameters["origin"][2]
    if yaw != 0.0:
        line = _line(files[main], "origin") if main != picture else None
        reason = f"the origin is turned by {yaw:g} rad; Nav2 ignores that: ask for the map with normalize=true"
        context.warn(reason, file=main, line=line, where="origin")
    mask_file = (
        next((n for n in _masks.companions(main, list(files)) if n != picture), None) if main != picture else None
    )
    meaning = _masks.read(mask_file, files[mask_file], context) if mask_file else {}
    try:
        if context.decode_cells:
            shades = images.read_grey(files[picture], context.limits)
            rule = _rule(
                parameters["mode"], parameters["negate"], parameters["occupied_thresh"], parameters["free_thresh"]
            )
            doubtful = _reads_unknown_as_free(rule, parameters["mode"], negate=parameters["negate"]) and not meaning
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
    name = context.grid or main.rpartition("/")[2].rpartition(".")[0] or MAP
    return Layers({PartKey("occupancy", context.level, name): grid})


def _reads_unknown_as_free(rule: Table, mode: Mode, *, negate: bool) -> bool:
    """Whether the grey that map_saver writes for unknown is read as free."""
    return mode == "trinary" and not negate and bool(rule[MAP_SAVER_PIXELS[UNKNOWN]] == FREE)


def _cells(
    shades: images.Grey, rule: Table, mode: Mode, shade: int | None
) -> tuple[NDArray[np.uint8], NDArray[np.bool_] | None]:
    """Canonical cells (bottom row first) of a picture, a strip of rows at a time, and which opaque ones have the wanted
    grey; None where there are none."""
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


def _rule(mode: Mode, negate: bool, occupied: float, free: float) -> Table:
    """The cell of each opaque pixel 0…255."""
    shade = np.arange(256)
    if mode == "raw":
        return np.where(shade <= OCCUPIED, shade, UNKNOWN).astype(np.uint8)
    high, low = np.float32(occupied), np.float32(free)
    x = shade.astype(np.float32) / np.float32(255)
    x = x if negate else np.float32(1) - x
    cells = np.full(256, UNKNOWN, np.uint8)
    if mode == "scale":
        between = (x > low) & (x < high)
        cells[between] = np.round((x[between] - low) / (high - low) * 100).astype(np.uint8)
    cells[x >= high] = OCCUPIED
    cells[x <= low] = FREE
    return cells


def _number(value: Any) -> float | None:
    """A finite number, also one that is quoted (yaml-cpp takes it so)."""
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        return None
    if isinstance(value, str) and not re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", value, re.ASCII):
        return None
    number = float(value)
    return number if math.isfinite(number) else None


def _shown(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False)[:80]


def _line(data: bytes, key: str) -> int | None:
    """The line (from 1) on which a top-level key stands."""
    match = re.search(rb'^[ \t{]*["\']?' + key.encode() + rb'["\']?[ \t]*:', data, re.MULTILINE)
    return None if match is None else data.count(b"\n", 0, match.end()) + 1


# --- writing ------------------------------------------------------------------------------------------------------
def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """``<grid>.yaml`` and its picture, and ``<grid>_filter_info.yaml`` of a mask.

    Raises MissingLayer, NotFound, Ambiguous, or Invalid for impossible options.
    """
    options = context.options if isinstance(context.options, WriteOptions) else WriteOptions()
    key = choose(sorted(layers.grids()), options)[0]
    grid = layers.grids()[key]
    if options.resolution is not None and options.resolution != grid.resolution:
        grid = _with_mask(grid, partial(resample, resolution=options.resolution))
    if options.normalize:
        grid = _with_mask(grid, normalize)
    stem = file_stem(key.name)
    grid, pixels, kind = _encoding(grid, options, context, stem + ".yaml")
    grid, pixels = _with_grey(grid, pixels)
    if grid.origin[2] != 0.0:
        reason = f"the origin is turned by {grid.origin[2]:g} rad; Nav2 ignores that: ask for normalize=true"
        context.warn(reason, file=stem + ".yaml", where="origin")
    picture = f"{stem}.{kind}"
    files = {stem + ".yaml": _yaml_text(grid, picture), picture: _picture(grid, pixels, kind)}
    return files | _masks.write(grid, stem, context)


def choose(keys: Sequence[PartKey], options: WriteOptions) -> Sequence[PartKey]:
    """The named grid; else ``map``, else the only one; on its level, else on the ground, else on the only one."""
    supply = "upload one (a YAML and its image)"
    return select_part(keys, "occupancy", options.grid, options.level, noun="grid", option="grid", supply=supply)


def options_from_filename(name: str) -> dict[str, str]:
    """``keepout.yaml``, ``keepout.pgm`` and ``keepout_filter_info.yaml`` are the grid ``keepout``; ``keepout.png`` asks
    for a PNG, too."""
    stem, _, end = name.rpartition(".")
    if f".{end}" in YAML_ENDS:
        stem = stem.removesuffix(_masks.SUFFIX)
    if not stem or f".{end}" not in (*YAML_ENDS, ".pgm", ".png"):
        return {}
    return {"grid": stem, **({"file_type": end} if end in ("pgm", "png") else {})}


def _encoding(
    grid: OccupancyGrid, options: WriteOptions, context: WriteContext, file: str
) -> tuple[OccupancyGrid, Table, Literal["pgm", "png"]]:
    """The grid in the mode it is written in, the pixel of each cell value, and the picture's format.

    In a PNG unknown may have no pixel of its own: it is transparent then.
    """
    present = np.flatnonzero(_present_file(grid.cells))
    if options.mode is not None:
        same_mode = options.mode == grid.mode
        grid = replace(grid, mode=options.mode)
        if options.mode == "trinary":
            if not same_mode and _pixels(grid, present) is None:
                grid = replace(grid, occupied_thresh=0.65, free_thresh=0.196)
            grid = _apply_thresholds(grid, context)
            present = np.flatnonzero(_present_file(grid.cells))
        elif options.mode == "scale" and not same_mode and _pixels(grid, present[present != UNKNOWN]) is None:
            grid = replace(grid, occupied_thresh=1.0, free_thresh=0.0)
    pixels = _pixels(grid, present)
    if pixels is not None:
        return grid, pixels, options.file_type or "pgm"
    cell_values = present[present != UNKNOWN]
    pixels = _pixels(grid, cell_values)
    if pixels is not None and options.file_type != "pgm":
        return grid, pixels, "png"
    if options.mode is not None:
        reason = (
            f"mode={options.mode} with these thresholds has no grey for unknown: ask for file_type=png or mode=raw"
            if pixels is not None
            else f"mode={options.mode} has no grey for every value of this grid: ask for mode=raw"
        )
        raise Invalid(reason)
    why = "unknown" if pixels is not None else "every value of this grid"
    context.warn(f"written with mode: raw, since {grid.mode} has no grey for {why}", file=file, where="mode")
    grid = replace(grid, mode="raw")
    pixels = _pixels(grid, present)
    if pixels is None:
        raise AssertionError("raw says every value")
    return grid, pixels, options.file_type or "pgm"


def _with_mask(grid: OccupancyGrid, change: Callable[[OccupancyGrid], OccupancyGrid]) -> OccupancyGrid:
    """A grid in other cells, whose free cells have unknown's grey if one of those that they show had it."""
    out = without_unknown_grey(change(grid))
    if unknown_grey(grid) is None:
        return out
    grey = (change(unknown_grey_as_unknown(grid)).cells == UNKNOWN) & (out.cells == FREE)
    return replace(out, properties={**out.properties, UNKNOWN_GREY: pack_cells(grey)}) if grey.any() else out


def _with_grey(grid: OccupancyGrid, pixels: Table) -> tuple[OccupancyGrid, Table]:
    """Free cells that came with the grey of unknown ones get it back, by a value that no cell has."""
    rule = _rule(grid.mode, grid.negate, grid.occupied_thresh, grid.free_thresh)
    grey = unknown_grey(grid) if _reads_unknown_as_free(rule, grid.mode, negate=grid.negate) else None
    if grey is None:
        return grid, pixels
    present = _present_file(grid.cells)
    spare = next((v for v in range(FREE + 1, OCCUPIED) if not present[v]), None)
    if spare is None:
        return grid, pixels
    pixels = pixels.copy()
    pixels[spare] = MAP_SAVER_PIXELS[UNKNOWN]
    return replace(grid, cells=np.where(grey, np.uint8(spare), grid.cells)), pixels


def _present_file(cells: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Which of the 256 values occur."""
    seen = np.zeros(256, bool)
    rows = max(1, images.STRIP // cells.shape[1])
    for y in range(0, len(cells), rows):
        block = cells[y : y + rows]
        counts = {value: int(np.count_nonzero(block == value)) for value in MAP_SAVER_PIXELS}
        for value, count in counts.items():
            seen[value] |= count > 0
        if sum(counts.values()) < block.size:
            seen[block] = True
    return seen


def _pixels(grid: OccupancyGrid, values: NDArray[np.intp]) -> Table | None:
    """For each cell value a pixel that the consumer's rule turns back into it; None if one of ``values`` has none.

    The pixels of map_saver where they fit, else blackest for occupied, whitest for free, the middle of those that fit.
    """
    rule = _rule(grid.mode, grid.negate, grid.occupied_thresh, grid.free_thresh)
    out = np.zeros(256, np.uint8)
    for value in values.tolist():
        fit = np.flatnonzero(rule == value)
        if not len(fit):
            return None
        pixel = MAP_SAVER_PIXELS.get(value, -1)
        pixel = 255 - pixel if grid.negate and pixel >= 0 else pixel
        black, white = (int(fit[-1]), int(fit[0])) if grid.negate else (int(fit[0]), int(fit[-1]))
        if grid.mode == "raw":
            out[value] = value
        elif grid.mode == "trinary" and pixel in fit:
            out[value] = pixel
        else:
            out[value] = {OCCUPIED: black, FREE: white}.get(value, int(fit[len(fit) // 2]))
    return out


def _apply_thresholds(grid: OccupancyGrid, context: WriteContext) -> OccupancyGrid:
    """Values between free and occupied put to the thresholds, as trinary knows three values only."""
    value = np.arange(256)
    table = np.where(value >= grid.occupied_thresh * OCCUPIED, OCCUPIED, UNKNOWN)
    table[value <= grid.free_thresh * OCCUPIED] = FREE
    table[[FREE, OCCUPIED, UNKNOWN]] = FREE, OCCUPIED, UNKNOWN
    between = int(grid.cells.size) - sum(int(np.count_nonzero(grid.cells == v)) for v in (FREE, OCCUPIED, UNKNOWN))
    context.drop("cells between free and occupied", between, "mode=trinary knows free, occupied and unknown only")
    return replace(grid, cells=images.apply_table(grid.cells, table.astype(np.uint8).tobytes())) if between else grid


def _yaml_text(grid: OccupancyGrid, picture: str) -> bytes:
    """The keys in map_saver's order, numbers as short as they read back exactly, then what else the source said."""
    origin = ", ".join(_float(v) for v in grid.origin)
    lines = [
        f"image: {_text(picture)}",
        f"mode: {grid.mode}",
        f"resolution: {_float(grid.resolution)}",
        f"origin: [{origin}]",
        f"negate: {int(grid.negate)}",
        f"occupied_thresh: {_float(grid.occupied_thresh)}",
        f"free_thresh: {_float(grid.free_thresh)}",
    ]
    extra = grid.properties.get(NAME)
    if isinstance(extra, Mapping):
        lines += [f"{_text(key)}: {_value(value)}" for key, value in extra.items() if key not in KEYS]
    return ("\n".join(lines) + "\n").encode()


def _float(value: float) -> str:
    """repr, with the point that YAML 1.1 wants before an exponent; no -0.0."""
    text = repr(float(value) + 0.0)
    return text.replace("e", ".0e") if "e" in text and "." not in text else text


_PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_./-]*")
_ESCAPE = re.compile("[\x7f-\x9f\u2028\u2029\ufeff\ufffe\uffff]")


def _text(value: str) -> str:
    """A YAML scalar that is read as this text."""
    if _PLAIN.fullmatch(value) and value not in yaml.CONSTANTS:
        return value
    quoted = json.dumps(value, ensure_ascii=False)
    return _ESCAPE.sub(lambda match: f"\\u{ord(match.group()):04x}", quoted)


def _value(value: Any) -> str:
    """Any JSON-like value as YAML in flow style."""
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, bool) or value is None:
        return json.dumps(value)
    if isinstance(value, float):
        return _float(value)
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_text(str(k))}: {_value(v)}" for k, v in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_value, value)) + "]"
    return str(int(value))


def _picture(grid: OccupancyGrid, pixels: Table, kind: Literal["pgm", "png"]) -> bytes:
    table = pixels.tobytes()
    if kind == "pgm":
        header = f"P5\n{grid.width} {grid.height}\n255\n".encode()
        out = io.BytesIO()
        out.seek(len(header) + grid.cells.size - 1)
        out.write(
            b"\0"
        )  # all of it at once: a buffer that grows is copied, and so is what ``join`` or ``+`` make of parts
        out.seek(0)
        out.write(header)
        rows = max(1, images.STRIP // grid.width)
        for top in range(grid.height, 0, -rows):
            out.write(grid.cells[max(0, top - rows) : top][::-1].tobytes().translate(table))
        return out.getvalue()
    rule = _rule(grid.mode, grid.negate, grid.occupied_thresh, grid.free_thresh)
    if rule[pixels[UNKNOWN]] == UNKNOWN or not bool((grid.cells == UNKNOWN).any()):
        return images.encode_png(grid.cells, flip=True, table=table)
    both = np.empty((grid.height, grid.width, 2), np.uint8)
    both[..., 0] = images.apply_table(grid.cells, table)
    both[..., 1] = 255
    both[..., 1][grid.cells == UNKNOWN] = 0
    return images.encode_png(both, flip=True)


# --- other cells --------------------------------------------------------------------------------------------------
_RANK = np.concatenate([[0], np.arange(2, OCCUPIED + 2), np.zeros(UNKNOWN - OCCUPIED - 1), [1]]).astype(np.uint8)
_OF_RANK = np.concatenate([[FREE, UNKNOWN], np.arange(1, OCCUPIED + 1), np.zeros(256 - OCCUPIED - 2)]).astype(np.uint8)
"""Free < unknown < any known value above free: the order in which one cell is made of several."""


def resample(grid: OccupancyGrid, resolution: float) -> OccupancyGrid:
    """The same place in cells of another size, from the same corner.

    A coarser cell has the highest value that it covers, where unknown counts just above free: no obstacle gets lost,
    nothing unseen becomes free. A finer cell has the value of the cell at its centre. Raises Invalid if too many cells.
    """
    ratio = resolution / grid.resolution
    shape = [max(1, math.ceil(n / ratio - 1e-6)) for n in grid.cells.shape]
    _check_count(shape[0] * shape[1], "resolution")
    if ratio < 1.0:
        rows, columns = (
            np.minimum(((np.arange(n) + 0.5) * ratio).astype(np.intp), last - 1)
            for n, last in zip(shape, grid.cells.shape, strict=True)
        )
        return replace(grid, cells=grid.cells.take(rows, 0).take(columns, 1), resolution=resolution)
    ranks = images.apply_table(grid.cells, _RANK.tobytes())
    for axis in (0, 1):
        n, old = shape[axis], ranks.shape[axis]
        edges = np.arange(n + 1) * ratio
        starts = np.minimum(np.floor(edges[:-1] + 1e-6).astype(np.intp), old - 1)
        ends = np.clip(np.ceil(edges[1:] - 1e-6).astype(np.intp), starts + 1, old)
        # Cells may share a row of old ones, so no single reduceat: the highest of each width, step by step.
        out = np.take(ranks, starts, axis)
        for step in range(1, int((ends - starts).max())):
            np.maximum(out, np.take(ranks, np.minimum(starts + step, ends - 1), axis), out=out)
        ranks = out
    return replace(grid, cells=images.apply_table(ranks, _OF_RANK.tobytes()), resolution=resolution)


def normalize(grid: OccupancyGrid) -> OccupancyGrid:
    """The same place with yaw 0 and an origin that is a whole multiple of the resolution; unknown outside.

    A cell has the value of the old cell at its centre, or that of an occupied one whose centre it holds, whichever is
    higher: no obstacle gets lost. Raises Invalid if too many cells.
    """
    size, (x, y, yaw) = grid.resolution, grid.origin
    steps = [v / size for v in (x, y)]
    if yaw == 0.0 and all(abs(s - round(s)) < 1e-6 for s in steps):
        return replace(grid, origin=(round(round(steps[0]) * size, 9), round(round(steps[1]) * size, 9), 0.0))
    cos, sin = math.cos(yaw), math.sin(yaw)
    corners = grid.corners() / size
    low = np.floor(corners.min(axis=0) + 1e-6).astype(np.int64)
    high = np.maximum(np.ceil(corners.max(axis=0) - 1e-6).astype(np.int64), low + 1)
    width, height = (int(v) for v in high - low)
    _check_count(width * height, "normalize")
    source = images.apply_table(grid.cells, _RANK.tobytes())
    ranks = np.empty((height, width), np.uint8)
    u = np.arange(width) + (float(low[0]) + 0.5 - steps[0])
    step = max(1, images.STRIP // 8 // width)
    for row in range(0, height, step):
        v = (np.arange(row, min(height, row + step)) + (float(low[1]) + 0.5 - steps[1]))[:, None]
        column = np.floor(u * cos + v * sin + 1e-9).astype(np.int32)
        line = np.floor(v * cos - u * sin + 1e-9).astype(np.int32)
        inside = (column >= 0) & (column < grid.width) & (line >= 0) & (line < grid.height)
        block = np.full(inside.shape, _RANK[UNKNOWN])
        block[inside] = source[line[inside], column[inside]]
        ranks[row : row + len(block)] = block
    for row in range(0, grid.height, step):
        high_line, high_column = np.nonzero(source[row : row + step] > _RANK[UNKNOWN])
        p, q = high_column + 0.5, high_line + (row + 0.5)
        at_x = np.floor(p * cos - q * sin + (steps[0] - float(low[0]))).astype(np.intp).clip(0, width - 1)
        at_y = np.floor(p * sin + q * cos + (steps[1] - float(low[1]))).astype(np.intp).clip(0, height - 1)
        np.maximum.at(ranks, (at_y, at_x), source[row + high_line, high_column])
    origin = (round(float(low[0]) * size, 9), round(float(low[1]) * size, 9), 0.0)
    return replace(grid, cells=images.apply_table(ranks, _OF_RANK.tobytes()), origin=origin)


def _check_count(count: int, location: str) -> None:
    maximum = Limits().pixels
    if count > maximum:
        reason = f"the map would have {count} cells; at most {maximum} are made: ask for a coarser resolution"
        raise Invalid(reason, [Problem(reason, where=location)])


register(
    Format(
        name=NAME,
        title="Occupancy grid (Nav2, ROS map_server)",
        files={"map.yaml": "application/yaml", "map.pgm": "image/x-portable-graymap"},
        layers=frozenset({"occupancy"}),
        detect=detect,
        read=read,
        write=write,
        needs=LayerRequirements(one_of=(frozenset({"occupancy"}),)),
        read_options=ReadOptions,
        write_options=WriteOptions,
        check=_occupancy_grid_rules.check,
        version=4,
        extensions=(*YAML_ENDS, *IMAGE_ENDS),
        selection=Selection(choose, options_from_filename, Parts("occupancy", "grid", file_stem)),
        claims=Claims(priority=40, companions=companions),
    )
)

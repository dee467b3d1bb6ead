"""Writing map_server files: selection of grids, their images and YAML files."""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from app.errors import Invalid, Problem
from app.formats import WriteContext, _masks
from app.formats._select import file_stem, select_part
from app.formats.occupancy_grid import geotiff_grid
from app.formats.occupancy_grid.resampling import normalize, resample
from app.formats.occupancy_grid.words import KEYS, MAP_SAVER_PIXELS, NAME, Table, cell_table, reads_unknown_as_free
from app.model.geodesy import LocalFrame
from app.model.grid import (
    FREE,
    OCCUPIED,
    UNKNOWN,
    UNKNOWN_GREY,
    Mode,
    OccupancyGrid,
    pack_cells,
    unknown_grey,
    unknown_grey_as_unknown,
    without_unknown_grey,
)
from app.model.layers import Layers, PartKey
from app.parameters import parameter
from app.syntax import geotiff, images, yaml
from app.syntax.decimals import DEGREES

Picture = Literal["pgm", "png"]


@dataclass(frozen=True, slots=True)
class WriteOptions:
    """Selection of the grid, and its encoding."""

    grid: str | None = parameter(
        None, "name of the grid; *: all, including masks drawn from zones; default: map, else the only one"
    )
    level: str | None = parameter(None, "level of the grid; *: all; default: ground, or the only one that has it")
    file_type: Literal["pgm", "png", "tif"] | None = parameter(
        None,
        "image format; tif: a cloud optimized GeoTIFF for GIS instead of both files (0 free to 100 occupied, no data "
        "255 unknown); default: pgm, or png if unknown can only be transparent",
    )
    world_file: bool = parameter(
        False, "with file_type=png: also a world file (.pgw) and the CRS (.png.aux.xml), for GIS"
    )
    mode: Literal["trinary", "scale", "raw"] | None = parameter(
        None, "encoding of cells as grey values; default: as uploaded, or raw if that cannot represent every value"
    )
    resolution: float | None = parameter(
        None,
        "resample to this cell size: a coarser cell has the highest value that it covers (unknown is just above "
        "free), a finer one the value of the cell at its centre",
        minimum=1e-3,
        maximum=1e3,
        unit="m",
    )
    normalize: bool = parameter(
        False,
        "rotate the cells to yaw 0 (Nav2 ignores the yaw), unknown outside, and move the origin to a multiple of the "
        "resolution; no obstacle disappears",
    )


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """Write ``<grid>.yaml`` and its image (or ``<grid>.tif``), and ``<grid>_filter_info.yaml`` of a mask.

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
    if options.world_file and options.file_type != "png":
        reason = "world_file is for PNG: set file_type=png, or omit it (a GeoTIFF contains its position)"
        raise Invalid(reason, [Problem(reason, where="world_file")])
    if options.file_type == "tif":
        return _geotiff(grid, options.mode, stem, layers.frame, context)
    grid, pixels, kind = _encoding(grid, options.mode, options.file_type, context, stem + ".yaml")
    grid, pixels = _with_grey(grid, pixels)
    if grid.origin[2] != 0.0:
        reason = (
            f"the origin has a yaw of {grid.origin[2]:g} rad, which Nav2 ignores; request the map with normalize=true"
        )
        context.warn(reason, file=stem + ".yaml", where="origin")
    picture = f"{stem}.{kind}"
    files = {stem + ".yaml": _yaml_text(grid, picture), picture: _picture(grid, pixels, kind)}
    if options.world_file:
        transform, crs = geotiff_grid.place(grid, layers.frame)
        files[f"{stem}.pgw"] = geotiff.world_file(transform, DEGREES)
        if crs is not None:
            files[f"{picture}.aux.xml"] = geotiff.aux_xml(crs, is_local=True)
    return files | _masks.write(grid, stem, context)


def _geotiff(
    grid: OccupancyGrid, mode: Mode | None, stem: str, frame: LocalFrame | None, context: WriteContext
) -> dict[str, bytes]:
    """Write ``<grid>.tif``, and ``<grid>_filter_info.yaml`` of a mask."""
    if mode is not None:
        grid = replace(grid, mode=mode)
    if mode == "trinary":
        grid = _apply_thresholds(grid, context)
    file = f"{stem}.tif"
    return {file: geotiff_grid.write_grid(grid, frame, context, file)} | _masks.write(grid, stem, context)


def choose(keys: Sequence[PartKey], options: WriteOptions) -> Sequence[PartKey]:
    """Choose the named grid, else ``map``, else the only one; on its level, else the ground, else the only one."""
    supply = "upload one (a YAML and its image)"
    return select_part(keys, "occupancy", options.grid, options.level, noun="grid", option="grid", supply=supply)


def _encoding(
    grid: OccupancyGrid, mode: Mode | None, file_type: Picture | None, context: WriteContext, file: str
) -> tuple[OccupancyGrid, Table, Picture]:
    """Return the grid in its output mode, the pixel value of each cell value, and the image format.

    In a PNG, unknown cells without a pixel value are transparent.
    """
    present = np.flatnonzero(_present_file(grid.cells))
    if mode is not None:
        same_mode = mode == grid.mode
        grid = replace(grid, mode=mode)
        if mode == "trinary":
            if not same_mode and _pixels(grid, present) is None:
                grid = replace(grid, occupied_thresh=0.65, free_thresh=0.196)
            grid = _apply_thresholds(grid, context)
            present = np.flatnonzero(_present_file(grid.cells))
        elif mode == "scale" and not same_mode and _pixels(grid, present[present != UNKNOWN]) is None:
            grid = replace(grid, occupied_thresh=1.0, free_thresh=0.0)
    pixels = _pixels(grid, present)
    if pixels is not None:
        return grid, pixels, file_type or "pgm"
    cell_values = present[present != UNKNOWN]
    pixels = _pixels(grid, cell_values)
    if pixels is not None and file_type != "pgm":
        return grid, pixels, "png"
    if mode is not None:
        reason = (
            f"mode={mode} with these thresholds has no grey for unknown: request file_type=png or mode=raw"
            if pixels is not None
            else f"mode={mode} has no grey for every value of this grid: request mode=raw"
        )
        raise Invalid(reason)
    why = "unknown" if pixels is not None else "every value of this grid"
    context.warn(f"{grid.mode} has no grey for {why}; the map is written with mode: raw", file=file, where="mode")
    grid = replace(grid, mode="raw")
    pixels = _pixels(grid, present)
    if pixels is None:
        raise AssertionError("raw represents every value")
    return grid, pixels, file_type or "pgm"


def _with_mask(grid: OccupancyGrid, change: Callable[[OccupancyGrid], OccupancyGrid]) -> OccupancyGrid:
    """Resample a grid; free cells get the grey of unknown if one of their source cells had it."""
    out = without_unknown_grey(change(grid))
    if unknown_grey(grid) is None:
        return out
    grey = (change(unknown_grey_as_unknown(grid)).cells == UNKNOWN) & (out.cells == FREE)
    return replace(out, properties={**out.properties, UNKNOWN_GREY: pack_cells(grey)}) if grey.any() else out


def _with_grey(grid: OccupancyGrid, pixels: Table) -> tuple[OccupancyGrid, Table]:
    """Restore the grey of unknown for free cells that were read from it, with an unused cell value."""
    rule = cell_table(grid.mode, grid.negate, grid.occupied_thresh, grid.free_thresh)
    grey = unknown_grey(grid) if reads_unknown_as_free(rule, grid.mode, negate=grid.negate) else None
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
    """Mark the values that occur, bool [256]."""
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
    """Return for each cell value a pixel that the consumer maps back to it; None if one of ``values`` has none.

    Uses map_saver's pixels if they fit, else the blackest for occupied, the whitest for free, and the middle of the
    fitting ones for other values.
    """
    rule = cell_table(grid.mode, grid.negate, grid.occupied_thresh, grid.free_thresh)
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
    """Apply the thresholds to values between free and occupied: trinary has three values only."""
    value = np.arange(256)
    table = np.where(value >= grid.occupied_thresh * OCCUPIED, OCCUPIED, UNKNOWN)
    table[value <= grid.free_thresh * OCCUPIED] = FREE
    table[[FREE, OCCUPIED, UNKNOWN]] = FREE, OCCUPIED, UNKNOWN
    between = int(grid.cells.size) - sum(int(np.count_nonzero(grid.cells == v)) for v in (FREE, OCCUPIED, UNKNOWN))
    context.drop("cells between free and occupied", between, "mode=trinary has free, occupied and unknown only")
    return replace(grid, cells=images.apply_table(grid.cells, table.astype(np.uint8).tobytes())) if between else grid


def _yaml_text(grid: OccupancyGrid, picture: str) -> bytes:
    """Format the keys in map_saver's order, with shortest exact numbers, then the source's other keys."""
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
    """Format a number like repr, with the point that YAML 1.1 requires before an exponent, and no -0.0."""
    text = repr(float(value) + 0.0)
    return text.replace("e", ".0e") if "e" in text and "." not in text else text


_PLAIN = re.compile(r"[A-Za-z_][A-Za-z0-9_./-]*")
_ESCAPE = re.compile("[\x7f-\x9f\u2028\u2029\ufeff\ufffe\uffff]")


def _text(value: str) -> str:
    """Quote a text as a YAML scalar."""
    if _PLAIN.fullmatch(value) and value not in yaml.CONSTANTS:
        return value
    quoted = json.dumps(value, ensure_ascii=False)
    return _ESCAPE.sub(lambda match: f"\\u{ord(match.group()):04x}", quoted)


def _value(value: Any) -> str:
    """Format a JSON-like value as YAML in flow style."""
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


def _picture(grid: OccupancyGrid, pixels: Table, kind: Picture) -> bytes:
    table = pixels.tobytes()
    if kind == "pgm":
        header = f"P5\n{grid.width} {grid.height}\n255\n".encode()
        out = io.BytesIO()
        out.seek(len(header) + grid.cells.size - 1)
        out.write(b"\0")  # one allocation: a growing buffer, ``join`` and ``+`` would copy
        out.seek(0)
        out.write(header)
        rows = max(1, images.STRIP // grid.width)
        for top in range(grid.height, 0, -rows):
            out.write(grid.cells[max(0, top - rows) : top][::-1].tobytes().translate(table))
        return out.getvalue()
    rule = cell_table(grid.mode, grid.negate, grid.occupied_thresh, grid.free_thresh)
    if rule[pixels[UNKNOWN]] == UNKNOWN or not bool((grid.cells == UNKNOWN).any()):
        return images.encode_png(grid.cells, flip=True, table=table)
    both = np.empty((grid.height, grid.width, 2), np.uint8)
    both[..., 0] = images.apply_table(grid.cells, table)
    both[..., 1] = 255
    both[..., 1][grid.cells == UNKNOWN] = 0
    return images.encode_png(both, flip=True)

"""DXF (AutoCAD), as text: floor plans. Read only.

Each entity of the model space is an object of the family ``dxf``, or what the upload's ``layer`` says; blocks are
resolved, arcs and splines become lines, closed lines become polygons. Its layer, type, line type and text are in
``properties.dxf``; a text is its ``name``, its handle is its id. The option ``layers`` selects layers of the drawing.

The coordinates are in the local frame (or in the option ``crs``) after conversion from the unit in ``$INSUNITS`` to its
unit. If the file names none, the option ``metres_per_unit`` is needed: units are never guessed.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.errors import Invalid, Problem, TooLarge, UnreadableFile
from app.formats import Files, Format, ReadContext, Traits, register
from app.formats.gis.layers import read_tables
from app.formats.gis.shapes import raise_unreadable, scaled
from app.formats.gis.tables import LOCAL, Table, to_parts
from app.model.geodesy import WGS84, length_units
from app.model.layers import VECTOR_LAYERS, Layers
from app.model.names import did_you_mean
from app.parameters import parameter

NAME = "dxf"

UNITS: Mapping[int, float] = {
    1: 0.0254, 2: 0.3048, 3: 1609.344, 4: 1e-3, 5: 1e-2, 6: 1.0, 7: 1e3, 8: 2.54e-8, 9: 2.54e-5, 10: 0.9144, 11: 1e-10,
    12: 1e-9, 13: 1e-6, 14: 0.1, 15: 10.0, 16: 100.0, 17: 1e9, 18: 149_597_870_700.0, 21: 1200 / 3937, 22: 100 / 3937,
    23: 3600 / 3937, 24: 6_336_000 / 3937,
}  # fmt: skip
"""Metres of a unit, by the code in ``$INSUNITS`` (AutoCAD's DXF reference)."""

UTF8_VERSION = 1021
"""First version of AutoCAD's files in UTF-8; older ones name their encoding."""

MAX_DEPTH = 32
"""Maximum nesting of blocks."""

_START = re.compile(rb"\s*(?:999[ \t]*\r?\n[^\n]*\n\s*)*0[ \t]*\r?\n[ \t]*SECTION[ \t]*\r?\n")
_BINARY = b"AutoCAD Binary DXF\r\n\x1a\0"
_UNIT = re.compile(rb"\$INSUNITS[ \t]*\r?\n[ \t]*70[ \t]*\r?\n[ \t]*(\d{1,3})[ \t]*\r?\n")
_VERSION = re.compile(rb"\$ACADVER[ \t]*\r?\n[ \t]*1[ \t]*\r?\n[ \t]*AC(\d{4})[ \t]*\r?\n")
_ENTITY = re.compile(rb"(?:\A|\n)[ \t]*0[ \t]*\r?\n[ \t]*((?:3D)?[A-Z][A-Z0-9_]*)[ \t]*(?=\r?\n)")


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """Unit, position and layers of a drawing."""

    metres_per_unit: float | None = parameter(
        None, "length of a unit of the drawing; default: $INSUNITS of the file", minimum=1e-9, maximum=1e6, unit="m"
    )
    crs: str | None = parameter(
        None, "CRS of a surveyed drawing: EPSG:<number>; default: local (metres of the local frame)"
    )
    layers: tuple[str, ...] | None = parameter(None, "layers of the drawing to read; default: all")


def detect(name: str, data: bytes) -> bool:  # noqa: ARG001
    """Detect the first section, after comments; or the header of a binary DXF, to refuse it with a reason."""
    return _START.match(data[:65536]) is not None or data.startswith(_BINARY)


def read(files: Files, context: ReadContext) -> Layers:
    """Read the model space. Raises UnreadableFile for damaged files and without a unit; TooLarge."""
    data = files[context.main]
    options = context.options if isinstance(context.options, ReadOptions) else ReadOptions()
    if data.startswith(_BINARY):
        raise_unreadable("binary DXF is unsupported: save it as text (ASCII)")
    if len(data) > context.limits.text_bytes:
        raise TooLarge(f"{context.main} has {len(data)} bytes; the limit for a text is {context.limits.text_bytes}")
    unit = _unit(data, options, context)
    check_blocks(data, context.limits.features)
    crs = {LOCAL: LOCAL, "wgs84": WGS84}.get((options.crs or LOCAL).lower(), options.crs or LOCAL)
    factors = _factors(unit, crs, context)
    version = _VERSION.search(data[:65536])
    encoding = "UTF-8" if version is not None and int(version[1]) >= UTF8_VERSION else None
    tables = read_tables(data, "DXF", context, encoding=encoding)
    context.options = None  # its crs is not that of a file without one
    return Layers(to_parts([_objects(table, factors, crs, options, context) for table in tables], context, NAME))


def _unit(data: bytes, options: ReadOptions, context: ReadContext) -> float:
    """Return the metres of a unit."""
    header = _UNIT.search(data, 0, data.find(b"ENTITIES") if b"ENTITIES" in data else len(data))
    code = int(header[1]) if header else 0
    unit = UNITS.get(code)
    chosen = options.metres_per_unit
    if chosen is not None:
        if unit is not None and unit != chosen:
            context.warn(f"option metres_per_unit is used; $INSUNITS states {unit:g} m", where="$INSUNITS")
        return chosen
    if unit is None:
        reason = (
            f"$INSUNITS is {code}, which is no unit: set metres_per_unit (0.001 for millimetres, 1 for metres)"
            if header
            else "the drawing names no unit ($INSUNITS): set metres_per_unit (0.001 for millimetres, 1 for metres)"
        )
        raise UnreadableFile(reason, [Problem(reason, where="$INSUNITS")])
    return unit


def _factors(unit: float, crs: str, context: ReadContext) -> Sequence[float]:
    """Return the factors of x, y and z from the unit of the drawing, in metres, to the units of a CRS."""
    if crs == LOCAL:
        return unit, unit, unit
    try:
        units = length_units(crs)
    except Invalid as error:
        raise UnreadableFile(error.detail, [Problem(error.detail, where="crs")]) from error
    if units is None:
        if unit != 1.0:
            raise_unreadable(
                f"{crs[:60]} has degrees, but the unit of the drawing is {unit:g} m: set the CRS that the drawing was "
                "surveyed in, or metres_per_unit=1 if its coordinates are degrees",
                "crs",
            )
        return 1.0, 1.0, 1.0
    plane, height = unit / units[0], unit / units[1]
    if 1e-9 < abs(plane - 1.0) < 1e-5:
        context.warn(
            f"the unit of the drawing is {unit:.10g} m and that of {crs[:60]} {units[0]:.10g} m, so coordinates are "
            f"converted: set metres_per_unit={units[0]:.10g} if they are in the unit of the CRS",
            where="$INSUNITS",
        )
    return plane, plane, height


def check_blocks(data: bytes, limit: int) -> None:
    """Count the entities after all blocks are resolved, from the references to blocks alone.

    Raises TooLarge beyond the limit, UnreadableFile for blocks that contain themselves.
    """
    sizes, references = _blocks(data)

    @cache
    def size(block: bytes, depth: int) -> int:
        if depth > MAX_DEPTH:
            raise_unreadable(f"blocks are nested deeper than {MAX_DEPTH} levels", block.decode("latin-1")[:80])
        inner = sum(n * size(child, depth + 1) for child, n in references.get(block, {}).items())
        return sizes.get(block, 0) + inner

    count = size(b"", 0)
    if count > limit:
        reason = f"the drawing has {count} entities with all blocks resolved; the limit is {limit}"
        raise TooLarge(reason, [Problem(reason)])


def _blocks(data: bytes) -> tuple[Counter[bytes], dict[bytes, Counter[bytes]]]:
    """Return by block the number of entities and the blocks that it inserts; the model space has no name."""
    sizes: Counter[bytes] = Counter()
    references: dict[bytes, Counter[bytes]] = {}
    block = b""
    starts = list(_ENTITY.finditer(data))
    for k, match in enumerate(starts):
        kind = match[1]
        if kind == b"ENDBLK":
            block = b""
        elif kind in (b"BLOCK", b"INSERT"):
            end = starts[k + 1].start() if k + 1 < len(starts) else len(data)
            lines = [line.strip() for line in data[match.end() : end].split(b"\n")[1:]]
            codes = dict(zip(lines[::2], lines[1::2], strict=False))
            name = codes.get(b"2", b"").upper()
            if kind == b"BLOCK":
                block = name
            else:
                copies = _number(codes.get(b"70")) * _number(codes.get(b"71"))
                references.setdefault(block, Counter())[name] += copies
        else:
            sizes[block] += 1
    return sizes, references


def _number(text: bytes | None) -> int:
    return max(1, int(text)) if text and text.isdigit() and len(text) < 10 else 1


def _objects(table: Table, factors: Sequence[float], crs: str, options: ReadOptions, context: ReadContext) -> Table:
    """Return the entities of the model space as objects; factors: see ``_factors``."""
    columns = table.columns
    layers = [str(value or "0") for value in columns["Layer"]]
    chosen = np.array([not value for value in columns["PaperSpace"]], bool)
    if not chosen.all():
        context.warn(f"{int((~chosen).sum())} entities of the paper space are not read")
    if options.layers is not None:
        chosen &= _in_layers(layers, options.layers)
    indices = np.flatnonzero(chosen).tolist()
    details = [_details(columns, layers, k) for k in indices]
    is_point = shapely.get_type_id(table.geometry[indices]) == 0  # the texts of hatches are names of patterns
    labels = [d.get("text") if point else None for d, point in zip(details, is_point, strict=True)]
    handles = [columns["EntityHandle"][k] for k in indices]
    geometry = _areas(table.geometry[indices])
    return Table(NAME, {"id": handles, "name": labels, "dxf": details}, scaled(geometry, factors), crs)


def _in_layers(layers: list[str], names: tuple[str, ...]) -> NDArray[np.bool_]:
    """Select entities by layer. Raises UnreadableFile for a layer that the drawing does not have."""
    available = sorted(set(layers))
    for name in names:
        if name.strip() not in available:
            near = did_you_mean(name, available)
            reason = f"unknown layer {name[:80]!r}{near}; available: {', '.join(available)[:500]}"
            raise UnreadableFile(reason, [Problem(reason, where="layers")])
    accepted = {name.strip() for name in names}
    return np.array([layer in accepted for layer in layers], bool)


def _details(columns: Mapping[str, Any], layers: list[str], k: int) -> dict[str, str]:
    values = {"layer": layers[k], "class": columns["SubClasses"][k], "line": columns["Linetype"][k]}
    values["text"] = columns["Text"][k]
    return {name: str(value) for name, value in values.items() if value}


def _areas(geometry: NDArray[np.object_]) -> NDArray[np.object_]:
    """Turn closed lines that enclose an area into polygons, also those of a block."""
    out = geometry.copy()
    for k in np.flatnonzero(np.isin(shapely.get_type_id(out), (1, 5))):
        lines = shapely.get_parts(out[k])
        if not ((shapely.get_num_points(lines) > 3) & shapely.is_closed(lines)).all():
            continue
        deep = bool(shapely.has_z(out[k]))
        polygons = np.array([shapely.polygons(shapely.get_coordinates(line, include_z=deep)) for line in lines])
        if bool((shapely.is_valid(polygons) & (shapely.area(polygons) > 0.0)).all()):
            out[k] = polygons[0] if len(polygons) == 1 else shapely.multipolygons(polygons)
    return out


register(
    Format(
        name=NAME,
        title="DXF drawing",
        files={"map.dxf": "image/vnd.dxf"},
        layers=frozenset(VECTOR_LAYERS),
        detect=detect,
        read=read,
        read_options=ReadOptions,
        extensions=(".dxf",),
        traits=Traits(is_drawing=True),
    )
)

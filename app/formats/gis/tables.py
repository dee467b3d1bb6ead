"""Rules that files of GIS programs share: their tables become objects, or the layers that our own data describes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, cast

import numpy as np
import orjson
import shapely
from numpy.typing import NDArray

from app.errors import Invalid, Problem, TooLarge, UnreadableFile
from app.formats import ReadContext
from app.formats.gis.shapes import scaled, transformed
from app.model.features import MAX_ID, Features, Properties, unique_ids
from app.model.frame import MAX_METRES, is_writable
from app.model.geodesy import WGS84, crs_to_wgs84, engineering_unit
from app.model.layers import VECTOR_LAYERS, Layer, Part, PartKey
from app.parameters import parameter
from app.syntax.decimals import DEGREES

LOCAL: Final = "local"
"""CRS of coordinates in metres of the local frame."""

MARKS = ("layer", "level", "part")
MORE = "more"
"""Columns that say where a feature of ours belongs, and the one with the properties that have no column."""

MAX_COLUMNS = 200
"""Maximum number of columns of a written table; SQLite allows 2000."""

MAX_COLUMN_NAME = 60
MAX_CRS = 2**16
"""Maximum length of a CRS definition, in characters."""

ColumnType = Literal["text", "integer", "real", "boolean"]


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """Position of a file that does not contain its CRS."""

    crs: str | None = parameter(
        None, "CRS of a file that names none: EPSG:<number>, wgs84 (longitude, latitude) or local (metres)"
    )


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """One layer of a file. Every column has a value or None for each of the n rows.

    geometry: object [n], NO_GEOMETRY if absent. crs: code or WKT, LOCAL, or None if the file names none.
    """

    name: str
    columns: Mapping[str, Sequence[Any]]
    geometry: NDArray[np.object_]
    crs: str | None

    def __len__(self) -> int:
        return len(self.geometry)


@dataclass(frozen=True, slots=True)
class Column:
    """Column of a table to write: None where a feature lacks the property."""

    name: str
    type: ColumnType
    values: list[Any]


# --- reading ----------------------------------------------------------------------------------------------------------
def to_parts(tables: Sequence[Table], context: ReadContext, family: str) -> dict[PartKey, Part]:
    """Convert tables to parts: rows with our own marks to theirs, all others to objects of this family.

    Raises UnreadableFile for a CRS that is missing or unknown, and for positions that are not on earth; TooLarge.
    """
    count = sum(map(len, tables))
    if count > context.limits.features:
        raise TooLarge(f"{context.main} has {count} features; the limit is {context.limits.features}")
    home = PartKey("objects", context.level, family)
    rows: dict[PartKey, list[tuple[str, Any, Properties, bool]]] = {}
    for table in tables:
        geometry, local = _place(table, context)
        marks = _marks(table)
        for k, properties in enumerate(_rows(table)):
            if marks[k] is None:
                item = _foreign(properties, geometry[k], f"{table.name}/{k + 1}")
                rows.setdefault(home, []).append((*item, local))
            else:
                row_id, stored_properties = _marked(properties, f"{table.name}/{k + 1}", table)
                rows.setdefault(cast(PartKey, marks[k]), []).append((row_id, geometry[k], stored_properties, local))
    return {key: _features(items, context) for key, items in rows.items()}


def _features(items: Sequence[tuple[str, Any, Properties, bool]], context: ReadContext) -> Features:
    file_ids = [i for i, _, _, _ in items]
    ids = unique_ids(file_ids)
    repeats = [a for a, b in zip(ids, file_ids, strict=True) if a != b]
    if repeats:
        context.warn(f"{len(repeats)} duplicate ids; later ones got #2, #3 …", where=repeats[0])
    geometry = np.empty(len(items), object)
    for k, (_, shape, _, _) in enumerate(items):
        geometry[k] = shape
    local = np.array([is_local for *_, is_local in items], bool)
    return Features(tuple(ids), geometry, tuple(p for _, _, p, _ in items), local)


def _rows(table: Table) -> list[dict[str, Any]]:
    """Return the values of each row by column, without the absent ones."""
    rows: list[dict[str, Any]] = [{} for _ in range(len(table))]
    for name, values in table.columns.items():
        for row, value in zip(rows, values, strict=True):
            if value is not None and not (isinstance(value, float) and not math.isfinite(value)):
                row[name] = value
    return rows


def _marks(table: Table) -> list[PartKey | None]:
    """Return the part of each row: new rows of a table of ours belong where its first one does."""
    if not set(MARKS) <= table.columns.keys():
        return [None] * len(table)
    keys = [
        PartKey(cast(Layer, layer), level, part)
        if layer in VECTOR_LAYERS and isinstance(level, str) and isinstance(part, str) and level and part
        else None
        for layer, level, part in zip(*(table.columns[name] for name in MARKS), strict=True)
    ]
    default = next((key for key in keys if key is not None), None)
    return [default if key is None else key for key in keys]


def _foreign(row: dict[str, Any], shape: Any, default: str) -> tuple[str, Any, Properties]:
    """Return id, geometry and properties of a row that is not ours: its columns are its properties."""
    title = next((name for name in row if name.lower() == "name" and isinstance(row[name], str)), None)
    if title is not None and "name" not in row:
        row = {"name": row[title], **{k: v for k, v in row.items() if k != title}}
    elif not isinstance(row.get("name", ""), str):
        row["name"] = str(row["name"])
    identifier = row.get("id", row.get("name"))
    text = str(identifier) if isinstance(identifier, str | int) and not isinstance(identifier, bool) else ""
    if not _is_id(text):
        text = default
    elif "id" in row:
        del row["id"]
    for name in ("kind", "name"):
        if row.get(name) == "":
            del row[name]
    if not isinstance(row.get("kind"), str):
        if "kind" in row:
            row["class"] = row.pop("kind")
        row = {"kind": ("note", "poi", "path", "region")[int(shapely.get_dimensions(shape)) + 1], **row}
    return text, shape, row


def _marked(row: dict[str, Any], default: str, table: Table) -> tuple[str, Properties]:
    """Return id and properties of a row of ours, with those in ``more`` unless their column was edited."""
    identifier = row.pop("id", None)
    text = str(identifier) if identifier is not None and _is_id(str(identifier)) else default
    for name in MARKS:
        row.pop(name, None)
    packed = row.pop(MORE, None)
    if isinstance(packed, str):
        try:
            further = orjson.loads(packed)
        except orjson.JSONDecodeError as error:
            reason = f"the column {MORE} must be JSON: {error.msg}"
            raise UnreadableFile(f"{default}: {reason}", [Problem(reason, where=default)]) from error
        if not isinstance(further, dict):
            reason = f"the column {MORE} must be a JSON object"
            raise UnreadableFile(f"{default}: {reason}", [Problem(reason, where=default)])
        for name, value in further.items():
            if name not in table.columns or name in (*MARKS, "id", MORE) or row.get(name) == value:
                row[name] = value
    return text, row


def _is_id(text: str) -> bool:
    return bool(text) and len(text) <= MAX_ID and is_writable(text)


def _place(table: Table, context: ReadContext) -> tuple[NDArray[np.object_], bool]:
    """Return the geometries of a table in metres of the local frame or in degrees, and whether they are in metres."""
    option = getattr(context.options, "crs", None)
    crs = table.crs
    if crs is None:
        if option is None:
            reason = (
                f"{table.name} names no CRS (a shapefile's is in its .prj): set crs=EPSG:<number>, crs=wgs84 "
                "(longitude, latitude) or crs=local (metres)"
            )
            raise UnreadableFile(reason, [Problem(reason, where="crs")])
        crs = {"wgs84": WGS84, LOCAL: LOCAL}.get(option.lower(), option)
    elif option is not None:
        context.warn("option crs is ignored: the file names its own CRS", where="crs")
    if len(crs) > MAX_CRS:
        reason = f"the CRS definition has {len(crs)} characters; the limit is {MAX_CRS}"
        raise UnreadableFile(reason, [Problem(reason, where="crs")])
    try:
        return convert(table.geometry, crs)
    except Invalid as error:
        raise UnreadableFile(f"{table.name}: {error.detail}", [Problem(error.detail, where="crs")]) from error


def convert(geometry: NDArray[np.object_], crs: str) -> tuple[NDArray[np.object_], bool]:
    """Convert geometries of a CRS to metres of the local frame if it is an engineering CRS, else to degrees.

    Degrees of WGS 84 stay as they are. Raises Invalid for an unknown CRS and for positions that it does not cover.
    """
    if crs == LOCAL:
        return _checked(geometry, MAX_METRES, MAX_METRES, "±1e7 metres"), True
    unit = engineering_unit(crs)
    if unit is not None:
        metres = geometry if unit == 1.0 else scaled(geometry, (unit, unit, unit))
        return _checked(metres, MAX_METRES, MAX_METRES, "±1e7 metres"), True
    if crs.upper() not in (WGS84, "OGC:CRS84"):
        _checked(geometry, 1e15, 1e15, "what a CRS covers")
        geometry = transformed(geometry, lambda points: np.column_stack(_degrees(crs, points)))
    return _checked(geometry, 180.0, 90.0, f"the area of the CRS {crs[:60]}"), False


def _degrees(crs: str, points: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    if points.shape[1] == 2:
        points = np.column_stack([points, np.zeros(len(points))])
        return tuple(np.round(crs_to_wgs84(crs, points)[:, :2], DEGREES).T)
    out = crs_to_wgs84(crs, points)
    return (*np.round(out[:, :2], DEGREES).T, out[:, 2])


def _checked(geometry: NDArray[np.object_], x: float, y: float, area: str) -> NDArray[np.object_]:
    """Return the geometries. Raises Invalid if a coordinate is not finite or beyond these bounds."""
    coordinates = shapely.get_coordinates(geometry)
    bad = np.flatnonzero(~(np.abs(coordinates) <= (x, y)).all(axis=1))
    if len(bad):
        east, north = coordinates[bad[0]].tolist()
        raise Invalid(f"the position ({east:g}, {north:g}) is outside {area}: check the CRS and the order of the axes")
    return geometry


# --- writing ----------------------------------------------------------------------------------------------------------
def columns(part_keys: Sequence[PartKey], ids: Sequence[str], properties: Sequence[Properties]) -> list[Column]:
    """Return the columns of features: id, layer, level, part, then properties, and ``more`` for those without a column.

    Texts, numbers and truth values of one type get a column; numbers may be mixed. ``more`` is JSON with everything
    that the columns cannot express exactly.
    """
    out = [Column("id", "text", list(ids))]
    for name in MARKS:
        places = [key.layer if name == "layer" else key.level if name == "level" else key.name for key in part_keys]
        out.append(Column(name, "text", list(places)))
    types = _column_types(properties)
    further: list[dict[str, Any]] = [{} for _ in properties]
    for k, row in enumerate(properties):
        for name, value in row.items():
            kind = types.get(name)
            if kind is None or value is None or (kind == "real" and (type(value) is int or str(value) == "-0.0")):
                further[k][name] = value
    for name, kind in types.items():
        values: list[Any] = [row.get(name) for row in properties]
        out.append(Column(name, kind, [float(v) if kind == "real" and v is not None else v for v in values]))
    if any(further):
        packed = [orjson.dumps(row, option=orjson.OPT_SORT_KEYS).decode() if row else None for row in further]
        out.append(Column(MORE, "text", list(packed)))
    return out


_FIRST = ("kind", "name", "source", "target")
_TYPES: Mapping[frozenset[type], ColumnType] = {
    frozenset({str}): "text",
    frozenset({bool}): "boolean",
    frozenset({int}): "integer",
    frozenset({float}): "real",
    frozenset({int, float}): "real",
}


def _column_types(properties: Sequence[Properties]) -> dict[str, ColumnType]:
    """Choose the properties that get a column: the most frequent ones, if their names and types allow it."""
    types: dict[str, set[type]] = {}
    counts: dict[str, int] = {}
    for row in properties:
        for name, value in row.items():
            seen = types.setdefault(name, set())
            if value is not None:
                seen.add(type(value) if _fits(value) else object)
                counts[name] = counts.get(name, 0) + 1
    taken = {"fid", "geom", "id", MORE, *MARKS}
    out: dict[str, ColumnType] = {}
    for name in sorted(types, key=lambda name: (-counts.get(name, 0), name)):
        kind = _TYPES.get(frozenset(types[name]))
        usable = 0 < len(name) <= MAX_COLUMN_NAME and name.isprintable() and name.strip() == name
        if kind is not None and usable and name.lower() not in taken and len(out) < MAX_COLUMNS:
            taken.add(name.lower())
            out[name] = kind
    order = sorted(out, key=lambda name: (_FIRST.index(name) if name in _FIRST else len(_FIRST), name))
    return {name: out[name] for name in order}


def _fits(value: Any) -> bool:
    """Whether a column can express a value: no integer beyond 64 bits, and no character that ends a text."""
    if isinstance(value, str):
        return "\0" not in value
    return not isinstance(value, int) or -(2**63) <= value < 2**63

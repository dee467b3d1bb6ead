"""Indexes that find environments by text, and SQLite's by box and areas by position; triggers keep them.

PostgreSQL has GiST for boxes. An index is used where it leaves few rows: a list of environments in the order of their
names is faster if most of them match. PostgreSQL decides that itself.
"""

from __future__ import annotations

from typing import Any, Final

import orjson
from sqlalchemy import (
    ColumnElement,
    Connection,
    LargeBinary,
    Select,
    and_,
    cast,
    column,
    func,
    literal,
    or_,
    select,
    table,
    tuple_,
)
from sqlalchemy.dialects.postgresql import TSQUERY

from app.store import tables
from app.store.column_types import from_wkb
from app.store.extent import geometry as to_geometry
from app.store.grams import GRAM, wanted_grams
from app.store.parts.boxes import split_box
from app.store.values import Box

MANY: Final = 500
"""Number of environments above which the list is read in the order of names."""

_NUMBER: Final = table("box_number", column("number"), column("environment_id"), column("piece"))
_TREE: Final = table("box_tree", *(column(name) for name in ("number", "west", "east", "south", "north")))
_TEXT: Final = table("environment_text", column("rowid"), column("environment_text"))
_GRAMS: Final = table("environment_text", column("environment_id"), column("grams"))
"""PostgreSQL's index of the same texts."""

_WHOLE: Final = -1
"""Piece that stands for an environment's extent."""


def intersects(table: Any, geometry: ColumnElement[Any], box: Box, dialect: str) -> ColumnElement[bool]:
    """Return a condition: the row's box, or on PostgreSQL its geometry's, intersects a box in degrees."""
    conditions: list[ColumnElement[bool]] = []
    for part in split_box(box):
        if dialect == "postgresql":
            shape = from_wkb(literal(to_geometry(part), LargeBinary))
            conditions.append(func.ST_Intersects(geometry, shape))
            continue
        west, south, east, north = part
        across = table.c.west > table.c.east
        inside = and_(table.c.west <= east, table.c.east >= west)
        wrapped = and_(across, or_(table.c.west <= east, table.c.east >= west))
        conditions.append(and_(table.c.south <= north, table.c.north >= south, or_(and_(~across, inside), wrapped)))
    return or_(*conditions)


def few_environments(connection: Connection, q: str | None, box: Box | None) -> list[ColumnElement[bool]]:
    """Return conditions on environments that an index answers: none is stricter than what ``filters`` returns.

    q: text in name, title, description or tags. box: west, south, east, north; west > east: antimeridian.
    """
    if connection.dialect.name == "postgresql":
        return [tables.environment.c.id.in_(_with_text(q.lower()))] if q else []
    choices: list[Select[Any]] = []
    if q is not None and len(q) >= GRAM:
        text = _TEXT.c.environment_text.op("MATCH")(wanted_grams(q.lower(), sqlite=True))
        choices.append(select(_NUMBER.c.environment_id).join(_TEXT, _TEXT.c.rowid == _NUMBER.c.number).where(text))
    if box is not None:
        choices.append(_boxes(box).with_only_columns(_NUMBER.c.environment_id).where(_NUMBER.c.piece == _WHOLE))
    out: list[ColumnElement[bool]] = []
    for chosen in choices:
        ids = connection.execute(chosen.limit(MANY + 1)).scalars().all()
        if len(ids) <= MANY:  # listed, since asking the index again costs as much
            listed = func.json_each(orjson.dumps(ids).decode()).table_valued("value")
            out.append(tables.environment.c.id.in_(select(listed.c.value)))
    return out


def _with_text(needle: str) -> Select[Any]:
    wanted = cast(literal(wanted_grams(needle, sqlite=False)), TSQUERY)
    return select(_GRAMS.c.environment_id).where(_GRAMS.c.grams.op("@@")(wanted))


def pieces_around(longitude: float, latitude: float) -> ColumnElement[bool]:
    """Return a condition: the box of an area's piece covers a position in degrees."""
    area = tables.area
    boxes = _boxes((longitude, latitude, longitude, latitude))
    around = boxes.with_only_columns(_NUMBER.c.environment_id, _NUMBER.c.piece)
    return tuple_(area.c.environment_id, area.c.piece).in_(around)


def _boxes(box: Box) -> Select[Any]:
    """Select what intersects a box. The index rounds its boxes outwards, to 32 bits."""
    tree = _TREE.c
    meets = [
        and_(tree.west <= east, tree.east >= west, tree.south <= north, tree.north >= south)
        for west, south, east, north in split_box(box)
    ]
    return select(_NUMBER.c.number).join(_TREE, _TREE.c.number == _NUMBER.c.number).where(or_(*meets))

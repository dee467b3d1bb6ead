"""Spatial index of the heads' vector items on earth, for queries across environments.

The index is narrow and can be rebuilt from the trees. A commit that changes few items updates it; otherwise
``environment.indexed`` stays behind the head, and the next query applies the differences.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from sqlalchemy import (
    ColumnElement,
    Connection,
    LargeBinary,
    Row,
    and_,
    delete,
    func,
    insert,
    literal,
    or_,
    select,
    update,
)

from app.model.layers import VECTOR_LAYERS, Layer, PartKey
from app.store import diff, tables
from app.store.changes import IndexRows
from app.store.chunks import Chunks
from app.store.column_types import from_wkb
from app.store.database import Database
from app.store.extent import geometry as to_geometry
from app.store.manifest import read_if_kept, read_version
from app.store.parts.boxes import split_box
from app.store.prepare import differing_keys, index_rows, read_roots
from app.store.values import Box, FeatureHit, PartEntry, Version

BATCH: Final = 500


def apply(connection: Connection, environment_id: str, rows: Sequence[IndexRows]) -> None:
    """Apply changes to the index."""
    table = tables.place
    for one in rows:
        condition = and_(
            table.c.environment_id == environment_id,
            table.c.layer == one.key.layer,
            table.c.level == one.key.level,
            table.c.name == one.key.name,
        )
        for start in range(0, len(one.removed), BATCH):
            some = list(one.removed[start : start + BATCH])
            connection.execute(delete(table).where(condition, table.c.feature.in_(some)))
        if one.put:
            connection.execute(
                insert(table),
                [
                    {
                        "environment_id": environment_id,
                        "layer": one.key.layer,
                        "level": one.key.level,
                        "name": one.key.name,
                        "feature": i,
                        "west": box[0],
                        "south": box[1],
                        "east": box[2],
                        "north": box[3],
                        "geometry": wkb,
                    }
                    for i, box, wkb in one.put
                ],
            )


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


class SpatialIndex:
    """Queries across environments."""

    def __init__(self, database: Database, chunks: Chunks) -> None:
        self._database, self._chunks = database, chunks

    def find(self, bbox: Box, *, layer: Layer | None = None, limit: int = 1000) -> list[FeatureHit]:
        """List features of all heads that intersect ``bbox`` (west, south, east, north; west > east: antimeridian).

        By their box on SQLite, by their geometry on PostgreSQL. Sorted by environment, part and id.
        """
        if not self._database.readonly:
            self.refresh()
        table, owner = tables.place, tables.environment
        query = (
            select(table, owner.c.name.label("environment"))
            .join(owner, owner.c.id == table.c.environment_id)
            .where(
                owner.c.deleted.is_(None),
                intersects(table, table.c.geometry, bbox, self._database.engine.dialect.name),
            )
            .order_by(owner.c.name, table.c.layer, table.c.level, table.c.name, table.c.feature)
        )
        if layer is not None:
            query = query.where(table.c.layer == layer)
        with self._database.read() as connection:
            rows = connection.execute(query.limit(limit)).all()
        return [
            FeatureHit(r.environment, PartKey(r.layer, r.level, r.name), r.feature, (r.west, r.south, r.east, r.north))
            for r in rows
        ]

    def refresh(self) -> int:
        """Update the index of every environment to its head; returns how many were behind."""
        table = tables.environment
        with self._database.read() as connection:
            behind = list(connection.execute(select(table.c.id).where(table.c.index_stale)).scalars())
        for environment_id in behind:
            self._refresh(environment_id)
        return len(behind)

    def _refresh(self, environment_id: str) -> None:
        table = tables.environment
        with self._database.write(upkeep=True) as connection:
            row = connection.execute(select(table).where(table.c.id == environment_id).with_for_update()).one_or_none()
            if row is None or row.indexed == row.head:
                return
            head = read_version(connection, row, row.head)
            before = read_if_kept(connection, row, row.indexed) if row.indexed >= 0 else None
            self._catch_up(connection, row, before, head)
            connection.execute(update(table).where(table.c.id == row.id).values(indexed=row.head))

    def _catch_up(self, connection: Connection, row: Row[Any], before: Version | None, head: Version) -> None:
        old: dict[PartKey, PartEntry] = {}
        if before is not None and before.datum == head.datum:
            old = {e.key: e for e in before.parts}
        else:
            connection.execute(delete(tables.place).where(tables.place.c.environment_id == row.id))
        new = {e.key: e for e in head.parts}
        draft = self._chunks.stage()
        for key in differing_keys(old, new):
            if key.layer not in VECTOR_LAYERS:
                continue
            changed = diff.features(draft, read_roots(draft, key, old), read_roots(draft, key, new))
            apply(connection, row.id, index_rows({key: changed}, head.datum, None) or ())

    def rebuild(self) -> None:
        """Rebuild the index from the trees."""
        with self._database.write(upkeep=True) as connection:
            connection.execute(delete(tables.place))
            connection.execute(update(tables.environment).values(indexed=-1))
        self.refresh()

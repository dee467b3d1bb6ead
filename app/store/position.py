"""Environments at a position, by their areas in the database."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import shapely
from sqlalchemy import Boolean, ColumnElement, Connection, LargeBinary, and_, func, literal, or_, select, update

from app.errors import Damaged, Invalid, Problem
from app.model.geodesy import distance
from app.store import column_types, tables
from app.store.area import compute_area, write_area
from app.store.base import as_environment, datum_from_row
from app.store.box_index import pieces_around
from app.store.chunks import Chunks
from app.store.database import Database
from app.store.encode import from_wkb, to_wkb
from app.store.environments import filters, reaches
from app.store.manifest import read_version
from app.store.values import Area, Box, Environment, Match

log = logging.getLogger(__name__)

BATCH: Final = 100
"""Maximum number of environments that are read, or whose areas are written, at once."""

MAX_ATTEMPTS: Final = 5
"""Maximum number of times an area is computed again because the head has moved."""

Rank = tuple[int, float, float, str]


@dataclass(frozen=True, slots=True)
class _Hit:
    id: str
    rank: Rank
    match: Match


class Areas:
    """Queries by position."""

    def __init__(self, database: Database, chunks: Chunks) -> None:
        self._database, self._chunks = database, chunks

    def locate(
        self,
        latitude: float,
        longitude: float,
        *,
        q: str | None = None,
        bbox: Box | None = None,
        limit: int = 100,
        cursor: str | None = None,
        allowed: str | None = None,
        deleted: bool = False,
    ) -> tuple[list[tuple[Environment, Match]], str | None]:
        """Find the environments whose area covers a position, and the cursor of the next page.

        Args:
            latitude, longitude: degrees.
            q, bbox, allowed, deleted: as for ``Environments.page``.

        Fences come first, then the smallest area, then the nearest datum. Raises Invalid for an invalid position.
        """
        if not (-90.0 <= latitude <= 90.0 and -180.0 <= longitude <= 180.0):
            raise Invalid(
                f"a position must be degrees, latitude within ±90 and longitude within ±180, got {latitude:g}, "
                f"{longitude:g}"
            )
        if limit < 1:
            raise Invalid(f"limit must be at least 1, got {limit}")
        after = None if cursor is None else _rank(cursor)
        conditions = filters(q=q, bbox=bbox, deleted=deleted, dialect=self._database.engine.dialect.name)

        def page(connection: Connection) -> tuple[list[tuple[Environment, Match]], str | None]:
            hits = [
                h for h in self._find_hits(connection, latitude, longitude, conditions) if reaches(allowed, h.rank[3])
            ]
            hits = sorted((h for h in hits if after is None or h.rank > after), key=lambda h: h.rank)
            environments = _environments(connection, [h.id for h in hits[:limit]])
            following = _cursor(hits[limit - 1].rank) if len(hits) > limit else None
            return [(environments[h.id], h.match) for h in hits[:limit] if h.id in environments], following

        with self._database.read() as connection:
            if self._database.readonly or not _stale(connection):
                return page(connection)
        self.refresh()
        with self._database.read() as connection:
            return page(connection)

    def _find_hits(
        self, connection: Connection, latitude: float, longitude: float, conditions: list[ColumnElement[bool]]
    ) -> list[_Hit]:
        environment, area = tables.environment, tables.area
        columns = (environment.c.id, environment.c.name, environment.c.datum, area.c.basis, area.c.size)
        places = [(longitude, latitude)]
        if abs(longitude) == 180.0:
            places.append((-longitude, latitude))
        query = (
            select(*columns, *([area.c.geometry] if self._database.sqlite else []))
            .join(environment, environment.c.id == area.c.environment_id)
            .where(or_(*(self._covers(place) for place in places)), *conditions)
        )
        rows = connection.execute(query).all()
        if self._database.sqlite and rows:
            shapes = from_wkb([row.geometry for row in rows])
            inside = np.any([shapely.covers(shapes, shapely.Point(place)) for place in places], axis=0)
            rows = [row for row, hit in zip(rows, inside.tolist(), strict=True) if hit]
        hits: dict[str, _Hit] = {}
        for row in rows:
            datum = datum_from_row(row.datum)
            away = None if datum is None else round(distance((datum.longitude, datum.latitude), places[0]), 1)
            rank = (int(row.basis != "fence"), row.size, math.inf if away is None else away, row.name)
            hits[row.id] = _Hit(row.id, rank, Match(row.basis, row.size, away))
        return list(hits.values())

    def _covers(self, place: tuple[float, float]) -> ColumnElement[bool]:
        """A condition: the geometry covers a (longitude, latitude) on PostgreSQL, its box does on SQLite."""
        area = tables.area
        if self._database.sqlite:
            x, y = place
            inside = and_(area.c.south <= y, area.c.north >= y, area.c.west <= x, area.c.east >= x)
            return and_(pieces_around(x, y), inside)
        wkb = bytes(to_wkb(np.array([shapely.Point(place)], object))[0])
        return func.ST_Covers(area.c.geometry, column_types.from_wkb(literal(wkb, LargeBinary)), type_=Boolean)

    def refresh(self) -> int:
        """Compute the areas that no commit has computed; returns how many environments were behind.

        Safe beside other servers: an area is written only if the head is the one it was computed from. An environment
        with damaged content keeps its last area.
        """
        with self._database.read() as connection:
            stale = _stale(connection)
        for start in range(0, len(stale), BATCH):
            todo = stale[start : start + BATCH]
            for _ in range(MAX_ATTEMPTS):
                todo = self._refresh_some(todo)
                if not todo:
                    break
        return len(stale)

    def _refresh_some(self, ids: list[str]) -> list[str]:
        """Compute and write some areas; returns the environments whose head has moved meanwhile."""
        table = tables.environment
        computed: dict[str, tuple[int, Area]] = {}
        for environment_id in ids:
            with self._database.read() as connection:
                row = connection.execute(select(table).where(table.c.id == environment_id)).one_or_none()
                head = None if row is None else read_version(connection, row, row.head)
            if head is None:
                continue
            try:
                computed[environment_id] = head.number, compute_area(self._chunks.stage(), head.parts, head.datum)
            except Damaged as error:
                log.critical(
                    "area: not computed, the previous one is kept (environment=%s, reason=%s)",
                    head.environment,
                    error.detail,
                )
        moved: list[str] = []
        with self._database.write(notify=False, upkeep=True) as connection:
            for environment_id in sorted(computed):
                number, area = computed[environment_id]
                query = select(table.c.head, table.c.area_stale).where(table.c.id == environment_id).with_for_update()
                row = connection.execute(query).one_or_none()
                if row is None or not row.area_stale:
                    continue
                if row.head != number:
                    moved.append(environment_id)
                    continue
                write_area(connection, environment_id, area)
                connection.execute(update(table).where(table.c.id == environment_id).values(area_stale=False))
        return moved


def _stale(connection: Connection) -> list[str]:
    """Return the ids of the environments whose areas have to be computed."""
    table = tables.environment
    return list(connection.execute(select(table.c.id).where(table.c.area_stale)).scalars())


def _environments(connection: Connection, ids: list[str]) -> dict[str, Environment]:
    """Read environments by id; those that are purged meanwhile are missing."""
    table = tables.environment
    out: dict[str, Environment] = {}
    for start in range(0, len(ids), BATCH):
        rows = connection.execute(select(table).where(table.c.id.in_(ids[start : start + BATCH])))
        out.update((row.id, as_environment(row)) for row in rows)
    return out


def _cursor(rank: Rank) -> str:
    return " ".join(map(str, rank))


def _rank(cursor: str) -> Rank:
    """Read the result of ``_cursor``. Raises Invalid for anything else."""
    try:
        guessed, size, away, name = cursor.split(" ")
        return int(guessed), float(size), float(away), name
    except ValueError:
        problems = [Problem("invalid cursor", where="cursor")]
        raise Invalid("invalid cursor: take it from the Link header of the previous page", problems) from None

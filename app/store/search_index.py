"""Index of names for the search in all environments, kept in the database.

An environment's items are those of the version of its channel ``production``, else of its head. Commits do not touch
the index: the database knows which environments have changed (``environment.search_stale``), and housekeeping or the
next search applies the differences between the version that the index shows and the one that it should show.
"""

from __future__ import annotations

import logging
import math
import secrets
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
import shapely
from numpy.typing import NDArray
from sqlalchemy import Connection, Row, Update, delete, func, insert, select, update

from app.errors import Damaged, Unavailable
from app.model.frame import Datum
from app.model.geodesy import local_frame
from app.model.layers import Layer, PartKey
from app.store import diff, tables
from app.store.base import storable_text
from app.store.chunks import Chunks
from app.store.database import Database
from app.store.encode import from_wkb
from app.store.grams import SEPARATOR, fold, grams
from app.store.manifest import read_if_kept, read_version
from app.store.parts.features import Item
from app.store.prepare import differing_keys, read_roots
from app.store.values import PartEntry

log = logging.getLogger(__name__)

SearchKind = Literal["environment", "node", "zone", "object"]

ORDER: Final[tuple[SearchKind, ...]] = ("environment", "node", "zone", "object")
"""Kinds of items, in the order of results; their positions are stored."""

KINDS: Final[dict[Layer, int]] = {"topology": 1, "zones": 2, "objects": 3}

PRODUCTION: Final = "production"

MAX_FIELD: Final = 256
"""Maximum number of characters of a name or id that are searched."""

BATCH: Final = 500
SLICE: Final = 2000
"""Maximum number of rows in one transaction, so that other writers on SQLite do not wait long."""

TOGETHER: Final = 50
"""Maximum number of environments in one transaction."""

AT_ONCE: Final = 200
"""Maximum number of environments that a search brings up to date; after a mass change further searches continue."""

MERGE_PAGES: Final = 200
"""Number of pages of an index of texts that are written in one transaction: about 15 ms."""

MERGED_CHANGES: Final = 2
"""Number of rows that a merge changes at least if it does anything (SQLite FTS5, section 6.8)."""

MAX_BUILDERS: Final = 4
"""Maximum number of searches that wait for the index; further ones are refused, so that threads stay free."""


@dataclass(frozen=True, slots=True)
class _Plan:
    """What brings an environment's rows up to date, if the environment is still as it was (``row``).

    version: that the rows will show; None for a deleted environment, which has no rows. afresh: whether all rows are
    replaced. removed: ids by part. added: rows.
    """

    row: Row[Any]
    version: int | None
    afresh: bool
    removed: Mapping[PartKey, Sequence[str]]
    added: Sequence[dict[str, Any]]


class SearchIndex:
    """The rows of ``search_item``. Thread-safe, and safe on several servers at once."""

    def __init__(self, database: Database, chunks: Chunks) -> None:
        self._database, self._chunks = database, chunks
        self._damaged: dict[str, int] = {}
        self._builders, self._building = threading.Semaphore(MAX_BUILDERS), threading.Lock()

    def catch_up(self) -> None:
        """Bring the index up to date before a search. Raises Unavailable if that takes too long."""
        if self._database.readonly or not self._stale(1):
            return
        if not self._builders.acquire(blocking=False):
            raise Unavailable("the search index is being built: try again in a few seconds")
        try:
            with self._building:  # one at a time: concurrent searches need the same rows
                self.refresh(AT_ONCE)
                if self._stale(1):
                    raise Unavailable("the search index is being built: try again in a few seconds")
        finally:
            self._builders.release()

    def refresh(self, limit: int) -> int:
        """Bring up to ``limit`` environments up to date; returns how many were behind.

        An environment with damaged content keeps its rows until it changes again.
        """
        stale = self._stale(limit)
        plans: list[_Plan] = []
        for environment_id in stale:
            plan = self._read_plan(environment_id)
            if plan is None:
                continue
            plans.append(plan)
            if sum(len(plan.added) for plan in plans) >= SLICE or len(plans) >= TOGETHER:
                self._apply(plans)
                plans = []
        self._apply(plans)
        return len(stale)

    def merge(self) -> None:
        """Join the segments of SQLite's indexes of texts, some pages in a transaction: queries read each segment."""
        if not self._database.sqlite:
            return
        for name in (*(f"search_{kind}" for kind in ORDER), "environment_text"):
            pages = -MERGE_PAGES  # begins to join all of them; further calls continue
            while self._merge_some(name, pages):
                pages = MERGE_PAGES

    def _merge_some(self, name: str, pages: int) -> bool:
        """Join segments of an index of texts; returns whether there was something to do."""
        with self._database.write(notify=False, upkeep=True) as connection:
            before = connection.execute(_CHANGES).scalar_one()
            connection.exec_driver_sql(f"INSERT INTO {name}({name}, rank) VALUES ('merge', ?)", (pages,))  # noqa: S608
            return int(connection.execute(_CHANGES).scalar_one() - before) >= MERGED_CHANGES

    def _stale(self, limit: int) -> list[str]:
        """Return up to ``limit`` environments that are behind, without those that are known to be damaged."""
        table = tables.environment
        query = select(table.c.id, table.c.sequence).where(table.c.search_stale)
        with self._database.read() as connection:
            rows = connection.execute(query.limit(limit + len(self._damaged))).all()
        return [row.id for row in rows if self._damaged.get(row.id) != row.sequence][:limit]

    def _read_plan(self, environment_id: str) -> _Plan | None:
        """Plan what brings an environment up to date; None if nothing does, or nothing can."""
        table = tables.environment
        with self._database.snapshot() as connection:
            row = connection.execute(select(table).where(table.c.id == environment_id)).one_or_none()
            if row is None or not row.search_stale:
                return None
            try:
                plan = self._plan(connection, row)
            except Damaged as error:
                self._damaged[environment_id] = row.sequence
                log.critical("search: %s is not up to date, its content is damaged (%s)", row.name, error.detail)
                return None
        self._damaged.pop(environment_id, None)
        return plan

    # --- what has to change ---

    def _plan(self, connection: Connection, row: Row[Any]) -> _Plan:
        if row.deleted is not None:
            return _Plan(row, None, True, {}, ())
        channel = tables.channel
        production = select(channel.c.version).where(channel.c.environment_id == row.id, channel.c.name == PRODUCTION)
        number = connection.execute(production).scalar_one_or_none()
        version = read_version(connection, row, row.head if number is None else number)
        before = read_if_kept(connection, row, row.search_version) if row.search_version >= 0 else None
        afresh = before is None or before.datum != version.datum
        old = {} if before is None or afresh else _searched(before.parts)
        new = _searched(version.parts)
        removed: dict[PartKey, Sequence[str]] = {}
        added: list[dict[str, Any]] = []
        draft = self._chunks.stage()
        for key in differing_keys(old, new):
            changed = diff.features(draft, read_roots(draft, key, old), read_roots(draft, key, new))
            removed[key] = [*changed.changed, *changed.deleted]
            items = {i: changed.after[i] for i in (*changed.added, *changed.changed)}
            added += _item_rows(row, key, items, version.datum)
        return _Plan(row, version.number, afresh, removed, added)

    # --- writing it ---

    def _apply(self, plans: Sequence[_Plan]) -> None:
        """Write plans in one transaction; long ones follow, each in several.

        Between these the environment has a negative number of its own as ``search_version``: it is not found, and
        whoever else begins to write takes it over.
        """
        short = [plan for plan in plans if len(plan.added) <= SLICE]
        if short:
            with self._database.write(notify=False, upkeep=True) as connection:
                rows: list[dict[str, Any]] = []
                for plan in sorted(
                    short, key=lambda plan: str(plan.row.id)
                ):  # an order in which none waits for another
                    if _claim(connection, plan.row, plan.row.search_version):
                        _begin(connection, plan)
                        _end(connection, plan)
                        rows += plan.added
                if rows:
                    connection.execute(insert(tables.search_item), rows)
        for plan in plans:
            if len(plan.added) > SLICE:
                self._apply_long(plan)

    def _apply_long(self, plan: _Plan) -> None:
        current = plan.row.search_version
        for start in range(0, len(plan.added), SLICE):
            with self._database.write(notify=False, upkeep=True) as connection:
                if not _claim(connection, plan.row, current):
                    return
                if not start:
                    _begin(connection, plan)
                connection.execute(insert(tables.search_item), plan.added[start : start + SLICE])
                if start + SLICE >= len(plan.added):
                    _end(connection, plan)
                else:
                    current = -2 - secrets.randbelow(2**30)
                    connection.execute(_of(plan.row).values(search_version=current))


_CHANGES: Final = select(func.total_changes())


def _begin(connection: Connection, plan: _Plan) -> None:
    """Remove what a plan replaces, and write the environment's own row."""
    _remove(connection, plan)
    if plan.version is not None:
        _put_environment(connection, plan.row)


def _end(connection: Connection, plan: _Plan) -> None:
    """Note that the rows show the planned version."""
    version = -1 if plan.version is None else plan.version
    seen = {"search_sequence": plan.row.sequence, "search_updated": plan.row.updated}
    connection.execute(_of(plan.row).values(search_version=version, **seen))


def _of(row: Row[Any]) -> Update:
    return update(tables.environment).where(tables.environment.c.id == row.id)


def _claim(connection: Connection, row: Row[Any], search_version: int) -> bool:
    """Lock an environment; returns whether it and its rows are still as they were."""
    table = tables.environment
    columns = (table.c.search_version, table.c.sequence, table.c.updated)
    now = connection.execute(select(*columns).where(table.c.id == row.id).with_for_update()).one_or_none()
    return now is not None and tuple(now) == (search_version, row.sequence, row.updated)


def _remove(connection: Connection, plan: _Plan) -> None:
    table = tables.search_item
    of_environment = table.c.environment_id == plan.row.id
    if plan.afresh:
        connection.execute(delete(table).where(of_environment))
    for key, ids in plan.removed.items():
        in_part = (table.c.kind == KINDS[key.layer], table.c.level == key.level, table.c.part == key.name)
        for start in range(0, len(ids), BATCH):
            some = table.c.feature.in_(ids[start : start + BATCH])
            connection.execute(delete(table).where(of_environment, some, *in_part))


def _put_environment(connection: Connection, row: Row[Any]) -> None:
    """Write an environment's own row, and a new name to the others."""
    table = tables.search_item
    of_environment = table.c.environment_id == row.id
    wanted = {"name": storable_text(row.name), **_folded(row.title, row.name)}
    is_own = (of_environment, table.c.kind == 0, table.c.feature == "")
    present = connection.execute(select(table.c.name, table.c.folded, table.c.folded_id).where(*is_own)).one_or_none()
    if present is not None and dict(present._mapping) == {k: v for k, v in wanted.items() if k != "grams"}:
        return
    connection.execute(delete(table).where(*is_own))
    place = {"environment_id": row.id, "environment": row.name, "kind": 0, "level": "", "part": "", "feature": ""}
    connection.execute(insert(table), [{**place, **wanted, "x": None, "y": None}])
    if present is None or present.name != row.name:
        connection.execute(update(table).where(of_environment).values(environment=row.name))


def _searched(parts: Sequence[PartEntry]) -> dict[PartKey, PartEntry]:
    return {e.key: e for e in parts if e.key.layer in KINDS and e.count}


def _item_rows(
    owner: Row[Any], key: PartKey, items: Mapping[str, Item], datum: Datum | None
) -> Iterator[dict[str, Any]]:
    """Return the rows of a part's items; of a network only the nodes have names that people know."""
    properties = {item_id: item.properties for item_id, item in items.items()}
    chosen = [i for i in items if key.layer != "topology" or properties[i].get("kind") == "node"]
    positions = _positions([items[i] for i in chosen], datum)
    for item_id, (x, y) in zip(chosen, positions, strict=True):
        name = properties[item_id].get("name")
        title = storable_text(name)[:MAX_FIELD] if isinstance(name, str) and name else item_id
        yield {
            "environment_id": owner.id,
            "environment": owner.name,
            "kind": KINDS[key.layer],
            "level": key.level,
            "part": key.name,
            "feature": item_id,
            "name": title,
            **_folded(item_id, title),
            "x": x,
            "y": y,
        }


def _folded(further: str, name: str) -> dict[str, Any]:
    """Return the columns of the searched texts: of the name, and of the id or title if it differs."""
    texts = [fold(text[:MAX_FIELD].replace(SEPARATOR, " ")) for text in (name, further)]
    texts = texts[:1] if texts[1] in (texts[0], "") else texts
    return {"folded": texts[0], "folded_id": texts[1] if len(texts) == 2 else None, "grams": grams(*texts)}


def _positions(items: Sequence[Item], datum: Datum | None) -> list[tuple[float | None, float | None]]:
    """Return a point of each item in metres; None without coordinates, and for degrees without a datum."""
    xy = points_on(from_wkb([item.wkb for item in items]))
    distant = np.array([item.anchor != 0 for item in items], bool)
    if distant.any():
        xy[distant] = np.nan if datum is None else local_frame(datum).to_local(xy[distant])
    rounded = np.round(xy, 9).tolist()
    return [(None, None) if math.isnan(x) or math.isnan(y) else (x, y) for x, y in rounded]


def points_on(geometry: NDArray[np.object_]) -> NDArray[np.float64]:
    """Return a position [n, 2] on each geometry; NaN for empty ones."""
    out = np.full((len(geometry), 2), np.nan)
    used = np.flatnonzero(~shapely.is_empty(geometry))
    points = geometry[used]
    shapes = shapely.get_type_id(points) != 0
    try:
        points[shapes] = shapely.point_on_surface(points[shapes])
    except shapely.errors.GEOSException:  # of an invalid polygon
        points[shapes] = shapely.centroid(points[shapes])
    out[used] = shapely.get_coordinates(points)
    return out

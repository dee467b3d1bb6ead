"""Search by name in all environments, by SQL on the index that ``search_index`` keeps.

Texts that equal the query or begin with it come in the order of an index on the texts, so that they cost what is
returned. Others that contain it come from an index of groups of three characters, if there are too few of the former.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, Literal, NamedTuple

import orjson
from sqlalchemy import (
    ARRAY,
    ColumnElement,
    CompoundSelect,
    Connection,
    Integer,
    Row,
    Select,
    Text,
    any_,
    bindparam,
    cast,
    column,
    func,
    literal_column,
    or_,
    select,
    table,
    true,
    union_all,
    values,
)
from sqlalchemy.dialects.postgresql import TSQUERY

from app.store import tables
from app.store.database import Database
from app.store.environments import reaches
from app.store.gram_shares import GramShares
from app.store.grams import GRAM, SEPARATOR, fold, wanted_grams
from app.store.search_index import ORDER, SearchIndex, SearchKind

MAX_CANDIDATES: Final = 1000
"""Maximum number of matches in the middle of a text, of each kind, that are put in order."""

FEW: Final = 5
"""Number of environments whose rows are all looked at, instead of the rows of all environments with the text."""

EQUAL: Final = 0
PREFIX: Final = 1
PART: Final = 2
"""Ranks: the name or id equals the query, begins with it, contains it."""

LAST: Final = "\U0010ffff"
"""Sorts after all texts that begin alike."""

WILDCARDS: Final = "*?["

_COLUMNS: Final = ("id", "kind", "level", "feature", "name", "folded", "folded_id", "x", "y")


@dataclass(frozen=True, slots=True)
class SearchHit:
    """Match of a search.

    title: of the environment. position: metres in the local frame; None for an environment, an item without
    coordinates, and an item in degrees if there is no datum.
    """

    kind: SearchKind
    environment: str
    version: int
    id: str
    name: str
    level: str | None
    position: tuple[float, float] | None
    title: str


class _Match(NamedTuple):
    """Match, in the order of the results: by the text that matches, names before ids."""

    rank: int
    kind: int
    text: str
    environment: str
    level: str
    by_id: bool
    feature: str
    id: int
    row: Row[Any]


class Search:
    """Search by name. Thread-safe."""

    def __init__(self, database: Database, index: SearchIndex) -> None:
        self._database, self._index = database, index
        self._shares = GramShares()

    def find(self, query: str, *, limit: int, allowed: str | None = None) -> tuple[list[SearchHit], bool]:
        """Find environments by name and title, and nodes, zones and objects by name and id.

        In the version of the channel ``production`` if it exists, else in the head. Case-insensitive. Order: equal
        texts before prefixes before other parts of texts; of each environments, nodes, zones, objects, by the text that
        matches. Of more than MAX_CANDIDATES of a kind that match in the middle, some are chosen.

        allowed: a name pattern (fnmatch) of environments. Returns also whether there are more than ``limit``. Raises
        Unavailable while the index is being built.
        """
        self._index.catch_up()
        needle = fold(query.replace(SEPARATOR, " "))
        if "\x00" in needle:  # no stored text has one
            return [], False
        hits: dict[int, SearchHit] = {}
        with self._database.read() as connection:
            scope = _scope(connection, allowed)
            for match in self._matches(connection, scope, needle, limit + 1):
                if reaches(allowed, match.row.owner):
                    hits.setdefault(match.id, _as_hit(match.row))
                if len(hits) > limit:
                    break
        return list(hits.values())[:limit], len(hits) > limit

    def _matches(self, connection: Connection, scope: _Scope, needle: str, limit: int) -> Iterator[_Match]:
        """Find the best ``limit`` items, best first; one that matches by name and id may come twice."""
        sqlite = self._database.sqlite
        given = {**scope.values, "needle": needle, "last": needle + LAST}
        if scope.form == "few":
            rows = connection.execute(_all_query(sqlite=sqlite), given)
            yield from heapq.nsmallest(limit, (_best_match(row, needle) for row in rows))
            return
        beginning = connection.execute(_ordered_query(scope.form, sqlite=sqlite), {**given, "limit": limit})
        yield from sorted(_ordered_match(row, needle) for row in beginning)
        wanted = wanted_grams(needle, sqlite=sqlite, shares=self._shares.current(connection))
        given |= {"wanted": wanted, "limit": MAX_CANDIDATES + limit}
        for candidates in self._part_rows(connection, scope.form, given, is_short=len(needle) < GRAM):
            matches = (_best_match(row, needle) for row in candidates)
            yield from sorted(match for match in matches if match.rank == PART)

    def _part_rows(
        self, connection: Connection, form: Form, given: Mapping[str, Any], *, is_short: bool
    ) -> Iterator[Sequence[Row[Any]]]:
        """Read items that contain the text: of all kinds or, if there are too many, of one kind after another."""
        sqlite = self._database.sqlite
        if not sqlite:
            rows = connection.execute(_part_query(form, None, is_short=is_short, sqlite=sqlite), given).all()
            if len(rows) < given["limit"]:
                yield rows
                return
        for kind in range(len(ORDER)):
            query = _part_query(form, kind, is_short=is_short, sqlite=sqlite)
            yield connection.execute(query, {**given, "kind": kind}).all()


# --- which environments ---

Form = Literal["all", "range", "ids", "few"]


@dataclass(frozen=True, slots=True)
class _Scope:
    """Environments that a search looks at, as a form of the queries and its values.

    ``range``: names from ``first`` to ``end``. ``ids``, ``few``: these; of few environments all items are read.
    """

    form: Form
    values: Mapping[str, Any]


def _scope(connection: Connection, allowed: str | None) -> _Scope:
    """Return the environments that a name pattern allows."""
    if allowed is None:
        return _Scope("all", {})
    prefix = allowed[: min((k for k in map(allowed.find, WILDCARDS) if k >= 0), default=len(allowed))]
    is_range = allowed == prefix + "*"
    owner = tables.environment
    names = select(owner.c.id, owner.c.name).where(owner.c.deleted.is_(None))
    names = names.where(owner.c.name.startswith(prefix, autoescape=True)) if prefix else names
    rows = connection.execute(names.limit(FEW + 1) if is_range else names)
    ids = [row.id for row in rows if reaches(allowed, row.name)]
    if is_range and len(ids) > FEW:
        return _Scope("range", {"first": prefix, "end": prefix + LAST})
    listed = orjson.dumps(ids).decode() if connection.dialect.name == "sqlite" else ids
    return _Scope("few" if len(ids) <= FEW else "ids", {"ids": listed})


# --- queries: made once, since making one takes longer than executing it ---


def _items(form: Form, *, sqlite: bool) -> Select[Any]:
    """Select items, with what a result says of their environment."""
    item, owner = tables.search_item, tables.environment
    columns = (item.c[name] for name in _COLUMNS)
    query = (
        select(*columns, owner.c.name.label("owner"), owner.c.title, owner.c.search_version.label("version"))
        .join(owner, owner.c.id == item.c.environment_id)
        .where(owner.c.deleted.is_(None), owner.c.search_version >= 0)
    )
    if form == "all":
        return query
    if form == "range":
        return query.where(item.c.environment >= bindparam("first"), item.c.environment < bindparam("end"))
    if sqlite:
        ids = func.json_each(bindparam("ids", type_=Text)).table_valued("value").c.value
        return query.where(item.c.environment_id.in_(select(ids)))
    return query.where(item.c.environment_id == any_(bindparam("ids", type_=ARRAY(Text))))


@lru_cache
def _all_query(*, sqlite: bool) -> Select[Any]:
    """Select all items of few environments that contain the text."""
    return _items("few", sqlite=sqlite).where(_has_text(sqlite=sqlite))


@lru_cache
def _ordered_query(form: Form, *, sqlite: bool) -> CompoundSelect[Any]:
    """Select the first items of each kind whose name or id equals the text or begins with it, in their order.

    One subquery for all kinds on PostgreSQL: it takes longer to plan one than to execute it.
    """
    item = tables.search_item
    needle, last = bindparam("needle", type_=Text), bindparam("last", type_=Text)
    listed = values(column("number", Integer), name="kinds", literal_binds=True)
    kinds = listed.data([(kind,) for kind in range(len(ORDER))])
    queries: list[Select[Any]] = []
    for by_id, text in enumerate((item.c.folded, item.c.folded_id)):
        query = _items(form, sqlite=sqlite).add_columns(literal_column(str(by_id)).label("by_id"))
        query = query.where(text >= needle, text < last)
        query = query.order_by(text, item.c.environment, item.c.level, item.c.feature)
        query = query.limit(bindparam("limit", type_=Integer))
        if sqlite:
            chosen = (query.where(item.c.kind == literal_column(str(kind))) for kind in range(len(ORDER)))
            queries += (select(some.subquery()) for some in chosen)
        else:
            some = query.where(item.c.kind == kinds.c.number).lateral()
            queries.append(select(some).select_from(kinds.join(some, true())))
    return union_all(*queries)


@lru_cache
def _part_query(form: Form, kind: int | None, *, is_short: bool, sqlite: bool) -> Select[Any]:
    """Select items that contain the text, by the index of three characters in a row. kind: None for all of them."""
    item = tables.search_item
    query = _items(form, sqlite=sqlite).where(_has_text(sqlite=sqlite)).limit(bindparam("limit", type_=Integer))
    if not sqlite:
        wanted = cast(bindparam("wanted", type_=Text), TSQUERY)
        query = query.where(item.c.grams.op("@@")(wanted))
        return query if kind is None else query.where(item.c.kind == bindparam("kind"))
    assert kind is not None, "each kind has an index of its own"
    name = f"search_{ORDER[kind]}"
    if is_short:
        term = table(f"{name}_term", column("term"), column("doc")).c
        begins = term.term >= bindparam("needle"), term.term < bindparam("last")
        rows = select(term.doc).where(*begins).distinct().subquery()
        return query.join(rows, rows.c.doc == item.c.id)
    text = table(name, column("rowid"), column(name))
    return query.join(text, text.c.rowid == item.c.id).where(text.c[name].op("MATCH")(bindparam("wanted")))


def _has_text(*, sqlite: bool) -> ColumnElement[bool]:
    """Return a condition: the name or id contains the text, whose characters stand for themselves."""
    item, needle = tables.search_item, bindparam("needle", type_=Text)
    position = func.instr if sqlite else func.strpos
    return or_(position(item.c.folded, needle) > 0, position(item.c.folded_id, needle) > 0)


def _best_match(row: Row[Any], needle: str) -> _Match:
    """Return the better match of an item's name and id."""
    ranks = [
        (EQUAL if text == needle else PREFIX if text.startswith(needle) else PART, by_id)
        for by_id, text in enumerate((row.folded, row.folded_id))
        if text is not None and needle in text
    ]
    rank, by_id = min(ranks)
    return _match(row, rank, by_id=bool(by_id))


def _ordered_match(row: Row[Any], needle: str) -> _Match:
    """Return a match at the beginning of an item's name or id, whichever the row was found by."""
    text = row.folded_id if row.by_id else row.folded
    return _match(row, EQUAL if text == needle else PREFIX, by_id=bool(row.by_id))


def _match(row: Row[Any], rank: int, *, by_id: bool) -> _Match:
    text = row.folded_id if by_id else row.folded
    return _Match(rank, row.kind, text, row.owner, row.level, by_id, row.feature, row.id, row)


def _as_hit(row: Row[Any]) -> SearchHit:
    of_item = row.kind != 0
    position = None if row.x is None else (row.x, row.y)
    name = row.name if of_item else row.owner
    item_id, level = (row.feature, row.level) if of_item else (row.owner, None)
    return SearchHit(ORDER[row.kind], row.owner, row.version, item_id, name, level, position, row.title)

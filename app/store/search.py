"""Search by name in all environments, by SQL on the index that ``search_index`` keeps.

Texts that equal the query or begin with it come in the order of an index on the texts, so that they cost what is
returned. Others that contain it come from an index of groups of three characters, if there are too few of the former.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import orjson
from sqlalchemy import (
    ARRAY,
    ColumnElement,
    Connection,
    Row,
    Select,
    Text,
    and_,
    any_,
    cast,
    column,
    func,
    literal,
    or_,
    select,
    table,
    union_all,
)
from sqlalchemy.dialects.postgresql import TSQUERY

from app.store import tables
from app.store.database import Database
from app.store.environments import reaches
from app.store.search_index import GRAM, ORDER, SEPARATOR, SearchIndex, SearchKind, fold

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
DOUBLE: Final = '"'

_COLUMNS: Final = ("id", "kind", "level", "feature", "name", "folded", "folded_id", "x", "y")

_SEARCH_TEXT: Final = table("search_text", column("rowid"), column("search_text"))
_SEARCH_TERM: Final = table("search_term", column("term"), column("doc"), column("col"))


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
        if scope.few is not None:
            rows = connection.execute(scope.items().where(_has_text(needle, sqlite=self._database.sqlite)))
            yield from heapq.nsmallest(limit, (_best_match(row, needle) for row in rows))
            return
        seen: set[int] = set()
        for rank in (EQUAL, PREFIX):
            for match in _ordered_matches(connection, scope, needle, rank, limit + len(seen)):
                seen.add(match.id)
                yield match
        for kind in range(len(ORDER)):
            rows = connection.execute(self._containing(scope, needle, kind).limit(MAX_CANDIDATES + limit))
            matches = (_best_match(row, needle) for row in rows)
            yield from sorted(match for match in matches if match.rank == PART)

    def _containing(self, scope: _Scope, needle: str, kind: int) -> Select[Any]:
        """Select items with a text in their name or id, by the index of three characters in a row."""
        item, is_short = tables.search_item, len(needle) < GRAM
        windows = sorted({needle[k : k + GRAM] for k in range(max(1, len(needle) - GRAM + 1))})
        query = scope.items().where(_has_text(needle, sqlite=self._database.sqlite))
        if not self._database.sqlite:
            wanted = " & ".join(_quoted(window, "'") + (":*" if is_short else "") for window in windows)
            return query.where(item.c.kind == kind, item.c.grams.op("@@")(cast(literal(wanted), TSQUERY)))
        if is_short:
            term = _SEARCH_TERM.c
            begins = term.term >= needle, term.term < needle + LAST, term.col == ORDER[kind]
            rows = select(term.doc).where(*begins).distinct().subquery()
            return query.join(rows, rows.c.doc == item.c.id)
        text = _SEARCH_TEXT.c
        wanted = f"{ORDER[kind]} : ({' AND '.join(_quoted(window, DOUBLE) for window in windows)})"
        return query.join(_SEARCH_TEXT, text.rowid == item.c.id).where(text.search_text.op("MATCH")(wanted))


@dataclass(frozen=True, slots=True)
class _Scope:
    """Environments that a search looks at. few: their ids, if they are few; else a condition on the items."""

    few: Sequence[str] | None = None
    condition: ColumnElement[bool] | None = None

    def items(self) -> Select[Any]:
        """Select items of these environments, with what a result says of their environment."""
        item, owner = tables.search_item, tables.environment
        columns = (item.c[name] for name in _COLUMNS)
        query = (
            select(*columns, owner.c.name.label("owner"), owner.c.title, owner.c.search_version.label("version"))
            .join(owner, owner.c.id == item.c.environment_id)
            .where(owner.c.deleted.is_(None), owner.c.search_version >= 0)
        )
        if self.few is not None:
            return query.where(item.c.environment_id.in_(self.few))
        return query if self.condition is None else query.where(self.condition)


def _scope(connection: Connection, allowed: str | None) -> _Scope:
    """Return the environments that a name pattern allows."""
    if allowed is None:
        return _Scope()
    prefix = allowed[: min((k for k in map(allowed.find, WILDCARDS) if k >= 0), default=len(allowed))]
    is_range = allowed == prefix + "*"
    owner, item = tables.environment, tables.search_item
    names = select(owner.c.id, owner.c.name).where(owner.c.deleted.is_(None))
    names = names.where(owner.c.name.startswith(prefix, autoescape=True)) if prefix else names
    rows = connection.execute(names.limit(FEW + 1) if is_range else names)
    ids = [row.id for row in rows if reaches(allowed, row.name)]
    if len(ids) <= FEW:
        return _Scope(few=ids)
    if is_range:
        return _Scope(condition=and_(item.c.environment >= prefix, item.c.environment < prefix + LAST))
    if connection.dialect.name == "sqlite":
        some = select(func.json_each(literal(orjson.dumps(ids).decode())).table_valued("value").c.value)
        return _Scope(condition=item.c.environment_id.in_(some))
    return _Scope(condition=item.c.environment_id == any_(cast(literal(ids, ARRAY(Text)), ARRAY(Text))))


def _ordered_matches(connection: Connection, scope: _Scope, needle: str, rank: int, limit: int) -> list[_Match]:
    """Find the first items of each kind whose name or id equals a text, or begins with it, in one query."""
    item = tables.search_item
    queries = []
    for kind in range(len(ORDER)):
        for by_id, text in enumerate((item.c.folded, item.c.folded_id)):
            condition = text == needle if rank == EQUAL else and_(text > needle, text < needle + LAST)
            order = (text, item.c.environment, item.c.level, item.c.feature)
            query = scope.items().add_columns(literal(by_id).label("by_id")).where(item.c.kind == kind, condition)
            queries.append(select(query.order_by(*order).limit(limit).subquery()))
    rows = connection.execute(union_all(*queries))
    return sorted(_match(row, rank, by_id=bool(row.by_id)) for row in rows)


def _has_text(needle: str, *, sqlite: bool) -> ColumnElement[bool]:
    """Return a condition: the name or id contains a text, whose characters stand for themselves."""
    item = tables.search_item
    position = func.instr if sqlite else func.strpos
    return or_(position(item.c.folded, needle) > 0, position(item.c.folded_id, needle) > 0)


def _quoted(text: str, quote: str) -> str:
    """Quote a text for a query of the index: quotes, and on PostgreSQL backslashes, are doubled."""
    escaped = text.replace("\\", "\\\\") if quote == "'" else text
    return quote + escaped.replace(quote, 2 * quote) + quote


def _best_match(row: Row[Any], needle: str) -> _Match:
    """Return the better match of an item's name and id."""
    ranks = [
        (EQUAL if text == needle else PREFIX if text.startswith(needle) else PART, by_id)
        for by_id, text in enumerate((row.folded, row.folded_id))
        if text is not None and needle in text
    ]
    rank, by_id = min(ranks)
    return _match(row, rank, by_id=bool(by_id))


def _match(row: Row[Any], rank: int, *, by_id: bool) -> _Match:
    text = row.folded_id if by_id else row.folded
    return _Match(rank, row.kind, text, row.owner, row.level, by_id, row.feature, row.id, row)


def _as_hit(row: Row[Any]) -> SearchHit:
    of_item = row.kind != 0
    position = None if row.x is None else (row.x, row.y)
    name = row.name if of_item else row.owner
    item_id, level = (row.feature, row.level) if of_item else (row.owner, None)
    return SearchHit(ORDER[row.kind], row.owner, row.version, item_id, name, level, position, row.title)

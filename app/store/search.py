"""Search by name in all environments: an index in memory for each vector part, built on first use.

Parts are addressed by their content, so an index stays valid for all versions that contain the part.
"""

from __future__ import annotations

import sys
import threading
from array import array
from bisect import bisect_left, bisect_right
from collections import OrderedDict
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray
from sqlalchemy import Connection, Row, func, select

from app.errors import Unavailable
from app.model.frame import Datum
from app.model.geodesy import local_frame
from app.model.layers import Layer
from app.store import tables, tree
from app.store.chunks import Chunks
from app.store.database import Database
from app.store.encode import from_wkb
from app.store.environments import reaches
from app.store.manifest import unpack_manifest
from app.store.parts.features import leaf_items
from app.store.parts.roots import read_root
from app.store.values import PartEntry

SearchKind = Literal["environment", "node", "object", "zone"]

KINDS: Final[dict[Layer, SearchKind]] = {"topology": "node", "objects": "object", "zones": "zone"}
"""Kind of hit by layer."""

ORDER: Final[tuple[SearchKind, ...]] = ("environment", "node", "zone", "object")

PRODUCTION: Final = "production"

MAX_INDEX_BYTES: Final = 128 * 2**20
"""Maximum size of all indexes in memory, in bytes; the least recently used ones are built again when needed."""

MAX_VERSIONS: Final = 2000
"""Maximum number of versions whose list of parts is cached."""

MAX_BUILDERS: Final = 4
"""Maximum number of searches that wait for missing indexes; further ones are refused, so that threads stay free."""

MAX_FIELD: Final = 256
"""Maximum number of characters of a name that are searched."""

SEPARATOR: Final = "\n"


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


class NameIndex:
    """Names and ids of a part's items, as one text that Python searches at the speed of memory."""

    def __init__(
        self, items: Iterable[tuple[str, str | None]], xy: NDArray[np.float64], local: NDArray[np.bool_]
    ) -> None:
        """Index items (id, name). xy: coordinates [n, 2], NaN without geometry. local: metres, else degrees."""
        self._xy, self._local = xy, local
        fields: list[str] = []
        self._owners = array("i")
        for row, (item, name) in enumerate(items):
            if name and name != item:
                fields.append(name)
                self._owners.append(row)
            fields.append(item)
            self._owners.append(row)
        fields = [text[:MAX_FIELD].replace(SEPARATOR, " ") for text in fields]
        lengths = np.fromiter(map(len, fields), np.int64, len(fields)) + len(SEPARATOR)
        self._starts = array("i", (np.cumsum(lengths) - lengths + len(SEPARATOR)).tolist())
        self._text = SEPARATOR.join(["", *fields, ""])
        folded = fold(self._text)
        self._folded = self._text if folded == self._text else folded
        texts = {id(text): sys.getsizeof(text) for text in (self._text, self._folded)}
        self.size = sum(texts.values()) + 8 * len(self._starts) + xy.nbytes + local.nbytes + 1000

    def find(self, query: str, limit: int, worst: int = 2) -> dict[int, int]:
        """Find items by a folded query: row -> rank (0 equal, 1 prefix, 2 part of the name or id).

        At least the best ``limit`` by rank are found, if there are so many. worst: the last rank of interest.
        """
        ranks: dict[int, int] = {}
        needles = (query, SEPARATOR + query, SEPARATOR + query + SEPARATOR)
        for needle in needles[2 - worst :]:
            if self._scan(needle, query, limit, ranks):
                break  # further needles find nothing else
        return ranks

    def _scan(self, needle: str, query: str, limit: int, ranks: dict[int, int]) -> bool:
        """Add up to ``limit`` items that contain a text; returns whether these are all."""
        shift = len(SEPARATOR) if needle.startswith(SEPARATOR) else 0
        at, rows = self._folded.find(needle), set[int]()
        while at >= 0:
            place = bisect_right(self._starts, at + shift) - 1
            start, row = self._starts[place], self._owners[place]
            rows.add(row)
            if len(rows) > limit:
                return False
            ranks[row] = min(ranks.get(row, 2), self._rank(start, query))
            at = self._folded.find(needle, self._end(start))
        return True

    def _rank(self, start: int, query: str) -> int:
        if not self._folded.startswith(query, start):
            return 2
        return 0 if self._folded.startswith(SEPARATOR, start + len(query)) else 1

    def _end(self, start: int) -> int:
        return self._folded.index(SEPARATOR, start)

    def item(self, row: int) -> tuple[str, str]:
        """Return (id, name) of an item; without a name, the name is the id."""
        first, last = bisect_left(self._owners, row), bisect_right(self._owners, row) - 1
        name, item = (self._text[start : self._end(start)] for start in (self._starts[first], self._starts[last]))
        return item, name

    def position(self, row: int, datum: Datum | None) -> tuple[float, float] | None:
        """Return the position of an item in metres, None if it has none."""
        xy = self._xy[row : row + 1]
        if np.isnan(xy).any():
            return None
        if not self._local[row]:
            if datum is None:
                return None
            xy = local_frame(datum).to_local(xy)
        return round(float(xy[0, 0]), 9), round(float(xy[0, 1]), 9)


class _Content(NamedTuple):
    """Searched parts of a version, and its datum."""

    datum: Datum | None
    parts: tuple[PartEntry, ...]


@dataclass(frozen=True, slots=True, order=True)
class _Match:
    """Match, in the order of the results. index: None for the environment itself."""

    rank: int
    order: int
    name: str
    environment: str
    level: str
    row: int
    owner: Row[Any] = field(compare=False)
    datum: Datum | None = field(compare=False)
    index: NameIndex | None = field(compare=False)

    def as_hit(self) -> SearchHit:
        version, title = self.owner.version, self.owner.title
        if self.index is None:
            name = self.environment
            return SearchHit("environment", name, version, name, name, None, None, title)
        item, name = self.index.item(self.row)
        position = self.index.position(self.row, self.datum)
        return SearchHit(ORDER[self.order], self.environment, version, item, name, self.level, position, title)


class Search:
    """Search by name. Thread-safe."""

    def __init__(self, database: Database, chunks: Chunks, max_bytes: int = MAX_INDEX_BYTES) -> None:
        self._database, self._chunks, self._max_bytes = database, chunks, max_bytes
        self._indexes: OrderedDict[str, NameIndex] = OrderedDict()
        self._contents: OrderedDict[tuple[str, int], _Content] = OrderedDict()
        self._size = 0
        self._lock, self._building = threading.Lock(), threading.Lock()
        self._builders = threading.Semaphore(MAX_BUILDERS)

    def find(self, query: str, *, limit: int, allowed: str | None = None) -> tuple[list[SearchHit], bool]:
        """Find environments by name and title, and nodes, zones and objects by name and id.

        In the version of the channel ``production`` if it exists, else in the head. Case-insensitive. Order: equal
        names before prefixes before other parts of names; of each environments, nodes, zones, objects, by name.

        allowed: a name pattern (fnmatch) of environments. Returns also whether there are more than ``limit``. Raises
        Unavailable while other searches build the index.
        """
        needle = fold(query.replace(SEPARATOR, " "))
        versions = self._read_versions(allowed)
        best = sorted(match for owner, _ in versions if (match := _environment_match(owner, needle)))[: limit + 1]
        for owner, content in versions:
            for entry in content.parts:
                order, worst = ORDER.index(KINDS[entry.key.layer]), 2
                if len(best) > limit:
                    worst = best[-1].rank - (best[-1].order <= order)
                if worst >= 0:
                    best += self._matches(owner, content.datum, entry, needle, limit + 1, worst)
                    best = sorted(best)[: limit + 1]
        return [match.as_hit() for match in best[:limit]], len(best) > limit

    def _matches(
        self, owner: Row[Any], datum: Datum | None, entry: PartEntry, needle: str, limit: int, worst: int
    ) -> list[_Match]:
        index, order = self._index(entry), ORDER.index(KINDS[entry.key.layer])
        return [
            _Match(rank, order, fold(index.item(row)[1]), owner.name, entry.key.level, row, owner, datum, index)
            for row, rank in index.find(needle, limit, worst).items()
            if rank <= worst
        ]

    def _read_versions(self, allowed: str | None) -> list[tuple[Row[Any], _Content]]:
        """Read the accessible environments with their searched version, by name."""
        table, channel = tables.environment, tables.channel
        production = (channel.c.environment_id == table.c.id) & (channel.c.name == PRODUCTION)
        number = func.coalesce(channel.c.version, table.c.head).label("version")
        query: Any = select(table.c.id, table.c.name, table.c.title, number).outerjoin(channel, production)
        with self._database.read() as connection:
            rows = connection.execute(query.where(table.c.deleted.is_(None)).order_by(table.c.name)).all()
            return [(row, self._content(connection, row)) for row in rows if reaches(allowed, row.name)]

    def _content(self, connection: Connection, row: Row[Any]) -> _Content:
        key = (row.id, row.version)
        with self._lock:
            content = self._contents.get(key)
            if content is not None:
                self._contents.move_to_end(key)
                return content
        table = tables.version
        query = select(table.c.manifest).where(table.c.environment_id == row.id, table.c.number == row.version)
        datum, _, parts, _ = unpack_manifest(bytes(connection.execute(query).scalar_one()))
        content = _Content(datum, tuple(e for e in parts if e.key.layer in KINDS and e.count))
        with self._lock:
            self._contents[key] = content
            while len(self._contents) > MAX_VERSIONS:
                self._contents.popitem(last=False)
        return content

    def _index(self, entry: PartEntry) -> NameIndex:
        index = self._cached(entry.hash)
        if index is not None:
            return index
        if not self._builders.acquire(blocking=False):
            raise Unavailable("the search index is being built: try again in a few seconds")
        try:
            with self._building:  # one at a time: concurrent searches need the same ones
                index = self._cached(entry.hash)
                return self._build(entry) if index is None else index
        finally:
            self._builders.release()

    def _cached(self, name: str) -> NameIndex | None:
        with self._lock:
            index = self._indexes.get(name)
            if index is not None:
                self._indexes.move_to_end(name)
            return index

    def _build(self, entry: PartEntry) -> NameIndex:
        index = self._read_index(entry)
        with self._lock:
            self._indexes[entry.hash] = index
            self._size += index.size
            while self._size > self._max_bytes and len(self._indexes) > 1:
                self._size -= self._indexes.popitem(last=False)[1].size
        return index

    def _read_index(self, entry: PartEntry) -> NameIndex:
        draft = self._chunks.stage()
        root = read_root(draft, bytes.fromhex(entry.hash))
        items: list[tuple[str, str | None]] = []
        wkb: list[bytes] = []
        local = 0
        for anchor, name in enumerate(("local", "wgs84")):
            node = root.trees[name]
            for item_id, item in leaf_items(draft, tree.leaves(draft, [node])[0] if node else [], anchor):
                properties = item.properties
                if entry.key.layer == "topology" and properties.get("kind") != "node":
                    continue
                title = properties.get("name")
                items.append((item_id, title if isinstance(title, str) else None))
                wkb.append(item.wkb)
                local += anchor == 0
        return NameIndex(items, _positions(from_wkb(wkb)), np.arange(len(items)) < local)


def _environment_match(owner: Row[Any], needle: str) -> _Match | None:
    """Compare the name and title of an environment."""
    texts = [fold(text) for text in (owner.name, owner.title)]
    ranks = [0 if text == needle else 1 if text.startswith(needle) else 2 for text in texts if needle in text]
    return _Match(min(ranks), 0, owner.name, owner.name, "", -1, owner, None, None) if ranks else None


def fold(text: str) -> str:
    """Convert to lower case without changing the number of characters."""
    lower = text.lower()
    if len(lower) != len(text):
        lower = "".join([c.lower() if len(c.lower()) == 1 else c for c in text])
    return lower.replace("ς", "σ")  # the only letter whose lower case depends on its neighbours


def _positions(geometry: NDArray[np.object_]) -> NDArray[np.float64]:
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

"""A vector part while it is edited: only the features that the edits name are read."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator
from typing import Any

import shapely

from app.model.features import Features, Properties
from app.model.layers import PartKey
from app.store.content import ContentReader
from app.store.values import Version

Row = tuple[Any, Properties, bool]
"""Geometry, properties, and whether the geometry is local."""

WHOLE = 8
"""A part is read as a whole if more than one in so many of its features are named."""


class EditedPart:
    """Features put and deleted, on top of the stored ones.

    ``dragged`` are the edges that follow a moved node. Stored features are read once, many at a time where that is
    known before.
    """

    def __init__(self, content: ContentReader, base: Version, key: PartKey, named: Collection[str]) -> None:
        """named: ids that the edits name."""
        self._content, self._base, self._key = content, base, key
        entry = base.part(key)
        self._count = 0 if entry is None else entry.count
        self._named = named
        self._rows: dict[str, Row | None] = {}
        self._edges: dict[str, list[str]] | None = None
        self._whole: Features | None = None
        self.puts: dict[str, Row] = {}
        self.deletes: set[str] = set()
        self.dragged: set[str] = set()
        if entry is not None:
            self.read(named)

    def read(self, items: Iterable[str]) -> None:
        """Read stored features, so that the next questions about them cost nothing."""
        missing = {item for item in items if item not in self._rows}
        if not missing or not self._count or self._whole is not None:
            return
        if len(missing) * WHOLE >= self._count:
            self._whole = self._content.features(self._base, self._key)
            self._rows = dict(_rows(self._whole))
            return
        self._rows |= dict.fromkeys(missing)
        self._rows |= dict(_rows(self._content.features(self._base, self._key, ids=missing)))

    def is_stored(self, item: str) -> bool:
        """Return whether the stored part has a feature."""
        self.read((item,))
        return self._rows.get(item) is not None

    def has_item(self, item: str) -> bool:
        """Return whether the edited part has a feature."""
        return item in self.puts or (item not in self.deletes and self.is_stored(item))

    def row(self, item: str) -> Row:
        """Return a feature of the edited part."""
        return self.puts[item] if item in self.puts else self.before(item)

    def before(self, item: str) -> Row:
        """Return a stored feature."""
        self.read((item,))
        row = self._rows[item]
        assert row is not None
        return row

    def connected_edges(self, node: str) -> list[str]:
        """List the stored edges that start or end at a node that the edits name."""
        if self._edges is None:
            self._edges = defaultdict(list)
            for item, (_, properties, _) in self._referring(self._named):
                if properties.get("kind") == "edge":
                    for end in {str(properties.get("source")), str(properties.get("target"))}:
                        self._edges[end].append(item)
        return self._edges.get(node, [])

    def drawn_from(self, sources: Collection[str]) -> list[str]:
        """List the features, not deleted, that were stored before and come from one of these drawn features."""
        stored = {item for item, _ in self._referring(sources)} | {i for i in self.puts if self.is_stored(i)}
        return sorted(i for i in stored - self.deletes if self.row(i)[1].get("drawn_from") in sources)

    def edited_ids(self) -> set[str]:
        """Return the ids of the stored features that are deleted or changed."""
        return self.deletes | {
            i for i, new in self.puts.items() if self.is_stored(i) and not _equal(self.before(i), new)
        }

    def _referring(self, names: Collection[str]) -> Iterator[tuple[str, Row]]:
        """Return the stored features that may name one of these in ``source``, ``target`` or ``drawn_from``."""
        if not self._count:
            return iter(())
        if self._whole is not None:
            return ((item, row) for item, row in self._rows.items() if row is not None)
        stored = dict(_rows(self._content.referring(self._base, self._key, names)))
        self._rows |= stored
        return iter(stored.items())


def _rows(features: Features) -> Iterator[tuple[str, Row]]:
    columns = (features.ids, features.geometry, features.properties, features.local.tolist())
    return ((i, (geometry, p, local)) for i, geometry, p, local in zip(*columns, strict=True))


def _equal(a: Row, b: Row) -> bool:
    return a[2] == b[2] and a[1] == b[1] and bool(shapely.equals_identical(a[0], b[0]))

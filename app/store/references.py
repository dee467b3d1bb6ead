"""Which leaves of vector parts have features that name others: remembered by the leaves' hashes.

Edges name their nodes, and features read from a drawing their drawn lines. Nothing stored says where from a node is
named, so the first question about a part reads it once; an edit makes a few new leaves, and only these are read again.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Collection, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from app.store import tree
from app.store.parts.features import BATCH, Item, leaf_items
from app.store.parts.roots import PartRoot, leaf_members
from app.store.tree import ChunkStage

PROPERTIES: Final = ("source", "target", "drawn_from")
"""Properties that name features."""

MAX_NAMES: Final = 2_000_000
"""Maximum number of remembered names, of 8 bytes each; a leaf counts as 16 more."""

Names = NDArray[np.int64]


class References:
    """Names in the leaves of vector parts, by the leaf's hash. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._leaves: OrderedDict[bytes, Names] = OrderedDict()
        self._names = 0

    def items(self, draft: ChunkStage, root: PartRoot, names: Collection[str]) -> dict[str, Item]:
        """Return the features that name one of these, and some others of the same leaves."""
        wanted = np.sort(np.fromiter(map(hash, names), np.int64))
        out: dict[str, Item] = {}
        if not len(wanted):
            return out
        for anchor, name in enumerate(("local", "wgs84")):
            node = root.trees[name]
            leaves = tree.leaves(draft, [node])[0] if node is not None else []
            names_by_leaf = self._names_of(draft, leaves)
            meeting = _meeting([names_by_leaf[leaf] for leaf in leaves], wanted)
            out.update(leaf_items(draft, [leaves[k] for k in meeting], anchor))
        return out

    def _names_of(self, draft: ChunkStage, leaves: Sequence[bytes]) -> dict[bytes, Names]:
        out: dict[bytes, Names] = {}
        with self._lock:
            for leaf in leaves:
                if leaf in self._leaves:
                    self._leaves.move_to_end(leaf)
                    out[leaf] = self._leaves[leaf]
        missing = [leaf for leaf in leaves if leaf not in out]
        for start in range(0, len(missing), BATCH):
            raws = draft.stream(missing[start : start + BATCH])
            read = {leaf: _names_in(raw) for leaf, raw in raws.items()}
            out |= read
            self._remember(read)
        return out

    def _remember(self, read: dict[bytes, Names]) -> None:
        with self._lock:
            for leaf, names in read.items():
                if leaf not in self._leaves:
                    self._leaves[leaf] = names
                    self._names += len(names) + 16
            while self._names > MAX_NAMES:
                _, names = self._leaves.popitem(last=False)
                self._names -= len(names) + 16


def _names_in(raw: bytes) -> Names:
    _, _, _, _, _, properties = leaf_members(raw, "features")
    named = {value for p in properties for name in PROPERTIES if isinstance(value := p.get(name), str)}
    return np.sort(np.fromiter(map(hash, named), np.int64))


def _meeting(leaves: Sequence[Names], wanted: Names) -> list[int]:
    """Return which leaves have a wanted name. wanted: sorted."""
    if not leaves:
        return []
    names = np.concatenate(leaves)
    places = np.minimum(np.searchsorted(wanted, names), len(wanted) - 1)
    ends = np.cumsum([len(leaf) for leaf in leaves])
    leaf_numbers: list[int] = np.unique(
        np.searchsorted(ends, np.flatnonzero(wanted[places] == names), side="right")
    ).tolist()
    return leaf_numbers

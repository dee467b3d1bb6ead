"""Chunk tree: a sorted sequence of items cut into content-addressed nodes, independent of its history.

The cuts depend on the items' keys only: a key whose hash at its level has ``bits`` low zero bits ends its node (2^bits
items on average). A node with more than four times as many items is cut again at keys with fewer zero bits, and so on.
The nodes' last keys are the sequence of the next level, until one node is left: the root. So equal items have equal
roots, an edit rewrites the few nodes on its path, and two trees share every node outside their differences. The idea
is that of the prolly trees of Noms and Dolt.

The key's hash is public (CRC-32, mixed with the level), so a client that chooses ids could make every item a node of
its own and slow down its own environment: more than 64 + n/8 leaves for n items are rejected.
"""

from __future__ import annotations

import zlib
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from app.errors import Damaged, Invalid
from app.store.encode import EMPTY_BOX, ENCODING, compress, decompress, digest, pack, unpack

FANOUT_BITS: Final = 6
"""Bits of an inner node's cuts: it has 64 children on average."""

OVERSIZE: Final = 4
"""Multiple of the average size above which nodes are cut again."""

MAX_LEVEL: Final = 12
"""Level at which everything goes into one node, so that no choice of keys makes an endless tree."""

Box = tuple[float, float, float, float]


class ChunkReader(Protocol):
    """Source of stored chunks."""

    def read_many(self, hashes: Sequence[bytes]) -> Mapping[bytes, bytes]:
        """Read chunks: hash -> canonical bytes. Raises Damaged if one is missing or damaged."""
        ...


@dataclass(frozen=True, slots=True)
class Node:
    """A reference to a node: its level (0 = leaf), items and leaves below, and the box around them."""

    hash: bytes
    level: int
    count: int
    leaves: int
    box: Box
    key: bytes = b""

    def as_list(self) -> list[Any]:
        """Return the reference as a list for a part's chunk."""
        box = None if self.box == EMPTY_BOX else list(self.box)
        return [self.hash, self.level, self.count, self.leaves, box]

    @classmethod
    def from_list(cls, members: Sequence[Any] | None) -> Node | None:
        """Read the result of ``as_list``; None for an empty tree."""
        if members is None:
            return None
        h, level, count, leaves, box = members
        return cls(h, level, count, leaves, EMPTY_BOX if box is None else tuple(box))


@dataclass(frozen=True, slots=True)
class Inner:
    """A decoded inner node. keys: ascending last keys of the children."""

    level: int
    keys: list[bytes]
    hashes: list[bytes]
    counts: list[int]
    leaves: list[int]
    boxes: NDArray[np.float64]

    def child(self, k: int) -> Node:
        """Return a reference to child k."""
        x0, y0, x1, y1 = self.boxes[k].tolist()
        return Node(self.hashes[k], self.level - 1, self.counts[k], self.leaves[k], (x0, y0, x1, y1), key=self.keys[k])

    def children(self) -> list[Node]:
        """All of them."""
        return [self.child(k) for k in range(len(self.keys))]

    def names(self) -> list[tuple[bytes, int]]:
        """Return hash and level of each child: much faster than ``children``."""
        return [(name, self.level - 1) for name in self.hashes]


def decode_inner(raw: bytes) -> Inner:
    """Decode the canonical bytes of an inner node."""
    members = unpack(raw)
    if members[1] != "inner":
        raise Damaged(f"a stored chunk is {members[1]!r} instead of an inner node")
    _, _, level, keys, hashes, counts, leaves, boxes = members
    n = len(keys)
    return Inner(
        level,
        keys,
        [hashes[32 * k : 32 * k + 32] for k in range(n)],
        counts,
        leaves,
        np.frombuffer(boxes, "<f8").reshape(n, 4),
    )


def encode_inner(level: int, children: Sequence[Node]) -> bytes:
    """The reverse."""
    boxes = np.array([c.box for c in children], "<f8")
    return pack(
        [
            ENCODING,
            "inner",
            level,
            [c.key for c in children],
            b"".join(c.hash for c in children),
            [c.count for c in children],
            [c.leaves for c in children],
            boxes.tobytes(),
        ]
    )


class ChunkStage:
    """New chunks on top of the stored ones. Chunks that are read are cached, so that none is read twice."""

    def __init__(self, source: ChunkReader) -> None:
        self._source = source
        self.new: dict[bytes, bytes] = {}
        self.stored: dict[bytes, bytes] = {}
        self._read: dict[bytes, bytes] = {}
        self._inner: dict[bytes, Inner] = {}

    def put(self, raw: bytes) -> bytes:
        """Stage a chunk; returns its hash."""
        name = digest(raw)
        self.new[name] = raw
        return name

    def put_compressed(self, raw: bytes, existing_names: Container[bytes]) -> bytes:
        """Stage a chunk compressed, unless its hash is in ``existing_names``; returns its hash."""
        name = digest(raw)
        if name not in existing_names and name not in self.stored:
            self.stored[name] = compress(raw)
        return name

    def read_many(self, hashes: Sequence[bytes]) -> dict[bytes, bytes]:
        """Read chunks: hash -> canonical bytes, one query for all that are not in memory."""
        missing = [h for h in dict.fromkeys(hashes) if h not in self.new and h not in self._read]
        if missing:
            self._read.update(self.stream(missing))
        return {h: self.new[h] if h in self.new else self._read[h] for h in hashes}

    def stream(self, hashes: Sequence[bytes]) -> dict[bytes, bytes]:
        """Read chunks like ``read_many``, without caching them."""
        out = {h: self.new[h] for h in hashes if h in self.new}
        out.update((h, decompress(self.stored[h])) for h in hashes if h in self.stored)
        missing = [h for h in dict.fromkeys(hashes) if h not in out]
        if missing:
            out.update(self._source.read_many(missing))
        return out

    def was_read(self, name: bytes) -> bool:
        """Return whether this chunk came from the store."""
        return name in self._read

    def read(self, name: bytes) -> bytes:
        """One chunk."""
        return self.read_many([name])[name]

    def inner(self, name: bytes) -> Inner:
        """Read one inner node."""
        node = self._inner.get(name)
        if node is None:
            node = self._inner[name] = decode_inner(self.read(name))
        return node


# --- cuts ---


def key_hashes(keys: Iterable[bytes], level: int) -> NDArray[np.uint32]:
    """Hash keys at a level: CRC-32 plus level · 0x9E3779B9, through MurmurHash3's finaliser. The hash is public."""
    crc = np.fromiter(map(zlib.crc32, keys), np.uint32)
    h = crc + np.uint32((level * 0x9E3779B9) & 0xFFFFFFFF)
    h ^= h >> np.uint32(16)
    h *= np.uint32(0x85EBCA6B)
    h ^= h >> np.uint32(13)
    h *= np.uint32(0xC2B2AE35)
    h ^= h >> np.uint32(16)
    return h


def cut(hashes: NDArray[np.uint32], bits: int, limit: int | None = None) -> list[int]:
    """Return the ends (exclusive) of the nodes of a sequence of keys with these hashes."""
    n = len(hashes)
    if limit is None:
        limit = OVERSIZE << bits
    ends = np.flatnonzero((hashes & np.uint32((1 << bits) - 1)) == 0) + 1
    out: list[int] = []
    start = 0
    for end in [*ends.tolist(), n]:
        if end == start:
            continue
        if end - start > limit and bits:
            out.extend(start + e for e in cut(hashes[start:end], bits - 1, limit))
        else:
            out.append(end)
        start = end
    return out


def ends_node(key: bytes, level: int, bits: int) -> bool:
    """Return whether this key ends its node by the full number of bits, which separates the nodes on both sides."""
    return level < MAX_LEVEL and not int(key_hashes((key,), level)[0]) & ((1 << bits) - 1)


# --- building ---


def build(
    draft: ChunkStage,
    keys: Sequence[bytes],
    bits: int,
    encode: Callable[[int, int], bytes],
    boxes: NDArray[np.float64] | None = None,
) -> Node | None:
    """Build a tree of sorted distinct keys. encode(start, end) gives a leaf's bytes; boxes: float64 [n, 4] or None."""
    if not keys:
        return None
    ends = cut(key_hashes(keys, 0), bits)
    starts = [0, *ends[:-1]]
    around = join_boxes(boxes, starts) if boxes is not None else [EMPTY_BOX] * len(ends)
    leaves = [
        Node(draft.put(encode(s, e)), 0, e - s, 1, box, key=keys[e - 1])
        for s, e, box in zip(starts, ends, around, strict=True)
    ]
    root = raise_tree(draft, leaves, 1)
    check_leaves(root)
    return root


def join_boxes(boxes: NDArray[np.float64], starts: Sequence[int]) -> list[Box]:
    """Return the box around each run of boxes."""
    low = np.minimum.reduceat(boxes[:, :2], starts, axis=0)
    high = np.maximum.reduceat(boxes[:, 2:], starts, axis=0)
    return [(a, b, c, d) for (a, b), (c, d) in zip(low.tolist(), high.tolist(), strict=True)]


def inner_nodes(draft: ChunkStage, children: Sequence[Node], level: int) -> list[Node]:
    """Group the nodes of the level below into inner nodes of this level."""
    ends = cut(key_hashes((c.key for c in children), level), FANOUT_BITS) if level < MAX_LEVEL else [len(children)]
    out = []
    start = 0
    for end in ends:
        group = children[start:end]
        boxes = np.array([c.box for c in group])
        (box,) = join_boxes(boxes, [0])
        name = draft.put(encode_inner(level, group))
        count, leaves = sum(c.count for c in group), sum(c.leaves for c in group)
        out.append(Node(name, level, count, leaves, box, key=group[-1].key))
        start = end
    return out


def raise_tree(draft: ChunkStage, nodes: list[Node], level: int) -> Node:
    """Build inner levels above these nodes, until one is left."""
    while len(nodes) > 1:
        nodes = inner_nodes(draft, nodes, level)
        level += 1
    return nodes[0]


def check_leaves(root: Node | None) -> None:
    """Raise Invalid if keys were chosen so that leaves become tiny."""
    if root is not None and root.leaves > 64 + root.count // 8:
        raise Invalid(
            f"{root.count} items would need {root.leaves} leaves of storage: their ids are chosen such that "
            "nearly each one ends a leaf. Use other ids (at most 64 leaves and one more for each 8 items are stored)"
        )


# --- reading ---


def leaves(draft: ChunkStage, roots: Sequence[Node]) -> list[list[bytes]]:
    """Return the hashes of each tree's leaves, in order; one query for each level of the tallest."""
    frontier = [[(root.hash, root.level)] for root in roots]
    while any(level for nodes in frontier for _, level in nodes):
        draft.read_many([name for nodes in frontier for name, level in nodes if level])
        frontier = [
            [child for node in nodes for child in (draft.inner(node[0]).names() if node[1] else (node,))]
            for nodes in frontier
        ]
    return [[name for name, _ in nodes] for nodes in frontier]


def select(
    draft: ChunkStage, root: Node | None, predicate: Callable[[NDArray[np.float64]], NDArray[np.bool_]]
) -> list[bytes]:
    """Return the hashes of the leaves whose box passes: wanted(boxes float64 [n, 4]) -> bool [n]."""
    if root is None or not bool(predicate(np.array([root.box]))[0]):
        return []
    nodes = [root.hash]
    for _ in range(root.level):
        draft.read_many(nodes)
        chosen: list[bytes] = []
        for name in nodes:
            inner = draft.inner(name)
            chosen.extend(inner.hashes[k] for k in np.flatnonzero(predicate(inner.boxes)).tolist())
        nodes = chosen
    return nodes


def paths(draft: ChunkStage, root: Node | None, keys: Sequence[bytes]) -> list[bytes]:
    """Return the hashes of the leaves that contain, or would contain, these sorted keys; reads the path."""
    if root is None or not keys:
        return []
    frontier: list[tuple[bytes, Sequence[bytes]]] = [(root.hash, keys)]
    for _ in range(root.level):
        draft.read_many([name for name, _ in frontier])
        following: list[tuple[bytes, Sequence[bytes]]] = []
        for name, some in frontier:
            inner = draft.inner(name)
            last = len(inner.keys) - 1
            start = 0
            while start < len(some):
                k = min(bisect_left(inner.keys, some[start]), last)
                end = len(some) if k == last else bisect_right(some, inner.keys[k], lo=start)
                following.append((inner.hashes[k], some[start:end]))
                start = end
        frontier = following
    names = [name for name, _ in frontier]
    draft.read_many(names)
    return names


def differing(draft: ChunkStage, a: Node | None, b: Node | None) -> tuple[list[bytes], list[bytes]]:
    """Return the leaves of a that are not in b, and the reverse; reads nothing below equal nodes."""
    left, right = [a] if a else [], [b] if b else []
    while True:
        common = {n.hash for n in left} & {n.hash for n in right}
        left = [n for n in left if n.hash not in common]
        right = [n for n in right if n.hash not in common]
        level = max((n.level for n in (*left, *right)), default=0)
        if level == 0:
            return [n.hash for n in left], [n.hash for n in right]
        draft.read_many([n.hash for n in (*left, *right) if n.level == level])
        left, right = (
            [c for n in side for c in (draft.inner(n.hash).children() if n.level == level else (n,))]
            for side in (left, right)
        )


def names(draft: ChunkStage, root: Node | None, existing_names: Container[bytes] = ()) -> set[bytes]:
    """Return the hashes of all nodes of a tree except ``existing_names`` and the nodes below them. Reads no leaves."""
    out: set[bytes] = set()
    nodes = [(root.hash, root.level)] if root else []
    while nodes:
        nodes = [node for node in nodes if node[0] not in existing_names]
        out.update(name for name, _ in nodes)
        inner = [name for name, level in nodes if level]
        draft.read_many(inner)
        nodes = [child for name in inner for child in draft.inner(name).names()]
    return out


# --- editing ---


class LeafCodec(Protocol):
    """Codec of the leaves of one kind of tree."""

    bits: int

    def decode(self, raw: bytes) -> tuple[list[bytes], list[Any]]:
        """Decode a leaf into keys and items."""
        ...

    def encode(self, keys: Sequence[bytes], items: Sequence[Any]) -> bytes:
        """Encode a leaf."""
        ...

    def boxes(self, items: Sequence[Any]) -> NDArray[np.float64] | None:
        """Return the items' boxes, float64 [n, 4], or None if they have no coordinates."""
        ...


def edit(
    draft: ChunkStage, codec: LeafCodec, root: Node | None, put: Mapping[bytes, Any], removed: Iterable[bytes]
) -> Node | None:
    """Put items (add or replace by key) and remove keys; returns the same tree as building it from scratch."""
    deletions = set(removed) - put.keys()
    if not put and not deletions:
        return root
    if root is None:
        keys = sorted(put)
        items = [put[k] for k in keys]
        return build(draft, keys, codec.bits, lambda s, e: codec.encode(keys[s:e], items[s:e]), codec.boxes(items))
    touched = sorted(deletions | put.keys())
    paths(draft, root, touched)

    def regroup_leaves(old: Sequence[Node], lo: bytes | None, hi: bytes | None) -> list[Node]:
        return _edited_leaves(draft, codec, old, put, _between(touched, lo, hi))

    new, old_keys, all_nodes = _edit_level(draft, root, 0, codec.bits, touched, deletions, regroup_leaves)
    level = 0
    while level < root.level:
        level += 1
        fresh = {n.key: n for n in new}
        lost = old_keys - fresh.keys()
        touched_now = sorted(lost | fresh.keys())
        at = level

        def regroup_inner(
            old: Sequence[Node],
            lo: bytes | None,
            hi: bytes | None,
            *,
            fresh: dict[bytes, Node] = fresh,
            touched_now: list[bytes] = touched_now,
            at: int = at,
        ) -> list[Node]:
            merged = {c.key: c for n in old for c in draft.inner(n.hash).children()}
            _update(merged, fresh, _between(touched_now, lo, hi))
            return inner_nodes(draft, [merged[k] for k in sorted(merged)], at) if merged else []

        new, old_keys, all_nodes = _edit_level(draft, root, level, FANOUT_BITS, touched_now, lost, regroup_inner)
    assert all_nodes
    if not new:
        return None
    top = raise_tree(draft, new, level + 1)
    while top.level:
        inner = draft.inner(top.hash)
        if len(inner.keys) > 1:
            break
        top = inner.child(0)
    check_leaves(top)
    return top


def _edited_leaves(
    draft: ChunkStage, codec: LeafCodec, old: Sequence[Node], put: Mapping[bytes, Any], touched: Sequence[bytes]
) -> list[Node]:
    """Return the leaves that replace old ones after the touched keys were put, or removed if not in ``put``."""
    merged: dict[bytes, Any] = {}
    for raw in draft.read_many([n.hash for n in old]).values():
        merged.update(zip(*codec.decode(raw), strict=True))
    _update(merged, put, touched)
    if not merged:
        return []
    keys = sorted(merged)
    items = [merged[k] for k in keys]
    ends = cut(key_hashes(keys, 0), codec.bits)
    starts = [0, *ends[:-1]]
    boxes = codec.boxes(items)
    around = join_boxes(boxes, starts) if boxes is not None else [EMPTY_BOX] * len(ends)
    return [
        Node(draft.put(codec.encode(keys[s:e], items[s:e])), 0, e - s, 1, box, key=keys[e - 1])
        for s, e, box in zip(starts, ends, around, strict=True)
    ]


def _update(merged: dict[bytes, Any], put: Mapping[bytes, Any], touched: Sequence[bytes]) -> None:
    """Put the touched keys that have an item, remove the others."""
    for key in touched:
        if key in put:
            merged[key] = put[key]
        else:
            merged.pop(key, None)


def _between(keys: Sequence[bytes], lo: bytes | None, hi: bytes | None) -> Sequence[bytes]:
    """Return the sorted keys in (lo, hi]; None is no bound."""
    return keys[0 if lo is None else bisect_right(keys, lo) : len(keys) if hi is None else bisect_right(keys, hi)]


def _edit_level(
    draft: ChunkStage,
    root: Node,
    level: int,
    bits: int,
    touched: Sequence[bytes],
    deletions: set[bytes],
    regroup: Callable[[Sequence[Node], bytes | None, bytes | None], list[Node]],
) -> tuple[list[Node], set[bytes], bool]:
    """Regroup the runs of nodes of a level that these sorted keys touch.

    A run starts after a key that ends its node by the full number of bits, and ends with such a key that is not
    deleted, or with the sequence. Returns the new nodes, the last keys of the nodes that they replace, and whether
    those were the whole level.
    """
    if level == root.level:
        last = draft.inner(root.hash).keys[-1] if root.level else b""
        return regroup([root], None, None), {last}, True
    new: list[Node] = []
    old_keys: set[bytes] = set()
    done: bytes | None = None
    finished = False
    for key in touched:
        if finished or (done is not None and key <= done):
            continue
        first = _first_node(draft, root, level, key) or _last_node(draft, root, level)
        run = [first]
        while (before := _is_before(draft, root, level, run[0].key)) and not ends_node(before.key, level, bits):
            run.insert(0, before)
        while not (ends_node(run[-1].key, level, bits) and run[-1].key not in deletions):
            after = _first_node(draft, root, level, run[-1].key, strict=True)
            if after is None:
                break
            run.append(after)
        before = _is_before(draft, root, level, run[0].key)
        finished = _first_node(draft, root, level, run[-1].key, strict=True) is None
        done = run[-1].key
        new.extend(regroup(run, before.key if before else None, None if finished else done))
        old_keys.update(n.key for n in run)
    return new, old_keys, False


def _first_node(draft: ChunkStage, root: Node, level: int, key: bytes, *, strict: bool = False) -> Node | None:
    """Return the first node of a level whose last key is not before (strict: is after) this key."""
    node = draft.inner(root.hash)
    while True:
        k = bisect_right(node.keys, key) if strict else bisect_left(node.keys, key)
        if k == len(node.keys):
            return None
        if node.level == level + 1:
            return node.child(k)
        node = draft.inner(node.hashes[k])


def _last_node(draft: ChunkStage, root: Node, level: int) -> Node:
    node = draft.inner(root.hash)
    while node.level > level + 1:
        node = draft.inner(node.hashes[-1])
    return node.child(len(node.keys) - 1)


def _is_before(draft: ChunkStage, root: Node, level: int, key: bytes) -> Node | None:
    """Return the last node of a level whose last key is before this key."""
    return _search_before(draft, draft.inner(root.hash), level, key)


def _search_before(draft: ChunkStage, node: Inner, level: int, key: bytes) -> Node | None:
    # no nested function: one that calls itself would keep the stage until the cyclic garbage collector runs
    k = bisect_left(node.keys, key)
    if node.level == level + 1:
        return node.child(k - 1) if k else None
    if k < len(node.keys):
        last_node = _search_before(draft, draft.inner(node.hashes[k]), level, key)
        if last_node:
            return last_node
    return _last_node(draft, node.child(k - 1), level) if k else None

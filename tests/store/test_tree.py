"""The chunk tree is a function of its items only, independent of its edits."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.errors import Invalid
from app.store import tree
from app.store.encode import ENCODING, pack, unpack


class Memory:
    """Chunks of earlier stages; counts reads."""

    def __init__(self) -> None:
        self.chunks: dict[bytes, bytes] = {}
        self.reads = 0

    def read_many(self, hashes: Sequence[bytes]) -> Mapping[bytes, bytes]:
        self.reads += len(hashes)
        return {h: self.chunks[h] for h in hashes}


class Numbers:
    """Codec of items that are numbers, with points as boxes."""

    def __init__(self, bits: int) -> None:
        self.bits = bits

    def decode(self, raw: bytes) -> tuple[list[bytes], list[Any]]:
        _, _, keys, items = unpack(raw)
        return keys, items

    def encode(self, keys: Sequence[bytes], items: Sequence[Any]) -> bytes:
        return pack([ENCODING, "numbers", list(keys), list(items)])

    def boxes(self, items: Sequence[Any]) -> Any:
        return np.array([[v, -v, v, -v] for v in items], float)


def fresh(codec: Numbers, items: dict[bytes, int]) -> tree.Node | None:
    return tree.edit(tree.ChunkStage(Memory()), codec, None, items, ())


keys = st.integers(0, 400).map(lambda n: str(n).encode())
edits = st.lists(
    st.tuples(st.dictionaries(keys, st.integers(0, 9), max_size=60), st.sets(keys, max_size=60)), min_size=1, max_size=8
)


@pytest.fixture(autouse=True)
def small_nodes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use four children per node, and no limit on tiny leaves: high trees of few items."""
    monkeypatch.setattr(tree, "FANOUT_BITS", 2)
    monkeypatch.setattr(tree, "check_leaves", lambda root: None)


@given(edits)
def test_edited_tree_equals_rebuilt_tree(rounds: list[tuple[dict[bytes, int], set[bytes]]]):
    tree.FANOUT_BITS = 2
    tree.check_leaves = lambda root: None
    codec, memory = Numbers(2), Memory()
    root: tree.Node | None = None
    items: dict[bytes, int] = {}
    for put, removed in rounds:
        draft = tree.ChunkStage(memory)
        root = tree.edit(draft, codec, root, put, removed)
        memory.chunks.update(draft.new)
        for key in removed - put.keys():
            items.pop(key, None)
        items.update(put)
        expected = fresh(codec, items) if items else None
        assert (root and (root.hash, root.level, root.count, root.leaves, root.box)) == (
            expected and (expected.hash, expected.level, expected.count, expected.leaves, expected.box)
        )


def test_edit_of_large_tree_rewrites_one_path():
    codec, memory = Numbers(4), Memory()
    items = {b"%06d" % i: i for i in range(20_000)}
    draft = tree.ChunkStage(memory)
    root = tree.edit(draft, codec, None, items, ())
    assert root is not None
    memory.chunks.update(draft.new)
    assert root.level >= 5
    draft = tree.ChunkStage(memory)
    new = tree.edit(draft, codec, root, {b"010000": 7}, ())
    assert len(draft.new) <= 3 * (root.level + 1)
    assert memory.reads <= 4 * (root.level + 1)
    memory.chunks.update(draft.new)
    memory.reads = 0
    left, right = tree.differing(tree.ChunkStage(memory), root, new)
    assert len(left) == len(right) == 1
    assert memory.reads <= 2 * root.level


def test_tree_paths_reach_every_key_and_select_every_box():
    codec, memory = Numbers(2), Memory()
    items = {b"%05d" % i: i for i in range(3000)}
    draft = tree.ChunkStage(memory)
    root = tree.edit(draft, codec, None, items, ())
    keys = [b"%05d" % i for i in range(0, 3000, 17)]
    path_keys = {k for name in tree.paths(draft, root, keys) for k in codec.decode(draft.read(name))[0]}
    assert set(keys) <= path_keys
    leaves = tree.select(draft, root, lambda boxes: (boxes[:, 0] <= 1210) & (boxes[:, 2] >= 1200))
    chosen = {k for name in leaves for k in codec.decode(draft.read(name))[0]}
    assert {b"%05d" % i for i in range(1200, 1211)} <= chosen
    assert len(chosen) < 100


def test_adversarial_keys_are_limited_in_levels_and_leaves(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.undo()
    some = (b"%d" % i for i in range(10**7))
    chosen = [k for k in (next(some) for _ in range(80_000)) if tree.ends_node(k, 0, 6)]
    assert len(chosen) > 1000
    codec = Numbers(6)
    with pytest.raises(Invalid, match="leaves of storage"):
        fresh(codec, dict.fromkeys(chosen, 1))


def test_nodes_without_a_boundary_are_cut_on_fewer_bits():
    hashes = np.arange(1, 4000, 2, dtype=np.uint32) * np.uint32(2)  # never zero in six bits at once, but in one
    ends = tree.cut(hashes[(hashes & 63) != 0], 6)
    sizes = np.diff([0, *ends])
    assert sizes.max() <= 256


def test_edit_leaves_no_cycle_that_keeps_what_it_read():
    codec, stage = Numbers(4), tree.ChunkStage(Memory())
    root = tree.edit(stage, codec, None, {b"%06d" % k: k for k in range(2_000)}, ())
    assert root is not None
    assert root.level > 1
    gc.collect()
    gc.disable()  # as while layers are loaded: objects of cycles then pile up
    try:
        tree.edit(stage, codec, root, {b"010000x": 1}, {b"000007"})
        reference = weakref.ref(stage)
        del stage
        assert reference() is None
    finally:
        gc.enable()

"""Canonical bytes: equal on every machine, exact in numbers, and limited to JSON types."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from hypothesis import given
from hypothesis import strategies as st

from app.errors import Damaged, Invalid
from app.model.features import features
from app.store import encode, parts
from app.store.changes import Replace
from app.store.parts.features import encode_leaf, split_leaf
from app.store.parts.rasters import morton
from app.store.store import Store
from app.store.tree import ChunkStage
from tests.store.samples import TOPOLOGY, grid, mixed, network, picture, save, typed, voxels


class Nothing:
    def read_many(self, hashes):
        raise AssertionError("nothing is stored")


def part_hash(part) -> str:
    return parts.compose(ChunkStage(Nothing()), part, None, "").hash.hex()


def test_encoding_hashes_never_change():
    """Hashes of content stored by older releases: it must stay readable and comparable, so these may only grow."""
    assert {
        "mixed": part_hash(mixed()),
        "network": part_hash(network(200)),
        "earth": part_hash(network(200, anchor="wgs84")),
        "grid": part_hash(grid()),
        "voxels": part_hash(voxels()),
        "picture": part_hash(picture()),
    } == GOLDEN


GOLDEN = {
    "mixed": "56bffffc69ea3e144b6c0ca371bd5a939566f5ea94a9e22ae876633736ab373e",
    "network": "52350fa4cd24455b6db22f412dbc7d8269d9802644b3975b3c2494041e51dd68",
    "earth": "a81f934124988aaa30407fafdeec8a4b7f7a91732e840ae8a27553f65027e3eb",
    "grid": "e880819126c56d6e43bc8f1d810bc02c309c7eedb35f7dc9d6ff8efbeaa2a656",
    "voxels": "e0647715e359e15a95812041599c23544308d29e294b7ddf026eb178dac700d9",
    "picture": "0e0b50470c9cb579f024e8b6e272fe1ad64e16122647606d900cb0388c95fed7",
}


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, np.float64("nan"), {"deep": [1, {"x": math.nan}]}])
def test_pack_rejects_infinite_numbers(bad):
    with pytest.raises(Invalid, match="x1"):
        part_hash(features([("x0", None, {}), ("x1", None, {"v": bad})], "local"))


@pytest.mark.parametrize("bad", [2**64, {1: 2}, {1, 2}, "\ud800", object(), {"a": b"bytes"}])
def test_pack_rejects_values_without_json_type(bad):
    with pytest.raises(Invalid, match="x1"):
        part_hash(features([("x1", None, {"v": bad})], "local"))


def test_pack_keeps_integers_and_floats_apart_and_drops_sign_of_zero():
    hashes = {part_hash(features([("a", shapely.Point(0, 0), {"v": v})], "local")) for v in (1, 1.0, True, "1")}
    assert len(hashes) == 4
    origin = shapely.Point(0, 0)
    zero = part_hash(features([("a", origin, {"v": 0.0, "w": [0.0]})], "local"))
    assert zero == part_hash(features([("a", shapely.Point(-0.0, 0), {"v": -0.0, "w": [-0.0]})], "local"))
    assert zero == part_hash(features([("a", origin, {"w": (np.float64(0),), "v": np.float32(0)})], "local"))


def test_root_ignores_order_of_items_and_keys():
    rows = [(f"i{k}", shapely.Point(k % 7, k), {"a": k, "b": {"x": 1, "y": 2}}) for k in range(300)]
    turned = [(i, g, {"b": {"y": 2, "x": 1}, "a": p["a"]}) for i, g, p in reversed(rows)]
    assert part_hash(features(rows, "local")) == part_hash(features(turned, "local"))


json_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**64 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=12,
)


@given(st.lists(st.dictionaries(st.text(), json_values, max_size=4), min_size=1, max_size=5))
def test_properties_round_trip_exactly(properties):
    ids = [f"i{k}" for k in range(len(properties))]
    packed = encode.pack_properties(ids, properties)
    leaf = encode_leaf(ids, b"\0" * 8 * len(ids), [b""] * len(ids), packed)
    back = encode.unpack(leaf)[-1]
    assert typed(back) == typed(properties)
    assert split_leaf(leaf) == (ids, b"\0" * 8 * len(ids), [b""] * len(ids), packed)
    assert encode.pack_properties(ids, back) == packed


@given(st.lists(st.tuples(st.integers(0, 2**32 - 1), st.integers(0, 2**32 - 1)), min_size=1, max_size=20))
def test_interleave_mixes_the_bits_of_both_numbers(pairs):
    x, y = (np.array(v, np.uint64) for v in zip(*pairs, strict=True))
    expected = [sum((a >> k & 1 | (b >> k & 1) << 1) << 2 * k for k in range(32)) for a, b in pairs]
    assert encode.interleave(x, y).tolist() == expected
    assert morton(int(encode.interleave(x % 1000, y % 1000)[0])) == (pairs[0][1] % 1000, pairs[0][0] % 1000)


def test_wkb_boxes_equal_geos_bounds():
    shapes = [
        shapely.Point(1, 2),
        shapely.Point(3, 4, 5),
        shapely.Point(),
        shapely.LineString([(5, 1), (2, 9)]),
        shapely.LineString([(5, 1, 1), (2, 9, 1)]),
        shapely.LineString([(5, 1), (2, 9), (0, 0)]),
        shapely.box(0, 0, 3, 3),
        shapely.GeometryCollection(),
        shapely.MultiPoint([(1, 1), (2, 2)]),
    ]
    column = np.array([*shapes, None], object)[:-1]
    assert np.array_equal(encode.wkb_bounds(list(encode.to_wkb(column))), encode.bounds(column))


def test_unknown_encoding_raises_damaged(sqlite_store: Store):
    with pytest.raises(Damaged, match="newer"):
        encode.unpack(encode.pack([2, "features", []]))


def test_adversarial_ids_are_rejected(sqlite_store: Store):
    from app.store import tree

    shape = shapely.Point(1, 2)
    cell = encode.z_cells(encode.bounds(np.array([shape])), np.array([True])).astype(">u8").tobytes()
    chosen = [i for i in (f"i{k}" for k in range(60_000)) if tree.ends_node(cell + i.encode(), 0, 6)]
    sqlite_store.environments.create("farm")
    with pytest.raises(Invalid, match="Use other ids"):
        save(sqlite_store, "farm", Replace(TOPOLOGY, features([(i, shape, {}) for i in chosen], "local")))

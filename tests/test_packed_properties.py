"""Properties that are numbered while they are MessagePack, beside the plain way: unpacked, and one by one."""

from __future__ import annotations

import itertools
import random
from typing import Any

import numpy as np
import ormsgpack
import pytest

from app.syntax import packed_properties
from app.syntax.packed_properties import Spans, number, read_maps

SINGLE = (str, int, float, bool)


def plain(features: list[dict[str, Any]]) -> tuple[list[str], list[tuple[type, Any]], list[list[tuple[int, int]]]]:
    """Return distinct keys and values in the order of their first occurrence, and each feature's pairs of indices."""
    keys: dict[str, int] = {}
    values: dict[tuple[type, Any], int] = {}
    tags = [
        [
            (keys.setdefault(key, len(keys)), values.setdefault((type(value), value), len(values)))
            for key, value in members.items()
        ]
        for members in features
    ]
    return list(keys), list(values), tags


def packed(features: list[dict[str, Any]]) -> list[bytes]:
    return [ormsgpack.packb(members) for members in features]


def check(features: list[dict[str, Any]]) -> None:
    """Compare with the plain way; nested and missing values are given as others."""
    ids = [f"é{k}" if k % 7 == 0 else f"n{k}" for k in range(len(features))]
    maps = read_maps(packed(features))
    flat = [
        {key: value if isinstance(value, SINGLE) else repr(value) for key, value in members.items()} | {"id": item}
        for members, item in zip(features, ids, strict=True)
    ]
    others = {row: flat[row] for row in np.flatnonzero(~maps.single | maps.with_key("id")).tolist()}
    found = number(maps, [("id", ids, np.arange(len(ids)))], others)
    keys, values, tags = plain(flat)
    assert [key.decode() for key in found.keys.slices(found.data)] == keys
    shown = zip(found.values.slices(found.data), found.values.texts.tolist(), strict=True)
    read = [one.decode() if is_text else ormsgpack.unpackb(one) for one, is_text in shown]
    assert [(type(value), value) for value in read] == values
    pairs = [tuple(pair) for pair in found.tags.tolist()]
    starts = found.starts.tolist()
    assert [pairs[a:b] for a, b in itertools.pairwise(starts)] == tags


def random_value(rng: random.Random) -> Any:
    text = rng.choice(
        ["", "a", "edge", "n1", "ä" * 40, "x" * 31, "x" * 32, "y" * 255, "y" * 256, "z" * 300, "12345678"]
    )
    numbers = [0, 1, -1, -33, 127, 128, 255, 256, 65535, 65536, 2**32, 2**63 - 1, 2**63, -(2**31) - 1, -(2**63), -200]
    return rng.choice([text, rng.choice(numbers), rng.choice([0.5, 1.0, -2.25]), True, False, text, text])


@pytest.mark.parametrize("seed", range(20))
def test_numbers_equal_those_of_unpacked_properties(seed: int) -> None:
    rng = random.Random(seed)
    names = ["kind", "id", "source", "k" * 40, "größe", "n", "long" * 70]
    features = []
    for _ in range(rng.randrange(1, 200)):
        members = {name: random_value(rng) for name in rng.sample(names, rng.randrange(len(names) + 1))}
        if rng.random() < 0.1:
            members["nested"] = rng.choice([None, [1, 2], {"a": {"b": 1}}])
            members["after"] = "nested"
        if rng.random() < 0.05:
            members |= {f"p{k}": k for k in range(rng.choice([10, 14, 30, 64, 65, 300]))}
        features.append(members)
    check(features)


def test_only_what_is_single_and_not_too_long_is_read() -> None:
    rows = [{"a": 1}, {"a": None}, {"a": [1]}, {"a": {}}, {}, {f"p{k}": 1 for k in range(65)}, {"a": "x" * 70_000}]
    assert read_maps(packed(rows)).single.tolist() == [True, False, False, False, True, False, False]
    assert read_maps([]).single.tolist() == []


def test_equal_hashes_of_different_texts_do_no_harm(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(packed_properties, "_FACTOR", np.uint64(0))
    check([{"a": f"{k % 5:08}", "b": "same"} for k in range(50)])


def test_a_text_differs_from_a_number_of_the_same_bytes() -> None:
    one = ormsgpack.packb(65).decode()
    check([{"a": one, "b": 65}, {"a": 65, "b": one}])


def test_a_constant_column_is_found_in_long_texts_too() -> None:
    check([{"a": "long text " * 20, "b": "long text " * 20 + str(k % 2)} for k in range(30)])
    assert Spans.of(1).slices(b"x") == [b""]

"""Bounded part of `make fuzz`: the same mutations on every machine; Hypothesis also chooses some."""

from __future__ import annotations

import random

from hypothesis import given, settings
from hypothesis import strategies as st

from tests.hostile.corpus import sample_maps
from tests.hostile.fuzz import mutate, outcome, run

MAPS = list(sample_maps())


def test_mutated_samples_are_read_or_rejected() -> None:
    counts, failures = run(seed=20261122, seconds=8.0, limit=600)
    assert not failures, "\n".join(failures)
    assert counts["refused"] > counts.total() // 10, counts
    assert counts["read"] > counts.total() // 20, counts


@settings(max_examples=60, deadline=None, derandomize=True)
@given(k=st.integers(0, len(MAPS) - 1), seed=st.integers(0, 2**32), tail=st.binary(max_size=40))
def test_any_mutation_is_read_or_rejected(k: int, seed: int, tail: bytes) -> None:
    name, files = MAPS[k]
    dice = random.Random(seed)
    victim = dice.choice(sorted(files))
    outcome(name, {**files, victim: mutate(files[victim], dice) + tail})

"""Chains are tried in the order of their cost, each without the steps that failed before."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from app.derive import ChainFailure, first_working
from app.errors import Ambiguous, CannotDerive, MissingLayer


def plan(without: frozenset[str]) -> str:
    left = [step for step in ("cheap", "dear") if step not in without]
    if not left:
        raise MissingLayer("supply a network")
    return left[0]


def test_next_chain_is_tried_with_earlier_failures() -> None:
    def attempt(step: str, failed: Sequence[ChainFailure]) -> list[ChainFailure]:
        if step == "cheap":
            raise CannotDerive("too thin", step=step)
        return list(failed)

    assert first_working(plan, attempt) == [ChainFailure("cheap", "too thin")]


def test_exhausted_chains_raise_all_reasons() -> None:
    def attempt(step: str, _: Sequence[ChainFailure]) -> None:
        raise CannotDerive(f"{step} finds nothing", step=step)

    reason = "supply a network; the stored layers do not suffice: cheap finds nothing; dear finds nothing"
    with pytest.raises(MissingLayer, match=reason):
        first_working(plan, attempt)


def test_chain_that_needs_a_name_raises_ambiguous() -> None:
    def attempt(step: str, _: Sequence[ChainFailure]) -> None:
        raise CannotDerive(f"{step}: name one", step=step, choose=step == "dear")

    with pytest.raises(Ambiguous, match="dear: name one"):
        first_working(plan, attempt)


def test_failure_without_a_step_is_final() -> None:
    def attempt(step: str, _: Sequence[ChainFailure]) -> None:
        raise CannotDerive("no step failed")

    with pytest.raises(CannotDerive, match="no step failed"):
        first_working(plan, attempt)

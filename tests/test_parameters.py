"""Parameters: accepted values have the declared type and bounds; all others are rejected by name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app import parameters
from app.errors import Invalid
from app.parameters import parameter


@dataclass(frozen=True, slots=True)
class Options:
    resolution: float = parameter(0.05, "metres a cell", minimum=1e-3, maximum=100.0, unit="m")
    count: int = parameter(3, "how many", minimum=0, maximum=10)
    kind: Literal["pgm", "png"] = parameter("pgm", "picture format")
    fast: bool = parameter(False, "less careful")
    name: str = parameter("", "a name")
    band: tuple[float, float] | None = parameter(None, "low,high", minimum=-10)
    tags: tuple[str, ...] = parameter((), "words")
    limit: int | None = parameter(None, "at most")


def parse(**values: Any) -> Options:
    return parameters.parse(Options, values)


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("resolution", "0.1", 0.1),
        ("resolution", 1, 1.0),
        ("resolution", "1e-3", 1e-3),
        ("count", "7", 7),
        ("count", 7.0, 7),
        ("kind", "png", "png"),
        *(("fast", value, True) for value in (True, "true", "YES", "1", " on ")),
        *(("fast", value, False) for value in (False, "false", "no", "0", "Off")),
        ("name", "a b", "a b"),
        ("name", 5, "5"),
        ("band", "1,2.5", (1.0, 2.5)),
        ("band", [1, 2], (1.0, 2.0)),
        ("band", "", None),
        ("band", None, None),
        ("tags", "a,b", ("a", "b")),
        ("limit", "", None),
        ("limit", "4", 4),
        ("limit", -(2**63), -(2**63)),
    ],
)
def test_valid_values_are_parsed(name: str, value: Any, expected: Any) -> None:
    parsed_value = getattr(parse(**{name: value}), name)
    assert parsed_value == expected
    assert type(parsed_value) is type(expected)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(
            ("resolution", v)
            for v in (
                "",
                "x",
                "nan",
                "inf",
                "-inf",
                "1e999",
                "0",
                "0.0009",
                "101",
                True,
                None,
                [1],
                "1_0",
                "１",
                10**400,
            )
        ),
        *(
            ("count", v)
            for v in ("", "x", "1.5", 1.5, True, None, -1, 11, "1e2", "٣", "1_0", float("nan"), float("inf"), [1])
        ),
        *(("kind", v) for v in ("", "PGM", "bmp", 1, None, ["pgm"])),
        *(("fast", v) for v in ("", "maybe", 2, None)),
        *(("name", v) for v in (None, ["a"], {"a": 1})),
        *(("band", v) for v in ("1", "1,2,3", "a,b", "-11,0", [1], [1, None], 5, {"a": 1})),
        *(("tags", v) for v in (5, {"a": 1}, [None])),
        *(("limit", v) for v in ("x", 1.5, 2**63, 10**400, "9" * 5000)),
        ("height", "1"),
        ("", "1"),
    ],
)
def test_invalid_values_are_rejected(name: str, value: Any) -> None:
    with pytest.raises(Invalid) as error:
        parse(**{name: value})
    (problem,) = error.value.problems
    assert problem.where == name
    assert problem.problem


def test_error_lists_every_problem_with_accepted_values() -> None:
    with pytest.raises(Invalid) as error:
        parse(resolution="x", height="1", count="99")
    assert [p.where for p in error.value.problems] == ["resolution", "height", "count"]
    assert "accepted: resolution, count" in error.value.problems[1].problem
    assert "at most 10" in error.value.problems[2].problem
    with pytest.raises(Invalid, match="unknown option; accepted: none"):
        parameters.parse(type("None_", (), {"__dataclass_fields__": {}}), {"a": "1"}, "option")


def test_missing_values_get_defaults() -> None:
    assert parse() == Options()
    assert parameters.canonical(parse()) == {}
    assert parameters.canonical(None) == {}


def test_canonical_lists_non_default_values_in_fixed_order() -> None:
    options = parse(tags="b,a", count="3", fast="yes", band="0,1")
    assert list(parameters.canonical(options).items()) == [("band", (0.0, 1.0)), ("fast", True), ("tags", ("b", "a"))]


def test_parameters_are_described_as_json_schema() -> None:
    descriptions = {entry["name"]: entry for entry in parameters.describe(Options)}
    assert list(descriptions) == ["resolution", "count", "kind", "fast", "name", "band", "tags", "limit"]
    assert descriptions["resolution"] == {
        "name": "resolution",
        "schema": {"type": "number", "minimum": 1e-3, "maximum": 100.0},
        "default": 0.05,
        "description": "metres a cell [m]",
    }
    assert descriptions["kind"]["schema"] == {"type": "string", "enum": ["pgm", "png"]}
    assert descriptions["fast"]["schema"] == {"type": "boolean"}
    assert descriptions["limit"]["schema"] == {"type": "integer"}
    assert descriptions["band"]["schema"]["type"] == "string"


@given(st.dictionaries(st.sampled_from(["resolution", "count", "band", "limit", "fast"]), st.text()))
def test_any_text_is_parsed_or_rejected(values: dict[str, str]) -> None:
    try:
        options = parameters.parse(Options, values)
    except Invalid:
        return
    assert 1e-3 <= options.resolution <= 100
    assert 0 <= options.count <= 10

"""RON: values equal JSON's, errors name their line, limits hold, and written values read back equal."""

from __future__ import annotations

import string
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.errors import TooLarge, UnreadableFile
from app.formats.rmf.site import vocabulary
from app.limits import Limits
from app.syntax import ron

LIMITS = Limits()


def load(text: str, limits: Limits = LIMITS) -> Any:
    return ron.load(text.encode(), limits)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("()", None),
        ("(a: 1, b: -2.5, c: 1e3,)", {"a": 1, "b": -2.5, "c": 1000.0}),
        ("#![enable(implicit_some)]\n#![enable(unwrap_newtypes)]\n[1, true, None]", [1, True, None]),
        ('{1: "a", "x y": Some(Some(2)), Floor: (0.5, 1)}', {"1": "a", "x y": 2, "Floor": [0.5, 1]}),
        ("Only([3])", {"Only": [3]}),
        ("Rect((width: 2.0))", {"Rect": {"width": 2.0}}),
        ("Both(forward: deg(90.0), backward: rad(1))", {"Both": {"forward": {"deg": 90.0}, "backward": {"rad": 1}}}),
        ("Site(levels: {}, all: All)", {"Site": {"levels": {}, "all": "All"}}),
        ("(100.0)", 100.0),
        ("(7,)", [7]),
        ("(/* a /* nested */ comment */ 1, // to the end\n 2)", [1, 2]),
        (r'"tab\t\u{e9}\x41 \"q\" \\"', 'tab\té' 'A "q" \\'),
        ('r#"raw "text" \\n"#', 'raw "text" \\n'),
        ("['a', '\\n']", ["a", "\n"]),
        ("[0x1F, 0b101, 0o17, 1_000, 5u32, 2.5f32, +3]", [31, 5, 15, 1000, 5, 2.5, 3]),
        ("123456789012345678901", 123456789012345678901.0),
        ("(r#type: 1)", {"type": 1}),
    ],
)  # fmt: skip
def test_ron_values_equal_json_values(text: str, value: Any) -> None:
    assert load(text) == value


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "missing value"),
        ("(\n a: 1\n b: 2)", "line 3: invalid RON: missing ',' before 'b'"),
        ("(a: 1, a: 2)", "duplicate key 'a'"),
        ("[1] 2", "unexpected content after the value"),
        ("[1\n, NaN]", "line 2: invalid RON: the number 'NaN' is not finite"),
        ("-inf", "not finite"),
        ("1e999", "not finite"),
        ('"\\u{d800}"', "invalid character"),
        ('"\\q"', "unknown escape"),
        ('"open', "unexpected"),
        ("/* open", "unterminated comment"),
        ('r##"open"#', "unterminated raw string"),
        ("(a: @)", "unexpected '@"),
        ("{1: }", "missing value before '}'"),
        ("[" * 200 + "]" * 200, "nested deeper than"),
        ("a(" * 200 + ")" * 200, "nested deeper than"),
    ],
)
def test_invalid_ron_is_refused_with_line(text: str, reason: str) -> None:
    with pytest.raises(UnreadableFile) as caught:
        load(text)
    assert reason in caught.value.detail
    assert caught.value.problems[0].line


def test_size_and_value_count_are_limited() -> None:
    with pytest.raises(TooLarge):
        load("[1, 2]", Limits(text_bytes=3))
    with pytest.raises(TooLarge):
        load("[1, 2, 3]", Limits(yaml_nodes=3))


NAMES = st.one_of(
    st.sampled_from(["trans", "anchors", "graphs", "tags", "CategorizedTranslate2D", "extensions", "Only", "deg", "7"]),
    st.text(st.sampled_from(string.ascii_letters + '_- "é\\'), min_size=1, max_size=6),
)
SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(-(2**63), 2**63 - 1),
    st.floats(allow_nan=False, allow_infinity=False),
    st.text(max_size=8),
    st.sampled_from(["All", "Charger", "Left", "Some", "None", "true"]),
)
VALUES = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(NAMES, inner, max_size=4), max_leaves=12
)


@given(VALUES)
def test_written_ron_reads_back_equal(value: Any) -> None:
    assert ron.load(ron.dump(value, vocabulary.SHAPE), LIMITS) == value

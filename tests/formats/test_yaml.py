"""YAML: meaning of scalars, refusals with their lines, and agreement of the fast reader with libyaml."""

from __future__ import annotations

import time
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from typing import Any

import orjson
import pytest
import ryml
import yaml as pyyaml
from hypothesis import example, given
from hypothesis import strategies as st

from app.errors import BadUpload, TooLarge, UnreadableFile
from app.formats.rmf.common import Flow
from app.limits import Limits
from app.syntax import yaml
from app.syntax.yaml.events import load_events
from app.syntax.yaml.lines import NotSimpleError, load_lines

LIMITS = Limits()


def load(text: str | bytes) -> Any:
    return yaml.load(text.encode() if isinstance(text, str) else text, LIMITS)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1", 1),
        ("-7", -7),
        ("+3", 3),
        ("0", 0),
        ("1.5", 1.5),
        ("1.", 1.0),
        (".5", 0.5),
        ("-.5", -0.5),
        ("1.0e-05", 1e-05),
        ("1e-05", 1e-05),
        ("1.5e3", 1500.0),
        ("1e+16", 1e16),
        ("7e12", "7e12"),
        ("0x1F", 31),
        ("9223372036854775807", 2**63 - 1),
        ("-9223372036854775808", -(2**63)),
        ("08", "08"),
        ("010", "010"),
        ("0o17", "0o17"),
        ("0b11", "0b11"),
        ("1_2", "1_2"),
        ("12:30", "12:30"),
        ("190:20:30", "190:20:30"),
        ("2022-06-23", "2022-06-23"),
        ("2022-06-23_13-10-11", "2022-06-23_13-10-11"),
        ("2001-12-14t21:59:43.10-05:00", "2001-12-14t21:59:43.10-05:00"),
        ("yes", True),
        ("True", True),
        ("OFF", False),
        ("no", False),
        ("y", "y"),
        ("tRUE", "tRUE"),
        ("~", None),
        ("null", None),
        ("", None),
        ("''", ""),
        ("'True'", "True"),
        ('"1"', "1"),
        ("'it''s'", "it's"),
        ('"a\\u00e9\\n"', "aé\n"),
        ("!!str 1", "1"),
        ("!!float 1", 1.0),
        ("!!int 7", 7),
        ("! 1", "1"),
        ("nan", "nan"),
        ("=", "="),
        ("robot_short | robot_hunter", "robot_short | robot_hunter"),
        ("[1, [2, {a: b}], 'c']", [1, [2, {"a": "b"}], "c"]),
    ],
)
def test_scalar_text_gives_expected_value(text: str, value: Any) -> None:
    read = load(f"key: {text}\n")
    assert read == {"key": value}
    assert type(read["key"]) is type(value)


def test_keys_are_texts_as_written() -> None:
    assert load("0: a\nyes: b\n2022-01-01: c\n~: d\n'<<': e\n1.50: f\n") == {
        "0": "a", "yes": "b", "2022-01-01": "c", "~": "d", "<<": "e", "1.50": "f",
    }  # fmt: skip


def test_aliases_and_byte_order_mark_are_read() -> None:
    text = "\ufeffa: &a [1, 2]\nb: *a\nc: &t text\nd: {e: *t}\nf: &a 3\ng: *a\n"
    assert load(text) == {"a": [1, 2], "b": [1, 2], "c": "text", "d": {"e": "text"}, "f": 3, "g": 3}


def test_windows_line_endings_are_read() -> None:
    assert load("a:\r\n- b: 1\r\n  c: x y\r\n") == {"a": [{"b": 1, "c": "x y"}]}


@pytest.mark.parametrize(
    ("text", "line", "part"),
    [
        ("a: 1\nb: .nan\n", 2, "finite"),
        ("a: -.inf\n", 1, "finite"),
        ("a: 1.0e+999\n", 1, "range"),
        ("a: 9223372036854775808\n", 1, "64 bit"),
        ("a: 0xFFFFFFFFFFFFFFFFF\n", 1, "64 bit"),
        ("a:\n- " + "9" * 5000 + "\n", 2, "characters"),
        ("a: 1\nb: 2\na: 3\n", 3, "duplicate key"),
        ("a: {b: 1, b: 2}\n", 1, "duplicate key"),
        ("a: 1\n1: x\n'1': y\n", 3, "duplicate key"),
        ("a: &a {b: 1}\nc:\n  <<: *a\n", 3, "merge"),
        ("a: 1\n---\nb: 1\n", 2, "only one document"),
        ("a: !!python/object/apply:os.system [ls]\n", 1, "tag"),
        ("a: !!python/name:os.system\n", 1, "tag"),
        ("a: !foo b\n", 1, "tag"),
        ("a: !!binary aGk=\n", 1, "tag"),
        ("a: !!timestamp 2001-01-01\n", 1, "tag"),
        ("a: !!int 010\n", 1, "tag"),
        ("a: !!int yes\n", 1, "tag"),
        ("!!set {a}\n", 1, "tag"),
        ("%TAG !e! tag:example.org,2000:\n--- \na: !e!b c\n", 1, "%TAG"),
        ("a: *b\n", 1, "anchor"),
        ("a: &a [*a]\n", 1, "inside"),
        ("a: &a\n  b: *a\n", 2, "inside"),
        ("[1]: 2\n", 1, "collection"),
        ("? {a: b}\n: 2\n", 1, "collection"),
        ("a:\n\t- b\n", 2, "character"),
        ("a: b: c\n", 1, "not allowed"),
        ("a: [1, 2\n", 2, "flow"),
        ("a: 'b\n", 2, "scalar"),
        ('a: "\\ud800"\n', 1, "Unicode"),
        ("a: 1\n  b: 2\n", 2, "not allowed"),
    ],
)
def test_invalid_yaml_is_refused_with_line(text: str, line: int, part: str) -> None:
    with pytest.raises(UnreadableFile, match=part) as caught:
        load(text)
    assert caught.value.problems[0].line == line
    assert part in caught.value.problems[0].problem


def test_invalid_utf8_is_refused() -> None:
    with pytest.raises(UnreadableFile, match="UTF-8") as caught:
        load(b"a: 1\nb: \xff\n")
    assert caught.value.problems[0].line == 2
    with pytest.raises(UnreadableFile, match="control characters"):
        load(b"a: \x00\n")
    with pytest.raises(UnreadableFile):
        load(b"a: \xed\xa0\x80\n")  # a lone surrogate
    with pytest.raises(UnreadableFile):
        load("a: 1".encode("utf-16"))


@pytest.mark.parametrize("opening", ["[", "{", "{a: ", "- ", "? ", "[a, ", "[{a: ", "&a [", "!!seq ["])
def test_deep_nesting_is_refused_at_once(opening: str) -> None:
    began = time.process_time()
    with pytest.raises(UnreadableFile):
        load(opening * 60_000)
    assert time.process_time() - began < 20


def test_deep_block_nesting_ends_at_the_limit() -> None:
    def nested(depth: int) -> str:
        return "".join(f"{' ' * k}a:\n" for k in range(depth))

    assert load(nested(LIMITS.yaml_depth)) is not None
    with pytest.raises(UnreadableFile, match="48 levels") as caught:
        load(nested(LIMITS.yaml_depth + 1))
    assert caught.value.problems[0].line is not None


def test_alias_bomb_is_refused_before_expansion() -> None:
    names = "abcdefghij"
    flow = "a: &a [" + ", ".join(["lol"] * 9) + "]\n"
    block = "a: &a\n" + "- lol\n" * 9
    for before, name in pairwise(names):
        flow += f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]\n"
        block += f"{name}: &{name}\n" + f"- *{before}\n" * 9
    for bomb in (flow, block):
        with pytest.raises(TooLarge, match="expand"):
            load(bomb)


def test_long_text_repeated_by_aliases_is_refused() -> None:
    for text in (f"a: &a {'x' * 100_000}\nb:\n", f"a: &a\n- {'x' * 100_000}\nb:\n"):
        with pytest.raises(TooLarge, match="expand"):
            load(text + "- *a\n" * 1000)


@pytest.mark.parametrize(
    "filling", [" ", "a", "a ", "'", "''", '"', "- ", "-", "[]", "a: ", "a:", "#", "~", "1", "é", "\\", "&a "]
)
@pytest.mark.parametrize("start", ["", "a: ", "- ", "a: '", 'a: "'])
def test_long_lines_take_linear_time(start: str, filling: str) -> None:
    text = start + filling * (200_000 // len(filling)) + "@"
    began = time.process_time()
    with suppress(BadUpload):
        load(text)
    assert time.process_time() - began < 20


def test_limits_on_nodes_and_bytes() -> None:
    with pytest.raises(TooLarge, match="nodes") as caught:
        yaml.load(b"a:\n" + b"- 1\n" * 100, Limits(yaml_nodes=50))
    assert caught.value.problems[0].line == 49  # a mapping, its key, a list and 48 items
    with pytest.raises(TooLarge, match="bytes"):
        yaml.load(b"a: 1\n" * 100, Limits(text_bytes=50))


def quick(text: str) -> Any:
    """Return the fast parser's result, or its mark that the reference parser is needed."""
    try:
        return load_lines(text, LIMITS)
    except NotSimpleError:
        return NotImplemented


def test_fast_and_full_parsers_agree_on_real_files(shared: Path) -> None:
    paths = [p for end in ("*.yaml", "*.tmap2", "*.tmap", ".*.tmap2") for p in (shared / "data").rglob(end)]
    assert len(paths) > 50
    simple = set()
    for path in paths:
        text = path.read_text()
        if path.parts[-3] == "navgraph":
            with pytest.raises(UnreadableFile, match="%TAG"):  # Fawkes' own tags
                load_events(text, LIMITS)
            continue
        reference = load_events(text, LIMITS)
        assert reference == pyyaml.load(text, pyyaml.CSafeLoader) or "graphs" in text, path
        value = quick(text)
        if value is not NotImplemented:
            simple.add(path.name)
            assert value == reference, path
            assert orjson.dumps(value) == orjson.dumps(reference), path  # also 1 and 1.0, True and 1
    assert {
        "network.tmap2.yaml",
        "network_autogen.tmap2.yaml",
        "poi.tmap2.yaml",
        "tmap.tmap",
        ".network.tmap2",
    } <= simple


WORDS = [
    "a", "b c", "1", "1.5", "-0.25", "- 1", "-", "--- ", "...", "x:", "y: 1", "k: &n", "*n", "&n", "&n 1", "[]", "{}",
    "[1, 2]", "'q'", "'it''s'", "'a: b'", '"d"', '"e\\n"', "yes", "~", "null", "08", "1e-05", "7e12", ".5", "# c",
    "a # c", "a#c", "é: ü", "a : b", "'k': v", "? x", ": y", "| ", "> ", "!!str 1", "<<: a", "k: a: b", "http://x",
    "12:30", "k: 'x' y", "a\u2028b", "\u00a0", "k:  2 ", "a,b", "$n.p", "(x)", "-x", "+1", ".nan", "@", "`", "%",
    "a\tb",
]  # fmt: skip
line = st.tuples(
    st.integers(0, 6), st.sampled_from(["", "", "- ", "-  ", "- - "]), st.lists(st.sampled_from(WORDS), max_size=2),
    st.sampled_from(["", ": ", ":", " "]),
)  # fmt: skip


@given(st.lists(line, max_size=9), st.sampled_from(["\n", "\n", "\r\n"]))
@example([(0, "", ["k: &n"], ""), (0, "- ", ["a"], ""), (0, "", ["b"], ": "), (0, "- ", ["*n"], "")], "\n")
@example([(0, "", ["a", "1"], ": "), (2, "", ["b c"], "")], "\n")
def test_fast_and_full_parsers_agree_on_fast_syntax(rows: list[Any], end: str) -> None:
    text = end.join(" " * indent + dash + glue.join(words) for indent, dash, words, glue in rows)
    value = quick(text)
    if value is not NotImplemented:
        assert orjson.dumps(value) == orjson.dumps(load_events(text, LIMITS)), text


FLOWING = [
    "[", "]", "{", "}", ", ", ", ", ": ", ",", ":", "a", "b c", "1", "-2.5", "08", "1e-05", "yes", "~", "''", "'it''s'",
    "'a, b'", '"d: e"', '"e\\n"', "it's", "a:b", "k: ", "'k': ", "-", "- 1", "?", "#", " #c", "&n ", "*n", "!!str 1",
    "<<: ", "é", " ", "{a: 1}", "[1, 2]", "[1, 2, {a: [4, true]}]", "{a: 1, b: [2, x]}", "[]", "{}", "%", "a\tb",
]  # fmt: skip


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["", "  "]),
            st.sampled_from(["- ", "- ", "k: ", "m: ", "- k: ", "- [1, 2.5, ", "- [0, -0, "]),
            st.lists(st.sampled_from(FLOWING), max_size=7),
        ),
        min_size=1,
        max_size=4,
    ),
)
@example([("", "- ", ["[1, 2, {a: [4, true]}]"])] * 2)
@example([("", "- [1, 2.5, ", ["1", ", ", "yes", "]"]), ("", "- [1, 2.5, ", ["08", ", ", "''", "]"])])
def test_fast_and_full_parsers_agree_on_flow_collections(rows: list[Any]) -> None:
    text = "\n".join(indent + start + "".join(words) for indent, start, words in rows)
    value = quick(text)
    if value is not NotImplemented:
        assert orjson.dumps(value) == orjson.dumps(load_events(text, LIMITS)), text


floats = st.floats(allow_nan=False, allow_infinity=False)
flowing = st.recursive(
    st.none() | st.booleans() | st.integers(-99, 99) | floats | st.text("a1b -'", max_size=5),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text("ab ", min_size=1, max_size=3), inner, max_size=3)
    ),
    max_leaves=8,
)


@given(st.lists(st.lists(flowing, min_size=1, max_size=5), min_size=1, max_size=5))
def test_flow_rows_use_fast_parser(rows: list[Any]) -> None:
    text = "rows:\n" + "".join(f"  - {Flow()(row)}\n" for row in rows)
    reference = load_events(text, LIMITS)
    assert orjson.dumps(reference) == orjson.dumps({"rows": rows}, option=orjson.OPT_SORT_KEYS)
    value = quick(text)
    assert value is not NotImplemented, text
    assert orjson.dumps(value) == orjson.dumps(reference), text


def test_limits_hold_for_collections_in_flow_style() -> None:
    rows = b"- [1, 2, {a: [4, true], b: [1, '']}]\n" * 10  # 12 nodes a row
    assert len(yaml.load(rows, Limits(yaml_nodes=121))) == 10
    with pytest.raises(TooLarge, match="nodes") as caught:
        yaml.load(rows, Limits(yaml_nodes=110))
    assert caught.value.problems[0].line == 10
    with pytest.raises(UnreadableFile, match="nested deeper"):
        yaml.load(b"a:\n" + rows, Limits(yaml_depth=4))
    with pytest.raises(UnreadableFile, match="nested deeper"):
        load("a: " + "[" * 60 + "]" * 60)
    assert yaml.load(b"a:\n" + rows, Limits(yaml_depth=5))["a"][9] == [1, 2, {"a": [4, True], "b": [1, ""]}]


@given(st.text("ab1.-: \n'\"#[]{}&*!|>~é", max_size=60))
def test_fast_and_full_parsers_agree_on_any_text(text: str) -> None:
    value = quick(text)
    if value is not NotImplemented:
        assert orjson.dumps(value) == orjson.dumps(load_events(text, LIMITS)), text


@given(st.binary(max_size=200))
def test_any_bytes_are_read_or_refused(data: bytes) -> None:
    try:
        value = load(data)
    except BadUpload:
        return
    orjson.dumps(value)


texts = st.text(st.characters(exclude_categories=["Cs"]), max_size=12) | st.sampled_from(
    [
        "no", "y", "Null", "~", "1", "010", "1e5", "a: b", "- a", "#x", " a", "a ", "", "!x", "&x", "*x", "%x", "'",
        '"', "\n", "a\nb", "<<", "=", "2022-01-01", "\u2028", "\ufeff", "\x85", "1_0", "0x1F", "[a", "{a", "é",
        "x" * 1100, "a #b", "a:", ".nan", "-", "---", "...", "?", "k" * 250, "robot | tall", "$node.pose", "a/b.c",
        "(x)", "a - b",
    ]
)  # fmt: skip
values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False, allow_infinity=False)
    | texts,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(texts, inner, max_size=4),
    max_leaves=15,
)


@given(st.dictionaries(texts, values, min_size=1, max_size=5))
def test_written_yaml_reads_back_equal_also_in_pyyaml(value: dict[str, Any]) -> None:
    text = yaml.mapping(value, 0)
    assert orjson.dumps(load(text), option=orjson.OPT_SORT_KEYS) == orjson.dumps(value, option=orjson.OPT_SORT_KEYS)
    assert pyyaml.load(text, pyyaml.loader.SafeLoader) == value  # in Python: it shares nothing with ours
    assert yaml.mapping(dict(reversed(value.items())), 0) == text


@given(st.dictionaries(texts, values, min_size=1, max_size=5), st.randoms(use_true_random=False))
def test_fast_and_full_parsers_agree_on_damaged_documents(value: dict[str, Any], random: Any) -> None:
    lines = yaml.mapping(value, 0).split("\n")
    for _ in range(random.randrange(4)):
        k = random.randrange(len(lines))
        change = random.randrange(6)
        if change == 0:
            del lines[k]
        elif change == 1:
            lines.insert(k, random.choice(lines or [""]))
        elif change == 2:
            lines[k] = " " * random.randrange(1, 4) + lines[k]
        elif change == 3:
            lines[k] = lines[k][random.randrange(1, 4) :]
        elif change == 4:
            lines[k] += random.choice([" ", " # c", ":", " x", " *a", " &a", " []"])
        else:
            lines.insert(k, random.choice(["", "  ", "# c", "   # c: d", "a: &a", "- *a", "  b: *a"]))
        lines = lines or [""]
    text = "\n".join(lines)
    taken = quick(text)
    if taken is not NotImplemented:
        assert orjson.dumps(taken) == orjson.dumps(load_events(text, LIMITS)), text


plain = st.text(st.characters(categories=["L", "N", "P", "Zs"], max_codepoint=0x2000), max_size=12).filter(
    # rapidyaml's JSON writes these as .inf and .nan even where YAML has them in quotes.
    lambda text: text.lower().lstrip("+-.") not in ("inf", "infinity", "nan")
)


@given(
    st.dictionaries(plain, plain | st.booleans() | st.integers(-1000, 1000) | st.lists(plain, max_size=3), min_size=1)
)
def test_written_yaml_is_equal_in_yaml_1_2(value: dict[str, Any]) -> None:
    tree = ryml.parse_in_arena(yaml.mapping(value, 0).encode())
    assert orjson.loads(ryml.emit_json(tree)) == value

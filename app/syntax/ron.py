"""Read RON (Rusty Object Notation) as JSON values, and write it.

Reading: structs and maps become mappings with string keys, sequences and tuples lists, ``Some(v)`` v, ``None`` and
``()`` None, a unit variant its name, ``Variant(v)`` and named structs ``{"Variant": v}``; one value in parentheses
without a comma (a newtype) becomes the value itself. So a site saved as RON reads as its JSON.

Writing needs a ``Shape`` for information that JSON lacks: which lists are tuples, which strings are variants. The file
begins with the extensions that allow options and newtypes without ``Some`` and parentheses.

Source: ron-rs/ron, docs/grammar.md and docs/extensions.md.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NoReturn

from app.errors import Problem, TooLarge, UnreadableFile
from app.limits import Limits

MAX_DEPTH = 96
"""Maximum nesting of values; sites have about fifteen levels."""

EXTENSIONS = "#![enable(implicit_some, unwrap_newtypes)]"

_TOKEN = re.compile(
    r"(?P<space>[ \t\r\n]+|//[^\n]*)"
    r"|(?P<comment>/\*)"
    r"|(?P<raw>b?r(?P<hashes>#{0,255})\")"
    r"|(?P<text>b?\"(?:[^\"\\]|\\.)*\")"
    r"|(?P<character>b?'(?:[^'\\\n]|\\[^\n]+?)')"
    r"|(?P<number>[-+]?(?:0[xX][0-9a-fA-F_]+|0[bB][01_]+|0[oO][0-7_]+|(?:[0-9][0-9_]*(?:\.[0-9_]*)?|\.[0-9][0-9_]*)"
    r"(?:[eE][-+]?[0-9_]+)?)(?:[iu](?:8|16|32|64|128)|f32|f64)?|[-+](?:inf|NaN))"
    r"|(?P<word>r#[A-Za-z0-9_.+-]+|[^\W\d]\w*)"
    r"|(?P<mark>[()\[\]{},:])",
    re.DOTALL,
)
_ATTRIBUTE = re.compile(r"#!\[\s*enable\s*\(([^()\[\]]*)\)\s*\]")
_COMMENT = re.compile(r"/\*|\*/")
_FIELD = re.compile(r"(?:\s|//[^\n]*\n)*:")
_SUFFIX = re.compile(r"(?:[iu](?:8|16|32|64|128)|f32|f64)$")
_ESCAPE = re.compile(r"\\(?:u\{([0-9a-fA-F]{1,6})\}|x([0-9a-fA-F]{2})|(\r?\n\s*)|(.))", re.DOTALL)
_PLAIN = {"n": "\n", "r": "\r", "t": "\t", "0": "\0", "\\": "\\", '"': '"', "'": "'"}
_IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_CLOSING = {"(": ")", "[": "]", "{": "}"}
_WORDS: Mapping[str, Any] = {"true": True, "false": False, "None": None}


# --- reading ---------------------------------------------------------------------------------------------------------


def load(data: bytes, limits: Limits) -> Any:
    """Parse RON. Raises UnreadableFile with the line, or TooLarge."""
    if len(data) > limits.text_bytes:
        raise TooLarge(f"the file has {len(data)} bytes; the limit for a text is {limits.text_bytes}")
    return _Parser(data.removeprefix(b"\xef\xbb\xbf").decode("utf-8"), limits).document()


class _Parser:
    """Recursive descent parser with one token of lookahead."""

    def __init__(self, text: str, limits: Limits) -> None:
        self._text, self._limits = text, limits
        self._at, self._left = 0, limits.yaml_nodes
        self._kind, self._value, self._start = "", "", 0

    def document(self) -> Any:
        """Parse the only value of the text."""
        self._space()
        while match := _ATTRIBUTE.match(self._text, self._at):
            self._at = match.end()
            self._space()
        self._next()
        out = self._parse_value(0)
        if self._kind != "end":
            self._fail("unexpected content after the value")
        return out

    def _fail(self, reason: str) -> NoReturn:
        line = self._text.count("\n", 0, self._start) + 1
        problem = f"invalid RON: {reason}"
        raise UnreadableFile(f"line {line}: {problem}", [Problem(problem, line=line)])

    def _space(self) -> None:
        """Skip white space and comments; block comments may be nested."""
        while (match := _TOKEN.match(self._text, self._at)) and match.lastgroup in ("space", "comment"):
            self._at = match.end()
            if match.lastgroup == "comment":
                self._start, depth = match.start(), 1
                for mark in _COMMENT.finditer(self._text, self._at):
                    depth += 1 if mark.group() == "/*" else -1
                    if not depth:
                        self._at = mark.end()
                        break
                else:
                    self._fail("unterminated comment")

    def _next(self) -> None:
        self._space()
        self._start = self._at
        if self._at >= len(self._text):
            self._kind, self._value = "end", ""
            return
        match = _TOKEN.match(self._text, self._at)
        if match is None:
            self._fail(f"unexpected {self._text[self._at : self._at + 20]!r}")
        self._kind, self._value, self._at = str(match.lastgroup), match.group(), match.end()
        if match["raw"] is not None:
            closing = '"' + match["hashes"]
            end = self._text.find(closing, self._at)
            if end < 0:
                self._fail("unterminated raw string")
            self._kind, self._value, self._at = "raw", self._text[self._at : end], end + len(closing)

    def _is(self, mark: str) -> bool:
        return self._kind == "mark" and self._value == mark

    def _expect(self, mark: str) -> None:
        if not self._is(mark):
            self._fail(f"missing {mark!r} before {self._value[:20]!r}" if self._value else f"missing {mark!r}")
        self._next()

    def _parse_value(self, depth: int) -> Any:
        """Parse one value."""
        self._left -= 1
        if depth > MAX_DEPTH:
            self._fail(f"nested deeper than {MAX_DEPTH} levels")
        if self._left < 0:
            raise TooLarge(f"the file has more than {self._limits.yaml_nodes} values")
        if self._kind == "mark" and self._value in _CLOSING:
            read = {"(": self._brackets, "[": self._sequence, "{": self._map}[self._value]
            return read(depth)
        if self._kind == "word":
            return self._parse_word(depth)
        return self._scalar()

    def _scalar(self) -> Any:
        kind, value = self._kind, self._value
        if kind in ("text", "character", "raw"):
            out: Any = value if kind == "raw" else self._unescape(value)
        elif kind == "number":
            out = self._number(value)
        else:
            self._fail("missing value" if kind == "end" else f"missing value before {value[:20]!r}")
        self._next()
        return out

    def _number(self, literal: str) -> int | float:
        bare = literal if literal[:3].lower().lstrip("+-").startswith("0x") else _SUFFIX.sub("", literal)
        bare = bare.replace("_", "")
        try:
            out: int | float = int(bare, 0) if re.fullmatch(r"[-+]?(?:0[xXbBoO].+|\d{1,20})", bare) else float(bare)
        except ValueError:
            try:
                out = int(bare, 10)
            except ValueError:
                self._fail(f"invalid number {literal[:40]!r}")
        if not math.isfinite(out):
            self._fail(f"the number {literal[:40]!r} is not finite")
        return float(out) if isinstance(out, int) and not -(2**63) <= out < 2**63 else out

    def _unescape(self, literal: str) -> str:
        literal = literal.removeprefix("b")[1:-1]
        if "\\" not in literal:
            return literal

        def one(match: re.Match[str]) -> str:
            code = match[1] or match[2]
            if code is not None:
                point = int(code, 16)
                if point > 0x10FFFF or 0xD800 <= point <= 0xDFFF:
                    self._fail(f"invalid character {match.group()!r}")
                return chr(point)
            if match[3] is not None:
                return ""
            if match[4] not in _PLAIN:
                self._fail(f"unknown escape {match.group()!r}")
            return _PLAIN[match[4]]

        return _ESCAPE.sub(one, literal)

    def _parse_word(self, depth: int) -> Any:
        """Parse a keyword, or a variant or named struct with its content."""
        name = self._value.removeprefix("r#")
        if name in ("inf", "NaN", "inff32", "inff64"):
            self._fail(f"the number {name!r} is not finite")
        self._next()
        if not self._is("("):
            return _WORDS.get(name, name)
        content = self._brackets(depth)
        return content if name == "Some" else {name: content}

    def _brackets(self, depth: int) -> Any:
        """Parse a struct, a tuple, a newtype or a unit."""
        self._expect("(")
        if self._is(")"):
            self._next()
            return None
        if self._kind == "word" and _FIELD.match(self._text, self._at):
            return self._pairs(depth, ")")
        out = [self._parse_value(depth + 1)]
        if self._is(")"):
            self._next()
            return out[0]
        while not self._is(")"):
            self._expect(",")
            if not self._is(")"):
                out.append(self._parse_value(depth + 1))
        self._next()
        return out

    def _sequence(self, depth: int) -> list[Any]:
        self._expect("[")
        out: list[Any] = []
        while not self._is("]"):
            out.append(self._parse_value(depth + 1))
            if not self._is("]"):
                self._expect(",")
        self._next()
        return out

    def _map(self, depth: int) -> dict[str, Any]:
        self._expect("{")
        return self._pairs(depth, "}")

    def _pairs(self, depth: int, closing: str) -> dict[str, Any]:
        out: dict[str, Any] = {}
        while not self._is(closing):
            start = self._start
            key = self._key()
            if key in out:
                self._start = start
                self._fail(f"duplicate key {key[:60]!r}")
            self._expect(":")
            out[key] = self._parse_value(depth + 1)
            if not self._is(closing):
                self._expect(",")
        self._next()
        return out

    def _key(self) -> str:
        if self._kind == "word":
            name = self._value.removeprefix("r#")
            self._next()
            return name
        key = self._scalar()
        return key if isinstance(key, str) else str(key)


# --- writing ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Shape:
    """Type information of a schema that JSON values lack.

    tuples: names of members whose lists have a fixed length. variants: names of enum variants with a value. units:
    member -> its strings that are variants, also in lists. maps: members whose mapping has variants as keys. free:
    member -> number of mappings below which all is plain JSON.
    """

    tuples: frozenset[str]
    variants: frozenset[str]
    units: Mapping[str, frozenset[str]]
    maps: frozenset[str]
    free: Mapping[str, int]


def dump(value: Any, shape: Shape) -> bytes:
    """Format a value as RON that ``load`` reads as the same value, indented by two spaces."""
    return (f"{EXTENSIONS}\n" + "".join(_written(value, "", shape, 0, None)) + "\n").encode()


def _written(value: Any, member: str, shape: Shape, depth: int, left: int | None) -> Iterator[str]:
    """Yield the pieces of one value. member: its name. left: mappings until all is plain JSON; None: never."""
    in_shape = left != 0
    if isinstance(value, dict):
        yield from _mapping(value, member, shape, depth, shape.free.get(member) if left is None else left)
    elif isinstance(value, (list, tuple)):
        as_tuple = in_shape and member in shape.tuples and len(value) > 1
        yield "(" if as_tuple else "["
        for k, item in enumerate(value):
            yield ", " if k else ""
            yield from _written(item, member, shape, depth, left)
        yield ")" if as_tuple else "]"
    elif in_shape and isinstance(value, str) and value in shape.units.get(member, ()):
        yield value
    else:
        yield _scalar(value)


def _mapping(value: Mapping[str, Any], member: str, shape: Shape, depth: int, left: int | None) -> Iterator[str]:
    in_shape = left != 0
    if in_shape and len(value) == 1 and (name := next(iter(value))) in shape.variants:
        yield f"{name}("
        yield from _written(value[name], name, shape, depth, left)
        yield ")"
        return
    named = in_shape and bool(value) and all(_IDENTIFIER.fullmatch(k) and k not in _WORDS for k in value)
    struct = named and member not in shape.maps
    begin = "\n" + "  " * (depth + 1)
    yield "(" if struct else "{"
    for key, item in value.items():
        yield f"{begin}{key if named or (in_shape and _WHOLE.fullmatch(key)) else _scalar(key)}: "
        yield from _written(item, key, shape, depth + 1, left - 1 if left else left)
        yield ","
    if value:
        yield "\n" + "  " * depth
    yield ")" if struct else "}"


_WHOLE = re.compile(r"0|[1-9][0-9]{0,9}")
_ESCAPED = {'"': '\\"', "\\": "\\\\", "\n": "\\n", "\r": "\\r", "\t": "\\t"}


def _character(c: str) -> str:
    return _ESCAPED.get(c) or (c if c >= " " and c != "\x7f" else f"\\u{{{ord(c):x}}}")


def _scalar(value: Any) -> str:
    if value is None:
        return "None"
    if isinstance(value, bool):
        return "true" if value else "false"
    return '"' + "".join(map(_character, value)) + '"' if isinstance(value, str) else repr(value)

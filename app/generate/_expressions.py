"""Expressions in rules that people write: numbers, names, arithmetic and comparisons, and nothing else.

A small grammar of its own instead of Python's ``eval``: an expression reads numbers and cannot reach anything. It is
computed with IEEE's exactly rounded operations only (no exponential, no sine), so that it gives the same number on
every machine.

    or:       and { "|" and }
    and:      not { "&" not }
    not:      "!" not | compared
    compared: sum [ ("<" | "<=" | ">" | ">=" | "==" | "!=") sum ]
    sum:      product { ("+" | "-") product }
    product:  signed { ("*" | "/" | "%") signed }
    signed:   "-" signed | power
    power:    primary [ "^" whole number up to 16 ]
    primary:  number | name | name "(" or { "," or } ")" | "(" or ")"

Functions: ``min``, ``max`` (two or more), ``abs``, ``sqrt``, ``floor``, ``round`` and ``rand(low, high)``, a number
drawn evenly. True is 1, false 0; everything but 0 counts as true.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import NoReturn

import numpy as np

from app.errors import CannotGenerate, Invalid, Problem

MAX_DEPTH = 32
"""Parentheses and operators within each other."""

MAX_TOKENS = 400
"""Tokens of one expression."""

MAX_NUMBER = 1e9
"""Maximum absolute value of a number: larger ones come from a typing error or from a rule that grows without end."""

_TOKEN = re.compile(
    r"\s*(?:(?P<number>\d+\.?\d*(?:[eE][+-]?\d{1,3})?|\.\d+)|(?P<name>[A-Za-z_][A-Za-z0-9_]*)"
    r"|(?P<sign><=|>=|==|!=|[-+*/%^()<>,&|!]))"
)

Value = Callable[[Mapping[str, float], np.random.Generator], float]
"""(values of the names, chance) -> the number. Raises ArithmeticError or ValueError."""


@dataclass(frozen=True, slots=True)
class Expression:
    """A parsed expression. text: as it was written; location: the place it is named by in problems."""

    text: str
    location: str
    value: Value

    def __call__(self, names: Mapping[str, float], chance: np.random.Generator) -> float:
        """The number, finite and at most 1e9. CannotGenerate names the expression otherwise."""
        try:
            value = self.value(names, chance)
        except (ArithmeticError, ValueError) as error:
            self._stop(str(error))
        if not abs(value) <= MAX_NUMBER:
            self._stop(f"{value:g} exceeds ±{MAX_NUMBER:g}")
        return value

    def _stop(self, reason: str) -> NoReturn:
        problem = f"{self.text.strip()!r} cannot be computed: {reason}"
        raise CannotGenerate(f"{self.location}: {problem}", [Problem(problem, where=self.location)])


def raise_invalid(problem: str, location: str) -> NoReturn:
    """Raise Invalid that names the place in the rules."""
    raise Invalid(f"{location}: {problem}", [Problem(problem, where=location)])


def parse(text: str, names: frozenset[str] | set[str], location: str) -> Expression:
    """Parse an expression. Raises Invalid with ``location`` for a syntax error or an unknown name."""
    parser = _Parser(_tokens(text, location), names, location)
    value = parser.either(0)
    if parser.peek():
        raise_invalid(f"unexpected {parser.peek()!r} after the expression in {text.strip()!r}", location)
    return Expression(text, location, value)


def _tokens(text: str, location: str) -> list[str]:
    out: list[str] = []
    at = 0
    end = len(text.rstrip())
    while at < end:
        match = _TOKEN.match(text, at)
        if match is None:
            raise_invalid(f"{text[at:].strip()[:20]!r} is not part of an expression", location)
        out.append(match.group().strip())
        at = match.end()
        if len(out) > MAX_TOKENS:
            raise_invalid(f"the expression has more than {MAX_TOKENS} numbers, names and signs", location)
    if not out:
        raise_invalid("missing expression", location)
    return out


_COMPARED: Mapping[str, Callable[[float, float], bool]] = {
    "<": lambda a, b: a < b,
    "<=": lambda a, b: a <= b,
    ">": lambda a, b: a > b,
    ">=": lambda a, b: a >= b,
    "==": lambda a, b: a == b,
    "!=": lambda a, b: a != b,
}

_ARITHMETIC: Mapping[str, Callable[[float, float], float]] = {
    "+": lambda a, b: a + b,
    "-": lambda a, b: a - b,
    "*": lambda a, b: a * b,
    "/": lambda a, b: a / b,
    "%": lambda a, b: a - math.floor(a / b) * b,
}

_FUNCTIONS: Mapping[str, tuple[int, int]] = {
    "min": (2, 16),
    "max": (2, 16),
    "abs": (1, 1),
    "sqrt": (1, 1),
    "floor": (1, 1),
    "round": (1, 1),
    "rand": (2, 2),
}

_SIMPLE: Mapping[str, Callable[[list[float]], float]] = {
    "min": min,
    "max": max,
    "abs": lambda v: abs(v[0]),
    "sqrt": lambda v: math.sqrt(v[0]),
    "floor": lambda v: float(math.floor(v[0])),
    "round": lambda v: float(math.floor(v[0] + 0.5)),
}


class _Parser:
    """Recursive descent, its depth bounded."""

    def __init__(self, tokens: list[str], names: frozenset[str] | set[str], location: str) -> None:
        self.tokens, self.names, self.where = tokens, names, location
        self.at = 0

    def peek(self) -> str:
        """The next token, or "" at the end."""
        return self.tokens[self.at] if self.at < len(self.tokens) else ""

    def next_token(self) -> str:
        token = self.peek()
        self.at += 1
        return token

    def _series(self, depth: int, signs: tuple[str, ...], inner: Callable[[int], Value]) -> Iterator[tuple[str, Value]]:
        yield "", inner(depth)
        while self.peek() in signs:
            yield self.next_token(), inner(depth)

    def either(self, depth: int) -> Value:
        """Alternatives, the loosest binding."""
        if depth > MAX_DEPTH:
            raise_invalid(f"the expression is nested deeper than {MAX_DEPTH} levels", self.where)
        terms = [value for _, value in self._series(depth + 1, ("|",), self._both)]
        return terms[0] if len(terms) == 1 else lambda n, c: float(any(v(n, c) != 0 for v in terms))

    def _both(self, depth: int) -> Value:
        terms = [value for _, value in self._series(depth, ("&",), self._not)]
        return terms[0] if len(terms) == 1 else lambda n, c: float(all(v(n, c) != 0 for v in terms))

    def _not(self, depth: int) -> Value:
        if self.peek() != "!":
            return self._compared(depth)
        self.next_token()
        if depth > MAX_DEPTH:
            raise_invalid(f"the expression is nested deeper than {MAX_DEPTH} levels", self.where)
        inner = self._not(depth + 1)
        return lambda n, c: float(inner(n, c) == 0)

    def _compared(self, depth: int) -> Value:
        left = self._sum(depth)
        if self.peek() not in _COMPARED:
            return left
        how = _COMPARED[self.next_token()]
        right = self._sum(depth)
        return lambda n, c: float(how(left(n, c), right(n, c)))

    def _sum(self, depth: int) -> Value:
        return _fold(list(self._series(depth, ("+", "-"), self._product)))

    def _product(self, depth: int) -> Value:
        return _fold(list(self._series(depth, ("*", "/", "%"), self._signed)))

    def _signed(self, depth: int) -> Value:
        if self.peek() != "-":
            return self._power(depth)
        self.next_token()
        if depth > MAX_DEPTH:
            raise_invalid(f"the expression is nested deeper than {MAX_DEPTH} levels", self.where)
        inner = self._signed(depth + 1)
        return lambda n, c: -inner(n, c)

    def _power(self, depth: int) -> Value:
        base = self._primary(depth)
        if self.peek() != "^":
            return base
        self.next_token()
        exponent = self.next_token()
        if not exponent.isdecimal() or int(exponent) > 16:
            raise_invalid(f"an exponent must be a whole number from 0 to 16, got {exponent!r}", self.where)
        return lambda n, c: math.prod([base(n, c)] * int(exponent))

    def _primary(self, depth: int) -> Value:
        token = self.next_token()
        if token == "(":  # noqa: S105 - no secret
            inner = self.either(depth + 1)
            self._expect(")")
            return inner
        if token and (token[0].isdigit() or token[0] == "."):
            number = float(token)
            return lambda n, c: number
        if token in _FUNCTIONS and self.peek() == "(":
            return self._function(token, depth)
        if token and (token[0].isalpha() or token[0] == "_"):
            if token not in self.names:
                name_list = ", ".join(sorted(self.names)) or "none"
                raise_invalid(
                    f"unknown name {token!r}; available: {name_list}; functions: {', '.join(_FUNCTIONS)}",
                    self.where,
                )
            return lambda n, c: n[token]
        raise_invalid(
            f"expected a number, a name or (, got {token!r}" if token else "the expression ends too early",
            self.where,
        )

    def _function(self, name: str, depth: int) -> Value:
        self._expect("(")
        given = [value for _, value in self._series(depth + 1, (",",), self.either)]
        self._expect(")")
        minimum, maximum = _FUNCTIONS[name]
        if not minimum <= len(given) <= maximum:
            raise_invalid(
                f"{name} takes {minimum if minimum == maximum else f'{minimum} or more'} values, got {len(given)}",
                self.where,
            )
        if name == "rand":
            low, high = given

            def drawn(n: Mapping[str, float], c: np.random.Generator) -> float:
                a, b = low(n, c), high(n, c)
                return a + (b - a) * float(c.random())

            return drawn
        how = _SIMPLE[name]
        return lambda n, c: how([v(n, c) for v in given])

    def _expect(self, sign: str) -> None:
        got = self.next_token()
        if got != sign:
            raise_invalid(f"expected {sign!r}, got {got!r}" if got else f"missing {sign!r} at the end", self.where)


def _fold(parts: list[tuple[str, Value]]) -> Value:
    """A series of operations of one rank, from the left."""
    first = parts[0][1]
    if len(parts) == 1:
        return first
    rest = [(_ARITHMETIC[sign], value) for sign, value in parts[1:]]

    def value(n: Mapping[str, float], c: np.random.Generator) -> float:
        out = first(n, c)
        for how, other in rest:
            out = how(out, other(n, c))
        return out

    return value

"""L-systems: bracketed, parametric and stochastic rewriting, and the turtle that draws the result.

Rules are text, one statement per line (or separated by semicolons); a line with an open bracket continues on the next;
``#`` begins a comment::

    taper = 0.7                                     # a constant
    axiom: !(0.05) F(0.5) A(1, 0.05)
    A(l, w) : l > 0.2 -> F(l, w * taper) [ +(rand(20, 40)) A(l * 0.6, w * taper) ] /(137.5) A(l * 0.8, w * taper)
    A(l, w) : l <= 0.2 @ 3 -> L(0.1)                # one of the matching rules is drawn, this one with weight 3
    A(l, w) : l <= 0.2 @ 1 -> O(0.03)

A symbol is one letter or sign, with its values in parentheses. A rule applies to the symbol with as many values as it
names, if its condition is true; symbols without a matching rule stay. Expressions: ``_expressions``. The turtle starts
at the origin and looks up (z); its symbols are

=================== ================================================= ==========================================
``F(length, r)``    goes forward and draws, its radius becoming ``r`` default: ``length`` of the system, radius kept
``f(length)``       goes forward and draws nothing
``+(a)``, ``-(a)``  turns left, right by degrees                      default: the system's ``angle``
``&(a)``, ``^(a)``  pitches down, up
``\\(a)``, ``/(a)``  rolls left, right
``|``               turns round
``$``               rolls until its left side is level
``!(r)``            sets the radius in metres
``[``, ``]``        saves its position, and returns to it
``L(size)``         a leaf of this length
``O(radius)``       a fruit
=================== ================================================= ==========================================

Source: Prusinkiewicz and Lindenmayer, The Algorithmic Beauty of Plants (1990), chapter 1 (their signs, and their
meaning of parametric and stochastic rules). A system that exceeds a limit raises CannotGenerate while it grows.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from app.errors import CannotGenerate, Problem
from app.generate import _expressions
from app.generate._expressions import Expression, raise_invalid

MAX_SYMBOLS = 100_000
"""Maximum number of symbols of a system at any time."""

MAX_WORK = 2_500_000
"""Maximum number of rewritten symbols, for all plants of one generation together."""

MAX_DRAWN = 20_000
"""Maximum number of branches, leaves and fruit of one plant."""

MAX_TEXT_CHARACTERS, MAX_RULES, MAX_WORDS = 20_000, 200, 500
"""Maximum number of characters of rules, of statements, and of symbols on one side of a rule."""

MAX_ITERATIONS = 40
MAX_DEPTH = 200
"""Maximum depth of nested brackets."""

MAX_PLANT_METRES = 1000.0
"""Maximum distance of a plant from its root, in metres."""

TURTLE: Mapping[str, tuple[int, int]] = {
    "F": (0, 2), "f": (0, 1), "L": (0, 1), "O": (0, 1), "!": (1, 1), "|": (0, 0), "$": (0, 0), "[": (0, 0), "]": (0, 0),
    **dict.fromkeys("+-&^\\/", (0, 1)),
}  # fmt: skip
"""Signs of the turtle, and the numbers of values that each takes."""

_LETTER = re.compile(r"[A-Za-z]")
_CONSTANT = re.compile(r"\s*([A-Za-z_][A-Za-z0-9_]*)\s*=(?!=)(.*)", re.DOTALL)
_AXIOM = re.compile(r"\s*axiom\s*:(.*)", re.DOTALL)
_RULE = re.compile(r"\s*([A-Za-z])\s*(?:\(([^()]*)\))?\s*(?::(.*))?\s*", re.DOTALL)
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")

Symbol = tuple[str, tuple[float, ...]]
"""Letter or sign with its values."""

Word = tuple[str, tuple[Expression, ...]]
"""Symbol of a rule, with expressions instead of values."""

Vector = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Rule:
    """Rule that rewrites a symbol. names: of its values. location: its statement."""

    symbol: str
    names: tuple[str, ...]
    condition: Expression | None
    weight: Expression | None
    after: tuple[Word, ...]
    location: str


@dataclass(frozen=True, slots=True)
class System:
    """Checked L-system. constants: by name."""

    axiom: tuple[Word, ...]
    rules: Mapping[tuple[str, int], tuple[Rule, ...]]
    constants: Mapping[str, float]


@dataclass(slots=True)
class Budget:
    """Number of symbols that one generation may still rewrite."""

    left: int = MAX_WORK


# --- reading rules ---------------------------------------------------------------------------------------------------


def parse(text: str) -> System:
    """Parse rules to an L-system. Raises Invalid, which names the statement and the problem."""
    if len(text) > MAX_TEXT_CHARACTERS:
        raise_invalid(f"the rules have {len(text)} characters; the limit is {MAX_TEXT_CHARACTERS}", "rules")
    statements = _statements(text)
    if len(statements) > MAX_RULES:
        raise_invalid(f"there are {len(statements)} statements; the limit is {MAX_RULES}", "rules")
    constants: dict[str, float] = {}
    axiom: tuple[Word, ...] | None = None
    rules: dict[tuple[str, int], list[Rule]] = {}
    never = np.random.Generator(np.random.PCG64(0))
    for k, statement in enumerate(statements):
        location = f"rules, statement {k + 1}"
        head, arrow, tail = statement.partition("->")
        if arrow:
            rule = _rule(head, tail, constants, location)
            rules.setdefault((rule.symbol, len(rule.names)), []).append(rule)
        elif match := _AXIOM.fullmatch(statement):
            if axiom is not None:
                raise_invalid("duplicate axiom", location)
            axiom = _parse_words(match[1], frozenset(constants), location)
        elif match := _CONSTANT.fullmatch(statement):
            if match[1] in constants:
                raise_invalid(f"duplicate constant {match[1]!r}", location)
            if "rand" in match[2]:
                raise_invalid("a constant must not be random: use rand in a rule", location)
            constants[match[1]] = _expressions.parse(match[2], frozenset(constants), location)(constants, never)
        else:
            raise_invalid(
                f"{statement[:60]!r} is not a statement: use axiom: …, name = number, or symbol -> symbols", location
            )
    if axiom is None:
        raise_invalid("missing axiom, such as axiom: F A(1)", "rules")
    system = System(axiom, {key: tuple(match) for key, match in rules.items()}, constants)
    _check_symbols(system)
    return system


def _statements(text: str) -> list[str]:
    """Split the text into statements without comments; lines are joined while a bracket is open."""
    out: list[str] = []
    open_ = 0
    for line in text.splitlines():
        for k, piece in enumerate(line.partition("#")[0].split(";")):
            if k == 0 and open_ > 0 and out:
                out[-1] += " " + piece
            else:
                out.append(piece)
                open_ = 0
            open_ += sum(piece.count(s) for s in "[(") - sum(piece.count(s) for s in "])")
    return [statement.strip() for statement in out if statement.strip()]


def _rule(head: str, tail: str, constants: Mapping[str, float], location: str) -> Rule:
    head, at, chance = head.partition("@")
    match = _RULE.fullmatch(head)
    if match is None:
        raise_invalid(f"{head.strip()[:60]!r} is not a symbol with names, such as A(l, w) : l > 1 @ 2", location)
    names = tuple(part.strip() for part in match[2].split(",")) if match[2] and match[2].strip() else ()
    if not all(_NAME.fullmatch(name) for name in names) or len(set(names)) != len(names) or len(names) > 8:
        raise_invalid(f"({match[2]}) must be at most 8 different names", location)
    scope = frozenset({*constants, *names})
    condition_text = match[3] or ""
    if match[3] is not None and not condition_text.strip():
        raise_invalid("missing condition after :", location)
    condition = _expressions.parse(condition_text, scope, location) if condition_text.strip() else None
    weight = _expressions.parse(chance, scope, location) if at else None
    return Rule(match[1], names, condition, weight, _parse_words(tail, scope, location), location)


def _parse_words(text: str, names: frozenset[str], location: str) -> tuple[Word, ...]:
    """Parse symbols with the expressions of their values; brackets must be balanced."""
    out: list[Word] = []
    at = open_ = 0
    while at < len(text):
        letter = text[at]
        at += 1
        if letter.isspace():
            continue
        if not (_LETTER.fullmatch(letter) or letter in TURTLE):
            raise_invalid(
                f"unknown symbol {letter!r}: use letters and {' '.join(s for s in TURTLE if not s.isalpha())}", location
            )
        open_ += (letter == "[") - (letter == "]")
        if open_ < 0:
            raise_invalid("] without [", location)
        rest = re.match(r"\s*\(", text[at:])
        values: tuple[Expression, ...] = ()
        if rest is not None:
            inside, at = _inside(text, at + rest.end(), location)
            values = tuple(_expressions.parse(one, names, location) for one in inside)
        out.append((letter, values))
        if len(out) > MAX_WORDS:
            raise_invalid(f"there are more than {MAX_WORDS} symbols on one side", location)
    if open_:
        raise_invalid("[ without ]", location)
    return tuple(out)


def _inside(text: str, at: int, location: str) -> tuple[list[str], int]:
    """Split the values after an opening parenthesis at their commas; also return where they end."""
    start, deep, out = at, 0, []
    while at < len(text):
        sign = text[at]
        if sign == ")" and deep == 0:
            out.append(text[start:at])
            return out, at + 1
        if sign == "," and deep == 0:
            out.append(text[start:at])
            start = at + 1
        deep += (sign == "(") - (sign == ")")
        at += 1
    return raise_invalid("missing )", location)


def _check_symbols(system: System) -> None:
    """Check that every letter has a meaning: a rule for as many values, or the turtle's."""
    sides = [("axiom", system.axiom), *((r.location, r.after) for rules in system.rules.values() for r in rules)]
    for location, words in sides:
        for letter, values in words:
            minimum, maximum = TURTLE.get(letter, (1, 0))
            if minimum <= len(values) <= maximum or (letter, len(values)) in system.rules:
                continue
            takes = [str(n) for symbol, n in system.rules if symbol == letter]
            takes += [f"{minimum} to {maximum}" if minimum < maximum else str(minimum)] if letter in TURTLE else []
            if takes:
                raise_invalid(f"{letter} takes {' or '.join(takes)} values, got {len(values)}", location)
            raise_invalid(f"no rule for {letter}, which is not a turtle symbol either", location)


# --- rewriting -------------------------------------------------------------------------------------------------------


def expand(system: System, iterations: int, chance: np.random.Generator, budget: Budget | None = None) -> list[Symbol]:
    """Rewrite the axiom for a number of rounds.

    Raises CannotGenerate, with the round, if there are too many symbols.
    """
    budget = budget or Budget()
    symbols = _produce_symbols(system.axiom, system.constants, chance)
    for k in range(iterations):
        out: list[Symbol] = []
        changed = False
        for symbol in symbols:
            rules = system.rules.get((symbol[0], len(symbol[1])))
            after = None if rules is None else _rewrite(system, rules, symbol, chance)
            if after is None:
                out.append(symbol)
            else:
                changed = True
                out += after
            if len(out) > MAX_SYMBOLS:
                _explodes(f"has more than {MAX_SYMBOLS} symbols after {k} of {iterations} rounds")
        budget.left -= len(symbols)
        if budget.left < 0:
            _explodes(f"has taken {MAX_WORK} symbols to rewrite after {k + 1} of {iterations} rounds")
        symbols = out
        if not changed:
            break
    return symbols


def _explodes(problem: str) -> None:
    why = f"the L-system {problem}: give fewer iterations, or conditions that end its growth"
    raise CannotGenerate(why, [Problem(f"the L-system {problem}", where="rules")])


def _produce_symbols(words: Iterable[Word], names: Mapping[str, float], chance: np.random.Generator) -> list[Symbol]:
    return [(letter, tuple([value(names, chance) for value in values])) for letter, values in words]


def _rewrite(system: System, rules: Sequence[Rule], symbol: Symbol, chance: np.random.Generator) -> list[Symbol] | None:
    """Return the replacement of a symbol; None if no rule applies."""
    names = dict(system.constants)
    holding: list[Rule] = []
    for rule in rules:
        variables = {**names, **dict(zip(rule.names, symbol[1], strict=True))}
        if rule.condition is None or rule.condition(variables, chance) != 0:
            holding.append(rule)
    if not holding:
        return None
    chosen = holding[0]
    if len(holding) > 1:
        weights = []
        for rule in holding:
            variables = {**names, **dict(zip(rule.names, symbol[1], strict=True))}
            weights.append(1.0 if rule.weight is None else rule.weight(variables, chance))
        if min(weights) < 0 or not sum(weights) > 0:
            problem = "weights must not be negative, and one must be above 0"
            raise CannotGenerate(f"{chosen.location}: {problem}", [Problem(problem, where=chosen.location)])
        left = float(chance.random()) * sum(weights)
        for rule, weight in zip(holding, weights, strict=True):
            chosen = rule
            left -= weight
            if left < 0:
                break
    variables = {**names, **dict(zip(chosen.names, symbol[1], strict=True))}
    return _produce_symbols(chosen.after, variables, chance)


# --- drawing ---------------------------------------------------------------------------------------------------------


@dataclass(slots=True)
class Drawing:
    """Result of the turtle, in metres.

    Each branch: (start, end, radius at the start, at the end, left, up); each leaf: (position, heading, left, length);
    each fruit: (position, radius). stem: length drawn before the first fork.
    """

    branches: list[tuple[Vector, Vector, float, float, Vector, Vector]] = field(default_factory=list)
    leaves: list[tuple[Vector, Vector, Vector, float]] = field(default_factory=list)
    fruit: list[tuple[Vector, float]] = field(default_factory=list)
    stem: float = 0.0


@dataclass(slots=True)
class _State:
    at: Vector
    h: Vector
    l: Vector  # noqa: E741 - the book's name
    u: Vector
    radius: float


def draw(symbols: Iterable[Symbol], *, angle: float, length: float, radius: float) -> Drawing:
    """Follow the turtle. angle (degrees), length and radius (metres): defaults of symbols without values.

    Raises CannotGenerate if there is too much to draw, or the plant reaches too far.
    """
    out = Drawing()
    now = _State((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (-1.0, 0.0, 0.0), (0.0, -1.0, 0.0), radius)
    stack: list[_State] = []
    forked = False
    for letter, values in symbols:
        first = values[0] if values else None
        if letter in ("F", "f"):
            start = now.at
            now.at = _plus(start, now.h, length if first is None else first)
            if not max(map(abs, now.at)) <= MAX_PLANT_METRES:
                _beyond(f"reaches more than {MAX_PLANT_METRES:g} m from its root")
            if letter == "F":
                end = max(0.0, values[1]) if len(values) > 1 else now.radius
                out.branches.append((start, now.at, now.radius, end, now.l, now.u))
                now.radius = end
                if not forked:
                    out.stem = max(out.stem, now.at[2])
        elif letter in "+-&^\\/|":
            turn = 180.0 if letter == "|" else angle if first is None else first
            _turn(now, letter, turn)
        elif letter == "$":
            _level(now)
        elif letter == "!":
            now.radius = max(0.0, values[0])
        elif letter == "[":
            forked = forked or bool(out.branches)
            stack.append(_State(now.at, now.h, now.l, now.u, now.radius))
            if len(stack) > MAX_DEPTH:
                _beyond(f"has more than {MAX_DEPTH} nested brackets")
        elif letter == "]":
            now = stack.pop()
        elif letter == "L":
            out.leaves.append((now.at, now.h, now.l, abs(length if first is None else first)))
        elif letter == "O":
            out.fruit.append((now.at, abs(radius if first is None else first)))
        if len(out.branches) + len(out.leaves) + len(out.fruit) > MAX_DRAWN:
            _beyond(f"has more than {MAX_DRAWN} branches, leaves and fruit")
    return out


def _beyond(problem: str) -> None:
    raise CannotGenerate(
        f"the plant {problem}: give fewer iterations", [Problem(f"the plant {problem}", where="rules")]
    )


def _plus(a: Vector, b: Vector, times: float) -> Vector:
    return (a[0] + b[0] * times, a[1] + b[1] * times, a[2] + b[2] * times)


def _combine(a: Vector, c: float, b: Vector, s: float) -> Vector:
    return (a[0] * c + b[0] * s, a[1] * c + b[1] * s, a[2] * c + b[2] * s)


def _turn(now: _State, sign: str, degrees: float) -> None:
    """Rotate: left and right about the up axis, down and up about the left one; rolling left lowers the left side."""
    # rounded, so that the last bit of a machine's sine has no effect
    a = math.radians(math.remainder(degrees, 360.0))
    c, s = round(math.cos(a), 12), round(math.sin(a), 12)
    if sign in "-^\\":
        s = -s
    if sign in "+-|":
        now.h, now.l = _combine(now.h, c, now.l, s), _combine(now.l, c, now.h, -s)
    elif sign in "&^":
        now.h, now.u = _combine(now.h, c, now.u, -s), _combine(now.u, c, now.h, s)
    else:
        now.l, now.u = _combine(now.l, c, now.u, s), _combine(now.u, c, now.l, -s)


def _level(now: _State) -> None:
    """Roll until the left axis is horizontal; pointing straight up or down changes nothing."""
    x, y, _ = now.h
    flat = math.sqrt(x * x + y * y)
    if flat > 1e-9:
        now.l = (-y / flat, x / flat, 0.0)
        h, left = now.h, now.l
        now.u = (
            h[1] * left[2] - h[2] * left[1],
            h[2] * left[0] - h[0] * left[2],
            h[0] * left[1] - h[1] * left[0],
        )

"""A grammar for towns: from a boundary to streets, blocks, lots and buildings, by rules that are data.

Rules are text, one per line (or separated by semicolons), ``#`` begins a comment::

    town -> ring(main) quarter                       # the first rule's shape is the boundary
    quarter : area > block -> cut(rand(0.4, 0.6), street) quarter quarter
    quarter : area <= block -> lots
    lots : area > 600 -> cut(0.5, 0) lots lots       # one of the matching rules is drawn by weight
    lots : area <= 600 @ 3 -> inset(2) house
    lots : area <= 600 @ 1 -> garden
    house -> gable(rand(1, 3))

Left of the arrow: a shape's name, a condition, a weight. Right of it one action and the names of the shapes that it
creates. Expressions (``_expressions``) can use the shape's ``area`` (m²), the ``length`` and ``width`` of the rectangle
around it, its ``frontage`` (metres of its edge on a street), its recursion depth ``deep``, and constants.

========================== ============================================================================================
``ring(street) A``          a street along the inside of the shape's edge; A is what it encloses
``cut(share, street) A B``  two parts, cut across the longer side at this share of it, with a street between (0: none)
``inset(metres) A``         A is the area farther from the edge
``flat(storeys)``           a building with this roof; ``gable`` and ``hip`` cover the largest rectangle that fits
``gable(…)``, ``hip(…)``
``garden``, ``park``,       open ground, planted or paved; also if a rule leads to nothing else
``square``
========================== ============================================================================================

In the spirit of Wonka et al., Instant Architecture (2003), and Parish and Müller, Procedural Modeling of Cities (2001):
lots are halved along the rectangle around them. Rules with too many shapes, or too deep, raise CannotGenerate.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely

from app.errors import CannotGenerate, Problem
from app.generate import _expressions
from app.generate._expressions import Expression, raise_invalid

MAX_SHAPES = 30_000
MAX_DEPTH = 48
MAX_TEXT_CHARACTERS, MAX_RULES = 20_000, 200
MIN_AREA_M2 = 1.0
"""Minimum area in square metres of a piece that is cut further."""

MIN_CROSSING_METRES = 14.0
"""Minimum distance in metres between the end of a street and the next crossing."""

SHAPE_NAMES = frozenset({"area", "length", "width", "frontage", "deep"})
ROOFS = ("flat", "gable", "hip")
OPEN = ("garden", "park", "square")
ACTIONS: Mapping[str, tuple[int, int]] = {
    "ring": (1, 1),
    "cut": (2, 2),
    "inset": (1, 1),
    **dict.fromkeys(ROOFS, (1, 0)),
}
"""Number of values and of shapes that each action takes."""

_RULE = re.compile(r"\s*([a-z_][a-z0-9_]*)\s*(?::(.*))?", re.DOTALL)
_ACTION = re.compile(r"\s*([a-z_][a-z0-9_]*)\s*(\(.*\))?([a-z0-9_\s]*)", re.DOTALL)


@dataclass(frozen=True, slots=True)
class Rule:
    """Action of a rule with its condition and weight."""

    condition: Expression | None
    weight: Expression | None
    action: str
    values: tuple[Expression, ...]
    makes: tuple[str, ...]
    location: str


@dataclass(frozen=True, slots=True)
class Grammar:
    """Checked rules by shape. start: shape of the boundary."""

    start: str
    rules: Mapping[str, tuple[Rule, ...]]
    constants: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Street:
    """Centreline of a street and its width between house fronts, in metres."""

    line: Any
    width: float


@dataclass(frozen=True, slots=True)
class Lot:
    """Ground that no rule divides further. use: flat, gable or hip with storeys, or one of OPEN."""

    area: Any
    use: str
    storeys: int = 0


@dataclass(slots=True)
class Town:
    """Result of the rules. blocks: the ground between streets. ends: of the streets."""

    streets: list[Street] = field(default_factory=list)
    blocks: list[Any] = field(default_factory=list)
    lots: list[Lot] = field(default_factory=list)
    ends: list[tuple[float, float]] = field(default_factory=list)

    def street(self, line: Any, width: float) -> None:
        """Add a street."""
        self.streets.append(Street(line, width))
        self.ends += [(float(x), float(y)) for x, y in shapely.get_coordinates(line)[[0, -1]]]


@dataclass(frozen=True, slots=True)
class _Shape:
    """Shape of the grammar.

    whole: reaches to the centre of the streets around it. land: without the streets. front: a strip along the edge of
    its block, once the block has been cut into lots.
    """

    name: str
    whole: Any
    land: Any
    front: Any
    deep: int


# --- rules ------------------------------------------------------------------------------------------------------------


def parse(text: str, constants: Mapping[str, float]) -> Grammar:
    """Parse rules to a grammar. Raises Invalid, which names the rule and the problem."""
    if len(text) > MAX_TEXT_CHARACTERS:
        raise_invalid(f"the rules have {len(text)} characters; the limit is {MAX_TEXT_CHARACTERS}", "rules")
    statements = [s.strip() for line in text.splitlines() for s in line.partition("#")[0].split(";")]
    statements = [s for s in statements if s]
    if not 0 < len(statements) <= MAX_RULES:
        raise_invalid(f"there must be 1 to {MAX_RULES} rules, got {len(statements)}", "rules")
    names = frozenset({*SHAPE_NAMES, *constants})
    rules: dict[str, list[Rule]] = {}
    for k, statement in enumerate(statements):
        location = f"rules, rule {k + 1}"
        head, arrow, tail = statement.partition("->")
        head, at, weight = head.partition("@")
        match = _RULE.fullmatch(head)
        if not arrow or match is None:
            raise_invalid(
                f"{statement[:60]!r} is not a rule such as lots : area > 600 @ 2 -> cut(0.5, 0) lots lots", location
            )
        if match[2] is not None and not match[2].strip():
            raise_invalid("missing condition after :", location)
        rule = _action(tail, names, location)
        rules.setdefault(match[1], []).append(
            Rule(
                _expressions.parse(match[2], names, location) if match[2] else None,
                _expressions.parse(weight, names, location) if at else None,
                *rule,
                location,
            )
        )
    grammar = Grammar(next(iter(rules)), {name: tuple(match) for name, match in rules.items()}, dict(constants))
    for alternatives in grammar.rules.values():
        for rule_ in alternatives:
            for name in rule_.makes:
                if name not in grammar.rules and name not in OPEN:
                    raise_invalid(f"no rule for {name!r}", rule_.location)
    return grammar


def _action(text: str, names: frozenset[str], location: str) -> tuple[str, tuple[Expression, ...], tuple[str, ...]]:
    match = _ACTION.fullmatch(text)
    if match is None:
        raise_invalid(f"{text.strip()[:60]!r} is not an action with shapes, such as cut(0.5, 8) a b", location)
    name, inside, rest = match[1], match[2], tuple(match[3].split())
    if name not in ACTIONS:
        if inside is None and not rest:
            return "is", (), (name,)
        raise_invalid(f"unknown action {name!r}: use one of {', '.join(ACTIONS)}, or a shape's name alone", location)
    values = tuple(_expressions.parse(one, names, location) for one in _split(inside or "()"))
    wants, makes = ACTIONS[name]
    if len(values) != wants or len(rest) != makes:
        raise_invalid(f"{name} takes {wants} values and {makes} shapes, got {len(values)} and {len(rest)}", location)
    return name, values, rest


def _split(inside: str) -> list[str]:
    """Split the text between parentheses at its outer commas."""
    out, deep, start = [], 0, 1
    for k, sign in enumerate(inside):
        deep += (sign == "(") - (sign == ")")
        if sign == "," and deep == 1:
            out.append(inside[start:k])
            start = k + 1
    out.append(inside[start:-1])
    return out


# --- shapes -----------------------------------------------------------------------------------------------------


def grow(grammar: Grammar, boundary: Any, chance: np.random.Generator) -> Town:
    """Apply the rules to a boundary (a polygon, metres).

    Raises CannotGenerate if there are too many shapes, the rules recurse too deep, or an action is impossible.
    """
    town = Town()
    waiting = [_Shape(grammar.start, boundary, boundary, None, 0)]
    shape_count = 0
    while waiting:
        shape = waiting.pop()
        shape_count += 1
        if shape_count > MAX_SHAPES:
            _stop(f"the rules create more than {MAX_SHAPES} shapes", "rules")
        rules = grammar.rules.get(shape.name)
        if rules is None or shape.land.area < MIN_AREA_M2:
            _finish_lot(town, shape, shape.name if shape.name in OPEN else "garden")
            continue
        names = _ShapeVariables(grammar.constants, shape)
        rule = _choose_rule(rules, names, chance)
        if rule is None:
            _finish_lot(town, shape, "garden")
            continue
        if shape.deep >= MAX_DEPTH:
            _stop(
                f"the rules recurse more than {MAX_DEPTH} levels deep: add a rule that ends {shape.name!r}",
                rule.location,
            )
        # reversed, because the stack processes the last one first
        waiting += reversed(_apply_rule(town, shape, rule, [value(names, chance) for value in rule.values]))
    return town


def _stop(problem: str, location: str) -> None:
    raise CannotGenerate(f"{location}: {problem}", [Problem(problem, where=location)])


def _finish_lot(town: Town, shape: _Shape, use: str, storeys: int = 0) -> None:
    if shape.front is None and not shape.land.is_empty:
        town.blocks.append(shape.land)
    if shape.land.area > 0:
        town.lots.append(Lot(shape.land, use, storeys))


class _ShapeVariables(dict[str, float]):
    """Variables of expressions: constants, and the shape's measures, computed on demand."""

    def __init__(self, constants: Mapping[str, float], shape: _Shape) -> None:
        super().__init__(constants)
        self.shape = shape

    def __missing__(self, name: str) -> float:
        shape = self.shape
        if name == "area":
            self[name] = round(shape.land.area, 3)
        elif name == "deep":
            self[name] = float(shape.deep)
        elif name == "frontage":
            edge = shapely.boundary(shape.land)
            part = edge if shape.front is None else shapely.intersection(edge, shape.front)
            self[name] = round(part.length, 2)
        else:
            long, short = _box(shape.land)[2:]
            self["length"], self["width"] = round(long, 3), round(short, 3)
        return self[name]


def _strip(land: Any) -> Any:
    """Return the part of an area within a centimetre of a block's edge."""
    return shapely.buffer(shapely.boundary(land), 0.01, cap_style="flat", join_style="mitre")


def _choose_rule(rules: Sequence[Rule], names: Mapping[str, float], chance: np.random.Generator) -> Rule | None:
    holding = [r for r in rules if r.condition is None or r.condition(names, chance) != 0]
    if len(holding) < 2:
        return holding[0] if holding else None
    weights = [1.0 if r.weight is None else r.weight(names, chance) for r in holding]
    if min(weights) < 0 or not sum(weights) > 0:
        _stop("weights must not be negative, and one must be above 0", holding[0].location)
    left = float(chance.random()) * sum(weights)
    for rule, weight in zip(holding, weights, strict=True):
        left -= weight
        if left < 0:
            return rule
    return holding[-1]


def _apply_rule(town: Town, shape: _Shape, rule: Rule, values: list[float]) -> list[_Shape]:
    """Return the shapes that an action creates; buildings and open ground are final."""
    deep = shape.deep + 1
    if rule.action == "is":
        return [_Shape(rule.makes[0], shape.whole, shape.land, shape.front, deep)]
    if rule.action in ROOFS:
        storeys = math.floor(values[0] + 0.5)
        if not 1 <= storeys <= 100:
            _stop(f"a building must have 1 to 100 storeys, got {values[0]:g}", rule.location)
        _finish_lot(town, shape, rule.action, storeys)
        return []
    if rule.action == "inset":
        return _inset(town, shape, rule, values[0], deep)
    width = values[-1]
    if width != 0 and not 1.0 <= width <= 200.0:
        _stop(f"a street must be 1 to 200 m wide, or 0 for none, got {width:g}", rule.location)
    if width and shape.front is not None:
        _stop("a street cannot cross land that has been cut into lots", rule.location)
    if rule.action == "ring":
        return _ring(town, shape, rule, width, deep)
    if not 0.02 <= values[0] <= 0.98:
        _stop(f"a share must be from 0.02 to 0.98, got {values[0]:g}", rule.location)
    return _cut(town, shape, rule, values[0], width, deep)


def _inset(town: Town, shape: _Shape, rule: Rule, metres: float, deep: int) -> list[_Shape]:
    if metres < 0:
        _stop(f"an inset must not be negative, got {metres:g}", rule.location)
    front = shape.front
    if front is None:
        town.blocks.append(shape.land)
        front = _strip(shape.land)
    inner = _pieces(shapely.buffer(shape.land, -metres, join_style="mitre"))
    if not inner:
        _finish_lot(town, _Shape(shape.name, shape.land, shape.land, front, deep), "garden")
    return [_Shape(rule.makes[0], piece, piece, front, deep) for piece in inner]


def _ring(town: Town, shape: _Shape, rule: Rule, width: float, deep: int) -> list[_Shape]:
    if width == 0:
        _stop("a ring needs a street's width", rule.location)
    middle = _pieces(shapely.buffer(shape.land, -width / 2, join_style="mitre"))
    out = []
    for block in middle:
        land = _pieces(shapely.buffer(block, -width / 2, join_style="mitre"))
        if not land:
            continue
        town.street(shapely.LineString(shapely.get_coordinates(block.exterior)), width)
        out += [_Shape(rule.makes[0], block, piece, None, deep) for piece in land]
    if not out:
        _stop(f"there is no room for a ring of {width:g} m and land inside it", rule.location)
    return out


def _cut(town: Town, shape: _Shape, rule: Rule, share: float, width: float, deep: int) -> list[_Shape]:
    """Cut an area in two halves, each of which may have several pieces."""
    (x, y), along, long, short = _box(shape.land)
    if width:
        share = _align_share(town, shape.land, share, width)
    reach = long + short + 1000.0
    middle = (x + along[0] * (share - 0.5) * long, y + along[1] * (share - 0.5) * long)
    across = (-along[1], along[0])
    ends = [(middle[0] + s * across[0] * reach, middle[1] + s * across[1] * reach) for s in (-1, 1)]
    far = [(px + s * along[0] * reach, py + s * along[1] * reach) for s in (-1, 1) for px, py in ends]
    sides = [shapely.Polygon([*ends, far[1], far[0]]), shapely.Polygon([*ends, far[3], far[2]])]
    line = shapely.LineString(ends)
    front = shape.front
    if width:
        for part in shapely.get_parts(shapely.intersection(line, shape.whole)):
            if part.geom_type == "LineString" and part.length > 0.5:
                town.street(_mm(part), width)
    elif front is None:
        town.blocks.append(shape.land)
        front = _strip(shape.land)
    strip = shapely.buffer(line, width / 2, cap_style="flat") if width else None
    out = []
    for side, name in zip(sides, rule.makes, strict=True):
        if strip is None:
            out += [_Shape(name, p, p, front, deep) for p in _pieces(shapely.intersection(shape.land, side))]
            continue
        for block in _pieces(shapely.intersection(shape.whole, side)):
            land = shapely.intersection(shape.land, block)
            land = shapely.difference(land, strip)
            out += [_Shape(name, block, piece, front, deep) for piece in _pieces(land)]
    return out


def _align_share(town: Town, land: Any, share: float, width: float) -> float:
    """Return a share at which a street meets those that end nearby, or keeps its distance."""
    (x, y), along, long, short = _box(land)
    near = []
    for px, py in town.ends:
        u = (px - x) * along[0] + (py - y) * along[1]
        v = abs(-(px - x) * along[1] + (py - y) * along[0])
        if abs(u) < 0.45 * long and v < short / 2 + 2 * width + 2.0:
            near.append(u)
    if not near:
        return share
    at = (share - 0.5) * long
    nearest = min(near, key=lambda u: (abs(u - at), u))
    if abs(nearest - at) >= MIN_CROSSING_METRES + width / 2:
        return share
    moved = nearest / long + 0.5
    return moved if 0.2 <= moved <= 0.8 else share


def _box(area: Any) -> tuple[tuple[float, float], tuple[float, float], float, float]:
    """Return centre, direction of the longer side, length and width of the rectangle around an area."""
    corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(area))
    if len(corners) < 4:
        return (0.0, 0.0), (1.0, 0.0), 0.0, 0.0
    a, b = corners[1] - corners[0], corners[2] - corners[1]
    la, lb = math.sqrt(float(a @ a)), math.sqrt(float(b @ b))
    long = a / la if la >= lb else b / lb
    if long[0] < -1e-9 or (abs(long[0]) <= 1e-9 and long[1] < 0):
        long = -long
    middle = (corners[0] + corners[2]) / 2
    along = (round(float(long[0]), 9), round(float(long[1]), 9))
    return (float(middle[0]), float(middle[1])), along, max(la, lb), min(la, lb)


def _mm(geometry: Any) -> Any:
    return shapely.transform(geometry, lambda xy: np.round(xy, 3) + 0.0)


def _pieces(area: Any) -> list[Any]:
    """Return the polygons of an area in whole millimetres, from the left and from below, without slivers and holes."""
    out = []
    for part in shapely.get_parts(area):
        if part.geom_type != "Polygon" or part.area < MIN_AREA_M2:
            continue
        plain = shapely.make_valid(_mm(shapely.Polygon(part.exterior)))
        out += [p for p in shapely.get_parts(plain) if p.geom_type == "Polygon" and p.area >= MIN_AREA_M2]
    return sorted((shapely.normalize(p) for p in out), key=lambda p: p.bounds)

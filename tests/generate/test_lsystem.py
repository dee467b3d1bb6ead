"""L-systems: classic ones computed by hand, the turtle's turns, and exploding or invalid rules."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from app.errors import CannotGenerate, Invalid
from app.generate import RandomSource, _expressions, _lsystem, _plants
from app.generate._lsystem import draw, expand, parse
from app.model.meshes import read_mesh

DICE = RandomSource(7, "plants")


def dice(name: str = "x") -> np.random.Generator:
    return DICE.stream(name)


def text(symbols: list[_lsystem.Symbol]) -> str:
    return "".join(
        letter + ("(" + ",".join(f"{v:g}" for v in values) + ")" if values else "") for letter, values in symbols
    )


def number(text: str, **names: float) -> float:
    return _expressions.parse(text, frozenset(names), "here")(names, dice())


def test_lindenmayer_algae_grow_as_published() -> None:
    system = parse("axiom: b; a -> ab; b -> a")
    assert [text(expand(system, n, dice())) for n in range(6)] == ["b", "a", "ab", "aba", "abaab", "abaababa"]


def test_bracketed_system_is_rewritten() -> None:
    """Figure 1.24 b of The Algorithmic Beauty of Plants: F -> F[+F]F[-F][F]."""
    system = parse("axiom: F\nF -> F[+F]F[-F][F]  # a comment")
    assert text(expand(system, 1, dice())) == "F[+F]F[-F][F]"
    assert [text(expand(system, n, dice())).count("F") for n in range(4)] == [1, 5, 25, 125]
    broken = parse("axiom: F\nF -> F[  # goes on\n  +F]F[\n-F][F]")
    assert text(expand(broken, 1, dice())) == "F[+F]F[-F][F]"


def test_parametric_system_is_rewritten() -> None:
    """Figure 1.9 of the book: B(2)A(4,4) and its first steps, y + x instead of y * x."""
    system = parse(
        """
        axiom: B(2) A(4, 4)
        A(x, y) : y <= 3 -> A(x * 2, x + y)
        A(x, y) : y > 3 -> B(x) A(x / y, 0)
        B(x) : x < 1 -> C
        B(x) : x >= 1 -> B(x - 1)
        C -> C
        """
    )
    steps = [text(expand(system, n, dice())) for n in range(5)]
    assert steps == [
        "B(2)A(4,4)",
        "B(1)B(4)A(1,0)",
        "B(0)B(3)A(2,1)",
        "CB(2)A(4,3)",
        "CB(1)A(8,7)",
    ]


def test_stochastic_rules_follow_weights_and_seed() -> None:
    system = parse("axiom: A; A -> AA; A @ 0 -> F")
    assert text(expand(system, 3, dice())) == "AAAAAAAA"
    system = parse("n = 30; axiom: X(n); X(k) : k > 0 -> A X(k - 1); A @ 3 -> F; A @ 1 -> f; X(k) : k <= 0 ->")
    once = text(expand(system, 40, dice()))
    assert once == text(expand(system, 40, dice()))
    assert once != text(expand(system, 40, dice("y")))
    many = parse("axiom: " + "A" * 400 + "; A @ 3 -> F; A @ 1 -> f")
    assert 0.68 < text(expand(many, 1, dice())).count("F") / 400 < 0.82


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("1 + 2 * 3 - 4 / 2", 5),
        ("2 - 3 - 4", -5),
        ("-2 ^ 2", -4),
        ("(1 + 2) ^ 3 % 4", 3),
        ("-7 % 3", 2),
        ("1 < 2 & 2 < 1 | !0", 1),
        ("min(3, 2, 4) + max(1, 5) + abs(-1) + sqrt(9) + floor(-0.5) + round(0.5)", 11),
        ("a * 2 >= b", 1),
        ("1e3 + .5", 1000.5),
    ],
)
def test_expressions_are_evaluated(text: str, value: float) -> None:
    assert number(text, a=2, b=4) == value


def test_random_number_is_within_its_bounds() -> None:
    drawn = [_expressions.parse("rand(2, 3)", frozenset(), "x")({}, dice(str(k))) for k in range(50)]
    assert 2 <= min(drawn) < 2.2
    assert 2.8 < max(drawn) < 3


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("__import__('os')", "not part of"),
        ("a.b", "not part of|unexpected"),
        ("c", "unknown name 'c'; available: a"),
        ("1 +", "ends too early"),
        ("(1", r"missing '\)' at the end"),
        ("1 2", "unexpected"),
        ("a ^ 99", "from 0 to 16"),
        ("2 ^ a", "from 0 to 16"),
        ("(" * 100 + "1" + ")" * 100, "deeper than 32 levels"),
        ("!" * 200 + "1", "deeper than 32 levels"),
        ("-" * 200 + "1", "deeper than 32 levels"),
        ("+".join("1" * 300), "more than"),
        ("sqrt(1, 2)", "takes 1 values, got 2"),
        ("", "missing"),
    ],
)
def test_invalid_expressions_raise(text: str, reason: str) -> None:
    with pytest.raises(Invalid, match=reason) as refused:
        number(text, a=2)
    assert refused.value.problems[0].where == "here"


@pytest.mark.parametrize("text", ["1 / 0", "sqrt(0 - 1)", "9999 ^ 16", "5 % 0", "1e300 * 1e300 * 0"])
def test_uncomputable_expressions_raise(text: str) -> None:
    with pytest.raises(CannotGenerate, match="cannot be computed"):
        number(text)


@pytest.mark.parametrize(
    ("rules", "reason"),
    [
        ("F -> FF", "missing axiom"),
        ("axiom: A", "no rule for A"),
        ("axiom: A(1); A -> F", "A takes 0 values, got 1"),
        ("axiom: F(1, 2, 3)", "F takes 0 to 2 values, got 3"),
        ("axiom: [F", r"\[ without \]"),
        ("axiom: F]", r"\] without \["),
        ("axiom: F; F -> F(", r"missing \)"),
        ("axiom: F; F -> G*", "unknown symbol"),
        ("axiom: F; AB -> F", "is not a symbol with names"),
        ("axiom: F; A(x, x) -> F", "different names"),
        ("axiom: F; A(x) : x > y -> F", "unknown name 'y'"),
        ("axiom: F; axiom: f", "duplicate axiom"),
        ("k = 1; k = 2; axiom: F", "duplicate constant"),
        ("k = rand(0, 1); axiom: F", "must not be random"),
        ("axiom: F; what is this", "is not a statement"),
        ("axiom: " + "F" * 600, "more than 500 symbols"),
        ("axiom: F\n" * 201, "duplicate axiom|the limit is 200"),
        ("#" * 20_001, "the limit is 20000"),
    ],
)
def test_invalid_lsystem_rules_raise(rules: str, reason: str) -> None:
    with pytest.raises(Invalid, match=reason):
        parse(rules)


def test_exploding_system_raises_while_it_grows() -> None:
    with pytest.raises(CannotGenerate, match="more than 100000 symbols after 3 of 40 rounds") as stopped:
        expand(parse("axiom: F; F -> " + "F" * 40), 40, dice())
    assert stopped.value.problems[0].where == "rules"
    with pytest.raises(CannotGenerate, match="has taken 2500000 symbols"):
        expand(parse("axiom: " + "A" * 450 + "; A -> B" + "F" * 199 + "; B -> B"), 40, dice())
    with pytest.raises(CannotGenerate, match="20000 branches"):
        draw(
            expand(parse("axiom: " + "F" * 300 + "; F -> " + "F" * 100), 1, dice()), angle=20, length=0.001, radius=0.01
        )
    with pytest.raises(CannotGenerate, match="200 nested brackets"):
        draw([("[", ())] * 300, angle=20, length=1, radius=0.01)
    with pytest.raises(CannotGenerate, match="more than 1000 m"):
        draw([("F", (2000.0,))], angle=20, length=1, radius=0.01)


def test_turtle_turns_as_specified() -> None:
    """From looking up (z) with its left side to -x: left, then down, gives -x and z again, by the right-hand rule."""

    def end(*symbols: _lsystem.Symbol) -> tuple[float, ...]:
        at = draw([*symbols, ("F", (1.0,))], angle=90.0, length=1.0, radius=0.1).branches[-1][1]
        return tuple(round(v, 9) + 0.0 for v in at)

    assert end() == (0, 0, 1)
    assert end(("+", ())) == (-1, 0, 0)
    assert end(("-", ())) == (1, 0, 0)
    assert end(("&", ())) == (0, 1, 0)
    assert end(("^", ())) == (0, -1, 0)
    assert end(("|", ())) == (0, 0, -1)
    assert end(("/", ()), ("&", ())) == (-1, 0, 0)
    assert end(("\\", ()), ("&", ())) == (1, 0, 0)
    assert end(("+", (90.0,)), ("-", (90.0,))) == (0, 0, 1)
    assert end(("&", (60.0,)), ("/", (30.0,)), ("$", ()), ("+", ())) == (-1, 0, 0)
    assert end(("[", ()), ("+", ()), ("F", ()), ("]", ())) == (0, 0, 1)


@pytest.mark.parametrize("name", sorted(_plants.SPECIES))
def test_species_grow_into_valid_meshes(name: str) -> None:
    first, second = _plants.grow_plants(name, 2, DICE)
    again = _plants.grow_plants(name, 2, DICE)
    assert first == again[0]
    assert first.files != second.files
    radius, length = first.body
    assert 0 < radius < first.spread + 0.1
    assert 0 < length <= first.height
    wood = first.files[first.meshes[0][0]]
    mesh = read_mesh(wood, "wood.obj")
    assert mesh.names[-1][0] == "wood"
    a, b, c = np.moveaxis(mesh.triangles(), 1, 0)
    volume = float((a * np.cross(b, c)).sum()) / 6
    assert volume > 0, "seen from outside, corners run counter-clockwise"
    assert volume < np.pi * radius**2 * first.height * 4
    assert float(mesh.vertices[:, 2].max()) <= first.height
    assert sum(map(len, first.files.values())) < 400_000


def test_plants_of_same_seed_have_same_bytes() -> None:
    (plant,) = _plants.grow_plants("apple", 1, DICE)
    digest = hashlib.sha256(b"".join(data for _, data in sorted(plant.files.items()))).hexdigest()
    assert digest == DIGEST


DIGEST = "d4c25de96f8b825d48eafef0b1d15d4ede36b44fc683286ee55328b8fb47faae"

"""Convert coordinate texts to arrays: all of a document at once, irregular ones one by one."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.errors import Problem, UnreadableFile

_BLANK, _CUT, _COMMA, _DIGIT, _OTHER = range(5)
_CLASSES = bytearray([_OTHER] * 256)
for _byte in b" \t\r\n":
    _CLASSES[_byte] = _BLANK
for _byte in b"0123456789+-.eE":
    _CLASSES[_byte] = _DIGIT
_CLASSES[ord(",")], _CLASSES[ord(";")] = _COMMA, _CUT
_SPACES = bytes.maketrans(b",;", b"  ")


@dataclass(frozen=True, slots=True)
class Sequences:
    """k lists of coordinates.

    points: float64 [n, 3], altitude 0 if none is given. start: int [k + 1], index of the first point of each list. odd:
    bool [k], True if a text is not plain tuples of two or three numbers (its list is empty).
    """

    points: NDArray[np.float64]
    start: NDArray[np.int64]
    odd: NDArray[np.bool_]


def parse_coordinates(texts: Sequence[str]) -> Sequences:
    """Parse all coordinate texts at once; irregular ones are marked, not rejected."""
    joined = ";".join(texts).encode() + b";"
    classes = joined.translate(_CLASSES)
    kind = np.frombuffer(classes, np.uint8)
    cuts = np.flatnonzero(kind == _CUT)
    if len(cuts) != len(texts):
        return _parse_each(texts)
    odd = np.zeros(len(texts), bool)
    inside = kind >= _COMMA
    begins = np.flatnonzero(inside[1:] > inside[:-1]) + 1
    if inside[0]:
        begins = np.concatenate([[0], begins])
    commas = np.flatnonzero(kind == _COMMA)
    # Commas before the n-th tuple begins: their differences are the commas within each.
    size = np.diff(np.searchsorted(commas, begins), append=len(commas)) + 1
    strange = begins[(size != 2) & (size != 3)]
    if len(strange):
        odd[np.searchsorted(cuts, strange)] = True
    # A comma needs a number on either side; other characters are no numbers.
    alone = commas[(kind[commas + 1] != _DIGIT) | (kind[commas - 1] != _DIGIT)]
    odd[np.searchsorted(cuts, alone)] = True
    if bytes([_OTHER]) in classes:
        odd[np.searchsorted(cuts, np.flatnonzero(kind == _OTHER))] = True
    if odd.any():
        plain = parse_coordinates(["" if bad else t for t, bad in zip(texts, odd.tolist(), strict=True)])
        return Sequences(plain.points, plain.start, odd | plain.odd)
    try:
        values = np.array(list(map(float, joined.translate(_SPACES).split())), np.float64)
    except ValueError:
        return _parse_each(texts)
    if len(values) == 3 * len(begins) and (size == 3).all():
        points = values.reshape(-1, 3)
    else:
        points = np.zeros((len(begins), 3))
        first = np.cumsum(size) - size
        points[:, 0], points[:, 1] = values[first], values[first + 1]
        deep = size == 3
        points[deep, 2] = values[first[deep] + 2]
    start = np.concatenate([[0], np.searchsorted(begins, cuts)])
    return Sequences(points, start, odd)


def parse_two_way_rings(parsed: Sequences, rings: Sequence[int]) -> Sequences:
    """Give rings of three points a fourth one, as few as a ring can have, by repeating their second point.

    Such a ring is an edge drawn as an area: there and back.
    """
    times = np.ones(len(parsed.points), np.int64)
    times[parsed.start[list(rings)] + 1] = 2
    before = np.concatenate([[0], np.cumsum(times)])
    return Sequences(np.repeat(parsed.points, times, axis=0), before[parsed.start], parsed.odd)


def _parse_each(texts: Sequence[str]) -> Sequences:
    """Parse the texts one by one, if an irregular one prevents parsing all at once."""
    if len(texts) == 1:
        return Sequences(np.empty((0, 3)), np.zeros(2, np.int64), np.ones(1, bool))
    each = [parse_coordinates([t]) for t in texts]
    start = np.concatenate([[0], np.cumsum([len(s.points) for s in each])])
    return Sequences(np.concatenate([s.points for s in each]), start, np.concatenate([s.odd for s in each]))


_SPACED_COMMA = re.compile(r"[ \t\r\n]*,[ \t\r\n]*")
PLAIN_NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?\Z")


def parse_lenient_tuples(text: str, line: int | None) -> list[tuple[float, float, float]]:
    """Parse coordinates as Google Earth does: spaces around commas, a stray comma, and a,b,c,d,e,f without spaces.

    Tuples of one number are skipped. Raises UnreadableFile for anything but numbers.
    """
    out = []
    for token in _SPACED_COMMA.sub(",", text).split():
        parts = [p for p in token.split(",") if p]
        for p in parts:
            if not PLAIN_NUMBER.match(p):
                raise UnreadableFile(
                    f"{p[:40]!r} is not a coordinate", [with_line(f"{p[:40]!r} is not a number", line)]
                )
        values = [float(p) for p in parts]
        step = 3 if len(values) % 3 == 0 else len(values) if len(values) == 2 else 0
        if step:
            out += [parse_point(values[k : k + step], line) for k in range(0, len(values), step)]
    return out


def parse_point(values: Sequence[float], line: int | None) -> tuple[float, float, float]:
    """Return longitude, latitude and altitude (0 if none is given). Raises UnreadableFile if not on earth."""
    x, y, z = (*values, 0.0, 0.0)[:3]
    if not (abs(x) <= 180.0 and abs(y) <= 90.0 and math.isfinite(z)):
        raise UnreadableFile(f"the coordinates {x:g},{y:g} are not on earth", [off_earth_problem(x, y, line)])
    return x, y, z


def off_earth_problem(x: float, y: float, line: int | None) -> Problem:
    """Describe a position that is not on earth."""
    return with_line(f"longitude {x:g}, latitude {y:g}: must be finite, within ±180 and ±90 degrees", line)


def with_line(problem: str, line: int | None) -> Problem:
    """Build a problem with the line of the file, if known."""
    return Problem(problem, line=line)


def parse_floats(texts: Sequence[str], line: int | None) -> list[float]:
    """Parse numbers as XML writes them. Raises UnreadableFile for other texts."""
    for t in texts:
        if not PLAIN_NUMBER.match(t.strip()):
            raise UnreadableFile(f"{t[:40]!r} is not a number", [with_line(f"{t[:40]!r} is not a number", line)])
    return [float(t) for t in texts]

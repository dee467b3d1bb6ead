"""Number the distinct keys and values of many features' properties while they are MessagePack: as arrays, not objects.

20 000 edges have some 100 000 properties: unpacked, looked up in dictionaries and encoded one by one, they take four
times as long. Maps of single values are read here; others are given unpacked.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import ormsgpack
from numpy.typing import NDArray

Integers = NDArray[np.int64]
Marks = NDArray[np.bool_]
Words = NDArray[np.uint64]
Value = str | bool | int | float
Added = tuple[str, Sequence[str], Integers]
"""Key, texts, and the index of each feature's text."""

MAX_PAIRS: Final = 64
"""Maximum number of properties of a map that is read here: each takes a step for all maps."""

MAX_TEXT: Final = 256
"""Maximum bytes of a text that is compared by words; longer ones one by one."""

_MASKS: Final = np.array([2 ** (8 * size) - 1 for size in range(9)], np.uint64)
_FACTOR: Final = np.uint64(0x9E3779B97F4A7C15)
_SHIFT: Final = np.uint64(29)


def _heads() -> tuple[Integers, Integers]:
    """Return for each first byte how long a value is with it and how much of it is before a text; 0 if not single."""
    sizes, texts = np.zeros(256, np.int64), np.zeros(256, np.int64)
    sizes[:0x80] = sizes[0xE0:] = sizes[0xC2:0xC4] = 1  # small integers, false and true
    for first, size in ((0xCB, 9), (0xCC, 2), (0xCD, 3), (0xCE, 5), (0xCF, 9), (0xD0, 2), (0xD1, 3), (0xD2, 5),
                        (0xD3, 9)):  # fmt: skip
        sizes[first] = size
    sizes[0xA0:0xC0] = np.arange(1, 33)
    texts[0xA0:0xC0] = 1
    sizes[0xD9], texts[0xD9] = 2, 2  # and as many bytes as the next byte says
    return sizes, texts


_SIZES, _TEXTS = _heads()


@dataclass(frozen=True, slots=True, eq=False)
class Spans:
    """Places of texts (UTF-8) and of other values (MessagePack) in bytes."""

    starts: Integers
    lengths: Integers
    texts: Marks

    @classmethod
    def of(cls, count: int) -> Spans:
        """Return spans to set."""
        return cls(np.zeros(count, np.int64), np.zeros(count, np.int64), np.ones(count, bool))

    def only(self, chosen: Integers | Marks) -> Spans:
        """Return some of them."""
        return Spans(self.starts[chosen], self.lengths[chosen], self.texts[chosen])

    def put(self, at: Integers | int, starts: Integers | int, lengths: Integers | int, texts: Marks | bool) -> None:
        """Set some of them."""
        self.starts[at], self.lengths[at], self.texts[at] = starts, lengths, texts

    def slices(self, data: bytes) -> list[bytes]:
        """Return their bytes."""
        return [data[a:b] for a, b in zip(self.starts.tolist(), (self.starts + self.lengths).tolist(), strict=True)]


@dataclass(frozen=True, slots=True, eq=False)
class Numbered:
    """Distinct keys and values of features in the order of their first occurrence.

    Attributes:
        data: what has the keys and values.
        tags: int64 [n, 2], indices of keys and values. starts: [features + 1], of each feature in ``tags``.
    """

    data: bytes
    keys: Spans
    values: Spans
    tags: Integers
    starts: Integers


@dataclass(frozen=True, slots=True, eq=False)
class PackedMaps:
    """Maps in MessagePack, one after the other, and where their keys and values are.

    Attributes:
        data: the maps, and 8 bytes more.
        counts: properties of each. single: which maps are read: others have nested or missing values, or too many.
    """

    data: bytes
    counts: Integers
    single: Marks
    steps: Sequence[tuple[Integers, Spans, Spans]]
    """For the first, second … property: maps that have it, keys, values."""

    def with_key(self, name: str) -> Marks:
        """Mark the maps that have a key of at most 8 bytes."""
        sought = name.encode()
        word = np.uint64(int.from_bytes(sought, "little"))
        words = _words(self.data)
        out = np.zeros(len(self.counts), bool)
        for maps, keys, _ in self.steps:
            some = np.flatnonzero(keys.lengths == len(sought))
            out[maps[some]] |= words[keys.starts[some]] & _MASKS[len(sought)] == word
        return out


def _words(data: bytes) -> Words:
    """Return the 8 bytes from each byte on; the last 8 have none."""
    return np.ndarray((max(len(data) - 8, 0),), "<u8", data, strides=(1,))


def read_maps(packed: Sequence[bytes]) -> PackedMaps:
    """Find the keys and values of maps, all maps at once."""
    data = b"".join([*packed, bytes(8)])
    raw = np.frombuffer(data, np.uint8)
    sizes = np.fromiter(map(len, packed), np.int64, len(packed))
    places = np.cumsum(sizes) - sizes
    first = raw[places].astype(np.int64)
    large = first == 0xDE
    counts = np.where(large, raw[places + 1].astype(np.int64) << 8 | raw[places + 2], first & 0xF)
    single = (large | (first & 0xF0 == 0x80)) & (counts <= MAX_PAIRS)
    places += np.where(large, 3, 1)
    columns = []
    for number in range(int(counts[single].max(initial=0))):
        maps = np.flatnonzero(single & (counts > number))
        keys, at = _read(raw, places[maps])
        values, at = _read(raw, at)
        places[maps] = at
        single[maps[(keys.lengths < 0) | (values.lengths < 0) | ~keys.texts]] = False
        columns.append((maps, keys, values))
    steps = [(maps[single[maps]], keys.only(single[maps]), values.only(single[maps])) for maps, keys, values in columns]
    return PackedMaps(data, counts, single, steps)


def _read(raw: NDArray[np.uint8], places: Integers) -> tuple[Spans, Integers]:
    """Read a value at each place; length -1 if it is not single. Returns also the places behind them."""
    places = np.minimum(places, len(raw) - 2)  # behind what is not single anything may follow
    first = raw[places]
    sizes, heads = _SIZES[first], _TEXTS[first]
    sizes = sizes + np.where(first == 0xD9, raw[places + 1], 0)
    return Spans(places + heads, np.where(sizes > 0, sizes - heads, -1), heads > 0), places + sizes


class _Tail:
    """Bytes after the maps: of what is added to them."""

    def __init__(self, data: bytes) -> None:
        self.size = len(data) - 8
        self.parts = [data[: self.size]]

    def add(self, more: bytes) -> int:
        """Add bytes; returns their start."""
        self.parts.append(more)
        self.size += len(more)
        return self.size - len(more)


def number(maps: PackedMaps, added: Sequence[Added], others: Mapping[int, Mapping[str, Value]]) -> Numbered:
    """Number the properties of features.

    Args:
        maps: of all features.
        added: further properties of the features that are not in ``others``.
        others: all properties of the features that are not ``single``, or that differ otherwise.
    """
    fast = np.ones(len(maps.counts), bool)
    fast[list(others)] = False
    counts = maps.counts + len(added)
    counts[list(others)] = [len(members) for members in others.values()]
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
    keys, values = (Spans.of(int(starts[-1])) for _ in range(2))
    columns = []
    for step, (rows, key, value) in enumerate(maps.steps):
        columns.append(starts[rows[fast[rows]]] + step)
        for spans, source in ((keys, key.only(fast[rows])), (values, value.only(fast[rows]))):
            spans.put(columns[-1], source.starts, source.lengths, source.texts)
    tail = _Tail(maps.data)
    rows = np.flatnonzero(fast)
    for step, (name, texts, index) in enumerate(added):
        columns.append(starts[rows] + maps.counts[rows] + step)
        keys.put(columns[-1], tail.add(name.encode()), len(name.encode()), True)
        lengths = _byte_lengths(texts)
        begin = tail.add("".join(texts).encode())
        chosen = index[rows]
        values.put(columns[-1], (begin + np.cumsum(lengths) - lengths)[chosen], lengths[chosen], True)
    for row, members in others.items():
        for place, (name, one) in enumerate(members.items(), start=int(starts[row])):
            text = one.encode() if isinstance(one, str) else ormsgpack.packb(one)
            keys.put(place, tail.add(name.encode()), len(name.encode()), True)
            values.put(place, tail.add(text), len(text), isinstance(one, str))
    data = b"".join([*tail.parts, bytes(8)])
    (key_tags, first_keys), (value_tags, first) = (_distinct(data, spans, columns) for spans in (keys, values))
    return Numbered(data, keys.only(first_keys), values.only(first), np.column_stack([key_tags, value_tags]), starts)


def _byte_lengths(texts: Sequence[str]) -> Integers:
    lengths = np.fromiter(map(len, texts), np.int64, len(texts))
    for row, text in () if all(map(str.isascii, texts)) else enumerate(texts):
        lengths[row] = len(text.encode())
    return lengths


def _distinct(data: bytes, spans: Spans, columns: Sequence[Integers]) -> tuple[Integers, Integers]:
    """Number distinct spans in the order of their first occurrence. Returns also their first occurrences.

    columns: ascending places of spans that are probably equal, such as a key, or a text that all features have.
    """
    source = np.arange(len(spans.starts))
    for column in columns:
        if _is_constant(data, spans, column):
            source[column] = column[0]
    rows = np.flatnonzero(source == np.arange(len(source)))
    numbers, first = _numbered(data, spans.only(rows))
    out = np.empty(len(source), np.int64)
    out[rows] = numbers
    return out[source], rows[first]


def _is_constant(data: bytes, spans: Spans, column: Integers) -> bool:
    """Return whether the spans of a column are equal, and short enough to compare by words."""
    lengths = spans.lengths[column]
    if not len(column) or lengths[0] > MAX_TEXT or (lengths != lengths[0]).any():
        return False
    texts, starts, words = spans.texts[column], spans.starts[column], _words(data)
    length = int(lengths[0])
    for offset in range(0, length, 8):
        shown = words[starts + offset] & _MASKS[min(length - offset, 8)]
        if (shown != shown[0]).any():
            return False
    return bool((texts == texts[0]).all())


def _numbered(data: bytes, spans: Spans) -> tuple[Integers, Integers]:
    """Number distinct spans by their hashes."""
    words = _words(data)
    hashes = (spans.lengths << 1 | spans.texts).astype(np.uint64)
    for rows, word in _word_by_word(words, spans):
        mixed = (hashes[rows] ^ word) * _FACTOR
        hashes[rows] = mixed ^ mixed >> _SHIFT
    long = np.flatnonzero(spans.lengths > MAX_TEXT)
    for row, text in zip(long.tolist(), spans.only(long).slices(data), strict=True):
        hashes[row] = np.uint64(hash(text) % 2**64)
    _, first, inverse = np.unique(hashes, return_index=True, return_inverse=True)
    if not _equal(data, spans, first[inverse]):
        return _numbered_slowly(data, spans)
    order = np.argsort(first)
    ranks = np.empty_like(order)
    ranks[order] = np.arange(len(order))
    return ranks[inverse], first[order]


def _word_by_word(words: Words, spans: Spans) -> Iterator[tuple[Integers, Words]]:
    """Yield the spans with a first, second … word of 8 bytes, and the words: long spans not at all."""
    rows = np.flatnonzero(spans.lengths <= MAX_TEXT)
    for start in range(0, MAX_TEXT, 8):
        rows = rows[spans.lengths[rows] > start]
        if not len(rows):
            return
        left = np.minimum(spans.lengths[rows] - start, 8)
        yield rows, words[spans.starts[rows] + start] & _MASKS[left]


def _equal(data: bytes, spans: Spans, others: Integers) -> bool:
    """Return whether each span equals another one of them."""
    if (spans.lengths != spans.lengths[others]).any() or (spans.texts != spans.texts[others]).any():
        return False
    second = spans.only(others)
    words = _words(data)
    pairs = zip(_word_by_word(words, spans), _word_by_word(words, second), strict=True)
    if not all((a == b).all() for (_, a), (_, b) in pairs):
        return False
    long = spans.lengths > MAX_TEXT
    return spans.only(long).slices(data) == second.only(long).slices(data)


def _numbered_slowly(data: bytes, spans: Spans) -> tuple[Integers, Integers]:
    """Number spans of which different ones have the same hash."""
    numbers: dict[tuple[bool, bytes], int] = {}
    first: list[int] = []
    out = np.empty(len(spans.starts), np.int64)
    for row, key in enumerate(zip(spans.texts.tolist(), spans.slices(data), strict=True)):
        if key not in numbers:
            numbers[key] = len(numbers)
            first.append(row)
        out[row] = numbers[key]
    return out, np.array(first, np.int64)

"""JSON as plain values within limits: strict UTF-8, finite numbers, no deep nesting."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import orjson

from app.errors import Problem, TooLarge, UnreadableFile
from app.limits import Limits

_CONTAINERS = (dict, list)

MAX_DEPTH = 128
"""Maximum nesting of arrays and objects. Real files have about ten; recursive parsers fail near a thousand."""


def load(data: bytes, limits: Limits) -> Any:
    """Parse JSON; integers beyond 64 bits become floats. Raises UnreadableFile with the line, or TooLarge."""
    data = data.removeprefix(b"\xef\xbb\xbf")
    if len(data) > limits.text_bytes:
        raise TooLarge(f"the file has {len(data)} bytes; the limit for a text is {limits.text_bytes}")
    try:
        top = orjson.loads(data)
    except orjson.JSONDecodeError as error:
        reason = f"invalid JSON: {error.msg}"
        raise UnreadableFile(reason, [Problem(reason, line=error.lineno)]) from error
    _check_depth(data)
    return top


def _check_depth(data: bytes) -> None:
    """Reject deep nesting of well-formed JSON, by counting brackets outside of strings."""
    plain = re.sub(rb"(?s)\\.", b"  ", data) if b"\\" in data else data
    characters = np.frombuffer(plain, np.uint8)
    in_text = np.bitwise_xor.accumulate((characters == ord('"')).view(np.uint8))
    step = np.zeros(256, np.int8)
    step[[ord("{"), ord("[")]] = 1
    step[[ord("}"), ord("]")]] = -1
    steps = step[characters]
    steps[in_text != 0] = 0
    steps = steps[steps != 0]
    if len(steps) and int(np.cumsum(steps, dtype=np.int64).max()) > MAX_DEPTH:
        reason = f"nested deeper than {MAX_DEPTH} levels"
        raise UnreadableFile(reason, [Problem(reason)])


def rank_keys(keys: str) -> dict[str, int]:
    """Map the words of a text to their positions, for ``sort_keys``."""
    return {key: rank for rank, key in enumerate(keys.split())}


def sort_keys(value: Any, key_ranks: Mapping[str, int]) -> Any:
    """Sort the keys of all objects: ranked keys by their rank, then the others alphabetically.

    Equal values then give equal bytes, in whatever order they were built.
    """
    if isinstance(value, dict):
        last = len(key_ranks)
        keys = sorted(value, key=lambda k: (key_ranks.get(k, last), k))
        # Most values are numbers: a call for each would be half the time of a large network.
        return {k: sort_keys(v, key_ranks) if isinstance(v := value[k], _CONTAINERS) else v for k in keys}
    if isinstance(value, list):
        return [sort_keys(v, key_ranks) if isinstance(v, _CONTAINERS) else v for v in value]
    return value

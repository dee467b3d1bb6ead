"""YAML as plain JSON-like values, read safely and written deterministically: the only way in which formats do it.

``load`` gives None, bool, int (64 bit), finite float, text, list and dict with text keys, and nothing else. What a
plain scalar means follows PyYAML (YAML 1.1), which the robots' own tools use, without its traps:

* dates and times, sexagesimals (``12:30``), numbers with a leading zero (``010``), with underscores (``1_2``) and
  binary ones stay the texts they are; so a node called ``1_2`` is not 12, and ``last_updated`` never becomes a date
* ``1e-05`` is a float although PyYAML takes it for a text (Python and C++ print floats so); ``7e12`` is a text
* keys are the texts as written: ``0``, ``yes`` and ``2022`` are the keys "0", "yes" and "2022"

Two ways lead to the same values: large generated files consist of few different lines in plain block layout, so
``load_lines`` understands each distinct line once and puts the rest together at dictionary speed (several times
faster than any general parser), also collections in flow style that end with their line; whatever it does not know,
and every error, is left to ``load_events``, which builds the values from libyaml's events. Tests hold that both agree.

Refused, each with its line: NaN and infinities, integers beyond 64 bit, duplicate keys, ``<<``, tags other than
YAML's own scalars and collections, ``%TAG``, a second document, nesting deeper than ``Limits.yaml_depth``, more than
``Limits.yaml_nodes`` nodes, aliases that unfold to much more than the file, aliases to a collection that contains them.
A format with tags of its own names their prefixes: mappings and lists so tagged come as ``Tagged``, and ``%TAG`` may
stand for these prefixes.

``text``, ``block`` and ``mapping`` write what readers of YAML 1.1 (PyYAML) and 1.2 (yaml-cpp) take for the same value.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from app.errors import TooLarge
from app.limits import Limits
from app.syntax.yaml.events import load_events
from app.syntax.yaml.lines import NotSimpleError, load_lines
from app.syntax.yaml.scalars import CONSTANTS, PlainScalar, Tagged, scalar, yaml_error
from app.syntax.yaml.writing import block, decimal, mapping, text

__all__ = ["CONSTANTS", "PlainScalar", "Tagged", "block", "decimal", "load", "mapping", "scalar", "text"]


def load(data: bytes, limits: Limits, *, tags: Sequence[str] = (), typed: bool = True) -> Any:
    """The one document of a UTF-8 YAML file as JSON-like values; an empty file is None.

    tags: prefixes of the format's own tags, which collections may carry. typed: whether scalars get their meaning;
    if not, all are texts, those without quotes ``PlainScalar``.
    Values behind aliases, and equal mappings at the end of rows in flow style, are shared objects: do not change them
    in place. Raises UnreadableFile or TooLarge, with line.
    """
    if len(data) > limits.text_bytes:
        raise TooLarge(f"the file has {len(data)} bytes of YAML; the limit is {limits.text_bytes}")
    document = _text(data)
    if tags or not typed:
        return load_events(document, limits, tuple(tags), typed=typed)
    try:
        return load_lines(document, limits)
    except NotSimpleError:
        return load_events(document, limits)


def _text(data: bytes) -> str:
    """Strict UTF-8 without a byte order mark."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise yaml_error(
            f"not UTF-8 text (byte 0x{data[error.start]:02x}); save the file as UTF-8",
            data.count(b"\n", 0, error.start),
        ) from error

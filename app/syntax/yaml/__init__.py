"""Safe YAML reading to JSON-like values and deterministic writing, for all formats.

``load`` returns only None, bool, int (64 bits), finite float, str, list and dict with string keys. Plain scalars are
resolved like PyYAML (YAML 1.1), which the robots' own tools use, except:

* dates and times, sexagesimals (``12:30``), numbers with a leading zero (``010``), with underscores (``1_2``) and
  binary ones stay strings; so a node named ``1_2`` is not 12, and ``last_updated`` never becomes a date
* ``1e-05`` is a float although it is a string for PyYAML (Python and C++ print floats so); ``7e12`` is a string
* keys are strings as written: ``0``, ``yes`` and ``2022`` are the keys "0", "yes" and "2022"

Two parsers return the same values. Large generated files consist of few different lines in plain block layout, so
``load_lines`` parses each distinct line once and assembles the rest at dictionary speed (several times faster than any
general parser), also flow collections that end with their line. It leaves everything else, and every error, to
``load_events``, which builds the values from libyaml's events. Tests verify that both agree.

Rejected, each with its line: NaN and infinities, integers beyond 64 bits, duplicate keys, ``<<``, tags other than
YAML's own scalars and collections, ``%TAG``, a second document, nesting deeper than ``Limits.yaml_depth``, more than
``Limits.yaml_nodes`` nodes, aliases that expand to much more than the file, aliases to a collection that contains them.
A format with tags of its own passes their prefixes: mappings and lists with such tags are returned as ``Tagged``, and
``%TAG`` may abbreviate these prefixes.

``text``, ``block`` and ``mapping`` write YAML with the same value for readers of YAML 1.1 (PyYAML) and 1.2 (yaml-cpp).
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
    """Parse the only document of a UTF-8 YAML file to JSON-like values; an empty file is None.

    tags: prefixes of the format's own tags, which collections may have. typed: whether to resolve scalars; if not, all
    are strings, unquoted ones ``PlainScalar``.
    Values of aliases, and equal mappings at the end of rows in flow style, are shared objects: do not change them in
    place. Raises UnreadableFile or TooLarge, with the line.
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
    """Decode strict UTF-8 and remove a byte order mark."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise yaml_error(
            f"not UTF-8 text (byte 0x{data[error.start]:02x}); save the file as UTF-8",
            data.count(b"\n", 0, error.start),
        ) from error

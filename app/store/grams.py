"""Texts as groups of three characters in a row, by which an index finds any part of a text."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

SEPARATOR: Final = "\n"
"""Character that no searched text has."""

GRAM: Final = 3
"""Number of characters in a group."""

RAREST: Final = 2
"""Number of a text's groups that an index is asked for if it is known how common they are."""

SINGLE, DOUBLE = "'", '"'


def grams(*texts: str) -> list[str]:
    """Return all groups of three characters in a row; line ends let the last characters begin such a group, too."""
    padded = (text + SEPARATOR * (GRAM - 1) for text in texts)
    return sorted({text[k : k + GRAM] for text in padded for k in range(len(text) - GRAM + 1)})


def fold(text: str) -> str:
    """Convert to lower case without changing the number of characters."""
    lower = text.lower()
    if len(lower) != len(text):
        lower = "".join([c.lower() if len(c.lower()) == 1 else c for c in text])
    return lower.replace("ς", "σ")  # the only letter whose lower case depends on its neighbours


def wanted_grams(needle: str, *, sqlite: bool, shares: Mapping[str, float] | None = None) -> str:
    """Return the query of an index of three characters in a row; on PostgreSQL shorter texts are prefixes of three.

    Groups side by side and the last one cover the text; what has them all is compared with it.

    shares: of the texts that have a common group; then only the rarest groups are asked for.
    """
    last = max(0, len(needle) - GRAM)
    windows = sorted({needle[k : k + GRAM] for k in (*range(0, last, GRAM), last)})
    if shares:
        windows = sorted(windows, key=lambda window: shares.get(window, 0.0))[:RAREST]
    if sqlite:
        return " AND ".join(_quoted(window, DOUBLE) for window in windows)
    return " & ".join(_quoted(window, SINGLE) + (":*" if len(window) < GRAM else "") for window in windows)


def _quoted(text: str, quote: str) -> str:
    """Quote a text for a query of the index: quotes, and on PostgreSQL backslashes, are doubled."""
    escaped = text.replace("\\", "\\\\") if quote == SINGLE else text
    return quote + escaped.replace(quote, 2 * quote) + quote

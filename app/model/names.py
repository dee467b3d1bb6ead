"""Names from outside: file names that are safe below a folder, and suggestions for mistyped names."""

from __future__ import annotations

import unicodedata
from collections.abc import Iterable

MAX_NAME = 1024
MAX_DEPTH = 64
"""Maximum length of a path in an archive in characters, and its depth in folders."""


def name_problem(name: str) -> str | None:
    """Return why a relative path must not be used, as a predicate (``it …``), or None."""
    if not name or len(name) > MAX_NAME:
        return f"does not have 1 to {MAX_NAME} characters"
    if "\\" in name:
        return "has a backslash"
    if not name.isprintable() and any(unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp") for c in name):
        return "has control characters"
    if name.startswith("/") or (len(name) > 1 and name[1] == ":"):
        return "is absolute"
    parts = name.removesuffix("/").split("/")
    if len(parts) > MAX_DEPTH:
        return f"is nested in more than {MAX_DEPTH} folders"
    if ".." in parts:
        return "leaves the archive with .."
    if "." in parts or "" in parts:
        return "has an empty or . folder"
    return None


MIN_SIMILARITY = 0.7
"""Minimum similarity, 0 to 1, of a name and the name that it may be mistyped for."""

MAX_COMPARED = 10_000
"""Maximum number of names that a mistyped one is compared with."""


def nearest(name: str, choices: Iterable[str], *, similarity: float = MIN_SIMILARITY) -> str | None:
    """Return the choice most similar to a mistyped name, case-insensitive; None if none is similar."""
    import difflib  # slow to import, and needed for wrong names only

    lowered: dict[str, str] = {}
    for choice in list(choices)[:MAX_COMPARED]:
        lowered.setdefault(choice.lower(), choice)
    matches = difflib.get_close_matches(name[:MAX_NAME].lower(), lowered, n=1, cutoff=similarity)
    return lowered[matches[0]] if matches else None


def did_you_mean(name: str, choices: Iterable[str]) -> str:
    """Return ` (did you mean NAME?)` for an error about an unknown name, or an empty text if none is similar."""
    suggestion = nearest(name, choices)
    return f" (did you mean {suggestion}?)" if suggestion is not None else ""

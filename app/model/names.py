"""Names of files that others have chosen: which of them may be used below a folder."""

from __future__ import annotations

import unicodedata

MAX_NAME = 1024
MAX_DEPTH = 64
"""Longest path in an archive, in characters and in folders."""


def bad_name(name: str) -> str | None:
    """Why a relative path must not be used, or None: said as ``it …``."""
    if not name or len(name) > MAX_NAME:
        return f"has not 1 to {MAX_NAME} characters"
    if "\\" in name:
        return "has a backslash"
    if any(unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp") for c in name):
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

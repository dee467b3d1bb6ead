"""Conditional and partial requests (RFC 9110, sections 8.8, 13 and 14), as pure functions on header values."""

from __future__ import annotations

import re
from dataclasses import dataclass
from urllib.parse import quote

IMMUTABLE = "private, max-age=31536000, immutable"
REVALIDATE = "private, no-cache"

_TAG = re.compile(r'\s*(?:(W/)?("[\x21\x23-\x7e\x80-\xff]*"))\s*(?:,|$)')
_RANGE = re.compile(r"bytes\s*=\s*(.*)", re.IGNORECASE)
_ONE_RANGE = re.compile(r"\s*(\d{0,18})\s*-\s*(\d{0,18})\s*")


def cache_control(version: str | int) -> str:
    """Return ``Cache-Control`` of a version's content: a number never changes; ``private``, since a token is needed."""
    return IMMUTABLE if isinstance(version, int) else REVALIDATE


def none_match(header: str | None, etag: str) -> bool:
    """Test if If-None-Match contains this ETag (weak comparison), so that the response is 304."""
    if header is None:
        return False
    if header == etag or header.strip() == "*":
        return True
    return any(tag == etag for _, tag in _tags(header))


def match(header: str | None, *etags: str) -> bool:
    """Test if If-Match is absent or contains one of these ETags (strong comparison)."""
    if header is None or header.strip() == "*":
        return True
    return any(not weak and tag in etags for weak, tag in _tags(header))


def _tags(header: str) -> list[tuple[bool, str]]:
    """Parse a list of entity tags up to the first malformed one."""
    out, at = [], 0
    while at < len(header) and (tag := _TAG.match(header, at)):
        out.append((bool(tag[1]), tag[2]))
        at = tag.end()
    return out


@dataclass(frozen=True, slots=True)
class Unsatisfiable:
    """Range outside the content, which returns 416."""


def byte_range(
    range_: str | None, if_range: str | None, etag: str, size: int
) -> tuple[int, int] | Unsatisfiable | None:
    """Return the requested half-open range [start, end), or None for the complete content.

    Only a single range is supported: several ranges, other units and malformed ranges return the complete content, as
    RFC 9110 allows. If-Range must be the strong ETag of the current content.
    """
    if range_ is None or (if_range is not None and if_range.strip() != etag):
        return None
    unit = _RANGE.fullmatch(range_.strip())
    one = _ONE_RANGE.fullmatch(unit[1]) if unit else None
    if one is None or not (one[1] or one[2]):
        return None
    if not one[1]:
        length = int(one[2])
        return (max(0, size - length), size) if length and size else Unsatisfiable()
    start = int(one[1])
    end = int(one[2]) + 1 if one[2] else size
    if one[2] and end <= start:
        return None
    return (start, min(end, size)) if start < size else Unsatisfiable()


def content_disposition(name: str) -> str:
    """Format ``attachment`` with a file name for all clients (RFC 6266): ASCII, plus UTF-8 if it differs."""
    base = name.rsplit("/", 1)[-1]
    plain = "".join(c if " " <= c <= "~" and c not in '"\\%' else "_" for c in base) or "file"
    if plain == base:
        return f'attachment; filename="{plain}"'
    return f"attachment; filename=\"{plain}\"; filename*=UTF-8''{quote(base, safe='')}"

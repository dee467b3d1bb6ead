"""Conditional and partial requests (RFC 9110, sections 8.8, 13 and 14), as pure functions on header values."""

from __future__ import annotations

import re
from dataclasses import dataclass
from urllib.parse import quote

_TAG = re.compile(r'\s*(?:(W/)?("[\x21\x23-\x7e\x80-\xff]*"))\s*(?:,|$)')
_RANGE = re.compile(r"bytes\s*=\s*(.*)", re.IGNORECASE)
_ONE_RANGE = re.compile(r"\s*(\d{0,18})\s*-\s*(\d{0,18})\s*")


def none_match(header: str | None, etag: str) -> bool:
    """Whether If-None-Match names this ETag (weak comparison), so that the answer is 304."""
    if header is None:
        return False
    if header == etag or header.strip() == "*":
        return True
    return any(tag == etag for _, tag in _tags(header))


def match(header: str | None, *etags: str) -> bool:
    """Whether If-Match names one of these ETags (strong comparison), or is absent."""
    if header is None or header.strip() == "*":
        return True
    return any(not weak and tag in etags for weak, tag in _tags(header))


def _tags(header: str) -> list[tuple[bool, str]]:
    """The entity tags of a list; what is not one ends it."""
    out, at = [], 0
    while at < len(header) and (tag := _TAG.match(header, at)):
        out.append((bool(tag[1]), tag[2]))
        at = tag.end()
    return out


@dataclass(frozen=True, slots=True)
class Unsatisfiable:
    """A range that lies outside the content: 416."""


def byte_range(
    range_: str | None, if_range: str | None, etag: str, size: int
) -> tuple[int, int] | Unsatisfiable | None:
    """The half-open range [start, end) that a client asks for; None means the whole.

    Only a single range is honoured: several, another unit or a malformed one give the whole, as RFC 9110 allows.
    If-Range holds only with the strong ETag of the present content.
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
    """``attachment`` with a file name that any client understands (RFC 6266): ASCII, and UTF-8 where it differs."""
    base = name.rsplit("/", 1)[-1]
    plain = "".join(c if " " <= c <= "~" and c not in '"\\%' else "_" for c in base) or "file"
    if plain == base:
        return f'attachment; filename="{plain}"'
    return f"attachment; filename=\"{plain}\"; filename*=UTF-8''{quote(base, safe='')}"

"""Check of the prolog of untrusted XML files: no DOCTYPE and no entities."""

from __future__ import annotations

import re

from app.errors import Problem, UnreadableFile

_DOCTYPE = re.compile(rb"<!\s*(DOCTYPE|ENTITY)", re.IGNORECASE)
_PROLOG = re.compile(rb"\s+|<\?.*?\?>|<!--.*?-->", re.DOTALL)
"""Pattern of the prolog before the root element. A DOCTYPE further inside is a text (HTML in a description)."""


def check_prolog(data: bytes) -> None:
    """Reject a DOCTYPE or entity declaration before parsing. Raises UnreadableFile with the line.

    Callers check the parsed document again.
    """
    head = data
    if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
        head = head[: 2**20].decode("utf-16", "replace").encode()
    head = head.lstrip(b"\xef\xbb\xbf")
    at = 0
    while blank := _PROLOG.match(head, at):
        at = blank.end()
    if _DOCTYPE.match(head, at):
        line = head.count(b"\n", 0, at) + 1
        reason = "DOCTYPE and entity declarations are not accepted: remove them"
        raise UnreadableFile(reason, [Problem(reason, line=line)])

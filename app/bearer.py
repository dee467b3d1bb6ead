"""The ``Authorization`` header of a token."""

from __future__ import annotations

from app.errors import Invalid


def authorization(token: str) -> str:
    """Return the header's value, without white space around the token, as files and variables often have it.

    Raises Invalid, without the token, if it has characters that no token has: the HTTP library's error would show it.
    """
    stripped = token.strip()
    if not (stripped and stripped.isascii() and stripped.isprintable() and " " not in stripped):
        raise Invalid("the token is empty or has characters that no token has: copy it again, in one line")
    return f"Bearer {stripped}"

"""Signed links: URLs of maps that work without a token until they expire.

A link is the map's URL with two more query parameters: ``expires`` (seconds since 1970) and ``signature``
(``<environment id>.<HMAC-SHA-256 in base64url>``). The HMAC covers the environment's id, the path, all other parameters
sorted by name, and the expiry. Because of the id a link ends with its environment, even if another environment gets the
same name. The secrets are in a document that only the server reads; all processes share it, and all servers on
PostgreSQL.

A link that was once rejected as expired stays expired, even if the clock is set back: each secret stores the latest
such expiry, and its links that do not expire later are rejected.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import json
import logging
import secrets
import threading
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, replace
from urllib.parse import parse_qsl, urlencode

from app.backends.documents import Document
from app.errors import ExpiredLink, InvalidLink, Unavailable

log = logging.getLogger(__name__)

EXPIRES = "expires"
SIGNATURE = "signature"

SECRET_BYTES = 32
MAX_SECRETS = 16
"""Maximum number of secrets: after more rotations within the life of a link the oldest is dropped."""

MAX_PARAMETERS = 100
_PURPOSE = "fleetmap-link-1"


@dataclass(frozen=True, slots=True)
class SignedAddress:
    """URL with a signature that is not checked yet.

    path: percent-decoded. query: the map's own parameters, percent-encoded, without ``expires`` and ``signature``.
    expires: seconds since 1970.
    """

    path: str
    query: bytes
    expires: int
    signature: str

    @property
    def environment_id(self) -> str:
        """Id of the link's environment, as the link states it."""
        return self.signature.partition(".")[0]


def parse(path: str, query: bytes) -> SignedAddress | None:
    """Parse a signed URL; None for a URL without ``signature``.

    Raises:
        InvalidLink: ``expires`` is missing or no number, a parameter is duplicate, or the query cannot be read.
    """
    if SIGNATURE.encode() + b"=" not in query:
        return None
    try:
        pairs = parse_qsl(query.decode("ascii"), keep_blank_values=True, max_num_fields=MAX_PARAMETERS, errors="strict")
    except ValueError:
        raise InvalidLink(
            "the link's query cannot be read: it must be percent-encoded UTF-8 with at most "
            f"{MAX_PARAMETERS} parameters; use the link exactly as received"
        ) from None
    values = dict(pairs)
    if SIGNATURE not in values:
        return None
    if len(values) != len(pairs):
        raise InvalidLink("the link has a duplicate parameter: use it exactly as received")
    signature, text = values.pop(SIGNATURE), values.pop(EXPIRES, "")
    if not (text.isascii() and text.isdigit() and len(text) <= 12):
        raise InvalidLink(
            "the link has no valid 'expires' (seconds since 1970): use it exactly as received, or request a new one"
        )
    return SignedAddress(path, _canonical(values), int(text), signature)


def sign(secret: bytes, environment_id: str, path: str, parameters: Mapping[str, str], expires: int) -> str:
    """Create the query of a signed link: the parameters sorted by name, the expiry, the signature."""
    query = _canonical(parameters)
    code = _code(secret, environment_id, path, query, expires)
    ending = urlencode({EXPIRES: expires, SIGNATURE: f"{environment_id}.{code}"})
    return f"{query.decode()}&{ending}" if query else ending


def check(keys: list[bytes], address: SignedAddress) -> int:
    """Check a link's signature against each valid secret, in constant time. Returns the index of its secret.

    Raises InvalidLink if it was altered or not created by this server.
    """
    environment_id, _, code = address.signature.partition(".")
    given = code.encode("utf-8", "surrogatepass")
    match_index = -1
    for index, secret in enumerate(keys):
        expected = _code(secret, environment_id, address.path, address.query, address.expires).encode()
        if hmac.compare_digest(expected, given):
            match_index = index
    if match_index < 0:
        raise InvalidLink(
            "the link's signature does not match its URL: it was altered, its secret is no longer valid, or "
            "another server created it; use it exactly as received, or request a new one"
        )
    return match_index


def _canonical(parameters: Mapping[str, str]) -> bytes:
    return urlencode(sorted(parameters.items())).encode()


def _code(secret: bytes, environment_id: str, path: str, query: bytes, expires: int) -> str:
    text = json.dumps([_PURPOSE, environment_id, path, query.decode(), expires], separators=(",", ":"))
    digest = hmac.digest(secret, text.encode(), hashlib.sha256)
    return base64.urlsafe_b64encode(digest).rstrip(b"=").decode()


@dataclass(frozen=True, slots=True)
class _Secret:
    """Secret of links.

    until: end of the validity of its links, in seconds since 1970; None for the newest. over: latest expiry of its
    links that were rejected as expired.
    """

    value: bytes
    until: float | None
    over: float = 0.0


class LinkSecrets:
    """Secrets in a document that all processes share; created on first use. Thread-safe.

    former: document whose secrets the first server takes over, so that existing links stay valid.
    """

    def __init__(self, document: Document, former: Document | None = None) -> None:
        self._document, self._former = document, former
        self._lock = threading.Lock()
        self._cached: tuple[Hashable, list[_Secret]] | None = None

    def newest(self) -> bytes:
        """Return the secret that signs new links."""
        return self._load()[0].value

    def signing(self, now: float, expires: float) -> bytes:
        """Return the secret for a link that expires at ``expires``; a new one if the link would be rejected.

        A new one is needed after the clock was set back. It invalidates all older links.
        """
        newest = self._load()[0]
        if now < expires <= newest.over:
            log.warning("links: clock was set back; secret replaced, all older links are invalid")
            self._update(lambda stored: [_new_secret()] if stored[0].value == newest.value else stored)
        return self.newest()

    def check(self, address: SignedAddress, now: float) -> None:
        """Check a link.

        Raises:
            InvalidLink: it was altered, its secret is no longer valid, or another server created it.
            ExpiredLink: it is genuine, but has expired, or was once rejected as expired.
        """
        secrets = self._valid(now)
        secret = secrets[check([s.value for s in secrets], address)]
        if now < address.expires and secret.over < address.expires:
            return
        if secret.over < address.expires:
            self._change(lambda s: replace(s, over=max(s.over, address.expires)) if s.value == secret.value else s)
        raise ExpiredLink("the link has expired: request a new one")

    def valid(self, now: float) -> list[bytes]:
        """List the secrets whose links are still accepted, newest first."""
        return [s.value for s in self._valid(now)]

    def rotate(self, now: float, seconds: float) -> None:
        """Sign with a new secret from now on; the old one stays valid for ``seconds``, until its links have ended."""

        def change(stored: list[_Secret]) -> list[_Secret]:
            old = [replace(s, until=now + seconds) if s.until is None else s for s in stored]
            valid_secrets = [s for s in old if s.until is not None and now < s.until]
            return [_new_secret(), *valid_secrets][:MAX_SECRETS]

        self._update(change)

    def _valid(self, now: float) -> list[_Secret]:
        """Return the valid secrets and delete expired ones, so that no change of the clock makes them valid again."""
        stored_secrets = self._load()
        if any(s.until is not None and s.until <= now for s in stored_secrets):
            self._change(lambda s: s if s.until is None or now < s.until else None)
        return [s for s in stored_secrets if s.until is None or now < s.until]

    def _change(self, change: Callable[[_Secret], _Secret | None]) -> None:
        """Update or delete each stored secret. A failed write is only logged: the next check repeats it."""
        try:
            self._update(lambda stored: [changed for s in stored if (changed := change(s)) is not None])
        except (OSError, Unavailable) as error:
            reason = error.detail if isinstance(error, Unavailable) else error.strerror
            log.warning("links: storing an expiry failed, will retry (reason=%s)", reason)

    def _load(self) -> list[_Secret]:
        with self._lock:
            stamp = self._document.stamp()  # before reading: a concurrent change is then read again
            if self._cached is None or self._cached[0] != stamp:
                content = self._document.read()
                if content is None:
                    content = self._document.update(lambda present: present or self._first())
                    stamp = self._document.stamp()
                self._cached = (stamp, _unpack(content))
            return self._cached[1]

    def _update(self, change: Callable[[list[_Secret]], list[_Secret]]) -> None:
        self._document.update(lambda content: _pack(change(_unpack(content or self._first()))))
        self._cached = None

    def _first(self) -> bytes:
        return (self._former.read() if self._former is not None else None) or _pack([_new_secret()])


def _unpack(content: bytes) -> list[_Secret]:
    lines = json.loads(content)
    return [_Secret(base64.b64decode(line["secret"]), line["until"], line.get("over", 0.0)) for line in lines]


def _pack(lines: list[_Secret]) -> bytes:
    body = [{"secret": base64.b64encode(s.value).decode(), "until": s.until, "over": s.over} for s in lines]
    return json.dumps(body, indent=1).encode()


def _new_secret() -> _Secret:
    return _Secret(secrets.token_bytes(SECRET_BYTES), None)

"""Signed links: detection in requests, verification and creation."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from urllib.parse import quote

from starlette.types import Scope

from app import links
from app.api.http.auth import Authenticator, Principal, environment_in_path
from app.api.http.responses import API
from app.errors import Invalid, InvalidLink, NotFound, Problem
from app.links import LinkSecrets, SignedAddress
from app.store.values import Environment

MAP_PATH = re.compile(
    rf"(?:/maps/(?P<short>[^/]+)|{API}/environments/(?P<long>[^/]+)/versions/(?P<version>[^/]+)/maps)"
    r"/(?P<format>[^/]+)(?:/(?P<file>.+))?",
    re.DOTALL,
)
"""Pattern of the two URLs of a map."""

LINK = "link"
"""Id and name of the principal of a signed link, and the key of the link in a request's state."""


def request_link(scope: Scope) -> SignedAddress | None:
    """Return the signed link of a request, or None. Links are valid for maps only, and for reading only.

    Raises InvalidLink if the query has a signature but is malformed.
    """
    query: bytes = scope["query_string"]
    if b"signature=" not in query or scope["method"] != "GET" or MAP_PATH.fullmatch(scope["path"]) is None:
        return None
    return links.parse(scope["path"], query)


@dataclass(frozen=True, slots=True)
class Grant:
    """Created link. url: without scheme and host."""

    url: str
    expires: datetime


class SignedLinks:
    """Creation and verification of signed links.

    max_seconds: maximum lifetime of a link. find: returns an environment by name; raises NotFound.
    """

    def __init__(
        self,
        secrets: LinkSecrets,
        access: Authenticator,
        find: Callable[[str], Environment],
        max_seconds: int,
        clock: Callable[[], float] = time.time,
    ) -> None:
        self._secrets, self._access, self._find, self._clock = secrets, access, find, clock
        self.max_seconds = max_seconds

    def check_life(self, seconds: int | None) -> None:
        """Raise Invalid if a lifetime exceeds the maximum."""
        if seconds is not None and seconds > self.max_seconds:
            limit = f"at most {self.max_seconds} (FLEETMAP_LINK_SECONDS)"
            raise Invalid(f"seconds must be {limit}, got {seconds}", [Problem(f"must be {limit}", where="seconds")])

    def create(
        self, environment: Environment, path: str, parameters: Mapping[str, str], seconds: int, creator: Principal
    ) -> Grant:
        """Create a link to a map's path (percent-decoded). It expires with its creator's token at the latest."""
        now = self._clock()
        expires = int(now) + min(seconds, self.max_seconds)
        if creator.expires is not None:
            expires = min(expires, int(creator.expires.timestamp()))
        query = links.sign(self._secrets.signing(now, expires), environment.id, path, parameters, expires)
        return Grant(f"{quote(path, safe='/')}?{query}", datetime.fromtimestamp(expires, UTC))

    def check(self, address: SignedAddress, client: str | None) -> Principal:
        """Verify a link; return its principal, which may read the linked map.

        Reads the store, so call it from a thread.

        A valid link is accepted even from an address with too many failures, because links cannot be guessed.

        Raises:
            InvalidLink: the signature is wrong (counted like a wrong token), or the environment was deleted.
            ExpiredLink: the link has expired.
            Throttled: the signature is wrong, after too many failures from this address.
        """
        now = self._clock()
        try:
            self._secrets.check(address, now)
        except InvalidLink:
            self._access.note_failure(client)
            raise
        name = environment_in_path(address.path) or ""
        try:
            environment = self._find(name)
        except NotFound:
            environment = None
        if environment is None or environment.id != address.environment_id:
            raise InvalidLink(
                f"the environment of this link was deleted or renamed ({name[:80]!r}): request a new link"
            )
        return Principal(LINK, LINK, "viewer", name, None, datetime.fromtimestamp(address.expires, UTC))

    def rotate(self) -> None:
        """Sign links with a new secret; existing links stay valid until they expire."""
        self._secrets.rotate(self._clock(), self.max_seconds)

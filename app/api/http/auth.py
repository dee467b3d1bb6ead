"""Who may do what: bearer tokens, roles, environments by name pattern, and a brake on guessing.

Default is no: the guard in front of all routes asks for a token at every address that is not listed as open, and for
the environment that stands in the address; each route declares the role it takes.
"""

from __future__ import annotations

import hashlib
import ipaddress
import re
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import UTC, datetime
from fnmatch import fnmatchcase
from typing import Annotated, Any, Literal
from urllib.parse import urlsplit

from fastapi import Depends, Request
from starlette.types import Scope

from app.api.http.problems import Throttled
from app.errors import Denied, Unauthenticated
from app.store.values import Role, Token

RequiredRole = Literal["viewer", "robot", "editor", "admin"]

_CAN: dict[RequiredRole, frozenset[Role]] = {
    "viewer": frozenset({"viewer", "robot", "editor", "admin"}),
    "robot": frozenset({"robot", "editor", "admin"}),
    "editor": frozenset({"editor", "admin"}),
    "admin": frozenset({"admin"}),
}

FRESH_SECONDS = 1.0
"""How long a token is believed without asking the store: one revoked by another process lives that much longer."""

WINDOW_SECONDS = 60.0
MAX_CACHED_TOKENS = 4096
MAX_SOURCES = 10_000
MAX_TOKEN = 512

OPEN = frozenset({"/", "/healthz", "/readyz", "/docs", "/openapi.json"})
"""Addresses that need no token; also all below /docs/ (the pages' own files)."""

PROVE = "prove"
"""In the ``state`` of a request's scope: what to call once the request has shown a valid token or link."""

_LOOPBACK = frozenset({"localhost", "127.0.0.1", "::1"})
_ENVIRONMENT = re.compile(r"/(?:api/v1/environments|maps)/([^/]+)(?:/.*)?", re.DOTALL)


@dataclass(frozen=True, slots=True)
class Principal:
    """Who asks. environments: a name pattern, None for all."""

    id: str
    name: str
    role: Role
    environments: str | None = None
    robot: str | None = None
    expires: datetime | None = None

    @classmethod
    def from_token(cls, token: Token) -> Principal:
        """Who holds this token."""
        return cls(token.id, token.name, token.role, token.environments, token.robot, token.expires)

    def has_expired(self) -> bool:
        """Whether the token or link is over."""
        return self.expires is not None and self.expires <= datetime.now(UTC)

    def has_role(self, need: RequiredRole) -> bool:
        """Whether the role allows it."""
        return self.role in _CAN[need]

    def can_access(self, environment: str) -> bool:
        """Whether the token reaches this environment."""
        return self.environments is None or fnmatchcase(environment, self.environments)

    def require_role(self, need: RequiredRole) -> None:
        """Denied unless the role allows it."""
        if not self.has_role(need):
            takes = " or ".join(sorted(_CAN[need]))
            raise Denied(f"this call takes a token with the role {takes}; yours is {self.role}")

    def require_environment(self, environment: str) -> None:
        """Denied unless the token reaches this environment."""
        if not self.can_access(environment):
            raise Denied(f"your token is limited to the environments {self.environments}")

    def require_all_environments(self) -> None:
        """Denied for tokens that are limited to some environments."""
        if self.environments is not None:
            raise Denied(f"this call takes a token for all environments; yours is limited to {self.environments}")


def authorise(scope: Scope, principal: Principal, environment: str | None) -> None:
    """Let a caller in whose token or link is valid: to the environment of the address, if it speaks of one.

    Raises Denied. The connection counts as proven all the same. What role a call takes is for its route to say.
    """
    prove = scope["state"].get(PROVE)
    if prove is not None:
        prove()
    if environment is not None:
        principal.require_environment(environment)


ANONYMOUS_ADMIN = Principal("", "anonymous", "admin")
"""Everybody, where access control is switched off."""


def is_open(path: str) -> bool:
    """Whether an address needs no token."""
    return path in OPEN or path.startswith("/docs/")


def environment_in_path(path: str) -> str | None:
    """The environment that an address speaks of."""
    match = _ENVIRONMENT.fullmatch(path)
    return match[1] if match else None


class Authenticator:
    """Tokens, looked up in the store and believed for a second. is_invalidated: how often one was revoked here."""

    def __init__(
        self,
        find: Callable[[str], Token | None],
        *,
        failures: int,
        insecure: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._find_token, self._failures, self._clock = find, failures, clock
        self.insecure = insecure
        self._cache: OrderedDict[bytes, tuple[Principal, float]] = OrderedDict()
        self._sources: OrderedDict[str, deque[float]] = OrderedDict()
        self._lock = threading.Lock()
        self.is_invalidated = 0

    def check_origin(self, headers: Iterable[tuple[bytes, bytes]]) -> None:
        """Denied without access control, unless a request names this machine and comes from no other site's page.

        Without tokens a browser must not be led here by a foreign page (DNS rebinding, cross-site requests).
        """
        if not self.insecure:
            return
        values = dict(headers)
        host = urlsplit("//" + values.get(b"host", b"").decode("latin-1")).hostname
        origin = values.get(b"origin")
        if host not in _LOOPBACK or (
            origin is not None and urlsplit(origin.decode("latin-1")).hostname not in _LOOPBACK
        ):
            raise Denied(
                "without access control the server answers only to a loopback name (localhost, 127.0.0.1), and no "
                "pages of other sites"
            )

    def cached_principal(self, header: bytes | None) -> Principal | None:
        """Who sent this Authorization header, if it was checked less than a second ago. Never blocks."""
        if self.insecure:
            return ANONYMOUS_ADMIN
        if header is None:
            return None
        entry = self._cache.get(hashlib.sha256(header).digest())
        return entry[0] if entry is not None and self._clock() < entry[1] else None

    def authenticate(self, header: bytes | None, client: str | None) -> Principal:
        """Who sent this header. Asks the store, so call it from a thread.

        A valid token is accepted also from an address that sent too many wrong ones: many robots share an address.

        Raises Unauthenticated; Throttled for a wrong token after too many from the client's address.
        """
        cached = self.cached_principal(header)
        if cached is not None:
            return cached
        if header is None:
            raise Unauthenticated("this call needs a token: send 'Authorization: Bearer <token>'")
        forgotten = self.is_invalidated
        token = self._find_token(_token(header)) if _token(header) else None
        principal = None if token is None else Principal.from_token(token)
        if principal is None or principal.has_expired():
            self.note_failure(client)
            raise Unauthenticated("the token is unknown or has expired: ask an administrator for a new one")
        with self._lock:
            if forgotten == self.is_invalidated:  # else it may have been revoked while it was looked up
                self._cache[hashlib.sha256(header).digest()] = (principal, self._clock() + FRESH_SECONDS)
            while len(self._cache) > MAX_CACHED_TOKENS:
                self._cache.popitem(last=False)
        return principal

    def invalidate(self) -> None:
        """Ask the store again for every token: one was revoked."""
        with self._lock:
            self.is_invalidated += 1
            self._cache.clear()

    def note_failure(self, client: str | None) -> None:
        """Count a wrong token or signature; Throttled after too many from this address within a minute."""
        source = client_source(client)
        with self._lock:
            now = self._clock()
            times = self._sources.setdefault(source, deque(maxlen=self._failures))
            while times and times[0] < now - WINDOW_SECONDS:
                times.popleft()
            if len(times) >= self._failures:
                raise Throttled(
                    "too many wrong tokens or signatures came from your address: wait a minute, or send a valid token, "
                    "which is accepted at any time"
                )
            times.append(now)
            self._sources.move_to_end(source)
            while len(self._sources) > MAX_SOURCES:
                self._sources.popitem(last=False)


def _token(header: bytes) -> str:
    """The token of ``Bearer <token>``; empty where it is none."""
    scheme, _, text = header.partition(b" ")
    text = text.strip()
    if scheme.lower() != b"bearer" or not text or len(text) > MAX_TOKEN:
        return ""
    try:
        return text.decode("ascii")
    except UnicodeDecodeError:
        return ""


def client_source(client: str | None) -> str:
    """What counts as one source: an IPv4 address (also one mapped into IPv6), the /64 of an IPv6 one."""
    try:
        address = ipaddress.ip_address(client or "")
    except ValueError:
        return client or ""
    if isinstance(address, ipaddress.IPv6Address):
        if address.ipv4_mapped is not None:
            return str(address.ipv4_mapped)
        if not address.is_loopback:
            return str(ipaddress.ip_network((int(address) >> 64 << 64, 64)))
    return str(address)


def is_loopback(source: str) -> bool:
    """Whether a source is this machine itself."""
    return source == "::1" or (source.startswith("127.") and "/" not in source)


@dataclass(frozen=True, slots=True)
class RequireRole:
    """A route's dependency: the caller, who must have at least this role; everywhere: in all environments."""

    need: RequiredRole
    everywhere: bool = False

    async def __call__(self, request: Request) -> Principal:
        """The caller; Denied where the role does not suffice."""
        principal: Any = request.scope.get("state", {}).get("principal")
        if not isinstance(principal, Principal):
            raise Unauthenticated("this call needs a token: send 'Authorization: Bearer <token>'")
        principal.require_role(self.need)
        if self.everywhere:
            principal.require_all_environments()
        return principal


viewer, robot, editor, admin = RequireRole("viewer"), RequireRole("robot"), RequireRole("editor"), RequireRole("admin")

Viewer = Annotated[Principal, Depends(viewer)]
RobotRole = Annotated[Principal, Depends(robot)]
Editor = Annotated[Principal, Depends(editor)]
Admin = Annotated[Principal, Depends(admin)]
ServerViewer = Annotated[Principal, Depends(RequireRole("viewer", everywhere=True))]
ServerAdmin = Annotated[Principal, Depends(RequireRole("admin", everywhere=True))]
"""For what concerns the server itself or all environments: tokens, keys, metrics."""

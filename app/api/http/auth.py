"""Authentication and authorization: bearer tokens, roles, environment name patterns, throttling of failures.

Access is denied by default: the middleware requires a token for every path that is not listed as open, and access to
the environment in the path. Each route declares the role that it requires.
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
"""Seconds for which a checked token is cached; a token revoked by another process stays valid that much longer."""

WINDOW_SECONDS = 60.0
MAX_CACHED_TOKENS = 4096
MAX_SOURCES = 10_000
MAX_TOKEN = 512

OPEN = frozenset({"/", "/icon.svg", "/service-worker.js", "/healthz", "/readyz", "/docs", "/openapi.json"})
"""Paths that need no token, besides all below /docs/ and /assets/ (files of the documentation and of the web page)."""

PROVE = "prove"
"""Key in a request scope's ``state``: callback for the first valid token or link of a connection."""

_LOOPBACK = frozenset({"localhost", "127.0.0.1", "::1"})
_ENVIRONMENT = re.compile(r"/(?:api/v1/environments|maps)/([^/]+)(?:/.*)?", re.DOTALL)


@dataclass(frozen=True, slots=True)
class Principal:
    """Authenticated caller. environments: name pattern, None for all."""

    id: str
    name: str
    role: Role
    environments: str | None = None
    robot: str | None = None
    expires: datetime | None = None

    @classmethod
    def from_token(cls, token: Token) -> Principal:
        """Create the principal of a token."""
        return cls(token.id, token.name, token.role, token.environments, token.robot, token.expires)

    def has_expired(self) -> bool:
        """Test if the token or link has expired."""
        return self.expires is not None and self.expires <= datetime.now(UTC)

    def has_role(self, need: RequiredRole) -> bool:
        """Test if the role includes ``need``."""
        return self.role in _CAN[need]

    def can_access(self, environment: str) -> bool:
        """Test if the token can access this environment."""
        return self.environments is None or fnmatchcase(environment, self.environments)

    def require_role(self, need: RequiredRole) -> None:
        """Raise Denied unless the role includes ``need``."""
        if not self.has_role(need):
            takes = " or ".join(sorted(_CAN[need]))
            raise Denied(f"this call requires the role {takes}; your token has the role {self.role}")

    def require_environment(self, environment: str) -> None:
        """Raise Denied unless the token can access this environment."""
        if not self.can_access(environment):
            raise Denied(f"your token is limited to the environments {self.environments}: use another token")

    def require_all_environments(self) -> None:
        """Raise Denied if the token is limited to some environments."""
        if self.environments is not None:
            raise Denied(f"this call requires a token for all environments; yours is limited to {self.environments}")


def authorise(scope: Scope, principal: Principal, environment: str | None) -> None:
    """Check that an authenticated caller may access the environment of the path, if there is one.

    Raises Denied, but the connection counts as proven anyway. The route checks the role.
    """
    prove = scope["state"].get(PROVE)
    if prove is not None:
        prove()
    if environment is not None:
        principal.require_environment(environment)


ANONYMOUS_ADMIN = Principal("", "anonymous", "admin")
"""Principal of every request if access control is disabled."""


def is_open(path: str) -> bool:
    """Test if a path needs no token."""
    return path in OPEN or path.startswith(("/docs/", "/assets/"))


def environment_in_path(path: str) -> str | None:
    """Return the environment in a path, or None."""
    match = _ENVIRONMENT.fullmatch(path)
    return match[1] if match else None


class Authenticator:
    """Token check with a cache of FRESH_SECONDS. is_invalidated: number of revocations in this process."""

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
        """If access control is disabled, raise Denied unless the request is local and not from another site's page.

        Otherwise another page could make the browser call this server (DNS rebinding, cross-site requests).
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
                "access control is disabled, so requests must use a loopback name (localhost, 127.0.0.1) and "
                "must not come from pages of other sites"
            )

    def cached_principal(self, header: bytes | None) -> Principal | None:
        """Return the cached principal of an Authorization header, or None. Never blocks."""
        if self.insecure:
            return ANONYMOUS_ADMIN
        if header is None:
            return None
        entry = self._cache.get(hashlib.sha256(header).digest())
        return entry[0] if entry is not None and self._clock() < entry[1] else None

    def authenticate(self, header: bytes | None, client: str | None) -> Principal:
        """Authenticate an Authorization header. Reads the store, so call it from a thread.

        A valid token is accepted even from an address with too many failures, because many robots may share an
        address.

        Raises Unauthenticated; Throttled for a wrong token after too many failures from the client's address.
        """
        cached = self.cached_principal(header)
        if cached is not None:
            return cached
        if header is None:
            raise Unauthenticated("missing token: send 'Authorization: Bearer <token>'")
        forgotten = self.is_invalidated
        token = self._find_token(_token(header)) if _token(header) else None
        principal = None if token is None else Principal.from_token(token)
        if principal is None or principal.has_expired():
            self.note_failure(client)
            raise Unauthenticated("unknown or expired token: ask an administrator for a new one")
        with self._lock:
            if forgotten == self.is_invalidated:  # otherwise it may have been revoked during the lookup
                self._cache[hashlib.sha256(header).digest()] = (principal, self._clock() + FRESH_SECONDS)
            while len(self._cache) > MAX_CACHED_TOKENS:
                self._cache.popitem(last=False)
        return principal

    def invalidate(self) -> None:
        """Clear the cache of tokens, because one was revoked."""
        with self._lock:
            self.is_invalidated += 1
            self._cache.clear()

    def note_failure(self, client: str | None) -> None:
        """Count a wrong token or signature. Raises Throttled after too many from this address within a minute."""
        source = client_source(client)
        with self._lock:
            now = self._clock()
            times = self._sources.setdefault(source, deque(maxlen=self._failures))
            while times and times[0] < now - WINDOW_SECONDS:
                times.popleft()
            if len(times) >= self._failures:
                raise Throttled(
                    "too many wrong tokens or signatures from your address: wait a minute, or send a valid "
                    "token, which is always accepted"
                )
            times.append(now)
            self._sources.move_to_end(source)
            while len(self._sources) > MAX_SOURCES:
                self._sources.popitem(last=False)


def _token(header: bytes) -> str:
    """Extract the token of ``Bearer <token>``; empty if the header is malformed."""
    scheme, _, text = header.partition(b" ")
    text = text.strip()
    if scheme.lower() != b"bearer" or not text or len(text) > MAX_TOKEN:
        return ""
    try:
        return text.decode("ascii")
    except UnicodeDecodeError:
        return ""


def client_source(client: str | None) -> str:
    """Reduce a client address to the unit of throttling: an IPv4 address (also mapped into IPv6), or an IPv6 /64."""
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
    """Test if a source is this machine."""
    return source == "::1" or (source.startswith("127.") and "/" not in source)


@dataclass(frozen=True, slots=True)
class RequireRole:
    """Dependency of a route: the caller, with at least this role. everywhere: for all environments."""

    need: RequiredRole
    everywhere: bool = False

    async def __call__(self, request: Request) -> Principal:
        """Return the caller. Raises Denied if the role is not sufficient."""
        principal: Any = request.scope.get("state", {}).get("principal")
        if not isinstance(principal, Principal):
            raise Unauthenticated("missing token: send 'Authorization: Bearer <token>'")
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
"""Roles for calls about the server or all environments: tokens, keys, metrics."""

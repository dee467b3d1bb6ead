"""Authentication and authorization: bearer tokens, sessions, roles, environment patterns, throttling of failures.

Access is denied by default: the middleware requires a token or session for every request that is not listed as open,
and access to the environment in the path. Each route declares the role that it requires.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import ipaddress
import re
import threading
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from fnmatch import fnmatchcase
from ipaddress import IPv4Network, IPv6Network
from typing import Annotated, Any, Literal, NamedTuple, Self
from urllib.parse import urlsplit

from fastapi import Depends, Request
from starlette.types import Scope

from app.api.http.problems import Throttled
from app.clock import seconds_since_boot
from app.errors import Denied, Unauthenticated
from app.store.sessions import Session
from app.store.values import Role, Token, Writer

RequiredRole = Literal["viewer", "robot", "mirror", "editor", "admin"]

_CAN: dict[RequiredRole, frozenset[Role]] = {
    "viewer": frozenset({"viewer", "robot", "mirror", "editor", "admin"}),
    "robot": frozenset({"robot", "editor", "admin"}),
    "mirror": frozenset({"mirror", "admin"}),
    "editor": frozenset({"editor", "admin"}),
    "admin": frozenset({"admin"}),
}

FRESH_SECONDS = 1.0
"""Seconds for which a checked token is cached; a token revoked by another process stays valid that much longer."""

WINDOW_SECONDS = 60.0
MAX_CACHED_TOKENS = 4096
MAX_SOURCES = 10_000
MAX_SHARED = 500
"""Maximum number of networks whose wrong tokens are shared with other servers in one transaction."""

MAX_TOKEN = 512

OPEN = frozenset({"/", "/icon.svg", "/service-worker.js", "/healthz", "/readyz", "/docs", "/openapi.json"})
"""Paths that need no token, besides all below /docs/ and /assets/ (files of the documentation and of the web page)."""

SESSION_PATH = "/api/v1/session"
OPEN_CALLS = frozenset({("POST", SESSION_PATH), ("DELETE", SESSION_PATH)})
"""Calls that need no token, because they start or end a session."""

SAFE_METHODS = frozenset({"GET", "HEAD", "OPTIONS"})
SESSION_COOKIE = "fleetmap_session"
_COOKIE = re.compile(rb"(?:^|;)[ \t]*" + SESSION_COOKIE.encode() + rb"=([A-Za-z0-9_-]{1,128})[ \t]*(?=;|$)")

PROVE = "prove"
"""Key in a request scope's ``state``: callback for the first valid token or link of a connection."""

OGC = "/ogc/"
"""Beginning of the paths that GIS programs use: HTTP Basic is allowed there, with a token as the password."""

BASIC_CHALLENGE = 'Basic realm="Fleet Map Server"'

_BASIC = b"basic "
_LOOPBACK = frozenset({"localhost", "127.0.0.1", "::1"})
_ENVIRONMENT = re.compile(r"/(?:api/v1/environments|maps|ogc)/([^/]+)(?:/.*)?", re.DOTALL)


ShareFailures = Callable[[Mapping[str, int], timedelta], Mapping[str, tuple[int, datetime]]]


class Credentials(NamedTuple):
    """Credentials of a request, before they are checked. A session beside an Authorization header is ignored."""

    authorization: bytes | None
    session: bytes | None = None
    client: str | None = None

    @classmethod
    def from_headers(cls, authorization: bytes | None, cookie: bytes | None, scope: Scope) -> Self:
        """Create the credentials of a request with these headers."""
        client = scope.get("client")
        match = _COOKIE.search(cookie) if cookie is not None and authorization is None else None
        if authorization is not None and scope["path"].startswith(OGC):
            authorization = _basic_as_bearer(authorization)
        return cls(authorization, match[1] if match else None, client[0] if client else None)

    @classmethod
    def from_scope(cls, scope: Scope) -> Self:
        """Create the credentials of a request."""
        headers = dict(scope["headers"])
        return cls.from_headers(headers.get(b"authorization"), headers.get(b"cookie"), scope)

    def digest(self) -> bytes:
        """Return the key of the credentials in a cache."""
        kind, secret = (b"t", self.authorization) if self.authorization is not None else (b"s", self.session)
        return hashlib.sha256(kind + (secret or b"")).digest()


@dataclass(frozen=True, slots=True)
class Principal:
    """Authenticated caller.

    environments: name pattern, None for all. expires: end of the token or link. session_ends: end of a session that is
    not used until then; None without a session.
    """

    id: str
    name: str
    role: Role
    environments: str | None = None
    robot: str | None = None
    expires: datetime | None = None
    session_ends: datetime | None = None

    @classmethod
    def from_token(cls, token: Token, session_ends: datetime | None = None) -> Principal:
        """Create the principal of a token."""
        return cls(token.id, token.name, token.role, token.environments, token.robot, token.expires, session_ends)

    def has_expired(self) -> bool:
        """Test if the token or link has expired."""
        return self.expires is not None and self.expires <= datetime.now(UTC)

    def has_role(self, need: RequiredRole) -> bool:
        """Test if the role includes ``need``."""
        return self.role in _CAN[need]

    def as_writer(self) -> Writer:
        """Return the caller as the writer of drafts."""
        return Writer(self.id, self.name, self.has_role("admin"))

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


ANONYMOUS_VIEWER = Principal("anonymous", "anonymous", "viewer")
"""Principal of readers without credentials from the networks that the operator allows."""


def is_open(path: str, method: str = "GET") -> bool:
    """Test if a request needs no token."""
    return path in OPEN or path.startswith(("/docs/", "/assets/")) or (method, path) in OPEN_CALLS


def check_same_origin(scope: Scope, *, required: bool) -> None:
    """Raise Denied unless a request comes from a page of this server: its browser adds the session by itself.

    The origin is that of the request: scheme and client as trusted proxies report them, and ``Host``.

    Args:
        required: refuse also a request without ``Origin``, unless ``Sec-Fetch-Site`` is ``same-origin``.
    """
    headers = dict(scope["headers"])
    origin = headers.get(b"origin")
    if origin is None:
        if required and headers.get(b"sec-fetch-site") != b"same-origin":
            raise Denied(
                "a change with a session requires the header Origin of this server's own page: use that page, or send "
                "'Authorization: Bearer <token>'"
            )
        return
    expected = f"{scope.get('scheme', 'http')}://{headers.get(b'host', b'').decode('latin-1')}"
    given = origin.decode("latin-1")
    if _origin(given) is None or _origin(given) != _origin(expected):
        raise Denied(
            f"the request comes from a page of another site ({given[:80]!r}, not {expected[:80]!r}): use this server's "
            "own page, send 'Authorization: Bearer <token>', or let the proxy pass Host and X-Forwarded-Proto"
        )


_PORTS = {"http": 80, "https": 443}


def _origin(text: str) -> tuple[str, str, int] | None:
    """Parse an origin as scheme, host and port; None if it is not one of a page (``null``)."""
    try:
        parts = urlsplit(text)
        port = parts.port
    except ValueError:
        return None
    if parts.scheme not in _PORTS or not parts.hostname or parts.path or parts.query or parts.fragment or "@" in text:
        return None
    return parts.scheme, parts.hostname, _PORTS[parts.scheme] if port is None else port


def environment_in_path(path: str) -> str | None:
    """Return the environment in a path, or None."""
    match = _ENVIRONMENT.fullmatch(path)
    return match[1] if match else None


class Authenticator:
    """Check of tokens and sessions with a cache of FRESH_SECONDS.

    Args:
        find: returns a token by its secret, None if it is unknown.
        find_session: returns a session by its secret, None if it has ended.
        anonymous: networks whose clients may read without credentials.
        share: adds to the counts of wrong tokens by network; returns the sums of all servers and since when they count.
            None: each process counts for itself.

    is_invalidated: number of revocations and ended sessions in this process.
    """

    def __init__(
        self,
        find: Callable[[str], Token | None],
        *,
        failures: int,
        find_session: Callable[[str], Session | None] = lambda _: None,
        anonymous: Sequence[IPv4Network | IPv6Network] = (),
        share: ShareFailures | None = None,
        insecure: bool = False,
        clock: Callable[[], float] = seconds_since_boot,
    ) -> None:
        self._find_token, self._find_session, self._failures, self._clock = find, find_session, failures, clock
        self._anonymous = tuple(anonymous)
        self.insecure = insecure
        self._cache: OrderedDict[bytes, tuple[Principal, float]] = OrderedDict()
        self._sources: OrderedDict[str, deque[float]] = OrderedDict()
        self._share, self._unshared, self._blocked = share, Counter[str](), dict[str, float]()
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

    def cached_principal(self, credentials: Credentials) -> Principal | None:
        """Return the cached principal of a request, or None. Never blocks."""
        if self.insecure:
            return ANONYMOUS_ADMIN
        if credentials.authorization is None and credentials.session is None:
            return self._anonymous_principal(credentials.client)
        entry = self._cache.get(credentials.digest())
        return entry[0] if entry is not None and self._clock() < entry[1] else None

    def authenticate(self, credentials: Credentials) -> Principal:
        """Authenticate a request. Reads the store, so call it from a thread.

        A valid token is accepted even from an address with too many failures, because many robots may share an
        address. An ended session is no failure, since open pages send it again, and it counts as none at all.

        Raises Unauthenticated; Throttled for a wrong token after too many failures from the client's address.
        """
        cached = self.cached_principal(credentials)
        if cached is not None:
            return cached
        forgotten = self.is_invalidated
        principal = self._find_principal(credentials)
        if principal is None:
            anonymous = self._anonymous_principal(credentials.client) if credentials.authorization is None else None
            if anonymous is not None:
                return anonymous
            if credentials.session is not None:
                raise Unauthenticated("the session has ended: sign in again")
            if credentials.authorization is None:
                raise Unauthenticated("missing token: send 'Authorization: Bearer <token>'")
            self.note_failure(credentials.client)
            raise Unauthenticated("unknown or expired token: ask an administrator for a new one")
        with self._lock:
            if forgotten == self.is_invalidated:  # otherwise it may have been revoked during the lookup
                self._cache[credentials.digest()] = (principal, self._clock() + FRESH_SECONDS)
            while len(self._cache) > MAX_CACHED_TOKENS:
                self._cache.popitem(last=False)
        return principal

    def _find_principal(self, credentials: Credentials) -> Principal | None:
        if credentials.authorization is not None:
            secret = _token(credentials.authorization)
            token = self._find_token(secret) if secret else None
            principal = None if token is None else Principal.from_token(token)
        elif credentials.session is not None:
            session = self._find_session(credentials.session.decode("ascii"))
            principal = None if session is None else Principal.from_token(session.token, session.ends)
        else:
            return None
        return None if principal is None or principal.has_expired() else principal

    def _anonymous_principal(self, client: str | None) -> Principal | None:
        """Return the principal of clients without credentials, None if the address is not in an allowed network."""
        if not self._anonymous:
            return None
        try:
            address = ipaddress.ip_address(client or "")
        except ValueError:
            return None
        if isinstance(address, ipaddress.IPv6Address) and address.ipv4_mapped is not None:
            address = address.ipv4_mapped
        return ANONYMOUS_VIEWER if any(address in network for network in self._anonymous) else None

    def invalidate(self) -> None:
        """Clear the cache of tokens and sessions, because one was revoked or has ended."""
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
            if len(times) >= self._failures or now < self._blocked.get(source, 0.0):
                raise Throttled(
                    "too many wrong tokens or signatures from your address: wait a minute, or send a valid "
                    "token, which is always accepted"
                )
            times.append(now)
            if self._share is not None:
                self._unshared[source] += 1
            self._sources.move_to_end(source)
            while len(self._sources) > MAX_SOURCES:
                self._sources.popitem(last=False)

    def share_failures(self) -> None:
        """Share the counts of wrong tokens since the last call, in one transaction; without any it writes nothing.

        Networks beyond the first MAX_SHARED by their number of failures wait for the next call. Raises Unavailable.
        """
        with self._lock:
            if self._share is None or not self._unshared:
                return
            counts = dict(self._unshared.most_common(MAX_SHARED))
            self._unshared -= Counter(counts)
            while len(self._unshared) > MAX_SOURCES:
                self._unshared.popitem()
        sums = self._share(counts, timedelta(seconds=WINDOW_SECONDS))
        wall, now = datetime.now(UTC), self._clock()
        with self._lock:
            self._blocked = {source: until for source, until in self._blocked.items() if now < until}
            for source, (count, since) in sums.items():
                left = min(WINDOW_SECONDS, WINDOW_SECONDS - (wall - since).total_seconds())
                if count >= self._failures and left > 0:
                    self._blocked[source] = now + left


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


def _basic_as_bearer(header: bytes) -> bytes:
    """Convert ``Basic`` credentials, whose password is a token, to ``Bearer``; return other headers as they are.

    The converted header is what caches see, so that ``Basic`` is of no use at other paths.
    """
    if not is_basic(header):
        return header
    try:
        pair = base64.b64decode(header[len(_BASIC) :].strip(), validate=True)
    except binascii.Error:
        return b"Basic"
    return b"Bearer " + pair.partition(b":")[2]


def is_basic(header: bytes) -> bool:
    """Test if an Authorization header has the scheme ``Basic``."""
    return header[: len(_BASIC)].lower() == _BASIC


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
MirrorRole = Annotated[Principal, Depends(RequireRole("mirror"))]
"""Role of a server that follows this one."""

Admin = Annotated[Principal, Depends(admin)]
ServerViewer = Annotated[Principal, Depends(RequireRole("viewer", everywhere=True))]
ServerAdmin = Annotated[Principal, Depends(RequireRole("admin", everywhere=True))]
"""Roles for calls about the server or all environments: tokens, keys, metrics."""

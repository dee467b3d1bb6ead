"""Requests of the server to addresses that users name: only to allowed addresses, bounded in time and size.

A name is resolved when a connection opens, each of its addresses is checked, and the connection goes to a checked
address, so an answer of the name server that changes later gains nothing. Redirects are not followed and proxies of the
environment are not used.
"""

from __future__ import annotations

import ipaddress
import socket
import ssl
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

import httpcore

from app.errors import Invalid, Problem

Address = ipaddress.IPv4Address | ipaddress.IPv6Address
Network = ipaddress.IPv4Network | ipaddress.IPv6Network

SECONDS: Final = 10.0
"""Maximum duration of one request, from the resolved name to the end of the response."""

CONNECT_SECONDS: Final = 5.0
"""Maximum duration of an attempt to connect to one address."""

MAX_RESPONSE_BYTES: Final = 16 * 2**10
"""Size of a response's body beyond which the connection is closed. Only the status counts."""

KEEP_ALIVE_SECONDS: Final = 2.0
"""Idle time after which a connection is not used again: the other side may be closing it."""

MAX_URL: Final = 2000

_NAT64: Final = ipaddress.IPv6Network("64:ff9b::/96")
_PUBLIC_V6: Final = ipaddress.IPv6Network("2000::/3")
"""All that is assigned as global unicast; what lies outside is local, or leads to IPv4 by a translator."""

_PLATFORMS: Final = (ipaddress.ip_network("168.63.129.16/32"),)
"""Public addresses at which a cloud answers its own machines: Azure's platform."""


@dataclass(frozen=True, slots=True)
class OutgoingRules:
    """Rules for addresses. networks: those that are allowed besides public ones, also over plain HTTP.

    ca: file with further certification authorities (PEM).
    """

    networks: tuple[Network, ...] = ()
    ca: Path | None = None

    def refusal(self, address: Address, scheme: str) -> str | None:
        """Return why an address must not be reached with ``http`` or ``https``; None if it may."""
        inner = embedded_address(address)
        if any(inner in network for network in self.networks):
            return None
        is_public = inner.is_global and not inner.is_multicast and (inner.version == 4 or inner in _PUBLIC_V6)
        if not is_public or any(inner in network for network in _PLATFORMS):
            return f"{address} is not a public address: FLEETMAP_WEBHOOK_NETWORKS must allow it"
        if scheme != "https":
            return f"plain http to {address} is not allowed: use https, or allow it with FLEETMAP_WEBHOOK_NETWORKS"
        return None


def embedded_address(address: Address) -> Address:
    """Return the IPv4 address that an IPv6 address stands for (mapped, 6to4, NAT64), else the address itself."""
    if isinstance(address, ipaddress.IPv4Address):
        return address
    if address in _NAT64:
        return ipaddress.IPv4Address(int(address) & 0xFFFFFFFF)
    return address.ipv4_mapped or address.sixtofour or address


def check_url(url: str, rules: OutgoingRules) -> str:
    """Check an address that a user gives; return it. A name is resolved only when it is used. Raises Invalid."""
    parts = urlsplit(url)
    try:
        port_problem = "an impossible port" if parts.port == 0 else None
    except ValueError:
        port_problem = "an impossible port"
    problem = (
        "more than 2000 characters" if len(url) > MAX_URL
        else "characters other than visible ASCII" if not all("!" <= c <= "~" for c in url)
        else "no scheme http or https" if parts.scheme not in ("http", "https")
        else "no host" if not parts.hostname
        else "a user or password" if "@" in parts.netloc
        else "a fragment" if parts.fragment
        else port_problem
    )  # fmt: skip
    if problem is None:
        literal = _literal(parts.hostname or "")
        if literal is not None:
            problem = rules.refusal(literal, parts.scheme)
        elif parts.scheme == "http" and not rules.networks:
            problem = "plain http, which only FLEETMAP_WEBHOOK_NETWORKS can allow: use https"
        if problem is None:
            return url
        raise Invalid(f"url: {problem}", [Problem(problem, where="url")])
    raise Invalid(f"url has {problem}: use https://host/path", [Problem(f"has {problem}", where="url")])


def _literal(host: str) -> Address | None:
    try:
        return ipaddress.ip_address(host.split("%", maxsplit=1)[0])
    except ValueError:
        return None


class RequestError(Exception):
    """The request got no response: not allowed, not reached, or not in time."""


@dataclass(frozen=True, slots=True)
class Response:
    """Status of a response, and after how many seconds to ask again if it says so."""

    status: int
    retry_after: float | None = None


class OutgoingClient:
    """Client for POST requests to one host. Not thread-safe."""

    def __init__(self, rules: OutgoingRules, scheme: str) -> None:
        self._backend = _CheckedNetwork(rules, scheme)
        self._pool = httpcore.ConnectionPool(
            ssl_context=_tls(rules) if scheme == "https" else None,
            network_backend=self._backend,
            max_connections=1,
            keepalive_expiry=KEEP_ALIVE_SECONDS,
        )

    def post(self, url: str, headers: dict[str, str], body: bytes) -> Response:
        """Send a request; return its response, of any status. Raises RequestError."""
        self._backend.deadline = time.monotonic() + SECONDS
        timeout = {"connect": CONNECT_SECONDS, "read": SECONDS, "write": SECONDS, "pool": SECONDS}
        listed = [(name.encode(), value.encode()) for name, value in headers.items()]
        listed += [(b"host", urlsplit(url).netloc.encode()), (b"content-length", b"%d" % len(body))]
        try:
            with self._pool.stream("POST", url, headers=listed, content=body, extensions={"timeout": timeout}) as sent:
                size = 0
                for chunk in sent.iter_stream():
                    size += len(chunk)
                    if size > MAX_RESPONSE_BYTES:
                        break
                return Response(sent.status, _retry_after(sent.headers))
        except httpcore.TimeoutException:
            raise RequestError(f"no response within {SECONDS:g} seconds") from None
        except (httpcore.NetworkError, httpcore.ProtocolError, ssl.SSLError, OSError) as error:
            raise RequestError(str(error) or type(error).__name__) from None

    def close(self) -> None:
        """Close the connection."""
        self._pool.close()


def _retry_after(headers: Iterable[tuple[bytes, bytes]]) -> float | None:
    for name, value in headers:
        if name.lower() == b"retry-after" and value.isdigit() and len(value) < 8:
            return float(value)
    return None


def _tls(rules: OutgoingRules) -> ssl.SSLContext:
    context = httpcore.default_ssl_context()
    context.load_default_certs()
    if rules.ca is not None:
        context.load_verify_locations(cafile=rules.ca)
    return context


class _CheckedNetwork(httpcore.NetworkBackend):
    """Connections to allowed addresses. deadline: end of the current request, in monotonic time."""

    def __init__(self, rules: OutgoingRules, scheme: str) -> None:
        self._rules, self._scheme = rules, scheme
        self._plain = httpcore.SyncBackend()
        self.deadline = 0.0

    def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,
        local_address: str | None = None,
        socket_options: Iterable[Any] | None = None,
    ) -> httpcore.NetworkStream:
        """Connect to the first allowed address of a host that answers. Raises RequestError or httpcore's errors."""
        problem: Exception = RequestError(f"{host} has no address")
        for address in self._allowed(host, port):
            try:
                left = self.left(timeout)
                stream = self._plain.connect_tcp(str(address), port, left, local_address, socket_options)
            except (httpcore.NetworkError, httpcore.ConnectTimeout) as error:
                reason = "no answer" if isinstance(error, httpcore.ConnectTimeout) else str(error)
                problem = RequestError(f"no connection to {address}, port {port}: {reason}")
            else:
                return _DeadlineStream(stream, self)
        raise problem

    def left(self, timeout: float | None) -> float:
        """Return the time that an operation may take. Raises ReadTimeout if there is none left."""
        left = self.deadline - time.monotonic()
        if left <= 0:
            raise httpcore.ReadTimeout
        return left if timeout is None else min(timeout, left)

    def _allowed(self, host: str, port: int) -> Iterator[Address]:
        try:
            rows = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        except (OSError, UnicodeError) as error:
            raise RequestError(f"the name {host} has no address: {error}") from None
        refusals = []
        for address in dict.fromkeys(ipaddress.ip_address(str(row[4][0]).split("%", maxsplit=1)[0]) for row in rows):
            refusal = self._rules.refusal(address, self._scheme)
            if refusal is None:
                yield address
            else:
                refusals.append(refusal)
        if refusals:
            raise RequestError(refusals[0])


class _DeadlineStream(httpcore.NetworkStream):
    """Connection whose operations end at the deadline of the request, however slowly bytes come."""

    def __init__(self, stream: httpcore.NetworkStream, network: _CheckedNetwork) -> None:
        self._stream, self._network = stream, network

    def read(self, max_bytes: int, timeout: float | None = None) -> bytes:
        """Read at most ``max_bytes``."""
        return self._stream.read(max_bytes, self._network.left(timeout))

    def write(self, buffer: bytes, timeout: float | None = None) -> None:
        """Write all bytes."""
        self._stream.write(buffer, self._network.left(timeout))

    def close(self) -> None:
        """Close the connection."""
        self._stream.close()

    def start_tls(
        self, ssl_context: ssl.SSLContext, server_hostname: str | None = None, timeout: float | None = None
    ) -> httpcore.NetworkStream:
        """Begin TLS; the certificate must be for the name of the URL, not for the address."""
        stream = self._stream.start_tls(ssl_context, server_hostname, self._network.left(timeout))
        return _DeadlineStream(stream, self._network)

    def get_extra_info(self, info: str) -> Any:
        """Return a property of the connection."""
        return self._stream.get_extra_info(info)

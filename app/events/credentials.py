"""Credentials of clients: TLS files, and user and password for Zenoh."""

from __future__ import annotations

import re
import socket
import ssl
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from app.errors import Invalid

PROBE_SECONDS = 2.0
"""Time limit of the TLS probe after Zenoh could not connect."""


@dataclass(frozen=True, slots=True)
class ZenohCredentials:
    """Credentials for a Zenoh router.

    Attributes:
        ca: certification authority to trust (PEM); default: public ones.
        certificate, key: client certificate and private key (PEM), for routers that require them.
        user, password: user of the router.
    """

    ca: Path | None = None
    certificate: Path | None = None
    key: Path | None = None
    user: str | None = None
    password: str | None = field(default=None, repr=False)

    def values(self) -> dict[str, Any]:
        """Return Zenoh's settings for a client session. Raises Invalid if something is missing."""
        out: dict[str, Any] = {}
        if self.ca is not None:
            out["transport/link/tls/root_ca_certificate"] = readable_file(self.ca)
            ca_ssl_context(self.ca)
        if (self.certificate is None) != (self.key is None):
            raise Invalid("Zenoh certificate and key must be set together")
        if self.certificate is not None and self.key is not None:
            out["transport/link/tls/connect_certificate"] = readable_file(self.certificate)
            out["transport/link/tls/connect_private_key"] = readable_file(self.key)
            _show(ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT), self.certificate, self.key)
            out["transport/link/tls/enable_mtls"] = True
        if (self.user is None) != (self.password is None):
            raise Invalid("Zenoh user and password must be set together")
        if self.user is not None:
            out["transport/auth/usrpwd"] = {"user": self.user, "password": self.password, "dictionary_file": None}
        return out


def readable_file(path: Path) -> str:
    """Return the absolute path of a readable file. Raises Invalid; Zenoh would report a failed connection only."""
    try:
        with path.open("rb"):
            return str(path.resolve())
    except OSError as error:
        raise Invalid(f"could not read {path}: {error.strerror or error}") from error


def ca_ssl_context(ca: Path) -> ssl.SSLContext:
    """Return a TLS context that trusts only this certification authority. Raises Invalid."""
    try:
        return ssl.create_default_context(cafile=ca)
    except (OSError, ssl.SSLError) as error:
        raise Invalid(f"{ca} is not a certificate of a certification authority (PEM): {error}") from error


def server_ssl_context(address: str, ca: Path | None) -> ssl.SSLContext | bool:
    """Return the TLS settings of an HTTP client: authority ``ca`` if given, else the public authorities.

    Raises Invalid if ``ca`` contains no certificate. Plain HTTP loads no authorities: it takes each client some 50 ms.
    """
    if ca is not None:
        return ca_ssl_context(ca)
    return ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT) if address.startswith("http://") else True


def _show(context: ssl.SSLContext, certificate: Path, key: Path) -> None:
    """Load the certificate to present. Raises Invalid if the files are not a certificate and its key."""
    try:
        context.load_cert_chain(certificate, key, password="")  # never ask a terminal
    except (OSError, ssl.SSLError) as error:
        raise Invalid(
            f"{certificate} and {key} are not a certificate and its unencrypted key (PEM): {error}"
        ) from error


def describe_connection_failure(hosts: str, error: Exception, login: ZenohCredentials, *, names: bool = True) -> str:
    """Describe why a connection failed: the TLS error, which Zenoh does not report, else Zenoh's own error.

    Args:
        hosts: endpoints, comma-separated; the first one is probed.
        names: whether the certificate must contain the host name.
    """
    return f"no router at {hosts}: {_tls_failure(hosts, login, names=names) or first_line(str(error))}"


def first_line(text: str) -> str:
    """Return the first line of a Zenoh error, without its source locations."""
    return re.sub(r",? at /\S+", "", text.splitlines()[0] if text else "")[:300]


def _tls_failure(endpoints: str, login: ZenohCredentials, *, names: bool) -> str | None:
    match = re.fullmatch(r"tls/\[?([^#?]+?)\]?:(\d+)(?:[#?].*)?", endpoints.split(",", maxsplit=1)[0].strip())
    if match is None:
        return None
    try:
        context = ca_ssl_context(login.ca) if login.ca is not None else ssl.create_default_context()
        context.check_hostname = names
        if login.certificate is not None and login.key is not None:
            _show(context, login.certificate, login.key)
        with (
            socket.create_connection((match[1], int(match[2])), PROBE_SECONDS) as bare,
            context.wrap_socket(bare, server_hostname=match[1]) as link,
        ):
            link.recv(1)  # the router rejects a client certificate only now
    except ssl.SSLCertVerificationError as error:
        return f"certificate not trusted: {error.verify_message}"
    except ssl.SSLError as error:
        return f"TLS error: {(error.reason or str(error)).replace('_', ' ').lower()}"
    except (OSError, Invalid):
        return None
    return None

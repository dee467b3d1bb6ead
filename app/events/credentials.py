"""How a client shows who it is, and knows whom it talks to: TLS, and for Zenoh a user with a password."""

from __future__ import annotations

import re
import socket
import ssl
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from app.errors import Invalid

PROBE_SECONDS = 2.0
"""How long TLS is tried where Zenoh did not get through."""


@dataclass(frozen=True, slots=True)
class ZenohCredentials:
    """ca: whom to trust, PEM; without it, public certification authorities. certificate and key: shown where the router
    asks for them, PEM. user and password: as the router knows them."""

    ca: Path | None = None
    certificate: Path | None = None
    key: Path | None = None
    user: str | None = None
    password: str | None = field(default=None, repr=False)

    def values(self) -> dict[str, Any]:
        """Zenoh's settings for a session that connects. Invalid where something is missing."""
        out: dict[str, Any] = {}
        if self.ca is not None:
            out["transport/link/tls/root_ca_certificate"] = readable_file(self.ca)
            ca_ssl_context(self.ca)
        if (self.certificate is None) != (self.key is None):
            raise Invalid("a certificate for Zenoh needs its key, and the other way round")
        if self.certificate is not None and self.key is not None:
            out["transport/link/tls/connect_certificate"] = readable_file(self.certificate)
            out["transport/link/tls/connect_private_key"] = readable_file(self.key)
            _show(ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT), self.certificate, self.key)
            out["transport/link/tls/enable_mtls"] = True
        if (self.user is None) != (self.password is None):
            raise Invalid("a user of Zenoh needs a password, and the other way round")
        if self.user is not None:
            out["transport/auth/usrpwd"] = {"user": self.user, "password": self.password, "dictionary_file": None}
        return out


def readable_file(path: Path) -> str:
    """A file that can be read, as Zenoh is told it: of one that cannot it only says that nobody answers."""
    try:
        with path.open("rb"):
            return str(path.resolve())
    except OSError as error:
        raise Invalid(f"{path} cannot be read: {error.strerror or error}") from error


def ca_ssl_context(ca: Path) -> ssl.SSLContext:
    """TLS that believes certificates of this certification authority alone. Raises Invalid."""
    try:
        return ssl.create_default_context(cafile=ca)
    except (OSError, ssl.SSLError) as error:
        raise Invalid(f"{ca} holds no certificate of a certification authority (PEM): {error}") from error


def server_ssl_context(address: str, ca: Path | None) -> ssl.SSLContext | bool:
    """TLS for an HTTP client of this server: by ``ca`` if given, else by the public certification authorities.

    Raises Invalid. For an ``http://`` address no authorities are loaded, which would cost each client some 50 ms.
    """
    if ca is not None:
        return ca_ssl_context(ca)
    return ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT) if address.startswith("http://") else True


def _show(context: ssl.SSLContext, certificate: Path, key: Path) -> None:
    """Have a certificate that is shown to who asks. Invalid where it and its key are none."""
    try:
        context.load_cert_chain(certificate, key, password="")  # never ask a terminal
    except (OSError, ssl.SSLError) as error:
        raise Invalid(f"{certificate} and {key} are no certificate and its unencrypted key (PEM): {error}") from error


def describe_connection_failure(hosts: str, error: Exception, login: ZenohCredentials, *, names: bool = True) -> str:
    """Why nobody was reached at ``hosts``: what TLS has against it, of which Zenoh does not tell, else what Zenoh says.

    hosts: endpoints, separated by commas; the first is asked. names: whether its certificate has to name it.
    """
    return f"no router at {hosts}: {_tls_failure(hosts, login, names=names) or first_line(str(error))}"


def first_line(text: str) -> str:
    """The first line of what Zenoh says, without the places in its source."""
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
            link.recv(1)  # who does not like our certificate says so only now
    except ssl.SSLCertVerificationError as error:
        return f"its certificate is not to be trusted: {error.verify_message}"
    except ssl.SSLError as error:
        return f"it refuses: {(error.reason or str(error)).replace('_', ' ').lower()}"
    except (OSError, Invalid):
        return None
    return None

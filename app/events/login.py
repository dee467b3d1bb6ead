"""How a client shows who it is, and knows whom it talks to: TLS, and for Zenoh a user with a password."""

from __future__ import annotations

import ssl
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from app.errors import Invalid


@dataclass(frozen=True, slots=True)
class Login:
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
            out["transport/link/tls/root_ca_certificate"] = file_of(self.ca)
        if (self.certificate is None) != (self.key is None):
            raise Invalid("a certificate for Zenoh needs its key, and the other way round")
        if self.certificate is not None and self.key is not None:
            out["transport/link/tls/connect_certificate"] = file_of(self.certificate)
            out["transport/link/tls/connect_private_key"] = file_of(self.key)
            out["transport/link/tls/enable_mtls"] = True
        if (self.user is None) != (self.password is None):
            raise Invalid("a user of Zenoh needs a password, and the other way round")
        if self.user is not None:
            out["transport/auth/usrpwd"] = {"user": self.user, "password": self.password, "dictionary_file": None}
        return out


def file_of(path: Path) -> str:
    """A file that can be read, as Zenoh is told it: of one that cannot it only says that nobody answers."""
    try:
        with path.open("rb"):
            return str(path.resolve())
    except OSError as error:
        raise Invalid(f"{path} cannot be read: {error.strerror or error}") from error


def trusting(ca: Path) -> ssl.SSLContext:
    """TLS that believes certificates of this certification authority alone. Raises Invalid."""
    try:
        return ssl.create_default_context(cafile=ca)
    except (OSError, ssl.SSLError) as error:
        raise Invalid(f"{ca} holds no certificate of a certification authority (PEM): {error}") from error

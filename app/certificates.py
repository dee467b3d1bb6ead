"""TLS certificates of the server as operators need to know them: names, authority and end. Reads PEM files."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from cryptography import x509

from app.errors import Invalid


@dataclass(frozen=True, slots=True)
class Certificate:
    """First certificate of a file. names: DNS names and addresses that it is valid for.

    ends: earliest end among the certificates of the file, which include those of its authorities.
    """

    path: Path
    subject: str
    names: tuple[str, ...]
    begins: datetime
    ends: datetime


def read_certificate(path: Path) -> Certificate:
    """Read a file with a certificate and its chain. Raises Invalid."""
    try:
        chain = x509.load_pem_x509_certificates(path.read_bytes())
    except OSError as error:
        raise Invalid(f"could not read {path}: {error.strerror or error}") from error
    except ValueError as error:
        raise Invalid(f"{path} is not a certificate (PEM): {error}") from error
    first = chain[0]
    ends = min(certificate.not_valid_after_utc for certificate in chain)
    return Certificate(path, first.subject.rfc4514_string(), _names(first), first.not_valid_before_utc, ends)


def _names(certificate: x509.Certificate) -> tuple[str, ...]:
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return ()
    addresses = names.get_values_for_type(x509.IPAddress)
    return (*names.get_values_for_type(x509.DNSName), *map(str, addresses))

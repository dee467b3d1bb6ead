"""Encryption of backups with age, to recipients whose identities the server does not have."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from app.errors import Damaged, Invalid, Unavailable, system_reason

IDENTITY = "AGE-SECRET-KEY-1"


class Age:
    """Encryption to recipients; none: nothing is encrypted. identities: those that can decrypt."""

    def __init__(self, recipients: Sequence[str], identities: Sequence[str] = ()) -> None:
        self.recipients = tuple(dict.fromkeys(recipients))
        self._to = [_recipient(text) for text in self.recipients]
        self._by = [_identity(text) for text in identities]

    @property
    def is_on(self) -> bool:
        """Whether backups are encrypted."""
        return bool(self.recipients)

    @property
    def can_decrypt(self) -> bool:
        """Whether there is an identity, or none is needed."""
        return bool(self._by) or not self.is_on

    def encrypt(self, data: bytes) -> bytes:
        """Encrypt if there are recipients."""
        if not self.is_on:
            return data
        encrypted: bytes = _pyrage().encrypt(data, self._to)
        return encrypted

    def decrypt(self, data: bytes) -> bytes:
        """Decrypt if there are recipients. Raises Invalid for a missing or wrong identity, Damaged."""
        if not self.is_on:
            return data
        if not self._by:
            raise Invalid("the backup is encrypted: pass the file with the age identity as --identity FILE")
        pyrage = _pyrage()
        try:
            plain: bytes = pyrage.decrypt(data, self._by)
        except pyrage.DecryptError as error:
            if "no matching" in str(error).lower():
                raise Invalid(
                    "the backup is encrypted for other recipients: none of the identities of --identity fits"
                ) from error
            raise Damaged(f"a part of the backup cannot be decrypted: {error}") from error
        return plain


def read_identities(path: Path) -> list[str]:
    """Read the identities of a file as ``age-keygen`` writes it. Raises Invalid."""
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = system_reason(error) if isinstance(error, OSError) else "not a text"
        raise Invalid(f"--identity {path}: cannot be read ({reason})") from error
    identities = [line.strip() for line in lines if line.strip().startswith(IDENTITY)]
    if not identities:
        raise Invalid(f"--identity {path}: no line begins with {IDENTITY}: use a file that `age-keygen` has written")
    for text in identities:
        _identity(text)
    return identities


def _pyrage() -> Any:
    try:
        import pyrage
    except ImportError as error:
        raise Unavailable(
            "encrypted backups need the package pyrage: install the server's dependencies again "
            "(`pip install 'fleet-map-server[server]'`)"
        ) from error
    return pyrage


def _recipient(text: str) -> Any:
    pyrage = _pyrage()
    try:
        return pyrage.x25519.Recipient.from_str(text)
    except pyrage.RecipientError as error:
        raise Invalid(f"--recipient {text[:80]}: no age recipient ({error}): it begins with age1") from error


def _identity(text: str) -> Any:
    pyrage = _pyrage()
    try:
        return pyrage.x25519.Identity.from_str(text)
    except pyrage.IdentityError as error:
        raise Invalid(f"--identity: an invalid line ({error})") from error

"""Ed25519 keys that sign manifests: in the data folder, in the database that servers share, or in a mounted file.

The id of a key is the start of the SHA-256 of the raw public key. The newest key signs. Each key endorses its
successor, so that a robot with a pinned old key can trust the new one.
"""

from __future__ import annotations

import base64
import hashlib
import json
import logging
import re
import threading
from abc import ABC, abstractmethod
from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from app.backends.documents import Document, write_private
from app.backends.locks import file_lock
from app.errors import Conflict, Unavailable

log = logging.getLogger(__name__)

MAX_PUBLISHED_KEYS = 32
"""Maximum number of published public keys: a robot may miss that many rotations."""


@dataclass(frozen=True, slots=True)
class PublicKey:
    """Public key for clients. endorsement: signature of the raw public key by the previous key."""

    id: str
    public: bytes
    created: str
    endorsed_by: str | None = None
    endorsement: bytes | None = None

    def as_dict(self) -> dict[str, Any]:
        """Convert the key to JSON, with bytes in base64."""
        out: dict[str, Any] = {
            "id": self.id,
            "algorithm": "Ed25519",
            "public_key": base64.b64encode(self.public).decode(),
            "created": self.created,
        }
        if self.endorsed_by is not None and self.endorsement is not None:
            out["endorsed_by"] = self.endorsed_by
            out["endorsement"] = base64.b64encode(self.endorsement).decode()
        return out

    @classmethod
    def from_dict(cls, line: dict[str, Any]) -> PublicKey:
        """Convert the members of ``as_dict``."""
        endorsement = base64.b64decode(line["endorsement"]) if "endorsement" in line else None
        public = base64.b64decode(line["public_key"])
        return cls(line["id"], public, line["created"], line.get("endorsed_by"), endorsement)


Loaded = tuple[Hashable, list[PublicKey], Ed25519PrivateKey]


class SigningKeys(ABC):
    """Keys, newest first, of which the newest signs. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._loaded: Loaded | None = None

    def public(self) -> list[PublicKey]:
        """List the public keys, newest first."""
        return self._load()[1]

    def sign(self, data: bytes) -> tuple[str, bytes]:
        """Sign data with the newest key. Returns the id of the key and the signature of 64 bytes."""
        _, keys, private = self._load()
        return keys[0].id, private.sign(data)

    @abstractmethod
    def rotate(self) -> PublicKey:
        """Create a new key, endorsed by the previous one, and sign with it from now on."""

    @abstractmethod
    def _stamp(self) -> Hashable:
        """Return a value that changes with the keys."""

    @abstractmethod
    def _read(self) -> tuple[list[PublicKey], Ed25519PrivateKey]:
        """Read the keys; create the first one."""

    def _load(self) -> Loaded:
        with self._lock:
            stamp = self._stamp()  # before reading: a concurrent change is then read again
            if self._loaded is None or self._loaded[0] != stamp:
                self._loaded = (stamp, *self._read())
            return self._loaded


class Keys(SigningKeys):
    """Keys of a folder, created on first use and shared by all processes of a data directory.

    Files: ``keys.json`` with the public keys, ``<id>.pem`` (PKCS 8) with the newest private key.
    """

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self._folder = folder

    def rotate(self) -> PublicKey:
        """Create a new key, endorsed by the previous one, and sign with it from now on."""
        self._load()
        with self._exclusive():
            keys, private = self._read_files()
            key = self._create(keys, private)
        self._loaded = None
        return key

    def export(self) -> bytes | None:
        """Return all keys as the content of a document of ``SharedKeys``; None if the folder has none."""
        if not self._stamp():
            return None
        return _pack(*self._read_files())

    def bring(self, content: bytes) -> None:
        """Write the keys of an exported document into the folder, which has none.

        Raises Conflict if it has keys, ValueError or KeyError if the content is no such document.
        """
        keys, private = _unpack(content)
        with self._exclusive():
            if self._stamp():
                raise Conflict(f"{self._folder} already has signing keys: move them away first")
            write_private(self._folder / f"{keys[0].id}.pem", _as_pem(private))
            write_private(self._folder / "keys.json", json.dumps([k.as_dict() for k in keys], indent=1).encode())
        self._loaded = None

    def _stamp(self) -> float:
        try:
            return (self._folder / "keys.json").stat().st_mtime_ns / 1.0
        except OSError:
            return 0.0

    def _read(self) -> tuple[list[PublicKey], Ed25519PrivateKey]:
        if not self._stamp():
            with self._exclusive():
                if not self._stamp():
                    self._create([], None)
        return self._read_files()

    @contextmanager
    def _exclusive(self) -> Iterator[None]:
        self._folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        with file_lock(self._folder / "lock"):
            yield

    def _read_files(self) -> tuple[list[PublicKey], Ed25519PrivateKey]:
        keys = [PublicKey.from_dict(line) for line in json.loads((self._folder / "keys.json").read_text())]
        path = self._folder / f"{keys[0].id}.pem"
        return keys, _from_pem(path.read_bytes(), path)

    def _create(self, keys: list[PublicKey], old: Ed25519PrivateKey | None) -> PublicKey:
        key, private = _new_key(keys, old)
        write_private(self._folder / f"{key.id}.pem", _as_pem(private))
        stored_keys = [key, *keys][:MAX_PUBLISHED_KEYS]
        write_private(self._folder / "keys.json", json.dumps([k.as_dict() for k in stored_keys], indent=1).encode())
        for path in self._folder.glob("*.pem"):
            if path.stem != key.id:
                path.unlink()  # old keys never sign again
        return key


class SharedKeys(SigningKeys):
    """Keys in a document that several servers share. The first server brings the keys of its folder, if it has any."""

    def __init__(self, document: Document, folder: Path) -> None:
        super().__init__()
        self._document, self._folder = document, Keys(folder)

    def rotate(self) -> PublicKey:
        """Create a new key, endorsed by the previous one; all servers sign with it once they know of the commit."""
        self._load()

        def change(content: bytes | None) -> bytes:
            keys, private = _unpack(content or self._first())
            key, new = _new_key(keys, private)
            return _pack([key, *keys][:MAX_PUBLISHED_KEYS], new)

        keys, _ = _unpack(self._document.update(change))
        self._loaded = None
        return keys[0]

    def _stamp(self) -> Hashable:
        return self._document.stamp()

    def _read(self) -> tuple[list[PublicKey], Ed25519PrivateKey]:
        content = self._document.read()
        if content is None:
            content = self._document.update(lambda present: present or self._first())
        keys, private = _unpack(content)
        local = self._folder.export() if self._loaded is None else None
        if local is not None and (former := _unpack(local)[0][0].id) not in {key.id for key in keys}:
            log.warning(
                "keys: the key of the data folder is not used, all servers on the database sign with another "
                "(unused=%s, used=%s); robots that trust only the former need the latter",
                former,
                keys[0].id,
            )
        return keys, private

    def _first(self) -> bytes:
        local = self._folder.export()
        if local is not None:
            return local
        key, private = _new_key([], None)
        return _pack([key], private)


class MountedKeys(SigningKeys):
    """Keys of a file with private keys (PEM, PKCS 8), newest first. Each endorses the one before it in the file."""

    _BLOCK = re.compile(rb"-----BEGIN PRIVATE KEY-----.+?-----END PRIVATE KEY-----", re.DOTALL)

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path = path

    def rotate(self) -> PublicKey:
        """Raise Conflict: the operator changes the file."""
        raise Conflict(
            "the signing key is in the file FLEETMAP_SIGNING_KEY: put the new key before the others in it, on all "
            "servers at once"
        )

    def _stamp(self) -> Hashable:
        try:
            return self._path.stat().st_mtime_ns
        except OSError as error:
            raise Unavailable(f"FLEETMAP_SIGNING_KEY: could not read {self._path.name}: {error.strerror}") from error

    def _read(self) -> tuple[list[PublicKey], Ed25519PrivateKey]:
        modified = datetime.fromtimestamp(self._path.stat().st_mtime, timezone.utc)
        try:
            blocks = self._BLOCK.findall(self._path.read_bytes())[:MAX_PUBLISHED_KEYS]
            privates = [_from_pem(block, self._path) for block in blocks]
        except (OSError, ValueError, TypeError) as error:
            raise Unavailable(f"FLEETMAP_SIGNING_KEY: invalid file {self._path.name}: {error}") from error
        if not privates:
            raise Unavailable(
                f"FLEETMAP_SIGNING_KEY: {self._path.name} has no key: create one with "
                "`openssl genpkey -algorithm ed25519`"
            )
        keys: list[PublicKey] = []
        older: Ed25519PrivateKey | None = None
        for private in reversed(privates):
            keys.insert(0, _public_key(private, keys, older, modified))
            older = private
        return keys, privates[0]


def _new_key(keys: Sequence[PublicKey], old: Ed25519PrivateKey | None) -> tuple[PublicKey, Ed25519PrivateKey]:
    private = Ed25519PrivateKey.generate()
    return _public_key(private, keys, old, datetime.now(timezone.utc)), private


def _public_key(
    private: Ed25519PrivateKey, keys: Sequence[PublicKey], old: Ed25519PrivateKey | None, created: datetime
) -> PublicKey:
    """Return the public key of ``private``, endorsed by ``old``, the private key of the first of ``keys``."""
    public = private.public_key().public_bytes_raw()
    endorsement = old.sign(public) if old is not None else None
    time = created.strftime("%Y-%m-%dT%H:%M:%SZ")
    return PublicKey(key_id(public), public, time, keys[0].id if keys else None, endorsement)


def _as_pem(private: Ed25519PrivateKey) -> bytes:
    return private.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def _from_pem(data: bytes, path: Path | str) -> Ed25519PrivateKey:
    private = serialization.load_pem_private_key(data, None)
    if not isinstance(private, Ed25519PrivateKey):
        raise TypeError(f"{path} is not an Ed25519 key")
    return private


def _pack(keys: Sequence[PublicKey], private: Ed25519PrivateKey) -> bytes:
    return json.dumps({"keys": [key.as_dict() for key in keys], "private": _as_pem(private).decode()}).encode()


def _unpack(content: bytes) -> tuple[list[PublicKey], Ed25519PrivateKey]:
    members = json.loads(content)
    keys = [PublicKey.from_dict(line) for line in members["keys"]]
    return keys, _from_pem(members["private"].encode(), "the key in the database")


def exported_key_ids(content: bytes) -> list[str]:
    """Return the ids of the keys of an exported document, newest first."""
    return [key.id for key in _unpack(content)[0]]


def delegation_statement(public: bytes, environment: str, start: datetime, until: datetime) -> bytes:
    """Return the text of which the signature lets another key sign the manifests of one environment for a time."""
    members = {
        "kind": "delegation",
        "public_key": base64.b64encode(public).decode(),
        "environment": environment,
        "from": start.astimezone(timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ"),
        "until": until.astimezone(timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ"),
    }
    return json.dumps(members, separators=(",", ":")).encode()


def key_id(public: bytes) -> str:
    """Compute the id of a raw public key."""
    return hashlib.sha256(public).hexdigest()[:16]

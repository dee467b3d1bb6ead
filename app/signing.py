"""Ed25519 keys that sign manifests, in a folder that only the server reads.

A key is a file ``<id>.pem`` (PKCS 8); its id is the start of the SHA-256 of the raw public key. The newest key signs.
Each key endorses its successor, so that a robot with a pinned old key can trust the new one.
"""

from __future__ import annotations

import base64
import fcntl
import hashlib
import json
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

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


class Keys:
    """Keys of a folder, created on first use and shared by all processes of a data directory."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._lock = threading.Lock()
        self._loaded: tuple[float, list[PublicKey], Ed25519PrivateKey] | None = None

    def public(self) -> list[PublicKey]:
        """List the public keys, newest first."""
        return self._load()[0]

    def sign(self, data: bytes) -> tuple[str, bytes]:
        """Sign data with the newest key. Returns the id of the key and the signature of 64 bytes."""
        keys, private = self._load()
        return keys[0].id, private.sign(data)

    def rotate(self) -> PublicKey:
        """Create a new key, endorsed by the previous one, and sign with it from now on."""
        self._load()
        with self._exclusive():
            keys, private = self._read()
            key = self._create(keys, private)
        self._loaded = None
        return key

    def _load(self) -> tuple[list[PublicKey], Ed25519PrivateKey]:
        with self._lock:
            changed = self._modified_at()
            if self._loaded is None or self._loaded[0] != changed:
                if changed == 0.0:
                    with self._exclusive():
                        if self._modified_at() == 0.0:
                            self._create([], None)
                keys, private = self._read()
                self._loaded = (self._modified_at(), keys, private)
            return self._loaded[1], self._loaded[2]

    def _modified_at(self) -> float:
        try:
            return (self._folder / "keys.json").stat().st_mtime_ns / 1.0
        except OSError:
            return 0.0

    @contextmanager
    def _exclusive(self) -> Iterator[None]:
        self._folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        with (self._folder / "lock").open("w") as handle:
            fcntl.flock(handle, fcntl.LOCK_EX)
            yield

    def _read(self) -> tuple[list[PublicKey], Ed25519PrivateKey]:
        lines = json.loads((self._folder / "keys.json").read_text())
        keys = [
            PublicKey(
                line["id"],
                base64.b64decode(line["public_key"]),
                line["created"],
                line.get("endorsed_by"),
                base64.b64decode(line["endorsement"]) if "endorsement" in line else None,
            )
            for line in lines
        ]
        data = (self._folder / f"{keys[0].id}.pem").read_bytes()
        private = serialization.load_pem_private_key(data, None)
        if not isinstance(private, Ed25519PrivateKey):
            raise TypeError(f"{self._folder}/{keys[0].id}.pem is not an Ed25519 key")
        return keys, private

    def _create(self, keys: list[PublicKey], old: Ed25519PrivateKey | None) -> PublicKey:
        private = Ed25519PrivateKey.generate()
        public = private.public_key().public_bytes_raw()
        endorsement = old.sign(public) if old is not None else None
        key = PublicKey(
            key_id(public),
            public,
            datetime.now(timezone.utc).strftime("%Y-%m-%dT%H:%M:%SZ"),
            keys[0].id if keys else None,
            endorsement,
        )
        pem = private.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
        _write(self._folder / f"{key.id}.pem", pem)
        stored_keys = [key, *keys][:MAX_PUBLISHED_KEYS]
        _write(self._folder / "keys.json", json.dumps([k.as_dict() for k in stored_keys], indent=1).encode())
        for path in self._folder.glob("*.pem"):
            if path.stem != key.id:
                path.unlink()  # old keys never sign again
        return key


def key_id(public: bytes) -> str:
    """Compute the id of a raw public key."""
    return hashlib.sha256(public).hexdigest()[:16]


def _write(path: Path, data: bytes) -> None:
    """Write a file atomically, readable by its owner only."""
    temporary = path.with_suffix(f".{os.getpid()}")
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    with os.fdopen(descriptor, "wb") as handle:
        handle.write(data)
        handle.flush()
        os.fsync(handle.fileno())
    temporary.replace(path)

"""Content-addressed files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO


class Blobs:
    """Bytes by their SHA-256 (hex)."""

    def put(self, data: bytes | Path) -> str:
        """Store bytes or a file's content durably; the SHA-256."""
        raise NotImplementedError

    def put_many(self, files: Sequence[bytes | Path]) -> list[str]:
        """Store several files with one set of fsyncs; their SHA-256s in the same order."""
        raise NotImplementedError

    def get(self, sha256: str) -> bytes:
        """The content, hashed again; Damaged where it does not match, NotFound where there is none."""
        raise NotImplementedError

    def open(self, sha256: str) -> BinaryIO:
        """The content as a seekable file, hashed again."""
        raise NotImplementedError

    def path(self, sha256: str) -> Path | None:
        """The file with exactly this content, None where it is packed with others."""
        raise NotImplementedError

    def size(self, sha256: str) -> int:
        """Bytes of the content."""
        raise NotImplementedError

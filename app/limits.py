"""Resource limits of an upload."""

from __future__ import annotations

from dataclasses import dataclass

from app.errors import Problem, TooLarge

UNPACKED_FREE_BYTES = 16 * 2**20
"""Uncompressed size in bytes that is allowed for any compression ratio."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of an upload. Every number is a setting; the defaults are above the size of real maps."""

    upload_bytes: int = 512 * 2**20
    unpacked_bytes: int = 1024 * 2**20
    unpacked_ratio: int = 100
    files: int = 10_000
    pixels: int = 2**28
    voxels: int = 2**25
    features: int = 5_000_000
    yaml_depth: int = 48
    yaml_nodes: int = 20_000_000
    xml_attribute_bytes: int = 64 * 2**10
    text_bytes: int = 256 * 2**20
    seconds: float = 300.0
    memory_bytes: int = 8 * 2**30
    warnings: int = 1000

    def max_unpacked(self, packed: int, free: int = UNPACKED_FREE_BYTES) -> int:
        """Compute the maximum uncompressed size of compressed content, in bytes.

        Args:
            packed: bytes of the compressed content.
            free: bytes allowed for any compression ratio; small real files compress well.
        """
        return min(self.unpacked_bytes, max(free, self.unpacked_ratio * packed))

    def check_unpacked(self, size: int, packed: int) -> None:
        """Raise TooLarge if ``size`` uncompressed bytes are too many for ``packed`` compressed bytes."""
        bound = self.max_unpacked(packed)
        if size > bound:
            reason = f"{packed} bytes decompress to more than the limit of {bound} bytes"
            raise TooLarge(f"{reason}: upload it uncompressed, or in parts", [Problem(reason)])

"""What an upload may cost."""

from __future__ import annotations

from dataclasses import dataclass

from app.errors import Problem, TooLarge

UNPACKED_FREE_BYTES = 16 * 2**20
"""Bytes that compressed content may unfold to whatever its ratio is."""


@dataclass(frozen=True, slots=True)
class Limits:
    """What an upload may hold. Every number is a setting; the defaults let real maps pass."""

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
        """Compute the maximum number of bytes that compressed content may unfold to.

        Args:
            packed: bytes of the compressed content.
            free: bytes that any content may unfold to, whatever its ratio; small real files compress well.
        """
        return min(self.unpacked_bytes, max(free, self.unpacked_ratio * packed))

    def check_unpacked(self, size: int, packed: int) -> None:
        """Raise TooLarge if this much compressed content must not unfold to this many bytes."""
        bound = self.max_unpacked(packed)
        if size > bound:
            reason = f"{packed} bytes unfold to more than {bound} bytes, which is the limit"
            raise TooLarge(f"{reason}: upload it uncompressed, or in parts", [Problem(reason)])

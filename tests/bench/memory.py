"""A process's memory, as the kernel counts it (proc(5)): also what libraries allocate, and the input itself."""

from __future__ import annotations

from pathlib import Path


def resident() -> int:
    """Bytes now."""
    return _of("VmRSS")


def peak() -> int:
    """The most bytes there were since ``reset``."""
    return _of("VmHWM")


def reset() -> None:
    """The peak counts from here."""
    Path("/proc/self/clear_refs").write_text("5")


def _of(field: str) -> int:
    text = Path("/proc/self/status").read_text()
    return next(int(line.split()[1]) for line in text.splitlines() if line.startswith(field)) * 1024

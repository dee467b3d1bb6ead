"""Memory of a process as counted by the kernel (proc(5)), including libraries and the input."""

from __future__ import annotations

from pathlib import Path


def resident() -> int:
    """Return the current memory in bytes."""
    return _of("VmRSS")


def peak() -> int:
    """Return the peak memory since ``reset``, in bytes."""
    return _of("VmHWM")


def reset() -> None:
    """Reset the peak."""
    Path("/proc/self/clear_refs").write_text("5")


def _of(field: str) -> int:
    text = Path("/proc/self/status").read_text()
    return next(int(line.split()[1]) for line in text.splitlines() if line.startswith(field)) * 1024

"""Waiting in the kernel until memory that processes share has another value: Linux's futex, which Python lacks."""

from __future__ import annotations

import ctypes
import errno
import mmap
import platform
import sys
import time
from typing import Any, Final

POLL_SECONDS: Final = 0.004
"""Where the kernel does not wait, a wait ends after this time, so that the caller reads the memory again."""

_WAIT, _WAKE, _ALL = 0, 1, 2**31 - 1  # linux/futex.h; without its flag "private", as other processes wait, too
_NUMBERS = {"x86_64": 202, "aarch64": 98, "riscv64": 98}  # of the system call; all three are little-endian
_NUMBER = _NUMBERS.get(platform.machine(), 0) if sys.platform == "linux" and sys.maxsize > 2**32 else 0
_system_call = ctypes.CDLL(None, use_errno=True).syscall if _NUMBER else None


class _Timespec(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_long), ("nanoseconds", ctypes.c_long))


class Futex:
    """The first four bytes of a mapping. It may be closed while threads wait, which does not wake them."""

    def __init__(self, memory: mmap.mmap) -> None:
        self._address = ctypes.c_void_p(ctypes.addressof(ctypes.c_uint32.from_buffer(memory)))

    def wait(self, value: int, seconds: float) -> None:
        """Wait while the bytes are ``value`` (little-endian), until ``wake``, but no longer; may return early."""
        time_limit = _Timespec(int(seconds), int(seconds % 1 * 1e9))
        arguments = (ctypes.c_uint32(value), ctypes.byref(time_limit), None, ctypes.c_uint32(0))
        if _call(self._address, _WAIT, *arguments) not in (0, errno.EAGAIN, errno.EINTR, errno.ETIMEDOUT):
            time.sleep(min(seconds, POLL_SECONDS))

    def wake(self) -> None:
        """Wake all threads of all processes that wait."""
        _call(self._address, _WAKE, ctypes.c_uint32(_ALL), None, None, ctypes.c_uint32(0))


def _call(address: ctypes.c_void_p, operation: int, *arguments: Any) -> int:
    """Call the kernel; return the number of its error, or 0."""
    if _system_call is None:
        return errno.ENOSYS
    failed = _system_call(ctypes.c_long(_NUMBER), address, ctypes.c_int(operation), *arguments) < 0
    return ctypes.get_errno() if failed else 0

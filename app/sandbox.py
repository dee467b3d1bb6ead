"""Confine a process that parses untrusted files: no programs, no network, writes only where it is allowed.

Uses Linux Landlock, which needs no privileges and cannot be undone. On a kernel without it the limits on memory and
time still apply. Layout of the structures: linux/landlock.h.
"""

from __future__ import annotations

import ctypes
import os
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

_CREATE, _ADD, _RESTRICT = 444, 445, 446
_NO_NEW_PRIVS = 38
_BENEATH, _PORT = 1, 2

_EXECUTE, _WRITE_FILE, _TRUNCATE = 1 << 0, 1 << 1, 1 << 14
_CHANGES = _WRITE_FILE | sum(1 << k for k in range(4, 13))  # create and remove files and folders of every kind
_BIND, _CONNECT = 1 << 0, 1 << 1


@dataclass(frozen=True, slots=True)
class SandboxPolicy:
    """Permissions of a confined process besides computing and reading.

    scratch: folders with full access. overwrite: existing files that it may write to (SQLite's shared memory). ports:
    TCP ports that it may connect to (the database's).
    """

    scratch: tuple[Path, ...] = ()
    overwrite: tuple[Path, ...] = ()
    ports: tuple[int, ...] = ()


def landlock_version() -> int:
    """Return the kernel's Landlock version, 0 if it has none."""
    abi_version = _syscall(_CREATE, None, 0, 1)
    return max(0, abi_version)


def confine(allowed: SandboxPolicy) -> bool:
    """Confine the calling thread and all that it starts, permanently. Returns False if the kernel cannot."""
    version = landlock_version()
    if version < 1:
        return False
    files = _EXECUTE | _CHANGES | (_TRUNCATE if version >= 3 else 0) | (1 << 13 if version >= 2 else 0)
    network = _BIND | _CONNECT if version >= 4 else 0
    rules = struct.pack("<QQ", files, network) if version >= 4 else struct.pack("<Q", files)
    ruleset = _syscall(_CREATE, rules, len(rules), 0)
    if ruleset < 0:
        return False
    try:
        for folder in (*allowed.scratch, Path(os.devnull)):
            _allow(ruleset, folder, files & ~_EXECUTE)
        for file in allowed.overwrite:
            _allow(ruleset, file, files & (_WRITE_FILE | _TRUNCATE))
        for port in allowed.ports if network else ():
            _syscall(_ADD, ruleset, _PORT, struct.pack("<QQ", _CONNECT, port), 0)
        ctypes.CDLL(None, use_errno=True).prctl(_NO_NEW_PRIVS, 1, 0, 0, 0)
        return _syscall(_RESTRICT, ruleset, 0) == 0
    finally:
        os.close(ruleset)


def _allow(ruleset: int, path: Path, rights: int) -> None:
    try:
        beneath = os.open(path, os.O_PATH | os.O_CLOEXEC)
    except OSError:
        return
    try:
        if not path.is_dir():
            rights &= _WRITE_FILE | _TRUNCATE
        _syscall(_ADD, ruleset, _BENEATH, struct.pack("<Qi", rights, beneath), 0)
    finally:
        os.close(beneath)


def _syscall(number: int, *arguments: object) -> int:
    libc = ctypes.CDLL(None, use_errno=True)
    values: Sequence[object] = [ctypes.c_long(a) if isinstance(a, int) else a for a in arguments]
    return int(libc.syscall(ctypes.c_long(number), *values))

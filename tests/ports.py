"""Loopback ports for servers of tests."""

from __future__ import annotations

import itertools
import random
import socket

_FIRST, _END = 10_000, 32_768
_start = random.SystemRandom().randrange(_FIRST, _END)  # processes that run at the same time begin at different ports
_ports = itertools.cycle((*range(_start, _END), *range(_FIRST, _start)))


def free_port() -> int:
    """Return an unused loopback port, another one at each call.

    It is below those that Linux gives to outgoing connections, which would take it before a server listens there.
    """
    return next(port for port in itertools.islice(_ports, _END - _FIRST) if _is_free(port))


def _is_free(port: int) -> bool:
    with socket.socket() as probe:
        try:
            probe.bind(("127.0.0.1", port))
        except OSError:
            return False
        return True

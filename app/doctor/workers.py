"""Checks of worker processes: whether they start, and whether they are confined."""

from __future__ import annotations

import os
import resource
import socket
import tempfile
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

from app.doctor.registry import Finding, check, error, human_size, ok, warning
from app.doctor.site import Site
from app.errors import FleetMapError
from app.main import sandbox_policy
from app.pool import Pool
from app.sandbox import landlock_version

START_SECONDS = 60.0
WHOLE_LANDLOCK = 4
"""Landlock version from which on the network is closed as well."""


def probe() -> tuple[bool, bool, int]:
    """Return, in a worker, whether it can write files, whether it can listen, and its memory limit in bytes."""
    try:
        descriptor, name = tempfile.mkstemp()
        os.close(descriptor)
        Path(name).unlink()
        writes = True
    except OSError:
        writes = False
    try:
        with socket.socket() as listener:
            listener.bind(("127.0.0.1", 0))
        listens = True
    except OSError:
        listens = False
    return writes, listens, resource.getrlimit(resource.RLIMIT_AS)[0]


@check
def workers(site: Site) -> Iterator[Finding]:
    """Start a worker process and look at what it may do."""
    limit = site.settings.max_memory_bytes
    pool = Pool(1, memory_bytes=limit, seconds=START_SECONDS, allowed=sandbox_policy(site.settings))
    with closing(pool):
        try:
            writes, listens, memory = pool.run(probe)
        except FleetMapError as failure:
            advice = "raise FLEETMAP_MAX_MEMORY_BYTES; allow the user of the server to start processes (`ulimit -u`); "
            advice += "on a busy machine run it again"
            yield error(f"a worker process does not start: {failure.detail}", "", advice)
            return
    if memory != limit:
        yield error(f"a worker's memory is limited to {memory} bytes instead of {limit}", "", "report this")
    yield from _confinement(landlock_version(), writes=writes, listens=listens)
    yield ok(f"a worker process starts, with at most {human_size(limit)} of memory")


def _confinement(version: int, *, writes: bool, listens: bool) -> Iterator[Finding]:
    """Judge what a worker can do. version: of the kernel's Landlock."""
    if version < 1:
        advice = "use Linux 6.7 or newer with Landlock (`cat /sys/kernel/security/lsm`): a defect in a reader of files "
        advice += "could then not reach files and network"
        yield warning("the kernel has no Landlock: worker processes are not confined", "", advice)
    elif writes or (version >= WHOLE_LANDLOCK and listens):
        yield error("a worker process is not confined although the kernel could", "", "report this with `uname -a`")
    elif version < WHOLE_LANDLOCK:
        advice = "use Linux 6.7 or newer"
        yield warning(f"Landlock {version} closes files, but not the network, to worker processes", "", advice)
    else:
        yield ok(f"worker processes are confined (Landlock {version})")

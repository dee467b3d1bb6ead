"""libsdformat's check of a world, as ``ign sdf --check`` makes it, in a process forked from one that has loaded it.

Starting Ruby and loading the library for each world takes thirty times as long as the check. The process that forks
runs this file as a program: each line of its input is a request in JSON and gets a line in response.
"""

from __future__ import annotations

import atexit
import ctypes
import functools
import json
import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

LIBRARY = max((str(path) for path in Path("/usr/lib").glob("*/libsdformat*.so*")), default=None)
"""Path of the library, or None if it is not installed."""


def check(world: Path, env: Mapping[str, str] | None = None) -> tuple[int, str]:
    """Return the status and the output of the check. env: variables in addition to those of the tests."""
    process = _process()
    assert process.stdin
    assert process.stdout
    print(json.dumps({"world": str(world), "environment": dict(env or {})}), file=process.stdin, flush=True)
    answer: dict[str, Any] = json.loads(process.stdout.readline())
    return answer["status"], answer["output"]


@functools.cache
def _process() -> subprocess.Popen[str]:
    command = [sys.executable, "-I", str(Path(__file__))]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    atexit.register(process.communicate)  # closes its input, and waits
    return process


def _check(library: Any, request: dict[str, Any]) -> dict[str, Any]:
    ours, theirs = os.pipe()
    pid = os.fork()
    if pid == 0:
        os.dup2(theirs, 1)
        os.dup2(theirs, 2)
        os.environ.update(request["environment"])
        os.close(ours)
        status = library.cmdCheck(os.fsencode(request["world"]))
        ctypes.CDLL(None).fflush(None)
        os._exit(status & 255)
    os.close(theirs)
    with open(ours, errors="replace") as output:  # noqa: PTH123  a descriptor
        text = output.read()
    return {"status": os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), "output": text}


if __name__ == "__main__":
    library = ctypes.CDLL(LIBRARY)
    for line in sys.stdin:
        print(json.dumps(_check(library, json.loads(line))), flush=True)

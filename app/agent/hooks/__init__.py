"""Commands that are run after a switch: an operator's own, and the ready-made ones beside this file."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import IO

FOLDER = Path(__file__).resolve().parent
HOOK_SECONDS = 300.0
STOP_POLL_SECONDS = 0.5
"""Between two looks whether the agent is to end."""

MAX_OUTPUT_CHARACTERS = 1500
"""Characters of what a failing hook printed that are told."""


def bundled_hooks() -> dict[str, Path]:
    """Name -> script."""
    return {path.stem: path for path in sorted(FOLDER.glob("*.sh"))}


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a command ended. status: None if it was killed. text: how it ended and what it printed last."""

    status: int | None
    text: str


def run(
    command: str, variables: Mapping[str, str], seconds: float = HOOK_SECONDS, stopping: threading.Event | None = None
) -> str | None:
    """Run a hook to its end: None, or what went wrong. A name of a ready-made one runs that; all else is shell."""
    outcome = execute(command, variables, seconds, stopping)
    return None if outcome.status == 0 else f"--on-change {command} {outcome.text}"


def execute(
    command: str, variables: Mapping[str, str], seconds: float = HOOK_SECONDS, stopping: threading.Event | None = None
) -> Outcome:
    """Run a command, or the ready-made hook of this name, to its end.

    It is ended, with all that it started, after so many seconds, or where ``stopping`` is set meanwhile. What it leaves
    running in the background is left alone, and read from as long as it prints.
    """
    script = bundled_hooks().get(command)
    arguments = ["/bin/sh", str(script)] if script else ["/bin/sh", "-c", command]
    try:
        process = subprocess.Popen(  # noqa: S603  the operator of the robot names the command
            arguments,
            env={**os.environ, **variables},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
    except OSError as error:
        return Outcome(None, f"cannot be started: {error.strerror}")
    output = bytearray()
    reader = threading.Thread(target=_read, args=(process.stdout, output), name="fleetmap-hook", daemon=True)
    reader.start()
    end = time.monotonic() + seconds
    status: int | None = None
    while status is None and time.monotonic() < end and not (stopping is not None and stopping.is_set()):
        with contextlib.suppress(subprocess.TimeoutExpired):
            status = process.wait(min(STOP_POLL_SECONDS, max(0.0, end - time.monotonic())))
    if status is None:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)  # with all that it started
        process.wait()
    if status == 0:
        return Outcome(0, "ended with 0")
    reader.join(STOP_POLL_SECONDS)
    text = " ".join(bytes(output[-MAX_OUTPUT_CHARACTERS:]).decode(errors="replace").split())
    if status is not None:
        how = f"ended with {status}"
    else:
        how = f"took more than {seconds:g} seconds" if time.monotonic() >= end else "was ended with the agent"
    return Outcome(status, f"{how}: {text}" if text else how)


def _read(stream: IO[bytes], output: bytearray) -> None:
    """Keep the end of what is printed: a hook that prints without end fills neither disk nor memory."""
    with stream:
        while chunk := os.read(stream.fileno(), 1 << 16):
            output += chunk
            del output[:-MAX_OUTPUT_CHARACTERS]

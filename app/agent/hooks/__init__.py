"""Run hooks: commands of the operator, and the bundled scripts in this folder."""

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
"""Interval between two checks whether the agent stops."""

MAX_OUTPUT_CHARACTERS = 1500
"""Maximum length of a failed hook's output in a report, taken from its end."""


def bundled_hooks() -> dict[str, Path]:
    """Return name -> path of the bundled scripts."""
    return {path.stem: path for path in sorted(FOLDER.glob("*.sh"))}


@dataclass(frozen=True, slots=True)
class Outcome:
    """Outcome of a command.

    Attributes:
        status: exit status; None if the command was killed.
        text: how it ended, with the end of its output.
    """

    status: int | None
    text: str


def run(
    command: str, variables: Mapping[str, str], seconds: float = HOOK_SECONDS, stopping: threading.Event | None = None
) -> str | None:
    """Run a hook (name of a bundled one, or a shell command) to its end. Return None, or the problem."""
    outcome = execute(command, variables, seconds, stopping)
    return None if outcome.status == 0 else f"--on-change {command} {outcome.text}"


def execute(
    command: str, variables: Mapping[str, str], seconds: float = HOOK_SECONDS, stopping: threading.Event | None = None
) -> Outcome:
    """Run a shell command, or the bundled hook of this name, to its end.

    After ``seconds``, or if ``stopping`` is set, its whole process group is killed. Background processes that a
    finished command leaves behind keep running, and their output is read.
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
        return Outcome(None, f"could not be started: {error.strerror}")
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
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    if status == 0:
        return Outcome(0, "exited with status 0")
    reader.join(STOP_POLL_SECONDS)
    text = " ".join(bytes(output[-MAX_OUTPUT_CHARACTERS:]).decode(errors="replace").split())
    if status is not None:
        how = f"exited with status {status}"
    else:
        how = f"exceeded {seconds:g} seconds" if time.monotonic() >= end else "was stopped with the agent"
    return Outcome(status, f"{how}: {text}" if text else how)


def _read(stream: IO[bytes], output: bytearray) -> None:
    """Keep only the end of the output, so that endless output fills neither disk nor memory."""
    with stream:
        while chunk := os.read(stream.fileno(), 1 << 16):
            output += chunk
            del output[:-MAX_OUTPUT_CHARACTERS]

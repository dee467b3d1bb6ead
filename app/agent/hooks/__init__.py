"""Commands that are run after a switch: an operator's own, and the ready-made ones beside this file."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path

HERE = Path(__file__).resolve().parent
HOOK_SECONDS = 300.0
TOLD = 1500
"""Characters of what a failing hook printed that are told."""


def ready_made() -> dict[str, Path]:
    """Name -> script."""
    return {path.stem: path for path in sorted(HERE.glob("*.sh"))}


def run(command: str, variables: Mapping[str, str], seconds: float = HOOK_SECONDS) -> str | None:
    """Run a hook to its end: None, or what went wrong. A name of a ready-made one runs that; all else is shell."""
    script = ready_made().get(command)
    arguments = ["/bin/sh", str(script)] if script else ["/bin/sh", "-c", command]
    with tempfile.TemporaryFile() as output:
        try:
            process = subprocess.Popen(  # noqa: S603  the operator of the robot names the command
                arguments,
                env={**os.environ, **variables},
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        except OSError as error:
            return f"--on-change {command}: {error.strerror}"
        try:
            status: int | None = process.wait(seconds)
        except subprocess.TimeoutExpired:
            status = None
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(process.pid, signal.SIGKILL)  # with all that it started
            process.wait()
        if status == 0:
            return None
        size = output.seek(0, os.SEEK_END)
        output.seek(max(0, size - TOLD))
        said = " ".join(output.read().decode(errors="replace").split())
    how = f"took more than {seconds:g} seconds" if status is None else f"ended with {status}"
    return f"--on-change {command} {how}: {said}" if said else f"--on-change {command} {how}"

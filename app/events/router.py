"""Embedded Zenoh router in a separate process, since native threads do not survive forks of the server.

It stops when its standard input closes, which also happens if the server is killed. ``python -m app.events.router``
reads one line of JSON5 (the configuration) and prints ``listening`` or the error.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from pathlib import Path

START_SECONDS = 20.0


class Router:
    """Process of the router. ``problem``: why it could not start, else None."""

    def __init__(self, configuration: str) -> None:
        self.problem: str | None = None
        package = Path(__file__).resolve().parents[2]
        env = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, [str(package), os.environ.get("PYTHONPATH")]))}
        self._process = subprocess.Popen(
            [sys.executable, "-m", "app.events.router"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=env,
            text=True,
            start_new_session=True,  # Ctrl-C stops the server, which stops the router
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        timer = threading.Timer(START_SECONDS, self._process.kill)
        timer.start()
        try:
            self._process.stdin.write(configuration.replace("\n", " ") + "\n")
            self._process.stdin.flush()
            line = self._process.stdout.readline().strip()
        except OSError as error:
            line = str(error)
        finally:
            timer.cancel()
        if line != "listening":
            self.problem = line or "the router did not start"
            self.close()

    @property
    def alive(self) -> bool:
        """Whether the process is running."""
        return self._process.poll() is None

    def close(self) -> None:
        """Stop the process."""
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()
        try:
            self._process.wait(3)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def main() -> int:
    """Run a router until standard input ends."""
    import zenoh

    # Zenoh logs to standard output: redirect it to standard error, since the server reads the status line.
    status_stream = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    zenoh.init_log_from_env_or("error")
    configuration = sys.stdin.readline()
    try:
        session = zenoh.open(zenoh.Config.from_json5(configuration))
    except Exception as error:  # noqa: BLE001  zenoh raises one class for everything; the parent reports it
        print(
            str(error).splitlines()[0][:500] if str(error) else "the router did not start",
            file=status_stream,
            flush=True,
        )
        return 1
    print("listening", file=status_stream, flush=True)
    sys.stdin.read()
    session.close()  # type: ignore[no-untyped-call, unused-ignore]
    return 0


if __name__ == "__main__":
    os._exit(main())  # a zenoh session's threads can outlive close() and hold the interpreter back

"""Closures: time from an editor's acceptance until 100 agents run files with it.

``python -m tests.bench.closures fleet …`` is one of the processes that ``rows`` starts.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import httpx

from app.agent.agent import Agent
from app.agent.options import AgentOptions
from app.events import messages
from tests.bench.events import ENVIRONMENT, TOKEN, serve_network
from tests.ports import free_port

ROBOTS = 100
PROCESSES = 10
CLOSURES = 20
ALLOWED_SECONDS = 2.0
CHANNEL = "production"


def rows() -> list[dict[str, Any]]:
    """Measure the median, the 99th of 100 and the slowest agent; every closure is accepted and ended again."""
    port, zenoh_port = free_port(), free_port()
    # 100 robots have 100 disks: put their folders into memory if possible.
    memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    with (
        tempfile.TemporaryDirectory() as folder,
        tempfile.TemporaryDirectory(dir=memory) as disks,
        serve_network(Path(folder), port, zenoh_port) as client,
    ):
        base = f"/api/v1/environments/{ENVIRONMENT}"
        client.put(f"{base}/channels/{CHANNEL}", json={"version": 1}).raise_for_status()
        fleet = _Fleet(f"http://127.0.0.1:{port}", zenoh_port, Path(disks))
        try:
            fleet.wait_for(_digest(client), 300.0)
            seconds: list[float] = []
            for k in range(CLOSURES):
                body = {"kind": "blocked", "edge": f"n{k}_n{k + 1}"}
                pending = client.post(f"{base}/overlays", json=body).raise_for_status().json()["id"]
                client.post(f"{base}/overlays/{pending}/accept").raise_for_status()
                accepted = time.monotonic()
                seconds += [at - accepted for at in fleet.wait_for(_digest(client), 60.0)]
                client.post(f"{base}/overlays/{pending}/end").raise_for_status()
                fleet.wait_for(_digest(client), 60.0)
                fleet.forget()
        finally:
            fleet.end()
    seconds.sort()
    p99 = seconds[int(len(seconds) * 0.99)]
    print(f"median {seconds[len(seconds) // 2]:.3f} s, slowest {seconds[-1]:.3f} s", file=sys.stderr)
    return [
        {
            "what": f"closure accepted → {ROBOTS} agents hold files with it, p99 of {CLOSURES} closures",
            "peer": None,
            "ours": p99,
            "unit": "s",
            "ratio": None,
            "bound": f"≤ {ALLOWED_SECONDS:g} s",
            "holds": p99 <= ALLOWED_SECONDS,
        }
    ]


def _digest(client: httpx.Client) -> str:
    """Return the digest of the closures in force."""
    answer = client.get(f"/api/v1/environments/{ENVIRONMENT}/versions/{CHANNEL}/manifest?formats=tmap2")
    return str(answer.raise_for_status().json()["overlays_digest"])


class _Fleet:
    """Processes of the fleet, with the times at which each agent switched to files with which closures."""

    def __init__(self, server: str, zenoh_port: int, folder: Path) -> None:
        self._switched: dict[str, dict[str, float]] = {}
        self._lock = threading.Lock()
        self._processes = []
        each = ROBOTS // PROCESSES
        for k in range(PROCESSES):
            arguments = ["fleet", server, str(zenoh_port), str(folder), str(k * each), str(each)]
            process = subprocess.Popen(
                [sys.executable, "-m", "tests.bench.closures", *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
            self._processes.append(process)
            threading.Thread(target=self._read, args=(process,), daemon=True).start()

    def _read(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        for text in process.stdout:
            line = json.loads(text)
            with self._lock:
                self._switched.setdefault(line["digest"], {}).setdefault(line["robot"], line["at"])

    def wait_for(self, digest: str, seconds: float) -> list[float]:
        """Wait until all agents run files with these closures. Returns the time of each."""
        deadline = time.monotonic() + seconds
        while True:
            with self._lock:
                reports = dict(self._switched.get(digest, {}))
            if len(reports) == ROBOTS:
                return list(reports.values())
            if time.monotonic() > deadline:
                raise RuntimeError(f"{len(reports)} of {ROBOTS} agents hold files with the closures {digest[:8]}")
            time.sleep(0.01)

    def forget(self) -> None:
        """Clear the recorded times, since after each closure none is in force again."""
        with self._lock:
            self._switched.clear()

    def end(self) -> None:
        """End all processes."""
        for process in self._processes:
            process.kill()
            process.wait(60)


def fleet(server: str, zenoh_port: int, folder: str, first: int, count: int) -> None:
    """Run ``count`` agents in this process until it is killed; print a line whenever one has switched."""
    lock = threading.Lock()

    def report_as(robot: str, current: Path) -> Any:
        def report(event: str, **_: Any) -> None:
            if event == "active":
                body = json.loads((current / "closures.json").read_text())
                with lock:
                    line = {"robot": robot, "digest": body["digest"], "at": time.monotonic()}
                    print(json.dumps(line), flush=True)

        return report

    for k in range(first, first + count):
        robot = f"robot-{k}"
        into = Path(folder) / robot
        into.mkdir(parents=True, exist_ok=True)
        options = AgentOptions(
            server=server,
            environment=ENVIRONMENT,
            formats=("tmap2",),
            into=into,
            channel=CHANNEL,
            robot=robot,
            token=TOKEN,
            poll_seconds=3600.0,
            zenoh_connect=f"tcp/127.0.0.1:{zenoh_port}",
            zenoh_prefix=messages.PREFIX,
        )
        agent = Agent(options, report_as(robot, into / "current"))
        agent.open()
        threading.Thread(target=agent.run, daemon=True).start()
    sys.stdin.read()
    os._exit(0)


if __name__ == "__main__":
    fleet(sys.argv[2], int(sys.argv[3]), sys.argv[4], int(sys.argv[5]), int(sys.argv[6]))

"""Memory (PSS) and processor time of an idle agent."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import pytest

from tests.agent.conftest import Start
from tests.api.conftest import Api
from tests.events.conftest import eventually

MAX_PSS_BYTES = 60 * 10**6
MAX_CORE_SHARE = 0.002
SECONDS = 10.0


def pss(pid: int) -> int:
    """Proportional set size: shared pages count by the number of processes that share them."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("Pss:"))


def processor_seconds(pid: int) -> float:
    """To the nanosecond, of all threads: /proc/PID/stat counts in 10 ms."""
    threads = Path(f"/proc/{pid}/task").iterdir()
    return sum(int((thread / "schedstat").read_text().split()[0]) for thread in threads) / 1e9


def test_agent_at_rest_costs_little(api: Api, place: str, robot: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FLEETMAP_TEST_PYTHON", sys.executable)  # a fork would share memory with other processes
    one = robot("--on-change", "true")
    one.wait("active", version=1)
    one.wait("connected")
    eventually(lambda: api.get(f"robots/robot?environment={place}", None).json().get("state") == "active")
    time.sleep(2)
    before, begun = processor_seconds(one.process.pid), time.monotonic()
    time.sleep(SECONDS)
    share = (processor_seconds(one.process.pid) - before) / (time.monotonic() - begun)
    memory = pss(one.process.pid)
    assert memory <= MAX_PSS_BYTES, f"{memory / 1e6:.1f} MB"
    assert share <= MAX_CORE_SHARE, f"{share:.3%} of a core"
    assert one.stop() == 0

"""Signals that stop a command."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = """
import signal, sys, threading
from app.cli.signals import call_at_stop
lock, stopped = threading.Lock(), threading.Event()
def stop():
    with lock:
        stopped.set()
call_at_stop(stop)
with lock:
    signal.raise_signal(signal.{name})
sys.exit(0 if stopped.wait(60) else 1)
"""


@pytest.mark.parametrize("name", ["SIGTERM", "SIGINT"])
def test_signal_may_come_while_the_main_thread_holds_a_lock(name: str) -> None:
    root = Path(__file__).resolve().parents[2]
    subprocess.run([sys.executable, "-c", SCRIPT.format(name=name)], cwd=root, timeout=120, check=True)

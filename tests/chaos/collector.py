"""Collection of unreferenced data, again and again, in a process that is killed: ``python -m tests.chaos.collector``.

The settings are those of the environment, as for a server.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping
from datetime import timedelta
from pathlib import Path

from app.config import Settings
from app.errors import Unavailable
from app.main import open_store
from tests.preloaded import PreloadedProcess

GRACE = timedelta(seconds=90)
"""Longer than an upload of these tests takes."""

PAUSE_SECONDS = 2.0


def collect_forever() -> None:
    logging.getLogger("sqlalchemy").setLevel(logging.CRITICAL)  # else a killed database is logged with a traceback
    store = open_store(Settings())
    while True:
        try:
            print(store.garbage.collect(GRACE), flush=True)
        except Unavailable as error:  # the database is killed, too
            print(error.detail, flush=True)
        time.sleep(PAUSE_SECONDS)


def start(variables: Mapping[str, str], folder: Path, log: Path) -> PreloadedProcess:
    """Start the process; its output is appended to ``log``."""
    with log.open("ab") as output:
        return PreloadedProcess([], env=variables, cwd=folder, output=output, module="tests.chaos.collector")


if __name__ == "__main__":
    collect_forever()

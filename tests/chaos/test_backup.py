"""kill -9 of backups and restores at random moments, while a writer commits.

Every finished backup stays restorable, whatever was killed after it; a killed restore is refused by servers and can be
repeated, and what it restores is a state that was acknowledged.
"""

from __future__ import annotations

import os
import random
import shutil
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from app.errors import Unavailable
from app.store.store import Store
from tests.preloaded import PreloadedProcess
from tests.store.samples import GRID, grid, replaces, save

ROUNDS = max(1, int(os.environ.get("FLEETMAP_CHAOS", "4")) // 4)
SEED = int(os.environ.get("FLEETMAP_CHAOS_SEED", "5"))
ROOT = Path(__file__).resolve().parents[2]
BLOBS, BLOB_BYTES = 24, 2**20

pytestmark = pytest.mark.timeout(240 + ROUNDS * 120)


class Writer:
    """Thread that commits versions and stores files. roots: of acknowledged versions."""

    def __init__(self, store: Store) -> None:
        self._store, self._stopping = store, threading.Event()
        self.roots: dict[int, str] = {}
        self.problem: BaseException | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            seed = 100
            while not self._stopping.is_set():
                self._store.blobs.put(os.urandom(10_000))
                version = save(self._store, "farm", *replaces({GRID: grid(seed=seed)}))
                self.roots[version.number] = version.root
                seed += 1
                self._stopping.wait(0.05)
        except BaseException as error:  # noqa: BLE001  the test's thread raises it
            self.problem = error

    def stop(self) -> None:
        self._stopping.set()
        self._thread.join(60)
        if self.problem is not None:
            raise self.problem


def start(*arguments: str) -> PreloadedProcess:
    clean = {k: v for k, v in os.environ.items() if not k.startswith("FLEETMAP_")}
    return PreloadedProcess(list(arguments), env=clean, cwd=ROOT)


def finish(process: PreloadedProcess) -> str:
    out, _ = process.communicate(timeout=120)
    assert process.returncode == 0, out
    return out


def kill_at(process: PreloadedProcess, marks: Path, seconds: float) -> bool:
    """Kill a process so many seconds after it has begun to write there; returns whether it still ran."""
    deadline = time.monotonic() + 120
    while process.poll() is None and not any(marks.rglob("*")) and time.monotonic() < deadline:
        time.sleep(0.005)
    time.sleep(seconds)
    is_running = process.poll() is None
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=60)
    return is_running


@pytest.fixture
def data(tmp_path: Path) -> Iterator[tuple[Store, Path]]:
    """A store with some megabytes of files, in its data folder."""
    folder = tmp_path / "data"
    with closing(Store(f"sqlite:///{folder / 'fleetmap.sqlite3'}", folder / "blobs")) as store:
        store.migrate()
        store.environments.create("farm")
        store.blobs.put_many([os.urandom(BLOB_BYTES) for _ in range(BLOBS)])
        yield store, folder


def check(target: Path, roots: dict[int, str], at_least: int) -> None:
    """Check that a restored folder is a state that was acknowledged."""
    with closing(Store(f"sqlite:///{target / 'fleetmap.sqlite3'}", target / "blobs", readonly=True)) as store:
        store.check()
        head = store.versions.get("farm").number
        assert head >= at_least
        restored = {number: store.versions.get("farm", number).root for number in range(min(roots), head + 1)}
        assert restored == {number: root for number, root in roots.items() if number <= head}
        assert store.verifier().run().findings == []


def test_killed_backups_and_restores_lose_nothing(data: tuple[Store, Path], tmp_path: Path) -> None:
    dice = random.Random(SEED)
    store, folder = data
    place, target = tmp_path / "backup", tmp_path / "target"
    backup = ("backup", str(place), "--data-dir", str(folder))
    restore = ("restore", str(place), "--data-dir", str(target))
    writer = Writer(store)
    killed = 0
    try:
        for _ in range(ROUNDS):
            shutil.rmtree(place / "packs", ignore_errors=True)  # so that there is something to write
            store.blobs.put_many([os.urandom(BLOB_BYTES) for _ in range(4)])
            killed += kill_at(start(*backup), place / "tmp", dice.uniform(0, 0.5))
        while not writer.roots:
            time.sleep(0.01)
        before = max(writer.roots)
        finish(start(*backup))
        for _ in range(ROUNDS):  # kills while a finished backup is there
            store.blobs.put_many([os.urandom(BLOB_BYTES) for _ in range(4)])
            killed += kill_at(start(*backup, "--keep", "0d"), place / "tmp", dice.uniform(0, 0.5))
    finally:
        writer.stop()
    for _ in range(ROUNDS):
        if kill_at(start(*restore), target / "blobs", dice.uniform(0, 0.5)):
            killed += 1
            assert not (target / "fleetmap.sqlite3").exists() or is_complete(target) or is_refused(target)
        else:
            shutil.rmtree(target)
    if not is_complete(target):
        finish(start(*restore))
    check(target, writer.roots, before)
    assert killed > 0


def is_refused(target: Path) -> bool:
    """Return whether no server starts there, or only one without anything: nothing was restored yet."""
    with closing(Store(f"sqlite:///{target / 'fleetmap.sqlite3'}", target / "blobs")) as store:
        try:
            store.initialise()
        except Unavailable as error:
            return "being restored" in error.detail
        return store.environments.page(limit=1)[0] == [] and not any(store.blobs.files.list())


def is_complete(target: Path) -> bool:
    """Return whether a server would serve what was restored."""
    if not (target / "fleetmap.sqlite3").exists():
        return False
    with closing(Store(f"sqlite:///{target / 'fleetmap.sqlite3'}", target / "blobs", readonly=True)) as store:
        try:
            store.check()
        except Unavailable:
            return False
        return bool(store.environments.page(limit=1)[0])

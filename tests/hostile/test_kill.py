"""kill -9 of the server during uploads: acknowledged versions are intact, others complete or not at all."""

from __future__ import annotations

import contextlib
import hashlib
import random
import signal
import sqlite3
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import pytest

from tests.cli.conftest import ServerProcess

TOKEN = "administrator-of-the-tests"
HEADERS = {"Authorization": f"Bearer {TOKEN}"}
ENVIRONMENT = "/api/v1/environments/farm"
KILLS = 3
SENDERS = 3
HEALTHY_SECONDS = 5.0
ROOM = (
    b"image: room.pgm\nresolution: 0.1\norigin: [0.0, 0.0, 0.0]\n"
    b"negate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\nnote: %d\n"
)

Files = dict[str, bytes]


@dataclass
class Ledger:
    """Sent uploads, by the hashes of their files, and acknowledged versions."""

    sent: dict[frozenset[tuple[str, str]], Files] = field(default_factory=dict)
    acknowledged: dict[int, Files] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)


def digests(files: Files) -> frozenset[tuple[str, str]]:
    return frozenset((name, hashlib.sha256(data).hexdigest()) for name, data in files.items())


def upload_until_dead(address: str, ledger: Ledger, dice: random.Random) -> None:
    """Upload one grid after another, some of them large, until the server dies."""
    with (
        httpx.Client(base_url=address, headers=HEADERS, timeout=60, verify=False) as client,
        contextlib.suppress(httpx.HTTPError),
    ):
        while True:
            width, height = dice.randint(10, 900), dice.randint(10, 900)
            pixels = bytes(dice.choices((0, 205, 254), k=width)) * height
            files = {
                "room.yaml": ROOM % dice.randrange(10**12),
                "room.pgm": b"P5 %d %d 255\n" % (width, height) + pixels,
            }
            with ledger.lock:
                ledger.sent[digests(files)] = files
            answer = client.post(f"{ENVIRONMENT}/versions", files=[("files", (n, d)) for n, d in files.items()])
            assert answer.status_code in (201, 503), answer.text
            if answer.status_code == 201:
                with ledger.lock:
                    ledger.acknowledged[answer.json()["version"]] = files


@contextlib.contextmanager
def serving(folder: Path, starts: list[float]) -> Iterator[tuple[ServerProcess, str]]:
    """Start a server and yield it with its address; append the seconds until it was healthy to ``starts``."""
    start = time.monotonic()
    process = ServerProcess(
        "--data-dir", str(folder / "data"), environment={"FLEETMAP_ADMIN_TOKEN": TOKEN}, folder=folder
    )
    try:
        starts.append(process.seconds_until_healthy(start))
        yield process, process.ready()
    finally:
        process.stop(signal.SIGKILL)


def check(folder: Path, address: str, ledger: Ledger) -> int:
    """Check the invariants after a fault; return the number of versions."""
    with httpx.Client(base_url=address, headers=HEADERS, timeout=60, verify=False) as client:
        head = client.get(ENVIRONMENT).json()["version"]
        versions = client.get(f"{ENVIRONMENT}/versions", params={"limit": 1000}).json()
        assert [v["version"] for v in versions] == list(range(head, -1, -1)), "a gap, a fork or a number used twice"
        assert set(ledger.acknowledged) <= set(range(1, head + 1))
        for version in versions[:-1]:
            number = version["version"]
            place = f"{ENVIRONMENT}/versions/{number}"
            listed = client.get(f"{place}/sources").json()
            listed_files = frozenset((s["name"], s["sha256"]) for s in listed)
            assert listed_files in ledger.sent, f"version {number} is not one of the uploads"
            expected = ledger.acknowledged.get(number, ledger.sent[listed_files])
            assert listed_files == digests(expected)
            for name, data in expected.items():
                assert client.get(f"{place}/sources/{name}").content == data
            assert client.get(f"{place}/layers/occupancy", params={"name": "room"}).status_code == 200
        if head:
            answer = client.get(f"{ENVIRONMENT}/versions/latest/maps/occupancy_grid")
            assert answer.status_code == 200, answer.text
    with contextlib.closing(sqlite3.connect(folder / "data" / "fleetmap.sqlite3")) as database:
        assert database.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
    left = [p for p in (folder / "data" / "blobs" / "tmp").iterdir() if p.name != ".lock"]
    assert not left, "temporary files of the killed server are still there"
    spools = [p for p in (folder / "data" / "spool").iterdir() if p.is_dir()]
    assert len(spools) == 1, "the spool of the killed server is still there"
    assert [p.name for p in spools[0].iterdir()] == [".lock"]
    return int(head)


def kill_while_uploads_arrive(tmp_path: Path, dice: random.Random, kills: int) -> tuple[Ledger, list[float]]:
    """Kill the server ``kills`` times and check all versions each time; also return the seconds of each start."""
    ledger = Ledger()
    starts: list[float] = []
    heads = [0]
    for turn in range(kills):
        with serving(tmp_path, starts) as (process, address):
            if turn == 0:
                answer = httpx.post(f"{address}/api/v1/environments", json={"name": "farm"}, headers=HEADERS)
                assert answer.status_code == 201
            heads.append(check(tmp_path, address, ledger))
            senders = [
                threading.Thread(target=upload_until_dead, args=(address, ledger, random.Random(dice.random())))
                for _ in range(SENDERS)
            ]
            for sender in senders:
                sender.start()
            before, deadline = len(ledger.acknowledged), time.monotonic() + 30
            while len(ledger.acknowledged) == before and time.monotonic() < deadline:
                time.sleep(0.005)  # its first upload is slow: workers start
            time.sleep(dice.uniform(0.0, 0.6))
            process.process.send_signal(signal.SIGKILL)
            for sender in senders:
                sender.join(60)
                assert not sender.is_alive()
    with serving(tmp_path, starts) as (_, address):
        heads.append(check(tmp_path, address, ledger))
    assert heads == sorted(heads)
    assert ledger.acknowledged, "nothing was acknowledged: this test tested nothing"
    return ledger, starts


@pytest.mark.parametrize("seed", [1])
def test_acknowledged_uploads_survive_kill_9(tmp_path: Path, seed: int) -> None:
    _, starts = kill_while_uploads_arrive(tmp_path, random.Random(seed), KILLS)
    # The first start also creates the database: it is the reference for a start on a busy machine.
    assert max(starts[1:]) < max(HEALTHY_SECONDS, 2 * starts[0])

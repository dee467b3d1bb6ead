"""A site that runs for an hour with faults in it: ``make soak``, or ``python -m tests.soak --minutes 5``.

Real processes (server with its router, PostgreSQL or SQLite, agents), with writers, readers and a webhook. Faults come
at random: kill -9 of server, router, database and collector, a full disk, a cut network between robots and server. A
table shows what came of it; the exit status is 1 if a bound is broken. The same seed gives the same order of faults.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import select
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import httpx

from app import native
from tests.api.test_damage import fill
from tests.chaos.test_chaos import check
from tests.chaos.world import ENVIRONMENT, HEADERS, Fleet, World
from tests.postgres import running_cluster

AVAILABILITY = 0.999
MEMORY_MB = 50
"""Bounds: share of GETs that are answered outside restarts, and growth of a server's memory."""

DISK = "512m"

START_SECONDS = 60.0
"""Time without faults at the beginning."""

KILLS_SHARE = 0.25
"""Share of the time after which the server is not killed any more: its memory is measured in the rest."""

WARM_SECONDS = 1200.0
"""Age of a server from which its memory is compared: until then its worker fills its cache of chunks (64 MiB)."""

SAMPLE_SECONDS = 10.0
SAMPLES = 12
"""Interval of measurements of the memory, and number of those of which the median counts."""

QUIET_SECONDS = SAMPLES * SAMPLE_SECONDS + 30.0
"""Time without faults at the end."""

READERS = 3
READ_PAUSE = 0.1
READ_SECONDS = 10.0
"""Time limit of a GET. A slower one counts as failed."""

PATHS = (
    f"/maps/{ENVIRONMENT}/tmap2",
    f"/maps/{ENVIRONMENT}/occupancy_grid",
    f"/api/v1/environments/{ENVIRONMENT}",
    f"/api/v1/environments/{ENVIRONMENT}/versions?limit=20",
    f"/api/v1/environments/{ENVIRONMENT}/versions/latest/manifest?formats=tmap2,occupancy_grid",
    f"/api/v1/environments/{ENVIRONMENT}/channels",
    "/api/v1/environments",
    "/api/v1/robots",
    "/healthz",
)


class Windows:
    """Times in which the server or its database is down or starting. Thread-safe."""

    def __init__(self) -> None:
        self._closed: list[tuple[float, float]] = []
        self._opened: float | None = None
        self._lock = threading.Lock()

    @contextlib.contextmanager
    def open(self) -> Iterator[None]:
        with self._lock:
            self._opened = time.monotonic()
        try:
            yield
        finally:
            with self._lock:
                assert self._opened is not None
                self._closed.append((self._opened, time.monotonic()))
                self._opened = None

    def touch(self, start: float, end: float) -> bool:
        """Whether a window and this time have a moment in common."""
        with self._lock:
            open_now = self._opened is not None and self._opened <= end
            return open_now or any(a <= end and start <= b for a, b in self._closed)

    @property
    def seconds(self) -> float:
        return sum(b - a for a, b in self._closed)


@dataclass
class Reads:
    """GETs. excluded: those that touch a restart. problems: what failed outside restarts, with its number."""

    answered: int = 0
    excluded: int = 0
    problems: Counter[str] = field(default_factory=Counter)

    @property
    def failed(self) -> int:
        return sum(self.problems.values())

    @property
    def availability(self) -> float:
        return self.answered / max(1, self.answered + self.failed)


class Reader:
    """Thread that gets maps, lists and manifests, with a connection that it keeps."""

    def __init__(self, world: World, windows: Windows, stopping: threading.Event, seed: int) -> None:
        self.reads = Reads()
        self._url, self._windows, self._stopping = f"http://127.0.0.1:{world.port}", windows, stopping
        self._dice = random.Random(seed)
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def _run(self) -> None:
        timeout = httpx.Timeout(READ_SECONDS)
        with httpx.Client(base_url=self._url, headers=HEADERS, timeout=timeout, verify=False) as client:
            while not self._stopping.wait(self._dice.uniform(0, 2 * READ_PAUSE)):
                self._read(client, self._dice.choice(PATHS))

    def _read(self, client: httpx.Client, path: str) -> None:
        start, problem = time.monotonic(), None
        try:
            answer = client.get(path)
            if answer.status_code != 200:
                problem = f"{path.split('?', maxsplit=1)[0]}: {answer.status_code} {answer.text[:200]}"
        except httpx.TransportError as error:
            problem = f"{path.split('?', maxsplit=1)[0]}: {type(error).__name__}"
        if problem is None:
            self.reads.answered += 1
        elif self._windows.touch(start, time.monotonic()):
            self.reads.excluded += 1
        else:
            self.reads.problems[problem] += 1


class Proxy:
    """Forwards connections to the server until it is cut: then it drops them, and answers nothing."""

    def __init__(self, target: int) -> None:
        self._target, self._is_cut = target, threading.Event()
        self._pairs: set[socket.socket] = set()
        self._lock = threading.Lock()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            threading.Thread(target=self._forward, args=(client,), daemon=True).start()

    def _forward(self, client: socket.socket) -> None:
        with client:
            if self._is_cut.is_set():
                return
            try:
                server = socket.create_connection(("127.0.0.1", self._target), timeout=5)
            except OSError:
                return
            with server:
                other = {client: server, server: client}
                with self._lock:
                    self._pairs |= other.keys()
                with contextlib.suppress(OSError):
                    while not self._is_cut.is_set():
                        for ready in select.select(list(other), [], [], 0.5)[0]:
                            data = ready.recv(65536)
                            if not data:
                                return
                            other[ready].sendall(data)
                with self._lock:
                    self._pairs -= other.keys()

    @contextlib.contextmanager
    def cut(self) -> Iterator[None]:
        self._is_cut.set()
        with self._lock:
            for one in self._pairs:
                with contextlib.suppress(OSError):
                    one.shutdown(socket.SHUT_RDWR)
        try:
            yield
        finally:
            self._is_cut.clear()

    def close(self) -> None:
        self._is_cut.set()
        self._listener.close()


class Memory:
    """Memory of the server's processes, in MB, in each of its lives: the time between two kills.

    Workers are started when they are needed, so only times with as many processes are compared.
    """

    def __init__(self) -> None:
        self._lives: list[list[tuple[float, int, float]]] = [[]]
        self._started = self._sampled = time.monotonic()

    def restart(self) -> None:
        """Begin the next life."""
        self._lives.append([])
        self._started = time.monotonic()

    def sample(self, world: World) -> None:
        """Measure, if the last sample is some seconds old."""
        now = time.monotonic()
        if now - self._sampled < SAMPLE_SECONDS or world.server is None:
            return
        self._sampled = now
        sizes = process_memory(world.server.process.pid)
        self._lives[-1].append((now - self._started, len(sizes), sum(sizes)))

    def change(self) -> tuple[float, float] | None:
        """Return the memory of a warm server and that at the end, of the life in which it grew most.

        Each is the median of some samples. None: no life was long enough.
        """
        changes = []
        for life in self._lives:
            for processes in {count for _, count, _ in life}:
                sizes = [size for age, count, size in life if age >= WARM_SECONDS and count == processes]
                if len(sizes) >= 2 * SAMPLES:
                    changes.append((statistics.median(sizes[:SAMPLES]), statistics.median(sizes[-SAMPLES:])))
        return max(changes, key=lambda change: change[1] - change[0], default=None)

    def table(self) -> str:
        """Return the memory in the last life, every minute."""
        return " ".join(f"{size:.0f}" for _, _, size in self._lives[-1][:: round(60 / SAMPLE_SECONDS)])


def process_memory(pid: int) -> list[float]:
    """Return the memory of a process and its descendants, in MB: pages without a file, those in swap included.

    A page that several of them share counts once, as a share in each. The server must not be forked from a process that
    goes on, or its share of that one's pages would change.
    """
    sizes, pending = [], [pid]
    while pending:
        one = pending.pop()
        with contextlib.suppress(OSError):
            rollup = dict(line.split(":", 1) for line in Path(f"/proc/{one}/smaps_rollup").read_text().splitlines()[1:])
            kinds = ("Pss_Anon", "Pss_Shmem", "SwapPss")
            sizes.append(sum(int(rollup[kind].split()[0]) for kind in kinds) / 1024)
            for task in Path(f"/proc/{one}/task").iterdir():
                pending += map(int, (task / "children").read_text().split())
    return sizes


class Soak:
    """Faults at random moments on a working fleet."""

    def __init__(self, fleet: Fleet, proxy: Proxy, disk: Path | None, seed: int) -> None:
        self._fleet, self._world, self._proxy, self._disk = fleet, fleet.world, proxy, disk
        self._dice = random.Random(seed)
        self.windows, self.memory = Windows(), Memory()
        self.counts: Counter[str] = Counter()
        self._faults: list[tuple[str, Callable[[], None]]] = [
            ("kill -9 of the server", self._kill_server),
            ("kill -9 of the router", self._kill_router),
            ("kill -9 of the collector", self._kill_collector),
            ("network between robots and server cut", self._cut_network),
        ]
        if self._world.cluster is not None:
            self._faults.append(("kill -9 of the database", self._kill_database))
        if disk is not None:
            self._faults.append(("full disk", self._fill_disk))

    def run(self, seconds: float, every: float) -> None:
        """Cause a fault about every ``every`` seconds, each kind as often as any other.

        The server is killed in the first part only. The last minutes are quiet.
        """
        end = time.monotonic() + seconds
        last_kill = time.monotonic() + KILLS_SHARE * seconds
        waiting: list[tuple[str, Callable[[], None]]] = []
        self._rest(START_SECONDS)
        while (left := end - time.monotonic() - QUIET_SECONDS) > 0:
            if not waiting:
                waiting = self._dice.sample(self._faults, len(self._faults))
            name, cause = waiting.pop()
            if cause == self._kill_server and time.monotonic() > last_kill:
                continue
            self._rest(min(left, self._dice.uniform(0.5, 1.5) * every))
            if end - time.monotonic() < QUIET_SECONDS:
                break
            print(f"{time.strftime('%H:%M:%S')} {name}", flush=True)
            cause()
            self.counts[name] += 1
        self._rest(max(0.0, end - time.monotonic()))

    def _rest(self, seconds: float) -> None:
        """Wait; stop at once if a writer or watcher has found a problem."""
        end = time.monotonic() + seconds
        fleet = self._fleet
        while time.monotonic() < end:
            time.sleep(min(0.5, max(0.0, end - time.monotonic())))
            self.memory.sample(self._world)
            for one in (*fleet.writers, fleet.promoter, fleet.closer, fleet.watcher):
                if one.problem is not None:
                    raise one.problem

    def _kill_server(self) -> None:
        with self.windows.open():
            self._world.kill_server()
            self.memory.restart()
            self._rest(self._dice.choice((0.0, 1.0)))
            self._world.revive("server")
        self.memory.restart()

    def _kill_database(self) -> None:
        with self.windows.open():
            self._world.kill_database()
            self._rest(self._dice.choice((0.0, 3.0)))
            self._world.revive("database")
            self._world.get("environments")  # its connections are open again
            time.sleep(1.0)

    def _kill_router(self) -> None:
        self._world.kill_router()

    def _kill_collector(self) -> None:
        self._world.kill_collector()
        self._world.revive_collector()

    def _cut_network(self) -> None:
        with self._proxy.cut():
            self._rest(self._dice.uniform(2, 20))

    def _fill_disk(self) -> None:
        assert self._disk is not None
        ballast = fill(self._disk)
        self._rest(self._dice.uniform(2, 10))
        ballast.unlink()


@contextlib.contextmanager
def small_disk(folder: Path) -> Iterator[Path | None]:
    """Mount a small disk for the server's data; None without the right to mount."""
    disk = folder / "disk"
    disk.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={DISK},mode=700", "tmpfs", str(disk)]
    if os.geteuid() != 0 or subprocess.run(command, check=False, capture_output=True).returncode != 0:
        print("no full disk: it needs root and the right to mount", file=sys.stderr)
        yield None
        return
    try:
        yield disk
    finally:
        subprocess.run(["umount", "-l", str(disk)], check=True)


def compile_first() -> None:
    """Compile native code into the user's folder: else a process of the server does so meanwhile, with 200 MB."""
    os.environ.setdefault(native.FOLDER, str(native.folder().parent))
    code = "import os, pathlib; from app import native; native.fill(pathlib.Path(os.environ[native.FOLDER]))"
    subprocess.run([sys.executable, "-c", code], check=True)


def soak(folder: Path, minutes: float, every: float, seed: int, *, sqlite: bool) -> bool:
    """Run a soak and print its table; return whether all bounds hold."""
    stopping, problem = threading.Event(), None
    with contextlib.ExitStack() as stack:
        disk = stack.enter_context(small_disk(folder))
        cluster = None if sqlite else stack.enter_context(running_cluster())
        place = folder if disk is None else disk
        world = World(place, cluster, own_router=True, forked=False, FLEETMAP_MEMORY_CACHE_BYTES="16MiB")
        stack.callback(world.close)
        proxy = Proxy(world.port)
        stack.callback(proxy.close)
        fleet = Fleet(world, seed, pause=4.0, proxy=proxy.port, robots=folder)  # their disks do not fill up
        stack.callback(fleet.close)
        run = Soak(fleet, proxy, disk, seed)
        readers = [Reader(world, run.windows, stopping, seed + k) for k in range(READERS)]
        stack.callback(stopping.set)
        started = time.monotonic()
        try:
            run.run(minutes * 60, every)
            stopping.set()
            check(fleet)
        except AssertionError as error:
            problem = str(error) or "an assertion failed"
        stopping.set()
        for reader in readers:
            reader.thread.join(READ_SECONDS + 5)
        return report(run, fleet, readers, time.monotonic() - started, seed, problem)


def report(run: Soak, fleet: Fleet, readers: list[Reader], seconds: float, seed: int, problem: str | None) -> bool:
    """Print the table and return whether all bounds hold."""
    reads = Reads(sum(r.reads.answered for r in readers), sum(r.reads.excluded for r in readers))
    for reader in readers:
        reads.problems.update(reader.reads.problems)
    faults = ", ".join(f"{count} x {name}" for name, count in sorted(run.counts.items()))
    is_available, change = reads.availability >= AVAILABILITY, run.memory.change()
    is_lean = change is None or change[1] <= change[0] + MEMORY_MB
    sizes = (
        "too short to measure it" if change is None else f"{change[0]:.0f} MB when warm, {change[1]:.0f} MB at the end"
    )
    rows = [
        ("faults", faults, ""),
        ("uploads · promotes · closures acknowledged", f"{fleet.count_commits()} · {len(fleet.promoter.moves)} · "
         f"{len(fleet.closer.states)}", ""),
        ("GETs outside restarts: answered", f"{reads.availability:.4%} of {reads.answered + reads.failed}",
         "≥ 99.9 %" if is_available else "BROKEN: ≥ 99.9 %"),
        ("GETs that touched a restart and failed", f"{reads.excluded}, in {run.windows.seconds:.0f} s of restarts", ""),
        ("acknowledged and lost, half stored, wrong order", "0" if problem is None else problem,
         "0" if problem is None else "BROKEN: 0"),
        ("memory of the server", sizes, f"growth ≤ {MEMORY_MB} MB" if is_lean else f"BROKEN: ≤ {MEMORY_MB} MB"),
    ]  # fmt: skip
    print(f"\n{seconds / 60:.1f} minutes with the seed {seed}\n\n| what | measured | bound |\n| --- | --- | --- |")
    for row in rows:
        print(f"| {' | '.join(row)} |")
    print(f"MB every minute of the last life: {run.memory.table()}")
    for text, count in reads.problems.most_common(10):
        print(f"failed outside restarts, {count} x: {text}")
    if problem is not None:
        print("\n".join(fleet.world.printed[-30:]))
        for robot in fleet.robots:
            print("\n".join(str(line)[:500] for line in robot.lines[-20:]))
    return problem is None and is_available and is_lean


def main() -> int:
    """Parse the command line and run a soak; return the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--minutes", type=float, default=60.0, help="duration of the load (default: 60)")
    parser.add_argument("--every", type=float, default=20.0, help="mean seconds between faults (default: 20)")
    parser.add_argument("--seed", type=int, help="order of the faults (default: random)")
    parser.add_argument("--sqlite", action="store_true", help="SQLite instead of PostgreSQL")
    given = parser.parse_args()
    if given.minutes < 4:
        parser.error("give at least 4 minutes; 35 to compare the server's memory, once it is warm")
    seed = random.SystemRandom().randrange(10**6) if given.seed is None else given.seed
    compile_first()
    folder = Path(tempfile.mkdtemp(prefix="soak"))
    try:
        return 0 if soak(folder, given.minutes, given.every, seed, sqlite=given.sqlite) else 1
    finally:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    sys.exit(main())

"""Measure and print the two tables of docs/security.md: ``python -m tests.figures hostile`` and ``faults``."""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import resource
import shutil
import signal
import socket
import sqlite3
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from datetime import datetime, timedelta, tzinfo
from functools import partial
from pathlib import Path
from typing import Any, Self
from unittest import mock

import httpx

from app import native
from tests.api import samples
from tests.api.conftest import ADMIN, API, parts, running, settings_for
from tests.api.test_damage import NETWORK, cached, fill, flip, mounted_disk
from tests.chaos.test_chaos import check, kill_repeatedly, lost_versions
from tests.chaos.world import fleet_of
from tests.cli.conftest import ServerProcess, seconds_until_healthy
from tests.conftest import TOP
from tests.hostile import corpus
from tests.hostile.corpus import Case
from tests.hostile.test_connections import REFUSED, read_to_end, send_head, trickle
from tests.hostile.test_decompression import uploads
from tests.hostile.test_kill import kill_while_uploads_arrive
from tests.hostile.test_misreadings import HERE, ROWS, bad_binaries, changed
from tests.hostile.test_requests import invalid_requests
from tests.postgres import running_cluster

HEADERS = {"Authorization": f"Bearer {ADMIN}"}
COPIES = 3
"""Number of damaged copies of each file of each sample: cut, with flipped bits, with a part removed or doubled."""

SLOW = 999
TICKS = os.sysconf("SC_CLK_TCK")


def table(*rows: Iterable[object]) -> str:
    """Format rows as a Markdown table; the first row is the header."""
    head, *others = [[str(cell) for cell in row] for row in rows]
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *others))


# --- hostile input ---------------------------------------------------------------------------------------------------


def out_of_range() -> Iterator[Case]:
    for k, row in enumerate(ROWS):
        yield Case(f"{row.sample} {k}", changed(row), "refused" if row.refused else "read")
    for sample, change, _ in bad_binaries():
        yield Case(sample, {sample: change((corpus.SAMPLES / sample).read_bytes())}, "refused")


def damaged_samples() -> Iterator[Case]:
    for name, files in corpus.sample_maps():
        for victim, data in files.items():
            for k, worse in enumerate(corpus.damaged(data, seed=len(data), count=COPIES)):
                yield Case(f"{victim}, damage {k}", {**files, victim: worse}, "any", name if k % 2 else None)


UPLOADS: dict[str, Callable[[], Iterable[Case]]] = {
    "YAML: aliases, depth, tags, numbers": corpus.yaml_cases,
    "XML: entities, depth, encodings": corpus.xml_cases,
    "Lanelet2 maps": corpus.lanelet_cases,
    "environment packages": corpus.package_cases,
    "OSM in binary (.pbf)": corpus.pbf_cases,
    "JSON: depth, numbers, geometries": corpus.json_cases,
    "images of grids": corpus.picture_cases,
    "aerial images and floor plans": corpus.satellite_cases,
    "archives: paths, sizes, lies": corpus.archive_cases,
    "folders": corpus.folder_cases,
    "networks": corpus.network_cases,
    "point clouds and octrees": corpus.cloud_cases,
    "worlds, models and meshes": corpus.sdf_cases,
    "bombs: 32 MiB to 280 MiB out of kilobytes": lambda: (Case(n, {n: d}, "refused") for n, d in uploads()),
    "samples with a value out of range or unknown": out_of_range,
    "samples with damaged bytes": damaged_samples,
}
REQUESTS = "requests: JSON, and bodies that nobody awaits"
KINDS = [*UPLOADS, REQUESTS]


@dataclass
class Count:
    """Outcomes of one kind of input. peak: memory of the worker, in bytes."""

    inputs: int = 0
    refused: int = 0
    warned: int = 0
    silent: int = 0
    failed: int = 0
    seconds: float = 0.0
    peak: int = 0

    def add(self, status: int, warnings: bool) -> None:
        self.inputs += 1
        self.failed += status >= 500
        self.refused += 400 <= status < 500
        self.warned += status < 400 and warnings
        self.silent += status < 400 and not warnings

    def row(self, name: str) -> list[object]:
        counts = (self.inputs, self.refused, self.warned, self.silent, self.failed)
        return [name, *counts, f"{self.seconds:.2f}", round(self.peak / 1e6) if self.peak else "–"]


class Usage:
    """CPU time of a server and all its processes, and the peak memory of those that read uploads, by proc(5)."""

    def __init__(self, process: int) -> None:
        self._process = process

    def _folders(self) -> Iterator[tuple[Path, list[str]]]:
        for folder in Path("/proc").glob("[0-9]*"):
            with contextlib.suppress(OSError):
                values = (folder / "stat").read_text().rpartition(") ")[2].split()
                if int(values[3]) == self._process:  # session id
                    yield folder, values

    def cpu_seconds(self) -> float:
        """Return the CPU time, including ended processes."""
        return sum(sum(map(int, values[11:15])) for _, values in self._folders()) / TICKS

    def worker_peak(self) -> int:
        """Return the highest memory of its processes except the server's own, in bytes."""
        peaks = [0]
        for folder, _ in self._folders():
            with contextlib.suppress(OSError):
                status = (folder / "status").read_text()
                if folder.name != str(self._process) and "VmHWM:" in status:
                    peaks.append(int(status.partition("VmHWM:")[2].split()[0]) * 1024)
        return max(peaks)

    def reset(self) -> None:
        for folder, _ in self._folders():
            with contextlib.suppress(OSError):
                (folder / "clear_refs").write_text("5")


def hostile(folder: Path, only: str) -> tuple[str, bool]:
    """Build the table; also return whether any input made the server fail or had an unexpected outcome."""
    process = serve(folder / "data", FLEETMAP_MAX_MEMORY_BYTES="6GiB")
    counts, bad = {name: Count() for name in KINDS if only in name}, False
    try:
        usage = Usage(process.process.pid)
        with httpx.Client(base_url=process.ready(), headers=HEADERS, timeout=400) as client:
            for name, count in counts.items():
                usage.reset()
                kind = UPLOADS.get(name, lambda: ())
                for case in kind():
                    env = f"{API}/environments/e{sum(c.inputs for c in counts.values())}"
                    datum = {"latitude": HERE.datum.latitude, "longitude": HERE.datum.longitude}
                    body = {"name": env.rpartition("/")[2], **({"datum": datum} if kind is out_of_range else {})}
                    client.post(f"{API}/environments", json=body).raise_for_status()
                    start = usage.cpu_seconds()
                    data = {"format": case.format} if case.format else {}
                    answer = client.post(f"{env}/versions", files=parts(case.files), data=data)
                    count.seconds = max(count.seconds, usage.cpu_seconds() - start)
                    count.peak = max(count.peak, usage.worker_peak())
                    count.add(answer.status_code, bool(answer.is_success and answer.json()["warnings"]))
                    expected = case.verdict in ("any", "refused" if answer.is_client_error else "read")
                    if answer.is_server_error or not expected:
                        bad = True
                        print(f"{name}: {case.name}: {answer.status_code} {answer.text[:300]}", file=sys.stderr)
                    client.delete(env)
                    client.post(f"{env}/purge")
            count = counts.setdefault(REQUESTS, Count())
            client.post(f"{API}/environments", json={"name": "farm"}).raise_for_status()
            client.post(f"{API}/environments/farm/versions", files=parts(corpus.room())).raise_for_status()
            for method, path, request, _ in invalid_requests():
                start = usage.cpu_seconds()
                answer = client.request(method, f"{API}/{path}", json=request)
                count.seconds = max(count.seconds, usage.cpu_seconds() - start)
                count.add(answer.status_code, warnings=False)
            for target, token, head, status in REFUSED:
                if status >= 400:
                    with send_head(process.address, target, token, head) as line:
                        count.add(int(read_to_end(line)[0].split()[1]), warnings=False)
    finally:
        process.stop()
    total = Count(
        *(sum(getattr(c, f) for c in counts.values()) for f in ("inputs", "refused", "warned", "silent", "failed"))
    )
    total.seconds, total.peak = max(c.seconds for c in counts.values()), max(c.peak for c in counts.values())
    head = ("kind of input", "inputs", "refused (4xx)", "read, warned", "read, no warning", "5xx", "CPU s", "peak MB")
    rows = [count.row(name) for name, count in counts.items()]
    return table(head, *rows, total.row("all")), bad or total.failed > 0


# --- faults ----------------------------------------------------------------------------------------------------------


@dataclass
class Outcome:
    """Outcome of a fault. healthy: seconds until /healthz of each run."""

    times: int
    lost: int = 0
    wrong: int = 0
    healthy: list[float] = field(default_factory=list)

    def row(self, name: str) -> list[object]:
        median, longest = statistics.median(self.healthy), max(self.healthy)
        return [name, self.times, self.lost, self.wrong, f"{median:.2f}", f"{longest:.2f}"]


def serve(data: Path, *arguments: str, **environment: str) -> ServerProcess:
    values = {"FLEETMAP_ADMIN_TOKEN": ADMIN, "FLEETMAP_LOG_LEVEL": "error", "FLEETMAP_CONVERSION_WORKERS": "1"}
    return ServerProcess("--data-dir", str(data), *arguments, environment={**values, **environment}, folder=TOP)


def survey(call: Callable[..., httpx.Response], number: int) -> tuple[str, dict[str, bytes], dict[str, bytes]]:
    """Commit a version; return its path, its files, and all its responses by path."""
    network = samples.tmap2({"gate": (0.0, 0.0), "barn": (11.0, number), "field": (10.0, 8.0)})
    files = {NETWORK: network, "notes.txt": random.Random(number).randbytes(100_000)}
    version = call("POST", "environments/farm/versions", files=parts(files)).raise_for_status().json()["version"]
    place = f"environments/farm/versions/{version}"
    served = {f"{place}/sources/{name}": data for name, data in files.items()}
    for name in ("tmap2", "kml", "geojson"):
        served[f"{place}/maps/{name}"] = call("GET", f"{place}/maps/{name}").raise_for_status().content
    return place, files, served


DATUM = {"latitude": samples.LATITUDE, "longitude": samples.LONGITUDE}


class Site:
    """Server with three versions and their responses before the fault. folder: for files other than its data."""

    def __init__(self, folder: Path, data: Path) -> None:
        self.data, self.dice = data, random.Random(1)
        self.originals, self.backup = folder / "originals", folder / "backup"
        self.originals.mkdir()
        self.healthy: list[float] = []
        self.good: dict[str, bytes] = {}
        self.start()
        self.call("POST", "environments", json={"name": "farm", "datum": DATUM}).raise_for_status()
        for number in range(3):
            _, files, served = survey(self.call, number)
            self.good |= served
            for name, data_ in files.items():
                (self.originals / f"{number}-{name}").write_bytes(data_)
        self.stop(signal.SIGTERM)
        shutil.copytree(self.data, self.backup)
        self.start()
        self.healthy.clear()

    def start(self) -> None:
        start = time.monotonic()
        self.process = serve(self.data)
        try:
            self.healthy.append(self.process.seconds_until_healthy(start))
            self.client = httpx.Client(base_url=self.process.ready() + API, headers=HEADERS, timeout=60)
        except AssertionError:
            self.process.stop(signal.SIGKILL)
            raise

    def stop(self, number: int = signal.SIGKILL) -> None:
        self.client.close()
        self.process.stop(number)

    def call(self, method: str, path: str, **more: Any) -> httpx.Response:
        return self.client.request(method, path, **more)

    def wrong(self) -> int:
        """Count responses with status 200 and other bytes than before."""
        return wrong(self.call, self.good)

    def lost(self) -> int:
        """Count versions that are not intact byte by byte."""
        return lost(self.call, self.good)

    def repair(self) -> None:
        command = [sys.executable, "-m", "app.cli", "verify", "--data-dir", str(self.data), "--repair"]
        subprocess.run([*command, "--from", str(self.originals)], cwd=TOP, capture_output=True, check=False)

    def restore(self) -> None:
        shutil.rmtree(self.data)
        shutil.copytree(self.backup, self.data)


def wrong(call: Callable[..., httpx.Response], good: dict[str, bytes]) -> int:
    answers = [(call("GET", path), data) for path, data in good.items()]
    return sum(answer.status_code == 200 and answer.content != data for answer, data in answers)


def lost(call: Callable[..., httpx.Response], good: dict[str, bytes]) -> int:
    bad = [path for path, data in good.items() if call("GET", path).content != data]
    return len({path.split("/")[3] for path in bad})


def flip_file(files: Callable[[Path], list[Path]], site: Site) -> None:
    file = site.dice.choice(sorted(p for p in files(site.data) if p.is_file() and p.stat().st_size))
    flip(file, site.dice.randrange(file.stat().st_size))


def blobs(data: Path) -> list[Path]:
    return [p for p in (data / "blobs").rglob("*") if len(p.name.split(".")[0]) == 64]


def flip_chunk(site: Site) -> None:
    with contextlib.closing(sqlite3.connect(site.data / "fleetmap.sqlite3")) as database, database:
        name, data = site.dice.choice(database.execute("SELECT hash, data FROM chunk ORDER BY hash").fetchall())
        at = site.dice.randrange(len(data))
        worse = data[:at] + bytes([data[at] ^ 0xFF]) + data[at + 1 :]
        database.execute("UPDATE chunk SET data = ? WHERE hash = ?", (worse, name))


def flip_page(site: Site) -> None:
    """Change the type byte of a page other than the first."""
    file = site.data / "fleetmap.sqlite3"
    with contextlib.closing(sqlite3.connect(file)) as database:
        database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    flip(file, 4096 * site.dice.randrange(1, file.stat().st_size // 4096))


def damage(harm: Callable[[Site], None], remedy: Callable[[Site], None], folder: Path, times: int) -> Outcome:
    """Kill, damage, start and read all; then apply the documented remedy, start and read all again."""
    site, out = Site(folder, folder / "data"), Outcome(times)
    try:
        for _ in range(times):
            site.stop()
            harm(site)
            try:
                site.start()
                out.wrong += site.wrong()
                site.stop()
            except AssertionError:
                print(f"the server does not start: {site.process.lines[-1:]}", file=sys.stderr)
            remedy(site)
            site.start()
            out.lost += site.lost()
    finally:
        site.stop()
    return replace(out, healthy=site.healthy)


def full_disk(folder: Path, times: int) -> Outcome:
    """Fill the disk, read, try to write, start on the full disk, read; free space, and read again."""
    out = Outcome(times)
    with mounted_disk(folder / "disk") as disk:
        site = Site(folder, disk / "data")
        try:
            for _ in range(times):
                ballast = fill(disk)
                out.wrong += site.wrong()
                files = parts({NETWORK: samples.tmap2(), "notes.txt": bytes(500_000)})
                assert site.call("POST", "environments/farm/versions", files=files).status_code == 507
                site.stop()
                site.start()
                out.wrong += site.wrong()
                ballast.unlink()
                out.lost += site.lost()
        finally:
            site.stop()
    return replace(out, healthy=site.healthy)


def slow_connections(folder: Path, times: int) -> Outcome:
    """Open slow connections. healthy: seconds of each GET /healthz meanwhile."""
    site, out, flood = Site(folder, folder / "data"), Outcome(times), list[socket.socket]()
    hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    try:
        for _ in range(times):
            for _ in trickle(site.process.address, SLOW, flood):
                out.healthy.append(site.process.seconds_until_healthy(time.monotonic()))
            out.wrong += site.wrong()
            for line in flood:
                line.close()
            flood.clear()
            out.lost += site.lost()
    finally:
        site.stop()
    return out


class Shifted(datetime):
    """Datetime with a wrong now()."""

    by = timedelta(0)

    @classmethod
    def now(cls, tz: tzinfo | None = None) -> Self:
        return super().now(tz) + cls.by


def wrong_clock(folder: Path, times: int) -> Outcome:
    """Set the clock a year ahead, a year back, and right again, with a start, a commit and a collection each time."""
    out, good, real = Outcome(times), dict[str, bytes](), time.time

    def shifted() -> float:
        return real() + Shifted.by.total_seconds()

    for number in range(times):
        Shifted.by = timedelta(days=(365, -365, 0)[number % 3])
        with contextlib.ExitStack() as stack:
            for module in ("app.store.base", "app.api.http.auth", "app.main"):
                stack.enter_context(mock.patch(f"{module}.datetime", Shifted))
            stack.enter_context(mock.patch("time.time", shifted))
            start = time.monotonic()
            api = stack.enter_context(running(settings_for(folder)))
            out.healthy.append(seconds_until_healthy(api.url, start))
            if not good:
                api.post("environments", {"name": "farm", "datum": DATUM})
            good |= survey(api, number)[2]
            api.app.state.services.store.garbage.collect(timedelta(hours=1))
            api.app.state.services.response_cache._entries.clear()
            out.wrong += wrong(api, good)
            out.lost += lost(api, good)
    return out


def kill(target: str, folder: Path, times: int) -> Outcome:
    with running_cluster() as cluster, fleet_of(folder, cluster, own_router=True, seed=5) as fleet:
        healthy = kill_repeatedly(fleet, {target: times})
        check(fleet)
        versions = fleet.world.get("environments/farm/versions?limit=1000")
        absent = lost_versions(fleet, {v["version"]: v["message"] for v in versions})
        half = sum(line["event"] in ("refused", "damaged") for robot in fleet.robots for line in robot.lines)
    return Outcome(times, len(absent), half, healthy)


def kill_during_uploads(folder: Path, times: int) -> Outcome:
    """Its test compares each file of each version, and fails at the first that differs."""
    _, starts = kill_while_uploads_arrive(folder, random.Random(1), times)
    return Outcome(times, healthy=starts[1:])


FAULTS: dict[str, tuple[Callable[[Path, int], Outcome], int]] = {
    "kill -9 of the server, robots follow (PostgreSQL)": (partial(kill, "server"), 5),
    "kill -9 of the server while uploads arrive (SQLite)": (kill_during_uploads, 5),
    "kill -9 of the router": (partial(kill, "router"), 5),
    "kill -9 of PostgreSQL": (partial(kill, "database"), 5),
    "full disk": (full_disk, 3),
    "flipped byte in a cached map": (partial(damage, partial(flip_file, cached), lambda site: None), 3),
    "flipped byte in a stored upload": (partial(damage, partial(flip_file, blobs), Site.repair), 3),
    "flipped byte in a chunk of a version": (partial(damage, flip_chunk, Site.repair), 3),
    "flipped byte in a database page (SQLite)": (partial(damage, flip_page, Site.restore), 3),
    f"{SLOW} connections at a byte now and then": (slow_connections, 1),
    "clock a year ahead, a year behind": (wrong_clock, 3),
}
"""Faults by name: function and default number of runs."""


def faults(folder: Path, times: int | None, only: str) -> tuple[str, bool]:
    """Build the table; also return whether anything was lost or wrong."""
    rows, bad = [], False
    for number, (name, (cause, default)) in enumerate(FAULTS.items()):
        if only in name:
            below = folder / str(number)
            below.mkdir()
            out = cause(below, times or default)
            rows.append(out.row(name))
            bad |= bool(out.lost or out.wrong)
            print(rows[-1], file=sys.stderr)
    head = ("fault", "times", "versions lost", "wrong bytes", "s until /healthz: median", "max")
    return table(head, *rows), bad


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.figures", description=__doc__)
    parser.add_argument("table", choices=("hostile", "faults"))
    parser.add_argument("--times", type=int, help="how often each fault comes; the default depends on the fault")
    parser.add_argument("--only", default="", help="only rows whose name has this in it")
    values = parser.parse_args()
    os.environ.setdefault("NUMBA_CACHE_DIR", str(native.folder().parent))
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # measure starts like those of users
    with tempfile.TemporaryDirectory(prefix="fleetmap-figures-") as name:
        if values.table == "hostile":
            text, bad = hostile(Path(name), values.only)
        else:
            text, bad = faults(Path(name), values.times, values.only)
    print(text)
    return int(bad)


if __name__ == "__main__":
    sys.exit(main())

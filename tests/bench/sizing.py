"""Sizing: CPU seconds, memory, connections and bytes that a server costs, and what a number of robots and sites needs.

The constants are measured on a server with SQLite and on one of two servers that share PostgreSQL and a blob folder.
They are CPU time, not wall time, so that a busy machine changes them little; what an idle server uses is subtracted.
The formula below is that of docs/how-to/scale.md.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import json
import math
import os
import socket
import sqlite3
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import httpx
from rich.console import Console
from rich.table import Table

from app import native
from tests.bench import http
from tests.bench.events import TOKEN, network
from tests.ports import free_port
from tests.postgres import Cluster, running_cluster

ENVIRONMENT = "field"
AUTH = {"Authorization": f"Bearer {TOKEN}"}
MAP = f"/maps/{ENVIRONMENT}/tmap2"
MANIFEST = f"/api/v1/environments/{ENVIRONMENT}/versions/latest/manifest?formats=tmap2"
GETS, ROBOTS, COMMITS, MOVES = 16_000, 500, 40, 300
ROUNDS = 3
CONNECTIONS = 16
SETTLE_SECONDS, IDLE_SECONDS = 10.0, 15.0
TICKS = os.sysconf("SC_CLK_TCK")
REPEATED = ("manifest, 304", "manifest, 200", "map, 304", "map, 200", "map, delta")
MOST = 1.10
"""Cost of a repeated GET on one of several servers, against a server alone."""

POLL_SECONDS = 60.0
STATUSES = 3
"""Statuses of a robot for each version: it downloads, is ready, runs it."""
COMMITS_A_DAY = 10
FRESH_SECONDS = 1.0
"""Time for which a server answers from memory without a look at the database."""
HALF = 0.5
"""Share of a processor that the servers may use on average: the rest is for bursts, and for the failure of one."""
BURST_SECONDS = 60.0
"""Time in which all robots of a site have a new version, if they ask for it at once."""
FLEETS = (1, 100, 1_000, 10_000, 100_000)
SITES = (1, 10, 100)


@dataclass
class Measured:
    """Constants of one kind of server. cpu: milliseconds of CPU time by operation. idle: CPU seconds a second."""

    cpu: dict[str, float] = field(default_factory=dict)
    idle: float = 0.0
    memory: float = 0.0
    connections: int = 0
    version_bytes: float = 0.0


class Server:
    """A server process with its workers, and the size of its database."""

    def __init__(self, process: subprocess.Popen[bytes], port: int, stored: Callable[[], int]) -> None:
        self.process, self.port, self.stored = process, port, stored
        self.client = httpx.Client(base_url=f"http://127.0.0.1:{port}", headers=AUTH, timeout=120)
        self.idle = 0.0

    def family(self) -> list[int]:
        """List the process and its descendants."""
        parents = {int(path.name): _stat(path)[1] for path in _processes()}
        members = [self.process.pid]
        for member in members:
            members += [process for process, parent in parents.items() if int(parent) == member]
        return members

    def cpu(self) -> float:
        """CPU seconds of all its processes, and of those that have ended."""
        total = 0
        for process in self.family():
            with contextlib.suppress(OSError):
                total += sum(int(ticks) for ticks in _stat(Path(f"/proc/{process}"))[11:15])
        return total / TICKS

    def memory(self) -> int:
        """Bytes of its processes; what they share counts once."""
        total = 0
        for process in self.family():
            with contextlib.suppress(OSError):
                for line in Path(f"/proc/{process}/smaps_rollup").read_text().splitlines():
                    total += 1024 * int(line.split()[1]) if line.startswith("Pss:") else 0
        return total

    def cost(self, work: Callable[[], int]) -> float:
        """CPU milliseconds of one of the operations that ``work`` does and counts."""
        cpu, start = self.cpu(), time.monotonic()
        count = work()
        if count < GETS:
            time.sleep(1.0)  # what is stored or published afterwards
        used = self.cpu() - cpu - self.idle * (time.monotonic() - start)
        return max(0.0, used / count * 1e3)

    def upload(self, moved: float) -> httpx.Response:
        """Commit a version with one node moved."""
        files = {"files": ("n.tmap2.yaml", network(moved))}
        return self.client.post(f"/api/v1/environments/{ENVIRONMENT}/versions", files=files).raise_for_status()


def _processes() -> list[Path]:
    return [path for path in Path("/proc").iterdir() if path.name.isdigit() and (path / "stat").exists()]


def _stat(folder: Path) -> list[str]:
    """Return the fields of /proc/N/stat from the state on (proc(5))."""
    try:
        return (folder / "stat").read_text().rpartition(")")[2].split()
    except OSError:
        return ["Z", "0", *["0"] * 20]


def send(port: int, requests: list[bytes]) -> int:
    """Send requests over some connections at once; returns their number. Raises RuntimeError for an error."""
    sockets = [socket.create_connection(("127.0.0.1", port)) for _ in range(CONNECTIONS)]
    try:
        for start in range(0, len(requests), CONNECTIONS):
            some = list(zip(sockets, requests[start : start + CONNECTIONS], strict=False))
            for connection, request in some:
                connection.sendall(request)
            for connection, _ in some:
                answer = http._answer(connection)
                if answer[9:10] not in (b"2", b"3"):
                    raise RuntimeError(f"unexpected answer: {answer[:300]!r}")
    finally:
        for connection in sockets:
            connection.close()
    return len(requests)


def single(port: int, request: bytes) -> bytes:
    """Send one request; returns the answer."""
    with socket.create_connection(("127.0.0.1", port)) as connection:
        connection.sendall(request)
        return http._answer(connection)


def request(method: str, path: str, body: bytes = b"", **headers: str) -> bytes:
    """Build a request."""
    lines = [f"{method} {path} HTTP/1.1", "Host: 127.0.0.1", *(f"{k}: {v}" for k, v in AUTH.items())]
    lines += [f"{name.replace('_', '-')}: {value}" for name, value in headers.items()]
    if body:
        lines += ["Content-Type: application/json", f"Content-Length: {len(body)}"]
    return ("\r\n".join(lines) + "\r\n\r\n").encode() + body


@contextlib.contextmanager
def serving(folder: Path, stored: Callable[[], int], **settings: str) -> Iterator[Server]:
    """Run a server."""
    compiled = Path(tempfile.gettempdir()) / f"fleetmap-bench-native-{os.getuid()}"
    native.fill(compiled)  # else its workers compile during the measurement
    port = free_port()
    env = {
        "NUMBA_CACHE_DIR": str(compiled),
        "FLEETMAP_DATA_DIR": str(folder),
        "FLEETMAP_ADMIN_TOKEN": TOKEN,
        "FLEETMAP_ZENOH_MODE": "off",
    }
    env |= {"FLEETMAP_SCRUB_HOURS": "0", "FLEETMAP_CONVERSION_WORKERS": "1"}
    env |= {f"FLEETMAP_{name.upper()}": value for name, value in settings.items()}
    command = [sys.executable, "-m", "app.cli", "serve", "--host", "127.0.0.1", "--port", str(port)]
    with http.serving(command, port, env) as process:
        server = Server(process, port, stored)
        while server.client.get("/readyz").status_code != 200:
            time.sleep(0.1)
        yield server
        server.client.close()


def measure_idle(servers: list[Server]) -> None:
    """Measure what servers use without requests, once they have started their workers."""
    time.sleep(SETTLE_SECONDS)
    before = [server.cpu() for server in servers]
    time.sleep(IDLE_SECONDS)
    for server, cpu in zip(servers, before, strict=True):
        server.idle = (server.cpu() - cpu) / IDLE_SECONDS


def measure_gets(servers: list[Server]) -> list[dict[str, float]]:
    """Measure repeated GETs, alternately on the servers; the least of several rounds counts."""
    out: list[dict[str, float]] = [{} for _ in servers]
    old = servers[0].client.get(MAP).content
    for server in servers:
        server.upload(0.5)
    digest = base64.b64encode(hashlib.sha256(old).digest()).decode()
    for _ in range(ROUNDS):
        for server, costs in zip(servers, out, strict=True):
            tags = {path: server.client.get(path).headers["etag"] for path in (MAP, MANIFEST)}
            delta = {"Accept_Encoding": "dcz", "Available_Dictionary": f":{digest}:"}
            kinds = {
                "manifest, 304": request("GET", MANIFEST, If_None_Match=tags[MANIFEST]),
                "manifest, 200": request("GET", MANIFEST),
                "map, 304": request("GET", MAP, If_None_Match=tags[MAP]),
                "map, 200": request("GET", MAP),
                "map, delta": request("GET", MAP, **delta),
            }
            if b"content-encoding: dcz" not in single(server.port, kinds["map, delta"]).lower():
                raise RuntimeError("the server sends no delta")
            for kind, one in kinds.items():
                send(server.port, [one])
                cost = server.cost(lambda one=one, port=server.port: send(port, [one] * GETS))  # type: ignore[misc]
                costs[kind] = min(cost, costs.get(kind, cost))
    return out


def status_requests(version: int, root: str) -> list[bytes]:
    """Build one status of each robot."""
    body = {"environment": ENVIRONMENT, "channel": "latest", "version": version, "root": root, "state": "active"}
    text = json.dumps(body).encode()
    return [request("PUT", f"/api/v1/robots/r{k}/status", text, Prefer="return=minimal") for k in range(ROBOTS)]


def measure_writes(server: Server, costs: dict[str, float]) -> float:
    """Measure statuses and commits; returns the bytes stored for a version."""
    place = f"/api/v1/environments/{ENVIRONMENT}/versions"
    versions = [server.client.get(f"{place}/{number}").json() for number in (1, 2)]
    statuses = [status_requests(v["version"], v["root"]) for v in versions]
    send(server.port, statuses[0])
    changed = [server.cost(lambda k=k: send(server.port, statuses[k])) for k in (1, 0, 1)]  # type: ignore[misc]
    costs["status, changed"] = min(changed)
    costs["status, unchanged"] = min(server.cost(lambda: send(server.port, statuses[1])) for _ in range(2))
    alone = server.cost(lambda: move_channel(server, look=False))
    costs["manifest, looked up"] = max(0.0, server.cost(lambda: move_channel(server, look=True)) - alone)
    before = server.stored()

    def commit() -> int:
        for number in range(COMMITS):
            server.upload(1.0 + number / 100)
        return COMMITS

    costs["commit"] = server.cost(commit)
    return (server.stored() - before) / COMMITS


def move_channel(server: Server, *, look: bool) -> int:
    """Move a channel some times, after which nothing in memory is fresh. look: with a GET of the manifest each time."""
    channel = f"/api/v1/environments/{ENVIRONMENT}/channels/production"
    etag = server.client.get(MANIFEST).headers["etag"]
    for k in range(MOVES):
        server.client.put(channel, json={"version": 1 + k % 2}).raise_for_status()
        if look and server.client.get(MANIFEST, headers={"If-None-Match": etag}).status_code != 304:
            raise RuntimeError("the manifest is not what it was")
    return MOVES


def measure_event(folder: Path) -> float:
    """Measure an event: moves of a channel on a server with a Zenoh router, against one without."""
    costs = []
    for mode in ("off", "router"):
        listen = f"tcp/127.0.0.1:{free_port()}"
        (folder / mode).mkdir()
        with serving(folder / mode, lambda: 0, zenoh_mode=mode, zenoh_listen=listen) as server:
            prepare(server)
            server.upload(0.5)
            measure_idle([server])
            costs.append(min(server.cost(lambda: move_channel(server, look=False)) for _ in range(2)))
    return max(0.0, costs[1] - costs[0])


def prepare(server: Server) -> None:
    """Create the environment with its first version."""
    server.client.post("/api/v1/environments", json={"name": ENVIRONMENT}).raise_for_status()
    server.upload(0.0)
    server.client.get(MAP).raise_for_status()


def folder_bytes(folder: Path) -> int:
    """Count the bytes of the files of a blob folder, without workspaces."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file() and "tmp" not in path.parts)


def measure(cluster: Cluster, folder: Path) -> tuple[Measured, Measured]:
    """Measure a server alone, and one of two that share PostgreSQL and a blob folder."""
    name, blobs = cluster.create_database(), folder / "blobs"
    blobs.mkdir()

    def sqlite_bytes() -> int:
        with contextlib.closing(sqlite3.connect(folder / "alone" / "fleetmap.sqlite3")) as database:
            pages = [database.execute(f"PRAGMA {name}").fetchone()[0] for name in ("page_count", "page_size")]
        return int(pages[0] * pages[1]) + folder_bytes(folder / "alone" / "blobs")

    def ask(query: str) -> int:
        with cluster.connect() as connection:
            row = connection.execute(query, (name,)).fetchone()
        return int(str(row[0])) if row is not None else 0

    def postgres_bytes() -> int:
        return ask("SELECT pg_database_size(%s)") + folder_bytes(blobs)

    shared = {"database_url": cluster.url(name), "blob_url": str(blobs)}
    for one in ("alone", "other", "one"):
        (folder / one).mkdir()
    with contextlib.ExitStack() as stack:
        alone = stack.enter_context(serving(folder / "alone", sqlite_bytes))
        stack.enter_context(serving(folder / "other", postgres_bytes, **shared))
        one = stack.enter_context(serving(folder / "one", postgres_bytes, **shared))
        servers, out = [alone, one], [Measured(), Measured()]
        for server in servers:
            prepare(server)
        measure_idle(servers)
        for server, result, gets in zip(servers, out, measure_gets(servers), strict=True):
            result.cpu = gets
            result.version_bytes = measure_writes(server, result.cpu)
            result.idle, result.memory = server.idle, server.memory()
        count = "SELECT count(*) FROM pg_stat_activity WHERE datname = %s AND application_name LIKE 'fleetmap%%'"
        out[1].connections = math.ceil(ask(count) / 2)
    cluster.drop_database(name)
    return out[0], out[1]


def servers_for(measured: Measured, robots: int, sites: int) -> dict[str, float]:
    """Return what a fleet needs: the formula of docs/how-to/scale.md, with COMMITS_A_DAY commits at each site."""
    c = {name: ms / 1e3 for name, ms in measured.cpu.items()}
    commits = sites * COMMITS_A_DAY / 86_400
    updates = robots * COMMITS_A_DAY / 86_400
    update = c["manifest, 200"] + c["map, delta"] + STATUSES * c["status, changed"]
    polls = robots / POLL_SECONDS
    looked_up = min(polls, sites / FRESH_SECONDS)
    poll = looked_up * c["manifest, looked up"] + (polls - looked_up) * c["manifest, 304"]
    cpu = poll + updates * update + commits * (c["commit"] + c["event"])
    burst = robots / sites * update
    return {
        "requests": polls + updates * (2 + STATUSES) + commits,
        "cpu": cpu,
        "processes": max(1, math.ceil(cpu / (HALF - measured.idle)), math.ceil(burst / BURST_SECONDS)),
        "burst": burst,
        "stored": sites * COMMITS_A_DAY * 365 * measured.version_bytes / 1e9,
    }


def report(as_json: bool) -> int:
    """Print the constants and the sizing table (or JSON). Returns 1 if a GET costs too much on one of several."""
    with running_cluster() as cluster, tempfile.TemporaryDirectory() as folder:
        alone, several = measure(cluster, Path(folder))
        (Path(folder) / "events").mkdir()
        alone.cpu["event"] = several.cpu["event"] = measure_event(Path(folder) / "events")
    ratios = {kind: several.cpu[kind] / alone.cpu[kind] for kind in REPEATED}
    fleets = [(robots, sites) for robots in FLEETS for sites in SITES if sites <= robots]
    rows = [{"robots": r, "sites": s, **servers_for(several, r, s)} for r, s in fleets]
    if as_json:
        print(json.dumps({"alone": vars(alone), "several": vars(several), "ratios": ratios, "sizing": rows}, indent=2))
        return 0 if max(ratios.values()) <= MOST else 1
    console = Console(width=110)
    table = Table("CPU milliseconds", "server alone", "one of several", "ratio", "bound", "holds")
    for kind, cost in alone.cpu.items():
        bound = ("≤ 1.10", "yes" if ratios[kind] <= MOST else "NO") if kind in ratios else ("–", "–")
        table.add_row(
            kind, f"{cost:.3f}", f"{several.cpu[kind]:.3f}", f"{several.cpu[kind] / cost:.2f}" if cost else "–", *bound
        )
    console.print(table)
    table = Table("server", "alone", "one of several")
    table.add_row("idle, CPU ms a second", f"{alone.idle * 1e3:.1f}", f"{several.idle * 1e3:.1f}")
    table.add_row("memory, MB", f"{alone.memory / 1e6:.0f}", f"{several.memory / 1e6:.0f}")
    table.add_row("connections to PostgreSQL", "0", str(several.connections))
    table.add_row("bytes stored for a version", f"{alone.version_bytes:.0f}", f"{several.version_bytes:.0f}")
    console.print(table)
    table = Table(
        "robots", "sites", "requests a second", "CPU", "server processes", "CPU s after a commit", "GB a year"
    )
    for row in rows:
        figures = [f"{row[name]:.{digits}f}" for name, digits in _DIGITS.items()]
        table.add_row(f"{row['robots']:.0f}", f"{row['sites']:.0f}", *figures)
    console.print(table)
    return 0 if max(ratios.values()) <= MOST else 1


_DIGITS: dict[str, int] = {"requests": 2, "cpu": 3, "processes": 0, "burst": 2, "stored": 2}

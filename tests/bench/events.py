"""Events: latency from a commit to 100 sessions against a bare put; 500 robots after a router's restart.

``python -m tests.bench.events put …`` and ``… fleet …`` are the processes that ``latency`` and ``convergence`` start.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import zenoh
from zenoh import ext

from app import native
from app.agent.agent import Agent, AgentOptions
from app.backends.notify import CommitCounter
from app.events import messages
from app.events.bus import BusOptions, router_configuration
from app.events.router import Router
from tests.bench import changes, http
from tests.ports import free_port

SESSIONS = 100
COMMITS = 30
ROBOTS = 500
PROCESSES = 20
"""Number of processes, for 25 robots each: more robots in a process wait more for each other than for the server."""
ALLOWED_MS = 20.0
CONVERGED_SECONDS = 10.0
TOKEN = "bench-" + "0" * 40
ENVIRONMENT = "field"
SHARED = Path(__file__).resolve().parents[3] / "shared"


def network(moved: float = 0.0, count: int = 100) -> bytes:
    """Build a network; one of its nodes can be moved."""
    lines = ["name: field", "metric_map: field", "pointset: field", "nodes:"]
    for k in range(count):
        x = k + (moved if k == count // 2 else 0.0)
        lines += [
            f"- meta: {{map: field, node: n{k}, pointset: field}}",
            "  node:",
            f"    name: n{k}",
            "    parent_frame: map",
            f"    pose: {{position: {{x: {x}, y: 0.0, z: 0.0}}, orientation: {{w: 1.0, x: 0.0, y: 0.0, z: 0.0}}}}",
            "    properties: {xy_goal_tolerance: 0.3}",
            "    verts: []",
            "    edges:" + ("" if k + 1 < count else " []"),
        ]
        if k + 1 < count:
            lines.append(f"    - {{edge_id: n{k}_n{k + 1}, node: n{k + 1}, action: move_base}}")
    return ("\n".join(lines) + "\n").encode()


@contextlib.contextmanager
def serve_network(folder: Path, port: int, zenoh_port: int, **more: str) -> Iterator[httpx.Client]:
    """Run a server with an environment of one network, and yield a client."""
    compiled = Path(tempfile.gettempdir()) / f"fleetmap-bench-native-{os.getuid()}"
    native.fill(compiled)  # compile before the measurement
    env = {
        "NUMBA_CACHE_DIR": str(compiled),
        "FLEETMAP_DATA_DIR": str(folder),
        "FLEETMAP_ADMIN_TOKEN": TOKEN,
        "FLEETMAP_LOG_LEVEL": "warning",
        "FLEETMAP_ZENOH_LISTEN": f"tcp/127.0.0.1:{zenoh_port}",
        **more,
    }
    command = [sys.executable, "-m", "app.cli", "serve", "--host", "127.0.0.1", "--port", str(port)]
    auth = {"Authorization": f"Bearer {TOKEN}"}
    with (
        http.serving(command, port, env),
        httpx.Client(base_url=f"http://127.0.0.1:{port}", headers=auth, timeout=120) as client,
    ):
        client.post("/api/v1/environments", json={"name": ENVIRONMENT}).raise_for_status()
        commit(client, 0.0)
        deadline = time.monotonic() + 30
        while client.get("/readyz").json()["events"]["state"] != "connected":
            if time.monotonic() > deadline:
                raise RuntimeError("the server finds no router")
            time.sleep(0.1)
        yield client


def commit(client: httpx.Client, moved: float) -> int:
    """Commit another version; return its number."""
    files = [("files", ("n.tmap2.yaml", network(moved)))]
    answer = client.post(f"/api/v1/environments/{ENVIRONMENT}/versions", files=files)
    answer.raise_for_status()
    return int(answer.json()["version"])


def open_session(port: int) -> zenoh.Session:
    """Open a robot's session."""
    config = zenoh.Config()
    for key, value in (
        ("mode", "client"),
        ("connect/endpoints", [f"tcp/127.0.0.1:{port}"]),
        ("scouting/multicast/enabled", False),
        ("transport/shared_memory/enabled", False),
    ):
        config.insert_json5(key, json.dumps(value))
    return zenoh.open(config)


# --- latency from commit to event ------------------------------------------------------------------------------------


def latency() -> list[dict[str, Any]]:
    """Measure the median delivery time of an event at 100 sessions after its commit.

    The reference is a bare session that puts the same bytes to plain subscribers of the same sessions. The time of the
    commit is the last change of the store's commit counter (``app.backends.notify``) before the first delivery.
    """
    port, zenoh_port = free_port(), free_port()
    with tempfile.TemporaryDirectory() as folder, serve_network(Path(folder), port, zenoh_port) as client:
        sessions = [open_session(zenoh_port) for _ in range(SESSIONS)]
        arrived: list[tuple[float, bytes]] = []
        bare: list[tuple[float, bytes]] = []

        def take(sample: zenoh.Sample) -> None:
            arrived.append((time.time(), bytes(sample.payload)))

        def take_bare(sample: zenoh.Sample) -> None:
            bare.append((time.time(), bytes(sample.payload)))

        declarations: list[Any] = []
        for session in sessions:
            declarations.append(
                ext.declare_advanced_subscriber(
                    session,
                    messages.events_key(messages.PREFIX, ENVIRONMENT),
                    take,
                    history=ext.HistoryConfig(detect_late_publishers=True),
                    recovery=ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
                )
            )
            declarations.append(session.declare_subscriber("bare/events", take_bare))
        time.sleep(3.0)
        arrived.clear()
        generation, ours = CommitCounter(Path(folder) / "blobs"), []
        for k in range(COMMITS):
            before = len(arrived)
            writer = threading.Thread(target=commit, args=(client, 0.001 * (k + 1)))
            seen, changed = generation(), time.time()
            writer.start()
            while len(arrived) == before:
                now = generation()
                if now != seen:
                    seen, changed = now, time.time()
                time.sleep(0.0002)
            _until(lambda n=before: len(arrived) >= n + SESSIONS)
            writer.join()
            ours += [(at - changed) * 1e3 for at, _ in arrived[before:]]
            time.sleep(0.05)
        generation.close()
        size = len(arrived[-1][1])
        command = [sys.executable, "-m", "tests.bench.events", "put", str(zenoh_port), str(COMMITS), str(size)]
        subprocess.run(command, check=True, timeout=120)
        _until(lambda: len(bare) >= SESSIONS * COMMITS)
        floor = [(at - json.loads(body)["time"]) * 1e3 for at, body in bare]
        for session in sessions:
            session.close()  # type: ignore[no-untyped-call]
    our_median, peer = statistics.median(ours), statistics.median(floor)
    complete = len(arrived) == SESSIONS * COMMITS
    bound = 2 * peer + ALLOWED_MS
    return [
        {
            "what": f"commit → event at {SESSIONS} sessions, p50 (peer: a bare put)",
            "peer": peer,
            "ours": our_median,
            "unit": "ms",
            "ratio": our_median / peer,
            "bound": f"≤ {bound:.1f} ms",
            "holds": complete and our_median <= bound,
        }
    ]


def put(port: int, count: int, size: int) -> None:
    """Put ``size`` bytes ``count`` times, each with its send time."""
    session = open_session(port)
    publisher = session.declare_publisher("bare/events", express=True)
    time.sleep(2.0)
    for _ in range(count):
        body = json.dumps({"time": time.time(), "fill": ""})
        filled = json.dumps({"time": time.time(), "fill": "x" * max(0, size - len(body))})
        publisher.put(filled.encode())
        time.sleep(0.15)
    time.sleep(1.0)
    session.close()  # type: ignore[no-untyped-call]


# --- 500 robots after a router's restart -----------------------------------------------------------------------------


class Light(Agent):
    """Agent that records the sequences that it receives."""

    def __init__(self, options: AgentOptions, say: Any) -> None:
        self.heard: list[int] = []
        super().__init__(options, say)

    def _on_event(self, event: messages.Event) -> None:
        self.heard.append(event.sequence)
        super()._on_event(event)


def fleet(server: str, zenoh_port: int, folder: str, first: int, count: int) -> None:
    """Run ``count`` agents in this process until standard input ends; print a line for each relevant event."""
    lock = threading.Lock()

    def tell_as(robot: str) -> Any:
        def tell(event: str, **members: Any) -> None:
            if event in ("active", "connected", "failed", "refused"):
                line = {"robot": robot, "event": event, "at": time.monotonic(), "version": members.get("version")}
                if event in ("failed", "refused"):
                    line["detail"] = members.get("detail")
                with lock:
                    print(json.dumps(line), flush=True)

        return tell

    agents, threads = [], []
    for k in range(first, first + count):
        robot = f"robot-{k}"
        options = AgentOptions(
            server=server,
            environment=ENVIRONMENT,
            formats=("tmap2",),
            into=Path(folder) / robot,
            channel="latest",
            robot=robot,
            token=TOKEN,
            poll_seconds=3600.0,
            zenoh_connect=f"tcp/127.0.0.1:{zenoh_port}",
            zenoh_prefix=messages.PREFIX,
        )
        agent = Light(options, tell_as(robot))
        agent.open()
        agents.append(agent)
        threads.append(threading.Thread(target=agent.run, daemon=True))
    for thread in threads:
        thread.start()
    sys.stdin.read()
    for agent in agents:
        agent.stop()
        heard = sorted(set(agent.heard))
        with lock:
            print(json.dumps({"robot": agent.options.robot, "event": "heard", "sequences": heard}), flush=True)
    os._exit(0)


class _Robots:
    """Processes of the fleet, with the lines that their agents printed."""

    def __init__(self, server: str, zenoh_port: int, folder: Path) -> None:
        each = ROBOTS // PROCESSES
        self.lines: list[dict[str, Any]] = []
        self._processes = []
        self._readers = []
        for k in range(PROCESSES):
            arguments = ["fleet", server, str(zenoh_port), str(folder), str(k * each), str(each)]
            process = subprocess.Popen(
                [sys.executable, "-m", "tests.bench.events", *arguments],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
            self._processes.append(process)
            reader = threading.Thread(target=self._read, args=(process,), daemon=True)
            reader.start()
            self._readers.append(reader)

    def _read(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            self.lines.append(json.loads(line))

    def times(self, event: str, version: int | None = None, after: float = 0.0) -> dict[str, float]:
        """Return the first time of an event, by robot."""
        out: dict[str, float] = {}
        for line in list(self.lines):
            fits = line["event"] == event and (version is None or line.get("version") == version)
            if fits and line["at"] >= after:
                out.setdefault(line["robot"], line["at"])
        return out

    def end(self) -> dict[str, list[int]]:
        """Stop all agents; return the received sequences by robot."""
        for process in self._processes:
            assert process.stdin is not None
            process.stdin.close()
        for process, reader in zip(self._processes, self._readers, strict=True):
            process.wait(60)
            reader.join(10)
        return {line["robot"]: line["sequences"] for line in self.lines if line["event"] == "heard"}


def convergence() -> list[dict[str, Any]]:
    """Measure the time from a router's restart until all 500 agents run a change committed meanwhile."""
    port, zenoh_port = free_port(), free_port()
    endpoint = f"tcp/127.0.0.1:{zenoh_port}"
    options = router_configuration(BusOptions(listen=endpoint))
    router = Router(options)
    # 500 robots have 500 disks: put their folders into memory if possible.
    shared = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    disk = Path(tempfile.mkdtemp(dir=shared))
    more = {"FLEETMAP_ZENOH_MODE": "client", "FLEETMAP_ZENOH_CONNECT": endpoint, "FLEETMAP_ZENOH_ADVERTISE": endpoint}
    try:
        with tempfile.TemporaryDirectory() as folder, serve_network(Path(folder), port, zenoh_port, **more) as client:
            robots = _Robots(f"http://127.0.0.1:{port}", zenoh_port, disk)
            _until(lambda: len(robots.times("active", 1)) == ROBOTS and len(robots.times("connected")) == ROBOTS, 300)
            # All receive a change at once: one conversion.
            count_before, at = conversions(client), time.monotonic()
            second = commit(client, 1.0)
            _until(lambda: len(robots.times("active", second)) == ROBOTS, 120)
            heard = max(robots.times("active", second).values()) - at
            one = conversions(client) - count_before
            # And after the router's restart.
            router._process.kill()
            router.close()
            third = commit(client, 2.0)
            time.sleep(3.0)
            router = Router(options)
            back = time.monotonic()
            if router.problem is not None:
                raise RuntimeError(router.problem)
            _until(lambda: len(robots.times("active", third)) == ROBOTS, 120)
            seconds = max(robots.times("active", third).values()) - back
            another = conversions(client) - count_before - one
            time.sleep(2.0)
            manifest = client.get(f"/api/v1/environments/{ENVIRONMENT}/versions/latest/manifest?formats=tmap2")
            last = int(manifest.json()["sequence"])
            sequences = robots.end()
            failed = Counter(line.get("detail") for line in robots.lines if line["event"] in ("failed", "refused"))
            for detail, count in failed.most_common(3):
                print(f"{count} × {detail}", file=sys.stderr)
    finally:
        router.close()
        shutil.rmtree(disk, ignore_errors=True)
    lost = sum(not set(range(2, last + 1)) <= set(numbers) for numbers in sequences.values())
    print(f"all {ROBOTS} robots drove on a change {heard:.1f} s after it was sent", file=sys.stderr)
    row = {"peer": None, "ratio": None}
    return [
        {
            **row,
            "what": f"{ROBOTS} robots after a router's restart",
            "ours": seconds,
            "unit": "s",
            "bound": f"≤ {CONVERGED_SECONDS:g} s",
            "holds": seconds <= CONVERGED_SECONDS,
        },
        {**row, "what": "… that lost an event", "ours": lost, "unit": "", "bound": "0", "holds": lost == 0},
        {
            **row,
            "what": f"conversions for {ROBOTS} robots",
            "ours": max(one, another),
            "unit": "",
            "bound": "1",
            "holds": one == another == 1,
        },
    ]


def conversions(client: httpx.Client) -> int:
    """Count the maps that the server has converted."""
    match = re.search(r'fleetmap_conversions_total\{format="tmap2",result="made"\} (\S+)', client.get("/metrics").text)
    return int(float(match[1])) if match else 0


# --- bytes per change -------------------------------------------------------------------------------------


def costs() -> list[dict[str, Any]]:
    """Measure the bytes for small changes of a real site."""
    port, zenoh_port = free_port(), free_port()
    with tempfile.TemporaryDirectory() as folder, serve_network(Path(folder), port, zenoh_port) as client:

        def upload(env: str, files: dict[str, bytes]) -> None:
            client.post("/api/v1/environments", json={"name": env})
            sent = [("files", item) for item in files.items()]
            client.post(f"/api/v1/environments/{env}/versions", files=sent).raise_for_status()

        server = f"http://127.0.0.1:{port}"
        node = changes.moved_node(SHARED, upload, server, TOKEN)
        block, picture = changes.changed_block(SHARED, upload, server, TOKEN)
    return [
        {
            "what": "a moved node of a network of 382 kB, to a robot",
            "peer": None,
            "ours": node,
            "unit": "B",
            "ratio": None,
            "bound": "≤ 1000 B",
            "holds": node <= 1000,
        },
        {
            "what": "a block of 400 × 400 of 4000 × 4000 cells, to a robot (peer: the PNG)",
            "peer": picture,
            "ours": block,
            "unit": "B",
            "ratio": block / picture,
            "bound": "≤ 0.15",
            "holds": block <= 0.15 * picture,
        },
    ]


def rows() -> list[dict[str, Any]]:
    """Run all measurements."""
    return [*costs(), *latency(), *convergence()]


def _until(condition: Any, seconds: float = 60.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            raise RuntimeError("it did not come about in time")
        time.sleep(0.02)


if __name__ == "__main__":
    if sys.argv[1] == "put":
        put(*map(int, sys.argv[2:]))
    else:
        fleet(sys.argv[2], int(sys.argv[3]), sys.argv[4], int(sys.argv[5]), int(sys.argv[6]))

"""Two servers and two workers as real processes, on one PostgreSQL database and one blob folder."""

from __future__ import annotations

import contextlib
import re
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import psycopg
import pytest

from tests.agent.conftest import ROOT
from tests.cli.conftest import ServerProcess
from tests.events.conftest import eventually
from tests.postgres import Cluster
from tests.scale.conftest import Server, Servers, servers_on

LONG = {"generator": "cave", "parameters": {"width": 40.0, "depth": 40.0, "cell": 0.1}, "replace": True}
"""A generation that takes some seconds of CPU time."""

ASYNC = {"Prefer": "respond-async"}
RESUME_SECONDS = 15.0


@dataclass
class Site:
    """Servers and workers."""

    servers: Servers
    blobs: Path
    workers: list[ServerProcess] = field(default_factory=list)

    def add_worker(self, **settings: str) -> ServerProcess:
        data = self.servers.folder / f"worker-{len(self.workers)}"
        values = {
            "FLEETMAP_DATABASE_URL": self.servers.url,
            "FLEETMAP_BLOB_URL": str(self.blobs),
            "FLEETMAP_CONVERSION_WORKERS": "1",
            **settings,
        }
        worker = ServerProcess("--data-dir", str(data), environment=values, folder=ROOT, command="worker")
        self.workers.append(worker)
        return worker

    def ready(self, worker: ServerProcess) -> str:
        """Wait until a worker takes tasks; returns its address."""
        address = worker.wait_for(r"worker: (http://\S+)/readyz")[1]

        def takes_tasks() -> bool:
            try:
                return httpx.get(f"{address}/readyz", timeout=10).status_code == 200
            except httpx.TransportError:
                return False

        eventually(takes_tasks)
        return address

    def create(self, name: str) -> None:
        self.servers.call(self.servers.all[0], "POST", "environments", json={"name": name})

    def start_generation(self, server: Server, environment: str, seed: int = 1) -> str:
        """Start a long generation and return its job."""
        answer = server.http.post(
            f"/api/v1/environments/{environment}/generations", json={**LONG, "seed": seed}, headers=ASYNC
        )
        assert answer.status_code == 202, answer.text
        assert answer.headers["preference-applied"] == "respond-async"
        return str(answer.json()["id"])

    def job(self, server: Server, id: str) -> Any:
        return self.servers.call(server, "GET", f"jobs/{id}")

    def wait(self, server: Server, id: str, *states: str) -> Any:
        return eventually(lambda: (job := self.job(server, id))["state"] in states and job, seconds=120.0)

    def versions(self, environment: str) -> int:
        found = self.servers.call(self.servers.all[0], "GET", f"environments/{environment}/versions/latest")
        return int(found["version"])


@pytest.fixture(scope="module")
def two_servers(postgres_cluster: Cluster, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """Two servers without Zenoh, which the tests share."""
    folder = tmp_path_factory.mktemp("servers")
    with servers_on(postgres_cluster, folder, zenoh=False) as servers:
        site = Site(servers, folder / "blobs")
        servers.start(2, blob_url=str(site.blobs))
        yield site


@pytest.fixture
def site(two_servers: Site) -> Iterator[Site]:
    """Two servers without workers; each test uses its own environments."""
    yield two_servers
    for worker in two_servers.workers:
        worker.stop(signal.SIGKILL)


def queue(server: Server) -> dict[str, float]:
    text = server.http.get("/metrics").text
    return {name: float(value) for name, value in re.findall(r"^fleetmap_queue_(\S+) (\S+)$", text, re.MULTILINE)}


def test_work_of_a_killed_worker_is_resumed_and_made_once(site: Site) -> None:
    """Kill -9 in the middle of a generation that one server started; the other one shows its end."""
    one, other = site.servers.all
    site.create("killed")
    first, second = site.add_worker(), site.add_worker()
    site.ready(first)
    site.ready(second)
    second.process.send_signal(signal.SIGSTOP)  # so that the first one takes the work
    job = site.start_generation(one, "killed")
    site.wait(other, job, "running")
    second.process.send_signal(signal.SIGCONT)
    state = site.job(other, job)["state"]
    assert state == "running", f"the work ended before the kill: {state}"
    first.stop(signal.SIGKILL)
    killed = time.monotonic()
    eventually(lambda: any("put back" in line for line in second.lines))
    print(f"put back {time.monotonic() - killed:.1f} s after the kill")
    assert time.monotonic() - killed < RESUME_SECONDS
    done = site.wait(other, job, "done", "failed")
    assert done["state"] == "done", done
    assert done["result"]["location"] == "/api/v1/environments/killed/versions/1"
    assert site.versions("killed") == 1
    assert site.servers.call(other, "GET", "environments/killed/versions/1")["message"].startswith("Generated by cave")


def entries(site: Site) -> list[tuple[str, int]]:
    """Status and number of earlier attempts of each task in the queue."""
    with psycopg.connect(site.servers.url.replace("+psycopg", "")) as connection:
        return connection.execute("SELECT status::text, attempts FROM procrastinate_jobs").fetchall()


def has_made(worker: ServerProcess) -> bool:
    """Whether the confined processes of a worker that stands still have nothing more to do."""

    def time_used() -> list[list[str]]:
        out = []
        for file in Path("/proc").glob("[0-9]*/stat"):
            with contextlib.suppress(OSError):  # it has ended
                stat = file.read_text().rpartition(")")[2].split()
                if stat[2] == str(worker.process.pid):  # in its group
                    out.append(stat[11:13])
        return out

    before = time_used()
    time.sleep(1.0)
    return len(before) > 1 and time_used() == before


def test_work_of_a_worker_that_stood_still_is_taken_over_and_made_once(site: Site) -> None:
    """Its result is there as soon as it goes on, while the other worker has the task."""
    one, other = site.servers.all
    site.create("stopped")
    first, second = site.add_worker(), site.add_worker()
    site.ready(first)
    site.ready(second)
    second.process.send_signal(signal.SIGSTOP)  # so that the first one takes the work
    job = site.start_generation(one, "stopped")
    eventually(lambda: site.job(other, job).get("step") == "cave")
    second.process.send_signal(signal.SIGCONT)
    first.process.send_signal(signal.SIGSTOP)
    stopped = time.monotonic()
    assert entries(site) == [("doing", 0)]
    eventually(lambda: entries(site) == [("doing", 1)])
    print(f"taken over {time.monotonic() - stopped:.1f} s after the stop")
    assert time.monotonic() - stopped < RESUME_SECONDS
    eventually(lambda: has_made(first), seconds=120.0)
    second.process.send_signal(signal.SIGSTOP)  # so that the first one ends before it
    first.process.send_signal(signal.SIGCONT)
    first.wait_for("taken for dead, what it made too late is thrown away")
    second.process.send_signal(signal.SIGCONT)
    done = site.wait(other, job, "done", "failed")
    assert done["state"] == "done", done
    assert done["result"]["location"] == "/api/v1/environments/stopped/versions/1"
    assert site.versions("stopped") == 1
    eventually(lambda: entries(site) == [])
    assert not [line for worker in (first, second) for line in worker.lines if " ERROR " in line]


def test_job_is_cancelled_from_the_other_server(site: Site) -> None:
    one, other = site.servers.all
    site.create("cancelled")
    site.ready(site.add_worker())
    job = site.start_generation(one, "cancelled")
    site.wait(one, job, "running")
    shown = eventually(lambda: (job_now := site.job(other, job)).get("step") and job_now)
    assert (shown["step"], shown["progress"]) in (("reading", 0.0), ("cave", 0.1))
    assert other.http.delete(f"/api/v1/jobs/{job}").status_code == 204
    assert site.job(one, job)["state"] == "cancelled"
    eventually(lambda: queue(one)["running"] == 0)
    assert site.versions("cancelled") == 0


def test_environments_take_turns_and_a_stopping_worker_gives_its_work_back(site: Site) -> None:
    one, other = site.servers.all
    quick = {"generator": "cave", "parameters": {"width": 5.0, "depth": 5.0}, "replace": True}
    for name in ("many", "few"):
        site.create(name)
    worker = site.add_worker()
    site.ready(worker)
    site.start_generation(one, "many", seed=99)
    jobs = {}
    for name, seeds in (("many", range(8)), ("few", range(1))):
        for seed in seeds:
            answer = one.http.post(
                f"/api/v1/environments/{name}/generations", json={**quick, "seed": seed}, headers=ASYNC
            )
            jobs[name, seed] = answer.json()["id"]
    assert queue(other)['waiting{urgency="person"}'] >= 5
    few = site.wait(other, jobs["few", 0], "done", "failed")
    assert few["state"] == "done", few
    others = [site.job(other, jobs["many", seed]) for seed in range(8)]
    before = [job for job in others if job["state"] == "done" and job["updated"] < few["updated"]]
    assert len(before) <= 4, others
    assert worker.stop(signal.SIGTERM) == 0
    site.ready(site.add_worker())
    for job in jobs.values():
        assert site.wait(other, job, "done", "failed")["state"] == "done"

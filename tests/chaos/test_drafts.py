"""kill -9 of the server while drafts are written, rebased and committed.

Every write that was acknowledged is in the version, none is there in part, and each draft becomes one version.
"""

from __future__ import annotations

import os
import random
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest

from tests.api.conftest import ADMIN
from tests.cli.conftest import ServerProcess
from tests.ports import free_port

ROUNDS = max(1, int(os.environ.get("FLEETMAP_CHAOS", "4")) // 8)
SEED = int(os.environ.get("FLEETMAP_CHAOS_SEED", "5"))
SECONDS = 120.0
"""Maximum time until a request is answered, however often the server is killed meanwhile."""

SITE = "environments/farm"
MERGE_PATCH = {"content-type": "application/merge-patch+json"}

pytestmark = pytest.mark.timeout(240 + ROUNDS * 240)


class Server:
    """A server on SQLite that is killed and started again, and calls that are repeated until it answers."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.port = folder, free_port()
        self.http = httpx.Client(
            base_url=f"http://127.0.0.1:{self.port}", headers={"Authorization": f"Bearer {ADMIN}"}, timeout=30
        )
        self.process = self._start()

    def _start(self) -> ServerProcess:
        arguments = ("--port", str(self.port), "--data-dir", str(self.folder / "data"))
        variables = {"FLEETMAP_ADMIN_TOKEN": ADMIN, "FLEETMAP_CONVERSION_WORKERS": "1"}
        process = ServerProcess(*arguments, environment=variables, folder=self.folder)
        process.ready()
        return process

    def kill(self) -> None:
        self.process.stop(signal.SIGKILL)
        self.process = self._start()

    def send(self, method: str, path: str, *statuses: int, **request: Any) -> httpx.Response:
        """Send a request until it is answered with one of these statuses. 5xx: the server is ending or starting."""
        address = path if path.startswith("/") else f"/api/v1/{path}"
        deadline = time.monotonic() + SECONDS
        while True:
            try:
                answer = self.http.request(method, address, **request)
            except httpx.TransportError:
                answer = None
            if answer is not None and answer.status_code < 500:
                assert answer.status_code in statuses, f"{method} {path}: {answer.status_code} {answer.text}"
                return answer
            assert time.monotonic() < deadline, f"{method} {path} was never answered"
            time.sleep(0.05)

    def nodes(self, ref: object) -> dict[str, Any]:
        features = self.send("GET", f"{SITE}/versions/{ref}/layers/topology", 200).json()["features"]
        return {feature["id"]: feature["properties"].get("count") for feature in features}


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    server = Server(tmp_path)
    yield server
    server.process.stop()
    server.http.close()


def node(item: str, count: int) -> dict[str, Any]:
    feature = {"type": "Feature", "id": item, "geometry": {"type": "Point", "coordinates": [5.0, 52.0]}}
    return {"op": "put", "layer": "topology", "feature": {**feature, "properties": {"kind": "node", "count": count}}}


class Writers:
    """Writers into one draft: a node again and again, new nodes, and two nodes together. ``done``: acknowledged."""

    def __init__(self, server: Server, draft: str, before: dict[str, int]) -> None:
        self._server, self._draft = server, draft
        self._stop = threading.Event()
        self.done = dict(before)
        self._pool = ThreadPoolExecutor(3)
        steps = {"patched": self._patch, "added": self._add, "pair": self._put_pair}
        self._running = [self._pool.submit(self._write, name, step) for name, step in steps.items()]

    def _write(self, name: str, step: Callable[[int], None]) -> None:
        while not self._stop.is_set():
            step(self.done[name] + 1)
            self.done[name] += 1

    def _items(self) -> str:
        return f"/ogc/farm/drafts/{self._draft}/collections/nodes/items"

    def _patch(self, count: int) -> None:
        body = {"properties": {"count": count}}
        self._server.send("PATCH", f"{self._items()}/patched", 204, json=body, headers=MERGE_PATCH)

    def _add(self, count: int) -> None:
        point = {"type": "Point", "coordinates": [5.001, 52.001]}
        body = {"type": "Feature", "id": f"added-{count}", "geometry": point, "properties": {"count": count}}
        self._server.send("POST", self._items(), 201, 409, json=body)  # 409: the answer of the first try was lost

    def _put_pair(self, count: int) -> None:
        changes = [node("left", count), node("right", count)]
        self._server.send("POST", f"{SITE}/drafts/{self._draft}/edits", 200, json={"changes": changes})

    def wait_for_more(self, before: dict[str, int]) -> None:
        """Wait until each writer has another write acknowledged."""
        deadline = time.monotonic() + SECONDS
        while not all(self.done[name] > before[name] for name in before):
            failed = next((one for one in self._running if one.done()), None)
            assert failed is None, failed.exception()
            assert time.monotonic() < deadline, "a writer is never answered"
            time.sleep(0.02)

    def finish(self) -> dict[str, int]:
        """Wait until each has its last write acknowledged."""
        self._stop.set()
        for one in self._running:
            one.result(2 * SECONDS)
        self._pool.shutdown()
        return self.done


def check(nodes: dict[str, Any], done: dict[str, int]) -> None:
    assert nodes["patched"] == done["patched"]
    assert (nodes["left"], nodes["right"]) == (done["pair"], done["pair"])
    added = {f"added-{count}" for count in range(1, done["added"] + 1)}
    assert {item for item in nodes if item.startswith("added-")} == added


def test_drafts_survive_kills(server: Server) -> None:
    dice = random.Random(SEED)
    datum = {"latitude": 52.0, "longitude": 5.0}
    server.send("POST", "environments", 201, json={"name": "farm", "datum": datum})
    first = [node(item, 0) for item in ("patched", "left", "right", "head")]
    head = server.send("POST", f"{SITE}/edits", 201, json={"changes": first}).json()["version"]
    done = {"patched": 0, "added": 0, "pair": 0}
    for k in range(ROUNDS):
        draft = server.send("POST", f"{SITE}/drafts", 201, json={"name": f"draft {k}"}).json()["id"]
        before = dict(done)
        writers = Writers(server, draft, before)
        writers.wait_for_more(before)
        time.sleep(dice.uniform(0.0, 0.5))
        server.kill()
        writers.wait_for_more(dict(writers.done))
        done = writers.finish()
        check(server.nodes(f"draft:{draft}"), done)

        edit = {"changes": [node("head", k + 1)]}
        head += 1
        moved = server.send("POST", f"{SITE}/edits", 201, json=edit, headers={"idempotency-key": f"head-{k}"})
        assert moved.json()["version"] == head
        with ThreadPoolExecutor(1) as pool:
            rebase = pool.submit(server.send, "POST", f"{SITE}/drafts/{draft}/rebase", 200, json={})
            rebased = killed_during(server, rebase, dice)
            assert rebased["base"] == head
            key = {"idempotency-key": f"commit-{k}"}
            path = f"{SITE}/drafts/{draft}/commit"
            commit = pool.submit(server.send, "POST", path, 201, json={"message": f"draft {k}"}, headers=key)
            committed = killed_during(server, commit, dice)
        head += 1
        assert committed["version"] == head
        assert server.send("GET", SITE, 200).json()["version"] == head, "committed once"
        server.send("GET", f"{SITE}/drafts/{draft}", 404)
        stored = server.nodes(head)
        check(stored, done)
        assert stored["head"] == k + 1
    messages = [one["message"] for one in server.send("GET", f"{SITE}/versions?limit=1000", 200).json()]
    assert [messages.count(f"draft {k}") for k in range(ROUNDS)] == [1] * ROUNDS


def killed_during(server: Server, request: Future[httpx.Response], dice: random.Random) -> Any:
    """Kill the server soon after a request was sent; returns what it was answered at last."""
    time.sleep(dice.choice((0.0, 0.02, 0.05, 0.1, 0.2)))
    server.kill()
    return request.result(2 * SECONDS).json()

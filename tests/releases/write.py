"""Write the sample of this release: ``python -m tests.releases.write``. Once for each release, before it is tagged.

The sample of a release that was published never changes again.
"""

from __future__ import annotations

import base64
import json
import sqlite3
import sys
import tempfile
import time
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from app import __version__
from app.agent.agent import Agent, AgentOptions
from app.store.retention_rule import Rule
from tests.agent.conftest import Gate
from tests.api import samples
from tests.api.conftest import ADMIN, Api, create_farm, running, settings_for
from tests.releases.sample import MAX_BYTES, Exchange, read_facts, store

BARN = {"type": "Polygon", "coordinates": [[[-1, -1], [3, -1], [3, 2], [-1, 2], [-1, -1]]]}
KEPT_HEADERS = (
    "accept",
    "accept-encoding",
    "authorization",
    "available-dictionary",
    "content-type",
    "if-none-match",
    "prefer",
)
AGENT_FORMATS = ("tmap2", "occupancy_grid")


class Recorder:
    """Proxy that records what passes."""

    def __init__(self, upstream: str) -> None:
        self.gate = Gate(upstream)
        self.gate.change = self._note
        self.phase = ""
        self._answers: list[tuple[str, int, dict[str, str], bytes]] = []

    def _note(self, path: str, status: int, headers: dict[str, str], body: bytes) -> tuple[int, dict[str, str], bytes]:
        self._answers.append((self.phase, status, dict(headers), body))
        return status, headers, body

    def exchanges(self) -> list[Exchange]:
        """Return what has passed, in order."""
        out = []
        statuses = iter(self.gate.statuses)
        for (method, path, sent, _), (phase, status, headers, body) in zip(
            self.gate.requests, self._answers, strict=True
        ):
            content = json.dumps(next(statuses)).encode() if method == "PUT" else b""
            kept = {name: value for name, value in sent.items() if name in KEPT_HEADERS}
            dropped = ("date", "server", "transfer-encoding", "connection", "content-length", "x-request-id")
            answer = {name: value for name, value in headers.items() if name not in dropped}
            texts = [base64.b64encode(data).decode() for data in (content, body)]
            out.append(Exchange(phase, method, path, kept, texts[0], status, answer, texts[1]))
        return out


def fill(api: Api) -> None:
    """Make what a release can store: versions of all kinds, a channel, a draft, a closure, tags, a thinned version."""
    create_farm(api, "farm")
    farm = "environments/farm"
    api.upload("farm", {"barn.kml": samples.KML}, message="drawn", layer="objects")
    nodes = {**samples.NODES, "dock": (4.0, 6.0)}
    edges = (*samples.EDGES, ("barn", "dock"), ("dock", "barn"))
    api.upload("farm", {"network.tmap2.yaml": samples.tmap2(nodes, edges)}, message="a dock")
    zone = {"type": "Feature", "id": "z1", "geometry": BARN, "properties": {"kind": "keepout"}}
    put = {"op": "put", "layer": "zones", "feature": zone, "crs": "local"}
    api.post(f"{farm}/edits", {"message": "keep out", "changes": [put]})
    cells = {"op": "cells", "grid": "map", "polygon": BARN, "crs": "local", "value": 100}
    api.post(f"{farm}/edits", {"message": "a wall", "changes": [cells]})
    api.post(f"{farm}/versions", {"revert_to": 6, "message": "no wall"})
    api("PUT", f"{farm}/templates/openrmf", None, json={"message": "speed", "values": {"max_speed": 0.7}})
    api.post("environments", {"name": "copy", "clone": {"environment": "farm", "version": 5}})
    api("PUT", f"{farm}/versions/3/tags/season-2025", 200)
    api("PUT", f"{farm}/channels/production", 200, json={"version": 5})
    draft = api.post(f"{farm}/drafts", {"name": "new lanes"}).json()["id"]
    node = {"type": "Feature", "id": "tree", "geometry": {"type": "Point", "coordinates": [1, 1]}}
    node["properties"] = {"kind": "node", "name": "tree"}
    change = {"op": "put", "layer": "topology", "feature": node, "crs": "local"}
    api.post(f"{farm}/drafts/{draft}/edits", {"changes": [change]}, 200)
    api.post(f"{farm}/overlays", {"kind": "blocked", "edge": "gate_barn", "state": "accepted"})
    with api.app.state.services.store._database.write() as connection:
        for table in ("overlay", "draft"):  # they are read for years
            connection.exec_driver_sql(f"UPDATE {table} SET expires = '2099-01-01 00:00:00.000000'")


def session(api: Api, folder: Path) -> list[Exchange]:
    """Have an agent follow ``production``: its first map, then a new version, as deltas where possible."""
    recorder = Recorder(api.url)
    options = AgentOptions(recorder.gate.url, "farm", AGENT_FORMATS, folder, token=ADMIN, robot="r1")
    agent = Agent(options, lambda *_, **__: None)
    agent.open()
    try:
        for phase, version in (("first map", 3), ("new version", 8)):
            recorder.phase = phase
            api("PUT", "environments/farm/channels/production", 200, json={"version": version})
            assert agent.run_once(), phase
    finally:
        agent.close()
        recorder.gate.close()
    return recorder.exchanges()


def thin_one(api: Api) -> None:
    """Have version 4 thinned, as if time had passed."""
    services = api.app.state.services
    with services.store._database.write() as connection:
        old = "UPDATE version SET time = '2025-05-01 00:00:00.000000' WHERE number = 4 AND message = 'drawn'"
        assert connection.exec_driver_sql(old).rowcount == 1
    rule = Rule(all_days=1, daily_days=0, last=1)
    (plan,) = [p for p in services.store.retention.plan(rule) if p.environment == "farm"]
    assert plan.thinned == (4,), plan
    list(services.store.retention.apply(plan, rule))
    services.store.garbage.collect(timedelta(0))


def main() -> None:
    """Write the sample, and print its size."""
    with tempfile.TemporaryDirectory() as temporary:
        data = Path(temporary) / "data"
        settings = settings_for(data, job_seconds=60)
        with running(settings) as api:
            fill(api)
            exchanges = session(api, Path(temporary) / "robot")
            thin_one(api)
            facts: dict[str, Any] = {"written": datetime.now(UTC).isoformat(), "environments": read_facts(api)}
            facts["time"] = time.time()
        with closing(sqlite3.connect(data / "fleetmap.sqlite3")) as database:
            facts["schema"] = database.execute("SELECT version_num FROM alembic_version").fetchone()[0]
            database.execute("DELETE FROM audit")
            database.commit()
            database.execute("VACUUM")
            database.execute("PRAGMA wal_checkpoint(TRUNCATE)")
        size = store(__version__, data, facts, exchanges)
    print(f"{__version__}: {size} bytes, {len(exchanges)} exchanges")
    sys.exit(f"larger than {MAX_BYTES} bytes" if size > MAX_BYTES else 0)


if __name__ == "__main__":
    main()

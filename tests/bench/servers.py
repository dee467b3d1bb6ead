"""Several servers: all services of compose.scale.yaml as processes; a pinned robot, a rolling upgrade, and kills."""

from __future__ import annotations

import base64
import hashlib
import os
import signal
import tempfile
from pathlib import Path
from typing import Any

import httpx

from app import native
from tests.docker.scale_site import SERVERS, Load, ReadinessWatch, Site, fetch_round_robin, read_delays, running_site
from tests.docker.schema_upgrade import upgrade_to_later_revision
from tests.postgres import running_cluster

FETCHES = 1000
ROTATIONS = (250, 500, 750)
COMMITS = tuple(range(100, FETCHES, 100))
READS = 200
REQUESTS = 200
"""Requests of the load between two events."""


def rows() -> list[dict[str, Any]]:
    """Measure refusals and conversions of a robot, then failed requests during an upgrade and kills."""
    compiled = Path(tempfile.gettempdir()) / f"fleetmap-bench-native-{os.getuid()}"
    native.fill(compiled)  # compile before the measurement
    os.environ[native.FOLDER] = str(compiled)
    with running_cluster() as cluster, tempfile.TemporaryDirectory() as folder:
        url = cluster.url(cluster.create_database())
        with running_site(Path(folder), url) as site:
            return [*_fetches(site), *_deltas(site), *_commits(site), *_upgrade(site, url), *_kills(site)]


def _row(what: str, ours: float, bound: float, unit: str, peer: float | None = None) -> dict[str, Any]:
    shown = f"≤ {bound:g}" if bound else "0"
    ratio = None if peer is None else ours / peer
    value = ours if ratio is None else ratio
    return {
        "what": what,
        "peer": peer,
        "ours": ours,
        "unit": unit,
        "ratio": ratio,
        "bound": shown,
        "holds": value <= bound,
    }


def _create(site: Site, name: str) -> None:
    site.call(site.https, "POST", "environments", json={"name": name})
    site.upload(site.https, name, 0.0)


def _fetches(site: Site) -> list[dict[str, Any]]:
    _create(site, "pinned")
    before = sum(site.conversions().values())
    fetches = fetch_round_robin(site, "pinned", FETCHES, ROTATIONS, COMMITS)
    conversions = sum(site.conversions().values()) - before
    label = f"{FETCHES} fetches of a pinned robot, 3 servers in turn, {len(ROTATIONS)} key rotations"
    return [
        _row(f"{label}: refusals", len(fetches.refusals) + FETCHES - fetches.count, 0, "refusals"),
        _row(
            f"{len(COMMITS) + 1} versions, 2 formats: conversions (peer: recipes)",
            conversions,
            1,
            "maps",
            len(fetches.recipes),
        ),
    ]


def _deltas(site: Site) -> list[dict[str, Any]]:
    """Compare the delta of servers that have made neither map with that of the one that made both."""
    _create(site, "deltas")
    path, first = "/maps/deltas/tmap2", site.servers[SERVERS[0]]
    old = first.get(path).content
    site.upload(first, "deltas", 0.25)
    first.get(path)
    digest = base64.b64encode(hashlib.sha256(old).digest()).decode()
    headers = {"Accept-Encoding": "dcz", "Available-Dictionary": f":{digest}:"}

    def size(client: httpx.Client) -> int:
        with client.stream("GET", path, headers=headers) as answer:
            return len(b"".join(answer.iter_raw()))

    sizes = [size(client) for client in site.servers.values()]
    label = "a moved node from a server that made neither map (peer: from the one that made both)"
    return [_row(label, max(sizes), 1, "B", sizes[0])]


def _commits(site: Site) -> list[dict[str, Any]]:
    """Measure how long after a commit another server serves it."""
    _create(site, "commits")
    delays = read_delays(site, "commits", READS)
    worst = delays[READS * 99 // 100]
    return [_row(f"commit on one server, read on another: 99th percentile of {READS}", worst * 1e3, 100, "ms")]


def _upgrade(site: Site, url: str) -> list[dict[str, Any]]:
    """Migrate to a later schema, then replace all servers one by one, under load."""
    _create(site, "upgrade")
    load, watch = Load(site, "upgrade"), ReadinessWatch(site, SERVERS)
    try:
        load.wait_for_more(REQUESTS)
        upgrade_to_later_revision(url)
        load.wait_for_more(REQUESTS)
        for name in SERVERS:
            watch.names.discard(name)
            site.containers[name].stop(signal.SIGTERM)
            site.containers[name].start()
            site.wait_ready(name)
            watch.names.add(name)
            load.wait_for_more(REQUESTS)
    finally:
        load.stop()
        watch.stop()
    label = "rolling upgrade of 3 servers beside a later schema, under load"
    return [
        _row(f"{label}: failed of {load.requests} requests", len(load.failures), 0, "requests"),
        _row(f"{label}: unready of {watch.polls} polls", len(watch.unready), 0, "polls"),
    ]


def _kills(site: Site) -> list[dict[str, Any]]:
    """Kill each server with kill -9 and start it again, under load."""
    _create(site, "kill")
    load = Load(site, "kill")
    try:
        for name in SERVERS:
            load.wait_for_more(REQUESTS)
            site.containers[name].stop(signal.SIGKILL)
            load.wait_for_more(REQUESTS)
            site.containers[name].start()
            site.wait_ready(name)
    finally:
        load.stop()
    label = "kill -9 of each of 3 servers, under load"
    return [_row(f"{label}: failed of {load.requests} requests", len(load.failures), 0, "requests")]

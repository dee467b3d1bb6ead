"""A mirror that was apart for 48 hours: what catching up transfers, against what it lacked."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from numpy.typing import NDArray

from app.mirror.centre import TIMEOUT, Centre
from app.mirror.follow import Mirror
from app.model.features import from_columns, points
from app.signing import Keys
from app.store.changes import Changes, Put, Replace
from app.store.store import Store
from tests.bench import http
from tests.bench.scale import commit_grid, rooms, stored_bytes
from tests.bench.scale_site import NODES, TOPOLOGY, joined, name_of, network
from tests.ports import free_port

TOKEN = "bench-" + "0" * 40
BOUND = 1.1
EDITS = 480
"""Commits while the mirror is apart: one every six minutes."""

UPLOADS = 16
"""Uploads of a 5 MB grid with some cells changed: one every three hours."""

SITES = 20


def rows() -> list[dict[str, Any]]:
    """Measure the bytes of a catch-up in both directions, bodies as transferred."""
    with tempfile.TemporaryDirectory() as folder:
        place, edge_place = Path(folder) / "centre", Path(folder) / "edge"
        url = f"sqlite:///{place / 'fleetmap.sqlite'}"
        there = Store(url, place / "blobs")
        there.migrate()
        dice = np.random.default_rng(7)
        cells = rooms(2000, 2500)
        last = _begin(there, cells)
        port = free_port()
        env = {"FLEETMAP_DATA_DIR": str(place), "FLEETMAP_DATABASE_URL": url, "FLEETMAP_ADMIN_TOKEN": TOKEN}
        env |= {"FLEETMAP_ZENOH_MODE": "off", "FLEETMAP_SCRUB_HOURS": "0", "FLEETMAP_LOG_LEVEL": "warning"}
        command = [sys.executable, "-m", "app.cli", "serve", "--host", "127.0.0.1", "--port", str(port)]
        with http.serving(command, port, env), httpx.Client(timeout=TIMEOUT) as client:
            here = Store(f"sqlite:///{edge_place / 'fleetmap.sqlite'}", edge_place / "blobs")
            here.migrate()
            here.blobs.prepare()
            centre = Centre(f"http://127.0.0.1:{port}", TOKEN, client=client)
            mirror = Mirror(here, Keys(edge_place / "keys"), centre)
            _follow(mirror)
            _change(there, cells, last, dice)
            before, transferred = stored_bytes(here), centre.received + centre.sent
            _follow(mirror)
            missing = stored_bytes(here) - before
            transferred = centre.received + centre.sent - transferred
            here.close()
        there.close()
    label = f"mirror after {EDITS} edits and {UPLOADS} uploads apart: bytes (peer: what it lacked, as stored)"
    return [
        {
            "what": label,
            "peer": missing / 1e3,
            "ours": transferred / 1e3,
            "unit": "kB",
            "ratio": transferred / missing,
            "bound": f"≤ {BOUND}",
            "holds": transferred <= BOUND * missing,
        }
    ]


def _begin(store: Store, cells: NDArray[np.uint8]) -> str:
    """Create the sites and upload the grid; returns the hash of its file."""
    store.environments.create("farm")
    last = commit_grid(store, cells, "", upload=True)
    with joined(store):
        for site in range(SITES):
            head = store.environments.create(name_of(site))
            base = store.versions.get(head.name)
            prepared = store.versions.prepare(base, Changes((Replace(TOPOLOGY, network(site)),)))
            store.versions.commit(head.name, prepared, author="bench", message="")
    return last


def _change(store: Store, cells: NDArray[np.uint8], last: str, dice: np.random.Generator) -> None:
    """Do what happens in 48 hours."""
    with joined(store):
        for edit in range(EDITS):
            name, node = name_of(edit % SITES), int(dice.integers(NODES))
            moved = from_columns([f"n{node}"], points(dice.random((1, 2)) * 100), [{"kind": "node"}], "local")
            base = store.versions.get(name)
            prepared = store.versions.prepare(base, Changes((Put(TOPOLOGY, moved),)))
            store.versions.commit(name, prepared, author="bench", message="")
    for upload in range(UPLOADS):
        y, x = dice.integers(0, 1900), dice.integers(0, 2400)
        cells[y : y + 50, x : x + 50] = 100 * (upload % 2)
        last = commit_grid(store, cells, last, upload=True)


def _follow(mirror: Mirror) -> None:
    failures = mirror.run_once().failures
    if failures:
        raise RuntimeError(f"not mirrored: {failures}")

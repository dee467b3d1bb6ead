"""OGC API: a box and a page of 100 000 features over HTTP, beside the store's query and orjson's dump; a vector tile.

Times are processor times of the process, in which server and client run, so that other load on the machine counts less.
"""

from __future__ import annotations

import http.client
import itertools
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import orjson
import shapely

from app.model.features import features
from app.model.frame import Datum
from app.model.geodesy import local_frame
from app.model.layers import PartKey
from app.ogc.tables import build_tables, table_key
from app.ogc.tile_matrix_sets import SETS
from app.ogc.vector_tiles import vector_tile
from app.store.changes import Replace
from app.store.store import Store
from tests.api.conftest import ADMIN, Api, running, settings_for
from tests.store.bench_layout import network
from tests.store.samples import save

FEATURES = 100_000
PAGE = 1000
SIDE_METRES = 2000.0
DATUM = Datum(53.2, -0.5, 0.0, 30.0)
KEY = PartKey("topology", "ground", "network")
TILE_EDGES, TILE_MS = 20_000, 100.0
BOX_MS, BOX_RATIO, PAGE_RATIO = 30.0, 1.5, 2.0


def rows(tries: int) -> list[dict[str, Any]]:
    """Measure a box of 1 % and a page of 1000; the peer runs in turns with ours."""
    with tempfile.TemporaryDirectory() as folder, running(settings_for(Path(folder))) as api:
        store = api.app.state.services.store
        store.environments.create("large", datum=DATUM)
        version = save(store, "large", Replace(KEY, network(2 * FEATURES).select(np.arange(FEATURES))))
        side = SIDE_METRES / 10
        corners = np.array([[x, y] for x in (900.0, 900.0 + side) for y in (900.0, 900.0 + side)])
        degrees = local_frame(DATUM).to_wgs84(corners)
        box = (*degrees.min(axis=0).tolist(), *degrees.max(axis=0).tolist())
        connection = _Connection(api)
        url = "/ogc/large/collections/nodes/items"
        started = time.process_time()
        connection.get(f"{url}?limit=1")
        first = (time.process_time() - started) * 1e3
        box_url = f"{url}?limit=10000&bbox={','.join(map(repr, box))}"
        matched = orjson.loads(connection.get(box_url))["numberMatched"]
        theirs, ours = _in_turns(
            lambda: store.content.features(version, KEY, bbox=box, crs="wgs84"), lambda: connection.get(box_url), tries
        )
        page_url = f"{url}?limit={PAGE}"
        page = orjson.loads(connection.get(page_url))
        dump, paged = _in_turns(lambda: orjson.dumps(page), lambda: connection.get(page_url), tries)
        empty, _ = _in_turns(lambda: connection.get("/healthz"), lambda: None, tries)
    return [
        _row(f"bbox of 1 % ({matched} of {FEATURES}), HTTP; peer: the store's box", theirs, ours, BOX_RATIO, BOX_MS),
        _row(f"page of {PAGE}, beyond an empty request; peer: orjson.dumps", dump, paged - empty, PAGE_RATIO, None),
        *_tile_rows(tries),
        {"what": "first request after a commit", "peer": None, "ours": first, "unit": "ms", "ratio": None,
         "bound": "–", "holds": True},
    ]  # fmt: skip


def _tile_rows(tries: int) -> list[dict[str, Any]]:
    """Measure the CPU time of a tile that shows all of 20 000 edges, from its table and from its prepared source."""
    with tempfile.TemporaryDirectory() as folder:
        store = Store(f"sqlite:///{folder}/db.sqlite", Path(folder) / "blobs")
        store.migrate()
        store.environments.create("streets", datum=DATUM)
        edges = [
            (f"e{k}", shapely.LineString([(x, y), (x + 9, y + 4)]), {"kind": "edge", "source": f"n{k}", "target": "n"})
            for k, (x, y) in enumerate(itertools.product(np.arange(200) * 6.0, np.arange(TILE_EDGES // 200) * 8.0))
        ]
        version = save(store, "streets", Replace(KEY, features(edges, "local")))
        tables = build_tables(store.content, version, "topology")
    key = table_key(version, "topology")
    assert key is not None
    quad = SETS["WebMercatorQuad"]
    (address,) = [
        (14, row, column) for row, _, column, _ in [quad.limits(tables["edges"].bbox, local_frame(DATUM))[14]]
    ]
    times = []
    for _ in range(max(3, tries)):
        started = time.process_time()
        data = vector_tile({"edges": (key, tables["edges"])}, quad, *address)
        times.append((time.process_time() - started) * 1e3)
    size = f"{len(data) / 1e6:.1f} MB"
    return [
        {"what": f"vector tile of {TILE_EDGES} edges ({size}), CPU", "peer": None, "ours": min(times[1:]), "unit": "ms",
         "ratio": None, "bound": f"≤ {TILE_MS:g} ms", "holds": min(times[1:]) <= TILE_MS},
        {"what": "the same, the layer's first one", "peer": None, "ours": times[0], "unit": "ms", "ratio": None,
         "bound": "–", "holds": True},
    ]  # fmt: skip


def _row(what: str, peer: float, ours: float, ratio: float, limit: float | None) -> dict[str, Any]:
    bound = f"≤ {ratio:g} ×" + ("" if limit is None else f", ≤ {limit:g} ms")
    holds = ours <= ratio * peer and (limit is None or ours <= limit)
    return {"what": what, "peer": peer, "ours": ours, "unit": "ms", "ratio": ours / peer, "bound": bound,
            "holds": holds}  # fmt: skip


class _Connection:
    """Connection to the server, with a client that costs little."""

    def __init__(self, api: Api) -> None:
        self._connection = http.client.HTTPConnection(api.url.removeprefix("http://"))

    def get(self, path: str) -> bytes:
        """Return the body of a response."""
        self._connection.request("GET", path, headers={"Authorization": f"Bearer {ADMIN}"})
        answer = self._connection.getresponse()
        body = answer.read()
        assert answer.status == 200, body[:500]
        return body


def _in_turns(peer: Callable[[], Any], ours: Callable[[], Any], tries: int) -> tuple[float, float]:
    """Return the fastest of several runs of each in milliseconds, after a warm-up."""
    best = [float("inf"), float("inf")]
    for _ in range(tries + 1):
        for k, work in enumerate((peer, ours)):
            started = time.process_time()
            work()
            best[k] = min(best[k], (time.process_time() - started) * 1e3)
    return best[0], best[1]

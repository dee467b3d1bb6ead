"""A centre and an edge server in this process, and mirrors that connect them and count what they transfer."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import httpx
import pytest
from sqlalchemy import func, select

from app.mirror.centre import Centre
from app.mirror.follow import Mirror
from app.signing import Keys
from app.store import tables
from app.store.store import Store
from tests.api import samples
from tests.api.conftest import Api, empty_database, running, settings_for
from tests.ports import free_port


class Wire(httpx.BaseTransport):
    """Transport that counts the bytes of bodies in both directions.

    cut: no connection. change: called with each answer's path and body, returns another body. limit: bytes after which
    content is cut off. repeats: answers by path, each of which is sent again.
    """

    def __init__(self) -> None:
        self._inner = httpx.HTTPTransport()
        self.sent = self.received = 0
        self.cut = False
        self.change: Callable[[str, bytes], bytes] | None = None
        self.limit: int | None = None
        self.repeats: dict[str, tuple[bytes, httpx.Headers]] | None = None
        self.paths: list[str] = []

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        if self.cut:
            raise httpx.ConnectError("cut off", request=request)
        self.sent += len(request.read())
        if self.change is not None:
            request.headers["accept-encoding"] = "identity"
        self.paths.append(request.url.path)
        answer = self._inner.handle_request(request)
        data, fields = b"".join(answer.stream), answer.headers  # type: ignore[arg-type]
        answer.close()
        if self.repeats is not None:
            data, fields = self.repeats.setdefault(request.url.path, (data, fields))
        self.received += len(data)
        if self.change is not None:
            data = self.change(request.url.path, data)
        if self.limit is not None and request.url.path.endswith("/content"):
            data = data[: self.limit]
        headers = [(k, v) for k, v in fields.items() if k not in ("content-length", "transfer-encoding")]
        return httpx.Response(answer.status_code, headers=headers, stream=httpx.ByteStream(data))

    def close(self) -> None:
        self._inner.close()


class Edge:
    """A store that mirrors a centre, with its own signing key."""

    def __init__(self, store: Store, keys: Any, centre: Api, token: str, *names: str, given: str | None = None) -> None:
        self.store, self.keys, self.wire = store, keys, Wire()
        client = httpx.Client(transport=self.wire, timeout=60)
        self.now: Callable[[], datetime] = lambda: datetime.now(UTC)
        state = store.mirrors.state()
        key = None if state is None else state.key
        self.centre = Centre(centre.url, token, key=key, given=given, client=client)
        self.mirror = Mirror(store, keys, self.centre, names, clock=lambda: self.now())

    def follow(self) -> None:
        """Run one pass, without any failure."""
        state = self.mirror.run_once()
        assert state.failures == {}, state.failures

    def close(self) -> None:
        self.centre.close()


@pytest.fixture(scope="module")
def centre(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Api]:
    with running(settings_for(tmp_path_factory.mktemp("centre"))) as api:
        yield api


@pytest.fixture(scope="module")
def port() -> int:
    """Port of the edge's Zenoh router."""
    return free_port()


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory, port: int) -> Iterator[Api]:
    """The server of the edge, with a Zenoh router."""
    folder = tmp_path_factory.mktemp("edge")
    with running(settings_for(folder, zenoh_mode="router", zenoh_listen=f"tcp/127.0.0.1:{port}")) as api:
        yield api


def mirror_token(centre: Api, environments: str | None = None) -> str:
    more = {} if environments is None else {"environments": environments}
    return str(centre.post("tokens", {"name": "edge", "role": "mirror", **more}).json()["token"])


@pytest.fixture
def follower(centre: Api, site: Api) -> Iterator[Callable[..., Edge]]:
    """Function that makes a mirror of some environments in the edge's server."""
    made: list[Edge] = []

    def make(*names: str) -> Edge:
        services = site.app.state.services
        made.append(Edge(services.store, services.keys, centre, mirror_token(centre), *names))
        return made[-1]

    yield make
    for one in made:
        one.close()


@pytest.fixture
def alone(centre: Api, tmp_path: Path) -> Iterator[Callable[..., Edge]]:
    """Function that makes a mirror with a store of its own, without a server."""
    made: list[Edge] = []

    def make(*names: str, folder: str = "edge", url: str | None = None, **more: Any) -> Edge:
        path = tmp_path / folder
        if not path.exists():
            path.mkdir()
            (path / "edge.sqlite3").write_bytes(empty_database())
        store = Store(f"sqlite:///{path}/edge.sqlite3", path / "blobs")
        store.blobs.prepare()
        token = more.pop("token", None) or mirror_token(centre)
        made.append(Edge(store, Keys(path / "keys"), centre, token, *names, **more))
        return made[-1]

    yield make
    for one in made:
        one.close()
        one.store.close()


def long_network(step: int = 0) -> str:
    """Return a file of a network of 2000 nodes; each step above 0 moves 150 others of them."""
    low, high = 450 * step, 450 * step + 150 if step else 0
    nodes = {f"n{k}": (float(k % 70), k / 70.0 + (step if low < k < high else 0)) for k in range(2000)}
    return samples.tmap2(nodes, tuple((f"n{k}", f"n{k + 1}") for k in range(1999)))


def stored_bytes(store: Store) -> int:
    """Bytes of everything that the mirrored versions consist of, as they are stored."""
    with store._database.read() as connection:
        of = [
            select(func.sum(func.length(tables.chunk.c.data))),
            select(func.sum(func.coalesce(tables.blob.c.stored, tables.blob.c.size))),
            select(func.sum(func.length(tables.version.c.manifest))),
            select(func.sum(func.length(tables.event.c.body))),
        ]
        return sum(int(connection.execute(query).scalar() or 0) for query in of)

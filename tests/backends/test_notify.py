"""Notifications: a commit changes the number that the other servers compare, soon and without a poll."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from app.backends.lead import LocalLead
from app.backends.notify import Listener
from app.store.store import Store
from tests.events.conftest import eventually
from tests.postgres import Cluster
from tests.scale.proxy import Proxy

OpenStore = Callable[..., Store]


@pytest.fixture
def open_store(database_url: str, tmp_path: Path) -> Iterator[OpenStore]:
    """Function that opens the store of another process: of the same server, or of another one on PostgreSQL."""
    stores: list[Store] = []
    listeners: list[Listener] = []

    def open_one(listen_url: str = database_url) -> Store:
        folder = tmp_path / ("blobs" if database_url.startswith("sqlite") else f"blobs-{len(stores)}")
        store = Store(database_url, folder)
        store.migrate()
        stores.append(store)
        if store.is_shared:
            listeners.append(Listener(listen_url, store.generation, LocalLead(folder, "notify")))
            listeners[-1].start()
            eventually(lambda: listeners[-1]._connection is not None)
        return store

    yield open_one
    for listener in listeners:
        listener.close()
    for store in stores:
        store.close()


def test_commit_is_noticed_by_another_process(open_store: OpenStore) -> None:
    one, two = open_store(), open_store()
    time.sleep(0.2)
    for number in range(5):
        before = two.generation()
        one.environments.create(f"farm-{number}")
        start = time.monotonic()
        eventually(lambda before=before: two.generation() != before)
        assert time.monotonic() - start < 5


def test_what_is_no_change_for_caches_is_not_announced(open_store: OpenStore) -> None:
    one, two = open_store(), open_store()
    time.sleep(0.3)
    before = two.generation()
    with one._database.write(notify=False):
        pass
    with pytest.raises(ZeroDivisionError), one._database.write():
        raise ZeroDivisionError
    time.sleep(0.3)
    assert two.generation() == before


@pytest.mark.postgres
@pytest.mark.parametrize("database_url", ["postgres"], indirect=True)
class TestShared:
    """What a network may do."""

    def test_own_commit_changes_the_number_once(self, open_store: OpenStore) -> None:
        store = open_store()
        time.sleep(0.3)
        store.environments.create("farm")
        after = store.generation()
        time.sleep(0.3)
        assert store.generation() == after

    def test_silent_connection_is_replaced(
        self, open_store: OpenStore, postgres_cluster: Cluster, database_url: str, caplog: pytest.LogCaptureFixture
    ) -> None:
        proxy = Proxy(postgres_cluster.port)
        try:
            url = database_url.replace(f":{postgres_cluster.port}/", f":{proxy.port}/")
            far = open_store(url)
            near = open_store()
            proxy.is_silent = True
            before = far.generation()
            near.environments.create("farm")
            eventually(lambda: "notifications: lost the connection" in caplog.text)
            assert far.generation() == before
            proxy.is_silent = False
            eventually(lambda: far.generation() != before)
            before = far.generation()
            near.environments.create("barn")
            eventually(lambda: far.generation() != before)
        finally:
            proxy.close()

"""Several servers on one database that start at once, refuse guesses together, and run beside a later schema.

What they share while they run is tested in ``tests/docker/test_scale_run.py``, on servers that start once.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import psycopg
import pytest

from app.main import close_services, open_services
from tests.api.conftest import settings_for
from tests.cli.conftest import ServerProcess
from tests.events.conftest import eventually
from tests.postgres import Cluster
from tests.scale.conftest import Servers, servers_on

pytestmark = pytest.mark.postgres

GUESSES = 9


@pytest.fixture(scope="module")
def servers(postgres_cluster: Cluster, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Servers]:
    """Three servers without Zenoh, which the tests share; each uses its own environment."""
    with servers_on(postgres_cluster, tmp_path_factory.mktemp("servers"), zenoh=False) as three:
        three.start(3, token_failures=str(GUESSES))
        yield three


def test_ten_first_starts_at_once_make_one_administrator(
    postgres_cluster: Cluster, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    database = postgres_cluster.create_database()
    together = threading.Barrier(10)

    def start(number: int) -> list[Any]:
        settings = settings_for(tmp_path / str(number), database_url=postgres_cluster.url(database), admin_token=None)
        together.wait()
        services = open_services(settings)
        try:
            return services.keys.public()
        finally:
            close_services(services)

    try:
        with ThreadPoolExecutor(10) as threads:
            keys = list(threads.map(start, range(10)))
    finally:
        postgres_cluster.drop_database(database)
    assert capsys.readouterr().out.count("administrator's token") == 1
    assert keys == [keys[0]] * 10
    assert len(keys[0]) == 1


def test_wrong_tokens_count_on_all_servers(servers: Servers) -> None:
    def guess(number: int) -> int:
        wrong = {"Authorization": f"Bearer guess-{os.urandom(4).hex()}"}
        return httpx.get(f"{servers.all[number].process.address}/api/v1/keys", headers=wrong).status_code

    assert [guess(n) for n in (0, 1, 2) * 3] == [401] * GUESSES
    for number in range(3):
        eventually(lambda n=number: guess(n) == 429, 10)
    assert servers.all[0].http.get("/api/v1/keys").status_code == 200, "a valid token is always accepted"


def test_servers_serve_beside_a_newer_compatible_schema(servers: Servers) -> None:
    """The next release migrates first; this one goes on, starts again, and refuses only what it cannot read."""

    def migrate_to(revision: str, compatible: str) -> None:
        with psycopg.connect(servers.url.replace("+psycopg", ""), autocommit=True) as connection:
            connection.execute("UPDATE alembic_version SET version_num = %s", (revision,))
            connection.execute("UPDATE server SET min_compatible = %s", (compatible,))

    def status(number: int) -> Any:
        return servers.all[number].http.get("/readyz").status_code

    migrate_to("9997", "0016")
    assert [status(n) for n in range(3)] == [200] * 3
    servers.add(servers.launch())
    migrate_to("9999", "9998")
    assert status(0) == 503
    refused: ServerProcess = servers.launch()
    refused.wait_for("requires a release with schema 9998 or newer")
    assert refused.process.wait(60) == 1
    refused.stop()

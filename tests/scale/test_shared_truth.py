"""Several servers on one database that start at once, refuse guesses together, and run beside a later schema.

What they share while they run is tested in ``tests/docker/test_scale_run.py``, on servers that start once.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

import httpx
import psycopg
import pytest

from tests.cli.conftest import ServerProcess
from tests.events.conftest import eventually
from tests.scale.conftest import Servers

pytestmark = pytest.mark.postgres


@pytest.fixture
def three(empty_servers: Callable[..., Servers]) -> Servers:
    """Three servers without Zenoh."""
    servers = empty_servers(zenoh=False)
    servers.start(3)
    return servers


def test_ten_first_starts_at_once_make_one_administrator(empty_servers: Callable[..., Servers]) -> None:
    servers = empty_servers(zenoh=False)
    processes = [servers.launch(admin_token="") for _ in range(10)]
    try:
        addresses = [process.ready() for process in processes]
        printed = [line for process in processes for line in process.lines if "administrator's token" in line]
        assert len(printed) == 1
        token = printed[0].split()[-1]
        keys = [
            httpx.get(f"{a}/api/v1/keys", headers={"Authorization": f"Bearer {token}"}).raise_for_status().json()
            for a in addresses
        ]
        assert keys == [keys[0]] * 10
        assert len(keys[0]) == 1
    finally:
        for process in processes:
            process.stop()


def test_wrong_tokens_count_on_all_servers(empty_servers: Callable[..., Servers]) -> None:
    servers = empty_servers(zenoh=False)
    servers.start(3, token_failures="9")

    def guess(number: int) -> int:
        wrong = {"Authorization": f"Bearer guess-{os.urandom(4).hex()}"}
        return httpx.get(f"{servers.all[number].process.address}/api/v1/keys", headers=wrong).status_code

    assert [guess(n) for n in (0, 1, 2) * 3] == [401] * 9
    for number in range(3):
        eventually(lambda n=number: guess(n) == 429, 10)
    assert servers.all[0].http.get("/api/v1/keys").status_code == 200, "a valid token is always accepted"


def test_servers_serve_beside_a_newer_compatible_schema(three: Servers) -> None:
    """The next release migrates first; this one goes on, starts again, and refuses only what it cannot read."""
    servers = three

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

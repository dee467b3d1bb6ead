"""Several servers without a shared folder answer as one."""

from __future__ import annotations

import base64
import itertools
import os
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import psycopg
import pytest

from app.agent.signed_manifest import key_id, verify_signature
from app.main import close_services, open_services
from tests.agent.conftest import network
from tests.api.conftest import ADMIN, settings_for
from tests.cli.conftest import ServerProcess
from tests.events.conftest import eventually
from tests.postgres import Cluster
from tests.scale.conftest import Servers, servers_on

pytestmark = pytest.mark.postgres

FETCHES = 120
COMMITS = 20
GUESSES = 9


@pytest.fixture(scope="module")
def servers(postgres_cluster: Cluster, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Servers]:
    """Three servers without Zenoh, which the tests share; each uses its own environment."""
    with servers_on(postgres_cluster, tmp_path_factory.mktemp("servers"), zenoh=False) as three:
        three.start(3, token_failures=str(GUESSES))
        yield three


def create(servers: Servers, name: str) -> None:
    servers.call(servers.all[0], "POST", "environments", json={"name": name})
    upload(servers, name, 0.0)


def upload(servers: Servers, name: str, moved: float) -> None:
    files = {"files": ("n.tmap2.yaml", network(moved, 60))}
    servers.call(servers.all[0], "POST", f"environments/{name}/versions", files=files)


def test_pinned_robot_accepts_all_servers_across_key_rotations(servers: Servers) -> None:
    create(servers, "pinned")
    turn = itertools.cycle(servers.all)
    listed = servers.call(servers.all[0], "GET", "keys")
    pinned = base64.b64decode(listed[0]["public_key"])
    signers = []
    for n in range(FETCHES):
        if n % 40 == 20:
            servers.call(servers.all[n // 40], "POST", "keys", json={})
        answer = next(turn).http.get("/api/v1/environments/pinned/versions/latest/manifest?formats=tmap2")
        assert answer.status_code == 200, answer.text
        signature = answer.headers["Fleetmap-Signature"]
        pinned = verify_signature(
            answer.content, signature, pinned, None, lambda: servers.call(next(turn), "GET", "keys")
        )
        signers.append(key_id(pinned))
    assert len(set(signers)) == 4
    assert len(list(itertools.groupby(signers))) == 4, "no server signs with an older key afterwards"
    assert [servers.call(server, "GET", "keys") for server in servers.all] == [
        servers.call(servers.all[0], "GET", "keys")
    ] * 3


def test_signed_link_of_one_server_is_valid_on_all(servers: Servers) -> None:
    create(servers, "linked")
    body = {"format": "tmap2"}
    link = servers.call(servers.all[1], "POST", "environments/linked/versions/1/links", json=body)
    path = httpx.URL(link["url"]).raw_path.decode()
    maps = {httpx.get(f"{server.process.address}{path}").raise_for_status().content for server in servers.all}
    assert len(maps) == 1


def test_commit_is_read_on_another_server_soon(servers: Servers, capsys: pytest.CaptureFixture[str]) -> None:
    """The answer is cached in memory there for a second, unless a notification comes."""
    create(servers, "changed")
    address, etags, delays = "/maps/changed/tmap2", [], []
    for n in range(1, COMMITS):
        before = servers.all[1].http.get(address).headers["etag"]
        upload(servers, "changed", n / 10)
        start = time.monotonic()
        while servers.all[1].http.head(address).headers["etag"] == before:
            assert time.monotonic() - start < 10
        delays.append(time.monotonic() - start)
        etags.append(before)
    assert len(set(etags)) == len(etags)
    delays.sort()
    with capsys.disabled():
        print(f"\ncommit read on another server: median {delays[len(delays) // 2]:.3f} s, worst {delays[-1]:.3f} s")
    assert delays[len(delays) // 2] < 0.5


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


def test_session_of_one_server_is_valid_on_all(servers: Servers) -> None:
    clients = [httpx.Client(base_url=server.process.address) for server in servers.all]
    clients[0].post("/api/v1/session", json={"token": ADMIN}).raise_for_status()
    secret = clients[0].cookies["fleetmap_session"]
    for client in clients:
        client.cookies.set("fleetmap_session", secret)
        assert client.get("/api/v1/session").status_code == 200
    clients[1].delete("/api/v1/session", headers={"Origin": servers.all[1].process.address}).raise_for_status()
    eventually(lambda: clients[2].get("/api/v1/session").status_code == 401)
    for client in clients:
        client.close()


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

"""Several servers without a shared folder answer as one."""

from __future__ import annotations

import base64
import itertools
import os
import time
from collections.abc import Callable
from typing import Any

import httpx
import psycopg
import pytest

from app.agent.signatures import key_id, verify_signature
from tests.agent.conftest import network
from tests.api.conftest import ADMIN
from tests.cli.conftest import ServerProcess
from tests.events.conftest import eventually
from tests.scale.conftest import Servers

pytestmark = pytest.mark.postgres

FETCHES = 300
COMMITS = 200


@pytest.fixture
def three(empty_servers: Callable[..., Servers]) -> Servers:
    """Three servers without Zenoh."""
    servers = empty_servers(zenoh=False)
    servers.start(3)
    return servers


def upload(servers: Servers, number: int, moved: float) -> None:
    files = {"files": ("n.tmap2.yaml", network(moved, 60))}
    servers.call(servers.all[number], "POST", "environments/farm/versions", files=files)


def test_pinned_robot_accepts_all_servers_across_key_rotations(three: Servers) -> None:
    servers = three
    servers.call(servers.all[0], "POST", "environments", json={"name": "farm"})
    upload(servers, 0, 0.0)
    turn = itertools.cycle(servers.all)
    listed = servers.call(servers.all[0], "GET", "keys")
    pinned = base64.b64decode(listed[0]["public_key"])
    signers = []
    for n in range(FETCHES):
        if n % 100 == 50:
            servers.call(servers.all[n // 100], "POST", "keys", json={})
        answer = next(turn).http.get("/api/v1/environments/farm/versions/latest/manifest?formats=tmap2")
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


def test_signed_link_of_one_server_is_valid_on_all(three: Servers) -> None:
    servers = three
    servers.call(servers.all[0], "POST", "environments", json={"name": "farm"})
    upload(servers, 0, 0.0)
    body = {"format": "tmap2"}
    link = servers.call(servers.all[1], "POST", "environments/farm/versions/1/links", json=body)
    path = httpx.URL(link["url"]).raw_path.decode()
    maps = {httpx.get(f"{server.process.address}{path}").raise_for_status().content for server in servers.all}
    assert len(maps) == 1


def test_commit_is_read_on_another_server_soon(three: Servers, capsys: pytest.CaptureFixture[str]) -> None:
    """The answer is cached in memory there for a second, unless a notification comes."""
    servers = three
    servers.call(servers.all[0], "POST", "environments", json={"name": "farm"})
    upload(servers, 0, 0.0)
    address, etags, delays = "/maps/farm/tmap2", [], []
    for n in range(1, COMMITS // 10):
        before = servers.all[1].http.get(address).headers["etag"]
        upload(servers, 0, n / 10)
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


def test_session_of_one_server_is_valid_on_all(three: Servers) -> None:
    servers = three
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

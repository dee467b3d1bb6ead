"""All services of compose.scale.yaml as processes, with the exact commands, environment and files of the file.

Real Caddy, SeaweedFS, PostgreSQL and Zenoh routers. All starts once for this module; the last tests stop servers.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import itertools
import json
import signal
import stat
from collections.abc import Iterator

import httpx
import psycopg
import pytest

from tests.docker.scale_site import (
    SERVERS,
    WORKERS,
    Load,
    ReadinessWatch,
    Site,
    fetch_round_robin,
    read_delays,
    running_site,
)
from tests.docker.schema_upgrade import upgrade_to_later_revision
from tests.events.conftest import Listener, eventually
from tests.postgres import Cluster

pytestmark = [pytest.mark.postgres, pytest.mark.timeout(600)]

FETCHES = 24
COMMITS = 9
CAVE = {"generator": "cave", "parameters": {"width": 8.0, "depth": 8.0}, "replace": True}


@pytest.fixture(scope="module")
def site(postgres_cluster: Cluster, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    name = postgres_cluster.create_database()
    with running_site(tmp_path_factory.mktemp("scale"), postgres_cluster.url(name)) as site:
        yield site
    postgres_cluster.drop_database(name)


def create(site: Site, name: str) -> None:
    site.call(site.https, "POST", "environments", json={"name": name})


def test_proxy_serves_https_and_names_the_client(site: Site) -> None:
    forged = {"X-Forwarded-For": "203.0.113.9", "X-Forwarded-Proto": "http"}
    site.call(site.https, "POST", "environments", json={"name": "links"}, headers=forged)
    entries = site.call(site.https, "GET", "audit?environment=links")
    assert [entry["address"] for entry in entries] == ["127.0.0.1"]
    document = site.https.get("/ogc/links/").json()
    assert {httpx.URL(link["href"]).scheme for link in document["links"]} == {"https"}
    assert site.https.get("/api/v1/keys", headers={"Authorization": "Bearer wrong"}).status_code == 401
    with pytest.raises(httpx.ConnectError, match="CERTIFICATE_VERIFY_FAILED"):
        httpx.get(site.https.base_url, timeout=60)


def test_map_of_an_upload_is_the_same_on_all_servers(site: Site) -> None:
    create(site, "farm")
    before = sum(site.conversions().values())
    site.upload(site.https, "farm", 0.0)
    answers = [client.get("/maps/farm/tmap2") for client in (site.https, *site.servers.values())]
    assert {answer.status_code for answer in answers} == {200}
    assert len({(answer.content, answer.headers["etag"]) for answer in answers}) == 1
    assert sum(site.conversions().values()) == before + 1


def test_job_of_one_server_is_done_by_a_worker_and_fetched_from_all(site: Site) -> None:
    create(site, "cave")
    a, b, c = site.servers.values()
    started = a.post("/api/v1/environments/cave/generations", json=CAVE, headers={"Prefer": "respond-async"})
    assert started.status_code == 202, started.text
    job = f"jobs/{started.json()['id']}"
    state = eventually(lambda: (job_of_b := site.call(b, "GET", job))["state"] in ("done", "failed") and job_of_b)
    assert state["state"] == "done", state
    assert [site.call(client, "GET", job)["result"] for client in (a, c, site.https)] == [state["result"]] * 3
    assert state["result"]["location"] == "/api/v1/environments/cave/versions/1"
    before = site.conversions()
    octomaps = [client.get("/api/v1/environments/cave/versions/1/maps/octomap") for client in (b, a, c, site.https)]
    assert len({(answer.content, answer.headers["etag"]) for answer in octomaps}) == 1
    new = {name: count - before[name] for name, count in site.conversions().items()}
    assert {new[name] for name in SERVERS} == {0}
    assert sum(new[name] for name in WORKERS) == 1, "a worker made it, once"


def test_pinned_robot_accepts_all_servers_across_a_key_rotation(site: Site) -> None:
    create(site, "pinned")
    site.upload(site.https, "pinned", 0.0)
    before = sum(site.conversions().values())
    fetches = fetch_round_robin(site, "pinned", FETCHES, rotate_at=[FETCHES // 2])
    assert fetches.refusals == []
    assert fetches.count == FETCHES
    assert len(list(itertools.groupby(fetches.signers))) == 2, "no server signs with the older key afterwards"
    assert len(fetches.recipes) == 2
    assert sum(site.conversions().values()) == before + len(fetches.recipes)


def test_commit_on_one_server_is_read_on_another_soon(site: Site, capsys: pytest.CaptureFixture[str]) -> None:
    """The other one keeps its answer in memory for a second, unless it is notified."""
    create(site, "commits")
    site.upload(site.https, "commits", 0.0)
    delays = read_delays(site, "commits", COMMITS)
    with capsys.disabled():
        print(f"\ncommit read on another server: {', '.join(f'{delay:.3f}' for delay in delays)} s")
    assert delays[COMMITS // 2] < 0.5


def test_signed_link_and_session_of_one_server_are_valid_on_all(site: Site) -> None:
    create(site, "guests")
    site.upload(site.https, "guests", 0.0)
    a, b, c = site.servers.values()
    link = site.call(a, "POST", "environments/guests/versions/1/links", json={"format": "tmap2"})
    path = httpx.URL(link["url"]).raw_path.decode()
    assert len({httpx.get(client.base_url.join(path)).raise_for_status().content for client in (a, b, c)}) == 1

    token = site.containers[SERVERS[0]].secret("fleetmap_admin_token")
    started = httpx.post(a.base_url.join("/api/v1/session"), json={"token": token}).raise_for_status()
    cookies = {"fleetmap_session": started.cookies["fleetmap_session"]}
    sessions = [httpx.Client(base_url=client.base_url, cookies=cookies) for client in (a, b, c)]
    assert {session.get("/api/v1/session").status_code for session in sessions} == {200}
    sessions[1].delete("/api/v1/session", headers={"Origin": str(b.base_url)}).raise_for_status()
    eventually(lambda: sessions[2].get("/api/v1/session").status_code == 401)
    for session in sessions:
        session.close()


def test_all_servers_send_deltas(site: Site) -> None:
    create(site, "deltas")
    site.upload(site.https, "deltas", 0.0)
    old = site.https.get("/maps/deltas/tmap2").content
    site.upload(site.https, "deltas", 0.25)
    digest = base64.b64encode(hashlib.sha256(old).digest()).decode()
    headers = {"Accept-Encoding": "dcz", "Available-Dictionary": f":{digest}:"}
    sizes = []
    for client in (*site.servers.values(), site.https):
        with client.stream("GET", "/maps/deltas/tmap2", headers=headers) as answer:
            assert answer.headers["content-encoding"] == "dcz"
            sizes.append(len(b"".join(answer.iter_raw())))
    assert len(set(sizes)) == 1
    assert sizes[0] < len(old) / 10


def test_event_reaches_a_robot_through_the_other_router(site: Site) -> None:
    """All servers are connected to the first router that they name."""
    create(site, "yard")
    with site.robot_session("router-2") as robot:
        listener = Listener(robot, "fleetmap/yard/events")
        site.upload(site.https, "yard", 0.0)
        listener.wait(lambda e: e.sequences() == [1, 2])
        with site.https.stream("GET", "/api/v1/events", params={"environment": "yard", "since": 0}) as stream:
            lines = stream.iter_lines()  # the proxy passes each on at once: the stream does not end
            assert next(json.loads(line[5:])["sequence"] for line in lines if line.startswith("data:")) == 1
        robot.put("fleetmap/yard/events", b'{"sequence": 3}')  # of another robot's: the routers drop it
        with site.robot_session("router-1") as other:
            late = Listener(other, "fleetmap/yard/events")
            late.wait(lambda e: sorted(e.sequences()) == [1, 2])
            site.upload(site.https, "yard", 0.5)
            late.wait(lambda e: sorted(e.sequences()) == [1, 2, 3])
            assert [event["type"] for event in late.events if event["sequence"] == 3] == ["version.created"]


def test_events_go_on_when_a_router_stops_and_comes_back(site: Site) -> None:
    create(site, "mesh")
    with site.robot_session("router-2") as robot:
        listener = Listener(robot, "fleetmap/mesh/events")
        listener.wait(lambda e: e.sequences() == [1])
        site.routers["router-1"].close()
        site.upload(site.https, "mesh", 0.0)
        listener.wait(lambda e: e.sequences() == [1, 2])
        eventually(lambda: all(site.is_connected(name) for name in SERVERS))
        site.start_router("router-1")
        with site.robot_session("router-1") as other:

            def join() -> Listener | None:
                """Join late; None while the routers have not joined again, since history is asked for once."""
                listener = Listener(other, "fleetmap/mesh/events")
                with contextlib.suppress(AssertionError):
                    listener.wait(lambda e: sorted(e.sequences()) == [1, 2], seconds=5.0)
                    return listener
                return None

            late: Listener = eventually(join)
            site.upload(site.https, "mesh", 0.5)
            late.wait(lambda e: sorted(e.sequences()) == [1, 2, 3])


def test_all_recover_when_the_database_is_restarted(site: Site, postgres_cluster: Cluster) -> None:
    create(site, "restart")
    a, b, _ = site.servers.values()
    postgres_cluster.kill()
    assert eventually(lambda: (answer := a.get("/readyz")).status_code == 503 and answer).headers["retry-after"]
    assert b.get("/api/v1/environments/restart").status_code == 503
    postgres_cluster.restart()
    for name in (*SERVERS, *WORKERS):
        site.wait_ready(name)
    site.upload(site.https, "restart", 0.0)
    site.leader()
    with psycopg.connect(site.compose.database_url.replace("+psycopg", ""), autocommit=True) as connection:
        listening = (
            "SELECT count(*) FROM pg_stat_activity WHERE datname = current_database() AND query ILIKE 'LISTEN%'"
            " AND application_name = 'fleetmap worker'"
        )
        eventually(lambda: connection.execute(listening).fetchone() == (len(WORKERS),))


def test_services_share_no_folder_and_log_no_secret(site: Site) -> None:
    for name in SERVERS:
        folder = site.containers[name].folder / "data"
        assert not list(folder.glob("*.sqlite3")), "everything is in PostgreSQL"
        assert not (folder / "keys").exists() or not list((folder / "keys").iterdir())
    assert stat.S_IMODE(site.compose.secrets.stat().st_mode) == 0o700
    secrets = [path for path in site.compose.secrets.iterdir() if path.suffix not in (".pem", ".json", ".json5")]
    for path in secrets:
        for secret in (line for line in path.read_text().splitlines() if len(line) > 15 and not line.startswith("#")):
            for container in site.containers.values():
                if (container.folder / "log").exists():
                    assert secret not in container.log, f"{container.name} logs {path.name}"


def test_servers_go_on_while_a_later_release_migrates_and_one_is_replaced(site: Site) -> None:
    create(site, "upgrade")
    site.upload(site.https, "upgrade", 0.0)
    load, watch = Load(site, "upgrade"), ReadinessWatch(site, SERVERS)
    try:
        load.wait_for_more()
        upgrade_to_later_revision(site.compose.database_url)
        load.wait_for_more()
        watch.names.discard("server-2")
        assert site.containers["server-2"].stop(signal.SIGTERM) == 0
        load.wait_for_more()
        site.containers["server-2"].start()
        site.wait_ready("server-2")
        watch.names.add("server-2")
        load.wait_for_more()
    finally:
        load.stop()
        watch.stop()
    assert load.failures == []
    assert watch.unready == []
    assert watch.polls > 10


def test_no_request_fails_when_the_leader_is_killed(site: Site) -> None:
    create(site, "kill")
    site.upload(site.https, "kill", 0.0)
    leader = site.leader()
    load = Load(site, "kill")
    with site.robot_session("router-2") as robot:
        listener = Listener(robot, "fleetmap/kill/events")
        listener.wait(lambda e: len(e.sequences()) >= 2)
        try:
            load.wait_for_more()
            site.containers[leader].stop(signal.SIGKILL)
            load.wait_for_more()
        finally:
            load.stop()
        rest = [name for name in SERVERS if name != leader]
        assert site.leader(rest) in rest
        last = site.call(site.https, "GET", "environments/kill/versions/latest")["version"]
        listener.wait(lambda e: e.sequences() == list(range(1, last + 2)))  # the first one is of the environment
    assert load.failures == []


def test_log_of_servers_has_no_internal_error(site: Site) -> None:
    for name in (*SERVERS, *WORKERS):
        assert "Traceback" not in site.containers[name].log, f"{name}:\n{site.containers[name].log[-5000:]}"

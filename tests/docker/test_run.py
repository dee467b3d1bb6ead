"""Services of compose.yaml as processes, with the exact commands, environment and files of the file.

Real Caddy, PostgreSQL and Zenoh router; all start once for this module. The last test stops the server.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
import zenoh

from app.config import Settings
from tests.cli.conftest import Fleetmap
from tests.docker.containers import Compose, Container, image, instructions
from tests.docker.site import ROBOT, Site
from tests.events.conftest import Listener, eventually
from tests.postgres import Cluster

VARIABLES = {"COMPOSE_PROFILES": "postgres"}


class PostgresSite(Site):
    """Services of compose.yaml with the profile postgres."""

    FILE = "compose.yaml"
    VARIABLES = VARIABLES
    SERVERS, ROUTERS, OTHERS = ("server",), ("router",), ("proxy", "migrate")

    def variables(self) -> dict[str, str]:
        """Variables of a client or robot at the proxy."""
        ca = str(self.compose.secrets / "ca.pem")
        return {"FLEETMAP_SERVER": str(self.https.base_url), "FLEETMAP_TOKEN": self.token, "FLEETMAP_CA": ca}


@pytest.fixture(scope="module")
def site(postgres_cluster: Cluster, tmp_path_factory: pytest.TempPathFactory) -> Iterator[PostgresSite]:
    name = postgres_cluster.create_database()
    site = PostgresSite(tmp_path_factory.mktemp("site"), postgres_cluster.url(name))
    server = site.containers["server"]
    assert server.run(server.healthcheck).returncode != 0
    try:
        site.start()
        yield site
    finally:
        site.close()
        postgres_cluster.drop_database(name)


@pytest.mark.postgres
def test_image_serves_maps_from_postgis_over_https(
    site: PostgresSite, offline: Fleetmap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = site.containers["server"]
    eventually(lambda: server.run(server.healthcheck).returncode == 0)  # its database may answer late for a moment
    assert site.https.get("/readyz").status_code == 200
    assert site.https.get("/api/v1/environments", headers={"Authorization": ""}).status_code == 401
    with pytest.raises(httpx.ConnectError, match="CERTIFICATE_VERIFY_FAILED"):
        httpx.get(site.https.base_url, timeout=60)

    for name, value in site.variables().items():
        monkeypatch.setenv(name, value)
    result = offline("demo", "--json")
    assert result.status == 0, result.err
    out = tmp_path / "map.yaml"
    assert offline("export", "orchard", "tmap2", "-o", out).status == 0
    assert "Dock" in out.read_text()
    moved = out.with_suffix(".tmap2.yaml")
    moved.write_text(out.read_text().replace("xy_goal_tolerance: 0.3", "xy_goal_tolerance: 0.4"))
    assert offline("import", moved, "-e", "copy").status == 0
    entries = site.call(site.https, "GET", "audit?environment=copy", headers={"X-Forwarded-For": "203.0.113.9"})
    assert {entry["address"] for entry in entries} == {"127.0.0.1"}, "the proxy names the client"


@pytest.mark.postgres
def test_robot_of_the_compose_file_syncs_with_tls_and_user(site: PostgresSite, tmp_path: Path) -> None:
    site.call(site.https, "POST", "environments", json={"name": "farm"})
    site.upload(site.https, "farm", 0.0)
    token = site.call(site.https, "POST", "tokens", json={"name": ROBOT, "role": "robot"})["token"]
    variables = {
        "FLEETMAP_SERVER": str(site.https.base_url),
        "FLEETMAP_TOKEN": token,
        "FLEETMAP_ROBOT": ROBOT,
        "FLEETMAP_ZENOH_PASSWORD": site.robot_password,
        "ENVIRONMENT": "farm",
        "FORMATS": "tmap2",
    }
    compose = Compose("robot.compose.yaml", tmp_path, "", variables=variables, secrets=site.compose.secrets)
    agent = Container(compose, "agent")
    with agent.running():
        maps = agent.folder / "var/lib/fleetmap/maps/current/tmap2/network.tmap2.yaml"
        eventually(lambda: maps.is_file() or agent.process.poll() is not None)
        assert maps.is_file(), agent.log
        state = eventually(lambda: next((r for r in site.call(site.https, "GET", "robots") if r["online"]), None))
        assert (state["robot"], state["version"]) == (ROBOT, 1), "its presence is announced over Zenoh"
        before = maps.read_text()
        site.upload(site.https, "farm", 0.5)  # an event: the next poll is a minute away
        eventually(lambda: maps.read_text() != before, 30)
    assert "Traceback" not in agent.log


@pytest.mark.postgres
def test_router_rejects_clients_without_its_users(site: PostgresSite) -> None:
    site.call(site.https, "POST", "environments", json={"name": "yard"})
    with site.robot_session("router") as robot, site.robot_session("router") as other:
        listener = Listener(other, "fleetmap/yard/events")
        listener.wait(lambda events: events.sequences() == [1])
        robot.put("fleetmap/yard/events", b'{"sequence": 3}')  # the router drops it
        site.upload(site.https, "yard", 0.0)
        listener.wait(lambda events: events.sequences() == [1, 2])
    with pytest.raises(zenoh.ZError):
        site.robot_session("router", password="guessed")


@pytest.mark.postgres
def test_migrations_may_be_repeated(site: PostgresSite) -> None:
    migrate = site.containers["migrate"]
    assert (done := migrate.run(migrate.command)).returncode == 0, done.stderr


@pytest.mark.postgres
def test_database_accepts_its_command(site: PostgresSite, postgres_cluster: Cluster) -> None:
    """PostgreSQL reads its settings and stops; the tests' cluster was created with POSTGRES_INITDB_ARGS."""
    for file in ("compose.yaml", "compose.scale.yaml"):
        compose = Compose(file, site.compose.folder, "", variables=VARIABLES, secrets=site.compose.secrets)
        program, *options = compose.services["database"]["command"]
        command = [str(postgres_cluster.bin / program), "-D", str(postgres_cluster.data), *options]
        done = postgres_cluster.run(*command, "-C", "max_connections")
        assert done.returncode == 0, done.stderr
        assert f"max_connections={done.stdout.strip()}" in options
    with postgres_cluster.connect() as connection:
        assert connection.execute("SHOW data_checksums").fetchone() == ("on",)
        collation = connection.execute("SELECT datcollate FROM pg_database WHERE datname = 'postgres'").fetchone()
        assert collation == ("C.UTF-8",)


def test_sqlite_service_has_no_database_and_the_same_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compose = Compose("compose.yaml", tmp_path, "", "--sqlite", variables={"COMPOSE_PROFILES": "sqlite"})
    assert not (compose.secrets / "fleetmap_database_url").exists()
    services = compose.services
    differing = {"profiles", "secrets", "volumes", "networks", "depends_on"}
    assert {k: v for k, v in services["server"].items() if k not in differing} == {
        k: v for k, v in services["server-sqlite"].items() if k not in differing
    }
    container = Container(compose, "server-sqlite")
    for name in [name for name in os.environ if name.startswith("FLEETMAP_")]:
        monkeypatch.delenv(name)
    for name, value in container.environment.items():
        if name.startswith("FLEETMAP_"):
            monkeypatch.setenv(name, value)
    settings = Settings(_env_file=None, _secrets_dir=container.environment["FLEETMAP_SECRETS_DIR"])
    assert settings.database_url is None
    assert settings.zenoh_password is not None
    assert settings.admin_token is not None


def test_prometheus_accepts_its_command(tmp_path: Path) -> None:
    """With a configuration of the test: that of ``docker/monitoring`` takes half a minute to scrape."""
    if shutil.which("prometheus") is None:
        (pytest.fail if os.environ.get("CI") else pytest.skip)("prometheus is not installed (Debian: prometheus)")
    (tmp_path / "secrets").mkdir()
    (tmp_path / "secrets" / "metrics_token").write_text("-\n")
    compose = Compose("compose.yaml", tmp_path, "", variables=VARIABLES, secrets=tmp_path / "secrets")
    prometheus = Container(compose, "prometheus")
    configuration = prometheus.folder / "etc" / "prometheus" / "prometheus.yml"
    configuration.parent.mkdir(parents=True, exist_ok=True)
    configuration.write_text("scrape_configs: []\n")
    with prometheus.running():
        ready = f"http://{compose.address('prometheus')}/-/ready"
        eventually(lambda: is_ready(ready) or prometheus.process.poll() is not None)
        assert is_ready(ready), prometheus.log


def is_ready(url: str) -> bool:
    """Whether an address returns 200."""
    try:
        return httpx.get(url, timeout=60).status_code == 200
    except httpx.TransportError:
        return False


def test_image_needs_no_shell() -> None:
    configuration = image()
    for name in ("entrypoint", "cmd", "healthcheck"):
        assert isinstance(configuration[name], list), f"{name} must be in exec form"
        assert configuration[name][0] not in ("sh", "bash", "/bin/sh")


def test_image_writes_only_to_its_volume() -> None:
    configuration = image()
    folder = Path(configuration["env"]["FLEETMAP_DATA_DIR"])
    settings = Settings(data_dir=folder, _env_file=None)
    volumes = [Path(v) for word, argument in instructions() if word == "VOLUME" for v in json.loads(argument)]
    for path in (settings.blob_dir, settings.cache_dir, settings.spool_dir):
        assert any(path.is_relative_to(volume) for volume in volumes), path


@pytest.mark.postgres
def test_server_stops_cleanly_and_logs_no_secret(site: PostgresSite) -> None:
    server = site.containers["server"]
    assert server.stop(signal.SIGTERM) == 0, server.log
    assert "Traceback" not in server.log
    for name in ("fleetmap_admin_token", "fleetmap_zenoh_password", "database_password"):
        secret = (site.compose.secrets / name).read_text().strip()
        assert all(secret not in site.containers[one].log for one in ("server", "proxy")), name
    assert not list((server.folder / "data").glob("*.sqlite3")), "everything is in PostgreSQL"

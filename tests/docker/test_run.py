"""Run the server as the image's entry point and environment and the compose file start it, on a real PostgreSQL."""

from __future__ import annotations

import json
import signal
import time
import urllib.error
import urllib.request
from pathlib import Path

import pytest

from app.cli.server import wait_ready
from tests.cli.conftest import Fleetmap
from tests.docker.containers import Compose, Container, image, instructions


@pytest.fixture
def containers(tmp_path_factory: pytest.TempPathFactory, postgres_url: str) -> tuple[Container, Container]:
    """Migrate service and server, with a new database, in a folder with a short path: a socket lies in its /tmp."""
    compose = Compose("compose.yaml", tmp_path_factory.mktemp("site"), postgres_url)
    return Container(compose, "migrate"), Container(compose, "server")


@pytest.mark.postgres
def test_image_serves_maps_from_postgis(
    containers: tuple[Container, Container], offline: Fleetmap, tmp_path: Path
) -> None:
    migrate, server = containers
    address = f"http://127.0.0.1:{server.environment['FLEETMAP_PORT']}"
    token = server.secret("fleetmap_admin_token")

    for _ in range(2):  # compose runs it on every start
        done = migrate.run(migrate.command)
        assert done.returncode == 0, done.stderr

    assert server.run(server.healthcheck).returncode != 0
    process = server.start()
    try:
        wait_ready(address)
        assert server.run(server.healthcheck).returncode == 0
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(f"{address}/api/v1/environments", timeout=60)
        refused.value.close()
        assert refused.value.code == 401

        access = ["--server", address, "--token", token]
        result = offline("demo", "--json", *access)
        assert result.status == 0, result.err
        out = tmp_path / "map.yaml"
        assert offline("export", "orchard", "tmap2", "-o", out, *access).status == 0
        assert "Dock" in out.read_text()
        moved = out.with_suffix(".tmap2.yaml")
        moved.write_text(out.read_text().replace("xy_goal_tolerance: 0.3", "xy_goal_tolerance: 0.4"))
        assert offline("import", moved, "-e", "copy", *access).status == 0
        with urllib.request.urlopen(f"{address}/readyz", timeout=60) as ready:
            assert ready.status == 200
    finally:
        began = time.monotonic()
        process.send_signal(signal.SIGTERM)
        status = process.wait(30)
        took = time.monotonic() - began
    log = server.log
    assert status == 0, log
    assert took < 20
    assert token not in log, "the log contains a secret"
    assert "Traceback" not in log
    assert (server.folder / "data").is_dir()
    assert not list((server.folder / "data").glob("*.sqlite3")), "everything is in PostgreSQL"


def test_image_needs_no_shell() -> None:
    configuration = image()
    for name in ("entrypoint", "cmd", "healthcheck"):
        assert isinstance(configuration[name], list), f"{name} must be in exec form"
        assert configuration[name][0] not in ("sh", "bash", "/bin/sh")


def test_image_writes_only_to_its_volume() -> None:
    from app.config import Settings

    configuration = image()
    folder = Path(configuration["env"]["FLEETMAP_DATA_DIR"])
    settings = Settings(data_dir=folder, _env_file=None)
    volumes = [Path(v) for word, argument in instructions() if word == "VOLUME" for v in json.loads(argument)]
    for path in (settings.blob_dir, settings.cache_dir, settings.spool_dir):
        assert any(path.is_relative_to(volume) for volume in volumes), path

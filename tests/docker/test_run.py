"""Run the server as the image's entry point and environment and the compose file start it.

Needs no container engine: the tests read the Dockerfile and compose.yaml, map their paths and the database's address to
this machine, and run the commands against a real PostgreSQL with PostGIS.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from pathlib import Path
from typing import Any

import pytest
import yaml

from app.cli.server import wait_ready
from tests.cli.conftest import Fleetmap

TOP = Path(__file__).resolve().parents[2]


def instructions() -> list[tuple[str, str]]:
    """Parse the Dockerfile's last stage into (instruction, argument), with continued lines joined."""
    text = (TOP / "docker" / "Dockerfile").read_text()
    text = re.sub(r"^\s*#.*\n", "", text, flags=re.MULTILINE)
    lines = [line.strip() for line in re.sub(r"\\\n", " ", text).splitlines() if line.strip()]
    pairs = [(line.split(None, 1)[0], line.split(None, 1)[1]) for line in lines]
    start = max(k for k, (word, _) in enumerate(pairs) if word == "FROM")
    return pairs[start:]


def image() -> dict[str, Any]:
    """Read the image's environment, entry point, command and health check."""
    configuration: dict[str, Any] = {"env": {}}
    for word, argument in instructions():
        if word == "ENV":
            configuration["env"].update(re.findall(r"(\w+)=(\S+)", argument))
        elif word in ("ENTRYPOINT", "CMD", "WORKDIR"):
            configuration[word.lower()] = json.loads(argument) if argument.startswith("[") else argument
        elif word == "HEALTHCHECK":
            configuration["healthcheck"] = json.loads(argument[argument.index("CMD") + 3 :])
    return configuration


class Container:
    """Service of the compose file on this machine, with environment and paths mapped below one folder."""

    def __init__(self, name: str, folder: Path, database_url: str) -> None:
        compose = yaml.safe_load((TOP / "docker" / "compose.yaml").read_text())
        service, configuration = compose["services"][name], image()
        self.folder = folder
        environment = {**configuration["env"], **service.get("environment", {})}
        defaulted = {k: re.sub(r"\$\{\w+:-(.*?)\}", r"\1", str(v)) for k, v in environment.items()}
        self.environment = {k: self._mapped(v) for k, v in defaulted.items()}
        self.environment["PATH"] = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
        # Share compiled code: bytecode is compiled when the image is built, native code at an earlier start.
        compiled = {k: os.environ[k] for k in ("PYTHONPYCACHEPREFIX", "NUMBA_CACHE_DIR") if k in os.environ}
        self.environment |= compiled
        if "PYTHONPYCACHEPREFIX" in compiled:
            self.environment.pop("PYTHONDONTWRITEBYTECODE", None)
        self.command = [*configuration["entrypoint"], *(service.get("command") or configuration["cmd"])]
        self.healthcheck = configuration["healthcheck"]
        self.workdir = self._mapped(configuration["workdir"])
        secrets = folder / "run" / "secrets"
        if not secrets.exists():
            subprocess.run(
                [sys.executable, TOP / "docker" / "make_secrets.py", secrets], check=True, capture_output=True
            )
            (secrets / "fleetmap_database_url").chmod(0o644)
            (secrets / "fleetmap_database_url").write_text(database_url + "\n")
            for path in secrets.iterdir():
                if path.name not in service["secrets"]:
                    path.unlink()
        Path(self.workdir).mkdir(parents=True, exist_ok=True)

    def _mapped(self, value: str) -> str:
        return re.sub(r"^/(data|run/secrets)\b", lambda m: f"{self.folder}/{m[1]}", value)

    def secret(self, name: str) -> str:
        return (self.folder / "run" / "secrets" / name).read_text().strip()

    def run(self, command: list[str], *, seconds: float = 120.0) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [self.program(command), *command[1:]],
            env=self.environment,
            cwd=self.workdir,
            capture_output=True,
            text=True,
            timeout=seconds,
            check=False,
        )

    def start(self) -> subprocess.Popen[bytes]:
        log = (self.folder / "log").open("wb")
        with log:
            return subprocess.Popen(
                [self.program(self.command), *self.command[1:]],
                env=self.environment,
                cwd=self.workdir,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )

    def program(self, command: list[str]) -> str:
        program_path = shutil.which(command[0], path=self.environment["PATH"])
        assert program_path, f"{command[0]} is not in the image's PATH"
        return program_path


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port: int = taken.getsockname()[1]
        return port


@pytest.fixture
def containers(tmp_path: Path, postgres_url: str) -> tuple[Container, Container]:
    """Migrate service and server, with a new database."""
    migrate, server = (Container(name, tmp_path, postgres_url) for name in ("migrate", "server"))
    server.environment["FLEETMAP_PORT"] = str(free_port())
    return migrate, server


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
    log = (tmp_path / "log").read_text()
    assert status == 0, log
    assert took < 20
    assert token not in log, "the log contains a secret"
    assert "Traceback" not in log
    assert (tmp_path / "data").is_dir()
    assert not list((tmp_path / "data").glob("*.sqlite3")), "everything is in PostgreSQL"


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

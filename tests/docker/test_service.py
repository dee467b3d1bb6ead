"""The systemd units: checked by systemd if it is there, and run as processes after the commands of the docs.

``sudo``, ``useradd``, ``systemctl`` and the bundle's installer are scripts of the tests; paths are below a folder.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import httpx
import pytest

from app.events.credentials import ca_ssl_context
from tests.agent.conftest import network
from tests.docker.containers import DOCKER, TOP
from tests.events.conftest import eventually
from tests.ports import free_port
from tests.preloaded import PreloadedProcess

UNITS = ("fleetmap-server.service", "fleetmap-agent.service", "fleetmap-doctor.service")
EXPOSURE = {"fleetmap-server.service": 2.5, "fleetmap-agent.service": 5.5, "fleetmap-doctor.service": 5.5}
"""Maximum of ``systemd-analyze security``, from 0 to 10."""
SCRIPTS = {
    "sudo": 'exec "$@"',
    "useradd": 'for user; do :; done; echo "$user" >> users',
    "systemctl": '[ "$1 $2" = "enable --now" ] && [ -f "etc/systemd/system/$3.service" ]',
}


def read_unit(text: str) -> dict[str, list[str]]:
    """Return the values of each key of a unit's section ``Service``."""
    values = defaultdict(list)
    for line in text.partition("[Service]")[2].partition("[Install]")[0].splitlines():
        if line and line[0] != "#":
            key, _, value = line.partition("=")
            values[key].append(value)
    return values


class Service:
    """Unit as a process. state, credentials: folders that systemd would create."""

    def __init__(self, text: str, folder: Path, changes: dict[str, str]) -> None:
        self.unit = read_unit(text)
        state, credentials = folder / "state", folder / "credentials"
        state.mkdir(parents=True)
        credentials.mkdir()
        for one in self.unit["LoadCredential"]:
            name, _, source = one.partition(":")
            shutil.copy(source, credentials / name)
        pairs = [pair for one in self.unit["Environment"] for pair in shlex.split(one)]
        for file in self.unit["EnvironmentFile"]:
            pairs += [line for line in Path(file).read_text().splitlines() if line and line[0] != "#"]
        environment = dict(pair.replace("%d", str(credentials)).partition("=")[::2] for pair in pairs)
        own = {name: value for name, value in os.environ.items() if not name.startswith("FLEETMAP_")}
        self.environment = {**own, "PYTHONPATH": str(TOP), "STATE_DIRECTORY": str(state), **environment, **changes}
        (command,) = self.unit["ExecStart"]
        command = re.sub(r"\$\{(\w+)\}", lambda match: self.environment[match[1]], command)
        program, *self.arguments = shlex.split(command)
        assert program == "/opt/fleetmap/current/bin/fleetmap", "where install.sh puts it by default"
        self.state, self.log = state, folder / "log"

    def start(self) -> PreloadedProcess:
        """Start ExecStart with this checkout's program."""
        with self.log.open("wb") as log:
            return PreloadedProcess(self.arguments, env=self.environment, cwd=self.state, output=log)


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Root of a machine on which the commands of the docs were run; ``etc`` and ``opt`` are below it."""
    root = tmp_path_factory.mktemp("machine")
    shutil.copytree(DOCKER, root / "docker", ignore=shutil.ignore_patterns("secrets", ".env"))
    (root / "app").symlink_to(TOP / "app")
    for folder in ("bin", "etc/systemd/system", "etc/fleetmap"):
        (root / folder).mkdir(parents=True)
    for path, text in {
        **{f"bin/{name}": text for name, text in SCRIPTS.items()},
        "install.sh": 'mkdir -p "$1"',
    }.items():
        (root / path).write_text(f"#!/bin/sh\n{text}\n")
        (root / path).chmod(0o755)
    section = (TOP / "docs" / "how-to" / "deploy.md").read_text().partition("\n## On one machine with systemd\n")[2]
    block = re.findall(r"^```console\n(.*?)^```", section, re.DOTALL | re.MULTILINE)[0]
    commands = re.sub(r"^\$ ", "", block, flags=re.MULTILINE).replace("maps.example.org", "127.0.0.1")
    commands = re.sub(r" (/etc|/opt)/", rf" {root}\1/", commands)
    environment = {**os.environ, "PATH": f"{root / 'bin'}:{os.environ['PATH']}"}
    done = subprocess.run(
        ["bash", "-euc", commands], cwd=root, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == (root / "etc/fleetmap/secrets/fleetmap_admin_token").read_text().strip()
    return root


@pytest.mark.parametrize("name", UNITS)
def test_systemd_accepts_the_unit(name: str, tmp_path: Path) -> None:
    text = (DOCKER / name).read_text()
    unit = read_unit(text)
    assert len(unit["User"]) == len(unit["ExecStart"]) == 1
    assert unit["ProtectSystem"] == ["strict"]
    if shutil.which("systemd-analyze") is None:
        return
    (tmp_path / name).write_text(re.sub(r"^(ExecStart=)\S+", rf"\1{sys.executable}", text, flags=re.MULTILINE))
    verified = subprocess.run(
        ["systemd-analyze", "verify", tmp_path / name], capture_output=True, text=True, check=False
    )
    assert (verified.returncode, verified.stderr) == (0, "")
    rated = subprocess.run(
        ["systemd-analyze", "security", "--offline=yes", f"--threshold={EXPOSURE[name] * 10:.0f}", tmp_path / name],
        capture_output=True,
        text=True,
        check=False,
    )
    assert rated.returncode == 0, rated.stdout.splitlines()[-1]


def test_backup_unit_fits_the_server_unit() -> None:
    """The nightly backup runs the same program as the same user, and may write to the same data folder."""
    text = (DOCKER / "fleetmap-backup.service").read_text()
    backup, server = read_unit(text), read_unit((DOCKER / "fleetmap-server.service").read_text())
    data = f"/var/lib/{server['StateDirectory'][0]}"
    assert backup["User"] == server["User"]
    assert backup["ExecStart"][0].split()[0] == server["ExecStart"][0].split()[0]
    assert data in backup["ReadWritePaths"][0].split()
    assert f"FLEETMAP_DATA_DIR={data}\n" in text
    assert int(backup["CPUWeight"][0]) * 8 <= int(server["CPUWeight"][0])


def test_doctor_unit_has_the_settings_of_the_server_unit() -> None:
    doctor, server = (read_unit((DOCKER / f"fleetmap-{name}.service").read_text()) for name in ("doctor", "server"))
    same = ("User", "StateDirectory", "WorkingDirectory", "LoadCredential", "EnvironmentFile", "AmbientCapabilities")
    assert {key: doctor[key] for key in same} == {key: server[key] for key in same}
    assert set(server["Environment"]) == set(doctor["Environment"]) - {"FLEETMAP_CA=%d/ca.pem"}
    assert doctor["ExecStart"] == [server["ExecStart"][0].replace(" serve ", " doctor ")]


def examine(machine: Path, server: Service, changes: dict[str, str]) -> str:
    """Run the doctor's unit on the data folder of a server; returns what it prints."""
    text = (DOCKER / "fleetmap-doctor.service").read_text().replace("/etc/fleetmap/", f"{machine}/etc/fleetmap/")
    doctor = Service(text, machine / "doctor", {**changes, "STATE_DIRECTORY": str(server.state)})
    status = doctor.start().wait(120)
    printed = doctor.log.read_text()
    assert status == 0, printed
    return printed


def test_services_of_the_docs_run_with_tls_and_users(machine: Path) -> None:
    port, zenoh_port = free_port(), free_port()
    text = (machine / "etc/systemd/system/fleetmap-server.service").read_text()
    changes = {
        "FLEETMAP_HOST": "127.0.0.1",
        "FLEETMAP_PORT": str(port),
        "FLEETMAP_ZENOH_LISTEN": f"tls/127.0.0.1:{zenoh_port}",
    }
    server = Service(text.replace("/etc/fleetmap/", f"{machine}/etc/fleetmap/"), machine / "server", changes)
    assert not (machine / "etc/fleetmap/secrets/fleetmap_database_url").exists()
    assert (machine / "users").read_text() == "fleetmap-server\n"
    secrets = machine / "etc/fleetmap/secrets"
    token = (secrets / "fleetmap_admin_token").read_text().strip()
    password = re.findall(r"^tractor-7:(.+)$", (secrets / "robots").read_text(), re.MULTILINE)[0]
    process = server.start()
    https = httpx.Client(
        base_url=f"https://127.0.0.1:{port}",
        headers={"Authorization": f"Bearer {token}"},
        verify=ca_ssl_context(secrets / "ca.pem"),
        timeout=60,
    )
    try:
        eventually(lambda: is_connected(https) or process.poll() is not None, 120)
        assert process.poll() is None, server.log.read_text()
        https.post("/api/v1/environments", json={"name": "farm"}).raise_for_status()
        files = {"files": ("n.tmap2.yaml", network(0.0))}
        https.post("/api/v1/environments/farm/versions", files=files).raise_for_status()
        created = https.post("/api/v1/tokens", json={"name": "tractor-7", "role": "robot"}).json()
        run_agent(machine, https, created["token"], password)
        printed = examine(machine, server, changes)
        assert re.search("ok +http-port: a server answers", printed), printed
        assert re.search("ok +certificate-https: its chain leads to a trusted authority", printed), printed
        assert re.search("ok +zenoh-router: ", printed), printed
    finally:
        process.terminate()
        status = process.wait(60)
        https.close()
    log = server.log.read_text()
    assert status == 0, log
    assert "Traceback" not in log
    assert token not in log
    assert (server.state / "fleetmap.sqlite3").is_file()


def run_agent(machine: Path, https: httpx.Client, token: str, password: str) -> None:
    """Run the agent's unit with the variables that its comment names, until the robot is online with a map."""
    text = (DOCKER / "fleetmap-agent.service").read_text()
    ca = machine / "etc/fleetmap/secrets/ca.pem"
    variables = {
        "FLEETMAP_SERVER": str(https.base_url),
        "FLEETMAP_TOKEN": token,
        "FLEETMAP_ROBOT": "tractor-7",
        "FLEETMAP_CA": str(ca),
        "FLEETMAP_ZENOH_CA": str(ca),
        "FLEETMAP_ZENOH_PASSWORD": password,
        "ENVIRONMENT": "farm",
        "FORMATS": "tmap2",
    }
    comment = text.partition("[Unit]")[0]
    assert all(f"{name}=" in comment for name in variables)
    (machine / "etc/fleetmap/agent.env").write_text("".join(f"{name}={value}\n" for name, value in variables.items()))
    maps = machine / "agent" / "state" / "maps"
    text = text.replace("/etc/fleetmap/", f"{machine}/etc/fleetmap/").replace("/var/lib/fleetmap/maps", str(maps))
    agent = Service(text, machine / "agent", {})
    process = agent.start()
    try:
        eventually(lambda: (maps / "current/tmap2/network.tmap2.yaml").is_file() or process.poll() is not None)
        assert process.poll() is None, agent.log.read_text()
        eventually(lambda: any(robot["online"] for robot in https.get("/api/v1/robots").json()))
    finally:
        process.terminate()
        assert process.wait(60) == 0, agent.log.read_text()


def is_connected(https: httpx.Client) -> bool:
    """Whether the server is ready and connected to its router."""
    try:
        answer = https.get("/readyz")
    except httpx.TransportError:
        return False
    return answer.status_code == 200 and answer.json()["events"]["state"] == "connected"

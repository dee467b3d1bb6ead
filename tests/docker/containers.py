"""Services of the compose files as processes: the image's and the service's command, environment, files and secrets.

Needs no container engine. Names and ports of services become free loopback ports, and each service has a folder in
which its mounts lie: /data, /tmp, /run/secrets and single files.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

from tests.ports import free_port
from tests.preloaded import PreloadedProcess, run_preloaded

TOP = Path(__file__).resolve().parents[2]
DOCKER = TOP / "docker"
OWN_IMAGES = {"fleet-map-server": "Dockerfile", "fleet-map-agent": "agent.Dockerfile"}
"""Images of this project that tests run as processes, and their files."""

TRANSLATED_FILES = ("Caddyfile", "router.json5", "prometheus.yml")
"""Mounted files that name paths, ports and services."""

STORE_PORTS = ("master.port", "master.port.grpc", "volume.port", "volume.port.grpc", "filer.port", "filer.port.grpc")
"""Ports of SeaweedFS on the loopback address of its container, which all services share here."""


def instructions(file: str = "Dockerfile") -> list[tuple[str, str]]:
    """Parse a Dockerfile's last stage into (instruction, argument), with continued lines joined."""
    text = (DOCKER / file).read_text()
    text = re.sub(r"^\s*#.*\n", "", text, flags=re.MULTILINE)
    lines = [line.strip() for line in re.sub(r"\\\n", " ", text).splitlines() if line.strip()]
    pairs = [(line.split(None, 1)[0], line.split(None, 1)[1]) for line in lines]
    start = max(k for k, (word, _) in enumerate(pairs) if word == "FROM")
    return pairs[start:]


def image(file: str = "Dockerfile") -> dict[str, Any]:
    """Read an image's environment, entry point, command and health check."""
    configuration: dict[str, Any] = {"env": {}}
    for word, argument in instructions(file):
        if word == "ENV":
            configuration["env"].update(re.findall(r"(\w+)=(\S+)", argument))
        elif word in ("ENTRYPOINT", "CMD", "WORKDIR"):
            configuration[word.lower()] = json.loads(argument) if argument.startswith("[") else argument
        elif word == "HEALTHCHECK":
            configuration["healthcheck"] = json.loads(argument[argument.index("CMD") + 3 :])
    return configuration


def with_defaults(text: str, values: Mapping[str, str] | None = None) -> str:
    """Replace variables by their values, and ``${NAME:-default}`` by the default without one.

    Raises KeyError for a required variable (``${NAME}`` and ``${NAME:?message}``) without a value.
    """

    def replace(match: re.Match[str]) -> str:
        name, operator, default = match.groups()
        value = (values or {}).get(name, "")
        if value or (operator == "-" and name in (values or {})):
            return value
        if operator in (":-", "-"):
            return default
        raise KeyError(match[0])

    return re.sub(r"\$\{(\w+)(?:(:-|-|:\?)(.*?))?\}", replace, text)


class Compose:
    """Compose file whose services run below a folder, on an existing database.

    Args:
        file: name of the file in ``docker``.
        options: options of make_secrets.py.
        variables: of the operator's ``.env``.
        secrets: existing folder of secrets. Default: one that make_secrets.py creates.

    Attributes:
        ports: (service, port) -> loopback port.
    """

    def __init__(
        self,
        file: str,
        folder: Path,
        database_url: str,
        *options: str,
        variables: Mapping[str, str] | None = None,
        secrets: Path | None = None,
    ) -> None:
        described = yaml.safe_load(with_defaults((DOCKER / file).read_text(), variables))
        self.services: dict[str, dict[str, Any]] = described["services"]
        self.folder, self.database_url = folder, database_url
        self.secrets = secrets or folder / "secrets"
        if secrets is None:
            self.make_secrets(*options)
        networks = [network or {} for network in described.get("networks", {}).values()]
        self.subnets = [one["subnet"] for network in networks for one in network.get("ipam", {}).get("config", ())]
        keys = [(name, port) for name, service in self.services.items() for port in _container_ports(service)]
        self.ports = {key: free_port() for key in keys}
        self.published = {
            host: self.ports[name, port]
            for name, service in self.services.items()
            for host, _, port in (text.rpartition(":") for text in service.get("ports", ()))
        }

    def make_secrets(self, *options: str) -> None:
        """Run make_secrets.py as an operator does."""
        command = [sys.executable, str(DOCKER / "make_secrets.py"), str(self.secrets), *options]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr

    def address(self, service: str) -> str:
        """Return ``127.0.0.1:port`` of a service with one port."""
        (port,) = (own for (name, _), own in self.ports.items() if name == service)
        return f"127.0.0.1:{port}"

    def translate(self, text: str, service: str) -> str:
        """Replace names and ports of services, and listen addresses, in a text of one service."""
        for (name, port), own in self.ports.items():
            text = re.sub(rf"\b{re.escape(name)}:{port}\b", f"127.0.0.1:{own}", text)
        for (name, port), own in self.ports.items():
            if name == service:
                text = re.sub(rf"(?<![\w.]){port}(?!\w)", str(own), text)
        for host, own in self.published.items():
            text = re.sub(rf"\b0\.0\.0\.0:{host}\b", f"127.0.0.1:{own}", text)
        for subnet in self.subnets:
            text = text.replace(subnet, "127.0.0.1")
        return text.replace("0.0.0.0", "127.0.0.1")


def _container_ports(service: Mapping[str, Any]) -> list[str]:
    ports = [*service.get("expose", ()), *(text.rpartition(":")[2] for text in service.get("ports", ()))]
    return list(dict.fromkeys(ports))


class Container:
    """Service of a compose file on this machine. folder: of its mounts, ``compose.folder/NAME``."""

    def __init__(self, compose: Compose, name: str) -> None:
        service = compose.services[name]
        file = OWN_IMAGES.get(service["image"].partition(":")[0])
        configuration = image(file) if file else {"env": {}, "entrypoint": [], "cmd": [], "workdir": "/tmp"}
        self.compose, self.name = compose, name
        self.folder = compose.folder / name
        volumes = [text.split(":") for text in service.get("volumes", ())]
        tmpfs = [text.partition(":")[0] for text in service.get("tmpfs", ())]
        self._mounts = sorted({"/run/secrets", "/tmp", *tmpfs, *(volume[1] for volume in volumes)}, key=len)[::-1]
        environment = {**configuration["env"], **service.get("environment", {})}
        self.environment = {
            k: self.translate("" if v is None else str(v)) for k, v in environment.items()
        } | self._of_machine()
        entrypoint = service.get("entrypoint") or configuration["entrypoint"]
        command = (*entrypoint, *(service.get("command") or configuration["cmd"]))
        self.command = [self.translate(word) for word in command]
        if "seaweedfs" in service["image"]:
            self.command += [f"-{option}={free_port()}" for option in STORE_PORTS]
        self.healthcheck = configuration.get("healthcheck", [])
        self.workdir = self.translate(configuration["workdir"])
        self._mount(service, volumes)
        self.process: subprocess.Popen[bytes] | PreloadedProcess | None = None

    def _of_machine(self) -> dict[str, str]:
        """Variables of this machine: its programs, this checkout, and compiled code.

        Bytecode is compiled when the image is built, native code at an earlier start.
        """
        names = ("PYTHONPYCACHEPREFIX", "NUMBA_CACHE_DIR")
        compiled = {name: os.environ[name] for name in names if name in os.environ}
        if "PYTHONPYCACHEPREFIX" in compiled:
            compiled["PYTHONDONTWRITEBYTECODE"] = ""
        path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
        return {"PATH": path, "PYTHONPATH": str(TOP), "TMPDIR": self.translate("/tmp"), **compiled}

    def translate(self, text: str) -> str:
        """Replace paths, ports and services by those of this machine."""
        paths = "|".join(map(re.escape, self._mounts))
        text = self.compose.translate(text, self.name)
        return re.sub(rf"(?<![\w./])({paths})(?![\w.-])", lambda match: f"{self.folder}{match[1]}", text)

    def _mount(self, service: Mapping[str, Any], volumes: list[list[str]]) -> None:
        """Create the folders of the service, and copy its secrets and files."""
        for path in self._mounts:
            (self.folder / path[1:]).parent.mkdir(parents=True, exist_ok=True)
        sources = {source: target for source, target, *_ in volumes if source.startswith("./")}
        for path in set(self._mounts) - set(sources.values()):
            (self.folder / path[1:]).mkdir(exist_ok=True)
        files = {
            path: self.folder / target[1:] / path.relative_to(DOCKER / source)
            for source, target in sources.items()
            for path in [DOCKER / source, *(DOCKER / source).rglob("*")]
            if path.is_file()
        }
        files |= {self.compose.secrets / name: self.secret_path(name) for name in service.get("secrets", ())}
        for file, copy in files.items():
            text = file.read_text()
            copy.parent.mkdir(parents=True, exist_ok=True)
            copy.write_text(self.translate(text) if file.name in TRANSLATED_FILES else text)
        if "fleetmap_database_url" in service.get("secrets", ()):
            self.secret_path("fleetmap_database_url").write_text(self.compose.database_url + "\n")
        Path(self.workdir).mkdir(parents=True, exist_ok=True)

    def secret_path(self, name: str) -> Path:
        """Return where the service finds a secret."""
        return self.folder / "run" / "secrets" / name

    def secret(self, name: str) -> str:
        """Return a secret of the service."""
        return self.secret_path(name).read_text().strip()

    @property
    def log(self) -> str:
        """What the service has printed."""
        return (self.folder / "log").read_text(errors="replace")

    def run(self, command: list[str], *, seconds: float = 120.0) -> subprocess.CompletedProcess[str]:
        """Run a command in the container to its end. Both streams of ``fleetmap`` are in ``stderr``."""
        program = self._program(command)
        if Path(program).name == "fleetmap":
            done = run_preloaded(command[1:], env=self.environment, cwd=Path(self.workdir), timeout=seconds)
            return subprocess.CompletedProcess(command, done.returncode, "", done.stdout)
        return subprocess.run(
            [program, *command[1:]],
            env=self.environment,
            cwd=self.workdir,
            capture_output=True,
            text=True,
            timeout=seconds,
            check=False,
        )

    def start(self) -> subprocess.Popen[bytes] | PreloadedProcess:
        """Start the service; its output is appended to ``log``."""
        program, *arguments = self._program(self.command), *self.command[1:]
        with (self.folder / "log").open("ab") as log:
            if Path(program).name == "fleetmap" and arguments[0] != "agent":
                self.process = PreloadedProcess(arguments, env=self.environment, cwd=Path(self.workdir), output=log)
                return self.process
            self.process = subprocess.Popen(
                [program, *arguments],
                env=self.environment,
                cwd=self.workdir,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        return self.process

    @contextlib.contextmanager
    def running(self) -> Iterator[None]:
        """Run the service within a block."""
        self.start()
        try:
            yield
        finally:
            self.stop()

    def stop(self, number: int = signal.SIGTERM) -> int | None:
        """Stop the service, and kill its processes if they stay. Returns the exit status, None if it never ran."""
        process = self.process
        if process is None:
            return None
        if process.poll() is None:
            process.send_signal(number)
        try:
            return process.wait(60)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait(60)

    def _program(self, command: list[str]) -> str:
        """Return the program of this machine; one with a path is the image's."""
        program_path = shutil.which(Path(command[0]).name, path=self.environment["PATH"])
        assert program_path, f"{command[0]} is not in the image's PATH"
        return program_path

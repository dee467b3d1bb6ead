"""Parts of the node without rclpy: agent process, hooks, level, grids to publish."""

from __future__ import annotations

import contextlib
import functools
import json
import os
import shlex
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from . import grids
from .loading import LoadError, Names, Nav2, Ros, Site, Steps, TopologicalMap, grid_names, map_grid, reporter

HOOK = Path(__file__).resolve().parent / "hook.py"
FIRST_PAUSE_SECONDS = 1.0
MAX_PAUSE_SECONDS = 60.0
"""Maximum pause before a stopped agent is restarted."""

STOP_SECONDS = 10.0
LEVEL_SECONDS = 280.0
MAX_REQUEST_BYTES = 1 << 20

Log = Callable[[str, str], None]
"""Log function: ``log(severity, text)`` with severity ``info``, ``warn`` or ``error``."""

Publish = Callable[[str, grids.Grid], None]
"""Publish function: ``publish(kind, grid)`` with kind ``map``, ``keepout`` or ``speed``."""


class SettingsError(Exception):
    """Invalid parameter of the node."""


@dataclass(frozen=True)
class Settings:
    """Parameters of the node. An empty string means unset."""

    environment: str = ""
    server: str = "http://127.0.0.1:8000"
    formats: tuple[str, ...] = ("occupancy_grid",)
    optional: tuple[str, ...] = ()
    into: str = ""
    channel: str = ""
    robot: str = ""
    token_file: str = ""
    ca_file: str = ""
    zenoh_connect: str = ""
    fleetmap: str = "fleetmap"
    arguments: tuple[str, ...] = ()
    level: str = ""
    nav2: bool = True
    topological: bool = False
    publish_map: bool = False
    publish_masks: bool = False
    frame_id: str = "map"
    map_topic: str = "/map"
    keepout_topic: str = "/keepout_filter_mask"
    speed_topic: str = "/speed_filter_mask"
    grid: str = ""
    keepout_grid: str = Names.keepout_grid
    speed_grid: str = Names.speed_grid
    map_server: str = Names.map_server
    keepout_server: str = Names.keepout_server
    speed_server: str = Names.speed_server
    route_server: str = Names.route_server
    dynamic_edges: str = ""
    topological_manager: str = Names.manager
    topological_topic: str = Names.topic
    call_seconds: float = 60.0

    @classmethod
    def from_parameters(cls, values: Mapping[str, Any]) -> Settings:
        """Check the parameters. Raises SettingsError."""
        out: dict[str, Any] = {}
        for name, value in values.items():
            if isinstance(value, (list, tuple)):  # ROS 2 cannot declare an empty string array: [''] replaces it
                out[name] = tuple(str(item).strip() for item in value if str(item).strip())
            else:
                out[name] = value.strip() if isinstance(value, str) else value
        settings = cls(**out)
        for name in ("environment", "into", "server", "fleetmap"):
            if not getattr(settings, name):
                raise SettingsError(f"parameter {name} is empty: set it in the parameter file")
        if not settings.formats:
            raise SettingsError("parameter formats is empty: list at least one format, such as occupancy_grid")
        if settings.call_seconds <= 0:
            raise SettingsError(f"parameter call_seconds must be above 0, got {settings.call_seconds}")
        return settings

    @property
    def folder(self) -> Path:
        """Map directory of the agent."""
        return Path(self.into).expanduser().absolute()

    @property
    def names(self) -> Names:
        """Names of nodes and grids; a mask server other than the default one is required."""
        values = {
            "map_server": self.map_server,
            "keepout_server": self.keepout_server,
            "speed_server": self.speed_server,
            "route_server": self.route_server,
            "dynamic_edges": self.dynamic_edges,
            "manager": self.topological_manager,
            "topic": self.topological_topic,
            "grid": self.grid,
            "keepout_grid": self.keepout_grid,
            "speed_grid": self.speed_grid,
        }
        default = Names()
        return Names(**values, required=frozenset(n for n, v in values.items() if v and v != getattr(default, n)))

    def command(self, hook: str) -> list[str]:
        """Return the agent's command line. hook: value of ``--on-change``."""
        out = [
            *shlex.split(self.fleetmap),
            "agent",
            "--json",
            "--server",
            self.server,
            "--environment",
            self.environment,
        ]
        out += ["--formats", ",".join(self.formats), "--into", str(self.folder), "--on-change", hook]
        for flag, value in (
            ("--optional", ",".join(self.optional)),
            ("--channel", self.channel),
            ("--robot", self.robot),
            ("--ca", self.ca_file),
            ("--zenoh", self.zenoh_connect),
        ):
            out += [flag, value] if value else []
        return [*out, *self.arguments]

    def variables(self) -> dict[str, str]:
        """Return the environment variables of the agent, with the token, which must not be in a command line.

        Raises SettingsError if the token file cannot be read.
        """
        if not self.token_file:
            return dict(os.environ)
        try:
            token = Path(self.token_file).expanduser().read_text().strip()
        except (OSError, UnicodeDecodeError) as error:
            raise SettingsError(f"could not read token_file {self.token_file}: {error}") from None
        return {**os.environ, "FLEETMAP_TOKEN": token}


class Loader:
    """Loads the maps that the agent has switched to, and passes grids to ``publish``. Thread-safe."""

    def __init__(self, ros: Ros, settings: Settings, publish: Publish) -> None:
        self._ros, self._settings, self._publish = ros, settings, publish
        self._lock = threading.Lock()

    def __call__(self, variables: Mapping[str, str]) -> tuple[bool, list[str]]:
        """Load the map of these hook variables. Return whether all steps succeeded, and a line per step."""
        lines: list[str] = []
        with self._lock:
            try:
                return self.load(Site.from_environment(variables), lines, variables.get("FLEETMAP_HOOK_STATUS")), lines
            except KeyError as error:
                return False, [*lines, f"missing hook variable {error.args[0]}"]
            except (LoadError, OSError) as error:
                return False, [*lines, str(error)]

    def load(self, site: Site, lines: list[str], status_file: str | None = None) -> bool:
        """Run all steps that the parameters enable. Return whether all succeeded."""
        write = reporter(status_file, lines.append)
        ok = True
        if self._settings.nav2:
            ok = Nav2(self._ros, site, self._settings.names).load(write) and ok
        if self._settings.topological:
            ok = TopologicalMap(self._ros, site, self._settings.names).load(write) and ok
        steps = Steps(write)
        self.publish(site, steps)
        return ok and not steps.failed

    def publish(self, site: Site, steps: Steps) -> None:
        """Publish the level's grids that the parameters enable."""
        names = self._settings.names
        kinds: dict[str, str | None] = {"map": None} if self._settings.publish_map else {}
        kinds |= {"keepout": names.keepout_grid, "speed": names.speed_grid} if self._settings.publish_masks else {}
        for kind, name in kinds.items():
            steps.run(f"publish {kind}", functools.partial(self._publish_grid, site, kind, name))

    def _publish_grid(self, site: Site, kind: str, name: str | None) -> str | None:
        if name is None:
            name = map_grid(grid_names(site), self._settings.names) or "map"
        path = site.path("occupancy_grid", f"{name}.yaml")
        if not (site.folder / path).is_file():
            if kind == "map":
                raise LoadError(f"no grid {path} to publish: set the parameter grid to an existing one")
            self._publish(kind, grids.Grid(1, 1, 0.01, (0.0, 0.0, 0.0), b"\0"))  # replaces the latched old mask
            return f"published an empty mask: the map has no {path}"
        try:
            grid = grids.read_map(site.folder / path)
        except grids.GridError as error:
            raise LoadError(str(error)) from None
        self._publish(kind, grid)
        return f"{path}: {grid.width} × {grid.height} cells"


class HookServer:
    """Unix socket that receives load requests of the agent's hook. Accessible to this user only."""

    def __init__(self, loader: Callable[[Mapping[str, str]], tuple[bool, list[str]]], log: Log) -> None:
        self._loader, self._log = loader, log
        self._folder = tempfile.TemporaryDirectory(prefix="fleetmap-ros-")  # mode 0700
        self.path = Path(self._folder.name) / "hook"
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.bind(str(self.path))
        self._socket.listen(8)
        self._thread = threading.Thread(target=self._serve, name="fleetmap-hooks", daemon=True)
        self._thread.start()

    @property
    def command(self) -> str:
        """Value of the agent's ``--on-change``."""
        return f"{shlex.quote(sys.executable)} {shlex.quote(str(HOOK))} {shlex.quote(str(self.path))}"

    def close(self) -> None:
        """Close the socket. A later hook fails, and the agent repeats it."""
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        self._thread.join(STOP_SECONDS)
        self._folder.cleanup()

    def _serve(self) -> None:
        while True:
            try:
                connection, _ = self._socket.accept()
            except OSError:
                return
            with connection, contextlib.suppress(OSError):
                connection.settimeout(STOP_SECONDS)
                data = bytearray()
                while len(data) <= MAX_REQUEST_BYTES and (chunk := connection.recv(1 << 16)):
                    data += chunk
                ok, lines = self._answer(bytes(data))
                connection.settimeout(STOP_SECONDS)
                connection.sendall(json.dumps({"ok": ok, "lines": lines}).encode())

    def _answer(self, data: bytes) -> tuple[bool, list[str]]:
        try:
            body = json.loads(data)
            variables = {str(name): str(value) for name, value in body.items()}
        except (ValueError, AttributeError):
            return False, ["invalid request of the hook"]
        try:
            ok, lines = self._loader(variables)
        except Exception as error:  # noqa: BLE001  this thread also answers the hooks that follow
            ok, lines = False, [f"could not load the map: {error!r}"]
        for line in lines:
            self._log("info" if ok else "warn", line)
        return ok, lines


@dataclass
class AgentProcess:
    """Process ``fleetmap agent``, restarted if it stops.

    Attributes:
        event: called with each JSON line that it prints.
    """

    settings: Settings
    hook: str
    event: Callable[[Mapping[str, Any]], None]
    log: Log
    _stopping: threading.Event = field(default_factory=threading.Event)
    _process: subprocess.Popen[str] | None = None
    _thread: threading.Thread | None = None
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def start(self) -> None:
        """Start the process. Raises SettingsError if the token cannot be read or the command is not found."""
        self._stopping.clear()
        process = self._spawn()
        self._thread = threading.Thread(target=self._watch, args=(process,), name="fleetmap-agent", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop the process with SIGTERM, after STOP_SECONDS with SIGKILL."""
        self._stopping.set()
        with self._lock:
            process = self._process
        if process is not None and process.poll() is None:
            process.terminate()
            try:
                process.wait(STOP_SECONDS)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        if self._thread is not None:
            self._thread.join(STOP_SECONDS)
            self._thread = None

    def _spawn(self) -> subprocess.Popen[str]:
        command = self.settings.command(self.hook)
        try:
            process = subprocess.Popen(  # noqa: S603  the node's parameters name the command
                command,
                env=self.settings.variables(),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                errors="replace",
            )
        except OSError as error:
            raise SettingsError(
                f"could not run {command[0]} ({error.strerror}): install the agent (pipx install fleet-map-server), or "
                "set the parameter fleetmap"
            ) from None
        with self._lock:
            self._process = process
        return process

    def _watch(self, process: subprocess.Popen[str]) -> None:
        pause = FIRST_PAUSE_SECONDS
        while True:
            assert process.stdout is not None
            with process.stdout:
                for line in process.stdout:
                    pause = FIRST_PAUSE_SECONDS if self._line(line) else pause
            status = process.wait()
            if self._stopping.is_set():
                return
            reason = f"the agent exited with status {status}"
            while True:
                self.log("error", f"{reason}; restarting it in {pause:g} seconds")
                if self._stopping.wait(pause):
                    return
                pause = min(MAX_PAUSE_SECONDS, pause * 2)
                try:
                    process = self._spawn()
                    break
                except SettingsError as error:  # during an upgrade, for example
                    reason = str(error)
            if self._stopping.is_set():
                process.terminate()

    def _line(self, line: str) -> bool:
        """Log a line of the agent and pass it to ``event``. Return whether it reports no error."""
        try:
            body = json.loads(line)
        except ValueError:
            body = None
        if not isinstance(body, dict):
            self.log("warn", line.rstrip()[:1000])
            return False
        bad = body.get("event") in ("failed", "refused", "damaged")
        self.log("warn" if bad else "info", line.rstrip()[:1000])
        self.event(body)
        return not bad


def switch_level(settings: Settings, level: str) -> tuple[bool, str]:
    """Load another level with ``fleetmap agent-level``, which runs the agent's hooks. Return success and a message."""
    if not level:
        return False, "set the parameter level first"
    command = [*shlex.split(settings.fleetmap), "agent-level", str(settings.folder), level]
    try:
        ended = subprocess.run(  # noqa: S603  the node's parameters name the command
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=LEVEL_SECONDS, check=False
        )
    except subprocess.TimeoutExpired:
        return False, f"level {level} was not loaded within {LEVEL_SECONDS:g} seconds"
    except OSError as error:
        return False, f"could not run {command[0]}: {error.strerror}"
    text = " ".join((ended.stderr or ended.stdout).split())[-1000:]
    return (
        (True, f"level {level} is loaded")
        if ended.returncode == 0
        else (False, text or f"{command[0]} exited with status {ended.returncode}")
    )


def initial_site(settings: Settings) -> Site | None:
    """Return the installed map and the stored level at start-up; None if there is no map yet."""
    current = settings.folder / "current"
    try:
        folder = current.resolve(strict=True)
    except (OSError, RuntimeError):
        return None
    names: list[str] = []
    with contextlib.suppress(OSError, UnicodeDecodeError):
        names = (settings.folder / "level").read_text().splitlines()  # in this map, and perhaps in the next one
    site = Site(folder, settings.folder / "hooks", frozenset(), names[0] if names else "")
    with contextlib.suppress(LoadError):
        levels = site.level_names()
        site.level = next((name for name in names if name in levels), site.level)
    return site

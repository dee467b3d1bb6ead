"""Temporary PostgreSQL cluster with PostGIS for a test session, on a free loopback port.

tests/conftest.py imports the fixtures: once, or each import would start a cluster of its own.
"""

from __future__ import annotations

import contextlib
import os
import pwd
import shutil
import signal
import subprocess
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import psycopg
import pytest
import yaml
from psycopg import sql

from tests.ports import free_port

FOLDERS = ("/usr/local/bin", *(f"/usr/lib/postgresql/{n}/bin" for n in range(20, 12, -1)))


@dataclass(frozen=True, slots=True)
class Cluster:
    """Running server: one superuser, trusted on the loopback address.

    run: prefix of commands as the server's user. synced: whether commits wait for the disk.
    """

    port: int
    bin: Path
    data: Path
    run: Callable[..., subprocess.CompletedProcess[str]]
    synced: bool = False

    def start(self) -> subprocess.CompletedProcess[str]:
        """Start the server and wait until it responds."""
        home = self.data.parent
        options = f"-p {self.port} -c listen_addresses=127.0.0.1 -c unix_socket_directories='{home}'"
        options += " -c max_connections=80"
        if not self.synced:
            options += " -c fsync=off"  # its files outlive its processes; tests cut no power
        command = [str(self.bin / "pg_ctl"), "-D", str(self.data), "-w", "-t", "60", "-l", str(home / "log")]
        return self.run(*command, "-o", options, "start")

    def kill(self) -> None:
        """Kill all processes with kill -9, as when memory runs out."""
        postmaster = int((self.data / "postmaster.pid").read_text().split()[0])
        children = subprocess.run(["pgrep", "-P", str(postmaster)], capture_output=True, text=True, check=False)
        for process in (postmaster, *map(int, children.stdout.split())):
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)

    def restart(self) -> None:
        """Start the server after ``kill``; it refuses to start until its last process has ended."""
        until = time.monotonic() + 120
        while (started := self.start()).returncode:
            if time.monotonic() > until:
                log = (self.data.parent / "log").read_text(errors="replace")
                pytest.fail(f"PostgreSQL does not start again: {started.stdout}{started.stderr}{log[-2000:]}")
            time.sleep(0.1)

    def url(self, database: str = "postgres") -> str:
        """Return the URL for SQLAlchemy."""
        return f"postgresql+psycopg://fleetmap@127.0.0.1:{self.port}/{database}"

    def connect(self, database: str = "postgres") -> psycopg.Connection[tuple[object, ...]]:
        """Open a connection with autocommit."""
        return psycopg.connect(
            host="127.0.0.1", port=self.port, user="fleetmap", dbname=database, autocommit=True, connect_timeout=10
        )

    def create_database(self, template: str = "fleetmap_template", *, name: str | None = None) -> str:
        """Create an empty database with PostGIS, or copy one without connections; return its name."""
        name = name or f"t{uuid.uuid4().hex}"
        with self.connect() as connection:
            names = sql.Identifier(name), sql.Identifier(template)
            copy = sql.SQL("CREATE DATABASE {} TEMPLATE {}").format(*names)
            if connection.info.server_version >= 150_000:  # its default logs each page, which takes half as long again
                copy += sql.SQL(" STRATEGY FILE_COPY")
            connection.execute(copy)
        return name

    def drop_database(self, name: str) -> None:
        """Remove a database, even with open connections."""
        with self.connect() as connection:
            connection.execute(sql.SQL("DROP DATABASE IF EXISTS {} WITH (FORCE)").format(sql.Identifier(name)))


def _initdb_options() -> list[str]:
    """Options with which the compose files create the database."""
    compose = yaml.safe_load((Path(__file__).resolve().parents[1] / "docker" / "compose.yaml").read_text())
    return str(compose["services"]["database"]["environment"]["POSTGRES_INITDB_ARGS"]).split()


def _missing(message: str) -> None:
    """Fail in CI; skip the tests for a developer without PostgreSQL."""
    if os.environ.get("CI"):
        pytest.fail(message)
    pytest.skip(message)


def _binaries() -> Path | None:
    initdb = shutil.which("initdb")
    candidates = [*([str(Path(initdb).resolve().parent)] if initdb else []), *FOLDERS]
    for folder in candidates:
        if (Path(folder) / "initdb").exists() and (Path(folder) / "pg_ctl").exists():
            return Path(folder)
    return None


def _as_user() -> tuple[list[str], int | None]:
    """Return a command prefix that drops root, which PostgreSQL rejects, and the user's id."""
    if os.geteuid() != 0:
        return [], None
    for name in ("postgres", "nobody"):
        try:
            user = pwd.getpwnam(name)
        except KeyError:
            continue
        if shutil.which("setpriv"):
            return ["setpriv", f"--reuid={user.pw_uid}", f"--regid={user.pw_gid}", "--clear-groups"], user.pw_uid
        if shutil.which("runuser"):
            return ["runuser", "-u", name, "--"], user.pw_uid
    return [], None


@pytest.fixture(scope="session")
def postgres_cluster() -> Iterator[Cluster]:
    """Cluster; skips if PostgreSQL or PostGIS is not installed, and fails if CI is set."""
    with running_cluster() as cluster:
        with cluster.connect() as connection:  # at any moment, autovacuum would give a test statistics
            connection.execute("ALTER SYSTEM SET autovacuum = off")
            connection.execute("SELECT pg_reload_conf()")
        yield cluster


@contextmanager
def running_cluster(kept: Path | None = None, *, synced: bool = False) -> Iterator[Cluster]:
    """Run a cluster outside of tests. kept: folder where its data stay, and are found again. synced: see Cluster."""
    folder = _binaries()
    if folder is None:
        _missing("PostgreSQL is not installed (initdb is not to be found)")
    assert folder is not None
    prefix, uid = _as_user()
    if os.geteuid() == 0 and uid is None:
        _missing("PostgreSQL does not run as root, and there is no other user to run it as")
    root = kept or Path(tempfile.mkdtemp(prefix="fleetmap-pg-"))
    home = root.absolute() / "home"
    home.mkdir(parents=True, exist_ok=True)
    root.chmod(0o755)
    if uid is not None:
        os.chown(home, uid, -1)
    data = home / "data"
    environment = {"PATH": os.environ.get("PATH", ""), "LC_ALL": "C.UTF-8", "HOME": str(home)}

    def run(*command: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [*prefix, *command], capture_output=True, text=True, cwd=home, env=environment, timeout=120, check=False
        )

    try:
        if not (data / "PG_VERSION").exists():
            _create_cluster(folder, data, run)
        cluster = _started_cluster(folder, data, run, synced=synced)
        try:
            _create_template(cluster)
            yield cluster
        finally:
            mode = "immediate" if kept is None else "fast"
            run(str(folder / "pg_ctl"), "-D", str(data), "-m", mode, "-w", "stop")
    finally:
        if kept is None:
            shutil.rmtree(root, ignore_errors=True)


def _create_cluster(folder: Path, data: Path, run: Callable[..., subprocess.CompletedProcess[str]]) -> None:
    process = run(
        str(folder / "initdb"),
        *("-D", str(data), "-U", "fleetmap", "-A", "trust", "-E", "UTF8", "--no-sync", *_initdb_options()),
    )
    if process.returncode:
        pytest.fail(f"initdb failed: {process.stderr}")


def _started_cluster(
    folder: Path, data: Path, run: Callable[..., subprocess.CompletedProcess[str]], *, synced: bool
) -> Cluster:
    for _ in range(5):
        cluster = Cluster(free_port(), folder, data, run, synced)
        started = cluster.start()
        if started.returncode == 0:
            return cluster
    log = data.parent / "log"
    text = log.read_text(errors="replace") if log.exists() else ""
    pytest.fail(f"PostgreSQL does not start: {started.stdout}{started.stderr}{text}")


def _create_template(cluster: Cluster) -> None:
    with cluster.connect() as connection:
        if connection.execute("SELECT 1 FROM pg_database WHERE datname = 'fleetmap_template'").fetchone():
            return
        row = connection.execute("SELECT 1 FROM pg_available_extensions WHERE name = 'postgis'").fetchone()
        if row is None:
            _missing("PostGIS is not installed beside PostgreSQL")
        connection.execute("CREATE DATABASE fleetmap_template")
    with cluster.connect("fleetmap_template") as connection:
        connection.execute("CREATE EXTENSION postgis")


@pytest.fixture
def postgres_url(postgres_cluster: Cluster) -> Iterator[str]:
    """Separate database, removed after the test."""
    name = postgres_cluster.create_database()
    yield postgres_cluster.url(name)
    postgres_cluster.drop_database(name)

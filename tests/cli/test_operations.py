"""An administrator's day: the ``console`` commands of the pages about operations, taken out of them and run.

What stands in ``sh`` blocks is run by ``test_pages``. A command that is neither run nor named in ``ELSEWHERE`` fails.
"""

from __future__ import annotations

import os
import re
import shutil
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import httpx
import pytest

from tests.certificates import Authority
from tests.events.receiver import Receiver
from tests.ports import free_port
from tests.preloaded import preloaded_command

ROOT = Path(__file__).resolve().parents[2]
PAGES = ("deploy", "maintain", "back-up", "send-events", "storage", "scale", "mirror", "runbook")
TOKEN = "administrator-of-these-tests"
PASSWORD = "a-long-random-password"
SECONDS = 280.0

ELSEWHERE = {
    r"(cd docker$|docker |for name in server-1)": "a container engine; tests/docker runs each service without one",
    r"(kubectl |cd docker/kubernetes|.*\| kubectl )": "Kubernetes; tests/docker checks the manifests",
    r"cat (docker/)?secrets/fleetmap_admin_token$": "tests/docker creates and reads it",
    r"sudo ": "tests/docker/test_service.py and test_offline.py, on a machine of their own",
    r"(make bundle|sha256sum --check)": "tests/test_bundle.py and tests/docker/test_offline.py",
    r"python3 docker/make_secrets.py": "tests/docker/test_scale_files.py",
    r"(pgbackrest |fleetmap restore --raise-epoch && fleetmap verify$)": "tried by hand; the page has the versions",
    r"(litestream replicate|rclone config|rclone copy /var)": "tried by hand; the page has the versions",
    r"FLEETMAP_CA=ca.pem FLEETMAP_ZENOH_CA=": "the same agent as in deploy.md",
    r"(export FLEETMAP_MQTT_URL|mosquitto_sub )": "tests/events/test_mqtt.py, with a broker",
    r"export (FLEETMAP_DATABASE_URL|FLEETMAP_ZENOH_MODE|AWS_|FLEETMAP_BLOB_URL)": "tests/docker/test_scale_run.py",
    r"fleetmap (serve( --host 0.0.0.0 --data-dir /srv/fleetmap)?|worker .*)$": "tests/docker/test_scale_run.py",
}
"""Commands that this test does not run, and why not or where they are run."""

SHIMS = {
    "age-keygen": """
        import sys; from pathlib import Path; from pyrage import x25519
        one = x25519.Identity.generate()
        Path(sys.argv[sys.argv.index("-o") + 1]).write_text(str(one) + "\\n")
        print("Public key:", one.to_public())
        """,
    "litestream": """
        import sqlite3, sys
        assert sys.argv[1:3] == ["restore", "-o"]
        with sqlite3.connect("../data/fleetmap.sqlite3") as live, sqlite3.connect(sys.argv[3]) as copy:
            live.backup(copy)
        """,
    "rclone": """
        import shutil, sys
        assert sys.argv[1] == "copy"
        shutil.copytree("../data/blobs", sys.argv[3], ignore=shutil.ignore_patterns("tmp"), dirs_exist_ok=True)
        """,
}
"""What programs of others leave behind that need not be on this machine."""


def commands() -> list[str]:
    """Return the commands in the ``console`` blocks of the pages; without comments, each in one line."""
    found = []
    for page in PAGES:
        text = (ROOT / "docs" / "how-to" / f"{page}.md").read_text()
        for block in re.findall(r"^```console\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
            lines = re.sub(r" +#.*$", "", block, flags=re.MULTILINE).replace("\\\n", "")
            if "$ " in lines:  # else all lines are commands
                lines = "\n".join(re.findall(r"^\$ (.*)$", lines, re.MULTILINE))
            found += [re.sub(r"  +", " ", line) for line in lines.splitlines() if line.strip()]
    return found


class Machine:
    """A folder with the programs that the pages need, in which their commands are run."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.port, self.zenoh = folder, free_port(), free_port()
        self.receiver = Receiver()
        self.left = [command for command in commands() if not any(re.match(known, command) for known in ELSEWHERE)]
        for name, text in SHIMS.items():
            lines = [line.removeprefix(" " * 8) for line in text.strip("\n").splitlines()]
            (folder / "bin" / name).write_text("\n".join([f"#!{sys.executable}", *lines, ""]))
            (folder / "bin" / name).chmod(0o755)
        clean = {name: value for name, value in os.environ.items() if not name.startswith("FLEETMAP_")}
        path = f"{folder / 'bin'}:{clean['PATH']}"
        self.environment = {**clean, "PATH": path, "FLEETMAP_ZENOH_MODE": "router", "COLUMNS": "200"}

    def take(self, begin: str) -> str:
        """Take the next command that begins so out of those that are left, with the places of this machine."""
        command = next((one for one in self.left if one.startswith(begin)), None)
        assert command is not None, f"no page has a command {begin!r} that was not run"
        self.left.remove(command)
        replaced = {
            "https://maps.example.org": f"https://127.0.0.1:{self.port}",
            "https://other-server": f"https://127.0.0.1:{self.port}",
            "https://hooks.example.org/fleet": self.receiver.url,
            "tls/0.0.0.0:7447": f"tls/127.0.0.1:{self.zenoh}",
            "--host 0.0.0.0": f"--host 127.0.0.1 --port {self.port} --data-dir data",
            "FLEETMAP_TOKEN=… FLEETMAP_CA": f"FLEETMAP_TOKEN={TOKEN} FLEETMAP_CA",
            "FLEETMAP_TOKEN=…": f"FLEETMAP_TOKEN={TOKEN}",
            "PASSWORD=…": f"PASSWORD={PASSWORD}",
            "FLEETMAP_WEBHOOK_NETWORKS=192.168.7.20": "FLEETMAP_WEBHOOK_NETWORKS=127.0.0.1",
            "/etc/fleetmap/ca.pem": "ca.pem",
            "/mnt/backup/": f"{self.folder}/mnt/",
            "/originals": "originals",
            "/other/data": "data",
        }
        for old, new in replaced.items():
            command = command.replace(old, new)
        return command

    def run(self, command: str, folder: str = ".") -> str:
        """Run a command to its end; return what it printed."""
        done = subprocess.run(
            ["bash", "-euc", command],
            cwd=self.folder / folder,
            env=self.environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=SECONDS,
            check=False,
        )
        assert done.returncode == 0, f"{command}\n{done.stdout}"
        return done.stdout

    def export(self, command: str) -> None:
        """Set the variables of an ``export`` for all later commands."""
        self.environment |= dict(part.split("=", 1) for part in command.split()[1:])

    @contextmanager
    def running(self, command: str) -> Iterator[None]:
        """Run a command in the background, and end it."""
        log = self.folder / "log"
        with log.open("ab") as output:
            process = subprocess.Popen(
                ["bash", "-euc", command], cwd=self.folder, env=self.environment, stdout=output, stderr=output
            )
        try:
            yield
            assert process.poll() is None, log.read_text()
        finally:
            process.terminate()
            process.wait(SECONDS)

    def wait(self, path: str) -> None:
        """Wait for the server, or for a file."""
        deadline = time.monotonic() + SECONDS
        while time.monotonic() < deadline:
            try:
                is_there = httpx.get(path, verify=False).is_success if "://" in path else (self.folder / path).exists()
            except httpx.TransportError:
                is_there = False
            if is_there:
                return
            time.sleep(0.05)
        raise AssertionError(f"{path} does not come:\n{(self.folder / 'log').read_text()}")


@pytest.fixture
def machine(tmp_path: Path) -> Iterator[Machine]:
    """A machine with certificates and a robot's password beside it, as ``make_secrets.py`` creates them."""
    (tmp_path / "bin").mkdir()
    machine = Machine(tmp_path)
    Authority(tmp_path).sign("server")
    (tmp_path / "robots").write_text(f"tractor-7:{PASSWORD}\n")
    for secret in ("robots", "server.key"):
        (tmp_path / secret).chmod(0o600)
    shutil.copytree(ROOT / "tests" / "samples" / "tmap2", tmp_path / "originals")
    with preloaded_command(tmp_path / "bin" / "fleetmap", {"PYTHONPATH": str(ROOT)}):
        yield machine
    machine.receiver.close()


def test_commands_of_operations_work_as_pasted(machine: Machine) -> None:
    """With a key, TLS and users: link, agent, webhooks, repair, encrypted backup, and copies by other programs."""
    machine.run(machine.take("openssl genpkey"))
    machine.export(f"export FLEETMAP_SIGNING_KEY={machine.folder}/signing-key.pem")
    machine.export(machine.take("export FLEETMAP_WEBHOOK_NETWORKS"))
    serve = machine.take("FLEETMAP_TLS_CERTIFICATE=")
    with machine.running(f"FLEETMAP_ADMIN_TOKEN={TOKEN} {serve}"):
        machine.export(machine.take("export FLEETMAP_SERVER"))
        machine.wait(f"https://127.0.0.1:{machine.port}/readyz")
        machine.run("fleetmap import originals/orchard.tmap2.yaml -e my-farm")
        machine.run("fleetmap import originals/orchard.tmap2.yaml -e farm-1")
        assert "signature=" in machine.run(machine.take("fleetmap link"))
        with machine.running(machine.take("FLEETMAP_TOKEN=")):
            machine.wait("maps/current/tmap2")
        hook_webhooks(machine)
        machine.run(machine.take("fleetmap verify --data-dir data --repair"))
        machine.run(machine.take("fleetmap verify --data-dir data --repair --from"))
        restore_encrypted_backup(machine)
        restore_copies(machine)
    assert machine.left == [], "a test runs these, or ELSEWHERE says where they are run"


def hook_webhooks(machine: Machine) -> None:
    """Register a webhook, try it, and list it."""
    printed = machine.run(machine.take("fleetmap webhooks add"))
    identifier, secret = re.findall(r"webhook (\w+) for", printed)[0], re.findall(r"whsec_\S+", printed)[0]
    machine.receiver.secret = secret
    tried = machine.run(re.sub(r"(test) \w+", rf"\1 {identifier}", machine.take("fleetmap webhooks test")))
    assert "delivered: the receiver answered 204" in tried
    assert not machine.receiver.problems
    assert identifier in machine.run(machine.take("fleetmap webhooks list"))


def restore_encrypted_backup(machine: Machine) -> None:
    """Create a pair of keys, back up to its recipient while the server runs, and restore with its identity."""
    printed = machine.run(machine.take("age-keygen"))
    recipient = printed.split()[-1]
    backup = re.sub(r"age1\w+", recipient, machine.take("fleetmap backup"))
    machine.run(f"{backup} --data-dir data")
    machine.run(f"{machine.take('fleetmap restore /mnt')} --data-dir restored/data")
    epochs = [read_epoch(machine.folder / place) for place in ("data", "restored/data")]
    machine.run(machine.take("fleetmap restore --raise-epoch --data-dir data"), "restored")
    epochs.append(read_epoch(machine.folder / "restored" / "data"))
    assert epochs == sorted(set(epochs))
    machine.run("fleetmap verify --data-dir data", "restored")


def restore_copies(machine: Machine) -> None:
    """Put back what Litestream and rclone have copied, with the keys."""
    (machine.folder / "copied" / "data").mkdir(parents=True)
    steps = [machine.take(begin) for begin in ("umask", "litestream restore", "rclone copy remote", "cp -r")]
    steps.append(machine.take("fleetmap restore --raise-epoch --data-dir data && fleetmap verify"))
    machine.run("\n".join(steps).replace("COPY-OF-KEYS", "../data/keys"), "copied")
    data = machine.folder / "copied" / "data"
    assert read_epoch(data) > read_epoch(machine.folder / "data")
    assert (data / "fleetmap.sqlite3").stat().st_mode & 0o077 == 0
    assert any((data / "keys").iterdir())


def read_epoch(data: Path) -> int:
    """Return the epoch of the server with a data folder."""
    with closing(sqlite3.connect(data / "fleetmap.sqlite3")) as connection:
        return int(connection.execute("SELECT epoch FROM server").fetchone()[0])


def test_reasons_are_of_commands_that_stand_in_a_page() -> None:
    assert [known for known in ELSEWHERE if not any(re.match(known, command) for command in commands())] == []

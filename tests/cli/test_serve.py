"""Starting and stopping the server as users, containers and `make run` do."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import sqlite3
import ssl
import stat
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.certificates import Authority
from tests.cli.conftest import Fleetmap, ServerProcess
from tests.events.conftest import eventually


@pytest.fixture
def usual_umask() -> Iterator[None]:
    """As a shell of most systems has it."""
    former = os.umask(0o022)
    yield
    os.umask(former)


def modes(data: Path) -> tuple[int, set[int]]:
    """Return the modes of a data folder and of the files of its database."""
    return stat.S_IMODE(data.stat().st_mode), {stat.S_IMODE(p.stat().st_mode) for p in data.glob("fleetmap.sqlite3*")}


def start(folder: Path, *arguments: str, **environment: str) -> ServerProcess:
    return ServerProcess("--data-dir", str(folder / "data"), *arguments, environment=environment, folder=folder)


@pytest.mark.usefixtures("usual_umask")
def test_first_start_prints_a_token_once_and_signals_stop_it_cleanly(tmp_path: Path, offline: Fleetmap) -> None:
    """First with two workers, of which only one may make the token."""
    process = start(tmp_path, "--workers", "2")
    try:
        address = process.ready()
        process.wait_for(f"^open {address}/$")
        token = process.wait_for(r"administrator's token, shown only once: (\S+)")[1]
        listed = offline("token", "list", "--server", process.address, "--token", token, "--json")
        assert [row["role"] for row in listed.json] == ["admin"]
        assert modes(tmp_path / "data") == (0o700, {0o600})
    finally:
        assert process.stop(signal.SIGTERM) == 0
    assert sum("shown only once" in line for line in process.lines) == 1
    again = start(tmp_path)
    try:
        again.ready()
        assert offline("token", "list", "--server", again.address, "--token", token).status == 0
        assert not any("shown only once" in line for line in again.lines)
        assert not any(token in line for line in again.lines)
    finally:
        assert again.stop(signal.SIGINT) == 0


def test_serve_demo_prints_working_commands_at_every_start(tmp_path: Path) -> None:
    for _ in range(2):
        process = start(tmp_path, "--demo")
        try:
            token = process.wait_for(r"^administrator's token: (\S+)")[1]
            line = process.wait_for(r'^  curl .*/tmap2"$')[0]
            assert token in line
            address = line.split('"')[-2]
            request = urllib.request.Request(address, headers={"Authorization": f"Bearer {token}"})
            with urllib.request.urlopen(request, timeout=30) as answer:
                assert b"Dock" in answer.read()
            code = process.wait_for(r"^open http://127\.0\.0\.1:\d+/#sign-in=(\S+)$")[1]
            address = f"{process.address}/api/v1/session"
            body, headers = json.dumps({"code": code}).encode(), {"Content-Type": "application/json"}
            with urllib.request.urlopen(urllib.request.Request(address, body, headers), timeout=30) as answer:
                assert json.load(answer)["role"] == "admin"
            with pytest.raises(urllib.error.HTTPError, match="401"):
                urllib.request.urlopen(urllib.request.Request(address, body, headers), timeout=30)
        finally:
            assert process.stop() == 0
    assert (tmp_path / "data" / "demo-token").stat().st_mode & 0o077 == 0


def test_taken_port_is_reported_in_one_line(tmp_path: Path, offline: Fleetmap) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        result = offline("serve", "--port", str(port), "--data-dir", tmp_path / "data")
    assert result.status == 1
    assert f"cannot listen on 127.0.0.1 port {port}" in result.err
    assert "--port" in result.err


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--port", "99999"], "FLEETMAP_PORT"),
        (["--workers", "none"], "FLEETMAP_WORKERS"),
        (["--insecure-no-auth", "--host", "0.0.0.0"], "loopback"),
        (["--no-such-flag"], "--no-such-flag"),
    ],
)
def test_unusable_settings_are_usage_errors(
    arguments: list[str], named: str, offline: Fleetmap, tmp_path: Path
) -> None:
    result = offline("serve", "--data-dir", tmp_path / "data", *arguments)
    assert result.status == 2
    assert named in " ".join(result.err.split())


def test_serve_uses_https_and_reads_a_mounted_secret(tmp_path: Path) -> None:
    authority = Authority(tmp_path)
    certificate, key = authority.sign("server")
    trusting = ssl.create_default_context(cafile=authority.pem)
    (tmp_path / "secrets").mkdir()
    (tmp_path / "secrets" / "fleetmap_admin_token").write_text("mounted-as-a-secret\n")
    files = ("--tls-certificate", str(certificate), "--tls-key", str(key))
    process = start(tmp_path, *files, FLEETMAP_SECRETS_DIR=str(tmp_path / "secrets"))
    try:
        address = process.wait_for(r"Fleet Map Server: (https://\S+)")[1]

        def answers() -> bool:
            try:
                with urllib.request.urlopen(f"{address}/healthz", timeout=60, context=trusting) as answer:
                    return bool(answer.status == 200)
            except ConnectionError:
                return False
            except urllib.error.URLError as error:
                assert isinstance(error.reason, ConnectionError), "it does not listen yet"
                return False

        eventually(answers, 60)
        headers = {"Authorization": "Bearer mounted-as-a-secret"}
        request = urllib.request.Request(f"{address}/api/v1/tokens", headers=headers)
        with urllib.request.urlopen(request, timeout=60, context=trusting) as answer:
            assert [token["role"] for token in json.load(answer)] == ["admin"]
        with pytest.raises(urllib.error.URLError, match="CERTIFICATE_VERIFY_FAILED"):
            urllib.request.urlopen(f"{address}/healthz", timeout=60)
    finally:
        assert process.stop() == 0


def test_unusable_files_prevent_start(tmp_path: Path, offline: Fleetmap) -> None:
    data = ("--data-dir", tmp_path / "data", "--port", "0")
    certificate, key = Authority(tmp_path).sign("server")
    other = Authority(tmp_path / "other").sign("server")[1]
    result = offline("serve", *data, "--tls-certificate", certificate, "--tls-key", other)
    assert result.status == 2
    assert "invalid --tls-certificate or --tls-key" in " ".join(result.err.split())
    result = offline("serve", "--demo", *data, "--tls-certificate", certificate, "--tls-key", key)
    assert result.status == 2
    (tmp_path / "users").write_text("r1\n")
    result = offline("serve", *data, "--zenoh-users", tmp_path / "users")
    assert result.status == 1
    assert "line 1: must be NAME:PASSWORD" in " ".join(result.err.split())


def test_every_setting_is_a_flag_but_secrets(offline: Fleetmap, monkeypatch: pytest.MonkeyPatch) -> None:
    from app.cli.server import NOT_FLAGS
    from app.config import Settings

    assert {"admin_token", "blob_secret_key", "zenoh_password"} == NOT_FLAGS
    monkeypatch.setenv("COLUMNS", "200")
    output = offline("serve", "--help").out
    for name in Settings.model_fields:
        assert (f"--{name.replace('_', '-')} " in output) == (name not in NOT_FLAGS), name


def test_given_token_is_never_printed_and_workers_stop_with_parent_process(tmp_path: Path, offline: Fleetmap) -> None:
    process = start(tmp_path, "--workers", "2", FLEETMAP_ADMIN_TOKEN="given-by-the-operator")
    try:
        address = process.ready()
        result = offline("token", "list", "--server", address, "--token", "given-by-the-operator")
        assert result.status == 0
        assert "given-by-the-operator" not in result.out
        process.process.kill()
        process.process.wait(10)
        process._reader.join(60)  # its output ends when the last worker has closed it
        assert not process._reader.is_alive()
    finally:
        process.stop()
    assert not any("given-by-the-operator" in line for line in process.lines)
    port = int(address.rpartition(":")[2])
    with socket.create_server(("127.0.0.1", port)):
        pass


def test_migrate_brings_a_database_up_and_hides_its_password(offline: Fleetmap, tmp_path: Path) -> None:
    result = offline("migrate", "--data-dir", tmp_path / "data", "--json")
    assert result.status == 0, result.err
    assert result.json["migrated"] is True
    assert (tmp_path / "data" / "fleetmap.sqlite3").is_file()
    assert offline("migrate", "--data-dir", tmp_path / "data").status == 0
    result = offline("migrate", "--database-url", "postgresql+psycopg://me:hidden-word@127.0.0.1:1/none")
    assert result.status == 1
    assert "hidden-word" not in result.err + result.out


@pytest.mark.usefixtures("usual_umask")
@pytest.mark.parametrize(("folder", "file"), [(0o755, 0o600), (0o2775, 0o640)])
def test_existing_data_folder_keeps_its_mode(folder: int, file: int, tmp_path: Path, offline: Fleetmap) -> None:
    """Such as a mounted one. If its group may write there, the database is the group's as far as the umask lets."""
    data = tmp_path / "data"
    data.mkdir()
    data.chmod(folder)
    assert offline("migrate", "--data-dir", data).status == 0
    assert modes(data) == (folder, {file})


def test_database_of_newer_release_is_not_changed(offline: Fleetmap, tmp_path: Path) -> None:
    assert offline("migrate", "--data-dir", tmp_path / "data").status == 0
    with contextlib.closing(sqlite3.connect(tmp_path / "data" / "fleetmap.sqlite3")) as database:
        database.execute("UPDATE alembic_version SET version_num = '9999'")
        database.execute("UPDATE server SET min_compatible = '9998'")
        database.commit()
    for command in ("serve", "migrate"):
        result = offline(command, "--data-dir", tmp_path / "data", *(["--port", "0"] if command == "serve" else []))
        assert result.status == 1
        assert "newer release" in result.err
        assert "Traceback" not in result.err

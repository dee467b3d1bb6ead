"""``fleetmap doctor`` as a command: output, JSON, exit status."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from app.cli import run
from tests.api.conftest import empty_database

CHECKS = ("settings", "database", "disk-limits", "folders", "memory", "secret-files", "stored-data")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FLEETMAP_ZENOH_MODE", "off")
    monkeypatch.setenv("FLEETMAP_MAX_MEMORY_BYTES", "512MiB")
    (tmp_path / "data" / "blobs").mkdir(parents=True)
    (tmp_path / "data" / "fleetmap.sqlite3").write_bytes(empty_database())
    return tmp_path / "data"


def doctor(*arguments: str) -> int:
    only = [word for name in CHECKS for word in ("--only", name)]
    return run(["doctor", *arguments, *([] if "--only" in arguments else only)])


def test_healthy_installation_exits_with_0(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert doctor("--data-dir", str(folder), "--json") == 0
    body = json.loads(capfd.readouterr().out)
    assert (body["ok"], body["errors"]) == (True, 0)
    assert {check["check"] for check in body["checks"]} == set(CHECKS)
    assert all(set(check) == {"check", "level", "detail", "place", "advice"} for check in body["checks"])
    assert doctor() == 0
    lines = capfd.readouterr().out.splitlines()
    assert lines[-1].startswith("0 errors, 0 warnings, ")
    assert any(line.startswith("ok       database: answers: SQLite") for line in lines)


def test_errors_exit_with_1_and_say_what_to_do(
    folder: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FLEETMAP_ADMIN_TOKEN", "short")
    monkeypatch.setenv("FLEETMAP_CACHE_BITES", "1")
    assert doctor() == 1
    captured = capfd.readouterr()
    assert "error    settings: the administrator's token can be guessed (FLEETMAP_ADMIN_TOKEN)" in captured.out
    assert "→ use 32 random characters" in captured.out
    assert "unknown setting FLEETMAP_CACHE_BITES (did you mean FLEETMAP_CACHE_BYTES?)" in captured.out
    assert captured.out.splitlines()[-1].startswith("1 errors, 1 warnings, ")
    assert "short" not in captured.out.replace("short one", "")


def test_contradictory_settings_are_an_error_of_the_installation(
    folder: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("FLEETMAP_TLS_KEY", "server.key")
    assert doctor("--json") == 1
    (check,) = json.loads(capfd.readouterr().out)["checks"]
    assert (check["check"], check["level"]) == ("settings", "error")
    assert "tls_certificate and tls_key must be set together" in check["detail"]


def test_wrong_options_exit_with_2(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert doctor("--only", "disk-spaces") == 2
    assert "did you mean disk-space?" in capfd.readouterr().err
    assert doctor("--nonsense") == 2

"""Settings: read from the environment, checked, documented, passed to workers."""

from __future__ import annotations

import dataclasses
import pickle
from pathlib import Path

import pytest
from pydantic import ValidationError

from app.config import Settings, is_loopback
from app.limits import Limits


@pytest.fixture(autouse=True)
def clean(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    for name in Settings.model_fields:
        monkeypatch.delenv(f"FLEETMAP_{name.upper()}", raising=False)


def test_every_limit_is_a_setting_with_the_same_default() -> None:
    assert Settings().limits == Limits()
    for field in dataclasses.fields(Limits):
        assert f"max_{field.name}" in Settings.model_fields


def test_settings_have_descriptions() -> None:
    for name, field in Settings.model_fields.items():
        assert field.description, name
        assert field.description.endswith("."), name


def test_environment_variables_override_the_env_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / ".env").write_text("FLEETMAP_PORT=9000\nFLEETMAP_MAX_PIXELS=1000\nOTHER=1\n")
    monkeypatch.setenv("FLEETMAP_MAX_PIXELS", "2000")
    settings = Settings()
    assert settings.port == 9000
    assert settings.limits.pixels == 2000


def test_default_paths_are_in_the_data_directory(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path / "x")
    assert settings.database == f"sqlite:///{tmp_path}/x/fleetmap.sqlite3"
    assert settings.blob_dir == tmp_path / "x" / "blobs"
    assert settings.cache_dir.parent == settings.spool_dir.parent == tmp_path / "x"
    assert Settings(blob_url=f"file://{tmp_path}/b%20b").blob_dir == tmp_path / "b b"
    assert Settings(blob_url="elsewhere").blob_dir == Path("elsewhere")


def test_empty_variable_means_none(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("ADMIN_TOKEN", "DATABASE_URL", "BLOB_URL"):
        monkeypatch.setenv(f"FLEETMAP_{name}", "")
    settings = Settings()
    assert settings.admin_token is None
    assert settings.database_url is None
    assert settings.blob_url is None


@pytest.mark.parametrize(
    ("name", "value"),
    [("blob_url", "ftp://bucket"), ("blob_url", "s3:///prefix"), ("port", 70000), ("workers", 0), ("max_pixels", 0)],
)
def test_invalid_settings_are_refused(name: str, value: object) -> None:
    with pytest.raises(ValidationError):
        Settings(**{name: value})  # type: ignore[arg-type]


def test_insecure_mode_requires_loopback() -> None:
    for host in ("127.0.0.1", "::1", "localhost", "127.9.9.9"):
        assert is_loopback(host)
        assert Settings(insecure_no_auth=True, host=host).insecure_no_auth
    for host in ("0.0.0.0", "::", "10.0.0.1", "example.org", ""):
        assert not is_loopback(host)
        with pytest.raises(ValidationError, match="loopback"):
            Settings(insecure_no_auth=True, host=host)


def test_workers_read_the_same_settings(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path, port=8123, admin_token="0123456789abcdef", insecure_no_auth=True)  # type: ignore[arg-type]
    assert pickle.loads(pickle.dumps(settings)) == settings


def test_secrets_are_not_shown() -> None:
    assert "0123456789abcdef" not in repr(Settings(admin_token="0123456789abcdef"))  # type: ignore[arg-type]

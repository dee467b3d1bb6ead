"""``fleetmap mirror`` in this process: once, its state, release, and what it says when something is missing."""

from __future__ import annotations

from pathlib import Path

import pytest

from app.store.store import Store
from tests.api.conftest import Api, create_farm, empty_database
from tests.cli.conftest import Fleetmap, offline
from tests.mirror.conftest import mirror_token

__all__ = ["offline"]


@pytest.fixture
def data(offline: Fleetmap, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Data folder of the edge, named by the environment, which ``offline`` has cleared before."""
    folder = tmp_path / "data"
    folder.mkdir()
    (folder / "fleetmap.sqlite3").write_bytes(empty_database())
    monkeypatch.setenv("FLEETMAP_DATA_DIR", str(folder))
    return folder


def test_mirror_once_status_and_release(centre: Api, data: Path, tmp_path: Path, offline: Fleetmap) -> None:
    farm = create_farm(centre, "commanded")
    token = tmp_path / "token"
    token.write_text(mirror_token(centre) + "\n")
    assert "mirrors no other" in offline("mirror", "--status").err
    key = centre.get("keys").json()[0]["id"]
    once = offline("mirror", centre.url, "--token-file", str(token), "-e", "comm*", "--key", key, "--once")
    assert once.status == 0, once.err
    shown = offline("mirror", "--status", "--json")
    assert shown.json["state"] == "connected"
    assert shown.json["key"] == key
    assert [(one["name"], one["version"], one["problem"]) for one in shown.json["environments"]] == [(farm, 3, None)]
    assert shown.json["serves_until"] is not None
    assert farm in offline("mirror", "--status").out
    assert offline("mirror", "--release", farm, "--json").json == {"environment": farm, "released": True}
    assert "no mirrored environment" in offline("mirror", "--release", farm).err
    store = Store(f"sqlite:///{data}/fleetmap.sqlite3", data / "blobs")
    assert store.environments.update(farm, title="mine").title == "mine"
    store.close()


def test_failed_environment_fails_the_command(centre: Api, data: Path, offline: Fleetmap, tmp_path: Path) -> None:
    farm = create_farm(centre, "taken")
    store = Store(f"sqlite:///{data}/fleetmap.sqlite3", data / "blobs")
    store.environments.create(farm)
    store.close()
    token = tmp_path / "token"
    token.write_text(mirror_token(centre))
    once = offline("mirror", centre.url, "--token-file", str(token), "-e", farm, "--once")
    assert once.status == 1
    assert "of its own" in once.err


def test_missing_arguments_are_named(data: Path, offline: Fleetmap, tmp_path: Path) -> None:
    assert "--role mirror" in offline("mirror", "http://127.0.0.1:1").err
    assert "could not read" in offline("mirror", "http://127.0.0.1:1", "--token-file", str(tmp_path / "no")).err
    assert offline("mirror").status == 2
    (tmp_path / "token").write_text("x")
    refused = offline("mirror", "http://127.0.0.1:1", "--token-file", str(tmp_path / "token"), "--once")
    assert refused.status == 1
    assert "no connection" in refused.err

"""``fleetmap backup`` beside a running server, ``fleetmap restore``, and a robot that is ahead of the backup."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from app.agent.agent import Agent
from app.agent.options import AgentOptions
from app.cli import run
from tests.api import samples
from tests.api.conftest import ADMIN, Api, running, settings_for
from tests.ports import free_port

Output = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Api, Path]]:
    """A running server with two versions."""
    folder = tmp_path_factory.mktemp("site")
    with running(settings_for(folder / "data", port=free_port(), scrub_hours=0)) as api:
        api.post("environments", {"name": "farm"})
        upload(api, 0.0)
        upload(api, 1.0)
        yield api, folder


@pytest.fixture(autouse=True)
def _stays_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """The process of the tests keeps its priority."""
    monkeypatch.setattr("app.cli.backup._stand_back", lambda: None)


def upload(api: Api, moved: float) -> int:
    nodes = {"gate": (0.0, 0.0), "barn": (12.0 + moved, 0.0), "field": (10.0, 8.0)}
    return int(api.upload("farm", {"n.tmap2.yaml": samples.tmap2(nodes)}).json()["version"])


def command(capfd: Output, *arguments: str | Path, status: int = 0) -> Any:
    capfd.readouterr()
    assert run([*map(str, arguments), "--json"]) == status
    return json.loads(capfd.readouterr().out)


def promote(api: Api, version: int) -> None:
    api("PUT", "environments/farm/channels/production", 200, json={"version": version})


def sync(api: Api, into: Path) -> tuple[int, int]:
    """Let an agent sync once; returns the version that it has, and the epoch."""
    agent = Agent(
        AgentOptions(api.url, "farm", ("tmap2",), into, channel="production", robot="r1", token=ADMIN),
        lambda *_, **__: None,
    )
    agent.open()
    try:
        assert agent.run_once()
    finally:
        agent.close()
    manifest = json.loads((into / "current" / "manifest.json").read_text())
    return manifest["version"], manifest.get("epoch", 0)


def test_robot_ahead_of_the_backup_follows_the_restored_server(
    site: tuple[Api, Path], tmp_path: Path, capfd: Output
) -> None:
    api, folder = site
    data, place, restored = folder / "data", tmp_path / "backup", tmp_path / "restored"
    promote(api, 1)
    written = command(capfd, "backup", place, "--keys", "--data-dir", data)
    assert written["damaged"] == []
    metrics = api.get("/metrics").text
    assert "fleetmap_backup_failures 0.0" in metrics
    age = next(float(line.split()[1]) for line in metrics.splitlines() if line.startswith("fleetmap_backup_age"))
    assert 0 <= age < 600
    for version in (2, 1, 2):
        promote(api, version)
    robot = tmp_path / "robot"
    assert sync(api, robot) == (2, 0)
    result = command(capfd, "restore", place, "--data-dir", restored)
    assert result["snapshot"] == written["snapshot"]
    assert result["keys"]
    assert [path.stat().st_mode & 0o77 for path in (restored, restored / "fleetmap.sqlite3")] == [0, 0]
    with running(settings_for(restored, scrub_hours=0)) as other:
        assert other.get("environments/farm/versions/2").json()["root"]
        assert sync(other, robot) == (1, result["epoch"])
        upload(other, 2.0)
        assert "fleetmap_backup_age_seconds +Inf" in other.get("/metrics").text


def test_refused_restore_creates_nothing(site: tuple[Api, Path], tmp_path: Path, capfd: Output) -> None:
    place, target = tmp_path / "backup", tmp_path / "restored"
    command(capfd, "backup", place, "--data-dir", site[1] / "data")
    largest = max(place.glob("packs/*/*"), key=lambda path: path.stat().st_size)
    largest.write_bytes(largest.read_bytes()[:-1])
    assert run(["restore", str(place), "--data-dir", str(target)]) == 1
    assert "not complete" in capfd.readouterr().err
    next(place.glob("snapshots/*")).unlink()
    assert run(["restore", str(place), "--data-dir", str(target)]) == 1
    assert "restore from another copy" in " ".join(capfd.readouterr().err.split())
    assert not target.exists()


def test_list_verify_and_keep(site: tuple[Api, Path], tmp_path: Path, capfd: Output) -> None:
    data, place = site[1] / "data", tmp_path / "backup"
    ids = [command(capfd, "backup", place, "--data-dir", data)["snapshot"] for _ in range(2)]
    listed = command(capfd, "backup", place, "--list")
    assert {b["id"] for b in listed["backups"]} == set(ids)
    assert command(capfd, "backup", place, "--verify")["ok"]
    third = command(capfd, "backup", place, "--data-dir", data, "--keep", "0d")
    assert set(third["removed"]) == set(ids)
    pack = max(place.glob("packs/*/*"), key=lambda path: path.stat().st_size)
    pack.write_bytes(pack.read_bytes()[:-1])
    check = command(capfd, "backup", place, "--verify", status=1)
    assert check["problems"][0]["backups"] == [third["snapshot"]]
    assert "cut off" in check["problems"][0]["problem"]
    assert run(["backup", str(place), "--list"]) == 0
    assert third["snapshot"] in capfd.readouterr().out


def test_restore_of_any_kind_needs_a_place(site: tuple[Api, Path], tmp_path: Path, capfd: Output) -> None:
    data = site[1] / "data"
    assert run(["restore", "--data-dir", str(data)]) == 2
    assert run(["restore", str(tmp_path / "nowhere"), "--data-dir", str(tmp_path / "new")]) == 1
    assert "no such file or folder" in capfd.readouterr().err
    assert not (tmp_path / "new").exists()
    assert run(["backup", str(tmp_path / "place"), "--data-dir", str(tmp_path / "new")]) == 1
    assert "not found" in capfd.readouterr().err
    assert not (tmp_path / "place").exists()


def test_epoch_is_raised_after_a_restore_by_other_means(tmp_path: Path, capfd: Output) -> None:
    with running(settings_for(tmp_path / "data", scrub_hours=0)) as api:
        api.post("environments", {"name": "farm"})
        upload(api, 0.0)
        promote(api, 1)
        assert sync(api, tmp_path / "robot") == (1, 0)
        epoch = command(capfd, "restore", "--raise-epoch", "--data-dir", tmp_path / "data")["epoch"]
        promote(api, 1)
        answer = api.get("environments/farm/versions/production/manifest?formats=tmap2").json()
        assert answer["epoch"] == epoch
        assert sync(api, tmp_path / "robot")[0] == 1


def test_nightly_unit_runs_the_command(site: tuple[Api, Path], tmp_path: Path, capfd: Output) -> None:
    docker = Path(__file__).parents[2] / "docker"
    unit = (docker / "fleetmap-backup.service").read_text()
    words = unit.partition("ExecStart=")[2].partition("\n")[0].split()
    assert words[0].endswith("/fleetmap")
    values = {"${DESTINATION}": [str(tmp_path / "backup")], "${KEEP}": ["7d/90d/2y"], "$OPTIONS": ["--keys"]}
    arguments = [value for word in words[1:] for value in values.get(word, [word])]
    assert command(capfd, *arguments, "--data-dir", site[1] / "data")["keys"]
    assert "EnvironmentFile=/etc/fleetmap/backup.env" in unit
    assert "OnCalendar=" in (docker / "fleetmap-backup.timer").read_text()

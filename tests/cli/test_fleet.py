"""Commands for environments, channels, robots, overlays, events, jobs and keys against a running server."""

from __future__ import annotations

import json
import subprocess
import sys
import urllib.request
from pathlib import Path
from typing import Any

import pytest

from tests.cli.conftest import TOKEN, Fleetmap
from tests.cli.test_commands import NETWORK


@pytest.fixture
def network(tmp_path: Path) -> Path:
    path = tmp_path / "network.tmap2.yaml"
    path.write_text(NETWORK.format(x="1.0"))
    return path


def post_status(server: str, robot: str, body: dict[str, Any]) -> None:
    request = urllib.request.Request(
        f"{server}/api/v1/robots/{robot}/status",
        data=json.dumps(body).encode(),
        headers={"Authorization": f"Bearer {TOKEN}", "Content-Type": "application/json"},
        method="PUT",
    )
    with urllib.request.urlopen(request) as answer:
        assert answer.status == 200


def test_environment_create_rename_delete_and_purge(fleetmap: Fleetmap) -> None:
    result = fleetmap("environment", "create", "life", "--datum", "53.25,-0.5", "--title", "A life", "--tag", "x")
    assert (result.status, result.out) == (0, "life: created, version 1\n"), result.err
    assert fleetmap("environment", "create", "life").status == 1
    listed = {row["name"]: row for row in fleetmap("environment", "list", "--json").json}
    assert listed["life"]["title"] == "A life"
    assert [row["name"] for row in fleetmap("environments", "-q", "A life", "--json").json] == ["life"]
    shown = fleetmap("environment", "show", "life").out
    assert "53.25, -0.5" in shown
    assert "newest version" in shown
    assert "53.3, -0.5, heading 12.5°" in fleetmap("environment", "datum", "life", "53.3,-0.5,12.5").out
    assert fleetmap("environment", "datum", "life", "--json").json["heading"] == 12.5
    assert "renamed to life-2" in fleetmap("environment", "rename", "life", "life-2").out
    assert fleetmap("environment", "rename", "life-2").status == 2
    assert (
        fleetmap("environment", "create", "life-3", "--clone", "life-2@1", "--json").json["datum"]["latitude"] == 53.25
    )
    assert fleetmap("environment", "delete", "life-2").status == 0
    refusal = fleetmap("environment", "show", "life-2")
    assert refusal.status == 1
    assert "environment restore" in refusal.err
    assert "life-2" in fleetmap("environment", "list", "--deleted").out
    assert fleetmap("environment", "restore", "life-2", "--json").json["version"] == 2
    assert fleetmap("environment", "purge", "life-2", "--yes").status == 1, "only what is deleted"
    assert fleetmap("environment", "delete", "life-2", "--json").json["deleted"] is True
    assert "removed permanently" in fleetmap("environment", "purge", "life-2", "--yes").out
    assert "life-2" not in fleetmap("environment", "list", "--deleted").out


def test_channels_and_robots(fleetmap: Fleetmap, server: str, network: Path) -> None:
    assert fleetmap("import", network, "-e", "manned").status == 0
    assert fleetmap("promote", "manned", "1").status == 0
    row = fleetmap("channels", "show", "manned", "production", "--json").json
    status = {"environment": "manned", "channel": "production", "version": 1, "root": row["root"], "state": "active"}
    post_status(server, "mower-3", status)
    result = fleetmap("channels", "manned")
    assert "1 of 1" in result.out, "a group without a command lists"
    assert {row["channel"] for row in fleetmap("channels", "list", "manned", "--json").json} == {"latest", "production"}
    assert "version" in fleetmap("channels", "show", "manned", "production").out
    assert fleetmap("promote", "manned", "1", "--at", "2099-01-31T06:00:00Z", "-c", "staging").status == 0
    assert "2099-01-31 06:00" in fleetmap("channels", "manned").out
    assert "cancelled the planned move" in fleetmap("channels", "cancel", "manned", "staging").out
    assert [row["robot"] for row in fleetmap("robots", "-e", "manned", "--json").json] == ["mower-3"]
    assert "mower-3" in fleetmap("robots").out
    shown = fleetmap("robots", "show", "mower-3")
    assert "manned" in shown.out
    assert len(fleetmap("robot", "show", "mower-3", "--json").json["history"]) == 1
    assert fleetmap("robots", "forget", "mower-3", "-e", "manned").status == 0
    assert fleetmap("robots", "-e", "manned", "--json").json == []


def test_overlays_are_reported_and_decided(fleetmap: Fleetmap, network: Path, tmp_path: Path) -> None:
    assert fleetmap("import", network, "-e", "blocked").status == 0
    overlay = fleetmap("overlays", "create", "blocked", "--edge", "A_B", "--detail", "fallen tree", "--json").json
    assert (overlay["state"], overlay["edge"]) == ("pending", "A_B")
    assert "fallen tree" in fleetmap("overlays", "list", "blocked").out
    assert fleetmap("overlays", "show", "blocked", overlay["id"], "--json").json == overlay
    assert "edge A_B" in fleetmap("overlays", "show", "blocked", overlay["id"]).out
    assert "is in force until" in fleetmap("overlays", "accept", "blocked", overlay["id"]).out
    assert [row["id"] for row in fleetmap("overlays", "blocked", "--state", "accepted", "--json").json] == [
        overlay["id"]
    ]
    assert fleetmap("overlays", "keep", "blocked", overlay["id"], "--json").json["version"] == 2
    assert "has ended" in fleetmap("overlays", "end", "blocked", overlay["id"]).out
    area = tmp_path / "area.geojson"
    ring = [[0, 0], [1, 0], [1, 1], [0, 0]]
    area.write_text(json.dumps({"type": "Feature", "geometry": {"type": "Polygon", "coordinates": [ring]}}))
    result = fleetmap(
        "overlays", "create", "blocked", "--polygon", area, "--crs", "local", "--accept", "--seconds", "60"
    )
    assert "(area) is in force until" in result.out, result.err
    pending = fleetmap("overlays", "create", "blocked", "--polygon", area, "--crs", "local", "--json").json
    if pending["state"] == "pending":
        assert "is rejected" in fleetmap("overlays", "reject", "blocked", pending["id"]).out
    assert fleetmap("overlays", "create", "blocked").status == 2
    area.write_text("{}")
    assert "no polygon" in fleetmap("overlays", "create", "blocked", "--polygon", area).err
    assert fleetmap("overlays", "show", "blocked", "nonsense").status == 1


def test_jobs_and_keys(fleetmap: Fleetmap) -> None:
    assert fleetmap("jobs", "--json").json == []
    assert fleetmap("jobs", "list", "--state", "running").status == 0
    missing = fleetmap("jobs", "show", "nonsense")
    assert (missing.status, missing.out) == (1, "")
    assert fleetmap("jobs", "cancel", "nonsense").status == 1
    before = fleetmap("keys", "--json").json
    assert fleetmap("keys", "show").out.strip() == before[0]["public_key"]
    key = fleetmap("keys", "rotate", "--yes", "--json").json
    after = fleetmap("keys", "list", "--json").json
    assert after[0]["id"] == key["id"] != before[0]["id"]
    assert fleetmap("keys", "show", before[0]["id"], "--json").json["public_key"] == before[0]["public_key"]
    assert fleetmap("keys", "show", "nonsense").status == 1


def test_json_option_is_accepted_before_or_after_command(fleetmap: Fleetmap, network: Path) -> None:
    assert fleetmap("import", network, "-e", "either").status == 0
    expected = fleetmap("channels", "list", "either", "--json").json
    for arguments in (
        ("--json", "channels", "list", "either"),
        ("channels", "--json", "list", "either"),
        ("channels", "--json", "either"),
        ("--json", "channels", "either"),
    ):
        assert fleetmap(*arguments).json == expected, arguments
    assert fleetmap("--json", "versions", "either").json[0]["version"] == 1
    refused = fleetmap("--json", "versions", "no-such-place")
    assert json.loads(refused.err)["status"] == 404
    assert fleetmap("--json", "serve").status == 2, "no command ignores it"


def test_events_are_listed_and_followed(fleetmap: Fleetmap, server: str, network: Path) -> None:
    assert fleetmap("import", network, "-e", "eventful").status == 0
    result = fleetmap("events", "-e", "eventful")
    assert "eventful" in result.out, result.err
    lines = [json.loads(line) for line in fleetmap("events", "-e", "eventful", "--json").out.splitlines()]
    assert [event["id"] for event in lines] == sorted(event["id"] for event in lines)
    assert fleetmap("events", "-e", "eventful", "--since", str(lines[-1]["id"])).out == ""
    assert len(fleetmap("events", "-e", "eventful", "-n", "1", "--json").out.splitlines()) == 1
    command = [sys.executable, "-m", "app.cli", "events", "-f", "-n", "1", "-e", "eventful", "--json", "-s", server]
    with subprocess.Popen([*command, "-t", TOKEN], stdout=subprocess.PIPE, text=True) as follower:
        assert follower.stdout is not None
        try:
            assert json.loads(follower.stdout.readline())["id"] == lines[-1]["id"]
            assert fleetmap("promote", "eventful", "1").status == 0
            event = json.loads(follower.stdout.readline())
            assert (event["id"], event["data"]["environment"]) == (lines[-1]["id"] + 1, "eventful")
        finally:
            follower.terminate()


def test_diff_starts_with_a_summary(fleetmap: Fleetmap, network: Path) -> None:
    assert fleetmap("import", network, "-e", "differing", "--datum", "53.25,-0.5").status == 0
    network.write_text(network.read_text().replace("x: 1.0", "x: 1.5"))
    assert fleetmap("import", network, "-e", "differing").status == 0
    lines = fleetmap("diff", "differing", "1", "3").out.splitlines()
    assert lines[0] == "versions 1 → 3: topology 3 added"
    assert lines[1].startswith("+ topology ")
    lines = fleetmap("diff", "differing", "2", "3").out.splitlines()
    assert lines[0] == "versions 2 → 3: topology 2 changed"
    assert set(fleetmap("diff", "differing", "2", "3", "--json").json) == {"from", "to", "layers"}


def test_export_prints_paths_and_reports_on_request(fleetmap: Fleetmap, network: Path, tmp_path: Path) -> None:
    assert fleetmap("import", network, "-e", "quiet").status == 0
    path = tmp_path / "out.tmap2.yaml"
    result = fleetmap("export", "quiet", "tmap2", "-o", path)
    assert (result.status, result.out, result.err) == (0, f"{path}\n", "")
    result = fleetmap("export", "quiet", "tmap2", "-o", path, "-v")
    assert result.out == f"{path}\n"
    assert "topology" in result.err


def test_one_format_is_described(offline: Fleetmap, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    output = offline("formats", "occupancy_grid").out
    assert "map.yaml, map.pgm" in output
    for line in ("resolution  number, 0.001 to 1000  m", "file_type   pgm, png", "free_thresh      number, 0 to 1"):
        assert line in output
    assert offline("formats", "tmap2", "--json").json["id"] == "tmap2"

"""A robot follows its channel: first sync, events, deltas, hooks, offline."""

from __future__ import annotations

import json
import subprocess
import time
from pathlib import Path

from tests.agent.conftest import Gate, Robot, Start, network, whole
from tests.api import samples
from tests.api.conftest import Api
from tests.events.conftest import eventually


def test_first_sync_installs_map(api: Api, place: str, robot: Start) -> None:
    api.upload(place, samples.grid())
    one = robot("--once", formats="tmap2,occupancy_grid")
    assert one.end() == 0, one.lines
    manifest = one.standing
    assert (manifest["version"], manifest["channel"]) == (2, "latest")
    assert one.saw("following", channel="latest")
    for file in manifest["files"]:
        path = f"/maps/{place}/{file['format']}/{file['name']}"
        assert one.file(f"{file['format']}/{file['name']}") == api.get(path).content
    again = robot("--once", formats="tmap2,occupancy_grid")
    assert again.end() == 0
    assert again.saw("switched") is None, "nothing changed"


def test_event_triggers_sync_with_delta_within_seconds(api: Api, place: str, robot: Start) -> None:
    one = robot("--poll", "3600")
    one.wait("active", version=1)
    one.wait("connected")
    before = one.file()
    begun = time.monotonic()
    api.upload(place, {"n.tmap2.yaml": network(0.25)})
    switched = one.wait("switched", version=2)
    took = time.monotonic() - begun
    assert took < 60, f"{took:.1f} s: with polls only it would be half an hour"
    assert one.file() == api.get(f"/maps/{place}/tmap2/network.tmap2.yaml").content != before
    assert switched["deltas"] == 1
    assert switched["bytes"] < 1500 < len(before) / 50, "the manifest and the delta"
    assert one.stop() == 0


def test_unchanged_files_are_linked_and_old_versions_go(api: Api, place: str, robot: Start) -> None:
    api.upload(place, samples.grid())
    formats = "tmap2,occupancy_grid"
    first = robot("--once", formats=formats)
    assert first.end() == 0
    grid = first.into / "current" / "occupancy_grid" / "map.pgm"
    inode = grid.stat().st_ino
    for moved in (1, 2, 3, 4):
        api.upload(place, {"n.tmap2.yaml": network(moved)})
        assert robot("--once", formats=formats).end() == 0
    assert grid.stat().st_ino == inode
    names = sorted(p.name.split("-")[0] for p in (first.into / "versions").iterdir())
    assert names == ["4", "5", "6"]
    assert list((first.into / "partial").iterdir()) == []


def test_production_goes_first_and_a_rollback_is_followed(api: Api, place: str, robot: Start) -> None:
    one = robot("--poll", "3600")
    one.wait("active", version=1)
    one.wait("connected")
    api.upload(place, {"n.tmap2.yaml": network(1)})
    one.wait("active", version=2, channel="latest")
    api("PUT", f"environments/{place}/channels/production", 200, json={"version": 2})
    one.wait("active", version=2, channel="production")
    count = len(one.lines)
    api("PUT", f"environments/{place}/channels/production", 200, json={"version": 1})
    one.wait("active", after=count, version=1, channel="production")
    assert one.standing["version"] == 1
    assert one.standing["sequence"] == 5
    api.upload(place, {"n.tmap2.yaml": network(2)})  # latest is not of its concern any more
    time.sleep(1)
    assert one.standing["version"] == 1
    assert one.stop() == 0


def test_planned_move_is_preloaded(api: Api, place: str, robot: Start) -> None:
    api("PUT", f"environments/{place}/channels/production", 200, json={"version": 1})
    api.upload(place, {"n.tmap2.yaml": network(1)})
    one = robot("--poll", "3600")
    one.wait("active", version=1)
    one.wait("connected")
    at = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime(time.time() + 6))
    api("PUT", f"environments/{place}/channels/production", 200, json={"version": 2, "activate_at": at})
    one.wait("ready", version=2)
    assert one.standing["version"] == 1
    switched = one.wait("switched", version=2)
    assert switched["bytes"] < 1500, "the manifest only"
    assert one.stop() == 0


def test_missing_channel_is_reported(api: Api, place: str, robot: Start) -> None:
    one = robot("--once", "--channel", "staging")
    assert one.end() == 1
    assert "staging" in one.wait("failed")["detail"]


def test_offline_start_keeps_the_map(api: Api, place: str, robot: Start, gate: Gate) -> None:
    assert robot("--once", server=gate.url).end() == 0
    gate.open = False
    one = robot("--poll", "1", server=gate.url)
    one.wait("holding", version=1)
    assert "no response" in one.wait("failed")["detail"]
    assert whole(one.into)["version"] == 1
    api.upload(place, {"n.tmap2.yaml": network(1)})
    gate.open = True
    one.wait("active", version=2)
    assert one.stop() == 0


def test_damaged_file_is_fetched_again(api: Api, place: str, robot: Start) -> None:
    one = robot("--once")
    assert one.end() == 0
    path = one.into / "current" / "tmap2" / "network.tmap2.yaml"
    path.chmod(0o644)
    path.write_bytes(b"x" + path.read_bytes()[1:])
    again = robot("--once")
    assert again.end() == 0
    assert again.saw("damaged", version=1)
    assert whole(one.into)["version"] == 1


def test_other_formats_are_another_folder(api: Api, place: str, robot: Start) -> None:
    assert robot("--once").end() == 0
    one = robot("--once", formats="tmap2,navgraph")
    assert one.end() == 0
    assert {f["format"] for f in one.standing["files"]} == {"tmap2", "navgraph"}


def test_one_folder_has_one_agent_and_one_environment(api: Api, place: str, robot: Start) -> None:
    one = robot("--poll", "3600")
    one.wait("active")
    other = robot("--once")
    assert other.end() == 1
    assert "another agent" in str(other.lines)
    assert one.stop() == 0
    other = robot("--once", env="elsewhere")
    assert other.end() == 1
    assert "elsewhere" in str(other.lines)
    assert "use one directory for each environment" in str(other.lines)


def test_hook_gets_changed_files(api: Api, place: str, robot: Start, tmp_path: Path) -> None:
    file = tmp_path / "told"
    command = f'env | grep ^FLEETMAP_ > {file}.new; cat "$FLEETMAP_CURRENT"/tmap2/* > /dev/null && mv {file}.new {file}'
    one = robot("--poll", "3600", "--on-change", command)
    one.wait("hook", version=1)
    one.wait("connected")
    api.upload(place, {"n.tmap2.yaml": network(1)})
    one.wait("hook", version=2)
    output = file.read_text()
    assert f"FLEETMAP_ENVIRONMENT={place}\n" in output
    assert "FLEETMAP_VERSION=2\n" in output
    assert f"FLEETMAP_ROOT={one.standing['root']}\n" in output
    assert "FLEETMAP_CHANNEL=latest\n" in output
    assert f"FLEETMAP_CURRENT={one.into}/current\n" in output
    assert "FLEETMAP_CHANGED=tmap2/network.tmap2.yaml\n" in output
    assert "FLEETMAP_LAYERS=topology\n" in output
    assert one.stop() == 0


def test_changed_layers_come_from_manifest_without_event(api: Api, place: str, robot: Start, tmp_path: Path) -> None:
    command = f"echo $FLEETMAP_LAYERS > {tmp_path}/layers"
    assert robot("--once", "--on-change", command).end() == 0
    api.upload(place, {"n.tmap2.yaml": network(1)})
    api.upload(place, samples.grid())
    assert robot("--once", "--on-change", command).end() == 0
    assert (tmp_path / "layers").read_text() == "occupancy topology\n"


def test_failing_hook_is_reported_and_retried(api: Api, place: str, robot: Start, tmp_path: Path) -> None:
    one = robot("--poll", "1", "--on-change", f"test -e {tmp_path}/fine || {{ echo no ROS here; exit 3; }}")
    detail = one.wait("failed")["detail"]
    assert "exited with status 3: no ROS here" in detail
    assert one.standing["version"] == 1
    (tmp_path / "fine").touch()
    one.wait("active", version=1)
    assert one.stop() == 0


def test_environment_sh_lists_installed_files(api: Api, place: str, robot: Start) -> None:
    api.upload(place, samples.grid())
    one = robot("--once", formats="tmap2,occupancy_grid")
    assert one.end() == 0
    script = 'set -eu; . "$1"; echo "$TMAP_FILE|$COSTMAP_YAML_FILE|$DATUM_FILE|$FLEETMAP_VERSION"'
    output = subprocess.run(
        ["sh", "-c", script, "sh", one.into / "current" / "environment.sh"], capture_output=True, text=True, check=True
    ).stdout
    current = one.into / "current"
    assert output == f"{current}/tmap2/network.tmap2.yaml|{current}/occupancy_grid/map.yaml||2\n"


def test_environment_sh_contains_environment_variables(api: Api, place: str, robot: Start) -> None:
    properties = b"export FARM_NAME='It'\\''s a \"yard\"; $(touch x)'\nexport FIELD_ID=p1\n"
    properties += b"export TMAP_FILE=/nowhere\nexport LD_PRELOAD=/x\n"
    api.upload(place, {"config/properties.sh": properties, "config/topological/n.tmap2.yaml": network(1)})
    one = robot("--once")
    assert one.end() == 0

    def sourced() -> list[str]:
        script = 'set -eu; . "$1"; printf "%s\\n" "$FARM_NAME" "$FIELD_ID" "$FIELD_TYPE" "$TMAP_FILE" "${LD_PRELOAD:-}"'
        command = ["sh", "-c", script, "sh", one.into / "current" / "environment.sh"]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.split("\n")

    file = str(one.into / "current" / "tmap2" / "network.tmap2.yaml")
    assert sourced() == ['It\'s a "yard"; $(touch x)', "p1", "", file, "", ""]
    api.upload(place, {"config/properties.sh": properties.replace(b"p1", b"p2")})
    assert robot("--once").end() == 0
    assert sourced()[1] == "p2"
    api.post(f"environments/{place}/versions", {"revert_to": 1})
    assert robot("--once").end() == 0
    assert sourced() == ["", "", "", file, "", ""], "nothing stale"


def test_two_robots_hold_the_same_root(api: Api, place: str, robot: Start) -> None:
    robots: list[Robot] = [robot("--poll", "3600", name=f"robot-{k}") for k in (1, 2)]
    for one in robots:
        one.wait("connected")
        one.wait("active", version=1)
    for moved in range(1, 6):
        api.upload(place, {"n.tmap2.yaml": network(moved)})
    for one in robots:
        one.wait("active", version=6)
    assert len({json.dumps(one.standing["files"]) + one.standing["root"] for one in robots}) == 1
    robot_rows = api.get(f"robots?environment={place}").json()
    assert {r["robot"] for r in robot_rows} == {"robot-1", "robot-2"}

    def agree() -> bool:
        robots = api.get(f"environments/{place}/channels").json()[0]["robots"]
        return bool(robots["holding"] == robots["total"] == robots["online"] == 2 and robots["since"])

    eventually(agree)
    for one in robots:
        assert one.stop() == 0


def test_rollout_waits_until_robot_is_ready(api: Api, place: str, robot: Start) -> None:
    api("PUT", f"environments/{place}/channels/production", 200, json={"version": 1})
    api.upload(place, {"n.tmap2.yaml": network(1)})
    one = robot("--poll", "3600")
    one.wait("active", version=1)
    one.wait("connected")
    body = {"version": 2, "rollout": {"ready": 1.0, "failed": 0.5}}
    api("PUT", f"environments/{place}/channels/production", 200, json=body)
    one.wait("ready", version=2)
    one.wait("active", version=2)
    assert one.standing["version"] == 2
    assert one.stop() == 0


def test_failing_robot_rolls_channel_back(api: Api, place: str, robot: Start) -> None:
    api("PUT", f"environments/{place}/channels/production", 200, json={"version": 1})
    api.upload(place, {"n.tmap2.yaml": network(1)})
    one = robot("--poll", "3600", "--on-change", "test $FLEETMAP_VERSION = 1")
    one.wait("active", version=1)
    one.wait("connected")
    count = len(one.lines)
    body = {"version": 2, "rollout": {"ready": 1.0, "failed": 0.5}}
    api("PUT", f"environments/{place}/channels/production", 200, json=body)
    one.wait("failed", after=count)
    one.wait("active", after=count, version=1)
    assert one.standing["version"] == 1
    assert one.standing["sequence"] > 4
    assert one.stop() == 0


def test_robot_token_suffices_for_agent(api: Api, place: str, robot: Start) -> None:
    token = api.post("tokens", {"name": "r", "role": "robot", "robot": "robot", "environments": place}).json()
    one = robot("--once", "--on-change", "true", FLEETMAP_TOKEN=token["token"])
    assert one.end() == 0, one.lines
    assert one.saw("status") is None
    assert api.get(f"robots/robot?environment={place}").json()["state"] == "active"
    api.upload(place, {"n.tmap2.yaml": network(1)})
    again = robot("--once", "--on-change", "true", FLEETMAP_TOKEN=token["token"])
    assert again.end() == 0
    assert again.saw("layers") is None
    wrong = robot("--once", name="wrong", FLEETMAP_TOKEN="nonsense")
    assert wrong.end() == 1
    assert "FLEETMAP_TOKEN" in str(wrong.saw("failed"))

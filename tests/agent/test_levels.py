"""The whole site: formats with parameters, optional formats, and the level that a robot is on."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from app.agent.activation import hook_variables
from app.agent.levels import load_level
from app.agent.requests import FormatRequest, encode_entries, parse_formats, parse_requests
from app.errors import Conflict, Invalid, NotFound, Unavailable
from tests.agent.conftest import ROOT, whole
from tests.agent.fake import Fake, One
from tests.events.conftest import eventually

SITE = {
    "occupancy_grid/map.yaml": b"map",
    "occupancy_grid/map.pgm": b"cells",
    "occupancy_grid/keepout.yaml": b"mask",
    "occupancy_grid/L2/map.yaml": b"map 2",
    "occupancy_grid/L2/map.pgm": b"cells 2",
    "tmap2/network.tmap2.yaml": b"network",
}
LEVELS = {path: "L2" if "/L2/" in path else "ground" for path in SITE if path.startswith("occupancy")}

Robot = Callable[..., One]


@pytest.fixture
def fake(tmp_path: Path) -> Iterator[Fake]:
    server = Fake(tmp_path / "keys")
    server.put(SITE)
    server.levels = LEVELS
    yield server
    server.close()


@pytest.fixture
def robot(fake: Fake, tmp_path: Path) -> Robot:
    def make(*on_change: str, **more: Any) -> One:
        return One(fake, tmp_path / "robot", *on_change, **{"formats": ("occupancy_grid", "tmap2"), **more})

    return make


def load(into: Path, level: str, **more: Any) -> list[dict[str, Any]]:
    lines: list[dict[str, Any]] = []
    load_level(into, level, hook_variables, lambda event, **members: lines.append({"event": event, **members}), **more)
    return lines


# --- formats ---


def test_formats_with_parameters_are_parsed() -> None:
    entries = parse_formats("occupancy_grid?level=L2&grid=map, tmap2,,osm?a=x%2Cy%26z")
    assert entries == ("occupancy_grid?level=L2&grid=map", "tmap2", "osm?a=x%2Cy%26z")
    requests = parse_requests(entries, ())
    assert requests == (
        FormatRequest("occupancy_grid", (("level", "L2"), ("grid", "map"))),
        FormatRequest("tmap2"),
        FormatRequest("osm", (("a", "x,y&z"),)),
    )
    assert encode_entries(requests[:2]) == "occupancy_grid%3Flevel%3DL2%26grid%3Dmap,tmap2"
    assert encode_entries(requests[2:]) == "osm%3Fa%3Dx%252Cy%2526z", "encoded once more"


@pytest.mark.parametrize("entries", [("kml", "kml?a=b"), ("../x",), ("kml?a",), ("?a=b",), ("KML",)])
def test_invalid_formats_are_refused(entries: tuple[str, ...]) -> None:
    with pytest.raises(Invalid):
        parse_requests(entries, ())
    with pytest.raises(Invalid):
        parse_requests(entries[:1], entries)


def test_parameters_are_part_of_each_address(fake: Fake, robot: Robot) -> None:
    fake.closures = []
    assert robot(formats=("occupancy_grid?level=*&grid=a,b", "tmap2")).once()
    manifest = next(path for path in fake.asked if "/manifest" in path)
    assert manifest.endswith("?formats=occupancy_grid%3Flevel%3D%252A%26grid%3Da%252Cb,tmap2")
    files = [path.partition("/maps/")[2] for path in fake.asked if "/maps/" in path]
    assert "occupancy_grid/L2/map.yaml?level=%2A&grid=a%2Cb&closures=apply" in files
    assert "tmap2/network.tmap2.yaml?closures=apply" in files
    fake.asked.clear()
    assert robot(formats=("occupancy_grid", "tmap2")).once()
    assert fake.asked[-1].endswith("manifest?formats=occupancy_grid,tmap2"), "other parameters are another map"


def test_optional_format_that_is_missing_is_reported(fake: Fake, robot: Robot) -> None:
    fake.more = {"missing": [{"format": "kml", "detail": "needs a datum"}]}
    one = robot(optional=("kml", "lif"))
    assert one.once()
    assert "&optional=kml,lif" in next(path for path in fake.asked if "/manifest" in path)
    assert fake.statuses[-1]["state"] == "active"
    assert fake.statuses[-1]["detail"] == "missing optional formats: kml (needs a datum), lif"
    fake.more = {}
    fake.put({**SITE, "kml/map.kml": b"k"})
    one = robot(optional=("kml",))
    assert one.once()
    assert "detail" not in fake.statuses[-1]
    assert (one.into / "current" / "kml" / "map.kml").exists()
    one = robot()
    assert not one.once()
    assert "unexpected kml" in one.detail, "a format that was not requested is refused"


def test_required_format_that_is_missing_refuses_the_version(fake: Fake, robot: Robot) -> None:
    assert robot().once()
    fake.put(SITE)
    fake.more = {"missing": [{"format": "tmap2", "detail": "there is no network"}]}
    one = robot()
    assert not one.once()
    assert "required format tmap2 is not available: there is no network" in one.detail
    assert whole(one.into)["version"] == 1


# --- levels ---


def test_levels_are_listed_with_their_files(robot: Robot) -> None:
    one = robot()
    assert one.once()
    assert json.loads((one.into / "current" / "levels.json").read_text()) == {
        "levels": [
            {"name": "L2", "elevation": 0.0, "files": {"occupancy_grid": ["L2/map.pgm", "L2/map.yaml"]}},
            {"name": "ground", "elevation": 3.5, "files": {"occupancy_grid": ["keepout.yaml", "map.pgm", "map.yaml"]}},
        ]
    }


def test_environment_sh_has_masks_and_levels(robot: Robot) -> None:
    one = robot()
    assert one.once()
    names = ("NOGO_COSTMAP_YAML_FILE", "COSTMAP_YAML_FILE", "COSTMAP_YAML_FILE_L2", "FLEETMAP_LEVELS_FILE")
    script = f'. "$1"; printf "%s\\n" {" ".join(f"${name}" for name in names)}'
    command = ["sh", "-uc", script, "sh", one.into / "current" / "environment.sh"]
    current = one.into / "current"
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines() == [
        f"{current}/occupancy_grid/keepout.yaml",
        f"{current}/occupancy_grid/map.yaml",
        f"{current}/occupancy_grid/L2/map.yaml",
        f"{current}/levels.json",
    ]


@pytest.mark.parametrize(
    "levels",
    [
        [{"name": "L2", "elevation": 0.0}],
        [{"name": "ground", "elevation": 0.0}, {"name": "L2", "elevation": "x"}],
        [{"name": "ground", "elevation": 0.0}, {"name": "L2", "elevation": float("nan")}],
        [{"name": "ground", "elevation": 0.0}, {"name": "L2", "elevation": 0.0}, {"name": "L2", "elevation": 1.0}],
        [{"name": "ground", "elevation": 0.0}, {"name": "L2\n", "elevation": 0.0}],
        [7],
    ],
)
def test_invalid_levels_are_refused(fake: Fake, robot: Robot, levels: list[Any]) -> None:
    fake.more = {"levels": levels}
    one = robot()
    assert not one.once()
    assert "invalid manifest" in one.detail


def test_agent_level_loads_a_level_and_remembers_it(fake: Fake, robot: Robot, tmp_path: Path) -> None:
    hook = f'printf "%s|%s|%s\\n" "$FLEETMAP_LEVEL" "$FLEETMAP_LEVEL_FOLDER" "$FLEETMAP_CHANGED" > {tmp_path}/taken'
    one = robot(hook)
    assert one.once()
    assert (tmp_path / "taken").read_text().startswith("||"), "no level was chosen"
    lines = load(one.into, "L2")
    assert lines[-1] == {"event": "level", "level": "L2", "version": 1}
    assert (tmp_path / "taken").read_text() == "L2|L2|occupancy_grid/L2/map.pgm\noccupancy_grid/L2/map.yaml\n"
    assert (one.into / "level").read_text() == "L2\n"
    fake.put({**SITE, "tmap2/network.tmap2.yaml": b"other"})
    assert robot(hook).once()
    assert (tmp_path / "taken").read_text() == "L2|L2|tmap2/network.tmap2.yaml\n"
    load(one.into, "ground")
    assert (tmp_path / "taken").read_text().startswith("ground||")


def test_level_before_is_loaded_again_if_another_cannot_be(robot: Robot, tmp_path: Path) -> None:
    """One command may have loaded its part of the new level when the next one fails."""
    first = f'echo "$FLEETMAP_LEVEL" >> {tmp_path}/loaded'
    one = robot(first, f'test ! -e {tmp_path}/bad -o "$FLEETMAP_LEVEL" != L2')
    assert one.once()
    (tmp_path / "bad").touch()
    with pytest.raises(Unavailable, match=r"could not load level L2: .*; the default level is loaded again"):
        load(one.into, "L2")
    assert (tmp_path / "loaded").read_text().split("\n") == ["", "L2", "", ""]
    load(one.into, "ground")
    with pytest.raises(Unavailable, match=r"could not load level L2: .*; level ground is loaded again"):
        load(one.into, "L2")
    assert (tmp_path / "loaded").read_text().split() == ["L2", "ground", "L2", "ground"]
    assert (one.into / "level").read_text() == "ground\n"


def test_robot_follows_a_map_with_renamed_levels(fake: Fake, robot: Robot, tmp_path: Path) -> None:
    hook = f'echo "$FLEETMAP_LEVEL" >> {tmp_path}/loaded; test ! -e {tmp_path}/bad -o "$FLEETMAP_LEVEL" != new-L2'
    one = robot(hook)
    assert one.once()
    with pytest.raises(Conflict, match="the robot is on the default level"):
        load(one.into, "new-L2", for_next_map=True)
    load(one.into, "L2")
    fake.levels = {path: f"new-{level}" for path, level in LEVELS.items()}
    fake.put({path: data + b"\n" for path, data in SITE.items()})
    assert not robot(hook).once()
    with pytest.raises(Conflict, match="the current map has a level ground"):
        load(one.into, "ground", for_next_map=True)
    stored = load(one.into, "new-L2", for_next_map=True)
    assert stored == [{"event": "level", "level": "L2", "next": "new-L2", "version": 1}]
    (tmp_path / "bad").touch()
    failed = robot(hook)
    assert not failed.once()
    assert "version 1 is restored" in failed.detail, "by the name that it has there"
    (tmp_path / "bad").unlink()
    assert robot(hook).once()
    assert (tmp_path / "loaded").read_text().splitlines() == ["", "L2", "new-L2", "L2", "new-L2"]
    load(one.into, "new-ground")
    assert (one.into / "level").read_text() == "new-ground\n"


def test_agent_level_refuses_what_it_cannot_load(fake: Fake, robot: Robot, tmp_path: Path) -> None:
    with pytest.raises(Conflict, match="no agent has run"):
        load(tmp_path / "robot", "L2")
    one = robot(f"test ! -e {tmp_path}/bad")
    assert one.once()
    with pytest.raises(NotFound, match=r"unknown level 'L3': choose one of L2, ground"):
        load(one.into, "L3")
    load(one.into, "L2")
    (tmp_path / "bad").touch()
    with pytest.raises(Unavailable, match="could not load level ground"):
        load(one.into, "ground")
    assert (one.into / "level").read_text() == "L2\n", "the robot is still on this one"
    (one.into / "hooks.json").write_text("[")
    with pytest.raises(Invalid, match="restart the agent"):
        load(one.into, "L2")
    (one.into / "current").unlink()
    (tmp_path / "bad").unlink()
    fake.instead = lambda h: h.send_error(503) or True
    robot(f"test ! -e {tmp_path}/bad").once()
    with pytest.raises(NotFound, match=r"no map in .* yet"):
        load(one.into, "L2")


def test_agent_level_runs_no_commands_of_another_user(
    robot: Robot, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    one = robot(f"touch {tmp_path}/run")
    assert one.once()
    (tmp_path / "run").unlink()
    owner = one.into.stat().st_uid
    os.chown(one.into / "hooks.json", 12345, -1) if owner == 0 else monkeypatch.setattr(os, "geteuid", lambda: 12345)
    with pytest.raises(Conflict, match="run this command as that user"):
        load(one.into, "L2")
    assert not (tmp_path / "run").exists()


def test_map_without_the_robots_level_is_refused(fake: Fake, robot: Robot) -> None:
    assert robot("true").once()
    one = robot("true")
    load(one.into, "L2")
    fake.put({path: data for path, data in SITE.items() if "/L2/" not in path})
    fake.levels = {path: level for path, level in LEVELS.items() if level == "ground"}
    one = robot("true")
    assert not one.once()
    assert "version 2 has no level 'L2', which the robot is on (levels: ground)" in one.detail
    assert whole(one.into)["version"] == 1, "the map of the floor that the robot stands on"
    load(one.into, "ground")
    assert robot("true").once()
    assert whole(one.into)["version"] == 2


def test_agent_level_waits_for_the_hooks_of_the_agent(fake: Fake, robot: Robot, tmp_path: Path) -> None:
    assert robot("true").once()
    fake.put({**SITE, "tmap2/network.tmap2.yaml": b"other"})
    hook = f'echo "begin $FLEETMAP_LEVEL" >> {tmp_path}/log; sleep 0.5; echo "end $FLEETMAP_LEVEL" >> {tmp_path}/log'
    one = robot(hook)
    agent = threading.Thread(target=one.once)
    agent.start()
    eventually((tmp_path / "log").exists)
    command = [sys.executable, "-m", "app.cli", "agent-level", str(one.into), "L2", "--json"]
    environment = {"PATH": os.environ["PATH"], "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60, check=False)
    agent.join(60)
    assert done.returncode == 0, done.stderr
    assert [json.loads(line)["event"] for line in done.stdout.splitlines()] == ["hook", "level"]
    assert (tmp_path / "log").read_text().splitlines() == ["begin ", "end ", "begin L2", "end L2"]


def test_switch_waits_for_agent_level(fake: Fake, robot: Robot, tmp_path: Path) -> None:
    log = f"$FLEETMAP_VERSION >> {tmp_path}/log"
    hook = f"echo begin {log}; sleep 0.4; echo end {log}"
    assert robot(hook).once()
    (tmp_path / "log").unlink()
    into = robot().into
    level = threading.Thread(target=lambda: load(into, "L2"))
    level.start()
    eventually((tmp_path / "log").exists)
    fake.put({**SITE, "tmap2/network.tmap2.yaml": b"other"})
    begun = time.monotonic()
    assert robot(hook).once()
    level.join(60)
    assert time.monotonic() - begun < 60
    assert (tmp_path / "log").read_text().splitlines() == ["begin 1", "end 1", "begin 2", "end 2"]


def test_old_server_lists_no_levels(fake: Fake, robot: Robot) -> None:
    fake.levels = {}
    one = robot("true")
    assert one.once()
    assert json.loads((one.into / "current" / "levels.json").read_text()) == {"levels": []}
    with pytest.raises(NotFound, match="the map has no levels"):
        load(one.into, "ground")

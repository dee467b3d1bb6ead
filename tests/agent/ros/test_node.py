"""The ROS 2 node with fakes of rclpy and of the command ``fleetmap``."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from app.agent.ros.fleetmap_ros import control, loading
from tests.agent.ros import standin
from tests.agent.ros.standin import Graph, Message

AGENT = r"""#!/bin/sh
echo "$FLEETMAP_TOKEN $*" >> "$CALLS"
if [ "$1" = agent-level ]; then
  [ "$3" != L9 ] || { echo "error: unknown level 'L9'" >&2; exit 1; }
  level=$3
fi
while [ $# -gt 0 ]; do
  case "$1" in --on-change) hook=$2 ;; --into) into=$2 ;; esac
  shift
done
[ -n "$hook" ] && echo "$hook" > "$CALLS.hook" || hook=$(cat "$CALLS.hook")
[ -z "$level" ] || into=$INTO
changed='occupancy_grid/map.yaml'
FLEETMAP_LEVEL=$level FLEETMAP_CURRENT="$into/current" FLEETMAP_CHANGED="$changed" sh -c "$hook" > "$CALLS.out" 2>&1
status=$?
echo '{"event": "hook", "status": "'$status'"}'
[ -z "$level" ] || exit $status
[ ! -e "$CALLS.end" ] || { rm "$CALLS.end"; exit 3; }
exec sleep 60
"""


@pytest.fixture
def graph() -> Iterator[Graph]:
    with standin.ros() as graph:
        yield graph


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The agent's folder with a map of two levels, and a ``fleetmap`` on the path."""
    into = tmp_path / "maps"
    version = into / "versions" / "3-abc"
    for prefix, cell in (("", 0), ("L2/", 254)):
        (version / "occupancy_grid" / prefix).mkdir(parents=True, exist_ok=True)
        (version / "occupancy_grid" / f"{prefix}map.pgm").write_bytes(b"P5 1 1 255\n" + bytes([cell]))
        (version / "occupancy_grid" / f"{prefix}map.yaml").write_text(
            "{image: map.pgm, resolution: 0.05, origin: [1, 2, 0], negate: 0, occupied_thresh: 0.65, free_thresh: 0.25}"
        )
    (into / "current").symlink_to("versions/3-abc")
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin" / "fleetmap").write_text(AGENT)
    (tmp_path / "bin" / "fleetmap").chmod(0o755)
    (tmp_path / "token").write_text("secret\n")
    monkeypatch.setenv("PATH", f"{tmp_path / 'bin'}:{os.environ['PATH']}")
    monkeypatch.setenv("CALLS", str(tmp_path / "calls"))
    monkeypatch.setenv("INTO", str(into))
    monkeypatch.setattr(control, "FIRST_PAUSE_SECONDS", 0.05)
    monkeypatch.setattr(loading, "SETTLE_SECONDS", 0.3)
    return into


def eventually(condition: Callable[[], Any], seconds: float = 30.0) -> Any:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if value := condition():
            return value
        time.sleep(0.02)
    raise AssertionError("it did not happen in time")


def configured(graph: Graph, folder: Path, **parameters: Any) -> Any:
    from app.agent.ros.fleetmap_ros.node import FleetmapAgent

    graph.parameters.update(environment="farm", into=str(folder), route_server="", **parameters)
    node = FleetmapAgent()
    assert node.on_configure(None) == "success", graph.log
    return node


def load_map(result: int = 0) -> Callable[[Any], Any]:
    return lambda request: Message(result=result, map=None)


def switch_level(node: Any) -> Any:
    response = Message(success=None, message="")
    return node.offered["~/switch_level"](None, response)


def test_agent_runs_while_node_is_active(graph: Graph, folder: Path) -> None:
    graph.services["/map_server/load_map"] = load_map()
    token = str(folder.parent / "token")
    formats = ["occupancy_grid?grid=map", "tmap2"]
    node = configured(graph, folder, token_file=token, formats=formats, optional=["kml", ""])
    assert node.on_activate(None) == "success"
    calls = folder.parent / "calls"
    eventually(lambda: graph.latched.get("/fleetmap_agent/status"))
    line = calls.read_text().splitlines()[0]
    assert line.startswith("secret agent --json --server http://127.0.0.1:8000 --environment farm --formats ")
    assert "--formats occupancy_grid?grid=map,tmap2 " in line
    assert "--optional kml" in line
    assert "secret" not in line[7:], "the token is not in the command line"
    file = (folder / "current" / "occupancy_grid" / "map.yaml").resolve()
    assert graph.calls == [("/map_server/load_map", {"map_url": str(file)})]
    assert "map: done: /map_server loaded occupancy_grid/map.yaml" in (folder.parent / "calls.out").read_text()
    assert json.loads(graph.latched["/fleetmap_agent/status"][-1].data) == {"event": "hook", "status": "0"}
    process = node._agent._process
    assert node.on_deactivate(None) == "success"
    assert process.poll() is not None, "it has ended"
    assert node.on_cleanup(None) == "success"
    assert node.entities == []
    assert node.on_configure(None) == "success"
    assert node.on_shutdown(None) == "success"
    assert node.entities == []


def test_hook_fails_when_loading_fails(graph: Graph, folder: Path) -> None:
    graph.services["/map_server/load_map"] = load_map(2)
    node = configured(graph, folder)
    node.on_activate(None)
    eventually(lambda: graph.latched.get("/fleetmap_agent/status"))
    assert "invalid map data (result=2)" in (folder.parent / "calls.out").read_text()
    assert json.loads(graph.latched["/fleetmap_agent/status"][-1].data)["status"] == "1"
    node.stop()


@pytest.mark.parametrize(
    ("service", "reason"),
    [
        (lambda request: None, "no response from /map_server/load_map within 0.2 seconds"),
        (lambda request: 1 / 0, "/map_server/load_map failed: division by zero"),
    ],
)
def test_node_reports_hanging_or_failing_service(graph: Graph, folder: Path, service: Any, reason: str) -> None:
    graph.services["/map_server/load_map"] = service
    node = configured(graph, folder, call_seconds=0.2)
    changed = {"FLEETMAP_CURRENT": str(folder / "current"), "FLEETMAP_CHANGED": "occupancy_grid/map.yaml"}
    ok, lines = node._loader(changed)
    assert not ok
    assert reason in lines[0]
    node.stop()


def test_grids_are_published_from_the_start(graph: Graph, folder: Path) -> None:
    graph.services["/map_server/load_map"] = load_map()
    (folder / "level").write_text("L2\n")
    node = configured(graph, folder, publish_map=True, publish_masks=True, keepout_topic="/mask")
    node.on_activate(None)
    (first, *_) = graph.latched["/map"]
    assert (first.info.width, first.info.height, list(first.data)) == (1, 1, [0]), "of the level that it was on"
    assert (first.header.frame_id, first.info.origin.position.x, first.info.resolution) == ("map", 1.0, 0.05)
    assert list(graph.latched["/mask"][0].data) == [0], "there is no mask: an empty one"
    eventually(lambda: graph.latched.get("/fleetmap_agent/status"))
    assert list(graph.latched["/map"][-1].data) == [100], "after the agent's hook without a level"
    node.stop()


def test_switch_level_service_loads_level(graph: Graph, folder: Path) -> None:
    graph.services["/map_server/load_map"] = load_map()
    node = configured(graph, folder, publish_map=True)
    assert switch_level(node).message == "the node is not active"
    node.on_activate(None)
    eventually(lambda: graph.latched.get("/fleetmap_agent/status"))
    assert switch_level(node).message == "set the parameter level first"
    graph.parameters["level"] = "L2"
    response = switch_level(node)
    assert (response.success, response.message) == (True, "level L2 is loaded")
    assert graph.calls[-1][1]["map_url"].endswith("/occupancy_grid/L2/map.yaml")
    assert list(graph.latched["/map"][-1].data) == [0]
    graph.parameters["level"] = "L9"
    response = switch_level(node)
    assert (response.success, response.message) == (False, "error: unknown level 'L9'")
    node.stop()


def test_node_restarts_stopped_agent(graph: Graph, folder: Path) -> None:
    graph.services["/map_server/load_map"] = load_map()
    (folder.parent / "calls.end").touch()
    program = folder.parent / "bin" / "fleetmap"
    graph.parameters["fleetmap"] = str(program)
    node = configured(graph, folder)
    node.on_activate(None)
    calls = folder.parent / "calls"
    calls.touch()  # the first process may not have written yet
    eventually(lambda: len(calls.read_text().splitlines()) == 2)
    assert any("the agent exited with status 3" in text for _, text in graph.log)
    eventually(lambda: len(graph.latched["/fleetmap_agent/status"]) == 2)
    node._agent._process.send_signal(signal.SIGKILL)
    eventually(lambda: len(calls.read_text().splitlines()) == 3)
    eventually(lambda: len(graph.latched["/fleetmap_agent/status"]) == 3)
    program.rename(program.with_name("away"))  # as during an upgrade
    node._agent._process.send_signal(signal.SIGKILL)
    eventually(lambda: any(f"could not run {program}" in text for _, text in graph.log))
    program.with_name("away").rename(program)
    eventually(lambda: len(calls.read_text().splitlines()) == 4)
    node.stop()
    assert node._agent is None


@pytest.mark.parametrize(
    ("parameters", "reason"),
    [
        ({"environment": " "}, "parameter environment is empty"),
        ({"formats": [""]}, "parameter formats is empty"),
        ({"call_seconds": 0.0}, "call_seconds must be above 0"),
    ],
)
def test_parameters_are_checked(graph: Graph, folder: Path, parameters: dict[str, Any], reason: str) -> None:
    from app.agent.ros.fleetmap_ros.node import FleetmapAgent

    graph.parameters.update({"environment": "farm", "into": str(folder), **parameters})
    node = FleetmapAgent()
    assert node.on_configure(None) == "failure"
    assert reason in graph.log[-1][1]
    assert node.entities == []


@pytest.mark.parametrize(
    ("parameters", "reason"),
    [
        ({"token_file": "/nowhere/token"}, "could not read token_file /nowhere/token"),
        ({"fleetmap": "/nowhere/fleetmap"}, "could not run /nowhere/fleetmap"),
    ],
)
def test_node_reports_agent_that_cannot_start(
    graph: Graph, folder: Path, parameters: dict[str, Any], reason: str
) -> None:
    node = configured(graph, folder, **parameters)
    assert node.on_activate(None) == "failure"
    assert reason in graph.log[-1][1]
    assert node._hooks is None
    node.stop()


def test_topological_map_is_verified_after_switch(graph: Graph, folder: Path) -> None:
    pose = "    pose: {position: {x: 0.0, y: 0.0, z: 0.0}}\n"
    text = f"name: farm\nnodes:\n- meta:\n    node: A\n  node:\n    edges: []\n    name: A\n{pose}pointset: p\n"
    (folder / "current" / "tmap2").mkdir()
    (folder / "current" / "tmap2" / "network.tmap2.yaml").write_text(text)
    graph.services["/topological_map_manager2/switch_topological_map"] = lambda request: Message(success=True)
    node = configured(graph, folder, nav2=False, topological=True)
    variables = {"FLEETMAP_CURRENT": str(folder / "current"), "FLEETMAP_CHANGED": "tmap2/network.tmap2.yaml"}
    right = {"name": "farm", "pointset": "p", "nodes": [{"node": {"name": "A", "edges": []}}]}
    graph.latched["/topological_map_2"] = [Message(data=json.dumps(right))]
    assert node._loader(variables) == (
        True,
        ["topological map: done: /topological_map_manager2 publishes tmap2/network.tmap2.yaml: 1 nodes, 0 edges"],
    )
    graph.latched["/topological_map_2"] = [Message(data="{}")]
    ok, lines = node._loader(variables)
    assert not ok
    assert "reported success, but /topological_map_2 does not publish" in lines[0]
    node.stop()


def test_missing_service_type_names_package_to_install(graph: Graph, folder: Path) -> None:
    from app.agent.ros.fleetmap_ros.node import service_type

    with pytest.raises(loading.LoadError, match="nav2_msgs/srv/SetRouteGraph not found: install nav2_msgs"):
        service_type("nav2_msgs/srv/SetRouteGraph")
    with pytest.raises(loading.LoadError, match="install absent_msgs"):
        service_type("absent_msgs/srv/X")


def test_ros_hook_fails_without_node(tmp_path: Path) -> None:
    command = [sys.executable, control.HOOK, tmp_path / "none"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ended.returncode == 1
    assert "no response from the node fleetmap_agent" in ended.stdout


def test_hooks_are_answered_after_an_unexpected_error(tmp_path: Path) -> None:
    def load(given: Any) -> tuple[bool, list[str]]:
        if given["FLEETMAP_CURRENT"] == "large":
            raise MemoryError("too large a grid")
        return True, ["done"]

    server = control.HookServer(load, lambda *_: None)
    answers = []
    for current in ("large", "small"):
        command = f"FLEETMAP_CURRENT={current} {server.command}"
        ended = subprocess.run(command, shell=True, capture_output=True, text=True, check=False)
        answers.append((ended.returncode, ended.stdout))
    server.close()
    assert answers == [(1, "could not load the map: MemoryError('too large a grid')\n"), (0, "done\n")]


def test_hook_socket_is_private_and_removed_with_node(tmp_path: Path) -> None:
    server = control.HookServer(lambda given: (False, [f"refused {given['FLEETMAP_CURRENT']}"]), lambda *_: None)
    assert server.path.parent.stat().st_mode & 0o077 == 0
    command = f"FLEETMAP_CURRENT=here {server.command}"
    ended = subprocess.run(command, shell=True, capture_output=True, text=True, check=False)
    assert (ended.returncode, ended.stdout) == (1, "refused here\n")
    server.close()
    assert not server.path.parent.exists()
    assert subprocess.run(command, shell=True, capture_output=True, check=False).returncode == 1

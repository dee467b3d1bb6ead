"""The ready-made hooks with a ``ros2`` that notes what it is asked, and answers as the real one prints."""

from __future__ import annotations

import json
import os
import subprocess
import threading
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import pytest

from app.agent import hooks
from tests.agent.conftest import Start, network
from tests.api import samples
from tests.api.conftest import Api
from tests.events.conftest import eventually

ROS2 = r"""#!/bin/sh
printf '%s\n' "$*" >> "$ROS_LOG"
case "$3" in
  */load_map) echo "requester: making request: nav2_msgs.srv.LoadMap_Request(map_url='x')"
              echo "response:"
              echo "nav2_msgs.srv.LoadMap_Response(map=nav_msgs.msg.OccupancyGrid(), result=${RESULT:-0})" ;;
  */set_route_graph) echo "response:"; echo "nav2_msgs.srv.SetRouteGraph_Response(success=${SUCCESS:-True})" ;;
  */switch_topological_map) echo "response:"
     echo "topological_navigation_msgs.srv.WriteTopologicalMap_Response(success=${SUCCESS:-True}, message='')" ;;
  *) exit 9 ;;
esac
"""


@pytest.fixture
def ros(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A fake ros2 on the path: the file of its calls."""
    tools = tmp_path / "bin"
    tools.mkdir()
    (tools / "ros2").write_text(ROS2)
    (tools / "ros2").chmod(0o755)
    log = tmp_path / "ros.log"
    log.touch()
    monkeypatch.setenv("PATH", f"{tools}:{os.environ['PATH']}")
    monkeypatch.setenv("ROS_LOG", str(log))
    return log


@pytest.fixture
def current(tmp_path: Path) -> Path:
    """A folder with all that the hooks know, in a place with a quote in its name."""
    version = tmp_path / "robot's maps" / "versions" / "3-abc"
    for name in (
        "occupancy_grid/map.yaml", "occupancy_grid/keepout.yaml", "occupancy_grid/speed.yaml",
        "nav2_route/graph.geojson", "tmap2/network.tmap2.yaml",
    ):  # fmt: skip
        (version / name).parent.mkdir(parents=True, exist_ok=True)
        (version / name).touch()
    link = version.parents[1] / "current"
    link.symlink_to("versions/3-abc")
    return link


def test_they_are_found_by_name() -> None:
    assert set(hooks.ready_made()) == {"nav2", "topological"}
    for path in hooks.ready_made().values():
        subprocess.run(["sh", "-n", path], check=True)


def test_nav2_loads_what_changed(ros: Path, current: Path) -> None:
    changed = ["occupancy_grid/map.pgm", "occupancy_grid/keepout.yaml", "nav2_route/graph.geojson", "kml/map.kml"]
    assert hooks.run("nav2", {"FLEETMAP_CURRENT": str(current), "FLEETMAP_CHANGED": "\n".join(changed)}) is None
    where = str(current.resolve()).replace("'", "''")
    assert ros.read_text().splitlines() == [
        f"service call /map_server/load_map nav2_msgs/srv/LoadMap {{map_url: '{where}/occupancy_grid/map.yaml'}}",
        "service call /keepout_filter_mask_server/load_map nav2_msgs/srv/LoadMap "
        f"{{map_url: '{where}/occupancy_grid/keepout.yaml'}}",
        "service call /route_server/set_route_graph nav2_msgs/srv/SetRouteGraph "
        f"{{graph_filepath: '{where}/nav2_route/graph.geojson'}}",
    ]


def test_nav2_cannot_unload_and_says_so(ros: Path, current: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (current / "occupancy_grid" / "keepout.yaml").unlink()
    (current / "nav2_route" / "graph.geojson").unlink()
    changed = (
        "occupancy_grid/keepout.pgm\noccupancy_grid/keepout.yaml\noccupancy_grid/map.pgm\nnav2_route/graph.geojson"
    )
    variables = {"FLEETMAP_CURRENT": str(current), "FLEETMAP_CHANGED": changed}
    told = hooks.run("nav2", variables)
    assert told is not None
    assert "the grid keepout is no longer part of the map; Nav2 goes on with the one of before" in told
    assert "the route graph is no longer part of the map" in told
    assert [line.split()[2] for line in ros.read_text().splitlines()] == ["/map_server/load_map"], "the rest is loaded"
    monkeypatch.setenv("FLEETMAP_NAV2_KEEPOUT_SERVER", "")
    monkeypatch.setenv("FLEETMAP_NAV2_ROUTE_SERVER", "")
    assert hooks.run("nav2", variables) is None, "who runs no such server has nothing to unload"


def test_nav2_says_what_was_not_taken(ros: Path, current: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    variables = {"FLEETMAP_CURRENT": str(current), "FLEETMAP_CHANGED": "occupancy_grid/map.yaml"}
    for result in ("1", "255", "10"):
        monkeypatch.setenv("RESULT", result)
        told = hooks.run("nav2", variables)
        assert told is not None
        assert f"result={result}" in told
        assert "/map_server/load_map did not take it" in told
    monkeypatch.delenv("RESULT")
    monkeypatch.setenv("FLEETMAP_NAV2_MAP_SERVER", "/r1/map_server")
    assert hooks.run("nav2", variables) is None
    assert "/r1/map_server/load_map" in ros.read_text()
    monkeypatch.setenv("FLEETMAP_NAV2_MAP_SERVER", "")
    before = ros.read_text()
    assert hooks.run("nav2", variables) is None
    assert ros.read_text() == before


def test_topological(ros: Path, current: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    variables = {"FLEETMAP_CURRENT": str(current), "FLEETMAP_CHANGED": "occupancy_grid/map.yaml"}
    assert hooks.run("topological", variables) is None
    assert ros.read_text() == "", "the network did not change"
    variables["FLEETMAP_CHANGED"] = "tmap2/network.tmap2.yaml"
    assert hooks.run("topological", variables) is None
    where = str(current.resolve()).replace("'", "''")
    assert ros.read_text() == (
        "service call /topological_map_manager2/switch_topological_map "
        "topological_navigation_msgs/srv/WriteTopologicalMap "
        f"{{filename: '{where}/tmap2/network.tmap2.yaml', no_alias: false}}\n"
    )
    monkeypatch.setenv("SUCCESS", "False")
    told = hooks.run("topological", variables)
    assert told is not None
    assert "did not take it" in told


def test_without_ros_it_fails_and_says_so(current: Path) -> None:
    told = hooks.run("nav2", {"FLEETMAP_CURRENT": str(current), "FLEETMAP_CHANGED": "occupancy_grid/map.yaml"})
    assert told is not None
    assert "status 127" in told


def test_a_hanging_hook_is_ended(tmp_path: Path) -> None:
    told = hooks.run(f"sleep 60 & echo $! > {tmp_path}/pid; wait", {}, seconds=0.5)
    assert told is not None
    assert "took more than 0.5 seconds" in told
    pid = int((tmp_path / "pid").read_text())
    eventually(lambda: _ended(pid))  # what was killed takes a moment to end on a busy machine


def test_a_hook_that_prints_without_end_fills_nothing() -> None:
    before = tracemalloc_peak(lambda: None)
    told: list[str | None] = []
    peak = tracemalloc_peak(
        lambda: told.append(hooks.run("head -c 50000000 /dev/zero | tr '\\0' x; echo; echo the end; exit 3", {}))
    )
    assert told[0] is not None
    assert told[0].endswith("the end")
    assert len(told[0]) < 2000
    assert peak - before < 2**20


def tracemalloc_peak(do: Callable[[], object]) -> int:
    tracemalloc.start()
    try:
        do()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_what_a_hook_leaves_in_the_background_lives_on(tmp_path: Path) -> None:
    background = f"(while [ ! -e {tmp_path}/end ]; do echo x; sleep 0.05; done; touch {tmp_path}/lived) & exit 0"
    assert hooks.run(background, {}, seconds=30) is None
    (tmp_path / "end").touch()
    eventually((tmp_path / "lived").exists)


def test_a_hook_ends_with_the_agent(tmp_path: Path) -> None:
    stopping = threading.Event()
    threading.Timer(0.2, stopping.set).start()
    told = hooks.run(f"sleep 60 & echo $! > {tmp_path}/pid; wait", {}, stopping=stopping)
    assert told is not None
    assert "was ended with the agent" in told
    pid = int((tmp_path / "pid").read_text())
    eventually(lambda: _ended(pid))


def _ended(pid: int) -> bool:
    try:
        return " Z " in Path(f"/proc/{pid}/stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return True


def test_an_agent_switches_nav2(api: Api, place: str, robot: Start, ros: Path) -> None:
    api.upload(place, samples.grid())
    formats = "tmap2,occupancy_grid"
    one = robot("--once", "--on-change", "nav2", "--on-change", "topological", formats=formats)
    assert one.end() == 0, one.lines
    assert [line.split()[2] for line in ros.read_text().splitlines()] == [
        "/map_server/load_map",
        "/topological_map_manager2/switch_topological_map",
    ]
    api.upload(place, {"n.tmap2.yaml": network(1)})
    again = robot("--once", "--on-change", "nav2", "--on-change", "topological", formats=formats)
    assert again.end() == 0, again.lines
    assert len(ros.read_text().splitlines()) == 3, "the grid did not change"
    name = f"versions/{json.loads((one.into / 'current' / 'manifest.json').read_bytes())['version']}-"
    assert name in ros.read_text().splitlines()[-1], "the file of this very version, not of the link"

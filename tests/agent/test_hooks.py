"""Bundled hooks with a fake ``ros2`` that records its calls and prints real responses."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import yaml

from app.agent import hooks
from app.agent.ros.fleetmap_ros import loading
from tests.agent.conftest import Start, network
from tests.api import samples
from tests.events.conftest import eventually

if TYPE_CHECKING:
    from tests.api.conftest import Api

ROS2 = r"""#!/bin/sh
case "$1 $2" in
  "service type")
    case " $ABSENT " in *" $3 "*) exit 1 ;; esac
    echo some/srv/Type; exit 0 ;;
  "topic echo")
    while read -r line; do printf '%s\n---\n' "$line"; done < "$PUBLISHED"
    exec sleep 30 ;;
esac
printf '%s\n' "$*" >> "$ROS_LOG"
case "$3" in
  */load_map) [ -z "$HANG" ] || exec sleep 60
              echo "requester: making request: nav2_msgs.srv.LoadMap_Request(map_url='x')"
              echo "response:"
              [ -z "$LARGE" ] || head -c 5000000 /dev/zero | tr '\\0' 0
              echo "nav2_msgs.srv.LoadMap_Response(map=nav_msgs.msg.OccupancyGrid(), result=${RESULT:-0})" ;;
  */set_route_graph) echo "response:"; echo "nav2_msgs.srv.SetRouteGraph_Response(success=${SUCCESS:-True})" ;;
  */adjust_edges) echo "response:"; echo "nav2_msgs.srv.DynamicEdges_Response(success=${SUCCESS:-True})" ;;
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
    monkeypatch.setenv("FLEETMAP_PYTHON", sys.executable)
    monkeypatch.setenv("FLEETMAP_ROS_WAIT_SECONDS", "0.1")
    monkeypatch.setenv("FLEETMAP_HOOK_STATUS", str(tmp_path / "status"))
    monkeypatch.setenv("PUBLISHED", str(tmp_path / "published"))
    return log


def steps(ros: Path) -> list[tuple[str, str]]:
    """Steps and results of the last hook; the file is emptied."""
    path = ros.with_name("status")
    lines = [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []
    path.unlink(missing_ok=True)
    assert all(set(line) == {"step", "result", "detail"} and line["detail"] for line in lines)
    return [(line["step"], line["result"]) for line in lines]


def called(ros: Path) -> list[str]:
    """Service and request of each call so far; the log is emptied."""
    lines = [line.split(" ", 4) for line in ros.read_text().splitlines()]
    ros.write_text("")
    return [f"{line[2]} {line[4]}" for line in lines]


def put(current: Path, name: str, data: object = b"") -> None:
    path = current / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data if isinstance(data, bytes) else json.dumps(data).encode())


def graph(*blocked: int) -> dict[str, Any]:
    """A route graph with three edges."""
    edges = [
        {"id": n, "startid": 1, "endid": 2, **({"metadata": {"blocked": True}} if n in blocked else {})}
        for n in (5, 6, 7)
    ]
    return {"type": "FeatureCollection", "features": [{"properties": p} for p in [{"id": 1}, {"id": 2}, *edges]]}


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
    put(version, "nav2_route/graph.geojson", graph())
    put(version, "tmap2/network.tmap2.yaml", samples.tmap2({"A": (0.0, 0.0), "B": (1.0, 0.0)}, (("A", "B"),)))
    link = version.parents[1] / "current"
    link.symlink_to("versions/3-abc")
    return link


def test_bundled_hooks_are_found_by_name() -> None:
    assert set(hooks.bundled_hooks()) == {"nav2", "topological"}
    for path in hooks.bundled_hooks().values():
        subprocess.run(["sh", "-n", path], check=True)


def test_nav2_loads_what_changed(ros: Path, current: Path) -> None:
    changed = ["occupancy_grid/map.pgm", "occupancy_grid/keepout.yaml", "nav2_route/graph.geojson", "kml/map.kml"]
    assert hooks.run("nav2", {"FLEETMAP_CURRENT": str(current), "FLEETMAP_CHANGED": "\n".join(changed)}) is None
    folder = str(current.resolve()).replace("'", "''")
    assert ros.read_text().splitlines() == [
        f"service call /map_server/load_map nav2_msgs/srv/LoadMap {{map_url: '{folder}/occupancy_grid/map.yaml'}}",
        "service call /keepout_filter_mask_server/load_map nav2_msgs/srv/LoadMap "
        f"{{map_url: '{folder}/occupancy_grid/keepout.yaml'}}",
        "service call /route_server/set_route_graph nav2_msgs/srv/SetRouteGraph "
        f"{{graph_filepath: '{folder}/nav2_route/graph.geojson'}}",
    ]


def variables(current: Path, *changed: str, **more: str) -> dict[str, str]:
    return {"FLEETMAP_CURRENT": str(current), "FLEETMAP_CHANGED": "\n".join(changed), **more}


def test_each_step_is_reported(ros: Path, current: Path) -> None:
    assert hooks.run("nav2", variables(current, "occupancy_grid/map.pgm", "nav2_route/graph.geojson")) is None
    assert steps(ros) == [("map", "done"), ("route graph", "done")]


def test_nav2_hook_fails_when_grid_or_graph_is_missing(
    ros: Path, current: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (current / "occupancy_grid" / "map.yaml").unlink()
    (current / "nav2_route" / "graph.geojson").unlink()
    hook_variables = variables(
        current, "occupancy_grid/map.yaml", "occupancy_grid/speed.pgm", "nav2_route/graph.geojson"
    )
    problem = hooks.run("nav2", hook_variables)
    assert problem is not None
    assert "the map no longer has the grid map" in problem
    assert "the map no longer has a route graph" in problem
    assert steps(ros) == [("map", "failed"), ("speed", "done"), ("route graph", "failed")], "the rest is loaded"
    monkeypatch.setenv("FLEETMAP_NAV2_MAP_SERVER", "")
    monkeypatch.setenv("FLEETMAP_NAV2_ROUTE_SERVER", "")
    assert hooks.run("nav2", hook_variables) is None


def test_nav2_hook_skips_mask_without_mask_server(ros: Path, current: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ABSENT", "/keepout_filter_mask_server/load_map /speed_filter_mask_server/load_map")
    changed = variables(current, "occupancy_grid/map.yaml", "occupancy_grid/keepout.yaml", "occupancy_grid/speed.yaml")
    assert hooks.run("nav2", changed) is None
    assert steps(ros) == [("map", "done"), ("keepout", "skipped"), ("speed", "skipped")]
    monkeypatch.setenv("FLEETMAP_NAV2_KEEPOUT_SERVER", "/keepout_filter_mask_server")
    problem = hooks.run("nav2", changed)
    assert problem is not None, "an operator who names a server wants it"
    assert "service /keepout_filter_mask_server/load_map not found" in problem


def test_nav2_hook_replaces_missing_mask_by_empty_one(ros: Path, current: Path) -> None:
    assert hooks.run("nav2", variables(current, "occupancy_grid/keepout.yaml")) is None
    called(ros)
    (current / "occupancy_grid" / "keepout.yaml").unlink()
    assert hooks.run("nav2", variables(current, "occupancy_grid/keepout.yaml", "occupancy_grid/keepout.pgm")) is None
    (line,) = called(ros)
    empty = current.parent / "hooks" / "empty.yaml"
    assert (
        line
        == f"/keepout_filter_mask_server/load_map {{map_url: '{str(empty.resolve()).replace(chr(39), chr(39) * 2)}'}}"
    )
    assert (empty.parent / "empty.pgm").read_bytes() == b"P5\n1 1\n255\n\xfe"
    assert hooks.run("nav2", variables(current, "tmap2/network.tmap2.yaml")) is None
    assert called(ros) == [], "only once"


def test_nav2_hook_fails_without_map_server(ros: Path, current: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ABSENT", "/map_server/load_map")
    problem = hooks.run("nav2", variables(current, "occupancy_grid/map.yaml"))
    assert problem is not None
    assert "service /map_server/load_map not found: start Nav2, or set FLEETMAP_NAV2_MAP_SERVER" in problem


def test_nav2_hook_selects_grid_by_name(ros: Path, current: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (current / "occupancy_grid" / "map.yaml").rename(current / "occupancy_grid" / "hall.yaml")
    put(current, "occupancy_grid/keepout_filter_info.yaml")
    assert hooks.run("nav2", variables(current, "occupancy_grid/hall.pgm")) is None
    assert "occupancy_grid/hall.yaml" in called(ros)[0], "the only grid that is no mask"
    put(current, "occupancy_grid/annex.yaml")
    problem = hooks.run("nav2", variables(current, "occupancy_grid/hall.pgm"))
    assert problem is not None
    assert "several grids (annex, hall): choose one with FLEETMAP_NAV2_GRID" in problem
    monkeypatch.setenv("FLEETMAP_NAV2_GRID", "annex")
    assert hooks.run("nav2", variables(current, "occupancy_grid/annex.yaml")) is None
    assert "occupancy_grid/annex.yaml" in called(ros)[0]
    monkeypatch.setenv("FLEETMAP_NAV2_GRID", "cellar")
    problem = hooks.run("nav2", variables(current, "occupancy_grid/annex.yaml"))
    assert problem is not None
    assert "unknown grid cellar: set FLEETMAP_NAV2_GRID to one of annex, hall" in problem


def test_align_onto_another_level(ros: Path, current: Path) -> None:
    put(current, "occupancy_grid/L2/map.yaml")
    levels = [
        {"name": "ground", "elevation": 0.0, "files": {"occupancy_grid": ["map.yaml", "keepout.yaml"]}},
        {"name": "L2", "elevation": 3.5, "files": {"occupancy_grid": ["L2/map.yaml"]}},
        {"name": "roof", "elevation": 9.0, "files": {}},
    ]
    put(current, "levels.json", {"levels": levels})
    ground = ["occupancy_grid/map.yaml", "occupancy_grid/keepout.yaml"]
    assert hooks.run("nav2", variables(current, *ground, FLEETMAP_LEVEL="ground")) is None
    assert ["/L2/" in line for line in called(ros)] == [False, False]
    assert hooks.run("nav2", variables(current, "occupancy_grid/L2/map.yaml", FLEETMAP_LEVEL="L2")) is None
    upper = called(ros)
    assert "/occupancy_grid/L2/map.yaml" in upper[0]
    assert "/hooks/empty.yaml" in upper[1], "the mask of the floor below is taken away"
    assert hooks.run("nav2", variables(current, FLEETMAP_LEVEL="ground")) is None
    assert len(called(ros)) == 2, "both again, though no file changed"
    for level, reason in (
        ("L3", "the map has no level 'L3': choose one of ground, L2, roof"),
        ("roof", "no files of level"),
    ):
        problem = hooks.run("nav2", variables(current, FLEETMAP_LEVEL=level))
        assert problem is not None
        assert reason in problem


def test_level_whose_folder_has_another_name(ros: Path, current: Path) -> None:
    """The server percent-encodes what no folder may be called."""
    put(current, "occupancy_grid/Floor 1 %28east%29/map.yaml")
    put(current, "occupancy_grid/map.yaml")
    name, files = "Floor 1 (east)", {"occupancy_grid": ["Floor 1 %28east%29/map.yaml"]}
    levels = [
        {"name": "ground", "elevation": 0.0, "files": {"occupancy_grid": ["map.yaml"]}},
        {"name": name, "elevation": 3.5, "files": files},
    ]
    put(current, "levels.json", {"levels": levels})
    changed = variables(current, "occupancy_grid/Floor 1 %28east%29/map.yaml", FLEETMAP_LEVEL=name)
    assert hooks.run("nav2", changed) is None
    assert "/occupancy_grid/Floor 1 %28east%29/map.yaml" in called(ros)[0]


def test_closed_edges_are_closed_and_opened_again(ros: Path, current: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    adjust = "/route_server/DynamicEdgesScorer/adjust_edges"
    changed = variables(current, "nav2_route/graph.geojson")
    put(current, "nav2_route/graph.geojson", graph(5, 7))
    assert hooks.run("nav2", changed) is None
    first, second = called(ros)
    assert first == f"{adjust} {{closed_edges: [5, 7], opened_edges: [], adjust_edges: []}}", "before the graph is set"
    assert "set_route_graph" in second
    put(current, "nav2_route/graph.geojson", graph(7))
    monkeypatch.setenv("SUCCESS", "False")
    assert hooks.run("nav2", changed) is not None
    monkeypatch.delenv("SUCCESS")
    called(ros)
    assert hooks.run("nav2", changed) is None
    assert called(ros)[2] == f"{adjust} {{closed_edges: [], opened_edges: [5], adjust_edges: []}}"
    put(current, "nav2_route/graph.geojson", graph())
    assert hooks.run("nav2", changed) is None
    assert f"{adjust} {{closed_edges: [], opened_edges: [7], adjust_edges: []}}" in called(ros)
    monkeypatch.setenv("ABSENT", adjust)
    put(current, "nav2_route/graph.geojson", graph(6))
    problem = hooks.run("nav2", changed)
    assert problem is not None
    assert "add DynamicEdgesScorer to the route server's edge_cost_functions" in problem
    assert not any("set_route_graph" in line for line in called(ros)), "an edge that cannot be closed is not set open"


def test_nav2_hook_reports_rejected_files(ros: Path, current: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    changed = variables(current, "occupancy_grid/map.yaml")
    for result, reason in (("1", "does not exist"), ("255", "undefined failure"), ("10", "no result")):
        monkeypatch.setenv("RESULT", result)
        problem = hooks.run("nav2", changed)
        assert problem is not None
        assert f"(result={result})" in problem
        assert reason in problem
    monkeypatch.setenv("LARGE", "1")
    monkeypatch.setenv("RESULT", "2")
    problem = hooks.run("nav2", changed)
    assert problem is not None, "an answer of megabytes"
    assert "invalid map data (result=2)" in problem
    monkeypatch.delenv("RESULT")
    monkeypatch.setenv("FLEETMAP_NAV2_MAP_SERVER", "/r1/map_server")
    assert hooks.run("nav2", changed) is None
    assert "/r1/map_server/load_map" in ros.read_text()


def test_nav2_hook_gives_up_hanging_service(ros: Path, current: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HANG", "1")
    changed = variables(current, "occupancy_grid/map.yaml", "occupancy_grid/keepout.yaml")
    problem = hooks.run("nav2", {**changed, "FLEETMAP_ROS_SECONDS": "1"})
    assert problem is not None
    assert "no response from /map_server/load_map within 1 seconds" in problem
    problem = hooks.run("nav2", {**changed, "FLEETMAP_HOOK_SECONDS": "1.5"})
    assert problem is not None
    assert "no time left" in problem
    problem = hooks.run("nav2", {**changed, "FLEETMAP_ROS_SECONDS": "soon"})
    assert problem is not None
    assert "FLEETMAP_ROS_SECONDS must be a number of seconds, got 'soon'" in problem


def published(ros: Path, *maps: object) -> None:
    """What the map manager's latched topic delivers."""
    ros.with_name("published").write_text("".join(json.dumps(one) + "\n" for one in maps))


def tmap2(*nodes: str, edges: tuple[str, ...] = ("A_B",), name: str = "network") -> dict[str, Any]:
    rows = [{"node": {"name": n, "edges": [{"edge_id": e} for e in edges if e.startswith(n)]}} for n in nodes]
    return {"name": name, "pointset": "network", "nodes": rows}


def test_topological_hook_switches_map(ros: Path, current: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert hooks.run("topological", variables(current, "occupancy_grid/map.yaml")) is None
    assert ros.read_text() == "", "the network did not change"
    changed = variables(current, "tmap2/network.tmap2.yaml")
    file = current / "tmap2" / "network.tmap2.yaml"
    expected_network = loading.read_network(file)
    assert (expected_network.nodes, expected_network.edges) == ({"A", "B"}, {"A_B"})
    right = {**tmap2("A", "B"), "name": expected_network.name, "pointset": expected_network.pointset}
    published(ros, {}, tmap2("old"), right)
    assert hooks.run("topological", changed) is None
    path = str(file.resolve()).replace("'", "''")
    assert ros.read_text() == (
        "service call /topological_map_manager2/switch_topological_map "
        "topological_navigation_msgs/srv/WriteTopologicalMap "
        f"{{filename: '{path}', no_alias: false}}\n"
    )
    monkeypatch.setenv("SUCCESS", "False")
    problem = hooks.run("topological", changed)
    assert problem is not None
    assert "switch_topological_map rejected tmap2/network.tmap2.yaml" in problem


def test_topological_hook_checks_published_map(ros: Path, current: Path) -> None:
    changed = variables(current, "tmap2/network.tmap2.yaml")
    expected_network = loading.read_network(current / "tmap2" / "network.tmap2.yaml")
    right = {**tmap2("A", "B"), "name": expected_network.name, "pointset": expected_network.pointset}
    for last, reason in (
        ({}, "its name is '', not"),
        ({**right, "nodes": right["nodes"][:1]}, "it has 1 nodes, not 2; for example it lacks 'B'"),
        ({**right, **{"nodes": tmap2("A", "B", edges=("A_B", "B_A"))["nodes"]}}, "it still has 'B_A'"),
    ):
        ros.write_text("")
        published(ros, right, last)
        problem = hooks.run("topological", changed)
        assert problem is not None
        assert "reported success, but /topological_map_2 does not publish tmap2/network.tmap2.yaml" in problem
        assert reason in problem
        assert "../../" in called(ros)[1], "a manager that puts its own folder before the name is helped"


def test_networks_are_read_as_the_server_writes_them(tmp_path: Path) -> None:
    pytest.importorskip("numpy", reason="the server's packages")
    from app.convert.files import offline
    from app.upload_reader import UploadHints

    names = ["a: b", "it's", "'", '"', "1e3", "yes", "- x", "name: y", "\u00e9 \U0001f600", "#", "~"]
    pose = {"position": {"x": 0.0, "y": 0.0, "z": 0.0}, "orientation": {"w": 1.0, "x": 0.0, "y": 0.0, "z": 0.0}}
    nodes = [
        {
            "meta": {"map": "m", "node": name, "pointset": "p", "name": "not this one"},
            "node": {
                "name": name,
                "parent_frame": "map",
                "pose": pose,
                "edges": [edge_of(name, names[0])] if k else [],
            },
        }
        for k, name in enumerate(names)
    ]
    frames = {"child": "topo_map", "parent": "map", "rotation": pose["orientation"], "translation": pose["position"]}
    body = {"meta": {}, "name": "it's: m", "metric_map": "m", "pointset": "p", "transformation": frames, "nodes": nodes}
    converted = offline({"n.tmap2.yaml": yaml.safe_dump(body).encode()}, "tmap2", hints=UploadHints("tmap2"))
    (data,) = converted.files.values()
    (tmp_path / "n.yaml").write_bytes(data)
    network = loading.read_network(tmp_path / "n.yaml")
    assert network == loading.parse_network(json.dumps(yaml.safe_load(data)))
    assert (len(network.nodes), len(network.edges)) == (len(names), len(names) - 1)


def edge_of(source: str, target: str) -> dict[str, Any]:
    return {"edge_id": f"{source}_{target}", "node": target, "action": "NavigateToPose", "action_type": "t"}


def test_hook_without_ros_fails_with_reason(current: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FLEETMAP_PYTHON", sys.executable)
    problem = hooks.run("nav2", variables(current, "occupancy_grid/map.yaml"))
    assert problem is not None
    assert "source the setup.bash of ROS 2" in problem


def test_hanging_hook_is_killed(tmp_path: Path) -> None:
    problem = hooks.run(f"sleep 60 & echo $! > {tmp_path}/pid; wait", {}, seconds=0.5)
    assert problem is not None
    assert "exceeded 0.5 seconds" in problem
    pid = int((tmp_path / "pid").read_text())
    eventually(lambda: _ended(pid))  # what was killed takes a moment to end on a busy machine


def test_hook_with_endless_output_fills_no_memory() -> None:
    before = tracemalloc_peak(lambda: None)
    problems: list[str | None] = []
    peak = tracemalloc_peak(
        lambda: problems.append(hooks.run("head -c 50000000 /dev/zero | tr '\\0' x; echo; echo the end; exit 3", {}))
    )
    assert problems[0] is not None
    assert problems[0].endswith("the end")
    assert len(problems[0]) < 2000
    assert peak - before < 2**20


def tracemalloc_peak(do: Callable[[], object]) -> int:
    tracemalloc.start()
    try:
        do()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_background_process_of_hook_survives(tmp_path: Path) -> None:
    background = f"(while [ ! -e {tmp_path}/end ]; do echo x; sleep 0.05; done; touch {tmp_path}/lived) & exit 0"
    assert hooks.run(background, {}, seconds=30) is None
    (tmp_path / "end").touch()
    eventually((tmp_path / "lived").exists)


def test_hook_is_killed_when_agent_stops(tmp_path: Path) -> None:
    stopping = threading.Event()
    threading.Timer(0.2, stopping.set).start()
    problem = hooks.run(f"sleep 60 & echo $! > {tmp_path}/pid; wait", {}, stopping=stopping)
    assert problem is not None
    assert "was stopped with the agent" in problem
    pid = int((tmp_path / "pid").read_text())
    eventually(lambda: _ended(pid))


def _ended(pid: int) -> bool:
    try:
        return " Z " in Path(f"/proc/{pid}/stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return True


def test_agent_loads_map_into_nav2(api: Api, place: str, robot: Start, ros: Path) -> None:
    api.upload(place, samples.grid())
    formats = "tmap2,occupancy_grid"
    published(ros, yaml.safe_load(network()))
    one = robot("--once", "--on-change", "nav2", "--on-change", "topological", formats=formats)
    assert one.end() == 0, one.lines
    assert [line.split()[2] for line in ros.read_text().splitlines()] == [
        "/map_server/load_map",
        "/topological_map_manager2/switch_topological_map",
    ]
    api.upload(place, {"n.tmap2.yaml": network(1, 599)})
    published(ros, yaml.safe_load(network(1, 599)))
    again = robot("--once", "--on-change", "nav2", "--on-change", "topological", formats=formats)
    assert again.end() == 0, again.lines
    assert len(ros.read_text().splitlines()) == 3, "the grid did not change"
    name = f"versions/{json.loads((one.into / 'current' / 'manifest.json').read_bytes())['version']}-"
    assert name in ros.read_text().splitlines()[-1], "the file of this very version, not of the link"

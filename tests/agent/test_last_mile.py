"""End to end: a complete site on the robot's disk, and closures that block and release its route."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.agent.conftest import Robot, Start
from tests.api.conftest import Api
from tests.events.conftest import eventually

EVERYTHING = "occupancy_grid,tmap2,nav2_route"


@pytest.fixture(scope="module")
def site(api: Api) -> Callable[[str], str]:
    """Generate a site with seed 7 and promote it: its name."""

    def generate(generator: str) -> str:
        name = f"{generator}-7"
        if api.get(f"environments/{name}", None).status_code == 404:
            api.post("environments", {"name": name})
            answer = api("POST", f"environments/{name}/generations", None, json={"generator": generator, "seed": 7})
            assert answer.status_code in (200, 201, 202), answer.text
            eventually(lambda: api.get(f"environments/{name}").json()["version"] == 1, 120)
            api("PUT", f"environments/{name}/channels/production", 200, json={"version": 1})
        return name

    return generate


def edges(robot: Robot) -> set[str]:
    nodes = yaml.load(robot.file(), yaml.CSafeLoader)["nodes"]
    return {edge["edge_id"] for node in nodes for edge in node["node"]["edges"]}


def lines(robot: Robot) -> set[tuple[int, int]]:
    """The edges of the route graph, by the numbers of their nodes."""
    features = json.loads(robot.file("nav2_route/graph.geojson"))["features"]
    return {(f["properties"]["startid"], f["properties"]["endid"]) for f in features if "startid" in f["properties"]}


def variable(robot: Robot, name: str) -> str:
    """What a shell that sources environment.sh has in a variable."""
    script = f'. "{robot.into}/current/environment.sh"; printf %s "${name}"'
    return subprocess.run(["/bin/sh", "-c", script], capture_output=True, text=True, check=True).stdout


def test_office_comes_with_both_levels(site: Callable[[str], str], robot: Start) -> None:
    name = site("office")
    one = robot(env=name, formats="occupancy_grid,tmap2", name="office")
    one.wait("active", 90)
    current = one.into / "current"
    levels = {level["name"]: level for level in json.loads((current / "levels.json").read_text())["levels"]}
    upper = next(level for level in levels if level != "ground")
    assert levels[upper]["elevation"] > 2.0
    assert "map.yaml" in levels["ground"]["files"]["occupancy_grid"]
    assert f"{upper}/map.yaml" in levels[upper]["files"]["occupancy_grid"]
    for folder in ("", f"{upper}/"):
        map_yaml = yaml.safe_load((current / "occupancy_grid" / f"{folder}map.yaml").read_text())
        assert (current / "occupancy_grid" / folder / map_yaml["image"]).stat().st_size > 10_000
    assert variable(one, "COSTMAP_YAML_FILE") == str(current / "occupancy_grid" / "map.yaml")


def test_polytunnels_come_with_their_drawn_masks(site: Callable[[str], str], robot: Start) -> None:
    one = robot(env=site("polytunnels"), formats="occupancy_grid", name="tunnels")
    one.wait("active", 90)
    files = {p.name for p in (one.into / "current" / "occupancy_grid").iterdir()}
    assert {"map.yaml", "keepout.yaml", "keepout.pgm", "keepout_filter_info.yaml"} <= files
    assert variable(one, "NOGO_COSTMAP_YAML_FILE").endswith("/occupancy_grid/keepout.yaml")


@pytest.mark.parametrize("level", ["ground", "upper"])
def test_accepted_closure_blocks_robot_until_its_end(
    api: Api, site: Callable[[str], str], robot: Start, tmp_path: Path, level: str
) -> None:
    """A robot reports an edge, an editor accepts with one call; nobody calls anything when the time is over."""
    name = site("office")
    topology = api.get(f"environments/{name}/versions/production/layers/topology?crs=local").json()["features"]
    on_level = [f for f in topology if (f["level"] == "ground") == (level == "ground")]
    edge = next(f for f in on_level if f["properties"].get("kind") == "edge" and f.get("place"))
    one = robot(env=name, formats=EVERYTHING, name=f"rover-{level}")
    one.wait("active", 120)
    before, graph = edges(one), lines(one)
    assert edge["id"] in before
    reporter = api.token_for("robot", robot=f"rover-{level}")
    report: dict[str, Any] = {"kind": "blocked", "edge": edge["id"], "ttl_seconds": 12, "detail": "a trolley"}
    pending = reporter.post(f"environments/{name}/overlays", report).json()["id"]
    since = len(one.lines)
    accept = [
        "curl", "--silent", "--fail", "-X", "POST", "-H", f"Authorization: Bearer {api.token}",
        f"{api.url}/api/v1/environments/{name}/overlays/{pending}/accept",
    ]  # fmt: skip
    subprocess.run(accept, check=True, capture_output=True)
    one.wait("active", 60, after=since)
    assert edges(one) == before - {edge["id"]}
    assert len(lines(one)) == len(graph) - 1
    listed = json.loads((one.into / "current" / "closures.json").read_text())["closures"]
    assert [(c["id"], c["edge"]) for c in listed] == [(pending, edge["id"])]
    since = one.lines.index(one.wait("active", after=since), since) + 1
    one.wait("active", 60, after=since)
    assert (edges(one), lines(one)) == (before, graph)

    def is_released() -> bool:
        channel = next(c for c in api.get(f"environments/{name}/channels").json() if c["channel"] == "production")
        return bool(channel["robots"]["holding"] >= 1 and channel["overlays"]["count"] == 0)

    eventually(is_released, 90)

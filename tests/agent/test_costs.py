"""What a change costs a robot, on a real site: all that its agent takes in, of the manifest too."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from app.agent.core import Agent, Options
from tests.api.conftest import ADMIN, Api, running, settings_for

FARM = "data/environment_template/riseholme_park_farm_strawberry_polytunnels/config"


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Api]:
    with running(settings_for(tmp_path_factory.mktemp("server"))) as api:
        yield api


class Robot:
    """An agent that syncs when told: what it then took in, bodies only."""

    def __init__(self, api: Api, env: str, kind: str, into: Path) -> None:
        options = Options(server=str(api.http.base_url), environment=env, formats=(kind,), into=into, token=ADMIN)
        self.said: list[dict[str, Any]] = []
        self._agent = Agent(options, lambda what, **more: self.said.append({"event": what, **more}))
        self._agent.open()
        self.current = into / "current" / kind

    def sync(self) -> int:
        before = self._agent._web.received
        assert self._agent.once(), self.said
        return self._agent._web.received - before

    def close(self) -> None:
        self._agent.close()


def test_a_moved_node_costs_less_than_a_kilobyte(api: Api, shared: Path, tmp_path: Path) -> None:
    network = (shared / FARM / "topological/network.tmap2.yaml").read_bytes()
    found = list(re.finditer(rb"\n      position:\n        x: (\S+)", network))
    x = found[len(found) // 2]
    moved = network[: x.start(1)] + f"{float(x[1]) + 0.25:.6f}".encode() + network[x.end(1) :]
    api.post("environments", {"name": "berries"})
    api.upload("berries", {"network.tmap2.yaml": network})
    robot = Robot(api, "berries", "tmap2", tmp_path / "robot")
    assert robot.sync() > 300_000
    api.upload("berries", {"network.tmap2.yaml": moved})
    assert robot.sync() <= 1000
    assert (robot.current / "network.tmap2.yaml").read_bytes() == api.get("/maps/berries/tmap2").content
    robot.close()


def test_a_changed_block_of_a_large_grid_costs_little_of_its_picture(api: Api, shared: Path, tmp_path: Path) -> None:
    folder = shared / FARM / "metric/map"
    described, picture = (folder / "map.yaml").read_bytes(), (folder / "map.png").read_bytes()
    cells = np.array(Image.open(io.BytesIO(picture)).convert("L"))
    assert cells.shape == (4000, 4000)
    cells[1800:2200, 1500:1900] = 0
    changed = io.BytesIO()
    Image.fromarray(cells).save(changed, "PNG")
    api.post("environments", {"name": "field"})
    api.upload("field", {"map.yaml": described, "map.png": picture})
    robot = Robot(api, "field", "occupancy_grid", tmp_path / "robot")
    robot.sync()
    api.upload("field", {"map.yaml": described, "map.png": changed.getvalue()})
    assert robot.sync() <= 0.15 * len(changed.getvalue())
    robot.close()

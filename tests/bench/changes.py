"""Bytes that a robot's agent receives in one sync after a small change to a real site."""

from __future__ import annotations

import io
import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from app.agent.agent import Agent, AgentOptions

FARM = "data/environment_template/riseholme_park_farm_strawberry_polytunnels/config"

Upload = Callable[[str, dict[str, bytes]], Any]
"""Function (environment, files) that creates a version, and the environment if it does not exist."""


def moved_node(shared: Path, upload: Upload, server: str, token: str) -> int:
    """Move one node of the strawberry polytunnels' network by 25 cm. Returns bytes."""
    network = (shared / FARM / "topological/network.tmap2.yaml").read_bytes()
    matches = list(re.finditer(rb"\n      position:\n        x: (\S+)", network))
    x = matches[len(matches) // 2]
    moved = network[: x.start(1)] + f"{float(x[1]) + 0.25:.6f}".encode() + network[x.end(1) :]
    before, after = {"network.tmap2.yaml": network}, {"network.tmap2.yaml": moved}
    return _cost("moved-node", "tmap2", before, after, upload, server, token)


def changed_block(shared: Path, upload: Upload, server: str, token: str) -> tuple[int, int]:
    """Fill a block of 400 × 400 cells in the polytunnels' grid of 4000 × 4000. Returns bytes and the new PNG's size."""
    folder = shared / FARM / "metric/map"
    described, picture = (folder / "map.yaml").read_bytes(), (folder / "map.png").read_bytes()
    cells = np.array(Image.open(io.BytesIO(picture)).convert("L"))
    if cells.shape != (4000, 4000):
        raise RuntimeError(f"the grid has {cells.shape} cells")
    cells[1800:2200, 1500:1900] = 0
    changed = io.BytesIO()
    Image.fromarray(cells).save(changed, "PNG")
    new = changed.getvalue()
    before, after = {"map.yaml": described, "map.png": picture}, {"map.yaml": described, "map.png": new}
    return _cost("changed-block", "occupancy_grid", before, after, upload, server, token), len(new)


def _cost(
    env: str, kind: str, before: dict[str, bytes], after: dict[str, bytes], upload: Upload, server: str, token: str
) -> int:
    events: list[tuple[str, dict[str, Any]]] = []
    with tempfile.TemporaryDirectory() as folder:
        options = AgentOptions(
            server=server, environment=env, formats=(kind,), into=Path(folder) / "robot", token=token
        )
        upload(env, before)
        agent = Agent(options, lambda event, **more: events.append((event, more)))
        agent.open()
        try:
            _sync(agent, events)
            upload(env, after)
            return _sync(agent, events)
        finally:
            agent.close()


def _sync(agent: Agent, events: list[tuple[str, dict[str, Any]]]) -> int:
    received = agent._web.received
    events.clear()
    if not agent.run_once() or not any(event == "switched" for event, _ in events):
        raise RuntimeError(f"the agent has not switched: {events}")
    return agent._web.received - received

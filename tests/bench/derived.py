"""Time and peak memory of derivations of grids with 20 000 × 14 000 cells (2.8·10⁸).

Each runs in a separate process after the same derivation of a small site, so that native code is compiled. The peak is
the kernel's (VmHWM) of the complete process: Python, libraries, inputs and result.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import shapely

from app import derive
from app.derive import DerivationNotes
from app.model.features import features
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.layers import MAP, NETWORK, SITE, Layers, PartKey
from tests.bench.memory import peak, reset

WIDTH, HEIGHT = 20_000, 14_000
RESOLUTION = 0.05
MOST = 3e9
"""Limit of peak memory, in bytes."""

ROOM = 200
"""Side of a room in cells: ten metres."""


@dataclass(frozen=True)
class Case:
    """One derivation. make(scale) builds the layers; scale is of the sides."""

    name: str
    make: Callable[[float], Layers]
    step: str
    parameters: Mapping[str, Any] = field(default_factory=dict)


def rooms(scale: float) -> Layers:
    """Build rooms of ten metres with doors of one metre to their neighbours, furniture, and an unknown border."""
    height, width = round(HEIGHT * scale), round(WIDTH * scale)
    cells = np.full((height, width), FREE, np.uint8)
    for y in range(0, height, ROOM):
        cells[y : y + 4] = OCCUPIED
    for x in range(0, width, ROOM):
        cells[:, x : x + 4] = OCCUPIED
    for y in range(0, height, ROOM):
        for k, x in enumerate(range(0, width, ROOM)):
            cells[y + 90 : y + 110, x : x + 4] = FREE
            cells[y : y + 4, x + 90 : x + 110] = FREE
            at = 30 + 7 * ((k + y) % 9)
            cells[y + at : y + at + 20, x + 30 : x + 50] = OCCUPIED
    cells[:10], cells[-10:], cells[:, :10], cells[:, -10:] = UNKNOWN, UNKNOWN, UNKNOWN, UNKNOWN
    return Layers({PartKey("occupancy", "ground", MAP): OccupancyGrid(cells, RESOLUTION)})


def yard(scale: float) -> Layers:
    """Build one open yard with a few posts: most cells are free and far from obstacles."""
    height, width = round(HEIGHT * scale), round(WIDTH * scale)
    cells = np.full((height, width), FREE, np.uint8)
    for y in range(ROOM, height - ROOM, 9 * ROOM):
        for x in range(ROOM, width - ROOM, 9 * ROOM):
            cells[y : y + 6, x : x + 6] = OCCUPIED
    cells[:4], cells[-4:], cells[:, :4], cells[:, -4:] = OCCUPIED, OCCUPIED, OCCUPIED, OCCUPIED
    return Layers({PartKey("occupancy", "ground", MAP): OccupancyGrid(cells, RESOLUTION)})


def walls(scale: float) -> Layers:
    """Build the walls of as many rooms, as lines; the last ones in the corners give the grid its full size."""
    side, width, height = ROOM * RESOLUTION, WIDTH * scale * RESOLUTION, HEIGHT * scale * RESOLUTION
    rows: list[tuple[str, Any, dict[str, Any]]] = []
    for x in np.arange(1.0, width - 2.0, side).tolist():
        for y in np.arange(1.0, height - 2.0, side).tolist():
            for a, b in (((x, y), (x + 4.0, y)), ((x, y), (x, y + 4.0))):
                rows.append((f"wall{len(rows)}", shapely.LineString([a, b]), {"kind": "wall", "width": 0.2}))
    corners = [(0.1, 0.1), (width - 0.1, height - 0.1)]
    rows += [(f"post{k}", shapely.Point(at), {"kind": "post", "width": 0.1}) for k, at in enumerate(corners)]
    return Layers({PartKey("objects", "ground", SITE): features(rows, "local")})


def aisles(scale: float) -> Layers:
    """Build a network of paths two metres wide, ten metres apart."""
    side, width, height = ROOM * RESOLUTION, WIDTH * scale * RESOLUTION, HEIGHT * scale * RESOLUTION
    xs = [*np.arange(2.0, width - 2.0, side).tolist(), width - 2.1]
    ys = [*np.arange(2.0, height - 2.0, side).tolist(), height - 2.1]
    rows: list[tuple[str, Any, dict[str, Any]]] = [
        (f"{i}/{j}", shapely.Point(x, y), {"kind": "node"}) for i, x in enumerate(xs) for j, y in enumerate(ys)
    ]
    for i, x in enumerate(xs):
        for j, y in enumerate(ys):
            for k, m in ((i + 1, j), (i, j + 1)):
                if k < len(xs) and m < len(ys):
                    line = shapely.LineString([(x, y), (xs[k], ys[m])])
                    properties = {"kind": "edge", "source": f"{i}/{j}", "target": f"{k}/{m}", "width": 2.0}
                    rows.append((f"{i}/{j}-{k}/{m}", line, properties))
    return Layers({PartKey("topology", "ground", NETWORK): features(rows, "local")})


FINE = {"resolution": RESOLUTION}
DRAWN = {**FINE, "padding": 0.0, "outside_free": True}
CASES = {
    case.name: case
    for case in (
        Case("objects → grid", walls, "objects_to_occupancy", DRAWN),
        Case("objects → grid, inflated", walls, "objects_to_occupancy", {**DRAWN, "inflate": 0.3}),
        Case("network → grid", aisles, "topology_to_occupancy", FINE),
        Case("rooms → skeleton", rooms, "occupancy_to_topology"),
        Case("rooms → roadmap", rooms, "occupancy_to_topology", {"method": "roadmap", "samples": 50_000}),
        Case("rooms → Voronoi diagram", rooms, "occupancy_to_topology", {"method": "voronoi"}),
        Case("yard → skeleton", yard, "occupancy_to_topology"),
        Case("yard → Voronoi diagram", yard, "occupancy_to_topology", {"method": "voronoi"}),
    )
}
SMALL = 0.05


def measure(name: str) -> dict[str, Any]:
    """Measure one case in a separate process."""
    command = [sys.executable, "-m", "tests.bench.derived", name]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{name}: {done.stderr[-2000:]}")
    figures: dict[str, Any] = json.loads(done.stdout)
    return {"map": name, **figures, "holds": figures["peak"] <= MOST}


def run(case: Case, scale: float) -> Layers:
    """Run the derivation once."""
    derivation = derive.all_derivations()[case.step]
    return derivation.function(case.make(scale), derivation.parameters(**case.parameters), DerivationNotes())


def _child(name: str) -> None:
    case = CASES[name]
    run(case, SMALL)
    derivation = derive.all_derivations()[case.step]
    layers, options = case.make(1.0), derivation.parameters(**case.parameters)
    reset()
    start = time.perf_counter()
    derived_layers = derivation.function(layers, options, DerivationNotes())
    spent = time.perf_counter() - start
    (part,) = derived_layers.parts.values()
    size = part.cells.size if isinstance(part, OccupancyGrid) else len(part)  # type: ignore[arg-type]
    print(json.dumps({"ms": spent * 1e3, "peak": peak(), "result": size}))


if __name__ == "__main__":
    _child(sys.argv[1])

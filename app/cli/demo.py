"""The demo: a small orchard of our own making, so that a newcomer has something to ask for.

Sixty by forty metres: six tree rows, five aisles, a yard with a barn and a charging dock. Everything is computed from
the numbers below, written by the same formats that serve maps, and uploaded over HTTP like anybody's files.
"""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app import formats
from app.cli.client import Client, Refused, path_of
from app.cli.folder import single
from app.formats import WriteContext
from app.model.features import Features
from app.model.frame import GROUND, Datum
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.layers import MAP, NETWORK, SITE, ZONES, Layers, Part, PartKey

NAME = "orchard"
TITLE = "Demo orchard"
DATUM = Datum(latitude=52.4205, longitude=5.6132)
"""The yard's south-west corner: the local origin. x runs east along the tree rows."""

FENCE = ((-4.0, -4.0), (64.0, -4.0), (64.0, 38.0), (58.0, 44.0), (-4.0, 44.0))
ROWS = (6.0, 12.0, 18.0, 24.0, 30.0, 36.0)
"""y of each tree row, metres."""

FIRST_TREE, LAST_TREE, TREE_STEP, TRUNK = 14.0, 54.0, 4.0, 0.3
"""x of the first and last tree of a row, between two trees, and a trunk's radius; metres."""

HEADLANDS = (10.0, 58.0)
"""x of the tracks that join the aisles, west and east."""

AISLES = tuple((a + b) / 2 for a, b in itertools.pairwise(ROWS))
ONE_WAY = 2
"""This aisle is driven from west to east only."""

BARN = (-2.0, 24.0, 5.0, 36.0)
"""West, south, east, north; metres."""

TANK = (6.5, 20.0)
DOCK, GATE, YARD = (2.0, 6.0), (-4.0, 16.0), (4.0, 12.0)
RESOLUTION = 0.2


def layers() -> Layers:
    """The orchard in canonical layers, all in the local frame."""
    parts: dict[PartKey, Part] = {
        PartKey("location", GROUND, SITE): _features([("fence", shapely.Polygon(FENCE), {"kind": "fence"})]),
        PartKey("topology", GROUND, NETWORK): _network(),
        PartKey("occupancy", GROUND, MAP): _grid(),
        PartKey("objects", GROUND, "geojson"): _objects(),
        PartKey("zones", GROUND, ZONES): _zones(),
    }
    return Layers(parts, DATUM)


def files() -> dict[str, bytes]:
    """The orchard as an environment_template's files: what ``fleetmap import`` would find in a folder."""
    whole = layers()
    out: dict[str, bytes] = {}
    for folder, name, wanted in (
        ("config/location", "datum", ("location",)),
        ("config/topological", "tmap2", ("topology",)),
        ("config/metric/map", "occupancy_grid", ("occupancy",)),
        ("config/world", "geojson", ("objects", "zones")),
    ):
        kept = Layers({k: p for k, p in whole.parts.items() if k.layer in wanted}, whole.datum, whole.levels)
        made = formats.write(formats.get_format(name), kept, WriteContext(title=NAME))
        out |= {f"{folder}/{file}": data for file, data in made.items()}
    return out


def install(client: Client) -> dict[str, Any]:
    """Make sure that the demo is on the server: ``{environment, version, created}``.

    Where the environment holds something already, it stays as it is, with whatever its users made of it.
    """
    try:
        client.post("/environments", {"name": NAME, "title": TITLE, "tags": ["demo"]})
    except Refused as refused:
        if refused.status != 409:
            raise
    head = client.get(path_of("environments", NAME, "versions", "latest"))
    if any(kind != "missing" for kind in (head.get("information") or {}).values()):
        return {"environment": NAME, "version": head["version"], "created": False}
    with tempfile.TemporaryDirectory(prefix="fleetmap-demo-") as folder:
        uploads = []
        for name, data in files().items():
            path = Path(folder) / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
            uploads.append(single(path, name))
        _, made = client.upload(path_of("environments", NAME, "versions"), uploads, {"message": "demo orchard"})
    return {"environment": NAME, "version": made["version"], "created": True}


def curl_lines(server: str, token: str | None) -> list[str]:
    """Three commands to paste: which map am I on, the network, and all of it as KML."""
    access = f'-H "Authorization: Bearer {token}" ' if token else ""
    return [
        f'curl {access}"{server}/api/v1/environments?contains={DATUM.latitude},{DATUM.longitude}"',
        f'curl {access}"{server}/maps/{NAME}/tmap2"',
        f'curl {access}-o {NAME}.kml "{server}/maps/{NAME}/kml"',
    ]


def _features(items: Sequence[tuple[str, Any, dict[str, Any]]]) -> Features:
    geometry: NDArray[np.object_] = np.empty(len(items), object)
    geometry[:] = [shape for _, shape, _ in items]
    return Features(
        tuple(i for i, _, _ in items), geometry, tuple(p for _, _, p in items), np.ones(len(items), np.bool_)
    )


def _network() -> Features:
    places: dict[str, tuple[float, float]] = {"Dock": DOCK, "Gate": GATE, "Yard": YARD}
    for number, y in enumerate(AISLES, 1):
        places[f"Aisle{number}West"], places[f"Aisle{number}East"] = (HEADLANDS[0], y), (HEADLANDS[1], y)
    nodes = [
        (name, shapely.Point(at), {"kind": "node", "name": name, "orientation": [0.0, 0.0, 0.0, 1.0]})
        for name, at in places.items()
    ]
    ways = [("Dock", "Yard"), ("Gate", "Yard"), ("Yard", "Aisle1West"), ("Yard", "Aisle2West")]
    for side in ("West", "East"):
        ways += [(f"Aisle{n}{side}", f"Aisle{n + 1}{side}") for n in range(1, len(AISLES))]
    aisles = [(f"Aisle{n}West", f"Aisle{n}East") for n in range(1, len(AISLES) + 1)]
    edges = []
    for start, end in ways + aisles:
        one_way = (start, end) == aisles[ONE_WAY]
        speed = 0.8 if (start, end) in aisles else 1.2
        for source, target in ((start, end),) if one_way else ((start, end), (end, start)):
            line = shapely.LineString([places[source], places[target]])
            words = {"kind": "edge", "source": source, "target": target, "action": "move_base", "speed_limit": speed}
            edges.append((f"{source}_{target}", line, words))
    return _features(nodes + edges)


def _trees() -> list[tuple[float, float]]:
    count = round((LAST_TREE - FIRST_TREE) / TREE_STEP) + 1
    return [(FIRST_TREE + TREE_STEP * k, y) for y in ROWS for k in range(count)]


def _objects() -> Features:
    items: list[tuple[str, Any, dict[str, Any]]] = [
        ("barn", shapely.box(*BARN), {"kind": "building", "name": "Barn"}),
        ("tank", shapely.Point(TANK), {"kind": "poi", "name": "Water tank"}),
        ("charger", shapely.Point(DOCK), {"kind": "poi", "name": "Charging dock"}),
    ]
    for number, y in enumerate(ROWS, 1):
        line = shapely.LineString([(FIRST_TREE, y), (LAST_TREE, y)])
        items.append((f"row{number}", line, {"kind": "tree_row", "name": f"Row {number}"}))
    return _features(items)


def _zones() -> Features:
    around = shapely.box(TANK[0] - 1.5, TANK[1] - 1.5, TANK[0] + 1.5, TANK[1] + 1.5)
    yard = shapely.box(-4.0, -4.0, 8.0, 18.0)
    return _features(
        [
            ("keepout-tank", around, {"kind": "keepout", "name": "Water tank"}),
            ("speed-yard", yard, {"kind": "speed", "name": "Yard", "value": 0.5}),
        ]
    )


def _grid() -> OccupancyGrid:
    west, south, east, north = shapely.Polygon(FENCE).buffer(2.0).bounds
    west, south = (np.floor(v / RESOLUTION) * RESOLUTION for v in (west, south))
    x = west + RESOLUTION * (np.arange(round((east - west) / RESOLUTION)) + 0.5)
    y = south + RESOLUTION * (np.arange(round((north - south) / RESOLUTION)) + 0.5)
    xs, ys = np.meshgrid(x, y)
    inside = shapely.contains_xy(shapely.Polygon(FENCE), xs, ys)
    cells = np.where(inside, FREE, UNKNOWN).astype(np.uint8)
    solid = [shapely.Polygon(FENCE).exterior.buffer(RESOLUTION), shapely.box(*BARN)]
    solid += [shapely.Point(at).buffer(TRUNK) for at in _trees()] + [shapely.Point(TANK).buffer(1.0)]
    gate = shapely.Point(GATE).buffer(1.5)
    cells[shapely.contains_xy(shapely.union_all(solid).difference(gate), xs, ys)] = OCCUPIED
    return OccupancyGrid(cells, RESOLUTION, (float(np.round(west, 9)), float(np.round(south, 9)), 0.0))

"""Synthetic large maps: time of a conversion, and memory above that of the idle process.

Each is measured in a separate process after the conversion of a small map of the same kind, so that libraries are
loaded. The peak is the kernel's (VmHWM), so it counts what any library allocates, and the input itself.
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from app import formats
from app.convert.files import offline_paths
from app.limits import Limits
from app.model.frame import Datum
from app.model.layers import Layers, PartKey
from app.model.voxels import LOG_ODDS, VoxelMap, morton
from app.upload_reader import UploadHints
from tests.bench.memory import peak, reset, resident

SEED = 2026
TEXT_TIMES, RASTER_TIMES = 10.0, 3.0
TEXT = 20_000_000
"""Minimum size in bytes of text files that the memory bound applies to."""


@dataclass(frozen=True)
class Case:
    """One conversion. make(scale) builds the files; small: scale of the conversion before. decoded: bytes of a raster's
    pixels, the unit of its bound; None for text. bounded: whether the bound applies to a map of this size."""

    name: str
    make: Callable[[float], dict[str, bytes]]
    to: str
    decoded: int | None = None
    bounded: bool = False
    options: Mapping[str, str] = field(default_factory=dict)
    datum: Datum | None = None


# --- synthetic maps -----------------------------------------------------------------------------------------------
def octree(kind: str) -> Callable[[float], dict[str, bytes]]:
    """Build a hilly terrain of 3.5 million leaves: the ground, and free space above it."""

    def make(scale: float) -> dict[str, bytes]:
        dice = np.random.default_rng(SEED)
        side = round(1323 * scale**0.5)
        x, y = (v.ravel() for v in np.meshgrid(np.arange(side) - side // 2, np.arange(side) - side // 2))
        hills = 40 * np.sin(x / 90) * np.cos(y / 70)
        z = np.round(hills + dice.normal(0, 1.5, len(x))).astype(np.int64)
        code = np.concatenate([morton(x, y, z), morton(x, y, z + 1)])
        odds = np.repeat(np.array([LOG_ODDS[1], LOG_ODDS[0]], np.float32), len(x))
        if kind == "ot":
            odds = (odds * dice.uniform(0.2, 1.0, len(odds))).astype(np.float32)
        order = np.argsort(code)
        depth = np.full(len(code), 16, np.uint8)
        voxels = VoxelMap(0.05, depth, code[order], odds[order], None, kind == "bt")
        fmt = formats.get_format("octomap")
        return formats.write(fmt, Layers({PartKey("voxels"): voxels}), formats.WriteContext())

    return make


def osm(nodes: int) -> Callable[[float], dict[str, bytes]]:
    """Build a town like an OSM export: a fifth of the nodes in streets, the others corners of houses, with history."""

    def make(scale: float) -> dict[str, bytes]:
        dice = np.random.default_rng(SEED)
        side = max(4, round((nodes * scale / 5) ** 0.5))
        lon = -93.2 + np.arange(side) * 0.0012 + dice.normal(0, 1e-4, (side, side))
        lat = 44.7 + (np.arange(side) * 0.0009)[:, None] + dice.normal(0, 1e-4, (side, side))
        corners = [(a + 0.0002 + da, b + 0.0003 + db) for a, b in zip(lat.ravel().tolist(), lon.ravel().tolist(), strict=True) for da, db in ((0, 0), (0, 1e-4), (1e-4, 1e-4), (1e-4, 0))]  # fmt: skip  # noqa: E501
        places = [*zip(lat.ravel().tolist(), lon.ravel().tolist(), strict=True), *corners]
        changes = dice.integers(10**6, 10**8, len(places)).tolist()
        history = [f'version="{c % 7 + 1}" changeset="{c}" timestamp="20{c % 24:02}-{c % 12 + 1:02}-{c % 28 + 1:02}T12:{c % 60:02}:00Z" user="mapper {c % 97}" uid="{9000 + c % 97}"' for c in changes]  # fmt: skip  # noqa: E501
        out = ['<?xml version="1.0" encoding="UTF-8"?>', '<osm version="0.6" generator="made up">']
        out.append(' <bounds minlat="44.69" minlon="-93.21" maxlat="46" maxlon="-91"/>')
        out += [
            f' <node id="{4_000_000_000 + k}" visible="true" {h} lat="{a:.7f}" lon="{b:.7f}"/>'
            for k, ((a, b), h) in enumerate(zip(places, history, strict=True))
        ]
        ids = np.arange(side * side).reshape(side, side) + 4_000_000_000
        number = 0
        for k in range(side):
            for line in (ids[k], ids[:, k]):
                for start in range(0, side - 1, 12):
                    number += 1
                    refs = "".join(f'\n  <nd ref="{r}"/>' for r in line[start : start + 13].tolist())
                    kind = ("residential", "footway", "service", "tertiary")[number % 4]
                    tags = "".join(f'\n  <tag k="{key}" v="{v}"/>' for key, v in (("highway", kind), ("name", f"Street {k}"), ("surface", "asphalt")))  # fmt: skip  # noqa: E501
                    out.append(
                        f' <way id="{number}" visible="true" {history[number % len(history)]}>{refs}{tags}\n </way>'
                    )
        for k in range(side * side):
            first = 4_000_000_000 + side * side + 4 * k
            refs = "".join(f'\n  <nd ref="{first + corner}"/>' for corner in (0, 1, 2, 3, 0))
            tags = f'\n  <tag k="building" v="house"/>\n  <tag k="addr:housenumber" v="{k % 120}"/>\n  <tag k="addr:street" v="Street {k // side}"/>'  # fmt: skip  # noqa: E501
            out.append(f' <way id="{10**6 + k}" visible="true" {history[k]}>{refs}{tags}\n </way>')
        out.append("</osm>\n")
        return {"map.osm": "\n".join(out).encode()}

    return make


def building(vertices: int) -> Callable[[float], dict[str, bytes]]:
    """Build a hall of aisles: named vertices, lanes in both directions, walls."""

    def make(scale: float) -> dict[str, bytes]:
        dice = np.random.default_rng(SEED)
        side = max(3, round((vertices * scale) ** 0.5))
        places = dice.uniform(-0.3, 0.3, (side, side, 2)) + np.indices((side, side)).transpose(1, 2, 0) * 2
        rows = [f"      - [{x!r}, {y!r}, 0, place_{k}]" for k, (x, y) in enumerate(places.reshape(-1, 2).tolist())]
        lane = '{bidirectional: [4, true], demo_mock_floor_name: [1, ""], demo_mock_lift_name: [1, ""], graph_idx: [2, 0], mutex: [1, ""], orientation: [1, ""], speed_limit: [3, 0.5]}'  # noqa: E501
        ids = np.arange(side * side).reshape(side, side)
        pairs = np.concatenate([np.stack([ids[:, :-1], ids[:, 1:]], -1).reshape(-1, 2), np.stack([ids[:-1], ids[1:]], -1).reshape(-1, 2)])  # fmt: skip  # noqa: E501
        lanes = [f"      - [{a}, {b}, {lane}]" for a, b in pairs.tolist()]
        wall = "{alpha: [3, 1], texture_height: [3, 2.5], texture_name: [1, default]}"
        walls = [f"      - [{a}, {b}, {wall}]" for a, b in pairs[::5].tolist()]
        text = "\n".join(
            [
                *("coordinate_system: cartesian_meters", "levels:", "  L1:", "    elevation: 0", "    lanes:", *lanes),
                *("    vertices:", *rows, "    walls:", *walls, "lifts: {}", "name: hall", ""),
            ]
        )
        return {"hall.building.yaml": text.encode()}

    return make


def graph(vertices: int) -> Callable[[float], dict[str, bytes]]:
    """Build a navigation graph like ``building_map_generator nav``: a hall of aisles, some vertices named."""

    def make(scale: float) -> dict[str, bytes]:
        dice = np.random.default_rng(SEED)
        side = max(3, round((vertices * scale) ** 0.5))
        places = dice.uniform(-0.3, 0.3, (side, side, 2)) + np.indices((side, side)).transpose(1, 2, 0) * 2
        ids = np.arange(side * side).reshape(side, side)
        pairs = np.concatenate([np.stack([ids[:, :-1], ids[:, 1:]], -1).reshape(-1, 2), np.stack([ids[:-1], ids[1:]], -1).reshape(-1, 2)])  # fmt: skip  # noqa: E501
        both = np.stack([pairs, pairs[:, ::-1]], 1).reshape(-1, 2).tolist()
        lanes = [f"    - - {a}\n      - {b}\n      - {{speed_limit: 0.5}}" for a, b in both]
        names = [f"place_{k}" if k % 3 == 0 else "''" for k in range(side * side)]
        named = zip(places.reshape(-1, 2).tolist(), names, strict=True)
        rows = [f"    - - {x!r}\n      - {y!r}\n      - {{name: {name}}}" for (x, y), name in named]
        text = ["building_name: hall", "doors: {}", "levels:", "  L1:", "    lanes:", *lanes, "    vertices:", *rows]
        return {"0.yaml": "\n".join([*text, "lifts: {}", ""]).encode()}

    return make


def lanes(count: int) -> Callable[[float], dict[str, bytes]]:
    """Build streets of lanelets, five points on each bound, like Autoware's editors: degrees, metres, elevation."""

    def make(scale: float) -> dict[str, bytes]:
        dice = np.random.default_rng(SEED)
        streets = max(2, round((count * scale / 4) ** 0.5))
        length = 4 * streets
        points, ways, relations = [], [], []
        x = np.arange(4 * length + 1) * 2.5
        for street in range(streets):
            first = []
            for side in range(2):
                y = 40.0 * street + 3.5 * side + np.cumsum(dice.normal(0, 0.02, len(x)))
                z = 40 + np.cumsum(dice.normal(0, 0.01, len(x)))
                first.append(len(points) + 1)
                points += [
                    f'  <node id="{k}" lat="{35.2 + b / 111_000:.11f}" lon="{138.8 + a / 91_000:.11f}">\n'
                    f'    <tag k="local_x" v="{a:.4f}"/>\n    <tag k="local_y" v="{b:.4f}"/>\n'
                    f'    <tag k="ele" v="{c:.4f}"/>\n  </node>'
                    for k, (a, b, c) in enumerate(zip(x.tolist(), y.tolist(), z.tolist(), strict=True), first[-1])
                ]
            for lane in range(length):
                number = 10**8 + 3 * (street * length + lane)
                for side in range(2):
                    refs = "".join(f'\n    <nd ref="{first[side] + 4 * lane + k}"/>' for k in range(5))
                    ways.append(
                        f'  <way id="{number + side}">{refs}\n    <tag k="type" v="line_thin"/>\n'
                        '    <tag k="subtype" v="solid"/>\n  </way>'
                    )
                tags = {"type": "lanelet", "subtype": "road", "speed_limit": str(30 + 10 * (street % 3)), "location": "urban", "one_way": "yes"}  # fmt: skip  # noqa: E501
                relations.append(
                    f'  <relation id="{number + 2}">\n    <member type="way" role="left" ref="{number + 1}"/>\n'
                    f'    <member type="way" role="right" ref="{number}"/>'
                    + "".join(f'\n    <tag k="{k}" v="{v}"/>' for k, v in tags.items())
                    + "\n  </relation>"
                )
        head = ['<?xml version="1.0" encoding="UTF-8"?>', '<osm generator="VMB">']
        return {"map.osm": "\n".join([*head, *points, *ways, *relations, "</osm>", ""]).encode()}

    return make


def photo(end: str, noise: float) -> Callable[[float], dict[str, bytes]]:
    """Build an aerial RGB image of 8000 × 8000 pixels: fields, and noise of this width on every pixel."""

    def make(scale: float) -> dict[str, bytes]:
        from app.model.imagery import GeoImage

        dice = np.random.default_rng(SEED)
        side = max(8, round(PIXELS**0.5 * scale**0.5))
        pixels = np.empty((side, side, 3), np.uint8)
        x = np.arange(side)
        for y in range(side):
            shade = (np.sin(x / 70) + np.cos(y / 90)) * 60 + 120
            grain = dice.integers(0, 256, (side, 3)) if noise >= 256 else dice.normal(0, noise, (side, 3))
            pixels[y] = grain if noise >= 256 else np.clip(shade[:, None] + np.array([0, 10, 20]) + grain, 0, 255)
        picture = GeoImage(pixels, (0.1, 0.0, 665000.0, 0.0, -0.1, 5905000.0), "EPSG:32630")
        fmt = formats.get_format("satellite")
        options = formats.write_options(fmt, {"file_type": end})
        return formats.write(fmt, Layers({PartKey("imagery"): picture}), formats.WriteContext(options=options))

    return make


def grid(end: str) -> Callable[[float], dict[str, bytes]]:
    """Build a grid of 5714 × 3197 cells: rooms, noise, unknown cells around them."""

    def make(scale: float) -> dict[str, bytes]:
        from PIL import Image

        dice = np.random.default_rng(SEED)
        height, width = round(3197 * scale**0.5), round(5714 * scale**0.5)
        pixels = np.full((height, width), 254, np.uint8)
        pixels[::97] = 0
        pixels[:, ::131] = 0
        pixels[dice.random((height, width)) < 0.01] = 0
        pixels[: height // 5] = 205
        text = f"image: map.{end}\nresolution: 0.05\norigin: [-10, -20, 0]\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"  # noqa: E501
        if end == "pgm":
            return {"map.yaml": text.encode(), "map.pgm": b"P5\n%d %d\n255\n" % (width, height) + pixels.tobytes()}
        import io

        out = io.BytesIO()
        Image.fromarray(pixels).save(out, "PNG")
        return {"map.yaml": text.encode(), "map.png": out.getvalue()}

    return make


def cloud(scale: float) -> dict[str, bytes]:
    """Build a point cloud as text."""
    dice = np.random.default_rng(SEED)
    n = round(TEXT / 27 * scale) + 1000
    rows = "\n".join(map("%.6f %.6f %.6f".__mod__, map(tuple, dice.uniform(-50, 50, (n, 3)).tolist())))
    head = f"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH {n}\nHEIGHT 1\nDATA ascii\n"
    return {"map.pcd": (head + rows + "\n").encode()}


CELLS = 5714 * 3197
PIXELS = 8000 * 8000
FIELD = Datum(53.27, -0.52)
TURNED = 4 * 8256 * 8256
"""Bytes of the image resampled to the axes of the local frame, which has another band for its mask."""
CASES = {
    case.name: case
    for case in (
        Case("octree of 3.5 million leaves, .bt → .bt", octree("bt"), "octomap"),
        Case("octree of 3.5 million leaves, .ot → .ot", octree("ot"), "octomap"),
        Case("octree of 3.5 million leaves → grid", octree("bt"), "occupancy_grid"),
        Case("OSM of 30 000 nodes → osm", osm(30_000), "osm"),
        Case("OSM of 30 000 nodes → tmap2", osm(30_000), "tmap2"),
        Case("building of 4 MB → openrmf", building(10_500), "openrmf"),
        Case("building of 4 MB → rmf_nav_graph", building(10_500), "rmf_nav_graph"),
        Case("OSM of 20 MB → osm", osm(80_000), "osm", bounded=True),
        Case("OSM of 20 MB → tmap2", osm(80_000), "tmap2", bounded=True),
        Case("building of 20 MB → openrmf", building(55_000), "openrmf", bounded=True),
        Case("building of 20 MB → rmf_nav_graph", building(55_000), "rmf_nav_graph", bounded=True),
        # Not bounded: a feature has 59 bytes of text, and takes ten times as much in memory.
        Case("navigation graph of 20 MB → rmf_nav_graph", graph(85_000), "rmf_nav_graph"),
        Case("Lanelet2 of 30 MB → lanelet2", lanes(14_500), "lanelet2", bounded=True),
        Case("Lanelet2 of 30 MB → tmap2", lanes(14_500), "tmap2", bounded=True, datum=Datum(35.2, 138.8)),
        Case("points of 20 MB of text → octomap", cloud, "octomap", bounded=True),
        Case("grid of 5714 × 3197, PGM → PGM", grid("pgm"), "occupancy_grid", CELLS, bounded=True),
        Case("grid of 5714 × 3197, PNG → PNG", grid("png"), "occupancy_grid", CELLS, True, {"file_type": "png"}),
        Case("picture of 8000 × 8000, PNG → TIFF", photo("png", 4), "satellite", 3 * PIXELS, True),
        Case("picture of 8000 × 8000, PNG → PNG", photo("png", 4), "satellite", 3 * PIXELS, True, {"file_type": "png"}),
        Case("picture of 8000 × 8000, TIFF → TIFF", photo("tif", 4), "satellite", 3 * PIXELS, True),
        Case(
            "picture of 8000 × 8000, TIFF → local", photo("tif", 4), "satellite", TURNED, True, {"crs": "local"}, FIELD
        ),
        Case("noise of 8000 × 8000, TIFF → TIFF", photo("tif", 256), "satellite", 3 * PIXELS, True),
    )
}
SMALL = 0.002


# --- measuring ----------------------------------------------------------------------------------------------------
def measure(name: str, folder: Path) -> dict[str, Any]:
    """Measure one case in a separate process."""
    files = CASES[name].make(1.0)
    for file, data in files.items():
        (folder / file).write_bytes(data)
    size = sum(map(len, files.values()))
    command = [sys.executable, "-m", "tests.bench.large", name, str(folder), *files]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"{name}: {done.stderr[-2000:]}")
    figures = json.loads(done.stdout)
    case = CASES[name]
    bound = None
    if case.bounded:
        bound = RASTER_TIMES * case.decoded if case.decoded else TEXT_TIMES * size
    return {
        "map": name,
        "input_mb": size / 1e6,
        "ms": figures["ms"],
        "peak_mb": figures["peak"] / 1e6,
        "times": figures["peak"] / (case.decoded or size),
        "bound": None if bound is None else RASTER_TIMES if case.decoded else TEXT_TIMES,
        "holds": bound is None or (figures["peak"] <= bound and (case.decoded is not None or size >= TEXT)),
    }


def _child(name: str, folder: Path, files: list[str]) -> None:
    case = CASES[name]

    def convert(paths: Mapping[str, Path]) -> None:
        offline_paths(paths, case.to, UploadHints(), case.datum, case.options, Limits())

    small = folder / "small"
    small.mkdir()
    for file, data in case.make(SMALL).items():
        (small / file).write_bytes(data)
    convert({file: small / file for file in files})
    idle = resident()
    reset()
    start = time.perf_counter()
    convert({file: folder / file for file in files})
    spent = time.perf_counter() - start
    print(json.dumps({"ms": spent * 1e3, "peak": peak() - idle}))


if __name__ == "__main__":
    _child(sys.argv[1], Path(sys.argv[2]), sys.argv[3:])

"""Natural terrain: hills of gradient noise as a height map, trees in dense vegetation, and the cost of slopes.

The floor of the level is at the top of the highest hill: all ground is below it, so that the grid, a slice above the
floor, shows obstacles on the ground and not the ground. Slopes are a grid of their own.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from app.derive import DerivationNotes
from app.errors import CannotGenerate
from app.generate import MAX_OBJECTS, RandomSource, _cells, generates
from app.generate._noise import Fractal, noise2, noise3
from app.generate._shapes import disc, mm
from app.generate._site import Site, SiteOptions, invalid_option_error
from app.model import masks
from app.model.frame import GROUND
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.layers import MAP, NETWORK, Layers, Part, PartKey
from app.parameters import parameter

Array = NDArray[np.float64]
U8 = NDArray[np.uint8]

FILE = "heightmaps/terrain.png"

POST_INSET_METRES = 0.3
"""Distance of corner posts from the fence in metres."""

MIN_SPEED_PERCENT = 10
"""Percentage of the robot's speed on the steepest ground that it can climb."""


@dataclass(frozen=True, slots=True)
class Options(SiteOptions):
    """Parameters of terrain."""

    width: float = parameter(40.0, "size along x, if there is no fence", minimum=2.0, maximum=5000.0, unit="m")
    depth: float = parameter(40.0, "size along y, if there is no fence", minimum=2.0, maximum=5000.0, unit="m")
    noise: Literal["simplex", "perlin"] = parameter("simplex", "type of gradient noise")
    feature: float = parameter(15.0, "approximate distance between hills", minimum=0.1, maximum=10_000.0, unit="m")
    octaves: int = parameter(4, "number of octaves of noise", minimum=1, maximum=16)
    persistence: float = parameter(0.4, "amplitude of each octave relative to the one before", minimum=0.0, maximum=1.0)
    lacunarity: float = parameter(2.0, "frequency of each octave relative to the one before", minimum=1.0, maximum=8.0)
    relief: float = parameter(
        1.2, "height difference between the lowest and the highest point", minimum=0.01, maximum=1000.0, unit="m"
    )
    epoch: float = parameter(
        0.0, "coordinate in time; close values give similar ground and woods", minimum=-1e6, maximum=1e6
    )
    detail: Literal["65", "129", "257", "513", "1025"] = parameter(
        "257", "number of heights along a side of the height map; Gazebo needs a power of two plus one"
    )
    vegetation: float = parameter(0.25, "share of the ground with trees", minimum=0.0, maximum=1.0)
    spacing: float = parameter(3.0, "distance between trees in the woods", minimum=0.5, maximum=100.0, unit="m")
    grove: float = parameter(12.0, "approximate distance between woods", minimum=0.1, maximum=10_000.0, unit="m")
    climb: float = parameter(15.0, "maximum slope that a robot can climb", minimum=0.1, maximum=89.0, unit="°")
    rough: Literal["costs", "speed", "none"] = parameter(
        "costs",
        "grid of slopes, a Nav2 filter mask: costs (0 flat, 100 too steep), or speed in percent",
    )


@generates(
    {"location", "objects", "occupancy", "topology", "imagery", "resources"},
    parameters=Options,
    also={"location"},
    version=3,
)
def terrain(given: Layers, options: Options, source: RandomSource, notes: DerivationNotes) -> Layers:
    """Hilly ground with woods: a height map for Gazebo, trees, and a grid of slope costs."""
    site = Site(given, options, notes)
    box = site.set_fence(shapely.box(0.0, 0.0, options.width, options.depth)).bounds
    columns, rows = (max(1, int((b - a) / options.spacing)) for a, b in ((box[0], box[2]), (box[1], box[3])))
    if options.vegetation and rows * columns > MAX_OBJECTS:
        raise invalid_option_error(
            "spacing",
            f"there are {columns} × {rows} positions for trees; the limit is {MAX_OBJECTS}: use a larger spacing",
        )
    n = int(options.detail)
    x, y = np.linspace(box[0], box[2], n), np.linspace(box[1], box[3], n)
    share = _heights(x, y, options, source)
    grey = np.rint(share * 255.0).astype(np.uint8)
    height = np.round((share - 1.0) * options.relief, 6)
    floor = site.elevation(GROUND)
    site.files[FILE] = _png(grey[::-1])
    middle = mm((box[0] + box[2]) / 2), mm((box[1] + box[3]) / 2)
    size = [mm(box[2] - box[0]), mm(box[3] - box[1]), mm(options.relief)]
    ground: Mapping[str, Any] = {"type": "heightmap", "file": FILE, "size": size, "position": [0.0, 0.0, 0.0]}
    site.add_object("terrain", "terrain", site.fence, shapes=[ground], pose=(*middle, floor - size[2], 0.0))
    trees = 0
    if options.vegetation:
        trees = _trees(site, (x, y, height), (rows, columns), options, source)
    if not trees:
        _posts(site, (x, y, height), notes)
    layers = site.finish(ground="meadow")
    grid = layers.parts[PartKey("occupancy", GROUND, MAP)]
    if not isinstance(grid, OccupancyGrid):
        raise TypeError("a site has a grid")
    steep = _steepness(grid, (x, y, height)) / round(math.tan(math.radians(options.climb)), 9)
    parts: dict[PartKey, Part] = dict(layers.parts)
    if options.rough == "costs":
        parts[PartKey("occupancy", GROUND, "costs")] = _costs(grid, steep)
    elif options.rough == "speed":
        parts[PartKey("occupancy", GROUND, "speed")] = _speed_mask(grid, steep)
    level = np.where((grid.cells == FREE) & (steep >= 1.0), np.uint8(OCCUPIED), grid.cells)
    topology = _cells.free_space_network(replace(grid, cells=level), options.robot_radius, notes)
    if topology is not None:
        parts[PartKey("topology", GROUND, NETWORK)] = topology
    return Layers(dict(sorted(parts.items())), layers.datum, layers.levels)


def _heights(x: Array, y: Array, options: Options, source: RandomSource) -> Array:
    """Return heights from 0 (the lowest point) to 1, row 0 at the smallest y."""
    fractal = Fractal(options.noise, options.feature, options.octaves, options.persistence, options.lacunarity)
    field = noise3(x, y, np.array([options.epoch]), fractal, source.stream("ground"))[0]
    low, high = float(field.min()), float(field.max())
    if high - low < 1e-9:
        raise CannotGenerate("the ground is flat: use a smaller feature, or more octaves")
    return np.asarray((field - low) / (high - low), np.float64)


def _trees(
    site: Site, ground: tuple[Array, Array, Array], shape: tuple[int, int], options: Options, source: RandomSource
) -> int:
    """Add a tree in each cell of a coarse raster with the densest vegetation; return their number."""
    rows, columns = shape
    low_x, low_y = float(ground[0][0]), float(ground[1][0])
    draw = np.round(source.stream("trees").random((rows, columns, 4)), 6)
    x = np.asarray(low_x + (np.arange(columns) + 0.5) * options.spacing, np.float64)
    y = np.asarray(low_y + (np.arange(rows) + 0.5) * options.spacing, np.float64)
    fractal = Fractal(options.noise, options.grove, 3)
    dense = np.round(noise3(x, y, np.array([options.epoch]), fractal, source.stream("woods"))[0], 9)
    soil = np.round(noise2(x, y, Fractal(options.noise, 2 * options.grove, 2), source.stream("soil")), 9)
    tree_count = max(1, round(options.vegetation * dense.size))
    order = np.argsort(-dense.ravel(), kind="stable")[:tree_count]
    inner = shapely.buffer(site.fence, -0.3)
    shapely.prepare(inner)
    floor = site.elevation(GROUND)
    count = 0
    for place in np.sort(order).tolist():
        r, c = divmod(place, columns)
        u, v, thick, tall = draw[r, c].tolist()
        at = mm(x[c] + (u - 0.5) * 0.6 * options.spacing), mm(y[r] + (v - 0.5) * 0.6 * options.spacing)
        if not inner.contains(shapely.Point(at)):
            continue
        count += 1
        base = mm(float(_heights_at(ground, np.array([at[0]]), np.array([at[1]]))[0]))
        good = 0.5 * (tall + 0.5 + 0.5 * float(soil[r, c]))  # random and of the soil, which lasts
        radius, height = mm(0.1 + 0.15 * thick), mm(5.0 + 7.0 * good)
        # the trunk must reach above the level's floor, wherever its foot is
        stem = mm(0.6 * height - base)
        crown = mm(min(0.22 * height, options.spacing))
        trunk: Mapping[str, Any] = {
            "type": "cylinder",
            "radius": radius,
            "length": stem,
            "pose": [0.0, 0.0, mm(stem / 2), 0.0, 0.0, 0.0],
        }
        leaves: Mapping[str, Any] = {
            "type": "ellipsoid",
            "radii": [crown, crown, mm(0.3 * height)],
            "pose": [0.0, 0.0, mm(stem + 0.1 * height), 0.0, 0.0, 0.0],
            "visual": True,
        }
        site.add_object(
            f"tree/{count}",
            "tree",
            shapely.Point(at),
            shapes=[trunk, leaves],
            pose=(*at, floor + base, 0.0),
            colour=("crown", "crown_light", "crown_dark")[count % 3],
            seen=disc(*at, crown),
            width=mm(2 * radius),
            height=mm(stem + 0.4 * height + base),
        )
    return count


def _posts(site: Site, ground: tuple[Array, Array, Array], notes: DerivationNotes) -> None:
    """Add a post at each corner of bare ground: without any object robots cannot localise."""
    inner = shapely.buffer(site.fence, -POST_INSET_METRES, join_style="mitre")
    if inner.is_empty or inner.geom_type != "Polygon":
        raise CannotGenerate("the ground is too narrow for posts at its corners: set vegetation above 0")
    corners = shapely.get_coordinates(inner.exterior)[:-1]
    for count, (x, y) in enumerate(corners.tolist(), 1):
        base = mm(float(_heights_at(ground, np.array([x]), np.array([y]))[0]))
        length = mm(1.0 - base)
        solid = {
            "type": "cylinder",
            "radius": 0.05,
            "length": length,
            "pose": [0.0, 0.0, mm(length / 2), 0.0, 0.0, 0.0],
        }
        at = mm(x), mm(y)
        site.add_object(
            f"post/{count}",
            "post",
            shapely.Point(at),
            shapes=[solid],
            pose=(*at, site.elevation(GROUND) + base, 0.0),
            colour="wood",
            seen=disc(*at, 0.05),
            width=0.1,
            height=1.0,
        )
    notes.fill("posts", len(corners), "there are no trees; corner posts are landmarks for robots")


def _heights_at(ground: tuple[Array, Array, Array], x: Array, y: Array) -> Array:
    """Return heights at points, interpolated linearly between those of the map."""
    xs, ys, height = ground
    u = np.clip((x - xs[0]) / (xs[-1] - xs[0]), 0.0, 1.0) * (len(xs) - 1)
    v = np.clip((y - ys[0]) / (ys[-1] - ys[0]), 0.0, 1.0) * (len(ys) - 1)
    i, j = np.minimum(u.astype(np.int64), len(xs) - 2), np.minimum(v.astype(np.int64), len(ys) - 2)
    a, b = u - i, v - j
    low = height[j, i] * (1 - a) + height[j, i + 1] * a
    high = height[j + 1, i] * (1 - a) + height[j + 1, i + 1] * a
    return np.asarray(low * (1 - b) + high * b, np.float64)


def _steepness(grid: OccupancyGrid, ground: tuple[Array, Array, Array]) -> Array:
    """Return the slope at each cell of a grid, metres per metre: float64 [height, width]."""
    xs, ys, height = ground
    up_y, up_x = np.gradient(height, ys, xs)
    steep = np.sqrt(up_x * up_x + up_y * up_y)
    r = grid.resolution
    x = np.asarray(grid.origin[0] + (np.arange(grid.width) + 0.5) * r, np.float64)
    out = np.empty((grid.height, grid.width))
    for row in range(grid.height):  # a row at a time: keeps the intermediate arrays small
        y = np.full(grid.width, grid.origin[1] + (row + 0.5) * r)
        out[row] = _heights_at((xs, ys, steep), x, y)
    return np.round(out, 6)


def _costs(grid: OccupancyGrid, steep: Array) -> OccupancyGrid:
    """Return Nav2's keepout mask: 0 if flat, 100 if too steep or occupied, proportional in between."""
    cells = np.where(steep >= 1.0, OCCUPIED, np.floor(np.minimum(steep, 1.0) * 99.0)).astype(np.uint8)
    cells = np.where(grid.cells == FREE, cells, grid.cells).astype(np.uint8)
    properties = {masks.NAME: {"params": masks.params("costs", masks.FilterInfo(masks.KEEPOUT, 0.0, 1.0))}}
    return OccupancyGrid(cells, grid.resolution, grid.origin, mode="raw", properties=properties)


def _speed_mask(grid: OccupancyGrid, steep: Array) -> OccupancyGrid:
    """Return Nav2's speed mask: percent of the robot's speed; 0 (no limit) for cells that robots cannot reach."""
    percent = np.maximum(np.rint(100.0 * (1.0 - np.minimum(steep, 1.0))), MIN_SPEED_PERCENT).astype(np.uint8)
    cells = np.where(grid.cells == UNKNOWN, 0, percent).astype(np.uint8)
    info = masks.FilterInfo(masks.SPEED_PERCENT, 0.0, 1.0)
    properties = {masks.NAME: {"params": masks.params("speed", info)}}
    return OccupancyGrid(cells, grid.resolution, grid.origin, mode="raw", properties=properties)


def _png(grey: U8) -> bytes:
    """Write an 8-bit grey PNG with the same bytes on every machine: uncompressed, because compression differs."""
    rows, columns = grey.shape
    data = np.concatenate([np.zeros((rows, 1), np.uint8), grey], axis=1).tobytes()
    blocks = [b"\x78\x01"]
    for at in range(0, len(data), 65535):
        part = data[at : at + 65535]
        last = at + 65535 >= len(data)
        blocks.append(struct.pack("<BHH", last, len(part), len(part) ^ 0xFFFF) + part)
    blocks.append(struct.pack(">I", zlib.adler32(data)))

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", columns, rows, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", b"".join(blocks)) + chunk(b"IEND", b"")

"""Kind ``site``: made-up sites of several seeds, measured from their layers alone, against real sites.

Keys of a label file:

    generator: orchard            # run with seeds 0, 1, … and no parameters
    seeds: 10
    row_kind: tree_row            # kind of the objects that are rows; they have lines or rectangles
    plant_kind: tree              # kind of the objects that are plants; shapes: the rows' own solids
    ranges: {row_spacing: [2.7, 6.0], …}      # of real sites, metres; every value of every site is within
    varies: [rows, angle, …]      # these have different values on different seeds
    sources: […]

or, for ``generator: wave_function_collapse``:

    map: depot.yaml               # a real grid: the sample
    image: depot.pgm
    closed: true                  # whether walls bound it
    seeds: 3
    size: [15.0, 15.0]            # of the results, metres

An aisle is a strip of free cells 0.6 to 4.5 m wide between obstacles on both sides, and longer than it is wide and 2 m.
It is looked for along rows and columns of cells, in samples and results alike.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray
from PIL import Image

from app import formats, generate
from app.convert.files import write_layers
from app.derive import DerivationNotes
from app.derive.objects_to_occupancy import Parameters, objects_to_occupancy
from app.errors import CannotGenerate
from app.formats import FileGroup, ReadContext
from app.model.features import Features
from app.model.frame import GROUND
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.imagery import GeoImage, display_pixels
from app.model.layers import Layers, PartKey
from app.store.values import Provenance
from tests.derive.judge import Case, Figure, Result
from tests.derive.judge.completion import read_grid

Bool = NDArray[np.bool_]
Values = dict[str, float]
OBJECTS = PartKey("objects", GROUND, "generated")
CHECKED_SEEDS = 2
"""Number of sites whose layers are compared with each other: the world is written, read and cut again."""

AISLE_METRES = (0.6, 4.5)
TILE = 300


def judge(case: Case) -> Result:
    """Generate the sites and measure them."""
    return _wfc(case) if "map" in case.labels else _field(case)


# --- fields and halls ---


def _field(case: Case) -> Result:
    labels = case.labels
    rows, pictures, agreement = [], [], 1.0
    for seed in range(labels["seeds"]):
        layers = generate.run(labels["generator"], seed, {}, Layers(), DerivationNotes())
        rows.append(_measured(layers, labels))
        pictures.append(_seen(layers))
        if seed < CHECKED_SEEDS:
            agreement = min(agreement, _agreement(layers))
    figures = []
    for name, (low, high) in labels["ranges"].items():
        values = [row[name] for row in rows]
        inside = [low - 1e-6 <= v <= high + 1e-6 for v in values]
        figures.append(Figure(f"{name}: within real range", float(np.mean(inside)), at_least=1.0))
        figures += [Figure(f"{name}: least", min(values)), Figure(f"{name}: most", max(values))]
    for name in labels["varies"]:
        count = len({round(row[name], 3) for row in rows})
        at_least = 2 if name in ("docks", "chargers") else max(3, labels["seeds"] // 3)
        figures.append(Figure(f"{name}: different values", count, at_least=at_least))
    figures.append(Figure("agreement of layers", agreement, at_least=0.9999))
    return Result(figures, _sheet(pictures, 5))


def _measured(layers: Layers, labels: Any) -> Values:
    """Return a site's values, from its objects and its network."""
    part = layers.parts[OBJECTS]
    assert isinstance(part, Features)
    kinds = np.array([p["kind"] for p in part.properties])
    areas = part.geometry[kinds == labels["row_kind"]]
    lines = np.array([_axis(area) for area in areas], object)
    middle = shapely.line_interpolate_point(lines, 0.5, normalized=True)
    lateral = _gaps(lines, middle)
    out = {"rows": float(len(lines)), "row_length": float(np.median(shapely.length(lines)))}
    out["row_spacing"] = float(np.median(lateral))
    out["angle"] = _angle(lines)
    out["headland"] = _headland(layers, lines)
    if labels["row_kind"] == "shelf":
        wide = np.array([_width(area) for area in areas])
        out |= {"depth": float(np.median(wide)), "aisle": float(np.median(_gaps(areas, middle, areas)))}
    out["docks"] = float(np.count_nonzero(kinds == "door"))
    out["chargers"] = float(np.count_nonzero(kinds == "machine"))
    if "plant_kind" in labels:
        out |= _plants(part, kinds, lines, labels)
    return out


def _axis(area: Any) -> Any:
    """Return the line along a row."""
    if area.geom_type == "LineString":
        return area
    corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(area))[:4]
    sides = np.hypot(*(corners[1] - corners[0])), np.hypot(*(corners[2] - corners[1]))
    a, b, c, d = corners if sides[0] >= sides[1] else np.roll(corners, -1, axis=0)
    return shapely.LineString([(a + d) / 2, (b + c) / 2])


def _width(area: Any) -> float:
    return float(area.area / max(_axis(area).length, 1e-9))


def _gaps(lines: Any, middle: Any, areas: Any = None) -> NDArray[np.float64]:
    """Return the distance from each row's middle to the next row beside it; between areas if there are any."""
    out = []
    for k, point in enumerate(middle):
        away = shapely.distance(point, lines)
        away[k] = math.inf
        other = int(np.argmin(away))
        if areas is None:
            out.append(float(away[other]))
        else:
            out.append(float(shapely.distance(areas[k], areas[other])))
    return np.array(out)


def _angle(lines: Any) -> float:
    ends = np.array([shapely.get_coordinates(line)[[0, -1]] for line in lines])
    step = ends[:, 1] - ends[:, 0]
    turn = 2 * np.arctan2(step[:, 1], step[:, 0])
    return round(math.degrees(math.atan2(np.sin(turn).mean(), np.cos(turn).mean()) / 2) % 180.0, 1) % 180.0


def _headland(layers: Layers, lines: Any) -> float:
    """Return the median distance from rows' ends to the fence, along the row."""
    fence = next(iter(layers.vector("location").values())).geometry[0]
    out = []
    for line in lines:
        a, b = shapely.get_coordinates(line)[[0, -1]]
        u = (b - a) / np.hypot(*(b - a))
        for end, sign in ((a, -1), (b, 1)):
            ray = shapely.LineString([end, end + sign * 200 * u])
            out.append(shapely.Point(end).distance(shapely.intersection(ray, shapely.boundary(fence))))
    return round(float(np.min(out)), 2)


def _plants(part: Features, kinds: Any, lines: Any, labels: Any) -> Values:
    """Return number and distance of plants, and the share of places in the rows that are empty."""
    along: list[NDArray[np.float64]] = []
    if labels["plant_kind"] == "shapes":
        for k in np.flatnonzero(kinds == labels["row_kind"]):
            shapes = part.properties[int(k)]["shapes"]
            along.append(np.sort([shape.get("pose", [0.0])[0] for shape in shapes]))
    else:
        points = shapely.centroid(part.geometry[kinds == labels["plant_kind"]])
        nearest = np.argmin(shapely.distance(points[:, None], lines[None]), axis=1)
        for number, line in enumerate(lines):
            along.append(np.sort(shapely.line_locate_point(line, points[nearest == number])))
    steps = [np.diff(row) for row in along]
    step = float(np.median(np.concatenate(steps)))
    lost = sum(int(np.maximum(np.round(row / step) - 1, 0).sum()) for row in steps)
    count = sum(len(row) for row in along)
    return {"plants": float(count), "plant_spacing": step, "missing": lost / (count + lost)}


def _agreement(layers: Layers) -> float:
    """Return the share of cells in which the grid agrees with the written world, cut again."""
    files = write_layers(layers, "gazebo", {}, Provenance("generated")).files
    read = formats.read(FileGroup(formats.get_format("gazebo"), "world.sdf", files), ReadContext())
    fence = {k: p for k, p in layers.parts.items() if k.layer == "location"}
    (grid,) = layers.grids().values()
    cut = Parameters(height=0.2, resolution=grid.resolution)
    (again,) = (
        objects_to_occupancy(Layers({**read.parts, **fence}, layers.datum), cut, DerivationNotes()).grids().values()
    )
    return float(((grid.cells == OCCUPIED) == (again.cells == OCCUPIED)).mean())


def _seen(layers: Layers) -> Image.Image:
    """Return the site from above, with the edges of its network."""
    picture = next(iter(layers.parts_of("imagery").values()))
    assert isinstance(picture, GeoImage)
    image = np.array(display_pixels(picture)[..., :3])
    a, _, c, _, e, f = picture.transform
    for part in layers.vector("topology").values():
        for line in part.select_kinds("edge").geometry:
            at = np.round((shapely.get_coordinates(line) - [c, f]) / [a, e]).astype(np.int32)
            cv2.polylines(image, [at.reshape(-1, 1, 2)], False, (38, 84, 180), max(1, image.shape[1] // 400))
    return Image.fromarray(image)


def _sheet(pictures: Sequence[Image.Image], columns: int) -> Image.Image:
    rows = -(-len(pictures) // columns)
    out = Image.new("RGB", (columns * (TILE + 6), rows * (TILE + 6)), (255, 255, 255))
    for k, picture in enumerate(pictures):
        picture.thumbnail((TILE, TILE), Image.Resampling.BOX)
        out.paste(picture, (k % columns * (TILE + 6) + 3, k // columns * (TILE + 6) + 3))
    return out


# --- wave-function collapse ---


def _wfc(case: Case) -> Result:
    sample = read_grid(case)
    walls, known = _obstacles(sample)
    in_sample = float(_aisles(walls, sample.resolution).sum() / max(1, known.sum()))
    given = Layers({PartKey("occupancy", GROUND, "map"): sample})
    width, depth = case.labels["size"]
    values = {"sample": "map", "width": width, "depth": depth}
    pictures, rows = [_drawn(walls, _aisles(walls, sample.resolution))], []
    failed = 0
    for seed in range(case.labels["seeds"]):
        try:
            layers = generate.run(case.labels["generator"], seed, values, given, DerivationNotes())
        except CannotGenerate:
            failed += 1
            continue
        grid = layers.grids()[PartKey("occupancy", GROUND, "map")]
        full = grid.cells == OCCUPIED
        found = _aisles(full, grid.resolution)
        rows.append(_counts(grid, found, in_sample))
        pictures.append(_drawn(full, found))
    figures = [Figure("seeds without a site", failed, at_most=0)]
    has_aisles = in_sample > 0  # by this measure: the gangways of depot's stacks are too short for it
    bounded: list[tuple[str, dict[str, Any]]] = [
        ("aisles", {"at_least": 2.0} if has_aisles else {}),
        ("aisles' share, of the sample's", {"at_least": 0.5, "at_most": 2.0} if has_aisles else {}),
        ("free space in one piece", {"at_least": 0.999}),
        ("obstacles smaller than 0.2 m", {"at_most": 0.1}),
        ("border closed", {"at_least": 0.95} if case.labels["closed"] else {"at_most": 0.5}),
    ]
    for name, bounds in bounded:
        values_of = [row[name] for row in rows] or [float("nan")]
        figures.append(Figure(f"{name} (median)", float(np.median(values_of)), **bounds))
    return Result(figures, _sheet(pictures, 4))


def _obstacles(grid: OccupancyGrid) -> tuple[Bool, Bool]:
    """Return a real grid's obstacles, and its inside: unknown holes in obstacles belong to them."""
    full = (grid.cells != UNKNOWN) & (grid.cells >= grid.occupied_thresh * OCCUPIED)
    free = (grid.cells == FREE) & ~full
    return full | ~free, free


def _aisles(full: Bool, resolution: float) -> Bool:
    """Return the free cells of aisles."""
    low, high = (v / resolution for v in AISLE_METRES)
    out = np.zeros(full.shape, bool)
    for across in (0, 1):
        cells = full if across == 0 else full.T
        strip = _strips(cells, low, high)
        if across:
            strip = strip.T
        pieces, label, stats, _ = cv2.connectedComponentsWithStats(strip.astype(np.uint8), connectivity=4)
        for k in range(1, pieces):
            wide, tall, area = (int(stats[k, c]) for c in (cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT, cv2.CC_STAT_AREA))
            length = wide if across == 0 else tall
            if length * resolution >= 2.0 and length >= area / length:
                out |= label == k
    return out


def _strips(full: Bool, low: float, high: float) -> Bool:
    """Return the free runs along columns that have an obstacle at both ends, and are as long as an aisle is wide."""
    out = np.zeros(full.shape, bool)
    for column in range(full.shape[1]):
        walls = np.flatnonzero(full[:, column])
        for a, b in zip(walls[:-1].tolist(), walls[1:].tolist(), strict=True):
            if low <= b - a - 1 <= high:
                out[a + 1 : b, column] = True
    return out


def _counts(grid: OccupancyGrid, found: Bool, in_sample: float) -> Values:
    full, free = grid.cells == OCCUPIED, grid.cells == FREE
    count, _, stats, _ = cv2.connectedComponentsWithStats(free.astype(np.uint8), connectivity=4)
    largest = stats[1:, cv2.CC_STAT_AREA].max() if count > 1 else 0
    pieces, _, sizes, _ = cv2.connectedComponentsWithStats(full.astype(np.uint8), connectivity=8)
    long = np.maximum(sizes[1:, cv2.CC_STAT_WIDTH], sizes[1:, cv2.CC_STAT_HEIGHT]) * grid.resolution
    edge = np.concatenate([full[0], full[-1], full[:, 0], full[:, -1]])
    share = float(found.sum() / max(1, free.sum()))
    return {
        "aisles": float(cv2.connectedComponents(found.astype(np.uint8))[0] - 1),
        "aisles' share, of the sample's": share / in_sample if in_sample else float("nan"),
        "free space in one piece": float(largest / max(1, free.sum())),
        "obstacles smaller than 0.2 m": float((long < 0.2).mean()) if pieces > 1 else 0.0,
        "border closed": float(edge.mean()),
    }


def _drawn(full: Bool, found: Bool) -> Image.Image:
    out = np.full((*full.shape, 3), 255, np.uint8)
    out[found] = (170, 215, 170)
    out[full] = 40
    return Image.fromarray(np.ascontiguousarray(out[::-1]))

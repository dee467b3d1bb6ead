"""Judge `occupancy_to_zones`: rooms, doors, aisles and rows of a grid, and whether their names last.

Keys of a label file of kind ``rooms``, besides the common ones; all coordinates are metres in the map's frame:

============== =====================================================================================================
``map``        a grid (YAML or PGM beside its image), or a building whose grid is derived from its walls
``level``      level of the map; needed if it has several
``derive``     parameters of objects_to_occupancy for a building
``resolution`` metres per pixel of an image without metadata: light pixels are free, dark ones occupied
``areas``      rooms and corridors: ``{name, kind, outline: [[x, y], …]}``
``doors``      ``{at: [x, y], width}``
``openings``   [x, y] of gaps that some call doors and others do not: a door found there counts neither way
``ignore``     outlines of ground that people divide in different ways: areas and doors in it count neither way
``lines``      aisles and rows: ``{name, kind, line: [[x, y], [x, y]]}``
============== =====================================================================================================

A labelled area is matched if a derived one overlaps it with IoU ≥ 0.5 over free cells; fragments are derived areas
that lie mostly in a labelled one, so 1 is right; joined are labelled areas that share a derived one. A door is found
within 0.5 m. A line is found if one area covers 70 % of it, and covers no other line as much. Names last if a name
stays with the same ground (IoU ≥ 0.5, doors within 0.5 m) when the areas are derived again beside the stored ones,
after a box of 0.5 m was put into the largest room, or after 1 % of the free cells beside obstacles became occupied.

Bounds: Bormann et al. 2016 (Room segmentation: survey, implementation, and analysis) report recalls and precisions of
0.8 to 0.95 for the four best methods on furnished and empty plans, so rooms and doors are to reach 0.8; names, which
nobody reports, 0.9.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from app import upload_reader
from app.derive import DerivationNotes, all_derivations, run, with_parameters
from app.errors import CannotConvert
from app.limits import Limits
from app.model.frame import Datum
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.layers import MAP, Layers, Part, PartKey
from app.upload_reader import EnvironmentContext, UploadHints
from tests.derive.judge import Case, Figure, Result

IOU = 0.5
NEAR = 0.5
COVERED = 0.7
AREA_KINDS = ("room", "corridor", "aisle", "row")
COLOURS = {"room": (70, 130, 220), "corridor": (240, 160, 40), "aisle": (160, 80, 200), "row": (60, 160, 70)}


@dataclass(frozen=True, slots=True)
class Area:
    """Derived area: its name, kind and outline in metres, and its free cells, bool [h, w]."""

    name: str
    kind: str
    shape: Any
    cells: NDArray[np.bool_]


def judge(case: Case) -> Result:
    """Derive the areas of a labelled map, and measure them."""
    layers, key, grid = read_layers(case)
    zones = derive_zones(layers)
    found = areas(zones, key, grid)
    figures = [
        *_room_figures(case.labels, found, grid),
        *_door_figures(case.labels, found),
        *_line_figures(case.labels, found),
        *_name_figures(layers, key, grid, zones, found),
    ]
    return Result(figures, _picture(case.labels, grid, found))


def derive_zones(layers: Layers) -> Layers:
    """Return the layers with their areas; without, where there are none."""
    derivation = all_derivations().get("occupancy_to_zones")
    if derivation is None:
        return Layers({}, layers.datum, layers.levels)
    try:
        return run([derivation.step()], layers, DerivationNotes())
    except CannotConvert:
        return Layers({}, layers.datum, layers.levels)


def areas(layers: Layers, key: PartKey, grid: OccupancyGrid) -> list[Area]:
    """Return the areas and doors among the zones of a level."""
    out = []
    for part in layers.vector("zones", key.level).values():
        for feature in part:
            kind = str(feature.properties.get("kind"))
            if kind in (*AREA_KINDS, "door"):
                cells = _cells(feature.geometry, grid)
                out.append(Area(str(feature.properties["name"]), kind, feature.geometry, cells))
    return out


def read_layers(case: Case) -> tuple[Layers, PartKey, OccupancyGrid]:
    """Return the map's layers with one grid, its key, and the grid."""
    path = case.file()
    if "resolution" in case.labels:
        grid = _bare_image(np.asarray(Image.open(path).convert("L")), float(case.labels["resolution"]))
        key = PartKey("occupancy")
        return Layers({key: grid}, None), key, grid
    files = {p.name: p.read_bytes() for p in path.parent.iterdir() if p == path or p.suffix in (".png", ".pgm")}
    context = EnvironmentContext(Datum(53.0, 0.0))
    layers = upload_reader.read(upload_reader.unpack(files, Limits()), UploadHints(), context, Limits()).layers(None)
    if not layers.grids():
        step = all_derivations()["objects_to_occupancy"].step()
        layers = run(with_parameters([step], dict(case.labels.get("derive", {}))), layers, DerivationNotes())
    found, grid = next(
        (key, grid) for key, grid in layers.grids().items() if case.labels.get("level") in (None, key.level)
    )
    key = PartKey("occupancy", found.level, MAP)
    return Layers({key: grid}, layers.datum, layers.levels), key, grid


def _bare_image(grey: NDArray[np.uint8], resolution: float) -> OccupancyGrid:
    cells = np.full(grey.shape, UNKNOWN, np.uint8)
    cells[grey >= 250], cells[grey <= 90] = FREE, OCCUPIED
    return OccupancyGrid(np.ascontiguousarray(cells[::-1]), resolution)


def _cells(shape: Any, grid: OccupancyGrid) -> NDArray[np.bool_]:
    """Return the free cells of an area in metres."""
    mask = np.zeros(grid.cells.shape, np.uint8)
    for polygon in shapely.get_parts(shape):
        if polygon.geom_type != "Polygon":
            continue
        for ring, value in ((polygon.exterior, 1), *((inner, 0) for inner in polygon.interiors)):
            corners = (shapely.get_coordinates(ring) - grid.origin[:2]) / grid.resolution - 0.5
            cv2.fillPoly(mask, [np.rint(corners).astype(np.int32)], value)
    return np.asarray((mask == 1) & (grid.cells == FREE))


def _iou(a: NDArray[np.bool_], b: NDArray[np.bool_]) -> float:
    union = np.count_nonzero(a | b)
    return np.count_nonzero(a & b) / union if union else 0.0


def _room_figures(labels: Mapping[str, Any], found: list[Area], grid: OccupancyGrid) -> Iterable[Figure]:
    wanted = [_cells(shapely.Polygon(a["outline"]), grid) for a in labels.get("areas", [])]
    derived = [a for a in found if a.kind in ("room", "corridor")]
    ignored = np.zeros(grid.cells.shape, bool)
    for outline in labels.get("ignore", []):
        ignored |= _cells(shapely.Polygon(outline), grid)
    counted = [a for a in derived if _share(a.cells, ignored) <= 0.5]
    if not wanted:
        yield Figure("false rooms", len(counted), at_most=0)
        return
    pairs = {(i, k): _iou(cells, a.cells) for i, cells in enumerate(wanted) for k, a in enumerate(derived)}
    matched = [pair for pair, iou in pairs.items() if iou >= IOU]  # above a half, so each is in one pair only
    yield Figure("rooms matched", len({i for i, _ in matched}) / len(wanted), at_least=0.8)
    right = {k for _, k in matched}
    surplus = [a for k, a in enumerate(derived) if k not in right and any(a is b for b in counted)]
    total = len(right) + len(surplus)
    yield Figure("areas that are rooms", len(right) / total if total else math.nan, at_least=0.8)
    named = [labels["areas"][i]["kind"] == derived[k].kind for i, k in matched]
    yield Figure("kinds right", sum(named) / len(named) if named else math.nan, at_least=0.8)
    fragments = [sum(_share(a.cells, cells) > 0.5 for a in derived) for cells in wanted]
    yield Figure("fragments of a room", float(np.mean(fragments)))
    homes = [[i for i, cells in enumerate(wanted) if _share(cells, a.cells) > 0.5] for a in derived]
    yield Figure("rooms joined", sum(len(home) for home in homes if len(home) > 1))


def _share(part: NDArray[np.bool_], whole: NDArray[np.bool_]) -> float:
    count = np.count_nonzero(part)
    return np.count_nonzero(part & whole) / count if count else 0.0


def _door_figures(labels: Mapping[str, Any], found: list[Area]) -> Iterable[Figure]:
    doors = [shapely.centroid(a.shape) for a in found if a.kind == "door"]
    wanted = [shapely.Point(d["at"]) for d in labels.get("doors", [])]
    neutral = [shapely.Point(at) for at in labels.get("openings", [])]
    ignored = [shapely.Polygon(outline) for outline in labels.get("ignore", [])]
    pairs = sorted(
        (one.distance(door), i, k)
        for i, one in enumerate(wanted)
        for k, door in enumerate(doors)
        if one.distance(door) <= NEAR
    )
    taken: dict[int, int] = {}
    for _, i, k in pairs:
        if i not in taken and k not in taken.values():
            taken[i] = k
    false = [
        door
        for k, door in enumerate(doors)
        if k not in taken.values()
        and not any(door.distance(at) <= 2 * NEAR for at in neutral)
        and not any(door.distance(area) <= NEAR for area in ignored)
    ]
    if not wanted:
        yield Figure("false doors", len(false), at_most=0)
        return
    yield Figure("doors found", len(taken) / len(wanted), at_least=0.8)
    total = len(taken) + len(false)
    yield Figure("doors that are doors", len(taken) / total if total else math.nan, at_least=0.8)


def _line_figures(labels: Mapping[str, Any], found: list[Area]) -> Iterable[Figure]:
    lines = [shapely.LineString(one["line"]) for one in labels.get("lines", [])]
    derived = [a for a in found if a.kind in ("aisle", "row")]
    if not lines:
        yield Figure("false aisles and rows", len(derived), at_most=0)
        return
    shares = np.array([[a.shape.intersection(line).length / line.length for a in derived] for line in lines])
    covers = shares.reshape(len(lines), len(derived)) >= COVERED
    alone = covers & (covers.sum(axis=0) == 1)
    yield Figure("aisles and rows found", float(alone.any(axis=1).mean()), at_least=0.8)
    near = [a for a in derived if any(a.shape.distance(line) < NEAR for line in lines)]
    right = sum(bool(alone[:, k].any()) for k in range(len(derived)))
    yield Figure("of the ones near", right / len(near) if near else math.nan, at_least=0.8)
    yield Figure("aisles and rows", len(derived))


def _name_figures(
    layers: Layers, key: PartKey, grid: OccupancyGrid, zones: Layers, before: list[Area]
) -> Iterable[Figure]:
    stored: dict[PartKey, Part] = {k: p for k, p in zones.parts.items() if k.layer == "zones"}
    for title, cells in (("after a new obstacle", _with_box(grid, before)), ("after noise", _with_noise(grid))):
        changed = Layers({**layers.parts, key: replace(grid, cells=cells), **stored}, layers.datum, layers.levels)
        after = {a.name: a for a in areas(derive_zones(changed), key, grid)}
        kept = [a.name in after and _is_same(a, after[a.name]) for a in before]
        yield Figure(f"names kept {title}", sum(kept) / len(kept) if kept else math.nan, at_least=0.9)


def _is_same(a: Area, b: Area) -> bool:
    if a.kind == "door":
        return bool(shapely.centroid(a.shape).distance(shapely.centroid(b.shape)) <= NEAR)
    return _iou(a.cells, b.cells) >= IOU


def _with_box(grid: OccupancyGrid, found: list[Area]) -> NDArray[np.uint8]:
    """Return the cells with a box of 0.5 m at the innermost cell of the largest area."""
    cells = grid.cells.copy()
    largest = max((a.cells for a in found), key=np.count_nonzero, default=grid.cells == FREE)
    distance = cv2.distanceTransform(largest.astype(np.uint8), cv2.DIST_L2, 5)
    row, column = np.unravel_index(int(np.argmax(distance)), distance.shape)
    half = max(1, round(0.25 / grid.resolution))
    cells[max(0, row - half) : row + half, max(0, column - half) : column + half] = OCCUPIED
    return cells


def _with_noise(grid: OccupancyGrid) -> NDArray[np.uint8]:
    cells = grid.cells.copy()
    beside = cv2.dilate((cells == OCCUPIED).astype(np.uint8), np.ones((3, 3), np.uint8)) == 1
    chance = np.random.default_rng(1).random(cells.shape) < 0.01
    cells[beside & chance & (cells == FREE)] = OCCUPIED
    return cells


def _picture(labels: Mapping[str, Any], grid: OccupancyGrid, found: list[Area]) -> Image.Image:
    """Draw derived areas in colour with their names, doors in red, labels as dark green lines."""
    known = grid.cells != UNKNOWN
    rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    top, bottom, left, right = int(rows[0]), int(rows[-1]) + 1, int(columns[0]), int(columns[-1]) + 1
    rgb = np.full((*grid.cells.shape, 3), 190, np.uint8)
    rgb[grid.cells == FREE], rgb[grid.cells == OCCUPIED] = 255, 0
    for n, a in enumerate(b for b in found if b.kind != "door"):
        shade = np.array(COLOURS[a.kind]) * (0.75 + 0.25 * (n % 3) / 2)
        rgb[a.cells] = (rgb[a.cells] * 0.45 + shade * 0.55).astype(np.uint8)
    view = rgb[top:bottom, left:right][::-1]
    scale = max(1, 1400 // max(view.shape[:2]))
    image = Image.fromarray(np.kron(view, np.ones((scale, scale, 1), np.uint8)))
    draw = ImageDraw.Draw(image)

    def at(points: Any) -> list[tuple[float, float]]:
        cells = (np.asarray(points, float) - grid.origin[:2]) / grid.resolution - [left, top]
        return [(x * scale, image.height - y * scale) for x, y in cells.tolist()]

    for one in labels.get("areas", []):
        draw.line(at([*one["outline"], one["outline"][0]]), fill=(0, 90, 0), width=2)
    for one in labels.get("lines", []):
        draw.line(at(one["line"]), fill=(0, 90, 0), width=2)
    for one in labels.get("doors", []):
        ((x, y),) = at([one["at"]])
        draw.ellipse([x - 7, y - 7, x + 7, y + 7], outline=(0, 90, 0), width=2)
    for a in found:
        ((x, y),) = at([shapely.point_on_surface(a.shape).coords[0]])
        if a.kind == "door":
            draw.rectangle([x - 4, y - 4, x + 4, y + 4], fill=(220, 0, 0))
        draw.text((x + 5, y), a.name, fill=(150, 0, 0) if a.kind == "door" else (0, 0, 90))
    return image

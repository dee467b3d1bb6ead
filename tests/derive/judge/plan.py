"""Judge walls and floors that imagery_to_occupancy derives from floor plans.

Keys of a label file of kind ``plan``, all positions in pixels of the plan (x to the right, y down):

    map, sha256          the picture of the plan
    source               where to get a picture that is not among our maps; without the file, nothing is measured
    metres_per_pixel     its scale
    tolerance            distance in metres from a labelled wall within which a cell belongs to it
    walls                [{width, line}], drawn walls
    traced, level        instead of walls: an Open-RMF building whose walls people traced on this plan
    unclear              [{width, line}], drawn as walls are, but perhaps none: neither right nor wrong
    unclear_areas        [polygon], likewise
    unclear_doors        whether the traced building's doors are unclear, too
    floor, outside       points on the floor of the building, and points outside of it

Recall: share of the length of labelled walls within ``tolerance`` of an occupied cell. Precision: share of occupied
cells within ``tolerance`` of a labelled wall; cells on unclear lines and areas do not count. ``strict precision``
counts them as wrong. Floor: share of the points on the floor that are free; outside: share of those outside that are.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image

from app.derive import DerivationNotes
from app.derive.imagery_to_occupancy import Parameters, imagery_to_occupancy
from app.model.grid import FREE, OCCUPIED, OccupancyGrid
from app.model.imagery import GeoImage
from app.model.layers import Layers, PartKey
from tests.derive.judge import BadLabels, Case, Figure, Result

PRECISION, RECALL, FLOOR, OUTSIDE = 0.7, 0.8, 0.9, 0.1

Line = tuple[float, NDArray[np.float64]]


def judge(case: Case) -> Result:
    """Derive a grid from a labelled plan and compare it with its walls, floors and outside."""
    try:
        picture = read_picture(case)
    except BadLabels:
        if "source" not in case.labels:
            raise
        return Result([Figure(f"not measured: get {case.labels['map']} from {case.labels['source']}", float("nan"))])
    pixels, size = picture.pixels, picture.transform[0]
    derived = imagery_to_occupancy(
        Layers({PartKey("imagery", "ground", "plan"): picture}), Parameters(), DerivationNotes()
    )
    (grid,) = derived.parts.values()
    assert isinstance(grid, OccupancyGrid)
    value = _values(grid, pixels.shape[:2], size)
    walls, unclear = _labels(case, pixels.shape[:2], size)
    return Result(_figures(case, value, walls, unclear, size), _picture(pixels, value, walls, unclear))


def read_picture(case: Case) -> GeoImage:
    """Return the labelled plan in metres, its upper left corner at the origin."""
    with Image.open(case.file()) as image:
        pixels = np.array(image if image.mode in ("L", "LA", "RGB", "RGBA") else image.convert("RGBA"))
    size = float(case.labels["metres_per_pixel"])
    return GeoImage(pixels.reshape(*pixels.shape[:2], -1), (size, 0.0, 0.0, 0.0, -size, 0.0))


def _values(grid: OccupancyGrid, shape: tuple[int, int], size: float) -> NDArray[np.uint8]:
    """Return the grid's value at each pixel of the plan."""
    rows = np.floor((-(np.arange(shape[0]) + 0.5) * size - grid.origin[1]) / grid.resolution).astype(int)
    columns = np.floor(((np.arange(shape[1]) + 0.5) * size - grid.origin[0]) / grid.resolution).astype(int)
    return np.asarray(grid.cells[np.ix_(rows.clip(0, grid.height - 1), columns.clip(0, grid.width - 1))])


def _labels(case: Case, shape: tuple[int, int], size: float) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Draw the labels: uint8 [h, w], 1 on the lines of walls; bool [h, w], unclear pixels."""
    labels = case.labels
    walls, doors = _traced(case) if "traced" in labels else (_lines(labels["walls"]), [])
    unclear = _lines(labels.get("unclear", []))
    if labels.get("unclear_doors"):
        unclear += [(2 * float(labels["tolerance"]) / size, line) for line in doors]
    truth, doubt = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
    for width, line in walls:
        cv2.polylines(truth, [np.round(line).astype(np.int32)], False, 1, max(1, round(width)))
    for width, line in unclear:
        cv2.polylines(doubt, [np.round(line).astype(np.int32)], False, 1, max(1, round(width)))
    for area in labels.get("unclear_areas", []):
        cv2.fillPoly(doubt, [np.round(np.array(area)).astype(np.int32)], 1)
    return truth, doubt == 1


def _lines(entries: list[dict[str, Any]]) -> list[Line]:
    return [(float(entry["width"]), np.array(entry["line"], np.float64)) for entry in entries]


def _traced(case: Case) -> tuple[list[Line], list[NDArray[np.float64]]]:
    """Return the walls and the doors of an Open-RMF building, in pixels of its drawing."""
    level = yaml.safe_load(case.file("traced").read_text())["levels"][case.labels["level"]]
    at = np.array([vertex[:2] for vertex in level["vertices"]], np.float64)
    walls = [(1.0, at[[wall[0], wall[1]]]) for wall in level["walls"]]
    return walls, [at[[door[0], door[1]]] for door in level.get("doors", [])]


def _figures(
    case: Case, value: NDArray[np.uint8], walls: NDArray[np.uint8], unclear: NDArray[np.bool_], size: float
) -> list[Figure]:
    reach = float(case.labels["tolerance"]) / size
    occupied = value == OCCUPIED
    near_wall = cv2.distanceTransform(1 - walls, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) <= reach
    near_cell = cv2.distanceTransform((~occupied).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) <= reach
    counted = occupied & (near_wall | ~unclear)
    floor, outside = (np.array(case.labels[key], int).T for key in ("floor", "outside"))
    return [
        Figure("recall of walls", _share(near_cell[walls == 1]), at_least=RECALL),
        Figure("precision of walls", _share(near_wall[counted]), at_least=PRECISION),
        Figure("strict precision", _share(near_wall[occupied])),
        Figure("floor that is free", _share(value[floor[1], floor[0]] == FREE), at_least=FLOOR),
        Figure("outside that is free", _share(value[outside[1], outside[0]] == FREE), at_most=OUTSIDE),
    ]


def _share(flags: NDArray[np.bool_]) -> float:
    return float(flags.mean()) if flags.size else float("nan")


def _picture(
    pixels: NDArray[np.uint8], value: NDArray[np.uint8], walls: NDArray[np.uint8], unclear: NDArray[np.bool_]
) -> Image.Image:
    """Draw the grid over the plan: free green, unknown grey, occupied red; labelled walls blue, unclear ones yellow."""
    base: NDArray[Any] = pixels[..., :3] if pixels.shape[2] >= 3 else np.repeat(pixels[..., :1], 3, axis=2)
    if pixels.shape[2] in (2, 4):
        alpha = pixels[..., -1:].astype(np.float64) / 255
        base = base * alpha + 255 * (1 - alpha)
    tint = np.full(base.shape, 150.0)
    tint[value == FREE] = (190, 240, 190)
    out = np.asarray(0.5 * base + 0.5 * tint)
    out[unclear] = 0.6 * out[unclear] + 0.4 * np.array([255, 220, 0])
    out[value == OCCUPIED] = (220, 0, 0)
    out[walls == 1] = 0.5 * out[walls == 1] + 0.5 * np.array([0, 0, 255])
    return Image.fromarray(out.astype(np.uint8))

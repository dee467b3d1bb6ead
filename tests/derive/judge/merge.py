"""Grids of several robots laid into one: pieces cut out of a real grid, turned and damaged, whose places are known.

Keys of a label file:

    map: FILE                   # YAML of a grid, or its image
    resolution: 0.05            # metres per cell, for an image without a YAML
    pieces:                     # what each robot has seen
      - box: [0, 0, 380, 307]   # columns and rows of the image: left, top, right, bottom
        turn: 37                # degrees that the robot's frame is turned against the map's
        resolution: 0.1         # of the robot's grid; default: the map's
      - map: FILE               # a grid of its own in the map's frame, instead of a box of the map
    expect: merged              # or `refused`, or `not wrong` (merged in the right place, or refused)
    angle: 20                   # bounds of the search: degrees, and metres; default: none
    reach: 1
    seed: 1                     # of the damage

Damage of a piece: 15 % of its occupied cells are lost to unknown and 10 % lie a cell beside their place, 0.2 % of the
free cells are unknown and 0.05 % occupied, and two things of 0.5 × 0.5 m stand where the others saw none. A piece with
a `map` of its own has its own damage.

Figures: the error of each piece's place against the first's (at the middle of the piece), and of the merged grid: the
share of the map's walls in the boxes that are there again, of its occupied cells that are none of the map's or the
damage's, and of the map's walls that were declared free. Two cells count as one place within two cells.
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image

from app.errors import CannotConvert, FleetMapError
from app.model import stitching
from app.model.alignment import Fit
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from tests.derive.judge import Case, Figure, Result

COLOURS = ((230, 70, 60), (50, 110, 220), (40, 160, 80), (200, 140, 20))


@dataclass(frozen=True, slots=True)
class Piece:
    """What a robot has seen. truth: motion of its frame into the map's. origin: grid in the robot's frame."""

    grid: OccupancyGrid
    truth: Fit
    added: NDArray[np.float64]

    @property
    def middle(self) -> NDArray[np.float64]:
        """Middle of the grid in the robot's frame."""
        return np.asarray(self.grid.corners().mean(axis=0)[None])


def judge(case: Case) -> Result:
    """Cut, turn, damage, merge, and compare with where the pieces were cut from."""
    labels = case.labels
    whole = _grid(case, labels)
    rng = np.random.default_rng(int(labels.get("seed", 1)))
    pieces = [_piece(case, whole, row, rng) for row in labels["pieces"]]
    try:
        fits, merged = _merge(pieces, labels)
    except FleetMapError as error:
        return _refused(str(labels["expect"]), error)
    return _measured(labels, whole, pieces, fits, merged)


def _merge(pieces: list[Piece], labels: Mapping[str, Any]) -> tuple[list[Fit], OccupancyGrid]:
    """Place and merge the pieces as the server does. Raises CannotConvert if one of them cannot be placed."""
    angle = labels.get("angle")
    bounds = stitching.Bounds(None if angle is None else math.radians(angle), labels.get("reach"))
    grids = [piece.grid for piece in pieces]
    places = stitching.place_grids(grids, bounds)
    problems = [place.problem for place in places if place.problem]
    if problems:
        raise CannotConvert("; ".join(problems))
    fits = [place.fit for place in places]
    return fits, stitching.merge_cells(grids, fits, "evidence").grid


def _refused(expect: str, error: FleetMapError) -> Result:
    figure = Figure("refused", 1.0, at_most=None if expect != "merged" else 0.0)
    return Result([figure] if len(str(error)) > 40 else [figure, Figure("says why", 0.0, at_least=1.0)])


def _measured(
    labels: Mapping[str, Any],
    whole: OccupancyGrid,
    pieces: list[Piece],
    fits: list[Fit],
    merged: OccupancyGrid,
) -> Result:
    anchor = pieces[0].truth
    far, turned = [], []
    for piece, fit in zip(pieces[1:], fits[1:], strict=True):
        placed = anchor.apply_to(fit.apply_to(piece.middle))
        cell = max(piece.grid.resolution, pieces[0].grid.resolution)
        far.append(float(np.linalg.norm(placed - piece.truth.apply_to(piece.middle))) / cell)
        turned.append(abs(math.degrees(math.remainder(fit.yaw + anchor.yaw - piece.truth.yaw, 2 * math.pi))))
    refuse = labels["expect"] == "refused"
    figures = [Figure("refused", 0.0, at_least=1.0 if refuse else None)]
    if not refuse:
        figures += [
            Figure("shift, worst", max(far), "cells", at_most=1.0),
            Figure("turn, worst", max(turned), "°", at_most=0.5),
        ]
        if not any("map" in row for row in labels["pieces"]):
            figures += _agreement(labels, whole, pieces, merged)
    return Result(figures, _picture(whole, pieces, fits))


def _agreement(
    labels: Mapping[str, Any], whole: OccupancyGrid, pieces: list[Piece], merged: OccupancyGrid
) -> list[Figure]:
    """Compare a merged grid, which is in the first piece's frame, with the map."""
    anchor, near = pieces[0].truth, 2.01 * max(p.grid.resolution for p in pieces)
    seen = np.zeros(whole.cells.shape, bool)
    for row in labels["pieces"]:
        left, top, right, bottom = row["box"]
        seen[whole.height - bottom : whole.height - top, left:right] = True
    walls = _middles(whole, (whole.cells == OCCUPIED) & seen)
    solid = anchor.apply_to(_middles(merged, merged.cells == OCCUPIED))
    added = np.concatenate([piece.truth.apply_to(piece.added) for piece in pieces])
    again = _away(walls, solid) <= near
    alien = _away(solid, np.concatenate([_middles(whole, whole.cells == OCCUPIED), added])) > near
    x, y = (-_turn(-anchor.yaw) @ np.array([anchor.x, anchor.y])).tolist()
    inverse = Fit(x, y, -anchor.yaw, 0.0, 1.0)
    freed = _values(merged, inverse.apply_to(walls[~again])) == FREE
    return [
        Figure("walls again", float(again.mean()), at_least=0.9),
        Figure("walls of nobody", float(alien.mean()), at_most=0.02),
        Figure("walls called free", float(freed.sum() / max(1, len(walls))), at_most=0.02),
    ]


# --- cutting ---------------------------------------------------------------------------------------------------------


def _grid(case: Case, row: Mapping[str, Any]) -> OccupancyGrid:
    """Read a grid: occupied is dark, the grey 195 to 215 is unknown, the rest is free."""
    path = case.file() if row is case.labels else next(r / row["map"] for r in case.roots if (r / row["map"]).is_file())
    origin, resolution = (0.0, 0.0, 0.0), float(row.get("resolution", 0.05))
    if path.suffix == ".yaml":
        text = yaml.safe_load(path.read_text())
        resolution = float(text["resolution"])
        x, y, yaw = (float(v) for v in text["origin"])
        origin, path = (x, y, yaw), path.parent / str(text["image"]).rsplit("/", 1)[-1]
    grey = np.array(Image.open(io.BytesIO(path.read_bytes())).convert("L"))[::-1]
    cells = np.where(grey < 100, OCCUPIED, np.where((grey > 195) & (grey < 215), UNKNOWN, FREE)).astype(np.uint8)
    return OccupancyGrid(cells, resolution, origin)


def _piece(case: Case, whole: OccupancyGrid, row: Mapping[str, Any], rng: np.random.Generator) -> Piece:
    yaw = math.radians(float(row.get("turn", 0.0)))
    if "map" in row:
        grid, whole_box = _grid(case, row), None
        middle = grid.corners().mean(axis=0)
    else:
        left, top, right, bottom = row["box"]
        low, high = (left, whole.height - bottom), (right, whole.height - top)
        whole_box = (low, high)
        middle = np.array(whole.origin[:2]) + (np.array(low) + high) / 2 * whole.resolution
        grid = whole
    if whole_box is None and yaw == 0.0:
        return Piece(grid, Fit(0.0, 0.0, 0.0, 0.0, 1.0), np.empty((0, 2)))
    size = float(row.get("resolution", grid.resolution))
    # the robot's frame: its middle is at the middle of the piece, but for a part of a cell
    x, y = (middle + rng.uniform(-0.5, 0.5, 2) * size).tolist()
    truth = Fit(x, y, yaw, 0.0, 1.0)
    extent = np.ptp(grid.corners(), axis=0) if whole_box is None else np.subtract(*whole_box[::-1]) * whole.resolution
    half = math.ceil(float(np.linalg.norm(extent)) / 2 / size)
    cut = OccupancyGrid(np.full((2 * half, 2 * half), UNKNOWN, np.uint8), size, (-half * size, -half * size, 0.0))
    fine = (np.array([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]]) - 0.5) * size
    row_, column = np.indices(cut.cells.shape).reshape(2, -1)
    places = (np.column_stack([column, row_]) + 0.5) * size - half * size
    # a cell of the robot has seen whatever stands in it: the highest of four samples
    samples = [_values(grid, truth.apply_to(places + step), whole_box) for step in fine]
    solid = np.any([s == OCCUPIED for s in samples], axis=0)
    free = np.sum([s == FREE for s in samples], axis=0) >= 3
    cells = np.where(solid, OCCUPIED, np.where(free, FREE, UNKNOWN)).astype(np.uint8).reshape(cut.cells.shape)
    added = np.empty((0, 2))
    if whole_box is not None:
        cells, mask = _damaged(cells, size, rng)
        added = _middles(cut, mask)
    return Piece(replace(cut, cells=cells), truth, added)


def _damaged(
    cells: NDArray[np.uint8], size: float, rng: np.random.Generator
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Return damaged cells, and which of them were made occupied."""
    out, known = cells.copy(), cells != UNKNOWN
    chance = rng.random(cells.shape)
    solid, free = cells == OCCUPIED, cells == FREE
    out[solid & (chance < 0.15)] = UNKNOWN
    row, column = np.nonzero(solid & (chance > 0.9))
    out[row, column] = FREE
    step = rng.integers(-1, 2, (2, len(row)))
    out[(row + step[0]).clip(0, len(cells) - 1), (column + step[1]).clip(0, cells.shape[1] - 1)] = OCCUPIED
    out[free & (chance < 0.002)] = UNKNOWN
    out[free & (chance > 0.9995)] = OCCUPIED
    side = round(0.5 / size)
    row, column = np.nonzero(free)
    for at in rng.integers(0, len(row), 2):
        out[row[at] : row[at] + side, column[at] : column[at] + side] = OCCUPIED
    out[~known] = UNKNOWN
    return out, (out == OCCUPIED) & ~solid


# --- reading ---------------------------------------------------------------------------------------------------------


def _values(
    grid: OccupancyGrid, points: NDArray[np.float64], box: tuple[tuple[int, int], tuple[int, int]] | None = None
) -> NDArray[np.uint8]:
    """Values of a grid at points [n, 2]; unknown beyond it, or beyond a box of its cells."""
    x, y, yaw = grid.origin
    column, row = np.floor((points - np.array([x, y])) @ _turn(yaw) / grid.resolution).astype(int).T
    (left, low), (right, high) = box or ((0, 0), (grid.width, grid.height))
    inside = (column >= max(left, 0)) & (column < min(right, grid.width)) & (row >= max(low, 0))
    inside &= row < min(high, grid.height)
    out = np.full(len(points), UNKNOWN, np.uint8)
    out[inside] = grid.cells[row[inside], column[inside]]
    return out


def _middles(grid: OccupancyGrid, mask: NDArray[np.bool_]) -> NDArray[np.float64]:
    row, column = np.nonzero(mask)
    x, y, yaw = grid.origin
    return np.asarray((np.column_stack([column, row]) + 0.5) * grid.resolution @ _turn(yaw).T + np.array([x, y]))


def _away(points: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(others).query(points)[0] if len(others) else np.full(len(points), np.inf))


def _turn(yaw: float) -> NDArray[np.float64]:
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s], [s, c]])


def _picture(whole: OccupancyGrid, pieces: list[Piece], fits: list[Fit]) -> Image.Image:
    """The pieces' walls in their colours over the map in grey, where they were placed."""
    scale, margin = 3, 60
    shades = np.where(whole.cells == OCCUPIED, 120, np.where(whole.cells == FREE, 255, 225)).astype(np.uint8)
    image = cv2.resize(np.pad(shades, margin, constant_values=225), None, fx=scale, fy=scale, interpolation=0)
    rgb = np.repeat(image[:, :, None], 3, axis=2)
    for piece, fit, colour in zip(pieces, fits, COLOURS, strict=False):
        points = pieces[0].truth.apply_to(fit.apply_to(_middles(piece.grid, piece.grid.cells == OCCUPIED)))
        column, row = ((points - np.array(whole.origin[:2])) / whole.resolution * scale + margin * scale).astype(int).T
        inside = (column >= 0) & (column < rgb.shape[1] - 1) & (row >= 0) & (row < rgb.shape[0] - 1)
        for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
            rgb[row[inside] + i, column[inside] + j] = colour
    return Image.fromarray(rgb[::-1])

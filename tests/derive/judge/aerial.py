"""Judge aerial pictures: points labelled by eye against the objects and the grid that are derived from the picture.

Keys of the label files, beside those of every kind:

    source:          # of a picture that is not in the folder of maps: repository, commit, path, licence
    resolution: 0.1  # metres per pixel
    bands: [red, green, blue, nir]   # meaning of the picture's bands
    points:          # column and row in pixels from the upper left, and what the eye sees there
      - [416, 55, bare]
      - [1670, 42, paved/bare/grass]    # any of them is right

Labels are ``building``, ``tree`` (also shrubs and hedges), ``grass`` (also crops), ``bare``, ``paved``, ``water``;
``bridge`` and ``vehicle`` are seen but not counted. A point is unknown if its cell is unknown, else right if the object
there has a kind of its label, or if no object is there and the cell is as free or occupied as the label.

Bounds: right or unknown ≥ 80 %, obstacles called free ≤ 5 %. A result that is unknown everywhere would keep both, so
at least 40 % of the points must be decided.

Pictures with a ``source`` are not part of this project. Clone the repository, check out the commit, copy the file to
the path of ``map`` below a folder, and pass it: ``python -m tests.derive.judge --kind aerial --data FOLDER``. Pictures
of the usual folder of maps are found beside it if FOLDER has links to them.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import rasterio
import shapely
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from app.derive import DerivationNotes
from app.derive.imagery_to_objects import Parameters as ObjectParameters
from app.derive.imagery_to_objects import imagery_to_objects
from app.derive.imagery_to_occupancy import Parameters as GridParameters
from app.derive.imagery_to_occupancy import imagery_to_occupancy
from app.model.features import Features
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.imagery import GeoImage
from app.model.layers import MAP, Layers, PartKey
from tests.derive.judge import BadLabels, Case, Figure, Result

KINDS: dict[str, frozenset[str]] = {
    "building": frozenset({"building"}),
    "tree": frozenset({"tree", "vegetation"}),
    "grass": frozenset({"field"}),
    "bare": frozenset({"field", "path", "road"}),
    "paved": frozenset({"path", "road", "paved"}),
    "water": frozenset({"water"}),
}
"""Kinds of objects that are right for a label; a field may state its surface."""

SURFACES = {"green": frozenset({"grass"}), "bare": frozenset({"bare"}), "paved": frozenset({"paved", "bare"})}
"""Labels that a field of each surface is right for."""

OBSTACLES = frozenset({"building", "tree", "water"})
UNCOUNTED = frozenset({"bridge", "vehicle"})
COLOURS = {"right": (0, 200, 0), "unknown": (160, 160, 160), "wrong": (255, 140, 0), "obstacle free": (255, 0, 0)}
SIDE = 1600
"""Maximum side of the picture of a result, in pixels."""


@dataclass(frozen=True, slots=True)
class Point:
    """Labelled point. verdict: key of COLOURS."""

    column: int
    row: int
    labels: frozenset[str]
    verdict: str = ""


def judge(case: Case) -> Result:
    """Derive objects and a grid from the picture, and compare them with the labelled points."""
    picture = read_picture(case)
    layers = Layers({PartKey("imagery", "ground", "satellite"): picture})
    (objects,) = imagery_to_objects(layers, ObjectParameters(), DerivationNotes()).parts.values()
    grid = imagery_to_occupancy(layers, GridParameters(), DerivationNotes()).parts[PartKey("occupancy", "ground", MAP)]
    assert isinstance(objects, Features)
    assert isinstance(grid, OccupancyGrid)
    points = _verdicts(case, picture, objects, grid)
    return Result(_figures(points), _draw(picture, grid, points))


def _read(path: Path) -> NDArray[Any]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # pictures without a position
        with rasterio.open(path) as source:
            return np.moveaxis(source.read(), 0, 2)


def read_picture(case: Case) -> GeoImage:
    """Return the labelled picture in metres; what is black in all bands is outside."""
    pixels = _read(case.file())
    bands = [str(word) for word in case.labels["bands"]]
    if len(bands) != pixels.shape[2]:
        raise BadLabels(f"{case.path}: bands has {len(bands)} entries, the picture {pixels.shape[2]} bands")
    covered = pixels.any(axis=2)
    described = [
        {"colour": word} if word in ("red", "green", "blue") else {"colour": "undefined", "description": word}
        for word in bands
    ]
    if not covered.all():
        pixels = np.dstack([pixels, np.where(covered, 255, 0).astype(pixels.dtype)])
        described.append({"colour": "alpha"})
    size = float(case.labels["resolution"])
    return GeoImage(pixels, (size, 0.0, 0.0, 0.0, -size, size * pixels.shape[0]), properties={"bands": described})


def _verdicts(case: Case, picture: GeoImage, objects: Features, grid: OccupancyGrid) -> list[Point]:
    size, height = picture.transform[0], picture.pixels.shape[0]
    areas = [k for k, g in enumerate(objects.geometry) if g.geom_type in ("Polygon", "MultiPolygon")]
    tree = shapely.STRtree([objects.geometry[k] for k in areas])
    out = []
    for column, row, words in case.labels["points"]:
        labels = frozenset(words.split("/"))
        if labels - KINDS.keys() - UNCOUNTED:
            raise BadLabels(f"{case.path}: unknown label {words!r}; known: {', '.join([*KINDS, *sorted(UNCOUNTED)])}")
        x, y = (column + 0.5) * size, (height - row - 0.5) * size
        inside = tree.query(shapely.Point(x, y), predicate="within")
        properties = objects.properties[areas[int(inside[0])]] if len(inside) else {}
        i, j = int((y - grid.origin[1]) / grid.resolution), int((x - grid.origin[0]) / grid.resolution)
        cell = int(grid.cells[i, j]) if 0 <= i < grid.height and 0 <= j < grid.width else UNKNOWN
        out.append(Point(column, row, labels, _verdict(labels, dict(properties), cell)))
    return out


def _verdict(labels: frozenset[str], properties: dict[str, Any], cell: int) -> str:
    if labels & UNCOUNTED:
        return ""
    if cell == FREE and labels <= OBSTACLES:
        return "obstacle free"
    if cell == UNKNOWN:
        return "unknown"
    if properties:
        return "right" if any(_is_right(label, properties) for label in labels) else "wrong"
    fits = bool(labels & OBSTACLES) if cell == OCCUPIED else bool(labels - OBSTACLES)
    return "right" if fits else "wrong"


def _is_right(label: str, properties: dict[str, Any]) -> bool:
    kind, surface = properties["kind"], properties.get("surface")
    if kind == "field" and surface is not None:
        return label in SURFACES.get(surface, frozenset())
    return kind in KINDS[label]


def _figures(points: list[Point]) -> list[Figure]:
    counted = [p for p in points if p.verdict]
    hard = [p for p in counted if p.labels <= OBSTACLES]

    def share(chosen: list[Point], *verdicts: str) -> float:
        return sum(p.verdict in verdicts for p in chosen) / max(len(chosen), 1)

    unknown = share(counted, "unknown")
    figures = [
        Figure("right or unknown", share(counted, "right", "unknown"), at_least=0.8),
        Figure("obstacles called free", share(hard, "obstacle free"), at_most=0.05),
        Figure("decided", 1 - unknown, at_least=0.4),
        Figure("right of decided", share(counted, "right") / max(1 - unknown, 1e-9)),
    ]
    for label in KINDS:
        chosen = [p for p in counted if p.labels == {label}]
        if chosen:
            figures.append(Figure(f"{label} right, of {len(chosen)}", share(chosen, "right")))
            figures.append(Figure(f"{label} unknown", share(chosen, "unknown")))
    return figures


def _draw(picture: GeoImage, grid: OccupancyGrid, points: list[Point]) -> Image.Image:
    """Draw the grid over the picture (free green, occupied red, unknown as it is), and the points by verdict."""
    pixels, size, height = picture.pixels, picture.transform[0], picture.pixels.shape[0]
    scale = min(1.0, SIDE / max(pixels.shape[:2]))
    shown = Image.fromarray(np.ascontiguousarray(pixels[..., :3])).resize(
        (round(pixels.shape[1] * scale), round(pixels.shape[0] * scale))
    )
    rows, columns = np.indices((shown.height, shown.width))
    i = ((height * size - (rows + 0.5) / scale * size - grid.origin[1]) / grid.resolution).astype(int)
    j = (((columns + 0.5) / scale * size - grid.origin[0]) / grid.resolution).astype(int)
    inside = (i >= 0) & (i < grid.height) & (j >= 0) & (j < grid.width)
    cells = np.full(rows.shape, UNKNOWN, np.uint8)
    cells[inside] = grid.cells[i[inside], j[inside]]
    out = np.asarray(shown).astype(np.float32)
    for value, colour in ((FREE, (0, 255, 0)), (OCCUPIED, (255, 0, 0))):
        out[cells == value] = out[cells == value] * 0.6 + np.array(colour, np.float32) * 0.4
    image = Image.fromarray(out.astype(np.uint8))
    pen = ImageDraw.Draw(image)
    for p in points:
        if p.verdict:
            x, y = p.column * scale, p.row * scale
            pen.ellipse((x - 6, y - 6, x + 6, y + 6), fill=COLOURS[p.verdict], outline=(0, 0, 0))
            pen.text((x + 8, y - 6), "/".join(sorted(p.labels)), fill=(255, 255, 0))
    return image

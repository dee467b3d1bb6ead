"""Judge rows in fields: rows and networks that people drew, or that a generator planted, against the derived ones.

Keys of the label files, beside those of every kind. A grid:

    map: …/map.yaml              # an occupancy grid, and its image
    image: …/map.png
    image_sha256: 58d4…
    rows:                        # metres in the local frame: x and y of both ends
      - [12.57, -12.19, 16.10, -36.22]
    nodes:                       # of the aisles and headlands, as people drew them
      - [19.53, -9.35]

Made-up sites: only the picture is given to the derivation, rows and nodes are the generator's:

    generator: orchard           # or vineyard, crop_rows
    seeds: [1, 2, 3]

A row is found if a derived line lies within 0.3 of the rows' distance at its middle, along at least half of it, within
3°; each derived line counts once. Where an aisle crosses the rows, each piece is a row. The distance of rows is the
median distance from a row to the nearest one that lies beside it. Errors of spacing and angle are those
of the found rows. Of several seeds the worst value counts.

The peer is the usual way: a probabilistic Hough transform of the mask of vegetation (excess green, Otsu) or of the
occupied cells; segments along the most frequent direction are grouped into lines.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from app import formats, generate
from app.derive import DerivationNotes, all_derivations, run
from app.errors import CannotConvert
from app.formats import ReadContext
from app.model.features import Features
from app.model.frame import GROUND
from app.model.grid import OCCUPIED, OccupancyGrid
from app.model.imagery import GeoImage, display_pixels
from app.model.layers import MAP, Layers, Part, PartKey
from tests.derive.judge import Case, Figure, Result

Array = NDArray[np.float64]

NEAR = 0.5
"""Metres from a drawn node to the derived network within which it is reached."""

SIDE = 1400
"""Maximum side of the picture of a result, in pixels."""


@dataclass(frozen=True, slots=True)
class Truth:
    """What a map shows. rows: lines. nodes: float64 [n, 2]. source: stored grid or picture."""

    rows: Sequence[Any]
    nodes: Array
    source: Layers


@dataclass(frozen=True, slots=True)
class Derived:
    """Rows (lines) and network (nodes [n, 2], lines) of a map."""

    rows: Sequence[Any]
    nodes: Array
    edges: Sequence[Any]


def judge(case: Case) -> Result:
    """Derive rows and a network, and compare them with the drawn ones."""
    truths = _generated(case) if "generator" in case.labels else [_drawn(case)]
    measured, picture = [], None
    for truth in truths:
        derived = _derive(truth.source)
        peer = _peer(*_mask(truth.source))
        found, right, spacing, angle = _compare(truth.rows, derived.rows)
        peer_found, peer_right, *_ = _compare(truth.rows, peer)
        near_line, near_node = _reach(truth.nodes, derived)
        measured.append((found, right, spacing, angle, near_line, near_node, peer_found, peer_right))
        picture = picture or _draw(truth, derived)
    table = np.array(measured)
    low, high = table.min(axis=0), table.max(axis=0)
    figures = [
        Figure("rows found", low[0], at_least=max(0.9, low[6])),
        Figure("rows right", low[1], at_least=0.9),
        Figure("spacing error", high[2], "%", at_most=5.0),
        Figure("angle error", high[3], "°", at_most=1.0),
        Figure("drawn nodes within 0.5 m of an edge", low[4], at_least=0.9),
        Figure("drawn nodes within 0.5 m of a node", low[5]),
        Figure("rows found by the peer", low[6]),
        Figure("rows right of the peer", low[7]),
    ]
    return Result(figures, picture)


def _drawn(case: Case) -> Truth:
    path, image = case.file(), case.file("image")
    files = {path.name: path.read_bytes(), image.name: image.read_bytes()}
    fmt = formats.get_format("occupancy_grid")
    (grid,) = formats.read(formats.FileGroup(fmt, path.name, files), ReadContext()).parts.values()
    rows = np.array(case.labels["rows"], float).reshape(-1, 2, 2)
    return Truth(
        list(shapely.linestrings(rows)),
        np.array(case.labels["nodes"], float),
        Layers({PartKey("occupancy", GROUND, MAP): grid}),
    )


def _generated(case: Case) -> list[Truth]:
    out = []
    for seed in case.labels["seeds"]:
        site = generate.run(case.labels["generator"], int(seed), {}, Layers({}), DerivationNotes())
        (objects,) = site.vector("objects").values()
        (network,) = site.vector("topology").values()
        rows = [
            g
            for g, p in zip(objects.geometry, objects.properties, strict=True)
            if p["kind"] in ("tree_row", "fence", "plant") and g.geom_type == "LineString"
        ]
        nodes = [
            shapely.get_coordinates(g)[0]
            for i, g, p in zip(network.ids, network.geometry, network.properties, strict=True)
            if p["kind"] == "node" and "-c" in i
        ]
        pictures: dict[PartKey, Part] = {k: p for k, p in site.parts.items() if k.layer == "imagery"}
        out.append(Truth(rows, np.array(nodes), Layers(pictures)))
    return out


def _derive(source: Layers) -> Derived:
    """Derive rows and network as a user would; nothing where there are none."""
    name = "imagery_to_rows" if source.parts_of("imagery") else "occupancy_to_rows"
    made: list[Features | None] = [None, None]
    try:
        with_rows = run([all_derivations()[name].step()], source)
        with_network = run([all_derivations()["rows_to_topology"].step()], with_rows)
    except CannotConvert:
        pass
    else:
        (made[0],) = with_rows.vector("objects").values()
        (made[1],) = with_network.vector("topology").values()
    objects, network = made
    rows = [] if objects is None else [g for g, p in _of(objects) if p["kind"] == "row"]
    listed = [] if network is None else _of(network)
    nodes = np.array([shapely.get_coordinates(g)[0] for g, p in listed if p["kind"] == "node"]).reshape(-1, 2)
    return Derived(rows, nodes, [g for g, p in listed if p["kind"] == "edge"])


def _of(part: Features) -> list[tuple[Any, Any]]:
    return list(zip(part.geometry, part.properties, strict=True))


def _compare(drawn: Sequence[Any], derived: Sequence[Any]) -> tuple[float, float, float, float]:
    """Return (share found, share right, spacing error in %, angle error in degrees)."""
    direction = _direction(drawn)
    spacing = _spacing(drawn, direction)
    taken: dict[int, int] = {}
    for k, row in enumerate(drawn):
        for n, line in enumerate(derived):
            if n not in taken.values() and _same(row, line, 0.3 * spacing):
                taken[k] = n
                break
    if not taken:
        return 0.0, 0.0, math.nan, math.nan
    chosen = [derived[n] for n in taken.values()]
    own = _spacing(chosen, direction)
    c, s = _direction(chosen)
    # the rows that were found may be pieces of curves on one side of the field
    direction = _direction([drawn[k] for k in taken])
    angle = math.degrees(abs(math.asin(max(-1.0, min(1.0, c * direction[1] - s * direction[0])))))
    return len(taken) / len(drawn), len(taken) / len(derived), abs(own / spacing - 1) * 100, angle


def _ends(lines: Sequence[Any]) -> Array:
    """Return the ends of lines, float64 [n, 2, 2]."""
    return np.array([shapely.get_coordinates(line)[[0, -1]] for line in lines]).reshape(-1, 2, 2)


def _direction(lines: Sequence[Any]) -> Array:
    """Return the mean direction of lines, as a unit vector."""
    ends = _ends(lines)
    step = ends[:, 1] - ends[:, 0]
    double = 2 * np.arctan2(step[:, 1], step[:, 0])
    angle = math.atan2(float(np.sin(double).mean()), float(np.cos(double).mean())) / 2
    return np.array([math.cos(angle), math.sin(angle)])


def _spacing(lines: Sequence[Any], direction: Array) -> float:
    """Return the median distance from a line to the nearest one beside it, NaN if there is none."""
    along = np.sort(_ends(lines) @ direction, axis=1)
    nearest = []
    for k, line in enumerate(lines):
        shared = np.minimum(along[:, 1], along[k, 1]) - np.maximum(along[:, 0], along[k, 0])
        beside = shared >= 0.5 * (along[k, 1] - along[k, 0])
        beside[k] = False
        middle = line.interpolate(0.5, normalized=True)
        nearest += [min(lines[n].distance(middle) for n in np.flatnonzero(beside).tolist())] if beside.any() else []
    return float(np.median(nearest)) if nearest else math.nan


def _same(row: Any, line: Any, near: float) -> bool:
    """Return whether a derived line follows a drawn row."""
    ends, others = _ends([row, line])
    step = ends[1] - ends[0]
    length = float(np.hypot(*step))
    unit = step / length
    along = np.sort((others - ends[0]) @ unit)
    if min(along[1], length) - max(along[0], 0.0) < length / 2:
        return False
    other = others[1] - others[0]
    if abs(float(unit[0] * other[1] - unit[1] * other[0])) > math.sin(math.radians(3)) * float(np.hypot(*other)):
        return False
    return bool(line.distance(row.interpolate(0.5, normalized=True)) <= near)


def _reach(nodes: Array, derived: Derived) -> tuple[float, float]:
    """Return the shares of drawn nodes near the derived network's lines, and near its nodes."""
    if not len(derived.nodes) or not derived.edges:
        return 0.0, 0.0
    lines = shapely.union_all(np.array(derived.edges, object))
    points = shapely.points(nodes)
    to_node = np.array([np.hypot(*(derived.nodes - node).T).min() for node in nodes])
    return float((shapely.distance(points, lines) <= NEAR).mean()), float((to_node <= NEAR).mean())


def _mask(source: Layers) -> tuple[NDArray[np.uint8], float, float, float]:
    """Return the peer's mask, row 0 on top, with metres per pixel and the left and upper edge."""
    for part in source.parts.values():
        if isinstance(part, OccupancyGrid):
            top = part.origin[1] + part.height * part.resolution
            return (part.cells[::-1] == OCCUPIED).astype(np.uint8), part.resolution, part.origin[0], top
        if isinstance(part, GeoImage):
            rgb = display_pixels(part)[..., :3].astype(np.float32)
            green = (2 * rgb[..., 1] - rgb[..., 0] - rgb[..., 2]) / np.maximum(rgb.sum(axis=2), 1)
            scaled = np.clip((green + 1) * 127, 0, 255).astype(np.uint8)
            _, mask = cv2.threshold(scaled, 0, 1, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
            a, _, left, _, _, top = part.transform
            return mask.astype(np.uint8), a, left, top
    raise AssertionError("neither a grid nor a picture")


def _peer(mask: NDArray[np.uint8], size: float, left: float, top: float) -> list[Any]:
    """Return the rows that a probabilistic Hough transform finds."""
    cv2.setRNGSeed(0)
    edges = cv2.HoughLinesP(mask * 255, 1, math.pi / 360, 30, minLineLength=3 / size, maxLineGap=1.5 / size)
    if edges is None:
        return []
    lines = edges.reshape(-1, 2, 2).astype(float)
    lines = np.stack([left + lines[..., 0] * size, top - lines[..., 1] * size], axis=-1)
    step = lines[:, 1] - lines[:, 0]
    length, angle = np.hypot(*step.T), np.degrees(np.arctan2(step[:, 1], step[:, 0])) % 180
    sums = np.bincount(np.round(angle).astype(int) % 180, length, 180)
    best = int(np.argmax(sums))
    lines = lines[np.abs((angle - best + 90) % 180 - 90) <= 2]
    c, s = math.cos(math.radians(best)), math.sin(math.radians(best))
    across = lines.mean(axis=1) @ np.array([-s, c])
    order = np.argsort(across)
    groups = np.split(order, np.flatnonzero(np.diff(across[order]) > 0.3) + 1)
    out: list[Any] = []
    for group in groups:
        ends = lines[group].reshape(-1, 2)
        along, v = ends @ np.array([c, s]), float(across[group].mean())
        out.append(shapely.LineString([(c * u - s * v, s * u + c * v) for u in (along.min(), along.max())]))
    return out


def _draw(truth: Truth, derived: Derived) -> Image.Image:
    """Draw drawn rows (blue) and nodes (blue), derived rows (red) and network (green) over the map."""
    mask, size, left, top = _mask(truth.source)
    for part in truth.source.parts.values():
        if isinstance(part, GeoImage):
            base = Image.fromarray(np.ascontiguousarray(display_pixels(part)[..., :3]))
        else:
            base = Image.fromarray(((1 - mask) * 255).astype(np.uint8)).convert("RGB")
    around = np.concatenate([shapely.get_coordinates(list(truth.rows)), truth.nodes])
    (low_x, low_y), (high_x, high_y) = around.min(axis=0) - 5, around.max(axis=0) + 5
    west, east = (int((x - left) / size) for x in (low_x, high_x))
    north, south = (int((top - y) / size) for y in (high_y, low_y))
    scale = SIDE / max(east - west, south - north)
    image = base.crop((west, north, east, south)).resize((round((east - west) * scale), round((south - north) * scale)))
    pen = ImageDraw.Draw(image)

    def at(xy: Any) -> list[tuple[float, float]]:
        return [(((x - left) / size - west) * scale, ((top - y) / size - north) * scale) for x, y in xy]

    for edge in derived.edges:
        pen.line(at(shapely.get_coordinates(edge)), fill=(0, 180, 0), width=2)
    for row in truth.rows:
        pen.line(at(shapely.get_coordinates(row)), fill=(60, 120, 255), width=5)
    for row in derived.rows:
        pen.line(at(shapely.get_coordinates(row)), fill=(255, 0, 0), width=2)
    for nodes, colour, r in ((truth.nodes, (60, 120, 255), 5), (derived.nodes, (0, 180, 0), 3)):
        for x, y in at(nodes):
            pen.ellipse((x - r, y - r, x + r, y + r), outline=colour, width=2)
    return image

"""Cellular automata: caves, forests and cluttered halls grown from random cells by a rule in B/S notation.

A rule ``B5678/S45678`` states with how many of its eight neighbours a dead cell is born (B) and a living one survives
(S). Living cells are rock, trees or clutter. Then places that a robot of the given radius fits into are joined by
passages, shortest first, and all others are filled, so that free space is one piece.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.derive import DerivationNotes
from app.errors import CannotGenerate
from app.generate import MAX_OBJECTS, RandomSource, _automata, _cells, generates
from app.generate._cells import STYLES, CellStyle, GridFrame
from app.generate._shapes import angle, disc, mm
from app.generate._site import Site, SiteOptions, invalid_option_error
from app.model.frame import GROUND
from app.model.layers import Layers
from app.parameters import parameter

Bool = NDArray[np.bool_]

RULE = re.compile(r"B([0-8]*)/S([0-8]*)", re.ASCII)

RESOLUTION = 0.05

CLUTTER = CellStyle("obstacle", 1.2, "goods")


@dataclass(frozen=True, slots=True)
class CaveOptions(SiteOptions):
    """Parameters of a cave."""

    width: float = parameter(30.0, "size along x, if there is no fence", minimum=1.0, maximum=5000.0, unit="m")
    depth: float = parameter(30.0, "size along y, if there is no fence", minimum=1.0, maximum=5000.0, unit="m")
    cell: float = parameter(
        0.25, "size of the automaton's cells; a multiple of the grid's", minimum=0.01, maximum=50.0, unit="m"
    )
    rule: str = parameter("B5678/S45678", "numbers of neighbours with which a cell is born (B) and survives (S)")
    iterations: int = parameter(6, "number of times that the rule is applied", minimum=0, maximum=1000)
    density: float = parameter(0.49, "share of living cells at the start", minimum=0.0, maximum=1.0)
    passage: float | None = parameter(
        None,
        "width of passages between places; default: three times robot_radius",
        minimum=0.0,
        maximum=100.0,
        unit="m",
    )
    smallest: float = parameter(
        2.0, "area below which places are filled instead of joined", minimum=0.0, maximum=1e6, unit="m²"
    )


@dataclass(frozen=True, slots=True)
class HallOptions(CaveOptions):
    """Parameters of a cluttered hall."""

    width: float = parameter(20.0, "size along x, if there is no fence", minimum=1.0, maximum=5000.0, unit="m")
    depth: float = parameter(15.0, "size along y, if there is no fence", minimum=1.0, maximum=5000.0, unit="m")
    cell: float = parameter(
        0.4, "size of the automaton's cells; a multiple of the grid's", minimum=0.01, maximum=50.0, unit="m"
    )
    rule: str = parameter("B5678/S3456", "numbers of neighbours with which a cell is born (B) and survives (S)")
    iterations: int = parameter(2, "number of times that the rule is applied", minimum=0, maximum=1000)
    density: float = parameter(0.34, "share of living cells at the start", minimum=0.0, maximum=1.0)


@dataclass(frozen=True, slots=True)
class ForestOptions(SiteOptions):
    """Parameters of a forest."""

    width: float = parameter(60.0, "size along x, if there is no fence", minimum=5.0, maximum=5000.0, unit="m")
    depth: float = parameter(60.0, "size along y, if there is no fence", minimum=5.0, maximum=5000.0, unit="m")
    spacing: float = parameter(
        2.5, "size of the automaton's cells, each with one tree", minimum=0.5, maximum=50.0, unit="m"
    )
    rule: str = parameter("B5678/S345678", "numbers of neighbours with which a cell is born (B) and survives (S)")
    iterations: int = parameter(3, "number of times that the rule is applied", minimum=0, maximum=1000)
    density: float = parameter(0.4, "share of living cells at the start", minimum=0.0, maximum=1.0)
    jitter: float = parameter(
        0.3, "maximum distance of trees from their cell's centre, as a share of the spacing", minimum=0.0, maximum=0.5
    )
    trunk: tuple[float, float] = parameter(
        (0.1, 0.25), "smallest,largest radius of the trunks", minimum=0.02, maximum=2.0, unit="m"
    )
    tree_height: tuple[float, float] = parameter(
        (6.0, 14.0), "smallest,largest height of the trees", minimum=1.0, maximum=100.0, unit="m"
    )


@generates(
    {"location", "objects", "occupancy", "topology", "imagery"}, parameters=CaveOptions, also={"location"}, version=3
)
def cave(given: Layers, options: CaveOptions, source: RandomSource, notes: DerivationNotes) -> Layers:
    """Cave: halls and passages in rock, grown by a cellular automaton."""
    return _grow_site(given, options, source, notes, STYLES["rock"], STYLES["rock"], ground="gravel")


@generates(
    {"location", "objects", "occupancy", "topology", "imagery"}, parameters=HallOptions, also={"location"}, version=3
)
def cluttered_hall(given: Layers, options: HallOptions, source: RandomSource, notes: DerivationNotes) -> Layers:
    """Hall full of clutter, heaped up by a cellular automaton."""
    return _grow_site(given, options, source, notes, CLUTTER, STYLES["wall"], ground="floor")


@generates(
    {"location", "objects", "occupancy", "topology", "imagery"}, parameters=ForestOptions, also={"location"}, version=3
)
def forest(given: Layers, options: ForestOptions, source: RandomSource, notes: DerivationNotes) -> Layers:
    """Forest: trees with trunks and crowns, and clearings, from a cellular automaton."""
    for name in ("trunk", "tree_height"):
        low, high = getattr(options, name)
        if low > high:
            raise invalid_option_error(name, "the smaller value must come first")
    reach = options.spacing * (0.5 - options.jitter)
    if reach < options.trunk[1]:
        raise invalid_option_error(
            "jitter", f"trunks of {options.trunk[1]:g} m would touch: use less jitter or a larger spacing"
        )
    site = Site(given, options, notes)
    box = site.set_fence(shapely.box(0.0, 0.0, options.width, options.depth)).bounds
    columns, rows = (max(1, int((b - a) / options.spacing)) for a, b in ((box[0], box[2]), (box[1], box[3])))
    if rows * columns > MAX_OBJECTS:
        raise invalid_option_error(
            "spacing", f"the forest has {columns} × {rows} cells; the limit is {MAX_OBJECTS}: use a larger spacing"
        )
    born, stays = _rule(options.rule)
    alive = source.stream("cells").random((rows, columns)) < options.density
    alive = _automata.run_automaton(alive, born, stays, options.iterations, outside=False)
    _trees(site, alive, box, options, source)
    return _cells.finish_site(site, options, notes, ground="meadow")


def _grow_site(
    given: Layers,
    options: CaveOptions,
    source: RandomSource,
    notes: DerivationNotes,
    look: CellStyle,
    border: CellStyle,
    *,
    ground: str,
) -> Layers:
    """Generate a closed site of occupied cells with one piece of free space."""
    resolution = options.resolution or _fine(options)
    step = round(options.cell / resolution)
    if step < 1 or abs(step * resolution - options.cell) > 1e-6:
        raise invalid_option_error(
            "cell", f"must be a whole number of cells of {resolution:g} m, got {options.cell:g} m"
        )
    born, stays = _rule(options.rule)
    site = Site(given, options, notes)
    place = _cells.site_grid_frame(site, options.width, options.depth, resolution, step=step)
    coarse = GridFrame(place.x, place.y, options.cell, place.columns // step, place.rows // step)
    if min(coarse.rows, coarse.columns) < 5:
        raise invalid_option_error(
            "cell",
            f"the site has {coarse.columns} × {coarse.rows} cells, and at least 5 × 5 are required: use smaller cells "
            "or a larger site",
        )
    if coarse.rows * coarse.columns * max(options.iterations, 1) > MAX_STEPS:
        raise invalid_option_error(
            "iterations",
            f"{coarse.rows * coarse.columns} cells times {options.iterations} iterations exceed the limit of "
            f"{MAX_STEPS}: use fewer iterations, or larger cells",
        )
    occupied = source.stream("cells").random((coarse.rows, coarse.columns)) < options.density
    occupied = _automata.run_automaton(occupied, born, stays, options.iterations, outside=True)
    rim = np.zeros(occupied.shape, bool)
    rim[[0, -1]] = rim[:, [0, -1]] = True
    if site.is_given:
        rim |= ~_within(site.fence, coarse)
    occupied |= rim
    passage = 3 * options.robot_radius if options.passage is None else options.passage
    joined, closed, passages = _automata.join_free_space(
        occupied,
        rim,
        options.robot_radius / options.cell,
        max(passage / options.cell, 1.0),
        options.smallest / options.cell**2,
    )
    if joined.all():
        raise CannotGenerate("no free space is left: use a lower density, another rule, or a smaller robot_radius")
    notes.drop("free cells", closed, "in isolated areas, which are filled")
    if passages:
        notes.fill("passages", passages, "joined isolated areas of free space")
    if border is look:
        _cells.add_objects(site, coarse, joined, look)
    else:
        _cells.add_objects(site, coarse, joined & rim, border)
        _cells.add_objects(site, coarse, joined & ~rim, look)
    return _cells.finish_site(site, options, notes, ground=ground)


MAX_STEPS = 2**32
"""Maximum product of cells and iterations."""


def _fine(options: CaveOptions) -> float:
    """Return the default resolution if the automaton's cells are multiples of it, else their size."""
    step = options.cell / RESOLUTION
    is_multiple = abs(step - round(step)) < 1e-6 and step >= 1
    return RESOLUTION if is_multiple and options.width * options.depth / RESOLUTION**2 <= 2**22 else options.cell


def _rule(text: str) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Parse a rule: (numbers of neighbours with which a cell is born, with which it survives)."""
    match = RULE.fullmatch(text.strip().upper())
    if match is None:
        raise invalid_option_error(
            "rule", f"must be B and S with numbers of neighbours from 0 to 8, such as B5678/S45678, got {text[:40]!r}"
        )
    born, stays = (tuple(sorted({int(c) for c in digits})) for digits in match.groups())
    return born, stays


def _within(fence: Any, place: GridFrame) -> Bool:
    """Return the cells that are completely inside a fence, except those at its border."""
    inner = shapely.buffer(fence, -place.resolution, join_style="mitre")
    x = place.x + (np.arange(place.columns) + 0.5) * place.resolution
    y = place.y + (np.arange(place.rows) + 0.5) * place.resolution
    shapely.prepare(inner)
    return np.asarray(shapely.contains_xy(inner, *np.meshgrid(x, y)), bool)


def _trees(site: Site, alive: Bool, box: tuple[float, ...], options: ForestOptions, source: RandomSource) -> None:
    draw = source.stream("trees").random((*alive.shape, 5))
    rows, columns = np.nonzero(alive)
    floor = site.elevation(GROUND)
    inner = shapely.buffer(site.fence, -options.trunk[1])
    shapely.prepare(inner)
    count = 0
    for r, c in zip(rows.tolist(), columns.tolist(), strict=True):
        u, v, thick, tall, turn = draw[r, c].tolist()
        x = mm(box[0] + (c + 0.5 + (2 * u - 1) * options.jitter) * options.spacing)
        y = mm(box[1] + (r + 0.5 + (2 * v - 1) * options.jitter) * options.spacing)
        if not inner.contains(shapely.Point(x, y)):
            continue
        count += 1
        radius = mm(options.trunk[0] + thick * (options.trunk[1] - options.trunk[0]))
        height = mm(options.tree_height[0] + tall * (options.tree_height[1] - options.tree_height[0]))
        stem, crown = mm(0.6 * height), mm(min(0.25 * height, options.spacing))
        trunk: Mapping[str, Any] = {
            "type": "cylinder",
            "radius": radius,
            "length": stem,
            "pose": [0.0, 0.0, mm(stem / 2), 0.0, 0.0, 0.0],
        }
        leaves: Mapping[str, Any] = {
            "type": "ellipsoid",
            "radii": [crown, crown, mm(0.275 * height)],
            "pose": [0.0, 0.0, mm(0.725 * height), 0.0, 0.0, 0.0],
            "visual": True,
        }
        site.add_object(
            f"tree/{count}",
            "tree",
            shapely.Point(x, y),
            shapes=[trunk, leaves],
            pose=(x, y, floor, angle(6.283185 * turn)),
            colour=("crown", "crown_light", "crown_dark")[count % 3],
            seen=disc(x, y, crown),
            width=mm(2 * radius),
            height=height,
        )
    if not count:
        raise CannotGenerate("no tree is left: use a higher density, another rule or fewer iterations")

"""Drawn zones -> Nav2's costmap filter masks, so that a keepout drawn in Google Earth or QGIS becomes keepout.yaml.

Zones of kind ``keepout`` (and ``preferred``: lanes that robots should use) give the grid ``keepout``, those of kind
``speed`` the grid ``speed``; each grid carries the meaning of its cells (``app.model.masks``). Every cell that a zone
touches is in it, so that robots never cut into a keepout; a lane has only cells whose centre it contains.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from app.derive import DerivationNotes, derives
from app.errors import CannotConvert, MissingLayer
from app.model import masks
from app.model.features import Features
from app.model.grid import FREE, OCCUPIED, OccupancyGrid
from app.model.layers import MAP, Layers, Part, PartKey
from app.model.masks import FilterInfo
from app.parameters import parameter

KEEPOUT, SPEED = "keepout", "speed"
KEEPOUTS = frozenset({"keepout", "keep_out", "no_go", "nogo", "forbidden"})
LANES = frozenset({"preferred", "preferred_lane", "lane"})
SPEEDS = frozenset({"speed", "speed_limit", "speed_zone"})

RESOLUTION = 0.05
"""Default cell size in metres without a map: the usual one of Nav2's maps."""

MAX_RESOLUTION_METRES = 1.0
"""Maximum size of a cell in metres that is chosen for large zones without a map."""

MARGIN = 1.0
"""Margin around the zones of a level without a map, in metres."""

STEPS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
"""Metres per second of one step of a cell: the finest one that reaches the highest limit is used, or the lowest limit
if that is less.
"""

MAX_CELLS = 2**28

MAX_SIDE_CELLS = 32767
"""Maximum number of cells along a side: Nav2's map_server rejects larger maps."""

_LIMIT = re.compile(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(%|percent|m/s)?\s*\Z", re.ASCII)


@dataclass(frozen=True, slots=True)
class Parameters:
    """Parameters of zones_to_occupancy."""

    resolution: float | None = parameter(
        None,
        "size of a cell; default: the map's, else 0.05 m or coarser for large zones",
        minimum=1e-3,
        maximum=1e3,
        unit="m",
    )
    speed_in: Literal["percent", "m/s"] | None = parameter(
        None, "unit of the speed mask's cells; default: m/s, or percent if every zone uses percent"
    )
    max_speed: float | None = parameter(
        None, "top speed of the robot, to convert between percent and m/s", minimum=1e-3, maximum=1e3, unit="m/s"
    )
    lane_cost: int = parameter(50, "cost of cells outside preferred lanes, if there are lanes", minimum=1, maximum=99)


@derives(
    gives="occupancy",
    needs={"zones"},
    parameters=Parameters,
    cost=1.0,
    makes=frozenset({KEEPOUT, SPEED}),
    version=2,
)
def zones_to_occupancy(layers: Layers, parameters: Parameters, notes: DerivationNotes) -> Layers:
    """Costmap filter masks from keepout and speed zones: grids keepout and speed, in the frame of the level's map.

    Raises MissingLayer if there is no zone of these kinds, MissingDatum for WGS 84 zones without a datum, CannotConvert
    for masks that are too large or speeds that cannot be converted.
    """
    parts: dict[PartKey, Part] = {}
    for level in dict.fromkeys(key.level for key in layers.vector("zones")):
        zones = _zones(layers, level, notes)
        if not zones:
            continue
        frame = _frame(layers, level, [z.shape for z in zones], parameters.resolution)
        _report_outside(zones, frame, level, notes)
        blocked = [z.shape for z in zones if z.kind in KEEPOUTS]
        lanes = [z.shape for z in zones if z.kind in LANES]
        if blocked or lanes:
            cells = np.full((frame.height, frame.width), parameters.lane_cost if lanes else FREE, np.uint8)
            _burn(cells, frame, lanes, [FREE] * len(lanes), touched=False)
            _burn(cells, frame, blocked, [OCCUPIED] * len(blocked), touched=True)
            if lanes:
                notes.fill("cost beside preferred lanes", parameters.lane_cost, "zones do not state it", "lane_cost")
            parts[PartKey("occupancy", level, KEEPOUT)] = frame.grid(
                cells, KEEPOUT, FilterInfo(masks.KEEPOUT, 0.0, 1.0)
            )
        slow = [z for z in zones if z.kind in SPEEDS]
        values, info = _limits(slow, parameters, notes) if slow else ([], None)
        if info is not None:
            cells = np.full((frame.height, frame.width), FREE, np.uint8)
            # the last one drawn wins: of overlapping zones, the lowest limit
            order = sorted((k for k, v in enumerate(values) if v), key=lambda k: -values[k])
            _burn(cells, frame, [slow[k].shape for k in order], [values[k] for k in order], touched=True)
            parts[PartKey("occupancy", level, SPEED)] = frame.grid(cells, SPEED, info)
    if not parts:
        raise MissingLayer(
            "no zones of kind keepout, preferred or speed (with a value) to derive masks from: upload a drawing with "
            "layer=zones, or add such zones by an edit"
        )
    return Layers(parts, layers.datum, layers.levels)


@dataclass(frozen=True, slots=True)
class _Zone:
    """Zone in local metres."""

    id: str
    kind: str
    value: Any
    shape: Any


@dataclass(frozen=True, slots=True)
class _Frame:
    """Frame of a mask: its lower left corner in metres, its cells."""

    x: float
    y: float
    resolution: float
    width: int
    height: int

    def grid(self, cells: NDArray[np.uint8], name: str, info: FilterInfo) -> OccupancyGrid:
        """Return the mask; ``scale`` gives each of its values from white to black."""
        properties = {masks.NAME: {"params": masks.params(name, info)}}
        return OccupancyGrid(cells, self.resolution, (self.x, self.y, 0.0), "scale", 1.0, 0.0, False, properties)

    def box(self) -> Any:
        """Its outline."""
        return shapely.box(
            self.x, self.y, self.x + self.width * self.resolution, self.y + self.height * self.resolution
        )


def _zones(layers: Layers, level: str, notes: DerivationNotes) -> list[_Zone]:
    """Return the zones of a level that masks are derived from, in the order of their parts and ids."""
    out = []
    other = expiring = flat = 0
    for part in layers.vector("zones", level).values():
        for zone, p in _shapes(part, layers):
            if zone.kind not in KEEPOUTS | LANES | SPEEDS:
                other += 1
            elif shapely.get_dimensions(zone.shape) < 2 or zone.shape.is_empty:
                flat += 1
            else:
                expiring += p.get("expires") is not None and "overlay" not in p  # a closure ends by itself
                out.append(zone)
    notes.drop("zones of other kinds", other, "masks express only keepout, preferred lanes and speed limits")
    notes.drop("zones without an area", flat, "they are not polygons")
    if expiring:
        notes.warn(f"{expiring} zones have an expiry; masks contain them until they are derived again")
    return out


def _shapes(part: Features, layers: Layers) -> Iterator[tuple[_Zone, Any]]:
    geometry = shapely.force_2d(part.in_local(layers.frame))
    broken = ~shapely.is_valid(geometry)
    if broken.any():
        geometry = geometry.copy()
        geometry[broken] = shapely.make_valid(geometry[broken])
    for i, p, shape in zip(part.ids, part.properties, geometry, strict=True):
        yield _Zone(i, str(p.get("kind", "")).strip().lower().replace(" ", "_"), p.get("value"), shape), p


def _frame(layers: Layers, level: str, shapes: list[Any], resolution: float | None) -> _Frame:
    """Return the map's frame if there is one (its cells, or its area in other cells), else one around the zones."""
    map_grid = layers.grids(level).get(PartKey("occupancy", level, MAP))
    if map_grid is not None and map_grid.origin[2] == 0.0 and resolution in (None, map_grid.resolution):
        return _Frame(map_grid.origin[0], map_grid.origin[1], map_grid.resolution, map_grid.width, map_grid.height)
    if map_grid is None:
        low_high = shapely.total_bounds(np.array(shapes, object)) + MARGIN * np.array([-1.0, -1.0, 1.0, 1.0])
    else:
        corners = map_grid.corners()
        low_high = np.concatenate([corners.min(axis=0), corners.max(axis=0)])
    cell = resolution or (RESOLUTION if map_grid is None else map_grid.resolution)
    if map_grid is None and resolution is None:
        cell = _coarse_enough(cell, low_high)
    first = [math.floor(v / cell + 1e-6) for v in low_high[:2]]
    end = [math.ceil(v / cell - 1e-6) for v in low_high[2:]]
    width, height = (max(1, b - a) for a, b in zip(first, end, strict=True))
    if width * height > MAX_CELLS or max(width, height) > MAX_SIDE_CELLS:
        raise CannotConvert(f"a mask of {width} × {height} cells is too large: use a coarser resolution")
    return _Frame(round(first[0] * cell, 9), round(first[1] * cell, 9), cell, width, height)


def _coarse_enough(cell: float, low_high: Any) -> float:
    """Double the cell size, up to MAX_RESOLUTION_METRES, until a mask of this extent is small enough."""
    width, height = float(low_high[2] - low_high[0]), float(low_high[3] - low_high[1])
    while cell * 2.0 <= MAX_RESOLUTION_METRES and (
        (width / cell) * (height / cell) > MAX_CELLS / 4 or max(width, height) / cell + 1.0 > MAX_SIDE_CELLS
    ):
        cell *= 2.0
    return cell


def _report_outside(zones: list[_Zone], frame: _Frame, level: str, notes: DerivationNotes) -> None:
    box = frame.box()
    outside = [z.id for z in zones if not z.shape.intersects(box)]
    cut = sum(not box.covers(z.shape) for z in zones) - len(outside)
    notes.drop("zones outside of the map", len(outside), f"the masks of {level} cover only its map")
    notes.drop("parts of zones outside of the map", cut, f"the masks of {level} cover only its map")


def _burn(cells: NDArray[np.uint8], frame: _Frame, shapes: list[Any], values: list[int], *, touched: bool) -> None:
    """Draw polygons into cells (row 0 at the bottom), later ones over earlier ones."""
    if not shapes:
        return
    from rasterio.features import rasterize
    from rasterio.transform import Affine

    size = frame.resolution
    to_metres = Affine(size, 0.0, frame.x, 0.0, size, frame.y)
    drawn = list(zip(shapes, values, strict=True))
    rasterize(drawn, out=cells, transform=to_metres, all_touched=touched)


def _limits(zones: list[_Zone], parameters: Parameters, notes: DerivationNotes) -> tuple[list[int], FilterInfo | None]:
    """Return (the cell of each zone, 0 if it has no limit; the meaning of cells, None if there is no limit at all).

    Limits are rounded down to what a cell can express, and never to 0, which would mean no limit. If the cells cannot
    express both the lowest and the highest limit, robots are slower than the highest one.
    """
    limits = [_parse_limit(z) for z in zones]
    notes.drop(
        "speed zones without a limit", limits.count(None), "their value is neither a speed in m/s nor a percentage"
    )
    valid_limits = [s for s in limits if s is not None]
    if not valid_limits:
        return [], None
    percent = parameters.speed_in == "percent" or (parameters.speed_in is None and all(p for _, p in valid_limits))
    if parameters.max_speed is None and any(p is not percent for _, p in valid_limits):
        raise CannotConvert(
            "limits in percent and in m/s need the robot's top speed to be combined: set max_speed=… (m/s)"
        )
    top = parameters.max_speed or 1.0
    exact: list[float | None] = []
    for limit in limits:
        if limit is None:
            exact.append(None)
        elif percent:
            exact.append(limit[0] if limit[1] else limit[0] / top * 100.0)
        else:
            exact.append(limit[0] / 100.0 * top if limit[1] else limit[0])
    step = _step([v for v in exact if v is not None], percent=percent)
    values, rounded, capped, stopped = [], 0, 0, 0
    for value in exact:
        if value is None or (percent and value > 100.0):
            values.append(0)
            continue
        cell = min(100, max(1, math.floor(value / step + 1e-6)))
        stopped += value < step - 1e-9
        capped += value > 100 * step + 1e-6
        rounded += abs(cell * step - value) > 1e-6
        values.append(cell)
    unit = "%" if percent else "m/s"
    notes.drop("exact speed limits", rounded, f"cells store multiples of {step:g} {unit}; limits are rounded down")
    if capped:
        lowest = f"the lowest limit needs steps of {step:g} {unit}"
        notes.warn(f"{capped} speed zones get the limit {100 * step:g} {unit}, less than their own: {lowest}")
    if stopped:
        reason = f"the limit 0, or one below {step:g} {unit}, and a cell of 0 means no limit in Nav2"
        notes.warn(f"{stopped} speed zones have {reason}; they get {step:g} {unit}")
    kind = masks.SPEED_PERCENT if percent else masks.SPEED_METRES
    return values, FilterInfo(kind, 0.0, step) if any(values) else None


def _step(limits: list[float], *, percent: bool) -> float:
    """Return the step of a cell, in the limits' unit: not above the lowest of them, which would raise it."""
    highest = max(limits)
    step = 1.0 if percent else next((s for s in STEPS if highest <= 100 * s + 1e-9), STEPS[-1])
    lowest = min((v for v in limits if v > 0.0), default=step)
    return max(STEPS[0], min(step, lowest))


def _parse_limit(zone: _Zone) -> tuple[float, bool] | None:
    """Parse a zone's limit and whether it is a percentage: a number is m/s, a text may name its unit."""
    value = zone.value
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return (float(value), False) if value >= 0 and math.isfinite(value) else None
    match = _LIMIT.match(value) if isinstance(value, str) else None
    return None if match is None else (float(match[1]), match[2] in ("%", "percent"))

"""Objects -> occupancy: grid of a world, building or town, at one height or over a height band."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from app.derive import DerivationNotes, derives
from app.derive._obstacles import (
    DEFAULT_SURROUNDINGS_METRES,
    NOT_AN_OBSTACLE,
    LevelObstacles,
    sites,
    unreadable_error,
)
from app.errors import Invalid, MissingLayer, Problem
from app.model import raster
from app.model.fences import fences, level_fence
from app.model.frame import GROUND
from app.model.grid import FREE, OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.layers import MAP, Layers, Part, PartKey
from app.model.obstacles import UNKNOWN_RADIUS_METRES
from app.model.raster import RasterFrame
from app.parameters import parameter

ENCLOSE = (
    "nothing encloses any ground; upload a fence (datum.yaml with gnss_fence, or a drawing with layer=location) or "
    "floors, or set outside_free=true if robots may drive everywhere"
)
"""Advice if no ground is known to be free."""

ALL_COVERED = (
    "all of it is occupied or near objects of unknown extent; upload the files of their models, or set a smaller "
    "unknown_radius"
)
"""Advice if no free ground is left."""

HEIGHT = 0.2
"""Default height of the slice above the floor in metres: a common height of robot laser scanners."""

RESOLUTION = 0.05
"""Default cell size in metres."""

RESOLUTIONS = (RESOLUTION, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
"""Coarser cell sizes, used if the default one would give a grid that no robot loads."""

DEFAULT_MAX_CELLS = 2**25
"""Maximum number of cells at the default resolution."""

MAX_CELLS = 2**29
"""Maximum number of cells of a grid: a byte each, and twice that while it is computed."""

MAX_SIDE_CELLS = 32767
"""Maximum number of cells along a side: Nav2's map_server rejects larger maps."""


def cell_size() -> Any:
    """Return the field of the parameter ``resolution`` of drawn grids."""
    text = f"size of a cell; default: {RESOLUTION}, or coarser to keep the grid below 2^25 cells"
    return parameter(None, text, minimum=1e-3, maximum=100.0, unit="m")


@dataclass(frozen=True, slots=True)
class Parameters:
    """Parameters of objects_to_occupancy."""

    height: float | None = parameter(
        None,
        f"height of the slice above the level's floor; default: {HEIGHT}, where a laser scanner measures",
        minimum=-1e4,
        maximum=1e4,
        unit="m",
    )
    band: tuple[float, float] | None = parameter(
        None,
        "height range low,high above the level's floor, instead of a slice",
        minimum=-1e4,
        maximum=1e4,
        unit="m",
    )
    resolution: float | None = cell_size()
    inflate: float = parameter(0.0, "distance by which obstacles are grown", minimum=0.0, maximum=100.0, unit="m")
    padding: float = parameter(1.0, "margin around everything, if there is no fence", minimum=0.0, maximum=1000.0)
    outside_free: bool = parameter(
        False, "whether ground outside floors, fence and closed walls is free instead of unknown"
    )
    surroundings: float = parameter(
        DEFAULT_SURROUNDINGS_METRES,
        "radius of unknown ground around an unreadable solid (a mesh that was not uploaded)",
        minimum=0.0,
        maximum=1000.0,
        unit="m",
    )
    unknown_radius: float = parameter(
        UNKNOWN_RADIUS_METRES,
        "radius of unknown ground around an object of unknown extent (a model with neither shapes nor a size, a table "
        "or building that is a point, an invalid pose, an OpenStreetMap area whose rings do not close)",
        minimum=0.0,
        maximum=1000.0,
        unit="m",
    )
    doors: Literal["open", "closed"] = parameter("open", "whether robots can pass doors")
    visuals: bool = parameter(False, "whether visual shapes without collision count as obstacles")
    world: str | None = parameter(None, "world to use, if there are several; default: gazebo…, else the shortest name")


@derives(
    gives="occupancy",
    needs={"objects"},
    also=frozenset({"resources", "location"}),
    parameters=Parameters,
    cost=4.0,
    version=4,
)
def objects_to_occupancy(layers: Layers, parameters: Parameters, notes: DerivationNotes) -> Layers:
    """Occupancy grid of each level from the obstacles at a height.

    Solids are cut and footprints rasterised; every cell that an obstacle touches is occupied. Free are the floors if
    there are any, else the fence, else ground that obstacles enclose. Elsewhere, and around unreadable solids and
    objects of unknown extent, cells are unknown. The origin is a multiple of the resolution, yaw 0. Raises MissingLayer
    if there is no obstacle, or if unreadable solids leave nothing known; MissingDatum for WGS 84 coordinates without a
    datum.
    """
    if parameters.height is not None and parameters.band is not None:
        raise Invalid("height and band exclude each other", [Problem("give height or band", where="band")])
    height = HEIGHT if parameters.height is None else parameters.height
    low, high = parameters.band or (height, height)
    if low > high:
        raise Invalid(
            "band must be low,high with low <= high", [Problem("must be low,high with low <= high", where="band")]
        )
    closed, seen = parameters.doors == "closed", parameters.visuals
    obstacles = sites(
        layers,
        notes,
        doors_closed=closed,
        visuals=seen,
        world=parameters.world,
        surroundings=parameters.surroundings,
        unknown_radius=parameters.unknown_radius,
    )
    around = fences(layers, notes.warn)
    parts: dict[PartKey, Part] = {}
    reach: list[tuple[float, float]] = []
    for level, site in obstacles.items():
        fence = level_fence(around, level, GROUND)
        grid = _grid(site, fence, (low, high), parameters, level, notes)
        if grid is not None:
            parts[PartKey("occupancy", level, MAP)] = grid
        elif len(site.triangles):
            reach.append((float(site.triangles[:, :, 2].min()), float(site.triangles[:, :, 2].max())))
    if not parts:
        extra = (
            f"; the solids reach from {min(r[0] for r in reach):g} to {max(r[1] for r in reach):g} m" if reach else ""
        )
        band = f"at {low:g} m above the floor" if low == high else f"between {low:g} and {high:g} m above the floor"
        unreadable = [reason for site in obstacles.values() for reason in site.unreadable]
        if unreadable:
            raise unreadable_error(unreadable, f"no readable object is an obstacle {band}{extra}")
        extra += "".join(
            f"; {one.count} {one.subject}: {one.why}" for one in notes.dropped if one.why != NOT_AN_OBSTACLE
        )
        raise MissingLayer(
            f"no stored object is an obstacle {band}{extra}: set another height or band, or upload walls, buildings, "
            "barriers, trees or a world with solids"
        )
    return Layers(parts, layers.datum, layers.levels)


def _grid(
    site: LevelObstacles,
    fence: Any,
    band: tuple[float, float],
    parameters: Parameters,
    level: str,
    notes: DerivationNotes,
) -> OccupancyGrid | None:
    """Draw a level's grid; None if there are no obstacles and no floor states which ground is free."""
    low, high = band
    section = site.cut(low, high)
    if not section.count and (site.unreadable or not site.free):
        return None
    if not section.count:
        rest = " except the ground around objects of unknown extent" if section.unknown else ""
        notes.warn(f"no obstacles on level {level}; all of its floor is free{rest}", where=level)
    box = section.bounds() if fence is None else tuple(shapely.bounds(fence).tolist())
    if box is None:
        return None
    if fence is None:
        pad = parameters.padding
        box = (box[0] - pad, box[1] - pad, box[2] + pad, box[3] + pad)
    elif section.count and not shapely.box(*(section.bounds() or box)).intersects(fence):
        notes.warn(f"all obstacles of level {level} are outside the fence; none is drawn", where=level)
    frame = grid_frame(box, parameters.resolution, notes)
    cells = empty_cells(frame, fence, site.free)
    section.draw(cells, frame, low, high)
    if fence is None and not site.free and not parameters.outside_free:
        raster.flood(cells, FREE, UNKNOWN)
        why = "there are neither floors nor a fence"
        notes.fill("ground that no walls enclose", "unknown", why, "outside_free")
    enclosed = bool((cells == FREE).any())
    section.draw_unknown(cells, frame)
    raster.grow(cells, OCCUPIED, parameters.inflate / frame.resolution)
    if not (cells == FREE).any():
        if site.unreadable:
            raise unreadable_error(site.unreadable, f"no free ground of level {level} is known")
        todo = ALL_COVERED if enclosed and section.unknown else ENCLOSE
        notes.warn(f"no cell of level {level} is free: {todo}", where=level)
    return OccupancyGrid(cells, frame.resolution, (*frame.origin, 0.0))


def grid_frame(box: tuple[float, ...], resolution: float | None, notes: DerivationNotes) -> RasterFrame:
    """Return the frame of the grid of a box (min x, min y, max x, max y in metres).

    Raises CannotConvert if it would be too large.
    """
    low_x, low_y, high_x, high_y = box[:4]
    if resolution is not None:
        return raster.check_frame(
            RasterFrame.from_box((low_x, low_y, high_x, high_y), resolution), MAX_CELLS, MAX_SIDE_CELLS
        )
    frame = RasterFrame.from_box((low_x, low_y, high_x, high_y), RESOLUTIONS[0])
    for coarser in RESOLUTIONS:
        frame = RasterFrame.from_box((low_x, low_y, high_x, high_y), coarser)
        if frame.cells <= DEFAULT_MAX_CELLS and max(frame.width, frame.height) <= MAX_SIDE_CELLS:
            break
    if frame.resolution != RESOLUTION:
        side = f"{high_x - low_x:.0f} × {high_y - low_y:.0f} m"
        notes.fill("resolution", frame.resolution, f"{RESOLUTION} m would be too many cells for {side}")
    return raster.check_frame(frame, MAX_CELLS, MAX_SIDE_CELLS)


def empty_cells(frame: RasterFrame, fence: Any, free: list[Any]) -> NDArray[np.uint8]:
    """Return cells, uint8 [height, width]: free on the floors, else within the fence, else unknown."""
    cells = np.full((frame.height, frame.width), FREE if fence is None and not free else UNKNOWN, np.uint8)
    inside = free
    if fence is not None:
        inside = [shapely.intersection(fence, ground) for ground in free] if free else [fence]
    raster.paint(cells, raster.areas([g for g in inside if g.area > 0], frame, touched=False), FREE)
    return cells

"""Objects -> occupancy: a world, a building or a town as the grid that a robot's laser would see, or a whole robot."""

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
    "floors, or ask with outside_free=true where robots may drive all around"
)
"""What to do where no ground is known to be free."""

ALL_COVERED = (
    "all of it is occupied or near objects of unknown extent; upload the files of their models, or ask with a smaller "
    "unknown_radius"
)
"""What to do where no ground is left."""

HEIGHT = 0.2
"""Metres above the floor at which a slice is taken unless asked otherwise: a usual height of a robot's laser."""

RESOLUTION = 0.05
"""Metres a cell unless asked otherwise."""

RESOLUTIONS = (RESOLUTION, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
"""What is taken where a finer one would give a grid that no robot loads."""

DEFAULT_MAX_CELLS = 2**25
"""Cells up to which the usual resolution is kept."""

MAX_CELLS = 2**29
"""Cells of a grid whatever was asked for: a byte each, and twice that while it is made."""

MAX_SIDE_CELLS = 32767
"""Cells along a side: beyond it Nav2's map_server refuses the map."""


def cell_size() -> Any:
    """The parameter ``resolution`` of the grids that are drawn."""
    text = f"metres a cell; default: {RESOLUTION}, or as much coarser as keeps a grid below 2^25 cells"
    return parameter(None, text, minimum=1e-3, maximum=100.0, unit="m")


@dataclass(frozen=True, slots=True)
class Parameters:
    """At which height, how fine, and how much is added around."""

    height: float | None = parameter(
        None,
        f"a slice at this height above the level's floor; default: {HEIGHT}, as a laser sees",
        minimum=-1e4,
        maximum=1e4,
        unit="m",
    )
    band: tuple[float, float] | None = parameter(
        None,
        "low,high: all that stands between two heights above the level's floor, instead of a slice",
        minimum=-1e4,
        maximum=1e4,
        unit="m",
    )
    resolution: float | None = cell_size()
    inflate: float = parameter(0.0, "how far obstacles are grown", minimum=0.0, maximum=100.0, unit="m")
    padding: float = parameter(
        1.0, "margin around everything, where no fence says how far the site reaches", minimum=0.0, maximum=1000.0
    )
    outside_free: bool = parameter(
        False, "whether ground that neither floor, fence nor closed walls surround is free, too, and not unknown"
    )
    surroundings: float = parameter(
        DEFAULT_SURROUNDINGS_METRES,
        "radius of unknown ground around a solid that cannot be read (a mesh that was not uploaded)",
        minimum=0.0,
        maximum=1000.0,
        unit="m",
    )
    unknown_radius: float = parameter(
        UNKNOWN_RADIUS_METRES,
        "radius of unknown ground around an object of unknown extent (a model that says neither shapes nor a size, a "
        "table or building that is a point, an invalid pose, an OpenStreetMap area whose rings do not close)",
        minimum=0.0,
        maximum=1000.0,
        unit="m",
    )
    doors: Literal["open", "closed"] = parameter("open", "whether doors let a robot through")
    visuals: bool = parameter(False, "whether shapes that are only seen and collide with nothing count")
    world: str | None = parameter(None, "which of several worlds; default: gazebo…, else the shortest name")


@derives(
    gives="occupancy",
    needs={"objects"},
    also=frozenset({"resources", "location"}),
    parameters=Parameters,
    cost=4.0,
    version=3,
)
def objects_to_occupancy(layers: Layers, parameters: Parameters, notes: DerivationNotes) -> Layers:
    """What stands on the ground at a height, as an occupancy grid for each level.

    Solids are cut, footprints rasterised; every cell that an obstacle touches is occupied. Free: the floors where there
    are any, else the fence, else what obstacles enclose; elsewhere unknown, as is the ground around solids that cannot
    be read and objects of unknown extent. The origin is a whole multiple of the resolution, yaw 0. Raises MissingLayer
    where nothing stands in a robot's way, or solids that cannot be read leave nothing known; MissingDatum where the
    objects are places on earth and there is none.
    """
    if parameters.height is not None and parameters.band is not None:
        raise Invalid("height and band exclude each other", [Problem("give height or band", where="band")])
    height = HEIGHT if parameters.height is None else parameters.height
    low, high = parameters.band or (height, height)
    if low > high:
        raise Invalid("band: the low height comes first", [Problem("the low height comes first", where="band")])
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
            raise unreadable_error(unreadable, f"nothing that can be read stands in a robot's way {band}{extra}")
        extra += "".join(
            f"; {one.count} {one.subject}: {one.why}" for one in notes.dropped if one.why != NOT_AN_OBSTACLE
        )
        raise MissingLayer(
            f"no stored object stands in a robot's way {band}{extra}: ask for another height or band, or upload walls, "
            "buildings, barriers, trees or a world with solids"
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
    """A level's grid; None where nothing stands in the way and no floor says what is free."""
    low, high = band
    section = site.cut(low, high)
    if not section.count and (site.unreadable or not site.free):
        return None
    if not section.count:
        rest = " but the ground around objects of unknown extent" if section.unknown else ""
        notes.warn(f"nothing stands in a robot's way on the level {level}: all of its floor is free{rest}", where=level)
    box = section.bounds() if fence is None else tuple(shapely.bounds(fence).tolist())
    if box is None:
        return None
    if fence is None:
        pad = parameters.padding
        box = (box[0] - pad, box[1] - pad, box[2] + pad, box[3] + pad)
    elif section.count and not shapely.box(*(section.bounds() or box)).intersects(fence):
        notes.warn(f"all obstacles of the level {level} lie outside the fence", where=level)
    frame = grid_frame(box, parameters.resolution, notes)
    cells = empty_cells(frame, fence, site.free)
    section.draw(cells, frame, low, high)
    if fence is None and not site.free and not parameters.outside_free:
        raster.flood(cells, FREE, UNKNOWN)
        why = "neither floors nor a fence say how far the site reaches"
        notes.fill("ground that no walls enclose", "unknown", why, "outside_free")
    enclosed = bool((cells == FREE).any())
    section.draw_unknown(cells, frame)
    raster.grow(cells, OCCUPIED, parameters.inflate / frame.resolution)
    if not (cells == FREE).any():
        if site.unreadable:
            raise unreadable_error(site.unreadable, f"no free ground of the level {level} is known")
        todo = ALL_COVERED if enclosed and section.unknown else ENCLOSE
        notes.warn(f"no cell of the level {level} is free: {todo}", where=level)
    return OccupancyGrid(cells, frame.resolution, (*frame.origin, 0.0))


def grid_frame(box: tuple[float, ...], resolution: float | None, notes: DerivationNotes) -> RasterFrame:
    """The grid around a box (min x, min y, max x, max y in metres). CannotConvert where it would be too large."""
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
    """Cells, uint8 [height, width], that are free on the floors, within the fence, or all where there is neither."""
    cells = np.full((frame.height, frame.width), FREE if fence is None and not free else UNKNOWN, np.uint8)
    inside = free
    if fence is not None:
        inside = [shapely.intersection(fence, ground) for ground in free] if free else [fence]
    raster.paint(cells, raster.areas([g for g in inside if g.area > 0], frame, touched=False), FREE)
    return cells

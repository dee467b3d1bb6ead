"""Objects -> voxels: a world, a building or a town as an octree."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from app.derive import DerivationNotes, derives
from app.derive._obstacles import LevelObstacles, sites, unreadable_error
from app.errors import CannotConvert, MissingLayer
from app.model import raster, solids, voxels
from app.model.distinct import distinct
from app.model.frame import GROUND
from app.model.layers import MAP, Layers, PartKey
from app.model.raster import Array, RasterFrame, Spans
from app.model.voxels import HALF, VoxelMap
from app.parameters import parameter

MAX_VOXELS = 2**25
"""Maximum number of occupied voxels (``Limits.voxels``)."""

DEFAULT_MAX_VOXELS = 2**23
"""Maximum number of voxels at the default resolution."""

RESOLUTION = 0.1
"""Default resolution in metres."""

RESOLUTIONS = (RESOLUTION, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
"""Coarser resolutions, used if the default one would give too many voxels."""

CELLS_PER_BLOCK = 2**22
"""Number of cells of spans that are deduplicated at a time."""

OCCUPIED = math.log(0.971 / (1.0 - 0.971))
"""Log-odds of an occupied voxel: OctoMap's upper clamping value, as read from a ``.bt``."""


@dataclass(frozen=True, slots=True)
class Parameters:
    """Parameters of objects_to_voxels."""

    resolution: float | None = parameter(
        None,
        f"edge length of the smallest voxel; default: {RESOLUTION}, or coarser for a large site",
        minimum=1e-3,
        maximum=100.0,
        unit="m",
    )
    filled: bool = parameter(True, "whether the inside of closed solids is occupied, instead of only their surface")
    extrude: float = parameter(2.5, "height of footprints that state none", minimum=0.0, maximum=1000.0, unit="m")
    doors: Literal["open", "closed"] = parameter("open", "whether robots can pass doors")
    visuals: bool = parameter(False, "whether visual shapes without collision count as obstacles")
    world: str | None = parameter(None, "world to use, if there are several; default: gazebo…, else the shortest name")


@derives(  # last: without free space, no grid is derived from them if objects_to_occupancy refuses
    gives="voxels",
    needs={"objects"},
    also=frozenset({"resources"}),
    parameters=Parameters,
    cost=6.0,
    version=4,
    last=True,
)
def objects_to_voxels(layers: Layers, parameters: Parameters, notes: DerivationNotes) -> Layers:
    """Solids and extruded footprints as occupied voxels, all levels in one map, without free space.

    Every voxel that a surface touches is occupied, and with ``filled`` those whose centre is inside. Raises
    MissingLayer if no object has a body, MissingDatum for WGS 84 coordinates without a datum, CannotConvert if the map
    would be too large.
    """
    closed, seen = parameters.doors == "closed", parameters.visuals
    obstacles = sites(layers, notes, doors_closed=closed, visuals=seen, world=parameters.world)
    triangles: list[Array] = []
    guessed = 0
    for level, site in obstacles.items():
        up = np.array([0.0, 0.0, layers.elevation(level)])
        if len(site.triangles):
            triangles += [one + up for one in np.split(site.triangles, np.flatnonzero(np.diff(site.owner)) + 1)]
        pieces, without = _extrude_footprints(site, parameters.extrude)
        triangles += [one + up for one in pieces]
        guessed += without
    if not triangles:
        unreadable = [reason for site in obstacles.values() for reason in site.unreadable]
        if unreadable:
            raise unreadable_error(unreadable, "no stored object is known to have a body")
        raise MissingLayer(
            "no stored object has a body: upload walls, buildings, barriers, trees or a world with solids"
        )
    if guessed:
        notes.fill("height", parameters.extrude, f"{guessed} footprints state no height", "extrude")
    corners = np.concatenate(triangles)
    owner = np.repeat(np.arange(len(triangles)), [len(one) for one in triangles])
    made_of = _voxels(corners, owner, parameters, notes)
    return Layers({PartKey("voxels", GROUND, MAP): made_of}, layers.datum, layers.levels)


def _extrude_footprints(site: LevelObstacles, otherwise: float) -> tuple[list[Array], int]:
    """Convert the footprints to closed solids; also return how many used the default height."""
    out, without = [], 0
    for footprint, base, top in zip(site.footprints, site.base, site.top, strict=True):
        if not math.isfinite(base):
            continue  # a hole
        without += not math.isfinite(top)
        high = top if math.isfinite(top) else base + otherwise
        if high > base:
            triangles = solids.extrude(shapely.make_valid(footprint), base, high)
            if len(triangles):
                out.append(triangles)
    return out, without


def _estimate_voxels(corners: Array, owner: NDArray[np.int64], resolution: float, *, filled: bool) -> float:
    """Estimate the number of voxels: volume of the solids, and one voxel per square of their surface."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normal = np.cross(b - a, c - a)
    area = float(np.linalg.norm(normal, axis=1).sum()) / 2
    middle = corners.reshape(-1, 3).mean(
        axis=0
    )  # relative to the objects, so that sums of large numbers keep their precision
    volume = np.abs(np.bincount(owner, np.einsum("ij,ij->i", a - middle, normal) / 6)).sum() if filled else 0.0
    return area / resolution**2 + float(volume) / resolution**3


def _voxels(corners: Array, owner: NDArray[np.int64], parameters: Parameters, notes: DerivationNotes) -> VoxelMap:
    flat = corners.reshape(-1, 3)
    low, high = flat.min(axis=0).tolist(), flat.max(axis=0).tolist()
    edge = parameters.resolution or next(
        (
            r
            for r in RESOLUTIONS
            if _fits(low, high, r)
            and _estimate_voxels(corners, owner, r, filled=parameters.filled) <= DEFAULT_MAX_VOXELS
        ),
        RESOLUTIONS[-1],
    )
    if parameters.resolution is None and edge != RESOLUTION:
        notes.fill("resolution", edge, f"{RESOLUTION} m would be too many voxels")
    if not _fits(low, high, edge):
        needed = max(map(abs, (*low, *high))) / (HALF - 1)
        raise CannotConvert(
            f"objects are farther from the origin than {HALF * edge:g} m, the range of an octree at {edge:g} m: set a "
            f"resolution of at least {needed:.3g} m, or a datum nearer to them"
        )
    if _estimate_voxels(corners, owner, edge, filled=parameters.filled) > 4 * MAX_VOXELS:
        _raise_too_many(edge)
    frame = RasterFrame.from_box((low[0], low[1], high[0], high[1]), edge)
    first = math.floor(low[2] / edge + 1e-6)
    end = max(math.ceil(high[2] / edge - 1e-6), first + 1)
    levels = np.round(np.arange(first, end + 1) * edge, 9)
    codes = _codes(raster.surfaces(corners, frame, np.column_stack([levels[:-1], levels[1:]])), frame, first)
    if parameters.filled:
        inside = _codes(raster.insides(corners, owner, frame, (levels[:-1] + levels[1:]) / 2), frame, first)
        codes = distinct(np.concatenate([codes, inside]))
    if not len(codes):
        raise MissingLayer("no stored object has a body with an extent: upload walls, buildings or a world with solids")
    depth = np.full(len(codes), voxels.DEPTH, np.uint8)
    return voxels.prune(VoxelMap(edge, depth, codes, np.full(len(codes), OCCUPIED, np.float32)))


def _fits(low: Sequence[float], high: Sequence[float], edge: float) -> bool:
    return bool(max(map(abs, (*low, *high))) / edge <= HALF - 1)


def _codes(spans: Iterable[Spans], frame: RasterFrame, first: int) -> voxels.Codes:
    """Return the distinct Morton codes of all cells of spans, ascending."""
    x0, y0 = (round(v / frame.resolution) for v in frame.origin)
    out = np.empty(0, np.uint64)
    waiting: list[voxels.Codes] = []
    size = 0
    for part in spans:
        portion = np.cumsum(part[:, 3] - part[:, 2]) // CELLS_PER_BLOCK
        for some in np.split(part, np.flatnonzero(np.diff(portion)) + 1):
            layer, row, column = raster.expand_spans(some)
            waiting.append(distinct(voxels.morton(column + x0, row + y0, layer + first)))
            size += len(waiting[-1])
            if size > MAX_VOXELS:
                out, waiting, size = distinct(np.concatenate([out, *waiting])), [], 0
                if len(out) > MAX_VOXELS:
                    _raise_too_many(frame.resolution)
    out = distinct(np.concatenate([out, *waiting]))
    if len(out) > MAX_VOXELS:
        _raise_too_many(frame.resolution)
    return out


def _raise_too_many(resolution: float) -> None:
    raise CannotConvert(
        f"there would be more than {MAX_VOXELS} voxels of {resolution:g} m: use a coarser resolution, or filled=false"
    )

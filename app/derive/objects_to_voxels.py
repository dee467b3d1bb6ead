"""Objects -> voxels: a world, a building or a town as an octree."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import shapely
from numpy.typing import NDArray

from app.derive import Notes, _raster, derives
from app.derive._obstacles import Site, sites
from app.derive._raster import Array, Frame, Spans
from app.errors import CannotConvert, MissingLayer
from app.model import solids, voxels
from app.model.frame import GROUND
from app.model.layers import MAP, Layers, PartKey
from app.model.voxels import HALF, VoxelMap
from app.parameters import parameter

MOST = 2**25
"""Occupied voxels (``Limits.voxels``)."""

OCCUPIED = math.log(0.971 / (1.0 - 0.971))
"""Log-odds of an occupied voxel: OctoMap's upper clamping value, as a ``.bt`` is read."""


@dataclass(frozen=True, slots=True)
class Parameters:
    """How fine, and what of a solid."""

    resolution: float = parameter(0.1, "metres an edge of the smallest voxel", minimum=1e-3, maximum=100.0, unit="m")
    filled: bool = parameter(True, "whether the inside of closed solids is occupied, or only their surface")
    extrude: float = parameter(2.5, "how high footprints are that do not say it", minimum=0.0, maximum=1000.0, unit="m")
    doors: Literal["open", "closed"] = parameter("open", "whether doors let a robot through")
    visuals: bool = parameter(False, "whether shapes that are only seen and collide with nothing count")


@derives(gives="voxels", needs={"objects"}, also=frozenset({"resources"}), parameters=Parameters, cost=6.0)
def objects_to_voxels(layers: Layers, parameters: Parameters, notes: Notes) -> Layers:
    """Solids and extruded footprints as occupied voxels, all levels in one map; nothing is said of free space.

    Every voxel that a surface touches is occupied, and with ``filled`` those whose middle lies inside. Raises
    MissingLayer where nothing has a body, MissingDatum where the objects are places on earth and there is none,
    CannotConvert where the map would be too large.
    """
    known = sites(layers, notes, doors_closed=parameters.doors == "closed", visuals=parameters.visuals)
    triangles: list[Array] = []
    guessed = 0
    for level, site in known.items():
        up = np.array([0.0, 0.0, layers.elevation(level)])
        if len(site.triangles):
            triangles += [one + up for one in np.split(site.triangles, np.flatnonzero(np.diff(site.owner)) + 1)]
        made, without = _extruded(site, parameters.extrude)
        triangles += [one + up for one in made]
        guessed += without
    if not triangles:
        raise MissingLayer(
            "no stored object has a body: upload walls, buildings, barriers, trees or a world with solids"
        )
    if guessed:
        notes.fill("height", parameters.extrude, f"{guessed} footprints do not say how high they are")
    corners = np.concatenate(triangles)
    owner = np.repeat(np.arange(len(triangles)), [len(one) for one in triangles])
    made_of = _voxels(corners, owner, parameters)
    return Layers({PartKey("voxels", GROUND, MAP): made_of}, layers.datum, layers.levels)


def _extruded(site: Site, otherwise: float) -> tuple[list[Array], int]:
    """The footprints as closed solids, and how many of them took the height from the parameter."""
    out, without = [], 0
    for footprint, base, top in zip(site.footprints, site.base, site.top, strict=True):
        if not math.isfinite(base):
            continue  # a hole
        without += not math.isfinite(top)
        high = top if math.isfinite(top) else base + otherwise
        if high > base:
            made = solids.extruded(shapely.make_valid(footprint), base, high)
            if len(made):
                out.append(made)
    return out, without


def _voxels(
    corners: Array,
    owner: NDArray[np.int64],
    parameters: Parameters,
) -> VoxelMap:
    edge = parameters.resolution
    flat = corners.reshape(-1, 3)
    low, high = flat.min(axis=0).tolist(), flat.max(axis=0).tolist()
    if max(map(abs, (*low, *high))) / edge > HALF - 1:
        needed = max(map(abs, (*low, *high))) / (HALF - 1)
        raise CannotConvert(
            f"an octree reaches {HALF * edge:g} m to each side at {edge:g} m, and the objects lie further from the "
            f"origin: ask for a resolution of at least {needed:.3g} m, or set a datum nearer to them"
        )
    frame = Frame.around((low[0], low[1], high[0], high[1]), edge)
    first = math.floor(low[2] / edge + 1e-6)
    end = max(math.ceil(high[2] / edge - 1e-6), first + 1)
    levels = np.round(np.arange(first, end + 1) * edge, 9)
    codes = _codes(_raster.surfaces(corners, frame, np.column_stack([levels[:-1], levels[1:]])), frame, first)
    if parameters.filled:
        inside = _codes(_raster.insides(corners, owner, frame, (levels[:-1] + levels[1:]) / 2), frame, first)
        codes = _distinct(np.concatenate([codes, inside]))
    if not len(codes):
        raise MissingLayer("no stored object has a body of any extent")
    depth = np.full(len(codes), voxels.DEPTH, np.uint8)
    return voxels.pruned(VoxelMap(edge, depth, codes, np.full(len(codes), OCCUPIED, np.float32)))


def _codes(spans: Iterable[Spans], frame: Frame, first: int) -> voxels.Codes:
    """The Morton codes of all cells of spans, each once, ascending."""
    x0, y0 = (round(v / frame.resolution) for v in frame.origin)
    out = np.empty(0, np.uint64)
    waiting: list[voxels.Codes] = []
    size = 0
    for part in spans:
        cells = int((part[:, 3] - part[:, 2]).sum())
        if cells > 4 * MOST:
            _too_many(frame)
        layer, row, column = _raster.expanded(part)
        waiting.append(_distinct(voxels.morton(column + x0, row + y0, layer + first)))
        size += len(waiting[-1])
        if size > MOST:
            out, waiting, size = _distinct(np.concatenate([out, *waiting])), [], 0
            if len(out) > MOST:
                _too_many(frame)
    out = _distinct(np.concatenate([out, *waiting]))
    if len(out) > MOST:
        _too_many(frame)
    return out


def _distinct(codes: voxels.Codes) -> voxels.Codes:
    """Each code once, ascending. By sorting: numpy.unique hashes, and Morton codes all meet in few of its buckets."""
    ordered = np.sort(codes)
    new = np.ones(len(ordered), bool)
    np.not_equal(ordered[1:], ordered[:-1], out=new[1:])
    return ordered[new]


def _too_many(frame: Frame) -> None:
    raise CannotConvert(
        f"voxels of {frame.resolution:g} m would be more than {MOST}: ask for a coarser resolution, or filled=false"
    )

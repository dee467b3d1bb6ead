"""Choose and run the segmentation method for imagery_to_objects and imagery_to_occupancy."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
from numpy.typing import NDArray

from app.derive import DerivationNotes, _model, _plans
from app.derive._colour import segments
from app.derive._pictures import GroundImage, infrared_band
from app.derive._segments import METHOD_PARAMETERS, MIN_CONFIDENCE, Segmentation, Segments, doubt
from app.errors import Invalid, Problem
from app.model.geodesy import LocalFrame
from app.model.grid import OCCUPIED, UNKNOWN, OccupancyGrid
from app.model.imagery import LOCAL, GeoImage, display_pixels
from app.model.resampling import resample

THUMB = 2**20
"""Maximum number of pixels of the thumbnail that decides whether an image is a floor plan."""


def choose_method(picture: GeoImage, how: Segmentation) -> str:
    """Return the segmentation method; ``auto`` is decided from the image.

    Raises Invalid for parameters of another method.
    """
    method: str = how.segmentation
    if method == "auto":
        step = max(1, round((picture.pixels.shape[0] * picture.pixels.shape[1] / THUMB) ** 0.5))
        few = GeoImage(picture.pixels[::step, ::step].copy(), picture.transform, picture.crs, picture.properties)
        shown = display_pixels(few)
        bands = shown.shape[2]
        valid = shown[..., -1] >= 128 if bands in (2, 4) else shown[..., 0] >= 0
        method = "plan" if _plans.looks_like_plan(shown[..., : 1 if bands < 3 else 3], valid) else "colour"
        if how.near_infrared is not None:
            method = "index"
    changed = [f.name for f in fields(how) if getattr(how, f.name) != f.default]
    wrong = [n for n in changed if method not in METHOD_PARAMETERS.get(n, (method,))]
    if wrong:
        problems = [
            Problem(f"applies only to segmentation={' or '.join(METHOD_PARAMETERS[n])}, not to {method}", where=n)
            for n in wrong
        ]
        raise Invalid("; ".join(f"{p.where}: {p.problem}" for p in problems), problems)
    return method


def segment_picture(
    on: GroundImage, picture: GeoImage, how: Segmentation, method: str, notes: DerivationNotes, name: str
) -> Segments:
    """Segment an image by the chosen method."""
    if method == "model":
        if not how.model:
            raise Invalid(
                "model is missing: name a model",
                [Problem("missing: segmentation=model needs the name of a model", where="model")],
            )
        return _model.segments(on, how, notes, name)
    nir = infrared_band(picture, how.near_infrared, name)
    out = segments(on, how, method, nir, notes, name)
    doubt(out, MIN_CONFIDENCE if how.confidence is None else how.confidence)
    _report_unknown(out, on, notes, name)
    return out


def _report_unknown(out: Segments, on: GroundImage, notes: DerivationNotes, name: str) -> None:
    """Warn of the share of an image that is unknown."""
    is_area = np.array([False, *(region.kind == "area" for region in out.regions)])
    unknown = on.valid & (((out.label == 0) & ~out.open_) | is_area[out.label])
    share = float(unknown.sum()) / float(on.valid.sum())
    if share > 0:
        notes.warn(f"{share:.0%} of {name} is unknown: colour and shape do not tell what is there")


def plan_to_grid(
    picture: GeoImage, frame: LocalFrame | None, how: Segmentation, notes: DerivationNotes, name: str
) -> tuple[OccupancyGrid, NDArray[np.float32]]:
    """Convert a floor plan to a grid, and the probability of each cell that it is a wall, float32 [rows, columns].

    Walls below ``confidence`` are unknown.
    """
    upright = picture if picture.crs == LOCAL else resample(picture, frame, crs=LOCAL)
    speck = 0.05 if how.minimum_area is None else how.minimum_area
    options = _plans.FloorPlanOptions(how.gap, speck, how.resolution, how.outside_free)
    grid, sure = _plans.plan_to_grid(upright, options, notes, name)
    least = MIN_CONFIDENCE if how.confidence is None else how.confidence
    walls = grid.cells == OCCUPIED
    doubtful = walls & (sure < np.float32(least))
    if doubtful.any():
        share = float(doubtful.sum()) / float(walls.sum())
        notes.warn(f"{share:.0%} of the walls of {name} are less sure than confidence={least:g}: unknown")
        grid = replace(grid, cells=np.where(doubtful, np.uint8(UNKNOWN), grid.cells))
    return grid, sure

"""Segmented images: parameters, kinds of regions, and the result of every segmentation method."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from app.model.grid import FREE, UNKNOWN
from app.parameters import parameter

Kind = Literal["field", "tree", "vegetation", "water", "path", "road", "building", "area"]
KINDS: tuple[str, ...] = get_args(Kind)
"""Kinds of regions; an ``area`` is a separate region of unknown kind."""


@dataclass(frozen=True, slots=True)
class Segmentation:
    """Parameters of image segmentation."""

    segmentation: Literal["auto", "colour", "index", "plan", "model"] = parameter(
        "auto",
        "segmentation method; colour: groups of similar colour, then shape; index: vegetation by excess green, or NDVI "
        "with a near-infrared band; plan: dark walls on bright paper; model: the model named by model=; auto: plan for "
        "images that look like one, else colour",
    )
    picture: str | None = parameter(None, "name of the image; default: satellite, else the only one on a level")
    resolution: float | None = parameter(
        None,
        "size of a pixel or cell; default: the image's, rounded up and at least 0.05, or coarser for a large image",
        minimum=1e-3,
        maximum=100.0,
        unit="m",
    )
    model: str | None = parameter(
        None,
        "model: name of the operator's ONNX model: YOLO or Segment-Anything family, or one that classifies pixels",
    )
    confidence: float | None = parameter(
        None,
        "minimum confidence of a region or wall; what is less sure is unknown (a region: kind area, with its guess). "
        "Default: 0.5, for models of the YOLO family 0.25, for Segment-Anything (its predicted IoU) 0.88",
        minimum=0.01,
        maximum=1.0,
    )
    points: int | None = parameter(
        None, "model, Segment-Anything: number of prompt points along a tile; default: 16", minimum=1, maximum=64
    )
    stability: float | None = parameter(
        None,
        "model, Segment-Anything: minimum intersection over union of a mask with itself at another threshold; default: "
        "0.95",
        minimum=0.0,
        maximum=1.0,
    )
    clusters: int = parameter(8, "colour: number of groups of similar colour", minimum=2, maximum=32)
    cluster_seed: int = parameter(0, "colour: seed of the initial groups", minimum=0, maximum=2**31 - 1)
    near_infrared: int | None = parameter(
        None,
        "index: number of the near-infrared band, from 1; default: the one described as such",
        minimum=1,
        maximum=999,
    )
    minimum_area: float | None = parameter(
        None, "minimum area of a region; default: 1 m², for ink of a plan 0.05 m²", minimum=0.0, maximum=1e6, unit="m²"
    )
    gap: float = parameter(
        1.2, "plan: maximum width of openings in the walls of a room", minimum=0.0, maximum=20.0, unit="m"
    )
    outside_free: bool = parameter(False, "plan: whether ground that no wall encloses is free instead of unknown")


METHOD_PARAMETERS = {
    "model": ("model",),
    "points": ("model",),
    "stability": ("model",),
    "clusters": ("colour",),
    "cluster_seed": ("colour",),
    "near_infrared": ("index",),
    "gap": ("plan",),
    "outside_free": ("plan",),
}
"""Parameters that apply to some methods only."""


@dataclass(slots=True)
class Region:
    """Segmented region. confidence: 0 to 1, how sure its kind is. attributes: further properties."""

    kind: Kind
    confidence: float
    attributes: dict[str, Any] = field(default_factory=dict)


@dataclass(slots=True)
class Segments:
    """Segmented image.

    Attributes:
        label: int32 [h, w], 0 nothing, k the region k - 1.
        regions: in the order of their labels.
        open_: bool [h, w], pixels of no region that are surely no obstacle.
    """

    label: NDArray[np.int32]
    regions: list[Region]
    open_: NDArray[np.bool_]


MIN_CONFIDENCE = 0.5
"""Default minimum confidence of a region that was segmented by colour or vegetation index."""


def doubt(segmented: Segments, sure: float) -> None:
    """Turn regions that are less sure into areas of unknown kind, with their kind as ``guess``."""
    for region in segmented.regions:
        if region.confidence < sure and region.kind != "area":
            region.attributes["guess"] = region.kind
            region.kind = "area"


OBSTACLES = frozenset({"tree", "vegetation", "building", "water"})
"""Kinds of regions that block robots."""


def probability_cells(segmented: Segments) -> NDArray[np.uint8]:
    """Return the probability in percent that each pixel is occupied: uint8 [h, w]; 255 where nothing is guessed.

    A region that is an obstacle with confidence c counts c, other ground 1 - c.
    """
    values = [UNKNOWN]
    for region in segmented.regions:
        kind = region.attributes.get("guess", region.kind)
        chance = region.confidence if kind in OBSTACLES else 1.0 - region.confidence
        values.append(UNKNOWN if kind == "area" else round(100 * chance))
    cells = np.array(values, np.uint8)[segmented.label]
    cells[segmented.open_ & (segmented.label == 0)] = FREE
    return cells

"""Imagery -> objects: parallel rows of trees, vines or crops in an aerial image, with their headlands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import shapely
from numpy.typing import NDArray

from app.derive import DerivationNotes, derives
from app.derive._pictures import GroundImage, ground, picture_label, select_pictures
from app.derive._row_features import ROWS, fields_of, row_items
from app.model.features import features
from app.model.layers import Layers, Part, PartKey
from app.parameters import parameter

SURROUNDINGS = 6.0
"""Side in metres of the surroundings from which plants differ: several rows wide."""

DARKER, GREENER = 4.0, 0.03
"""Minimum difference from the surroundings in CIELAB lightness and in excess green."""


@dataclass(frozen=True, slots=True)
class Parameters:
    """Parameters of imagery_to_rows."""

    picture: str | None = parameter(None, "name of the image; default: satellite, else the only one on a level")
    resolution: float | None = parameter(
        None,
        "size of a pixel or cell; default: the image's, rounded up and at least 0.05, or coarser for a large image",
        minimum=1e-3,
        maximum=100.0,
        unit="m",
    )
    headland_depth: float = parameter(
        4.5, "depth of the headlands at the ends of rows", minimum=0.5, maximum=50.0, unit="m"
    )


@derives(gives="objects", needs={"imagery"}, parameters=Parameters, cost=60.0, version=3)
def imagery_to_rows(layers: Layers, parameters: Parameters, notes: DerivationNotes) -> Layers:
    """Rows in an aerial image: lines of kind ``row`` with their distance and direction, and headlands.

    Plants are greener, darker or brighter than their surroundings; whichever gives the clearest rows counts.
    ``rows_to_topology`` makes a network of the aisles. A row's ``confidence`` is 0 to 1. Raises CannotConvert if there
    are none.
    """
    parts: dict[PartKey, Part] = {}
    for key, picture in select_pictures(layers, parameters.picture).items():
        name = picture_label(key)
        on = ground(picture, layers.frame, parameters.resolution, notes, name)
        bottom = on.top - on.resolution * on.valid.shape[0]
        fields = fields_of([mask[::-1] for mask in _masks(on)], on.resolution, (on.left, bottom, 0.0), notes, name)
        rows = row_items(fields, parameters.headland_depth)
        if on.on_earth and on.frame is not None:
            back = on.frame.geometries_to_wgs84(np.array([g for _, g, _ in rows], object))
            back = shapely.set_precision(back, 1e-12, mode="pointwise")
            rows = [(i, g, properties) for (i, _, properties), g in zip(rows, back, strict=True)]
        notes.warn("rows were detected automatically in an image: review them before robots use them", where=key.name)
        parts[PartKey("objects", key.level, ROWS)] = features(rows, "wgs84" if on.on_earth else "local")
    return Layers(parts, layers.datum, layers.levels)


def _masks(on: GroundImage) -> list[NDArray[np.bool_]]:
    """Return pixels that are greener, darker and brighter than their surroundings, and not of wide ground that is so.

    At the edge of a meadow, its pixels differ from the mean of their surroundings as plants do. The white top-hat
    transform leaves what is narrower than the surroundings, and nothing of the meadow (Meyer 1979).
    """
    import cv2

    rgb = cv2.GaussianBlur(on.rgb, (3, 3), 0).astype(np.float32)
    green = (2 * rgb[..., 1] - rgb[..., 0] - rgb[..., 2]) / np.maximum(rgb.sum(axis=2), np.float32(1))
    light = cv2.cvtColor(rgb / np.float32(255), cv2.COLOR_RGB2LAB)[..., 0]
    side = max(3, int(SURROUNDINGS / on.resolution) // 2 * 2 + 1)
    out = []
    for plane, least in ((green, GREENER), (-light, DARKER), (light, DARKER)):
        values = np.where(on.valid, plane, np.float32(0)).astype(np.float32)
        share = np.maximum(cv2.blur(on.valid.astype(np.float32), (side, side)), np.float32(1e-6))
        narrow = values - cv2.morphologyEx(values, cv2.MORPH_OPEN, np.ones((side, side), np.uint8))
        above = plane > cv2.blur(values, (side, side)) / share + least
        out.append(np.asarray(on.valid & above & (narrow > least)))
    return out

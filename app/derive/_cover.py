"""Evidence of each pixel of an aerial image: colour without cast, roughness, shadow, water."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.derive._pictures import GroundImage

Plane = NDArray[np.float32]

WINDOW, WINDOW_PIXELS = 1.5, 5
"""Window in metres over which roughness is averaged, and its minimum in pixels."""

BRIGHT = (85.0, 99.5)
"""Percentiles of lightness between which pixels are taken for grey."""

COLOURFUL = 25.0
"""Minimum chroma of bright pixels that have a colour of their own, and show no colour cast."""

OVERSAMPLED = 0.2
"""Share of the detail at four times the pixel size below which an image has no detail of its own at that size."""

MAX_BLUR = 16
"""Maximum ratio of the size of an image's details to its pixels."""

SHADE = 0.45
"""Share of the median lightness below which a pixel is in the shade."""

ROUGH = 2.5
"""Minimum roughness of wood."""

LEAF, LEAF_SLOPE, LEAF_LIGHT = 2.0, 0.4, 60.0
"""Minimum greenness (-a*) of leaves, minimum ratio of b* to it, and maximum lightness."""

WET, WET_NDVI = 0.05, 0.1
"""Minimum NDWI and maximum NDVI of water."""

STILL, DIM, COLD = 0.8, 50.0, 2.0
"""Maximum roughness, lightness, and a* and b* of water that is recognised by colour."""

RED = 10.0
"""Minimum a* of what is too red for water, such as tiles, which have a high NDWI."""

LAKE = 400.0
"""Minimum area of water that is recognised by colour, in square metres: shadows are smaller."""


@dataclass(frozen=True, slots=True, eq=False)
class Cover:
    """Evidence of the pixels of an image.

    Attributes:
        lab: float32 [h, w, 3], CIELAB without noise and colour cast.
        light: float32 [h, w], lightness of the image itself.
        rough: float32 [h, w], mean difference of lightness from its median within 5 pixels, at the size of the image's
            details. A median follows edges, so a smooth tree on smooth turf has no roughness.
        shade: bool [h, w], much darker than the image.
        contrast: float32 [h, w], difference of colour (CIELAB) across the pixel, over a few of the image's details.
        window: side of the roughness's window in pixels, odd.
    """

    lab: Plane
    light: Plane
    rough: Plane
    shade: NDArray[np.bool_]
    contrast: Plane
    window: int


def cover(ground: GroundImage) -> Cover:
    """Compute the evidence of the pixels of an image."""
    import cv2

    smooth = cv2.bilateralFilter(ground.rgb, 5, 25.0, 2.0)
    lab = np.asarray(cv2.cvtColor(smooth.astype(np.float32) / np.float32(255), cv2.COLOR_RGB2LAB), np.float32)
    del smooth
    converted = cv2.cvtColor(ground.rgb.astype(np.float32) / np.float32(255), cv2.COLOR_RGB2LAB)
    light = np.ascontiguousarray(converted[..., 0], np.float32)
    del converted
    lab[..., 1:] -= _cast(lab, ground.valid)
    window = max(WINDOW_PIXELS, int(WINDOW / ground.resolution) // 2 * 2 + 1)
    median = float(np.median(light[ground.valid]))
    step = _blur(light)
    return Cover(lab, light, _roughness(light, window, step), light < SHADE * median, _contrast(lab, step), window)


def _contrast(lab: Plane, step: int) -> Plane:
    """Return the largest difference of a channel's mean within a few details of the image. step: their size."""
    import cv2

    out = np.zeros(lab.shape[:2], np.float32)
    side = 2 * step + 1
    kernel = np.ones((2 * side + 1, 2 * side + 1), np.uint8)
    for k in range(3):
        mean = cv2.blur(np.ascontiguousarray(lab[..., k]), (side, side))
        np.maximum(out, cv2.dilate(mean, kernel) - cv2.erode(mean, kernel), out=out)
    return out


def _cast(lab: Plane, valid: NDArray[np.bool_]) -> Plane:
    """Return a* and b* of grey: the colour of the bright pixels, if they have none of their own."""
    light = lab[..., 0][valid]
    low, high = np.percentile(light[:: max(1, len(light) // 2**16)], BRIGHT)
    bright = valid & (lab[..., 0] >= low) & (lab[..., 0] <= high)
    grey = np.median(lab[bright][:, 1:], axis=0) if bright.any() else np.zeros(2)
    if float(np.hypot(*grey)) > COLOURFUL:
        return np.zeros(2, np.float32)
    return np.asarray(np.round(grey, 1), np.float32)


def _roughness(light: Plane, window: int, step: int) -> Plane:
    """Return the roughness at the size of the image's details: an enlarged image has none at that of its pixels."""
    import cv2

    if step == 1:
        return np.asarray(cv2.blur(np.abs(light - cv2.medianBlur(light, 5)), (window, window)), np.float32)
    height, width = light.shape
    small = cv2.resize(light, (max(1, width // step), max(1, height // step)), interpolation=cv2.INTER_AREA)
    side = max(WINDOW_PIXELS, window // step // 2 * 2 + 1)
    rough = cv2.blur(np.abs(small - cv2.medianBlur(small, 5)), (side, side))
    return np.asarray(cv2.resize(rough, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)


def _blur(light: Plane) -> int:
    """Return the size of an image's details in pixels: 1, 2, 4 …"""
    import cv2

    height, width = light.shape

    def detail(step: int) -> float:
        small = cv2.resize(light, (width // step, height // step), interpolation=cv2.INTER_AREA)
        back = cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR)
        return float(np.abs(light - back).mean())

    step = 1
    while step < MAX_BLUR and min(height, width) >= 64 * step:
        if detail(2 * step) >= OVERSAMPLED * detail(8 * step):
            break
        step *= 2
    return step


def indices(ground: GroundImage, nir: int) -> tuple[Plane, Plane]:
    """Return NDVI and NDWI of each pixel; 0 where a band is missing or has no usable value."""
    infrared = ground.raw[..., nir].astype(np.float32)
    out = []
    for band, sign in ((0, 1.0), (1, -1.0)):
        if band >= ground.raw.shape[2]:
            out.append(np.zeros(infrared.shape, np.float32))
            continue
        other = ground.raw[..., band].astype(np.float32)
        with np.errstate(over="ignore", invalid="ignore"):  # NaN and infinite values have no index
            total = infrared + other
            index = np.divide(infrared - other, total, out=np.zeros_like(total), where=total > 0)
        out.append(np.clip(np.nan_to_num(index * np.float32(sign), nan=0.0), -1.0, 1.0).astype(np.float32))
    return out[0], out[1]


def crowns(ground: GroundImage, seen: Cover) -> NDArray[np.bool_]:
    """Mark pixels that look like crowns with most of their surroundings: rough, dull green, not bright."""
    import cv2

    a, b = seen.lab[..., 1], seen.lab[..., 2]
    leaf = ground.valid & (a < -LEAF) & (b > -a * LEAF_SLOPE) & (seen.rough > ROUGH) & (seen.lab[..., 0] < LEAF_LIGHT)
    return np.asarray(leaf & (cv2.blur(leaf.astype(np.float32), (seen.window, seen.window)) > 0.5))


def water(ground: GroundImage, seen: Cover, nir: int | None) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Mark (water, what may be water): by NDWI with a near-infrared band, else what is large, dark, smooth and bluish.

    Bright or red pixels with a high NDWI may be muddy water, paint or tiles.
    """
    import cv2

    lab = seen.lab
    if nir is not None:
        ndvi, ndwi = indices(ground, nir)
        wet = ground.valid & (ndwi > WET) & (ndvi < WET_NDVI)
        return wet & (seen.light < DIM) & (lab[..., 1] < RED), wet
    wet = ground.valid & (seen.rough < STILL) & (lab[..., 0] < DIM) & (lab[..., 1] < COLD) & (lab[..., 2] < COLD)
    side = max(3, int(2 * WINDOW / ground.resolution) // 2 * 2 + 1)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))
    wide = cv2.morphologyEx(wet.astype(np.uint8), cv2.MORPH_OPEN, kernel)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(wide, connectivity=4)
    large = stats[:, cv2.CC_STAT_AREA] * ground.resolution**2 >= LAKE
    large[0] = False
    wet = np.asarray(large[labels])
    return wet, wet

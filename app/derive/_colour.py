"""Segment an aerial image into fields, trees, vegetation, water, paths, roads and buildings, without a model.

Pixels are classified by colour, after the image's colour cast is removed (its bright pixels are grey, Land 1977):
k-means in CIELAB groups them (seeded, so that the same image gives the same groups), and the excess green of a group,
(2g - r - b) of colours that sum to 1 (Woebbecke et al. 1995), decides whether it is vegetation. With ``index`` every
pixel is classified by its own excess green, or by NDVI = (nir - red) / (nir + red) if there is a near-infrared band;
then water is where NDWI = (green - nir) / (green + nir) is high (McFeeters 1996). Without one, only large, dark, smooth
and bluish areas are water. Dark or rough vegetation is wood, bright and smooth vegetation is turf. Wood is cut into
crowns at the saddles of its distance to the edge; round ones are trees. Areas of turf are fields, separated at edges
(Canny). Other areas are classified by shape: long and narrow is a path, or a road if it is wide; compact, with straight
edges and of one shade is a building.

Colour does not tell a grey roof from a car park, nor muddy water from bare ground: each region has a confidence, which
falls for what is rough, bluish, of a shape that roofs have, or beside a shadow that it may cast itself. Regions below
``confidence``, shadow and everything else are unknown.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from app.derive import DerivationNotes
from app.derive._cover import ROUGH, cover, crowns, indices, water
from app.derive._pictures import GroundImage
from app.derive._regions import GREEN, SHADOW, RegionBuilder
from app.derive._segments import Segmentation, Segments
from app.errors import CannotConvert

NDVI = 0.2
"""Minimum NDVI of vegetation, whatever Otsu's threshold is; typical of sparse grass."""

SPREAD = 0.03
"""Minimum difference in excess green or NDVI between vegetation and the rest."""

NOISE = 3.0
"""Difference in CIELAB below which two groups have the same colour, and differ by noise only."""

SAMPLE = 2**16
"""Maximum number of pixels from which the groups are computed."""


def segments(
    ground: GroundImage, how: Segmentation, method: str, nir: int | None, notes: DerivationNotes, name: str
) -> Segments:
    """Segment an image by colour or vegetation index. nir: index of the near-infrared band in ``ground.raw``.

    Raises CannotConvert for an image without colours, or with a single one.
    """
    if ground.grey and nir is None and ground.raw.shape[2] >= 3:
        raise CannotConvert(
            f"{name} does not state which of its bands are red, green and blue: tag them (gdal_translate -colorinterp "
            "red,green,blue), or set near_infrared to the number of the near-infrared band"
        )
    if ground.grey and nir is None:
        raise CannotConvert(
            f"{name} has no colours, so vegetation cannot be detected: use a colour image, or segmentation=plan for a "
            "floor plan"
        )
    seen = cover(ground)
    work = RegionBuilder(ground, seen, 1.0 if how.minimum_area is None else how.minimum_area)
    if method == "index":
        grows = _vegetation_by_index(ground, nir, notes, name)
        if nir is not None:
            work.water(water(ground, seen, nir)[0] & ~grows, measured=True)
        work.vegetation(grows, np.zeros_like(grows))
        work.small(notes, name)
        return Segments(work.label, work.regions, work.open_)
    group, centres = _groups(seen.lab, ground.valid, how.clusters, how.cluster_seed)
    if len(centres) < 2:
        raise CannotConvert(f"{name} has a single colour: nothing to segment")
    lake, wet = water(ground, seen, nir)
    if nir is None:
        leafy = crowns(ground, seen) & ~wet
        green = ground.valid & (_greens(centres)[group] | leafy) & ~wet
    else:
        green = ground.valid & (indices(ground, nir)[0] > NDVI)
        leafy = green & (seen.rough > ROUGH)
    shadow = ground.valid & ~green & ~wet & ((centres[:, 0] < SHADOW)[group] | seen.shade)
    work.water(lake, measured=nir is not None)
    work.vegetation(green, leafy)
    for k in range(len(centres)):
        work.add_sealed(ground.valid & (group == k) & ~green & ~wet & ~shadow, measured=nir is not None)
    notes.drop("m² of shadow", round(float(shadow.sum()) * ground.resolution**2), f"{name}: too dark to classify")
    work.small(notes, name)
    return Segments(work.label, work.regions, work.open_)


def _greens(centres: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return which colours [k, 3] in CIELAB are vegetation's."""
    import cv2

    rgb = np.clip(cv2.cvtColor(centres[None], cv2.COLOR_LAB2RGB)[0], 0.0, 1.0)
    total = np.maximum(rgb.sum(axis=1), 1 / 255)
    return np.asarray((2 * rgb[:, 1] - rgb[:, 0] - rgb[:, 2]) / total > GREEN)


def _vegetation_by_index(ground: GroundImage, nir: int | None, notes: DerivationNotes, name: str) -> NDArray[np.bool_]:
    """Mark vegetation by its index."""
    import cv2

    if nir is None:
        rgb = ground.rgb.astype(np.float32)
        total = np.maximum(rgb.sum(axis=2), 1.0)
        index, minimum = (2 * rgb[..., 1] - rgb[..., 0] - rgb[..., 2]) / total, GREEN
    else:
        index, minimum = indices(ground, nir)[0], NDVI
    index = cv2.GaussianBlur(np.where(ground.valid, index, np.float32(0)).astype(np.float32), (3, 3), 0)
    values = index[ground.valid]
    low, high = float(values.min()), float(values.max())
    if high < minimum:
        raise CannotConvert(f"{name}: no vegetation, the vegetation index is at most {high:.2f}")
    threshold = minimum
    if high - low > SPREAD:
        scaled = np.round((values - low) / (high - low) * 255).astype(np.uint8)
        cut, _ = cv2.threshold(scaled.reshape(-1, 1), 0, 255, cv2.THRESH_BINARY + cv2.THRESH_OTSU)
        threshold = max(minimum, low + (cut + 0.5) / 255 * (high - low))
    word = "excess green" if nir is None else "NDVI"
    notes.fill("threshold", round(threshold, 4), f"{name}: pixels with a higher {word} are vegetation")
    return np.asarray(ground.valid & (index > threshold))


def _groups(
    lab: NDArray[np.float32], valid: NDArray[np.bool_], clusters: int, seed: int
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Group pixels by k-means: (group of each pixel, colours [k, 3] of the groups from dark to bright)."""
    import cv2

    places = np.flatnonzero(valid)
    sample = lab.reshape(-1, 3)[places[:: max(1, len(places) // SAMPLE)]].astype(np.float32)
    k = min(clusters, len(np.unique(np.round(sample), axis=0)))
    if k < 2:
        return np.zeros(valid.shape, np.uint8), sample[:1]
    cv2.setRNGSeed(seed)
    stop = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 0.2)
    _, _, centres = cv2.kmeans(sample, k, None, stop, 3, cv2.KMEANS_PP_CENTERS)  # type: ignore[call-overload]
    centres = centres[np.lexsort(centres.T[::-1])]
    out = np.empty(valid.size, np.uint8)
    flat = lab.reshape(-1, 3)
    for start in range(0, len(flat), 2**18):
        away = ((flat[start : start + 2**18, None, :] - centres[None]) ** 2).sum(axis=2)
        out[start : start + 2**18] = away.argmin(axis=1)
    same = _similar(centres)
    kept = np.unique(same)
    return np.searchsorted(kept, same).astype(np.uint8)[out.reshape(valid.shape)], centres[kept]


def _similar(centres: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return for each colour the first one that differs from it by noise only."""
    away = np.sqrt(((centres[:, None] - centres[None]) ** 2).sum(axis=2))
    same = np.arange(len(centres))
    for k in range(1, len(centres)):
        near = np.flatnonzero(away[k, :k] < NOISE)
        if len(near):
            same[k] = same[near[0]]
    return same

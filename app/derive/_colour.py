"""Segment an aerial image into fields, trees, vegetation, paths, roads and buildings, without a model.

Pixels are classified by colour: k-means in CIELAB groups them (seeded, so that the same image gives the same groups),
and the excess green of a group, (2g - r - b) of colours that sum to 1 (Woebbecke et al. 1995), decides whether it is
vegetation. With ``index`` every pixel is classified by its own excess green, or by NDVI = (nir - red) / (nir + red) if
there is a near-infrared band. Dark or rough vegetation is wood, bright and smooth vegetation is turf. Wood is cut into
crowns at the saddles of its distance to the edge; round ones are trees. Large areas of turf or bare ground are fields,
separated at edges (Canny). Other areas are classified by shape: long and narrow is a path, or a road if it is wide;
compact, with straight edges and of one shade is a building. The rest, and shadow, is nothing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from app.derive import DerivationNotes
from app.derive._pictures import GroundImage
from app.derive._regions import GREEN, SHADOW, RegionBuilder
from app.derive._segments import Segmentation, Segments
from app.errors import CannotConvert

NDVI = 0.2
"""Minimum NDVI of vegetation, whatever Otsu's threshold is; typical of sparse grass."""

SPREAD = 0.03
"""Minimum difference in excess green or NDVI between vegetation and the rest."""

SAMPLE = 2**16
"""Maximum number of pixels from which the groups are computed."""


def segments(
    ground: GroundImage, how: Segmentation, method: str, nir: int | None, notes: DerivationNotes, name: str
) -> Segments:
    """Segment an image by colour or vegetation index. nir: index of the near-infrared band in ``ground.raw``.

    Raises CannotConvert for an image without colours, or with a single one.
    """
    import cv2

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
    min_area = 1.0 if how.minimum_area is None else how.minimum_area
    work = RegionBuilder(ground, min_area)
    if method == "index":
        grows = _vegetation_by_index(ground, nir, notes, name)
        work.vegetation(grows)
        rest = ground.valid & ~grows
        work.small(notes, name)
        return Segments(work.label, work.regions, rest | work.open_)
    smooth = cv2.bilateralFilter(ground.rgb, 5, 25.0, 2.0)
    lab = cv2.cvtColor(smooth.astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB)
    group, centres = _groups(np.asarray(lab, np.float32), ground.valid, how.clusters, how.cluster_seed)
    if len(centres) < 2:
        raise CannotConvert(f"{name} has a single colour: nothing to segment")
    of = group[ground.valid]
    sums = np.stack([np.bincount(of, smooth[..., k][ground.valid], len(centres)) for k in range(3)], axis=1)
    means = sums / np.maximum(np.bincount(of, minlength=len(centres)), 1)[:, None]
    green = (2 * means[:, 1] - means[:, 0] - means[:, 2]) / np.maximum(means.sum(axis=1), 1.0) > GREEN
    dark = ~green & (centres[:, 0] < SHADOW)
    grows = ground.valid & green[group]
    work.vegetation(grows)
    for k in np.flatnonzero(~green & ~dark).tolist():
        work.add_sealed(ground.valid & (group == k))
    shadow = ground.valid & dark[group]
    area = ground.resolution**2
    notes.drop("m² of shadow", round(float(shadow.sum()) * area), f"{name}: too dark to classify")
    work.small(notes, name)
    left = (work.label == 0) & ground.valid & ~shadow & ~work.open_
    notes.drop("m² of ground", round(float(left.sum()) * area), f"{name}: shape and colour match no kind")
    return Segments(work.label, work.regions, work.open_)


def _vegetation_by_index(ground: GroundImage, nir: int | None, notes: DerivationNotes, name: str) -> NDArray[np.bool_]:
    """Mark vegetation by its index."""
    import cv2

    if nir is None:
        rgb = ground.rgb.astype(np.float32)
        total = np.maximum(rgb.sum(axis=2), 1.0)
        index, minimum = (2 * rgb[..., 1] - rgb[..., 0] - rgb[..., 2]) / total, GREEN
    else:
        infrared, red = ground.raw[..., nir].astype(np.float64), _red(ground)
        with np.errstate(over="ignore", invalid="ignore"):  # NaN and infinite values are no vegetation
            total = infrared + red
            index = np.divide(infrared - red, total, out=np.zeros(total.shape), where=total > 0)
        index = np.clip(np.nan_to_num(index, nan=0.0), -1.0, 1.0).astype(np.float32)
        minimum = NDVI
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


def _red(ground: GroundImage) -> NDArray[np.float64]:
    """Return the raw red band, in the same unit as near infrared."""
    return np.asarray(ground.raw[..., 0], np.float64)


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
    return out.reshape(valid.shape), centres

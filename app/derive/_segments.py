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

import math
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from app.derive import DerivationNotes
from app.derive._pictures import GroundImage
from app.errors import CannotConvert
from app.parameters import parameter

Kind = Literal["field", "tree", "vegetation", "path", "road", "building", "area"]
KINDS: tuple[str, ...] = get_args(Kind)
"""Kinds of regions; an ``area`` is a separate region of unknown kind."""

Mask = NDArray[np.uint8]

GREEN = 0.06
"""Minimum excess green of a group of pixels that is vegetation."""

NDVI = 0.2
"""Minimum NDVI of vegetation, whatever Otsu's threshold is; typical of sparse grass."""

SPREAD = 0.03
"""Minimum difference in excess green or NDVI between vegetation and the rest."""

DARK, SHADOW = 38.0, 20.0
"""CIELAB lightness (0 to 100) below which vegetation is wood, and below which other pixels are shadow."""

ROUGH = 2.5
"""Minimum roughness of wood: mean difference of lightness from its median within 5 pixels, over ``WINDOW`` metres.

A median follows edges, so a smooth tree on smooth turf has no roughness.
"""

WINDOW = 1.5
CROWNS = (0.8, 20.0)
"""Minimum and maximum diameter of a tree's crown in metres."""

ROUND = 0.75
"""Minimum share of its circle around the same centre that a tree's crown covers."""

LONG = 4.0
"""Minimum ratio of length to width of paths and roads."""

PATH, ROAD = 4.0, 20.0
"""Width in metres above which paths are roads, and maximum width of roads."""

FIELD, TURF = 50.0, 10.0
"""Minimum area of a field of bare ground, and of turf, in square metres."""

BUILDING, SIDE, RECTANGULAR = 8.0, 2.5, 0.78
"""Minimum area in square metres, minimum side in metres, and minimum share of its rectangle, of a building."""

MIXED = 0.25
"""Share of green up to which an area is no vegetation, and share of other pixels up to which it is."""

SAMPLE = 2**16
"""Maximum number of pixels from which the groups are computed."""


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
        "model: minimum confidence of a result; default: 0.25, for Segment-Anything (its predicted IoU) 0.88, for "
        "pixel classes 0.5",
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
    "confidence": ("model",),
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
    """Segmented region. confidence: 0 to 1, how well shape and shade fit its kind. attributes: further properties."""

    kind: Kind
    confidence: float
    attributes: dict[str, Any] = field(default_factory=dict)


@dataclass(slots=True)
class Segments:
    """Segmented image.

    Attributes:
        label: int32 [h, w], 0 nothing, k the region k - 1.
        regions: in the order of their labels.
        open_: bool [h, w], pixels known to be no obstacle that belong to no region.
    """

    label: NDArray[np.int32]
    regions: list[Region]
    open_: NDArray[np.bool_]


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
    work = _RegionBuilder(ground, min_area)
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


class _RegionBuilder:
    """Builder of regions: adds the regions of one image one after the other."""

    def __init__(self, ground: GroundImage, min_area: float) -> None:
        import cv2

        self.size = ground.resolution
        self.minimum_area = max(min_area / self.size**2, 1.0)
        self.height, self.width = (int(n) for n in ground.valid.shape)
        self.label = np.zeros(ground.valid.shape, np.int32)
        self.regions: list[Region] = []
        self.lightness = cv2.cvtColor(ground.rgb.astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB)[..., 0]
        self.few = 0
        self.valid = ground.valid
        self.open_ = np.zeros(ground.valid.shape, bool)

    def pixels(self, metres: float) -> int:
        """Return a length as an odd number of pixels, at least 3."""
        return max(3, int(metres / self.size) // 2 * 2 + 1)

    def small(self, notes: DerivationNotes, name: str) -> None:
        """Note the number of regions that were too small."""
        min_area = self.minimum_area * self.size**2
        notes.drop("small regions", self.few, f"{name}: smaller than minimum_area={min_area:g} m²")

    def add(self, mask: NDArray[np.bool_], at: tuple[slice, slice], region: Region) -> None:
        """Add a region: the mask within a window of the image."""
        self.regions.append(region)
        window = self.label[at]
        window[mask & (window == 0)] = len(self.regions)

    def pieces(self, mask: NDArray[Any]) -> list[tuple[NDArray[np.bool_], tuple[slice, slice], int]]:
        """Yield the connected pieces that are large enough: (mask, window, area in pixels)."""
        import cv2

        count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
        out = []
        for k in range(1, count):
            x, y, w, h, area = (int(v) for v in stats[k])
            if area < self.minimum_area:
                self.few += 1
                continue
            at = (slice(y, y + h), slice(x, x + w))
            out.append((labels[at] == k, at, area))
        return out

    # --- vegetation ---------------------------------------------------------------------------------------------------
    def vegetation(self, grows: NDArray[np.bool_]) -> None:
        """Add the regions of wood and turf."""
        import cv2

        light = self.lightness
        box = (self.pixels(WINDOW), self.pixels(WINDOW))
        rough = cv2.blur(np.abs(light - cv2.medianBlur(light, 5)), box)
        # the roughness of an edge to another area is not the vegetation's own
        within = cv2.erode(grows.astype(np.uint8), np.ones(box, np.uint8)) == 1
        wood = grows & ((cv2.blur(light, (3, 3)) < DARK) | (within & (rough > ROUGH)))
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
        wood = grows & (cv2.morphologyEx(wood.astype(np.uint8), cv2.MORPH_CLOSE, kernel, iterations=2) == 1)
        wood = cv2.morphologyEx(wood.astype(np.uint8), cv2.MORPH_OPEN, kernel) == 1
        for mask, at, _ in self.pieces(wood):
            self._wood(mask, at)
        turf = cv2.morphologyEx((grows & ~wood).astype(np.uint8), cv2.MORPH_OPEN, kernel)
        edges = cv2.Canny(cv2.GaussianBlur(np.clip(light * 2.55, 0, 255).astype(np.uint8), (5, 5), 0), 60, 150)
        parted = turf & (cv2.dilate(edges, kernel) == 0)
        for mask, at, area in self.pieces(parted):
            # restore the pixels that the edge itself took
            high, wide = (slice(max(0, s.start - 2), s.stop + 2) for s in at)
            grown = np.pad(mask, ((at[0].start - high.start, 2), (at[1].start - wide.start, 2)))
            room = turf[high, wide] == 1
            grown = grown[: room.shape[0], : room.shape[1]]
            grown = (cv2.dilate(grown.astype(np.uint8), kernel, iterations=2) == 1) & room
            if self.metres(area) < TURF:
                self.open_[high, wide] |= grown
                continue
            shade = float(light[high, wide][grown].std())
            attributes = {"surface": "green", "area": self.metres(area)}
            self.add(grown, (high, wide), Region("field", _fit(1.0 - shade / 30.0), attributes))

    def metres(self, area: float) -> float:
        """Return pixels as square metres, for attributes."""
        return round(area * self.size**2, 2)

    def _wood(self, mask: NDArray[np.bool_], at: tuple[slice, slice]) -> None:
        """Add a piece of wood: crowns if it splits into round ones, else vegetation."""
        import cv2
        from scipy.ndimage import find_objects

        padded = np.pad(mask, 1).astype(np.uint8)
        away = cv2.distanceTransform(padded, cv2.DIST_L2, cv2.DIST_MASK_5)
        crowns = _watershed(padded, np.asarray(away, np.float32), self.pixels(CROWNS[0]))
        rest = np.zeros(mask.shape, bool)
        crowns = crowns[1:-1, 1:-1]
        for k, inner in enumerate(find_objects(crowns), 1):
            if inner is None:
                continue
            crown = crowns[inner] == k
            size = int(crown.sum())
            round_ = _roundness(crown)
            across = 2 * math.sqrt(size / math.pi) * self.size
            if size >= self.minimum_area and round_ >= ROUND and CROWNS[0] <= across <= CROWNS[1]:
                attributes = {"area": self.metres(size), "width": round(across, 2)}
                self.add(crown, _inner(at, inner), Region("tree", _fit(round_), attributes))
            else:
                rest[inner] |= crown
        window = self.label[at]
        for part, inner, size in self.pieces(rest & (window == 0)):
            self.add(part, _inner(at, inner), Region("vegetation", 0.6, {"area": self.metres(size)}))

    # --- ground and roofs ---------------------------------------------------------------------------------------------
    def add_sealed(self, mask: NDArray[np.bool_]) -> None:
        """Add the regions of ground and roofs of one colour group."""
        import cv2

        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
        clean = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, kernel)
        clean = cv2.morphologyEx(clean, cv2.MORPH_CLOSE, kernel, iterations=2)
        clean[(self.label > 0) | ~self.valid] = 0
        for piece, at, area in self.pieces(clean):
            self._add_by_shape(piece, at, area)

    def _add_by_shape(self, piece: NDArray[np.bool_], at: tuple[slice, slice], area: int) -> None:
        ends = at[0].start == 0 or at[1].start == 0 or at[0].stop == self.height or at[1].stop == self.width
        region = _classify_shape(piece, self.lightness[at], area, self.minimum_area, self.size, ends)
        if region is not None:
            self.add(piece, at, region)


class ColourRules:
    """Classifier of masks found by a model, by the same colours and shapes."""

    def __init__(self, ground: GroundImage, min_area: float) -> None:
        """Set up the classifier. min_area: square metres of the smallest region."""
        import cv2

        self.size, self.grey = ground.resolution, ground.grey
        self.least = max(min_area / self.size**2, 1.0)
        self.shape = ground.valid.shape
        smooth = cv2.bilateralFilter(ground.rgb, 5, 25.0, 2.0).astype(np.float32)
        self.green = (2 * smooth[..., 1] - smooth[..., 0] - smooth[..., 2]) > GREEN * np.maximum(
            smooth.sum(axis=2), 1.0
        )
        self.light = cv2.cvtColor(ground.rgb.astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB)[..., 0]
        self.box = max(3, int(WINDOW / self.size) // 2 * 2 + 1)
        self.rough = cv2.blur(np.abs(self.light - cv2.medianBlur(self.light, 5)), (self.box, self.box)) > ROUGH

    def kind(self, mask: NDArray[np.bool_], at: tuple[slice, slice]) -> Region:
        """Classify a mask within a window of the image; ``area`` if colour and shape are not conclusive."""
        import cv2

        size = int(mask.sum())
        area = round(size * self.size**2, 2)
        unsure = Region("area", 1.0, {"area": area})
        if self.grey:
            return unsure
        grows = float(self.green[at][mask].mean())
        light = float(self.light[at][mask].mean())
        if MIXED < grows < 1 - MIXED:
            return unsure
        if grows <= MIXED:
            ends = any(s.start == 0 or s.stop == n for s, n in zip(at, self.shape, strict=True))
            return (
                None if light < SHADOW else _classify_shape(mask, self.light[at], size, self.least, self.size, ends)
            ) or unsure
        inner = cv2.erode(np.pad(mask, 1).astype(np.uint8), np.ones((self.box, self.box), np.uint8))[1:-1, 1:-1] == 1
        if light >= DARK and not (inner.any() and self.rough[at][inner].mean() > 0.5):
            return Region("field", _fit(grows), {"surface": "green", "area": area}) if area >= TURF else unsure
        round_ = _roundness(mask)
        across = 2 * math.sqrt(size / math.pi) * self.size
        if round_ >= ROUND and CROWNS[0] <= across <= CROWNS[1]:
            return Region("tree", _fit(round_ * grows), {"area": area, "width": round(across, 2)})
        return Region("vegetation", _fit(0.6 * grows), {"area": area})


def way_attributes(kind: str, mask: NDArray[np.bool_], size: float) -> dict[str, Any]:
    """Return the additional attribute of a path or road: its mean width. size: metres per pixel."""
    if kind not in ("path", "road"):
        return {}
    _, width, _ = _band(mask, int(mask.sum()), 1.0)
    return {"width": round(width * size, 2)}


def _band(piece: NDArray[np.bool_], area: int, min_pixels: float) -> tuple[float, float, Any]:
    """Return (length, width, outline) in pixels of the band with this area and perimeter."""
    import cv2

    # close dents and holes of a pixel or two, which would make every outline long
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    plain = cv2.morphologyEx(np.pad(piece, 4).astype(np.uint8), cv2.MORPH_CLOSE, kernel)
    outlines, order = cv2.findContours(plain, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)
    large = [c for c, o in zip(outlines, order[0], strict=True) if o[3] < 0 or cv2.contourArea(c) >= min_pixels]
    around = sum(cv2.arcLength(cv2.approxPolyDP(c, 2.0, True), True) for c in large) + 4 * len(large)
    length = (around + math.sqrt(max(around * around - 16 * area, 0.0))) / 4
    return length, area / length, max(outlines, key=cv2.contourArea)


def _classify_shape(
    piece: NDArray[np.bool_], light: NDArray[Any], area: int, min_pixels: float, size: float, ends: bool
) -> Region | None:
    """Classify a piece of ground or roof by its shape.

    light: lightness of its window. area, min_area: pixels. size: metres per pixel. ends: whether it reaches the image's
    edge.
    """
    import cv2

    length, width, outer = _band(piece, area, min_pixels)
    (_, _), (w, h), _ = cv2.minAreaRect(outer)
    w, h = w + 1, h + 1
    filled = cv2.contourArea(outer) + cv2.arcLength(outer, True) / 2 + 1
    rectangular = min(1.0, filled / (w * h))
    uniform = max(0.0, 1.0 - float(light[piece].std()) / 25.0)
    square_metres = round(area * size**2, 2)
    attributes: dict[str, Any] = {"area": square_metres}
    metres, side = width * size, min(w, h) * size
    long = length >= LONG * width and metres <= ROAD and length * size >= 2 * WINDOW
    straight = rectangular >= RECTANGULAR and square_metres >= BUILDING and side >= SIDE
    # a path leads somewhere: a straight band that is isolated in the image is rather a roof
    if straight and (max(w, h) < LONG * min(w, h) or (not ends and max(w, h) < 3 * LONG * min(w, h))):
        sides = sorted((round(w * size, 2), round(h * size, 2)), reverse=True)
        return Region("building", _fit(rectangular * uniform), {**attributes, "sides": sides})
    if long:
        slender = 1.0 - LONG / 2 / max(length / width, LONG)
        kind: Kind = "path" if metres <= PATH else "road"
        return Region(kind, _fit(slender * uniform), {**attributes, "width": round(metres, 2)})
    if square_metres >= FIELD:
        return Region("field", _fit(0.6 * uniform), {**attributes, "surface": "bare"})
    return None


def _inner(at: tuple[slice, slice], inner: tuple[slice, slice]) -> tuple[slice, slice]:
    """Return a window within a window as a window of the image."""
    rows, columns = (slice(o.start + i.start, o.start + i.stop) for o, i in zip(at, inner, strict=True))
    return rows, columns


def _fit(value: float) -> float:
    return round(min(1.0, max(0.05, value)), 3)


def _roundness(mask: NDArray[np.bool_]) -> float:
    """Return the share of a shape within the circle of equal area around its centre."""
    rows, columns = np.nonzero(mask)
    limit = len(rows) / math.pi
    inside = (rows - rows.mean()) ** 2 + (columns - columns.mean()) ** 2 <= limit
    return float(inside.mean())


def _watershed(mask: Mask, away: NDArray[np.float32], window: int) -> NDArray[np.int32]:
    """Cut a mask at the saddles of its distance to the edge: int32 [h, w], 0 outside."""
    import cv2

    smooth = np.where(mask == 1, cv2.GaussianBlur(away, (window, window), 0), np.float32(0))
    count, hills = cv2.connectedComponents(_hills(smooth).astype(np.uint8))
    if count <= 2:
        return mask.astype(np.int32)
    markers: NDArray[np.int32] = hills.astype(np.int32) + 1
    markers[(mask == 1) & (markers == 1)] = 0
    height = np.clip(255.0 - smooth / max(float(smooth.max()), 1e-6) * 254.0, 0, 255).astype(np.uint8)
    cv2.watershed(np.repeat(height[..., None], 3, axis=2), markers)
    parts = np.where(markers > 1, markers - 1, 0)
    # lines between two basins go to one of them
    beside = cv2.dilate(parts.astype(np.float32), np.ones((3, 3), np.uint8)).astype(np.int32)
    return np.where(mask == 1, np.where(parts > 0, parts, beside), 0).astype(np.int32)


def _hills(height: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return the tops of the hills that rise more than a fifth above their saddles (domes by reconstruction)."""
    import cv2

    kernel = np.ones((3, 3), np.uint8)
    marker = height * np.float32(0.8)
    while True:
        grown = np.minimum(cv2.dilate(marker, kernel), height)
        if np.array_equal(grown, marker):
            return np.asarray(height > marker + np.float32(1e-3))
        marker = grown

"""Regions of an aerial image by shade, roughness and shape: crowns, turf, paths, roads and buildings."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.derive import DerivationNotes
from app.derive._cover import ROUGH, WINDOW, Cover
from app.derive._pictures import GroundImage
from app.derive._segments import Kind, Region

Mask = NDArray[np.uint8]

GREEN = 0.06
"""Minimum excess green of a group of pixels that is vegetation."""

DARK, SHADOW = 38.0, 20.0
"""CIELAB lightness (0 to 100) below which vegetation is wood, and below which other pixels are shadow."""

CROWNS = (0.8, 20.0)
"""Minimum and maximum diameter of a tree's crown in metres."""

ROUND = 0.75
"""Minimum share of its circle around the same centre that a tree's crown covers."""

LONG = 4.0
"""Minimum ratio of length to width of paths and roads."""

BULGE = 2.5
"""Maximum diameter of the widest place of a path or road, in its mean widths."""

PATH, ROAD = 4.0, 20.0
"""Width in metres above which paths are roads, and maximum width of roads."""

FIELD, TURF = 50.0, 10.0
"""Minimum area of a field of bare ground, and of turf, in square metres."""

BUILDING, SIDE, RECTANGULAR = 8.0, 2.5, 0.78
"""Minimum area in square metres, minimum side in metres, and minimum share of its rectangle, of a building."""

CALM = 1.8
"""Maximum roughness of turf."""

WATER, DOUBT = 0.7, 0.5
"""Confidence of water that is recognised by colour alone; factor of confidence for each reason to doubt."""

LEAVES, SOIL = (85.0, 150.0), (50.0, 95.0)
"""Hues of turf and of bare soil in CIELAB, in degrees."""

EARTHY = 10.0
"""Minimum chroma of bare soil: roofs and paved ground are greyer."""

VAST = 500.0
"""Minimum area of a field of bare ground that is no roof, in square metres."""

NARROW = 0.8
"""Width in metres below which a path is doubtful: it may be the edge of a roof."""

SHADOW_REACH, SHADY = 1.5, 0.15
"""Width in metres of the edge in which a shadow is looked for, and minimum share of shade there."""

OUTLINE, OUTLINED = 10.0, 0.7
"""Minimum contrast at the edge of a region, and minimum share of it along a path or road: water and roofs whose shade
changes fall apart into bands without edges.
"""

HALL = 10_000.0
"""Area in square metres above which a building is doubtful; above ten times that, a rectangle is a field."""

MIXED = 0.25
"""Share of green up to which an area is no vegetation, and share of other pixels up to which it is."""


class RegionBuilder:
    """Builder of regions: adds the regions of one image one after the other."""

    def __init__(self, ground: GroundImage, seen: Cover, min_area: float) -> None:
        self.size = ground.resolution
        self.minimum_area = max(min_area / self.size**2, 1.0)
        self.height, self.width = (int(n) for n in ground.valid.shape)
        self.label = np.zeros(ground.valid.shape, np.int32)
        self.regions: list[Region] = []
        self.cover, self.lightness = seen, seen.light
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

    # --- water --------------------------------------------------------------------------------------------------------
    def water(self, wet: NDArray[np.bool_], *, measured: bool) -> None:
        """Add the regions of water. measured: whether they come from a near-infrared band, not from colour alone."""
        import cv2

        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
        clean = cv2.morphologyEx(wet.astype(np.uint8), cv2.MORPH_CLOSE, kernel) if measured else wet
        for mask, at, area in self.pieces(clean):
            still = _fit(1.0 - float(self.cover.rough[at][mask].mean()) / 10.0)
            confidence = still if measured else _fit(WATER * still)
            self.add(mask, at, Region("water", confidence, {"area": self.metres(area)}))

    # --- vegetation ---------------------------------------------------------------------------------------------------
    def vegetation(self, grows: NDArray[np.bool_], leafy: NDArray[np.bool_]) -> None:
        """Add the regions of wood and turf. Vegetation that is neither rough nor calm is unknown.

        leafy: pixels whose surroundings look like crowns.
        """
        import cv2

        light, rough = self.lightness, self.cover.rough
        box = np.ones((self.cover.window, self.cover.window), np.uint8)
        # the roughness of an edge to another area is not the vegetation's own
        within = cv2.erode(grows.astype(np.uint8), box) == 1
        dark = cv2.blur(light, (3, 3)) < DARK
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
        wood = grows & (dark | ((within | leafy) & (rough > ROUGH)))
        wood = grows & (cv2.morphologyEx(wood.astype(np.uint8), cv2.MORPH_CLOSE, kernel, iterations=2) == 1)
        wood = cv2.morphologyEx(wood.astype(np.uint8), cv2.MORPH_OPEN, kernel) == 1
        for mask, at, _ in self.pieces(wood):
            self._wood(mask, at)
        calm = (grows & ~wood & within & (rough < CALM)).astype(np.uint8)
        # the turf's own edge, up to the window of the roughness
        near = cv2.dilate(calm, box, iterations=2) == 1
        turf = cv2.morphologyEx((grows & ~wood & near).astype(np.uint8), cv2.MORPH_OPEN, kernel)
        edges = cv2.Canny(cv2.GaussianBlur(np.clip(light * 2.55, 0, 255).astype(np.uint8), (5, 5), 0), 60, 150)
        for mask, at, area in self.pieces(turf & (cv2.dilate(edges, kernel) == 0)):
            # restore the pixels that the edge itself took
            high, wide = (slice(max(0, s.start - 2), s.stop + 2) for s in at)
            grown = np.pad(mask, ((at[0].start - high.start, 2), (at[1].start - wide.start, 2)))
            room = turf[high, wide] == 1
            grown = grown[: room.shape[0], : room.shape[1]]
            grown = (cv2.dilate(grown.astype(np.uint8), kernel, iterations=2) == 1) & room
            if self.metres(area) >= TURF:
                self._turf(grown, (high, wide), area, calm)

    def _turf(self, mask: NDArray[np.bool_], at: tuple[slice, slice], area: int, calm: Mask) -> None:
        """Add a field of turf. It is sure as far as it is calm, of one shade, and not as bluish as water."""
        shade = float(self.lightness[at][mask].std())
        a, b = (float(np.median(self.cover.lab[at][..., k][mask])) for k in (1, 2))
        hue = math.degrees(math.atan2(b, a))
        sure = (1.0 - shade / 30.0) * min(1.0, 2.0 * float(calm[at][mask].mean()))
        if not LEAVES[0] <= hue <= LEAVES[1]:
            sure *= DOUBT
        self.add(mask, at, Region("field", _fit(sure), {"surface": "green", "area": self.metres(area)}))

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
    def add_sealed(self, mask: NDArray[np.bool_], *, measured: bool) -> None:
        """Add the regions of ground and roofs of one colour group. measured: whether water is known from a band."""
        import cv2

        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3))
        clean = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, kernel)
        clean = cv2.morphologyEx(clean, cv2.MORPH_CLOSE, kernel, iterations=2)
        clean[(self.label > 0) | ~self.valid] = 0
        for piece, at, area in self.pieces(clean):
            ends = at[0].start == 0 or at[1].start == 0 or at[0].stop == self.height or at[1].stop == self.width
            region = _classify_shape(piece, self.lightness[at], area, self.minimum_area, self.size, ends)
            if region is not None:
                if region.kind != "building":
                    region.confidence = self._ground_confidence(region, piece, at, measured=measured)
                self.add(piece, at, region)

    def _ground_confidence(
        self, region: Region, piece: NDArray[np.bool_], at: tuple[slice, slice], *, measured: bool
    ) -> float:
        """Return how sure a piece is ground, and not a roof, a crown or water."""
        sure = region.confidence
        if region.kind == "field":
            a, b = (float(np.median(self.cover.lab[at][..., k][piece])) for k in (1, 2))
            soil = math.hypot(a, b) >= EARTHY and SOIL[0] <= math.degrees(math.atan2(b, a)) <= SOIL[1]
            vast = region.attributes["area"] >= VAST
            is_ground = measured and (soil or region.attributes["area"] >= HALL)
            sure = _fit(sure / 0.6 * (0.8 if vast and is_ground else 0.55 if vast and soil else 0.35))
        else:
            if region.attributes["width"] < max(NARROW, 3 * self.size):
                sure *= DOUBT
            if sure >= 0.5 and self._outlined(piece, at) < OUTLINED:
                sure *= DOUBT
        if float(self.cover.rough[at][piece].mean()) > ROUGH:
            sure *= DOUBT
        if sure >= 0.5 and self._casts_shadow(piece, at):
            sure *= DOUBT
        return _fit(sure)

    def _outlined(self, piece: NDArray[np.bool_], at: tuple[slice, slice]) -> float:
        """Return the share of a piece's edge at which the colour changes: elsewhere the same surface goes on."""
        import cv2

        padded = np.pad(piece, 1).astype(np.uint8)
        edge = (padded == 1) & (cv2.erode(padded, np.ones((3, 3), np.uint8)) == 0)
        # the image's border is no edge of the piece
        rows, columns = np.nonzero(edge[1:-1, 1:-1])
        rows, columns = rows + at[0].start, columns + at[1].start
        inner = (rows > 0) & (rows < self.height - 1) & (columns > 0) & (columns < self.width - 1)
        contrast = self.cover.contrast[rows[inner], columns[inner]]
        return float((contrast > OUTLINE).mean()) if len(contrast) else 1.0

    def _casts_shadow(self, piece: NDArray[np.bool_], at: tuple[slice, slice]) -> bool:
        """Return whether shade lies along much of a piece's edge, as beside a wall."""
        import cv2

        reach = max(2, round(SHADOW_REACH / self.size))
        high, wide = (slice(max(0, s.start - reach), s.stop + reach) for s in at)
        padded = np.pad(piece, ((at[0].start - high.start, reach), (at[1].start - wide.start, reach)))
        shade = self.cover.shade[high, wide]
        inner: Mask = padded[: shade.shape[0], : shade.shape[1]].astype(np.uint8)
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
        ring = (cv2.dilate(inner, kernel) == 1) & (inner == 0)
        return bool(ring.any() and shade[ring].mean() > SHADY)


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
    if long:  # a ragged area has a long outline, too, but is wider than a band of its length
        away = cv2.distanceTransform(np.pad(piece, 1).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
        long = 2 * float(away.max()) <= BULGE * max(width, 2.0)
    straight = rectangular >= RECTANGULAR and BUILDING <= square_metres <= 10 * HALL and side >= SIDE
    # a path leads somewhere: a straight band that is isolated in the image is rather a roof
    if straight and (max(w, h) < LONG * min(w, h) or (not ends and max(w, h) < 3 * LONG * min(w, h))):
        sides = sorted((round(w * size, 2), round(h * size, 2)), reverse=True)
        sure = rectangular * uniform * (DOUBT if square_metres > HALL else 1.0)  # fields are rectangles, too
        return Region("building", _fit(sure), {**attributes, "sides": sides})
    if long:
        slender = 1.0 - LONG / 2 / max(length / width, LONG)
        kind: Kind = "path" if metres <= PATH else "road"
        if kind == "road" and not ends and length < 2 * LONG * width:  # a roof with wings is a short wide band
            slender *= DOUBT
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

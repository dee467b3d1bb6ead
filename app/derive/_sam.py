"""Models of the Segment-Anything family: an image encoder, and a prompt decoder queried at a grid of points.

Supported files are those of facebookresearch/segment-anything's ``export_onnx_model.py`` (and of MobileSAM, which has
the same decoder), or of SAM 2 as it is commonly exported:

======= ===============================================================================================================
encoder one image -> ``image_embeddings``. Either [1, 3, side, side], normalised by ImageNet's mean and deviation and
        padded with 0, or [height, width, 3] with values 0 to 255, normalised and padded in the file itself. SAM 2:
        [1, 3, side, side] -> ``image_embed`` and ``high_res_feats_…``, the image stretched to the square
decoder those, ``point_coords`` [n, points, 2] in pixels of the encoder's image, ``point_labels`` [n, points] (1: in
        the object, -1: no point), ``mask_input`` [n, 1, side / 4, side / 4], ``has_mask_input`` [1], ``orig_im_size``
        [2] (height, width; optional for SAM 2) -> ``masks``, ``iou_predictions`` [n, m] and ``low_res_masks`` [n, m,
        side / 4, side / 4], logits
======= ===============================================================================================================

Masks are generated as by segment_anything's automatic mask generator: at a grid of points in each tile, and in the
whole image scaled down. Masks with a low predicted IoU, masks that change with the threshold, and masks that end at a
tile's edge are dropped; of those with nearly the same box the best of the finest tile stays. ``low_res_masks`` are
preferred, because some exports crop ``masks`` to the image of their export. Masks are classified by colour and shape.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.derive import DerivationNotes
from app.derive._onnx import Array, LoadedModel, ModelFiles, load_session, square, starts
from app.derive._pictures import GroundImage
from app.derive._regions import ColourRules
from app.derive._segments import Region, Segments
from app.errors import CannotConvert

DEFAULT_SIDE = 1024
"""Default side of a tile in pixels, if the files do not state it."""

MIN_SCORE, MIN_STABILITY, POINTS = 0.88, 0.95, 16
"""Defaults: minimum predicted IoU and stability as in segment_anything, and points along a tile (there 32)."""

OFFSET = 1.0
"""Offset of the threshold in both directions that tests a mask's stability."""

MIN_DUPLICATE_OVERLAP = 0.7
"""Minimum intersection over union of the boxes of duplicate masks."""

EDGE = 20 / 1024
"""Share of a tile's side: a mask that comes this close to an edge continues beyond it."""

PROMPTS_PER_CALL = 16
"""Number of prompts per call, if the decoder accepts several."""

MAX_TILES, MAX_PROMPTS = 256, 2**15

MEAN = np.array([123.675, 116.28, 103.53], np.float32)
DEVIATION = np.array([58.395, 57.12, 57.375], np.float32)
"""ImageNet's standard deviations, for values 0 to 255."""

PROMPT = ("point_coords", "point_labels", "mask_input", "has_mask_input")
EXPECTED_MODEL = (
    "an encoder with one image [1, 3, side, side] or [height, width, 3] as its input, and a decoder with the inputs "
    "image_embeddings, point_coords, point_labels, mask_input, has_mask_input, orig_im_size and the outputs masks, "
    "iou_predictions, low_res_masks (segment-anything's scripts/export_onnx_model.py), or SAM 2's with image_embed and "
    "high_res_feats_… in place of image_embeddings"
)


@dataclass(frozen=True, slots=True)
class Model:
    """Loaded encoder and decoder.

    Attributes:
        passed: the decoder's input for each of the encoder's outputs.
        side: pixels of a tile.
        upright: whether the encoder takes [height, width, 3].
        stretched: whether a tile fills the square, whatever its shape.
        together: whether the decoder accepts several prompts at once.
    """

    encoder: LoadedModel
    decoder: LoadedModel
    name: str
    passed: Mapping[str, str]
    side: int
    upright: bool
    stretched: bool
    together: bool


@dataclass(frozen=True, slots=True)
class Mask:
    """One mask of a detected region.

    Attributes, in order: its window in the image's pixels, its pixels there (packed), its size in pixels, its predicted
    IoU, its stability, and the size of the tile in which it was found.
    """

    box: tuple[int, int, int, int]
    bits: NDArray[np.uint8]
    size: int
    score: float
    stability: float
    tile: int

    def pixels(self) -> NDArray[np.bool_]:
        """Return the mask within its box."""
        x0, y0, x1, y1 = self.box
        return np.unpackbits(self.bits, count=(y1 - y0) * (x1 - x0)).astype(bool).reshape(y1 - y0, x1 - x0)


def check_model(supplied: ModelFiles) -> Model:
    """Load the two files as a model. Raises CannotConvert, which states the expected inputs and outputs."""
    name = supplied.name
    encoder, decoder = (load_session(file, f"{name} ({file.name})") for file in supplied.files)

    def wrong(file: LoadedModel) -> CannotConvert:
        return CannotConvert(
            f"the model {name} is not of the Segment-Anything family: expected {EXPECTED_MODEL}; {file.name} has the "
            f"signature {file.signature()}"
        )

    if len(encoder.inputs) != 1:
        raise wrong(encoder)
    ((_, shape),) = encoder.inputs.values()
    upright = len(shape) == 3 and shape[2] in (3, "3")
    if not upright and not (len(shape) == 4 and shape[1] in (3, "3")):
        raise wrong(encoder)
    wants = set(decoder.inputs) - {*PROMPT, "orig_im_size"}
    if not set(PROMPT) <= set(decoder.inputs) or not wants or not _answers(decoder):
        raise wrong(decoder)
    if wants <= set(encoder.outputs):
        passed = {n: n for n in sorted(wants)}
    elif len(wants) == 1 and len(encoder.outputs) == 1:
        passed = {next(iter(encoder.outputs)): next(iter(wants))}
    else:
        raise wrong(encoder)
    low = [4 * n if isinstance(n, int) else n for n in decoder.inputs["mask_input"][1][2:]]
    side = square(low if upright else shape[2:], name, square(low, name, DEFAULT_SIDE))
    together = not isinstance((decoder.inputs["point_coords"][1] or [1])[0], int)
    return Model(encoder, decoder, name, passed, side, upright, len(wants) > 1, together)


def _answers(decoder: LoadedModel) -> bool:
    return "iou_predictions" in decoder.outputs and bool({"low_res_masks", "masks"} & set(decoder.outputs))


def segments(
    ground: GroundImage,
    model: Model,
    sure: float,
    stable: float,
    points: int,
    min_area: float,
    notes: DerivationNotes,
    name: str,
) -> Segments:
    """Segment an image into the regions that the model finds, smaller ones above larger ones. min_area: square metres.

    Raises CannotConvert before work starts if the model would have to be queried too often, and if it finds nothing.
    """
    height, width = ground.valid.shape
    tiles = list(_tiles(height, width, model.side))
    prompts = [_grid(tile, points, ground.valid) for tile in tiles]
    prompt_count = sum(len(p) for p in prompts)
    if len(tiles) > MAX_TILES or prompt_count > MAX_PROMPTS:
        raise CannotConvert(
            f"{name}: the model {model.name} would need {prompt_count} prompts in {len(tiles)} tiles of {model.side} "
            f"pixels, above the maximum of {MAX_PROMPTS} in {MAX_TILES}: use a resolution coarser than "
            f"{ground.resolution:g} m, or fewer points than {points}"
        )
    masks: list[Mask] = []
    for tile, places in zip(tiles, prompts, strict=True):
        if len(places):
            masks += _drop_duplicates(_tile_masks(ground, tile, places, model, sure, stable))
    best_masks = _drop_duplicates(masks)
    if not best_masks:
        raise CannotConvert(
            f"{name}: the model {model.name} finds nothing with a confidence of at least {sure:g} and a stability of "
            f"at least {stable:g}: lower one of them"
        )
    return _masks_to_segments(ground, best_masks, model, min_area, notes, name)


def _tiles(height: int, width: int, side: int) -> Iterator[tuple[int, int, int, int]]:
    """Return (row, column, rows, columns) of the tiles: the whole image, and if it is larger than a tile, its parts."""
    yield 0, 0, height, width
    if max(height, width) > side:
        for row, column in itertools.product(starts(height, side), starts(width, side)):
            yield row, column, min(side, height - row), min(side, width - column)


def _grid(tile: tuple[int, int, int, int], points: int, valid: NDArray[np.bool_]) -> Array:
    """Return the prompt points (x, y) of a tile in its pixels, equally dense in both directions, in valid pixels."""
    row, column, rows, columns = tile
    step = max(rows, columns) / points
    down, across = max(1, round(rows / step)), max(1, round(columns / step))
    y = (np.arange(down) + 0.5) * rows / down
    x = (np.arange(across) + 0.5) * columns / across
    at = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    mask = valid[row + at[:, 1].astype(np.int64), column + at[:, 0].astype(np.int64)]
    return at[mask].astype(np.float32)


def _tile_masks(
    ground: GroundImage, tile: tuple[int, int, int, int], places: Array, model: Model, sure: float, stable: float
) -> list[Mask]:
    """Return the masks of one tile that pass all thresholds."""
    import cv2

    row, column, rows, columns = tile
    part = ground.rgb[row : row + rows, column : column + columns]
    scale = model.side / max(rows, columns)
    high, wide = (model.side, model.side) if model.stretched else (int(rows * scale + 0.5), int(columns * scale + 0.5))
    high, wide = max(1, high), max(1, wide)
    shrinks = high < rows or wide < columns
    image = cv2.resize(part, (wide, high), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    feed = _encode_image(image.astype(np.float32), model)
    at = places * np.array([wide / columns, high / rows], np.float32)
    out: list[Mask] = []
    count = PROMPTS_PER_CALL if model.together else 1
    for k in range(0, len(at), count):
        logits, scores = _prompt_masks(at[k : k + count], feed, (rows, columns), (high, wide), model)
        for one, score in zip(logits[scores >= sure], scores[scores >= sure].tolist(), strict=True):
            steady = _stability(one)
            if steady < stable:
                continue
            full = cv2.resize(one, (columns, rows), interpolation=cv2.INTER_LINEAR) > 0.0
            full &= ground.valid[row : row + rows, column : column + columns]
            mask = _mask(full, tile, ground.valid.shape, score, steady)
            if mask is not None:
                out.append(mask)
    return out


def _encode_image(image: Array, model: Model) -> dict[str, Array]:
    """Encode an image [h, w, 3] of values 0 to 255; return the outputs by the decoder's input names."""
    if not model.upright:
        padded = np.zeros((model.side, model.side, 3), np.float32)
        padded[: image.shape[0], : image.shape[1]] = (image - MEAN) / DEVIATION
        image = padded.transpose(2, 0, 1)[None]
    answer = model.encoder.run({next(iter(model.encoder.inputs)): image})
    return {theirs: answer[ours] for ours, theirs in model.passed.items()}


def _prompt_masks(
    at: Array, feed: Mapping[str, Array], size: tuple[int, int], inner: tuple[int, int], model: Model
) -> tuple[Array, Array]:
    """Return (logits [m, h, w] of the tile alone, predicted IoU [m]) for all points, one mask after the other."""
    n, low = len(at), model.side // 4
    prompt: dict[str, NDArray[Any]] = {
        **feed,
        # a padding point (label -1) replaces the missing box prompt, as in segment_anything's own example
        "point_coords": np.stack([at, np.zeros_like(at)], axis=1),
        "point_labels": np.tile(np.array([1.0, -1.0], np.float32), (n, 1)),
        "mask_input": np.zeros((n, 1, low, low), np.float32),
        "has_mask_input": np.zeros(1, np.float32),
    }
    if "orig_im_size" in model.decoder.inputs:
        prompt["orig_im_size"] = np.array(size, np.float32)
    answer = model.decoder.run(prompt)
    scores = answer["iou_predictions"]
    small = answer.get("low_res_masks")
    masks = answer["masks"] if small is None else small
    if masks.ndim != 4 or masks.shape[0] != n or scores.shape != masks.shape[:2] or 0 in masks.shape:
        raise CannotConvert(
            f"the model {model.name} returns for {n} points masks {masks.shape} and iou_predictions {scores.shape}: "
            "expected [points, masks, height, width] and [points, masks]"
        )
    if masks.shape[1] == 4:  # the first mask is for several points; here each prompt has one
        masks, scores = masks[:, 1:], scores[:, 1:]
    if small is not None:
        down, across = (max(1, int(np.ceil(n * f / model.side))) for n, f in zip(inner, masks.shape[2:], strict=True))
        masks = masks[:, :, :down, :across]
    scores = np.where(np.isfinite(scores), scores, np.float32(-1))
    return masks.reshape(-1, *masks.shape[2:]), scores.reshape(-1)


def _stability(logits: Array) -> float:
    """Return the IoU of a mask at a higher and at a lower threshold (the lower one contains the higher)."""
    low = int((logits > -OFFSET).sum())
    return int((logits > OFFSET).sum()) / low if low else 0.0


def _mask(
    full: NDArray[np.bool_],
    tile: tuple[int, int, int, int],
    full_shape: tuple[int, ...],
    score: float,
    stability: float,
) -> Mask | None:
    """Crop a mask to its box; None if it is empty, or continues beyond its tile."""
    row, column, rows, columns = tile
    down, across = np.flatnonzero(full.any(axis=1)), np.flatnonzero(full.any(axis=0))
    if not len(down):
        return None
    y0, y1, x0, x1 = int(down[0]), int(down[-1]) + 1, int(across[0]), int(across[-1]) + 1
    near = EDGE * max(rows, columns)
    if (row > 0 and y0 < near) or (column > 0 and x0 < near):
        return None
    if (row + rows < full_shape[0] and rows - y1 < near) or (column + columns < full_shape[1] and columns - x1 < near):
        return None
    inside = full[y0:y1, x0:x1]
    box = (column + x0, row + y0, column + x1, row + y1)
    return Mask(box, np.packbits(inside), int(inside.sum()), float(score), stability, rows * columns)


def _drop_duplicates(masks: list[Mask]) -> list[Mask]:
    """Non-maximum suppression by boxes: masks of finer tiles first, then by score."""
    import cv2

    if not masks:
        return []
    masks = sorted(masks, key=lambda m: (m.tile, -m.score, -m.stability, m.box))
    boxes = [(m.box[0], m.box[1], m.box[2] - m.box[0], m.box[3] - m.box[1]) for m in masks]
    rank = np.linspace(1.0, 0.5, len(masks)).tolist()
    indices = cv2.dnn.NMSBoxes(boxes, rank, 0.0, MIN_DUPLICATE_OVERLAP)
    return [masks[k] for k in sorted(int(i) for i in np.asarray(indices).ravel())]


def _masks_to_segments(
    ground: GroundImage, masks: list[Mask], model: Model, min_area: float, notes: DerivationNotes, name: str
) -> Segments:
    """Convert masks to regions, classified by colour and shape."""
    label = np.zeros(ground.valid.shape, np.int32)
    pixels = max(min_area / ground.resolution**2, 1.0)
    masks.sort(key=lambda m: (-m.size, m.score, m.box))
    clean = [(mask, cleaned) for mask in masks if (cleaned := _clean_mask(mask.pixels(), pixels)) is not None]
    for k, (mask, cleaned) in enumerate(clean, 1):
        x0, y0, x1, y1 = mask.box
        label[y0:y1, x0:x1][cleaned & ground.valid[y0:y1, x0:x1]] = k
    seen = np.bincount(label.ravel(), minlength=len(clean) + 1)
    colours = ColourRules(ground, min_area)
    regions: list[Region] = []
    numbers = np.zeros(len(clean) + 1, np.int32)
    unsure = 0
    for k, (mask, _) in enumerate(clean, 1):
        if seen[k] < pixels:
            continue
        x0, y0, x1, y1 = mask.box
        at = (slice(y0, y1), slice(x0, x1))
        region_mask = label[at] == k
        rest = _drop_small(region_mask, pixels)  # the part that no other mask covers
        label[at][region_mask & ~rest] = 0
        if not rest.any():
            continue
        region = colours.kind(rest, at)
        unsure += region.kind == "area"
        region.confidence = round(min(1.0, max(0.05, region.confidence * min(mask.score, 1.0))), 3)
        region.attributes |= {"model": model.name, "stability": round(mask.stability, 3)}
        regions.append(region)
        numbers[k] = len(regions)
    if not regions:
        raise CannotConvert(
            f"{name}: everything that the model {model.name} finds is smaller than minimum_area={min_area:g} m²"
        )
    notes.drop(
        "masks", len(masks) - len(regions), f"{name}: smaller than minimum_area={min_area:g} m², or hidden by others"
    )
    notes.warn(
        f"{name}: the model {model.name} returns masks without classes; {len(regions) - unsure} were classified by "
        f"colour and shape, {unsure} have kind area"
    )
    return Segments(numbers[label], regions, np.zeros(label.shape, bool))


def _clean_mask(mask: NDArray[np.bool_], min_pixels: float) -> NDArray[np.bool_] | None:
    """Remove pieces and holes of a mask that are too small; None if nothing is left."""
    filled = ~_drop_small(np.pad(~mask, 1, constant_values=True), min_pixels)[1:-1, 1:-1]
    inside = _drop_small(filled, min_pixels)
    return inside if inside.any() else None


def _drop_small(mask: NDArray[np.bool_], min_pixels: float) -> NDArray[np.bool_]:
    """Remove connected pieces with fewer pixels from a mask."""
    import cv2

    count, pieces, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] >= min_pixels
    large[0] = False
    return mask if large[1:].all() or count == 1 else np.asarray(large[pieces])

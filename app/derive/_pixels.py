"""Semantic segmentation models, which classify each pixel.

Input is a tile of the image as float32 [1, 3, side, side], RGB from 0 to 1, minus ``mean`` and divided by ``std``
(three numbers each in the model's ``NAME.json``; default: ImageNet's, as in torchvision). Output are logits [1,
classes, h, w], as fine as the image or coarser. Each connected piece of a class is a region.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.derive import DerivationNotes
from app.derive._onnx import Array, LoadedModel, ModelFiles, classes, input_side, starts
from app.derive._pictures import GroundImage
from app.derive._regions import way_attributes
from app.derive._segments import Region, Segments
from app.errors import CannotConvert

SIDE = 512
"""Default side of a tile in pixels, for models that accept any size."""

MIN_CONFIDENCE = 0.5
"""Default minimum probability of a classified pixel."""

MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)

MAX_SEGMENTS = 100_000
"""Maximum number of regions in one image; more are noise."""


@dataclass(frozen=True, slots=True)
class Model:
    """Loaded model. classes: kind of each class, or None. side: pixels of a tile."""

    file: LoadedModel
    name: str
    classes: tuple[str | None, ...]
    side: int
    mean: Array
    deviation: Array


def check_model(supplied: ModelFiles, file: LoadedModel) -> Model:
    """Return a loaded file as a pixel classification model. Raises CannotConvert, which states the expected input."""
    side = input_side(supplied, file, "does not classify pixels", SIDE)
    kinds, metadata = classes(supplied, file.session)
    mean, deviation = (_three(metadata, word, usual, supplied) for word, usual in (("mean", MEAN), ("std", DEVIATION)))
    if (deviation <= 0).any():
        raise CannotConvert(f"{supplied.classes_file.name}: std must be above 0")
    return Model(file, supplied.name, kinds, side, mean, deviation)


def _three(metadata: Mapping[str, Any], word: str, usual: tuple[float, ...], supplied: ModelFiles) -> Array:
    try:
        values = np.array([float(v) for v in metadata.get(word, usual)], np.float32)
    except (TypeError, ValueError):
        values = np.empty(0, np.float32)
    if values.shape != (3,) or not np.isfinite(values).all():
        raise CannotConvert(
            f"{supplied.classes_file.name}: {word} must be three numbers, for red, green and blue from 0 to 1"
        )
    return values


def segments(
    ground: GroundImage, model: Model, sure: float, min_area: float, notes: DerivationNotes, name: str
) -> Segments:
    """Segment an image by the class of each pixel. min_area: square metres."""
    import cv2

    height, width = ground.valid.shape
    labels = np.zeros(
        (height, width), np.uint8 if len(model.classes) < 255 else np.uint16
    )  # 0: nothing, k: class k - 1
    chance = np.zeros((height, width), np.float16)
    rows, columns = starts(height, model.side), starts(width, model.side)
    seen: set[int] = set()
    for (i, row), (j, column) in itertools.product(enumerate(rows), enumerate(columns)):
        best, score = _tile(ground.rgb[row : row + model.side, column : column + model.side], model)
        seen.update(np.unique(best).tolist())
        # each of two overlapping tiles counts up to the middle of the overlap
        top, left = (_half(starts_, k, model.side) for starts_, k in ((rows, i), (columns, j)))
        inner = (slice(top, None), slice(left, None))
        at = (slice(row + top, row + best.shape[0]), slice(column + left, column + best.shape[1]))
        labels[at], chance[at] = best[inner] + 1, score[inner]
    labels[(chance < sure) | ~ground.valid] = 0
    if len(seen) == 1 < len(model.classes):
        only = model.classes[next(iter(seen))] or "none of the kinds"
        notes.warn(f"{name}: the model {model.name} puts every pixel into one class ({only}); check its mean and std")
    label = np.zeros((height, width), np.int32)
    regions: list[Region] = []
    other = small = 0
    for k, kind in enumerate(model.classes, 1):
        mask = labels == k
        if kind is None:
            other += int(mask.sum())
            continue
        count, pieces, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
        large = stats[:, cv2.CC_STAT_AREA] * ground.resolution**2 >= max(min_area, ground.resolution**2)
        small += int(count - 1 - large[1:].sum())
        if len(regions) + int(large[1:].sum()) > MAX_SEGMENTS:
            raise CannotConvert(
                f"{name}: the model {model.name} finds more than {MAX_SEGMENTS} regions: set a larger minimum_area"
            )
        for piece in (np.flatnonzero(large[1:]) + 1).tolist():
            x, y, w, h, area = (int(v) for v in stats[piece])
            at = (slice(y, y + h), slice(x, x + w))
            inside = pieces[at] == piece
            attributes = {"area": round(area * ground.resolution**2, 2), "model": model.name}
            attributes |= way_attributes(kind, inside, ground.resolution)
            mean = round(float(chance[at][inside].mean(dtype=np.float64)), 3)
            regions.append(Region(kind, min(mean, 1.0), attributes))  # type: ignore[arg-type]
            label[at][inside] = len(regions)
    if not regions:
        raise CannotConvert(
            f"{name}: the model {model.name} finds nothing with a confidence of at least {sure:g}: lower it"
        )
    area = round(other * ground.resolution**2)
    notes.drop("m² of ground", area, f"{name}: the classes of this model map them to no kind")
    notes.drop("small regions", small, f"{name}: smaller than minimum_area={min_area:g} m²")
    return Segments(label, regions, np.zeros(label.shape, bool))


def _half(starts_: list[int], k: int, side: int) -> int:
    """Return the pixels at a tile's start that belong to the tile before it."""
    return (starts_[k - 1] + side - starts_[k]) // 2 if k else 0


def _tile(part: NDArray[np.uint8], model: Model) -> tuple[NDArray[np.int64], Array]:
    """Return (class, its probability) of each pixel of a tile."""
    import cv2

    side, count = model.side, len(model.classes)
    image = np.zeros((side, side, 3), np.float32)
    seen = (part.astype(np.float32) / np.float32(255) - model.mean) / model.deviation
    image[: part.shape[0], : part.shape[1]] = seen
    answers = model.file.run({next(iter(model.file.inputs)): image.transpose(2, 0, 1)[None]})
    logits = next(iter(answers.values()))
    if logits.ndim != 4 or logits.shape[:2] != (1, count) or 0 in logits.shape:
        raise CannotConvert(
            f"the model {model.name} does not have {count} classes: it returns {logits.shape}, expected "
            f"[1, {count}, h, w]"
        )
    full = np.stack([cv2.resize(one, (side, side), interpolation=cv2.INTER_LINEAR) for one in logits[0]])
    full = full[:, : part.shape[0], : part.shape[1]]
    best = full.argmax(axis=0)
    with np.errstate(over="ignore", invalid="ignore"):
        score = 1.0 / np.exp(full - full.max(axis=0)).sum(axis=0)
    return best, np.nan_to_num(score.astype(np.float32), nan=0.0)

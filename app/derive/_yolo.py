"""Models of the YOLO family: boxes, and masks if the model has them.

Input is a tile of the image as float32 [1, 3, side, side], RGB from 0 to 1, the last tiles padded. Output are boxes [1,
4 + classes (+ mask coefficients), n] (YOLOv8 and later) or [1, n, 5 + classes (+ coefficients)] (YOLOv5, with
objectness), with either axis order, centre and size in pixels; segmentation models also output mask prototypes [1,
coefficients, h, w].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.derive import DerivationNotes
from app.derive._onnx import Array, LoadedModel, ModelFiles, classes, input_side, starts
from app.derive._pictures import GroundImage
from app.derive._regions import way_attributes
from app.derive._segments import Region, Segments
from app.errors import CannotConvert

SIDE = 640
"""Default side of a tile in pixels, for models that accept any size."""

MIN_DUPLICATE_OVERLAP = 0.5
"""Minimum intersection over union of duplicate boxes of one class."""

MIN_CONFIDENCE = 0.25
"""Default minimum confidence of a box."""

PAD = 114 / 255
MAX_DETECTIONS = 20_000


@dataclass(frozen=True, slots=True)
class Detection:
    """One detection: its box (x0, y0, x1, y1) in pixels, its class, its score, and its mask within the box's pixels."""

    box: tuple[float, float, float, float]
    kind: int
    score: float
    mask: NDArray[np.bool_] | None


@dataclass(frozen=True, slots=True)
class Model:
    """Loaded model. classes: kind of each class, or None. side: pixels of a tile."""

    file: LoadedModel
    name: str
    classes: tuple[str | None, ...]
    side: int


def check_model(supplied: ModelFiles, file: LoadedModel) -> Model:
    """Return a loaded file as a YOLO model. Raises CannotConvert, which states the expected input."""
    side = input_side(supplied, file, "is not of the YOLO family", SIDE)
    return Model(file, supplied.name, classes(supplied, file.session)[0], side)


def segments(
    ground: GroundImage, model: Model, confidence: float, min_area: float, notes: DerivationNotes, name: str
) -> Segments:
    """Segment an image into a model's detections; of overlapping ones the most confident is on top.

    min_area: square metres.
    """
    detections: list[Detection] = []
    for column in starts(ground.rgb.shape[1], model.side):
        for row in starts(ground.rgb.shape[0], model.side):
            detections += _tile(ground.rgb, row, column, model, confidence)
    remaining = _drop_duplicates(detections)
    if not remaining:
        raise CannotConvert(
            f"{name}: the model {model.name} finds nothing with a confidence of at least {confidence:g}: lower it"
        )
    label = np.zeros(ground.valid.shape, np.int32)
    regions: list[Region] = []
    other = small = 0
    height, width = len(label), len(label[0])
    for one in remaining:
        kind = model.classes[one.kind]
        if kind is None:
            other += 1
            continue
        x0, y0 = (max(0, int(v)) for v in one.box[:2])
        x1, y1 = min(width, int(np.ceil(one.box[2]))), min(height, int(np.ceil(one.box[3])))
        window = label[y0:y1, x0:x1]
        mask = np.ones(window.shape, bool) if one.mask is None else one.mask[: window.shape[0], : window.shape[1]]
        mask = mask & (window == 0) & ground.valid[y0:y1, x0:x1]
        area = int(mask.sum()) * ground.resolution**2
        if area <= 0 or area < min_area:
            small += 1
            continue
        attributes = {"area": round(area, 2), "model": model.name, **way_attributes(kind, mask, ground.resolution)}
        regions.append(Region(kind, round(one.score, 3), attributes))  # type: ignore[arg-type]
        window[mask] = len(regions)
    notes.drop("detected objects", other, f"{name}: the classes of this model map them to no kind")
    notes.drop(
        "detected objects",
        small,
        f"{name}: smaller than minimum_area={min_area:g} m², or hidden by more confident ones",
    )
    return Segments(label, regions, np.zeros(label.shape, bool))


def _tile(rgb: NDArray[np.uint8], row: int, column: int, model: Model, confidence: float) -> list[Detection]:
    """Return the detections in one tile, in the image's pixels."""
    side = model.side
    part = rgb[row : row + side, column : column + side]
    image = np.full((side, side, 3), PAD, np.float32)
    image[: part.shape[0], : part.shape[1]] = part.astype(np.float32) / np.float32(255)
    feed = {next(iter(model.file.inputs)): image.transpose(2, 0, 1)[None]}
    answer = list(model.file.run(feed).values())
    rows = next((a[0] for a in answer if a.ndim == 3 and a.shape[0] == 1), None)
    masks = next((a[0] for a in answer if a.ndim == 4 and a.shape[0] == 1), None)
    boxes, scores, kinds, weights = _decode_rows(rows, 0 if masks is None else len(masks), model)
    sure = np.flatnonzero(scores >= confidence)
    out = []
    for k in sure[np.argsort(-scores[sure], kind="stable")][:MAX_DETECTIONS].tolist():
        x, y, w, h = (float(v) for v in boxes[k])
        x0, y0, x1, y1 = (min(max(v, 0.0), float(side)) for v in (x - w / 2, y - h / 2, x + w / 2, y + h / 2))
        x1, y1 = min(x1, float(part.shape[1])), min(y1, float(part.shape[0]))
        if x1 - x0 < 1 or y1 - y0 < 1:
            continue
        mask = None if masks is None else _mask(weights[k], masks, side, (x0, y0, x1, y1))
        box = (x0 + column, y0 + row, x1 + column, y1 + row)
        out.append(Detection(box, int(kinds[k]), float(scores[k]), mask))
    return out


def _decode_rows(rows: Array | None, coefficients: int, model: Model) -> tuple[Array, Array, NDArray[np.int64], Array]:
    """Parse a model's first output: (boxes [n, 4], scores [n], classes [n], mask coefficients [n, m])."""
    count = len(model.classes)
    plain, older = 4 + count + coefficients, 5 + count + coefficients
    if rows is not None:
        for table, size in ((rows.T, rows.shape[0]), (rows, rows.shape[1])):
            if size in (plain, older):
                first = 4 if size == plain else 5
                chances = table[:, first : first + count]
                if size == older:
                    chances = chances * table[:, 4:5]
                kinds = chances.argmax(axis=1).astype(np.int64)
                return table[:, :4], chances.max(axis=1), kinds, table[:, first + count :]
    shape = "no table" if rows is None else str(rows.shape)
    raise CannotConvert(
        f"the model {model.name} is not of the YOLO family, or does not have {count} classes: it returns {shape}, "
        f"expected {plain} or {older} values per box"
    )


def _mask(weights: Array, prototypes: Array, side: int, box: tuple[float, float, float, float]) -> NDArray[np.bool_]:
    """Return the mask of a detection within its box."""
    import cv2

    count, h, w = prototypes.shape
    low = (weights @ prototypes.reshape(count, -1)).reshape(h, w)
    full = cv2.resize(np.ascontiguousarray(low, np.float32), (side, side), interpolation=cv2.INTER_LINEAR)
    x0, y0, x1, y1 = int(box[0]), int(box[1]), int(np.ceil(box[2])), int(np.ceil(box[3]))
    return np.asarray(full[y0:y1, x0:x1] > 0.0)  # the sigmoid is above 0.5 if its argument is above 0


def _drop_duplicates(detections: list[Detection]) -> list[Detection]:
    """Non-maximum suppression over all tiles, class by class; highest score first."""
    import cv2

    if not detections:
        return []
    detections = sorted(detections, key=lambda f: (-f.score, f.box))[:MAX_DETECTIONS]
    boxes = [(f.box[0], f.box[1], f.box[2] - f.box[0], f.box[3] - f.box[1]) for f in detections]
    kinds = [f.kind for f in detections]
    indices = cv2.dnn.NMSBoxesBatched(boxes, [f.score for f in detections], kinds, 0.0, MIN_DUPLICATE_OVERLAP)
    return [detections[k] for k in sorted(int(i) for i in np.asarray(indices).ravel())]

"""A segmentation or detection model of the YOLO family in ONNX, whose file the operator supplies.

``NAME.onnx`` lies in the folder ``FLEETMAP_MODELS_DIR``, beside it ``NAME.json`` with the classes in the model's order,
each the kind of object that it becomes, or null where it becomes none; without that file the names in the model's own
metadata (as Ultralytics writes them) count. The picture is cut into overlapping tiles of the model's input size, the
last ones padded; a tile goes in as float32 [1, 3, side, side], RGB from 0 to 1. Out come boxes [1, 4 + classes (+ mask
coefficients), n] (YOLOv8 and later) or [1, n, 5 + classes (+ coefficients)] (YOLOv5, with objectness), either way
round, centre and size in pixels; of a segmentation model also prototypes of masks [1, coefficients, h, w].
"""

from __future__ import annotations

import ast
import importlib
import json
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from app.derive import Notes
from app.derive._pictures import Ground
from app.derive._segments import Kind, Region, Segments
from app.errors import CannotConvert, NotFound

FOLDER = "FLEETMAP_MODELS_DIR"
INSTALL = 'models need onnxruntime, which is not installed: pip install "fleet-map-server[models]"'
KINDS: tuple[str, ...] = get_args(Kind)

OVERLAP = 0.2
"""Share of a tile that the next one shows, too."""

SIDE = 640
"""Pixels of a tile where a model takes any size."""

SAME = 0.5
"""Intersection over union from which on two boxes of one class are one thing."""

PAD = 114 / 255
MOST = 20_000
_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,99}")

Array = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Found:
    """One detection: its box (x0, y0, x1, y1) in pixels, its class, its score, and its mask within the box's pixels."""

    box: tuple[float, float, float, float]
    kind: int
    score: float
    mask: NDArray[np.bool_] | None


@dataclass(frozen=True, slots=True)
class Model:
    """A loaded model. classes: the kind that each class becomes, or None. side: pixels of a tile."""

    session: Any
    name: str
    classes: tuple[str | None, ...]
    side: int


def load(name: str) -> Model:
    """The operator's model of that name. CannotConvert or NotFound say what to supply."""
    folder = os.environ.get(FOLDER, "")
    if not folder:
        raise CannotConvert(f"there are no models: the operator sets {FOLDER} to a folder with {name}.onnx")
    known = sorted(f.stem for f in Path(folder).glob("*.onnx"))
    if not _NAME.fullmatch(name) or name not in known:
        raise NotFound(f"there is no model {name[:100]!r}; there are: {', '.join(known) or 'none'}")
    try:
        runtime = importlib.import_module("onnxruntime")
    except ModuleNotFoundError:
        raise CannotConvert(INSTALL) from None
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1  # sums in one order: the same picture, the same map
    options.log_severity_level = 3
    path = Path(folder) / f"{name}.onnx"
    try:
        session = runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise CannotConvert(f"the model {name} cannot be loaded: {str(error)[:300]}") from error
    inputs = session.get_inputs()
    shape = list(inputs[0].shape)
    if len(inputs) != 1 or inputs[0].type != "tensor(float)" or len(shape) != 4 or shape[1] not in (3, "3"):
        raise CannotConvert(f"the model {name} is not of the YOLO family: its input is not one picture [1, 3, h, w]")
    sizes = [n for n in shape[2:] if isinstance(n, int)]
    if len(set(sizes)) > 1 or any(n < 32 or n > 4096 for n in sizes):
        raise CannotConvert(f"the model {name} takes pictures of {shape[2]} × {shape[3]}: square ones are needed")
    return Model(session, name, _classes(path.with_suffix(".json"), session, name), sizes[0] if sizes else SIDE)


def _classes(file: Path, session: Any, name: str) -> tuple[str | None, ...]:
    said: Any
    try:
        if file.is_file():
            said = json.loads(file.read_text("utf-8"))
        else:
            said = ast.literal_eval(session.get_modelmeta().custom_metadata_map.get("names", "None"))
    except (OSError, ValueError, SyntaxError) as error:
        raise CannotConvert(f"the classes of the model {name} cannot be read: {error}") from error
    if isinstance(said, dict):
        said = [said[key] for key in sorted(said, key=int)]
    if not isinstance(said, list) or not said:
        raise CannotConvert(f"the model {name} does not say its classes: put {name}.json beside it, a list of kinds")
    if file.is_file() and not all(kind is None or kind in KINDS for kind in said):
        raise CannotConvert(f"{file.name}: each class must be null or one of {', '.join(KINDS)}")
    kinds = tuple(kind if kind in KINDS else None for kind in said)
    if not any(kinds):
        raise CannotConvert(f"no class of the model {name} is one of {', '.join(KINDS)}: put {name}.json beside it")
    return kinds


def segments(ground: Ground, model: Model, confidence: float, least: float, notes: Notes, name: str) -> Segments:
    """What a model finds in a picture, the surest first where things overlap. least: square metres."""
    found: list[Found] = []
    for column in _starts(ground.rgb.shape[1], model.side):
        for row in _starts(ground.rgb.shape[0], model.side):
            found += _tile(ground.rgb, row, column, model, confidence)
    kept = _without_twice(found)
    if not kept:
        raise CannotConvert(f"{name}: the model {model.name} finds nothing of a confidence of {confidence:g}")
    label = np.zeros(ground.known.shape, np.int32)
    regions: list[Region] = []
    other = small = 0
    height, width = len(label), len(label[0])
    for one in kept:
        kind = model.classes[one.kind]
        if kind is None:
            other += 1
            continue
        x0, y0 = (max(0, int(v)) for v in one.box[:2])
        x1, y1 = min(width, int(np.ceil(one.box[2]))), min(height, int(np.ceil(one.box[3])))
        window = label[y0:y1, x0:x1]
        mask = np.ones(window.shape, bool) if one.mask is None else one.mask[: window.shape[0], : window.shape[1]]
        mask = mask & (window == 0) & ground.known[y0:y1, x0:x1]
        area = int(mask.sum()) * ground.resolution**2
        if area <= 0 or area < least:
            small += 1
            continue
        said = {"area": round(area, 2), "model": model.name}
        regions.append(Region(kind, round(one.score, 3), said))  # type: ignore[arg-type]
        window[mask] = len(regions)
    notes.drop("things", other, f"{name}: of classes that the model's operator gave no kind")
    notes.drop("spots", small, f"{name}: smaller than minimum_area={least:g} m², or hidden by surer ones")
    return Segments(label, regions, np.zeros(label.shape, bool))


def _starts(length: int, side: int) -> list[int]:
    """Where tiles begin along an edge, the last one at its end."""
    if length <= side:
        return [0]
    step = max(1, int(side * (1 - OVERLAP)))
    return sorted({*range(0, length - side, step), length - side})


def _tile(rgb: NDArray[np.uint8], row: int, column: int, model: Model, confidence: float) -> list[Found]:
    """The detections in one tile, in the picture's pixels."""
    side = model.side
    part = rgb[row : row + side, column : column + side]
    image = np.full((side, side, 3), PAD, np.float32)
    image[: part.shape[0], : part.shape[1]] = part.astype(np.float32) / np.float32(255)
    feed = {model.session.get_inputs()[0].name: np.ascontiguousarray(image.transpose(2, 0, 1))[None]}
    try:
        answer = [np.asarray(a, np.float32) for a in model.session.run(None, feed)]
    except Exception as error:
        raise CannotConvert(f"the model {model.name} fails: {str(error)[:300]}") from error
    rows = next((a[0] for a in answer if a.ndim == 3 and a.shape[0] == 1), None)
    masks = next((a[0] for a in answer if a.ndim == 4 and a.shape[0] == 1), None)
    boxes, scores, kinds, weights = _decoded(rows, 0 if masks is None else len(masks), model)
    sure = np.flatnonzero(scores >= confidence)
    out = []
    for k in sure[np.argsort(-scores[sure], kind="stable")][:MOST].tolist():
        x, y, w, h = (float(v) for v in boxes[k])
        x0, y0, x1, y1 = (min(max(v, 0.0), float(side)) for v in (x - w / 2, y - h / 2, x + w / 2, y + h / 2))
        x1, y1 = min(x1, float(part.shape[1])), min(y1, float(part.shape[0]))
        if x1 - x0 < 1 or y1 - y0 < 1:
            continue
        mask = None if masks is None else _mask(weights[k], masks, side, (x0, y0, x1, y1))
        box = (x0 + column, y0 + row, x1 + column, y1 + row)
        out.append(Found(box, int(kinds[k]), float(scores[k]), mask))
    return out


def _decoded(rows: Array | None, coefficients: int, model: Model) -> tuple[Array, Array, NDArray[np.int64], Array]:
    """(boxes [n, 4], scores [n], classes [n], mask coefficients [n, m]) of a model's first output."""
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
        f"the model {model.name} is not of the YOLO family, or has other than {count} classes: it gives {shape}, and "
        f"{plain} or {older} values a box were expected"
    )


def _mask(weights: Array, prototypes: Array, side: int, box: tuple[float, float, float, float]) -> NDArray[np.bool_]:
    """The pixels of a box that belong to the thing."""
    import cv2

    count, h, w = prototypes.shape
    low = (weights @ prototypes.reshape(count, -1)).reshape(h, w)
    full = cv2.resize(np.ascontiguousarray(low, np.float32), (side, side), interpolation=cv2.INTER_LINEAR)
    x0, y0, x1, y1 = int(box[0]), int(box[1]), int(np.ceil(box[2])), int(np.ceil(box[3]))
    return np.asarray(full[y0:y1, x0:x1] > 0.0)  # the sigmoid is above a half where its argument is above 0


def _without_twice(found: list[Found]) -> list[Found]:
    """Non-maximum suppression over all tiles, class by class; the surest first."""
    import cv2

    if not found:
        return []
    found = sorted(found, key=lambda f: (-f.score, f.box))[:MOST]
    boxes = [(f.box[0], f.box[1], f.box[2] - f.box[0], f.box[3] - f.box[1]) for f in found]
    kinds = [f.kind for f in found]
    kept = cv2.dnn.NMSBoxesBatched(boxes, [f.score for f in found], kinds, 0.0, SAME)
    return [found[k] for k in sorted(int(i) for i in np.asarray(kept).ravel())]

"""Segmentation by a model that the operator supplies: detect its family and run it."""

from __future__ import annotations

from app.derive import DerivationNotes, _onnx, _pixels, _sam, _yolo
from app.derive._pictures import GroundImage
from app.derive._segments import Segmentation, Segments
from app.errors import CannotConvert, Invalid, Problem


def segments(ground: GroundImage, how: Segmentation, notes: DerivationNotes, name: str) -> Segments:
    """Segment an image with the model ``how.model``.

    Two files are a model of the Segment-Anything family; one file that outputs a table of boxes is of the YOLO family;
    one that outputs [1, classes, h, w] classifies pixels. Raises CannotConvert, NotFound or TooLarge, which name the
    file to supply, and Invalid for parameters of another family.
    """
    supplied = _onnx.find_model(how.model or "")
    min_area = 1.0 if how.minimum_area is None else how.minimum_area
    if len(supplied.files) == 2:
        model = _sam.check_model(supplied)
        sure = _sam.MIN_SCORE if how.confidence is None else how.confidence
        stable = _sam.MIN_STABILITY if how.stability is None else how.stability
        return _sam.segments(ground, model, sure, stable, how.points or _sam.POINTS, min_area, notes, name)
    problems = [
        Problem(f"applies only to models of the Segment-Anything family, which {how.model} is not", where=word)
        for word in ("points", "stability")
        if getattr(how, word) is not None
    ]
    if problems:
        raise Invalid("; ".join(f"{p.where}: {p.problem}" for p in problems), problems)
    file = _onnx.load_session(supplied.files[0], supplied.name)
    ranks = [len(shape) for _, shape in file.outputs.values()]
    if ranks and ranks[0] == 4 and 3 not in ranks:
        sure = _pixels.MIN_CONFIDENCE if how.confidence is None else how.confidence
        return _pixels.segments(ground, _pixels.check_model(supplied, file), sure, min_area, notes, name)
    if 3 not in ranks:
        raise CannotConvert(
            f"the model {supplied.name} has an unsupported signature {file.signature()}: supply one file [1, 3, h, w] "
            "-> boxes [1, values, n] (YOLO) or -> [1, classes, h, w] (pixel classes), or for Segment-Anything two "
            f"files, {supplied.name}.encoder.onnx and {supplied.name}.decoder.onnx"
        )
    sure = _yolo.MIN_CONFIDENCE if how.confidence is None else how.confidence
    return _yolo.segments(ground, _yolo.check_model(supplied, file), sure, min_area, notes, name)

"""ONNX models supplied by the operator: find, load and run them.

They are in the directory ``FLEETMAP_MODELS_DIR``: ``NAME.onnx``, or for the Segment-Anything family two files,
``NAME.encoder.onnx`` and ``NAME.decoder.onnx`` (``_`` or ``-`` may replace the dot), with ``NAME.json`` beside them if
the model has classes. Together, including external weight files, they have at most ``FLEETMAP_MODELS_MAX_BYTES``.
"""

from __future__ import annotations

import ast
import importlib
import json
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.derive._segments import KINDS
from app.errors import CannotConvert, NotFound, TooLarge
from app.model.names import did_you_mean

FOLDER, LARGEST = "FLEETMAP_MODELS_DIR", "FLEETMAP_MODELS_MAX_BYTES"
MAX_MODEL_BYTES = 2 * 2**30
INSTALL = 'models need onnxruntime, which is not installed: pip install "fleet-map-server[models]"'

OVERLAP = 0.2
"""Share of a tile that overlaps with the next one."""

_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,99}")
_PAIR = re.compile(r"(.+)[._-](encoder|decoder)", re.IGNORECASE)
_TYPES: Mapping[str, type[np.generic]] = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
    "tensor(double)": np.float64,
    "tensor(uint8)": np.uint8,
    "tensor(int32)": np.int32,
    "tensor(int64)": np.int64,
    "tensor(bool)": np.bool_,
}

_NO_MEMORY = ("bad_alloc", "bad allocation", "failed to allocate", "out of memory")
"""Texts by which onnxruntime reports that memory is exhausted."""

Array = NDArray[np.float32]
Shape = list[int | str | None]


@dataclass(frozen=True, slots=True)
class ModelFiles:
    """Model files of the operator. files: the model, or its encoder and its decoder."""

    name: str
    files: tuple[Path, ...]

    @property
    def classes_file(self) -> Path:
        """Path of the file with the model's classes."""
        return self.files[0].with_name(f"{self.name}.json")


@dataclass(frozen=True, slots=True)
class LoadedModel:
    """Loaded model file. inputs, outputs: (type, shape) by name, in the file's order; free sizes are texts or None."""

    session: Any
    name: str
    inputs: Mapping[str, tuple[str, Shape]]
    outputs: Mapping[str, tuple[str, Shape]]

    def run(self, feed: Mapping[str, NDArray[Any]]) -> dict[str, Array]:
        """Run the model and return its outputs by name, as float32. Inputs are cast to the types that it needs.

        Raises CannotConvert if the model fails (for lack of memory, too) or outputs anything but numbers.
        """
        given = {n: np.ascontiguousarray(v, _TYPES.get(self.inputs[n][0], np.float32)) for n, v in feed.items()}
        try:
            answer = self.session.run(list(self.outputs), given)
            arrays = {n: np.asarray(a, np.float32) for n, a in zip(self.outputs, answer, strict=True)}
        except Exception as error:
            reason = str(error)[:300] or type(error).__name__
            hint = ""
            if isinstance(error, MemoryError) or any(word in reason.lower() for word in _NO_MEMORY):
                hint = (
                    ": it needs more memory than a worker may use; export it with a smaller input or in half precision"
                )
            raise CannotConvert(f"the model {self.name} failed: {reason}{hint}") from error
        for output, array in arrays.items():
            if np.isnan(array).any():
                raise CannotConvert(
                    f"the model {self.name} returns values that are not numbers (NaN in {output[:60]}): check its "
                    "normalisation, or export it in float32"
                )
        return arrays

    def signature(self) -> str:
        """Return its inputs and outputs as readable text."""

        def describe(of: Mapping[str, tuple[str, Shape]]) -> str:
            return ", ".join(f"{n[:60]} [{', '.join(str(s)[:20] for s in shape)}]" for n, (_, shape) in of.items())

        return f"({describe(self.inputs)}) → ({describe(self.outputs)})"[:600]


def find_model(name: str) -> ModelFiles:
    """Find a model of the operator by name.

    Raises CannotConvert or NotFound, which name the files to supply, and TooLarge for files above the limit.
    """
    folder = os.environ.get(FOLDER, "")
    if not folder:
        raise CannotConvert(
            f"no models are configured: set {FOLDER} to a directory that contains {name[:100]}.onnx, or "
            f"{name[:100]}.encoder.onnx and {name[:100]}.decoder.onnx"
        )
    models = _list_models(Path(folder))
    if not _NAME.fullmatch(name) or name not in models:
        near = did_you_mean(name, models)
        raise NotFound(f"unknown model {name[:100]!r}{near}; available: {', '.join(models) or 'none'}")
    files = models[name]
    max_bytes = int(os.environ.get(LARGEST) or MAX_MODEL_BYTES)
    stems = {file.stem for file in files}
    beside = (f for f in Path(folder).iterdir() if f.is_file() and any(f.name.startswith(stem) for stem in stems))
    if sum(f.stat().st_size for f in beside) > max_bytes:
        raise TooLarge(f"the files of the model {name} are larger than {max_bytes} bytes: raise {LARGEST}")
    return ModelFiles(name, files)


def _list_models(folder: Path) -> dict[str, tuple[Path, ...]]:
    """List the models of a directory by name, sorted."""
    files = {f.stem: f for f in sorted(folder.glob("*.onnx"))}
    halves: dict[str, dict[str, Path]] = {}
    for stem, file in files.items():
        if half := _PAIR.fullmatch(stem):
            halves.setdefault(half[1], {}).setdefault(half[2].lower(), file)
    pairs = {n: (h["encoder"], h["decoder"]) for n, h in halves.items() if len(h) == 2}
    taken = {f for pair in pairs.values() for f in pair}
    return dict(sorted({**{stem: (f,) for stem, f in files.items() if f not in taken}, **pairs}.items()))


def load_session(file: Path, name: str) -> LoadedModel:
    """Load a file as a session on one thread: a fixed order of sums makes the result reproducible."""
    try:
        runtime = importlib.import_module("onnxruntime")
    except ModuleNotFoundError:
        raise CannotConvert(INSTALL) from None
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    try:
        session = runtime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise CannotConvert(f"the model {name} cannot be loaded: {file.name}: {str(error)[:300]}") from error
    inputs, outputs = (
        {v.name: (v.type, list(v.shape)) for v in values} for values in (session.get_inputs(), session.get_outputs())
    )
    return LoadedModel(session, name, inputs, outputs)


def classes(model: ModelFiles, session: Any) -> tuple[tuple[str | None, ...], Mapping[str, Any]]:
    """Read a model's classes: (the kind of each class, or None; other members of its file).

    The file is a list of kinds, or an object with the list as ``classes``. Without a file, the names in the model's own
    metadata are used (as written by Ultralytics). Raises CannotConvert if there are none.
    """
    file, name = model.classes_file, model.name
    metadata: Any
    more: Mapping[str, Any] = {}
    try:
        if file.is_file():
            metadata = json.loads(file.read_text("utf-8"))
            if isinstance(metadata, dict) and "classes" in metadata:
                more = {key: value for key, value in metadata.items() if key != "classes"}
                metadata = metadata["classes"]
        else:
            metadata = ast.literal_eval(session.get_modelmeta().custom_metadata_map.get("names", "None"))
        if isinstance(metadata, dict):
            metadata = [metadata[key] for key in sorted(metadata, key=int)]
    except (OSError, ValueError, SyntaxError, TypeError) as error:
        raise CannotConvert(f"the classes of the model {name} cannot be read: {error}") from error
    if not isinstance(metadata, list) or not metadata:
        raise CannotConvert(f"the model {name} states no classes: add {name}.json beside it with a list of kinds")
    if file.is_file() and not all(kind is None or kind in KINDS for kind in metadata):
        raise CannotConvert(f"{file.name}: each class must be null or one of {', '.join(KINDS)}")
    kinds = tuple(kind if kind in KINDS else None for kind in metadata)
    if not any(kinds):
        raise CannotConvert(f"no class of the model {name} is one of {', '.join(KINDS)}: add {name}.json beside it")
    return kinds, more


def input_side(model: ModelFiles, file: LoadedModel, reason: str, usual: int) -> int:
    """Return the side in pixels of a model's single input image [1, 3, h, w].

    reason: why the model is unsuitable, for the error. Raises CannotConvert, which states the expected input.
    """
    (kind, shape), *more = file.inputs.values()
    if more or kind != "tensor(float)" or len(shape) != 4 or shape[1] not in (3, "3"):
        raise CannotConvert(
            f"the model {model.name} {reason}: its input must be one image [1, 3, h, w] of floats, got "
            f"{file.signature()}"
        )
    return square(shape[2:], model.name, usual)


def square(shape: Iterable[int | str | None], name: str, usual: int) -> int:
    """Return the side of a model's input images from their height and width. usual: side if the model accepts any."""
    sizes = [n for n in shape if isinstance(n, int)]
    if len(set(sizes)) > 1 or any(n < 32 or n > 4096 for n in sizes):
        raise CannotConvert(
            f"the model {name} has input images of {' × '.join(str(n) for n in shape)} pixels: they must be square, of "
            "32 to 4096 pixels"
        )
    return sizes[0] if sizes else usual


def starts(length: int, side: int) -> list[int]:
    """Return the start of each tile along an edge; the last one ends at the edge's end."""
    if length <= side:
        return [0]
    step = max(1, int(side * (1 - OVERLAP)))
    return sorted({*range(0, length - side, step), length - side})

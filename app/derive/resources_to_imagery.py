"""Floor plans of a building -> imagery, so that a plan alone, before any wall is drawn, is a map."""

from __future__ import annotations

import io
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from app.derive import DerivationNotes, derives
from app.errors import MissingLayer
from app.model.imagery import GeoImage
from app.model.layers import Layers, Part, PartKey

MAX_PIXELS = 2**26
KINDS = ("PNG", "JPEG", "BMP")


@dataclass(frozen=True, slots=True)
class Parameters:
    """No parameters: the building states the positions of its drawings."""


@derives(gives="imagery", needs={"resources", "objects"}, parameters=Parameters, cost=15.0)
def resources_to_imagery(layers: Layers, parameters: Parameters, notes: DerivationNotes) -> Layers:  # noqa: ARG001
    """Floor plans of an Open-RMF building as images in the local frame.

    The building's measurements and fiducials give their positions. Raises MissingLayer if no building refers to an
    uploaded, readable drawing.
    """
    files = layers.resources()
    parts: dict[PartKey, Part] = {}
    for level, name, turn in _drawings(layers):
        if name not in files:
            notes.warn(f"the drawing {name[:200]!r} was not uploaded; the level has no image of it", where=level)
            continue
        pixels = _pixels(files[name], name, level, notes)
        if pixels is None:
            continue
        scale, rotation, x, y = turn
        if scale == 1.0:
            notes.warn("the building has no measurement; a pixel of its drawing counts as a metre", where=level)
        c, s = scale * math.cos(rotation), scale * math.sin(rotation)
        # y of a building's pixels points down: flip it
        picture = GeoImage(pixels, (c, s, x, s, -c, y))
        parts[PartKey("imagery", level, name.rpartition("/")[2].rpartition(".")[0] or "plan")] = picture
    if not parts:
        raise MissingLayer(
            "no building refers to an uploaded floor plan: upload building.yaml with its images, or an image with "
            "a world file, corners or metres_per_pixel"
        )
    return Layers(parts, layers.datum, layers.levels)


def _drawings(layers: Layers) -> Iterator[tuple[str, str, tuple[float, float, float, float]]]:
    """Yield (level, file, [scale, rotation, x, y]) from the buildings' documents."""
    for key, part in layers.vector("objects").items():
        source_document = part.document.get("openrmf")
        if not isinstance(source_document, Mapping):
            continue
        level, turn = source_document.get("level"), source_document.get("transform")
        drawing = level.get("drawing") if isinstance(level, Mapping) else None
        name = drawing.get("filename") if isinstance(drawing, Mapping) else None
        if isinstance(name, str) and name and isinstance(turn, list | tuple) and len(turn) == 4:
            scale, rotation, x, y = (float(v) for v in turn)
            if scale > 0 and all(map(math.isfinite, (scale, rotation, x, y))):
                yield key.level, _find_file(name, layers.resources()), (scale, rotation, x, y)


def _find_file(path: str, files: Mapping[str, bytes]) -> str:
    """Return the stored file of a drawing's name: the exact name, else the first with the same base name."""
    base = path.replace("\\", "/").rpartition("/")[2]
    return path if path in files else next((f for f in sorted(files) if f.rpartition("/")[2] == base), path)


def _pixels(data: bytes, name: str, level: str, notes: DerivationNotes) -> NDArray[np.uint8] | None:
    """Return a drawing's pixels, grey or RGB, with alpha if present; None, with a warning, if it is no image."""
    from PIL import Image

    reason: Any = None
    try:
        with Image.open(io.BytesIO(data), formats=KINDS) as image:
            if image.width * image.height > MAX_PIXELS:
                reason = f"{image.width} × {image.height} pixels; the limit is {MAX_PIXELS}"
            else:
                clear = "transparency" in image.info or "A" in image.getbands()
                grey = image.mode in ("1", "L", "LA")
                mode = ("LA" if clear else "L") if grey else ("RGBA" if clear else "RGB")
                pixels = np.array(image.convert(mode), np.uint8)
                return pixels[..., None] if pixels.ndim == 2 else pixels
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        reason = error
    notes.warn(f"the drawing {name[:200]!r} cannot be read and is dropped: {str(reason)[:200]}", where=level)
    return None

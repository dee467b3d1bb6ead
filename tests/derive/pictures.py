"""Images with known content: a farm from above, and a floor plan. The lower left corner is the origin."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from app.model.imagery import GeoImage

SIZE = 0.1
WIDTH, HEIGHT = 60.0, 40.0
TREES = tuple((x, y) for x in (6.0, 12.0, 18.0, 24.0) for y in (26.0, 31.0, 36.0))
CROWN = 1.8
BUILDING = (36.0, 25.0, 46.0, 33.0)
PATH_WIDTH = 2.0
PATH = ((0.0, 20.0), (60.0, 20.0))
BRANCH = ((30.0, 20.0), (30.0, 40.0))


def _pixel(x: float, y: float) -> tuple[int, int]:
    return round(x / SIZE), round((HEIGHT - y) / SIZE)


def farm(noise: float = 3.0) -> NDArray[np.uint8]:
    """Grass with twelve trees, one building with a red roof, and a path with a branch: uint8 [400, 600, 3]."""
    image = np.full((round(HEIGHT / SIZE), round(WIDTH / SIZE), 3), (110, 150, 80), np.uint8)
    for (x0, y0), (x1, y1) in (PATH, BRANCH):
        half = PATH_WIDTH / 2
        wide, high = (half, 0.0) if x0 == x1 else (0.0, half)
        cv2.rectangle(image, _pixel(x0 - wide, y1 + high), _pixel(x1 + wide, y0 - high), (185, 175, 160), -1)
    for x, y in TREES:
        cv2.circle(image, _pixel(x, y), round(CROWN / SIZE), (35, 75, 35), -1)
    left, bottom, right, top = BUILDING
    cv2.rectangle(image, _pixel(left, top), _pixel(right, bottom), (170, 80, 70), -1)
    shaken = image + np.random.default_rng(1).normal(0.0, noise, image.shape)
    return np.clip(np.round(shaken), 0, 255).astype(np.uint8)


def local(pixels: NDArray[Any], size: float = SIZE, **properties: Any) -> GeoImage:
    """Return an image with its lower left corner at the local origin."""
    shaped = pixels if pixels.ndim == 3 else pixels[..., None]
    return GeoImage(shaped, (size, 0.0, 0.0, 0.0, -size, len(shaped) * size), properties=properties)


def plan() -> NDArray[np.uint8]:
    """A house of 10 × 8 m on paper of 14 × 12 m, 2 cm a pixel: two rooms, doors of 1 m inside and outside, a title."""
    paper = np.full((600, 700), 250, np.uint8)

    def box(x0: float, y0: float, x1: float, y1: float, shade: int = 20) -> None:
        paper[round((12 - y1) / 0.02) : round((12 - y0) / 0.02), round(x0 / 0.02) : round(x1 / 0.02)] = shade

    box(2, 2, 12, 10)
    box(2.2, 2.2, 11.8, 9.8, 250)
    box(7, 2.2, 7.1, 9.8)
    box(7, 5, 7.1, 6, 250)  # the door inside
    box(4, 2, 5, 2.2, 250)  # the door to the outside
    cv2.putText(paper, "HOUSE", (20, 50), cv2.FONT_HERSHEY_SIMPLEX, 1.2, (0,), 3)
    return paper

"""The image in docs shows the generators' results."""

from __future__ import annotations

import numpy as np
from PIL import Image

from app.generate import all_generators
from tests.generate.pictures import SHEET, sheet, sites


def test_picture_shows_what_generators_make() -> None:
    drawn, kept = np.array(sheet().convert("RGB")), np.array(Image.open(SHEET).convert("RGB"))
    assert kept.shape == drawn.shape, "draw it again: python -m tests.generate.pictures"
    # Fonts and palettes may differ between releases of Pillow; sites that have changed differ by far more.
    assert np.abs(drawn.astype(int) - kept).mean() < 1.0, "draw it again: python -m tests.generate.pictures"


def test_picture_shows_generators_of_each_kind() -> None:
    assert {"orchard", "office", "town", "warehouse"} <= set(sites()) <= set(all_generators())

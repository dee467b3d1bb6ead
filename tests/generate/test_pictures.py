"""The README's picture shows what the generators make, and its table names them all."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from app.generate import all_generators
from tests.generate.pictures import SHEET, sheet, sites

README = Path(__file__).resolve().parents[2] / "README.md"


def test_the_readme_shows_what_is_made() -> None:
    drawn, kept = np.array(sheet().convert("RGB")), np.array(Image.open(SHEET).convert("RGB"))
    assert kept.shape == drawn.shape, "draw it anew: python -m tests.generate.pictures"
    # Fonts and palettes may differ between releases of Pillow; sites that have changed differ by far more.
    assert np.abs(drawn.astype(int) - kept).mean() < 1.0, "draw it anew: python -m tests.generate.pictures"


def test_every_generator_stands_in_the_readme() -> None:
    text = README.read_text()
    for name in all_generators():
        assert f"`{name}`" in text, f"the README does not mention the generator {name}"
    assert {"orchard", "office", "town", "warehouse"} <= set(sites())

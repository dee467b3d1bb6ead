"""Image of all sites in docs: ``python -m tests.generate.pictures`` draws it again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import shapely
from PIL import Image, ImageDraw

from app import generate
from app.derive import DerivationNotes
from app.model.features import Features
from app.model.imagery import GeoImage, display_pixels
from app.model.layers import Layers

SHEET = Path(__file__).resolve().parents[2] / "docs" / "images" / "sites.png"
SEED = 7
TILE = (300, 220)
COLUMNS = 4
EDGE, INK, PAPER = (38, 84, 180), (40, 40, 44), (255, 255, 255)


def sites() -> list[str]:
    """The generators that make a whole site."""
    return [name for name, one in generate.all_generators().items() if not one.needs and "imagery" in one.gives]


def tile(name: str) -> Image.Image:
    """A site from above, its lowest level, with the network's edges."""
    layers = generate.run(name, SEED, {}, Layers(), DerivationNotes())
    key, picture = next(iter(layers.parts_of("imagery").items()))
    assert isinstance(picture, GeoImage)
    image = Image.fromarray(np.ascontiguousarray(display_pixels(picture)[..., :3]))
    scale = min(TILE[0] / image.width, TILE[1] / image.height)
    image = image.resize((round(image.width * scale), round(image.height * scale)), Image.Resampling.BOX)
    pen = ImageDraw.Draw(image)
    a, _, c, _, e, f = picture.transform
    for part in layers.vector("topology", key.level).values():
        edges: Features = part.select_kinds("edge")
        for line in edges.in_local(layers.frame):
            xy = shapely.get_coordinates(line)
            at = np.column_stack([(xy[:, 0] - c) / a, (xy[:, 1] - f) / e]) * scale
            pen.line([tuple(p) for p in np.round(at).astype(int).tolist()], fill=EDGE)
    return image


def sheet() -> Image.Image:
    """All sites, each under its name."""
    names = sites()
    rows = -(-len(names) // COLUMNS)
    width, height = TILE[0] + 12, TILE[1] + 26
    out = Image.new("RGB", (COLUMNS * width, rows * height), PAPER)
    pen = ImageDraw.Draw(out)
    for k, name in enumerate(names):
        x, y = k % COLUMNS * width + 6, k // COLUMNS * height + 4
        image = tile(name)
        out.paste(image, (x, y))
        pen.text((x, y + TILE[1] + 4), name, fill=INK)
    return out.quantize(96, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)


if __name__ == "__main__":
    sheet().save(SHEET, optimize=True)
    print(f"wrote {SHEET} ({SHEET.stat().st_size} bytes)")

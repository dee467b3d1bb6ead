"""Plants as solids, and the meshes that they share."""

from __future__ import annotations

import math
import struct
from functools import cache
from typing import Any

import numpy as np
import shapely

from app.generate._field import Field, between
from app.generate._shapes import disc, mm
from app.generate._site import Site, rgb

CROWN = "models/crown/meshes/crown.stl"
CROWNS = ("crown", "crown_light", "crown", "crown_dark")

MAX_TREES = 40_000
"""Maximum number of trees: a trunk and a crown have 144 triangles, and a derivation reads ten million."""

MAX_PLANTS = 50_000
MISSING_BESIDE = 0.3
"""Share of the places beside a missing plant that are empty too: diseases and machines take neighbours."""

MAX_PER_ROW = 9_000
"""Maximum number of solids of one object; ``app.model.solids`` reads 10 000."""


@cache
def crown_mesh() -> bytes:
    """Ball of radius 1 with 80 sides, as binary STL: each crown is a scaled one."""
    g = (1 + math.sqrt(5)) / 2
    corners = np.array(
        [(a * s, b * t, 0.0) for a, b in ((1.0, g),) for s in (-1, 1) for t in (-1, 1)]
        + [(0.0, a * s, b * t) for a, b in ((1.0, g),) for s in (-1, 1) for t in (-1, 1)]
        + [(b * t, 0.0, a * s) for a, b in ((1.0, g),) for s in (-1, 1) for t in (-1, 1)]
    )
    corners /= math.sqrt(1 + g * g)
    side = 2 / math.sqrt(1 + g * g)
    n = range(12)
    near = np.abs(np.linalg.norm(corners[:, None] - corners[None], axis=2) - side) < 1e-6
    faces = [(i, j, k) for i in n for j in n if j > i and near[i, j] for k in n if k > j and near[i, k] and near[j, k]]
    out = []
    for face in faces:
        a, b, c = (corners[k] for k in face)
        ab, bc, ca = (m / np.linalg.norm(m) for m in (a + b, b + c, c + a))
        out += [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    rows = []
    for triangle in np.round(np.array(out), 6) + 0.0:
        a, b, c = triangle
        if np.dot(np.cross(b - a, c - a), a + b + c) < 0:
            b, c = c, b
        normal = np.cross(b - a, c - a)
        normal = np.round(normal / np.linalg.norm(normal), 6) + 0.0
        rows.append(struct.pack("<12fH", *normal, *a, *b, *c, 0))
    return b"crown".ljust(80, b"\0") + struct.pack("<I", len(rows)) + b"".join(rows)


def tree(
    site: Site, i: str, at: tuple[float, float], *, trunk: float, height: float, crown: float, below: float, tint: int
) -> None:
    """Tree: a trunk of a radius, and a crown of a radius from ``below`` to ``height`` metres above the ground."""
    site.files[CROWN] = crown_mesh()
    middle, half = mm((below + height) / 2), mm((height - below) / 2)
    stem = mm(below + half / 2)
    upright = [0.0, 0.0, mm(stem / 2), 0.0, 0.0, 0.0]
    shapes: list[dict[str, Any]] = [
        {"type": "cylinder", "radius": mm(trunk), "length": stem, "pose": upright, "colour": rgb("wood")},
        {
            "type": "mesh",
            "file": CROWN,
            "scale": [mm(crown), mm(crown), half],
            "pose": [0.0, 0.0, middle, 0.0, 0.0, 0.0],
        },
    ]
    site.add_object(
        i,
        "tree",
        shapely.Point(at),
        shapes=shapes,
        pose=(at[0], at[1], 0.0, 0.0),
        colour=CROWNS[tint % len(CROWNS)],
        seen=disc(at[0], at[1], crown),
        width=mm(2 * trunk),
        height=mm(height),
    )


def jitter(stream: np.random.Generator, count: int, max_offset: float) -> Any:
    """Draw offsets float64 [n, 2] along and across, up to a maximum in metres, evenly distributed."""
    return np.round((2.0 * stream.random((count, 2)) - 1.0) * max_offset, 3)


def places(
    out: Field, stream: np.random.Generator, step: float, max_offset: float, missing: float = 0.0
) -> list[list[tuple[float, float]]]:
    """Return the positions (u, v) of plants, row by row; none beyond a row's ends. missing: share that is not there."""
    rows = []
    for row in out.rows:
        along = np.array(between(row, step))
        offset = jitter(stream, len(along), max_offset)
        kept = present(stream, len(along), missing)
        u = np.clip(along + offset[:, 0], row.low, row.high)[kept]
        rows.append([(mm(a), mm(row.v + b)) for a, b in zip(u, offset[kept, 1], strict=True)])
    return rows


def present(stream: np.random.Generator, count: int, missing: float) -> Any:
    """Draw which of the plants in a row are there: bool [count]. Beside a missing one others are more often missing.

    The first and the last one of a row are there: people replant at its ends, and a row is as long as it says.
    """
    out = np.ones(count, bool)
    chances = stream.random(count)
    again = max(missing, MISSING_BESIDE) if missing else 0.0
    first = missing * (1.0 - again) / (1.0 - missing)  # so that the share of missing ones is the wanted one
    for k in range(1, count - 1):
        out[k] = chances[k] >= (first if out[k - 1] else again)
    return out

"""The picture of the packages: the layers that import-linter holds, and the two flows through them."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
WRITE = ("api", "ingest", "pool", "upload_reader", "formats", "store", "events", "agent")
READ = ("api", "convert", "store", "derive", "formats")
FLOWS = (
    (
        "#1565c0",
        WRITE,
        "Write: a request is read in a worker process and becomes a version and its event, which robots receive.",
    ),
    ("#2e7d32", READ, "Read: a version is planned, derived and written in the worker processes; the answer is cached."),
)
WIDTH, ROW, GAP, TOP = 900, 44, 10, 16


def layers() -> list[list[str]]:
    """Packages and modules of ``app``, from the top down; each row may import only from rows below it."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    rows = next(c["layers"] for c in contracts if c["type"] == "layers")
    return [re.findall(r"app\.(\w+)", row) for row in rows]


def svg() -> str:
    """The picture."""
    rows = layers()
    missing = {name for _, steps, _ in FLOWS for name in steps}.difference(*rows)
    if missing:
        raise ValueError(f"steps of the flows that are in no row of the picture: {sorted(missing)}")
    height = TOP + len(rows) * (ROW + GAP) + 24 * len(FLOWS) + 24
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" '
        'font-family="sans-serif" font-size="16">',
        f'<rect width="{WIDTH}" height="{height}" rx="8" fill="#ffffff"/>',
    ]
    for k, row in enumerate(rows):
        width = (WIDTH - 2 * TOP - GAP * (len(row) - 1)) / len(row)
        for n, name in enumerate(row):
            x, y = TOP + n * (width + GAP), TOP + k * (ROW + GAP)
            out.append(
                f'<rect x="{x:.1f}" y="{y}" width="{width:.1f}" height="{ROW}" rx="5" fill="#eceff1" stroke="#90a4ae"/>'
                f'<text x="{x + 12:.1f}" y="{y + 28}" fill="#212121">{name}</text>'
            )
            right = x + width - 18
            for colour, steps, _ in reversed(FLOWS):
                if name in steps:
                    out.append(_mark(right, y + ROW / 2, colour, str(steps.index(name) + 1)))
                    right -= 30
    for k, (colour, _, text) in enumerate(FLOWS):
        y = height - 24 * (len(FLOWS) - k) - 4
        out.append(_mark(TOP + 12, y - 5, colour, "1"))
        out.append(f'<text x="{TOP + 32}" y="{y}" fill="#212121">{text}</text>')
    return "\n".join([*out, "</svg>\n"])


def _mark(x: float, y: float, colour: str, text: str) -> str:
    return (
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="11" fill="{colour}"/>'
        f'<text x="{x:.1f}" y="{y + 5:.1f}" fill="#ffffff" font-size="14" text-anchor="middle">{text}</text>'
    )

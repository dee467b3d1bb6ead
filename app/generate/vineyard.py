"""Generator ``vineyard``."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

from app.derive import DerivationNotes
from app.generate import RandomSource, _field, _field_network, _trees, generates
from app.generate._field import Field, Row, RowOptions
from app.generate._shapes import angle, mm, rectangle
from app.generate._site import Site, invalid_option_error, rgb
from app.generate._variety import drawn
from app.model.layers import Layers
from app.parameters import parameter


@dataclass(frozen=True, slots=True)
class Vineyard(RowOptions):
    """Parameters of a vineyard.

    Ranges: rows of Riseholme's vineyard (2.5 m apart) and of a Greek one (3.2 to 4.1 m apart, 22 to 24 m long), and
    planting guides (2 to 3 m, vines 0.9 to 1.8 m).
    """

    rows: int | None = drawn(
        5,
        14,
        "number of vine rows",
        step=1,
        minimum=2,
        maximum=_field.MAX_ROWS,
        fence="as many as fit into the fence",
    )
    row_spacing: float = drawn(
        2.0,
        3.6,
        "distance between rows",
        step=0.05,
        minimum=1.0,
        maximum=10.0,
        unit="m",
        yields="high",
        helps=("headland",),
    )
    vine_spacing: float = drawn(
        0.9,
        1.8,
        "distance between vines in a row",
        step=0.05,
        minimum=0.3,
        maximum=10.0,
        unit="m",
        yields="high",
        measured="plant_spacing",
    )
    jitter: float = parameter(0.05, "maximum random offset of a vine", minimum=0.0, maximum=1.0, unit="m")
    post_spacing: float = drawn(
        4.5, 7.0, "distance between posts of the trellis", step=0.1, minimum=1.0, maximum=30.0, unit="m"
    )
    canopy_width: float = parameter(0.5, "thickness of the leaves on the wires", minimum=0.1, maximum=3.0, unit="m")
    canopy_base: float = parameter(
        0.7, "height of the leaves' lower side above the ground", minimum=0.1, maximum=3.0, unit="m"
    )
    canopy_top: float = parameter(
        1.9, "height of the leaves' upper side above the ground", minimum=0.3, maximum=4.0, unit="m"
    )


@generates(
    {"location", "objects", "occupancy", "topology", "zones", "imagery"},
    parameters=Vineyard,
    also={"location"},
    version=2,
)
def vineyard(given: Layers, options: Vineyard, source: RandomSource, notes: DerivationNotes) -> Layers:
    """Vineyard: vines on trellises with posts and wires that robots cannot pass, headlands, and a yard."""
    if options.canopy_top <= options.canopy_base:
        raise invalid_option_error("canopy_top", "must be above canopy_base")
    site = Site(given, options, notes, coloured=True)
    lines = _field.number_rows(options.rows or _field.MAX_ROWS)
    half = options.canopy_width / 2 + options.jitter
    out = _field.open_field(
        site, options, lines, _field.row_layout(options, options.row_spacing, half), count=options.rows
    )
    vines = sum(int(row.length / options.vine_spacing) + 1 for row in out.rows)
    if vines > _trees.MAX_PLANTS:
        raise invalid_option_error("vine_spacing", f"there would be {vines} vines; the limit is {_trees.MAX_PLANTS}")
    _field.ground(out, field_colour="meadow")
    for row in out.rows:
        _trellis(site, out, row, options)
    size = source.stream("size")
    stood = _trees.places(out, source.stream("places"), options.vine_spacing, options.jitter, options.missing)
    for row, plants in zip(out.rows, stood, strict=True):
        drawn = size.random((len(plants), 3)).tolist()
        for k, ((u, v), chance) in enumerate(zip(plants, drawn, strict=True), 1):
            _vine(site, f"vine{row.name}-{k}", out, (u, v), row, options, chance)
    _field_network.network(out, _field_network.yard(out, options.shed), aisle_speed=0.8, lane_speed=1.2)
    return site.finish(ground="grass")


def _trellis(site: Site, out: Field, row: Row, options: Vineyard) -> None:
    """Add posts with wires between them, and their keep-out zone."""
    site.draw(out.strip(row, options.canopy_width + 0.2), "soil")
    step = row.length / max(1, round(row.length / options.post_spacing))
    shapes: list[dict[str, Any]] = []
    height = options.canopy_top
    posts = [(u, float(out.bend(u) - out.bend(row.low))) for u in _field.between(row, step)]
    for u, v in posts:
        place = [mm(u - row.low), mm(v), mm(height / 2), 0.0, 0.0, 0.0]
        shapes.append({"type": "cylinder", "radius": 0.05, "length": mm(height), "pose": place, "colour": rgb("wood")})
    spans = list(itertools.pairwise(posts)) if out.curve else [(posts[0], posts[-1])]
    for z in (options.canopy_base, (options.canopy_base + options.canopy_top) / 2):
        for (u, v), (p, q) in spans:
            place = [mm((u + p) / 2 - row.low), mm((v + q) / 2), mm(z), 0.0, 0.0, angle(math.atan2(q - v, p - u))]
            size = [mm(math.hypot(p - u, q - v)), 0.01, 0.01]
            shapes.append({"type": "box", "size": size, "pose": place, "colour": rgb("metal")})
    x, y = out.to_local(row.low, row.v)
    members: dict[str, Any] = {"name": f"Row {row.name}", "height": mm(options.canopy_top), "width": 0.1}
    site.add_object(f"trellis{row.name}", "fence", out.line(row), shapes=shapes, pose=(x, y, 0.0, out.yaw), **members)
    site.zone(f"row{row.name}", "keepout", out.strip(row, options.canopy_width), name=f"Row {row.name}")


def _vine(
    site: Site, i: str, out: Field, place: tuple[float, float], row: Row, options: Vineyard, chance: list[float]
) -> None:
    """Add a vine: a trunk, and its leaves on the wires."""
    at = out.to_local(*place)
    low, high = (
        options.canopy_base,
        options.canopy_base + (options.canopy_top - options.canopy_base) * (0.85 + 0.15 * chance[0]),
    )
    wide = options.canopy_width * (0.7 + 0.3 * chance[1])
    along = min(options.vine_spacing, 2 * min(place[0] - row.low, row.high - place[0]) + options.vine_spacing / 2)
    stem = [0.0, 0.0, mm(low / 2), 0.0, 0.0, 0.0]
    across = row.v - place[1]  # the leaves hang on the wires, independent of the trunk's position
    shapes: list[dict[str, Any]] = [
        {"type": "cylinder", "radius": 0.04, "length": mm(low), "pose": stem, "colour": rgb("wood")},
        {
            "type": "box",
            "size": [mm(along), mm(wide), mm(high - low)],
            "pose": [0.0, mm(across), mm((low + high) / 2), 0.0, 0.0, 0.0],
        },
    ]
    x, y = out.to_local(place[0], row.v)
    site.add_object(
        i,
        "plant",
        rectangle(*at, 0.0, 0.08, 0.08),
        shapes=shapes,
        pose=(*at, 0.0, out.heading(place[0])),
        colour=("crown", "crown_light", "leaf")[int(3 * chance[2])],
        seen=rectangle(x, y, out.heading(place[0]), along, wide),
        height=mm(high),
    )

"""Generator ``polytunnels``."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from app.derive import DerivationNotes
from app.generate import RandomSource, _field, _field_network, _trees, generates
from app.generate._field import FarmOptions, Field, Layout, Line, Row
from app.generate._shapes import angle, mm
from app.generate._site import Site, invalid_option_error, rgb
from app.generate._variety import drawn
from app.model.layers import Layers
from app.parameters import parameter

CHORDS = 6
"""Number of straight pieces of an arch."""

MAX_TUNNELS = 60


@dataclass(frozen=True, slots=True)
class Polytunnels(FarmOptions):
    """Parameters of a field of polytunnels.

    Ranges: Riseholme's strawberries (two tunnels of five rows, 1.28 to 1.41 m apart), and tunnels of 6.4 to 8.5 m.
    """

    tunnels: int | None = drawn(
        1,
        4,
        "number of tunnels",
        step=1,
        minimum=1,
        maximum=MAX_TUNNELS,
        fence="as many as fit into the fence",
        measured="tunnels",
    )
    rows_per_tunnel: int = drawn(4, 6, "number of table rows in a tunnel", step=1, minimum=1, maximum=20, yields="low")
    row_spacing: float = drawn(
        1.28,
        1.5,
        "distance between rows, and between outer rows and a tunnel's legs",
        step=0.01,
        minimum=0.8,
        maximum=6.0,
        unit="m",
        yields="high",
        helps=("headland",),
    )
    table_width: float = parameter(
        0.3, "width of the tables that the plants grow on", minimum=0.1, maximum=2.0, unit="m"
    )
    table_height: float = parameter(1.1, "height of the tables' lower side", minimum=0.2, maximum=2.0, unit="m")
    leg_spacing: float = drawn(
        2.0, 3.0, "distance between the legs of a table", step=0.1, minimum=0.5, maximum=10.0, unit="m", yields="high"
    )
    hoop_spacing: float = drawn(
        1.8, 2.5, "distance between the hoops of a tunnel", step=0.1, minimum=0.5, maximum=10.0, unit="m", yields="high"
    )
    tunnel_height: float = parameter(3.6, "height of the hoops", minimum=2.0, maximum=8.0, unit="m")
    side_height: float = parameter(1.8, "height of the hoops' straight legs", minimum=0.5, maximum=4.0, unit="m")


@generates(
    {"location", "objects", "occupancy", "topology", "zones", "imagery"},
    parameters=Polytunnels,
    also={"location"},
    version=2,
)
def polytunnels(given: Layers, options: Polytunnels, source: RandomSource, notes: DerivationNotes) -> Layers:
    """Polytunnels: hoops and covers over rows of tables with strawberries, aisles between them, and a yard."""
    if options.tunnel_height <= options.side_height:
        raise invalid_option_error("tunnel_height", "must be above side_height")
    site = Site(given, options, notes, coloured=True)
    count = options.rows_per_tunnel
    layout = Layout(options.row_spacing, max(options.table_width / 2, 0.04))
    lines = _lines(options.tunnels or MAX_TUNNELS, count)
    out = _field.open_field(site, options, lines, layout, count=len(lines) if options.tunnels else None)
    out.trim_after("legs")
    legs = [row for row in out.rows if row.kind == "legs"]
    if len(legs) < 2:
        raise invalid_option_error(
            "rows_per_tunnel", "the fence has no room for a complete tunnel: make the tunnel smaller"
        )
    if options.tunnels and len(legs) - 1 < options.tunnels:
        notes.drop("tunnels", options.tunnels - len(legs) + 1, "the fence has no room for them")
    parts = sum(row.length / options.hoop_spacing * (CHORDS + 1) for row in legs)
    parts += sum(row.length / options.leg_spacing * 2 for row in out.rows if row.kind == "row")
    if parts > _trees.MAX_PLANTS:
        raise invalid_option_error(
            "hoop_spacing", f"there would be {int(parts)} hoops and legs; the limit is {_trees.MAX_PLANTS}"
        )
    if max(row.length for row in legs) / options.hoop_spacing * CHORDS > _trees.MAX_PER_ROW:
        raise invalid_option_error(
            "hoop_spacing", f"a tunnel would have more than {_trees.MAX_PER_ROW // CHORDS} hoops"
        )
    _field.ground(out, field_colour="grass")
    for k, (low, high) in enumerate(itertools.pairwise(legs), 1):
        site.draw(_cover(out, low, high), "plastic")
        _hoops(site, out, k, low, high, options)
    for row in legs:
        _legs(site, out, row, options)
    stream = source.stream("plants")
    for row in out.rows:
        if row.kind == "row":
            _table(site, out, row, options, stream)
    _field_network.network(out, _field_network.yard(out, options.shed), aisle_speed=0.6, lane_speed=1.0)
    return site.finish(ground="grass")


def _lines(tunnels: int, rows: int) -> list[Line]:
    """Yield the lines of the field: legs, rows, legs, rows …, legs.

    The aisle between row 5 and the legs behind it is r5.3, the one between the legs and row 6 is r5.7, and others are
    half-way, as in Riseholme.
    """
    out = []
    for tunnel in range(tunnels):
        first = tunnel * rows
        out.append(Line("legs", tunnel + 1, f"r{first}.7"))
        out += [Line("row", first + k, f"r{first + k}.{3 if k == rows else 5}") for k in range(1, rows + 1)]
    return [*out, Line("legs", tunnels + 1, "")]


def _cover(out: Field, low: Row, high: Row) -> Any:
    """Return the ground that a tunnel covers."""
    return out.area(max(low.low, high.low), low.v, min(low.high, high.high), high.v)


def _places(low: Row, high: Row, step: float) -> list[float]:
    """Return the positions of hoops that both lines of legs have."""
    both = Row(0, low.v, max(low.low, high.low), min(low.high, high.high), "legs")
    return _field.between(both, step) if both.length > 0 else []


def _legs(site: Site, out: Field, row: Row, options: Polytunnels) -> None:
    """Add the straight posts of a line of hoops, which two tunnels share."""
    h = mm(options.side_height)
    shapes = [
        {"type": "cylinder", "radius": 0.03, "length": h, "pose": [mm(u - row.low), 0.0, mm(h / 2), 0.0, 0.0, 0.0]}
        for u in _field.between(row, options.hoop_spacing)
    ]
    x, y = out.to_local(row.low, row.v)
    site.add_object(
        f"legs{row.number}",
        "post",
        out.line(row),
        shapes=shapes,
        pose=(x, y, 0.0, out.yaw),
        colour="metal",
        seen=out.strip(row, 0.12),
        name=f"Tunnel legs {row.number}",
        width=0.06,
        height=h,
    )


def _hoops(site: Site, out: Field, number: int, low: Row, high: Row, options: Polytunnels) -> None:
    """Add the arches of a tunnel, from leg to leg."""
    half, rise = (high.v - low.v) / 2, options.tunnel_height - options.side_height
    turns = [math.pi * k / CHORDS for k in range(CHORDS + 1)]
    across = [(-half * math.cos(a), options.side_height + rise * math.sin(a)) for a in turns]
    shapes: list[dict[str, Any]] = []
    seen = []
    start = max(low.low, high.low)
    for u in _places(low, high, options.hoop_spacing):
        for (v0, z0), (v1, z1) in itertools.pairwise(across):
            place = [mm(u - start), mm((v0 + v1) / 2), mm((z0 + z1) / 2), angle(math.atan2(v0 - v1, z1 - z0)), 0.0, 0.0]
            shapes.append(
                {"type": "cylinder", "radius": 0.02, "length": mm(math.hypot(v1 - v0, z1 - z0)), "pose": place}
            )
        seen.append(out.area(u - 0.05, low.v, u + 0.05, high.v))
    if not shapes:
        return
    x, y = out.to_local(start, (low.v + high.v) / 2)
    site.add_object(
        f"tunnel{number}",
        "tunnel",
        _cover(out, low, high),
        shapes=shapes,
        pose=(x, y, 0.0, out.yaw),
        colour="metal",
        seen=seen,
        name=f"Tunnel {number}",
        base=mm(options.side_height),
        height=mm(options.tunnel_height),
    )


def _table(site: Site, out: Field, row: Row, options: Polytunnels, stream: np.random.Generator) -> None:
    """Add a row of tables on legs, with plants, and its keep-out zone."""
    width, low, thick = options.table_width, options.table_height, 0.15
    middle = [mm(row.length / 2), 0.0, mm(low + thick / 2), 0.0, 0.0, 0.0]
    shapes: list[dict[str, Any]] = [{"type": "box", "size": [mm(row.length), mm(width), thick], "pose": middle}]
    shapes[0]["colour"] = rgb("plastic")
    for u in _field.between(row, options.leg_spacing):
        place = [mm(u - row.low), 0.0, mm(low / 2), 0.0, 0.0, 0.0]
        shapes.append({"type": "cylinder", "radius": 0.025, "length": mm(low), "pose": place, "colour": rgb("metal")})
    leaves = 0.2 + 0.1 * float(stream.random())
    place = [mm(row.length / 2), 0.0, mm(low + thick + leaves / 2), 0.0, 0.0, 0.0]
    shapes.append({"type": "box", "size": [mm(row.length), mm(width * 0.9), mm(leaves)], "pose": place})
    x, y = out.to_local(row.low, row.v)
    site.add_object(
        f"table{row.number}",
        "table",
        out.strip(row, width),
        shapes=shapes,
        pose=(x, y, 0.0, out.yaw),
        colour=("leaf", "crown_light", "crown")[int(3 * float(stream.random()))],
        name=f"Row {row.number}",
        height=mm(low + thick + leaves),
        base=mm(low),
    )
    site.zone(f"row{row.number}", "keepout", out.strip(row, width), name=f"Row {row.number}")

"""Generator ``orchard``."""

from __future__ import annotations

from dataclasses import dataclass

from app.derive import DerivationNotes
from app.generate import RandomSource, _field, _field_network, _trees, generates
from app.generate._field import RowOptions
from app.generate._site import Site, invalid_option_error
from app.generate._variety import drawn
from app.model.layers import Layers
from app.parameters import parameter


@dataclass(frozen=True, slots=True)
class Orchard(RowOptions):
    """Parameters of an orchard.

    Ranges: intensive and semi-dwarf apples and cherries (Robinson et al., The tall spindle apple production system,
    2006; Ontario Ministry of Agriculture, Orchard design for the new apple orchard).
    """

    rows: int | None = drawn(
        5,
        12,
        "number of tree rows",
        step=1,
        minimum=2,
        maximum=_field.MAX_ROWS,
        fence="as many as fit into the fence",
    )
    row_spacing: float = drawn(
        3.0,
        5.0,
        "distance between rows",
        step=0.05,
        minimum=1.0,
        maximum=30.0,
        unit="m",
        yields="high",
        helps=("headland",),
    )
    tree_spacing: float = drawn(
        1.0,
        2.8,
        "distance between trees in a row",
        step=0.05,
        minimum=0.5,
        maximum=30.0,
        unit="m",
        yields="high",
        measured="plant_spacing",
    )
    jitter: float = parameter(0.1, "maximum random offset of a tree", minimum=0.0, maximum=5.0, unit="m")
    tree_height: float = parameter(3.2, "height of the trees", minimum=1.0, maximum=30.0, unit="m")
    crown_diameter: float = parameter(1.6, "diameter of the trees' crowns", minimum=0.3, maximum=20.0, unit="m")
    trunk_diameter: float = parameter(0.16, "diameter of the trees' trunks", minimum=0.04, maximum=2.0, unit="m")


@generates(
    {"location", "objects", "occupancy", "topology", "zones", "imagery", "resources"},
    parameters=Orchard,
    also={"location"},
    version=2,
)
def orchard(given: Layers, options: Orchard, source: RandomSource, notes: DerivationNotes) -> Layers:
    """Orchard: rows of trees with crowns, headlands, a yard with charging docks, and a network of its aisles."""
    if options.crown_diameter < options.trunk_diameter:
        raise invalid_option_error("crown_diameter", "must be at least trunk_diameter")
    site = Site(given, options, notes, coloured=True)
    lines = _field.number_rows(options.rows or _field.MAX_ROWS)
    half = options.trunk_diameter / 2 + options.jitter
    out = _field.open_field(
        site, options, lines, _field.row_layout(options, options.row_spacing, half), count=options.rows
    )
    trees = sum(int(row.length / options.tree_spacing) + 1 for row in out.rows)
    if trees > _trees.MAX_TREES:
        raise invalid_option_error("tree_spacing", f"there would be {trees} trees; the limit is {_trees.MAX_TREES}")
    _field.ground(out, field_colour="meadow")
    for row in out.rows:
        site.mark(f"row{row.name}", "tree_row", out.line(row), name=f"Row {row.name}")
        site.draw(out.strip(row, min(1.0, options.row_spacing / 2)), "soil")
    size = source.stream("size")
    stood = _trees.places(out, source.stream("places"), options.tree_spacing, options.jitter, options.missing)
    for row, plants in zip(out.rows, stood, strict=True):
        drawn = size.random((len(plants), 3))
        for k, ((u, v), (a, b, c)) in enumerate(zip(plants, drawn.tolist(), strict=True), 1):
            height = options.tree_height * (0.85 + 0.15 * a)
            _trees.tree(
                site,
                f"tree{row.name}-{k}",
                out.to_local(u, v),
                trunk=options.trunk_diameter / 2,
                height=height,
                crown=max(options.trunk_diameter, options.crown_diameter * (0.8 + 0.2 * b)) / 2,
                below=0.25 * height,
                tint=int(4 * c),
            )
    _field_network.network(out, _field_network.yard(out, options.shed), aisle_speed=0.8, lane_speed=1.2)
    return site.finish(ground="grass")

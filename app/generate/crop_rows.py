"""Generator ``crop_rows``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from app.derive import DerivationNotes
from app.generate import RandomSource, _field, _field_network, _trees, generates
from app.generate._field import Row, RowOptions
from app.generate._shapes import disc, mm
from app.generate._site import Site, invalid_option_error
from app.generate._variety import drawn
from app.model.layers import Layers
from app.parameters import parameter


@dataclass(frozen=True, slots=True)
class CropRows(RowOptions):
    """Parameters of a field of crops. Ranges: vegetables on beds of 1.2 to 2 m between wheel tracks."""

    beds: int | None = drawn(
        6,
        14,
        "number of beds",
        step=1,
        minimum=2,
        maximum=_field.MAX_ROWS,
        fence="as many as fit into the fence",
        measured="rows",
    )
    rows_per_bed: int = drawn(2, 4, "number of plant rows in a bed", step=1, minimum=1, maximum=20, yields="low")
    row_spacing: float = drawn(
        0.25, 0.5, "distance between rows in a bed", step=0.01, minimum=0.1, maximum=2.0, unit="m", measured="plant_row"
    )
    aisle: float = drawn(
        1.0,
        1.3,
        "distance from the last row of a bed to the first of the next, where robots drive",
        step=0.02,
        minimum=0.3,
        maximum=10,
        unit="m",
        yields="high",
    )
    plant_spacing: float = drawn(
        0.25,
        0.6,
        "distance between plants in a row",
        step=0.01,
        minimum=0.05,
        maximum=5.0,
        unit="m",
        yields="high",
    )
    jitter: float = parameter(0.03, "maximum random offset of a plant", minimum=0.0, maximum=1.0, unit="m")
    plant_height: float = drawn(0.25, 0.6, "height of the plants", step=0.01, minimum=0.05, maximum=3.0, unit="m")
    plant_diameter: float = parameter(0.24, "diameter of the plants", minimum=0.02, maximum=1.0, unit="m")


@generates(
    {"location", "objects", "occupancy", "topology", "zones", "imagery"},
    parameters=CropRows,
    also={"location"},
    version=2,
)
def crop_rows(given: Layers, options: CropRows, source: RandomSource, notes: DerivationNotes) -> Layers:
    """Field of crops: beds of several rows of plants, wheel tracks between them, headlands, and a yard."""
    site = Site(given, options, notes, coloured=True)
    width = (options.rows_per_bed - 1) * options.row_spacing
    half = width / 2 + options.plant_diameter / 2 + options.jitter
    layout = _field.row_layout(options, width + options.aisle, half, "aisle")
    out = _field.open_field(
        site, options, _field.number_rows(options.beds or _field.MAX_ROWS), layout, count=options.beds
    )
    plants = sum(int(row.length / options.plant_spacing) + 1 for row in out.rows) * options.rows_per_bed
    if plants > _trees.MAX_PLANTS:
        raise invalid_option_error("plant_spacing", f"there would be {plants} plants; the limit is {_trees.MAX_PLANTS}")
    if max(row.length for row in out.rows) / options.plant_spacing > _trees.MAX_PER_ROW:
        raise invalid_option_error("plant_spacing", f"a row would have more than {_trees.MAX_PER_ROW} plants")
    _field.ground(out, field_colour="soil")
    stream = source.stream("plants")
    for bed in out.rows:
        site.draw(out.strip(bed, width + options.plant_diameter + 0.2), "tilled")
        for k in range(options.rows_per_bed):
            v = bed.v - width / 2 + k * options.row_spacing
            row = Row(bed.number, v, bed.low, bed.high, "row", bed.part)
            _row(site, f"bed{bed.name}-{k + 1}", out, row, options, stream)
    _field_network.network(out, _field_network.yard(out, options.shed), aisle_speed=0.8, lane_speed=1.2)
    return site.finish(ground="grass")


def _row(site: Site, i: str, out: _field.Field, row: Row, options: CropRows, stream: np.random.Generator) -> None:
    """Add a row of plants as one object, each plant a block."""
    along = np.array(_field.between(row, options.plant_spacing))
    offset = _trees.jitter(stream, len(along), options.jitter)
    size = 0.75 + 0.25 * stream.random((len(along), 2))
    kept = _trees.present(stream, len(along), options.missing)
    along, offset, size = along[kept], offset[kept], size[kept]
    shapes: list[dict[str, Any]] = []
    seen = []
    for position, (a, b), (c, d) in zip(along.tolist(), offset.tolist(), size.tolist(), strict=True):
        u = min(max(position + a, row.low), row.high)
        side, height = mm(options.plant_diameter * c * 0.8), mm(options.plant_height * d)
        aside = float(out.bend(u) - out.bend(row.low))
        place = [mm(u - row.low), mm(b + aside), mm(height / 2), 0.0, 0.0, 0.0]
        shapes.append({"type": "box", "size": [side, side, height], "pose": place})
        seen.append(disc(*out.to_local(u, row.v + b), options.plant_diameter * c / 2))
    x, y = out.to_local(row.low, row.v)
    site.add_object(
        i,
        "plant",
        out.line(row),
        shapes=shapes,
        pose=(x, y, 0.0, out.yaw),
        colour="leaf",
        seen=seen,
        name=f"Bed {row.name}, row {i.rpartition('-')[2]}",
        width=mm(options.plant_diameter),
        height=mm(options.plant_height),
    )

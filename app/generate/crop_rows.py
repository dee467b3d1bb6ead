"""Generator ``crop_rows``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from app.derive import DerivationNotes
from app.generate import RandomSource, _field, _trees, generates
from app.generate._field import FieldOptions, Row
from app.generate._shapes import disc, mm
from app.generate._site import Site, invalid_option_error
from app.model.layers import Layers
from app.parameters import parameter


@dataclass(frozen=True, slots=True)
class CropRows(FieldOptions):
    """Parameters of a field of crops."""

    beds: int | None = parameter(
        None,
        "number of beds; default: as many as fit into the fence, 10 without one",
        minimum=2,
        maximum=_field.MAX_ROWS,
    )
    rows_per_bed: int = parameter(3, "number of plant rows in a bed", minimum=1, maximum=20)
    row_spacing: float = parameter(0.4, "distance between rows in a bed", minimum=0.1, maximum=2.0, unit="m")
    aisle: float = parameter(
        1.1,
        "distance from the last row of a bed to the first of the next, where robots drive",
        minimum=0.3,
        maximum=10,
        unit="m",
    )
    plant_spacing: float = parameter(0.5, "distance between plants in a row", minimum=0.05, maximum=5.0, unit="m")
    jitter: float = parameter(0.03, "maximum random offset of a plant", minimum=0.0, maximum=1.0, unit="m")
    plant_height: float = parameter(0.4, "height of the plants", minimum=0.05, maximum=3.0, unit="m")
    plant_diameter: float = parameter(0.24, "diameter of the plants", minimum=0.02, maximum=1.0, unit="m")


@generates({"location", "objects", "occupancy", "topology", "zones", "imagery"}, parameters=CropRows, also={"location"})
def crop_rows(given: Layers, options: CropRows, source: RandomSource, notes: DerivationNotes) -> Layers:
    """Field of crops: beds of several rows of plants, wheel tracks between them, headlands, and a yard."""
    site = Site(given, options, notes, coloured=True)
    width = (options.rows_per_bed - 1) * options.row_spacing
    out = _field.open_field(
        site,
        options,
        _field.number_rows(options.beds or _field.MAX_ROWS),
        row_count=None if options.beds else 10,
        spacing=width + options.aisle,
        half=width / 2 + options.plant_diameter / 2 + options.jitter,
        word="aisle",
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
            _row(site, f"bed{bed.number}-{k + 1}", out, Row(bed.number, v, bed.low, bed.high, "row"), options, stream)
    _field.network(out, _field.yard(out), aisle_speed=0.8, lane_speed=1.2)
    return site.finish(ground="grass")


def _row(site: Site, i: str, out: _field.Field, row: Row, options: CropRows, stream: np.random.Generator) -> None:
    """Add a row of plants as one object, each plant a block."""
    along = np.array(_field.between(row, options.plant_spacing))
    offset = _trees.jitter(stream, len(along), options.jitter)
    size = 0.75 + 0.25 * stream.random((len(along), 2))
    shapes: list[dict[str, Any]] = []
    seen = []
    for position, (a, b), (c, d) in zip(along.tolist(), offset.tolist(), size.tolist(), strict=True):
        u = min(max(position + a, row.low), row.high)
        side, height = mm(options.plant_diameter * c * 0.8), mm(options.plant_height * d)
        place = [mm(u - row.low), mm(b), mm(height / 2), 0.0, 0.0, 0.0]
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
        name=f"Bed {row.number}, row {i.rpartition('-')[2]}",
        width=mm(options.plant_diameter),
        height=mm(options.plant_height),
    )

"""Rows as objects: lines with their distance, and the headlands at their ends."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from app.derive import DerivationNotes
from app.derive._rows import MAX_CELL, RowField, find_fields
from app.errors import CannotConvert

ROWS = "rows"
"""Name of the part."""

CLEARER = 1.5
"""Factor by which the rows of a later mask must be clearer."""

Item = tuple[str, Any, dict[str, Any]]


def fields_of(
    masks: Sequence[NDArray[np.bool_]],
    size: float,
    origin: tuple[float, float, float],
    notes: DerivationNotes,
    name: str,
) -> list[RowField]:
    """Return the fields in the mask whose rows are clearest.

    masks: [h, w], row 0 at the bottom, the likeliest first. size: metres of a cell. origin: (x, y, yaw) of the lower
    left corner, in local metres and radians. Raises CannotConvert if no mask has rows.
    """
    if size > MAX_CELL:
        raise CannotConvert(f"{name} has cells of {size:g} m, too coarse for rows: use one of {MAX_CELL:g} m or finer")
    first = [find_fields(mask, size, *origin, limit=1) for mask in masks]
    # where plants are dark, the aisles are bright rows, too: a later mask must be clearly better
    scores = [(fields[0].score if fields else 0.0) / CLEARER**k for k, fields in enumerate(first)]
    clearest = int(np.argmax(scores))
    best = find_fields(masks[clearest], size, *origin) if scores[clearest] else []
    if not best:
        raise CannotConvert(
            f"{name} shows no parallel rows, at least 3 of 5 m or more at regular distances up to 15 m: draw them as "
            "lines of kind row"
        )
    if any(field.regular < 1.0 for field in best):
        notes.warn("some rows are missing, or at irregular distances: review them before robots use them", where=name)
    return best


def row_items(fields: Sequence[RowField], depth: float) -> list[Item]:
    """Return rows and headlands as (id, geometry, properties), in the local frame. depth: of a headland, in metres."""
    out: list[Item] = []
    for number, field in enumerate(fields, 1):
        prefix = f"field-{number}/"
        spacing, yaw = round(field.spacing, 3), round(math.degrees(field.yaw), 2)
        for k, row in enumerate(field.rows, 1):
            line = field.line(row)
            properties = {
                "kind": "row",
                "name": f"Row {k}",
                "field": number,
                "number": k,
                "row_spacing": spacing,
                "direction": yaw,
                "row_width": round(row.width, 3),
                "length": round(row.length, 3),
                "confidence": round(min(0.99, field.regular * (0.5 + 0.5 * row.fill)), 3),
            }
            out.append((f"{prefix}row-{k}", shapely.LineString(line), properties))
        for end, sign in (("first", -1.0), ("second", 1.0)):
            ends_u = [row.low if sign < 0 else row.high for row in field.rows]
            near = [field.to_local(u, row.v) for u, row in zip(ends_u, field.rows, strict=True)]
            far = [field.to_local(u + sign * depth, row.v) for u, row in zip(ends_u, field.rows, strict=True)]
            area = shapely.make_valid(shapely.Polygon([*near, *far[::-1]]))
            properties = {"kind": "headland", "name": f"{end.capitalize()} headland", "field": number, "depth": depth}
            out.append((f"{prefix}headland-{end}", area, properties))
    return out

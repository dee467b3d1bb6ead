"""Assign a drawing's lines and polygons to the layer that they are drawn for."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
import shapely
from numpy.typing import NDArray

from app.errors import Problem
from app.model import network
from app.model.features import Features, Properties
from app.model.frame import Datum
from app.model.geodesy import local_frame
from app.model.layers import NETWORK, SITE, ZONES, Layer, Part, PartKey
from app.upload_reader.bundle import Bundle, EnvironmentContext

_FENCE = re.compile(r"fence|boundary|perimeter", re.IGNORECASE)


SAME_PLACE_DEGREES = 1e-7
"""Tolerance of equal fences, in degrees: about a centimetre."""


def assign_layer(
    parts: dict[PartKey, Part],
    layer: Layer | None,
    level: str,
    context: EnvironmentContext,
    datum: Datum | None,
    file: str,
    bundle: Bundle,
) -> dict[PartKey, Part]:
    """Move a drawing's lines and polygons to the layer that they are drawn for."""
    out = dict(parts)
    for key, part in parts.items():
        if key.layer != "objects" or not isinstance(part, Features) or not len(part):
            continue
        kinds = shapely.get_type_id(part.geometry)
        lines = np.isin(kinds, [1, 2, 5])
        areas = np.isin(kinds, [3, 6])
        if layer == "topology":
            frame = local_frame(datum or context.datum) if datum or context.datum else None
            drawn = part if lines.any() else part.select(areas)
            if not lines.any() and not areas.any():
                bundle.warnings.append(Problem("it has no lines or polygons; no network is created", file))
                continue
            drawn_network = network.from_drawing(drawn, frame=frame, outlines=not lines.any())
            out[PartKey("topology", level, NETWORK)] = drawn_network
        elif layer == "zones":
            _move(out, key, part, areas, PartKey("zones", level, ZONES), "keepout")
        elif layer == "location":
            fence = _is_own_fence(part, key.name, areas, context, bundle, file)
            _move(out, key, part, fence, PartKey("location", level, SITE), "fence")
    return out


def _move(
    parts: dict[PartKey, Part], key: PartKey, part: Features, mask: NDArray[np.bool_], to: PartKey, kind: str
) -> None:
    """Move features from the objects to another layer, with the drawing's collection document."""
    if not mask.any():
        return
    moved = part.select(mask)
    generic = ("region", "path", "poi", None)
    properties = tuple({**p, "kind": kind} if p.get("kind") in generic else p for p in moved.properties)
    parts[to] = Features(moved.ids, moved.geometry, properties, moved.local, part.document)
    if mask.all():
        del parts[key]  # a drawing of zones says nothing of objects, so it does not replace them by none
    else:
        parts[key] = part.select(~mask)


def _is_own_fence(
    part: Features, family: str, areas: NDArray[np.bool_], context: EnvironmentContext, bundle: Bundle, file: str
) -> NDArray[np.bool_]:
    """Find the fence among the polygons: a mask with at most one True.

    That is the polygon at the place of the fence that there is, else the only one, else the one named so. Nothing but
    the first replaces a fence of the same upload: a file of coordinates has it exactly, a drawing shows it.
    """
    indices = np.flatnonzero(areas)
    chosen = np.zeros(len(part), bool)
    fence = bundle.fence or context.fence
    if fence is not None:
        same = [k for k in indices if shapely.hausdorff_distance(part.geometry[k], fence) < SAME_PLACE_DEGREES]
        chosen[same[:1]] = True
        if same or bundle.fence is not None:
            return chosen
    named = [k for k in indices if _FENCE.search(_title(part.properties[k], family))]
    if len(indices) == 1 or len(named) == 1:
        chosen[indices if len(indices) == 1 else named] = True
    elif len(indices):
        bundle.warnings.append(
            Problem("no polygon is named fence; all polygons become regions and no GNSS fence is set", file)
        )
    return chosen


def _title(properties: Properties, family: str) -> str:
    """Return the name of a polygon, and of its layer in a drawing whose polygons have no names (DXF)."""
    details = properties.get(family)
    layer = details.get("layer") if isinstance(details, Mapping) else None
    return f"{properties.get('name') or ''} {layer or ''}"

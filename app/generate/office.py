"""An office building: rooms along a corridor on every level, joined by a lift."""

from __future__ import annotations

import numpy as np

from app.derive import DerivationNotes
from app.generate import RandomSource, _storeys, generates
from app.generate._building import Furniture, Room
from app.generate._storeys import BuildingOptions
from app.model.layers import Layers

CHARGER_ROOMS = ("storage", "copy")
"""Rooms on the ground with a charger for robots."""


@generates(
    {"location", "objects", "occupancy", "topology", "zones", "imagery"},
    also=frozenset({"location"}),
    parameters=BuildingOptions,
)
def office(given: Layers, options: BuildingOptions, source: RandomSource, notes: DerivationNotes) -> Layers:
    """An office building: rooms with doors along corridors, two levels or more with a lift, furniture."""
    return _storeys.build_site(
        given, options, source, notes, _kinds, _FURNISH, lambda k, room: k == 0 and room.kind in CHARGER_ROOMS
    )


def _kinds(level: int, side: int, widths: list[float], chance: np.random.Generator) -> list[str]:
    """Mostly offices; the widest room is for meetings, and one each is a kitchen, for copies and for storage."""
    out = ["office"] * len(widths)
    out[int(np.argmax(widths))] = "meeting"
    rest = [n for n, kind in enumerate(out) if kind == "office"]
    kinds = ("kitchen",) if side > 0 else ("copy", "storage")
    for kind in kinds:
        if len(rest) > 1:
            out[rest.pop(int(chance.integers(0, len(rest))))] = kind
    if level == 0 and side > 0 and rest:
        out[rest[-1]] = "reception"
    return out


def _desks(things: Furniture, room: Room, chance: np.random.Generator) -> None:
    """Desks along the outer wall, a chair at each, and cupboards along a side wall."""
    width = room.box[2] - room.box[0]
    count = int((width - 0.4) / 1.9)
    gap = (width - count * 1.6) / (count + 1) if count else 0.0
    for k in range(count):
        along = gap + 0.8 + k * (1.6 + gap)
        if things.add_item("desk", along, room.depth - 0.5, (1.6, 0.8, 0.74), "furniture", style="desk"):
            shift = 0.4 * (float(chance.random()) - 0.5)
            things.add_item("chair", along + shift, room.depth - 1.3, (0.5, 0.5, 0.9), "goods")
    for k in range(int((room.depth - 2.6) / 1.3)):
        if chance.random() < 0.6:
            things.add_item("cupboard", width - 0.25, 1.0 + 1.3 * k, (0.4, 1.2, 1.8), "wood")


def _meeting(things: Furniture, room: Room, chance: np.random.Generator) -> None:
    """A table in the part of the room that the robot leaves free, with chairs around it."""
    width = room.box[2] - room.box[0]
    depth = max(0.0, min(1.2, 0.3 * room.depth))
    inward = room.depth - 0.9 - depth / 2
    long = width - 1.6
    if long < 0.8 or not things.add_item("table", width / 2, inward, (long, depth, 0.74), "wood", style="table"):
        return
    for k in range(int(long / 0.75)):
        for off in (-0.4 - depth / 2, 0.4 + depth / 2):
            if chance.random() < 0.9:
                things.add_item("chair", 0.8 + 0.375 + 0.75 * k, inward + off, (0.45, 0.45, 0.9), "goods", gap=0.02)


def _kitchen(things: Furniture, room: Room, chance: np.random.Generator) -> None:
    """A counter along the outer wall, a fridge, and a small table."""
    width = room.box[2] - room.box[0]
    things.add_item("counter", (width - 0.8) / 2 + 0.05, room.depth - 0.35, (width - 0.9, 0.6, 0.9), "metal")
    things.add_item("fridge", width - 0.4, room.depth - 0.4, (0.65, 0.65, 1.8), "white")
    side = 0.7 if chance.random() < 0.5 else width - 0.7
    things.add_item("table", side, 1.4, (0.8, 0.8, 0.74), "wood", style="table")


def _copy(things: Furniture, room: Room, chance: np.random.Generator) -> None:
    """Machines along the outer wall."""
    width = room.box[2] - room.box[0]
    for k in range(int(width / 1.4)):
        if chance.random() < 0.8:
            things.add_item("machine", 0.7 + 1.4 * k, room.depth - 0.5, (0.9, 0.7, 1.1), "metal")


def _reception(things: Furniture, room: Room, chance: np.random.Generator) -> None:
    """A counter across, and seats along the outer wall."""
    width = room.box[2] - room.box[0]
    for k in range(int((width - 0.4) / 0.8)):
        if chance.random() < 0.8:
            things.add_item("seat", 0.6 + 0.8 * k, room.depth - 0.4, (0.6, 0.6, 0.8), "goods")
    things.add_item("counter", width - 0.5, room.depth / 2, (0.6, min(2.4, room.depth - 2.0), 1.1), "wood")


_FURNISH = {
    "office": _desks,
    "meeting": _meeting,
    "kitchen": _kitchen,
    "storage": _storeys.put_shelves,
    "copy": _copy,
    "reception": _reception,
}

"""An office building: rooms along a corridor on every level, joined by a lift."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from app.derive import DerivationNotes
from app.generate import RandomSource, _storeys, generates
from app.generate._building import Furniture, Room, Storeys
from app.generate._site import SiteOptions
from app.model.layers import Layers
from app.parameters import parameter

CHARGER_ROOMS = ("storage", "copy")
"""Rooms on the ground with a charger for robots."""


@dataclass(frozen=True, slots=True)
class Options(SiteOptions):
    """How large the building is, and how fine its rooms."""

    levels: int = parameter(2, "levels; from two on a lift joins them", minimum=1, maximum=_storeys.MAX_LEVELS)
    length: float = parameter(32.0, "of the corridor", minimum=4.0, maximum=500.0, unit="m")
    depth: float = parameter(5.5, "of the rooms on each side of it", minimum=2.5, maximum=50.0, unit="m")
    corridor: float = parameter(2.4, "width of the corridor", minimum=1.2, maximum=20.0, unit="m")
    room_width: tuple[float, float] = parameter(
        (3.2, 6.4), "least,most width of a room", minimum=2.0, maximum=100.0, unit="m"
    )
    door_width: float = parameter(1.1, "of the rooms' doors", minimum=0.6, maximum=3.0, unit="m")
    storey_height: float = parameter(3.4, "from floor to floor", minimum=2.0, maximum=20.0, unit="m")
    furniture: bool = parameter(True, "whether there are desks, tables and cupboards")


@generates(
    {"location", "objects", "occupancy", "topology", "zones", "imagery"},
    also=frozenset({"location"}),
    parameters=Options,
)
def office(given: Layers, options: Options, source: RandomSource, notes: DerivationNotes) -> Layers:
    """An office building: rooms with doors along corridors, two levels or more with a lift, furniture."""
    min_width, max_width = options.room_width
    lift = options.levels > 1
    measures = Storeys(
        options.levels, options.length, options.depth, options.corridor, min_width, max_width, options.door_width,
        options.storey_height, lift,
    )  # fmt: skip
    furnish = _furnish if options.furniture else None
    return _storeys.build_site(
        given, options, measures, source, notes, _kinds, furnish, lambda k, room: k == 0 and room.kind in CHARGER_ROOMS
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


def _storage(things: Furniture, room: Room, chance: np.random.Generator) -> None:
    """Shelves along both side walls."""
    width = room.box[2] - room.box[0]
    for k in range(int((room.depth - 0.4) / 1.1)):
        for along in (0.3, width - 0.3):
            if chance.random() < 0.85:
                things.add_item("shelf", along, 0.75 + 1.1 * k, (0.5, 1.0, 2.0), "shelf")


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
    "storage": _storage,
    "copy": _copy,
    "reception": _reception,
}


def _furnish(things: Furniture, room: Room, chance: np.random.Generator) -> None:
    _FURNISH.get(room.kind, _desks)(things, room, chance)

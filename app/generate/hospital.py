"""A hospital ward: patients' rooms along a wide corridor, with a nurse station in its middle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from app.derive import DerivationNotes
from app.generate import RandomSource, _storeys, generates
from app.generate._building import Furniture, Room
from app.generate._storeys import BuildingOptions, redefine
from app.model.layers import Layers


@dataclass(frozen=True, slots=True)
class Options(BuildingOptions):
    """How large the wards are, and how many lie above each other."""

    levels: int = redefine("levels", 1, "wards above each other; from two on a lift joins them")
    length: float = redefine("length", 36.0)
    depth: float = redefine("depth", 6.0)
    corridor: float = redefine("corridor", 3.0)
    room_width: tuple[float, float] = redefine("room_width", (4.0, 6.6))
    door_width: float = redefine("door_width", 1.4)
    storey_height: float = redefine("storey_height", 3.8)
    furniture: bool = redefine("furniture", True, "whether there are beds, cabinets and counters")


@generates(
    {"location", "objects", "occupancy", "topology", "zones", "imagery"},
    also=frozenset({"location"}),
    parameters=Options,
)
def hospital(given: Layers, options: Options, source: RandomSource, notes: DerivationNotes) -> Layers:
    """A hospital ward: rooms with beds, a nurse station and a corridor; several wards are joined by a lift."""
    return _storeys.build_site(given, options, source, notes, _kinds, _FURNISH, lambda _, room: room.kind == "supply")


def _kinds(level: int, side: int, widths: list[float], chance: np.random.Generator) -> list[str]:  # noqa: ARG001
    """Patients' rooms; below the corridor the nurse station in the middle, supplies and treatment beside it."""
    out = ["patients"] * len(widths)
    middle = len(out) // 2
    if side < 0:
        out[middle] = "nurse_station"
        for n, kind in ((middle - 1, "supply"), (middle + 1, "treatment")):
            if 0 <= n < len(out):
                out[n] = kind
    elif len(out) > 2:
        out[int(chance.integers(0, len(out)))] = "lounge"
    return out


def _beds(things: Furniture, room: Room, chance: np.random.Generator) -> None:
    """Beds with their heads at the outer wall, a cabinet beside each, and a wardrobe."""
    width = room.box[2] - room.box[0]
    count = max(1, int((width - 0.6) / 2.0))
    step = width / count
    for k in range(count):
        along = step * (k + 0.5)
        if things.add_item("bed", along, room.depth - 1.1, (0.95, 2.1, 0.6), "white"):
            things.add_item("cabinet", along + 0.8, room.depth - 0.3, (0.45, 0.45, 0.7), "wood")
            if chance.random() < 0.5:
                things.add_item("chair", along - 0.8, room.depth - 1.6, (0.5, 0.5, 0.9), "goods")
    things.add_item("wardrobe", width - 0.35, 0.9, (0.6, 1.2, 2.0), "wood")
    things.add_item("basin", 0.3, 0.9, (0.5, 0.5, 0.9), "metal")


def _station(things: Furniture, room: Room, chance: np.random.Generator) -> None:
    """A counter towards the corridor on both sides of the way in, desks behind it."""
    width, door = room.box[2] - room.box[0], room.door - room.box[0]
    for low, high in ((0.2, door), (door, width - 0.2)):
        keep = things.building.radius + 3 * things.building.site.resolution + 0.2
        start, end = (low, high - keep) if low < door else (low + keep, high)
        if end - start > 0.6:
            things.add_item("counter", (start + end) / 2, 0.5, (end - start, 0.6, 1.1), "furniture")
    for k in range(int((width - 0.4) / 1.9)):
        if things.add_item("desk", 1.1 + 1.9 * k, room.depth - 0.5, (1.6, 0.8, 0.74), "furniture", style="desk"):
            shift = 0.3 * (float(chance.random()) - 0.5)
            things.add_item("chair", 1.1 + 1.9 * k + shift, room.depth - 1.25, (0.5, 0.5, 0.9), "goods")


def _treatment(things: Furniture, room: Room, chance: np.random.Generator) -> None:
    """A couch, cupboards along a wall, a trolley."""
    width = room.box[2] - room.box[0]
    things.add_item("bed", 0.7, room.depth - 1.3, (0.7, 2.0, 0.7), "white")
    for k in range(int((room.depth - 1.0) / 1.3)):
        things.add_item("cupboard", width - 0.3, 0.9 + 1.3 * k, (0.5, 1.2, 1.8), "metal")
    things.add_item("trolley", 1.8 + 0.4 * float(chance.random()), room.depth - 0.6, (0.6, 0.45, 0.9), "metal")


def _lounge(things: Furniture, room: Room, chance: np.random.Generator) -> None:
    """Seats along the outer wall, and a small table."""
    width = room.box[2] - room.box[0]
    for k in range(int((width - 0.4) / 0.8)):
        if chance.random() < 0.85:
            things.add_item("seat", 0.6 + 0.8 * k, room.depth - 0.4, (0.6, 0.6, 0.8), "goods")
    things.add_item("table", 0.8 if chance.random() < 0.5 else width - 0.8, 1.6, (0.8, 0.8, 0.5), "wood", style="table")


_FURNISH = {
    "patients": _beds,
    "nurse_station": _station,
    "supply": _storeys.put_shelves,
    "treatment": _treatment,
    "lounge": _lounge,
}

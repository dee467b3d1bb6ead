"""Reading a site's objects: walls, doors, floors, items on drawings, models and lifts."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import shapely

from app.formats._network import number
from app.formats.rmf import common
from app.formats.rmf.common import BUILDING, Array, mapping, raise_unreadable
from app.formats.rmf.site import vocabulary
from app.formats.rmf.site.source import Source, SourceLevel, SourceLift
from app.formats.rmf.site.vocabulary import NAME, elements, place, reference, references, text
from app.model.features import Properties


class ObjectReader:
    """Reader of the objects of a site's levels: walls, doors, floors, items on drawings, models and lifts."""

    def __init__(self, source: Source) -> None:
        self.source = source

    def _raw_anchor(self, level: SourceLevel, anchor: str) -> Any:
        for home in (level.element.get("anchors"), self.source.top.get("anchors")):
            if isinstance(home, dict) and anchor in home:
                return home[anchor]
        return None

    def read(self, level: SourceLevel) -> list[tuple[str, Any, Properties]]:
        """Return (id, geometry in metres, properties) of each object of the level except lifts."""
        rows: list[tuple[str, Any, Properties]] = []
        for section, kind, category in (
            ("walls", "wall", "Wall"),
            ("doors", "door", "Door"),
            ("floors", "floor", "Floor"),
        ):
            for k, (i, (anchors, element)) in enumerate(self.source.items(level, section)):
                self.source.count_unknown_members(element, section)
                raws = [self._raw_anchor(level, a) for a in anchors]
                if any(raw is None for raw in raws):
                    raise_unreadable(
                        "uses anchors that neither its level nor the site has", f"{level.location}.{section}.{i}"
                    )
                at = np.array([place(raw, category, "anchors")[:2] for raw in raws]).reshape(-1, 2)
                location = f"{level.location}.{section}.{i}"
                p = self._solid(kind, k, element, location)
                members = {key: value for key, value in element.items() if key not in ("anchors", "name")}
                p[NAME] = {"id": int(i), "anchors": [int(a) for a in anchors], "says": members}
                rows.append((self._id(level, kind, i), shapely.LineString(at) if kind != "floor" else _ring(at), p))
        return [*rows, *self._read_drawn(level), *self._models(level)]

    def _id(self, level: SourceLevel, kind: str, i: str) -> str:
        return f"{common.short(level.name, 200)}/{kind}/{i}"

    def _solid(self, kind: str, k: int, element: Mapping[str, Any], location: str) -> dict[str, Any]:
        p: dict[str, Any] = {"kind": kind}
        parameters: dict[str, Any] = {}
        if kind == "door":
            name = text(element.get("name"), f"{location}.name")
            if name:
                p["name"] = name
            parameters = vocabulary.door_parameters(element.get("kind"), f"{location}.kind")
            parameters["name"] = [1, name]
        elif element.get("texture") is not None:
            group = self.source.textures.get(reference(element["texture"], f"{location}.texture"))
            parameters = vocabulary.texture_parameters(group, kind) if group is not None else {}
        if kind != "floor":
            for key, member in (("height", "top"), ("base", "bottom")):
                height = vocabulary.height(element.get(member), f"{location}.{member}")
                if height is not None and height > 0:
                    p[key] = height
        p[BUILDING] = {"index": k, "parameters": parameters}
        return p

    def _read_drawn(self, level: SourceLevel) -> list[tuple[str, Any, Properties]]:
        """Read the measurements and fiducials of a level's drawings, in metres."""
        rows: list[tuple[str, Any, Properties]] = []
        counts: Counter[str] = Counter()
        for i, drawing in elements(level.element.get("drawings"), f"{level.location}.drawings"):
            location = f"{level.location}.drawings.{i}"
            self.source.count_unknown_members(drawing, "drawings")
            transform = self.source.transform(drawing, location)
            anchors = self.source.parse_anchors(drawing.get("anchors"), f"{location}.anchors")
            at = {key: pixels_to_metres(transform, place_) for key, place_ in anchors.items()}

            def places(ids: Sequence[str], path: str, at: Mapping[str, Array] = at) -> list[Array]:
                if any(a not in at for a in ids):
                    raise_unreadable("uses anchors that its drawing does not have", path)
                return [at[a] for a in ids]

            for section, kind in (("measurements", "measurement"), ("fiducials", "fiducial")):
                for key, one in elements(drawing.get(section), f"{location}.{section}"):
                    self.source.count_unknown_members(one, section)
                    item_location = f"{location}.{section}.{key}"
                    p: dict[str, Any] = {"kind": kind, BUILDING: {"index": counts[kind]}}
                    counts[kind] += 1
                    if kind == "measurement":
                        ids = references(one.get("anchors"), f"{item_location}.anchors", 2)
                        geometry = shapely.LineString(places(ids, item_location))
                        distance = one.get("distance")
                        parameters = (
                            {} if distance is None else {"distance": [3, number(distance, f"{item_location}.distance")]}
                        )
                        p[BUILDING]["parameters"] = parameters
                    else:
                        ids = [reference(one.get("anchor"), f"{item_location}.anchor")]
                        geometry = shapely.Point(places(ids, item_location)[0])
                        if one.get("affiliation") is not None:
                            group = self.source.groups.get(
                                reference(one["affiliation"], f"{item_location}.affiliation"), {}
                            )
                            p["name"] = text(group.get("name"), "fiducial_groups")
                    members = {k: v for k, v in one.items() if k not in ("anchor", "anchors")}
                    p[NAME] = {"id": int(key), "drawing": int(i), "anchors": [int(a) for a in ids], "says": members}
                    rows.append((self._id(level, kind, key), geometry, p))
        return rows

    def _models(self, level: SourceLevel) -> list[tuple[str, Any, Properties]]:
        rows: list[tuple[str, Any, Properties]] = []
        for i, element, description in self.source.instances(level):
            if int(i) in self.source.placed_robots:
                continue
            location = f"model_instances.{i}"
            self.source.count_unknown_members(element, "model_instances")
            x, y, z, *turn = vocabulary.pose(element.get("pose"), f"{location}.pose")
            name = text(element.get("name"), f"{location}.name")
            p: dict[str, Any] = {
                "kind": "robot" if str(element.get("description")) in self.source.robots else "model",
                **({"name": name} if name else {}),
                "pose": [x, y, z + level.elevation, *turn],
                BUILDING: {
                    "index": len(rows),
                    "says": {
                        "model_name": model_name(description, location),
                        "static": description.get("is_static") is True,
                    },
                },
                NAME: {"id": int(i), "says": {k: v for k, v in element.items() if k not in ("parent", "name")}},
            }
            rows.append((self._id(level, "model", i), shapely.Point(x, y), p))
        return rows

    def lift_row(self, k: int, lift: SourceLift) -> tuple[str, tuple[str, Any, Properties]]:
        """Return (level, row) of a lift: on its initial level, else on the lowest level that it visits."""
        properties = mapping(lift.element.get("properties"), f"lifts.{lift.id}.properties")
        location = f"lifts.{lift.id}"
        rect = vocabulary.rectangle(properties, location)
        initial = properties.get("initial_level")
        home = None if initial is None else reference(initial, f"{location}.properties.initial_level")
        floors = sorted(lift.visits or self.source.levels, key=lambda i: self.source.levels[i].elevation)
        level = self.source.levels[home if home in self.source.levels else floors[0]]
        doors: dict[str, Any] = {}
        served: dict[str, list[str]] = {self.source.levels[i].name: [] for i in lift.visits}
        door_elements = dict(elements(lift.element.get("cabin_doors"), f"{location}.cabin_doors"))
        for face in vocabulary.FACES:
            door = vocabulary.cabin_door(rect, face, f"{location}.properties.cabin.{face}")
            if door is None:
                continue
            doors[face] = door
            key = reference(rect[face].get("door"), f"{location}.properties.cabin.{face}.door")
            for visit in references(
                door_elements.get(key, {}).get("visits", []), f"{location}.cabin_doors.{key}.visits"
            ):
                if visit in self.source.levels:
                    served[self.source.levels[visit].name].append(face)
        says = {
            "doors": doors,
            "level_doors": served,
            "reference_floor_name": level.name,
            "initial_floor_name": level.name if home is not None else "",
            "lowest_floor": self.source.levels[floors[0]].name,
            "highest_floor": self.source.levels[floors[-1]].name,
            "plugins": properties.get("is_static") is not True,
        }
        cabin = lift.cabin
        members = {
            **lift.element,
            "cabin_anchors": {
                a: raw
                for a, raw in mapping(lift.element.get("cabin_anchors"), location).items()
                if a not in self.source.homes
            },
        }
        p = {
            "kind": "lift",
            "name": lift.name,
            "size": vocabulary.cabin_size(cabin),
            "pose": [cabin.x, cabin.y, level.elevation, 0.0, 0.0, cabin.yaw],
            BUILDING: {"index": k, "says": says},
            NAME: {"id": int(lift.id), "says": members, "was": [*cabin.pose, cabin.depth, cabin.width]},
        }
        return level.id, (self._id(level, "lift", lift.id), shapely.Point(cabin.x, cabin.y), p)


def pixels_to_metres(transform: Sequence[float], at: Sequence[float]) -> Array:
    """Convert a drawing's pixel (y up) to metres."""
    scale, turn, x, y = transform
    c, s = scale * math.cos(turn), scale * math.sin(turn)
    return np.array([c * at[0] - s * at[1] + x, s * at[0] + c * at[1] + y])


def _ring(at: Array) -> Any:
    """Build a polygon, or points if there are too few corners."""
    if not len(at):
        return None
    closed = (at[0] == at[-1]).all()
    return shapely.MultiPoint(at) if len(at) < (4 if closed else 3) else shapely.Polygon(at)


def model_name(description: Mapping[str, Any], location: str) -> str:
    """Return the model's name as a building refers to it."""
    if "source" not in description:
        return ""
    kind, name = vocabulary.asset(description["source"], f"{location}.source")
    if kind == "Search":
        return name
    parts = [part for part in name.split("/") if part and "." not in part]
    return parts[-1] if parts else name

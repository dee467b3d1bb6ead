"""Writing a site's lifts: cabins, their anchors and doors."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from app.formats._network import get_source_properties
from app.formats.rmf import common
from app.formats.rmf.common import BUILDING, mapping
from app.formats.rmf.site import vocabulary
from app.formats.rmf.site.draft import Draft, Floor, Lift, element_ids
from app.formats.rmf.site.vocabulary import SAME_METRES, Cabin
from app.model.features import Properties


class LiftWriter:
    """Writer of lifts and the doors of their cabins."""

    def __init__(self, draft: Draft) -> None:
        self.draft = draft

    def write(self) -> None:
        """Write the lifts of all levels, in the order of their file."""
        lifts = []
        for floor in self.draft.floors:
            for kind, p, geometry, i in self.draft.items(floor):
                if kind != "lift":
                    continue
                if geometry.geom_type != "Point" or geometry.is_empty:
                    self.draft.dropped["lifts without a point"] += 1
                    continue
                at = get_source_properties(p, BUILDING).get("index")
                lifts.append((not isinstance(at, int), at if isinstance(at, int) else 0, i, floor, p, geometry))
        for _, _, i, floor, p, geometry in sorted(lifts, key=lambda item: item[:3]):
            self.draft.lifts.setdefault(str(p.get("name") or i), self._lift(floor, p, geometry, i))

    def _lift(self, floor: Floor, p: Properties, geometry: Any, i: str) -> Lift:
        members = self.draft.source_members(floor, p)
        building = mapping(get_source_properties(p, BUILDING).get("says"), "lift")
        pose = common.object_pose(p)
        yaw = pose[5] if pose is not None else float(building.get("yaw") or 0.0)
        depth, width = common.object_size(p) or (1.0, 1.0)
        lift = dict(mapping(members.get("says"), "lift"))
        was = members.get("was")
        now = [geometry.x, geometry.y, yaw, depth, width]
        self.draft.claimed.update(element_ids(lift))
        cabin_anchors: dict[str, Any] = dict(mapping(lift.get("cabin_anchors"), "cabin_anchors"))
        properties = dict(mapping(lift.get("properties"), "properties"))
        rect = dict(vocabulary.rectangle(properties, "cabin")) if lift else {}
        rect |= {"depth": depth, "width": width}
        cabin_doors = lift.get("cabin_doors")
        if not lift:
            cabin_doors = self._cabin_doors(rect, cabin_anchors, building)
            start = next((f for f in self.draft.floors if f.storey.name == building.get("initial_floor_name")), None)
            properties |= {"is_static": building.get("plugins") is False}
            properties |= {} if start is None else {"initial_level": int(start.id)}
            self.draft.created["lifts"] += BUILDING not in p
        properties |= {"name": str(p.get("name") or i), "cabin": {"Rect": rect}}
        cabin = Cabin(geometry.x, geometry.y, yaw, depth, width, vocabulary.cabin_offset(rect, "cabin"))
        if not isinstance(was, list) or not np.allclose(was, now, rtol=0, atol=SAME_METRES):
            old = properties.get("reference_anchors")
            old = old if isinstance(old, list) and len(old) == 2 else [None, None]
            keys = [str(o) if str(o) in self.draft.anchors else self.draft.claim() for o in old]
            for key, at in zip(keys, cabin.ends(), strict=True):
                self.draft.anchors[key] = vocabulary.anchor_or_source(at, None)
            properties["reference_anchors"] = [int(key) for key in keys]
        element = {
            **lift,
            "cabin_doors": cabin_doors,
            "properties": properties,
            "id": self.draft.claim(members.get("id")),
        }
        return Lift(cabin, element, cabin_anchors)

    def _cabin_doors(
        self, rect: dict[str, Any], anchors: dict[str, Any], building: Mapping[str, Any]
    ) -> dict[str, Any]:
        """Write a building's lift doors; each becomes a placement in ``rect`` with two anchors in the cabin."""
        out: dict[str, Any] = {}
        served = mapping(building.get("level_doors"), "level_doors")
        for name, door in mapping(building.get("doors"), "doors").items():
            face, placement = vocabulary.door_placement(mapping(door, "door"), rect, f"doors.{name}")
            if face in rect:
                self.draft.dropped["further doors on one face of a lift's cabin"] += 1
                continue
            i = self.draft.claim()
            rect[face] = {"door": int(i), **placement}
            ids = [self.draft.claim(), self.draft.claim()]
            anchors |= dict(zip(ids, vocabulary.door_anchors(rect, face), strict=True))
            visits = [int(f.id) for f in self.draft.floors if name in (served.get(f.storey.name) or ())]
            kind: dict[str, Any] = {"DoubleSliding": {"left_right_ratio": 1.0}}
            if door.get("door_type") == 1:
                kind = {"SingleSliding": {"towards": "Left"}}
            out[i] = {"kind": kind, "reference_anchors": [int(a) for a in ids], "visits": sorted(visits)}
        return out

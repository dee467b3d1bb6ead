"""Writing a site's objects: walls, doors and floors on anchors, drawings and the items on them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any

import numpy as np
import shapely

from app.formats._network import get_source_properties
from app.formats.rmf.common import BUILDING, mapping, parameter_value
from app.formats.rmf.images import find_stored_image
from app.formats.rmf.site import vocabulary
from app.formats.rmf.site.draft import Draft, Floor, element_ids, sorted_json, spot_of
from app.formats.rmf.site.model_writing import ModelWriter
from app.formats.rmf.site.vocabulary import SAME_METRES, metres, place
from app.model.features import Properties


class ObjectWriter:
    """Writer of walls, doors and floors, and of drawings with the items on them."""

    def __init__(self, draft: Draft, models: ModelWriter) -> None:
        self.draft, self.models = draft, models

    def write_objects(self, floor: Floor) -> None:
        """Write the level's drawings and objects, except lifts."""
        sections = {"wall": "walls", "door": "doors", "floor": "floors"}
        self._write_drawings(floor)
        for kind, p, geometry, _ in self.draft.items(floor):
            members = self.draft.source_members(floor, p)
            lines = geometry.geom_type == "LineString" and len(geometry.coords) >= 2
            point = geometry.geom_type == "Point" and not geometry.is_empty
            if kind in ("wall", "door") and lines:
                element = {
                    **mapping(members.get("says"), kind),
                    "anchors": self._corner_anchors(floor, p, geometry, kind),
                }
                self._solid(kind, p, element)
                floor.element.setdefault(sections[kind], {})[self.draft.claim(members.get("id"))] = element
                self.draft.dropped["bends of walls and doors"] += len(geometry.coords) > 2
            elif kind == "floor" and not geometry.is_empty:
                self._floors(floor, p, geometry, members)
            elif kind == "measurement" and lines:
                self._measurement(floor, p, geometry, members)
            elif kind == "fiducial" and point:
                self._fiducial(floor, p, geometry, members)
            elif kind in ("model", "robot") and point:
                self.models.write_model(floor, kind, p, geometry, members)
            elif kind != "lift":
                self.draft.dropped["objects that a site cannot contain"] += 1

    def _corner_anchors(self, floor: Floor, p: Properties, geometry: Any, kind: str) -> list[int]:
        """Return the anchors of a line's ends or a ring's corners."""
        at = shapely.get_coordinates(geometry)
        at = at if kind == "floor" else at[[0, -1]]
        hints = self.draft.source_members(floor, p).get("anchors")
        hints = hints if isinstance(hints, list) else []
        if kind == "floor" and geometry.geom_type == "Polygon" and len(at) != len(hints):
            at = at[:-1]  # a polygon repeats its first corner, a floor need not
        hints = hints if len(hints) == len(at) else [None] * len(at)
        return [self._anchor(floor, xy, hint, kind.capitalize()) for xy, hint in zip(at.tolist(), hints, strict=True)]

    def _anchor(self, floor: Floor, xy: Sequence[float], hint: Any, category: str) -> int:
        """Return the anchor at this position: the source anchor, else any of the level, else a new one."""
        key = str(hint)
        for home in (floor.anchors, self.draft.anchors):
            if key in home and _is_near(place(home[key], category, "anchor"), xy):
                return int(key)
        form = mapping(floor.document.get("forms"), "forms").get(key)
        if form is not None and not _is_near(place(form, category, "anchor"), xy):
            form = None
        spot = spot_of(xy)
        if (existing := floor.by_place.get(spot)) is not None and form is None:
            return int(existing)
        anchor = self.draft.claim(hint)
        floor.anchors[anchor] = form or vocabulary.anchor_or_source([*xy, 0.0], None)
        floor.by_place.setdefault(spot, anchor)
        return int(anchor)

    def _solid(self, kind: str, p: Properties, element: dict[str, Any]) -> None:
        """Write a door's kind, a wall's texture, and the heights of both."""
        parameters = mapping(get_source_properties(p, BUILDING).get("parameters"), "parameters")
        if kind == "door":
            element["name"] = str(p.get("name") or parameter_value(parameters, "name") or "")
            was = str(parameter_value(parameters, "type", "hinged"))
            self.draft.dropped["telescope doors, written as sliding ones"] += was.endswith("telescope")
            element["kind"] = vocabulary.door_kind(parameters, element.get("kind"))
        elif "texture" not in element and (group := vocabulary.texture_group(parameters, kind)) is not None:
            element["texture"] = int(self._texture(group))
        for key, member in (("height", "top"), ("base", "bottom")):
            now, source_value = p.get(key), element.get(member)
            fixed = vocabulary.height(source_value, member)
            if isinstance(now, (int, float)) and not isinstance(now, bool) and now > 0 and now != fixed:
                element[member] = {"fixed": float(now)}

    def _texture(self, group: dict[str, Any]) -> str:
        key = sorted_json(group)
        if key not in self.draft.texture_ids:
            self.draft.texture_ids[key] = self.draft.claim()
            self.draft.textures[self.draft.texture_ids[key]] = group
        return self.draft.texture_ids[key]

    def _floors(self, floor: Floor, p: Properties, geometry: Any, members: Mapping[str, Any]) -> None:
        pieces = list(geometry.geoms) if geometry.geom_type == "MultiPolygon" else [geometry]
        for k, piece in enumerate(pieces):
            ring = shapely.Polygon(piece.exterior) if piece.geom_type == "Polygon" else piece
            self.draft.dropped["holes in floors"] += len(getattr(piece, "interiors", ()))
            element = {
                **mapping(members.get("says"), "floor"),
                "anchors": self._corner_anchors(floor, p, ring, "floor"),
            }
            parameters = mapping(get_source_properties(p, BUILDING).get("parameters"), "parameters")
            if "texture" not in element and (group := vocabulary.texture_group(parameters, "floor")) is not None:
                element["texture"] = int(self._texture(group))
            floor.element.setdefault("floors", {})[self.draft.claim(None if k else members.get("id"))] = element

    def _write_drawings(self, floor: Floor) -> None:
        """Write the drawings of the level's source, without the items on them."""
        drawings = {
            i: {**drawing, "anchors": dict(mapping(drawing.get("anchors"), "anchors"))}
            for i, drawing in mapping(floor.document.get("drawings"), "drawings").items()
        }
        self.draft.claimed.update(element_ids({"drawings": drawings}))
        drawing = mapping(mapping(floor.storey.document.get("level"), "level").get("drawing"), "drawing")
        turn = floor.storey.document.get("transform")
        file = drawing.get("filename")
        if (
            not drawings
            and isinstance(file, str)
            and file
            and isinstance(turn, list)
            and len(turn) == 4
            and turn[0] > 0
        ):
            pose = vocabulary.pose_or_source([turn[2], turn[3], 0.0, 0.0, 0.0, turn[1]], None)
            properties = {"name": PurePosixPath(file).stem, "source": {"Local": file}, "pose": pose}
            properties["pixels_per_meter"] = 1.0 / turn[0]
            i = self.draft.claim()
            drawings[i] = {"properties": properties, "transform": list(turn), "anchors": {}}
            floor.element["rankings"] = {"drawings": [int(i)]}
        if drawings:
            floor.element["drawings"] = drawings

    def write_images(self, floor: Floor) -> None:
        """Add the images that drawings name."""
        for i, drawing in mapping(floor.element.get("drawings"), "drawings").items():
            drawing.pop("transform", None)
            location = f"levels.{floor.id}.drawings.{i}.properties.source"
            properties = mapping(drawing.get("properties"), location)
            kind, name = vocabulary.asset(properties.get("source"), location)
            if not name or kind not in ("Local", "Remote"):
                continue
            file = find_stored_image(name, self.draft.resources)
            if file is None:
                problem = f"the image {name[:200]!r} was not uploaded; the map names it but does not contain it"
                self.draft.context.warn(problem, where=location)
                continue
            self.draft.used[file] = self.draft.resources[file]
            if file != name or kind != "Local":
                drawing["properties"] = {**properties, "source": {"Local": file}}

    def _place_on_drawing(
        self, floor: Floor, geometry: Any, members: Mapping[str, Any]
    ) -> tuple[dict[str, Any], list[int]] | None:
        """Return (drawing, anchors on it) for an item with coordinates in drawing pixels."""
        drawings = mapping(floor.element.get("drawings"), "drawings")
        i = str(members.get("drawing"))
        i = i if i in drawings else next(iter(drawings), "")
        if i not in drawings:
            self.draft.dropped["measurements and fiducials of levels without a drawing"] += 1
            return None
        drawing = drawings[i]
        scale, turn, x, y = drawing["transform"]
        c, s = math.cos(turn) / scale, math.sin(turn) / scale
        at = shapely.get_coordinates(geometry) - np.array([x, y])
        pixels = np.column_stack([c * at[:, 0] + s * at[:, 1], -s * at[:, 0] + c * at[:, 1]])
        hints = members.get("anchors")
        hints = hints if isinstance(hints, list) and len(hints) == len(pixels) else [None] * len(pixels)
        ids = []
        for place_, hint in zip(pixels.tolist(), hints, strict=True):
            anchor = {"Translate2D": [metres(v) for v in place_]}
            key = str(hint)
            if key not in drawing["anchors"] or drawing["anchors"][key] != anchor:
                key = self.draft.claim(hint)
                drawing["anchors"][key] = anchor
            ids.append(int(key))
        return drawing, ids

    def _measurement(self, floor: Floor, p: Properties, geometry: Any, members: Mapping[str, Any]) -> None:
        ends = shapely.LineString([geometry.coords[0][:2], geometry.coords[-1][:2]])
        placement = self._place_on_drawing(floor, ends, members)
        if placement is None:
            return
        drawing, anchors = placement
        distance = parameter_value(get_source_properties(p, BUILDING).get("parameters"), "distance")
        length = {} if distance is None else {"distance": distance}
        element = {**mapping(members.get("says"), "measurement"), "anchors": anchors, **length}
        drawing.setdefault("measurements", {})[self.draft.claim(members.get("id"))] = element

    def _fiducial(self, floor: Floor, p: Properties, geometry: Any, members: Mapping[str, Any]) -> None:
        placement = self._place_on_drawing(floor, geometry, members)
        if placement is None:
            return
        drawing, (anchor,) = placement
        element = {**mapping(members.get("says"), "fiducial"), "anchor": anchor}
        name = str(p.get("name") or "")
        if self.draft.groups.get(str(element.get("affiliation")), {}).get("name", "") != name:
            element.pop("affiliation", None)
            if name:
                element["affiliation"] = int(self.draft.group_named(self.draft.groups, self.draft.group_ids, name))
        drawing.setdefault("fiducials", {})[self.draft.claim(members.get("id"))] = element


def _is_near(a: Sequence[float], b: Sequence[float]) -> bool:
    return abs(a[0] - b[0]) < SAME_METRES and abs(a[1] - b[1]) < SAME_METRES

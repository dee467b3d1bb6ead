"""Writing a site's models and robots, their descriptions and scenarios."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any

from app.formats._network import get_source_properties
from app.formats.rmf import common
from app.formats.rmf.common import BUILDING, mapping
from app.formats.rmf.site import vocabulary
from app.formats.rmf.site.draft import Draft, Floor, sorted_json
from app.formats.rmf.site.vocabulary import metres
from app.model.features import Properties


class ModelWriter:
    """Writer of models, robots and the scenarios that contain them."""

    def __init__(self, draft: Draft) -> None:
        self.draft = draft

    def write_model(self, floor: Floor, kind: str, p: Properties, geometry: Any, members: Mapping[str, Any]) -> None:
        """Write an object that is a model or robot."""
        element = mapping(members.get("says"), "model")
        building = mapping(get_source_properties(p, BUILDING).get("says"), "model")
        pose = common.object_pose(p) or [0.0, 0.0, floor.elevation, 0.0, 0.0, float(building.get("yaw") or 0.0)]
        now = [geometry.x, geometry.y, metres(pose[2] - floor.elevation), *pose[3:]]
        name = str(p.get("name") or "")
        static = building.get("static") is True
        self._instance(
            floor, name, now, element, members.get("id"), str(building.get("model_name") or name), static, kind
        )

    def _instance(
        self,
        floor: Floor,
        name: str,
        now: Sequence[float],
        element: Mapping[str, Any],
        hint: Any,
        model: str,
        static: bool,
        kind: str,
    ) -> None:
        """Write a model instance, and its description if the site has none."""
        description = str(element.get("description"))
        if description not in self.draft.descriptions:
            source = element.get("source", {"Search": model})
            is_static = element.get("is_static", static) is True
            description = self._description(source, is_static, element.get("scale"), model, robot=kind == "robot")
        i = self.draft.claim(hint)
        pose = vocabulary.pose_or_source(now, element.get("pose"))
        older = ("source", "is_static", "scale")
        self.draft.instances[i] = {
            **{k: v for k, v in element.items() if k not in older},
            **{"parent": int(floor.id), "name": name, "pose": pose, "description": int(description)},
        }
        if not element or "source" in element:  # old releases have no scenarios, new ones hide models in none
            self.draft.fresh.append(i)
        elif pose != element.get("pose"):
            self.draft.moved[i] = (element.get("pose"), pose)

    def _description(self, source: Any, static: bool, scale: Any, model: str, *, robot: bool) -> str:
        description = {"name": PurePosixPath(model).name or model, "source": source}
        description |= {"is_static": True} if static else {}
        description |= {} if scale is None else {"scale": scale}
        key = sorted_json([description, robot])
        if key not in self.draft.description_ids:
            description_id = self.draft.description_ids[key] = self.draft.claim()
            self.draft.descriptions[description_id] = description
            if robot:
                self.draft.robot_types[description_id] = {"properties": {}}
        return self.draft.description_ids[key]

    def write_robot(
        self, floor: Floor, parameters: Mapping[str, Any], members: Mapping[str, Any], xyz: Sequence[float]
    ) -> None:
        """Write the robot that starts at a node."""
        name, model = parameters.get(common.ROBOT), parameters.get(common.ROBOT_TYPE)
        if not name or not model:
            self.draft.dropped["robots without a name or a type"] += bool(name or model)
            return
        robot = mapping(members.get("robot"), "robot")
        element = mapping(robot.get("says"), "robot") if robot.get("name") == name else {}
        now = [xyz[0], xyz[1], 0.0, 0.0, 0.0, 0.0]
        if element:
            was = vocabulary.pose(element.get("pose"), "robot.pose")
            near = math.dist(was[:2], xyz[:2]) <= 1e-3
            now = was if near else [*xyz[:2], *was[2:]]
        self._instance(floor, str(name), now, element, robot.get("id") if element else None, str(model), False, "robot")

    def scenarios(self, instances: Mapping[str, Any]) -> dict[str, Any]:
        """Return the scenarios without deleted models; new models are added to each root scenario."""
        out: dict[str, Any] = dict(mapping(self.draft.site.get("scenarios"), "scenarios"))
        removed_ids = {str(i) for i in self.draft.site.get("models") or ()} - instances.keys()
        if self.draft.fresh and not out:
            out[self.draft.claim()] = {"instances": {}, "name": "Default Scenario", "parent_scenario": None}
        for i, scenario in out.items():
            modifiers = scenario.get("instances")
            if not isinstance(modifiers, dict) and not self.draft.fresh:
                continue
            listed = {
                k: self._modifier(k, v) for k, v in mapping(modifiers, "instances").items() if k not in removed_ids
            }
            if scenario.get("parent_scenario") is None:
                for k in self.draft.fresh:
                    one = instances[k]
                    listed[k] = {"pose": one["pose"], "inclusion": "Included", "on_level": one["parent"]}
            out[i] = {**scenario, "instances": listed}
        return out

    def _modifier(self, i: str, modifier: Any) -> Any:
        old, new = self.draft.moved.get(i, (None, None))
        moves = isinstance(modifier, dict) and new is not None and modifier.get("pose") == old
        return {**modifier, "pose": new} if moves else modifier

"""Members of Open-RMF sites, and their conversion from and to those of a building (``properties.openrmf``).

A site's elements have integers as ids, unique within the site; an enum's value is ``{"Variant": content}`` or
``"Variant"``. Coordinates are metres; angles are ``{"deg": v}`` or ``{"rad": v}``.

Source: open-rmf/rmf_site, crates/rmf_site_format (site.rs, level.rs, anchor.rs, lane.rs, location.rs, door.rs, lift.rs,
drawing.rs, misc.rs, model.rs, scenario.rs, nav_graph.rs), and its legacy module for buildings.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import orjson

from app.formats._network import number
from app.formats.rmf.common import CABIN_HEIGHT, mapping, parameter_value, raise_unreadable
from app.model.frame import MAX_METRES
from app.syntax import ron

NAME = "rmf_site"
VERSION = "0.1"
UNNAMED = "<Unnamed>"

MEMBERS: Mapping[str, frozenset[str]] = {
    "": frozenset(
        {
            *("format_version", "anchors", "properties", "levels", "textures", "fiducial_groups", "fiducials", "lifts"),
            *("navigation", "scenarios", "model_descriptions", "robots", "model_instances", "tasks", "extensions"),
        }
    ),
    "properties": frozenset(
        {"name", "geographic_offset", "filtered_issues", "filtered_issue_kinds", "extension_settings"}
    ),
    "navigation": frozenset({"guided"}),
    "navigation.guided": frozenset({"graphs", "ranking", "lanes", "locations", "mutex_groups"}),
    "levels": frozenset(
        {
            *("properties", "anchors", "doors", "drawings", "floors", "lights", "physical_cameras", "walls"),
            *("rankings", "user_camera_poses", "models"),
        }
    ),
    "levels.properties": frozenset({"name", "elevation", "global_floor_visibility", "global_drawing_visibility"}),
    "lanes": frozenset({"anchors", "forward", "reverse", "mutex", "graphs"}),
    "locations": frozenset({"anchor", "tags", "name", "mutex", "graphs"}),
    "doors": frozenset({"anchors", "name", "kind", "bottom", "top"}),
    "walls": frozenset({"anchors", "texture", "bottom", "top"}),
    "floors": frozenset({"anchors", "texture", "preferred_semi_transparency"}),
    "drawings": frozenset({"properties", "anchors", "fiducials", "measurements"}),
    "measurements": frozenset({"anchors", "distance"}),
    "fiducials": frozenset({"anchor", "affiliation"}),
    "lifts": frozenset({"cabin_doors", "properties", "cabin_anchors"}),
    "model_instances": frozenset(
        {"parent", "name", "pose", "description", "optional_properties", "source", "is_static", "scale"}
    ),
}
"""Members of each element in rmf_site_format, including older releases. Others are stored with a warning."""

ORDER = {
    word: rank
    for rank, word in enumerate(
        (
            *("format_version", "properties", "trans", "rot", "name", "elevation", "parent", "source", "anchor"),
            *("anchors", "tags", "texture", "forward", "reverse", "mutex", "graphs", "ranking", "lanes", "locations"),
            *("orientation_constraint", "speed_limit", "dock", "kind", "bottom", "top", "pose", "pixels_per_meter"),
            *("fiducials", "measurements", "levels", "textures", "fiducial_groups", "lifts", "navigation"),
        )
    )
}
"""Members in file order; others follow alphabetically, ids by number."""

_SIDES = frozenset({"Left", "Right"})
_GRAPHS = frozenset({"All"})
SHAPE = ron.Shape(
    tuples=frozenset(
        {
            *("trans", "euler_xyz", "quat", "Translate2D", "color", "reference_anchors", "anchor", "scale"),
            *("General", "Floor", "Wall", "Door", "Lift", "Lane", "Location", "ends"),
        }
    ),
    variants=frozenset(
        {
            *("Translate2D", "CategorizedTranslate2D", "Pose3D", "Local", "Remote", "Search", "Package", "Memory"),
            *("SingleSliding", "DoubleSliding", "SingleSwing", "DoubleSwing", "Model", "Forward", "Backward", "Both"),
            *("deg", "rad", "yaw", "euler_xyz", "quat", "fixed", "level_height_ratio", "Rect", "Only", "AllExcept"),
            *("RelativeYaw", "AbsoluteYaw", "Different", "Workcell"),
        }
    ),
    units={
        "towards": _SIDES,
        "pivot_on": _SIDES,
        "graphs": _GRAPHS,
        "reverse": frozenset({"Same", "Disable"}),
        "tags": frozenset({"Charger", "ParkingSpot", "HoldingPoint"}),
        "orientation_constraint": frozenset({"Forwards", "Backwards"}),
        "inclusion": frozenset({"Included", "Hidden"}),
    },
    maps=frozenset({"CategorizedTranslate2D"}),
    free={"robots": 2, "extensions": 1},
)

CABIN_WALL, CABIN_DOOR, CABIN_GAP = 0.1, 0.05, 0.01
"""Default thickness of a cabin's wall and door, and of the gap before the door, in metres."""

SAME_METRES = 1e-9
SINGLE_PRECISION = 1e-6
"""Relative tolerance: the editor stores numbers in single precision."""


# --- values ----------------------------------------------------------------------------------------------------------


def reference(value: Any, location: str) -> str:
    """Check an element id; return it as a key of the element's mapping."""
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**32:
        raise_unreadable("must be an element id, an integer below 2^32", location)
    return str(value)


def references(value: Any, location: str, count: int | None = None) -> list[str]:
    """Check a list of ids. count: required number of ids."""
    if not isinstance(value, list) or (count is not None and len(value) != count):
        raise_unreadable(f"must be a list of {count} ids" if count else "must be a list of ids", location)
    return [reference(v, f"{location}[{k}]") for k, v in enumerate(value)]


def members_by_id(value: Any, location: str) -> list[tuple[str, Any]]:
    """Return the members of a mapping whose keys are ids, sorted by number."""
    members = mapping(value, location)
    for key in members:
        if not key.isascii() or not key.isdigit() or len(key) > 10 or int(key) >= 2**32 or str(int(key)) != key:
            raise_unreadable(f"invalid id {key[:40]!r}: must be an integer below 2^32", location)
    return [(key, members[key]) for key in sorted(members, key=int)]


def elements(value: Any, location: str) -> list[tuple[str, dict[str, Any]]]:
    """Return the elements of a mapping by id, sorted by number; each is a mapping."""
    listed = members_by_id(value, location)
    for key, element in listed:
        if not isinstance(element, dict):
            raise_unreadable("must be a mapping", f"{location}.{key}")
    return listed


def variant(value: Any, location: str) -> tuple[str, Any]:
    """Split an enum's value into (name, content)."""
    if isinstance(value, str):
        return value, None
    if not isinstance(value, dict) or len(value) != 1:
        raise_unreadable('must be a variant: a string or {"Variant": content}', location)
    return next(iter(value.items()))


def vector(value: Any, size: int, location: str) -> list[float]:
    """Check a list of ``size`` numbers."""
    if not isinstance(value, list) or len(value) != size:
        raise_unreadable(f"must be a list of {size} numbers", location)
    out = [number(v, f"{location}[{k}]") for k, v in enumerate(value)]
    if max(map(abs, out)) > MAX_METRES:
        raise_unreadable(f"must be within ±{MAX_METRES:g}", location)
    return out


def text(value: Any, where: str) -> str:
    """Check that a value is text; None becomes an empty text."""
    if value is None:
        return ""
    if not isinstance(value, str):
        raise_unreadable("must be a string", where)
    return value


def angle(value: Any, location: str) -> float:
    """Radians."""
    name, content = variant(value, location)
    if name not in ("deg", "rad"):
        raise_unreadable(f"must be deg or rad, got {name[:40]!r}", location)
    amount = number(content, location)
    if abs(amount) > MAX_METRES:
        raise_unreadable(f"must be within ±{MAX_METRES:g}", location)
    return math.radians(amount) if name == "deg" else amount


def pose(value: Any, location: str) -> list[float]:
    """Parse a pose to [x, y, z, roll, pitch, yaw] in metres and radians."""
    members = mapping(value, location)
    at = vector(members.get("trans"), 3, f"{location}.trans")
    name, content = variant(members.get("rot", {"yaw": {"rad": 0.0}}), f"{location}.rot")
    if name == "yaw":
        return [*at, 0.0, 0.0, angle(content, f"{location}.rot")]
    if name == "euler_xyz":
        if not isinstance(content, list) or len(content) != 3:
            raise_unreadable("must be three angles", f"{location}.rot")
        return [*at, *(angle(v, f"{location}.rot[{k}]") for k, v in enumerate(content))]
    if name != "quat":
        raise_unreadable(f"must be yaw, euler_xyz or quat, got {name[:40]!r}", f"{location}.rot")
    x, y, z, w = vector(content, 4, f"{location}.rot")
    length = x * x + y * y + z * z + w * w
    if not 1e-12 < length < 1e12:
        raise_unreadable("invalid rotation: the quaternion has length 0", f"{location}.rot")
    roll = math.atan2(2 * (w * x + y * z), length - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x) / length)))
    return [*at, roll, pitch, math.atan2(2 * (w * z + x * y), length - 2 * (y * y + z * z))]


def pose_or_source(now: Sequence[float], source_pose: Any) -> dict[str, Any]:
    """Convert a pose to a site's form; an unchanged pose keeps its source form."""
    if isinstance(source_pose, dict):
        was = pose(source_pose, "pose")
        turns = (abs(math.remainder(a - b, math.tau)) for a, b in zip(was[3:], now[3:], strict=True))
        if max(map(abs, np.subtract(was[:3], now[:3]))) < SAME_METRES and max(turns) < SAME_METRES:
            return source_pose
    turn: dict[str, Any] = {"yaw": {"rad": round(now[5], 12) + 0.0}}
    if abs(now[3]) > SAME_METRES or abs(now[4]) > SAME_METRES:
        turn = {"euler_xyz": [{"rad": round(v, 12) + 0.0} for v in now[3:]]}
    return {"trans": [metres(v) for v in now[:3]], "rot": turn}


def metres(value: float) -> float:
    """Round to the precision of metres in all formats."""
    return round(float(value), 9) + 0.0


def place(anchor: Any, category: str, location: str) -> list[float]:
    """Return [x, y, z] of an anchor, for elements of this category."""
    name, content = variant(anchor, location)
    if name == "Translate2D":
        return [*vector(content, 2, location), 0.0]
    if name == "CategorizedTranslate2D":
        members = mapping(content, location)
        return [*vector(members.get(category, members.get("General")), 2, location), 0.0]
    if name != "Pose3D":
        raise_unreadable(f"must be Translate2D, CategorizedTranslate2D or Pose3D, got {name[:40]!r}", location)
    return pose(content, location)[:3]


def anchor_or_source(now: Sequence[float], source_anchor: Any) -> dict[str, Any]:
    """Create the anchor at [x, y, z], or move the source anchor there with all its categories."""
    if not isinstance(source_anchor, dict):
        return {"Translate2D": [metres(now[0]), metres(now[1])]}
    was = place(source_anchor, "General", "anchor")
    name, content = variant(source_anchor, "anchor")
    if max(map(abs, np.subtract(was, now))) < SAME_METRES:
        return source_anchor
    if name == "Pose3D":
        return {name: {**content, "trans": [metres(v) for v in now]}}
    moved = np.subtract(now[:2], was[:2])
    return {name: {key: [metres(v) for v in np.add(at, moved)] for key, at in content.items()}}


def sort_members(value: Any) -> Any:
    """Sort members in the format's order: equal values give equal bytes."""
    if isinstance(value, dict):
        last = len(ORDER)
        key = sorted(value, key=lambda k: (ORDER.get(k, last), len(k) if k.isdigit() else 0, k))
        return {k: sort_members(value[k]) for k in key}
    return list(map(sort_members, value)) if isinstance(value, (list, tuple)) else value


def digest(site: Mapping[str, Any]) -> str:
    """Compute the digest that distinguishes parts of different sites."""
    return hashlib.sha256(orjson.dumps(sort_members(site))).hexdigest()[:16]


def unknown(members: Mapping[str, Any], section: str) -> list[str]:
    """Return the members that no release of the format has."""
    return sorted(members.keys() - MEMBERS[section])


def height(value: Any, location: str) -> float | None:
    """Return the height of a fixed top or bottom in metres, or None."""
    if value is None:
        return None
    name, content = variant(value, location)
    if name not in ("fixed", "level_height_ratio"):
        raise_unreadable(f"must be fixed or level_height_ratio, got {name[:40]!r}", location)
    amount = number(content, location)
    return amount if name == "fixed" else None


# --- doors -----------------------------------------------------------------------------------------------------------

DOORS = ("SingleSliding", "DoubleSliding", "SingleSwing", "DoubleSwing", "Model")


def door_parameters(kind: Any, location: str) -> dict[str, Any]:
    """Convert a door's kind to a building's parameters; a swing to both sides keeps the forward one."""
    name, content = variant(kind, location)
    if name not in DOORS or not isinstance(content, dict):
        raise_unreadable(f"must be one of {', '.join(DOORS)} and its members", location)
    if name == "Model":
        return {}
    members, sliding = content, name.endswith("Sliding")
    out: dict[str, Any] = {"type": [1, ("double_" if name[0] == "D" else "") + ("sliding" if sliding else "hinged")]}
    if name[0] == "D":
        ratio = number(members.get("left_right_ratio", 1.0), f"{location}.left_right_ratio")
        out["right_left_ratio"] = [3, 1.0 / ratio if abs(ratio) > 1e-9 else 1.0]
    if sliding:  # the editor reads a building's sliding door as sliding right
        out["motion_axis"] = [1, "end" if members.get("towards") == "Left" else "start"]
        return out | {"motion_degrees": [3, 90.0], "motion_direction": [2, 1]}
    right = members.get("pivot_on", "Left") == "Right"
    swing, turn = variant(members.get("swing", {"Forward": {"deg": 90.0}}), f"{location}.swing")
    turn = mapping(turn, location).get("forward") if swing == "Both" else turn
    degrees = (
        turn["deg"] if isinstance(turn, dict) and "deg" in turn else math.degrees(angle(turn, f"{location}.swing"))
    )
    forward = swing != "Backward"
    return out | {
        "motion_axis": [1, "end" if right else "start"],
        "motion_degrees": [3, number(degrees, f"{location}.swing")],
        "motion_direction": [2, 1 if forward == right else -1],
    }


def door_kind(parameters: Mapping[str, Any], source_kind: Any) -> dict[str, Any]:
    """Convert a building's door parameters to a site's kind; unchanged parameters keep the source kind."""
    if source_kind is not None:
        was = door_parameters(source_kind, "kind")
        if not was or all(parameter_value(was, k) == parameter_value(parameters, k) for k in was):
            return dict(source_kind)
    kind = str(parameter_value(parameters, "type", "hinged"))
    double = kind.startswith("double_")
    right = parameter_value(parameters, "motion_axis", "start") == "end"
    ratio = parameter_value(parameters, "right_left_ratio", 1.0)
    valid = isinstance(ratio, (int, float)) and not isinstance(ratio, bool) and ratio > 1e-9
    shares = {"left_right_ratio": 1.0 / ratio if valid else 1.0}
    if kind.removeprefix("double_") in ("sliding", "telescope"):
        if double:
            return {"DoubleSliding": shares}
        return {"SingleSliding": {"towards": "Left" if right else "Right"}}
    degrees = parameter_value(parameters, "motion_degrees", 90.0)
    valid = isinstance(degrees, (int, float)) and not isinstance(degrees, bool)
    forward = (parameter_value(parameters, "motion_direction", 1) != -1) == right
    swing = {"Forward" if forward else "Backward": {"deg": float(degrees) if valid else 90.0}}
    if double:
        return {"DoubleSwing": {"swing": swing, **shares}}
    return {"SingleSwing": {"pivot_on": "Right" if right else "Left", "swing": swing}}


# --- lifts -----------------------------------------------------------------------------------------------------------

FACES: Mapping[str, tuple[float, float]] = {
    "front_door": (1.0, 0.0),
    "back_door": (-1.0, 0.0),
    "left_door": (0.0, 1.0),
    "right_door": (0.0, -1.0),
}
"""Directions out of the cabin; a door's positive shift is to the left of its direction."""


def _or(value: Any, default: float, location: str) -> float:
    return default if value is None else number(value, location)


@dataclass(frozen=True, slots=True)
class Cabin:
    """Lift cabin: centre and yaw in the site, inner depth (along x, to the front) and width (along y).

    The reference anchors are in front of it: a gap, half a door and a wall away (``RectangularLiftCabin::aabb``).
    """

    x: float
    y: float
    yaw: float
    depth: float
    width: float
    offset: tuple[float, float]

    def outward(self, at: Sequence[float]) -> tuple[float, float]:
        """Convert a position from the cabin's frame to the site's."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return self.x + c * at[0] - s * at[1], self.y + s * at[0] + c * at[1]

    def inward(self, at: Sequence[float]) -> tuple[float, float]:
        """Convert a position from the site's frame to the cabin's."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        dx, dy = at[0] - self.x, at[1] - self.y
        return c * dx + s * dy, -s * dx + c * dy

    def ends(self) -> list[list[float]]:
        """Return the positions of the left and the right reference anchor."""
        x, y = -self.offset[0], -self.offset[1]
        return [[*self.outward((x, y + side * self.width / 2.0)), 0.0] for side in (1.0, -1.0)]

    @property
    def pose(self) -> list[float]:
        """Return [x, y, yaw] in the site."""
        return [self.x, self.y, self.yaw]


def rectangle(properties: Mapping[str, Any], location: str) -> dict[str, Any]:
    """Return the parameters of a lift's cabin."""
    name, content = variant(properties.get("cabin"), f"{location}.cabin")
    if name != "Rect":
        raise_unreadable(f"must be Rect, got {name[:40]!r}", f"{location}.cabin")
    return mapping(content, f"{location}.cabin")


def cabin_offset(rect: Mapping[str, Any], location: str) -> tuple[float, float]:
    """Return the offset of the cabin's centre from the midpoint of its reference anchors, in metres."""
    front = mapping(rect.get("front_door"), f"{location}.front_door")
    depth = number(rect.get("depth"), f"{location}.depth")
    wall, gap = _or(rect.get("wall_thickness"), CABIN_WALL, location), _or(rect.get("gap"), CABIN_GAP, location)
    door = _or(front.get("thickness"), CABIN_DOOR, location)
    return -depth / 2.0 - wall - gap - door / 2.0, _or(rect.get("shift"), 0.0, location)


def parse_cabin(properties: Mapping[str, Any], left: Sequence[float], right: Sequence[float], location: str) -> Cabin:
    """Build the cabin from its parameters and the positions of its reference anchors."""
    rect = rectangle(properties, location)
    dx, dy = left[0] - right[0], left[1] - right[1]
    yaw = math.atan2(-dx, dy) if dx or dy else 0.0
    x, y = cabin_offset(rect, f"{location}.cabin")
    c, s = math.cos(yaw), math.sin(yaw)
    middle = (left[0] + right[0]) / 2.0, (left[1] + right[1]) / 2.0
    depth, width = (number(rect.get(key), f"{location}.cabin.{key}") for key in ("depth", "width"))
    if depth <= 0 or width <= 0:
        raise_unreadable("must have a depth and a width above 0", f"{location}.cabin")
    return Cabin(middle[0] + c * x - s * y, middle[1] + s * x + c * y, yaw, depth, width, (x, y))


def cabin_door(rect: Mapping[str, Any], face: str, location: str) -> dict[str, Any] | None:
    """Convert the door on this face to a building's lift door, centred in the cabin's frame, or None."""
    door = rect.get(face)
    if door is None:
        return None
    door = mapping(door, location)
    (ux, uy), reach = FACES[face], _reach(rect, face, door, location)
    shift = _or(door.get("shifted"), 0.0, f"{location}.shifted")
    return {
        "door_type": 2,
        "motion_axis_orientation": 0.0 if uy else round(math.pi / 2, 9),
        "width": number(door.get("width"), f"{location}.width"),
        "x": metres(ux * reach - uy * shift),
        "y": metres(uy * reach + ux * shift),
    }


def _reach(rect: Mapping[str, Any], face: str, door: Mapping[str, Any], location: str) -> float:
    """Return the distance from the cabin's centre to the middle of a door's leaf, in metres."""
    half = number(rect.get("depth" if FACES[face][0] else "width"), location) / 2.0
    wall = _or(rect.get("wall_thickness"), CABIN_WALL, location)
    gap = _or(door.get("custom_gap"), _or(rect.get("gap"), CABIN_GAP, location), location)
    return half + wall + gap + _or(door.get("thickness"), CABIN_DOOR, location) / 2.0


def door_placement(door: Mapping[str, Any], rect: Mapping[str, Any], location: str) -> tuple[str, dict[str, Any]]:
    """Convert a building's lift door to (face, placement)."""
    x, y = number(door.get("x"), f"{location}.x"), number(door.get("y"), f"{location}.y")
    side = abs(y) * rect["depth"] > abs(x) * rect["width"]
    face = ("left_door" if y > 0 else "right_door") if side else ("front_door" if x >= 0 else "back_door")
    ux, uy = FACES[face]
    reach = _reach(rect, face, {"custom_gap": 0.0}, location)
    shift, gap = metres(ux * y - uy * x), metres(ux * x + uy * y - reach)
    out = {"width": number(door.get("width"), f"{location}.width"), "custom_gap": gap}
    return face, out | ({"shifted": shift} if shift else {})


def door_anchors(rect: Mapping[str, Any], face: str) -> list[dict[str, Any]]:
    """Create the anchors left and right of a cabin's door, in the cabin's frame (``level_door_anchors``)."""
    door = rect[face]
    (ux, uy), reach = FACES[face], _reach(rect, face, door, face)
    half = _or(door.get("thickness"), CABIN_DOOR, face) / 2.0
    shift = _or(door.get("shifted"), 0.0, face)
    out = []
    for along in (door["width"] / 2.0 + shift, -door["width"] / 2.0 + shift):
        x, y = ux * reach - uy * along, uy * reach + ux * along
        floor = [metres(x - half * ux), metres(y - half * uy)]
        out.append({"CategorizedTranslate2D": {"General": [metres(x), metres(y)], "Floor": floor}})
    return out


def cabin_size(cabin: Cabin) -> list[float]:
    """Return an object's size: along x, along y, and Open-RMF's height of every cabin."""
    return [cabin.depth, cabin.width, CABIN_HEIGHT]


# --- graphs, models, textures ----------------------------------------------------------------------------------------


def parse_graphs(choice: Any, numbers_by_id: Mapping[str, int], location: str) -> tuple[int, int]:
    """Return (first graph of an element, number of its graphs). numbers_by_id: graph numbers by id, ascending."""
    name, content = variant("All" if choice is None else choice, location)
    if name not in ("All", "Only", "AllExcept"):
        raise_unreadable(f"must be All, Only or AllExcept, got {name[:40]!r}", location)
    ids = set() if name == "All" else set(references(content, location)) & numbers_by_id.keys()
    if name == "Only":
        return min((numbers_by_id[i] for i in ids), default=0), len(ids)
    return next((number_ for i, number_ in numbers_by_id.items() if i not in ids), 0), len(numbers_by_id) - len(ids)


def graph_numbers(graphs: Iterable[tuple[str, Mapping[str, Any]]], ranking: Sequence[str]) -> dict[str, int]:
    """Number the graphs as in a building: by name if all names are numbers, else by rank."""
    listed = sorted(graphs, key=lambda item: ranking.index(item[0]) if item[0] in ranking else len(ranking))
    names = [str(graph.get("name")) for _, graph in listed]
    numbered = all(n.isascii() and n.isdigit() and len(n) < 4 for n in names) and len(set(names)) == len(names)
    out = {i: int(n) if numbered else k for k, ((i, _), n) in enumerate(zip(listed, names, strict=True))}
    return dict(sorted(out.items(), key=lambda item: item[1]))


def asset(value: Any, location: str) -> tuple[str, str]:
    """Split an asset source into (kind, name)."""
    name, content = variant(value, location)
    return name, text(content, location)


TEXTURES = "OpenRobotics/RMF_Materials/textures/"


def texture_parameters(group: Mapping[str, Any], kind: str) -> dict[str, Any]:
    """Convert a wall's or floor's texture to a building's parameters; none for textures from elsewhere."""
    texture = mapping(group.get("texture"), "texture")
    source, name = asset(texture.get("source", "Local"), "texture")
    if source != "Remote" or not name.startswith(TEXTURES) or not name.endswith(".png"):
        return {}
    out: dict[str, Any] = {"texture_name": [1, name[len(TEXTURES) : -len(".png")]]}
    if kind == "floor":
        if texture.get("rotation") is not None:
            out["texture_rotation"] = [3, round(math.degrees(angle(texture["rotation"], "texture.rotation")), 9)]
        if texture.get("width") is not None:
            out["texture_scale"] = [3, number(texture["width"], "texture.width")]
        return out
    for member, key in (("alpha", "alpha"), ("width", "texture_width"), ("height", "texture_height")):
        if texture.get(member) is not None:
            out[key] = [3, number(texture[member], f"texture.{member}")]
    return out


def texture_group(parameters: Mapping[str, Any], kind: str) -> dict[str, Any] | None:
    """Convert a building's texture to a site's texture group."""
    name = parameter_value(parameters, "texture_name")
    if not isinstance(name, str) or not name:
        return None
    texture: dict[str, Any] = {"source": {"Remote": f"{TEXTURES}{name}.png"}}
    scale = parameter_value(parameters, "texture_scale", 1.0)
    scale = float(scale) if isinstance(scale, (int, float)) and scale > 0 else 1.0
    if kind == "floor":
        texture |= {"width": scale, "height": scale}
        turn = parameter_value(parameters, "texture_rotation")
        if isinstance(turn, (int, float)):
            texture["rotation"] = {"deg": float(turn)}
    else:
        for member, key, by in (
            ("alpha", "alpha", 1.0),
            ("width", "texture_width", scale),
            ("height", "texture_height", scale),
        ):
            value = parameter_value(parameters, key)
            if isinstance(value, (int, float)):
                texture[member] = float(value) / by
    return {"name": name, "texture": texture}

"""VDA 5050 (3.0, sections 6.3 and 6.4): instant actions that install maps on a vehicle, and the maps in its state.

Vehicles of 2.1 accept the same actions. They report results in ``actionStates`` (``resultDescription``), vehicles of
3.0 in ``instantActionStates`` (``actionResult``, with reasons in ``errors``); 2.0 has no maps.

Covers only the content of messages: the fleet manager adds the header and sends them over MQTT. The id of an action
contains its purpose (``downloadMap:<mapId>:<mapVersion>:<unique>``), so that a failure in a state can be assigned. In a
state, maps are enabled (in use) or disabled (stored on the vehicle); optional fields may be absent or null.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import Any, Literal

from app.errors import Invalid, Problem
from app.event_types import MAX_ROUTE, MAX_ROUTE_CHARACTERS, RobotPlace
from app.events.messages import read_place
from app.model.frame import GROUND
from app.store.values import Version

MAX_MAPS = 1000
MAX_ACTIONS = 10_000

Action = Literal["downloadMap", "enableMap", "deleteMap"]

_ACTION_ID = re.compile(r"(downloadMap|enableMap):(.+):([0-9]{1,9}):[^:]*", re.DOTALL)


def action(kind: Action, map_id: str, version: int, unique: str, **more: str) -> dict[str, Any]:
    """Return an instant action. unique: unique part of its id. more: further parameters.

    The blocking type is NONE: 3.0 allows no other for instant actions, and earlier versions accept it.
    """
    parameters = {"mapId": map_id, "mapVersion": str(version), **more}
    return {
        "actionType": kind,
        "actionId": f"{kind}:{map_id}:{version}:{unique}",
        "blockingType": "NONE",
        "actionParameters": [{"key": key, "value": value} for key, value in parameters.items()],
    }


@dataclass(frozen=True, slots=True)
class VehicleMaps:
    """Versions of one map in a vehicle's state.

    Attributes:
        failed: (version, reason) of failed actions of this server.
    """

    map_id: str
    enabled: tuple[str, ...]
    disabled: tuple[str, ...]
    failed: tuple[tuple[str, str], ...]


def default_level(version: Version) -> str:
    """Return the level whose map id is that of the site: ``ground``, else the lowest one."""
    names = [level.name for level in version.levels]
    if not names or GROUND in names:
        return GROUND
    return min(version.levels, key=lambda level: level.elevation).name


def level_map_id(site: str, level: str | None) -> str:
    """Return the ``mapId`` of a level. level: None for the default level, whose map id is that of the site."""
    return site if level is None else f"{site}/{level}"


def site_name(map_id: str) -> str:
    """Return the site of a level's ``mapId``: the part before the first slash."""
    return map_id.partition("/")[0]


@dataclass(frozen=True, slots=True)
class VehiclePlace:
    """Place of a vehicle. map_id: of the map in which its position is; None if the state has no position."""

    map_id: str | None
    place: RobotPlace


def read_vehicle_place(message: Mapping[str, Any]) -> VehiclePlace | None:
    """Read position, last node and remaining order of a state message. Raises Invalid.

    A position that the vehicle does not trust (``positionInitialized``, 3.0: ``localized``) is none. Nodes and edges
    are joined by their ``sequenceId``; a state of a vehicle without an order has an empty route.
    """
    pose, map_id = None, None
    for name, trusted in (("agvPosition", "positionInitialized"), ("mobileRobotPosition", "localized")):
        position = message.get(name)
        if position is None:
            continue
        if not isinstance(position, Mapping):
            raise _invalid_state_error("must be an object", name)
        map_id = _text(position, "mapId", name)
        if position.get(trusted) is not False:
            level = map_id.partition("/")[2] or None
            pose = {"x": position.get("x"), "y": position.get("y"), "yaw": position.get("theta")}
            pose |= {} if level is None else {"level": level}
    place, problems = read_place({"pose": pose, "node": message.get("lastNodeId") or None, "route": _route(message)})
    for problem in problems:
        raise _invalid_state_error(problem.problem, f"position, lastNodeId or order ({problem.where})")
    return VehiclePlace(map_id, place) if place else None


def _route(message: Mapping[str, Any]) -> list[Any] | None:
    """Return the ids of the nodes and edges that a vehicle has still to drive; None if the state has no such lists.

    An order that is longer than a stored route is cut.
    """
    if message.get("nodeStates") is None and message.get("edgeStates") is None:
        return None
    steps: list[tuple[int, Any]] = []
    for name, word in (("nodeStates", "nodeId"), ("edgeStates", "edgeId")):
        for k, item in enumerate(_list(message, name, MAX_ACTIONS)):
            sequence = item.get("sequenceId")
            if isinstance(sequence, bool) or not isinstance(sequence, int):
                raise _invalid_state_error("must be an integer", f"{name}[{k}].sequenceId")
            steps.append((sequence, _text(item, word, f"{name}[{k}]")))
    ids = [item_id for _, item_id in sorted(steps, key=lambda step: step[0])][:MAX_ROUTE]
    lengths = list(accumulate(map(len, ids)))
    return ids[: bisect_right(lengths, MAX_ROUTE_CHARACTERS)]


def merge_levels(floors: Sequence[VehicleMaps]) -> VehicleMaps:
    """Merge the map versions of all levels of a site.

    Enabled: the oldest version that is enabled on any level. Disabled: versions present on all reported levels. Failed:
    versions that failed on any level.
    """
    first, *others = floors
    if not others:
        return first
    enabled = sorted({v for floor in floors for v in floor.enabled}, key=_age)[:1]
    loaded = [v for v in (*first.enabled, *first.disabled) if all(v in (*o.enabled, *o.disabled) for o in others)]
    failed = dict(pair for floor in floors for pair in floor.failed)
    return VehicleMaps(
        site_name(first.map_id), tuple(enabled), tuple(v for v in loaded if v not in enabled), tuple(failed.items())
    )


def _age(version: str) -> tuple[bool, int, str]:
    """Return a sort key for versions, oldest first; names that are not numbers come last."""
    number = version.isascii() and version.isdigit() and len(version) < 10
    return not number, int(version) if number else 0, version


def read_state(message: Any) -> tuple[VehicleMaps, ...]:
    """Read the maps of a state message, sorted by id. Raises Invalid.

    A failed download is ignored if the vehicle has the map, since a later download must have succeeded.
    """
    if not isinstance(message, Mapping):
        raise Invalid("invalid VDA 5050 state: must be a JSON object", [Problem("must be a JSON object", where="body")])
    enabled: dict[str, list[str]] = {}
    disabled: dict[str, list[str]] = {}
    failed: dict[str, list[tuple[str, str]]] = {}
    for k, item in enumerate(_list(message, "maps", MAX_MAPS)):
        location = f"maps[{k}]"
        map_id, version = _text(item, "mapId", location), _text(item, "mapVersion", location)
        status = item.get("mapStatus")
        if status not in ("ENABLED", "DISABLED"):
            raise _invalid_state_error("must be ENABLED or DISABLED", f"{location}.mapStatus")
        (enabled if status == "ENABLED" else disabled).setdefault(map_id, []).append(version)
    for map_id, versions in enabled.items():
        if len(set(versions)) > 1:
            raise _invalid_state_error(f"several versions of map {map_id[:80]!r} are ENABLED: enable only one", "maps")
    for (kind, map_id, version), why in _failures(message).items():
        if kind == "downloadMap" and version in (*enabled.get(map_id, ()), *disabled.get(map_id, ())):
            continue
        failed.setdefault(map_id, []).append((version, why))
    names = sorted(enabled.keys() | disabled.keys() | failed.keys())
    return tuple(
        VehicleMaps(n, tuple(enabled.get(n, ())[:1]), tuple(disabled.get(n, ())), tuple(failed.get(n, ())))
        for n in names
    )


def _failures(message: Mapping[str, Any]) -> dict[tuple[str, str, str], str]:
    """Return (action, map, version) -> reason of this server's actions that failed or wait for a retry.

    Vehicles keep failed actions in their lists; a later entry for the same action replaces an earlier one.
    """
    descriptions: dict[str, str] = {}
    for k, error in enumerate(_list(message, "errors", MAX_ACTIONS)):
        for reference in _list(error, "errorReferences", MAX_ACTIONS, f"errors[{k}]."):
            if reference.get("referenceKey") == "actionId":
                why = error.get("errorDescription") or error.get("errorType")
                descriptions.setdefault(str(reference.get("referenceValue")), why if isinstance(why, str) else "")
    out: dict[tuple[str, str, str], str] = {}
    for name in ("actionStates", "instantActionStates"):
        for k, item in enumerate(_list(message, name, MAX_ACTIONS)):
            ours = _ACTION_ID.fullmatch(str(item.get("actionId")))
            if ours is None:
                continue
            about = (ours[1], ours[2], ours[3])
            out.pop(about, None)
            if item.get("actionStatus") not in ("FAILED", "RETRIABLE"):
                continue
            reasons = [descriptions.get(ours[0])]
            for member in ("actionResult", "resultDescription"):
                text = item.get(member)
                if text is not None and not isinstance(text, str):
                    raise _invalid_state_error("must be a string", f"{name}[{k}].{member}")
                reasons.insert(0, text)
            out[about] = next((text for text in reasons if text), "the vehicle reports no reason")
    return out


def _list(message: Mapping[str, Any], name: str, limit: int, within: str = "") -> Sequence[Mapping[str, Any]]:
    items = message.get(name)
    if items is None:
        return ()
    if not isinstance(items, list) or len(items) > limit:
        raise _invalid_state_error(f"must be a list of at most {limit} items", within + name)
    for k, item in enumerate(items):
        if not isinstance(item, Mapping):
            raise _invalid_state_error("must be an object", f"{within}{name}[{k}]")
    return items


def _text(item: Mapping[str, Any], name: str, location: str) -> str:
    value = item.get(name)
    if not isinstance(value, str) or not value or len(value) > 512:
        raise _invalid_state_error("must be a string of 1 to 512 characters", f"{location}.{name}")
    return value


def _invalid_state_error(problem: str, location: str) -> Invalid:
    return Invalid(f"invalid VDA 5050 state: {location} {problem}", [Problem(problem, where=location)])

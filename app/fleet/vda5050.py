"""VDA 5050 (3.0, sections 6.3 and 6.4): instant actions that bring a map to a vehicle, and what its state says of maps.

Vehicles of 2.1 understand the same actions. Their states tell of them in ``actionStates`` (``resultDescription``),
those of 3.0 in ``instantActionStates`` (``actionResult``, and why in ``errors``); 2.0 knows no maps.

Only the messages' content: carrying it over MQTT, with its header, is the fleet manager's. An action's id tells what it
is about (``downloadMap:<mapId>:<mapVersion>:<unique>``), so that a state that says it failed can be understood. A state
says which map is enabled (the vehicle drives on it) or disabled (it has it); optional fields may be absent or null.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from app.errors import Invalid, Problem
from app.model.frame import GROUND
from app.store.values import Version

MAX_MAPS = 1000
MAX_ACTIONS = 10_000

Action = Literal["downloadMap", "enableMap", "deleteMap"]

_ACTION_ID = re.compile(r"(downloadMap|enableMap):(.+):([0-9]{1,9}):[^:]*", re.DOTALL)


def action(kind: Action, map_id: str, version: int, unique: str, **more: str) -> dict[str, Any]:
    """One instant action. unique: what no other action has. more: further parameters.

    The blocking type of an instant action is always NONE in 3.0, whose schema refuses others, and may be so before.
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
    """What a state says of one map: versions by what they are. failed: of actions of ours that failed, and why."""

    map_id: str
    enabled: tuple[str, ...]
    disabled: tuple[str, ...]
    failed: tuple[tuple[str, str], ...]


def default_level(version: Version) -> str:
    """The level whose map is the site's: ``ground``, else the lowest one."""
    names = [level.name for level in version.levels]
    if not names or GROUND in names:
        return GROUND
    return min(version.levels, key=lambda level: level.elevation).name


def level_map_id(site: str, level: str | None) -> str:
    """The ``mapId`` of a floor: VDA 5050 has one for each. level: None for the default level, which is the site's."""
    return site if level is None else f"{site}/{level}"


def site_name(map_id: str) -> str:
    """The site that a floor's ``mapId`` belongs to: the part before the first slash."""
    return map_id.partition("/")[0]


def merge_levels(floors: Sequence[VehicleMaps]) -> VehicleMaps:
    """What a vehicle holds of a site, from what its state says of each floor.

    It runs the oldest version that is enabled on a floor, has those that it has of every floor that it reports, and
    has failed with those that failed on any.
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
    """Sort key of versions, the oldest first; what is no number comes last."""
    number = version.isascii() and version.isdigit() and len(version) < 10
    return not number, int(version) if number else 0, version


def read_state(message: Any) -> tuple[VehicleMaps, ...]:
    """The maps of a state message, by id; what it does not speak of is not there. Invalid says what is wrong with it.

    A download that failed and whose map is there all the same was followed by one that did not fail.
    """
    if not isinstance(message, Mapping):
        raise Invalid("a state message is a JSON object", [Problem("no object", where="body")])
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
            raise _invalid_state_error(f"several versions of {map_id[:80]} are ENABLED: at most one may be", "maps")
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
    """Of our actions (what, map, version) those that failed, or wait for another try, and why.

    Vehicles keep what failed in their lists: the same tried again, further down, counts instead.
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
                    raise _invalid_state_error("must be a text", f"{name}[{k}].{member}")
                reasons.insert(0, text)
            out[about] = next((text for text in reasons if text), "the vehicle does not say why")
    return out


def _list(message: Mapping[str, Any], name: str, limit: int, within: str = "") -> Sequence[Mapping[str, Any]]:
    items = message.get(name)
    if items is None:
        return ()
    if not isinstance(items, list) or len(items) > limit:
        raise _invalid_state_error(f"must be a list of at most {limit}", within + name)
    for k, item in enumerate(items):
        if not isinstance(item, Mapping):
            raise _invalid_state_error("must be an object", f"{within}{name}[{k}]")
    return items


def _text(item: Mapping[str, Any], name: str, location: str) -> str:
    value = item.get(name)
    if not isinstance(value, str) or not value or len(value) > 512:
        raise _invalid_state_error("must be a text", f"{location}.{name}")
    return value


def _invalid_state_error(problem: str, location: str) -> Invalid:
    return Invalid(f"this is no VDA 5050 state: {location} {problem}", [Problem(problem, where=location)])

"""Keys and payloads of Zenoh messages.

Shared with the agent, which imports nothing else of the server except errors, event types and credentials.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, get_args

from app.errors import Invalid, Problem
from app.event_types import (
    EVENT_TYPES,
    MAX_POSE_METRES,
    MAX_ROUTE,
    MAX_ROUTE_CHARACTERS,
    MAX_YAW,
    EventType,
    Pose,
    RobotPlace,
    RobotState,
)

PREFIX = "fleetmap"
"""Default prefix of all keys."""

JSON = "application/json"

SIGNATURE = "fleetmap-signature"
"""Header of a manifest: ``<key id>:<base64 of the Ed25519 signature over the body>``."""

ROBOT_STATES: tuple[RobotState, ...] = get_args(RobotState)

ROBOT_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,127}")
"""Robot name: one segment of a key and of a URL, without slashes and wildcards."""

MAX_STATUS_BYTES = 32 * 2**10
MAX_DETAIL = 2000
MAX_ID = 512
MAX_LEVEL = 256
_CHANNEL = re.compile(r"[a-z][a-z0-9_-]{0,62}")
_ROOT = re.compile(r"[0-9a-f]{64}")
_UNWRITABLE = re.compile("[\x00-\x1f\x7f\ud800-\udfff]")
"""Characters that no id of the store has."""


def events_key(prefix: str, environment: str) -> str:
    """Return the key of an environment's events (``*``: of all environments)."""
    return f"{prefix}/{environment}/events"


def status_key(prefix: str, environment: str, robot: str) -> str:
    """Return the key of a robot's status."""
    return f"{prefix}/{environment}/robots/{robot}/status"


def robot_key(prefix: str, robot: str) -> str:
    """Return the key of a robot's liveliness token."""
    return f"{prefix}/robots/{robot}"


POSITION_QUERY = ("server", "where")
"""Segments after the prefix of the key to find environments by position."""


def position_key(prefix: str) -> str:
    """Return the key to query environments by position (``?lat=…;lon=…``)."""
    return "/".join((prefix, *POSITION_QUERY))


def server_key(prefix: str) -> str:
    """Return the key of the server's liveliness token."""
    return f"{prefix}/server"


@dataclass(frozen=True, slots=True)
class Event:
    """A change of an environment. Robots order events by ``sequence``, never by version.

    Attributes:
        body: all members, such as layers (``[{layer, level, name, change, hash}]``) and previous (``{version, root}``
            or None).
    """

    sequence: int
    type: EventType
    environment: str
    version: int
    root: str
    channel: str | None
    body: Mapping[str, Any]

    @classmethod
    def from_json(cls, data: bytes | str) -> Event:
        """Parse an event; ``body`` keeps unknown members. Raises Invalid."""
        try:
            body = json.loads(data)
            kind, channel = body["type"], body.get("channel")
            sequence, version, root = body["sequence"], body["version"], body["root"]
            environment = body["environment"]
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
            raise Invalid(f"invalid event: {error}") from None
        if kind not in EVENT_TYPES or not isinstance(environment, str) or not isinstance(root, str):
            raise Invalid(f"invalid event: type {kind!r:.80}, environment {environment!r:.80}, root {root!r:.80}")
        for number in (sequence, version):
            if isinstance(number, bool) or not isinstance(number, int) or number < 0:
                raise Invalid(f"invalid event: sequence {sequence!r:.80}, version {version!r:.80}")
        return cls(sequence, kind, environment, version, root, channel, body)


@dataclass(frozen=True, slots=True)
class RobotStatus:
    """Status that a robot reports.

    Attributes:
        version, root: map that ``state`` is about.
        time: RFC 3339, by the robot's clock.
        sequence: position of the installed map in its channel.
        overlays: digest of the closures in the installed map.
        holds: version and root of the map that the robot has loaded, whatever ``state`` is about; the root ``NO_ROOT``
            if it has none; None if not reported.
        place: where the robot is and what it drives next; None if not reported.
    """

    channel: str
    version: int
    root: str
    state: RobotState
    detail: str | None = None
    time: str | None = None
    sequence: int | None = None
    overlays: str | None = None
    holds: tuple[int, str] | None = None
    place: RobotPlace | None = None

    @classmethod
    def from_json(cls, data: bytes | str) -> RobotStatus:
        """Parse a status. Raises Invalid with all problems."""
        if len(data) > MAX_STATUS_BYTES:
            raise Invalid(f"invalid status: must be at most {MAX_STATUS_BYTES} bytes")
        try:
            body = json.loads(data)
        except (ValueError, RecursionError):
            raise Invalid("invalid status: must be a JSON object") from None
        return cls.from_dict(body)

    @classmethod
    def from_dict(cls, body: Any) -> RobotStatus:
        """Check a status that is parsed already. Raises Invalid with all problems."""
        if not isinstance(body, Mapping):
            raise Invalid("invalid status: must be a JSON object")
        problems = []

        def check(name: str, good: bool, accepted: str) -> None:
            if not good:
                problems.append(Problem(f"must be {accepted}, got {body.get(name)!r:.80}", where=name))

        channel, version, root = body.get("channel"), body.get("version"), body.get("root")
        state, detail, time = body.get("state"), body.get("detail"), body.get("time")
        sequence, overlays = body.get("sequence"), body.get("overlays")
        check("channel", isinstance(channel, str) and _CHANNEL.fullmatch(channel) is not None, "a channel name")
        check("version", _is_number(version), "a version number")
        check("root", isinstance(root, str) and _ROOT.fullmatch(root) is not None, "64 hexadecimal digits")
        check("state", state in ROBOT_STATES, " or ".join(ROBOT_STATES))
        check(
            "detail",
            detail is None or (isinstance(detail, str) and len(detail) <= MAX_DETAIL),
            f"a string of at most {MAX_DETAIL} characters",
        )
        check("time", time is None or (isinstance(time, str) and len(time) <= 64), "an RFC 3339 time")
        check("sequence", sequence is None or _is_number(sequence), "an event sequence")
        hashed = isinstance(overlays, str) and _ROOT.fullmatch(overlays) is not None
        check("overlays", overlays is None or hashed, "64 hexadecimal digits")
        holds = _read_holds(body.get("holds"))
        check("holds", (body.get("holds") is None) == (holds is None), "a version and its root")
        place, place_problems = read_place(body)
        problems += place_problems
        if problems:
            raise Invalid("; ".join(f"{p.where} {p.problem}" for p in problems), problems)
        robot_state = next(s for s in ROBOT_STATES if s == state)
        more = (detail, time, sequence, overlays, holds, place or None)
        return cls(str(channel), int(version or 0), str(root), robot_state, *more)

    def as_dict(self) -> dict[str, Any]:
        """Return the members of the status that are set."""
        members = {
            "channel": self.channel,
            "version": self.version,
            "root": self.root,
            "state": self.state,
            "detail": self.detail,
            "time": self.time,
            "sequence": self.sequence,
            "overlays": self.overlays,
            "holds": None if self.holds is None else {"version": self.holds[0], "root": self.holds[1]},
            **({} if self.place is None else self.place.as_dict()),
        }
        return {name: value for name, value in members.items() if value is not None}


def _is_number(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 2**63


def _read_holds(value: Any) -> tuple[int, str] | None:
    """Parse the member ``holds``; None if it is invalid."""
    if not isinstance(value, Mapping):
        return None
    version, root = value.get("version"), value.get("root")
    if not _is_number(version) or not isinstance(root, str) or _ROOT.fullmatch(root) is None:
        return None
    return int(version or 0), root


def read_place(body: Mapping[str, Any]) -> tuple[RobotPlace, list[Problem]]:
    """Parse the members ``pose``, ``node`` and ``route`` of a status. Returns the place and what is wrong with them."""
    pose, node, route = body.get("pose"), body.get("node"), body.get("route")
    problems = []
    if pose is not None and not _is_pose(pose):
        reason = f"must be {{x, y, yaw, level?}}: metres within ±{MAX_POSE_METRES:g} and radians within ±{MAX_YAW:g}"
        problems.append(Problem(reason, where="pose"))
    if node is not None and not _is_id(node):
        problems.append(Problem(f"must be an id of 1 to {MAX_ID} characters without control characters", where="node"))
    if route is not None and not _is_route(route):
        limits = f"at most {MAX_ROUTE} ids with at most {MAX_ROUTE_CHARACTERS} characters together"
        problems.append(Problem(f"must be a list of {limits}", where="route"))
    if problems:
        return RobotPlace(), problems
    parsed = None
    if pose is not None:
        parsed = Pose(float(pose["x"]), float(pose["y"]), float(pose["yaw"]), pose.get("level"))
    return RobotPlace(parsed, node, None if route is None else tuple(route)), []


def _is_pose(value: Any) -> bool:
    if not isinstance(value, Mapping) or not {"x", "y", "yaw"} <= set(value) <= {"x", "y", "yaw", "level"}:
        return False
    bounds = (("x", MAX_POSE_METRES), ("y", MAX_POSE_METRES), ("yaw", MAX_YAW))
    level = value.get("level")
    return all(_is_within(value[name], bound) for name, bound in bounds) and (
        level is None or (_is_id(level) and len(level) <= MAX_LEVEL)
    )


def _is_within(value: Any, bound: float) -> bool:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return is_number and math.isfinite(value) and abs(value) <= bound


def _is_id(value: Any) -> bool:
    return isinstance(value, str) and 0 < len(value) <= MAX_ID and _UNWRITABLE.search(value) is None


def _is_route(value: Any) -> bool:
    if not isinstance(value, (list, tuple)) or len(value) > MAX_ROUTE or not all(map(_is_id, value)):
        return False
    return sum(map(len, value)) <= MAX_ROUTE_CHARACTERS


def dumps(value: Mapping[str, Any]) -> bytes:
    """Encode a payload as compact JSON in UTF-8."""
    return json.dumps(value, ensure_ascii=False, separators=(",", ":")).encode()

"""Frame of a network's nodes: its ``transformation``, and nodes in its child frame.

The newest topological_navigation names the child frame ``topo_frame_id``, older ones ``child``. Nodes are in it if
their ``parent_frame`` or ``nav_frame`` says so; with ``topo_frame_id`` also if they have neither. Source:
LCAS/topological_navigation, map_manager2.py and networkx_utils.py.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from app.errors import Problem, UnreadableFile
from app.formats import ReadContext
from app.formats.tmap.network import Array, parse_number


@dataclass(frozen=True, slots=True)
class MapTransform:
    """A file's ``transformation``: rotation and translation from the child frame to the local frame."""

    child: str
    quaternion: tuple[float, float, float, float]
    shift: Array

    def matrix(self) -> Array:
        """Return the rotation matrix [3, 3] of the quaternion (x, y, z, w)."""
        x, y, z, w = self.quaternion
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )


CHILD_FRAME_REFERENCE = "${transformation.topo_frame_id}"


def child_frame(document: Mapping[str, Any]) -> str | None:
    """Return the name of the transformation's child frame, or None if it has none."""
    transformation = document.get("transformation")
    names = [transformation.get(key) for key in ("topo_frame_id", "child")] if isinstance(transformation, dict) else []
    return next((name for name in names if isinstance(name, str) and name), None)


def has_default_frame(document: Mapping[str, Any]) -> bool:
    """Whether nodes without a frame are in the child frame."""
    transformation = document.get("transformation")
    return isinstance(transformation, dict) and bool(transformation.get("topo_frame_id"))


def is_in_child_frame(node: Mapping[str, Any], document: Mapping[str, Any]) -> bool:
    """Check that a node's pose is in the child frame of the document's transformation."""
    frames = [node[key] for key in ("parent_frame", "nav_frame") if node.get(key)]
    if not frames:
        return has_default_frame(document)
    return child_frame(document) in frames or CHILD_FRAME_REFERENCE in frames


def map_transform(document: Mapping[str, Any]) -> MapTransform | None:
    """Parse the file's transformation, or return None if it is missing or the identity."""
    transformation, child = document.get("transformation"), child_frame(document)
    if not isinstance(transformation, dict) or child is None or child == transformation.get("parent"):
        return None
    rotation, translation = transformation.get("rotation") or {}, transformation.get("translation") or {}
    if not isinstance(rotation, dict) or not isinstance(translation, dict):
        return None
    location = "transformation"
    x, y, z = (parse_number(rotation.get(key, 0.0), f"{location}.rotation.{key}") for key in "xyz")
    w = parse_number(rotation.get("w", 1.0), f"{location}.rotation.w")
    shift = np.array([parse_number(translation.get(key, 0.0), f"{location}.translation.{key}") for key in "xyz"])
    length = math.sqrt(x * x + y * y + z * z + w * w)
    if not math.isfinite(length) or length < 1e-9:
        raise UnreadableFile(
            "transformation.rotation is invalid: the quaternion has length 0",
            [Problem("invalid rotation", where=f"{location}.rotation")],
        )
    if x == y == z == 0.0 and not shift.any():
        return None
    return MapTransform(child, (x / length, y / length, z / length, w / length), shift)


def multiply(a: Sequence[float], b: Sequence[float]) -> list[float]:
    """Multiply two quaternions (x, y, z, w): rotate by b, then by a."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return [
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    ]


def to_local(
    xyz: Array,
    orientations: list[list[float] | None],
    nodes: Sequence[Mapping[str, Any]],
    document: Mapping[str, Any],
    context: ReadContext,
) -> None:
    """Transform poses of nodes in the transformation's child frame to the local frame, in place."""
    turn = map_transform(document)
    if turn is None:
        return
    inside = [k for k, node in enumerate(nodes) if is_in_child_frame(node, document)]
    if not inside:
        return
    xyz[inside] = xyz[inside] @ turn.matrix().T + turn.shift
    for k in inside:
        orientations[k] = multiply(turn.quaternion, orientations[k] or [0.0, 0.0, 0.0, 1.0])
    context.warn(
        f"{len(inside)} nodes are in the frame {turn.child!r}; the file's transformation was applied to move them to "
        "the local frame"
    )

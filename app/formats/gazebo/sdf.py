"""SDFormat (Gazebo's worlds and models) as trees: references, poses and frames, geometry <-> ``properties.shapes``.

Rules of SDFormat 1.4 to 1.11, from its specification and the behaviour of libsdformat:

- A pose is x, y, z, roll, pitch, yaw (metres; radians, or degrees with ``degrees="true"``; a unit quaternion x, y, z,
  w with ``rotation_format="quat_xyzw"``); rotations are about the fixed axes x, y, z in this order.
- A pose is in the frame named by ``relative_to`` (before 1.7 ``frame``, if not empty); else in the model's frame, for a
  collision or visual in the link's, for a joint in the child link's.
- The pose of an ``<include>`` replaces the model's own pose.
- ``model.config`` names a model's files by version: the newest supported one is read.
- A reference is looked up in the upload only: ``model://NAME/path`` as the end of a path, nearest to the file that
  names it. A reference that the upload does not contain stays a reference.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from lxml import etree
from numpy.typing import NDArray

from app.errors import Problem, UnreadableFile
from app.formats import ReadContext, _fields
from app.limits import Limits
from app.model.frame import MAX_METRES
from app.model.solids import matrix
from app.syntax import xml
from app.syntax.decimals import number

Matrix = NDArray[np.float64]

VERSIONS = ("1.4", "1.5", "1.6", "1.7", "1.8", "1.9", "1.10", "1.11")
NEWEST = (1, 11)

_BLANK = re.compile(rb"\s+|<\?.*?\?>|<!--.*?-->", re.DOTALL)
_ROOT = re.compile(rb"<sdf[\s>/]")


def is_sdf(data: bytes) -> bool:
    """Check that the root element is ``<sdf>``, after any whitespace and comments."""
    at = 3 if data.startswith(b"\xef\xbb\xbf") else 0
    while blank := _BLANK.match(data, at):
        at = blank.end()
    return _ROOT.match(data, at) is not None


def contains_element(data: bytes, *tags: bytes) -> bool:
    """Check for an element with one of these names outside comments."""
    bare = without_comments(data)
    return any(re.search(rb"<" + tag + rb"[\s>/]", bare) for tag in tags)


def without_comments(data: bytes) -> bytes:
    """Remove comments in linear time; an unclosed comment extends to the end."""
    out, at = [], 0
    while (start := data.find(b"<!--", at)) >= 0:
        out.append(data[at:start])
        end = data.find(b"-->", start + 4)
        if end < 0:
            return b"".join(out)
        at = end + 3
    return b"".join([*out, data[at:]])


def unreadable_error(reason: str, element: etree._Element | None = None, where: str | None = None) -> UnreadableFile:
    """Create the error for an element, with its line."""
    line = None if element is None else element.sourceline
    location = where or (None if element is None else element_path(element))
    return UnreadableFile(reason, [Problem(reason, line=line, where=location)])


def element_path(element: etree._Element) -> str:
    """Return an element's location for users: names from the world down."""
    parts: list[str] = []
    at: etree._Element | None = element
    while at is not None and at.tag not in ("sdf", "world"):
        name = at.get("name")
        parts.append(f"{at.tag} {name}" if name else str(at.tag))
        at = at.getparent()
    return " / ".join(reversed(parts))[:200] or str(element.tag)


def parse(data: bytes, limits: Limits) -> etree._Element:
    """Parse the ``<sdf>`` element, without comments and indentation."""
    root = xml.parse(data, limits, remove_blank_text=True)
    if root.tag != "sdf":
        raise unreadable_error(f"the root element must be <sdf>, not <{str(root.tag)[:80]}>", root)
    return root


_EXTENTS = ("radius", "length", "size", "scale")
_BOOLEANS = ("static", "self_collide", "allow_auto_disable", "cast_shadows")


def report_suspicious_values(root: etree._Element, context: ReadContext) -> None:
    """Warn about valid but suspicious values: angles in degrees, sizes of zero."""
    doubts: dict[str, list[etree._Element]] = {}
    for pose in root.iter("pose"):
        turned = pose.get("degrees") or pose.get("rotation_format")
        angles = [] if turned else element_text(pose).split()[3:6]
        if any(_FLOAT.match(a) and abs(float(a)) > _fields.MAX_USUAL_ANGLE for a in angles):
            doubts.setdefault("a <pose> has an angle above 2π; angles must be in radians", []).append(pose)
    for name in _EXTENTS:
        for extent in root.iter(name):
            tokens = element_text(extent).split()
            if (
                tokens
                and "geometry" in {a.tag for a in extent.iterancestors()}
                and not any(_FLOAT.match(w) is None or float(w) for w in tokens)
            ):
                doubts.setdefault(f"<{name}> is 0; the shape has no extent", []).append(extent)
    for name in _BOOLEANS:
        for flag in root.iter(name):
            if element_text(flag).lower() not in ("0", "1", "true", "false"):
                doubts.setdefault(f"<{name}> is {element_text(flag)[:40]!r}; it is read as false", []).append(flag)
    for reason, elements in doubts.items():
        often = f" ({len(elements)} times)" if len(elements) > 1 else ""
        context.warn(f"{reason}{often}", line=elements[0].sourceline, where=element_path(elements[0]))


_FLOAT = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?\Z", re.ASCII)


def element_text(element: etree._Element | None, tag: str | None = None) -> str:
    """Return an element's (or its child's) stripped text, empty if there is none."""
    if element is not None and tag is not None:
        element = element.find(tag)
    return "" if element is None else (element.text or "").strip()


def is_true(text: str) -> bool:
    """Parse an SDFormat boolean."""
    return text.strip().lower() in ("1", "true")


def numbers(text: str, element: etree._Element, maximum: float = MAX_METRES) -> list[float]:
    """Parse a text of numbers. Raises UnreadableFile if one is invalid, not finite or beyond ±maximum."""
    out = []
    for token in text.split():
        try:
            value = float(token) if token.isascii() and "_" not in token else math.nan
        except ValueError:
            value = math.nan
        if not abs(value) <= maximum:
            raise unreadable_error(f"invalid number {token[:40]!r}: must be finite and within ±{maximum:g}", element)
        out.append(value + 0.0)
    return out


def vector(element: etree._Element | None, tag: str, count: int, default: Sequence[float]) -> list[float]:
    """Parse ``count`` numbers of a child, or return the default if it is missing.

    Raises UnreadableFile for another count.
    """
    child = None if element is None else element.find(tag)
    if child is None or not element_text(child):
        return list(default)
    values = numbers(element_text(child), child)
    if len(values) != count:
        raise unreadable_error(f"<{tag}> must have {count} numbers, got {len(values)}", child)
    return values


@dataclass(frozen=True, slots=True)
class Pose:
    """Parsed ``<pose>``: [x, y, z, roll, pitch, yaw] in metres and radians, and the frame that it names.

    plain: the element contains nothing else, so that a canonical pose can replace it.
    """

    values: tuple[float, ...] = (0.0,) * 6
    relative: str = ""
    plain: bool = True

    @property
    def matrix(self) -> Matrix:
        """Return the pose as float64 [4, 4]."""
        return matrix(self.values)


ZERO = Pose()


def parse_pose(parent: etree._Element) -> Pose | None:
    """Parse the pose of an element, or return None if it has none."""
    element = parent.find("pose")
    if element is None:
        return None
    values = numbers(element_text(element), element)
    attributes = {k: v for k, v in xml.attributes(element).items() if v and k != "degrees"}
    if element.get("rotation_format") == "quat_xyzw":
        if len(values) not in (0, 7):
            raise unreadable_error(f"a pose with a quaternion must have 7 numbers, got {len(values)}", element)
        values = [*values[:3], *_quaternion_angles(values[3:], element)] if values else [0.0] * 6
    elif len(values) > 6:
        raise unreadable_error(f"a pose must have 6 numbers, got {len(values)}", element)
    else:
        values += [0.0] * (6 - len(values))
        if is_true(element.get("degrees", "")):
            values[3:] = [math.radians(v) for v in values[3:]]
    relative = element.get("relative_to") or element.get("frame") or ""
    return Pose(tuple(values), relative, not attributes and not len(element))


def _quaternion_angles(quaternion: Sequence[float], element: etree._Element) -> list[float]:
    x, y, z, w = quaternion
    length = math.sqrt(x * x + y * y + z * z + w * w)
    if length < 1e-9:
        raise unreadable_error("a pose's quaternion must not be zero", element)
    x, y, z, w = (v / length for v in (x, y, z, w))
    turn = np.eye(4)
    turn[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return six(turn)[3:]


def six(transform: Matrix) -> list[float]:
    """Convert float64 [4, 4] to [x, y, z, roll, pitch, yaw], rounded to a nanometre and a nanoradian."""
    r = transform[:3, :3]
    across = math.hypot(r[0, 0], r[1, 0])
    pitch = math.atan2(-r[2, 0], across)
    if across > 1e-9:
        roll, yaw = math.atan2(r[2, 1], r[2, 2]), math.atan2(r[1, 0], r[0, 0])
    else:  # pitch of ±90°: only the sum of roll and yaw is defined
        roll, yaw = 0.0, math.atan2(-r[0, 1], r[1, 1])
    return [round(float(v), 9) + 0.0 for v in (*transform[:3, 3], roll, pitch, yaw)]


def pose_element(values: Sequence[float]) -> etree._Element:
    """Create a ``<pose>`` from [x, y, z, roll, pitch, yaw]."""
    element = etree.Element("pose")
    element.text = " ".join(number(v) for v in values)
    return element


def child(parent: etree._Element, tag: str, text: str | None = None, **attributes: str) -> etree._Element:
    """Append a child element."""
    element = etree.SubElement(parent, tag, attributes)
    element.text = text
    return element


def format_numbers(values: Iterable[float]) -> str:
    """Format numbers as an SDF text."""
    return " ".join(number(float(v)) for v in values)


def geometry_element(shape: Mapping[str, Any], uri: str | None) -> etree._Element:
    """Create the ``<geometry>`` of a shape. uri: address of its mesh or height map."""
    out = etree.Element("geometry")
    kind = str(shape.get("type"))
    if kind == "polyline":
        for ring in shape["points"]:
            line = child(out, kind)
            for point in ring:
                child(line, "point", format_numbers(point))
            child(line, "height", format_numbers([shape["height"]]))
        return out
    element = child(out, kind)
    if kind in ("mesh", "heightmap"):
        child(element, "uri", uri)
    for key, tag in _WORDS[kind]:
        if key in shape:
            value = shape[key]
            child(element, tag, format_numbers(value if isinstance(value, (list, tuple)) else [value]))
    if kind == "mesh" and shape.get("submesh"):
        part = child(element, "submesh")
        child(part, "name", str(shape["submesh"]))
        child(part, "center", "true" if shape.get("center") else "false")
    return out


_WORDS: Mapping[str, tuple[tuple[str, str], ...]] = {
    "box": (("size", "size"),),
    "cylinder": (("radius", "radius"), ("length", "length")),
    "capsule": (("radius", "radius"), ("length", "length")),
    "sphere": (("radius", "radius"),),
    "ellipsoid": (("radii", "radii"),),
    "plane": (("normal", "normal"), ("size", "size")),
    "mesh": (("scale", "scale"),),
    "heightmap": (("size", "size"), ("position", "pos")),
}

SHAPES = frozenset(_WORDS) | {"polyline"}


def serialise(root: etree._Element) -> bytes:
    """Serialise the document as indented text, deterministically."""
    etree.indent(root, "  ")
    root.tail = None
    text: bytes = etree.tostring(root, encoding="utf-8")
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + text + b"\n"


def compact(element: etree._Element) -> str:
    """Serialise an element in one line, for storage."""
    tail, element.tail = element.tail, None
    text = etree.tostring(element, encoding="unicode")
    element.tail = tail
    return str(text)


def stem(name: str) -> str:
    """Return the name of a world's file without directory and extensions."""
    base = PurePosixPath(name).name
    for end in (".world.xml", ".world", ".sdf", ".xml", ".yaml", ".yml"):
        if base.lower().endswith(end) and len(base) > len(end):
            return base[: -len(end)]
    return base


def iter_models(root: etree._Element) -> Iterator[etree._Element]:
    """Iterate over the models and lights at the root of a file without a world."""
    yield from root.iterchildren("model", "light", "actor")

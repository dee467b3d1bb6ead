"""SDFormat (Gazebo's worlds and models) as trees: references, poses and frames, geometry <-> ``properties.shapes``.

Rules of SDFormat 1.4 to 1.11, from its specification and from what libsdformat does with them:

- A pose is x, y, z, roll, pitch, yaw (metres; radians, or degrees with ``degrees="true"``; a unit quaternion x, y, z,
  w with ``rotation_format="quat_xyzw"``); rotations are about the fixed axes x, y, z in this order.
- A pose stands in the frame that ``relative_to`` (before 1.7 ``frame``, where it is not empty) names; else in the
  model's frame, in the link's for a collision or visual, in the child link's for a joint.
- The pose of an ``<include>`` takes the place of the model's own; without one the model's own holds.
- ``model.config`` names a model's files by version: the newest that is known is read.
- A reference is looked up in the upload only: ``model://NAME/path`` as the end of a path, nearest to the file that
  names it. What the upload does not have stays a reference.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import Any

import numpy as np
from lxml import etree
from numpy.typing import NDArray

from app.errors import Problem, TooLarge, UnreadableFile
from app.formats import Files, ReadContext, _fields
from app.limits import Limits
from app.model.frame import MAX_METRES
from app.model.solids import matrix
from app.syntax import xml
from app.syntax.decimals import number

Matrix = NDArray[np.float64]

VERSIONS = ("1.4", "1.5", "1.6", "1.7", "1.8", "1.9", "1.10", "1.11")
NEWEST = (1, 11)

MAX_NESTED_MODELS = 32
"""Models in models: real worlds have three."""

MAX_SHAPES = 250_000
"""Shapes of one file, all includes unfolded."""

MODELS = "models"
"""The folder beside ``world.sdf`` that Gazebo is to look for models in."""

BODILESS = frozenset({"sun", "ground_plane"})
"""Models that uploads seldom hold and that stand in no robot's way."""

_BLANK = re.compile(rb"\s+|<\?.*?\?>|<!--.*?-->", re.DOTALL)
_ROOT = re.compile(rb"<sdf[\s>/]")
_REFERENCE = re.compile(
    rb"<(uri|filename|albedo_map|normal_map|roughness_map|metalness_map|environment_map|light_map|emissive_map|"
    rb"ambient_occlusion_map|glossiness_map|specular_map|diffuse|normal|texture|sky|cubemap_uri)\b[^<>]*>([^<>]{1,1024})</"
)
_FETCHED = re.compile(r"(https?|fuel|ign|gz|package|ftp)://", re.IGNORECASE)
_UNSAFE = re.compile(r"[\x00-\x1f\\%~$]")


def is_sdf(data: bytes) -> bool:
    """Whether the root element is ``<sdf>``, whatever blanks and comments stand before it."""
    at = 3 if data.startswith(b"\xef\xbb\xbf") else 0
    while blank := _BLANK.match(data, at):
        at = blank.end()
    return _ROOT.match(data, at) is not None


def contains_element(data: bytes, *tags: bytes) -> bool:
    """Whether there is an element of one of these names outside of comments."""
    bare = without_comments(data)
    return any(re.search(rb"<" + tag + rb"[\s>/]", bare) for tag in tags)


def without_comments(data: bytes) -> bytes:
    """The text between the comments, in linear time; a comment without an end goes to the end."""
    out, at = [], 0
    while (start := data.find(b"<!--", at)) >= 0:
        out.append(data[at:start])
        end = data.find(b"-->", start + 4)
        if end < 0:
            return b"".join(out)
        at = end + 3
    return b"".join([*out, data[at:]])


def unreadable_error(reason: str, element: etree._Element | None = None, where: str | None = None) -> UnreadableFile:
    """The error for something that cannot be used, with the element's line."""
    line = None if element is None else element.sourceline
    location = where or (None if element is None else element_path(element))
    return UnreadableFile(reason, [Problem(reason, line=line, where=location)])


def element_path(element: etree._Element) -> str:
    """An element as users find it: its names from the world down."""
    parts: list[str] = []
    at: etree._Element | None = element
    while at is not None and at.tag not in ("sdf", "world"):
        name = at.get("name")
        parts.append(f"{at.tag} {name}" if name else str(at.tag))
        at = at.getparent()
    return " / ".join(reversed(parts))[:200] or str(element.tag)


def parse(data: bytes, limits: Limits) -> etree._Element:
    """The ``<sdf>`` element without comments and indentation."""
    root = xml.parse(data, limits, remove_blank_text=True)
    if root.tag != "sdf":
        raise unreadable_error(f"the root element must be <sdf>, it is <{str(root.tag)[:80]}>", root)
    return root


_EXTENTS = ("radius", "length", "size", "scale")
_BOOLEANS = ("static", "self_collide", "allow_auto_disable", "cast_shadows")


def report_suspicious_values(root: etree._Element, context: ReadContext) -> None:
    """Report values that SDFormat reads but that hardly mean what they say: turns in degrees, sizes of zero."""
    doubts: dict[str, list[etree._Element]] = {}
    for pose in root.iter("pose"):
        turned = pose.get("degrees") or pose.get("rotation_format")
        angles = [] if turned else element_text(pose).split()[3:6]
        if any(_FLOAT.match(a) and abs(float(a)) > _fields.MAX_USUAL_ANGLE for a in angles):
            doubts.setdefault("a <pose> turned by more than 2π: are its angles in radians?", []).append(pose)
    for name in _EXTENTS:
        for extent in root.iter(name):
            tokens = element_text(extent).split()
            if (
                tokens
                and "geometry" in {a.tag for a in extent.iterancestors()}
                and not any(_FLOAT.match(w) is None or float(w) for w in tokens)
            ):
                doubts.setdefault(f"a <{name}> of 0: the shape has no extent", []).append(extent)
    for name in _BOOLEANS:
        for flag in root.iter(name):
            if element_text(flag).lower() not in ("0", "1", "true", "false"):
                doubts.setdefault(f"<{name}> is {element_text(flag)[:40]!r}, which is taken for false", []).append(flag)
    for reason, elements in doubts.items():
        often = f" ({len(elements)} times)" if len(elements) > 1 else ""
        context.warn(f"{reason}{often}", line=elements[0].sourceline, where=element_path(elements[0]))


_FLOAT = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?\Z", re.ASCII)


def element_text(element: etree._Element | None, tag: str | None = None) -> str:
    """An element's (or its child's) text without blanks around it; empty where there is none."""
    if element is not None and tag is not None:
        element = element.find(tag)
    return "" if element is None else (element.text or "").strip()


def is_true(text: str) -> bool:
    """SDFormat's boolean."""
    return text.strip().lower() in ("1", "true")


def numbers(text: str, element: etree._Element, maximum: float = MAX_METRES) -> list[float]:
    """The numbers of a text. Raises UnreadableFile where there is anything else, or one is not finite or too large."""
    out = []
    for token in text.split():
        try:
            value = float(token) if token.isascii() and "_" not in token else math.nan
        except ValueError:
            value = math.nan
        if not abs(value) <= maximum:
            raise unreadable_error(f"{token[:40]!r} is no finite number within ±{maximum:g}", element)
        out.append(value + 0.0)
    return out


def vector(element: etree._Element | None, tag: str, count: int, default: Sequence[float]) -> list[float]:
    """So many numbers of a child, or the default where it is not there. Raises UnreadableFile for another count."""
    child = None if element is None else element.find(tag)
    if child is None or not element_text(child):
        return list(default)
    values = numbers(element_text(child), child)
    if len(values) != count:
        raise unreadable_error(f"<{tag}> must have {count} numbers, it has {len(values)}", child)
    return values


# --- poses -------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class Pose:
    """What a ``<pose>`` says: [x, y, z, roll, pitch, yaw] in metres and radians, the frame it names, and whether there
    is nothing else in it (a canonical pose can stand for it)."""

    values: tuple[float, ...] = (0.0,) * 6
    relative: str = ""
    plain: bool = True

    @property
    def matrix(self) -> Matrix:
        """As float64 [4, 4]."""
        return matrix(self.values)


ZERO = Pose()


def parse_pose(parent: etree._Element) -> Pose | None:
    """The pose of an element, or None where it says none."""
    element = parent.find("pose")
    if element is None:
        return None
    values = numbers(element_text(element), element)
    attributes = {k: v for k, v in xml.attributes(element).items() if v and k != "degrees"}
    if element.get("rotation_format") == "quat_xyzw":
        if len(values) not in (0, 7):
            raise unreadable_error(f"a pose with a quaternion must have 7 numbers, it has {len(values)}", element)
        values = [*values[:3], *_quaternion_angles(values[3:], element)] if values else [0.0] * 6
    elif len(values) > 6:
        raise unreadable_error(f"a pose must have 6 numbers, it has {len(values)}", element)
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
    """float64 [4, 4] as [x, y, z, roll, pitch, yaw], rounded to a nanometre and a nanoradian."""
    r = transform[:3, :3]
    across = math.hypot(r[0, 0], r[1, 0])
    pitch = math.atan2(-r[2, 0], across)
    if across > 1e-9:
        roll, yaw = math.atan2(r[2, 1], r[2, 2]), math.atan2(r[1, 0], r[0, 0])
    else:  # looking straight up or down: only the sum of roll and yaw counts
        roll, yaw = 0.0, math.atan2(-r[0, 1], r[1, 1])
    return [round(float(v), 9) + 0.0 for v in (*transform[:3, 3], roll, pitch, yaw)]


def pose_element(values: Sequence[float]) -> etree._Element:
    """``<pose>`` of [x, y, z, roll, pitch, yaw]."""
    element = etree.Element("pose")
    element.text = " ".join(number(v) for v in values)
    return element


# --- references --------------------------------------------------------------------------------------------------
class Library:
    """The files of an upload, found by what SDF calls them. Nothing outside of them is ever looked for."""

    def __init__(self, files: Files) -> None:
        self.files = files
        self._by_base: dict[str, list[str]] = {}
        self._folders: dict[str, set[str]] = {}
        for name in files:
            parts = name.split("/")
            self._by_base.setdefault(parts[-1], []).append(name)
            for k in range(1, len(parts)):
                self._folders.setdefault(parts[k - 1], set()).add("/".join(parts[:k]))
        self._inside: dict[str, list[str]] = {}
        self._cache: dict[tuple[str, str], str | None] = {}

    def find(self, reference: str, near: str) -> str | None:
        """The file or folder of the upload that a reference in the file ``near`` means; None where there is none."""
        folder = near.rpartition("/")[0]
        key = (reference, folder)
        if key not in self._cache:
            self._cache[key] = self._find(reference, folder)
        return self._cache[key]

    def _find(self, reference: str, folder: str) -> str | None:
        path = plain_path(reference)
        if path is None:
            return None
        if not re.match(r"[a-z]+://", reference, re.IGNORECASE):
            beside = _join_path(folder, path)
            if beside is not None and (beside in self.files or self._is_folder(beside)):
                return beside
        if path.startswith(f"{MODELS}/") and reference.lower().startswith("file://"):
            nearest = self._nearest(path, folder)
            return nearest or self._nearest(path[len(MODELS) + 1 :], folder)
        return self._nearest(path, folder)

    def _is_folder(self, path: str) -> bool:
        return path in self._folders.get(path.rpartition("/")[2], ())

    def _nearest(self, path: str, folder: str) -> str | None:
        base = path.rpartition("/")[2]
        candidates = [*self._by_base.get(base, ()), *self._folders.get(base, ())]
        fitting = [name for name in candidates if name == path or name.endswith("/" + path)]
        return min(fitting, key=lambda name: (-_common_folders(name, folder), name.count("/"), name), default=None)

    def model_root(self, reference: str, file: str) -> str:
        """The folder around the model that a reference begins with: ``a/b`` for ``model://NAME/x`` in a/b/NAME/x."""
        path = plain_path(reference) or ""
        if reference.lower().startswith("file://") and path.startswith(f"{MODELS}/"):
            path = path[len(MODELS) + 1 :]
        return file[: -len(path)].rstrip("/") if path and file.endswith(path) else file.rpartition("/")[0]

    def inside(self, folder: str) -> list[str]:
        """The files of a folder and of those in it, sorted."""
        if folder not in self._inside:
            self._inside[folder] = sorted(n for n in self.files if n.startswith(folder + "/"))
        return self._inside[folder]

    def files_beside(self, file: str) -> list[str]:
        """A file and those beside it that are called like it: a mesh's materials and texture."""
        folder, _, base = file.rpartition("/")
        name = base.rpartition(".")[0] or base
        same = [f"{folder}/{b}" if folder else b for b in self._by_base if b.rpartition(".")[0] == name]
        return [file, *sorted(n for n in same if n in self.files and n != file)]

    def model_file(self, folder: str) -> str | None:
        """The SDF file of a model's folder: the newest version that ``model.config`` names, else ``model.sdf``."""
        config = self.files.get(f"{folder}/model.config") or self.files.get(f"{folder}/manifest.xml") or b""
        candidates: list[tuple[tuple[int, int], str]] = []
        for version, name in _CONFIG.findall(without_comments(config)):
            path = _join_path(folder, name.decode("utf-8", "replace").strip())
            if path in self.files and path is not None:
                sdf_version = parse_version(version.decode("ascii", "replace"))
                candidates.append((sdf_version or (0, 0), path))
        usable = [f for f in candidates if f[0] <= NEWEST] or candidates
        if usable:
            return max(usable, key=lambda f: f[0])[1]
        default_path = f"{folder}/model.sdf"
        return default_path if default_path in self.files else None


_CONFIG = re.compile(rb"<sdf(?:\s+version\s*=\s*[\"']([^\"'<>]{0,20})[\"'])?[^<>]*>([^<>]{1,512})</sdf>")


def parse_version(text: str | None) -> tuple[int, int] | None:
    """``1.7`` as (1, 7); None where it is no version."""
    match = re.fullmatch(r"\s*(\d{1,3})\.(\d{1,3})(\.\d{1,3})?\s*", text or "", re.ASCII)
    return (int(match[1]), int(match[2])) if match else None


def plain_path(reference: str) -> str | None:
    """The path of a reference below some folder of models; None for addresses of other machines and unsafe paths."""
    text = reference.strip()
    if _FETCHED.match(text):
        return None
    match = re.match(r"(model|file)://", text, re.IGNORECASE)
    path = text[match.end() :] if match else text
    path = path.strip("/")
    parts = [p for p in path.split("/") if p not in ("", ".")]
    if not parts or ".." in parts or _UNSAFE.search(path) or len(path) > 1024:
        return None
    return "/".join(parts)


def is_remote(reference: str) -> bool:
    """Whether a reference names another machine or package system (never fetched)."""
    return _FETCHED.match(reference.strip()) is not None


def references(data: bytes) -> list[str]:
    """What an SDF file refers to, found without parsing it: each address once, in order.

    Also in comments: a model that stands in one for the time being goes along with its world.
    """
    out: dict[str, None] = {}
    for _, text in _REFERENCE.findall(data):
        reference = text.decode("utf-8", "replace").strip()
        for a, b in (("&amp;", "&"), ("&lt;", "<"), ("&gt;", ">"), ("&quot;", '"'), ("&apos;", "'")):
            reference = reference.replace(a, b)
        if ("/" in reference or "." in reference) and re.search("[A-Za-z]", reference):
            out[reference] = None
    return list(out)


def required_files(library: Library, main: str, more: Iterable[str] = ()) -> dict[str, str]:
    """What a world needs of an upload, directly or through other models: path in the upload -> path as it is served.

    A model's folder is needed as a whole and is served as ``models/NAME/…``; a mesh beside the models as
    ``models/<file>``; what a world names relative to itself keeps its place beside it. more: further references.
    """
    roots: dict[str, tuple[str, str]] = {}  # a needed folder or file -> the folder above it, and the one it goes to
    todo, seen = [main], set()
    extra = list(more)
    while todo:
        name = todo.pop()
        if name in seen:
            continue
        seen.add(name)
        paths = references(library.files[name]) + extra
        extra = []
        for reference in paths:
            file = library.find(reference, name)
            if file is None:
                continue
            is_beside = (
                name == main and "://" not in reference and file == _join_path(main.rpartition("/")[0], reference)
            )
            root = main.rpartition("/")[0] if is_beside else library.model_root(reference, file)
            below = file[len(root) + 1 :] if root else file
            entry = file if is_beside else (root + "/" if root else "") + below.split("/")[0]
            entry = file if entry in library.files or not library.inside(entry) else entry
            if not any(entry.startswith(prefix + "/") for prefix in roots):
                roots.setdefault(entry, (root, "" if is_beside else MODELS + "/"))
            inside = [entry] if entry in library.files else library.inside(entry)
            todo += [n for n in inside if n.lower().endswith(".sdf") and n not in seen]
    out: dict[str, str] = {}
    taken = {"world.sdf"}
    for entry in sorted(roots, key=lambda w: (w.count("/"), w)):
        root, folder = roots[entry]
        for name in library.files_beside(entry) if entry in library.files else library.inside(entry):
            path = folder + (name[len(root) + 1 :] if root else name)
            if name == main or name in out or path in taken:
                continue
            out[name] = path
            taken.add(path)
    return out


def _join_path(folder: str, path: str) -> str | None:
    """A path relative to a folder, without leaving the upload; None where it would."""
    parts = folder.split("/") if folder else []
    for part in path.split("/"):
        if part in ("", "."):
            continue
        if part == "..":
            if not parts:
                return None
            parts.pop()
        else:
            parts.append(part)
    return "/".join(parts)


def _common_folders(name: str, folder: str) -> int:
    """How many folders two paths have in common, from the first on."""
    count = 0
    for a, b in zip(name.split("/"), folder.split("/") if folder else [], strict=False):
        if a != b:
            break
        count += 1
    return count


# --- models ------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class Shape:
    """A solid of a model: its words (no pose), and its place in the model's frame as float64 [4, 4]."""

    words: Mapping[str, Any]
    place: Matrix

    def as_dict(self, *, visual: bool = False) -> dict[str, Any]:
        """As an item of ``properties.shapes``."""
        out = dict(self.words)
        pose = six(self.place)
        if any(pose):
            out["pose"] = pose
        return out | {"visual": True} if visual else out


@dataclass(slots=True)
class Body:
    """The solids of a model in its own frame, and the frames in it that others may name."""

    collisions: list[Shape] = field(default_factory=list)
    visuals: list[Shape] = field(default_factory=list)
    frames: _Frames | None = None
    name: str = ""
    pose: Pose | None = None
    kind: str = "model"

    def frame(self, name: str) -> Matrix | None:
        """A frame in the model (``link``, ``model::link``) as float64 [4, 4]; None where there is none."""
        return None if self.frames is None else self.frames.find(name)

    def shapes(self) -> list[dict[str, Any]]:
        """What collides; of a model where nothing does, or not all that does is in the upload, also what is seen."""
        out = [s.as_dict() for s in self.collisions]
        if not out or any(is_absent(s) for s in out):
            out += [s.as_dict(visual=True) for s in self.visuals]
        return out


class ModelFlattener:
    """Models with all that they include as solids in one frame.

    served: path in the upload -> path among the objects' resources.
    """

    def __init__(self, library: Library, served: Mapping[str, str], context: ReadContext) -> None:
        self.library, self.served, self.context = library, served, context
        self._files: dict[str, Body | None] = {}
        self._open: list[str] = []
        self._count = 0
        self._depth = 0
        self._missing: dict[str, int] = {}

    def body(self, model: etree._Element, file: str) -> Body:
        """A model, or a light, without its own pose."""
        out = Body(name=model.get("name", ""), pose=parse_pose(model), kind=str(model.tag))
        if model.tag != "model":
            return out
        if self._depth >= MAX_NESTED_MODELS:
            raise unreadable_error(f"models in models are nested more than {MAX_NESTED_MODELS} deep", model)
        self._depth += 1
        frames = _Frames(self, file)
        inner: list[tuple[str, Body]] = []
        absent: list[etree._Element] = []
        for child in model.iterchildren("link", "frame", "joint", "model", "include"):
            name = child.get("name", "")
            if child.tag == "link":
                frames.add(name, parse_pose(child), "", child)
            elif child.tag == "frame":
                frames.add(name, parse_pose(child), child.get("attached_to", ""), child)
            elif child.tag == "joint":
                frames.add(name, parse_pose(child), element_text(child, "child"), child)
            else:
                inside = self.include(child, file) if child.tag == "include" else self.body(child, file)
                if inside is None:
                    absent.append(child)
                    continue
                include_pose = parse_pose(child) if child.tag == "include" else inside.pose
                name = (element_text(child, "name") if child.tag == "include" else name) or inside.name
                frames.add_model(name, include_pose or inside.pose or ZERO, inside, placement(child, inside), child)
                inner.append((name, inside))
        for link in model.iterchildren("link"):
            at = frames.place(link.get("name", ""))
            for tag, target in (("collision", out.collisions), ("visual", out.visuals)):
                for part in link.iterchildren(tag):
                    pose = frames.within(parse_pose(part), at, part)
                    shapes = self.geometry(part.find("geometry"), file)
                    target += [Shape(shape, pose) for shape in shapes if tag == "collision" or not is_absent(shape)]
        for child in absent:
            pose = frames.within(parse_pose(child), np.eye(4), child)
            out.collisions += [Shape(shape, pose) for shape in absent_model(child)]
        for name, inside in inner:
            at = frames.place(name)
            out.collisions += [Shape(s.words, at @ s.place) for s in inside.collisions]
            out.visuals += [Shape(s.words, at @ s.place) for s in inside.visuals]
            self._check_count(len(inside.collisions) + len(inside.visuals), model)
        out.frames = frames
        self._depth -= 1
        return out

    def _check_count(self, more: int, element: etree._Element) -> None:
        self._count += more
        if self._count > MAX_SHAPES:
            reason = f"the models have more than {MAX_SHAPES} shapes once their includes are unfolded"
            raise TooLarge(reason, [Problem(reason, line=element.sourceline, where=element_path(element))])

    def include(self, element: etree._Element, file: str) -> Body | None:
        """The model that an ``<include>`` names; None, noted as missing, where the upload does not have it."""
        reference = element_text(element, "uri")
        target = self.library.find(reference, file) if reference else None
        path = None
        if target is not None:
            path = target if target in self.library.files else self.library.model_file(target)
        if path is None or not is_sdf(self.library.files[path]):
            self.missing(reference)
            return None
        return self.file(path, element)

    def missing(self, reference: str) -> None:
        """Note a reference that the upload cannot answer, for one warning in the end."""
        self._missing[reference] = self._missing.get(reference, 0) + 1

    def file(self, path: str, element: etree._Element | None = None) -> Body | None:
        """The model of a file; each file is unfolded once. Raises UnreadableFile for one that includes itself."""
        if path in self._open:
            raise unreadable_error(f"{path} includes itself", element)
        if path not in self._files:
            self._open.append(path)
            main, self.context.main = self.context.main, path
            try:
                root = parse(self.library.files[path], self.context.limits)
                model = next((c for c in root.iterchildren("model", "light", "actor")), None)
                self._files[path] = None if model is None else self.body(model, path)
            except (UnreadableFile, TooLarge) as error:
                raise _with_path(error, path) from error
            except etree.XMLSyntaxError as error:
                reason = f"{path} cannot be read: {error.msg}"
                raise UnreadableFile(reason, [Problem(error.msg or "no XML", path, error.lineno)]) from error
            finally:
                self.context.main = main
            self._open.pop()
        return self._files[path]

    def geometry(self, element: etree._Element | None, file: str) -> list[dict[str, Any]]:
        """The shapes of a ``<geometry>``: none where it is empty; see ``is_absent``."""
        if element is None:
            return []
        out: list[dict[str, Any]] = []
        rings: dict[float, list[list[list[float]]]] = {}
        for child in element.iterchildren():
            tag = str(child.tag)
            if tag == "polyline":
                points = [_pair(p) for p in child.iterchildren("point")]
                height = vector(child, "height", 1, (1.0,))[0]
                rings.setdefault(height, []).append(points)
                continue
            shape = self._shape(tag, child, file)
            if shape is not None:
                out.append(shape)
        out += [{"type": "polyline", "points": points, "height": height} for height, points in rings.items()]
        self._check_count(len(out), element)
        return out

    def _shape(self, tag: str, e: etree._Element, file: str) -> dict[str, Any] | None:
        """A shape. One that is unknown or whose file is not in the upload is noted as missing, and stays solid."""
        if tag == "box":
            return {"type": tag, "size": vector(e, "size", 3, (1.0, 1.0, 1.0))}
        if tag in ("cylinder", "capsule"):
            standard = (1.0, 1.0) if tag == "cylinder" else (0.5, 1.0)
            length = {"length": vector(e, "length", 1, standard[1:])[0]}
            return {"type": tag, "radius": vector(e, "radius", 1, standard[:1])[0], **length}
        if tag == "sphere":
            return {"type": tag, "radius": vector(e, "radius", 1, (1.0,))[0]}
        if tag == "ellipsoid":
            return {"type": tag, "radii": vector(e, "radii", 3, (1.0, 1.0, 1.0))}
        if tag == "plane":
            size = vector(e, "size", 2, (1.0, 1.0))
            return {"type": tag, "normal": vector(e, "normal", 3, (0.0, 0.0, 1.0)), "size": size}
        if tag in ("mesh", "heightmap"):
            reference = element_text(e, "uri") or element_text(e, "filename")
            target = self.library.find(reference, file) if reference else None
            path = self.served.get(target) if target is not None and target in self.library.files else None
            if path is None:
                self.missing(reference)
                return {"type": tag, "uri": reference}
            if tag == "mesh":
                out: dict[str, Any] = {"type": tag, "file": path, "scale": vector(e, "scale", 3, (1.0, 1.0, 1.0))}
                part = e.find("submesh")
                if part is not None and element_text(part, "name"):
                    out |= {"submesh": element_text(part, "name"), "center": is_true(element_text(part, "center"))}
                return out
            size, position = vector(e, "size", 3, (1.0, 1.0, 1.0)), vector(e, "pos", 3, (0.0, 0.0, 0.0))
            return {"type": tag, "file": path, "size": size, "position": position}
        if tag == "empty":
            return None
        self.missing(f"<{tag}>")
        return {"type": tag, "uri": f"<{tag}>"}

    def report(self) -> None:
        """One warning for each kind of thing that is not there."""
        for reference, count in sorted(self._missing.items()):
            often = f" ({count} times)" if count > 1 else ""
            if reference.startswith("<"):
                text = f"a geometry of the kind {reference[:40]}{often} is kept, but no solid is known for it"
            elif not reference:
                text = f"an include or mesh without an address{often} is kept as it is"
            elif is_remote(reference):
                text = f"{reference[:200]}{often} is not fetched: supply its folder in models/ with the upload"
            else:
                text = f"{reference[:200]}{often} is not in the upload: supply its files in models/"
            self.context.warn(text, where=reference[:200] or None)


def is_absent(shape: Mapping[str, Any]) -> bool:
    """Whether a shape is a solid that the upload does not tell: a mesh without its file, an unknown geometry."""
    return "uri" in shape and "file" not in shape


def absent_model(include: etree._Element) -> list[dict[str, Any]]:
    """The solids of an ``<include>`` whose model is not in the upload: unknown, but for Gazebo's own sun and ground."""
    reference = element_text(include, "uri")
    name = reference.rstrip("/").rpartition("/")[2].lower().replace(" ", "_")
    return [] if name in BODILESS else [{"type": "model", "uri": reference}]


def _with_path(error: UnreadableFile | TooLarge, path: str) -> UnreadableFile | TooLarge:
    problems = [p if p.file else Problem(p.problem, path, p.line, p.where) for p in error.problems]
    return type(error)(error.detail, problems or [Problem(error.detail, path)])


def _pair(point: etree._Element) -> list[float]:
    values = numbers(element_text(point), point)
    if len(values) != 2:
        raise unreadable_error(f"a point must have 2 numbers, it has {len(values)}", point)
    return values


def placement(element: etree._Element, inside: Body) -> Matrix | None:
    """The inverse of the frame in a model that its pose is meant for (``placement_frame``), if there is one."""
    name = element.get("placement_frame") or element_text(element, "placement_frame")
    at = inside.frame(name) if name else None
    return None if at is None else np.asarray(np.linalg.inv(at), np.float64)


class _Frames:
    """The frames of a model (or of a world) by name, each resolved once along ``relative_to``."""

    def __init__(self, unfolder: ModelFlattener, file: str) -> None:
        self.unfolder, self.file = unfolder, file
        self._said: dict[str, tuple[Pose, str, Matrix | None, etree._Element]] = {}
        self._inner: dict[str, Body] = {}
        self._placed: dict[str, Matrix] = {}

    def add(self, name: str, pose: Pose | None, attached: str, element: etree._Element) -> None:
        """A link, frame or joint. attached: the frame its pose stands in where it names none itself."""
        self._said.setdefault(name, (pose or ZERO, attached, None, element))

    def add_model(self, name: str, pose: Pose, body: Body, back: Matrix | None, element: etree._Element) -> None:
        """A nested model, with the frames in it. back: what ``placement`` gave."""
        if name not in self._said:
            self._inner[name] = body
        self._said.setdefault(name, (pose, "", back, element))

    def place(self, name: str) -> Matrix:
        """A frame in the model's frame. A name that is not known, or whose frames go round in a circle, is warned of
        and stands where the model does."""
        if name in self._placed:
            return self._placed[name]
        chain: list[str] = []
        while name in self._said and name not in self._placed and name not in chain:
            chain.append(name)
            pose, attached, _, _ = self._said[name]
            name = pose.relative or attached
        at = self._base(name, chain)
        for link in reversed(chain):
            pose, _, back, _ = self._said[link]
            at = at @ pose.matrix
            at = at if back is None else at @ back
            self._placed[link] = at
        return at

    def _base(self, name: str, chain: Sequence[str]) -> Matrix:
        if name in self._placed:
            return self._placed[name]
        if name in ("", "__model__", "world", "__root__"):
            return np.eye(4)
        outer, _, inner_name = name.partition("::")
        if inner_name and outer in self._inner and outer not in chain:
            frame = self._inner[outer].frame(inner_name)
            if frame is not None:
                return np.asarray(self.place(outer) @ frame, np.float64)
        element = self._said[chain[-1]][3] if chain else None
        circle = "goes round in a circle" if name in chain else "is not known"
        line = None if element is None else element.sourceline
        location = None if element is None else element_path(element)
        self.unfolder.context.warn(
            f"the frame {name[:80]!r} {circle}: its parent's is taken", line=line, where=location
        )
        return np.eye(4)

    def within(self, pose: Pose | None, parent: Matrix, element: etree._Element) -> Matrix:
        """Something with a pose in a frame of this model."""
        if pose is None:
            return parent
        if not pose.relative:
            return np.asarray(parent @ pose.matrix, np.float64)
        if pose.relative in self._said or "::" in pose.relative or pose.relative == "__model__":
            return np.asarray(self._relative(pose.relative) @ pose.matrix, np.float64)
        reason = f"the frame {pose.relative[:80]!r} is not known: its parent's is taken"
        self.unfolder.context.warn(reason, line=element.sourceline, where=element_path(element))
        return np.asarray(parent @ pose.matrix, np.float64)

    def _relative(self, name: str) -> Matrix:
        return self.place(name) if name in self._said else self._base(name, ())

    def find(self, name: str) -> Matrix | None:
        """A frame of this model or, as ``model::frame``, of one in it; None where there is none."""
        if name in self._said:
            return self.place(name)
        outer, _, inner_name = name.partition("::")
        inside = self._inner[outer].frame(inner_name) if inner_name and outer in self._inner else None
        return None if inside is None else np.asarray(self.place(outer) @ inside, np.float64)


WorldFrames = _Frames


# --- writing -----------------------------------------------------------------------------------------------------
def child(parent: etree._Element, tag: str, text: str | None = None, **attributes: str) -> etree._Element:
    """A new last child."""
    element = etree.SubElement(parent, tag, attributes)
    element.text = text
    return element


def format_numbers(values: Iterable[float]) -> str:
    """Numbers as an SDF text."""
    return " ".join(number(float(v)) for v in values)


def geometry_element(shape: Mapping[str, Any], uri: str | None) -> etree._Element:
    """``<geometry>`` of a shape. uri: the address of its mesh or height map."""
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
    """The document as indented text; the same each time."""
    etree.indent(root, "  ")
    root.tail = None
    text: bytes = etree.tostring(root, encoding="utf-8")
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + text + b"\n"


def compact(element: etree._Element) -> str:
    """An element as text in one line, to be kept."""
    tail, element.tail = element.tail, None
    text = etree.tostring(element, encoding="unicode")
    element.tail = tail
    return str(text)


def stem(name: str) -> str:
    """What a world's file is called, without folder and endings."""
    base = PurePosixPath(name).name
    for end in (".world.xml", ".world", ".sdf", ".xml", ".yaml", ".yml"):
        if base.lower().endswith(end) and len(base) > len(end):
            return base[: -len(end)]
    return base


def iter_models(root: etree._Element) -> Iterator[etree._Element]:
    """The models and lights that stand at the root of a file without a world."""
    yield from root.iterchildren("model", "light", "actor")

"""Shapes of models and their poses, through included and nested models and their frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from lxml import etree

from app.errors import Problem, TooLarge, UnreadableFile
from app.formats import ReadContext
from app.formats.gazebo.library import BODILESS, Library, is_remote
from app.formats.gazebo.sdf import (
    ZERO,
    Matrix,
    Pose,
    element_path,
    element_text,
    is_sdf,
    is_true,
    numbers,
    parse,
    parse_pose,
    six,
    unreadable_error,
    vector,
)

MAX_NESTED_MODELS = 32
"""Maximum nesting depth of models; real worlds have three levels."""

MAX_SHAPES = 250_000
"""Maximum number of shapes of one file after resolving all includes."""


@dataclass(frozen=True, slots=True)
class Shape:
    """Solid of a model: its description (without pose), and its pose in the model's frame as float64 [4, 4]."""

    words: Mapping[str, Any]
    place: Matrix

    def as_dict(self, *, visual: bool = False) -> dict[str, Any]:
        """Return the shape as an item of ``properties.shapes``."""
        out = dict(self.words)
        pose = six(self.place)
        if any(pose):
            out["pose"] = pose
        return out | {"visual": True} if visual else out


@dataclass(slots=True)
class Body:
    """Solids of a model in its own frame, and the model's frames that others can refer to."""

    collisions: list[Shape] = field(default_factory=list)
    visuals: list[Shape] = field(default_factory=list)
    frames: _Frames | None = None
    name: str = ""
    pose: Pose | None = None
    kind: str = "model"

    def frame(self, name: str) -> Matrix | None:
        """Return a frame in the model (``link``, ``model::link``) as float64 [4, 4], or None."""
        return None if self.frames is None else self.frames.find(name)

    def shapes(self) -> list[dict[str, Any]]:
        """Return the collision shapes; also the visual ones if collisions are missing or incomplete in the upload."""
        out = [s.as_dict() for s in self.collisions]
        if not out or any(is_absent(s) for s in out):
            out += [s.as_dict(visual=True) for s in self.visuals]
        return out


class ModelFlattener:
    """Resolver of models and their includes to solids in one frame.

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
        """Resolve a model or a light, without its own pose."""
        out = Body(name=model.get("name", ""), pose=parse_pose(model), kind=str(model.tag))
        if model.tag != "model":
            return out
        if self._depth >= MAX_NESTED_MODELS:
            raise unreadable_error(f"models are nested more than {MAX_NESTED_MODELS} levels deep", model)
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
            reason = f"the models have more than {MAX_SHAPES} shapes with all includes"
            raise TooLarge(reason, [Problem(reason, line=element.sourceline, where=element_path(element))])

    def include(self, element: etree._Element, file: str) -> Body | None:
        """Resolve the model of an ``<include>``; a model that is not in the upload is noted as missing (None)."""
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
        """Count a reference that is not in the upload, for one warning in the end."""
        self._missing[reference] = self._missing.get(reference, 0) + 1

    def file(self, path: str, element: etree._Element | None = None) -> Body | None:
        """Resolve the model of a file, once per file. Raises UnreadableFile if it includes itself."""
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
        """Return the shapes of a ``<geometry>``, none if it is empty; see ``is_absent``."""
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
        """Convert a shape element. Unsupported shapes and missing files are counted as missing and stay solid."""
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
        """Warn once for each missing reference."""
        for reference, count in sorted(self._missing.items()):
            often = f" ({count} times)" if count > 1 else ""
            if reference.startswith("<"):
                text = f"unsupported geometry {reference[:40]}{often}; it is stored without a solid"
            elif not reference:
                text = f"an include or mesh has no URI{often}; it is stored unchanged"
            elif is_remote(reference):
                text = f"{reference[:200]}{often} is remote and not fetched; upload its directory in models/"
            else:
                text = f"{reference[:200]}{often} is not in the upload; upload its files in models/"
            self.context.warn(text, where=reference[:200] or None)


def is_absent(shape: Mapping[str, Any]) -> bool:
    """Check for a solid that the upload does not define: a mesh without its file, an unsupported geometry."""
    return "uri" in shape and "file" not in shape


def absent_model(include: etree._Element) -> list[dict[str, Any]]:
    """Return placeholder solids of an ``<include>`` without its model; none for Gazebo's own sun and ground."""
    reference = element_text(include, "uri")
    name = reference.rstrip("/").rpartition("/")[2].lower().replace(" ", "_")
    return [] if name in BODILESS else [{"type": "model", "uri": reference}]


def _with_path(error: UnreadableFile | TooLarge, path: str) -> UnreadableFile | TooLarge:
    problems = [p if p.file else Problem(p.problem, path, p.line, p.where) for p in error.problems]
    return type(error)(error.detail, problems or [Problem(error.detail, path)])


def _pair(point: etree._Element) -> list[float]:
    values = numbers(element_text(point), point)
    if len(values) != 2:
        raise unreadable_error(f"a point must have 2 numbers, got {len(values)}", point)
    return values


def placement(element: etree._Element, inside: Body) -> Matrix | None:
    """Return the inverse of the model frame that its pose refers to (``placement_frame``), or None."""
    name = element.get("placement_frame") or element_text(element, "placement_frame")
    at = inside.frame(name) if name else None
    return None if at is None else np.asarray(np.linalg.inv(at), np.float64)


class _Frames:
    """Frames of a model (or of a world) by name, each resolved once along ``relative_to``."""

    def __init__(self, unfolder: ModelFlattener, file: str) -> None:
        self.unfolder, self.file = unfolder, file
        self._entries: dict[str, tuple[Pose, str, Matrix | None, etree._Element]] = {}
        self._inner: dict[str, Body] = {}
        self._placed: dict[str, Matrix] = {}

    def add(self, name: str, pose: Pose | None, attached: str, element: etree._Element) -> None:
        """Add a link, frame or joint. attached: frame of its pose if it names none."""
        self._entries.setdefault(name, (pose or ZERO, attached, None, element))

    def add_model(self, name: str, pose: Pose, body: Body, back: Matrix | None, element: etree._Element) -> None:
        """Add a nested model with its frames. back: result of ``placement``."""
        if name not in self._entries:
            self._inner[name] = body
        self._entries.setdefault(name, (pose, "", back, element))

    def place(self, name: str) -> Matrix:
        """Return a frame's pose in the model's frame as float64 [4, 4].

        An unknown name or a cycle of frames gives a warning and the model's own frame.
        """
        if name in self._placed:
            return self._placed[name]
        chain: dict[str, None] = {}  # a set in order: files may have thousands of frames, each relative to the next
        while name in self._entries and name not in self._placed and name not in chain:
            chain[name] = None
            pose, attached, _, _ = self._entries[name]
            name = pose.relative or attached
        at = self._base(name, chain)
        for link in reversed(chain):
            pose, _, back, _ = self._entries[link]
            at = at @ pose.matrix
            at = at if back is None else at @ back
            self._placed[link] = at
        return at

    def _base(self, name: str, chain: dict[str, None]) -> Matrix:
        if name in self._placed:
            return self._placed[name]
        if name in ("", "__model__", "world", "__root__"):
            return np.eye(4)
        outer, _, inner_name = name.partition("::")
        if inner_name and outer in self._inner and outer not in chain:
            frame = self._inner[outer].frame(inner_name)
            if frame is not None:
                return np.asarray(self.place(outer) @ frame, np.float64)
        element = self._entries[next(reversed(chain))][3] if chain else None
        circle = "is part of a cycle" if name in chain else "is unknown"
        line = None if element is None else element.sourceline
        location = None if element is None else element_path(element)
        self.unfolder.context.warn(
            f"the frame {name[:80]!r} {circle}; the parent's frame is used", line=line, where=location
        )
        return np.eye(4)

    def within(self, pose: Pose | None, parent: Matrix, element: etree._Element) -> Matrix:
        """Return a pose in a frame of this model as float64 [4, 4] in the model's frame."""
        if pose is None:
            return parent
        if not pose.relative:
            return np.asarray(parent @ pose.matrix, np.float64)
        if pose.relative in self._entries or "::" in pose.relative or pose.relative == "__model__":
            return np.asarray(self._relative(pose.relative) @ pose.matrix, np.float64)
        reason = f"the frame {pose.relative[:80]!r} is unknown; the parent's frame is used"
        self.unfolder.context.warn(reason, line=element.sourceline, where=element_path(element))
        return np.asarray(parent @ pose.matrix, np.float64)

    def _relative(self, name: str) -> Matrix:
        return self.place(name) if name in self._entries else self._base(name, {})

    def find(self, name: str) -> Matrix | None:
        """Return a frame of this model or, as ``model::frame``, of a nested one; None if unknown."""
        if name in self._entries:
            return self.place(name)
        outer, _, inner_name = name.partition("::")
        inside = self._inner[outer].frame(inner_name) if inner_name and outer in self._inner else None
        return None if inside is None else np.asarray(self.place(outer) @ inside, np.float64)


WorldFrames = _Frames

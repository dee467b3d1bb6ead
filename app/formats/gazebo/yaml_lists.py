"""YAML lists that environment_common generates Gazebo worlds from, read as objects.

Three kinds, distinguished by content:

- ``components``: ``type: {object, reference}``. A custom object is another such list, ``custom_models/<reference>``,
  placed at the component's ``anchor`` (x, y, yaw); anything else is a box, sphere, cylinder, plane or mesh with
  ``position``, ``orientation`` and, if ``collision`` is true, a body. A custom object is one object with all its parts.
- ``models``: instances ``{name, type, position, orientation}``, as a list or by name; the type is a model of the
  upload. ``ground`` is a plane of ``width`` by ``height`` if it is ``flat``.
- named rows of ``coordinates`` with one ``orientation``: known obstacles, one point each.

The generator subtracts the anchor's position instead of adding it, which mirrors anchored components. This reader
applies the intended meaning: the component's pose in the anchor's frame.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from app.errors import Problem, TooLarge, UnreadableFile
from app.formats import ReadContext
from app.formats.gazebo import sdf
from app.formats.gazebo.library import Library, required_files
from app.formats.gazebo.models import MAX_SHAPES, ModelFlattener
from app.model.frame import MAX_METRES, is_writable
from app.model.solids import matrix
from app.syntax import yaml

NAMESPACE = "gazebo"

_COMPONENTS = re.compile(rb"^components[ \t]*:", re.MULTILINE)
_TYPED = re.compile(rb"^[ \t-]*type[ \t]*:|[{,][ \t]*type[ \t]*:", re.MULTILINE)
_MODELS = re.compile(rb"^models[ \t]*:", re.MULTILINE)
_PLACED = re.compile(rb"^[ \t-]*position[ \t]*:|[{,][ \t]*position[ \t]*:", re.MULTILINE)
_ROWS = re.compile(rb"^[ \t-]*coordinates[ \t]*:[ \t]*\r?$", re.MULTILINE)
_TURNED = re.compile(rb"^[ \t-]*orientation[ \t]*:", re.MULTILINE)
_POINT = re.compile(rb"^[ \t]*-[ \t]+x[ \t]*:", re.MULTILINE)
_CUSTOM = re.compile(rb"reference[ \t]*:[ \t]*[\"']?([^\"'\s,}#]{1,256})")
_MESH = re.compile(rb"dae[ \t]*:[ \t]*[\"']?([^\"'\s,}#]{1,256})")
_TYPE = re.compile(rb"^[ \t-]*type[ \t]*:[ \t]*[\"']?([^\"'\s,{}#]{1,256})", re.MULTILINE)

MAX_NESTED_OBJECTS = 8
"""Maximum nesting depth of custom objects; the generator itself supports one level."""

Place = tuple[float, ...]


def detect(name: str, data: bytes) -> bool:
    """Detect one of these lists."""
    if not name.lower().endswith((".yaml", ".yml")):
        return False
    if _COMPONENTS.search(data):
        return _TYPED.search(data) is not None
    if _MODELS.search(data):
        return _TYPED.search(data) is not None and _PLACED.search(data) is not None
    return bool(_ROWS.search(data) and _TURNED.search(data) and _POINT.search(data))


def _custom(library: Library, reference: str, near: str) -> str | None:
    """Find the list or model of a reference, first in ``custom_models`` beside the list."""
    for path in (f"custom_models/{reference}", reference):
        for ending in ("", ".yaml", ".yml"):
            file = library.find(f"model://{path}{ending}", near)
            if file is not None and (file in library.files or library.model_file(file) is not None):
                return file
    return None


def find_required_files(library: Library, main: str) -> list[str]:
    """Return the custom objects, models and meshes that a list needs, also indirectly, and ``models.yaml``."""
    out: dict[str, None] = {}
    todo = [main]
    while todo:
        name = todo.pop()
        data = library.files[name]
        references = [t.decode("utf-8", "replace") for p in (_CUSTOM, _TYPE) for t in p.findall(data)]
        for reference in dict.fromkeys(references):
            file = _custom(library, reference, name)
            if file is None or file in out or file == main:
                continue
            if file in library.files:
                out[file] = None
                if detect(file, library.files[file]):
                    todo.append(file)
            else:
                out.update(dict.fromkeys(required_files(library, main, [f"model://{reference}"])))
        meshes = [t.decode("utf-8", "replace") for t in _MESH.findall(data)]
        out.update(dict.fromkeys(required_files(library, name, meshes)))
    beside = main.rpartition("/")[0] + "/" if "/" in main else ""
    catalogue = beside + "models.yaml"
    if catalogue in library.files and catalogue != main and not detect(catalogue, library.files[catalogue]):
        out[catalogue] = None
    return [name for name in out if name != main]


@dataclass(slots=True)
class ParsedList:
    """Content of a list: objects as (name, properties), the rest, and path in the upload -> resource path."""

    objects: list[tuple[str, dict[str, Any]]] = field(default_factory=list)
    rest: dict[str, Any] = field(default_factory=dict)
    served: dict[str, str] = field(default_factory=dict)


def read(library: Library, main: str, context: ReadContext) -> ParsedList:
    """Read a list with everything it refers to. Raises UnreadableFile or TooLarge."""
    data = yaml.load(library.files[main], context.limits)
    reader = _Reader(library, main, context)
    if isinstance(data, Mapping) and "components" in data:
        reader.components(data["components"])
        section_names = {"components"}
    elif isinstance(data, Mapping) and "models" in data:
        reader.models(data["models"], data.get("ground"))
        section_names = {"models", "ground"}
    elif isinstance(data, (list, Mapping)):
        reader.rows(data)
        section_names = set(data) if isinstance(data, Mapping) else set()
    else:
        raise _unreadable_error("must be a list of objects", "")
    if isinstance(data, Mapping):
        reader.result.rest = (
            {"rest": extra_members}
            if (extra_members := {str(k): v for k, v in data.items() if k not in section_names})
            else {}
        )
    reader.unfolder.report()
    return reader.result


def _unreadable_error(reason: str, location: str) -> UnreadableFile:
    return UnreadableFile(f"{location}: {reason}" if location else reason, [Problem(reason, where=location or None)])


def _number(value: Any, location: str, maximum: float = MAX_METRES) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= maximum:
        raise _unreadable_error(f"must be a finite number within ±{maximum:g}, got {str(value)[:40]!r}", location)
    return float(value) + 0.0


def _members(members: Any, names: Sequence[str], location: str, default: float = 0.0) -> list[float]:
    """Parse numbers of a mapping (``{x: …, y: …}``); missing ones get the default."""
    if members is None:
        members = {}
    if not isinstance(members, Mapping):
        raise _unreadable_error(f"must be a mapping with {', '.join(names)}", location)
    return [_number(members.get(name, default), f"{location}.{name}") for name in names]


def _pose(members: Mapping[str, Any], location: str) -> Place:
    """Parse ``position`` and ``orientation`` to [x, y, z, roll, pitch, yaw]."""
    position = _members(members.get("position"), ("x", "y", "z"), f"{location}.position")
    turned = _members(members.get("orientation"), ("roll", "pitch", "yaw"), f"{location}.orientation")
    return (*position, *turned)


def _text(value: Any, location: str) -> str:
    text = str(value)
    if isinstance(value, (Mapping, list)) or not text or len(text) > 256 or not is_writable(text):
        raise _unreadable_error("must be a name of 1 to 256 characters without control characters", location)
    return text


def _list(items: Any, location: str) -> list[Mapping[str, Any]]:
    if items is None:
        return []
    if not isinstance(items, list) or not all(isinstance(item, Mapping) for item in items):
        raise _unreadable_error("must be a list of mappings", location)
    return items


class _Reader:
    """Reader of one list."""

    def __init__(self, library: Library, main: str, context: ReadContext) -> None:
        self.library, self.main, self.context = library, main, context
        self.result = ParsedList()
        self.unfolder = ModelFlattener(library, self.result.served, context)
        self._lists: dict[str, list[Mapping[str, Any]]] = {}
        self._count = 0

    def _add(self, name: str, properties: dict[str, Any]) -> None:
        self.result.objects.append((name, properties))
        if len(self.result.objects) > self.context.limits.features:
            raise TooLarge(f"the list has more than {self.context.limits.features} objects")

    # components

    def components(self, items: Any) -> None:
        """Read one object for each component of the list itself."""
        for k, item in enumerate(_list(items, "components")):
            location = f"components[{k}]"
            kind, reference = self._type(item, location)
            anchor = self._anchor(item, location)
            name = _text(item.get("name", reference.rpartition(".")[0] or reference), f"{location}.name")
            source_properties = {
                str(a): b for a, b in item.items() if a not in ("name", "anchor", "position", "orientation", "type")
            }
            source_properties["type"] = item["type"]
            if kind == "custom":
                shapes = list(self._custom(reference, self.main, location, ()))
                pose = list(anchor)
            else:
                shapes = [self._shape(item, reference, self.main, location)]
                pose = sdf.six(matrix(anchor) @ matrix(_pose(item, location)))
            properties: dict[str, Any] = {"kind": "model", "name": name, "pose": pose, NAMESPACE: source_properties}
            if shapes:
                properties["shapes"] = shapes
            self._add(name, properties)

    def _type(self, item: Mapping[str, Any], location: str) -> tuple[str, str]:
        members = item.get("type")
        if not isinstance(members, Mapping) or "reference" not in members:
            raise _unreadable_error("must be {object: custom or primitive, reference: NAME}", f"{location}.type")
        return str(members.get("object", "")), _text(members["reference"], f"{location}.type.reference")

    def _anchor(self, item: Mapping[str, Any], location: str) -> Place:
        anchor = item.get("anchor")
        if anchor is None:
            return (0.0,) * 6
        if not isinstance(anchor, Mapping):
            raise _unreadable_error("must be a mapping with position and orientation", f"{location}.anchor")
        return _pose(anchor, f"{location}.anchor")

    def _custom(self, reference: str, near: str, location: str, above: tuple[str, ...]) -> Iterator[dict[str, Any]]:
        """Iterate over the shapes of a custom object in its own frame."""
        path = _custom(self.library, reference, near)
        if path is None or path not in self.library.files or not detect(path, self.library.files[path]):
            if path is not None and path not in self.library.files:
                yield from self._model(path, reference)
            else:
                self.unfolder.missing(f"custom_models/{reference}")
                yield {"type": "model", "uri": f"custom_models/{reference}"}
            return
        if path in above or len(above) >= MAX_NESTED_OBJECTS:
            raise _unreadable_error(
                f"custom object {reference} includes itself or is nested more than {MAX_NESTED_OBJECTS} levels deep",
                location,
            )
        if path not in self._lists:
            document = yaml.load(self.library.files[path], self.context.limits)
            self._lists[path] = _list(document.get("components") if isinstance(document, Mapping) else None, path)
        for k, item in enumerate(self._lists[path]):
            item_location = f"{reference}: components[{k}]"
            kind, inner = self._type(item, item_location)
            anchor = matrix(self._anchor(item, item_location))
            if kind == "custom":
                for shape in self._custom(inner, path, item_location, (*above, path)):
                    yield self._place_shape(shape, anchor @ matrix(shape.get("pose", (0.0,) * 6)))
            else:
                yield self._place_shape(
                    self._shape(item, inner, path, item_location), anchor @ matrix(_pose(item, item_location))
                )

    def _place_shape(self, shape: Mapping[str, Any], at: sdf.Matrix) -> dict[str, Any]:
        self._count += 1
        if self._count > MAX_SHAPES:
            raise TooLarge(f"the custom objects have more than {MAX_SHAPES} shapes")
        out = {k: v for k, v in shape.items() if k != "pose"}
        pose = sdf.six(at)
        return out | {"pose": pose} if any(pose) else out

    def _shape(self, item: Mapping[str, Any], reference: str, near: str, location: str) -> dict[str, Any]:
        """Convert a primitive without its pose; ``visual`` if it has no ``collision``. See ``sdf.is_absent``."""
        out: dict[str, Any]
        if reference == "sphere":
            out = {"type": reference, "radius": _number(item.get("radius"), f"{location}.radius")}
        elif reference == "cylinder":
            out = {"type": reference, "radius": _number(item.get("radius"), f"{location}.radius")}
            out["length"] = _number(item.get("length"), f"{location}.length")
        elif reference == "box":
            out = {"type": reference, "size": _members(item.get("size"), ("x", "y", "z"), f"{location}.size", 1.0)}
        elif reference == "plane":
            size = [_number(item.get(key), f"{location}.{key}") for key in ("width", "length")]
            out = {"type": reference, "normal": [0.0, 0.0, 1.0], "size": size}
        elif reference == "mesh":
            uri = _text(item.get("dae"), f"{location}.dae")
            self.result.served.update(required_files(self.library, near, [uri]))
            file = self.library.find(uri, near)
            path = self.result.served.get(file) if file is not None else None
            if path is None:
                self.unfolder.missing(uri)
                out = {"type": reference, "uri": uri}
            else:
                out = {"type": reference, "file": path, "scale": [1.0, 1.0, 1.0]}
        else:
            self.unfolder.missing(f"<{reference[:40]}>")
            out = {"type": reference[:40], "uri": f"<{reference[:40]}>"}
        return out if item.get("collision") is True else {**out, "visual": True}

    # models

    def models(self, models: Any, ground: Any) -> None:
        """Read instances of models, and the ground."""
        if isinstance(ground, Mapping) and ground.get("flat") is True:
            size = [_number(ground.get(key), f"ground.{key}") for key in ("width", "height")]
            plane = {"type": "plane", "normal": [0.0, 0.0, 1.0], "size": size}
            pose = [0.0] * 6
            source_properties = {"ground": dict(ground)}
            self._add(
                "ground_plane",
                {
                    "kind": "model",
                    "name": "ground_plane",
                    "pose": pose,
                    "shapes": [plane],
                    NAMESPACE: source_properties,
                },
            )
        elif ground is not None:
            self.result.rest["ground"] = ground
        items: list[tuple[Any, Any]]
        if isinstance(models, Mapping):
            items = [(name, item) for name, item in models.items()]
        else:
            items = [(item.get("name"), item) for item in _list(models, "models")]
        for k, (called, item) in enumerate(items):
            location = f"models[{k}]"
            if not isinstance(item, Mapping):
                raise _unreadable_error("must be a mapping with type, position and orientation", location)
            name = _text(called, f"{location}.name")
            kind = _text(item.get("type"), f"{location}.type")
            source_properties = {str(a): b for a, b in item.items() if a not in ("name", "position", "orientation")}
            properties: dict[str, Any] = {
                "kind": "model",
                "name": name,
                "pose": list(_pose(item, location)),
                NAMESPACE: source_properties,
            }
            if shapes := list(self._custom(kind, self.main, location, ())):
                properties["shapes"] = shapes
            self._add(name, properties)

    def _model(self, folder: str, reference: str) -> list[dict[str, Any]]:
        """Return the shapes of a model directory."""
        self.result.served.update(required_files(self.library, self.main, [f"model://{reference}"]))
        file = self.library.model_file(folder)
        body = None if file is None else self.unfolder.file(file)
        if body is None:
            self.unfolder.missing(f"custom_models/{reference}")
            return [{"type": "model", "uri": f"custom_models/{reference}"}]
        body_pose = sdf.ZERO if body.pose is None else body.pose
        return [self._place_shape(s, body_pose.matrix @ matrix(s.get("pose", (0.0,) * 6))) for s in body.shapes()]

    # rows

    def rows(self, node: Any, path: tuple[str, ...] = ()) -> None:
        """Read obstacles: mappings with ``coordinates`` at any depth, named by their path."""
        if isinstance(node, Mapping):
            if isinstance(node.get("coordinates"), list):
                self._row(node, path)
                return
            for name, inner in node.items():
                self.rows(inner, (*path, str(name)))
        elif isinstance(node, list):
            for inner in node:
                self.rows(inner, path)
        elif node is not None:
            raise _unreadable_error(f"must be rows with coordinates, got {str(node)[:40]!r}", "/".join(path))

    def _row(self, row: Mapping[str, Any], path: tuple[str, ...]) -> None:
        location = "/".join(path)
        yaw = math.remainder(_number(row.get("orientation", 0.0), f"{location}.orientation"), math.tau)
        source_properties = {str(k): v for k, v in row.items() if k not in ("coordinates", "orientation")}
        source_properties["row"] = location
        for k, item in enumerate(row["coordinates"]):
            position = _members(item, ("x", "y", "z"), f"{location}[{k}]")
            name = _text(f"{location}/{k}".strip("/"), location)
            pose = [*position, 0.0, 0.0, yaw]
            self._add(name, {"kind": "obstacle", "name": name, "pose": pose, NAMESPACE: source_properties})

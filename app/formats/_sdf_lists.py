"""The YAML lists that environment_common makes Gazebo worlds from, as objects.

Three kinds, told by their content:

- ``components``: ``type: {object, reference}``. A custom object is another such list, ``custom_models/<reference>``,
  placed at the component's ``anchor`` (x, y, yaw); anything else is a box, sphere, cylinder, plane or mesh with
  ``position``, ``orientation`` and, if ``collision`` is true, a body. A custom object is one object with all its parts.
- ``models``: instances ``{name, type, position, orientation}``, as a list or by name; the type is a model of the
  upload. ``ground`` is a plane of ``width`` by ``height`` where it says ``flat``.
- named rows of ``coordinates`` with one ``orientation``: known obstacles, a point each.

The generator takes the anchor's position off instead of adding it, which mirrors what is anchored; what is meant, and
done here, is the component's pose in the anchor's frame.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from app.errors import Problem, TooLarge, UnreadableFile
from app.formats import ReadContext, _sdf, _yaml
from app.model.frame import MAX_METRES, is_writable
from app.model.solids import matrix

OWN = "gazebo"

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

DEEPEST = 8
"""Custom objects in custom objects; the generator itself knows one step."""

Place = tuple[float, ...]


def detect(name: str, data: bytes) -> bool:
    """Whether a YAML file is one of these lists."""
    if not name.lower().endswith((".yaml", ".yml")):
        return False
    if _COMPONENTS.search(data):
        return _TYPED.search(data) is not None
    if _MODELS.search(data):
        return _TYPED.search(data) is not None and _PLACED.search(data) is not None
    return bool(_ROWS.search(data) and _TURNED.search(data) and _POINT.search(data))


def _custom(library: _sdf.Library, reference: str, near: str) -> str | None:
    """The list or model that a reference names: in ``custom_models`` beside the list first."""
    for said in (f"custom_models/{reference}", reference):
        for ending in ("", ".yaml", ".yml"):
            found = library.find(f"model://{said}{ending}", near)
            if found is not None and (found in library.files or library.model_file(found) is not None):
                return found
    return None


def needed(library: _sdf.Library, main: str) -> list[str]:
    """The custom objects, models and meshes that a list needs, directly or through others, and ``models.yaml``."""
    out: dict[str, None] = {}
    todo = [main]
    while todo:
        name = todo.pop()
        data = library.files[name]
        said = [t.decode("utf-8", "replace") for p in (_CUSTOM, _TYPE) for t in p.findall(data)]
        for reference in dict.fromkeys(said):
            found = _custom(library, reference, name)
            if found is None or found in out or found == main:
                continue
            if found in library.files:
                out[found] = None
                if detect(found, library.files[found]):
                    todo.append(found)
            else:
                out.update(dict.fromkeys(_sdf.needed(library, main, [f"model://{reference}"])))
        meshes = [t.decode("utf-8", "replace") for t in _MESH.findall(data)]
        out.update(dict.fromkeys(_sdf.needed(library, name, meshes)))
    beside = main.rpartition("/")[0] + "/" if "/" in main else ""
    catalogue = beside + "models.yaml"
    if catalogue in library.files and catalogue != main and not detect(catalogue, library.files[catalogue]):
        out[catalogue] = None
    return [name for name in out if name != main]


@dataclass(slots=True)
class Found:
    """Objects as (name, properties), the rest of the list, and path in the upload -> path of a resource."""

    objects: list[tuple[str, dict[str, Any]]] = field(default_factory=list)
    rest: dict[str, Any] = field(default_factory=dict)
    served: dict[str, str] = field(default_factory=dict)


def read(library: _sdf.Library, main: str, context: ReadContext) -> Found:
    """A list with all it refers to. Raises UnreadableFile or TooLarge."""
    data = _yaml.load(library.files[main], context.limits)
    reader = _Reader(library, main, context)
    if isinstance(data, Mapping) and "components" in data:
        reader.components(data["components"])
        known = {"components"}
    elif isinstance(data, Mapping) and "models" in data:
        reader.models(data["models"], data.get("ground"))
        known = {"models", "ground"}
    elif isinstance(data, (list, Mapping)):
        reader.rows(data)
        known = set(data) if isinstance(data, Mapping) else set()
    else:
        raise _refused("it must be a list of objects", "")
    if isinstance(data, Mapping):
        reader.found.rest = {"rest": rest} if (rest := {str(k): v for k, v in data.items() if k not in known}) else {}
    reader.unfolder.report()
    return reader.found


def _refused(reason: str, where: str) -> UnreadableFile:
    return UnreadableFile(f"{where}: {reason}" if where else reason, [Problem(reason, where=where or None)])


def _number(value: Any, where: str, most: float = MAX_METRES) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) <= most:
        raise _refused(f"must be a finite number within ±{most:g}, got {str(value)[:40]!r}", where)
    return float(value) + 0.0


def _members(said: Any, names: Sequence[str], where: str, default: float = 0.0) -> list[float]:
    """Numbers of a mapping (``{x: …, y: …}``), the default where one is not there."""
    if said is None:
        said = {}
    if not isinstance(said, Mapping):
        raise _refused(f"must be a mapping with {', '.join(names)}", where)
    return [_number(said.get(name, default), f"{where}.{name}") for name in names]


def _pose(said: Mapping[str, Any], where: str) -> Place:
    """[x, y, z, roll, pitch, yaw] of ``position`` and ``orientation``."""
    position = _members(said.get("position"), ("x", "y", "z"), f"{where}.position")
    turned = _members(said.get("orientation"), ("roll", "pitch", "yaw"), f"{where}.orientation")
    return (*position, *turned)


def _text(value: Any, where: str) -> str:
    text = str(value)
    if isinstance(value, (Mapping, list)) or not text or len(text) > 256 or not is_writable(text):
        raise _refused("must be a name of 1 to 256 characters without control characters", where)
    return text


def _list(said: Any, where: str) -> list[Mapping[str, Any]]:
    if said is None:
        return []
    if not isinstance(said, list) or not all(isinstance(item, Mapping) for item in said):
        raise _refused("must be a list of mappings", where)
    return said


class _Reader:
    """A list being read."""

    def __init__(self, library: _sdf.Library, main: str, context: ReadContext) -> None:
        self.library, self.main, self.context = library, main, context
        self.found = Found()
        self.unfolder = _sdf.Unfolder(library, self.found.served, context)
        self._lists: dict[str, list[Mapping[str, Any]]] = {}
        self._count = 0

    def _add(self, name: str, said: dict[str, Any]) -> None:
        self.found.objects.append((name, said))
        if len(self.found.objects) > self.context.limits.features:
            raise TooLarge(f"the list has more than {self.context.limits.features} objects")

    # components

    def components(self, said: Any) -> None:
        """One object for each component of the list itself."""
        for k, item in enumerate(_list(said, "components")):
            where = f"components[{k}]"
            kind, reference = self._type(item, where)
            anchor = self._anchor(item, where)
            name = _text(item.get("name", reference.rpartition(".")[0] or reference), f"{where}.name")
            own = {str(a): b for a, b in item.items() if a not in ("name", "anchor", "position", "orientation", "type")}
            own["type"] = item["type"]
            if kind == "custom":
                shapes = list(self._custom(reference, self.main, where, ()))
                pose = list(anchor)
            else:
                shapes = [self._shape(item, reference, self.main, where)]
                pose = _sdf.six(matrix(anchor) @ matrix(_pose(item, where)))
            properties: dict[str, Any] = {"kind": "model", "name": name, "pose": pose, OWN: own}
            if shapes:
                properties["shapes"] = shapes
            self._add(name, properties)

    def _type(self, item: Mapping[str, Any], where: str) -> tuple[str, str]:
        said = item.get("type")
        if not isinstance(said, Mapping) or "reference" not in said:
            raise _refused("must say {object: custom or primitive, reference: what}", f"{where}.type")
        return str(said.get("object", "")), _text(said["reference"], f"{where}.type.reference")

    def _anchor(self, item: Mapping[str, Any], where: str) -> Place:
        said = item.get("anchor")
        if said is None:
            return (0.0,) * 6
        if not isinstance(said, Mapping):
            raise _refused("must be a mapping with position and orientation", f"{where}.anchor")
        return _pose(said, f"{where}.anchor")

    def _custom(self, reference: str, near: str, where: str, above: tuple[str, ...]) -> Iterator[dict[str, Any]]:
        """The shapes of a custom object in its own frame."""
        path = _custom(self.library, reference, near)
        if path is None or path not in self.library.files or not detect(path, self.library.files[path]):
            if path is not None and path not in self.library.files:
                yield from self._model(path, reference)
            else:
                self.unfolder.missing(f"custom_models/{reference}")
                yield {"type": "model", "uri": f"custom_models/{reference}"}
            return
        if path in above or len(above) >= DEEPEST:
            raise _refused(f"custom object {reference} includes itself, or is nested more than {DEEPEST} deep", where)
        if path not in self._lists:
            said = _yaml.load(self.library.files[path], self.context.limits)
            self._lists[path] = _list(said.get("components") if isinstance(said, Mapping) else None, path)
        for k, item in enumerate(self._lists[path]):
            place = f"{reference}: components[{k}]"
            kind, inner = self._type(item, place)
            anchor = matrix(self._anchor(item, place))
            if kind == "custom":
                for shape in self._custom(inner, path, place, (*above, path)):
                    yield self._placed(shape, anchor @ matrix(shape.get("pose", (0.0,) * 6)))
            else:
                yield self._placed(self._shape(item, inner, path, place), anchor @ matrix(_pose(item, place)))

    def _placed(self, shape: Mapping[str, Any], at: _sdf.Matrix) -> dict[str, Any]:
        self._count += 1
        if self._count > _sdf.MOST_SHAPES:
            raise TooLarge(f"the custom objects have more than {_sdf.MOST_SHAPES} shapes")
        out = {k: v for k, v in shape.items() if k != "pose"}
        pose = _sdf.six(at)
        return out | {"pose": pose} if any(pose) else out

    def _shape(self, item: Mapping[str, Any], reference: str, near: str, where: str) -> dict[str, Any]:
        """A primitive without its pose; ``visual`` where it says no ``collision``. See ``_sdf.is_absent``."""
        out: dict[str, Any]
        if reference == "sphere":
            out = {"type": reference, "radius": _number(item.get("radius"), f"{where}.radius")}
        elif reference == "cylinder":
            out = {"type": reference, "radius": _number(item.get("radius"), f"{where}.radius")}
            out["length"] = _number(item.get("length"), f"{where}.length")
        elif reference == "box":
            out = {"type": reference, "size": _members(item.get("size"), ("x", "y", "z"), f"{where}.size", 1.0)}
        elif reference == "plane":
            size = [_number(item.get(word), f"{where}.{word}") for word in ("width", "length")]
            out = {"type": reference, "normal": [0.0, 0.0, 1.0], "size": size}
        elif reference == "mesh":
            uri = _text(item.get("dae"), f"{where}.dae")
            self.found.served.update(_sdf.needed(self.library, near, [uri]))
            file = self.library.find(uri, near)
            path = self.found.served.get(file) if file is not None else None
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

    def models(self, said: Any, ground: Any) -> None:
        """Instances of models, and the ground."""
        if isinstance(ground, Mapping) and ground.get("flat") is True:
            size = [_number(ground.get(word), f"ground.{word}") for word in ("width", "height")]
            plane = {"type": "plane", "normal": [0.0, 0.0, 1.0], "size": size}
            pose = [0.0] * 6
            own = {"ground": dict(ground)}
            self._add(
                "ground_plane", {"kind": "model", "name": "ground_plane", "pose": pose, "shapes": [plane], OWN: own}
            )
        elif ground is not None:
            self.found.rest["ground"] = ground
        items: list[tuple[Any, Any]]
        if isinstance(said, Mapping):
            items = [(name, item) for name, item in said.items()]
        else:
            items = [(item.get("name"), item) for item in _list(said, "models")]
        for k, (called, item) in enumerate(items):
            where = f"models[{k}]"
            if not isinstance(item, Mapping):
                raise _refused("must be a mapping with type, position and orientation", where)
            name = _text(called, f"{where}.name")
            kind = _text(item.get("type"), f"{where}.type")
            own = {str(a): b for a, b in item.items() if a not in ("name", "position", "orientation")}
            properties: dict[str, Any] = {"kind": "model", "name": name, "pose": list(_pose(item, where)), OWN: own}
            if shapes := list(self._custom(kind, self.main, where, ())):
                properties["shapes"] = shapes
            self._add(name, properties)

    def _model(self, folder: str, reference: str) -> list[dict[str, Any]]:
        """The shapes of a model folder."""
        self.found.served.update(_sdf.needed(self.library, self.main, [f"model://{reference}"]))
        file = self.library.model_file(folder)
        body = None if file is None else self.unfolder.file(file)
        if body is None:
            self.unfolder.missing(f"custom_models/{reference}")
            return [{"type": "model", "uri": f"custom_models/{reference}"}]
        own = _sdf.ZERO if body.pose is None else body.pose
        return [self._placed(s, own.matrix @ matrix(s.get("pose", (0.0,) * 6))) for s in body.shapes()]

    # rows

    def rows(self, said: Any, path: tuple[str, ...] = ()) -> None:
        """Obstacles: every mapping with ``coordinates``, however deep, called by the names above it."""
        if isinstance(said, Mapping):
            if isinstance(said.get("coordinates"), list):
                self._row(said, path)
                return
            for name, inner in said.items():
                self.rows(inner, (*path, str(name)))
        elif isinstance(said, list):
            for inner in said:
                self.rows(inner, path)
        elif said is not None:
            raise _refused(f"must be rows with coordinates, got {str(said)[:40]!r}", "/".join(path))

    def _row(self, said: Mapping[str, Any], path: tuple[str, ...]) -> None:
        where = "/".join(path)
        yaw = math.remainder(_number(said.get("orientation", 0.0), f"{where}.orientation"), math.tau)
        own = {str(k): v for k, v in said.items() if k not in ("coordinates", "orientation")}
        own["row"] = where
        for k, item in enumerate(said["coordinates"]):
            position = _members(item, ("x", "y", "z"), f"{where}[{k}]")
            name = _text(f"{where}/{k}".strip("/"), where)
            pose = [*position, 0.0, 0.0, yaw]
            self._add(name, {"kind": "obstacle", "name": name, "pose": pose, OWN: own})

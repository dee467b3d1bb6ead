"""Reading worlds: each model, include and light as an object with its footprint."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import orjson
import shapely
from lxml import etree

from app.errors import Invalid, TooLarge
from app.formats import Files, ReadContext
from app.formats.gazebo import sdf, yaml_lists
from app.formats.gazebo.elements import ELEMENTS
from app.formats.gazebo.library import Library, parse_version, required_files
from app.formats.gazebo.models import Body, ModelFlattener, WorldFrames, absent_model, is_absent, placement
from app.model import solids
from app.model.features import features, unique_ids
from app.model.frame import Datum, is_writable
from app.model.layers import Layers, PartKey, Resources
from app.syntax import xml

NAME = "gazebo"
OBJECTS = ("model", "include", "light")

SAME_POSE = 1e-6


def read(files: Files, context: ReadContext) -> Layers:
    """Read the worlds of a file. Raises UnreadableFile (with file, line and element) or TooLarge."""
    main = context.main or next(iter(files))
    library = Library(files)
    if not sdf.is_sdf(files[main]) and yaml_lists.detect(main, files[main]):
        return _read_list(library, main, context)
    root = sdf.parse(files[main], context.limits)
    xml.report_active_content(files[main], context.warn, has_scripts=True)
    xml.report_unknown_elements(files[main], root, ELEMENTS, context.warn, free={"plugin"})
    sdf.report_suspicious_values(root, context)
    version = parse_version(root.get("version"))
    if version is None or not (1, 4) <= version <= sdf.NEWEST:
        version_text = root.get("version")
        context.warn(
            f"SDFormat version {version_text!r} is not one of 1.4 to 1.11; the file is read as 1.7",
            line=root.sourceline,
        )
    served = required_files(library, main)
    reader = _Reader(ModelFlattener(library, served, context), main, {served[n]: files[n] for n in served}, context)
    worlds = root.findall("world")
    for k, world in enumerate(worlds):
        name = _key(main) if not k else f"{_key(main)}#{k + 1}"
        reader.world(world, name, root.get("version", ""))
    if not worlds:
        alone = etree.Element("world")
        alone.extend(list(sdf.iter_models(root)))
        if not len(alone):
            raise sdf.unreadable_error("the file contains no world, model or light", root)
        reader.world(alone, _key(main), root.get("version", ""), alone=True)
    reader.unfolder.report()
    return reader.layers()


def model_files(library: Library, main: str) -> list[str]:
    """Return the files in a single model's own directory."""
    folder = main.rpartition("/")[0]
    if not folder or (main.rpartition("/")[2] != "model.sdf" and f"{folder}/model.config" not in library.files):
        return []
    return [name for name in library.inside(folder) if name != main]


def _key(main: str) -> str:
    """Return a world's key: its file path without the extension."""
    folder, slash, base = main.rpartition("/")
    return folder + slash + sdf.stem(base)


@dataclass(slots=True)
class _Reader:
    """Reader of the objects and the rest of a file's worlds."""

    unfolder: ModelFlattener
    main: str
    resources: dict[str, bytes]
    context: ReadContext
    rows: list[tuple[str, Any, dict[str, Any]]] = field(default_factory=list)
    worlds: dict[str, dict[str, Any]] = field(default_factory=dict)
    datum: Datum | None = None

    def layers(self) -> Layers:
        """Return the layers. Objects with the same name get unique ids."""
        ids = unique_ids(name for name, _, _ in self.rows)
        rows = [(i, g, p) for i, (_, g, p) in zip(ids, self.rows, strict=True)]
        level = self.context.level
        document = {NAME: {"worlds": self.worlds}}
        parts: dict[PartKey, Any] = {PartKey("objects", level, NAME): features(rows, "local", document)}
        if self.resources and self.context.wants("resources"):
            parts[PartKey("resources", level, NAME)] = Resources(self.resources)
        return Layers(parts, self.datum)

    def world(self, world: etree._Element, key: str, version: str, *, alone: bool = False) -> None:
        """Read a world: its objects, and the rest as a document."""
        elements = []
        frames = WorldFrames(self.unfolder, self.main)
        for element in world.iterchildren("frame"):
            frames.add(element.get("name", ""), sdf.parse_pose(element), element.get("attached_to", ""), element)
        for element in world.iterchildren(*OBJECTS):
            body = self._body(element)
            name = self._name(element, body)
            element_pose = sdf.parse_pose(element)
            body_pose = body.pose if body is not None and element.tag == "include" else None
            back = None if body is None else placement(element, body)
            frames.add_model(name, element_pose or body_pose or sdf.ZERO, body or Body(), back, element)
            elements.append((element, body, name, element_pose, body_pose, back))
        moved = self._state(world)
        footprints = Footprints(self.resources, self.context)
        seen: set[str] = set()
        for element, body, name, element_pose, body_pose, back in elements:
            source_pose = element_pose or body_pose or sdf.ZERO
            simple = not source_pose.relative and back is None
            if name in seen:
                self.context.warn(
                    "duplicate object name in the world; the objects get unique ids",
                    line=element.sourceline,
                    where=name[:80],
                )
            pose = list(source_pose.values) if simple or name in seen else sdf.six(frames.place(name))
            seen.add(name)
            source_properties: dict[str, Any] = {"world": key}
            if not (simple and (element_pose.plain if element_pose is not None else element.tag != "include")):
                source_properties["pose"] = pose
            if element.tag == "include" and not sdf.element_text(element, "name"):
                source_properties["name"] = name
            if name in moved and not _is_same_pose(moved[name], pose):
                source_properties["state"] = moved[name]
            self._add(element, body, name, pose, source_properties, footprints)
        self._report_state(moved, key, {name for _, _, name, _, _, _ in elements})
        remainder = etree.Element("world", dict(world.attrib))
        for child in world:
            if child.tag not in (*OBJECTS, "state") and isinstance(child.tag, str):
                remainder.append(child)
        entry: dict[str, Any] = {"sdf": sdf.compact(remainder), "version": version}
        if alone:
            entry["alone"] = True
        datum = self._datum(remainder.find("spherical_coordinates"))
        if datum is not None:
            entry["datum"] = [datum.latitude, datum.longitude, datum.altitude, datum.heading]
        self.worlds[key] = entry

    def _body(self, element: etree._Element) -> Body | None:
        if element.tag == "include":
            return self.unfolder.include(element, self.main)
        return self.unfolder.body(element, self.main)

    def _name(self, element: etree._Element, body: Body | None) -> str:
        """Return the object's name; an include without one is named like its model."""
        name = sdf.element_text(element, "name") if element.tag == "include" else element.get("name", "")
        if not name:
            reference = sdf.element_text(element, "uri").rstrip("/")
            name = (body.name if body is not None else "") or reference.rpartition("/")[2] or str(element.tag)
        if len(name) > 256 or not is_writable(name):
            raise sdf.unreadable_error("a name must have at most 256 characters and no control characters", element)
        return name

    def _add(
        self,
        element: etree._Element,
        body: Body | None,
        name: str,
        pose: list[float],
        source_properties: dict[str, Any],
        footprints: Footprints,
    ) -> None:
        properties: dict[str, Any] = {"kind": str(element.tag), "name": name, "pose": pose}
        shapes = absent_model(element) if body is None else body.shapes() if body.kind == "model" else []
        if shapes:
            properties["shapes"] = shapes
        shape, size = footprints.footprint_and_size(properties, name)
        if size is not None:
            properties["size"] = size
        if "pose" not in source_properties:
            for old in element.findall("pose"):
                element.remove(old)
        if element.tag != "include" and "name" in element.attrib:
            del element.attrib["name"]
        source_properties["sdf"] = sdf.compact(element)
        properties[NAME] = source_properties
        self.rows.append((name, shape, properties))

    # saved state and datum

    def _state(self, world: etree._Element) -> dict[str, list[float]]:
        """Return the poses of the models in the last ``<state>``, by name."""
        out = {}
        for state in world.iterchildren("state"):
            for model in state.iterchildren("model", "light"):
                pose = sdf.parse_pose(model)
                if pose is not None:
                    out[model.get("name", "")] = list(pose.values)
            if state.find("insertions") is not None:
                reason = "the <insertions> of the <state> are dropped; save the world with them as models"
                self.context.warn(reason, line=state.sourceline, where="state")
        return out

    def _report_state(self, moved: Mapping[str, list[float]], key: str, names: set[str]) -> None:
        off = [p["name"] for _, _, p in self.rows if p.get(NAME, {}).get("world") == key and "state" in p[NAME]]
        if off:
            self.context.warn(
                f"the saved <state> is dropped: it moves {len(off)} of {len(names)} objects ({_shorten(off)}); the "
                "poses in <world> are kept",
                where="state",
            )
        strangers = sorted(set(moved) - names)
        if strangers:
            self.context.warn(
                f"the <state> names {len(strangers)} unknown objects: {_shorten(strangers)}; they are ignored",
                where="state",
            )

    def _datum(self, element: etree._Element | None) -> Datum | None:
        """Return the datum of spherical coordinates, or None if they give no geographic position."""
        if element is None:
            return None
        surface = sdf.element_text(element, "surface_model") or "EARTH_WGS84"
        axes = sdf.element_text(element, "world_frame_orientation") or "ENU"
        if surface != "EARTH_WGS84" or axes != "ENU":
            self.context.warn(
                f"surface model {surface} with axes {axes} is unsupported; the world gives no datum",
                line=element.sourceline,
            )
            return None
        latitude, longitude, elevation, heading = (
            sdf.vector(element, tag, 1, (0.0,))[0]
            for tag in ("latitude_deg", "longitude_deg", "elevation", "heading_deg")
        )
        if latitude == 0.0 and longitude == 0.0:
            return None
        if heading == 180.0:
            reason = "heading_deg 180 is used as given; worlds for old Gazebo versions set it to work around a bug"
            self.context.warn(reason, line=element.sourceline, where="heading_deg")
        turned = math.remainder(-heading, 360.0)
        datum = Datum(latitude, longitude, elevation, turned)
        current = self.context.frame.datum if self.context.frame is not None else None
        if current is not None and current != datum:
            self.context.warn(
                f"the world's origin {latitude!r}, {longitude!r} (heading {turned:g}°) differs from the environment's "
                f"datum {current.latitude!r}, {current.longitude!r} (heading {current.heading:g}°), which is kept; "
                "change the environment's datum or the world",
                line=element.sourceline,
                where="spherical_coordinates",
            )
        elif self.datum is None:
            self.datum = datum
        return datum


@dataclass(slots=True)
class Footprints:
    """Footprints and sizes of objects, computed once for equal shapes."""

    resources: Mapping[str, bytes]
    context: ReadContext
    _solid: solids.Solids | None = None
    _flat: solids.Solids | None = None
    _cache: dict[bytes, tuple[Any, list[float] | None]] = field(default_factory=dict)
    _warned: set[str] = field(default_factory=set)

    def footprint_and_size(self, properties: Mapping[str, Any], name: str) -> tuple[Any, list[float] | None]:
        """Return the footprint in local metres (a point without solids) and the size in the object's frame."""
        pose = properties["pose"]
        point = shapely.Point(pose[:2])
        if not properties.get("shapes"):
            return point, None
        key = orjson.dumps([properties["shapes"], *(pose[3:5] if any(pose[3:5]) else ())])
        if key not in self._cache:
            self._cache[key] = self._compute(properties, name)
        area, size = self._cache[key]
        if area is None or shapely.is_empty(area):
            return point, size
        c, s = math.cos(pose[5]), math.sin(pose[5])
        turn = np.array([[c, s], [-s, c]])
        position = np.array(pose[:2])
        return shapely.transform(area, lambda at: np.round(at @ turn + position, 9) + 0.0), size

    def _compute(self, properties: Mapping[str, Any], name: str) -> tuple[Any, list[float] | None]:
        if self._solid is None or self._flat is None:
            self._solid = solids.Solids(self.resources, planes=False, visuals=True)
            self._flat = solids.Solids(self.resources, planes=True, visuals=True)
        readable = [shape for shape in properties["shapes"] if self._is_readable(shape, name)]
        alone = {"shapes": [shape for shape in readable if not shape.get("visual")] or readable}
        tilted = {**alone, "pose": [0.0, 0.0, 0.0, *properties["pose"][3:5], 0.0]}
        try:
            area = self._solid.footprint(tilted)
            area = self._flat.footprint(tilted) if shapely.is_empty(area) else area
            size = self._solid.size(alone) or self._flat.size(alone)
        except (Invalid, TooLarge) as error:
            self._warn_once(error, name)
            return None, None
        return area, None if size is None else [round(float(v), 9) + 0.0 for v in size]

    def _is_readable(self, shape: Mapping[str, Any], name: str) -> bool:
        """Check that a solid can be read; for one that is not in the upload a warning exists already."""
        try:
            (self._flat or solids.Solids(self.resources)).shape(shape)
        except (Invalid, TooLarge) as error:
            if not is_absent(shape):
                self._warn_once(error, name)
            return False
        return True

    def _warn_once(self, error: Invalid | TooLarge, name: str) -> None:
        if error.detail not in self._warned:
            self._warned.add(error.detail)
            file = error.problems[0].file if error.problems else None
            self.context.warn(f"the solids are unknown: {error.detail}"[:500], file=file, where=name[:80])


def _shorten(names: Sequence[str]) -> str:
    """Join the first names of a long list."""
    return ", ".join(n[:60] for n in names[:12]) + (" …" if len(names) > 12 else "")


def _is_same_pose(a: Sequence[float], b: Sequence[float]) -> bool:
    return bool(np.abs(solids.matrix(a) - solids.matrix(b)).max() <= SAME_POSE)


def _read_list(library: Library, main: str, context: ReadContext) -> Layers:
    """Read an environment_common list of objects as a separate world."""
    listing = yaml_lists.read(library, main, context)
    resources = {path: library.files[name] for name, path in listing.served.items()}
    footprints = Footprints(resources, context)
    rows = []
    key = _key(main)
    for name, properties in listing.objects:
        shape, size = footprints.footprint_and_size(properties, name)
        source_properties = {**properties.get(NAME, {}), "world": key}
        rows.append((name, shape, {**properties, **({"size": size} if size else {}), NAME: source_properties}))
    ids = unique_ids(name for name, _, _ in rows)
    document = {NAME: {"worlds": {key: {"list": True, **listing.rest}}}}
    objects = features([(i, g, p) for i, (_, g, p) in zip(ids, rows, strict=True)], "local", document)
    parts: dict[PartKey, Any] = {PartKey("objects", context.level, NAME): objects}
    if resources and context.wants("resources"):
        parts[PartKey("resources", context.level, NAME)] = Resources(resources)
    return Layers(parts)

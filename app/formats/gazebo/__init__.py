"""Gazebo worlds: SDFormat 1.4 to 1.11, with the models, meshes and materials they need.

A file is a world (``.world``, ``.world.xml``, ``.sdf``), a lone ``model.sdf`` (a world of one model), or one of the
lists that environment_common makes worlds from (``objects.yaml``, ``known_obstacles.yaml``; see ``gazebo.yaml_lists``).

Canonical: each direct model, include and light of a world is an object of the kind ``model``, ``include`` or ``light``,
called by its name, with its ``pose`` and, where the upload tells its solids, ``shapes``, ``size`` and a footprint in
local metres. The rest of its element is kept as text in ``properties.gazebo.sdf``, that of the world (physics, scene,
plugins, wind …) in ``document.gazebo.worlds``. Where a pose says more than six numbers (``relative_to``,
``placement_frame``, an include's own pose) its text stays, with the ``pose`` it means beside it: it holds as long as
nobody moves the object. The worlds of one upload lie in one part side by side; ``world`` says which is written.

``<state>`` is not kept: what it moves is warned of and noted under ``properties.gazebo.state``. Files of models are
kept byte for byte as resources, as ``models/NAME/…``.

Frame: ``spherical_coordinates`` is the datum. Its heading is the angle from east to the world's x axis,
counter-clockwise seen from above (libignition-math: LOCAL2 to SPHERICAL), so the datum's heading, clockwise, is its
negative. Gazebo's frame is the tangent plane and ours a projection: 1 km from the datum they differ by millimetres.
Latitude and longitude 0 are Gazebo's default and no place.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import orjson
import shapely
from lxml import etree

from app.errors import BadUpload, Invalid, MissingLayer, NotFound, TooLarge
from app.formats import (
    Claims,
    Files,
    Format,
    LayerRequirements,
    ReadContext,
    Selection,
    Traits,
    WriteContext,
    register,
)
from app.formats._select import select_part
from app.formats.gazebo import sdf, yaml_lists
from app.formats.gazebo.bodies import Bodies, BodyDefaults, free_name, slug, sun, valid
from app.formats.gazebo.elements import KNOWN
from app.limits import Limits
from app.model import masks, solids, worlds
from app.model.features import Feature, Features, features, unique_ids
from app.model.frame import GROUND, Datum, is_writable
from app.model.grid import OccupancyGrid
from app.model.layers import Layers, PartKey, Resources
from app.parameters import parameter
from app.syntax import xml
from app.syntax.decimals import DEGREES, number

NAME = "gazebo"
MAIN = "world.sdf"
OBJECTS = ("model", "include", "light")
NO_WALLS = ("keepout", "speed", "nogo")
"""Grids that are masks: they are no walls unless one is asked for by its name."""

OF_GRIDS = "occupancy"
"""The family of objects that were made of a grid (``occupancy_to_objects``)."""

SAME_POSE = 1e-6


@dataclass(frozen=True, slots=True)
class WriteOptions(BodyDefaults):
    """Which world, and what is made of objects and grids that no world has told of."""

    world: str | None = parameter(
        None, "name of the stored world's file (with or without folders); default: gazebo…, else the shortest"
    )
    content: Literal["auto", "world", "all"] = parameter(
        "auto",
        "world: the stored world as it is; all: the other formats' objects and the grid's walls with it; auto: the "
        "world where one is stored, else all",
    )
    version: Literal["1.4", "1.5", "1.6", "1.7", "1.8", "1.9", "1.10", "1.11"] | None = parameter(
        None, "SDFormat version that the file says; default: the stored world's, else 1.7"
    )
    georeference: bool = parameter(
        False, "put the environment's datum in the place of spherical_coordinates 0, 0, which are Gazebo's default"
    )
    grid: str | None = parameter(None, "grid whose occupied cells become walls; default: map, else the only one")
    level: str | None = parameter(None, "level of the objects and the grid; default: all, and the grid's own")
    threshold: int = parameter(65, "cell value from which on a cell is a wall", minimum=1, maximum=100)


# --- telling -----------------------------------------------------------------------------------------------------
def detect(name: str, data: bytes) -> bool:
    """A root element ``<sdf>`` with a world, model or light, or a list of the generator's."""
    if sdf.is_sdf(data):
        return sdf.contains_element(data, b"world", b"model", b"light")
    return yaml_lists.detect(name, data)


def sort(files: Files, mains: Sequence[str]) -> dict[str, list[str]]:
    """Worlds and lists are maps of their own; a model only where there is no world in the upload and no other model
    includes it. With each come the model folders and files that it needs, also through other models."""
    library = sdf.Library(files)
    lists = [n for n in mains if not sdf.is_sdf(files[n])]
    worlds = [n for n in mains if sdf.is_sdf(files[n]) and sdf.contains_element(files[n], b"world")]
    out = {name: list(sdf.required_files(library, name)) for name in worlds}
    parts = {name: yaml_lists.required_files(library, name) for name in lists}
    inner = {other for name, companions in parts.items() for other in companions if other != name}
    for name in lists:
        if name not in inner or not set(lists) - inner:
            out[name] = parts[name]
    if not out:
        out = _lone_models(library, [n for n in mains if sdf.is_sdf(files[n])])
    return out


def _lone_models(library: sdf.Library, models: Sequence[str]) -> dict[str, list[str]]:
    """Of an upload without a world the models that ``model.config`` chooses and no other model includes."""
    mains = []
    for name in models:
        folder = name.rpartition("/")[0]
        config = f"{folder}/model.config" if folder else "model.config"
        if config not in library.files or library.model_file(folder) in (name, None):
            mains.append(name)
    out = {name: [*sdf.required_files(library, name), *_model_files(library, name)] for name in mains}
    inner = {other for name, companions in out.items() for other in companions if other != name}
    free = {name: companions for name, companions in out.items() if name not in inner}
    # Models that include each other all the way round: one of them tells what is wrong.
    return free or dict(sorted(out.items())[:1])


# --- reading -----------------------------------------------------------------------------------------------------
def read(files: Files, context: ReadContext) -> Layers:
    """The worlds of a file. Raises UnreadableFile (with file, line and element) or TooLarge."""
    main = context.main or next(iter(files))
    library = sdf.Library(files)
    if not sdf.is_sdf(files[main]) and yaml_lists.detect(main, files[main]):
        return _read_list(library, main, context)
    root = sdf.parse(files[main], context.limits)
    xml.report_active_content(files[main], context.warn, has_scripts=True)
    xml.report_unknown_elements(files[main], root, KNOWN, context.warn, free={"plugin"})
    sdf.report_suspicious_values(root, context)
    version = sdf.parse_version(root.get("version"))
    if version is None or not (1, 4) <= version <= sdf.NEWEST:
        version_text = root.get("version")
        context.warn(f"SDFormat version {version_text!r} is not one of 1.4 to 1.11: read as 1.7", line=root.sourceline)
    served = sdf.required_files(library, main)
    reader = _Reader(sdf.ModelFlattener(library, served, context), main, {served[n]: files[n] for n in served}, context)
    worlds = root.findall("world")
    for k, world in enumerate(worlds):
        name = _key(main) if not k else f"{_key(main)}#{k + 1}"
        reader.world(world, name, root.get("version", ""))
    if not worlds:
        alone = etree.Element("world")
        alone.extend(list(sdf.iter_models(root)))
        if not len(alone):
            raise sdf.unreadable_error("there is no world, model or light in it", root)
        reader.world(alone, _key(main), root.get("version", ""), alone=True)
    reader.unfolder.report()
    return reader.layers()


def _model_files(library: sdf.Library, main: str) -> list[str]:
    """What lies in a lone model's own folder."""
    folder = main.rpartition("/")[0]
    if not folder or (main.rpartition("/")[2] != "model.sdf" and f"{folder}/model.config" not in library.files):
        return []
    return [name for name in library.inside(folder) if name != main]


def _key(main: str) -> str:
    """A world's name in the store: its file's path without the ending."""
    folder, slash, base = main.rpartition("/")
    return folder + slash + sdf.stem(base)


@dataclass(slots=True)
class _Reader:
    """The objects and the rest of a file's worlds."""

    unfolder: sdf.ModelFlattener
    main: str
    resources: dict[str, bytes]
    context: ReadContext
    rows: list[tuple[str, Any, dict[str, Any]]] = field(default_factory=list)
    worlds: dict[str, dict[str, Any]] = field(default_factory=dict)
    datum: Datum | None = None

    def layers(self) -> Layers:
        """All of it. Objects of one name get ids of their own."""
        ids = unique_ids(name for name, _, _ in self.rows)
        rows = [(i, g, p) for i, (_, g, p) in zip(ids, self.rows, strict=True)]
        level = self.context.level
        document = {NAME: {"worlds": self.worlds}}
        parts: dict[PartKey, Any] = {PartKey("objects", level, NAME): features(rows, "local", document)}
        if self.resources and self.context.wants("resources"):
            parts[PartKey("resources", level, NAME)] = Resources(self.resources)
        return Layers(parts, self.datum)

    def world(self, world: etree._Element, key: str, version: str, *, alone: bool = False) -> None:
        """Take a world apart."""
        elements = []
        frames = sdf.WorldFrames(self.unfolder, self.main)
        for element in world.iterchildren("frame"):
            frames.add(element.get("name", ""), sdf.parse_pose(element), element.get("attached_to", ""), element)
        for element in world.iterchildren(*OBJECTS):
            body = self._body(element)
            name = self._name(element, body)
            element_pose = sdf.parse_pose(element)
            body_pose = body.pose if body is not None and element.tag == "include" else None
            back = None if body is None else sdf.placement(element, body)
            frames.add_model(name, element_pose or body_pose or sdf.ZERO, body or sdf.Body(), back, element)
            elements.append((element, body, name, element_pose, body_pose, back))
        moved = self._state(world)
        footprints = Footprints(self.resources, self.context)
        seen: set[str] = set()
        for element, body, name, element_pose, body_pose, back in elements:
            source_pose = element_pose or body_pose or sdf.ZERO
            simple = not source_pose.relative and back is None
            if name in seen:
                self.context.warn("two objects of the world have this name", line=element.sourceline, where=name[:80])
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

    def _body(self, element: etree._Element) -> sdf.Body | None:
        if element.tag == "include":
            return self.unfolder.include(element, self.main)
        return self.unfolder.body(element, self.main)

    def _name(self, element: etree._Element, body: sdf.Body | None) -> str:
        """What the object is called: an include without a name like its model."""
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
        body: sdf.Body | None,
        name: str,
        pose: list[float],
        source_properties: dict[str, Any],
        footprints: Footprints,
    ) -> None:
        properties: dict[str, Any] = {"kind": str(element.tag), "name": name, "pose": pose}
        shapes = sdf.absent_model(element) if body is None else body.shapes() if body.kind == "model" else []
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

    # what the world was saved with

    def _state(self, world: etree._Element) -> dict[str, list[float]]:
        """Poses of the models of the last ``<state>``, by name."""
        out = {}
        for state in world.iterchildren("state"):
            for model in state.iterchildren("model", "light"):
                pose = sdf.parse_pose(model)
                if pose is not None:
                    out[model.get("name", "")] = list(pose.values)
            if state.find("insertions") is not None:
                reason = "the state's <insertions> are not kept: save the world with them as models"
                self.context.warn(reason, line=state.sourceline, where="state")
        return out

    def _report_state(self, moved: Mapping[str, list[float]], key: str, names: set[str]) -> None:
        off = [p["name"] for _, _, p in self.rows if p.get(NAME, {}).get("world") == key and "state" in p[NAME]]
        if off:
            self.context.warn(
                f"the saved <state> moves {len(off)} of {len(names)} objects ({_shorten(off)}); it is not kept, the "
                "poses of the world itself are",
                where="state",
            )
        strangers = sorted(set(moved) - names)
        if strangers:
            self.context.warn(
                f"the <state> names {len(strangers)} that are not there: {_shorten(strangers)}", where="state"
            )

    def _datum(self, element: etree._Element | None) -> Datum | None:
        """The datum that spherical coordinates mean; None where they tell no place on earth."""
        if element is None:
            return None
        surface = sdf.element_text(element, "surface_model") or "EARTH_WGS84"
        axes = sdf.element_text(element, "world_frame_orientation") or "ENU"
        if surface != "EARTH_WGS84" or axes != "ENU":
            self.context.warn(f"a world on {surface} with axes {axes} gives no datum", line=element.sourceline)
            return None
        latitude, longitude, elevation, heading = (
            sdf.vector(element, tag, 1, (0.0,))[0]
            for tag in ("latitude_deg", "longitude_deg", "elevation", "heading_deg")
        )
        if latitude == 0.0 and longitude == 0.0:
            return None
        if heading == 180.0:
            reason = "heading_deg 180 is taken as it stands; worlds for old Gazebo versions used it against a bug"
            self.context.warn(reason, line=element.sourceline, where="heading_deg")
        turned = math.remainder(-heading, 360.0)
        datum = Datum(latitude, longitude, elevation, turned)
        current = self.context.frame.datum if self.context.frame is not None else None
        if current is not None and current != datum:
            self.context.warn(
                f"its place {latitude!r}, {longitude!r} (heading {turned:g}°) is not the environment's datum "
                f"{current.latitude!r}, {current.longitude!r} (heading {current.heading:g}°), which stays: change the "
                "environment's datum, or the world",
                line=element.sourceline,
                where="spherical_coordinates",
            )
        elif self.datum is None:
            self.datum = datum
        return datum


@dataclass(slots=True)
class Footprints:
    """Footprints and sizes of objects; those of equal shapes are worked out once."""

    resources: Mapping[str, bytes]
    context: ReadContext
    _solid: solids.Solids | None = None
    _flat: solids.Solids | None = None
    _cache: dict[bytes, tuple[Any, list[float] | None]] = field(default_factory=dict)
    _warned: set[str] = field(default_factory=set)

    def footprint_and_size(self, properties: Mapping[str, Any], name: str) -> tuple[Any, list[float] | None]:
        """The footprint in local metres (a point where no solid is known) and the size in the object's own frame."""
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
        """Whether a solid can be read; of one that is not in the upload the reader has warned already."""
        try:
            (self._flat or solids.Solids(self.resources)).shape(shape)
        except (Invalid, TooLarge) as error:
            if not sdf.is_absent(shape):
                self._warn_once(error, name)
            return False
        return True

    def _warn_once(self, error: Invalid | TooLarge, name: str) -> None:
        if error.detail not in self._warned:
            self._warned.add(error.detail)
            file = error.problems[0].file if error.problems else None
            self.context.warn(f"its solids are not known: {error.detail}"[:500], file=file, where=name[:80])


def _shorten(names: Sequence[str]) -> str:
    """The first names of many."""
    return ", ".join(n[:60] for n in names[:12]) + (" …" if len(names) > 12 else "")


def _is_same_pose(a: Sequence[float], b: Sequence[float]) -> bool:
    return bool(np.abs(solids.matrix(a) - solids.matrix(b)).max() <= SAME_POSE)


def _read_list(library: sdf.Library, main: str, context: ReadContext) -> Layers:
    """The generator's list of objects as a world of its own."""
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


# --- writing -----------------------------------------------------------------------------------------------------
def choose(keys: Sequence[PartKey], options: WriteOptions) -> list[PartKey]:
    """All objects and their files, and one grid for walls: the named one, else ``map``, else the only one.

    Objects that were made of a level's grid stand for it, unless it is named.
    """
    matches = [k for k in keys if k.layer in ("objects", "resources") and options.level in (None, k.level)]
    grids = [k for k in keys if k.layer == "occupancy"]
    if options.grid is None:
        object_levels = {k.level for k in matches if (k.layer, k.name) == ("objects", OF_GRIDS)}
        grids = [k for k in grids if k.name not in NO_WALLS and k.level not in object_levels]
        names = {k.name for k in grids}
        if any(k.layer == "objects" for k in matches) and len(names) > 1 and "map" not in names:
            return matches
    if not grids and options.grid is None:
        if not any(k.layer == "objects" for k in matches):
            raise MissingLayer("there is nothing to build a world of: supply objects or an occupancy grid")
        return matches
    supply = "supply a map.yaml with its image, or objects"
    return matches + select_part(
        grids, "occupancy", options.grid, options.level, noun="grid", option="grid", supply=supply
    )


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """``world.sdf`` and ``models/…``."""
    return _Writer(layers, context, context.options).files()


@dataclass(frozen=True, slots=True)
class _StoredWorld:
    """A stored world: what it says, its objects, and where they lie."""

    key: str
    entry: Mapping[str, Any]
    objects: list[Feature]

    @property
    def is_world(self) -> bool:
        return "sdf" in self.entry and not self.entry.get("alone")

    @property
    def rank(self) -> tuple[Any, ...]:
        return worlds.rank(self.key, self.entry)


class _Writer:
    """One world from what is stored."""

    def __init__(self, layers: Layers, context: WriteContext, options: WriteOptions) -> None:
        self.layers, self.context, self.options = layers, context, options
        self.resources = layers.resources()
        self.made: list[tuple[str, etree._Element]] = []
        self.taken: set[str] = set()
        self.stored: list[_StoredWorld] = []
        self.others: list[tuple[PartKey, Features]] = []
        self.loose: list[Feature] = []
        self._sort()

    def _sort(self) -> None:
        for key, part in self.layers.vector("objects", self.options.level).items():
            if key.name != NAME:
                if len(part):
                    self.others.append((key, part))
                continue
            source_document = part.document.get(NAME)
            worlds = source_document.get("worlds") if isinstance(source_document, Mapping) else None
            worlds = (
                {str(k): w for k, w in worlds.items() if isinstance(w, Mapping)} if isinstance(worlds, Mapping) else {}
            )
            by_world: dict[str, list[Feature]] = {name: [] for name in worlds}
            for one in part:
                source_properties = one.properties.get(NAME)
                name = source_properties.get("world") if isinstance(source_properties, Mapping) else None
                by_world.get(str(name), self.loose).append(one)
            for name, entry in worlds.items():
                if "sdf" in entry or by_world[name]:
                    self.stored.append(_StoredWorld(name, entry, by_world[name]))
        self.stored.sort(key=lambda world: world.rank)

    def _select_world(self) -> _StoredWorld | None:
        world_name = self.options.world
        if world_name is not None:
            matches = [w for w in self.stored if world_name in (w.key, sdf.stem(w.key))]
            if not matches:
                names = ", ".join(w.key for w in self.stored) or "none"
                raise NotFound(f"there is no world {world_name!r}; there are: {names}")
            return matches[0]
        if len(self.stored) > 1:
            names = ", ".join(w.key for w in self.stored[1:])
            self.context.warn(f"written is the world {self.stored[0].key}; ask for another one with world=: {names}")
        return self.stored[0] if self.stored else None

    def files(self) -> dict[str, bytes]:
        """The world first."""
        source_world = self._select_world()
        for other in self.stored:
            if other is not source_world:
                self.context.drop(
                    f"objects of the world {other.key}", len(other.objects), f"ask with world={other.key}"
                )
        world = self._frame(source_world)
        for one in sorted(source_world.objects if source_world is not None else [], key=lambda o: _natural(o.id)):
            self._restore_object(one)
        bodies = Bodies(self.context, self.resources, self.options)
        self._make_models(bodies, [(self.options.level or GROUND, one) for one in self.loose])
        everything = self.options.content == "all" or (
            self.options.content == "auto" and not (source_world is not None and source_world.is_world)
        )
        why = "a world is stored: ask for them with content=all"
        if everything:
            rows = []
            for key, part in self.others:
                placed = part.in_local(self.layers.frame)
                for one, geometry in zip(part, placed, strict=True):
                    rows.append((key.level, Feature(one.id, geometry, one.properties, "local")))
            self._make_models(bodies, rows)
        else:
            self.context.drop("objects of other formats", sum(len(p) for _, p in self.others), why)
        for key, grid in self.layers.grids().items():
            if masks.NAME in grid.properties and self.options.grid is None:
                continue  # it tells where robots should go, not what stands there
            has_objects = any(other.level == key.level for other, _ in self.others)
            if self.options.grid is None and everything and has_objects and _is_slice(grid):
                continue  # its walls are these objects
            if everything or self.options.grid is not None:
                name = free_name(f"walls_{slug(key.name)}", self.taken)
                model = bodies.walls(grid, name, self.options.threshold, self.layers.elevation(key.level))
                if model is not None:
                    self.made.append((name, model))
            else:
                self.context.drop(f"walls of the grid {key.name}", 1, why)
        if source_world is None or not source_world.is_world:
            self._furnish(bodies)
        bodies.report()
        self._place(world, source_world)
        world.extend([element for _, element in sorted(self.made, key=lambda row: _natural(row[0]))])
        return self._bundle(world, source_world, bodies)

    def _frame(self, source_world: _StoredWorld | None) -> etree._Element:
        """The world's element with all that is no object."""
        if source_world is not None and "sdf" in source_world.entry:
            world = _element(str(source_world.entry["sdf"]), ("world",))
            if world is not None:
                if not world.get("name"):
                    first = next(
                        (str(o.properties.get("name") or o.id) for o in source_world.objects), self.context.title
                    )
                    world.set("name", first)
                for tag in ("frame", "actor", "joint", "population", "road"):
                    self.taken.update(e.get("name", "") for e in world.iterchildren(tag))
                return world
            self.context.warn(f"what was kept of the world {source_world.key} cannot be read: it is left out")
        return etree.Element("world", name=valid(sdf.stem(source_world.key) if source_world else self.context.title))

    def _restore_object(self, one: Feature) -> None:
        """An object of the stored world as it was, under its present name and pose."""
        source_properties = one.properties.get(NAME, {})
        text = source_properties.get("sdf")
        element = _element(text, OBJECTS) if isinstance(text, str) else None
        if element is None:
            if isinstance(text, str):
                self.context.warn("its element cannot be read: made anew from its shapes", where=one.id)
            self.loose.append(one)
            return
        name = one.properties.get("name")
        name = name if isinstance(name, str) and name else one.id
        if element.tag == "include":
            name_element = element.find("name")
            if name_element is not None:
                name_element.text = name
            elif source_properties.get("name") != name:
                name_element = etree.Element("name")
                name_element.text = name
                element.append(name_element)
        else:
            attributes = xml.attributes(element)
            element.attrib.clear()
            element.attrib.update({"name": name, **attributes})
        if name in self.taken:
            self.context.warn("two objects of the world have this name, which Gazebo refuses", where=name)
        self.taken.add(name)
        pose = one.properties.get("pose")
        pose = [float(v) for v in pose] if _is_pose(pose) and pose is not None else [0.0] * 6
        if source_properties.get("pose") is None or [float(v) for v in source_properties["pose"]] != pose:
            for old in element.findall("pose"):
                element.remove(old)
            for old in element.findall("placement_frame"):
                element.remove(old)
            element.attrib.pop("placement_frame", None)
            if element.tag == "include" or any(pose):
                element.insert(0, sdf.pose_element(pose))
        self.made.append((name, element))

    def _make_models(self, bodies: Bodies, rows: Iterable[tuple[str, Feature]]) -> None:
        """Static models of objects that no world has told of."""
        for level, one in sorted(rows, key=lambda row: _natural(row[1].id)):
            model = bodies.model(one, self.layers.elevation(level), self.taken)
            if model is not None:
                self.made.append((model.get("name", ""), model))

    def _furnish(self, bodies: Bodies) -> None:
        """A ground to stand on and a light, where a world is made."""
        if "ground_plane" not in self.taken and self.options.ground and not bodies.hilly:
            self.made.append(("ground_plane", bodies.ground()))
            self.context.fill("ground plane", bodies.ground_size, "no world tells of the ground", "ground")
        lit = any(
            e.tag == "light" or sdf.element_text(e, "uri").lower().rstrip("/").endswith("sun") for _, e in self.made
        )
        if not lit and self.options.sun:
            name = free_name("sun", self.taken)
            self.made.append((name, sun(name)))
            self.context.fill("sun", "directional light", "no world tells of a light", "sun")

    def _place(self, world: etree._Element, source_world: _StoredWorld | None) -> None:
        """The datum as spherical coordinates; what the stored world says stays where it means the same."""
        datum = self.layers.datum
        old_coordinates = world.find("spherical_coordinates")
        if datum is None:
            return
        position = [datum.latitude, datum.longitude, datum.altitude, datum.heading]
        if old_coordinates is not None:
            meant = source_world.entry.get("datum") if source_world is not None else None
            if meant is None and not self.options.georeference:
                reason = (
                    "the world's spherical_coordinates are not the environment's datum: georeference=true puts it there"
                )
                self.context.warn(reason, where="spherical_coordinates")
                return
            if meant is not None and [float(v) for v in meant] == position:
                return
            world.remove(old_coordinates)
        coordinates = sdf.child(world, "spherical_coordinates")
        sdf.child(coordinates, "surface_model", "EARTH_WGS84")
        if (sdf.parse_version(self._version(source_world)) or (1, 7)) >= (1, 6):
            sdf.child(coordinates, "world_frame_orientation", "ENU")
        sdf.child(coordinates, "latitude_deg", number(datum.latitude, DEGREES))
        sdf.child(coordinates, "longitude_deg", number(datum.longitude, DEGREES))
        sdf.child(coordinates, "elevation", number(datum.altitude))
        sdf.child(coordinates, "heading_deg", number(-datum.heading, DEGREES))

    def _version(self, source_world: _StoredWorld | None) -> str:
        source_version = str(source_world.entry.get("version") or "") if source_world is not None else ""
        valid_version = source_version if source_version in sdf.VERSIONS else None
        if self.options.version is not None:
            if valid_version is not None and valid_version != self.options.version:
                self.context.warn(f"the world was written as SDFormat {valid_version}: its elements are not converted")
            return self.options.version
        return source_version or "1.7"

    def _bundle(self, world: etree._Element, source_world: _StoredWorld | None, bodies: Bodies) -> dict[str, bytes]:
        version = self._version(source_world)
        if bodies.newest > (sdf.parse_version(version) or (1, 7)):
            needed_version = ".".join(map(str, bodies.newest))
            if self.options.version is None and not (source_world is not None and source_world.is_world):
                version = needed_version
            else:
                self.context.warn(f"some shapes need SDFormat {needed_version}")
        root = etree.Element("sdf", version=version)
        root.append(world)
        main = sdf.serialise(root)
        files = {MAIN: main}
        stored: dict[str, bytes] = {}
        for part in self.layers.parts_of("resources", self.options.level, NAME).values():
            stored.update(part.files if isinstance(part, Resources) else {})
        if source_world is not None and len(self.stored) == 1:
            needed = dict(stored)
        else:
            library = sdf.Library({**stored, MAIN: main})
            needed = {n: stored[n] for n in sdf.required_files(library, MAIN)}
        needed |= bodies.files
        needed.pop(MAIN, None)
        return files | dict(sorted(needed.items()))


def _natural(text: str) -> tuple[tuple[int, str], ...]:
    """A sort key by which ``pole_10`` comes after ``pole_9``."""
    out, digits, letters = [], "", ""
    for letter in text:
        if letter.isascii() and letter.isdigit():
            if letters:
                out.append((0, letters))
                letters = ""
            digits += letter
        else:
            if digits:
                out.append((len(digits), digits))
                digits = ""
            letters += letter
    out.append((len(digits), digits) if digits else (0, letters))
    return tuple(out)


def _is_slice(grid: OccupancyGrid) -> bool:
    """Whether a grid was made of the objects beside it (``app.generate``)."""
    slice_properties = grid.properties.get("slice")
    return isinstance(slice_properties, Mapping) and slice_properties.get("of") == "objects"


def _is_pose(value: Any) -> bool:
    return (
        isinstance(value, (list, tuple))
        and len(value) == 6
        and all(isinstance(v, (int, float)) and not isinstance(v, bool) and math.isfinite(v) for v in value)
    )


def _element(text: str, tags: Sequence[str]) -> etree._Element | None:
    """A kept element; None where it is none of these."""
    try:
        element = xml.parse(text.encode(), Limits(), remove_blank_text=True)
    except (BadUpload, etree.LxmlError, ValueError):
        return None
    return element if element.tag in tags else None


register(
    Format(
        name=NAME,
        title="Gazebo world (SDFormat)",
        files={MAIN: "application/xml"},
        extensions=(".world", ".world.xml", ".sdf"),
        layers=frozenset({"objects", "occupancy", "resources"}),
        detect=detect,
        read=read,
        write=write,
        write_options=WriteOptions,
        needs=LayerRequirements(
            one_of=(frozenset({"objects"}), frozenset({"occupancy"})),
            anchor="local",
            also=frozenset({"resources", "occupancy"}),
        ),
        version=2,
        selection=Selection(choose),
        claims=Claims(priority=10, sort=sort),
        traits=Traits(has_title=True),
    )
)

"""Writing worlds: uploaded objects unchanged, and new bodies for objects of other formats."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from lxml import etree

from app.errors import BadUpload, MissingLayer, NotFound
from app.formats import WriteContext
from app.formats._select import select_part
from app.formats.gazebo import sdf
from app.formats.gazebo.bodies import Bodies, BodyDefaults, free_name, slug, sun, valid
from app.formats.gazebo.library import Library, parse_version, required_files
from app.formats.gazebo.reading import NAME, OBJECTS
from app.limits import Limits
from app.model import masks, worlds
from app.model.features import Feature, Features
from app.model.frame import GROUND
from app.model.grid import OccupancyGrid
from app.model.layers import Layers, PartKey, Resources
from app.parameters import parameter
from app.syntax import xml
from app.syntax.decimals import DEGREES, number

MAIN = "world.sdf"
NO_WALLS = ("keepout", "speed", "nogo")
"""Names of grids that are masks: they become walls only if requested by name."""

OF_GRIDS = "occupancy"
"""Family of objects derived from a grid (``occupancy_to_objects``)."""


@dataclass(frozen=True, slots=True)
class WriteOptions(BodyDefaults):
    """World to write, and conversion of objects and grids from other formats."""

    world: str | None = parameter(
        None, "name of the stored world's file, with or without directories; default: gazebo…, else the shortest name"
    )
    content: Literal["auto", "world", "all"] = parameter(
        "auto",
        "world: the stored world unchanged; all: with objects of other formats and the grid's walls; auto: the stored "
        "world if there is one, else all",
    )
    version: Literal["1.4", "1.5", "1.6", "1.7", "1.8", "1.9", "1.10", "1.11"] | None = parameter(
        None, "SDFormat version in the file; default: the stored world's, else 1.7"
    )
    georeference: bool = parameter(
        False, "replace spherical_coordinates 0, 0 (Gazebo's default) with the environment's datum"
    )
    grid: str | None = parameter(None, "grid whose occupied cells become walls; default: map, else the only one")
    level: str | None = parameter(
        None, "level of the objects and the grid; default: all levels for objects, the grid's own level"
    )
    threshold: int = parameter(65, "minimum value of cells that become walls", minimum=1, maximum=100)


def choose(keys: Sequence[PartKey], options: WriteOptions) -> list[PartKey]:
    """Choose all objects and their files, and one grid for walls: the named one, else ``map``, else the only one.

    Objects derived from a level's grid replace it, unless it is named.
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
            raise MissingLayer("a Gazebo world needs objects or an occupancy grid: supply one of them")
        return matches
    supply = "supply a map.yaml with its image, or objects"
    return matches + select_part(
        grids, "occupancy", options.grid, options.level, noun="grid", option="grid", supply=supply
    )


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """Write ``world.sdf`` and ``models/…``."""
    return _Writer(layers, context, context.options).files()


@dataclass(frozen=True, slots=True)
class _StoredWorld:
    """Stored world: its document, its objects, and their part."""

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
    """Writer of one world."""

    def __init__(self, layers: Layers, context: WriteContext, options: WriteOptions) -> None:
        self.layers, self.context, self.options = layers, context, options
        self.resources = layers.resources()
        self.elements: list[tuple[str, etree._Element]] = []
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
                raise NotFound(f"unknown world {world_name!r:.80}; available: {names}")
            return matches[0]
        if len(self.stored) > 1:
            names = ", ".join(w.key for w in self.stored[1:])
            self.context.warn(
                f"several stored worlds; {self.stored[0].key} is written, world= selects another: {names}"
            )
        return self.stored[0] if self.stored else None

    def files(self) -> dict[str, bytes]:
        """Return the files, the world first."""
        source_world = self._select_world()
        for other in self.stored:
            if other is not source_world:
                self.context.drop(
                    f"objects of the world {other.key}", len(other.objects), f"request it with world={other.key}"
                )
        world = self._frame(source_world)
        for one in sorted(source_world.objects if source_world is not None else [], key=lambda o: _natural(o.id)):
            self._restore_object(one)
        bodies = Bodies(self.context, self.resources, self.options)
        self._make_models(bodies, [(self.options.level or GROUND, one) for one in self.loose])
        everything = self.options.content == "all" or (
            self.options.content == "auto" and not (source_world is not None and source_world.is_world)
        )
        why = "a world is stored: request them with content=all"
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
                continue  # it describes rules for robots, not obstacles
            has_objects = any(other.level == key.level for other, _ in self.others)
            if self.options.grid is None and everything and has_objects and _is_slice(grid):
                continue  # its walls are already present as objects
            if everything or self.options.grid is not None:
                name = free_name(f"walls_{slug(key.name)}", self.taken)
                model = bodies.walls(grid, name, self.options.threshold, self.layers.elevation(key.level))
                if model is not None:
                    self.elements.append((name, model))
            else:
                self.context.drop(f"walls of the grid {key.name}", 1, why)
        if source_world is None or not source_world.is_world:
            self._furnish(bodies)
        bodies.report()
        self._place(world, source_world)
        world.extend([element for _, element in sorted(self.elements, key=lambda row: _natural(row[0]))])
        return self._bundle(world, source_world, bodies)

    def _frame(self, source_world: _StoredWorld | None) -> etree._Element:
        """Create the world's element with everything but objects."""
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
            self.context.warn(f"the stored elements of the world {source_world.key} cannot be read; they are skipped")
        return etree.Element("world", name=valid(sdf.stem(source_world.key) if source_world else self.context.title))

    def _restore_object(self, one: Feature) -> None:
        """Write an object of the stored world unchanged, with its current name and pose."""
        source_properties = one.properties.get(NAME, {})
        text = source_properties.get("sdf")
        element = _element(text, OBJECTS) if isinstance(text, str) else None
        if element is None:
            if isinstance(text, str):
                self.context.warn("the stored element cannot be read; it is rebuilt from its shapes", where=one.id)
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
            self.context.warn("duplicate object name in the world; Gazebo rejects it", where=name)
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
        self.elements.append((name, element))

    def _make_models(self, bodies: Bodies, rows: Iterable[tuple[str, Feature]]) -> None:
        """Write static models of objects from other formats."""
        for level, one in sorted(rows, key=lambda row: _natural(row[1].id)):
            model = bodies.model(one, self.layers.elevation(level), self.taken)
            if model is not None:
                self.elements.append((model.get("name", ""), model))

    def _furnish(self, bodies: Bodies) -> None:
        """Add a ground plane and a light to a generated world."""
        if "ground_plane" not in self.taken and self.options.ground and not bodies.hilly:
            self.elements.append(("ground_plane", bodies.ground()))
            self.context.fill("ground plane", bodies.ground_size, "no stored world has a ground", "ground")
        lit = any(
            e.tag == "light" or sdf.element_text(e, "uri").lower().rstrip("/").endswith("sun") for _, e in self.elements
        )
        if not lit and self.options.sun:
            name = free_name("sun", self.taken)
            self.elements.append((name, sun(name)))
            self.context.fill("sun", "directional light", "no stored world has a light", "sun")

    def _place(self, world: etree._Element, source_world: _StoredWorld | None) -> None:
        """Write the datum as spherical coordinates; equivalent ones of the stored world stay unchanged."""
        datum = self.layers.datum
        old_coordinates = world.find("spherical_coordinates")
        if datum is None:
            return
        position = [datum.latitude, datum.longitude, datum.altitude, datum.heading]
        if old_coordinates is not None:
            meant = source_world.entry.get("datum") if source_world is not None else None
            if meant is None and not self.options.georeference:
                reason = "spherical_coordinates differ from the environment's datum; georeference=true replaces them"
                self.context.warn(reason, where="spherical_coordinates")
                return
            if meant is not None and [float(v) for v in meant] == position:
                return
            world.remove(old_coordinates)
        coordinates = sdf.child(world, "spherical_coordinates")
        sdf.child(coordinates, "surface_model", "EARTH_WGS84")
        if (parse_version(self._version(source_world)) or (1, 7)) >= (1, 6):
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
                self.context.warn(f"the world was written as SDFormat {valid_version}; its elements are not converted")
            return self.options.version
        return source_version or "1.7"

    def _bundle(self, world: etree._Element, source_world: _StoredWorld | None, bodies: Bodies) -> dict[str, bytes]:
        version = self._version(source_world)
        if bodies.newest > (parse_version(version) or (1, 7)):
            needed_version = ".".join(map(str, bodies.newest))
            if self.options.version is None and not (source_world is not None and source_world.is_world):
                version = needed_version
            else:
                self.context.warn(f"some shapes need SDFormat {needed_version}; older readers reject them")
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
            library = Library({**stored, MAIN: main})
            needed = {n: stored[n] for n in required_files(library, MAIN)}
        needed |= bodies.files
        needed.pop(MAIN, None)
        return files | dict(sorted(needed.items()))


def _natural(text: str) -> tuple[tuple[int, str], ...]:
    """Return a sort key that puts ``pole_10`` after ``pole_9``."""
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
    """Check that a grid was rasterised from the objects beside it (``app.generate``)."""
    slice_properties = grid.properties.get("slice")
    return isinstance(slice_properties, Mapping) and slice_properties.get("of") == "objects"


def _is_pose(value: Any) -> bool:
    return (
        isinstance(value, (list, tuple))
        and len(value) == 6
        and all(isinstance(v, (int, float)) and not isinstance(v, bool) and math.isfinite(v) for v in value)
    )


def _element(text: str, tags: Sequence[str]) -> etree._Element | None:
    """Parse a stored element, or return None if its tag is not one of ``tags``."""
    try:
        element = xml.parse(text.encode(), Limits(), remove_blank_text=True)
    except (BadUpload, etree.LxmlError, ValueError):
        return None
    return element if element.tag in tags else None

"""environment: a complete environment_template package as one archive.

``config/location`` contains the datum, the fence and georeferenced images, ``config/metric/<grid>`` a map.yaml with its
image for each grid (``<name>/map.bt`` for voxels), ``config/topological`` the network, ``config/world`` the Gazebo
world, points of interest and all other objects, ``config/properties.sh`` the name of the place and
``config/environment.sh`` the paths of its files. Source: LCAS/environment_template, releases v1.0.x and older.

Robots source the two scripts, so they are always generated, never copied: literal variables of an upload are written
with ``shell.exports``; the script computes variables that name files from its own location, for existing files only;
as in the template, those of missing maps are empty. The archive contains stored maps; ``complete`` adds derived ones.

``config/fleet_map`` contains the stored layers exactly (``environment.content``): a package with unchanged maps
restores the same environment; if a map was edited, the maps are read. Additional files that no format can read (a
README, ``.DS_Store``) do not count as edits.

Every map in it has another format: reading equals an upload of the directory (``app.upload_reader``), and writers come
from ``WriteContext.make``.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Container, Mapping
from dataclasses import dataclass
from typing import Any

from app.errors import CannotConvert, FleetMapError, MissingLayer, Problem, UnreadableFile
from app.formats import (
    Claims,
    Files,
    Format,
    LayerRequirements,
    NestedMap,
    ReadContext,
    Traits,
    WriteContext,
    register,
)
from app.formats._network import shorten_list
from app.formats.environment import content as exact_content
from app.limits import Limits
from app.model.features import Features
from app.model.frame import GROUND, Level
from app.model.layers import LAYERS, MAP, NETWORK, Layer, Layers, Part, PartKey, cloud_name, is_empty
from app.model.voxels import VoxelMap
from app.parameters import parameter
from app.syntax import archives, shell

NAME = "environment"
MAIN = "environment.zip"
CONFIG = "config"
FOLDERS = ("location", "metric", "topological", "world")
RELEASE = "ENVIRONMENT_COMMON_LATEST_RELEASE"
"""The only literal variable in environment.sh; all others are properties of the place."""

CLOUDS = {"laz": "las"}
"""Format names of point cloud extensions that differ from the format's name."""

NO_GO = ("nogo", "keepout")
"""Names of grids for NOGO_COSTMAP_YAML_FILE."""

_FOLDER_NAMES = tuple(f"{CONFIG}/{folder}/".encode() for folder in FOLDERS)
_PATH = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*(?:/[A-Za-z0-9_][A-Za-z0-9_.-]*)*/?")
"""Valid paths between double quotes in a script: no characters that are special in a shell."""

STORED_LAYERS: tuple[Layer, ...] = tuple(layer for layer in LAYERS if layer != "resources")


@dataclass(frozen=True, slots=True)
class WriteOptions:
    """Content in addition to the stored maps."""

    complete: bool = parameter(False, "also derive the network, the map and the world if they are not stored")


# --- reading ---------------------------------------------------------------------------------------------------------


def detect(name: str, data: bytes) -> bool:
    """Detect an archive that contains one of the template's directories."""
    if name.lower().endswith(".kmz") or not archives.is_archive(data):
        return False
    return any(folder in data for folder in _FOLDER_NAMES)


def read(files: Files, context: ReadContext) -> Layers:
    """Read the directory in the archive as an upload of its files. Raises the errors of their readers."""
    if context.folder is None:
        reason = "an environment package inside another one is not opened: upload it separately"
        raise UnreadableFile(reason, [Problem(reason)])
    members = archives.unpack(files[context.main or next(iter(files))], context.limits)
    if not members:
        raise UnreadableFile("the archive is empty", [Problem("the archive is empty")])
    return context.folder(members)


# --- writing ---------------------------------------------------------------------------------------------------------


def write(layers: Layers, context: WriteContext) -> dict[str, bytes]:
    """Write ``environment.zip``. Raises MissingLayer if there is nothing to write."""
    return {MAIN: archives.pack(_Writer(layers, context).files())}


class _Writer:
    """Writer of one package: files by path below ``config``, and the files that variables name."""

    def __init__(self, layers: Layers, context: WriteContext) -> None:
        if context.make is None:
            raise CannotConvert(
                "an environment package contains maps of other formats, which cannot be written in this context"
            )
        self.layers, self.context, self.make = layers, context, context.make
        self.complete = bool(getattr(context.options, "complete", False))
        self.out: dict[str, bytes] = {}
        self.paths: dict[str, str] = {}
        self.reported: set[PartKey] = set()

    def files(self) -> dict[str, bytes]:
        """Return the files. Writes the maps of each layer; dropped data is reported by path."""
        self.location()
        self.pictures()
        self.grids()
        self.voxels()
        self.network()
        self.world()
        self.points()
        self.objects()
        variables = self.variables()
        if not self.out and not variables:
            raise MissingLayer("an environment package needs at least one map: supply a map of any kind")
        self.report_unwritten()
        self.scripts(variables)
        if self.context.stored is not None and not self.complete:  # derived maps differ from the stored layers
            content = exact_content.pack(self.layers, self.out, self.context.stored)
            if len(content[exact_content.MAIN]) <= Limits().text_bytes:
                self.out |= content
            else:
                self.context.warn(
                    "the stored layers are too large for an exact copy; the package contains the maps only"
                )
        return {f"{CONFIG}/{path}": data for path, data in self.out.items()}

    # --- one map ---

    def write_map(
        self, name: str, layers: Layers, values: Mapping[str, Any] | None = None, *, derived: bool = False
    ) -> NestedMap | None:
        """Write a map with another format's writer; return None, with the reason in the report, if it fails."""
        try:
            return self.make(name, layers, values or {}, derived)
        except FleetMapError as error:
            self.context.warn(f"the package contains no {name}: {error.detail}")
        return None

    def add_files(self, names: Mapping[str, str], inner: NestedMap, *, copy: bool = False) -> str:
        """Add a map's files and return the path of its main file, with a number if the path is in use.

        Args:
            names: path in the package by the map's own name of a file.
            copy: whether another map has the same content, so that data dropped by this one is not reported.
        """
        first = next(iter(inner.files))
        names = {**names, first: self.free_path(names[first], inner.files[first])}
        self.out |= {names[name]: data for name, data in inner.files.items()}
        main = f"{CONFIG}/{names[first]}"
        if not copy:
            self.context.dropped += [
                dataclasses.replace(line, subject=f"{main}: {line.subject}") for line in inner.dropped
            ]
            self.context.template += [
                dataclasses.replace(line, subject=f"{main}: {line.subject}") for line in inner.template
            ]
        reported = {problem.problem for problem in self.context.warnings} if copy else ()
        for problem in inner.warnings:
            if problem.problem in reported:
                continue
            path_ = names.get(problem.file or "")
            self.context.warnings.append(dataclasses.replace(problem, file=f"{CONFIG}/{path_}" if path_ else main))
        return names[first]

    def free_path(self, path: str, data: bytes) -> str:
        """Return a path that no other content has, also on case-insensitive file systems."""
        if self.out.get(path) == data:
            return path
        end = _file_ending(path)
        return _unique_names(path.removesuffix(end), end, {other.casefold() for other in self.out})

    def select_layers(self, *layers: Layer) -> Layers:
        """Return the stored parts of these layers."""
        parts = {k: p for k, p in self.layers.parts.items() if k.layer in layers and not is_empty(p)}
        return Layers(parts, self.layers.datum, self.layers.levels)

    def with_parts(self, parts: Mapping[PartKey, Part]) -> Layers:
        return Layers(dict(parts), self.layers.datum, self.layers.levels)

    # --- the folders ---

    def location(self) -> None:
        site = self.select_layers("location")
        self.reported.update(site.parts)
        if self.layers.datum is not None:
            # The grids give the extent of the map.
            inner = self.write_map("datum", self.select_layers("location", "occupancy"))
            if inner is not None:
                self.add_files(dict.fromkeys(inner.files, "location/datum.yaml"), inner)
                self.paths["DATUM_FILE"] = "location/datum.yaml"
        if any(isinstance(part, Features) and len(part) for part in site.parts.values()):
            inner = self.write_map("kml", _display_layers(site))
            if inner is not None:
                self.add_files(dict.fromkeys(inner.files, "location/fence.kml"), inner, copy="DATUM_FILE" in self.paths)

    def pictures(self) -> None:
        for key, part in self.layers.parts_of("imagery").items():
            inner = self.write_map("satellite", self.with_parts({key: part}))
            if inner is None:
                continue
            self.reported.add(key)
            stem = self.stem(key, {k for k in self.layers.parts if k.layer == "imagery"})
            self.add_files({n: f"location/{stem}{_file_ending(n)}" for n in inner.files}, inner)

    def grids(self) -> None:
        """Write each grid to a directory with its name, which readers use as the grid's name."""
        grids = self.layers.grids()
        if not grids and self.complete:
            inner = self.write_map("occupancy_grid", self.layers, derived=True)
            if inner is not None:
                self.add_files({n: f"metric/{MAP}/{n.rpartition('/')[2]}" for n in inner.files}, inner)
                main = f"metric/{MAP}/{next(iter(inner.files)).rpartition('/')[2]}"
                self.paths["COSTMAP_YAML_FILE"] = main
        names: dict[str, list[str]] = {}
        for key, grid in grids.items():
            stem = self.stem(key, set(grids))
            inner = self.write_map("occupancy_grid", self.with_parts({PartKey("occupancy", GROUND, MAP): grid}))
            if inner is None:
                continue
            self.reported.add(key)
            self.add_files({n: f"metric/{stem}/{n}" for n in inner.files}, inner)
            names.setdefault(key.name, []).append(f"metric/{stem}/{next(iter(inner.files))}")
        paths = names.get(MAP) or ([p for row in names.values() for p in row] if len(grids) == 1 else [])
        if paths:
            self.paths["COSTMAP_YAML_FILE"] = paths[0]
        elif len(names) > 1:
            self.context.warn(
                f"none of the grids {shorten_list(sorted(names))} is named {MAP}; COSTMAP_YAML_FILE is empty"
            )
        for name in NO_GO:
            if name in names:
                self.paths.setdefault("NOGO_COSTMAP_YAML_FILE", names[name][0])

    def voxels(self) -> None:
        """Write each voxel map to a directory with its name, with its source point cloud."""
        keys = {k for k in self.layers.parts if k.layer == "voxels"}
        for key in sorted(keys):
            part = self.layers.parts[key]
            stem = self.stem(key, keys)
            inner = self.write_map("octomap", self.with_parts({key: part}))
            cloud = PartKey("resources", key.level, cloud_name(key.name))
            source_properties = part.properties.get("points") if isinstance(part, VoxelMap) else None
            end = (
                str(source_properties.get("file")).rpartition(".")[2].lower()
                if isinstance(source_properties, Mapping)
                else ""
            )
            made_of = end if cloud in self.layers.parts else ""
            if inner is not None:
                self.reported.add(key)
                # Of two equivalent files the reader uses the shorter name: give it to the points, which voxels lack.
                name = "octomap" if made_of else MAP
                self.add_files({n: f"metric/{stem}/{name}{_file_ending(n)}" for n in inner.files}, inner)
            if not made_of:
                continue
            points = self.write_map(CLOUDS.get(end, end), self.with_parts({key: part, cloud: self.layers.parts[cloud]}))
            if points is not None:
                self.reported.add(cloud)
                self.add_files({n: f"metric/{stem}/cloud{_file_ending(n)}" for n in points.files}, points, copy=True)

    def network(self) -> None:
        networks = self.select_layers("topology")
        self.reported.update(networks.parts)
        if not networks.parts and not self.complete:
            return
        source = networks if networks.parts else self.select_layers("objects", "occupancy", "imagery", "topology")
        inner = self.write_map("tmap2", source, derived=not networks.parts)
        if inner is None:
            return
        self.add_files(dict.fromkeys(inner.files, "topological/network.tmap2.yaml"), inner)
        self.paths["TMAP_FILE"] = "topological/network.tmap2.yaml"
        if networks.parts and (drawn := self.write_map("kml", _display_layers(networks))) is not None:
            self.add_files(dict.fromkeys(drawn.files, "topological/network.kml"), drawn, copy=True)

    def world(self) -> None:
        """Write the stored worlds, each with its own name; else one generated from the layers, if requested."""
        own_parts = {k: p for k, p in self.layers.vector("objects").items() if k.name == "gazebo"}
        worlds: dict[str, dict[str, Any]] = {}
        for part in own_parts.values():
            source_document = part.document.get("gazebo")
            stored = source_document.get("worlds") if isinstance(source_document, Mapping) else None
            worlds |= (
                {str(name): {"world": str(name), "content": "world"} for name in stored}
                if isinstance(stored, Mapping)
                else {}
            )
        if own_parts and not worlds:
            worlds = {"gazebo": {}}
        if not own_parts and self.complete:
            worlds = {"gazebo": {}}
        first: list[str] = []
        for name, values in worlds.items():
            source = self.select_layers("objects", "resources", "occupancy")
            if own_parts:
                world_parts = {k: p for k, p in source.parts.items() if k.name == "gazebo" and k.layer != "occupancy"}
                source = self.with_parts(world_parts)
            inner = self.write_map("gazebo", source, values, derived=not own_parts)
            if inner is None:
                continue
            # Objects of other worlds are not lost: they are in the other worlds' files.
            others_ = {f"request it with world={other}" for other in worlds}
            inner = dataclasses.replace(inner, dropped=tuple(d for d in inner.dropped if d.why not in others_))
            self.reported.update(own_parts)
            self.reported.update(k for k in self.layers.parts if k.layer == "resources" and k.name == "gazebo")
            main, *companions = inner.files
            path = f"world/{_world_name(name)}"
            paths = {n: f"world/custom_models/{n.removeprefix('models/')}" for n in companions}
            first.append(self.add_files({main: path, **paths}, inner))
            if companions:
                self.paths["GAZEBO_CUSTOM_MODELS"] = "world/custom_models/"
        if first:
            # The name that the template expects, else that of a directory with one world.
            best = min(first, key=lambda p: (not p.startswith("world/gazebo"), len(p), p))
            self.paths["GAZEBO_WORLD_FILE"] = best

    def points(self) -> None:
        """Write points of interest as a topological map of nodes without edges."""
        own_parts = {k: p for k, p in self.layers.vector("objects").items() if k.name == "tmap2" and len(p)}
        for key, part in own_parts.items():
            nodes = tuple({**p, "kind": "node"} for p in part.properties)
            network = Features(part.ids, part.geometry, nodes, part.local, part.document)
            inner = self.write_map("tmap2", self.with_parts({PartKey("topology", key.level, NETWORK): network}))
            if inner is None:
                continue
            self.reported.add(key)
            path = "world/poi.tmap2.yaml" if key.level == GROUND else f"world/poi_{_plain(key.level)}.tmap2.yaml"
            self.paths.setdefault("POI_FILE", self.add_files(dict.fromkeys(inner.files, path), inner))

    def objects(self) -> None:
        """Write objects in their source format; zones and objects of GeoJSON or no format in one GeoJSON file."""
        remaining: dict[PartKey, Part] = {
            k: p for k, p in self.select_layers("zones").parts.items() if isinstance(p, Features)
        }
        families: dict[str, dict[PartKey, Part]] = {}
        for key, part in self.layers.vector("objects").items():
            if len(part) and key not in self.reported:
                families.setdefault(key.name, {})[key] = part
        for family, parts in families.items():
            inner = self.family(family, parts) if family != "geojson" else None
            if inner is None:
                remaining |= parts
                continue
            main, *companions = inner.files
            names = {n: f"world/{_plain(family)}/{n}" for n in inner.files}
            if not companions:
                end = _file_ending(main)
                plain = end in (f".{family}", ".kmz")
                names[main] = f"world/objects{end}" if plain else f"world/objects_{_plain(family)}{end}"
            self.add_files(names, inner)
            self.reported.update(parts)
            further = {family, "kmz"} if main.endswith(".kmz") else {family}
            self.reported.update(k for k in self.layers.parts if k.layer == "resources" and k.name in further)
        if remaining:
            inner = self.write_map("geojson", self.with_parts(remaining))
            if inner is not None:
                self.add_files(dict.fromkeys(inner.files, "world/objects.geojson"), inner)
                self.reported.update(remaining)

    def family(self, name: str, parts: Mapping[PartKey, Part]) -> NestedMap | None:
        """Write a map in the source format of these objects; None if it cannot contain all of them."""
        names = (name, "kmz") if name == "kml" else (name,)
        resources = {k: p for k, p in self.layers.parts.items() if k.layer == "resources" and k.name in names}
        if any(k.name == "kmz" for k in resources):
            name = "kmz"
        try:
            return self.make(name, self.with_parts({**parts, **resources}), {}, False)
        except FleetMapError:
            pass
        try:
            networks = self.select_layers("topology").parts
            return self.make(name, self.with_parts({**parts, **resources, **networks}), {}, False)
        except FleetMapError:
            return None

    def report_unwritten(self) -> None:
        """Report parts that no file of the package contains."""
        for key, part in sorted(self.layers.parts.items()):
            if key in self.reported or is_empty(part) or key.name == NAME:
                continue
            count = len(part) if isinstance(part, Features) else 1
            if count:
                part_name = f"{key.layer} {key.level}/{key.name}"
                self.context.drop(
                    part_name, count, "no format in the package can contain it, or its map cannot be written"
                )
        levels = {k.level for k in self.reported if k.layer in ("occupancy", "voxels", "imagery")} - {GROUND}
        self.context.drop("levels of grids and images", len(levels), "the template's directories have one level")
        if self.layers.levels != (Level(),):
            more = sum(level != Level() for level in self.layers.levels)
            self.context.drop("elevations of levels", more, "the template's directories have one level")

    def stem(self, key: PartKey, all_keys: set[PartKey]) -> str:
        """Return a unique directory name for a part: its name on the ground, elsewhere with its level."""
        stems: dict[PartKey, str] = {}
        for k in sorted(all_keys):
            name = _plain(k.name if k.level == GROUND else f"{k.name}_{k.level}")
            stems[k] = _unique_names(name, "", {other.casefold() for other in stems.values()})
        return stems[key]

    # --- the scripts ---

    def variables(self) -> dict[str, str]:
        """Return the stored variables except those with file paths."""
        all_variables: dict[str, Any] = {}
        for key, part in self.layers.vector("objects").items():
            stored = part.document.get(NAME) if key.name == NAME else None
            values = stored.get("variables") if isinstance(stored, Mapping) else None
            all_variables |= values if isinstance(values, Mapping) else {}
        out, file_names, reasons = shell.exported_variables(all_variables)
        self.context.drop(
            "variables that name files",
            len(file_names),
            f"they are replaced with paths in the package: {shorten_list(file_names)}",
        )
        for reason in reasons:
            self.context.drop("variables", 1, reason)
        return out

    def scripts(self, variables: Mapping[str, str]) -> None:
        properties = {n: v for n, v in variables.items() if n != RELEASE}
        release = {n: v for n, v in variables.items() if n == RELEASE}
        head = b"# What this environment is called. Sourced by environment.sh.\n"
        self.out["properties.sh"] = head + shell.exports(properties)
        lines = [
            "# Where the maps of this environment are: source this file in bash.",
            *shell.exports(release).decode().splitlines(),
            "",
            'CONFIG_DIR=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)',
            self.path("PROPERTIES_FILE", "properties.sh"),
            '. "$PROPERTIES_FILE"',
            "",
        ]
        always = ("DATUM_FILE", "TMAP_FILE", "GAZEBO_WORLD_FILE", "COSTMAP_YAML_FILE")
        lines += [self.path(name, self.paths.get(name)) for name in always]
        sometimes = ("NOGO_COSTMAP_YAML_FILE", "POI_FILE")
        lines += [self.path(name, self.paths[name]) for name in sometimes if name in self.paths]
        if "GAZEBO_CUSTOM_MODELS" in self.paths:
            lines.append(self.path("GAZEBO_CUSTOM_MODELS", self.paths["GAZEBO_CUSTOM_MODELS"]))
            lines.append('export GAZEBO_MODEL_PATH="${GAZEBO_MODEL_PATH:+$GAZEBO_MODEL_PATH:}$GAZEBO_CUSTOM_MODELS"')
        self.out["environment.sh"] = "\n".join([*lines, ""]).encode()

    def path(self, name: str, path: str | None) -> str:
        """Format a line that exports a path relative to the package, or an empty value if there is no such file."""
        if path is None:
            return f"export {name}=''"
        exists = path in self.out or path == "properties.sh" or any(n.startswith(path) for n in self.out)
        if not _PATH.fullmatch(path) or not exists:
            raise ValueError(f"{name} refers to {path!r}, which is not a file of the package")
        return f'export {name}="$CONFIG_DIR/{path}"'


def _display_layers(layers: Layers) -> Layers:
    """Return the layers for display: without source properties, which are in their own format's file."""
    parts: dict[PartKey, Part] = {}
    for key, part in layers.parts.items():
        if isinstance(part, Features):
            order = sorted(range(len(part)), key=part.ids.__getitem__)
            features = part.select(order)
            plain = tuple({n: v for n, v in p.items() if not isinstance(v, Mapping)} for p in features.properties)
            document = {n: v for n, v in part.document.items() if n == "attribution"}
            parts[key] = Features(features.ids, features.geometry, plain, features.local, document)
    return Layers(parts, layers.datum, layers.levels)


def _plain(name: str) -> str:
    """Convert a name to a file or directory name of letters, digits, ``_``, ``.`` and ``-``."""
    plain = re.sub(r"[^A-Za-z0-9_.-]+", "_", name).lstrip(".-")[:64]
    return plain or "unnamed"


def _unique_names(stem: str, end: str, taken: Container[str]) -> str:
    """Return ``stem`` with its extension, with the first free number from 2 if in use. taken: case-folded."""
    path, number = f"{stem}{end}", 2
    while path.casefold() in taken:
        path, number = f"{stem}_{number}{end}", number + 1
    return path


def _world_name(name: str) -> str:
    """Return a world's source file name, with an extension of worlds."""
    stem = _plain(name.rpartition("/")[2])
    return stem if stem.endswith((".world", ".world.xml", ".sdf")) else f"{stem}.world.xml"


def _file_ending(name: str) -> str:
    """Return everything from the first point: ``.tif``, ``.pgw``, ``.png.aux.xml``."""
    base = name.rpartition("/")[2]
    return base[base.index(".") :] if "." in base else ""


register(
    Format(
        name=NAME,
        title="environment_template package (all maps of a place)",
        files={MAIN: "application/zip"},
        layers=frozenset(LAYERS),
        detect=detect,
        read=read,
        write=write,
        needs=LayerRequirements(tuple(frozenset({layer}) for layer in STORED_LAYERS)),
        write_options=WriteOptions,
        version=3,
        extensions=(".zip",),
        claims=Claims(priority=70),
        traits=Traits(is_container=True),
    )
)

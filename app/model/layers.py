"""Content of an environment: parts, each one (layer, level, name), with their datum and levels."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Literal, get_args

from app.errors import Invalid
from app.model.features import Features
from app.model.frame import GROUND, Datum, Level, is_writable
from app.model.geodesy import LocalFrame, local_frame
from app.model.grid import OccupancyGrid
from app.model.imagery import GeoImage
from app.model.names import name_problem
from app.model.voxels import VoxelMap

Layer = Literal["location", "objects", "topology", "occupancy", "voxels", "imagery", "zones", "resources"]
"""Kinds of content, and ``resources``: files that items refer to (meshes, images), stored byte for byte."""

LAYERS: tuple[Layer, ...] = get_args(Layer)
CONTENT_LAYERS: tuple[Layer, ...] = tuple(layer for layer in LAYERS if layer != "resources")
"""The seven public layers; ``resources`` are files of objects."""

VECTOR_LAYERS: frozenset[Layer] = frozenset({"location", "objects", "topology", "zones"})

NETWORK = "network"
SITE = "site"
ZONES = "zones"
MAP = "map"
"""Default part names: one network, one site, one set of zones per level, and the grid that robots drive on."""

CLOUD = "points/"


def cloud_name(voxels: str) -> str:
    """Return the name of the resources with the point cloud from which a voxel map of this name was made."""
    return f"{CLOUD}{voxels}"[:256]


@dataclass(frozen=True, slots=True)
class Resources:
    """Files that belong to a part's items, by relative path with forward slashes."""

    files: Mapping[str, bytes]

    def __post_init__(self) -> None:
        for path in self.files:
            if reason := name_problem(path):
                raise Invalid(f"invalid resource path {path[:80]!r}: it {reason}")


Part = Features | OccupancyGrid | VoxelMap | GeoImage | Resources

PART_TYPES: Mapping[Layer, type] = {
    "location": Features,
    "objects": Features,
    "topology": Features,
    "zones": Features,
    "occupancy": OccupancyGrid,
    "voxels": VoxelMap,
    "imagery": GeoImage,
    "resources": Resources,
}


@dataclass(frozen=True, slots=True, order=True)
class PartKey:
    """Key of a part. name of vector parts: a network, a site, or the format family of the objects' source."""

    layer: Layer
    level: str = GROUND
    name: str = MAP

    def __post_init__(self) -> None:
        if self.layer not in LAYERS:
            raise Invalid(f"unknown layer {self.layer!r}: use one of {', '.join(LAYERS)}")
        for label, text in (("level", self.level), ("name", self.name)):
            if not text or len(text) > 256 or not is_writable(text):
                raise Invalid(f"a {label} must have 1 to 256 characters and no control characters, got {text[:80]!r}")


@dataclass(frozen=True, slots=True, eq=False)
class Layers:
    """Content of a file that was read, or of a map to be written."""

    parts: Mapping[PartKey, Part] = field(default_factory=dict)
    datum: Datum | None = None
    levels: tuple[Level, ...] = (Level(),)

    def __post_init__(self) -> None:
        for key, part in self.parts.items():
            if not isinstance(part, PART_TYPES[key.layer]):
                raise ValueError(f"{key} must be {PART_TYPES[key.layer].__name__}, got {type(part).__name__}")

    @property
    def frame(self) -> LocalFrame | None:
        """Return the local frame, None without a datum."""
        return None if self.datum is None else local_frame(self.datum)

    @property
    def layers(self) -> frozenset[Layer]:
        """Return the layers with content: a collection without items does not count, whatever its document contains."""
        full = {
            k.layer for k, p in self.parts.items() if not is_empty(p) and (len(p) if isinstance(p, Features) else 1)
        }
        return frozenset(full | ({"location"} if self.datum else set()))

    def parts_of(self, layer: Layer, level: str | None = None, name: str | None = None) -> dict[PartKey, Part]:
        """Return the parts of a layer, in the order of their keys."""
        return {
            key: self.parts[key]
            for key in sorted(self.parts)
            if key.layer == layer and level in (None, key.level) and name in (None, key.name)
        }

    def vector(self, layer: Layer, level: str | None = None) -> dict[PartKey, Features]:
        """Return the feature collections of a vector layer, in the order of their keys."""
        return {key: part for key, part in self.parts_of(layer, level).items() if isinstance(part, Features)}

    def grids(self, level: str | None = None) -> dict[PartKey, OccupancyGrid]:
        """Return the occupancy grids, in the order of their keys."""
        return {key: part for key, part in self.parts_of("occupancy", level).items() if isinstance(part, OccupancyGrid)}

    def resources(self) -> dict[str, bytes]:
        """Return all resource files by path."""
        out: dict[str, bytes] = {}
        for part in self.parts_of("resources").values():
            if isinstance(part, Resources):
                out.update(part.files)
        return out

    def elevation(self, level: str) -> float:
        """Return the metres of a level's floor above the local origin; 0 if unknown."""
        return next((candidate.elevation for candidate in self.levels if candidate.name == level), 0.0)


def is_empty(part: Part) -> bool:
    """Return whether a part is empty: features without items or document, resources without files."""
    if isinstance(part, Features):
        return not len(part) and not part.document
    return isinstance(part, Resources) and not part.files


def join_levels(old: Iterable[Level], new: Iterable[Level]) -> tuple[Level, ...]:
    """Merge levels; the new elevations win; sorted by elevation and name."""
    levels = {level.name: level for level in old} | {level.name: level for level in new}
    return tuple(sorted(levels.values(), key=lambda level: (level.elevation, level.name)))

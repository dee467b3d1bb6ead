"""An environment's content: parts, each one (layer, level, name), with the datum and the levels they refer to."""

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
"""The kinds of information, and ``resources``: files that items refer to (meshes, images), kept byte for byte."""

LAYERS: tuple[Layer, ...] = get_args(Layer)
CONTENT_LAYERS: tuple[Layer, ...] = tuple(layer for layer in LAYERS if layer != "resources")
"""The seven layers that clients see; ``resources`` are files that objects need."""

VECTOR_LAYERS: frozenset[Layer] = frozenset({"location", "objects", "topology", "zones"})

NETWORK = "network"
SITE = "site"
ZONES = "zones"
MAP = "map"
"""The usual part names: one network, one site, one set of zones a level, and the grid that robots drive on."""

CLOUD = "points/"


def cloud_name(voxels: str) -> str:
    """The name of the resources that hold the point cloud which a voxel map of this name was made of."""
    return f"{CLOUD}{voxels}"[:256]


@dataclass(frozen=True, slots=True)
class Resources:
    """Files that belong to a part's items, by relative path with forward slashes."""

    files: Mapping[str, bytes]

    def __post_init__(self) -> None:
        for path in self.files:
            if reason := name_problem(path):
                raise Invalid(f"a resource cannot be called {path[:80]!r}: the name {reason}")


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
    """The name of a part. Vector parts: a network, a site, or the format family that objects came from."""

    layer: Layer
    level: str = GROUND
    name: str = MAP

    def __post_init__(self) -> None:
        if self.layer not in LAYERS:
            raise Invalid(f"no layer is called {self.layer!r}; there are {', '.join(LAYERS)}")
        for label, text in (("level", self.level), ("name", self.name)):
            if not text or len(text) > 256 or not is_writable(text):
                raise Invalid(f"a {label} must have 1 to 256 characters and no control characters, got {text[:80]!r}")


@dataclass(frozen=True, slots=True, eq=False)
class Layers:
    """What a file holds, or what a map is written from: the same shape both ways."""

    parts: Mapping[PartKey, Part] = field(default_factory=dict)
    datum: Datum | None = None
    levels: tuple[Level, ...] = (Level(),)

    def __post_init__(self) -> None:
        for key, part in self.parts.items():
            if not isinstance(part, PART_TYPES[key.layer]):
                raise ValueError(f"{key} must be {PART_TYPES[key.layer].__name__}, got {type(part).__name__}")

    @property
    def frame(self) -> LocalFrame | None:
        """The local frame, where there is a datum."""
        return None if self.datum is None else local_frame(self.datum)

    @property
    def layers(self) -> frozenset[Layer]:
        """The layers that have content: a collection without items is no information, whatever its document says."""
        full = {
            k.layer for k, p in self.parts.items() if not is_empty(p) and (len(p) if isinstance(p, Features) else 1)
        }
        return frozenset(full | ({"location"} if self.datum else set()))

    def parts_of(self, layer: Layer, level: str | None = None, name: str | None = None) -> dict[PartKey, Part]:
        """The parts of a layer, by key order."""
        return {
            key: self.parts[key]
            for key in sorted(self.parts)
            if key.layer == layer and level in (None, key.level) and name in (None, key.name)
        }

    def vector(self, layer: Layer, level: str | None = None) -> dict[PartKey, Features]:
        """The feature collections of a vector layer, by key order."""
        return {key: part for key, part in self.parts_of(layer, level).items() if isinstance(part, Features)}

    def grids(self, level: str | None = None) -> dict[PartKey, OccupancyGrid]:
        """The occupancy grids, by key order."""
        return {key: part for key, part in self.parts_of("occupancy", level).items() if isinstance(part, OccupancyGrid)}

    def resources(self) -> dict[str, bytes]:
        """All resource files by path."""
        out: dict[str, bytes] = {}
        for part in self.parts_of("resources").values():
            if isinstance(part, Resources):
                out.update(part.files)
        return out

    def elevation(self, level: str) -> float:
        """Metres of a level's floor above the local origin; 0 where it is not stated."""
        return next((candidate.elevation for candidate in self.levels if candidate.name == level), 0.0)


def is_empty(part: Part) -> bool:
    """Whether a part holds nothing: features without items or document, resources without files."""
    if isinstance(part, Features):
        return not len(part) and not part.document
    return isinstance(part, Resources) and not part.files


def join_levels(old: Iterable[Level], new: Iterable[Level]) -> tuple[Level, ...]:
    """Levels of both, the new elevations win, sorted by elevation and name."""
    levels = {level.name: level for level in old} | {level.name: level for level in new}
    return tuple(sorted(levels.values(), key=lambda level: (level.elevation, level.name)))
